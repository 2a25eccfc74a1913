"""Doubts about a visit as a whole: ends that cannot be told apart, screws that may all be in one fragment."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.evaluation import Fragments
from torchkcreg.geometry import fit_rigid, principal_axes, transform_points, vector_from_rotation
from torchkcreg.implant import Screw
from torchkcreg.registration import RegisteredImplant, RegistrationResult

CONTRADICTION = (
    "no stiffness of the gap is given: the implant carries more than the force along the bone's axis explains, so the "
    "force acts elsewhere or otherwise"
)
MINERAL_WITHOUT_SPECTRUM = "bone mineral was measured without the detected spectrum: its scale is not known"
TURNED_AROUND = "the implant is symmetric: nothing tells its ends apart, but motion and load do not depend on that"
_SAMPLE, _SAME_METAL_MM = 1000, 3.0
_TURNED_RAD = 5e-3  # if fragments turn by more, the fracture lies between their screws


def fragments_turned(first: RegisteredImplant, second: RegisteredImplant, fragments: Fragments) -> bool:
    """True if one fragment turned noticeably against the other between two registrations."""
    lower, upper = (
        fit_rigid(first.warp(held), second.warp(held))[:3, :3] for held in (fragments.lower, fragments.upper)
    )
    return float(vector_from_rotation(lower.T @ upper).norm()) > _TURNED_RAD


def turned_around(result: RegistrationResult, nodes: Tensor) -> bool:
    """True if a rival place of a registered implant is the same metal turned around, since the implant is symmetric.

    Args:
        result: The registration.
        nodes: Nodes (N, 3) of its first implant, undeformed.
    """
    pose = (result.diagnostics.get("rival") or {}).get("pose")
    if pose is None:
        return False
    nodes = nodes[:: max(1, len(nodes) // _SAMPLE)].double()
    here = transform_points(result.implants[0].implant_to_world, nodes)
    there = transform_points(torch.tensor(pose, dtype=torch.float64), nodes)
    return float(torch.cdist(there, here).amin(1).square().mean().sqrt()) < _SAME_METAL_MM


def beyond_the_screws(nodes: Tensor, screws: Sequence[Screw]) -> str | None:
    """A doubt if the implant reaches further beyond its last screw than the widest gap between screws, else None.

    The fracture may then lie beyond the last screw, and the screws all in one fragment.
    """
    if len(screws) < 2:
        return None
    _, (*_, axis) = principal_axes(nodes)
    heights = (nodes.new_tensor([screw.start for screw in screws]) @ axis).sort().values
    low, high = (nodes @ axis).aminmax()
    beyond = float(torch.stack([heights[0] - low, high - heights[-1]]).max())
    if beyond <= float(heights.diff().max()):
        return None
    return (
        f"the implant reaches {beyond:.0f} mm beyond its last screw, further than between any two: the screws may all "
        "be in one fragment"
    )
