"""Preparation of measured transmissions for reconstruction: corrected line integrals and weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import Veil

from .corrections import floored_line_integrals, scatter_image
from .inpainting import filled_transmission
from .kcrec import component_shares, without_components
from .spectral import BeamModel


def statistical_weights(
    primary: Tensor,
    *,
    scatter: Tensor | float = 0.0,
    mask: Tensor | None = None,
    noise: float = 0.0,
    sensitivity: Tensor | float = 1.0,
) -> Tensor:
    """Inverse variance of line integrals l, relative to the open beam: 1 in air, exp(-l) behind an object.

    The variance of a count equals its mean `primary + scatter` (Poisson). The variance of the line integral
    `-ln primary` is that over `primary^2`, so `w = primary^2 / (primary + scatter + noise)`.

    Args:
        primary: Intensity without scatter, in units of the open beam, any shape.
        scatter: Scatter subtracted before the logarithm, same unit.
        mask: 0 where a pixel holds no measurement.
        noise: Variance of the electronic noise in counts squared, over the counts of the open beam.
        sensitivity: Derivative of the measured line integral by the reconstructed one, if they differ (beam hardening);
            the weights are multiplied by its square.

    >>> statistical_weights(torch.tensor([1.0, 0.5])).tolist()
    [1.0, 0.5]
    """
    primary = primary.clamp_min(0)
    total = (primary + scatter + noise).clamp_min(torch.finfo(primary.dtype).tiny)
    weights = primary * (primary / total) * torch.as_tensor(sensitivity).to(primary) ** 2
    return weights if mask is None else weights * mask


@dataclass(frozen=True)
class PreparedData:
    """Line integrals to reconstruct, and their statistical weights.

    Attributes:
        line_integrals: Line integrals of the background at the beam's reference energy, (V, rows, cols).
        weights: Statistical weights, same shape, not negative.
    """

    line_integrals: Tensor
    weights: Tensor


def prepare(
    transmission: Tensor,
    geometry: ConeBeamGeometry,
    beam: BeamModel,
    *,
    components: Sequence[KnownComponent] = (),
    shares: Sequence[tuple[slice, Tensor]] | None = None,
    scatter: Veil | Tensor | None = None,
    mask: Tensor | None = None,
    floor: float = 1e-3,
    noise: float = 0.0,
    blur_sigma_px: float = 0.0,
    mineral: Tensor | None = None,
    oversampling: int = 4,
    backend: str = "auto",
) -> PreparedData:
    """Subtract scatter, take the logarithm, and correct for known components and beam hardening.

    With `components` the line integrals are those of everything except the components (KC-Rec), otherwise those of the
    whole object. In both cases the background's beam hardening is corrected with the beam model; a
    `BeamModel.monoenergetic` corrects nothing. The weights differ only by the derivative of the hardening.

    Args:
        transmission: Measured intensity over the open beam's, (V, rows, cols).
        geometry: The views.
        beam: Beam with the attenuation of the components' materials.
        components: Registered metal components.
        shares: `component_shares` of these, if already computed or from your own projector.
        scatter: A fitted or given veil, or an image of the scatter in units of the open beam.
        mask: 0 where a pixel holds no measurement; such pixels are filled from neighbours (`filled`) and get weight 0.
        floor: Smallest transmission used, see `floored_line_integrals`.
        noise: See `statistical_weights`.
        blur_sigma_px: The system's blur for the components' projections, detector pixels.
        mineral: Line integrals of mineral, (V, rows, cols), from an earlier reconstruction; see `mineral_part`.
        oversampling: Sub-pixels along each side of a pixel for the components' projections.
        backend: Projector backend.

    >>> import torch
    >>> from torchkcreg.geometry import circular_geometry
    >>> geometry = circular_geometry([0, 90], sad=404, sdd=538, det_shape=(4, 4), pixel_spacing=(2.0, 2.0))
    >>> data = prepare(torch.full((2, 4, 4), 0.5), geometry, BeamModel.monoenergetic([]))
    >>> round(float(data.line_integrals[0, 0, 0]), 4), round(float(data.weights[0, 0, 0]), 4)
    (0.6931, 0.5)
    """
    expected = (geometry.num_views, *geometry.det_shape)
    if mask is not None:
        transmission = filled_transmission(transmission, mask)
    if tuple(transmission.shape) != expected or not bool(transmission.isfinite().all()):
        raise ValueError(f"transmission must be finite numbers of shape {expected}, got {tuple(transmission.shape)}")
    veil = scatter_image(transmission, scatter, geometry.pixel_spacing)
    primary = transmission - veil
    measured = floored_line_integrals(primary, floor=floor)
    blocks = (
        shares
        if shares is not None
        else component_shares(
            components, geometry, beam, oversampling=oversampling, blur_sigma_px=blur_sigma_px, backend=backend
        )
    )
    unknown, slope = without_components(measured, blocks, beam, mineral=mineral)
    weights = statistical_weights(primary, scatter=veil, mask=mask, noise=noise, sensitivity=slope)
    return PreparedData(unknown, weights)
