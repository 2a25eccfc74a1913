"""Figures and the HTML report of registrations, reconstructions, plans of views and studies.

Each figure function returns a new matplotlib `Figure`. pyplot's state and the screen are not used.
"""

from .case import case_figure
from .comparison import comparison_figure, frames_figure, healing_figure
from .displacement_map import displacement_figure, series_figure
from .errors import error_map_figure, histogram_figure
from .geometry import geometry_figure
from .history import history_figure
from .load import load_figure
from .overlay import overlay_figure, overlay_layers
from .page import Page, Row, page_html, png_of
from .plan import plan_figure
from .reconstruction import beam_figure, reconstruction_figure
from .registration import draw_registration, draw_start, registered_layers
from .studies import capture_figure

__all__ = [
    "Page",
    "Row",
    "beam_figure",
    "capture_figure",
    "case_figure",
    "comparison_figure",
    "displacement_figure",
    "draw_registration",
    "draw_start",
    "error_map_figure",
    "frames_figure",
    "geometry_figure",
    "healing_figure",
    "histogram_figure",
    "history_figure",
    "load_figure",
    "overlay_figure",
    "overlay_layers",
    "page_html",
    "plan_figure",
    "png_of",
    "reconstruction_figure",
    "registered_layers",
    "series_figure",
]
