"""A mapping run from its plan to its outputs: what `jaxmap map` and `jaxmap demo` do."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import UInt8

from jaxmap.errors import JaxmapError
from jaxmap.evaluation.geometry_scores import DisparityScores, score_disparity
from jaxmap.host.output_folder import write_json
from jaxmap.mapping.devices import Device, choose_devices, run_on_devices
from jaxmap.mapping.sequence import FusedFrame, PreparedFrame, with_labels_shown
from jaxmap.mapping.store import MapReader
from jaxmap.profiling.step_profile import WARM_UP_FRAMES, StepProfile, table_lines
from jaxmap.report.run_page import write_report
from jaxmap.runs.exports import write_exports
from jaxmap.runs.folder import RunFolder, count_missed, write_key_frame, write_poses
from jaxmap.runs.labelling import Notify
from jaxmap.runs.log import RunLog
from jaxmap.runs.map_in_progress import TiledMap, WholeMap, map_attributes
from jaxmap.runs.mapping_plan import Plan
from jaxmap.runs.metrics import metrics_of, notes
from jaxmap.runs.run_frames import rows_of, write_frame_table
from jaxmap.types import VoxelMap

_PICTURES_AT_ONCE = 4
"""Frames that wait for their pictures to be written; each holds some 10 MB."""

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
    memory = TiledMap(plan, folder.map) if plan.block_shape else WholeMap(plan, folder.map)
    voxel_map, log = memory.begin()
    _tell_progress(plan, log, notify)
    step_profile, program = StepProfile(folder.profile if profile else None), None
    if plan.keeper is not None:
        plan.keeper.begin(folder.observations)
    form = plan.frame_form if log.next_index < len(plan.sequence.frames) else None
    frames = plan.prepare(range(log.next_index, len(plan.sequence.frames)), keep_in=folder.observations)
    if plan.labeller.classes:
        form = None if form is None else replace(form, show=jax.ShapeDtypeStruct((), np.bool_))
        frames = with_labels_shown(frames, plan.key_frames)
    pictures = Pictures(plan, folder)
    saver = _Saver(plan, log, memory, pictures)
    options: dict[str, Any] = {"strict": strict, "form": form, "cover": memory.cover}
    run = run_on_devices(plan.mapper, voxel_map, frames, plan.params, plan.key, devices, **options)
    try:
        for voxel_map, fused in run:
            if fused.cost is not None:
                program = fused.cost.program
                log.temporary_bytes = fused.cost.temporary_bytes
                log.compile_s += fused.cost.compile_s
                saver.leave_out(fused.cost.compile_s)
            pictures.note(fused)
            log.add(fused, _disparity_scores(plan, fused))
            saver.leave_out(pictures.write_many())
            if fused.info is not None:
                step_profile.step_done()
            on_frame(fused)
            watch(fused, voxel_map)
            if saver.unsaved_s > checkpoint_every_s:
                saver.save(voxel_map)
    except KeyboardInterrupt:
        if saver.save(voxel_map):
            notify(f"interrupted and saved after {log.next_index} frames; --resume goes on there")
        raise
    finally:
        step_profile.close()
    saver.count_time()
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


class _Saver:
    """Saves a run on its way, and counts its time: without that of compiling, of pictures and of saving."""

    def __init__(self, plan: Plan, log: RunLog, memory: WholeMap | TiledMap, pictures: Pictures) -> None:
        self.plan, self.log, self.memory, self.pictures = plan, log, memory, pictures
        self.saved_s = self.counted_s = time.perf_counter()

    @property
    def unsaved_s(self) -> float:
        """How long ago the run was saved last."""
        return time.perf_counter() - self.saved_s

    def leave_out(self, seconds: float) -> None:
        """So long was not spent on the run itself."""
        self.counted_s += seconds

    def count_time(self) -> None:
        """Adds to the log what has passed since it was counted last."""
        now_s = time.perf_counter()
        self.log.total_s += now_s - self.counted_s
        self.counted_s = now_s

    def save(self, voxel_map: VoxelMap) -> bool:
        """Saves the run, unless map and log speak of other frames, and returns whether it did.

        They do where an interrupt comes between the two, and within a batch that several devices have fused: the map
        holds all of its frames, which the log takes one by one.
        """
        if voxel_map.log_odds.is_deleted() or not int(voxel_map.frames_fused) == self.log.fused > 0:
            return False
        self.count_time()
        # First, so that what counts as done has its pictures.
        self.pictures.write()
        self.memory.save(voxel_map, map_attributes(self.plan, self.log, voxel_map))
        self.saved_s = self.counted_s = time.perf_counter()
        return True


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
    metrics = metrics_of(plan, log, reader) | count_missed(plan.rule, reader, plan.members) | details
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
