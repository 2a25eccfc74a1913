"""The page of symptoms quotes messages as the package gives them, and has an entry for each warning."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
ENTRIES = re.findall(r"^### `(.+)`$", PAGE, re.MULTILINE)
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "torchkcreg").rglob("*.py")}


def text(node: ast.AST) -> str:
    """A string as it is written; what is filled in becomes a blank."""
    if isinstance(node, ast.JoinedStr):
        return "".join(value.value if isinstance(value, ast.Constant) else "_" for value in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def test_each_entry_quotes_a_message_of_the_package():
    messages = [text(node) for tree in TREES.values() for node in ast.walk(tree)]
    assert len(ENTRIES) > 20
    assert [entry for entry in ENTRIES if not any(entry in message for message in messages)] == []


def test_each_warning_has_an_entry():
    """Warnings of a text of their own; others pass on what a reason says."""
    missing = []
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "warn"
            if not is_call or not node.args:
                continue
            message = text(node.args[0])
            words = re.sub(r"_|\W", " ", message).split()
            if len(words) > 4 and not any(entry in message for entry in ENTRIES):
                missing.append(f"{path.name}: {message}")
    assert missing == []
