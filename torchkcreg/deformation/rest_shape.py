"""An implant that was bent before it carried anything: the shape that loads bend further."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchkcreg.deformation.deviations import Deviations
from torchkcreg.deformation.model import Deformation
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics import Hold, Superelement
from torchkcreg.mechanics.rigid import rigid_fields


@torch.no_grad()
def bent_cloud(cloud: ImplantPointCloud, rest: Deformation) -> ImplantPointCloud:
    """An implant in its rest shape; bent metal keeps its volume (what yields does not shrink)."""
    return ImplantPointCloud(rest(cloud.points.double()).to(cloud.points), cloud.volumes, cloud.cell)


@torch.no_grad()
def bent_hold(hold: Hold, rest: Deformation) -> Hold:
    """A hold of an implant in its rest shape: a hole's axis turns with the metal about it."""
    center = torch.tensor([hold.center], dtype=torch.float64, device="cpu")
    moved = tuple(rest(center)[0].tolist())
    if hold.axis is None:
        return replace(hold, center=moved)
    axis = rest.jacobian(center)[0] @ center.new_tensor(hold.axis)
    return replace(hold, center=moved, axis=tuple((axis / axis.norm()).tolist()))


@torch.no_grad()
def spread_of_rest(
    element: Superelement, rest: Deformation, deviations: Deviations, implant_to_world: Tensor
) -> Tensor:
    """Covariance (A, A), mm^2, of the amounts that are mistaken for loads because the rest shape may be off.

    Where the rest shape is off, an implant without load seems to be bent by as much the other way: by those amounts
    that fit its deviations best beside the prior of the loads. Of what a registration knows of a shape, no more than
    the sections of the body is independent.

    Args:
        element: Of the implant in its rest shape.
        rest: From the undeformed implant to that.
        deviations: By which it may be off.
        implant_to_world: Pose (4, 4) in which it was registered.
    """
    fields = deviations.fields @ implant_to_world[:3, :3].to(deviations.fields)  # in the implant's axes
    if len(fields) == 0:
        return torch.zeros_like(element.expected.diag())
    nodes = rest(deviations.points.double())
    ways = element.linear(nodes, torch.eye(element.num_amounts, dtype=torch.float64, device=nodes.device))
    moves = torch.cat([ways, rigid_fields(nodes - nodes.mean(0))]).flatten(1)
    variance = fields.square().sum() / (3 * len(element.sections.heights))  # a coordinate's, for that many places
    precision = torch.cat([element.expected.square().reciprocal(), nodes.new_zeros(6)]).diag()
    found = torch.linalg.solve(moves @ moves.T + variance * precision, moves @ fields.flatten(1).T)
    return found[: element.num_amounts] @ found[: element.num_amounts].T
