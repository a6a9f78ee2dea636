"""`jaxmap simulate`: renders a traverse, or training images, of worlds drawn from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from jaxmap.commands.console import Console, check_bounds, parse

Edge = Annotated[int, Interval(ge=16, le=8192)]


@dataclass(frozen=True)
class SimulateArguments:
    """Render a rover's traverse in the layout of the Katwijk data set, with its ground truth.

    Part1/ holds the raw stereo images and the files of the sensors; gt/ holds poses, labels, depth, orthomosaic,
    labelled orthomosaic and heights. The same seed and options give the same files; an interrupted run resumes where
    it stopped. Needs Mitsuba (pip install 'jaxmap[sim]').
    """

    out: Path
    """Folder to write."""
    seed: Annotated[int, Interval(ge=0, lt=2**31)] = 0
    """Seed of the world and of all noise."""
    scene: Literal["few", "small", "medium", "random"] = "random"
    """Few big rocks; many small, flat ones; medium ones with the rover's shadow in view; or any of these."""
    frames: Annotated[int, Interval(ge=1, le=10_000)] = 14
    """Number of stereo pairs."""
    step_m: Annotated[float, Interval(ge=0.01, le=10)] = 0.4
    """Distance between them, in metres."""
    samples: Annotated[int, Interval(ge=1, le=4096)] | None = None
    """Rays per pixel: more take longer and leave less noise (8; 4 for training images)."""
    width: Annotated[int, Interval(ge=32, le=8192)] = 1024
    """Width of the images in pixels; calibration.yaml describes the camera of that size."""
    map_cell_m: Annotated[float, Interval(ge=0.005, le=1)] = 0.02
    """Cell size of the orthomosaic, in metres."""
    preview: bool = False
    """Small and quick: images of 320 pixels, 4 rays per pixel, a coarse ground and orthomosaic."""
    training: Annotated[int, Interval(ge=1, le=1_000_000)] | None = None
    """Write so many single images, each of another world, as images/ and masks/ for jaxmap train instead."""
    size: tuple[Edge, Edge] = (384, 512)
    """Height and width of the training images."""
    stereo: bool = False
    """Training images are left images of rectified pairs, and their disparity is written, too: disparity/, cameras/."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(SimulateArguments, "simulate", words)
    check_bounds(arguments, "simulate")
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
        stereo=arguments.stereo,
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
