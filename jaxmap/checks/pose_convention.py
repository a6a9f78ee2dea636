"""Whether poses fit what the images show of the motion and of the ground, and by which conventions they would."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.checks.camera_mounting import mounting_findings
from jaxmap.checks.finding import Finding
from jaxmap.checks.motions import (
    Motion,
    between_deg,
    choose_steps,
    ground_normal,
    measure_motion,
    read_shrunk,
    shrunk_camera,
)
from jaxmap.checks.scale import scale_findings, still_findings
from jaxmap.checks.tilt import tilt_findings
from jaxmap.datasets.base import StereoSequence
from jaxmap.datasets.options import PosesAre
from jaxmap.datasets.pose_axes import (
    T_CHILD_CAMERA,
    T_Z_UP_SOURCE,
    PoseReading,
    Quaternion,
    rigid_inverse,
    with_other_quaternions,
)
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import Matcher, StereoOptions

WIDTH_PX = 600
"""Images are shrunk to about this width."""

FITS_DEG, SUSPECT_DEG = 25.0, 12.0
"""Steps and turns whose directions are off by less fit; those above the second do not where others are far better."""

FAR_BETTER = 4.0
CHANGE_DEG = 3.0
"""What a reading must be better by for each convention that it changes."""

UPRIGHT, CLEARLY_UPRIGHT = 0.5, 0.7
"""Cosine between the world's up and that of the images. Above the second the images' upright alone is believed: the
plane that was measured may be a wall."""

SURE_MOTIONS = 4
"""So many motions that fit no convention make the map wrong; fewer may be wrong themselves."""

STEEP = 0.7
"""Share of the path that is climbed or fallen, on one that no rover drives."""

_WORDS = {
    "pose_convention": {
        "optical": "of the camera's optical axes (x right, y down, z forward)",
        "body": "of a body (x forward, y left, z up)",
        "frd": "of a body (x forward, y right, z down)",
        "opengl": "of OpenGL's axes (x right, y up, z backward)",
    },
    "poses_world": {
        "z_up": "in a world with z up",
        "z_down": "in a world with z down",
        "y_up": "in a world with y up",
        "camera": "in a world with y down",
    },
    "poses_are": {"T_world_camera": "camera to world", "T_camera_world": "world to camera"},
    "quaternion": {"xyzw": "with quaternions x y z w", "wxyz": "with quaternions w x y z"},
}


class _Fit(NamedTuple):
    """How a reading of the poses fits the images.

    Attributes:
        reading: the conventions.
        changes: in how many they differ from those in use.
        off_deg: by how much the directions of steps and turns are off, the greater of the two medians; 0 without
            motions.
        up: cosine between the world's up and what the images show of it.
        T_source_camera: (N, 4, 4).
    """

    reading: PoseReading
    changes: int
    off_deg: float
    up: float
    T_source_camera: np.ndarray

    @property
    def cost_deg(self) -> float:
        """Degrees that it is off by, with those for its changes."""
        return self.off_deg + self.tilt_deg / 4 + CHANGE_DEG * self.changes

    @property
    def tilt_deg(self) -> float:
        return float(np.degrees(np.arccos(np.clip(self.up, -1, 1))))


def pose_findings(sequence: StereoSequence, front_end: StereoFrontEnd, steps: int = 5) -> list[Finding]:
    """Measures the motion between some frames of a sequence, and compares it with the poses; tells of faulty poses.

    Args:
        sequence: with its poses.
        front_end: its rectification and matcher.
        steps: how many pairs of frames to look at; none leaves what the poses alone say.
    """
    T_raw_rectified = front_end.T_raw_rectified
    shrink = max(1, round(front_end.camera.width_px / WIDTH_PX))
    camera = shrunk_camera(front_end.camera, shrink)
    matcher = Matcher(StereoOptions(), camera.width_px)
    motions, normals = [], []
    for i, j in choose_steps(sequence.T_world_camera, steps):
        pair_i, pair_j = (read_shrunk(sequence, front_end, index, shrink) for index in (i, j))
        if pair_i is None or pair_j is None:
            continue
        disparity_px = matcher(*pair_i)
        if (normal := ground_normal(camera, disparity_px)) is not None:
            normals.append((i, T_raw_rectified[:3, :3] @ normal))
        motion = measure_motion(camera, (i, j), pair_i[0], disparity_px, pair_j[0])
        if motion is not None:
            motions.append(motion._replace(T_i_j=T_raw_rectified @ motion.T_i_j @ T_raw_rectified.T))
    left_out = "mend or remove these lines of the pose file"
    faults = [Finding("unusable-poses", False, 1.0, fault, left_out) for fault in sequence.pose_faults]
    return faults + pose_convention(
        sequence.T_world_camera,
        motions,
        normals,
        reading=sequence.pose_reading,
        site_origin=sequence.site_origin,
        baseline_m=float(camera.baseline_m),
    )


def pose_convention(
    T_world_camera: Float64[np.ndarray, "N 4 4"],
    motions: Sequence[Motion],
    up_camera_measured: Sequence[tuple[int, Float64[np.ndarray, "3"]]] = (),
    *,
    reading: PoseReading = PoseReading(),  # noqa: B008 - a value
    site_origin: Float64[np.ndarray, "3"] | None = None,
    baseline_m: float | None = None,
) -> list[Finding]:
    """Which conventions make the poses agree with the motions that images show, and put the ground below the camera.

    Tried are all axes of the posed frame, both directions of the transform, both orders of quaternions, each in the
    world whose up fits best. A step of the poses that points elsewhere than that of the images, or a world whose up is
    neither that of the images nor of the ground, is told with the options under which all agree; so is a length of
    steps that is off by a unit.

    Args:
        T_world_camera: left camera in the z-up world, as read.
        motions: as measured between frames.
        up_camera_measured: index of a frame, and the normal of the ground in its camera.
        reading: the conventions that the poses were read by.
        site_origin: what was subtracted from the positions.
        baseline_m: of the camera, to tell a wrong unit of the baseline from one of the poses.
    """
    T_source_camera = T_world_camera.copy()
    T_source_camera[:, :3, 3] += 0.0 if site_origin is None else site_origin
    T_source_camera = T_Z_UP_SOURCE[reading.poses_world].T @ T_source_camera
    T_file = reading.file_poses(T_source_camera)
    told = [motion for motion in motions if motion.steps or motion.turns]
    fits = _fits(reading, T_file, told, up_camera_measured)
    used = next(fit for fit in fits if not fit.changes)
    if used.off_deg > FITS_DEG and (still := still_findings(used.T_source_camera, told)):
        return still
    # Noise alone must not make another reading look better.
    limit_deg = FITS_DEG if used.off_deg < FITS_DEG else min(FITS_DEG, used.off_deg / 2)
    fitting = [fit for fit in fits if fit.changes and fit.off_deg < limit_deg and fit.up > UPRIGHT]
    fitting.sort(key=lambda fit: fit.cost_deg)
    best_deg = min((fit.off_deg for fit in fitting), default=np.inf)
    far_better = used.off_deg > max(SUSPECT_DEG, FAR_BETTER * best_deg)
    if used.off_deg < FITS_DEG and used.up > UPRIGHT and not far_better:
        mounting = mounting_findings(used.T_source_camera, told, reading)
        # A camera that is turned on its body sees the ground askew, too.
        tilt = [] if mounting else tilt_findings(used.T_source_camera, up_camera_measured, used.reading)
        return [*mounting, *tilt, *scale_findings(used.T_source_camera, told, baseline_m)]
    if not fitting:
        return _disagreement(used, told)
    best = fitting[0]
    rivals = [fit for fit in fitting[1:] if fit.cost_deg < best.cost_deg + CHANGE_DEG / 2]
    evidence = len(told) + len(up_camera_measured)
    gain = max((used.off_deg - best.off_deg) / 45, (used.tilt_deg - best.tilt_deg) / 60)
    certain = min(1.0, gain) * (evidence + 1) / (evidence + 2) * (0.75 if rivals else 1.0)
    read = " and ".join(_WORDS[name][getattr(reading, name)] for name in _changed(reading, best.reading))
    what = f"the poses, read as {read}, do not fit the images: {_misfit(used, told, best)}"
    fix = " or ".join([_options(reading, best.reading), *(_options(reading, rival.reading) for rival in rivals[:2])])
    found = Finding("pose-convention", True, round(float(np.clip(certain, 0.3, 0.99)), 2), what, fix)
    mounting = mounting_findings(best.T_source_camera, told, best.reading)
    return [found, *mounting, *scale_findings(best.T_source_camera, told, baseline_m)]


def _changed(used: PoseReading, other: PoseReading) -> list[str]:
    """The options in which two readings differ."""
    return [name for name, a, b in zip(PoseReading._fields, used, other, strict=True) if a != b]


def _options(used: PoseReading, other: PoseReading) -> str:
    """The options that change one reading into the other."""
    return " ".join(f"--{name.replace('_', '-')} {getattr(other, name)}" for name in _changed(used, other))


def _fits(
    used: PoseReading, T_file: np.ndarray, motions: Sequence[Motion], normals: Sequence[tuple[int, np.ndarray]]
) -> list[_Fit]:
    """How every reading fits; the world matters to what is up alone."""
    fits = []
    for quaternion in get_args(Quaternion):
        T_as_read = with_other_quaternions(T_file, used.quaternion, quaternion)
        for axes, are in product(T_CHILD_CAMERA, get_args(PosesAre)):
            T = PoseReading(axes, poses_are=are).camera_poses(T_as_read)
            off_deg = _off_deg(T, motions)
            for world, T_z_up_source in T_Z_UP_SOURCE.items():
                R = T_z_up_source[:3, :3]
                up = _up(R @ T[:, :3, :3], T[:, :3, 3] @ R.T, normals)
                reading = PoseReading(axes, world, are, quaternion)
                fits.append(_Fit(reading, len(_changed(used, reading)), off_deg, up, T))
    return fits


def _off_deg(T_source_camera: np.ndarray, motions: Sequence[Motion]) -> float:
    """By how much the directions of steps and turns are off: the greater of their medians."""
    if not motions:
        return 0.0
    i, j = np.array([(motion.i, motion.j) for motion in motions]).T
    by_poses = rigid_inverse(T_source_camera[i]) @ T_source_camera[j]
    by_images = np.stack([motion.T_i_j for motion in motions])
    steps, turns = [motion.steps for motion in motions], [motion.turns for motion in motions]
    vectors = [Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (by_poses, by_images)]
    kinds = ((steps, by_poses[:, :3, 3], by_images[:, :3, 3]), (turns, *vectors))
    return max(float(np.median(between_deg(a[known], b[known]))) for known, a, b in kinds if any(known))


def _up(R_world_camera: np.ndarray, positions_m: np.ndarray, normals: Sequence[tuple[int, np.ndarray]]) -> float:
    """How well z is up, by the cameras' upright, or by the ground that they see.

    A camera that looks down, or hangs upside down, has the ground below it all the same. Where no ground was
    measured, one that looks straight down is believed unless its path is too steep.
    """
    upright = float(-R_world_camera[:, 2, 1].mean())
    if upright > CLEARLY_UPRIGHT:
        return upright
    if normals:
        return float(np.median([R_world_camera[row, 2] @ normal for row, normal in normals]))
    looks_down = float(-R_world_camera[:, 2, 2].mean())
    steps = np.diff(positions_m, axis=0)
    length_m = np.linalg.norm(steps, axis=1).sum()
    steep = length_m > 0 and np.abs(steps[:, 2]).sum() > STEEP * length_m
    return upright if steep else max(upright, looks_down)


def _misfit(used: _Fit, motions: Sequence[Motion], best: _Fit | None = None) -> str:
    """What is the matter with the reading in use, and how much of it is left by the best one."""
    faults = []
    if used.off_deg > SUSPECT_DEG:
        pairs = f"{len(motions)} pair{'s' * (len(motions) > 1)} of frames"
        left = f" ({best.off_deg:.0f} if read otherwise)" if best else ""
        faults.append(f"the motion of the camera between {pairs} is off by {used.off_deg:.0f} degrees{left}")
    if used.up <= UPRIGHT:
        R = T_Z_UP_SOURCE[used.reading.poses_world][:3, :3] @ used.T_source_camera[:, :3, :3]
        up, ahead = -R[:, 2, 1].mean(), R[:, 2, 2].mean()
        stance = "stand on their heads" if up < -0.5 else "look at the sky" if ahead > 0.6 else "lie on their side"
        faults.append(f"the cameras {stance if ahead > -0.6 else 'look straight down'} in a z-up world")
    return " and ".join(faults)


def _disagreement(used: _Fit, motions: Sequence[Motion]) -> list[Finding]:
    """No convention mends the poses: they are of other frames, or of another clock, or the calibration is off."""
    if 0 < len(motions) <= 2:
        return []
    what = f"the poses do not fit the images, by no convention: {_misfit(used, motions)}"
    fix = "check that poses and images are of one drive and one clock, that no frames are left out, and the calibration"
    certain = 0.6 * len(motions) / (len(motions) + 2)
    return [Finding("poses-disagree", len(motions) >= SURE_MOTIONS, round(certain, 2), what, fix)]
