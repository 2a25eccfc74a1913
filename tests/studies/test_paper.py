"""The paper's experiments: their recipes, their steps, their tables."""

import json

import pytest
import torch
import trimesh

from torchkcreg.cli import main
from torchkcreg.geometry import transform_points
from torchkcreg.io import read_init, read_mesh, write_json
from torchkcreg.registration import RegistrationConfig
from torchkcreg.simulation.bench import LoadRecipe, Recipe, loaded, specimen
from torchkcreg.simulation.bench.standing import parts_in_beam
from torchkcreg.studies.paper import experiment, femoral_plate, tibial_plate
from torchkcreg.studies.paper.departures import PAPER, Settings, departures
from torchkcreg.studies.paper.experiment import bench_model, packaged, registered, simulated, start_of
from torchkcreg.studies.paper.tibial import _Study, load_table


class Still:
    """A registration that leaves everything where it started."""

    status = "ok"
    diagnostics = {"node_std_mm": 0.1}  # noqa: RUF012

    def __init__(self, pose: torch.Tensor) -> None:
        self.pose = pose

    def warp(self, points: torch.Tensor) -> torch.Tensor:
        return transform_points(self.pose, points.double())

    def deformed(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        moved = self.warp(torch.tensor(mesh.vertices))
        return trimesh.Trimesh(moved.numpy(), mesh.faces, process=False)


@pytest.mark.parametrize("name", ["tibial_plate", "femoral_plate"])
def test_recipes_are_right_and_their_parts_fit(name):
    recipe = Recipe.of(packaged(name))
    made = specimen(recipe)
    assert len(made.screws) == len(recipe.screws.holes)
    parts = parts_in_beam(made, loaded(made, LoadRecipe()))
    assert len({part.name for part in parts}) == len(parts)
    Recipe.of({**packaged("bench"), "implant": packaged(name)["implant"]})


def test_the_femoral_plate_is_bent_and_titanium_and_its_screws_end_in_a_rod():
    recipe = Recipe.of(packaged("femoral_plate"))
    made = specimen(recipe)
    assert recipe.implant.material == "titanium"
    rod = next(rod for rod in recipe.limb.inserts if rod.calcium_mg_ml == 100)
    tip = made.screws[0].end
    assert (tip[0] - rod.start[0]) ** 2 + (tip[1] - rod.start[1]) ** 2 < rod.radius**2


def test_departures_change_one_thing_each_from_the_papers_settings():
    by_name = departures("steel")
    paper = RegistrationConfig.of(by_name[PAPER].options)
    assert not by_name[PAPER].screws and not by_name[PAPER].spectrum and paper.material is None
    changed = {}
    for name, settings in by_name.items():
        config = RegistrationConfig.of(settings.options)
        assert config.preset == "paper" and [s.groups for s in config.schedule()][2:] == [2, 4, 6, 8, 10]
        changed[name] = {key for key in type(config).model_fields if getattr(config, key) != getattr(paper, key)}
    assert changed["screws as components"] == set() and by_name["screws as components"].screws
    assert changed["polyenergetic DRRs"] == {"material"} and by_name["polyenergetic DRRs"].spectrum
    assert changed["elastic energy in the objective"] == {"stiffness"}
    assert changed["control points 17.5 mm apart, as many as needed"] == {"grid_spacing_mm", "grid_grows"}
    assert changed["places along the plate compared"] == {"stages"}
    assert changed["implausible stages undone"] == {"undo_stages"}


def test_a_finished_registration_is_read_and_not_made_again(monkeypatch, tmp_path):
    (tmp_path / "deformation.json").write_text("{}")
    monkeypatch.setattr(experiment, "register_files", lambda *_args, **_options: pytest.fail("made again"))
    monkeypatch.setattr(experiment, "read_run", lambda folder: f"kept {folder.name}")
    found = registered(tmp_path, "cfg0", [0], tmp_path, start=tmp_path, settings=Settings())
    assert found == f"kept {tmp_path.name}"


@pytest.fixture
def quick(monkeypatch, tmp_path):
    """The quick experiment in coarse images, with a registration that does nothing."""
    content = packaged("tibial_plate")
    content["configurations"] = {"cfg0": {}, "cfg3": {"bend": "2 deg"}}
    content["panel"] = {"supersample": 1}
    monkeypatch.setattr("torchkcreg.studies.paper.tibial.packaged", lambda _name: dict(content))

    def coarse(recipe, folder, **changes):
        changes["scanner"] |= {"binning": 8}
        return simulated(recipe, folder, **changes)

    calls = []

    def still(_case, configuration, views, run, *, start, **_options):
        calls.append((configuration, len(views), run.name))
        run.mkdir(parents=True, exist_ok=True)
        write_json(run / "metrics.json", {"seconds": 1.0})
        return Still(read_init(start))

    monkeypatch.setattr("torchkcreg.studies.paper.tibial.simulated", coarse)
    monkeypatch.setattr("torchkcreg.studies.paper.tibial.registered", still)
    return tmp_path / "out", calls


def test_the_quick_experiment_has_a_table_rows_and_figures(quick):
    out, calls = quick
    table = tibial_plate(out, quick=True, paper=True)
    names = [call[2] for call in calls]
    assert names[:4] == ["cfg0-3", "cfg0-3-paper", "cfg3-3", "cfg3-3-paper"]
    assert "cfg3-3-screws_as_components" in names and len(set(names)) == len(names) == 12
    rows = json.loads((out / "rows.json").read_text())
    still, bent = rows[0], rows[2]
    assert still["beads"] == pytest.approx(still["start"])  # a registration that does nothing is not credited
    assert still["segmented"] is None
    assert bent["nodes"] > 0.5
    assert "| cfg3, 0 N | 3 | paper's settings |" in table
    assert (out / "table.md").read_text().strip() == table
    for name in ("overlay.png", "displacement.png"):
        assert (out / name).stat().st_size > 10_000


def test_a_folder_of_another_experiment_is_left_alone(quick, capsys):
    out, _ = quick
    (out / "views").mkdir(parents=True)
    (out / "views" / "mine.txt").write_text("")
    assert main(["experiment", "tibial-plate", "--quick", "--out", str(out)]) == 2
    assert "mine.txt" in capsys.readouterr().err


def test_segmented_beads_are_those_near_where_they_are_expected(tmp_path):
    study = _Study(tmp_path, quick=False, known=True)
    study.segmented["cfg0"] = torch.tensor([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]], dtype=torch.float64)
    expected = torch.tensor([[9.5, 0.2, 0.0], [0.0, 50.0, 0.0]], dtype=torch.float64)
    found = study._segmentation("cfg0", expected)
    assert found[0].tolist() == [10.0, 0.0, 0.0]
    assert bool(found[1].isnan().all())
    study.segmented["cfg1"] = study.segmented["cfg0"] + 0.3
    study.__dict__["content"] = {"configurations": {"cfg0": {}, "cfg1": {}}}
    study.__dict__["beads"] = expected
    error = study._segmented_error("cfg1", Still(torch.eye(4, dtype=torch.float64)))
    assert error == pytest.approx(0.3 * 3**0.5)  # of the one that was found


