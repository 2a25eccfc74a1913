"""Two plates on one bone, through files and the command line."""

import json

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.cli import main
from torchkcreg.geometry import circular_geometry, rigid_matrix
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_run, write_geometry, write_init, write_json, write_mesh, write_points
from torchkcreg.registration import Implant, RegistrationConfig, build_scene

STAGES = [{"bin": 2, "oversampling": 1}, {"oversampling": 1}]


def bar(length: float) -> trimesh.Trimesh:
    """A bar of 9 x 3 mm with a shoulder, so that it has no symmetry."""
    parts = [trimesh.creation.box((9.0, 3.0, length)), trimesh.creation.box((4.0, 3.0, 10.0))]
    parts[1].apply_translation((6.4, 0.0, length / 4))
    return trimesh.boolean.union(parts) if trimesh.boolean.engines_available else parts[0]


def beside(x: float, degrees: float) -> torch.Tensor:
    turn = torch.tensor([0.0, 0.0, np.radians(degrees)], dtype=torch.float64)
    return rigid_matrix(turn, torch.tensor([x, 0.5 * x, 0.0], dtype=torch.float64))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    meshes = {"medial": bar(40.0), "lateral": bar(34.0)}
    truth = {"medial": beside(-14.0, 4.0), "lateral": beside(15.0, -3.0)}
    views = circular_geometry([20.0, 65.0, 110.0], sad=404, sdd=538, det_shape=(120, 120), pixel_spacing=(0.8, 0.8))
    implants = [
        Implant(ImplantPointCloud.from_mesh(mesh, 0.5), implant_to_world=truth[name], name=name)
        for name, mesh in meshes.items()
    ]
    with torch.no_grad():
        lines = build_scene(implants, RegistrationConfig())(views)
    for name, mesh in meshes.items():
        write_mesh(folder / f"{name}.stl", mesh)
    write_init(folder / "lateral.json", beside(14.0, -1.0))
    write_init(folder / "medial.json", beside(-13.0, 2.0))
    write_geometry(folder / "geometry.json", views)
    np.savez(folder / "projections.npz", line_integrals=lines.numpy())
    write_json(folder / "options.json", {"stages": STAGES, "pitch_mm": 0.5})
    write_points(folder / "points.csv", torch.tensor([[0.0, 0.0, 15.0], [2.0, 1.0, -10.0]]))
    return folder, truth


def command(folder, *more: str) -> list[str]:
    given = [f"--{name}={folder / f'{name}.json'}" for name in ("geometry",)]
    return ["register", *given, f"--projections={folder / 'projections.npz'}", *more]


def test_two_implants_are_registered_by_repeating_the_flag(files, tmp_path) -> None:
    folder, truth = files
    flags = [f"--implant={folder / f'{name}.stl'}" for name in truth]
    flags += [f"--init={folder / f'{name}.json'}" for name in truth]
    run = tmp_path / "run"
    assert main(command(folder, *flags, f"--config={folder / 'options.json'}", f"--out={run}")) in (0, 3)
    result = read_run(run)
    points = torch.tensor([[0.0, 0.0, 15.0], [2.0, 1.0, -10.0]], dtype=torch.float64)
    for name, pose in truth.items():
        expected = points @ pose[:3, :3].T + pose[:3, 3]
        torch.testing.assert_close(result.warp(points, implant=name), expected, atol=0.1, rtol=0)
        out = tmp_path / f"{name}.csv"
        warp = [f"--run={run}", f"--points={folder / 'points.csv'}", f"--out={out}", f"--implant-name={name}"]
        assert main(["warp", *warp]) == 0
        warped = np.loadtxt(out, delimiter=",", skiprows=1)[:, :3]
        np.testing.assert_allclose(warped, expected.numpy(), atol=0.1)
    written = {path.name for path in run.iterdir()}
    assert {"dvf.mha", "lateral_dvf.mha", "lateral_bspline.tfm", "lateral_displacement.png", "overlay.png"} <= written
    assert json.loads((run / "metrics.json").read_text())["largest_motion_mm"] > 0.5
    assert main(["info", str(run)]) == 0


def test_what_does_not_pair_with_the_implants_is_refused(files, tmp_path, capsys) -> None:
    folder, _ = files
    implants = [f"--implant={folder / f'{name}.stl'}" for name in ("medial", "lateral")]
    out = f"--out={tmp_path / 'run'}"
    assert main(command(folder, *implants, f"--init={folder / 'medial.json'}", out)) == 2
    assert "2 implants need as many init, got 1; use - for none" in capsys.readouterr().err
    assert main(command(folder, implants[0], implants[0], out)) == 2
    assert "medial is there 2 times" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_name_that_no_implant_has_is_told(files, tmp_path, capsys) -> None:
    folder, _ = files
    run = tmp_path / "run"
    options = [f"--config={folder / 'options.json'}", f"--init={folder / 'medial.json'}", "--no-figures"]
    main(command(folder, f"--implant={folder / 'medial.stl'}", *options, f"--out={run}"))
    warp = [f"--run={run}", f"--points={folder / 'points.csv'}", f"--out={tmp_path / 'w.csv'}"]
    assert main(["warp", *warp, "--implant-name=lateral"]) == 2
    assert "no implant 'lateral': there are implant" in capsys.readouterr().err
