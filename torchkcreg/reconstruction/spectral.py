"""Polyenergetic beam model: line integrals of the background behind known components, with beam hardening."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, avg_pool3d

from torchkcreg.physics import Beam, Material, Spectrum, calcium_attenuation, gaussian_blur, material

_STEPS = 4096
_DARKEST = 12.0  # largest line integral in the table
NEWTON_STEPS = 8
LEAST_LINE_INTEGRAL = -0.5
CLEARLY_ABOVE = 0.1  # relative to water: more than noise and variations of soft tissue


def path_lengths_through(transmission: Tensor, substance: Material, spectrum: Spectrum) -> Tensor:
    """Path lengths in mm through an object of one material, corrected for beam hardening, in the transmission's shape.

    Inverts `T(L) = sum_k w_k exp(-mu_k L)` by interpolation in `-ln T`. Pixels brighter than the open beam get negative
    lengths by linear extrapolation, so that noise is not biased.

    Args:
        transmission: Measured intensity over the open beam's, with scatter subtracted; positive.
        substance: The object's material.
        spectrum: Detected spectrum.
    """
    weights = torch.tensor(spectrum.weights, dtype=torch.float64, device="cpu")
    attenuation = substance.attenuation(spectrum.energies_kev)
    longest = _DARKEST / float(attenuation.min())
    lengths = torch.linspace(0, 1, _STEPS, dtype=torch.float64, device="cpu").square() * longest
    lines = -(torch.exp(-lengths[:, None] * attenuation) @ weights).log()
    table, lengths = lines.to(transmission.device), lengths.to(transmission.device)
    measured = -transmission.double().clamp_min(1e-30).log()
    upper = torch.searchsorted(table, measured.contiguous()).clamp(1, _STEPS - 1)
    low, high = table[upper - 1], table[upper]
    share = (measured - low) / (high - low)
    return torch.lerp(lengths[upper - 1], lengths[upper], share).to(transmission.dtype)


def hounsfield(attenuation: Tensor, water: float) -> Tensor:
    """CT numbers in HU, `1000 (mu - mu_water) / mu_water`, of attenuation in 1/mm.

    >>> import torch
    >>> hounsfield(torch.tensor([0.0, 0.02, 0.03]), 0.02).round().tolist()
    [-1000.0, 0.0, 500.0]
    """
    if not water > 0:
        raise ValueError(f"water must be a positive attenuation in 1/mm, got {water}")
    return 1000 * (attenuation - water) / water


@dataclass(frozen=True)
class BeamModel:
    """Beam spectrum with the background's attenuation at its energies relative to a reference energy.

    The background is modelled as one material of varying density, water by default: a line integral b at the reference
    energy attenuates energy k by `exp(-r_k b)`.

    Attributes:
        beam: Energies, shares of the signal, and the metals' attenuation.
        background: Ratio r of the background's attenuation, (E,).
        mineral: The same ratio for calcium, which hardens the beam more than water, (E,).
        reference_kev: Energy of the reconstructed attenuation; None for a monoenergetic beam.
        water: Attenuation of water at the reference energy, for CT numbers, 1/mm.
    """

    beam: Beam
    background: Tensor
    mineral: Tensor
    reference_kev: float | None
    water: float

    @property
    def weights(self) -> Tensor:
        """Energies' shares of the signal, (E,); they sum to one."""
        return self.beam.weights

    @property
    def attenuation(self) -> Tensor:
        """Attenuation of the metals, (M, E), 1/mm."""
        return self.beam.attenuation

    @classmethod
    def polyenergetic(
        cls,
        metals: Sequence[Material],
        spectrum: Spectrum,
        *,
        background: Material | None = None,
        reference_kev: float | None = None,
        num_bins: int = 12,
    ) -> BeamModel:
        """Beam model of a detected spectrum, reduced to a few energies with nearly the same transmission.

        Args:
            metals: Metals in the order of the path lengths; may be empty.
            spectrum: Detected spectrum.
            background: Background material; water if None.
            reference_kev: Reference energy, keV; the spectrum's mean energy if None.
            num_bins: Maximum number of energies.
        """
        base = material("water") if background is None else background
        energy = spectrum.mean_energy if reference_kev is None else float(reference_kev)
        whole = Beam.of([*metals, base], spectrum, num_bins=num_bins)
        return cls.behind(
            Beam(whole.energies_kev, whole.weights, whole.attenuation[:-1]), background=base, reference_kev=energy
        )

    @classmethod
    def behind(cls, beam: Beam, *, background: Material | None = None, reference_kev: float | None = None) -> BeamModel:
        """Beam model of a given beam; the background is water and the reference the beam's mean energy by default.

        Raises:
            ValueError: If the beam has several spectra.
        """
        if beam.sources is not None:
            raise ValueError("a reconstruction needs one spectrum for all views, got one for each source")
        base = material("water") if background is None else background
        energy = float(beam.weights @ beam.energies_kev) if reference_kev is None else float(reference_kev)
        energies = beam.energies_kev.tolist()
        water = material("water")
        return cls(
            beam,
            base.attenuation(energies) / base.attenuation((energy,)),
            calcium_attenuation(energies) / calcium_attenuation((energy,)),
            energy,
            float(water.attenuation((energy,))[0]),
        )

    @classmethod
    def monoenergetic(cls, attenuation: Sequence[float], *, water: float = 0.0205) -> BeamModel:
        """Beam model of a single energy, as in Cao et al. 2020, from the metals' attenuation in 1/mm."""
        unit = torch.ones(1, dtype=torch.float64)
        table = torch.tensor(list(attenuation), dtype=torch.float64).reshape(-1, 1)
        return cls(Beam(torch.zeros_like(unit), unit, table), unit, unit, None, water)

    def without_metals(self) -> BeamModel:
        """The same beam model without metals."""
        beam = self.beam
        return replace(self, beam=Beam(beam.energies_kev, beam.weights, beam.attenuation[:0]))


