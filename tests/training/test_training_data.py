"""Training data: splits, what masks stand for, and every way a folder can be wrong."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from jaxmap.datasets.masks import UNNAMED, make_mask_lookup, meaning, read_labels
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.labels import IGNORE
from jaxmap.training.data import check_training_set, digest, open_training_set, read_example, split_names
from jaxmap.training.options import DataOptions

CLASSES = ("sand", "rock")
NAMES = ("a", "b", "c", "deep/d", "deep/e")


def write_mask(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def write_example(folder: Path, name: str, mask: np.ndarray, suffix: str = "jpg") -> None:
    image = np.random.default_rng(len(name)).integers(0, 256, (*mask.shape[:2], 3), np.uint8)
    write_mask(folder / "images" / f"{name}.{suffix}", image)
    write_mask(folder / "masks" / f"{name}.png", mask)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Five examples of different sizes whose masks hold 0, 1 and 255."""
    for index, name in enumerate(NAMES):
        mask = np.zeros((12 + index, 20), np.uint8)
        mask[:4], mask[-1] = 1, IGNORE
        write_example(tmp_path / "set", name, mask)
    return tmp_path / "set"


def names(examples) -> tuple[str, ...]:
    return tuple(example.name for example in examples)


def lists(folder: Path, train: str | None = None, validation: str | None = None) -> None:
    for file, text in (("train.txt", train), ("val.txt", validation)):
        if text is not None:
            (folder / file).write_text(text, encoding="utf-8")


def error_of(folder: Path, classes=CLASSES, *, check: bool = True, **options) -> str:
    with pytest.raises(JaxmapError) as caught:
        opened = open_training_set(folder, classes, DataOptions(**options))
        if check:
            check_training_set(opened)
    return str(caught.value).replace(str(folder), "SET")


# --- splits


def test_lists_take_names_with_or_without_suffix_blank_lines_and_comments(folder) -> None:
    lists(folder, "\ufeff# the training images\na\n\n  b.jpg  # the good one\n", "c\ndeep/d\n#e\n")
    opened = open_training_set(folder, CLASSES)
    assert names(opened.train) == ("a", "b") and names(opened.validation) == ("c", "deep/d")
    assert opened.notes == ("1 image in neither train.txt nor val.txt: not used",)


def test_a_name_may_end_like_a_suffix(folder) -> None:
    write_example(folder, "f.png", np.ones((4, 4), np.uint8))
    lists(folder, "f.png\na.jpg\n")
    assert names(open_training_set(folder, CLASSES).train) == ("a", "f.png")


def test_one_list_leaves_the_rest_to_the_other_part(folder) -> None:
    lists(folder, train="a\nb\n")
    opened = open_training_set(folder, CLASSES)
    assert names(opened.train) == ("a", "b") and names(opened.validation) == ("c", "deep/d", "deep/e")
    (folder / "train.txt").rename(folder / "val.txt")
    opened = open_training_set(folder, CLASSES)
    assert names(opened.train) == ("c", "deep/d", "deep/e") and names(opened.validation) == ("a", "b")


def test_sizes_are_height_and_width_of_the_headers(folder) -> None:
    opened = open_training_set(folder, CLASSES, DataOptions(validation_share=0))
    assert [example.size_px for example in opened.train] == [(12 + index, 20) for index in range(5)]
    assert opened.validation == () and opened.notes == ("no image validates",)


def test_what_neither_list_names_needs_no_partner(folder) -> None:
    lists(folder, "a\n", "b\n")
    (folder / "masks/c.png").unlink()
    (folder / "images/deep/d.jpg").unlink()
    assert check_training_set(open_training_set(folder, CLASSES)).sum() > 0


file_names = st.sets(st.text("abcxyz019_", min_size=1, max_size=4), min_size=1, max_size=30)


