"""Wild poses: glitches of a localisation that put the camera where it cannot have been."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

MAX_SPEED_M_S, LEAST_JUMP_M = 40.0, 3.0
"""Steps below either are no jumps, whatever the rest of the path is like."""

MAX_RATE_DEG_S, LEAST_TURN_DEG = 720.0, 60.0

TIMES_TYPICAL = 20.0
"""A jump is so many times faster than the path is, and half so many times longer than its steps."""

IMPOSSIBLE_SPEED_M_S, IMPOSSIBLE_JUMP_M = 100.0, 50.0
"""Steps above both are jumps, even on a path of two poses."""

FEW_POSES, FEW_SHARE = 5, 0.1
"""A piece of the path beyond a jump is left out if it is shorter than this, as a number or a share of the rest ..."""

FAR_M = 100.0
"""... or if it lies farther away."""

_CHAINS_SEARCHED = 50


class WildPoses(NamedTuple):
    """Which poses (N,) are wild, how far they lie and are turned from the path, and the greatest jump that is kept."""

    wild: Bool[np.ndarray, "N"]
    away_m: float
    away_deg: float
    kept_jump_m: float


class _Path(NamedTuple):
    times_s: np.ndarray
    T: np.ndarray
    typical_m: float
    typical_m_s: float
    typical_deg_s: float

    def step(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance in m, angle in degrees, time in s between poses."""
        length_m = np.linalg.norm(self.T[j, :3, 3] - self.T[i, :3, 3], axis=-1)
        cosine = ((self.T[i, :3, :3] * self.T[j, :3, :3]).sum(axis=(-1, -2)) - 1) / 2
        angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        return length_m, angle_deg, np.maximum(self.times_s[j] - self.times_s[i], 1e-6)

    def jumps(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Whether no camera gets from pose i to pose j in that time."""
        length_m, angle_deg, time_s = self.step(i, j)
        speed_m_s = length_m / time_s
        fast = speed_m_s > max(MAX_SPEED_M_S, TIMES_TYPICAL * self.typical_m_s)
        far = length_m > max(LEAST_JUMP_M, TIMES_TYPICAL / 2 * self.typical_m)
        impossible = (speed_m_s > IMPOSSIBLE_SPEED_M_S) & (length_m > IMPOSSIBLE_JUMP_M)
        spins = angle_deg / time_s > max(MAX_RATE_DEG_S, TIMES_TYPICAL * self.typical_deg_s)
        return (fast & far) | impossible | (spins & (angle_deg > LEAST_TURN_DEG))


def find_wild_poses(timestamps_s: Float64[np.ndarray, "N"], T: Float64[np.ndarray, "N 4 4"]) -> WildPoses:
    """The poses that a path cannot hold, by steps against its typical step and against neighbours.

    The path is cut where it jumps, and pieces that fit each other are joined over what lies between. The longest chain
    of pieces is the path. Short or far pieces beside it are wild; long ones nearby (a localisation that corrected
    itself) are kept. Single poses that leave the path and return to it at once are wild at smaller distances.

    Args:
        timestamps_s: increasing.
        T: poses of a camera or a body.
    """
    count = len(T)
    wild = np.zeros(count, bool)
    if count < 2:
        return WildPoses(wild, 0.0, 0.0, 0.0)
    path = _typical(timestamps_s, T)
    wild |= _spikes(path)
    kept = np.flatnonzero(~wild)
    cuts = np.flatnonzero(path.jumps(kept[:-1], kept[1:])) + 1
    chains = _chains(path, np.split(kept, cuts))
    main = max(chains, key=len)
    kept_jump_m = 0.0
    for chain in chains:
        if chain is main:
            continue
        nearest = main[np.abs(main - chain[0]).argmin()]
        jump_m = float(np.linalg.norm(T[chain[0], :3, 3] - T[nearest, :3, 3]))
        if len(chain) < max(FEW_POSES, FEW_SHARE * len(main)) or jump_m > FAR_M:
            wild[chain] = True
        else:
            kept_jump_m = max(kept_jump_m, jump_m)
    return WildPoses(wild, *_away(path, wild), kept_jump_m)


def _typical(timestamps_s: np.ndarray, T: np.ndarray) -> _Path:
    """The path with the medians of its steps; each pose steps to the nearest of two neighbours on either side."""
    bare = _Path(timestamps_s, T, 0.0, 0.0, 0.0)
    count = len(T)
    steps = np.full((3, 4, count), np.inf)
    for row, offset in enumerate((-2, -1, 1, 2)):
        i = np.arange(max(0, -offset), min(count, count - offset))
        if len(i):
            ends = (i, i + offset) if offset > 0 else (i + offset, i)
            length_m, angle_deg, time_s = bare.step(*ends)
            steps[:, row, i] = length_m, length_m / time_s, angle_deg / time_s
    return bare._replace(
        **dict(
            zip(
                ("typical_m", "typical_m_s", "typical_deg_s"),
                np.median(steps.min(axis=1), axis=1).tolist(),
                strict=True,
            )
        )
    )


def _spikes(path: _Path) -> np.ndarray:
    """(N,), the poses that leave the path and return to it at once."""
    spike = np.zeros(len(path.T), bool)
    if len(path.T) < 3:
        return spike
    middle = np.arange(1, len(path.T) - 1)
    out_m, out_deg, out_s = path.step(middle - 1, middle)
    back_m, back_deg, back_s = path.step(middle, middle + 1)
    over_m, over_deg, _ = path.step(middle - 1, middle + 1)
    least_m, least_deg, longest_s = np.minimum(out_m, back_m), np.minimum(out_deg, back_deg), np.maximum(out_s, back_s)
    away = least_m > np.maximum(TIMES_TYPICAL / 2 * np.maximum(over_m, path.typical_m), LEAST_JUMP_M / 3)
    turned = least_deg > np.maximum(5 * over_deg, LEAST_TURN_DEG / 2)
    spike[middle] = away & (least_m / longest_s > MAX_SPEED_M_S / 4)
    spike[middle] |= turned & (least_deg / longest_s > MAX_RATE_DEG_S / 4)
    return spike


def _chains(path: _Path, pieces: list[np.ndarray]) -> list[np.ndarray]:
    """Pieces of the path joined to the latest earlier piece from which no jump leads to them."""
    chains: list[list[np.ndarray]] = []
    for piece in pieces:
        latest = sorted(chains[-_CHAINS_SEARCHED:], key=lambda chain: -chain[-1][-1])
        fitting = next((chain for chain in latest if not path.jumps(chain[-1][-1:], piece[:1])[0]), None)
        if fitting is None:
            chains.append([piece])
        else:
            fitting.append(piece)
    return [np.concatenate(chain) for chain in chains]


def _away(path: _Path, wild: np.ndarray) -> tuple[float, float]:
    """How far the wildest poses lie and are turned from those beside them, in m and degrees."""
    if not wild.any():
        return 0.0, 0.0
    kept = np.flatnonzero(~wild)
    rows = np.flatnonzero(wild)
    after = np.searchsorted(kept, rows).clip(0, len(kept) - 1)
    length_m, angle_deg, _ = path.step(kept[after], rows)
    return float(length_m.max()), float(angle_deg.max())
