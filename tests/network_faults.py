"""Ways to spoil the inputs of `jaxmap segment` and `jaxmap weights`, each with the exit status it must give."""

from __future__ import annotations

import json
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from golden.seeded_weights import exported, seeded_image, seeded_weights
from PIL import Image
from safetensors.numpy import save

from jaxmap.models import import_tables as tables
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import save_model

GOLDEN = Path(__file__).parent / "golden"
SMALL = replace(
    torch_architecture("mobilenet_v2", ("background", "sand", "rock")),
    top_conv=False,
    head_channels=4,
    low_level_channels=4,
    atrous_rates=(2,),
)
SIZE = (24, 32)

Spoil = Callable[[Path], "list[str] | None"]
"""Takes a folder with `model.safetensors`, `images/{a,b}.png` and `masks/{a,b}.png`; returns more words."""


def write_inputs(folder: Path) -> Path:
    """All that a scored run of `jaxmap segment` needs."""
    (folder / "model.safetensors").write_bytes(_model_bytes(folder))
    for kind, content in (("images", seeded_image(*SIZE)), ("masks", np.zeros(SIZE, np.uint8))):
        (folder / kind).mkdir()
        for name in "ab":
            Image.fromarray(content).save(folder / kind / f"{name}.png")
    return folder


_models: dict[str, bytes] = {}


def _model_bytes(folder: Path) -> bytes:
    if "small" not in _models:
        save_model(folder / "model.safetensors", SMALL, seeded_weights(SMALL))
        _models["small"] = (folder / "model.safetensors").read_bytes()
    return _models["small"]


def segment_words(folder: Path, *more: str) -> list[str]:
    """The command line of a scored run."""
    words = ["segment", folder / "images", "--model", folder / "model.safetensors", "--out", folder / "out"]
    return [str(word) for word in (*words, "--masks", folder / "masks", *more)]


def import_words(source: Path, *more: str) -> list[str]:
    """The command line of a conversion."""
    return [str(word) for word in ("weights", "import", source, "--out", source.parent / "out.safetensors", *more)]


def with_header(change: Callable[[dict], None]) -> Spoil:
    """Changes the header of the model file."""

    def spoil(folder: Path) -> None:
        path = folder / "model.safetensors"
        content = path.read_bytes()
        size = struct.unpack("<Q", content[:8])[0]
        header = json.loads(content[8 : 8 + size])
        change(header)
        text = json.dumps(header).encode()
        path.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + size :])

    return spoil


def with_record(**changes: object) -> Spoil:
    """Changes what the model file says of its network."""

    def change(header: dict) -> None:
        record = json.loads(header["__metadata__"]["jaxmap"])
        record["architecture"].update(changes.pop("architecture", {}))
        header["__metadata__"]["jaxmap"] = json.dumps({**record, **changes})

    return with_header(change)


def of_another_program(header: dict) -> None:
    del header["__metadata__"]


def with_huge_shape(header: dict) -> None:
    header["classifier.kernel"]["shape"] = [1, 1, 1 << 40, 1 << 40]


def with_wrong_type(header: dict) -> None:
    header["classifier.bias"]["dtype"] = "F8_E4M3"
    header["classifier.bias"]["shape"] = [12]


def not_finite(folder: Path) -> None:
    path = folder / "model.safetensors"
    content = path.read_bytes()
    size = struct.unpack("<Q", content[:8])[0]
    place = json.loads(content[8 : 8 + size])["classifier.bias"]["data_offsets"][0] + 8 + size
    path.write_bytes(content[:place] + struct.pack("<f", float("nan")) + content[place + 4 :])


def truncated(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:5000])


def text_for_model(folder: Path) -> None:
    (folder / "model.safetensors").write_text("no model at all")


def backbone_alone(folder: Path) -> None:
    weights = {name: value for name, value in seeded_weights(SMALL).items() if name.startswith("backbone.")}
    save_model(folder / "model.safetensors", SMALL, weights, holds="backbone")


def removed(name: str) -> Spoil:
    return lambda folder: (folder / name).unlink()


def emptied(folder: Path) -> None:
    for path in (folder / "images").iterdir():
        path.unlink()


def without_images(folder: Path) -> None:
    shutil.rmtree(folder / "images")


def one_name_twice(folder: Path) -> None:
    Image.fromarray(seeded_image(*SIZE)).save(folder / "images" / "a.jpg")


def mask(content: np.ndarray) -> Spoil:
    return lambda folder: Image.fromarray(content).save(folder / "masks" / "b.png")


