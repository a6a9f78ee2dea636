"""Training data: a folder of images and masks, checked whole before the long work starts."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Int64, UInt8

from jaxmap.datasets.images import IMAGE_SUFFIXES, image_size_px, read_image
from jaxmap.errors import JaxmapError
from jaxmap.models.tensor_files import shortened
from jaxmap.training.masks import (
    UNNAMED,
    Colour,
    MaskLookup,
    absent_classes,
    make_mask_lookup,
    read_codes,
    read_labels,
    unnamed_codes,
)
from jaxmap.training.splits import Files, find_files, split_names

MASK_SUFFIXES = (".png",)
MAX_THREADS = 8

Pixels = UInt8[np.ndarray, "H W 3"]
Labels = UInt8[np.ndarray, "H W"]
Item = TypeVar("Item")
Result = TypeVar("Result")


class Example(NamedTuple):
    """An image and its mask, not read yet.

    Attributes:
        name: path of the image below `images/`, without suffix.
        image: the image file.
        mask: the mask file.
        size_px: (height, width) of the image, from its header.
    """

    name: str
    image: Path
    mask: Path
    size_px: tuple[int, int]


class TrainingSet(NamedTuple):
    """What a network is trained on.

    Attributes:
        folder: where it lies.
        classes: names in the order of the labels.
        train: examples in order of name.
        validation: those that only score; may be none.
        lookup: what the pixels of the masks stand for.
        notes: what should be known about how the examples were chosen.
    """

    folder: Path
    classes: tuple[str, ...]
    train: tuple[Example, ...]
    validation: tuple[Example, ...]
    lookup: MaskLookup
    notes: tuple[str, ...]


def open_training_set(
    folder: Path,
    classes: Sequence[str],
    *,
    remap: Mapping[int | str, str] | None = None,
    palette: Mapping[str, Colour] | None = None,
    validation_share: float = 0.2,
    seed: int = 0,
) -> TrainingSet:
    """Opens a folder of `images/NAME.{png,jpg,...}`, `masks/NAME.png` and, if wanted, `train.txt` and `val.txt`.

    Only the headers of the images are read; `check_training_set` reads the rest.

    Args:
        folder: where they lie; names may be of subfolders (`images/sub/NAME.jpg`, `masks/sub/NAME.png`).
        classes: names in the order of the labels.
        remap: class by value of the masks, see `make_mask_lookup`.
        palette: colour of the masks by class, see `make_mask_lookup`.
        validation_share: share of the images that validates where there is no list, in [0, 1).
        seed: of the draw of those.

    Raises:
        UsageError: faulty classes, remap, palette or share.
        JaxmapError: files are missing, broken, or do not fit each other.
    """
    folder = Path(folder)
    lookup = make_mask_lookup(classes, remap, palette)
    images, masks = find_files(folder / "images", IMAGE_SUFFIXES), find_files(folder / "masks", MASK_SUFFIXES)
    split = split_names(folder, images, masks, validation_share=validation_share, seed=seed)
    train, validation = (_examples(names, images, masks) for names in (split.train, split.validation))
    return TrainingSet(folder, lookup.classes, train, validation, lookup, split.notes)


def read_example(example: Example, lookup: MaskLookup) -> tuple[Pixels, Labels]:
    """Reads an image and its labels; grey images become RGB.

    As everywhere, the rotation tag of a photograph is not applied: the mask lies on the stored pixels.

    Returns:
        image: uint8 (H, W, 3).
        labels: uint8 (H, W): class indices, and 255 for none.

    Raises:
        JaxmapError: a file cannot be read, they differ in size, or a pixel of the mask stands for nothing.
    """
    image = _read_rgb(example)
    labels = read_labels(example.mask, lookup)
    _check_size(labels, example)
    return image, labels


def check_training_set(
    training_set: TrainingSet, advance: Callable[[int], None] = lambda done: None
) -> Int64[np.ndarray, "2 C"]:
    """Reads every image and mask once, so that nothing is found wrong hours later.

    Args:
        training_set: what to read.
        advance: called with the number of examples read so far.

    Returns:
        Pixels of each class in training (row 0) and in validation (row 1).

    Raises:
        JaxmapError: examples that cannot be read or do not fit, masks with what stands for nothing, or
            classes that no training mask holds.
    """
    lookup, parts = training_set.lookup, (training_set.train, training_set.validation)
    examples = [(row, example) for row, part in enumerate(parts) for example in part]
    seen = np.zeros((2, len(lookup.table)), bool)

    def count(entry: tuple[int, Example]) -> np.ndarray:
        row, example = entry
        _read_rgb(example)
        codes = read_codes(example.mask, lookup)
        _check_size(codes, example)
        # Threads may meet here, but all of them only ever write True.
        seen[row][codes] = True
        return np.bincount(lookup.table[codes].ravel(), minlength=256)

    counts = np.zeros((2, 256), np.int64)
    for (row, _), found in zip(examples, _in_threads(count, examples, advance), strict=True):
        counts[row] += found
    if counts[:, UNNAMED].any():
        unnamed = np.flatnonzero(seen.any(axis=0) & (lookup.table == UNNAMED)).tolist()
        raise unnamed_codes(lookup, unnamed, training_set.folder / "masks")
    counts = counts[:, : len(lookup.classes)]
    if absent := [name for name, pixels in zip(lookup.classes, counts[0], strict=True) if not pixels]:
        raise absent_classes(lookup, absent, seen[0], training_set.folder / "masks")
    return counts


def digest(training_set: TrainingSet) -> str:
    """A fingerprint of the classes, what the masks' pixels stand for, names, sizes, split and sizes of files.

    A resumed run must find the same. Where the folder lies does not count, nor what no example uses.

    Raises:
        JaxmapError: a file is missing.
    """
    text = hashlib.sha256(training_set.lookup.table.tobytes())
    text.update(repr((training_set.classes, training_set.lookup.kind)).encode())
    for part in (training_set.train, training_set.validation):
        text.update(f"{len(part)}\n".encode())
        for example in part:
            sizes = (*example.size_px, _file_size(example.image), _file_size(example.mask))
            text.update(os.fsencode(f"{example.name}\0{sizes}\n"))
    return text.hexdigest()


def _examples(names: Sequence[str], images: Files, masks: Files) -> tuple[Example, ...]:
    sizes = _in_threads(lambda name: image_size_px(images[name][0]), names)
    return tuple(
        Example(name, images[name][0], masks[name][0], (height, width))
        for name, (width, height) in zip(names, sizes, strict=True)
    )


def _read_rgb(example: Example) -> Pixels:
    image = read_image(example.image)
    if image.shape[:2] != example.size_px:
        raise JaxmapError(
            f"the image is {image.shape[1]}x{image.shape[0]} px, and was {example.size_px[1]}x{example.size_px[0]} px",
            where=example.image,
            fix="leave the data alone while it is trained on",
        )
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


def _check_size(mask: np.ndarray, example: Example) -> None:
    if mask.shape != example.size_px:
        raise JaxmapError(
            f"the mask is {mask.shape[1]}x{mask.shape[0]} px, the image {example.size_px[1]}x{example.size_px[0]} px",
            where=example.mask,
            fix="give masks of the images' own size",
        )


def _in_threads(
    work: Callable[[Item], Result], items: Sequence[Item], advance: Callable[[int], None] = lambda done: None
) -> list[Result]:
    """The result of each item, in order; Pillow and NumPy let threads run side by side.

    Raises:
        JaxmapError: items failed; the first is told whole, the others are counted.
    """
    threads = ThreadPoolExecutor(min(MAX_THREADS, os.cpu_count() or 1))
    try:
        futures = [threads.submit(work, item) for item in items]
        for done, future in enumerate(as_completed(futures)):
            if not isinstance(future.exception(), JaxmapError | None):
                future.result()
            advance(done + 1)
    finally:
        # An interrupted check must not go on to the last file.
        threads.shutdown(cancel_futures=True)
    _raise_together(futures)
    return [future.result() for future in futures]


def _raise_together(futures: Iterable[Future]) -> None:
    faults = [fault for future in futures if isinstance(fault := future.exception(), JaxmapError)]
    if not faults:
        return
    first = faults[0]
    if len(faults) == 1:
        raise first
    others = shortened([Path(fault.where).name for fault in faults[1:]])
    raise JaxmapError(
        f"{first.what} (and {len(faults) - 1} more are faulty: {others})", where=first.where, fix=first.fix
    )


def _file_size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as fault:
        raise JaxmapError(f"the file cannot be read ({fault.strerror})", where=path, fix="restore the file") from fault
