"""A body rendered at many poses on coarse pixels, and its similarity to the images."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchkcreg.geometry import rotation_from_vector
from torchkcreg.projector import cell_footprint, project_points
from torchkcreg.scene import RegistrationData
from torchkcreg.similarity import GradientCorrelation, erode_mask, sobel_gradient

from .candidates import Body, Candidates

_AT_ONCE = 4_000_000  # node-views or pixels that are held in memory
_STEP_MM = 0.5
_LARGEST_STEP_MM = 8.0
_LEAST_SHARE = 0.25  # of a template's contrast that must lie on the detector


class CoarseViews:
    """Images on coarse pixels, compared with the path lengths of a body at many poses by gradient correlation.

    Args:
        data: Measured images of a few views.
        body: The body, on nodes about as coarse as the pixels.
        near: A world point (3,) near the body; footprints of the nodes are those there.
        pixel_mm: Least edge of a pixel; detector pixels are averaged to at least about this size.
        others: Renders path lengths (V, rows, cols) of what else is known, for a geometry; None for nothing.
    """

    def __init__(
        self,
        data: RegistrationData,
        body: Body,
        near: Tensor,
        pixel_mm: float,
        others: Callable[[RegistrationData], Tensor] | None = None,
    ) -> None:
        self.data = data.binned(max(1, round(pixel_mm / data.geometry.pixel_spacing[1])))
        self.body, self.near = body, near.double()
        self.points, self.volumes = body.points.to(torch.float32), body.volumes.to(torch.float32)
        self.cell = body.cell.to(torch.float32)
        self.matrices = self.data.geometry.projection_matrices.to(torch.float32)
        self.footprint = cell_footprint(self.points + self.near.to(torch.float32), self.cell, self.matrices)
        self.similarity = GradientCorrelation(self.data.line_integrals.to(torch.float32), self.data.mask)
        self.others = None if others is None else others(self.data).to(torch.float32)
        self._unexplained = self._without_others()
        rows, cols = self.data.geometry.det_shape
        self._batch = max(1, _AT_ONCE // (self.data.num_views * max(len(self.points), 2 * rows * cols)))

    def _without_others(self) -> Tensor:
        """Gradients (V, 2, rows, cols) of the images without what the others explain of them."""
        measured = self.similarity.unit_gradients
        if self.others is None:
            return measured
        known = sobel_gradient(self.others) * erode_mask(self.data.mask)[:, None]
        share = (measured * known).sum((1, 2, 3)) / known.square().sum((1, 2, 3)).clamp_min(1e-12)
        return measured - share[:, None, None, None] * known

    def _images(self, rotations: Tensor, centers: Tensor) -> Tensor:
        points = self.points @ rotations.to(torch.float32).mT + centers.to(torch.float32)[:, None]
        shape = self.data.geometry.det_shape
        drawn = project_points(points, self.volumes, self.matrices, shape, footprint=self.footprint)
        return drawn if self.others is None else drawn + self.others

    @torch.no_grad()
    def compared(self, rotations: Tensor, centers: Tensor) -> Candidates:
        """Candidates of K rotations (K, 3, 3) and centres (K, 3), with their similarity."""
        batches = zip(rotations.split(self._batch), centers.split(self._batch), strict=True)
        similarity = torch.cat([self.similarity(self._images(*batch)).mean(-1) for batch in batches])
        return Candidates(rotations, centers, similarity)

    def _residuals(self, rotations: Tensor, centers: Tensor) -> Tensor:
        return self.similarity.residuals(self._images(rotations, centers)).flatten(1)

    @torch.no_grad()
    def refined(self, candidates: Candidates, iterations: int) -> Candidates:
        """Candidates moved to the nearest optimum: Levenberg-Marquardt steps of all of them together."""
        parts = candidates.rotations.split(self._batch), candidates.centers.split(self._batch)
        moved = [self._refined(*part, iterations) for part in zip(*parts, strict=True)]
        return Candidates(*(torch.cat(tensors) for tensors in zip(*moved, strict=True)))

    def _refined(self, rotations: Tensor, centers: Tensor, iterations: int) -> tuple[Tensor, Tensor, Tensor]:
        radius = self.body.radius_mm
        offsets = _STEP_MM * torch.eye(6, dtype=torch.float64, device=rotations.device)
        turns, shifts = rotation_from_vector(offsets[:, :3] / radius), offsets[:, 3:]
        damping = torch.full((len(rotations),), 0.1, dtype=torch.float64, device=rotations.device)
        residuals = self._residuals(rotations, centers)
        loss = residuals.square().sum(1)
        for _ in range(iterations):
            slopes = [
                (self._residuals(turn @ rotations, centers + shift) - residuals) / _STEP_MM
                for turn, shift in zip(turns, shifts, strict=True)
            ]
            jacobian = torch.stack(slopes, dim=1)
            normal = (jacobian @ jacobian.mT).double()
            slope = (jacobian @ residuals[..., None])[..., 0].double()
            damped = normal + torch.diag_embed(damping[:, None] * normal.diagonal(dim1=1, dim2=2) + 1e-9)
            step = -torch.linalg.solve(damped, slope[..., None])[..., 0]
            step = step / (step.norm(dim=1, keepdim=True) / _LARGEST_STEP_MM).clamp_min(1.0)
            there = rotation_from_vector(step[:, :3] / radius) @ rotations, centers + step[:, 3:]
            new_residuals = self._residuals(*there)
            new_loss = new_residuals.square().sum(1)
            better = new_loss < loss
            rotations = torch.where(better[:, None, None], there[0], rotations)
            centers = torch.where(better[:, None], there[1], centers)
            residuals = torch.where(better[:, None], new_residuals, residuals)
            loss = torch.where(better, new_loss, loss)
            damping = torch.where(better, 0.4 * damping, 5 * damping).clamp(1e-3, 1e3)
        return rotations, centers, 1 - loss / (4 * self.data.num_views)

    @torch.no_grad()
    def shadows(self, rotations: Tensor, view: int) -> Candidates:
        """The place of each rotation (K, 3, 3) whose shadow fits best in one view, at the depth of the near point.

        The gradients of the shadow are correlated with those of the image at all shifts by FFT, and divided by the
        contrast of the part that lies on the detector.
        """
        geometry = self.data.geometry
        rows, cols = geometry.det_shape
        matrix = geometry.projection_matrices[view]
        homogeneous = matrix[:, :3] @ self.near + matrix[:, 3]
        depth = homogeneous[2]
        magnification = float(geometry.detector_distances[view] / depth)
        reach = math.ceil(self.body.extent_mm * magnification / min(geometry.pixel_spacing)) + 2
        offset = reach - homogeneous[:2] / depth  # the middle of a template sees the near point
        centred = matrix.clone()
        centred[:2] += offset[:, None] * matrix[2]
        size = 2 * reach + 1
        padded = (_fast_size(rows + size - 1), _fast_size(cols + size - 1))
        measured = torch.fft.rfft2(self._unexplained[view], padded)
        valid = torch.fft.rfft2(self.data.mask[view].to(torch.float32), padded)
        near, drawn_in = self.near.to(torch.float32), centred[None].to(torch.float32)
        footprint = cell_footprint(self.points + near, self.cell, drawn_in)
        similarity, places = [], []
        batch = max(1, _AT_ONCE // (padded[0] * padded[1]))
        for turns in rotations.split(batch):
            points = self.points @ turns.to(torch.float32).mT + near
            drawn = project_points(points, self.volumes, drawn_in, (size, size), footprint=footprint)[:, 0]
            template = sobel_gradient(drawn)
            spectrum = torch.fft.rfft2(template, padded)
            contrast = torch.fft.rfft2(template.square().sum(1), padded)
            common = torch.fft.irfft2((measured * spectrum.conj()).sum(1), padded)
            seen = torch.fft.irfft2(valid * contrast.conj(), padded).clamp_min(0)
            whole = template.square().sum((1, 2, 3))[:, None, None]
            fit, place = (common / torch.maximum(seen, _LEAST_SHARE * whole).sqrt()).flatten(1).max(1)
            similarity.append(fit / 2**0.5)
            places.append(place)
        place = torch.cat(places)
        row, column = place // padded[1], place % padded[1]
        row, column = (
            torch.where(at >= size_of, at - padded_to, at).double()
            for at, size_of, padded_to in ((row, rows, padded[0]), (column, cols, padded[1]))
        )
        pixel = torch.stack([column + reach, row + reach, torch.ones_like(row)])
        centers = torch.linalg.solve(matrix[:, :3], pixel * depth - matrix[:, 3:]).mT
        return Candidates(rotations, centers, torch.cat(similarity))


def _fast_size(size: int) -> int:
    """The next size without prime factors above five."""
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return size
        size += 1
