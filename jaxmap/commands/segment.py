"""`jaxmap segment`: labels images with a network, and scores the labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxmap.commands.console import Console, check_bounds, parse
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.settings import count

Edge = Annotated[int, count(8192)]


@dataclass(frozen=True)
class SegmentArguments:
    """Label images with a network.

    Writes NAME.png (class indices) and NAME_overlay.png for each image, at its own size and as viewers show it: the
    rotation tag of a photograph is applied. With --size, pictures of more than 34 million pixels are decimated while
    they are read, and their overlays are smaller. Inputs are never replaced. An image that cannot be read is skipped
    and reported at the end; the exit status is then 1.
    """

    images: tyro.conf.Positional[tuple[Path, ...]]
    """Image files, or folders of them."""
    model: Path
    """A model file, as train and weights import write it."""
    out: Path
    """Folder to write."""
    size: tuple[Edge, Edge] | None = None
    """Height and width that the network runs at; each image's own without it."""
    masks: Path | None = None
    """Folder of true labels, NAME.png of class indices (255: none), to score against."""
    remap: dict[str, str] | None = None
    """Class by value of the masks, such as 0 "not rock" 255 rock; "ignore" is no class, and the value * every other."""
    palette: dict[str, str] | None = None
    """Colour of the masks by class, such as rock #ff0000; several of a class with blanks between."""
    scores: Path | None = None
    """JSON file to write the scores to; needs --masks."""
    save_logits: bool = False
    """Write NAME_logits.npy too, float32 (H, W, classes)."""


COLUMNS = {"name": "class", "iou": "IoU", "precision": "precision", "recall": "recall", "pixels": "true pixels"}


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(SegmentArguments, "segment", words)
    check_bounds(arguments, "segment")
    if not arguments.images:
        raise UsageError("no images", where="the command line", fix="name image files or folders")
    if arguments.masks is None and (arguments.remap or arguments.palette):
        raise UsageError("no masks are given to read", where="--remap", fix="give --masks DIR")
    if arguments.scores is not None and arguments.masks is None:
        raise UsageError("there is nothing to score against", where="--scores", fix="give --masks DIR")

    from jaxmap.datasets.images import rotation_notes
    from jaxmap.datasets.masks import make_mask_lookup
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.models.checkpoint import load_network
    from jaxmap.runs.segmentation import (
        LabelWriter,
        Segmenter,
        check_masks,
        check_outputs,
        find_images,
        find_masks,
        label_images,
    )

    keep_compiled_programs()
    images = find_images(arguments.images)
    model = load_network(arguments.model)
    masks = [] if arguments.masks is None else find_masks(images, arguments.masks)
    inputs = [*images, *masks, arguments.model]
    check_outputs(images, arguments.out, inputs=inputs, scores=arguments.scores)
    segmenter = Segmenter(model, arguments.size)
    lookup = make_mask_lookup(segmenter.classes, arguments.remap, arguments.palette, option="--", all_classes=False)
    console = Console()
    for note in [*rotation_notes(images), *(check_masks(images, masks, lookup) if masks else [])]:
        console.notify(f"note: {note}")
    writer = LabelWriter(segmenter, arguments.out, lookup, arguments.save_logits)
    with console.steps("labelling", "images", len(images)) as advance:
        scores, faults = label_images(writer, images, masks, advance=advance)
    if masks:
        _print_scores(console, scores.summary(), arguments.scores)
    if len(faults) < len(images):
        names = ["NAME.png", "NAME_overlay.png", *(["NAME_logits.npy"] * arguments.save_logits)]
        console.result(arguments.out, names)
    if faults:
        raise JaxmapError(
            f"{len(faults)} of {len(images)} images could not be labelled; the first: {faults[0].what}",
            where=faults[0].where,
            fix=faults[0].fix,
        )
    return 0


def _print_scores(console: Console, summary: dict, file: Path | None) -> None:
    from jaxmap.host.output_folder import write_json

    headings = {"accuracy": "accuracy", "mean_iou": "mean IoU", "ece": "calibration error"}
    figures = [f"{heading} {summary[key]:.3f}" for key, heading in headings.items() if summary[key] is not None]
    rows = [
        {"name": name, **{key: "-" if value is None else value for key, value in values.items()}}
        for name, values in summary["classes"].items()
    ]
    console.table(f"{summary['images']} images: {', '.join(figures) or 'no labelled pixel'}", COLUMNS, rows)
    if file is not None:
        write_json(file, summary)
        console.notify(f"scores: {file}")
