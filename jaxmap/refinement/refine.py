"""The refinement of a sequence: matching and solving in turn, coarse to fine, then with ties to the ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.refinement.consistency import Consistency, consistency_of
from jaxmap.refinement.frames import DisparityFrame, PixelSamples, sample_bilinear, sample_pixels
from jaxmap.refinement.ground import (
    GroundRaster,
    ground_contact,
    height_term,
    placement_term,
    register_labels,
    rock_relief,
)
from jaxmap.refinement.matching import MatchTable, PoseUncertainty, match_neighbours, match_overlapping, match_table
from jaxmap.refinement.residuals import linearise, make_device_rig
from jaxmap.refinement.rig import PER_FRAME, SHARED, Rig, displacement, make_rig, points_world, vehicle_axes
from jaxmap.refinement.solver import (
    FIRST_ANGLE_RAD,
    FIRST_POSITION_M,
    MAX_STEPS,
    Prior,
    ResidualTerm,
    Solution,
    solve,
)
from jaxmap.types import Pinhole

MATCH_SIGMA_PX, DISPARITY_SIGMA_PX = 0.25, 0.25
PAIR_WEIGHT = 30.0
"""Errors of matching are correlated within a pair of frames: its matches count as so many independent ones, at most."""

RADII_PX = (12, 6)
"""Radii of the windows in which overlapping frames are compared, round by round."""

BLURS_M = (0.3, 0.1, 0.0)
"""An elevation model is smoothed at first, so that its rocks attract from as far away as the poses may be wrong."""

SPARSE, DENSE = 600, 20_000
"""Pixels sampled in each frame: for the elevation model, and for the consistency and relief of the map."""

FEW_STEPS = 4
"""Enough for a solution that only initialises the next one."""


class GroundReference(NamedTuple):
    """What is known of the ground; each may be None.

    Attributes:
        heights: elevations of the world.
        is_rock: 1 rock, 0 no rock, NaN unlabelled.
        below_camera_m: how far below the cameras, as given, the ground lies that the rover drives over.
    """

    heights: GroundRaster | None = None
    is_rock: GroundRaster | None = None
    below_camera_m: float | None = None


@dataclass
class Refinement:
    """The state of a refinement.

    Attributes:
        given: the rig before.
        solution: the best so far.
        before, after: consistency of the map with the given and with the refined rig.
        residuals_px: median length of the match residuals, step by step.
        rounds: the step at which each round began, and its name.
        pairs: how many pairs of frames have matches.
        matches: how many matches there are.
        unmatched: frames that share no match with any other; they keep their prior.
        notes: remarks for the user.
    """

    given: Rig
    solution: Solution | None = None
    before: Consistency | None = None
    after: Consistency | None = None
    residuals_px: list[float] = field(default_factory=list)
    rounds: list[tuple[int, str]] = field(default_factory=list)
    pairs: int = 0
    matches: int = 0
    unmatched: list[int] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def rig(self) -> Rig:
        """The best rig so far."""
        return self.given if self.solution is None else self.solution.rig


OnRound = Callable[[Refinement], None]
Advance = Callable[[int, str], None]


def refine(
    frames: Sequence[DisparityFrame],
    T_world_camera: Float64[np.ndarray, "N 4 4"],
    camera: Pinhole,
    prior: Prior,
    ground: GroundReference,
    depth_range_m: tuple[float, float],
    *,
    advance: Advance = lambda done, note: None,
    on_round: OnRound = lambda refinement: None,
) -> Refinement:
    """Refines the poses of frames, the camera's mounting and the stereo calibration.

    Args:
        frames: rectified and matched.
        T_world_camera: their given poses, of the rectified camera, in a z-up world.
        camera: of all frames.
        prior: how wrong poses, mounting and calibration may be.
        ground: what ties the map to the ground.
        depth_range_m: only points of these depths are used.
        advance: called with the number of frames done, of three times all frames, and the name of the round.
        on_round: called with the state after each round.

    Raises:
        JaxmapError: fewer than two frames, no overlap between them, or residuals that are not finite.
    """
    if len(frames) < 2:
        raise JaxmapError(
            f"{len(frames)} frame with disparities", fix="refining needs two frames that overlap, or more"
        )
    state = Refinement(make_rig(T_world_camera))
    problem = _Problem(frames, camera, prior, depth_range_m, T_world_camera[:, :3, 3].mean(axis=0), state)
    sparse, dense = (sample_pixels(frames, camera, depth_range_m, count) for count in (SPARSE, DENSE))
    if not len(sparse.frames):
        raise JaxmapError(
            f"no point lies between {depth_range_m[0]:g} and {depth_range_m[1]:g} m", fix="set --max-depth-m"
        )
    state.before = _consistency(frames, state.rig, camera, dense)
    matches = _align_frames(problem, advance, on_round)
    _tie_to_ground(problem, matches, ground, sparse, dense, on_round)
    state.after = _consistency(frames, state.rig, camera, dense)
    on_round(state)
    return state


class _Problem(NamedTuple):
    """What stays the same in all rounds, and the state."""

    frames: Sequence[DisparityFrame]
    camera: Pinhole
    prior: Prior
    depth_range_m: tuple[float, float]
    origin_m: np.ndarray
    state: Refinement

    def match_term(self, matches: MatchTable) -> ResidualTerm:
        return ResidualTerm(
            lambda rig: linearise(make_device_rig(rig, self.camera, self.origin_m), matches.frames, matches.uvd_px),
            matches.frames,
            np.array([MATCH_SIGMA_PX, MATCH_SIGMA_PX, DISPARITY_SIGMA_PX]),
            DISPARITY_SIGMA_PX,
            matches.pairs,
            PAIR_WEIGHT,
        )

    def height_term(self, samples: PixelSamples, heights: GroundRaster, blur_m: float = 0.0) -> ResidualTerm:
        return height_term(samples, self.camera, heights, self.origin_m, DISPARITY_SIGMA_PX, blur_m)

    def solve(self, name: str, terms: list[ResidualTerm], steps: int = MAX_STEPS) -> None:
        state = self.state
        solution = solve(state.rig, state.given, terms, self.prior, steps)
        state.rounds.append((len(state.residuals_px), name))
        state.residuals_px += solution.residuals_px
        state.solution = solution


def _align_frames(problem: _Problem, advance: Advance, on_round: OnRound) -> MatchTable:
    """Makes the frames agree with each other: neighbours first, then all that overlap."""
    frames, camera, prior, depth_range_m, _, state = problem
    uncertainty = PoseUncertainty(
        FIRST_POSITION_M if prior.position_m is None else max(prior.position_m, 0.05),
        FIRST_ANGLE_RAD if prior.angle_rad is None else max(prior.angle_rad, np.radians(0.2)),
    )
    poses = state.given.T_world_camera
    found = match_neighbours(
        frames, poses, camera, uncertainty, depth_range_m, lambda done: advance(done, "neighbours")
    )
    if not found:
        raise JaxmapError(
            "no two frames that follow each other show the same ground",
            fix="check the poses, or say how wrong they may be: --sigma-position-m, --sigma-angle-deg",
        )
    matches = match_table(found)
    problem.solve("neighbours", [problem.match_term(matches)])
    on_round(state)
    for number, radius_px in enumerate(RADII_PX, start=1):

        def advance_round(done: int, before: int = number * len(frames)) -> None:
            advance(before + done, "all pairs")

        poses = state.rig.T_world_camera
        found = match_overlapping(frames, poses, camera, depth_range_m, radius_px, advance_round)
        matches = match_table(found) if found else matches
        problem.solve("all pairs", [problem.match_term(matches)])
        on_round(state)
    state.pairs, state.matches = len(found), len(matches.pairs)
    state.unmatched = sorted(set(range(len(frames))) - set(matches.frames.ravel().tolist()))
    return matches


def _tie_to_ground(
    problem: _Problem,
    matches: MatchTable,
    ground: GroundReference,
    sparse: PixelSamples,
    dense: PixelSamples,
    on_round: OnRound,
) -> None:
    """Solves again with what ties the map as a whole to the ground."""
    state, terms = problem.state, [problem.match_term(matches)]
    if ground.below_camera_m is not None:
        contact = ground_contact(state.given.T_world_camera[:, :3, 3], ground.below_camera_m)
        terms.append(problem.height_term(dense, contact))
        problem.solve("ground under the rover", terms)
    if ground.heights is not None:
        for blur_m in BLURS_M:
            on_model = problem.height_term(sparse, ground.heights, blur_m)
            steps = FEW_STEPS if blur_m else MAX_STEPS
            problem.solve(f"elevation model, smoothed over {blur_m:g} m", [*terms, on_model], steps)
        terms.append(problem.height_term(sparse, ground.heights))
        on_round(state)
    if ground.is_rock is not None:
        relief = rock_relief(points_world(state.rig, problem.camera, dense))
        placed = register_labels(relief, ground.is_rock, (float(problem.origin_m[0]), float(problem.origin_m[1])))
        if placed is None:
            state.notes.append("too little labelled rock is in view to locate the map by it")
            return
        alignment, sigma = placed
        off_m, turned_deg = np.hypot(*alignment.shift_m), np.degrees(abs(alignment.heading_rad))
        state.notes.append(
            f"by its rocks the map is {off_m:.2f} m and {turned_deg:.1f} deg away from the labels, "
            f"+- {sigma[0]:.2f} m and {np.degrees(sigma[2]):.1f} deg (1 sigma)"
        )
        problem.solve("labelled rocks", [*terms, placement_term(state.rig, alignment, sigma)])


def _consistency(frames: Sequence[DisparityFrame], rig: Rig, camera: Pinhole, points: PixelSamples) -> Consistency:
    pixels = points.uvd_px[:, :2]
    brightness = np.concatenate(
        [sample_bilinear(frame.image, pixels[points.frames == index]) for index, frame in enumerate(frames)]
    )
    return consistency_of(points_world(rig, camera, points), brightness, points.frames)


OBSERVABLE = 0.5
"""A parameter is observable where the data leave less than this share of the prior's standard deviation."""

