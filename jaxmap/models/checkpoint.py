"""Model files: one `.safetensors` with the weights of a network and the record of its architecture.

The metadata key `jaxmap` holds JSON: `format_version`, `architecture` (the fields of `Architecture`),
`classes`, `normalisation` and `holds` (`network`, or `backbone` where the rest is still to be trained).
"""

from __future__ import annotations

import dataclasses
import errno
import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import parse_json
from jaxmap.host.files import atomic_path
from jaxmap.models.architecture import Architecture
from jaxmap.models.file_kinds import kind_of_weights
from jaxmap.models.network import Weights, weight_shapes
from jaxmap.models.one_channel import with_complement
from jaxmap.models.tensor_files import as_float32, read_safetensors, shortened
from jaxmap.types import to_device

FORMAT_VERSION = 1

Holds = Literal["network", "backbone"]

_ELSEWHERE = {"classes", "mean", "std"}
"""Fields of `Architecture` that are stored beside it in the file, where other programs look for them."""


class SavedModel(NamedTuple):
    """The content of a model file.

    Attributes:
        architecture: the network.
        weights: its arrays by dotted path, float32.
        holds: `network`, or `backbone` where only the weights `backbone.*` are there.
    """

    architecture: Architecture
    weights: Weights
    holds: Holds


