"""`jaxmap segment` and `jaxmap weights`: from a checkpoint to labelled and scored images."""

from __future__ import annotations

import hashlib
import json
import re
import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from fixtures import cli, shared_cache  # noqa: F401
from golden.seeded_weights import exported, seeded_image, seeded_weights
from PIL import Image
from safetensors.numpy import save_file

from jaxmap.errors import JaxmapError
from jaxmap.evaluation.segmentation_scores import SegmentationScores
from jaxmap.models import importers as tables
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import load_model, save_model
from jaxmap.runs import weights as weight_files

SMALL = replace(
    torch_architecture("mobilenet_v2", ("background", "sand", "rock")),
    top_conv=False,
    head_channels=8,
    low_level_channels=4,
    atrous_rates=(2,),
)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(path, SMALL, seeded_weights(SMALL))
    return path


@pytest.fixture
def images(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    Image.fromarray(seeded_image(40, 56)).save(folder / "a.png")
    Image.fromarray(seeded_image(40, 56)[..., 0]).save(folder / "b.png")
    (folder / "notes.txt").write_text("no image")
    return folder


def labels_of(path):
    with Image.open(path) as image:
        return np.array(image)


def test_images_are_labelled_and_scored(cli, model, images, tmp_path):
    out = tmp_path / "out"
    assert cli("segment", images, "--model", model, "--out", out, "--save-logits").status == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(
        f"{name}{end}" for name in "ab" for end in (".png", "_overlay.png", "_logits.npy")
    )
    logits = np.load(out / "a_logits.npy")
    assert logits.shape == (40, 56, 3) and logits.dtype == np.float32
    np.testing.assert_array_equal(labels_of(out / "a.png"), logits.argmax(axis=-1))
    assert labels_of(out / "a_overlay.png").shape == (40, 56, 3)
    (tmp_path / "masks").mkdir()
    for name in "ab":
        mask = labels_of(out / f"{name}.png")
        mask[:3] = 255
        Image.fromarray(mask).save(tmp_path / "masks" / f"{name}.png")
    words = ("segment", images, "--model", model, "--out", out, "--masks", tmp_path / "masks")
    outcome = cli(*words, "--scores", tmp_path / "scores.json")
    assert outcome.status == 0 and "IoU" in outcome.out
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["accuracy"] == 1.0 and scores["images"] == 2 and scores["pixels"] == 2 * 37 * 56
    assert set(scores["classes"]) == set(SMALL.classes)
    assert {"iou", "precision", "recall"} <= set(scores["classes"]["rock"])


def test_a_given_size_still_labels_every_pixel(cli, model, images, tmp_path):
    words = ("segment", images / "a.png", "--model", model, "--out", tmp_path / "out", "--size", "32", "48")
    assert cli(*words).status == 0
    assert labels_of(tmp_path / "out" / "a.png").shape == (40, 56)


def test_faults_are_one_line_and_nothing_is_written(cli, model, images, tmp_path):
    masks, out = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    words = ("segment", images, "--model", model, "--out", out)
    assert "2 of 2 masks are missing: a.png, b.png" in cli(*words, "--masks", masks).error
    Image.fromarray(np.zeros((40, 56), np.uint8)).save(masks / "a.png")
    Image.fromarray(np.zeros((40, 55), np.uint8)).save(masks / "b.png")
    assert "the mask is 55x40 px" in cli(*words, "--masks", masks).error
    Image.fromarray(np.full((40, 56), 3, np.uint8)).save(masks / "b.png")
    assert "label 3, but there are 3 classes" in cli(*words, "--masks", masks).error
    assert "no such file" in cli("segment", tmp_path / "no.png", "--model", model, "--out", out).error
    assert "same name" in cli("segment", images, images / "a.png", "--model", model, "--out", out).error
    assert "no such model file" in cli("segment", images, "--model", tmp_path / "no.safetensors", "--out", out).error
    outcome = cli(*words, "--scores", tmp_path / "scores.json")
    assert outcome.status == 2 and "--masks" in outcome.error
    assert not out.exists()


def test_scores_by_hand():
    scores = SegmentationScores.empty(("a", "b", "c"))
    truth = np.array([[0, 0, 1, 255]], np.uint8)
    logits = np.log(np.array([[[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]]]))
    scores.add(truth, logits)
    summary = scores.summary()
    assert summary["confusion"] == [[1, 1, 0], [0, 1, 0], [0, 0, 0]]
    assert summary["accuracy"] == pytest.approx(2 / 3)
    assert summary["classes"]["a"] == {"iou": 0.5, "precision": 1.0, "recall": 0.5, "pixels": 2}
    assert summary["classes"]["c"] == {"iou": None, "precision": None, "recall": None, "pixels": 0}
    assert summary["ece"] == pytest.approx(0.8 - 2 / 3)
    assert SegmentationScores.empty(("a",)).summary()["accuracy"] is None
    with pytest.raises(JaxmapError, match="label 7"):
        scores.add(np.full((1, 4), 7, np.uint8), logits)


@pytest.fixture
def server(tmp_path):
    """A folder that is served, and its URL."""
    folder = tmp_path / "served"
    folder.mkdir()

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *words):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield folder, f"http://127.0.0.1:{running.server_port}"
        running.shutdown()


