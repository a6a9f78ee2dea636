"""Which images train and which validate, from the names of files and from split lists."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxmap.datasets.images import IMAGE_SUFFIXES
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.models.tensor_files import shortened

TRAIN_LIST, VALIDATION_LIST = "train.txt", "val.txt"

Files = Mapping[str, Sequence[Path]]
"""The files of each name; a sound folder has one for each."""


class Split(NamedTuple):
    """Sorted names that train and validate, and what should be known about how they were chosen."""

    train: tuple[str, ...]
    validation: tuple[str, ...]
    notes: tuple[str, ...]


class _Lists(NamedTuple):
    train: list[str] | None
    validation: list[str] | None


def find_files(folder: Path, suffixes: Sequence[str]) -> Files:
    """The files with one of these suffixes in a folder and its subfolders, by path without suffix (`sub/NAME`).

    Hidden files and folders are passed over, and links to folders are not followed.

    Raises:
        JaxmapError: the folder is missing, cannot be read, or holds none.
    """
    found: dict[str, list[Path]] = {}

    def refuse(fault: OSError) -> None:
        fix = "training data is a folder of images/NAME.jpg and masks/NAME.png"
        raise JaxmapError(f"the folder cannot be read ({fault.strerror})", where=folder, fix=fix) from fault

    for place, subfolders, files in os.walk(folder, onerror=refuse):
        subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
        for path in (Path(place, name) for name in sorted(files) if not name.startswith(".")):
            if path.suffix.lower() in suffixes:
                found.setdefault(path.relative_to(folder).with_suffix("").as_posix(), []).append(path)
    if not found:
        raise JaxmapError(f"no {suffixes[0]} file", where=folder, fix=f"put files there ({' '.join(suffixes)})")
    return found


def split_names(folder: Path, images: Files, masks: Files, *, validation_share: float, seed: int) -> Split:
    """Divides the images of a folder into those that train and those that validate.

    `train.txt` and `val.txt` say so by name; with one of them only, the other images are the other
    part; without either, a share of the images validates, drawn by the seed.

    Args:
        folder: where the lists are.
        images: the image files by name.
        masks: the mask files by name.
        validation_share: share of the images that validates where there is no list, in [0, 1).
        seed: of the draw, which depends on nothing else but the names.

    Raises:
        UsageError: the share is out of range.
        JaxmapError: a list cannot be read, or names and files do not fit; all that does not is told together.
    """
    if not 0 <= validation_share < 1:
        raise UsageError(f"a share of {validation_share}", where="--data.validation-share", fix="give 0 to below 1")
    problems = [*_file_problems(images, "images"), *_file_problems(masks, "masks")]
    lists = _Lists(_listed(folder / TRAIN_LIST, images, problems), _listed(folder / VALIDATION_LIST, images, problems))
    split = _drawn(images, validation_share, seed) if lists == (None, None) else _by_lists(lists, images)
    if twice := sorted(set(split.train) & set(split.validation)):
        problems.append(f"{_count(twice, 'name')} in both {TRAIN_LIST} and {VALIDATION_LIST}: {shortened(twice)}")
    used = {*split.train, *split.validation}
    if bare := sorted(used - masks.keys()):
        problems.append(f"{_count(bare, 'image')} without a mask: {shortened(bare)}")
    # Where both lists say what is used, nobody asks for the rest.
    if None in lists and (stray := sorted(masks.keys() - images.keys())):
        problems.append(f"{_count(stray, 'mask')} without an image: {shortened(stray)}")
    if not split.train and not problems:
        problems.append("no image is left to train on")
    if problems:
        fix = f"each images/NAME needs a masks/NAME.png, each name stands once in {TRAIN_LIST} or {VALIDATION_LIST}"
        raise JaxmapError("; ".join(problems), where=folder, fix=fix)
    return split


def _file_problems(files: Files, kind: str) -> list[str]:
    twice = [f"{name} ({', '.join(path.name for path in paths)})" for name, paths in files.items() if len(paths) > 1]
    return [f"{_count(twice, 'name')} of several {kind}: {shortened(twice)}"] if twice else []


def _listed(path: Path, images: Files, problems: list[str]) -> list[str] | None:
    """The names of a list, or None where there is no list; what is wrong with it goes to `problems`."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as fault:
        raise JaxmapError(f"the list cannot be read ({fault})", where=path, fix="write one name a line") from fault
    texts = [text for line in lines if (text := re.split(r"(?:^|\s)#", line)[0].strip())]
    names = [_name(text, images) for text in texts]
    if unknown := sorted({name for name in names if name not in images}):
        problems.append(f"{_count(unknown, 'name')} without an image in {path.name}: {shortened(unknown)}")
    if twice := sorted(name for name, times in Counter(names).items() if times > 1):
        problems.append(f"{_count(twice, 'name')} listed twice in {path.name}: {shortened(twice)}")
    return [name for name in names if name in images]


def _name(text: str, images: Files) -> str:
    """The name that a line means, with or without the suffix of the image."""
    stem, dot, suffix = text.rpartition(".")
    return stem if text not in images and f"{dot}{suffix}".lower() in IMAGE_SUFFIXES else text


def _by_lists(lists: _Lists, images: Files) -> Split:
    train, validation = lists
    listed = {*(train or ()), *(validation or ())}
    rest = sorted(images.keys() - listed)
    notes = []
    if train is not None and validation is not None and rest:
        notes.append(f"{_count(rest, 'image')} in neither {TRAIN_LIST} nor {VALIDATION_LIST}: not used")
    parts = [tuple(rest if names is None else sorted(set(names))) for names in (train, validation)]
    if not parts[1]:
        notes.append("no image validates")
    return Split(parts[0], parts[1], tuple(notes))


def _drawn(images: Iterable[str], share: float, seed: int) -> Split:
    names = sorted(images)
    count = min(max(round(share * len(names)), 1), len(names) - 1) if share > 0 else 0
    # By hashes, so that a few more images leave nearly all others where they were.
    chosen = set(sorted(names, key=lambda name: _rank(name, seed))[:count])
    note = f"{count} of {len(names)} images validate, drawn by seed {seed}" if count else "no image validates"
    train, validation = (tuple(name for name in names if (name in chosen) == flag) for flag in (False, True))
    return Split(train, validation, (note,))


def _rank(name: str, seed: int) -> bytes:
    return hashlib.sha256(os.fsencode(f"{seed}/{name}")).digest()


def _count(items: Sequence[object], noun: str) -> str:
    return f"{len(items)} {noun}{'' if len(items) == 1 else 's'}"
