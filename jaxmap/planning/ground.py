"""The ground as a planner sees it: the top-down layers that a map gives of heights, hazards and rock."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import top_down
from jaxmap.fusion.surface import Surface, read_surface
from jaxmap.geometry.grid import exact_corner
from jaxmap.planning.hazards import Hazards, Heights, measure_hazards
from jaxmap.planning.options import RoverOptions
from jaxmap.types import GridSpec, VoxelMap

_REACH_M = 0.1
"""Columns so far around lend their points to far ground, of which there are few."""

LEAST_COLUMNS = 1.4
"""Columns in the radius of a rover, at least: a plane needs heights around its middle."""

SURFACE_LAYER, SIGMA_LAYER = "surface_m", "surface_sigma_m"
"""Names of a map's layers: height of the surface (world z) and its standard deviation; NaN where it is not known."""


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


def read_ground(voxel_map: VoxelMap, params: FusionParams, rule: FusionRule, rock: str | None) -> Ground:
    """The ground of a map.

    Args:
        voxel_map: the map.
        params: of fusion, by which the evidence is read.
        rule: of fusion, likewise.
        rock: the class that is no ground to drive on; where it is None, there is none.
    """
    top = top_down(voxel_map, params, rule)
    probability = np.zeros(top.observed.shape, np.float32)
    if rock is not None:
        probability = np.asarray(top.probability[voxel_map.classes.index(rock)])
    surface = read_surface(voxel_map, params, reach=_reach(cell_size(voxel_map.grid)))
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
    """Heights and hazards as the layers of a map, by name; NaN where they are not known."""
    height_m, sigma_m, known = map(np.asarray, surface)
    named = {SURFACE_LAYER: np.where(known, height_m, np.nan), SIGMA_LAYER: np.where(known, sigma_m, np.nan)}
    return named | {name: np.asarray(values) for name, values in hazards._asdict().items()}


def map_layers(voxel_map: VoxelMap, params: FusionParams) -> dict[str, Float[np.ndarray, "X Y"]]:
    """The layers of a map's ground: heights that are good to some centimetres, and hazards for the usual rover.

    None of a map that keeps no heights, or whose columns are too large for hazards.
    """
    rover, cell_m = RoverOptions(), cell_size(voxel_map.grid)
    if voxel_map.surface is None or rover.radius_m < LEAST_COLUMNS * max(cell_m):
        return {}
    around = read_surface(voxel_map, params, reach=_reach(cell_m))
    return ground_layers(read_surface(voxel_map, params), hazards_of(around, cell_m, rover))


def _reach(cell_m: tuple[float, float]) -> int:
    return round(_REACH_M / min(cell_m))
