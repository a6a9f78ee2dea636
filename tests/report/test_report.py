"""The 3D view and the page of a run."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from html_tables import tables_of
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from made_runs import NASTY, SITE, add_cameras, make_run
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.export.voxels import OccupiedVoxels
from jaxmap.labels import IGNORE, ROVER_CLASSES
from jaxmap.mapping.store import MapAttributes, save_map
from jaxmap.report import voxel_view as voxel_view_module
from jaxmap.report.drive_view import MAX_KEY_FRAMES, ground_outline
from jaxmap.report.image_colours import SeenFrame
from jaxmap.report.page import ACCENT, svg_of
from jaxmap.report.run_page import write_report
from jaxmap.report.tuning_page import tuning_page
from jaxmap.report.voxel_view import exposed_faces, merge_voxels, voxel_view
from jaxmap.report.wording import name_and_unit, number_text, value_text
from jaxmap.types import make_grid, make_voxel_map


def voxels_of(index: np.ndarray, label: np.ndarray | None = None, size_m=(0.2, 0.3, 0.1)) -> OccupiedVoxels:
    index = np.asarray(index, np.int32).reshape(-1, 3)
    size = np.array(size_m, np.float32)
    label = np.full(len(index), 1, np.uint8) if label is None else label.astype(np.uint8)
    return OccupiedVoxels(
        index, ((index + 0.5) * size).astype(np.float32), label, np.full(len(index), 0.9, np.float32), size
    )


solids = hnp.arrays(bool, st.tuples(*[st.integers(1, 5)] * 3))


@settings(max_examples=25)
@given(solids)
def test_exposed_faces_close_the_voxels(solid) -> None:
    index = np.argwhere(solid)
    faces = exposed_faces(index)
    padded = np.pad(solid, 1)
    expected = sum(int((padded & ~np.roll(padded, step, axis)).sum()) for axis in range(3) for step in (1, -1))
    assert len(faces.voxel) == expected
    assert len(faces.triangle) == 2 * expected
    assert len(np.unique(faces.corner, axis=0)) == len(faces.corner)
    corners = faces.corner[faces.triangle].astype(float)
    # Outward triangles of a closed surface span its volume, by the divergence theorem.
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(solid.sum())
    middle = corners.mean(axis=1) - (index[np.repeat(faces.voxel, 2)] + 0.5 if len(index) else 0)
    assert (np.abs(middle).max(axis=-1, initial=0) < 0.5 + 1e-9).all()


@settings(max_examples=10)
@given(solids)
def test_undersides_can_be_left_out(solid) -> None:
    index = np.argwhere(solid)
    down = int((np.pad(solid, 1) & ~np.roll(np.pad(solid, 1), 1, 2)).sum())
    assert len(exposed_faces(index).voxel) - len(exposed_faces(index, undersides=False).voxel) == down


@settings(max_examples=25)
@given(solids, st.integers(0, 1000), st.integers(-4, 4))
def test_merged_voxels_carry_the_label_of_most(solid, seed, shift) -> None:
    index = np.argwhere(solid) + 2 * shift
    label = np.random.default_rng(seed).choice([0, 1, 2, IGNORE], len(index)).astype(np.uint8)
    merged, labels = merge_voxels(index, label)
    assert {tuple(i) for i in merged} == {tuple(i) for i in index // 2}
    assert len(merged) == len(np.unique(merged, axis=0))
    for parent, chosen in zip(merged, labels, strict=True):
        counts = np.bincount(label[(index // 2 == parent).all(axis=1)], minlength=256)
        assert chosen == counts.argmax()


def test_view_is_in_metres_with_a_toggle_and_the_path() -> None:
    index = np.argwhere(np.ones((4, 3, 1), bool))
    label = np.where(index[:, 0] < 2, 1, 2)
    path_world = np.array([[0.0, 0, 1], [0.8, 0.9, 1], [np.nan] * 3])
    figure, caption, _ = voxel_view(voxels_of(index, label), ROVER_CLASSES, path_world)
    mesh, line, ends = figure.data
    assert (mesh.x.min(), mesh.x.max()) == (0, np.float32(0.8))
    assert (mesh.z.min(), mesh.z.max()) == (0, np.float32(0.1))
    assert len(mesh.intensity) == len(mesh.i)
    assert list(mesh.colorbar.ticktext) == ["sand", "rock"]
    assert len(line.x) == 2
    assert len(ends.x) == 2
    assert [button.label for button in figure.layout.updatemenus[0].buttons] == ["Classes", "Height"]
    scene = figure.layout.scene
    spans_m = [axis.range[1] - axis.range[0] for axis in (scene.xaxis, scene.yaxis, scene.zaxis)]
    ratio = [scene.aspectratio.x, scene.aspectratio.y, scene.aspectratio.z]
    assert np.ptp(np.array(ratio) / spans_m) < 1e-6
    assert caption == "12 occupied voxels of 0.2 × 0.3 × 0.1 m."
    content = figure.to_json()
    assert "bdata" in content
    assert "NaN" not in content


def test_view_in_the_colours_of_the_images() -> None:
    index = np.argwhere(np.ones((9, 1, 1), bool))
    shades = [(10, 20, 30), (200, 190, 180)]

    def colours_of(points_world):
        return np.where(points_world[:, :1] < 0.8, *np.array(shades, np.uint8)).astype(np.uint8)

    figure, *_ = voxel_view(voxels_of(index), ROVER_CLASSES, colours_of=colours_of)
    buttons = figure.layout.updatemenus[0].buttons
    assert [button.label for button in buttons] == ["Classes", "Height", "Images"]
    (colouring, _) = buttons[2].args
    (scale,), (intensity,) = colouring["colorscale"], colouring["intensity"]
    assert len(intensity) == len(figure.data[0].i) and colouring["showscale"] == [False]
    span = colouring["cmax"][0] - colouring["cmin"][0]
    drawn = {next(colour for stop, colour in scale if np.isclose(stop, value / span)) for value in intensity.tolist()}
    assert drawn == {f"rgb({r},{g},{b})" for r, g, b in shades}


def test_view_is_coarsened_and_says_so(monkeypatch) -> None:
    monkeypatch.setattr(voxel_view_module, "MAX_FACES", 100)
    figure, caption, _ = voxel_view(voxels_of(np.argwhere(np.ones((20, 20, 2), bool))), ROVER_CLASSES)
    assert caption.startswith("800 occupied voxels, drawn as 25 of 0.8 × 1.2 × 0.4 m: 4 × 4 × 4 voxels merged into one")
    assert len(figure.data[0].i) <= 200
    assert (figure.data[0].x.min(), figure.data[0].x.max()) == (0, 4)


def test_view_without_classes_and_without_voxels() -> None:
    figure, *_ = voxel_view(voxels_of([[0, 0, 0]], np.array([IGNORE])), ())
    assert not figure.layout.updatemenus
    figure, caption, _ = voxel_view(voxels_of(np.zeros((0, 3))), ROVER_CLASSES)
    assert not figure.data
    assert caption.startswith("0 occupied voxels")


class Page(HTMLParser):
    """What a page holds: its tags with their attributes, and its text outside scripts."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text, self.scripts, self._in = "", [], ""
        self.feed(content)

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append((tag, dict(attrs)))
        self._in = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, _tag) -> None:
        self._in = ""

    def handle_data(self, data) -> None:
        if self._in == "script":
            self.scripts[-1] += data
        elif self._in != "style":
            self.text += data + "\n"

    def all(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == name]


