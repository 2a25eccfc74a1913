"""What is in the beam and what is seen of it: implants with their poses, deformations and components (`Assembly`), the
scene they make, which renders itself, the measured images, and all that may be changed to make both agree.
"""

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
