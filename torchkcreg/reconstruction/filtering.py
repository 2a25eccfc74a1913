"""The ramp filter of filtered back-projection: windows, kernels, and rows that the detector cuts off."""

from __future__ import annotations

import math

import torch
from torch import Tensor

WINDOWS = ("ram-lak", "shepp-logan", "cosine", "hamming", "hann")
EDGE_PIXELS = 4  # averaged for the value that a truncated row goes on with, so that it is not one pixel's noise


def ramp_response(
    length: int, spacing: float, *, window: str = "ram-lak", cutoff: float = 1.0, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Frequency response (length // 2 + 1,) of the band-limited ramp |f|, in 1/mm, times a window.

    The response is the transform of the sampled kernel ``h(0) = 1 / (4 d^2)``, ``h(n) = -1 / (pi n d)^2`` for odd n
    and 0 for even n (Kak and Slaney 1988, eq. 3.61), times d: sampling |f| itself would lose the mean of the image.

    Args:
        length: samples of the padded row.
        spacing: distance d between samples, mm.
        window: "ram-lak" (none), "shepp-logan", "cosine", "hamming" or "hann".
        cutoff: frequency, as a share of the highest one, where the window ends; beyond it the response is 0.
        dtype: of the result.

    Raises:
        ValueError: an unknown window, or a cutoff outside (0, 1].

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
    """Values of a window at frequencies given as shares of its end."""
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
    extrapolate: tuple[bool, bool] = (True, True),
) -> Tensor:
    """Images (..., cols) convolved with the ramp along their rows; in the images' unit over mm.

    Args:
        images: cosine-weighted projections.
        spacing: distance between columns, mm, where the reconstruction formula wants it: on the axis of rotation.
        window: see `ramp_response`.
        cutoff: see `ramp_response`.
        extrapolate: before the first and after the last column, go on beyond the detector with the border's value,
            falling to 0 along a cosine over half the detector's width, so that an object larger than the detector does
            not end in a bright rim. Where the border is air nothing changes.

    >>> rows = filter_rows(torch.ones(2, 256), 0.5)
    >>> bool(rows[0, 128].abs() < 0.02)
    True
    """
    cols = images.shape[-1]
    before, after = (cols // 2 if wanted else 0 for wanted in extrapolate)
    padded = torch.cat([_tail(images, before).flip(-1), images, _tail(images.flip(-1), after)], -1)
    length = 1 << max(1, math.ceil(math.log2(2 * padded.shape[-1])))
    response = ramp_response(length, spacing, window=window, cutoff=cutoff, dtype=images.dtype).to(images.device)
    filtered = torch.fft.irfft(torch.fft.rfft(padded, length) * response, length)
    return filtered[..., before : before + cols].contiguous()


def _tail(images: Tensor, extra: int) -> Tensor:
    """What comes before the first column, nearest first: its value going to 0 along a cosine, (..., extra)."""
    steps = torch.arange(1, extra + 1, dtype=images.dtype, device=images.device) / (extra + 1)
    edge = images[..., : min(EDGE_PIXELS, images.shape[-1])].mean(-1, keepdim=True)
    return edge * (0.5 + 0.5 * torch.cos(math.pi * steps))
