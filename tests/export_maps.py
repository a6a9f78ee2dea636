"""Small maps made by hand, to be exported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmap.export.source import Camera, KeyFrame, Source, Track
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.store import in_memory, open_map, save_map
from jaxmap.types import GridSpec, VoxelMap

UTM_SITE = np.array([588123.456789, 5790321.654321, 12.5])


def random_map(
    seed: int,
    classes: tuple[str, ...] = ROVER_CLASSES,
    shape: tuple[int, int, int] = (6, 5, 4),
    size_m: tuple[float, float, float] = (0.2, 0.3, 0.1),
) -> VoxelMap:
    rng = np.random.default_rng(seed)
    touched = rng.random(shape) < 0.4
    log_odds = rng.normal(size=(1 + len(classes), *shape)) * touched
    grid = GridSpec(jnp.array([-1.5, 2.25, -0.5], jnp.float32), jnp.array(size_m, jnp.float32), shape)
    return VoxelMap(jnp.asarray(log_odds, jnp.float32), jnp.asarray(3, jnp.int32), grid, classes)


def hill(size_m: tuple[float, float, float] = (0.2, 0.2, 0.1), classes: tuple[str, ...] = ROVER_CLASSES) -> VoxelMap:
    """A hill of one rock in sand, ten by eight columns from -1, -0.8 on, seen from above; a corner was not seen."""
    x, y, z = np.ogrid[:10, :8, :6]
    top = np.rint(4 - ((x - 4) ** 2 + (y - 3) ** 2) / 8).clip(1, 4)
    surface, rock = z == top, (x - 4) ** 2 + (y - 3) ** 2 <= 4
    log_odds = np.zeros((1 + len(classes), 10, 8, 6), np.float32)
    log_odds[0] = np.where(surface, 2.0, np.where(z > top, -1.0, 0.0))
    if classes:
        log_odds[classes.index("rock") + 1] = np.where(surface & rock, 4.0, np.where(surface, -4.0, 0.0))
        log_odds[classes.index("sand") + 1] = np.where(surface & ~rock, 4.0, np.where(surface, -4.0, 0.0))
    log_odds[:, 8:, 6:] = 0.0
    lattice_m = -np.array([1.0, 0.8, 0.2])
    grid = GridSpec(jnp.asarray(lattice_m, jnp.float32), jnp.array(size_m, jnp.float32), (10, 8, 6))
    return VoxelMap(jnp.asarray(log_odds), jnp.asarray(3, jnp.int32), grid, classes)


def empty_map(classes: tuple[str, ...] = ROVER_CLASSES) -> VoxelMap:
    grid = GridSpec(jnp.zeros(3), jnp.full(3, 0.5), (2, 2, 2))
    return VoxelMap(jnp.zeros((1 + len(classes), 2, 2, 2)), jnp.asarray(0), grid, classes)


def source_of(voxel_map: VoxelMap, *, utm: bool = False, beside: dict[str, Any] | None = None, **stored: Any) -> Source:
    """A source of a map in memory, with attributes of a stored map; in UTM on request. `beside` is of `Source`."""
    place = dict(crs="EPSG:32631", site_origin=UTM_SITE) if utm else {}
    return Source(in_memory(voxel_map, MapAttributes(**place | stored)), **beside or {})


def stored_source(voxel_map: VoxelMap, path: Path, **attributes: Any) -> Source:
    """A source of the same map on disk, read tile by tile."""
    save_map(path, voxel_map, MapAttributes(**attributes))
    return Source(open_map(path), path)


def short_track() -> Track:
    """Three poses, a second apart, that look down and go east; a key frame at the second."""
    T = np.tile(np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.5], [0, 0, 0, 1]]), (3, 1, 1))
    T[:, 0, 3] = [0.0, 0.5, 1.0]
    times_s = 1.7e9 + np.arange(3.0)
    key_frame = KeyFrame(float(times_s[1]), T[1], Camera(20.0, 20.0, 7.5, 5.5, 16, 12), png(), "png")
    return Track(times_s, T, (key_frame,))


def png() -> bytes:
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(12, 16)).save(buffer, "PNG")
    return buffer.getvalue()
