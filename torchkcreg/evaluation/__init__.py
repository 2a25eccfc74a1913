"""How good a registration is, and what it measured: errors at reference points, displacement maps."""

from .displacement import DisplacementMap, displacement_map
from .points import PointMetrics, bb_rmse, evaluate, evaluate_points, point_errors

__all__ = [
    "DisplacementMap",
    "PointMetrics",
    "bb_rmse",
    "displacement_map",
    "evaluate",
    "evaluate_points",
    "point_errors",
]
