"""Labels images with a network: finds them, runs it, writes what comes out, scores it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from jaxmap.datasets.images import IMAGE_SUFFIXES, read_image, read_index_image
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.segmentation_scores import SegmentationScores, check_mask
from jaxmap.files import atomic_path
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.compilation import inference_options
from jaxmap.models.convolutions import resize_bilinear
from jaxmap.models.deeplab import Images, Weights, inference_network
from jaxmap.report.pictures import overlay_labels


class Segmenter:
    """A network ready to label images; it compiles once for each size of image.

    Args:
        model: architecture and weights; batch norm is folded.
        size: height and width the network runs at, or None for each image's own.
    """

    def __init__(self, model: SavedModel, size: tuple[int, int] | None = None) -> None:
        if size is not None and min(size) < 1:
            raise JaxmapError(f"size {size[0]} {size[1]}", where="--size", fix="give a height and a width above 0")
        network = inference_network(model.architecture, model.weights)
        self.classes, self._weights = network.architecture.classes, network.weights

        def run(weights: Weights, images: Images) -> jax.Array:
            if size is None:
                return network.apply(weights, images)
            inside = resize_bilinear(images.astype("float32"), *size, align_corners=False)
            logits = network.apply(weights, inside)
            return resize_bilinear(logits, *images.shape[1:3], align_corners=False)

        self._run = jax.jit(run, compiler_options=inference_options())

    def logits(self, image: UInt8[np.ndarray, "H W *rgb"]) -> Float[np.ndarray, "H W C"]:
        """Class logits of a grey or RGB image, at its own size."""
        rgb = np.broadcast_to(image[..., None], (*image.shape, 3)) if image.ndim == 2 else image
        return np.asarray(self._run(self._weights, rgb[None])[0])


class Labelled(NamedTuple):
    """One image and what the network says of it."""

    source: Path
    image: UInt8[np.ndarray, "H W *rgb"]
    logits: Float[np.ndarray, "H W C"]


def find_images(sources: Sequence[Path]) -> list[Path]:
    """Image files, those of folders in order of name.

    Raises:
        JaxmapError: a path that is not there, a folder without images, or two images of one name.
    """
    found: list[Path] = []
    for source in sources:
        if source.is_dir():
            inside = sorted(path for path in source.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
            if not inside:
                raise JaxmapError("no images", where=source, fix=f"give a folder of {', '.join(IMAGE_SUFFIXES[:3])}")
            found += inside
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


def label_images(segmenter: Segmenter, images: Sequence[Path]) -> Iterator[Labelled]:
    """Labels one image after the other.

    Raises:
        JaxmapError: an image cannot be read.
    """
    for path in images:
        image = read_image(path)
        yield Labelled(path, image, segmenter.logits(image))


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
