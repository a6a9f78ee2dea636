"""Position and heading: GPS pins them down, gyro and wheels carry them between the fixes.

One Gauss-Newton problem over the whole recording. A knot holds the position of the point of the
ground under the IMU (along the body's up axis), heading, forward speed and three numbers that hardly
change: the gyro's bias, what the wheels' speed has to be multiplied by (radius and slip), and how far
ahead of the IMU the axis lies about which the rover turns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from jaxmap.localisation.attitude import Tilt
from jaxmap.localisation.sensors import GpsFixes, RoverGeometry
from jaxmap.localisation.track_terms import (
    CENTRE,
    EAST,
    HEADING,
    NORTH,
    SPEED,
    STATES,
    UP,
    WHEEL_SCALE,
    Motion,
    TrackNoise,
    TrackTerms,
    levelled,
    turned,
)

MAX_ITERATIONS = 20

MAX_VOTES = 2000
"""Steps from fix to fix that the first guess of the heading rests on, at most."""

DRIFT_FOLLOWED_S = 15.0
"""Over this time the first guess of the heading takes the gyro to be without drift."""


class Track(NamedTuple):
    """The estimate.

    Attributes:
        position_m: (K, 3), of the IMU in the world.
        heading_rad: (K,), from east towards north, continuous.
        heading_sigma_rad: the median over the way.
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
    knot_of_fix: Int[np.ndarray, "N"],
    motion: Motion,
    tilt: Tilt,
    geometry: RoverGeometry,
    noise: TrackNoise | None = None,
) -> Track:
    """Position and heading at the knots.

    Args:
        fixes: at least two.
        knot_of_fix: (N,), the knot at the time of each fix, increasing.
        motion: between the knots.
        tilt: at the knots.
        geometry: where the antenna is.
        noise: how far each source is trusted; by default `TrackNoise()`.

    Raises:
        numpy.linalg.LinAlgError: the readings determine no track.
    """
    terms = TrackTerms(fixes, knot_of_fix, motion, tilt, geometry, noise or TrackNoise())
    state = initial_state(fixes, terms)
    for iteration in range(MAX_ITERATIONS):
        # The first steps are not yet near enough to tell which fixes are stray.
        step = terms.linearise(state, robust=iteration > 1).step()
        state += step
        if iteration > 2 and np.abs(step[:, : HEADING + 1]).max() < 1e-5:
            break
    some = np.linspace(0, len(state) - 1, 9).astype(int)
    heading_sigma_rad = np.median(terms.linearise(state, robust=True).sigma(some, HEADING))
    height = turned(levelled(np.array([0.0, 0.0, geometry.height_m]), tilt), state[:, HEADING])
    return Track(
        position_m=state[:, :3] + height + terms.origin_m,
        heading_rad=state[:, HEADING],
        heading_sigma_rad=float(heading_sigma_rad),
        wheel_scale=float(state[:, WHEEL_SCALE].mean()),
        outliers=int((terms.fix_weights(state) < 1).any(axis=1).sum()),
    )


def initial_state(fixes: GpsFixes, terms: TrackTerms) -> Float64[np.ndarray, "K 8"]:
    """A first guess: the fixes joined by lines, and a heading that lays the way of the wheels along them."""
    heading = _initial_heading(fixes, terms)
    knots, fix_knots = np.arange(len(heading)), terms.knot_of_fix
    state = np.zeros((len(heading), STATES))
    state[:, HEADING], state[:, WHEEL_SCALE], state[:, CENTRE] = heading, 1, terms.geometry.turning_centre_m
    ground = terms.antenna_m - turned(terms.lever_m, heading[fix_knots])
    for axis in (EAST, NORTH, UP):
        state[:, axis] = np.interp(knots, fix_knots, ground[:, axis])
    pace = np.linalg.norm(np.diff(ground[:, :2], axis=0), axis=1) / np.diff(fixes.timestamps_s)
    pace = np.interp(knots[:-1], (fix_knots[:-1] + fix_knots[1:]) / 2, pace)
    state[:-1, SPEED] = np.where(terms.wheels_heard, terms.wheel_speed_m_s, pace)
    state[-1, SPEED] = state[-2, SPEED]
    return state


def _initial_heading(fixes: GpsFixes, terms: TrackTerms) -> Float64[np.ndarray, "K"]:
    """The gyro's heading, turned so that the wheels' way from fix to fix points where the antenna went.

    Each step from one fix to the next votes for an angle, and votes near in time are added up as
    complex numbers, so that the gyro's drift is followed and no angle has to be unwrapped first.
    """
    gyro = np.concatenate([[0.0], np.cumsum(terms.turn_rad)])
    middle = (gyro[:-1] + gyro[1:]) / 2
    some = np.unique(np.linspace(0, len(terms.knot_of_fix) - 1, MAX_VOTES + 1).astype(int))
    knots, times_s = terms.knot_of_fix[some], fixes.timestamps_s[some]
    steps = np.diff(terms.antenna_m[some, 0] + 1j * terms.antenna_m[some, 1])
    if terms.wheels_heard.any():
        way = np.concatenate([[0.0], np.cumsum(terms.wheel_speed_m_s * terms.dt_s * np.exp(1j * middle))])
        wheel_steps = np.diff(way[knots])
    else:
        # Without wheels the rover is taken to go forward.
        wheel_steps = np.abs(steps) * np.exp(1j * gyro[(knots[:-1] + knots[1:]) // 2])
    # The shorter of the two lengths counts, so that neither slip nor a stray fix outvotes the others.
    votes = steps * wheel_steps.conj() / np.maximum(np.maximum(np.abs(steps), np.abs(wheel_steps)), 1e-9)
    middle_s = (times_s[:-1] + times_s[1:]) / 2
    nearness = 1 / (1 + ((middle_s[:, None] - middle_s[None, :]) / DRIFT_FOLLOWED_S) ** 2)
    offset = np.unwrap(np.angle(nearness @ votes))
    return gyro + np.interp(np.arange(len(gyro)), (knots[:-1] + knots[1:]) / 2, offset)
