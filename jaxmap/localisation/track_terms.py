"""What a track is held against: the terms of its least-squares problem, and how far each is trusted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from jaxmap.localisation.attitude import Tilt
from jaxmap.localisation.chain import ChainLeastSquares
from jaxmap.localisation.sensors import GpsFixes, RoverGeometry

EAST, NORTH, UP, HEADING, SPEED, BIAS, WHEEL_SCALE, CENTRE = range(8)
"""The states of a knot: metres, radians from east towards north, m/s, rad/s, a factor, metres."""

STATES = 8


@dataclass(frozen=True)
class TrackNoise:
    """Standard deviations of the track's terms. Random walks are per root of what they grow with.

    Attributes:
        slip_along, slip_across, slip_up: of the way travelled, m per root metre.
        slip_turning: sideways, m per root radian turned.
        creep_m: of the position at rest, m per root second.
        gyro: rad per root second; gyro_scale: rad per root radian turned.
        gyro_silent: where the IMU has a gap, rad per root second.
        standing: of the heading while no wheel turns, rad per root second.
        bias, bias_drift: of the yaw rate's bias in rad/s, before and per root second.
        acceleration: of the speed, m/s per root second.
        wheel_m_s: of the wheels' mean speed from one knot to the next; standing_m_s: while none turns.
        wheel_scale, wheel_scale_drift: before anything is known, and per root metre.
        centre_m: of the turning centre's offset, before anything is known.
        tilt_rad: of roll and pitch, which move the antenna on its mast.
        huber: fixes beyond so many sigma pull with a constant force.
    """

    slip_along: float = 0.01
    slip_across: float = 0.02
    slip_up: float = 0.015
    slip_turning: float = 0.03
    creep_m: float = 0.002
    gyro: float = 5e-4
    gyro_scale: float = 0.01
    gyro_silent: float = 0.5
    standing: float = 2e-4
    bias: float = 0.02
    bias_drift: float = 5e-5
    acceleration: float = 0.2
    wheel_m_s: float = 0.03
    standing_m_s: float = 0.003
    wheel_scale: float = 0.3
    wheel_scale_drift: float = 0.02
    centre_m: float = 0.05
    tilt_rad: float = 0.004
    huber: float = 3.0


class Motion(NamedTuple):
    """What gyros and wheels say of the way from each knot to the next, all (K - 1,).

    Attributes:
        dt_s: the time.
        turn_rad: by how much the heading changed; NaN where the gyros are silent.
        wheel_speed_m_s: the mean speed forward; NaN where the wheels are silent.
        standing: whether the rover stands, bool.
    """

    dt_s: np.ndarray
    turn_rad: np.ndarray
    wheel_speed_m_s: np.ndarray
    standing: np.ndarray


class TrackTerms:
    """The terms of one track, to be linearised again and again.

    Attributes:
        origin_m: (3,), what is subtracted from positions, so that the equations stay well conditioned.
        antenna_m: (N, 3), the fixes less the origin.
        lever_m: (N, 3), the antenna as seen from the ground point; it turns with the heading alone.
        dt_s, turn_rad, wheel_speed_m_s: as in `Motion`, 0 where nothing was heard.
    """

    def __init__(
        self,
        fixes: GpsFixes,
        knot_of_fix: Int[np.ndarray, "N"],
        motion: Motion,
        tilt: Tilt,
        geometry: RoverGeometry,
        noise: TrackNoise,
    ) -> None:
        self.knot_of_fix, self.noise, self.geometry = knot_of_fix, noise, geometry
        self.origin_m = fixes.antenna_world_m[0]
        self.antenna_m = fixes.antenna_world_m - self.origin_m
        self.dt_s = motion.dt_s
        self.gyro_heard, self.wheels_heard = np.isfinite(motion.turn_rad), np.isfinite(motion.wheel_speed_m_s)
        self.turn_rad, self.wheel_speed_m_s = np.nan_to_num(motion.turn_rad), np.nan_to_num(motion.wheel_speed_m_s)
        self.standing = motion.standing
        self.pitch = _middle(tilt.pitch_rad)
        mast_body_m = geometry.antenna_body_m + np.array([0, 0, geometry.height_m])
        self.lever_m = levelled(mast_body_m, tilt)[knot_of_fix]
        mast_m = np.linalg.norm(mast_body_m)
        self.fix_sigma = np.sqrt(fixes.sigma_m**2 + np.array([1, 1, 0]) * (mast_m * noise.tilt_rad) ** 2)

    def linearise(self, state: np.ndarray, robust: bool) -> ChainLeastSquares:
        """The terms around a state (K, 8); `robust`: fixes that do not fit count less."""
        chain = ChainLeastSquares(*state.shape)
        self._add_way(chain, state)
        self._add_rates(chain, state)
        self._add_constants(chain, state)
        self._add_fixes(chain, state, self.fix_weights(state) if robust else np.ones_like(self.antenna_m))
        return chain

    def _add_way(self, chain: ChainLeastSquares, state: np.ndarray) -> None:
        """The ground point goes where the rover heads, and sideways where its turning takes it."""
        noise = self.noise
        heading, speed = _middle(state[:, HEADING]), _middle(state[:, SPEED])
        cos_h, sin_h, cos_p, sin_p = np.cos(heading), np.sin(heading), np.cos(self.pitch), np.sin(self.pitch)
        east, north, up = np.diff(state[:, :3], axis=0).T
        level_ahead, left = east * cos_h + north * sin_h, north * cos_h - east * sin_h
        length_m = np.abs(np.where(self.wheels_heard, self.wheel_speed_m_s, speed)) * self.dt_s
        # Where the gyros are silent, the rover may have turned in between and gone any way.
        creep = noise.creep_m**2 * self.dt_s + np.where(self.gyro_heard, 0, length_m**2)

        # Each of the body's axes in the world, and the derivative by the heading of the way along it.
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
        residual = left + state[:-1, CENTRE] * self.turn_rad
        turning = noise.slip_turning**2 * np.abs(self.turn_rad)
        sigma = np.sqrt(noise.slip_across**2 * length_m + turning + creep)
        chain.between(
            _negative(left_axis) | {HEADING: by_heading / 2, CENTRE: self.turn_rad},
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
        """Gyro, wheels, and that the speed does not jump."""
        noise = self.noise
        gyro_sigma = np.sqrt(noise.gyro**2 * self.dt_s + noise.gyro_scale**2 * np.abs(self.turn_rad))
        gyro_sigma = np.where(self.gyro_heard, gyro_sigma, noise.gyro_silent * np.sqrt(self.dt_s))
        off = np.diff(state[:, HEADING]) - self.turn_rad + state[:-1, BIAS] * self.dt_s
        chain.between({HEADING: -1.0, BIAS: self.dt_s}, {HEADING: 1.0}, off, gyro_sigma)
        # Standing still shows the gyro's bias, long before the drift of the heading would.
        standing_sigma = np.where(self.standing, noise.standing * np.sqrt(self.dt_s), np.inf)
        chain.between({HEADING: -1.0}, {HEADING: 1.0}, np.diff(state[:, HEADING]), standing_sigma)
        jump = np.diff(state[:, SPEED])
        chain.between({SPEED: -1.0}, {SPEED: 1.0}, jump, noise.acceleration * np.sqrt(self.dt_s))
        chain.between(
            {SPEED: 0.5, WHEEL_SCALE: -self.wheel_speed_m_s},
            {SPEED: 0.5},
            _middle(state[:, SPEED]) - state[:-1, WHEEL_SCALE] * self.wheel_speed_m_s,
            np.where(self.standing, noise.standing_m_s, np.where(self.wheels_heard, noise.wheel_m_s, np.inf)),
        )

    def _add_constants(self, chain: ChainLeastSquares, state: np.ndarray) -> None:
        """What hardly changes, and what is known of it beforehand."""
        noise = self.noise
        creep = 1e-4 * np.sqrt(self.dt_s)
        length = np.abs(self.wheel_speed_m_s) * self.dt_s
        drifts = {
            BIAS: noise.bias_drift * np.sqrt(self.dt_s),
            WHEEL_SCALE: np.hypot(noise.wheel_scale_drift * np.sqrt(length), creep),
            CENTRE: creep,
        }
        for number, sigma in drifts.items():
            chain.between({number: -1.0}, {number: 1.0}, np.diff(state[:, number]), sigma)
        beforehand = {
            BIAS: (0.0, noise.bias),
            WHEEL_SCALE: (1.0, noise.wheel_scale),
            CENTRE: (self.geometry.turning_centre_m, noise.centre_m),
            # So weak that it only keeps the equations solvable where the rover never moves.
            HEADING: (state[0, HEADING], np.pi),
        }
        for number, (mean, sigma) in beforehand.items():
            chain.at(0, {number: 1.0}, state[0, number] - mean, sigma)

    def _add_fixes(self, chain: ChainLeastSquares, state: np.ndarray, weights: np.ndarray) -> None:
        lever = turned(self.lever_m, state[self.knot_of_fix, HEADING])
        by_heading = (-lever[:, 1], lever[:, 0], np.zeros(len(lever)))
        residual = state[self.knot_of_fix, :3] + lever - self.antenna_m
        for axis in (EAST, NORTH, UP):
            slopes = {axis: 1.0, HEADING: by_heading[axis]}
            chain.at(self.knot_of_fix, slopes, residual[:, axis], self.fix_sigma[:, axis] / np.sqrt(weights[:, axis]))

    def fix_weights(self, state: np.ndarray) -> np.ndarray:
        """Huber's weights of the fixes, (N, 3), 1 within the bound."""
        lever = turned(self.lever_m, state[self.knot_of_fix, HEADING])
        off = np.abs(state[self.knot_of_fix, :3] + lever - self.antenna_m) / self.fix_sigma
        return self.noise.huber / np.maximum(off, self.noise.huber)


def _middle(values: np.ndarray) -> np.ndarray:
    return (values[:-1] + values[1:]) / 2


def _negative(slopes: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    return {state: -slope for state, slope in slopes.items()}


def levelled(vector_body: np.ndarray, tilt: Tilt) -> Float64[np.ndarray, "K 3"]:
    """A body vector turned by pitch and roll, not by heading."""
    x, y, z = vector_body
    cos_r, sin_r = np.cos(tilt.roll_rad), np.sin(tilt.roll_rad)
    cos_p, sin_p = np.cos(tilt.pitch_rad), np.sin(tilt.pitch_rad)
    rolled_y, rolled_z = y * cos_r - z * sin_r, y * sin_r + z * cos_r
    return np.stack([x * cos_p + rolled_z * sin_p, rolled_y, rolled_z * cos_p - x * sin_p], axis=-1)


def turned(vectors: np.ndarray, heading_rad: np.ndarray) -> Float64[np.ndarray, "N 3"]:
    """Level vectors turned by the heading."""
    x, y, z = vectors.T
    cos_h, sin_h = np.cos(heading_rad), np.sin(heading_rad)
    return np.stack([x * cos_h - y * sin_h, x * sin_h + y * cos_h, z], axis=-1)
