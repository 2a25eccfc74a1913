"""Cone-beam geometry: projection matrices, the multisource scanner, rigid motions and voxel grids.

World coordinates are right-handed, in mm, with z along the gantry's rotation axis. A view is one 3 x 4 projection
matrix; its source, rays and pixel positions are derived from that.
"""

from .calibration import Calibration, calibrate
from .circular import circular_geometry, matrices_from_frames
from .cone_beam import ConeBeamGeometry
from .frames import DetectorFrames, gantry_about_z
from .multisource import MultisourceScanner
from .packages import from_astra, from_leap, from_leap_cone, from_tigre, to_astra, to_leap
from .rotation_grid import rotation_grid
from .se3 import (
    across,
    fit_rigid,
    invert_rigid,
    principal_axes,
    rigid_matrix,
    rotation_about,
    rotation_from_vector,
    transform_points,
    vector_from_rotation,
)
from .two_level_grid import TwoLevelGrid
from .volume_grid import VolumeGrid, distance_to

__all__ = [
    "Calibration",
    "ConeBeamGeometry",
    "DetectorFrames",
    "MultisourceScanner",
    "TwoLevelGrid",
    "VolumeGrid",
    "across",
    "calibrate",
    "circular_geometry",
    "distance_to",
    "fit_rigid",
    "from_astra",
    "from_leap",
    "from_leap_cone",
    "from_tigre",
    "gantry_about_z",
    "invert_rigid",
    "matrices_from_frames",
    "principal_axes",
    "rigid_matrix",
    "rotation_about",
    "rotation_from_vector",
    "rotation_grid",
    "to_astra",
    "to_leap",
    "transform_points",
    "vector_from_rotation",
]
