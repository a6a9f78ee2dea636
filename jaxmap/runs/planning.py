"""`jaxmap plan`, from a run to a path: the ground, its costs, the cheapest path, and the files that show it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

import jaxmap
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.export.geotiff import write_bands
from jaxmap.export.route import write_csv, write_geojson
from jaxmap.export.source import absolute
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams, stored_fusion
from jaxmap.fusion.query import TopDown
from jaxmap.geometry.grid import exact_corner
from jaxmap.host.output_folder import write_json
from jaxmap.mapping.columns import MOST_WHOLE, part_of, top_down_of
from jaxmap.mapping.store import Columns, MapAttributes, MapReader, open_map
from jaxmap.planning.cost import CostMap, cost_map
from jaxmap.planning.ground import Ground, cell_size, ground_layers, hazards_of, read_ground
from jaxmap.planning.hazards import Hazards
from jaxmap.planning.options import ROVER_SETTINGS, RoverOptions
from jaxmap.planning.path import NoPathError, Terrain, find_path, length_m, sampled, straightened
from jaxmap.report.plan_picture import write_plan_picture
from jaxmap.runs.folder import RunFolder
from jaxmap.types import GridSpec

PLAN_FILES = ("plan.png", "plan.geojson", "plan.csv", "plan.tif", "plan.json")
ROCK = 0.5
"""What is likelier rock than not is rock, where a path may not begin or end, and from which clearance is measured."""
_SAMPLE_M = 0.1


@dataclass(frozen=True, eq=False)
class Site:
    """The part of a map that is planned over; arrays are on the host.

    Attributes:
        grid: of the part.
        top: its top-down map.
        attributes: of the whole map.
        rock: name of the class that is rock, None where the map has none.
        fine: whether heights are finer than voxels.
    """

    grid: GridSpec
    top: TopDown
    attributes: MapAttributes
    rock: str | None
    fine: bool


@dataclass(frozen=True, eq=False)
class Costs:
    """A run's ground, and what driving it costs a rover; arrays are on the host.

    Attributes:
        site: where it is.
        terrain: what paths are sought over.
        ground: as the map has it.
        hazards: for the rover.
        costs: for the rover.
        rover: the rover.
    """

    site: Site
    terrain: Terrain
    ground: Ground
    hazards: Hazards
    costs: CostMap
    rover: RoverOptions


@dataclass(frozen=True, eq=False)
class Plan:
    """A path over a map.

    Attributes:
        points_m: its corners, world.
        places_m: places along it, a tenth of a metre apart.
        along: numbers at each of these, by name.
        metrics: what is written as JSON.
    """

    points_m: Float[np.ndarray, "M 2"]
    places_m: Float[np.ndarray, "S 2"]
    along: dict[str, Float[np.ndarray, "S"]]
    metrics: dict[str, Any]


def read_costs(run: Path, rover: RoverOptions) -> Costs:
    """What driving over the map of a run costs a rover; of a large map, over the rectangle that was observed.

    Raises:
        JaxmapError: there is no map, it is damaged, too coarse for the rover, or no memory holds the rectangle.
    """
    folder = RunFolder(run)
    if not run.is_dir():
        raise JaxmapError("no such run folder", where=run, fix="give a folder that `jaxmap map` wrote")
    reader = open_map(folder.map)
    within = reader.whole if math.prod(reader.grid.shape[:2]) <= MOST_WHOLE else reader.extent()
    params, rule = stored_fusion(reader.attributes.fusion, reader.classes, folder.map)
    return costs_of(*read_site(reader, params, rule, within), rover)


def read_site(reader: MapReader, params: FusionParams, rule: FusionRule, within: Columns) -> tuple[Site, Ground]:
    """A rectangle of a map, and its ground.

    Raises:
        JaxmapError: a tile is damaged, or no memory holds the rectangle.
    """
    top, rock = top_down_of(reader, params, rule, within), rule.target(reader.classes)
    site = Site(part_of(reader.grid, within), top, reader.attributes, rock, reader.surface)
    return site, read_ground(reader, top, params, rock, within)


def costs_of(site: Site, ground: Ground, rover: RoverOptions) -> Costs:
    """What driving over a ground costs a rover.

    Raises:
        JaxmapError: the cells are too large for it.
    """
    cell_m = cell_size(site.grid)
    hazards = hazards_of(ground.surface, cell_m, rover)
    costs = cost_map(hazards, ground.rock_probability, ground.seen, cell_m, rover)
    hazards, costs, ground = jax.tree.map(np.asarray, (hazards, costs, ground))
    terrain = Terrain(costs.cost, costs.drivable, exact_corner(site.grid)[0][:2], np.array(cell_m))
    return Costs(site, terrain, ground, hazards, costs, rover)


def plan_path(costs: Costs, start: Float[np.ndarray, "2"], goal: Float[np.ndarray, "2"]) -> Plan:
    """The cheapest path between two places, given as coordinates of the map's reference system.

    Raises:
        UsageError: one of them is outside the map, or where the rover cannot be; it names the nearest free place.
        JaxmapError: the goal cannot be reached.
    """
    terrain, site = costs.terrain, costs.site.attributes.site_origin[:2]
    cells = [_free_cell(costs, name, place) for name, place in (("start", start), ("goal", goal))]
    try:
        steps, _ = find_path(terrain, *cells)
    except NoPathError as error:
        raise JaxmapError(
            f"the goal {_text(goal)} cannot be reached from the start {_text(start)}",
            where="the map",
            fix=f"the nearest place to it that can is {_text(error.nearest_m + site)}; or map more ground, or see "
            "max_unknown, max_step_m, max_slope_deg and margin_m of the rover",
        ) from error
    points_m = straightened(terrain, steps)
    places_m = sampled(points_m, _SAMPLE_M)
    along = _along(costs, places_m)
    return Plan(points_m, places_m, along, _metrics(costs, points_m, places_m, along, (start, goal)))


def write_plan(costs: Costs, plan: Plan, folder: Path) -> None:
    """Writes `PLAN_FILES`: picture, path as GeoJSON and CSV, costs and hazards as GeoTIFF, and metrics.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    picture, geojson, table, raster, metrics = (folder / name for name in PLAN_FILES)
    attributes, grid, top = costs.site.attributes, costs.site.grid, costs.site.top
    folder.mkdir(parents=True, exist_ok=True)
    placed = attributes.crs is not None
    write_plan_picture(picture, costs.costs, costs.ground, top, grid, plan.points_m, plan.metrics, georeferenced=placed)
    write_geojson(geojson, plan.points_m + attributes.site_origin[:2], attributes.crs, plan.metrics)
    write_csv(table, plan.along)
    layers = {name: np.asarray(value, np.float32) for name, value in costs.costs._asdict().items()}
    layers |= absolute(ground_layers(costs.ground.surface, costs.hazards), attributes.site_origin[2])
    write_bands(raster, layers, grid, attributes.crs, attributes.site_origin)
    write_json(metrics, plan.metrics)


