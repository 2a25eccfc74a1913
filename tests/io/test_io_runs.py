import json

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh
from matplotlib.figure import Figure

from torchkcreg.deformation import FreeFormDeformation
from torchkcreg.geometry import rigid_matrix, transform_points
from torchkcreg.io import RunFolder, read_config, read_run
from torchkcreg.plain import plain
from torchkcreg.registration import RegisteredImplant, RegistrationConfig, RegistrationResult
from torchkcreg.splines import ControlPointGrid

RESULT_FILES = {
    "deformation.json",
    "dvf.mha",
    "bspline.tfm",
    "implant_deformed.ply",
    "implant_deformed.vtp",
    "history.json",
}


@pytest.fixture
def result():
    generator = torch.Generator().manual_seed(4)
    frame = rigid_matrix(torch.tensor([0.2, 0.1, -0.4]).double(), torch.tensor([-20.0, -20.0, -90.0]).double())
    shape = (5, 5, 7)
    deformation = FreeFormDeformation(
        ControlPointGrid(shape, (10.0, 10.0, 30.0), frame),
        torch.randn(*shape, 3, dtype=torch.float64, generator=generator),
        (torch.arange(7) // 3).expand(shape),
    )
    pose = rigid_matrix(torch.tensor([0.1, -0.2, 0.3]).double(), torch.tensor([1.0, 2.0, 3.0]).double())
    implant = RegisteredImplant("plate", pose, deformation, components={"screw0": pose.inverse()})
    return RegistrationResult(
        implants=[implant],
        gc=torch.tensor([0.75, 0.5]),
        history=[{"stage": 0, "iteration": 1, "loss": 0.25}],
        config=RegistrationConfig(beta=0.5, seed=7),
        seed=7,
        warnings=["few views"],
        intensity={"scatter": 0.0625},
    )


@pytest.fixture
def points():
    return 40 * torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(9))


def names(path):
    return {entry.name for entry in path.iterdir()}


def test_a_result_comes_back_and_warps_every_point_as_before(tmp_path, result, points):
    run = RunFolder.create(tmp_path / "run")
    run.write_result(result, [points])
    again = read_run(tmp_path / "run")
    assert not result.outside(points).all()
    assert result.outside(points).any()
    assert torch.equal(again.outside(points), result.outside(points))
    torch.testing.assert_close(again.warp(points), result.warp(points), rtol=0, atol=1e-12)
    assert torch.equal(again.implant_to_world, result.implant_to_world)
    assert torch.equal(again.gc, result.gc)
    assert torch.equal(again.implants[0].components["screw0"], result.implants[0].components["screw0"])
    assert again.history == result.history
    assert again.config == result.config
    assert (again.seed, again.warnings, again.intensity) == (7, ["few views"], {"scatter": 0.0625})


def test_the_files_of_a_result_agree_with_each_other(tmp_path, result, points):
    run = RunFolder.create(tmp_path)
    run.write_result(result, [points])
    assert names(tmp_path) == RESULT_FILES
    cloud = np.asarray(trimesh.load(tmp_path / "implant_deformed.ply").vertices)
    assert cloud == pytest.approx(result.warp(points).numpy(), abs=1e-4)
    transform = sitk.ReadTransform(str(tmp_path / "bspline.tfm"))
    near = points[~result.outside(points)]
    moved = torch.tensor([transform.TransformPoint(p) for p in near.tolist()], dtype=torch.float64)
    torch.testing.assert_close(moved, result.warp(near), rtol=0, atol=1e-4)
    assert sitk.ReadImage(str(tmp_path / "dvf.mha")).GetNumberOfComponentsPerPixel() == 3


def test_displacements_of_the_cloud_count_from_the_initial_pose(tmp_path, result, points):
    run = RunFolder.create(tmp_path)
    with torch.no_grad():
        result.deformation.control_points.zero_()
    run.write_result(result, [points], initial_to_world=[result.implant_to_world])
    fields = trimesh.load(tmp_path / "implant_deformed.ply").metadata["_ply_raw"]["vertex"]["data"]
    assert np.abs(fields["displacement"]).max() < 1e-5
    run.write_result(result, [points])
    fields = trimesh.load(tmp_path / "implant_deformed.ply").metadata["_ply_raw"]["vertex"]["data"]
    expected = (transform_points(result.implant_to_world, points) - points).norm(dim=-1)
    assert fields["displacement"].ravel() == pytest.approx(expected.numpy(), rel=1e-5)


