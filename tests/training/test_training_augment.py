"""Augmentation against its slow twin, and the laws it keeps: masks stay exact, colours stay on their masks."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_augment
from compiling import compiled_quickly
from hypothesis import assume, given
from hypothesis import strategies as st

from jaxmap.labels import IGNORE
from jaxmap.training.augment import (
    Crop,
    CropWindow,
    augment,
    change_light,
    cut,
    cut_nearest,
    cut_relief,
    disturb_relief,
    draw_pixel,
    draw_window,
    whole_window,
)
from jaxmap.training.options import AugmentationOptions

quickly = pytest.fixture(scope="module", autouse=True)(compiled_quickly)

STORED_PX = (20, 24)
"""Images are padded to this, so that each function is compiled once for all sizes."""
SIZES_PX = ((20, 24), (10, 24), (20, 9))
CROP_PX = (16, 19)
FILL = (12.0, 100.0, 240.0)
OPTIONS = AugmentationOptions(crop_px=CROP_PX, scale=(0.4, 2.5))
LIGHT = replace(OPTIONS, brightness=0.5, contrast=0.5, saturation=0.5, gamma=0.5, hue_rad=0.5, noise=9.0)

fast_cut = jax.jit(partial(cut, crop_px=CROP_PX, fill=FILL))
fast_relief = jax.jit(partial(cut_relief, crop_px=CROP_PX))
disturb = jax.jit(partial(disturb_relief, strength=0.3))
fast_draw = jax.jit(partial(draw_window, options=OPTIONS))
around_draw = jax.jit(partial(draw_window, options=replace(OPTIONS, class_share=1.0)))
draw_pixels = jax.jit(jax.vmap(draw_pixel, in_axes=(0, None, None)))
fast_augment = jax.jit(partial(augment, options=OPTIONS, fill=FILL))
SEEING = replace(OPTIONS, scale=(1.0, 1.0), drop_relief=0.25, drop_image=0.25)
lit_augment = jax.jit(jax.vmap(partial(augment, options=LIGHT, fill=FILL)))
"""Of two examples at once."""

sizes = st.tuples(st.integers(1, STORED_PX[0]), st.integers(1, STORED_PX[1]))
scales = st.floats(0.25, 4.0, width=32)
offsets = st.tuples(st.integers(-20, 40), st.integers(-20, 40))
seeds = st.integers(0, 2**31 - 1)


@jax.jit
@partial(jax.vmap, in_axes=(0, None, None))
def seeing_augment(key: jax.Array, image: jax.Array, relief: jax.Array) -> Crop:
    """Of one example with relief, under many keys."""
    labels, size_px = jnp.zeros(STORED_PX, jnp.uint8), jnp.array(STORED_PX)
    return augment(key, image, labels, size_px, jnp.array(False), SEEING, FILL, relief)


def view_of(scale: float, offset_px: tuple[int, int], mirrored: bool) -> CropWindow:
    return CropWindow(jnp.float32(scale), jnp.array(offset_px, jnp.int32), jnp.array(mirrored))


def example(size_px: tuple[int, int], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """An image and its labels, 0 to 4 and `IGNORE`; the padding is white, of label 99."""
    draw = np.random.default_rng(seed)
    image = np.full((*STORED_PX, 3), 255, np.uint8)
    labels = np.full(STORED_PX, 99, np.uint8)
    image[: size_px[0], : size_px[1]] = draw.integers(0, 200, (*size_px, 3))
    labels[: size_px[0], : size_px[1]] = draw.choice([0, 1, 2, 3, 4, IGNORE], size_px)
    return image, labels


def cut_of(view: CropWindow, image: np.ndarray, labels: np.ndarray, size_px: tuple[int, int]) -> tuple[np.ndarray, ...]:
    return tuple(map(np.asarray, fast_cut(view, image, labels, np.array(size_px, np.int32))))


def lit(*words: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Crops and labels of two examples of (seed, image, labels, size, original), in changed light."""
    seeds, images, labels, sizes_px, originals = zip(*words, strict=True)
    keys = jax.vmap(jax.random.key)(np.array(seeds))
    arrays = map(np.array, (images, labels, np.array(sizes_px, np.int32), originals))
    crops = lit_augment(keys, *arrays)
    return np.asarray(crops.image), np.asarray(crops.labels)


