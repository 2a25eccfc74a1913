"""Figures of a registration: overlays, displacement and error maps, histograms, the course of the optimisation.

Each function returns a matplotlib `Figure` of its own; nothing touches pyplot's state or a screen.
"""

from .beam import beam_figure
from .capture import capture_figure
from .case import case_figure
from .comparison import comparison_figure
from .displacement import displacement_figure
from .errors import error_map_figure, histogram_figure
from .geometry import geometry_figure
from .history import history_figure
from .load import load_figure
from .overlay import overlay_figure, overlay_layers
from .page import Page, Row, page_html, png_of
from .plan import plan_figure
from .reconstruction import reconstruction_figure
from .series import series_figure

__all__ = [
    "Page",
    "Row",
    "beam_figure",
    "capture_figure",
    "case_figure",
    "comparison_figure",
    "displacement_figure",
    "error_map_figure",
    "geometry_figure",
    "histogram_figure",
    "history_figure",
    "load_figure",
    "overlay_figure",
    "overlay_layers",
    "page_html",
    "plan_figure",
    "png_of",
    "reconstruction_figure",
    "series_figure",
]
