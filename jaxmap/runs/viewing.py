"""`jaxmap view`: a run as a recording of rerun; and `jaxmap map --view`, while it runs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from jaxmap.errors import FrameError
from jaxmap.export.voxels import occupied_voxels
from jaxmap.labels import IGNORE
from jaxmap.mapping.observations import open_observations
from jaxmap.mapping.sequence import FusedFrame
from jaxmap.report.first_seen import first_seen
from jaxmap.report.pictures import colourise_disparity, overlay_labels
from jaxmap.report.recording import Recording, recording
from jaxmap.report.run_contents import PICTURES, RunContents, read_run
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import Watch
from jaxmap.runs.mapping_plan import Plan
from jaxmap.runs.run_frames import RunFrames, read_run_frames
from jaxmap.types import VoxelMap, pinhole

MOST_PARTS = 240
"""Frames after which voxels appear; more would make a viewer slow."""
_NEAR_M = 1e-3
_EVERY_S = 2.0
"""How often the map is shown while it grows."""


def view_run(run: Path, save: Path | None) -> list[str]:
    """Shows a run in rerun's viewer, or writes it into a file for it.

    Voxels are those that are occupied at the end; each appears with the first frame that sees it.

    Returns:
        What is shown, and what is not, as the run does not hold it.

    Raises:
        JaxmapError: no run, one without poses, rerun is not installed, no display, or the file cannot be written.
    """
    folder = RunFolder(run)
    contents = read_run(run)
    frames = read_run_frames(folder, contents.attributes.site_origin)
    with recording(contents.name, contents.classes, frames.T_world_camera, save) as log:
        log.path(frames.T_world_camera[:, :3, 3])
        for frame, T, timestamp_s in zip(frames.index, frames.T_world_camera, frames.timestamps_s, strict=True):
            log.at(int(frame), float(timestamp_s))
            log.pose(T)
        pictures = [*_log_pictures(log, contents, frames), *_log_observed(log, folder, contents, frames)]
        notes = [*pictures, *_log_voxels(log, contents, frames)]
        for note in notes:
            log.note(note)
    return notes


def _log_pictures(log: Recording, contents: RunContents, frames: RunFrames) -> Iterator[str]:
    """Logs the pictures of the key frames, and tells how many."""
    shown = 0
    for name, pictures in contents.pictures.items():
        row = _row_of(name, contents, frames)
        if row is None:
            continue
        log.at(int(frames.index[row]), float(frames.timestamps_s[row]))
        try:
            for kind, path in pictures.items():
                if kind == "left":
                    log.left(path, frames.camera, frames.size_px[0])
                else:
                    log.picture(kind, path)
        except FrameError as error:
            yield f"a picture is left out: {error}"
            continue
        shown += 1
    kinds = ", ".join(kind for kind in PICTURES if any(kind in pictures for pictures in contents.pictures.values()))
    yield f"{len(frames.index)} poses; pictures ({kinds or 'none'}) of {shown} key frames"
    yield from frames.notes


def _log_observed(log: Recording, folder: RunFolder, contents: RunContents, frames: RunFrames) -> Iterator[str]:
    """Logs disparity and likeliest classes of the other frames, where the run has kept them, and tells of how many."""
    if not folder.observations.exists():
        return
    observations, shown = open_observations(folder.observations), 0
    place = {ref.name: index for index, ref in enumerate(observations.frames)}
    own = np.full(256, IGNORE, np.uint8)
    for index, name in enumerate(observations.attributes.classes):
        if name in contents.classes:
            own[index] = contents.classes.index(name)
    for index, name, timestamp_s in zip(frames.index, frames.names, frames.timestamps_s, strict=False):
        if f"{index:06d}" in contents.pictures or name not in place:
            continue
        try:
            seen = observations.observation(place[name])
        except FrameError as error:
            yield f"a frame is left out: {error}"
            continue
        log.at(int(index), float(timestamp_s))
        log.no_left()
        log.picture("disparity", colourise_disparity(seen.disparity_px))
        if seen.kept is not None and contents.classes:
            labels = own[seen.kept if seen.kept.ndim == 2 else seen.kept.argmax(axis=-1)]
            log.picture("labels", overlay_labels(np.zeros(labels.shape, np.uint8), labels, contents.classes, 1.0))
        shown += 1
    yield f"disparity and likeliest classes of {shown} other frames, as they were perceived"


def _row_of(name: str, contents: RunContents, frames: RunFrames) -> int | None:
    """Which of the frames a key frame is: by its number, or where the run's table is lost, by where it was taken."""
    known = contents.group("camera").get("key_frames")
    if not frames.names and isinstance(known, dict) and name in known:
        place = np.array(known[name], np.float64).reshape(4, 4)[:3, 3] - frames.T_world_camera[:, :3, 3]
        off_m = np.linalg.norm(place, axis=1)
        return int(off_m.argmin()) if off_m.min() < _NEAR_M else None
    rows = np.flatnonzero(frames.index == int(name))
    return int(rows[0]) if len(rows) else None


