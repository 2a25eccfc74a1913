"""Search for the pose of an implant from nowhere, by its outline on coarse images."""

from .candidates import Body, Candidates
from .coarse_views import CoarseViews
from .pose_search import PoseSearch
from .region import aimed_at, spread_views

__all__ = ["Body", "Candidates", "CoarseViews", "PoseSearch", "aimed_at", "spread_views"]
