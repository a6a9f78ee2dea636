"""Heights and hazards as layers of a map that is stored in tiles, square by square."""

from __future__ import annotations

from pathlib import Path

from jaxmap.fusion.params import stored_fusion
from jaxmap.mapping.arrays import TILE
from jaxmap.mapping.columns import squares_of
from jaxmap.mapping.store import MapReader, add_layers, open_map
from jaxmap.planning.ground import LAYERS, keeps_layers, map_layers
from jaxmap.planning.options import RoverOptions

_EDGE = 4 * TILE[0]
"""Columns along a square: around each, as many again are measured in part."""


def add_hazards(path: Path, rover: RoverOptions) -> MapReader:
    """Adds the layers of its ground to a stored map, and opens it; memory stays that of a square.

    There are none where the map keeps no heights, or its columns are too large for the rover.

    Raises:
        JaxmapError: the map is damaged, or the disk refuses.
    """
    reader = open_map(path)
    if not keeps_layers(reader, rover):
        return reader
    params, _ = stored_fusion(reader.attributes.fusion, reader.classes, path)
    parts = ((square, map_layers(reader, params, rover, square)) for square in squares_of(reader, _EDGE))
    add_layers(path, LAYERS, parts)
    return open_map(path)
