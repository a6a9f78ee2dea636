"""Paths over maps of simulated worlds: collisions with true rocks, and length against a planner that knows the truth.

    python scripts/experiments/planning.py [--worlds FOLDER] [--seeds 301 302] [--known FOLDER ...] [--pairs 5]

Worlds of new seeds are rendered into the folder, each once (extra `sim`; minutes each), so that more can be added;
`--known` names folders that `jaxmap simulate` has written already. In each world, pairs of places are drawn that
are free in truth, in view, at least 3 m apart, and between which true rock bars the straight way wherever there
are such pairs. Prints, for each way to see rocks, how many paths were found and how many of them collide: come closer
to a true rock of more than 0.3 m than the rover's radius; and their length over that of the same planner where it
knows true heights and all rocks of more than 0.3 m. Rows plane, network and relief plan by what labels say alone;
hazards by heights alone; ours by both. The scores of a world are kept in its folder.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import Frames, Table, Traverse, command_line, fuse, jaxmap, parse
from scipy.ndimage import distance_transform_edt, label
from skimage.draw import line

from jaxmap.datasets.crs import Extent
from jaxmap.datasets.rasters import read_heights, read_window
from jaxmap.errors import JaxmapError
from jaxmap.fusion.surface import Surface
from jaxmap.geometry.grid import exact_corner
from jaxmap.mapping.store import MapAttributes, in_memory
from jaxmap.planning.ground import Ground
from jaxmap.planning.options import RoverOptions
from jaxmap.runs.config import MapConfig
from jaxmap.runs.mapping_plan import Plan
from jaxmap.runs.planning import ROCK, Costs, costs_of, plan_path, read_site
from jaxmap.types import GridSpec

LEAST_ROCK_M, LEAST_APART_M, IN_VIEW, ROCK_LABEL = 0.3, 3.0, 0.2, 2
RENDERING = ("--frames", 10, "--samples", 4, "--map-cell-m", 0.05)
BASE = MapConfig()
NETWORK = replace(BASE, labeller="deeplab", relief=replace(BASE.relief, combine=False))
SEEN_BY = {
    "plane": replace(BASE, labeller="plane"),
    "network": replace(NETWORK, deeplab=replace(BASE.deeplab, see_relief=False)),
    "relief": replace(BASE, labeller="relief"),
    "ours": BASE,
}


class Truth(NamedTuple):
    """The true ground on the columns of a map, of rocks the large ones alone; and where these are."""

    ground: Ground
    large_rock: np.ndarray


def worlds(folder: Path | None, seeds: list[int], known: list[Path]) -> Iterator[Path]:
    """The folders of all worlds; new ones are rendered."""
    yield from known
    for seed in seeds:
        assert folder is not None, "--seeds needs --worlds"
        world = folder / f"{seed}"
        jaxmap("simulate", "--out", world, "--seed", seed, *RENDERING)
        yield world


def read_truth(gt: Path, grid: GridSpec, plan: Plan) -> Truth:
    """The heights and rocks of a world, sampled at the middle of each column."""
    origin_m, size_m = exact_corner(grid)
    site, crs = plan.sequence.site_origin, plan.sequence.crs
    west, south = site[:2] + origin_m[:2]
    east, north = (west, south) + size_m[:2] * grid.shape[:2]
    place = Extent(float(west), float(south), float(east), float(north), crs)
    heights, labels = read_heights(gt / "dem.tif", place), read_window(gt / "orthomosaic_labels.tif", place)
    x = west + (np.arange(grid.shape[0]) + 0.5) * size_m[0]
    y = south + (np.arange(grid.shape[1]) + 0.5) * size_m[1]
    height_m = sample(heights.height_m, heights.T_crs_pixel, x, y, np.nan) - site[2]
    rock = sample(labels.bands[0].astype(float), labels.T_crs_pixel, x, y, 0) == ROCK_LABEL
    numbered, _ = components(rock)
    diameter_m = np.sqrt(np.bincount(numbered.ravel()) * size_m[0] * size_m[1] * 4 / np.pi)
    large = rock & (diameter_m > LEAST_ROCK_M)[numbered]
    known = np.isfinite(height_m)
    surface = Surface(np.nan_to_num(height_m).astype(np.float32), np.zeros(known.shape, np.float32), known)
    return Truth(Ground(surface, large.astype(np.float32), known), large)


def components(where: np.ndarray) -> tuple[np.ndarray, int]:
    """The connected parts of cells, numbered, corners counting as connections; and how many there are."""
    numbered: Any = label(where, np.ones((3, 3)))
    return numbered


def sample(values: np.ndarray, T_crs_pixel: np.ndarray, x: np.ndarray, y: np.ndarray, outside: float) -> np.ndarray:
    """A raster's pixels at places; x is the first axis."""
    places = np.stack([*np.meshgrid(x, y, indexing="ij"), np.ones((len(x), len(y)))])
    column, row = np.floor(np.einsum("ij,jxy->ixy", np.linalg.inv(T_crs_pixel), places)[:2]).astype(int)
    inside = (row >= 0) & (row < values.shape[0]) & (column >= 0) & (column < values.shape[1])
    clipped = values[row.clip(0, values.shape[0] - 1), column.clip(0, values.shape[1] - 1)]
    return np.where(inside, clipped, outside)


