"""The page of one place of a map: which frames and pixels made it what it is."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxmap.labels import IGNORE
from jaxmap.report.page import figure, header, section, table, write_page
from jaxmap.report.pictures import colourise_disparity, overlay_labels
from jaxmap.report.training_charts import LIGHT_PANEL, Line, class_inks, class_style, hex_of, line_chart
from jaxmap.report.wording import number_text, value_text

MOST_PATCHES = 24
_PATCH_PX, _SHOWN_PX, _AROUND_PX = 96, 384, 24
_EDGE = (255, 64, 200)


@dataclass(frozen=True, eq=False)
class FramePart:
    """What one frame has added to a place.

    Attributes:
        index: of the frame in its sequence.
        name: of the frame.
        evidence: log-odds, summed over the voxels that decide and the mean of the columns: occupancy, then each class.
        seen_through: voxels of the place that it saw through.
        range_m: from the camera to the place.
        centre_px: column and row of the place in the image; None behind the camera.
        inside: pixels whose points lie in the place.
        label: of all pixels.
        weight: how much each pixel inside counts.
        depth_m: of all pixels.
        left: rectified left image; empty where it is not kept.
        disparity_px: of all pixels.
    """

    index: int
    name: str
    evidence: Float[np.ndarray, "K"]
    seen_through: int
    range_m: float
    centre_px: tuple[float, float] | None
    inside: Bool[np.ndarray, "H W"]
    label: UInt8[np.ndarray, "H W"]
    weight: Float[np.ndarray, "H W"]
    depth_m: Float[np.ndarray, "H W"]
    left: UInt8[np.ndarray, "H W *rgb"]
    disparity_px: Float[np.ndarray, "H W"]

    def pixels_of(self, label: int) -> int:
        """How many pixels inside have a label."""
        return int((self.inside & (self.label == label)).sum())


@dataclass(frozen=True, eq=False)
class Explanation:
    """A place of a map and the frames that made it; metres are of the map's system.

    Attributes:
        run: name of its folder.
        low_m: south-west corner.
        high_m: north-east corner.
        crs: the system.
        classes: of the map.
        columns: how many columns of voxels were observed.
        labels: how many of them have each label.
        height_m: of the surface, None where nothing is occupied.
        evidence: what the map holds, as `FramePart.evidence`.
        priors: log-odds of occupancy and of each class where nothing was seen.
        probability: of each class, the mean of the columns; empty where nothing is occupied.
        priority: classes that win from a probability on, and that.
        spread: the map is read with a kernel, through which neighbours count too.
        column_rule: how a column reads its voxels: their sum, or the greatest.
        parts: the frames, in their order.
    """

    run: str
    low_m: tuple[float, float]
    high_m: tuple[float, float]
    crs: str | None
    classes: tuple[str, ...]
    columns: int
    labels: dict[str, int]
    height_m: float | None
    evidence: Float[np.ndarray, "K"]
    priors: Float[np.ndarray, "K"]
    probability: tuple[float, ...]
    priority: tuple[tuple[str, ...], float]
    spread: bool
    column_rule: str
    parts: Sequence[FramePart]

    @property
    def place(self) -> str:
        """Where it is, in words."""
        x, y = (f"{a:.10g} to {b:.10g}" for a, b in zip(self.low_m, self.high_m, strict=True))
        return f"east {x}, north {y}" if self.crs else f"x {x}, y {y}"

    @property
    def verdict(self) -> str:
        """What the map says of it, in words."""
        if not self.labels:
            return "free: it was seen through"
        named = list(self.labels.items())
        return named[0][0] if len(named) == 1 else ", ".join(f"{name} {count}" for name, count in named)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the evidence: occupancy and the classes."""
        return ("occupancy", *self.classes)

    def note(self) -> str:
        """How the numbers are to be read."""
        of = {"sum": "summed over the occupied voxels", "max": "of the occupied voxel with the greatest evidence"}
        which = of[self.column_rule] if self.labels else "summed over the voxels that were observed"
        mean = f", the mean of {self.columns} columns" if self.columns > 1 else ""
        text = f"Log-odds that each frame added, {which}{mean}; their sum and the prior are what the map holds."
        names, threshold = self.priority
        if names and self.labels:
            text += f" {' and '.join(names)} wins where its probability passes {threshold:.2g}."
        return text + (" Neighbouring columns count too, by the class kernel." if self.spread else "")


