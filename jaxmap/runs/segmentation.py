"""Labels images with a network: finds the images, labels them, writes and scores the labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from jaxmap.datasets.images import as_rgb, list_images, read_image, read_index_image
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.evaluation.segmentation_scores import SegmentationScores, check_mask
from jaxmap.host.files import atomic_path
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.deeplab import Images, Weights, inference_network
from jaxmap.models.pixelwise import check_size, resized_input, resized_output
from jaxmap.report.pictures import overlay_labels


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
        try:
            return np.asarray(self._run(self._weights, as_rgb(image)[None])[0])
        except (jax.errors.JaxRuntimeError, MemoryError) as fault:
            if isinstance(fault, MemoryError) or "RESOURCE_EXHAUSTED" in str(fault):
                raise JaxmapError(
                    f"an image of {image.shape[1]}x{image.shape[0]} px takes more memory than there is",
                    where="the network",
                    fix="run it smaller with --size H W",
                ) from fault
            raise


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
    """The mask `NAME.png` of every image.

    Raises:
        JaxmapError: masks are missing; all are named.
    """
    masks = [folder / f"{image.stem}.png" for image in images]
    missing = [mask.name for mask in masks if not mask.is_file()]
    if missing:
        raise JaxmapError(
            f"{len(missing)} of {len(masks)} masks are missing: {', '.join(missing[:5])}",
            where=folder,
            fix="name each mask after its image",
        )
    return masks


def check_masks(images: Sequence[Path], masks: Sequence[Path], class_count: int) -> None:
    """Reads every mask once, before the long work starts.

    Raises:
        JaxmapError: a mask that cannot be read, of another size than its image, or with wrong labels.
    """
    for image, mask in zip(images, masks, strict=True):
        check_mask(read_index_image(mask), read_image(image).shape[:2], class_count, mask)


def label_images(
    segmenter: Segmenter,
    images: Sequence[Path],
    out: Path,
    *,
    masks: Sequence[Path] = (),
    save_logits: bool = False,
    advance: Callable[[int], None] = lambda done: None,
) -> tuple[SegmentationScores, list[FrameError]]:
    """Labels images and writes `NAME.png`, `NAME_overlay.png` and, if asked, `NAME_logits.npy`, each atomically.

    Args:
        segmenter: the network.
        images: files to label.
        out: the folder to write.
        masks: the true labels of each image, or none.
        save_logits: whether the logits are written as well.
        advance: takes the number of images done so far.

    Returns:
        The scores against the masks, and the errors of images that cannot be read.

    Raises:
        JaxmapError: an image is too large for the memory, a mask does not fit, or writing failed.
    """
    scores, faults = SegmentationScores.empty(segmenter.classes), []
    for index, path in enumerate(images):
        try:
            image = read_image(path)
        except FrameError as fault:
            faults.append(fault)
        else:
            logits = segmenter.logits(image)
            labels = logits.argmax(axis=-1).astype(np.uint8)
            overlay = overlay_labels(image, labels, segmenter.classes)
            for suffix, picture in (("", labels), ("_overlay", overlay)):
                with atomic_path(out / f"{path.stem}{suffix}.png") as temporary:
                    Image.fromarray(picture).save(temporary)
            if save_logits:
                with atomic_path(out / f"{path.stem}_logits.npy") as temporary:
                    np.save(temporary, logits.astype(np.float32))
            if masks:
                scores.add(read_index_image(masks[index]), logits, masks[index])
        advance(index + 1)
    return scores, faults
