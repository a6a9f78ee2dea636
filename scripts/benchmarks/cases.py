"""The cases that `bench.py` times: what of jaxmap, at which sizes, beside which programs, with which targets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import networks
import numpy as np
import ours
import peers
from harness import Amount, Case, Group, Peer, Run, usable_cores
from scene import DEPTH_RANGE_M, DISPARITIES, VOXEL_M, Scene, grid_of, make_scene, moved_poses, write_sequence

from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.fusion.frame import add_plainly
from jaxmap.host.files import config_folder
from jaxmap.stereo.match import Matcher, StereoOptions
from jaxmap.stereo.rectify import StereoRig, make_rectifier, make_stereo_rig, rectify_image

HYPOTHESES = {"small": 128, "medium": 512, "large": 2048}
SEEN_PX = {"small": (192, 256), "medium": ours.NETWORK_PX, "large": (768, 1024)}
"""Height and width of the image that the network sees."""
LOGITS_PX = {"small": (192, 256), "medium": (384, 512), "large": (512, 512)}
BATCH = {"small": 2, "medium": 4, "large": 8}
FUSED_BEFORE = {"small": 50, "medium": 500, "large": 2000}
FRAMES = {"small": 8, "medium": 24, "large": 72}
RATE_SHARE = 0.45
"""Target of a whole sequence, of the rate of SGBM alone on the same cores."""

SIDE_M, OUTLIER_SHARE, NOISE_M, TILT_RAD = 10.0, 0.4, 0.02, 0.1
"""Of the cloud that planes are fitted to."""


def case_of(prepared: ours.Prepared | ours.Step, grown: Amount, work: Amount, beside: list[Peer]) -> Case:
    """The case of something compiled."""
    run = prepared if isinstance(prepared, ours.Step) else prepared.run
    return Case(run, grown, work, beside, prepared.compile_s, prepared.temporary_bytes)


def rectify(size: str) -> Case:
    """Both images by the LocCam's calibration, against OpenCV with maps of floats."""
    scene = make_scene(size)
    rig = scaled_rig(scene)
    rectifier = make_rectifier(rig)
    sides = ((scene.left, rectifier.left_maps), (scene.right, rectifier.right_maps))
    beside = Peer("OpenCV alone, float maps", lambda: peers.float_maps(scene, rig), 1.1, size == "medium")
    pixels = Amount(scene.pixels, "pixels")
    return Case(lambda: [rectify_image(image, maps) for image, maps in sides], pixels, pixels, [beside])


def scaled_rig(scene: Scene) -> StereoRig:
    """The LocCam's calibration for images of the scene's size."""
    rig = read_camera_yaml(config_folder() / "cameras" / "katwijk_loccam.yaml")
    assert isinstance(rig, StereoRig)
    height_px, width_px = scene.left.shape[:2]
    zoom = np.diag([width_px / rig.width_px, height_px / rig.height_px, 1.0])
    return make_stereo_rig(
        K_left=zoom @ rig.K_left,
        distortion_left=rig.distortion_left,
        K_right=zoom @ rig.K_right,
        distortion_right=rig.distortion_right,
        R_right_left=rig.R_right_left,
        t_right_left_m=rig.t_right_left_m,
        size_px=(width_px, height_px),
    )


def match(size: str) -> Case:
    """From an RGB pair to disparity with NaN, the leftmost columns too, against SGBM alone on grey images."""
    scene = make_scene(size)
    matcher = Matcher(StereoOptions(num_disparities=DISPARITIES), scene.left.shape[1])
    beside = peers.sgbm(scene)._replace(limit=1.5, gated=size == "medium")
    pixels = Amount(scene.pixels, "pixels")
    return Case(lambda: matcher(scene.left, scene.right), pixels, pixels, [beside])


def project(size: str) -> Case:
    """Disparity to points in the world."""
    scene = make_scene(size)
    name, pixels = "OpenCV, reprojectImageTo3D and transform", Amount(scene.pixels, "pixels")
    beside = Peer(name, lambda: peers.opencv_points(scene), 1.0, size == "medium")
    return case_of(ours.project(scene), pixels, pixels, [beside])


