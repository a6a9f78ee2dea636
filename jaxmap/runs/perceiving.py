"""Perceiving: each frame is matched and seen by the network once, and kept; `jaxmap perceive` does nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import jaxmap
from jaxmap.datasets.base import FrameRef
from jaxmap.errors import FrameError, JaxmapError, UsageError
from jaxmap.host.output_folder import check_same_settings, write_json, write_yaml
from jaxmap.host.prefetch import prefetch
from jaxmap.host.replacement import Replacement
from jaxmap.host.stages import timed_stage
from jaxmap.labellers.base import Labeller
from jaxmap.mapping.observations import (
    Observation,
    ObservationAttributes,
    Observations,
    is_observed,
    matrix_of,
    open_observations,
    read_attributes,
    remove_stray_frames,
    write_attributes,
    write_observation,
)
from jaxmap.mapping.quantised import Kept
from jaxmap.mapping.sequence import PreparedFrame, as_prepared, frame_form, prepare_frames
from jaxmap.mapping.step import perceive_frame
from jaxmap.runs.checking import findings_tree
from jaxmap.runs.config import PerceiveConfig
from jaxmap.runs.folder import RunFolder, write_key_frame
from jaxmap.runs.labelling import Notify, choose_labeller, network_size_px
from jaxmap.runs.log import Sample
from jaxmap.runs.perception import Perception
from jaxmap.types import Frame


@dataclass(frozen=True)
class Keeper:
    """Perceives the frames of a sequence that are not there yet, and keeps them.

    Attributes:
        seen: the sequence, and what perceives it.
        attributes: of the observations.
        labeller: what labels the points by what is kept.
        see: the compiled network: the logits of a prepared frame; None where nothing is computed.
    """

    seen: Perception
    attributes: ObservationAttributes
    labeller: Labeller
    see: Callable[[Frame], jax.Array] | None

    def frames(
        self, folder: Path, indices: Sequence[int], pose_errors: Float[np.ndarray, "N M 6"] | None = None
    ) -> Iterator[PreparedFrame]:
        """The frames as they are kept: those that are there are read, the others are perceived and written first.

        What the step fuses is what was rounded, so that a map made on the way and one made afterwards are the same.

        Args:
            folder: the observations; `begin` was called.
            indices: of the frames.
            pose_errors: of the members of an ensemble, for each frame.

        Raises:
            JaxmapError: the first readable pair has left and right swapped, or the disk is full.
        """
        seen, kept = self.seen, self.attributes.kept
        refs = seen.sequence.frames
        observations = self._observations(folder)
        missing = [index for index in indices if not is_observed(folder, refs[index].name)]
        needs = "image" if self.see is not None else None
        ready = prepare_frames(seen.sequence, seen.front_end, seen.label_folder, needs=needs, indices=missing)

        def perceived() -> Iterator[tuple[int, PreparedFrame | None, jax.Array | None]]:
            absent = set(missing)
            for index in indices:
                prepared = next(ready) if index in absent else None
                logits = None
                if prepared is not None and prepared.frame is not None and self.see is not None:
                    with timed_stage("network", prepared.stages_s):
                        logits = self.see(prepared.frame).block_until_ready()
                yield index, prepared, logits

        def keep(item: tuple[int, PreparedFrame | None, jax.Array | None]) -> PreparedFrame:
            index, prepared, logits = item
            ref = refs[index]
            if prepared is not None and (prepared.frame is None or prepared.rectified is None):
                return prepared
            stages_s = {} if prepared is None else prepared.stages_s
            try:
                with timed_stage("keep" if prepared is not None else "read", stages_s):
                    if prepared is not None:
                        write_observation(folder, self._observation(index, prepared, logits), kept)
                    again = as_prepared(observations, observations.observation(index), index, pose_errors)
            except FrameError as fault:
                return PreparedFrame(index, ref, fault=fault.at(f"frame {ref.name}"))
            rectified = again.rectified if prepared is None else prepared.rectified
            return replace(again, rectified=rectified, stages_s=stages_s)

        return prefetch(keep, perceived(), workers=1, ahead=2)

    def begin(self, folder: Path) -> None:
        """Makes the observations, or takes up those that are there.

        Raises:
            JaxmapError: those were perceived otherwise, or of another sequence; or the disk is full.
        """
        again = "bring the sequence back as it was, or perceive it anew with --overwrite"
        if (folder / "zarr.json").exists():
            if read_attributes(folder).digest() != self.attributes.digest():
                raise JaxmapError(
                    "the frames that are there were perceived by another camera, matcher or network",
                    where=folder,
                    fix=again,
                )
            self._check_same_frames(folder, again)
        write_attributes(folder, self.attributes)
        remove_stray_frames(folder)

    def finish(self, folder: Path, skipped: Mapping[str, str]) -> None:
        """Notes that all frames are there but those that could not be used."""
        write_attributes(folder, replace(self.attributes, skipped=dict(skipped), complete=True))

    def _check_same_frames(self, folder: Path, again: str) -> None:
        planned = {ref.name: number for number, ref in enumerate(self.seen.sequence.frames)}
        if not any(is_observed(folder, name) for name in planned):
            return
        there = open_observations(folder)
        for ref, pose in zip(there.frames, there.T_world_camera, strict=True):
            number = planned.get(ref.name)
            same = number is not None and self.seen.sequence.frames[number].timestamp_s == ref.timestamp_s
            if number is not None and not (same and np.array_equal(self.seen.sequence.T_world_camera[number], pose)):
                raise JaxmapError(f"frame {ref.name} was perceived at another pose or time", where=folder, fix=again)

    def _observations(self, folder: Path) -> Observations:
        """The observations as they will be."""
        sequence = self.seen.sequence
        refs = tuple(
            FrameRef(ref.name, ref.timestamp_s, folder / ref.name, folder / ref.name) for ref in sequence.frames
        )
        return Observations(folder, self.attributes, refs, sequence.T_world_camera)

    def _observation(self, index: int, prepared: PreparedFrame, logits: jax.Array | None) -> Observation:
        frame, rectified, kept = prepared.frame, prepared.rectified, self.attributes.kept
        assert frame is not None and rectified is not None
        values = logits if kept == "logits" else None if kept is None else getattr(frame, kept)
        return Observation(
            prepared.ref.name,
            prepared.ref.timestamp_s,
            self.seen.sequence.T_world_camera[index],
            self.seen.front_end.disparity_of(rectified),
            None if values is None else np.asarray(values),
            rectified.too_near,
            rectified.nearest_px,
        )


def make_keeper(seen: Perception, config: PerceiveConfig, disparity_sigma_px: float) -> Keeper:
    """Decides what is kept of the frames of a sequence.

    Args:
        seen: the sequence, and what perceives it.
        config: the settings.
        disparity_sigma_px: noise of the disparity under which a network is shown relief.

    Raises:
        UsageError: these are observations already.
    """
    if seen.observations is not None:
        raise UsageError("these are observations already", where=seen.source, fix="give the sequence, or map them")
    camera, labeller = seen.front_end.camera, seen.labeller
    see: Callable[[Frame], jax.Array] | None = None
    kept: Kept | None = None
    shape: tuple[int, ...] = ()
    classes = labeller.classes
    if seen.network is not None:
        architecture, soft = seen.network.architecture, None
        kept, classes, perceiver = "logits", architecture.classes, labeller
        labeller = choose_labeller(config, soft, architecture, camera)
        # The weights are handed to the compiled function, not compiled into it.
        compiled = jax.jit(lambda frame, params: perceive_frame(perceiver, camera, frame, params, disparity_sigma_px))
        shape = jax.eval_shape(compiled, frame_form(camera, perceiver), perceiver.params).shape
        see = lambda frame: compiled(frame, perceiver.params)  # noqa: E731
    elif seen.label_folder is not None:
        kept = "class_probabilities" if seen.label_folder.soft else "labels"
        shape = (camera.height_px, camera.width_px, *([len(classes)] if seen.label_folder.soft else []))
    return Keeper(seen, _attributes(seen, config, disparity_sigma_px, kept, shape, classes), labeller, see)


def _attributes(
    seen: Perception,
    config: PerceiveConfig,
    disparity_sigma_px: float,
    kept: Kept | None,
    kept_shape: tuple[int, ...],
    classes: tuple[str, ...],
) -> ObservationAttributes:
    sequence, front_end = seen.sequence, seen.front_end
    numbers = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px", "width_px", "height_px")
    return ObservationAttributes(
        sequence=seen.source,
        name=sequence.name,
        dataset=sequence.dataset,
        camera={name: float(getattr(front_end.camera, name)) for name in numbers},
        settings=resolved_settings(seen, config),
        labeller=config.labeller,
        kept=kept,
        kept_shape=kept_shape,
        classes=classes,
        network=None if seen.network is None else asdict(seen.network.architecture),
        model=None if seen.model is None else {"file": str(seen.model.path), "sha256": seen.model.sha256},
        disparity_sigma_px=float(disparity_sigma_px),
        T_raw_rectified=matrix_of(front_end.T_raw_rectified),
        rectified_here=front_end.rectified_here,
        alignment_rad=None if (turn := front_end.alignment_rad) is None else tuple(turn.tolist()),
        crs=sequence.crs,
        site_origin=tuple(np.asarray(sequence.site_origin, np.float64).tolist()),
        T_world_source=matrix_of(sequence.T_world_source),
        notes=sequence.notes,
        findings=tuple(findings_tree(seen.findings)),
        key_frames={sequence.frames[index].name: index for index in sorted(seen.key_frames)},
        frames=len(sequence.frames),
    )


def resolved_settings(seen: Perception, config: PerceiveConfig) -> dict[str, Any]:
    """The settings of the perception as plain values, with what was left to the data resolved."""
    tree = seen.settings(PerceiveConfig.of(config))
    size_px = network_size_px(config, seen.front_end.camera) if seen.network is not None else None
    tree["deeplab"] = tree["deeplab"] | ({} if size_px is None else {"size_px": list(size_px)})
    return {name: value for name, value in tree.items() if name != "sequence"}


def outputs_of(folder: RunFolder) -> Iterable[Path]:
    """What a perception writes into its folder."""
    return (folder.observations, folder.config, folder.metrics, *folder.pictures.glob("[0-9]*_*.*"))


@contextmanager
def observing(folder: RunFolder, settings: dict[str, Any], *, overwrite: bool, notify: Notify) -> Iterator[RunFolder]:
    """Begins or goes on with observations, and yields the folder to write into; it must be locked.

    Raises:
        JaxmapError: the folder holds something else.
        UsageError: it holds observations that were perceived with other settings.
    """
    replacement = Replacement(folder.path, lambda: outputs_of(folder))
    replacement.settle()
    if folder.map.exists():
        raise JaxmapError("the folder holds a run", where=folder.path, fix="choose another --out")
    if overwrite:
        with replacement.place(folder.observations.name, notify) as place:
            work = RunFolder(place)
            write_yaml(work.config, settings)
            yield work
        return
    if folder.observations.exists():
        check_same_settings(folder.config, settings)
    elif folder.config.exists():
        raise JaxmapError("no perception has written this", where=folder.config, fix="choose another --out")
    else:
        write_yaml(folder.config, settings)
    yield folder


@dataclass
class _Log:
    """What has been done so far."""

    perceived: int = 0
    skipped: dict[str, str] = field(default_factory=dict)
    stages_ms: dict[str, Sample] = field(default_factory=dict)

    def add(self, kept: KeptFrame) -> None:
        if kept.fault is not None:
            self.skipped[kept.name] = str(kept.fault)
            return
        self.perceived += 1
        for name, seconds in kept.stages_s.items():
            self.stages_ms.setdefault(name, Sample()).add(round(1e3 * seconds, 3))


class KeptFrame(NamedTuple):
    """What became of a frame: it is kept, or there is a fault."""

    name: str
    fault: FrameError | None
    stages_s: dict[str, float]


def keep_frames(keeper: Keeper, folder: RunFolder, indices: Sequence[int]) -> Iterator[KeptFrame]:
    """Perceives frames and keeps them, and the pictures of the key frames.

    Raises:
        JaxmapError: the first readable pair has left and right swapped, or the disk is full.
    """
    for prepared in keeper.frames(folder.observations, indices):
        if prepared.frame is not None and prepared.index in keeper.seen.key_frames:
            rectified = prepared.rectified
            if rectified is None or not rectified.left.size:
                # Kept by a process that was killed before it drew the picture.
                seen = keeper.seen
                pair = seen.sequence.read_pair(seen.sequence.frames[prepared.index])
                rectified = seen.front_end(pair.left, pair.right)
            # At full size: maps draw their own pictures, of any size, from these.
            write_key_frame(folder, prepared.index, rectified, None, (), large=True)
        yield KeptFrame(prepared.ref.name, prepared.fault, prepared.stages_s)


def run_perception(
    keeper: Keeper,
    folder: RunFolder,
    *,
    strict: bool,
    notify: Notify,
    on_frame: Callable[[int], object] = lambda done: None,
    keep: Callable[[Sequence[int]], Iterable[KeptFrame]] | None = None,
) -> dict[str, Any]:
    """Perceives the frames that are not there yet, and keeps each as soon as it is seen.

    Args:
        keeper: what perceives and keeps.
        folder: where it goes, of `observing`.
        strict: stop at the first frame that cannot be used.
        notify: takes lines for the user.
        on_frame: is told after each frame how many are done.
        keep: perceives frames and keeps them, in whatever order; `keep_frames` by default.

    Returns:
        The metrics, as they are in metrics.json.

    Raises:
        JaxmapError: no frame could be perceived, or one cannot be written.
    """
    refs, log = keeper.seen.sequence.frames, _Log()
    keeper.begin(folder.observations)
    missing = [index for index, ref in enumerate(refs) if not is_observed(folder.observations, ref.name)]
    there = len(refs) - len(missing)
    if there:
        notify(f"{there} of {len(refs)} frames are there already" + ("" if missing else ": nothing is left to do"))
    started_s = time.perf_counter()
    for kept in keep_frames(keeper, folder, missing) if keep is None else keep(missing):
        if strict and kept.fault is not None:
            raise kept.fault
        log.add(kept)
        on_frame(there + log.perceived + len(log.skipped))
    if not there + log.perceived:
        reason = next(iter(log.skipped.values()))
        raise JaxmapError(f"none of {len(refs)} frames could be perceived; the first: {reason}")
    keeper.finish(folder.observations, log.skipped)
    total_s = time.perf_counter() - started_s
    metrics = _metrics(keeper, folder, log, there, total_s)
    write_json(folder.metrics, metrics)
    return metrics


def _metrics(keeper: Keeper, folder: RunFolder, log: _Log, there: int, total_s: float) -> dict[str, Any]:
    """What metrics.json holds."""
    seen, attributes = keeper.seen, keeper.attributes
    files = [path for path in folder.observations.rglob("*") if path.is_file()]
    kept = there + log.perceived
    return {
        "jaxmap_version": jaxmap.__version__,
        "sequence": {
            "name": attributes.name,
            "dataset": attributes.dataset,
            "frames": attributes.frames,
            "kept": kept,
            "skipped": [{"frame": name, "reason": reason} for name, reason in log.skipped.items()],
            "notes": list(attributes.notes),
            "findings": list(attributes.findings),
        },
        "labeller": attributes.labeller,
        **({} if seen.model is None else {"model": attributes.model}),
        "digest": attributes.digest(),
        "bytes_per_frame": round(sum(path.stat().st_size for path in files) / kept),
        "times": {
            "perceived": log.perceived,
            "total_s": round(total_s, 3),
            "frames_per_s": round(log.perceived / max(total_s, 1e-9), 3),
            "stages": {name: {"median_ms": round(times.percentile(50), 3)} for name, times in log.stages_ms.items()},
        },
    }
