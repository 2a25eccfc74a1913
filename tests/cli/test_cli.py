import json
import subprocess
import sys

import numpy as np
import pytest
import torch
import trimesh

import torchkcreg
from torchkcreg.cli import main
from torchkcreg.geometry import transform_points
from torchkcreg.io import read_components, read_geometry, read_points, read_projections, read_run, write_json

FIGURES = {"overlay.png", "displacement.png", "history.png", "overlay.npz", "report.html"}
RUN_FILES = {"config.yaml", "versions.json", "checkpoint.pt", "history.json", "metrics.json", "deformation.json"}
EXPORTS = {"dvf.mha", "bspline.tfm", "implant_deformed.ply", "implant_deformed.vtp", "arrays.npz", "uncertainty.json"}


def command(case, out, **changes):
    """Arguments of a quick registration; a change of None leaves the flag out."""
    flags = {
        "implant": case / "implant.stl",
        "geometry": case / "geometry.json",
        "projections": case / "projections.npz",
        "components": case / "screws.json",
        "spectrum": case / "spectrum.csv",
        "config": case / "quick.yaml",
        "material": "steel",
        "out": out,
        **changes,
    }
    return ["register", *(f"--{k.replace('_', '-')}={v}" for k, v in flags.items() if v is not None)]


@pytest.fixture(scope="module")
def finished(small_case, tmp_path_factory):
    """A run folder."""
    out = tmp_path_factory.mktemp("finished") / "run"
    assert main(command(small_case, out)) == 0
    return out


def the_error(capsys, name="register"):
    """The error's text: the only line that is neither a warning nor empty."""
    lines = capsys.readouterr().err.splitlines()
    errors = [line for line in lines if not line.startswith(f"torchkcreg {name}: warning: ")]
    assert len(errors) == 1, lines
    assert errors[0].startswith(f"torchkcreg {name}: error: ")
    return errors[0]


def rejected(arguments, out, capsys):
    """The error of a registration that must fail before anything is written."""
    capsys.readouterr()
    assert main(arguments) == 2
    assert not out.exists()
    return the_error(capsys)


def test_a_registration_leaves_a_whole_run_folder(finished):
    assert {entry.name for entry in finished.iterdir()} == RUN_FILES | EXPORTS | FIGURES
    metrics = json.loads((finished / "metrics.json").read_text())
    assert len(metrics["gc"]) == 3
    assert min(metrics["gc"]) > 0.8
    assert metrics["status"] == ("doubtful" if metrics["warnings"] else "ok")
    assert metrics["node_std_mm"] < 0.5


def test_a_registration_finds_most_of_the_motion(small_case, finished, tmp_path):
    before, after = (read_points(small_case / f"{name}.csv") for name in ("before", "after"))
    arguments = ["warp", f"--run={finished}", f"--points={small_case / 'before.csv'}", f"--out={tmp_path / 'w.csv'}"]
    assert main(arguments) == 0
    warped = read_points(tmp_path / "w.csv")
    start, end = ((p - after).square().sum(-1).mean().sqrt().item() for p in (before, warped))
    assert end < 0.5 * start
    torch.testing.assert_close(warped, read_run(finished).warp(before), rtol=0, atol=1e-6)


def test_warping_replaces_its_own_tables_and_nothing_else(finished, small_case, tmp_path, capsys):
    points, out = tmp_path / "points.csv", tmp_path / "out.csv"
    points.write_text((small_case / "before.csv").read_text())
    arguments = ["warp", f"--run={finished}", f"--points={points}"]
    assert main([*arguments, f"--out={out}"]) == 0
    first = out.read_text()
    assert main([*arguments, f"--out={out}"]) == 0 and out.read_text() == first
    before = points.read_text()
    for more in ([], ["--overwrite"]):
        assert main([*arguments, f"--out={points}", *more]) == 2
        assert "holds the points themselves" in capsys.readouterr().err
    assert points.read_text() == before
    other = tmp_path / "mine.csv"
    other.write_text("x,y,z\n1,2,3\n")
    assert main([*arguments, f"--out={other}"]) == 2
    assert "is there already" in capsys.readouterr().err and other.read_text() == "x,y,z\n1,2,3\n"
    assert main([*arguments, f"--out={other}", "--overwrite"]) == 0 and other.read_text() == first