def relief(size: str) -> Case:
    """Height above the local ground, slope and the rest."""
    scene = make_scene(size)
    pixels = Amount(scene.pixels, "pixels")
    return case_of(ours.relief(scene), pixels, pixels, [])


def mlesac(size: str) -> Case:
    """A plane in a cloud of as many points as an image has pixels, 40 % of them outliers."""
    points, truth = tilted_cloud(make_scene().pixels)
    hypotheses = HYPOTHESES[size]
    prepared = ours.fit_plane(points, hypotheses)
    fits = {"jaxmap": peers.PlaneFit(prepared.run)}

    def peer(name: str, make: Callable[[], peers.PlaneFit], limit: float | None = None) -> Peer:
        def kept() -> Run:
            fits[name] = make()
            return fits[name]

        return Peer(name, kept, limit, size == "medium", modules=("open3d",))

    def facts() -> Mapping[str, float]:
        errors = {
            name: np.median([plane_errors(plane, truth) for plane in one.planes], 0) for name, one in fits.items()
        }
        names = ("angle to the true plane, degrees", "height off the true plane, mm")
        return {f"{what}: {who}": two[index] for index, what in enumerate(names) for who, two in errors.items()}

    beside = [peer("Open3D segment_plane, stopping early", lambda: peers.open3d_plane(points, hypotheses, 0.99999999))]
    # Open3D's time goes with its iterations: 2048 of them would only cost time.
    if size != "large":
        name = f"Open3D segment_plane, {hypotheses} iterations"
        beside.insert(0, peer(name, lambda: peers.open3d_plane(points, hypotheses, 1.0), 1 / 20))
    amount = Amount(hypotheses, "hypotheses")
    return Case(fits["jaxmap"], amount, amount, beside, prepared.compile_s, prepared.temporary_bytes, facts)


