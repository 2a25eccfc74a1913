"""Interface of the similarities that a registration can use."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn


class Similarity(nn.Module, ABC):
    """Similarity of rendered and measured images: 1 for a perfect match, less otherwise.

    For your own similarity, derive a class that stores what it needs of the measured images. Pass a registration the
    class, or any callable that returns an instance from `(fixed, mask, weights)`.

    Args:
        fixed: Measured images, shape (V, rows, cols).
        mask: Shape (V, rows, cols), nonzero where pixels are used. None uses all pixels.
        weights: Weights of the pixels, shape (V, rows, cols), not negative. None: all equal.
    """

    @abstractmethod
    def forward(self, moving: Tensor) -> Tensor:
        """Similarity of each view, shape (..., V), of rendered images (..., V, rows, cols)."""

    def residuals(self, moving: Tensor) -> Tensor:
        """Residuals (..., V, channels, rows, cols) whose squares sum to 4 (1 - similarity), for least squares.

        Raises:
            NotImplementedError: If the similarity is not a sum of squares.
        """
        raise NotImplementedError(
            f"{type(self).__name__} is not a sum of squares, which Gauss-Newton and the weighting of pixels need"
        )
