"""`jaxmap plan`: the cheapest path over a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from jaxmap.commands.console import Console, Coordinate, check_bounds, parse


@dataclass(frozen=True)
class PlanArguments:
    """Plan a path over the map of a run, from its hazards, its rocks and what it has not seen.

    Writes plan.png (the path over what driving costs), plan.geojson and plan.csv (the path in the map's coordinates),
    plan.tif (costs and hazards) and plan.json (length, cost, greatest slope, least clearance, share of unknown ground)
    into the run folder, or --out.
    """

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it."""
    start: tuple[Coordinate, Coordinate]
    """East and north of the start, in the coordinates of the map (bev.tif)."""
    goal: tuple[Coordinate, Coordinate]
    """East and north of the goal."""
    rover: str = "katwijk"
    """YAML file of the rover's size, limits and costs, or the name of one in configs/rovers (katwijk)."""
    out: Path | None = None
    """Folder to write; by default the run folder."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(PlanArguments, "plan", words)
    check_bounds(arguments, "plan")

    import numpy as np

    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.planning.options import ROVER_SETTINGS
    from jaxmap.runs.folder import RunFolder
    from jaxmap.runs.planning import PLAN_FILES, plan_path, read_costs, write_plan

    keep_compiled_programs()
    console, out = Console(), arguments.out or arguments.run
    rover = ROVER_SETTINGS.load(arguments.rover)
    RunFolder(arguments.run).settle_for_reading()
    costs = read_costs(arguments.run, rover)
    if costs.site.rock is None:
        console.notify("note: the map has no class of rocks: the path keeps clear of hazards by height alone")
    if not costs.site.fine:
        console.notify("note: the map has no surface heights, only voxels: hazards are coarse; map again to have them")
    plan = plan_path(costs, np.array(arguments.start), np.array(arguments.goal))
    write_plan(costs, plan, out)
    console.notify(_summary(plan.metrics))
    console.result(out, PLAN_FILES)
    return 0


def _summary(metrics: dict) -> str:
    slope, clearance = metrics["greatest_slope_deg"], metrics["least_clearance_m"]
    parts = [
        f"{metrics['length_m']:.2f} m ({metrics['straight_m']:.2f} m straight), cost {metrics['cost']:.1f} m",
        "" if slope is None else f"slope up to {slope:.0f} degrees",
        "" if clearance is None else f"{clearance:.2f} m clear of rock and hazards",
        f"{metrics['unknown_share']:.0%} of the ground not seen",
    ]
    return ", ".join(part for part in parts if part)
