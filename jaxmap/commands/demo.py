"""`jaxmap demo`: the paper's table on the bundled traverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxmap.commands.console import Console, parse
from jaxmap.geometry.options import DepthOptions, GridOptions
from jaxmap.runs.config import MapConfig, load_config

if TYPE_CHECKING:
    from jaxmap.report.demo_page import ScoredRun

SAMPLE = "sample:traverse"
TITLE = "A simulated traverse, mapped and scored"
MAX_RANGE_M, VOXEL_M = 8.0, 0.05
COLUMNS = {
    "map": "map",
    "accuracy": "accuracy",
    "iou": "IoU",
    "precision": "precision",
    "recall": "recall",
    "found": "rocks found",
}
SIZES_M = {"under 0.2 m": (0.0, 0.2), "0.2 to 0.5 m": (0.2, 0.5), "over 0.5 m": (0.5, None)}
"""Classes of rocks by diameter, on edges of `evaluation.evaluate.SIZE_EDGES_M`."""


@dataclass(frozen=True)
class DemoArguments:
    """Map the bundled traverse four times, and print the paper's table.

    The rows are the paper's two labellers (an MLESAC plane and DeepLabv3+) under its preset, and relief without and
    with DeepLabv3+ under the default, in cubes of 0.05 m. Each has a run folder of its own, and is scored against the
    traverse's labelled orthomosaic in cells of 0.2 m, within 8 m of the camera.
    """

    out: Path = Path("jaxmap_demo")
    """Folder to write; runs that lie in it are replaced."""


def demo_rows() -> dict[str, tuple[str, MapConfig]]:
    """The rows: run folder name, then the name of the map and its settings."""
    # In cubes, the shapes of rocks are seen in 3D.
    paper, ours = load_config("chiodini2020"), MapConfig(grid=GridOptions(voxel_size_m=VOXEL_M))
    rows = {
        "plane_chiodini2020": ("MLESAC plane (paper)", replace(paper, labeller="plane")),
        "deeplab_chiodini2020": ("DeepLabv3+ (paper)", replace(paper, labeller="deeplab")),
        "relief": ("relief", replace(ours, labeller="relief")),
        "relief_deeplab": ("relief + DeepLabv3+", replace(ours, labeller="deeplab")),
    }
    return {run: (name, replace(config, depth=DepthOptions(max_m=MAX_RANGE_M))) for run, (name, config) in rows.items()}


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(DemoArguments, "demo", words)

    from jaxmap.datasets.samples import sample_truth
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.host.output_folder import write_json
    from jaxmap.report.demo_page import write_demo_page
    from jaxmap.runs.evaluation import summary

    keep_compiled_programs()
    console, truth = Console(), sample_truth()
    runs = []
    for run, (name, config) in demo_rows().items():
        console.notify(f"--- {name} ---")
        runs.append(_map_and_score(arguments.out / run, name, config, truth, console))
    table = [dict(run.row) for run in runs]
    sizes = {heading: heading for heading in SIZES_M if any(row[heading] for row in table)}
    columns = COLUMNS | sizes | {"frames_per_s": "frames/s"}
    write_json(arguments.out / "table.json", table)
    write_demo_page(arguments.out, TITLE, columns, runs)
    console.table(TITLE, columns, table)
    console.notify(summary(table[-1]))
    console.result(arguments.out, ["report.html", "table.json", *(f"{row['run']}/" for row in table)])
    return 0


def _map_and_score(out: Path, name: str, config: MapConfig, truth: Path, console: Console) -> ScoredRun:
    """One row: a run and its scores, written into the run folder."""
    from jaxmap.evaluation.options import ScoringOptions
    from jaxmap.report.demo_page import ScoredRun
    from jaxmap.report.run_page import write_report
    from jaxmap.runs.evaluation import TruthOptions, evaluate_run, read_backdrop, write_evaluation
    from jaxmap.runs.folder import RunFolder
    from jaxmap.runs.mapping import run_plan
    from jaxmap.runs.mapping_plan import plan_run

    folder = RunFolder(out)
    plan = plan_run(SAMPLE, config, console.notify)
    with folder.locked(), folder.writing(plan.settings(config), resume=False, overwrite=True) as work:
        metrics = run_plan(plan, work, strict=True, checkpoint_every_s=60.0, notify=console.notify, report=False)
        evaluation, layer = evaluate_run(
            work.path, [truth / "orthomosaic_labels.tif"], TruthOptions(), ScoringOptions()
        )
        evaluation.scores["run"] = str(out)
        backdrop = read_backdrop(truth / "orthomosaic.tif", evaluation, layer)
        write_evaluation(work.scores, work.errors, evaluation, backdrop)
        write_report(work.path)
    row = {**evaluation.scores, **found_rocks(evaluation.scores["rocks"]), **_figures(metrics)}
    return ScoredRun({**row, "run": out.name, "map": name}, evaluation, backdrop)


def found_rocks(rocks: dict[str, Any]) -> dict[str, str | None]:
    """How many of the rocks in view were found, in all (`found`) and by size; None where there are none."""

    def share(rows: Sequence[dict[str, int]]) -> str | None:
        count, missed = (sum(row[key] for row in rows) for key in ("count", "missed"))
        return f"{count - missed} of {count}" if count else None

    found = {"found": share([rocks])}
    for heading, (low, high) in SIZES_M.items():
        here = [row for row in rocks["by_diameter_m"] if row["from"] >= low and (high is None or row["from"] < high)]
        found[heading] = share(here)
    return found


def _figures(metrics: dict) -> dict[str, float]:
    """What the table shows of a run's metrics."""
    return {
        "voxel_size_m": metrics["grid"]["voxel_size_m"],
        "frames_per_s": metrics["times"]["frames_per_s"],
        "step_ms": metrics["times"]["stages"]["step"]["median_ms"],
        "match_ms": metrics["times"]["stages"]["match"]["median_ms"],
        "peak_resident_mib": metrics["memory"]["peak_resident_mib"],
    }
