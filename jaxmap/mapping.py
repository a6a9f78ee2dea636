"""A mapping run from a sequence to its outputs: what `jaxmap map` and `jaxmap demo` do."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

import jaxmap
from jaxmap.config import MapConfig, split_fusion
from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.label_files import LabelFolder, open_label_folder
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.fusion.params import FusionRule, make_fusion_params
from jaxmap.geometry.bounds import check_memory, grid_around_views, map_bytes, usable_depth
from jaxmap.labellers import Labeller, make_files_labeller, make_no_labeller, make_plane_labeller
from jaxmap.map_store import MapAttributes, save_map
from jaxmap.mapper import Mapper, MapperParams, make_mapper
from jaxmap.report.html import write_report
from jaxmap.run_folder import RunFolder, RunLog, peak_resident_mib, write_json
from jaxmap.run_outputs import count_voxels, write_exports, write_key_frame, write_poses
from jaxmap.sequence import FusedFrame, PreparedFrame, prepare_frames, run_sequence
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.types import GridSpec, VoxelMap, make_grid

Tell = Callable[[str], None]

_KEY_FRAMES = 4


@dataclass(frozen=True)
class Plan:
    """A run, decided in full before the first frame is fused."""

    sequence: StereoSequence
    front_end: StereoFrontEnd
    labeller: Labeller
    label_folder: LabelFolder | None
    grid: GridSpec
    depth_range_m: tuple[float, float]
    rule: FusionRule
    params: MapperParams
    fusion: dict[str, Any]
    mapper: Mapper
    key: PRNGKeyArray

    @property
    def key_frames(self) -> set[int]:
        """Indices of the frames whose pictures are kept."""
        return {int(index) for index in np.linspace(0, len(self.sequence.frames) - 1, _KEY_FRAMES)}


def plan_run(source: str, config: MapConfig, tell: Tell) -> Plan:
    """Opens the sequence and decides range, bounds, labeller and step.

    Args:
        source: the folder of one sequence, or `sample:NAME`.
        config: the settings.
        tell: takes lines for the user.

    Raises:
        JaxmapError: the data or the settings do not serve.
    """
    options = ReadOptions(
        dataset=config.dataset,
        poses=config.poses,
        poses_world=config.poses_world,
        calibration=config.calibration,
        start=config.start,
        stop=config.stop,
        stride=config.stride,
        max_pose_gap_s=config.max_pose_gap_s,
    )
    sequence = open_sequence(source, options)
    front_end = StereoFrontEnd(sequence.camera, config.stereo)
    camera = front_end.camera
    tell(
        f"{sequence.name} ({sequence.dataset}): {len(sequence.frames)} frames "
        f"of {camera.width_px} x {camera.height_px} px, f {float(camera.fx_px):.2f} px, "
        f"baseline {float(camera.baseline_m):.5f} m"
    )
    for note in sequence.notes:
        tell(f"note: {note}")

    max_depth_m = config.depth.max_m or usable_depth(camera, config.depth.max_sigma_m, config.fusion.disparity_sigma_px)
    if not config.depth.min_m < max_depth_m:
        raise UsageError(
            f"depth.min_m {config.depth.min_m} is not below the greatest depth, {max_depth_m} m",
            fix="set --depth.max-m",
        )
    depth_range_m = (config.depth.min_m, max_depth_m)
    labeller, label_folder = _labeller(config, sequence)
    grid = _grid(config, sequence, front_end, max_depth_m)
    size = " x ".join(f"{edge:g}" for edge in np.asarray(grid.voxel_size_m, np.float64).round(6))
    tell(
        f"depth {depth_range_m[0]:g} to {max_depth_m:g} m; grid {' x '.join(map(str, grid.shape))} voxels of {size} m, "
        f"{1 + len(labeller.classes)} channels: {map_bytes(grid, len(labeller.classes)) / 2**20:.0f} MiB"
    )
    check_memory(grid, len(labeller.classes), config.grid.max_memory_gib)

    params, rule = split_fusion(config.fusion)
    fusion_rule = FusionRule(**rule)
    mapper_params = MapperParams(camera, make_fusion_params(labeller.classes, **params))
    return Plan(
        sequence=sequence,
        front_end=front_end,
        labeller=labeller,
        label_folder=label_folder,
        grid=grid,
        depth_range_m=depth_range_m,
        rule=fusion_rule,
        params=mapper_params,
        fusion={"params": params, "rule": rule},
        mapper=make_mapper(camera, grid, labeller, fusion_rule, depth_range_m),
        key=jax.random.key(config.seed),
    )


def run_plan(
    plan: Plan,
    folder: RunFolder,
    *,
    strict: bool,
    checkpoint_every_s: float,
    tell: Tell,
    on_frame: Callable[[FusedFrame], None] = lambda fused: None,
) -> dict[str, Any]:
    """Maps the sequence and writes all outputs.

    A run folder that holds an interrupted run of the same settings is gone on with: the map comes
    out as if the run had not been interrupted, bit for bit.

    Args:
        plan: the run.
        folder: where it goes; `RunFolder.begin` was called.
        strict: stop at the first frame that cannot be used.
        checkpoint_every_s: how often the map is saved on the way.
        tell: takes lines for the user.
        on_frame: called after each frame.

    Returns:
        The metrics, as they are in metrics.json.

    Raises:
        JaxmapError: no frame could be fused, or an output cannot be written.
    """
    voxel_map, log = folder.resume_point() or (plan.mapper.init(), RunLog())
    if log.complete:
        tell("the run is complete already; its outputs are written anew")
    elif log.next_index:
        tell(f"going on after {log.next_index} of {len(plan.sequence.frames)} frames")
    saved_s = resumed_s = time.perf_counter()
    frames = prepare_frames(plan.sequence, plan.front_end, plan.label_folder, first=log.next_index)
    run = run_sequence(plan.mapper, voxel_map, frames, plan.params, plan.key, strict=strict)
    for voxel_map, fused in run:
        if fused.cost is not None:
            log.temporary_bytes = fused.cost.temporary_bytes
            log.compile_s += fused.cost.compile_s
            # Compiling is told apart from mapping.
            resumed_s += fused.cost.compile_s
        log.add(fused)
        if fused.info is not None and fused.prepared.index in plan.key_frames:
            _write_key_frame(plan, folder, fused.prepared, int(voxel_map.frames_fused) - 1)
        on_frame(fused)
        if time.perf_counter() - saved_s > checkpoint_every_s:
            log.total_s += time.perf_counter() - resumed_s
            save_map(folder.map, voxel_map, _attributes(plan, log))
            saved_s = resumed_s = time.perf_counter()
    log.total_s += time.perf_counter() - resumed_s
    if not log.fused:
        raise JaxmapError(f"no frame could be fused: {log.skipped[0]['reason']}", where=plan.sequence.name)

    log.complete = True
    attributes = _attributes(plan, log)
    save_map(folder.map, voxel_map, attributes)
    fused_frames = np.array([frame.name in set(log.fused) for frame in plan.sequence.frames])
    timestamps_s = np.array([frame.timestamp_s for frame in plan.sequence.frames])
    write_poses(
        folder, timestamps_s[fused_frames], plan.sequence.T_world_camera[fused_frames], plan.sequence.site_origin
    )
    write_exports(folder, voxel_map, attributes)
    metrics = _metrics(plan, log, voxel_map)
    write_json(folder.metrics, metrics)
    write_report(folder.path)
    return metrics


def _attributes(plan: Plan, log: RunLog) -> MapAttributes:
    return MapAttributes(
        crs=plan.sequence.crs,
        site_origin=plan.sequence.site_origin,
        T_world_source=plan.sequence.T_world_source,
        fusion=plan.fusion,
        progress=log.as_json(),
    )


def _write_key_frame(plan: Plan, folder: RunFolder, prepared: PreparedFrame, number: int) -> None:
    """Pictures of one frame, with the labels that the step gave it as the `number`-th."""
    assert prepared.frame is not None and prepared.rectified is not None
    labels = None
    if plan.labeller.classes:
        labels = np.asarray(plan.mapper.label_image(prepared.frame, plan.params, plan.key, number))
    write_key_frame(folder, prepared.index, prepared.rectified, labels, plan.labeller.classes)


def _metrics(plan: Plan, log: RunLog, voxel_map: VoxelMap) -> dict[str, Any]:
    """What metrics.json holds."""
    sequence, camera, grid = plan.sequence, plan.front_end.camera, plan.grid
    steps_m = np.linalg.norm(np.diff(sequence.T_world_camera[:, :3, 3], axis=0), axis=1)
    camera_numbers = {
        name: round(float(getattr(camera, name)), 6)
        for name in ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px")
    }
    return {
        "jaxmap_version": jaxmap.__version__,
        "sequence": {
            "name": sequence.name,
            "dataset": sequence.dataset,
            "frames": len(sequence.frames),
            "fused": len(log.fused),
            "skipped": log.skipped,
            "crs": sequence.crs,
            "site_origin": sequence.site_origin.tolist(),
            "path_length_m": round(float(steps_m.sum()), 3),
            "notes": list(sequence.notes),
        },
        "camera": camera_numbers
        | {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "rectified_here": plan.front_end.rectifier is not None,
        },
        "grid": {
            "shape": list(grid.shape),
            "voxel_size_m": np.asarray(grid.voxel_size_m, np.float64).round(6).tolist(),
            "origin_m": np.asarray(grid.origin_m, np.float64).round(6).tolist(),
            "depth_range_m": list(plan.depth_range_m),
        },
        "labeller": plan.labeller.name,
        "times": {
            "total_s": round(log.total_s, 3),
            "compile_s": round(log.compile_s, 3),
            "frames_per_s": round(len(log.fused) / max(log.total_s, 1e-9), 3),
            "stages": log.stage_summary(),
        },
        "points": {
            "valid_fraction": round(float(np.median(log.valid_fractions)), 4),
            "fused": log.points_fused,
        },
        "voxels": count_voxels(voxel_map, plan.params.fusion, plan.rule),
        "memory": {
            "map_mib": round(voxel_map.log_odds.nbytes / 2**20, 2),
            "step_temporary_mib": round(log.temporary_bytes / 2**20, 2),
            "peak_resident_mib": round(peak_resident_mib(), 1),
        },
    }


def _labeller(config: MapConfig, sequence: StereoSequence) -> tuple[Labeller, LabelFolder | None]:
    if config.labeller == "none":
        return make_no_labeller(), None
    if config.labeller == "plane":
        return make_plane_labeller(config.classes, **asdict(config.plane)), None
    if config.labels is None:
        raise UsageError("the files labeller needs a folder of labels", fix="give --labels DIR")
    folder = open_label_folder(config.labels, len(config.classes), config.labels_are, sequence.frames[0].name)
    return make_files_labeller(config.classes, soft=folder.soft), folder


def _grid(config: MapConfig, sequence: StereoSequence, front_end: StereoFrontEnd, max_depth_m: float) -> GridSpec:
    settings = config.grid
    if (settings.lower_m is None) != (settings.upper_m is None):
        raise UsageError("one of grid.lower_m and grid.upper_m is missing", fix="give both, or neither")
    if settings.lower_m is not None and settings.upper_m is not None:
        return make_grid(settings.lower_m, settings.upper_m, settings.voxel_size_m)
    return grid_around_views(
        front_end.camera,
        sequence.T_world_camera @ front_end.T_raw_rectified,
        max_depth_m,
        settings.voxel_size_m,
        (settings.below_camera_m, settings.above_camera_m),
    )
