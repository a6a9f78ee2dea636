"""Laws of maps that are fused in regions: the bits of the map in one piece, however it is split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from observed_scenes import CAMERA as scene_camera
from observed_scenes import FARTHEST_M, HEIGHT_PX, VOXEL_M, WIDTH_PX, disparities, poses_along
from same_maps import assert_same_bits

from jaxmap.datasets.base import FrameRef
from jaxmap.errors import FrameError
from jaxmap.fusion.options import FusionOptions
from jaxmap.fusion.params import make_fusion_params
from jaxmap.geometry.bounds import grid_around_views, view_boxes
from jaxmap.geometry.grid import window_shape
from jaxmap.labellers.plane import PlaneOptions, make_plane_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.parts import TileRecord, assemble_map, kept_tiles, part_tiles, read_record, write_part
from jaxmap.mapping.regions import frames_of_tiles, fuse_region, region_shape, regions_of, tile_sources
from jaxmap.mapping.sequence import PreparedFrame
from jaxmap.mapping.step import MapperParams, make_mapper
from jaxmap.mapping.store import load_map
from jaxmap.mapping.tiles import TILE, whole_tiles
from jaxmap.types import Frame, GridSpec, VoxelMap, make_stereo_camera, to_device

CAMERA = make_stereo_camera(**scene_camera, width_px=WIDTH_PX, height_px=HEIGHT_PX)
LABELLER = make_plane_labeller(ROVER_CLASSES, PlaneOptions())
KEY = jax.random.key(3)
OPTIONS = FusionOptions()
RULE = OPTIONS.rule(ROVER_CLASSES)
PARAMS = MapperParams(CAMERA, make_fusion_params(ROVER_CLASSES, OPTIONS), LABELLER.params)
DONE = MapAttributes(progress={"complete": True})


def grid_of(poses: np.ndarray) -> GridSpec:
    return whole_tiles(grid_around_views(CAMERA, poses, FARTHEST_M, VOXEL_M, (1.5, 0.5)))


def frame(disparity_px: np.ndarray, pose: np.ndarray) -> Frame:
    return Frame(to_device(disparity_px), jaxlie.SE3.from_matrix(to_device(pose, np.float32)))


def prepared(index: int, seen: Frame | None) -> PreparedFrame:
    return PreparedFrame(index, FrameRef(f"f{index}", float(index), Path("left"), Path("right")), seen)


def mapper_of(grid: GridSpec, poses: np.ndarray):
    return make_mapper(CAMERA, grid, LABELLER, RULE, (0.3, FARTHEST_M), T_world_camera=poses)


def in_one_piece(seen: np.ndarray, poses: np.ndarray) -> VoxelMap:
    mapper = mapper_of(grid_of(poses), poses)
    voxel_map = mapper.init()
    for disparity_px, pose in zip(seen, poses, strict=True):
        voxel_map, _ = mapper.step(voxel_map, frame(disparity_px, pose), PARAMS, KEY)
    assert voxel_map.surface is not None and voxel_map.surface.any()
    return voxel_map


class InRegions:
    """A run in regions, with frames that are held in memory."""

    def __init__(self, seen: np.ndarray, poses: np.ndarray, names: Sequence[str]) -> None:
        self.seen, self.poses, self.names = seen, poses, names
        self.grid = grid_of(poses)
        self.touching = frames_of_tiles(self.grid, view_boxes(self.grid, CAMERA, poses, FARTHEST_M))
        self.sources = tile_sources(self.touching, names, poses, range(len(names)))

    def map(self, path: Path, shape: tuple[int, int, int], parts: Path, old: Path | None = None) -> int:
        """Writes the map, with what can stay of an old one, and returns how many frames were fused for it."""
        kept = None
        if old is not None and (record := read_record(old)) is not None:
            kept = kept_tiles(old, record, self.sources, self.grid, surface=True)
        left = {tile: frames for tile, frames in self.touching.items() if kept is None or tile not in kept.done}
        mapper = mapper_of(replace(self.grid, shape=shape), self.poses)
        files = {} if kept is None else dict(kept.files)
        regions = regions_of(self.grid, shape, left)
        for number, region in enumerate(regions):
            here = replace(self.grid, first=to_device(np.array(region.first), np.int32), shape=shape)
            frames = (prepared(i, frame(self.seen[i], self.poses[i])) for i in region.frames)
            numbers = {i: i for i in region.frames}
            fused, faults = fuse_region(mapper, ROVER_CLASSES, here, frames, numbers, PARAMS, KEY)
            assert not faults
            write_part(parts / f"{number}", fused, region.tiles, {})
            files |= part_tiles(parts / f"{number}")
        record = TileRecord("run", self.sources, set(), {})
        assemble_map(path, self.grid, ROVER_CLASSES, len(self.names), DONE, files, record, surface=True)
        return sum(len(region.frames) for region in regions)


def scene(seed: int, count: int = 9) -> InRegions:
    rng = np.random.default_rng(seed)
    return InRegions(disparities(rng, count), poses_along(rng, count), [f"f{i}" for i in range(count)])


def shape_of(run: InRegions, tiles: tuple[int, int, int]) -> tuple[int, int, int]:
    """Regions of so many tiles, or of more where the step's window needs them, or of fewer where there are none."""
    window = np.array(window_shape(run.grid, CAMERA, FARTHEST_M, run.poses))
    edges = np.minimum(np.maximum(tiles, -(-window // TILE)), np.array(run.grid.shape) // TILE)
    x, y, z = (edges * TILE).tolist()
    return x, y, z


@pytest.mark.slow
@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), tiles=st.tuples(st.integers(1, 3), st.integers(1, 3), st.integers(1, 2)))
def test_regions_of_any_size_give_the_bits_of_the_map_in_one_piece(tmp_path_factory, seed, tiles):
    folder, run = tmp_path_factory.mktemp("regions"), scene(seed)
    run.map(folder / "map.zarr", shape_of(run, tiles), folder / "parts")
    found, _ = load_map(folder / "map.zarr")
    assert_same_bits(found, in_one_piece(run.seen, run.poses))
    assert int(found.frames_fused) == len(run.names)


@pytest.mark.slow
@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), moved=st.sets(st.integers(0, 13), max_size=3), size_m=st.floats(0, 4))
def test_corrected_poses_give_the_bits_of_mapping_anew(tmp_path_factory, seed, moved, size_m):
    folder, run = tmp_path_factory.mktemp("poses"), scene(seed, 14)
    shape = shape_of(run, (2, 2, 1))
    all_fused = run.map(folder / "old.zarr", shape, folder / "old")
    rng, poses = np.random.default_rng(seed + 1), run.poses.copy()
    for index in moved:
        poses[index, :3, 3] += rng.normal(0, size_m, 3) * [1, 1, 0.05]
    again = InRegions(run.seen, poses, run.names)
    shape = shape_of(again, (2, 2, 1))
    fused = again.map(folder / "new.zarr", shape, folder / "new", old=folder / "old.zarr")
    again.map(folder / "anew.zarr", shape, folder / "anew")
    assert_same_bits(load_map(folder / "new.zarr")[0], load_map(folder / "anew.zarr")[0])
    if not moved:
        assert not fused
    elif len(moved) == 1 and size_m < 0.1 and again.grid.shape == run.grid.shape:
        assert fused <= all_fused


