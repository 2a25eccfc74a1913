"""Reconstruction: filtered back-projection, penalised weighted least squares, known components.

`fdk` for one or several focal spots; `pwls` with ordered subsets and momentum; `prepare` turns measured transmissions
into line integrals and weights, with known components (KC-Rec), scatter and beam hardening accounted for; `inpainted`
is the fast way around known metal (KC-MAR).
"""

from torchkcreg.physics import Veil, veil_image
from torchkcreg.scene import KnownComponent

from .beam_estimate import BeamEstimate, estimate_beam
from .corrections import fit_veil, floored_line_integrals, refined_scatter
from .ct_numbers import hounsfield
from .dead_pixels import filled
from .decomposition import Decomposition, decompose
from .fdk import FDKConfig, fdk
from .field_of_view import coverage, field_of_view_grid
from .inpainting import inpainted
from .known_component import (
    component_path_lengths,
    component_shares,
    known_materials,
    unknown_share,
    with_components,
    without_components,
)
from .preparation import PreparedData, prepare
from .pwls import PWLS, pwls
from .pwls_config import PWLSConfig
from .reconstructed import Reconstruction
from .roughness import Roughness, VoxelRoughness, quadratic_roughness
from .sharding import ViewShard
from .single_material import path_lengths_through
from .spectral import BeamModel, background_line_integrals, behind_metal, mineral_part
from .subsets import ordered_subsets
from .system import System, VoxelSystem
from .two_levels import TwoLevelRoughness, TwoLevelSystem
from .weights import statistical_weights
from .workflow import IterativeResult, reconstruct

__all__ = [
    "PWLS",
    "BeamEstimate",
    "BeamModel",
    "Decomposition",
    "FDKConfig",
    "IterativeResult",
    "KnownComponent",
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
    "statistical_weights",
    "unknown_share",
    "veil_image",
    "with_components",
    "without_components",
]
