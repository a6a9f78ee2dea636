"""Stereo visual odometry: the motion of a rectified stereo camera, from its images alone.

Points of a keyframe are followed into each pair, and a robust pose is found from them; where the view has changed
enough, the pair becomes a keyframe. The last keyframes and the points they see are adjusted together (`bundle`). A pair
that does not become a keyframe keeps its pose relative to the last one, so that a standing camera does not drift.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation

from jaxmap.localisation.bundle import Bundle, Sightings, adjust, adjust_pose, project, to_camera, to_world, triangulate
from jaxmap.localisation.features import (
    View,
    coarse_disparity_at,
    find_corners,
    follow,
    match_descriptors,
    match_right,
)
from jaxmap.types import Pinhole

POINTS = 400
"""Points wanted in a keyframe."""

LEAST_POINTS = 20
"""A pose that fewer points agree on is none."""

LEAST_SHARE, GOOD_SHARE = 0.2, 0.6
"""Of the points that should be in view: a pose with a smaller share is none, with a greater one no other is tried."""

KEEP_SHARE, MOVED_SHARE = 0.7, 0.02
"""A pair becomes a keyframe where it shows a smaller share of the points, or they have moved by more of its width."""

WINDOW, HELD = 8, 2
"""Keyframes that are adjusted together; so many of the oldest stay where they are."""

LEAST_DISPARITY_PX = 1.0
"""Points farther away have no depth worth the name."""

SIGMA_PX = 0.4
"""Standard deviation of a point's place."""

OFF_PX, FAR_OFF_PX = 2.0, 6.0
"""How far a point may lie off where a pose projects it: followed, and matched by its look alone."""

MOST_BRIDGED = 5
"""Where pairs match nothing, the camera is assumed to keep its motion over so many of them, or as long, at most."""


class Keyframe(NamedTuple):
    """A pair with its points: `ids` (N,) count all points from the first on, `uvr_px` (N, 3) as in `Sightings`."""

    T_world_camera: Float64[np.ndarray, "4 4"]
    ids: Int[np.ndarray, "N"]
    uvr_px: Float64[np.ndarray, "N 3"]


class Located(NamedTuple):
    """A pose of a pair, and the points of the last keyframe that agree on it: their rows there, and places here."""

    T_world_camera: Float64[np.ndarray, "4 4"]
    rows: Int[np.ndarray, "N"]
    uvr_px: Float64[np.ndarray, "N 3"]
    expected: int


class Track(NamedTuple):
    """Poses of a camera.

    Attributes:
        frames: the frames that have one, counted from 0.
        T_world_camera: (N, 4, 4), in the frame of the first of them.
        inliers: (N,) points that agree on each; in the first one, those it begins with.
        bridged: frames before which no motion was seen, and where it is assumed to have stayed the same.
        keyframes: how many of them are keyframes.
        moved_px: how far points have moved in the image from the last keyframe, at most: 0 for a standing camera.
    """

    frames: Int[np.ndarray, "N"]
    T_world_camera: Float64[np.ndarray, "N 4 4"]
    inliers: Int[np.ndarray, "N"]
    bridged: list[int]
    keyframes: int
    moved_px: float


