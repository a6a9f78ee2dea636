"""MLESAC, growing with its hypotheses, and how near its plane comes to the true one."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from benchmarks import ours, peers
from benchmarks.groups import Group
from benchmarks.harness import Amount, Case, Peer, Run
from benchmarks.scene import make_scene

HYPOTHESES = {"small": 128, "medium": 512, "large": 2048}
OUTLIER_SHARE, NOISE_M, TILT_RAD = 0.4, 0.02, 0.1
SIDE_M, OUTLIER_HEIGHT_M = 10.0, 4.0
"""Points spread over a square of this side; outliers through as much height."""


def tilted_cloud(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a tilted plane among outliers, shuffled; and the plane, `normal . p + offset = 0`."""
    random = np.random.default_rng(6)
    normal = np.array([np.sin(TILT_RAD), 0.0, np.cos(TILT_RAD)])
    centre = np.array([SIDE_M / 2, SIDE_M / 2, 0.0])
    ground = random.uniform(0.0, SIDE_M, (count, 2))
    height_m = -(ground - centre[:2]) @ normal[:2] / normal[2] + NOISE_M * random.standard_normal(count) / normal[2]
    points = np.column_stack([ground, height_m])
    outliers = random.permutation(count)[: round(OUTLIER_SHARE * count)]
    points[outliers, 2] = random.uniform(-OUTLIER_HEIGHT_M / 2, OUTLIER_HEIGHT_M / 2, len(outliers))
    return points, np.append(normal, -normal @ centre)


def plane_errors(plane: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """The angle between the normals in degrees, and the distance in millimetres above the middle of the cloud."""
    plane = plane / np.linalg.norm(plane[:3]) * (1 if plane[:3] @ truth[:3] > 0 else -1)
    # By the cross product: the cosine of a small angle has no digits left.
    angle_deg = np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(plane[:3], truth[:3])))))
    middle = np.array([SIDE_M / 2, SIDE_M / 2, 0.0])
    return float(angle_deg), float(1e3 * abs(plane[:3] @ middle + plane[3]) / abs(plane[2]))


def mlesac(size: str) -> Case:
    """A plane in a cloud of as many points as an image has pixels, 40 % of them outliers."""
    points, truth = tilted_cloud(make_scene().pixels)
    hypotheses = HYPOTHESES[size]
    fit, cost = ours.fit_plane(points, hypotheses)
    fits = {"jaxmap": peers.PlaneFit(fit)}

    def peer(name: str, make: Callable[[], peers.PlaneFit], limit: float | None = None, module: str = "open3d") -> Peer:
        def kept() -> Run:
            fits[name] = make()
            return fits[name]

        return Peer(name, kept, limit, size == "medium", modules=(module,))

    def facts() -> Mapping[str, float]:
        errors = {
            name: np.median([plane_errors(plane, truth) for plane in one.planes], 0) for name, one in fits.items()
        }
        names = ("angle to the true plane, degrees", "height off the true plane, mm")
        return {f"{what}: {who}": two[index] for index, what in enumerate(names) for who, two in errors.items()}

    beside = [peer("Open3D segment_plane, stopping early", lambda: peers.open3d_plane(points, hypotheses, 0.99999999))]
    # Every iteration takes Open3D as long: 2048 of them would only cost time.
    if size != "large":
        name = f"Open3D segment_plane, {hypotheses} iterations"
        beside.insert(0, peer(name, lambda: peers.open3d_plane(points, hypotheses, 1.0), 1 / 20))
    if size == "small":
        name = f"scikit-image ransac, {hypotheses} trials"
        beside.append(peer(name, lambda: peers.skimage_plane(points, hypotheses), module="skimage"))
    amount = Amount(hypotheses, "hypotheses")
    return Case(fits["jaxmap"], amount, amount, beside, cost.compile_s, cost.temporary_bytes, facts)


GROUPS = (Group("mlesac", "the plane in 786,432 points, of which 40 % are outliers", mlesac),)
