"""Images to train a network on: views of worlds of their own, with their masks and, as pairs, their disparity."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.datasets.stereo_images import LevelCamera, write_stereo
from jaxmap.labels import IGNORE
from jaxmap.simulation.camera_rig import loccam, undistorted_pixels
from jaxmap.simulation.develop import corner_distance, develop
from jaxmap.simulation.draw import Draw, draw_world, widen_looks
from jaxmap.simulation.drive import Drive, make_path
from jaxmap.simulation.lighting import make_lighting
from jaxmap.simulation.materials import make_textures
from jaxmap.simulation.mesh import ROCK, Mesh
from jaxmap.simulation.orthomosaic import surface_labels
from jaxmap.simulation.rays import RayImage, camera_rays
from jaxmap.simulation.recipe import SceneKind
from jaxmap.simulation.render import FirstHits, Renderer
from jaxmap.simulation.rover import rover_mesh
from jaxmap.simulation.terrain import Ground, fan
from jaxmap.simulation.traverse import sand_exposure
from jaxmap.simulation.world import WHEEL_FEEL_M, Points, bare_ground, build_world
from jaxmap.simulation.writer import claim_folder, is_whole_image, write_png, write_record, write_text
from jaxmap.stereo.match import Matcher, StereoOptions

_VALIDATION_SHARE = 0.1
_LENGTH_M = 1.0

LEAST_ROCK_PX = 10
"""Rocks of fewer pixels are no lesson: nobody would label them by hand."""


@dataclass(frozen=True)
class TrainingOptions:
    """What decides a training set.

    Attributes:
        seed: of all that is drawn; the worlds of one seed are not those of another, nor of a traverse.
        scene: few, small, medium or random.
        images: how many.
        height_px: of the images.
        width_px: of the images.
        samples: rays per pixel.
    """

    seed: int = 0
    scene: SceneKind = "random"
    images: int = 100
    height_px: int = 384
    width_px: int = 512
    samples: int = 4
    stereo: bool = False


@dataclass(frozen=True)
class View:
    """How the camera of one image looks: its height, how it is turned, its focal length and the shadow in view.

    `baseline_m` and what follows are of pairs: how far the cameras stand apart, by how much the calibration of the
    right one is off, and how the pair is matched.
    """

    height_m: float
    pitch_deg: float
    roll_deg: float
    zoom: float
    rover: bool
    baseline_m: float
    misalignment_px: tuple[float, float]
    mode: Literal["3way", "sgbm", "hh", "hh4"]
    block_size: int
    penalty: float


def draw_view(seed: int) -> View:
    """The view of a world's seed: about LocCam's, and well around it."""
    draw = Draw(seed, "view")
    return View(
        height_m=draw.ratio(0.7, 1.7),
        pitch_deg=draw.uniform(8, 32),
        roll_deg=float(draw.rng.normal(0, 2.5)),
        zoom=draw.ratio(0.85, 1.6),
        rover=draw.chance(0.5),
        baseline_m=draw.ratio(0.09, 0.3),
        misalignment_px=(float(draw.rng.normal(0, 0.25)), float(draw.rng.normal(0, 0.15))),
        mode=draw.one_of(("3way", "sgbm", "hh", "hh4"), (3, 1, 1, 1)),
        block_size=draw.one_of((3, 5, 7), (1, 3, 2)),
        penalty=draw.ratio(0.7, 4.5),
    )


def world_seed(seed: int, index: int) -> int:
    """The seed of the world of one image."""
    return int(np.random.SeedSequence([seed, index, 0x714A]).generate_state(1)[0] >> 1)


def simulate_training_set(out: Path, options: TrainingOptions, advance: Callable[[int], None]) -> float:
    """Writes `images/`, `masks/`, `train.txt` and `val.txt`; images that are there and whole are kept.

    Where the options ask for pairs, `disparity/` and `cameras/` are written, too (`datasets.stereo_images`).

    Returns:
        Seconds per image; 0 where none was left to render.

    Raises:
        JaxmapError: Mitsuba is missing, the folder holds something else, or a file cannot be written.
    """
    claim_folder(out, {"options": asdict(options)})
    names = [f"{options.seed:04d}_{index:05d}" for index in range(options.images)]
    seconds = []
    for index, name in enumerate(names):
        image, mask = out / "images" / f"{name}.png", out / "masks" / f"{name}.png"
        if not all(is_whole_image(path, options.width_px, options.height_px) for path in (image, mask)):
            started_s = time.monotonic()
            rendered = render_view(world_seed(options.seed, index), options)
            write_png(image, rendered.image)
            write_record(out / "worlds" / f"{name}.json", rendered.record)
            if rendered.stereo is not None:
                write_stereo(out, name, *rendered.stereo)
            write_png(mask, rendered.labels)
            seconds.append(time.monotonic() - started_s)
        advance(index + 1)
    order = np.random.default_rng([options.seed, 0x5917]).permutation(options.images)
    count = max(round(_VALIDATION_SHARE * options.images), min(1, options.images - 1))
    held_back = set(order[:count].tolist())
    for file, chosen in (("train.txt", False), ("val.txt", True)):
        lines = [f"{name}\n" for index, name in enumerate(names) if (index in held_back) == chosen]
        write_text(out / file, "".join(lines))
    return float(np.median(seconds)) if seconds else 0.0


class Rendered(NamedTuple):
    """One view: image (H, W, 3), labels (H, W), disparity and camera where it is a pair, and what was drawn."""

    image: np.ndarray
    labels: np.ndarray
    stereo: tuple[np.ndarray, LevelCamera] | None
    record: dict


def render_view(seed: int, options: TrainingOptions) -> Rendered:
    """Renders the view of a seed."""
    recipe, view = widen_looks(draw_world(seed, options.scene)), draw_view(seed)
    path = make_path(recipe.drive, _LENGTH_M)
    ground = Ground(recipe.relief, recipe.sand, recipe.backdrop)
    drive = Drive(recipe.drive, path, _LENGTH_M, bare_ground(ground, WHEEL_FEEL_M))
    T_world_body = drive.T_world_body(np.array([drive.duration_s]))[0]
    T_world_camera = _camera_pose(T_world_body, view)
    x, y = T_world_camera[:2, 3]
    heading = float(np.arctan2(-T_world_body[1, 0], -T_world_body[0, 0]))
    # A little over two pixels across; along the view, the ground is seen aslant.
    steps = (3.0 / options.width_px, 4.0 / options.width_px)
    points = Points(*fan((float(x), float(y)), heading, np.deg2rad(52), (0.4, 170.0), steps))
    places = _feature_places(recipe.seed, np.array([x, y]), heading)
    world = build_world(recipe, path, points, places, in_view=(np.array([x, y]), heading, np.deg2rad(60)))
    lighting = make_lighting(recipe.sky)
    textures = make_textures(recipe.sand, recipe.stone, size=512)
    renderer = Renderer(world.mesh, textures, lighting, rover_mesh())
    renderer.place_rover(T_world_body if view.rover else None)
    corner, gain = corner_distance(options.height_px, options.width_px), sand_exposure(recipe, lighting)

    def photograph(T_world_camera: np.ndarray, eye: int) -> tuple[np.ndarray, RayImage]:
        rays = camera_rays(_pixels(options, view), T_world_camera)
        noise = np.random.default_rng([seed, 0x401 + eye])
        radiance = renderer.radiance(rays, options.samples, (seed + eye,))
        return develop(radiance, recipe.exposure, gain, noise, corner), rays

    image, rays = photograph(T_world_camera, 0)
    labels = _without_specks(renderer.first_hits(rays), world.mesh)
    stereo = None
    if options.stereo:
        camera = _level_camera(options, view, T_world_camera)
        right, _ = photograph(T_world_camera @ _right_eye(camera, view), 1)
        stereo = _match(image, right, camera, view), camera
    return Rendered(image, labels, stereo, {"recipe": asdict(recipe), "view": asdict(view)})


def _right_eye(camera: LevelCamera, view: View) -> np.ndarray:
    """T_left_right, turned by what the calibration of a rover is off by."""
    T = np.eye(4)
    pitch, roll = (pixels / camera.fx_px for pixels in (view.misalignment_px[0], 2 * view.misalignment_px[1]))
    T[:3, :3] = Rotation.from_euler("xz", [pitch, roll]).as_matrix()
    T[0, 3] = camera.baseline_m
    return T


def _match(left: np.ndarray, right: np.ndarray, camera: LevelCamera, view: View) -> np.ndarray:
    """Disparity as a rover's matcher would find it, NaN where unknown."""
    area = view.block_size**2 * view.penalty
    # The ground at the lower edge is the nearest thing that matters.
    nearest_px = camera.fx_px * camera.baseline_m / max(0.55 * view.height_m, 0.4)
    options = StereoOptions(
        mode=view.mode,
        block_size=view.block_size,
        p1=round(8 * area),
        p2=round(32 * area),
        num_disparities=max(1, math.ceil(nearest_px / 16)) * 16,
        # What a matcher leaves in the sky and smears at edges is to be learnt from.
        speckle_window=100,
        edge_step_px=0.0,
    )
    return Matcher(options, left.shape[1])(left, right)


