"""What a registration would start from, without registering anything."""

from __future__ import annotations

import re

import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.io import read_geometry, read_mesh, write_init


def flags(small_case, out, *more):
    files = {"implant": "implant.stl", "geometry": "geometry.json", "projections": "projections.npz"}
    named = [part for key, name in files.items() for part in (f"--{key}", str(small_case / name))]
    return ["register", *named, "--config", str(small_case / "quick.yaml"), "--out", str(out), "--dry-run", *more]


def test_it_says_where_the_implant_lies_and_draws_it(small_case, tmp_path, capsys):
    assert main(flags(small_case, tmp_path / "run", "--material", "steel")) == 0
    out = capsys.readouterr().out
    assert "steel" in out and "nothing was registered" in out
    assert (tmp_path / "run-start.png").stat().st_size > 5000
    assert [path.name for path in tmp_path.iterdir()] == ["run-start.png"]
    geometry, mesh = read_geometry(small_case / "geometry.json"), read_mesh(small_case / "implant.stl")
    uv, depth = geometry.project(torch.as_tensor(mesh.vertices, dtype=torch.float64))
    for view, line in enumerate(line for line in out.splitlines() if line.startswith("  view")):
        low, high, cols = (int(x) for x in re.search(r"columns (-?\d+) to (-?\d+) of (\d+)", line).groups())
        assert cols == geometry.det_shape[1]
        assert [low, high] == pytest.approx([float(uv[view, :, 0].amin()), float(uv[view, :, 0].amax())], abs=2)
        magnified = float(re.search(r"magnified ([\d.]+)", line).group(1))
        assert magnified == pytest.approx(float(geometry.detector_distances[view] / depth[view].median()), abs=0.05)


def test_wrong_input_is_told_as_by_the_registration(small_case, tmp_path, capsys):
    away = torch.eye(4, dtype=torch.float64)
    away[0, 3] = 5000.0
    write_init(tmp_path / "init.json", away)
    assert main(flags(small_case, tmp_path / "run", "--init", str(tmp_path / "init.json"))) == 2
    assert "behind the X-ray source" in capsys.readouterr().err
    assert main(flags(small_case, tmp_path / "run", "--views", "7")) == 2
    assert "view" in capsys.readouterr().err
    assert not (tmp_path / "run-start.png").exists()
    assert main(flags(small_case, tmp_path / "run", "--no-figures")) == 0
    assert not (tmp_path / "run-start.png").exists()
