"""What a registration asks of an intensity model, and what such a model says of its own parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn


@dataclass(frozen=True)
class FreeParameter:
    """A scalar of an intensity model that may be estimated along with a motion.

    Attributes:
        attribute: Its name in the model, a parameter and a keyword of `forward`.
        scale: A step that changes a radiograph about as much as a motion by 1 mm.
        low: Lower bound.
        high: Upper bound.
        likely: Where it most likely is.
        deviation: Standard deviation about that.
        in_pixels: It is a length in pixels.
    """

    attribute: str
    scale: float
    low: float
    high: float
    likely: float
    deviation: float
    in_pixels: bool = False


class IntensityModel(nn.Module):
    """Path lengths (K, M, V, rows, cols) of M materials to line integrals (K, V, rows, cols).

    Attributes:
        has_background: The last of the materials stands for what is not known (bone, water).
        free: What may be estimated, by short names.
    """

    has_background: bool = False

    def __init__(self, free: Mapping[str, FreeParameter] | None = None) -> None:
        super().__init__()
        self.free = dict(free or {})

    def arguments(self, pixel_px: float, **overrides: Tensor) -> dict[str, Tensor]:
        """Keyword arguments of `forward` for images of other pixels, each of shape (K,), K = 1 without overrides.

        Args:
            pixel_px: Edge of the images' pixels, in those that the model's own lengths count.
            overrides: Values (K,) of attributes in place of the model's own.
        """
        found = {}
        for free in self.free.values():
            value = overrides.get(free.attribute, getattr(self, free.attribute).detach()[None])
            found[free.attribute] = value / pixel_px if free.in_pixels else value
        return found

    def to_dict(self) -> dict[str, Any]:
        """The model as plain types, for files; "model" names what reads it."""
        raise NotImplementedError(f"{type(self).__name__} cannot be written: it has no to_dict")

    def of_sources(self, sources: Sequence[str] | None) -> dict[str, Any]:
        """Keyword arguments of `forward` that depend on the names of the views' sources; none by default."""
        return {}
