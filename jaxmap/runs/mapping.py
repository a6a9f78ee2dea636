"""A mapping run from its plan to its outputs: what `jaxmap map` and `jaxmap demo` do."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import UInt8

import jaxmap
from jaxmap.ensemble.layer import named_layers
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.geometry_scores import DisparityScores, score_disparity
from jaxmap.geometry.bounds import map_bytes, view_boxes
from jaxmap.host.memory import peak_resident_mib
from jaxmap.host.output_folder import write_json
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.devices import Device, choose_devices, run_on_devices
from jaxmap.mapping.sequence import FusedFrame, PreparedFrame, with_labels_shown
from jaxmap.mapping.store import MapReader, holds_map, in_memory, load_map, open_map, save_map
from jaxmap.mapping.tiles import MovingBlock, TileStore
from jaxmap.planning.ground import keeps_layers, map_layers
from jaxmap.profiling.step_profile import WARM_UP_FRAMES, StepProfile, table_lines
from jaxmap.report.run_page import write_report
from jaxmap.runs.checking import finding_line, findings_tree
from jaxmap.runs.exports import write_exports
from jaxmap.runs.folder import RunFolder, count_missed, count_voxels, write_key_frame, write_poses
from jaxmap.runs.hazard_layers import add_hazards
from jaxmap.runs.labelling import Notify
from jaxmap.runs.log import RunLog
from jaxmap.runs.mapping_plan import Plan
from jaxmap.runs.run_frames import rows_of, write_frame_table
from jaxmap.types import VoxelMap

_PICTURES_AT_ONCE = 4
"""Frames that wait for their pictures to be written; each holds some 10 MB."""
FEW_MATCHED = 0.01
"""Where fewer pixels of a frame have a depth in range, it is not the bounds that leave a map empty."""

Watch = Callable[[FusedFrame, VoxelMap], None]
"""Looks at the map after each frame; the next frame takes the map's memory."""


def unwatched(fused: FusedFrame, voxel_map: VoxelMap) -> None:
    """Looks at nothing."""


def run_plan(
    plan: Plan,
    folder: RunFolder,
    *,
    strict: bool,
    checkpoint_every_s: float,
    notify: Notify,
    on_frame: Callable[[FusedFrame], None] = lambda fused: None,
    watch: Watch = unwatched,
    profile: bool = False,
    report: bool = True,
    devices: Sequence[Device] | None = None,
) -> dict[str, Any]:
    """Maps the sequence and writes all outputs.

    An interrupted run of the same settings in the folder is resumed: the map comes
    out as if the run had not been interrupted, bit for bit.

    Args:
        plan: the run.
        folder: where it goes; `RunFolder.begin` was called.
        strict: stop at the first frame that cannot be used.
        checkpoint_every_s: how often the map is saved on the way.
        notify: takes lines for the user.
        on_frame: called after each frame.
        watch: looks at the map after each frame (`viewing.live_view`).
        profile: record a trace of some steps into the folder, and report where their time went.
        report: write the page of the run.
        devices: of `mapping.devices.choose_devices`, by default its default.

    Returns:
        The metrics, as they are in metrics.json.

    Raises:
        JaxmapError: no frame could be fused, or an output cannot be written.
    """
    devices = devices or choose_devices(None, plan.members)
    memory = _TiledMap(plan, folder.map) if plan.block_shape else _WholeMap(plan, folder.map)
    voxel_map, log = memory.begin()
    _tell_progress(plan, log, notify)
    step_profile, program = StepProfile(folder.profile if profile else None), None
    saved_s = resumed_s = time.perf_counter()
    if plan.keeper is not None:
        plan.keeper.begin(folder.observations)
    form = plan.frame_form if log.next_index < len(plan.sequence.frames) else None
    frames = plan.prepare(range(log.next_index, len(plan.sequence.frames)), keep_in=folder.observations)
    if plan.labeller.classes:
        form = None if form is None else replace(form, show=jax.ShapeDtypeStruct((), np.bool_))
        frames = with_labels_shown(frames, plan.key_frames)
    options: dict[str, Any] = {"strict": strict, "form": form, "cover": memory.cover}
    run = run_on_devices(plan.mapper, voxel_map, frames, plan.params, plan.key, devices, **options)
    pictures = Pictures(plan, folder)
    try:
        for voxel_map, fused in run:
            if fused.cost is not None:
                program = fused.cost.program
                log.temporary_bytes = fused.cost.temporary_bytes
                log.compile_s += fused.cost.compile_s
                # Compilation is timed apart.
                resumed_s += fused.cost.compile_s
            pictures.note(fused)
            log.add(fused, _disparity_scores(plan, fused))
            resumed_s += pictures.write_many()
            if fused.info is not None:
                step_profile.step_done()
            on_frame(fused)
            watch(fused, voxel_map)
            # A map that several devices have made holds all of a batch, whose frames are counted one by one.
            if int(voxel_map.frames_fused) == log.fused and time.perf_counter() - saved_s > checkpoint_every_s:
                log.total_s += time.perf_counter() - resumed_s
                _save(plan, log, memory, voxel_map, pictures)
                saved_s = resumed_s = time.perf_counter()
    except KeyboardInterrupt:
        # Only where map and log speak of the same frames: the interrupt may come between the two.
        if not voxel_map.log_odds.is_deleted() and int(voxel_map.frames_fused) == log.fused > 0:
            _save(plan, log, memory, voxel_map, pictures)
            notify(f"interrupted and saved after {log.next_index} frames; --resume goes on there")
        raise
    finally:
        step_profile.close()
    log.total_s += time.perf_counter() - resumed_s
    pictures.write()
    if not log.fused:
        raise JaxmapError(f"none of {len(log.skipped)} frames could be fused; the first: {log.skipped[0]['reason']}")

    log.complete = True
    reader = memory.finish(voxel_map, map_attributes(plan, log, voxel_map))
    metrics = write_outputs(plan, folder, log, reader, _profile(step_profile, program, notify) if profile else {})
    if report:
        write_report(folder.path)
    for note in notes(plan, log, metrics):
        notify(f"note: {note}")
    return metrics


