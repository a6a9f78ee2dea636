"""Labels of other programs: one file for each frame, named after its left image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from jaxmap.datasets.base import FrameRef
from jaxmap.datasets.masks import find_mask, read_values
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.files import check_regular
from jaxmap.labels import IGNORE
from jaxmap.stereo.front_end import StereoFrontEnd

_MOST_HEADER_BYTES, _MOST_FILE_BYTES = 1024, 1 << 34


@dataclass(frozen=True)
class LabelFolder:
    """A folder of `NAME.png` (class indices, 255 for none) or `NAME.npy` (probabilities (H, W, C)).

    Attributes:
        folder: where the files lie.
        soft: whether they are probabilities.
        class_count: the number of classes.
        labels_are: whether they label the raw or the rectified pixels of the left image.
        rectify: the sequence's `rectify_labels`, for raw ones; the front end rectifies them where it is None.
    """

    folder: Path
    soft: bool
    class_count: int
    labels_are: Literal["raw", "rectified"]
    rectify: Callable[[FrameRef, np.ndarray], np.ndarray] | None = None

    def read(self, ref: FrameRef, front_end: StereoFrontEnd) -> dict[str, np.ndarray]:
        """The labels of one frame on its rectified pixels, as the fields of `Frame` that they fill.

        Raises:
            FrameError: the file is missing or damaged, of another size, or holds an unknown class.
        """
        path = self.folder / f"{ref.name}{'.npy' if self.soft else '.png'}"
        expected = (front_end.camera.height_px, front_end.camera.width_px)
        labels = self._read_probabilities(path, *expected) if self.soft else self._read_indices(ref.name)
        _check_size(labels.shape, expected, path)
        if self.labels_are == "raw":
            labels = self.rectify(ref, labels) if self.rectify else front_end.rectify_labels(labels)
        return {"class_probabilities" if self.soft else "labels": labels}

    def looks_binary(self, names: Sequence[str]) -> bool:
        """Whether the labels of these frames are 0 and 255 alone, as a black and white mask has them.

        As labels, these are the first class and none. What cannot be read is passed over.
        """
        values: set[int] = set()
        for path in () if self.soft else (find_mask(self.folder, name) for name in names):
            with suppress(FrameError):
                values |= set() if path is None else set(np.unique(read_values(path)).tolist())
        return values == {0, IGNORE}

    def _read_indices(self, name: str) -> np.ndarray:
        path = find_mask(self.folder, name)
        if path is None:
            raise FrameError(
                "the label image is missing", where=self.folder / f"{name}.png", fix="label every left image"
            )
        labels = read_values(path)
        highest = labels[labels != IGNORE].max(initial=0)
        if highest >= self.class_count:
            raise FrameError(
                f"label {highest}, but there are {self.class_count} classes",
                where=path,
                fix="give all --classes in order",
            )
        return labels.astype(np.uint8)

    def _read_probabilities(self, path: Path, height: int, width: int) -> np.ndarray:
        try:
            check_regular(path, _MOST_FILE_BYTES)
            with open(path, "rb") as file:
                shape, dtype = _npy_header(file, path)
                if len(shape) != 3 or shape[2] != self.class_count or dtype.kind != "f":
                    fix = f"give floats (H, W, {self.class_count})"
                    raise FrameError(f"an array {shape} of {dtype}", where=path, fix=fix)
                _check_size(shape, (height, width), path)
                file.seek(0)
                # What the header says is known by now: the array is as large as the image.
                array = np.lib.format.read_array(file, allow_pickle=False).astype(np.float32)
        except (OSError, ValueError, EOFError) as error:
            raise FrameError(f"not a readable array: {error}", where=path, fix="write it with numpy.save") from error
        except FrameError:
            raise
        except JaxmapError as error:
            raise FrameError(error.what, where=error.where, fix="label every left image") from error
        if not np.isfinite(array).all() or array.min(initial=0) < 0 or array.sum(axis=2).max(initial=0) > 1.01:
            raise FrameError(
                "the probabilities are not finite, not negative, or sum to more than 1",
                where=path,
                fix="write softmax outputs",
            )
        return array


def _npy_header(file: BinaryIO, path: Path) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of the array in a .npy file, before anything is allocated for it.

    Raises:
        FrameError: it is no such file; the header is Python text, and its parser may raise nearly anything.
    """
    try:
        version = np.lib.format.read_magic(file)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, _, dtype = read(file, max_header_size=_MOST_HEADER_BYTES)
    except Exception as error:
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise FrameError(f"not a readable array: {reason}", where=path, fix="write it with numpy.save") from error
    return shape, dtype


def _check_size(shape: tuple[int, ...], expected: tuple[int, int], path: Path) -> None:
    if shape[:2] != expected:
        raise FrameError(
            f"the labels are {shape[1]}x{shape[0]} px, the image is {expected[1]}x{expected[0]} px",
            where=path,
            fix="label the left image at its own size",
        )


def open_label_folder(
    folder: Path, class_count: int, labels_are: Literal["raw", "rectified"], first_name: str
) -> LabelFolder:
    """Opens a folder of labels: indices or probabilities, by the suffix of the first frame's file.

    Raises:
        JaxmapError: no such folder, or no label for the first frame.
    """
    if not folder.is_dir():
        raise JaxmapError("no such folder of labels", where=folder, fix="check --labels")
    soft = find_mask(folder, first_name) is None
    if not soft or (folder / f"{first_name}.npy").is_file():
        return LabelFolder(folder, soft, class_count, labels_are)
    raise JaxmapError(
        f"no {first_name}.png and no {first_name}.npy", where=folder, fix="name label files after the left images"
    )
