"""The page of a folder of results: all in one file, the verdict first, nothing from outside."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.commands import RegistrationFiles, register_files, write_report
from torchkcreg.commands.register import _bending as bending_of
from torchkcreg.commands.report import implant_scene
from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.io import read_point_cloud_ply, read_run, write_point_cloud_ply

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)


@pytest.fixture(scope="module")
def run(small_case, tmp_path_factory):
    """A finished registration with its pictures."""
    out = tmp_path_factory.mktemp("report") / "a <run>"
    names = {"implant": "implant.stl", "geometry": "geometry.json", "projections": "projections.npz"}
    files = RegistrationFiles(
        **{key: small_case / name for key, name in names.items()}, config=small_case / "quick.yaml"
    )
    register_files(files, out, overrides={"material": "steel"})
    return out


@pytest.fixture(scope="module")
def page(run):
    return write_report(run).read_text(encoding="utf-8")


def test_the_verdict_comes_first_and_every_picture_is_inside(run, page):
    result = read_run(run)
    assert page.index(f"<b>{result.status}</b>") < page.index("<table>") < page.index("<img")
    assert len(list(run.glob("*.png"))) >= 3
    assert page.count("data:image/png;base64,") == len(list(run.glob("*.png"))) + 2 * 3  # and three views, twice
    for text in result.warnings:
        assert text.split(":")[0].replace("'", "&#x27;") in page
    assert "Registration: a &lt;run&gt;" in page and "a <run>" not in page


def test_the_page_asks_for_nothing_from_outside(page):
    assert not re.findall(r"(?:src|href)=[\"'](?!data:)", page)
    assert "http:" not in page and "https:" not in page and "default-src 'none'" in page


def test_the_scene_has_the_implants_nodes_and_the_registered_views(run, page):
    scene = json.loads(re.search(r'<script type="application/json">(.*?)</script>', page, re.DOTALL).group(1))
    table = read_point_cloud_ply(run / "implant_deformed.ply")
    assert len(scene["points"]) == 3 * min(6000, len(table["x"])) == len(scene["moved"])
    assert max(scene["displacement"]) == pytest.approx(float(table["displacement"].max()), abs=0.05)
    assert len(scene["sources"]) == len(scene["detectors"]) == 3 and len(scene["detectors"][0]) == 4


def test_the_views_can_be_laid_over_each_other(run, page):
    held = np.load(run / "overlay.npz")
    grey, overlay = held["grey"], held["overlay"]
    assert overlay.shape == (*grey.shape, 3) and len(held["labels"]) == 3
    green = overlay[..., 1].astype(int) - overlay[..., 0]
    assert 0.02 < (green > 30).mean() < 0.6  # the implant, and not all of the view
    same = green == 0
    np.testing.assert_allclose(overlay[same][:, 0].astype(int), grey[same], atol=1)
    for label in held["labels"]:
        assert f"<option>{label}</option>" in page
    assert "<option>blink</option>" in page and "<option>checkerboard</option>" in page


def test_a_registration_writes_its_page_and_one_without_pictures_none(run):
    assert "The implant over the measured views" in (run / "report.html").read_text(encoding="utf-8")
    (run / "overlay.npz").rename(run / "kept.npz")
    (run / "overlay.npz").write_bytes(b"damaged")
    page = write_report(run, out=run.parent / "other.html").read_text(encoding="utf-8")
    (run / "kept.npz").replace(run / "overlay.npz")
    assert "The implant over the measured views" not in page and "<table>" in page


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_a_browser_draws_the_scene_without_errors(run, page, tmp_path):
    copy = tmp_path / "report.html"
    copy.write_text(page, encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2000", "--dump-dom"]
    done = subprocess.run([CHROMIUM, *flags, copy.as_uri()], capture_output=True, text=True, timeout=60, check=True)
    assert "<output>1 x</output>" in done.stdout and 'width="' in re.search(r"<canvas[^>]*>", done.stdout).group(0)


def test_other_folders_of_results_have_a_page_too(tmp_path, capsys):
    (tmp_path / "metrics.json").write_text('{"shape": [4, 5, 6], "spacing_mm": [1, 1, 2], "seconds": 12.3}')
    (tmp_path / "compare.json").write_text('{"rotation": {"x_deg": 1.25, "x_deg_std": 0.04}}')
    assert main(["report", str(tmp_path), "--out", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    assert str(tmp_path / "page.html") in capsys.readouterr().out
    assert "6 x 5 x 4" in page and "12 s" in page and "<h1>Comparison: " in page
    assert "rotation x deg" in page and "1.25" in page and "0.04" in page
    assert '<div class="verdict' not in page


def test_a_folder_without_results_is_refused(tmp_path, capsys):
    assert main(["report", str(tmp_path)]) == 2
    assert "holds no results" in capsys.readouterr().err
    assert main(["report", str(tmp_path / "nothing")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_point_clouds_come_back_and_damaged_ones_are_told(tmp_path):
    points = torch.rand(5, 3)
    write_point_cloud_ply(tmp_path / "a.ply", points, points / 2, torch.ones(5))
    table = read_point_cloud_ply(tmp_path / "a.ply")
    assert torch.equal(torch.stack([table[name] for name in "xyz"], -1), points)
    assert torch.equal(table["dx"], points[:, 0] / 2) and torch.equal(table["std"], torch.ones(5))
    content = (tmp_path / "a.ply").read_bytes()
    damaged = {
        b"no ply": "no binary PLY",
        content[:-3]: "does not hold the 5 points",
        content.replace(b"float y", b"float q"): "x, y, z",
    }
    for broken, reason in damaged.items():
        (tmp_path / "b.ply").write_bytes(broken)
        with pytest.raises(ValueError, match=reason):
            read_point_cloud_ply(tmp_path / "b.ply")


def test_a_reconstructions_page_says_what_was_found_of_scatter_beam_and_metal(tmp_path):
    (tmp_path / "volume.mha").touch()
    metrics = {"scatter": {"fraction": 0.4}, "beam": {"kvp": 90.0, "scales": [1.02]}, "components": ["steel", "steel"]}
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    page = write_report(tmp_path).read_text(encoding="utf-8")
    assert "<h1>Reconstruction: " in page and "scatter: fraction" in page and "estimated beam: kvp" in page
    assert "known metal" in page and "steel, steel" in page
    assert "expected error" not in page  # of none of these


def test_bending_is_what_a_rigid_motion_does_not_explain():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)).double() * 50
    turned = transform_points(
        rigid_matrix(torch.tensor([0.1, 0.2, -0.1]), torch.tensor([1.0, 2.0, 3.0])).double(), points
    )
    assert bending_of(points, turned) < 1e-5
    bent = points + torch.stack([0 * points[:, 0], 0.001 * (points[:, 2] - 25) ** 2, 0 * points[:, 0]], dim=-1)
    assert 0.2 < bending_of(points, bent) < 0.7


def test_the_3d_view_opens_nearly_face_on():
    generator = torch.Generator().manual_seed(1)
    plate = torch.rand(500, 3, generator=generator) * torch.tensor([12.0, 3.0, 100.0])  # thin along y
    scene = implant_scene(plate, torch.zeros_like(plate), torch.zeros(500))
    off = (scene["yaw"] - 0.5) % math.pi
    assert min(off, math.pi - off) < 0.05


def test_a_folder_with_pictures_alone_is_no_result(tmp_path, capsys):
    (tmp_path / "holiday.png").write_bytes(b"")
    assert main(["report", str(tmp_path)]) == 2
    assert "holds no results" in capsys.readouterr().err
