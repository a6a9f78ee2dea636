"""`jaxmap evaluate`: scores a top-down map, and poses, against ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from annotated_types import Interval

from jaxmap.commands.console import Console, check_bounds, parse
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.host.output_folder import check_inputs_stay, write_json
from jaxmap.host.settings import NotNegative, Positive
from jaxmap.report.wording import MISSED_COLUMNS, SCORE_COLUMNS

if TYPE_CHECKING:
    from jaxmap.runs.folder import RunFolder

Diameter = Annotated[float, Interval(gt=0, le=1000)]


@dataclass(frozen=True)
class EvaluateArguments:
    """Score the top-down map of a run against ground truth, or its poses against true ones, or both.

    Cells count where the map observed a surface and the truth is labelled; the second row counts every labelled cell
    in the cameras' view, with unobserved ones as not rock. An ensemble (jaxmap map --ensemble.members) is scored by how
    well it predicts the missed cells among those not called rock. Writes scores.json and errors.png (true, false and
    missed rock in colours) into the run folder and its report, or --out and OUT_errors.png. Of poses: absolute and
    relative errors (ATE, RPE) as evo counts them, in pose_scores.json, or --out (OUT_poses.json beside scores).
    """

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it."""
    ground_truth: tyro.conf.Positional[tuple[Path, ...]] = ()
    """A labelled orthomosaic (GeoTIFF: 0 unlabelled, 1 sand, 2 rock), or text files of rocks (x y [diameter in m]),
    or a folder of those."""
    out: Path | None = None
    """JSON file to write; by default scores.json in the run folder."""
    target: Annotated[str, tyro.conf.arg(name="class")] = "rock"
    """The class that is scored."""
    scoring: Annotated[ScoringOptions, tyro.conf.arg(name="")] = field(default_factory=ScoringOptions)
    remap: tuple[str, ...] = ()
    """What the values of the orthomosaic mean: 0=unlabelled 7=rock '*=sand', or colours: '#b23c2e=rock'."""
    palette: Path | None = None
    """The same as a YAML file of CODE: CLASS."""
    truth_crs: str | None = None
    """Coordinate reference system of the ground truth, in place of its own."""
    rock_diameters_m: tuple[Diameter, Diameter, Diameter] = (0.3, 0.6, 1.0)
    """Diameters of small, medium and large rocks in lists that give none."""
    backdrop: Path | None = None
    """An RGB orthomosaic to draw the errors on."""
    poses: Path | None = None
    """True poses of the left camera (TUM, KITTI, EuRoC, CSV) to compare the run's with."""
    max_diff_s: Annotated[float, NotNegative] = 0.01
    """How far in time a pose and its true one may be apart."""
    way_m: Annotated[float, Positive] = 1.0
    """Length of the pieces of the path over which relative errors are taken, beside those from frame to frame."""


COLUMNS = {"over": "counted", **SCORE_COLUMNS}
RANKING_COLUMNS = {"by": "missed, by", **MISSED_COLUMNS}


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(EvaluateArguments, "evaluate", words)
    if not arguments.ground_truth and arguments.poses is None:
        fix = "name an orthomosaic or lists of rocks, or true poses with --poses"
        raise UsageError("no ground truth", where="the command line", fix=fix)
    if arguments.out is not None and arguments.out.suffix.lower() != ".json":
        raise UsageError(f"--out {arguments.out} is not a .json file", fix="name a JSON file")
    check_bounds(arguments, "evaluate")

    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.report.run_page import write_report
    from jaxmap.runs.folder import RunFolder

    keep_compiled_programs()
    console = Console()
    folder = RunFolder(arguments.run)
    folder.settle_for_reading()
    written = [*_score_map(arguments, folder, console), *_score_poses(arguments, folder, console)]
    if arguments.out is None and folder.metrics.is_file():
        # The scores go into the report; a run that is incomplete has none.
        try:
            written.append(write_report(arguments.run))
        except JaxmapError as error:
            console.notify(f"note: the report was not written again: {error}")
    console.result(written[0].parent, [path.name for path in written])
    return 0


