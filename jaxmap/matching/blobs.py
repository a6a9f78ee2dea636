"""Blobs of disparity: pixels that hang together by small steps, and how many they are."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

MOST_ROUNDS = 64
"""Of labels handed on. Blobs of real images take fewer than ten; what coils more than that stays as it is."""


def drop_blobs(disparity_px: Float[Array, "H W"], step_px: float, most_px: int) -> Float[Array, "H W"]:
    """NaN where a blob has at most so many pixels.

    Args:
        disparity_px: NaN where it is unknown.
        step_px: neighbours, above, below and to the sides, hang together where they differ by no more.
        most_px: pixels of a blob that is dropped.
    """
    labels, settled = blob_labels(disparity_px, step_px)
    sizes = jnp.zeros(labels.size, jnp.int32).at[labels.reshape(-1)].add(1)
    # What has not settled is in pieces, and looks smaller than it is.
    small = (sizes[labels] <= most_px) & settled
    return jnp.where(small, jnp.nan, disparity_px)


def blob_labels(disparity_px: Float[Array, "H W"], step_px: float) -> tuple[Int[Array, "H W"], Bool[Array, ""]]:
    """For each pixel the least index of a pixel in its blob; whether all labels have settled.

    In a round, labels are handed on along columns and rows, both ways, as far as they go; then each pixel takes the
    label that its label's pixel has ("pointer jumping").
    """
    height, width = disparity_px.shape
    down = jnp.abs(disparity_px[1:] - disparity_px[:-1]) <= step_px
    along = (jnp.abs(disparity_px[:, 1:] - disparity_px[:, :-1]) <= step_px).T
    down, along = (jnp.pad(tied, ((1, 0), (0, 0))) for tied in (down, along))

    def hand_on(labels: Int[Array, "H W"], tied: Bool[Array, "H W"]) -> Int[Array, "H W"]:
        """Down the rows and up again."""
        last = jnp.full(labels.shape[1], labels.size, labels.dtype)

        def row(
            before: tuple[Int[Array, "W"], Bool[Array, "W"]], here: tuple[Int[Array, "W"], Bool[Array, "W"]]
        ) -> tuple[tuple[Int[Array, "W"], Bool[Array, "W"]], Int[Array, "W"]]:
            least, is_tied = before
            label, tied_to_above = here
            least = jnp.where(is_tied, jnp.minimum(label, least), label)
            return (least, tied_to_above), least

        def downwards(before: Int[Array, "W"], here: tuple[Int[Array, "W"], Bool[Array, "W"]]) -> tuple[Array, Array]:
            least = jnp.where(here[1], jnp.minimum(here[0], before), here[0])
            return least, least

        labels = lax.scan(downwards, last, (labels, tied))[1]
        return lax.scan(row, (last, jnp.zeros(last.shape, bool)), (labels, tied), reverse=True)[1]

    def go_on(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        _, settled, rounds = state
        return ~settled & (rounds < MOST_ROUNDS)

    def one_round(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        labels, _, rounds = state
        handed = hand_on(hand_on(labels, down).T, along).T
        jumped = handed.reshape(-1)[handed]
        return jumped, (jumped == labels).all(), rounds + 1

    first = jnp.arange(height * width, dtype=jnp.int32).reshape(height, width)
    labels, settled, _ = lax.while_loop(go_on, one_round, (first, jnp.zeros((), bool), jnp.zeros((), jnp.int32)))
    return labels, settled
