"""The options of reading a sequence; light to import, so that the command line can hold them."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Annotated, Literal

from jaxmap.host.settings import AnyNumber, Place, Positive, count, options

PosesWorld = Literal["auto", "z_up", "z_down", "y_up", "camera"]
"""World of a pose file: z up; x north, y east, z down; x right, y up, z backward; x right, y down, z forward; or
detected from the cameras' up axes."""

PoseConvention = Literal["auto", "optical", "body", "frd", "opengl"]
"""Axes of the frame whose poses a file holds: x right, y down, z forward; x forward, y left, z up; x forward, y right,
z down; x right, y up, z backward; or what the form of the file says."""

PosesAre = Literal["T_world_camera", "T_camera_world"]
QuaternionOrder = Literal["auto", "xyzw", "wxyz"]
TimeUnit = Literal["auto", "s", "ms", "us", "ns"]
LengthUnit = Literal["m", "cm", "mm"]


Bits = Literal[8, 10, 12, 14, 16]
"""What cameras deliver; files that hold more than 8 hold 16."""

Offset = Annotated[float, AnyNumber]


@options("bag")
class BagOptions:
    """The topics and frames of a ROS bag; found by their names where they are not given."""

    left: str | None = None
    """Image topic of the left camera."""
    right: str | None = None
    """Image topic of the right camera."""
    left_info: str | None = None
    """CameraInfo topic of the left camera; by default camera_info beside its images."""
    right_info: str | None = None
    """CameraInfo topic of the right camera."""
    images_are: Literal["auto", "raw", "rectified"] = "auto"
    """Whether the images are rectified: by default by ROS's names (image_rect*), else by their distortion."""
    poses: str | None = None
    """Topic of the poses: Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped, Path, tf or NavSatFix."""
    child: str | None = None
    """Frame (of tf) whose poses that topic gives, where its messages do not say so."""
    attitude: str | None = None
    """Imu topic whose orientation goes with the positions of NavSatFix."""
    gps: str | None = None
    """NavSatFix topic that the poses are turned and moved onto, which georeferences the map (UTM)."""
    max_pair_gap_s: Annotated[float, Positive] = 0.005
    """Left and right images farther apart in time make no pair."""


@options("")
class ReadOptions:
    """How a sequence is read, and which of its frames.

    `start`, `stop` and `stride` are a Python slice of the frames on disk. Poses are `T_world_camera` of the left
    camera; a mounting in the calibration file moves the sequence's own poses, and those of `poses` where these are of a
    body by `pose_convention`.

    Raises:
        UsageError: a value of another type or out of its bounds.
    """

    dataset: str = "auto"
    """The reader: auto, kitti, euroc, folder, katwijk, planetary, asp, rosbag, madmax, tartanair or middlebury."""
    poses: Path | None = None
    """Pose file in place of the sequence's own: TUM, KITTI or EuRoC text; or odometry: estimated from the images."""
    poses_world: PosesWorld = "auto"
    """World of the poses: z up, z down (north, east, down), y up, camera-like (y down), or find out."""
    poses_up: tuple[Offset, Offset, Offset] | None = None
    """Direction of up in that world, where it is not level, as a SLAM's that begins at a camera which looks down;
    jaxmap check measures it."""
    pose_convention: PoseConvention = "auto"
    """Axes that the poses describe: of the camera (optical: x right, y down, z forward), of a body at the camera's
    place (body: x forward, y left, z up; frd: x forward, y right, z down), of OpenGL (x right, y up, z backward), or
    as the form of the file says."""
    poses_are: PosesAre = "T_world_camera"
    """What takes points into what: the poses of the camera in the world, or the inverse."""
    quaternion: QuaternionOrder = "auto"
    """Order of a quaternion in the pose file; by default as its header or its form says."""
    poses_time_unit: TimeUnit = "auto"
    """Unit of the times in the pose file; by default told from their size."""
    poses_unit: LengthUnit = "m"
    """Unit of the positions in the pose file."""
    baseline_unit: LengthUnit = "m"
    """Unit in which the calibration gives the stereo baseline."""
    calibration: Path | None = None
    """Camera file in place of the sequence's own: jaxmap's YAML, or one of OpenCV, ROS, Kalibr or MATLAB."""
    camera: str | None = None
    """Which stereo camera, where there are several; Katwijk: loccam (the default) or pancam; KITTI: grey (the default)
    or color; planetary archives: navcam, front_hazcam, rear_hazcam, pancam, mastcam, mastcam_z or other."""
    image_bits: Bits | None = None
    """Bits that 16-bit images use: 8, 10, 12, 14 or 16; by default found from several images of both cameras."""
    antenna_m: tuple[Offset, Offset, Offset] | None = None
    """Katwijk: the GPS antenna in the IMU frame (x backward, y right, z up), by default 0.221 -0.052 1.5785."""
    crs: str | None = None
    """Coordinate reference system of the poses, such as EPSG:32631; it goes into the map and the GeoTIFF."""
    max_pose_gap_s: Annotated[float, Positive] = 1.0
    """Poses farther apart are not bridged."""
    start: Annotated[int, Place] = 0
    """First frame."""
    stop: Annotated[int, Place] | None = None
    """Frame to stop before, from the end if negative; by default the end."""
    stride: Annotated[int, count(2**31 - 1)] = 1
    """Take every so many frames."""
    bag: BagOptions = field(default_factory=BagOptions)
