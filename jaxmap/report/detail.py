"""Every voxel of a large map on its page: part by part, each loaded when it is chosen from the map from above.

The parts lie compressed in the page as long as they are small enough together, else in a folder beside it. They are
made one row of the map after the other: the memory they take does not grow with it.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxmap.export.source import Source
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE, class_colours
from jaxmap.report.page import script_text, section

EDGE = 192
"""Columns along a side of a part, whole tiles: its faces are what a browser draws with ease."""
MOST_EMBEDDED_BYTES = 10_000_000
"""Of the text that all parts take in the page."""
FOLDER = "report.parts"
"""Beside the page, for the parts of larger maps."""


class Part(NamedTuple):
    """A part of a map: where it lies, counted in parts, how many voxels it has, and these, compressed."""

    place: tuple[int, int]
    voxels: int
    packed: bytes


def pack(index: Int[np.ndarray, "N 3"], label: UInt8[np.ndarray, "N"], place: tuple[int, int]) -> Part:
    """The voxels of a part as detail.js unpacks them: x and y within it, z from the lowest of the grid, the label.

    Each number has an array of its own, one after the other; z has two bytes, low byte first.
    """
    order = np.lexsort(index.T[::-1])
    x, y, z = index[order].T
    local = [(x - place[0] * EDGE).astype(np.uint8), (y - place[1] * EDGE).astype(np.uint8)]
    content = b"".join(values.tobytes() for values in (*local, z.astype("<u2"), label[order].astype(np.uint8)))
    return Part(place, len(order), gzip.compress(content, 6, mtime=0))


def parts_of(source: Source) -> Iterator[Part]:
    """The parts of a map that have voxels, along x, and y within that."""
    open_parts: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
    for voxels in source.voxels():
        places = voxels.index[:, :2] // EDGE
        # Blocks come along x: what lies before this one is whole.
        for place in sorted(place for place in open_parts if place[0] < places[:, 0].min()):
            yield _closed(place, open_parts.pop(place))
        for place in np.unique(places, axis=0):
            here = (places == place).all(axis=1)
            open_parts.setdefault((int(place[0]), int(place[1])), []).append((voxels.index[here], voxels.label[here]))
    for place in sorted(open_parts):
        yield _closed(place, open_parts[place])


def _closed(place: tuple[int, int], pieces: list[tuple[np.ndarray, np.ndarray]]) -> Part:
    index, label = zip(*pieces, strict=True)
    return pack(np.concatenate(index), np.concatenate(label), place)


def detail_section(source: Source, page: Path, background: str, T_map_world: Float[np.ndarray, "3 3"]) -> str:
    """The section from which each part of a map is chosen; writes the folder beside the page where there must be one.

    Args:
        source: the map.
        page: the file of the page.
        background: an SVG element, the map from above.
        T_map_world: from metres of the world to the units of that picture.

    Raises:
        JaxmapError: a tile is damaged, or the disk is full or refuses.
    """
    folder = page.parent / FOLDER
    embedded: list[Part] | None = []
    places, size, total = [], 0, 0
    for part in parts_of(source):
        places.append((*part.place, part.voxels))
        total += part.voxels
        size += len(part.packed) * 4 // 3
        if embedded is not None:
            embedded.append(part)
            if size <= MOST_EMBEDDED_BYTES:
                continue
            for waiting in embedded:
                _write(folder, waiting)
            embedded = None
        else:
            _write(folder, part)
    scripts = "".join(
        f'<script type="text/plain" id="part-{x}-{y}">{base64.b64encode(packed).decode("ascii")}</script>'
        for (x, y), _, packed in embedded or ()
    )
    colours = class_colours(source.classes)[[*range(len(source.classes)), IGNORE]].tolist()
    data = {
        "edge": EDGE,
        "size_m": source.size_m.tolist(),
        "corner_m": source.corner_m.tolist(),
        "names": [*source.classes, "no label"],
        "colours": [f"rgb({r},{g},{b})" for r, g, b in colours],
        "folder": None if embedded is not None else FOLDER,
    }
    boxes = "".join(_box(source, x, y, count, T_map_world) for x, y, count in places)
    side_m = EDGE * source.size_m[0]
    east_m, north_m = source.size_m[:2] * source.reader.grid.shape[:2]
    # The parts of a long drive are small: its picture takes the whole width.
    layout = "stage" if east_m < 2 * north_m else "stacked"
    where = "" if embedded is not None else f" They lie in the folder {FOLDER}/, which goes with this page."
    text = f"All {total:,} voxels, in {len(places):,} parts of {side_m:g} m: choose one from the map.{where}"
    return section(
        "In detail",
        f'<div id="detail" class="{layout}"><div id="detail3d" class="view3d" role="figure" '
        'aria-label="The voxels of a part in 3D"><p>Choose a part of the map.</p></div>'
        f'<figure class="above">{background.replace("</svg>", f"{boxes}</svg>")}<figcaption></figcaption></figure>'
        f"</div><p>{escape(text)}</p>{scripts}"
        f'<script type="application/json" id="detail-data">{script_text(json.dumps(data))}</script>',
    )


def _write(folder: Path, part: Part) -> None:
    """A part as a script: a page that was opened from a disk may read no other file."""
    text = base64.b64encode(part.packed).decode("ascii")
    with atomic_path(folder / f"part-{part.place[0]}-{part.place[1]}.js") as temporary:
        temporary.write_text(f'jaxmapPart("{part.place[0]}-{part.place[1]}","{text}");\n', "utf-8")


def _box(source: Source, x: int, y: int, count: int, T_map_world: Float[np.ndarray, "3 3"]) -> str:
    low = source.corner_m[:2] + np.array([x, y]) * EDGE * source.size_m[:2]
    end = source.corner_m[:2] + source.size_m[:2] * source.reader.grid.shape[:2]
    high = np.minimum(low + EDGE * source.size_m[:2], end)
    corners = np.array([low, high]) @ T_map_world[:2, :2].T + T_map_world[:2, 2]
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
    return (
        f'<rect class="part" data-part="{x}-{y}" x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" '
        f'height="{bottom - top:.2f}" tabindex="0" role="button"><title>{count:,} voxels</title></rect>'
    )
