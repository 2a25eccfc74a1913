"""An implant as an elastic body: stiffness from its own nodes, without a mesh; displacements and stresses."""

from torchkcreg.mechanics.body import ElasticBody, von_mises
from torchkcreg.mechanics.hexahedra import Hexahedra, edge_for
from torchkcreg.mechanics.stiffness import stiffness_matrix

__all__ = ["ElasticBody", "Hexahedra", "edge_for", "stiffness_matrix", "von_mises"]
