"""Simulated bench experiment from a recipe file: specimen, loads in newton, scanner, images and ground truth.

The image formation is independent of the registration's model: path lengths are exact chords of meshes and solids,
scatter comes from kernels that depend on the object's thickness, blur from focal spot and scintillator, and bones are
solid bodies.
"""

from .acquisition import Acquisition, acquisitions, panel_of, simulate_projections, views_of
from .loaded import ElasticConstruct, Loaded, loaded
from .panel import FlatPanel, scatter_shapes, scattered
from .quantities import quantity
from .recipe import LoadRecipe, PanelRecipe, Recipe
from .specimen import Specimen, recipe_files, recipe_in, specimen

__all__ = [
    "Acquisition",
    "ElasticConstruct",
    "FlatPanel",
    "LoadRecipe",
    "Loaded",
    "PanelRecipe",
    "Recipe",
    "Specimen",
    "acquisitions",
    "loaded",
    "panel_of",
    "quantity",
    "recipe_files",
    "recipe_in",
    "scatter_shapes",
    "scattered",
    "simulate_projections",
    "specimen",
    "views_of",
]
