"""From measured transmissions to what a reconstruction takes: line integrals and weights, corrected."""

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
    """One over the variance of line integrals, relative to the open beam's: 1 in air, exp(-l) behind something.

    A count of ``primary + scatter`` has its own size as variance (Poisson), and the line integral ``-ln primary`` that
    over ``primary^2``: ``w = primary^2 / (primary + scatter + noise)``.

    Args:
        primary: intensity without scatter, in units of the open beam, any shape.
        scatter: what was taken away before the logarithm, same unit.
        mask: 0 where a pixel holds no measurement.
        noise: variance of the detector's own noise, in the square of counts over the open beam's counts.
        sensitivity: derivative of the measured line integral to the one that is reconstructed, where these differ
            (beam hardening); the weights take its square.

    >>> statistical_weights(torch.tensor([1.0, 0.5])).tolist()
    [1.0, 0.5]
    """
    primary = primary.clamp_min(0)
    total = (primary + scatter + noise).clamp_min(torch.finfo(primary.dtype).tiny)
    weights = primary * (primary / total) * torch.as_tensor(sensitivity).to(primary) ** 2
    return weights if mask is None else weights * mask


@dataclass(frozen=True)
class PreparedData:
    """Line integrals to reconstruct, and how much each counts.

    Attributes:
        line_integrals: (V, rows, cols), of the background at the beam's reference energy.
        weights: same shape, not negative.
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
    """Scatter taken away, the logarithm with a floor, known components and beam hardening accounted for.

    With `components` the line integrals are those of everything else (KC-Rec), without them those of all there is. In
    both the background's beam hardening is corrected as the beam says; a `BeamModel.monoenergetic` corrects nothing.
    The weights are the same but for the hardening's derivative.

    Args:
        transmission: measured intensity over the open beam's, (V, rows, cols).
        geometry: the views.
        beam: with the attenuation of the components' materials.
        components: metal in its registered place.
        shares: `component_shares` of these, where they are at hand already or come from a projector of the user's own.
        scatter: a fitted or given veil, or an image of the scatter in units of the open beam.
        mask: 0 where a pixel holds no measurement: it is filled from its neighbours, see `filled`, and has no weight.
        floor: smallest transmission taken at its word.
        noise: see `statistical_weights`.
        blur_sigma_px: the system's blur for the components' projections, detector pixels.
        mineral: line integrals of mineral, (V, rows, cols), from an earlier reconstruction; see `mineral_part`.
        oversampling: sub-pixels along each side of a pixel for the components' projections.
        backend: of the projection.

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
