"""Logits at the pixels equal those that are resized step by step, whatever the sizes."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import SMALL
from reference_pixelwise import pixel_logits

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import tf_architecture
from jaxmap.models.pixelwise import check_size, map_pixels, resized_input, resized_output, upsampling

ARCHITECTURES = {
    "torch": SMALL,
    "tensorflow": tf_architecture("mobilenet_v2", ("a", "b"), decoder=False),
    "half pixels": replace(SMALL, align_corners=False),
}


# More columns than one band and more rows than one block, and neither whole.
LARGE, LEAST = ((3, 10), (18, 150)), ((1, 1), (3, 2))


@pytest.mark.parametrize(
    ("name", "size_px", "shapes"),
    [
        *((name, None, LARGE) for name in ARCHITECTURES),
        *((name, (50, 64), LARGE) for name in ARCHITECTURES),
        ("torch", (9, 21), LARGE),
        ("torch", (1, 1), LARGE),
        ("tensorflow", None, LEAST),
        ("half pixels", (9, 21), LEAST),
    ],
)
def test_pixels_equal_the_twin(name, size_px, shapes):
    coarse_px, image_px = shapes
    architecture = ARCHITECTURES[name]
    coarse = np.random.default_rng(0).normal(size=(*coarse_px, 2)).astype(np.float32)
    places = upsampling(architecture, coarse_px, image_px, size_px)
    compiled = jax.jit(lambda coarse: map_pixels(lambda logits: (logits[:, 0], logits[:, 1]), coarse, places))
    ours = np.stack(compiled(coarse), axis=-1)
    np.testing.assert_allclose(ours, pixel_logits(architecture, coarse, image_px, size_px), atol=2e-5)


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
