"""Docstrings and pages are plain English: no markup that MkDocs shows as text, and no riddles that were mended once."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted((ROOT / "torchkcreg").rglob("*.py"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ROLE = re.compile(r":(class|func|meth|attr|mod|data|obj):`|``")
RIDDLES = re.compile(
    r"^Nothing;|^Hears|^What |speaks? against|nobody (knows|told|said)|hangs? together|is told by|what is told"
)


def docstrings(path: Path) -> list[tuple[int, str]]:
    """Docstrings of a file with their lines."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, kinds)]
    return [(getattr(node, "lineno", 1), text) for node in nodes if (text := ast.get_docstring(node))]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_docstrings_are_plain(path):
    for line, text in docstrings(path):
        assert not ROLE.search(text), f"{path.name}:{line} has a Sphinx role or double backticks"
        assert not RIDDLES.search(text), f"{path.name}:{line} is a riddle: {RIDDLES.search(text)[0]}"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_pages_are_plain(path):
    text = path.read_text(encoding="utf-8")
    assert not RIDDLES.search(text), RIDDLES.search(text)[0]


def test_the_check_sees_a_riddle_and_a_role():
    assert RIDDLES.search("Nothing; writes the folder.") and RIDDLES.search("what speaks against bending")
    assert ROLE.search("see :class:`Scene`") and ROLE.search("``x``") and not ROLE.search("see `Scene`")
