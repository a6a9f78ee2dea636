"""The principal plane of a point cloud, by MLESAC: all hypotheses at once.

Torr and Zisserman, "MLESAC: A new robust estimator with application to estimating image geometry",
Computer Vision and Image Understanding 78 (2000), 138-156.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxmap.geometry.options import PlaneFitOptions
from jaxmap.types import Plane

_REFIT_ROUNDS = 5
_POLISH_ROUNDS = 2
_POLISH_POINTS = 1 << 16
"""The few points that judge hypotheses bound how near their plane can come; the last rounds take so many."""
_BLOCK = 16
_NORMALISER = 2.5066282746  # sqrt(2 pi)


def fit_plane_mlesac(
    key: PRNGKeyArray,
    points: Float[Array, "N 3"],
    valid: Bool[Array, "N"],
    *,
    up_hint: Float[Array, "3"],
    sigma_m: Float[Array, ""] | float | None = None,
    options: PlaneFitOptions | None = None,
    **changes: Any,
) -> Plane:
    """Fits the plane that most points lie on.

    A residual r is drawn from `gamma N(0, sigma) + (1 - gamma) / nu` (the mixture of the paper
    above), gamma by expectation maximisation for each hypothesis; the hypothesis with the least
    negative log-likelihood wins and is refitted by least squares weighted with the inliers'
    posteriors, at last on points spread evenly over the whole list. `cost="msac"` scores hypotheses
    by `min(r^2, (1.96 sigma)^2)` instead, which is what PCL and MATLAB's `pcfitplane` run.

    Args:
        key: the randomness of the hypotheses; the same key gives the same plane.
        points: any frame, metres; the plane comes out in the same frame.
        valid: which points are real.
        up_hint: unit vector that the normal shall agree with.
        sigma_m: standard deviation of points on the plane, along its normal, where it is not that of the options: a
            traced number, to be differentiated.
        options: of the fit; by default those of `PlaneFitOptions`.
        **changes: fields of `PlaneFitOptions` that differ from it.

    Returns:
        The plane; `found` is false where no hypothesis was acceptable, and the plane then is the
        one through the origin across `up_hint`.
    """
    options = replace(options or PlaneFitOptions(), **changes)
    sigma = options.sigma_m if sigma_m is None else sigma_m
    with jax.named_scope("mlesac"):
        start = search_plane(key, points, valid, up_hint, sigma, options)
        return refit_plane(start, up_hint, sigma, options)


class PlaneStart(NamedTuple):
    """The best hypothesis, the points that judged it, and more for its refit (real where `spread_valid`).

    All positions are relative to `centre_m`.
    """

    sample: Float[Array, "S 3"]
    spread: Float[Array, "L 3"]
    spread_valid: Bool[Array, "L"]
    centre_m: Float[Array, "3"]
    normal: Float[Array, "3"]
    offset_m: Float[Array, ""]
    found: Bool[Array, ""]


def search_plane(
    key: PRNGKeyArray,
    points: Float[Array, "N 3"],
    valid: Bool[Array, "N"],
    up_hint: Float[Array, "3"],
    sigma_m: Float[Array, ""] | float,
    options: PlaneFitOptions,
) -> PlaneStart:
    """The first half of `fit_plane_mlesac`: the hypothesis that wins, not yet refitted."""
    sample_points, hypotheses, outlier_range_m = options.sample_points, options.hypotheses, options.outlier_range_m
    draw_key, triple_key = jax.random.split(key)
    sample, enough = _draw_valid(draw_key, points, valid, sample_points)
    # Centred: the moments of the refit lose no digits, however far the frame's origin is.
    centre = sample.mean(axis=0)
    sample = sample - centre
    triples = jax.random.randint(triple_key, (hypotheses, 3), 0, sample_points)
    normals, offsets, proper = _planes_through(sample[triples], up_hint)
    acceptable = proper & (normals @ up_hint >= jnp.cos(options.max_tilt_rad))

    def score(residuals: Array) -> Array:
        if options.cost == "msac":
            return jnp.minimum(residuals**2, (1.96 * sigma_m) ** 2).sum()
        # Computed once: the rounds of EM only weigh it anew.
        density = jax.lax.optimization_barrier(_inlier_density(residuals, sigma_m))
        gamma = _mixing(density, outlier_range_m, options.em_rounds)
        return -jnp.log(gamma * density + (1.0 - gamma) / outlier_range_m).sum()

    residuals_m = normals @ sample.T + offsets[:, None]
    costs = jnp.where(acceptable, jax.vmap(score)(residuals_m), jnp.inf)
    best = jnp.argmin(costs)
    # Which hypothesis wins is a choice, and those through one point twice have no gradient: the refit has.
    normal, offset = jax.lax.stop_gradient((normals[best], offsets[best]))
    every = max(1, -(-points.shape[0] // _POLISH_POINTS))
    spread_valid = valid[::every]
    spread = jnp.where(spread_valid[:, None], points[::every] - centre, 0.0)
    return PlaneStart(sample, spread, spread_valid, centre, normal, offset, acceptable[best] & enough)


def refit_plane(
    start: PlaneStart, up_hint: Float[Array, "3"], sigma_m: Float[Array, ""] | float, options: PlaneFitOptions
) -> Plane:
    """The second half of `fit_plane_mlesac`, differentiable in `sigma_m`: least squares on inlier posteriors."""
    mixture = (sigma_m, options.outlier_range_m, options.em_rounds)
    # Points all alike, as where nothing is valid, have a spread without directions: its eigenvectors have no gradient.
    sample = jnp.where(start.found, start.sample, _spread_points(start.sample.shape[0]))
    more = jnp.where(start.found, start.spread, _spread_points(start.spread.shape[0]))
    first = jnp.where(start.found, start.normal, up_hint)
    normal, offset, inliers = _refit(sample, first, jnp.where(start.found, start.offset_m, 0.0), up_hint, mixture)
    for _ in range(_POLISH_ROUNDS):
        density = _inlier_density(more @ normal + offset, sigma_m)
        weights = _posterior(density, inliers, options.outlier_range_m) * (start.spread_valid | ~start.found)
        normal, offset = _least_squares(more, weights, up_hint)
    # Points of a wall may turn the refitted plane over; the hypothesis is acceptable as it is.
    upright = normal @ up_hint >= jnp.cos(options.max_tilt_rad)
    normal = jnp.where(upright, normal, start.normal)
    offset = jnp.where(upright, offset, start.offset_m)
    return Plane(
        normal=jnp.where(start.found, normal, up_hint),
        offset_m=jnp.where(start.found, offset - normal @ start.centre_m, 0.0),
        inlier_fraction=jnp.where(start.found, inliers, 0.0),
        found=start.found,
    )


def _spread_points(count: int) -> Float[Array, "S 3"]:
    """Millimetres to either side of the origin along the axes, along each another distance."""
    place = jnp.arange(count)
    distance_m = jnp.array([3e-3, 2e-3, 1e-3])[place % 3] * jnp.where(place // 3 % 2, 1.0, -1.0)
    return jnp.where(place[:, None] % 3 == jnp.arange(3), distance_m[:, None], 0.0)


def plane_distance(plane: Plane, points: Float[Array, "*s 3"]) -> Float[Array, "*s"]:
    """Signed distance of points from a plane, in metres, positive on the side of the normal."""
    n = plane.normal
    return n[..., 0] * points[..., 0] + n[..., 1] * points[..., 1] + n[..., 2] * points[..., 2] + plane.offset_m


def _draw_valid(key: PRNGKeyArray, points: Array, valid: Array, count: int) -> tuple[Array, Array]:
    """Draws points evenly, with replacement, from the valid ones; also whether there are three.

    The n-th valid point is found through counts of blocks: a running sum over all points would cost
    more than the rest of the fit.
    """
    blocks = jnp.pad(valid, (0, -valid.shape[0] % _BLOCK)).reshape(-1, _BLOCK)
    upto_block = jnp.cumsum(blocks.sum(axis=1, dtype=jnp.int32))
    total = upto_block[-1]
    wanted = jax.random.randint(key, (count,), 0, jnp.maximum(total, 1))
    block = jnp.minimum(jnp.searchsorted(upto_block, wanted, side="right"), blocks.shape[0] - 1)
    members = blocks[block]
    within = wanted - (upto_block[block] - members.sum(axis=1, dtype=jnp.int32))
    place = jnp.argmax(jnp.cumsum(members, axis=1, dtype=jnp.int32) > within[:, None], axis=1)
    drawn = points[jnp.minimum(block * _BLOCK + place, points.shape[0] - 1)]
    return jnp.where(total >= 3, drawn, 0.0), total >= 3


def _planes_through(triples: Array, up_hint: Array) -> tuple[Array, Array, Array]:
    """Planes through three points each, normals turned to the side of the up hint."""
    a, b, c = triples[:, 0], triples[:, 1], triples[:, 2]
    normals = jnp.cross(b - a, c - a)
    length = jnp.linalg.norm(normals, axis=-1, keepdims=True)
    # Three points nearly on a line say nothing of the plane through them.
    spread = jnp.linalg.norm(b - a, axis=-1) * jnp.linalg.norm(c - a, axis=-1)
    proper = length[:, 0] > jnp.maximum(1e-9, 1e-2 * spread)
    normals = normals / jnp.where(length > 1e-9, length, 1.0)
    normals = normals * jnp.where(normals @ up_hint < 0, -1.0, 1.0)[:, None]
    return normals, -(normals * a).sum(axis=-1), proper


def _inlier_density(residuals: Array, sigma_m: Array | float) -> Array:
    """The normal density of residuals."""
    return jnp.exp(-0.5 * (residuals / sigma_m) ** 2) / (_NORMALISER * sigma_m)


def _mixing(density: Array, nu_m: Array | float, rounds: int) -> Array:
    """The share of inliers, by expectation maximisation from one half."""
    gamma = jnp.asarray(0.5)
    for _ in range(rounds):
        # Kept off 0 and 1, where a single residual would have likelihood zero.
        gamma = jnp.clip(_posterior(density, gamma, nu_m).mean(), 1e-3, 1.0 - 1e-3)
    return gamma


def _posterior(density: Array, gamma: Array, nu_m: Array | float) -> Array:
    """The probability that a point is an inlier."""
    return gamma * density / (gamma * density + (1.0 - gamma) / nu_m)


def _refit(
    sample: Array,
    normal: Array,
    offset: Array,
    up_hint: Array,
    mixture: tuple[Array | float, Array | float, int],
) -> tuple[Array, Array, Array]:
    """Least squares on inlier posteriors, a few rounds; also the share of inliers."""
    sigma_m, nu_m, em_rounds = mixture
    gamma = jnp.asarray(0.5)
    for _ in range(_REFIT_ROUNDS):
        density = _inlier_density(sample @ normal + offset, sigma_m)
        gamma = _mixing(density, nu_m, em_rounds)
        normal, offset = _least_squares(sample, _posterior(density, gamma, nu_m), up_hint)
    return normal, offset, gamma


def _least_squares(points: Array, weights: Array, up_hint: Array) -> tuple[Array, Array]:
    """The plane with the least weighted sum of squared distances, its normal turned to the side of the up hint."""
    total = jnp.maximum(weights.sum(), 1e-9)
    mean = weights @ points / total
    spread = points - mean
    _, vectors = jnp.linalg.eigh((weights[:, None] * spread).T @ spread / total)
    normal = vectors[:, 0] * jnp.where(vectors[:, 0] @ up_hint < 0, -1.0, 1.0)
    return normal, -normal @ mean
