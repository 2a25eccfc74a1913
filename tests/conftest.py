"""A small loaded plate as files, for tests of whole commands; and runs in which nothing may be skipped."""

import pytest

from torchkcreg.io import (
    write_components,
    write_config,
    write_geometry,
    write_mesh,
    write_points,
    write_projections,
    write_spectrum,
)
from torchkcreg.physics import tungsten_spectrum
from torchkcreg.simulation import weight_bearing_case

QUICK = {
    "pitch_mm": 1.0,
    "stages": [
        {"bin": 2, "iterations": 4, "oversampling": 1},
        {"groups": 2, "iterations": 3, "oversampling": 1},
    ],
}

EXCUSES = ("no ../shared", "no such device here")


def pytest_addoption(parser):
    parser.addoption("--no-skips", action="store_true", help="a test that is skipped is a failure")


def pytest_terminal_summary(terminalreporter, config):
    """Fails a run that skipped more than the tests of data and devices from elsewhere."""
    skipped = [r for r in terminalreporter.stats.get("skipped", []) if not any(e in str(r.longrepr) for e in EXCUSES)]
    if config.getoption("--no-skips") and skipped:
        terminalreporter.write_line(f"{len(skipped)} skipped with --no-skips: {skipped[0].nodeid}, ...", red=True)
        terminalreporter._session.exitstatus = 1


@pytest.fixture(scope="session")
def small_case(tmp_path_factory):
    """Folder with a case of 192 x 80 pixels and three views; not to be changed."""
    folder = tmp_path_factory.mktemp("small_case")
    case = weight_bearing_case(0.5, seed=1, binning=4)
    write_mesh(folder / "implant.stl", case.implant)
    write_geometry(folder / "geometry.json", case.geometry)
    write_projections(folder / "projections.npz", intensity=case.intensity, open_beam=case.open_beam)
    write_components(folder / "screws.json", case.screws)
    write_spectrum(folder / "spectrum.csv", tungsten_spectrum(90))
    write_config(folder / "quick.yaml", QUICK)
    write_points(folder / "before.csv", case.beads_before)
    write_points(folder / "after.csv", case.beads_after)
    return folder