def _tell_progress(plan: Plan, log: RunLog, notify: Notify) -> None:
    if log.complete:
        notify("the run is complete already; its outputs are written anew")
    elif log.next_index:
        notify(f"going on after {log.next_index} of {len(plan.sequence.frames)} frames")


class _WholeMap:
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


class _TiledMap:
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


def _save(plan: Plan, log: RunLog, memory: _WholeMap | _TiledMap, voxel_map: VoxelMap, pictures: Pictures) -> None:
    """Saves a map on the way; the pictures of its frames first, so that what counts as done has them."""
    pictures.write()
    memory.save(voxel_map, map_attributes(plan, log, voxel_map))


def _disparity_scores(plan: Plan, fused: FusedFrame) -> DisparityScores | None:
    """Compares the disparity of a rectified frame with its truth, where that is known.

    Raises:
        JaxmapError: the truth cannot be read, or is of another size.
    """
    read, rectified, ref = plan.sequence.true_disparity, fused.prepared.rectified, fused.prepared.ref
    if read is None or rectified is None or plan.front_end.rectifier is not None:
        return None
    truth_px = read(ref)
    if truth_px is None:
        return None
    disparity_px = plan.front_end.disparity_of(rectified)
    if truth_px.shape != disparity_px.shape:
        size, expected = (f"{shape[1]}x{shape[0]}" for shape in (truth_px.shape, disparity_px.shape))
        raise JaxmapError(
            f"the true disparity is {size} px, the image {expected} px",
            where=f"frame {ref.name}",
            fix="give the truth of this image, or remove it",
        )
    return score_disparity(disparity_px, truth_px)


