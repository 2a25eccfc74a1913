import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.commands import (
    ReconstructionFiles,
    ReconstructionOptions,
    RegistrationFiles,
    reconstruct_files,
    register_files,
    registered_components,
)
from torchkcreg.commands.reconstruct import resolve_options
from torchkcreg.commands.reconstruct_inputs import _completed, read_reconstruction_inputs
from torchkcreg.geometry import circular_geometry
from torchkcreg.io import RunFolder, read_config, read_volume, write_geometry, write_projections
from torchkcreg.physics import Beam, material, tungsten_spectrum
from torchkcreg.reconstruction import component_path_lengths
from torchkcreg.simulation.solids import Sphere


@pytest.fixture(scope="module")
def ball_scan(tmp_path_factory, ball_images):
    """Folder with the scan of a ball of water, 20 mm in radius, in air."""
    folder = tmp_path_factory.mktemp("ball")
    geometry, images = ball_images
    write_geometry(folder / "geometry.json", geometry)
    write_projections(folder / "projections.npz", intensity=1000 * torch.exp(-images), open_beam=1000.0)
    return folder


@pytest.fixture(scope="module")
def ball_images():
    from torchkcreg.simulation.solids import chord_image

    geometry = circular_geometry(range(0, 200, 5), sad=404, sdd=538, det_shape=(28, 40), pixel_spacing=(2.5, 2.5))
    ball = Sphere(torch.zeros(3), 20.0)
    return geometry, torch.stack(
        [0.02 * chord_image(ball, matrix, geometry.det_shape) for matrix in geometry.projection_matrices]
    )


@pytest.fixture(scope="module")
def small_run(small_case, tmp_path_factory):
    """A finished registration of the small case."""
    out = tmp_path_factory.mktemp("runs") / "run"
    files = RegistrationFiles(
        implant=small_case / "implant.stl",
        geometry=small_case / "geometry.json",
        projections=small_case / "projections.npz",
        components=small_case / "screws.json",
        spectrum=small_case / "spectrum.csv",
        config=small_case / "quick.yaml",
    )
    register_files(files, out, overrides={"material": "steel"}, figures=False)
    return out


def arguments(folder, out, *more):
    files = ["--geometry", str(folder / "geometry.json"), "--projections", str(folder / "projections.npz")]
    return ["reconstruct", *files, "--out", str(out), "--spacing", "4", *map(str, more)]


@pytest.mark.parametrize("method", ["fdk", "pwls"])
def test_the_command_line_makes_a_volume_with_its_geometry(ball_scan, tmp_path, method):
    of_method = {"fdk": [], "pwls": ["--iterations", 6, "--beta", 1]}[method]
    assert main(arguments(ball_scan, tmp_path / "out", "--method", method, *of_method)) == 0
    volume, grid = read_volume(tmp_path / "out" / "volume.mha")
    inside = grid.points().norm(dim=-1) < 14
    assert volume[inside].mean() == pytest.approx(0.02, rel=0.03)
    numbers, _ = read_volume(tmp_path / "out" / "volume_hu.mha")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    expected = 1000 * (volume[inside].mean() / metrics["water"] - 1)
    assert numbers[inside].mean() == pytest.approx(float(expected), abs=1)
    assert (tmp_path / "out" / "slices.png").stat().st_size > 1000
    assert metrics["scatter"]["fraction"] < 0.02


def test_size_and_centre_choose_the_voxels(ball_scan, tmp_path):
    flags = ("--size", 24, 24, 12, "--center", 4, 0, 2, "--no-figures")
    assert main(arguments(ball_scan, tmp_path / "out", *flags)) == 0
    _, grid = read_volume(tmp_path / "out" / "volume.mha")
    assert grid.shape == (3, 6, 6)
    assert grid.origin == pytest.approx((-6.0, -10.0, -2.0))


def test_kcrec_takes_implant_and_files_from_the_run(small_run, tmp_path):
    options = ["--method", "kcrec", "--run", str(small_run), "--out", str(tmp_path / "out"), "--spacing", "6"]
    assert main(["reconstruct", *options, "--size", "60", "60", "120", "--iterations", "2", "--subsets", "1"]) == 0
    background, _ = read_volume(tmp_path / "out" / "volume.mha")
    whole, _ = read_volume(tmp_path / "out" / "with_implant.mha")
    assert whole.max() > 5 * background.max().clamp_min(0.01)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["components"].count("steel") > 1 and metrics["passes"] == 2


