"""What the pixels of a mask stand for: class indices, other values, or colours.

`train`, `segment` and the labels of `map --labeller files` are all read here.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Int32, UInt8
from PIL import Image

from jaxmap.datasets.images import decode_deep, has_deep_colours
from jaxmap.errors import FrameError, JaxmapError, UsageError
from jaxmap.host.pictures import open_picture, oriented, raw_mode, turn_of
from jaxmap.labels import ANY_OTHER, IGNORE
from jaxmap.models.tensor_files import shortened

IGNORED = "ignore"
"""What a remap or a palette calls pixels that carry no class."""
REST = "*"
"""Stands for every value or colour that is not named."""
NOT = "not "
"""Before a class, stands for any class but that one."""
UNNAMED = 253
"""What `MaskLookup.table` holds for a code that stands for nothing."""

MASK_SUFFIXES = (".png", ".tif", ".tiff", ".bmp")
"""Of files that keep values as they are, in any case; JPEG does not."""

_VALUES, _COLOURS = 1 << 16, 1 << 24
_SPREAD = {"L;2": 85, "L;4": 17}
"""Pillow spreads grey levels of 2 and 4 bits over all of 8, by these factors."""
_LISTED = 8

Kind = Literal["indices", "values", "colours"]


class MaskLookup(NamedTuple):
    """Turns the codes of a mask into labels.

    Attributes:
        classes: names in the order of the labels.
        kind: whether a code is a class index, another value, or a colour (`0xRRGGBB`).
        table: the label of every code; `UNNAMED` where it stands for nothing.
        negated: index of the class that pixels labelled `ANY_OTHER` are not of; None where no code says that.
        option: what the options of remap and palette begin with on the command line, for errors.
    """

    classes: tuple[str, ...]
    kind: Kind
    table: UInt8[np.ndarray, " N"]
    negated: int | None = None
    option: str = "--data."


def make_mask_lookup(
    classes: Sequence[str],
    remap: Mapping[str, str] | None = None,
    palette: Mapping[str, str] | None = None,
    *,
    option: str = "--data.",
    all_classes: bool = True,
) -> MaskLookup:
    """Makes the lookup from the pixels of masks to labels; by default they are class indices, and 255 for none.

    Args:
        classes: names in the order of the labels.
        remap: class, `"not CLASS"` or `"ignore"`, by value of the mask (0 to 65535); the key `"*"` is every other
            value.
        palette: colours by the same names: `"#rrggbb"`, several with blanks between them, or `"*"` for every
            other colour.
        option: what the two options begin with on the command line, for errors.
        all_classes: whether each class must be named, as training needs it; masks to score against may hold fewer.

    Raises:
        UsageError: faulty classes, values or colours, something named twice, a class that nothing stands for, or
            several negated ones.
    """
    names = _checked_classes(classes)
    if remap and palette:
        raise UsageError(
            "masks have either values or colours", where=f"{option}palette", fix=f"leave out {option}remap"
        )
    if palette:
        named, rest = _named_colours(palette, f"{option}palette")
        return _lookup("colours", names, named, rest, option, all_classes)
    if remap:
        named, rest = _named_values(remap, f"{option}remap")
        return _lookup("values", names, named, rest, option, all_classes)
    return _lookup("indices", names, {**dict(enumerate(names)), IGNORE: IGNORED}, None, option, all_classes)


def find_mask(folder: Path, name: str) -> Path | None:
    """The file `NAME.png` in a folder, or of another of `MASK_SUFFIXES` in any case; None without any."""
    plain = folder / f"{name}.png"
    if plain.is_file():
        return plain
    ends = sorted({end for suffix in MASK_SUFFIXES for end in (suffix, suffix.upper(), suffix.title())})
    return next((path for end in ends if (path := folder / f"{name}{end}").is_file()), None)


def read_codes(path: Path, lookup: MaskLookup) -> Int32[np.ndarray, "H W"]:
    """The pixels of a mask, as viewers show it, as indices of `lookup.table`.

    Values are the stored ones, see `read_values`; colours are the displayed ones.

    Raises:
        FrameError: the file is missing, broken, or of colours where values are asked for.
    """
    if lookup.kind != "colours":
        return read_values(
            path, as_shown=True, fix=f"say which colour is which class: {lookup.option}palette CLASS '#rrggbb' ..."
        )
    with open_picture(path, "mask") as image:
        turn = turn_of(image)
        pixels = oriented(np.array(image.convert("RGB")), turn, as_shown=True)
    red, green, blue = (pixels[..., channel].astype(np.int32) for channel in range(3))
    return (red << 16) | (green << 8) | blue


def read_values(
    path: Path, *, as_shown: bool = False, fix: str = "write class indices as 8-bit grey or palette"
) -> Int32[np.ndarray, "H W"]:
    """The values of a label image: the indices of a palette, 0 and 1 of two levels, grey levels of up to 16 bits.

    Grey stored as RGB counts as grey, and alpha is dropped.

    Args:
        path: the file.
        as_shown: whether its rotation tag is applied, as to a photograph that it belongs to.
        fix: what to do about colours.

    Raises:
        FrameError: the file is missing, broken, or in colour.
    """
    with open_picture(path, "mask") as image:
        turn, raw = turn_of(image), raw_mode(image)
        pixels = decode_deep(image, path) if has_deep_colours(image) else np.array(_without_alpha(image))
    if raw in _SPREAD:
        pixels = pixels // _SPREAD[raw]
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        if (pixels != pixels[..., :1]).any():
            raise FrameError("the mask is in colour", where=path, fix=fix)
        pixels = pixels[..., 0]
    if pixels.ndim != 2 or pixels.dtype.kind not in "bui" or not 0 <= pixels.min() <= pixels.max() < _VALUES:
        raise FrameError("the mask holds no values of 8 or 16 bits", where=path, fix="write it as 8-bit grey")
    return oriented(pixels.astype(np.int32), turn, as_shown=as_shown)


def read_labels(path: Path, lookup: MaskLookup) -> UInt8[np.ndarray, "H W"]:
    """The labels of a mask: class indices, 255 for none, and 254 for any class but the negated one.

    Raises:
        JaxmapError: the mask cannot be read, or holds codes that stand for nothing.
    """
    codes = read_codes(path, lookup)
    labels = lookup.table[codes]
    unnamed = labels == UNNAMED
    if unnamed.any():
        raise unnamed_codes(lookup, np.unique(codes[unnamed]).tolist(), path)
    return labels


def unnamed_codes(lookup: MaskLookup, codes: Iterable[int], where: object) -> JaxmapError:
    """The error for codes that stand for nothing."""
    listed = shortened([code_text(lookup, code) for code in codes], _LISTED)
    if lookup.kind == "colours":
        what, fix = (
            f"{lookup.option}palette does not name the colours {listed}",
            f'name them, or give "{REST}" to one class',
        )
    elif lookup.kind == "values":
        what, fix = f"{lookup.option}remap does not name the values {listed}", f'name them, or "{REST}" for the rest'
    else:
        last = len(lookup.classes) - 1
        what = f"the values {listed} are no class (0 to {last}, and {IGNORE} for none)"
        order = "give all --classes in order" if lookup.option == "--data." else "take masks of the network's classes"
        fix = f"{order}, or say what each value stands for: {lookup.option}remap VALUE CLASS ..."
    return JaxmapError(what, where=where, fix=fix)


def unlabelled_notes(lookup: MaskLookup, labels: Iterable[int]) -> list[str]:
    """A note where masks to score against label hardly anything, as those do that write 255 for a class.

    Args:
        lookup: what their pixels stand for.
        labels: all that they hold.
    """
    held = set(labels)
    classes = [name for index, name in enumerate(lookup.classes) if index in held]
    if lookup.kind != "indices" or IGNORE not in held or len(classes) > 1:
        return []
    only = f"only {classes[0]} and {IGNORE} (no label)" if classes else f"nothing but {IGNORE} (no label)"
    named = [f"{lookup.classes.index(name)} {name}" for name in classes]
    return [
        f"the masks hold {only}: if {IGNORE} stands for a class, say so: "
        f"{lookup.option}remap {' '.join([*named, str(IGNORE)])} CLASS"
    ]


def absent_classes(
    lookup: MaskLookup, absent: Sequence[str], seen: Bool[np.ndarray, " N"], where: object
) -> JaxmapError:
    """The error for classes that no training mask holds.

    Args:
        lookup: what the pixels stand for.
        absent: the classes.
        seen: whether the training masks hold a code.
        where: the folder.
    """
    codes = np.flatnonzero(seen).tolist()
    held = shortened([f"{code_text(lookup, code)} ({meaning(lookup, code)})" for code in codes], _LISTED)
    option = f"{lookup.option}{'palette' if lookup.kind == 'colours' else 'remap'}"
    fix = f"train on images that show {absent[0]}, leave it out of --classes, or correct {option}"
    if lookup.kind == "indices" and len(absent) == 1 and seen[IGNORE]:
        # Binary masks are often written as 0 and 255.
        named = [f"{code} {absent[0] if code == IGNORE else meaning(lookup, code)}" for code in codes]
        fix = f"if {IGNORE} stands for {absent[0]}, say so: {option} {' '.join(named)}"
    what = f"no pixel of the training masks is {shortened(list(absent))}; they hold {held}"
    return JaxmapError(what, where=where, fix=fix)


def code_text(lookup: MaskLookup, code: int) -> str:
    """A code as people write it: a number, or `#rrggbb`."""
    return f"#{code:06x}" if lookup.kind == "colours" else str(code)


def meaning(lookup: MaskLookup, code: int) -> str:
    """The class that a code stands for, `"not CLASS"`, or `"ignore"`."""
    label = int(lookup.table[code])
    if label == ANY_OTHER:
        assert lookup.negated is not None
        return NOT + lookup.classes[lookup.negated]
    return IGNORED if label == IGNORE else lookup.classes[label]


def _checked_classes(classes: Sequence[str]) -> tuple[str, ...]:
    names = tuple(classes)
    if not 1 <= len(names) <= UNNAMED or len(set(names)) != len(names) or not all(names):
        fix = f"give 1 to {UNNAMED} different names"
        raise UsageError(f"faulty classes {shortened(list(names), _LISTED) or '(none)'}", where="--classes", fix=fix)
    if forbidden := {IGNORED, REST} & set(names):
        raise UsageError(f"no class can be called {forbidden.pop()}", where="--classes", fix="name it otherwise")
    return names


def _named_values(remap: Mapping[str, str], where: str) -> tuple[dict[int, str], str | None]:
    named: dict[int, str] = {}
    for key, name in remap.items():
        if str(key) == REST:
            continue
        text = str(key).strip()
        if not re.fullmatch("[0-9]{1,5}", text) or int(text) >= _VALUES:
            raise UsageError(f"{key!r} is no value of a mask", where=where, fix=f'give 0 to {_VALUES - 1}, or "{REST}"')
        if named.setdefault(int(text), name) != name:
            raise UsageError(f"two classes for the value {text}", where=where, fix="name it once")
    return named, remap.get(REST)


def _named_colours(palette: Mapping[str, str], where: str) -> tuple[dict[int, str], str | None]:
    named: dict[int, str] = {}
    rest: str | None = None
    for name, colours in palette.items():
        for colour in colours.replace(",", " ").split():
            if colour == REST:
                if rest is not None:
                    raise UsageError(f'"{REST}" is given to {rest} and {name}', where=where, fix="give it to one")
                rest = name
                continue
            if not re.fullmatch("#[0-9a-fA-F]{6}", colour):
                raise UsageError(f"{colour!r} is no colour", where=where, fix="give #rrggbb")
            code = int(colour[1:], 16)
            if (other := named.setdefault(code, name)) != name:
                raise UsageError(f"{other} and {name} share #{code:06x}", where=where, fix="a colour is one class's")
    return named, rest


def _lookup(
    kind: Kind, classes: tuple[str, ...], named: Mapping[int, str], rest: str | None, option: str, all_classes: bool
) -> MaskLookup:
    where = f"{option}{'palette' if kind == 'colours' else 'remap'}"
    label = {NOT + name: ANY_OTHER for name in classes}
    label |= {**{name: index for index, name in enumerate(classes)}, IGNORED: IGNORE}
    given = {*named.values(), *([] if rest is None else [rest])}
    if unknown := sorted(map(str, given - label.keys())):
        fix = f"the classes are {', '.join(classes)}; {NOT}CLASS and {IGNORED} are known, too"
        raise UsageError(f"unknown class {shortened(unknown)}", where=where, fix=fix)
    if all_classes and (missing := [name for name in classes if name not in given]):
        raise UsageError(f"nothing stands for {shortened(missing)}", where=where, fix="name every class")
    negated = sorted(name for name in given if label[name] == ANY_OTHER)
    if len(negated) > 1:
        raise UsageError(f"several classes are negated: {shortened(negated)}", where=where, fix="negate one of them")
    if negated and len(classes) == 1:
        raise UsageError(f"{negated[0]} leaves no class", where=where, fix="name the others in --classes")
    table = np.full(_COLOURS if kind == "colours" else _VALUES, UNNAMED if rest is None else label[rest], np.uint8)
    for code, name in named.items():
        table[code] = label[name]
    return MaskLookup(classes, kind, table, classes.index(negated[0].removeprefix(NOT)) if negated else None, option)


def _without_alpha(image: Image.Image) -> Image.Image:
    return image.convert(image.mode[:-1]) if image.mode in ("LA", "PA", "RGBA") else image