@pytest.fixture(scope="module")
def made_run(tmp_path_factory) -> Path:
    run = make_run(tmp_path_factory.mktemp("runs") / "run", name=NASTY)
    assert write_report(run) == run / "report.html"
    return run


@pytest.fixture
def run_folder(made_run, tmp_path) -> Path:
    run = tmp_path / "run"
    shutil.copytree(made_run, run)
    (run / "report.html").unlink()
    return run


def page_of(run: Path) -> Page:
    return Page((run / "report.html").read_text(encoding="utf-8"))


def figure_of(page: Page) -> dict:
    """The 3D view, unpacked."""
    return json.loads(gzip.decompress(base64.b64decode(page.scripts[0])))


def test_page_shows_the_run(made_run) -> None:
    page = page_of(made_run)
    text = page.text.replace("\N{NO-BREAK SPACE}", " ").replace("\N{NARROW NO-BREAK SPACE}", " ")
    for expected in (
        *("Top-down map", "The drive", "Frame 000020", "Metrics", "Skipped frames", "Notes", "Configuration"),
        *("folder · labels: deeplab · EPSG:32631", "40", "9.2 m", "4.8", "1.4 GiB", "96 m²", "2 400"),
        *("left_7", "no pose within 0.2 s", "heading from motion", "61.5", "81.2 %", "New number", "1.25 m"),
        *("60 × 40 × 12", "1, 8.5 m", "Made by jaxmap 0.1.0."),
    ):
        assert expected in text, expected
    assert sum(line in ("sand", "rock") for line in text.splitlines()) == 2


