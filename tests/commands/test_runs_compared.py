"""Ranking of registrations of the same images by what they explain and with how many parameters."""

import json
import math

import pytest
import yaml

from torchkcreg.cli import main
from torchkcreg.commands import runs_compared


@pytest.fixture
def run(tmp_path):
    def made(name, misfit, parameters, projections="images.npz", blocks=100):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "config.yaml").write_text(yaml.safe_dump({"files": {"projections": projections, "views": [0, 1]}}))
        diagnostics = {"misfit": misfit, "effective_parameters": parameters, "blocks": blocks}
        (folder / "metrics.json").write_text(json.dumps({"diagnostics": diagnostics}))
        return folder

    return made


def test_fewer_parameters_win_where_both_explain_as_much(run):
    more, fewer = run("more", 0.02, 40.0), run("fewer", 0.02, 30.0)
    lines = runs_compared([more, fewer]).splitlines()
    assert "fewer: +0.0, misfit 0.0200 with 30.0" in lines[1] and "more: +20.0" in lines[2]


def test_explaining_more_is_worth_parameters(run):
    worse, better = run("worse", 0.02, 30.0), run("better", 0.01, 40.0)
    lines = runs_compared([worse, better]).splitlines()
    assert "better: +0.0" in lines[1]
    assert f"worse: +{100 * math.log(2) - 20:.1f}" in lines[2]


def test_only_runs_of_the_same_images_are_compared(run, tmp_path):
    one, other = run("one", 0.02, 30.0), run("other", 0.02, 30.0, projections="others.npz")
    assert runs_compared([one, other]) == runs_compared([one]) == runs_compared([tmp_path, one]) == ""
    old = run("old", 0.02, None)
    assert runs_compared([one, old]) == ""


def test_info_of_runs_that_are_no_result_says_so(run, capsys):
    assert main(["info", str(run("one", 0.02, 30.0)), str(run("two", 0.02, 31.0))]) == 2
    assert "torchkcreg info: error:" in capsys.readouterr().err
