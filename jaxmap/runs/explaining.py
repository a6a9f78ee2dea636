"""`jaxmap explain`: the frames and pixels that made a place of a map what it is."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams, stored_fusion
from jaxmap.fusion.query import TopDown, occupied
from jaxmap.geometry.bounds import view_boxes
from jaxmap.geometry.grid import exact_corner
from jaxmap.host.bounded_text import read_yaml
from jaxmap.mapping.columns import log_odds_of, nearest_observed, part_of, top_down_of
from jaxmap.mapping.explain import Contribution, make_explainer
from jaxmap.mapping.sequence import PreparedFrame, prepare_frames
from jaxmap.mapping.store import Columns, MapReader, open_map
from jaxmap.report.explain_page import Explanation, FramePart
from jaxmap.runs.config import CHOSEN_ANEW, MapConfig, load_config
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.labelling import Notify
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.types import VoxelMap, pinhole, to_device

_MOST_APART = 1e-3
"""Sums of evidence that differ by more than this are not of the same frames, labels or numbers."""


@dataclass(frozen=True)
class Cell:
    """A place of a stored map.

    Attributes:
        reader: the map.
        within: its columns.
        log_odds: the evidence of those.
        top: the top-down map of them.
        deciding: which voxels the top-down map reads, by channel: the occupied ones, or of each class the one with
            the greatest evidence (`FusionRule.column`); where none is occupied, all that were observed.
        params: of fusion.
        rule: of fusion.
    """

    reader: MapReader
    within: Columns
    log_odds: Float[np.ndarray, "K X Y Z"]
    top: TopDown
    deciding: Bool[np.ndarray, "K X Y Z"]
    params: FusionParams
    rule: FusionRule

    @property
    def columns(self) -> int:
        """How many of its columns were observed."""
        return int(self.deciding[0].any(axis=-1).sum())

    def read(self, log_odds: Float[np.ndarray, "K X Y Z"]) -> Float[np.ndarray, "K"]:
        """Evidence as the top-down map reads it, the mean of the columns."""
        return np.where(self.deciding, log_odds, 0.0).sum(axis=(1, 2, 3), dtype=np.float64) / self.columns


def find_cell(run: Path, at: tuple[float, float], radius_m: float | None = None) -> Cell:
    """The columns of a run's map at a place, in the map's system.

    Args:
        run: the run folder.
        at: east and north; x and y where the map has no system.
        radius_m: all columns whose centres are so near along both axes; only the one at the place without it.

    Raises:
        JaxmapError: there is no map, or it is damaged.
        UsageError: the place lies outside the map, or nothing was observed there; the nearest observed one is named.
    """
    folder = RunFolder(run)
    if not run.is_dir():
        raise JaxmapError("no such run folder", where=run, fix="give a folder that `jaxmap map` wrote")
    folder.settle_for_reading()
    reader = open_map(folder.map)
    corner_m, size_m = (numbers[:2] for numbers in exact_corner(reader.grid))
    column = (np.array(at) - np.asarray(reader.attributes.site_origin)[:2] - corner_m) / size_m
    reach = np.zeros(2) if radius_m is None else radius_m / size_m
    first = np.floor(column) if radius_m is None else np.ceil(column - reach - 0.5)
    last = np.floor(column) + 1 if radius_m is None else np.floor(column + reach - 0.5) + 1
    last = np.maximum(last, first + 1)
    first, last = first.clip(0), np.minimum(last, reader.grid.shape[:2])
    place = f"{at[0]:.10g} {at[1]:.10g}"
    if (first >= last).any():
        raise UsageError(f"{place} lies outside the map", where=folder.map, fix=_nearest(reader, column))
    within = slice(int(first[0]), int(last[0])), slice(int(first[1]), int(last[1]))
    log_odds = log_odds_of(reader, within)
    if not log_odds.any():
        raise UsageError(f"no frame has seen anything at {place}", where=folder.map, fix=_nearest(reader, column))
    params, rule = stored_fusion(reader.attributes.fusion, reader.classes, folder.map)
    top = top_down_of(reader, params, rule, within)
    box = VoxelMap(to_device(log_odds), to_device(0, np.int32), part_of(reader.grid, within), reader.classes)
    solid = np.asarray(occupied(box, params))
    return Cell(reader, within, log_odds, top, _deciding(log_odds, solid, rule), params, rule)


def _deciding(
    log_odds: Float[np.ndarray, "K X Y Z"], solid: Bool[np.ndarray, "X Y Z"], rule: FusionRule
) -> Bool[np.ndarray, "K X Y Z"]:
    read = solid if solid.any() else (log_odds != 0).any(axis=0)
    every = np.broadcast_to(read, log_odds.shape).copy()
    if rule.column == "max" and solid.any():
        for channel in range(1, len(log_odds)):
            best = np.where(solid, log_odds[channel], -np.inf).argmax(axis=-1)
            every[channel] = solid & (np.arange(solid.shape[-1]) == best[..., None])
    return every


def _nearest(reader: MapReader, column: np.ndarray) -> str:
    """What to try instead."""
    found = nearest_observed(reader, (float(column[0]), float(column[1])))
    if found is None:
        return "nothing was observed in this map at all"
    corner_m, size_m = (numbers[:2] for numbers in exact_corner(reader.grid))
    at = np.asarray(reader.attributes.site_origin)[:2] + corner_m + (np.array(found) + 0.5) * size_m
    return f"the nearest cell that was observed: --at {at[0]:.3f} {at[1]:.3f}"


def plan_again(run: Path, cell: Cell, notify: Notify) -> Plan:
    """The plan of a run, from what its folder says of it.

    Raises:
        JaxmapError: the sequence or its poses are not those of the run.
        UsageError: the run was merged of others.
    """
    folder = RunFolder(run)
    tree = read_yaml(folder.config)
    tree = tree if isinstance(tree, dict) else {}
    if isinstance(merged := tree.get("merged"), list):
        raise UsageError(
            "the run was merged of others, which hold their frames",
            where=run,
            fix=f"explain one of them: {', '.join(map(str, merged))}",
        )
    source = tree.get("sequence")
    if not isinstance(source, str):
        raise JaxmapError("it does not say which sequence was mapped", where=folder.config, fix="map it again")
    config, kept = load_config(str(folder.config)), bool(tree.get("keep_observations")) and folder.observations.exists()
    if kept:
        # The map was fused from what was kept, which is rounded; it holds just the frames and poses of the run.
        source, usual = str(folder.observations), MapConfig()
        config = replace(config, **{name: getattr(usual, name) for name in CHOSEN_ANEW})
    plan = plan_run(source, config, notify, in_tiles=True)
    progress = cell.reader.attributes.progress
    done = progress.get("next_index")
    if not isinstance(done, int) or not (kept or progress.get("digest") == plan.digest(done)):
        raise JaxmapError("the frames, poses or camera are not those of the run", where=source, fix="map it again")
    fusion = json.loads(json.dumps(plan.fusion))
    if fusion != cell.reader.attributes.fusion or plan.labeller.classes != cell.reader.classes:
        raise JaxmapError(
            "the map was fused with other numbers than its config.yaml has", where=run, fix="map it again"
        )
    return plan


def frames_of(cell: Cell, plan: Plan) -> dict[int, int]:
    """The frames that can have touched a cell, and how many were fused before each."""
    box = part_of(cell.reader.grid, cell.within)
    poses = plan.sequence.T_world_camera @ plan.front_end.T_raw_rectified
    views = view_boxes(box, plan.front_end.camera, poses, plan.depth_range_m[1])
    skipped = {entry.get("frame") for entry in cell.reader.attributes.progress.get("skipped", [])}
    fused = np.array([frame.name not in skipped for frame in plan.sequence.frames])
    before = np.cumsum(fused) - fused
    sees = fused & (views[:, 1] > views[:, 0]).all(axis=1)
    sees[cell.reader.attributes.progress["next_index"] :] = False
    return {int(index): int(before[index]) for index in np.flatnonzero(sees)}


def explain_cell(
    run: Path, cell: Cell, plan: Plan, numbers: dict[int, int], advance: Callable[[int], object] = lambda done: None
) -> Explanation:
    """What each frame that sees a cell has added to it.

    Args:
        run: the run folder.
        cell: of its map.
        plan: of the run (`plan_again`).
        numbers: of `frames_of`.
        advance: is told how many of those frames are done.

    Raises:
        JaxmapError: the parts do not add up to what the map holds.
    """
    box = part_of(cell.reader.grid, cell.within)
    explain = make_explainer(plan.mapper.design, box, plan.params, plan.key)
    sums, parts = np.zeros_like(cell.log_odds), []
    for done, (index, prepared) in enumerate(_frames(plan, list(numbers)), start=1):
        if prepared.frame is not None and prepared.rectified is not None:
            added = explain(prepared.frame, numbers[index])
            sums += np.asarray(added.log_odds)
            if np.asarray(added.log_odds).any():
                parts.append(_part(cell, plan, index, prepared, added))
        advance(done)
    apart = np.abs(sums - cell.log_odds)
    if (apart > _MOST_APART + 1e-5 * np.abs(cell.log_odds)).any():
        raise JaxmapError(
            f"the frames add up to other evidence than the map holds, by {apart.max():.3g}",
            where=run,
            fix="images, labels or jaxmap have changed since: map the sequence again",
        )
    return _explanation(run, cell, parts)


def _frames(plan: Plan, indices: list[int]) -> Iterator[tuple[int, PreparedFrame]]:
    """Some frames of a plan, made ready."""
    if plan.observations is not None:
        frames = replace(plan, observations=plan.observations.selected(np.array(indices))).prepare()
    else:
        more: Any = {"needs": plan.labeller.needs, "indices": indices}
        frames = prepare_frames(plan.sequence, plan.front_end, plan.label_folder, **more)
    yield from zip(indices, frames, strict=True)


def _part(cell: Cell, plan: Plan, index: int, prepared: PreparedFrame, added: Contribution) -> FramePart:
    assert prepared.rectified is not None
    evidence, inside = np.asarray(added.log_odds), np.asarray(added.inside)
    pose = plan.sequence.T_world_camera[index] @ plan.front_end.T_raw_rectified
    camera = pinhole(plan.front_end.camera)
    x, y, z = pose[:3, :3].T @ (_middle_m(cell) - pose[:3, 3])
    return FramePart(
        index=index,
        name=prepared.ref.name,
        evidence=cell.read(evidence),
        seen_through=int((evidence[0] < 0).sum()),
        range_m=float(np.linalg.norm([x, y, z])),
        centre_px=(camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px) if z > 0 else None,
        inside=inside,
        label=np.asarray(added.label),
        weight=np.asarray(added.weight),
        depth_m=np.asarray(added.depth_m),
        left=prepared.rectified.left,
        disparity_px=plan.front_end.disparity_of(prepared.rectified),
    )


def _middle_m(cell: Cell) -> Float[np.ndarray, "3"]:
    """The middle of what decides on a cell, world."""
    corner_m, size_m = exact_corner(part_of(cell.reader.grid, cell.within))
    voxels = np.argwhere(cell.deciding[0])
    return corner_m + (voxels.mean(axis=0) + 0.5) * size_m


def _explanation(run: Path, cell: Cell, parts: list[FramePart]) -> Explanation:
    reader = cell.reader
    corner_m, size_m = exact_corner(part_of(reader.grid, cell.within))
    low = np.asarray(reader.attributes.site_origin, np.float64)[:2] + corner_m[:2]
    seen = cell.top.observed
    labels = [reader.classes[label] if label < len(reader.classes) else "no label" for label in cell.top.label[seen]]
    priority = tuple(reader.classes[index] for index in cell.rule.priority(reader.classes))
    priors = np.concatenate([[float(cell.params.occupancy_prior)], np.asarray(cell.params.class_prior, np.float64)])
    return Explanation(
        run=str(RunFolder(run).path.resolve().name),
        low_m=(float(low[0]), float(low[1])),
        high_m=(float(low[0] + size_m[0] * seen.shape[0]), float(low[1] + size_m[1] * seen.shape[1])),
        crs=reader.attributes.crs,
        classes=reader.classes,
        columns=cell.columns,
        labels={name: labels.count(name) for name in dict.fromkeys(labels)},
        height_m=float(np.nanmean(cell.top.height_m) + reader.attributes.site_origin[2]) if seen.any() else None,
        evidence=cell.read(cell.log_odds),
        priors=priors,
        probability=tuple(float(p) for p in cell.top.probability[:, seen].mean(axis=1)) if seen.any() else (),
        priority=(priority, float(cell.params.class_threshold)),
        spread=cell.params.class_kernel is not None,
        column_rule=cell.rule.column,
        parts=parts,
    )
