"""Roll and pitch: the inclinometer measures them on average, the gyros their changes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.localisation.chain import ChainLeastSquares
from jaxmap.localisation.sensors import ImuLog, in_gap, increments

GRAVITY_M_S2 = 9.81

GYRO_NOISE = 1.5e-3
"""Random walk of the up direction integrated from the gyros, rad per root second; with vibration and misalignment."""

GYRO_NOISE_IN_GAP = 0.2
"""The same in gaps of the IMU."""

FORCE_SIGMA_M_S2 = 0.2
"""Of the specific force averaged around a knot (0.1 s): mostly jolts, which last longer than a sample."""

BIAS_SIGMA = 0.01
"""Prior of the gyro bias in rad/s."""

BIAS_DRIFT = 5e-5
"""Random walk of the gyro bias, rad/s per root second."""

HUBER = 2.0
"""Residuals beyond so many sigma weigh less (Huber's loss)."""

_UP, _BIAS = (0, 1, 2), (3, 4, 5)


class RollPitch(NamedTuple):
    """Roll about the forward axis (left side up) and pitch about the left axis (nose down), each (K,)."""

    roll_rad: np.ndarray
    pitch_rad: np.ndarray


def estimate_roll_pitch(
    imu: ImuLog, knots_s: Float64[np.ndarray, "K"], acceleration_body: Float64[np.ndarray, "K 3"]
) -> RollPitch:
    """Roll and pitch at the knots.

    The estimate is the up direction u in the body frame: `du/dt = -(rate - bias) x u` and
    `u = (force - acceleration) / g`. This is linear in u, whatever the tilt, and bilinear in the bias.

    Args:
        imu: gyros and inclinometer.
        knots_s: times within those of the IMU.
        acceleration_body: of the rover in m/s2, which the inclinometer cannot distinguish from tilt.

    Raises:
        numpy.linalg.LinAlgError: the measurements do not determine the attitude.
    """
    dt = np.diff(knots_s)
    # A vector fixed in the world rotates the opposite way in the body.
    turn = Rotation.from_rotvec(-increments(imu.timestamps_s, imu.angular_rate_body_rad_s, knots_s)).as_matrix()
    # The mean specific force from midway before each knot to midway after it.
    edges_s = np.concatenate([knots_s[:1], (knots_s[:-1] + knots_s[1:]) / 2, knots_s[-1:]])
    mean_force = increments(imu.timestamps_s, imu.specific_force_body_m_s2, edges_s) / np.diff(edges_s)[:, None]
    measured = (mean_force - acceleration_body) / GRAVITY_M_S2
    gaps = in_gap(imu.timestamps_s, (knots_s[:-1] + knots_s[1:]) / 2)
    up_sigma = np.where(gaps, GYRO_NOISE_IN_GAP, GYRO_NOISE) * np.sqrt(dt)
    # The inclinometer hardly weighs beside a gap.
    force_weight = np.where(np.append(gaps, False) | np.append(False, gaps), 1e-6, 1.0)

    up = measured / np.maximum(np.linalg.norm(measured, axis=1, keepdims=True), 1e-9)
    bias = np.zeros_like(up)
    huber = force_weight
    for _ in range(4):
        chain = ChainLeastSquares(len(knots_s), 6)
        middle = (up[:-1] + up[1:]) / 2
        residual = up[1:] - np.einsum("kij,kj->ki", turn, up[:-1]) + dt[:, None] * np.cross(middle, bias[:-1])
        for axis in _UP:
            by_bias = dt[:, None] * _cross_matrix(middle)[:, axis]
            before = {_UP[j]: -turn[:, axis, j] for j in range(3)} | {_BIAS[j]: by_bias[:, j] for j in range(3)}
            chain.between(before, {_UP[axis]: 1.0}, residual[:, axis], up_sigma)
            force_sigma = FORCE_SIGMA_M_S2 / GRAVITY_M_S2 / np.sqrt(huber)
            chain.at(slice(None), {_UP[axis]: 1.0}, up[:, axis] - measured[:, axis], force_sigma)
            drift = bias[1:, axis] - bias[:-1, axis]
            chain.between({_BIAS[axis]: -1.0}, {_BIAS[axis]: 1.0}, drift, BIAS_DRIFT * np.sqrt(dt))
            chain.at(0, {_BIAS[axis]: 1.0}, bias[0, axis], BIAS_SIGMA)
        step = chain.step()
        up, bias = up + step[:, :3], bias + step[:, 3:]
        off = np.linalg.norm(up - measured, axis=1) / (FORCE_SIGMA_M_S2 / GRAVITY_M_S2)
        huber = force_weight * HUBER / np.maximum(off, HUBER)
    return RollPitch(np.arctan2(up[:, 1], up[:, 2]), np.arctan2(-up[:, 0], np.hypot(up[:, 1], up[:, 2])))


def _cross_matrix(vectors: np.ndarray) -> np.ndarray:
    """The matrices [v]x with [v]x w = v x w, (N, 3, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
