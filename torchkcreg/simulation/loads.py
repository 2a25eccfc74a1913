"""Loads on a plate (bending, S-bending, torsion, misalignment) as motion of a rod with rigid cross sections."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import fit_rigid, rigid_matrix

STEP_MM = 0.5


@dataclass(frozen=True)
class Load:
    """Bending, torsion and displacement of a plate along z. All angles are in degrees and zero by default.

    The curvature of bending and torsion is one smooth hump between the inner screws, since the bone carries the load
    everywhere else. The S-bend's curvature is one hump up and one down, which leaves the ends parallel but offset. The
    rigid part of the bending motion is removed: on average the plate moves by the misalignment alone.

    Attributes:
        bend_deg: Angle between the two ends about x: the plate bends in the direction of its thickness y.
        lateral_deg: Angle between the two ends about y: it bends in its plane.
        torsion_deg: Angle between the two ends about z.
        s_bend_deg: Angle of each of the S-bend's two opposite bends about x.
        zone_mm: The humps lie within this distance of `center_mm` along z: half the distance of the inner screws.
        center_mm: Height z of the middle of the bent stretch.
        length_mm: Length of the plate, centred on z = 0.
        rotation_deg: Rotation vector of the misalignment of the whole plate, degrees.
        translation_mm: Translation of the misalignment, mm.

    Raises:
        ValueError: If the zone is not positive or longer than the plate, or does not contain z = 0.

    >>> bent = Load(bend_deg=3.0).motion()(torch.tensor([[0.0, 0.0, -94.0], [0.0, 0.0, 0.0], [0.0, 0.0, 94.0]]))
    >>> [round(y, 2) for y in bent[:, 1].tolist()]
    [-1.2, 1.05, -1.2]
    """

    bend_deg: float = 0.0
    lateral_deg: float = 0.0
    torsion_deg: float = 0.0
    s_bend_deg: float = 0.0
    zone_mm: float = 27.0
    center_mm: float = 0.0
    length_mm: float = 188.0
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not 0 < 2 * self.zone_mm <= self.length_mm:
            raise ValueError(f"zone_mm must lie between 0 and half of {self.length_mm} mm, got {self.zone_mm}")
        if not abs(self.center_mm) < self.zone_mm:
            raise ValueError(f"center_mm must lie within {self.zone_mm} mm of 0, got {self.center_mm}")

    def motion(self) -> RodMotion:
        """Motion of points of the undeformed frame under this load."""

        def curvature(z: Tensor) -> Tensor:
            relative = ((z - self.center_mm) / self.zone_mm).clamp(-1, 1)
            hump = (1 + torch.cos(math.pi * relative)) / (2 * self.zone_mm)  # integral one
            wave = -math.pi / (2 * self.zone_mm) * torch.sin(math.pi * relative)  # integral 1, then -1
            bend, lateral, torsion, s_bend = (
                math.radians(angle) for angle in (self.bend_deg, self.lateral_deg, self.torsion_deg, self.s_bend_deg)
            )
            return torch.stack([bend * hump + s_bend * wave, lateral * hump, torsion * hump], dim=-1)

        rotation = torch.deg2rad(torch.tensor(self.rotation_deg, dtype=torch.float64))
        misalignment = rigid_matrix(rotation, torch.tensor(self.translation_mm, dtype=torch.float64))
        stretch = (self.center_mm - self.zone_mm, self.center_mm + self.zone_mm)
        plate = torch.cartesian_prod(
            *(torch.linspace(-x, x, n).double() for x, n in zip(self._half_size(), (2, 2, 65)))
        )
        common = fit_rigid(plate, RodMotion(curvature, stretch)(plate))
        return RodMotion(curvature, stretch, misalignment @ torch.linalg.inv(common))

    def _half_size(self) -> tuple[float, float, float]:
        """Half the plate's size in mm. Width and thickness matter little: they only make torsion visible to the fit."""
        return 7.0, 2.0, self.length_mm / 2


