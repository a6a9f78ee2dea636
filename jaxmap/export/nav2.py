"""Maps of nav2's map server: what is an obstacle, and what driving costs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.errors import JaxmapError
from jaxmap.export.source import Source, TopDownPart
from jaxmap.host.files import atomic_path

COST_LAYER = "cost"
"""The layer of a map that holds what a metre of driving costs, in metres of level driving: 1 or more."""
FREE, UNKNOWN, OCCUPIED = 254, 205, 0
_MOST_CELLS = 1 << 27


def write_nav2(source: Source, map_yaml: Path, map_image: Path, costs_yaml: Path, costs_image: Path) -> None:
    """Writes two maps, north up, each an image and its YAML.

    `map` is trinary: occupied where the label is the class asked about first (rock), free elsewhere, unknown where
    nothing was seen. `costs` is of mode `scale`: from the layer `COST_LAYER`, or else the probability of that class; as
    PNG, since this mode takes its unknown cells from transparency, which PGM has not.

    Raises:
        JaxmapError: the map has no class of obstacles, its columns are no squares, nothing was observed, the map is too
            large for one image, or the disk refuses.
    """
    from PIL import Image

    if source.target is None:
        raise JaxmapError(
            f"the map has no class of obstacles: its classes are {', '.join(source.classes) or 'none'}",
            where=source.where,
            fix="map with a labeller that knows rocks",
        )
    edge_m = source.square_cells("nav2")
    box = source.observed_box(_MOST_CELLS, "nav2")
    if box is None:
        raise source.nothing_observed("nav2")
    corner, shape = box
    corner_m = source.corner_m[:2] + np.asarray(corner) * source.size_m[:2]
    obstacles, greys = np.full(shape, UNKNOWN, np.uint8), np.zeros((*shape, 2), np.uint8)
    for part in source.parts():
        x, y = np.argwhere(part.top.observed).T
        to = part.moved(x, y, corner)
        obstacles[to] = np.where(np.asarray(part.top.label)[x, y] == source.target, OCCUPIED, FREE)
        greys[to] = _scaled(_costs(part, source.target)[x, y])
    for image, settings, pixels, mode in (
        (map_image, map_yaml, obstacles, "trinary"),
        (costs_image, costs_yaml, greys, "scale"),
    ):
        free, occupied = (0.196, 0.65) if mode == "trinary" else (0.5 / 255, 1 - 0.5 / 255)
        with atomic_path(image) as temporary:
            Image.fromarray(np.ascontiguousarray(np.swapaxes(pixels, 0, 1)[::-1])).save(temporary)
        lines = [
            f"image: {image.name}",
            f"mode: {mode}",
            f"resolution: {edge_m!r}",
            f"origin: [{corner_m[0]:.9g}, {corner_m[1]:.9g}, 0.0]",
            "negate: 0",
            f"occupied_thresh: {occupied:.6f}",
            f"free_thresh: {free:.6f}",
        ]
        with atomic_path(settings) as temporary:
            temporary.write_text("\n".join(lines) + "\n", "utf-8")


def _costs(part: TopDownPart, target: int) -> Float[np.ndarray, "X Y"]:
    """Costs from 0 to 1, NaN where they are not known: `1 - 1 / cost` of the layer, or else the probability of rock."""
    layer = part.layers.get(COST_LAYER)
    return np.asarray(part.top.probability)[target] if layer is None else 1 - 1 / np.maximum(layer, 1)


def _scaled(cost: Float[np.ndarray, "N"]) -> UInt8[np.ndarray, "N 2"]:
    """Grey value and opacity of costs: white costs nothing, black everything, what is not known is transparent."""
    known = ~np.isnan(cost)
    grey = np.where(known, 255 - np.rint(np.nan_to_num(cost) * 255), UNKNOWN)
    return np.stack([grey, np.where(known, 255, 0)], axis=-1).astype(np.uint8)
