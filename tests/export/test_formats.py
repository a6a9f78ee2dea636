"""Forms for other programs, each opened by a reader that is not ours."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from export_maps import UTM_SITE, empty_map, hill, random_map, short_track, source_of, stored_source

from jaxmap.errors import JaxmapError
from jaxmap.export.formats import FORMATS, OF_EACH_RUN
from jaxmap.export.las import FIRST_CLASS, UNCLASSIFIED, write_las
from jaxmap.export.lunar_challenge import write_lunar_challenge
from jaxmap.export.mesh_files import write_gltf, write_mesh_ply
from jaxmap.export.nav2 import write_nav2
from jaxmap.export.octomap_trees import write_octomap
from jaxmap.export.source import Source
from jaxmap.export.surface import patches
from jaxmap.fusion.query import TopDown, occupied, top_down
from jaxmap.labels import ROVER_CLASSES, class_colours

ROCK = ROVER_CLASSES.index("rock")


def top_of(source: Source) -> TopDown:
    (block,) = source.reader.blocks()
    return jax.tree.map(np.asarray, top_down(block.voxel_map, *source.fusion))


def write(name: str, source: Source, folder: Path) -> list[Path]:
    module, _, function = FORMATS[name].writer.partition(":")
    paths = [folder / file for file in FORMATS[name].files]
    return list(getattr(import_module(module), function)(source, *paths) or paths)


def test_every_form_is_there_and_files_have_one_owner() -> None:
    files = [file for form in FORMATS.values() for file in form.files]
    assert len(set(files)) == len(files) and set(OF_EACH_RUN) <= set(FORMATS)
    for form in FORMATS.values():
        module, _, function = form.writer.partition(":")
        assert callable(getattr(import_module(module), function))


OF_MAPS = [name for name in FORMATS if name != "colmap"]
"""The forms that take no more than a map."""


@pytest.mark.parametrize("name", OF_MAPS)
def test_an_empty_map_is_written_or_refused_whole(name, tmp_path) -> None:
    try:
        written = write(name, source_of(empty_map()), tmp_path)
    except JaxmapError as error:
        assert "nothing was observed" in str(error) and list(tmp_path.iterdir()) == []
    else:
        assert {path.name for path in tmp_path.iterdir()} == {path.name for path in written}


@pytest.mark.parametrize("name", OF_MAPS)
def test_a_map_without_classes_or_crs_is_written_or_refused_whole(name, tmp_path) -> None:
    try:
        written = write(name, source_of(hill(classes=())), tmp_path)
    except JaxmapError as error:
        assert "its classes are none" in str(error) and list(tmp_path.iterdir()) == []
    else:
        assert {path.name for path in tmp_path.iterdir()} == {path.name for path in written}


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("las", "laspy"),
        ("laz", "lazrs"),
        ("octomap", "octomap"),
        ("grid-map", "mcap"),
        ("mcap", "mcap_protobuf"),
        ("mcap", "foxglove_schemas_protobuf"),
    ],
)
def test_a_missing_library_is_named_with_its_command(name, module, tmp_path, monkeypatch) -> None:
    # What is imported for the first time meanwhile would never find it again.
    for loaded in ("laspy", "lazrs", "mcap_protobuf.writer"):
        import_module(loaded)
    for loaded in (module, f"{module}.writer"):
        monkeypatch.setitem(__import__("sys").modules, loaded, None)
    with pytest.raises(JaxmapError, match=r"is not installed.*pip install 'jaxmap\[formats\]'"):
        write(name, source_of(hill()), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size_m", [(0.2, 0.2, 0.2), (0.1, 0.1, 0.2)])
def test_octomap_reads_the_trees(tmp_path, size_m) -> None:
    import octomap

    source = source_of(hill(size_m))
    write_octomap(source, tmp_path / "map.ot", tmp_path / "map.bt")
    colour, binary = octomap.ColorOcTree.read(str(tmp_path / "map.ot").encode()), octomap.OcTree(0.1)
    assert binary.readBinary(str(tmp_path / "map.bt").encode())
    edge_m = min(size_m)
    assert colour.getResolution() == pytest.approx(edge_m) and binary.getResolution() == pytest.approx(edge_m)
    (block,) = source.reader.blocks()
    log_odds, solid = np.asarray(block.voxel_map.log_odds), np.asarray(occupied(block.voxel_map, source.fusion[0]))
    # The lattice lies at multiples of the edge: nothing is shifted.
    assert np.allclose(np.rint(source.corner_m / edge_m) * edge_m, source.corner_m)
    for index in np.ndindex(*solid.shape):
        centre = source.corner_m + (np.array(index) + 0.5) * source.size_m
        for dz in (np.arange(round(size_m[2] / edge_m)) + 0.5) * edge_m - size_m[2] / 2:
            at = centre + np.array([0, 0, dz])
            node = colour.search(at)
            if not log_odds[:, *index].any():
                with pytest.raises(octomap.NullPointerException):
                    node.getLogOdds()
                continue
            assert node.getLogOdds() == pytest.approx(log_odds[0, *index], abs=1e-5)
            assert binary.isNodeOccupied(binary.search(at)) == solid[index]
            if solid[index]:
                label = ROCK if log_odds[1 + ROCK, *index] > 0 else ROVER_CLASSES.index("sand")
                assert node.getColor()[:3] == tuple(class_colours(ROVER_CLASSES)[label])


def test_octomap_tells_how_far_its_lattice_is_off(tmp_path) -> None:
    import octomap

    lines: list[str] = []
    shifted = hill((0.2, 0.2, 0.2))
    grid = replace(shifted.grid, lattice_m=shifted.grid.lattice_m + jnp.array([0.05, 0.0, 0.0]))
    source = source_of(replace(shifted, grid=grid), beside=dict(notify=lines.append))
    write_octomap(source, tmp_path / "map.ot", tmp_path / "map.bt")
    assert lines == ["note: trees lie on multiples of 0.2 m: add (0.05, 0, 0) m to their coordinates"]
    tree = octomap.OcTree(0.2)
    assert tree.readBinary(str(tmp_path / "map.bt").encode())
    (voxels,) = source.voxels()
    for centre in voxels.centres_world:
        assert tree.isNodeOccupied(tree.search(centre - [0.05, 0.0, 0.0]))


def test_octomap_refuses_voxels_that_divide_into_no_cubes(tmp_path) -> None:
    with pytest.raises(JaxmapError, match=r"0\.05 x 0\.05 x 0\.12 m .*--grid\.voxel-size-m 0\.05 0\.05 0\.1"):
        write_octomap(source_of(hill((0.05, 0.05, 0.12))), tmp_path / "map.ot", tmp_path / "map.bt")
    far = hill((0.2, 0.2, 0.2))
    far = replace(far, grid=replace(far.grid, first=jnp.array([40_000, 0, 0])))
    with pytest.raises(JaxmapError, match="6553.6 m from the origin"):
        write_octomap(source_of(far), tmp_path / "map.ot", tmp_path / "map.bt")


def read_nav2(settings: Path) -> tuple[dict, np.ndarray]:
    """Reads a map as nav2's map server does; cells x first, -1 unknown."""
    import yaml
    from PIL import Image

    known = yaml.safe_load(settings.read_text())
    pixels = np.asarray(Image.open(settings.parent / known["image"])).astype(float)
    opaque = np.ones(pixels.shape[:2], bool)
    if pixels.ndim == 3:
        pixels, opaque = pixels[..., 0], pixels[..., -1] == 255
    occupancy = (pixels if known["negate"] else 255 - pixels) / 255
    low, high = known["free_thresh"], known["occupied_thresh"]
    between = -1.0 if known["mode"] == "trinary" else np.rint((occupancy - low) / (high - low) * 98 + 1)
    cells = np.where(occupancy > high, 100, np.where(occupancy < low, 0, between))
    if known["mode"] == "scale":
        cells = np.where(opaque, cells, -1)
    return known, cells[::-1].T.astype(int)


