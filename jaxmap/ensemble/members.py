"""The members of an ensemble in the compiled step: one frame into each, under its own errors.

A member is fused as the map is, from the same labels, which are computed once for all. It carries two channels only:
occupancy and the one class that is asked about, as no other decides whether a column is of that class.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxmap.ensemble.draws import EnsembleParams, MemberParams, disparity_noise, displaced
from jaxmap.fusion.integrate import window_evidence
from jaxmap.fusion.params import FusionRule
from jaxmap.fusion.view import Reach, view_of
from jaxmap.geometry.camera import disparity_to_points, transform_points
from jaxmap.geometry.grid import Window
from jaxmap.types import Frame, GridSpec, PointLabels, StereoCamera, VoxelMap

_LEAST_PROBABILITY = 1e-30
_LEAST_REST = 1e-5


class Site(NamedTuple):
    """What all members share: the camera, the grid, and how they are fused."""

    camera: StereoCamera
    grid: GridSpec
    rule: FusionRule
    reach: Reach
    class_count: int
    target: int
    """Index of the class that members carry."""


def fuse_members(
    voxel_map: VoxelMap, frame: Frame, labels: PointLabels, site: Site, params: EnsembleParams, key: PRNGKeyArray
) -> Float[Array, "M 2 X Y Z"]:
    """Adds one frame to every member of a map.

    Args:
        voxel_map: `members` are those so far.
        frame: with `pose_errors`, the errors of its pose.
        labels: of its pixels, as the map takes them.
        site: what all members share.
        params: the numbers of the members.
        key: the frame's own; member `m` takes `fold_in(key, m)`.
    """
    assert voxel_map.members is not None and frame.pose_errors is not None
    count = voxel_map.members.shape[0]
    at_once = next(size for size in range(min(params.at_once, count), 0, -1) if count % size == 0)
    drawn = (jnp.arange(count), params.sensor, frame.pose_errors)

    def evidence_of(number: Array, sensor: MemberParams, error: Array) -> tuple[Array, Array]:
        member = _Member(sensor, error, jax.random.fold_in(key, number))
        evidence, window = _member_evidence(frame, labels, site, params, member)
        return evidence, window.start

    def fuse_some(index: Int[Array, ""], members: Array) -> Array:
        some: Any = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, index * at_once, at_once), drawn)
        if at_once == 1:
            # By itself: a scatter with an axis of one member is slower than one without.
            evidence, start = (out[None] for out in evidence_of(*jax.tree.map(lambda leaf: leaf[0], some)))
        else:
            evidence, start = jax.vmap(evidence_of)(*some)
        # One by one, in place: windows that start at different voxels would be gathered and scattered.
        for place in range(at_once):
            corner = (index * at_once + place, jnp.zeros((), jnp.int32), *start[place])
            added = evidence[place : place + 1]
            here = jax.lax.dynamic_slice(members, corner, added.shape)
            members = jax.lax.dynamic_update_slice(members, here + added, corner)
        return members

    with jax.named_scope("fuse_members"):
        return jax.lax.fori_loop(0, count // at_once, fuse_some, voxel_map.members)


class _Member(NamedTuple):
    sensor: MemberParams
    pose_error: Float[Array, "6"]
    key: PRNGKeyArray


def _member_evidence(
    frame: Frame, labels: PointLabels, site: Site, params: EnsembleParams, member: _Member
) -> tuple[Float[Array, "2 X Y Z"], Window]:
    """What a frame adds to one member, and to which part of the grid."""
    height_px, width_px = frame.disparity_px.shape
    noise = disparity_noise(member.key, (height_px, width_px), params.block_px)
    T_world_camera = displaced(frame.T_world_camera, member.pose_error)
    points_camera, valid = disparity_to_points(site.camera, frame.disparity_px + params.disparity_sigma_px * noise)
    depth_m = points_camera[..., 2]
    low_m, high_m = site.reach.depth_range_m
    in_range = valid & (depth_m >= low_m) & (depth_m <= high_m)
    points_world = transform_points(T_world_camera, points_camera).reshape(-1, 3)
    points_world, depth_m, in_range = jax.lax.optimization_barrier((points_world, depth_m, in_range))
    view = view_of(site.grid, site.camera, T_world_camera, depth_m, valid, member.sensor.fusion, site.rule, site.reach)
    own = doubted(labels, member.sensor)._replace(keep=labels.keep & in_range.reshape(-1))
    evidence, _ = window_evidence(
        site.grid,
        points_world,
        own,
        view.weights,
        site.class_count,
        member.sensor.fusion,
        site.rule,
        view.window,
        view.free,
    )
    return jnp.stack([evidence[0], evidence[1 + site.target]]), view.window


def doubted(labels: PointLabels, member: MemberParams) -> PointLabels:
    """Soft labels with their logits divided by a member's temperature and biased; hard ones stay as they are.

    What the probabilities lack to 1, that of no class, is one more class in this, without a bias.
    """
    if labels.probabilities is None:
        return labels
    known = labels.probabilities
    # Class by class: XLA does not vectorise over a short last axis.
    shares = [known[:, c] for c in range(known.shape[1])]
    rest = 1.0 - sum(shares[1:], shares[0])
    # What rounding leaves over is nothing: a high temperature would make something of it.
    shares.append(jnp.where(rest > _LEAST_REST, rest, 0.0))
    logits = [jnp.log(jnp.maximum(share, _LEAST_PROBABILITY)) for share in shares]
    top = functools.reduce(jnp.maximum, logits)
    logits = [(logit - top) / member.temperature for logit in logits]
    logits = [*(logit + member.bias[c] for c, logit in enumerate(logits[:-1])), logits[-1]]
    top = functools.reduce(jnp.maximum, logits)
    powers = [jnp.exp(logit - top) for logit in logits]
    total = sum(powers[1:], powers[0])
    changed = jnp.stack([power / total for power in powers[:-1]], axis=-1)
    # A member that doubts nothing has the labels of the map, to the last bit.
    same = (member.temperature == 1.0) & (member.bias == 0.0).all()
    return labels._replace(probabilities=jnp.where(same, known, changed))
