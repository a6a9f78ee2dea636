"""The members of an ensemble in the compiled step: one frame into each, under its own errors.

A member is fused as the map is, from the same labels, which are computed once for all. It carries two channels only:
occupancy and the one class that is asked about, as no other decides whether a column is of that class.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxmap.ensemble.draws import EnsembleParams, MemberParams, disparity_noise, displaced
from jaxmap.fusion.carve import carve
from jaxmap.fusion.integrate import count_points
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.sensor_model import frame_evidence, point_weights
from jaxmap.geometry.cloud import project
from jaxmap.geometry.grid import view_window
from jaxmap.types import Frame, PointLabels, StereoCamera, VoxelMap

_LEAST_PROBABILITY = 1e-30
_LEAST_REST = 1e-5


_DRAW = 1
"""Folded into a frame's key for the draws of the ensemble; the labeller draws from the key itself."""


def fuse_members(
    voxel_map: VoxelMap,
    frame: Frame,
    labels: PointLabels,
    camera: StereoCamera,
    params: EnsembleParams,
    frame_key: PRNGKeyArray,
    rule: FusionRule,
    depth_range_m: tuple[float, float],
    window_shape: tuple[int, int, int],
) -> Float[Array, "M 2 X Y Z"]:
    """Adds one frame to every member of a map.

    Args:
        voxel_map: `members` are those so far.
        frame: with `pose_errors`, the errors of its pose.
        labels: of its pixels, as the map takes them.
        camera: the rectified camera.
        params: the numbers of the members.
        frame_key: the frame's own; member `m` takes `fold_in(fold_in(frame_key, 1), m)`.
        rule: how frames are fused; its first priority class is the one that members carry.
        depth_range_m: the depths that are mapped.
        window_shape: voxels that hold the view of a frame.
    """
    assert voxel_map.members is not None and frame.pose_errors is not None
    target = rule.target(voxel_map.classes)
    assert target is not None
    key, index_of_class = jax.random.fold_in(frame_key, _DRAW), 1 + voxel_map.classes.index(target)
    # Kept apart, so that the map comes out as it does without members.
    frame, labels = jax.lax.optimization_barrier((frame, labels))
    count, grid = voxel_map.members.shape[0], voxel_map.grid
    at_once = next(size for size in range(min(params.at_once, count), 0, -1) if count % size == 0)
    drawn = (jnp.arange(count), params.sensor, frame.pose_errors)

    def evidence_of(number: Array, sensor: MemberParams, pose_error: Array) -> tuple[Array, Array]:
        """What a frame adds to one member, and where its window of the grid starts."""
        noise = disparity_noise(jax.random.fold_in(key, number), frame.matched_px.shape, params.block_px)
        disparity_px = frame.matched_px + params.disparity_sigma_px * noise
        pose, fusion = displaced(frame.T_world_camera, pose_error), sensor.fusion

        cloud = project(camera, pose, disparity_px, depth_range_m, fusion.disparity_sigma_px)
        own = doubted(labels, sensor)._replace(keep=labels.keep & cloud.in_range.reshape(-1))
        window = view_window(grid, camera, pose, depth_range_m[1], window_shape)
        free = None
        if rule.carve:
            free = carve(camera, pose, cloud.depth_m, cloud.valid, window, fusion, depth_range_m)
        weights = point_weights(grid, cloud, rule)
        counts = count_points(window, cloud.points_world, own, weights, len(voxel_map.classes))
        evidence = frame_evidence(counts, free, fusion, rule)
        return jnp.stack([evidence[0], evidence[index_of_class]]), window.first - grid.first

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
