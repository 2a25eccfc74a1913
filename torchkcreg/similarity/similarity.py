"""What a registration asks of a similarity."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn


class Similarity(nn.Module, ABC):
    """How alike rendered and measured images are: 1 for a perfect match, less for others.

    A similarity of your own derives from it, keeps what it needs of the measured images, and is given to a registration
    as a class or as anything else that makes one of ``(fixed, mask, weights)``.

    Args:
        fixed: Measured images, shape (V, rows, cols).
        mask: Shape (V, rows, cols), nonzero where pixels count; None: all do.
        weights: Shape (V, rows, cols), how much a pixel counts, not negative; None: all alike.
    """

    @abstractmethod
    def forward(self, moving: Tensor) -> Tensor:
        """Similarity of each view, shape (..., V), of rendered images (..., V, rows, cols)."""

    def residuals(self, moving: Tensor) -> Tensor:
        """Residuals (..., V, channels, rows, cols) whose squares sum to 4 (1 - similarity), for least squares.

        Raises:
            NotImplementedError: If the similarity is no sum of squares.
        """
        raise NotImplementedError(
            f"{type(self).__name__} is no sum of squares, which Gauss-Newton and the weighting of pixels need"
        )
