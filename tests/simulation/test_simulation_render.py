"""Rendering with Mitsuba: light against closed forms, labels against geometry, and whole small data sets."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from fixtures import Run, cli  # noqa: F401
from scipy.spatial.transform import Rotation

from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.poses import read_poses
from jaxmap.datasets.stereo_images import read_stereo
from jaxmap.errors import JaxmapError
from jaxmap.labels import ROVER_CLASSES
from jaxmap.simulation.camera_rig import loccam, scaled, undistorted_pixels
from jaxmap.simulation.lighting import Lighting, sky_irradiance
from jaxmap.simulation.llvm import working_llvm
from jaxmap.simulation.materials import Textures
from jaxmap.simulation.mesh import Mesh, Surface, join, make_mesh
from jaxmap.simulation.orthomosaic import Raster, ground_truth_labels, raster_heights_m, raster_rays, surface_labels
from jaxmap.simulation.render import Renderer

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install 'jaxmap[sim]'")
try:
    working_llvm()
except JaxmapError as error:
    pytest.skip(str(error), allow_module_level=True)

PLAIN = Textures(np.zeros((4, 4, 5), np.float32), np.zeros((4, 4, 3), np.float32), np.zeros((4, 4, 4, 4), np.float32))
RASTER = Raster(-2.0, 2.0, 0.1, (40, 40))


def lighting(sun_elevation_deg: float = 90.0, sun: float = 2.0, sky: float = 1.0) -> Lighting:
    radiance = np.full((48, 192, 3), sky, np.float32)
    angle = np.deg2rad(sun_elevation_deg)
    direction = np.array([np.cos(angle), 0, np.sin(angle)])
    return Lighting(direction, np.full(3, sun), 1e-4, radiance, sky_irradiance(radiance), 1e9, np.ones(3))


def quad(size_m: float, height_m: float, surface: Surface, colour: float = 0.5, at: float = 0.0) -> Mesh:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size_m / 2 + (at, 0, height_m)
    return make_mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), (colour,) * 3, surface)


def test_open_ground_reflects_sun_and_sky_without_noise():
    renderer = Renderer(quad(50, 0, Surface.SAND), PLAIN, lighting(sun_elevation_deg=30, sun=2.0, sky=0.7))
    radiance = renderer.radiance(raster_rays(RASTER), 2, (0,))
    expected = 0.5 / np.pi * (2.0 * 0.5 + 0.7 * np.pi)
    assert radiance == pytest.approx(expected, rel=0.02) and radiance.std() < 1e-3


def test_what_stands_above_casts_its_shadow_away_from_the_sun():
    world = join([quad(50, 0, Surface.SAND), quad(1.0, 1.0, Surface.ROCK, at=-0.2)])
    renderer = Renderer(world, PLAIN, lighting(sun_elevation_deg=45, sky=0.0))
    radiance = renderer.radiance(raster_rays(RASTER), 1, (0,))[..., 0]
    hits = renderer.first_hits(raster_rays(RASTER))
    sand = surface_labels(hits, world) == ROVER_CLASSES.index("sand")
    dark = (radiance < 0.02) & sand
    columns = np.nonzero(dark[20])[0]
    # The sun is in the east at 45 degrees: a sheet at height 1 is shifted west by 1, over x -1.7 to -0.7.
    assert RASTER.west_m + 0.1 * columns.min() == pytest.approx(-1.7, abs=0.15)
    assert RASTER.west_m + 0.1 * (columns.max() + 1) == pytest.approx(-0.7, abs=0.15)


def test_the_rover_is_not_seen_but_its_shadow_is():
    sheet = quad(1.0, 1.0, Surface.SCENERY)
    renderer = Renderer(quad(50, 0, Surface.SAND), PLAIN, lighting(sky=0.0), rover=sheet)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    T[0, 3] = 0.8
    for pose, shadow in ((None, False), (T, True)):
        renderer.place_rover(pose)
        radiance = renderer.radiance(raster_rays(RASTER), 1, (0,))[..., 0]
        assert (renderer.first_hits(raster_rays(RASTER)).face < 2).all()
        assert (radiance.min() < 0.01) == shadow
        if shadow:
            row, column = np.nonzero(radiance < 0.01)
            assert (RASTER.west_m + 0.1 * (column + 0.5)).mean() == pytest.approx(0.8, abs=0.05)
            assert len(row) == pytest.approx(100, abs=8)


def test_labels_and_heights_are_those_of_the_topmost_surface():
    world = join(
        [quad(3.0, 0.25, Surface.SAND), quad(1.0, 0.75, Surface.ROCK), quad(0.5, 1.0, Surface.PEBBLE, at=-1.0)]
    )
    hits = Renderer(world, PLAIN, lighting()).first_hits(raster_rays(RASTER))
    coded, heights = ground_truth_labels(hits, world), raster_heights_m(hits)
    assert (coded == 2).sum() == 100 and (coded == 1).sum() == 800 and (coded == 0).sum() == 700
    assert heights[20, 20] == pytest.approx(0.75, abs=1e-4) and heights[20, 10] == pytest.approx(1.0, abs=1e-4)


def test_depth_of_a_camera_is_along_its_axis():
    rig = scaled(loccam(), 64)
    pixels = undistorted_pixels(rig.K_left, rig.distortion_left, rig.width_px, rig.height_px)
    from jaxmap.simulation.rays import camera_rays

    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[2, 3] = 2.0
    hits = Renderer(quad(50, 0, Surface.SAND), PLAIN, lighting()).first_hits(camera_rays(pixels, T))
    assert hits.depth == pytest.approx(2.0, abs=1e-4)


@pytest.fixture(scope="module")
def traverse(tmp_path_factory) -> Path:
    from jaxmap.simulation.traverse import TraverseOptions, simulate_traverse

    out = tmp_path_factory.mktemp("traverse") / "out"
    simulate_traverse(out, tiny(TraverseOptions), lambda line: None, lambda done: None)
    return out


def tiny(kind):
    return kind(
        seed=4, scene="few", frames=2, step_m=0.5, samples=2, width_px=64, map_cell_m=0.1, map_reach_m=4.0, fine_m=0.1
    )


def by_time(path: Path) -> list[int]:
    """The milliseconds are not padded, so names do not sort by time."""
    return [int(word) for word in path.stem.split("_")[1:]]


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_traverse_has_the_layout_of_the_data_set(traverse):
    images = sorted(path.name for path in (traverse / "Part1" / "LocCam").iterdir())
    assert len(images) == 4 and all(name.startswith("LocCam_2015_11_") for name in images)
    stems = {name.rsplit("_", 1)[0] for name in images}
    assert {f"{stem}_{side}.png" for stem in stems for side in (0, 1)} == set(images)
    assert {path.stem for path in (traverse / "gt" / "labels").iterdir()} == {f"{stem}_0" for stem in stems}
    named = {path.name for path in (traverse / "gt").iterdir() if path.is_file()}
    assert named == {
        *("poses.tum", "poses_utm.tum", "origin.json", "rocks.json"),
        *("orthomosaic.tif", "orthomosaic_labels.tif", "dem.tif"),
    }
    image = cv2.imread(str(traverse / "Part1" / "LocCam" / images[0]), cv2.IMREAD_UNCHANGED)
    assert image.shape == (48, 64, 3) and 20 < image.mean() < 235 and image.std() > 3
    rig = read_camera_yaml(traverse / "calibration.yaml")
    assert np.allclose(rig.K_left, scaled(loccam(), 64).K_left)


def test_depth_poses_labels_and_orthomosaic_agree(traverse):
    import rasterio

    track = read_poses(traverse / "gt" / "poses_utm.tum")
    rig = scaled(loccam(), 64)
    x, y = undistorted_pixels(rig.K_left, rig.distortion_left, 64, 48)
    with (
        rasterio.open(traverse / "gt" / "dem.tif") as file,
        rasterio.open(traverse / "gt" / "orthomosaic_labels.tif") as coded,
    ):
        assert file.crs.to_epsg() == coded.crs.to_epsg() == 32631 and file.bounds == coded.bounds
        for path, T in zip(sorted((traverse / "gt" / "depth").iterdir(), key=by_time), track.T, strict=True):
            z = np.load(path)
            labels = cv2.imread(str(traverse / "gt" / "labels" / f"{path.stem}.png"), cv2.IMREAD_UNCHANGED)
            assert set(np.unique(labels)) <= {0, 1, 2} and ((z == 0) == (labels == 0)).all()
            near = (z > 0) & (z < 5) & (labels == 1)
            assert near.sum() > 300
            points = np.stack([x * z, y * z, z], axis=-1)[near] @ T[:3, :3].T + T[:3, 3]
            heights = np.array([value[0] for value in file.sample(points[:, :2])])
            below = np.array([value[0] for value in coded.sample(points[:, :2])])
            assert np.median(np.abs(points[:, 2] - heights)) < 0.01
            # Sand within half a cell of a rock may lie in a cell whose middle is rock; cells are 0.1 m here.
            assert (below == 1).mean() > 0.9


@pytest.mark.slow
def test_the_same_seed_writes_the_same_files(traverse, tmp_path):
    from jaxmap.simulation.traverse import TraverseOptions, simulate_traverse

    simulate_traverse(tmp_path / "again", tiny(TraverseOptions), lambda line: None, lambda done: None)
    first, second = files_of(traverse), files_of(tmp_path / "again")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


@pytest.mark.slow
def test_an_interrupted_traverse_is_finished(traverse, tmp_path):
    import shutil

    from jaxmap.simulation.traverse import TraverseOptions, simulate_traverse

    out = tmp_path / "cut"
    shutil.copytree(traverse, out)
    images = sorted((out / "Part1" / "LocCam").iterdir())
    images[0].write_bytes(images[0].read_bytes()[:200])
    images[3].unlink()
    done = []
    simulate_traverse(out, tiny(TraverseOptions), lambda line: None, done.append)
    assert done == [1, 2] and files_of(out) == files_of(traverse)
    written = [path.stat().st_mtime_ns for path in images]
    assert simulate_traverse(out, tiny(TraverseOptions), lambda line: None, done.append) == 0.0
    assert [path.stat().st_mtime_ns for path in images] == written


def test_another_data_set_is_not_overwritten(traverse, cli):
    outcome = cli("simulate", "--out", traverse, "--preview", "--frames", 1, "--seed", 99)
    assert outcome.status == 1 and "other settings" in outcome.error


def test_a_folder_of_something_else_is_refused(tmp_path, cli):
    (tmp_path / "thesis.txt").write_text("mine")
    outcome = cli("simulate", "--out", tmp_path, "--training", 1)
    assert outcome.status == 1 and "something else" in outcome.error


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (("--frames", 0), "--frames"),
        (("--samples", 0), "--samples"),
        (("--size", 4, 99999), "--size"),
        (("--seed", -1), "--seed"),
    ],
)
def test_numbers_out_of_range_are_named(cli, tmp_path, words, where):
    outcome = cli("simulate", "--out", tmp_path / "out", *words)
    assert outcome.status == 2 and where in outcome.error and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_training_images_come_with_masks_and_lists(tmp_path, cli):
    words = ("simulate", "--training", 3, "--size", 48, 64, "--seed", 2, "--samples", 1)
    for folder in ("a", "b"):
        outcome = cli(*words, "--out", tmp_path / folder)
        assert outcome.status == 0 and "s per image" in outcome.err, outcome
    names = sorted((tmp_path / "a" / "images").iterdir())
    lists = [(tmp_path / "a" / name).read_text().split() for name in ("train.txt", "val.txt")]
    assert sorted(lists[0] + lists[1]) == [path.stem for path in names] and [len(names) for names in lists] == [2, 1]
    pictures = [cv2.imread(str(path)) for path in names]
    assert all(picture.shape == (48, 64, 3) for picture in pictures)
    assert np.abs(pictures[0].astype(float) - pictures[1]).mean() > 3
    for path in names:
        mask = cv2.imread(str(tmp_path / "a" / "masks" / path.name), cv2.IMREAD_UNCHANGED)
        assert mask.shape == (48, 64) and set(np.unique(mask)) <= {0, 1, 2, 255}
        assert "recipe" in json.loads((tmp_path / "a" / "worlds" / f"{path.stem}.json").read_text())
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


@pytest.mark.slow
def test_training_pairs_come_with_the_disparity_of_their_ground(tmp_path, cli):
    words = ("simulate", "--training", 1, "--stereo", "--size", 192, 256, "--seed", 2, "--samples", 2)
    assert cli(*words, "--out", tmp_path).status == 0
    (name,) = [path.stem for path in (tmp_path / "images").iterdir()]
    stereo = read_stereo(tmp_path, name)
    assert stereo is not None
    disparity_px, camera = stereo
    known = np.isfinite(disparity_px)
    assert disparity_px.shape == (192, 256) and known.mean() > 0.3
    assert np.linalg.norm(camera.up_camera) == pytest.approx(1, abs=1e-4)
    # The ground is nearer in the lower part of the image, and lies below the camera.
    upper, lower = (np.nanmedian(part) for part in (disparity_px[64:128], disparity_px[128:]))
    assert lower > upper
    depth_m = camera.fx_px * camera.baseline_m / lower
    ray = np.array([0.0, (160 - camera.cy_px) / camera.fy_px, 1.0])
    assert -2.5 < depth_m * ray @ np.array(camera.up_camera) < -0.3