@given(file_names, st.floats(0, 1, exclude_max=True), st.integers(0, 5))
def test_the_draw_divides_the_images(tmp_path_factory, chosen, share, seed) -> None:
    files = {name: [Path(f"{name}.png")] for name in chosen}
    split = split_names(Path("nowhere"), files, files, validation_share=share, seed=seed)
    assert split == split_names(
        Path("elsewhere"), dict(reversed(files.items())), files, validation_share=share, seed=seed
    )
    assert sorted(split.train + split.validation) == sorted(chosen)
    assert list(split.train) == sorted(split.train) and split.train
    assert abs(len(split.validation) - share * len(chosen)) <= 1
    assert bool(split.validation) == (share > 0 and len(chosen) > 1)


@given(file_names, st.text("AB", min_size=1, max_size=3), st.integers(0, 5))
def test_one_more_image_moves_at_most_one_other(chosen, extra, seed) -> None:
    def validating(names) -> set[str]:
        files = {name: [Path(name)] for name in names}
        return set(split_names(Path("nowhere"), files, files, validation_share=0.3, seed=seed).validation)

    assert len((validating(chosen) ^ validating({*chosen, extra})) - {extra}) <= 1


def test_another_seed_draws_others() -> None:
    files = {f"{index:03}": [Path(f"{index}.png")] for index in range(100)}
    drawn = {
        split_names(Path("nowhere"), files, files, validation_share=0.2, seed=seed).validation for seed in range(5)
    }
    assert len(drawn) == 5


# --- masks


def slow_labels(pixels, meanings, classes, rest=None) -> np.ndarray:
    """Looks up one pixel after the other."""
    numbers = {**{name: index for index, name in enumerate(classes)}, "ignore": IGNORE}
    labels = np.empty(pixels.shape[:2], np.uint8)
    for row, column in np.ndindex(labels.shape):
        pixel = pixels[row, column]
        key = tuple(map(int, pixel)) if pixel.ndim else int(pixel)
        labels[row, column] = numbers[meanings.get(key, rest)]
    return labels


@given(st.data())
def test_values_are_looked_up_one_by_one(tmp_path_factory, data) -> None:
    classes = ("a", "b", "c")
    meanings = data.draw(st.dictionaries(st.integers(0, 65535), st.sampled_from([*classes, "ignore"]), min_size=1))
    rest = data.draw(st.sampled_from([*classes, "ignore"]))
    meanings |= {70000 + index: name for index, name in enumerate(classes)}  # Every class is named somewhere.
    meanings = {key if key < 65536 else key - 70000: name for key, name in meanings.items()}
    pixels = np.array(data.draw(st.lists(st.sampled_from([*meanings, 3, 65535]), min_size=6, max_size=6)), np.uint16)
    write_mask(path := tmp_path_factory.mktemp("mask") / "m.png", pixels.reshape(2, 3))
    remap = {**{(str(key) if key % 2 else key): name for key, name in meanings.items()}, "*": rest}
    labels = read_labels(path, make_mask_lookup(classes, remap, None))
    np.testing.assert_array_equal(labels, slow_labels(pixels.reshape(2, 3), meanings, classes, rest))


channel = st.integers(0, 255)


@given(st.lists(st.tuples(channel, channel, channel), min_size=4, max_size=8, unique=True), st.integers(0, 99))
def test_colours_are_looked_up_one_by_one(tmp_path_factory, colours, seed) -> None:
    classes = ("a", "b", "c")
    meanings = dict(zip(colours, ["a", "b", "c", "ignore", "a", "b", "c", "ignore"], strict=False))
    pixels = np.array(colours, np.uint8)[np.random.default_rng(seed).integers(0, len(colours), (3, 5))]
    palette = {
        name: " ".join("#{:02x}{:02x}{:02X}".format(*key) for key, own in meanings.items() if own == name)
        for name in classes
    }
    palette["ignore"] = "#{:02x}{:02x}{:02x}".format(*colours[3]) if len(colours) < 8 else "*"
    write_mask(path := tmp_path_factory.mktemp("mask") / "m.png", pixels)
    labels = read_labels(path, make_mask_lookup(classes, None, palette))
    np.testing.assert_array_equal(labels, slow_labels(pixels, meanings, classes))


