import json

import pytest

from torchkcreg.commands import demo
from torchkcreg.io import read_run


def test_a_folder_with_something_else_is_refused_even_to_overwrite(tmp_path):
    (tmp_path / "thesis.tex").write_text("years")
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match=r"holds more than a demo \(thesis.tex\)"):
            demo(tmp_path, overwrite=overwrite)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_demo_is_replaced_only_when_asked(tmp_path):
    (tmp_path / "case").mkdir()
    with pytest.raises(FileExistsError, match="holds a demo already"):
        demo(tmp_path)


def test_a_file_in_the_way_is_an_error(tmp_path):
    (tmp_path / "demo").write_text("")
    with pytest.raises(NotADirectoryError, match="a file is in the way"):
        demo(tmp_path / "demo")


@pytest.mark.slow
def test_the_demo_registers_beads_and_plate(tmp_path, capsys):
    metrics = demo(tmp_path / "demo", seed=1)
    assert metrics["beads"].rmse_mm < 0.2
    assert metrics["plate"].rmse_mm < 0.15
    assert metrics["beads at the start"].rmse_mm > 1.0
    out = capsys.readouterr().out
    assert "bead 8" in out
    assert str(tmp_path / "demo" / "run" / "overlay.png") in out
    written = json.loads((tmp_path / "demo" / "evaluation.json").read_text())
    assert written["beads"]["rmse_mm"] == pytest.approx(metrics["beads"].rmse_mm)
    assert read_run(tmp_path / "demo" / "run").config.material == "steel"
