"""Point clouds and rasters, read back and compared with the map they came from."""

from __future__ import annotations

import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.errors import JaxmapError
from jaxmap.export.geotiff import write_geotiff
from jaxmap.export.ply import write_ply
from jaxmap.export.voxels import occupied_voxels
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.query import TopDown, class_probabilities, occupancy_probability, occupied, top_down, voxel_labels
from jaxmap.geometry.grid import voxel_centres, world_to_voxel
from jaxmap.labels import IGNORE, ROVER_CLASSES, class_colours
from jaxmap.types import GridSpec, VoxelMap

UTM_SITE = np.array([588123.456789, 5790321.654321, 12.5])


def random_map(seed: int, classes: tuple[str, ...] = ROVER_CLASSES) -> VoxelMap:
    rng = np.random.default_rng(seed)
    shape = (6, 5, 4)
    touched = rng.random(shape) < 0.4
    log_odds = rng.normal(size=(1 + len(classes), *shape)) * touched
    grid = GridSpec(jnp.array([-1.5, 2.25, -0.5], jnp.float32), jnp.array([0.2, 0.3, 0.1], jnp.float32), shape)
    return VoxelMap(jnp.asarray(log_odds, jnp.float32), jnp.asarray(3, jnp.int32), grid, classes)


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    content = path.read_bytes()
    header, body = content.split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    kinds = {"double": "<f8", "float": "<f4", "uchar": "u1"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    vertices = np.frombuffer(body, np.dtype(fields))
    assert f"element vertex {len(vertices)}" in lines
    return [line.removeprefix("comment ") for line in lines if line.startswith("comment")], vertices


def as_numpy(top: TopDown) -> TopDown:
    return TopDown(*(np.asarray(leaf) for leaf in top))


@settings(max_examples=8)
@given(st.integers(0, 2**31), st.sampled_from([ROVER_CLASSES, ()]))
def test_occupied_voxels_are_those_of_the_map(seed, classes) -> None:
    voxel_map, params, rule = random_map(seed, classes), make_fusion_params(classes), FusionRule()
    voxels = occupied_voxels(voxel_map, params, rule)
    solid = np.asarray(occupied(voxel_map, params))
    at = tuple(voxels.index.T)
    assert len(voxels.index) == solid.sum() and solid[at].all()
    np.testing.assert_allclose(voxels.centres_world, np.asarray(voxel_centres(voxel_map.grid))[at], rtol=1e-6)
    inside_index, inside = world_to_voxel(voxel_map.grid, jnp.asarray(voxels.centres_world))
    assert inside.all() and (np.asarray(inside_index) == voxels.index).all()
    assert (voxels.label == np.asarray(voxel_labels(voxel_map, params, rule))[at]).all()
    every = np.asarray(class_probabilities(voxel_map, params))
    something = np.asarray(occupancy_probability(voxel_map, params))
    for index, label, probability in zip(voxels.index, voxels.label, voxels.probability, strict=True):
        expected = something[tuple(index)] if label == IGNORE else every[(label, *index)]
        assert probability == pytest.approx(expected, abs=1e-6)
    dtypes = [leaf.dtype for leaf in voxels]
    assert dtypes == [np.int32, np.float32, np.uint8, np.float32, np.float32]


@settings(max_examples=6)
@given(st.integers(0, 2**31), st.booleans())
def test_ply_holds_the_voxels(tmp_path_factory, seed, georeferenced) -> None:
    path = tmp_path_factory.mktemp("ply") / "map.ply"
    voxel_map, site = random_map(seed), UTM_SITE if georeferenced else np.zeros(3)
    voxels = occupied_voxels(voxel_map, make_fusion_params(ROVER_CLASSES), FusionRule())
    write_ply(path, voxels, ROVER_CLASSES, site)
    comments, vertices = read_ply(path)
    assert vertices["x"].dtype == ("<f8" if georeferenced else "<f4")
    xyz = np.stack([vertices[axis] for axis in "xyz"], axis=-1)
    assert np.array_equal(xyz, voxels.centres_world + site)
    assert np.array_equal(vertices["label"], voxels.label)
    assert np.array_equal(vertices["probability"], voxels.probability)
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)
    assert np.array_equal(colours, class_colours(ROVER_CLASSES)[voxels.label])
    assert "voxel_size_m 0.2 0.3 0.1" in comments
    assert {"class 0 background", "class 2 rock"} <= set(comments)


