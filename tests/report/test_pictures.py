"""Pictures of known inputs have the sizes and colours that are due."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from jaxmap.fusion.query import TopDown
from jaxmap.labels import IGNORE, ROVER_CLASSES, class_colours
from jaxmap.report.pictures import colourise_disparity, overlay_labels
from jaxmap.report.top_down import HALF, UNOBSERVED_COLOUR, _nice, top_down_colours, top_down_picture
from jaxmap.types import make_grid

MANY = tuple(f"class {index}" for index in range(21))


def flat_view(shape=(30, 20), classes=ROVER_CLASSES, seen=None) -> TopDown:
    seen = np.ones(shape, bool) if seen is None else seen
    label = np.where(seen, np.arange(shape[0])[:, None] % max(len(classes), 1), IGNORE).astype(np.uint8)
    if not classes:
        label[:] = IGNORE
    height_m = np.where(seen, 0.5, np.nan).astype(np.float32)
    return TopDown(np.full((len(classes), *shape), 0.7, np.float32), label, height_m, seen)


def colours_in(path) -> set[tuple[int, ...]]:
    with Image.open(path) as image:
        return {tuple(colour) for _, colour in image.convert("RGB").getcolors(2**24)}


def test_disparity_runs_from_blue_to_red_and_unknown_is_dark() -> None:
    disparity_px = np.tile(np.linspace(2, 60, 50, dtype=np.float32), (4, 1))
    disparity_px[0, :10] = np.nan
    disparity_px[1, 25] = 1e4
    picture = colourise_disparity(disparity_px)
    assert picture.shape == (4, 50, 3)
    assert picture.dtype == np.uint8
    assert picture[0, :10].max() < 40 < picture[0, 10:].max(axis=-1).min()
    assert picture[2, 2, 2] > picture[2, 2, 0]
    assert picture[2, -2, 0] > picture[2, -2, 2]
    # One mismatch among many pixels changes nothing else.
    without = disparity_px.copy()
    without[1, 25] = 60
    assert np.array_equal(picture, colourise_disparity(without))


@pytest.mark.parametrize("value", [np.nan, 7.0])
def test_disparity_without_a_range(value) -> None:
    picture = colourise_disparity(np.full((3, 5), value))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 1


def test_labels_and_overlay() -> None:
    labels = np.array([[0, 1], [2, IGNORE]], np.uint8)
    table = class_colours(ROVER_CLASSES)
    image = np.random.default_rng(0).integers(0, 256, (2, 2, 3)).astype(np.uint8)
    assert np.array_equal(overlay_labels(image, labels, ROVER_CLASSES, alpha=0.0), image)
    full = overlay_labels(image, labels, ROVER_CLASSES, alpha=1.0)
    assert np.array_equal(full[0], table[[0, 1]])
    assert np.array_equal(full[1, 1], image[1, 1])
    half = overlay_labels(image, labels, ROVER_CLASSES, alpha=0.5)
    assert np.abs(half[1, 0] - (image[1, 0] / 2 + table[2] / 2)).max() <= 0.5


def test_level_ground_has_exactly_its_class_colours() -> None:
    top = flat_view()
    view = top_down_colours(top, np.array([0.2, 0.2]), ROVER_CLASSES)
    assert not view.by_height
    assert np.array_equal(view.colours, class_colours(ROVER_CLASSES)[top.label])


def test_slopes_to_the_north_west_are_brighter() -> None:
    top = flat_view()
    x = np.arange(30, dtype=np.float32)[:, None] * 0.1
    rising_east = top._replace(height_m=np.broadcast_to(x, (30, 20)), label=np.ones((30, 20), np.uint8))
    falling_east = rising_east._replace(height_m=rising_east.height_m[::-1])
    cell_m = np.array([0.2, 0.2])
    lit, dark = (
        top_down_colours(view, cell_m, ROVER_CLASSES).colours.astype(int).sum(axis=-1)
        for view in (rising_east, falling_east)
    )
    assert (lit > dark).all()


def test_top_down_map_shows_the_classes_that_are_there(tmp_path) -> None:
    seen = np.zeros((300, 200), bool)
    seen[100:160, 50:90] = True
    top = flat_view((300, 200), seen=seen)
    top = top._replace(label=np.where(seen, np.where(np.arange(300)[:, None] < 130, 1, 2), IGNORE).astype(np.uint8))
    grid = make_grid([-30, -20, -1], [30, 20, 1], 0.2)
    path = tmp_path / "made" / "bev.png"
    top_down_picture(
        top, grid, ROVER_CLASSES, np.array([[-12.0, -8, 1], [-2, -4, 1], [np.nan] * 3]), path, title="A & <b>"
    )
    table = class_colours(ROVER_CLASSES)
    colours = colours_in(path)
    assert {tuple(table[1]), tuple(table[2]), UNOBSERVED_COLOUR, (255, 255, 255)} <= colours
    assert tuple(table[0]) not in colours
    with Image.open(path) as image:
        picture = np.asarray(image.convert("RGB"))
    # Cropped to the 12 m x 8 m that were seen: sand and rock fill most of the picture, in equal parts but for the path.
    sand, rock = ((picture == table[label]).all(axis=-1) for label in (1, 2))
    assert sand.mean() + rock.mean() > 0.35
    assert sand.sum() == pytest.approx(rock.sum(), rel=0.15)
    # Cells are squares of whole pixels.
    sandy = (np.abs(picture.astype(int) - table[1]) < 25).all(axis=-1)  # grid lines tint it
    columns = np.flatnonzero(sandy.sum(axis=0) > 200)
    assert (columns[-1] - columns[0] + 1) % 30 == 0
    assert [p.name for p in path.parent.iterdir()] == ["bev.png"]


@pytest.mark.parametrize(
    ("classes", "shape", "size"),
    [((), (30, 20), 0.2), (MANY, (2, 90), 0.5), (("rock",), (120, 1), (0.1, 0.3, 0.2)), (MANY, (1, 1), 1.0)],
)
def test_top_down_map_of_every_shape(tmp_path, classes, shape, size) -> None:
    size_m = np.broadcast_to(np.asarray(size), (3,))
    grid = make_grid([0, 0, 0], [shape[0] * size_m[0], shape[1] * size_m[1], 1], size)
    top_down_picture(flat_view(shape, classes), grid, classes, None, tmp_path / "bev.png")
    with Image.open(tmp_path / "bev.png") as image:
        assert max(image.size) < 2400
        assert min(image.size) > 150


def test_maps_side_by_side_have_one_size_whatever_they_show(tmp_path) -> None:
    grid = make_grid([0, 0, 0], [6, 4, 1], 0.2)
    sizes = []
    for classes in (ROVER_CLASSES, MANY):
        top_down_picture(flat_view(classes=classes), grid, classes, None, tmp_path / "bev.png", layout=HALF)
        with Image.open(tmp_path / "bev.png") as image:
            sizes.append(image.size)
    assert sizes[0] == sizes[1] and sizes[0][0] < 1200


def test_top_down_map_of_nothing(tmp_path) -> None:
    grid = make_grid([0, 0, 0], [6, 4, 1], 0.2)
    top_down_picture(flat_view(seen=np.zeros((30, 20), bool)), grid, ROVER_CLASSES, None, tmp_path / "bev.png")
    assert not {tuple(colour) for colour in class_colours(ROVER_CLASSES)[:3]} & colours_in(tmp_path / "bev.png")


@pytest.mark.parametrize(
    ("number", "expected"), [(0.3, 0.5), (1.0, 1.0), (1.01, 2.0), (6, 10.0), (0.05, 0.05), (731, 1000.0)]
)
def test_nice_numbers(number, expected) -> None:
    assert _nice(number) == pytest.approx(expected)
