"""`jaxmap segment`: labelled and scored images, of odd kinds, sizes and names, and what it refuses."""

from __future__ import annotations

import json
import re
import unicodedata
import zlib
from dataclasses import replace
from pathlib import Path
from struct import pack

import jax
import numpy as np
import pytest
import rasterio
from fixtures import cli, shared_cache  # noqa: F401
from golden.seeded_weights import seeded_image, seeded_weights
from networks import SEGMENTING
from PIL import Image

from jaxmap.datasets.images import rotation_notes
from jaxmap.datasets.masks import make_mask_lookup
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.segmentation_scores import SegmentationScores
from jaxmap.models.architecture import tf_architecture
from jaxmap.models.checkpoint import SavedModel, load_network, save_model
from jaxmap.models.pixelwise import resized_output
from jaxmap.runs import segmentation
from jaxmap.runs.large_pictures import enlarged

SIZE = (40, 56)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(path, SEGMENTING, seeded_weights(SEGMENTING))
    return path


@pytest.fixture
def picture() -> Image.Image:
    return Image.fromarray(seeded_image(*SIZE))


@pytest.fixture
def images(tmp_path, picture):
    folder = tmp_path / "images"
    folder.mkdir()
    picture.save(folder / "a.png")
    picture.convert("L").save(folder / "b.png")
    (folder / "notes.txt").write_text("no image")
    return folder


def labels_of(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_images_are_labelled_and_scored(cli, model, images, tmp_path):
    """The network runs at another size; labels and logits have that of the image."""
    out = tmp_path / "out"
    words = ("segment", images, "--model", model, "--out", out, "--size", "17", "50")
    assert cli(*words, "--save-logits").status == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(
        f"{name}{end}" for name in "ab" for end in (".png", "_overlay.png", "_logits.npy")
    )
    logits = np.load(out / "a_logits.npy")
    assert logits.shape == (*SIZE, 3) and logits.dtype == np.float32
    np.testing.assert_array_equal(labels_of(out / "a.png"), logits.argmax(axis=-1))
    assert labels_of(out / "a_overlay.png").shape == (*SIZE, 3)
    (tmp_path / "masks").mkdir()
    for name in "ab":
        mask = labels_of(out / f"{name}.png")
        mask[:3] = 255
        Image.fromarray(mask).save(tmp_path / "masks" / f"{name}.png")
    outcome = cli(*words, "--masks", tmp_path / "masks", "--scores", tmp_path / "scores.json")
    assert outcome.status == 0 and "IoU" in outcome.out
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["accuracy"] == 1.0 and scores["images"] == 2 and scores["pixels"] == 2 * 37 * SIZE[1]
    assert set(scores["classes"]) == set(SEGMENTING.classes)
    assert {"iou", "precision", "recall"} <= set(scores["classes"]["rock"])


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
NAMES = ("Ωmega æ", "岩石 01", "a.b.c", "[x]{y}*", "'; rm -rf", "%s %d", "e\u0301")


@pytest.mark.slow
def test_every_kind_and_name_of_image_is_labelled(cli, model, picture, tmp_path):
    folder, out = tmp_path / "[岩石] %s" / "images", tmp_path / "[岩石] %s" / "out"
    folder.mkdir(parents=True)
    for name, convert in KINDS.items():
        convert(picture).save(folder / name)
    for name in NAMES:
        picture.save(folder / f"{name}.png")
    turned = Image.Exif()
    turned[0x0112] = 6
    picture.save(folder / "turned.jpg", exif=turned)
    (folder / "._a.png").write_bytes(b"resource fork")
    before = contents(folder)
    outcome = cli("segment", folder, "--model", model, "--out", out)
    assert outcome.status == 0 and str(out) in outcome.out and contents(folder) == before
    stems = [*(Path(name).stem for name in KINDS), *NAMES, "turned"]
    assert {unicodedata.normalize("NFC", path.name) for path in out.iterdir()} == {
        unicodedata.normalize("NFC", f"{stem}{end}") for stem in stems for end in (".png", "_overlay.png")
    }
    labels = {stem: labels_of(out / f"{stem}.png") for stem in stems}
    # Labels of a photograph lie on what viewers show.
    assert labels.pop("turned").shape == SIZE[::-1]
    assert {array.shape for array in labels.values()} == {SIZE}
    # 16 bits go down to 8 by a shift: the same picture again.
    alike = {"rgba": "rgb", "LOUD": "rgb", "a.b.c": "rgb", "grey_alpha": "grey", "deep": "grey"}
    for one, other in alike.items():
        np.testing.assert_array_equal(labels[one], labels[other], err_msg=one)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (1, 50), (10, 5000), (17, 3)])
