"""What the experiments share: traverses, maps of prepared frames, scores, tables."""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.evaluation.cells import CellGrid, column_shares, make_cells, map_cells
from jaxmap.evaluation.evaluate import ClassLayer, evaluate_map
from jaxmap.evaluation.map_scores import Confusion, confusion_scores, count_confusion
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.evaluation.truth_cells import truth_cells
from jaxmap.fusion.options import FusionOptions
from jaxmap.geometry.options import DepthOptions, GridOptions
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.files import bundled
from jaxmap.mapping.sequence import PreparedFrame, run_sequence
from jaxmap.runs.config import MapConfig, load_config
from jaxmap.runs.evaluation import TruthOptions, class_layer_of, read_truth
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.types import VoxelMap

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared"
"""Recorded and simulated data, beside the repository."""

CELL_M, RANGE_M, TARGET, LATTICES = 0.2, 8.0, "rock", 4
"""Maps are scored in cells of 0.2 m within 8 m of the camera; on 4 x 4 lattices of cells, because a site of a few dozen
rock cells moves by several hundredths when its lattice shifts by a part of a cell."""

LABELS = {"true": "files", "deeplab": "deeplab", "plane": "plane"}
"""Sources of labels, and the labeller of each."""

POINTS = FusionOptions(per_frame="sum", carve=False, range_weighting=False, class_hit=1.0, class_miss=-1.0)
"""The majority of points over all frames."""
FRAMES = replace(POINTS, per_frame="mean", full_evidence_points=1.0)
"""Each frame has one vote, shared by its points."""
FINE, COARSE = GridOptions(voxel_size_m=(0.05, 0.05, 0.2)), GridOptions(voxel_size_m=0.2)


def parse(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The command line; from here on compiled programs are kept."""
    given = parser.parse_args()
    keep_compiled_programs()
    return given


def command_line(text: str | None) -> argparse.ArgumentParser:
    """A parser with the script's docstring as its help."""
    return argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)


class Traverse:
    """A traverse in the simulator's layout: `sample:traverse`, or a folder that holds `gt` and one part, as `Part1`."""

    def __init__(self, name: str | Path) -> None:
        self.folder = bundled("traverse") if str(name) == "sample:traverse" else Path(name)
        self.name = str(name) if str(name) == "sample:traverse" else self.folder.name
        part = next(iter(sorted(self.folder.glob("Part*"))), self.folder / "Part1")
        self.sequence = str(name) if str(name) == "sample:traverse" else str(part)
        self.gt = self.folder / "gt"
        self.truth = self.gt / "orthomosaic_labels.tif"

    def config(self, labels: str, *, true_poses: bool = False, model: Path | None = None) -> MapConfig:
        """The default settings with a source of labels, within 8 m."""
        return MapConfig(
            labeller=LABELS[labels],  # pyright: ignore[reportArgumentType]
            labels=self.gt / "labels" if labels == "true" else None,
            labels_are="raw" if labels == "true" else "auto",
            model=model if labels == "deeplab" else None,
            poses=self.gt / "poses_utm.tum" if true_poses else None,
            depth=DepthOptions(max_m=RANGE_M),
        )


class Frames:
    """A sequence whose frames are read, matched and labelled once, and mapped under several settings."""

    def __init__(self, sequence: str, truth: Path | None = None) -> None:
        self.sequence, self.truth = sequence, truth
        self.prepared: list[PreparedFrame] = []

    def plan(self, config: MapConfig) -> Plan:
        """The run of these settings; the first one prepares the frames."""
        plan = plan_run(self.sequence, config, lambda line: None)
        if not self.prepared:
            self.prepared = list(plan.prepare())
        return plan

    def scored(self, config: MapConfig, chosen: Sequence[PreparedFrame] | None = None) -> Scored:
        """The map of the frames under these settings, against the truth."""
        plan = self.plan(config)
        assert self.truth is not None
        return Scored(plan, fuse(plan, self.prepared if chosen is None else chosen), self.truth)


def fuse(plan: Plan, frames: Sequence[PreparedFrame]) -> VoxelMap:
    """The map of prepared frames."""
    # The step is compiled for each plan; the frames are the same.
    steps = run_sequence(plan.mapper, plan.mapper.init(), frames, plan.params, plan.key)
    return deque(steps, maxlen=1).pop()[0]


