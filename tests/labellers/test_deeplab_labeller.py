"""The network inside the compiled step labels as `segment` does, and the map can be differentiated back to it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from golden.seeded_weights import seeded_image, seeded_weights
from hypothesis import given
from hypothesis import strategies as st
from networks import NETWORK_CLASSES, small_model
from reference_pixelwise import merged_probabilities
from strategies import HEIGHT_PX, WIDTH_PX, cloud_of, disparities, rngs

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.labellers.base import Labeller, LabellerParams, harden, label_points
from jaxmap.labellers.deeplab import make_deeplab_labeller, map_classes
from jaxmap.labels import IGNORE
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import load_network, save_model
from jaxmap.runs.segmentation import Segmenter
from jaxmap.types import Frame, PointLabels, make_grid, make_stereo_camera

CAMERA = make_stereo_camera(
    fx_px=30, fy_px=28, cx_px=15.2, cy_px=11.7, baseline_m=0.3, doffs_px=0.4, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
GRID = make_grid([-4, -3, -2], [4, 4, 3], 0.5)
KEY = jax.random.key(2)
PIXELS = HEIGHT_PX * WIDTH_PX
RENAMED = {"gravel": "rock", "boulder": "rock"}
"""Two classes become one, sand is dropped by being named nowhere, and so are sky and rover."""


def frame_of(image: np.ndarray, seed: int = 0) -> Frame:
    rng = np.random.default_rng(seed)
    pose = jaxlie.SE3.exp(jnp.asarray(rng.normal(0, 0.4, 6), jnp.float32))
    return Frame(jnp.asarray(disparities(rng, low_px=3.0, high_px=6.0)), pose, image=jnp.asarray(image))


def image_of(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.roll(seeded_image(HEIGHT_PX, WIDTH_PX), rng.integers(0, 20, 2), axis=(0, 1))


@cache
def labeller_of(*, renamed: bool = False, **options) -> Labeller:
    """A labeller whose function is compiled once for all tests."""
    labeller = make_deeplab_labeller(small_model(), class_map=RENAMED if renamed else {}, **options)
    return labeller._replace(label=jax.jit(labeller.label))


def labelled(labeller: Labeller, frame: Frame, params=None) -> PointLabels:
    points, valid = jnp.zeros((PIXELS, 3)), jnp.ones(PIXELS, bool)
    return label_points(labeller, frame, cloud_of(points, valid), labeller.params if params is None else params, KEY)[0]


@cache
def segmented(size_px: tuple[int, int] | None) -> np.ndarray:
    """The logits that `jaxmap segment` gives an image."""
    return Segmenter(small_model(), size_px).logits(image_of(0))


@pytest.mark.slow
@pytest.mark.parametrize("size_px", [pytest.param(None, marks=pytest.mark.slow), (40, 50)], ids=str)
def test_labels_are_those_of_segment(size_px):
    logits = segmented(size_px)
    labels = labelled(labeller_of(soft=False, size_px=size_px), frame_of(image_of(0))).labels
    # Up to ties within rounding.
    chosen = np.take_along_axis(logits, np.asarray(labels).reshape(HEIGHT_PX, WIDTH_PX, 1), axis=-1)[..., 0]
    np.testing.assert_allclose(chosen, logits.max(axis=-1), atol=1e-4)
    assert len(np.unique(labels)) > 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fcn", "segnet", "unet"])
def test_any_network_of_a_model_file_labels_as_segment_does(kind, tmp_path):
    record = replace(torch_architecture("resnet18", NETWORK_CLASSES, kind=kind), head_channels=16)
    save_model(tmp_path / "a.safetensors", record, seeded_weights(record))
    saved = load_network(tmp_path / "a.safetensors")
    labeller = make_deeplab_labeller(saved, soft=False, size_px=(40, 50))
    labels = np.asarray(labelled(labeller._replace(label=jax.jit(labeller.label)), frame_of(image_of(0))).labels)
    logits = Segmenter(saved, (40, 50)).logits(image_of(0))
    chosen = np.take_along_axis(logits, labels.reshape(HEIGHT_PX, WIDTH_PX, 1), axis=-1)[..., 0]
    np.testing.assert_allclose(chosen, logits.max(axis=-1), atol=1e-3)


@pytest.mark.parametrize("size_px", [pytest.param(None, marks=pytest.mark.slow), (40, 50)], ids=str)
def test_probabilities_are_those_of_segment_with_classes_merged_and_dropped(size_px):
    labeller = labeller_of(renamed=True, size_px=size_px, temperature=2.0)
    assert labeller.classes == ("rock",)
    shares = np.asarray(labelled(labeller, frame_of(image_of(0))).probabilities)
    targets = tuple(0 if name in RENAMED else IGNORE for name in NETWORK_CLASSES)
    expected = merged_probabilities(segmented(size_px).astype(np.float64) / 2.0, targets, 1)
    np.testing.assert_allclose(shares, expected.reshape(-1, 1), atol=1e-5)
    assert shares.min() > 0 and shares.max() < 1


def test_probabilities_of_all_classes_sum_to_one_and_harden_to_the_labels():
    frame = frame_of(image_of(0))
    soft = labelled(labeller_of(), frame)
    hard = labelled(labeller_of(soft=False, size_px=None), frame)
    np.testing.assert_allclose(soft.probabilities.sum(axis=-1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(harden(soft).labels, hard.labels)


def test_labels_of_dropped_classes_are_none_and_their_points_are_kept():
    frame = frame_of(image_of(0))
    everything = np.asarray(labelled(labeller_of(soft=False, size_px=None), frame).labels)
    some = labelled(labeller_of(classes=("rock", "sand"), renamed=True, soft=False), frame)
    become = np.array([IGNORE, 1, 0, 0, IGNORE])
    np.testing.assert_array_equal(some.labels, become[everything])
    assert IGNORE in some.labels and bool(some.keep.all())


def test_a_grey_image_is_taken_as_one_of_three_equal_channels():
    labeller, grey = labeller_of(), image_of(0)[..., 1]
    one, other = (labelled(labeller, frame_of(image)) for image in (grey, np.repeat(grey[..., None], 3, axis=-1)))
    np.testing.assert_array_equal(one.probabilities, other.probabilities)


def test_a_high_temperature_makes_all_classes_alike():
    labeller = labeller_of()
    hot = labeller.params._replace(numbers={"temperature": jnp.float32(np.exp(12.0))})
    shares = labelled(labeller, frame_of(image_of(0)), hot).probabilities
    np.testing.assert_allclose(shares, 1 / len(NETWORK_CLASSES), atol=1e-3)


@given(rngs())
def test_hardening_gives_no_class_where_most_is_of_none(rng):
    shares = rng.dirichlet(np.ones(4), 50).astype(np.float32)
    labels = harden(PointLabels(keep=jnp.ones(50, bool), probabilities=jnp.asarray(shares[:, :3]))).labels
    expected = shares.argmax(axis=-1)
    sure = np.abs(shares[:, 3] - shares[:, :3].max(axis=-1)) > 1e-5
    np.testing.assert_array_equal(np.asarray(labels)[sure], np.where(expected == 3, IGNORE, expected)[sure])


NAMES = st.sampled_from(["a", "b", "c", "d", "e"])


@given(
    st.lists(NAMES, min_size=1, unique=True),
    st.none() | st.lists(NAMES, unique=True),
    st.dictionaries(NAMES, NAMES),
)
def test_a_class_map_sends_every_class_to_its_name_or_is_refused(network, classes, renamed):
    try:
        mapped = map_classes(network, classes, renamed)
    except JaxmapError:
        names = set(renamed.values()) or set(network) if classes is None else set(classes)
        reached = {renamed.get(name, name) for name in network}
        assert set(renamed) - set(network) or set(renamed.values()) - names or names - reached or not names
        return
    for name, target in zip(network, mapped.targets, strict=True):
        new_name = renamed.get(name, name)
        assert (mapped.classes[target] if target != IGNORE else None) == (
            new_name if new_name in mapped.classes else None
        )
    assert set(mapped.targets) >= set(range(len(mapped.classes)))
    assert mapped.classes == tuple(classes or dict.fromkeys(renamed.values()) or network)


def test_all_faults_of_a_class_map_are_named_together():
    says = "the network has no class bus, tram; the map has no class car; no class of the network becomes mud"
    with pytest.raises(JaxmapError, match=says) as caught:
        map_classes(NETWORK_CLASSES, ("sand", "mud"), {"bus": "car", "tram": "car"})
    assert "sky, sand, gravel, boulder, rover" in str(caught.value)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (dict(size_px=(0, 32)), "deeplab.size_px.0 is 0: input should be greater than or equal to 1"),
        (dict(temperature=0.0), "deeplab.temperature is 0.0: input should be greater than 0"),
        (dict(temperature=float("nan")), "deeplab.temperature is nan"),
        (dict(classes=()), "the map has no class at all"),
    ],
)
def test_a_wrong_deeplab_labeller_is_refused_in_one_line(options, says):
    with pytest.raises(JaxmapError, match=says) as caught:
        make_deeplab_labeller(small_model(), **options)
    assert "\n" not in str(caught.value)


def test_a_backbone_alone_labels_nothing():
    with pytest.raises(JaxmapError, match="only a backbone"):
        make_deeplab_labeller(small_model()._replace(holds="backbone"))


def mapper_of(labeller: Labeller, rule: FusionRule) -> tuple[Mapper, MapperParams]:
    params = MapperParams(CAMERA, make_fusion_params(labeller.classes), labeller.params)
    return make_mapper(CAMERA, GRID, labeller, rule, (0.3, 4.0)), params


@pytest.fixture(scope="module")
def soft() -> tuple[Mapper, MapperParams]:
    return mapper_of(make_deeplab_labeller(small_model(), ("rock", "sand"), class_map=RENAMED), FusionRule())


@pytest.mark.slow
def test_the_step_compiles_once_for_a_sequence_and_scan_equals_loop(soft):
    mapper, params = soft
    sequence = [frame_of(image_of(seed), seed) for seed in range(3)]
    looped, infos = mapper.init(), []
    for frame in sequence:
        looped, info = mapper.step(looped, frame, params, KEY)
        infos.append(info)
    # Other weights are no other program: they are not compiled into it.
    warmer = replace(params, labeller=params.labeller._replace(numbers={"temperature": jnp.float32(1.6)}))
    mapper.step(mapper.init(), sequence[0], warmer, KEY)
    assert mapper.compilations() == 1
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sequence)
    scanned, scanned_info = mapper.scan(mapper.init(), stacked, params, KEY)
    np.testing.assert_allclose(scanned.log_odds, looped.log_odds, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(scanned_info.points_kept, [info.points_kept for info in infos])
    assert np.asarray(looped.log_odds[1:]).any(axis=(1, 2, 3)).all()


def test_the_map_is_updated_in_place_and_no_weight_is_donated_or_built_in(soft):
    mapper, params = soft
    before, frame = mapper.init(), frame_of(image_of(0))
    lowered = mapper.lower(before, frame, params, KEY)
    assert lowered.compile().memory_analysis().alias_size_in_bytes >= before.log_odds.nbytes
    # A constant of the program would be printed in full; there are millions of them.
    weights = sum(leaf.size for leaf in jax.tree.leaves(params.labeller))
    assert len(lowered.as_text()) < weights
    mapper.step(before, frame, params, KEY)
    assert before.log_odds.is_deleted()
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves((frame, params)))


@pytest.mark.slow
def test_label_image_shows_what_the_step_gives_the_pixels(soft):
    mapper, params = soft
    shown = np.asarray(mapper.label_image(frame_of(image_of(0)), params, KEY, 0))
    labels = map_classes(NETWORK_CLASSES, ("rock", "sand"), RENAMED)
    shares = merged_probabilities(segmented(None).astype(np.float64), labels.targets, 2)
    shares = np.concatenate([shares, 1 - shares.sum(axis=-1, keepdims=True)], axis=-1)
    expected = np.where(shares.argmax(axis=-1) == 2, IGNORE, shares.argmax(axis=-1))
    fused = shown != IGNORE
    np.testing.assert_array_equal(shown[fused], expected[fused])
    assert fused.any()


def test_params_of_another_labeller_are_refused(soft):
    mapper, params = soft
    with pytest.raises(JaxmapError, match="build MapperParams with labeller=labeller.params"):
        mapper.fuse(mapper.init(), frame_of(image_of(0)), replace(params, labeller=LabellerParams()), KEY)


@pytest.mark.parametrize(
    ("image", "says"),
    [(None, "the frame has no image in deeplab labeller"), (image_of(0)[1:], "give the rectified left image")],
    ids=["none", "of another size"],
)
def test_a_frame_without_its_image_is_refused(soft, image, says):
    mapper, params = soft
    frame = replace(frame_of(image_of(0)), image=None if image is None else jnp.asarray(image))
    with pytest.raises(JaxmapError, match=says):
        mapper.fuse(mapper.init(), frame, params, KEY)


LEAVES = ("temperature", "classifier.kernel", "backbone.stages.1.0.convs.1.bias", "aspp.project.kernel")


@pytest.mark.slow
def test_gradients_of_the_map_with_respect_to_the_network_equal_finite_differences(soft):
    mapper, params = soft
    with jax.enable_x64(True):
        to_double = lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf  # noqa: E731
        params, frame, empty = jax.tree.map(to_double, (params, frame_of(image_of(0)), mapper.init()))
        weight = np.random.default_rng(9).normal(size=empty.log_odds.shape)

        def with_leaf(name: str, value: jax.Array) -> MapperParams:
            if name == "temperature":
                return replace(params, labeller=params.labeller._replace(numbers={name: value}))
            weights = params.labeller.weights | {name: value}
            return replace(params, labeller=params.labeller._replace(weights=weights))

        @jax.jit
        @jax.value_and_grad
        def score(params: MapperParams) -> jax.Array:
            voxel_map, _ = mapper.fuse(empty, frame, params, KEY)
            return (weight * jnp.tanh(voxel_map.log_odds)).sum()

        # One program for values and gradients: to compile it is what takes the time.
        gradient = score(params)[1].labeller
        step = 1e-6
        for name in LEAVES:
            leaf = (params.labeller.numbers | params.labeller.weights)[name]
            ours = (gradient.numbers | gradient.weights)[name]
            direction = np.random.default_rng(3).normal(size=leaf.shape)
            slope = (
                float(score(with_leaf(name, leaf + step * direction))[0])
                - float(score(with_leaf(name, leaf - step * direction))[0])
            ) / (2 * step)
            assert abs(slope) > 1e-3, name
            np.testing.assert_allclose(float((ours * direction).sum()), slope, rtol=1e-3, err_msg=name)
