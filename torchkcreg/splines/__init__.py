"""Lattice of control points around an implant, and the cubic B-spline displacement field between them.

Displacements of control points are in the grid's axes; points and fields are in the implant's frame.
"""

from .basis import SplineBasis, cubic_bspline_derivatives, cubic_bspline_weights
from .displacement import cell_features, group_rigid_motions, spline_displacement
from .grid import ControlPointGrid, default_grid

__all__ = [
    "ControlPointGrid",
    "SplineBasis",
    "cell_features",
    "cubic_bspline_derivatives",
    "cubic_bspline_weights",
    "default_grid",
    "group_rigid_motions",
    "spline_displacement",
]
