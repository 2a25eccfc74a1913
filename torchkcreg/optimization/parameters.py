"""Named blocks of the parameters of an optimisation, with bounds and penalties."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor


class ParameterBlock:
    """Steps from the current state, scaled so that a step of 1 changes an image about as much as a motion by 1 mm.

    Zeros change nothing. Derive from it and set `num_parameters`; all other members have defaults.

    Attributes:
        num_parameters: Number of parameters.
        loss_of_deviation: Penalty of a parameter that is one standard deviation off the mean of its prior, if the
            penalty is quadratic in such deviations; else 0.
    """

    num_parameters: int
    loss_of_deviation: float = 0.0

    def weigh(self, loss: float) -> None:
        """Set the loss of one standard deviation of the images, for priors without given weight. Ignored by default."""

    def clamp(self, steps: Tensor) -> Tensor:
        """Steps (K, D) clamped to their bounds. Unchanged by default."""
        return steps

    def penalty(self, steps: Tensor) -> Tensor:
        """Penalty (prior) of steps (K, D) in units of the loss, shape (K,). Zero by default."""
        return steps.new_zeros(steps.shape[:-1])

    def at_bounds(self, share: float) -> list[str]:
        """Names of parameters within `share` of their range from a bound. None by default."""
        return []

    def at_rest(self, device: torch.device | str = "cpu") -> Tensor:
        """The step (1, D) that changes nothing."""
        return torch.zeros(1, self.num_parameters, dtype=torch.float64, device=device)


class ParameterBlocks(Mapping[str, ParameterBlock]):
    """Named blocks, concatenated in one vector.

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
        """Number of parameters of all blocks."""
        return sum(block.num_parameters for block in self._blocks.values())

    @property
    def places(self) -> dict[str, slice]:
        """Slice of each block in the vector."""
        slices, start = {}, 0
        for name, block in self._blocks.items():
            slices[name] = slice(start, start := start + block.num_parameters)
        return slices

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
        """Parameters (K, D) clamped to their bounds."""
        parts = self.split(parameters)
        return torch.cat([self._blocks[name].clamp(part) for name, part in parts.items()], dim=-1)

    def penalty(self, parameters: Tensor) -> Tensor:
        """Sum of the penalties of all blocks for parameters (K, D), shape (K,)."""
        parts = self.split(parameters)
        return torch.stack([self._blocks[name].penalty(part) for name, part in parts.items()]).sum(0)

    def at_bounds(self, share: float) -> list[str]:
        """Names of parameters within `share` of their range from a bound."""
        return [name for block in self._blocks.values() for name in block.at_bounds(share)]

    def at_rest(self, device: torch.device | str = "cpu") -> Tensor:
        """The step (1, D) that changes nothing."""
        return torch.cat([block.at_rest(device) for block in self._blocks.values()], dim=-1)
