"""Position and heading: GPS pins them down, gyro and wheels carry them between the fixes.

One Gauss-Newton problem over the whole recording. A knot holds the position of the point of the
ground under the IMU (along the body's up axis), heading, forward speed and three numbers that hardly
change: the gyro's bias, what the wheels' speed has to be multiplied by (radius and slip), and how far
ahead of the IMU the axis lies about which the rover turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.localisation.attitude import Tilt
from jaxmap.localisation.chain import ChainLeastSquares
from jaxmap.localisation.sensors import GpsFixes, RoverGeometry

EAST, NORTH, UP, HEADING, SPEED, BIAS, WHEEL_SCALE, CENTRE = range(8)

MAX_ITERATIONS = 20


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
        wheel_m_s: of the wheels' mean speed from one knot to the next.
        wheel_scale, wheel_scale_drift: before anything is known, and per root metre.
        centre_m: of the turning centre's offset, before anything is known.
        tilt_rad: of roll and pitch, which move the antenna on its mast.
        huber: fixes beyond so many sigma pull with a constant force.
    """

    slip_along: float = 0.01
    slip_across: float = 0.02
    slip_up: float = 0.02
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


class Track(NamedTuple):
    """The estimate.

    Attributes:
        position_m: (K, 3), of the IMU in the world.
        heading_rad: (K,), from east towards north, continuous.
        heading_sigma_rad: at the first, middle and last knot, the greatest.
        wheel_scale: the mean over the way.
        outliers: how many fixes lay beyond the bound of the robust loss.
    """

    position_m: np.ndarray
    heading_rad: np.ndarray
    heading_sigma_rad: float
    wheel_scale: float
    outliers: int


