"""A series of frames of two implants, through files and the command line."""

import json

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.cli import main
from torchkcreg.geometry import circular_geometry, rigid_matrix
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_init, read_run, read_tra, write_geometry, write_init, write_json, write_mesh
from torchkcreg.registration import Implant, RegistrationConfig, build_scene

STAGES = [{"bin": 2, "oversampling": 1}, {"oversampling": 1}]
TURN, SHIFT = 2.5, (0.6, -0.4, 1.0)  # of the shorter bar in the second frame, degrees about z and mm, in the world


def bar(length: float) -> trimesh.Trimesh:
    """A bar of 9 x 3 mm with a shoulder, so that it has no symmetry."""
    parts = [trimesh.creation.box((9.0, 3.0, length)), trimesh.creation.box((4.0, 3.0, 10.0))]
    parts[1].apply_translation((6.4, 0.0, length / 4))
    return trimesh.boolean.union(parts)


def place(x: float, degrees: float, shift=(0.0, 0.0, 0.0)) -> torch.Tensor:
    turn = torch.tensor([0.0, 0.0, np.radians(degrees)], dtype=torch.float64)
    return rigid_matrix(turn, torch.tensor([x, 0.5 * x, 0.0], dtype=torch.float64) + torch.tensor(shift))


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    """Run folder of three frames, the middle one of another size, and the command that made it."""
    folder = tmp_path_factory.mktemp("frames")
    meshes = {"upper": bar(34.0), "lower": bar(40.0)}
    poses = {
        "frame0": {"upper": place(15.0, -3.0), "lower": place(-14.0, 4.0)},
        "frame2": {"upper": place(15.0, -3.0 + TURN, SHIFT), "lower": place(-14.0, 4.0)},
    }
    views = circular_geometry([20.0, 65.0, 110.0], sad=404, sdd=538, det_shape=(120, 120), pixel_spacing=(0.8, 0.8))
    for name, mesh in meshes.items():
        write_mesh(folder / f"{name}.stl", mesh)
        write_init(folder / f"{name}.json", poses["frame0"][name])
    for frame, there in poses.items():
        implants = [
            Implant(ImplantPointCloud.from_mesh(mesh, 0.5), implant_to_world=there[name], name=name)
            for name, mesh in meshes.items()
        ]
        with torch.no_grad():
            lines = build_scene(implants, RegistrationConfig())(views)
        np.savez(folder / f"{frame}.npz", line_integrals=lines.numpy())
    np.savez(folder / "frame1.npz", line_integrals=np.zeros((3, 40, 40), np.float32))
    write_geometry(folder / "geometry.json", views)
    write_json(folder / "options.json", {"stages": STAGES, "pitch_mm": 0.5, "deformation": "rigid"})
    frames = [str(folder / f"frame{number}.npz") for number in range(3)]
    each = [flag for name in meshes for flag in (f"--implant={folder / name}.stl", f"--init={folder / name}.json")]
    command = ["register", *each, f"--geometry={folder / 'geometry.json'}", f"--config={folder / 'options.json'}"]
    command += ["--out", str(folder / "out"), "--no-figures", "--frames", *frames]
    assert main(command) == 0
    return folder, command


def test_each_frame_starts_from_the_one_before_and_the_motion_is_right(series) -> None:
    folder, _ = series
    content = json.loads((folder / "out" / "frames.json").read_text())
    assert content["reference"] == "lower"
    assert [frame["status"] == "failed" for frame in content["frames"]] == [False, True, False]
    last = content["implants"]["upper"][2]
    # the reference is turned by 4 degrees about z
    turn = rigid_matrix(torch.tensor([0.0, 0.0, -np.radians(4.0)]).double(), torch.zeros(3).double())[:3, :3]
    assert last["rotation_z_deg"] == pytest.approx(TURN, abs=0.05)
    shift = [last[f"translation_{axis}_mm"] for axis in "xyz"]
    # the middle of its nodes is off the axis of the turn
    middle = torch.from_numpy(bar(34.0).center_mass)
    before, after = (place(15.0, -3.0), place(15.0, -3.0 + TURN, SHIFT))
    moved = (after[:3, :3] - before[:3, :3]) @ middle + torch.tensor(SHIFT).double()
    assert shift == pytest.approx((turn @ moved).tolist(), abs=0.05)
    assert 0 < last["translation_z_std_mm"] < 0.2
    init = (folder / "out" / "frame2" / "config.yaml").read_text()
    assert str(folder / "out" / "frame0") in init


def test_a_frame_that_cannot_be_registered_is_listed_and_the_table_has_a_gap(series) -> None:
    folder, _ = series
    content = json.loads((folder / "out" / "frames.json").read_text())
    assert "(3, 40, 40)" in content["frames"][1]["reasons"][0]
    assert content["implants"]["upper"][1]["rotation_z_deg"] is None
    rows = (folder / "out" / "frames.csv").read_text().splitlines()
    assert rows[0].startswith("frame,status,implant,rotation_x_deg,rotation_x_std_deg")
    assert rows[2].startswith("frame1,failed,upper,,,")


def test_poses_over_frames_are_written_for_other_programs_and_start_a_registration(series) -> None:
    folder, _ = series
    poses = read_tra(folder / "out" / "upper.tra")
    there = read_run(folder / "out" / "frame2").implant("upper").implant_to_world
    torch.testing.assert_close(poses[2], there, atol=1e-6, rtol=0)
    assert bool(poses[1].isnan().all())
    torch.testing.assert_close(read_init(folder / "out" / "upper.tra"), poses[0])


def test_existing_runs_are_refused_or_continued_with_the_same_result(series, capsys) -> None:
    folder, command = series
    before = (folder / "out" / "frames.csv").read_text()
    assert main(command) == 2
    assert "holds a run already" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    assert (folder / "out" / "frames.csv").read_text() == before


def test_frames_of_one_name_and_other_flags_are_refused(series, capsys) -> None:
    folder, command = series
    frame = str(folder / "frame0.npz")
    assert main([*command[: command.index("--frames")], "--frames", frame, frame]) == 2
    assert "frame0 is there 2 times" in capsys.readouterr().err
    assert main([*command, "--seeds", "2"]) == 2
    assert "--frames and --seeds exclude each other" in capsys.readouterr().err


def test_no_registered_frame_is_an_error(series, capsys, tmp_path) -> None:
    folder, command = series
    alone = [*command[: command.index("--out")], "--out", str(tmp_path), "--frames", str(folder / "frame1.npz")]
    assert main(alone) == 2
    assert "none of 1 frames was registered" in capsys.readouterr().err
