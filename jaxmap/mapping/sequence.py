"""Running a sequence: frames are read and matched ahead in threads while the step computes."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Float, PRNGKeyArray

from jaxmap.datasets.base import FrameRef, StereoSequence
from jaxmap.datasets.images import ImageArray, as_rgb, read_image
from jaxmap.datasets.label_files import LabelFolder
from jaxmap.errors import FrameError
from jaxmap.host.prefetch import prefetch
from jaxmap.host.stages import timed_stage
from jaxmap.labellers.base import Labeller, Needs
from jaxmap.mapping.observations import Observation, Observations
from jaxmap.mapping.step import Mapper, MapperParams, StepCost, StepReport, compile_step
from jaxmap.stereo.front_end import RectifiedFrame, StereoFrontEnd
from jaxmap.types import Frame, StereoCamera, VoxelMap, to_device

Cover = Callable[[VoxelMap, Sequence[int]], VoxelMap]
"""From a part of a map to the part that holds the views of frames, given their indices."""


@dataclass(frozen=True)
class PreparedFrame:
    """A frame on its way to the step: ready, or with the reason why it is not.

    `stages_s` holds what each host stage took.
    """

    index: int
    ref: FrameRef
    frame: Frame | None = None
    rectified: RectifiedFrame | None = None
    fault: FrameError | None = None
    stages_s: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class FusedFrame:
    """What became of one frame.

    `info` is None where it was skipped; `cost` is that of compiling the step, with the first frame.
    """

    prepared: PreparedFrame
    info: StepReport | None = None
    cost: StepCost | None = None


def prepare_frames(
    sequence: StereoSequence,
    front_end: StereoFrontEnd,
    label_folder: LabelFolder | None = None,
    *,
    needs: Needs | None = None,
    matched: bool = True,
    pose_errors: Float[np.ndarray, "N M 6"] | None = None,
    indices: Sequence[int] | None = None,
    workers: int = 2,
    ahead: int = 4,
) -> Iterator[PreparedFrame]:
    """Reads, rectifies and matches the frames of a sequence ahead of their use; the first are begun at once.

    Args:
        sequence: the frames and their poses.
        front_end: rectification and matching.
        label_folder: where each frame's labels lie, for the `files` labeller.
        needs: what the labeller asks of each frame (`Labeller.needs`); the rectified left image is delivered,
            as RGB, where it is `image`.
        matched: with their disparity; else with both images, the right one grey, for a step that matches them.
        pose_errors: of the members of an ensemble, for each frame.
        indices: which frames; by default all.
        workers: threads.
        ahead: frames in the making or waiting, which bounds the memory.

    Raises:
        JaxmapError: the first readable pair has left and right swapped.
    """
    T_world_camera = sequence.T_world_camera @ front_end.T_raw_rectified

    def prepare(index: int) -> PreparedFrame:
        ref = sequence.frames[index]
        try:
            stages_s: dict[str, float] = {}
            with timed_stage("read", stages_s):
                pair = sequence.read_pair(ref)
            rectified = (front_end if matched else front_end.ready)(pair.left, pair.right)
            stages_s |= {"rectify": rectified.rectify_s, "match": rectified.match_s}
            filled: dict[str, Any] = {} if matched else _to_match(rectified)
            if needs == "image" or not matched:
                # All as RGB: a grey image between coloured ones must not change the form of a frame.
                filled["image"] = to_device(as_rgb(rectified.left))
            if label_folder is not None:
                with timed_stage("labels", stages_s):
                    filled |= label_folder.read(ref, front_end)
            if pose_errors is not None:
                filled["pose_errors"] = to_device(pose_errors[index], np.float32)
            pose = jaxlie.SE3.from_matrix(to_device(T_world_camera[index], np.float32))
            disparity_px = to_device(front_end.disparity_of(rectified)) if matched else None
            frame = Frame(disparity_px, pose, **filled)
        except FrameError as fault:
            return PreparedFrame(index, ref, fault=fault.at(f"frame {ref.name}"))
        return PreparedFrame(index, ref, frame, rectified, stages_s=stages_s)

    chosen = range(len(sequence.frames)) if indices is None else indices
    return _in_right_order(prefetch(prepare, chosen, workers, ahead), front_end)


def _to_match(rectified: RectifiedFrame) -> dict[str, Any]:
    """What a frame holds beside its left image for a step that matches it."""
    blind = np.zeros(rectified.left.shape[:2], bool) if rectified.blind is None else rectified.blind
    return {"right_image": to_device(rectified.right), "blind": to_device(blind)}


def observed_frames(
    observations: Observations,
    *,
    left_image: Callable[[FrameRef], ImageArray] | None = None,
    pose_errors: Float[np.ndarray, "N M 6"] | None = None,
    indices: Sequence[int] | None = None,
    workers: int = 2,
    ahead: int = 4,
) -> Iterator[PreparedFrame]:
    """The frames of observations, read ahead of their use: what `prepare_frames` is to the images of a sequence.

    Args:
        observations: the frames and their poses.
        left_image: reads the rectified left image of a frame, which is then delivered, as RGB, in place of the labels
            that are kept.
        pose_errors: of the members of an ensemble, for each frame.
        indices: which frames; by default all.
        workers: threads.
        ahead: frames in the making or waiting.
    """

    def prepare(index: int) -> PreparedFrame:
        ref, stages_s = observations.frames[index], {}
        try:
            with timed_stage("read", stages_s):
                seen = observations.observation(index)
                prepared = as_prepared(observations, seen, index, pose_errors)
                picture, left = observations.picture(index), None
                if left_image is not None:
                    left = left_image(ref)
                elif picture is not None:
                    left = _at_full_size(read_image(picture), observations.camera)
        except FrameError as fault:
            return PreparedFrame(index, ref, fault=fault.at(f"frame {ref.name}"))
        assert prepared.rectified is not None and prepared.frame is not None
        frame, rectified = prepared.frame, prepared.rectified
        if left is not None:
            rectified = rectified._replace(left=left)
        if left is not None and left_image is not None:
            kept: dict[str, Any] = dict.fromkeys(get_args(Needs))
            frame = replace(frame, **kept | {"image": to_device(as_rgb(left))})
        return replace(prepared, frame=frame, rectified=rectified, stages_s=stages_s)

    return prefetch(prepare, range(len(observations.frames)) if indices is None else indices, workers, ahead)


def _at_full_size(picture: ImageArray, camera: StereoCamera) -> ImageArray:
    """A picture of a key frame, which may have been kept small, at the size of the images."""
    import cv2

    return cv2.resize(picture, (camera.width_px, camera.height_px))


def as_prepared(
    observations: Observations, seen: Observation, index: int, pose_errors: Float[np.ndarray, "N M 6"] | None = None
) -> PreparedFrame:
    """An observation as a frame for the step; its rectified images are empty."""
    frame = observations.frame_of(seen, index)
    if pose_errors is not None:
        frame = replace(frame, pose_errors=to_device(pose_errors[index], np.float32))
    nothing = np.zeros((0, 0), np.uint8)
    rectified = RectifiedFrame(nothing, nothing, seen.disparity_px, 0.0, 0.0, seen.too_near, seen.nearest_px)
    return PreparedFrame(index, observations.frames[index], frame, rectified)


def _in_right_order(frames: Iterator[PreparedFrame], front_end: StereoFrontEnd) -> Iterator[PreparedFrame]:
    """The same frames, the first readable one checked for swapped images."""
    order_checked = False
    for prepared in frames:
        if prepared.rectified is not None and not order_checked:
            front_end.check_order(prepared.rectified, f"frame {prepared.ref.name}")
            order_checked = True
        yield prepared


def with_labels_shown(frames: Iterable[PreparedFrame], shown: Container[int]) -> Iterator[PreparedFrame]:
    """The same frames, some of which, by their index, ask the step for the labels of their pixels."""
    for prepared in frames:
        frame = prepared.frame
        if frame is not None:
            frame = replace(frame, show=to_device(prepared.index in shown, np.bool_))
        yield replace(prepared, frame=frame)


def frame_form(
    camera: StereoCamera,
    labeller: Labeller,
    members: int = 0,
    logits_shape: tuple[int, ...] = (),
    *,
    matched: bool = True,
) -> Frame:
    """The form of the frames that `prepare_frames` makes for a labeller: shapes without numbers.

    Args:
        camera: the rectified camera.
        labeller: what asks for images, labels or probabilities.
        members: of an ensemble.
        logits_shape: of the logits, where the labeller asks for those (`ObservationAttributes.kept_shape`).
        matched: with their disparity; else with both images.
    """
    size = (camera.height_px, camera.width_px)
    kinds: dict[Needs, tuple[tuple[int, ...], DTypeLike]] = {
        "image": ((*size, 3), np.uint8),
        "labels": (size, np.uint8),
        "class_probabilities": ((*size, len(labeller.classes)), np.float32),
        "logits": (logits_shape, np.float32),
    }

    def frame() -> Frame:
        filled: dict[str, Any] = {} if labeller.needs is None else {labeller.needs: jnp.zeros(*kinds[labeller.needs])}
        if not matched:
            filled["image"], filled["right_image"] = jnp.zeros((*size, 3), np.uint8), jnp.zeros(size, np.uint8)
            filled["blind"] = jnp.zeros(size, bool)
        pose_errors = jnp.zeros((members, 6), np.float32) if members else None
        disparity_px = jnp.zeros(size, np.float32) if matched else None
        return Frame(disparity_px, jaxlie.SE3.identity(), pose_errors=pose_errors, **filled)

    return jax.eval_shape(frame)


def run_sequence(
    mapper: Mapper,
    voxel_map: VoxelMap,
    frames: Iterable[PreparedFrame],
    params: MapperParams,
    key: PRNGKeyArray,
    *,
    strict: bool = False,
    form: Frame | None = None,
    cover: Cover = lambda voxel_map, indices: voxel_map,
) -> Iterator[tuple[VoxelMap, FusedFrame]]:
    """Fuses prepared frames one after the other.

    Args:
        mapper: its step.
        voxel_map: where to begin.
        frames: of `prepare_frames`.
        params: the numbers of the step.
        key: that of the run.
        strict: stop at a frame that cannot be used.
        form: that of the frames (`frame_form`): the step is compiled for it while the first ones are read. Without it,
            the first frame that is ready compiles the step.
        cover: of a map that is a part of a larger one: moves it so that it holds the views of frames, given their
            indices.

    Yields:
        After each frame, the map so far and what became of the frame. The map is donated to the
        next frame: copy what shall last.

    Raises:
        FrameError: a frame cannot be used and `strict` is set; otherwise it is skipped.
    """
    cost = news = None
    if form is not None:
        mapper, cost = compile_step(mapper, voxel_map, form, params, key)
        news = cost
    for prepared in timed_frames(frames):
        if prepared.frame is None:
            if strict and prepared.fault is not None:
                raise prepared.fault
            yield voxel_map, FusedFrame(prepared)
            continue
        if cost is None:
            mapper, cost = compile_step(mapper, voxel_map, prepared.frame, params, key)
            news = cost
        with timed_stage("step", prepared.stages_s):
            voxel_map = cover(voxel_map, [prepared.index])
            voxel_map, info = mapper.step(voxel_map, prepared.frame, params, key)
            jax.block_until_ready(voxel_map.log_odds)
        yield voxel_map, FusedFrame(prepared, info, news)
        news = None


def timed_frames(frames: Iterable[PreparedFrame]) -> Iterator[PreparedFrame]:
    """The same frames; how long each was waited for is one of its stages."""
    source = iter(frames)
    while True:
        waited_s: dict[str, float] = {}
        with timed_stage("wait", waited_s):
            prepared = next(source, None)
        if prepared is None:
            return
        prepared.stages_s.update(waited_s)
        yield prepared
