"""Shares of the map's classes at all pixels, from the coarse logits of a network and the odds that relief adds.

By one kernel in C++ (`native/labels.cpp`), row by row, where there is a compiler; otherwise, on other devices and
wherever a derivative is taken, by `map_pixels`, whose operations XLA runs one after the other. They differ by rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxmap.geometry.relief import RELIEF_STRIDE
from jaxmap.labels import IGNORE
from jaxmap.models.pixelwise import Upsampling, cut_matrix, map_pixels
from jaxmap.native.build import LABELS_TARGET, has_kernel

_MOST_CLASSES = 32
"""Of a network, that the kernel takes."""
_LEAST_SHARE = 1e-7


class Odds(NamedTuple):
    """What is added to the log-odds of one class against each other, at the pixels of relief.

    Before, all are multiplied by `gain`.
    """

    of_class: int
    log_odds: Float[Array, "h w"]
    gain: Float[Array, ""]


def merged_softmax(
    logits: Float[Array, "N D *w"], targets: Sequence[int], classes: int
) -> tuple[Float[Array, "N *w"], ...]:
    """The summed probability of the logits that become each class: the targets are those of the logits, or `IGNORE`."""
    powers = jnp.exp(logits - jax.lax.stop_gradient(logits.max(axis=1, keepdims=True)))
    # Without the barriers they would be computed anew for each class.
    powers = jax.lax.optimization_barrier(powers)
    scale = jax.lax.optimization_barrier(1.0 / powers.sum(axis=1))
    groups = [[index for index, target in enumerate(targets) if target == wanted] for wanted in range(classes)]
    return tuple(sum(powers[:, index] for index in group) * scale for group in groups)


def with_odds(
    shares: Sequence[Float[Array, "N *w"]], of_class: int, log_odds: Float[Array, "N *w"], gain: Float[Array, ""]
) -> tuple[Float[Array, "N *w"], ...]:
    """The shares of classes, of the same sum, with odds added to those of one of them (`Odds`)."""
    # A power takes XLA four times as long as its logarithm and exponential.
    logs = [gain * jnp.log(jnp.maximum(share, _LEAST_SHARE)) for share in shares]
    logs[of_class] = logs[of_class] + log_odds
    powers = [jnp.exp(log) for log in logs]
    scale = sum(shares) / sum(powers)
    return tuple(power * scale for power in powers)


def pixel_shares(
    logits: Float[Array, "h w C"],
    places: Upsampling,
    targets: Sequence[int],
    classes: int,
    temperature: Float[Array, ""],
    wanted: Bool[Array, "H W"],
    odds: Odds | None = None,
) -> tuple[Float[Array, "N"], ...]:
    """The share of each class at each pixel: softmax, `merged_softmax`, `with_odds`.

    Args:
        logits: of the network, coarse.
        places: where the pixels lie among them.
        targets: for each class of the network that of the map, or `IGNORE`.
        classes: of the map.
        temperature: divides the logits.
        wanted: pixels whose shares are asked for; others may get zeros.
        odds: what relief adds.
    """
    numbers = (logits, temperature, None if odds is None else (odds.log_odds, odds.gain), wanted)
    favoured = None if odds is None else odds.of_class
    plain = partial(_plainly, places=places, targets=targets, classes=classes, favoured=favoured)
    if logits.dtype != jnp.float32 or len(targets) > _MOST_CLASSES or not has_kernel(LABELS_TARGET):
        return plain(*numbers)

    @jax.custom_jvp
    def shares(*numbers: PyTree) -> tuple[Array, ...]:
        kernel = partial(_by_kernel, places=places, targets=targets, classes=classes, favoured=favoured)
        return jax.lax.platform_dependent(*numbers, cpu=kernel, default=plain)

    shares.defjvp(lambda primals, tangents: jax.jvp(plain, primals, tangents))
    return shares(*numbers)


Added = tuple[Float[Array, "h2 w2"], Float[Array, ""]]
"""The arrays of `Odds`."""


def _plainly(
    logits: Float[Array, "h w C"],
    temperature: Float[Array, ""],
    added: Added | None,
    wanted: Bool[Array, "H W"],
    *,
    places: Upsampling,
    targets: Sequence[int],
    classes: int,
    favoured: int | None,
) -> tuple[Float[Array, "N"], ...]:
    def of_rows(values: Array) -> tuple[Array, ...]:
        shares = merged_softmax(values[:, : len(targets)] / temperature, targets, classes)
        if added is None or favoured is None:
            return shares
        return with_odds(shares, favoured, values[:, len(targets)], added[1])

    beside = None if added is None else added[0][..., None]
    images = map_pixels(of_rows, logits, places, beside, RELIEF_STRIDE, wanted)
    return tuple(image.reshape(-1) for image in images)


def _by_kernel(
    logits: Float[Array, "h w C"],
    temperature: Float[Array, ""],
    added: Added | None,
    wanted: Bool[Array, "H W"],
    *,
    places: Upsampling,
    targets: Sequence[int],
    classes: int,
    favoured: int | None,
) -> tuple[Float[Array, "N"], ...]:
    axes = [cut_matrix(matrix, 1) for matrix in places]
    factors, gain = (jnp.zeros((0, 0)), 1.0) if added is None else (jnp.exp(added[0]), added[1])
    call = jax.ffi.ffi_call(
        LABELS_TARGET, [jax.ShapeDtypeStruct((wanted.size,), jnp.float32)] * classes, vmap_method="sequential"
    )
    shares = call(
        logits,
        *(array for axis in axes for array in (axis.starts, axis.weights[:, 0].T)),
        wanted,
        factors,
        jnp.stack([1.0 / temperature, jnp.asarray(gain)]).astype(jnp.float32),
        targets=np.array([-1 if target == IGNORE else target for target in targets], np.int64),
        stride=np.int64(RELIEF_STRIDE),
        favoured=np.int64(-1 if favoured is None else favoured),
    )
    return tuple(shares)
