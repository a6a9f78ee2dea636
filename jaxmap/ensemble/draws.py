"""What the members of an ensemble draw: errors of poses and of disparity, and numbers of the sensor model.

All come from an explicit key, member by member and frame by frame: more members or more frames leave the draws of
the others as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Float32, Int, PRNGKeyArray

from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.fusion.params import FusionParams

_MOST_DECADES = 3.0
_NO_FRAME = 2**32 - 1


class MemberParams(NamedTuple):
    """The sensor model as a member takes it.

    `temperature` divides the logits of soft labels, `bias` is added to those of each class.
    """

    fusion: FusionParams
    temperature: Float[Array, ""]
    bias: Float[Array, "C"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EnsembleParams:
    """The numbers of all members: every leaf of `sensor` has a leading axis of members.

    `disparity_sigma_px` is that of errors shared by blocks of `block_px` pixels; `at_once` members are computed
    together.
    """

    sensor: MemberParams
    disparity_sigma_px: Float[Array, ""]
    block_px: int = field(metadata={"static": True})
    at_once: int = field(metadata={"static": True})


def draw_ensemble(
    key: PRNGKeyArray, fusion: FusionParams, timestamps_s: Float[np.ndarray, "N"], options: EnsembleOptions
) -> tuple[EnsembleParams, Float32[np.ndarray, "N M 6"]]:
    """All that the members of a run draw before its first frame: their numbers, and the errors of their poses.

    Args:
        key: the run's own, as the steps take it.
        fusion: the sensor model of the map.
        timestamps_s: of all frames.
        options: how many members, and their spread.
    """
    # Steps fold the number of fused frames into the key: this one is out of their reach.
    params_key, poses_key = jax.random.split(jax.random.fold_in(key, _NO_FRAME))
    return draw_ensemble_params(params_key, fusion, options), draw_pose_errors(poses_key, timestamps_s, options)


def draw_ensemble_params(key: PRNGKeyArray, fusion: FusionParams, options: EnsembleOptions) -> EnsembleParams:
    """Each member's sensor model: increments and temperature scaled by log-normal factors of median 1, biased logits.

    There is one factor for the occupancy of a hit, one for that of a miss and one for each label. How maps are read
    (priors, thresholds) is the same for all.
    """
    labels = fusion.class_increments.shape[0]

    def draw(member: Int[Array, ""]) -> MemberParams:
        normal = jax.random.normal(jax.random.fold_in(key, member), (3 + 2 * labels,))
        factor = _log_normal(options.increment_sigma * normal)
        drawn = replace(
            fusion,
            occupancy_hit=fusion.occupancy_hit * factor[0],
            occupancy_miss=fusion.occupancy_miss * factor[1],
            class_increments=fusion.class_increments * factor[3 : 3 + labels, None],
        )
        temperature = _log_normal(options.temperature_sigma * normal[2])
        return MemberParams(drawn, temperature, options.label_bias_sigma * normal[3 + labels :])

    sigma_px = jnp.asarray(options.disparity_sigma_px, jnp.float32)
    sensor = jax.vmap(draw)(jnp.arange(options.members))
    return EnsembleParams(sensor, sigma_px, options.disparity_block_px, options.at_once)


def _log_normal(exponent: Float[Array, "*s"]) -> Float[Array, "*s"]:
    # Within three decades: a spread that is too wide for any sensor must not overflow.
    return jnp.exp(jnp.clip(exponent, -_MOST_DECADES * np.log(10.0), _MOST_DECADES * np.log(10.0)))


def draw_pose_errors(
    key: PRNGKeyArray, timestamps_s: Float[np.ndarray, "N"], options: EnsembleOptions
) -> Float32[np.ndarray, "N M 6"]:
    """Errors of the camera's pose along a drive: shift in metres, then turn as a rotation vector, along world axes.

    Each of the six is a first-order Gauss-Markov process (Gelb, *Applied Optimal Estimation*, 1974, section 3.8): of
    the same standard deviation at all times, correlated by `exp(-dt / correlation)` between two of them. The world is
    z-up: the third of the turn is heading.
    """
    count, members = len(timestamps_s), options.members

    def draw(member: Array, frame: Array) -> Array:
        return jax.random.normal(jax.random.fold_in(jax.random.fold_in(key, member), frame), (6,))

    over_members = jax.vmap(draw, in_axes=(0, None))
    normal = jax.vmap(over_members, in_axes=(None, 0))(jnp.arange(members), jnp.arange(count))
    errors = np.asarray(normal, np.float64).reshape(count, members, 6)
    steps_s = np.diff(np.asarray(timestamps_s, np.float64)).clip(min=0)
    for index, kept in enumerate(np.exp(-steps_s / options.pose_correlation_s), start=1):
        errors[index] = kept * errors[index - 1] + np.sqrt(1 - kept**2) * errors[index]
    position, tilt, heading = options.position_sigma_m, options.tilt_sigma_rad, options.heading_sigma_rad
    return (errors * [position, position, position, tilt, tilt, heading]).astype(np.float32)


def displaced(T_world_camera: jaxlie.SE3, error: Float[Array, "6"]) -> jaxlie.SE3:
    """A pose with an error of `draw_pose_errors`: shifted, and turned about the camera."""
    turn = jaxlie.SO3.exp(error[3:])
    return jaxlie.SE3.from_rotation_and_translation(
        turn @ T_world_camera.rotation(), T_world_camera.translation() + error[:3]
    )


def disparity_noise(key: PRNGKeyArray, shape: tuple[int, ...], block_px: int) -> Float[Array, "H W"]:
    """Standard normal noise shared by the pixels of each block; where the blocks begin is drawn, too.

    Two pixels `dx` and `dy` apart are correlated by `(1 - dx / block) (1 - dy / block)`, those farther apart not.
    """
    corner_key, noise_key = jax.random.split(key)
    corner = jax.random.randint(corner_key, (2,), 0, block_px)
    height, width = (-(-size // block_px) + 1 for size in shape)
    blocks = jax.random.normal(noise_key, (height, width))
    pixels = jnp.repeat(jnp.repeat(blocks, block_px, axis=0), block_px, axis=1)
    return jax.lax.dynamic_slice(pixels, (corner[0], corner[1]), shape)
