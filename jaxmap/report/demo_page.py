"""The page of `jaxmap demo`: what went in, the maps side by side, the table, one of them in 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from jaxmap.export.voxels import occupied_voxels
from jaxmap.files import atomic_path
from jaxmap.report.html import in_3d
from jaxmap.report.inline import inline_image
from jaxmap.report.page import page
from jaxmap.report.run_contents import read_run
from jaxmap.report.wording import value_text

Row = Mapping[str, object]


def write_demo_page(out: Path, title: str, columns: Mapping[str, str], rows: Sequence[Row]) -> Path:
    """Writes `OUT/report.html` from the run folders that the rows name, and returns its path.

    Args:
        out: the folder of the demo.
        title: what was mapped.
        columns: heading of each key of the rows that is shown.
        rows: one for each run; `run` is its folder, the last one is shown in 3D with its key frame.

    Raises:
        JaxmapError: a run is missing or broken, or the page cannot be written.
    """
    runs = [str(row["run"]) for row in rows]
    shown = read_run(out / _in_3d_run(runs))
    voxels = occupied_voxels(shown.voxel_map, shown.params, shown.rule)
    body = "".join(
        [
            f'<header><p class="kind">jaxmap demo</p><h1>{escape(title)}</h1></header>',
            f"<section><h2>What went in, and its labels</h2>{key_frame_row(shown.path)}</section>",
            f"<section><h2>The maps from above</h2>{_maps(out, rows)}</section>",
            f"<section><h2>Scores</h2>{_table(columns, rows)}</section>",
            in_3d(shown, voxels),
        ]
    )
    target = out / "report.html"
    with atomic_path(target) as temporary:
        temporary.write_text(page(title, body, drawn=len(voxels.label) > 0), encoding="utf-8")
    return target


def _in_3d_run(runs: Sequence[str]) -> str:
    return "plane" if "plane" in runs else runs[-1]


def key_frame_row(run: Path) -> str:
    """The pictures of a run's first key frame, side by side."""
    captions = {"left": "Left image", "disparity": "Disparity, near red to far blue", "labels": "Labels"}
    figures = ""
    for kind, caption in captions.items():
        for path in sorted((run / "pictures").glob(f"*_{kind}.png"))[:1]:
            figures += f"<figure>{inline_image(path, caption, width_px=720)}<figcaption>{caption}</figcaption></figure>"
    return f'<div class="row">{figures}</div>'


def _maps(out: Path, rows: Sequence[Row]) -> str:
    figures = ""
    for row in rows:
        name, caption = str(row["run"]), f"{row['labeller']}, {row['preset']}"
        image = inline_image(out / name / "bev.png", f"Map from above: {caption}", width_px=720)
        link = f'<a href="{escape(name)}/report.html">{escape(caption)}</a>'
        figures += f'<figure><div class="paper">{image}</div><figcaption>{link}</figcaption></figure>'
    return f'<div class="row">{figures}</div>'


def _table(columns: Mapping[str, str], rows: Sequence[Row]) -> str:
    head = "".join(f'<th scope="col"{_alignment(rows[0][key])}>{escape(name)}</th>' for key, name in columns.items())
    body = "".join(
        "<tr>" + "".join(f"<td{_alignment(row[key])}>{value_text(row[key])}</td>" for key in columns) + "</tr>"
        for row in rows
    )
    return (
        '<div class="tables"><figure class="wide"><table class="barred">'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></figure></div>"
    )


def _alignment(value: object) -> str:
    return ' class="text"' if isinstance(value, str) else ""
