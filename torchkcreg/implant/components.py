"""Components of an assembly: rigid parts that are fixed to an implant, such as the screws of a plate."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .point_cloud import ImplantPointCloud
from .screws import Screw


class Component(nn.Module):
    """A rigid part that is fixed to an implant near one of its ends, like a screw near its head.

    Args:
        name: Its name in results.
        cloud: Its nodes, in the implant's frame.
        material: Name of its material.
        head: (3,) point in the implant's frame, mm. The component moves with the implant around this point.
        axis: (3,) direction from the head to the tip, of any length.
        screw: Description of the screw, if the component is one.

    Raises:
        ValueError: If shapes do not fit or the axis is zero.

    >>> screw = Component.screw("s1", (0, 0, 0), (0, 20, 0), radius=1.75, pitch=0.5)
    >>> screw.axis.tolist(), round(screw.cloud.volume, 2)
    ([0.0, 1.0, 0.0], 192.42)
    """

    cloud: ImplantPointCloud
    as_screw: Screw | None
    head: Tensor
    axis: Tensor

    def __init__(
        self,
        name: str,
        cloud: ImplantPointCloud,
        material: str,
        head: Tensor,
        axis: Tensor,
        *,
        screw: Screw | None = None,
    ) -> None:
        super().__init__()
        if head.shape != (3,) or axis.shape != (3,):
            raise ValueError(f"head and axis must have shape (3,), got {tuple(head.shape)} and {tuple(axis.shape)}")
        if not bool(axis.norm() > 0):
            raise ValueError(f"axis must not be zero, got {axis.tolist()}")
        self.name, self.material, self.cloud, self.as_screw = name, material, cloud, screw
        self.register_buffer("head", head.clone())
        self.register_buffer("axis", axis / axis.norm())

    @classmethod
    def of(cls, screw: Screw, *, pitch: float = 0.25, dtype: torch.dtype = torch.float32) -> Component:
        """Component of a screw: a solid cylinder from the centre of its head to its tip."""
        start, end = (torch.tensor(point, dtype=dtype, device="cpu") for point in (screw.start, screw.end))
        return cls(screw.name, screw.cloud(pitch, dtype=dtype), screw.material, start, end - start, screw=screw)

    @classmethod
    def screw(
        cls,
        name: str,
        head: Sequence[float],
        tip: Sequence[float],
        radius: float,
        *,
        material: str = "steel",
        pitch: float = 0.25,
        dtype: torch.dtype = torch.float32,
    ) -> Component:
        """Component of the screw between two points, mm; see `Screw`."""
        return cls.of(Screw(_point(head), _point(tip), radius, material, name), pitch=pitch, dtype=dtype)


def _point(coordinates: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = coordinates
    return x, y, z
