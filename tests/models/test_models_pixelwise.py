"""Logits at the pixels equal those that are resized step by step, whatever the sizes."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import SMALL
from reference_pixelwise import pixel_logits

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import tf_architecture
from jaxmap.models.convolutions import resize_bilinear, resize_rows
from jaxmap.models.pixelwise import check_size, map_pixels, resized_input, resized_output, upsampling

ARCHITECTURES = {
    "torch": SMALL,
    "tensorflow": tf_architecture("mobilenet_v2", ("a", "b"), decoder=False),
    "half pixels": replace(SMALL, align_corners=False),
}


@pytest.mark.parametrize("name", ARCHITECTURES)
@pytest.mark.parametrize("size_px", [None, (50, 64), (9, 21), (1, 1)], ids=str)
# More columns than one band and more rows than one block, and neither whole.
@pytest.mark.parametrize(("coarse_px", "image_px"), [((3, 10), (18, 150)), ((1, 1), (3, 2))], ids=str)
def test_pixels_equal_the_twin(name, size_px, coarse_px, image_px):
    architecture = ARCHITECTURES[name]
    coarse = np.random.default_rng(0).normal(size=(*coarse_px, 2)).astype(np.float32)
    places = upsampling(architecture, coarse_px, image_px, size_px)
    ours = np.stack(map_pixels(lambda logits: (logits[:, 0], logits[:, 1]), jnp.asarray(coarse), places), axis=-1)
    np.testing.assert_allclose(ours, pixel_logits(architecture, coarse, image_px, size_px), atol=2e-5)


@given(st.integers(1, 40), st.integers(1, 40), st.booleans())
@settings(max_examples=12)
def test_the_matrix_of_an_axis_resizes_it(source, target, align_corners):
    line = np.random.default_rng(source).normal(size=source).astype(np.float32)
    matrix = resize_rows(np.eye(source), target, align_corners=align_corners)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-6)
    assert matrix.min() >= -1e-9 and (matrix > 1e-9).sum(axis=1).max() <= 2
    resized = resize_bilinear(jnp.asarray(line)[None, :, None, None], target, 1, align_corners=align_corners)
    np.testing.assert_allclose(matrix @ line, resized[0, :, 0, 0], atol=1e-5)


def test_nothing_is_resized_where_no_size_is_given():
    image = jnp.zeros((1, 2, 3, 3), jnp.uint8)
    assert resized_input(image, None) is image
    logits = jnp.asarray(np.random.default_rng(0).normal(size=(1, 4, 5, 2)), jnp.float32)
    np.testing.assert_array_equal(resized_output(logits, (4, 5)), logits)


def test_the_logits_of_all_pixels_are_never_held_at_once():
    places = upsampling(SMALL, (96, 128), (384, 512), None)

    def likeliest(coarse):
        return map_pixels(lambda logits: (logits.max(axis=1),), coarse, places)[0]

    coarse = jnp.zeros((96, 128, 21))
    everything = 4 * 384 * 512 * 21
    for function in (likeliest, jax.grad(lambda coarse: likeliest(coarse).sum())):
        memory = jax.jit(function).lower(coarse).compile().memory_analysis()
        assert memory.temp_size_in_bytes < everything / 4


@pytest.mark.parametrize("size_px", [(0, 4), (4, -1)])
def test_a_size_that_is_none_is_refused(size_px):
    with pytest.raises(JaxmapError, match=r"size .* in here; give a height and a width above 0"):
        check_size(size_px, "here")
    check_size(None, "here")
