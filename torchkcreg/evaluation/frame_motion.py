"""Motion of one implant relative to another over a series of frames, with standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import fit_rigid, invert_rigid, transform_points, vector_from_rotation
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.registration import RegisteredImplant

FRAME_COLUMNS = (*(f"rotation_{axis}_deg" for axis in "xyz"), *(f"translation_{axis}_mm" for axis in "xyz"))


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """Motion of an implant since the first of several frames.

    Attributes:
        values: Rotation vector, degrees, and translation of the implant's centre, mm, in each frame, (F, 6), in the
            axes of the reference: the other implant's frame, or the world. NaN for frames without a registration.
        std: Their standard deviations (F, 6); NaN if unknown.
        poses: Pose (F, 4, 4) of the implant in the reference.
    """

    values: Tensor
    std: Tensor
    poses: Tensor

    @property
    def angles_deg(self) -> Tensor:
        """Angle of the rotation in each frame, (F,), degrees."""
        return self.values[:, :3].norm(dim=-1)


@torch.no_grad()
def frame_motion(
    moving: Sequence[RegisteredImplant | None],
    cloud: ImplantPointCloud,
    reference: Sequence[RegisteredImplant | None] | None = None,
    reference_cloud: ImplantPointCloud | None = None,
) -> FrameMotion:
    """Motion of an implant in frames that were registered one by one, since the first frame.

    Bent implants are represented by the rigid motion that fits their nodes best. Standard deviations combine the
    expected errors of both frames and both implants, assumed independent.

    Args:
        moving: The implant as registered in each frame; None where there is none.
        cloud: The undeformed implant.
        reference: Another implant in the same frames, relative to which the first one moves; the world if None.
        reference_cloud: That implant, undeformed.

    Raises:
        ValueError: If no frame has both, or the reference comes without its nodes.
    """
    if (reference is None) != (reference_cloud is None):
        raise ValueError("a reference implant needs its nodes, and nodes need their implant")
    others: Sequence[RegisteredImplant | None] = [None] * len(moving) if reference is None else reference
    usable = [m is not None and (reference is None or r is not None) for m, r in zip(moving, others, strict=True)]
    if not any(usable):
        raise ValueError("no frame has a registration of the implant")
    first = usable.index(True)
    places = [_Place.of(m, cloud) if ok else None for m, ok in zip(moving, usable, strict=True)]
    stands = [_Place.of(r, reference_cloud) if ok else None for r, ok in zip(others, usable, strict=True)]
    centre = cloud.points.double().mean(0)
    values = torch.full((len(usable), 6), torch.nan, dtype=torch.float64)
    std = values.clone()
    poses = torch.full((len(usable), 4, 4), torch.nan, dtype=torch.float64)
    start = start_stand = None
    for number, (place, stand) in enumerate(zip(places, stands, strict=True)):
        if place is None or stand is None:
            continue
        if start is None or start_stand is None:
            start, start_stand = place, stand
        involved = (start, start_stand, place, stand)
        values[number] = _numbers([p.pose for p in involved], centre)
        poses[number] = invert_rigid(stand.pose) @ place.pose
        squares = torch.zeros_like(values[number])
        if number != first:
            for role, changing in enumerate(involved):
                for changed in changing.poses:
                    now = [changed if n == role else p.pose for n, p in enumerate(involved)]
                    squares += (_numbers(now, centre) - values[number]).square()
        if all(p.known for p in involved):
            std[number] = squares.sqrt()
    return FrameMotion(values, std, poses)


@dataclass(frozen=True, eq=False)
class _Place:
    """The rigid pose that fits an implant best in a frame; the pose with each of its expected errors, if known."""

    pose: Tensor
    poses: tuple[Tensor, ...] = ()
    known: bool = True

    @classmethod
    def of(cls, implant: RegisteredImplant | None, cloud: ImplantPointCloud | None) -> _Place:
        if implant is None or cloud is None:
            return cls(torch.eye(4, dtype=torch.float64))  # the world, which stands still
        known = implant.deviations
        nodes = cloud.points.double() if known is None else known.points
        warped = implant.warp(nodes)
        poses = () if known is None else tuple(fit_rigid(nodes, warped + field) for field in known.fields)
        return cls(fit_rigid(nodes, warped), poses, known is not None)


def _numbers(places: Sequence[Tensor], centre: Tensor) -> Tensor:
    """Rotation vector, degrees, and translation of the centre, mm, (6,): from a pose to another, each in its stand.

    Args:
        places: First pose and its stand, second pose and its stand, (4, 4) each.
        centre: Point (3,) of the implant.
    """
    start, start_stand, pose, stand = places
    before, after = invert_rigid(start_stand) @ start, invert_rigid(stand) @ pose
    turned = torch.rad2deg(vector_from_rotation(after[:3, :3] @ before[:3, :3].T))
    moved = transform_points(after, centre[None]) - transform_points(before, centre[None])
    return torch.cat([turned, moved[0]])