@pytest.mark.parametrize("given", [None, (33, 47)])
def test_any_size_is_labelled_at_its_own_size(model, size, given):
    logits = segmentation.Segmenter(load_network(model), given).logits(seeded_image(*size))
    assert logits.shape == (*size, 3) and np.isfinite(logits).all()


@pytest.mark.slow
def test_one_pixel_is_enough_for_the_tensorflow_design():
    record = replace(tf_architecture("mobilenet_v2", ("a", "b")), head_channels=8, low_level_channels=4)
    weights = {name: jax.numpy.asarray(value) for name, value in seeded_weights(record).items()}
    segmenter = segmentation.Segmenter(SavedModel(record, weights, "network"))
    assert np.isfinite(segmenter.logits(seeded_image(1, 1))).all()


@pytest.mark.slow
def test_a_broken_photograph_does_not_keep_its_neighbours_from_being_labelled(cli, model, picture, tmp_path):
    """They may be labelled beside themselves."""
    for name in "abc":
        picture.save(tmp_path / f"{name}.jpg")
    broken = tmp_path / "b.jpg"
    broken.write_bytes(broken.read_bytes()[:300])
    before = contents(tmp_path)
    outcome = cli("segment", tmp_path, "--model", model, "--out", tmp_path)
    assert outcome.status == 1 and "1 of 3 images" in outcome.error and str(broken) in outcome.error
    new = {"a.png", "a_overlay.png", "c.png", "c_overlay.png"}
    assert contents(tmp_path).items() > before.items() and contents(tmp_path).keys() - before.keys() == new


@pytest.mark.slow
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


