"""Exact gradients of a score of the map, with memory that does not grow with the number of frames.

Fusion is a sum: `map = sum_i evidence_i(params)`, so `d loss / d params = sum_i (d evidence_i / d params)^T G` with one
and the same `G = d loss / d map` for all frames. The map is made once, forward; `G` is taken; then every frame is
computed anew and pulls `G` back to the parameters, within its own window of the map. Plain reverse mode through the
scan gives the same numbers, but keeps what every frame has computed until the last one is done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxmap.errors import JaxmapError
from jaxmap.mapping.step import Mapper, MapperParams
from jaxmap.types import Frame, VoxelMap

MapLoss = Callable[[VoxelMap, MapperParams], Float[Array, ""]]
"""A loss, from the map and the parameters that it is read with."""


class MapGradient(NamedTuple):
    """A loss of the map, its gradient with respect to the parameters, and the map itself."""

    loss: Float[Array, ""]
    gradient: MapperParams
    voxel_map: VoxelMap


class PullBack(NamedTuple):
    """The compiled functions of `map_gradient`; kept, they serve any number of gradients.

    Attributes:
        score: `(voxel_map, params) -> (loss, d loss / d log_odds, d loss / d params)`; the last is that of reading
            the map alone.
        add: `(gradient, cotangent, frame, params, key, number) -> gradient`, with what the frame has to add, which
            was fused after `number` others; the gradient passed in is donated. Compiled once for all frames.
        lower: the arguments of `add` -> `jax.stages.Lowered`, for its memory.
    """

    score: Callable[[VoxelMap, MapperParams], tuple[Array, Array, MapperParams]]
    add: Callable[[MapperParams, Array, Frame, MapperParams, PRNGKeyArray, int], MapperParams]
    lower: Callable[..., jax.stages.Lowered]


def make_pull_back(mapper: Mapper, loss_of_map: MapLoss) -> PullBack:
    """Builds the functions of the gradient of a loss of the map."""

    @jax.jit
    def score(voxel_map: VoxelMap, params: MapperParams) -> tuple[Array, Array, MapperParams]:
        def loss(log_odds: Array, params: MapperParams) -> Array:
            return loss_of_map(replace(voxel_map, log_odds=log_odds), params)

        value, (cotangent, reading) = jax.value_and_grad(loss, argnums=(0, 1))(voxel_map.log_odds, params)
        return value, cotangent, reading

    def add(
        gradient: MapperParams,
        cotangent: Array,
        frame: Frame,
        params: MapperParams,
        key: PRNGKeyArray,
        number: Int[Array, ""] | int,
    ) -> MapperParams:
        _, pull = jax.vjp(lambda params: frame_evidence(mapper, frame, params, key, number), params)
        return jax.tree.map(jnp.add, gradient, pull(cotangent)[0])

    compiled = jax.jit(add, donate_argnums=0)
    return PullBack(score, compiled, compiled.lower)


def frame_evidence(
    mapper: Mapper, frame: Frame, params: MapperParams, key: PRNGKeyArray, number: Int[Array, ""] | int
) -> Float[Array, "K X Y Z"]:
    """What a frame adds to the map, as the step does it after `number` others.

    It is the map of that frame alone. Only its window is computed where it is pulled back: the map is a constant
    then, and nothing of it is kept.
    """
    blank = replace(mapper.init(), frames_fused=jnp.asarray(number, jnp.int32))
    return mapper.fuse(blank, frame, params, key)[0].log_odds


def map_gradient(
    mapper: Mapper,
    frames: Iterable[Frame],
    params: MapperParams,
    key: PRNGKeyArray,
    loss_of_map: MapLoss,
    *,
    pull_back: PullBack | None = None,
) -> MapGradient:
    """A loss of the map of all frames, and its gradient with respect to every parameter.

    Equal to `jax.grad` through `Mapper.scan`. At any time there are two maps in the memory, one of them the gradient,
    and what one frame takes.

    Args:
        mapper: the step.
        frames: iterated twice, in the same order: a list, or an iterable that prepares them again.
        params: where the gradient is taken.
        key: of the run.
        loss_of_map: `(voxel_map, params) -> loss`. What it reads the map with (priors, thresholds) has its part in
            the gradient.
        pull_back: `make_pull_back(mapper, loss_of_map)`, where it is there already.

    Returns:
        The loss, its gradient, of the structure of `params`, and the map. Without frames, that of the empty map.

    Raises:
        JaxmapError: frames that can be iterated only once.
    """
    if isinstance(frames, Iterator):
        raise JaxmapError("the frames can be iterated only once", where="map_gradient", fix="give a list")
    functions = make_pull_back(mapper, loss_of_map) if pull_back is None else pull_back
    voxel_map = mapper.init()
    for frame in frames:
        voxel_map, _ = mapper.step(voxel_map, frame, params, key)
    loss, cotangent, gradient = functions.score(voxel_map, params)
    for number, frame in enumerate(frames):
        gradient = functions.add(gradient, cotangent, frame, params, key, number)
    return MapGradient(loss, gradient, voxel_map)
