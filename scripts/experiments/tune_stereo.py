"""Tunes stereo matching through the map of some traverses, and scores it on others.

    python scripts/experiments/tune_stereo.py --tune sample:traverse --score TRAVERSE... [--labels relief] [--stop 6]
    python scripts/experiments/tune_stereo.py --tuned tuned_stereo/sgm_relief.yaml --score TRAVERSE...

A TRAVERSE is `sample:traverse` or a folder in the simulator's layout. `jaxmap tune --through stereo` runs on those of
`--tune`; `--tuned` takes what was written before, on a GPU perhaps. Then all traverses are matched, with hard minima
and at full size, by the default numbers of each matcher and by the tuned ones. Prints one table: penalties; of frames
with true depth (`gt/depth`) within 12 m the share matched, and of that the share off by more than 1 and 2 px, the
latter among rocks alone, too; of the map the scores of `jaxmap evaluate` in cells of 0.2 m within the range, and the
mean IoU on 16 lattices of cells.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import Frames, Table, Traverse, command_line, parse
from stereo_table import Simulated

from jaxmap.geometry.options import DepthOptions, GridOptions
from jaxmap.runs.config import MapConfig, load_config
from jaxmap.runs.evaluation import TruthOptions
from jaxmap.runs.stereo_tuning import StereoTuningRun
from jaxmap.runs.tuning import Source
from jaxmap.stereo.jax_matcher import match_params
from jaxmap.stereo.match import StereoOptions
from jaxmap.tuning.options import DescentOptions, TuneOptions

PIXELS = ("valid", "off_1px", "off_2px", "rock_off_2px")
CELLS = ("iou", "precision", "recall")


def config_of(traverse: Traverse, stereo: StereoOptions, given: Namespace) -> MapConfig:
    """How a traverse is mapped."""
    true = given.labels == "true"
    return replace(
        traverse.config("true" if true else "plane"),
        labeller="files" if true else given.labels,
        stereo=stereo,
        depth=DepthOptions(max_m=given.max_m),
        grid=GridOptions(voxel_size_m=given.voxel_m),
        stop=given.stop,
        stride=given.stride,
    )


def tune(given: Namespace) -> Path:
    """Tunes on the traverses to tune on, and gives the file that is written."""
    traverses = [Traverse(path) for path in given.tune]
    stereo = StereoOptions(
        matcher=given.matcher,
        num_disparities=given.num_disparities,
        cost_network=_network(given.matcher, given),
        temperature=given.temperature,
    )
    configs = [config_of(traverse, stereo, given) for traverse in traverses]
    sources = [
        Source(traverse.sequence, traverse.truth, labels=config.labels)
        for traverse, config in zip(traverses, configs, strict=True)
    ]
    descent = DescentOptions(steps=given.steps, learning_rate=given.learning_rate)
    options = TuneOptions(descent=descent, through="stereo", smaller=given.smaller, frozen=tuple(given.frozen))
    given.out.mkdir(parents=True, exist_ok=True)
    out = given.out / f"{given.name or f'{given.matcher}_{given.labels}'}.yaml"
    run = StereoTuningRun(sources, configs[0], TruthOptions(), options, out, final=out, notify=lambda line: None)
    run.cache(lambda done: None)
    result = run.tune(lambda step, note: print(f"step {step}: {note}", flush=True))
    print("\n".join(result["notes"]))
    return out


def score(given: Namespace, tuned: list[Path]) -> None:
    """Matches and maps all traverses anew by each setting."""
    found = {path.stem: load_config(str(path)).stereo for path in tuned}
    usual = {one.matcher: replace(one, **_USUAL, cost_network=_network(one.matcher, given)) for one in found.values()}
    settings = {**{f"default {matcher}": stereo for matcher, stereo in usual.items()}, **found}
    numbers = dict.fromkeys(("p1", "p2", "unique"), "7.3f")
    scores = dict.fromkeys((*PIXELS, *CELLS), "13.4f")
    table = Table({"traverse": "<16", "": "<9", "stereo": "<20", **numbers, **scores, "mean IoU": "9.3f", "rock": "6d"})
    for path in dict.fromkeys([*given.tune, *given.score]):
        traverse = Traverse(path)
        pairs = Simulated(traverse, (), given.stop) if (traverse.gt / "depth").is_dir() else None
        for name, stereo in settings.items():
            pixels = {} if pairs is None else pairs.row(stereo)
            cells = Frames(traverse.sequence, traverse.truth).scored(config_of(traverse, stereo, given))
            params = match_params(stereo)
            row = [float(value) for value in (params.p1, params.p2, params.uniqueness)]
            row += [pixels.get(score) for score in PIXELS] + [cells.scores[score] or 0.0 for score in CELLS]
            seen = "tuned on" if path in given.tune else ""
            mean = float(np.mean(cells.lattice_ious()))
            table.row(traverse.name, seen, name, *row, mean, cells.scores["rock_cells"])
            table.write(given.json)


def _network(matcher: str, given: Namespace) -> Path | None:
    return given.cost_network if matcher == "mccnn" else None


_USUAL = {
    **dict.fromkeys(("step_penalty", "jump_penalty", "cost_network_sha256")),
    "uniqueness_ratio": StereoOptions().uniqueness_ratio,
}
"""The numbers that are tuned, as they are by default."""


def main() -> None:
    """Tunes, maps, scores, prints."""
    parser = command_line(__doc__)
    parser.add_argument("--tune", nargs="+", default=[], help="traverses to tune on")
    parser.add_argument("--tuned", nargs="+", type=Path, default=[], help="files of numbers tuned before")
    parser.add_argument("--score", nargs="*", default=[], help="traverses that tuning never sees")
    parser.add_argument("--labels", choices=("true", "relief", "plane", "deeplab"), default="relief")
    parser.add_argument("--matcher", choices=("sgm", "mccnn"), default="sgm")
    parser.add_argument("--cost-network", type=Path, help="its weights at first, in place of the packaged ones")
    parser.add_argument("--num-disparities", type=int, help="disparities searched at full size")
    parser.add_argument("--temperature", type=float, default=StereoOptions().temperature, help="while tuning")
    parser.add_argument("--frozen", nargs="*", default=[], help="numbers that stay as they are")
    parser.add_argument("--smaller", type=int, choices=(1, 2, 4), default=2)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--learning-rate", type=float, default=DescentOptions().learning_rate)
    parser.add_argument("--stop", type=int, help="frames of each traverse, from its first on")
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--max-m", type=float, default=8.0)
    parser.add_argument("--voxel-m", type=float, default=0.2)
    parser.add_argument("--out", type=Path, default=Path("tuned_stereo"), help="folder for the configurations")
    parser.add_argument("--name", help="of the file in it")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    tuned = given.tuned if given.tuned or not given.tune else [tune(given)]
    if tuned and given.score:
        score(given, tuned)


if __name__ == "__main__":
    main()
