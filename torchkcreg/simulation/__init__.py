"""Simulation of weight-bearing experiments: hardware, loads, the scanner, and whole cases with ground truth.

`weight_bearing_case` returns images of a loaded plate together with its true deformation.
"""

from .bench import FlatPanel, simulate_projections
from .cases import SimulatedCase, weight_bearing_case
from .hardware import hole_positions, locking_plate, locking_screws
from .loads import Load, RodMotion
from .parts import Part, material_paths
from .population import Draw, draw_case, random_case
from .solids import Cylinder, Sphere, Tube, chord_image, chord_lengths

__all__ = [
    "Cylinder",
    "Draw",
    "FlatPanel",
    "Load",
    "Part",
    "RodMotion",
    "SimulatedCase",
    "Sphere",
    "Tube",
    "chord_image",
    "chord_lengths",
    "draw_case",
    "hole_positions",
    "locking_plate",
    "locking_screws",
    "material_paths",
    "random_case",
    "simulate_projections",
    "weight_bearing_case",
]
