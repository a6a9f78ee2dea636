"""The map of a run in other forms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, Literal

import numpy as np

from jaxmap.datasets.poses import read_poses
from jaxmap.errors import JaxmapError
from jaxmap.export.formats import FORMATS, OF_EACH_RUN
from jaxmap.export.source import KeyFrame, Pinholes, Source, Track
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import read_bytes
from jaxmap.mapping.store import MapReader
from jaxmap.report.drive_view import seen_frames
from jaxmap.report.image_colours import SeenFrame, image_colours
from jaxmap.report.run_contents import find_pictures
from jaxmap.runs.folder import RunFolder

_MOST_PICTURE_BYTES = 256 << 20
_NEAR_M = 1e-4


def write_exports(
    folder: RunFolder,
    reader: MapReader,
    formats: Sequence[str] = OF_EACH_RUN,
    *,
    colours: Literal["classes", "images"] = "classes",
    notify: Callable[[str], None] = lambda line: None,
    advance: Callable[[int], object] = lambda done: None,
) -> list[str]:
    """Writes the map in other forms, going through it block by block, and returns the names of the files.

    Pictures and time lines show the poses of poses.tum and the key frames, where there are any.

    Args:
        folder: of the run.
        reader: its map.
        formats: of `FORMATS`.
        colours: of points and surfaces: by class, or those of the key frames.
        notify: takes lines for the user.
        advance: called with the number of forms that are done.

    Raises:
        JaxmapError: a form cannot hold the map, the run has lost what it needs, or the disk is full or refuses; forms
            before it are written.
    """
    frames = _read_frames(folder) if colours == "images" or "foxglove" in formats else {}
    if colours == "images" and not frames:
        raise JaxmapError(
            "the run has no pictures of key frames to take colours from",
            where=folder.path,
            fix="export with --colours classes, or map again",
        )
    seen = [*frames.values()]
    source = Source(
        reader,
        folder.map,
        _read_track(folder, reader, frames),
        (lambda points_world, label: image_colours(points_world, seen)) if colours == "images" else None,
        notify,
    )
    written: list[str] = []
    for done, name in enumerate(dict.fromkeys(formats)):
        paths = [folder.path / file for file in FORMATS[name].files]
        module, _, function = FORMATS[name].writer.partition(":")
        finished = getattr(import_module(module), function)(source, *paths)
        written += [path.name for path in (finished or paths)]
        advance(done + 1)
    return written


def _read_frames(folder: RunFolder) -> dict[str, SeenFrame]:
    return seen_frames(find_pictures(folder.path), _camera(folder))


def _camera(folder: RunFolder) -> dict[str, Any]:
    """The camera of metrics.json; empty where that is missing or of another form."""
    try:
        camera = read_json(folder.metrics)["camera"]
    except (JaxmapError, KeyError, TypeError):
        return {}
    return camera if isinstance(camera, dict) else {}


def _read_track(folder: RunFolder, reader: MapReader, frames: dict[str, SeenFrame]) -> Track:
    """The poses of the fused frames, and the key frames at their times.

    Raises:
        JaxmapError: poses.tum cannot be read.
    """
    if not folder.poses.exists():
        return Track()
    poses = read_poses(folder.poses)
    T = np.array(poses.T, np.float64)
    T[:, :3, 3] -= reader.attributes.site_origin
    times_s = np.arange(len(T), dtype=np.float64) if poses.timestamps_s is None else poses.timestamps_s
    pictures, key_frames = find_pictures(folder.path) if frames else {}, []
    for name, frame in frames.items():
        # Rectifying turns a camera about its centre: the frame is the one that was there.
        off_m = np.linalg.norm(T[:, :3, 3] - frame.T_world_camera[:3, 3], axis=-1)
        picture = pictures[name]["left"]
        # The others are smaller than the images that the camera is of.
        if picture.suffix == ".png" and len(off_m) and off_m.min() < _NEAR_M:
            image = read_bytes(picture, _MOST_PICTURE_BYTES)
            key_frames.append(KeyFrame(float(times_s[off_m.argmin()]), frame.T_world_camera, image))
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
    camera = _camera(folder) if frames else {}
    known = all(isinstance(camera.get(name), int | float) for name in names)
    pinholes = Pinholes(*(camera[name] for name in names)) if known else None
    return Track(times_s, T, pinholes, key_frames)
