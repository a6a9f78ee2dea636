"""Tiny training data, and ways to spoil them, each with the exit status that `jaxmap train` must give."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from golden.seeded_weights import seeded_weights
from PIL import Image

from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import save_model

CLASSES = ("sand", "rock")


def scene(size_px: tuple[int, int], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A dark rock on bright sand, and its labels."""
    draw = np.random.default_rng(seed)
    rows, columns = np.indices(size_px)
    middle = draw.uniform(0.3, 0.7, 2) * size_px
    labels = (np.hypot(rows - middle[0], columns - middle[1]) < 0.3 * min(size_px)).astype(np.uint8)
    image = np.where(labels[..., None] == 1, (90, 40, 30), (200, 170, 120)) + draw.integers(-20, 20, (*size_px, 3))
    return image.astype(np.uint8), labels


def write_pair(folder: Path, name: str, image: np.ndarray, labels: np.ndarray) -> None:
    for part, pixels in (("images", image), ("masks", labels)):
        (folder / part).mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / part / f"{name}.png")


def write_data(folder: Path) -> Path:
    """Five images of two sizes to train on, two of one size to validate."""
    for index in range(7):
        image, labels = scene((36, 44) if index % 2 else (40, 40), index)
        labels[:2] = 255
        write_pair(folder, f"i{index}", image, labels)
    (folder / "val.txt").write_text("i1\ni3\n")
    return folder


Damage = Callable[[Path, Path], list[str] | None]
"""Takes the data and an empty folder, and returns words for the command line."""


def with_words(*words: str) -> Damage:
    return lambda data, folder: list(words)


def change_mask(data: Path, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    path = data / "masks" / f"{name}.png"
    with Image.open(path) as image:
        mask = np.array(image)
    Image.fromarray(change(mask)).save(path)


def without(part: str) -> Damage:
    return lambda data, folder: shutil.rmtree(data / part)


def emptied(part: str) -> Damage:
    def damage(data: Path, folder: Path) -> None:
        for path in (data / part).iterdir():
            path.unlink()

    return damage


def one_mask_missing(data: Path, folder: Path) -> None:
    (data / "masks" / "i2.png").unlink()


def small_mask(data: Path, folder: Path) -> None:
    change_mask(data, "i2", lambda mask: mask[1:])


def strange_label(data: Path, folder: Path) -> None:
    change_mask(data, "i2", lambda mask: np.where(mask == 1, 7, mask).astype(np.uint8))


def colour_mask(data: Path, folder: Path) -> None:
    change_mask(data, "i2", lambda mask: np.stack([mask, mask, 0 * mask], axis=-1))


def truncated_image(data: Path, folder: Path) -> None:
    image = data / "images" / "i2.png"
    image.write_bytes(image.read_bytes()[:1000])


def no_image(data: Path, folder: Path) -> None:
    (data / "images" / "i2.png").write_bytes(b"no picture at all")


def unknown_name(data: Path, folder: Path) -> None:
    (data / "val.txt").write_text("i1\ni99\n")


def list_of_junk(data: Path, folder: Path) -> None:
    (data / "val.txt").write_bytes(bytes(range(128, 256)))


def all_validate(data: Path, folder: Path) -> None:
    (data / "val.txt").write_text("".join(f"i{index}\n" for index in range(7)))


def with_init(change: Callable[[Path], None], *words: str) -> Damage:
    def damage(data: Path, folder: Path) -> list[str]:
        record = replace(torch_architecture("mobilenet_v2", CLASSES), top_conv=False, head_channels=8)
        weights = {name: value for name, value in seeded_weights(record).items() if name.startswith("backbone.")}
        save_model(folder / "init.safetensors", record, weights, holds="backbone")
        change(folder / "init.safetensors")
        return ["--init", str(folder / "init.safetensors"), *words]

    return damage


def halved(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def foreign_run(data: Path, folder: Path) -> None:
    (folder / "run").mkdir()
    (folder / "run" / "history.csv").write_text("another's")


def out_is_file(data: Path, folder: Path) -> None:
    (folder / "run").write_text("")


def with_yaml(text: str) -> Damage:
    def damage(data: Path, folder: Path) -> list[str]:
        (folder / "mine.yaml").write_text(text)
        return ["--config", str(folder / "mine.yaml")]

    return damage


TRAIN_FAULTS: dict[str, tuple[int, Damage]] = {
    "no folder of images": (1, without("images")),
    "no folder of masks": (1, without("masks")),
    "no images": (1, emptied("images")),
    "no masks": (1, emptied("masks")),
    "one mask missing": (1, one_mask_missing),
    "mask of another size": (1, small_mask),
    "label out of range": (1, strange_label),
    "mask in colours": (1, colour_mask),
    "truncated image": (1, truncated_image),
    "not an image": (1, no_image),
    "a name that is no image": (1, unknown_name),
    "a list that is no text": (1, list_of_junk),
    "no image left to train on": (1, all_validate),
    "a class that is never there": (1, with_words("--classes", "sand", "rock", "water")),
    "a class named twice": (2, with_words("--classes", "rock", "rock")),
    "a remap of an unknown class": (2, with_words("--data.remap", "0", "sand", "1", "stone")),
    "no such init": (1, with_words("--init", "nowhere/model.safetensors")),
    "init of another backbone": (2, with_init(lambda path: None, "--network.backbone", "resnet18")),
    "truncated init": (1, with_init(halved)),
    "init that is no model": (1, with_init(lambda path: path.write_bytes(b"junk" * 99) and None)),
    "scales the wrong way round": (2, with_words("--augmentation.scale", "2", "0.5")),
    "no loss at all": (2, with_words("--loss.cross-entropy", "0")),
    "another number of class weights": (2, with_words("--loss.class-weights", "1", "2", "3")),
    "resume and overwrite": (2, with_words("--resume", "--overwrite")),
    "out of range on the command line": (2, with_words("--batch-size", "0")),
    "crop too small": (2, with_words("--augmentation.crop-px", "8", "8")),
    "NaN in the config": (2, with_yaml("optimiser: {learning_rate: .nan}\n")),
    "unknown keys in the config": (2, with_yaml("optimizer: {learning_rate: 1}\nloss: {dice: 1}\n")),
    "a config of map": (2, with_yaml("grid: {voxel_size_m: 0.2}\n")),
    "unknown config": (2, with_words("--config", "chiodini2019")),
    "files of another in the run folder": (1, foreign_run),
    "out is a file": (1, out_is_file),
}
