"""Figures on disk."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from torchkcreg.io.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_figure(path: str | os.PathLike[str], figure: Figure, *, dpi: int = 150) -> None:
    """Nothing; writes a matplotlib figure, whole or not at all, its format chosen by the suffix (.png, .pdf, .svg)."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
