"""STL files as they come: damaged, oddly named, written twice."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import trimesh

from torchkcreg.io import read_mesh

BOX = trimesh.creation.box((10.0, 5.0, 60.0))
BINARY = BOX.export(file_type="stl")
TEXT = trimesh.exchange.stl.export_stl_ascii(BOX)


def body(mesh: trimesh.Trimesh) -> bytes:
    return mesh.export(file_type="stl")


@pytest.mark.parametrize(
    "content",
    [
        BINARY,
        b"solid of a binary file".ljust(80, b" ") + BINARY[80:],
        TEXT.encode(),
        TEXT.replace("\n", "\r\n").encode(),
        TEXT.upper().encode(),
        TEXT.replace("solid", "solid Pl\xe4tte", 1).encode("latin-1"),
        TEXT.replace("solid", "solid 骨板", 1).encode("utf-8"),
        (TEXT + "\n" + TEXT).encode(),  # the same solid twice
    ],
)
def test_a_whole_file_is_read(tmp_path, content):
    (tmp_path / "box.stl").write_bytes(content)
    mesh = read_mesh(tmp_path / "box.stl")
    assert len(mesh.faces) == 12
    assert mesh.volume == pytest.approx(3000.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (BINARY[:-70], "cut off or its count is wrong: 12 triangles take 684 bytes, it has 614"),
        (BINARY + b"\0" * 7, "its count is wrong or bytes follow: 12 triangles take 684 bytes, it has 691"),
        (BINARY[:80] + struct.pack("<I", 0) + BINARY[84:], "its count is wrong or bytes follow: 0 triangles"),
        (BINARY[:80] + struct.pack("<I", 2**32 - 1) + BINARY[84:], "its count is wrong"),
        (BINARY[:60], "no STL: 60 bytes"),
        (TEXT[: len(TEXT) // 2].encode(), "cut off or damaged"),
        (TEXT[:-30].encode(), "cut off or damaged"),
        (
            TEXT.replace("vertex -5.0", "vertex -5,0", 1).replace("vertex 5.0", "vertex 5,0", 1).encode(),
            "no number|damaged",
        ),
        (TEXT.replace("vertex", "vertex nan", 1).encode(), "damaged"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, content, message):
    (tmp_path / "box.stl").write_bytes(content)
    with pytest.raises(ValueError, match=rf"mesh file .*box\.stl cannot be read: .*({message})") as caught:
        read_mesh(tmp_path / "box.stl")
    assert "\n" not in str(caught.value)


def test_a_vertex_that_is_no_number_is_named(tmp_path):
    lines = TEXT.splitlines()
    first = next(i for i, line in enumerate(lines) if "vertex" in line)
    lines[first] = "vertex 1,5 2,0 3,0"
    (tmp_path / "box.stl").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"has a vertex that is no number: .*1,5"):
        read_mesh(tmp_path / "box.stl")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_vertex_that_is_not_finite_is_refused(tmp_path, value):
    content = bytearray(BINARY)
    struct.pack_into("<f", content, 84 + 12, value)
    (tmp_path / "box.stl").write_bytes(content)
    with pytest.raises(ValueError, match="finite vertices"):
        read_mesh(tmp_path / "box.stl")


def test_a_face_that_is_there_twice_counts_once(tmp_path):
    content = BINARY[:80] + struct.pack("<I", 13) + BINARY[84:] + BINARY[84:134]
    (tmp_path / "box.stl").write_bytes(content)
    assert read_mesh(tmp_path / "box.stl").volume == pytest.approx(3000.0)


def test_one_of_two_bodies_inside_out_is_turned(tmp_path):
    other = BOX.copy().apply_translation([30, 0, 0])
    other.invert()
    (tmp_path / "two.stl").write_bytes(body(trimesh.util.concatenate([BOX, other])))
    assert read_mesh(tmp_path / "two.stl").volume == pytest.approx(6000.0)


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_cavity_stays_one(tmp_path, inside_out):
    hollow = trimesh.creation.box((4.0, 2.0, 20.0))
    hollow.invert()
    whole = trimesh.util.concatenate([BOX, hollow, BOX.copy().apply_translation([30, 0, 0])])
    if inside_out:
        whole.invert()
    (tmp_path / "hollow.stl").write_bytes(body(whole))
    assert read_mesh(tmp_path / "hollow.stl").volume == pytest.approx(6000.0 - 160.0)
