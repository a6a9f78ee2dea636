"""Laws of FCN-8s, SegNet and U-Net, which hold whatever the backbone; and SegNet's unpooling against a slow twin."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from golden.seeded_weights import seeded_image, seeded_weights
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_pooling import reference_pool, reference_unpool

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import BACKBONES, torch_architecture
from jaxmap.models.base import padded_size
from jaxmap.models.checkpoint import load_model, save_model
from jaxmap.models.network import KINDS, fold_batch_norm, inference_network, pure_network, training_form, weight_shapes
from jaxmap.models.one_channel import with_complement
from jaxmap.models.unpooling import pool_with_places, unpool

CLASSES = ("background", "sand", "rock")
OTHERS = ("fcn", "segnet", "unet")


def small(kind: str, backbone: str = "resnet18"):
    """Narrow, so that it compiles fast."""
    return replace(torch_architecture(backbone, CLASSES, kind=kind), head_channels=16)


@jax.jit
def _there_and_back(images):
    largest, places = pool_with_places(images)
    return largest, places, unpool(largest, places)


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_pooling_and_unpooling_are_those_of_the_slow_twin(seed):
    # Few values, so that equal ones meet.
    images = np.random.default_rng(seed).integers(-2, 3, (2, 6, 8, 3)).astype(np.float32)
    largest, places, back = _there_and_back(images)
    wanted, where = reference_pool(images)
    np.testing.assert_array_equal(largest, wanted)
    np.testing.assert_array_equal(places, where)
    np.testing.assert_array_equal(back, reference_unpool(wanted, where))
    np.testing.assert_array_equal(pool_with_places(back)[0], np.maximum(largest, 0))


@pytest.mark.slow
def test_the_gradient_of_pooling_goes_to_the_pixel_that_won():
    images = jnp.array([[[[1.0], [3.0]], [[3.0], [2.0]]]])
    gradient = jax.grad(lambda images: pool_with_places(images)[0].sum())(images)
    np.testing.assert_array_equal(gradient[0, :, :, 0], [[0, 1], [0, 0]])
    _, places = pool_with_places(images)
    np.testing.assert_array_equal(jax.grad(lambda one: (unpool(one, places) * images).sum())(jnp.ones((1, 1, 1, 1))), 3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", OTHERS)
def test_a_small_network_keeps_the_laws(kind):
    """Size, padding, batch, folding, eager and compiled, the same bits twice."""
    record = small(kind)
    weights = {name: jnp.asarray(value) for name, value in seeded_weights(record).items()}
    image = jnp.asarray(seeded_image(45, 61)[None])
    apply = pure_network(record, weights).apply
    compiled = jax.jit(apply)
    logits = np.asarray(compiled(weights, image))
    assert logits.shape == (1, 45, 61, 3) and logits.std() > 0.01
    assert np.asarray(compiled(weights, image)).tobytes() == logits.tobytes()
    np.testing.assert_allclose(apply(weights, image), logits, atol=1e-4)
    # Padding is nothing but more pixels of the mean, and the other images of a batch do not matter.
    padded = np.broadcast_to(np.asarray(record.mean, np.float32) * 255, (2, 64, 64, 3)).copy()
    padded[:, :45, :61] = np.concatenate([image[:, ::-1], image])
    both = compiled(weights, padded)
    np.testing.assert_allclose(both[1:, :45, :61], logits, atol=1e-4)
    np.testing.assert_allclose(both[:1], compiled(weights, padded[:1]), atol=1e-4)
    fast = inference_network(record, weights)
    assert not any(".norm." in name for name in fold_batch_norm(record, weights)[1])
    np.testing.assert_allclose(jax.jit(fast.apply)(fast.weights, image), logits, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", OTHERS)
def test_gradients_are_finite_and_reach_every_weight(kind):
    record = small(kind)
    weights = {name: jnp.asarray(value) for name, value in seeded_weights(record).items()}
    train = training_form(record, ("",))
    image, truth = seeded_image(64, 64)[None], jnp.arange(64 * 64).reshape(1, 64, 64, 1) % 3

    @jax.jit
    @jax.grad
    def gradient(weights):
        logits, _ = train(weights, image, jax.random.key(0))
        return -jnp.take_along_axis(jax.nn.log_softmax(logits), truth, axis=-1).mean()

    for name, slope in gradient(weights).items():
        assert np.isfinite(slope).all(), name
        assert name.endswith((".mean", ".var")) or np.abs(slope).max() > 0, name


@pytest.mark.slow
@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("kind", OTHERS)
def test_every_kind_fits_every_backbone(kind, backbone):
    """By shapes alone: sizes of any image, and for SegNet the weights of the same backbone with strides."""
    record = small(kind, backbone)
    network = nnx.eval_shape(lambda: KINDS[kind](record))
    for size in ((1, 1), (50, 65)):
        images = jax.ShapeDtypeStruct((2, *size, 3), jnp.float32)
        logits = nnx.eval_shape(lambda model, x: model(x), network, images)
        assert logits.shape == (2, *size, 3)
        coarse = nnx.eval_shape(lambda model, x: model.coarse_logits(x), network, images)
        step = 8 if kind == "fcn" else 1
        assert coarse.shape[1:3] == tuple(padded_size(length, record) // step for length in size)
    strided = weight_shapes(torch_architecture(backbone, CLASSES))
    assert {name: shape for name, shape in weight_shapes(record).items() if name.startswith("backbone.")} == {
        name: shape for name, shape in strided.items() if name.startswith("backbone.")
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", OTHERS)
def test_a_model_file_says_what_it_holds(kind, tmp_path):
    record = replace(small(kind, "mobilenet_v2"), classes=("rock",), top_conv=False)
    weights = seeded_weights(record)
    save_model(tmp_path / "a.safetensors", record, weights)
    saved = load_model(tmp_path / "a.safetensors")
    assert saved.architecture == record and set(saved.weights) == set(weights)
    # A network of one output becomes one of two whose first logit is zero, whatever the number of its classifiers.
    both, arrays = with_complement(record, weights)
    assert {name: value.shape for name, value in arrays.items()} == weight_shapes(both)
    changed = [name for name in arrays if arrays[name] is not weights[name]]
    assert changed and all(name.startswith("classifier.") and not arrays[name][..., 0].any() for name in changed)


@pytest.mark.parametrize(
    ("kind", "changes", "reason"),
    [
        ("unet", {"output_stride": 16}, "U-Net at output stride 16"),
        ("segnet", {"output_stride": 8}, "SegNet at output stride 8"),
        ("fcn", {"output_stride": 16}, "FCN-8s at output stride 16"),
        ("deeplab", {"output_stride": 32}, r"DeepLabv3\+ at output stride 32"),
        ("unet", {"relief_channels": 2}, "relief without a decoder of DeepLabv3"),
        ("fcn", {"size_remainder": 1}, "FCN-8s on sizes with a remainder"),
        ("unet", {"kind": "pspnet"}, "kind is 'pspnet'"),
    ],
)
def test_what_a_kind_has_not_is_refused(kind, changes, reason):
    with pytest.raises(JaxmapError, match=reason):
        replace(torch_architecture("resnet18", CLASSES, kind=kind), **changes)
