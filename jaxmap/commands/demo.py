"""`jaxmap demo`: the paper's table on the bundled traverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from jaxmap.commands.console import Console, parse
from jaxmap.geometry.options import DepthOptions
from jaxmap.runs.config import MapConfig, load_config

SAMPLE = "sample:traverse"
TITLE = "A simulated traverse, mapped and scored"
MAX_RANGE_M = 8.0
COLUMNS = {
    "labeller": "labeller",
    "preset": "preset",
    "accuracy": "accuracy",
    "iou": "IoU",
    "precision": "precision",
    "recall": "recall",
    "coverage": "coverage",
    "frames_per_s": "frames/s",
    "step_ms": "step, ms",
}


@dataclass(frozen=True)
class DemoArguments:
    """Map the bundled traverse with the DeepLabv3+ and the MLESAC labeller, and print the paper's table.

    Each row of the table is a labeller under a preset, with a run folder of its own, scored against the traverse's
    labelled orthomosaic in cells of 0.2 m, within 8 m of the camera.
    """

    out: Path = Path("jaxmap_demo")
    """Folder to write; runs that lie in it are replaced."""


def demo_rows() -> dict[str, tuple[str, str, MapConfig]]:
    """The rows: run folder name, then labeller, preset and settings."""
    rows = {}
    for labeller in ("plane", "deeplab"):
        for preset in ("chiodini2020", "default"):
            config = MapConfig() if preset == "default" else load_config(preset)
            config = replace(config, labeller=labeller, depth=DepthOptions(max_m=MAX_RANGE_M))
            rows[f"{labeller}_{preset}"] = (labeller, preset, config)
    return rows


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(DemoArguments, "demo", words)

    from jaxmap.datasets.samples import sample_truth
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.host.output_folder import write_json
    from jaxmap.report.demo_page import write_demo_page
    from jaxmap.runs.evaluation import summary

    keep_compiled_programs()
    console = Console()
    truth = sample_truth()
    table = []
    for name, (labeller, preset, config) in demo_rows().items():
        console.notify(f"--- {labeller}, {preset} ---")
        metrics, scores = _map_and_score(arguments.out / name, config, truth, console)
        table.append({**scores, **_figures(metrics), "run": name, "labeller": labeller, "preset": preset})
    write_json(arguments.out / "table.json", table)
    write_demo_page(arguments.out, TITLE, COLUMNS, table, truth)
    console.table(TITLE, COLUMNS, table)
    console.notify(summary(table[-1]))
    console.result(arguments.out, ["report.html", "table.json", *(f"{row['run']}/" for row in table)])
    return 0


def _map_and_score(out: Path, config: MapConfig, truth: Path, console: Console) -> tuple[dict, dict]:
    """One row: a run and its scores, written into the run folder."""
    from jaxmap.evaluation.options import ScoringOptions
    from jaxmap.report.run_page import write_report
    from jaxmap.runs.evaluation import TruthOptions, evaluate_run, write_evaluation
    from jaxmap.runs.folder import RunFolder
    from jaxmap.runs.mapping import run_plan
    from jaxmap.runs.mapping_plan import plan_run

    folder = RunFolder(out)
    plan = plan_run(SAMPLE, config, console.notify)
    with folder.locked():
        folder.begin(plan.settings(config), resume=False, overwrite=True)
        metrics = run_plan(plan, folder, strict=True, checkpoint_every_s=60.0, notify=console.notify)
    evaluation, layer = evaluate_run(out, [truth / "orthomosaic_labels.tif"], TruthOptions(), ScoringOptions())
    write_evaluation(folder.scores, folder.errors, evaluation, layer, truth / "orthomosaic.tif")
    write_report(out)
    return metrics, evaluation.scores


def _figures(metrics: dict) -> dict[str, float]:
    """What the table shows of a run's metrics."""
    return {
        "voxel_size_m": metrics["grid"]["voxel_size_m"],
        "frames_per_s": metrics["times"]["frames_per_s"],
        "step_ms": metrics["times"]["stages"]["step"]["median_ms"],
        "match_ms": metrics["times"]["stages"]["match"]["median_ms"],
        "peak_resident_mib": metrics["memory"]["peak_resident_mib"],
    }
