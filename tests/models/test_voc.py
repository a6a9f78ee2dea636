"""The real Pascal VOC network finds the cat, the astronaut and the motorbike."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import skimage

from jaxmap.models.importers import VOC_CLASSES, import_weights
from jaxmap.models.network import pure_network


@pytest.fixture(scope="module")
def network(realdata):
    path = realdata / "weights" / "deeplabv3_mnv2_voc_trainval_folded.safetensors"
    if not path.exists():
        pytest.skip(f"no {path}")
    imported = import_weights(path)
    assert imported.holds == "network" and imported.architecture.classes == VOC_CLASSES
    return pure_network(imported.architecture, imported.weights)


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize(
    ("picture", "name", "least", "most"),
    [
        ("chelsea", "cat", 0.75, 0.83),
        ("astronaut", "person", 0.38, 0.46),
        ("stereo_motorcycle", "motorbike", 0.30, 0.38),
    ],
)
def test_the_voc_network_finds_what_is_there(network, picture, name, least, most):
    pixels = getattr(skimage.data, picture)()
    pixels = pixels[0] if isinstance(pixels, tuple) else pixels
    labels = np.asarray(jax.jit(network.apply)(network.weights, pixels[None])[0].argmax(axis=-1))
    assert least <= (labels == VOC_CLASSES.index(name)).mean() <= most


@pytest.mark.realdata
def test_the_imagenet_backbone_is_converted(realdata):
    path = realdata / "weights" / "mobilenet_v2_1.0_224_tf_folded.safetensors"
    if not path.exists():
        pytest.skip(f"no {path}")
    imported = import_weights(path)
    assert imported.holds == "backbone" and len(imported.weights) == 104
