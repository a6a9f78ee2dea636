"""What a reader is and what it delivers: a stereo sequence with poses in a z-up world.

To add a format, write a module with a function that opens a folder and a `Reader` that recognises it, and name the
reader in `registry.py`. The function finds the frames, the calibration and the poses (`read_pose_track`), and hands
them to `assemble`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.bit_depth import bits_note
from jaxmap.datasets.calibration import read_mounting
from jaxmap.datasets.images import (
    ImageArray,
    first_image_size_px,
    image_rotation_tag,
    read_image_pair,
    sequence_bits,
)
from jaxmap.datasets.options import Bits, ReadOptions
from jaxmap.datasets.pose_axes import PoseReading, found_world, stand_upright, to_z_up
from jaxmap.datasets.poses import (
    FEW_FRAMES,
    PoseTrack,
    in_unit_of_frames,
    make_pose_track,
    poses_at,
    read_poses,
    split_site_origin,
    with_timestamps,
    without_wild_poses,
)
from jaxmap.datasets.units import METRES, PER_SECOND, UNIT_NAMES, with_baseline_unit
from jaxmap.errors import FrameError, JaxmapError
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
        pose_faults: those of the notes that tell of poses that were left out as unusable.
        pose_reading: the conventions that the poses were read by.
        read_pair: reads the images of one frame.
        rectify_labels: where `read_pair` rectifies: the same for labels (H, W) or probabilities (H, W, C) of the left
            image of a frame as it lies on disk; else None.
        true_disparity: reads the true disparity of a frame's left image in px, NaN where unknown; None where the
            sequence has no truth, and for a frame without one.
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
    rectify_labels: Callable[[FrameRef, np.ndarray], np.ndarray] | None = None
    true_disparity: Callable[[FrameRef], np.ndarray | None] | None = None
    pose_faults: tuple[str, ...] = ()
    pose_reading: PoseReading = field(default_factory=PoseReading)


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


def read_stereo_pair(
    frame: FrameRef, *, bits: Bits | None = None, size_px: tuple[int, int] | None = None
) -> StereoPair:
    """Reads the images of one frame, see `images.read_image_pair`.

    Raises:
        FrameError: an image cannot be read, or has another size than asked for or than the other one.
    """
    where = f"frame {frame.name} ({frame.right})"
    return StereoPair(*read_image_pair(frame.left, frame.right, where, bits=bits, size_px=size_px))


UNPOSED = make_pose_track(np.zeros(1), np.eye(4)[None], where="--poses odometry")
"""Stands for the poses that are estimated later, from the images."""


def from_images(options: ReadOptions) -> bool:
    """Whether the poses are to be estimated from the images: `--poses odometry`, and no file is called so."""
    path = options.poses
    return path is not None and path == Path("odometry") and not path.is_file()


def read_pose_track(options: ReadOptions, own: Path, *, allow_body: bool = False) -> PoseTrack:
    """The poses given by the options, else those of the sequence, in metres and of the left camera's optical axes.

    `UNPOSED` where the images are to give them.

    Args:
        options: `poses` has precedence; the conventions of the file.
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
    track = read_poses(path, options.quaternion, options.poses_time_unit)
    notes = [*track.notes]
    track = by_conventions(track, options)
    child = "camera" if options.pose_convention != "auto" else track.child
    if child == "body" and not allow_body:
        if not stand_upright(track.T[track.usable]):
            raise JaxmapError(
                "a csv of EuRoC's form holds poses of the body, not of the camera",
                where=path,
                fix="name their axes with --pose-convention: optical if they are of the left camera, body (x forward, "
                "y left, z up) if their frame sits at the camera; else give T_world_camera as TUM text",
            )
        child = "camera"
        notes.append(
            f"the poses in {path.name} stand upright as those of a camera's optical axes, and are taken for them"
        )
    return replace(track, child=child, notes=tuple(notes))


def by_conventions(track: PoseTrack, options: ReadOptions) -> PoseTrack:
    """A track as it was recorded, read by the options: poses of optical axes, and positions in metres."""
    T = reading_of(options, track).camera_poses(track.T)
    T[:, :3, 3] *= METRES[options.poses_unit]
    return replace(track, T=T)


