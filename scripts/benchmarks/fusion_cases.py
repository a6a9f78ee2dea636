"""Carving, integration and both together, growing with voxels and with points."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import reference

from benchmarks import ours, peers
from benchmarks.groups import Group
from benchmarks.harness import Amount, Case, Peer, Run
from benchmarks.scene import DEPTH_RANGE_M, VOXEL_M, Scene, grid_of, make_scene
from benchmarks.stereo_cases import plain_camera
from jaxmap.fusion.params import make_fusion_params
from jaxmap.labels import ROVER_CLASSES
from jaxmap.types import GridSpec

COPY_LIMIT = 2.0
RAY_LIMIT, DISCRETE_LIMIT = 1 / 50, 1 / 15


def carve(size: str) -> Case:
    """Free space in the window of one frame, by the size of the voxels."""
    scene = make_scene()
    window = ours.window_of(scene, size)
    prepared = ours.carve_frame(scene, window)
    voxels = Amount(int(np.prod(window.shape)), "voxels")
    beside = [Peer("NumPy twin", lambda: _carve_twin(scene, window))] if size == "small" else []
    return Case(prepared.run, voxels, voxels, beside, prepared.compile_s, prepared.temporary_bytes)


def integrate(size: str) -> Case:
    """The points of one frame into its window at 0.2 m, by the number of points."""
    scene = make_scene(size)
    grid = ours.window_of(scene, "medium")
    prepared = ours.integrate_frame(scene, grid)
    points = Amount(scene.pixels, "points")
    beside = [
        Peer(
            "Open3D voxel grid, occupancy only",
            lambda: peers.open3d_voxels(_kept(scene), VOXEL_M["medium"][0]),
            1.0,
            size == "medium",
            modules=("open3d",),
        )
    ]
    if size == "small":
        beside.append(Peer("NumPy twin", lambda: _integrate_twin(scene, grid)))
    return Case(prepared.run, points, points, beside, prepared.compile_s, prepared.temporary_bytes)


def fuse(size: str) -> Case:
    """Carving and integration of one frame into 40 x 40 x 4 m, by the size of the voxels."""
    scene = make_scene()
    prepared = ours.fuse_frame(scene, size)
    points = _kept(scene)
    # OctoMap knows cubes only: of the same volume.
    edge_m = float(np.prod(VOXEL_M[size])) ** (1 / 3)
    # Targets are set for the paper's voxels, and told for the others.
    gated = size == "medium"

    def octomap(name: str, limit: float, discretize: bool) -> Peer:
        def make() -> Run:
            origin_world = scene.T_world_camera[:3, 3]
            return peers.octomap_insertion(
                points, origin_world, edge_m, discretize=discretize, max_range_m=DEPTH_RANGE_M[1]
            )

        return Peer(name, make, limit, gated, modules=("octomap",))

    beside = [
        octomap("OctoMap, ray casting", RAY_LIMIT, discretize=False),
        octomap("OctoMap, discretised", DISCRETE_LIMIT, discretize=True),
        Peer(
            "OctoMap's Python binding alone",
            lambda: peers.octomap_binding(len(points), edge_m),
            modules=("octomap",),
        ),
        Peer("touched memory once", lambda: _touched_once(scene, prepared), COPY_LIMIT, gated),
    ]
    voxels = Amount(int(np.prod(grid_of(size).shape)), "voxels")
    return Case(
        prepared.run, voxels, Amount(scene.pixels, "points"), beside, prepared.compile_s, prepared.temporary_bytes
    )


def _kept(scene: Scene) -> np.ndarray:
    """The points of a frame that are fused, (N, 3)."""
    points = ours.points_of(scene)
    return np.asarray(points.points_world)[np.asarray(points.labels.keep)]


def _touched_once(scene: Scene, fused: ours.Prepared) -> Run:
    """Reads a frame's points, labels, flags and depth, reads and writes the voxels that it touches: all channels."""
    if not np.any(fused.result):
        fused.run()
    log_odds = np.asarray(fused.result)
    touched = int((log_odds != 0).any(axis=0).sum())
    points = ours.points_of(scene)
    labels = points.labels
    read = [points.points_world, labels.labels, labels.keep, points.depth_m, points.valid]
    return peers.memory_pass([np.array(array) for array in read], touched * len(log_odds))


def _plain(values: Any) -> SimpleNamespace:
    """A record with NumPy's arrays in place of JAX's, which the twins read many times faster."""
    return SimpleNamespace(**{name: np.asarray(value) for name, value in vars(values).items() if value is not None})


def _carve_twin(scene: Scene, window: GridSpec) -> Run:
    points, params = ours.points_of(scene), _plain(make_fusion_params(ROVER_CLASSES))
    depth_m, valid = np.asarray(points.depth_m), np.asarray(points.valid)
    camera, pose = plain_camera(scene), SimpleNamespace(wxyz_xyz=np.asarray(scene.pose.wxyz_xyz))
    plain = SimpleNamespace(**{**vars(_plain(window)), "shape": window.shape})
    return lambda: reference.carve(camera, pose, depth_m, valid, plain, params, DEPTH_RANGE_M)


def _integrate_twin(scene: Scene, grid: GridSpec) -> Run:
    points, params = ours.points_of(scene), _plain(make_fusion_params(ROVER_CLASSES))
    labels = SimpleNamespace(
        keep=np.asarray(points.labels.keep), labels=np.asarray(points.labels.labels), probabilities=None
    )
    points_world, weights = np.asarray(points.points_world), np.ones(scene.pixels)
    plain = SimpleNamespace(**{**vars(_plain(grid)), "shape": grid.shape})
    log_odds = np.zeros((1 + len(ROVER_CLASSES), *grid.shape))
    return lambda: reference.integrate(log_odds, plain, points_world, labels, weights, params, ours.RULE)


GROUPS = (
    Group("carve", "free space in the window of one frame, by voxels", carve),
    Group("integrate", "the points of one frame into voxels of 0.2 m, by points", integrate),
    Group("fuse", "carving and integration of 786,432 points into 40 x 40 x 4 m, by voxels", fuse),
)
