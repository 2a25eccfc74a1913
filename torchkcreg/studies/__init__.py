"""Studies of many registrations on simulated cases: one runner that keeps what is finished, tables and figures."""

from .simulated import simulated
from .studies import STUDIES, Study, StudyOptions, run_study
from .sweeps import sweep
from .wrong_geometry import wrong_geometry

__all__ = ["STUDIES", "Study", "StudyOptions", "run_study", "simulated", "sweep", "wrong_geometry"]
