"""`jaxmap report`: writes the HTML report of a run again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from jaxmap.commands.console import Console, parse


@dataclass(frozen=True)
class ReportArguments:
    """Write report.html of a run again, from what is in its folder."""

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(ReportArguments, "report", words)

    from jaxmap.report.run_page import write_report
    from jaxmap.runs.folder import RunFolder

    RunFolder(arguments.run).settle_for_reading()
    Console().result(arguments.run, [write_report(arguments.run).name])
    return 0
