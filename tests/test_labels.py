from __future__ import annotations

import numpy as np
import pytest

from jaxmap.labels import IGNORE, ROVER_CLASSES, UNLABELLED_COLOUR, class_colours


def test_rover_classes_are_in_the_order_of_the_label_images():
    assert ROVER_CLASSES == ("background", "sand", "rock")
    assert IGNORE == 255


@pytest.mark.parametrize("count", [0, 3, 21])
def test_colours_of_classes_differ_from_each_other_and_from_grey(count):
    classes = (ROVER_CLASSES + tuple(f"class {n}" for n in range(count)))[:count]
    table = class_colours(classes)
    assert table.shape == (256, 3)
    assert table.dtype == np.uint8
    assert len({tuple(row) for row in table[: count + 1]}) == count + 1
    assert tuple(table[IGNORE]) == UNLABELLED_COLOUR


def test_colours_do_not_depend_on_the_other_classes_for_the_rovers_own():
    assert tuple(class_colours(("rock",))[0]) == tuple(class_colours(ROVER_CLASSES)[2])
