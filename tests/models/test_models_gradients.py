"""Whole networks: gradients are finite differences, folding changes nothing, the same bits come twice."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden.seeded_weights import seeded_image, seeded_weights
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.models.architecture import (
    BACKBONES,
    Architecture,
    tf_architecture,
    torch_architecture,
    torchvision_architecture,
)
from jaxmap.models.deeplab import fold_batch_norm, pure_network, weight_shapes

CLASSES = ("background", "sand", "rock")
FAMILIES = {"torch": torch_architecture, "tf": tf_architecture, "torchvision": torchvision_architecture}
NARROW = {"head_channels": 4, "low_level_channels": 3}
STEPS = (1e-6, 1e-7)
"""The larger rounds off less, the smaller crosses fewer corners of a ReLU."""
slow = pytest.mark.slow


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


@pytest.mark.parametrize(
    ("family", "backbone"),
    [
        ("torch", "mobilenet_v2"),
        pytest.param("tf", "mobilenet_v2", marks=slow),
        pytest.param("torchvision", "resnet18", marks=slow),
        pytest.param("torch", "resnet50", marks=slow),
        pytest.param("tf", "xception65", marks=slow),
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
            name = names[draw.integers(len(names))]
            slopes = np.asarray(gradient[name])
            # The steepest of its array: at the others little is left but rounding.
            place = np.unravel_index(np.abs(slopes).argmax(), slopes.shape)
            moved = [
                [loss({**weights, name: weights[name].at[place].add(sign * step)})[0] for sign in (1, -1)]
                for step in STEPS
            ]
            found = [float(one - other) / (2 * step) for (one, other), step in zip(moved, STEPS, strict=True)]
            nearest = min(found, key=lambda slope: abs(slope - slopes[place]))
            np.testing.assert_allclose(nearest, slopes[place], rtol=1e-4, err_msg=kind)
            assert abs(slopes[place]) > 1e-6, f"{kind} does nothing"


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


def check_folding(family: str, backbone: str, seed: int) -> None:
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


@settings(max_examples=4)
@given(seed=st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("family", ["torch", "tf"])
def test_folding_changes_nothing_and_evaluation_repeats_its_bits(family, seed):
    check_folding(family, "mobilenet_v2", seed)


@slow
@settings(max_examples=3)
@given(seed=st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("backbone", [name for name in BACKBONES if name != "mobilenet_v2"])
def test_folding_changes_nothing_with_any_backbone(family, backbone, seed):
    check_folding(family, backbone, seed)
