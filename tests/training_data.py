"""Tiny training data, and faults of a command line of `jaxmap train`, each with the exit status that it must give."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

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


def one_mask_missing(data: Path, folder: Path) -> None:
    (data / "masks" / "i2.png").unlink()


def out_is_file(data: Path, folder: Path) -> None:
    (folder / "run").write_text("")


def with_yaml(text: str) -> Damage:
    def damage(data: Path, folder: Path) -> list[str]:
        (folder / "mine.yaml").write_text(text)
        return ["--config", str(folder / "mine.yaml")]

    return damage


TRAIN_FAULTS: dict[str, tuple[int, Damage]] = {
    "one mask missing": (1, one_mask_missing),
    "a class named twice": (2, with_words("--classes", "rock", "rock")),
    "no such init": (1, with_words("--init", "nowhere/model.safetensors")),
    "scales the wrong way round": (2, with_words("--augmentation.scale", "2", "0.5")),
    "resume and overwrite": (2, with_words("--resume", "--overwrite")),
    "out of range on the command line": (2, with_words("--batch-size", "0")),
    "unknown keys in the config": (2, with_yaml("optimizer: {learning_rate: 1}\nloss: {dice: 1}\n")),
    "unknown config": (2, with_words("--config", "chiodini2019")),
    "out is a file": (1, out_is_file),
}
"""Those of reading, options and files are tested where they arise."""
