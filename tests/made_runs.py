"""Run folders that no run has made: what a page or a viewer reads, in a moment."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.store import MapAttributes, save_map
from jaxmap.report.top_down import PLACE, PLACE_KEY
from jaxmap.types import VoxelMap, make_grid, make_voxel_map

SITE = np.array([588123.4, 5790321.6, 3.25])
NASTY = '<script>alert("x")</script> & co'


def make_run(run: Path, *, classes: tuple[str, ...] = ROVER_CLASSES, name: str = "beach, part 1") -> Path:
    """A run folder with a bumpy ground, a few rocks and two key frames."""
    (run / "pictures").mkdir(parents=True)
    grid = make_grid([-4, -3, -1], [8, 5, 1.4], 0.2)
    x, y = np.meshgrid(np.arange(grid.shape[0]), np.arange(grid.shape[1]), indexing="ij")
    rock = np.hypot(x % 20 - 10, y % 15 - 7) < 3
    z = np.round(3 + 1.5 * np.sin(x / 7) + np.cos(y / 5) + 3 * rock).astype(int).clip(0, grid.shape[2] - 1)
    log_odds = np.zeros((1 + len(classes), *grid.shape), np.float32)
    log_odds[0, x, y, z] = 2.0
    for index, label in enumerate(classes):
        log_odds[1 + index, x, y, z] = np.where(rock == (label == "rock"), 1.5 if label != "background" else -2.0, -1.5)
    voxel_map = make_voxel_map(grid, classes)
    voxel_map = VoxelMap(jnp.asarray(log_odds), jnp.asarray(40), grid, tuple(classes))
    fusion = {"params": {"occupancy_threshold": 0.6, "class_prior": 0.4}, "rule": {"priority_classes": ["rock"]}}
    save_map(run / "map.zarr", voxel_map, MapAttributes(crs="EPSG:32631", site_origin=SITE, fusion=fusion))
    positions = np.stack([np.linspace(-3, 6, 20), np.linspace(0, 2, 20), np.full(20, 1.2)], axis=-1) + SITE
    lines = [f"{i} {px:.6f} {py:.6f} {pz:.6f} 0 0 0 1" for i, (px, py, pz) in enumerate(positions)]
    (run / "poses.tum").write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]))
    (run / "config.yaml").write_text(f"name: {NASTY}\n")
    for frame in ("000000", "000020"):
        for kind, colour in (("left", 120), ("disparity", 60), ("labels", 200)):
            Image.new("RGB", (800, 600), (colour, colour, 90)).save(run / "pictures" / f"{frame}_{kind}.png")
    Image.new("RGB", (300, 200), (240, 240, 240)).save(run / "bev.png")
    (run / "map.ply").write_bytes(b"ply")
    metrics = {
        "jaxmap_version": "0.1.0",
        "sequence": {
            "name": name,
            "dataset": "folder",
            "frames": 42,
            "fused": 40,
            "skipped": [{"frame": "left_7", "reason": "no pose within 0.2 s"}],
            "path_length_m": 9.2,
            "notes": ["heading from motion"],
        },
        "grid": {"shape": [60, 40, 12], "voxel_size_m": [0.2, 0.2, 0.2], "depth_range_m": [1.0, 8.5]},
        "labeller": "deeplab",
        "times": {"frames_per_s": 4.8, "stages": {"match": {"median_ms": 61.5, "p95_ms": 70.0, "total_s": 2.5}}},
        "points": {"valid_fraction": 0.812},
        "voxels": {"by_class": {"sand": 1800, "rock": 600}},
        "memory": {"peak_resident_mib": 1434.0},
        "unheard_of": {"new_number_m": 1.25},
    }
    (run / "metrics.json").write_text(json.dumps(metrics))
    return run


def add_cameras(run: Path) -> None:
    """Gives a run the cameras of its key frames, looking east, and a map that says where it lies."""
    metrics = json.loads((run / "metrics.json").read_text())
    T = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    poses = {}
    for name, x in (("000000", -3.0), ("000020", 4.0)):
        T[:3, 3] = x, 1.5, 1.2
        poses[name] = T.tolist()
    camera = dict(fx_px=800.0, fy_px=800.0, cx_px=511.5, cy_px=383.5, width_px=1024, height_px=768, key_frames=poses)
    (run / "metrics.json").write_text(json.dumps(metrics | {"camera": camera}))
    place = PngInfo()
    place.add_text(PLACE_KEY, json.dumps(dict(zip(PLACE, (60, 40, 600, 400, -4, -3, 8, 5), strict=True))))
    Image.new("RGB", (700, 500), (240, 240, 240)).save(run / "bev.png", pnginfo=place)