def test_nav2_reads_obstacles_and_costs(tmp_path) -> None:
    cost = np.full((10, 8), np.nan, np.float32)
    cost[:5] = np.linspace(1, 20, 8)
    for layers in ({}, {"cost": cost}):
        source = source_of(hill(), layers=layers)
        top = top_of(source)
        write("nav2", source, tmp_path)
        known, cells = read_nav2(tmp_path / "map.yaml")
        assert known["resolution"] == 0.2 and known["origin"] == pytest.approx([-1.0, -0.8, 0.0])
        assert (tmp_path / known["image"]).read_bytes().startswith(b"P5")
        expected = np.where(top.observed, np.where(top.label == ROCK, 100, 0), -1)
        assert np.array_equal(cells, expected) and set(np.unique(cells)) == {-1, 0, 100}
        known, costs = read_nav2(tmp_path / "costs.yaml")
        truth = 1 - 1 / cost if layers else np.where(top.observed, top.probability[ROCK], np.nan)
        truth = np.where(top.observed, truth, np.nan)
        assert known["mode"] == "scale" and ((costs == -1) == np.isnan(truth)).all()
        np.testing.assert_allclose(costs[costs >= 0], 100 * truth[~np.isnan(truth)], atol=1.5)


def test_nav2_refuses_columns_that_are_no_squares(tmp_path) -> None:
    paths = [tmp_path / file for file in FORMATS["nav2"].files]
    with pytest.raises(JaxmapError, match=r"square cells.*0\.2 x 0\.3 m.*--grid\.voxel-size-m 0\.2 0\.2 0\.1"):
        write_nav2(source_of(random_map(0)), *paths)


