"""`jaxmap check`: says what is wrong with a sequence before anything is mapped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.runs.config import CheckConfig, load_config


@dataclass(frozen=True)
class CheckArguments:
    """Check whether the images, the calibration, the poses and the times of a sequence fit each other.

    Looks at some frames spread over the sequence, and says what is wrong, how sure that is, and which option or step
    mends it. Exit status: 0 where nothing would make a map wrong, 1 where something would. map, tune, refine and train
    --supervision map begin with a quick form of it, on three frames; with --strict they stop where it finds something.
    """

    sequence: tyro.conf.Positional[str]
    """Folder of one sequence, or sample:NAME."""
    out: Path | None = None
    """JSON file for what is found."""
    config: str | None = None
    """YAML file of jaxmap map, or the name of a bundled one, whose settings of reading and matching are taken."""
    settings: Annotated[CheckConfig, tyro.conf.arg(name="")] = field(default_factory=CheckConfig)


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(CheckArguments, "check", words, with_config=_with_config)

    from jaxmap.host.output_folder import check_inputs_stay
    from jaxmap.runs.checking import run_check

    config = arguments.settings
    if arguments.out is not None:
        check_inputs_stay((arguments.out,), (config.poses, config.calibration))
    console = Console()
    report = run_check(arguments.sequence, config, config.stereo, arguments.out, console.notify)
    seen = report.looked_at
    looked_at = f"{seen['frames']} of {seen['of']} frames and {seen['matches']:,} matches between left and right"
    if report.findings:
        rows = [
            {
                "kind": finding.kind,
                "stops": "map would be wrong" if finding.stops else "worth knowing",
                "confidence": f"{finding.confidence:.0%}",
                "what": finding.what,
                "fix": finding.fix,
            }
            for finding in report.findings
        ]
        columns = {
            "kind": "finding",
            "stops": "",
            "confidence": "sure",
            "what": "what is wrong",
            "fix": "mended by",
        }
        console.table(f"{arguments.sequence}: {len(rows)} found, in {looked_at}", columns, rows)
    else:
        rows_px = f", whose rows differ by {seen['row_error_px']:.2f} px" if "row_error_px" in seen else ""
        print(f"nothing wrong found, in {looked_at}{rows_px}")
    if arguments.out is not None:
        print(f"wrote {arguments.out}")
    return 1 if report.stops else 0


def _with_config(name: str) -> CheckArguments:
    """The defaults under a configuration; the required argument is filled in by the parser."""
    return CheckArguments(sequence=tyro.MISSING, config=name, settings=CheckConfig.of(load_config(name)))