_MOUNTING = ("forward_m", "left_m", "up_m", "roll_deg", "pitch_deg", "heading_deg")
_MAP = ("east_m", "north_m", "up_m", "tilt_about_east_deg", "tilt_about_north_deg", "heading_deg")


def results(state: Refinement, T_world_given: Float64[np.ndarray, "N 4 4"], prior: Prior) -> dict[str, Any]:
    """The content of refine.json: what was found, and how certain it is.

    Args:
        state: the refinement.
        T_world_given: the given poses.
        prior: how wrong they might be.
    """
    before, after, solution = state.before, state.after, state.solution
    assert before is not None and solution is not None
    T = state.rig.T_world_camera
    moved_m = np.linalg.norm(T[:, :3, 3] - T_world_given[:, :3, 3], axis=1)
    turned = Rotation.from_matrix(T_world_given[:, :3, :3].transpose(0, 2, 1) @ T[:, :3, :3]).magnitude()
    sigma = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0))
    own = sigma[: PER_FRAME * len(T)].reshape(-1, PER_FRAME)
    content: dict[str, Any] = {
        "matches": {"pairs": state.pairs, "count": state.matches, "frames_without": state.unmatched},
        "match_residual_px": {"before": state.residuals_px[0], "after": state.residuals_px[-1]},
        "map_height_spread_m": {"before": before.height_m, "after": None if after is None else after.height_m},
        "map_brightness_spread": {"before": before.brightness, "after": None if after is None else after.brightness},
        "poses": {
            "moved_m": moved_m.round(5).tolist(),
            "turned_deg": np.degrees(turned).round(5).tolist(),
            "sigma_m": np.sqrt((own[:, :3] ** 2).sum(axis=1)).round(5).tolist(),
            "sigma_deg": np.degrees(np.sqrt((own[:, 3:] ** 2).sum(axis=1))).round(5).tolist(),
            "prior_sigma_m": float(solution.prior_sigma[0]),
            "prior_sigma_deg": float(np.degrees(solution.prior_sigma[3])),
            "prior_estimated": {"position": prior.position_m is None, "angle": prior.angle_rad is None},
        },
        "parameters": _shared_parameters(state),
        "whole_map": _mean_motion(state),
        "rounds": [{"step": step, "name": name} for step, name in state.rounds],
        "residuals_px": [round(value, 5) for value in state.residuals_px],
    }
    return _finite(content)


