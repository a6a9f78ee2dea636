"""Running a sequence: frames are read and matched ahead in threads while the step computes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import jax
import jaxlie
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jaxmap.datasets.base import FrameRef, StereoSequence
from jaxmap.datasets.images import as_rgb
from jaxmap.datasets.label_files import LabelFolder
from jaxmap.errors import FrameError
from jaxmap.labellers import Needs
from jaxmap.mapper import Mapper, MapperParams, StepCost, StepInfo, compile_step
from jaxmap.prefetch import prefetch
from jaxmap.stereo.front_end import RectifiedFrame, StereoFrontEnd
from jaxmap.types import Frame, VoxelMap, to_device


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
    info: StepInfo | None = None
    cost: StepCost | None = None


def prepare_frames(
    sequence: StereoSequence,
    front_end: StereoFrontEnd,
    label_folder: LabelFolder | None = None,
    *,
    needs: Needs | None = None,
    pose_errors: Float[np.ndarray, "N M 6"] | None = None,
    first: int = 0,
    workers: int = 2,
    ahead: int = 4,
) -> Iterator[PreparedFrame]:
    """Reads, rectifies and matches the frames of a sequence ahead of their use.

    Args:
        sequence: the frames and their poses.
        front_end: rectification and matching.
        label_folder: where each frame's labels lie, for the `files` labeller.
        needs: what the labeller asks of each frame (`Labeller.needs`); the rectified left image is delivered,
            as RGB, where it is `image`.
        pose_errors: of the members of an ensemble, for each frame.
        first: index of the first frame.
        workers: threads.
        ahead: frames in the making or waiting, which bounds the memory.

    Raises:
        JaxmapError: the first readable pair has left and right swapped.
    """
    T_world_camera = sequence.T_world_camera @ front_end.T_raw_rectified

    def prepare(index: int) -> PreparedFrame:
        ref = sequence.frames[index]
        try:
            started_s = time.perf_counter()
            pair = sequence.read_pair(ref)
            stages_s = {"read": time.perf_counter() - started_s}
            rectified = front_end(pair.left, pair.right)
            stages_s |= {"rectify": rectified.rectify_s, "match": rectified.match_s}
            filled: dict[str, Any] = {}
            if needs == "image":
                # All as RGB: a grey image between coloured ones must not change the form of a frame.
                filled["image"] = to_device(as_rgb(rectified.left))
            if label_folder is not None:
                started_s = time.perf_counter()
                filled |= label_folder.read(ref, front_end)
                stages_s["labels"] = time.perf_counter() - started_s
            if pose_errors is not None:
                filled["pose_errors"] = to_device(pose_errors[index], np.float32)
            pose = jaxlie.SE3.from_matrix(to_device(T_world_camera[index], np.float32))
            frame = Frame(to_device(rectified.disparity_px), pose, **filled)
        except FrameError as fault:
            return PreparedFrame(index, ref, fault=fault.at(f"frame {ref.name}"))
        return PreparedFrame(index, ref, frame, rectified, stages_s=stages_s)

    order_checked = False
    for prepared in prefetch(prepare, range(first, len(sequence.frames)), workers, ahead):
        if prepared.rectified is not None and not order_checked:
            front_end.check_order(prepared.rectified, f"frame {prepared.ref.name}")
            order_checked = True
        yield prepared


def run_sequence(
    mapper: Mapper,
    voxel_map: VoxelMap,
    frames: Iterable[PreparedFrame],
    params: MapperParams,
    key: PRNGKeyArray,
    *,
    strict: bool = False,
) -> Iterator[tuple[VoxelMap, FusedFrame]]:
    """Fuses prepared frames one after the other; the first one that is ready compiles the step.

    Yields:
        After each frame, the map so far and what became of the frame. The map is donated to the
        next frame: copy what shall last.

    Raises:
        FrameError: a frame cannot be used and `strict` is set; otherwise it is skipped.
    """
    cost: StepCost | None = None
    for prepared in frames:
        if prepared.frame is None:
            if strict and prepared.fault is not None:
                raise prepared.fault
            yield voxel_map, FusedFrame(prepared)
            continue
        news = None
        if cost is None:
            mapper, cost = compile_step(mapper, voxel_map, prepared.frame, params, key)
            news = cost
        started_s = time.perf_counter()
        voxel_map, info = mapper.step(voxel_map, prepared.frame, params, key)
        jax.block_until_ready(voxel_map.log_odds)
        prepared.stages_s["step"] = time.perf_counter() - started_s
        yield voxel_map, FusedFrame(prepared, info, news)
