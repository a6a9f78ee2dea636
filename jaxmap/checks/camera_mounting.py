"""Whether the camera looks another way than the frame whose poses are given: a body's, or a level nominal camera's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.checks.finding import Finding
from jaxmap.checks.motions import Motion, between_deg
from jaxmap.datasets.pose_axes import PoseReading, rigid_inverse

TURNED_DEG, STOPS_DEG = 5.0, 12.0
"""Cameras turned by less are told by `jaxmap refine`; by more than the second, the map would be wrong."""

DIRECTIONS = 3
"""Fewer directions of steps and turns agree after some turn by chance."""

AGREE_DEG = 4.0
"""Steps agree to this after the turn, or it is not a turn that is amiss."""

PRIOR = 0.05
"""Weight of "not turned", beside 1 for a step: what no step shows stays zero."""


def mounting_findings(
    T_world_camera: Float64[np.ndarray, "N 4 4"], motions: Sequence[Motion], reading: PoseReading
) -> list[Finding]:
    """Tells a constant turn between the frame of the poses and the camera, where steps and turns agree on it.

    Args:
        T_world_camera: the poses as read; any world.
        motions: measured between frames.
        reading: the conventions that the poses were read by.
    """
    by_poses, by_images = _directions(T_world_camera, motions)
    if len(by_poses) < DIRECTIONS:
        return []
    before_deg = float(np.median(between_deg(by_poses, by_images)))
    weights = [1.0] * len(by_poses) + [PRIOR] * 3
    R_nominal_camera = Rotation.align_vectors(
        np.concatenate([by_poses, np.eye(3)]), np.concatenate([by_images, np.eye(3)]), weights
    )[0]
    turned_deg = float(np.degrees(R_nominal_camera.magnitude()))
    after_deg = float(np.median(between_deg(by_poses, R_nominal_camera.apply(by_images))))
    if turned_deg < TURNED_DEG or before_deg < TURNED_DEG or after_deg > min(AGREE_DEG, before_deg / 3):
        return []
    vector = R_nominal_camera.as_rotvec()
    down_deg = float(np.degrees(np.arcsin(np.clip(R_nominal_camera.as_matrix()[1, 2], -1, 1))))
    what = f"the camera is turned by {turned_deg:.0f} degrees ({down_deg:+.0f} down) against the axes of the poses"
    turn = f"mounting: {{translation_m: [0, 0, 0], rotation_vector_rad: [{', '.join(f'{x:.3f}' for x in vector)}]}}"
    if reading.pose_convention in ("body", "frd"):
        fix = f"give the camera's place on the body in the calibration file, turned so: {turn}"
    else:
        fix = (
            "give poses of the left camera itself, or check the principal point of the calibration; poses of the "
            f"sequence's own can be turned in camera.yaml: {turn}"
        )
    certain = len(by_poses) / (len(by_poses) + 1)
    return [Finding("camera-mounting", turned_deg > STOPS_DEG, round(certain, 2), what, fix)]


def _directions(T: np.ndarray, motions: Sequence[Motion]) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (M, 3) of steps and turns, by the poses and by the images."""
    pairs = []
    for motion in motions:
        by_pose = rigid_inverse(T[[motion.i]])[0] @ T[motion.j]
        if motion.steps:
            pairs.append((by_pose[:3, 3], motion.T_i_j[:3, 3]))
        if motion.turns:
            pairs.append(tuple(Rotation.from_matrix(M[:3, :3]).as_rotvec() for M in (by_pose, motion.T_i_j)))
    vectors = np.array(pairs, np.float64).reshape(-1, 2, 3)
    lengths = np.linalg.norm(vectors, axis=2, keepdims=True)
    vectors = (vectors / np.where(lengths > 0, lengths, 1.0))[(lengths > 0).all(axis=(1, 2))]
    return vectors[:, 0], vectors[:, 1]
