"""Ways to spoil a plain folder or the command line of `jaxmap map`, each with the exit status it must give."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml
from networks import write_small_model
from PIL import Image
from safetensors.numpy import save_file
from scenes import CAMERA

Damage = Callable[[Path, Path], list[str] | None]
"""Takes the scene and an empty folder, and returns words for the command line."""


def rewrite(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("".join(f"{line}\n" for line in change(path.read_text().splitlines())))


def with_camera(**changes: object) -> Damage:
    def damage(scene: Path, folder: Path) -> None:
        (scene / "camera.yaml").write_text(yaml.safe_dump({**CAMERA, **changes}))

    return damage


def with_yaml(text: str) -> Damage:
    def damage(scene: Path, folder: Path) -> list[str]:
        (folder / "mine.yaml").write_text(text)
        return ["--config", str(folder / "mine.yaml")]

    return damage


def with_words(*words: str) -> Damage:
    return lambda scene, folder: list(words)


def missing_right(scene: Path, folder: Path) -> list[str]:
    (scene / "right" / "f002.png").unlink()
    return ["--strict"]


def missing_left(scene: Path, folder: Path) -> None:
    (scene / "left" / "f002.png").unlink()


def truncated(scene: Path, folder: Path) -> list[str]:
    image = scene / "left" / "f001.png"
    image.write_bytes(image.read_bytes()[:4000])
    return ["--strict"]


def no_image(scene: Path, folder: Path) -> list[str]:
    (scene / "right" / "f000.png").write_bytes(b"no picture at all")
    return ["--strict"]


def smaller_right(scene: Path, folder: Path) -> list[str]:
    Image.fromarray(np.zeros((90, 160), np.uint8)).save(scene / "right" / "f000.png")
    return ["--strict"]


def smaller_pair(scene: Path, folder: Path) -> list[str]:
    for side in ("left", "right"):
        Image.fromarray(np.zeros((90, 160), np.uint8)).save(scene / side / "f003.png")
    return ["--strict"]


def all_unreadable(scene: Path, folder: Path) -> None:
    for image in (scene / "right").iterdir():
        image.write_bytes(b"no picture at all")


def times_back(scene: Path, folder: Path) -> None:
    rewrite(scene / "times.txt", lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]])


def pose_times_back(scene: Path, folder: Path) -> None:
    rewrite(scene / "poses.tum", lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]])


def no_times(scene: Path, folder: Path) -> None:
    (scene / "times.txt").unlink()
    rewrite(scene / "poses.tum", lambda lines: lines[:-1])


def nan_time(scene: Path, folder: Path) -> None:
    rewrite(scene / "times.txt", lambda lines: [*lines[:2], "nan", *lines[3:]])


def nan_pose(scene: Path, folder: Path) -> None:
    rewrite(scene / "poses.tum", lambda lines: [*lines[:3], re.sub(r" \S+", " nan", lines[3], count=1), *lines[4:]])


def long_quaternion(scene: Path, folder: Path) -> None:
    rewrite(scene / "poses.tum", lambda lines: [*lines[:3], lines[3].rsplit(" ", 1)[0] + " 3", *lines[4:]])


def skewed_pose(scene: Path, folder: Path) -> list[str]:
    rows = ["1 0 0 0 0 0 1 0 0 -1 0 1"] * 5 + ["1 0 0.4 0 0 0 1 0 0 -1 0 1"]
    (folder / "poses.txt").write_text("\n".join(rows))
    return ["--poses", str(folder / "poses.txt")]


def no_poses(scene: Path, folder: Path) -> None:
    (scene / "poses.tum").unlink()


def other_clock(scene: Path, folder: Path) -> None:
    rewrite(scene / "times.txt", lambda lines: [str(float(line) + 1000) for line in lines])


def no_calibration(scene: Path, folder: Path) -> None:
    (scene / "camera.yaml").unlink()


def swapped(scene: Path, folder: Path) -> None:
    (scene / "left").rename(scene / "aside")
    (scene / "right").rename(scene / "left")
    (scene / "aside").rename(scene / "right")


def no_images(scene: Path, folder: Path) -> None:
    for image in (scene / "left").iterdir():
        image.unlink()


def labels(damage: Callable[[Path], None]) -> Damage:
    def spoil(scene: Path, folder: Path) -> list[str]:
        damage(scene / "labels")
        return ["--labeller", "files", "--labels", str(scene / "labels"), "--strict"]

    return spoil


def missing_label(folder: Path) -> None:
    (folder / "f002.png").unlink()


def first_label_missing(folder: Path) -> None:
    (folder / "f000.png").unlink()


def small_label(folder: Path) -> None:
    Image.fromarray(np.zeros((60, 80), np.uint8)).save(folder / "f000.png")


def strange_label(folder: Path) -> None:
    Image.fromarray(np.full((120, 160), 7, np.uint8)).save(folder / "f000.png")


def colour_label(folder: Path) -> None:
    Image.fromarray(np.zeros((120, 160, 3), np.uint8)).save(folder / "f000.png")


def wild_probabilities(folder: Path) -> None:
    for file in list(folder.iterdir()):
        file.unlink()
        np.save(folder / f"{file.stem}.npy", np.full((120, 160, 3), 0.7, np.float32))


def deeplab(*words: str, **model: bool) -> Damage:
    def damage(scene: Path, folder: Path) -> list[str]:
        path = write_small_model(folder / "model.safetensors", **model)
        return ["--labeller", "deeplab", "--model", str(path), *words]

    return damage


def no_model(scene: Path, folder: Path) -> list[str]:
    save_file({"weight": np.zeros(3, np.float32)}, folder / "model.safetensors")
    return ["--labeller", "deeplab", "--model", str(folder / "model.safetensors")]


MAP_FAULTS: dict[str, tuple[int, Damage]] = {
    "missing right image": (1, missing_right),
    "missing left image": (1, missing_left),
    "truncated image": (1, truncated),
    "not an image": (1, no_image),
    "left and right of different size": (1, smaller_right),
    "one pair of another size": (1, smaller_pair),
    "all frames unreadable": (1, all_unreadable),
    "images of another size than the calibration": (1, with_camera(image_size_px=[320, 240])),
    "times not increasing": (1, times_back),
    "pose times not increasing": (1, pose_times_back),
    "no times": (1, no_times),
    "NaN time": (1, nan_time),
    "NaN pose": (1, nan_pose),
    "quaternion without unit norm": (1, long_quaternion),
    "non-rigid pose": (1, skewed_pose),
    "no poses": (1, no_poses),
    "poses of another clock": (1, other_clock),
    "no such pose file": (1, with_words("--poses", "nowhere/poses.tum")),
    "zero baseline": (1, with_camera(baseline_m=0.0)),
    "negative baseline": (1, with_camera(baseline_m=-0.12)),
    "NaN focal length": (1, with_camera(fx_px=float("nan"))),
    "no calibration": (1, no_calibration),
    "unknown calibration key": (1, with_camera(baseline=0.1)),
    "left and right swapped": (1, swapped),
    "no images": (1, no_images),
    "no frame selected": (1, with_words("--start", "9")),
    "unknown data set": (2, with_words("--dataset", "mars")),
    "another data set": (1, with_words("--dataset", "kitti")),
    "unknown keys in the config": (2, with_yaml("grid: {voxel_size: 0.1}\nlabeler: plane\n")),
    "out of range in the config": (2, with_yaml("fusion: {occupancy_prior: 1.5}\nstride: 0\n")),
    "NaN in the config": (2, with_yaml("depth: {max_m: .nan}\n")),
    "wrong type in the config": (2, with_yaml("grid: 3\n")),
    "keys that are no text in the config": (2, with_yaml("1.5: 3\nnull: 2\n")),
    "malformed YAML": (2, with_yaml("grid: [0.1\nstride: 1\n")),
    "a config that is a list": (2, with_yaml("- 1\n")),
    "unknown config": (2, with_words("--config", "chiodini2019")),
    "out of range on the command line": (2, with_words("--plane.threshold-m", "-1")),
    "unknown class": (2, with_words("--plane.off-plane", "boulder")),
    "nearest depth beyond the farthest": (2, with_words("--depth.min-m", "9")),
    "odd disparities": (2, with_words("--stereo.num-disparities", "20")),
    "even block": (2, with_words("--stereo.block-size", "4")),
    "matrix of another size": (2, with_yaml("fusion: {class_increments: [[1, 0], [0, 1]]}\n")),
    "penalties the wrong way round": (2, with_words("--stereo.p1", "9", "--stereo.p2", "3")),
    "too large a map": (1, with_words("--grid.max-memory-gib", "1e-4", "--grid.voxel-size-m", "0.1")),
    "too many members": (
        1,
        with_words("--grid.max-memory-gib", "1e-3", "--grid.voxel-size-m", "0.1", "--ensemble.members", "40"),
    ),
    "an ensemble without a class": (2, with_words("--ensemble.members", "2", "--labeller", "none")),
    "an ensemble of a spread below zero": (2, with_words("--ensemble.heading-sigma-rad", "-1")),
    "bounds the wrong way round": (2, with_words("--grid.lower-m", "3", "0", "0")),
    "files without a folder": (2, with_words("--labeller", "files")),
    "no such folder of labels": (1, with_words("--labeller", "files", "--labels", "nowhere")),
    "missing label": (1, labels(missing_label)),
    "first label missing": (1, labels(first_label_missing)),
    "label of another size": (1, labels(small_label)),
    "class out of range": (1, labels(strange_label)),
    "label in colours": (1, labels(colour_label)),
    "probabilities over 1": (1, labels(wild_probabilities)),
    "a model without deeplab": (2, with_words("--model", "model.safetensors")),
    "no such model": (1, with_words("--labeller", "deeplab", "--model", "nowhere.safetensors")),
    "a model that is none": (1, no_model),
    "a backbone to label the map": (1, deeplab(backbone_only=True)),
    "another model than was told": (2, deeplab("--model-sha256", "0" * 64)),
    "classes that the network has not": (2, deeplab("--classes", "sand", "mud", "clay")),
    "a class map of unknown names": (
        2,
        deeplab("--classes", "sand", "rock", "--deeplab.class-map", "stone=rock", "pebble=rock", "gravel=stones"),
    ),
    "a network of no size": (2, deeplab("--deeplab.size-px", "0", "64")),
    "no temperature": (2, deeplab("--deeplab.temperature", "0")),
}
