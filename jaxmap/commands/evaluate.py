"""`jaxmap evaluate`: scores a top-down map against ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Interval

from jaxmap.commands.console import Console, check_bounds, parse
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.host.output_folder import check_inputs_stay
from jaxmap.report.wording import MISSED_COLUMNS, SCORE_COLUMNS

Diameter = Annotated[float, Interval(gt=0, le=1000)]


@dataclass(frozen=True)
class EvaluateArguments:
    """Score the top-down map of a run against ground truth.

    Cells count where the map observed a surface and the truth is labelled; the second row counts every labelled cell
    in the cameras' view, with unobserved ones as not rock. An ensemble (jaxmap map --ensemble.members) is scored by how
    well it predicts the missed cells among those not called rock. Writes scores.json and errors.png (true, false and
    missed rock in colours) into the run folder and its report, or --out and OUT_errors.png.
    """

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it."""
    ground_truth: tyro.conf.Positional[tuple[Path, ...]]
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


COLUMNS = {"over": "counted", **SCORE_COLUMNS}
RANKING_COLUMNS = {"by": "missed, by", **MISSED_COLUMNS}


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(EvaluateArguments, "evaluate", words)
    if not arguments.ground_truth:
        raise UsageError("no ground truth", where="the command line", fix="name an orthomosaic or lists of rocks")
    if arguments.out is not None and arguments.out.suffix.lower() != ".json":
        raise UsageError(f"--out {arguments.out} is not a .json file", fix="name a JSON file")
    check_bounds(arguments, "evaluate")

    from jaxmap.datasets.label_raster import choose_coding
    from jaxmap.datasets.rock_list import SIZE_CLASSES
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.report.run_page import write_report
    from jaxmap.runs.evaluation import TruthOptions, evaluate_run, read_backdrop, summary, write_evaluation
    from jaxmap.runs.folder import RunFolder

    keep_compiled_programs()
    console = Console()
    folder = RunFolder(arguments.run)
    folder.settle_for_reading()
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
    names = [out.name, picture.name]
    if arguments.out is None and folder.metrics.is_file():
        # The scores go into the report; a run that is incomplete has none.
        try:
            names.append(write_report(arguments.run).name)
        except JaxmapError as error:
            console.notify(f"note: the report was not written again: {error}")
    console.result(out.parent, names)
    return 0


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
