"""Makes docs/traverse.png, the picture of the README: what the rover saw, the voxel map, and the ground truth.

    python scripts/readme_picture.py [RUN]

RUN is the run folder of the last row of `jaxmap demo` (jaxmap_demo/relief_deeplab); without it the traverse is mapped
first, which takes a minute.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import rasterio
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

import jaxmap as jm
from jaxmap.commands.demo import SAMPLE, demo_rows
from jaxmap.commands.main import main as jaxmap_main
from jaxmap.datasets.samples import sample_truth
from jaxmap.host.output_folder import write_yaml
from jaxmap.labels import class_colours
from jaxmap.report.run_contents import RunContents, read_run
from jaxmap.runs.config import config_tree

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "traverse.png"
FRAME = "000004"
EYE_AZIMUTH_DEG, EYE_ELEVATION_DEG = -45.0, 33.0
"""Where the map is seen from in 3D: from behind the rover, east by north."""
SHADES = (0.74, 0.58, 1.0)
"""Light on faces normal to x, y and z."""
INK, SIZE_PX, DPI = "#222222", (1800, 720), 100


def voxels_in_3d(run: RunContents, width_px: int) -> Image.Image:
    """The occupied voxels in parallel projection, far faces drawn first."""
    voxel_map = jm.load_map(run.path / "map.zarr")[0]
    labels = np.asarray(jm.voxel_labels(voxel_map, *run.source.fusion))
    solid = labels != jm.IGNORE
    origin_m, size_m = np.asarray(voxel_map.grid.origin_m), np.asarray(voxel_map.grid.voxel_size_m)
    azimuth, elevation = np.deg2rad([EYE_AZIMUTH_DEG, EYE_ELEVATION_DEG])
    eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    corners_m, colours = [], []
    for axis in range(3):
        towards = int(eye[axis] > 0)
        beside = np.roll(np.pad(solid, 1), 1 - 2 * towards, axis)[1:-1, 1:-1, 1:-1]
        faces = np.argwhere(solid & ~beside)
        square = np.insert([[0, 0], [1, 0], [1, 1], [0, 1]], axis, towards, axis=1)
        corners_m.append(origin_m + (faces[:, None] + square) * size_m)
        colours.append(class_colours(run.classes)[labels[tuple(faces.T)]] * SHADES[axis])
    corners_m, colours = np.concatenate(corners_m), np.concatenate(colours).astype(int)
    order = np.argsort(corners_m.mean(axis=1) @ eye)
    seen = np.stack([corners_m @ right, -(corners_m @ np.cross(eye, right))], axis=-1)[order]
    low, high = seen.min(axis=(0, 1)), seen.max(axis=(0, 1))
    # Drawn at twice the size, for smooth edges.
    seen = (seen - low) * (2 * width_px / (high - low)[0])
    picture = Image.new("RGB", (2 * width_px, int(np.ceil(seen[..., 1].max()))), "white")
    draw = ImageDraw.Draw(picture)
    for corners, colour in zip(seen.reshape(-1, 8).tolist(), colours[order].tolist(), strict=True):
        draw.polygon(corners, fill=tuple(colour))
    return picture.resize((width_px, picture.height // 2), Image.Resampling.LANCZOS)


def read_raster(run: RunContents, name: str, bands: int | tuple[int, ...]) -> tuple[np.ndarray, tuple[float, ...]]:
    """A raster of the sample's ground truth, and its extent in the world of the map: west, east, south, north."""
    with rasterio.open(sample_truth() / name) as image:
        west, south, east, north = image.bounds - np.tile(run.attributes.site_origin[:2], 2)
        return image.read(bands).astype(float), (west, east, south, north)


def draw(run: RunContents) -> Figure:
    """The whole picture."""
    width, height = SIZE_PX
    figure = Figure((width / DPI, height / DPI), dpi=DPI, facecolor="white")

    def panel(left: int, top: int, wide: int, high: int, title: str):
        axes = figure.add_axes((left / width, 1 - (top + high) / height, wide / width, high / height))
        axes.set_title(title, loc="left", fontsize=11, color=INK, pad=5)
        axes.set_axis_off()
        return axes

    for top, kind, title in ((34, "left", "left image"), (392, "labels", "labels by DeepLabv3+ and relief")):
        axes = panel(12, top, 420, 316, title)
        axes.imshow(Image.open(run.path / "pictures" / f"{FRAME}_{kind}.png"), aspect="auto")
    title = "voxel map of 14 stereo pairs (sand, rock; white: not observed)"
    panel(452, 34, 980, 674, title).imshow(voxels_in_3d(run, 980), aspect="equal")
    figure.axes[-1].set_anchor("N")

    voxel_map = jm.load_map(run.path / "map.zarr")[0]
    grid, top_down = voxel_map.grid, jm.top_down(voxel_map, *run.source.fusion)
    low = np.asarray(grid.origin_m)[:2]
    high = low + np.asarray(grid.voxel_size_m)[:2] * grid.shape[:2]
    colours = class_colours(run.classes)
    colours[jm.IGNORE] = 255
    above = panel(1450, 34, 338, 316, "top-down map and path")
    above.imshow(colours[np.asarray(top_down.label).T], origin="lower", extent=(low[0], high[0], low[1], high[1]))
    path = run.trajectory_world
    above.plot(path[:, 0], path[:, 1], color=INK, linewidth=2)
    below = panel(1450, 392, 338, 316, "orthomosaic, true rocks outlined")
    ground, extent = read_raster(run, "orthomosaic.tif", (1, 2, 3))
    below.imshow(ground.mean(axis=0), cmap="gray", extent=extent)
    rocks, extent = read_raster(run, "orthomosaic_labels.tif", 1)
    below.contour(rocks == 2, levels=[0.5], colors=[colours[2] / 255], linewidths=1.2, extent=extent, origin="upper")
    for axes in (above, below):
        axes.set_xlim(low[0] + 0.8, high[0] - 0.4)
        axes.set_ylim(low[1], high[1] - 0.4)
    return figure


def main() -> int:
    """Maps the traverse unless a run is given, and draws it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", type=Path)
    run = parser.parse_args().run
    with tempfile.TemporaryDirectory() as name:
        folder = run or Path(name) / "run"
        if run is None:
            write_yaml(Path(name) / "config.yaml", config_tree(demo_rows()["relief_deeplab"][1]))
            jaxmap_main(["map", SAMPLE, "--out", str(folder), "--config", str(Path(name) / "config.yaml")])
        draw(read_run(folder)).savefig(Path(name) / "picture.png")
        Image.open(Path(name) / "picture.png").convert("RGB").quantize(256).save(PICTURE, optimize=True)
    print(f"wrote {PICTURE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