def reading_of(options: ReadOptions, track: PoseTrack) -> PoseReading:
    """The conventions that poses are read by; the world is z up until it is found out."""
    return PoseReading(
        pose_convention="optical" if options.pose_convention == "auto" else options.pose_convention,
        poses_are=options.poses_are,
        quaternion=track.quaternion,
    )


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
    read_pair: Callable[[FrameRef], StereoPair] | None = None,
    size_px: tuple[int, int] | None = None,
    true_disparity: Callable[[FrameRef], np.ndarray | None] | None = None,
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
        read_pair: reads the images of one frame; by default from its files, with one depth of bits for all frames.
        size_px: width and height of the images; by default those of the first image file.
        true_disparity: reads the truth of one frame, where there is any.

    Raises:
        JaxmapError: frames out of order, counts that disagree, an image of another size than the
            calibration's, a selection without frames or without poses.
    """
    timestamps_s = np.array([frame.timestamp_s for frame in frames], np.float64)
    _check_frames(frames, timestamps_s, camera, where, size_px)
    selected, all_notes = _selected(len(frames), options, where), list(notes)
    common: dict[str, Any] = {
        "name": name,
        "dataset": dataset,
        "camera": with_baseline_unit(camera, options.baseline_unit),
        "read_pair": read_pair or _reader_of_files(frames, camera, options, all_notes),
        "true_disparity": true_disparity,
    }
    if track is UNPOSED:
        # All of them: a stride comes after the odometry, which needs every frame.
        seen, notes = tuple(frames[options.start : options.stop]), tuple(all_notes)
        return StereoSequence(frames=seen, T_world_camera=np.tile(np.eye(4), (len(seen), 1, 1)), notes=notes, **common)
    track = timed_track(track, timestamps_s, options)
    assert track.timestamps_s is not None
    T_source_child, has_pose = poses_at(track, timestamps_s, options.max_pose_gap_s)

    kept = selected[has_pose[selected]]
    if not len(kept):
        raise _no_pose(timestamps_s[selected], track, options)
    _check_time_units(timestamps_s, track, float(has_pose.mean()))
    T_source_camera = T_source_child[has_pose]
    if T_child_camera is not None:
        T_source_camera = T_source_camera @ (T_child_camera if T_child_camera.ndim == 2 else T_child_camera[has_pose])
    mounted = options.poses is None or options.pose_convention in ("body", "frd")
    if mounted and options.calibration is not None and options.calibration.suffix.lower() != ".mat":
        T_source_camera = T_source_camera @ read_mounting(options.calibration)
    world = found_world(T_source_camera, options.poses_world)
    T_world_camera, T_world_source = to_z_up(T_source_camera, world, options.poses_up)
    T_world_camera, site_origin = split_site_origin(T_world_camera)

    all_notes += [*track.notes, *track.faults]
    if options.poses_world == "auto" and world != "z_up":
        all_notes.append("the poses' world is taken for camera-like (y down) and turned z-up")
    if len(kept) < len(selected):
        all_notes.append(
            f"{len(selected) - len(kept)} of {len(selected)} frames have no pose and are left out: "
            f"the frames span {_span(timestamps_s[selected])}, the poses {_span(track.timestamps_s)}"
        )
    row_of_frame = np.cumsum(has_pose) - 1
    return StereoSequence(
        frames=tuple(frames[index] for index in kept),
        T_world_camera=T_world_camera[row_of_frame[kept]],
        T_world_source=T_world_source,
        site_origin=site_origin,
        crs=options.crs or crs,
        notes=tuple(all_notes),
        pose_faults=track.faults,
        pose_reading=reading_of(options, track)._replace(poses_world=world),
        **common,
    )


def timed_track(track: PoseTrack, timestamps_s: np.ndarray, options: ReadOptions) -> PoseTrack:
    """A track with times of the frames' unit, and without wild poses."""
    if track.timestamps_s is None:
        track = with_timestamps(track, timestamps_s)
    if options.poses_time_unit == "auto":
        track = in_unit_of_frames(track, timestamps_s, options.max_pose_gap_s)
    return without_wild_poses(track)


def _selected(count: int, options: ReadOptions, where: object) -> np.ndarray:
    """The indices of the frames that `start`, `stop` and `stride` select."""
    selected = np.arange(count)[options.start : options.stop : options.stride]
    if not len(selected):
        raise JaxmapError(
            f"start {options.start}, stop {options.stop}, stride {options.stride} select none of {count} frames",
            where=where,
            fix="choose another range",
        )
    return selected


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


def _reader_of_files(
    frames: Sequence[FrameRef], camera: StereoCamera | StereoRig, options: ReadOptions, notes: list[str]
) -> Callable[[FrameRef], StereoPair]:
    """Reads pairs with one depth of bits for all; see `_bits` for the notes."""
    bits = _bits(frames, options, notes)
    return partial(read_stereo_pair, bits=bits, size_px=(camera.width_px, camera.height_px))


def _bits(frames: Sequence[FrameRef], options: ReadOptions, notes: list[str]) -> Bits | None:
    """How many bits 16-bit images use, as given or found; what was taken is noted, and a rotation tag, too."""
    with suppress(FrameError):
        if (tag := image_rotation_tag(frames[0].left)) != 1:
            notes.append(
                f"the images carry the rotation tag {tag}, which is not applied: calibration, labels and masks must "
                "refer to the pixels as they are stored"
            )
    found = sequence_bits([(frame.left, frame.right) for frame in frames])
    if found is None:
        return options.image_bits
    if options.image_bits is None:
        notes.append(bits_note(*found))
    return options.image_bits or found.bits


def _no_pose(timestamps_s: np.ndarray, track: PoseTrack, options: ReadOptions) -> JaxmapError:
    """No frame has a pose: says so, and which unit of the poses' times would make clocks meet."""
    assert track.timestamps_s is not None
    fix = f"check that both use one clock, or that poses lie within max_pose_gap_s {options.max_pose_gap_s:g} s"
    return JaxmapError(
        f"none of {len(timestamps_s)} frames has a pose: the frames span {_span(timestamps_s)}, "
        f"the poses {_span(track.timestamps_s)}",
        where=track.where,
        fix=fix,
    )


def _check_time_units(timestamps_s: np.ndarray, track: PoseTrack, posed: float) -> None:
    """Refuses times of frames in another unit than those of the poses: only the first, at zero, would be mapped."""
    assert track.timestamps_s is not None
    frames_s, poses_s = np.ptp(timestamps_s), np.ptp(track.timestamps_s)
    for unit, per_second in PER_SECOND.items():
        if posed < FEW_FRAMES and per_second > 1 and 0.5 < frames_s / max(poses_s, 1e-9) / per_second < 2:
            raise JaxmapError(
                f"times of the frames look like {UNIT_NAMES[unit]}, so that {posed:.0%} of the frames have a pose: "
                f"the frames span {_span(timestamps_s)}, the poses {_span(track.timestamps_s)}",
                where=track.where,
                fix="give the times of the frames in seconds, in times.txt, or both in one unit",
            )


def _span(timestamps_s: np.ndarray) -> str:
    return f"{timestamps_s[0]:.3f} to {timestamps_s[-1]:.3f} s"
