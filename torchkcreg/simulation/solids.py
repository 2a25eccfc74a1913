"""Solids with closed-form chord lengths: spheres, cylinders and tubes, for screws, bones, beads and water baths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchkcreg.geometry import transform_points

PARALLEL = 1e-12  # direction components below this count as zero
BLOCK_ROWS = 64  # detector rows whose rays are traced together


class Convex(Protocol):
    """A convex solid: a ray is inside it between two distances."""

    def interval(self, origin: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Entry and exit distances `(...)` of rays with unit directions `(..., 3)`; entry >= exit if a ray misses."""


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere, such as a bead.

    Attributes:
        center: Centre (3,), mm.
        radius: Radius, mm.
    """

    center: Tensor
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", _point("center", self.center))
        _check_positive("radius", self.radius)

    @property
    def hull(self) -> Convex:
        """The solid with its cavity filled: itself."""
        return self

    @property
    def cavity(self) -> Convex | None:
        """The cavity in the hull: none."""
        return None

    def interval(self, origin: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Entry and exit distances of rays."""
        offset = self.center - origin
        nearest = directions @ offset
        half = (self.radius**2 - offset @ offset + nearest**2).clamp_min(0).sqrt()
        return nearest - half, nearest + half

    def corners(self) -> Tensor:
        """Corners (8, 3) of a box around the sphere."""
        return self.center + self.radius * _cube_corners()

    def moved(self, transform: Tensor) -> Sphere:
        """The solid after a rigid motion (4, 4)."""
        return Sphere(transform_points(transform, self.center[None])[0], self.radius)


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A straight cylinder, such as a screw, a rod or a water bath.

    Attributes:
        start: Centre of one end (3,), mm.
        end: Centre of the other end (3,), mm.
        radius: Radius, mm.
    """

    start: Tensor
    end: Tensor
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", _point("start", self.start))
        object.__setattr__(self, "end", _point("end", self.end))
        _check_positive("radius", self.radius)
        _check_positive("length", float((self.end - self.start).norm()))

    @property
    def hull(self) -> Convex:
        """The solid with its cavity filled: itself."""
        return self

    @property
    def cavity(self) -> Convex | None:
        """The cavity in the hull: none."""
        return None

    def interval(self, origin: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Entry and exit distances of rays."""
        length = (self.end - self.start).norm()
        axis = (self.end - self.start) / length
        offset = origin - self.start
        along, height = directions @ axis, offset @ axis
        across = (1 - along**2).clamp_min(PARALLEL)
        half_linear = directions @ offset - along * height
        discriminant = half_linear**2 - across * (offset @ offset - height**2 - self.radius**2)
        reach = discriminant.clamp_min(0).sqrt()
        slope = torch.where(along.abs() < PARALLEL, torch.full_like(along, PARALLEL), along)
        bottom, top = -height / slope, (length - height) / slope
        enter = torch.maximum((-half_linear - reach) / across, torch.minimum(bottom, top))
        leave = torch.minimum((-half_linear + reach) / across, torch.maximum(bottom, top))
        return enter, torch.where(discriminant > 0, leave, enter)

    def corners(self) -> Tensor:
        """Corners (16, 3) of boxes around both ends."""
        around = self.radius * _cube_corners()
        return torch.cat([self.start + around, self.end + around])

    def moved(self, transform: Tensor) -> Cylinder:
        """The solid after a rigid motion (4, 4)."""
        start, end = transform_points(transform, torch.stack([self.start, self.end]))
        return Cylinder(start, end, self.radius)


@dataclass(frozen=True, eq=False)
class Tube:
    """A straight tube, open at both ends, such as the shaft of a long bone.

    Attributes:
        start: Centre of one end (3,), mm.
        end: Centre of the other end (3,), mm.
        outer_radius: Outer radius, mm.
        inner_radius: Inner radius, mm, smaller than the outer.
    """

    start: Tensor
    end: Tensor
    outer_radius: float
    inner_radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", _point("start", self.start))
        object.__setattr__(self, "end", _point("end", self.end))
        if not 0 < self.inner_radius < self.outer_radius:
            raise ValueError(f"inner_radius must lie between 0 and {self.outer_radius}, got {self.inner_radius}")

    @property
    def hull(self) -> Cylinder:
        """The tube with its bore filled."""
        return Cylinder(self.start, self.end, self.outer_radius)

    @property
    def cavity(self) -> Cylinder:
        """The bore."""
        return Cylinder(self.start, self.end, self.inner_radius)

    def corners(self) -> Tensor:
        """Corners (16, 3) of boxes around both ends."""
        return self.hull.corners()

    def moved(self, transform: Tensor) -> Tube:
        """The solid after a rigid motion (4, 4)."""
        hull = self.hull.moved(transform)
        return Tube(hull.start, hull.end, self.outer_radius, self.inner_radius)


