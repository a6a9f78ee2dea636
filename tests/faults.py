"""Ways to spoil a plain folder or the settings of `jaxmap map`, each with the exit status it must give."""

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

Damage = Callable[[Path, Path], dict[str, object] | None]
"""Takes the scene and an empty folder, and returns settings."""


def rewrite(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("".join(f"{line}\n" for line in change(path.read_text().splitlines())))


def with_camera(**changes: object) -> Damage:
    def damage(scene: Path, folder: Path) -> None:
        (scene / "camera.yaml").write_text(yaml.safe_dump({**CAMERA, **changes}))

    return damage


def with_settings(**settings: object) -> Damage:
    return lambda scene, folder: settings


def missing_right(scene: Path, folder: Path) -> None:
    (scene / "right" / "f002.png").unlink()


def missing_left(scene: Path, folder: Path) -> None:
    (scene / "left" / "f002.png").unlink()


def truncated(scene: Path, folder: Path) -> None:
    image = scene / "left" / "f001.png"
    image.write_bytes(image.read_bytes()[:4000])


def no_image(scene: Path, folder: Path) -> None:
    (scene / "right" / "f000.png").write_bytes(b"no picture at all")


def smaller_right(scene: Path, folder: Path) -> None:
    Image.fromarray(np.zeros((90, 160), np.uint8)).save(scene / "right" / "f000.png")


def smaller_pair(scene: Path, folder: Path) -> None:
    for side in ("left", "right"):
        Image.fromarray(np.zeros((90, 160), np.uint8)).save(scene / side / "f003.png")


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


def skewed_pose(scene: Path, folder: Path) -> dict[str, object]:
    rows = ["1 0 0 0 0 0 1 0 0 -1 0 1"] * 5 + ["1 0 0.4 0 0 0 1 0 0 -1 0 1"]
    (folder / "poses.txt").write_text("\n".join(rows))
    return {"poses": folder / "poses.txt"}


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
    def spoil(scene: Path, folder: Path) -> dict[str, object]:
        damage(scene / "labels")
        return {"labeller": "files", "labels": scene / "labels"}

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
    Image.new("RGB", (160, 120), "red").save(folder / "f000.png")


def wild_probabilities(folder: Path) -> None:
    for file in list(folder.iterdir()):
        file.unlink()
        np.save(folder / f"{file.stem}.npy", np.full((120, 160, 3), 0.7, np.float32))


def deeplab(*, backbone_only: bool = False, **settings: object) -> Damage:
    def damage(scene: Path, folder: Path) -> dict[str, object]:
        path = write_small_model(folder / "model.safetensors", backbone_only=backbone_only)
        return {"labeller": "deeplab", "model": path, **settings}

    return damage


def no_model(scene: Path, folder: Path) -> dict[str, object]:
    save_file({"weight": np.zeros(3, np.float32)}, folder / "model.safetensors")
    return {"labeller": "deeplab", "model": folder / "model.safetensors"}


SEQUENCE_FAULTS: dict[str, tuple[int, Damage]] = {
    "missing left image": (1, missing_left),
    "times not increasing": (1, times_back),
    "pose times not increasing": (1, pose_times_back),
    "no times": (1, no_times),
    "NaN time": (1, nan_time),
    "NaN pose": (1, nan_pose),
    "quaternion without unit norm": (1, long_quaternion),
    "non-rigid pose": (1, skewed_pose),
    "no poses": (1, no_poses),
    "poses of another clock": (1, other_clock),
    "no such pose file": (1, with_settings(poses=Path("nowhere/poses.tum"))),
    "images of another size than the calibration": (1, with_camera(image_size_px=[320, 240])),
    "zero baseline": (1, with_camera(baseline_m=0.0)),
    "negative baseline": (1, with_camera(baseline_m=-0.12)),
    "NaN focal length": (1, with_camera(fx_px=float("nan"))),
    "no calibration": (1, no_calibration),
    "unknown calibration key": (1, with_camera(baseline=0.1)),
    "no images": (1, no_images),
    "no frame selected": (1, with_settings(start=9)),
    "unknown data set": (2, with_settings(dataset="mars")),
    "another data set": (1, with_settings(dataset="kitti")),
}
"""Found when the sequence is opened."""

FRAME_FAULTS: dict[str, tuple[int, Damage]] = {
    "missing right image": (1, missing_right),
    "truncated image": (1, truncated),
    "not an image": (1, no_image),
    "left and right of different size": (1, smaller_right),
    "one pair of another size": (1, smaller_pair),
    "left and right swapped": (1, swapped),
    "missing label": (1, labels(missing_label)),
    "label of another size": (1, labels(small_label)),
    "class out of range": (1, labels(strange_label)),
    "label in colours": (1, labels(colour_label)),
    "probabilities over 1": (1, labels(wild_probabilities)),
}
"""Found when a frame is read."""

SETTINGS_FAULTS: dict[str, tuple[int, Damage]] = {
    "out of range": (2, with_settings(plane={"threshold_m": -1.0})),
    "unknown class": (2, with_settings(plane={"off_plane": "boulder"})),
    "nearest depth beyond the farthest": (2, with_settings(depth={"min_m": 9.0})),
    "odd disparities": (2, with_settings(stereo={"num_disparities": 20})),
    "even block": (2, with_settings(stereo={"block_size": 4})),
    "penalties the wrong way round": (2, with_settings(stereo={"p1": 9, "p2": 3})),
    "matrix of another size": (2, with_settings(fusion={"class_increments": [[1.0, 0.0], [0.0, 1.0]]})),
    "too large a map": (1, with_settings(grid={"max_memory_gib": 1e-4, "voxel_size_m": 0.1})),
    "more voxels than 64 bits can count": (1, with_settings(grid={"voxel_size_m": 1e-6})),
    "too many members": (
        1,
        with_settings(grid={"max_memory_gib": 1e-3, "voxel_size_m": 0.1}, ensemble={"members": 40}),
    ),
    "an ensemble without a class": (2, with_settings(ensemble={"members": 2}, labeller="none")),
    "an ensemble of a spread below zero": (2, with_settings(ensemble={"heading_sigma_rad": -1.0})),
    "one bound alone": (2, with_settings(grid={"upper_m": None})),
    "bounds the wrong way round": (2, with_settings(grid={"lower_m": [3.0, 0.0, 0.0]})),
    "files without a folder": (2, with_settings(labeller="files")),
    "no such folder of labels": (1, with_settings(labeller="files", labels=Path("nowhere"))),
    "first label missing": (1, labels(first_label_missing)),
    "relief beside the plane": (2, with_settings(relief={"combine": True})),
    "relief beside itself": (2, with_settings(labeller="relief", relief={"combine": True})),
    "relief without its class": (2, with_settings(labeller="relief", classes=["sand", "mud"])),
    "a softness of none": (2, with_settings(labeller="relief", relief={"softness_m": 0.0})),
    "a model without deeplab": (2, with_settings(model=Path("model.safetensors"))),
    "no such model": (1, with_settings(labeller="deeplab", model=Path("nowhere.safetensors"))),
    "a model that is none": (1, no_model),
    "a backbone to label the map": (1, deeplab(backbone_only=True)),
    "another model than recorded": (2, deeplab(model_sha256="0" * 64)),
    "classes that the network has not": (2, deeplab(classes=["sand", "mud", "clay"])),
    "a class map of unknown names": (
        2,
        deeplab(
            classes=["sand", "rock"],
            deeplab={"class_map": {"stone": "rock", "pebble": "rock", "gravel": "stones"}},
        ),
    ),
    "a network of no size": (2, deeplab(deeplab={"size_px": [0, 64]})),
    "no temperature": (2, deeplab(deeplab={"temperature": 0.0})),
}
"""Found when the settings are checked and the run is planned."""

CONFIG_FAULTS: dict[str, str] = {
    "unknown keys in the config": "grid: {voxel_size: 0.1}\nlabeler: plane\n",
    "out of range in the config": "fusion: {occupancy_prior: 1.5}\nstride: 0\n",
    "NaN in the config": "depth: {max_m: .nan}\n",
    "wrong type in the config": "grid: 3\n",
    "keys that are no text in the config": "1.5: 3\nnull: 2\n",
    "malformed YAML": "grid: [0.1\nstride: 1\n",
    "a config that is a list": "- 1\n",
}
"""Found when a YAML file is read; all have exit status 2."""