def test_kcmar_is_an_fdk_around_the_registered_metal(ball_scan, small_run, tmp_path, capsys):
    flags = ("--method", "kcmar", "--no-figures")
    assert main(arguments(ball_scan, tmp_path / "around", *flags, "--run", small_run)) == 0
    background, grid = read_volume(tmp_path / "around" / "volume.mha")
    whole, _ = read_volume(tmp_path / "around" / "with_implant.mha")
    inside = grid.points().norm(dim=-1) < 14
    assert 0.014 < float(background[inside].mean()) < 0.02  # behind a plate as wide as the ball little is left of it
    assert whole.max() > 3 * background.max()
    metrics = json.loads((tmp_path / "around" / "metrics.json").read_text())
    assert metrics["components"].count("steel") > 1 and metrics["passes"] is None
    assert main(arguments(ball_scan, tmp_path / "other", *flags)) == 2
    assert "method kcmar needs the run of a registration" in capsys.readouterr().err


def test_a_beam_that_nobody_knows_is_estimated_behind_the_registered_metal(ball_scan, small_run, tmp_path, capsys):
    geometry = circular_geometry(range(0, 200, 8), sad=404, sdd=538, det_shape=(60, 50), pixel_spacing=(1.5, 1.5))
    lengths = component_path_lengths(registered_components(small_run), geometry)
    seen = Beam.of([material("steel")], tungsten_spectrum(90)).transmission(lengths[None].double())[0]
    write_geometry(tmp_path / "geometry.json", geometry)
    write_projections(tmp_path / "scan.npz", intensity=60000 * seen.float(), open_beam=60000.0)
    files = ["--geometry", str(tmp_path / "geometry.json"), "--projections", str(tmp_path / "scan.npz")]
    options = ["reconstruct", "--run", str(small_run), *files, "--spacing", "6", "--size", "60", "60", "120"]
    options += ["--scatter", "none"]
    estimated = ["--beam", "estimate", "--out", str(tmp_path / "out")]
    assert main([*options, *estimated, "--method", "kcmar"]) == 0
    beam = json.loads((tmp_path / "out" / "metrics.json").read_text())["beam"]
    assert beam["alloys"] == ["steel"] and 0.9 < beam["scales"][0] < 1.1
    assert (tmp_path / "out" / "beam.png").stat().st_size > 1000
    assert main(arguments(ball_scan, tmp_path / "other", "--beam", "estimate")) == 2
    assert "beam estimate needs known metal: use method kcrec or kcmar, not fdk" in capsys.readouterr().err
    assert main([*options, *estimated, "--method", "kcrec", "--monoenergetic", "--overwrite"]) == 2
    assert "monoenergetic cannot be combined with beam estimate" in capsys.readouterr().err


def test_the_registered_metal_has_the_volume_of_its_meshes(small_run, small_case):
    components = registered_components(small_run)
    assert len(components) == 7  # a plate and six screws
    from torchkcreg.io import read_mesh

    assert components[0].cloud.volume == pytest.approx(read_mesh(small_case / "implant.stl").volume, rel=0.01)
    plate_alone = registered_components(small_run, components=small_case / "screws.json")
    assert len(plate_alone) == 7


def test_screws_that_a_registration_found_are_known_components(small_case, tmp_path):
    files = RegistrationFiles(
        implant=small_case / "implant.stl",
        geometry=small_case / "geometry.json",
        projections=small_case / "projections.npz",
    )
    stages = [{"bin": 4, "iterations": 2, "oversampling": 1, "before": ["find_screws"], "estimate": ["screws"]}]
    overrides = {"material": "steel", "pitch_mm": 1.0, "stages": stages}
    result = register_files(files, tmp_path / "run", overrides=overrides, figures=False)
    _, *screws = registered_components(tmp_path / "run")
    assert len(screws) == len(result.screws_found) >= 1
    for screw, found in zip(screws, result.screws_found, strict=True):
        assert screw.material == found.material
        assert screw.cloud.volume == pytest.approx(found.mesh().volume, rel=0.03)
    told = registered_components(tmp_path / "run", components=small_case / "screws.json")
    assert len(told) == 7


