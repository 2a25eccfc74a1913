"""A body rendered at many poses on coarse pixels, and its similarity to the images."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from torchkcreg.geometry import rotation_from_vector
from torchkcreg.projector import cell_footprint, project_points
from torchkcreg.scene import RegistrationData
from torchkcreg.similarity import erode_mask, sobel_gradient

from .candidates import Body, Candidates

_AT_ONCE = 4_000_000  # node-views or pixels that are held in memory
_STEP_MM = 0.5
_LARGEST_STEP_MM = 8.0
_AROUND_PX, _WINDOW_PX = 2, 3  # pixels around a shadow that are compared, and that a refinement sees
_DARKEST = 0.002  # share of a view's pixels that may be darker than its floor
_LEAST_ENERGY = 0.1  # of the image's edges, that any place has at least: nothing fits where nothing is
_LEAST_SHARE = 0.5  # of a template's contrast: one that lies on the detector by less is compared as if it were so much


class CoarseViews:
    """Images on coarse pixels, and how well the shadow of a body at many poses agrees with them.

    The similarity is the correlation of Sobel gradients on and around the body's shadow, times the root of the share of
    the body that a view shows; its square root is averaged over the views. Strong edges elsewhere, such as skin,
    another implant or the rim of an aperture, do not count.

    Args:
        data: Measured images of a few views.
        body: The body, on nodes about as coarse as the pixels.
        near: A world point (3,) near the body; footprints of the nodes are those there.
        pixel_mm: Least edge of a pixel; detector pixels are averaged to about this size.
        attenuation: Of the body's metal, 1/mm. Thick metal is opaque: the darkest transmission f of a view is its
            floor, and path lengths L show as `-ln(f + (1 - f) exp(-attenuation L))`.
        others: Renders path lengths (V, rows, cols) of what else is known, for a geometry; None for nothing.
    """

    def __init__(
        self,
        data: RegistrationData,
        body: Body,
        near: Tensor,
        pixel_mm: float,
        attenuation: float,
        others: Callable[[RegistrationData], Tensor] | None = None,
    ) -> None:
        self.data = data.binned(max(1, round(pixel_mm / data.geometry.pixel_spacing[1])))
        self.body, self.near, self.attenuation = body, near.double(), attenuation
        self.points, self.volumes, self.cell = (t.to(torch.float32) for t in (body.points, body.volumes, body.cell))
        self.matrices = self.data.geometry.projection_matrices.to(torch.float32)
        self.footprint = cell_footprint(self.points + self.near.to(torch.float32), self.cell, self.matrices)
        self._valid = erode_mask(self.data.mask)[:, None].to(torch.float32)
        self._floor = _darkest(self.data)
        self._others = None if others is None else others(self.data).to(torch.float32)
        self._others_shown: Tensor | None = None
        if self._others is not None:
            self._others_shown = sobel_gradient(self._seen(self._others, self._floor)) * self._valid
        self._target = self._unexplained()
        self._energy = self._target.square().sum(1)
        self._least_energy = _LEAST_ENERGY * self._energy.sum((-2, -1))
        rows, cols = self.data.geometry.det_shape
        self._batch = max(1, _AT_ONCE // (self.data.num_views * max(len(self.points), 2 * rows * cols)))

    def _unexplained(self) -> Tensor:
        """Gradients (V, 2, rows, cols) of the images without what the others explain, in units of the whole."""
        measured = sobel_gradient(self.data.line_integrals.to(torch.float32)) * self._valid
        measured = measured / measured.square().sum((1, 2, 3), keepdim=True).sqrt().clamp_min(1e-12)
        known = self._others_shown
        if known is None:
            return measured
        share = (measured * known).sum((1, 2, 3)) / known.square().sum((1, 2, 3)).clamp_min(1e-12)
        return measured - share[:, None, None, None] * known

    def _drawn(self, rotations: Tensor, centers: Tensor) -> Tensor:
        """Path lengths (K, V, rows, cols) of the body."""
        points = self.points @ rotations.to(torch.float32).mT + centers.to(torch.float32)[:, None]
        shape = self.data.geometry.det_shape
        return project_points(points, self.volumes, self.matrices, shape, footprint=self.footprint)

    def _seen(self, lengths: Tensor, floor: Tensor) -> Tensor:
        """Line integrals (..., V, rows, cols) of path lengths, for the floor (V,) of each view."""
        level = floor[:, None, None]
        return -torch.log(level + (1 - level) * torch.exp(-self.attenuation * lengths))

    def _shown(self, lengths: Tensor) -> Tensor:
        """Gradients (..., V, 2, rows, cols) that a body of these path lengths adds to what is known."""
        if self._others is None:
            return sobel_gradient(self._seen(lengths, self._floor)) * self._valid
        shown = sobel_gradient(self._seen(lengths + self._others, self._floor)) * self._valid
        return shown if self._others_shown is None else shown - self._others_shown

    @torch.no_grad()
    def compared(self, rotations: Tensor, centers: Tensor) -> Candidates:
        """Candidates of K rotations (K, 3, 3) and centres (K, 3), with their similarity."""
        batches = zip(rotations.split(self._batch), centers.split(self._batch), strict=True)
        return Candidates(rotations, centers, torch.cat([self._similarity(*batch) for batch in batches]))

    def _similarity(self, rotations: Tensor, centers: Tensor) -> Tensor:
        drawn = self._drawn(rotations, centers)
        shown = self._shown(drawn)
        common = (shown * self._target).sum((-3, -2, -1))
        around = (_widened(drawn > 0, _AROUND_PX) * self._energy).sum((-2, -1)) + self._least_energy
        similarity = common / (around * shown.square().sum((-3, -2, -1)) + 1e-20).sqrt()
        of_views = similarity * self._share_seen(drawn, centers).clamp(0.0, 1.0).sqrt()
        return of_views.clamp_min(0).sqrt().mean(-1).square()  # one view that fits does not outweigh one that does not

    def _share_seen(self, drawn: Tensor, centers: Tensor) -> Tensor:
        """Share (K, V) of the body's volume that projects on pixels that count."""
        geometry = self.data.geometry
        depth = centers.to(torch.float32) @ self.matrices[:, 2, :3].mT + self.matrices[:, 2, 3]
        area = (depth / geometry.detector_distances.to(depth)).square() * math.prod(geometry.pixel_spacing)
        return (drawn * self.data.mask).sum((-2, -1)) * area / self.volumes.sum()

    @torch.no_grad()
    def refined(self, candidates: Candidates, iterations: int) -> Candidates:
        """Candidates moved to the nearest optimum by Levenberg-Marquardt steps, all together."""
        parts = candidates.rotations.split(self._batch), candidates.centers.split(self._batch)
        moved = [self._refined(*part, iterations) for part in zip(*parts, strict=True)]
        return self.compared(*(torch.cat(tensors) for tensors in zip(*moved, strict=True)))

    def _refined(self, rotations: Tensor, centers: Tensor, iterations: int) -> tuple[Tensor, Tensor]:
        radius = self.body.radius_mm
        offsets = _STEP_MM * torch.eye(6, dtype=torch.float64, device=rotations.device)
        turns, shifts = rotation_from_vector(offsets[:, :3] / radius), offsets[:, 3:]
        damping = torch.full((len(rotations),), 0.1, dtype=torch.float64, device=rotations.device)
        # The window around the shadow stays where it is at the start.
        window = _widened(self._drawn(rotations, centers) > 0, _WINDOW_PX)[:, :, None]
        target = _unit(self._target * window)

        def residuals(turned: Tensor, placed: Tensor) -> Tensor:
            return (_unit(self._shown(self._drawn(turned, placed)) * window) - target).flatten(1)

        misfit = residuals(rotations, centers)
        loss = misfit.square().sum(1)
        for _ in range(iterations):
            slopes = [
                (residuals(turn @ rotations, centers + shift) - misfit) / _STEP_MM
                for turn, shift in zip(turns, shifts, strict=True)
            ]
            jacobian = torch.stack(slopes, dim=1)
            normal = (jacobian @ jacobian.mT).double()
            slope = (jacobian @ misfit[..., None])[..., 0].double()
            damped = normal + torch.diag_embed(damping[:, None] * normal.diagonal(dim1=1, dim2=2) + 1e-9)
            step = -torch.linalg.solve(damped, slope[..., None])[..., 0]
            step = step / (step.norm(dim=1, keepdim=True) / _LARGEST_STEP_MM).clamp_min(1.0)
            there = rotation_from_vector(step[:, :3] / radius) @ rotations, centers + step[:, 3:]
            new_misfit = residuals(*there)
            new_loss = new_misfit.square().sum(1)
            better = new_loss < loss
            rotations = torch.where(better[:, None, None], there[0], rotations)
            centers = torch.where(better[:, None], there[1], centers)
            misfit = torch.where(better[:, None], new_misfit, misfit)
            loss = torch.where(better, new_loss, loss)
            damping = torch.where(better, 0.4 * damping, 5 * damping).clamp(1e-3, 1e3)
        return rotations, centers

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
        measured = torch.fft.rfft2(self._target[view], padded)
        valid = torch.fft.rfft2(self.data.mask[view].to(torch.float32), padded)
        energy = torch.fft.rfft2(self._energy[view], padded)
        near, drawn_in = self.near.to(torch.float32), centred[None].to(torch.float32)
        footprint = cell_footprint(self.points + near, self.cell, drawn_in)
        similarity, places = [], []
        batch = max(1, _AT_ONCE // (padded[0] * padded[1]))
        for turns in rotations.split(batch):
            points = self.points @ turns.to(torch.float32).mT + near
            drawn = project_points(points, self.volumes, drawn_in, (size, size), footprint=footprint)[:, 0]
            template = sobel_gradient(self._seen(drawn[:, None], self._floor[view : view + 1])[:, 0])
            spectrum = torch.fft.rfft2(template, padded)
            contrast = torch.fft.rfft2(template.square().sum(1), padded)
            common = torch.fft.irfft2((measured * spectrum.conj()).sum(1), padded)
            seen = torch.fft.irfft2(valid * contrast.conj(), padded).clamp_min(0)
            whole = template.square().sum((1, 2, 3))[:, None, None]
            support = torch.fft.rfft2(_widened(drawn > 0, _AROUND_PX).to(torch.float32), padded)
            around = torch.fft.irfft2(energy * support.conj(), padded).clamp_min(0) + self._least_energy[view]
            fit, place = (common / (around * torch.maximum(seen, _LEAST_SHARE * whole)).sqrt()).flatten(1).max(1)
            similarity.append(fit)
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


def _darkest(data: RegistrationData) -> Tensor:
    """Nearly the smallest transmission (V,) of each view on pixels that count, between 1e-6 and 0.9."""
    darkest = [
        torch.quantile(lines[mask], 1 - _DARKEST) for lines, mask in zip(data.line_integrals, data.mask, strict=True)
    ]
    return torch.exp(-torch.stack(darkest).to(torch.float32)).clamp(1e-6, 0.9)


def _widened(inside: Tensor, pixels: int) -> Tensor:
    """1 on pixels (..., rows, cols) within so many pixels of those that are True, else 0."""
    flat = inside.to(torch.float32).reshape(-1, 1, *inside.shape[-2:])
    return max_pool2d(flat, 2 * pixels + 1, stride=1, padding=pixels).reshape(inside.shape)


def _unit(gradients: Tensor) -> Tensor:
    """Gradients (..., 2, rows, cols) of a norm of one; zero where they are."""
    return gradients / gradients.square().sum((-3, -2, -1), keepdim=True).sqrt().clamp_min(1e-12)


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
