"""Which images of a planetary archive make stereo pairs of one linear camera; what is left out is noted."""

from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path
from typing import NamedTuple

from jaxmap.datasets.pds_groups import LABEL_SUFFIXES, is_label
from jaxmap.datasets.pds_labels import ProductLabel, read_label
from jaxmap.errors import JaxmapError
from jaxmap.stereo.linearise import LinearPair, SharedView, linearise, share_view

MAX_APART_S = 1.0
"""Left and right whose clocks differ by less make a pair; the clocks of most pairs agree."""

CAMERAS = (
    ("navcam", ("NAV", "N*")),
    ("front_hazcam", ("FHAZ", "FRONT", "F*")),
    ("rear_hazcam", ("RHAZ", "REAR", "R*")),
    ("pancam", ("PANCAM", "PANORAMIC", "P*")),
    ("mastcam_z", ("MCZ", "ZCAM", "MASTCAM_Z", "MASTCAM-Z", "Z*")),
    ("mastcam", ("MAST", "M*")),
    ("other", ("",)),
)
"""Names for `ReadOptions.camera`, and what the instrument's name then holds."""


class StereoProduct(NamedTuple):
    """A stereo pair: its labels and its linear form."""

    left: ProductLabel
    right: ProductLabel
    pair: LinearPair


def read_labels(folder: Path, notes: list[str]) -> list[ProductLabel]:
    """The labels of a folder's images, one for each name; what cannot be used is noted, once for each reason.

    Raises:
        JaxmapError: none can be used.
    """
    by_stem: dict[str, Path] = {}
    files = [file for file in sorted(folder.iterdir()) if is_label(file)]
    for file in sorted(files, key=lambda file: LABEL_SUFFIXES.index(file.suffix.lower())):
        by_stem.setdefault(file.stem.upper(), file)
    labels: list[ProductLabel] = []
    faults: defaultdict[str, list[JaxmapError]] = defaultdict(list)
    for file in sorted(by_stem.values()):
        try:
            label = read_label(file)
        except JaxmapError as fault:
            faults[fault.what].append(fault)
        else:
            labels += [label] if label else []
    if not labels:
        first = next(iter(faults.values()))[0] if faults else None
        raise JaxmapError(
            f"none of {len(by_stem)} products can be used" + (f": {first.what}" if first else ": none is an image"),
            where=first.where if first else folder,
            fix=first.fix if first else "give a folder of stereo images",
        )
    for what, same in faults.items():
        notes.append(f"{len(same)} of {len(by_stem)} images are left out: {what} (first: {same[0].where})")
    if any(label.model_is_of_frame for label in labels):
        notes.append("camera models of the full frame are shifted and scaled to the parts that were read out")
    return labels


def of_one_camera(labels: list[ProductLabel], camera: str | None, folder: Path) -> list[ProductLabel]:
    """The images of the camera that is asked for, or of the only one with both eyes.

    Raises:
        JaxmapError: several have both eyes and none is asked for, or there are none of that one.
    """
    by_camera: defaultdict[str, list[ProductLabel]] = defaultdict(list)
    for label in labels:
        by_camera[_camera_of(label.rig)].append(label)
    if camera is None and len(by_camera) > 1:
        both = [name for name, its in by_camera.items() if len({label.eye for label in its}) == 2]
        if len(both) != 1:
            found = ", ".join(f"{name} ({len(its)} images)" for name, its in sorted(by_camera.items()))
            raise JaxmapError(f"images of several cameras: {found}", where=folder, fix="choose one with --camera")
        camera = both[0]
    chosen = by_camera.get(camera or next(iter(by_camera)), [])
    if not chosen:
        raise JaxmapError(f"no images of {camera}, only of {', '.join(sorted(by_camera))}", where=folder)
    return chosen


def _camera_of(rig: str) -> str:
    return next(name for name, words in CAMERAS if any(word in rig for word in words))


