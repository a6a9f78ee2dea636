"""The picture of what may be missed, and its place in the report."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxmap.ensemble.layer import EnsembleLayers
from jaxmap.fusion.query import TopDown
from jaxmap.report.run_page import missed_section
from jaxmap.report.top_down import MOST_MISSED, UNOBSERVED_COLOUR, missed_colours, missed_picture
from jaxmap.types import GridSpec

SHAPE = (12, 9)
CALLED, SURE, LIKELY, MORE, UNSEEN = (1, 1), (5, 5), (7, 2), (7, 5), (0, 0)


def flat() -> tuple[EnsembleLayers, TopDown]:
    """Level ground with one column of each kind."""
    missed, probability = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
    probability[CALLED] = 0.9
    for place, value in ((LIKELY, 0.3), (MORE, MOST_MISSED)):
        missed[place] = probability[place] = value
    observed = np.ones(SHAPE, bool)
    observed[UNSEEN] = False
    missed[UNSEEN] = probability[UNSEEN] = np.nan
    top = TopDown(np.zeros((3, *SHAPE)), np.ones(SHAPE, np.uint8), np.where(observed, 0.5, np.nan), observed)
    return EnsembleLayers(probability, missed), top


def test_columns_are_told_apart_by_colour():
    layers, top = flat()
    colours = missed_colours(layers, top, np.array([0.1, 0.1]))
    assert tuple(colours[UNSEEN]) == UNOBSERVED_COLOUR
    kinds = {tuple(colours[place]) for place in (CALLED, SURE, LIKELY, MORE, UNSEEN)}
    assert len(kinds) == 5
    brightness = [int(colours[place].sum()) for place in (SURE, LIKELY, MORE)]
    assert brightness == sorted(brightness, reverse=True), "the likelier, the darker, also without colours"


def test_called_columns_are_those_of_the_map():
    layers, _ = flat()
    assert np.argwhere(layers.called()).tolist() == [list(CALLED)]


@pytest.mark.parametrize("with_path", [True, False])
def test_the_picture_is_written_and_is_the_same_again(with_path, tmp_path):
    layers, top = flat()
    grid = GridSpec(jnp.zeros(3), jnp.full(3, 0.1), (*SHAPE, 4))
    path_world = np.array([[0.1, 0.1, 1.0], [0.8, 0.6, 1.0]]) if with_path else None
    for name in ("one.png", "again.png"):
        missed_picture(layers, "rock", top, grid, path_world, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "again.png").read_bytes()
    with Image.open(tmp_path / "one.png") as image:
        assert min(image.size) > 500


def test_the_section_tells_what_is_expected(tmp_path):
    ensemble = {"class": "<rock>", "members": 8, "missed_area_expected_m2": 1.25, "observed_area_m2": 80.0}
    Image.new("RGB", (40, 30)).save(tmp_path / "missed.png")
    remarks: list[str] = []
    section = missed_section(tmp_path, {"ensemble": ensemble}, remarks)
    assert "1.25" in section and "&lt;rock&gt;" in section and "<rock>" not in section and not remarks
    assert missed_section(tmp_path, {}, remarks) == ""


def test_a_picture_that_cannot_be_read_is_left_out_and_told(tmp_path):
    (tmp_path / "missed.png").write_bytes(b"no picture")
    remarks: list[str] = []
    assert missed_section(tmp_path, {"ensemble": {"class": "rock"}}, remarks) == ""
    assert remarks == ["missed.png could not be read and is left out."]
