"""What a refinement found, as plain values: numbers, how well each is known, and who told it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.refinement.rig import PER_FRAME, displacement, vehicle_axes
from jaxmap.refinement.rounds import Refinement
from jaxmap.refinement.solve import Prior

OBSERVABLE = 0.5
"""A number is observable where the data leave less than this share of the prior's standard deviation."""

_MOUNTING = ("forward_m", "left_m", "up_m", "roll_deg", "pitch_deg", "heading_deg")
_WHOLE = ("east_m", "north_m", "up_m", "tilt_about_east_deg", "tilt_about_north_deg", "heading_deg")


def results(state: Refinement, T_world_given: Float64[np.ndarray, "N 4 4"], prior: Prior) -> dict[str, Any]:
    """The content of refine.json.

    Args:
        state: the refinement.
        T_world_given: the poses it began with.
        prior: what was allowed to change.
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
        "parameters": _shared(state),
        "whole_map": _whole(state),
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


def _shared(state: Refinement) -> list[dict[str, Any]]:
    """The mounting in axes of the vehicle, the baseline's scale and the disparity offset, those that were free."""
    assert state.solution is not None
    turn = np.kron(np.eye(2), vehicle_axes(state.given.T_world_camera).R_vehicle_camera)
    to_vehicle = np.eye(8)
    to_vehicle[:6, :6] = turn
    value = to_vehicle @ displacement(state.rig, state.given)[-8:]
    covariance = to_vehicle @ state.solution.covariance[-8:, -8:] @ to_vehicle.T
    prior = to_vehicle @ np.diag(state.solution.prior_sigma[-8:] ** 2) @ to_vehicle.T
    names = [*(f"mounting_{name}" for name in _MOUNTING), "baseline_scale", "disparity_offset_px"]
    value[6] = np.exp(value[6])
    return [
        _entry(name, value[index], np.sqrt(max(covariance[index, index], 0.0)), np.sqrt(prior[index, index]))
        for index, name in enumerate(names)
        if prior[index, index] > 0
    ]


def _whole(state: Refinement) -> list[dict[str, Any]]:
    """How well the place and attitude of the map as a whole are known: the mean over the frames."""
    assert state.solution is not None
    rig, frames = state.rig, len(state.rig.T_world_nominal)
    R_nominal, R = rig.T_world_nominal[:, :3, :3], rig.T_world_camera[:, :3, :3]
    to_mean = np.zeros((6, PER_FRAME * frames + 8))
    for frame in range(frames):
        first = PER_FRAME * frame
        to_mean[:3, first : first + 3] = np.eye(3) / frames
        to_mean[3:, first + 3 : first + 6] = R_nominal[frame] / frames
    to_mean[:3, -8:-5], to_mean[3:, -5:-2] = R_nominal.mean(axis=0), R.mean(axis=0)
    mean = to_mean @ displacement(rig, state.given)
    sigma = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", to_mean, state.solution.covariance, to_mean), 0.0))
    prior = np.sqrt((to_mean**2) @ state.solution.prior_sigma**2)
    return [_entry(name, mean[index], sigma[index], prior[index]) for index, name in enumerate(_WHOLE)]


def _finite(value: Any) -> Any:
    """JSON knows no NaN."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
