"""Griffe extension that shows the examples (`>>>` lines) of docstrings as code blocks in the documentation."""

from __future__ import annotations

from typing import Any

import griffe


def fenced(text: str) -> str:
    """The docstring with its doctests in code fences. An "Example:" heading is dropped and its block unindented."""
    lines: list[str] = []
    inside = headed = False
    for line in text.splitlines():
        if line == "Example:":
            headed = True
            continue
        headed = headed and (not line.strip() or line.startswith("    "))
        shown = line[4:] if headed else line
        if not inside and shown.startswith(">>> "):
            lines += ["", "```pycon"]
            inside = True
        elif inside and not shown.strip():
            lines.append("```")
            inside = False
        lines.append(shown)
    return "\n".join([*lines, "```"] if inside else lines)


class Examples(griffe.Extension):
    """Puts the examples of all docstrings in code fences."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = fenced(obj.docstring.value)
