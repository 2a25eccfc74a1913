"""Case folders out of recipe files."""

import json

import numpy as np
import pytest
import torch
import trimesh
import yaml

from torchkcreg.cli import main
from torchkcreg.commands import RegistrationFiles, register_files, simulate_files
from torchkcreg.io import read_components, read_geometry, read_projections, read_spectrum

RECIPE = {
    "implant": {"plate": {"length": "110 mm", "holes": 6}, "material": "steel"},
    "screws": {"holes": [0, 1, 4, 5], "length": "30 mm"},
    "limb": {"bone": {}, "tissue": {"radius": "45 mm"}, "beads": ["[11, 3, 40] mm"]},
    "configurations": {"still": {}, "bent": {"bend": "2 deg", "zone": "20 mm", "translation": "[0.5, 0, 0] mm"}},
    "scanner": {"views": [10, 49, 92, 135], "binning": 4},
    "panel": {"supersample": 1},
}


def written(folder, name="case.yaml", **changes):
    path = folder / name
    path.write_text(yaml.safe_dump(RECIPE | changes, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated")
    simulate_files(written(folder), folder / "case", progress=False)
    return folder / "case"


def test_a_case_is_what_a_registration_reads(case):
    geometry = read_geometry(case / "geometry.json")
    projections = read_projections(case / "bent.npz")
    projections.check_against(geometry)
    assert geometry.num_views == 4
    assert len(read_components(case / "screws.json")) == 4
    assert 50 < read_spectrum(case / "spectrum.csv").mean_energy < 65
    assert trimesh.load_mesh(case / "implant.stl").is_watertight
    assert json.loads((case / "implant.json").read_text())["material"] == "steel"
    assert json.loads((case / "background.json").read_text())["cylinders"][0]["material"] == "soft_tissue"
    assert (case / "bent.png").stat().st_size > 10_000


def test_the_truth_says_where_nodes_beads_and_fragments_are(case):
    truth = json.loads((case / "truth.json").read_text())
    still, bent = truth["cfg"]
    assert [still["name"], bent["name"]] == ["still", "bent"]
    before, after = (np.array(still[key]) for key in ("nodes_undeformed_mm", "nodes_deformed_mm"))
    np.testing.assert_allclose(before, after, atol=1e-5)
    after = np.array(bent["nodes_deformed_mm"])
    assert after.mean(0) - before.mean(0) == pytest.approx([0.5, 0, 0], abs=0.15)
    motion = np.array(bent["fragments"]["proximal"])
    bead = motion[:3, :3] @ truth["bb_reference_mm"][0] + motion[:3, 3]
    np.testing.assert_allclose(bent["bb_mm"][0], bead, atol=1e-5)


def test_a_registration_finds_what_was_simulated(case, tmp_path):
    files = RegistrationFiles(
        case / "implant.stl", case / "geometry.json", case / "bent.npz", case / "spectrum.csv", case / "screws.json"
    )
    options = {"material": "steel", "pitch_mm": 0.5}
    result = register_files(files, tmp_path / "run", overrides=options, figures=False)
    bent = json.loads((case / "truth.json").read_text())["cfg"][1]
    before, after = (torch.tensor(bent[key]).double() for key in ("nodes_undeformed_mm", "nodes_deformed_mm"))
    assert float((result.warp(before) - after).square().sum(-1).mean().sqrt()) < 0.15
    assert float((before - after).square().sum(-1).mean().sqrt()) > 0.5


def test_what_was_made_is_kept_and_what_is_missing_is_made(case):
    (case / "still.npz").unlink()
    kept = (case / "bent.npz").stat().st_mtime_ns
    made = simulate_files(case / "recipe.yaml", case, progress=False)
    assert made.made == 1
    assert "1 kept" in str(made)
    assert (case / "bent.npz").stat().st_mtime_ns == kept
    assert (case / "still.npz").exists()


def test_a_configuration_that_is_made_later_is_the_same(case):
    before = (case / "bent.npz").read_bytes(), (case / "bent_implant.stl").read_bytes()
    (case / "bent.npz").unlink()
    simulate_files(case / "recipe.yaml", case, progress=False)
    assert ((case / "bent.npz").read_bytes(), (case / "bent_implant.stl").read_bytes()) == before


def test_a_folder_with_something_else_is_left_alone(case, tmp_path):
    other = written(tmp_path, screws={"holes": [0, 5]})
    with pytest.raises(FileExistsError, match="another recipe"):
        simulate_files(other, case)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.doc").write_text("")
    with pytest.raises(FileExistsError, match=r"thesis\.doc"):
        simulate_files(other, tmp_path / "mine")
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError):
        simulate_files(other, tmp_path / "file")


def test_another_recipe_replaces_a_case_if_asked(tmp_path):
    one = {"configurations": {"a": {}}, "scanner": {"views": [0], "binning": 8}}
    simulate_files(written(tmp_path, **one), tmp_path / "case", progress=False, figures=False)
    two = one | {"configurations": {"b": {}}}
    simulate_files(written(tmp_path, **two), tmp_path / "case", overwrite=True, progress=False, figures=False)
    assert {path.name for path in (tmp_path / "case").glob("*.npz")} == {"b.npz"}


def test_files_of_a_recipe_are_relative_to_it(tmp_path, capsys):
    (tmp_path / "parts").mkdir()
    trimesh.creation.box((12.0, 4.0, 60.0)).export(tmp_path / "parts" / "box.stl")
    own = {"implant": {"mesh": "parts/box.stl", "material": "titanium"}, "screws": {}, "limb": {}}
    path = written(tmp_path, **own, configurations={"a": {}}, scanner={"views": [0], "binning": 8})
    assert main(["simulate", str(path), "--out", str(tmp_path / "case"), "--no-figures"]) == 0
    assert "1 configurations made" in capsys.readouterr().out
    path = written(tmp_path, "gone.yaml", implant={"mesh": "gone.stl"})
    assert main(["simulate", str(path), "--out", str(tmp_path / "other")]) == 2
    assert "gone.stl" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("material", ["steal", "ca"])
def test_a_material_that_is_not_known_is_told_before_anything_is_written(tmp_path, material):
    path = written(tmp_path, implant={"plate": {}, "material": material})
    with pytest.raises(ValueError, match="material must be one of"):
        simulate_files(path, tmp_path / "case")
    assert not (tmp_path / "case").exists()
