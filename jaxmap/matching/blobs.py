"""Blobs of disparity: pixels that hang together by small steps, and how many they are."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

MOST_ROUNDS = 64
"""Of labels handed on. Images take a few; where that were not enough, nothing would be dropped."""
_JUMPS = 4
"""To the parent's parent, after each round of hooks."""


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
    """For each pixel the least index of a pixel in its blob; whether all labels have settled."""
    down = jnp.abs(disparity_px[1:] - disparity_px[:-1]) <= step_px
    along = jnp.abs(disparity_px[:, 1:] - disparity_px[:, :-1]) <= step_px
    down, along = jnp.pad(down, ((1, 0), (0, 0))), jnp.pad(along, ((0, 0), (1, 0)))
    return lax.platform_dependent(down, along, cuda=labels_by_hooks, default=labels_handed_on)


def labels_by_hooks(down: Bool[Array, "H W"], along: Bool[Array, "H W"]) -> tuple[Int[Array, "H W"], Bool[Array, ""]]:
    """The labels where many threads read and write at random: trees of pixels, hooked onto each other by their roots.

    Args:
        down: which pixels hang together with the one above.
        along: with the one to their left.
    """
    height, width = down.shape
    index = jnp.arange(height * width, dtype=jnp.int32).reshape(height, width)
    # Ways that lead left and up are no longer than this power of two.
    parent = jnp.where(along, index - 1, jnp.where(down, index - width, index)).reshape(-1)
    for _ in range((height + width).bit_length()):
        parent = parent[parent]

    def one_round(state: tuple[Array, Array]) -> tuple[Array, Array]:
        before, _ = state
        labels = before.reshape(height, width)
        low, high = (choose(labels[1:], labels[:-1]) for choose in (jnp.minimum, jnp.maximum))
        # Only roots are hooked, so that no tree falls apart.
        hooks = down[1:] & (low < high) & (before[high] == high)
        parent = before.at[jnp.where(hooks, high, before.size)].min(low, mode="drop")
        for _ in range(_JUMPS):
            parent = parent[parent]
        return parent, (parent == before).all()

    parent, settled = lax.while_loop(lambda state: ~state[1], one_round, (parent, jnp.zeros((), bool)))
    return parent.reshape(height, width), settled


def labels_handed_on(down: Bool[Array, "H W"], along: Bool[Array, "H W"]) -> tuple[Int[Array, "H W"], Bool[Array, ""]]:
    """The same where rows are worked off one after the other.

    In a round, labels are handed on along columns and rows, both ways, as far as they go; then each pixel takes the
    label that its label's pixel has ("pointer jumping").
    """
    (height, width), along = down.shape, along.T

    def hand_on(labels: Int[Array, "H W"], tied: Bool[Array, "H W"]) -> Int[Array, "H W"]:
        """Down the rows, where a row is tied to the one above, and up again."""

        def step(before: Int[Array, "W"], here: tuple[Array, Array]) -> tuple[Array, Array]:
            label = jnp.where(here[1], jnp.minimum(here[0], before), here[0])
            return label, label

        last = labels[-1]
        labels = lax.scan(step, last, (labels, tied))[1]
        return lax.scan(step, last, (labels, jnp.roll(tied, -1, 0)), reverse=True)[1]

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
