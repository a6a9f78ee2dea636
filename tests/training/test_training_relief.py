"""Relief in training: read with the images, cut with them, seen by the network."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures import cli, shared_cache  # noqa: F401
from PIL import Image
from tiny_training import ARCHITECTURE, network_is_tiny, train_words, write_data_and_config  # noqa: F401
from training_data import CLASSES, write_data

from jaxmap.datasets.stereo_images import LevelCamera, read_stereo, write_stereo
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.geometry.relief import RELIEF_CHANNELS, relief_channels, relief_of
from jaxmap.host.files import bundled
from jaxmap.models.checkpoint import load_network
from jaxmap.models.network import initial_weights
from jaxmap.runs.training_plan import TrainConfig, plan_image_training
from jaxmap.training.batches import ExampleOrder, ExampleReader
from jaxmap.training.data import TrainingSet, check_training_set, digest, open_training_set, with_stereo
from jaxmap.training.options import AugmentationOptions, NetworkOptions, TrainingOptions
from jaxmap.training.relief import read_relief
from jaxmap.training.step import Batch, make_trainer
from jaxmap.types import make_stereo_camera

CAMERA = LevelCamera(40.0, 40.0, 20.0, 10.0, 0.3, 0.0, (0.0, -1.0, 0.0))
UNLEVEL = json.dumps({**asdict(CAMERA), "up_camera": [0.0, 0.0, 0.0]})
measured = jax.jit(lambda *frame: relief_channels(relief_of(*frame)))
NAME, SIZE_PX = "i0", (40, 40)


def ground_px() -> np.ndarray:
    """The disparity of flat ground one metre below the camera, unknown above the horizon and in a stripe."""
    depth_m = 40.0 / np.maximum(np.arange(SIZE_PX[0]) - 10.0, 1e-3)
    disparity_px = np.repeat((0.3 * 40.0 / depth_m)[:, None], SIZE_PX[1], axis=1).astype(np.float32)
    disparity_px[:14], disparity_px[:, 8:12] = np.nan, np.nan
    return disparity_px


@pytest.fixture(scope="module")
def data(tmp_path_factory, network_is_tiny) -> Path:
    """The tiny data, of which one image has a disparity."""
    folder = write_data_and_config(tmp_path_factory.mktemp("data"))
    write_stereo(folder, NAME, ground_px(), CAMERA)
    return folder


@pytest.fixture
def copy(data, tmp_path) -> Path:
    return Path(shutil.copytree(data, tmp_path / "copy"))


def opened(folder: Path) -> TrainingSet:
    return with_stereo(open_training_set(folder, CLASSES))


@pytest.mark.slow
def test_the_relief_of_an_image_is_that_of_its_disparity(data):
    training_set = opened(data)
    first, second = training_set.train[:2]
    assert first.name == NAME and first.stereo and not second.stereo
    camera = make_stereo_camera(fx_px=40, cx_px=20, cy_px=10, baseline_m=0.3, width_px=40, height_px=40)
    rounded = np.round(ground_px() * 256) / 256
    expected = measured(camera, jnp.array(CAMERA.up_camera), jnp.asarray(rounded, jnp.float32))
    found = read_relief(first)
    assert found.dtype == np.float16 and found.shape == (10, 10, RELIEF_CHANNELS) and found[..., -1].any()
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert not read_relief(second).any() and read_relief(second).shape[:2] == tuple(-(-s // 4) for s in second.size_px)


def test_batches_carry_the_relief_of_their_images(data):
    training_set = opened(data)
    reader = ExampleReader(training_set.train, training_set.lookup, relief=True)
    order = ExampleOrder.of(5, TrainingOptions(batch_size=5, epochs=2))
    for step in (0, 1):
        batch, chosen = reader.batch(order.draws(step), order), order.draws(step)[:, 1]
        assert batch.relief is not None and batch.relief.shape == (5, 10, 11, RELIEF_CHANNELS)
        for relief, index in zip(batch.relief, chosen.tolist(), strict=True):
            expected = read_relief(training_set.train[index])
            np.testing.assert_array_equal(relief[: expected.shape[0], : expected.shape[1]], expected)
    assert ExampleReader(training_set.train, training_set.lookup).batch(order.draws(0), order).relief is None


def test_faults_of_disparities_are_found_before_training(copy):
    before = digest(opened(copy))
    write_stereo(copy, NAME, np.full((20, 40), 1.0, np.float32), CAMERA)
    assert digest(opened(copy)) != before
    with pytest.raises(JaxmapError, match=r"the disparity is 40x20 px, the image 40x40 px in .*i0.png"):
        check_training_set(opened(copy))
    check_training_set(open_training_set(copy, CLASSES))
    (copy / "cameras" / f"{NAME}.json").unlink()
    with pytest.raises(JaxmapError, match=r"no such file in .*i0.json"):
        check_training_set(opened(copy))
    (copy / "disparity" / f"{NAME}.png").unlink()
    assert not any(example.stereo for example in opened(copy).train)


def test_a_disparity_of_an_image_with_a_rotation_tag_is_refused(copy):
    """The image would be turned, the disparity not."""
    path = copy / "images" / f"{NAME}.png"
    exif = Image.Exif()
    exif[0x0112] = 3
    with Image.open(path) as image:
        image.load()
        image.save(path, exif=exif)
    with pytest.raises(JaxmapError, match=r"the image has a disparity and a rotation tag in .*i0.png; remove the tag"):
        opened(copy)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{", "not readable as JSON"),
        ('{"fx_px": 40}', "the camera cannot be read"),
        (UNLEVEL, "the camera cannot be read"),
    ],
    ids=["truncated", "incomplete", "no unit vector"],
)
def test_a_camera_that_is_none_is_refused(copy, content, reason):
    (copy / "cameras" / f"{NAME}.json").write_text(content)
    with pytest.raises(JaxmapError, match=reason):
        read_stereo(copy, NAME)


@pytest.mark.slow
def test_the_network_learns_from_relief_alone():
    """The images are all alike; the labels stand in the relief."""
    record = replace(ARCHITECTURE, decoder=True, relief_channels=2)
    augmentation = AugmentationOptions(crop_px=(32, 32), scale=(1.0, 1.25), drop_image=0.5, disturb_relief=0.1)
    options = TrainingOptions(batch_size=2, augmentation=augmentation)
    trainer = make_trainer(record, options, steps=1000, class_weights=jnp.ones(2), batch_norms=("aspp", "decoder"))
    labels = (np.indices((2, 32, 32))[2] < 16).astype(np.uint8)
    relief = np.stack([labels[:, ::4, ::4], np.ones((2, 8, 8))], axis=-1).astype(np.float16)
    sizes_px, draws = np.full((2, 2), 32, np.int32), np.array([[0, 0], [0, 1]], np.int32)
    state, losses = trainer.init(initial_weights(record, jax.random.key(0))), []
    images, originals = np.full((2, 32, 32, 3), 128, np.uint8), np.zeros(2, bool)
    for epoch in range(30):
        draws[:, 0] = epoch
        batch = jax.device_put(Batch(images, labels, sizes_px, draws, originals, relief))  # type: ignore[arg-type]
        state, metrics = trainer.step(state, batch, jax.random.key(1))
        losses.append(float(metrics.loss))
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:3]), losses


@pytest.mark.slow
def test_a_run_with_relief_says_so(cli, data, tmp_path):
    out = tmp_path / "run"
    words = train_words(data, out, "--network.relief", "True", "--network.decoder", "True", "--epochs", 1)
    status, _, errors = cli(*words)
    assert status == 0, errors
    assert load_network(out / "model.safetensors").architecture.relief_channels == RELIEF_CHANNELS
    assert "5, 1 with relief" in (out / "report.html").read_text("utf8")


def test_a_network_that_sees_relief_is_trained_on_images_alone(tmp_path):
    folder, init, notes = write_data(tmp_path), bundled("rover.safetensors"), []
    for path in (folder / "masks").iterdir():
        labels = np.asarray(Image.open(path))
        Image.fromarray(np.where(labels == 255, 0, labels + 1).astype(np.uint8)).save(path)
    config = TrainConfig(batch_size=1, augmentation=AugmentationOptions(crop_px=(32, 32)))
    plan = plan_image_training(folder, config, init, notify=notes.append)
    assert any("learns from images alone" in note for note in notes)
    assert plan.network.architecture.relief_channels
    asked_for = replace(config, network=NetworkOptions(relief=True))
    with pytest.raises(UsageError, match="no training image has a disparity, and network.relief is given"):
        plan_image_training(folder, asked_for, init, notify=notes.append)
