"""Headers of MetaImage files (MHA, MHD), looked at before ITK's reader, which does not survive some damaged ones."""

from __future__ import annotations

import re
from pathlib import Path

META_SUFFIXES = (".mha", ".mhd")
_LONGEST = 1 << 16  # bytes of a header
_FLAGS = ("BinaryData", "BinaryDataByteOrderMSB", "ElementByteOrderMSB", "CompressedData")


def check_meta_header(path: Path) -> None:
    """Nothing; RuntimeError where a header is not as its format has it.

    A wrong flag makes ITK read binary data as text and write beyond its memory.
    """
    with path.open("rb") as file:
        start = file.read(_LONGEST)
    end = re.search(rb"^ElementDataFile *=.*$", start, re.MULTILINE)
    if end is None:
        raise RuntimeError("its header has no ElementDataFile")
    lines = start[: end.end()].decode("latin-1").splitlines()
    pairs = [line.split("=", 1) for line in lines if line.strip()]
    if any(len(pair) != 2 or not re.fullmatch(r"\w+", pair[0].strip()) for pair in pairs):
        raise RuntimeError("its header has a line that is no key and value")
    header = {key.strip(): value.strip() for key, value in pairs}
    if len(header) < len(pairs):
        raise RuntimeError("its header has a key twice")
    for flag in _FLAGS:
        if header.get(flag, "True").lower() not in ("true", "false"):
            raise RuntimeError(f"its header's {flag} must be True or False, got {header[flag]!r}")
    sizes = header.get("DimSize", "").split()
    if not re.fullmatch(r"[1-4]", header.get("NDims", "")) or len(sizes) != int(header["NDims"]):
        raise RuntimeError("its header's NDims and DimSize do not fit together")
    if not all(re.fullmatch(r"[1-9]\d{0,9}", size) for size in sizes):
        raise RuntimeError(f"its header's DimSize must be positive whole numbers, got {header['DimSize']!r}")
    if not re.fullmatch(r"[1-9]\d{0,3}", header.get("ElementNumberOfChannels", "1")):
        raise RuntimeError("its header's ElementNumberOfChannels must be a positive whole number")
