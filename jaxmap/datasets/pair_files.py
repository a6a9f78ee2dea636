"""Which right image belongs to which left one: by name, by name without the word for the side, or by time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmap.datasets.pairing import nearest_pairs
from jaxmap.datasets.units import PER_SECOND, unit_by_size
from jaxmap.errors import JaxmapError

_LEFT, _RIGHT = "left|cam_?0|camera_?0|l|0", "right|cam_?1|camera_?1|r|1"
_MIN_UNIX_TIME_S = 1e8
_LONE_TOLERANCE_NS = 5_000_000
_UNSYNCHRONISED_NS = 5_000_000
_FAR_NS = 2**61


class FilePairs(NamedTuple):
    """Pairs of files.

    Attributes:
        right: the partner of each left image, None where it has none; one that should be there may be missing.
        keys: the names of the left images without suffix and word for the side; of a time, the number alone.
        notes: how they were paired, and how many images are left over.
    """

    right: tuple[Path | None, ...]
    keys: tuple[str, ...]
    notes: tuple[str, ...]


def pair_files(left: Sequence[Path], right: Sequence[Path]) -> FilePairs:
    """Pairs the images of two cameras.

    Where names agree (without suffix), names decide, and a left image without partner is given one that does not exist,
    which reading reports. If some are times that differ between the cameras (`is_time`), the images nearest in time are
    paired, up to half the time between frames. Else names are compared without `left_`, `_right`, `cam0_` and the like.

    Args:
        left: the images of the left camera, at least one.
        right: those of the right camera, at least one.

    Raises:
        JaxmapError: no left image has a partner.
    """
    keys = tuple(_without_side(path.stem, _LEFT) for path in left)
    right_keys = [_without_side(path.stem, _RIGHT) for path in right]
    by_stem = {path.stem: path for path in right}
    alike = [path.stem in by_stem for path in left]
    times = all(map(is_time, [*keys, *right_keys]))
    if all(alike) or (any(alike) and not times):
        return FilePairs(tuple(by_stem.get(path.stem, right[0].with_name(path.name)) for path in left), keys, ())
    if times:
        return _by_time(keys, right_keys, left, right)
    by_key = dict(zip(right_keys, right, strict=True))
    if len(set(keys)) == len(left) and len(by_key) == len(right) and by_key.keys() & set(keys):
        partners = tuple(by_key.get(key) for key in keys)
        return FilePairs(partners, keys, tuple(_left_over(partners, right)))
    raise JaxmapError(
        f"left and right images share no name: {left[0].name} and {right[0].name} are the first",
        where=right[0].parent,
        fix="name the two images of a pair alike, or each by its time",
    )


def is_time(name: str) -> bool:
    """Whether a name is a time: a number with a decimal point, or of 1e8 and more; smaller ones count the frames."""
    return is_number(name) and ("." in name or float(name) >= _MIN_UNIX_TIME_S)


def is_number(name: str) -> bool:
    """Whether a name is a number of fewer than 40 digits."""
    return len(name) < 40 and re.fullmatch(r"[0-9]+(\.[0-9]+)?", name) is not None


def units_per_second(times: np.ndarray) -> float:
    """Seconds up to 1e11, then milliseconds, from 1e14 on microseconds, from 1e17 on nanoseconds."""
    return PER_SECOND[unit_by_size(float(np.abs(times).max())) or "s"]


def _without_side(stem: str, words: str) -> str:
    """A name without the word for its side at the beginning or the end, set off by a mark or, if long, a digit.

    Of a name that ends in a time, such as `img_1700000000.25` or `1700000000_250000000` (s, ns), the time is left.
    """
    if is_number(stem):
        return stem
    long = words.split("|")[0]
    pattern = rf"^(?:(?:{words})[-_.]+|{long}(?=[0-9]))|(?:[-_.]+(?:{words})|(?<=[0-9]){long})$"
    name = re.sub(pattern, "", stem, flags=re.IGNORECASE) or stem
    if found := re.fullmatch(r"(?:[A-Za-z_-]*[A-Za-z][-_]*)?([0-9]{9,10})[-_]([0-9]{9})", name):
        return f"{found[1]}.{found[2]}"
    found = re.fullmatch(r"[A-Za-z_-]*[A-Za-z][-_]*([0-9]+(?:\.[0-9]+)?)", name)
    return found[1] if found and is_time(found[1]) else name


def _by_time(keys: Sequence[str], right_keys: Sequence[str], left: Sequence[Path], right: Sequence[Path]) -> FilePairs:
    scale = 10**9 // int(units_per_second(np.array([float(key) for key in keys])))
    whole = [[int(Decimal(key) * scale) for key in names] for names in (keys, right_keys)]
    first = min(whole[0])
    times_ns = [np.array([min(max(time - first, -_FAR_NS), _FAR_NS) for time in side], np.int64) for side in whole]
    orders = [np.argsort(times, kind="stable") for times in times_ns]
    left_ns, right_ns = (times[order] for times, order in zip(times_ns, orders, strict=True))
    gaps_ns = np.concatenate([np.diff(left_ns), np.diff(right_ns)])
    # Where frames are lost gaps are longer than the time between frames, so that the short ones tell it.
    tolerance_ns = int(np.quantile(gaps_ns, 0.1, method="lower")) // 2 if len(gaps_ns) else _LONE_TOLERANCE_NS
    mine, theirs, nearest_ns = nearest_pairs(left_ns, right_ns, tolerance_ns)
    if not len(mine):
        raise JaxmapError(
            f"no left and right images lie within {tolerance_ns / 1e6:g} ms of each other by the times in their names; "
            f"the nearest are {nearest_ns / 1e9:g} s apart",
            where=right[0].parent,
            fix="check that both folders are of one recording and one clock",
        )
    partners: list[Path | None] = [None] * len(left)
    for i, j in zip(orders[0][mine], orders[1][theirs], strict=True):
        partners[i] = right[j]
    farthest_ns = int(np.abs(left_ns[mine] - right_ns[theirs]).max())
    notes = [f"left and right images are paired by the times in their names, up to {farthest_ns / 1e6:g} ms apart"]
    if farthest_ns > _UNSYNCHRONISED_NS:
        notes.append("the two cameras did not expose together: what they saw while moving gives wrong depths")
    return FilePairs(tuple(partners), tuple(keys), (*notes, *_left_over(partners, right)))


def _left_over(partners: Sequence[Path | None], right: Sequence[Path]) -> list[str]:
    lone, others = partners.count(None), len(right) - len({path for path in partners if path is not None})
    return [f"{lone} left and {others} right images have no partner and are left out"] if lone or others else []
