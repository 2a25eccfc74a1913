import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchkcreg

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_importing_the_package_does_not_load_torch():
    code = "import sys, torchkcreg; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", torchkcreg.__all__)
def test_every_public_name_is_there(name):
    assert getattr(torchkcreg, name) is not None
    assert name in dir(torchkcreg)


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


def examples():
    """Python examples of the readme."""
    return re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_the_readmes_registration_registers(capsys):
    exec(compile(examples()[0], "README.md", "exec"), {})
    before, after = map(float, re.findall(r"([\d.]+) mm", capsys.readouterr().out))
    assert after < 0.2 < before


def test_the_readmes_own_loop_finds_the_shift(capsys):
    exec(compile(examples()[1], "README.md", "exec"), {})
    found = [float(x) for x in re.findall(r"-?\d+\.\d+", capsys.readouterr().out)]
    assert found == pytest.approx([0.6, -0.4, 0.8], abs=0.1)


def test_every_link_of_the_readme_to_a_file_leads_somewhere():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if not link.startswith("http")]
    assert "docs/demo.png" in links
    assert all((ROOT / link).is_file() for link in links)


def test_every_flag_in_the_readme_exists(capsys):
    from torchkcreg.cli import main

    texts = []
    for command in ("register", "warp", "evaluate", "reconstruct", "info", "demo"):
        assert main([command, "--help"]) == 0
        texts.append(capsys.readouterr().out)
    flags = set(re.findall(r"(?<![\w-])--[a-z]+(?:-[a-z]+)*", README)) - {"--no-build-isolation"}
    assert "--components" in flags
    assert all(any(flag in text for text in texts) for flag in flags)


def test_folders_are_there_whatever_was_touched_before():
    code = "import torchkcreg as kc; print(kc.registration.Trainer.__name__, kc.io.__name__, 'io' in dir(kc))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["Trainer", "torchkcreg.io", "True"]