def _free_cell(costs: Costs, name: str, place: Float[np.ndarray, "2"]) -> Int[np.ndarray, "2"]:
    """The cell of a place where the rover can be.

    Raises:
        UsageError: it cannot be there.
    """
    terrain, site = costs.terrain, costs.site.attributes.site_origin[:2]
    free = terrain.drivable & (costs.costs.rock <= ROCK)
    cell = terrain.cell_of(place - site)
    reason = _why_not(costs, cell) if terrain.holds(cell) else "lies outside the map"
    if not reason:
        return cell
    nearest_m = terrain.nearest(place - site, free)
    fix = "no place of this map is free for this rover: map more ground, or take a smaller rover"
    if nearest_m is not None:
        fix = f"the nearest free place is {_text(nearest_m + site)}"
    raise UsageError(f"the {name} {_text(place)} {reason}", where="the map", fix=fix)


def _why_not(costs: Costs, cell: Int[np.ndarray, "2"]) -> str:
    """Why a rover cannot be in a cell; empty where it can."""
    at = tuple(cell)
    rover, unknown = costs.rover, costs.costs.unknown[at]
    if costs.costs.rock[at] > ROCK:
        return f"is in a rock, or within {rover.radius_m + rover.margin_m:g} m of one"
    if unknown > rover.max_unknown:
        return f"lies on ground not seen ({unknown:.0%} of that under the rover)"
    return "" if costs.terrain.drivable[at] else "is too steep, rough or close to a step for the rover"


