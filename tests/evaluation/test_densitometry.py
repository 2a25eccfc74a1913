"""Bone mineral in regions of a reconstruction."""

from __future__ import annotations

import json

import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.commands import densitometry_files
from torchkcreg.evaluation import mineral_content
from torchkcreg.geometry import VolumeGrid
from torchkcreg.io import read_volume, write_json, write_volume
from torchkcreg.physics import calcium_in_water, calcium_of

GRID = VolumeGrid.centered((10, 20, 20), 1.0)
KEV = 54.0


def attenuation(calcium: float) -> float:
    return float(calcium_in_water(calcium).attenuation((KEV,))[0])


@pytest.fixture
def folder(tmp_path):
    """A reconstruction of water, a half with 120 mg/mL of calcium, and a metal rod on its border."""
    volume = torch.full(GRID.shape, attenuation(0.0))
    volume[:, :, 10:] = attenuation(120.0)
    metal = torch.zeros(GRID.shape)
    metal[:, 8:12, 9:11] = 0.4
    write_volume(tmp_path / "volume.mha", volume, GRID)
    write_volume(tmp_path / "with_implant.mha", volume + metal, GRID)
    write_volume(tmp_path / "measured.mha", torch.ones(GRID.shape, dtype=torch.uint8), GRID)
    write_json(tmp_path / "metrics.json", {"reference_kev": KEV, "water": attenuation(0.0)})
    return tmp_path


def test_calcium_is_linear_in_attenuation():
    values = calcium_of(torch.tensor([attenuation(c) for c in (0.0, 50.0, 300.0)]), KEV)
    torch.testing.assert_close(values, torch.tensor([0.0, 50.0, 300.0]), atol=0.05, rtol=0)


def test_regions_are_measured_away_from_metal(folder, capsys):
    cylinders = ["--cylinder", "5", "0", "-4", "5", "0", "4", "4", "--cylinder", "-6", "0", "-4", "-6", "0", "4", "3"]
    assert main(["densitometry", str(folder), *cylinders, "--from-metal", "2"]) == 0
    record = json.loads((folder / "densitometry" / "densitometry.json").read_text())
    bone, water = record["regions"]
    assert bone["calcium_mg_ml"] == pytest.approx(120, abs=0.1) and water["calcium_mg_ml"] == pytest.approx(0, abs=0.1)
    assert bone["hydroxyapatite_mg_ml"] == pytest.approx(120 / 0.3989, rel=1e-3)
    assert bone["content_mg"] == pytest.approx(bone["hydroxyapatite_mg_ml"] * bone["volume_ml"])
    assert 0 < bone["left_out"] < 0.3 and water["left_out"] == 0
    assert (folder / "densitometry" / "densitometry.png").stat().st_size > 1000
    printed = capsys.readouterr().out
    assert "cylinder 1" in printed and "left out" in printed


def test_a_label_map_names_regions(folder):
    labels = torch.zeros(GRID.shape, dtype=torch.int32)
    labels[2:8, 2:6, 13:18] = 3
    labels[2:8, 2:6, 2:6] = 1
    write_volume(folder / "labels.nii.gz", labels, GRID)
    flags = ["--labels", str(folder / "labels.nii.gz"), "--out", str(folder / "other"), "--no-figures"]
    assert main(["densitometry", str(folder), *flags]) == 0
    first, third = json.loads((folder / "other" / "densitometry.json").read_text())["regions"]
    assert (first["name"], third["name"]) == ("label 1", "label 3")
    assert third["calcium_mg_ml"] == pytest.approx(120, abs=0.1) and third["volume_ml"] == pytest.approx(0.12)


