"""MkDocs hook: add benchmark results, examples and a reference page per subpackage to the site built from `docs/`.

`make docs` calls it.
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
    """Names of the package and of its subpackages that export names."""
    packages = ["torchkcreg"]
    for init in sorted(PACKAGE.glob("*/__init__.py")):
        body = ast.parse(init.read_text(encoding="utf-8")).body
        names = [target.id for node in body if isinstance(node, ast.Assign) for target in node.targets]
        if "__all__" in names:
            packages.append(f"torchkcreg.{init.parent.name}")
    return packages


def on_config(config: Any) -> Any:
    """Add the reference to the navigation."""
    pages = [{name.removeprefix("torchkcreg."): f"api/{name}.md"} for name in folders()]
    config.nav.append({"Reference": pages})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add pages and pictures."""
    for name in folders():
        files.append(File.generated(config, f"api/{name}.md", content=f"# {name}\n\n::: {name}\n"))
    for path in sorted((ROOT / "benchmarks" / "results").iterdir()):
        if path.suffix[1:] in SHOWN:
            files.append(File.generated(config, f"benchmarks/results/{path.name}", abs_src_path=str(path)))
    for path in sorted((ROOT / "examples").iterdir()):
        files.append(File.generated(config, f"examples/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Redirect links that leave `docs/` to the corresponding pages of the site."""
    if page.file.src_uri.startswith(("api/", "benchmarks/")):
        return markdown
    return markdown.replace("](../benchmarks/results)", "](benchmarks/results/ablation.md)").replace("](../", "](")
