"""A frame into a map by one kernel in C++ (`native/fuse.cpp`): what `frame.add_plainly` does, in one pass.

The plain form is made of whole windows: each step of it reads and writes all their voxels, of which a frame touches a
few in a hundred, and XLA scatters points one by one on one core. The kernel touches what the frame touches, in place.
Sums over the points of a voxel are rounded in another order; all else is the same. Where there is no compiler, for
gradients, and on other devices than CPUs, the plain form does it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxmap.fusion.carve import MARGIN_SIGMAS
from jaxmap.fusion.frame import Counted, Sighting, add_plainly
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.surface import POSE_SIGMA_M
from jaxmap.geometry.camera import depth_sigma
from jaxmap.native.build import FUSE_TARGET, has_kernel
from jaxmap.types import LAYER, GridSpec, VoxelMap

_RULES = ("sum", "once", "majority", "mean")


@partial(jax.custom_jvp, nondiff_argnums=(4, 5))
def add_sighting(
    voxel_map: VoxelMap,
    sighting: Sighting,
    window: GridSpec,
    params: FusionParams,
    rule: FusionRule,
    depth_range_m: tuple[float, float],
) -> tuple[VoxelMap, Counted]:
    """Adds a frame to a map; also counts its points and the voxels it touched.

    Args:
        voxel_map: the map so far.
        sighting: the frame.
        window: of the map, that holds all that the frame can see.
        params: the sensor model.
        rule: how the points of a frame add up, and whether it carves.
        depth_range_m: voxels nearer or farther are not seen through.
    """
    plain = partial(add_plainly, rule=rule, depth_range_m=depth_range_m)
    # The kernel knows float32 alone.
    if jax.config.jax_enable_x64 or not has_kernel(FUSE_TARGET):  # pyright: ignore[reportAttributeAccessIssue]
        return plain(voxel_map, sighting, window, params)
    kernel = partial(_by_kernel, rule=rule, depth_range_m=depth_range_m)
    return jax.lax.platform_dependent(voxel_map, sighting, window, params, cpu=kernel, default=plain)


def _differentiated(
    rule: FusionRule, depth_range_m: tuple[float, float], primals: PyTree, tangents: PyTree
) -> tuple[PyTree, PyTree]:
    """Derivatives of the plain form, in what changes alone: of all else not even zeros are made."""
    leaves, form = jax.tree.flatten(primals)
    changes = jax.tree.leaves(tangents, is_leaf=_is_zero)
    moving = [index for index, change in enumerate(changes) if not _is_zero(change)]

    def plain(*moved: Array) -> tuple[VoxelMap, Counted]:
        those = dict(zip(moving, moved, strict=True))
        arguments = [those.get(index, leaf) for index, leaf in enumerate(leaves)]
        voxel_map, sighting, window, params = jax.tree.unflatten(form, arguments)
        return add_plainly(voxel_map, sighting, window, params, rule, depth_range_m)

    return jax.jvp(plain, [leaves[index] for index in moving], [changes[index] for index in moving])


def _is_zero(change: object) -> bool:
    return isinstance(change, jax.custom_derivatives.SymbolicZero)


add_sighting.defjvp(_differentiated, symbolic_zeros=True)


def _by_kernel(
    voxel_map: VoxelMap,
    sighting: Sighting,
    window: GridSpec,
    params: FusionParams,
    rule: FusionRule,
    depth_range_m: tuple[float, float],
) -> tuple[VoxelMap, Counted]:
    labels, log_odds, surface = sighting.labels, voxel_map.log_odds, voxel_map.surface
    if surface is None or not rule.surface:
        surface = jnp.zeros((4, 0, 0, 0))
    hard, shares = jnp.zeros(0, jnp.int32), []
    if labels.probabilities is not None:
        # Class by class, as XLA has them before it stacks them: nothing is copied.
        shares = [labels.probabilities[:, index] for index in range(len(voxel_map.classes))]
    elif labels.labels is not None:
        hard = labels.labels.astype(jnp.int32)
    places = jnp.concatenate([window.first, window.first - voxel_map.grid.first]).astype(jnp.int32)
    call = jax.ffi.ffi_call(
        FUSE_TARGET,
        (
            jax.ShapeDtypeStruct(log_odds.shape, log_odds.dtype),
            jax.ShapeDtypeStruct(surface.shape, surface.dtype),
            jax.ShapeDtypeStruct((len(Counted._fields),), jnp.int32),
        ),
        input_output_aliases={0: 0, 1: 1},
        vmap_method="sequential",
    )
    with jax.named_scope("fuse"):
        new_log_odds, new_surface, counted = call(
            *(log_odds, surface, _numbers(sighting, window, params, rule, depth_range_m), places),
            *(sighting.disparity_px, labels.keep, hard, *shares),
            shape=np.asarray(window.shape, np.int64),
            layer=np.int64(LAYER),
            carve=rule.carve,
            rule=np.int64(_RULES.index(rule.per_frame)),
        )
    fused = replace(
        voxel_map,
        log_odds=new_log_odds,
        surface=new_surface if surface.size else voxel_map.surface,
        frames_fused=voxel_map.frames_fused + 1,
    )
    return fused, Counted(*counted)


def _numbers(
    sighting: Sighting, window: GridSpec, params: FusionParams, rule: FusionRule, depth_range_m: tuple[float, float]
) -> Float[Array, "K"]:
    """`Numbers` of the kernel, and the matrix of increments."""
    camera, pose, size_m, prior = sighting.camera, sighting.T_world_camera, window.voxel_size_m, params.occupancy_prior
    sigma, R_world_camera = depth_sigma(camera, jnp.ones(()), params.disparity_sigma_px), pose.rotation().as_matrix()
    parts = [
        *(R_world_camera, pose.translation(), R_world_camera.T, pose.inverse().translation()),
        *(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.doffs_px, camera.baseline_m * camera.fx_px),
        *(sigma, 1.0 / size_m.mean() if rule.range_weighting else 0.0, POSE_SIGMA_M**2),
        *(0.5 * jnp.linalg.norm(size_m), MARGIN_SIGMAS * sigma, *depth_range_m, window.lattice_m, size_m),
        *(params.occupancy_hit - prior, params.occupancy_miss - prior, params.full_evidence_points),
        params.class_increments,
    ]
    return jnp.concatenate([jnp.asarray(part, jnp.float32).reshape(-1) for part in parts])
