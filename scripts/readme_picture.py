"""Makes docs/motorcycle.png, the first picture of the README: the Motorcycle pair and its map in 3D.

python scripts/readme_picture.py      (needs Chromium)
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from jaxmap.commands.main import main as jaxmap_main
from jaxmap.report.page import page
from jaxmap.report.run_page import in_3d, key_frame_row, read_run

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "motorcycle.png"
SIZE_PX = (1180, 1040)
STYLE = "<style>main{padding:1rem} h2,.view3d+p{display:none} .view3d{margin-top:1rem;height:660px}</style>"


def main() -> int:
    """Maps the pair, opens the map in a browser, and keeps what it shows."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        print("error: there is no Chromium; install it to make the picture", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        options = ["--depth.max-m", "5", "--grid.voxel-size-m", "0.025", "--stereo.mode", "hh4"]
        jaxmap_main(["map", "sample:motorcycle", "--out", str(folder / "run"), *options])
        run = read_run(folder / "run")
        body = STYLE + key_frame_row(run, next(iter(run.pictures))) + in_3d(run)
        (folder / "page.html").write_text(page("motorcycle", body, drawn=True), encoding="utf-8")
        flags = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        flags += ["--hide-scrollbars", "--virtual-time-budget=15000", f"--user-data-dir={folder / 'profile'}"]
        flags += [f"--window-size={SIZE_PX[0]},{SIZE_PX[1]}", f"--screenshot={folder / 'shot.png'}"]
        subprocess.run([browser, *flags, f"file://{folder / 'page.html'}"], check=True, stderr=subprocess.DEVNULL)
        PICTURE.parent.mkdir(exist_ok=True)
        picture = Image.open(folder / "shot.png").convert("RGB").crop((0, 0, SIZE_PX[0], 850))
        picture.quantize(256).save(PICTURE, optimize=True)
    print(f"wrote {PICTURE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
