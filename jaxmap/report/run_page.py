"""The report of a run: one page from what lies in its folder."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import YAML_BOUNDS, read_text
from jaxmap.labels import class_colours
from jaxmap.report.detail import FOLDER
from jaxmap.report.drive_view import drive_section
from jaxmap.report.page import figure, header, notes_section, paper, section, table, write_page
from jaxmap.report.run_contents import RunContents, read_run
from jaxmap.report.score_tables import map_score_section, pose_score_section
from jaxmap.report.wording import name_and_unit, number_text, share_text, value_text

_FILES = {
    "map.zarr": "the map, Zarr",
    "map.ply": "occupied voxels, point cloud",
    "bev.tif": "top-down map, GeoTIFF",
    "bev.png": "top-down map, picture",
    "missed.png": "where the map may have missed something, picture",
    "poses.tum": "poses of the left camera",
    "frames.csv": "what became of each frame",
    "metrics.json": "all numbers of this page",
    "config.yaml": "the configuration",
    "scores.json": "scores against ground truth",
    "pose_scores.json": "errors of the poses",
    "errors.png": "where map and ground truth differ, picture",
}
_GROUPS = ("camera", "grid", "times", "points", "voxels", "ensemble", "memory", "sequence")
_ELSEWHERE = {"skipped", "notes", "stages", "by_class", "key_frames"}


def write_report(run: Path) -> Path:
    """Writes `RUN/report.html` from what else is in the folder, and returns its path.

    Pictures, the path, the top-down map and the configuration are left out where they are missing.

    Raises:
        JaxmapError: the map or the metrics are missing or broken, or the disk is full or refuses.
    """
    contents = read_run(Path(run))
    path, metrics, remarks = contents.path, contents.metrics, contents.remarks
    page = path / "report.html"
    shutil.rmtree(path / FOLDER, ignore_errors=True)
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
        drive_section(contents, page),
        section("Top-down map", paper(path / "bev.png", f"Top-down map of {contents.name}", remarks)),
        missed_section(path, metrics, remarks),
        map_score_section(path, remarks),
        pose_score_section(path, remarks),
        section("Metrics", _metric_tables(contents)),
        section("Skipped frames", f'<div class="list">{table((), rows, "plain")}</div>' if rows else ""),
        notes_section([*(notes if isinstance(notes, list) else []), *remarks]),
        section("Configuration", settings),
        section("Files", f'<ul class="files">{links}</ul>'),
        f"<footer>Made by jaxmap{f' {escape(str(version))}' if version else ''}.</footer>",
    ]
    beside = (path / FOLDER).is_dir()
    return write_page(page, contents.name, "".join(body), drawn=contents.occupied > 0, beside=beside)


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
    metrics, sequence = contents.metrics, contents.group("sequence")
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
    area_m2 = contents.area_m2
    peak_mib, skipped = contents.group("memory").get("peak_resident_mib"), sequence.get("skipped")
    length_m, rate = sequence.get("path_length_m"), contents.group("times").get("frames_per_s")
    stats: list[tuple[str, str | None]] = [
        ("frames fused", value_text(contents.reader.frames_fused)),
        ("frames skipped", value_text(len(skipped)) if isinstance(skipped, list) else None),
        ("path", value_text(round(float(length_m), 1), "m") if isinstance(length_m, int | float) else None),
        ("area observed", value_text(round(area_m2) if area_m2 >= 100 else area_m2, "m²")),
        ("occupied voxels", value_text(contents.occupied)),
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
        wide += _class_table(by_class, contents.classes)
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
