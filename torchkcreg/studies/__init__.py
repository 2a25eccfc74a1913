"""Studies of many registrations on simulated cases, run in parallel and resumable, with tables and figures."""

from .capture import CaptureStudy, CaptureTrial, capture_study
from .catalogue import STUDIES, Study, StudyOptions, run_study
from .simulated import simulated, wrong_geometry
from .sweeps import sweep

__all__ = [
    "STUDIES",
    "CaptureStudy",
    "CaptureTrial",
    "Study",
    "StudyOptions",
    "capture_study",
    "run_study",
    "simulated",
    "sweep",
    "wrong_geometry",
]
