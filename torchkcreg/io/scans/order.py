"""Files in the order that people expect."""

from __future__ import annotations

import re
from pathlib import Path


def by_number(file: Path) -> list[tuple[int, str]]:
    """What to sort by: view_2 before view_10.

    >>> [path.name for path in sorted([Path("v10.tif"), Path("v2.tif")], key=by_number)]
    ['v2.tif', 'v10.tif']
    """
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", file.name.lower())]