def test_warp_flags_points_beyond_the_implant(finished, tmp_path, capsys):
    (tmp_path / "points.csv").write_text("x,y,z\n0,0,0\n0,0,500\n")
    assert (
        main(["warp", f"--run={finished}", f"--points={tmp_path / 'points.csv'}", f"--out={tmp_path / 'w.csv'}"]) == 0
    )
    lines = (tmp_path / "w.csv").read_text().splitlines()
    assert lines[0] == "x,y,z,outside,lateral_std_mm,depth_std_mm"
    near, far = ([float(cell) for cell in line.split(",")] for line in lines[1:])
    assert [near[3], far[3]] == [0, 1]
    assert 0 < near[4] < far[4] and 0 < near[5] < far[5]  # a rotation that is off grows with the distance
    assert "1 of 2 points lie beyond the implant's reach" in capsys.readouterr().err


def test_a_registration_starts_from_an_earlier_one_of_the_same_implant(small_case, finished, tmp_path, capsys):
    from torchkcreg.commands import RegistrationFiles
    from torchkcreg.commands.register_inputs import read_inputs
    from torchkcreg.registration import RegistrationConfig

    names = {"geometry": small_case / "geometry.json", "projections": small_case / "projections.npz"}
    files = RegistrationFiles(implant=small_case / "implant.stl", init=finished, **names)
    (implant,) = read_inputs(files, RegistrationConfig(pitch_mm=1.0)).implants
    torch.testing.assert_close(implant.implant_to_world, read_run(finished).implant_to_world)
    mesh = trimesh.load(small_case / "implant.stl")
    mesh.apply_translation([0, 30, 0])
    mesh.export(tmp_path / "elsewhere.stl")
    rejected(
        command(small_case, tmp_path / "run", implant=tmp_path / "elsewhere.stl", init=finished),
        tmp_path / "run",
        capsys,
    )


def test_finite_elements_bend_an_implant_from_the_shape_of_an_earlier_run(small_case, finished, tmp_path, capsys):
    from torchkcreg.commands import RegistrationFiles
    from torchkcreg.commands.register_inputs import read_inputs
    from torchkcreg.registration import RegistrationConfig, build_scene

    names = {"geometry": small_case / "geometry.json", "projections": small_case / "projections.npz"}
    files = RegistrationFiles(implant=small_case / "implant.stl", rest=finished, **names)
    config = RegistrationConfig(pitch_mm=1.0, deformation="fe", material="steel")
    inputs, before = read_inputs(files, config), read_run(finished)
    torch.testing.assert_close(inputs.implants[0].implant_to_world, before.implant_to_world)
    points = inputs.implants[0].cloud.points.double()
    scene = build_scene(inputs.implants, config)
    torch.testing.assert_close(scene.assemblies[0].warp(points), before.warp(points), atol=1e-6, rtol=0)
    assert scene.assemblies[0].deformation.rest_spread is not None
    out = tmp_path / "run"
    asked = command(small_case, out, rest=finished, material="steel", deformation="modes")
    assert "--deformation fe" in rejected(asked, out, capsys)
    assert "is no run" in rejected(command(small_case, out, rest=tmp_path, deformation="fe"), out, capsys)


def test_plan_ranks_views_without_any_image(small_case, tmp_path, capsys):
    flags = [f"--implant={small_case / 'implant.stl'}", "--material=steel", f"--out={tmp_path / 'plan'}"]
    geometry = f"--geometry={small_case / 'geometry.json'}"
    assert main(["plan", *flags, geometry, f"--components={small_case / 'screws.json'}", "--most=3"]) == 0
    assert {entry.name for entry in (tmp_path / "plan").iterdir()} == {"plan.json", "plan.csv", "plan.png"}
    best = json.loads((tmp_path / "plan" / "plan.json").read_text())["best"]
    assert len(best["2"]) == 3 and best["3"][0]["views"] == [0, 1, 2]
    assert 0 < best["2"][0]["node_std_mm"] < best["2"][1]["node_std_mm"]
    assert "2 views: " in capsys.readouterr().out
    assert main(["plan", *flags, geometry, "--most=4"]) == 2
    assert "3 views to choose from, fewer than the 4" in the_error(capsys, "plan")