def test_no_lookup_means_class_indices() -> None:
    table = make_mask_lookup(CLASSES, None, None).table
    assert table[0] == 0 and table[1] == 1 and table[IGNORE] == IGNORE
    assert (np.delete(table, [0, 1, IGNORE]) == UNNAMED).all()


@pytest.mark.parametrize("mode", ["1", "L", "P", "LA", "PA", "RGB", "RGBA", "I;16", "I"])
def test_the_same_values_in_any_mode(tmp_path, mode) -> None:
    values = np.array([[0, 1, 1], [1, 0, 0]], np.uint8)
    image = Image.fromarray(values)
    if mode == "1":
        image = Image.fromarray(values.astype(bool))
    elif mode in ("P", "PA"):
        image.putpalette([9, 9, 9, 200, 3, 3])
        image = image if mode == "P" else image.convert("PA")
    elif mode != "L":
        image = image.convert(mode)
    path = tmp_path / "m.png"
    # PNG has neither; readers go by content, not by suffix.
    image.save(path, "tiff" if mode in ("PA", "I") else "png")
    np.testing.assert_array_equal(read_labels(path, make_mask_lookup(CLASSES, None, None)), values)


def test_masks_may_say_what_a_pixel_is_not(folder) -> None:
    values = np.array([[0, 1, 2], [7, 255, 1]], np.uint8)
    write_mask(folder / "m.png", values)
    remap = {"0": "sand", "1": "rock", "2": "not rock", "7": "not rock", "255": "ignore"}
    lookup = make_mask_lookup(CLASSES, remap, None)
    assert lookup.negated == 1 and meaning(lookup, 7) == "not rock"
    np.testing.assert_array_equal(read_labels(folder / "m.png", lookup), [[0, 1, 254], [254, 255, 1]])
    coloured = make_mask_lookup(CLASSES, None, {"sand": "#010101", "rock": "#020202", "not sand": "*"})
    assert coloured.negated == 0 and coloured.table[9] == 254


def test_what_a_pixel_is_not_counts_for_no_class(folder) -> None:
    mask = np.array(Image.open(folder / "masks/a.png"))
    mask[4:6] = 9
    write_mask(folder / "masks/a.png", mask)
    remap = {"0": "sand", "1": "rock", "9": "not rock", "255": "ignore"}
    opened = open_training_set(folder, CLASSES, DataOptions(validation_share=0, remap=remap))
    labels = np.concatenate([read_example(example, opened.lookup)[1].ravel() for example in opened.train])
    assert check_training_set(opened)[0].tolist() == [(labels == index).sum() for index in range(2)]
    assert (labels == 254).sum() == 40


def test_a_palette_image_is_looked_up_by_its_colours_too(tmp_path) -> None:
    image = Image.fromarray(np.array([[0, 1], [1, 0]], np.uint8))
    image.putpalette([9, 9, 9, 200, 3, 3])
    image.save(tmp_path / "m.png")
    lookup = make_mask_lookup(CLASSES, None, {"sand": "#c80303", "rock": "#090909"})
    np.testing.assert_array_equal(read_labels(tmp_path / "m.png", lookup), [[1, 0], [0, 1]])


# --- examples, check, digest


def test_examples_are_rgb_and_labels(folder) -> None:
    write_mask(folder / "images/a.jpg", np.full((12, 20), 90, np.uint8))
    opened = open_training_set(folder, CLASSES, DataOptions(validation_share=0))
    image, labels = read_example(opened.train[0], opened.lookup)
    assert image.shape == (12, 20, 3) and image.dtype == np.uint8 and image.flags.c_contiguous
    assert (image == 90).all()
    assert labels.dtype == np.uint8 and set(np.unique(labels)) == {0, 1, IGNORE}