def coded(size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """An image in bands of flat colour by label: red is 50 for each label."""
    rows, columns = np.indices(STORED_PX)
    labels = ((rows // 4 + columns // 5) % 4).astype(np.uint8)
    labels[size_px[0] :], labels[:, size_px[1] :] = 99, 99
    return np.stack([50 * labels, 0 * labels, 0 * labels], axis=-1).astype(np.uint8), labels


@given(sizes, scales, offsets, st.booleans(), seeds)
def test_a_cut_is_its_slow_twin(size_px, scale, offset_px, mirrored, seed):
    image, labels = example(size_px, seed)
    crop, near = cut_of(view_of(scale, offset_px, mirrored), image, labels, size_px)
    colours, expected = reference_augment.cut(scale, offset_px, mirrored, image, labels, size_px, CROP_PX, FILL)
    np.testing.assert_array_equal(near, expected)
    np.testing.assert_allclose(crop, colours, atol=1e-3)


@given(sizes, scales, offsets, st.booleans(), seeds)
def test_no_label_comes_out_that_was_not_there(size_px, scale, offset_px, mirrored, seed):
    image, labels = example(size_px, seed)
    crop, near = cut_of(view_of(scale, offset_px, mirrored), image, labels, size_px)
    assert set(np.unique(near)) <= {*np.unique(labels[: size_px[0], : size_px[1]]), IGNORE}
    # Colours lie between those of the image: its padding, 255, shines through nowhere.
    filled = (crop == np.array(FILL, np.float32)).all(axis=-1)
    assert (near[filled & (near != IGNORE)] <= 4).all()
    assert crop[~filled].max(initial=0) < 200


@given(sizes, scales, offsets, st.booleans(), seeds)
def test_a_cut_of_relief_is_its_slow_twin(size_px, scale, offset_px, mirrored, seed):
    relief = np.random.default_rng(seed).standard_normal((5, 6, 2)).astype(np.float32)
    # Halfway between two pixels of relief, whether they lie inside depends on the last bit.
    edges = [(4 * np.arange(5) + 2 + start) / scale / 4 for start in offset_px]
    assume(
        all(
            abs(np.append(places, places - size / 4) % 1).min() > 1e-3
            for places, size in zip(edges, size_px, strict=True)
        )
    )
    part = fast_relief(view_of(scale, offset_px, mirrored), relief, size_px=np.array(size_px, np.int32))
    expected = reference_augment.cut_relief(scale, offset_px, mirrored, relief, size_px, CROP_PX)
    np.testing.assert_allclose(part, expected, atol=1e-4)


@given(st.floats(0.5, 2.0, width=32), st.tuples(st.integers(0, 8), st.integers(0, 8)), st.booleans())
def test_relief_stays_on_its_image(scale, offset_px, mirrored):
    """Both show a ramp; so do their crops, one at every fourth place of the other."""
    rows, columns = np.indices(STORED_PX)
    ramp = np.stack([5 * rows, 5 * columns, 0 * rows], axis=-1)
    window = view_of(scale, offset_px, mirrored)
    crop, near = cut_of(window, ramp.astype(np.uint8), np.zeros(STORED_PX, np.uint8), STORED_PX)
    relief = ramp.reshape(5, 4, 6, 4, 3).mean(axis=(1, 3)).astype(np.float32)
    part = np.asarray(fast_relief(window, relief, size_px=np.array(STORED_PX, np.int32)))
    means = crop[:16, :16].reshape(4, 4, 4, 4, 3).mean(axis=(1, 3))
    whole = (near[:16, :16] == 0).reshape(4, 4, 4, 4).all(axis=(1, 3))
    # Not at the edge of the image, where the ramp of the relief ends half a pixel of relief earlier.
    inner = whole & (means[..., :2] > 15).all(axis=-1) & (means[..., :2] < 5 * np.array(STORED_PX) - 20).all(axis=-1)
    np.testing.assert_allclose(part[:4, :4][inner], means[inner], atol=0.02)


@given(seeds)
def test_disturbed_relief_stays_unknown_where_it_was(seed):
    draw = np.random.default_rng(seed)
    relief = draw.standard_normal((5, 6, 4)).astype(np.float32)
    relief[..., -1] = draw.random((5, 6)) < 0.7
    relief *= relief[..., -1:]
    changed = np.asarray(disturb(jax.random.key(seed), relief))
    hole = changed[..., -1] != relief[..., -1]
    assert (changed[hole] == 0).all() and (changed[relief[..., -1] == 0] == 0).all() and hole.mean() < 0.6
    error = (changed - relief)[~hole & (relief[..., -1] > 0)]
    assert (np.abs(error[..., :-1]) < 0.3 * 6).all() and (error[..., -1] == 0).all()


@pytest.mark.slow
def test_either_input_is_dropped_but_not_both():
    image = np.full((*STORED_PX, 3), 90, np.uint8)
    known, unknown = np.ones((5, 6, 3), np.float32), np.zeros((5, 6, 3), np.float32)
    keys = jax.random.split(jax.random.key(0), 400)
    crops = [seeing_augment(keys, image, relief) for relief in (known, unknown)]
    flat, blind = ((np.asarray(crop.image) == FILL).all(axis=(1, 2, 3)) for crop in crops)
    dropped = ~np.asarray(crops[0].relief).any(axis=(1, 2, 3))
    assert abs(flat.mean() - 0.25) < 0.08 and abs(dropped.mean() - 0.25) < 0.08
    assert not (flat & dropped).any() and not blind.any()
    assert (np.asarray(crops[0].image)[~flat] == 90).all() and (np.asarray(crops[0].relief)[~dropped] == 1).all()


@given(sizes, scales, offsets, st.booleans())
def test_what_lies_outside_is_fill_and_carries_no_label(size_px, scale, offset_px, mirrored):
    image, labels = np.zeros((*STORED_PX, 3), np.uint8), np.ones(STORED_PX, np.uint8)
    crop, near = cut_of(view_of(scale, offset_px, mirrored), image, labels, size_px)
    outside = near == IGNORE
    assert (near[~outside] == 1).all()
    np.testing.assert_array_equal(crop[outside], np.broadcast_to(np.array(FILL, np.float32), crop[outside].shape))
    assert (crop[~outside] == 0).all()


@given(seeds, st.booleans())
def test_ignored_pixels_stay_ignored(seed, mirrored):
    image, labels = example(STORED_PX, seed)
    _, near = cut_of(view_of(2.0, (3, 5), mirrored), image, labels, STORED_PX)
    _, marked = cut_of(view_of(2.0, (3, 5), mirrored), image, (labels == IGNORE).astype(np.uint8), STORED_PX)
    np.testing.assert_array_equal(near == IGNORE, marked == 1)


@given(st.tuples(st.integers(0, 4), st.integers(0, 5)), seeds)
def test_the_view_that_changes_nothing_gives_the_very_crop(offset_px, seed):
    image, labels = example(STORED_PX, seed)
    crop, near = cut_of(view_of(1.0, offset_px, False), image, labels, STORED_PX)
    rows, columns = (slice(start, start + count) for start, count in zip(offset_px, CROP_PX, strict=True))
    np.testing.assert_array_equal(crop, image[rows, columns])
    np.testing.assert_array_equal(near, labels[rows, columns])


@given(scales, offsets, seeds)
def test_mirroring_the_image_and_the_view_is_no_change(scale, offset_px, seed):
    image, labels = example(STORED_PX, seed)
    plain = cut_of(view_of(scale, offset_px, False), image, labels, STORED_PX)
    again = cut_of(view_of(scale, offset_px, True), image[:, ::-1], labels[:, ::-1], STORED_PX)
    np.testing.assert_allclose(again[0], plain[0], atol=0.02)
    # Halfway between two pixels, "nearest" rounds to the right one on either side of the mirror.
    columns = (np.arange(CROP_PX[1]) + offset_px[1] + 0.5) / scale - 0.5
    clear = np.abs(columns % 1 - 0.5) > 1e-3
    np.testing.assert_array_equal(again[1][:, clear], plain[1][:, clear])


@given(seeds)
def test_mirroring_twice_is_no_change(seed):
    image, labels = example(CROP_PX, seed)
    once = cut_of(view_of(1.0, (0, 0), True), image, labels, CROP_PX)
    np.testing.assert_array_equal(once[1], labels[: CROP_PX[0], : CROP_PX[1]][:, ::-1])
    padded, padded_labels = np.zeros_like(image), np.zeros_like(labels)
    padded[: CROP_PX[0], : CROP_PX[1]], padded_labels[: CROP_PX[0], : CROP_PX[1]] = once
    twice = cut_of(view_of(1.0, (0, 0), True), padded, padded_labels, CROP_PX)
    np.testing.assert_array_equal(twice[0], image[: CROP_PX[0], : CROP_PX[1]])
    np.testing.assert_array_equal(twice[1], labels[: CROP_PX[0], : CROP_PX[1]])


@given(sizes, scales, offsets, st.booleans())
def test_colours_stay_on_their_labels(size_px, scale, offset_px, mirrored):
    image, labels = coded(size_px)
    crop, near = cut_of(view_of(scale, offset_px, mirrored), image, labels, size_px)
    seen = near != IGNORE
    # Within half a step of the colour's own label, or on the border of two bands.
    low, high = crop[seen][:, 0] // 50, -(-crop[seen][:, 0] // 50)
    # Between labels 1 and 3 the colour passes that of 2: only where it does not change is it a label's own.
    colour, around = crop[..., 0], np.pad(crop[..., 0], 1, mode="edge")
    even = np.all([np.isclose(around[1:-1, :-2], colour), np.isclose(around[1:-1, 2:], colour)], axis=0)
    even &= np.all([np.isclose(around[:-2, 1:-1], colour), np.isclose(around[2:, 1:-1], colour)], axis=0)
    flat = np.isclose(crop[seen][:, 0] % 50, 0, atol=1e-3) & even[seen]
    np.testing.assert_array_equal(np.rint(crop[seen][:, 0][flat] / 50), near[seen][flat])
    assert ((near[seen] >= low - 3) & (near[seen] <= high + 3)).all()


@given(sizes, st.tuples(st.integers(1, 40), st.integers(1, 40)))
def test_the_whole_window_shows_the_whole_image_in_the_middle(size_px, crop_px):
    view = whole_window(np.array(size_px), crop_px)
    assume(min(size_px) * float(view.scale) >= 1)
    lying = [
        np.array([reference_augment.position(i, int(view.offset_px[axis]), float(view.scale), size_px[axis], False)
                  for i in range(crop_px[axis])])
        for axis in (0, 1)
    ]  # fmt: skip
    fits = []
    for places, size in zip(lying, size_px, strict=True):
        inside = (np.floor(places + 0.5) >= 0) & (np.floor(places + 0.5) < size)
        step = 1 / float(view.scale)
        assert inside.any()
        assert places[inside][0] <= step and places[inside][-1] >= size - 1 - step, "from the first to the last pixel"
        before, after = np.argmax(inside), np.argmax(inside[::-1])
        assert abs(before - after) <= 1, "in the middle"
        fits.append(before + after <= 1)
    assert any(fits), "as large as it goes"
    assert not bool(view.mirrored)


@pytest.mark.slow
@given(sizes, seeds, st.sampled_from([fast_draw, around_draw]))
def test_a_drawn_view_lies_on_its_image_or_the_image_in_it(size_px, seed, draw):
    view = draw(jax.random.key(seed), example(size_px, seed)[1], jnp.array(size_px))
    assert OPTIONS.scale[0] <= float(view.scale) < OPTIONS.scale[1]
    for offset, size, count in zip(view.offset_px.tolist(), size_px, CROP_PX, strict=True):
        scaled = int(np.floor(np.float32(size) * np.float32(view.scale)))
        assert min(scaled - count, 0) <= offset <= max(scaled - count, 0)


def test_draws_reach_all_that_they_may():
    fixed = replace(OPTIONS, scale=(1.0, 1.0))

    @jax.jit
    @jax.vmap
    def draw(key: jax.Array) -> tuple[CropWindow, CropWindow]:
        size_px, labels = jnp.array([24, 30]), jnp.zeros((24, 30), jnp.uint8)
        still = replace(OPTIONS, mirror=False)
        return draw_window(key, labels, size_px, fixed), draw_window(key, labels, size_px, still)

    views, never = draw(jax.random.split(jax.random.key(0), 400))
    assert set(views.offset_px[:, 0].tolist()) == set(range(24 - CROP_PX[0] + 1))
    assert set(views.offset_px[:, 1].tolist()) == set(range(30 - CROP_PX[1] + 1))
    assert 0.4 < views.mirrored.mean() < 0.6
    assert not never.mirrored.any()
    assert never.scale.min() < 0.5 and never.scale.max() > 2.4


@pytest.mark.slow
@given(sizes, seeds)
def test_drawn_pixels_are_of_all_classes_of_the_image_evenly(size_px, seed):
    _, labels = example(size_px, seed)
    labels[0, 0] = 200  # A class of one pixel.
    rows, columns = draw_pixels(jax.random.split(jax.random.key(seed), 400), labels, np.array(size_px))
    drawn = labels[np.asarray(rows), np.asarray(columns)]
    held = set(labels[: size_px[0], : size_px[1]].ravel().tolist()) - {IGNORE}
    assert set(drawn.tolist()) == held
    spread = 5 * np.sqrt(400 / len(held))
    assert all(abs((drawn == one).sum() - 400 / len(held)) < spread for one in held)


def test_a_pixel_of_an_image_without_labels_is_its_first():
    labels = np.full(STORED_PX, IGNORE, np.uint8)
    rows, columns = draw_pixels(jax.random.split(jax.random.key(0), 400), labels, np.array(STORED_PX))
    assert not rows.any() and not columns.any()


@pytest.mark.slow
def test_crops_around_classes_hold_what_is_rare():
    labels = jnp.zeros((64, 80), jnp.uint8).at[50, 7].set(2)
    size_px, enlarged = np.array(labels.shape), replace(OPTIONS, scale=(1.0, 2.0))

    def held(class_share: float) -> float:
        @jax.jit
        @jax.vmap
        def rare(key: jax.Array) -> jax.Array:
            window = draw_window(key, labels, size_px, replace(enlarged, class_share=class_share))
            return (cut_nearest(window, labels, size_px, CROP_PX, IGNORE) == 2).any()

        return float(rare(jax.random.split(jax.random.key(1), 300)).mean())

    assert held(0.0) < 0.15
    assert 0.4 < held(1.0) < 0.65, "one of two classes is chosen"


@pytest.mark.slow
def test_the_same_key_is_the_same_example_whatever_stands_beside_it():
    words = [(seed, *example(size_px, seed), size_px, False) for seed, size_px in enumerate(SIZES_PX)]
    for one in words:
        alone = lit(one, one)
        np.testing.assert_array_equal(alone[0][0], alone[0][1])
        for other in words:
            together = lit(one, other)
            np.testing.assert_array_equal(together[0][0], alone[0][0])
            np.testing.assert_array_equal(together[1][0], alone[1][0])
    anew = lit(words[0], (9, *words[0][1:]))
    assert not np.array_equal(anew[0][0], anew[0][1])


@given(sizes, seeds)
def test_light_leaves_labels_and_fill_alone(size_px, seed):
    image, labels = example(size_px, seed)
    plain, near, _ = fast_augment(jax.random.key(seed), image, labels, np.array(size_px, np.int32), np.array(False))
    (crop, _), (labels, _) = lit(*[(seed, image, labels, size_px, False)] * 2)
    np.testing.assert_array_equal(near, labels)
    filled = (np.asarray(plain) == np.array(FILL, np.float32)).all(axis=-1)
    np.testing.assert_array_equal(crop[filled], np.asarray(plain)[filled])
    assert crop.min() >= 0 and crop.max() <= 255


def test_an_original_is_the_image_itself_in_its_own_light():
    image, labels = example(CROP_PX, 3)
    words = (3, image, labels, CROP_PX)
    (crop, drawn), (near, _) = lit((*words, True), (*words, False))
    np.testing.assert_array_equal(crop, image[: CROP_PX[0], : CROP_PX[1]])
    np.testing.assert_array_equal(near, labels[: CROP_PX[0], : CROP_PX[1]])
    assert not np.array_equal(drawn, crop)


CHANGES = ("brightness", "contrast", "saturation", "gamma", "hue_rad", "noise", "tint")
COLOURS = np.random.default_rng(0).uniform(0, 255, (6, 7, 3)).astype(np.float32)


def test_light_that_is_off_changes_nothing():
    np.testing.assert_array_equal(change_light(jax.random.key(0), COLOURS, AugmentationOptions()), COLOURS)


@pytest.mark.parametrize("change", CHANGES)
def test_a_small_change_of_light_is_a_small_change_of_colours(change):
    lit = change_light(jax.random.key(1), COLOURS, replace(AugmentationOptions(), **{change: 1e-3}))
    assert 0 < np.abs(lit - COLOURS).max() < 1


@pytest.mark.parametrize("change", CHANGES)
def test_black_and_white_and_grey_stay_in_range(change):
    greys = np.repeat(np.linspace(0, 255, 12, dtype=np.float32)[:, None, None], 3, axis=-1)
    lit = np.asarray(change_light(jax.random.key(2), greys, replace(AugmentationOptions(), **{change: 2.0})))
    assert np.isfinite(lit).all() and lit.min() >= 0 and lit.max() <= 255
    if change in ("hue_rad", "saturation"):
        np.testing.assert_allclose(lit, greys, atol=1e-2)


def test_a_grey_camera_is_grey_with_its_noise():
    lit = np.asarray(change_light(jax.random.key(3), COLOURS, AugmentationOptions(grey=1.0, noise=9.0, tint=0.5)))
    assert (lit == lit[..., :1]).all() and lit[..., 0].std() > 1


def test_brightness_and_contrast_by_hand():
    only = AugmentationOptions(brightness=0.3)
    dim = 80 + COLOURS / 4
    factor = np.asarray(change_light(jax.random.key(4), dim, only)) / dim
    np.testing.assert_allclose(factor, factor.flat[0], rtol=1e-5)
    assert 1 / 1.3 <= factor.flat[0] <= 1.3
    luma = dim @ np.array([0.299, 0.587, 0.114], np.float32)
    lit = np.asarray(change_light(jax.random.key(5), dim, AugmentationOptions(contrast=0.1)))
    factor = (lit - luma.mean()) / (dim - luma.mean())
    np.testing.assert_allclose(factor, np.median(factor), rtol=1e-2)
    assert 1 / 1.1 <= np.median(factor) <= 1.1
