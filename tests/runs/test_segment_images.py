"""`jaxmap segment` on the images that people have: odd kinds, odd sizes, odd names, and folders used twice."""

from __future__ import annotations

import unicodedata
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from fixtures import cli, shared_cache  # noqa: F401
from golden.seeded_weights import seeded_image, seeded_weights
from PIL import Image

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import tf_architecture, torch_architecture
from jaxmap.models.checkpoint import SavedModel, load_network, save_model
from jaxmap.runs import segmentation as segmentation

SMALL = replace(
    torch_architecture("mobilenet_v2", ("background", "sand", "rock")),
    top_conv=False,
    head_channels=8,
    low_level_channels=4,
    atrous_rates=(2,),
)
SIZE = (40, 56)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(path, SMALL, seeded_weights(SMALL))
    return path


@pytest.fixture
def picture() -> Image.Image:
    return Image.fromarray(seeded_image(*SIZE))


def labels_of(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        assert image.mode == "L"
        return np.array(image)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def sixteen_bits(picture: Image.Image) -> Image.Image:
    return Image.fromarray(np.asarray(picture.convert("L")).astype(np.uint16) * 257)


KINDS = {
    "rgb.png": lambda picture: picture,
    "grey.png": lambda picture: picture.convert("L"),
    "grey_alpha.png": lambda picture: picture.convert("LA"),
    "rgba.png": lambda picture: picture.convert("RGBA"),
    "palette.png": lambda picture: picture.convert("P"),
    "two_colours.png": lambda picture: picture.convert("1"),
    "deep.png": sixteen_bits,
    "photograph.jpg": lambda picture: picture,
    "print.tif": lambda picture: picture.convert("CMYK"),
    "LOUD.PNG": lambda picture: picture,
}


def test_every_kind_of_image_is_labelled(cli, model, picture, tmp_path):
    (tmp_path / "images").mkdir()
    for name, convert in KINDS.items():
        convert(picture).save(tmp_path / "images" / name)
    before = contents(tmp_path / "images")
    assert cli("segment", tmp_path / "images", "--model", model, "--out", tmp_path / "out").status == 0
    labels = {name: labels_of(tmp_path / "out" / f"{Path(name).stem}.png") for name in KINDS}
    assert {array.shape for array in labels.values()} == {SIZE}
    for alike, to in (("rgba.png", "rgb.png"), ("LOUD.PNG", "rgb.png"), ("grey_alpha.png", "grey.png")):
        np.testing.assert_array_equal(labels[alike], labels[to])
    # 16 bits go down to 8 by a shift: the same picture again.
    np.testing.assert_array_equal(labels["deep.png"], labels["grey.png"])
    assert contents(tmp_path / "images") == before


def test_labels_lie_on_the_pixels_as_they_are_stored(cli, model, picture, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    picture.save(tmp_path / "turned.jpg", exif=exif, quality=95)
    picture.save(tmp_path / "plain.jpg", quality=95)
    words = ("segment", tmp_path / "turned.jpg", tmp_path / "plain.jpg", "--model", model, "--out", tmp_path / "out")
    assert cli(*words).status == 0
    np.testing.assert_array_equal(*(labels_of(tmp_path / "out" / f"{name}.png") for name in ("turned", "plain")))


@pytest.mark.parametrize("size", [(1, 1), (1, 50), (10, 5000), (17, 3)])
@pytest.mark.parametrize("given", [None, (33, 47)])
def test_any_size_is_labelled_at_its_own_size(model, size, given):
    segmenter = segmentation.Segmenter(load_network(model), given)
    logits = segmenter.logits(seeded_image(*size))
    assert logits.shape == (*size, 3) and np.isfinite(logits).all()


def test_one_pixel_is_enough_for_the_tensorflow_design():
    record = replace(tf_architecture("mobilenet_v2", ("a", "b")), head_channels=8, low_level_channels=4)
    segmenter = segmentation.Segmenter(SavedModel(record, seeded_arrays(record), "network"))
    assert np.isfinite(segmenter.logits(seeded_image(1, 1))).all()


def seeded_arrays(record) -> dict[str, jax.Array]:
    return {name: jax.numpy.asarray(value) for name, value in seeded_weights(record).items()}


@pytest.mark.parametrize("name", ["Ωmega æ", "岩石 01", "a.b.c", "[x]{y}*", "'; rm -rf", "%s %d", "e\u0301"])
def test_names_come_back_as_they_are(cli, model, picture, tmp_path, name):
    (tmp_path / name).mkdir()
    picture.save(tmp_path / name / f"{name}.png")
    out = tmp_path / name / "out"
    outcome = cli("segment", tmp_path / name, "--model", model, "--out", out)
    assert outcome.status == 0 and str(out) in outcome.out
    written = {unicodedata.normalize("NFC", path.name) for path in out.iterdir()}
    assert written == {unicodedata.normalize("NFC", f"{name}{end}") for end in (".png", "_overlay.png")}


def test_an_input_is_never_replaced(cli, model, picture, tmp_path):
    images, masks = tmp_path / "images", tmp_path / "masks"
    for folder in (images, masks):
        folder.mkdir()
    picture.save(images / "a.png")
    Image.fromarray(np.zeros(SIZE, np.uint8)).save(masks / "a.png")
    (tmp_path / "link").symlink_to(images, target_is_directory=True)
    before = contents(images), contents(masks), model.read_bytes()
    words = ("segment", images, "--model", model)
    for out in (images, tmp_path / "link", images / ".." / "images"):
        assert "a.png would be replaced" in cli(*words, "--out", out).error
    assert "a.png would be replaced" in cli(*words, "--out", masks, "--masks", masks).error
    for target in (masks / "a.png", model, images / "a.png"):
        outcome = cli(*words, "--out", tmp_path / "out", "--masks", masks, "--scores", target)
        assert f"{target.name} would be replaced" in outcome.error
    assert (contents(images), contents(masks), model.read_bytes()) == before
    assert not (tmp_path / "out").exists()


def test_photographs_may_be_labelled_beside_themselves(cli, model, picture, tmp_path):
    picture.save(tmp_path / "a.jpg")
    before = contents(tmp_path)
    assert cli("segment", tmp_path / "a.jpg", "--model", model, "--out", tmp_path).status == 0
    assert contents(tmp_path).items() > before.items()


def test_two_outputs_never_share_a_name(cli, model, picture, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("a.png", "a_overlay.png"):
        picture.save(folder / name)
    words = ("--model", model, "--out", tmp_path / "out")
    assert "a_overlay.png" in cli("segment", folder, *words).error
    picture.save(folder / "a.jpg")
    (folder / "a_overlay.png").unlink()
    assert "same name" in cli("segment", folder, *words).error
    assert not (tmp_path / "out").exists()


def test_hidden_files_are_no_images(cli, model, picture, tmp_path):
    (tmp_path / "images").mkdir()
    picture.save(tmp_path / "images" / "a.png")
    (tmp_path / "images" / "._a.png").write_bytes(b"resource fork")
    assert cli("segment", tmp_path / "images", "--model", model, "--out", tmp_path / "out").status == 0


def test_one_broken_image_does_not_keep_the_others_from_being_labelled(cli, model, picture, tmp_path):
    (tmp_path / "images").mkdir()
    for name in "abc":
        picture.save(tmp_path / "images" / f"{name}.png")
    broken = tmp_path / "images" / "b.png"
    broken.write_bytes(broken.read_bytes()[:300])
    outcome = cli("segment", tmp_path / "images", "--model", model, "--out", tmp_path / "out")
    assert outcome.status == 1 and "1 of 3 images" in outcome.error and str(broken) in outcome.error
    assert sorted(contents(tmp_path / "out")) == ["a.png", "a_overlay.png", "c.png", "c_overlay.png"]


def test_an_interrupt_leaves_whole_files(cli, model, picture, tmp_path, monkeypatch):
    for name in "ab":
        picture.save(tmp_path / f"{name}.jpg")
    logits, calls = segmentation.Segmenter.logits, []

    def interrupted(self, image):
        calls.append(image)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return logits(self, image)

    words = ("segment", tmp_path / "a.jpg", tmp_path / "b.jpg", "--model", model, "--out", tmp_path / "out")
    monkeypatch.setattr(segmentation.Segmenter, "logits", interrupted)
    outcome = cli(*words)
    assert outcome.status == 130 and outcome.error == "interrupted"
    assert sorted(contents(tmp_path / "out")) == ["a.png", "a_overlay.png"]
    assert labels_of(tmp_path / "out" / "a.png").shape == SIZE
    assert cli(*words).status == 0
    assert len(contents(tmp_path / "out")) == 4


def test_too_little_memory_is_told(model):
    segmenter = segmentation.Segmenter(load_network(model))

    def exhausted(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8796093022208 bytes.")

    segmenter._run = exhausted  # type: ignore[assignment]
    with pytest.raises(JaxmapError, match="56x40 px takes more memory than there is.*--size"):
        segmenter.logits(seeded_image(*SIZE))
