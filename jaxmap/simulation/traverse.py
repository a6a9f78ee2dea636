"""A simulated traverse: a rover drives through a world and records it, in the layout of the Katwijk data set."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxmap.datasets.poses import write_tum
from jaxmap.simulation.camera_rig import body_from_left, left_from_right, loccam, scaled, undistorted_pixels
from jaxmap.simulation.develop import corner_distance, develop, exposure_gain
from jaxmap.simulation.draw import Draw, draw_sky, draw_world
from jaxmap.simulation.drive import Drive, make_path
from jaxmap.simulation.lighting import Lighting, make_lighting
from jaxmap.simulation.materials import make_textures
from jaxmap.simulation.orthomosaic import (
    ground_truth_labels,
    raster_around,
    raster_heights_m,
    raster_rays,
    surface_labels,
    write_raster,
)
from jaxmap.simulation.rays import camera_rays
from jaxmap.simulation.recipe import SceneKind, WorldRecipe
from jaxmap.simulation.render import Renderer
from jaxmap.simulation.rover import rover_mesh
from jaxmap.simulation.sensors import CRS, time_stamp, write_sensors
from jaxmap.simulation.terrain import Ground, graded_axis, lattice
from jaxmap.simulation.world import WHEEL_FEEL_M, Points, World, bare_ground, build_world
from jaxmap.simulation.writer import (
    claim_folder,
    is_whole_image,
    write_array,
    write_calibration,
    write_png,
    write_record,
)

_FEATURE_PLACES_M = ((2.5, 1.2), (5.0, -1.5), (4.0, 2.6), (1.0, -1.6), (7.0, 1.0), (3.0, -2.8), (6.0, 3.4), (-1.5, 1.8))
"""Where big rocks may lie, ahead and to the left of the path's end: in view from most of it."""

_FAR_M, _FINE_REACH_M, _MOST_VERTICES = 160.0, 6.0, 1_400_000


@dataclass(frozen=True)
class TraverseOptions:
    """What decides a traverse, apart from where it is written.

    Attributes:
        seed: of all that is drawn.
        scene: few, small, medium or random.
        frames: stereo pairs.
        step_m: distance between them.
        samples: rays per pixel.
        width_px: of the images; 1024 is the camera's own.
        map_cell_m: cells of the orthomosaic.
        map_reach_m: how far it goes beyond the path.
        fine_m: finest spacing of the ground's mesh.
    """

    seed: int = 0
    scene: SceneKind = "random"
    frames: int = 14
    step_m: float = 0.4
    samples: int = 8
    width_px: int = 1024
    map_cell_m: float = 0.02
    map_reach_m: float = 12.0
    fine_m: float = 0.015


class Traverse:
    """A world with a rover in it, ready to be recorded."""

    def __init__(self, options: TraverseOptions) -> None:
        self.options = options
        self.recipe = recipe = draw_world(options.seed, options.scene)
        length = options.step_m * (options.frames - 1) + 0.1
        self.path = make_path(recipe.drive, length)
        ground = Ground(recipe.relief, recipe.sand, recipe.backdrop)
        self.drive = Drive(recipe.drive, self.path, length, bare_ground(ground, WHEEL_FEEL_M))
        self.rig = scaled(loccam(), options.width_px)
        self.times_s = self.drive.times_at(options.step_m * np.arange(options.frames) + 0.05)
        self.timestamps_s = np.round(recipe.drive.start_time_s + self.times_s, 3)
        self.T_world_body = self.drive.T_world_body(self.times_s)
        self.T_world_left = self.T_world_body @ body_from_left()

    def names(self) -> list[str]:
        """Of the frames' files, without the camera's number."""
        return [f"LocCam_{time_stamp(when)}" for when in self.timestamps_s]

    def build(self) -> tuple[World, Lighting, Renderer]:
        """The world as meshes, its light, and what renders it."""
        world = build_world(self.recipe, self.path, self._ground_points(), self._feature_places())
        lighting = make_lighting(self.recipe.sky)
        textures = make_textures(self.recipe.sand, self.recipe.stone)
        return world, lighting, Renderer(world.mesh, textures, lighting, rover_mesh())

    def _ground_points(self) -> Points:
        lower = self.path.points_m.min(axis=0) - _FINE_REACH_M
        upper = self.path.points_m.max(axis=0) + _FINE_REACH_M
        fine = max(self.options.fine_m, float(np.sqrt(np.prod(upper - lower) / _MOST_VERTICES)))
        axes = [graded_axis(low, high, fine, _FAR_M) for low, high in zip(lower, upper, strict=True)]
        return Points(*lattice(*axes))

    def _feature_places(self) -> Float[np.ndarray, "Q 2"]:
        heading = self.path.heading_rad[-1]
        ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        jitter = Draw(self.options.seed, "features").rng.normal(0, 0.5, (len(_FEATURE_PLACES_M), 2))
        places = np.array(_FEATURE_PLACES_M) + jitter
        return self.path.points_m[-1] + places[:, :1] * ahead + places[:, 1:] * left


