"""Semi-global matching in JAX beside OpenCV's modes at equal settings: what is matched, and how truly.

    python scripts/experiments/matching.py [--matchers 3way bands sgbm hh census bt --p1 0.15 --p2 0.8 --frames 3]

`bands` is 3WAY as `--stereo.narrow` runs it. Disparities searched, block, uniqueness, left-right check and
speckles are the defaults of `StereoOptions` for all; edges of depth are kept. With truth (the Motorcycle pair; frames
of simulated traverses with `gt/depth`): `matched`, the share of the pixels whose disparity is known that have one; of
these, `off_1` and `off_3`, which err by more than 1 and 3 px, and the median error; `bad_1` and `bad_3`, the same
shares over all pixels, where a pixel without a match is a bad one. Without truth, of KITTI and K10 `agreeing`: points
within 5 % of the depth measured five frames later. `ms` is time of the processor.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import product
from pathlib import Path

import cv2
import jax
import numpy as np
from common import SHARED, Table, command_line, parse
from stereo_table import Simulated, Site, sites

from jaxmap.matching.design import MatchDesign, make_match_params
from jaxmap.matching.match import match
from jaxmap.stereo.bands import search_bands
from jaxmap.stereo.coarse import CoarseMatcher
from jaxmap.stereo.match import Matcher, StereoOptions

SCORES = ("matched", "off_1", "off_3", "median_px", "bad_1", "bad_3", "agreeing")
Match = Callable[[np.ndarray, np.ndarray], np.ndarray]

matched = jax.jit(match, static_argnums=0)


def opencv(mode: str, width_px: int) -> Match:
    """OpenCV's matcher in that mode."""
    return Matcher(StereoOptions(mode=mode, edge_step_px=0), width_px)


def in_bands(width_px: int) -> Match:
    """OpenCV's 3WAY as `--stereo.narrow` runs it: in bands, of the disparities that small images show there."""
    matcher = Matcher(StereoOptions(edge_step_px=0), width_px)
    coarse = CoarseMatcher(matcher, width_px)
    return lambda left, right: matcher(left, right, search_bands(coarse(left, right), matcher, len(left)))


def ours(kind: str, width_px: int, p1: float | None, p2: float | None) -> Match:
    """Ours, by the kind of cost: `census` of 7 x 9, `census5x5`, `census1` of single pixels, or `bt`."""
    options = StereoOptions()
    design = MatchDesign(
        cost="bt" if kind == "bt" else "census",
        census_window_px=(5, 5) if kind == "census5x5" else (7, 9),
        block_size=1 if kind == "census1" else options.block_size,
        num_disparities=Matcher(options, width_px).num_disparities,
        edge_step_px=0,
    )
    params = make_match_params(design.cost, p1=p1, p2=p2, uniqueness=options.uniqueness_ratio / 100)
    return lambda left, right: np.array(matched(design, left, right, params))


def scores(site: Site, matcher: Match) -> dict[str, float | None]:
    """Of the frames of a data set that have a truth, or of all."""
    disparities, spent_ms = {}, []
    for index in site.chosen:
        left, right = (_grey(image) for image in site.pairs[index][:2])
        if not disparities:
            matcher(left, right)
        started_s = time.process_time()
        disparities[index] = matcher(left, right)
        spent_ms.append(1e3 * (time.process_time() - started_s))
    rows = {"ms": float(np.median(spent_ms)), **site.scored(disparities)}
    truths = {index: truth.disparity_px for index, truth in site.truths().items() if truth.disparity_px is not None}
    if not truths:
        return rows | {"matched": float(np.mean([np.isfinite(one).mean() for one in disparities.values()]))}
    errors = []
    for index, truth in truths.items():
        known = np.isfinite(truth) & (truth > 0)
        errors.append(np.abs(disparities[index] - truth)[known])
    error = np.concatenate(errors)
    found = np.isfinite(error)
    rows |= {"matched": float(found.mean()), "median_px": float(np.median(error[found]))}
    for limit in (1, 3):
        rows[f"off_{limit}"] = float((error[found] > limit).mean())
        rows[f"bad_{limit}"] = float(1 - (error <= limit).mean())
    return rows


def _grey(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def main() -> None:
    """Prints one table."""
    parser = command_line(__doc__)
    parser.add_argument("--data", type=Path, default=SHARED)
    parser.add_argument("--matchers", nargs="+", default=["3way", "bands", "sgbm", "hh", "census", "bt"])
    parser.add_argument("--p1", nargs="+", type=float, default=[None])
    parser.add_argument("--p2", nargs="+", type=float, default=[None])
    parser.add_argument("--frames", type=int, default=3, help="of each traverse, of those with a true depth")
    parser.add_argument("--traverses", nargs="+", help="others than simdata's two and the sample")
    parser.add_argument("--stop", type=int, default=10, help="of traverses, so many frames alone are read")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    cv2.setNumThreads(1)
    columns = {"data": "<16", "matcher": "<9", "p1": "5.2f", "p2": "5.2f"}
    table = Table({**columns, **{name: f"{max(len(name) + 1, 8)}.4f" for name in SCORES}, "ms": "6.0f"})
    for site in sites(given.data, given.traverses, (), given.stop):
        if isinstance(site, Simulated):
            site.chosen = site.chosen[:: max(len(site.chosen) // given.frames, 1)][: given.frames]
        for kind in given.matchers:
            if kind in ("3way", "bands", "sgbm", "hh", "hh4"):
                width_px = site.front_end.camera.width_px
                choices = [(None, None, in_bands(width_px) if kind == "bands" else opencv(kind, width_px))]
            else:
                width_px = site.front_end.camera.width_px
                choices = [(p1, p2, ours(kind, width_px, p1, p2)) for p1, p2 in product(given.p1, given.p2)]
            for p1, p2, matcher in choices:
                row = scores(site, matcher)
                table.row(site.name, kind, p1, p2, *(row.get(name) for name in (*SCORES, "ms")))
    table.write(given.json)


if __name__ == "__main__":
    main()
