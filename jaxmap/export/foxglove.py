"""A run as one MCAP file for Foxglove: poses, key frames, voxels and the top-down layers on a time line."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.export.source import Camera, Source, Track, optional, stamp_ns
from jaxmap.export.voxels import OccupiedVoxels
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE

WORLD, CAMERA = "map", "camera_left"
_UINT8, _FLOAT32 = 1, 7
_MOST_CELLS = 1 << 23
_MOST_COLUMNS = 1 << 24
_PACKAGES = "mcap-protobuf-support and foxglove-schemas-protobuf"


def write_foxglove(source: Source, path: Path) -> None:
    """Writes Foxglove's own messages, relative to the site origin, in the frame `map`: x east, y north, z up.

    At its time, each pose of the rectified left camera (`/tf`) and each key frame with its camera (`/camera/image`,
    `/camera/calibration`). At the first time, so that they are there whatever is shown: the whole path (`/path`), the
    occupied voxels in their true shape (`/map/voxels`, a large map in several topics) and the top-down layers
    (`/map/ground`: colours, label, height, probabilities, hazards). Cells without a surface are transparent.

    Raises:
        JaxmapError: the packages are missing, the top-down map is too large for one message, or the disk refuses.
    """
    writer_module = optional("mcap_protobuf.writer", _PACKAGES, "MCAP for Foxglove")
    optional("foxglove_schemas_protobuf", _PACKAGES, "MCAP for Foxglove")
    track = source.track
    first_s = float(track.timestamps_s[0]) if len(track.timestamps_s) else 0.0
    with atomic_path(path) as temporary, temporary.open("wb") as stream, writer_module.Writer(stream) as writer:

        def send(topic: str, time_s: float, kind: str, **values: Any) -> None:
            at_ns = stamp_ns(time_s)
            message = _message(kind, timestamp=_stamp(at_ns), **values)
            writer.write_message(topic, message, at_ns, at_ns)

        for topic, kind, values in _poses(track):
            send(topic, first_s, kind, **values)
        for number, group in enumerate(_groups(source)):
            send("/map/voxels" + (f"/{number}" if number else ""), first_s, "VoxelGrid", **_voxels(source, group))
        if (ground := _ground(source)) is not None:
            send("/map/ground", first_s, "Grid", **ground)
        for time_s, T, xyzw in zip(track.timestamps_s.tolist(), track.T_world_camera, track.quaternions, strict=True):
            send("/tf", time_s, "FrameTransform", **_transform(CAMERA, T, xyzw))
        for frame in track.key_frames:
            image = dict(data=frame.image, format=frame.form)
            send("/camera/image", frame.timestamp_s, "CompressedImage", frame_id=CAMERA, **image)
            send("/camera/calibration", frame.timestamp_s, "CameraCalibration", **_calibration(frame.camera))


def _poses(track: Track) -> Iterator[tuple[str, str, dict[str, Any]]]:
    if len(track.T_world_camera):
        poses = [_pose(T[:3, 3], xyzw) for T, xyzw in zip(track.T_world_camera, track.quaternions, strict=True)]
        yield "/path", "PosesInFrame", dict(frame_id=WORLD, poses=poses)


def _groups(source: Source) -> Iterator[list[OccupiedVoxels]]:
    """Blocks of voxels, as many at once as one message holds."""
    held: list[OccupiedVoxels] = []
    low, high = np.zeros(3, int), np.zeros(3, int)
    for voxels in source.voxels():
        here = voxels.index.min(axis=0), voxels.index.max(axis=0) + 1
        grown = (np.minimum(low, here[0]), np.maximum(high, here[1])) if held else here
        if held and np.prod(grown[1] - grown[0]) > _MOST_CELLS:
            yield held
            held, grown = [], here
        held.append(voxels)
        low, high = grown
    if held:
        yield held


def _voxels(source: Source, group: list[OccupiedVoxels]) -> dict[str, Any]:
    index = np.concatenate([voxels.index for voxels in group])
    low, shape = index.min(axis=0), np.ptp(index, axis=0) + 1
    cells = np.zeros((*shape[::-1], 4), np.uint8)
    label = np.concatenate([voxels.label for voxels in group])
    centres = np.concatenate([voxels.centres_world for voxels in group])
    x, y, z = (index - low).T
    cells[z, y, x, :3], cells[z, y, x, 3] = source.colours_of(centres, label), 255
    return dict(
        frame_id=WORLD,
        pose=_pose(source.corner_m + low * source.size_m),
        row_count=int(shape[1]),
        column_count=int(shape[0]),
        cell_size=_message("Vector3", **dict(zip("xyz", source.size_m.tolist(), strict=True))),
        slice_stride=int(4 * shape[0] * shape[1]),
        row_stride=int(4 * shape[0]),
        cell_stride=4,
        fields=_fields(("red", "green", "blue", "alpha"), _UINT8, 0),
        data=cells.tobytes(),
    )


def _ground(source: Source) -> dict[str, Any] | None:
    """The top-down layers; None where nothing was observed."""
    columns = source.whole(_MOST_COLUMNS, "Foxglove")
    if columns is None:
        return None
    top, (width, depth) = columns.top, columns.top.observed.shape
    layers = {"label": np.where(top.label == IGNORE, np.nan, top.label), "height_m": columns.height_m}
    layers |= {
        f"probability_{name}": np.where(top.observed, values, np.nan)
        for name, values in zip(source.classes, top.probability, strict=True)
    }
    layers |= columns.layers
    table = np.zeros((depth, width), np.dtype([("colour", "u1", 4), ("layers", "<f4", len(layers))]))
    at = np.argwhere(top.observed)
    corner_m = source.corner_m[:2] + np.asarray(columns.corner) * source.size_m[:2]
    points = np.column_stack([corner_m + (at + 0.5) * source.size_m[:2], columns.height_m[tuple(at.T)]])
    colours = np.full((len(at), 4), 255, np.uint8)
    colours[:, :3] = source.colours_of(points, np.asarray(top.label)[tuple(at.T)])
    table["colour"][at[:, 1], at[:, 0]] = colours
    table["layers"] = np.stack([values.T for values in layers.values()], axis=-1)
    lowest_m = float(np.nanmin(columns.height_m))
    x_m, y_m = source.size_m[:2].tolist()
    return dict(
        frame_id=WORLD,
        pose=_pose(np.append(corner_m, lowest_m)),
        column_count=width,
        cell_size=_message("Vector2", x=x_m, y=y_m),
        row_stride=table.itemsize * width,
        cell_stride=table.itemsize,
        fields=_fields(("red", "green", "blue", "alpha"), _UINT8, 0) + _fields(layers, _FLOAT32, 4),
        data=table.tobytes(),
    )


def _fields(names: Any, kind: int, start: int) -> list[Any]:
    size = 1 if kind == _UINT8 else 4
    return [_message("PackedElementField", name=n, offset=start + size * i, type=kind) for i, n in enumerate(names)]


def _calibration(camera: Camera) -> dict[str, Any]:
    fx, fy, cx, cy, width, height = camera
    K = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    P = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return dict(frame_id=CAMERA, width=width, height=height, K=K, P=P, R=np.eye(3).ravel().tolist())


def _transform(child: str, T: np.ndarray, xyzw: np.ndarray) -> dict[str, Any]:
    place = _message("Vector3", **dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
    rotation = _message("Quaternion", **dict(zip("xyzw", xyzw.tolist(), strict=True)))
    return dict(parent_frame_id=WORLD, child_frame_id=child, translation=place, rotation=rotation)


def _pose(position: np.ndarray, xyzw: np.ndarray | None = None) -> Any:
    """A pose; not turned where there is no rotation."""
    xyzw = np.array([0.0, 0.0, 0.0, 1.0]) if xyzw is None else xyzw
    place = _message("Vector3", **dict(zip("xyz", position.tolist(), strict=True)))
    return _message(
        "Pose", position=place, orientation=_message("Quaternion", **dict(zip("xyzw", xyzw.tolist(), strict=True)))
    )


def _stamp(at_ns: int) -> Any:
    from google.protobuf.timestamp_pb2 import Timestamp

    return Timestamp(seconds=at_ns // 10**9, nanos=at_ns % 10**9)


def _message(kind: str, **values: Any) -> Any:
    """A message of Foxglove's schemas."""
    return getattr(import_module(f"foxglove_schemas_protobuf.{kind}_pb2"), kind)(**values)