def simulate_traverse(
    out: Path, options: TraverseOptions, notify: Callable[[str], None], advance: Callable[[int], None]
) -> float:
    """Records a traverse, or finishes one that was interrupted; frames that are there and whole are kept.

    Args:
        out: folder to write: `Part1` as the data set has it, and `gt` with all that is true of it.
        options: what decides it.
        notify: takes lines for the user.
        advance: takes the number of frames done.

    Returns:
        Seconds per stereo pair; 0 where none was left to render.

    Raises:
        JaxmapError: Mitsuba is missing, the folder holds something else, or a file cannot be written.
    """
    claim_folder(out, {"options": asdict(options), "recipe": asdict(draw_world(options.seed, options.scene))})
    traverse = Traverse(options)
    world, lighting, renderer = traverse.build()
    notify(f"{len(world.rocks)} rocks, {len(world.pebbles)} pebbles, {len(world.mesh.faces):,} triangles")
    _write_sequence_files(out, traverse, world)
    recorder = _Recorder(out, traverse, world, lighting, renderer)
    seconds = []
    for index in range(options.frames):
        started_s = time.monotonic()
        if recorder.record(index):
            seconds.append(time.monotonic() - started_s)
        advance(index + 1)
    _write_map(out / "gt", traverse, world, renderer)
    return float(np.median(seconds)) if seconds else 0.0


class _Recorder:
    """Renders and writes single frames."""

    def __init__(self, out: Path, traverse: Traverse, world: World, lighting: Lighting, renderer: Renderer) -> None:
        self._out, self._traverse, self._world, self._renderer = out, traverse, world, renderer
        recipe, rig = traverse.recipe, traverse.rig
        self._size = (rig.width_px, rig.height_px)
        self._pixels = (
            undistorted_pixels(rig.K_left, rig.distortion_left, *self._size),
            undistorted_pixels(rig.K_right, rig.distortion_right, *self._size),
        )
        self._gain = sand_exposure(recipe, lighting)
        self._corner = corner_distance(rig.height_px, rig.width_px)

    def record(self, index: int) -> bool:
        """Records one frame unless it is there; whether it had to."""
        traverse, options = self._traverse, self._traverse.options
        name = traverse.names()[index]
        images = [self._out / "Part1" / "LocCam" / f"{name}_{side}.png" for side in (0, 1)]
        labels, depth = self._out / "gt" / "labels" / f"{name}_0.png", self._out / "gt" / "depth" / f"{name}_0.npy"
        if depth.is_file() and all(is_whole_image(path, *self._size) for path in (*images, labels)):
            return False
        self._renderer.place_rover(traverse.T_world_body[index])
        T_left = traverse.T_world_left[index]
        cameras = (T_left, T_left @ left_from_right(traverse.rig))
        for side, (pixels, T_world_camera) in enumerate(zip(self._pixels, cameras, strict=True)):
            seed = (options.seed, index, side)
            rays = camera_rays(pixels, T_world_camera)
            radiance = self._renderer.radiance(rays, options.samples, seed)
            noise = np.random.default_rng([*seed, 0x401])
            write_png(images[side], develop(radiance, traverse.recipe.exposure, self._gain, noise, self._corner))
            if side == 0:
                hits = self._renderer.first_hits(rays)
                label_image = surface_labels(hits, self._world.mesh)
                write_png(labels, label_image)
                write_array(depth, np.where(label_image == 0, 0, hits.depth).astype(np.float32))
        return True


def sand_exposure(recipe: WorldRecipe, lighting: Lighting) -> float:
    """The camera's gain: sand under the whole sun and sky comes out as the recipe of the exposure says."""
    sand = np.mean(lighting.level_irradiance() / np.pi * np.array(recipe.sand.colours[0]))
    return exposure_gain(recipe.exposure, float(sand))


def _write_sequence_files(out: Path, traverse: Traverse, world: World) -> None:
    site = traverse.recipe.drive.site_utm_m
    write_sensors(out / "Part1", traverse.drive, traverse.options.seed)
    write_calibration(out / "calibration.yaml", traverse.rig)
    write_tum(out / "gt" / "poses.tum", traverse.timestamps_s, traverse.T_world_left)
    absolute = traverse.T_world_left.copy()
    absolute[:, :3, 3] += site
    write_tum(out / "gt" / "poses_utm.tum", traverse.timestamps_s, absolute)
    origin = {"crs": CRS, "easting": site[0], "northing": site[1], "alt": site[2], "part": 1}
    write_record(out / "gt" / "origin.json", origin)
    write_record(out / "gt" / "rocks.json", [asdict(rock) for rock in world.rocks])


def _write_map(gt: Path, traverse: Traverse, world: World, renderer: Renderer) -> None:
    """Orthomosaic, labels and heights, without the rover and under another sun."""
    options, recipe = traverse.options, traverse.recipe
    raster = raster_around(traverse.path.points_m, options.map_reach_m, options.map_cell_m)
    rays = raster_rays(raster)
    site = recipe.drive.site_utm_m
    hits = renderer.first_hits(rays)
    heights = raster_heights_m(hits) + np.float32(site[2])
    write_raster(gt / "orthomosaic_labels.tif", ground_truth_labels(hits, world.mesh)[None], raster, site, CRS, 0)
    write_raster(gt / "dem.tif", heights[None], raster, site, CRS)
    if (gt / "orthomosaic.tif").is_file():
        return
    flight = make_lighting(draw_sky(Draw(options.seed, "flight"), recipe.sand.colours[0]))
    renderer.relight(flight)
    renderer.place_rover(None)
    radiance = renderer.radiance(rays, max(2, options.samples // 2), (options.seed, 0xF11))
    noise = np.random.default_rng([options.seed, 0xF11])
    corner = np.zeros(raster.shape)
    picture = develop(radiance, recipe.exposure, sand_exposure(recipe, flight), noise, corner)
    write_raster(gt / "orthomosaic.tif", picture.transpose(2, 0, 1), raster, site, CRS)
