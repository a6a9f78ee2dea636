"""Compares our projective carving with OctoMap's ray casting: the same clouds, poses, hits and misses into both.

    python scripts/octomap_agreement.py SEQUENCE... [--config katwijk] [--voxel-size-m 0.2 0.1] [--out DIR]

Needs `octomap-python` (extra `bench`). Every frame counts once in a voxel, as in OctoMap; evidence is a plain sum in
both; voxels are cubes; what lies outside the mapped depths is left out of the clouds. Prints for each sequence and
voxel how the classes (unknown, free, occupied) stand against each other and what the differences come from, and writes
all into DIR: agreement.json and a picture of each comparison. Where the sequence is a simulated traverse (true poses
and heights in `gt` beside it), voxels are also held against the true ground, so that it is seen who is right.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from agreement.causes import CAUSES, Differences, agreement_of, explain
from agreement.heights import NO_TRUTH, TRUTH_NAMES, true_voxels
from agreement.maps import CLASS_NAMES, TwoMaps, map_both
from agreement.picture import draw_agreement

from jaxmap.errors import JaxmapError
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.output_folder import write_json
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.runs.config import MapConfig, load_config
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.types import Frame

LEAST_AGREEMENT = 0.97
"""Of the voxels that both maps observed."""


def main() -> int:
    """Prints and writes the comparisons; 1 where the maps agree on too few voxels, or cannot be made."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+", metavar="SEQUENCE", help="as for jaxmap map")
    parser.add_argument("--config", help="configuration of jaxmap map")
    parser.add_argument("--voxel-size-m", type=float, nargs="+", default=[0.2, 0.1])
    parser.add_argument("--frames", type=int, default=8, help="how many, spread over the sequence")
    parser.add_argument("--stop", type=int, help="frame to stop before, as for jaxmap map")
    parser.add_argument("--speckle-window", type=int, help="drop matches in islands of at most so many pixels")
    parser.add_argument("--out", type=Path, default=Path("octomap_agreement"))
    given = parser.parse_args()
    if importlib.util.find_spec("octomap") is None:
        print("error: there is no octomap: pip install octomap-python", file=sys.stderr)
        return 1
    keep_compiled_programs()
    given.out.mkdir(parents=True, exist_ok=True)
    try:
        rows = [compared(source, voxel_m, given) for source in given.sequences for voxel_m in given.voxel_size_m]
        write_json(given.out / "agreement.json", rows)
    except JaxmapError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"\nwrote {given.out}")
    return 0 if all(row["agreement_both"] >= LEAST_AGREEMENT for row in rows) else 1


def compared(source: str, voxel_size_m: float, given: argparse.Namespace) -> dict[str, Any]:
    """One comparison: printed, drawn, and as plain values."""
    plan = planned(source, voxel_size_m, given)
    maps = map_both(frames_of(plan, given.frames), plan.mapper, plan.params, plan.grid, plan.depth_range_m)
    found = explain(maps, plan.front_end.camera, plan.grid, plan.params.fusion, plan.depth_range_m)
    cleaned = "" if given.speckle_window is None else f", no islands up to {given.speckle_window} px"
    site, frames = site_of(source, plan), len(maps.frames)
    name = f"{site}, voxels of {voxel_size_m:g} m, {frames} frame{'s' if frames > 1 else ''}{cleaned}"
    row = as_row(maps, found, name)
    dem = truth_folder(source) / "dem.tif"
    if dem.is_file():
        truth = true_voxels(dem, plan.grid, plan.sequence.site_origin, plan.sequence.crs)
        row["against_truth"] = against_truth(maps, found, truth)
    print_row(row)
    picture = given.out / f"{site.replace(' ', '_')}_{voxel_size_m:g}m.png"
    draw_agreement(maps, found, plan.grid, f"Projective carving and OctoMap: {name}", picture)
    return row


def site_of(source: str, plan: Plan) -> str:
    """What a sequence is called: parts of traverses are told apart by the folder that they lie in."""
    folder, name = Path(source).resolve().parent.name, plan.sequence.name
    return f"{folder} {name}" if plan.sequence.dataset == "katwijk" and folder not in name else name


