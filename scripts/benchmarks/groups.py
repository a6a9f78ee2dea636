"""All groups of cases, by name, in the order in which they run."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from benchmarks.harness import Case


class Group(NamedTuple):
    """A benchmark at its three sizes.

    Attributes:
        name: as given to `--only`.
        told: what it is, in one line.
        build: prepares the case of a size.
    """

    name: str
    told: str
    build: Callable[[str], Case]


def all_groups() -> list[Group]:
    """The groups."""
    from benchmarks import fusion_cases, network_cases, plane_cases, sequence_cases, step_cases, stereo_cases

    modules = (stereo_cases, plane_cases, fusion_cases, network_cases, step_cases, sequence_cases)
    return [group for module in modules for group in module.GROUPS]


def case_name(group: Group, size: str) -> str:
    """The name of a case in the JSON."""
    return f"{group.name} {size}"
