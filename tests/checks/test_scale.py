"""Steps of poses that are shorter or longer than images show, by a little and by all."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmap.checks.motions import Motion
from jaxmap.checks.pose_convention import pose_convention
from jaxmap.checks.scale import scale_findings, still_findings

STEP_M, DEPTH_M = 0.5, 3.0


def poses(count: int, step_m: float = STEP_M) -> np.ndarray:
    """A drive along the optical axis."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 2, 3] = step_m * np.arange(count)
    return T


def seen(lengths_m: list[float]) -> list[Motion]:
    """Steps along the optical axis, as long as images show."""
    motions = []
    for i, length_m in enumerate(lengths_m):
        T = np.eye(4)
        T[2, 3] = length_m
        motions.append(Motion(i, i + 1, T, 200, DEPTH_M))
    return motions


@pytest.mark.parametrize("factor", [1.18, 1 / 1.18])
def test_three_steps_tell_of_a_focal_length_that_is_off_by_a_fifth(factor):
    steps = [STEP_M * factor * noise for noise in (1.0, 1.01, 0.99)]
    (found,) = scale_findings(poses(4), seen(steps), 0.12)
    assert found.kind == "scale" and not found.stops
    assert "focal length" in found.fix and f"{factor:.4g} times as long" in found.what
    assert not scale_findings(poses(3), seen(steps[:2]), 0.12)


def test_a_difference_within_noise_is_not_told():
    assert not scale_findings(poses(6), seen([STEP_M * 1.05] * 5), 0.12)
    assert not scale_findings(poses(6), seen([STEP_M * factor for factor in (0.9, 1.5, 1.2, 1.0, 1.4)]), 0.12)


def test_a_factor_of_two_makes_the_map_wrong():
    (found,) = scale_findings(poses(4), seen([2 * STEP_M] * 3), 0.12)
    assert found.stops


@pytest.mark.parametrize("step_m", [0.0, STEP_M / 111_000])
def test_poses_that_stand_still_or_are_in_degrees_are_told(step_m):
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("x", -100, degrees=True).as_matrix()
    still = turned @ poses(4, step_m)
    still[:, :3, 3] = still[:, [1, 2, 0], 3]
    (found,) = pose_convention(still, seen([STEP_M] * 3))
    assert found.kind == "poses-still" and found.stops
    assert "0.5 m" in found.what and "UTM" in found.fix
    assert not still_findings(poses(4), seen([STEP_M] * 3))
    assert not still_findings(poses(4, 0.0), seen([0.001] * 3))
