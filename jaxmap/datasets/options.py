"""The options of reading a sequence; light to import, so that the command line can hold them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from jaxmap.host.settings import Positive, options

PosesWorld = Literal["auto", "z_up", "camera"]
"""World of a pose file: z up; x right, y down, z forward; or detected from the cameras' up axes."""


@options("")
class ReadOptions:
    """How a sequence is read, and which of its frames.

    `start`, `stop` and `stride` are a Python slice of the frames on disk. Poses are `T_world_camera` of the left
    camera; a mounting in the calibration file moves the sequence's own poses, not those of `poses`.

    Raises:
        UsageError: a value of another type or out of its bounds.
    """

    dataset: str = "auto"
    """The reader: auto, kitti, euroc, folder or katwijk."""
    poses: Path | None = None
    """Pose file in place of the sequence's own: TUM, KITTI or EuRoC text; or odometry: estimated from the images."""
    poses_world: PosesWorld = "auto"
    """World of the poses: z up, camera-like (y down), or find out."""
    calibration: Path | None = None
    """Camera file in place of the sequence's own."""
    camera: str | None = None
    """Which stereo camera, where there are several; Katwijk: loccam (the default) or pancam."""
    antenna_m: tuple[float, float, float] | None = None
    """Katwijk: the GPS antenna in the IMU frame (x backward, y right, z up), by default 0.221 -0.052 1.5785."""
    crs: str | None = None
    """Coordinate reference system of the poses, such as EPSG:32631; it goes into the map and the GeoTIFF."""
    max_pose_gap_s: Annotated[float, Positive] = 1.0
    """Poses farther apart are not bridged."""
    start: int = 0
    """First frame."""
    stop: int | None = None
    """Frame to stop before, from the end if negative; by default the end."""
    stride: Annotated[int, Positive] = 1
    """Take every so many frames."""
