"""Observations: what was seen in each frame, kept on disk: frames are matched and labelled once, and fused often.

A Zarr v3 group: its attributes hold what all frames share, and a group of each frame's name its time and pose, the
disparity in sixteenths of a pixel, and what labels are made from, at the resolution at which it was made. Relief, and
whatever else a few numbers change, is computed when the frame is fused. A frame is written beside its place and
renamed: it is there whole, or not at all, whoever is killed when.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import jaxlie
import numpy as np
from annotated_types import Interval
from jaxtyping import Float, Shaped
from pydantic import ConfigDict, TypeAdapter, ValidationError

from jaxmap.datasets.base import FrameRef, StereoPair, StereoSequence
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import atomic_path, check_regular, is_alive, sync, write_error
from jaxmap.host.pictures import MAX_PX
from jaxmap.host.settings import fault_text
from jaxmap.mapping.quantised import Kept, quantise_disparity, quantise_kept, restore_disparity, restore_kept
from jaxmap.types import Frame, StereoCamera, make_stereo_camera, to_device

if TYPE_CHECKING:
    import zarr

FORMAT_VERSION = 1
DISPARITY = "disparity"
_DTYPES = {DISPARITY: np.int16, "logits": np.int16, "labels": np.uint8, "class_probabilities": np.uint8}
_MOST_FILE_BYTES, _MOST_ATTRIBUTES_BYTES = 1 << 30, 1 << 20
_AGAIN = "remove that folder and run jaxmap perceive again: it perceives what is missing"

Number = Annotated[float, Interval(ge=-1e15, le=1e15)]
Count = Annotated[int, Interval(ge=0, le=2**31)]
Row = tuple[Number, Number, Number, Number]
Matrix = tuple[Row, Row, Row, Row]
IDENTITY: Matrix = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True)
class ObservationAttributes:
    """What all frames share; JSON values only.

    Attributes:
        sequence: what was perceived, as it was named.
        name: of the sequence.
        dataset: of its reader.
        camera: the arguments of `make_stereo_camera`: the rectified camera.
        settings: those of the perception, resolved (`runs.config.PerceiveConfig`).
        labeller: what gave labels.
        kept: what labels are made from; None where they are made of the points alone.
        kept_shape: of that array.
        classes: of what is kept, in its order.
        network: the architecture that gave logits, without its weights.
        model: the file of the network, and its SHA-256.
        disparity_sigma_px: noise of the disparity under which a network was shown relief.
        T_raw_rectified: turns the rectified left camera into that of the images on disk, which the poses are of.
        rectified_here: whether the images were rectified by jaxmap.
        alignment_rad: rotation vector by which the right camera was corrected.
        site_origin: where the world's origin lies in `crs`, metres.
        T_world_source: turns the world of the poses' source into the z-up world.
        notes: what the user was told when the sequence was opened.
        findings: of the quick check of the sequence.
        key_frames: by name, the frames whose rectified left image is kept beside the group, and the number that its
            picture has (`Observations.picture`).
        frames: how many the sequence has.
        skipped: the frames that could not be used, with the reason.
        complete: whether all others are there.
    """

    __pydantic_config__ = _STRICT

    sequence: str
    name: str
    dataset: str
    camera: dict[str, Number]
    settings: dict[str, Any]
    labeller: str = "none"
    kept: Kept | None = None
    kept_shape: tuple[Count, ...] = ()
    classes: tuple[str, ...] = ()
    network: dict[str, Any] | None = None
    model: dict[str, str] | None = None
    disparity_sigma_px: Number = 0.5
    T_raw_rectified: Matrix = IDENTITY
    rectified_here: bool = False
    alignment_rad: tuple[Number, Number, Number] | None = None
    crs: str | None = None
    site_origin: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    T_world_source: Matrix = IDENTITY
    notes: tuple[str, ...] = ()
    findings: tuple[dict[str, Any], ...] = ()
    key_frames: dict[str, Annotated[int, Interval(ge=0, lt=10**6)]] = field(default_factory=dict)
    frames: Count = 0
    skipped: dict[str, str] = field(default_factory=dict)
    complete: bool = False

    def digest(self) -> str:
        """A fingerprint of what perceived the frames: camera, matcher, network and world, whatever the frames."""
        perceived = ("camera", "kept", "kept_shape", "classes", "network", "disparity_sigma_px", "T_raw_rectified")
        world = ("crs", "site_origin", "T_world_source")
        tree = asdict(self)
        told = {name: tree[name] for name in (*perceived, "alignment_rad", *world)} | {
            "sha256": (self.model or {}).get("sha256"),
            "stereo": self.settings.get("stereo"),
        }
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


class Observation(NamedTuple):
    """What was seen in one frame.

    Attributes:
        name: of the frame.
        timestamp_s: when the left image was taken.
        T_world_camera: float64 (4, 4), left camera of the images as they lay on disk, relative to the site origin.
        disparity_px: float32 (H, W), NaN where unknown.
        kept: the array of `ObservationAttributes.kept`: float32 logits (h, w, C) or probabilities (H, W, C), or uint8
            labels (H, W).
        too_near: share of the pixels that were left out as nearer than the searched disparities reach.
        nearest_px: the disparity of the nearest of them.
    """

    name: str
    timestamp_s: float
    T_world_camera: Float[np.ndarray, "4 4"]
    disparity_px: Float[np.ndarray, "H W"]
    kept: Shaped[np.ndarray, "..."] | None = None
    too_near: float = 0.0
    nearest_px: float = 0.0


@dataclass(frozen=True)
class _FrameAttributes:
    """What a frame's group holds beside its arrays."""

    __pydantic_config__ = _STRICT

    timestamp_s: Number
    T_world_camera: Matrix
    scale: Number = 1.0
    too_near: Number = 0.0
    nearest_px: Number = 0.0


