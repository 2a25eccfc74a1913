"""Ordered subsets of views: balanced over angles and focal spots, in an order that keeps successive ones apart."""

from __future__ import annotations

from collections.abc import Sequence


def ordered_subsets(num_views: int, num_subsets: int, *, sources: Sequence[str] | None = None) -> list[list[int]]:
    """Views of each subset, in the order in which to visit them.

    Views are dealt out like cards, focal spot by focal spot. Taking every n-th view instead would give subsets of one
    focal spot each where the firing order's period divides n. Subsets are visited in bit-reversed order, so that one
    differs as much as can be from those before.

    Args:
        num_views: V.
        num_subsets: at most V.
        sources: label of each view.

    Raises:
        ValueError: a number of subsets that is not between 1 and V, or labels that don't match.

    >>> ordered_subsets(8, 2, sources=list("ababcdcd"))
    [[0, 1, 4, 5], [2, 3, 6, 7]]
    """
    if not 1 <= num_subsets <= num_views:
        raise ValueError(f"subsets must be between 1 and the number of views {num_views}, got {num_subsets}")
    labels = [""] * num_views if sources is None else list(sources)
    if len(labels) != num_views:
        raise ValueError(f"sources must have one entry for each of {num_views} views, got {len(labels)}")
    dealt = [view for label in sorted(set(labels)) for view in range(num_views) if labels[view] == label]
    return [dealt[start::num_subsets] for start in bit_reversed(num_subsets)]


def bit_reversed(count: int) -> list[int]:
    """The numbers below count in the order of their reversed bits.

    >>> bit_reversed(6)
    [0, 4, 2, 1, 5, 3]
    """
    bits = max(1, (count - 1).bit_length())
    return [n for n in (int(f"{i:0{bits}b}"[::-1], 2) for i in range(1 << bits)) if n < count]
