import json

import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.commands import RegistrationFiles, register_files, register_seeds
from torchkcreg.commands.seeds import distances_from_mean
from torchkcreg.io import read_config, read_run

CHANCE = (
    "pitch_mm: 1.0\n"
    "stages: [{bin: 4, pitch_factor: 2, optimizer: cmaes, iterations: 3, population: 4, oversampling: 1, step_mm: 0.5}]"
)


@pytest.fixture
def files(small_case, tmp_path):
    """A registration of three generations of CMA-ES, which ends where its seed takes it."""
    (tmp_path / "chance.yaml").write_text(CHANCE)
    names = {"implant": "implant.stl", "geometry": "geometry.json", "projections": "projections.npz"}
    paths = {flag: small_case / name for flag, name in names.items()}
    return RegistrationFiles(**paths, config=tmp_path / "chance.yaml")


def arguments(files, out, *more):
    paths = [f"--{name}={getattr(files, name)}" for name in ("implant", "geometry", "projections", "config")]
    return ["register", *paths, f"--out={out}", "--no-figures", *more]


def test_distances_are_those_from_the_mean_of_the_runs():
    nodes = torch.zeros(3, 5, 3)
    nodes[0, :, 0], nodes[1, :, 0] = 3.0, -3.0
    assert distances_from_mean(nodes).tolist() == [3.0, 3.0, 0.0]


def test_the_best_of_several_seeds_is_the_run_and_each_is_kept(files, tmp_path):
    with pytest.warns(UserWarning, match="3 seeds end up to .* more than 0.02 mm"):
        runs = register_seeds(files, tmp_path / "run", 3, overrides={"seed": 5}, figures=False)
    assert runs.seeds == (5, 6, 7)
    kept = [read_run(tmp_path / "run" / "seeds" / str(seed)) for seed in runs.seeds]
    ends = [result.history[-1]["loss"] for result in kept]
    assert list(runs.losses) == ends
    best = kept[ends.index(min(ends))]
    assert runs.result.seed == best.seed
    whole = read_run(tmp_path / "run")
    assert torch.equal(whole.implant_to_world, best.implant_to_world)
    points = torch.tensor([[0.0, 0.0, -60.0], [0.0, 0.0, 60.0]])
    found = torch.stack([result.warp(points) for result in kept])
    assert distances_from_mean(found).max() == pytest.approx(runs.spread_mm, rel=0.5)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["seeds"]["spread_mm"] == pytest.approx(runs.spread_mm)
    assert [run["seed"] for run in metrics["seeds"]["runs"]] == [5, 6, 7]
    assert "3 seeds end up to" in metrics["warnings"][-1]


def test_a_seed_of_several_ends_with_the_bits_of_a_run_of_its_own(files, tmp_path):
    with pytest.warns(UserWarning, match="2 seeds"):
        runs = register_seeds(files, tmp_path / "several", 2, figures=False)
    register_files(files, tmp_path / "alone", overrides={"seed": 1}, figures=False)
    name = "deformation.json"
    alone = (tmp_path / "alone" / name).read_text()
    assert json.loads((tmp_path / "several" / "seeds" / "1" / name).read_text()) == json.loads(alone)
    assert read_config(tmp_path / "several" / "config.yaml")["options"]["seed"] == runs.result.seed


def test_overwriting_leaves_no_seeds_of_the_run_before(files, tmp_path):
    with pytest.warns(UserWarning, match="2 seeds"):
        register_seeds(files, tmp_path / "run", 2, overrides={"seed": 3}, figures=False)
    runs = register_seeds(files, tmp_path / "run", 1, overwrite=True, figures=False)
    assert runs.spread_mm == 0
    assert [entry.name for entry in (tmp_path / "run" / "seeds").iterdir()] == ["0"]
    register_files(files, tmp_path / "run", overwrite=True, figures=False)
    assert not (tmp_path / "run" / "seeds").exists()


def test_the_command_says_the_spread(files, tmp_path, capsys):
    assert main(arguments(files, tmp_path / "run", "--seeds=2", "--seed=4")) in (0, 3)  # a few iterations from chance
    out, err = capsys.readouterr()
    assert "2 seeds: spread " in out
    assert "torchkcreg register: warning: 2 seeds end up to" in err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--seeds=0"], "seeds must be at least 1, got 0"),
        (["--seeds=-3"], "seeds must be at least 1, got -3"),
        (["--seeds=2", "--resume"], "--seeds cannot be resumed"),
        (["--seeds=few"], "--seeds"),
    ],
)
def test_seeds_that_cannot_be_run_are_one_line(files, tmp_path, capsys, more, message):
    assert main(arguments(files, tmp_path / "run", *more)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "run").exists()
