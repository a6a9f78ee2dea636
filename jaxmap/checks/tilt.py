"""Whether the ground that the cameras see lies level in the world of the poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from jaxmap.checks.finding import Finding
from jaxmap.checks.motions import angle_deg, between_deg
from jaxmap.datasets.pose_axes import T_Z_UP_SOURCE, PoseReading

TILTED_DEG, SLOPE_DEG, STEEPEST_DEG = 5.0, 10.0, 45.0
"""A world that begins at the first camera is tilted from the first on; in another one, ground is a slope up to the
second at least. Planes beyond the third are walls."""

AGREE_SHARE = 1 / 3
"""By this share of the tilt, the ground seen in several frames may differ."""

FIRST_DEG, FIRST_M = 0.1, 1e-3
"""A first pose that is turned and moved by less is the origin of its world."""


def tilt_findings(
    T_source_camera: Float64[np.ndarray, "N 4 4"],
    normals: Sequence[tuple[int, Float64[np.ndarray, "3"]]],
    reading: PoseReading,
) -> list[Finding]:
    """Tells a world whose up is not that of the ground, in all frames alike: a SLAM's that begins at a pitched camera.

    Args:
        T_source_camera: the poses in their own world.
        normals: index of a frame, and the normal of the ground in its camera.
        reading: the conventions that the poses were read by.
    """
    if len(normals) < 2:
        return []
    ups = np.stack([T_source_camera[row, :3, :3] @ normal for row, normal in normals])
    up = ups.mean(axis=0) / np.linalg.norm(ups.mean(axis=0))
    upright = T_Z_UP_SOURCE[reading.poses_world][2, :3]
    tilt_deg = float(between_deg(upright[None], up[None])[0])
    first = T_source_camera[0]
    begins_here = bool(angle_deg(first[:3, :3]) < FIRST_DEG and np.abs(first[:3, 3]).max() < FIRST_M)
    if not (TILTED_DEG if begins_here else SLOPE_DEG) < tilt_deg < STEEPEST_DEG:
        return []
    if np.median(between_deg(ups, np.tile(up, (len(ups), 1)))) > AGREE_SHARE * tilt_deg:
        return []
    what = f"the ground is tilted by {tilt_deg:.0f} degrees in the world of the poses"
    what += ", which is that of the first camera and not level" if begins_here else ", in all frames alike"
    fix = f"--poses-up {up[0]:.3f} {up[1]:.3f} {up[2]:.3f}" + ("" if begins_here else "; on a slope, all is well")
    return [Finding("tilted-world", begins_here, round(len(normals) / (len(normals) + 1), 2), what, fix)]
