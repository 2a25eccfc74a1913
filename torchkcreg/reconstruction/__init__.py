"""Reconstruction: filtered back-projection, penalised weighted least squares, known components.

`fdk` is filtered back-projection for one or several focal spots. `pwls` is iterative, with ordered subsets and
momentum. `prepare` turns measured transmissions into line integrals and weights, corrected for known components
(KC-Rec), scatter and beam hardening. `inpainted` is the fast alternative: it interpolates across the shadow of known
metal (KC-MAR).
"""

from torchkcreg.physics import Veil, veil_image

from .beam_estimate import BeamEstimate, estimate_beam
from .corrections import fit_veil, floored_line_integrals, refined_scatter
from .decomposition import Decomposition, decompose
from .fdk import FDKConfig, fdk
from .field_of_view import coverage, field_of_view_grid, seen_from_all_sides
from .inpainting import filled, inpainted
from .kcrec import (
    component_path_lengths,
    component_shares,
    known_materials,
    unknown_share,
    with_components,
    without_components,
)
from .preparation import PreparedData, prepare, statistical_weights
from .pwls import PWLS, PWLSConfig, Reconstruction, ordered_subsets, pwls
from .scan_views import ViewShard
from .spectral import BeamModel, background_line_integrals, behind_metal, hounsfield, mineral_part, path_lengths_through
from .system import Roughness, System, VoxelRoughness, VoxelSystem, quadratic_roughness
from .two_levels import TwoLevelRoughness, TwoLevelSystem
from .workflow import IterativeResult, reconstruct

__all__ = [
    "PWLS",
    "BeamEstimate",
    "BeamModel",
    "Decomposition",
    "FDKConfig",
    "IterativeResult",
    "PWLSConfig",
    "PreparedData",
    "Reconstruction",
    "Roughness",
    "System",
    "TwoLevelRoughness",
    "TwoLevelSystem",
    "Veil",
    "ViewShard",
    "VoxelRoughness",
    "VoxelSystem",
    "background_line_integrals",
    "behind_metal",
    "component_path_lengths",
    "component_shares",
    "coverage",
    "decompose",
    "estimate_beam",
    "fdk",
    "field_of_view_grid",
    "filled",
    "fit_veil",
    "floored_line_integrals",
    "hounsfield",
    "inpainted",
    "known_materials",
    "mineral_part",
    "ordered_subsets",
    "path_lengths_through",
    "prepare",
    "pwls",
    "quadratic_roughness",
    "reconstruct",
    "refined_scatter",
    "seen_from_all_sides",
    "statistical_weights",
    "unknown_share",
    "veil_image",
    "with_components",
    "without_components",
]