def _log_voxels(log: Recording, contents: RunContents, frames: RunFrames) -> Iterator[str]:
    """Logs the voxels by the frame that first sees them, and tells how many."""
    voxels, count = contents.voxels, len(frames.index)
    rows = np.unique(np.linspace(0, count - 1, MOST_PARTS).round().astype(int))
    if frames.camera is None:
        rows = rows[:1]
        first = np.zeros(len(voxels.label), int)
        yield f"{len(voxels.label)} voxels, all from the first frame on: without a camera nothing tells when each came"
    else:
        first = first_seen(
            voxels.centres_world, frames.T_world_camera[rows], frames.camera, frames.size_px, frames.max_range_m
        )
        unseen = int((first < 0).sum())
        first[first < 0] = len(rows) - 1
        thinned = f" (of every {count / len(rows):.1f}th)" if count > len(rows) else ""
        late = f"; {unseen} that none sees at the end" if unseen else ""
        yield f"{len(voxels.label)} voxels, each from the first frame{thinned} that sees it{late}"
    for part, row in enumerate(rows):
        here = first == part
        if here.any():
            log.at(int(frames.index[row]), float(frames.timestamps_s[row]))
            name = f"{int(frames.index[row]):06d}"
            log.voxels(name, voxels.centres_world[here], voxels.label[here], voxels.voxel_size_m)


@contextmanager
def live_view(plan: Plan, save: Path | None) -> Iterator[Watch]:
    """A viewer, or a file for it, that shows a run while it goes on.

    Yields:
        What to call after each frame, with the map so far: logs pose, left image and disparity, the labels of key
        frames, and from time to time the map.

    Raises:
        JaxmapError: rerun is not installed, no display, or the file cannot be written.
    """
    camera, T_world_camera = plan.front_end.camera, plan.sequence.T_world_camera @ plan.front_end.T_raw_rectified
    key_frames = plan.key_frames
    classes, last, shown_s = plan.labeller.classes, len(plan.sequence.frames) - 1, -np.inf
    with recording(plan.sequence.name, classes, T_world_camera, save) as log:

        def show(fused: FusedFrame, voxel_map: VoxelMap) -> None:
            nonlocal shown_s
            prepared = fused.prepared
            log.at(prepared.index, prepared.ref.timestamp_s)
            if prepared.rectified is not None and prepared.frame is not None:
                left = prepared.rectified.left
                log.pose(T_world_camera[prepared.index])
                # Observations have that of key frames alone.
                if left.size:
                    log.left(left, pinhole(camera), camera.width_px)
                log.picture("disparity", colourise_disparity(plan.front_end.disparity_of(prepared.rectified)))
                if fused.info is not None and fused.info.labels is not None and prepared.index in key_frames:
                    log.picture("labels", overlay_labels(left, np.asarray(fused.info.labels), classes))
            if time.monotonic() - shown_s > _EVERY_S or prepared.index == last:
                voxels = occupied_voxels(voxel_map, plan.params.fusion, plan.rule)
                log.voxels("map", voxels.centres_world, voxels.label, voxels.voxel_size_m)
                shown_s = time.monotonic()

        yield show