def write_explanation(path: Path, explained: Explanation) -> Path:
    """Writes the page, and returns its path.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    stats = [
        ("label", escape(explained.verdict)),
        *(
            (f"p({escape(name)})", f"{p:.3f}")
            for name, p in zip(explained.classes, explained.probability, strict=False)
        ),
        ("frames", value_text(len(explained.parts))),
        ("pixels", value_text(int(sum(part.inside.sum() for part in explained.parts)))),
        ("height", value_text(round(explained.height_m, 2), "m") if explained.height_m is not None else None),
    ]
    columns = f"{explained.columns} columns of voxels" if explained.columns > 1 else ""
    where = " · ".join(filter(None, [explained.place, explained.crs, columns]))
    chosen = sorted(explained.parts, key=lambda part: -float(np.abs(part.evidence).max()))[:MOST_PATCHES]
    shown = [part for part in explained.parts if any(part is one for one in chosen)]
    left_out = len(explained.parts) - len(shown)
    body = [
        f"<style>{class_style(explained.classes)}</style>",
        header("Why is it so?", f"{explained.verdict[:1].upper()}{explained.verdict[1:]}", where, stats),
        section("Frame by frame", f"<p>{explained.note()}</p>{_charts(explained)}"),
        section("What each frame saw", "".join(_patches(part, explained) for part in shown)),
        section("All frames", f'<div class="tables"><figure>{_table(explained)}</figure></div>'),
        f"<footer>{f'{left_out} frames that added less are in the table alone. ' if left_out else ''}"
        f"Made by jaxmap from {escape(explained.run)}; pixels of the place are outlined.</footer>",
    ]
    return write_page(path, f"{explained.verdict} at {explained.place}", "".join(body), drawn=False)


def _charts(explained: Explanation) -> str:
    """How the evidence grew with the frames: the probability of each class, and of occupancy."""
    numbers = range(len(explained.parts) + 1)
    sums = np.cumsum([explained.priors, *(part.evidence for part in explained.parts)], axis=0)
    inks = [hex_of(ink) for ink in class_inks(explained.classes, LIGHT_PANEL)]
    variables = {ink: f"--class-{index}" for index, ink in enumerate(inks)}
    lines = [
        Line(name, list(zip(numbers, sums[:, 1 + index].tolist(), strict=True)), inks[index], strong=True)
        for index, name in enumerate(explained.classes)
    ]
    charts = [("Class", lines)] if lines else []
    charts.append(
        ("Occupancy", [Line("", list(zip(numbers, sums[:, 0].tolist(), strict=True)), "#667080", strong=True)])
    )
    figures = ""
    for name, drawn in charts:
        svg = line_chart(
            f"{name}: log-odds after each frame",
            ("frames that saw it", "log-odds"),
            drawn,
            height_px=240,
            variables=variables,
        )
        figures += f"<figure><figcaption>{name}</figcaption>{svg}</figure>"
    return f'<div class="charts">{figures}</div>'


def _table(explained: Explanation) -> str:
    headings = ("frame", "range, m", "pixels", "seen through", *map(escape, explained.channels))
    rows = [
        (
            escape(part.name),
            number_text(round(part.range_m, 2)),
            value_text(int(part.inside.sum())),
            value_text(part.seen_through),
            *map(signed, part.evidence),
        )
        for part in explained.parts
    ]
    rows.append(("prior", "", "", "", *map(signed, explained.priors)))
    rows.append(
        ("<b>the map</b>", "", "", "", *(f"<b>{signed(value)}</b>" for value in explained.evidence + explained.priors))
    )
    return table(headings, rows)


def signed(value: float) -> str:
    """A number with its sign, two digits after the point."""
    return f"{value:+.2f}".replace("-", "\N{MINUS SIGN}")


def _patches(part: FramePart, explained: Explanation) -> str:
    """Image, labels and disparity around the place, with its pixels outlined."""
    window = _window(part)
    if window is None:
        return ""
    pictures = {}
    if part.left.size:
        pictures["image"] = part.left if part.left.ndim == 3 else np.repeat(part.left[..., None], 3, axis=2)
        if explained.classes:
            pictures["labels"] = overlay_labels(part.left, part.label, explained.classes)
    pictures["disparity"] = colourise_disparity(part.disparity_px)
    figures = "".join(
        figure(_inline(_outlined(picture[window], part.inside[window]), f"{name} of frame {part.name}"), name)
        for name, picture in pictures.items()
    )
    said = ", ".join(
        f"{escape(name)} {signed(value)}"
        for name, value in zip(explained.channels, part.evidence, strict=True)
        if value
    )
    counts = [
        f"{part.pixels_of(index)} {name}" for index, name in enumerate(explained.classes) if part.pixels_of(index)
    ]
    if unknown := part.pixels_of(IGNORE):
        counts.append(f"{unknown} without a class")
    pixels = f"pixels: {escape(', '.join(counts))}" if counts else f"{part.seen_through} voxels seen through"
    title = f"Frame {escape(part.name)} · {number_text(round(part.range_m, 2))} m away · {pixels} · {said or 'nothing'}"
    return f'<div class="frame"><h3>{title}</h3><div class="row">{figures}</div></div>'


def _window(part: FramePart) -> tuple[slice, slice] | None:
    """The part of the image around the place; None where it lies outside."""
    height, width = part.inside.shape
    if part.inside.any():
        rows, columns = np.nonzero(part.inside)
        low, high = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()]) + 1
    elif part.centre_px is not None:
        low = high = np.round(part.centre_px[::-1]).clip(-1, [height, width]).astype(int)
        if (low < 0).any() or (low >= [height, width]).any():
            return None
    else:
        return None
    side = max(_PATCH_PX, int((high - low).max()) + 2 * _AROUND_PX)
    first = ((low + high) // 2 - side // 2).clip(0, np.maximum([height - side, width - side], 0))
    return slice(int(first[0]), int(first[0]) + side), slice(int(first[1]), int(first[1]) + side)


def _outlined(picture: UInt8[np.ndarray, "h w 3"], inside: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "H W 3"]:
    """A patch enlarged to whole pixels, with lines around the pixels inside."""
    scale = max(1, _SHOWN_PX // max(inside.shape))
    large, mask = (values.repeat(scale, axis=0).repeat(scale, axis=1) for values in (picture, inside))
    around = np.pad(mask, 1)
    edge = mask & ~(around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:])
    return np.where(edge[..., None], np.array(_EDGE, np.uint8), large)


def _inline(picture: UInt8[np.ndarray, "H W 3"], alt: str) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "webp", quality=88)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    height, width = picture.shape[:2]
    return f'<img src="data:image/webp;base64,{data}" alt="{escape(alt)}" width="{width}" height="{height}">'
