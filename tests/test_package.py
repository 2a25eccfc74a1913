import ast
import re
import subprocess
import sys
from collections import Counter
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
    made = ("simulate", "experiment", "study", "demo", "densitometry", "convert", "report", "doctor")
    for command in ("register", "warp", "evaluate", "load", "compare", "plan", "reconstruct", "info", *made):
        assert main([command, "--help"]) == 0
        texts.append(capsys.readouterr().out)
    flags = set(re.findall(r"(?<![\w-])--[a-z]+(?:-[a-z]+)*", README)) - {"--no-build-isolation"}
    assert "--components" in flags
    assert not [flag for flag in flags if not any(flag in text for text in texts)]


def test_folders_are_there_whatever_was_touched_before():
    code = "import torchkcreg as kc; print(kc.registration.Trainer.__name__, kc.io.__name__, 'io' in dir(kc))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["Trainer", "torchkcreg.io", "True"]


def test_the_page_on_extending_runs_from_start_to_end(capsys):
    page = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) >= 8
    space: dict = {}
    for block in blocks:
        exec(compile(block, "extend.md", "exec"), space)
    out = capsys.readouterr().out
    assert "RegistrationResult(" in out and "('auto', 'cpp', 'triton', 'torch') True False" in out


def test_the_page_on_elastic_bodies_runs(capsys):
    page = (ROOT / "docs" / "mechanics.md").read_text(encoding="utf-8")
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(block, "mechanics.md", "exec"), {})
    bent, stress = (float(re.search(r"tensor\(\[+([-.\d]+)", line)[1]) for line in capsys.readouterr().out.splitlines())
    assert bent == pytest.approx(100 * 110**3 / (48 * 193_000 * 10 * 4**3 / 12), rel=0.05)
    assert stress == pytest.approx(50 * 45 * 2 / (10 * 4**3 / 12), rel=0.05)


def public_names(folder: Path) -> list[str]:
    """The names in the `__all__` of a folder."""
    for node in ast.parse((folder / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "__all__":
            return [element.value for element in node.value.elts]  # type: ignore[attr-defined]
    return []


def test_no_public_name_is_used_by_neither_the_package_nor_its_documents():
    package = ROOT / "torchkcreg"
    texts = [p.read_text(encoding="utf-8") for p in package.rglob("*.py") if p != package / "__init__.py"]
    documents = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("notebooks/*"), *ROOT.glob("benchmarks/*.py")]
    told = [p.read_text(encoding="utf-8") for p in documents if p.is_file() and p.name != "CHANGELOG.md"]
    used = Counter(word for text in texts for word in re.findall(r"\w+", text))
    named = {word for text in told for word in re.findall(r"\w+", text)}
    for folder in (p.parent for p in package.glob("*/__init__.py")):
        for name in public_names(folder):
            # once where it is defined, once where the folder imports it, once in its __all__
            assert used[name] > 3 or name in named, f"{folder.name}.{name} is public, and nobody uses it"
