"""Similarity of rendered and measured radiographs, for whole batches of candidates.

Gradient correlation, gradient difference and normalised cross-correlation, and the Sobel derivatives they are based on.
"""

from .gradient_correlation import GradientCorrelation, GradientCorrelationLoss, GradientDifference, gradient_correlation
from .ncc import normalized_cross_correlation
from .similarity import Similarity
from .sobel import erode_mask, sobel_gradient

__all__ = [
    "GradientCorrelation",
    "GradientCorrelationLoss",
    "GradientDifference",
    "Similarity",
    "erode_mask",
    "gradient_correlation",
    "normalized_cross_correlation",
    "sobel_gradient",
]
