"""Configurations: files, round trips, defaults that agree with the functions they are for, strictness."""

from __future__ import annotations

import inspect
import re
from dataclasses import MISSING, fields, is_dataclass, replace

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.errors import UsageError
from jaxmap.fusion.options import FusionOptions, FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.geometry.options import DepthOptions, GridOptions
from jaxmap.host.files import config_folder
from jaxmap.labellers.options import DeeplabOptions, PlaneOptions
from jaxmap.labels import ROVER_CLASSES
from jaxmap.runs.config import MapConfig, check_config, config_tree, load_config
from jaxmap.stereo.match import StereoOptions

CONFIGS = sorted(config_folder().glob("*.yaml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_loads_and_is_read_to_the_last_key(path):
    config = load_config(str(path))
    assert config == load_config(path.stem) == load_config(path.name)
    tree = yaml.safe_load(path.read_text())

    def check(part: dict, whole: dict) -> None:
        for key, value in part.items():
            if isinstance(value, dict):
                check(value, whole[key])
            else:
                assert whole[key] == value, key

    check(tree, config_tree(config))
    assert path.read_text().startswith("#"), "says what it is"


@pytest.mark.parametrize(
    ("name", "reading"),
    [("chiodini2020", ("majority", "sum", -0.9)), ("chiodini2020_hits_only", ("once", "max", 0.0))],
)
def test_there_is_a_config_for_each_reading_of_the_paper(name, reading):
    fusion = load_config(name).fusion
    assert load_config(name).grid.voxel_size_m == 0.2
    assert (fusion.per_frame, fusion.column, fusion.class_miss) == reading
    assert (fusion.carve, fusion.range_weighting) == (False, False)
    assert (fusion.occupancy_hit, fusion.class_hit, fusion.occupancy_miss) == (0.9, 0.9, 0.0)
    assert (fusion.class_prior, fusion.class_threshold) == (0.5, 0.7)


def test_the_preset_for_sand_doubles_the_penalties():
    stereo = load_config("sand").stereo
    area = stereo.block_size**2
    assert stereo.mode == "hh" and stereo.penalties() == (16 * area, 64 * area)


configs = st.builds(
    MapConfig,
    labeller=st.sampled_from(["plane", "none"]),
    classes=st.lists(st.sampled_from(["background", "sand", "rock", "grass"]), unique=True).map(tuple),
    start=st.integers(-5, 5),
    stop=st.none() | st.integers(-5, 50),
    stride=st.integers(1, 9),
    strict=st.booleans(),
    seed=st.integers(0, 2**31 - 1),
    grid=st.builds(
        GridOptions,
        voxel_size_m=st.floats(0.01, 2) | st.tuples(*[st.floats(0.01, 2)] * 3),
        lower_m=st.none() | st.tuples(*[st.floats(-1e6, 1e6)] * 3),
        max_memory_gib=st.floats(0.1, 64),
    ),
    stereo=st.builds(
        StereoOptions, alpha=st.floats(-1, 1), num_disparities=st.none() | st.integers(1, 32).map(lambda n: 16 * n)
    ),
    fusion=st.builds(
        FusionOptions,
        per_frame=st.sampled_from(["sum", "once", "majority", "mean"]),
        class_increments=st.none() | st.just(((1.0, -0.5), (-0.25, 0.5))),
        class_prior=st.floats(0.01, 0.99) | st.tuples(st.floats(0.01, 0.99), st.floats(0.01, 0.99)),
    ),
)


@given(configs)
def test_a_config_comes_back_from_its_tree_and_from_yaml(config):
    tree = config_tree(config)
    assert check_config(tree) == config
    assert check_config(yaml.safe_load(yaml.safe_dump(tree))) == config
    assert config_tree(check_config(tree)) == tree


def test_every_setting_has_a_default_and_says_what_it_is():
    sections = ("grid", "depth", "stereo", "fusion", "plane", "relief", "deeplab", "ensemble", "bag")
    kinds = (GridOptions, DepthOptions, FusionOptions, PlaneOptions, DeeplabOptions, StereoOptions, EnsembleOptions)
    for kind in (MapConfig, *kinds):
        source = "".join(inspect.getsource(one) for one in kind.__mro__ if is_dataclass(one))
        for field in fields(kind):
            assert field.default is not MISSING or field.default_factory is not MISSING, field.name
            assert field.name in sections or f"    {field.name}: " in source
        described = len(re.findall(r'^    \w+: .*\n    """\S', source, re.MULTILINE))
        told_apart = sum(field.name in sections for field in fields(kind))
        assert described == len(fields(kind)) - told_apart, kind.__name__


@pytest.mark.parametrize(
    ("tree", "named"),
    [
        ({"gird": {}, "grid": {"size": 1}, "fusion": {"carved": True}}, ["gird", "grid.size", "fusion.carved"]),
        ({"grid": {"voxel_size_m": 0}}, ["grid.voxel_size_m is 0"]),
        ({"grid": {"voxel_size_m": [0.1, 0.1]}}, ["grid.voxel_size_m"]),
        ({"grid": {"voxel_size_m": [0.1, -0.1, 0.1]}}, ["grid.voxel_size_m.1 is -0.1"]),
        ({"grid": {"lower_m": [0, 0]}}, ["grid.lower_m"]),
        ({"depth": {"min_m": -1, "max_m": 0}}, ["depth.min_m is -1", "depth.max_m is 0"]),
        ({"depth": {"max_m": float("inf")}}, ["depth.max_m is inf"]),
        ({"fusion": {"occupancy_miss": 0.1}}, ["fusion.occupancy_miss is 0.1"]),
        ({"fusion": {"class_prior": [0.5, 1.0]}}, ["fusion.class_prior.1 is 1.0"]),
        ({"fusion": {"class_hit": float("nan")}}, ["fusion.class_hit is nan"]),
        ({"fusion": {"per_frame": "twice"}}, ["fusion.per_frame is 'twice'"]),
        ({"plane": {"hypotheses": 0, "cost": "ransac"}}, ["plane.hypotheses is 0", "plane.cost is 'ransac'"]),
        ({"stereo": {"alpha": float("nan")}}, ["stereo.alpha is nan"]),
        ({"stereo": {"mode": "bm", "block_size": 0}}, ["stereo.mode is 'bm'", "stereo.block_size is 0"]),
        ({"stride": 0, "seed": -1}, ["stride is 0", "seed is -1"]),
        ({"seed": 2**31}, ["seed is 2147483648"]),
        ({"labeller": "oracle"}, ["labeller is 'oracle'"]),
        ({"classes": "rock"}, ["classes is 'rock'"]),
        ({"deeplab": {"size_px": [0, 8], "temperature": 0}}, ["deeplab.size_px.0 is 0", "deeplab.temperature is 0"]),
        ({"deeplab": {"class_map": {"bus": 3}, "softly": True}}, ["deeplab.class_map.bus", "deeplab.softly"]),
        ({"grid": None}, ["grid is None"]),
    ],
)
def test_every_fault_is_named_by_its_key(tree, named):
    with pytest.raises(UsageError) as caught:
        check_config(tree, where="mine.yaml")
    assert all(part in str(caught.value) for part in named), str(caught.value)
    assert "mine.yaml" in str(caught.value)


def test_options_check_themselves_however_they_are_made():
    with pytest.raises(UsageError, match=r"fusion.occupancy_miss is 0\.5: .* less than or equal to 0"):
        FusionOptions(occupancy_miss=0.5)
    with pytest.raises(UsageError, match=r"fusion.class_prior.1 is 1\.0"):
        replace(FusionOptions(), class_prior=(0.5, 1.0))
    with pytest.raises(UsageError, match="unknown key plane.hypothesis_count"):
        PlaneOptions(hypothesis_count=3)
    with pytest.raises(UsageError, match="oak is not one of the classes sand rock in fusion.priority_classes"):
        FusionOptions(priority_classes=("oak",)).rule(("sand", "rock"))
    assert FusionOptions().rule(("sand", "gravel")).priority_classes == ()
    chosen = {"priority_classes": ("rock",), "left_out_classes": ("background",)}
    assert FusionOptions(per_frame="sum").rule(ROVER_CLASSES) == FusionRule("sum", **chosen)


def test_a_file_may_hold_nothing(tmp_path):
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    assert load_config(str(tmp_path / "empty.yaml")) == MapConfig()


def test_yaml_runs_no_code(tmp_path):
    (tmp_path / "evil.yaml").write_text("!!python/object/apply:os.mkdir ['" + str(tmp_path / "made") + "']\n")
    with pytest.raises(UsageError, match=r"evil\.yaml"):
        load_config(str(tmp_path / "evil.yaml"))
    assert not (tmp_path / "made").exists()


def test_the_params_of_a_config_are_what_it_says():
    made = make_fusion_params(("background", "sand", "rock"), load_config("chiodini2020").fusion)
    np.testing.assert_allclose(made.class_increments, 1.8 * np.eye(3) - 0.9, atol=1e-7)
    np.testing.assert_allclose(made.class_prior, 0, atol=1e-7)
    np.testing.assert_allclose(made.class_threshold, 0.7)