def garbage(name: str) -> Spoil:
    return lambda folder: (folder / name).write_text("no picture at all") and None


def words(*more: str) -> Spoil:
    return lambda folder: [word.replace("{}", str(folder)) for word in more]


def out_is_a_file(folder: Path) -> list[str]:
    (folder / "file").write_text("")
    return ["--out", str(folder / "file")]


SEGMENT_FAULTS: dict[str, tuple[int, Spoil]] = {
    "no model file": (1, removed("model.safetensors")),
    "a text for a model": (1, text_for_model),
    "truncated model": (1, truncated),
    "model of another program": (1, with_header(of_another_program)),
    "model of a newer jaxmap": (1, with_record(format_version=2)),
    "model with a damaged record": (1, with_record(holds="nothing")),
    "model of another architecture": (1, with_record(architecture={"backbone": "resnet18"})),
    "model of an unknown backbone": (1, with_record(architecture={"backbone": "vgg19"})),
    "model of an impossible architecture": (1, with_record(architecture={"output_stride": 4, "head_channels": 0})),
    "model with a huge shape": (1, with_header(with_huge_shape)),
    "model of a wrong type": (1, with_header(with_wrong_type)),
    "model with NaN": (1, not_finite),
    "a backbone for a model": (1, backbone_alone),
    "no such image": (1, without_images),
    "a folder without images": (1, emptied),
    "two images of one name": (1, one_name_twice),
    "outputs in the place of inputs": (1, words("--out", "{}/images")),
    "outputs in the place of masks": (1, words("--out", "{}/masks")),
    "scores in the place of the model": (1, words("--scores", "{}/model.safetensors")),
    "segment out is a file": (1, out_is_a_file),
    "scores are a folder": (1, words("--scores", "{}/masks")),
    "missing mask": (1, removed("masks/b.png")),
    "no folder of masks": (1, words("--masks", "{}/nowhere")),
    "mask of another size": (1, mask(np.zeros((SIZE[0], SIZE[1] - 1), np.uint8))),
    "mask label out of range": (1, mask(np.full(SIZE, 3, np.uint8))),
    "mask in colours": (1, mask(np.full((*SIZE, 3), (9, 0, 0), np.uint8))),
    "mask that is no image": (1, garbage("masks/b.png")),
    "image that is no image": (1, garbage("images/a.png")),
    "size of zero": (2, words("--size", "0", "64")),
}


@cache
def resnet18_state() -> dict[str, np.ndarray]:
    """A backbone under torchvision's names."""
    rows = list(tables.torchvision_backbone("resnet18"))
    return exported(torch_architecture("resnet18", ("a",)), rows, tables.TORCH)


@cache
def smp_state() -> dict[str, np.ndarray]:
    """A network of segmentation_models_pytorch's design with 3 classes."""
    architecture = torch_architecture("mobilenet_v2", ("a", "b", "c"))
    rows = [*tables.torchvision_backbone("mobilenet_v2", "encoder."), *tables.smp_head(architecture)]
    return exported(architecture, rows, tables.TORCH)


def saved(folder: Path, state: dict[str, np.ndarray]) -> Path:
    (folder / "checkpoint.safetensors").write_bytes(save(state))
    return folder / "checkpoint.safetensors"


def cut(source: Path, share: float) -> Path:
    content = source.read_bytes()
    source.write_bytes(content[: int(len(content) * share)])
    return source


def copied(folder: Path, name: str) -> Path:
    (folder / "checkpoint.pth").write_bytes((GOLDEN / name).read_bytes())
    return folder / "checkpoint.pth"


def pickled(folder: Path) -> Path:
    (folder / "checkpoint.pth").write_bytes(pickle.dumps({"w": [1.0, 2.0]}, protocol=2))
    return folder / "checkpoint.pth"


class Bomb:
    """What a pickle can do when it is loaded."""

    def __reduce__(self):
        return exec, ("raise SystemExit('gone off')",)


