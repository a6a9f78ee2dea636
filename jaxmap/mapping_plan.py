"""A mapping run, decided in full before the first frame: what is read, its range, bounds and step."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jaxmap.config import MapConfig, split_fusion
from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.label_files import LabelFolder
from jaxmap.datasets.registry import SAMPLE_PREFIX
from jaxmap.ensemble.draws import draw_ensemble
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.fusion.params import FusionRule, make_fusion_params
from jaxmap.geometry.bounds import check_memory, usable_depth
from jaxmap.labellers import Labeller
from jaxmap.mapper import Mapper, MapperParams, make_mapper
from jaxmap.mapping_grid import choose_grid, told_grid
from jaxmap.mapping_labels import ModelFile, choose_label_folder, choose_labeller, choose_model, told_network
from jaxmap.sequence import frame_form
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.types import Frame, GridSpec, StereoCamera

Tell = Callable[[str], None]

_KEY_FRAMES = 4


@dataclass(frozen=True)
class Plan:
    """A run, decided in full before the first frame is fused."""

    source: str
    sequence: StereoSequence
    front_end: StereoFrontEnd
    labeller: Labeller
    label_folder: LabelFolder | None
    model: ModelFile | None
    grid: GridSpec
    depth_range_m: tuple[float, float]
    rule: FusionRule
    params: MapperParams
    fusion: dict[str, Any]
    mapper: Mapper
    key: PRNGKeyArray
    pose_errors: Float[np.ndarray, "N M 6"] | None = None
    """Of the members of an ensemble, for each frame."""

    @property
    def members(self) -> int:
        """How many members the ensemble has."""
        return 0 if self.pose_errors is None else self.pose_errors.shape[1]

    @property
    def frame_form(self) -> Frame:
        """The form of the frames that the step takes."""
        return frame_form(self.front_end.camera, self.labeller, self.members)

    @property
    def key_frames(self) -> set[int]:
        """Indices of the frames whose pictures are kept."""
        return {int(index) for index in np.linspace(0, len(self.sequence.frames) - 1, _KEY_FRAMES)}

    @property
    def resolved(self) -> dict[str, Any]:
        """Settings that were left to the data, as they have come out."""
        classes = {"classes": list(self.labeller.classes)} if self.labeller.classes else {}
        return classes | ({"model_sha256": self.model.sha256} if self.model is not None else {})

    def digest(self, count: int) -> str:
        """A fingerprint of the first frames, their poses and the camera: what a resumed run must share."""
        frames = self.sequence.frames[:count]
        described = [(frame.name, frame.timestamp_s) for frame in frames]
        camera = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(self.front_end.camera)]
        poses = np.ascontiguousarray(self.sequence.T_world_camera[:count])
        return hashlib.sha256(repr((described, camera)).encode() + poses.tobytes()).hexdigest()[:16]


def plan_run(source: str, config: MapConfig, tell: Tell) -> Plan:
    """Opens the sequence and decides range, bounds, labeller and step.

    Args:
        source: the folder of one sequence, or `sample:NAME`.
        config: the settings.
        tell: takes lines for the user.

    Raises:
        JaxmapError: the data or the settings do not serve.
    """
    options = ReadOptions(
        dataset=config.dataset,
        poses=config.poses,
        poses_world=config.poses_world,
        calibration=config.calibration,
        camera=config.camera,
        antenna_m=config.antenna_m,
        start=config.start,
        stop=config.stop,
        stride=config.stride,
        max_pose_gap_s=config.max_pose_gap_s,
        crs=config.crs,
    )
    sequence = open_sequence(source, options)
    front_end = StereoFrontEnd(sequence.camera, config.stereo)
    camera = front_end.camera
    _tell_sequence(sequence, camera, tell)
    depth_range_m = _depth_range(config, camera)
    label_folder = choose_label_folder(config, sequence)
    model, network = choose_model(config)
    with _as_usage_error():
        labeller = choose_labeller(config, label_folder, network)
        if model is not None and network is not None:
            tell(told_network(model, network, labeller.classes))
        grid = choose_grid(config, sequence, front_end, depth_range_m[1], len(labeller.classes))
        params, rule = split_fusion(config.fusion, labeller.classes)
        fusion_rule = FusionRule(**rule)
        fusion_params = make_fusion_params(labeller.classes, **params)
        members = _members(config, fusion_rule, labeller.classes)
    tell(told_grid(grid, depth_range_m, len(labeller.classes), members))
    check_memory(grid, len(labeller.classes), config.grid.max_memory_gib, members)
    key = jax.random.key(config.seed)
    ensemble, pose_errors = None, None
    if members:
        timestamps_s = np.array([frame.timestamp_s for frame in sequence.frames], np.float64)
        ensemble, pose_errors = draw_ensemble(key, fusion_params, timestamps_s, config.ensemble)

    return Plan(
        source=source if source.startswith(SAMPLE_PREFIX) else str(Path(source).resolve()),
        sequence=sequence,
        front_end=front_end,
        labeller=labeller,
        label_folder=label_folder,
        model=model,
        grid=grid,
        depth_range_m=depth_range_m,
        rule=fusion_rule,
        params=MapperParams(camera, fusion_params, labeller.params, ensemble),
        fusion={"params": params, "rule": rule} | ({"ensemble": asdict(config.ensemble)} if members else {}),
        mapper=make_mapper(
            camera,
            grid,
            labeller,
            fusion_rule,
            depth_range_m,
            members=members,
            # The members of an ensemble stand elsewhere.
            T_world_camera=None if members else sequence.T_world_camera @ front_end.T_raw_rectified,
        ),
        key=key,
        pose_errors=pose_errors,
    )


def _tell_sequence(sequence: StereoSequence, camera: StereoCamera, tell: Tell) -> None:
    """What was opened, what its reader noted, and where its world begins."""
    tell(
        f"{sequence.name} ({sequence.dataset}): {len(sequence.frames)} frames "
        f"of {camera.width_px} x {camera.height_px} px, f {float(camera.fx_px):.2f} px, "
        f"baseline {float(camera.baseline_m):.5f} m"
    )
    for note in sequence.notes:
        tell(f"note: {note}")
    if sequence.site_origin.any():
        origin = " ".join(f"{number:.0f}" for number in sequence.site_origin)
        tell(f"site origin {origin} ({sequence.crs or 'no CRS given: --crs'}); bounds are relative to it")


def _depth_range(config: MapConfig, camera: StereoCamera) -> tuple[float, float]:
    """The depths that are mapped, in metres; without a greatest one, as far as the camera is good for.

    Raises:
        UsageError: there is nothing between them.
    """
    max_depth_m = config.depth.max_m or usable_depth(camera, config.depth.max_sigma_m, config.fusion.disparity_sigma_px)
    if not config.depth.min_m < max_depth_m:
        raise UsageError(
            f"depth.min_m {config.depth.min_m} is not below the greatest depth, {max_depth_m} m",
            fix="set --depth.max-m",
        )
    return config.depth.min_m, max_depth_m


def _members(config: MapConfig, rule: FusionRule, classes: Sequence[str]) -> int:
    """How many members the ensemble has.

    Raises:
        UsageError: the map has no class that it could be asked about.
    """
    members = config.ensemble.members
    if members and rule.target(classes) is None:
        known = f"its classes are {' '.join(classes)}" if classes else "it has no class at all"
        raise UsageError(
            f"an ensemble tells where the map misses a priority class, and the map has none: {known}",
            where="ensemble.members",
            fix="name a class with --fusion.priority-classes, or leave the ensemble out",
        )
    return members


@contextmanager
def _as_usage_error() -> Iterator[None]:
    """What is refused while settings are taken up is the fault of the settings."""
    try:
        yield
    except UsageError:
        raise
    except JaxmapError as error:
        raise UsageError(error.what, where=error.where, fix=error.fix or "see jaxmap map --help") from error
