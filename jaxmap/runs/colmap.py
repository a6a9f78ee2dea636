"""`jaxmap export RUN --format colmap`: a run as a COLMAP model with its images."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxmap.datasets.registry import open_sequence
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.export.colmap import FILES, write_colmap
from jaxmap.export.source import Source
from jaxmap.host.bounded_text import read_json, read_yaml
from jaxmap.host.files import atomic_path
from jaxmap.mapping.observations import read_attributes
from jaxmap.report.drive_view import seen_frames
from jaxmap.report.image_colours import image_colours
from jaxmap.report.run_contents import find_pictures
from jaxmap.runs.config import load_config, observations_in
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.run_frames import read_run_frames
from jaxmap.stereo.front_end import StereoFrontEnd

IMAGES = "images"
_QUALITY = 95


def export_colmap(source: Source, out: Path) -> Iterable[Path]:
    """Writes the model into a folder of the run, and the rectified left images, where the sequence is still at hand.

    Points are the occupied voxels in the colours that the key frames show there.

    Returns:
        What was written.

    Raises:
        JaxmapError: the run has no poses, names or camera, or the disk is full or refuses.
    """
    folder = RunFolder(out.parent)
    frames = read_run_frames(folder, source.site_origin)
    if frames.camera is None or frames.notes:
        raise JaxmapError(frames.notes[0], where=folder.path, fix="map again")
    files = [f"{name}.jpg" for name in frames.names]
    centres = np.concatenate([np.zeros((0, 3), np.float32), *(voxels.centres_world for voxels in source.voxels())])
    key_frames = seen_frames(find_pictures(folder.path), read_json(folder.metrics)["camera"])
    colours = image_colours(centres, [*key_frames.values()])
    write_colmap(out, frames.camera, frames.size_px, files, frames.T_world_camera, centres, colours, source.site_origin)
    written = [out / name for name in FILES]
    try:
        _write_images(folder, set(frames.names))
    except (JaxmapError, KeyError, TypeError, ValueError) as error:
        source.notify(f"note: no images are written ({error}): images.txt names the rectified left ones")
        return written
    return [*written, out / IMAGES]


def _write_images(folder: RunFolder, names: set[str]) -> None:
    """Rectifies the left images of a run once more, as it did, and writes them.

    Raises:
        JaxmapError: the sequence cannot be opened as it was, or the disk is full or refuses.
    """
    from PIL import Image

    config, source = load_config(str(folder.config)), str(read_yaml(folder.config)["sequence"])
    if (perceived := observations_in(source)) is not None:
        source = read_attributes(perceived).sequence
    # Only images are wanted: poses that took long to find are not sought again.
    if str(config.poses) == "odometry":
        config = replace(config, poses=folder.poses, poses_world="auto", poses_up=None)
    sequence = open_sequence(source, config)
    turn = read_json(folder.metrics)["camera"].get("alignment_rad")
    front_end = StereoFrontEnd(sequence.camera, config.stereo, None if turn is None else np.array(turn, np.float64))
    done = 0
    for frame in sequence.frames:
        if frame.name not in names:
            continue
        try:
            pair = sequence.read_pair(frame)
            left, _ = front_end.rectify(pair.left, pair.right)
        except FrameError as error:
            raise error.at(f"frame {frame.name}") from error
        with atomic_path(folder.path / "colmap" / IMAGES / f"{frame.name}.jpg") as temporary:
            Image.fromarray(left).save(temporary, quality=_QUALITY)
        done += 1
    if done < len(names):
        raise JaxmapError(f"{len(names) - done} of {len(names)} images are gone", where=source)