def zipped(folder: Path, program: bytes, compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(folder / "checkpoint.pth", "w", compression) as archive:
        archive.writestr("archive/data.pkl", program)
        archive.writestr("archive/data/0", bytes(4096))
    return folder / "checkpoint.pth"


def huge_tensor() -> bytes:
    """A state dict whose only tensor says that it has 2^40 numbers."""
    count = b"\x8a\x08" + struct.pack("<q", 1 << 40)
    reference = b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpu" + count + b"tQ"
    view = b"ctorch._utils\n_rebuild_tensor_v2\n(" + reference + b"K\x00(" + count + b"t(K\x01ttR"
    return b"\x80\x02}X\x01\x00\x00\x00w" + view + b"s."


def altered_resnet() -> dict[str, np.ndarray]:
    state = dict(resnet18_state())
    del state["bn1.running_mean"]
    state["conv1.weight"] = np.zeros((64, 1, 7, 7), np.float32)
    state["layer9.weight"] = np.zeros(2, np.float32)
    state["bn1.bias"] = np.full(64, np.inf, np.float32)
    return state


def in_bfloat16(folder: Path) -> Path:
    text = b'{"w":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}}'
    (folder / "checkpoint.safetensors").write_bytes(struct.pack("<Q", len(text)) + text + bytes(4))
    return folder / "checkpoint.safetensors"


def resnet34(folder: Path) -> Path:
    names = [f"layer{stage + 1}.{unit}.conv1.weight" for stage, n in enumerate((3, 4, 6, 3)) for unit in range(n)]
    return saved(folder, dict.fromkeys(names, np.zeros(1, np.float32)))


def half_words(source: Path, *more: str) -> list[str]:
    """The command line that makes a model file smaller."""
    return [str(word) for word in ("weights", "half", source, "--out", source.parent / "out.safetensors", *more)]


def too_large(folder: Path) -> Path:
    weights = seeded_weights(SMALL)
    weights["classifier.bias"] = weights["classifier.bias"] + 1e5
    save_model(folder / "model.safetensors", SMALL, weights)
    return folder / "model.safetensors"


def truncated_half(folder: Path) -> Path:
    save_model(folder / "model.safetensors", SMALL, seeded_weights(SMALL), half=True)
    return cut(folder / "model.safetensors", 0.9)


def our_own(folder: Path) -> Path:
    (folder / "model.safetensors").write_bytes(_model_bytes(folder))
    return folder / "model.safetensors"


IMPORT_FAULTS: dict[str, tuple[int, Callable[[Path], list[str]]]] = {
    "no checkpoint": (1, lambda folder: import_words(folder / "nowhere.pth")),
    "truncated checkpoint": (1, lambda folder: import_words(cut(saved(folder, resnet18_state()), 0.5))),
    "truncated .pth": (1, lambda folder: import_words(cut(copied(folder, "tiny.pth"), 0.5))),
    "truncated .pth of the old format": (1, lambda folder: import_words(cut(copied(folder, "tiny_legacy.pth"), 0.95))),
    ".pth that PyTorch did not write": (1, lambda folder: import_words(pickled(folder))),
    "pickle bomb": (1, lambda folder: import_words(zipped(folder, pickle.dumps({"w": Bomb()}, protocol=2)))),
    "zip bomb": (1, lambda folder: import_words(zipped(folder, huge_tensor(), zipfile.ZIP_DEFLATED))),
    "huge declared tensor": (1, lambda folder: import_words(zipped(folder, huge_tensor()))),
    "bfloat16 checkpoint": (1, lambda folder: import_words(in_bfloat16(folder))),
    "unknown network": (1, lambda folder: import_words(saved(folder, {"a.weight": np.zeros(3, np.float32)}))),
    "unknown .pth network": (1, lambda folder: import_words(copied(folder, "tiny.pth"))),
    "ResNet-34": (1, lambda folder: import_words(resnet34(folder))),
    "tensors missing, left over, misshapen, infinite": (
        1,
        lambda folder: import_words(saved(folder, altered_resnet())),
    ),
    "too few class names": (1, lambda folder: import_words(saved(folder, smp_state()), "--classes", "sand", "rock")),
    "class names repeated": (
        1,
        lambda folder: import_words(saved(folder, smp_state()), "--classes", "sand", "rock", "sand"),
    ),
    "a model of our own": (1, lambda folder: import_words(our_own(folder))),
    "converted onto itself": (
        1,
        lambda folder: import_words(source := saved(folder, resnet18_state()), "--out", str(source)),
    ),
    "a model too large for half precision": (1, lambda folder: half_words(too_large(folder))),
    "a model in half precision truncated": (1, lambda folder: half_words(truncated_half(folder))),
    "a model halved onto itself": (
        1,
        lambda folder: half_words(source := our_own(folder), "--out", str(source)),
    ),
    "unknown word after weights": (2, lambda folder: ["weights", "export"]),
    "unknown public weights": (2, lambda folder: ["weights", "fetch", "vgg16", "--out", str(folder / "out")]),
}