def planned(source: str, voxel_size_m: float, given: argparse.Namespace) -> Plan:
    """The run of `jaxmap map`, with the rule that OctoMap has."""
    config = load_config(given.config) if given.config else MapConfig()
    poses = truth_folder(source) / "poses_utm.tum"
    stereo = config.stereo
    if given.speckle_window is not None:
        stereo = replace(stereo, speckle_window=given.speckle_window)
    config = replace(
        config,
        labeller="none",
        stereo=stereo,
        stop=given.stop if given.stop is not None else config.stop,
        grid=replace(config.grid, voxel_size_m=voxel_size_m),
        fusion=replace(config.fusion, per_frame="once", carve=True, range_weighting=False),
        **({"poses": poses, "max_pose_gap_s": 10.0} if poses.is_file() else {}),
    )
    return plan_run(source, config, lambda line: None)


def truth_folder(source: str) -> Path:
    """Where a simulated traverse keeps what is true of it."""
    return Path(source).resolve().parent / "gt"


def frames_of(plan: Plan, count: int) -> Iterator[Frame]:
    """So many frames, at even distances over the sequence; those that cannot be used are left out."""
    every = len(plan.sequence.frames)
    chosen = sorted({round(index) for index in np.linspace(0, every - 1, min(count, every))})
    frames = tuple(plan.sequence.frames[index] for index in chosen)
    sequence = replace(plan.sequence, frames=frames, T_world_camera=plan.sequence.T_world_camera[chosen])
    return (ready.frame for ready in prepare_frames(sequence, plan.front_end) if ready.frame is not None)


def as_row(maps: TwoMaps, found: Differences, name: str) -> dict[str, Any]:
    """A comparison as plain values."""
    agreement = agreement_of(maps)
    return {
        "name": name,
        "confusion": {
            "rows": "ours",
            "columns": "OctoMap",
            "classes": CLASS_NAMES,
            "voxels": agreement.confusion.tolist(),
        },
        "agreement_both": agreement.both,
        "agreement_either": agreement.either,
        "causes_of_conflicts": found.counts(both=True),
        "causes_of_observed_by_one": found.counts(both=False),
    }


def against_truth(maps: TwoMaps, found: Differences, truth: np.ndarray) -> dict[str, Any]:
    """Counts of voxels above, at and below the true surface: of each map's classes, and of each cause."""

    def counts(which: np.ndarray) -> list[int]:
        return np.bincount(truth[which & (truth != NO_TRUTH)], minlength=len(TRUTH_NAMES)).tolist()

    def of_cause(both: bool, cause: int) -> np.ndarray:
        which = np.zeros(truth.shape, bool)
        which[tuple(found.voxels[(found.both == both) & (found.cause == cause)].T)] = True
        return which

    tables: dict[str, Any] = {"columns": TRUTH_NAMES}
    for name, classes in (("ours", maps.ours), ("OctoMap", maps.theirs)):
        tables[name] = {CLASS_NAMES[index]: counts(classes == index) for index in (1, 2)}
    for name, both in (("conflicts", True), ("observed by one", False)):
        tables[name] = {cause: counts(of_cause(both, index)) for index, cause in enumerate(CAUSES)}
    return tables


def print_row(row: dict[str, Any]) -> None:
    """A comparison in words and tables."""
    print(f"\n{row['name']}\n  {'ours / OctoMap':16s}" + "".join(f"{name:>12s}" for name in CLASS_NAMES))
    for name, counts in zip(CLASS_NAMES, row["confusion"]["voxels"], strict=True):
        print(f"  {name:16s}" + "".join(f"{count:12,d}" for count in counts))
    print(
        f"  one class: {row['agreement_both']:.2%} of the voxels that both observed, "
        f"{row['agreement_either']:.2%} of those that either did"
    )
    truth = row.get("against_truth", {})
    header = "".join(f"{name:>20s}" for name in TRUTH_NAMES) if truth else ""
    kinds = (("observed by both, otherwise", "causes_of_conflicts", "conflicts"),)
    kinds += (("observed by one", "causes_of_observed_by_one", "observed by one"),)
    for title, key, part in kinds:
        if any(row[key].values()):
            print(f"  {title:66s}{'voxels':>9s}{header}")
        for cause, count in sorted(row[key].items(), key=lambda item: -item[1]):
            if count:
                cells = "".join(f"{number:20,d}" for number in truth[part][cause]) if truth else ""
                print(f"    {CAUSES[cause]:64s}{count:9,d}{cells}")
    for name in ("ours", "OctoMap") if truth else ():
        for kind, counts in truth[name].items():
            print(f"  {name + ' ' + kind:66s}{sum(counts):9,d}" + "".join(f"{number:20,d}" for number in counts))
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
