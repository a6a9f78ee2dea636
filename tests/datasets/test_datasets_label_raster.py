"""Ground truth from files: orthomosaics of any system, affine and coding, and lists of rocks."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from rasterio import Affine
from rasterio.enums import ColorInterp
from truth_files import CRS, SITE, class_layer, write_raster

from jaxmap.datasets.crs import Extent
from jaxmap.datasets.label_raster import (
    DEFAULT_CODING,
    LabelCoding,
    choose_coding,
    make_coding,
    parse_coding,
    read_coding,
    read_label_orthomosaic,
)
from jaxmap.datasets.rasters import read_picture
from jaxmap.datasets.rock_list import draw_rocks, find_rock_lists, read_rock_lists
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.cells import make_cells
from jaxmap.evaluation.truth_cells import truth_cells

WEST, NORTH = float(SITE[0]), float(SITE[1]) + 8.0
PLACE = Extent(SITE[0], SITE[1], SITE[0] + 8.0, SITE[1] + 8.0, CRS)


def blobs(size: int = 160) -> np.ndarray:
    """Rocks on sand, rows from the north; the rim unlabelled."""
    rows, columns = np.mgrid[:size, :size] / size * 8.0
    labels = np.ones((size, size), np.uint8)
    for x, y, radius in ((2.0, 3.0, 0.6), (5.5, 2.0, 0.4), (4.0, 6.2, 0.9)):
        labels[(columns - x) ** 2 + (8.0 - rows - y) ** 2 < radius**2] = 2
    labels[:4] = labels[:, :4] = 0
    return labels


def shares(raster, crs: str | None = CRS):
    cells = make_cells(class_layer(np.zeros((40, 40), bool)).grid, 0.2)
    return truth_cells(raster, cells, SITE, crs)


@pytest.fixture
def plain(tmp_path):
    return read_label_orthomosaic(write_raster(tmp_path / "plain.tif", blobs(), WEST, NORTH, 0.05), PLACE)


def test_labels_are_read_where_they_lie(plain):
    truth = shares(plain)
    assert truth.share[10, 15] == 1.0 and truth.share[0, 20] == 0.0 and not truth.labelled[0, 20]
    assert plain.notes == ()


def test_only_the_window_over_the_map_is_read(tmp_path):
    wide = np.pad(blobs(), 400, constant_values=1)
    wide[0, 0] = 77
    path = write_raster(tmp_path / "wide.tif", wide, WEST - 20.0, NORTH + 20.0, 0.05)
    read = read_label_orthomosaic(path, PLACE)
    assert max(read.labels.shape) < 170
    np.testing.assert_array_equal(shares(read).share, shares(read_label_orthomosaic(path, PLACE, margin=3.0)).share)


def rotated(angle_rad: float, pixel_m: float) -> tuple[np.ndarray, Affine]:
    """The blobs on a raster that is turned about the middle of the site."""
    c, s = pixel_m * np.cos(angle_rad), pixel_m * np.sin(angle_rad)
    west, north = WEST + 4.0 - 150 * c - 150 * s, NORTH - 4.0 - 150 * s + 150 * c
    transform = Affine(c, s, west, s, -c, north)
    column, row = np.meshgrid(np.arange(300) + 0.5, np.arange(300) + 0.5)
    x, y = west + c * column + s * row, north + s * column - c * row
    labels = blobs(1600)
    at = np.floor((NORTH - y) / 0.005).astype(int), np.floor((x - WEST) / 0.005).astype(int)
    inside = (at[0] >= 0) & (at[0] < 1600) & (at[1] >= 0) & (at[1] < 1600)
    turned = np.where(inside, labels[np.where(inside, at[0], 0), np.where(inside, at[1], 0)], 0).astype(np.uint8)
    return turned, transform


def test_a_rotated_raster_gives_the_same_labels(tmp_path, plain):
    labels, transform = rotated(0.5, 0.05)
    read = read_label_orthomosaic(write_raster(tmp_path / "r.tif", labels, 0, 0, 0, transform=transform), PLACE)
    there, here = shares(read), shares(plain)
    both = there.labelled & here.labelled
    assert both.sum() > 1400
    assert np.abs(there.share - here.share)[both].max() < 0.3
    assert np.abs(there.share - here.share)[both].mean() < 0.01


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:4326", "EPSG:3857"])
def test_a_reprojected_raster_gives_the_same_labels(tmp_path, plain, crs):
    from rasterio.warp import calculate_default_transform, reproject

    fine = np.kron(blobs(), np.ones((4, 4), np.uint8))
    source = Affine(0.0125, 0, WEST, 0, -0.0125, NORTH)
    transform, width, height = calculate_default_transform(CRS, crs, 640, 640, WEST, NORTH - 8, WEST + 8, NORTH)
    warped = np.zeros((height, width), np.uint8)
    reproject(fine, warped, src_transform=source, src_crs=CRS, dst_transform=transform, dst_crs=crs)
    path = write_raster(tmp_path / "warped.tif", warped, 0, 0, 0, crs=crs, transform=transform)
    there, here = shares(read_label_orthomosaic(path, PLACE)), shares(plain)
    both = there.labelled & here.labelled
    assert both.sum() > 1400
    assert np.abs(there.share - here.share)[both].mean() < 0.005


def test_codes_and_colours_and_palettes_mean_the_same(tmp_path, plain):
    labels = blobs()
    codes = np.array([9, 40, 200], np.uint8)[labels]
    coding = parse_coding(["9=unlabelled", "40=sand", "200=rock"])
    path = write_raster(tmp_path / "codes.tif", codes, WEST, NORTH, 0.05)
    np.testing.assert_array_equal(read_label_orthomosaic(path, PLACE, coding=coding).labels, plain.labels)

    colours = np.array([[0, 0, 0], [222, 184, 120], [178, 60, 46]], np.uint8)
    coding = parse_coding(["#000000=unlabelled", "#b23c2e=rock", "*=sand"])
    path = write_raster(tmp_path / "rgb.tif", np.moveaxis(colours[labels], -1, 0), WEST, NORTH, 0.05)
    np.testing.assert_array_equal(read_label_orthomosaic(path, PLACE, coding=coding).labels, plain.labels)

    palette = {index: tuple(map(int, colour)) for index, colour in enumerate(colours)}
    path = write_raster(tmp_path / "palette.tif", labels, WEST, NORTH, 0.05, palette=palette)
    np.testing.assert_array_equal(read_label_orthomosaic(path, PLACE).labels, plain.labels)
    np.testing.assert_array_equal(read_label_orthomosaic(path, PLACE, coding=coding).labels, plain.labels)
    picture, _, _ = read_picture(path, PLACE)
    np.testing.assert_array_equal(picture, colours[labels])


def test_nodata_and_transparency_are_unlabelled(tmp_path, plain):
    labels = blobs()
    void = np.where(labels == 0, 255, labels).astype(np.uint8)
    path = write_raster(tmp_path / "nodata.tif", void, WEST, NORTH, 0.05, nodata=255)
    np.testing.assert_array_equal(read_label_orthomosaic(path, PLACE).labels, plain.labels)
    floats = np.where(labels == 0, np.nan, labels).astype(np.float32)
    path = write_raster(tmp_path / "floats.tif", floats, WEST, NORTH, 0.05, nodata=np.nan)
    np.testing.assert_array_equal(read_label_orthomosaic(path, PLACE).labels, plain.labels)
    import rasterio

    clear = np.stack([np.ones_like(labels) + (labels == 2), np.where(labels == 0, 0, 255).astype(np.uint8)])
    path = write_raster(tmp_path / "alpha.tif", clear, WEST, NORTH, 0.05)
    with rasterio.open(path, "r+") as raster:
        raster.colorinterp = [ColorInterp.gray, ColorInterp.alpha]
    np.testing.assert_array_equal(read_label_orthomosaic(path, PLACE).labels, plain.labels)


def test_assumptions_on_an_unknown_system_are_noted(tmp_path, plain):
    bare = write_raster(tmp_path / "bare.tif", blobs(), WEST, NORTH, 0.05, crs=None)
    read = read_label_orthomosaic(bare, PLACE)
    assert read.notes == ("bare.tif has no CRS: taken for the map's, EPSG:32631",)
    np.testing.assert_array_equal(shares(read).share, shares(plain).share)
    known = write_raster(tmp_path / "known.tif", blobs(), WEST, NORTH, 0.05)
    read = read_label_orthomosaic(known, PLACE._replace(crs=None))
    assert read.notes == ("the map has no CRS: taken for that of known.tif, EPSG:32631",)
    named = read_label_orthomosaic(bare, PLACE, crs="EPSG:32631")
    assert named.notes == () and named.crs == "EPSG:32631"


def test_faults_of_a_raster_are_reported(tmp_path):
    labels = blobs()
    away = write_raster(tmp_path / "away.tif", labels, WEST + 500, NORTH, 0.05)
    with pytest.raises(JaxmapError, match="does not lie over the map: it reaches from 596183 to 596191 east") as e:
        read_label_orthomosaic(away, PLACE)
    assert "the map from 595683 to 595691 east" in str(e.value) and "EPSG:32631" in str(e.value)
    other = write_raster(tmp_path / "other.tif", labels, 0.0, 8.0, 0.05, crs=None)
    with pytest.raises(JaxmapError, match="no CRS, name it with --truth-crs"):
        read_label_orthomosaic(other, PLACE)
    with pytest.raises(JaxmapError, match=r"label values without a class: 7 \(12 px\), 9 \(1 px\)"):
        strange = labels.copy()
        strange[50, 50:62], strange[60, 60] = 7, 9
        read_label_orthomosaic(write_raster(tmp_path / "s.tif", strange, WEST, NORTH, 0.05), PLACE)
    with pytest.raises(JaxmapError, match="3 bands, one band of labels is expected"):
        read_label_orthomosaic(write_raster(tmp_path / "b.tif", np.stack([labels] * 3), WEST, NORTH, 0.05), PLACE)
    with pytest.raises(JaxmapError, match="fractions, not labels"):
        halves = labels.astype(np.float32) / 2
        read_label_orthomosaic(write_raster(tmp_path / "h.tif", halves, WEST, NORTH, 0.05), PLACE)
    with pytest.raises(JaxmapError, match="not georeferenced"):
        read_label_orthomosaic(write_raster(tmp_path / "n.tif", labels, 0, 0, 0, transform=Affine.identity()), PLACE)
    with pytest.raises(JaxmapError, match="no such file"):
        read_label_orthomosaic(tmp_path / "nowhere.tif", PLACE)
    with pytest.raises(UsageError, match="has no class 'bush'"):
        plain = write_raster(tmp_path / "p.tif", labels, WEST, NORTH, 0.05)
        read_label_orthomosaic(plain, PLACE, target="bush")
    with pytest.raises(JaxmapError, match="unknown coordinate reference system 'EPSG:1'"):
        read_label_orthomosaic(plain, PLACE, crs="EPSG:1")


def test_a_raster_too_large_for_memory_is_refused_by_its_size(tmp_path):
    """46,000 x 46,000 numbers in a file of some kilobytes: tiles that are not there."""
    path = tmp_path / "sparse.tif"
    profile = dict(driver="GTiff", width=46_000, height=46_000, count=1, dtype="float64", crs=CRS, SPARSE_OK=True)
    transform = Affine(1e-3, 0, PLACE.west, 0, -1e-3, PLACE.north)
    with rasterio.open(path, "w", **profile, tiled=True, transform=transform):
        pass
    with pytest.raises(JaxmapError, match="46000 x 46000 pixels of 1 bands lie over the map"):
        read_label_orthomosaic(path, Extent(PLACE.west, PLACE.north - 46, PLACE.west + 46, PLACE.north, CRS))
    corner = Extent(PLACE.west, PLACE.north - 0.1, PLACE.west + 0.1, PLACE.north, CRS)
    assert read_label_orthomosaic(path, corner).labels.shape == (102, 102)


@pytest.mark.parametrize("numbers", [(1e300, 0, 0, 0, -1, 0), (1e-300, 0, 0, 0, -1e-300, 0), (1, 0, 1e300, 0, -1, 0)])
def test_a_georeference_beyond_the_earth_is_none(tmp_path, numbers):
    path = write_raster(tmp_path / "far.tif", np.ones((4, 4), np.uint8), 0, 0, 1, transform=Affine(*numbers))
    with pytest.raises(JaxmapError, match="not georeferenced"):
        read_label_orthomosaic(path, PLACE)


def test_every_cut_of_a_raster_is_one_line(tmp_path):
    whole = write_raster(tmp_path / "whole.tif", blobs(), WEST, NORTH, 0.05, compress="deflate").read_bytes()
    damaged = tmp_path / "damaged.tif"
    for size in (0, 3, 40, len(whole) // 3, len(whole) // 2, len(whole) - 200):
        damaged.write_bytes(whole[:size])
        # A cut may take the georeference alone.
        with pytest.raises(JaxmapError, match="not a readable raster|no CRS|not georeferenced") as fault:
            read_label_orthomosaic(damaged, PLACE)
        assert "\n" not in str(fault.value)
    damaged.write_text("not a picture at all\n" * 50)
    with pytest.raises(JaxmapError, match="not a readable raster"):
        read_label_orthomosaic(damaged, PLACE)


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["3"], "is not CODE=CLASS"),
        (["x=rock"], "is not a code"),
        (["3="], "does not name a class"),
        (["3=rock", "#ffffff=sand"], "numbers and colours are mixed"),
        (["*=rock"], "no code is given"),
    ],
)
def test_invalid_codings_are_refused(words, what):
    with pytest.raises(UsageError, match=what.replace("*", r"\*")):
        parse_coding(words)


def test_codings_from_files(tmp_path):
    path = tmp_path / "palette.yaml"
    path.write_text("0: unlabelled\n3: rock\n'*': sand\n")
    assert read_coding(path) == LabelCoding({0: "unlabelled", 3: "rock"}, rest="sand")
    for text, what in (
        ("- 1\n", "no keys and values"),
        ("a: [", "malformed YAML"),
        ("1: {}\n", "does not name a class"),
    ):
        path.write_text(text)
        with pytest.raises(UsageError, match=what):
            read_coding(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="not a text file"):
        read_coding(path)
    with pytest.raises(UsageError, match="cannot be read"):
        read_coding(tmp_path)
    assert make_coding({"-1": "rock"}, "here").text() == "-1=rock"


def test_words_or_a_file_choose_the_coding(tmp_path):
    path = tmp_path / "palette.yaml"
    path.write_text("0: unlabelled\n3: rock\n")
    assert choose_coding((), None) == DEFAULT_CODING
    assert choose_coding(["3=rock"], None) == LabelCoding({3: "rock"})
    assert choose_coding((), path) == read_coding(path)
    with pytest.raises(UsageError, match="exclude each other"):
        choose_coding(["3=rock"], path)


def test_rocks_are_discs_on_sand(tmp_path):
    (tmp_path / "large-rocks-1.txt").write_text(f"{SITE[0] + 2} {SITE[1] + 3}\n{SITE[0] + 6} {SITE[1] + 5}\n")
    (tmp_path / "mine.csv").write_text(f"y,x,diameter\n{SITE[1] + 6},{SITE[0] + 3},0.5\n\n# a comment\n")
    lists = find_rock_lists(tmp_path)
    rocks = read_rock_lists(lists, {"small": 0.2, "medium": 0.5, "large": 1.2})
    np.testing.assert_array_equal(rocks.diameters_m, [1.2, 1.2, 0.5])
    assert rocks.notes == ("large-rocks-1.txt: 2 rocks taken for discs of 1.2 m",)
    drawn = draw_rocks(rocks, PLACE, name="rocks")
    truth = shares(drawn)
    rock_m2 = (truth.share * truth.labelled).sum() * 0.04
    assert rock_m2 == pytest.approx(np.pi * (2 * 0.6**2 + 0.25**2), rel=0.01)
    assert truth.share[10, 15] == 1.0 and not truth.labelled[0, 0] and truth.labelled[15, 20]
    assert any("taken for sand" in note for note in drawn.notes)


def test_one_rock_alone_and_lists_of_another_system(tmp_path):
    from pyproj import Transformer

    longitude, latitude = Transformer.from_crs(CRS, 4326, always_xy=True).transform(SITE[0] + 4, SITE[1] + 4)
    (tmp_path / "a.txt").write_text(f"{longitude!r}\t{latitude!r}\t0.8\n")
    drawn = draw_rocks(read_rock_lists([tmp_path / "a.txt"]), PLACE, "EPSG:4326")
    truth = shares(drawn)
    assert truth.share[19:21, 19:21].min() == 1.0
    # Sand within 1 m of the disc.
    assert truth.labelled.sum() * 0.04 == pytest.approx(np.pi * 1.4**2, rel=0.15)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "no rocks"),
        ("x,y\n", "no rocks"),
        ("1 2\n3\n", "1 columns in .*line 2"),
        ("1 2 3\n1 b 3\n", "line 2"),
        ("1 nan\n", "not finite"),
        ("1 2 -3\n", "not positive"),
        ("1 1e30\n", "beyond the earth"),
        ("1 2 1e-300\n", "not positive"),
        ("east,north\n1,2\n", "the columns are east north"),
        ("1 2\n", "do not lie over the map: they reach from"),
    ],
)
def test_faults_of_lists_are_reported(tmp_path, text, what):
    (tmp_path / "rocks.txt").write_text(text)
    with pytest.raises(JaxmapError, match=what):
        draw_rocks(read_rock_lists([tmp_path / "rocks.txt"]), PLACE)
