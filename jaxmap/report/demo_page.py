"""The page of `jaxmap demo`: what went in, the table, truth, maps and errors side by side, one map in 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np
import rasterio
from PIL import Image
from rasterio.coords import BoundingBox
from rasterio.errors import RasterioError
from rasterio.windows import from_bounds

from jaxmap.errors import JaxmapError
from jaxmap.export.voxels import occupied_voxels
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE, ROVER_CLASSES
from jaxmap.report.inline import inline_image
from jaxmap.report.page import page
from jaxmap.report.pictures import overlay_labels
from jaxmap.report.run_contents import read_run
from jaxmap.report.run_page import in_3d
from jaxmap.report.wording import value_text

Row = Mapping[str, object]


def write_demo_page(out: Path, title: str, columns: Mapping[str, str], rows: Sequence[Row], truth: Path) -> Path:
    """Writes `OUT/report.html` from the run folders that the rows name, and returns its path.

    Args:
        out: the folder of the demo.
        title: what was mapped.
        columns: heading of each key of the rows that is shown.
        rows: one for each run; `run` is its folder, the last one is shown in 3D with its key frame.
        truth: folder of orthomosaic.tif and orthomosaic_labels.tif.

    Raises:
        JaxmapError: a run is missing or broken, or the page cannot be written.
    """
    shown = read_run(out / str(rows[-1]["run"]))
    voxels = occupied_voxels(shown.voxel_map, shown.params, shown.rule)
    body = "".join(
        [
            f'<header><p class="kind">jaxmap demo</p><h1>{escape(title)}</h1></header>',
            f"<section><h2>What went in, and its labels</h2>{key_frame_row(shown.path)}</section>",
            f"<section><h2>Scores</h2>{_table(columns, rows)}</section>",
            f"<section><h2>The truth from above</h2>{_truth(out, shown.path, truth)}</section>",
            f"<section><h2>The maps from above</h2>{_pictures(out, rows, 'bev.png', 'Map from above')}</section>",
            f"<section><h2>Where they err</h2>{_pictures(out, rows, 'errors.png', 'Errors')}</section>",
            in_3d(shown, voxels),
        ]
    )
    target = out / "report.html"
    with atomic_path(target) as temporary:
        temporary.write_text(page(title, body, drawn=len(voxels.label) > 0), encoding="utf-8")
    return target


def key_frame_row(run: Path) -> str:
    """The pictures of a run's first key frame, side by side."""
    captions = {"left": "Left image", "disparity": "Disparity, near red to far blue", "labels": "Labels"}
    figures = ""
    for kind, caption in captions.items():
        for path in sorted((run / "pictures").glob(f"*_{kind}.png"))[:1]:
            figures += f"<figure>{inline_image(path, caption, width_px=720)}<figcaption>{caption}</figcaption></figure>"
    return f'<div class="row">{figures}</div>'


def _truth(out: Path, run: Path, truth: Path) -> str:
    """The orthomosaic where the map lies, without and with its labels, as files of their own and in the page."""
    with rasterio.open(run / "bev.tif") as bev:
        bounds = bev.bounds
    window = {name: _cut(truth / name, bounds) for name in ("orthomosaic.tif", "orthomosaic_labels.tif")}
    image, codes = np.moveaxis(window["orthomosaic.tif"], 0, -1), window["orthomosaic_labels.tif"][0]
    labels = np.where(codes == 0, IGNORE, codes).astype(np.uint8)
    pictures = {
        "orthomosaic": ("Orthomosaic, under another sun", image),
        "truth": ("Ground truth", overlay_labels(image, labels, ROVER_CLASSES)),
    }
    figures = ""
    for name, (caption, picture) in pictures.items():
        path = out / f"{name}.png"
        with atomic_path(path) as temporary:
            Image.fromarray(picture).save(temporary)
        figures += f"<figure>{inline_image(path, caption, width_px=720)}<figcaption>{caption}</figcaption></figure>"
    return f'<div class="row">{figures}</div>'


def _cut(path: Path, bounds: BoundingBox) -> np.ndarray:
    """The part of a raster that lies within bounds of its system: (bands, H, W)."""
    try:
        with rasterio.open(path) as file:
            whole = from_bounds(*file.bounds, transform=file.transform)
            part = from_bounds(*bounds, transform=file.transform).round_offsets().round_lengths()
            return file.read(window=part.intersection(whole.round_offsets().round_lengths()))
    except RasterioError as error:
        raise JaxmapError("not a readable raster", where=path, fix="install jaxmap anew") from error


def _pictures(out: Path, rows: Sequence[Row], file: str, kind: str) -> str:
    figures = ""
    for row in rows:
        name, caption = str(row["run"]), f"{row['labeller']}, {row['preset']}"
        image = inline_image(out / name / file, f"{kind}: {caption}", width_px=720)
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
