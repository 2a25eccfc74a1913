"""What is expected of an implant's loads where it is known which of its holds are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.mechanics.superelement import Superelement


@dataclass(frozen=True, eq=False)
class ExpectedLoads:
    """A prior of loads, some holds of which carry less than others, in terms of a superelement's amounts.

    Attributes:
        precision: Of the amounts, (A, A), 1/mm^2: ``a^T precision a`` is the least sum of squared loads, in standard
            deviations, that bends the implant by amounts a.
        followed: Of the stiff ways, (B, A): how much of them comes with an amount.
        spread: Covariance (B, B) of the stiff ways about that.
    """

    precision: Tensor
    followed: Tensor
    spread: Tensor

    @classmethod
    def of(cls, element: Superelement, shares: Tensor | None = None) -> ExpectedLoads:
        """Of an implant.

        Args:
            element: The implant.
            shares: How strong loads of each hold are against what the superelement's prior expects, (H,); all of them
                that when None.
        """
        number = element.num_amounts
        scale = element.loads.new_tensor([element.prior.force] * 3 + [element.prior.moment] * 3)
        strengths = scale.expand(len(element.holds), 6) * (1.0 if shares is None else shares.to(scale)[:, None])
        ways = (torch.cat([element.loads, element.stiff]) / strengths).flatten(1)
        whole = ways @ ways.T
        stiff, mixed = whole[number:, number:], whole[number:, :number]
        spread = torch.linalg.inv(stiff)
        followed = -spread @ mixed
        return cls(whole[:number, :number] + mixed.T @ followed, followed, spread)

    def loads_of(self, element: Superelement) -> Tensor:
        """Loads (A, H, 6) that are likeliest at an amount of one, those of the stiff ways included, N and N mm."""
        return element.loads + torch.einsum("ba,bhk->ahk", self.followed, element.stiff)

    @property
    def covariance(self) -> Tensor:
        """Of the amounts that are expected, (A, A), mm^2."""
        return torch.linalg.inv(self.precision)


def shares_of_holds(element: Superelement, heads: Sequence[Tensor] | Tensor, unused: float) -> Tensor:
    """Shares (H,) of holds where an implant is fixed: one at the nearest hold of each head (C, 3), else less.

    All are one where heads are at fewer than two holds: no loads could be in balance.
    """
    centers = element.loads.new_tensor([hold.center for hold in element.holds])
    used = {int((centers - head.to(centers)).norm(dim=-1).argmin()) for head in heads}
    if len(used) < 2:
        return torch.ones_like(centers[:, 0])
    return centers.new_tensor([1.0 if hold in used else unused for hold in range(len(centers))])