def test_compare_of_a_run_with_itself_finds_no_motion_and_writes_table_and_figure(finished, tmp_path, capsys):
    flags = ["--loads", "100", "200", f"--out={tmp_path / 'c'}"]
    assert main(["compare", str(finished), str(finished), str(finished), *flags]) == 0
    written = {"compare.json", "compare.csv", "compare.png", "report.html"}
    assert {entry.name for entry in (tmp_path / "c").iterdir()} == written
    content = json.loads((tmp_path / "c" / "compare.json").read_text())
    first = content["runs"][0]
    assert max(map(abs, first["rotation_deg"] + first["translation_mm"])) < 1e-6
    assert min(first["rotation_std_deg"] + first["translation_std_mm"]) > 0
    assert content["compliance_per_n"]["rotation_across_deg"]["std"] > 0
    assert "degrees per kN" in capsys.readouterr().out
    heads, *rows = (tmp_path / "c" / "compare.csv").read_text().splitlines()
    assert heads.startswith("run,load_n,rotation_across_deg,rotation_across_std_deg,") and len(rows) == 2


def test_compare_refuses_what_cannot_be_told(finished, capsys):
    assert main(["compare", str(finished), str(finished), "--loads", "1", "2"]) == 2
    assert "1 loaded runs need as many loads, got 2" in the_error(capsys, "compare")
    for load in ("0", "nan"):
        assert main(["compare", str(finished), str(finished), "--loads", load]) == 2
        assert f"one of them other than 0 N, got {load}" in the_error(capsys, "compare")
    assert main(["compare", str(finished), str(finished), "--plane", "0", "0", "500"]) == 2
    assert "give the plane of the fracture" in the_error(capsys, "compare")
    assert main(["compare", str(finished), str(finished), "--plane", "0", "0"]) == 2
    assert "3 or 6 numbers, got 2" in the_error(capsys, "compare")


def test_evaluate_prints_and_writes_the_error(small_case, finished, tmp_path, capsys):
    points, truth = small_case / "before.csv", small_case / "after.csv"
    flags = [f"--run={finished}", f"--points={points}", f"--truth={truth}", f"--out={tmp_path / 'e.json'}"]
    assert main(["evaluate", *flags]) == 0
    metrics = json.loads((tmp_path / "e.json").read_text())
    errors = (read_run(finished).warp(read_points(points)) - read_points(truth)).norm(dim=-1)
    assert metrics["rmse_mm"] == pytest.approx(errors.square().mean().sqrt().item())
    assert f"RMSE {metrics['rmse_mm']:.3f} mm" in capsys.readouterr().out


def test_info_describes_each_file_in_its_own_words(small_case, finished, capsys):
    names = ("implant.stl", "geometry.json", "projections.npz")
    assert main(["info", *(str(small_case / name) for name in names), str(finished)]) == 0
    out = capsys.readouterr().out
    for text in ("13.5 x 4.6 x 188 mm", "3 views of 192 x 80 pixels", "source T1", "control points in 2 groups"):
        assert text in out


def test_info_alone_says_what_is_installed_and_which_projector_runs(capsys):
    assert main(["info"]) == 0
    out = capsys.readouterr().out
    assert f"torch {torch.__version__}" in out
    assert "projector backend " in out


def test_info_of_a_file_of_another_kind_is_an_error(tmp_path, capsys):
    (tmp_path / "notes.md").write_text("90 kV")
    assert main(["info", str(tmp_path / "notes.md")]) == 2
    assert "cannot be described" in the_error(capsys, "info")


def test_the_same_seed_gives_the_same_bits(small_case, finished, tmp_path):
    assert main(command(small_case, tmp_path / "again", seed=0)) == 0
    assert (tmp_path / "again" / "deformation.json").read_text() == (finished / "deformation.json").read_text()


def test_a_runs_own_config_repeats_it(small_case, finished, tmp_path):
    arguments = command(small_case, tmp_path / "again", config=finished / "config.yaml", material=None)
    assert main([*arguments, "--no-figures"]) == 0
    assert (tmp_path / "again" / "deformation.json").read_text() == (finished / "deformation.json").read_text()
    assert not (tmp_path / "again" / "overlay.png").exists()


