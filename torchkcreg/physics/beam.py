"""X-ray beam: its energies, their weights in the detected signal, and the attenuation of materials at them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from torchkcreg.precision import ExactModule

from .materials import Material, material
from .spectra import Spectrum
from .transmission import transmission


class Beam(ExactModule):
    """Energies of one spectrum, or of one spectrum per source, and the attenuation of materials at them.

    Args:
        energies_kev: Energies, keV, (E,).
        weights: Shares of the detected signal, (E,), or (S, E) with one row per source. Each row sums to one.
        attenuation: Linear attenuation of the materials, 1/mm, (M, E).
        sources: Names of the S sources if each has its own spectrum.
        aluminium: Attenuation of aluminium, 1/mm, (E,), for `hardened`. Zero if not given.

    Attributes:
        energies_kev, weights, attenuation, aluminium: Buffers, float64.

    Raises:
        ValueError: If shapes do not match.
    """

    exact_buffers: ClassVar[tuple[str, ...]] = ("energies_kev", "weights", "attenuation", "aluminium")
    energies_kev: Tensor
    weights: Tensor
    attenuation: Tensor
    aluminium: Tensor

    def __init__(
        self,
        energies_kev: Tensor,
        weights: Tensor,
        attenuation: Tensor,
        *,
        sources: Sequence[str] | None = None,
        aluminium: Tensor | None = None,
    ) -> None:
        super().__init__()
        expected = (len(energies_kev),) if sources is None else (len(sources), len(energies_kev))
        if tuple(weights.shape) != expected:
            raise ValueError(f"weights must have shape {expected}, got {tuple(weights.shape)}")
        if attenuation.dim() != 2 or attenuation.shape[1] != len(energies_kev):
            raise ValueError(f"attenuation must have shape (M, {len(energies_kev)}), got {tuple(attenuation.shape)}")
        self.sources = None if sources is None else tuple(sources)
        filtering = torch.zeros_like(energies_kev) if aluminium is None else aluminium
        named = {"energies_kev": energies_kev, "weights": weights, "attenuation": attenuation, "aluminium": filtering}
        for name, value in named.items():
            self.register_buffer(name, value.double())

    @classmethod
    def of(
        cls, materials: Sequence[Material], spectrum: Spectrum | Mapping[str, Spectrum], *, num_bins: int | None = 20
    ) -> Beam:
        """Beam of a detected spectrum, or of one per source, reduced to few energies with the same transmission.

        Args:
            materials: Materials in the order of the path lengths' axis M; at least one.
            spectrum: Detected spectrum, or one for each source by its name.
            num_bins: Largest number of energies per spectrum. None keeps the spectrum as it is.

        >>> beam = Beam.of([material("water")], Spectrum((40.0, 60.0), (1.0, 3.0)))
        >>> beam
        Beam(energies=2, materials=1)
        """
        if not materials:
            raise ValueError("materials must hold at least one material, got none")
        spectra_by_source = {"": spectrum} if isinstance(spectrum, Spectrum) else dict(spectrum)
        reduced = [s if num_bins is None else s.reduced(materials, num_bins) for s in spectra_by_source.values()]
        energies = [energy for s in reduced for energy in s.energies_kev]
        weights = torch.block_diag(*(torch.tensor([s.weights], dtype=torch.float64, device="cpu") for s in reduced))
        return cls(
            torch.tensor(energies, dtype=torch.float64, device="cpu"),
            weights[0] if isinstance(spectrum, Spectrum) else weights,
            torch.stack([m.attenuation(energies) for m in materials]),
            sources=None if isinstance(spectrum, Spectrum) else list(spectra_by_source),
            aluminium=material("aluminium").attenuation(energies),
        )

    def weights_of(self, views: Sequence[str] | None) -> Tensor:
        """Weights (E,) of a single spectrum, or (V, E) of views given the names of their sources.

        Raises:
            ValueError: If there are several spectra and a view has no source or an unknown one.
        """
        if self.sources is None:
            return self.weights
        unknown = sorted(set(views or ()) - set(self.sources))
        if views is None or unknown:
            named = "the views have no sources" if views is None else f"got a view of source {unknown[0]}"
            raise ValueError(f"the beam has spectra of the sources {', '.join(self.sources)}, but {named}")
        return self.weights[[self.sources.index(name) for name in views]]

    def hardened(self, hardness: Tensor, views: Sequence[str] | None = None) -> Tensor:
        """Weights (K, V or 1, E) behind `hardness` (K,) mm of aluminium; a negative value removes filtration."""
        unfiltered = self.weights_of(views)
        logs = unfiltered.log() if unfiltered.dim() == 2 else unfiltered.log()[None]
        return torch.softmax(logs - hardness.to(logs)[:, None, None] * self.aluminium, dim=-1)

    def behind(self, hardness: float, materials: Sequence[int]) -> Beam:
        """Beam of a single spectrum behind `hardness` mm of aluminium, for the materials with these indices."""
        weights = self.hardened(self.weights.new_tensor([hardness]))[0, 0]
        return Beam(self.energies_kev, weights, self.attenuation[list(materials)], aluminium=self.aluminium)

    def transmission(
        self,
        path_lengths: Tensor,
        *,
        weights: Tensor | None = None,
        kernel: Tensor | None = None,
        pooling: int = 1,
        backend: str = "auto",
    ) -> Tensor:
        """Transmission behind path lengths (K, M, V, rows, cols), see `torchkcreg.physics.transmission`."""
        return transmission(
            path_lengths,
            self.attenuation,
            self.weights if weights is None else weights,
            kernel=kernel,
            pooling=pooling,
            backend=backend,
        )

    def extra_repr(self) -> str:
        """Numbers of energies and materials, and the sources."""
        of = "" if self.sources is None else f", sources={', '.join(self.sources)}"
        return f"energies={len(self.energies_kev)}, materials={len(self.attenuation)}{of}"
