"""The order of examples and the batches made of them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest
from compiling import compiled_quickly
from hypothesis import given
from hypothesis import strategies as st
from training_data import CLASSES, scene, write_pair

from jaxmap.errors import JaxmapError
from jaxmap.labels import IGNORE
from jaxmap.training.augment import augment
from jaxmap.training.batches import ExampleOrder, ExampleReader, batches_from
from jaxmap.training.data import TrainingSet, open_training_set
from jaxmap.training.options import AugmentationOptions, DataOptions, TrainingOptions

quickly = pytest.fixture(scope="module", autouse=True)(compiled_quickly)

SIZES_PX = ((20, 30), (25, 17), (16, 16))


def order_of(images: int, epochs: int, batch: int, copies: int | None = None, seed: int = 0) -> ExampleOrder:
    options = TrainingOptions(
        epochs=epochs, batch_size=batch, seed=seed, augmentation=AugmentationOptions(crop_px=(16, 16), copies=copies)
    )
    return ExampleOrder.of(images, options)


orders = st.builds(
    order_of,
    images=st.integers(1, 9),
    epochs=st.integers(1, 5),
    batch=st.integers(1, 20),
    copies=st.none() | st.integers(0, 3),
    seed=st.integers(0, 9),
)


@pytest.fixture(scope="module")
def opened(tmp_path_factory) -> TrainingSet:
    """Three images of three sizes."""
    folder = tmp_path_factory.mktemp("data")
    for index, size_px in enumerate(SIZES_PX):
        write_pair(folder, f"i{index}", *scene(size_px, index))
    return open_training_set(folder, CLASSES, DataOptions(validation_share=0))


@pytest.fixture(scope="module")
def pixels(opened) -> ExampleReader:
    return ExampleReader(opened.train, opened.lookup)


@given(orders)
def test_every_example_is_seen_once_in_every_epoch(order):
    draws = np.concatenate([order.draws(step) for step in range(order.steps)])
    seen = Counter(map(tuple, draws.tolist()))
    for epoch in range(order.options.epochs):
        for example in range(order.examples):
            assert seen.pop((epoch, example)) == 1
    # What the last batch has left to fill is the beginning of one more epoch.
    assert set(seen.values()) <= {1} and len(seen) < order.options.batch_size


@given(orders)
def test_epochs_follow_without_a_gap(order):
    epochs = np.concatenate([order.draws(step)[:, 0] for step in range(order.steps)])
    np.testing.assert_array_equal(epochs, np.arange(len(epochs)) // order.examples)
    for epoch in range(order.options.epochs):
        end = order.epoch_end(epoch)
        assert (epochs == epoch).sum() == order.examples
        assert np.flatnonzero(epochs == epoch)[-1] // order.options.batch_size == end - 1
    assert order.epoch_end(order.options.epochs - 1) == order.steps


@given(orders, st.integers(0, 100))
def test_any_step_can_be_asked_for(order, step):
    np.testing.assert_array_equal(order.draws(step), ExampleOrder(*order).draws(step))


def test_epochs_and_seeds_have_orders_of_their_own():
    order = order_of(50, 3, 50)
    orders = [tuple(order.draws(step)[:, 1]) for step in range(3)]
    orders.append(tuple(order_of(50, 3, 50, seed=1).draws(0)[:, 1]))
    assert len(set(orders)) == 4


def test_a_batch_holds_its_images_padded_with_ignored_pixels(opened, pixels):
    order = order_of(3, 2, 3)
    batch = pixels.batch(order.draws(1), order)
    assert batch.images.shape == (3, 25, 30, 3) and batch.labels.shape == (3, 25, 30)
    np.testing.assert_array_equal(batch.draws, order.draws(1))
    assert not batch.originals.any()
    for place, index in enumerate(order.draws(1)[:, 1].tolist()):
        height, width = SIZES_PX[index]
        image, labels = scene(SIZES_PX[index], index)
        np.testing.assert_array_equal(batch.sizes_px[place], (height, width))
        np.testing.assert_array_equal(batch.images[place, :height, :width], image)
        np.testing.assert_array_equal(batch.labels[place, :height, :width], labels)
        outside = np.ones((25, 30), bool)
        outside[:height, :width] = False
        assert (batch.labels[place][outside] == IGNORE).all() and (batch.images[place][outside] == 0).all()


@pytest.mark.parametrize("first", [0, 1, 4])
def test_batches_from_a_step_on_are_those_of_the_whole(pixels, first):
    order = order_of(3, 4, 2, copies=1)
    whole, rest = (list(batches_from(pixels, order, start)) for start in (0, first))
    assert len(whole) == order.steps == 12 and len(rest) == order.steps - first
    for ours, expected in zip(rest, whole[first:], strict=True):
        assert all(np.array_equal(one, other) for one, other in zip(ours, expected, strict=True))


def test_a_cache_that_is_full_changes_nothing(opened, pixels):
    order = order_of(3, 2, 4)
    small = ExampleReader(opened.train, opened.lookup, cache_bytes=2500)
    for step in range(order.steps):
        for ours, expected in zip(*(reader.batch(order.draws(step), order) for reader in (small, pixels)), strict=True):
            np.testing.assert_array_equal(ours, expected)
    assert sum(array.nbytes for raw in small._kept.values() for array in raw[:2]) <= 2500


def crops_of(pixels: ExampleReader, order: ExampleOrder) -> dict[tuple[int, int], np.ndarray]:
    """The crop drawn for each (epoch, example), as the step draws it."""
    fill, key = (0.0, 0.0, 0.0), jax.random.key(3)

    @jax.jit
    def one(image, labels, size_px, draw, original):
        drawn = jax.random.fold_in(jax.random.fold_in(key, draw[0]), draw[1])
        return augment(drawn, image, labels, size_px, original, order.options.augmentation, fill).image

    found = {}
    for step in range(order.steps):
        batch = pixels.batch(order.draws(step), order)
        for place, draw in enumerate(order.draws(step).tolist()):
            found[tuple(draw)] = np.asarray(one(*(array[place] for array in batch[:5])))
    return found


def test_fixed_copies_are_the_same_in_every_epoch_and_the_first_is_the_image(pixels):
    order = order_of(3, 2, 3, copies=2)
    crops = crops_of(pixels, order)
    assert len(crops) == 2 * 9
    for example in range(9):
        np.testing.assert_array_equal(crops[0, example], crops[1, example])
    # The last image has the size of the crop: there, the original comes through as it is.
    np.testing.assert_array_equal(crops[0, 6], scene(SIZES_PX[2], 2)[0])
    different = {crops[0, example].tobytes() for example in range(9)}
    assert len(different) == 9


def test_without_copies_each_epoch_draws_anew(pixels):
    crops = crops_of(pixels, order_of(3, 2, 3))
    assert not any(np.array_equal(crops[0, example], crops[1, example]) for example in range(3))


def test_an_image_that_is_gone_is_reported(opened, tmp_path):
    lost = opened.train[0]._replace(image=Path(tmp_path / "gone.png"))
    with pytest.raises(JaxmapError, match=r"gone\.png"):
        list(batches_from(ExampleReader((lost,), opened.lookup), order_of(1, 1, 1), 0))