def _entry(name: str, value: float | None, sigma: float, prior_sigma: float) -> dict[str, Any]:
    unit = 180 / np.pi if name.endswith("_deg") else 1.0
    return {
        "name": name,
        "value": None if value is None else float(value * unit),
        "sigma": float(sigma * unit),
        "prior_sigma": float(prior_sigma * unit),
        "observable": bool(prior_sigma > 0 and sigma < OBSERVABLE * prior_sigma),
    }


def _shared_parameters(state: Refinement) -> list[dict[str, Any]]:
    """The mounting in axes of the vehicle, the baseline's scale and the disparity offset, those that were free."""
    assert state.solution is not None
    turn = np.kron(np.eye(2), vehicle_axes(state.given.T_world_camera))
    to_vehicle = np.eye(SHARED)
    to_vehicle[:6, :6] = turn
    value = to_vehicle @ displacement(state.rig, state.given)[-SHARED:]
    covariance = to_vehicle @ state.solution.covariance[-SHARED:, -SHARED:] @ to_vehicle.T
    prior = to_vehicle @ np.diag(state.solution.prior_sigma[-SHARED:] ** 2) @ to_vehicle.T
    names = [*(f"mounting_{name}" for name in _MOUNTING), "baseline_scale", "disparity_offset_px"]
    value[6] = np.exp(value[6])
    return [
        _entry(name, value[index], np.sqrt(max(covariance[index, index], 0.0)), np.sqrt(prior[index, index]))
        for index, name in enumerate(names)
        if prior[index, index] > 0
    ]


def _mean_motion(state: Refinement) -> list[dict[str, Any]]:
    """Position and attitude of the map as a whole, and how certain they are: the mean over the frames."""
    assert state.solution is not None
    rig, frames = state.rig, len(state.rig.T_world_nominal)
    R_nominal, R = rig.T_world_nominal[:, :3, :3], rig.T_world_camera[:, :3, :3]
    to_mean = np.zeros((6, PER_FRAME * frames + SHARED))
    for frame in range(frames):
        first = PER_FRAME * frame
        to_mean[:3, first : first + 3] = np.eye(3) / frames
        to_mean[3:, first + 3 : first + 6] = R_nominal[frame] / frames
    to_mean[:3, -8:-5], to_mean[3:, -5:-2] = R_nominal.mean(axis=0), R.mean(axis=0)
    mean = to_mean @ displacement(rig, state.given)
    sigma = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", to_mean, state.solution.covariance, to_mean), 0.0))
    prior = np.sqrt((to_mean**2) @ state.solution.prior_sigma**2)
    return [_entry(name, mean[index], sigma[index], prior[index]) for index, name in enumerate(_MAP)]


def _finite(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
