"""`ConeBeamGeometry`: views given by 3 x 4 projection matrices, with their sources, rays and pixel positions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.precision import ExactModule

from .orientation import checked_matrices, checked_shape, looking_signs, turned_towards

_LARGEST_ASPECT = 0.02  # relative difference of the distances that rows and columns give


class ConeBeamGeometry(ExactModule):
    """Views of a cone-beam system: `u = P0.X / P2.X` (column), `v = P1.X / P2.X` (row), X = (x, y, z, 1) in mm.

    A view is defined by its matrix `P = [M | m]`: the source is at `-M^-1 m` and the ray of pixel (u, v) has the
    direction `M^-1 (u, v, 1)`. Pixel centres are at integers, counted from 0. On construction each matrix is scaled so
    that its row 2 gives the depth in mm along the detector's normal. Depths are positive in front of the source, on the
    side where the views' central rays meet (see `looking_signs`). Any invertible M is valid: tilted detectors, cropped
    images, rows that run up or down, a world origin at or behind a source.

    Args:
        projection_matrices: (V, 3, 4), any scale and sign.
        det_shape: (rows, cols) of every image.
        pixel_spacing: (dv, du) in mm, between rows and between columns.
        sources: Name of each view's focal spot.
        angles_deg: Gantry angle of each view, used only to select views.

    Attributes:
        projection_matrices: Buffer (V, 3, 4), float64 whatever the module is cast to.
        knows_front: True if the signs of the depths follow from the views themselves; otherwise `facing` can set them.

    Raises:
        ValueError: Shapes, labels or numbers that do not make a geometry.

    >>> from torchkcreg.geometry import circular_geometry
    >>> geometry = circular_geometry([0.0, 90.0], sad=404, sdd=538, det_shape=(768, 768), pixel_spacing=(0.39, 0.39))
    >>> uv, depth = geometry.project(torch.zeros(1, 3))
    >>> uv[0].tolist(), depth[0].tolist()
    ([[383.5, 383.5]], [404.0])
    """

    exact_buffers = ("projection_matrices",)
    projection_matrices: Tensor

    def __init__(
        self,
        projection_matrices: Tensor,
        det_shape: Sequence[int],
        pixel_spacing: Sequence[float],
        *,
        sources: Sequence[str] | None = None,
        angles_deg: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        matrices = checked_matrices(projection_matrices)
        det_shape = checked_shape(det_shape)
        signs, knows_front = looking_signs(matrices.detach(), det_shape)
        self._set_up(matrices * signs[:, None, None], det_shape, pixel_spacing, sources, angles_deg, knows_front)

    def _set_up(
        self,
        matrices: Tensor,
        det_shape: Sequence[int],
        pixel_spacing: Sequence[float],
        sources: Sequence[str] | None,
        angles_deg: Sequence[float] | None,
        knows_front: bool,
    ) -> None:
        if len(pixel_spacing) != 2 or not all(math.isfinite(d) and d > 0 for d in pixel_spacing):
            raise ValueError(f"pixel_spacing must be two positive lengths (dv, du) in mm, got {tuple(pixel_spacing)}")
        self.register_buffer("projection_matrices", matrices)
        self.det_shape = checked_shape(det_shape)
        self.pixel_spacing = (float(pixel_spacing[0]), float(pixel_spacing[1]))
        self.knows_front = knows_front
        self.sources = None if sources is None else tuple(str(source) for source in sources)
        self.angles_deg = None if angles_deg is None else tuple(float(angle) for angle in angles_deg)
        for name, labels in (("sources", self.sources), ("angles_deg", self.angles_deg)):
            if labels is not None and len(labels) != len(matrices):
                raise ValueError(f"{name} must have one entry for each of the {len(matrices)} views, got {len(labels)}")

    def _derived(self, matrices: Tensor, **changes: object) -> ConeBeamGeometry:
        """This geometry with other matrices. Unlike the constructor it does not change the sign of the depth."""
        names = ("det_shape", "pixel_spacing", "sources", "angles_deg", "knows_front")
        fields: dict = {name: getattr(self, name) for name in names}
        geometry = ConeBeamGeometry.__new__(ConeBeamGeometry)
        ExactModule.__init__(geometry)
        geometry._set_up(matrices, **(fields | changes))
        return geometry

    def extra_repr(self) -> str:
        """Counts of views and pixels for `repr`."""
        dv, du = self.pixel_spacing
        text = f"num_views={self.num_views}, det_shape={self.det_shape}, pixel_spacing=({dv:g}, {du:g})"
        if self.sources is not None:
            counts = {source: self.sources.count(source) for source in sorted(set(self.sources))}
            text += ", sources=" + "/".join(f"{source}:{count}" for source, count in counts.items())
        return text

    @property
    def num_views(self) -> int:
        """Number of views V."""
        return len(self.projection_matrices)

    @property
    def source_positions(self) -> Tensor:
        """Positions of the focal spots in the world, (V, 3) in mm."""
        matrices = self.projection_matrices
        return torch.linalg.solve(matrices[:, :, :3], -matrices[:, :, 3:]).squeeze(-1)

    @property
    def detector_distances(self) -> Tensor:
        """Distances (V,) in mm from source to detector plane along its normal (SDD).

        The matrix determines the rays; the pixel spacing determines where the detector intersects them. One column
        changes the end of the ray by `depth * |M^-1 e_u|`, which equals du on the detector.

        Raises:
            ValueError: Row and column spacing give distances that differ by more than 2 %, so they do not fit the
                matrix. Calibrations of image intensifiers differ by up to 1 %.
        """
        steps = torch.linalg.inv(self.projection_matrices[:, :, :3])[:, :, :2].norm(dim=1)  # (V, 2): du, dv
        distances = steps.new_tensor(self.pixel_spacing[::-1]) / steps
        if bool(((distances[:, 0] / distances[:, 1] - 1).abs() > _LARGEST_ASPECT).any()):
            raise ValueError(f"pixel_spacing {self.pixel_spacing} does not fit the projection matrices' pixel aspect")
        return distances.mean(1)

    def rays(self) -> Tensor:
        """Vectors (V, rows, cols, 3) from source to pixel centre at depth 1 mm: `M^-1 (u, v, 1)`."""
        inverse = torch.linalg.inv(self.projection_matrices[:, :, :3])
        rows, cols = self.det_shape
        u = torch.arange(cols, dtype=inverse.dtype, device=inverse.device)
        v = torch.arange(rows, dtype=inverse.dtype, device=inverse.device)
        along_u = u[:, None] * inverse[:, None, None, :, 0]
        along_v = v[:, None, None] * inverse[:, None, None, :, 1]
        return along_u + along_v + inverse[:, None, None, :, 2]

    def pixel_positions(self) -> Tensor:
        """World positions (V, rows, cols, 3) in mm of the pixel centres, at `detector_distances` from the source."""
        return self.source_positions[:, None, None] + self.detector_distances[:, None, None, None] * self.rays()

    def obliquity(self) -> Tensor:
        """1 / cosine of the angle between ray and detector normal, (V, rows, cols): `|M^-1 (u, v, 1)|`."""
        return self.rays().norm(dim=-1)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel positions uv (..., V, N, 2), column first, and depths (..., V, N) in mm of world points (..., N, 3).

        Computed in double precision and returned in the points' dtype. Points behind the source have negative depths.
        """
        if points.ndim < 2 or points.shape[-1] != 3:
            raise ValueError(f"points must have shape (..., N, 3), got {tuple(points.shape)}")
        matrices = self.projection_matrices
        homogeneous = points.double().unsqueeze(-3) @ matrices[:, :, :3].mT + matrices[:, None, :, 3]
        depth = homogeneous[..., 2]
        return (homogeneous[..., :2] / depth.unsqueeze(-1)).to(points.dtype), depth.to(points.dtype)

    def facing(self, points: Tensor) -> ConeBeamGeometry:
        """The geometry with these world points (N, 3) in front of every source.

        If the front of the views is not known (see `knows_front`), the signs of the matrices are chosen so that the
        mean of the points has a positive depth.

        Raises:
            ValueError: A point lies at or behind a source.
        """
        return self._derived(turned_towards(self.projection_matrices, points, keep=self.knows_front))

    def select(self, views: Sequence[int] | slice) -> ConeBeamGeometry:
        """The geometry of selected views, in the order given, with their labels."""
        if isinstance(views, slice):
            views = range(self.num_views)[views]
        chosen = [int(view) for view in views]
        if not chosen or any(not -self.num_views <= view < self.num_views for view in chosen):
            raise ValueError(f"views must name some of the {self.num_views} views, got {chosen}")
        labels = {
            name: None if values is None else [values[view] for view in chosen]
            for name, values in (("sources", self.sources), ("angles_deg", self.angles_deg))
        }
        return self._derived(self.projection_matrices[chosen], **labels)

    def nearest_views(self, angles_deg: Sequence[float], sources: Sequence[str] | str | None = None) -> list[int]:
        """Indices of the views nearest to gantry angles (mod 360), optionally restricted to views of given sources.

        Of two views equally near, the first is taken.

        Args:
            angles_deg: Gantry angles to look for.
            sources: One source name for all angles, or one per angle.

        Raises:
            ValueError: The geometry lacks the labels, or no view has the given source.

        >>> from torchkcreg.geometry import MultisourceScanner
        >>> MultisourceScanner().geometry().nearest_views([91, 451, 91], sources=["T1", "T2", "T3"])
        [91, 90, 89]
        """
        if self.angles_deg is None or (sources is not None and self.sources is None):
            raise ValueError("nearest_views needs a geometry with angles_deg (and sources, to choose by source)")
        names = [sources] * len(angles_deg) if sources is None or isinstance(sources, str) else list(sources)
        if len(names) != len(angles_deg):
            raise ValueError(f"sources must have one entry for each of {len(angles_deg)} angles, got {len(names)}")
        nearest = []
        for angle, source in zip(angles_deg, names):
            candidates = [i for i in range(self.num_views) if source is None or (self.sources or ())[i] == source]
            if not candidates:
                raise ValueError(f"sources must be among {sorted(set(self.sources or ()))}, got {source!r}")
            # rounded, so that rounding errors do not decide between views equally near
            apart = [round(abs((self.angles_deg[i] - angle + 180) % 360 - 180), 9) for i in candidates]
            nearest.append(candidates[apart.index(min(apart))])
        return nearest

    def crop(self, rows: slice, cols: slice) -> ConeBeamGeometry:
        """The geometry of images cropped to `[rows, cols]`; the rays of the remaining pixels do not change."""
        starts, sizes = [], []
        for name, part, count in (("rows", rows, self.det_shape[0]), ("cols", cols, self.det_shape[1])):
            start, stop, step = part.indices(count)
            if step != 1 or stop <= start:
                raise ValueError(f"{name} must be a slice of step 1 that keeps some of {count}, got {part}")
            starts.append(start)
            sizes.append(stop - start)
        return self._derived(self._rescaled(starts, 1.0), det_shape=sizes)

    def bin(self, factor: int) -> ConeBeamGeometry:
        """The geometry of images averaged over blocks of `factor x factor` pixels; incomplete blocks are dropped.

        The centre of a binned pixel is the centre of its block: `u' = (u - (factor - 1)/2) / factor`.
        """
        if int(factor) != factor or not 1 <= factor <= min(self.det_shape):
            raise ValueError(f"factor must be an integer from 1 to {min(self.det_shape)}, got {factor}")
        matrices = self._rescaled([(factor - 1) / 2] * 2, 1 / factor)
        det_shape = [count // int(factor) for count in self.det_shape]
        return self._derived(matrices, det_shape=det_shape, pixel_spacing=[d * factor for d in self.pixel_spacing])

    def refined(self, factor: int) -> ConeBeamGeometry:
        """The geometry with pixels `factor` times finer, `u' = factor u + (factor - 1)/2`; undoes `bin`."""
        if int(factor) != factor or factor < 1:
            raise ValueError(f"factor must be a positive integer, got {factor}")
        matrices = self._rescaled([-(factor - 1) / (2 * factor)] * 2, factor)
        det_shape = [count * int(factor) for count in self.det_shape]
        return self._derived(matrices, det_shape=det_shape, pixel_spacing=[d / factor for d in self.pixel_spacing])

    def _rescaled(self, start: Sequence[float], factor: float) -> Tensor:
        """Matrices for pixels `(uv - start) * factor`; start is (v, u)."""
        matrices = self.projection_matrices
        change = torch.diag(matrices.new_tensor([factor, factor, 1.0]))
        change[0, 2], change[1, 2] = -start[1] * factor, -start[0] * factor
        return change @ matrices

    def moved(self, transform: Tensor) -> ConeBeamGeometry:
        """The geometry for a world moved by an affine transform (4, 4), or (V, 4, 4) for one per view: `P T`.

        `geometry.moved(T).project(x)` is `geometry.project(T x)`: moving the implant by T is the same as moving the
        gantry by its inverse.
        """
        if tuple(transform.shape) not in ((4, 4), (self.num_views, 4, 4)):
            raise ValueError(f"transform must have shape (4, 4) or (V, 4, 4), got {tuple(transform.shape)}")
        return self._derived(checked_matrices(self.projection_matrices @ transform.to(self.projection_matrices)))
