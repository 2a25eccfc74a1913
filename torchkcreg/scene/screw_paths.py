"""Path lengths through screws that might be in an implant's holes."""

from __future__ import annotations

import torch
from torch import Tensor

from torchkcreg.implant import Screw

from .assembly import Assembly
from .view import View

_PITCH_MM = 0.5


class ScrewPaths:
    """Path lengths (V, rows, cols) in mm of screws where an assembly, as it is, would have them.

    Args:
        assembly: It must not move meanwhile.
        view: Of it.
    """

    def __init__(self, assembly: Assembly, view: View) -> None:
        self.assembly, self.view = assembly, view
        self._motions: dict[tuple[float, float, float], Tensor] = {}

    @torch.no_grad()
    def __call__(self, screw: Screw) -> Tensor:
        """Of a screw, given in the implant's frame."""
        pose = self.assembly.implant_to_world
        if screw.start not in self._motions:
            self._motions[screw.start] = pose @ self.assembly.motion_at(pose.new_tensor(screw.start))
        return self.view.cloud_path_lengths(screw.stretched_cloud(_PITCH_MM), self._motions[screw.start])
