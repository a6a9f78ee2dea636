"""Labels images with a network: finds the images, labels them, writes and scores the labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from jaxmap.datasets.images import as_rgb, image_size_px, list_images, read_image
from jaxmap.datasets.masks import MaskLookup, find_mask, read_labels, unlabelled_notes
from jaxmap.datasets.options import Bits
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.evaluation.segmentation_scores import SegmentationScores, check_mask
from jaxmap.host.files import atomic_path
from jaxmap.host.memory import available_bytes
from jaxmap.labels import ANY_OTHER, IGNORE
from jaxmap.models.base import Images
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.network import Weights, inference_network
from jaxmap.models.pixelwise import check_size, resized_input, resized_output
from jaxmap.report.pictures import overlay_labels
from jaxmap.runs.large_pictures import LARGE_PX, OVERVIEW_PX, Size, enlarged, read_decimated


class Segmenter:
    """A network ready to label images; it compiles once for each size of image.

    Args:
        model: architecture and weights; batch norm is folded.
        size: height and width the network runs at, or None for each image's own.

    Raises:
        UsageError: a size below 1.
    """

    def __init__(self, model: SavedModel, size: tuple[int, int] | None = None) -> None:
        check_size(size, "--size")
        self.size = size
        network = inference_network(model.architecture, model.weights)
        self.classes, self._weights = network.architecture.classes, network.weights

        def run(weights: Weights, images: Images) -> jax.Array:
            logits = network.apply(weights, resized_input(images, size))
            return resized_output(logits, images.shape[1:3])

        self._run = jax.jit(run)

    def logits(self, image: UInt8[np.ndarray, "H W *rgb"]) -> Float[np.ndarray, "H W C"]:
        """Class logits of a grey or RGB image, at its own size.

        Raises:
            JaxmapError: the image is too large for the memory.
        """
        height, width = image.shape[:2]
        too_large = JaxmapError(
            f"an image of {width}x{height} px takes more memory than there is",
            where="the network",
            fix="run it smaller with --size H W",
        )
        large = height * width > LARGE_PX and jax.default_backend() == "cpu"
        if large and self._needed_bytes((height, width)) > available_bytes():
            raise too_large
        try:
            return np.asarray(self._run(self._weights, as_rgb(image)[None])[0])
        except (jax.errors.JaxRuntimeError, MemoryError) as fault:
            if isinstance(fault, MemoryError) or "RESOURCE_EXHAUSTED" in str(fault):
                raise too_large from fault
            raise

    def _needed_bytes(self, size: Size) -> float:
        """What a run takes, as the compiler says: a process that takes more than there is would be killed."""
        image = jax.ShapeDtypeStruct((1, *size, 3), np.uint8)
        costs = self._run.lower(self._weights, image).compile().memory_analysis()
        return 0.0 if costs is None else float(costs.temp_size_in_bytes + costs.output_size_in_bytes)


def find_images(sources: Sequence[Path]) -> list[Path]:
    """Image files, those of folders in the natural order of their names.

    Raises:
        JaxmapError: a path that is not there, a folder without images, or two images of one name.
    """
    found: list[Path] = []
    for source in sources:
        if source.is_dir():
            found += list_images(source)
        elif source.is_file():
            found.append(source)
        else:
            raise JaxmapError("no such file or folder", where=source, fix="check the path of the images")
    by_name: dict[str, Path] = {}
    for path in found:
        if (other := by_name.setdefault(path.stem, path)) is not path:
            raise JaxmapError(
                f"{other} has the same name, so one output would replace the other", where=path, fix="label them apart"
            )
    return found


def check_outputs(images: Sequence[Path], out: Path, *, inputs: Sequence[Path], scores: Path | None) -> None:
    """Refuses outputs that would replace each other or an input.

    Args:
        images: files to label.
        out: the folder to write.
        inputs: files that are only read: images, masks, model.
        scores: a file to write as well.

    Raises:
        JaxmapError: an output would replace an input or another output, or `out` is a file.
    """
    if out.exists() and not out.is_dir():
        raise JaxmapError("cannot be made: it is a file", where=out, fix="choose another --out")
    if scores is not None and scores.is_dir():
        raise JaxmapError("cannot be written: it is a folder", where=scores, fix="choose another --scores")

    def identity(path: Path) -> tuple[int, int]:
        """The same for all names of a file."""
        found = path.stat()
        return found.st_dev, found.st_ino

    read = {identity(path) for path in inputs}
    names = {f"{image.stem}.png" for image in images}
    written = [out / name for name in names] + ([] if scores is None else [scores])
    for image in images:
        overlay = f"{image.stem}_overlay.png"
        if overlay in names:
            raise JaxmapError(
                f"{overlay} would be both the overlay of {image.name} and the labels of another image",
                where=out,
                fix="label them apart",
            )
        written.append(out / overlay)
    for path in sorted(written):
        if path.exists() and identity(path) in read:
            raise JaxmapError(f"{path.name} would be replaced, and it is an input", where=path, fix="write elsewhere")


def find_masks(images: Sequence[Path], folder: Path) -> list[Path]:
    """The mask of every image: `NAME.png`, or of another of `MASK_SUFFIXES`.

    Raises:
        JaxmapError: masks are missing; all are named.
    """
    found = {image.stem: find_mask(folder, image.stem) for image in images}
    missing = [f"{name}.png" for name, mask in found.items() if mask is None]
    if missing:
        raise JaxmapError(
            f"{len(missing)} of {len(found)} masks are missing: {', '.join(missing[:5])}",
            where=folder,
            fix="name each mask after its image",
        )
    return [mask for mask in found.values() if mask is not None]


def check_masks(images: Sequence[Path], masks: Sequence[Path], lookup: MaskLookup) -> list[str]:
    """Reads every mask once, before the long work starts.

    Returns:
        A note where the masks label hardly anything.

    Raises:
        JaxmapError: an image or a mask that cannot be read, a mask of another size than its image, or with values that
            stand for nothing.
    """
    held: set[int] = set()
    for image, mask in zip(images, masks, strict=True):
        labels = read_labels(mask, lookup)
        held |= set(np.unique(labels).tolist())
        width, height = image_size_px(image, as_shown=True)
        known = labels if lookup.negated is None else np.where(labels == ANY_OTHER, np.uint8(IGNORE), labels)
        check_mask(known, (height, width), len(lookup.classes), mask)
    return unlabelled_notes(lookup, held)


@dataclass(frozen=True)
class LabelWriter:
    """Labels images and writes `NAME.png`, `NAME_overlay.png` and, if asked, `NAME_logits.npy`, each atomically.

    Attributes:
        segmenter: the network.
        out: the folder to write.
        lookup: what the pixels of masks stand for.
        save_logits: whether the logits are written as well.
        bits: how many 16-bit images use; found in each by default.
    """

    segmenter: Segmenter
    out: Path
    lookup: MaskLookup
    save_logits: bool = False
    bits: Bits | None = None

    def label(self, path: Path, mask: Path | None, scores: SegmentationScores) -> None:
        """Labels one image, as viewers show it, and scores the labels against a mask.

        Raises:
            FrameError: the image cannot be read.
            JaxmapError: it is too large for the memory, the mask does not fit, or writing failed.
        """
        (width, height), wanted = image_size_px(path, as_shown=True), self.segmenter.size
        if wanted is not None and width * height > LARGE_PX and wanted[0] * wanted[1] <= LARGE_PX:
            self._label_large(path, mask, scores, (height, width), wanted)
            return
        try:
            image = read_image(path, bits=self.bits, as_shown=True)
        except FrameError as fault:
            if wanted is None and width * height > LARGE_PX:
                raise FrameError(fault.what, where=path, fix="run it smaller with --size H W, or cut it up") from fault
            raise
        logits = self.segmenter.logits(image)
        labels = logits.argmax(axis=-1).astype(np.uint8)
        self._write(path, labels, overlay_labels(image, labels, self.segmenter.classes))
        if self.save_logits:
            with atomic_path(self.out / f"{path.stem}_logits.npy") as temporary:
                np.save(temporary, logits.astype(np.float32))
        if mask is not None:
            scores.add(read_labels(mask, self.lookup), logits, mask)

    def _label_large(self, path: Path, mask: Path | None, scores: SegmentationScores, size: Size, wanted: Size) -> None:
        """The same for a picture that is never held as more than one number a pixel; its overlay is smaller than it."""
        height, width = size
        # Its labels, and as much again while they are compressed.
        if 2 * height * width > available_bytes():
            raise FrameError(
                f"the labels of an image of {width}x{height} px take more memory than there is",
                where=path,
                fix="cut it into tiles",
            )
        logits = self.segmenter.logits(read_decimated(path, wanted, self.bits))
        truth = None if mask is None else read_labels(mask, self.lookup)
        labels, counted = np.empty(size, np.uint8), scores.images
        with ExitStack() as stack:
            kept = None
            if self.save_logits:
                temporary = stack.enter_context(atomic_path(self.out / f"{path.stem}_logits.npy"))
                kept = np.lib.format.open_memmap(temporary, "w+", np.float32, (*size, logits.shape[2]))
            for rows, band in enlarged(logits, size):
                labels[rows] = band.argmax(axis=-1)
                if kept is not None:
                    kept[rows] = band
                if truth is not None:
                    scores.add(truth[rows], band, mask)
                    scores.images = counted + 1
        step = -(-max(size) // OVERVIEW_PX)
        small = labels[::step, ::step]
        overview = read_decimated(path, small.shape, self.bits)
        self._write(path, labels, overlay_labels(overview, small, self.segmenter.classes))

    def _write(self, path: Path, labels: np.ndarray, overlay: np.ndarray) -> None:
        for suffix, picture in (("", labels), ("_overlay", overlay)):
            with atomic_path(self.out / f"{path.stem}{suffix}.png") as temporary:
                Image.fromarray(picture).save(temporary)


def label_images(
    writer: LabelWriter,
    images: Sequence[Path],
    masks: Sequence[Path] = (),
    *,
    advance: Callable[[int], None] = lambda done: None,
) -> tuple[SegmentationScores, list[FrameError]]:
    """Labels images, and scores the labels.

    Args:
        writer: the network, and where to write.
        images: files to label.
        masks: the true labels of each image, or none.
        advance: takes the number of images done so far.

    Returns:
        The scores against the masks, and the errors of images that cannot be read.

    Raises:
        JaxmapError: an image is too large for the memory, a mask does not fit, or writing failed.
    """
    scores, faults = SegmentationScores.empty(writer.segmenter.classes, writer.lookup.negated), []
    for index, path in enumerate(images):
        try:
            writer.label(path, masks[index] if masks else None, scores)
        except FrameError as fault:
            faults.append(fault)
        advance(index + 1)
    return scores, faults
