"""What is in the beam and what is seen of it: implants with their poses, deformations and components (`Assembly`), the
scene they make, which renders itself, the measured images, and all that may be changed to make both agree."""

from .assembly import Assembly, followed_points
from .background import with_background
from .data import RegistrationData
from .moves import Moves, screw_path
from .scene import Scene
from .state import Placement, State
from .view import View

__all__ = [
    "Assembly",
    "Moves",
    "Placement",
    "RegistrationData",
    "Scene",
    "State",
    "View",
    "followed_points",
    "screw_path",
    "with_background",
]