@pytest.mark.parametrize(("tag", "turn"), [(3, Image.Transpose.ROTATE_180), (6, Image.Transpose.ROTATE_90)])
def test_a_photograph_is_taken_as_viewers_show_it(folder, tag, turn) -> None:
    """The mask is drawn on the upright picture, whose upper rows are bright."""
    exif = Image.Exif()
    exif[0x0112] = tag
    upright = np.zeros((12, 20, 3), np.uint8)
    upright[:4] = 200
    Image.fromarray(upright).transpose(turn).save(folder / "images/a.jpg", exif=exif, quality=95)
    opened = open_training_set(folder, CLASSES, DataOptions(validation_share=0))
    assert opened.train[0].size_px == (12, 20)
    image, labels = read_example(opened.train[0], opened.lookup)
    assert image.shape == (12, 20, 3) and (image[labels == 1] > 100).mean() > 0.9
    assert opened.notes[1].startswith("1 of 5 images carry a rotation tag (a.jpg) and are turned")


def test_a_mask_on_the_stored_pixels_of_a_turned_photograph_is_refused(folder) -> None:
    exif = Image.Exif()
    exif[0x0112] = 8
    Image.new("RGB", (20, 12), (1, 2, 3)).save(folder / "images/a.jpg", exif=exif)
    assert error_of(folder) == (
        "the mask is 20x12 px, the image 12x20 px in SET/masks/a.png; the image's rotation tag 8 turns it: "
        "turn the mask, too, or remove the tag"
    )


@pytest.mark.parametrize("suffix", ["PNG", "tif", "bmp"])
def test_masks_may_have_other_suffixes(folder, suffix) -> None:
    with Image.open(folder / "masks/a.png") as mask:
        mask.save(folder / f"masks/a.{suffix}")
    (folder / "masks/a.png").unlink()
    assert check_training_set(open_training_set(folder, CLASSES)).sum() > 0


def test_the_check_counts_every_pixel_once(folder) -> None:
    lists(folder, "a\nb\nc\n")
    opened = open_training_set(folder, CLASSES)
    counts = check_training_set(opened)
    assert counts.dtype == np.int64
    for row, part in enumerate((opened.train, opened.validation)):
        labels = np.concatenate([read_example(example, opened.lookup)[1].ravel() for example in part])
        assert counts[row].tolist() == [(labels == index).sum() for index in range(2)]
        assert counts[row].sum() + 20 * len(part) == labels.size  # The last line of each is ignored.


def test_a_class_that_only_validation_lacks_is_no_fault(folder) -> None:
    write_mask(folder / "masks/a.png", np.zeros((12, 20), np.uint8))
    lists(folder, validation="a\n")
    assert check_training_set(open_training_set(folder, CLASSES))[1].tolist() == [240, 0]


def test_the_digest_knows_what_a_resumed_run_must_share(folder, tmp_path) -> None:
    def of(place: Path, classes=CLASSES, **options) -> str:
        return digest(open_training_set(place, classes, DataOptions(**options)))

    first = of(folder)
    moved = Path(shutil.copytree(folder, tmp_path / "moved"))
    assert of(moved) == first
    others = [
        of(moved, ("sand", "stone")),
        of(moved, validation_share=0.5),
        of(moved, remap={0: "sand", 1: "rock", 255: "ignore"}),
    ]
    write_mask(moved / "masks/a.png", np.random.default_rng(0).integers(0, 2, (12, 20), np.uint8))
    others.append(of(moved))
    (moved / "images/a.jpg").rename(moved / "images/A.jpg")
    (moved / "masks/a.png").rename(moved / "masks/A.png")
    others.append(of(moved))
    assert len({first, *others}) == 6


# --- faults

PARTNERS = "each images/NAME needs a masks/NAME.png, each name stands once in train.txt or val.txt"


