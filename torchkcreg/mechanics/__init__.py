"""Finite-element mechanics of an implant without a body-fitted mesh: stiffness, displacements, loads, stresses."""

from .bodies import num_shells, separate_bodies
from .body import ElasticBody
from .carried import CarriedLoad, node_stresses
from .hexahedra import Hexahedra, edge_for
from .holds import Hold, holds_of
from .rigid_fragments import fracture_among, fragment_loads, hold_motions, rigid_at, sides_of_holds
from .sections import Sections
from .stiffness import stiffness_matrix
from .stress import von_mises
from .superelement import ExpectedLoads, LoadPrior, Superelement, shares_of_holds, used_holds

__all__ = [
    "CarriedLoad",
    "ElasticBody",
    "ExpectedLoads",
    "Hexahedra",
    "Hold",
    "LoadPrior",
    "Sections",
    "Superelement",
    "edge_for",
    "fracture_among",
    "fragment_loads",
    "hold_motions",
    "holds_of",
    "node_stresses",
    "num_shells",
    "rigid_at",
    "separate_bodies",
    "shares_of_holds",
    "sides_of_holds",
    "stiffness_matrix",
    "used_holds",
    "von_mises",
]
