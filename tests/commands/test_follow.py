"""A fracture over its visits, from assessments that are written by hand."""

import json

import pytest

from torchkcreg.cli import main


def assessment(folder, rotation: float, *, status="ok", callus=None, mineral=None, loads=(300.0, 600.0)):
    """A visit whose upper fragment tilts by `rotation` degrees per kN, with an error of 0.05 degrees."""
    configurations = [
        {
            "name": f"at{load:g}",
            "status": status,
            "reasons": [],
            "load_n": load,
            "rotation_deg": rotation * load / 1000,
            "rotation_std_deg": 0.05,
            "moment_nmm": 20.0 * load,
            "moment_std_nmm": 500.0,
            "places": {"bone axis": {"axial_mm": -0.8 * load / 1000, "axial_std_mm": 0.03}},
        }
        for load in loads
    ]
    content = {"configurations": configurations, "mineral": [] if mineral is None else [mineral]}
    if callus is not None:
        content["callus"] = {
            "axial_n_per_mm": callus,
            "axial_std_n_per_mm": 40.0,
            "bending_nm_per_deg": callus / 1000,
            "bending_std_nm_per_deg": 0.04,
        }
    folder.mkdir()
    (folder / "assess.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def visits(tmp_path):
    mineral = {"region": "gap", "hydroxyapatite_mg_ml": 120.0}
    return [
        assessment(tmp_path / "week2", 4.0),
        assessment(tmp_path / "week6", 2.0, callus=250.0, status="doubtful"),
        assessment(tmp_path / "week12", 0.5, callus=900.0, mineral=mineral),
    ]


def test_motion_is_told_per_newton_with_its_error_and_gaps_stay_gaps(visits, tmp_path, capsys):
    out = tmp_path / "out"
    dates = ["2026-01-05", "2026-02-02", "2026-03-16"]
    assert main(["follow", *map(str, visits), "--dates", *dates, "--out", str(out)]) == 0
    content = json.loads((out / "follow.json").read_text())
    assert content["visits"] == ["week2", "week6", "week12"] and content["days"] == [0, 28, 70]
    tilt = content["series"]["tilt_deg_per_kn"]
    assert [round(n["value"], 6) for n in tilt] == [4.0, 2.0, 0.5]
    # two loads of 0.3 and 0.6 kN, each off by 0.05 degrees
    assert tilt[0]["std"] == pytest.approx(0.05 / (0.3**2 + 0.6**2) ** 0.5)
    assert [round(n["value"], 6) for n in content["series"]["closing_mm_per_kn"]] == [0.8, 0.8, 0.8]
    assert [round(n["value"], 6) for n in content["series"]["moment_nm_per_kn"]] == [20.0, 20.0, 20.0]
    assert [n and n["value"] for n in content["series"]["callus_n_per_mm"]] == [None, 250.0, 900.0]
    assert [n and n["value"] for n in content["series"]["gap_mineral_mg_ml"]] == [None, None, 120.0]
    assert content["warnings"] == ["week6: at300 is doubtful", "week6: at600 is doubtful"]
    rows = (out / "follow.csv").read_text().splitlines()
    assert rows[0].startswith("visit,day,tilt_deg_per_kn,tilt_deg_per_kn_std") and len(rows) == 4
    assert rows[1].startswith("week2,0,4,") and rows[1].endswith(",,,,")
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "tilts less than at the first visit: 0.50" in page and "data:image/png" in page
    assert "stiffness of the tissue in the gap (N/mm): -, 250 +- 40, 900 +- 40" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        (["--dates", "2026-01-05"], "3 visits need as many dates, got 1"),
        (["--dates", "2026-01-05", "2026-01-04", "2026-01-06"], "in the order of time"),
        (["--dates", "5.1.2026", "a", "b"], "a date is such as 2026-12-31"),
    ],
)
def test_dates_that_do_not_fit_are_refused(visits, tmp_path, capsys, more, problem):
    assert main(["follow", *map(str, visits), "--out", str(tmp_path / "out"), *more]) == 2
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_visit_without_known_loads_or_an_assessment_is_named(visits, tmp_path, capsys):
    content = json.loads((visits[1] / "assess.json").read_text())
    for c in content["configurations"]:
        del c["load_n"]
    (visits[1] / "assess.json").write_text(json.dumps(content))
    assert main(["follow", *map(str, visits), "--out", str(tmp_path / "out")]) == 2
    assert "week6 has no motion under a known load" in capsys.readouterr().err
    (visits[1] / "assess.json").unlink()
    assert main(["follow", *map(str, visits), "--out", str(tmp_path / "out")]) == 2
    assert "assess.json" in capsys.readouterr().err


def test_a_single_visit_and_figures_left_out(visits, tmp_path):
    assert main(["follow", str(visits[0]), "--out", str(tmp_path / "out"), "--no-figures"]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["follow.csv", "follow.json"]
