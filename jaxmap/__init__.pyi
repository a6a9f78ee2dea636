from .datasets import ReadOptions, StereoSequence, open_sequence
from .datasets.images import read_image
from .ensemble.draws import draw_ensemble
from .ensemble.layer import EnsembleLayers, ensemble_layers
from .ensemble.options import EnsembleOptions
from .errors import FrameError, JaxmapError, UsageError
from .fusion.carve import carve
from .fusion.integrate import integrate
from .fusion.options import FusionOptions, FusionRule
from .fusion.params import FusionParams, make_fusion_params
from .fusion.query import TopDown, class_probabilities, occupancy_probability, top_down, voxel_labels
from .geometry.camera import depth_sigma, disparity_to_points, points_to_pixels, transform_points
from .geometry.cloud import PointCloud, project
from .geometry.grid import voxel_centres, world_to_voxel
from .geometry.options import GroundOptions
from .geometry.plane import fit_plane_mlesac, plane_distance
from .geometry.relief import Relief, relief_channels, relief_of
from .labellers.base import Labeller, LabellerParams, make_no_labeller
from .labellers.deeplab import make_deeplab_labeller, make_logits_labeller
from .labellers.files import make_files_labeller
from .labellers.options import DeeplabOptions, PlaneOptions, ReliefOptions
from .labellers.plane import make_plane_labeller
from .labellers.relief import combine_with_relief, make_relief_labeller
from .labels import IGNORE, ROVER_CLASSES
from .mapping.observations import Observations, open_observations
from .mapping.sequence import prepare_frames, run_sequence
from .mapping.step import Mapper, MapperParams, make_mapper
from .mapping.store import MapAttributes, load_map, save_map
from .models.architecture import Architecture, tf_architecture, torch_architecture, torchvision_architecture
from .models.checkpoint import SavedModel, load_model, load_network, save_model
from .models.importers import import_weights
from .models.network import PureNetwork, fold_batch_norm, make_network, pure_form, pure_network
from .runs.segmentation import Segmenter
from .stereo.front_end import StereoFrontEnd
from .stereo.jax_matcher import JaxMatcher
from .stereo.match import StereoOptions
from .stereo.rectify import make_raw_pair, make_stereo_rig
from .tuning.pull_back import make_pull_back, map_gradient
from .types import (
    Frame,
    GridSpec,
    Plane,
    PointLabels,
    StereoCamera,
    VoxelMap,
    make_grid,
    make_stereo_camera,
    make_voxel_map,
)

__version__: str

__all__ = [
    "IGNORE",
    "ROVER_CLASSES",
    "Architecture",
    "DeeplabOptions",
    "EnsembleLayers",
    "EnsembleOptions",
    "Frame",
    "FrameError",
    "FusionOptions",
    "FusionParams",
    "FusionRule",
    "GridSpec",
    "GroundOptions",
    "JaxMatcher",
    "JaxmapError",
    "Labeller",
    "LabellerParams",
    "MapAttributes",
    "Mapper",
    "MapperParams",
    "Observations",
    "Plane",
    "PlaneOptions",
    "PointCloud",
    "PointLabels",
    "PureNetwork",
    "ReadOptions",
    "Relief",
    "ReliefOptions",
    "SavedModel",
    "Segmenter",
    "StereoCamera",
    "StereoFrontEnd",
    "StereoOptions",
    "StereoSequence",
    "TopDown",
    "UsageError",
    "VoxelMap",
    "carve",
    "class_probabilities",
    "combine_with_relief",
    "depth_sigma",
    "disparity_to_points",
    "draw_ensemble",
    "ensemble_layers",
    "fit_plane_mlesac",
    "fold_batch_norm",
    "import_weights",
    "integrate",
    "load_map",
    "load_model",
    "load_network",
    "make_deeplab_labeller",
    "make_files_labeller",
    "make_fusion_params",
    "make_grid",
    "make_logits_labeller",
    "make_mapper",
    "make_network",
    "make_no_labeller",
    "make_plane_labeller",
    "make_pull_back",
    "make_raw_pair",
    "make_relief_labeller",
    "make_stereo_camera",
    "make_stereo_rig",
    "make_voxel_map",
    "map_gradient",
    "occupancy_probability",
    "open_observations",
    "open_sequence",
    "plane_distance",
    "points_to_pixels",
    "prepare_frames",
    "project",
    "pure_form",
    "pure_network",
    "read_image",
    "relief_channels",
    "relief_of",
    "run_sequence",
    "save_map",
    "save_model",
    "tf_architecture",
    "top_down",
    "torch_architecture",
    "torchvision_architecture",
    "transform_points",
    "voxel_centres",
    "voxel_labels",
    "world_to_voxel",
]
