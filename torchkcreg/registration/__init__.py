"""Registration: the objective, its optimisers and the coarse-to-fine loop."""

from .background import with_background
from .callbacks import Callback, ProgressBar
from .config import RegistrationConfig, Stage, preset_stages
from .data import RegistrationData
from .model import StageModel
from .objective import StageObjective, stage_objective
from .register import build_scene, register
from .result import RegistrationResult
from .scene import Scene
from .screws import find_screws
from .trainer import Trainer

__all__ = [
    "Callback",
    "ProgressBar",
    "RegistrationConfig",
    "RegistrationData",
    "RegistrationResult",
    "Scene",
    "Stage",
    "StageModel",
    "StageObjective",
    "Trainer",
    "build_scene",
    "find_screws",
    "preset_stages",
    "register",
    "stage_objective",
    "with_background",
]