@pytest.mark.slow
@pytest.mark.parametrize("array", ["log_odds", "surface"])
def test_tiles_that_are_damaged_or_missing_are_named_and_fused_again(tmp_path, array):
    run = scene(5)
    shape = shape_of(run, (2, 2, 1))
    run.map(tmp_path / "old.zarr", shape, tmp_path / "old")
    files = sorted((tmp_path / "old.zarr" / array / "c" / "0").rglob("*"))
    files = [file for file in files if file.is_file()]
    files[0].write_bytes(files[0].read_bytes()[:-9])
    files[1].unlink()
    record = read_record(tmp_path / "old.zarr")
    assert record is not None
    kept = kept_tiles(tmp_path / "old.zarr", record, run.sources, run.grid, surface=True)
    assert sorted(kept.lost.values()) == ["is damaged", "is missing"]
    assert not kept_tiles(tmp_path / "old.zarr", record, run.sources, run.grid, surface=False).done
    run.map(tmp_path / "new.zarr", shape, tmp_path / "new", old=tmp_path / "old.zarr")
    assert_same_bits(load_map(tmp_path / "new.zarr")[0], in_one_piece(run.seen, run.poses))


def test_every_tile_that_a_frame_touches_is_in_one_region_with_all_its_frames():
    run = scene(1, 30)
    for tiles in ((1, 1, 1), (3, 2, 1), (100, 1, 1)):
        shape = shape_of(run, tiles)
        regions = regions_of(run.grid, shape, run.touching)
        owned = [tile for region in regions for tile in region.tiles]
        assert len(owned) == len(set(owned))
        assert set(owned) == run.touching.keys()
        for region in regions:
            low = (np.array(region.first) - np.asarray(run.grid.first)) // TILE
            assert (low >= 0).all()
            assert (np.array(region.first) + shape <= np.asarray(run.grid.first) + run.grid.shape).all()
            assert list(region.frames) == sorted(region.frames)
            for tile in region.tiles:
                inside = np.array(tile) * TILE - region.first
                assert (inside >= 0).all()
                assert (inside + TILE <= shape).all()
                assert set(run.touching[tile]) <= set(region.frames)


def test_workers_share_regions_that_hold_the_window_and_fit_the_memory():
    run = scene(2, 60)
    window = window_shape(run.grid, CAMERA, FARTHEST_M, run.poses)
    one, four = (region_shape(run.grid, window, 4, 2**31, run.touching, workers) for workers in (1, 4))
    assert one == run.grid.shape
    assert four is not None
    assert (np.array(four) >= window).all()
    assert len(regions_of(run.grid, four, run.touching)) > 1
    assert region_shape(run.grid, window, 4, 1e5, run.touching, 2) is None


def test_a_frame_that_cannot_be_read_is_told_and_nothing_else(tmp_path):
    run = scene(4, 2)
    mapper = mapper_of(run.grid, run.poses)
    fault = FrameError("it is damaged")
    frames = [replace(prepared(0, None), fault=fault), prepared(1, frame(run.seen[1], run.poses[1]))]
    fused, faults = fuse_region(mapper, ROVER_CLASSES, run.grid, frames, {0: 0, 1: 1}, PARAMS, KEY)
    assert faults == {0: fault}
    assert not fused.log_odds.any()