def test_too_little_memory_is_reported(model):
    segmenter = segmentation.Segmenter(load_network(model))

    def exhausted(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8796093022208 bytes.")

    segmenter._run = exhausted  # type: ignore[assignment]
    with pytest.raises(JaxmapError, match="56x40 px takes more memory than there is.*--size"):
        segmenter.logits(seeded_image(*SIZE))


def test_an_input_is_never_replaced(images, model, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    (masks / "a.png").write_bytes(b"mask")
    (tmp_path / "link").symlink_to(images, target_is_directory=True)
    found = segmentation.find_images([images])
    inputs = [*found, masks / "a.png", model]

    def refused(out: Path, scores: Path | None, name: str) -> None:
        with pytest.raises(JaxmapError, match=f"{name} would be replaced"):
            segmentation.check_outputs(found, out, inputs=inputs, scores=scores)

    for out in (images, tmp_path / "link", images / ".." / "images", masks):
        refused(out, None, "a.png")
    for target in (masks / "a.png", model, images / "a.png"):
        refused(tmp_path / "out", target, target.name)
    segmentation.check_outputs(found, tmp_path / "out", inputs=inputs, scores=tmp_path / "scores.json")


def test_two_outputs_never_share_a_name(images, picture, tmp_path):
    picture.save(images / "a_overlay.png")
    with pytest.raises(JaxmapError, match=r"a_overlay.png would be both"):
        segmentation.check_outputs(segmentation.find_images([images]), tmp_path / "out", inputs=[], scores=None)
    picture.save(images / "a.jpg")
    with pytest.raises(JaxmapError, match="same name"):
        segmentation.find_images([images])
    with pytest.raises(JaxmapError, match="no such file"):
        segmentation.find_images([tmp_path / "no.png"])


def test_faults_of_masks_are_found_before_the_work(cli, model, images, tmp_path):
    masks, found = tmp_path / "masks", segmentation.find_images([images])
    lookup = make_mask_lookup(SEGMENTING.classes, option="--", all_classes=False)
    masks.mkdir()
    with pytest.raises(JaxmapError, match=r"2 of 2 masks are missing: a.png, b.png"):
        segmentation.find_masks(found, masks)
    Image.fromarray(np.zeros(SIZE, np.uint8)).save(masks / "a.png")
    for fault, content in {
        "the mask is 55x40 px": np.zeros((40, 55), np.uint8),
        "the values 3 are no class .0 to 2, and 255 for none.*; take masks of the network's .* --remap VALUE": np.full(
            SIZE, 3, np.uint8
        ),
        "the mask is in colour .* --palette CLASS": np.full((*SIZE, 3), (0, 1, 2), np.uint8),
    }.items():
        Image.fromarray(content).save(masks / "b.png")
        with pytest.raises(JaxmapError, match=fault):
            segmentation.check_masks(found, segmentation.find_masks(found, masks), lookup)
    outcome = cli("segment", images, "--model", model, "--out", tmp_path / "out", "--scores", tmp_path / "scores.json")
    assert outcome.status == 2 and "--masks" in outcome.error
    assert not (tmp_path / "out").exists()


class Fixed:
    """Stands for a network that says the same of every pixel, or one class by the brightness of the pixel."""

    classes = ("background", "sand", "rock")
    size: tuple[int, int] | None = None

    def logits(self, image: np.ndarray) -> np.ndarray:
        grey = image.reshape(*image.shape[:2], -1)[..., 0].astype(np.float32)
        return np.stack([128 - grey, np.full_like(grey, -10), grey - 128], axis=-1) / 32


def score(images: list[Path], masks: Path, out: Path, **coding) -> tuple[dict, list[str]]:
    """The scores of that network, and the notes on the masks."""
    lookup = make_mask_lookup(Fixed.classes, option="--", all_classes=False, **coding)
    found = segmentation.find_masks(images, masks)
    notes = segmentation.check_masks(images, found, lookup)
    scores, faults = segmentation.label_images(segmentation.LabelWriter(Fixed(), out, lookup), images, found)  # type: ignore[arg-type]
    assert not faults
    return scores.summary(), notes


@pytest.fixture
def halves(tmp_path) -> tuple[Path, np.ndarray]:
    """An image whose upper half is dark and whose lower half is bright, and the labels of it."""
    pixels = np.full((20, 30), 40, np.uint8)
    pixels[10:] = 220
    (tmp_path / "masks").mkdir()
    Image.fromarray(pixels).save(tmp_path / "a.png")
    return tmp_path / "a.png", np.where(pixels > 128, 2, 0).astype(np.uint8)


MASKS = {
    "a.png": lambda truth: Image.fromarray(truth),
    "a.PNG": lambda truth: Image.fromarray(truth),
    "a.tif": lambda truth: Image.fromarray(truth),
    "a.Png": lambda truth: Image.fromarray(truth.astype(np.uint16)),
    "a.bmp": lambda truth: Image.fromarray(np.stack([truth] * 3, axis=-1)),
}


@pytest.mark.parametrize("name", MASKS)
def test_masks_are_read_as_train_reads_them(halves, tmp_path, name):
    image, truth = halves
    MASKS[name](truth).save(tmp_path / "masks" / name)
    summary, notes = score([image], tmp_path / "masks", tmp_path / "out")
    assert summary["accuracy"] == 1.0 and summary["classes"]["rock"]["pixels"] == 300 and not notes


def test_grey_levels_of_few_bits_are_not_spread(halves, tmp_path):
    """Pillow reads the levels 0, 1, 2 of 2 bits as 0, 85, 170."""
    image, truth = halves
    rows = b"".join(b"\0" + np.packbits(np.unpackbits(row[:, None], axis=1)[:, 6:].ravel()).tobytes() for row in truth)
    chunks = [(b"IHDR", pack(">IIBBBBB", 30, 20, 2, 0, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    (tmp_path / "masks" / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(pack(">I", len(data)) + kind + data + pack(">I", zlib.crc32(kind + data)) for kind, data in chunks)
    )
    assert score([image], tmp_path / "masks", tmp_path / "out")[0]["accuracy"] == 1.0


def test_masks_of_255_and_of_colours_are_named(halves, tmp_path):
    image, truth = halves
    mask = tmp_path / "masks" / "a.png"
    Image.fromarray(np.where(truth == 2, 255, 0).astype(np.uint8)).save(mask)
    summary, notes = score([image], tmp_path / "masks", tmp_path / "out")
    assert summary["classes"]["rock"]["pixels"] == 0
    assert notes == [
        "the masks hold only background and 255 (no label): if 255 stands for a class, say so: "
        "--remap 0 background 255 CLASS"
    ]
    coding = {"remap": {"0": "not rock", "255": "rock"}}
    summary, notes = score([image], tmp_path / "masks", tmp_path / "out", **coding)
    assert summary["accuracy"] == 1.0 and summary["classes"]["rock"]["iou"] == 1.0 and not notes
    Image.fromarray(np.array([[255, 255, 0], [0, 0, 0], [255, 0, 0]], np.uint8)[truth]).save(mask)
    palette = {"rock": "#ff0000", "background": "#ffff00"}
    assert score([image], tmp_path / "masks", tmp_path / "out", palette=palette)[0]["accuracy"] == 1.0


@pytest.mark.parametrize("tag", [3, 6, 8])
def test_a_photograph_is_scored_as_viewers_show_it(halves, tmp_path, tag):
    """The mask is drawn on the upright picture."""
    image, truth = halves
    with Image.open(image) as picture:
        turns = {3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}
        exif = Image.Exif()
        exif[0x0112] = tag
        picture.transpose(turns[tag]).save(tmp_path / "a.jpg", exif=exif, quality=95)
    Image.fromarray(truth).save(tmp_path / "masks" / "a.png")
    assert score([tmp_path / "a.jpg"], tmp_path / "masks", tmp_path / "out")[0]["accuracy"] == 1.0
    assert labels_of(tmp_path / "out" / "a.png").shape == truth.shape
    assert len(rotation_notes([tmp_path / "a.jpg", image])) == 1 and not rotation_notes([image])


LARGE_KINDS = {
    "grey.png": lambda pixels: Image.fromarray(pixels),
    "rgb.jpg": lambda pixels: Image.fromarray(np.stack([pixels] * 3, axis=-1)),
    "deep.tif": lambda pixels: Image.fromarray(pixels.astype(np.uint16) * 16),
    "rgba.webp": lambda pixels: Image.fromarray(np.stack([pixels, pixels, pixels, 0 * pixels + 255], axis=-1)),
    "palette.png": lambda pixels: Image.fromarray(pixels).convert("P"),
    "grey.pgm": lambda pixels: Image.fromarray(pixels),
    "two.png": lambda pixels: Image.fromarray(pixels > 128),
}


@pytest.mark.parametrize("name", LARGE_KINDS)
def test_large_pictures_are_decimated_and_labelled_at_their_own_size(tmp_path, monkeypatch, name):
    monkeypatch.setattr(segmentation, "LARGE_PX", 5000)
    monkeypatch.setattr(segmentation, "OVERVIEW_PX", 40)
    monkeypatch.setattr("jaxmap.runs.large_pictures._BAND_PX", 700)
    pixels = np.full((96, 64), 40, np.uint8)
    pixels[48:] = 220
    (tmp_path / "masks").mkdir()
    image = tmp_path / name
    LARGE_KINDS[name](pixels).save(image)
    Image.fromarray(np.where(pixels > 128, 2, 0).astype(np.uint8)).save(tmp_path / "masks" / f"{image.stem}.png")
    seen = []

    class Small(Fixed):
        size = (24, 16)

        def logits(self, image):
            seen.append(image.shape[:2])
            return super().logits(image)

    lookup = make_mask_lookup(Fixed.classes)
    writer = segmentation.LabelWriter(Small(), tmp_path / "out", lookup, save_logits=True)  # type: ignore[arg-type]
    scores, faults = segmentation.label_images(writer, [image], segmentation.find_masks([image], tmp_path / "masks"))
    assert not faults and seen == [(24, 16)]
    summary = scores.summary()
    assert summary["images"] == 1 and summary["pixels"] == pixels.size and summary["accuracy"] > 0.95
    labels = labels_of(tmp_path / "out" / f"{image.stem}.png")
    assert labels.shape == pixels.shape
    np.testing.assert_array_equal(np.load(tmp_path / "out" / f"{image.stem}_logits.npy").argmax(axis=-1), labels)
    assert labels_of(tmp_path / "out" / f"{image.stem}_overlay.png").shape == (32, 22, 3)


def test_bands_are_what_the_whole_would_be():
    logits = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    bands = [band for _, band in enlarged(logits, (31, 23))]
    whole = np.asarray(resized_output(jax.numpy.asarray(logits[None]), (31, 23))[0])
    np.testing.assert_allclose(np.concatenate(bands), whole, atol=1e-5)


def test_a_picture_too_large_to_be_read_names_its_size_and_the_way_out(tmp_path):
    path = tmp_path / "ortho.tif"
    with rasterio.open(path, "w", driver="GTiff", width=20000, height=9000, count=1, dtype="uint8", sparse_ok=True):
        pass
    lookup = make_mask_lookup(Fixed.classes)
    writer = segmentation.LabelWriter(Fixed(), tmp_path / "out", lookup)  # type: ignore[arg-type]
    _, faults = segmentation.label_images(writer, [path])
    assert re.search(r"is 20000x9000 px, more than .* in .*ortho\.tif; run it smaller with --size", str(faults[0]))


@pytest.mark.slow
def test_more_than_the_memory_is_refused_before_it_is_taken(model, monkeypatch):
    monkeypatch.setattr(segmentation, "LARGE_PX", 100)
    monkeypatch.setattr(segmentation, "available_bytes", lambda: 1000)
    with pytest.raises(JaxmapError, match="56x40 px takes more memory than there is.*--size"):
        segmentation.Segmenter(load_network(model)).logits(seeded_image(*SIZE))


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
