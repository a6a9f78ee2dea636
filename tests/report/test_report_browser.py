"""The report in a real browser: nothing fails, everything is drawn, nothing is fetched."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from made_runs import add_cameras, make_run
from PIL import Image

from jaxmap.labels import ROVER_CLASSES, class_colours
from jaxmap.report.run_page import write_report

pytestmark = [pytest.mark.browser, pytest.mark.slow]

_BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Chromium's own advice on a canvas that plotly reads back.
_HARMLESS = "willReadFrequently"
# Waits for the drawing, presses the other button, and leaves what it sees as attributes of <html>.
_PROBE = """
<script>
(function wait() {
  const root = document.documentElement, place = document.getElementById("view3d");
  if (root.dataset.view3d === undefined) { setTimeout(wait, 50); return; }
  const mesh = () => ({ bar: place._fullData[0].colorbar.title.text, faces: place._fullData[0].intensity.length });
  const rectangle = place.getBoundingClientRect();
  const seen = {
    before: mesh(),
    place: [rectangle.left, rectangle.top, rectangle.right, rectangle.bottom].map(Math.round),
    ground: getComputedStyle(document.body).backgroundColor,
    wider: root.scrollWidth > root.clientWidth,
    fetched: performance.getEntriesByType("resource").map((e) => e.name).filter((name) => !/^(data|blob):/.test(name)),
  };
  document.querySelectorAll(".updatemenu-button")[1].dispatchEvent(new MouseEvent("click"));
  const drive = () => ({
    frame: root.dataset.frame, shown: document.querySelectorAll(".frame:not([hidden])").length,
    camera: place.data[place.data.length - 1].x[0], above: document.querySelector(".above .camera").getAttribute("cx"),
  });
  setTimeout(() => {
    seen.first = drive();
    document.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight", bubbles: true }));
    seen.second = drive();
  }, 200);
  setTimeout(() => { seen.after = mesh(); root.dataset.seen = JSON.stringify(seen); }, 500);
})();
</script>
"""


def browse(folder: Path, page: Path, *options: str, size: tuple[int, int] = (1280, 2200)) -> tuple[str, list[str]]:
    """Opens a page; what it prints and the lines of its console."""
    if _BROWSER is None:
        pytest.skip("no Chromium here")
    profile = folder / "profile"
    command = [
        *(_BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--use-angle=swiftshader"),
        *("--enable-unsafe-swiftshader", "--enable-logging=stderr", f"--user-data-dir={profile}", "--hide-scrollbars"),
        *(f"--window-size={size[0]},{size[1]}", "--virtual-time-budget=20000", *options, page.as_uri()),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    shutil.rmtree(profile, ignore_errors=True)
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line and _HARMLESS not in line]
    return done.stdout, console


def attributes(document: str) -> dict[str, str]:
    opening = re.search(r"<html[^>]*>", document)
    assert opening, document[:500]
    return {name: html.unescape(value) for name, value in re.findall(r'data-(\w+)="([^"]*)"', opening[0])}


@pytest.fixture(scope="module")
def probed(tmp_path_factory) -> Path:
    run = make_run(tmp_path_factory.mktemp("browser") / "run")
    add_cameras(run)
    content = write_report(run).read_text(encoding="utf-8")
    page = run / "probed.html"
    page.write_text(content.replace("</body>", f"{_PROBE}</body>"), encoding="utf-8")
    return page


@pytest.fixture(scope="module")
def in_light(probed, tmp_path_factory) -> tuple[str, list[str]]:
    return browse(tmp_path_factory.mktemp("light"), probed, "--dump-dom", "--blink-settings=preferredColorScheme=1")


@pytest.fixture(scope="module")
def in_dark_and_narrow(probed, tmp_path_factory) -> tuple[str, list[str]]:
    options = ("--dump-dom", "--blink-settings=preferredColorScheme=0")
    return browse(tmp_path_factory.mktemp("dark"), probed, *options, size=(500, 1400))


@pytest.mark.parametrize(
    ("visit", "ground"), [("in_light", "rgb(247, 246, 242)"), ("in_dark_and_narrow", "rgb(19, 21, 25)")]
)
def test_page_loads_draws_and_fetches_nothing(request, visit, ground) -> None:
    document, console = request.getfixturevalue(visit)
    assert console == []
    state = attributes(document)
    assert state["images"] == "7/7"
    assert state["view3d"] == "drawn"
    seen = json.loads(state["seen"])
    assert seen["fetched"] == []
    assert seen["ground"] == ground
    assert not seen["wider"]
    assert not seen["before"]["bar"]
    assert seen["after"] == {"bar": "height, m", "faces": seen["before"]["faces"]}
    assert seen["before"]["faces"] > 4000
    assert seen["first"] == {"frame": "000000", "shown": 1, "camera": -3, "above": "50"}
    assert seen["second"] == {"frame": "000020", "shown": 1, "camera": 4, "above": "400"}


def test_voxels_are_seen_in_their_colours(probed, in_light, tmp_path) -> None:
    left, top, right, bottom = json.loads(attributes(in_light[0])["seen"])["place"]
    picture = tmp_path / "page.png"
    _, console = browse(tmp_path, probed.with_name("report.html"), f"--screenshot={picture}")
    assert console == []
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB"), float)[top:bottom, left:right].reshape(-1, 3)
    assert pixels.std(axis=0).min() > 10
    brightness = np.linalg.norm(pixels, axis=-1)
    for label in (1, 2):
        colour = class_colours(ROVER_CLASSES)[label].astype(float)
        alike = pixels @ colour / np.maximum(brightness * np.linalg.norm(colour), 1) > 0.998
        share = brightness[alike] / np.linalg.norm(colour)
        assert alike.mean() > 0.004
        # Tops are bright and sides are dark: the faces are lit.
        assert np.percentile(share, 99) - np.percentile(share, 1) > 0.2
