"""An experiment on a desk, out of a file: a specimen, loads in newton, a scanner, and images with the truth about them.

Nothing that makes the images is the registration's: path lengths are exact chords of meshes and solids, scatter comes
from kernels that depend on what they pass, blur from focal spot and scintillator, and bones are bodies.
"""

from .acquisition import Acquisition, acquisitions, panel_of, views_of
from .loaded import ElasticConstruct, Loaded, loaded
from .panel import FlatPanel, scatter_shapes, scattered
from .recipe import LoadRecipe, Recipe
from .specimen import Specimen, recipe_files, recipe_in, specimen

__all__ = [
    "Acquisition",
    "ElasticConstruct",
    "FlatPanel",
    "LoadRecipe",
    "Loaded",
    "Recipe",
    "Specimen",
    "acquisitions",
    "loaded",
    "panel_of",
    "recipe_files",
    "recipe_in",
    "scatter_shapes",
    "scattered",
    "specimen",
    "views_of",
]
