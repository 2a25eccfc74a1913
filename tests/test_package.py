import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchkcreg
from torchkcreg.commands.demo import CASE, SIMULATED_KVP, VIEWS, _write_case
from torchkcreg.simulation import weight_bearing_case

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_importing_the_package_does_not_load_torch():
    code = "import sys, torchkcreg; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", torchkcreg.__all__)
def test_every_public_name_is_there(name):
    assert getattr(torchkcreg, name) is not None
    assert name in dir(torchkcreg)


def test_dir_shows_names_and_folders_alone():
    folders = {path.parent.name for path in (ROOT / "torchkcreg").glob("*/__init__.py")} - {"cli"}
    code = "import torchkcreg as kc; kc.register; kc.io; print(*dir(kc))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert set(shown) == {*torchkcreg.__all__, *folders}


def test_the_names_are_those_of_the_folders():
    from torchkcreg.geometry import ConeBeamGeometry
    from torchkcreg.registration import register

    assert torchkcreg.ConeBeamGeometry is ConeBeamGeometry
    assert torchkcreg.register is register


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'registre'"):
        _ = torchkcreg.registre


def test_the_version_is_the_packages_and_the_changelogs():
    setup = (ROOT / "setup.cfg").read_text(encoding="utf-8")
    assert f"version = {torchkcreg.__version__}" in setup or "version = attr: torchkcreg.__version__" in setup
    assert f"## [{torchkcreg.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def readme(tmp_path_factory):
    """Names that the README's Python leaves, run in one go beside the demo's case, and the beads of the case."""
    folder = tmp_path_factory.mktemp("readme")
    case = weight_bearing_case(1.0, views=VIEWS, kvp=SIMULATED_KVP)
    (folder / "demo").mkdir()
    _write_case(folder / "demo" / CASE, case)
    names: dict = {}
    here = Path.cwd()
    os.chdir(folder)
    try:
        for code in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
            exec(compile(code, "README.md", "exec"), names)
    finally:
        os.chdir(here)
    return {**names, "before": case.beads_before, "after": case.beads_after}


def rms(points, truth) -> float:
    return float((points.detach() - truth).square().sum(-1).mean().sqrt())


def test_the_readmes_torch_loop_moves_the_implant_nearer(readme):
    assert rms(readme["beads"], readme["after"]) < 0.4 * rms(readme["before"], readme["after"])


def test_the_readmes_registration_registers(readme):
    assert rms(readme["result"].warp(readme["before"]), readme["after"]) < 0.1


def test_the_figures_in_readme_and_documentation_are_those_of_the_result_files():
    run = subprocess.run([sys.executable, ROOT / "scripts" / "results.py", "--check"], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout
