"""`jaxmap segment`: labels images with a network, and scores the labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.errors import FrameError, JaxmapError, UsageError

if TYPE_CHECKING:
    from jaxmap.runs.segmentation import Segmenter


@dataclass(frozen=True)
class SegmentArguments:
    """Label images with a network.

    Writes NAME.png (class indices) and NAME_overlay.png for each image, at its own size and on its pixels
    as they are stored: the rotation tag of a photograph is not applied. Inputs are never replaced; an image
    that cannot be read is passed over, told, and makes the exit status 1.
    """

    images: tyro.conf.Positional[tuple[Path, ...]]
    """Image files, or folders of them."""
    model: Path
    """A model file, as train and weights import write it."""
    out: Path
    """Folder to write."""
    size: tuple[int, int] | None = None
    """Height and width that the network runs at; each image's own without it."""
    masks: Path | None = None
    """Folder of true labels, NAME.png of class indices (255: none), to score against."""
    scores: Path | None = None
    """JSON file to write the scores to; needs --masks."""
    save_logits: bool = False
    """Write NAME_logits.npy too, float32 (H, W, classes)."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(SegmentArguments, "segment", words)
    if not arguments.images:
        raise UsageError("no images", where="the command line", fix="name image files or folders")
    if arguments.scores is not None and arguments.masks is None:
        raise UsageError("there is nothing to score against", where="--scores", fix="give --masks DIR")

    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.models.checkpoint import load_network
    from jaxmap.runs.segmentation import Segmenter, check_masks, check_outputs, find_images, find_masks

    keep_compiled_programs()
    images = find_images(arguments.images)
    model = load_network(arguments.model)
    masks = [] if arguments.masks is None else find_masks(images, arguments.masks)
    inputs = [*images, *masks, arguments.model]
    check_outputs(images, arguments.out, inputs=inputs, scores=arguments.scores)
    segmenter = Segmenter(model, arguments.size)
    if masks:
        check_masks(images, masks, len(segmenter.classes))
    _label(arguments, segmenter, images, masks)
    return 0


def _label(arguments: SegmentArguments, segmenter: Segmenter, images: list[Path], masks: list[Path]) -> None:
    """Labels, writes and scores all images; those that cannot be read are told at the end."""
    from jaxmap.evaluation.segmentation_scores import SegmentationScores
    from jaxmap.runs.segmentation import label_image, score_image, write_labelled

    console, faults = Console(), []
    scores = SegmentationScores.empty(segmenter.classes)
    with console.steps("labelling", "images", len(images)) as advance:
        for index, image in enumerate(images):
            try:
                labelled = label_image(segmenter, image)
            except FrameError as fault:
                faults.append(fault)
            else:
                write_labelled(labelled, segmenter.classes, arguments.out, save_logits=arguments.save_logits)
                if masks:
                    score_image(scores, labelled, masks[index])
            advance(index + 1)
    if masks:
        _tell_scores(console, scores.summary(), arguments.scores)
    if len(faults) < len(images):
        names = ["NAME.png", "NAME_overlay.png", *(["NAME_logits.npy"] * arguments.save_logits)]
        console.result(arguments.out, names)
    if faults:
        raise JaxmapError(
            f"{len(faults)} of {len(images)} images could not be labelled; the first: {faults[0].what}",
            where=faults[0].where,
            fix=faults[0].fix,
        )


def _tell_scores(console: Console, summary: dict, file: Path | None) -> None:
    from jaxmap.host.output_folder import write_json

    console.table(_title(summary), COLUMNS, _rows(summary))
    if file is not None:
        write_json(file, summary)
        console.notify(f"scores: {file}")


COLUMNS = {"name": "class", "iou": "IoU", "precision": "precision", "recall": "recall", "pixels": "true pixels"}


def _title(summary: dict) -> str:
    figures = {"accuracy": "accuracy", "mean_iou": "mean IoU", "ece": "calibration error"}
    told = [f"{heading} {summary[key]:.3f}" for key, heading in figures.items() if summary[key] is not None]
    return f"{summary['images']} images: {', '.join(told) or 'no labelled pixel'}"


def _rows(summary: dict) -> list[dict[str, object]]:
    return [
        {"name": name, **{key: "-" if value is None else value for key, value in values.items()}}
        for name, values in summary["classes"].items()
    ]
