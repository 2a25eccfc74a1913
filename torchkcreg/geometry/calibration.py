"""Where the detector really stands: calibration of a scan's geometry from the tracks of beads across its views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from .cone_beam import ConeBeamGeometry
from .frames import DetectorFrames
from .se3 import rotation_from_vector

LIKELY_SHIFT_MM = 20.0  # standard deviations of what is told about a detector's place
LIKELY_DISTANCE = 0.05  # as a share of the distance from the source
LIKELY_TURN_DEG = 2.0
LEAST_NOISE_PX = 0.02
PARAMETERS = ("shift_u_mm", "shift_v_mm", "shift_depth_mm", "turn_u_deg", "turn_v_deg", "turn_normal_deg")


@dataclass(frozen=True)
class Calibration:
    """A geometry made to fit the tracks of beads.

    Attributes:
        geometry: the views as they were found to be.
        beads: positions in the world, (N, 3) mm.
        detector: by how much the detector stands elsewhere, the same in all views: shifts along columns (u), rows (v)
            and away from the source in mm; turns about its column axis, row axis and normal (away from the source)
            in degrees.
        deviations: their standard deviations, from the tracks' own scatter; a likely misplacement's where the tracks
            say nothing.
        residuals: measured less modelled positions (V, N, 2) in pixels, NaN where a bead was not seen.
        median_px: median length of the residuals, pixels.
        before_px: the same of the geometry as it was told, with the beads where they fit it best.
    """

    geometry: ConeBeamGeometry
    beads: Tensor
    detector: dict[str, float]
    deviations: dict[str, float]
    residuals: Tensor
    median_px: float
    before_px: float


def calibrate(geometry: ConeBeamGeometry, tracks: Tensor) -> Calibration:
    """The place of the detector in which tracks of beads fit best, and the beads' places.

    The gantry's angles and the distance of the source from the axis count as known: they set the unit of length. The
    detector moves as one rigid body, in the same way in all views, from where the geometry has it; a robust least
    squares fit of its six parameters and of the beads' positions counts outliers little, and holds what the tracks do
    not tell near what was told. Two beads at different heights are enough for all but the tilts (turns about u and v).

    Args:
        geometry: as it is told, such as a `circular_geometry` of measured lengths.
        tracks: position (u, v) of each bead in each view, pixels, (V, N, 2); NaN where it was not seen.

    Raises:
        ValueError: tracks of another shape, a bead that fewer than three views see, or tracks that the geometry does
            not fit at all: residuals stay above two hundredths of the detector.

    >>> from torchkcreg.geometry import circular_geometry
    >>> angles, size = range(0, 360, 10), {"sad": 404, "sdd": 538, "det_shape": (64, 64), "pixel_spacing": (2.0, 2.0)}
    >>> truth = circular_geometry(angles, det_offset_mm=(0.0, 3.0), **size)
    >>> beads = torch.tensor([[10.0, 5.0, -20.0], [-15.0, 8.0, 20.0]], dtype=torch.float64)
    >>> found = calibrate(circular_geometry(angles, **size), truth.project(beads)[0])
    >>> round(found.detector["shift_u_mm"], 2), [round(x, 1) for x in found.beads[0].tolist()]
    (3.0, [10.0, 5.0, -20.0])
    """
    measured = torch.as_tensor(tracks).detach().cpu().double().numpy()
    if measured.ndim != 3 or measured.shape[0] != geometry.num_views or measured.shape[2] != 2 or measured.shape[1] < 1:
        raise ValueError(f"tracks must have shape ({geometry.num_views}, N, 2), got {measured.shape}")
    seen = np.isfinite(measured).all(-1)
    if (seen.sum(0) < 3).any():
        raise ValueError(f"each bead must be seen in three views or more, got {seen.sum(0).tolist()}")
    fit = _Fit(geometry, measured, seen)
    start = np.concatenate([np.zeros(6), fit.triangulated(geometry).ravel()])
    told = fit.solved(start, free=slice(6, None))
    before = float(np.median(fit.lengths(told)))
    best = fit.solved(told, free=slice(0, None))
    lengths = fit.lengths(best)
    if (median := float(np.median(lengths))) > 0.02 * max(geometry.det_shape):
        raise ValueError(
            f"no place of the detector fits the tracks: they stay {median:.1f} px off; are the angles, and the sense "
            "in which they count, those of the views?"
        )
    residuals = np.full(measured.shape, np.nan)
    residuals[seen] = fit.residuals(best)
    detector, deviations = (
        dict(zip(PARAMETERS, values.tolist(), strict=True)) for values in (best[:6], fit.deviations(best))
    )
    beads = torch.from_numpy(best[6:].reshape(-1, 3))
    return Calibration(fit.placed(best), beads, detector, deviations, torch.from_numpy(residuals), median, before)


class _Fit:
    """Residuals of tracks (V, N, 2) for the detector's six parameters and the beads' positions, one vector."""

    def __init__(self, geometry: ConeBeamGeometry, measured: NDArray, seen: NDArray) -> None:
        self.geometry, self.measured, self.seen = geometry, measured, seen
        frames = DetectorFrames.of(geometry)
        self.sources, self.centers = frames.sources.cpu(), frames.centers.cpu()
        across, down = (torch.nn.functional.normalize(x.cpu(), dim=-1) for x in (frames.col_steps, frames.row_steps))
        normal = torch.linalg.cross(across, down)
        away = ((self.centers - self.sources) * normal).sum(-1, keepdim=True).sign()
        self.frames = torch.stack([across, down, away * normal], dim=-1)
        scale = float(geometry.detector_distances.mean())
        self.likely = np.array([*[LIKELY_SHIFT_MM] * 2, LIKELY_DISTANCE * scale, *[LIKELY_TURN_DEG] * 3])
        self.noise = 1.0

    def placed(self, x: NDArray) -> ConeBeamGeometry:
        """The geometry with the detector in its place."""
        geometry, move = self.geometry, torch.from_numpy(x[:6])
        turn = rotation_from_vector(self.frames @ move[3:].deg2rad())
        dv, du = geometry.pixel_spacing
        across, down, _ = (turn @ self.frames).unbind(-1)
        moved = DetectorFrames(self.sources, self.centers + self.frames @ move[:3], du * across, dv * down)
        return moved.geometry(geometry.det_shape, sources=geometry.sources, angles_deg=geometry.angles_deg)

    def residuals(self, x: NDArray) -> NDArray:
        """Measured less modelled, pixels, of what was seen, (n, 2)."""
        uv, _ = self.placed(x).project(torch.from_numpy(x[6:].reshape(-1, 3)))
        return (self.measured - uv.numpy())[self.seen]

    def lengths(self, x: NDArray) -> NDArray:
        return np.linalg.norm(self.residuals(x), axis=-1)

    def solved(self, start: NDArray, *, free: slice) -> NDArray:
        """The parameters that fit best, some of them free; twice, as the first fit tells how large the noise is."""
        x = start.copy()

        def cost(values: NDArray) -> NDArray:
            x[free] = values
            likely = self.noise * x[:6] / self.likely
            return np.concatenate([self.residuals(x).ravel(), likely])

        for _ in range(2):
            x[free] = least_squares(cost, x[free], loss="soft_l1", f_scale=2 * self.noise, x_scale="jac").x
            self.noise = max(LEAST_NOISE_PX, 1.4826 * float(np.median(np.abs(self.residuals(x)))))
        return x

    def deviations(self, x: NDArray) -> NDArray:
        """Standard deviations of the detector's parameters."""
        base, columns = self.residuals(x).ravel(), []
        for index in range(len(x)):
            step = np.zeros_like(x)
            step[index] = 1e-3
            columns.append((self.residuals(x + step).ravel() - base) / 1e-3)
        jacobian = np.stack(columns, axis=-1) / self.noise
        information = jacobian.T @ jacobian
        information[range(6), range(6)] += 1 / self.likely**2
        return np.sqrt(np.diag(np.linalg.pinv(information))[:6])

    def triangulated(self, geometry: ConeBeamGeometry) -> NDArray:
        """Where the rays of each bead's track come closest to each other, (N, 3)."""
        inverse = torch.linalg.inv(geometry.projection_matrices.detach().cpu()[:, :, :3]).numpy()
        points = []
        for bead in range(self.measured.shape[1]):
            views = self.seen[:, bead]
            pixels = np.concatenate([self.measured[views, bead], np.ones((views.sum(), 1))], axis=1)
            rays = np.einsum("vij,vj->vi", inverse[views], pixels)
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
            towards = (across @ self.sources.numpy()[views][..., None]).sum(0)
            points.append(np.linalg.solve(across.sum(0), towards)[:, 0])
        return np.stack(points)