def save_model(
    path: str | PathLike[str],
    architecture: Architecture,
    weights: Mapping[str, object],
    *,
    holds: Holds = "network",
    half: bool = False,
) -> None:
    """Writes a model file atomically.

    Args:
        path: the file.
        architecture: the network.
        weights: its arrays by dotted path.
        holds: whether that is all of them, or those of the backbone.
        half: whether they are stored as float16, in half the space; `load_model` gives float32 either way.

    Raises:
        JaxmapError: the weights are not those of the network or too large for float16, or writing failed.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    arrays = {name: as_float32(np.asarray(value)) for name, value in weights.items()}
    check_weights(architecture, arrays, holds=holds, where=path)
    if half:
        arrays = _halved(arrays, path)
    fields = dataclasses.asdict(architecture)
    record = {
        "format_version": FORMAT_VERSION,
        "holds": holds,
        "architecture": {name: value for name, value in fields.items() if name not in _ELSEWHERE},
        "classes": list(architecture.classes),
        "normalisation": {"mean": list(architecture.mean), "std": list(architecture.std), "scale": "0 to 1, RGB"},
    }
    with atomic_path(path) as temporary:
        try:
            save_file(arrays, temporary, metadata={"jaxmap": json.dumps(record)})
        except SafetensorError as error:
            # The library wraps the operating system's error.
            code = errno.ENOSPC if "os error 28" in str(error) else errno.EIO
            raise OSError(code, str(error)) from error


def _halved(arrays: dict[str, np.ndarray], where: object) -> dict[str, np.ndarray]:
    with np.errstate(over="ignore"):
        halves = {name: value.astype(np.float16) for name, value in arrays.items()}
    if lost := [name for name, value in halves.items() if not np.isfinite(value).all()]:
        raise JaxmapError(
            f"numbers beyond {np.finfo(np.float16).max:.0f}, too large for half precision: {shortened(lost)}",
            where=where,
            fix="keep the model in full precision",
        )
    return halves


def load_model(path: str | PathLike[str]) -> SavedModel:
    """Reads a model file.

    Raises:
        JaxmapError: the file is missing, truncated, no model of jaxmap's, of a newer format, or its
            weights do not fit its architecture.
    """
    path = Path(path)
    if not path.is_file():
        raise JaxmapError("no such model file", where=path, fix="convert one with jaxmap weights import")
    if kind_of_weights(path) == "torch":
        raise JaxmapError(
            "weights of PyTorch's, no model of jaxmap's", where=path, fix="convert them with jaxmap weights import"
        )
    metadata, tensors = read_safetensors(path)
    architecture, holds = _read_record(metadata, path)
    tensors = {name: as_float32(value) for name, value in tensors.items()}
    check_weights(architecture, tensors, holds=holds, where=path)
    return SavedModel(architecture, {name: to_device(value) for name, value in tensors.items()}, holds)


def load_network(path: str | PathLike[str]) -> SavedModel:
    """Reads a model file that must hold a whole network; one of a single class comes as one of two (`with_complement`).

    Raises:
        JaxmapError: as `load_model`, or there is only a backbone.
    """
    saved = load_model(path)
    if saved.holds != "network":
        raise JaxmapError(
            f"the file holds only a backbone ({saved.architecture.backbone})", where=path, fix="train a network from it"
        )
    if len(saved.architecture.classes) == 1:
        arrays = {name: np.asarray(value) for name, value in saved.weights.items()}
        architecture, arrays = with_complement(saved.architecture, arrays)
        return SavedModel(architecture, {name: to_device(value) for name, value in arrays.items()}, saved.holds)
    return saved


def check_weights(
    architecture: Architecture, weights: Mapping[str, np.ndarray], *, holds: Holds = "network", where: object
) -> None:
    """Compares weights with what an architecture needs.

    Raises:
        JaxmapError: weights are missing, left over, misshapen or not finite; all are reported together.
    """
    expected = weight_shapes(architecture)
    if holds == "backbone":
        expected = {name: shape for name, shape in expected.items() if name.startswith("backbone.")}
    misshapen = [
        f"{name} is {list(weights[name].shape)}, not {list(shape)}"
        for name, shape in expected.items()
        if name in weights and tuple(weights[name].shape) != shape
    ]
    raise_mismatch(
        missing=[name for name in expected if name not in weights],
        left_over=[name for name in weights if name not in expected],
        misshapen=misshapen,
        not_finite=[name for name, value in weights.items() if not np.isfinite(value).all()],
        what=f"the weights are not those of {architecture.backbone} as described",
        where=where,
        fix="take the file and the architecture that belong together",
    )


def raise_mismatch(
    *,
    missing: list[str],
    left_over: list[str],
    misshapen: list[str],
    not_finite: list[str],
    what: str,
    where: object,
    fix: str,
) -> None:
    """Raises one error that lists all differences, or does nothing where there is none.

    Raises:
        JaxmapError: a list is not empty.
    """
    kinds = {"missing": missing, "left over": left_over, "misshapen": misshapen, "not finite": not_finite}
    parts = [f"{len(names)} {kind}: {shortened(names)}" for kind, names in kinds.items() if names]
    if parts:
        raise JaxmapError(f"{what} ({'; '.join(parts)})", where=where, fix=fix)


def _read_record(metadata: dict[str, str], path: Path) -> tuple[Architecture, Holds]:
    if "jaxmap" not in metadata:
        raise JaxmapError(
            "no model of jaxmap's: the metadata has no key jaxmap",
            where=path,
            fix="convert other networks with jaxmap weights import",
        )
    try:
        record = parse_json(metadata["jaxmap"], f"the metadata of {path}")
        version = record["format_version"]
        if not isinstance(version, int) or version < 1:
            raise ValueError(f"format_version is {version!r}")
        if version > FORMAT_VERSION:
            raise JaxmapError(
                f"written by a newer jaxmap: format {str(version)[:20]}, this one reads {FORMAT_VERSION}",
                where=path,
                fix="upgrade jaxmap",
            )
        fields = dict(record["architecture"], classes=record["classes"])
        fields.update((name, record["normalisation"][name]) for name in ("mean", "std"))
        holds = record.get("holds", "network")
        if holds not in get_args(Holds):
            raise ValueError(f"holds is {holds!r}")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as fault:
        reason = f"{type(fault).__name__}: {' '.join(str(fault).split())[:120]}"
        raise JaxmapError(
            f"the metadata key jaxmap is damaged ({reason})", where=path, fix="write the model file anew"
        ) from fault
    try:
        return Architecture(**fields), holds
    except JaxmapError as fault:
        raise JaxmapError(fault.what, where=path, fix=fault.fix) from fault
