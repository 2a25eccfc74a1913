"""Studies of simulated cases: wrong geometries, jobs, tables and figures out of rows, the command."""

from __future__ import annotations

import json
import math

import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.geometry import circular_geometry
from torchkcreg.studies import STUDIES, StudyOptions, run_study, simulated, wrong_geometry
from torchkcreg.studies.catalogue import Study
from torchkcreg.studies.simulated import WIDTHS, with_source
from torchkcreg.studies.tibial_loads import recipe_of, registered_load


def geometry(number=3):
    angles = [40.0 * k for k in range(number)]
    return circular_geometry(angles, sad=404.0, sdd=538.0, det_shape=(96, 96), pixel_spacing=(0.8, 0.8))


def nodes():
    return torch.randn(200, 3, generator=torch.Generator().manual_seed(0)).double() * torch.tensor([5.0, 2.0, 50.0])


def test_a_source_moves_while_the_detector_stays():
    views = geometry(1)
    shift = torch.tensor([0.2, -0.1, 0.3]).double()
    matrix = with_source(views.projection_matrices[0], float(views.detector_distances[0]), shift)
    moved = views._derived(matrix[None])
    torch.testing.assert_close(moved.source_positions, views.source_positions + shift)
    torch.testing.assert_close(moved.pixel_positions(), views.pixel_positions())


@pytest.mark.parametrize(("error", "low", "high"), [("detector", 0.1, 0.5), ("source", 0.01, 0.3), ("limb", 0.1, 0.8)])
def test_wrong_geometries_shift_the_image_by_about_what_they_say(error, low, high):
    views = geometry(6)
    off = wrong_geometry(views, nodes(), error, 3).project(nodes())[0] - views.project(nodes())[0]
    assert low < float(off.square().sum(-1).mean().sqrt()) < high  # pixels
    assert len({round(x, 4) for x in off.mean(1)[:, 0].tolist()}) == 6  # each view is off on its own
    torch.testing.assert_close(
        wrong_geometry(views, nodes(), error, 3).projection_matrices,
        wrong_geometry(views, nodes(), error, 3).projection_matrices,
    )


def test_none_is_no_error_and_another_is_refused():
    views = geometry()
    torch.testing.assert_close(wrong_geometry(views, nodes(), "none", 0).projection_matrices, views.projection_matrices)
    with pytest.raises(ValueError, match="error must be one of none, detector, source, limb, all"):
        wrong_geometry(views, nodes(), "gantry", 0)


def row_of(job):
    """What a registration might say of a case."""
    seed = job["seed"]
    wrong = job.get("geometry", "none") != "none" and job["options"].get("view_motion") != "auto"
    off = 0.05 + 0.021 * seed + (0.5 if wrong else 0)
    coverage = {f"{what} {part}": [min(1.0, 0.4 * w) for w in WIDTHS] for what in ("nodes", "beads") for part in "ab"}
    return {
        **{name: off for name in ("nodes", "shape", "beads", "worst", "node_std_mm", "expected_mm")},
        **{"seed": seed, "gc": 0.9, "azimuth": 10.0 * seed, "scatter": 0.1, "seconds": 1.0, "coverage": coverage},
        **{"status": "ok", "warnings": "", "view_motion_mm": None, "planned": job.get("random", 0) is None},
        **{"load_n": job.get("load_n"), "views": job["views"], "photons": job.get("photons")},
        **{"gap_true": 1000.0, "gap_found": 1010.0, "gap_std": 20.0},
        **{"largest_true": -900.0, "largest_found": -700.0, "largest_std": 50.0},
    }


@pytest.fixture
def pretended(monkeypatch):
    """Studies whose registrations are pretended."""
    monkeypatch.setattr("torchkcreg.studies.catalogue.simulated", row_of)
    whole = {name: Study(s.text, s.jobs, s.function, s.report) for name, s in STUDIES.items()}
    for name in ("population", "views", "loads"):
        whole[name] = Study(whole[name].text, whole[name].jobs, row_of, whole[name].report)
    monkeypatch.setattr("torchkcreg.studies.catalogue.STUDIES", whole)


@pytest.mark.parametrize(
    ("name", "files", "told"),
    [
        ("population", {"population.csv", "errors.png", "verdict.png", "coverage.png"}, "3 cases: node RMSE median"),
        ("coverage", {"coverage.png"}, "three views a degree apart (3 cases) | 40%, 78%"),
        ("geometry", {"geometry.csv", "geometry.png"}, "| limb | 3 | 0.571, 0.571 | 0.071, 0.071 | 0 of 3 |"),
        ("views", {"views.csv", "views.png"}, "in 0 of 30 draws, 3 cases"),
        ("loads", {"loads.csv", "loads.png"}, "| 600 N | 0.071 | 0.071 | 0.071 | 0.071 |"),
    ],
)
def test_a_study_writes_table_and_figures_and_is_taken_up(name, files, told, pretended, tmp_path, monkeypatch):
    rows, text = run_study(name, StudyOptions(cases=3), tmp_path / "out", workers=1)
    assert told in text and {path.name for path in (tmp_path / "out").iterdir()} == files | {"jobs.jsonl"}
    monkeypatch.setattr("torchkcreg.studies.catalogue.simulated", None)  # nothing is run again
    assert run_study(name, StudyOptions(cases=3), tmp_path / "out", workers=1) == (rows, text)