class RodMotion:
    """Motion of a rod along z whose cross sections stay flat, rigid and at right angles to its axis (Kirchhoff).

    The axis keeps its length; the frame `(R, c)` of the cross section at z solves `dR/dz = R [k(z)]x`, `dc/dz = R e_z`,
    with `R = I, c = 0` at z = 0, and a point goes from (x, y, z) to `R(z) (x, y, 0) + c(z)`, then through a rigid
    motion of the whole. The curvature is constant within steps of 0.5 mm, for which the solution is exact. Outside
    the bent stretch the motion continues rigidly. Calling it maps points of any shape (..., 3), in float64.

    Args:
        curvature: Rotation of the cross section about its x, y, z axes per mm: function of z `(n,)` to `(n, 3)`, 1/mm.
        stretch: Range (low, high) of z in mm in which the rod is bent; contains z = 0.
        afterwards: Rigid motion (4, 4) applied after the bending; none by default.

    Raises:
        ValueError: If the stretch does not contain zero.
    """

    def __init__(
        self,
        curvature: Callable[[Tensor], Tensor],
        stretch: tuple[float, float],
        afterwards: Tensor | None = None,
    ) -> None:
        low, high = stretch
        if not low < 0 < high:
            raise ValueError(f"stretch must contain z = 0, got {low} to {high}")
        before, after = (math.ceil(length / STEP_MM) for length in (-low, high))
        knots = torch.cat(
            [
                torch.linspace(low, 0, before + 1, dtype=torch.float64)[:-1],
                torch.linspace(0, high, after + 1, dtype=torch.float64),
            ]
        )
        rates = curvature((knots[:-1] + knots[1:]) / 2).double()
        frames = [torch.eye(4, dtype=torch.float64)]
        for step in _rod_steps(rates, knots.diff()):
            frames.append(frames[-1] @ step)
        chain = torch.stack(frames)
        chain = torch.linalg.inv(chain[before]) @ chain
        if afterwards is not None:
            chain = afterwards.double() @ chain
        straight = rates.new_zeros(1, 3)
        # the rod continues straight beyond both ends
        self._knots = knots
        self._frames = torch.cat([chain[:1], chain])
        self._rates = torch.cat([straight, rates, straight])
        self._starts = torch.cat([knots[:1], knots])

    def __call__(self, points: Tensor | Sequence[Sequence[float]]) -> Tensor:
        """Moved points in mm, with the shape and dtype of `points` `(..., 3)`."""
        given = torch.as_tensor(points)
        points = given.double()
        frames = self.frames(points[..., 2])
        section = torch.cat([points[..., :2], torch.zeros_like(points[..., 2:])], dim=-1)
        moved = (frames[..., :3, :3] @ section[..., None])[..., 0] + frames[..., :3, 3]
        return moved.to(given.dtype) if given.dtype.is_floating_point else moved

    def straightened(self, points: Tensor, *, iterations: int = 20) -> Tensor:
        """Inverse of the motion, near the rod: positions (..., 3) in mm, float64, before the motion.

        The cross section of a point p is the one whose plane contains it, `(p - c(z)) . R(z) e_z = 0`; z is found by
        iteration.
        """
        points = points.double()
        z = points[..., 2]
        for _ in range(iterations):
            frames = self.frames(z)
            z = z + ((points - frames[..., :3, 3]) * frames[..., :3, 2]).sum(-1)
        frames = self.frames(z)
        section = (frames[..., :3, :3].mT @ (points - frames[..., :3, 3])[..., None])[..., 0]
        return torch.cat([section[..., :2], z[..., None]], dim=-1)

    def frames(self, z: Tensor) -> Tensor:
        """Frames (..., 4, 4) of the cross sections at z. In the frame's coordinates the section lies at z = 0."""
        interval = torch.searchsorted(self._knots, z.contiguous(), right=True)
        rest = z - self._starts[interval]
        return self._frames[interval] @ _rod_steps(self._rates[interval], rest)


def _rod_steps(rates: Tensor, lengths: Tensor) -> Tensor:
    """Frames (..., 4, 4) at the end of rod segments with constant curvature (..., 3) and lengths (...)."""
    twist = rates.new_zeros(*rates.shape[:-1], 4, 4)
    x, y, z = (rates * lengths[..., None]).unbind(-1)
    twist[..., 0, 1], twist[..., 0, 2], twist[..., 1, 2] = -z, y, -x
    twist[..., 1, 0], twist[..., 2, 0], twist[..., 2, 1] = z, -y, x
    twist[..., 2, 3] = lengths
    return torch.linalg.matrix_exp(twist)
