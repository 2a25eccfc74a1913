"""Deformation models of an implant, and the interface that a registration uses (`Deformation`, `Motion`).

There are rigid, linear, finite-element and free-form deformations. In a free-form deformation, groups of control points
move rigidly or along elastic modes. Displacements of control points are given in the grid's axes, points and
displacement fields in the implant's frame.
"""

from .deformation import Deformation, Level, Motion, combined
from .deviations import Deviation, Deviations, depth_direction
from .elasticity import Elasticity, strain_energy
from .ffd import FreeFormDeformation
from .finite_elements import FiniteElementDeformation, FiniteElementMotion, bent_cloud, bent_hold, spread_of_rest
from .group_motion import GroupMotion
from .groups import (
    cluster_control_points,
    control_point_volumes,
    control_points_from_groups,
    group_centers,
    group_moment_gradients,
    group_moments,
    moment_features,
    motion_coefficients,
)
from .linear import LinearDeformation, LinearMotion, RigidDeformation
from .modal_motion import ModalMotion
from .penalty import BendingPrior, diffusion_penalty, without_rigid
from .reading import deformation_from_dict
from .spline_field import SplineField

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
