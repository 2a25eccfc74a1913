"""A whole visit through the command line: motion of the fracture, load on the plate, page, and wrong input."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.cli import main
from torchkcreg.commands.visit_doubts import beyond_the_screws, turned_around
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_components, read_mesh, write_config, write_projections
from torchkcreg.simulation import weight_bearing_case

STAGES = [
    {"bin": 2, "iterations": 6, "oversampling": 1},
    {"groups": 2, "iterations": 4, "oversampling": 1, "similarity": "gradient-difference"},
]


@pytest.fixture(scope="module")
def scans(small_case, tmp_path_factory):
    """Folder of the scans: without load, with load, and one of another size."""
    folder = tmp_path_factory.mktemp("scans")
    for name, amount in (("rest", 0.0), ("stand", 1.0)):
        case = weight_bearing_case(amount, seed=2, binning=4)
        write_projections(folder / f"{name}.npz", intensity=case.intensity, open_beam=case.open_beam)
    np.savez(folder / "broken.npz", line_integrals=np.zeros((3, 20, 20), np.float32))
    write_config(folder / "quick.yaml", {"pitch_mm": 1.0, "stages": STAGES, "start": "given"})
    return folder


def command(small_case, scans, out, *loaded, unloaded="rest", screws=True):
    given = ["assess", f"--implant={small_case / 'implant.stl'}", "--material=steel", "--no-volumes"]
    given += [f"--geometry={small_case / 'geometry.json'}", f"--unloaded={scans / f'{unloaded}.npz'}"]
    given += [f"--config={scans / 'quick.yaml'}", f"--spectrum={small_case / 'spectrum.csv'}", f"--out={out}"]
    given += [f"--screws={small_case / 'screws.json'}"] if screws else []
    return [*given, "--loaded", *(str(scans / f"{name}.npz") for name in loaded)]


@pytest.fixture(scope="module")
def visit(small_case, scans, tmp_path_factory):
    """Folder of an assessment of one scan under load, with another that cannot be read as one."""
    out = tmp_path_factory.mktemp("visit") / "visit"
    assert main([*command(small_case, scans, out, "stand", "broken"), "--loads", "600", "700"]) == 0
    return out


def test_the_answer_has_the_motion_the_load_and_the_places_of_the_bone(visit):
    content = json.loads((visit / "assess.json").read_text())
    stand = content["configurations"][0]
    assert (stand["name"], stand["load_n"]) == ("stand", 600.0)
    turns = [stand[f"{name}_deg"] for name in ("bending_out_of_plane", "bending_in_plane", "twist")]
    assert np.linalg.norm(turns) == pytest.approx(stand["rotation_deg"], rel=1e-6)
    assert 0.3 < stand["rotation_deg"] < 5 and 0 < stand["rotation_std_deg"] < 2
    assert list(stand["places"]) == ["gap", "near cortex", "bone axis", "far cortex"]
    far, near = (stand["places"][name]["translation_mm"] for name in ("far cortex", "near cortex"))
    assert far > near  # the plate is the hinge
    moments = [stand[f"{name}_moment_nmm"] for name in ("bending_out_of_plane", "bending_in_plane", "twist")]
    assert np.linalg.norm(moments) == pytest.approx(stand["moment_nmm"], rel=1e-6)
    assert stand["moment_std_nmm"] > 0
    assert stand["share_of_yield"] == pytest.approx(stand["stress_mpa"] / 690, rel=0.2)
    assert content["answer"][0].startswith("Under 600 N the upper fragment tilts by")
    # the plate is bent by angles, far more than 600 N along the bone's axis would
    assert "callus" not in content and any("no stiffness of the gap is given" in text for text in content["warnings"])
    assert any("--rest" in line and "--out" in line for line in content["commands"])


def test_a_scan_that_cannot_be_registered_is_listed_and_stops_nothing(visit):
    broken = json.loads((visit / "assess.json").read_text())["configurations"][1]
    assert broken["status"] == "failed" and "(3, 20, 20)" in broken["reasons"][0]
    assert "rotation_deg" not in broken
    assert not (visit / "broken" / "deformation.json").exists()


def test_the_page_gives_the_answer_first_and_needs_nothing_from_outside(visit):
    page = (visit / "report.html").read_text(encoding="utf-8")
    assert page.index("Under 600 N the upper fragment") < page.index('class="tile"') < page.index("<table>")
    assert not re.findall(r"(?:src|href)=[\"'](?!data:)", page)
    scene = json.loads(re.search(r'<script type="application/json">(.*?)</script>', page, re.DOTALL).group(1))
    assert scene["ghost"] and len(scene["lines"]) == len(scene["linesMoved"]) > 0
    moved = torch.tensor(scene["moved"]).reshape(-1, 3).norm(dim=-1)
    assert float(moved.min()) < 0.2 < float(moved.max())  # the lower fragment stays
    before = page
    (visit / "report.html").unlink()
    assert main(["report", str(visit)]) == 0
    assert (visit / "report.html").read_text(encoding="utf-8") == before


def test_it_goes_on_where_it_ended_and_keeps_finished_registrations(small_case, scans, visit, capsys):
    again = [*command(small_case, scans, visit, "stand", "broken"), "--loads", "600", "700"]
    assert main(again) == 2
    assert "holds a run already" in capsys.readouterr().err
    before = (visit / "assess.json").read_text()
    stamp = (visit / "stand" / "deformation.json").stat().st_mtime_ns
    (visit / "assess.json").unlink()
    assert main([*again, "--resume"]) == 0
    assert (visit / "stand" / "deformation.json").stat().st_mtime_ns == stamp
    assert json.loads((visit / "assess.json").read_text()) == json.loads(before)


def test_the_same_scan_twice_has_not_moved(small_case, scans, tmp_path):
    (tmp_path / "same.npz").write_bytes((scans / "rest.npz").read_bytes())
    given = command(small_case, scans, tmp_path / "out", "rest")
    given[-1] = str(tmp_path / "same.npz")
    assert main([*given, "--no-figures"]) == 0
    same = json.loads((tmp_path / "out" / "assess.json").read_text())["configurations"][0]
    assert same["rotation_deg"] < 3 * same["rotation_std_deg"]
    assert same["translation_mm"] < 3 * same["translation_std_mm"]
    assert same["moment_nmm"] < 3 * same["moment_std_nmm"]
    assert not (tmp_path / "out" / "report.html").exists()


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        (["--loads", "600", "700"], "1 loaded scans need as many loads, got 2"),
        (["--loads", "-600"], "loads must be above 0 N, got -600"),
        (["--loads", "nan"], "loads must be above 0 N, got nan"),
        (["--at", "0", "0", "inf"], "three finite coordinates"),
        (["--material", "cheese"], "cheese"),
        (["--views", "all"], "hours"),
    ],
)
def test_inputs_that_contradict_each_other_are_refused_before_anything_is_written(
    small_case, scans, tmp_path, capsys, more, problem
):
    assert main([*command(small_case, scans, tmp_path / "out", "stand"), *more]) == 2
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_two_scans_of_one_name_are_refused(small_case, scans, tmp_path, capsys):
    assert main(command(small_case, scans, tmp_path / "out", "rest")) == 2
    assert "rest is there 2 times" in capsys.readouterr().err


def test_screws_that_may_all_be_in_one_fragment_are_doubted(small_case):
    screws = read_components(small_case / "screws.json")
    nodes = ImplantPointCloud.from_mesh(read_mesh(small_case / "implant.stl"), 2.0, dtype=torch.float64).points
    assert beyond_the_screws(nodes, screws) is None
    lower = [screw for screw in screws if screw.start[2] < 0]
    assert 2 <= len(lower) < len(screws)
    assert re.search(r"reaches \d\d+ mm beyond its last screw", beyond_the_screws(nodes, lower))
    assert beyond_the_screws(nodes, lower[:1]) is None  # that is said otherwise


def test_a_rival_is_the_same_plate_turned_around_or_another_place():
    nodes = ImplantPointCloud.from_mesh(trimesh.creation.box((12.0, 4.0, 120.0)), 1.0, dtype=torch.float64).points
    here, half_turn = torch.eye(4).double(), torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).double()
    elsewhere = here.clone()
    elsewhere[2, 3] = 18.0

    def result(pose):
        rival = None if pose is None else {"pose": pose.tolist()}
        return SimpleNamespace(diagnostics={"rival": rival}, implants=[SimpleNamespace(implant_to_world=here)])

    assert turned_around(result(half_turn), nodes)
    assert not turned_around(result(elsewhere), nodes)
    assert not turned_around(result(None), nodes)


def test_a_mirrored_scan_is_no_answer(small_case, scans, visit, tmp_path):
    with np.load(scans / "stand.npz") as file:
        parts = {name: file[name] for name in file.files}
    np.savez(tmp_path / "mirrored.npz", **{**parts, "intensity": parts["intensity"][:, :, ::-1]})
    given = command(small_case, scans, visit, "stand")
    given[-1] = str(tmp_path / "mirrored.npz")
    assert main([*given, "--resume", "--no-figures"]) == 3
    mirrored = json.loads((visit / "assess.json").read_text())["configurations"][0]
    assert mirrored["status"] == "failed" and "rotation_deg" not in mirrored
