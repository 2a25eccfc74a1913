"""Intensity models: from path lengths in mm to the line integrals that a detector reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from torchkcreg.plain import require_keys
from torchkcreg.precision import full_precision

from .beam import Beam
from .blur import gaussian_kernel
from .materials import Material, material
from .scatter import scattered_signal
from .spectra import Spectrum

# Standard deviations of these parameters over scanners and limbs, used as priors.
_LIKELY_SCATTER = 0.2
_LIKELY_BLUR = 0.4  # relative to the start value: varies with focal spot and scintillator
_LEAST_LIKELY_BLUR_PX = 0.1
_LIKELY_HARDNESS_MM = {True: 0.5, False: 3.0}  # of aluminium, by whether the spectrum is known


@dataclass(frozen=True)
class FreeParameter:
    """A scalar of an intensity model that may be estimated along with a motion.

    Attributes:
        attribute: Name of the model's parameter and of the keyword of `forward`.
        scale: A step that changes a radiograph about as much as a motion by 1 mm.
        low: Lower bound.
        high: Upper bound.
        likely: Most likely value.
        deviation: Standard deviation about the most likely value.
        in_pixels: True if it is a length in pixels.
        ends_at_low: True if the lower bound is a limit of physics, not of what is plausible: to end there is no flaw.
    """

    attribute: str
    scale: float
    low: float
    high: float
    likely: float
    deviation: float
    in_pixels: bool = False
    ends_at_low: bool = False


class IntensityModel(nn.Module):
    """Base class: maps path lengths (K, M, V, rows, cols) of M materials to line integrals (K, V, rows, cols).

    Attributes:
        has_background: True if the last material is the unknown background (bone, water).
        free: Parameters that may be estimated, by short names.
    """

    has_background: bool = False

    def __init__(self, free: Mapping[str, FreeParameter] | None = None) -> None:
        super().__init__()
        self.free = dict(free or {})

    def arguments(self, pixel_px: float, **overrides: Tensor) -> dict[str, Tensor]:
        """Keyword arguments of `forward` for a given pixel size, each of shape (K,); K = 1 without overrides.

        Args:
            pixel_px: Edge of the images' pixels, in the pixels that the model's lengths are given in.
            overrides: Values (K,) that replace attributes of the model.
        """
        keywords = {}
        for free in self.free.values():
            value = overrides.get(free.attribute, getattr(self, free.attribute).detach()[None])
            keywords[free.attribute] = value / pixel_px if free.in_pixels else value
        return keywords

    def to_dict(self) -> dict[str, Any]:
        """Model as plain types, for files. "model" names the kind of model, see `intensity_from_dict`."""
        raise NotImplementedError(f"{type(self).__name__} cannot be written: it has no to_dict")

    def of_sources(self, sources: Sequence[str] | None) -> dict[str, Any]:
        """Keyword arguments of `forward` that depend on the sources of the views. None by default."""
        return {}


class IdentityIntensity(IntensityModel):
    """Sum of the path lengths over the materials, without any physics: the model of Cao et al. 2020."""

    def to_dict(self) -> dict[str, Any]:
        """Name of the model."""
        return {"model": "identity"}

    def forward(self, path_lengths: Tensor, *, pooling: int = 1) -> Tensor:
        """Path lengths `(..., M, V, rows, cols)` summed to `(..., V, rows, cols)` and averaged over squares of pixels.

        Args:
            path_lengths: Path lengths, one image per material and view.
            pooling: Side of the squares of pixels that are averaged.
        """
        _check_path_lengths(path_lengths, None, pooling)
        total = path_lengths[..., 0, :, :, :] if path_lengths.shape[-4] == 1 else path_lengths.sum(-4)
        if pooling == 1:
            return total
        return avg_pool2d(total.flatten(0, -3), pooling).unflatten(0, total.shape[:-2])


class PolyenergeticTransmission(IntensityModel):
    """Line integrals behind several materials, with beam hardening, system blur and scatter.

    `y = -ln(blur(sum_k w_k exp(-sum_m mu_mk L_m)) + s p + r q) + ln(1 + s)`; zero in the open beam. The
    blur acts on intensities, before the logarithm, as in the detector; together with beam hardening it shifts apparent
    edges. One part of the scatter is proportional to the transmitted beam, `s p` (Sun & Star-Lack 2010), the other to
    the intensity that the object removes from the beam, `r q` (Ohnesorge et al. 1999).

    Args:
        materials: Materials, in the order of the path lengths' axis M.
        spectrum: The detected spectrum, or one for each source by its name. It is reduced to the fewest energies with
            the same transmission.
        scatter: Scatter s proportional to the transmitted beam, in units of the open beam.
        scatter_removed: Scatter r proportional to the removed intensity; needs `scatter_shapes` in `forward`.
        blur_sigma_px: Standard deviation of the system's point spread, pixels.
        hardness: Filtration added to the spectrum (removed if negative), mm of aluminium:
            `w_k *= exp(-mu_Al(E_k) hardness)`, normalised again.
        num_bins: Largest number of energies. None keeps the spectrum as it is.
        background: Material of the unknown background, appended to `materials`.
        spectrum_is_known: True if the spectrum was measured or given for this scanner. The prior on `hardness` is then
            narrower.

    Attributes:
        scatter, scatter_removed, blur_sigma_px, hardness: Scalar parameters, float64, that can be fitted. The gradient
            to `blur_sigma_px` vanishes at zero: start its fit from a third of a pixel or more.
        beam: Energies, their weights and the materials' attenuation, see `Beam`.

    Raises:
        ValueError: If there are no materials, or scatter or blur is negative.

    >>> from torchkcreg.physics import material, tungsten_spectrum
    >>> model = PolyenergeticTransmission([material("steel")], tungsten_spectrum(90), scatter=0.05)
    >>> lengths = torch.tensor([0.0, 1.0, 10.0]).reshape(1, 1, 1, 3)
    >>> model(lengths).shape
    torch.Size([1, 1, 3])
    """

    def __init__(
        self,
        materials: Sequence[Material],
        spectrum: Spectrum | Mapping[str, Spectrum],
        *,
        scatter: float = 0.0,
        scatter_removed: float = 0.0,
        blur_sigma_px: float = 0.0,
        hardness: float = 0.0,
        num_bins: int | None = 20,
        background: Material | None = None,
        spectrum_is_known: bool = True,
    ) -> None:
        super().__init__(
            {
                "scatter": FreeParameter("scatter", 0.05, 0.0, 0.9, scatter, _LIKELY_SCATTER),
                "removed": FreeParameter("scatter_removed", 0.05, 0.0, 0.9, scatter_removed, _LIKELY_SCATTER),
                "blur": FreeParameter(
                    "blur_sigma_px",
                    0.5,
                    0.1,
                    5.0,
                    blur_sigma_px,
                    max(_LIKELY_BLUR * blur_sigma_px, _LEAST_LIKELY_BLUR_PX),
                    in_pixels=True,
                    ends_at_low=True,  # a panel sharper than its pixels
                ),
                "hardness": FreeParameter(
                    "hardness", 2.0, -5.0, 20.0, hardness, _LIKELY_HARDNESS_MM[spectrum_is_known]
                ),
            }
        )
        self.has_background = background is not None
        materials = [*materials, background] if background is not None else list(materials)
        if not materials:
            raise ValueError("materials must hold at least one material, got none")
        named = {"scatter": scatter, "scatter_removed": scatter_removed, "blur_sigma_px": blur_sigma_px}
        for name, value in named.items():
            if not value >= 0:
                raise ValueError(f"{name} must not be negative, got {value}")
        self.material_names = tuple(m.name for m in materials)
        self.scatter = _parameter(scatter)
        self.scatter_removed = _parameter(scatter_removed)
        self.blur_sigma_px = _parameter(blur_sigma_px)
        self.hardness = _parameter(hardness)
        self.beam = Beam.of(materials, spectrum, num_bins=num_bins)

    def to_dict(self) -> dict[str, Any]:
        """Materials, spectra and parameters."""
        weights = self.beam.weights if self.beam.sources else self.beam.weights[None]
        return {
            "model": "polyenergetic",
            "materials": list(self.material_names),
            "has_background": self.has_background,
            "energies_kev": self.beam.energies_kev.tolist(),
            "weights": weights.tolist(),
            "sources": None if self.beam.sources is None else list(self.beam.sources),
            "parameters": {name: float(value.detach()) for name, value in self.named_parameters()},
        }

    def of_sources(self, sources: Sequence[str] | None) -> dict[str, Any]:
        """Names of the sources if each has its own spectrum, else empty."""
        return {} if self.beam.sources is None else {"sources": sources}

    @full_precision
    def forward(
        self,
        path_lengths: Tensor,
        *,
        scatter: Tensor | None = None,
        scatter_removed: Tensor | None = None,
        blur_sigma_px: Tensor | None = None,
        hardness: Tensor | None = None,
        pooling: int = 1,
        scatter_shapes: Tensor | None = None,
        sources: Sequence[str] | None = None,
    ) -> Tensor:
        """Line integrals `(..., V, rows, cols)` of path lengths `(..., M, V, rows, cols)` in mm.

        Args:
            path_lengths: Path lengths, one image per material and view, with any leading candidate axes.
            scatter: Replaces the module's value: a scalar, or one value per candidate (shape of the candidate axes).
            scatter_removed: As `scatter`.
            blur_sigma_px: As `scatter`.
            hardness: As `scatter`.
            pooling: Edge of the squares of pixels over which transmissions are averaged after the blur. Path lengths on
                pixels finer than the detector's model sharp edges better: the average of exponentials is not the
                exponential of the average.
            scatter_shapes: Spatial distributions p and q of both kinds of scatter after pooling, (2, V, rows, cols).
                None: p is 1 everywhere and q is 0.
            sources: Names of the views' sources if each source has its own spectrum.

        Raises:
            ValueError: If the path lengths' axis M is not the number of materials, an override does not match the
                candidate axes, or pooling does not divide the images.
        """
        _check_path_lengths(path_lengths, len(self.material_names), pooling)
        leading = path_lengths.shape[:-4]
        # the few parameters of a candidate keep the module's precision, images keep that of the path lengths
        hardness = _per_candidate("hardness", self.hardness, hardness, leading)
        sigma = _per_candidate("blur_sigma_px", self.blur_sigma_px, blur_sigma_px, leading)
        weights = self.beam.hardened(hardness, sources)
        flat = path_lengths.reshape(-1, *path_lengths.shape[-4:])
        levels = self._scatter_levels(scatter, scatter_removed, leading)
        scattered = scattered_signal(levels, scatter_shapes)
        passed = self.beam.transmission(flat, weights=weights, kernel=gaussian_kernel(sigma), pooling=pooling)
        signal = (passed + scattered.to(passed)).clamp_min(torch.finfo(passed.dtype).tiny)  # no NaN, whatever s
        result = torch.log1p(levels[:, 0]).to(signal)[:, None, None, None] - signal.log()
        return result.reshape(*leading, *result.shape[-3:])

    def _scatter_levels(self, passed: Tensor | None, removed: Tensor | None, leading: torch.Size) -> Tensor:
        """Levels (K, 2) of both kinds of scatter."""
        levels_by_name = {"scatter": (self.scatter, passed), "scatter_removed": (self.scatter_removed, removed)}
        return torch.stack([_per_candidate(name, *levels, leading) for name, levels in levels_by_name.items()], dim=-1)

    def extra_repr(self) -> str:
        """Materials and number of energies."""
        return f"materials={', '.join(self.material_names)}, num_bins={len(self.beam.energies_kev)}"


def _parameter(value: float) -> nn.Parameter:
    """A scalar float64 parameter."""
    return nn.Parameter(torch.tensor(float(value), dtype=torch.float64, device="cpu"))


def _check_path_lengths(path_lengths: Tensor, num_materials: int | None, pooling: int) -> None:
    """Raise ValueError unless path lengths have shape (..., M, V, rows, cols) and pooling divides rows and cols."""
    if path_lengths.dim() < 4 or num_materials not in (None, path_lengths.shape[-4]):
        expected = "M" if num_materials is None else num_materials
        raise ValueError(
            f"path_lengths must have shape (..., {expected}, V, rows, cols), got {tuple(path_lengths.shape)}"
        )
    if pooling < 1 or path_lengths.shape[-1] % pooling or path_lengths.shape[-2] % pooling:
        raise ValueError(f"pooling must divide rows and cols, got {pooling} for {tuple(path_lengths.shape[-2:])}")


def _per_candidate(name: str, default: Tensor, override: Tensor | None, leading: torch.Size) -> Tensor:
    """Value of each candidate, flattened: the override if given, else the module's value."""
    value = default if override is None else torch.as_tensor(override, dtype=default.dtype, device=default.device)
    try:
        return value.broadcast_to(leading).reshape(-1)
    except RuntimeError as error:
        raise ValueError(f"{name} must fit the candidates {tuple(leading)}, got {tuple(value.shape)}") from error


def intensity_from_dict(content: Any) -> IntensityModel:
    """Intensity model from the output of `IntensityModel.to_dict`.

    Raises:
        ValueError: A key is missing or malformed; the message names it.
    """
    require_keys(content, ("model",), " of an intensity model")
    if content["model"] == "identity":
        return IdentityIntensity()
    if content["model"] != "polyenergetic":
        raise ValueError(f"model must be identity or polyenergetic, got {content['model']!r}")
    require_keys(content, ("materials", "energies_kev", "weights", "parameters"), " of an intensity model")
    spectra = [_spectrum(content["energies_kev"], weights) for weights in content["weights"]]
    sources, names = content.get("sources"), list(content["materials"])
    background = material(names.pop()) if content.get("has_background") else None
    return PolyenergeticTransmission(
        [material(name) for name in names],
        spectra[0] if sources is None else dict(zip(sources, spectra, strict=True)),
        num_bins=None,
        background=background,
        **content["parameters"],
    )


def _spectrum(energies: Sequence[float], weights: Sequence[float]) -> Spectrum:
    positive = sorted((energy, weight) for energy, weight in zip(energies, weights, strict=True) if weight > 0)
    return Spectrum(tuple(energy for energy, _ in positive), tuple(weight for _, weight in positive))
