"""The map of a run in other forms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Literal

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.export.formats import FORMATS, OF_EACH_RUN
from jaxmap.export.source import Camera, Colours, KeyFrame, Source, Track
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import read_bytes
from jaxmap.mapping.store import MapReader
from jaxmap.report.drive_view import seen_frames
from jaxmap.report.image_colours import SeenFrame, brightest_of, image_colours
from jaxmap.report.run_contents import find_pictures
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.run_frames import read_run_frames

_MOST_PICTURE_BYTES = 256 << 20


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
    frames = _read_frames(folder) if colours == "images" or "mcap" in formats else {}
    if colours == "images" and not frames:
        raise JaxmapError(
            "the run has no pictures of key frames to take colours from",
            where=folder.path,
            fix="export with --colours classes, or map again",
        )
    of_points: Colours | None = None
    if colours == "images":
        seen, brightest = [*frames.values()], brightest_of([*frames.values()])
        of_points = lambda points_world, label: image_colours(points_world, seen, brightest)  # noqa: E731
    source = Source(reader, folder.map, _read_track(folder, reader, frames), of_points, notify)
    written: list[str] = []
    for done, name in enumerate(dict.fromkeys(formats)):
        paths = [folder.path / file for file in FORMATS[name].files]
        module, _, function = FORMATS[name].writer.partition(":")
        finished = getattr(import_module(module), function)(source, *paths)
        written += [str(path.relative_to(folder.path)) + "/" * path.is_dir() for path in (finished or paths)]
        advance(done + 1)
    return written


def _read_frames(folder: RunFolder) -> dict[str, SeenFrame]:
    """The key frames of the run, by their number."""
    try:
        camera = read_json(folder.metrics)["camera"]
    except (JaxmapError, KeyError, TypeError):
        return {}
    return seen_frames(find_pictures(folder.path), camera if isinstance(camera, dict) else {})


def _read_track(folder: RunFolder, reader: MapReader, frames: dict[str, SeenFrame]) -> Track:
    """The poses of the fused frames, and the key frames at their times.

    Raises:
        JaxmapError: poses.tum cannot be read.
    """
    if not folder.poses.exists():
        return Track()
    known = read_run_frames(folder, np.asarray(reader.attributes.site_origin, np.float64))
    times_s = dict(zip(known.index.tolist(), known.timestamps_s.tolist(), strict=True))
    pictures, key_frames = find_pictures(folder.path) if frames else {}, []
    for name, seen in frames.items():
        if int(name) in times_s:
            path, (height, width) = pictures[name]["left"], seen.image.shape[:2]
            camera = Camera(*seen.focal_px, *seen.centre_px, width, height)
            image = read_bytes(path, _MOST_PICTURE_BYTES)
            key_frames.append(KeyFrame(times_s[int(name)], seen.T_world_camera, camera, image, path.suffix[1:]))
    return Track(known.timestamps_s, known.T_world_camera, key_frames)