def test_what_cannot_be_measured_is_refused(folder, capsys):
    assert main(["densitometry", str(folder)]) == 2
    assert "needs regions" in capsys.readouterr().err
    assert (
        main(["densitometry", str(folder), "--cylinder", *["0", "0", "-4", "0", "0", "4", "1"], "--from-metal", "5"])
        == 2
    )
    assert "too few to measure" in capsys.readouterr().err
    other = VolumeGrid.centered(GRID.shape, 1.0, center=(5.3, 0.0, 0.0))
    write_volume(folder / "labels.mha", torch.ones(GRID.shape, dtype=torch.int32), other)
    assert main(["densitometry", str(folder), "--labels", str(folder / "labels.mha")]) == 2
    assert "must lie on the reconstruction's voxels" in capsys.readouterr().err
    write_volume(folder / "labels.mha", torch.full(GRID.shape, 0.5), GRID)
    assert main(["densitometry", str(folder), "--labels", str(folder / "labels.mha")]) == 2
    assert "must hold whole numbers" in capsys.readouterr().err
    write_json(folder / "metrics.json", {"reference_kev": None})
    assert main(["densitometry", str(folder), "--cylinder", *["5", "0", "-4", "5", "0", "4", "2"]]) == 2
    assert "has no reference energy" in capsys.readouterr().err
    with pytest.raises(ValueError, match="must have the volume's shape"):
        mineral_content(torch.zeros(GRID.shape), {"a": torch.ones(2, 2, 2)}, GRID)
    holes = torch.full(GRID.shape, float("nan"))
    with pytest.raises(ValueError, match="not finite"):
        mineral_content(holes, {"a": torch.ones(GRID.shape)}, GRID)


def test_what_lies_beyond_the_volume_is_left_out_and_said(folder):
    with pytest.warns(UserWarning, match=r"cylinder 1: 7\d % lies beyond the volume, .* left out"):
        (content,) = densitometry_files(folder, folder / "d", cylinders=[(5, 0, 1, 5, 0, 17, 4)], figures=False)
    assert content.left_out == pytest.approx(0.75, abs=0.03)
    assert content.calcium_mg_ml == pytest.approx(120, abs=0.1)


def test_what_is_not_seen_from_all_sides_is_left_out_and_said(folder):
    seen = torch.ones(GRID.shape, dtype=torch.uint8)
    seen[:, :, 14:] = 0
    volume, _ = read_volume(folder / "volume.mha")
    volume[:, :, 14:] = 0.0
    write_volume(folder / "measured.mha", seen, GRID)
    write_volume(folder / "volume.mha", volume, GRID)
    with pytest.warns(UserWarning, match="% is not seen from all sides"):
        (content,) = densitometry_files(folder, folder / "d", cylinders=[(5, 0, -4, 5, 0, 4, 3)], figures=False)
    assert content.calcium_mg_ml == pytest.approx(120, abs=0.1) and 0.3 < content.left_out < 0.9


def test_metal_that_the_reconstruction_does_not_know_is_no_bone(folder):
    volume, _ = read_volume(folder / "with_implant.mha")
    write_volume(folder / "volume.mha", volume, GRID)
    (folder / "with_implant.mha").unlink()
    cylinder = (5, 0, -4, 5, 0, 4, 8)
    with pytest.warns(UserWarning, match="knows of no metal"):
        (content,) = densitometry_files(folder, folder / "d", cylinders=[cylinder], figures=False)
    assert content.calcium_mg_ml < 121 and content.left_out > 0.02


def test_a_folder_that_does_not_say_what_was_measured_is_doubted(folder):
    (folder / "measured.mha").unlink()
    with pytest.warns(UserWarning, match="does not tell which voxels were measured"):
        densitometry_files(folder, folder / "d", cylinders=[(5, 0, -4, 5, 0, 4, 3)], figures=False)


def test_labels_may_lie_on_a_cropped_or_turned_lattice_of_the_same_voxels(folder, recwarn):
    whole = torch.zeros(GRID.shape, dtype=torch.int32)
    whole[2:8, 2:6, 13:18] = 3
    write_volume(folder / "whole.nii.gz", whole, GRID)
    (expected,) = densitometry_files(folder, folder / "d", labels=folder / "whole.nii.gz", figures=False)
    x, y, z = GRID.origin
    cropped = VolumeGrid((8, 6, 10), GRID.spacing, (x + 10, y, z + 1))
    write_volume(folder / "cropped.nrrd", whole[1:9, :6, 10:], cropped)
    turned = VolumeGrid(GRID.shape, GRID.spacing, (-x, -y, z), ((-1, 0, 0), (0, -1, 0), (0, 0, 1)))
    write_volume(folder / "turned.nrrd", whole.flip(1, 2), turned)
    for name in ("cropped.nrrd", "turned.nrrd"):
        (content,) = densitometry_files(folder, folder / "d", labels=folder / name, figures=False)
        assert content == expected
    shifted = VolumeGrid(GRID.shape, GRID.spacing, (x + 0.3, y, z))
    write_volume(folder / "shifted.nrrd", whole, shifted)
    with pytest.raises(ValueError, match="must lie on the reconstruction's voxels"):
        densitometry_files(folder, folder / "d", labels=folder / "shifted.nrrd", figures=False)