def test_ply_of_nothing_and_of_odd_names(tmp_path) -> None:
    empty = VoxelMap(jnp.zeros((2, 2, 2, 2)), jnp.asarray(0), GridSpec(jnp.zeros(3), jnp.ones(3), (2, 2, 2)), ("é\nx",))
    write_ply(
        tmp_path / "a.ply", occupied_voxels(empty, make_fusion_params(("a",)), FusionRule()), empty.classes, np.zeros(3)
    )
    comments, vertices = read_ply(tmp_path / "a.ply")
    assert len(vertices) == 0 and "class 0 \\xe9 x" in comments


@settings(max_examples=8)
@given(st.integers(0, 2**31), st.sampled_from([ROVER_CLASSES, ()]), st.booleans())
def test_geotiff_holds_each_column_at_its_place(tmp_path_factory, seed, classes, georeferenced) -> None:
    import rasterio

    path = tmp_path_factory.mktemp("tif") / "bev.tif"
    voxel_map, params = random_map(seed, classes), make_fusion_params(classes)
    top = as_numpy(top_down(voxel_map, params, FusionRule()))
    site, crs = (UTM_SITE, "EPSG:32631") if georeferenced else (np.zeros(3), None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_geotiff(path, top, voxel_map.grid, classes, crs, site)
    with rasterio.open(path) as raster:
        assert (raster.crs.to_string() if raster.crs else None) == crs
        assert raster.descriptions == ("label", "height_m", *(f"probability_{name}" for name in classes))
        assert np.isnan(raster.nodata) and set(raster.dtypes) == {"float32"}
        assert raster.res == (0.2, 0.3) and raster.transform.e < 0
        bands = raster.read()
        for x in range(6):
            for y in range(5):
                world_m = np.array([-1.5 + (x + 0.5) * 0.2, 2.25 + (y + 0.5) * 0.3]) + site[:2]
                row, column = raster.index(*world_m)
                assert raster.xy(row, column) == pytest.approx(tuple(world_m), rel=0, abs=1e-6)
                label, height_m, *probabilities = bands[:, row, column]
                if not top.observed[x, y]:
                    assert np.isnan(bands[:, row, column]).all()
                    continue
                assert np.isnan(label) if top.label[x, y] == IGNORE else label == top.label[x, y]
                assert height_m == np.float32(top.height_m[x, y] + site[2])
                assert np.array_equal(probabilities, top.probability[:, x, y])


def test_an_unknown_crs_is_an_error(tmp_path) -> None:
    voxel_map = random_map(0)
    top = as_numpy(top_down(voxel_map, make_fusion_params(ROVER_CLASSES), FusionRule()))
    with pytest.raises(JaxmapError, match="unknown coordinate reference system 'EPSG:1'") as caught:
        write_geotiff(tmp_path / "bev.tif", top, voxel_map.grid, ROVER_CLASSES, "EPSG:1", np.zeros(3))
    assert "\n" not in str(caught.value) and list(tmp_path.iterdir()) == []


def test_a_full_disk_keeps_the_old_file(tmp_path, monkeypatch) -> None:
    def full(*_args):
        raise OSError(28, "No space left on device")

    voxel_map, params = random_map(1), make_fusion_params(ROVER_CLASSES)
    voxels, top = occupied_voxels(voxel_map, params, FusionRule()), as_numpy(top_down(voxel_map, params, FusionRule()))
    for name in ("map.ply", "bev.tif"):
        (tmp_path / name).write_text("old")
    monkeypatch.setattr("jaxmap.host.files.sync", full)
    with pytest.raises(JaxmapError, match="disk full"):
        write_ply(tmp_path / "map.ply", voxels, ROVER_CLASSES, np.zeros(3))
    with pytest.raises(JaxmapError, match="disk full"):
        write_geotiff(tmp_path / "bev.tif", top, voxel_map.grid, ROVER_CLASSES, None, np.zeros(3))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bev.tif", "map.ply"]
    assert {p.read_text() for p in tmp_path.iterdir()} == {"old"}
