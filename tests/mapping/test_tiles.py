"""Laws of maps larger than memory: tiles on disk, the block that moves, commits that are cut off."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from same_maps import assert_same_bits

from jaxmap.errors import JaxmapError
from jaxmap.fusion.surface import add_heights, gather_heights
from jaxmap.geometry.bounds import site_lattice, view_boxes
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.store import load_map, open_map, save_map
from jaxmap.mapping.tile_arrays import TileValues
from jaxmap.mapping.tiles import TILE, MovingBlock, TileStore, block_shape, tiles_of, whole_tiles
from jaxmap.types import VoxelMap, make_grid, make_stereo_camera, make_voxel_map, to_device

CLASSES = ("sand", "rock")
GRID = whole_tiles(make_grid([-7, 3, -1], [12, 20, 2], (0.1, 0.1, 0.2), np.zeros(3)))
DONE = MapAttributes(progress={"complete": True})


def random_tile(rng: np.random.Generator) -> TileValues:
    """A tile with evidence, and heights in some of its columns."""
    heights = rng.normal(size=(4, *TILE[:2], 1)) * (rng.random(TILE[:2]) < 0.5)[None, ..., None]
    return TileValues(rng.normal(size=(3, *TILE)).astype(np.float32), heights.astype(np.float32))


def same(found: TileValues | None, expected: TileValues) -> None:
    assert found is not None
    for name, values in expected._asdict().items():
        np.testing.assert_array_equal(getattr(found, name), values)


def store_at(path: Path) -> TileStore:
    return TileStore(path, GRID, CLASSES, surface=True)


def test_tiles_read_back_before_and_after_the_commit_and_the_map_is_a_map(tmp_path):
    store, tile = store_at(tmp_path / "map.zarr"), random_tile(np.random.default_rng(0))
    store.write((1, 2, 0), tile)
    same(store.read((1, 2, 0)), tile)
    assert store.read((0, 0, 0)) is None
    store.commit(7, DONE)
    same(store_at(store.path).read((1, 2, 0)), tile)
    whole, _ = load_map(store.path)
    assert int(whole.frames_fused) == 7
    for values, expected in ((whole.log_odds[..., :16], tile.log_odds), (whole.surface[..., :1], tile.surface)):
        np.testing.assert_array_equal(values[:, 64:128, 128:192], expected)
    assert np.count_nonzero(whole.log_odds) == np.count_nonzero(tile.log_odds)
    assert np.count_nonzero(whole.surface) == np.count_nonzero(tile.surface)


def test_what_was_not_committed_is_not_there(tmp_path):
    store, rng = store_at(tmp_path / "map.zarr"), np.random.default_rng(0)
    first = random_tile(rng)
    store.write((0, 0, 0), first)
    store.commit(1, DONE)
    store.write((0, 0, 0), random_tile(rng))
    store.write((1, 1, 1), random_tile(rng))
    again = store_at(store.path)
    same(again.read((0, 0, 0)), first)
    assert again.tiles() == {(0, 0, 0)}


@pytest.mark.parametrize("steps", range(12))
def test_a_commit_that_is_cut_off_anywhere_is_carried_out_or_undone(tmp_path, monkeypatch, steps):
    store, rng = store_at(tmp_path / "map.zarr"), np.random.default_rng(0)
    old, new = ([random_tile(rng) for _ in range(2)] for _ in range(2))
    for index, tile in enumerate(old):
        store.write((index, 0, 0), tile)
    store.commit(1, DONE)
    for index, tile in enumerate(new):
        store.write((index, 0, 0), tile)
    store.write((1, 0, 0), store.empty())
    left, replacing, unlinking = [steps], os.replace, os.unlink

    def cut_off(name, function):
        def counted(*words, **options):
            if not left[0]:
                raise OSError(errno.EIO, name)
            left[0] -= 1
            return function(*words, **options)

        return counted

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", cut_off("replace", replacing))
        patch.setattr(Path, "unlink", cut_off("unlink", lambda self, **_: unlinking(self) if self.exists() else None))
        with suppress(JaxmapError):
            store.commit(2, DONE)
    again = store_at(store.path)
    count = open_map(store.path).frames_fused
    expected = {1: {(0, 0, 0): old[0], (1, 0, 0): old[1]}, 2: {(0, 0, 0): new[0]}}[count]
    assert again.tiles() == expected.keys()
    for index, tile in expected.items():
        same(again.read(index), tile)
    load_map(store.path)


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_a_block_that_moves_gives_the_map_of_the_whole_grid(tmp_path_factory, seed):
    rng, path = np.random.default_rng(seed), tmp_path_factory.mktemp("moves") / "map.zarr"
    window = (40, 70, 9)
    shape = block_shape(GRID, window, 3, 3 * 4 * 3 * 13 * np.prod(TILE))
    assert shape is not None
    assert np.prod(shape) < np.prod(GRID.shape)
    block = MovingBlock(store_at(path), shape)
    here, dense = block.begin(0), np.zeros((3, *GRID.shape), np.float32)
    whole = make_voxel_map(GRID, CLASSES, surface=True)
    for number in range(6):
        start = np.array([rng.integers(0, size - n + 1) for size, n in zip(GRID.shape, window, strict=True)])
        box = np.asarray(GRID.first) + np.stack([start, start + window])
        added = rng.normal(size=(3, *window)).astype(np.float32)
        here = block.cover(here, box)
        assert (box[0] >= np.asarray(here.grid.first)).all()
        assert (box[1] <= np.asarray(here.grid.first) + here.grid.shape).all()
        low = box[0] - np.asarray(here.grid.first)
        inside = tuple(slice(a, a + n) for a, n in zip(low, window, strict=True))
        here = replace(here, log_odds=here.log_odds.at[(slice(None), *inside)].add(added))
        points = (box[0] + rng.random((500, 3)) * window) * [0.1, 0.1, 0.2]
        here, whole = with_points(here, points, box), with_points(whole, points, box)
        dense[(slice(None), *(slice(a, a + n) for a, n in zip(start, window, strict=True)))] += added
        if number == 3:
            block.write_changes(here)
            block.store.commit(number, DONE)
    block.write_changes(here)
    block.store.commit(6, DONE)
    assert_same_bits(load_map(path)[0], replace(whole, log_odds=dense))


def with_points(voxel_map: VoxelMap, points: np.ndarray, box: np.ndarray) -> VoxelMap:
    """The map with the heights of points that lie in a box of voxels."""
    x, y, z = (box[1] - box[0]).tolist()
    window = replace(GRID, first=to_device(box[0], np.int32), shape=(x, y, z))
    sigma_m, keep = to_device(np.full(len(points), 0.02)), to_device(np.ones(len(points), bool), bool)
    heights = gather_heights(voxel_map.grid, window, to_device(points, np.float32), sigma_m, keep)
    return replace(voxel_map, surface=add_heights(voxel_map, heights, window))


@pytest.mark.parametrize("margin", [0, 3])
def test_the_blocks_of_a_stored_map_are_the_map(tmp_path, margin):
    rng, path = np.random.default_rng(1), tmp_path / "map.zarr"
    grid = make_grid([-7, 3, -1], [9, 20, 2], (0.1, 0.1, 0.2), np.zeros(3))
    values = rng.normal(size=(3, *grid.shape)).astype(np.float32)
    values[:, :64, :64] = 0
    saved = replace(make_voxel_map(grid, CLASSES), log_odds=values)
    save_map(path, saved, DONE)
    found = np.zeros_like(values)
    for block in open_map(path).blocks(margin):
        part = np.asarray(block.voxel_map.log_odds)
        own = part[:, block.own[0], block.own[1]]
        x, y = block.corner
        found[:, x : x + own.shape[1], y : y + own.shape[2]] += own
        first = np.asarray(block.voxel_map.grid.first) - np.asarray(grid.first)
        around = tuple(slice(a, a + n) for a, n in zip(first, part.shape[1:], strict=True))
        np.testing.assert_array_equal(part, values[(slice(None), *around)])
    np.testing.assert_array_equal(found, values)


def test_a_damaged_tile_is_named(tmp_path):
    store = store_at(tmp_path / "map.zarr")
    store.write((1, 2, 0), random_tile(np.random.default_rng(0)))
    store.commit(1, DONE)
    file = store.path / "log_odds" / "c" / "0" / "1" / "2" / "0"
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(JaxmapError, match="damaged, at or beside tile 1 2"):
        list(open_map(store.path).blocks())


def test_a_map_of_another_form_is_not_written_over(tmp_path):
    store_at(tmp_path / "map.zarr").commit(1, DONE)
    with pytest.raises(JaxmapError, match="the run needs"):
        TileStore(tmp_path / "map.zarr", replace(GRID, shape=(64, 64, 16)), CLASSES, surface=True)
    with pytest.raises(JaxmapError, match="the run needs .* without heights"):
        TileStore(tmp_path / "map.zarr", GRID, CLASSES)


@given(
    st.tuples(*[st.floats(-6e6, 6e6)] * 3),
    st.tuples(*[st.floats(-6e6, 6e6)] * 3),
    st.sampled_from([0.05, 0.2, 0.03, (0.05, 0.05, 0.2)]),
)
def test_sites_of_one_system_share_their_voxels(one_m, other_m, size_m):
    size = np.broadcast_to(size_m, 3)
    corners = [site + site_lattice(np.array(site), size_m) for site in (one_m, other_m)]
    apart = (corners[0] - corners[1]) / size
    assert np.abs(apart - np.round(apart)).max() < 1e-4
    assert np.abs(site_lattice(np.array(one_m), size_m) / size).max() <= 0.5 + 1e-6


def test_a_box_holds_the_tiles_that_it_touches():
    first = np.asarray(GRID.first)
    assert set(tiles_of(GRID, first + np.array([[63, 0, 0], [65, 1, 1]]))) == {(0, 0, 0), (1, 0, 0)}
    assert not set(tiles_of(GRID, np.stack([first, first])))
    assert not set(tiles_of(GRID, np.stack([first - 9, first - 3])))


def test_boxes_of_views_hold_their_corners_and_stay_in_the_grid():
    camera = make_stereo_camera(fx_px=30, cx_px=15.5, cy_px=11.5, baseline_m=0.2, width_px=32, height_px=24)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 1e3
    near, far = view_boxes(GRID, camera, poses, 5.0)
    assert (near[1] > near[0]).all()
    assert (far[0] == far[1]).any()
    low, high = np.asarray(GRID.first), np.asarray(GRID.first) + GRID.shape
    for box in (near, far):
        assert (box >= low).all()
        assert (box <= high).all()


def test_no_block_fits_too_small_a_limit():
    assert block_shape(GRID, (40, 70, 9), 3, 1e5) is None
