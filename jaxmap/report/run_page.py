"""The report of a run: one page that needs no other file and no network."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.export.voxels import OccupiedVoxels, occupied_voxels
from jaxmap.host.files import atomic_path
from jaxmap.report.inline import inline_image, script_text
from jaxmap.report.missed_section import missed_section
from jaxmap.report.page import page
from jaxmap.report.run_contents import PICTURE_KINDS, RunContents, read_run
from jaxmap.report.score_section import score_section
from jaxmap.report.tables import group, metric_tables
from jaxmap.report.voxel_view import voxel_view
from jaxmap.report.wording import value_text

MAX_KEY_FRAMES = 12
PICTURE_WIDTH_PX = 720

_FILES = {
    "map.zarr": "the map, Zarr",
    "map.ply": "occupied voxels, point cloud",
    "bev.tif": "view from above, GeoTIFF",
    "bev.png": "view from above, picture",
    "missed.png": "where the map may have missed something, picture",
    "poses.tum": "poses of the left camera",
    "metrics.json": "all numbers of this page",
    "config.yaml": "the configuration",
    "scores.json": "scores against ground truth",
    "errors.png": "where map and ground truth differ, picture",
}
_KIND_CAPTIONS = {"left": "Left image", "disparity": "Disparity, near red to far blue", "labels": "Labels"}


def write_report(run: Path) -> Path:
    """Writes `RUN/report.html` from what else is in the folder, and returns its path.

    Pictures, the path, the view from above and the configuration are left out where they are missing.

    Raises:
        JaxmapError: the map or the metrics are missing or broken, or the disk is full or refuses.
    """
    folder = read_run(Path(run))
    voxels = occupied_voxels(folder.voxel_map, folder.params, folder.rule)
    remarks = list(folder.remarks)
    sections = [
        _header(folder, voxels),
        _from_above(folder, remarks),
        missed_section(folder, remarks),
        score_section(folder.path, remarks),
        in_3d(folder, voxels),
        _key_frames(folder, remarks),
        f"<section><h2>Figures</h2>{metric_tables(folder.metrics, folder.voxel_map.classes)}</section>",
        _skipped(folder.metrics),
        _notes(folder.metrics, remarks),
        _configuration(folder),
        _links(folder),
    ]
    content = page(_name(folder), "".join(sections), drawn=len(voxels.label) > 0)
    target = folder.path / "report.html"
    with atomic_path(target) as temporary:
        temporary.write_text(content, encoding="utf-8")
    return target


def _name(folder: RunContents) -> str:
    return str(group(folder.metrics, "sequence").get("name") or folder.path.resolve().name)


def _header(folder: RunContents, voxels: OccupiedVoxels) -> str:
    metrics, sequence = folder.metrics, group(folder.metrics, "sequence")
    facts = [
        sequence.get("dataset"),
        f"labels: {metrics['labeller']}" if metrics.get("labeller") else None,
        Path(str(model)).name if (model := group(metrics, "model").get("file")) else None,
        sequence.get("crs") or folder.attributes.crs,
    ]
    progress = folder.attributes.progress
    banner = ""
    if progress.get("complete") is False:
        numbers = {key: value for key, value in progress.items() if isinstance(value, int) and key != "complete"}
        told = ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in numbers.items())
        how_far = escape(f" ({told})" if told else "")
        banner = f'<p class="banner">This run was interrupted{how_far}: the map is of its first part.</p>'
    stats = "".join(f"<div><dt>{name}</dt><dd>{text}</dd></div>" for name, text in _stats(folder, voxels))
    line = " · ".join(escape(str(fact)) for fact in facts if fact)
    return (
        f'<header><p class="kind">Semantic voxel map</p><h1>{escape(_name(folder))}</h1><p>{line}</p>{banner}'
        f'<dl class="stats">{stats}</dl></header>'
    )


def _stats(folder: RunContents, voxels: OccupiedVoxels) -> list[tuple[str, str]]:
    sequence, times = group(folder.metrics, "sequence"), group(folder.metrics, "times")
    skipped = sequence.get("skipped")
    cell_m2 = float(np.prod(voxels.voxel_size_m[:2].astype(np.float64)))
    area_m2 = len(np.unique(voxels.index[:, :2], axis=0)) * cell_m2
    peak_mib = group(folder.metrics, "memory").get("peak_resident_mib")
    length_m, rate = sequence.get("path_length_m"), times.get("frames_per_s")
    stats: list[tuple[str, Any]] = [
        ("frames fused", value_text(int(folder.voxel_map.frames_fused))),
        ("frames skipped", value_text(len(skipped)) if isinstance(skipped, list) else None),
        ("path", value_text(round(float(length_m), 1), "m") if isinstance(length_m, int | float) else None),
        ("area observed", value_text(round(area_m2) if area_m2 >= 100 else area_m2, "m²")),
        ("occupied voxels", value_text(len(voxels.label))),
        ("frames/s", value_text(float(rate)) if isinstance(rate, int | float) else None),
        ("peak memory", _memory(peak_mib) if isinstance(peak_mib, int | float) else None),
    ]
    return [(name, text) for name, text in stats if text is not None]


def _memory(mib: float) -> str:
    return value_text(round(mib / 1024, 2), "GiB") if mib >= 1024 else value_text(round(mib), "MiB")


def _from_above(folder: RunContents, remarks: list[str]) -> str:
    path = folder.path / "bev.png"
    if not path.is_file():
        return ""
    try:
        image = inline_image(path, f"Map of {_name(folder)} seen from above")
    except JaxmapError:
        remarks.append(f"{path.name} could not be read: the view from above is left out.")
        return ""
    return f'<section><h2>From above</h2><div class="paper">{image}</div></section>'


def in_3d(folder: RunContents, voxels: OccupiedVoxels) -> str:
    """The section with the interactive view; a page holds one at most."""
    if not len(voxels.label):
        return "<section><h2>In 3D</h2><p>No voxel is occupied.</p></section>"
    view = voxel_view(voxels, folder.voxel_map.classes, folder.trajectory_world)
    return (
        '<section><h2>In 3D</h2><div id="view3d" class="view3d" role="figure" '
        f'aria-label="Occupied voxels of {escape(_name(folder))} in 3D, to turn by dragging"></div>'
        f"<p>{escape(view.caption)} Drag to turn, scroll to come closer.</p>"
        f'<script type="application/json" id="view3d-data">{script_text(str(view.figure.to_json()))}</script></section>'
    )


def _key_frames(folder: RunContents, remarks: list[str]) -> str:
    frames = list(folder.pictures)
    if len(frames) > MAX_KEY_FRAMES:
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, MAX_KEY_FRAMES).round().astype(int)]
    rows = []
    for frame in frames:
        figures = []
        for kind in PICTURE_KINDS:
            if path := folder.pictures[frame].get(kind):
                try:
                    image = inline_image(path, f"{_KIND_CAPTIONS[kind]}, frame {frame}", width_px=PICTURE_WIDTH_PX)
                except JaxmapError:
                    remarks.append(f"pictures/{path.name} could not be read and is left out.")
                    continue
                figures.append(f"<figure>{image}<figcaption>{_KIND_CAPTIONS[kind]}</figcaption></figure>")
        if figures:
            rows.append(
                f'<div class="frame"><h3>Frame {escape(frame)}</h3><div class="row">{"".join(figures)}</div></div>'
            )
    if not rows:
        return ""
    told = f"<p>{len(rows)} of {len(folder.pictures)} key frames.</p>" if len(rows) < len(folder.pictures) else ""
    return f'<section><h2>Key frames</h2><div class="frames">{"".join(rows)}</div>{told}</section>'


def _skipped(metrics: dict[str, Any]) -> str:
    skipped = group(metrics, "sequence").get("skipped")
    if not isinstance(skipped, list) or not skipped:
        return ""
    rows = "".join(
        f'<tr><th scope="row">{value_text(entry.get("frame"))}</th><td>{value_text(entry.get("reason"))}</td></tr>'
        for entry in skipped
        if isinstance(entry, dict)
    )
    return f'<section><h2>Skipped frames</h2><div class="list"><table><tbody>{rows}</tbody></table></div></section>'


def _notes(metrics: dict[str, Any], remarks: list[str]) -> str:
    notes = group(metrics, "sequence").get("notes")
    told = [*(notes if isinstance(notes, list) else []), *remarks]
    items = "".join(f"<li>{escape(str(note))}</li>" for note in told)
    return f"<section><h2>Notes</h2><ul>{items}</ul></section>" if items else ""


def _configuration(folder: RunContents) -> str:
    if not folder.config_text:
        return ""
    return (
        "<section><h2>Configuration</h2><details><summary>All settings, as resolved</summary>"
        f"<pre>{escape(folder.config_text)}</pre></details></section>"
    )


def _links(folder: RunContents) -> str:
    items = "".join(
        f'<li><a href="{quote(name)}">{name}</a><span>{told}</span></li>'
        for name, told in _FILES.items()
        if (folder.path / name).exists()
    )
    version = folder.metrics.get("jaxmap_version")
    made = f"Made by jaxmap {escape(str(version))}." if version else "Made by jaxmap."
    return f'<section><h2>Files</h2><ul class="files">{items}</ul></section><footer>{made}</footer>'
