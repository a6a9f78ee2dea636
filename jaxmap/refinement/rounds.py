"""The refinement of a sequence: matches and solutions in turn, from coarse to fine, then the ties to the ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.errors import JaxmapError
from jaxmap.refinement.anchors import Points, Raster, draw_points, ground_contact, height_term, points_world
from jaxmap.refinement.consistency import Consistency, consistency_of
from jaxmap.refinement.pairs import MatchTable, Reach, match_chain, match_overlapping, table
from jaxmap.refinement.relief import place, place_term, relief_of
from jaxmap.refinement.rig import Rig, make_rig
from jaxmap.refinement.solve import FIRST_ANGLE_RAD, FIRST_POSITION_M, MAX_STEPS, Prior, Solution, Term, solve
from jaxmap.refinement.terms import linearise, make_setting
from jaxmap.refinement.views import Pinhole, View, bilinear

MATCH_SIGMA_PX, DISPARITY_SIGMA_PX = 0.25, 0.25
PAIR_WORTH = 30.0
"""Errors of matching are alike within a pair of frames: its matches count as so many independent ones, at most."""

RADII_PX = (12, 6)
"""Of the windows in which overlapping frames are compared, round by round."""

BLURS_M = (0.3, 0.1, 0.0)
"""An elevation model is smoothed, so that its rocks are found from as far away as the poses may be off."""

POINTS_PER_FRAME, DENSE_PER_FRAME = 600, 20_000

FEW_STEPS = 4
"""Enough for a solution that is only the way to the next one."""


class Ground(NamedTuple):
    """What is known of the ground; each may be None.

    Attributes:
        heights: elevations of the world.
        is_rock: 1 rock, 0 no rock, NaN unlabelled.
        below_camera_m: how far below the cameras, as given, the ground lies that the rover drives over.
    """

    heights: Raster | None = None
    is_rock: Raster | None = None
    below_camera_m: float | None = None


@dataclass
class Refinement:
    """A refinement as far as it has come.

    Attributes:
        given: the rig before.
        solution: the best so far.
        before, after: how sharp the map was, and is.
        residuals_px: the median distance of matches from where they should be, step by step.
        rounds: at which step each round began.
        pairs: pairs of frames with matches.
        matches: all matches.
        unmatched: frames that share no match with any other; they keep their prior.
        notes: what is worth telling.
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


Report = Callable[[Refinement], None]
Advance = Callable[[int, str], None]


def refine(
    views: Sequence[View],
    T_world_camera: Float64[np.ndarray, "N 4 4"],
    camera: Pinhole,
    prior: Prior,
    ground: Ground,
    depth_range_m: tuple[float, float],
    *,
    advance: Advance = lambda done, note: None,
    on_round: Report = lambda refinement: None,
) -> Refinement:
    """Refines the poses of views, their mounting and the stereo calibration.

    Args:
        views: the frames.
        T_world_camera: their given poses, rectified, in a z-up world.
        camera: of all frames.
        prior: how wrong all that may be.
        ground: what ties the map to its place.
        depth_range_m: depths that count.
        advance: told how many of three times the frames are done, and how it goes.
        on_round: given the state after each round.

    Raises:
        JaxmapError: fewer than two frames, none of which overlap, or residuals that are not finite.
    """
    if len(views) < 2:
        raise JaxmapError(f"{len(views)} frame with disparities", fix="refining needs two frames that overlap, or more")
    state = Refinement(make_rig(T_world_camera))
    origin_m = T_world_camera[:, :3, 3].mean(axis=0)
    points = draw_points(views, camera, depth_range_m, POINTS_PER_FRAME)
    if not len(points.frames):
        raise JaxmapError(
            f"no point lies between {depth_range_m[0]:g} and {depth_range_m[1]:g} m", fix="set --max-depth-m"
        )
    shown = draw_points(views, camera, depth_range_m, DENSE_PER_FRAME)
    state.before = _sharpness(views, state.given, camera, shown)
    reach = Reach(
        FIRST_POSITION_M if prior.position_m is None else max(prior.position_m, 0.05),
        FIRST_ANGLE_RAD if prior.angle_rad is None else max(prior.angle_rad, np.radians(0.2)),
        depth_range_m,
    )
    found = match_chain(views, T_world_camera, camera, reach, lambda done: advance(done, "neighbours"))
    if not found:
        raise JaxmapError(
            "no two frames that follow each other show the same ground",
            fix="check the poses, or say how wrong they may be: --sigma-position-m, --sigma-angle-deg",
        )
    matches = table(found)
    _solve(state, "neighbours", [_match_term(matches, camera, origin_m)], prior)
    on_round(state)
    for number, radius in enumerate(RADII_PX, start=1):
        poses = state.rig.T_world_camera
        told = number * len(views)
        found = match_overlapping(
            views, poses, camera, depth_range_m, radius, lambda done, told=told: advance(told + done, "all pairs")
        )
        matches = table(found) if found else matches
        _solve(state, "all pairs", [_match_term(matches, camera, origin_m)], prior)
        on_round(state)
    state.pairs, state.matches = len(found), len(matches.pairs)
    state.unmatched = sorted(set(range(len(views))) - set(matches.frames.ravel().tolist()))
    _tie(state, [_match_term(matches, camera, origin_m)], prior, ground, camera, points, shown, origin_m, on_round)
    state.after = _sharpness(views, state.rig, camera, shown)
    on_round(state)
    return state


