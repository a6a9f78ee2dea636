"""Stereo visual odometry: the motion of a rectified stereo camera from its images alone.

Points of a keyframe are followed into each pair, a robust pose is found from them, and where the view has changed
enough the pair becomes a keyframe. The last keyframes and the points they see are adjusted together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, Int

from jaxmap.localisation.bundle import Bundle, Sightings, adjust, adjust_pose, project, to_camera, to_world, triangulate
from jaxmap.localisation.features import View, coarse_disparity_at, find_corners, follow, match_right
from jaxmap.types import Pinhole

POINTS = 400
MIN_POINTS = 15
WINDOW = 8
SIGMA_PX = 0.5
INLIER_PX = 2.0
MIN_DISPARITY_PX = 1.0
KEEP_SHARE = 0.7
MOVED_PX = 20.0


class Keyframe(NamedTuple):
    """A pair with its points: `ids` (N,), `uvr_px` (N, 3)."""

    frame: int
    view: View
    ids: Int[np.ndarray, "N"]
    uvr_px: Float64[np.ndarray, "N 3"]


class Found(NamedTuple):
    """Points of a keyframe in another pair: their rows in the keyframe, where, and the pose that explains them."""

    rows: np.ndarray
    uvr_px: np.ndarray
    T_world_camera: np.ndarray


class Odometry:
    def __init__(self, camera: Pinhole) -> None:
        self.camera = camera
        self.keyframes: list[Keyframe] = []
        self.T: list[np.ndarray] = []
        self.points = np.zeros((0, 3))
        self.relative: list[tuple[int, np.ndarray]] = []
        self.velocity = np.eye(4)
        self.log = []

    def add(self, view: View) -> None:
        if not self.keyframes:
            self._new_keyframe(view, np.eye(4), np.zeros(0, int), np.zeros((0, 3)))
            self.relative.append((0, np.eye(4)))
            return
        last = self.keyframes[-1]
        T_before = self.T[self.relative[-1][0]] @ self.relative[-1][1]
        guesses = [T_before @ self.velocity, T_before]
        best = None
        for guess in guesses:
            found = self._locate(last, view, guess)
            if found is not None and (best is None or len(found.rows) > len(best.rows)):
                best = found
            if best is not None and len(best.rows) > 0.5 * len(last.ids):
                break
        if best is None or len(best.rows) < 0.3 * len(last.ids):
            guess = self._coarse(last, view)
            if guess is not None:
                found = self._locate(last, view, guess)
                if found is not None and (best is None or len(found.rows) > len(best.rows)):
                    best = found
        if best is None:
            raise RuntimeError(f"lost at {len(self.relative)}")
        moved = np.median(np.linalg.norm(best.uvr_px[:, :2] - last.uvr_px[best.rows, :2], axis=1))
        share = len(best.rows) / len(last.ids)
        self.velocity = np.linalg.inv(T_before) @ best.T_world_camera
        self.log.append((len(last.ids), len(best.rows), moved))
        if share < KEEP_SHARE or moved > MOVED_PX:
            self._new_keyframe(view, best.T_world_camera, last.ids[best.rows], best.uvr_px)
            self.relative.append((len(self.keyframes) - 1, np.eye(4)))
        else:
            self.relative.append((len(self.keyframes) - 1, np.linalg.inv(self.T[-1]) @ best.T_world_camera))

    def poses(self) -> np.ndarray:
        return np.stack([self.T[k] @ T for k, T in self.relative])

    def _locate(self, keyframe: Keyframe, view: View, guess: np.ndarray) -> Found | None:
        points = self.points[keyframe.ids]
        expected = project(self.camera, to_camera(guess, points))
        height, width = view.left.shape
        ahead = np.isfinite(expected).all(axis=1)
        ahead &= (expected[:, :2] > -40).all(axis=1) & (expected[:, 0] < width + 40) & (expected[:, 1] < height + 40)
        rows = np.flatnonzero(ahead)
        pixels, good = follow(keyframe.view.left, view.left, keyframe.uvr_px[rows, :2], expected[rows, :2], 3)
        rows, pixels, expected = rows[good], pixels[good], expected[rows[good]]
        if len(rows) < MIN_POINTS:
            return None
        K = np.array([[self.camera.fx_px, 0, self.camera.cx_px], [0, self.camera.fy_px, self.camera.cy_px], [0, 0, 1]])
        cv2.setRNGSeed(0)
        try:
            ok, rotation, translation, inliers = cv2.solvePnPRansac(
                self.points[keyframe.ids[rows]], np.ascontiguousarray(pixels), K, np.zeros(4), iterationsCount=200, reprojectionError=INLIER_PX, confidence=0.999
            )
        except cv2.error:
            return None
        if not ok or inliers is None or len(inliers) < MIN_POINTS:
            return None
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
        T = np.linalg.inv(T)
        inliers = np.sort(inliers.ravel())
        rows, pixels = rows[inliers], pixels[inliers]
        expected = project(self.camera, to_camera(T, self.points[keyframe.ids[rows]]))
        right, seen = match_right(view, pixels, expected[:, 0] - expected[:, 2])
        rows, uvr = rows[seen], np.column_stack([pixels, right])[seen]
        if len(rows) < MIN_POINTS:
            return None
        points = self.points[keyframe.ids[rows]]
        T = adjust_pose(self.camera, T, points, uvr, SIGMA_PX)
        off = np.abs(project(self.camera, to_camera(T, points)) - uvr).max(axis=1)
        kept = off < 2 * INLIER_PX
        if kept.sum() < MIN_POINTS:
            return None
        return Found(rows[kept], uvr[kept], T)

    def _coarse(self, keyframe: Keyframe, view: View) -> np.ndarray | None:
        orb = cv2.ORB.create(1500)
        small = [cv2.resize(v.left, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for v in (keyframe.view, view)]
        (kp1, d1), (kp2, d2) = (orb.detectAndCompute(s, None) for s in small)
        if d1 is None or d2 is None:
            return None
        matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(d1, d2)
        p1 = np.array([kp1[m.queryIdx].pt for m in matches]) * 2 + 0.5
        p2 = np.array([kp2[m.trainIdx].pt for m in matches]) * 2 + 0.5
        d = coarse_disparity_at(keyframe.view, p1)
        ok = np.isfinite(d)
        uvr = np.column_stack([p1, p1[:, 0] - d])[ok]
        points = to_world(self.T[self.keyframes.index(keyframe) if False else -1], triangulate(self.camera, uvr))
        K = np.array([[self.camera.fx_px, 0, self.camera.cx_px], [0, self.camera.fy_px, self.camera.cy_px], [0, 0, 1]])
        good = np.isfinite(points).all(axis=1)
        if good.sum() < MIN_POINTS:
            return None
        cv2.setRNGSeed(0)
        try:
            found, rotation, translation, inliers = cv2.solvePnPRansac(points[good], np.ascontiguousarray(p2[ok][good]), K, np.zeros(4), iterationsCount=1000, reprojectionError=6.0, confidence=0.999)
        except cv2.error:
            return None
        if not found or inliers is None or len(inliers) < MIN_POINTS:
            return None
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
        self.log.append(("coarse", len(matches), len(inliers)))
        return np.linalg.inv(T)

    def _new_keyframe(self, view: View, T: np.ndarray, ids: np.ndarray, uvr: np.ndarray) -> None:
        if len(ids) < POINTS:
            corners = find_corners(view, uvr[:, :2], POINTS)
            right, seen = match_right(view, corners, coarse_disparity_at(view, corners))
            new = np.column_stack([corners, right])[seen]
            new = new[new[:, 0] - new[:, 2] + self.camera.doffs_px > MIN_DISPARITY_PX]
            fresh = len(self.points) + np.arange(len(new))
            self.points = np.concatenate([self.points, to_world(T, triangulate(self.camera, new))])
            ids, uvr = np.concatenate([ids, fresh]), np.concatenate([uvr, new])
        self.keyframes.append(Keyframe(len(self.relative), view, ids, uvr))
        self.T.append(T)
        if len(self.keyframes) > 1 and self.window > 1:
            self._adjust()

    window = WINDOW

    def _adjust(self) -> None:
        first = max(0, len(self.keyframes) - self.window)
        window = self.keyframes[first:]
        ids = np.concatenate([k.ids for k in window])
        cameras = np.repeat(np.arange(len(window)), [len(k.ids) for k in window])
        uvr = np.concatenate([k.uvr_px for k in window])
        unique, index, counts = np.unique(ids, return_inverse=True, return_counts=True)
        often = counts[index] > 1
        used = np.flatnonzero(counts > 1)
        renumber = np.full(len(unique), -1)
        renumber[used] = np.arange(len(used))
        seen = Sightings(cameras[often], renumber[index[often]], uvr[often])
        fixed = np.zeros(len(window), bool)
        fixed[0] = True
        if len(window) == self.window:
            fixed[: self.window // 4] = True
        bundle = adjust(self.camera, Bundle(np.stack(self.T[first:]), self.points[unique[used]]), seen, fixed, SIGMA_PX)
        self.T[first:] = list(bundle.T_world_camera)
        self.points[unique[used]] = bundle.points_world
