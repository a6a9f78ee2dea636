"""What all readers share: their options, the choice of poses, and joining the parts into a sequence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.base import FrameRef, StereoPair, StereoSequence
from jaxmap.datasets.calibration import read_mounting
from jaxmap.datasets.images import first_image_size_px, read_stereo_pair
from jaxmap.datasets.pose_files import read_poses
from jaxmap.datasets.poses import PosesWorld, PoseTrack, poses_at, split_site_origin, to_z_up, with_timestamps
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera


@dataclass(frozen=True)
class ReadOptions:
    """How a sequence is read.

    Attributes:
        dataset: the name of a reader, or `auto` to tell by the folder's content.
        poses: poses of the left camera in the world (TUM text, KITTI 3x4 text; EuRoC csv for EuRoC
            alone), instead of the sequence's own.
        poses_world: the world of the poses: `z_up`, `camera` (x right, y down, z forward), or
            `auto` to tell by which way the cameras' up axes point.
        calibration: a camera YAML, instead of the sequence's own calibration (Katwijk: or MATLAB's .mat). A mounting
            that it holds moves the sequence's own poses; those of `poses` are of the camera as it is.
        camera: which stereo camera, where a data set has several; by default its first.
        antenna_m: where the GPS antenna is on the rover, in the data set's IMU frame, where poses come from GPS.
        start, stop, stride: which frames, as a Python slice of the frames on disk.
        max_pose_gap_s: poses further apart are not interpolated.
        crs: the coordinate reference system of the poses, where the data do not say it.
    """

    dataset: str = "auto"
    poses: Path | None = None
    poses_world: PosesWorld = "auto"
    calibration: Path | None = None
    camera: str | None = None
    antenna_m: tuple[float, float, float] | None = None
    start: int = 0
    stop: int | None = None
    stride: int = 1
    max_pose_gap_s: float = 1.0
    crs: str | None = None


@dataclass(frozen=True)
class Reader:
    """One kind of data set.

    Attributes:
        name: what `ReadOptions.dataset` calls it.
        help: one line, which also says what is looked for.
        recognises: whether a folder is of this kind, by its content; it never raises.
        open: opens a folder.
        cameras: what `ReadOptions.camera` chooses among; empty where there is no choice.
    """

    name: str
    help: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, ReadOptions], StereoSequence]
    cameras: tuple[str, ...] = ()


def read_pose_track(
    options: ReadOptions, found: Path | None, looked_for: object, *, allow_body: bool = False
) -> PoseTrack:
    """The poses given by the options, else those found with the data.

    Args:
        options: `poses` goes before `found`.
        found: the data set's own pose file, or None.
        looked_for: where that file would be, for the error.
        allow_body: whether poses of a body (EuRoC csv) can be used.

    Raises:
        JaxmapError: there are none, or they are poses of a body and the reader cannot use them.
    """
    path = options.poses or found
    if path is None:
        raise JaxmapError(
            f"the sequence has no poses: there is no file {looked_for}",
            fix="give them with --poses FILE (TUM text, T_world_camera of the left camera)",
        )
    track = read_poses(Path(path))
    if track.child == "body" and not allow_body:
        raise JaxmapError(
            "EuRoC csv holds poses of the body, not of the camera",
            where=path,
            fix="give T_world_camera of the left camera as TUM text",
        )
    return track


def assemble(
    *,
    name: str,
    dataset: str,
    where: object,
    frames: Sequence[FrameRef],
    track: PoseTrack,
    camera: StereoCamera | StereoRig,
    options: ReadOptions,
    T_child_camera: Float64[np.ndarray, "*frames 4 4"] | None = None,
    crs: str | None = None,
    notes: Sequence[str] = (),
    read_pair: Callable[[FrameRef], StereoPair] = read_stereo_pair,
) -> StereoSequence:
    """Joins frames, poses and calibration into a sequence in a z-up world.

    The turn to z-up and the site origin are found from all frames that have a pose, so that parts
    of one sequence share their world; the selection comes after.

    Args:
        name: the sequence's name.
        dataset: the reader's name.
        where: the source, for error texts.
        frames: all frames on disk, in the order of time.
        track: their poses; without times, one for each frame.
        camera: the calibration.
        options: selection, world and gap.
        T_child_camera: the left camera in the child frame of the poses, for all frames or (N, 4, 4) for
            each; None where they are one.
        crs: the coordinate reference system of the poses.
        notes: what the reader found.
        read_pair: reads the images of one frame.

    Raises:
        JaxmapError: frames out of order, counts that disagree, an image of another size than the
            calibration's, a selection without frames or without poses.
    """
    timestamps_s = np.array([frame.timestamp_s for frame in frames], np.float64)
    _check_order(frames, timestamps_s, where)
    _check_image_size(frames, camera, where)
    if track.timestamps_s is None:
        track = with_timestamps(track, timestamps_s)
    assert track.timestamps_s is not None
    T_source_child, has_pose = poses_at(track, timestamps_s, options.max_pose_gap_s)

    selected = np.arange(len(frames))[options.start : options.stop : options.stride]
    if not len(selected):
        raise JaxmapError(
            f"start {options.start}, stop {options.stop}, stride {options.stride} select none of {len(frames)} frames",
            where=where,
            fix="choose another range",
        )
    kept = selected[has_pose[selected]]
    if not len(kept):
        raise JaxmapError(
            f"none of {len(selected)} frames has a pose: the frames span {_span(timestamps_s[selected])}, "
            f"the poses {_span(track.timestamps_s)}",
            where=track.where,
            fix=f"check that both use one clock, or that poses lie within max_pose_gap_s {options.max_pose_gap_s:g} s",
        )
    T_source_camera = T_source_child[has_pose]
    if T_child_camera is not None:
        T_source_camera = T_source_camera @ (T_child_camera if T_child_camera.ndim == 2 else T_child_camera[has_pose])
    if options.poses is None and options.calibration is not None and options.calibration.suffix.lower() != ".mat":
        T_source_camera = T_source_camera @ read_mounting(options.calibration)
    T_world_camera, T_world_source = to_z_up(T_source_camera, options.poses_world)
    T_world_camera, site_origin = split_site_origin(T_world_camera)

    told = list(notes)
    if options.poses_world == "auto" and not np.array_equal(T_world_source, np.eye(4)):
        told.append("the poses' world is taken for camera-like (y down) and turned z-up")
    if len(kept) < len(selected):
        told.append(
            f"{len(selected) - len(kept)} of {len(selected)} frames have no pose and are left out: "
            f"the frames span {_span(timestamps_s[selected])}, the poses {_span(track.timestamps_s)}"
        )
    row_of_frame = np.cumsum(has_pose) - 1
    return StereoSequence(
        name=name,
        dataset=dataset,
        camera=camera,
        frames=tuple(frames[index] for index in kept),
        T_world_camera=T_world_camera[row_of_frame[kept]],
        read_pair=read_pair,
        T_world_source=T_world_source,
        site_origin=site_origin,
        crs=options.crs or crs,
        notes=tuple(told),
    )


def _check_order(frames: Sequence[FrameRef], timestamps_s: np.ndarray, where: object) -> None:
    backwards = np.diff(timestamps_s, prepend=-np.inf) <= 0
    if backwards.any():
        row = int(np.argmax(backwards))
        raise JaxmapError(
            f"the time of frame {frames[row].name} ({timestamps_s[row]:.6f} s) does not come after the one before it",
            where=where,
            fix="correct the times of the frames",
        )


def _check_image_size(frames: Sequence[FrameRef], camera: StereoCamera | StereoRig, where: object) -> None:
    width_px, height_px = first_image_size_px(frames, where)
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise JaxmapError(
            f"images are {width_px}x{height_px} px, the calibration is for {camera.width_px}x{camera.height_px} px",
            where=where,
            fix="give the calibration of these images",
        )


def _span(timestamps_s: np.ndarray) -> str:
    return f"{timestamps_s[0]:.3f} to {timestamps_s[-1]:.3f} s"
