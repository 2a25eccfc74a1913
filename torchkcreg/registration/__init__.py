"""Registration: objective, coarse-to-fine stages, result with expected errors, and view planning."""

from torchkcreg.callbacks import Callback
from torchkcreg.optimization import OPTIMIZERS, Optimizer, Progress
from torchkcreg.scene import RegistrationData, Scene, with_background

from .config import RegistrationConfig, Stage, preset_stages
from .implant import Implant
from .objective import Objective
from .planning import PlannedSet, ViewInformation, view_information
from .register import build_scene, register
from .registered_implant import RegisteredImplant
from .result import RegistrationResult
from .screw_search import find_screws
from .stage import StageRun, Terms, similarities
from .steps import AFTER, BEFORE
from .trainer import ProgressBar, StageRecord, Trainer, TrainerState

__all__ = [
    "AFTER",
    "BEFORE",
    "OPTIMIZERS",
    "Callback",
    "Implant",
    "Objective",
    "Optimizer",
    "PlannedSet",
    "Progress",
    "ProgressBar",
    "RegisteredImplant",
    "RegistrationConfig",
    "RegistrationData",
    "RegistrationResult",
    "Scene",
    "Stage",
    "StageRecord",
    "StageRun",
    "Terms",
    "Trainer",
    "TrainerState",
    "ViewInformation",
    "build_scene",
    "find_screws",
    "preset_stages",
    "register",
    "similarities",
    "view_information",
    "with_background",
]
