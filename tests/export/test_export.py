"""Point clouds and rasters, read back and compared with the map they came from."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from export_maps import UTM_SITE, empty_map, random_map, source_of, stored_source
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.errors import JaxmapError
from jaxmap.export.geotiff import write_cog, write_geotiff
from jaxmap.export.ply import write_ply
from jaxmap.export.voxels import occupied_voxels
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.query import TopDown, class_probabilities, occupancy_probability, occupied, top_down, voxel_labels
from jaxmap.geometry.grid import voxel_centres, world_to_voxel
from jaxmap.labels import IGNORE, ROVER_CLASSES, class_colours
from jaxmap.report.overview import overview


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


@pytest.mark.slow
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
    write_ply(source_of(voxel_map, utm=georeferenced), path)
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
    write_ply(source_of(empty_map(("é\nx",))), tmp_path / "a.ply")
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
        write_geotiff(source_of(voxel_map, utm=georeferenced), path)
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


@pytest.mark.parametrize("write", [write_geotiff, write_cog])
def test_an_unknown_crs_is_an_error(tmp_path, write) -> None:
    source = source_of(random_map(0), crs="EPSG:1")
    with pytest.raises(JaxmapError, match="unknown coordinate reference system 'EPSG:1'") as caught:
        write(source, tmp_path / "bev.tif")
    assert "\n" not in str(caught.value) and list(tmp_path.iterdir()) == []


def test_a_full_disk_keeps_the_old_file(tmp_path, monkeypatch) -> None:
    def full(*_args):
        raise OSError(28, "No space left on device")

    for name in ("map.ply", "bev.tif"):
        (tmp_path / name).write_text("old")
    monkeypatch.setattr("jaxmap.host.files.sync", full)
    source = source_of(random_map(1))
    with pytest.raises(JaxmapError, match="disk full"):
        write_ply(source, tmp_path / "map.ply")
    with pytest.raises(JaxmapError, match="disk full"):
        write_geotiff(source, tmp_path / "bev.tif")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bev.tif", "map.ply"]
    assert {p.read_text() for p in tmp_path.iterdir()} == {"old"}


def test_a_disk_that_fills_up_while_a_raster_is_written_is_an_error(tmp_path) -> None:
    program = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from export_maps import random_map, source_of; from jaxmap.export.geotiff import write_geotiff\n"
        "source = source_of(random_map(0, shape=(256, 256, 1)))\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))\n"
        "write_geotiff(source, Path(sys.argv[1]))"
    )
    words = [sys.executable, "-c", program, str(tmp_path / "bev.tif")]
    ended = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert "JaxmapError: writing failed" in ended.stderr and list(tmp_path.iterdir()) == []


def test_a_cog_is_valid_and_holds_the_same(tmp_path) -> None:
    import rasterio
    from rio_cogeo.cogeo import cog_validate

    source = source_of(random_map(2, shape=(300, 290, 1)), utm=True)
    write_geotiff(source, tmp_path / "bev.tif")
    write_cog(source, tmp_path / "cog.tif")
    valid, faults, warned = cog_validate(tmp_path / "cog.tif", strict=True)
    assert valid and not faults and not warned
    with rasterio.open(tmp_path / "bev.tif") as plain, rasterio.open(tmp_path / "cog.tif") as cog:
        assert (plain.descriptions, plain.crs, plain.transform) == (cog.descriptions, cog.crs, cog.transform)
        assert np.array_equal(plain.read(), cog.read(), equal_nan=True) and plain.tags() == cog.tags()
        overview_label = cog.read(1, out_shape=(145, 150))
        assert set(np.unique(overview_label[~np.isnan(overview_label)])) <= {0.0, 1.0, 2.0}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bev.tif", "cog.tif"]


@pytest.mark.slow
@pytest.mark.parametrize("reach", [0, 1])
def test_a_map_in_tiles_is_written_as_one_in_memory(tmp_path, reach) -> None:
    """Ten of fifteen tiles are there; a kernel looks across their edges."""
    import rasterio

    whole = random_map(3, shape=(150, 130, 3))
    log_odds = np.array(whole.log_odds)
    log_odds[:, 64:128, :64] = 0
    whole = replace(whole, log_odds=jnp.asarray(log_odds))
    kernel = np.random.default_rng(0).normal(0, 0.3, (3, 3, 3)) + np.eye(3)[[1]] * np.eye(3)[1][:, None]
    fusion = {"params": {"class_kernel": kernel.tolist()}} if reach else {}
    sources = [stored_source(whole, tmp_path / "map.zarr", fusion=fusion), source_of(whole, fusion=fusion)]
    rasters, points, views = [], [], []
    for number, source in enumerate(sources):
        write_geotiff(source, tmp_path / f"{number}.tif")
        write_ply(source, tmp_path / f"{number}.ply")
        with rasterio.open(tmp_path / f"{number}.tif") as raster:
            rasters.append(raster.read())
        points.append(read_ply(tmp_path / f"{number}.ply")[1])
        views.append(overview(source, 40)[0])
    assert np.array_equal(rasters[0][:2], rasters[1][:2], equal_nan=True)
    # A kernel's sums are rounded otherwise by programs for other shapes.
    np.testing.assert_allclose(rasters[0][2:], rasters[1][2:], atol=1e-6 if reach else 0)
    for name in points[0].dtype.names or ():
        np.testing.assert_allclose(points[0][name], points[1][name], atol=1e-6 if name == "probability" else 0)
    for one, other in zip(*views, strict=True):
        assert np.array_equal(one, other, equal_nan=one.dtype == np.float32)


def test_an_overview_keeps_rocks_and_the_highest() -> None:
    source = source_of(random_map(4, shape=(12, 9, 3)))
    whole, _, same = overview(source, 12)
    coarse, _, grid = overview(source, 4)
    assert same is source.reader.grid and grid.shape == (4, 3, 3)
    assert np.allclose(grid.voxel_size_m, [0.6, 0.9, 0.1])
    for x in range(4):
        for y in range(3):
            part = tuple(slice(3 * i, 3 * i + 3) for i in (x, y))
            assert coarse.observed[x, y] == whole.observed[part].any()
            label, height_m = whole.label[part], whole.height_m[part]
            if (label == 2).any():
                assert coarse.label[x, y] == 2 and coarse.height_m[x, y] == height_m[label == 2].max()
            elif coarse.observed[x, y]:
                assert coarse.height_m[x, y] == np.nanmax(height_m)
