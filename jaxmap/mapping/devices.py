"""Several devices of one machine: each sees one frame of a batch, and what all have seen goes into the map in order.

Every device holds the map. Only the evidence of the windows travels, and each device adds all of it, frame by frame:
the sums are those of a single device, in the same order. A sum over devices of whole maps would move as many numbers
as the map has, and round them in another order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Int, PRNGKeyArray

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.fusion.frame import add_evidence_of, evidence_of
from jaxmap.host.stages import timed_stage
from jaxmap.mapping.sequence import Cover, FusedFrame, PreparedFrame, run_sequence, timed_frames
from jaxmap.mapping.step import (
    Mapper,
    MapperParams,
    StepReport,
    check_inputs,
    compile_step,
    report_of,
    see_frame,
    step_functions,
)
from jaxmap.types import Frame, VoxelMap, to_device

Device = Any
"""A `jax.Device`, which is no type to type checkers."""

_AXIS = "frame"


class Batch(NamedTuple):
    """Frames stacked along a leading axis, one for each device; only the first `used` of them are real."""

    frames: Frame
    used: Int[Array, ""]


def choose_devices(count: int | None, members: int = 0) -> list[Device]:
    """The devices to map on.

    Args:
        count: how many; by default all GPUs, and one CPU.
        members: of an ensemble, which is fused on one device.

    Raises:
        UsageError: there are not so many, or the run cannot be shared out.
    """
    there = jax.local_devices()
    if count is None:
        return there[:1] if members or jax.default_backend() == "cpu" else there
    if not 1 <= count <= len(there):
        raise UsageError(
            f"{count} devices are asked for, {len(there)} of the kind {there[0].device_kind} are there",
            where="--devices",
            fix=f"give 1 to {len(there)}; cores of a CPU are shared out by themselves",
        )
    if count > 1 and members:
        raise UsageError(
            "an ensemble is fused on one device", where="--devices", fix="leave out --devices or --ensemble.members"
        )
    return there[:count]


def on_devices(mapper: Mapper, devices: Sequence[Device]) -> Mapper:
    """The mapper with a step for batches: `(voxel_map, Batch, params, key) -> (voxel_map, StepReport)`.

    The map is equal to that of a loop over the frames on one device. The reports have a leading axis.

    Args:
        mapper: without an ensemble.
        devices: as many as a batch has frames.
    """
    design = mapper.design
    if design.members:
        raise JaxmapError("an ensemble is fused on one device", where="mapper", fix="give one device")

    def fuse(voxel_map: VoxelMap, batch: Batch, params: MapperParams, key: PRNGKeyArray) -> tuple[VoxelMap, StepReport]:
        frame = jax.tree.map(lambda leaf: leaf[0], batch.frames)
        check_inputs(design, frame, params)
        frame_key = jax.random.fold_in(key, voxel_map.frames_fused + jax.lax.axis_index(_AXIS))
        seen = see_frame(design, voxel_map.grid, frame, params, frame_key)
        own = evidence_of(seen.sighting, voxel_map.grid, seen.window, params.fusion, design.rule, design.depth_range_m)
        all_evidence, first = jax.lax.all_gather((own, seen.window.first), _AXIS)
        fused = voxel_map
        for index in range(len(devices)):
            evidence = jax.tree.map(lambda leaf, index=index: leaf[index], all_evidence)
            fused = add_evidence_of(fused, evidence, replace(seen.window, first=first[index]))
        fused = replace(fused, frames_fused=voxel_map.frames_fused + batch.used)
        return fused, jax.tree.map(lambda leaf: leaf[None], report_of(seen, own.counted))

    sharded = jax.shard_map(
        fuse,
        mesh=Mesh(np.array(devices), (_AXIS,)),
        in_specs=(P(), Batch(P(_AXIS), P()), P(), P()),  # pyright: ignore[reportArgumentType]
        out_specs=(P(), P(_AXIS)),
        # What is gathered is the same everywhere, but its type does not say so.
        check_vma=False,
    )
    return mapper._replace(**step_functions(sharded))


def run_on_devices(
    mapper: Mapper,
    voxel_map: VoxelMap,
    frames: Iterable[PreparedFrame],
    params: MapperParams,
    key: PRNGKeyArray,
    devices: Sequence[Device],
    *,
    strict: bool = False,
    form: Frame | None = None,
    cover: Cover = lambda voxel_map, indices: voxel_map,
) -> Iterator[tuple[VoxelMap, FusedFrame]]:
    """As `sequence.run_sequence`, in batches: with each frame of a batch comes the map that holds all of the batch."""
    if len(devices) == 1:
        yield from run_sequence(mapper, voxel_map, frames, params, key, strict=strict, form=form, cover=cover)
        return
    mapper, cost = on_devices(mapper, devices), None
    mesh = Mesh(np.array(devices), (_AXIS,))
    everywhere = NamedSharding(mesh, P())
    params, key = jax.device_put((params, key), everywhere)
    for prepared in _batches(timed_frames(frames), len(devices), strict):
        ready = [one for one in prepared if one.frame is not None]
        reports: list[StepReport] = []
        news = None
        if ready:
            batch = _placed([one.frame for one in ready if one.frame is not None], mesh)
            voxel_map = jax.device_put(cover(voxel_map, [one.index for one in ready]), everywhere)
            if cost is None:
                any_mapper: Any = mapper
                mapper, cost = compile_step(any_mapper, voxel_map, batch, params, key)  # pyright: ignore[reportArgumentType]
                news = cost
            stages_s: dict[str, float] = {}
            with timed_stage("step", stages_s):
                voxel_map, report = mapper.step(voxel_map, batch, params, key)  # pyright: ignore[reportArgumentType]
                jax.block_until_ready(voxel_map.log_odds)
            rows = jax.tree.map(np.asarray, report)
            reports = [jax.tree.map(lambda leaf, row=row: leaf[row], rows) for row in range(len(ready))]
            for one in ready:
                one.stages_s["step"] = stages_s["step"] / len(ready)
        for one in prepared:
            info = reports.pop(0) if one.frame is not None else None
            yield voxel_map, FusedFrame(one, info, news if info is not None else None)
            news = None if info is not None else news
        if strict and (fault := prepared[-1].fault) is not None:
            raise fault


def _batches(frames: Iterable[PreparedFrame], size: int, strict: bool) -> Iterator[list[PreparedFrame]]:
    """Lists of frames of which so many are ready; under `strict` a frame that is not ends its list."""
    batch: list[PreparedFrame] = []
    for prepared in frames:
        batch.append(prepared)
        if sum(one.frame is not None for one in batch) == size or (strict and prepared.fault is not None):
            yield batch
            batch = []
    if batch:
        yield batch


def _placed(frames: Sequence[Frame], mesh: Mesh) -> Batch:
    """The frames, each on its device; where they are too few, with frames in which nothing is seen."""
    devices, count = list(mesh.devices), len(frames)
    blank = _seen_nothing(frames[-1])
    frames = [*frames, *[blank] * (len(devices) - count)]

    def placed(*leaves: Array) -> Array:
        parts = [jax.device_put(leaf[None], device) for leaf, device in zip(leaves, devices, strict=True)]
        shape = (len(devices), *leaves[0].shape)
        return jax.make_array_from_single_device_arrays(shape, NamedSharding(mesh, P(_AXIS)), parts)

    return Batch(jax.tree.map(placed, *frames), jax.device_put(to_device(count, np.int32), NamedSharding(mesh, P())))


def _seen_nothing(frame: Frame) -> Frame:
    """The frame without any disparity, be it brought or to be matched."""
    if frame.disparity_px is not None:
        return replace(frame, disparity_px=jnp.full_like(frame.disparity_px, jnp.nan))
    assert frame.blind is not None
    return replace(frame, blind=jnp.ones_like(frame.blind))
