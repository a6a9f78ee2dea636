"""`jaxmap demo`: maps the bundled real stereo pair with every labeller and scores what comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from jaxmap.commands.console import Console, parse
from jaxmap.config import DepthConfig, GridConfig, MapConfig, load_config

SAMPLE = "sample:motorcycle"
TITLE = "The Motorcycle pair, mapped"
COLUMNS = {
    "labeller": "labeller",
    "preset": "preset",
    "voxel_size_m": "voxel, m",
    "median_error_px": "disparity error, px",
    "bad_2": "bad-2",
    "valid": "valid",
    "surface_precision": "surface precision",
    "surface_recall": "surface recall",
    "occupied": "occupied voxels",
    "off_plane": "off the plane",
    "step_ms": "step, ms",
}


@dataclass(frozen=True)
class DemoArguments:
    """Map the Motorcycle pair (Middlebury 2014, shipped with scikit-image) and score the maps.

    Each row of the table is a labeller under a preset, with a run folder of its own. Surfaces are
    scored against the map made of the pair's true disparity.
    """

    out: Path = Path("jaxmap_demo")
    """Folder to write; runs that lie in it are replaced."""


def demo_rows() -> dict[str, tuple[str, str, MapConfig]]:
    """The rows: run folder name, then labeller, preset and settings."""
    # The scene is an arm's length to five metres away, so the cells are finer than a rover's.
    default = MapConfig(
        grid=GridConfig(voxel_size_m=0.05, below_camera_m=1.5, above_camera_m=1.5), depth=DepthConfig(max_m=6.0)
    )
    paper = replace(load_config("chiodini2020"), depth=default.depth)
    paper = replace(paper, grid=replace(default.grid, voxel_size_m=paper.grid.voxel_size_m))
    return {
        "geometry": ("none", "default", replace(default, labeller="none")),
        "plane": ("plane", "default", replace(default, labeller="plane")),
        "plane_chiodini2020": ("plane", "chiodini2020", replace(paper, labeller="plane")),
    }


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(DemoArguments, "demo", words)

    from jaxmap.cache import keep_compiled_programs
    from jaxmap.evaluation.motorcycle import score_motorcycle
    from jaxmap.map_store import load_map
    from jaxmap.mapping import run_plan
    from jaxmap.mapping_plan import plan_run
    from jaxmap.output_folder import write_json
    from jaxmap.report.demo_page import write_demo_page
    from jaxmap.run_folder import RunFolder

    keep_compiled_programs()
    console = Console()
    table = []
    for name, (labeller, preset, config) in demo_rows().items():
        console.tell(f"--- {labeller}, {preset} ---")
        folder = RunFolder(arguments.out / name)
        plan = plan_run(SAMPLE, config, console.tell)
        with folder.locked():
            folder.begin(plan, config, resume=False, overwrite=True)
            metrics = run_plan(plan, folder, strict=True, checkpoint_every_s=60.0, tell=console.tell)
        voxel_map, _ = load_map(folder.map)
        scores = score_motorcycle(plan.sequence, plan.front_end, voxel_map, plan.depth_range_m)
        table.append({"run": name, "labeller": labeller, "preset": preset, **scores, **_figures(metrics)})
    write_json(arguments.out / "table.json", table)
    write_demo_page(arguments.out, TITLE, COLUMNS, table)
    console.table(TITLE, COLUMNS, table)
    console.result(arguments.out, ["report.html", "table.json", *(f"{row['run']}/" for row in table)])
    return 0


def _figures(metrics: dict) -> dict[str, float]:
    """What the table shows of a run's metrics."""
    return {
        "voxel_size_m": metrics["grid"]["voxel_size_m"][0],
        "occupied": metrics["voxels"]["occupied"],
        "free": metrics["voxels"]["free"],
        "off_plane": metrics["voxels"]["by_class"].get("rock", 0),
        "step_ms": metrics["times"]["stages"]["step"]["median_ms"],
        "match_ms": metrics["times"]["stages"]["match"]["median_ms"],
        "peak_resident_mib": metrics["memory"]["peak_resident_mib"],
    }