def test_page_holds_everything_itself(made_run) -> None:
    content = (made_run / "report.html").read_text(encoding="utf-8")
    page = Page(content)
    images = page.all("img")
    assert len(images) == 7
    assert all(image["src"].startswith("data:image/") and image["alt"] and image["width"] for image in images)
    assert [a["href"] for a in page.all("a")] == [
        "map.zarr",
        "map.ply",
        "bev.png",
        "poses.tum",
        "metrics.json",
        "config.yaml",
    ]
    assert not page.all("link")
    assert not any("src" in script for script in page.all("script"))
    plotly = max(page.scripts, key=len)
    assert not re.findall(r"https?://", content.replace(plotly, ""))
    policy = next(meta["content"] for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'")
    assert str(made_run.parent) not in content


def test_inserted_text_is_escaped(made_run) -> None:
    page = page_of(made_run)
    assert page.text.count(NASTY) >= 3
    assert not any("alert" in script for script in page.scripts)


def test_class_names_cannot_leave_the_script(tmp_path) -> None:
    run = make_run(tmp_path / "run", classes=("sand</script><b>", "rock"))
    write_report(run)
    page = page_of(run)
    figure = figure_of(page)
    assert "sand</script><b>" in figure["data"][0]["colorbar"]["ticktext"]
    assert not page.all("b")


def test_path_is_drawn_in_the_maps_world(made_run) -> None:
    figure = figure_of(page_of(made_run))
    line = next(trace for trace in figure["data"] if trace.get("mode") == "lines")
    x = np.frombuffer(base64.b64decode(line["x"]["bdata"]), np.dtype(line["x"]["dtype"]))
    np.testing.assert_allclose(x[[0, -1]], [-3, 6], atol=1e-5)


def test_the_slider_has_the_camera_of_each_key_frame(run_folder) -> None:
    add_cameras(run_folder)
    write_report(run_folder)
    page = page_of(run_folder)
    views = json.loads(next(text for text in page.scripts if text.startswith('[{"name"')))
    assert [view["name"] for view in views] == ["000000", "000020"]
    assert views[1]["camera"] == [4.0, 1.5, 1.2] and views[1]["driven"].endswith("driven")
    outline = np.array(views[1]["outline"])
    assert outline[:, 0].min() > 4 and outline[:, 0].max() == pytest.approx(4 + 8.5, abs=0.01), "ahead, to the range"
    # The picture shows 12 by 8 m, 600 by 400 pixels of it from its left upper corner (60, 40) on.
    np.testing.assert_allclose(views[1]["camera_px"], [[(4 + 4) * 50, (5 - 1.5) * 50]], atol=1e-6)
    assert len(page.all("svg")) == 1 and page.all("input")[0]["max"] == "1"
    assert (run_folder / "report.html").stat().st_size < 6e6


def test_without_cameras_or_place_pictures_still_move(made_run) -> None:
    page = page_of(made_run)
    assert json.loads(page.scripts[1]) == [{"name": "000000"}, {"name": "000020"}]
    assert not page.all("svg") and page.all("input")


@settings(max_examples=25)
@given(st.floats(-60, -40), st.floats(0, 360), st.floats(0.3, 3))
def test_what_a_camera_sees_of_the_ground(pitch_deg, heading_deg, height_m) -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zx", [heading_deg, -90 + pitch_deg], degrees=True).as_matrix()
    T[:3, 3] = 5, -3, height_m + 0.5
    seen = SeenFrame(np.zeros((48, 64), np.uint8), T, (50.0, 50.0), (31.5, 23.5))
    outline = ground_outline(seen, 0.5, 1e3)
    assert (outline[:, 2] == 0.5).all()
    x, y, z, _ = np.linalg.inv(T) @ np.column_stack([outline, np.ones(len(outline))]).T
    # Steep enough, every ray meets the ground; what is outlined lies on the border of the image.
    u, v = 50 * x / z + 31.5, 50 * y / z + 23.5
    assert (z > 0).all()
    np.testing.assert_allclose(np.minimum.reduce([u + 0.5, 63.5 - u, v + 0.5, 47.5 - v]), 0, atol=1e-6)


def test_optional_parts_are_left_out(run_folder) -> None:
    for name in ("bev.png", "config.yaml", "poses.tum", "map.ply"):
        (run_folder / name).unlink()
    shutil.rmtree(run_folder / "pictures")
    (run_folder / "metrics.json").write_text("{}")
    write_report(run_folder)
    page = page_of(run_folder)
    assert not page.all("img")
    assert "The drive" in page.text
    absent = ("Top-down map", "Key frames", "Skipped frames", "Notes", "Configuration", "frames skipped", "None", "nan")
    assert not [text for text in absent if text in page.text]
    assert page.all("title")
    assert run_folder.name in page.text


def test_broken_optional_parts_are_left_out_with_a_remark(run_folder) -> None:
    (run_folder / "bev.png").write_bytes(b"no picture")
    (run_folder / "pictures" / "000000_left.png").write_bytes(b"")
    (run_folder / "poses.tum").write_text("a b c d")
    write_report(run_folder)
    page = page_of(run_folder)
    assert len(page.all("img")) == 5
    for remark in ("bev.png could not be read", "000000_left.png could not be read", "poses.tum could not be read"):
        assert remark in page.text


def test_metrics_of_other_shapes_are_shown_kindly(run_folder) -> None:
    metrics = {
        "sequence": [1, 2],
        "times": {"total_s": None, "stages": {"match": 3, "step": {"median_ms": float("nan")}}},
        "voxels": {"by_class": {"moon": "many"}},
        "memory": "much",
        "deep": {"one": {"two": True}},
    }
    (run_folder / "metrics.json").write_text(json.dumps(metrics))
    write_report(run_folder)
    text = page_of(run_folder).text
    assert {"moon", "One two", "yes"} <= set(text.splitlines())


def test_an_interrupted_run_and_many_key_frames(run_folder) -> None:
    from jaxmap.mapping.store import load_map

    voxel_map, attributes = load_map(run_folder / "map.zarr")
    cut = MapAttributes(attributes.crs, SITE, fusion=attributes.fusion, progress={"complete": False, "next_frame": 12})
    save_map(run_folder / "map.zarr", voxel_map, cut)
    for frame in range(30):
        Image.new("RGB", (8, 6)).save(run_folder / "pictures" / f"{frame:06d}_left.png")
    write_report(run_folder)
    text = page_of(run_folder).text
    assert "interrupted (next frame 12)" in text
    assert text.count("Frame 0000") == MAX_KEY_FRAMES
    assert f"{MAX_KEY_FRAMES} of 30 key frames." in text


def test_an_empty_map_has_no_3d_view(run_folder) -> None:
    save_map(
        run_folder / "map.zarr", make_voxel_map(make_grid([0, 0, 0], [1, 1, 1], 0.2), ROVER_CLASSES), MapAttributes()
    )
    write_report(run_folder)
    assert (run_folder / "report.html").stat().st_size < 300_000
    assert "No voxel is occupied." in page_of(run_folder).text


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda run: (run / "metrics.json").unlink(), "there is no file .*metrics.json"),
        (lambda run: (run / "metrics.json").write_text("{"), "not readable as JSON"),
        (lambda run: (run / "metrics.json").write_text("[]"), "not a JSON object"),
        (lambda run: shutil.rmtree(run / "map.zarr"), "no such map"),
        (lambda run: shutil.rmtree(run), "no such run folder"),
    ],
)
def test_what_a_report_cannot_do_without(run_folder, break_it, message) -> None:
    break_it(run_folder)
    with pytest.raises(JaxmapError, match=message) as caught:
        write_report(run_folder)
    assert "\n" not in str(caught.value)
    assert not (run_folder / "report.html").exists()


