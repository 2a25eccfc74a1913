"""Conversion of detector counts to line integrals."""

from __future__ import annotations

import torch
from torch import Tensor

COUNT_FLOOR = 0.5


def line_integrals_from_intensity(
    intensity: Tensor,
    open_beam: Tensor | float,
    *,
    floor: float = COUNT_FLOOR,
    saturation: float | None = None,
) -> tuple[Tensor, Tensor]:
    """Line integrals `-ln(I / I0)` and the mask of valid pixels.

    Intensities below `floor` are raised to `floor`, by default half a count: the largest value that an integer detector
    rounds to zero. So every line integral is finite, at most ln(I0 / floor), and never NaN.

    Args:
        intensity: Detector counts, `(V, rows, cols)`, integer or floating.
        open_beam: Counts of the unattenuated beam: one number, one per view `(V,)`, or an image that broadcasts.
        floor: Smallest count; lower ones are raised to it.
        saturation: Counts from this value on are saturated. None if the detector does not saturate.

    Returns:
        Line integrals, float32 (float64 for float64 counts), and a boolean mask of the same shape: False where the
        count is not above zero, not finite, or saturated.

    Raises:
        ValueError: If the open beam or the floor is not positive, or the open beam's shape does not match the views.

    >>> line_integrals, valid = line_integrals_from_intensity(torch.tensor([[[1000, 0, 368]]]), 1000.0)
    >>> valid.tolist()
    [[[True, False, True]]]
    """
    dtype = torch.float64 if intensity.dtype == torch.float64 else torch.float32
    counts = intensity.to(dtype)
    beam = torch.as_tensor(open_beam, dtype=dtype, device=counts.device)
    if beam.dim() == 1 and counts.dim() == 3:
        beam = beam[:, None, None]
    if not floor > 0:
        raise ValueError(f"floor must be positive, got {floor}")
    if not bool((beam > 0).all()):
        raise ValueError(f"open_beam must be positive, got {float(beam.min()):g}")
    try:
        beam = beam.broadcast_to(counts.shape)
    except RuntimeError as error:
        shapes = f"{tuple(beam.shape)} for intensity {tuple(counts.shape)}"
        raise ValueError(f"open_beam must be one number, one a view or an image, got shape {shapes}") from error
    valid = torch.isfinite(counts) & (counts > 0)
    if saturation is not None:
        valid &= counts < saturation
    counts = torch.nan_to_num(counts, nan=floor, neginf=floor).clamp_min(floor)
    return beam.log() - counts.log(), valid
