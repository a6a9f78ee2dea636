"""Plans of a run: files read back by other programs, and what is refused, with the nearest place that is not."""

from __future__ import annotations

import csv
import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from truth_files import CRS, SITE, write_map

from jaxmap.commands import plan
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.mapping.store import load_map, save_map
from jaxmap.planning.options import RoverOptions
from jaxmap.runs.planning import PLAN_FILES, ROVER_SETTINGS, plan_path, read_costs

pytestmark = pytest.mark.slow
SHAPE, VOXEL_M = (60, 50), 0.1
EAST, NORTH = SITE[:2]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Level ground with a wall of rock that leaves a passage in the north, and ground not seen in the east."""
    rock, observed = np.zeros(SHAPE, bool), np.ones(SHAPE, bool)
    rock[28:32, :30] = True
    observed[54:] = False
    folder = write_map(tmp_path_factory.mktemp("plan") / "run", rock, observed, voxel_m=VOXEL_M)
    voxel_map, attributes = load_map(folder / "map.zarr")
    save_map(folder / "map.zarr", replace(voxel_map, log_odds=3 * voxel_map.log_odds), attributes)
    return folder


def place(east_m: float, north_m: float) -> tuple[float, float]:
    return float(EAST + east_m), float(NORTH + north_m)


def test_a_plan_goes_around_rock_and_its_files_agree(run, tmp_path, capsys):
    start, goal = place(1.0, 1.0), place(4.5, 1.0)
    assert plan.main([str(run), "--start", *map(str, start), "--goal", *map(str, goal), "--out", str(tmp_path)]) == 0
    assert f"wrote {tmp_path}/: {', '.join(PLAN_FILES)}" in capsys.readouterr().out
    metrics = json.loads((tmp_path / "plan.json").read_text())
    assert metrics["length_m"] > 5 and metrics["straight_m"] == 3.5
    assert metrics["least_clearance_m"] > 0 and metrics["greatest_rock_probability"] < 0.5

    tree = json.loads((tmp_path / "plan.geojson").read_text())
    assert tree["crs"]["properties"]["name"] == f"urn:ogc:def:crs:{CRS.replace(':', '::')}"
    corners = np.array(tree["features"][0]["geometry"]["coordinates"])
    np.testing.assert_allclose([corners[0], corners[-1]], [start, goal], atol=VOXEL_M)
    length_m = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
    np.testing.assert_allclose(length_m, metrics["length_m"], atol=1e-2)

    with (tmp_path / "plan.csv").open() as file:
        rows = list(csv.DictReader(file))
    np.testing.assert_allclose(float(rows[-1]["distance_m"]), metrics["length_m"], atol=1e-2)
    with rasterio.open(tmp_path / "plan.tif") as raster:
        assert raster.crs == CRS
        cost, drivable = (raster.read(raster.descriptions.index(name) + 1) for name in ("cost", "drivable"))
        for row in rows:
            east_m, north_m = float(row["east_m"]), float(row["north_m"])
            at = raster.index(east_m, north_m)
            assert drivable[at] == 1
            columns = np.array([east_m - EAST, north_m - NORTH]) / VOXEL_M
            # On the edge of a column, the raster's reader takes the other one.
            if (np.abs(columns - columns.round()) > 1e-3).all():
                np.testing.assert_allclose(cost[at], float(row["cost"]), atol=1e-3)
    assert (tmp_path / "plan.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("start", "says"),
    [
        ((-5.0, 1.0), "lies outside the map"),
        ((3.0, 1.0), "is in a rock, or within 0.55 m of one"),
        ((5.9, 2.5), "lies on ground not seen"),
    ],
)
def test_a_start_where_no_rover_can_be_names_the_nearest_free_place(run, start, says):
    costs = read_costs(run, RoverOptions())
    with pytest.raises(UsageError, match=says) as caught:
        plan_path(costs, np.array(place(*start)), np.array(place(4.5, 4.0)))
    assert "start" in caught.value.what and "the nearest free place is" in caught.value.fix
    named = np.array([float(word) for word in caught.value.fix.split()[-2:]])
    i, j = costs.terrain.cell_of(named - SITE[:2])
    assert costs.terrain.drivable[i, j]


def test_a_goal_that_cannot_be_reached_names_the_nearest_place_that_can(run):
    costs = read_costs(run, RoverOptions())
    walled = costs.terrain.drivable.copy()
    walled[40] = False
    costs = replace(costs, terrain=costs.terrain._replace(drivable=walled))
    with pytest.raises(JaxmapError, match="cannot be reached") as caught:
        plan_path(costs, np.array(place(1.0, 1.0)), np.array(place(4.7, 2.0)))
    assert "the nearest place to it that can is" in caught.value.fix


def test_a_map_too_coarse_for_the_rover_is_refused(run):
    with pytest.raises(JaxmapError, match="smaller than the rover"):
        read_costs(run, RoverOptions(radius_m=0.13, wheel_m=0.05))


def test_the_rovers_that_come_along_load():
    assert ROVER_SETTINGS.load("katwijk") == RoverOptions()
    with pytest.raises(UsageError, match="give a YAML file or one of: katwijk"):
        ROVER_SETTINGS.load("no_such_rover")


def test_a_path_between_blocked_corners_has_a_cost(run):
    costs, planned = read_costs(run, RoverOptions()), 0
    for seed in range(8):
        drivable = costs.terrain.drivable & (np.random.default_rng(seed).random(costs.terrain.drivable.shape) < 0.8)
        for end in (place(1.0, 1.0), place(4.5, 4.0)):
            drivable[tuple(costs.terrain.cell_of(np.array(end) - SITE[:2]))] = True
        with suppress(JaxmapError):
            walled = replace(costs, terrain=costs.terrain._replace(drivable=drivable))
            assert np.isfinite(plan_path(walled, np.array(place(1.0, 1.0)), np.array(place(4.5, 4.0))).metrics["cost"])
            planned += 1
    assert planned > 2
