"""Heights of maps against the true ground of simulated worlds, and hazards against those of true heights.

    python scripts/experiments/hazards.py [FOLDER ...] [--true-poses]

FOLDER is a traverse in the simulator's layout, such as `jaxmap simulate` writes; by default the two of
`shared/simdata`. Prints for each what is within 5 cm of the truth (the Lunar Autonomy Challenge asks for that), root
mean square, bias, and coverage: the share of the columns with a surface in them that have a height. Rows are the
middle of the highest voxel; heights whose sigma is below 5 cm, as `map` writes them (surface_m); and those filled from
0.1 m around, from which hazards are measured. Then the median error of each hazard over all of the rover's discs, and
in how many of them steps bar the rover as they truly do, or do not.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from common import SHARED, Frames, Table, Traverse, command_line, fuse, parse
from planning import read_truth

from jaxmap.fusion.query import top_down
from jaxmap.fusion.surface import read_surface
from jaxmap.planning.ground import cell_size, hazards_of
from jaxmap.planning.options import RoverOptions
from jaxmap.runs.config import MapConfig

CLOSE_M = 0.05


def main() -> None:
    """Prints the tables."""
    parser = command_line(__doc__)
    parser.add_argument("folders", type=Path, nargs="*", default=[SHARED / "simdata" / f"traverse_{n}" for n in "ab"])
    parser.add_argument("--true-poses", action="store_true")
    parser.add_argument("--json", type=Path)
    given, rover = parse(parser), RoverOptions()
    columns = {"world": "<14", "heights": "<10", "within 5 cm": "13.1%", "rms, m": "8.3f", "bias, m": "9.3f"}
    heights = Table({**columns, "coverage": "10.1%"})
    errors = []
    for folder in given.folders:
        world = Traverse(folder)
        frames = Frames(world.sequence)
        poses = world.gt / "poses_utm.tum" if given.true_poses else None
        plan = frames.plan(MapConfig(labeller="relief", poses=poses))
        voxel_map, params = fuse(plan, frames.prepared), plan.params.fusion
        truth = read_truth(world.gt, voxel_map.grid, plan).ground
        seen = np.asarray(top_down(voxel_map, params, plan.rule).observed)
        surfaces = {
            "voxels": read_surface(replace(voxel_map, surface=None), params),
            "surface_m": read_surface(voxel_map, params),
            "filled": read_surface(voxel_map, params, reach=round(0.1 / min(cell_size(voxel_map.grid)))),
        }
        for name, surface in surfaces.items():
            counted = np.asarray(surface.known) & truth.seen
            error_m = (np.asarray(surface.height_m) - truth.surface.height_m)[counted]
            rms_m, bias_m = float(np.sqrt(np.mean(error_m**2))), float(error_m.mean())
            covered = counted.sum() / (seen & truth.seen).sum()
            heights.row(folder.name, name, float(np.mean(np.abs(error_m) < CLOSE_M)), rms_m, bias_m, float(covered))
        cell_m = cell_size(voxel_map.grid)
        measured, true = (
            jax.tree.map(np.asarray, hazards_of(surface, cell_m, rover))
            for surface in (surfaces["filled"], truth.surface)
        )
        found = {name: np.abs(getattr(measured, name) - getattr(true, name)) for name in measured._fields[:3]}
        barred = [one.step_m > rover.max_step_m for one in (measured, true)]
        both = np.isfinite(measured.step_m) & np.isfinite(true.step_m)
        agree = float((barred[0] == barred[1])[both].mean())
        errors.append((folder.name, *(float(np.nanmedian(value)) for value in found.values()), agree))
    print()
    hazards = Table(
        {"world": "<14", "step, m": "9.3f", "slope, deg": "12.2f", "roughness, m": "14.3f", "same bar": "10.1%"}
    )
    for row in errors:
        hazards.row(*row)
    heights.rows += hazards.rows
    heights.write(given.json)


if __name__ == "__main__":
    main()
