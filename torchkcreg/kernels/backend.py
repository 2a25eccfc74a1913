"""What a backend says of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Backend:
    """Something that computes operators on some devices.

    Attributes:
        name: What users call it.
        devices: Types of devices that it serves, such as "cpu"; None: every one.
        unavailable: Makes its kernels ready at the first call; None, or why they cannot be had.
        operators: Names of the operators that it has kernels for; None: all.
        is_reference: It is the readable definition, correct and slow.
    """

    name: str
    devices: frozenset[str] | None
    unavailable: Callable[[], str | None]
    operators: frozenset[str] | None = None
    is_reference: bool = False

    def serves(self, device: str, operator: str | None) -> bool:
        """Whether it has a kernel of an operator for a type of device."""
        on_device = self.devices is None or device in self.devices
        return on_device and (operator is None or self.operators is None or operator in self.operators)