def _cube_corners() -> Tensor:
    """Corners (8, 3) of the cube from -1 to 1."""
    side = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    return torch.cartesian_prod(side, side, side)


def _point(name: str, value: Tensor | Sequence[float]) -> Tensor:
    """A point (3,) in float64."""
    point = torch.as_tensor(value, dtype=torch.float64)
    if point.shape != (3,):
        raise ValueError(f"{name} must be a point of 3 coordinates, got shape {tuple(point.shape)}")
    return point


def _check_positive(name: str, value: float) -> None:
    """Raise ValueError unless a length is positive."""
    if not value > 0:
        raise ValueError(f"{name} must be positive, got {value}")


Solid = Sphere | Cylinder | Tube


def chord_lengths(solid: Solid, origin: Tensor, directions: Tensor, *, within: Solid | None = None) -> Tensor:
    """Chord lengths in mm `(...)` of rays from `origin` (3,) along unit `directions` `(..., 3)` through a solid.

    Args:
        solid: Solid that the rays cross.
        origin: Position of the source.
        directions: Unit vectors.
        within: If given, only lengths that are also inside this solid count; it must have no cavity.

    Raises:
        ValueError: If `within` has a cavity.

    >>> from torchkcreg.simulation import Sphere
    >>> along_z = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    >>> chord_lengths(Sphere([0, 0, 0], 2.0), -9 * along_z[0], along_z)
    tensor([4.], dtype=torch.float64)
    """
    bodies = [solid.hull]
    if within is not None:
        if within.cavity is not None:
            raise ValueError("within must be a solid without a cavity")
        bodies.append(within.hull)
    length = _common_length(bodies, origin, directions)
    if solid.cavity is not None:
        length = length - _common_length([*bodies, solid.cavity], origin, directions)
    return length


def chord_image(
    solid: Solid, matrix: Tensor, det_shape: tuple[int, int], *, rays: int = 2, within: Solid | None = None
) -> Tensor:
    """Chord lengths in mm (rows, cols), float64, averaged over `rays` x `rays` rays per pixel.

    Args:
        solid: Solid that the rays cross, in the world's frame.
        matrix: Projection matrix (3, 4).
        det_shape: Rows and columns.
        rays: Rays along each side of a pixel.
        within: As in `chord_lengths`.
    """
    matrix = matrix.double()
    image = matrix.new_zeros(det_shape)
    rows, cols = _shadow(solid.corners() if within is None else within.corners(), matrix, det_shape)
    inverse = torch.linalg.inv(matrix[:, :3])
    origin = -inverse @ matrix[:, 3]
    u = _ray_positions(cols, rays)
    for start in range(rows.start, rows.stop, BLOCK_ROWS):
        block = range(start, min(start + BLOCK_ROWS, rows.stop))
        v = _ray_positions(block, rays)
        directions = inverse[:, 0] * u[:, None] + inverse[:, 1] * v[:, None, None] + inverse[:, 2]
        directions = directions / directions.norm(dim=-1, keepdim=True)
        lengths = chord_lengths(solid, origin, directions, within=within)
        means = lengths.reshape(len(block), rays, len(cols), rays).mean((1, 3))
        image[block.start : block.stop, cols.start : cols.stop] = means
    return image


def _common_length(bodies: Sequence[Convex], origin: Tensor, directions: Tensor) -> Tensor:
    """Length inside the intersection of convex bodies."""
    enters, leaves = zip(*(body.interval(origin, directions) for body in bodies))
    return (torch.stack(leaves).amin(0) - torch.stack(enters).amax(0)).clamp_min(0)


def _shadow(corners: Tensor, matrix: Tensor, det_shape: tuple[int, int]) -> tuple[range, range]:
    """Rows and columns of the shadow of a solid within these corners."""
    homogeneous = corners @ matrix[:, :3].T + matrix[:, 3]
    if bool((homogeneous[:, 2] <= 0).any()):
        return range(det_shape[0]), range(det_shape[1])
    pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    low, high = (pixels.amin(0) - 1).floor().tolist(), (pixels.amax(0) + 2).ceil().tolist()
    ranges = [range(max(0, int(a)), min(size, int(b))) for a, b, size in zip(low, high, det_shape[::-1])]
    return ranges[1], ranges[0]


def _ray_positions(pixels: range, rays: int) -> Tensor:
    """Pixel coordinates of the rays for a range of pixels, with pixel centres at integers."""
    fine = torch.arange(pixels.start * rays, max(pixels.stop, pixels.start) * rays, dtype=torch.float64)
    return (fine + 0.5) / rays - 0.5
