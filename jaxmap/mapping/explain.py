"""What one frame adds to a few voxels, and which of its pixels: the step again, with its inner workings laid open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, UInt8

from jaxmap.fusion.sensor_model import point_weights
from jaxmap.geometry.cloud import project
from jaxmap.geometry.grid import world_to_voxel
from jaxmap.labellers.base import fusible, harden, label_points
from jaxmap.labels import IGNORE
from jaxmap.mapping.step import MapperParams, StepDesign, fuse_frame, in_full_float32
from jaxmap.types import Frame, GridSpec, make_voxel_map, to_device


class Contribution(NamedTuple):
    """What a frame adds to the voxels of a box.

    Attributes:
        log_odds: its evidence, occupancy first, then each class.
        inside: pixels whose point lies in the box and is fused.
        label: of each pixel, `IGNORE` where it has no class; the likeliest where labels are probabilities.
        weight: how much each pixel counts, 0 where it is not inside.
        depth_m: of each pixel, along the optical axis.
    """

    log_odds: Float[Array, "K X Y Z"]
    inside: Bool[Array, "H W"]
    label: UInt8[Array, "H W"]
    weight: Float[Array, "H W"]
    depth_m: Float[Array, "H W"]


Explain = Callable[[Frame, int], Contribution]
"""From a frame, and how many were fused before it, to what it adds."""


def make_explainer(design: StepDesign, box: GridSpec, params: MapperParams, key: PRNGKeyArray) -> Explain:
    """A function that tells what frames add to the voxels of a box of the map.

    Args:
        design: of the mapper of the run; its window is made no larger than the box.
        box: a part of the map's grid. A frame's evidence of a voxel is the same in any box.
        params: of the run.
        key: of the run.
    """
    x, y, z = (min(pair) for pair in zip(design.window_shape, box.shape, strict=True))
    design = replace(design, window_shape=(x, y, z), members=0, match=None)
    empty = make_voxel_map(box, design.labeller.classes)

    @jax.jit
    @in_full_float32
    def explained(frame: Frame, number: Array) -> Contribution:
        before = replace(empty, frames_fused=number)
        fused, _ = fuse_frame(design, before, frame, params, key)
        labeller, rule, pose = design.labeller, design.rule, frame.T_world_camera
        sigma_px = params.fusion.disparity_sigma_px
        # As in the step, whose own values the compiler takes.
        cloud = project(params.camera, pose, frame.matched_px, design.depth_range_m, sigma_px, labeller.ground)
        frame_key = jax.random.fold_in(key, number)
        labels, _ = label_points(labeller, frame, cloud, params.labeller, frame_key)
        labels = fusible(labels, labeller.classes, rule)
        _, inside = world_to_voxel(box, cloud.points_world)
        inside = inside & labels.keep
        hard = harden(labels).labels
        assert hard is not None
        size = cloud.valid.shape
        known = (hard >= 0) & (hard < len(labeller.classes))
        return Contribution(
            fused.log_odds,
            inside.reshape(size),
            jnp.where(known, hard, IGNORE).astype(jnp.uint8).reshape(size),
            jnp.where(inside, point_weights(box, cloud, rule), 0.0).reshape(size),
            cloud.depth_m,
        )

    return lambda frame, number: explained(frame, to_device(number, np.int32))
