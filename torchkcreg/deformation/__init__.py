"""How an implant bends: what a registration needs of a deformation (`Deformation`, `Motion`), and the models behind it.
A free-form deformation has groups of control points that move rigidly or along elastic modes. Displacements of control
points are in the grid's axes, points and fields in the implant's frame."""

from torchkcreg.deformation.clustering import cluster_control_points, control_point_volumes
from torchkcreg.deformation.deviations import Deviation, Deviations, depth_direction
from torchkcreg.deformation.elasticity import Elasticity
from torchkcreg.deformation.ffd import FreeFormDeformation
from torchkcreg.deformation.finite_elements import FiniteElementDeformation, FiniteElementMotion
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
from torchkcreg.deformation.model import Deformation, Level, Motion, combined
from torchkcreg.deformation.penalty import diffusion_penalty, without_rigid
from torchkcreg.deformation.prior import BendingPrior
from torchkcreg.deformation.reading import deformation_from_dict
from torchkcreg.deformation.rest_shape import bent_cloud, bent_hold, spread_of_rest
from torchkcreg.deformation.spline_field import SplineField
from torchkcreg.deformation.strain import strain_energy

__all__ = [
    "BendingPrior",
    "Deformation",
    "Deviation",
    "Deviations",
    "Elasticity",
    "FiniteElementDeformation",
    "FiniteElementMotion",
    "FreeFormDeformation",
    "GroupMotion",
    "Level",
    "LinearDeformation",
    "LinearMotion",
    "ModalMotion",
    "Motion",
    "RigidDeformation",
    "SplineField",
    "bent_cloud",
    "bent_hold",
    "cluster_control_points",
    "combined",
    "control_point_volumes",
    "control_points_from_groups",
    "deformation_from_dict",
    "depth_direction",
    "diffusion_penalty",
    "group_centers",
    "group_moment_gradients",
    "group_moments",
    "moment_features",
    "motion_coefficients",
    "spread_of_rest",
    "strain_energy",
    "without_rigid",
]