def notes(plan: Plan, log: RunLog, metrics: dict[str, Any]) -> Iterator[str]:
    """What the user should look at."""
    said = {finding.kind for finding in plan.findings}
    if log.too_near and not said & {"near-limit", "vertical-disparity"}:
        matcher = plan.front_end.matcher
        needed = -(-(log.nearest_px + 1 - matcher.options.min_disparity_px) // 16) * 16
        yield (
            f"in {log.too_near} of {log.fused} frames something is nearer than {matcher.num_disparities} disparities "
            f"can see, and was left out: the map has a hole there; --stereo.num-disparities {needed:.0f} sees it"
        )
    if scores := metrics.get("disparity"):
        yield (
            f"against the true disparity: median error {scores['median_error_px']:.2f} px, {scores['bad_2']:.1%} off "
            f"by more than 2 px, {scores['valid']:.0%} of the pixels matched"
        )
    if log.without_ground:
        yield (
            f"no ground below the camera in {log.without_ground} of {log.fused} frames: nothing there is sand or rock "
            "by its shape; check that the poses are of the left camera in a z-up world"
        )
    if not metrics["voxels"]["occupied"]:
        matched = log.valid_fractions.percentile(50)
        reason = "check the bounds, the range and the poses"
        if matched < FEW_MATCHED:
            reason = f"only {matched:.1%} of the pixels lie in range; jaxmap check tells what is wrong with the images"
        yield f"no voxel is occupied: {reason}"


def write_outputs(
    plan: Plan, folder: RunFolder, log: RunLog, reader: MapReader, details: dict[str, Any]
) -> dict[str, Any]:
    """Writes all that a run leaves beside its map, and returns its metrics, the details among them."""
    skipped = {frame["frame"]: frame["reason"] for frame in log.skipped}
    if plan.keeper is not None:
        plan.keeper.finish(folder.observations, skipped)
    fused_frames = np.array([frame.name not in skipped for frame in plan.sequence.frames])
    timestamps_s = np.array([frame.timestamp_s for frame in plan.sequence.frames])
    write_poses(
        folder, timestamps_s[fused_frames], plan.sequence.T_world_camera[fused_frames], plan.sequence.site_origin
    )
    write_frame_table(folder.frames, rows_of(plan.sequence.frames, skipped))
    write_exports(folder, reader)
    metrics = _metrics(plan, log, reader) | count_missed(plan.rule, reader, plan.members) | details
    write_json(folder.metrics, metrics)
    return metrics


def _profile(step_profile: StepProfile, program: Callable[[], str | None] | None, notify: Notify) -> dict[str, Any]:
    """What metrics.json holds of the steps that were traced."""
    summary = step_profile.summary(program)
    if summary is None:
        notify(f"note: {step_profile.steps} frames are too few for a profile: it takes more than {WARM_UP_FRAMES}")
        return {}
    for line in table_lines(summary):
        notify(line)
    return {"profile": summary}


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


class Pictures:
    """Key frames that wait for their pictures to be written, each with the labels that the step gave its pixels."""

    def __init__(self, plan: Plan, folder: RunFolder) -> None:
        self.plan, self.folder, self.key_frames = plan, folder, plan.key_frames
        self.waiting: list[tuple[PreparedFrame, UInt8[np.ndarray, "H W"] | None]] = []

    def note(self, fused: FusedFrame) -> None:
        """Keeps a key frame; before it counts, so that an interrupt loses none."""
        if fused.info is not None and fused.prepared.index in self.key_frames:
            labels = fused.info.labels
            self.waiting.append((fused.prepared, None if labels is None else np.asarray(labels)))

    def write_many(self) -> float:
        """Writes pictures where many wait, and returns how long that took, in seconds."""
        if len(self.waiting) < _PICTURES_AT_ONCE:
            return 0.0
        started_s = time.perf_counter()
        self.write()
        return time.perf_counter() - started_s

    def write(self) -> None:
        """Writes all."""
        for prepared, labels in self.waiting:
            assert prepared.rectified is not None
            rectified, large = self.plan.front_end.matched(prepared.rectified), self.key_frames[prepared.index]
            write_key_frame(self.folder, prepared.index, rectified, labels, self.plan.labeller.classes, large=large)
        self.waiting.clear()


def _metrics(plan: Plan, log: RunLog, reader: MapReader) -> dict[str, Any]:
    """What metrics.json holds."""
    sequence, camera, grid = plan.sequence, plan.front_end.camera, plan.grid
    steps_m = np.linalg.norm(np.diff(sequence.T_world_camera[:, :3, 3], axis=0), axis=1)
    block = None if plan.block_shape is None else replace(grid, shape=plan.block_shape)
    members_bytes = map_bytes(grid, 0, plan.members) - map_bytes(grid, 0)
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
            "fused": log.fused,
            "skipped": log.skipped,
            **({} if log.without_ground is None else {"without_ground": log.without_ground}),
            "crs": sequence.crs,
            "site_origin": sequence.site_origin.tolist(),
            "path_length_m": round(float(steps_m.sum()), 3),
            "notes": [*sequence.notes, *map(finding_line, plan.findings)],
            **({"findings": findings_tree(plan.findings)} if plan.findings else {}),
        },
        "camera": camera_numbers
        | {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "rectified_here": plan.front_end.rectified_here,
            **({} if (turn := plan.front_end.alignment_rad) is None else {"alignment_rad": turn.round(8).tolist()}),
            # Poses of the rectified camera, relative to the site origin.
            "key_frames": {
                f"{index:06d}": (sequence.T_world_camera[index] @ plan.front_end.T_raw_rectified).round(6).tolist()
                for index in plan.key_frames
            },
            "T_raw_rectified": plan.front_end.T_raw_rectified.round(9).tolist(),
        },
        "grid": {
            "shape": list(grid.shape),
            "voxel_size_m": np.asarray(grid.voxel_size_m, np.float64).round(6).tolist(),
            "origin_m": np.asarray(grid.origin_m, np.float64).round(6).tolist(),
            "depth_range_m": list(plan.depth_range_m),
        },
        "labeller": plan.labeller.name,
        **({"model": {"file": str(plan.model.path), "sha256": plan.model.sha256}} if plan.model is not None else {}),
        "times": {
            "total_s": round(log.total_s, 3),
            "compile_s": round(log.compile_s, 3),
            "frames_per_s": round(log.fused / max(log.total_s, 1e-9), 3),
            "stages": log.stage_summary(),
        },
        "points": {
            "valid_fraction": round(log.valid_fractions.percentile(50), 4),
            "fused": log.points_fused,
            **({"frames_too_near": log.too_near} if log.too_near else {}),
        },
        **(
            {"disparity": {name: round(sample.total / sample.count, 4) for name, sample in log.disparity.items()}}
            if log.disparity
            else {}
        ),
        "voxels": count_voxels(reader, plan.params.fusion, plan.rule),
        "memory": {
            "map_mib": round(map_bytes(plan.grid, len(plan.labeller.classes)) / 2**20, 2),
            **({"block_mib": round(map_bytes(block, len(plan.labeller.classes)) / 2**20, 2)} if block else {}),
            **({"members_mib": round(members_bytes / 2**20, 2)} if plan.members else {}),
            "step_temporary_mib": round(log.temporary_bytes / 2**20, 2),
            "peak_resident_mib": round(peak_resident_mib(), 1),
        },
    }
