from dataclasses import replace

import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.commands import RegistrationFiles, register_files, resolve_config
from torchkcreg.commands.register import sample_of
from torchkcreg.io import read_config, read_run
from torchkcreg.registration import Callback


class Interruption(Callback):
    """Stops a registration in the middle of its second stage, as a user would."""

    def on_iteration(self, trainer, index, progress):
        if index == 1 and progress.iteration == 2:
            raise KeyboardInterrupt


@pytest.fixture
def files(small_case):
    return RegistrationFiles(
        implant=small_case / "implant.stl",
        geometry=small_case / "geometry.json",
        projections=small_case / "projections.npz",
        components=small_case / "screws.json",
        config=small_case / "quick.yaml",
    )


def test_a_run_that_was_interrupted_ends_with_the_bits_of_one_that_was_not(files, tmp_path):
    options = {"material": "steel"}
    register_files(files, tmp_path / "whole", overrides=options, figures=False)
    with pytest.raises(KeyboardInterrupt):
        register_files(files, tmp_path / "cut", overrides=options, figures=False, callbacks=[Interruption()])
    assert (tmp_path / "cut" / "checkpoint.pt").is_file()
    assert not (tmp_path / "cut" / "deformation.json").exists()
    register_files(files, tmp_path / "cut", overrides=options, figures=False, resume=True)
    texts = [(tmp_path / name / "deformation.json").read_text() for name in ("whole", "cut")]
    assert texts[0] == texts[1]


def test_the_result_and_the_folder_say_the_same(files, tmp_path, small_case):
    result = register_files(files, tmp_path / "run", overrides={"material": "steel"}, figures=False)
    again = read_run(tmp_path / "run")
    points = torch.tensor([[x, 2.0, z] for x in (-5.0, 0.0, 5.0) for z in (-90.0, -20.0, 30.0, 120.0)])
    assert again.warp(points).tolist() == result.warp(points).tolist()
    assert again.gc.tolist() == result.gc.tolist()
    kept = read_config(tmp_path / "run" / "config.yaml")
    assert kept["options"]["material"] == "steel"
    assert kept["files"]["implant"] == str((small_case / "implant.stl").resolve())
    assert [stage["groups"] for stage in kept["schedule"]] == [1, 2]


def test_overwriting_replaces_the_run(files, tmp_path):
    first = register_files(files, tmp_path / "run", overrides={"material": "steel"}, figures=False)
    second = register_files(files, tmp_path / "run", overrides={"beta": 0.5}, overwrite=True, figures=False)
    assert (first.config.material, second.config.material) == ("steel", None)
    assert read_run(tmp_path / "run").config == second.config


def test_warping_leaves_the_deformation_in_its_dtype(files, tmp_path):
    result = register_files(files, tmp_path / "run", figures=False)
    result.deformation.float()
    assert result.warp(result.deformation.grid.positions().reshape(-1, 3)).dtype == torch.float64
    assert str(result.deformation.control_points.dtype) == "torch.float32"


def test_overrides_win_over_the_file(tmp_path):
    (tmp_path / "options.yaml").write_text("beta: 0.25\nseed: 3\n")
    config = resolve_config(tmp_path / "options.yaml", {"seed": 4})
    assert (config.beta, config.seed) == (0.25, 4)


def test_wrong_options_are_one_line_with_every_problem(tmp_path):
    with pytest.raises(ValueError, match=r"^options: seed: .*; pitch: ") as caught:
        resolve_config(None, {"seed": "many", "pitch": 1})
    assert "\n" not in str(caught.value)


def test_a_device_that_is_not_there_is_refused_before_anything_is_written(files, tmp_path):
    with pytest.raises(ValueError, match="device 'nowhere' is not available"):
        register_files(files, tmp_path / "run", overrides={"device": "nowhere"})
    with pytest.raises(ValueError, match="backend must be one of auto, cpp, triton, torch, got 'fast'"):
        register_files(files, tmp_path / "run", overrides={"backend": "fast"})
    assert not (tmp_path / "run").exists()


def test_a_runs_configuration_repeats_it_files_and_views_and_all(files, tmp_path):
    first = register_files(
        replace(files, views=[0, 2]), tmp_path / "run", overrides={"material": "steel"}, figures=False
    )
    config = tmp_path / "run" / "config.yaml"
    assert main(["register", f"--config={config}", f"--out={tmp_path / 'again'}", "--no-figures"]) in (0, 3)
    again = read_run(tmp_path / "again")
    assert len(again.gc) == 2 and again.config == first.config
    assert torch.equal(again.implant_to_world, first.implant_to_world)
    assert RegistrationFiles.of({"config": config, "views": [1]}).views == [1]


def test_a_registration_without_its_files_says_which(tmp_path, files, capsys):
    (tmp_path / "options.yaml").write_text("beta: 0.25\n")
    with pytest.raises(ValueError, match="needs --geometry, --projections"):
        RegistrationFiles.of({"config": tmp_path / "options.yaml", "implant": files.implant, "geometry": None})


def test_a_new_result_has_nothing_of_an_old_one_beside_it(files, tmp_path):
    run = tmp_path / "run"
    register_files(files, run, figures=False)
    (run / "load").mkdir()
    for name in ("geometry_corrected.json", "load/load.json"):
        (run / name).write_text("{}")
    (run / "load" / "mine.txt").write_text("")
    register_files(files, run, overwrite=True, figures=False)
    assert not (run / "geometry_corrected.json").exists() and not (run / "load" / "load.json").exists()
    assert (run / "load" / "mine.txt").exists()


def test_of_a_large_cloud_a_sample_is_written() -> None:
    few = torch.arange(30.0).reshape(10, 3)
    assert sample_of(few) is few
    many = torch.arange(120_000.0)[:, None].expand(-1, 3)
    sample = sample_of(many)
    assert len(sample) == 30_000 and len(sample.unique(dim=0)) == 30_000
    assert 55_000 < float(sample.mean()) < 65_000  # from everywhere
    torch.testing.assert_close(sample, sample_of(many))
