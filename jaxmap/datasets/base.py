"""What a reader is and what it delivers: a stereo sequence with poses in a z-up world.

To add a format, write a module with a function that opens a folder and a `Reader` that recognises it, and name the
reader in `registry.py`. The function finds the frames, the calibration and the poses (`read_pose_track`), and hands
them to `assemble`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.calibration import read_mounting
from jaxmap.datasets.images import ImageArray, first_image_size_px, read_image_pair
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import (
    PoseTrack,
    make_pose_track,
    poses_at,
    read_poses,
    split_site_origin,
    to_z_up,
    with_timestamps,
)
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

OnFrame = Callable[[int, int], None]
"""Called with the number of frames done, and of all."""


class StereoPair(NamedTuple):
    """A pair of images as read: uint8, (H, W) grey or (H, W, 3) RGB, both of one size."""

    left: ImageArray
    right: ImageArray


@dataclass(frozen=True)
class FrameRef:
    """One frame of a sequence: its image files and the time at which the left one was taken.

    `name` is the left image's file name without its suffix; label files have the same name. Where images lie in one
    file together, `left` and `right` only say where: bag, topic, time.
    """

    name: str
    timestamp_s: float
    left: Path
    right: Path


@dataclass(frozen=True)
class StereoSequence:
    """A stereo sequence with poses.

    Attributes:
        name: a short name for headings and files.
        dataset: the reader's name in the registry.
        camera: a rectified camera, or a `StereoRig` where the images are raw.
        frames: in the order of time.
        T_world_camera: float64 (N, 4, 4), left camera of the images as they lie on disk (raw if
            they are raw), in the z-up world, relative to `site_origin`.
        T_world_source: float64 (4, 4), turns the poses' own world into the z-up world.
        site_origin: float64 (3,), what was subtracted from the positions.
        crs: the coordinate reference system of `site_origin`, e.g. "EPSG:32631", or None.
        notes: what the reader reports to the user (frames left out, conventions assumed).
        read_pair: reads the images of one frame.
    """

    name: str
    dataset: str
    camera: StereoCamera | StereoRig
    frames: tuple[FrameRef, ...]
    T_world_camera: np.ndarray
    read_pair: Callable[[FrameRef], StereoPair]
    T_world_source: np.ndarray = field(default_factory=lambda: np.eye(4))
    site_origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    crs: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reader:
    """One kind of data set.

    Attributes:
        name: the value of `ReadOptions.dataset` that chooses it.
        help: one line, which also says what the folder must hold.
        recognises: whether a folder is of this kind, by its content; it never raises.
        open: opens a folder.
        cameras: the values of `ReadOptions.camera`; empty where there is no choice.
    """

    name: str
    help: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, ReadOptions], StereoSequence]
    cameras: tuple[str, ...] = ()


def read_stereo_pair(frame: FrameRef) -> StereoPair:
    """Reads the images of one frame, see `images.read_image_pair`.

    Raises:
        FrameError: an image cannot be read, or the two differ in size.
    """
    return StereoPair(*read_image_pair(frame.left, frame.right, where=f"frame {frame.name} ({frame.right})"))


UNPOSED = make_pose_track(np.zeros(1), np.eye(4)[None], where="--poses odometry")
"""Stands for the poses that are estimated later, from the images."""


def from_images(options: ReadOptions) -> bool:
    """Whether the poses are to be estimated from the images: `--poses odometry`, and no file is called so."""
    path = options.poses
    return path is not None and path == Path("odometry") and not path.is_file()


def read_pose_track(options: ReadOptions, own: Path, *, allow_body: bool = False) -> PoseTrack:
    """The poses given by the options, else those of the sequence; `UNPOSED` where the images are to give them.

    Args:
        options: `poses` has precedence.
        own: the sequence's own pose file, which need not exist.
        allow_body: whether the reader can use poses of the body (EuRoC csv).

    Raises:
        JaxmapError: there are none, or they are poses of a body and the reader cannot use them.
    """
    if from_images(options):
        return UNPOSED
    path = options.poses or own
    if not options.poses and not own.is_file():
        raise JaxmapError(
            f"the sequence has no poses: there is no file {own}",
            fix="give them with --poses FILE (TUM text, T_world_camera of the left camera), "
            "or estimate them from the images: --poses odometry",
        )
    track = read_poses(path)
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
    size_px: tuple[int, int] | None = None,
) -> StereoSequence:
    """Joins frames, poses and calibration into a sequence in a z-up world.

    The rotation to z-up and the site origin are found from all frames that have a pose, before `start`, `stop` and
    `stride` select, so that parts of one sequence share their world.

    Args:
        name: the sequence's name.
        dataset: the reader's name.
        where: the source, for error texts.
        frames: all frames on disk, in the order of time.
        track: their poses; without timestamps, one for each frame.
        camera: the calibration.
        options: selection of frames, world of the poses, longest gap between poses.
        T_child_camera: the left camera in the child frame of the poses, (4, 4) or (N, 4, 4) for each frame; None
            where the child frame is the left camera.
        crs: the coordinate reference system of the poses.
        notes: what the reader reports to the user.
        read_pair: reads the images of one frame.
        size_px: width and height of the images; by default those of the first image file.

    Raises:
        JaxmapError: frames out of order, counts that disagree, an image of another size than the
            calibration's, a selection without frames or without poses.
    """
    timestamps_s = np.array([frame.timestamp_s for frame in frames], np.float64)
    _check_frames(frames, timestamps_s, camera, where, size_px)
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
    if track is UNPOSED:
        # All of them: a stride comes after the odometry, which needs every frame.
        seen = tuple(frames[options.start : options.stop])
        return StereoSequence(
            name, dataset, camera, seen, np.tile(np.eye(4), (len(seen), 1, 1)), read_pair, notes=tuple(notes)
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

    all_notes = list(notes)
    if options.poses_world == "auto" and not np.array_equal(T_world_source, np.eye(4)):
        all_notes.append("the poses' world is taken for camera-like (y down) and turned z-up")
    if len(kept) < len(selected):
        all_notes.append(
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
        notes=tuple(all_notes),
    )


def _check_frames(
    frames: Sequence[FrameRef],
    timestamps_s: np.ndarray,
    camera: StereoCamera | StereoRig,
    where: object,
    size_px: tuple[int, int] | None,
) -> None:
    """Checks the order of the times, and the size of the images against the calibration."""
    backwards = np.diff(timestamps_s, prepend=-np.inf) <= 0
    if backwards.any():
        row = int(np.argmax(backwards))
        raise JaxmapError(
            f"the time of frame {frames[row].name} ({timestamps_s[row]:.6f} s) does not come after the one before it",
            where=where,
            fix="correct the times of the frames",
        )
    width_px, height_px = size_px or first_image_size_px((frame.left for frame in frames), where)
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise JaxmapError(
            f"images are {width_px}x{height_px} px, the calibration is for {camera.width_px}x{camera.height_px} px",
            where=where,
            fix="give the calibration of these images",
        )


def _span(timestamps_s: np.ndarray) -> str:
    return f"{timestamps_s[0]:.3f} to {timestamps_s[-1]:.3f} s"
