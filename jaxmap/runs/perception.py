"""How frames come to the step, decided before the first: from the images of a sequence, or as they were observed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.checks.check import open_front_end
from jaxmap.checks.finding import Finding
from jaxmap.datasets import StereoSequence, open_sequence
from jaxmap.datasets.base import OnFrame, from_images, read_pose_track, timed_track
from jaxmap.datasets.label_files import LabelFolder
from jaxmap.datasets.pose_axes import to_z_up
from jaxmap.datasets.poses import poses_at
from jaxmap.datasets.registry import SAMPLE_PREFIX
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.geometry.options import GroundOptions
from jaxmap.host.files import real_path
from jaxmap.host.output_folder import dotted
from jaxmap.labellers.base import Labeller
from jaxmap.mapping.observations import ObservationAttributes, Observations, open_observations
from jaxmap.models.architecture import Architecture
from jaxmap.models.checkpoint import SavedModel
from jaxmap.runs.checking import warn_of_faults
from jaxmap.runs.config import CHOSEN_ANEW, PerceiveConfig, config_tree, observations_in
from jaxmap.runs.labelling import (
    ModelFile,
    Notify,
    as_usage_error,
    choose_label_folder,
    choose_labeller,
    choose_model,
    describe_network,
)
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.types import StereoCamera

_KEY_FRAMES = 4

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

    @property
    def key_frames(self) -> set[int]:
        """Indices of the frames whose pictures are kept; with observations, those that have one."""
        count = len(self.sequence.frames)
        if self.observations is not None:
            return {index for index in range(count) if self.observations.picture(index) is not None}
        return {int(index) for index in np.linspace(0, count - 1, _KEY_FRAMES)}

    @property
    def images(self) -> Iterator[Path]:
        """The files of all images, or the folders of all frames that were observed."""
        return (image for frame in self.sequence.frames for image in (frame.left, frame.right))

    def settings(self, config: PerceiveConfig) -> dict[str, Any]:
        """The settings as plain values, with the sequence and what was left to the data resolved."""
        classes = {"classes": list(self.labeller.classes)} if self.labeller.classes else {}
        model = {"model_sha256": self.model.sha256} if self.model is not None else {}
        return {"sequence": self.source, **config_tree(config), **classes, **model}


def plan_perception(
    source: str, config: PerceiveConfig, notify: Notify, on_frame: OnFrame = lambda done, total: None
) -> Perception:
    """Opens a sequence, or observations, and decides what labels the points.

    Args:
        source: the folder of one sequence, or of observations, or `sample:NAME`.
        config: the settings.
        notify: takes lines for the user.
        on_frame: is told of the progress of odometry, where it gives the poses.

    Raises:
        JaxmapError: the data or the settings do not serve.
    """
    if (folder := observations_in(source)) is not None:
        return _of_observations(folder, config, notify)
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


def _of_observations(folder: Path, config: PerceiveConfig, notify: Notify) -> Perception:
    """What observations hold, for these settings."""
    observations = open_observations(folder)
    attributes = observations.attributes
    check_perceived_so(config, attributes, folder)
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
    of_kept = config.labeller == attributes.labeller
    soft = attributes.kept == "class_probabilities" if config.labeller == "files" else None
    network, model = None, None
    if of_kept and attributes.network is not None:
        network = _architecture_of(attributes.network, folder)
        model = ModelFile(Path(attributes.model["file"]), attributes.model["sha256"]) if attributes.model else None
    with as_usage_error():
        labeller = choose_labeller(config, soft, network, observations.camera)
    if model is not None and network is not None:
        notify(describe_network(model, network, labeller.classes))
    findings = tuple(Finding(**finding) for finding in attributes.findings)
    return Perception(
        source=str(real_path(folder)),
        sequence=sequence,
        front_end=front_end,
        labeller=labeller,
        model=model,
        findings=findings,
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
    T_world_camera, _ = to_z_up(T_source_camera[has_pose], config.poses_world)
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


def check_perceived_so(config: PerceiveConfig, attributes: ObservationAttributes, where: Path) -> None:
    """Refuses settings under which the frames would have been perceived otherwise.

    Raises:
        UsageError: there are some; they are named.
    """
    now, then = dotted(config_tree(PerceiveConfig.of(config))), dotted(attributes.settings)
    if config.labeller not in (attributes.labeller, "plane", "relief", "none"):
        kept = f"the observations hold no labels of {config.labeller}: they were perceived with {attributes.labeller}"
        raise UsageError(kept, where=where, fix="perceive the sequence again with that labeller")
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
    return name in free or name.startswith(("plane.", "deeplab.class_map"))


def saw_relief(attributes: ObservationAttributes) -> bool:
    """Whether the network was shown the relief of each frame."""
    network, deeplab = attributes.network or {}, attributes.settings.get("deeplab", {})
    return bool(network.get("relief_channels")) and bool(deeplab.get("see_relief"))


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