def test_weights_are_fetched_checked_and_kept(cli, server, tmp_path, monkeypatch):
    pytest.importorskip("pooch")
    monkeypatch.setenv("JAXMAP_CACHE", str(tmp_path / "cache"))
    folder, url = server
    architecture = torch_architecture("resnet18", ("background", "sand", "rock"))
    source = folder / "resnet18.safetensors"
    save_file(exported(architecture, list(tables.torchvision_backbone("resnet18")), tables.TORCH), source)
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    public = {
        name: weight_files.PublicWeights(f"https://no.invalid/{file}", checksum, "")
        for name, file, checksum in (
            ("good", source.name, digest[:8]),
            ("whole", source.name, digest),
            ("wrong", source.name, "0" * 8),
            ("gone", "nothing.pth", digest),
        )
    }
    monkeypatch.setattr(weight_files, "PUBLIC", public)
    words = ("--out", tmp_path / "m.safetensors", "--mirror", url)
    outcome = cli("weights", "fetch", "good", *words)
    assert outcome.status == 0 and "downloading" in outcome.err
    assert load_model(tmp_path / "m.safetensors").holds == "backbone"
    source.write_bytes(b"changed")
    assert "downloading" not in cli("weights", "fetch", "whole", *words).err, "the cache is used"
    assert "should start with 00000000" in cli("weights", "fetch", "wrong", *words).error
    assert not (tmp_path / "cache" / "weights" / source.name).exists()
    assert "download failed" in cli("weights", "fetch", "whole", *words).error
    assert "download failed" in cli("weights", "fetch", "gone", *words).error
    assert "known are good" in cli("weights", "fetch", "other", *words).error


def test_the_table_of_public_weights_is_well_formed():
    for public in weight_files.PUBLIC.values():
        assert public.url.startswith("https://") and re.fullmatch("[0-9a-f]{64}", public.sha256)
        assert public.url.endswith(f"-{public.sha256[:8]}.pth")


@pytest.mark.realdata
def test_weights_import_and_segment_label_the_cat(cli, realdata, tmp_path):
    import skimage

    source = realdata / "weights" / "deeplabv3_mnv2_voc_trainval_folded.safetensors"
    if not source.exists():
        pytest.skip(f"no {source}")
    assert cli("weights", "import", source, "--out", tmp_path / "voc.safetensors").status == 0
    Image.fromarray(skimage.data.chelsea()).save(tmp_path / "chelsea.png")
    words = ("segment", tmp_path / "chelsea.png", "--model", tmp_path / "voc.safetensors", "--out", tmp_path / "out")
    assert cli(*words).status == 0
    assert 0.75 <= (labels_of(tmp_path / "out" / "chelsea.png") == 8).mean() <= 0.83
