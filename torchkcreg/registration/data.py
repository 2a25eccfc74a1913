"""The measured side of a registration: projections, their geometry and the pixels that count."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry


@dataclass(frozen=True)
class RegistrationData:
    """Projections with the geometry that made them.

    Attributes:
        geometry: V views.
        line_integrals: -ln(I / I0), shape (V, rows, cols).
        mask: True where a pixel counts, shape (V, rows, cols); all pixels when None was given.
        background: Share of the beam that everything but the known components lets through, shape (V, rows, cols);
            None where nothing is known of it.

    Raises:
        ValueError: If the views or the pixels of geometry and images differ, or no pixel is left.
    """

    geometry: ConeBeamGeometry
    line_integrals: Tensor
    mask: Tensor = None  # type: ignore[assignment]  # set below
    background: Tensor | None = None

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
        object.__setattr__(self, "line_integrals", torch.where(mask, self.line_integrals, 0.0).float())

    @property
    def num_views(self) -> int:
        """Number of views V."""
        return self.line_integrals.shape[0]

    def select(self, views: list[int]) -> RegistrationData:
        """The given views alone, in the given order."""
        background = None if self.background is None else self.background[views]
        return RegistrationData(self.geometry.select(views), self.line_integrals[views], self.mask[views], background)

    def binned(self, factor: int) -> RegistrationData:
        """Data on pixels ``factor`` times as large: transmissions are averaged over the pixels that count.

        A binned pixel counts if at least half of its pixels do.
        """
        if factor == 1:
            return self
        rows, cols = (n // factor * factor for n in self.geometry.det_shape)

        def mean(image: Tensor) -> Tensor:
            return torch.nn.functional.avg_pool2d(image[:, :rows, :cols], factor)

        share = mean(self.mask.float())
        transmission = mean(torch.exp(-self.line_integrals) * self.mask) / share.clamp_min(1e-6)
        line_integrals = -torch.log(transmission.clamp_min(1e-6))
        background = None if self.background is None else mean(self.background)
        return RegistrationData(self.geometry.bin(factor), line_integrals, share >= 0.5, background)

    def windowed(self, points: Tensor, margin_px: float) -> RegistrationData:
        """Data cropped, view by view, to the projection of ``points`` and a margin.

        All windows have one size; what a window has beyond the detector is masked. The matrices carry the offsets.

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
        images = self.line_integrals.new_zeros((self.num_views, size_v, size_u))
        mask = torch.zeros_like(images, dtype=torch.bool)
        background = None if self.background is None else torch.ones_like(images)
        for view, (u0, v0) in enumerate(low.tolist()):
            height, width = min(size_v, rows - v0), min(size_u, cols - u0)
            images[view, :height, :width] = self.line_integrals[view, v0 : v0 + height, u0 : u0 + width]
            mask[view, :height, :width] = self.mask[view, v0 : v0 + height, u0 : u0 + width]
            if background is not None and self.background is not None:
                background[view, :height, :width] = self.background[view, v0 : v0 + height, u0 : u0 + width]
            matrices[view, 0] -= u0 * matrices[view, 2]
            matrices[view, 1] -= v0 * matrices[view, 2]
        geometry = ConeBeamGeometry(
            matrices,
            (size_v, size_u),
            self.geometry.pixel_spacing,
            sources=self.geometry.sources,
            angles_deg=self.geometry.angles_deg,
        )
        return RegistrationData(geometry, images, mask, background)
