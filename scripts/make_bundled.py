"""Makes again what is bundled with jaxmap: the sample traverse and the network for rovers on sand.

    python scripts/make_bundled.py --work DIR [--only model|traverse]

Worlds are simulated (extra `sim`), with the seeds below. Images of other worlds train the network from scratch, by
`jaxmap train --config rover`; a traverse through a world that it never saw becomes the sample. Takes about two hours on
two cores; an interrupted run is resumed.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

BUNDLED = Path(__file__).resolve().parents[1] / "jaxmap" / "bundled"
TRAINING_SETS = (
    {"--training": "268", "--seed": "5001", "--size": "384 512"},
    {"--training": "200", "--seed": "5002", "--size": "576 768"},
)
"""Two sets of images; the larger ones show what the cameras of a rover see at full size."""

BY_BATCH = {"--norm.backbone": "batch", "--norm.head": "batch"}
STAGES: dict[str, tuple[int, dict[str, str]]] = {
    "first": (1, {}),
    "second": (1, BY_BATCH | {"--epochs": "36"}),
    "third": (
        2,
        BY_BATCH
        | {"--epochs": "24", "--augmentation.class-share": "0.6"}
        | {"--augmentation.crop-px": "320 448", "--augmentation.scale": "0.5 1.4"},
    ),
}
"""Stages of training, each from the network of the one before and with a fresh schedule: on how many sets, and how."""
TRAVERSE = {"--scene": "few", "--seed": "101"}
JPEG_QUALITY = 93
"""The sample's images are JPEG files in full colour resolution; as PNG files they would be five times as large."""


def main() -> None:
    """Makes both, or one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for what is made on the way")
    parser.add_argument("--only", choices=("model", "traverse"))
    given = parser.parse_args()
    if given.only != "traverse":
        make_model(given.work)
    if given.only != "model":
        make_traverse(given.work)


def make_model(work: Path) -> None:
    """Renders the training sets, trains on them, and copies the model."""
    sets = [work / f"images_{options['--seed']}" for options in TRAINING_SETS]
    for folder, options in zip(sets, TRAINING_SETS, strict=True):
        jaxmap("simulate", "--out", folder, *words(options))
    start: list[str | Path] = []
    for name, (count, options) in STAGES.items():
        run, images = work / name, joined(work / f"images_of_{name}", sets[:count])
        resume = ["--resume"] if run.exists() else []
        jaxmap("train", images, "--out", run, "--config", "rover", *start, *words(options), *resume)
        start = ["--init", run / "model.safetensors"]
    shutil.copyfile(start[1], BUNDLED / "rover.safetensors")


def joined(folder: Path, sets: list[Path]) -> Path:
    """A folder of links to the images of several sets, with their lists joined."""
    for kind in ("images", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        for path in (path for one in sets for path in sorted((one / kind).glob("*.png"))):
            link = folder / kind / path.name
            if not link.exists():
                link.symlink_to(path.resolve())
    for name in ("train.txt", "val.txt"):
        (folder / name).write_text("".join((one / name).read_text() for one in sets))
    return folder


def make_traverse(work: Path) -> None:
    """Renders the traverse, and copies what the demo and the readers need."""
    source, target = work / "traverse", BUNDLED / "traverse"
    jaxmap("simulate", "--out", source, *words(TRAVERSE))
    shutil.rmtree(target, ignore_errors=True)
    (target / "Part1" / "LocCam").mkdir(parents=True)
    (target / "gt" / "labels").mkdir(parents=True)
    for path in sorted((source / "Part1").glob("*.txt")):
        shutil.copyfile(path, target / "Part1" / path.name)
    for path in sorted((source / "Part1" / "LocCam").glob("*.png")):
        with Image.open(path) as image:
            image.save(target / "Part1" / "LocCam" / f"{path.stem}.jpg", quality=JPEG_QUALITY, subsampling=0)
    for path in sorted((source / "gt" / "labels").glob("*.png")):
        shutil.copyfile(path, target / "gt" / "labels" / path.name)
    shutil.copyfile(source / "gt" / "poses_utm.tum", target / "gt" / "poses_utm.tum")
    copy_rasters(source / "gt", target / "gt")
    size_mib = sum(path.stat().st_size for path in target.rglob("*") if path.is_file()) / 2**20
    print(f"{target}: {size_mib:.1f} MiB")


def copy_rasters(source: Path, target: Path) -> None:
    """The labelled orthomosaic as it is; the orthomosaic with JPEG compression."""
    import rasterio

    shutil.copyfile(source / "orthomosaic_labels.tif", target / "orthomosaic_labels.tif")
    with rasterio.open(source / "orthomosaic.tif") as file:
        pixels, profile = file.read(), file.profile
    profile.pop("predictor", None)
    profile.update(compress="jpeg", photometric="ycbcr", jpeg_quality=85, interleave="pixel", tiled=True)
    profile.update(blockxsize=256, blockysize=256)
    with rasterio.open(target / "orthomosaic.tif", "w", **profile) as file:
        file.write(np.asarray(pixels))


def words(options: dict[str, str]) -> list[str]:
    """Options as words of a command line."""
    return [word for name, value in options.items() for word in (name, *value.split())]


def jaxmap(*command: str | Path) -> None:
    """Runs a command of jaxmap; stops where it fails."""
    if status := subprocess.run([sys.executable, "-m", "jaxmap", *map(str, command)]).returncode:
        raise SystemExit(status)


if __name__ == "__main__":
    main()
