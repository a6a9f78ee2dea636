"""Hostile files within the layouts of data sets: opening one ends soon, in bounded memory, well or with one line."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hostile import TEXT_CHANGES, Campaign
from rover_logs import DRIVES, drive, write_part
from test_datasets_euroc import made_recording
from test_datasets_kitti import made_sequence

from jaxmap.datasets import open_sequence


def katwijk(folder: Path) -> Path:
    write_part(folder / "Part1", drive(DRIVES["curves"], seed=8), images=3)
    return folder / "Part1"


LAYOUTS: dict[str, Callable[[Path], Path]] = {"euroc": made_recording, "kitti": made_sequence, "katwijk": katwijk}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("count", [pytest.param(8, id="quick"), pytest.param(80, id="all", marks=pytest.mark.slow)])
def test_hostile_layouts(layout, count, tmp_path):
    campaign, whole = Campaign(seed=count), tmp_path / "whole"
    whole.mkdir()
    sequence = LAYOUTS[layout](whole).relative_to(whole)
    texts = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.suffix in (".txt", ".csv", ".yaml"))
    for trial in range(count):
        copy = Path(shutil.copytree(whole, tmp_path / str(trial)))
        name, change = campaign.rng.choice(texts), campaign.rng.choice(TEXT_CHANGES)
        change(copy / name, campaign.rng)
        with campaign.trial(f"{layout} {trial}, {change.__name__} {name}"):
            open_sequence(copy / sequence)
        shutil.rmtree(copy)
    campaign.check()
