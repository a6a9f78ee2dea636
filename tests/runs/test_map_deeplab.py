"""`jaxmap map --labeller deeplab`: from a model file and a folder of images to a labelled map."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from fixtures import cli, map_words, scene_copy, scene_folder, shared_cache  # noqa: F401
from networks import NETWORK_CLASSES, small_model, write_small_model
from PIL import Image
from planned_runs import log_odds, planned

from jaxmap.commands.main import main
from jaxmap.datasets.images import read_image
from jaxmap.labels import IGNORE
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.mapping.store import load_map
from jaxmap.runs.segmentation import Segmenter

RENAMED = ("--deeplab.class-map", "gravel=rock", "boulder=rock")


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    return write_small_model(tmp_path_factory.mktemp("model") / "small.safetensors")


def deeplab_words(scene: object, out: object, model: Path, *more: object) -> list[str]:
    return map_words(scene, out, "--labeller", "deeplab", "--model", model, "--strict", *more)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory, scene_folder, shared_cache, model) -> Path:
    """A run over the first half of the scene; only to be read."""
    out = tmp_path_factory.mktemp("mapped") / "run"
    assert main(deeplab_words(scene_folder, out, model, "--stop", "3", *RENAMED, "--classes", "rock", "sand")) == 0
    return out


@pytest.mark.slow
def test_a_run_says_what_labelled_it(mapped, model):
    sha256 = hashlib.sha256(model.read_bytes()).hexdigest()
    metrics = json.loads((mapped / "metrics.json").read_text())
    assert metrics["labeller"] == "deeplab"
    assert metrics["model"] == {"file": str(model), "sha256": sha256}
    config = yaml.safe_load((mapped / "config.yaml").read_text())
    assert (config["model"], config["model_sha256"]) == (str(model), sha256)
    assert config["deeplab"]["class_map"] == {"gravel": "rock", "boulder": "rock"}
    assert model.name in (mapped / "report.html").read_text()


@pytest.mark.slow
def test_the_map_has_the_classes_asked_for_and_evidence_of_each(mapped):
    voxel_map, _ = load_map(mapped / "map.zarr")
    assert voxel_map.classes == ("rock", "sand")
    assert np.asarray(voxel_map.log_odds[1:] > 0).any(axis=(1, 2, 3)).all()


@pytest.mark.slow
def test_the_configuration_of_a_run_repeats_it_bit_for_bit(cli, scene_folder, mapped, tmp_path):
    words = ("map", scene_folder, "--out", tmp_path / "again", "--config", mapped / "config.yaml")
    assert cli(*words).status == 0
    np.testing.assert_array_equal(log_odds(tmp_path / "again"), log_odds(mapped))


@pytest.mark.slow
def test_a_run_is_gone_on_with_by_its_own_model_only(cli, scene_folder, mapped, model, tmp_path):
    run = Path(shutil.copytree(mapped, tmp_path / "run"))
    other = Path(shutil.copy(model, tmp_path / "other.safetensors"))
    settings = ("--stop", "3", *RENAMED, "--classes", "rock", "sand", "--resume")
    outcome = cli(*deeplab_words(scene_folder, run, other, *settings))
    assert outcome.status == 2 and "begun with another model in" in outcome.error
    kept = model.read_bytes()
    try:
        write_small_model(model, shift=0.5)
        outcome = cli(*deeplab_words(scene_folder, run, model, *settings))
        assert outcome.status == 2 and "begun with another model_sha256 in" in outcome.error
    finally:
        model.write_bytes(kept)
    assert cli(*deeplab_words(scene_folder, run, model, *settings)).status == 0


@pytest.mark.slow
def test_the_frames_of_a_run_are_labelled_as_segment_labels_their_images(scene_folder, model):
    plan = planned(scene_folder, labeller="deeplab", model=str(model), stop=1)
    assert plan.labeller.classes == NETWORK_CLASSES
    (prepared,) = prepare_frames(plan.sequence, plan.front_end, needs=plan.labeller.needs)
    shown = np.asarray(plan.mapper.label_image(prepared.frame, plan.params, plan.key, 0))
    logits = Segmenter(small_model()).logits(read_image(prepared.ref.left))
    chosen = np.take_along_axis(logits, np.minimum(shown, len(NETWORK_CLASSES) - 1)[..., None], axis=-1)[..., 0]
    fused = shown != IGNORE
    assert fused.any()
    np.testing.assert_allclose(chosen[fused], logits.max(axis=-1)[fused], atol=1e-3)


@pytest.mark.slow
def test_a_coloured_frame_among_grey_ones_is_mapped(cli, scene_copy, model, tmp_path):
    for side in ("left", "right"):
        image = scene_copy / side / "f001.png"
        with Image.open(image) as grey:
            grey.convert("RGB").save(image)
    outcome = cli(*deeplab_words(scene_copy, tmp_path / "run", model, "--stop", "3", *RENAMED))
    assert outcome.status == 0, outcome.err
    assert "3 of 3 frames fused" in outcome.err
    assert load_map(tmp_path / "run" / "map.zarr")[0].classes == ("rock",)


def test_frames_carry_images_only_where_they_are_asked_for(scene_folder):
    plan = planned(scene_folder, stop=1)
    for needs, shape in (("image", (120, 160, 3)), (None, None), ("labels", None)):
        (prepared,) = prepare_frames(plan.sequence, plan.front_end, needs=needs)
        assert (None if prepared.frame.image is None else prepared.frame.image.shape) == shape
