"""Settings of training: files, round trips, strictness, and that every one says what it is."""

from __future__ import annotations

import inspect
from dataclasses import MISSING, fields, is_dataclass, replace

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.errors import UsageError
from jaxmap.host.settings import config_folder
from jaxmap.runs.training_plan import TRAIN_SETTINGS, MapTruthOptions, TrainConfig
from jaxmap.training.batches import ExampleOrder
from jaxmap.training.options import (
    AugmentationOptions,
    BatchNormOptions,
    DataOptions,
    NetworkOptions,
    OptimiserOptions,
    PixelLossOptions,
    TrainingOptions,
)

CONFIGS = sorted((config_folder() / "train").glob("*.yaml"))
SECTIONS = ("augmentation", "loss", "optimiser", "norm", "data", "network", "map_truth")


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_loads_and_is_read_to_the_last_key(path):
    config = TRAIN_SETTINGS.load(str(path))
    assert config == TRAIN_SETTINGS.load(path.stem) == TRAIN_SETTINGS.load(path.name)

    def check(part: dict, whole: dict) -> None:
        for key, value in part.items():
            if isinstance(value, dict):
                check(value, whole[key])
            else:
                assert whole[key] == value, key

    check(yaml.safe_load(path.read_text()), TRAIN_SETTINGS.tree(config))
    assert path.read_text().startswith("#"), "says what it is"


def test_the_paper_makes_four_hundred_of_fifty():
    config = TRAIN_SETTINGS.load("chiodini2020")
    order = ExampleOrder.of(50, config)
    assert order.examples == 400 and order.variants == 8
    assert config.classes == ("background", "sand", "rock") and config.augmentation.mirror


configs = st.builds(
    TrainConfig,
    epochs=st.integers(1, 500),
    batch_size=st.integers(1, 64),
    keep=st.sampled_from(["best", "last"]),
    seed=st.integers(0, 2**31 - 1),
    classes=st.lists(st.sampled_from(["background", "sand", "rock", "grass"]), unique=True).map(tuple),
    augmentation=st.builds(
        AugmentationOptions,
        crop_px=st.tuples(st.integers(16, 4096), st.integers(16, 4096)),
        copies=st.none() | st.integers(0, 9),
        hue_rad=st.floats(0, 3),
    ),
    loss=st.builds(
        PixelLossOptions,
        lovasz=st.floats(0, 2),
        class_weights=st.sampled_from(["equal", "balanced", (1.0, 2.5)]),
        label_smoothing=st.floats(0, 1, exclude_max=True),
    ),
    optimiser=st.builds(OptimiserOptions, kind=st.sampled_from(["adamw", "sgd"]), clip_norm=st.none() | st.just(2.0)),
    norm=st.builds(BatchNormOptions, head=st.sampled_from(["auto", "batch", "frozen"])),
    data=st.builds(
        DataOptions,
        remap=st.none() | st.just({"255": "rock", "*": "sand"}),
        palette=st.none() | st.just({"rock": "#ff0000 #00ff00"}),
    ),
    network=st.builds(
        NetworkOptions,
        backbone=st.none() | st.sampled_from(["resnet18", "xception65"]),
        output_stride=st.sampled_from([None, 8, 16]),
        atrous_rates=st.sampled_from([None, (), (6, 12)]),
    ),
)


@given(configs)
def test_a_config_comes_back_from_its_tree_and_from_yaml(config):
    tree = TRAIN_SETTINGS.tree(config)
    assert TRAIN_SETTINGS.check(tree) == config
    assert TRAIN_SETTINGS.check(yaml.safe_load(yaml.safe_dump(tree))) == config
    assert TRAIN_SETTINGS.tree(TRAIN_SETTINGS.check(tree)) == tree


def test_the_settings_of_a_run_can_be_read_again(tmp_path):
    """A run's config.yaml names its data and its start as well, which are not settings."""
    tree = {"training_data": "somewhere", "init": None, **TRAIN_SETTINGS.tree(TrainConfig(epochs=7))}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(tree))
    assert TRAIN_SETTINGS.load(str(tmp_path / "config.yaml")) == TrainConfig(epochs=7)