class StereoOdometry:
    """Takes the pairs of a sequence one after the other; the same pairs give the same poses."""

    def __init__(self, camera: Pinhole) -> None:
        self.camera = camera
        self.bridged: list[int] = []
        self.moved_px = 0.0
        self._K = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
        self._done: list[np.ndarray] = []
        self._window: list[Keyframe] = []
        self._view: View | None = None
        self._points, self._first_id = np.zeros((0, 3)), 0
        self._poses: list[tuple[int, int, np.ndarray, int]] = []
        self._times_s: list[float] = []
        self._motion = np.zeros((2, 3))
        self._pending: tuple[int, View] | None = None

    def add(self, view: View | None, timestamp_s: float) -> int:
        """Takes the next pair; None for one that shows nothing.

        Returns:
            How many points agree on its pose, 0 where it has none.
        """
        frame = len(self._times_s)
        self._times_s.append(timestamp_s)
        if view is None:
            return 0
        if self._view is None:
            return self._begin(frame, view, np.eye(4))
        located = self._locate(view, self.latest(), self._as_before(frame))
        if located is None and self._pending is not None:
            located = self._bridge(frame, view)
        if located is None:
            self._pending = frame, view
            return 0
        return self._take(frame, view, located)

    def track(self) -> Track:
        """The poses so far."""
        keyframes = np.array(self._done + [keyframe.T_world_camera for keyframe in self._window]).reshape(-1, 4, 4)
        frames, bases, relative, inliers = zip(*self._poses, strict=True) if self._poses else ((), (), (), ())
        T = keyframes[np.array(bases, int)] @ np.array(relative).reshape(-1, 4, 4)
        counts = np.array(inliers, int)
        return Track(np.array(frames, int), T, counts, self.bridged, len(keyframes), self.moved_px)

    def latest(self) -> np.ndarray:
        """The pose of the last frame that has one, as far as it is known now."""
        return self._window[-1].T_world_camera @ self._poses[-1][2]

    def _begin(self, frame: int, view: View, T_world_camera: np.ndarray) -> int:
        """Makes a pair a keyframe that shares no point with those before it."""
        keyframe = self._with_new_points(view, T_world_camera, np.zeros(0, int), np.zeros((0, 3)))
        if len(keyframe.ids) < LEAST_POINTS:
            return 0
        self._push(keyframe, view)
        self._poses.append((frame, len(self._done) + len(self._window) - 1, np.eye(4), len(keyframe.ids)))
        return len(keyframe.ids)

    def _take(self, frame: int, view: View, located: Located) -> int:
        """Records the pose of a pair, and makes it a keyframe where it shows much that is new."""
        last = self._window[-1]
        step = np.linalg.inv(self.latest()) @ located.T_world_camera
        self._motion = np.stack([step[:3, 3], Rotation.from_matrix(step[:3, :3]).as_rotvec()]) / self._since(frame)
        self._pending = None
        moved_px = float(np.median(np.hypot(*(located.uvr_px - last.uvr_px[located.rows])[:, :2].T)))
        self.moved_px = max(self.moved_px, moved_px)
        relative = np.linalg.inv(last.T_world_camera) @ located.T_world_camera
        if len(located.rows) < KEEP_SHARE * len(last.ids) or moved_px > MOVED_SHARE * view.left.shape[1]:
            ids = last.ids[located.rows]
            self._push(self._with_new_points(view, located.T_world_camera, ids, located.uvr_px), view)
            relative = np.eye(4)
        self._poses.append((frame, len(self._done) + len(self._window) - 1, relative, len(located.rows)))
        return len(located.rows)

    def _bridge(self, frame: int, view: View) -> Located | None:
        """Goes on from the last pair that matched nothing, if this one matches that."""
        assert self._pending is not None
        before, view_before = self._pending
        if self._since(before) > (MOST_BRIDGED + 0.5) * np.median(np.diff(self._times_s)):
            return None
        kept = self._view, list(self._window), list(self._done), list(self._poses), self._points, self._first_id
        T = self._as_before(before)
        if self._begin(before, view_before, T):
            located = self._locate(view, T, self._as_before(frame))
            if located is not None:
                self.bridged.append(before)
                return located
        self._view, self._window, self._done, self._poses, self._points, self._first_id = kept
        return None

    def _push(self, keyframe: Keyframe, view: View) -> None:
        """Adds a keyframe, and adjusts those of the window."""
        self._window.append(keyframe)
        self._view = view
        if len(self._window) > 1:
            self._adjust()
        if len(self._window) == WINDOW:
            self._done.append(self._window.pop(0).T_world_camera)
            oldest = min((int(kept.ids.min()) for kept in self._window if len(kept.ids)), default=self._first_id)
            self._points, self._first_id = self._points[oldest - self._first_id :], oldest

    def _points_of(self, ids: np.ndarray) -> np.ndarray:
        return self._points[ids - self._first_id]

    def _with_new_points(self, view: View, T_world_camera: np.ndarray, ids: np.ndarray, uvr_px: np.ndarray) -> Keyframe:
        """A keyframe with the points it shares with the last one, and new ones where it has few."""
        corners = find_corners(view, uvr_px[:, :2], POINTS)
        right, seen = match_right(view, corners, coarse_disparity_at(view, corners))
        new = np.column_stack([corners, right])[seen]
        new = new[new[:, 0] - new[:, 2] + self.camera.doffs_px > LEAST_DISPARITY_PX]
        fresh = self._first_id + len(self._points) + np.arange(len(new))
        self._points = np.concatenate([self._points, to_world(T_world_camera, triangulate(self.camera, new))])
        return Keyframe(T_world_camera, np.concatenate([ids, fresh]), np.concatenate([uvr_px, new]))

    def _since(self, frame: int) -> float:
        """Time since the last frame that has a pose."""
        return self._times_s[frame] - self._times_s[self._poses[-1][0]]

    def _as_before(self, frame: int) -> np.ndarray:
        """The pose of a frame, if the camera keeps its motion."""
        shift, turn = self._motion * self._since(frame)
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
        return self.latest() @ step

    def _locate(self, view: View, T_before: np.ndarray, T_moved: np.ndarray) -> Located | None:
        """The pose of a pair from the points of the last keyframe; None where they do not agree on one."""
        best: Located | None = None
        for guess in (lambda: T_moved, lambda: T_before, lambda: self._alike(view)):
            T = guess()
            if T is None or (located := self._locate_near(view, T)) is None:
                continue
            if best is None or len(located.rows) > len(best.rows):
                best = located
            if len(best.rows) > GOOD_SHARE * best.expected:
                break
        return best

    def _locate_near(self, view: View, T_guess: np.ndarray) -> Located | None:
        """The pose near a guess: followed coarsely at first, then from where the pose found so projects the points."""
        assert self._view is not None
        keyframe, points = self._window[-1], self._points_of(self._window[-1].ids)
        rows, expected = self._in_view(view, T_guess, points)
        places, guess = (self._view.to_small(pixels[:, :2]) for pixels in (keyframe.uvr_px[rows], expected))
        pixels, good = follow(self._view.small, view.small, places, guess, levels=2, window_px=17)
        T = self._pose_by_ransac(points[rows[good]], view.to_full(pixels[good]), OFF_PX, 200)
        if T is None:
            return None
        rows, expected = self._in_view(view, T, points)
        if len(rows) < LEAST_POINTS:
            return None
        places = keyframe.uvr_px[rows, :2]
        pixels, good = follow(self._view.left, view.left, places, expected[:, :2], levels=1, window_px=15)
        right, seen = match_right(view, pixels, expected[:, 0] - expected[:, 2])
        good &= seen
        uvr_px, kept = np.column_stack([pixels, right])[good], rows[good]
        for _ in range(2):
            if len(kept) < max(LEAST_POINTS, LEAST_SHARE * len(rows)):
                return None
            T = adjust_pose(self.camera, T, points[kept], uvr_px, SIGMA_PX)
            near = np.abs(project(self.camera, to_camera(T, points[kept])) - uvr_px).max(axis=1) < OFF_PX
            kept, uvr_px = kept[near], uvr_px[near]
        return Located(T, kept, uvr_px, len(rows))

    def _in_view(self, view: View, T: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The points that a camera there would see, and where."""
        expected = project(self.camera, to_camera(T, points))
        inside = ((expected[:, :2] > 0) & (expected[:, :2] < view.left.shape[::-1])).all(axis=1)
        rows = np.flatnonzero(inside & np.isfinite(expected).all(axis=1))
        return rows, expected[rows]

    def _alike(self, view: View) -> np.ndarray | None:
        """The pose by points that look alike, however far it is from the last one."""
        assert self._view is not None
        here, there = match_descriptors(self._view, view, 1500)
        local = triangulate(self.camera, np.column_stack([here, here[:, 0] - coarse_disparity_at(self._view, here)]))
        known = np.isfinite(local).all(axis=1)
        points = to_world(self._window[-1].T_world_camera, local[known])
        return self._pose_by_ransac(points, there[known], FAR_OFF_PX, 1000)

    def _pose_by_ransac(self, points: np.ndarray, pixels: np.ndarray, within_px: float, tries: int):
        """T_world_camera of a camera that sees points at pixels; None where too few agree."""
        if len(points) < LEAST_POINTS:
            return None
        cv2.setRNGSeed(0)
        try:
            found, rotation, translation, inliers = cv2.solvePnPRansac(
                points,
                np.ascontiguousarray(pixels),
                self._K,
                np.zeros(4),
                iterationsCount=tries,
                reprojectionError=within_px,
                confidence=0.999,
            )
        except cv2.error:
            return None
        if not found or inliers is None or len(inliers) < LEAST_POINTS:
            return None
        T_camera_world = np.eye(4)
        T_camera_world[:3, :3], T_camera_world[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
        return np.linalg.inv(T_camera_world)

    def _adjust(self) -> None:
        """Adjusts the keyframes of the window, and the points that two of them see at least."""
        ids = np.concatenate([keyframe.ids for keyframe in self._window])
        cameras = np.repeat(np.arange(len(self._window)), [len(keyframe.ids) for keyframe in self._window])
        uvr_px = np.concatenate([keyframe.uvr_px for keyframe in self._window])
        counts = np.bincount(ids - self._first_id, minlength=len(self._points))
        again = counts[ids - self._first_id] > 1
        if not again.any():
            return
        shared, points = np.unique(ids[again], return_inverse=True)
        fixed = np.arange(len(self._window)) < (HELD if len(self._window) == WINDOW else 1)
        start = Bundle(np.array([keyframe.T_world_camera for keyframe in self._window]), self._points_of(shared))
        found = adjust(self.camera, start, Sightings(cameras[again], points, uvr_px[again]), fixed, SIGMA_PX)
        self._points[shared - self._first_id] = found.points_world
        self._window = [
            keyframe._replace(T_world_camera=T) for keyframe, T in zip(self._window, found.T_world_camera, strict=True)
        ]
