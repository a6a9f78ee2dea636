"""The scene's ground truth from above, and ways to spoil it or the command line of `jaxmap tune`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from fixtures import GRID
from scenes import BOXES_M, ROCK, SAND
from truth_files import write_raster

PIXEL_M, WEST_M, NORTH_M = 0.05, -3.0, 7.0
SIZE = (160, 120)

Damage = Callable[[Path, Path], list[str]]
"""Takes the scene and an empty folder, and returns the words after `tune`."""


def labels_from_above() -> np.ndarray:
    """Sand, and rock where the boxes stand; rows from the north."""
    rows, columns = np.indices(SIZE)
    x, y = WEST_M + (columns + 0.5) * PIXEL_M, NORTH_M - (rows + 0.5) * PIXEL_M
    labels = np.full(SIZE, SAND, np.uint8)
    for lower, upper in BOXES_M:
        labels[(x > lower[0]) & (x < upper[0]) & (y > lower[1]) & (y < upper[1])] = ROCK
    return labels


def write_truth(path: Path, labels: np.ndarray | None = None, **more: object) -> Path:
    """The scene's labelled orthomosaic."""
    labels = labels_from_above() if labels is None else labels
    return write_raster(path, labels, **{"west": WEST_M, "north": NORTH_M, "pixel_m": PIXEL_M, "crs": None} | more)


def tune_words(scene: Path, truth: Path, out: Path, *more: object) -> list[str]:
    """The command line that tunes on the scene, with its true labels."""
    labels = ("--labeller", "files", "--labels", scene / "labels")
    words = ("tune", scene, "--ground-truth", truth, "--out", out, *labels, *GRID, *more)
    return [str(word) for word in words]


def with_truth(labels: Callable[[np.ndarray], np.ndarray] = lambda labels: labels, **more: object) -> Damage:
    def damage(scene: Path, folder: Path) -> list[str]:
        truth = write_truth(folder / "truth.tif", labels(labels_from_above()), **more)
        return tune_words(scene, truth, folder / "fusion.yaml")

    return damage


def with_words(*words: str) -> Damage:
    def damage(scene: Path, folder: Path) -> list[str]:
        return tune_words(scene, write_truth(folder / "truth.tif"), folder / "fusion.yaml", *words)

    return damage


def no_raster(scene: Path, folder: Path) -> list[str]:
    (folder / "truth.tif").write_bytes(b"no raster at all")
    return tune_words(scene, folder / "truth.tif", folder / "fusion.yaml")


def truth_missing(scene: Path, folder: Path) -> list[str]:
    return tune_words(scene, folder / "nowhere.tif", folder / "fusion.yaml")


def out_there(scene: Path, folder: Path) -> list[str]:
    (folder / "fusion.yaml").write_text("mine")
    return tune_words(scene, write_truth(folder / "truth.tif"), folder / "fusion.yaml")


def out_no_yaml(scene: Path, folder: Path) -> list[str]:
    return tune_words(scene, write_truth(folder / "truth.tif"), folder / "fusion.json")


def truths_too_few(scene: Path, folder: Path) -> list[str]:
    return ["tune", str(scene), *tune_words(scene, write_truth(folder / "truth.tif"), folder / "fusion.yaml")[1:]]


def one_folder_of_labels(scene: Path, folder: Path) -> list[str]:
    truth = str(write_truth(folder / "truth.tif"))
    words = tune_words(scene, folder / "truth.tif", folder / "fusion.yaml")
    return ["tune", str(scene), str(scene), "--ground-truth", truth, truth, *words[4:]]


def no_labels(scene: Path, folder: Path) -> list[str]:
    truth = write_truth(folder / "truth.tif")
    words = ("tune", scene, "--ground-truth", truth, "--out", folder / "fusion.yaml", "--labeller", "none", *GRID)
    return [str(word) for word in words]


TUNE_FAULTS: dict[str, tuple[int, Damage]] = {
    "tune: truth missing": (1, truth_missing),
    "tune: truth is no raster": (1, no_raster),
    "tune: truth of another place": (1, with_truth(west=5000.0)),
    "tune: nothing labelled": (1, with_truth(np.zeros_like)),
    "tune: labelled only where nothing was seen": (
        1,
        with_truth(lambda labels: np.where(np.indices(SIZE)[0] > 150, labels, 0).astype(np.uint8)),
    ),
    "tune: sand alone": (1, with_truth(lambda labels: np.full_like(labels, SAND))),
    "tune: rock alone": (1, with_truth(lambda labels: np.full_like(labels, ROCK))),
    "tune: fewer truths than sequences": (2, truths_too_few),
    "tune: one folder of labels for two sequences": (2, one_folder_of_labels),
    "tune: out is there": (2, out_there),
    "tune: out is no YAML": (2, out_no_yaml),
    "tune: no labels at all": (2, no_labels),
    "tune: unknown class": (2, with_words("--class", "tree")),
    "tune: unknown parameter": (2, with_words("--frozen", "gravity")),
    "tune: nothing held out": (2, with_words("--held-out-share", "0")),
    "tune: rock weighs less than nothing": (2, with_words("--class-weight", "-1")),
    "tune: weight that is no number": (2, with_words("--iou-weight", "nan")),
    "tune: rock from no share on": (2, with_words("--rock-fraction", "0")),
    "tune: cells without size": (2, with_words("--cell-size-m", "0")),
    "tune: no steps": (2, with_words("--steps", "0")),
}
"""The exit status and the damage of each."""
