"""Geometric calibration: the detector's true position from the tracks of beads across the views of a scan."""

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

LIKELY_SHIFT_MM = 20.0  # prior standard deviations of the detector's nominal position
LIKELY_DISTANCE = 0.05  # relative to the source-detector distance
LIKELY_TURN_DEG = 2.0
LEAST_NOISE_PX = 0.02
PARAMETERS = ("shift_u_mm", "shift_v_mm", "shift_depth_mm", "turn_u_deg", "turn_v_deg", "turn_normal_deg")


@dataclass(frozen=True)
class Calibration:
    """A geometry calibrated with the tracks of beads.

    Attributes:
        geometry: The calibrated views.
        beads: Bead positions in the world, (N, 3) mm.
        detector: Displacement of the detector from its nominal position, the same in all views: shifts along u, along
            v and away from the source in mm; rotations about its column axis, row axis and normal (which points away
            from the source) in degrees.
        deviations: Standard deviations of these six numbers, from the scatter of the residuals. Where the tracks hold
            no information it is that of the prior.
        residuals: Measured minus modelled positions (V, N, 2) in pixels, NaN where a bead was not seen.
        median_px: Median length of the residuals in pixels.
        before_px: The same for the nominal geometry with best-fitting beads.
    """

    geometry: ConeBeamGeometry
    beads: Tensor
    detector: dict[str, float]
    deviations: dict[str, float]
    residuals: Tensor
    median_px: float
    before_px: float


def calibrate(geometry: ConeBeamGeometry, tracks: Tensor) -> Calibration:
    """Fit the detector's position and the bead positions to the tracks of beads.

    The gantry angles and the source-axis distance are taken as known; they set the scale. The detector is displaced
    from its nominal position as one rigid body, in the same way in all views. Its six parameters and the bead positions
    are fitted by robust least squares, which gives outliers little weight. A weak prior holds parameters that the
    tracks do not determine near their nominal values. Two beads at different heights determine all but the tilts
    (rotations about u and v).

    Args:
        geometry: Nominal geometry, such as a `circular_geometry` of measured lengths.
        tracks: Position (u, v) of each bead in each view in pixels, (V, N, 2); NaN where it was not seen.

    Raises:
        ValueError: The tracks have another shape, a bead is seen in fewer than three views, or the geometry does not
            fit: the median residual stays above 2 % of the detector's longer side.

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
    nominal = fit.solved(start, free=slice(6, None))
    before = float(np.median(fit.lengths(nominal)))
    best = fit.solved(nominal, free=slice(0, None))
    lengths = fit.lengths(best)
    if (median := float(np.median(lengths))) > 0.02 * max(geometry.det_shape):
        raise ValueError(
            f"no detector position fits the tracks: the median residual is {median:.1f} px; check the gantry angles "
            "and the direction of rotation"
        )
    residuals = np.full(measured.shape, np.nan)
    residuals[seen] = fit.residuals(best)
    detector, deviations = (
        dict(zip(PARAMETERS, values.tolist(), strict=True)) for values in (best[:6], fit.deviations(best))
    )
    beads = torch.from_numpy(best[6:].reshape(-1, 3))
    return Calibration(fit.placed(best), beads, detector, deviations, torch.from_numpy(residuals), median, before)


class _Fit:
    """Least-squares fit of tracks (V, N, 2); the parameters x are the detector's six, then the bead positions."""

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
        """The geometry with the detector displaced by the parameters."""
        geometry, move = self.geometry, torch.from_numpy(x[:6])
        turn = rotation_from_vector(self.frames @ move[3:].deg2rad())
        dv, du = geometry.pixel_spacing
        across, down, _ = (turn @ self.frames).unbind(-1)
        moved = DetectorFrames(self.sources, self.centers + self.frames @ move[:3], du * across, dv * down)
        return moved.geometry(geometry.det_shape, sources=geometry.sources, angles_deg=geometry.angles_deg)

    def residuals(self, x: NDArray) -> NDArray:
        """Measured minus modelled positions (n, 2) in pixels, of the bead images that were seen."""
        uv, _ = self.placed(x).project(torch.from_numpy(x[6:].reshape(-1, 3)))
        return (self.measured - uv.numpy())[self.seen]

    def lengths(self, x: NDArray) -> NDArray:
        """Lengths (n,) of the residuals, pixels."""
        return np.linalg.norm(self.residuals(x), axis=-1)

    def solved(self, start: NDArray, *, free: slice) -> NDArray:
        """Best-fitting parameters, only `free` ones varied; fitted twice, as the first fit estimates the noise."""
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
        """Point (N, 3) closest to all rays of each bead's track."""
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