@pytest.mark.parametrize(
    "kind",
    [
        *(TrainConfig, TrainingOptions, AugmentationOptions, PixelLossOptions, OptimiserOptions, BatchNormOptions),
        *(DataOptions, NetworkOptions, MapTruthOptions),
    ],
)
def test_every_setting_has_a_default_and_says_what_it_is(kind):
    assert is_dataclass(kind) and kind() == kind()
    source = inspect.getsource(kind).splitlines()
    own = [field for field in fields(kind) if field.name in kind.__annotations__]
    for field in own:
        assert field.default is not MISSING or field.default_factory is not MISSING, field.name
        place = next(index for index, line in enumerate(source) if line.startswith(f"    {field.name}: "))
        assert field.name in SECTIONS or source[place + 1].startswith('    """'), field.name


@pytest.mark.parametrize(
    ("tree", "named"),
    [
        ({"epoch": 3, "optimiser": {"rate": 1}}, ["epoch", "optimiser.rate"]),
        ({"epochs": 0, "batch_size": 0}, ["epochs is 0", "batch_size is 0"]),
        ({"seed": -1}, ["seed is -1"]),
        ({"keep": "first"}, ["keep is 'first'"]),
        ({"classes": "rock"}, ["classes is 'rock'"]),
        ({"augmentation": {"crop_px": [8, 384]}}, ["augmentation.crop_px.0 is 8"]),
        ({"augmentation": {"crop_px": 384}}, ["augmentation.crop_px is 384"]),
        ({"augmentation": {"scale": [0, 1]}}, ["augmentation.scale.0 is 0"]),
        ({"augmentation": {"noise": float("nan")}}, ["augmentation.noise is nan"]),
        ({"loss": {"label_smoothing": 1.0}}, ["loss.label_smoothing is 1.0"]),
        ({"loss": {"class_weights": [1, 0]}}, ["loss.class_weights.1 is 0"]),
        ({"loss": {"class_weights": "square"}}, ["loss.class_weights is 'square'"]),
        ({"optimiser": {"kind": "adam"}}, ["optimiser.kind is 'adam'"]),
        ({"optimiser": {"learning_rate": float("inf")}}, ["optimiser.learning_rate is inf"]),
        ({"optimiser": {"average": 1}}, ["optimiser.average is 1"]),
        ({"norm": {"head": "learn"}}, ["norm.head is 'learn'"]),
        ({"data": {"validation_share": 1}}, ["data.validation_share is 1"]),
        ({"network": {"backbone": "vgg"}}, ["network.backbone is 'vgg'"]),
        ({"network": {"output_stride": 4}}, ["network.output_stride is 4"]),
        ({"network": None}, ["network is None"]),
    ],
)
def test_every_fault_is_named_by_its_key(tree, named):
    with pytest.raises(UsageError) as caught:
        TRAIN_SETTINGS.check(tree, where="mine.yaml")
    assert all(part in str(caught.value) for part in named), str(caught.value)
    assert "mine.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: AugmentationOptions(scale=(2, 1)), "augmentation.scale is 2.0 1.0"),
        (lambda: AugmentationOptions(crop_px=(8, 384)), "augmentation.crop_px.0 is 8"),
        (lambda: PixelLossOptions(cross_entropy=0), "every loss has a weight of 0"),
        (lambda: OptimiserOptions(learning_rate=-1, momentum=2), "optimiser.learning_rate is -1"),
        (lambda: OptimiserOptions(learning_rate=-1, momentum=2), "optimiser.momentum is 2"),
        (lambda: DataOptions(validation_share=1), "data.validation_share is 1"),
        (lambda: TrainConfig(epochs=0), "epochs is 0"),
        (lambda: TrainConfig(epoch=1), "unknown key epoch"),
        (lambda: replace(TrainConfig(), keep="first"), "keep is 'first'"),
    ],
)
def test_options_are_validated_when_they_are_made(make, named):
    with pytest.raises(UsageError) as caught:
        make()
    assert named in str(caught.value)


def test_options_override_the_config(tmp_path):
    from jaxmap.commands.console import parse
    from jaxmap.commands.train import TrainArguments, _with_config

    words = ["data", "--out", "run", "--config", "chiodini2020", "--epochs", "3", "--augmentation.copies", "1"]
    settings = parse(TrainArguments, "train", words, with_config=_with_config).settings
    assert (settings.epochs, settings.augmentation.copies, settings.augmentation.crop_px) == (3, 1, (384, 512))


def test_yaml_runs_no_code(tmp_path):
    (tmp_path / "evil.yaml").write_text("!!python/object/apply:os.mkdir ['" + str(tmp_path / "made") + "']\n")
    with pytest.raises(UsageError, match=r"evil\.yaml"):
        TRAIN_SETTINGS.load(str(tmp_path / "evil.yaml"))
    assert not (tmp_path / "made").exists()