def test_a_stopped_reconstruction_resumes_to_the_same_volume(ball_scan, tmp_path, monkeypatch):
    files = ReconstructionFiles(geometry=ball_scan / "geometry.json", projections=ball_scan / "projections.npz")
    options = ReconstructionOptions(method="pwls", spacing_mm=5.0, iterations=12, subsets=4, scatter="none")
    reconstruct_files(files, tmp_path / "whole", options, figures=False)

    save, calls = RunFolder.save_checkpoint, []

    def stop_at_the_second(run, state):
        save(run, state)
        calls.append(state["solver"]["iteration"])
        if len(calls) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "save_checkpoint", stop_at_the_second)
        with pytest.raises(KeyboardInterrupt):
            reconstruct_files(files, tmp_path / "cut", options, figures=False)
    assert calls == [5, 10] and not (tmp_path / "cut" / "volume.mha").exists()
    reconstruct_files(files, tmp_path / "cut", options, resume=True, figures=False)
    whole, cut = (read_volume(tmp_path / name / "volume.mha")[0] for name in ("whole", "cut"))
    assert torch.equal(whole, cut)
    with pytest.raises(ValueError, match="started with other reconstruction"):
        changed = options.model_copy(update={"beta": 3.0})
        reconstruct_files(files, tmp_path / "cut", changed, resume=True, figures=False)


def test_voxels_near_the_metal_are_divided(ball_scan, small_run, tmp_path, capsys):
    flags = ("--method", "kcrec", "--run", small_run, "--iterations", 8, "--subsets", 2, "--scatter", "none")
    assert main(arguments(ball_scan, tmp_path / "out", *flags, "--refine", 2, "--refine-within", 4)) == 0
    volume, grid = read_volume(tmp_path / "out" / "volume.mha")
    near, fine = read_volume(tmp_path / "out" / "near_metal_volume.mha")
    assert fine.spacing == tuple(step / 2 for step in grid.spacing)
    whole, _ = read_volume(tmp_path / "out" / "near_metal_with_implant.mha")
    assert whole.max() > 3 * near.max()
    metal = sum(component.fraction(fine) for component in registered_components(small_run))
    assert float(metal.sum()) * fine.voxel_volume > 100.0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["near_metal_mm"] == list(fine.spacing) and metrics["shape"] == list(volume.shape)
    assert main(arguments(ball_scan, tmp_path / "other", "--method", "pwls", "--refine", 2)) == 2
    assert "divided near known metal: use method kcrec, not pwls" in capsys.readouterr().err


def test_beam_and_blur_may_be_what_the_registration_found(small_run, tmp_path):
    """Hardness and blur as the run's folder has them; the reference energy stays the spectrum's."""
    harder = tmp_path / "run"
    shutil.copytree(small_run, harder)
    record = json.loads((harder / "deformation.json").read_text())
    record["intensity"]["hardness"], record["blur_mm"] = 6.0, 0.3
    (harder / "deformation.json").write_text(json.dumps(record))
    files = ReconstructionFiles(run=harder)
    options = ReconstructionOptions(method="kcrec", scatter="none", size_mm=(10, 10, 10), spacing_mm=5)
    given, found = (read_reconstruction_inputs(files, options.model_copy(update={"beam": b})) for b in ("given", "run"))
    assert found.beam.reference_kev == given.beam.reference_kev
    energies = [float(inputs.beam.beam.weights @ inputs.beam.beam.energies_kev) for inputs in (given, found)]
    assert energies[1] > energies[0] + 2
    assert given.blur_sigma_px == pytest.approx(0.3 / given.geometry.pixel_spacing[0])