def test_a_result_that_diverged_is_refused_and_nothing_is_written(tmp_path, result, points):
    with torch.no_grad():
        result.deformation.control_points[0, 0, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="control_points must be finite"):
        RunFolder.create(tmp_path).write_result(result, [points])
    assert names(tmp_path) == set()


def test_a_write_that_fails_halfway_leaves_a_run_that_is_not_finished(tmp_path, result, points):
    run = RunFolder.create(tmp_path)
    run.start({})
    run.write_result(result, [points])
    (tmp_path / "bspline.tfm").unlink()
    (tmp_path / "bspline.tfm").mkdir()
    with pytest.raises(IsADirectoryError, match=r"bspline\.tfm is a folder"):
        run.write_result(result, [points])
    assert not any(name.startswith(".") for name in names(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"is not finished: it has no deformation\.json"):
        read_run(tmp_path)


def test_a_run_starts_with_its_configuration_and_versions(tmp_path):
    run = RunFolder.create(tmp_path / "a" / "b")
    run.start({"beta": 0.5, "implant": tmp_path / "plate.stl"})
    assert read_config(tmp_path / "a" / "b" / "config.yaml") == {"beta": 0.5, "implant": str(tmp_path / "plate.stl")}
    versions = json.loads((tmp_path / "a" / "b" / "versions.json").read_text())
    assert versions["threads"] == torch.get_num_threads()
    assert {"torchkcreg", "torch", "numpy", "python", "platform"} <= versions.keys()


def test_a_run_is_neither_overwritten_nor_resumed_unasked(tmp_path):
    RunFolder.create(tmp_path).start({"seed": 1})
    with pytest.raises(FileExistsError, match="holds a run already: overwrite or resume it"):
        RunFolder.create(tmp_path)
    assert read_config(tmp_path / "config.yaml") == {"seed": 1}


def test_a_resumed_run_keeps_its_files(tmp_path):
    RunFolder.create(tmp_path).start({"seed": 1})
    RunFolder.create(tmp_path, resume=True).write_metrics({"rmse_mm": 0.05})
    assert names(tmp_path) == {"config.yaml", "versions.json", "metrics.json"}


def test_overwriting_discards_the_run_and_nothing_else(tmp_path, result, points):
    run = RunFolder.create(tmp_path)
    run.start({})
    run.write_result(result, [points])
    run.save_checkpoint({"a": 1})
    (tmp_path / "notes.txt").write_text("mine")
    RunFolder.create(tmp_path, overwrite=True)
    assert names(tmp_path) == {"notes.txt"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_with_other_files_is_never_taken(tmp_path, overwrite):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(FileExistsError, match="is not empty and holds no run"):
        RunFolder.create(tmp_path, overwrite=overwrite)
    assert names(tmp_path) == {"thesis.tex"}


def test_there_must_be_a_run_to_resume(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no run to resume"):
        RunFolder.create(tmp_path / "new", resume=True)
    assert names(tmp_path) == set()
    with pytest.raises(ValueError, match="not both"):
        RunFolder.create(tmp_path, resume=True, overwrite=True)


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "run").write_text("")
    for path in (tmp_path / "run", tmp_path / "run" / "below"):
        with pytest.raises(NotADirectoryError, match="a file is in the way"):
            RunFolder.create(path)


def test_what_a_killed_run_was_writing_is_swept_away(tmp_path):
    RunFolder.create(tmp_path).start({})
    (tmp_path / ".writing-123-dvf.mha").write_bytes(b"half")
    with pytest.raises(FileExistsError):
        RunFolder.create(tmp_path)
    assert ".writing-123-dvf.mha" in names(tmp_path)  # it may be a living run's
    RunFolder.create(tmp_path, resume=True)
    assert names(tmp_path) == {"config.yaml", "versions.json"}


def test_a_checkpoint_comes_back_bit_by_bit(tmp_path):
    run = RunFolder.create(tmp_path)
    assert run.load_checkpoint() is None
    state = {
        "scene": {"phi": torch.randn(3, dtype=torch.float64)},
        "next_stage": 2,
        "history": [{"loss": 0.1, "t": None}],
    }
    run.save_checkpoint(state)
    again = run.load_checkpoint()
    assert torch.equal(again["scene"]["phi"], state["scene"]["phi"])
    assert {key: again[key] for key in ("next_stage", "history")} == {
        key: state[key] for key in ("next_stage", "history")
    }


def test_a_checkpoint_that_could_not_be_loaded_is_not_written(tmp_path):
    run = RunFolder.create(tmp_path)
    run.save_checkpoint({"a": 1})
    with pytest.raises(ValueError, match=r"state\['b'\]\[0\] is a Generator"):
        run.save_checkpoint({"b": [torch.Generator()]})
    assert run.load_checkpoint() == {"a": 1}


def test_a_damaged_checkpoint_is_named_and_nothing_in_it_is_executed(tmp_path):
    run = RunFolder.create(tmp_path)
    for content in (b"nothing", b"cos\nsystem\n(S'touch pwned'\ntR."):
        (tmp_path / "checkpoint.pt").write_bytes(content)
        with pytest.raises(ValueError, match=r"checkpoint .*checkpoint\.pt cannot be read") as caught:
            run.load_checkpoint()
        assert "\n" not in str(caught.value)


def test_figures_are_written_under_their_name(tmp_path):
    run = RunFolder.create(tmp_path)
    run.write_figure("history.png", Figure(figsize=(1, 1)))
    assert (tmp_path / "history.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="name must be a file name"):
        run.write_figure("../history.png", Figure())


def test_a_folder_without_a_run_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_run(tmp_path / "none")
    with pytest.raises(FileNotFoundError, match="is no run"):
        read_run(tmp_path)


def bending(content):
    return content["implants"][0]["deformation"]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c.update(format="other"), "must be a 'torchkcreg deformation', got 'other'"),
        (lambda c: c.update(format_version=99), "format_version must be at most 2, got 99"),
        (lambda c: bending(c).pop("grid"), "'grid' of a deformation is missing"),
        (lambda c: bending(c).update(model="jelly"), "model must be one of fe, ffd, rigid, got 'jelly'"),
        (lambda c: bending(c)["grid"].pop("spacing_mm"), "'spacing_mm' of the grid is missing"),
        (lambda c: bending(c)["control_points_mm"].pop(), "control_points_mm must be 5 x 5 x 7 x 3 numbers"),
        (lambda c: c["implants"][0].update(implant_to_world=[[1.0]]), "implant_to_world must be 4 x 4 numbers"),
        (lambda c: bending(c).update(labels=0), "labels must be 5 x 5 x 7 numbers"),
        (lambda c: c["config"].update(colour="green"), "colour"),
        (lambda c: c["implants"][0]["components"].update(screw0=1), "motion of component screw0 must be 4 x 4"),
    ],
)
def test_a_damaged_result_is_refused_in_one_line_that_names_the_key(tmp_path, result, points, spoil, message):
    RunFolder.create(tmp_path).write_result(result, [points])
    content = json.loads((tmp_path / "deformation.json").read_text())
    spoil(content)
    (tmp_path / "deformation.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"^deformation file .*deformation\.json: .*{message}") as caught:
        read_run(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_result_of_the_first_format_is_read_too(result, points):
    content = json.loads(json.dumps(plain(result.to_dict())))
    (implant,) = content.pop("implants")
    own = {key: value for key, value in bending({"implants": [implant]}).items() if key != "model"}
    screw = {"start": [0.0, 0.0, 0.0], "end": [0.0, 0.0, 9.0], "radius": 1.5, "material": "steel"}
    old = {"implant_to_world": implant["implant_to_world"], "components": implant["components"]}
    again = RegistrationResult.from_dict({**content, **own, **old, "screws_found": [screw], "format_version": 1})
    torch.testing.assert_close(again.warp(points), result.warp(points), rtol=0, atol=1e-12)
    assert [s.name for s in again.screws_found] == ["found0"] and again.screws_found[0].length == 9.0


def test_a_view_without_a_similarity_stays_unknown(result):
    result.gc = torch.tensor([0.5, float("nan")])
    again = RegistrationResult.from_dict(json.loads(json.dumps(plain(result.to_dict()), allow_nan=False)))
    assert again.gc[0] == 0.5
    assert torch.isnan(again.gc[1])