@pytest.mark.parametrize("fusion", [{"params": {"unknown": 1}}, {"rule": {"unknown": 1}}, {"params": [1]}])
def test_fusion_that_is_not_understood(run_folder, fusion) -> None:
    save_map(
        run_folder / "map.zarr", make_voxel_map(make_grid([0, 0, 0], [1, 1, 1], 0.2), ()), MapAttributes(fusion=fusion)
    )
    with pytest.raises(JaxmapError, match="the attribute fusion is not understood"):
        write_report(run_folder)


def test_wording() -> None:
    assert name_and_unit("peak_resident_mib") == ("Peak resident", "MiB")
    assert name_and_unit("frames_per_s") == ("Frames per s", "")
    assert name_and_unit("m") == ("M", "")
    assert name_and_unit("<b>_m") == ("&lt;b&gt;", "m")
    assert number_text(0.123456) == "0.1235"
    assert number_text(5790321.6) == "5\N{NARROW NO-BREAK SPACE}790\N{NARROW NO-BREAK SPACE}321.6"
    assert number_text(float("inf")) == "–"
    assert value_text("<a>") == "&lt;a&gt;"
    assert value_text(None, "m") == "–"
    assert value_text(False) == "no"
    assert value_text(-3, "m") == "\N{MINUS SIGN}3&nbsp;m"


