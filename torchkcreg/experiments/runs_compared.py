"""Which of several registrations of the same images explains them better."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchkcreg.io import read_config
from torchkcreg.io.files import read_json

_IMAGES = ("projections", "geometry", "views", "open_beam")


def runs_compared(paths: Sequence[Path]) -> str:
    """Lines that rank those of the paths that are run folders of the same images by Akaike's criterion, best first.

    ``n ln(misfit) + 2 p``: n is the number of blocks of pixels that say something, misfit what of the images' contrast
    is left unexplained, p the number of parameters that the images determine (of which priors leave a part). Only
    differences mean something; one of 10 is a clear one. Empty where there are fewer than two such runs.

    Args:
        paths: Run folders, and others, which are passed over.
    """
    runs = [(path, *told) for path in paths if (told := _told(path)) is not None]
    same = [run for run in runs if run[1] == runs[0][1]]
    if len(same) < 2:
        return ""
    blocks = sum(found["blocks"] for *_, found in same) / len(same)
    ranked = sorted((blocks * math.log(f["misfit"]) + 2 * f["effective_parameters"], path, f) for path, _, f in same)
    lines = ["which explains the same images better (difference of Akaike's criterion):"]
    for value, path, found in ranked:
        words = f"misfit {found['misfit']:.4f} with {found['effective_parameters']:.1f} effective parameters"
        lines.append(f"  {path}: +{value - ranked[0][0]:.1f}, {words}")
    return "\n".join(lines)


def _told(path: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """The images of a finished run, and its diagnostics; None for anything else."""
    if not ((path / "config.yaml").is_file() and (path / "metrics.json").is_file()):
        return None
    files = read_config(path / "config.yaml").get("files")
    found = read_json(path / "metrics.json", "metrics").get("diagnostics", {})
    if not isinstance(files, dict) or not all(found.get(key) for key in ("blocks", "misfit", "effective_parameters")):
        return None
    return {name: files.get(name) for name in _IMAGES}, found
