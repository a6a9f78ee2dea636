"""`jaxmap check`, and the quick form of it that other commands begin with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxmap.checks.check import QUICK, THOROUGH, CheckReport, check_sequence, open_front_end
from jaxmap.checks.finding import Finding
from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.errors import JaxmapError
from jaxmap.host.output_folder import write_json
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions

Notify = Callable[[str], None]


def run_check(
    source: str, options: ReadOptions, stereo: StereoOptions, out: Path | None, notify: Notify
) -> CheckReport:
    """Checks a sequence thoroughly.

    Args:
        source: the folder of one sequence, or `sample:NAME`.
        options: how it is read.
        stereo: how it would be matched.
        out: JSON file for what is found, if any.
        notify: takes lines for the user.

    Raises:
        JaxmapError: the sequence cannot be opened, or the file cannot be written.
    """
    sequence = open_sequence(source, options)
    for note in sequence.notes:
        notify(f"note: {note}")
    report = check_sequence(sequence, open_front_end(sequence, stereo, notify), THOROUGH)
    if out is not None:
        content = {
            "sequence": source,
            "dataset": sequence.dataset,
            **report_tree(report),
            "notes": list(sequence.notes),
        }
        write_json(out, content)
    return report


def report_tree(report: CheckReport) -> dict[str, Any]:
    """A report as plain values."""
    return {
        "stops": report.stops,
        "findings": findings_tree(report.findings),
        "looked_at": report.looked_at,
    }


def findings_tree(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """Findings as plain values."""
    return [finding._asdict() for finding in findings]


def warn_of_faults(
    sequence: StereoSequence, front_end: StereoFrontEnd, *, strict: bool, notify: Notify
) -> tuple[Finding, ...]:
    """The quick check that a command begins with: findings become notes.

    Raises:
        JaxmapError: something would make the map wrong, and `strict` is set.
    """
    findings = check_sequence(sequence, front_end, QUICK).findings
    for finding in findings:
        if strict and finding.stops:
            raise JaxmapError(finding.what, where=sequence.name, fix=f"{finding.fix}; or go on without --strict")
        # What was wrong with the pose file the reader's own notes say.
        if finding.kind != "unusable-poses":
            notify(f"note: {finding_line(finding)}")
    return findings


def finding_line(finding: Finding) -> str:
    """A finding in one line."""
    return f"{finding.what}; {finding.fix} ({finding.kind}, {finding.confidence:.0%} sure)"
