"""Small ROS bags, written by rosbags: of ROS 1 and of ROS 2, in sqlite3 and MCAP."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import scenes
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

Kind = Literal["ros1", "sqlite3", "mcap"]
KINDS: tuple[Kind, ...] = ("ros1", "sqlite3", "mcap")
TF = "tf2_msgs/msg/TFMessage"


class Sent(NamedTuple):
    """A message on its way into a bag."""

    topic: str
    time_ns: int
    value: Any


@cache
def _types(ros1: bool) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if TF not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return store


class Messages:
    """Makes messages of one generation of ROS."""

    def __init__(self, kind: Kind) -> None:
        self.kind: Kind = kind
        self.store = _types(kind == "ros1")

    def make(self, name: str, *values: Any) -> Any:
        """A message of a type such as `sensor_msgs/Image`, by its fields in order."""
        return self.store.types[name.replace("/", "/msg/")](*values)

    def header(self, time_ns: int, frame: str = "") -> Any:
        stamp = self.make("builtin_interfaces/Time", time_ns // 10**9, time_ns % 10**9)
        return self.make("std_msgs/Header", *([0] if self.kind == "ros1" else []), stamp, frame)

    def image(self, time_ns: int, pixels: np.ndarray, encoding: str, frame: str = "", padding: int = 0) -> Any:
        """Rows are padded by so many bytes."""
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        data = np.pad(rows, ((0, 0), (0, padding)))
        height, width = pixels.shape[:2]
        header = self.header(time_ns, frame)
        return self.make("sensor_msgs/Image", header, height, width, encoding, 0, data.shape[1], data.ravel())

    def compressed(self, time_ns: int, data: bytes, form: str = "jpeg", frame: str = "") -> Any:
        return self.make(
            "sensor_msgs/CompressedImage", self.header(time_ns, frame), form, np.frombuffer(data, np.uint8)
        )

    def info(self, size_px, K, D, R, P, model: str = "plumb_bob", time_ns: int = 0, frame: str = "") -> Any:
        roi = self.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        K, D, R, P = (np.asarray(values, np.float64).ravel() for values in (K, D, R, P))
        header = self.header(time_ns, frame)
        return self.make("sensor_msgs/CameraInfo", header, size_px[1], size_px[0], model, D, K, R, P, 0, 0, roi)

    def pose(self, T: np.ndarray) -> Any:
        at = self.make("geometry_msgs/Point", *T[:3, 3].tolist())
        return self.make("geometry_msgs/Pose", at, self._turn(T))

    def pose_stamped(self, time_ns: int, T: np.ndarray, frame: str = "map") -> Any:
        return self.make("geometry_msgs/PoseStamped", self.header(time_ns, frame), self.pose(T))

    def odometry(self, time_ns: int, T: np.ndarray, child: str, frame: str = "odom") -> Any:
        still = self.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        twist = self.make("geometry_msgs/Twist", still, still)
        return self.make(
            "nav_msgs/Odometry",
            self.header(time_ns, frame),
            child,
            self.make("geometry_msgs/PoseWithCovariance", self.pose(T), np.zeros(36)),
            self.make("geometry_msgs/TwistWithCovariance", twist, np.zeros(36)),
        )

    def tf(self, time_ns: int, *edges: tuple[str, str, np.ndarray]) -> Any:
        """Transforms by parent, child and T_parent_child."""
        transforms = [
            self.make(
                "geometry_msgs/TransformStamped",
                self.header(time_ns, parent),
                child,
                self.make(
                    "geometry_msgs/Transform",
                    self.make("geometry_msgs/Vector3", *T[:3, 3].tolist()),
                    self._turn(T),
                ),
            )
            for parent, child, T in edges
        ]
        return self.make("tf2_msgs/TFMessage", transforms)

    def fix(self, time_ns: int, latitude_deg: float, longitude_deg: float, altitude_m: float, frame: str = "") -> Any:
        status = self.make("sensor_msgs/NavSatStatus", 0, 1)
        header = self.header(time_ns, frame)
        place = (latitude_deg, longitude_deg, altitude_m)
        return self.make("sensor_msgs/NavSatFix", header, status, *place, np.zeros(9), 0)

    def imu(self, time_ns: int, R: np.ndarray, frame: str = "") -> Any:
        T = np.eye(4)
        T[:3, :3] = R
        still = self.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        header = self.header(time_ns, frame)
        return self.make("sensor_msgs/Imu", header, self._turn(T), np.zeros(9), still, np.zeros(9), still, np.zeros(9))

    def _turn(self, T: np.ndarray) -> Any:
        return self.make("geometry_msgs/Quaternion", *Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist())

    def write(self, path: Path, sent: list[Sent]) -> Path:
        """Writes a bag: a file of ROS 1, a folder of ROS 2."""
        if self.kind == "ros1":
            writer = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
        with writer:
            connections = {}
            for topic, time_ns, value in sent:
                name = value.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name, typestore=self.store)
                serialise = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
                writer.write(connections[topic], time_ns, serialise(value, name))
        return path


SIZE_PX = (scenes.WIDTH_PX, scenes.HEIGHT_PX)
K = [[scenes.F_PX, 0, scenes.CX_PX], [0, scenes.F_PX, scenes.CY_PX], [0, 0, 1]]
FRAMES = 3


def time_ns(index: int) -> int:
    return round(scenes.timestamp_s(index) * 1e9)


def P(side: str) -> np.ndarray:
    return np.column_stack([K, [-scenes.F_PX * scenes.BASELINE_M if side == "right" else 0.0, 0, 0]])


def images(messages: Messages, root: str = "/stereo", frame: str = "cam_optical", shift_ns: int = 0) -> list[Sent]:
    """Rectified pairs and their CameraInfo; headers say when they were taken, the recording is 20 ms late."""
    sent = []
    for index in range(FRAMES):
        taken_ns, pair = time_ns(index), scenes.scene_frame(index)
        for side, pixels, late_ns in (("left", pair.left, 0), ("right", pair.right, shift_ns)):
            info = messages.info(SIZE_PX, K, np.zeros(5), np.eye(3), P(side), time_ns=taken_ns, frame=frame)
            message = messages.image(taken_ns + late_ns, pixels, "mono8", frame, padding=3)
            topic = f"{root}/{side}/image_rect"
            sent += [
                Sent(f"{root}/{side}/camera_info", taken_ns + 20_000_000, info),
                Sent(topic, taken_ns + 20_000_000, message),
            ]
    return sent


def camera_poses(messages: Messages, topic: str = "/pose") -> list[Sent]:
    return [
        Sent(topic, time_ns(index), messages.pose_stamped(time_ns(index), scenes.pose(index)))
        for index in range(FRAMES)
    ]


def bag(tmp_path: Path, kind: Kind, sent: list[Sent]) -> Path:
    name = "log.bag" if kind == "ros1" else "log"
    return Messages(kind).write(tmp_path / name, sorted(sent, key=lambda message: message.time_ns))


def whole_bag(tmp_path: Path, kind: Kind = "ros1") -> Path:
    messages = Messages(kind)
    return bag(tmp_path, kind, images(messages) + camera_poses(messages))
