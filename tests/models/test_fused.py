"""Convolutions by the compiled kernel are those of the plain form, in values and in gradients."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from golden.seeded_weights import seeded_image, seeded_weights

from jaxmap.models.architecture import folded, torch_architecture
from jaxmap.models.backbones import InvertedResidual
from jaxmap.models.fused import apply_fused
from jaxmap.models.layers import ConvBlock, SeparableBlock
from jaxmap.models.network import inference_network
from jaxmap.native.build import TARGET, has_kernel

RECORD = folded(torch_architecture("mobilenet_v2", ("one", "two")))
SAME = folded(torch_architecture("efficientnet_lite0", ("one", "two")))

MODULES = {
    "expanded, with a shortcut": (lambda: InvertedResidual(16, 16, 6, 1, 1, RECORD), (2, 9, 13, 16)),
    "odd channels, stride 2": (lambda: InvertedResidual(5, 7, 3, 2, 1, RECORD), (1, 17, 12, 5)),
    "5x5, stride 2, padded as TensorFlow does": (lambda: InvertedResidual(8, 24, 6, 2, 1, SAME, 5), (1, 14, 11, 8)),
    "dilated": (lambda: InvertedResidual(24, 40, 6, 1, 4, RECORD), (1, 20, 22, 24)),
    "not expanded": (lambda: InvertedResidual(32, 16, 1, 1, 1, RECORD), (1, 40, 33, 32)),
    "separable, dilated beyond the image": (lambda: SeparableBlock(20, 33, dilation=12, norm="bias"), (1, 8, 9, 20)),
    "separable, norm inside": (lambda: SeparableBlock(16, 8, norm="bias", norm_inside=True), (1, 9, 9, 16)),
    "1x1, more inputs than are summed in one go": (lambda: ConvBlock(700, 200, norm="bias"), (1, 15, 15, 700)),
    "1x1, stride 2, no bias": (lambda: ConvBlock(6, 3, stride=2, norm="none", activation="none"), (2, 9, 10, 6)),
    "dense, as the stem": (lambda: ConvBlock(3, 32, 3, stride=2, norm="bias", activation="relu6"), (1, 31, 40, 3)),
    "dense, dilated": (lambda: ConvBlock(9, 10, 3, dilation=3, norm="bias"), (1, 12, 12, 9)),
}


@pytest.fixture
def kernel():
    """Skips where the kernel cannot be compiled."""
    if not has_kernel():
        pytest.skip("no C++ compiler, or no CPU")


def filled(name):
    """The module with random weights, and images."""
    make, shape = MODULES[name]
    module, draw = make(), np.random.default_rng(0)
    state = jax.tree.map(lambda array: jnp.asarray(draw.normal(0, 0.3, array.shape), jnp.float32), nnx.state(module))
    nnx.update(module, state)
    return module, jnp.asarray(draw.normal(0, 2, shape), jnp.float32)


def calls_kernel(function, *arguments) -> bool:
    return TARGET in jax.jit(function).lower(*arguments).as_text()


@pytest.mark.parametrize("name", MODULES)
def test_the_kernel_computes_the_plain_form(kernel, name):
    module, images = filled(name)
    assert calls_kernel(lambda images: apply_fused(module, images), images)
    result, wanted = apply_fused(module, images), module.plain(images)
    assert result.shape == wanted.shape
    np.testing.assert_allclose(result, wanted, rtol=1e-5, atol=2e-5 * float(jnp.abs(wanted).max()))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["expanded, with a shortcut", "separable, dilated beyond the image"])
def test_gradients_are_those_of_the_plain_form(kernel, name):
    module, images = filled(name)
    graph, state = nnx.split(module)

    def loss(plain, state, images):
        module = nnx.merge(graph, state)
        return (module.plain(images) if plain else module(images)).sum()

    wanted, result = (jax.grad(lambda *given, plain=plain: loss(plain, *given), (0, 1)) for plain in (True, False))
    jax.tree.map(np.testing.assert_array_equal, result(state, images), wanted(state, images))


def test_nothing_that_is_not_a_number_is_lost(kernel):
    module, images = filled("expanded, with a shortcut")
    result = apply_fused(module, images.at[0, 4, 6, 3].set(jnp.nan))
    seen = np.isnan(result[0]).any(-1)
    assert seen[3:6, 5:8].all() and seen.sum() == 9 and not np.isnan(result[1]).any()


def test_several_networks_at_once_are_each_alone(kernel):
    module, images = filled("odd channels, stride 2")
    graph, state = nnx.split(module)
    several = jax.tree.map(lambda array: jnp.stack([array, 2 * array]), state)
    both = jax.vmap(lambda state: apply_fused(nnx.merge(graph, state), images))(several)
    for index, one in enumerate(both):
        alone = nnx.merge(graph, jax.tree.map(lambda array, index=index: array[index], several))
        np.testing.assert_array_equal(one, apply_fused(alone, images))


@pytest.mark.parametrize("why", ["turned off", "double precision", "few pixels"])
def test_otherwise_the_plain_form_computes(monkeypatch, why):
    module, images = filled("expanded, with a shortcut")
    if why == "turned off":
        monkeypatch.setenv("JAXMAP_NATIVE", "0")
    if why == "few pixels":
        images = images[:, :3, :3]
    with jax.enable_x64(why == "double precision"):
        given = images.astype(jnp.float64) if why == "double precision" else images
        assert not calls_kernel(lambda images: module(images), given)


@pytest.mark.slow
@pytest.mark.parametrize("backbone", ["mobilenet_v2", "efficientnet_lite0", "resnet18"])
def test_networks_have_the_same_logits(kernel, monkeypatch, backbone):
    architecture = replace(torch_architecture(backbone, ("one", "two", "three")), head_channels=32)
    network = inference_network(architecture, seeded_weights(architecture))
    images = jnp.asarray(seeded_image(65, 97))[None]

    def logits():
        # Another function each time: a program that was traced before would be used again.
        return jax.jit(lambda weights: network.apply(weights, images))(network.weights)

    fused = logits()
    monkeypatch.setenv("JAXMAP_NATIVE", "0")
    np.testing.assert_allclose(fused, logits(), rtol=0, atol=1e-3 * max(1.0, float(jnp.abs(fused).max())) / 10)