def test_a_job_of_the_study_of_loads_is_an_experiment_of_its_own():
    jobs = STUDIES["loads"].jobs(StudyOptions(cases=2, known=True))
    assert len(jobs) == 2 * 6 * 2 * 2
    one, other = (recipe_of(next(j for j in jobs if j["seed"] == seed and j["load_n"] == 400.0)) for seed in (0, 1))
    assert one.configurations["loaded"].force == (0.0, 0.0, -400.0)
    assert one.configurations["loaded"].translation != other.configurations["loaded"].translation
    assert one.panel.photons == 5000.0
    assert one.scanner.views == (91, 92, 93)


@pytest.mark.slow
def test_a_load_is_registered():
    job = STUDIES["loads"].jobs(StudyOptions(cases=1, known=True))[0]
    row = registered_load({**job, "load_n": 300.0})
    assert row["nodes"] < 0.15 and row["beads"] < 0.25 and row["load_n"] == 300.0


def test_silent_failures_and_loads_are_told(pretended, tmp_path):
    _, text = run_study("population", StudyOptions(cases=8), tmp_path, workers=1)
    assert "silent failures 3 [5, 6, 7]" in text and "false alarms 0 []" in text
    assert "bending moments, gap, of 8: error median 10 N mm, 1.0% of them; 8 within 5 %" in text
    assert "bending moments, largest, of 8: error median 200 N mm, 22.2% of them; 0 within" in text


def test_jobs_that_fail_are_counted_and_all_of_them_are_an_error(monkeypatch, tmp_path):
    def fails(job):
        if job["seed"] < 2:
            raise RuntimeError("no memory")
        return row_of(job)

    one = STUDIES["population"]
    monkeypatch.setattr(
        "torchkcreg.studies.catalogue.STUDIES", {"population": Study(one.text, one.jobs, fails, one.report)}
    )
    rows, text = run_study("population", StudyOptions(cases=4), tmp_path / "some", workers=1)
    assert "2 jobs failed, the first with RuntimeError: no memory" in text and rows[3]["nodes"] > 0
    with pytest.raises(ValueError, match="all 2 jobs failed, the first with RuntimeError: no memory"):
        run_study("population", StudyOptions(cases=2), tmp_path / "all", workers=1)


def test_the_command_refuses_what_is_no_study_case_or_option(tmp_path, capsys):
    assert main(["study", "weather"]) == 2
    assert main(["study", "views", "--cases=0", f"--out={tmp_path / 'x'}"]) == 2
    assert "a study needs a case or more, got 0" in capsys.readouterr().err
    assert main(["study", "views", "--options=[1]"]) == 2
    assert main(["study", "views", "--options={"]) == 2
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("name", "asked", "told"),
    [
        ("loads", {"elastic": True, "images": "mirrored"}, "the study loads has its own elastic and images"),
        ("views", {"views": "around"}, "the study views has its own views"),
        ("coverage", {"views": "both"}, "the study coverage has its own views"),
    ],
)
def test_an_option_that_would_change_nothing_is_refused(name, asked, told, tmp_path):
    with pytest.raises(ValueError, match=told):
        run_study(name, StudyOptions(cases=1, **asked), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_command_knows_every_study_and_no_other(tmp_path, capsys):
    for name in STUDIES:
        assert main(["study", name, "--cases=0", f"--out={tmp_path}"]) == 2
        assert "a study needs a case or more" in capsys.readouterr().err


def test_images_without_a_right_answer_are_failures_that_must_be_told(tmp_path):
    rows = [{**row_of(StudyOptions().job(0)), "worst": None, "status": status} for status in ("ok", "failed")]
    assert "silent failures 1 [0]" in STUDIES["population"].report(rows, tmp_path)


@pytest.mark.slow
def test_a_case_of_the_population_is_registered(tmp_path):
    job = StudyOptions(cases=1, known=True, cache=str(tmp_path)).job(0)
    row = json.loads(json.dumps(simulated(job)))
    assert row["nodes"] < 0.3 and row["shape"] <= row["nodes"] and 0 < row["coverage"]["nodes depth"][3] <= 1
    assert len(list(tmp_path.glob("*.npy"))) == 1
    other = simulated({**job, "images": "mirrored"})
    assert other["status"] == "failed" or other["warnings"]
    assert other["worst"] == math.inf