def paired(labels: list[ProductLabel], folder: Path, notes: list[str]) -> list[tuple[ProductLabel, ProductLabel]]:
    """Left and right of one clock reading and instrument; of several products the largest that both eyes have.

    They come in the order of the clock.

    Raises:
        JaxmapError: there is no pair.
    """
    pairs, lone, spare, unequal = [], 0, 0, 0
    for both in _exposures(labels):
        forms = [{_form(label) for label in its} for its in both.values()]
        shared = forms[0] & forms[1]
        if not shared:
            lone += not (forms[0] and forms[1])
            unequal += bool(forms[0] and forms[1])
            continue
        # The later name is the newer version of a product.
        left, right = (
            max((label for label in its if _form(label) == max(shared)), key=lambda label: label.path.stem)
            for its in both.values()
        )
        pairs.append((left, right))
        spare += sum(map(len, both.values())) - 2
    if not pairs:
        raise JaxmapError(
            f"no pair among {len(labels)} images: {lone} exposures with one eye only, {unequal} with eyes of different "
            f"sizes or kinds{'; ' * bool(notes)}{'; '.join(notes[:1])}",
            where=folder,
            fix="left and right must have one SPACECRAFT_CLOCK_START_COUNT, within 1 s, and one size",
        )
    if lone:
        notes.append(f"{lone} exposures have one eye only and are left out")
    if unequal:
        notes.append(f"{unequal} pairs have eyes of different sizes or kinds and are left out")
    if spare:
        notes.append(f"{spare} further products of the same exposures are left out: smaller ones, older versions")
    return sorted(pairs, key=lambda pair: pair[0].clock_s)


def _form(label: ProductLabel) -> tuple[int, tuple[int, int], int, str]:
    """What both eyes of a pair must share; the greatest is the best."""
    return label.size_px[0] * label.size_px[1], label.size_px, label.bands, label.product_kind


def _exposures(labels: list[ProductLabel]) -> list[dict[str, list[ProductLabel]]]:
    """The products of each exposure, by eye: of one clock reading, or two eyes less than `MAX_APART_S` apart."""
    by_clock: defaultdict[tuple[str, float], dict[str, list[ProductLabel]]] = defaultdict(
        lambda: {"left": [], "right": []}
    )
    for label in labels:
        by_clock[label.rig, round(label.clock_s, 3)][label.eye].append(label)
    lone_rights = [key for key, both in by_clock.items() if not both["left"]]
    for key in sorted(key for key, both in by_clock.items() if not both["right"]):
        near = [other for other in lone_rights if other[0] == key[0] and abs(other[1] - key[1]) < MAX_APART_S]
        if near:
            nearest = min(near, key=lambda other: abs(other[1] - key[1]))
            lone_rights.remove(nearest)
            by_clock[key]["right"] = by_clock.pop(nearest)["right"]
    return list(by_clock.values())


def of_one_site(
    pairs: list[tuple[ProductLabel, ProductLabel]], notes: list[str]
) -> list[tuple[ProductLabel, ProductLabel]]:
    """The pairs whose poses refer to the site that most refer to: each site has its own origin."""
    sites = Counter(left.site for left, _ in pairs)
    if len(sites) < 2:
        return pairs
    site, count = sites.most_common(1)[0]
    others = ", ".join(str(other) for other in sorted(sites, key=str) if other != site)
    notes.append(f"{len(pairs) - count} of {len(pairs)} pairs are of other sites than {site} ({others}), left out")
    return [pair for pair in pairs if pair[0].site == site]


def linearised(
    pairs: list[tuple[ProductLabel, ProductLabel]], notes: list[str]
) -> tuple[list[StereoProduct], SharedView]:
    """The pairs linearised, those of the view that most share.

    Raises:
        JaxmapError: none can be linearised.
    """
    products: list[StereoProduct] = []
    faults: list[JaxmapError] = []
    for left, right in pairs:
        try:
            if left.model_frame != right.model_frame:
                raise JaxmapError(
                    f"the eyes' models are in {left.model_frame} and {right.model_frame}", where=left.path
                )
            pair = linearise(left.model, right.model, left.size_px, where=left.path)
        except JaxmapError as fault:
            faults.append(fault)
        else:
            products.append(StereoProduct(left, right, pair))
    if not products:
        raise faults[0]
    if faults:
        notes.append(f"{len(faults)} of {len(pairs)} pairs are left out: {faults[0].what} (first: {faults[0].where})")
    shared = share_view([product.pair for product in products])
    if others := len(products) - len(shared.kept):
        notes.append(
            f"{others} of {len(pairs)} pairs have another size, zoom, part of the detector or baseline, left out"
        )
    kept = [products[index]._replace(pair=pair) for index, pair in zip(shared.kept, shared.pairs, strict=True)]
    return kept, shared
