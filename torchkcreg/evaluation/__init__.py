"""Evaluation of registrations.

Errors at reference points and of the implant's shape, displacement maps, motion between fracture fragments, metal beads
in views and volumes, and bone mineral in reconstructed volumes.
"""

from torchkcreg.geometry import distance_to

from .alignment import align_to_surface, frame_changes, rigid_coherent_point_drift
from .bead_shadows import bead_shadows, track_beads
from .beads import Beads, find_beads
from .callus import CallusStiffness, GapLoad, callus_stiffness
from .densitometry import MineralContent, mineral_content
from .displacement_map import DisplacementMap, displacement_map
from .distances import nearest_node_distances, nearest_node_floor, surface_distances
from .fragments import BONE_PLACES, Fragments, bone_places, fracture_plane, fragments_of
from .frame_motion import FRAME_COLUMNS, FrameMotion, frame_motion
from .point_errors import PointMetrics, bb_rmse, evaluate, evaluate_points, point_errors
from .regions import RegionStatistics, cylinder_region, region_statistics
from .relative_motion import AXES, RelativeMotion, relative_motion
from .shape import ShapeEvaluation, evaluate_shape
from .statistics import DistanceStatistics, distance_statistics, full_width_at_half_maximum

__all__ = [
    "AXES",
    "BONE_PLACES",
    "FRAME_COLUMNS",
    "Beads",
    "CallusStiffness",
    "DisplacementMap",
    "DistanceStatistics",
    "Fragments",
    "FrameMotion",
    "GapLoad",
    "MineralContent",
    "PointMetrics",
    "RegionStatistics",
    "RelativeMotion",
    "ShapeEvaluation",
    "align_to_surface",
    "bb_rmse",
    "bead_shadows",
    "bone_places",
    "callus_stiffness",
    "cylinder_region",
    "displacement_map",
    "distance_statistics",
    "distance_to",
    "evaluate",
    "evaluate_points",
    "evaluate_shape",
    "find_beads",
    "fracture_plane",
    "fragments_of",
    "frame_changes",
    "frame_motion",
    "full_width_at_half_maximum",
    "mineral_content",
    "nearest_node_distances",
    "nearest_node_floor",
    "point_errors",
    "region_statistics",
    "relative_motion",
    "rigid_coherent_point_drift",
    "surface_distances",
    "track_beads",
]