def test_charts_follow_the_theme_and_leave_the_page_alone() -> None:
    from matplotlib.figure import Figure

    drawing = Figure()
    drawing.add_subplot().plot([0, 1], color=ACCENT, label="a < b")
    chart = svg_of(drawing, "a & b")
    assert chart == svg_of(drawing, "a & b")
    assert chart.startswith('<svg class="chart"') and 'aria-label="a &amp; b"' in chart
    assert "var(--accent)" in chart and ACCENT not in chart and "<text" in chart
    assert "<style" not in chart and "DejaVu" not in chart and "axes_1" not in chart


def test_tuning_page_shows_parameters_scores_and_charts() -> None:
    score = dict(before=0.5, after=0.75, change=0.25, before_interval=[0.4, 0.6], after_interval=None)
    scores = dict.fromkeys(
        ("iou", "precision", "recall", "accuracy", "nll", "brier", "ece"), score | {"change_interval": None}
    )
    bins = {"before": [{"said": 0.2, "true": 0.1}], "after": []}
    stage = {
        "name": "fusion",
        "best_step": 1,
        "history": [{"step": step, "loss": 1.0 / (1 + step), "held_out": 1.1 / (1 + step)} for step in range(3)],
        "scores": dict(held_out=scores, tuned_on=scores),
        "calibration": dict(held_out=bins, tuned_on=bins),
        "parameters": {"class_hit": 1.5, "class_kernel": [[0.0, 0.1], [0.2, 0.3]]},
    }
    result = {
        **{"class": "rock", "labeller": "plane", "before": {"class_hit": 0.9}, "stages": [stage], "notes": [NASTY]},
        "traverses": [{"sequence": "<a>", "frames": 6, "cells": 100, "held_out_cells": 20}],
    }
    content = tuning_page("mine", result)
    page, by_name = Page(content), {row[0]: row for part in tables_of(content) for row in part.rows}
    assert by_name["IoU"][1:] == ["0.500 (0.400 to 0.600)", "0.750", "0.250"]
    assert by_name["class hit"][1:] == ["0.9", "1.5"] and by_name["<a>"][1:] == ["6", "100", "20"]
    assert len(page.all("svg")) == 3 and NASTY in page.text
    assert not re.findall(r"https?://(?!www.w3.org/)", content)
