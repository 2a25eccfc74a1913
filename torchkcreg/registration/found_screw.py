"""A screw that was found, and how its image changes with its length and radius."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchkcreg.geometry import across, rotation_about, transform_points
from torchkcreg.implant import Component, ImplantPointCloud, cylinder_cloud

_LENGTH_STEP_MM = 0.5
_RADIUS_STEP_MM = 0.05
_RADIUS_UNIT_MM = 0.2  # a unit step in radius changes an image about as much as one in length
_COMMON_LENGTH_MM, _COMMON_RADIUS_MM = 24.0, 2.0  # about those of most screws
_LARGEST_STEPS = (4.0, 2.0)  # of length and radius in one stage, in units


@dataclass(frozen=True)
class FoundScrew:
    """A cylinder in the implant's frame, mm.

    Attributes:
        start: Centre (x, y, z) of its head's end, in the hole's opening.
        end: Its tip.
        radius: Of its shaft.
        material: Name of its material.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float
    material: str

    @property
    def length(self) -> float:
        """From start to end, mm."""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    def with_length(self, length: float) -> FoundScrew:
        """The screw with its tip elsewhere along its axis."""
        axis = np.subtract(self.end, self.start) / self.length
        x, y, z = np.add(self.start, length * axis).tolist()
        return replace(self, end=(x, y, z))

    def with_radius(self, radius: float) -> FoundScrew:
        """The screw, thicker or thinner."""
        return replace(self, radius=radius)

    def shifted_to(self, start: tuple[float, float, float]) -> FoundScrew:
        """The screw, moved as a whole."""
        x, y, z = (np.array(self.end) + start - self.start).tolist()
        return replace(self, start=start, end=(x, y, z))

    def same_side(self, other: FoundScrew) -> bool:
        """Whether two screws point the same way."""
        return float(np.subtract(self.end, self.start) @ np.subtract(other.end, other.start)) > 0

    def overlaps(self, other: FoundScrew) -> bool:
        """Whether two screws share a hole or, side by side in a combination hole, run into each other."""
        way = np.subtract(self.start, other.start)
        axis = np.subtract(other.end, other.start) / other.length
        return float(np.linalg.norm(way - (way @ axis) * axis)) < self.radius + other.radius

    def moved(self, rotation: Tensor, shift: Tensor) -> FoundScrew:
        """The screw, turned about its start by a rotation vector (3,) and then shifted by a vector (3,), mm."""
        ends = torch.tensor([self.start, self.end], dtype=torch.float64)
        turned = transform_points(rotation_about(ends[0], rotation.double()), ends) + shift
        start, end = ((float(x), float(y), float(z)) for x, y, z in turned)
        return replace(self, start=start, end=end)

    def cloud(self, pitch: float) -> ImplantPointCloud:
        """Nodes of the screw, those of a common one stretched: in no time, but on a lattice of its own."""
        common = _common_cloud(pitch)
        start, end = (torch.tensor(p, dtype=torch.float64) for p in (self.start, self.end))
        axis = (end - start) / (end - start).norm()
        thicker, longer = self.radius / _COMMON_RADIUS_MM, self.length / _COMMON_LENGTH_MM
        stretch = torch.tensor([[thicker], [thicker], [longer]]) * torch.cat([across(axis), axis[None]])
        masses = common.masses * (thicker**2 * longer)
        return ImplantPointCloud(start + common.points @ stretch, masses, common.cell @ stretch)

    def component(self, name: str, pitch: float) -> Component:
        """The screw's nodes, ``pitch`` mm apart."""
        return Component.screw(name, self.start, self.end, self.radius, material=self.material, pitch=pitch)


@functools.cache
def _common_cloud(pitch: float) -> ImplantPointCloud:
    tip = (0.0, 0.0, _COMMON_LENGTH_MM)
    return cylinder_cloud((0.0, 0.0, 0.0), tip, _COMMON_RADIUS_MM, pitch, dtype=torch.float64)


class ScrewShapes:
    """Lengths, then radii of found screws as parameters, linear in the images.

    Args:
        screws: The screws.
        render: Path lengths (V, rows, cols) of a screw where it now is.
    """

    def __init__(self, screws: Sequence[FoundScrew], render: Callable[[FoundScrew], Tensor]) -> None:
        self.screws = list(screws)
        longer, thicker = _LENGTH_STEP_MM, _RADIUS_STEP_MM
        slopes = [
            (render(s.with_length(s.length + longer)) - render(s.with_length(s.length - longer))) / (2 * longer)
            for s in self.screws
        ]
        slopes += [
            (render(s.with_radius(s.radius + thicker)) - render(s.with_radius(s.radius - thicker)))
            * (_RADIUS_UNIT_MM / (2 * thicker))
            for s in self.screws
        ]
        materials = 2 * [s.material for s in self.screws]
        self.slopes = {
            name: torch.stack([slope * (name == other) for slope, other in zip(slopes, materials, strict=True)])
            for name in dict.fromkeys(materials)
        }

    @property
    def num_parameters(self) -> int:
        """A length and a radius a screw."""
        return 2 * len(self.screws)

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, S) within what the linear images hold for."""
        length, radius = _LARGEST_STEPS
        lengths, radii = steps.chunk(2, dim=-1)
        return torch.cat([lengths.clamp(-length, length), radii.clamp(-radius, radius)], dim=-1)

    def __call__(self, steps: Tensor) -> dict[str, Tensor]:
        """What steps (K, S) add to the path lengths of each material, shape (K, V, rows, cols)."""
        return {name: torch.tensordot(steps.to(slopes), slopes, dims=1) for name, slopes in self.slopes.items()}

    def stepped(self, steps: Tensor) -> list[FoundScrew]:
        """The screws after steps (S,)."""
        return [
            s.with_length(s.length + longer).with_radius(s.radius + _RADIUS_UNIT_MM * thicker)
            for s, (longer, thicker) in zip(self.screws, steps.reshape(2, -1).T.tolist(), strict=True)
        ]
