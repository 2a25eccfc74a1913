"""STL files taken at their word only where they keep it: their length, their count and their end are checked."""

from __future__ import annotations

import re
import struct

import numpy as np
import trimesh

_HEADER, _TRIANGLE = 84, 50  # bytes
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_FLAGS = re.MULTILINE | re.IGNORECASE
_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t]*$", _FLAGS)
_WORDS = [re.compile(rb"^[ \t]*" + word + rb"\b", _FLAGS) for word in (b"facet", b"endfacet", b"solid", b"endsolid")]


def load_stl(content: bytes) -> trimesh.Trimesh:
    """The triangles of a binary or ASCII STL file, vertices not merged.

    A name in the first line means nothing, whatever its letters.

    Raises:
        ValueError: it is cut off, longer than it says, or no STL.
    """
    if is_text(content):
        return _load_text(content)
    if len(content) < _HEADER:
        raise ValueError(f"it is no STL: {len(content)} bytes, where a header alone has {_HEADER}")
    (count,) = struct.unpack_from("<I", content, 80)
    expected = _HEADER + _TRIANGLE * count
    if len(content) != expected:
        what = (
            "it is cut off or its count is wrong" if len(content) < expected else "its count is wrong or bytes follow"
        )
        raise ValueError(f"{what}: {count} triangles take {expected} bytes, it has {len(content)}")
    return _soup(np.frombuffer(content, _RECORD, count, _HEADER)["corners"])


def is_text(content: bytes) -> bool:
    """Whether an STL is ASCII: binary ones may begin with "solid" too, but their length fits their count."""
    if not content[:512].lstrip().lower().startswith(b"solid"):
        return False
    if len(content) >= _HEADER and len(content) == _HEADER + _TRIANGLE * struct.unpack_from("<I", content, 80)[0]:
        return False
    return b"\0" not in content


def _load_text(content: bytes) -> trimesh.Trimesh:
    lines = content.replace(b"\r", b"\n")
    facets, ends, solids, closed = (len(w.findall(lines)) for w in _WORDS)
    corners = _VERTEX.findall(lines)
    if facets != ends or solids != closed or len(corners) != 3 * facets:
        raise ValueError(
            f"it is cut off or damaged: {facets} facets begin and {ends} end, with {len(corners)} vertices; "
            f"{solids} solids begin and {closed} end"
        )
    try:
        return _soup(np.array(corners).astype(np.float64))
    except ValueError as error:
        raise ValueError(f"it has a vertex that is no number: {error}") from None


def _soup(corners: np.ndarray) -> trimesh.Trimesh:
    vertices = corners.astype(np.float64).reshape(-1, 3)
    return trimesh.Trimesh(vertices, np.arange(len(vertices)).reshape(-1, 3), process=False)