def _match_term(matches: MatchTable, camera: Pinhole, origin_m: np.ndarray) -> Term:
    return Term(
        lambda rig: linearise(make_setting(rig, camera, origin_m), matches.frames, matches.seen_px),
        matches.frames,
        np.array([MATCH_SIGMA_PX, MATCH_SIGMA_PX, DISPARITY_SIGMA_PX]),
        DISPARITY_SIGMA_PX,
        matches.pairs,
        PAIR_WORTH,
    )


def _solve(state: Refinement, name: str, terms: list[Term], prior: Prior, steps: int = MAX_STEPS) -> None:
    solution = solve(state.rig, state.given, terms, prior, steps)
    state.rounds.append((len(state.residuals_px), name))
    state.residuals_px += solution.residuals_px
    state.solution = solution


def _tie(
    state: Refinement,
    terms: list[Term],
    prior: Prior,
    ground: Ground,
    camera: Pinhole,
    points: Points,
    shown: Points,
    origin_m: np.ndarray,
    on_round: Report,
) -> None:
    """Solves again with what ties the map to the ground."""
    if ground.below_camera_m is not None:
        track = state.given.T_world_camera[:, :3, 3]
        contact = ground_contact(track, ground.below_camera_m)
        terms = [*terms, height_term(shown, camera, contact, origin_m, DISPARITY_SIGMA_PX)]
        _solve(state, "ground under the rover", terms, prior)
    if ground.heights is not None:
        untied = terms
        for blur_m in BLURS_M:
            tied = height_term(points, camera, ground.heights, origin_m, DISPARITY_SIGMA_PX, blur_m)
            terms = [*untied, tied]
            _solve(
                state, f"elevation model, smoothed over {blur_m:g} m", terms, prior, FEW_STEPS if blur_m else MAX_STEPS
            )
        on_round(state)
    if ground.is_rock is not None:
        relief = relief_of(points_world(state.rig, camera, shown))
        placed = place(relief, ground.is_rock, (float(origin_m[0]), float(origin_m[1])))
        if placed is None:
            state.notes.append("too little of the labelled rock is in view to place the map by it")
            return
        alignment, sigma = placed
        off_m, turned_deg = np.hypot(*alignment.shift_m), np.degrees(abs(alignment.heading_rad))
        state.notes.append(
            f"by its rocks the map lies {off_m:.2f} m and {turned_deg:.1f} deg beside the labels, "
            f"known to {sigma[0]:.2f} m and {np.degrees(sigma[2]):.1f} deg"
        )
        _solve(state, "labelled rocks", [*terms, place_term(state.rig, alignment, sigma)], prior)


def _sharpness(views: Sequence[View], rig: Rig, camera: Pinhole, points: Points) -> Consistency:
    pixels = points.seen_px[:, :2]
    brightness = np.concatenate(
        [bilinear(view.image, pixels[points.frames == index]) for index, view in enumerate(views)]
    )
    return consistency_of(points_world(rig, camera, points), brightness, points.frames)
