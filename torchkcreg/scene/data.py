"""Measured data of a registration: projections, their geometry and masks."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.physics import scatter_shapes

from .following import resized

_LEAST_TRANSMISSION = 1e-6
_SCATTER_BLOCK = 8  # scatter is smooth: its shape is found on blocks of this many pixels squared


@dataclass(frozen=True)
class RegistrationData:
    """Projections with the geometry that made them.

    Attributes:
        geometry: V views.
        line_integrals: -ln(I / I0), shape (V, rows, cols); their dtype sets that of all rendered images.
        mask: True where a pixel counts, shape (V, rows, cols); all pixels when None was given.
        background: Path length of all but the known components (bone, water), expressed in one background material,
            shape (V, rows, cols), mm; None if unknown.
        background_mm: Smoothness of an estimated background, standard deviation in mm at the detector; it is then
            refitted to each candidate. 0 if the background is known.
        scatter_shapes: Distribution of scatter over the detector, shape (2, V, rows, cols), see
            `torchkcreg.physics.scatter_shapes`; uniform if None.

    Raises:
        ValueError: If the views or the pixels of geometry and images differ, or a view has no valid pixel.
    """

    geometry: ConeBeamGeometry
    line_integrals: Tensor
    mask: Tensor = None  # type: ignore[assignment]  # set below
    background: Tensor | None = None
    background_mm: float = 0.0
    scatter_shapes: Tensor | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.line_integrals.shape)
        if len(shape) != 3:
            raise ValueError(f"line_integrals must have shape (V, rows, cols), got {shape}")
        if shape[0] != self.geometry.num_views:
            raise ValueError(f"the geometry has {self.geometry.num_views} views, the projections have {shape[0]}")
        if shape[1:] != tuple(self.geometry.det_shape):
            raise ValueError(
                f"the geometry's detector is {tuple(self.geometry.det_shape)} pixels, the projections' {shape[1:]}"
            )
        finite = torch.isfinite(self.line_integrals)
        mask = finite if self.mask is None else self.mask.to(torch.bool) & finite
        if tuple(mask.shape) != shape:
            raise ValueError(f"mask must have the projections' shape {shape}, got {tuple(mask.shape)}")
        if not mask.any(dim=-1).any(dim=-1).all():
            empty = (~mask.any(dim=-1).any(dim=-1)).nonzero().flatten().tolist()
            raise ValueError(f"no valid pixel is left in view {', '.join(map(str, empty))}")
        object.__setattr__(self, "mask", mask)
        lines = torch.where(mask, self.line_integrals, 0.0)
        if lines.dtype not in (torch.float32, torch.float64):
            lines = lines.to(torch.float32)
        object.__setattr__(self, "line_integrals", lines)

    @classmethod
    def of_transmission(
        cls, geometry: ConeBeamGeometry, transmission: Tensor, mask: Tensor | None = None
    ) -> RegistrationData:
        """Data of measured transmissions I / I0 (V, rows, cols), limited from below to 1e-6."""
        lines = -transmission.clamp_min(_LEAST_TRANSMISSION).log()
        return cls(geometry, lines, mask)  # type: ignore[arg-type]

    @property
    def num_views(self) -> int:
        """Number of views V."""
        return self.line_integrals.shape[0]

    def to(self, device: torch.device | str) -> RegistrationData:
        """The data on another device."""
        moved: dict[str, Any] = {n: v.to(device) for n, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, geometry=copy.deepcopy(self.geometry).to(device), **moved)

    def facing(self, points: Tensor) -> RegistrationData:
        """The data with these world points (N, 3) in front of every source, see `ConeBeamGeometry.facing`."""
        return replace(self, geometry=self.geometry.facing(points))

    def select(self, views: list[int]) -> RegistrationData:
        """The given views, in the given order."""
        estimates = self._estimates(lambda image: image[views])
        lines, mask = self.line_integrals[views], self.mask[views]
        return replace(self, geometry=self.geometry.select(views), line_integrals=lines, mask=mask, **estimates)

    def binned(self, factor: int) -> RegistrationData:
        """Data on pixels `factor` times as large: transmissions are averaged over the pixels that count.

        A binned pixel counts if at least half of its pixels do.
        """
        if factor == 1:
            return self
        rows, cols = (n // factor * factor for n in self.geometry.det_shape)

        def mean(image: Tensor) -> Tensor:
            return avg_pool2d(image[:, :rows, :cols], factor)

        share = mean(self.mask.to(self.line_integrals))
        transmission = mean(torch.exp(-self.line_integrals) * self.mask) / share.clamp_min(1e-6)
        line_integrals = -torch.log(transmission.clamp_min(1e-6))
        return RegistrationData(self.geometry.bin(factor), line_integrals, share >= 0.5, **self._estimates(mean))

    def windowed(self, points: Tensor, margin_px: float) -> RegistrationData:
        """Data cropped, view by view, to the projection of `points` and a margin.

        All windows have the same size; pixels beyond the detector are masked. The matrices include the offsets.

        Args:
            points: World positions, shape (N, 3), mm.
            margin_px: Pixels around the points' bounding box.

        Raises:
            ValueError: If the points project outside the detector in every view.
        """
        uv, _ = self.geometry.project(points.to(self.geometry.projection_matrices))
        rows, cols = self.geometry.det_shape
        limit = uv.new_tensor([cols - 1, rows - 1])
        low = (uv.amin(dim=-2) - margin_px).floor().clamp_min(-margin_px)
        high = torch.minimum((uv.amax(dim=-2) + margin_px).ceil(), limit + margin_px)
        seen = ((high - margin_px >= 0) & (low + margin_px <= limit)).all(dim=-1)
        if not seen.any():
            raise ValueError("the implant lies outside every view: check its frame, its unit and the initial pose")
        low = torch.minimum(torch.maximum(low, torch.zeros_like(low)), limit).long()
        high = torch.maximum(torch.minimum(high, limit), low.to(high)).long()
        size_u, size_v = (high - low + 1).amax(dim=0).tolist()
        matrices = self.geometry.projection_matrices.clone()
        for view, (u0, v0) in enumerate(low.tolist()):
            matrices[view, 0] -= u0 * matrices[view, 2]
            matrices[view, 1] -= v0 * matrices[view, 2]

        def window(image: Tensor) -> Tensor:
            cut = image.new_zeros(self.num_views, size_v, size_u)
            for view, (u0, v0) in enumerate(low.tolist()):
                height, width = min(size_v, rows - v0), min(size_u, cols - u0)
                cut[view, :height, :width] = image[view, v0 : v0 + height, u0 : u0 + width]
            return cut

        def continued(image: Tensor) -> Tensor:
            """Estimate extended beyond the detector by its edge values, since the blur of a DRR reaches there."""
            sizes = ((size_v, low[:, 1:]), (size_u, low[:, :1]))
            v, u = (torch.arange(size, device=low.device) + first for size, first in sizes)
            views = torch.arange(self.num_views, device=low.device)[:, None, None]
            return image[views, v.clamp_max(rows - 1)[:, :, None], u.clamp_max(cols - 1)[:, None, :]]

        geometry = ConeBeamGeometry(
            matrices,
            (size_v, size_u),
            self.geometry.pixel_spacing,
            sources=self.geometry.sources,
            angles_deg=self.geometry.angles_deg,
        )
        estimates = self._estimates(continued)
        return RegistrationData(geometry, window(self.line_integrals), window(self.mask), **estimates)

    def with_scatter_shapes(self, sigma_mm: float) -> RegistrationData:
        """The data with scatter shapes of standard deviation `sigma_mm` at the detector."""
        factor = min(_SCATTER_BLOCK, *self.geometry.det_shape)
        sigma = sigma_mm / self.geometry.pixel_spacing[1] / factor
        transmission = adaptive_avg_pool2d(torch.exp(-self.line_integrals) * self.mask, self._blocks(factor))
        share = adaptive_avg_pool2d(self.mask.to(transmission), self._blocks(factor))
        shapes = scatter_shapes(transmission / share.clamp_min(1e-3), share, sigma)
        return replace(self, scatter_shapes=torch.stack([resized(s, self.geometry.det_shape) for s in shapes]))

    def _blocks(self, factor: int) -> tuple[int, int]:
        rows, cols = self.geometry.det_shape
        return max(1, rows // factor), max(1, cols // factor)

    def _estimates(self, change: Callable[[Tensor], Tensor]) -> dict[str, Any]:
        """The estimated images, each transformed by `change`."""
        background = None if self.background is None else change(self.background)
        shapes = None if self.scatter_shapes is None else torch.stack([change(s) for s in self.scatter_shapes])
        return {"background": background, "scatter_shapes": shapes, "background_mm": self.background_mm}
