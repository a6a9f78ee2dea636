"""Laws of merging: the sum of maps is the map of all, wherever each begins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.errors import UsageError
from jaxmap.fusion.surface import combine, gather_heights, over_layers
from jaxmap.geometry.bounds import site_lattice
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.merge import add_maps, check_alike, common_grid
from jaxmap.mapping.store import MapReader, in_memory, load_map, open_map, save_map
from jaxmap.mapping.tiles import TileStore
from jaxmap.types import VoxelMap, make_grid, make_voxel_map, to_device

CLASSES, SIZE_M = ("sand", "rock"), (0.1, 0.1, 0.2)
SITES = (np.array([4000.03, 250.0, 12.1]), np.array([4003.37, 246.91, 11.3]))
ATTRIBUTES = MapAttributes(crs="EPSG:32631", fusion={"hit": 0.7})


def session(rng: np.random.Generator, site: np.ndarray, shape_m=(9, 8, 1)):
    """A map about a site of its own, with evidence in some of its voxels."""
    corner_m = rng.uniform(-3, 3, 3)
    grid = make_grid(corner_m, corner_m + shape_m, SIZE_M, site_lattice(site, SIZE_M))
    values = rng.normal(size=(3, *grid.shape)).astype(np.float32) * (rng.random(grid.shape) > 0.7)
    count = to_device(int(rng.integers(1, 9)), np.int32)
    points = to_device(corner_m + rng.random((4000, 3)) * shape_m, np.float32)
    heights = gather_heights(grid, grid, points, to_device(np.full(4000, 0.02)), to_device(np.ones(4000, bool), bool))
    voxel_map = replace(make_voxel_map(grid, CLASSES), log_odds=values, frames_fused=count, surface=heights)
    return voxel_map, replace(ATTRIBUTES, site_origin=site)


def merged(path: Path, maps: list[MapReader]):
    names = [f"map {index}" for index in range(len(maps))]
    check_alike(maps, names)
    grid, shifts = common_grid(maps, names)
    store = TileStore(path, grid, maps[0].classes, surface=all(one.surface for one in maps))
    add_maps(maps, shifts, store)
    store.commit(sum(one.frames_fused for one in maps), maps[0].attributes)
    store.close()
    return load_map(path)[0]


def where(voxel_map, site: np.ndarray, lattice_m: np.ndarray) -> tuple[slice, ...]:
    """The slices of a map in another whose corner lies there in the system."""
    corner_m = site + np.asarray(voxel_map.grid.origin_m, np.float64)
    first = np.round((corner_m - lattice_m) / SIZE_M).astype(int)
    return tuple(slice(a, a + n) for a, n in zip(first, voxel_map.grid.shape, strict=True))


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_the_sum_holds_each_map_in_its_place(tmp_path_factory, seed):
    rng, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("merge")
    sessions = [session(rng, site) for site in SITES]
    for index, one in enumerate(sessions):
        save_map(folder / f"{index}.zarr", *one)
    whole = merged(folder / "map.zarr", [open_map(folder / f"{index}.zarr") for index in range(2)])
    expected = np.zeros(whole.log_odds.shape, np.float32)
    seen = np.zeros(expected.shape, int)
    corner_m = SITES[0] + np.asarray(whole.grid.origin_m, np.float64)
    for (voxel_map, _), site in zip(sessions, SITES, strict=True):
        part = (slice(None), *where(voxel_map, site, corner_m))
        expected[part] += voxel_map.log_odds
        seen[part] += np.asarray(voxel_map.log_odds) != 0
    np.testing.assert_array_equal(whole.log_odds, expected)
    check_heights(whole, sessions, corner_m)
    assert np.count_nonzero(expected) == np.count_nonzero(seen)
    assert int(whole.frames_fused) == sum(int(voxel_map.frames_fused) for voxel_map, _ in sessions)


def check_heights(whole: VoxelMap, sessions, corner_m: np.ndarray) -> None:
    """Columns of the sum hold the statistics of all, about the first site's origin."""
    found = np.asarray(over_layers(whole.surface))
    expected = np.zeros(found.shape, np.float32)
    for voxel_map, attributes in sessions:
        own = np.array(over_layers(voxel_map.surface))
        own[2] += np.where(own[1] > 0, attributes.site_origin[2] - SITES[0][2], 0)
        part = (slice(None), *where(voxel_map, attributes.site_origin, corner_m)[:2])
        expected[part] = combine(expected[part], own)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-6)
    np.testing.assert_allclose(found[2], expected[2], atol=1e-5)
    np.testing.assert_allclose(found[3], expected[3], rtol=1e-3, atol=1e-2)


def test_a_merged_map_can_be_merged_again_in_any_order(tmp_path):
    rng = np.random.default_rng(0)
    maps = [in_memory(*session(rng, site)) for site in (*SITES, SITES[0])]
    merged(tmp_path / "a.zarr", maps[:2])
    one = merged(tmp_path / "b.zarr", [open_map(tmp_path / "a.zarr"), maps[2]])
    other = merged(tmp_path / "c.zarr", [maps[0], maps[2], maps[1]])
    np.testing.assert_array_equal(one.grid.first, other.grid.first)
    np.testing.assert_allclose(one.log_odds, other.log_odds, atol=1e-5)
    np.testing.assert_allclose(over_layers(one.surface)[:3], over_layers(other.surface)[:3], rtol=1e-5, atol=1e-5)


def changed(one: MapReader, **attributes) -> MapReader:
    return replace(one, attributes=replace(one.attributes, **attributes))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(crs=None), "not to be added to map 0: CRS is None, not EPSG:32631"),
        (dict(fusion={"hit": 0.8}), "fusion.hit is 0.8, not 0.7"),
        (dict(fusion={}), "fusion.hit is None, not 0.7"),
        (dict(site_origin=SITES[0] + [0.05, 0, 0]), r"the lattice is \[-?0.5, 0.0, 0.0\] of a voxel off that of map 0"),
        (dict(site_origin=SITES[0] + [0.03, 0, 0.02]), r"the lattice is \[0.3, 0.0, 0.1\] of a voxel off"),
        (dict(site_origin=SITES[0] + 1e7), "voxels from the first site's origin"),
        (dict(progress={"digest": "a1"}), "frames of map 0 would count twice"),
    ],
)
def test_maps_that_do_not_go_together_are_refused_with_the_reason(tmp_path, change, says):
    voxel_map, attributes = session(np.random.default_rng(0), SITES[0])
    one = in_memory(voxel_map, replace(attributes, progress={"digests": ["b2", "a1"]}))
    with pytest.raises(UsageError, match=says):
        merged(tmp_path / "map.zarr", [one, changed(in_memory(voxel_map, attributes), **change)])


def test_other_classes_and_voxels_are_refused(tmp_path):
    voxel_map, attributes = session(np.random.default_rng(0), SITES[0])
    one = in_memory(voxel_map, attributes)
    grid = make_grid([0, 0, 0], [1, 1, 1], 0.1, np.zeros(3))
    others = [replace(voxel_map, classes=("rock", "sand")), make_voxel_map(grid, CLASSES)]
    for other, says in zip(others, ("classes is .*rock.*, not", r"voxel size is .*0\.10"), strict=True):
        with pytest.raises(UsageError, match=says):
            check_alike([one, in_memory(other, attributes)], ["map 0", "map 1"])