def rectangles(source: Source) -> np.ndarray:
    return np.concatenate([patch.points_world[patch.triangles].reshape(-1, 9) for patch in patches(source)])


def test_the_surface_looks_up_and_stays_within_its_voxels() -> None:
    source = source_of(hill())
    top = top_of(source)
    (patch,) = patches(source)
    a, b, c = patch.points_world[patch.triangles].transpose(1, 0, 2)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    # All quads that are whole, and half of the one at the corner that was not seen.
    assert len(patch.triangles) == 2 * (9 * 7 - 4) + 1
    x, y = np.floor((patch.points_world[:, :2] - source.corner_m[:2]) / 0.2 + 1e-9).astype(int).T
    assert top.observed[x, y].all()
    assert np.abs(patch.points_world[:, 2] - top.height_m[x, y]).max() <= 0.05 + 1e-6


@pytest.mark.slow
def test_the_surface_of_tiles_has_no_seams(tmp_path) -> None:
    whole = random_map(5, shape=(150, 130, 3))
    in_tiles, at_once = (rectangles(s) for s in (stored_source(whole, tmp_path / "m.zarr"), source_of(whole)))
    for triangles in (in_tiles, at_once):
        triangles[:] = triangles.round(6) + 0.0
    assert np.array_equal(np.unique(in_tiles, axis=0), np.unique(at_once, axis=0)) and len(in_tiles) == len(at_once)


def test_gltf_and_ply_are_the_surface(tmp_path) -> None:
    import trimesh

    source = source_of(hill(), utm=True)
    write_gltf(source, tmp_path / "surface.glb")
    write_mesh_ply(source, tmp_path / "surface.ply")
    (patch,) = patches(source)
    loaded = trimesh.load(tmp_path / "surface.glb", process=False)
    (mesh,) = loaded.geometry.values()
    east, up, south = mesh.vertices.T
    np.testing.assert_allclose(np.stack([east, -south, up], axis=-1), patch.points_world, atol=1e-6)
    assert np.array_equal(mesh.faces, patch.triangles) and (mesh.face_normals[:, 1] > 0).all()
    content = (tmp_path / "surface.glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    asset = json.loads(content[20 : 20 + length])["asset"]
    assert asset["extras"]["site_origin"] == UTM_SITE.tolist() and asset["extras"]["crs"] == "EPSG:32631"
    linear = np.asarray(mesh.visual.vertex_attributes["color"])[:, :3] / 65535
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) * 255
    np.testing.assert_allclose(srgb, patch.colours, atol=0.02)
    ply = trimesh.load(tmp_path / "surface.ply", process=False)
    np.testing.assert_allclose(ply.vertices, patch.points_world + UTM_SITE, atol=1e-9)
    assert np.array_equal(ply.faces, patch.triangles)
    assert np.array_equal(ply.visual.vertex_colors[:, :3], patch.colours)


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_laspy_reads_the_points(tmp_path, ending) -> None:
    import laspy

    source, path = source_of(hill(), utm=True), tmp_path / f"map.{ending}"
    write_las(source, path)
    las = laspy.read(path)
    (voxels,) = source.voxels()
    np.testing.assert_allclose(las.xyz, voxels.centres_world + UTM_SITE, atol=6e-5)
    assert np.array_equal(las.classification, voxels.label + FIRST_CLASS)
    assert np.array_equal(
        np.stack([las.red, las.green, las.blue], -1) // 257, class_colours(ROVER_CLASSES)[voxels.label]
    )
    np.testing.assert_allclose(las["probability"], voxels.probability)
    assert las.header.parse_crs().to_epsg() == 32631 and las.header.version == "1.4"
    (lookup,) = las.header.vlrs.get("ClassificationLookupVlr")
    assert lookup[FIRST_CLASS + ROCK] == "rock"
    with pytest.raises(JaxmapError, match="unknown coordinate reference system 'EPSG:1'"):
        write_las(source_of(hill(), crs="EPSG:1"), path)


