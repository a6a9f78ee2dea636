"""The top-down map as a grid_map message of ROS 2, with the path and the transforms of the camera, in one MCAP file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmap.errors import JaxmapError
from jaxmap.export.source import Source, optional, stamp_ns
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE

FRAME, CAMERA = "map", "camera_left_optical"
_MOST_CELLS = 1 << 24
_DEFINITIONS = {
    "grid_map_msgs/msg/GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\n"
    "geometry_msgs/Pose pose\n",
    "grid_map_msgs/msg/GridMap": "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info\nstring[] layers\n"
    "string[] basic_layers\nstd_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index\n",
}
"""Of grid_map for ROS 2, which rosbags does not know."""


def write_grid_map(source: Source, path: Path) -> None:
    """Writes `/grid_map` (grid_map_msgs/GridMap), `/path` (nav_msgs/Path) and `/tf` (one transform a frame).

    All is relative to the site origin, in the frame `map`: x east, y north, z up. The layers are `elevation` (basic),
    `label`, `probability_NAME` and those of the map. Row 0, column 0 of a layer is its greatest x and y, as grid_map
    has it, and arrays go column by column.

    Raises:
        JaxmapError: mcap is missing, columns are no squares, nothing was observed, the map is too large for one
            message, or the disk refuses.
    """
    writer_module = optional("mcap.writer", "mcap", "MCAP")
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    track = source.track
    times_s = track.timestamps_s if len(track.timestamps_s) else np.zeros(1)
    messages = [*_poses(store, source), ("/grid_map", float(times_s[-1]), _grid_map(store, source, float(times_s[-1])))]
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        writer = writer_module.Writer(stream)
        writer.start(profile="ros2", library="jaxmap")
        channels: dict[str, int] = {}
        for topic, time_s, message in messages:
            kind = message.__msgtype__
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            at_ns = stamp_ns(time_s)
            writer.add_message(channels[topic], at_ns, bytes(store.serialize_cdr(message, kind)), at_ns)
        writer.finish()


def _grid_map(store: Any, source: Source, time_s: float) -> Any:
    edge_m = source.square_cells("grid_map")
    columns = source.whole(_MOST_CELLS, "grid_map")
    if columns is None:
        raise source.nothing_observed("grid_map")
    top, (width, depth) = columns.top, columns.top.observed.shape
    if max(width, depth) > 2**16 - 1:
        raise JaxmapError(
            f"grid_map has at most {2**16 - 1} cells along an axis", where=source.where, fix="write a GeoTIFF"
        )
    layers = {"elevation": columns.height_m, "label": np.where(top.label == IGNORE, np.nan, top.label)}
    layers |= {
        f"probability_{name}": np.where(top.observed, values, np.nan)
        for name, values in zip(source.classes, top.probability, strict=True)
    }
    layers |= columns.layers
    middle_m = source.corner_m[:2] + (np.asarray(columns.corner) + np.array([width, depth]) / 2) * edge_m
    kind = store.types
    info = kind["grid_map_msgs/msg/GridMapInfo"](
        resolution=edge_m,
        length_x=width * edge_m,
        length_y=depth * edge_m,
        pose=_pose(store, np.append(middle_m, 0.0), np.array([0.0, 0.0, 0.0, 1.0])),
    )
    return kind["grid_map_msgs/msg/GridMap"](
        header=_header(store, time_s),
        info=info,
        layers=[*layers],
        basic_layers=["elevation"],
        data=[_array(store, values) for values in layers.values()],
        outer_start_index=0,
        inner_start_index=0,
    )


def _array(store: Any, values: Float[np.ndarray, "X Y"]) -> Any:
    rows, columns = values.shape
    dimension = store.types["std_msgs/msg/MultiArrayDimension"]
    layout = store.types["std_msgs/msg/MultiArrayLayout"](
        dim=[
            dimension(label="column_index", size=columns, stride=rows * columns),
            dimension(label="row_index", size=rows, stride=rows),
        ],
        data_offset=0,
    )
    data = np.ascontiguousarray(values[::-1, ::-1].T, np.float32).ravel()
    return store.types["std_msgs/msg/Float32MultiArray"](layout=layout, data=data)


def _poses(store: Any, source: Source) -> list[tuple[str, float, Any]]:
    """Transforms of each frame, and at the end the path."""
    track, kind = source.track, store.types
    if not len(track.timestamps_s):
        return []
    messages, stamped = [], []
    for time_s, T, xyzw in zip(track.timestamps_s.tolist(), track.T_world_camera, track.quaternions, strict=True):
        x, y, z = T[:3, 3].tolist()
        transform = kind["geometry_msgs/msg/TransformStamped"](
            header=_header(store, time_s),
            child_frame_id=CAMERA,
            transform=kind["geometry_msgs/msg/Transform"](
                translation=kind["geometry_msgs/msg/Vector3"](x=x, y=y, z=z), rotation=_quaternion(store, xyzw)
            ),
        )
        messages.append(("/tf", time_s, kind["tf2_msgs/msg/TFMessage"](transforms=[transform])))
        pose = _pose(store, T[:3, 3], xyzw)
        stamped.append(kind["geometry_msgs/msg/PoseStamped"](header=_header(store, time_s), pose=pose))
    last_s = float(track.timestamps_s[-1])
    path = kind["nav_msgs/msg/Path"](header=_header(store, last_s), poses=stamped)
    return [*messages, ("/path", last_s, path)]


def _pose(store: Any, position: np.ndarray, xyzw: np.ndarray) -> Any:
    x, y, z = position.tolist()
    point = store.types["geometry_msgs/msg/Point"](x=x, y=y, z=z)
    return store.types["geometry_msgs/msg/Pose"](position=point, orientation=_quaternion(store, xyzw))


def _quaternion(store: Any, xyzw: np.ndarray) -> Any:
    x, y, z, w = xyzw.tolist()
    return store.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _header(store: Any, time_s: float) -> Any:
    sec, nanosec = divmod(stamp_ns(time_s), 10**9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME)
