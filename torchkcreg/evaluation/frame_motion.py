"""Motion of one implant relative to another over a series of frames, with standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.deformation import Deviations
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
    places = [_Place.of(m, cloud) if ok else None for m, ok in zip(moving, usable, strict=True)]
    stands = [_Place.of(r, reference_cloud) if ok else None for r, ok in zip(others, usable, strict=True)]
    first = usable.index(True)
    centre = cloud.points.double().mean(0)
    nan = torch.full((6,), torch.nan, dtype=torch.float64)
    values, deviations, poses = [], [], []
    first_place, first_stand = places[first], stands[first]
    assert first_place is not None
    for number, (place, stand) in enumerate(zip(places, stands, strict=True)):
        if place is None:
            values.append(nan)
            deviations.append(nan)
            poses.append(torch.full((4, 4), torch.nan, dtype=torch.float64))
            continue
        start, pose = _relative(first_place.pose, first_stand), _relative(place.pose, stand)
        value = _numbers(start, pose, centre)
        squares = torch.zeros_like(value)
        if number != first:
            for changed in place.poses():
                squares += (_numbers(start, _relative(changed, stand), centre) - value).square()
            for changed in first_place.poses():
                squares += (_numbers(_relative(changed, first_stand), pose, centre) - value).square()
            if stand is not None and first_stand is not None:
                for changed in stand.poses():
                    squares += (_numbers(start, invert_rigid(changed) @ place.pose, centre) - value).square()
                for changed in first_stand.poses():
                    moved = invert_rigid(changed) @ first_place.pose
                    squares += (_numbers(moved, pose, centre) - value).square()
        involved = [place, first_place, stand, first_stand]
        unknown = any(p is not None and p.deviations is None for p in involved)
        values.append(value)
        deviations.append(nan if unknown else squares.sqrt())
        poses.append(pose)
    return FrameMotion(torch.stack(values), torch.stack(deviations), torch.stack(poses))


@dataclass(frozen=True, eq=False)
class _Place:
    """Nodes of an implant in a frame, the rigid pose that fits them best, and their expected errors."""

    nodes: Tensor
    warped: Tensor
    pose: Tensor
    deviations: Deviations | None

    @classmethod
    def of(cls, implant: RegisteredImplant | None, cloud: ImplantPointCloud | None) -> _Place | None:
        if implant is None or cloud is None:
            return None
        nodes = cloud.points.double() if implant.deviations is None else implant.deviations.points
        warped = implant.warp(nodes)
        return cls(nodes, warped, fit_rigid(nodes, warped), implant.deviations)

    def poses(self) -> list[Tensor]:
        """The pose with each of the expected errors."""
        fields = () if self.deviations is None else self.deviations.fields
        return [fit_rigid(self.nodes, self.warped + field) for field in fields]


def _relative(pose: Tensor, stand: _Place | None) -> Tensor:
    return pose if stand is None else invert_rigid(stand.pose) @ pose


def _numbers(start: Tensor, pose: Tensor, centre: Tensor) -> Tensor:
    """Rotation vector, degrees, and translation of the centre, mm, from one pose (4, 4) to another, (6,)."""
    turned = torch.rad2deg(vector_from_rotation(pose[:3, :3] @ start[:3, :3].T))
    before, after = (transform_points(p, centre[None])[0] for p in (start, pose))
    return torch.cat([turned, after - before])
