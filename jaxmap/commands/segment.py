"""`jaxmap segment`: labels images with a network, and scores the labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.errors import UsageError


@dataclass(frozen=True)
class SegmentArguments:
    """Label images with a network.

    Writes NAME.png (class indices) and NAME_overlay.png for each image, at its own size.
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

    from jaxmap.cache import keep_compiled_programs
    from jaxmap.evaluation.segmentation_scores import SegmentationScores
    from jaxmap.models.checkpoint import load_network
    from jaxmap.output_folder import write_json
    from jaxmap.segmentation import (
        Segmenter,
        check_masks,
        find_images,
        find_masks,
        label_images,
        score_image,
        write_labelled,
    )

    keep_compiled_programs()
    console = Console()
    images = find_images(arguments.images)
    model = load_network(arguments.model)
    masks = None if arguments.masks is None else find_masks(images, arguments.masks)
    segmenter = Segmenter(model, arguments.size)
    scores = SegmentationScores.empty(segmenter.classes)
    if masks is not None:
        check_masks(images, masks, len(segmenter.classes))
    with console.steps("labelling", "images", len(images)) as advance:
        for index, labelled in enumerate(label_images(segmenter, images)):
            write_labelled(labelled, segmenter.classes, arguments.out, save_logits=arguments.save_logits)
            if masks is not None:
                score_image(scores, labelled, masks[index])
            advance(index + 1)
    if masks is not None:
        summary = scores.summary()
        console.table(_title(summary), COLUMNS, _rows(summary))
        if arguments.scores is not None:
            write_json(arguments.scores, summary)
            console.tell(f"scores: {arguments.scores}")
    console.result(arguments.out, ["NAME.png", "NAME_overlay.png", *(["NAME_logits.npy"] * arguments.save_logits)])
    return 0


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
