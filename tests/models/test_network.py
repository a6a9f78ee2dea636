"""Laws of whole networks: sizes, folding, determinism, one compilation, gradients by finite differences."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from golden.seeded_weights import seeded_image, seeded_weights
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import (
    BACKBONES,
    Architecture,
    folded,
    tf_architecture,
    torch_architecture,
    torchvision_architecture,
)
from jaxmap.models.backbones import InvertedResidual, ResidualUnit, XceptionUnit
from jaxmap.models.base import padded_size, placed_relief
from jaxmap.models.heads import Aspp, Decoder
from jaxmap.models.network import (
    KINDS,
    fold_batch_norm,
    inference_network,
    initial_weights,
    make_network,
    network_weights,
    pure_network,
    training_form,
    weight_shapes,
)

CLASSES = ("background", "sand", "rock")
SMALL = replace(torch_architecture("mobilenet_v2", CLASSES), top_conv=False, head_channels=8, low_level_channels=4)
slow = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize("relief_channels", [0, 2])
def test_a_small_network_keeps_the_laws(relief_channels):
    """Size, padding, batch, folding, the same bits twice, one compilation; no relief is relief of zeros."""
    # Of all backbones it compiles fastest.
    record = replace(SMALL, backbone="resnet18", atrous_rates=(2,), relief_channels=relief_channels)
    weights, image, traced = seeded_weights(record), seeded_image(45, 61)[None], []
    apply = pure_network(record, weights).apply
    compiled = jax.jit(lambda weights, images: (traced.append(images.shape), apply(weights, images))[1])
    logits = np.asarray(compiled(weights, image))
    assert logits.shape == (1, 45, 61, 3) and logits.std() > 0.01
    assert np.asarray(compiled(weights, image)).tobytes() == logits.tobytes()
    assert traced == [image.shape]
    # Padding is nothing but more pixels of the mean, and the other images of a batch do not matter.
    padded = np.broadcast_to(np.asarray(record.mean, np.float32) * 255, (2, 48, 64, 3)).copy()
    padded[:, :45, :61] = np.concatenate([image, image[:, ::-1]])
    np.testing.assert_allclose(compiled(weights, padded)[:1, :45, :61], logits, atol=1e-4)
    # Neither folding nor transformed kernels change anything.
    folded_record, fewer = fold_batch_norm(record, weights)
    assert set(fewer) == set(weight_shapes(folded_record)) and not any(".norm." in name for name in fewer)
    fast = inference_network(record, weights)
    assert sum(kernel.shape[:2] == (4, 4) for kernel in fast.weights.values()) == 10
    np.testing.assert_allclose(jax.jit(fast.apply)(fast.weights, image), logits, atol=1e-4)
    if relief_channels:
        zeros, other = (np.full((1, 24, 30, relief_channels), value, np.float32) for value in (0, 0.5))
        np.testing.assert_array_equal(jax.jit(apply)(weights, image, zeros), logits)
        assert np.abs(jax.jit(fast.apply)(fast.weights, image, other) - logits).max() > 1e-3
        trained = training_form(replace(record, dropout=0.0), ())
        key = jax.random.key(0)
        np.testing.assert_allclose(jax.jit(trained)(weights, image, key, zeros)[0], logits, atol=1e-4)


SEEING = replace(SMALL, relief_channels=2)


def test_relief_lies_on_the_pixels_of_the_decoder():
    images = (3, 45, 61, 3)
    assert placed_relief(None, images, SMALL) is None
    np.testing.assert_array_equal(placed_relief(None, images, SEEING), np.zeros((3, 12, 16, 2)))
    ramp = jnp.broadcast_to(jnp.arange(24.0)[:, None, None], (3, 24, 32, 2))
    placed = np.asarray(placed_relief(ramp, (3, 45, 50, 3), SEEING))
    np.testing.assert_allclose(
        placed[..., :13, :], np.broadcast_to(2 * np.arange(12)[:, None, None] + 0.5, (3, 12, 13, 2))
    )
    np.testing.assert_array_equal(placed[..., 13:, :], np.zeros((3, 12, 3, 2)))
    # The original's sizes are a multiple of the stride and one.
    odd = replace(tf_architecture("mobilenet_v2", CLASSES), relief_channels=2)
    assert np.asarray(placed_relief(ramp, (3, 500, 513, 3), odd)).shape == (3, 129, 129, 2)


@pytest.mark.parametrize(
    ("record", "shape", "reason"),
    [
        (SMALL, (1, 4, 4, 2), r"relief of shape \[1, 4, 4, 2\], the network sees no relief"),
        (SEEING, (1, 4, 4, 3), "the network sees relief of 1 images in 2 channels"),
        (SEEING, (2, 4, 4, 2), "the network sees relief of 1 images in 2 channels"),
        (SEEING, (4, 4, 2), "the network sees relief of 1 images in 2 channels"),
    ],
)
def test_relief_that_the_network_does_not_know_is_refused(record, shape, reason):
    with pytest.raises(JaxmapError, match=reason):
        placed_relief(jnp.zeros(shape), (1, 16, 16, 3), record)


def test_relief_needs_a_decoder():
    with pytest.raises(JaxmapError, match="relief without a decoder"):
        replace(SEEING, decoder=False)


def test_the_network_of_a_key_is_always_the_same():
    shapes = weight_shapes(SMALL)
    one, same, other = (
        {name: np.asarray(value) for name, value in network_weights(make_network(SMALL, jax.random.key(seed))).items()}
        for seed in (1, 1, 2)
    )
    assert {name: value.shape for name, value in one.items()} == shapes
    assert all(np.array_equal(one[name], same[name]) for name in shapes)
    assert not np.array_equal(one["backbone.stem.kernel"], other["backbone.stem.kernel"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["deeplab", "fcn", "segnet", "unet"])
def test_classifiers_start_with_logits_on_the_scale_of_the_features(kind):
    record = replace(torch_architecture("mobilenet_v2", CLASSES, kind=kind), top_conv=False)
    for name, kernel in initial_weights(record, jax.random.key(0)).items():
        if name.startswith("classifier.") and name.endswith(".kernel"):
            spread = np.asarray(kernel).std() * np.prod(kernel.shape[:3]) ** 0.5
            assert abs(spread - 1) < 0.3, name


QUICK_STRIDES = [(torch_architecture, 8, "mobilenet_v2"), (torch_architecture, 16, "efficientnet_lite0")]
ALL_STRIDES = [
    (*family, name)
    for family in ((torch_architecture, 8), (torch_architecture, 16), (tf_architecture, 16))
    for name in BACKBONES
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "stride", "backbone"),
    [pytest.param(*case, marks=() if case in QUICK_STRIDES else slow) for case in ALL_STRIDES],
)
def test_every_backbone_has_the_right_strides(backbone, stride, family):
    architecture = family(backbone, CLASSES, output_stride=stride)
    network = nnx.eval_shape(lambda: KINDS[architecture.kind](architecture))
    sizes = [padded_size(size, architecture) for size in (50, 65)]
    images = jax.ShapeDtypeStruct((1, *sizes, 3), jnp.float32)
    levels, places = nnx.eval_shape(lambda model, x: model.backbone(x), network, images)
    strides = [step for step in (4, 8, 16) if step <= stride]
    assert [level.shape for level in levels] == [
        (1, *(-(-size // step) for size in sizes), channels)
        for step, channels in zip(strides, network.backbone.channels, strict=True)
    ]
    assert places == ()


def test_tensorflow_sizes_are_a_multiple_and_one():
    record = tf_architecture("mobilenet_v2", CLASSES)
    assert [padded_size(size, record) for size in (1, 17, 18, 512, 513)] == [17, 17, 33, 513, 513]
    record = torch_architecture("mobilenet_v2", CLASSES)
    assert [padded_size(size, record) for size in (1, 16, 17, 512)] == [16, 16, 32, 512]


@pytest.mark.parametrize(
    "make",
    [
        lambda: InvertedResidual(4, 4, 2, 1, 2, SMALL),
        pytest.param(lambda: InvertedResidual(4, 6, 2, 2, 1, replace(SMALL, padding="same"), 5), marks=slow),
        pytest.param(
            lambda: ResidualUnit(4, 2, 2, (1, 2), replace(SMALL, padding="same"), bottleneck=True), marks=slow
        ),
        pytest.param(lambda: XceptionUnit(4, (4, 4, 6), 2, 1, SMALL, shortcut="conv"), marks=slow),
        lambda: Aspp(4, replace(SMALL, atrous_rates=(2,), head_channels=4)),
    ],
    ids=["inverted residual", "of 5x5", "bottleneck", "xception", "aspp"],
)
def test_gradients_equal_finite_differences(make):
    images = np.random.default_rng(0).normal(size=(1, 9, 8, 4))
    check_gradient(make, lambda model: model(jnp.asarray(images)))


@slow
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
        @jax.value_and_grad
        def loss(state):
            result = call(nnx.merge(graph, state))
            result = result[0] if isinstance(result, tuple) else result
            return (result * jnp.cos(jnp.arange(result.size)).reshape(result.shape)).sum()

        leaves, tree = jax.tree.flatten(state)
        step = jax.tree.unflatten(tree, [draw.normal(size=leaf.shape) for leaf in leaves])
        gradient = jax.tree.leaves(loss(state)[1])
        backward = sum(float((one * other).sum()) for one, other in zip(gradient, jax.tree.leaves(step), strict=True))
        ahead, behind = (loss(jax.tree.map(lambda a, b, s=s: a + s * b, state, step))[0] for s in (1e-7, -1e-7))
    assert abs(backward) > 1e-3
    np.testing.assert_allclose((ahead - behind) / 2e-7, backward, rtol=1e-5)


def test_faults_of_an_architecture_are_reported_together():
    with pytest.raises(JaxmapError) as caught:
        replace(SMALL, backbone="vgg", output_stride=4, classes=("a", "a"), std=(1.0, 0.0, 1.0))
    for word in ("vgg", "output_stride is 4", "different printable names", "std.1 is 0.0"):
        assert word in str(caught.value)


FAMILIES = {"torch": torch_architecture, "tf": tf_architecture, "torchvision": torchvision_architecture}
NARROW = {"head_channels": 4, "low_level_channels": 3}
STEPS = (1e-5, 1e-6, 1e-7)
"""The larger rounds off less, the smaller crosses fewer corners of a ReLU."""


def narrow(family: str, backbone: str) -> Architecture:
    """A network of this family with a head of a few channels; atrous branches see neighbours on 4x4 features."""
    architecture = replace(FAMILIES[family](backbone, CLASSES, output_stride=8), **NARROW)
    return replace(architecture, atrous_rates=(2,))


def kinds(architecture: Architecture) -> dict[str, list[str]]:
    """Weights by their place in the design: `backbone.units.N.expand.norm.scale`."""
    found: dict[str, list[str]] = {}
    for name in weight_shapes(architecture):
        found.setdefault(re.sub(r"\.\d+", ".N", name), []).append(name)
    return found


def lively_weights(architecture: Architecture) -> dict[str, np.ndarray]:
    """Seeded weights under which the slopes of the first layers are no mere rounding.

    MobileNetV2's projections are linear: without norms that keep the scale its chain fades. The sums of the
    others keep it by themselves.
    """
    factor = np.float32(1.6 if architecture.backbone == "mobilenet_v2" else 1)
    weights = seeded_weights(architecture)
    return {name: value * factor if name.endswith(".norm.scale") else value for name, value in weights.items()}


@slow
@pytest.mark.parametrize(
    ("family", "backbone"),
    [
        ("torch", "mobilenet_v2"),
        ("tf", "mobilenet_v2"),
        ("torchvision", "resnet18"),
        ("torch", "resnet50"),
        ("tf", "xception65"),
    ],
)
def test_the_gradient_of_a_loss_is_its_finite_difference_for_every_kind_of_weight(family, backbone):
    architecture, draw = narrow(family, backbone), np.random.default_rng(0)
    with jax.enable_x64(True):
        weights = {name: jnp.asarray(value, jnp.float64) for name, value in lively_weights(architecture).items()}
        network = pure_network(architecture, weights)
        image = jnp.asarray(seeded_image(30, 33)[None], jnp.float64)
        truth = jnp.asarray(draw.integers(0, len(CLASSES), (1, 30, 33)))

        @jax.jit
        @jax.value_and_grad
        def loss(weights):
            chances = jax.nn.log_softmax(network.apply(weights, image))
            return -jnp.take_along_axis(chances, truth[..., None], axis=-1).mean()

        value, gradient = loss(weights)
        assert value.dtype == jnp.float64
        for kind, names in kinds(architecture).items():
            # The steepest of its kind: at the others little is left but rounding.
            name = max(names, key=lambda name: float(np.abs(gradient[name]).max()))
            slopes = np.asarray(gradient[name])
            place = np.unravel_index(np.abs(slopes).argmax(), slopes.shape)
            moved = [
                [loss({**weights, name: weights[name].at[place].add(sign * step)})[0] for sign in (1, -1)]
                for step in STEPS
            ]
            found = [float(one - other) / (2 * step) for (one, other), step in zip(moved, STEPS, strict=True)]
            nearest = min(found, key=lambda slope: abs(slope - slopes[place]))
            # A loss of about 1, rounded by a few units in the last place, over the step.
            np.testing.assert_allclose(nearest, slopes[place], rtol=1e-4, atol=1e-9, err_msg=kind)
            assert abs(slopes[place]) > 1e-7, f"{kind} does nothing"


@cache
def both_forms(family: str, backbone: str):
    """A network and its folded form, compiled; both take weights."""
    architecture = FAMILIES[family](backbone, CLASSES)
    without_norms = replace(architecture, backbone_norm=False, head_norm=False)
    return architecture, *(jax.jit(pure_network(record, {}).apply) for record in (architecture, without_norms))


def random_weights(architecture: Architecture, seed: int) -> dict[str, jax.Array]:
    """Kernels that keep the scale, and batch-norm statistics such as training leaves behind."""
    draw = np.random.default_rng(seed)

    def array(name: str, shape: tuple[int, ...]) -> np.ndarray:
        if name.endswith(".kernel"):
            fan = shape[0] * shape[1] * shape[2]
            return draw.standard_normal(shape, np.float32) * np.float32((1 / fan) ** 0.5)
        if name.endswith(".norm.var"):
            return np.exp(draw.normal(0, 0.3, shape))
        if name.endswith(".norm.scale"):
            return draw.uniform(0.3, 0.9, shape)
        return draw.normal(0, 0.1, shape)

    return {name: jnp.asarray(array(name, s), jnp.float32) for name, s in weight_shapes(architecture).items()}


@slow
@settings(max_examples=3)
@given(seed=st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("backbone", BACKBONES)
def test_folding_changes_nothing_and_evaluation_repeats_its_bits(family, backbone, seed):
    architecture, plain, folded = both_forms(family, backbone)
    weights, image = random_weights(architecture, seed), seeded_image(33, 47)[None]
    logits = plain(weights, image)
    record, fewer = fold_batch_norm(architecture, weights)
    assert (record.backbone_norm, record.head_norm) == (False, False)
    assert set(fewer) == set(weight_shapes(record))
    np.testing.assert_allclose(folded(fewer, image), logits, atol=1e-4, rtol=0)
    assert float(jnp.std(logits)) > 1e-3
    for run, given_weights in ((plain, weights), (folded, fewer)):
        assert np.asarray(run(given_weights, image)).tobytes() == np.asarray(run(given_weights, image)).tobytes()