def draw_pairs(truth: Costs, seen: np.ndarray, near_rock: np.ndarray, count: int, seed: int) -> list[np.ndarray]:
    """Pairs of cells, as places (2, 2) of the map's world."""
    free = truth.terrain.drivable & (truth.costs.rock <= ROCK)
    rng, cells = np.random.default_rng(seed), np.argwhere(free & ~near_rock & seen)
    connected, _ = components(truth.terrain.drivable)
    barred, others = [], []
    for _ in range(4000):
        pair = cells[rng.integers(len(cells), size=2)]
        places_m = truth.terrain.centre_of(pair)
        if np.linalg.norm(places_m[1] - places_m[0]) < LEAST_APART_M or np.ptp(connected[tuple(pair.T)]):
            continue
        (barred if near_rock[line(*pair[0], *pair[1])].any() else others).append(places_m)
        if len(barred) == count:
            break
    return [*barred, *others][:count]


def ways(frames: Frames, rover: RoverOptions, world: Traverse) -> tuple[dict[str, Costs], np.ndarray]:
    """What driving costs by each way to see the ground, the truth first; and how far true large rocks are, metres."""
    seen_by: dict[str, Costs] = {}
    plan = frames.plan(BASE)
    truth = read_truth(world.gt, plan.grid, plan)
    for name, config in SEEN_BY.items():
        plan = frames.plan(config)
        voxel_map = fuse(plan, frames.prepared)
        attributes = MapAttributes(plan.sequence.crs, plan.sequence.site_origin)
        reader = in_memory(voxel_map, attributes)
        site, ground = read_site(reader, plan.params.fusion, plan.rule, reader.whole)
        if not seen_by:
            seen_by["truth"] = costs_of(replace(site, rock="rock"), truth.ground, rover)
        if name == "ours":
            blind = ground._replace(rock_probability=np.zeros_like(ground.rock_probability))
            seen_by["hazards"] = costs_of(site, blind, rover)
        else:
            ground = ground._replace(surface=ground.surface._replace(known=np.zeros_like(ground.seen)))
        seen_by[name] = costs_of(site, ground, rover)
    cell_m = seen_by["truth"].terrain.cell_m
    far_m = np.full(truth.large_rock.shape, np.inf)
    if truth.large_rock.any():
        far_m = np.asarray(distance_transform_edt(~truth.large_rock, sampling=tuple(cell_m)))
    # Who knows the truth never touches a large rock, whatever a detour costs.
    terrain = seen_by["truth"].terrain
    free = terrain._replace(drivable=terrain.drivable & (far_m >= rover.radius_m))
    return {**seen_by, "truth": replace(seen_by["truth"], terrain=free)}, far_m


class Tally(NamedTuple):
    """Paths asked for, those not found, those that collide, and how much longer each is than with the truth."""

    asked: int = 0
    refused: int = 0
    collided: int = 0
    longer: tuple[float, ...] = ()

    def __add__(self, other: Any) -> Tally:
        return Tally(*(mine + its for mine, its in zip(self, other, strict=True)))


def scored(costs: Costs, ends: np.ndarray, far_m: np.ndarray, radius_m: float, truth_m: float) -> Tally:
    """Plans one path and scores it."""
    try:
        plan = plan_path(costs, *(ends + costs.site.attributes.site_origin[:2]))
    except JaxmapError:
        return Tally(asked=1, refused=1)
    i, j = costs.terrain.cell_of(plan.places_m).T
    # Within half a column of the radius is rounding.
    collided = (far_m[i, j] < radius_m - costs.terrain.cell_m.max() / 2).any()
    return Tally(1, 0, int(collided), (plan.metrics["length_m"] / truth_m - 1,))


def tallies_of(folder: Path, pairs: int, seed: int, rover: RoverOptions) -> dict[str, Tally]:
    """The tallies of a world."""
    world = Traverse(folder)
    seen_by, far_m = ways(Frames(world.sequence), rover, world)
    in_view = np.asarray(seen_by["ours"].costs.unknown) <= IN_VIEW
    tallies = dict.fromkeys(seen_by, Tally())
    for ends in draw_pairs(seen_by["truth"], in_view, far_m < rover.radius_m + rover.margin_m, pairs, seed):
        site = seen_by["truth"].site.attributes.site_origin[:2]
        truth_m = plan_path(seen_by["truth"], *(ends + site)).metrics["length_m"]
        for name, costs in seen_by.items():
            tallies[name] += scored(costs, ends, far_m, rover.radius_m, truth_m)
    return tallies


def main() -> None:
    """Prints a line for each world, and the table."""
    parser = command_line(__doc__)
    parser.add_argument("--worlds", type=Path, help="folder of rendered worlds")
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--known", type=Path, nargs="*", default=[])
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--rock-cost", type=float, default=RoverOptions().rock_cost, help="of the rover")
    parser.add_argument("--json", type=Path)
    given, sums = parse(parser), dict[str, Tally]()
    rover = replace(RoverOptions(), rock_cost=given.rock_cost)
    for number, folder in enumerate(worlds(given.worlds, given.seeds, given.known)):
        done = folder / f"planning_{rover.rock_cost:g}.json"
        if not done.exists():
            done.write_text(json.dumps(tallies_of(folder, given.pairs, number, rover)))
        tallies = {name: Tally(*tally[:3], tuple(tally[3])) for name, tally in json.loads(done.read_text()).items()}
        sums = {name: sums.get(name, Tally()) + tally for name, tally in tallies.items()}
        told = ", ".join(f"{name} {tally.refused}/{tally.collided}" for name, tally in tallies.items())
        print(f"{folder.name}: {tallies['truth'].asked} pairs; without a path/colliding: {told}", flush=True)
    table = Table(
        {"seen by": "<10", "pairs": "7d", "no path": "9d", "collide": "9d", "mean longer": "13.1%", "worst": "9.1%"}
    )
    for name, tally in sums.items():
        longer = tally.longer or (float("nan"),)
        table.row(name, tally.asked, tally.refused, tally.collided, float(np.mean(longer)), max(longer))
    table.write(given.json)


if __name__ == "__main__":
    main()