def write_attributes(folder: Path, attributes: ObservationAttributes) -> None:
    """Makes the group, or replaces its attributes; its frames stay.

    Raises:
        JaxmapError: the disk is full, or refuses.
    """
    stored = {"format_version": FORMAT_VERSION, **asdict(attributes), "digest": attributes.digest()}
    group = {"zarr_format": 3, "node_type": "group", "attributes": stored}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(error, folder) from error
    with atomic_path(folder / "zarr.json") as temporary:
        temporary.write_text(json.dumps(group, allow_nan=False, indent=1), encoding="utf8")


def write_observation(folder: Path, observation: Observation, kept: Kept | None) -> None:
    """Writes a frame into the group, whole or not at all; one that is there stays.

    May be called from several threads and processes at once.

    Raises:
        FrameError: numbers that cannot be kept.
        JaxmapError: the disk is full, or refuses.
    """
    import zarr

    target = folder / observation.name
    temporary = folder / f".{observation.name}.tmp-{threading.get_ident()}-{os.getpid()}"
    arrays, scale = {DISPARITY: quantise_disparity(observation.disparity_px)}, 1.0
    if kept is not None:
        assert observation.kept is not None
        arrays[kept], scale = quantise_kept(observation.kept, kept)
    attributes = _FrameAttributes(
        float(observation.timestamp_s),
        matrix_of(observation.T_world_camera),
        scale,
        float(observation.too_near),
        float(observation.nearest_px),
    )
    try:
        group = zarr.create_group(temporary, zarr_format=3, attributes=asdict(attributes))
        for name, values in arrays.items():
            _write_array(group, name, values)
        for path in (*temporary.rglob("*"), temporary):
            sync(path)
        try:
            os.rename(temporary, target)
        except OSError:
            # Another process was faster.
            if not (target / "zarr.json").exists():
                raise
        sync(folder)
    except OSError as error:
        raise write_error(error, target) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_array(group: zarr.Group, name: str, values: np.ndarray) -> None:
    from zarr.codecs import ZstdCodec

    array = group.create_array(
        name,
        shape=values.shape,
        dtype=values.dtype,
        chunks=tuple(max(edge, 1) for edge in values.shape),
        # As small as other codecs of this speed on disparities, and its checksum finds damage.
        compressors=ZstdCodec(level=1, checksum=True),
        chunk_key_encoding={"name": "default", "separator": "."},
        fill_value=0,
        # A chunk that is missing reads as the fill value: none is left out.
        config={"write_empty_chunks": True},
    )
    array[...] = values


def is_observed(folder: Path, name: str) -> bool:
    """Whether a frame is there."""
    return (folder / name / "zarr.json").exists()