def test_the_implants_frame_does_not_matter(small_case, finished, tmp_path):
    """CAD frame: the mesh is turned and shifted, and init.json says so."""
    pose = torch.tensor([[0.0, 0, 1, 5], [1, 0, 0, -7], [0, 1, 0, 9], [0, 0, 0, 1]], dtype=torch.float64)
    back = torch.linalg.inv(pose)
    mesh = trimesh.load(small_case / "implant.stl")
    mesh.apply_transform(back.numpy())
    mesh.export(tmp_path / "cad.stl")
    ends = [
        transform_points(back, torch.tensor([c.start, c.end]).double()).tolist()
        for c in read_components(small_case / "screws.json")
    ]
    screws = [{"from": start, "to": end, "radius": 2.0, "material": "steel"} for start, end in ends]
    write_json(tmp_path / "screws.json", {"screws": screws})
    write_json(tmp_path / "init.json", {"implant_to_world": pose})
    files = {"implant": "cad.stl", "components": "screws.json", "init": "init.json"}
    arguments = command(small_case, tmp_path / "run", **{flag: tmp_path / name for flag, name in files.items()})
    assert main([*arguments, "--no-figures"]) == 0
    points = read_points(small_case / "before.csv")
    turned = read_run(tmp_path / "run").warp(transform_points(back, points))
    torch.testing.assert_close(turned, read_run(finished).warp(points), rtol=0, atol=0.15)


def test_a_folder_that_holds_a_run_is_not_overwritten_unasked(small_case, finished, capsys):
    before = {entry: entry.stat().st_mtime_ns for entry in finished.iterdir()}
    capsys.readouterr()
    assert main(command(small_case, finished)) == 2
    assert "holds a run already" in the_error(capsys)
    assert {entry: entry.stat().st_mtime_ns for entry in finished.iterdir()} == before


def test_a_run_is_resumed_only_with_the_options_and_files_it_was_started_with(small_case, finished, capsys):
    capsys.readouterr()
    assert main([*command(small_case, finished, pitch=2.0), "--resume"]) == 2
    assert "started with other options: pitch_mm" in the_error(capsys)
    assert main([*command(small_case, finished, views="0,1"), "--resume"]) == 2
    assert "started with other files: views" in the_error(capsys)
    assert read_run(finished).config.pitch_mm == 1.0


def test_there_must_be_a_run_to_resume(small_case, tmp_path, capsys):
    assert "no run to resume" in rejected(
        [*command(small_case, tmp_path / "run"), "--resume"], tmp_path / "run", capsys
    )


def test_bad_pixels_are_masked_counted_and_said_in_one_line(small_case, tmp_path, capsys):
    with np.load(small_case / "projections.npz") as file:
        intensity, open_beam = file["intensity"].astype(np.float32), file["open_beam"]
    intensity[0, 90:93, 40] = np.nan
    intensity[1, 10, 10:12] = 0
    np.savez(tmp_path / "bad.npz", intensity=intensity, open_beam=open_beam)
    out = tmp_path / "run"
    arguments = command(small_case, out, projections=tmp_path / "bad.npz", views="0,2")
    assert main([*arguments, "--no-figures"]) == 0
    warning, *of_verdict = capsys.readouterr().err.splitlines()
    assert not any("masked" in line for line in of_verdict)
    said = "3 pixels are masked (3 not finite)"
    assert warning.startswith("torchkcreg register: warning: ")
    assert said in warning
    assert said in read_run(out).warnings[0]
    assert said in json.loads((out / "metrics.json").read_text())["warnings"][0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"implant": "nowhere.stl"}, "mesh file nowhere.stl does not exist"),
        ({"geometry": "nowhere.json"}, "geometry file nowhere.json does not exist"),
        ({"projections": "nowhere.npz"}, "projections file nowhere.npz does not exist"),
        ({"material": "unobtainium"}, "unobtainium"),
        ({"preset": "fast"}, "preset"),
        ({"backend": "fortran"}, "backend"),
        ({"backend": "triton"}, 'backend "triton" needs tensors on cuda'),
        ({"pitch": -1}, "pitch_mm"),
        ({"pitch": "fine"}, "--pitch"),
        ({"seed": "x"}, "--seed"),
        ({"views": "0,one"}, "views must be such as 3,4-10,0:200:20"),
        ({"views": "0,3"}, "there is no view 3"),
        ({"views": "-1"}, "there is no view -1"),
        ({"views": "0,1,0"}, "got view 0 2 times"),
        ({"material": None}, "a spectrum needs the implant's material"),
        ({"open_beam": -5}, "open_beam must be positive"),
        ({"colour": "red"}, "unrecognized arguments: --colour=red"),
    ],
)
def test_a_wrong_flag_is_one_line_that_names_it(small_case, tmp_path, capsys, changes, message):
    capsys.readouterr()
    assert main(command(small_case, tmp_path / "run", **changes)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "error: " in line
    assert message in line
    assert not (tmp_path / "run").exists()


def test_an_open_mesh_is_an_error_that_counts_the_edges(small_case, tmp_path, capsys):
    mesh = trimesh.load(small_case / "implant.stl")
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "open.stl")
    out = tmp_path / "run"
    assert "3 open edges" in rejected(command(small_case, out, implant=tmp_path / "open.stl"), out, capsys)


