"""A network of one output, which a sigmoid reads, is one of two classes with the same probabilities."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from golden.seeded_weights import exported, seeded_image, seeded_weights
from safetensors.numpy import save_file

from jaxmap.errors import JaxmapError
from jaxmap.models import import_tables as tables
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import load_network, save_model
from jaxmap.models.importers import import_weights
from jaxmap.models.one_channel import with_complement
from jaxmap.runs.segmentation import Segmenter

ARCHITECTURE = torch_architecture("mobilenet_v2", ("rock",))
ROWS = [*tables.torchvision_backbone("mobilenet_v2", "encoder."), *tables.smp_head(ARCHITECTURE)]


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    path = tmp_path_factory.mktemp("one") / "one.safetensors"
    save_file(exported(ARCHITECTURE, ROWS, tables.TORCH), path)
    return path


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (None, ("background", "rock")),
        (("boulder",), ("background", "boulder")),
        (("background",), ("other", "background")),
        (("sand", "rock"), ("sand", "rock")),
    ],
)
def test_two_classes_are_named_and_told(given, named, published):
    imported = import_weights(published, classes=given)
    assert imported.architecture.classes == named
    (note,) = imported.notes
    assert f"{named[1]} where it is above 0.5, {named[0]} elsewhere" in note
    kernel, bias = (imported.weights[f"classifier.{leaf}"] for leaf in ("kernel", "bias"))
    expected = seeded_weights(ARCHITECTURE)
    np.testing.assert_array_equal(kernel[..., 1:], expected["classifier.kernel"])
    assert not kernel[..., 0].any() and bias[0] == 0 and bias[1:] == expected["classifier.bias"]


def test_more_names_than_two_are_refused(published):
    with pytest.raises(JaxmapError, match="3 classes are named, the network has one output, which a sigmoid reads"):
        import_weights(published, classes=("background", "sand", "rock"))


def test_probabilities_are_those_of_the_sigmoid():
    logit = np.linspace(-8, 8, 33, dtype=np.float32)
    weights = {"classifier.kernel": np.ones((1, 1, 1, 1), np.float32), "classifier.bias": np.zeros(1, np.float32)}
    _, two = with_complement(ARCHITECTURE, weights)
    logits = logit[:, None] @ two["classifier.kernel"][0, 0] + two["classifier.bias"]
    np.testing.assert_allclose(jax.nn.softmax(logits)[:, 1], jax.nn.sigmoid(logit), rtol=1e-6)
    np.testing.assert_array_equal(logits.argmax(axis=-1), logit > 0)


@pytest.mark.slow
def test_a_model_file_of_one_class_labels_by_its_sign(tmp_path):
    weights = seeded_weights(ARCHITECTURE)
    save_model(tmp_path / "one.safetensors", ARCHITECTURE, weights)
    segmenter = Segmenter(load_network(tmp_path / "one.safetensors"))
    assert segmenter.classes == ("background", "rock")
    logits = segmenter.logits(seeded_image(64, 96))
    assert not logits[..., 0].any() and 0 < (logits[..., 1] > 0).mean() < 1
