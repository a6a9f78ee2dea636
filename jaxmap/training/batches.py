"""The order of examples, and the batches made of them, read ahead in threads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from threading import Lock
from typing import NamedTuple

import numpy as np
from jaxtyping import Float16, Int, UInt8

from jaxmap.datasets.masks import MaskLookup
from jaxmap.geometry.relief import RELIEF_CHANNELS, RELIEF_STRIDE
from jaxmap.host.prefetch import prefetch
from jaxmap.labels import IGNORE
from jaxmap.training.data import Example, read_example
from jaxmap.training.options import TrainingOptions
from jaxmap.training.relief import read_relief
from jaxmap.training.step import Batch

CACHE_BYTES = 2 * 2**30
BATCHES_AHEAD = 3


class ExampleOrder(NamedTuple):
    """The order of the examples of a run; that of any step can be computed, so that a run can resume anywhere.

    Epochs follow each other without a gap: a batch may end one and begin the next, and every example is
    seen equally often.

    Attributes:
        images: their number.
        variants: examples made of each image: 1, or 1 + copies where they are fixed.
        options: the recipe.
    """

    images: int
    variants: int
    options: TrainingOptions

    @classmethod
    def of(cls, images: int, options: TrainingOptions) -> ExampleOrder:
        """The order of a recipe for a number of images."""
        return cls(images, 1 + (options.augmentation.copies or 0), options)

    @property
    def examples(self) -> int:
        """Examples in an epoch."""
        return self.images * self.variants

    @property
    def steps(self) -> int:
        """Steps of the whole run."""
        return self.epoch_end(self.options.epochs - 1)

    def epoch_end(self, epoch: int) -> int:
        """The number of steps after which an epoch, counted from 0, is complete."""
        return -(-(epoch + 1) * self.examples // self.options.batch_size)

    def draws(self, step: int) -> Int[np.ndarray, "B 2"]:
        """(epoch, example) of each item of a step's batch."""
        size = self.options.batch_size
        places = np.arange(step * size, (step + 1) * size)
        epochs, within = np.divmod(places, self.examples)
        orders = {
            epoch: np.random.default_rng((self.options.seed, epoch)).permutation(self.examples)
            for epoch in np.unique(epochs).tolist()
        }
        chosen = [orders[epoch][place] for epoch, place in zip(epochs.tolist(), within.tolist(), strict=True)]
        return np.stack([epochs, chosen], axis=1).astype(np.int32)


class RawExample(NamedTuple):
    """An image as it was read, its labels, and its relief, where the network sees any."""

    image: UInt8[np.ndarray, "H W 3"]
    labels: UInt8[np.ndarray, "H W"]
    relief: Float16[np.ndarray, "h w R"] | None


class ExampleReader:
    """Reads examples and makes batches of them; as many as fit into `cache_bytes` stay in memory.

    Args:
        examples: the training examples.
        lookup: from the pixels of their masks to labels.
        relief: whether the network sees relief.
        cache_bytes: what may be kept.
    """

    def __init__(
        self, examples: Sequence[Example], lookup: MaskLookup, *, relief: bool = False, cache_bytes: int = CACHE_BYTES
    ) -> None:
        self._examples, self._lookup, self._relief = examples, lookup, relief
        self._kept: dict[int, RawExample] = {}
        self._room, self._lock = cache_bytes, Lock()
        self.height_px = max(example.size_px[0] for example in examples)
        self.width_px = max(example.size_px[1] for example in examples)

    def read(self, index: int) -> RawExample:
        """An image, its labels, and its relief.

        Raises:
            JaxmapError: they cannot be read.
        """
        kept = self._kept.get(index)
        if kept is not None:
            return kept
        example = self._examples[index]
        raw = RawExample(*read_example(example, self._lookup), read_relief(example) if self._relief else None)
        taken = sum(array.nbytes for array in raw if array is not None)
        with self._lock:
            if index not in self._kept and taken <= self._room:
                self._kept[index], self._room = raw, self._room - taken
        return raw

    def batch(self, draws: Int[np.ndarray, "B 2"], order: ExampleOrder) -> Batch:
        """The batch of these draws.

        Raises:
            JaxmapError: an image cannot be read.
        """
        count = len(draws)
        images = np.zeros((count, self.height_px, self.width_px, 3), np.uint8)
        labels = np.full((count, self.height_px, self.width_px), IGNORE, np.uint8)
        coarse_px = -(-self.height_px // RELIEF_STRIDE), -(-self.width_px // RELIEF_STRIDE)
        relief = np.zeros((count, *coarse_px, RELIEF_CHANNELS), np.float16) if self._relief else None
        sizes = np.zeros((count, 2), np.int32)
        for place, example in enumerate(draws[:, 1]):
            raw = self.read(int(example) // order.variants)
            sizes[place] = height, width = raw.labels.shape
            images[place, :height, :width] = raw.image
            labels[place, :height, :width] = raw.labels
            if relief is not None and raw.relief is not None:
                relief[place, : raw.relief.shape[0], : raw.relief.shape[1]] = raw.relief
        fixed = order.variants > 1
        seeds = np.stack([np.zeros(count, np.int32) if fixed else draws[:, 0], draws[:, 1]], axis=1)
        originals = (draws[:, 1] % order.variants == 0) & fixed
        return Batch(images, labels, sizes, seeds, originals, relief)  # type: ignore[arg-type]


def batches_from(pixels: ExampleReader, order: ExampleOrder, first_step: int) -> Iterator[Batch]:
    """The batches of a run from `first_step` on, read ahead.

    Raises:
        JaxmapError: an image cannot be read.
    """
    yield from prefetch(
        lambda step: pixels.batch(order.draws(step), order),
        range(first_step, order.steps),
        workers=2,
        ahead=BATCHES_AHEAD,
    )