def test_a_mesh_in_metres_is_noticed_and_its_size_said(small_case, tmp_path, capsys):
    mesh = trimesh.load(small_case / "implant.stl")
    mesh.apply_scale(0.001)
    mesh.export(tmp_path / "metres.stl")
    assert main(command(small_case, tmp_path / "run", implant=tmp_path / "metres.stl")) == 2
    warning, *_, error = capsys.readouterr().err.splitlines()
    assert "0.0135 x 0.0046 x 0.188 mm: it is probably in metres" in warning
    assert "0.0135 x 0.0046 x 0.188 mm, too small" in error
    assert not (tmp_path / "run").exists()


def test_an_implant_outside_every_view_is_searched_unless_the_start_is_given(small_case, tmp_path, capsys):
    mesh = trimesh.load(small_case / "implant.stl")
    mesh.apply_translation((0.0, 0.0, 900.0))
    mesh.export(tmp_path / "far.stl")
    out = tmp_path / "run"
    arguments = command(small_case, out, implant=tmp_path / "far.stl", components=None)
    assert "outside every view" in rejected([*arguments, "--start", "given"], out, capsys)
    assert main([*arguments, "--dry-run", "--no-figures"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("searched, since the start pose does not agree with the images: implant")
    assert "100 % within the image" in said


def arrays_of(case):
    with np.load(case / "projections.npz") as file:
        return file["intensity"], file["open_beam"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda i, b: {"intensity": i[:2], "open_beam": b}, "(2, 192, 80), the geometry has (3, 192, 80)"),
        (lambda i, b: {"intensity": i[:, :, 1:], "open_beam": b}, "(3, 192, 79), the geometry has (3, 192, 80)"),
        (lambda i, b: {"intensity": i[0], "open_beam": b}, "shape (V, rows, cols)"),
        (lambda i, b: {"intensity": i}, "open_beam"),
        (lambda i, b: {"intensity": 0 * i, "open_beam": b}, "no valid pixel is left in view 0, 1, 2"),
        (lambda i, b: {"images": i}, "needs either intensity"),
    ],
)
def test_projections_that_do_not_fit_are_an_error(small_case, tmp_path, capsys, change, message):
    np.savez(tmp_path / "wrong.npz", **change(*arrays_of(small_case)))
    out = tmp_path / "run"
    assert message in rejected(command(small_case, out, projections=tmp_path / "wrong.npz"), out, capsys)


@pytest.mark.parametrize(
    ("flag", "text", "message"),
    [
        ("geometry", "{", "not valid JSON"),
        ("geometry", '{"views": []}', "at least one view"),
        ("components", "[1, 2", "not valid JSON"),
        ("components", '{"screws": [{"from": [0, 0, 0]}]}', "screw 0 has no 'to'"),
        ("init", '{"pose": 1}', "no 'implant_to_world'"),
        ("init", "[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]", "must be rigid"),
        ("spectrum", "energy,weight\n", "holds no rows"),
        ("config", "pitch: 1\n", "pitch: Extra inputs are not permitted"),
        ("config", "stages: [{bins: 2}]\n", "stages.0.bins: Extra inputs are not permitted"),
        ("config", "preset: [\n", "not valid YAML"),
        ("config", "stages: [{bin: 64}]\n", "too few for a stage that bins 64"),
        ("config", "beta: -1\n", "beta"),
    ],
)
def test_a_file_with_wrong_content_is_an_error_that_names_file_and_key(
    small_case, tmp_path, capsys, flag, text, message
):
    path = tmp_path / "wrong.file"
    path.write_text(text)
    out = tmp_path / "run"
    error = rejected(command(small_case, out, **{flag: path}), out, capsys)
    assert message in error
    assert ("the detector has" in error) or str(path) in error


