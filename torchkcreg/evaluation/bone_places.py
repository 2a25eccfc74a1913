"""Where the bone is beside an implant, from its screws: near cortex, axis and far cortex at the fracture."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.implant import Screw

BONE_PLACES = ("near cortex", "bone axis", "far cortex")
_AROUND_MM = 4.0  # of the implant's length, where its thickness is measured


def bone_places(nodes: Tensor, screws: Sequence[Screw], gap: Tensor) -> Tensor:
    """Points (3, 3) on the near cortex, the bone's axis and the far cortex at the fracture, in the implant's frame.

    Screws of a plate go through both cortices. The near cortex is taken where their mean direction leaves the implant,
    the far cortex at the median depth of their tips, and the axis half-way.

    Args:
        nodes: Nodes (N, 3) of the undeformed implant, mm.
        screws: Its screws, from head to tip, in the same frame.
        gap: Point (3,) of the fracture at the centre of the implant's cross-section.

    Raises:
        ValueError: If there are no screws.
    """
    if not screws:
        raise ValueError("without screws it is not known where the bone is")
    nodes, gap = nodes.double(), gap.double()
    heads, tips = (torch.tensor([getattr(s, end) for s in screws], dtype=torch.float64) for end in ("start", "end"))
    directions = torch.nn.functional.normalize(tips - heads, dim=-1)
    down = torch.nn.functional.normalize(directions.mean(0), dim=0)
    beside = nodes - gap
    across = beside - (beside @ down)[:, None] * down
    near = across.norm(dim=-1) <= across.norm(dim=-1).kthvalue(max(1, len(nodes) // 50)).values.clamp_min(_AROUND_MM)
    underside = float((beside[near] @ down).max())
    # a tip's depth below its own head, from the level of the heads' side of the implant
    depth = float((torch.linalg.vecdot(tips - heads, down.expand_as(heads))).median()) + float(
        (beside[near] @ down).min()
    )
    depths = torch.tensor([underside, (underside + depth) / 2, depth], dtype=torch.float64)
    return gap + depths[:, None] * down
