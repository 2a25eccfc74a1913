"""Filtered back-projection of cone-beam scans (Feldkamp, Davis and Kress 1984), with one or several focal spots."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid, transform_points
from torchkcreg.options import Config
from torchkcreg.projector import backproject_weighted

from .axial_frame import axial_frame, columns_and_rows, is_aligned, rectified
from .field_of_view import coverage, height_shares, views_by_source
from .redundancy import LineCoverage, angular_sampling
from .scan_views import ViewShard

WINDOWS = ("ram-lak", "shepp-logan", "cosine", "hamming", "hann")
EDGE_PIXELS = 4  # averaged for the value that extends a truncated row, to reduce noise
NOTICEABLE = 0.002  # share of unmeasured lines that is worth a warning
UNMEASURED = 0.04  # share that makes FDK wrong
BLOCK_VIEWS = 16  # filtered together, to bound memory
Views = Callable[[list[int]], Tensor]  # returns the images of the given views


def ramp_response(
    length: int, spacing: float, *, window: str = "ram-lak", cutoff: float = 1.0, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Frequency response (length // 2 + 1,) of the band-limited ramp |f|, in 1/mm, times a window.

    The response is the transform of the sampled kernel `h(0) = 1 / (4 d^2)`, `h(n) = -1 / (pi n d)^2` for odd n
    and 0 for even n (Kak and Slaney 1988, eq. 3.61), times d. Sampling |f| directly would lose the image's mean.

    Args:
        length: Number of samples of the padded row.
        spacing: Distance d between samples, mm.
        window: "ram-lak" (none), "shepp-logan", "cosine", "hamming" or "hann".
        cutoff: Frequency where the window ends, as a fraction of the highest one; the response beyond it is 0.
        dtype: Type of the result.

    Raises:
        ValueError: If the window is unknown or the cutoff is outside (0, 1].

    >>> response = ramp_response(64, 0.5)
    >>> round(float(response[32]), 2), bool(response[0] > 0)
    (0.99, True)
    """
    if window not in WINDOWS:
        raise ValueError(f"window must be one of {', '.join(WINDOWS)}, got {window!r}")
    if not 0 < cutoff <= 1:
        raise ValueError(f"cutoff must be in (0, 1], got {cutoff}")
    offsets = torch.arange(length, dtype=torch.float64)
    offsets = torch.minimum(offsets, length - offsets)
    odd = offsets % 2 == 1
    kernel = torch.where(odd, -1 / (math.pi * offsets.clamp_min(1)) ** 2, torch.zeros_like(offsets))
    kernel[0] = 0.25
    response = torch.fft.rfft(kernel / spacing).real
    share = torch.arange(length // 2 + 1, dtype=torch.float64) / (length / 2) / cutoff
    return torch.where(share <= 1, response * _window(window, share.clamp(max=1)), torch.zeros_like(response)).to(dtype)


def _window(name: str, share: Tensor) -> Tensor:
    """Values of a window at frequencies given as fractions of its end."""
    if name == "shepp-logan":
        return torch.sinc(share / 2)
    if name == "cosine":
        return torch.cos(math.pi / 2 * share)
    if name == "hamming":
        return 0.54 + 0.46 * torch.cos(math.pi * share)
    if name == "hann":
        return 0.5 + 0.5 * torch.cos(math.pi * share)
    return torch.ones_like(share)


def filter_rows(
    images: Tensor,
    spacing: float,
    *,
    window: str = "ram-lak",
    cutoff: float = 1.0,
    extrapolate: bool = True,
    beyond: tuple[int, int] = (0, 0),
) -> Tensor:
    """Ramp-filtered images (..., before + cols + after), convolved along their rows; unit of the images per mm.

    Args:
        images: Cosine-weighted projections.
        spacing: Distance between columns at the axis of rotation, mm.
        window: See `ramp_response`.
        cutoff: See `ramp_response`.
        extrapolate: If true, extend the rows by the border's value, falling to 0 along a cosine over half the
            detector's width. This avoids a bright rim if the object is larger than the detector. Where the border is
            air nothing changes.
        beyond: Number of columns (before the first, after the last) of the result that the images do not have.

    >>> rows = filter_rows(torch.ones(2, 256), 0.5)
    >>> bool(rows[0, 128].abs() < 0.02)
    True
    """
    cols = images.shape[-1]
    extra = cols // 2 if extrapolate else 0
    padded = torch.cat([_tail(images, extra).flip(-1), images, _tail(images.flip(-1), extra)], -1)
    more = [max(0, asked - extra) for asked in beyond]
    padded = pad(padded, (more[0], more[1]))
    length = 1 << max(1, math.ceil(math.log2(2 * padded.shape[-1])))
    response = ramp_response(length, spacing, window=window, cutoff=cutoff, dtype=images.dtype).to(images.device)
    filtered = torch.fft.irfft(torch.fft.rfft(padded, length) * response, length)
    first = max(extra, beyond[0]) - beyond[0]
    return filtered[..., first : first + beyond[0] + cols + beyond[1]].contiguous()


def _tail(images: Tensor, extra: int) -> Tensor:
    """Extension (..., extra) before the first column, nearest first: its value falling to 0 along a cosine."""
    steps = torch.arange(1, extra + 1, dtype=images.dtype, device=images.device) / (extra + 1)
    edge = images[..., : min(EDGE_PIXELS, images.shape[-1])].mean(-1, keepdim=True)
    return edge * (0.5 + 0.5 * torch.cos(math.pi * steps))


class FDKConfig(Config):
    """Options of `fdk`.

    Attributes:
        window: Window of the ramp: "ram-lak", "shepp-logan", "cosine", "hamming" or "hann".
        cutoff: End of the window, as a fraction of the highest frequency.
        extrapolate: Extend rows truncated by the detector smoothly.
        combine: Reconstruct one volume per focal spot and blend them by height; otherwise all views are treated as one
            scan.
    """

    window: str = "ram-lak"
    cutoff: float = 1.0
    extrapolate: bool = True
    combine: bool = True


def fdk(
    projections: Tensor | Views,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    *,
    config: FDKConfig | None = None,
    shard: ViewShard | None = None,
    backend: str = "auto",
) -> Tensor:
    """Filtered back-projection: attenuation (..., D, H, W) in 1/mm from line integrals (..., V, rows, cols).

    `f(x) = sum_v db_v (R / depth_v(x))^2 q_v(u, v)`. Here q is the projection times `R / sqrt(R^2 + p^2 + zeta^2)`
    and the redundancy weight, ramp-filtered along p. The positions p and zeta are in mm on the virtual detector through
    the axis of rotation, and R is the source-to-axis distance. Views may be in any order and at any angles around the
    world's z axis, over a full turn or less, with gaps, of centred or offset detectors: lines measured twice share
    their weight (`LineCoverage`). If more than 0.2 % of the lines at some distance from the axis were never measured,
    there is a warning. Tilted detectors are resampled first.

    With several focal spots (`geometry.sources`) a volume is reconstructed for each; it is exact in the plane of the
    spot. Between the heights of two focal spots their volumes are blended smoothly, each weighted by how completely it
    sees the voxel (`height_shares`). This keeps the cone angle small over the whole height.

    Args:
        projections: Line integrals (..., V, rows, cols); masked pixels must be filled. For scans larger than memory, a
            function that returns the line integrals (v, rows, cols) of a list of views; each view is requested once.
        geometry: The views. If the gantry does not rotate about the world's z axis, align it first with `moved`.
        grid: The voxels.
        config: Window, extrapolation and combination of focal spots.
        shard: Views that this process works on, see `ViewShard`; every process gets the complete result.
        backend: Back-projection backend.

    Raises:
        ValueError: If shapes do not match, values are not finite, no view sees the grid, or more than 4 % of the lines
            at some distance from the axis were never measured.

    >>> import torch
    >>> from torchkcreg.geometry import VolumeGrid, circular_geometry
    >>> geometry = circular_geometry(range(0, 360, 20), sad=404, sdd=538, det_shape=(9, 33), pixel_spacing=(2.0, 2.0))
    >>> grid = VolumeGrid.centered((1, 9, 9), 2.0)
    >>> fdk(torch.zeros(18, 9, 33), geometry, grid).abs().max().item()
    0.0
    """
    config = config or FDKConfig()
    if isinstance(projections, Tensor):
        check_projections(projections, geometry)
    images = projections
    read = images if callable(images) else lambda views: images[..., views, :, :]
    seen = coverage(geometry, grid)
    if not bool((seen > 0).any()):
        raise ValueError("grid lies outside the field of view: no view sees any of its voxels")
    groups = views_by_source(geometry) if config.combine else [list(range(geometry.num_views))]
    if len(groups) == 1:
        return _single_spot(read, geometry, grid, config, shard, backend)
    parts = [geometry.select(views) for views in groups]
    shares = height_shares(parts, grid)

    def of_spot(number: int) -> Tensor:
        views, part = groups[number], parts[number]
        local_shard = shard.within(views) if shard is not None else None
        volume = _single_spot(lambda block: read([views[i] for i in block]), part, grid, config, local_shard, backend)
        return volume.mul_(shares[number].to(volume))

    total = of_spot(0)
    for number in range(1, len(groups)):
        total += of_spot(number)
    return total


@dataclass(frozen=True)
class _Plan:
    """Weights and filter options of the views of one focal spot.

    `weights` (V, cols) are the product of redundancy weight, angular step and R^2. `beyond` is the number of columns
    added before and after the detector's columns, and `matrices` are the projection matrices of the wider detector.
    """

    radii: Tensor
    columns: Tensor
    rows: Tensor
    weights: Tensor
    matrices: Tensor
    beyond: tuple[int, int]


def _single_spot(
    read: Views,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    config: FDKConfig,
    shard: ViewShard | None,
    backend: str,
) -> Tensor:
    """FDK of the views of one focal spot."""
    is_tilted, measured = not is_aligned(axial_frame(geometry), geometry.det_shape), geometry
    if is_tilted:
        geometry, resampled = rectified(geometry)
    plan = _plan(geometry, grid)
    views = list(range(geometry.num_views)) if shard is None else shard.views
    volume = None
    for start in range(0, len(views), BLOCK_VIEWS):
        block = views[start : start + BLOCK_VIEWS]
        images = read(block)
        check_projections(images, measured, len(block))
        filtered = _filtered(resampled(images, block) if is_tilted else images, plan, block, config)
        part = backproject_weighted(filtered, grid, plan.matrices[block], backend=backend)
        volume = part if volume is None else volume.add_(part)
    if volume is None:  # more processes than views
        images = read([0])
        volume = images.new_zeros(*images.shape[:-3], *grid.shape)
    return volume if shard is None else shard.sum(volume)


def _plan(geometry: ConeBeamGeometry, grid: VolumeGrid) -> _Plan:
    frame = axial_frame(geometry)
    columns, rows = columns_and_rows(frame, geometry.det_shape)
    radii = frame.radii[:, None]
    sampling, fans = angular_sampling(frame.angles.cpu()), (columns / radii).atan().cpu()
    lines = LineCoverage(sampling, fans)
    _check_coverage(lines, float(frame.radii.mean()), grid)
    # the short side of an offset detector: filtered signal beyond it contributes
    first, last = -float(columns[0, 0]), float(columns[0, -1])
    missing = round((last - first) / float(columns[0, 1] - columns[0, 0]))
    beyond = (max(missing, 0), max(-missing, 0))
    weights = (lines.weights() * sampling.steps[:, None]).to(columns) * radii**2
    matrices = geometry.projection_matrices.clone()
    matrices[:, 0] += beyond[0] * matrices[:, 2]
    return _Plan(frame.radii, columns, rows, weights, matrices, beyond)


def _check_coverage(lines: LineCoverage, radius: float, grid: VolumeGrid) -> None:
    """Warn or refuse if lines through the grid were never measured."""
    ends = [torch.tensor([0.0, n - 1], dtype=torch.float64) for n in reversed(grid.shape)]
    corners = transform_points(grid.voxel_to_world.double(), torch.cartesian_prod(*ends))
    reach = float(corners[:, :2].abs().amax())  # of the circle in the grid: scans rarely see its corners
    widest = math.asin(min(1.0, reach / radius))
    missing, fan = lines.unmeasured(widest)
    text = (
        f"no view measures {100 * missing:.1f} % of the lines at {radius * math.sin(fan):.0f} mm from the axis of "
        f"rotation: the views cover {lines.sampling.covered_deg:.0f} degrees"
    )
    if missing > UNMEASURED:
        raise ValueError(f"{text}; FDK needs 180 degrees plus the fan angle, or a full turn with an offset detector")
    if missing > NOTICEABLE:
        warnings.warn(f"{text}; expect streaks", stacklevel=5)


def _filtered(images: Tensor, plan: _Plan, views: list[int], config: FDKConfig) -> Tensor:
    """Projections (..., v, rows, cols) weighted, ramp-filtered and widened."""
    columns = plan.columns[views]
    radii = plan.radii[views][:, None, None]
    distance = (radii**2 + columns[:, None] ** 2 + plan.rows[views][:, :, None] ** 2).sqrt()
    weighted = images * (radii / distance * plan.weights[views][:, None]).to(images)
    pitches = (columns[:, 1:] - columns[:, :-1]).abs().mean(1)
    pitch = float(pitches.mean())
    filtered = filter_rows(
        weighted,
        pitch,
        window=config.window,
        cutoff=config.cutoff,
        extrapolate=config.extrapolate,
        beyond=plan.beyond,
    )
    return filtered * (pitch / pitches)[:, None, None].to(images)  # the ramp scales with one over the pitch


def check_projections(projections: Tensor, geometry: ConeBeamGeometry, num_views: int | None = None) -> None:
    """Check that projections are finite and match the detector and `num_views` (default: the geometry's).

    Raises:
        ValueError: If they do not.
    """
    expected = (geometry.num_views if num_views is None else num_views, *geometry.det_shape)
    if projections.dim() < 3 or tuple(projections.shape[-3:]) != expected:
        raise ValueError(
            f"projections must have shape (..., V, rows, cols) = {expected}, got {tuple(projections.shape)}"
        )
    if expected[2] < 2:
        raise ValueError(f"FDK filters along rows and needs at least 2 columns, got {expected[2]}")
    if not projections.is_floating_point():
        raise ValueError(f"projections must be floating point, got {projections.dtype}")
    if not bool(projections.isfinite().all()):
        bad = int((~projections.isfinite()).sum())
        raise ValueError(f"projections must be finite, got {bad} values that are not")
