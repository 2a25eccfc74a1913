"""Figures of a registration: overlays on the projections, displacement maps, the course of the optimisation.

Each function returns a matplotlib `Figure` of its own; nothing touches pyplot's state or a screen.
"""

from .displacement import displacement_figure
from .history import history_figure
from .overlay import overlay_figure

__all__ = ["displacement_figure", "history_figure", "overlay_figure"]
