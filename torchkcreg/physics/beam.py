"""The beam: its energies, how much of the signal each of them is, and what materials do to it."""

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
    """Energies of one spectrum or, by source, of several, and the attenuation of materials at them.

    Args:
        energies_kev: (E,).
        weights: Shares of the signal, (E,), or (S, E), one row a source; each row sums to one.
        attenuation: Of the materials, 1/mm, (M, E).
        sources: Names of the S sources, where there are several spectra.
        aluminium: Attenuation of aluminium, (E,), by which :meth:`hardened` filters; nothing if not given.

    Attributes:
        energies_kev, weights, attenuation, aluminium: Buffers, float64.

    Raises:
        ValueError: If shapes do not fit.
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
        """The beam of a detected spectrum, or of one for each source, with the fewest energies that transmit alike.

        Args:
            materials: In the order of the path lengths' M; at least one.
            spectrum: As detected.
            num_bins: The most energies kept of each spectrum; None keeps its own.

        >>> beam = Beam.of([material("water")], Spectrum((40.0, 60.0), (1.0, 3.0)))
        >>> beam
        Beam(energies=2, materials=1)
        """
        if not materials:
            raise ValueError("materials must hold at least one material, got none")
        several = {"": spectrum} if isinstance(spectrum, Spectrum) else dict(spectrum)
        kept = [s if num_bins is None else s.reduced(materials, num_bins) for s in several.values()]
        energies = [energy for one in kept for energy in one.energies_kev]
        weights = torch.block_diag(*(torch.tensor([one.weights], dtype=torch.float64, device="cpu") for one in kept))
        return cls(
            torch.tensor(energies, dtype=torch.float64, device="cpu"),
            weights[0] if isinstance(spectrum, Spectrum) else weights,
            torch.stack([m.attenuation(energies) for m in materials]),
            sources=None if isinstance(spectrum, Spectrum) else list(several),
            aluminium=material("aluminium").attenuation(energies),
        )

    def weights_of(self, views: Sequence[str] | None) -> Tensor:
        """Weights (E,) of the one spectrum, or (V, E) of views whose sources have these names.

        Raises:
            ValueError: If there are several spectra, and a view of none of them.
        """
        if self.sources is None:
            return self.weights
        unknown = sorted(set(views or ()) - set(self.sources))
        if views is None or unknown:
            named = "the views have no sources" if views is None else f"got a view of source {unknown[0]}"
            raise ValueError(f"the beam has spectra of the sources {', '.join(self.sources)}, but {named}")
        return self.weights[[self.sources.index(name) for name in views]]

    def hardened(self, hardness: Tensor, views: Sequence[str] | None = None) -> Tensor:
        """Weights (K, V or 1, E) behind aluminium of hardness (K,) in mm, taken away where that is negative."""
        own = self.weights_of(views)
        logs = own.log() if own.dim() == 2 else own.log()[None]
        return torch.softmax(logs - hardness.to(logs)[:, None, None] * self.aluminium, dim=-1)

    def behind(self, hardness: float, materials: Sequence[int]) -> Beam:
        """The beam of one spectrum behind so many mm of aluminium, with some of the materials, by their numbers."""
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
        """What of the beam passes path lengths (K, M, V, rows, cols), see :func:`torchkcreg.physics.transmission`."""
        return transmission(
            path_lengths,
            self.attenuation,
            self.weights if weights is None else weights,
            kernel=kernel,
            pooling=pooling,
            backend=backend,
        )

    def extra_repr(self) -> str:
        """Energies, materials and sources."""
        of = "" if self.sources is None else f", sources={', '.join(self.sources)}"
        return f"energies={len(self.energies_kev)}, materials={len(self.attenuation)}{of}"
