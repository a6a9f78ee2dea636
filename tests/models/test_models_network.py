"""Laws of whole networks: sizes, folding, determinism, one compilation, gradients."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from golden.seeded_weights import seeded_image, seeded_weights

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import BACKBONES, folded, tf_architecture, torch_architecture
from jaxmap.models.deeplab import (
    DeepLab,
    fold_batch_norm,
    make_network,
    network_weights,
    padded_size,
    pure_network,
    weight_shapes,
)
from jaxmap.models.backbones import InvertedResidual, ResidualUnit, XceptionUnit
from jaxmap.models.heads import Aspp, Decoder

CLASSES = ("background", "sand", "rock")
SMALL = replace(torch_architecture("mobilenet_v2", CLASSES), top_conv=False, head_channels=8, low_level_channels=4)


@pytest.fixture(scope="module")
def small():
    return pure_network(SMALL, seeded_weights(SMALL))


@pytest.fixture(scope="module")
def compiled(small):
    return jax.jit(small.apply)


@pytest.fixture(scope="module")
def image():
    return seeded_image(45, 61)[None]


def test_any_size_goes_in_and_comes_out(small, compiled, image):
    assert compiled(small.weights, image).shape == (1, 45, 61, 3)


def test_padding_is_nothing_but_more_pixels_of_the_mean(small, compiled, image):
    mean = np.asarray(SMALL.mean, np.float32) * 255
    padded = np.broadcast_to(mean, (1, 48, 64, 3)).copy()
    padded[:, :45, :61] = image
    whole = compiled(small.weights, padded)
    np.testing.assert_allclose(compiled(small.weights, image), whole[:, :45, :61], atol=1e-4)


def test_folding_changes_nothing(small, compiled, image):
    folded = pure_network(*fold_batch_norm(SMALL, small.weights))
    assert not any(".norm." in name for name in folded.weights)
    logits = compiled(small.weights, image)
    np.testing.assert_allclose(jax.jit(folded.apply)(folded.weights, image), logits, atol=1e-4)
    assert float(jnp.std(logits)) > 0.01


def test_evaluation_is_deterministic_and_compiles_once(small, image):
    traced = []
    compiled = jax.jit(lambda weights, images: (traced.append(images.shape), small.apply(weights, images))[1])
    first = compiled(small.weights, image)
    for _ in range(3):
        assert jnp.array_equal(first, compiled(small.weights, image))
    assert traced == [image.shape]


def test_the_batch_does_not_matter(small, compiled, image):
    both = jax.jit(small.apply)(small.weights, np.concatenate([image, image[:, ::-1]]))
    np.testing.assert_allclose(both[:1], compiled(small.weights, image), atol=1e-4)


def test_the_network_of_a_key_is_always_the_same():
    shapes = weight_shapes(SMALL)
    one, same, other = (network_weights(make_network(SMALL, jax.random.key(seed))) for seed in (1, 1, 2))
    assert {name: value.shape for name, value in one.items()} == shapes
    assert all(jnp.array_equal(one[name], same[name]) for name in shapes)
    assert not jnp.array_equal(one["backbone.stem.kernel"], other["backbone.stem.kernel"])


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize(("family", "stride"), [(torch_architecture, 8), (tf_architecture, 16)])
def test_every_backbone_has_the_right_strides(backbone, stride, family):
    architecture = family(backbone, CLASSES, output_stride=stride)
    network = nnx.eval_shape(lambda: DeepLab(architecture))
    sizes = [padded_size(size, architecture) for size in (50, 65)]
    images = jax.ShapeDtypeStruct((1, *sizes, 3), jnp.float32)
    features, low_level = nnx.eval_shape(lambda model, x: model.backbone(x), network, images)
    assert features.shape == (1, *(-(-size // stride) for size in sizes), network.backbone.channels)
    assert low_level.shape == (1, *(-(-size // 4) for size in sizes), network.backbone.low_level_channels)


def test_tensorflow_sizes_are_a_multiple_and_one():
    record = tf_architecture("mobilenet_v2", CLASSES)
    assert [padded_size(size, record) for size in (1, 17, 18, 512, 513)] == [17, 17, 33, 513, 513]
    record = torch_architecture("mobilenet_v2", CLASSES)
    assert [padded_size(size, record) for size in (1, 16, 17, 512)] == [16, 16, 32, 512]


@pytest.mark.parametrize(
    "make",
    [
        lambda: InvertedResidual(4, 4, 2, 1, 2, SMALL),
        lambda: ResidualUnit(4, 2, 2, (1, 2), replace(SMALL, padding="same"), bottleneck=True),
        lambda: XceptionUnit(4, (4, 4, 6), 2, 1, SMALL, shortcut="conv"),
        lambda: Aspp(4, replace(SMALL, atrous_rates=(2,), head_channels=4)),
    ],
    ids=["inverted residual", "bottleneck", "xception", "aspp"],
)
def test_gradients_equal_finite_differences(make):
    images = np.random.default_rng(0).normal(size=(1, 9, 8, 4))
    check_gradient(make, lambda model: model(jnp.asarray(images)))


@pytest.mark.parametrize("record", [SMALL, folded(SMALL)], ids=["batch norm", "folded"])
def test_gradients_of_the_decoder_equal_finite_differences(record):
    draw = np.random.default_rng(0)
    coarse, fine = draw.normal(size=(1, 2, 3, 8)), draw.normal(size=(1, 7, 9, 4))
    check_gradient(lambda: Decoder(4, record), lambda model: model(jnp.asarray(coarse), jnp.asarray(fine), jnp.tanh))


def check_gradient(make, call):
    with jax.enable_x64(True):
        graph, state = nnx.split(make())
        draw = np.random.default_rng(0)
        state = jax.tree.map(lambda value: value.astype(jnp.float64) + 0.3 * abs(draw.normal(size=value.shape)), state)

        @jax.jit
        def loss(state):
            result = call(nnx.merge(graph, state))
            result = result[0] if isinstance(result, tuple) else result
            return (result * jnp.cos(jnp.arange(result.size)).reshape(result.shape)).sum()

        leaves, tree = jax.tree.flatten(state)
        step = jax.tree.unflatten(tree, [draw.normal(size=leaf.shape) for leaf in leaves])
        gradient = jax.tree.leaves(jax.jit(jax.grad(loss))(state))
        backward = sum(float((one * other).sum()) for one, other in zip(gradient, jax.tree.leaves(step), strict=True))
        ahead, behind = (loss(jax.tree.map(lambda a, b, s=s: a + s * b, state, step)) for s in (1e-7, -1e-7))
    assert abs(backward) > 1e-3
    np.testing.assert_allclose((ahead - behind) / 2e-7, backward, rtol=1e-5)


def test_faults_of_an_architecture_are_reported_together():
    with pytest.raises(JaxmapError) as caught:
        replace(SMALL, backbone="vgg", output_stride=4, classes=("a", "a"), std=(1.0, 0.0, 1.0))
    for word in ("vgg", "output_stride is 4", "different printable names", "std.1 is 0.0"):
        assert word in str(caught.value)