def test_las_without_a_crs_or_labels(tmp_path) -> None:
    import laspy

    write_las(source_of(hill(classes=())), tmp_path / "map.las")
    las = laspy.read(tmp_path / "map.las")
    assert len(las.points) and las.header.parse_crs() is None and set(las.classification) == {UNCLASSIFIED}


def test_the_array_of_the_lunar_autonomy_challenge(tmp_path) -> None:
    source = source_of(hill((0.05, 0.05, 0.1)))
    write_lunar_challenge(source, tmp_path / "lac.npy")
    table = np.load(tmp_path / "lac.npy", allow_pickle=False)
    assert table.shape == (180, 180, 4) and table.dtype == np.float64
    centres = -13.5 + 0.15 * (np.arange(180) + 0.5)
    np.testing.assert_allclose(table[..., 0], np.broadcast_to(centres[:, None], (180, 180)), atol=1e-9)
    np.testing.assert_allclose(table[..., 1], np.broadcast_to(centres[None], (180, 180)), atol=1e-9)
    top, seen = top_of(source), 0
    for x, y in np.argwhere(np.isfinite(table[..., 2])):
        # Sixteen points, each in a column.
        offsets = (np.arange(4) - 1.5) * 0.0375
        at = [
            np.floor((centre + offsets - corner) / 0.05 + 1e-9).astype(int)
            for centre, corner in ((centres[x], -1.0), (centres[y], -0.8))
        ]
        points = [(i, j) for i in at[0] for j in at[1] if 0 <= i < 10 and 0 <= j < 8 and top.observed[i, j]]
        assert table[x, y, 2] == pytest.approx(np.mean([top.height_m[point] for point in points]), abs=1e-6)
        assert table[x, y, 3] == any(top.label[point] == ROCK for point in points)
        seen += 1
    assert 9 <= seen <= 20 and (np.isneginf(table[..., 2]) == np.isneginf(table[..., 3])).all()


def test_the_challenge_needs_the_middle_of_the_area(tmp_path) -> None:
    lines: list[str] = []
    far = hill()
    for east_m, error in ((100.0, "within the 27 m x 27 m about the origin"), (12.5, None)):
        grid = replace(far.grid, lattice_m=jnp.array([east_m, 0.0, 0.0]))
        source = source_of(replace(far, grid=grid), beside=dict(notify=lines.append))
        if error:
            with pytest.raises(JaxmapError, match=error):
                write_lunar_challenge(source, tmp_path / "lac.npy")
        else:
            write_lunar_challenge(source, tmp_path / "lac.npy")
    assert len(lines) == 1 and "of the map" in lines[0]