def _along(costs: Costs, places_m: Float[np.ndarray, "S 2"]) -> dict[str, Float[np.ndarray, "S"]]:
    """The numbers of the places along a path."""
    i, j = costs.terrain.cell_of(places_m).T
    site, surface, hazards = costs.site.attributes.site_origin, costs.ground.surface, costs.hazards
    steps_m = np.linalg.norm(np.diff(places_m, axis=0), axis=1)
    east, north = (places_m + site[:2]).T
    height_m = np.where(surface.known, np.asarray(surface.height_m, np.float64) + site[2], np.nan)
    under = {"cost": costs.costs.cost}
    under |= {name: getattr(hazards, name) for name in ("slope_deg", "step_m", "roughness_m")}
    under |= {"rock_probability": costs.costs.rock, "unknown": costs.costs.unknown}
    return {
        "east_m": east,
        "north_m": north,
        "height_m": height_m[i, j],
        "distance_m": np.concatenate([[0.0], np.cumsum(steps_m)]),
        **{name: np.asarray(values)[i, j] for name, values in under.items()},
    }


def _metrics(
    costs: Costs,
    points_m: Float[np.ndarray, "M 2"],
    places_m: Float[np.ndarray, "S 2"],
    along: dict[str, Float[np.ndarray, "S"]],
    ends: tuple[np.ndarray, np.ndarray],
) -> dict[str, Any]:
    i, j = costs.terrain.cell_of(places_m).T
    clearance_m = clearance(costs)[i, j].min()
    straight_m = float(np.linalg.norm(ends[1] - ends[0]))

    def greatest(name: str) -> float | None:
        values = along[name][np.isfinite(along[name])]
        return round(float(values.max()), 4) if values.size else None

    return {
        "length_m": round(length_m(points_m), 3),
        "straight_m": round(straight_m, 3),
        # Of a place between two cells that the path crosses at their corner, a third cell may be the one that counts.
        "cost": round(float(np.trapezoid(along["cost"], along["distance_m"])), 3),
        "greatest_slope_deg": greatest("slope_deg"),
        "greatest_step_m": greatest("step_m"),
        "greatest_roughness_m": greatest("roughness_m"),
        "greatest_rock_probability": greatest("rock_probability"),
        "least_clearance_m": None if np.isinf(clearance_m) else round(float(clearance_m), 3),
        "unknown_share": round(float(along["unknown"].mean()), 4),
        "start": np.round(ends[0], 3).tolist(),
        "goal": np.round(ends[1], 3).tolist(),
        "crs": costs.site.attributes.crs,
        "rock_class": costs.site.rock,
        "rover": ROVER_SETTINGS.tree(costs.rover),
        "jaxmap_version": jaxmap.__version__,
    }


def clearance(costs: Costs) -> Float[np.ndarray, "X Y"]:
    """Metres from a rover over each cell to rock and to what it cannot drive; infinite where there is none."""
    rock = costs.ground.seen & (costs.ground.rock_probability > ROCK)
    # Hazards are those of the whole disc: its centre is where they begin.
    barred = np.isfinite(costs.hazards.slope_deg) & (costs.costs.goodness <= 0)
    to_rock, to_hazard = (_distance_m(where, costs.terrain.cell_m) for where in (rock, barred))
    return np.minimum(to_rock - costs.rover.radius_m, to_hazard)


def _distance_m(where: Bool[np.ndarray, "X Y"], cell_m: Float[np.ndarray, "2"]) -> Float[np.ndarray, "X Y"]:
    if not where.any():
        return np.full(where.shape, np.inf)
    return np.asarray(distance_transform_edt(~where, sampling=tuple(cell_m)))


def _text(place: Float[np.ndarray, "2"]) -> str:
    return f"{place[0]:.2f} {place[1]:.2f}"