def estimate_track(
    fixes: GpsFixes,
    knot_of_fix: np.ndarray,
    motion: Motion,
    tilt: Tilt,
    geometry: RoverGeometry,
    noise: TrackNoise = TrackNoise(),
) -> Track:
    """Position and heading at the knots.

    Args:
        fixes: at least two.
        knot_of_fix: (N,), the knot at the time of each fix, increasing.
        motion: between the knots.
        tilt: at the knots.
        geometry: where the antenna is.
        noise: how far each source is trusted.

    Raises:
        numpy.linalg.LinAlgError: the readings determine no track.
    """
    problem = _Problem(fixes, knot_of_fix, motion, tilt, geometry, noise)
    state = problem.initial_state()
    for iteration in range(MAX_ITERATIONS):
        step = problem.linearise(state, robust=iteration > 1).step()
        state += step
        if iteration > 2 and np.abs(step[:, : HEADING + 1]).max() < 1e-5:
            break
    chain = problem.linearise(state, robust=True)
    some = np.array([0, len(state) // 2, len(state) - 1])
    mast = _turn(_level(np.array([0, 0, geometry.height_m]), tilt), state[:, HEADING])
    return Track(
        position_m=state[:, :3] + mast + problem.origin,
        heading_rad=state[:, HEADING],
        heading_sigma_rad=float(chain.sigma(some, HEADING).max()),
        wheel_scale=float(state[:, WHEEL_SCALE].mean()),
        outliers=int((problem.fix_weights(state) < 1).any(axis=1).sum()),
    )


class _Problem:
    """The terms of one track, to be linearised again and again."""

    def __init__(
        self,
        fixes: GpsFixes,
        knot_of_fix: np.ndarray,
        motion: Motion,
        tilt: Tilt,
        geometry: RoverGeometry,
        noise: TrackNoise,
    ) -> None:
        self.knot_of_fix, self.noise, self.geometry = knot_of_fix, noise, geometry
        # Small numbers keep the equations well conditioned.
        self.origin = fixes.antenna_world_m[0]
        self.antenna = fixes.antenna_world_m - self.origin
        self.fix_times_s = fixes.timestamps_s
        self.dt = motion.dt_s
        self.gyro_heard, self.wheels_heard = np.isfinite(motion.turn_rad), np.isfinite(motion.wheel_speed_m_s)
        self.turn, self.wheels = np.nan_to_num(motion.turn_rad), np.nan_to_num(motion.wheel_speed_m_s)
        self.standing = motion.standing
        self.pitch = (tilt.pitch_rad[:-1] + tilt.pitch_rad[1:]) / 2
        # The antenna as seen from the ground point, levelled: it turns with the heading alone.
        mast_body_m = geometry.antenna_body_m + [0, 0, geometry.height_m]
        self.lever = _level(mast_body_m, tilt)[knot_of_fix]
        mast_m = np.linalg.norm(mast_body_m)
        self.fix_sigma = np.sqrt(fixes.sigma_m**2 + np.array([1, 1, 0]) * (mast_m * noise.tilt_rad) ** 2)

    def initial_state(self) -> np.ndarray:
        """A heading that turns the way of the wheels onto that of the antenna, piece by piece."""
        heading, speed = self._initial_heading()
        state = np.zeros((len(heading), 8))
        state[:, HEADING], state[:, WHEEL_SCALE], state[:, CENTRE] = heading, 1, self.geometry.turning_centre_m
        state[:, SPEED] = np.append(speed, speed[-1])
        ground = self.antenna - _turn(self.lever, heading[self.knot_of_fix])
        for axis in (EAST, NORTH, UP):
            state[:, axis] = np.interp(np.arange(len(heading)), self.knot_of_fix, ground[:, axis])
        return state

    def _initial_heading(self) -> tuple[np.ndarray, np.ndarray]:
        gyro = np.concatenate([[0.0], np.cumsum(self.turn)])
        forward = np.exp(1j * (gyro[:-1] + gyro[1:]) / 2)
        steps = np.diff(self.antenna[:, 0] + 1j * self.antenna[:, 1])
        way = np.concatenate([[0.0], np.cumsum(self.wheels * self.dt * forward)])
        wheel_steps = np.diff(way[self.knot_of_fix])
        if not self.wheels_heard.any():
            # Without wheels the rover is taken to go forward.
            knots = (self.knot_of_fix[:-1] + self.knot_of_fix[1:]) // 2
            wheel_steps = np.abs(steps) * np.exp(1j * gyro[knots])
        # Each step votes with the shorter of its two lengths, so that neither slip nor a stray fix wins.
        votes = steps * wheel_steps.conj() / np.maximum(np.maximum(abs(steps), abs(wheel_steps)), 1e-9)
        middle_s = (self.fix_times_s[:-1] + self.fix_times_s[1:]) / 2
        # The gyro's drift is followed by weighing votes down over some 15 s.
        near = 1 / (1 + ((middle_s[:, None] - middle_s[None, :]) / 15.0) ** 2)
        turned = np.unwrap(np.angle(near @ votes))
        knots = (self.knot_of_fix[:-1] + self.knot_of_fix[1:]) / 2
        heading = gyro + np.interp(np.arange(len(gyro)), knots, turned)
        speed_by_fix = np.abs(steps) / np.diff(self.fix_times_s)
        speed = np.interp(np.arange(len(self.dt)), knots, speed_by_fix)
        return heading, np.where(self.wheels_heard, self.wheels, speed)

    def linearise(self, state: np.ndarray, robust: bool) -> ChainLeastSquares:
        chain = ChainLeastSquares(*state.shape)
        self._add_way(chain, state)
        self._add_rates(chain, state)
        self._add_constants(chain, state)
        self._add_fixes(chain, state, self.fix_weights(state) if robust else np.ones_like(self.antenna))
        return chain

    def _add_way(self, chain: ChainLeastSquares, state: np.ndarray) -> None:
        """The rover goes where it heads, and where its turning takes the point under the IMU."""
        noise = self.noise
        heading = (state[:-1, HEADING] + state[1:, HEADING]) / 2
        speed = (state[:-1, SPEED] + state[1:, SPEED]) / 2
        cos_h, sin_h, cos_p, sin_p = np.cos(heading), np.sin(heading), np.cos(self.pitch), np.sin(self.pitch)
        east, north, up = np.diff(state[:, :3], axis=0).T
        ahead, left = east * cos_h + north * sin_h, north * cos_h - east * sin_h
        # By heading, `ahead` grows with `left`, and `left` shrinks with `ahead`; half by either knot's.
        length = np.abs(np.where(self.wheels_heard, self.wheels, speed)) * self.dt
        creep = noise.creep_m**2 * self.dt
        turned = np.abs(self.turn)

        def add(axis: tuple, others: dict, by_heading: np.ndarray, residual: np.ndarray, variance: np.ndarray) -> None:
            slopes = dict(zip((EAST, NORTH, UP), axis, strict=True))
            half = {HEADING: by_heading / 2} | others
            chain.between(
                {state: -slope for state, slope in slopes.items()} | half,
                slopes | {state: slope for state, slope in half.items() if state != CENTRE},
                residual,
                np.sqrt(variance + creep),
            )

        add(
            (cos_h * cos_p, sin_h * cos_p, -sin_p),
            {SPEED: -self.dt / 2},
            left * cos_p,
            ahead * cos_p - up * sin_p - speed * self.dt,
            noise.slip_along**2 * length,
        )
        # That point goes sideways when the rover turns about an axis that lies ahead of it or behind it.
        add(
            (-sin_h, cos_h, np.zeros_like(cos_h)),
            {CENTRE: self.turn},
            -ahead,
            left + state[:-1, CENTRE] * self.turn,
            noise.slip_across**2 * length + noise.slip_turning**2 * turned,
        )
        add(
            (cos_h * sin_p, sin_h * sin_p, cos_p),
            {},
            left * sin_p,
            ahead * sin_p + up * cos_p,
            noise.slip_up**2 * length,
        )

    def _add_rates(self, chain: ChainLeastSquares, state: np.ndarray) -> None:
        """Gyro, wheels, and that the speed does not jump."""
        noise = self.noise
        gyro_sigma = np.sqrt(noise.gyro**2 * self.dt + noise.gyro_scale**2 * np.abs(self.turn))
        gyro_sigma = np.where(self.gyro_heard, gyro_sigma, noise.gyro_silent * np.sqrt(self.dt))
        turned = np.diff(state[:, HEADING]) - self.turn + state[:-1, BIAS] * self.dt
        chain.between({HEADING: -1.0, BIAS: self.dt}, {HEADING: 1.0}, turned, gyro_sigma)
        # Standing still shows the gyro's bias, long before the drift of the heading would.
        standing_sigma = np.where(self.standing, noise.standing * np.sqrt(self.dt), np.inf)
        chain.between({HEADING: -1.0}, {HEADING: 1.0}, np.diff(state[:, HEADING]), standing_sigma)
        jump = np.diff(state[:, SPEED])
        chain.between({SPEED: -1.0}, {SPEED: 1.0}, jump, noise.acceleration * np.sqrt(self.dt))
        speed = (state[:-1, SPEED] + state[1:, SPEED]) / 2
        chain.between(
            {SPEED: 0.5, WHEEL_SCALE: -self.wheels},
            {SPEED: 0.5},
            speed - state[:-1, WHEEL_SCALE] * self.wheels,
            np.where(self.wheels_heard, noise.wheel_m_s, np.inf),
        )

    def _add_constants(self, chain: ChainLeastSquares, state: np.ndarray) -> None:
        """What hardly changes, and what is known of it beforehand."""
        noise = self.noise
        creep = 1e-4 * np.sqrt(self.dt)
        length = np.abs(self.wheels) * self.dt
        drifts = {
            BIAS: noise.bias_drift * np.sqrt(self.dt),
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
        lever = _turn(self.lever, state[self.knot_of_fix, HEADING])
        by_heading = (-lever[:, 1], lever[:, 0], np.zeros(len(lever)))
        residual = state[self.knot_of_fix, :3] + lever - self.antenna
        for axis in (EAST, NORTH, UP):
            slopes = {axis: 1.0, HEADING: by_heading[axis]}
            chain.at(self.knot_of_fix, slopes, residual[:, axis], self.fix_sigma[:, axis] / np.sqrt(weights[:, axis]))

    def fix_weights(self, state: np.ndarray) -> np.ndarray:
        """Huber's weights of the fixes, 1 within the bound."""
        lever = _turn(self.lever, state[self.knot_of_fix, HEADING])
        off = np.abs(state[self.knot_of_fix, :3] + lever - self.antenna) / self.fix_sigma
        return self.noise.huber / np.maximum(off, self.noise.huber)


def _level(vector_body: np.ndarray, tilt: Tilt) -> Float64[np.ndarray, "K 3"]:
    """A body vector turned by pitch and roll, not by heading."""
    x, y, z = vector_body
    cos_r, sin_r = np.cos(tilt.roll_rad), np.sin(tilt.roll_rad)
    cos_p, sin_p = np.cos(tilt.pitch_rad), np.sin(tilt.pitch_rad)
    rolled_y, rolled_z = y * cos_r - z * sin_r, y * sin_r + z * cos_r
    return np.stack([x * cos_p + rolled_z * sin_p, rolled_y, rolled_z * cos_p - x * sin_p], axis=-1)


def _turn(vectors: np.ndarray, heading_rad: np.ndarray) -> Float64[np.ndarray, "N 3"]:
    """Level vectors turned by the heading."""
    x, y, z = vectors.T
    cos_h, sin_h = np.cos(heading_rad), np.sin(heading_rad)
    return np.stack([x * cos_h - y * sin_h, x * sin_h + y * cos_h, z], axis=-1)
