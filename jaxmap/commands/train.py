"""`jaxmap train`: trains or fine-tunes a segmentation network."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.errors import UsageError
from jaxmap.runs.training_plan import TRAIN_SETTINGS, TrainConfig

OUTPUTS = ("report.html", "model.safetensors", "history.csv", "metrics.json", "config.yaml", "checkpoints/")


@dataclass(frozen=True)
class TrainArguments:
    """Train or fine-tune a segmentation network on images and masks, or on a stereo sequence and an orthomosaic.

    It is DeepLabv3+, or with --network.kind FCN-8s (fcn), SegNet or U-Net, on one of several backbones.
    The folder holds images/NAME.{png,jpg,...} and masks/NAME.png, and may hold train.txt and val.txt of names.
    With --supervision map it is a sequence, as of jaxmap map, or sample:NAME, and no image is labelled: the network
    (the bundled one without --init) learns to make the map that the orthomosaic of --ground-truth shows.
    Writes into the run folder: model.safetensors, history.csv, metrics.json, config.yaml, report.html and
    checkpoints/, from which an interrupted run is resumed exactly (--resume).
    """

    data_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATA")]
    """Folder of the training data: images and masks, or with --supervision map a sequence or its observations."""
    out: Path
    """The run folder to write."""
    init: Path | None = None
    """Model file to start from: a backbone or a whole network, as train and weights write it."""
    config: str | None = None
    """YAML file, or the name of one in configs/train (chiodini2020); options given here override it."""
    resume: bool = False
    """Resume an interrupted run."""
    overwrite: bool = False
    """Replace the run in the folder; it stays until the new one is whole."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(TrainArguments, "train", words, with_config=_with_config)
    config = arguments.settings
    if arguments.resume and arguments.overwrite:
        raise UsageError("--resume and --overwrite exclude each other", fix="give one of them")

    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.host.output_folder import locked
    from jaxmap.runs.map_training import plan_map_training
    from jaxmap.runs.training import TrainingFolder, TrainingRun
    from jaxmap.runs.training_plan import plan_image_training

    keep_compiled_programs()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console = Console()
    if config.supervision == "pixels" and config.ground_truth is not None:
        raise UsageError("--ground-truth is given, but pixels supervise", fix="add --supervision map, or leave it out")
    folder = TrainingFolder(arguments.out)
    # The plan reads all data: a folder that cannot be written is reported before.
    with locked(arguments.out):
        if config.supervision == "map":
            plan = plan_map_training(str(arguments.data_folder), config, arguments.init, notify=console.notify)
        else:
            plan = plan_image_training(arguments.data_folder, config, arguments.init, notify=console.notify)
        with (
            folder.writing(plan, resume=arguments.resume, overwrite=arguments.overwrite) as work,
            console.steps("training", "steps", plan.order.steps) as advance,
        ):
            metrics = TrainingRun(plan, work, notify=console.notify, on_step=advance).run()
    rate = metrics["examples_seen"] / max(metrics["seconds"], 1e-9)
    summary = f"{metrics['epochs']} epochs: {metrics['examples_seen']} examples, {rate:.1f} a second"
    if metrics["kept_epoch"] is not None:
        kept = metrics["last"] if metrics["kept_epoch"] == metrics["last"]["epoch"] else metrics["best"]
        iou = "unknown" if kept["mean_iou"] is None else f"{kept['mean_iou']:.3f}"
        summary += f"; kept: epoch {metrics['kept_epoch']}, mean IoU {iou}"
    console.notify(summary)
    console.result(arguments.out, OUTPUTS)
    return 0


def _with_config(name: str) -> TrainArguments:
    """The defaults under a configuration; the two required arguments are filled in by the parser."""
    return TrainArguments(data_folder=tyro.MISSING, out=tyro.MISSING, config=name, settings=TRAIN_SETTINGS.load(name))
