"""How an implant bends: control points on a lattice around it, the cubic B-spline field between them, groups of them
that move rigidly, and what unlikely deformations cost. Displacements of control points are in the grid's axes, points
and fields in the implant's frame."""

from torchkcreg.deformation.bspline import cubic_bspline_derivatives, cubic_bspline_weights
from torchkcreg.deformation.clustering import cluster_control_points, control_point_masses
from torchkcreg.deformation.elastic import elastic_energy, elastic_stiffness
from torchkcreg.deformation.ffd import FreeFormDeformation, group_rigid_motions, spline_displacement
from torchkcreg.deformation.grid import ControlPointGrid, default_grid
from torchkcreg.deformation.groups import (
    control_points_from_groups,
    displacement_from_groups,
    group_centers,
    group_moment_gradients,
    group_moments,
    split_motions,
)
from torchkcreg.deformation.penalty import diffusion_penalty, without_rigid
from torchkcreg.deformation.strain import strain_energy

__all__ = [
    "ControlPointGrid",
    "FreeFormDeformation",
    "cluster_control_points",
    "control_point_masses",
    "control_points_from_groups",
    "cubic_bspline_derivatives",
    "cubic_bspline_weights",
    "default_grid",
    "diffusion_penalty",
    "displacement_from_groups",
    "elastic_energy",
    "elastic_stiffness",
    "group_centers",
    "group_moment_gradients",
    "group_moments",
    "group_rigid_motions",
    "spline_displacement",
    "split_motions",
    "strain_energy",
    "without_rigid",
]
