"""How frames come to the step, decided before the first: from the images of a sequence, or as they were observed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jaxmap.checks.check import open_front_end
from jaxmap.checks.finding import Finding
from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.base import FrameRef, OnFrame, from_images, read_pose_track, timed_track
from jaxmap.datasets.label_files import LabelFolder
from jaxmap.datasets.pose_axes import to_z_up
from jaxmap.datasets.poses import poses_at
from jaxmap.datasets.registry import SAMPLE_PREFIX
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.geometry.options import GroundOptions
from jaxmap.host.files import real_path
from jaxmap.host.output_folder import dotted
from jaxmap.labellers.base import Labeller, make_no_labeller
from jaxmap.mapping.observations import ObservationAttributes, Observations, open_observations, read_attributes
from jaxmap.models.architecture import Architecture
from jaxmap.models.checkpoint import SavedModel
from jaxmap.runs.checking import warn_of_faults
from jaxmap.runs.config import CHOSEN_ANEW, CheckConfig, PerceiveConfig, check_perception, config_tree, observations_in
from jaxmap.runs.labelling import (
    ModelFile,
    Notify,
    as_usage_error,
    choose_label_folder,
    choose_labeller,
    choose_model,
    describe_network,
    network_size_px,
    warn_of_masks,
)
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.jax_matcher import JaxMatcher
from jaxmap.types import StereoCamera, pinhole

MapSettings = TypeVar("MapSettings", bound=PerceiveConfig)

_KEY_FRAMES, _LARGE_EVERY = 22, 7
"""Frames whose pictures are kept, evenly spaced, and which of them at full size: the first, the last, two between."""

MOST_MOVED_M = 10_000.0
"""Other poses farther from those of the perception are of another place, or relative to another origin."""


@dataclass(frozen=True, kw_only=True)
class Perception:
    """How frames come to the step, decided before the first: matched and labelled from images, or read as observed.

    Attributes:
        source: the folder of the sequence or of the observations, or `sample:NAME`.
        sequence: the frames and their poses.
        front_end: of the images; with observations, only its camera and its rotations mean anything.
        labeller: what gives the points of the step their classes.
        label_folder: of the files labeller.
        model: the file of the network.
        network: that itself, where it runs here.
        findings: of the quick check of the sequence.
        observations: what was perceived before, where that is what is read.
        left_image: reads the rectified left image of a frame that was observed, where the labeller sees it anew.
    """

    source: str
    sequence: StereoSequence
    front_end: StereoFrontEnd
    labeller: Labeller
    label_folder: LabelFolder | None = None
    model: ModelFile | None = None
    network: SavedModel | None = None
    findings: tuple[Finding, ...] = ()
    observations: Observations | None = None
    left_image: Callable[[FrameRef], np.ndarray] | None = None

    @property
    def key_frames(self) -> dict[int, bool]:
        """The frames whose pictures are kept, by their index, and whether at full size.

        With observations, those that have a picture.
        """
        there = list(range(len(self.sequence.frames)))
        if self.observations is not None:
            there = [index for index in there if self.observations.picture(index) is not None]
        spaced = [there[int(place)] for place in np.linspace(0, len(there) - 1, _KEY_FRAMES).round()] if there else []
        # Of frames taken twice, in a short sequence, the large one counts.
        small = dict.fromkeys(spaced, False)
        return dict(sorted((small | dict.fromkeys(spaced[::_LARGE_EVERY], True)).items()))

    @property
    def images(self) -> Iterator[Path]:
        """The files of all images, or the folders of all frames that were observed."""
        return (image for frame in self.sequence.frames for image in (frame.left, frame.right))

    def settings(self, config: PerceiveConfig) -> dict[str, Any]:
        """The settings as plain values, with the sequence and what was left to the data resolved."""
        classes = {"classes": list(self.labeller.classes)} if self.labeller.classes else {}
        model = {"model_sha256": self.model.sha256} if self.model is not None else {}
        tree = config_tree(config)
        if isinstance(self.front_end.matcher, JaxMatcher):
            tree["stereo"] = tree["stereo"] | {"cost_network_sha256": self.front_end.matcher.network_sha256}
        return {"sequence": self.source, **tree, **classes, **model}


def plan_perception(
    source: str,
    config: PerceiveConfig,
    notify: Notify,
    on_frame: OnFrame = lambda done, total: None,
    *,
    images: bool = False,
) -> Perception:
    """Opens a sequence, or observations, and decides what labels the points.

    Args:
        source: the folder of one sequence, or of observations, or `sample:NAME`.
        config: the settings.
        notify: takes lines for the user.
        on_frame: is told of the progress of odometry, where it gives the poses.
        images: of observations only disparities and poses are taken; a network sees the images of their sequence.

    Raises:
        JaxmapError: the data or the settings do not serve.
    """
    if (folder := observations_in(source)) is not None:
        seen = _of_observations(folder, config, notify, images=images)
        return _with_images(seen, config, notify) if images else seen
    sequence = open_sequence(source, config, on_frame)
    if config.strict and sequence.pose_faults:
        raise JaxmapError(sequence.pose_faults[0], fix="mend the poses, or map without --strict")
    front_end = open_front_end(sequence, config.stereo, notify)
    _describe_sequence(sequence, front_end.camera, notify)
    findings: tuple[Finding, ...] = ()
    # The bundled samples are as they should be, unless other poses or another camera are put to them.
    if not source.startswith(SAMPLE_PREFIX) or config.poses or config.calibration:
        findings = warn_of_faults(sequence, front_end, strict=config.strict, notify=notify)
    label_folder = choose_label_folder(config, sequence)
    if label_folder is not None:
        warn_of_masks(label_folder, sequence, notify)
    model, network = choose_model(config)
    with as_usage_error():
        soft = None if label_folder is None else label_folder.soft
        labeller = choose_labeller(config, soft, network, front_end.camera)
    if model is not None and network is not None:
        notify(describe_network(model, network.architecture, labeller.classes))
    source = source if source.startswith(SAMPLE_PREFIX) else str(real_path(source))
    return Perception(
        source=source,
        sequence=sequence,
        front_end=front_end,
        labeller=labeller,
        label_folder=label_folder,
        model=model,
        network=network,
        findings=findings,
    )


def _of_observations(folder: Path, config: PerceiveConfig, notify: Notify, *, images: bool) -> Perception:
    """What observations hold, for these settings; for images, which are labelled anew, their geometry alone."""
    observations = open_observations(folder)
    attributes = observations.attributes
    check_perceived_so(config, observations, geometry_alone=images)
    frames = len(observations.frames)
    if not attributes.complete:
        left = f"{frames} of {attributes.frames} frames are there"
        notify(f"note: the observations are not complete: {left}; jaxmap perceive goes on with the others")
    for name, reason in attributes.skipped.items():
        notify(f"note: not perceived: {name}: {reason}")
    chosen = np.arange(frames)[config.start : config.stop : config.stride]
    if not len(chosen):
        raise JaxmapError(
            f"start {config.start}, stop {config.stop}, stride {config.stride} select none of {frames} frames",
            where=folder,
            fix="choose another range",
        )
    observations = observations.selected(chosen)
    if config.poses is not None:
        observations = _with_poses(observations, config, notify)
    sequence = observations.sequence()
    _describe_sequence(sequence, observations.camera, notify)
    front_end = StereoFrontEnd(observations.camera, config.stereo)
    front_end.rectified_here = attributes.rectified_here
    front_end.T_raw_rectified = np.array(attributes.T_raw_rectified)
    if attributes.alignment_rad is not None:
        front_end.alignment_rad = np.array(attributes.alignment_rad)
    of_kept = config.labeller == attributes.labeller and not images
    soft = attributes.kept == "class_probabilities" if config.labeller == "files" else None
    network, model = None, None
    if of_kept and attributes.network is not None:
        network = _architecture_of(attributes.network, folder)
        told = attributes.model or {}
        model = ModelFile(Path(told.get("file", "")), told.get("sha256", "")) if told else None
    with as_usage_error():
        labeller = make_no_labeller() if images else choose_labeller(config, soft, network, observations.camera)
    if model is not None and network is not None:
        notify(describe_network(model, network, labeller.classes))
    return Perception(
        source=str(real_path(folder)),
        sequence=sequence,
        front_end=front_end,
        labeller=labeller,
        model=model,
        findings=_findings_of(attributes, folder),
        observations=observations,
    )


def _with_poses(observations: Observations, config: PerceiveConfig, notify: Notify) -> Observations:
    """The observations with the poses of a file, in the world that they have; frames without one are left out.

    Raises:
        JaxmapError: the file cannot be read, or is of another place or time.
    """
    if from_images(config):
        raise UsageError(
            "observations hold no images to estimate poses from", where="--poses", fix="perceive with --poses odometry"
        )
    track = read_pose_track(config, observations.folder)
    timestamps_s = np.array([frame.timestamp_s for frame in observations.frames], np.float64)
    track = timed_track(track, timestamps_s, config)
    T_source_camera, has_pose = poses_at(track, timestamps_s, config.max_pose_gap_s)
    if not has_pose.any():
        raise JaxmapError(
            f"none of {len(timestamps_s)} frames has a pose", where=config.poses, fix="check that both use one clock"
        )
    T_world_camera, _ = to_z_up(T_source_camera[has_pose], config.poses_world, config.poses_up)
    T_world_camera[:, :3, 3] -= np.array(observations.attributes.site_origin)
    kept = observations.selected(np.flatnonzero(has_pose))
    away_m = float(np.median(np.linalg.norm((T_world_camera - kept.T_world_camera)[:, :3, 3], axis=1)))
    if away_m > MOST_MOVED_M:
        raise JaxmapError(
            f"the poses lie {away_m / 1e3:.0f} km from those that the frames were perceived with",
            where=config.poses,
            fix="give absolute ones, as poses.tum of a run has them",
        )
    for note in (*track.notes, *track.faults):
        notify(f"note: {note}")
    if left_out := int((~has_pose).sum()):
        notify(f"note: {left_out} of {len(has_pose)} frames have no pose in {config.poses} and are left out")
    return replace(kept, T_world_camera=T_world_camera)


def _with_images(seen: Perception, config: PerceiveConfig, notify: Notify) -> Perception:
    """The same frames, seen anew by a network: with the images of the sequence that they were perceived from.

    Raises:
        JaxmapError: that sequence is not there any more, or has another camera or other frames.
    """
    observations = seen.observations
    assert observations is not None
    attributes, where = observations.attributes, observations.folder
    fix = "bring the sequence back as it was, or perceive it again"
    perceived = check_perception(attributes.settings, where)
    sequence = open_sequence(attributes.sequence, perceived)
    front_end = open_front_end(sequence, perceived.stereo, lambda line: None)
    if pinhole(front_end.camera) != pinhole(seen.front_end.camera):
        raise JaxmapError(f"the camera of {attributes.sequence} is another by now", where=where, fix=fix)
    refs = {ref.name: ref for ref in sequence.frames}
    if lost := [ref.name for ref in observations.frames if ref.name not in refs]:
        raise JaxmapError(f"{attributes.sequence} has no frame {lost[0]} any more", where=where, fix=fix)

    def left_image(ref: FrameRef) -> np.ndarray:
        pair = sequence.read_pair(refs[ref.name])
        return front_end.rectify(pair.left, pair.right)[0]

    model, network = choose_model(config)
    with as_usage_error():
        labeller = choose_labeller(config, None, network, seen.front_end.camera)
    if model is not None and network is not None:
        notify(describe_network(model, network.architecture, labeller.classes))
    return replace(seen, labeller=labeller, model=model, network=network, left_image=left_image)


def settings_taken_over(config: MapSettings, observations: Path) -> MapSettings:
    """The settings with those of reading and matching that the frames were perceived with, where they name none."""
    usual, then = type(config)(), check_perception(read_attributes(observations).settings, observations)
    names = {one.name for one in fields(CheckConfig)} - {*CHOSEN_ANEW}
    taken = {name: getattr(then, name) for name in names if getattr(config, name) == getattr(usual, name)}
    return replace(config, **taken)


def check_perceived_so(config: PerceiveConfig, observations: Observations, *, geometry_alone: bool = False) -> None:
    """Refuses settings under which the frames would have been perceived otherwise.

    Args:
        config: the settings of what fuses them.
        observations: the frames.
        geometry_alone: only of their disparities; what labels them is of no account.

    Raises:
        UsageError: there are some; they are named.
    """
    attributes, where = observations.attributes, observations.folder
    now, then = dotted(config_tree(PerceiveConfig.of(config))), dotted(attributes.settings)
    size_px = network_size_px(config, observations.camera)
    now["deeplab.size_px"] = None if size_px is None else list(size_px)
    if geometry_alone:
        of_geometry = {one.name for one in fields(ReadOptions)}
        now = {name: value for name, value in now.items() if name.partition(".")[0] in {*of_geometry, "stereo"}}
    elif config.labeller not in (attributes.labeller, "plane", "relief", "none"):
        kept = f"the observations hold no labels of {config.labeller}: they were perceived with {attributes.labeller}"
        raise UsageError(kept, where=where, fix="perceive the sequence again with that labeller")
    # Without a checksum any network will do: none is run again.
    for name in ("model_sha256", "stereo.cost_network_sha256"):
        now[name] = now.get(name) or then.get(name)
    differing = [name for name in now if now[name] != then.get(name) and not _is_free(name, attributes)]
    if differing:
        raise UsageError(
            f"the frames were perceived with another {', '.join(sorted(differing))}",
            where=where,
            fix="leave that out, or perceive the sequence again with it",
        )


def _is_free(name: str, attributes: ObservationAttributes) -> bool:
    """Whether a setting acts when frames are fused, and not when they are perceived."""
    if name.startswith("relief."):
        ground = {field.name for field in fields(GroundOptions)}
        return not saw_relief(attributes) or name.removeprefix("relief.") not in ground
    free = (*CHOSEN_ANEW, "labeller", "deeplab.soft", "deeplab.temperature")
    if attributes.kept in (None, "logits"):
        free = (*free, "classes")
    if attributes.kept != "logits":
        free = (*free, "model", "model_sha256", "deeplab.size_px", "deeplab.see_relief")
    return name in free or name.startswith(("plane.", "deeplab.class_map"))


def saw_relief(attributes: ObservationAttributes) -> bool:
    """Whether the network was shown the relief of each frame."""
    network, deeplab = attributes.network or {}, attributes.settings.get("deeplab", {})
    return bool(network.get("relief_channels")) and bool(deeplab.get("see_relief"))


def _findings_of(attributes: ObservationAttributes, where: Path) -> tuple[Finding, ...]:
    try:
        return tuple(Finding(**finding) for finding in attributes.findings)
    except TypeError as fault:
        raise JaxmapError(
            "the attribute findings is damaged", where=where, fix="perceive the sequence again"
        ) from fault


def _architecture_of(network: dict[str, Any], where: Path) -> Architecture:
    try:
        return Architecture(**network)
    except (JaxmapError, TypeError) as fault:
        raise JaxmapError("the attribute network is damaged", where=where, fix="perceive the sequence again") from fault


def _describe_sequence(sequence: StereoSequence, camera: StereoCamera, notify: Notify) -> None:
    """What was opened, what its reader noted, and where its world begins."""
    notify(
        f"{sequence.name} ({sequence.dataset}): {len(sequence.frames)} frames "
        f"of {camera.width_px} x {camera.height_px} px, f {float(camera.fx_px):.2f} px, "
        f"baseline {float(camera.baseline_m):.5f} m"
    )
    for note in sequence.notes:
        notify(f"note: {note}")
    if sequence.site_origin.any():
        origin = " ".join(f"{number:.0f}" for number in sequence.site_origin)
        notify(f"site origin {origin} ({sequence.crs or 'no CRS given: --crs'}); bounds are relative to it")
