"""Every number that a user can give has a least and a greatest value, so that no typing error runs for a week."""

from __future__ import annotations

import dataclasses
import importlib
import math
import types
import typing
from collections.abc import Iterator
from typing import Annotated, Any

import annotated_types
import pytest

from jaxmap.commands import COMMANDS
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.runs.config import check_config
from jaxmap.runs.training_plan import TRAIN_SETTINGS
from jaxmap.types import make_stereo_camera


def has_bounds(metadata: tuple[Any, ...]) -> bool:
    """Whether both ends are given, and finite."""
    ends: dict[str, float] = {}
    for entry in metadata:
        for part in entry if isinstance(entry, annotated_types.GroupedMetadata) else [entry]:
            ends |= {end[0]: getattr(part, end) for end in ("ge", "gt", "le", "lt") if hasattr(part, end)}
    return ends.keys() == {"g", "l"} and all(map(math.isfinite, ends.values()))


def unbounded(kind: Any, name: str, metadata: tuple[Any, ...] = ()) -> Iterator[str]:
    """Names of the numbers within a type that lack a bound."""
    if typing.get_origin(kind) is Annotated:
        inner, *more = typing.get_args(kind)
        yield from unbounded(inner, name, (*metadata, *more))
    elif kind in (int, float):
        if not has_bounds(metadata):
            yield name
    elif dataclasses.is_dataclass(kind) or (isinstance(kind, type) and hasattr(kind, "_fields")):
        for field, inner in typing.get_type_hints(kind, include_extras=True).items():
            if not field.startswith("_"):
                yield from unbounded(inner, f"{name}.{field}")
    elif typing.get_origin(kind) in (typing.Union, types.UnionType, tuple, dict, list):
        for inner in typing.get_args(kind):
            yield from unbounded(inner, name, metadata)


def arguments_of(command: str) -> list[Any]:
    module = importlib.import_module(f"jaxmap.commands.{command}")
    return [
        kind for name, kind in vars(module).items() if name.endswith("Arguments") and dataclasses.is_dataclass(kind)
    ]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_number_of_a_command_has_two_bounds(command):
    kinds = arguments_of(command)
    assert kinds or command == "info"
    assert not [name for kind in kinds for name in unbounded(kind, kind.__name__)]


def test_a_number_without_a_bound_is_found():
    hints: dict[str, Any] = {
        "free": Annotated[float, annotated_types.Ge(0)],
        "bound": Annotated[int, annotated_types.Interval(ge=0, lt=3)],
    }
    assert [list(unbounded(kind, name)) for name, kind in hints.items()] == [["free"], []]


ABSURD = [
    "grid.voxel_size_m=1e300",
    "grid.voxel_size_m=1e-300",
    "grid.max_memory_gib=1e-300",
    "stereo.min_disparity_px=9999999999",
    "stereo.block_size=99999999999",
    "stereo.speckle_window=99999999999",
    "stereo.num_disparities=100000000",
    "plane.em_rounds=1000000000",
    "plane.sample_points=100000000",
    "ensemble.members=1000000000",
    "fusion.class_hit=1e300",
    "depth.max_m=1e300",
    "relief.smooth_m=1e5",
    "relief.rock_m=19",
    "seed=99999999999999999999999999999",
]


@pytest.mark.parametrize("setting", ABSURD)
def test_absurd_settings_of_a_map_are_refused(setting):
    key, _, text = setting.partition("=")
    *groups, name = key.split(".")
    tree: Any = {name: float(text) if "e" in text else int(text)}
    for group in reversed(groups):
        tree = {group: tree}
    with pytest.raises(UsageError, match=name):
        check_config(tree)


def test_absurd_settings_of_training_are_refused():
    with pytest.raises(UsageError, match=r"epochs.*batch_size.*scale"):
        TRAIN_SETTINGS.check({"epochs": 10**30, "batch_size": 10**9, "augmentation": {"scale": [1, 1e9]}})


@pytest.mark.parametrize(
    "number", [{"cy_px": 1e38}, {"doffs_px": 3.5e38}, {"baseline_m": 1e300}, {"fx_px": 1e-300}, {"baseline_m": 1e-40}]
)
def test_no_camera_is_like_that(number):
    camera: Any = dict(fx_px=500.0, cx_px=320.0, cy_px=240.0, baseline_m=0.1, width_px=640, height_px=480)
    with pytest.raises(JaxmapError, match=f"{next(iter(number))} is .* in camera.yaml"):
        make_stereo_camera(**camera | number, where="camera.yaml")
