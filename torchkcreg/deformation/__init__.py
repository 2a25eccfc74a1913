"""How an implant bends: what a registration needs of a deformation (`Deformation`, `Motion`), and the models behind it.
A free-form deformation has control points on a lattice around the implant, the cubic B-spline field between them, and
groups of them that move rigidly or along elastic modes. Displacements of control points are in the grid's axes, points
and fields in the implant's frame."""

from torchkcreg.deformation.bspline import cubic_bspline_derivatives, cubic_bspline_weights
from torchkcreg.deformation.clustering import cluster_control_points, control_point_volumes
from torchkcreg.deformation.elasticity import Elasticity
from torchkcreg.deformation.ffd import FreeFormDeformation
from torchkcreg.deformation.grid import ControlPointGrid, default_grid
from torchkcreg.deformation.group_motion import GroupMotion
from torchkcreg.deformation.groups import (
    control_points_from_groups,
    group_centers,
    group_moment_gradients,
    group_moments,
    moment_features,
    motion_coefficients,
)
from torchkcreg.deformation.linear import LinearDeformation, LinearMotion, RigidDeformation
from torchkcreg.deformation.modal_motion import ModalMotion
from torchkcreg.deformation.model import Deformation, Level, Motion
from torchkcreg.deformation.penalty import diffusion_penalty, without_rigid
from torchkcreg.deformation.prior import BendingPrior
from torchkcreg.deformation.spline_field import SplineField, group_rigid_motions, spline_displacement
from torchkcreg.deformation.strain import strain_energy

__all__ = [
    "BendingPrior",
    "ControlPointGrid",
    "Deformation",
    "Elasticity",
    "FreeFormDeformation",
    "GroupMotion",
    "Level",
    "LinearDeformation",
    "LinearMotion",
    "ModalMotion",
    "Motion",
    "RigidDeformation",
    "SplineField",
    "cluster_control_points",
    "control_point_volumes",
    "control_points_from_groups",
    "cubic_bspline_derivatives",
    "cubic_bspline_weights",
    "default_grid",
    "diffusion_penalty",
    "group_centers",
    "group_moment_gradients",
    "group_moments",
    "group_rigid_motions",
    "moment_features",
    "motion_coefficients",
    "spline_displacement",
    "strain_energy",
    "without_rigid",
]
