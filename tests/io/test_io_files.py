import errno
import json
import math
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchkcreg.io.files import atomic_path, read_json, write_json, write_text
from torchkcreg.plain import finite_array, plain


def test_a_file_that_was_written_holds_the_text_and_nothing_lies_beside_it(tmp_path):
    write_text(tmp_path / "note.txt", "größer")
    assert (tmp_path / "note.txt").read_text(encoding="utf-8") == "größer"
    assert [entry.name for entry in tmp_path.iterdir()] == ["note.txt"]


def test_a_failing_write_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="disk"), atomic_path(tmp_path / "new.txt") as temporary:
        temporary.write_text("half of")
        raise RuntimeError("disk full")
    assert list(tmp_path.iterdir()) == []


def test_a_failing_write_leaves_the_old_file_as_it_was(tmp_path):
    write_text(tmp_path / "note.txt", "old")
    with pytest.raises(RuntimeError, match="disk"), atomic_path(tmp_path / "note.txt") as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError("disk full")
    assert (tmp_path / "note.txt").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_the_temporary_name_keeps_the_suffix_and_the_folder(tmp_path):
    with atomic_path(tmp_path / "volume.nii.gz") as temporary:
        assert temporary.name.endswith("volume.nii.gz")
        assert temporary.parent == tmp_path
        temporary.write_bytes(b"1")


def test_writing_into_a_folder_that_is_not_there_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match="missing does not exist"):
        write_text(tmp_path / "missing" / "note.txt", "")


def test_writing_over_a_folder_is_refused(tmp_path):
    with pytest.raises(IsADirectoryError, match="is a folder"):
        write_text(tmp_path, "")


def test_numbers_survive_json_to_the_last_bit(tmp_path):
    values = torch.randn(50, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    write_json(tmp_path / "a.json", {"values": values})
    assert torch.equal(torch.tensor(read_json(tmp_path / "a.json", "a")["values"], dtype=torch.float64), values)


def test_plain_turns_tensors_arrays_scalars_tuples_and_paths_into_what_json_holds(tmp_path):
    content = plain(
        {1: torch.eye(2), "a": np.float32(0.5), "b": (np.int64(3), None, True), "p": tmp_path, "n": math.nan}
    )
    assert content == {"1": [[1.0, 0.0], [0.0, 1.0]], "a": 0.5, "b": [3, None, True], "p": str(tmp_path), "n": None}
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_plain_says_what_it_cannot_write_and_where():
    with pytest.raises(ValueError, match=r"cannot write a set .*\['a'\]\[1\]"):
        plain({"a": [1, {2}]})


def test_json_that_is_none_is_named_with_the_line(tmp_path):
    (tmp_path / "bad.json").write_text('{\n "a": 1,\n "b" 2}')
    with pytest.raises(ValueError, match=r"geometry file .*bad\.json is not valid JSON: .*line 3"):
        read_json(tmp_path / "bad.json", "geometry")


def test_a_binary_file_is_no_text(tmp_path):
    (tmp_path / "bad.json").write_bytes(b"\xff\xd8\x00\x81")
    with pytest.raises(ValueError, match=r"bad\.json is not a text file"):
        read_json(tmp_path / "bad.json", "geometry")


def test_a_missing_file_and_a_folder_are_told_apart(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"geometry file .*none\.json does not exist"):
        read_json(tmp_path / "none.json", "geometry")
    with pytest.raises(ValueError, match="is not a file"):
        read_json(tmp_path, "geometry")


@pytest.mark.parametrize(
    "value", [[1, 2], [[1], [2, 3]], ["a", "b", "c"], None, [1, 2, math.nan], [True, False, True], {}]
)
def test_an_array_of_another_shape_or_kind_is_refused_by_name(value):
    with pytest.raises(ValueError, match=r"^radii must be"):
        finite_array(value, (3,), "radii")


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), RuntimeError("fail after write")])
def test_a_full_disk_is_named_whatever_the_writer_says(error, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=10))
    full = r"the disk is full, .*volume\.mha was not written: make room"
    with pytest.raises(OSError, match=full) as told, atomic_path(tmp_path / "volume.mha"):
        raise error
    assert told.value.errno == errno.ENOSPC and not list(tmp_path.iterdir())


def test_another_error_is_no_full_disk(tmp_path):
    with pytest.raises(RuntimeError, match="something else"), atomic_path(tmp_path / "volume.mha"):
        raise RuntimeError("something else")
