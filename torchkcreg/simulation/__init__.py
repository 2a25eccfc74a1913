"""Simulation of weight-bearing experiments: hardware, loads, the scanner, and whole cases with known truth.

`weight_bearing_case` gives images of a loaded plate together with what really happened to it.
"""

from torchkcreg.simulation.cases import SimulatedCase, weight_bearing_case
from torchkcreg.simulation.chords import chord_image, chord_lengths
from torchkcreg.simulation.draws import Draw, draw_case
from torchkcreg.simulation.hardware import (
    hole_positions,
    locking_plate,
    locking_screws,
)
from torchkcreg.simulation.loads import Load, RodMotion
from torchkcreg.simulation.parts import Part, material_paths
from torchkcreg.simulation.population import random_case
from torchkcreg.simulation.scanner import DetectorModel, simulate_projections
from torchkcreg.simulation.solids import Cylinder, Sphere, Tube

__all__ = [
    "Cylinder",
    "DetectorModel",
    "Draw",
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