def _score_map(arguments: EvaluateArguments, folder: RunFolder, console: Console) -> list[Path]:
    """Scores the map where there is truth for it, and returns what was written."""
    from jaxmap.datasets.label_raster import choose_coding
    from jaxmap.datasets.rock_list import SIZE_CLASSES
    from jaxmap.runs.evaluation import TruthOptions, evaluate_run, read_backdrop, summary, write_evaluation

    if not arguments.ground_truth:
        return []
    out, picture = folder.scores, folder.errors
    if arguments.out is not None:
        out, picture = arguments.out, arguments.out.with_name(f"{arguments.out.stem}_errors.png")
    read = (arguments.backdrop, arguments.palette, *arguments.ground_truth, folder.metrics, folder.poses)
    check_inputs_stay((out, picture), read)
    diameters_m: dict[str, float] = dict(zip(SIZE_CLASSES, arguments.rock_diameters_m, strict=True))
    coding = choose_coding(arguments.remap, arguments.palette)
    truth = TruthOptions(arguments.target, coding, arguments.truth_crs, diameters_m)
    evaluation, layer = evaluate_run(arguments.run, arguments.ground_truth, truth, arguments.scoring)
    scores = evaluation.scores
    backdrop = None if arguments.backdrop is None else read_backdrop(arguments.backdrop, evaluation, layer)
    write_evaluation(out, picture, evaluation, backdrop)
    for note in scores["notes"]:
        console.notify(f"note: {note}")
    _print_scores(console, scores, summary(scores))
    return [out, picture]


def _score_poses(arguments: EvaluateArguments, folder: RunFolder, console: Console) -> list[Path]:
    """Compares the poses where there are true ones, and returns what was written."""
    from jaxmap.report.wording import POSE_COLUMNS, pose_rows
    from jaxmap.runs.pose_evaluation import evaluate_poses

    if arguments.poses is None:
        return []
    out = folder.pose_scores
    if arguments.out is not None:
        out = arguments.out
        out = out.with_name(f"{out.stem}_poses.json") if arguments.ground_truth else out
    check_inputs_stay((out,), (arguments.poses, folder.metrics, folder.poses))
    scores = evaluate_poses(arguments.run, arguments.poses, arguments.max_diff_s, arguments.way_m)
    for note in scores["notes"]:
        console.notify(f"note: {note}")
    title = (
        f"{scores['poses']} of {scores['poses_of_run']} poses compared over {scores['path_length_m']:.1f} m; "
        f"scale {scores['scale']:.5f}"
    )
    rows = [{key: _shown(value) for key, value in row.items()} for row in pose_rows(scores)]
    console.table(title, {"error": "error", **POSE_COLUMNS}, rows)
    write_json(out, scores)
    return [out]


def _print_scores(console: Console, scores: dict, title: str) -> None:
    rows = [{"over": "observed cells", **scores}, {"over": "all cells in view", **scores["in_view"]}]
    if moved := scores.get("registration"):
        rows.append({"over": "observed, before registration", **moved["before"]})
        console.notify(
            f"registered: truth shifted {moved['shift_east_m']:+.3f} m east, {moved['shift_north_m']:+.3f} m north, "
            f"turned {moved['heading_deg']:+.2f} degrees"
        )
    console.table(title, COLUMNS, [{key: _shown(row[key]) for key in COLUMNS} for row in rows])
    if (ensemble := scores.get("ensemble")) is not None:
        _print_ensemble(console, ensemble, scores["class"])
    rocks = [
        {"rocks": f"{heading} {_span(row)} m", "count": row["count"], "missed": row["missed"]}
        for key, heading in (("by_diameter_m", "diameter"), ("by_range_m", "nearest camera at"))
        for row in scores["rocks"][key]
    ]
    if rocks:
        console.table("rocks in view", {"rocks": "rocks", "count": "true", "missed": "missed"}, rocks)


def _print_ensemble(console: Console, ensemble: dict, target: str) -> None:
    title = (
        f"of {ensemble['cells']:,} cells not called {target}, {ensemble['missed_cells']} are; "
        f"the ensemble expected {ensemble['expected_missed_cells']:.1f}"
    )
    rows = [{"by": "the ensemble", **ensemble}, {"by": "the map alone", **ensemble["map_alone"]}]
    console.table(title, RANKING_COLUMNS, [{key: _shown(row[key]) for key in RANKING_COLUMNS} for row in rows])


def _span(row: dict) -> str:
    return f"{row['from']:g} to {row['to']:g}" if row["to"] is not None else f"over {row['from']:g}"


def _shown(value: object) -> object:
    return "-" if value is None else value