def _without_specks(hits: FirstHits, mesh: Mesh) -> np.ndarray:
    """The classes, and `IGNORE` where a rock is too far away to be distinguished from a pebble."""
    labels = surface_labels(hits, mesh)
    is_rock = labels == ROCK
    rock = mesh.part[hits.face[is_rock]]
    pixels = np.bincount(rock)
    labels[is_rock] = np.where(pixels[rock] < LEAST_ROCK_PX, IGNORE, ROCK)
    return labels


def _camera_pose(T_world_body: np.ndarray, view: View) -> np.ndarray:
    forward, right, up = -T_world_body[:3, 0], T_world_body[:3, 1], T_world_body[:3, 2]
    level = np.stack([right, -up, forward], axis=1)
    turn = Rotation.from_euler("zx", [view.roll_deg, -view.pitch_deg], degrees=True).as_matrix()
    T = np.eye(4)
    T[:3, :3] = level @ turn
    ground = T_world_body[:3, 3] - 0.543 * up
    T[:3, 3] = ground + view.height_m * up + 0.4 * forward
    return T


def _pixels(options: TrainingOptions, view: View) -> np.ndarray:
    """Where the pixels look: through LocCam's lens at another focal length; pairs are rectified, without distortion."""
    rig, K = loccam(), _matrix(options, view)
    distortion = np.zeros(4) if options.stereo else rig.distortion_left
    return undistorted_pixels(K, distortion, options.width_px, options.height_px)


def _matrix(options: TrainingOptions, view: View) -> np.ndarray:
    rig = loccam()
    focal = rig.K_left[0, 0] / rig.width_px * options.width_px * view.zoom
    return np.array([[focal, 0, (options.width_px - 1) / 2], [0, focal, (options.height_px - 1) / 2], [0, 0, 1]])


def _level_camera(options: TrainingOptions, view: View, T_world_camera: np.ndarray) -> LevelCamera:
    K, up = _matrix(options, view), T_world_camera[2, :3]
    fx, fy, cx, cy = (round(float(value), 4) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return LevelCamera(fx, fy, cx, cy, view.baseline_m, 0.0, (float(up[0]), float(up[1]), float(up[2])))


def _feature_places(seed: int, camera_m: np.ndarray, heading_rad: float) -> np.ndarray:
    rng = np.random.default_rng([seed, 0xFEA7])
    angle = heading_rad + rng.uniform(-0.5, 0.5, 8)
    distance = np.exp(rng.uniform(np.log(1.8), np.log(12.0), 8))
    return camera_m + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
