"""What geometry and appearance bring: each source of labels on the same traverses, by several matchers.

    python scripts/experiments/relief_ladder.py [TRAVERSE...] [--matchers M...] [--labels L...] [--stop N] [--json F]

A TRAVERSE is `sample:traverse` or a folder in the simulator's layout; by default the sample and the two of another
renderer beside the repository. Maps are made under the default rule with the reader's own poses and scored in cells of
0.2 m within 8 m of the camera. Prints one table: the scores of the usual lattice of cells, the calibration of the
probability of rock (ECE), and the IoU on 16 lattices.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from common import SHARED, Frames, Table, Traverse, command_line, parse

from jaxmap.labellers.options import DeeplabOptions, ReliefOptions
from jaxmap.runs.config import MapConfig
from jaxmap.stereo.match import StereoOptions

DEFAULT = ("sample:traverse", SHARED / "simdata" / "traverse_a", SHARED / "simdata" / "traverse_b")
BEFORE = StereoOptions(block_size=5, p1=200, p2=800, speckle_window=100, edge_step_px=0.0)
EDGES = StereoOptions(edge_step_px=0.0)
MATCHERS = {"before": BEFORE, "edges kept": EDGES, "now": StereoOptions(), "sgm": StereoOptions(matcher="sgm")}
"""`now` is the default, which drops edges of depth; `sgm` is jaxmap's own, in the step."""


def sources(traverse: Traverse, model: Path | None) -> dict[str, MapConfig]:
    """The settings of each source of labels."""
    ours = traverse.config("deeplab", model=model)
    blind, alone = DeeplabOptions(see_relief=False), ReliefOptions(combine=False)
    return {
        "MLESAC plane": traverse.config("plane"),
        "relief": replace(traverse.config("plane"), labeller="relief"),
        "network, image alone": replace(ours, deeplab=blind, relief=alone),
        "... and relief": replace(ours, deeplab=blind),
        "network sees relief": replace(ours, relief=alone),
        "... and relief (ours)": ours,
        "true labels": traverse.config("true"),
    }


def main() -> None:
    """Maps, scores, prints."""
    parser = command_line(__doc__)
    parser.add_argument("traverses", nargs="*", help="sample:traverse, or folders that hold a part and gt")
    parser.add_argument("--model", type=Path, help="a network other than the bundled one")
    parser.add_argument("--matchers", nargs="+", choices=list(MATCHERS), default=["now"])
    parser.add_argument("--labels", nargs="+", help="sources of labels, as the table names them; by default all")
    parser.add_argument("--stop", type=int, help="frame to stop before")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    scores = ("accuracy", "iou", "precision", "recall", "ece")
    columns = {"traverse": "<16", "matcher": "<12", "labels": "<24", **dict.fromkeys(scores, "10.3f")}
    table = Table({**columns, "mean IoU": "10.3f", "least": "7.3f", "greatest": "10.3f"})
    for path in given.traverses or [path for path in DEFAULT if str(path) == DEFAULT[0] or Path(path).exists()]:
        traverse = Traverse(path)
        for matcher in given.matchers:
            known = sources(traverse, given.model)
            if unknown := set(given.labels or ()) - known.keys():
                parser.error(f"--labels: {', '.join(sorted(unknown))} is none of {', '.join(known)}")
            for name in given.labels or known:
                frames = Frames(traverse.sequence, traverse.truth)
                result = frames.scored(replace(known[name], stereo=MATCHERS[matcher], stop=given.stop))
                ious = result.lattice_ious()
                numbers = [result.scores[one] or 0.0 for one in scores]
                table.row(traverse.name, matcher, name, *numbers, float(np.mean(ious)), min(ious), max(ious))
    table.write(given.json)


if __name__ == "__main__":
    main()
