"""How long the report of a large map takes, and how much memory: a winding traverse of bumpy ground, made tile by tile.

    python scripts/benchmarks/large_report.py --metres 500 --out FOLDER

Prints tiles, voxels, seconds for each hundred tiles, peak resident memory and the size of the page.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from jaxmap.datasets.poses import write_tum
from jaxmap.export.formats import OF_EACH_RUN
from jaxmap.host.memory import peak_resident_mib
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.store import open_map
from jaxmap.mapping.tile_arrays import TileValues
from jaxmap.mapping.tiles import TILE, TileStore, whole_tiles
from jaxmap.report.run_page import write_report
from jaxmap.runs.exports import write_exports
from jaxmap.runs.folder import RunFolder
from jaxmap.types import make_grid

SIZE_M, WIDTH_M = (0.05, 0.05, 0.2), 8.0
SITE = np.array([595112.0, 5785753.0, 45.0])


def path_of(metres: float) -> np.ndarray:
    """Positions every half metre along a winding way, relative to the site."""
    along = np.arange(0, metres, 0.5)
    heading = 0.9 * np.sin(along / 40) + 0.5 * np.sin(along / 13)
    steps = 0.5 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.column_stack([np.cumsum(steps, axis=0), np.full(len(along), 1.0)])


def ground_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the ground."""
    return 0.5 * np.sin(x / 9) * np.cos(y / 7) + 0.1 * np.sin(x / 1.3) * np.sin(y / 1.7)


def write_map(run: Path, path: np.ndarray) -> None:
    """The map: the ground as far as half the width from the path, with rocks."""
    low, high = path.min(axis=0) - WIDTH_M, path.max(axis=0) + WIDTH_M
    low[2], high[2] = -1.2, 1.6
    grid = whole_tiles(make_grid(low, high, SIZE_M, np.zeros(3)))
    store = TileStore(run / "map.zarr", grid, ROVER_CLASSES)
    size_m, corner_m, layers = np.array(SIZE_M), np.asarray(grid.origin_m, np.float64), grid.shape[2]
    near = np.unique(((path[:, :2] - corner_m[:2]) / size_m[:2] // TILE[:2]).astype(int), axis=0)
    tiles = np.unique((near[:, None, None] + np.mgrid[-1:2, -1:2].T.reshape(1, 9, 1, 2)).reshape(-1, 2), axis=0)
    for i, j in tiles[((tiles >= 0) & (tiles < np.array(grid.shape[:2]) // TILE[:2])).all(axis=1)]:
        x, y = np.meshgrid(
            *(corner_m[a] + ((t * TILE[a]) + np.arange(TILE[a]) + 0.5) * size_m[a] for a, t in ((0, i), (1, j))),
            indexing="ij",
        )
        rng = np.random.default_rng([i, j])
        rocks = rng.uniform(0, TILE[0], (12, 2))
        height = np.zeros(TILE[:2])
        for rock in rocks:
            away = np.hypot(*(np.mgrid[: TILE[0], : TILE[1]] - rock[:, None, None]))
            height = np.maximum(height, 0.45 * np.exp(-((away / 4) ** 2)))
        z = ground_m(x, y) + height
        level = np.clip((z - corner_m[2]) / size_m[2], 0, layers - 1).astype(int)
        values = np.zeros((4, *TILE[:2], layers), np.float32)
        at = (*np.mgrid[: TILE[0], : TILE[1]], level)
        values[(0, *at)] = 2.0
        values[(2, *at)], values[(3, *at)] = np.where(height > 0.12, -2, 2), np.where(height > 0.12, 3, -3)
        for k in range(layers // TILE[2]):
            part = values[..., k * TILE[2] : (k + 1) * TILE[2]]
            if part.any():
                store.write((int(i), int(j), k), TileValues(part))
    attributes = MapAttributes(crs="EPSG:32631", site_origin=SITE, progress={"complete": True})
    store.commit(len(path), attributes)
    store.close()


def main() -> None:
    """Makes the map and reports on it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--metres", type=float, default=200.0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only-report", action="store_true", help="of a map that is there")
    arguments = parser.parse_args()
    run, path = arguments.out, path_of(arguments.metres)
    run.mkdir(parents=True, exist_ok=True)
    if not arguments.only_report:
        write_map(run, path)
        poses = np.tile(np.eye(4), (len(path), 1, 1))
        poses[:, :3, 3] = path + SITE
        write_tum(run / "poses.tum", np.arange(len(path), dtype=float), poses)
        (run / "metrics.json").write_text(json.dumps({"sequence": {"name": f"{arguments.metres:g} m"}}))
    reader = open_map(run / "map.zarr")
    print(f"{len(reader.places)} columns of tiles, {' x '.join(map(str, reader.grid.shape))} voxels")
    started_s = time.perf_counter()
    write_exports(RunFolder(run), reader, [name for name in OF_EACH_RUN if name == "png"])
    drawn_s = time.perf_counter()
    write_report(run)
    report_s = time.perf_counter() - drawn_s
    beside = sum(file.stat().st_size for file in (run / "report.parts").glob("*"))
    each_s, page_mb = 100 * report_s / len(reader.places), (run / "report.html").stat().st_size / 1e6
    print(
        f"picture {drawn_s - started_s:.1f} s, report {report_s:.1f} s ({each_s:.2f} s for a hundred columns of tiles)"
    )
    print(f"peak {peak_resident_mib():.0f} MiB, page {page_mb:.1f} MB, beside it {beside / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
