"""Voxels take the colours of the images that see them."""

from __future__ import annotations

import numpy as np

from jaxmap.report.image_colours import SeenFrame, image_colours

FOCAL_PX, CENTRE_PX = (40.0, 40.0), (31.5, 23.5)
RED, GREEN, GREY = [235, 0, 0], [0, 235, 0], [128, 128, 128]


def frame(colour, x_m: float = 0.0) -> SeenFrame:
    """One that looks along z, all in one colour."""
    pose = np.eye(4)
    pose[0, 3] = x_m
    return SeenFrame(np.tile(np.array(colour, np.uint8), (48, 64, 1)), pose, FOCAL_PX, CENTRE_PX)


def test_left_and_right_halves_have_their_colours() -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, :32], image[:, 32:] = (235, 0, 0), (0, 235, 0)
    seen = SeenFrame(image, np.eye(4), FOCAL_PX, CENTRE_PX)
    # The last two are outside the image, and take the colour of the nearest that is seen.
    points = np.array([[-0.5, 0, 2.0], [0.5, 0, 2.0], [-0.1, 0, -2.0], [50, 0, 2.0]])
    assert image_colours(points, [seen]).tolist() == [RED, GREEN, RED, GREEN]
    assert image_colours(points[2:3], [seen]).tolist() == [GREY]


def test_the_nearest_frame_that_sees_a_point_colours_it() -> None:
    near = frame((0, 235, 0))
    near.T_world_camera[2, 3] = 1.0
    points = np.array([[0, 0, 3.0], [0, 0, 0.9]])
    assert image_colours(points, [frame((235, 0, 0)), near]).tolist() == [GREEN, RED]


def test_what_stands_behind_takes_its_colour_from_another_frame() -> None:
    before, behind = [0, 0, 2.0], [0, 0, 6.0]
    frames = [frame((235, 0, 0)), frame((0, 235, 0), x_m=1.0)]
    assert image_colours(np.array([before, behind]), frames).tolist() == [RED, GREEN]


def test_dark_images_are_brightened_and_grey_ones_are_taken() -> None:
    dark = SeenFrame(np.full((48, 64), 40, np.uint8), np.eye(4), FOCAL_PX, CENTRE_PX)
    assert image_colours(np.array([[0, 0, 2.0]]), [dark]).tolist() == [[235, 235, 235]]
    assert image_colours(np.zeros((0, 3)), [dark]).shape == (0, 3)
