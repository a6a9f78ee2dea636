"""Small maps and ground truth made by hand, on disk and in memory."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import rasterio
from rasterio import Affine

from jaxmap.evaluation.evaluate import ClassLayer
from jaxmap.mapping.store import MapAttributes, save_map
from jaxmap.types import GridSpec, VoxelMap

CLASSES = ("background", "sand", "rock")
CRS = "EPSG:32631"
SITE = np.array([595683.0, 5785776.0, 45.0])


def write_raster(
    path: Path,
    labels: np.ndarray,
    west: float,
    north: float,
    pixel_m: float,
    *,
    crs: str | None = CRS,
    transform: Affine | None = None,
    **more: object,
) -> Path:
    """Writes labels (rows from the north, or bands first) as a GeoTIFF."""
    bands = labels[None] if labels.ndim == 2 else labels
    palette = more.pop("palette", None)
    profile = dict(driver="GTiff", count=len(bands), height=bands.shape[1], width=bands.shape[2], dtype=bands.dtype)
    transform = transform or Affine(pixel_m, 0, west, 0, -pixel_m, north)
    with rasterio.open(path, "w", **profile, crs=crs, transform=transform, **more) as raster:
        raster.write(bands)
        if palette is not None:
            raster.write_colormap(1, palette)
    return path


def class_layer(rock: np.ndarray, observed: np.ndarray | None = None, *, voxel_m=0.2, origin_m=(0.0, 0.0), **more):
    """A map seen from above with these columns (x first); certain of what it says."""
    observed = np.ones_like(rock) if observed is None else observed
    grid = GridSpec(jnp.asarray([*origin_m, 0.0], jnp.float32), jnp.full(3, voxel_m, jnp.float32), (*rock.shape, 1))
    probability = np.where(rock, 0.9, 0.1).astype(np.float32)
    height_m = np.where(observed, 0.0, np.nan)
    return ClassLayer(grid, rock & observed, probability, observed, height_m, **more)


def write_map(run: Path, rock: np.ndarray, observed: np.ndarray, *, voxel_m=0.2, origin_m=(0.0, 0.0), crs=CRS) -> Path:
    """Writes a run folder that holds a map of these columns and nothing else."""
    grid = GridSpec(jnp.asarray([*origin_m, 0.0], jnp.float32), jnp.full(3, voxel_m, jnp.float32), (*rock.shape, 1))
    log_odds = np.zeros((4, *rock.shape, 1), np.float32)
    log_odds[0, ..., 0] = observed * 2.0
    log_odds[2, ..., 0] = observed * np.where(rock, -2.0, 2.0)
    log_odds[3, ..., 0] = observed * np.where(rock, 2.0, -2.0)
    run.mkdir(parents=True)
    voxel_map = VoxelMap(jnp.asarray(log_odds), jnp.asarray(1, jnp.int32), grid, CLASSES)
    site = SITE if crs else np.zeros(3)
    save_map(run / "map.zarr", voxel_map, MapAttributes(crs=crs, site_origin=site))
    return run
