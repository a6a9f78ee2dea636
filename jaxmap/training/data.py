"""Training data: a folder of images and masks, its split, and a check of all files before training begins."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from jaxmap.datasets.images import IMAGE_SUFFIXES, image_rotation_tag, image_size_px, read_image, rotation_notes
from jaxmap.datasets.masks import (
    MASK_SUFFIXES,
    UNNAMED,
    MaskLookup,
    absent_classes,
    make_mask_lookup,
    read_codes,
    read_labels,
    unnamed_codes,
)
from jaxmap.datasets.options import Bits
from jaxmap.datasets.stereo_images import LevelCamera, read_stereo, stereo_paths
from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_text
from jaxmap.models.tensor_files import shortened
from jaxmap.training.options import DataOptions

TRAIN_LIST, VALIDATION_LIST = "train.txt", "val.txt"
MAX_THREADS = 8

Pixels = UInt8[np.ndarray, "H W 3"]
Labels = UInt8[np.ndarray, "H W"]
Files = Mapping[str, Sequence[Path]]
"""The files of each name; in a correct folder, one for each."""
Item = TypeVar("Item")
Result = TypeVar("Result")


class Example(NamedTuple):
    """An image and its mask, as files.

    Attributes:
        name: path of the image below `images/`, without suffix.
        image: the image file.
        mask: the mask file.
        size_px: (height, width) of the image as viewers show it, from its header.
        stereo: folder of `disparity/NAME.png` and `cameras/NAME.json`; None where there are none or none are wanted.
        bits: how many a 16-bit image uses; found in it where None.
    """

    name: str
    image: Path
    mask: Path
    size_px: tuple[int, int]
    stereo: Path | None = None
    bits: Bits | None = None


class TrainingSet(NamedTuple):
    """The examples that a network is trained and validated on.

    Attributes:
        folder: of images and masks.
        classes: names in the order of the labels.
        train: training examples, in order of name.
        validation: validation examples; may be empty.
        lookup: from the pixels of the masks to labels.
        notes: on the split and on rotation tags, for the user.
    """

    folder: Path
    classes: tuple[str, ...]
    train: tuple[Example, ...]
    validation: tuple[Example, ...]
    lookup: MaskLookup
    notes: tuple[str, ...]


def open_training_set(
    folder: Path, classes: Sequence[str], options: DataOptions | None = None, *, seed: int = 0
) -> TrainingSet:
    """Opens a folder of `images/NAME.{png,jpg,...}`, `masks/NAME.png` and, optionally, `train.txt` and `val.txt`.

    Only the headers of the images are read; `check_training_set` reads the rest.

    Args:
        folder: names may be of subfolders (`images/sub/NAME.jpg`, `masks/sub/NAME.png`).
        classes: names in the order of the labels.
        options: what the pixels of the masks stand for, and the share that validates where there is no list.
        seed: of the random split.

    Raises:
        UsageError: faulty classes, remap or palette.
        JaxmapError: files are missing, broken, or do not fit each other.
    """
    folder, options = Path(folder), options or DataOptions()
    lookup = make_mask_lookup(classes, options.remap, options.palette)
    images, masks = find_files(folder / "images", IMAGE_SUFFIXES), find_files(folder / "masks", MASK_SUFFIXES)
    split = split_names(folder, images, masks, validation_share=options.validation_share, seed=seed)

    def examples(names: Sequence[str]) -> tuple[Example, ...]:
        sizes = _in_threads(lambda name: image_size_px(images[name][0], as_shown=True), names)
        return tuple(
            Example(name, images[name][0], masks[name][0], (height, width), bits=options.image_bits)
            for name, (width, height) in zip(names, sizes, strict=True)
        )

    train, validation = examples(split.train), examples(split.validation)
    notes = [*split.notes, *rotation_notes([example.image for example in (*train, *validation)])]
    return TrainingSet(folder, lookup.classes, train, validation, lookup, tuple(notes))


def with_stereo(training_set: TrainingSet) -> TrainingSet:
    """The same examples, with the disparity and the camera of those that have them.

    Raises:
        JaxmapError: an image that has them carries a rotation tag.
    """
    folder = training_set.folder

    def added(examples: tuple[Example, ...]) -> tuple[Example, ...]:
        there = (any(path.exists() for path in stereo_paths(folder, example.name)) for example in examples)
        return tuple(
            example._replace(stereo=folder if found else None) for example, found in zip(examples, there, strict=True)
        )

    result = training_set._replace(train=added(training_set.train), validation=added(training_set.validation))
    for example in (*result.train, *result.validation):
        if example.stereo and image_rotation_tag(example.image) != 1:
            raise JaxmapError(
                "the image has a disparity and a rotation tag",
                where=example.image,
                fix="remove the tag: a disparity belongs to the pixels as they are stored",
            )
    return result


def read_disparity(example: Example) -> tuple[Float32[np.ndarray, "H W"], LevelCamera] | None:
    """The disparity of an image (NaN where unknown) and its camera; None where it has none.

    Raises:
        JaxmapError: a file cannot be read or is missing, or the disparity has another size than the image.
    """
    stereo = None if example.stereo is None else read_stereo(example.stereo, example.name)
    if stereo is not None and example.stereo is not None:
        _check_size(stereo[0], example, "disparity", stereo_paths(example.stereo, example.name)[0])
    return stereo


def read_example(example: Example, lookup: MaskLookup) -> tuple[Pixels, Labels]:
    """Reads an image and its labels; grey images become RGB.

    The rotation tag of a photograph is applied, as labelling programs do: the mask lies on what viewers show.

    Returns:
        image: uint8 (H, W, 3).
        labels: uint8 (H, W): class indices, 255 for none, and 254 for any class but the negated one.

    Raises:
        JaxmapError: a file cannot be read, they differ in size, or a pixel of the mask stands for nothing.
    """
    image = _read_rgb(example)
    labels = read_labels(example.mask, lookup)
    _check_size(labels, example, "mask", example.mask)
    return image, labels


def check_training_set(training_set: TrainingSet) -> Int64[np.ndarray, "2 C"]:
    """Reads every image, mask and disparity once, so that no fault is found hours later.

    Returns:
        Pixels of each class in training (row 0) and in validation (row 1).

    Raises:
        JaxmapError: examples that cannot be read or do not fit, masks with codes that stand for nothing, or
            classes that no training mask holds.
    """
    lookup, parts = training_set.lookup, (training_set.train, training_set.validation)
    examples = [(row, example) for row, part in enumerate(parts) for example in part]
    seen = np.zeros((2, len(lookup.table)), bool)

    def count(entry: tuple[int, Example]) -> np.ndarray:
        row, example = entry
        _read_rgb(example)
        read_disparity(example)
        codes = read_codes(example.mask, lookup)
        _check_size(codes, example, "mask", example.mask)
        # Threads may meet here, but all of them only ever write True.
        seen[row][codes] = True
        return np.bincount(lookup.table[codes].ravel(), minlength=256)

    counts = np.zeros((2, 256), np.int64)
    for (row, _), found in zip(examples, _in_threads(count, examples), strict=True):
        counts[row] += found
    if counts[:, UNNAMED].any():
        unnamed = np.flatnonzero(seen.any(axis=0) & (lookup.table == UNNAMED)).tolist()
        raise unnamed_codes(lookup, unnamed, training_set.folder / "masks")
    counts = counts[:, : len(lookup.classes)]
    if absent := [name for name, pixels in zip(lookup.classes, counts[0], strict=True) if not pixels]:
        raise absent_classes(lookup, absent, seen[0], training_set.folder / "masks")
    return counts


def digest(training_set: TrainingSet) -> str:
    """A fingerprint of classes, mask lookup, names, image sizes, file sizes and split, which a resumed run must share.

    The path of the folder and unused files do not enter it.

    Raises:
        JaxmapError: a file is missing.
    """
    text = hashlib.sha256(training_set.lookup.table.tobytes())
    text.update(repr((training_set.classes, training_set.lookup.kind, training_set.lookup.negated)).encode())
    for part in (training_set.train, training_set.validation):
        text.update(f"{len(part)}\n".encode())
        for example in part:
            stereo = () if example.stereo is None else stereo_paths(example.stereo, example.name)
            sizes = (*example.size_px, *map(_file_size, (example.image, example.mask, *stereo)))
            sizes += () if example.bits is None else (example.bits,)
            text.update(os.fsencode(f"{example.name}\0{sizes}\n"))
    return text.hexdigest()


def _read_rgb(example: Example) -> Pixels:
    image = read_image(example.image, bits=example.bits, as_shown=True)
    if image.shape[:2] != example.size_px:
        raise JaxmapError(
            f"the image is {image.shape[1]}x{image.shape[0]} px, and was {example.size_px[1]}x{example.size_px[0]} px",
            where=example.image,
            fix="leave the data alone while it is trained on",
        )
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


def _check_size(pixels: np.ndarray, example: Example, kind: str, where: Path) -> None:
    if pixels.shape != example.size_px:
        (height, width), (rows, columns) = example.size_px, pixels.shape
        fix = f"give each {kind} the size of its image"
        if pixels.shape == (width, height) and (tag := image_rotation_tag(example.image)) > 4:
            fix = f"the image's rotation tag {tag} turns it: turn the {kind}, too, or remove the tag"
        raise JaxmapError(f"the {kind} is {columns}x{rows} px, the image {width}x{height} px", where=where, fix=fix)


def _in_threads(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """The result of each item, in order; Pillow and NumPy let threads run side by side.

    Raises:
        JaxmapError: items failed; the first is reported, the others are counted.
    """
    threads = ThreadPoolExecutor(min(MAX_THREADS, os.cpu_count() or 1))
    try:
        futures = [threads.submit(work, item) for item in items]
        for future in as_completed(futures):
            if not isinstance(future.exception(), JaxmapError | None):
                future.result()
    finally:
        # An interrupted check must not continue to the last file.
        threads.shutdown(cancel_futures=True)
    faults = [fault for future in futures if isinstance(fault := future.exception(), JaxmapError)]
    if len(faults) > 1:
        first, others = faults[0], shortened([Path(fault.where).name for fault in faults[1:]])
        what = f"{first.what} (and {len(faults) - 1} more are faulty: {others})"
        raise JaxmapError(what, where=first.where, fix=first.fix)
    if faults:
        raise faults[0]
    return [future.result() for future in futures]


def _file_size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as fault:
        raise JaxmapError(f"the file cannot be read ({fault.strerror})", where=path, fix="restore the file") from fault


class Split(NamedTuple):
    """Sorted names of training and validation, and notes on how they were chosen."""

    train: tuple[str, ...]
    validation: tuple[str, ...]
    notes: tuple[str, ...]


def find_files(folder: Path, suffixes: Sequence[str]) -> Files:
    """The files with one of these suffixes in a folder and its subfolders, by path without suffix (`sub/NAME`).

    Hidden files and folders are skipped, and links to folders are not followed.

    Raises:
        JaxmapError: the folder is missing, cannot be read, or holds none.
    """
    found: dict[str, list[Path]] = {}

    def refuse(fault: OSError) -> None:
        fix = "training data is a folder of images/NAME.jpg and masks/NAME.png"
        raise JaxmapError(f"the folder cannot be read ({fault.strerror})", where=folder, fix=fix) from fault

    for place, subfolders, files in os.walk(folder, onerror=refuse):
        subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
        for path in (Path(place, name) for name in sorted(files) if not name.startswith(".")):
            if path.suffix.lower() in suffixes:
                found.setdefault(path.relative_to(folder).with_suffix("").as_posix(), []).append(path)
    if not found:
        raise JaxmapError(f"no {suffixes[0]} file", where=folder, fix=f"put files there ({' '.join(suffixes)})")
    return found


def split_names(folder: Path, images: Files, masks: Files, *, validation_share: float, seed: int) -> Split:
    """Splits the images of a folder into training and validation.

    `train.txt` and `val.txt` list names; with only one of them, the remaining images are the other part; without
    either, a share of the images validates, drawn at random.

    Args:
        folder: of the lists.
        images: the image files by name.
        masks: the mask files by name.
        validation_share: share of the images that validates where there is no list, in [0, 1).
        seed: of the draw, which otherwise depends on the names alone.

    Raises:
        JaxmapError: a list cannot be read, or names and files do not fit; all faults are reported together.
    """
    problems: list[str] = []
    for kind, files in (("images", images), ("masks", masks)):
        twice = [f"{name} ({', '.join(path.name for path in paths)})" for name, paths in files.items() if paths[1:]]
        problems += [f"{_count(twice, 'name')} of several {kind}: {shortened(twice)}"] if twice else []
    train, validation = (_listed(folder / name, images, problems) for name in (TRAIN_LIST, VALIDATION_LIST))
    if train is None and validation is None:
        split = _drawn(images, validation_share, seed)
    else:
        split = _by_lists(train, validation, images)
    if twice := sorted(set(split.train) & set(split.validation)):
        problems.append(f"{_count(twice, 'name')} in both {TRAIN_LIST} and {VALIDATION_LIST}: {shortened(twice)}")
    used = {*split.train, *split.validation}
    if bare := sorted(used - masks.keys()):
        problems.append(f"{_count(bare, 'image')} without a mask: {shortened(bare)}")
    # Where both lists name what is used, the rest does not matter.
    if (train is None or validation is None) and (stray := sorted(masks.keys() - images.keys())):
        problems.append(f"{_count(stray, 'mask')} without an image: {shortened(stray)}")
    if not split.train and not problems:
        problems.append("no image is left to train on")
    if problems:
        fix = f"each images/NAME needs a masks/NAME.png, each name stands once in {TRAIN_LIST} or {VALIDATION_LIST}"
        raise JaxmapError("; ".join(problems), where=folder, fix=fix)
    return split


def _listed(path: Path, images: Files, problems: list[str]) -> list[str] | None:
    """The names of a list, or None where there is no list; its faults are added to `problems`."""
    if not path.exists():
        return None
    lines = read_text(path).splitlines()
    texts = [text for line in lines if (text := re.split(r"(?:^|\s)#", line)[0].strip())]
    names = [_without_suffix(text, images) for text in texts]
    if unknown := sorted({name for name in names if name not in images}):
        problems.append(f"{_count(unknown, 'name')} without an image in {path.name}: {shortened(unknown)}")
    if twice := sorted(name for name, times in Counter(names).items() if times > 1):
        problems.append(f"{_count(twice, 'name')} listed twice in {path.name}: {shortened(twice)}")
    return [name for name in names if name in images]


def _without_suffix(text: str, images: Files) -> str:
    """The name on a line, which may have the suffix of the image."""
    stem, dot, suffix = text.rpartition(".")
    return stem if text not in images and f"{dot}{suffix}".lower() in IMAGE_SUFFIXES else text


def _by_lists(train: list[str] | None, validation: list[str] | None, images: Files) -> Split:
    listed = {*(train or ()), *(validation or ())}
    rest = sorted(images.keys() - listed)
    notes = []
    if train is not None and validation is not None and rest:
        notes.append(f"{_count(rest, 'image')} in neither {TRAIN_LIST} nor {VALIDATION_LIST}: not used")
    parts = [tuple(rest if names is None else sorted(set(names))) for names in (train, validation)]
    if not parts[1]:
        notes.append("no image validates")
    return Split(parts[0], parts[1], tuple(notes))


def _drawn(images: Iterable[str], share: float, seed: int) -> Split:
    names = sorted(images)
    count = min(max(round(share * len(names)), 1), len(names) - 1) if share > 0 else 0
    # By hashes, so that adding images hardly changes the split of the others.
    chosen = set(sorted(names, key=lambda name: hashlib.sha256(os.fsencode(f"{seed}/{name}")).digest())[:count])
    note = f"{count} of {len(names)} images validate, drawn by seed {seed}" if count else "no image validates"
    train, validation = (tuple(name for name in names if (name in chosen) == flag) for flag in (False, True))
    return Split(train, validation, (note,))


def _count(items: Sequence[object], noun: str) -> str:
    return f"{len(items)} {noun}{'' if len(items) == 1 else 's'}"
