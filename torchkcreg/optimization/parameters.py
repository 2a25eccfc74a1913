"""Named blocks of parameters that an optimiser walks in, with their bounds and what speaks against them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor


class ParameterBlock:
    """Steps from where something is, so scaled that one of 1 changes an image about as much as a motion by 1 mm.

    A vector of zeros leaves all as it is. Derive from it and set ``num_parameters``; the rest has defaults.

    Attributes:
        num_parameters: How many there are.
        loss_of_deviation: What the penalty is for a parameter that is one standard deviation off where a prior expects
            it, if the penalty is the square of such deviations; 0 if it is none.
    """

    num_parameters: int
    loss_of_deviation: float = 0.0

    def weigh(self, loss: float) -> None:
        """Hears what a standard deviation of the images is worth in loss, for priors that have no weight of their own.

        Forgets it by default.
        """

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, D) within their bounds; as they are by default."""
        return steps

    def penalty(self, steps: Tensor) -> Tensor:
        """What speaks against steps (K, D) but the images, in units of the loss, shape (K,); nothing by default."""
        return steps.new_zeros(steps.shape[:-1])

    def at_bounds(self, share: float) -> list[str]:
        """Names of parameters that now are within a share of their range of a bound; none by default."""
        return []

    def at_rest(self, device: torch.device | str = "cpu") -> Tensor:
        """The step (1, D) that changes nothing."""
        return torch.zeros(1, self.num_parameters, dtype=torch.float64, device=device)


class ParameterBlocks(Mapping[str, ParameterBlock]):
    """Blocks under their names, one after the other in one vector.

    >>> class Two(ParameterBlock):
    ...     num_parameters = 2
    >>> blocks = ParameterBlocks({"plate": Two(), "physics": Two()})
    >>> blocks.num_parameters, blocks.split(torch.arange(4.0)[None])["physics"].tolist()
    (4, [[2.0, 3.0]])
    """

    def __init__(self, blocks: Mapping[str, ParameterBlock]) -> None:
        self._blocks = dict(blocks)

    def __getitem__(self, name: str) -> ParameterBlock:
        return self._blocks[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._blocks)

    def __len__(self) -> int:
        return len(self._blocks)

    @property
    def num_parameters(self) -> int:
        """Of all blocks."""
        return sum(block.num_parameters for block in self._blocks.values())

    @property
    def places(self) -> dict[str, slice]:
        """Where each block's parameters are."""
        found, start = {}, 0
        for name, block in self._blocks.items():
            found[name] = slice(start, start := start + block.num_parameters)
        return found

    def split(self, parameters: Tensor) -> dict[str, Tensor]:
        """Parameters (..., D) of each block.

        Raises:
            ValueError: If D is not the number of parameters.
        """
        if parameters.shape[-1] != self.num_parameters:
            raise ValueError(f"parameters must have shape (..., {self.num_parameters}), got {tuple(parameters.shape)}")
        parts = parameters.split([block.num_parameters for block in self._blocks.values()], dim=-1)
        return dict(zip(self._blocks, parts, strict=True))

    def clamp(self, parameters: Tensor) -> Tensor:
        """Parameters (K, D), all within their bounds."""
        parts = self.split(parameters)
        return torch.cat([self._blocks[name].clamp(part) for name, part in parts.items()], dim=-1)

    def penalty(self, parameters: Tensor) -> Tensor:
        """What speaks against parameters (K, D) in all blocks, shape (K,)."""
        parts = self.split(parameters)
        return torch.stack([self._blocks[name].penalty(part) for name, part in parts.items()]).sum(0)

    def at_bounds(self, share: float) -> list[str]:
        """Names of parameters that now are within a share of their range of a bound."""
        return [name for block in self._blocks.values() for name in block.at_bounds(share)]

    def at_rest(self, device: torch.device | str = "cpu") -> Tensor:
        """The step (1, D) that changes nothing."""
        return torch.cat([block.at_rest(device) for block in self._blocks.values()], dim=-1)
