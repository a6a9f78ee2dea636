"""Large maps on a page: few voxels in one view, and every one of them in its part."""

from __future__ import annotations

import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from jaxmap.export.source import Source
from jaxmap.export.voxels import OccupiedVoxels
from jaxmap.host.output_folder import write_json
from jaxmap.labels import IGNORE
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.store import in_memory, save_map
from jaxmap.report import detail, run_contents, voxel_view
from jaxmap.report.detail import EDGE, pack, parts_of
from jaxmap.report.run_contents import read_run
from jaxmap.report.run_page import write_report
from jaxmap.report.top_down import PLACE, PLACE_KEY
from jaxmap.report.voxel_view import exposed_faces
from jaxmap.types import make_grid, make_voxel_map

CLASSES = ("sand", "rock")


def unpacked(packed: bytes, place: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """What detail.js reads of a part."""
    raw = np.frombuffer(gzip.decompress(packed), np.uint8).astype(int)
    count = len(raw) // 5
    z = raw[2 * count : 4 * count]
    index = np.stack(
        [raw[:count] + place[0] * EDGE, raw[count : 2 * count] + place[1] * EDGE, z[::2] + 256 * z[1::2]], axis=-1
    )
    return index, raw[4 * count :]


class Blocks(Source):
    """A source of these voxels, block by block."""

    pieces: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    def voxels(self):
        for index, label in self.pieces:
            one = np.ones(3, np.float32)
            yield OccupiedVoxels(index, index.astype(np.float32), label, np.ones(len(label), np.float32), one)


def test_parts_hold_all_voxels_once_in_a_memory_that_does_not_grow():
    rng = np.random.default_rng(0)
    pieces = []
    for x in range(0, 3 * EDGE, 64):
        for y in range(0, 2 * EDGE, 64):
            index = np.unique(rng.integers([x, y, 0], [x + 64, y + 64, 700], (40, 3)), axis=0).astype(np.int32)
            pieces.append((index, rng.choice([0, 1, IGNORE], len(index)).astype(np.uint8)))
    source = Blocks(in_memory(make_voxel_map(make_grid([0, 0, 0], [1, 1, 1], 0.5), CLASSES), MapAttributes()))
    object.__setattr__(source, "pieces", tuple(pieces))
    parts = list(parts_of(source))
    assert [part.place for part in parts] == [(x, y) for x in range(3) for y in range(2)]
    found, labels = (
        np.concatenate(of) for of in zip(*(unpacked(part.packed, part.place) for part in parts), strict=True)
    )
    given, known = (np.concatenate(of) for of in zip(*pieces, strict=True))
    for ours, theirs in ((found, given), (labels, known)):
        np.testing.assert_array_equal(ours[np.lexsort(found.T)], theirs[np.lexsort(given.T)])
    assert sum(part.voxels for part in parts) == len(given)


def test_a_part_is_small():
    index = np.argwhere(np.ones((EDGE, EDGE, 1))).astype(np.int32)
    assert len(pack(index, np.ones(len(index), np.uint8), (0, 0)).packed) < 0.1 * len(index)


def test_faces_of_voxels_far_apart_need_no_array_between_them():
    index = np.array([[0, 0, 0], [400_000, 900_000, 30], [400_001, 900_000, 30]])
    faces = exposed_faces(index)
    assert len(faces.voxel) == 6 + 2 * 5
    assert faces.corner.max(axis=0).tolist() == [400_002, 900_001, 31]
    assert not len(exposed_faces(np.zeros((0, 3), int)).voxel)


@pytest.fixture
def run(tmp_path):
    """A run whose map is a plain of 40 by 30 columns, with a picture that says where it lies."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    voxel_map = make_voxel_map(make_grid([0, 0, 0], [4, 3, 0.4], 0.1), CLASSES)
    values = np.zeros(voxel_map.log_odds.shape, np.float32)
    values[0, ..., 1], values[1, ..., 1] = 2, 2
    save_map(tmp_path / "map.zarr", replace(voxel_map, log_odds=values), MapAttributes())
    write_json(tmp_path / "metrics.json", {})
    text = PngInfo()
    text.add_text(PLACE_KEY, json.dumps(dict(zip(PLACE, (0, 0, 40, 30, 0, 0, 4, 3), strict=True))))
    Image.new("RGB", (40, 30), (200, 180, 120)).save(tmp_path / "bev.png", pnginfo=text)
    return tmp_path


def test_few_voxels_are_held_of_a_large_map(run, monkeypatch):
    whole = read_run(run)
    assert (len(whole.voxels.label), whole.merged, whole.occupied) == (1200, 1, 1200)
    assert whole.area_m2 == pytest.approx(12)
    monkeypatch.setattr(run_contents, "MOST_VOXELS", 100)
    few = read_run(run)
    assert (few.merged, few.occupied, few.area_m2) == (4, 1200, whole.area_m2)
    assert len(few.voxels.label) == 10 * 8 and (few.voxels.label == 0).all()
    np.testing.assert_allclose(few.voxels.centres_world[0], [0.2, 0.2, 0.2], atol=1e-6)


def test_a_small_map_has_no_parts(run):
    page = write_report(run).read_text()
    assert 'id="detail"' not in page and "script-src 'unsafe-inline'\"" in page


@pytest.mark.parametrize("most", [10_000_000, 10])
def test_parts_lie_in_the_page_or_beside_it(run, monkeypatch, most):
    monkeypatch.setattr(voxel_view, "MAX_FACES", 500)
    monkeypatch.setattr(detail, "MOST_EMBEDDED_BYTES", most)
    (run / "report.parts").mkdir()
    (run / "report.parts" / "part-9-9.js").write_text("of a run before")
    page = write_report(run).read_text()
    assert "All 1,200 voxels, in 1 parts of 19.2 m" in page and 'data-part="0-0"' in page
    beside = sorted(path.name for path in (run / "report.parts").glob("*"))
    if most > 10:
        packed = re.findall('<script type="text/plain" id="part-0-0">(.*?)</script>', page)[0]
        assert not beside and "file:" not in page.split("</head>")[0]
    else:
        assert beside == ["part-0-0.js"] and "script-src 'unsafe-inline' 'self' file:" in page
        packed = re.findall('"0-0","(.*?)"', (run / "report.parts" / "part-0-0.js").read_text())[0]
    index, label = unpacked(base64.b64decode(packed), (0, 0))
    assert len(index) == 1200 and (index[:, 2] == 1).all() and not label.any()
