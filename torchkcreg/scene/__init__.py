"""Implants (`Assembly`), the scene that renders them, the measured images, and the parameters of a stage (`Moves`)."""

from .assembly import Assembly, followed_motion
from .background import with_background
from .data import RegistrationData
from .moves import Moves, ScrewPaths
from .saved import scene_from_dict, scene_to_dict
from .scene import Scene
from .state import Placement, State
from .view import View
from .view_motions import ViewMotions, ViewMotionSteps

__all__ = [
    "Assembly",
    "Moves",
    "Placement",
    "RegistrationData",
    "Scene",
    "ScrewPaths",
    "State",
    "View",
    "ViewMotionSteps",
    "ViewMotions",
    "followed_motion",
    "scene_from_dict",
    "scene_to_dict",
    "with_background",
]