def test_names_that_do_not_fit_are_reported_together(folder) -> None:
    shutil.copy(folder / "images/a.jpg", folder / "images/a.jpeg")
    (folder / "masks/b.png").unlink()
    write_mask(folder / "masks/z.png", np.zeros((3, 3), np.uint8))
    lists(folder, "a\nb\nb\nq\nr\ns\nt\nu\n")
    lists(folder, validation=None)
    assert error_of(folder) == (
        "1 name of several images: a (a.jpeg, a.jpg); 5 names without an image in train.txt: q, r, s and 2 more; "
        "1 name listed twice in train.txt: b; 1 image without a mask: b; 1 mask without an image: z in SET; " + PARTNERS
    )


FAULTY_LISTS = {
    "a\nb\n|b\nc\n": "1 name in both train.txt and val.txt: b in SET; " + PARTNERS,
    "# nothing\n|b\n": "no image is left to train on in SET; " + PARTNERS,
    "masks/a\n|b\n": "1 name without an image in train.txt: masks/a in SET; " + PARTNERS,
}


@pytest.mark.parametrize(("texts", "expected"), FAULTY_LISTS.items(), ids=FAULTY_LISTS)
def test_faulty_lists(folder, texts, expected) -> None:
    lists(folder, *texts.split("|"))
    assert error_of(folder) == expected


def test_unreadable_lists(folder) -> None:
    (folder / "train.txt").write_bytes(b"a\n\xff\xfe\n")
    assert error_of(folder).startswith("not a text file") and "in SET/train.txt" in error_of(folder)
    (folder / "train.txt").unlink()
    (folder / "val.txt").mkdir()
    assert error_of(folder).endswith("in SET/val.txt; give a regular file")


def test_missing_and_empty_folders(folder, tmp_path) -> None:
    assert error_of(tmp_path / "nowhere") == (
        "the folder cannot be read (No such file or directory) in SET/images; "
        "training data is a folder of images/NAME.jpg and masks/NAME.png"
    )
    shutil.rmtree(folder / "masks")
    (folder / "masks/.hidden").mkdir(parents=True)
    write_mask(folder / "masks/.hidden/a.png", np.zeros((3, 3), np.uint8))
    write_mask(folder / "masks/._a.png", np.zeros((3, 3), np.uint8))
    assert error_of(folder) == "no .png file in SET/masks; put files there (.png .tif .tiff .bmp)"


def truncate(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.7)])


def big(path: Path) -> None:
    write_mask(path, np.zeros((13, 20), np.uint8))


def junk(path: Path) -> None:
    path.write_bytes(bytes(range(256)))


def empty(path: Path) -> None:
    path.write_bytes(b"")


def coloured(path: Path) -> None:
    write_mask(path, np.random.default_rng(0).integers(0, 2, (12, 20, 3), np.uint8))


def three(path: Path) -> None:
    write_mask(path, np.full((12, 20), 3, np.uint8))


def deep(path: Path) -> None:
    Image.fromarray(np.full((12, 20), 70000, np.int32)).save(path, "tiff")


FAULTY_FILES = [
    (
        "masks/a.png",
        big,
        "the mask is 20x13 px, the image 20x12 px in SET/masks/a.png; give each mask the size of its image",
    ),
    (
        "masks/a.png",
        junk,
        "not an image of a known format in SET/masks/a.png; give PNG, JPEG, TIFF, BMP, PGM, PPM or WebP",
    ),
    (
        "masks/a.png",
        empty,
        "not an image of a known format in SET/masks/a.png; give PNG, JPEG, TIFF, BMP, PGM, PPM or WebP",
    ),
    (
        "masks/a.png",
        truncate,
        "the mask cannot be read (.*) in SET/masks/a.png; replace it by a whole one of 8 or 16 bits",
    ),
    (
        "masks/a.png",
        coloured,
        "the mask is in colour in SET/masks/a.png; say which colour is which class: --data.palette CLASS '#rrggbb' ...",
    ),
    ("masks/a.png", deep, "the mask holds no values of 8 or 16 bits in SET/masks/a.png; write it as 8-bit grey"),
    (
        "images/a.jpg",
        junk,
        "not an image of a known format in SET/images/a.jpg; give PNG, JPEG, TIFF, BMP, PGM, PPM or WebP",
    ),
    (
        "images/a.jpg",
        truncate,
        "the image cannot be read (.*) in SET/images/a.jpg; replace it by a whole one of 8 or 16 bits",
    ),
    (
        "masks/a.png",
        three,
        "the values 3 are no class (0 to 1, and 255 for none) in SET/masks; give all --classes in order, "
        "or say what each value stands for: --data.remap VALUE CLASS ...",
    ),
]


