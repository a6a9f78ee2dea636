"""A network so small that its training step compiles in seconds, tiny data for it, and runs on them.

The network stands in the place of MobileNetV2: the head, training and files around it are the real ones.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from compiling import optimised
from flax import nnx
from jaxtyping import Array
from training_data import CLASSES, write_data

from jaxmap.commands.main import main
from jaxmap.models import backbones, network
from jaxmap.models.architecture import Architecture, torch_architecture
from jaxmap.models.backbones import Pyramid
from jaxmap.models.layers import ConvBlock

CONFIG = """\
classes: [sand, rock]
epochs: 3
batch_size: 2
validate_every: 2
augmentation: {crop_px: [32, 32], scale: [0.75, 1.5]}
optimiser: {learning_rate: 0.005, warmup_steps: 2}
network: {head_channels: 8, low_level_channels: 4, atrous_rates: [], decoder: false}
"""
EPOCHS, STEPS = 3, 8
"""Of this configuration on the five training images: the batches of one epoch reach into the next."""

ARCHITECTURE = replace(
    torch_architecture("mobilenet_v2", CLASSES),
    decoder=False,
    head_channels=8,
    low_level_channels=4,
    atrous_rates=(),
    dropout=0.0,
)


class TinyBackbone(nnx.Module):
    """Two convolutions of stride 2."""

    def __init__(self, record: Architecture) -> None:
        norm = "batch" if record.backbone_norm else "bias"
        self.stem = ConvBlock(3, 8, 3, stride=2, norm=norm, eps=record.backbone_eps)
        self.deep = ConvBlock(8, 16, 3, stride=2, norm=norm, eps=record.backbone_eps)
        self.channels = (16, 16)

    def __call__(self, images: Array) -> Pyramid:
        features = self.deep(self.stem(images))
        return Pyramid((features, features), ())


@contextmanager
def tiny_network() -> Iterator[None]:
    """Within it, `mobilenet_v2` names the tiny backbone, and programs are compiled with few optimisations."""
    builders: dict = backbones.BUILDERS
    before = builders["mobilenet_v2"]
    builders["mobilenet_v2"] = TinyBackbone
    network.weight_shapes.cache_clear()
    try:
        with optimised(False):
            yield
    finally:
        builders["mobilenet_v2"] = before
        network.weight_shapes.cache_clear()


@pytest.fixture(scope="module", autouse=True)
def network_is_tiny() -> Iterator[None]:
    """For all tests of the module that imports it."""
    with tiny_network():
        yield


def write_data_and_config(folder: Path) -> Path:
    write_data(folder)
    (folder / "tiny.yaml").write_text(CONFIG)
    return folder


def train_words(data: Path, out: Path, *more: object) -> list[str]:
    """The command line that trains the tiny network."""
    return [str(word) for word in ("train", data, "--out", out, "--config", data / "tiny.yaml", *more)]


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny data; only to be read."""
    return _tiny_data(tmp_path_factory.getbasetemp())


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory: pytest.TempPathFactory, shared_cache: Path) -> Path:
    """The folder of an uninterrupted run; only to be read."""
    return _whole_run(tmp_path_factory.getbasetemp())


@cache
def _tiny_data(base: Path) -> Path:
    return write_data_and_config(base / "tiny_data")


@cache
def _whole_run(base: Path) -> Path:
    out = base / "whole_run"
    with tiny_network():
        assert main(train_words(_tiny_data(base), out)) == 0
    return out


def contents(folder: Path) -> Mapping[str, bytes]:
    """Everything in a folder, by path."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


if __name__ == "__main__":
    with tiny_network():
        sys.exit(main(sys.argv[1:]))