def test_views_in_another_order_are_other_views(small_case):
    """The fixture's views differ, so the tests of selections can fail."""
    geometry = read_geometry(small_case / "geometry.json")
    projections = read_projections(small_case / "projections.npz")
    assert geometry.sources == ("T1", "T2", "T3")
    assert not torch.equal(projections.line_integrals[0], projections.line_integrals[1])


def test_missing_runs_and_points_are_errors(small_case, finished, tmp_path, capsys):
    out = f"--out={tmp_path / 'w.csv'}"
    assert main(["warp", f"--run={tmp_path / 'no'}", f"--points={small_case / 'before.csv'}", out]) == 2
    assert "does not exist" in the_error(capsys, "warp")
    assert main(["warp", f"--run={finished}", f"--points={tmp_path / 'no.csv'}", out]) == 2
    assert "does not exist" in the_error(capsys, "warp")
    (tmp_path / "text.csv").write_text("x,y,z\n1,2,three\n")
    assert main(["warp", f"--run={finished}", f"--points={tmp_path / 'text.csv'}", out]) == 2
    assert "line 2" in the_error(capsys, "warp")
    assert not (tmp_path / "w.csv").exists()


def test_the_module_runs_as_a_program_and_knows_its_version():
    done = subprocess.run([sys.executable, "-m", "torchkcreg", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"torchkcreg {torchkcreg.__version__}"


def test_no_command_is_an_error(capsys):
    assert main([]) == 2
    assert capsys.readouterr().err == "torchkcreg: error: the following arguments are required: COMMAND\n"


@pytest.fixture(scope="module")
def true_shape(small_case, finished, tmp_path_factory):
    """Folder with what the finished run found, moved by 0.3 mm: as a mesh, in metres, and as a scan."""
    folder = tmp_path_factory.mktemp("true_shape")
    mesh = trimesh.load(small_case / "implant.stl").subdivide_to_size(4.0)
    vertices = read_run(finished).warp(torch.tensor(np.asarray(mesh.vertices)))
    mesh.vertices = (vertices + torch.tensor([0.3, 0.0, 0.0])).numpy()
    mesh.export(folder / "true.stl")
    np.savetxt(folder / "scan.xyz", trimesh.sample.sample_surface(mesh, 3000, seed=0)[0])
    mesh.apply_scale(0.001)
    mesh.export(folder / "metres.stl")
    return folder


def test_evaluate_compares_with_a_true_shape_prints_and_draws(finished, true_shape, tmp_path, capsys):
    flags = [f"--run={finished}", f"--out={tmp_path / 'e.json'}", f"--figures={tmp_path / 'figures'}"]
    capsys.readouterr()
    assert main(["evaluate", *flags, f"--reference={true_shape / 'true.stl'}"]) == 0
    shape = json.loads((tmp_path / "e.json").read_text())["shape"]
    assert 0.05 < shape["surface_before"]["rmse_mm"] < 0.3
    assert shape["surface_after"]["rmse_mm"] < 0.005
    assert shape["shift_mm"] == pytest.approx(0.3, abs=0.02)
    out = capsys.readouterr().out
    assert "node to surface, after CPD" in out
    assert "floor between perfect lattices       0.480   0.500" in out
    pictures = {"displacement.png", "error_map.png", "histogram.png"}
    assert {entry.name for entry in (tmp_path / "figures").iterdir()} == pictures


def test_evaluate_takes_points_and_a_scan_at_once(small_case, finished, true_shape, tmp_path, capsys):
    points = [f"--points={small_case / 'before.csv'}", f"--truth={small_case / 'after.csv'}"]
    flags = [f"--run={finished}", f"--reference={true_shape / 'scan.xyz'}", f"--out={tmp_path / 'e.json'}"]
    capsys.readouterr()
    assert main(["evaluate", *flags, *points]) == 0
    metrics = json.loads((tmp_path / "e.json").read_text())
    assert metrics["num_points"] == 8
    assert metrics["shape"]["reference"] == "surface"
    assert metrics["shape"]["surface_after"]["rmse_mm"] < 0.01
    assert "8 points: RMSE" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "nothing to compare with"),
        (["--points={case}/before.csv"], "points need truth"),
        (["--truth={case}/after.csv"], "truth need points"),
        (["--reference=nowhere.stl"], "reference file nowhere.stl does not exist"),
        (["--reference={shape}/metres.stl"], "is the reference in metres"),
        (["--reference={shape}/scan.xyz", "--reference-kind=line"], "--reference-kind"),
        (["--reference={shape}/scan.xyz", "--implant=nowhere.stl"], "mesh file nowhere.stl does not exist"),
        (["--points={case}/before.csv", "--truth={case}/after.csv", "--reference-kind=surface"], "needs a reference"),
    ],
)
def test_evaluate_says_what_is_missing_or_wrong(small_case, finished, true_shape, capsys, flags, message):
    capsys.readouterr()
    filled = [flag.format(case=small_case, shape=true_shape) for flag in flags]
    assert main(["evaluate", f"--run={finished}", *filled]) == 2
    assert message in the_error(capsys, "evaluate")


