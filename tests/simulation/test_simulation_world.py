"""Noise, ground and rocks: the laws of simulated worlds."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
import reference_simulation as reference
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree

from jaxmap.simulation.draw import LARGEST_PEBBLE_M, SMALLEST_ROCK_M, draw_world
from jaxmap.simulation.drive import make_path
from jaxmap.simulation.marks import make_marks
from jaxmap.simulation.mesh import ROCK, SAND, SURFACE_LABEL, Surface, icosphere, join, make_mesh, vertex_normals
from jaxmap.simulation.noise import fractal_noise, gradient_noise, seamless_noise, smoothstep
from jaxmap.simulation.recipe import RockFieldRecipe
from jaxmap.simulation.rock_shapes import stone_meshes, subdivisions_for
from jaxmap.simulation.rocks import (
    PATH_CLEARANCE_M,
    cumulative_cover,
    draw_diameters,
    draw_pebbles,
    draw_rocks,
    size_density,
)
from jaxmap.simulation.terrain import Ground, fan, graded_axis, lattice

KINDS = ("few", "small", "medium", "random")
seeds = st.integers(0, 2**31 - 1)
PATH_M = np.stack([np.linspace(-3, 3, 30), np.zeros(30)], axis=1)
NO_PLACES = np.zeros((0, 2))


def ground_of(seed: int) -> Ground:
    recipe = draw_world(seed, "random")
    return Ground(recipe.relief, recipe.sand, recipe.backdrop)


@given(seed=seeds, point=st.lists(st.floats(-500, 500), min_size=1, max_size=3))
def test_noise_equals_its_twin(seed, point):
    rounded = [float(np.float32(value)) for value in point]
    noise = gradient_noise([np.array([value], np.float32) for value in rounded], seed)[0]
    assert noise == pytest.approx(reference.gradient_noise(rounded, seed), abs=2e-4)


@given(seed=seeds)
def test_noise_is_zero_at_whole_numbers_and_differs_by_seed(seed):
    whole = np.arange(-20, 20, dtype=np.float32)
    assert np.abs(gradient_noise([whole, whole], seed)).max() < 1e-6
    between = [whole + np.float32(0.5)] * 2
    assert not np.array_equal(gradient_noise(between, seed), gradient_noise(between, seed + 1))


@pytest.mark.parametrize("ridged", [False, True])
def test_fractal_noise_is_about_normalised(ridged):
    points = list(np.random.default_rng(0).uniform(-500, 500, (2, 60000)))
    noise = fractal_noise(points, 3, wavelength=2.0, ridged=ridged)
    assert noise.std() == pytest.approx(1.0, abs=0.15)
    assert abs(noise.mean()) < 0.3


def test_seamless_noise_repeats_without_a_seam():
    field = seamless_noise((64, 64), 5, slope=1.5, finest=4)
    assert field.mean() == pytest.approx(0, abs=1e-5) and field.std() == pytest.approx(1, abs=1e-4)
    within = np.abs(np.diff(field, axis=0)).max()
    assert np.abs(field[0] - field[-1]).max() <= 1.2 * within


@given(value=st.floats(-3, 3))
def test_smoothstep_falls_where_its_bounds_do(value):
    rising, falling = (float(smoothstep(np.array(value), *bounds)) for bounds in ((-1, 1), (1, -1)))
    assert 0 <= rising <= 1 and rising + falling == pytest.approx(1)


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_draws_one_world_and_another_seed_another(kind):
    assert asdict(draw_world(7, kind)) == asdict(draw_world(7, kind))
    assert draw_world(7, kind) != draw_world(8, kind)


@given(seed=seeds)
def test_colours_are_reflectances(seed):
    recipe = draw_world(seed, "random")
    for colour in (*recipe.sand.colours, *recipe.stone.colours, *recipe.backdrop.ridge_colours):
        assert all(0 <= channel < 1 for channel in colour)


@given(seed=seeds)
def test_the_sun_stands_behind_the_rover_in_scenes_with_its_shadow(seed):
    recipe = draw_world(seed, "medium")
    towards = recipe.sky.sun_azimuth_deg - recipe.drive.heading_deg
    assert np.cos(np.deg2rad(towards)) < -0.9 and recipe.sky.sun_elevation_deg < 35


@given(seed=seeds)
def test_the_ground_is_continuous(seed):
    ground = ground_of(seed)
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-30, 30, (2, 500)).astype(np.float32)
    step = np.float32(1e-3)
    assert np.abs(ground.height_m(x + step, y) - ground.height_m(x, y)).max() < 3e-3
    # A coarser mesh of the same ground leaves out what it cannot hold, and no more.
    assert np.abs(ground.height_m(x, y, 0.3) - ground.height_m(x, y)).max() < 0.2


def test_the_ground_is_the_same_wherever_else_it_is_asked_for():
    ground = ground_of(3)
    x, y = np.random.default_rng(1).uniform(-10, 10, (2, 40000)).astype(np.float32)
    assert np.array_equal(ground.height_m(x, y)[-7:], ground.height_m(x[-7:], y[-7:]))


def test_lattices_and_fans_face_upwards_and_cover_the_ground():
    axis = graded_axis(-1, 1, 0.1, 20)
    assert (np.diff(axis) > 0).all() and axis[0] <= -21 and axis[-1] >= 21
    for x, y, spacing, faces in (
        lattice(axis, axis),
        fan((0.0, 0.0), 0.4, 0.9, (0.4, 20.0), (0.1, 0.1)),
    ):
        vertices = np.stack([x, y, np.zeros_like(x)], axis=1).astype(np.float32)
        first, second, third = (vertices[faces[:, corner]] for corner in range(3))
        area = np.cross(second - first, third - first)[:, 2] / 2
        assert area.min() > -1e-6 and (spacing > 0).all()
        box = (2 * 20.5) ** 2 if len(x) == len(axis) ** 2 else np.pi * 19**2
        assert area.sum() > box


def test_icospheres_are_closed_and_face_outwards():
    for count in range(4):
        vertices, faces = icosphere(count)
        assert len(vertices) == 10 * 4**count + 2 and len(faces) == 20 * 4**count
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        assert len({tuple(edge) for edge in edges}) == len(edges) == 30 * 4**count * 2
        assert (vertex_normals(vertices, faces) * vertices).sum(axis=1).min() > 0.99


def test_joined_meshes_keep_their_triangles():
    vertices, faces = icosphere(1)
    first = make_mesh(vertices, faces, (0.1, 0.2, 0.3), Surface.ROCK, part=4)
    second = make_mesh(vertices + 5, faces, (0.4, 0.5, 0.6), Surface.PEBBLE)
    both = join([first, second])
    assert np.array_equal(both.vertices_m[both.faces[len(faces) :]], second.vertices_m[second.faces])
    assert set(both.part[: len(faces)]) == {4} and set(both.part[len(faces) :]) == {-1}
    assert SURFACE_LABEL[both.surface[0]] == ROCK and SURFACE_LABEL[both.surface[-1]] == SAND


@given(k=st.floats(0.005, 0.2))
def test_the_size_density_is_that_of_the_cover(k):
    edges = np.linspace(0.1, 2.0, 4000)
    middle = (edges[1:] + edges[:-1]) / 2
    area = (size_density(middle, k) * np.pi / 4 * middle**2 * np.diff(edges)).sum()
    cover = cumulative_cover(edges, k)
    assert area == pytest.approx(cover[0] - cover[-1], rel=1e-3)


def test_diameters_follow_the_distribution():
    field = draw_world(0, "few").rocks
    recipe = RockFieldRecipe(**{**asdict(field), "cover": 0.05, "smallest_m": 0.1, "largest_m": 1.0})
    area = 40000.0
    diameters = draw_diameters(recipe, area, np.random.default_rng(0))
    assert (np.diff(diameters) <= 0).all() and diameters.min() >= 0.1 and diameters.max() <= 1.0
    for bound in (0.15, 0.25, 0.4):
        edges = np.geomspace(bound, 1.0, 2000)
        middle = (edges[1:] + edges[:-1]) / 2
        expected = area * (size_density(middle, 0.05) * np.diff(edges)).sum()
        assert (diameters >= bound).sum() == pytest.approx(expected, abs=4 * np.sqrt(expected) + 1)


@pytest.mark.parametrize("kind", KINDS)
def test_rocks_lie_within_bounds_apart_and_off_the_path(kind):
    recipe = draw_world(5, kind)
    places = np.array([[2.0, 2.0], [4.0, -2.0]])
    rocks = draw_rocks(recipe.rocks, recipe.stone, recipe.sand, PATH_M, 15.0, places)
    assert rocks == draw_rocks(recipe.rocks, recipe.stone, recipe.sand, PATH_M, 15.0, places)
    where = np.array([(rock.x_m, rock.y_m) for rock in rocks])
    size = np.array([rock.diameter_m for rock in rocks])
    on_path = KDTree(PATH_M).query(where)[0]
    assert on_path.max() < 15.0 and (on_path > PATH_CLEARANCE_M + 0.5 * size).all()
    assert size.min() >= SMALLEST_ROCK_M
    gaps = np.linalg.norm(where[:, None] - where[None], axis=2) + np.eye(len(where)) * 99
    assert (gaps >= 0.55 * (size[:, None] + size[None]) - 1e-9).all()


def test_pebbles_are_smaller_than_any_rock():
    recipe = draw_world(9, "small")
    pebbles = draw_pebbles(recipe.rocks, recipe.stone, recipe.sand, PATH_M, 6.0, most=500)
    assert len(pebbles) > 10
    assert max(pebble.diameter_m for pebble in pebbles) <= LARGEST_PEBBLE_M < SMALLEST_ROCK_M


def test_stones_have_their_size_and_are_sunk_as_drawn():
    recipe = draw_world(2, "random")
    rocks = draw_rocks(recipe.rocks, recipe.stone, recipe.sand, PATH_M, 8.0, np.array([[0.0, 4.0]]))[:40]
    flat = [type(rock)(**{**asdict(rock), "tilt_rad": 0.0, "heading_rad": 0.0}) for rock in rocks]
    mesh = stone_meshes(flat, [2] * len(flat), lambda x, y: np.full(np.shape(x), 3.0), (0.4, 0.3, 0.2), Surface.ROCK)
    for index, rock in enumerate(flat):
        own = mesh.vertices_m[mesh.faces[mesh.part == index].ravel()]
        span = np.ptp(own, axis=0)
        assert span[0] * span[1] == pytest.approx(rock.diameter_m**2, rel=1e-3)
        assert span[2] == pytest.approx(rock.height_m, rel=1e-3)
        assert 3.0 - own[:, 2].min() == pytest.approx(rock.burial * rock.height_m, abs=1e-4)
        assert np.abs((own.min(axis=0) + own.max(axis=0))[:2] / 2 - (rock.x_m, rock.y_m)).max() < 1e-3
    assert np.isfinite(mesh.vertices_m).all() and 0 < mesh.colours.min() <= mesh.colours.max() < 1


def test_nearer_and_bigger_stones_are_finer():
    assert subdivisions_for(0.05, 9.0) <= subdivisions_for(0.5, 9.0) <= subdivisions_for(0.5, 2.0) <= 6


def test_marks_press_in_and_end_at_their_raster():
    relief = type(draw_world(0, "random").relief)(
        **{**asdict(draw_world(0, "random").relief), "walks": 2, "tracks": 1, "drift": 0.0}
    )
    lower, upper = np.array([-4.0, -4.0]), np.array([4.0, 4.0])
    marks = make_marks(relief, [], lower, upper)
    assert -0.05 < marks.height_m.min() < -0.004 and 0 < marks.height_m.max() < 0.03
    assert 0.5 < marks.disturbed.max() <= 1.001
    height, disturbed = marks.at(np.array([50.0, -50.0]), np.array([0.0, 0.0]))
    assert not height.any() and not disturbed.any()
    row, column = np.unravel_index(np.argmin(marks.height_m), marks.height_m.shape)
    x, y = lower[0] + (column + 0.5) * 0.01, lower[1] + (row + 0.5) * 0.01
    assert marks.at(np.array([x]), np.array([y]))[0][0] == pytest.approx(marks.height_m.min(), abs=1e-6)


def test_sand_drifts_against_rocks_only():
    recipe = draw_world(4, "medium")
    relief = type(recipe.relief)(**{**asdict(recipe.relief), "walks": 0, "tracks": 0, "drift": 0.2})
    rocks = draw_rocks(recipe.rocks, recipe.stone, recipe.sand, PATH_M, 5.0, NO_PLACES)[:5]
    marks = make_marks(relief, rocks, np.array([-9.0, -9.0]), np.array([9.0, 9.0]))
    at_rocks = marks.at(*np.array([(rock.x_m, rock.y_m) for rock in rocks]).T)[0]
    assert (at_rocks > 0).all() and marks.height_m.min() == 0


@given(seed=seeds)
def test_paths_pass_the_origin_and_keep_their_step(seed):
    path = make_path(draw_world(seed, "random").drive, 6.0)
    steps = np.linalg.norm(np.diff(path.points_m, axis=0), axis=1)
    assert np.allclose(steps, np.diff(path.arc_m)) and path.arc_m[-1] >= 6.0
    assert np.linalg.norm(path.points_m, axis=1).min() < 1e-9