def remove_stray_frames(folder: Path) -> None:
    """Removes what killed processes have left of frames; what a process that is alive writes stays."""
    for stray in folder.glob(".*.tmp-*"):
        process = stray.name.rpartition("-")[2]
        if process.isdecimal() and not is_alive(int(process)):
            shutil.rmtree(stray, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations on disk; frames are read when they are asked for, from as many threads as one likes.

    Attributes:
        folder: the group.
        attributes: what the frames share.
        frames: their names and times, in the order of time.
        T_world_camera: float64 (N, 4, 4) as of `StereoSequence`: left camera of the images as they lay on disk, z-up
            world, relative to the site origin. Others may be put in their place (`dataclasses.replace`).
    """

    folder: Path
    attributes: ObservationAttributes
    frames: tuple[FrameRef, ...]
    T_world_camera: Float[np.ndarray, "N 4 4"]

    @cached_property
    def camera(self) -> StereoCamera:
        """The rectified camera, which the disparities are of."""
        numbers: dict[str, Any] = dict(self.attributes.camera)
        sizes = {name: int(numbers.pop(name, 0)) for name in ("width_px", "height_px")}
        if math.prod(sizes.values()) > MAX_PX:
            raise self._damaged("a camera of so many pixels")
        try:
            return make_stereo_camera(**numbers, **sizes, where=self.folder)
        except TypeError as fault:
            raise self._damaged("the attribute camera") from fault

    @cached_property
    def T_world_rectified(self) -> Float[np.ndarray, "N 4 4"]:
        """Poses of `camera`, float64."""
        return self.T_world_camera @ np.array(self.attributes.T_raw_rectified)

    def read(self, index: int) -> Frame:
        """A frame, ready for the step; without pose errors of an ensemble.

        Raises:
            FrameError: it is damaged or missing.
        """
        return self.frame_of(self.observation(index), index)

    def frame_of(self, observation: Observation, index: int) -> Frame:
        """The frame that the step sees of an observation."""
        kept = self.attributes.kept
        filled: dict[str, Any] = {}
        if kept is not None:
            assert observation.kept is not None
            filled[kept] = to_device(observation.kept)
        pose = jaxlie.SE3.from_matrix(to_device(self.T_world_rectified[index], np.float32))
        return Frame(to_device(observation.disparity_px), pose, **filled)

    def observation(self, index: int) -> Observation:
        """What was seen in a frame, with the pose that these observations have for it.

        Raises:
            FrameError: it is damaged or missing.
        """
        kept, size = self.attributes.kept, (self.camera.height_px, self.camera.width_px)
        ref = self.frames[index]
        where = self.folder / ref.name
        try:
            stored = _frame_attributes(where)
            disparity_px = restore_disparity(_read_array(where, DISPARITY, size))
            values = None
            if kept is not None:
                values = restore_kept(_read_array(where, kept, self.attributes.kept_shape), kept, stored.scale)
        except JaxmapError as fault:
            raise FrameError(fault.what, where=fault.where or where, fix=_AGAIN) from fault
        pose = self.T_world_camera[index]
        return Observation(ref.name, ref.timestamp_s, pose, disparity_px, values, stored.too_near, stored.nearest_px)

    def picture(self, index: int) -> Path | None:
        """Where the rectified left image of a frame is kept, if it is: a PNG, or a smaller WebP."""
        number = self.attributes.key_frames.get(self.frames[index].name)
        if number is None:
            return None
        paths = [self.folder.parent / "pictures" / f"{number:06d}_left.{ending}" for ending in ("png", "webp")]
        return next((path for path in paths if path.is_file()), None)

    def selected(self, chosen: slice | Sequence[int] | np.ndarray) -> Observations:
        """Some of the frames."""
        indices = np.arange(len(self.frames))[chosen]
        return replace(
            self,
            frames=tuple(self.frames[index] for index in indices),
            T_world_camera=self.T_world_camera[indices],
        )

    def sequence(self) -> StereoSequence:
        """The frames as a sequence, whose images are not there."""
        attributes = self.attributes
        return StereoSequence(
            name=attributes.name,
            dataset=attributes.dataset,
            camera=self.camera,
            frames=self.frames,
            T_world_camera=self.T_world_camera,
            read_pair=self._no_images,
            T_world_source=np.array(attributes.T_world_source),
            site_origin=np.array(attributes.site_origin),
            crs=attributes.crs,
            notes=attributes.notes,
        )

    def _no_images(self, ref: FrameRef) -> StereoPair:
        raise FrameError("observations hold no images", where=self.folder / ref.name, fix="read the sequence itself")

    def _damaged(self, what: str) -> JaxmapError:
        return JaxmapError(f"{what} is damaged", where=self.folder, fix="perceive the sequence again")


def open_observations(path: str | os.PathLike[str]) -> Observations:
    """Opens observations, be they complete or not.

    Args:
        path: the Zarr group, `observations.zarr`.

    Raises:
        JaxmapError: there are none, they are of another version, or damaged; or no frame is there.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise JaxmapError("no such observations", where=folder, fix="make them with jaxmap perceive")
    attributes = read_attributes(folder)
    names = [entry.name for entry in os.scandir(folder) if entry.is_dir() and not entry.name.startswith(".")]
    kept = {name: _frame_attributes(folder / name) for name in names}
    names.sort(key=lambda name: (kept[name].timestamp_s, name))
    if not names:
        raise JaxmapError("no frame was perceived", where=folder, fix="run jaxmap perceive again")
    observations = Observations(
        folder,
        attributes,
        tuple(FrameRef(name, kept[name].timestamp_s, folder / name, folder / name) for name in names),
        np.array([kept[name].T_world_camera for name in names], np.float64),
    )
    # A camera that is none is told now.
    _ = observations.camera
    return observations


def read_attributes(folder: Path) -> ObservationAttributes:
    """What the frames of a group share.

    Raises:
        JaxmapError: it is no group of observations, of another version, or damaged.
    """
    fix = "give what jaxmap perceive has written"
    tree = read_json(folder / "zarr.json")
    stored = tree.get("attributes") if isinstance(tree, dict) else None
    version = stored.get("format_version") if isinstance(stored, dict) else None
    if not isinstance(stored, dict) or version is None:
        raise JaxmapError("not jaxmap's observations: no format_version", where=folder, fix=fix)
    if version != FORMAT_VERSION:
        newer = isinstance(version, int) and version > FORMAT_VERSION
        raise JaxmapError(
            f"observations of format {str(version)[:20]}, this jaxmap reads {FORMAT_VERSION}",
            where=folder,
            fix="upgrade jaxmap" if newer else "perceive the sequence again",
        )
    told = {name: value for name, value in stored.items() if name not in ("format_version", "digest")}
    try:
        attributes = TypeAdapter(ObservationAttributes).validate_python(told)
    except ValidationError as fault:
        raise _bad_attributes(fault, folder) from fault
    if attributes.digest() != stored.get("digest"):
        raise JaxmapError(
            "the attributes are not those that the frames were perceived with",
            where=folder,
            fix="restore zarr.json, or perceive the sequence again",
        )
    return attributes


def _frame_attributes(where: Path) -> _FrameAttributes:
    path = where / "zarr.json"
    check_regular(path, _MOST_ATTRIBUTES_BYTES)
    try:
        return _frame_adapter().validate_python(read_json(path)["attributes"])
    except (KeyError, TypeError, ValidationError) as fault:
        raise JaxmapError("the frame is damaged: its attributes", where=where, fix=_AGAIN) from fault


@cache
def _frame_adapter() -> TypeAdapter[_FrameAttributes]:
    return TypeAdapter(_FrameAttributes)


def _bad_attributes(fault: ValidationError, where: Path) -> JaxmapError:
    first = fault.errors()[0]
    name = ".".join(str(part) for part in first["loc"]) or "attributes"
    return JaxmapError(
        f"the attribute {name} is damaged ({fault_text(first['msg'])})", where=where, fix="perceive the sequence again"
    )


def _read_array(where: Path, name: str, shape: Sequence[int]) -> np.ndarray:
    """An array of a frame.

    Raises:
        JaxmapError: it is missing, not whole, of another type or shape, or damaged.
    """
    from numcodecs.zstd import decompress

    described, chunk = where / name / "zarr.json", where / name / ".".join("c" + "0" * len(shape))
    for path in (described, chunk):
        check_regular(path, _MOST_FILE_BYTES)
    dtype = np.dtype(_DTYPES[name])
    # What `_write_array` writes is read here: Zarr takes as long to open an array as the rest of a frame takes.
    try:
        stored = read_json(described)
        if (form := (stored["data_type"], tuple(stored["shape"]))) != (dtype.name, tuple(shape)):
            raise JaxmapError(f"{name} is {form[0]} {form[1]}, not {dtype} {tuple(shape)}", where=where)
        ((raw, options), (codec, _)) = ((one["name"], one.get("configuration", {})) for one in stored["codecs"])
        chunks = stored["chunk_grid"]["configuration"]["chunk_shape"]
        if (raw, options.get("endian", "little"), codec, tuple(chunks)) != ("bytes", "little", "zstd", tuple(shape)):
            raise JaxmapError(f"{name} is stored otherwise than jaxmap stores it", where=where)
        values = np.empty(shape, dtype.newbyteorder("<"))
        # Zstandard's own checksum finds damage.
        decompress(chunk.read_bytes(), values)
    except JaxmapError:
        raise
    # The codec raises whatever it likes on damaged bytes.
    except Exception as error:
        raise JaxmapError(f"the {name.replace('_', ' ')} of the frame is damaged", where=where) from error
    return values.astype(dtype, copy=False)


def matrix_of(T: Float[np.ndarray, "4 4"]) -> Matrix:
    """A transform as plain numbers."""
    return tuple(tuple(row) for row in np.asarray(T, np.float64).tolist())  # type: ignore[return-value]
