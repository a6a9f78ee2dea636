"""The map of a run while it is made: begun or gone on with, saved on the way, finished; whole, or in tiles on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxmap.ensemble.layer import named_layers
from jaxmap.errors import JaxmapError
from jaxmap.geometry.bounds import view_boxes
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.store import MapReader, holds_map, in_memory, load_map, open_map, save_map
from jaxmap.mapping.tiles import MovingBlock, TileStore
from jaxmap.planning.ground import keeps_layers, map_layers
from jaxmap.runs.hazard_layers import add_hazards
from jaxmap.runs.log import RunLog
from jaxmap.runs.mapping_plan import Plan
from jaxmap.types import VoxelMap


class WholeMap:
    """A map that is in memory as a whole, and saved as a whole."""

    def __init__(self, plan: Plan, path: Path) -> None:
        self.plan, self.path = plan, path

    def begin(self) -> tuple[VoxelMap, RunLog]:
        """An empty map, or that of an interrupted run, and its log."""
        if not holds_map(self.path):
            return self.plan.mapper.init(), RunLog()
        voxel_map, attributes = load_map(self.path, members=True)
        log = RunLog.from_json(attributes.progress, self.path)
        _check_same(self.plan, voxel_map, log, self.path)
        return voxel_map, log

    def cover(self, voxel_map: VoxelMap, indices: Sequence[int]) -> VoxelMap:
        """It holds the view of any frame."""
        return voxel_map

    def save(self, voxel_map: VoxelMap, attributes: MapAttributes) -> None:
        """Writes the map."""
        save_map(self.path, voxel_map, attributes)

    def finish(self, voxel_map: VoxelMap, attributes: MapAttributes) -> MapReader:
        """Writes the map for good, and opens it."""
        self.save(voxel_map, attributes)
        return in_memory(voxel_map, attributes)


class TiledMap:
    """A map larger than memory, of which a block moves along with the views."""

    def __init__(self, plan: Plan, path: Path) -> None:
        assert plan.block_shape is not None
        self.plan, self.path = plan, path
        store = TileStore(path, plan.grid, plan.labeller.classes, surface=plan.rule.surface)
        self.block = MovingBlock(store, plan.block_shape)
        poses = plan.sequence.T_world_camera @ plan.front_end.T_raw_rectified
        self.boxes = view_boxes(plan.grid, plan.front_end.camera, poses, plan.depth_range_m[1])

    def begin(self) -> tuple[VoxelMap, RunLog]:
        """An empty block, or one of the map of an interrupted run, and its log."""
        stored = open_map(self.path)
        log = RunLog.from_json(stored.attributes.progress, self.path)
        voxel_map = self.block.begin(stored.frames_fused)
        _check_same(self.plan, replace(voxel_map, grid=stored.grid), log, self.path)
        return voxel_map, log

    def cover(self, voxel_map: VoxelMap, indices: Sequence[int]) -> VoxelMap:
        """The block, where it holds the views of frames."""
        return self.block.cover(voxel_map, self.boxes[list(indices)])

    def save(self, voxel_map: VoxelMap, attributes: MapAttributes) -> None:
        """Writes the tiles that have changed, and the attributes, all at once."""
        self.block.write_changes(voxel_map)
        self.block.store.commit(int(voxel_map.frames_fused), attributes)

    def finish(self, voxel_map: VoxelMap, attributes: MapAttributes) -> MapReader:
        """Writes the map for good, and opens it, which lists its tiles: seconds where they are many."""
        self.save(voxel_map, attributes)
        self.block.store.close()
        return add_hazards(self.path, self.plan.rover)


def _check_same(plan: Plan, voxel_map: VoxelMap, log: RunLog, where: Path) -> None:
    """Checks that an interrupted run can go on.

    Raises:
        JaxmapError: the sequence has changed since, so that the run cannot go on as if it had not.
    """
    done = log.next_index
    same_frames = not done or (done <= len(plan.sequence.frames) and log.digest == plan.digest(done))
    # A sequence that has grown since goes on where it ended.
    log.complete = log.complete and log.next_index == len(plan.sequence.frames)
    same_grid = (
        voxel_map.grid.shape == plan.grid.shape
        and voxel_map.classes == plan.labeller.classes
        and np.array_equal(voxel_map.grid.lattice_m, plan.grid.lattice_m)
        and np.array_equal(voxel_map.grid.first, plan.grid.first)
        and np.array_equal(voxel_map.grid.voxel_size_m, plan.grid.voxel_size_m)
        and (0 if voxel_map.members is None else len(voxel_map.members)) == plan.members
    )
    if not (same_frames and same_grid):
        raise JaxmapError(
            f"the {'bounds of the map' if same_frames else 'frames, poses or camera'} are not those of the run so far",
            where=where.parent,
            fix="bring the sequence back as it was, or map it anew with --overwrite",
        )


def map_attributes(plan: Plan, log: RunLog, voxel_map: VoxelMap | None = None) -> MapAttributes:
    """What is stored beside the map, which is looked at where it has an ensemble."""
    log.digest = plan.digest(log.next_index)
    layers = {} if voxel_map is None else named_layers(voxel_map, plan.params.fusion, plan.rule)
    attributes = MapAttributes(
        crs=plan.sequence.crs,
        site_origin=plan.sequence.site_origin,
        T_world_source=plan.sequence.T_world_source,
        fusion=plan.fusion,
        progress=log.as_json(),
        layers=layers,
    )
    # Those of a part of a larger map would be no map's (`add_hazards`).
    if log.complete and plan.block_shape is None and voxel_map is not None:
        reader = in_memory(voxel_map, attributes)
        if keeps_layers(reader, plan.rover):
            layers |= map_layers(reader, plan.params.fusion, plan.rover, reader.whole)
    return attributes
