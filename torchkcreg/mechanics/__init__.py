"""An implant as an elastic body: stiffness from its own nodes, without a mesh; displacements, loads and stresses."""

from torchkcreg.mechanics.body import ElasticBody
from torchkcreg.mechanics.carried import CarriedLoad, node_stresses
from torchkcreg.mechanics.expected_loads import ExpectedLoads, shares_of_holds
from torchkcreg.mechanics.hexahedra import Hexahedra, edge_for
from torchkcreg.mechanics.holds import Hold, holds_of
from torchkcreg.mechanics.sections import Sections
from torchkcreg.mechanics.stiffness import stiffness_matrix
from torchkcreg.mechanics.stress import von_mises
from torchkcreg.mechanics.superelement import LoadPrior, Superelement

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
    "holds_of",
    "node_stresses",
    "shares_of_holds",
    "stiffness_matrix",
    "von_mises",
]
