"""The layers of an ensemble: laws of the share of its calls, and their way through map.zarr."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import reference_ensemble
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import CLASSES, rngs

from jaxmap.ensemble.layer import ensemble_layers, layer_names, named_layers, stored_layers
from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.query import top_down
from jaxmap.mapping.store import MEMBERS, MapAttributes, load_map, save_map
from jaxmap.types import GridSpec, VoxelMap

PARAMS = make_fusion_params(CLASSES, occupancy_threshold=0.6, class_threshold=0.7)
RULES = [FusionRule(), FusionRule(column="max")]
SHAPE = (6, 5, 4)


def random_map(rng: np.random.Generator, members: int = 3) -> VoxelMap:
    log_odds = rng.normal(0, 2, (1 + len(CLASSES), *SHAPE)) * (rng.random(SHAPE) < 0.5)
    own = rng.normal(0, 2, (members, 2, *SHAPE)) * (rng.random((members, 1, *SHAPE)) < 0.5)
    grid = GridSpec(jnp.zeros(3), jnp.full(3, 0.2), SHAPE)
    return VoxelMap(
        jnp.asarray(log_odds, jnp.float32), jnp.asarray(3, jnp.int32), grid, CLASSES, jnp.asarray(own, jnp.float32)
    )


@given(rngs(), st.sampled_from(RULES))
@settings(max_examples=10)
def test_layers_equal_the_twin(rng, rule):
    voxel_map = random_map(rng)
    probability, missed = reference_ensemble.layers(voxel_map, PARAMS, rule, "rock")
    ours = ensemble_layers(voxel_map, PARAMS, rule)
    np.testing.assert_allclose(ours.probability, probability, rtol=1e-6)
    np.testing.assert_allclose(ours.missed, missed, rtol=1e-6)


@given(rngs())
@settings(max_examples=10)
def test_the_order_of_members_does_not_matter(rng):
    voxel_map = random_map(rng, members=5)
    order = rng.permutation(5)
    layers = ensemble_layers(voxel_map, PARAMS, RULES[0])
    shuffled = ensemble_layers(replace(voxel_map, members=voxel_map.members[order]), PARAMS, RULES[0])
    for layer, other in zip(layers, shuffled, strict=True):
        np.testing.assert_array_equal(layer, other)


@given(rngs())
@settings(max_examples=10)
def test_layers_lie_between_0_and_1_where_the_map_saw_ground_and_nowhere_else(rng):
    voxel_map = random_map(rng)
    top = top_down(voxel_map, PARAMS, RULES[0])
    layers = ensemble_layers(voxel_map, PARAMS, RULES[0])
    called = np.asarray(top.label) == CLASSES.index("rock")
    for layer in map(np.asarray, layers):
        np.testing.assert_array_equal(np.isnan(layer), ~np.asarray(top.observed))
        known = layer[np.asarray(top.observed)]
        assert ((known >= 0) & (known <= 1)).all()
    assert not np.asarray(layers.missed)[called].any()
    assert (np.asarray(layers.probability)[called] > 0).all()


def test_a_member_that_saw_nothing_has_no_say():
    voxel_map = random_map(np.random.default_rng(1), members=2)
    blind = jnp.concatenate([voxel_map.members, jnp.zeros((3, 2, *SHAPE))])
    layers = ensemble_layers(voxel_map, PARAMS, RULES[0])
    with_blind = ensemble_layers(replace(voxel_map, members=blind), PARAMS, RULES[0])
    np.testing.assert_array_equal(layers.missed, with_blind.missed)


def test_the_class_is_the_first_priority_class_that_the_map_has():
    rule = FusionRule(priority_classes=("boulder", "sand", "rock"))
    assert rule.target(CLASSES) == "sand"
    assert FusionRule(priority_classes=("boulder",)).target(CLASSES) is None
    names = named_layers(random_map(np.random.default_rng(0)), PARAMS, rule)
    assert tuple(names) == layer_names("sand") == ("ensemble_probability_sand", "missed_sand")


def test_a_map_without_members_has_no_layers():
    voxel_map = replace(random_map(np.random.default_rng(0)), members=None)
    assert named_layers(voxel_map, PARAMS, RULES[0]) == {}
    assert stored_layers({}, "rock", "map") is None
    assert stored_layers({}, None, "map") is None


def test_members_and_layers_are_saved_and_loaded(tmp_path):
    voxel_map = random_map(np.random.default_rng(4))
    layers = named_layers(voxel_map, PARAMS, RULES[0])
    save_map(tmp_path / "map.zarr", voxel_map, MapAttributes(layers=layers))
    loaded, attributes = load_map(tmp_path / "map.zarr", members=True)
    np.testing.assert_array_equal(loaded.members, voxel_map.members)
    np.testing.assert_array_equal(loaded.log_odds, voxel_map.log_odds)
    assert list(attributes.layers) == list(layers)
    for name, layer in layers.items():
        np.testing.assert_array_equal(attributes.layers[name], layer)
    assert load_map(tmp_path / "map.zarr")[0].members is None, "they are read only where they are asked for"


def test_a_map_without_an_ensemble_is_stored_as_ever(tmp_path):
    import json

    voxel_map = replace(random_map(np.random.default_rng(4)), members=None)
    save_map(tmp_path / "map.zarr", voxel_map, MapAttributes())
    stored = json.loads((tmp_path / "map.zarr" / "zarr.json").read_text())["attributes"]
    assert not {"layers", "chunks_stored_of"} & stored.keys()
    assert {path.name for path in (tmp_path / "map.zarr").iterdir()} == {"zarr.json", "log_odds"}


@pytest.mark.parametrize("name", [MEMBERS, "missed_rock"])
def test_lost_and_damaged_chunks_of_the_ensemble_are_noticed(name, tmp_path):
    voxel_map = random_map(np.random.default_rng(4))
    attributes = MapAttributes(layers=named_layers(voxel_map, PARAMS, RULES[0]))
    save_map(tmp_path / "map.zarr", voxel_map, attributes)
    chunk = next(path for path in (tmp_path / "map.zarr" / name / "c").rglob("*") if path.is_file())
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(JaxmapError, match=f"chunk of {name} is damaged"):
        load_map(tmp_path / "map.zarr", members=True)
    chunk.unlink()
    with pytest.raises(JaxmapError, match=f"chunks of {name} are there"):
        load_map(tmp_path / "map.zarr", members=True)


def test_members_that_are_no_numbers_are_not_saved(tmp_path):
    voxel_map = random_map(np.random.default_rng(4))
    bad = replace(voxel_map, members=voxel_map.members.at[0, 0, 0, 0, 0].set(jnp.nan))
    with pytest.raises(JaxmapError, match="not finite"):
        save_map(tmp_path / "map.zarr", bad, MapAttributes())
    assert not (tmp_path / "map.zarr").exists()


@pytest.mark.parametrize("value", [-0.1, 1.5, np.inf])
def test_layers_that_hold_no_probabilities_are_refused(value):
    layers = dict.fromkeys(layer_names("rock"), np.array([[np.nan, value]], np.float32))
    with pytest.raises(JaxmapError, match="not probabilities"):
        stored_layers(layers, "rock", "map.zarr")


@given(rngs())
@settings(max_examples=10)
def test_members_that_are_the_map_itself_miss_nothing_whatever_the_kernel(rng):
    kernel = jnp.asarray(rng.uniform(-0.3, 0.5, (len(CLASSES), 3, 3)), jnp.float32)
    voxel_map, params = random_map(rng), replace(PARAMS, class_kernel=kernel)
    own = voxel_map.log_odds[jnp.array([0, 1 + CLASSES.index("rock")])]
    layers = ensemble_layers(replace(voxel_map, members=jnp.stack([own, own])), params, RULES[0])
    assert np.nanmax(layers.missed) == 0.0