class Scored:
    """A map and the truth below it.

    Attributes:
        class_layer: the map as rock is scored in it.
        raster: the truth.
    """

    def __init__(self, plan: Plan, voxel_map: VoxelMap, truth: Path) -> None:
        where: dict[str, Any] = {"site_origin": plan.sequence.site_origin, "crs": plan.sequence.crs}
        self.class_layer: ClassLayer = class_layer_of(voxel_map, plan.params.fusion, plan.rule, TARGET, **where)
        self.raster: LabelRaster = read_truth([truth], self.class_layer.place, TruthOptions())

    @cached_property
    def scores(self) -> dict[str, Any]:
        """As `jaxmap evaluate` computes them."""
        return evaluate_map(self.class_layer, self.raster, None, ScoringOptions(cell_size_m=CELL_M)).scores

    @cached_property
    def lattices(self) -> list[dict[str, Any]]:
        """The scores of cells on lattices shifted by parts of a cell, the usual one first."""
        return [confusion_scores(one) for one in self.confusions()]

    def lattice_ious(self) -> list[float]:
        """The IoU on each lattice."""
        return [scores["iou"] or 0.0 for scores in self.lattices]

    def confusions(self, cell_size_m: float = CELL_M) -> list[Confusion]:
        """The confusion on each lattice."""
        class_map, found = self.class_layer, []
        usual = make_cells(class_map.grid, cell_size_m)
        for shift in np.ndindex(LATTICES, LATTICES):
            east_m, north_m = np.array(usual.origin_m) - np.array(shift) * cell_size_m / LATTICES
            shape = (usual.shape[0] + 1, usual.shape[1] + 1)
            cells = CellGrid((float(east_m), float(north_m)), usual.size_m, shape)
            shares = column_shares(class_map.grid, cells)
            mapped = map_cells(class_map.is_class, class_map.probability, class_map.observed, shares)
            truth = truth_cells(self.raster, cells, class_map.site_origin, class_map.crs)
            counted = np.asarray(mapped.observed) & truth.labelled
            found.append(count_confusion(mapped.called(), truth.truly(), counted))
        return found


def rules(base: MapConfig) -> dict[str, MapConfig]:
    """Both readings of the paper's rule, the majority of points in voxels of 0.2 m, and the default."""
    readings = {"paper": load_config("chiodini2020"), "hits only": load_config("chiodini2020_hits_only")}
    return {
        **{name: replace(base, grid=reading.grid, fusion=reading.fusion) for name, reading in readings.items()},
        "majority": replace(base, grid=COARSE, fusion=POINTS),
        "default": base,
    }


def jaxmap(*words: object) -> None:
    """Runs a command of jaxmap in a process of its own; stops where it fails."""
    if status := subprocess.run([sys.executable, "-m", "jaxmap", *map(str, words)]).returncode:
        raise SystemExit(status)


class Table:
    """Prints rows under a header, as they come.

    Args:
        columns: the format of each column by its name: `<14` for text of 14 letters, `8.3f` or `6d` for numbers.
    """

    def __init__(self, columns: Mapping[str, str]) -> None:
        self.columns, self.rows = columns, []
        self._print(list(columns))

    def row(self, *values: object, **more: object) -> None:
        """Prints a row, `None` as a dash; what is in `more` goes into the JSON only."""
        self.rows.append({**dict(zip(self.columns, values, strict=True)), **more})
        self._print(values)

    def _print(self, values: Sequence[object]) -> None:
        line = ""
        for form, value in zip(self.columns.values(), values, strict=True):
            width = re.match(r"<?\d+", form)
            assert width is not None
            if isinstance(value, int | float):
                line += format(value, form)
            else:
                line += format("-" if value is None else str(value), width[0] if "<" in form else f">{width[0]}")
        print(line.rstrip(), flush=True)

    def write(self, path: Path | None) -> None:
        """Writes the rows as JSON, where a path is given."""
        if path is not None:
            path.write_text(json.dumps(self.rows, indent=1, default=str) + "\n")
