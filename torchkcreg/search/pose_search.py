"""Search for the pose of an implant from nowhere: any frame of its mesh, any orientation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchkcreg.geometry import rotation_grid
from torchkcreg.scene import RegistrationData

from .candidates import Body, Candidates
from .coarse_views import CoarseViews
from .region import aimed_at, spread_views

_ROTATIONS = 4608
_SHADOWS = 512  # places from one view that are compared in all views
_ROUGH = 1.5  # relative pixels on which depths are compared
_DEPTH_STEP_MM = 8.0  # along the ray, as far as half of the field of view, about where the views are aimed at
_MOST_VIEWS = 4
_COARSEST_MM, _PIXELS_ALONG = 4.0, 25.0  # pixels, at most so large and so many along the implant's longest radius
_MOST_NODES, _MOST_PIXELS = 1500, 5000  # pixels of a view: larger detectors have coarser ones, up to 1.5 times
# Relative pixels, candidates refined on them, and iterations. Coarser pixels draw candidates from further away, but the
# outlines of neighbouring views say little on them.
_PATHS = (((1.0, 96, 10),), ((2.5, 64, 8), (1.5, 48, 6), (1.0, 32, 6)))
_TURNED, _CONTINUED, _POLISHED = 8, 32, 12  # candidates turned, refined on finer pixels, and refined further there
_APART_MM = 4.0  # RMS of the nodes: nearer candidates are one


class PoseSearch:
    """Poses at which an implant's outline agrees with the images, without a start, see docs/method.md.

    Rotations on a grid over SO(3) are placed by one view, by correlation of their shadows with the image; the best are
    compared at several depths in all views, and refined, first on coarse, then on finer pixels. Half turns about the
    principal axes of the best ones are candidates too: nearly symmetric implants have twins that coarse images do not
    tell apart.

    Args:
        data: Measured images; of many views, four that lie far apart are used.
        body_at: Makes the body for a pitch of its nodes, mm.
        attenuation: Of the implant's metal, 1/mm, at the energies of a tube: about 0.9 for steel, 0.3 for titanium.
        others: Renders path lengths (V, rows, cols) of what else is known, for images of some size; None for nothing.
        rotations: Number of rotations.

    Attributes:
        coarse: The views on coarse pixels.
        body: The body whose poses `candidates` returned last.
    """

    def __init__(
        self,
        data: RegistrationData,
        body_at: Callable[[float], Body],
        others: Callable[[RegistrationData], Tensor] | None = None,
        *,
        attenuation: float = 0.5,
        rotations: int = _ROTATIONS,
    ) -> None:
        views = spread_views(data.geometry, _MOST_VIEWS)
        self.data = data if len(views) == data.num_views else data.select(views)
        geometry = self.data.geometry
        self.near, self.num_rotations = aimed_at(geometry), rotations
        depths = geometry.projection_matrices[:, 2, :3] @ self.near + geometry.projection_matrices[:, 2, 3]
        self._magnification = float((geometry.detector_distances / depths).mean())
        edges = (size * spacing for size, spacing in zip(geometry.det_shape, geometry.pixel_spacing, strict=True))
        self._reach_mm = 0.5 * max(edges) / self._magnification
        extent = body_at(_COARSEST_MM).extent_mm
        finest = min(_COARSEST_MM, 2 * extent * self._magnification / _PIXELS_ALONG)
        area = math.prod(geometry.det_shape) * math.prod(geometry.pixel_spacing)
        self.pixel_mm = min(max(finest, (area / _MOST_PIXELS) ** 0.5), 1.5 * finest)
        self._body_at, self._others, self._attenuation = body_at, others, attenuation
        self.coarse = self._views(self.pixel_mm)
        self.body = self.coarse.body
        self._rough = self._views(_ROUGH * self.pixel_mm, self.coarse.body)

    def _views(self, pixel_mm: float, body: Body | None = None) -> CoarseViews:
        if body is None:
            pitch = pixel_mm / self._magnification / 1.5
            body = self._body_at(pitch)
            while len(body.volumes) > _MOST_NODES * (self.pixel_mm / pixel_mm) ** 2:
                pitch *= 1.25
                body = self._body_at(pitch)
        return CoarseViews(self.data, body, self.near, pixel_mm, self._attenuation, self._others)

    def placed(self, rotations: Tensor, number: int) -> Candidates:
        """The best `number` of the rotations (K, 3, 3), each at its best place, unrefined."""
        view = self.data.num_views // 2
        shadows = self.coarse.shadows(rotations, view).best(number)
        source = self.data.geometry.source_positions[view]
        rays = torch.nn.functional.normalize(shadows.centers - source, dim=-1)
        number_of = math.ceil(self._reach_mm / _DEPTH_STEP_MM)
        steps = torch.arange(-number_of, number_of + 1, dtype=rays.dtype, device=rays.device) * _DEPTH_STEP_MM
        centers = (shadows.centers[:, None] + steps[:, None] * rays[:, None]).flatten(0, 1)
        turns = shadows.rotations.repeat_interleave(len(steps), 0)
        compared = self._rough.compared(turns, centers)
        best = compared.similarity.unflatten(0, (len(shadows), -1)).argmax(1)
        return compared[torch.arange(len(shadows), device=best.device) * len(steps) + best]

    def candidates(self, report: Callable[[int, str], None] = lambda done, text: None) -> Candidates:
        """The most similar distinct poses, best first, with their similarity on pixels half as large.

        Args:
            report: Called with the number of finished steps, of four, and the name of the next.
        """
        report(0, "shadows of all orientations")
        placed = self.placed(rotation_grid(self.num_rotations, self.near.device), _SHADOWS)
        report(1, "refinement")
        body = self.coarse.body
        refined = sum((self._along(path, placed) for path in _PATHS), placed[:0]).distinct(body, _APART_MM)
        report(2, "half turns")
        turned = self.coarse.refined(refined[:_TURNED].half_turned(body), 6)
        every = (refined + turned).distinct(body, _APART_MM).best(_CONTINUED)
        report(3, "finer pixels")
        fine = self._views(self.pixel_mm / 2)
        self.body = fine.body
        finer = fine.refined(every.about(fine.body.center - body.center), 8).distinct(fine.body, _APART_MM)
        return fine.refined(finer.best(_POLISHED), 12).distinct(fine.body, _APART_MM)

    def _along(self, path: Sequence[tuple[float, int, int]], candidates: Candidates) -> Candidates:
        """Distinct candidates refined on one size of pixels after the other."""
        for relative, number, iterations in path:
            views = self.coarse if relative == 1 else self._views(relative * self.pixel_mm, self.coarse.body)
            candidates = views.refined(candidates.best(number), iterations).distinct(self.coarse.body, _APART_MM)
        return candidates
