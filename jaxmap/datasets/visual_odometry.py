"""Poses of a sequence that has none: estimated from its images by `localisation.odometry`, and stood upright."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.base import OnFrame, StereoSequence
from jaxmap.datasets.options import ReadOptions
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.geometry.options import PlaneFitOptions
from jaxmap.geometry.plane import fit_plane_mlesac
from jaxmap.host.prefetch import prefetch
from jaxmap.localisation.bundle import triangulate
from jaxmap.localisation.features import View, coarse_scale, make_view, shrunk
from jaxmap.localisation.odometry import LEAST_POINTS, MOST_BRIDGED, StereoOdometry, Track
from jaxmap.stereo.rectify import Rectifier, StereoRig, make_rectifier, rectify_image
from jaxmap.types import Pinhole, Plane, StereoCamera, pinhole

MOST_COLUMNS = 1600
"""Larger images are shrunk: a point is found to a tenth of a pixel, and that is enough."""

STANDING_PX = 3.0
"""A camera stands where no points move by more."""

MOST_UNSEEN = 0.1
"""Share of the frames before which the motion may be unseen."""

GROUND_EVERY_M, GROUND_WITHIN_M, GROUND_FRAMES = 1.0, 30.0, 12
"""The ground is looked for in so many frames at most, so far apart, in the first part of the path."""

GROUND_NOISE_M = 0.2
"""Points are used up to the depth where their noise is as large, at half a pixel of disparity."""

LEAST_GROUND = 0.25
"""Share of the points near the camera that lie on the ground, where it is one."""

MOST_LEAN_RAD = 1.0
"""How far the camera may look down or lean, for its ground to be found."""

_GROUND = PlaneFitOptions(max_tilt_rad=MOST_LEAN_RAD)

UpInCamera = Callable[[StereoSequence], Float64[np.ndarray, "N 3"] | None]
"""The direction up in the left camera's frame, for each frame of a sequence, NaN where it is unknown; None where no
sensor tells it."""


def with_odometry(
    sequence: StereoSequence,
    options: ReadOptions,
    up_in_camera: UpInCamera = lambda sequence: None,
    on_frame: OnFrame = lambda done, total: None,
) -> StereoSequence:
    """The sequence with poses estimated from its images, in a z-up world with its origin under the first camera.

    The first camera looks north (+y). Up is as the sequence's inclinometer says, else across the ground that the first
    frames show. Frames that match no other are left out; the `stride` is taken afterwards.

    Args:
        sequence: with any poses, which are not looked at.
        options: `stride` and `crs`.
        up_in_camera: asks the sequence's inclinometer.
        on_frame: is told of the progress.

    Raises:
        JaxmapError: there are no two frames, they show too little, the camera stands still, or its motion is unseen for
            too long.
    """
    if len(sequence.frames) < 2:
        raise _fault(sequence, f"{len(sequence.frames)} frame shows no motion", "give two frames or more")
    rig = _Rig.of(sequence.camera)
    odometry, grounds, unread = StereoOdometry(rig.pinhole), _Grounds(), 0
    for frame, read in enumerate(prefetch(partial(_read, sequence, rig), range(len(sequence.frames)), 2, 4)):
        view = None if isinstance(read, FrameError) else read
        unread += isinstance(read, FrameError)
        if odometry.add(view, sequence.frames[frame].timestamp_s) and view is not None:
            grounds.look(frame, view, odometry.latest())
        on_frame(frame + 1, len(sequence.frames))
    track = odometry.track()
    _check(sequence, track)
    T_first_rectified = track.T_world_camera
    T_rectified_raw = np.linalg.inv(rig.T_raw_rectified)
    T_first_raw = rig.T_raw_rectified @ T_first_rectified @ T_rectified_raw

    notes = _notes(sequence, track, unread)
    found = _from_sensor(up_in_camera(sequence), T_first_raw, track)
    ground = grounds.up(rig.pinhole, track)
    if found is None and ground is not None:
        found = rig.T_raw_rectified[:3, :3] @ ground.up
        notes.append(f"up is across the ground in {ground.frames} frames, which differ by {ground.spread_deg:.1f} deg")
    elif found is not None:
        notes.append("up is as the inclinometer says")
    else:
        found = np.array([0.0, -1.0, 0.0])
        notes.append("no ground is seen: the first camera is taken for level")
    T_world_first = _upright(found, 0.0 if ground is None else ground.height_m)

    kept = np.flatnonzero(np.isin(np.arange(0, len(sequence.frames), options.stride), track.frames)) * options.stride
    rows = np.searchsorted(track.frames, kept)
    return replace(
        sequence,
        frames=tuple(sequence.frames[index] for index in kept),
        T_world_camera=(T_world_first @ T_first_raw)[rows],
        T_world_source=np.eye(4),
        site_origin=np.zeros(3),
        crs=options.crs,
        notes=(*sequence.notes, *notes),
    )


@dataclass(frozen=True)
class _Rig:
    """The camera as odometry sees it: rectified, and shrunk `scale` times."""

    rectifier: Rectifier | None
    pinhole: Pinhole
    size_px: tuple[int, int]
    scale: int
    T_raw_rectified: np.ndarray

    @staticmethod
    def of(camera: StereoCamera | StereoRig) -> _Rig:
        rectifier, T_raw_rectified = None, np.eye(4)
        if isinstance(camera, StereoRig):
            rectifier = make_rectifier(camera)
            T_raw_rectified[:3, :3] = rectifier.R_rectified_left.T
            camera = rectifier.camera
        scale = -(-camera.width_px // MOST_COLUMNS)
        full = pinhole(camera)
        small = Pinhole(
            full.fx_px / scale,
            full.fy_px / scale,
            (full.cx_px + 0.5) / scale - 0.5,
            (full.cy_px + 0.5) / scale - 0.5,
            full.baseline_m,
            full.doffs_px / scale,
        )
        return _Rig(rectifier, small, (camera.width_px, camera.height_px), scale, T_raw_rectified)


def _read(sequence: StereoSequence, rig: _Rig, index: int) -> View | FrameError | None:
    """One pair, rectified and prepared; None where it shows nothing."""
    try:
        pair = sequence.read_pair(sequence.frames[index])
    except FrameError as fault:
        return fault
    images = [pair.left, pair.right]
    if any(image.shape[1::-1] != rig.size_px for image in images):
        return FrameError("an image is of another size than the calibration", fix="give images of one size")
    if rig.rectifier is not None:
        images = [
            rectify_image(image, maps)
            for image, maps in zip(images, (rig.rectifier.left_maps, rig.rectifier.right_maps), strict=True)
        ]
    return make_view(*(shrunk(image, rig.scale) for image in images))


def _fault(sequence: StereoSequence, what: str, fix: str) -> JaxmapError:
    return JaxmapError(f"no poses from the images: {what}", where=f"--poses odometry, {sequence.name}", fix=fix)


def _check(sequence: StereoSequence, track: Track) -> None:
    """Refuses a track that says nothing, or that breaks off.

    Raises:
        JaxmapError: it does.
    """
    count = len(sequence.frames)
    if len(track.frames) < 2:
        raise _fault(
            sequence,
            f"{len(track.frames)} of {count} frames can be tracked, the others show less than {LEAST_POINTS} points "
            "that match their neighbours",
            "look at the images and the calibration (jaxmap check), or give --poses FILE",
        )
    if track.moved_px < STANDING_PX:
        raise _fault(
            sequence,
            f"the camera stands still over {count} frames (points move by {track.moved_px:.1f} px)",
            "give a part in which it moves (--start, --stop), or --poses FILE",
        )
    if len(track.bridged) > max(2, MOST_UNSEEN * count):
        raise _fault(
            sequence,
            f"at {len(track.bridged)} places in {count} frames no motion is seen",
            "give a part whose images overlap (--start, --stop), or --poses FILE",
        )
    tail = count - 1 - int(track.frames[-1])
    if tail > MOST_BRIDGED and tail > 0.2 * count:
        name = sequence.frames[int(track.frames[-1])].name
        raise _fault(
            sequence,
            f"the motion is lost after frame {name}: the {tail} frames after it match nothing before",
            "map the parts apart (--start, --stop), or give --poses FILE",
        )


def _notes(sequence: StereoSequence, track: Track, unread: int) -> list[str]:
    count, tracked = len(sequence.frames), len(track.frames)
    path_m = float(np.linalg.norm(np.diff(track.T_world_camera[:, :3, 3], axis=0), axis=1).sum())
    notes = [
        f"the poses are estimated from the images (stereo odometry): {tracked} of {count} frames tracked over "
        f"{path_m:.1f} m, by {np.median(track.inliers[1:]):.0f} points each in the median, {track.inliers[1:].min()} "
        "at least; they drift with the path"
    ]
    if tracked < count:
        lost = sorted(set(range(count)) - set(track.frames.tolist()))
        names = ", ".join(sequence.frames[index].name for index in lost[:5]) + ", ..." * (len(lost) > 5)
        unreadable = f" ({unread} cannot be read)" if unread else ""
        notes.append(f"{len(lost)} frames that match no other are left out{unreadable}: {names}")
    if track.bridged:
        names = ", ".join(sequence.frames[index].name for index in track.bridged)
        notes.append(
            f"before {names} no motion is seen, and the camera is taken to have kept its speed: the map may be broken"
            " there"
        )
    return notes


class Ground(NamedTuple):
    """The ground under the first camera.

    Attributes:
        up: (3,), across the ground, in the first camera's frame.
        height_m: of the camera above it.
        frames: that show it.
        spread_deg: the median angle between theirs and the mean.
    """

    up: np.ndarray
    height_m: float
    frames: int
    spread_deg: float


class _Grounds:
    """The frames in which the ground is looked for."""

    def __init__(self) -> None:
        self._seen: list[tuple[int, View]] = []
        self._path_m, self._last_m = 0.0, np.full(3, np.inf)

    def look(self, frame: int, view: View, T_first_camera: np.ndarray) -> None:
        """Keeps a frame, where it shows other ground than those before."""
        step_m = float(np.linalg.norm(T_first_camera[:3, 3] - self._last_m)) if self._seen else 0.0
        if self._seen and (
            step_m < GROUND_EVERY_M or self._path_m + step_m > GROUND_WITHIN_M or len(self._seen) == GROUND_FRAMES
        ):
            return
        self._path_m, self._last_m = self._path_m + step_m, T_first_camera[:3, 3]
        self._seen.append((frame, view))

    def up(self, camera: Pinhole, track: Track) -> Ground | None:
        """The ground; None where most frames show none."""
        normals, heights = [], []
        for frame, view in self._seen:
            found = _ground_plane(camera, view)
            row = np.searchsorted(track.frames, frame)
            if found is not None and row < len(track.frames) and track.frames[row] == frame:
                normals.append(track.T_world_camera[row, :3, :3] @ found[0])
                heights.append(found[1])
        if len(normals) * 2 < len(self._seen) or not normals:
            return None
        up = np.median(normals, axis=0)
        up /= np.linalg.norm(up)
        off = np.degrees(np.arccos(np.clip(np.array(normals) @ up, -1, 1)))
        return Ground(up, float(np.median(heights)), len(normals), float(np.median(off)))


@jax.jit
def _fit(points: jax.Array, valid: jax.Array) -> Plane:
    up_hint = jax.numpy.array([0.0, -1.0, 0.0])
    return fit_plane_mlesac(jax.random.key(0), points, valid, up_hint=up_hint, options=_GROUND)


def _ground_plane(camera: Pinhole, view: View) -> tuple[np.ndarray, float] | None:
    """The normal of the ground in the camera's frame, and the camera's height above it."""
    disparity = view.disparity_px
    row, column = (np.indices(disparity.shape).reshape(2, -1) + 0.5) * coarse_scale(view.left.shape[1]) - 0.5
    points = triangulate(camera, np.column_stack([column, row, column - disparity.ravel()]))
    farthest_m = np.sqrt(GROUND_NOISE_M * camera.baseline_m * camera.fx_px / 0.5)
    valid = np.isfinite(points).all(axis=1) & (points[:, 2] < farthest_m)
    points = np.where(valid[:, None], points, 0.0).astype(np.float32)
    normal, offset_m, inliers, is_found = (np.asarray(part, np.float64) for part in _fit(points, valid))
    if not is_found or valid.sum() < 200 or inliers < LEAST_GROUND or offset_m <= 0:
        return None
    return normal / np.linalg.norm(normal), float(offset_m)


def _from_sensor(up_camera: np.ndarray | None, T_first_camera: np.ndarray, track: Track) -> np.ndarray | None:
    """Up in the first camera's frame, as the mean over the frames of what a sensor says."""
    if up_camera is None or np.isnan(up_camera[track.frames]).all():
        return None
    up = np.nanmedian(np.einsum("nij,nj->ni", T_first_camera[:, :3, :3], up_camera[track.frames]), axis=0)
    return up / np.linalg.norm(up)


def _upright(up: Float64[np.ndarray, "3"], height_m: float) -> Float64[np.ndarray, "4 4"]:
    """T_world_first of a first camera that looks north, so high above the origin."""
    ahead = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.95 else np.array([0.0, -1.0, 0.0])
    north = ahead - up * (ahead @ up)
    north /= np.linalg.norm(north)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(north, up), north, up])
    T[2, 3] = height_m
    return T
