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
    end = re.search(rb"^ElementDataFile[ \t]*[=:].*$", start, re.MULTILINE)
    if end is None:
        raise RuntimeError("its header has no ElementDataFile")
    lines = start[: end.end()].decode("latin-1").splitlines()
    parts = [re.sub("[=:]", "=", line, count=1).partition("=") for line in lines]
    pairs = [(key.strip(), value.strip()) for key, _, value in parts]
    header = dict(pairs)
    for key in (*_FLAGS, "NDims", "DimSize", "ElementNumberOfChannels"):
        if [name for name, _ in pairs].count(key) > 1:
            raise RuntimeError(f"its header has {key} twice")
    for flag in _FLAGS:
        if header.get(flag, "True").lower() not in ("true", "false", "t", "f", "1", "0"):
            raise RuntimeError(f"its header's {flag} must be True or False, got {header[flag]!r}")
    sizes = header.get("DimSize", "").split()
    if not re.fullmatch(r"[1-4]", header.get("NDims", "")) or len(sizes) != int(header["NDims"]):
        raise RuntimeError("its header's NDims and DimSize do not fit together")
    if not all(re.fullmatch(r"[1-9]\d{0,9}", size) for size in sizes):
        raise RuntimeError(f"its header's DimSize must be positive whole numbers, got {header['DimSize']!r}")
    if not re.fullmatch(r"[1-9]\d{0,3}", header.get("ElementNumberOfChannels", "1")):
        raise RuntimeError("its header's ElementNumberOfChannels must be a positive whole number")