def test_rosbags_reads_grid_map(tmp_path) -> None:
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    track = short_track()
    source = source_of(hill(), beside=dict(track=track))
    top = top_of(source)
    (path,) = write("grid-map", source, tmp_path)
    store, messages = get_typestore(Stores.ROS2_JAZZY), {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            # The types come from the file, as for any reader of bags.
            assert schema.encoding == "ros2msg" and channel.message_encoding == "cdr"
            types = get_types_from_msg(schema.data.decode(), schema.name)
            store.register({name: fields for name, fields in types.items() if name not in store.types})
            decoded = store.deserialize_cdr(message.data, schema.name)
            messages.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert set(messages) == {"/grid_map", "/path", "/tf"} and len(messages["/tf"]) == 3
    ((time_ns, grid_map),) = messages["/grid_map"]
    assert time_ns == round(track.timestamps_s[-1] * 1e9) and grid_map.header.frame_id == "map"
    info = grid_map.info
    assert (info.resolution, info.length_x, info.length_y) == pytest.approx((0.2, 2.0, 1.6))
    assert (info.pose.position.x, info.pose.position.y) == pytest.approx((0.0, 0.0))
    layers = dict(zip(grid_map.layers, grid_map.data, strict=True))
    assert list(layers) == ["elevation", "label", *(f"probability_{name}" for name in ROVER_CLASSES)]
    for name, expected in (("elevation", top.height_m), ("label", np.where(top.observed, top.label, np.nan))):
        rows, columns = (dim.size for dim in layers[name].layout.dim[::-1])
        matrix = layers[name].data.reshape(columns, rows).T
        # Row i lies at the i-th greatest x, column j at the j-th greatest y.
        assert np.array_equal(matrix[::-1, ::-1], expected.astype(np.float32), equal_nan=True)
    ((_, path_message),) = messages["/path"]
    assert [pose.pose.position.x for pose in path_message.poses] == [0.0, 0.5, 1.0]
    rotation = messages["/tf"][0][1].transforms[0].transform.rotation
    assert abs(rotation.x) == pytest.approx(1.0)


def test_foxglove_decodes_the_run(tmp_path) -> None:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    reader_of = partial(make_reader, decoder_factories=[DecoderFactory()])
    track = short_track()
    source = source_of(
        hill((0.2, 0.2, 0.1)), beside=dict(track=track), layers={"slope_deg": np.ones((10, 8), np.float32)}
    )
    (path,) = write("mcap", source, tmp_path)
    messages: dict[str, list] = {}
    with path.open("rb") as stream:
        for schema, channel, message, decoded in reader_of(stream).iter_decoded_messages():
            assert schema.name.startswith("foxglove.")
            assert decoded.timestamp.seconds * 10**9 + decoded.timestamp.nanos == message.log_time
            messages.setdefault(channel.topic, []).append((message.log_time, decoded))
    images = {"/camera/image", "/camera/calibration"}
    assert set(messages) == {"/path", "/tf", "/map/voxels", "/map/ground", *images}
    assert [time for time, _ in messages["/tf"]] == [round(1e9 * t) for t in track.timestamps_s]
    ((_, calibration),) = messages["/camera/calibration"]
    assert list(calibration.K) == [20.0, 0, 7.5, 0, 20.0, 5.5, 0, 0, 1] and calibration.width == 16
    ((time, image),) = messages["/camera/image"]
    assert image.data == track.key_frames[0].image and time == round((1.7e9 + 1) * 1e9)
    ((_, grid),) = messages["/map/voxels"]
    (voxels,) = source.voxels()
    cells = np.frombuffer(grid.data, np.uint8).reshape(-1, grid.row_count, grid.column_count, 4)
    assert (grid.cell_size.x, grid.cell_size.y, grid.cell_size.z) == pytest.approx((0.2, 0.2, 0.1))
    z, y, x = np.nonzero(cells[..., 3])
    corner = np.array([grid.pose.position.x, grid.pose.position.y, grid.pose.position.z])
    there = corner + (np.stack([x, y, z], -1) + 0.5) * [0.2, 0.2, 0.1]
    order, expected = np.lexsort(there.round(3).T), np.lexsort(voxels.centres_world.round(3).T)
    np.testing.assert_allclose(there[order], voxels.centres_world[expected], atol=1e-5)
    colours = class_colours(ROVER_CLASSES)[voxels.label]
    assert np.array_equal(cells[z, y, x, :3][order], colours[expected])
    ((_, ground),) = messages["/map/ground"]
    top, names = top_of(source), [field.name for field in ground.fields]
    assert names[4:] == ["label", "height_m", *(f"probability_{name}" for name in ROVER_CLASSES), "slope_deg"]
    offset = ground.fields[names.index("height_m")].offset
    rows = np.frombuffer(ground.data, np.uint8).reshape(-1, ground.column_count, ground.cell_stride)
    heights = np.ascontiguousarray(rows[..., offset : offset + 4]).view("<f4")[..., 0]
    assert np.array_equal(heights.T, top.height_m.astype(np.float32), equal_nan=True)


def test_colours_of_points_may_be_others(tmp_path) -> None:
    import laspy

    def by_place(points_world: np.ndarray, label: np.ndarray) -> np.ndarray:
        return np.where(points_world[:, :1] < 0, [[255, 0, 0]], [[0, 0, 255]]).astype(np.uint8)

    source = source_of(hill(), beside=dict(colours=by_place))
    write_las(source, tmp_path / "map.las")
    las = laspy.read(tmp_path / "map.las")
    assert np.array_equal(las.red == 65535, np.asarray(las.x) < 0)
