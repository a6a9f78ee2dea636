"""HTML pages that need no other file and no network: their frame, and the parts that they share."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Whatever a script may try, the browser fetches nothing.
_POLICY = "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"

INK, QUIET, LINE, ACCENT, BAR = "#1f242b", "#667080", "#e4e1d9", "#b23c2e", "#c9b48d"
"""The colours of a light page, as page.css has them."""
THEME = {INK: "--ink", QUIET: "--quiet", LINE: "--line", ACCENT: "--accent", BAR: "--bar"}
"""Their CSS variables."""


def page(title: str, body: str, *, drawn: bool, beside: bool = False) -> str:
    """A whole page.

    Args:
        title: its title, escaped here.
        body: its HTML.
        drawn: whether the body holds a 3D view.
        beside: whether there are scripts in a folder beside it that it may read, and nothing else.
    """
    scripts, policy = "", f"{_POLICY} 'self' file:" if beside else _POLICY
    if drawn:
        from plotly.offline import get_plotlyjs

        scripts = f"<script>{get_plotlyjs()}</script>"
    style, *code = (
        files("jaxmap.report").joinpath(name).read_text(encoding="utf-8")
        for name in ("page.css", "page.js", "drive.js", "detail.js")
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)} · jaxmap</title>\n<style>{style}</style>\n</head>\n"
        f"<body>\n<main>{body}</main>\n{scripts}\n<script>{''.join(code)}</script>\n</body>\n</html>\n"
    )


def write_page(path: Path, title: str, body: str, *, drawn: bool, beside: bool = False) -> Path:
    """Writes a page, atomically, and returns its path.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(page(title, body, drawn=drawn, beside=beside), encoding="utf-8", errors="backslashreplace")
    return path


def header(
    kind: str, title: str, line: str = "", stats: Iterable[tuple[str, str | None]] = (), banner: str = ""
) -> str:
    """The head of a page; the statistics are names and values in HTML, left out where they are None."""
    shown = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in stats if value is not None)
    return (
        f'<header><p class="kind">{kind}</p><h1>{escape(title)}</h1><p>{escape(line)}</p>'
        + (f'<p class="banner">{escape(banner)}</p>' if banner else "")
        + (f'<dl class="stats">{shown}</dl>' if shown else "")
        + "</header>"
    )


def section(title: str, content: str) -> str:
    """A section of a page; nothing where there is no content."""
    return f"<section><h2>{title}</h2>{content}</section>" if content else ""


def notes_section(notes: Iterable[object]) -> str:
    """Notes as a list."""
    items = "".join(f"<li>{escape(str(note))}</li>" for note in notes)
    return section("Notes", f"<ul>{items}</ul>" if items else "")


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "barred") -> str:
    """A table of HTML cells, of which the first of each row is its name.

    Args:
        headings: of the columns; without any, the table has no head.
        rows: cells by row; one that begins with `<td` is taken as it is.
        kind: `barred` for numbers, `plain` for names and values.
    """
    head = "".join(f'<th scope="col">{name}</th>' for name in headings)
    body = "".join(
        f'<tr><th scope="row">{name}</th>'
        + "".join(cell if cell.startswith("<td") else f"<td>{cell}</td>" for cell in cells)
        + "</tr>"
        for name, *cells in rows
    )
    return f'<table class="{kind}">{f"<thead><tr>{head}</tr></thead>" if head else ""}<tbody>{body}</tbody></table>'


def figure(content: str, caption: str) -> str:
    """A figure with its caption: above a table or chart, below a picture."""
    title = f"<figcaption>{caption}</figcaption>"
    return f"<figure>{content}{title}</figure>" if content.startswith("<img") else f"<figure>{title}{content}</figure>"


def inline_image(path: Path, alt: str, *, width_px: int | None = None) -> str:
    """An `<img>` that holds the picture, scaled down to `width_px` where it is wider.

    Raises:
        JaxmapError: the picture cannot be read.
    """
    from jaxmap.host.pictures import open_picture

    try:
        with open_picture(path) as picture:
            picture.load()
            content, kind, image = path.read_bytes(), str(picture.format).lower(), picture
            if width_px is not None and (kind != "webp" or picture.width > width_px):
                image = picture.convert("RGB")
                image.thumbnail((width_px, width_px * 4))
                buffer = io.BytesIO()
                image.save(buffer, "webp", quality=86)
                content, kind = buffer.getvalue(), "webp"
            size = image.size
    except FrameError as error:
        raise JaxmapError("not a readable picture", where=path, fix="remove it or map again") from error
    data = base64.b64encode(content).decode("ascii")
    return f'<img src="data:image/{kind};base64,{data}" alt="{escape(alt)}" width="{size[0]}" height="{size[1]}">'


def paper(path: Path, alt: str, remarks: list[str]) -> str:
    """A picture on white; left out where it is missing, and with a remark where it cannot be read."""
    if not path.is_file():
        return ""
    try:
        return f'<div class="paper">{inline_image(path, alt)}</div>'
    except JaxmapError:
        remarks.append(f"{path.name} could not be read and is left out.")
        return ""


def svg_of(drawing: Figure, title: str, variables: Mapping[str, str] = THEME) -> str:
    """A matplotlib figure as an SVG element, in the fonts of the page.

    Args:
        drawing: in the colours of a light page.
        title: for those who cannot see it.
        variables: CSS variables by the colours that they replace, so that a dark page has its own.
    """
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxmap"}):
        drawing.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    # The style that matplotlib adds would hold for the whole page, and its names occur once in each chart.
    text = re.sub(r"(?s)<metadata>.*?</metadata>|<style.*?</style>| id=\"[a-zA-Z.]+\w*_\d+\"", "", buffer.getvalue())
    text = re.sub(r"'DejaVu Sans'[^;\"]*", "system-ui, sans-serif", text[text.index("<svg") :])
    for colour, name in variables.items():
        text = text.replace(colour, f"var({name})")
    return text.replace("<svg", f'<svg class="chart" role="img" aria-label="{escape(title)}"', 1)


def script_text(content: str) -> str:
    """JSON that is safe inside a `<script>`."""
    return content.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
