"""Labels images with a network: finds them, runs it, writes what comes out, scores it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from jaxmap.datasets.images import as_rgb, list_images, read_image, read_index_image
from jaxmap.errors import JaxmapError
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


class Labelled(NamedTuple):
    """One image and what the network says of it."""

    source: Path
    image: UInt8[np.ndarray, "H W *rgb"]
    logits: Float[np.ndarray, "H W C"]


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
    """Refuses outputs that would replace each other or anything that is read.

    Args:
        images: what is labelled.
        out: the folder that is written.
        inputs: files that are only read: images, masks, model.
        scores: a file that is written as well.

    Raises:
        JaxmapError: an output has the place of an input, or two have one name, or what should be a
            folder is a file.
    """
    if out.exists() and not out.is_dir():
        raise JaxmapError("cannot be made: it is a file", where=out, fix="choose another --out")
    if scores is not None and scores.is_dir():
        raise JaxmapError("cannot be written: it is a folder", where=scores, fix="choose another --scores")
    read = {_identity(path) for path in inputs}
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
        if path.exists() and _identity(path) in read:
            raise JaxmapError(f"{path.name} would be replaced, and it is an input", where=path, fix="write elsewhere")


def _identity(path: Path) -> tuple[int, int]:
    """The same for all names of a file."""
    found = path.stat()
    return found.st_dev, found.st_ino


def find_masks(images: Sequence[Path], folder: Path) -> list[Path]:
    """The mask `NAME.png` of every image.

    Raises:
        JaxmapError: masks are missing; they are told together.
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


def label_image(segmenter: Segmenter, path: Path) -> Labelled:
    """Reads an image and labels it.

    Raises:
        FrameError: the image cannot be read.
        JaxmapError: it is too large for the memory.
    """
    image = read_image(path)
    return Labelled(path, image, segmenter.logits(image))


def write_labelled(labelled: Labelled, classes: Sequence[str], out: Path, *, save_logits: bool) -> None:
    """Writes `NAME.png`, `NAME_overlay.png` and, where asked, `NAME_logits.npy`, each atomically.

    Raises:
        JaxmapError: writing failed.
    """
    labels = labelled.logits.argmax(axis=-1).astype(np.uint8)
    name = labelled.source.stem
    for suffix, picture in (("", labels), ("_overlay", overlay_labels(labelled.image, labels, classes))):
        with atomic_path(out / f"{name}{suffix}.png") as temporary:
            Image.fromarray(picture).save(temporary)
    if save_logits:
        with atomic_path(out / f"{name}_logits.npy") as temporary:
            np.save(temporary, labelled.logits.astype(np.float32))


def check_masks(images: Sequence[Path], masks: Sequence[Path], class_count: int) -> None:
    """Reads every mask once before the long work starts.

    Raises:
        JaxmapError: a mask that cannot be read, of another size than its image, or with wrong labels.
    """
    for image, mask in zip(images, masks, strict=True):
        check_mask(read_index_image(mask), read_image(image).shape[:2], class_count, mask)


def score_image(scores: SegmentationScores, labelled: Labelled, mask: Path) -> None:
    """Counts one labelled image.

    Raises:
        JaxmapError: the mask does not fit.
    """
    scores.add(read_index_image(mask), labelled.logits, mask)