@pytest.mark.parametrize(
    ("file", "damage", "expected"), FAULTY_FILES, ids=[f"{f} {d.__name__}" for f, d, _ in FAULTY_FILES]
)
def test_faulty_files(folder, file, damage, expected) -> None:
    damage(folder / file)
    error = error_of(folder)
    before, _, after = expected.partition(".*")
    assert error.startswith(before) and error.endswith(after)


def test_faulty_files_are_reported_together(folder) -> None:
    for name in ("a", "c", "deep/d"):
        big(folder / f"masks/{name}.png")
    assert error_of(folder, validation_share=0) == (
        "the mask is 20x13 px, the image 20x12 px (and 2 more are faulty: c.png, d.png) in SET/masks/a.png; "
        "give each mask the size of its image"
    )


def test_reading_names_the_file_and_its_values(folder) -> None:
    opened = open_training_set(folder, CLASSES, DataOptions(validation_share=0))
    mask = np.zeros((12, 20), np.uint8)
    mask[0, :3] = (7, 2, 200)
    write_mask(folder / "masks/a.png", mask)
    with pytest.raises(JaxmapError, match="the values 2, 7, 200 are no class .* in .*a.png; give all"):
        read_example(opened.train[0], opened.lookup)
    (folder / "masks/a.png").unlink()
    with pytest.raises(JaxmapError, match="the mask is missing in .*a.png; restore the file"):
        read_example(opened.train[0], opened.lookup)
    with pytest.raises(JaxmapError, match="the file cannot be read .* in .*a.png; restore"):
        digest(opened)
    big(folder / "images/a.jpg")
    with pytest.raises(JaxmapError, match="the image is 20x13 px, and was 20x12 px in .*a.jpg; leave the data alone"):
        read_example(opened.train[0], opened.lookup)


def test_errors_say_how_binary_masks_of_0_and_255_are_read(folder) -> None:
    for name in NAMES:
        path = folder / f"masks/{name}.png"
        write_mask(path, np.where(np.array(Image.open(path)) == 1, 255, 0).astype(np.uint8))
    assert error_of(folder) == (
        "no pixel of the training masks is rock; they hold 0 (sand), 255 (ignore) in SET/masks; "
        "if 255 stands for rock, say so: --data.remap 0 sand 255 rock"
    )
    opened = open_training_set(folder, CLASSES, DataOptions(remap={"0": "sand", "255": "rock"}))
    assert (check_training_set(opened).sum(axis=0) > 0).all()


def test_a_class_that_is_absent(folder) -> None:
    assert error_of(folder, (*CLASSES, "sky", "rover")) == (
        "no pixel of the training masks is sky, rover; they hold 0 (sand), 1 (rock), 255 (ignore) in SET/masks; "
        "train on images that show sky, leave it out of --classes, or correct --data.remap"
    )
    palette = {"sand": "#010101", "rock": "#123456", "ignore": "*"}
    assert error_of(folder, palette=palette).startswith(
        "no pixel of the training masks is rock; they hold #000000 (ignore), #010101 (sand), #ffffff (ignore) in SET"
    )


def test_values_and_colours_that_are_not_named(folder) -> None:
    assert error_of(folder, remap={0: "sand", 9: "rock"}) == (
        '--data.remap does not name the values 1, 255 in SET/masks; name them, or "*" for the rest'
    )
    assert error_of(folder, palette={"sand": "#000000", "rock": "#010101"}) == (
        '--data.palette does not name the colours #ffffff in SET/masks; name them, or give "*" to one class'
    )


