"""Finding a network among the names that trainers, compilers and checkpoints put around it.

A checkpoint of Lightning's holds `state_dict.model.encoder...`, one of a compiled network `_orig_mod.encoder...`, one
with averaged weights the same network twice. All of it is one rule: behind which common prefix is a network known?
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

_TRANSPARENT = re.compile(r"(?<![^.])(_orig_mod|module|_fsdp_wrapped_module|_checkpoint_wrapped_module)\.")
"""Parts that a wrapper puts before the names of a network or of any part of it."""

_BESIDE = re.compile(r"(^|[._])(optim|loss|criteri|metric|scheduler|scaler|callback)", re.IGNORECASE)
"""What is no part of a network, however large."""

_COPY = re.compile(r"(^|[._])(ema|averag|swa|teacher|shadow|best)", re.IGNORECASE)
"""Copies of the network, taken only where there is no other."""

_MAX_DEPTH = 6
_LARGE = 10_000
"""A buffer beside a network (mean, std, class weights) has fewer numbers, a layer more."""

Recognise = Callable[[Collection[str]], bool]
"""Whether names are those of a known network."""


class Choice(NamedTuple):
    """What of a file is taken.

    Attributes:
        names: the file's name of each tensor, by the network's.
        notes: lines for the user: where the network was found, and what is left out.
        fault: why what looks like a network is none; empty where all is well.
    """

    names: dict[str, str]
    notes: tuple[str, ...] = ()
    fault: str = ""


def choose_network(sizes: Mapping[str, int], recognise: Recognise) -> Choice:
    """Chooses the tensors of a network from those of a file.

    A prefix counts if the names behind it are a network's, and all that lies elsewhere is small, a copy of that
    network, or a loss or an optimiser: a backbone within a larger network is not taken for the whole.

    Args:
        sizes: how many numbers each tensor has, by its name in the file (of nested dicts joined by dots).
        recognise: tells the networks that are known.

    Returns:
        The choice; all names as they are where no network is found.
    """
    plain = {name: _TRANSPARENT.sub("", name) for name in sizes}
    if len(set(plain.values())) < len(plain):
        plain = {name: name for name in sizes}
    found = [prefix for prefix in _prefixes(plain.values()) if recognise(_behind(prefix, plain).keys())]
    fault = ""
    for prefix in sorted(found, key=lambda prefix: (bool(_COPY.search(prefix)), prefix.count("."))):
        names = _behind(prefix, plain)
        copies = [other for other in found if other != prefix and _behind(other, plain).keys() >= names.keys()]
        beside = [name for name in plain if name not in set(names.values())]
        others = [name for name in beside if not _under(copies, plain[name])]
        parts = [name for name in others if sizes[name] >= _LARGE and not _BESIDE.search(name)]
        if parts:
            fault = (
                fault or f"a network under {prefix!r} with other parts beside it ({parts[0]} and {len(parts) - 1} more)"
            )
            continue
        return Choice(names, (*_told(prefix, names), *_left_out(copies, others)))
    return Choice({name: name for name in sizes}, fault=fault)


def _prefixes(names: Collection[str]) -> list[str]:
    """All that whole parts of names may be behind, nothing at all first."""
    found = dict.fromkeys([""])
    for name in names:
        parts = name.split(".")[:-1]
        found |= dict.fromkeys(".".join(parts[:depth]) + "." for depth in range(1, min(len(parts), _MAX_DEPTH) + 1))
    return sorted(found, key=lambda prefix: prefix.count("."))


def _behind(prefix: str, plain: Mapping[str, str]) -> dict[str, str]:
    """The file's names of what is behind a prefix; of no prefix, without what is plainly no layer's."""
    names = {short.removeprefix(prefix): name for name, short in plain.items() if short.startswith(prefix)}
    return names if prefix else {short: name for short, name in names.items() if not _is_beside(short)}


def _is_beside(name: str) -> bool:
    return bool(_BESIDE.search(name)) or not ("." in name or "/" in name)


def _under(prefixes: Collection[str], name: str) -> bool:
    return any(name.startswith(prefix) for prefix in prefixes)


def _told(prefix: str, names: Mapping[str, str]) -> tuple[str, ...]:
    """Where the network was found, if not under its own names."""
    ours, theirs = next(iter(names.items()))
    return () if ours == theirs else (f"the network is what lies under {theirs.removesuffix(ours) or prefix!r}",)


def _left_out(copies: Collection[str], others: Collection[str]) -> tuple[str, ...]:
    kinds = dict.fromkeys([*copies, *(name if name.count(".") < 2 else name.split(".")[0] + "." for name in others)])
    return (f"left out: {', '.join([*kinds][:6])}{', ...' * (len(kinds) > 6)}",) if kinds else ()