def test_a_failed_registration_is_exit_status_3_and_is_written(small_case, tmp_path, capsys):
    with np.load(small_case / "projections.npz") as file:
        intensity, open_beam = file["intensity"], file["open_beam"]
    np.savez(tmp_path / "wrong.npz", intensity=intensity[:, ::-1, ::-1], open_beam=open_beam)
    out = tmp_path / "run"
    assert main([*command(small_case, out, projections=tmp_path / "wrong.npz"), "--no-figures"]) == 3
    output = capsys.readouterr()
    assert output.out.startswith("failed: ")
    assert "torchkcreg register: warning: " in output.err
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["status"] == "failed"
    assert metrics["warnings"]
    assert read_run_quietly(out).status == "failed"
    arguments = ["warp", f"--run={out}", f"--points={small_case / 'before.csv'}", f"--out={tmp_path / 'w.csv'}"]
    assert main(arguments) == 0
    assert "is failed: " in capsys.readouterr().err


def read_run_quietly(folder):
    with pytest.warns(UserWarning, match="is failed"):
        return read_run(folder)


def test_views_are_lists_ranges_and_slices() -> None:
    from argparse import ArgumentTypeError

    from torchkcreg.cli.register import views_of

    assert views_of("15,16,17") == [15, 16, 17]
    assert views_of("4-7,0:20:5,9") == [4, 5, 6, 7, 0, 5, 10, 15, 9]
    assert views_of("2:4") == [2, 3]
    assert (views_of("all"), views_of("auto")) == ("all", "auto")
    for wrong in ("", "a", "4-", "7-4", "0:5:0", "1;2"):
        with pytest.raises(ArgumentTypeError, match="views must be such as"):
            views_of(wrong)


def test_of_many_views_those_that_lie_far_apart_are_used(tmp_path) -> None:
    from itertools import pairwise

    from torchkcreg.commands import RegistrationFiles
    from torchkcreg.geometry import circular_geometry
    from torchkcreg.io import write_geometry

    ring = circular_geometry(range(0, 200), sad=404, sdd=538, det_shape=(64, 64), pixel_spacing=(3.0, 3.0))
    write_geometry(tmp_path / "scan.json", ring)
    write_geometry(tmp_path / "few.json", ring.select(list(range(20))))
    files = {name: tmp_path / f"{name}.none" for name in ("implant", "projections")}
    chosen = RegistrationFiles(geometry=tmp_path / "scan.json", **files).with_views().views
    assert len(chosen) == 24 and min(b - a for a, b in pairwise(chosen)) >= 5
    assert RegistrationFiles(geometry=tmp_path / "few.json", **files).with_views().views is None
    given = RegistrationFiles(geometry=tmp_path / "scan.json", views=[3, 4], **files)
    assert given.with_views() is given
    assert RegistrationFiles(geometry=tmp_path / "few.json", views="all", **files).with_views().views == list(range(20))
