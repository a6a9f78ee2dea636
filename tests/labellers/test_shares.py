"""Shares of all pixels, by the kernel and without it, equal the twin; their gradients do not know of the kernel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import SMALL
from reference_pixelwise import merged_probabilities, pixel_logits

from jaxmap.geometry.relief import RELIEF_STRIDE
from jaxmap.labellers.shares import Odds, pixel_shares
from jaxmap.labels import IGNORE
from jaxmap.models.pixelwise import upsampling
from jaxmap.native.build import LABELS_TARGET, has_kernel

CLASSES = 3
ARCHITECTURES = {"corners": SMALL, "half pixels": replace(SMALL, align_corners=False)}


@pytest.fixture(params=["kernel", "plain"])
def way(request, monkeypatch) -> str:
    """How shares are computed."""
    if request.param == "plain":
        monkeypatch.setenv("JAXMAP_NATIVE", "0")
    elif not has_kernel(LABELS_TARGET):
        pytest.skip("there is no compiler, or no CPU")
    return request.param


def an_example(seed: int, coarse_px: tuple[int, int], image_px: tuple[int, int], inputs: int = 5) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    targets = rng.permutation([*range(CLASSES), *rng.choice([*range(CLASSES), IGNORE], inputs - CLASSES)])
    relief_px = [-(-edge // RELIEF_STRIDE) for edge in image_px]
    return {
        "logits": jnp.asarray(rng.normal(0, 6, (*coarse_px, inputs)), jnp.float32),
        "targets": tuple(targets.tolist()),
        "temperature": jnp.float32(rng.uniform(0.3, 3)),
        "wanted": jnp.asarray(rng.random(image_px) < rng.choice([0.01, 0.5, 1])),
        "odds": Odds(1, jnp.asarray(rng.normal(0, 10, relief_px), jnp.float32), jnp.float32(rng.choice([1, 0.3, 2]))),
    }


def twin(example: dict[str, Any], architecture: Any, size_px: Any, image_px: tuple[int, int]) -> np.ndarray:
    """In float64: softmax, sums, and the odds of one class multiplied, the sum kept."""
    logits = pixel_logits(architecture, example["logits"], image_px, size_px) / float(example["temperature"])
    shares = merged_probabilities(logits, example["targets"], CLASSES)
    odds = example["odds"]
    if odds is None:
        return shares
    rows, columns = (np.arange(edge) // RELIEF_STRIDE for edge in image_px)
    powers = np.maximum(shares, 1e-7) ** float(odds.gain)
    powers[..., odds.of_class] *= np.exp(np.asarray(odds.log_odds, np.float64)[rows][:, columns])
    return powers * (shares.sum(axis=-1) / powers.sum(axis=-1))[..., None]


@pytest.mark.slow
@pytest.mark.parametrize("odds", [True, False], ids=["odds", "no odds"])
@pytest.mark.parametrize("size_px", [None, (24, 48)])
@pytest.mark.parametrize(
    ("name", "seed", "image_px"),
    [
        ("corners", 0, (18, 150)),
        ("corners", 1, (70, 40)),
        ("half pixels", 2, (37, 40)),
        ("half pixels", 3, (18, 150)),
        ("corners", 4, (3, 5)),
    ],
)
def test_shares_equal_the_twin(way, name, seed, image_px, size_px, odds):
    architecture, coarse_px = ARCHITECTURES[name], (3, 6)
    example = an_example(seed, coarse_px, image_px)
    if not odds:
        example["odds"] = None
    places = upsampling(architecture, coarse_px, image_px, size_px)
    shares = pixel_shares(places=places, classes=CLASSES, **example)
    expected = twin(example, architecture, size_px, image_px)
    wanted = np.asarray(example["wanted"])
    for index, share in enumerate(shares):
        np.testing.assert_allclose(share.reshape(image_px)[wanted], expected[..., index][wanted], atol=3e-5, rtol=1e-4)


@pytest.mark.slow
def test_gradients_do_not_know_of_the_kernel(monkeypatch):
    image_px, coarse_px = (18, 150), (3, 6)
    example = an_example(0, coarse_px, image_px) | {"wanted": jnp.ones(image_px, bool)}
    places = upsampling(SMALL, coarse_px, image_px, None)

    def loss(logits: Any, temperature: Any, log_odds: Any) -> Any:
        odds = example["odds"]._replace(log_odds=log_odds)
        changed = example | {"logits": logits, "temperature": temperature, "odds": odds}
        return sum((share**2).sum() for share in pixel_shares(places=places, classes=CLASSES, **changed))

    numbers = example["logits"], example["temperature"], example["odds"].log_odds
    by_kernel = jax.grad(loss, argnums=(0, 1, 2))(*numbers)
    monkeypatch.setenv("JAXMAP_NATIVE", "0")
    plain = jax.grad(loss, argnums=(0, 1, 2))(*numbers)
    for one, other in zip(by_kernel, plain, strict=True):
        assert np.abs(other).max() > 0
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
