"""The ground as a planner sees it: the top-down layers that a map gives of heights, hazards and rock."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxmap.errors import JaxmapError
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import TopDown
from jaxmap.fusion.surface import Surface, surface_of
from jaxmap.geometry.grid import exact_corner
from jaxmap.mapping.columns import heights_of, part_of
from jaxmap.mapping.store import Columns, MapReader
from jaxmap.planning.hazards import Hazards, Heights, hazard_reach, measure_hazards
from jaxmap.planning.options import RoverOptions
from jaxmap.types import GridSpec

_REACH_M = 0.1
"""Columns so far around lend their points to far ground, of which there are few."""

LEAST_COLUMNS = 1.4
"""Columns in the radius of a rover, at least: a plane needs heights around its middle."""

LAYERS = ("surface_m", "surface_sigma_m", *Hazards._fields)
"""Names of a map's layers: height of the surface (world z), its standard deviation, and hazards; NaN where unknown."""


class Ground(NamedTuple):
    """What a map says of the ground, by columns.

    Attributes:
        surface: heights.
        rock_probability: of each column.
        seen: whether a surface was seen in the column.
    """

    surface: Surface
    rock_probability: Float[np.ndarray, "X Y"]
    seen: Bool[np.ndarray, "X Y"]


def read_ground(reader: MapReader, top: TopDown, params: FusionParams, rock: str | None, within: Columns) -> Ground:
    """The ground of a rectangle of a map.

    Args:
        reader: the map.
        top: its top-down map there.
        params: of fusion, by which the evidence is read.
        rock: the class that is no ground to drive on; where it is None, there is none.
        within: the rectangle.

    Raises:
        JaxmapError: a tile is damaged, or no memory holds the columns.
    """
    probability = np.zeros(top.observed.shape, np.float32)
    if rock is not None:
        probability = np.asarray(top.probability[reader.classes.index(rock)])
    grid = part_of(reader.grid, within)
    surface = surface_of(heights_of(reader, params, within), grid, reach=_reach(cell_size(grid)))
    return Ground(surface, probability, np.asarray(top.observed))


def cell_size(grid: GridSpec) -> tuple[float, float]:
    """Size of a column along x and y, metres."""
    size_m = exact_corner(grid)[1]
    return float(size_m[0]), float(size_m[1])


def hazards_of(surface: Surface, cell_m: tuple[float, float], rover: RoverOptions) -> Hazards:
    """The hazards of the ground for a rover.

    Raises:
        JaxmapError: the cells are too large for it.
    """
    if rover.radius_m < LEAST_COLUMNS * max(cell_m):
        raise JaxmapError(
            f"a rover of radius {rover.radius_m:g} m on columns of {max(cell_m):g} m",
            where="rover",
            fix="map with voxels smaller than the rover (--grid.voxel-size-m)",
        )
    heights = Heights(*(jnp.asarray(values) for values in surface))
    return measure_hazards(heights, cell_m, rover.radius_m, rover.wheel_m)


def ground_layers(surface: Surface, hazards: Hazards) -> dict[str, Float[np.ndarray, "X Y"]]:
    """Heights and hazards as the layers of a map, by the names of `LAYERS`; NaN where they are not known."""
    height_m, sigma_m, known = map(np.asarray, surface)
    heights = (np.where(known, height_m, np.nan), np.where(known, sigma_m, np.nan))
    return dict(zip(LAYERS, (*heights, *map(np.asarray, hazards)), strict=True))


def keeps_layers(reader: MapReader, rover: RoverOptions) -> bool:
    """Whether a map keeps heights, and its columns are fine enough for the hazards of a rover."""
    return reader.surface and rover.radius_m >= LEAST_COLUMNS * max(cell_size(reader.grid))


def map_layers(
    reader: MapReader, params: FusionParams, rover: RoverOptions, within: Columns
) -> dict[str, Float[np.ndarray, "X Y"]]:
    """The layers of a map's ground in a rectangle: heights that are good to some centimetres, and a rover's hazards.

    They are the same through whatever rectangle, which may reach beyond the grid.

    Raises:
        JaxmapError: the columns are too large for the rover, a tile is damaged, or no memory holds the rectangle.
    """
    cell_m = cell_size(reader.grid)
    reach = _reach(cell_m)
    margin = reach + hazard_reach(cell_m, rover.radius_m, rover.wheel_m)
    x, y = (slice(side.start - margin, side.stop + margin) for side in within)
    columns, grid = heights_of(reader, params, (x, y)), part_of(reader.grid, (x, y))
    hazards = hazards_of(surface_of(columns, grid, reach=reach), cell_m, rover)
    layers = ground_layers(surface_of(columns, grid), hazards)
    return {name: values[margin:-margin, margin:-margin] for name, values in layers.items()}


def _reach(cell_m: tuple[float, float]) -> int:
    return round(_REACH_M / min(cell_m))
