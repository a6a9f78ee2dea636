"""`jaxmap simulate`: renders a traverse, or training images, of worlds drawn from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxmap.commands.console import Console, parse
from jaxmap.errors import UsageError


@dataclass(frozen=True)
class SimulateArguments:
    """Render a rover's traverse in the layout of the Katwijk data set, with all that is true of it.

    Part1/ holds the raw stereo images and the files of the sensors; gt/ holds poses, labels, depth,
    orthomosaic, labelled orthomosaic and heights. The same seed and options give the same files; a
    run that was interrupted goes on where it stopped. Needs Mitsuba (pip install 'jaxmap[sim]').
    """

    out: Path
    """Folder to write."""
    seed: int = 0
    """Seed of the world and of all noise."""
    scene: Literal["few", "small", "medium", "random"] = "random"
    """Few big rocks; many small, flat ones; medium ones with the rover's shadow in view; or anything."""
    frames: int = 14
    """Stereo pairs."""
    step_m: float = 0.4
    """Distance between them, in metres."""
    samples: int | None = None
    """Rays per pixel: more take longer and leave less grain (8; 4 for training images)."""
    width: int = 1024
    """Width of the images in pixels; calibration.yaml tells the camera that belongs to it."""
    map_cell_m: float = 0.02
    """Cells of the orthomosaic, in metres."""
    preview: bool = False
    """Small and quick: images of 320 pixels, 4 rays per pixel, a coarse ground and orthomosaic."""
    training: int | None = None
    """Write so many single views, each of another world, as images/ and masks/ for jaxmap train instead."""
    size: tuple[int, int] = (384, 512)
    """Height and width of the training images."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(SimulateArguments, "simulate", words)
    _check(arguments)
    return _training(arguments) if arguments.training is not None else _traverse(arguments)


def _traverse(arguments: SimulateArguments) -> int:
    from jaxmap.simulation.tracer import load_mitsuba
    from jaxmap.simulation.traverse import TraverseOptions, simulate_traverse

    options = TraverseOptions(
        seed=arguments.seed,
        scene=arguments.scene,
        frames=arguments.frames,
        step_m=arguments.step_m,
        samples=arguments.samples or (4 if arguments.preview else 8),
        width_px=320 if arguments.preview else arguments.width,
        map_cell_m=0.05 if arguments.preview else arguments.map_cell_m,
        fine_m=0.05 if arguments.preview else 0.015,
    )
    console = Console()
    # A machine that cannot render is refused before a world is made.
    load_mitsuba()
    with console.steps("rendering", "frames", options.frames) as advance:
        pair_s = simulate_traverse(arguments.out, options, console.notify, advance)
    if pair_s:
        console.notify(f"{pair_s:.1f} s per stereo pair")
    console.result(arguments.out, ["Part1/", "gt/", "calibration.yaml", "scene.json"])
    return 0


def _training(arguments: SimulateArguments) -> int:
    from jaxmap.simulation.tracer import load_mitsuba
    from jaxmap.simulation.training_set import TrainingOptions, simulate_training_set

    options = TrainingOptions(
        seed=arguments.seed,
        scene=arguments.scene,
        images=arguments.training or 0,
        height_px=arguments.size[0],
        width_px=arguments.size[1],
        samples=arguments.samples or 4,
    )
    console = Console()
    # A machine that cannot render is refused before a world is made.
    load_mitsuba()
    with console.steps("rendering", "images", options.images) as advance:
        image_s = simulate_training_set(arguments.out, options, advance)
    if image_s:
        console.notify(f"{image_s:.1f} s per image")
    console.result(arguments.out, ["images/", "masks/", "train.txt", "val.txt", "worlds/"])
    return 0


def _check(arguments: SimulateArguments) -> None:
    """Refuses what cannot be rendered.

    Raises:
        UsageError: a number is out of range.
    """
    limits = {
        "--seed": (arguments.seed, 0, 2**31 - 1),
        "--frames": (arguments.frames, 1, 10_000),
        "--step-m": (arguments.step_m, 0.01, 10.0),
        "--samples": (arguments.samples, 1, 4096),
        "--width": (arguments.width, 32, 8192),
        "--map-cell-m": (arguments.map_cell_m, 0.005, 1.0),
        "--training": (arguments.training, 1, 1_000_000),
        "--size": (min(arguments.size), 16, 8192),
    }
    for option, (value, least, most) in limits.items():
        if value is not None and not least <= value <= most:
            raise UsageError(f"{value} is out of range", where=option, fix=f"give {least} to {most}")
    if max(arguments.size) > 8192:
        raise UsageError(f"{max(arguments.size)} is out of range", where="--size", fix="give 16 to 8192")