WRONG_OPTIONS = [
    (dict(remap={0: "sand"}), "nothing stands for rock in --data.remap; name every class"),
    (
        dict(remap={0: "sand", 1: "stone"}),
        "unknown class stone in --data.remap; the classes are sand, rock; not CLASS and ignore are known, too",
    ),
    (dict(remap={"x": "sand"}), "'x' is no value of a mask in --data.remap; give 0 to 65535, or \"*\""),
    (dict(remap={-1: "sand"}), "'-1' is no value of a mask in --data.remap; give 0 to 65535, or \"*\""),
    (dict(remap={65536: "sand"}), "'65536' is no value of a mask in --data.remap; give 0 to 65535, or \"*\""),
    (dict(remap={1: "sand", "01": "rock"}), "two classes for the value 01 in --data.remap; name it once"),
    (
        dict(remap={1: "sand"}, palette={"sand": "#000000"}),
        "masks have either values or colours in --data.palette; leave out --data.remap",
    ),
    (dict(palette={"sand": "red"}), "'red' is no colour in --data.palette; give #rrggbb"),
    (
        dict(palette={"sand": (0, 0, 256)}),
        "data.palette.sand is (0, 0, 256): input should be a valid string; choose a valid value",
    ),
    (
        dict(palette={"sand": "#00000f", "rock": "#00000F"}),
        "sand and rock share #00000f in --data.palette; a colour is one class's",
    ),
    (dict(palette={"sand": "*", "rock": "*"}), '"*" is given to sand and rock in --data.palette; give it to one'),
    (dict(palette={"sand": "#000000"}), "nothing stands for rock in --data.palette; name every class"),
    (dict(validation_share=1.0), "data.validation_share is 1.0: input should be less than 1; choose a valid value"),
    (
        dict(validation_share=float("nan")),
        "data.validation_share is nan: input should be a finite number; choose a valid value",
    ),
    (dict(classes=()), "faulty classes (none) in --classes; give 1 to 253 different names"),
    (dict(classes=("a", "a")), "faulty classes a, a in --classes; give 1 to 253 different names"),
    (
        dict(remap={0: "sand", 1: "rock", 2: "not rock", 3: "not sand"}),
        "several classes are negated: not rock, not sand in --data.remap; negate one of them",
    ),
    (
        dict(classes=("rock",), remap={0: "not rock", 1: "rock"}),
        "not rock leaves no class in --data.remap; name the others in --classes",
    ),
    (dict(classes=("a", "ignore")), "no class can be called ignore in --classes; name it otherwise"),
]


@pytest.mark.parametrize(
    ("options", "expected"), WRONG_OPTIONS, ids=[text.split(" in ")[0] for _, text in WRONG_OPTIONS]
)
def test_wrong_options_are_reported(folder, options, expected) -> None:
    with pytest.raises(UsageError) as caught:
        open_training_set(folder, options.pop("classes", CLASSES), DataOptions(**options))
    assert str(caught.value) == expected


@given(st.binary(max_size=300), st.sampled_from(["images/a.jpg", "masks/a.png", "train.txt"]), st.integers(0, 400))
def test_damage_never_raises_anything_else(tmp_path_factory, content, file, at) -> None:
    folder = tmp_path_factory.mktemp("set")
    write_example(folder, "a", np.array([[0, 1], [1, 0]], np.uint8))
    whole = (folder / file).read_bytes() if (folder / file).exists() else b""
    (folder / file).write_bytes(whole[:at] + content + whole[at + len(content) :])
    try:
        opened = open_training_set(folder, CLASSES)
        check_training_set(opened)
        assert [read_example(example, opened.lookup)[1].shape for example in opened.train] == [(2, 2)]
    except JaxmapError as error:
        assert error.what and error.fix and error.where