def test_wrong_input_is_one_line_that_names_it(ball_scan, small_run, tmp_path, capsys):
    assert main(arguments(ball_scan, tmp_path / "a", "--method", "kcrec")) == 2
    assert "needs the run of a registration" in capsys.readouterr().err
    assert main(["reconstruct", "--run", str(small_run), "--out", str(small_run), "--overwrite"]) == 2
    assert "would be overwritten" in capsys.readouterr().err and (small_run / "deformation.json").exists()
    assert main(["reconstruct", "--run", str(small_run), "--out", str(tmp_path / "b"), "--scatter", "none"]) == 2
    assert "needs at least 3 views" in capsys.readouterr().err
    assert main(arguments(ball_scan, tmp_path / "c", "--size", 10, -1, 10)) == 2
    assert "size_mm must be positive" in capsys.readouterr().err
    assert main(["reconstruct", "--out", str(tmp_path / "d")]) == 2
    assert "needs geometry and projections" in capsys.readouterr().err
    assert main(arguments(ball_scan, tmp_path / "e", "--initial", ball_scan / "geometry.json")) == 2
    assert "an initial volume has no effect on fdk" in capsys.readouterr().err
    with pytest.raises(ValueError, match="unknown_key: Extra inputs"):
        resolve_options({"unknown_key": 1})


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("fdk", {"iterations": 10, "beta": 3.0}, "no effect on fdk, only on pwls, kcrec: iterations, beta"),
        ("pwls", {"window": "cosine"}, "no effect on pwls, only on fdk, kcmar: window"),
        ("pwls", {"material": "steel"}, "no effect on pwls, only on kcmar, kcrec: material"),
        ("fdk", {"center_mm": (1.0, 0.0, 0.0)}, "center_mm has no effect without size_mm"),
    ],
)
def test_an_option_without_effect_on_the_method_is_refused(method: str, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        resolve_options({"method": method, **options})
    defaults = {name: ReconstructionOptions.model_fields[name].default for name in options}
    assert resolve_options({"method": method, **defaults}).method == method


def test_known_components_take_two_passes_unless_told_otherwise() -> None:
    assert ReconstructionOptions(method="kcrec").num_passes == 2
    assert ReconstructionOptions(method="kcrec", passes=1).num_passes == 1
    assert ReconstructionOptions(method="pwls").num_passes == 1


def test_scatter_may_be_what_the_registration_found(ball_scan, small_run, tmp_path, capsys):
    assert main(arguments(ball_scan, tmp_path / "a", "--scatter", "run")) == 2
    assert "needs the run of a registration: name it with --run" in capsys.readouterr().err
    means = {}
    for scatter in ("run", "none"):
        out = tmp_path / scatter
        assert main(arguments(ball_scan, out, "--run", small_run, "--scatter", scatter, "--no-figures")) == 0
        volume, grid = read_volume(out / "volume.mha")
        means[scatter] = float(volume[grid.points().norm(dim=-1) < 14].mean())
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())["scatter"]["mean_of_run"]
    assert found > 0 and means["run"] > means["none"]  # less signal is primary: the ball is denser


def test_a_registration_and_a_reconstruction_do_not_take_each_others_folder(ball_scan, small_run, small_case, tmp_path):
    taken = tmp_path / "run"
    shutil.copytree(small_run, taken)
    before = sorted(path.name for path in taken.iterdir())
    with pytest.raises(FileExistsError, match="holds a registration, no reconstruction"):
        main_or_raise(arguments(ball_scan, taken, "--method", "fdk", "--overwrite"))
    assert sorted(path.name for path in taken.iterdir()) == before
    main_or_raise(arguments(ball_scan, tmp_path / "rec", "--method", "fdk"))
    files = RegistrationFiles(
        implant=small_case / "implant.stl",
        geometry=small_case / "geometry.json",
        projections=small_case / "projections.npz",
        config=small_case / "quick.yaml",
    )
    with pytest.raises(FileExistsError, match="holds a reconstruction, no registration"):
        register_files(files, tmp_path / "rec", overwrite=True, figures=False)
    assert (tmp_path / "rec" / "volume.mha").exists()


def main_or_raise(words):
    """Run the command line; its error is raised instead of printed."""
    assert main([*words, "--debug"]) == 0


def test_the_open_beam_of_a_run_is_not_that_of_another_scan(ball_scan, small_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(small_run, run)
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("files:\n", "files:\n  open_beam: 45000.0\n", 1))
    options = ReconstructionOptions(method="fdk", scatter="none", spacing_mm=8.0)
    alone = ReconstructionFiles(geometry=ball_scan / "geometry.json", projections=ball_scan / "projections.npz")
    lines = [read_reconstruction_inputs(files, options).transmission for files in (alone, replace(alone, run=run))]
    assert torch.equal(*lines)
    assert _completed(ReconstructionFiles(run=run)).open_beam == 45000.0
    named = small_case_projections(run)
    assert _completed(ReconstructionFiles(run=run, projections=named)).open_beam == 45000.0


def small_case_projections(run):
    """Path of the projections that a run was made of."""
    return Path(read_config(run / "config.yaml")["files"]["projections"])


def test_a_reconstruction_says_which_voxels_are_seen_from_all_sides(ball_scan, tmp_path):
    main_or_raise(
        arguments(ball_scan, tmp_path / "rec", "--method", "fdk", "--spacing", "4", "--size", "140", "140", "8")
    )
    seen, _ = read_volume(tmp_path / "rec" / "measured.mha")
    middle = seen[seen.shape[0] // 2]
    assert middle[17, 17] == 1 and middle[0, 0] == 0 and middle[17, 0] == 0