def behind_metal(path_lengths: Tensor, beam: BeamModel, *, pooling: int = 1, blur_sigma_px: float = 0.0) -> Tensor:
    """Energies' shares of the signal behind metal, (K, V, rows, cols); they sum to the metal's transmission.

    Args:
        path_lengths: Path lengths (M, V, rows * pooling, cols * pooling), mm. With pooling above 1 the pixels are finer
            than the detector's, because transmissions, not path lengths, must be averaged.
        beam: Energies and attenuation.
        pooling: Side length of the blocks of pixels whose transmission is averaged.
        blur_sigma_px: The system's blur, standard deviation in detector pixels.
    """
    if path_lengths.dim() != 4 or len(path_lengths) != len(beam.attenuation):
        raise ValueError(
            f"path_lengths must have shape ({len(beam.attenuation)}, V, rows, cols), got {tuple(path_lengths.shape)}"
        )
    images = []
    for energy, weight in enumerate(beam.weights.tolist()):
        exponent = torch.zeros_like(path_lengths[0])
        for lengths, attenuation in zip(path_lengths, beam.attenuation[:, energy].tolist(), strict=True):
            exponent.sub_(lengths, alpha=attenuation)
        passed = exponent.exp_()
        if blur_sigma_px > 0:
            passed = gaussian_blur(passed, blur_sigma_px * pooling)
        images.append(weight * (passed if pooling == 1 else avg_pool2d(passed[:, None], pooling)[:, 0]))
    return torch.stack(images)


def transmitted_behind(
    background: Tensor, shares: Tensor, beam: BeamModel, *, mineral: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """`-ln sum_k T_k exp(-r_k b)` for background line integrals b, and its derivative by b.

    If a part m of b is mineral, `r_k b` becomes `r_k (b - m) + r'_k m` with r' the mineral's ratio.

    Args:
        background: Line integrals b, (V, rows, cols).
        shares: Shares T, (K, V, rows, cols), from `behind_metal`; without metal the beam's weights, (K,).
        beam: Energies and the background's relative attenuation.
        mineral: Mineral part m, (V, rows, cols); none if not given.
    """
    logs = shares.clamp_min(1e-30).log().to(background)
    parts = []
    for k, (ratio, mineral_ratio) in enumerate(zip(beam.background.tolist(), beam.mineral.tolist(), strict=True)):
        part = logs[k] - ratio * background
        parts.append(part if mineral is None else part.sub_(mineral, alpha=mineral_ratio - ratio))
    stacked = torch.stack(parts)
    total = torch.logsumexp(stacked, dim=0)
    mixture = torch.exp(stacked.sub_(total))
    slope = torch.einsum("k...,k->...", mixture, beam.background.to(mixture))
    return -total, slope


def background_line_integrals(
    line_integrals: Tensor, shares: Tensor, beam: BeamModel, *, mineral: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Line integrals b of the background and the derivative of the measured ones by b, both (V, rows, cols).

    Solves `-ln sum_k T_k exp(-r_k b) = y` by Newton's method: the left side is concave and increasing in b, so the
    iteration converges from below.

    Args:
        line_integrals: Measured y without scatter, (V, rows, cols).
        shares: As in `transmitted_behind`.
        beam: Energies and the background's relative attenuation.
        mineral: As in `transmitted_behind`, from `mineral_part` of an earlier reconstruction.
    """
    b, slope = torch.zeros_like(line_integrals), torch.ones_like(line_integrals)
    for _ in range(NEWTON_STEPS if len(beam.weights) > 1 else 1):
        modelled, slope = transmitted_behind(b, shares, beam, mineral=mineral)
        b = (b + (line_integrals - modelled) / slope).clamp_min(LEAST_LINE_INTEGRAL)
    return b, slope


def mineral_part(volume: Tensor, beam: BeamModel, *, mask: Tensor | None = None) -> Tensor:
    """Mineral part of a reconstructed background (D, H, W), 1/mm: excess over water in voxels clearly above it.

    Args:
        volume: Attenuation at the beam's reference energy.
        beam: Beam model with the attenuation of water at that energy.
        mask: Share of each voxel that is background; 1 if None.
    """
    smooth = avg_pool3d(volume[None, None], 3, stride=1, padding=1, count_include_pad=False)[0, 0]
    excess = (volume - beam.water).clamp_min(0) * (smooth > (1 + CLEARLY_ABOVE) * beam.water)
    return excess if mask is None else excess * mask
