"""Files that were damaged, one way or another: read, or refused in one line that names the file."""

from __future__ import annotations

import json
import random
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchkcreg.geometry import MultisourceScanner, VolumeGrid
from torchkcreg.implant import Screw
from torchkcreg.io import (
    read_components,
    read_config,
    read_geometry,
    read_init,
    read_mesh,
    read_point_cloud_ply,
    read_points,
    read_projections,
    read_reference,
    read_spectrum,
    read_volume,
    write_components,
    write_geometry,
    write_init,
    write_mesh,
    write_point_cloud_ply,
    write_points,
    write_projections,
    write_spectrum,
    write_volume,
)
from torchkcreg.physics import tungsten_spectrum

VIEWS = MultisourceScanner().geometry().select([0, 1])
PIXELS: dict[str, Any] = {"det_shape": VIEWS.det_shape, "pixel_spacing": VIEWS.pixel_spacing}
BOX = trimesh.creation.box((12.0, 4.0, 90.0))
_TOKENS = [
    b"",
    b"0",
    b"-1",
    b"1e999",
    b"nan",
    b"NaN",
    b"Infinity",
    b"null",
    b"true",
    b'""',
    b"[]",
    b"{}",
    b",",
    b";",
    b"\t",
]
_TOKENS += [b"\n", b"\0", b"\xff", b"\xef\xbb\xbf", b"1,5", b"9" * 40, b"#", b'"', b"\r\n", b"solid", b"\xc3\xa9"]

_SWAPS = [(b",", b";"), (b".", b","), (b"\n", b"\r"), (b" ", b"")]


def _images() -> np.ndarray:
    return np.random.default_rng(0).integers(100, 3000, (3, 8, 10)).astype(np.uint16)


def _raw_npz(path: Path) -> None:
    """Not compressed, so that a mutated byte arrives."""
    np.savez(path, intensity=_images(), open_beam=3000.0, saturation=4095)


def _stack(path: Path) -> None:
    sitk.WriteImage(sitk.GetImageFromArray(_images()), str(path))


def _hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["exchange/data"], file["exchange/data_white"] = _images(), np.full((2, 8, 10), 3000, np.uint16)


def _dicom(path: Path) -> None:
    image = sitk.GetImageFromArray(_images()[:1])
    tags = {"0008|0060": "XA", "0018|1110": "1200", "0018|1111": "750", "0018|1164": "0.3\\0.3", "0018|1510": "20"}
    for tag, value in tags.items():
        image.SetMetaData(tag, value)
    sitk.WriteImage(image, str(path))


def _described(path: Path) -> None:
    _images().tofile(path.with_suffix(".raw"))
    raw = "{shape: [3, 8, 10], type: uint16, skip_bytes: 0}"
    path.write_text(f"images: {path.stem}.raw\nopen_beam: 3000.0\nsaturation: 65535\nraw: {raw}\n")


def _points(path: Path) -> None:
    write_points(path, torch.arange(18.0).reshape(6, 3))


