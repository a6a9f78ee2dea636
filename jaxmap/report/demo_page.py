"""The page of `jaxmap demo`: input, scores, truth, maps and errors, and the last map in 3D."""

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
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE, ROVER_CLASSES
from jaxmap.report.page import figure, header, inline_image, section, table, write_page
from jaxmap.report.pictures import overlay_labels
from jaxmap.report.run_page import in_3d, key_frame_row, read_run
from jaxmap.report.wording import value_text

_WIDTH_PX = 1000

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
    lead = (
        f"{int(shown.voxel_map.frames_fused)} stereo frames of a simulated beach become a 3D semantic voxel map, with "
        "two labellers (a fitted plane and a network) under two presets (the paper's and jaxmap's). Each top-down map "
        "is scored against the labelled orthomosaic."
    )
    text = [key for key in columns if isinstance(rows[0][key], str)]
    heading = " / ".join(columns[key] for key in text)
    numbers = [key for key in columns if key not in text]
    cells = [(_name(row), *(_score_text(row[key]) for key in numbers)) for row in rows]
    scores = table((heading, *(escape(columns[key]) for key in numbers)), cells)
    bodies = [
        header("jaxmap demo", title, lead),
        section(
            "Input, disparity and labels", key_frame_row(shown, next(iter(shown.pictures))) if shown.pictures else ""
        ),
        section("Scores", f'<div class="tables"><figure>{scores}</figure></div>'),
        section("Ground truth", _truth(out, shown.path, truth)),
        section(
            "Top-down maps and their errors",
            f'<div class="frames">{"".join(_map_and_errors(out, row) for row in reversed(rows))}</div>',
        ),
        in_3d(shown),
    ]
    return write_page(out / "report.html", title, "".join(bodies), drawn=len(shown.voxels.label) > 0)


def _name(row: Row) -> str:
    name = escape(f"{row['labeller']}, {row['preset']}")
    return f'<a href="{escape(str(row["run"]))}/report.html">{name}</a>'


def _score_text(value: object) -> str:
    if not isinstance(value, float):
        return value_text(value)
    return f"{value:.3f}" if value < 10 else value_text(round(value))


def _truth(out: Path, run: Path, truth: Path) -> str:
    """The orthomosaic where the map lies, without and with its labels, as files of their own and in the page."""
    with rasterio.open(run / "bev.tif") as raster:
        bounds = raster.bounds
    image = np.moveaxis(_cut(truth / "orthomosaic.tif", bounds), 0, -1)
    codes = _cut(truth / "orthomosaic_labels.tif", bounds)[0]
    labels = np.where(codes == 0, IGNORE, codes).astype(np.uint8)
    pictures = {
        "orthomosaic": ("Orthomosaic, at another time of day", image),
        "truth": ("Ground truth", overlay_labels(image, labels, ROVER_CLASSES)),
    }
    figures = ""
    for name, (caption, picture) in pictures.items():
        with atomic_path(out / f"{name}.png") as temporary:
            Image.fromarray(picture).save(temporary)
        figures += figure(inline_image(out / f"{name}.png", caption, width_px=_WIDTH_PX), caption)
    return f'<div class="row">{figures}</div>'


def _cut(path: Path, bounds: BoundingBox) -> np.ndarray:
    """The part of a raster that lies within bounds of its system: (bands, H, W)."""
    try:
        with rasterio.open(path) as file:
            whole = from_bounds(*file.bounds, transform=file.transform)
            part = from_bounds(*bounds, transform=file.transform).round_offsets().round_lengths()
            return file.read(window=part.intersection(whole.round_offsets().round_lengths()))
    except RasterioError as error:
        raise JaxmapError("not a readable raster", where=path, fix="reinstall jaxmap") from error


def _map_and_errors(out: Path, row: Row) -> str:
    name = f"{row['labeller']}, {row['preset']}"
    images = (
        inline_image(out / str(row["run"]) / file, f"{kind}: {name}", width_px=_WIDTH_PX)
        for file, kind in (("bev.png", "Top-down map"), ("errors.png", "Errors"))
    )
    figures = "".join(f'<figure><div class="paper">{image}</div></figure>' for image in images)
    return (
        f'<div class="frame"><h3>{_name(row)}: IoU {_score_text(row["iou"])}</h3><div class="row">{figures}</div></div>'
    )