def test_a_table_says_what_there_is_not():
    assert load_table([]).count("\n") == 1


def test_a_bench_scan_gives_the_implants_surface(tmp_path, monkeypatch):
    pytest.importorskip("skimage")
    content = packaged("bench")
    content["scanner"] |= {"rows": 160, "cols": 72, "num_views": 60, "step": "6 deg", "binning": 1}
    monkeypatch.setattr(experiment, "packaged", lambda _name: content)
    implant = {"plate": {"length": "30 mm", "holes": 2, "hole_radius": "2 mm"}, "material": "titanium"}
    path = bench_model(implant, tmp_path, size_mm=(18.0, 9.0, 36.0))
    scanned, true = read_mesh(path), read_mesh(tmp_path / "scan" / "implant.stl")
    assert scanned.volume == pytest.approx(true.volume, rel=0.03)
    off = trimesh.proximity.closest_point(true, scanned.vertices[::50])[1]
    assert float((off**2).mean() ** 0.5) < 0.08
    stamp = path.stat().st_mtime_ns
    assert bench_model(implant, tmp_path, size_mm=(18.0, 9.0, 36.0)).stat().st_mtime_ns == stamp


def test_a_start_is_off_by_more_than_a_millimetre(tmp_path):
    pose = read_init(start_of(tmp_path / "new"))
    far = torch.tensor([[0.0, 0.0, 90.0], [0.0, 0.0, -90.0]], dtype=torch.float64)
    assert float((transform_points(pose, far) - far).norm(dim=1).min()) > 1.0


@pytest.mark.slow
def test_both_experiments_in_their_quick_form(tmp_path):
    tibial_plate(tmp_path / "a", quick=True)
    rows = json.loads((tmp_path / "a" / "rows.json").read_text())
    assert max(row["beads"] for row in rows) < 0.3
    tables = femoral_plate(tmp_path / "b", quick=True)
    assert "KC-Rec" in tables
    assert json.loads((tmp_path / "b" / "deformed-3.json").read_text())["nodes_rmse_mm"] < 0.15
    assert (tmp_path / "b" / "slices.png").stat().st_size > 10_000
