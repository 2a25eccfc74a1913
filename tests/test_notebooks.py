import json
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

NOTEBOOKS = sorted((Path(__file__).resolve().parent.parent / "notebooks").glob("*.ipynb"))
LONG = ("03_tibial_plate", "04_femoral_plate", "10_load_and_uncertainty")  # whole experiments: minutes


def test_there_are_notebooks():
    assert {path.stem for path in NOTEBOOKS} >= set(LONG)


def timed(path):
    return pytest.param(path, marks=pytest.mark.slow) if path.stem in LONG else path


@pytest.mark.parametrize("path", [timed(path) for path in NOTEBOOKS], ids=[path.stem for path in NOTEBOOKS])
def test_a_notebook_runs_from_start_to_end(path):
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=1200, kernel_name="python3").execute()
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path):
    cells = [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert cells
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
