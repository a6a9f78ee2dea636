"""The frame of a page: style, scripts and policy, all inlined."""

from __future__ import annotations

from html import escape
from importlib.resources import files

# Whatever a script may try, the browser fetches nothing.
_POLICY = "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def page(title: str, body: str, *, drawn: bool) -> str:
    """A whole page that needs no other file and no network.

    Args:
        title: its title, escaped here.
        body: its HTML.
        drawn: whether the body holds a 3D view.
    """
    scripts = ""
    if drawn:
        from plotly.offline import get_plotlyjs

        scripts = f"<script>{get_plotlyjs()}</script>"
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)} · jaxmap</title>\n<style>{_resource('page.css')}</style>\n</head>\n"
        f"<body>\n<main>{body}</main>\n{scripts}\n<script>{_resource('page.js')}</script>\n</body>\n</html>\n"
    )


def _resource(name: str) -> str:
    return files("jaxmap.report").joinpath(name).read_text(encoding="utf-8")
