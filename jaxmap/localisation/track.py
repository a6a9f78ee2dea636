"""Position and heading: GPS fixes them, gyro and wheels carry them from fix to fix.

One Gauss-Newton problem over the whole recording. The state of a knot is the position of the ground point under the
IMU (along the body's up axis), heading, forward speed, and three slowly varying parameters: the bias of the yaw rate,
the scale of the wheel speed (radius and slip), and the offset of the turning axis ahead of the IMU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from jaxmap.localisation.attitude import RollPitch
from jaxmap.localisation.chain import ChainLeastSquares
from jaxmap.localisation.sensors import GpsFixes, RoverGeometry

EAST, NORTH, UP, HEADING, SPEED, BIAS, WHEEL_SCALE, TURNING_CENTRE = range(8)
"""The states of a knot: m, rad from east towards north, m/s, rad/s, a factor, m."""

STATES = 8

MAX_ITERATIONS = 20

MAX_HEADING_VOTES = 2000
"""Most steps from fix to fix that the initial heading is estimated from."""

DRIFT_TIME_S = 15.0
"""Time over which the initial heading neglects the drift of the gyro."""


@dataclass(frozen=True)
class TrackNoise:
    """Standard deviations of the terms of the least-squares problem; random walks per root of time, distance or angle.

    Attributes:
        slip_along, slip_across, slip_up: of the distance travelled, m per root metre.
        slip_turning: sideways, m per root radian turned.
        creep_m: of the position at rest, m per root second.
        gyro: rad per root second; gyro_scale: rad per root radian turned.
        gyro_gap: in gaps of the IMU, rad per root second.
        standing: of the heading while no wheel turns, rad per root second.
        bias, bias_drift: of the bias of the yaw rate, prior in rad/s, and drift in rad/s per root second.
        acceleration: of the speed, m/s per root second.
        wheel_m_s: of the mean wheel speed from one knot to the next; standing_m_s: while no wheel turns.
        wheel_scale, wheel_scale_drift: of the wheel scale, prior, and drift per root metre.
        turning_centre_m: prior of the turning axis's offset.
        tilt_rad: of roll and pitch, which move the antenna on its mast.
        huber: residuals of fixes beyond so many sigma weigh less (Huber's loss).
    """

    slip_along: float = 0.01
    slip_across: float = 0.02
    slip_up: float = 0.015
    slip_turning: float = 0.03
    creep_m: float = 0.002
    gyro: float = 5e-4
    gyro_scale: float = 0.01
    gyro_gap: float = 0.5
    standing: float = 2e-4
    bias: float = 0.02
    bias_drift: float = 5e-5
    acceleration: float = 0.2
    wheel_m_s: float = 0.03
    standing_m_s: float = 0.003
    wheel_scale: float = 0.3
    wheel_scale_drift: float = 0.02
    turning_centre_m: float = 0.05
    tilt_rad: float = 0.004
    huber: float = 3.0


class OdometryIncrements(NamedTuple):
    """What gyros and wheels measured from each knot to the next, all (K - 1,).

    Attributes:
        dt_s: the time.
        heading_change_rad: by the gyros; NaN in gaps of the IMU.
        wheel_speed_m_s: the mean forward speed; NaN in gaps of the odometry.
        standing: whether the rover stands, bool.
    """

    dt_s: np.ndarray
    heading_change_rad: np.ndarray
    wheel_speed_m_s: np.ndarray
    standing: np.ndarray


class RoverTrack(NamedTuple):
    """Estimated position and heading.

    Attributes:
        imu_world_m: (K, 3), position of the IMU.
        heading_rad: (K,), from east towards north, continuous.
        heading_sigma_rad: the median over the track.
        wheel_scale: the mean over the track.
        outliers: how many fixes lie beyond the bound of the Huber loss.
    """

    imu_world_m: np.ndarray
    heading_rad: np.ndarray
    heading_sigma_rad: float
    wheel_scale: float
    outliers: int


def estimate_track(
    fixes: GpsFixes,
    knot_of_fix: Int[np.ndarray, "N"],
    odometry: OdometryIncrements,
    roll_pitch: RollPitch,
    geometry: RoverGeometry,
    noise: TrackNoise | None = None,
) -> RoverTrack:
    """Position and heading at the knots.

    Args:
        fixes: at least two.
        knot_of_fix: (N,), the knot at the time of each fix, increasing.
        odometry: between the knots.
        roll_pitch: at the knots.
        geometry: of antenna and wheels.
        noise: standard deviations; by default `TrackNoise()`.

    Raises:
        numpy.linalg.LinAlgError: the measurements do not determine the track.
    """
    problem = TrackProblem(fixes, knot_of_fix, odometry, roll_pitch, geometry, noise or TrackNoise())
    state = initial_state(fixes, problem)
    for iteration in range(MAX_ITERATIONS):
        # The first steps are not near enough to separate outliers from good fixes.
        step = problem.linearise(state, robust=iteration > 1).step()
        state += step
        if iteration > 2 and np.abs(step[:, : HEADING + 1]).max() < 1e-5:
            break
    some = np.linspace(0, len(state) - 1, 9).astype(int)
    heading_sigma_rad = np.median(problem.linearise(state, robust=True).sigma(some, HEADING))
    height = turned(levelled(np.array([0.0, 0.0, geometry.height_m]), roll_pitch), state[:, HEADING])
    return RoverTrack(
        imu_world_m=state[:, :3] + height + problem.origin_m,
        heading_rad=state[:, HEADING],
        heading_sigma_rad=float(heading_sigma_rad),
        wheel_scale=float(state[:, WHEEL_SCALE].mean()),
        outliers=int((problem.fix_weights(state) < 1).any(axis=1).sum()),
    )


class TrackProblem:
    """The least-squares problem of one track.

    Attributes:
        origin_m: (3,), subtracted from positions, so that the equations stay well conditioned.
        antenna_m: (N, 3), the fixes relative to the origin.
        lever_m: (N, 3), from the ground point to the antenna, levelled: it turns with the heading alone.
        dt_s, heading_change_rad, wheel_speed_m_s: as in `OdometryIncrements`, 0 in gaps.
        has_gyro, has_wheels: (K - 1,), outside the gaps.
    """

    def __init__(
        self,
        fixes: GpsFixes,
        knot_of_fix: Int[np.ndarray, "N"],
        odometry: OdometryIncrements,
        roll_pitch: RollPitch,
        geometry: RoverGeometry,
        noise: TrackNoise,
    ) -> None:
        self.knot_of_fix, self.noise, self.geometry = knot_of_fix, noise, geometry
        self.origin_m = fixes.antenna_world_m[0]
        self.antenna_m = fixes.antenna_world_m - self.origin_m
        self.dt_s, self.standing = odometry.dt_s, odometry.standing
        self.has_gyro = np.isfinite(odometry.heading_change_rad)
        self.has_wheels = np.isfinite(odometry.wheel_speed_m_s)
        self.heading_change_rad = np.nan_to_num(odometry.heading_change_rad)
        self.wheel_speed_m_s = np.nan_to_num(odometry.wheel_speed_m_s)
        self.pitch_rad = _middle(roll_pitch.pitch_rad)
        mast_body_m = geometry.antenna_body_m + np.array([0, 0, geometry.height_m])
        self.lever_m = levelled(mast_body_m, roll_pitch)[knot_of_fix]
        mast_m = np.linalg.norm(mast_body_m)
        self.fix_sigma = np.sqrt(fixes.sigma_m**2 + np.array([1, 1, 0]) * (mast_m * noise.tilt_rad) ** 2)

    def linearise(self, state: np.ndarray, robust: bool) -> ChainLeastSquares:
        """The terms linearised at a state (K, 8); `robust`: with the Huber weights of the fixes."""
        chain = ChainLeastSquares(*state.shape)
        self._add_displacements(chain, state)
        self._add_rates(chain, state)
        self._add_parameters(chain, state)
        self._add_fixes(chain, state, self.fix_weights(state) if robust else np.ones_like(self.antenna_m))
        return chain

    def _add_displacements(self, chain: ChainLeastSquares, state: np.ndarray) -> None:
        """The ground point moves along the heading, and sideways as the turning axis is not under the IMU."""
        noise = self.noise
        heading, speed = _middle(state[:, HEADING]), _middle(state[:, SPEED])
        cos_h, sin_h, cos_p, sin_p = np.cos(heading), np.sin(heading), np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        east, north, up = np.diff(state[:, :3], axis=0).T
        level_ahead, left = east * cos_h + north * sin_h, north * cos_h - east * sin_h
        length_m = np.abs(np.where(self.has_wheels, self.wheel_speed_m_s, speed)) * self.dt_s
        # In a gap of the gyros the rover may have turned and moved in any direction.
        creep = noise.creep_m**2 * self.dt_s + np.where(self.has_gyro, 0, length_m**2)

        # Each body axis in the world, and the derivative of the displacement along it by the heading.
        ahead_axis, by_heading = {EAST: cos_h * cos_p, NORTH: sin_h * cos_p, UP: -sin_p}, left * cos_p
        residual = level_ahead * cos_p - up * sin_p - speed * self.dt_s
        sigma = np.sqrt(noise.slip_along**2 * length_m + creep)
        chain.between(
            _negative(ahead_axis) | {HEADING: by_heading / 2, SPEED: -self.dt_s / 2},
            ahead_axis | {HEADING: by_heading / 2, SPEED: -self.dt_s / 2},
            residual,
            sigma,
        )
        left_axis, by_heading = {EAST: -sin_h, NORTH: cos_h}, -level_ahead
        residual = left + state[:-1, TURNING_CENTRE] * self.heading_change_rad
        turning = noise.slip_turning**2 * np.abs(self.heading_change_rad)
        sigma = np.sqrt(noise.slip_across**2 * length_m + turning + creep)
        chain.between(
            _negative(left_axis) | {HEADING: by_heading / 2, TURNING_CENTRE: self.heading_change_rad},
            left_axis | {HEADING: by_heading / 2},
            residual,
            sigma,
        )
        up_axis, by_heading = {EAST: cos_h * sin_p, NORTH: sin_h * sin_p, UP: cos_p}, left * sin_p
        residual = level_ahead * sin_p + up * cos_p
        sigma = np.sqrt(noise.slip_up**2 * length_m + creep)
        chain.between(
            _negative(up_axis) | {HEADING: by_heading / 2}, up_axis | {HEADING: by_heading / 2}, residual, sigma
        )

    def _add_rates(self, chain: ChainLeastSquares, state: np.ndarray) -> None:
        """Gyro, wheels and bounded acceleration."""
        noise = self.noise
        gyro_sigma = np.sqrt(noise.gyro**2 * self.dt_s + noise.gyro_scale**2 * np.abs(self.heading_change_rad))
        gyro_sigma = np.where(self.has_gyro, gyro_sigma, noise.gyro_gap * np.sqrt(self.dt_s))
        off = np.diff(state[:, HEADING]) - self.heading_change_rad + state[:-1, BIAS] * self.dt_s
        chain.between({HEADING: -1.0, BIAS: self.dt_s}, {HEADING: 1.0}, off, gyro_sigma)
        # At standstill the gyro measures its own bias.
        standing_sigma = np.where(self.standing, noise.standing * np.sqrt(self.dt_s), np.inf)
        chain.between({HEADING: -1.0}, {HEADING: 1.0}, np.diff(state[:, HEADING]), standing_sigma)
        jump = np.diff(state[:, SPEED])
        chain.between({SPEED: -1.0}, {SPEED: 1.0}, jump, noise.acceleration * np.sqrt(self.dt_s))
        chain.between(
            {SPEED: 0.5, WHEEL_SCALE: -self.wheel_speed_m_s},
            {SPEED: 0.5},
            _middle(state[:, SPEED]) - state[:-1, WHEEL_SCALE] * self.wheel_speed_m_s,
            np.where(self.standing, noise.standing_m_s, np.where(self.has_wheels, noise.wheel_m_s, np.inf)),
        )

    def _add_parameters(self, chain: ChainLeastSquares, state: np.ndarray) -> None:
        """Priors and drift of the slowly varying parameters."""
        noise = self.noise
        creep = 1e-4 * np.sqrt(self.dt_s)
        length = np.abs(self.wheel_speed_m_s) * self.dt_s
        drifts = {
            BIAS: noise.bias_drift * np.sqrt(self.dt_s),
            WHEEL_SCALE: np.hypot(noise.wheel_scale_drift * np.sqrt(length), creep),
            TURNING_CENTRE: creep,
        }
        for number, sigma in drifts.items():
            chain.between({number: -1.0}, {number: 1.0}, np.diff(state[:, number]), sigma)
        priors = {
            BIAS: (0.0, noise.bias),
            WHEEL_SCALE: (1.0, noise.wheel_scale),
            TURNING_CENTRE: (self.geometry.turning_centre_m, noise.turning_centre_m),
            # Weak: it only keeps the equations solvable where the rover never moves.
            HEADING: (state[0, HEADING], np.pi),
        }
        for number, (mean, sigma) in priors.items():
            chain.at(0, {number: 1.0}, state[0, number] - mean, sigma)

    def _add_fixes(self, chain: ChainLeastSquares, state: np.ndarray, weights: np.ndarray) -> None:
        lever = turned(self.lever_m, state[self.knot_of_fix, HEADING])
        by_heading = (-lever[:, 1], lever[:, 0], np.zeros(len(lever)))
        residual = state[self.knot_of_fix, :3] + lever - self.antenna_m
        for axis in (EAST, NORTH, UP):
            slopes = {axis: 1.0, HEADING: by_heading[axis]}
            chain.at(self.knot_of_fix, slopes, residual[:, axis], self.fix_sigma[:, axis] / np.sqrt(weights[:, axis]))

    def fix_weights(self, state: np.ndarray) -> np.ndarray:
        """Huber weights of the fixes, (N, 3), 1 within the bound."""
        lever = turned(self.lever_m, state[self.knot_of_fix, HEADING])
        off = np.abs(state[self.knot_of_fix, :3] + lever - self.antenna_m) / self.fix_sigma
        return self.noise.huber / np.maximum(off, self.noise.huber)


def initial_state(fixes: GpsFixes, problem: TrackProblem) -> Float64[np.ndarray, "K 8"]:
    """Initial state: the fixes interpolated, and a heading that aligns the wheel odometry with them."""
    heading = _initial_heading(fixes, problem)
    knots, fix_knots = np.arange(len(heading)), problem.knot_of_fix
    state = np.zeros((len(heading), STATES))
    state[:, HEADING], state[:, WHEEL_SCALE], state[:, TURNING_CENTRE] = heading, 1, problem.geometry.turning_centre_m
    ground = problem.antenna_m - turned(problem.lever_m, heading[fix_knots])
    for axis in (EAST, NORTH, UP):
        state[:, axis] = np.interp(knots, fix_knots, ground[:, axis])
    pace = np.linalg.norm(np.diff(ground[:, :2], axis=0), axis=1) / np.diff(fixes.timestamps_s)
    pace = np.interp(knots[:-1], (fix_knots[:-1] + fix_knots[1:]) / 2, pace)
    state[:-1, SPEED] = np.where(problem.has_wheels, problem.wheel_speed_m_s, pace)
    state[-1, SPEED] = state[-2, SPEED]
    return state


def _initial_heading(fixes: GpsFixes, problem: TrackProblem) -> Float64[np.ndarray, "K"]:
    """The integrated yaw rate, offset so that the wheel odometry from fix to fix points along the antenna's motion.

    Each step from one fix to the next votes for an offset. Votes near in time are added up as complex numbers, so
    that the offset follows the gyro's drift and no angle has to be unwrapped first.
    """
    gyro = np.concatenate([[0.0], np.cumsum(problem.heading_change_rad)])
    middle = (gyro[:-1] + gyro[1:]) / 2
    some = np.unique(np.linspace(0, len(problem.knot_of_fix) - 1, MAX_HEADING_VOTES + 1).astype(int))
    knots, times_s = problem.knot_of_fix[some], fixes.timestamps_s[some]
    steps = np.diff(problem.antenna_m[some, 0] + 1j * problem.antenna_m[some, 1])
    if problem.has_wheels.any():
        way = np.concatenate([[0.0], np.cumsum(problem.wheel_speed_m_s * problem.dt_s * np.exp(1j * middle))])
        wheel_steps = np.diff(way[knots])
    else:
        # Without wheels the rover is assumed to drive forward.
        wheel_steps = np.abs(steps) * np.exp(1j * gyro[(knots[:-1] + knots[1:]) // 2])
    # A vote weighs as the shorter of the two lengths, so that neither slip nor an outlier dominates.
    votes = steps * wheel_steps.conj() / np.maximum(np.maximum(np.abs(steps), np.abs(wheel_steps)), 1e-9)
    middle_s = (times_s[:-1] + times_s[1:]) / 2
    nearness = 1 / (1 + ((middle_s[:, None] - middle_s[None, :]) / DRIFT_TIME_S) ** 2)
    offset = np.unwrap(np.angle(nearness @ votes))
    return gyro + np.interp(np.arange(len(gyro)), (knots[:-1] + knots[1:]) / 2, offset)


def levelled(vector_body: np.ndarray, roll_pitch: RollPitch) -> Float64[np.ndarray, "K 3"]:
    """A body vector rotated by roll and pitch, not by heading."""
    x, y, z = vector_body
    cos_r, sin_r = np.cos(roll_pitch.roll_rad), np.sin(roll_pitch.roll_rad)
    cos_p, sin_p = np.cos(roll_pitch.pitch_rad), np.sin(roll_pitch.pitch_rad)
    rolled_y, rolled_z = y * cos_r - z * sin_r, y * sin_r + z * cos_r
    return np.stack([x * cos_p + rolled_z * sin_p, rolled_y, rolled_z * cos_p - x * sin_p], axis=-1)


def turned(vectors: np.ndarray, heading_rad: np.ndarray) -> Float64[np.ndarray, "N 3"]:
    """Level vectors rotated by the heading."""
    x, y, z = vectors.T
    cos_h, sin_h = np.cos(heading_rad), np.sin(heading_rad)
    return np.stack([x * cos_h - y * sin_h, x * sin_h + y * cos_h, z], axis=-1)


def _middle(values: np.ndarray) -> np.ndarray:
    return (values[:-1] + values[1:]) / 2


def _negative(slopes: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    return {state: -slope for state, slope in slopes.items()}