Reader = tuple[str, Callable[[Path], Any], Callable[[Path], Any]]
READERS: dict[str, Reader] = {
    "geometry": ("g.json", lambda p: write_geometry(p, MultisourceScanner().geometry().select([0, 1])), read_geometry),
    "rtk": ("g.xml", lambda p: write_geometry(p, VIEWS), lambda p: read_geometry(p, **PIXELS)),
    "matrices, npy": ("g.npy", lambda p: write_geometry(p, VIEWS), lambda p: read_geometry(p, **PIXELS)),
    "matrices, npz": ("g.npz", lambda p: write_geometry(p, VIEWS), lambda p: read_geometry(p, **PIXELS)),
    "matrices, csv": ("g.csv", lambda p: write_geometry(p, VIEWS), lambda p: read_geometry(p, **PIXELS)),
    "point cloud": ("p.ply", lambda p: write_point_cloud_ply(p, torch.rand(6, 3)), read_point_cloud_ply),
    "points": ("p.csv", _points, read_points),
    "spectrum": ("s.csv", lambda p: write_spectrum(p, tungsten_spectrum(70)), read_spectrum),
    "components": (
        "c.json",
        lambda p: write_components(p, [Screw((0.0, 0.0, 0.0), (0.0, 9.0, 0.0), 1.5, "steel", "a")]),
        read_components,
    ),
    "init": ("i.json", lambda p: write_init(p, torch.eye(4, dtype=torch.float64)), read_init),
    "config": ("c.yaml", lambda p: p.write_text("material: steel\nstages:\n- {bin: 2, groups: 1}\n"), read_config),
    "npz": ("n.npz", lambda p: write_projections(p, intensity=_images(), open_beam=3000.0), read_projections),
    "raw npz": ("n.npz", _raw_npz, read_projections),
    "npy": ("n.npy", lambda p: np.save(p, _images() / 3000.0), read_projections),
    "mha": ("n.mha", _stack, lambda p: read_projections(p, open_beam=3000.0)),
    "nrrd": ("n.nrrd", _stack, lambda p: read_projections(p, open_beam=3000.0)),
    "tiff": ("n.tif", _stack, lambda p: read_projections(p, open_beam=3000.0)),
    "hdf5": ("n.h5", _hdf5, read_projections),
    "dicom": ("n.dcm", _dicom, lambda p: (read_geometry(p), read_projections(p, open_beam=3000.0))[1]),
    "scan description": ("n.yaml", _described, read_projections),
    "binary stl": ("m.stl", lambda p: write_mesh(p, BOX), read_mesh),
    "text stl": ("m.stl", lambda p: p.write_text(trimesh.exchange.stl.export_stl_ascii(BOX)), read_mesh),
    "obj": ("m.obj", lambda p: write_mesh(p, BOX), read_mesh),
    "ply": ("m.ply", lambda p: write_mesh(p, BOX), read_mesh),
    "off": ("m.off", lambda p: write_mesh(p, BOX), read_mesh),
    "reference": ("r.csv", _points, read_reference),
    "volume": ("v.mha", lambda p: write_volume(p, torch.rand(3, 4, 5), VolumeGrid((3, 4, 5), 1.0)), read_volume),
}


def mutated(content: bytes, seed: int) -> bytes:
    """Content with one to four places cut out, doubled, overwritten, or filled with something else."""
    chance = random.Random(seed)
    data = bytearray(content)
    for _ in range(chance.choice([1, 1, 1, 2, 4])):
        start = chance.randrange(len(data) + 1)
        end = min(len(data), start + chance.choice([0, 1, 1, 2, 5, 20, 200]))
        way = chance.randrange(6)
        if way == 0:
            del data[start:end]
        elif way == 1:
            data[start:start] = data[start:end]
        elif way == 2:
            data[start:end] = chance.choice(_TOKENS)
        elif way == 3 and data:
            data[min(start, len(data) - 1)] = chance.randrange(256)
        elif way == 4:
            del data[start:]
        else:
            data = bytearray(
                bytes(data).replace(*chance.choice([(b",", b";"), (b".", b","), (b"\n", b"\r"), (b" ", b"")]))
            )
    return bytes(data)


def finite(result: Any) -> bool:
    """Whether what was read holds numbers only."""
    if isinstance(result, trimesh.Trimesh):
        return bool(np.isfinite(result.vertices).all()) and result.volume > 0
    if isinstance(result, torch.Tensor):
        return bool(result.isfinite().all())
    if hasattr(result, "line_integrals"):
        return bool(result.line_integrals.isfinite().all())
    if hasattr(result, "projection_matrices"):
        return bool(result.projection_matrices.isfinite().all())
    return True


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("examples", [200, pytest.param(10000, marks=pytest.mark.slow)])
def test_a_damaged_file_is_read_or_refused_in_one_line(kind: str, examples: int, tmp_path: Path) -> None:
    name, write, read = READERS[kind]
    write(tmp_path / name)
    content, path = (tmp_path / name).read_bytes(), tmp_path / f"damaged-{name}"

    @settings(max_examples=examples, deadline=5000, suppress_health_check=list(HealthCheck), derandomize=True)
    @given(st.integers(0, 2**32))
    def damaged(seed: int) -> None:
        path.write_bytes(mutated(content, seed))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                result = read(path)
        except (ValueError, OSError) as error:
            assert not isinstance(error, (UnicodeError, json.JSONDecodeError)), error
            assert path.name in str(error) and "\n" not in str(error), error
        else:
            assert finite(result)

    assert finite(read(tmp_path / name))
    damaged()
