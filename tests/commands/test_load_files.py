"""What an implant carries, out of run folders: files, differences, warnings, and runs that know no loads."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh
from small_scene import plate

from torchkcreg.cli import main
from torchkcreg.commands import load_files
from torchkcreg.deformation import FiniteElementDeformation, RigidDeformation
from torchkcreg.io import RunFolder, read_run, write_surface_vtu
from torchkcreg.mechanics import CarriedLoad, Hold
from torchkcreg.registration import Implant, RegisteredImplant, RegistrationConfig, RegistrationResult, build_scene

HOLDS = [Hold(f"at {z:.0f}", (0.0, 0.0, z), 4.0) for z in (-22.0, -7.0, 7.0, 22.0)]
CONFIG = RegistrationConfig(deformation="fe")


@pytest.fixture(scope="module")
def body():
    """The plate as an elastic body."""
    implant = Implant(plate(), material="titanium", holds=HOLDS)
    return build_scene(implant, CONFIG).assemblies[0].deformation.superelement


@pytest.fixture(scope="module")
def mesh(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "plate.stl"
    trimesh.creation.box((10.0, 3.0, 50.0)).export(path)
    return path


def run_of(folder: Path, deformation, *, status="ok", warnings=()) -> Path:
    """A run folder of a plate that is bent so."""
    registered = RegisteredImplant("implant", torch.eye(4).double(), deformation)
    found = RegistrationResult([registered], torch.tensor([0.9]), [], CONFIG, status=status, warnings=list(warnings))
    RunFolder.create(folder).write_result(found, [plate().points])
    return folder


def bent(body, first: float, deviation: float = 0.01) -> FiniteElementDeformation:
    amounts = torch.zeros_like(body.expected)
    amounts[0] = first
    covariance = torch.diag((deviation * body.expected).square())
    return FiniteElementDeformation(body, amounts, covariance=covariance)


def test_files_hold_what_the_implant_carries(body, mesh, tmp_path) -> None:
    run = run_of(tmp_path / "run", bent(body, 0.02))
    found = load_files(run, tmp_path / "out", implant=mesh)
    assert {path.name for path in found.folder.iterdir()} == {"load.json", "load.vtu", "load.png"}
    content = json.loads((tmp_path / "out" / "load.json").read_text())
    torch.testing.assert_close(
        torch.tensor([hold["moment_nmm"] for hold in content["holds"]], dtype=torch.float64),
        found.carried.hold_loads[:, 3:],
        rtol=1e-9,
        atol=1e-9,
    )
    assert content["largest_stress_mpa"] == pytest.approx(found.stress) and found.stress_std > 0
    grid = ElementTree.parse(tmp_path / "out" / "load.vtu").getroot()
    arrays = {array.get("Name"): np.array(array.text.split(), dtype=float) for array in grid.iter("DataArray")}
    piece = next(grid.iter("Piece"))
    vertices, faces = int(piece.get("NumberOfPoints")), int(piece.get("NumberOfCells"))
    assert arrays["von_mises_mpa"].size == vertices and arrays["von_mises_mpa"].max() == pytest.approx(found.stress)
    assert arrays["displacement_mm"].size == 3 * vertices and set(arrays["types"]) == {5}
    assert arrays["offsets"].tolist() == list(range(3, 3 * faces + 1, 3)) and arrays["connectivity"].max() < vertices
    assert "+-" in str(found) and "warning" not in str(found)


def test_what_both_runs_have_in_common_is_no_load(body, mesh, tmp_path) -> None:
    loaded, unloaded = run_of(tmp_path / "a", bent(body, 0.03)), run_of(tmp_path / "b", bent(body, 0.01))
    alone = load_files(loaded, tmp_path / "1", implant=mesh, figures=False)
    difference = load_files(loaded, tmp_path / "2", against=unloaded, implant=mesh, figures=False)
    torch.testing.assert_close(difference.carried.section_loads, alone.carried.section_loads * 2 / 3)
    # Loads that bend nothing are unknown however many runs there are; the rest of the variance is that of two runs.
    bending = bent(body, 0.03)
    nothing = torch.zeros_like(bending.covariance)
    unseen = CarriedLoad.of(body, bending.amounts, nothing, bending.expected).section_std ** 2
    of_two, of_one = (found.carried.section_std**2 - unseen for found in (difference, alone))
    assert of_one[:-1, 3:].amax() > 100
    torch.testing.assert_close(of_two, 2 * of_one, rtol=1e-6, atol=1e-6 * float(unseen.max()))
    assert not (tmp_path / "2" / "load.png").exists()


def test_doubts_and_yielding_are_told(body, mesh, tmp_path) -> None:
    run = run_of(tmp_path / "run", bent(body, 2.0), status="doubtful", warnings=["few views"])
    found = load_files(run, tmp_path / "out", implant=mesh, figures=False)
    assert "the registration is doubtful: few views" in found.warnings
    assert any("the alloy's yield stress" in text for text in found.warnings) and found.stress > found.yield_stress
    assert "warning: stress reaches" in str(found)


def test_runs_that_know_no_load_or_are_of_another_implant_are_refused(body, mesh, tmp_path, capsys) -> None:
    rigid = run_of(tmp_path / "rigid", RigidDeformation())
    assert main(["load", str(rigid), "--implant", str(mesh)]) == 2
    assert (
        "has no loads: its implant was not registered as finite elements; register with --deformation fe"
        in capsys.readouterr().err
    )
    assert not (rigid / "load").exists()
    run = run_of(tmp_path / "run", bent(body, 0.02))
    other = run_of(tmp_path / "other", bent(replace(body, holds=body.holds[::-1]), 0.02))
    with pytest.raises(ValueError, match="different implants, materials or holds"):
        load_files(run, tmp_path / "out", against=other, implant=mesh)
    with pytest.raises(ValueError, match="implant"):
        load_files(run, tmp_path / "out", implant=mesh, name="nail")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        load_files(run, tmp_path / "out")
    assert main(["load", str(run), "--implant", str(mesh), "--no-figures"]) == 0
    assert "von Mises stress" in capsys.readouterr().out and (run / "load" / "load.json").exists()


def test_a_run_folder_keeps_how_sure_the_loads_are(body, tmp_path) -> None:
    deformation = bent(body, 0.02)
    again = read_run(run_of(tmp_path / "run", deformation)).deformation
    torch.testing.assert_close(again.covariance, deformation.covariance)


def test_values_that_do_not_belong_to_the_vertices_are_refused(tmp_path) -> None:
    with pytest.raises(ValueError, match="a value for each of 8 vertices, got 3"):
        write_surface_vtu(tmp_path / "x.vtu", trimesh.creation.box(), {"stress": torch.zeros(3)})
    assert not (tmp_path / "x.vtu").exists()
