"""What training starts from: kept and fresh weights, networks decided by file and settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from compiling import compiled_quickly
from golden.seeded_weights import seeded_weights

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.models.architecture import Architecture, tf_architecture, torch_architecture
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.network import weight_shapes
from jaxmap.training.initial_network import InitialNetwork, make_initial_network
from jaxmap.training.options import BatchNormOptions, NetworkOptions

quickly = pytest.fixture(scope="module", autouse=True)(compiled_quickly)

CLASSES = ("background", "sand", "rock")
SMALL = NetworkOptions(head_channels=8, low_level_channels=4, atrous_rates=(2,), top_conv=False)
TRAINED = replace(
    torch_architecture("mobilenet_v2", CLASSES),
    head_channels=8,
    low_level_channels=4,
    atrous_rates=(2,),
    top_conv=False,
    mean=(0.4, 0.4, 0.4),
)


def saved(architecture: Architecture = TRAINED, holds: str = "network") -> SavedModel:
    weights = seeded_weights(architecture)
    if holds == "backbone":
        weights = {name: value for name, value in weights.items() if name.startswith("backbone.")}
    return SavedModel(architecture, weights, holds)  # type: ignore[arg-type]


def start_of(init: SavedModel | None, network: NetworkOptions = SMALL, classes=CLASSES, **norm: str) -> InitialNetwork:
    return make_initial_network(network, BatchNormOptions(**norm), classes, init, seed=1)  # type: ignore[arg-type]


def kept(start: InitialNetwork, init: SavedModel) -> set[str]:
    """The blocks that hold the very weights of the file."""
    same = {
        name
        for name, value in start.weights.items()
        if name in init.weights
        and value.shape == init.weights[name].shape
        and np.array_equal(value, init.weights[name])
    }
    parts = {name.split(".")[0] for name in start.weights}
    return {part for part in parts if all(name in same for name in start.weights if name.startswith(f"{part}."))}


def test_without_a_file_all_is_fresh_and_learns():
    start = start_of(None)
    assert start.architecture.backbone == "mobilenet_v2" and start.architecture.classes == CLASSES
    assert start.fresh == ("aspp", "backbone", "classifier", "decoder")
    assert start.batch_norms == ("backbone", "aspp", "decoder")
    assert {name: value.shape for name, value in start.weights.items()} == weight_shapes(start.architecture)
    again, other = (
        make_initial_network(SMALL, BatchNormOptions(), CLASSES, None, seed=seed).weights["classifier.kernel"]
        for seed in (1, 2)
    )
    assert np.array_equal(start.weights["classifier.kernel"], again) and not np.array_equal(again, other)


def test_of_a_backbone_the_backbone_is_kept():
    init = saved(holds="backbone")
    start = start_of(init)
    assert kept(start, init) == {"backbone"}
    assert start.fresh == ("aspp", "classifier", "decoder") and start.batch_norms == ("aspp", "decoder")
    assert start.architecture.mean == TRAINED.mean, "its input is normalised as it was"


def test_of_a_network_all_is_kept():
    init = saved()
    start = start_of(init, NetworkOptions())
    assert start.architecture == TRAINED
    assert kept(start, init) == {"backbone", "aspp", "decoder", "classifier"}
    assert start.fresh == () and start.batch_norms == ()


@pytest.mark.parametrize("classes", [("sand", "rock"), ("background", "rock", "sand"), ("a", "b", "c")])
def test_other_classes_have_a_fresh_classifier(classes):
    init = saved()
    start = start_of(init, NetworkOptions(), classes)
    assert start.architecture == replace(TRAINED, classes=classes)
    assert start.fresh == ("classifier",) and start.batch_norms == ()
    assert start.weights["classifier.kernel"].shape[-1] == len(classes)
    assert not np.array_equal(
        start.weights["classifier.kernel"][..., 0], np.asarray(init.weights["classifier.kernel"])[..., 0]
    )


def test_options_go_before_the_file_and_what_they_change_is_fresh():
    init = saved()
    start = start_of(init, NetworkOptions(head_channels=6, output_stride=8, dropout=0.2))
    assert start.architecture == replace(TRAINED, head_channels=6, output_stride=8, dropout=0.2)
    assert "backbone" in kept(start, init)
    assert start.fresh == ("aspp", "classifier", "decoder") and start.batch_norms == ("aspp", "decoder")
    # Another stride or dropout changes no weight.
    start = start_of(init, NetworkOptions(output_stride=8, dropout=0.2))
    assert start.fresh == ()


def test_a_network_may_lose_its_decoder():
    init = saved()
    start = start_of(init, NetworkOptions(decoder=False))
    assert not any(name.startswith("decoder.") for name in start.weights)
    assert start.fresh == () and kept(start, init) == {"backbone", "aspp", "classifier"}


def test_a_backbone_may_lose_its_last_convolution():
    init = saved(replace(TRAINED, top_conv=True), holds="backbone")
    start = start_of(init)
    assert not any(name.startswith("backbone.top") for name in start.weights)
    assert kept(start, init) == {"backbone"} and start.batch_norms == ("aspp", "decoder")


@pytest.mark.parametrize("holds", ["backbone", "network"])
def test_another_backbone_is_refused(holds):
    with pytest.raises(UsageError, match="holds mobilenet_v2, not resnet18"):
        start_of(saved(holds=holds), replace(SMALL, backbone="resnet18"))
    assert start_of(saved(holds=holds), replace(SMALL, backbone="mobilenet_v2")).architecture.backbone == "mobilenet_v2"


def test_the_family_decides_the_head_and_never_the_trained_backbone():
    start = start_of(saved(), replace(SMALL, family="tf"))
    assert start.architecture.pool_first and start.architecture.norm_inside
    assert (start.architecture.padding, start.architecture.backbone_eps) == ("torch", 1e-5)
    tf = replace(tf_architecture("mobilenet_v2", CLASSES), head_channels=8, low_level_channels=4)
    start = start_of(saved(tf, holds="backbone"))
    assert start.architecture.padding == "same" and start.architecture.pool_first
    assert start.architecture.mean == tf.mean
    # TensorFlow's padding alone does not make the head TensorFlow's.
    lite = replace(torch_architecture("efficientnet_lite0", CLASSES), head_channels=8, low_level_channels=4)
    start = start_of(saved(lite, holds="backbone"))
    assert start.architecture.padding == "same" and not start.architecture.pool_first
    assert start.architecture.mean == lite.mean


@pytest.mark.parametrize(("stride", "rates"), [(16, (6, 12, 18)), (8, (12, 24, 36))])
def test_fresh_networks_see_at_several_scales_in_either_family(stride, rates):
    network = NetworkOptions(family="tf", output_stride=stride)
    assert start_of(None, network).architecture.atrous_rates == rates


@pytest.mark.parametrize(
    ("norm", "expected"),
    [
        ({}, ("aspp", "decoder")),
        ({"backbone": "batch"}, ("backbone", "aspp", "decoder")),
        ({"head": "frozen"}, ()),
        ({"backbone": "frozen", "head": "batch"}, ("aspp", "decoder")),
    ],
)
def test_norms_train_as_the_options_say(norm, expected):
    assert start_of(saved(holds="backbone"), **norm).batch_norms == expected


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name"), [("fcn", "FCN-8s"), ("segnet", "SegNet"), ("unet", "U-Net")])
def test_of_another_kind_of_network_the_backbone_alone_is_kept(kind, name):
    tf = replace(tf_architecture("mobilenet_v2", CLASSES), head_channels=8, low_level_channels=4)
    for init in (saved(), saved(tf)):
        start = start_of(init, NetworkOptions(kind=kind))
        record, trained = start.architecture, init.architecture
        assert (record.name, record.output_stride, record.size_remainder) == (name, 32, 0)
        assert (record.padding, record.backbone_eps, record.mean) == (
            trained.padding,
            trained.backbone_eps,
            trained.mean,
        )
        assert kept(start, init) == {"backbone"}
        parts = {part.split(".")[0] for part in start.weights}
        assert set(start.fresh) == parts - {"backbone"} and set(start.batch_norms) == set(start.fresh) - {"classifier"}
    # Of the same kind all is kept, without a word about it.
    again = start_of(saved(record), NetworkOptions())
    assert again.architecture == record and again.fresh == ()


def test_an_fcn_without_a_decoder_has_any_stride():
    network = NetworkOptions(kind="fcn", decoder=False, output_stride=8)
    for init in (None, saved()):
        record = start_of(init, network).architecture
        assert (record.name, record.output_stride, record.decoder) == ("FCN", 8, False)
    with pytest.raises(JaxmapError, match="FCN-8s at output stride 8"):
        start_of(None, replace(network, decoder=None))


@pytest.mark.parametrize(
    ("kind", "options", "name"),
    [
        ("fcn", {"atrous_rates": (2,)}, "network.atrous-rates"),
        ("unet", {"decoder": True}, "network.decoder"),
        ("segnet", {"head_channels": 8}, "network.head-channels"),
        ("unet", {"relief": True}, "network.relief"),
    ],
)
def test_an_option_that_means_nothing_to_the_kind_is_refused(kind, options, name):
    with pytest.raises(UsageError, match=f"{name} is given, which means nothing to {kind}"):
        start_of(None, NetworkOptions(kind=kind, **options))


def test_a_network_that_cannot_be_built_is_refused():
    with pytest.raises(JaxmapError, match="atrous_rates"):
        start_of(saved(), NetworkOptions(atrous_rates=tuple(range(1, 18))))
