"""How alike a rendered and a measured radiograph are: gradient correlation, normalised cross-correlation, and the
Sobel derivatives under them, all of whole batches of candidates at once."""

from torchkcreg.similarity.gradient_correlation import (
    GradientCorrelation,
    GradientCorrelationLoss,
    gradient_correlation,
)
from torchkcreg.similarity.gradient_difference import GradientDifference
from torchkcreg.similarity.model import Similarity
from torchkcreg.similarity.ncc import normalized_cross_correlation
from torchkcreg.similarity.sobel import erode_mask, sobel_gradient

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
