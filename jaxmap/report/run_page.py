"""The report of a run: one page from what lies in its folder."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Float

from jaxmap.datasets.poses import read_poses
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.export.voxels import OccupiedVoxels, occupied_voxels
from jaxmap.fusion.params import FusionParams, FusionRule, stored_fusion
from jaxmap.host.bounded_text import YAML_BOUNDS, read_json, read_text
from jaxmap.host.pictures import open_picture
from jaxmap.labels import class_colours
from jaxmap.mapping.store import MapAttributes, load_map
from jaxmap.report.image_colours import SeenFrame, image_colours
from jaxmap.report.page import (
    figure,
    header,
    inline_image,
    notes_section,
    paper,
    script_text,
    section,
    table,
    write_page,
)
from jaxmap.report.voxel_view import voxel_view
from jaxmap.report.wording import (
    MISSED_COLUMNS,
    SCORE_COLUMNS,
    name_and_unit,
    number_text,
    share_text,
    value_text,
)
from jaxmap.types import VoxelMap

MAX_KEY_FRAMES = 12
PICTURE_WIDTH_PX = 720

_CAPTIONS = {"left": "Left image", "disparity": "Disparity, near red to far blue", "labels": "Labels"}
_PICTURE_NAME = re.compile(rf"(?P<frame>.+)_(?P<kind>{'|'.join(_CAPTIONS)})\.png")
_FILES = {
    "map.zarr": "the map, Zarr",
    "map.ply": "occupied voxels, point cloud",
    "bev.tif": "top-down map, GeoTIFF",
    "bev.png": "top-down map, picture",
    "missed.png": "where the map may have missed something, picture",
    "poses.tum": "poses of the left camera",
    "metrics.json": "all numbers of this page",
    "config.yaml": "the configuration",
    "scores.json": "scores against ground truth",
    "errors.png": "where map and ground truth differ, picture",
}
_GROUPS = ("camera", "grid", "times", "points", "voxels", "ensemble", "memory", "sequence")
_ELSEWHERE = {"skipped", "notes", "stages", "by_class", "key_frames"}


@dataclass(frozen=True)
class RunContents:
    """What a run left in its folder.

    Attributes:
        path: the folder.
        voxel_map: the map, with its attributes.
        params: of fusion, by which the map is read.
        rule: of fusion, likewise.
        voxels: the occupied ones.
        metrics: the content of `metrics.json`.
        trajectory_world: positions of the left camera in the map's world, None without `poses.tum`.
        pictures: paths by kind (left, disparity, labels), by the number of their key frame.
        remarks: what could not be read.
    """

    path: Path
    voxel_map: VoxelMap
    attributes: MapAttributes
    params: FusionParams
    rule: FusionRule
    voxels: OccupiedVoxels
    metrics: dict[str, Any]
    trajectory_world: Float[np.ndarray, "N 3"] | None
    pictures: dict[str, dict[str, Path]]
    remarks: list[str]

    @property
    def name(self) -> str:
        """That of the sequence, or else of the folder."""
        return str(self.group("sequence").get("name") or self.path.resolve().name)

    def group(self, key: str) -> dict[str, Any]:
        """A group of metrics; empty where it is absent or no group."""
        value = self.metrics.get(key)
        return value if isinstance(value, dict) else {}


def read_run(run: Path) -> RunContents:
    """Reads a run folder.

    Raises:
        JaxmapError: the map or the metrics are missing or broken.
    """
    run = Path(run)
    if not run.is_dir():
        raise JaxmapError("no such run folder", where=run, fix="give a folder that `jaxmap map` wrote")
    voxel_map, attributes = load_map(run / "map.zarr")
    params, rule = stored_fusion(attributes.fusion, voxel_map.classes, run / "map.zarr")
    path, fix = run / "metrics.json", "finish the run (jaxmap map ... --resume), or bring the file back"
    try:
        metrics = read_json(path)
    except JaxmapError as error:
        raise JaxmapError(error.what, where=error.where, fix=fix) from error
    if not isinstance(metrics, dict):
        raise JaxmapError("not a JSON object", where=path, fix=fix)
    trajectory_world, remarks = None, []
    if (run / "poses.tum").is_file():
        try:
            trajectory_world = read_poses(run / "poses.tum").T[:, :3, 3] - attributes.site_origin
        except JaxmapError:
            remarks.append("poses.tum could not be read: the path is left out.")
    pictures = find_pictures(run)
    voxels = occupied_voxels(voxel_map, params, rule)
    return RunContents(run, voxel_map, attributes, params, rule, voxels, metrics, trajectory_world, pictures, remarks)


def write_report(run: Path) -> Path:
    """Writes `RUN/report.html` from what else is in the folder, and returns its path.

    Pictures, the path, the top-down map and the configuration are left out where they are missing.

    Raises:
        JaxmapError: the map or the metrics are missing or broken, or the disk is full or refuses.
    """
    contents = read_run(Path(run))
    path, metrics, remarks = contents.path, contents.metrics, contents.remarks
    skipped, notes = (contents.group("sequence").get(key) for key in ("skipped", "notes"))
    rows = [
        (value_text(entry.get("frame")), value_text(entry.get("reason")))
        for entry in (skipped if isinstance(skipped, list) else ())
        if isinstance(entry, dict)
    ]
    config, version = path / "config.yaml", metrics.get("jaxmap_version")
    text = _settings(config, remarks)
    settings = f"<details><summary>All settings, as resolved</summary><pre>{text}</pre></details>" if text else ""
    links = "".join(
        f'<li><a href="{quote(name)}">{name}</a><span>{text}</span></li>'
        for name, text in _FILES.items()
        if (path / name).exists()
    )
    body = [
        _header(contents),
        section("Top-down map", paper(path / "bev.png", f"Top-down map of {contents.name}", remarks)),
        missed_section(path, metrics, remarks),
        _score_section(path, remarks),
        in_3d(contents),
        section("Key frames", _key_frames(contents)),
        section("Metrics", _metric_tables(contents)),
        section("Skipped frames", f'<div class="list">{table((), rows, "plain")}</div>' if rows else ""),
        notes_section([*(notes if isinstance(notes, list) else []), *remarks]),
        section("Configuration", settings),
        section("Files", f'<ul class="files">{links}</ul>'),
        f"<footer>Made by jaxmap{f' {escape(str(version))}' if version else ''}.</footer>",
    ]
    return write_page(path / "report.html", contents.name, "".join(body), drawn=len(contents.voxels.label) > 0)


def _settings(config: Path, remarks: list[str]) -> str:
    """The configuration as it was resolved; left out, with a remark, where it cannot be read."""
    if not config.exists():
        return ""
    try:
        return escape(read_text(config, YAML_BOUNDS.text_bytes))
    except JaxmapError:
        remarks.append(f"{config.name} could not be read and is left out.")
        return ""


def _header(contents: RunContents) -> str:
    metrics, sequence, voxels = contents.metrics, contents.group("sequence"), contents.voxels
    facts = [
        sequence.get("dataset"),
        f"labels: {metrics['labeller']}" if metrics.get("labeller") else None,
        Path(str(model)).name if (model := contents.group("model").get("file")) else None,
        sequence.get("crs") or contents.attributes.crs,
    ]
    banner, progress = "", contents.attributes.progress
    if progress.get("complete") is False:
        numbers = {key: value for key, value in progress.items() if isinstance(value, int) and key != "complete"}
        done = ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in numbers.items())
        banner = f"This run was interrupted{f' ({done})' if done else ''}: the map is of its first part."
    area_m2 = len(np.unique(voxels.index[:, :2], axis=0)) * float(np.prod(voxels.voxel_size_m[:2].astype(np.float64)))
    peak_mib, skipped = contents.group("memory").get("peak_resident_mib"), sequence.get("skipped")
    length_m, rate = sequence.get("path_length_m"), contents.group("times").get("frames_per_s")
    stats: list[tuple[str, str | None]] = [
        ("frames fused", value_text(int(contents.voxel_map.frames_fused))),
        ("frames skipped", value_text(len(skipped)) if isinstance(skipped, list) else None),
        ("path", value_text(round(float(length_m), 1), "m") if isinstance(length_m, int | float) else None),
        ("area observed", value_text(round(area_m2) if area_m2 >= 100 else area_m2, "m²")),
        ("occupied voxels", value_text(len(voxels.label))),
        ("frames/s", value_text(float(rate)) if isinstance(rate, int | float) else None),
    ]
    if isinstance(peak_mib, int | float):
        large = peak_mib >= 1024
        stats.append(
            ("peak memory", value_text(*((round(peak_mib / 1024, 2), "GiB") if large else (round(peak_mib), "MiB"))))
        )
    return header("Semantic voxel map", contents.name, " · ".join(str(fact) for fact in facts if fact), stats, banner)


def missed_section(path: Path, metrics: dict[str, Any], remarks: list[str]) -> str:
    """Where the map may have missed its class: the picture and what is expected; empty without an ensemble.

    A picture that cannot be read is left out with a remark.
    """
    ensemble = metrics.get("ensemble")
    if not isinstance(ensemble, dict) or not ensemble:
        return ""
    target = escape(str(ensemble.get("class")))
    image = paper(path / "missed.png", f"Probability that the map missed {target}", remarks)
    area = {key: value_text(ensemble.get(f"{key}_area_m2"), "m²") for key in ("observed", "missed", "called")}
    area["missed"] = value_text(ensemble.get("missed_area_expected_m2"), "m²")
    text = (
        f"The probability that a place which the map does not call {target} is {target}, by an ensemble of "
        f"{value_text(ensemble.get('members'))} maps, each with errors of its own in poses, disparities and the "
        f"sensor model. Over all {area['observed']} observed, {area['missed']} of {target} are expected to be missed, "
        f"beside {area['called']} called so."
    )
    return section("What may be missed", f"<p>{text}</p>{image}" if image else "")


def _score_section(run: Path, remarks: list[str]) -> str:
    """Scores and error map that `jaxmap evaluate` left in a run folder."""
    if not (run / "scores.json").is_file():
        return ""
    try:
        text = _scores(read_json(run / "scores.json"))
    except (JaxmapError, ValueError, KeyError, TypeError, AttributeError):
        remarks.append("scores.json could not be read: the scores are left out.")
        return ""
    image = paper(run / "errors.png", "Rock that was found, falsely called and missed", remarks)
    return section("Against ground truth", text + image)


def _scores(scores: dict[str, Any]) -> str:
    def listed(title: str, columns: Iterable[tuple[str, str]], rows: Iterable[tuple[str, dict[str, Any]]]) -> str:
        keys, headings = zip(*columns, strict=True)
        cells = [(escape(name), *(value_text(values.get(key)) for key in keys)) for name, values in rows]
        return f'<div class="tables"><figure>{table((title, *headings), cells)}</figure></div>'

    rocks = scores.get("rocks") or {}
    facts = {"cells": scores.get("cells"), "frames": scores.get("frames")}
    facts |= {"rocks in view": rocks.get("count"), "of them missed": rocks.get("missed")}
    size, reach = scores.get("cell_size_m"), scores.get("max_range_m")
    within = f", within {value_text(reach, 'm')}" if reach is not None else ""
    counted = ", ".join(f"{value_text(value)} {name}" for name, value in facts.items() if value is not None)
    rows = [("observed cells", scores), ("all cells in view", scores["in_view"])]
    if "registration" in scores:
        rows.append(("observed, before registration", scores["registration"]["before"]))
    html = (
        f"<p>Scored for {escape(str(scores.get('class')))} in cells of {value_text(size, 'm')}{within}: {counted}.</p>"
        + listed("Counted", SCORE_COLUMNS.items(), rows)
    )
    if "ensemble" in scores:
        ensemble = scores["ensemble"]
        bins = [(f"{number_text(row['from'])} to {number_text(row['to'])}", row) for row in ensemble["reliability"]]
        html += (
            f"<p>Of {value_text(ensemble['cells'])} cells that the map does not call so, "
            f"{value_text(ensemble['missed_cells'])} are; the ensemble expected "
            f"{value_text(float(ensemble['expected_missed_cells']))}.</p>"
        )
        ranked = [("the ensemble", ensemble), ("the map alone", ensemble["map_alone"])]
        html += listed("Missed cells, by", MISSED_COLUMNS.items(), ranked)
        columns = {"cells": "cells", "said": "mean", "true": "truly missed"}
        html += listed("Probability of a miss", columns.items(), bins)
    return html


def in_3d(contents: RunContents) -> str:
    """The section with the interactive view; a page holds one at most."""
    if not len(contents.voxels.label):
        return section("In 3D", "<p>No voxel is occupied.</p>")
    seen = [*seen_frames(contents.pictures, contents.group("camera")).values()]
    view = voxel_view(
        contents.voxels,
        contents.voxel_map.classes,
        contents.trajectory_world,
        (lambda points_world: image_colours(points_world, seen)) if seen else None,
    )
    return section(
        "In 3D",
        '<div id="view3d" class="view3d" role="figure" '
        f'aria-label="Occupied voxels of {escape(contents.name)} in 3D, to turn by dragging"></div>'
        f"<p>{escape(view.caption)} Drag to turn, scroll to zoom.</p>"
        f'<script type="application/json" id="view3d-data">{script_text(str(view.figure.to_json()))}</script>',
    )


def seen_frames(pictures: Mapping[str, Mapping[str, Path]], camera: Mapping[str, Any]) -> dict[str, SeenFrame]:
    """The key frames with their cameras, by name; those that are not whole are left out.

    Args:
        pictures: of `find_pictures`.
        camera: that of `metrics.json`.
    """
    frames, poses = {}, camera.get("key_frames")
    for name, pose in poses.items() if isinstance(poses, dict) else ():
        try:
            with open_picture(pictures[name]["left"]) as image:
                pixels = np.asarray(image)
            frames[name] = SeenFrame(
                pixels,
                np.array(pose, np.float64).reshape(4, 4),
                (camera["fx_px"], camera["fy_px"]),
                (camera["cx_px"], camera["cy_px"]),
            )
        except (FrameError, KeyError, ValueError, TypeError):
            continue
    return frames


def find_pictures(run: Path) -> dict[str, dict[str, Path]]:
    """The pictures of key frames by kind (left, disparity, labels), by the number of the frame."""
    pictures: dict[str, dict[str, Path]] = {}
    for picture in sorted((run / "pictures").glob("*.png")):
        if match := _PICTURE_NAME.fullmatch(picture.name):
            pictures.setdefault(match["frame"], {})[match["kind"]] = picture
    return pictures


def key_frame_row(contents: RunContents, frame: str) -> str:
    """The pictures of a key frame side by side; those that cannot be read are left out with a remark."""
    figures = ""
    for kind, caption in _CAPTIONS.items():
        if path := contents.pictures[frame].get(kind):
            try:
                figures += figure(inline_image(path, f"{caption}, frame {frame}", width_px=PICTURE_WIDTH_PX), caption)
            except JaxmapError:
                contents.remarks.append(f"pictures/{path.name} could not be read and is left out.")
    return f'<div class="row">{figures}</div>' if figures else ""


def _key_frames(contents: RunContents) -> str:
    frames = list(contents.pictures)
    if len(frames) > MAX_KEY_FRAMES:
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, MAX_KEY_FRAMES).round().astype(int)]
    rows = {frame: row for frame in frames if (row := key_frame_row(contents, frame))}
    if not rows:
        return ""
    shown = "".join(f'<div class="frame"><h3>Frame {escape(frame)}</h3>{row}</div>' for frame, row in rows.items())
    more = f"<p>{len(rows)} of {len(contents.pictures)} key frames.</p>" if len(rows) < len(contents.pictures) else ""
    return f'<div class="frames">{shown}</div>{more}'


def _metric_tables(contents: RunContents) -> str:
    """All metrics, one table for each group; keys that are not known here are shown all the same."""
    metrics, wide = contents.metrics, ""
    stages, by_class = contents.group("times").get("stages"), contents.group("voxels").get("by_class")
    if isinstance(stages, dict):
        known = {name: stage for name, stage in stages.items() if isinstance(stage, dict)}
        most = max((_number(stage.get("total_s")) for stage in known.values()), default=0.0) or 1.0
        rows = [
            (
                escape(str(name).replace("_", " ")),
                *(_number_text(stage.get(key)) for key in ("median_ms", "p95_ms", "total_s")),
                _bar(_number(stage.get("total_s")) / most),
            )
            for name, stage in known.items()
        ]
        if rows:
            wide += figure(table(("Stage", "median, ms", "95 %, ms", "total, s", ""), rows), "Stages")
    if isinstance(by_class, dict) and by_class:
        wide += _class_table(by_class, contents.voxel_map.classes)
    groups = {key: metrics[key] for key in dict.fromkeys((*_GROUPS, *metrics)) if isinstance(metrics.get(key), dict)}
    groups["other"] = {key: value for key, value in metrics.items() if key not in (*_GROUPS, *groups)}
    cards = ""
    for name, values in groups.items():
        rows = [row for key, value in values.items() if key not in _ELSEWHERE for row in _metric_rows(key, value)]
        cards += figure(table((), rows, "plain"), name_and_unit(name)[0]) if rows else ""
    return f'<div class="tables">{wide}<div class="cards">{cards}</div></div>'


def _class_table(by_class: dict[str, Any], classes: Sequence[str]) -> str:
    colours = dict(zip(classes, class_colours(classes).tolist(), strict=False))
    total = sum(map(_number, by_class.values())) or 1.0
    rows = []
    for name, count in by_class.items():
        share, colour = _number(count) / total, f"rgb{tuple(colours.get(name, class_colours(())[0].tolist()))}"
        swatch = f'<i class="swatch" style="background:{colour}"></i>'
        rows.append((swatch + escape(str(name)), value_text(count), share_text(share), _bar(share, colour)))
    return figure(table(("Class", "voxels", "share", ""), rows), "Occupied voxels by class")


def _metric_rows(key: str, value: object, prefix: str = "") -> list[tuple[str, str]]:
    if isinstance(value, dict):
        return [row for inner, item in value.items() for row in _metric_rows(inner, item, f"{prefix}{key} ")]
    name, unit = name_and_unit(f"{prefix}{key}")
    if isinstance(value, float) and key.endswith("fraction"):
        return [(name, share_text(value))]
    return [(name, value_text(value, unit, key))]


def _bar(share: float, colour: str = "var(--bar)") -> str:
    return f'<td class="bar"><i style="width:{100 * share:.1f}%;background:{colour}"></i></td>'


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def _number_text(value: object) -> str:
    return number_text(float(value)) if isinstance(value, int | float) else "–"
