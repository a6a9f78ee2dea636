"""`jaxmap tune`: tunes the numbers of fusion against labelled orthomosaics."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.errors import UsageError
from jaxmap.host.output_folder import check_inputs_stay
from jaxmap.host.replacement import Replacement
from jaxmap.runs.config import MapConfig, config_of_observations, load_config, observations_in
from jaxmap.tuning.options import TuneOptions


@dataclass(frozen=True)
class TuneArguments:
    """Tune the numbers of fusion by gradient descent, on traverses whose ground truth is known.

    Maps the frames once, then moves increments, priors, thresholds, range weighting and the labeller's own numbers
    to where the map agrees best with the ground truth. Part of the ground is held out and decides when to stop.
    Writes OUT, a configuration for jaxmap map --config, at every step that is the best so far; and beside it
    OUT's .json (scores before and after, with intervals) and .html (the same with plots). With --through stereo the
    penalties, uniqueness and cost network of stereo matching are tuned instead, by the map that they lead to.
    """

    sequence: tyro.conf.Positional[tuple[str, ...]]
    """Folders of sequences or of observations (jaxmap perceive), or sample:NAME."""
    ground_truth: tuple[Path, ...]
    """A labelled orthomosaic for each sequence, in the same order (GeoTIFF: 0 unlabelled, 1 sand, 2 rock)."""
    out: Path
    """The YAML file to write."""
    config: str | None = None
    """YAML file, or the name of a bundled one, to start from; options given here go before it."""
    labels_of: tuple[Path, ...] = ()
    """Folders of labels, one for each sequence, where there are several (--labels for one)."""
    poses_of: tuple[Path, ...] = ()
    """Pose files, one for each sequence, where there are several (--poses for one)."""
    target: Annotated[str, tyro.conf.arg(name="class")] = "rock"
    """The class that is scored."""
    options: Annotated[TuneOptions, tyro.conf.arg(name="")] = field(default_factory=TuneOptions)
    remap: tuple[str, ...] = ()
    """What the values of the orthomosaics mean: 0=unlabelled 7=rock '*=sand', or colours: '#b23c2e=rock'."""
    palette: Path | None = None
    """The same as a YAML file of CODE: CLASS."""
    truth_crs: str | None = None
    """Coordinate reference system of the ground truth, in place of its own."""
    overwrite: bool = False
    """Replace the files of an earlier run; they stay until the new ones are whole."""
    settings: Annotated[MapConfig, tyro.conf.arg(name="")] = field(default_factory=MapConfig)


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(TuneArguments, "tune", words, with_config=_with_config)
    if (perceived := next(filter(None, map(observations_in, arguments.sequence)), None)) is not None:
        settings = config_of_observations(perceived, arguments.config)
        arguments = parse(TuneArguments, "tune", words, default=_under(settings, arguments.config))
    config, out = arguments.settings, arguments.out
    replacement = Replacement(out.parent, lambda: _outputs(out), out.stem)
    replacement.settle_for_reading()
    _check(arguments, config)

    from jaxmap.datasets.label_raster import choose_coding
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.host.output_folder import locked
    from jaxmap.runs.evaluation import TruthOptions
    from jaxmap.runs.tuning import Source, TuningRun

    keep_compiled_programs()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console = Console()
    count = len(arguments.sequence)
    rows = zip(
        arguments.sequence,
        arguments.ground_truth,
        arguments.labels_of or (None,) * count,
        arguments.poses_of or (None,) * count,
        strict=True,
    )
    options = replace(arguments.options, seed=config.seed)
    coding = choose_coding(arguments.remap, arguments.palette)
    truth = TruthOptions(arguments.target, coding, arguments.truth_crs)
    with locked(out.parent), replacement.place(out.name, console.notify) as place:
        given = [Source(*row) for row in rows], config, truth, options, place / out.name
        if options.through == "stereo":
            from jaxmap.runs.stereo_tuning import StereoTuningRun

            run: TuningRun | StereoTuningRun = StereoTuningRun(*given, final=out, notify=console.notify)
        else:
            run = TuningRun(*given, notify=console.notify)
        with console.steps("reading", "frames", run.frames) as advance:
            run.cache(advance)
        with console.steps("tuning", "steps", options.descent.steps * (1 + bool(options.kernel))) as advance:
            result = run.tune(advance)
    _print(console, result)
    for note in result["notes"]:
        console.notify(f"note: {note}")
    console.result(out.parent, [path.name for path in _outputs(out) if path.exists()])
    return 0


def _outputs(out: Path) -> list[Path]:
    return [out, *(out.with_suffix(suffix) for suffix in (".json", ".html", ".safetensors"))]


def _check(arguments: TuneArguments, config: MapConfig) -> None:
    count = len(arguments.sequence)
    if not count:
        raise UsageError("no sequence", where="the command line", fix="name the folder of one")
    for name in ("ground_truth", "labels_of", "poses_of"):
        given = len(getattr(arguments, name))
        if given != count and (given or name == "ground_truth"):
            option = f"--{name.replace('_', '-')}"
            raise UsageError(f"{count} sequences and {given} of {option}", fix="give one for each, in the same order")
    for single, several in (("labels", "labels_of"), ("poses", "poses_of")):
        if count > 1 and getattr(config, single) is not None:
            raise UsageError(
                f"--{single} is of one sequence, and there are {count}",
                fix=f"give --{several.replace('_', '-')}, one for each",
            )
    if arguments.out.suffix.lower() not in (".yaml", ".yml"):
        raise UsageError(f"--out {arguments.out} is not a .yaml file", fix="name a YAML file")
    outputs = _outputs(arguments.out)
    start = None if arguments.config is None else Path(arguments.config)
    given = (start, arguments.palette, *arguments.poses_of, *arguments.ground_truth)
    check_inputs_stay(outputs, (config.poses, config.calibration, config.model, *given))
    if folders := [path for path in outputs if path.is_dir()]:
        raise UsageError("cannot be written: it is a folder", where=folders[0], fix="choose another --out")
    there = [path for path in outputs if path.exists()]
    if there and not arguments.overwrite:
        raise UsageError("there already", where=there[0], fix="choose another --out, or add --overwrite")


def _print(console: Console, result: dict) -> None:
    columns = {"score": "held-out ground", "before": "before", "after": "after", "change": "change (90 % interval)"}
    for stage in result["stages"]:
        rows = [
            {
                "score": name,
                "before": _text(row["before"]),
                "after": _text(row["after"]),
                "change": f"{_text(row['change'])} ({' to '.join(map(_text, row['change_interval'] or (None, None)))})",
            }
            for name, row in stage["scores"]["held_out"].items()
        ]
        console.table(f"{result['class']}, {stage['name']}, best after {stage['best_step']} steps", columns, rows)


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _with_config(name: str) -> TuneArguments:
    """The defaults under a configuration; the required arguments are filled in by the parser."""
    return _under(load_config(name), name)


def _under(settings: MapConfig, name: str | None) -> TuneArguments:
    return TuneArguments(
        sequence=tyro.MISSING, ground_truth=tyro.MISSING, out=tyro.MISSING, config=name, settings=settings
    )
