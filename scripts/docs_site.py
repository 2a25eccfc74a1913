"""What the documentation's site has beside `docs/`: results of the benchmarks, and a page of reference a folder.

A hook of MkDocs: `make docs` calls it.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchkcreg"
SHOWN = ("md", "png", "csv")


def folders() -> list[str]:
    """The package and those of its folders that export names."""
    found = ["torchkcreg"]
    for init in sorted(PACKAGE.glob("*/__init__.py")):
        body = ast.parse(init.read_text(encoding="utf-8")).body
        names = [target.id for node in body if isinstance(node, ast.Assign) for target in node.targets]
        if "__all__" in names:
            found.append(f"torchkcreg.{init.parent.name}")
    return found


def on_config(config: Any) -> Any:
    """Adds the reference to the navigation."""
    pages = [{name.removeprefix("torchkcreg."): f"api/{name}.md"} for name in folders()]
    config.nav.append({"Reference": pages})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Adds pages and pictures."""
    for name in folders():
        files.append(File.generated(config, f"api/{name}.md", content=f"# {name}\n\n::: {name}\n"))
    for path in sorted((ROOT / "benchmarks" / "results").iterdir()):
        if path.suffix[1:] in SHOWN:
            files.append(File.generated(config, f"benchmarks/results/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links out of `docs/` point into the site."""
    if page.file.src_uri.startswith(("api/", "benchmarks/")):
        return markdown
    return markdown.replace("](../benchmarks/results)", "](benchmarks/results/ablation.md)").replace("](../", "](")
