"""Scores of a map of the Motorcycle pair against the map made of its true disparity."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxmap.datasets.base import StereoSequence
from jaxmap.datasets.samples import motorcycle_disparity
from jaxmap.evaluation.geometry_scores import score_disparity, score_surface
from jaxmap.fusion.params import FusionRule, make_fusion_params
from jaxmap.fusion.query import occupied
from jaxmap.labellers import make_no_labeller
from jaxmap.mapper import MapperParams, make_mapper
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.types import Frame, VoxelMap


def score_motorcycle(
    sequence: StereoSequence, front_end: StereoFrontEnd, voxel_map: VoxelMap, depth_range_m: tuple[float, float]
) -> dict[str, float]:
    """Disparity and surface of a map of the pair, against truth.

    The true surface is what the true disparity gives in the same grid, with the simplest rule, over
    the pixels of the depth range.
    """
    frame = sequence.read_pair(sequence.frames[0])
    truth_px = motorcycle_disparity()
    scores = score_disparity(front_end(frame.left, frame.right).disparity_px, truth_px)

    labeller = make_no_labeller()
    rule = FusionRule("once", carve=False, range_weighting=False)
    mapper = make_mapper(front_end.camera, voxel_map.grid, labeller, rule, depth_range_m)
    pose = jaxlie.SE3.from_matrix(jnp.asarray(sequence.T_world_camera[0], jnp.float32))
    params = MapperParams(front_end.camera, make_fusion_params(()))
    true_map, _ = mapper.step(mapper.init(), Frame(jnp.asarray(truth_px), pose), params, jax.random.key(0))
    any_params = make_fusion_params(voxel_map.classes)
    surface = score_surface(np.asarray(occupied(voxel_map, any_params)), np.asarray(occupied(true_map, params.fusion)))
    return {
        "median_error_px": round(scores.median_error_px, 4),
        "bad_2": round(scores.bad_2, 4),
        "valid": round(scores.valid, 4),
        "surface_precision": round(surface.precision, 4),
        "surface_recall": round(surface.recall, 4),
    }
