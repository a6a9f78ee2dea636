"""Robust least squares over the poses, the mounting and the calibration, with the covariance of the solution.

The posterior of a rig combines its priors (how wrong the given poses, the mounting, ... may be) with the residual
terms (matches, heights). Its mode is found by Gauss-Newton steps on the linearised residuals, with damping as of
Levenberg and Marquardt where a step does not reduce the cost; the inverse of the normal matrix is its covariance.
Unobservable parameters keep their prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.linalg import cho_factor, cho_solve

from jaxmap.errors import JaxmapError
from jaxmap.refinement.residuals import Linearised
from jaxmap.refinement.rig import PER_FRAME, SHARED, Rig, displacement, moved

ROBUST = 2.5
"""Scale of the robust loss (Cauchy's), in sigma: larger residuals count less and less."""

MAX_STEPS = 12
CONVERGED = 0.02
"""The iteration ends with a step below this share of the posterior's sigma in every parameter."""

_LEAST_POSITION_M, _LEAST_ANGLE_RAD = 1e-3, np.radians(0.01)
_CHI2_MEDIAN = {1: 0.455, 3: 2.366}


class ResidualTerm(NamedTuple):
    """Residuals of one kind, and how they are weighted.

    Attributes:
        linearise: evaluates them at a rig.
        frames: (M, F), the frames of each.
        sigma: (R,), their standard deviations, apart from what the error of the disparity causes.
        disparity_sigma_px: standard deviation of the points' disparity.
        groups: (M,), from 0; errors within a group are correlated.
        group_weight: a group counts as so many independent residuals, at most.
        estimate_noise: the noise is estimated from the residuals; else it is as assumed.
    """

    linearise: Callable[[Rig], Linearised]
    frames: np.ndarray
    sigma: np.ndarray
    disparity_sigma_px: float
    groups: np.ndarray
    group_weight: float
    estimate_noise: bool = True


class Prior(NamedTuple):
    """How wrong the given rig may be, as standard deviations; 0 holds a parameter fixed.

    `position_m` and `angle_rad` are of each frame and axis; None: estimated from the data.
    """

    position_m: float | None = None
    angle_rad: float | None = None
    mounting_m: float = 0.0
    mounting_rad: float = 0.0
    baseline_scale: float = 0.0
    offset_px: float = 0.0


FIRST_POSITION_M, FIRST_ANGLE_RAD = 0.2, np.radians(1.0)
"""Initial values where the errors of the poses are estimated from the data."""


class Solution(NamedTuple):
    """The mode of the posterior.

    Attributes:
        rig: the refined rig.
        covariance: (n, n) of `displacement`, zero where a parameter is held fixed.
        prior_sigma: (n,), as given or estimated.
        residuals_px: the median length of the match residuals (the first term), before the first step and after each.
        noise_scales: for each term, the variance of its residuals over the assumed one.
    """

    rig: Rig
    covariance: np.ndarray
    prior_sigma: np.ndarray
    residuals_px: list[float]
    noise_scales: list[float]


def solve(rig: Rig, given: Rig, terms: Sequence[ResidualTerm], prior: Prior, steps: int = MAX_STEPS) -> Solution:
    """The most likely rig.

    Args:
        rig: the initial rig.
        given: the mean of the prior.
        terms: the residuals, those of matches first.
        prior: how wrong the given rig may be.
        steps: at most so many.

    Raises:
        JaxmapError: the residuals are not finite, or priors are too wide to solve for.
    """
    sigma = _prior_sigma(prior, len(given.T_world_nominal))
    free = sigma > 0
    damping, scales = 0.0, [1.0] * len(terms)
    parts = [term.linearise(rig) for term in terms]
    residuals_px = [_median_px(parts[0])]
    for _ in range(steps):
        scales = [_noise_scale(term, part) for term, part in zip(terms, parts, strict=True)]
        normal, gradient, data_cost = _normal_equations(terms, parts, scales, len(sigma))
        deviation = displacement(rig, given)
        sigma = _estimated_sigma(prior, sigma, free, normal, gradient, deviation)
        before = data_cost + _prior_cost(deviation, sigma, free)
        step, covariance = _step(normal, gradient, deviation, sigma, free, damping)
        candidate = moved(rig, step)
        candidate_parts = [term.linearise(candidate) for term in terms]
        after = _cost(terms, candidate_parts, scales) + _prior_cost(displacement(candidate, given), sigma, free)
        if not np.isfinite(after) or after > before * (1 + 1e-9) + 1e-9:
            damping = max(10 * damping, 1e-3)
            if damping > 1e6:
                break
            continue
        rig, parts, damping = candidate, candidate_parts, damping / 10
        residuals_px.append(_median_px(parts[0]))
        if (np.abs(step[free]) < CONVERGED * np.sqrt(np.diag(covariance)[free])).all():
            break
    normal, gradient, _ = _normal_equations(terms, parts, scales, len(sigma))
    _, covariance = _step(normal, gradient, displacement(rig, given), sigma, free, 0.0)
    return Solution(rig, covariance, sigma, residuals_px, scales)


def _median_px(part: Linearised) -> float:
    return float(np.median(np.hypot(part.residual[:, 0], part.residual[:, 1]))) if len(part.residual) else 0.0


def _prior_sigma(prior: Prior, frames: int) -> np.ndarray:
    position = FIRST_POSITION_M if prior.position_m is None else prior.position_m
    angle = FIRST_ANGLE_RAD if prior.angle_rad is None else prior.angle_rad
    own = np.tile(np.repeat([position, angle], 3), frames)
    mounting = np.repeat([prior.mounting_m, prior.mounting_rad], 3)
    return np.concatenate([own, mounting, [prior.baseline_scale, prior.offset_px]])


def _noise_scale(term: ResidualTerm, part: Linearised) -> float:
    """The variance of the residuals over the assumed one, from their median."""
    if not len(part.residual) or not term.estimate_noise:
        return 1.0
    squares = _squares(term, part)
    return float(max(np.median(squares) / _CHI2_MEDIAN[part.residual.shape[1]], 0.05))


def _whiten(term: ResidualTerm, part: Linearised, *columns: np.ndarray) -> list[np.ndarray]:
    """Columns (M, R, k) whitened by the residuals' covariance."""
    by = part.by_disparity * term.disparity_sigma_px
    covariance = by[:, :, None] * by[:, None, :] + np.diag(term.sigma**2)
    factor = np.linalg.cholesky(covariance)
    return [np.linalg.solve(factor, column) for column in columns]


def _squares(term: ResidualTerm, part: Linearised) -> np.ndarray:
    """Squared Mahalanobis length of each residual."""
    (white,) = _whiten(term, part, part.residual[..., None])
    return (white[..., 0] ** 2).sum(axis=1)


def _weight(term: ResidualTerm) -> np.ndarray:
    """Weight of each residual, such that no group counts for more than its `group_weight`."""
    counts = np.bincount(term.groups) if len(term.groups) else np.zeros(0)
    return np.minimum(1.0, term.group_weight / np.maximum(counts, 1))[term.groups]


def _cost(terms: Sequence[ResidualTerm], parts: Sequence[Linearised], scales: Sequence[float]) -> float:
    total = 0.0
    for term, part, scale in zip(terms, parts, scales, strict=True):
        limit = ROBUST**2 * part.residual.shape[1]
        total += float((_weight(term) * limit * np.log1p(_squares(term, part) / scale / limit)).sum())
    return total / 2


def _prior_cost(deviation: np.ndarray, sigma: np.ndarray, free: np.ndarray) -> float:
    # With its normalisation, as the sigmas may be estimated.
    return float((0.5 * (deviation[free] / sigma[free]) ** 2 + np.log(sigma[free])).sum())


def _normal_equations(
    terms: Sequence[ResidualTerm], parts: Sequence[Linearised], scales: Sequence[float], size: int
) -> tuple[Float64[np.ndarray, "n n"], Float64[np.ndarray, "n"], float]:
    """The normal matrix and the gradient of the data, and their cost."""
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    for term, part, scale in zip(terms, parts, scales, strict=True):
        if not len(part.residual):
            continue
        count, rows = part.residual.shape
        local = np.concatenate([part.by_frames.reshape(count, rows, -1), part.by_shared], axis=-1)
        white, slope = _whiten(term, part, part.residual[..., None], local)
        limit = ROBUST**2 * rows
        weight = _weight(term) / scale / (1 + (white[..., 0] ** 2).sum(axis=1) / scale / limit)
        half = np.sqrt(weight)[:, None, None]
        white, slope = white * half, slope * half
        order = np.lexsort(term.frames.T)
        borders = np.flatnonzero(np.any(np.diff(term.frames[order], axis=0) != 0, axis=1)) + 1
        for same_frames in np.split(order, borders):
            indices = (PER_FRAME * term.frames[same_frames[0], :, None] + np.arange(PER_FRAME)).ravel()
            indices = np.concatenate([indices, np.arange(size - SHARED, size)])
            stacked = slope[same_frames].reshape(-1, slope.shape[-1])
            normal[np.ix_(indices, indices)] += stacked.T @ stacked
            gradient[indices] += stacked.T @ white[same_frames].reshape(-1)
    if not (np.isfinite(normal).all() and np.isfinite(gradient).all()):
        raise JaxmapError(
            "the refinement diverges: residuals are not finite", fix="check the poses and the calibration"
        )
    return normal, gradient, _cost(terms, parts, scales)


def _step(
    normal: np.ndarray, gradient: np.ndarray, deviation: np.ndarray, sigma: np.ndarray, free: np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """The step towards the posterior's mode, and the covariance (undamped only where the damping is 0)."""
    weight = 1 / sigma[free] ** 2
    matrix = normal[np.ix_(free, free)] + np.diag(weight)
    matrix[np.diag_indices_from(matrix)] *= 1 + damping
    # In units of the priors the matrix is well-conditioned: its least eigenvalue is 1.
    scale = sigma[free]
    try:
        factor = cho_factor(matrix * scale[:, None] * scale)
    except np.linalg.LinAlgError as error:
        # Parameters that only a very wide prior determines are lost in rounding.
        raise JaxmapError(
            "the refinement cannot be solved: some of its priors are too wide",
            where="the standard deviations",
            fix="give smaller ones: --sigma-position-m, --sigma-angle-deg, --sigma-mounting-m ...",
        ) from error
    step, covariance = np.zeros(len(deviation)), np.zeros((len(deviation), len(deviation)))
    step[free] = -scale * cho_solve(factor, scale * (gradient[free] + weight * deviation[free]))
    covariance[np.ix_(free, free)] = scale[:, None] * cho_solve(factor, np.eye(len(scale))) * scale
    return step, covariance


def _estimated_sigma(
    prior: Prior,
    sigma: np.ndarray,
    free: Bool[np.ndarray, "n"],
    normal: np.ndarray,
    gradient: np.ndarray,
    deviation: np.ndarray,
) -> np.ndarray:
    """The standard deviations of the given poses, where they are estimated: by expectation maximisation.

    The variance of a group of parameters is the mean of their squares under the posterior: of its mode and around it.
    """
    frames = (len(sigma) - SHARED) // PER_FRAME
    kinds = [
        (prior.position_m is None, np.arange(3), _LEAST_POSITION_M),
        (prior.angle_rad is None, np.arange(3, 6), _LEAST_ANGLE_RAD),
    ]
    if not any(estimated for estimated, _, _ in kinds):
        return sigma
    sigma = sigma.copy()
    for _ in range(15):
        step, covariance = _step(normal, gradient, deviation, sigma, free, 0.0)
        squares = (deviation + step) ** 2 + np.diag(covariance)
        for estimated, columns, least in kinds:
            indices = (PER_FRAME * np.arange(frames)[:, None] + columns).ravel()
            if estimated:
                sigma[indices] = max(np.sqrt(squares[indices].mean()), least)
    return sigma
