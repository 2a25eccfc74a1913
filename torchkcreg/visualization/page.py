"""A report as one self-contained HTML page: table, pictures, and a 3D view of the implant."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from typing import Any

from numpy.typing import NDArray
from PIL import Image

VERDICTS = ("ok", "doubtful", "failed")


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        name: Name of the quantity.
        value: Value with unit.
        deviation: Expected error with unit; empty if unknown.
        about: A sentence of explanation; empty if the name is clear.
    """

    name: str
    value: str
    deviation: str = ""
    about: str = ""


@dataclass(frozen=True)
class Page:
    """Contents of a report, in the order shown.

    Attributes:
        title: Title of the page.
        verdict: "ok", "doubtful" or "failed"; None without a verdict.
        summary: A sentence beside the verdict.
        warnings: Warnings to read before trusting the numbers.
        answer: Sentences that answer the question, above all else; the table then comes after the pictures.
        tiles: The most important numbers: name, value, and a line of explanation.
        rows: Rows of the table.
        scene: Data of the 3D view, see `implant_scene`; None for no 3D view.
        layers: For each view a label, a PNG of the measured view, and a PNG of it with the implant. The page compares
            both as overlay, by blinking, as a checkerboard, or with a wipe.
        pictures: Title and PNG of each picture.
        details: Title and text of each collapsed section.
        made_with: Line with software versions.
    """

    title: str
    verdict: str | None = None
    summary: str = ""
    warnings: Sequence[str] = ()
    answer: Sequence[str] = ()
    tiles: Sequence[tuple[str, str, str]] = ()
    rows: Sequence[Row] = ()
    scene: dict[str, Any] | None = None
    layers: Sequence[tuple[str, bytes, bytes]] = ()
    pictures: Sequence[tuple[str, bytes]] = ()
    details: Sequence[tuple[str, str]] = ()
    made_with: str = ""


def page_html(page: Page) -> str:
    """The page as HTML that needs no other file and no network.

    Raises:
        ValueError: The verdict is unknown.

    >>> "<h1>run &lt;1&gt;</h1>" in page_html(Page("run <1>", verdict="ok"))
    True
    """
    if page.verdict is not None and page.verdict not in VERDICTS:
        raise ValueError(f"verdict must be one of {', '.join(VERDICTS)}, got {page.verdict!r}")
    parts = [
        f"<h1>{escape(page.title)}</h1>",
        _answer(page.answer),
        _tiles(page.tiles),
        _verdict(page),
    ]
    table, views, viewer = _table(page.rows), _layers(page.layers), _viewer(page.scene)
    pictures = _pictures(page.pictures)
    parts += [viewer, views, pictures, table] if page.answer else [table, views, viewer, pictures]
    parts += [_folded(title, text) for title, text in page.details]
    web = files("torchkcreg.visualization") / "web"
    files_of_page = ("page.css", "viewer.js", "layers.js")
    style, *scripts = (web.joinpath(name).read_text(encoding="utf-8") for name in files_of_page)
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(page.title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>",
            *(part for part in parts if part),
            f"<footer>{escape(page.made_with)}</footer>\n</main>",
            f"<script>\n{''.join(scripts)}</script>\n</body>\n</html>\n",
        ]
    )


def _verdict(page: Page) -> str:
    if page.verdict is None and not page.warnings and not page.summary:
        return ""
    word = "" if page.verdict is None else f"<b>{escape(page.verdict)}</b> "
    reasons = "".join(f"<li>{escape(text)}</li>" for text in page.warnings)
    listed = f"<ul>{reasons}</ul>" if reasons else ""
    return f'<div class="verdict {page.verdict or ""}">{word}{escape(page.summary)}{listed}</div>'


def _answer(sentences: Sequence[str]) -> str:
    shown = "".join(f"<p>{escape(text)}</p>" for text in sentences)
    return f'<section class="answer">{shown}</section>' if shown else ""


def _tiles(tiles: Sequence[tuple[str, str, str]]) -> str:
    shown = "".join(
        f'<div class="tile">{escape(name)}<b>{escape(value)}</b><small>{escape(about)}</small></div>'
        for name, value, about in tiles
    )
    return f'<div class="tiles">{shown}</div>' if shown else ""


def _table(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    errors = any(row.deviation for row in rows)  # no column without entries
    lines = [
        f"<tr><td>{escape(row.name)}{f'<small>{escape(row.about)}</small>' if row.about else ''}</td>"
        f'<td class="number">{escape(row.value)}</td>'
        f"{f'<td class=number>{escape(row.deviation)}</td>' if errors else ''}</tr>"
        for row in rows
    ]
    head = f'<tr><th></th><th class="number">value</th>{"<th class=number>expected error</th>" if errors else ""}</tr>'
    return f'<section><h2>Numbers</h2><div class="wide"><table>{head}{"".join(lines)}</table></div></section>'


def _layers(layers: Sequence[tuple[str, bytes, bytes]]) -> str:
    if not layers:
        return ""
    options = "".join(f"<option>{escape(label)}</option>" for label, _, _ in layers)
    kinds = ("overlay", "measured", "blink", "checkerboard", "wipe")
    modes = "".join(f"<option>{kind}</option>" for kind in kinds)
    images = "".join(
        f'<img hidden alt="" src="{_data(measured)}"><img hidden alt="" src="{_data(overlay)}">'
        for _, measured, overlay in layers
    )
    return (
        f'<section class="layers"><h2>The implant over the measured views</h2>{images}'
        f'<div class="controls"><label>view <select name="view">{options}</select></label>'
        f'<label>show <select name="mode">{modes}</select></label>'
        '<label>wipe position, checkerboard size <input type="range" name="place" min="0" max="100" value="50"></label>'
        "</div>"
        '<canvas role="img" aria-label="A measured view with the registered implant in green"></canvas>'
        "<p>The implant of the model is green. Where the shadow stays white, or green lies beside the shadow, model "
        "and image do not agree.</p></section>"
    )


def _data(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def png_of(image: NDArray) -> bytes:
    """A PNG of an image, uint8 (rows, cols) or (rows, cols, 3)."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _viewer(scene: dict[str, Any] | None) -> str:
    if scene is None:
        return ""
    content = json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c")
    views = '<label><input type="checkbox" name="views"> focal spots and detectors</label>' if scene["sources"] else ""
    return (
        '<section class="viewer"><h2>The implant in 3D</h2>'
        f'<script type="application/json">{content}</script>'
        '<canvas role="img" aria-label="The registered implant, coloured by its displacement; drag to turn"></canvas>'
        '<div class="controls"><label>displacement <input type="range" name="times" min="0" max="20" value="1">'
        "<output>1 x</output></label>"
        '<label>colour <select name="value"><option value="displacement">displacement</option>'
        f'<option value="std">expected error</option></select></label>{views}</div>'
        "<p>Drag to turn, wheel or two fingers to zoom. 0 x: undeformed implant, 1 x: measured displacement.</p>"
        "</section>"
    )


def _pictures(pictures: Sequence[tuple[str, bytes]]) -> str:
    if not pictures:
        return ""
    shown = "".join(
        f'<figure><img alt="{escape(title)}" src="{_data(png)}"><figcaption>{escape(title)}</figcaption></figure>'
        for title, png in pictures
    )
    return f"<section><h2>Pictures</h2>{shown}</section>"


def _folded(title: str, text: str) -> str:
    return f"<section><details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details></section>"