def tilted_cloud(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a tilted plane among outliers, shuffled; and the plane, `normal . p + offset = 0`."""
    random = np.random.default_rng(6)
    normal = np.array([np.sin(TILT_RAD), 0.0, np.cos(TILT_RAD)])
    centre = np.array([SIDE_M / 2, SIDE_M / 2, 0.0])
    ground = random.uniform(0.0, SIDE_M, (count, 2))
    height_m = -(ground - centre[:2]) @ normal[:2] / normal[2] + NOISE_M * random.standard_normal(count) / normal[2]
    points = np.column_stack([ground, height_m])
    outliers = random.permutation(count)[: round(OUTLIER_SHARE * count)]
    points[outliers, 2] = random.uniform(-2.0, 2.0, len(outliers))
    return points, np.append(normal, -normal @ centre)


def plane_errors(plane: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """The angle between the normals in degrees, and the vertical distance in the middle of the cloud, millimetres."""
    plane = plane / np.linalg.norm(plane[:3]) * (1 if plane[:3] @ truth[:3] > 0 else -1)
    # By the cross product: the cosine of a small angle has no digits left.
    angle_deg = np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(plane[:3], truth[:3])))))
    middle = np.array([SIDE_M / 2, SIDE_M / 2, 0.0])
    return float(angle_deg), float(1e3 * abs(plane[:3] @ middle + plane[3]) / abs(plane[2]))


def carve(size: str) -> Case:
    """Free space in the window of one frame, by the size of the voxels."""
    scene = make_scene()
    window = ours.window_of(scene, size)
    voxels = Amount(int(np.prod(window.shape)), "voxels")
    return case_of(ours.carve_frame(scene, window), voxels, voxels, [])


def integrate(size: str) -> Case:
    """The points of one frame into its window at 0.2 m, by the number of points."""
    scene = make_scene(size)
    name, points = "Open3D voxel grid, occupancy only", Amount(scene.pixels, "points")
    beside = Peer(
        name,
        lambda: peers.open3d_voxels(kept_points(scene), VOXEL_M["medium"][0]),
        1.0,
        size == "medium",
        modules=("open3d",),
    )
    return case_of(ours.integrate_frame(scene, ours.window_of(scene, "medium")), points, points, [beside])


def fuse(size: str) -> Case:
    """Carving and integration of one frame into 40 x 40 x 4 m, by the size of the voxels."""
    scene = make_scene()
    prepared, points = ours.fuse_frame(scene, size), kept_points(scene)
    # OctoMap's voxels are cubes: of the same volume.
    edge_m = float(np.prod(VOXEL_M[size])) ** (1 / 3)
    # Targets are set for the paper's voxels, and only printed for the others.
    gated = size == "medium"

    def octomap(name: str, limit: float, discretize: bool) -> Peer:
        origin_world = scene.T_world_camera[:3, 3]
        given = {"discretize": discretize, "max_range_m": DEPTH_RANGE_M[1]}
        make = partial(peers.octomap_insertion, points, origin_world, edge_m, **given)
        return Peer(name, make, limit, gated, modules=("octomap",))

    binding = "OctoMap's Python binding alone"
    beside = [
        octomap("OctoMap, ray casting", 1 / 50, discretize=False),
        octomap("OctoMap, discretised", 1 / 15, discretize=True),
        Peer(binding, lambda: peers.octomap_binding(len(points), edge_m), modules=("octomap",)),
        Peer("touched memory once", lambda: touched_once(scene, prepared), 2.0, gated),
        Peer("in JAX alone", lambda: ours.fuse_frame(scene, size, add_plainly).run),
    ]
    voxels = Amount(int(np.prod(grid_of(size).shape)), "voxels")
    return case_of(prepared, voxels, Amount(scene.pixels, "points"), beside)


def kept_points(scene: Scene) -> np.ndarray:
    """The points of a frame that are fused, (N, 3)."""
    points = ours.points_of(scene)
    return np.asarray(points.cloud.points_world)[np.asarray(points.labels.keep)]


def touched_once(scene: Scene, fused: ours.Prepared) -> Run:
    """Reads a frame's points, labels, flags and depth, reads and writes the voxels that it touches: all channels."""
    if not np.any(fused.result):
        fused.run()
    log_odds, points = np.asarray(fused.result), ours.points_of(scene)
    touched = int((log_odds != 0).any(axis=0).sum())
    read = [
        points.cloud.points_world,
        points.labels.labels,
        points.labels.keep,
        points.cloud.depth_m,
        points.cloud.valid,
    ]
    return peers.memory_pass([np.array(array) for array in read], touched * len(log_odds))


def network(size: str) -> Case:
    """Probabilities of all pixels; the peers only compute logits, of an image that was made smaller before."""
    scene, (height_px, width_px) = make_scene(), SEEN_PX[size]
    seen = np.ascontiguousarray(cv2.resize(scene.left, (width_px, height_px), interpolation=cv2.INTER_AREA)[None])
    beside = [
        Peer(name, partial(make, "mobilenet_v2", seen, usable_cores()), modules=modules)
        for name, (make, modules) in networks.PEERS.items()
    ]
    prepared = ours.label_pixels(scene, (height_px, width_px))
    return case_of(prepared, Amount(height_px * width_px, "pixels"), Amount(1, "images"), beside)


def deeplab(backbone: str, size: str) -> Case:
    """Logits of one image by the same network in other libraries."""
    images = np.random.default_rng(0).integers(0, 256, (1, *LOGITS_PX[size], 3), np.uint8)
    beside = [
        Peer(name, partial(make, backbone, images, usable_cores()), modules=modules)
        for name, (make, modules) in networks.PEERS.items()
    ]
    prepared, gflop = ours.logits(backbone, images)
    case = case_of(prepared, Amount(images[..., 0].size, "pixels"), Amount(gflop, "GFLOP"), beside)
    return replace(case, facts=lambda: {"GFLOP/s of a product of matrices": ours.product_rate()})


def train(size: str) -> Case:
    """One training step of MobileNetV2 on a batch of images of 384 x 384."""
    images = np.random.default_rng(0).integers(0, 256, (BATCH[size], 384, 384, 3), np.uint8)
    labels = (images[..., 0] // 86).astype(np.uint8)
    beside = [
        Peer(name, partial(networks.training_step, layout, images, labels, usable_cores()), modules=networks.TORCH)
        for name, layout in (("torch eager", "contiguous_format"), ("torch channels-last", "channels_last"))
    ]
    amount = Amount(BATCH[size], "images")
    return case_of(ours.training_step(images, labels), amount, amount, beside)


def step(labeller: str, size: str) -> Case:
    """One frame into 40 x 40 x 4 m, by the size of the voxels."""
    scene, gated = make_scene(), size == "medium"
    if labeller == "deeplab":
        beside = Peer("the network alone", lambda: ours.label_pixels(scene, ours.NETWORK_PX).run, 1.5, gated)
    else:
        beside = peers.sgbm(scene)._replace(limit=0.25, gated=gated)
    voxels = Amount(int(np.prod(grid_of(size).shape)), "voxels")
    return case_of(ours.Step(scene, ours.labeller_of(labeller), size), voxels, Amount(1, "frames"), [beside])


def fused_before(size: str) -> Case:
    """The step into a map that holds many frames against the same step into one that holds few."""
    scene = make_scene()
    prepared = ours.Step(scene, ours.labeller_of("none"), "medium")
    prepared.drive(moved_poses(scene, FUSED_BEFORE[size]))
    beside = Peer("the same step, map empty at first", prepared.afresh, 1.25, size == "large")
    return Case(prepared, Amount(FUSED_BEFORE[size], "frames fused before"), Amount(1, "frames"), [beside])


@cache
def written_sequence() -> TemporaryDirectory[str]:
    """The longest sequence; the folder goes with the program."""
    return write_sequence(make_scene(), max(FRAMES.values()))


def sequence(voxels: str, size: str) -> Case:
    """Read, match, label by the network, carve and fuse, against matching alone."""
    scene, frames = make_scene(), FRAMES[size]
    prepared = ours.map_sequence(scene, Path(written_sequence().name), frames, voxels)
    beside = peers.sgbm(scene, frames)._replace(limit=1 / RATE_SHARE, gated=voxels == "medium" and size == "large")
    return case_of(prepared, Amount(frames, "frames"), Amount(frames, "frames"), [beside])


GROUPS = {
    "rectify": Group("both images of a pair, by the LocCam's calibration", rectify),
    "match": Group("disparity of a pair, 128 disparities", match),
    "project": Group("disparity to points in the world", project),
    "relief": Group("the relief of a frame above the local ground", relief),
    "mlesac": Group("the plane in 786,432 points, of which 40 % are outliers", mlesac),
    "carve": Group("free space in the window of one frame, by voxels", carve),
    "integrate": Group("the points of one frame into voxels of 0.2 m, by points", integrate),
    "fuse": Group("carving and integration of 786,432 points into 40 x 40 x 4 m, by voxels", fuse),
    "network": Group("MobileNetV2 on an image of 1024 x 768, by the pixels that it sees", network),
    "logits_mobilenet": Group("logits of one image, by its pixels", partial(deeplab, "mobilenet_v2")),
    "logits_resnet18": Group("the same on ResNet-18", partial(deeplab, "resnet18")),
    "train": Group("a training step on MobileNetV2, images of 384 x 384, by the batch", train),
    "step_none": Group("the step without labels: project, carve, fuse", partial(step, "none")),
    "step_plane": Group("the step: project, label by the MLESAC plane, carve, fuse", partial(step, "plane")),
    "step_deeplab": Group("the step: project, label by MobileNetV2, carve, fuse", partial(step, "deeplab")),
    "fused_before": Group("the step without labels, by the frames that were fused before", fused_before),
    "sequence": Group("1024 x 768, MobileNetV2 at 384 x 512, voxels of 0.2 m, by frames", partial(sequence, "medium")),
    "sequence_fine": Group("the same in the default voxels, 0.05 x 0.05 x 0.2 m", partial(sequence, "large")),
}
"""The groups by name, in the order in which they run."""
