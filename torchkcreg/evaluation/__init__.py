"""How good a registration is, and what it measured: errors at reference points and of the shape, displacement maps."""

from .alignment import align_to_surface, rigid_coherent_point_drift
from .beads import Beads, find_beads
from .displacement import DisplacementMap, displacement_map
from .distances import nearest_node_distances, nearest_node_floor, surface_distances
from .points import PointMetrics, bb_rmse, evaluate, evaluate_points, point_errors
from .regions import RegionStatistics, cylinder_region, distance_to, region_statistics
from .shape import ShapeEvaluation, evaluate_shape
from .statistics import DistanceStatistics, distance_statistics, full_width_at_half_maximum

__all__ = [
    "Beads",
    "DisplacementMap",
    "DistanceStatistics",
    "PointMetrics",
    "RegionStatistics",
    "ShapeEvaluation",
    "align_to_surface",
    "bb_rmse",
    "cylinder_region",
    "displacement_map",
    "distance_statistics",
    "distance_to",
    "evaluate",
    "evaluate_points",
    "evaluate_shape",
    "find_beads",
    "full_width_at_half_maximum",
    "nearest_node_distances",
    "nearest_node_floor",
    "point_errors",
    "region_statistics",
    "rigid_coherent_point_drift",
    "surface_distances",
]
