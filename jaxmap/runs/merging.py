"""`jaxmap merge`, from runs to a run: one map of several sessions, with their poses, pictures and report."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import jaxmap
from jaxmap.datasets.poses import PoseTrack, read_poses
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.fusion.params import stored_fusion
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import atomic_path, real_path, sync, write_error
from jaxmap.host.output_folder import write_json
from jaxmap.mapping.merge import add_maps, check_alike, common_grid, digests_of
from jaxmap.mapping.store import MapReader, open_map
from jaxmap.mapping.tiles import TileStore
from jaxmap.planning.options import RoverOptions
from jaxmap.report.run_page import write_report
from jaxmap.runs.exports import write_exports
from jaxmap.runs.folder import RunFolder, count_voxels, write_poses
from jaxmap.runs.hazard_layers import add_hazards
from jaxmap.runs.metrics import grid_metrics
from jaxmap.runs.run_frames import FrameRow, read_frame_table, write_frame_table

_PICTURE = re.compile(r"(?P<frame>\d{6})_(?P<kind>left|disparity|labels)\.(?P<ending>png|webp)")
_PAUSE_S = 1.0
"""Between sessions whose times overlap, where the later is told as if it had come after."""


@dataclass(frozen=True)
class Session:
    """A run that is to be merged.

    Attributes:
        folder: of the run.
        reader: its map.
        metrics: of the run, empty where there are none.
        track: its poses, None where there are none.
    """

    folder: RunFolder
    reader: MapReader
    metrics: dict[str, Any]
    track: PoseTrack | None

    @property
    def name(self) -> str:
        """That of its sequence, or of its folder."""
        return str(self.group("sequence").get("name") or self.folder.path.name)

    def group(self, name: str) -> dict[str, Any]:
        """A group of metrics; empty where it is absent or no group."""
        value = self.metrics.get(name)
        return value if isinstance(value, dict) else {}


def open_sessions(runs: Sequence[Path]) -> list[Session]:
    """Opens runs and checks that their maps can be added.

    Raises:
        JaxmapError: a run has no map, or it cannot be read.
        UsageError: fewer than two, one twice, an interrupted one, one with an ensemble, or maps that differ.
    """
    if len(runs) < 2:
        raise UsageError("a merge needs two runs or more", fix="name them: jaxmap merge RUN RUN --out RUN")
    sessions = [_session(run) for run in runs]
    check_alike([session.reader for session in sessions], list(runs))
    return sessions


def _session(run: Path) -> Session:
    folder = RunFolder(run)
    if not run.is_dir():
        raise JaxmapError("no such run folder", where=run, fix="give a folder that `jaxmap map` wrote")
    folder.settle_for_reading()
    reader = open_map(folder.map)
    if reader.attributes.progress.get("complete") is False:
        raise UsageError("the run is not complete", where=run, fix="finish it first: jaxmap map ... --resume")
    if "ensemble" in reader.attributes.fusion:
        raise UsageError(
            "the map has an ensemble, and ensembles of sessions cannot be added: their draws are not the same",
            where=run,
            fix="map the sessions without one (jaxmap map --ensemble.members 0), then merge",
        )
    metrics = read_json(folder.metrics) if folder.metrics.exists() else {}
    track = read_poses(folder.poses) if folder.poses.exists() else None
    return Session(folder, reader, metrics if isinstance(metrics, dict) else {}, track)


def settings_of(sessions: Sequence[Session]) -> dict[str, Any]:
    """What config.yaml of the merged run holds."""
    return {"sequence": "merged", "merged": [str(real_path(session.folder.path)) for session in sessions]}


def merge_sessions(
    sessions: Sequence[Session],
    folder: RunFolder,
    rover: RoverOptions,
    on_block: Callable[[int], object] = lambda done: None,
) -> list[str]:
    """Writes the run that all sessions make.

    Args:
        sessions: of `open_sessions`.
        folder: where it goes; `RunFolder.begin` was called.
        rover: whose hazards are layers of the map.
        on_block: is told how many blocks of the maps were added.

    Returns:
        What the user should know.

    Raises:
        JaxmapError: a map is damaged, the lattices do not agree, or an output cannot be written.
    """
    _write_map(sessions, folder, rover, on_block)
    reader = open_map(folder.map)
    firsts = np.cumsum([0, *map(_count, sessions)])[:-1].tolist()
    notes = _write_poses(sessions, firsts, folder)
    if reader.attributes.crs is None:
        notes.append("no run has a CRS: their worlds are taken for one and the same")
    if not reader.surface and any(session.reader.surface for session in sessions):
        without = ", ".join(str(session.folder.path) for session in sessions if not session.reader.surface)
        notes.append(f"{without} keeps no heights: the sum has none, and no hazards")
    key_frames = {}
    for session, first in zip(sessions, firsts, strict=True):
        key_frames |= _take_key_frames(session, folder, first, reader.attributes.site_origin)
    write_exports(folder, reader)
    write_json(folder.metrics, _metrics(sessions, reader, key_frames, notes))
    write_report(folder.path)
    return notes


def _write_map(
    sessions: Sequence[Session], folder: RunFolder, rover: RoverOptions, on_block: Callable[[int], object]
) -> None:
    """The map is made in a folder of its own, and put in its place when it is whole."""
    readers = [session.reader for session in sessions]
    grid, shifts = common_grid(readers, [session.folder.path for session in sessions])
    making = folder.path / ".merging"
    try:
        shutil.rmtree(making, ignore_errors=True)
        surface = all(reader.surface for reader in readers)
        store = TileStore(making / folder.map.name, grid, readers[0].classes, surface=surface)
        add_maps(readers, shifts, store, on_block)
        digests = [digest for reader in readers for digest in digests_of(reader)]
        attributes = replace(readers[0].attributes, layers={}, progress={"complete": True, "digests": digests})
        store.commit(sum(reader.frames_fused for reader in readers), attributes)
        store.close()
        add_hazards(making / folder.map.name, rover)
        os.rename(making / folder.map.name, folder.map)
        sync(folder.path)
    except OSError as error:
        raise write_error(error, folder.map) from error
    finally:
        shutil.rmtree(making, ignore_errors=True)


def _write_poses(sessions: Sequence[Session], firsts: Sequence[int], folder: RunFolder) -> list[str]:
    """Writes the poses and the frames of all sessions, in the order of their times; what was moved for that is told.

    Frames keep their numbers within their session, which go on from `firsts`.
    """
    notes = [f"{one.folder.path} has no poses.tum: its path is left out" for one in sessions if one.track is None]
    tracks = [(one, first, one.track) for one, first in zip(sessions, firsts, strict=True) if one.track is not None]
    if not tracks:
        return notes
    times, poses, rows = [], [], []
    last_s = -np.inf
    for session, first, track in sorted(tracks, key=lambda one: _times_s(one[2])[0]):
        times_s, later_s = _times_s(track), 0.0
        if times_s[0] <= last_s:
            later_s = float(last_s + _PAUSE_S - times_s[0])
            told = f"the times of {session.folder.path} overlap with another run's"
            notes.append(f"{told}: in poses.tum they are {later_s:.3f} s later")
            times_s = times_s + later_s
        times.append(times_s)
        poses.append(track.T)
        rows += [
            FrameRow(row.frame + first, f"{session.name}/{row.name}", row.timestamp_s + later_s, row.skipped)
            for row in read_frame_table(session.folder, len(times_s))
            or [FrameRow(i, f"{i:06d}", float(time_s) - later_s) for i, time_s in enumerate(times_s)]
        ]
        last_s = times_s[-1]
    # They are absolute already.
    write_poses(folder, np.concatenate(times), np.concatenate(poses), np.zeros(3))
    write_frame_table(folder.frames, rows)
    return notes


def _times_s(track: PoseTrack) -> np.ndarray:
    return np.arange(len(track.T), dtype=np.float64) if track.timestamps_s is None else track.timestamps_s


def _take_key_frames(session: Session, folder: RunFolder, first: int, site_origin: np.ndarray) -> dict[str, Any]:
    """Copies the pictures of a session under numbers that go on from `first`, and returns their poses by those."""
    for picture in sorted(session.folder.pictures.glob("*")):
        if match := _PICTURE.fullmatch(picture.name):
            name = f"{int(match['frame']) + first:06d}_{match['kind']}.{match['ending']}"
            with atomic_path(folder.pictures / name) as temporary:
                shutil.copyfile(picture, temporary)
    poses = session.group("camera").get("key_frames")
    moved = {}
    for name, pose in poses.items() if isinstance(poses, dict) else ():
        try:
            T_world_camera = np.array(pose, np.float64).reshape(4, 4)
            T_world_camera[:3, 3] += session.reader.attributes.site_origin - site_origin
            moved[f"{int(name) + first:06d}"] = T_world_camera.round(6).tolist()
        except (ValueError, TypeError):
            continue
    return moved


def _count(session: Session) -> int:
    """How many frames a session has, used or not."""
    frames = session.group("sequence").get("frames")
    return frames if isinstance(frames, int) else session.reader.frames_fused


def _metrics(
    sessions: Sequence[Session], reader: MapReader, key_frames: dict[str, Any], notes: list[str]
) -> dict[str, Any]:
    """What metrics.json holds: sums over the sessions, and what they have in common."""
    params, rule = stored_fusion(reader.attributes.fusion, reader.classes, "the map")
    sequences = [session.group("sequence") for session in sessions]
    names = [session.name for session in sessions]
    cameras = [
        {key: value for key, value in session.group("camera").items() if key != "key_frames"} for session in sessions
    ]
    camera = cameras[0] if all(camera == cameras[0] for camera in cameras) else {}
    if not camera:
        notes.append("the cameras of the runs differ, or are not known: what they saw is not told apart in scores")
    ranges = [found for session in sessions if (found := _range_m(session)) is not None]
    return {
        "jaxmap_version": jaxmap.__version__,
        "sequence": {
            "name": " + ".join(names),
            "dataset": _common(sequence.get("dataset") for sequence in sequences),
            "frames": sum(map(_count, sessions)),
            "fused": reader.frames_fused,
            "skipped": [
                skipped | {"frame": f"{name}: {skipped.get('frame')}"}
                for name, sequence in zip(names, sequences, strict=True)
                for skipped in sequence.get("skipped") or ()
                if isinstance(skipped, dict)
            ],
            "crs": reader.attributes.crs,
            "site_origin": np.asarray(reader.attributes.site_origin, np.float64).tolist(),
            "path_length_m": round(sum(float(sequence.get("path_length_m") or 0) for sequence in sequences), 3),
            "notes": [
                *notes,
                *(
                    f"{name}: {note}"
                    for name, sequence in zip(names, sequences, strict=True)
                    for note in sequence.get("notes") or ()
                ),
            ],
        },
        **({"camera": camera | {"key_frames": key_frames}} if camera else {}),
        "grid": {
            **grid_metrics(reader.grid),
            **({"depth_range_m": [min(a for a, _ in ranges), max(b for _, b in ranges)]} if ranges else {}),
        },
        "labeller": _common(session.metrics.get("labeller") for session in sessions),
        **({"model": model} if (model := _common(session.metrics.get("model") for session in sessions)) else {}),
        "points": {"fused": sum(int(session.group("points").get("fused") or 0) for session in sessions)},
        "voxels": count_voxels(reader, params, rule),
        "merged": [str(session.folder.path) for session in sessions],
    }


def _common(values: Any) -> Any:
    """The value that all have; None where they differ."""
    first, *others = values
    return first if all(other == first for other in others) else None


def _range_m(session: Session) -> tuple[float, float] | None:
    """The depths that a run has mapped."""
    match session.group("grid").get("depth_range_m"):
        case [float() | int() as least, float() | int() as most]:
            return least, most
    return None
