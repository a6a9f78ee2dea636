"""Benchmarks: each case beside its peer, in one process, interleaved; figures are medians and ratios.

    python scripts/bench.py                  print the table, and fail where a ratio passes its gate
    python scripts/bench.py --write-baseline also write scripts/bench_baseline.json
    python scripts/bench.py --json F         also write the figures to F

A ratio is the case's time over its peer's. The gate of a case is the smaller of its limit and 1.5 times its ratio in
the committed baseline, but never tighter than 0.9 times the limit: machines are noisy, ratios less so.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from PIL import Image

from jaxmap.datasets import open_sequence
from jaxmap.datasets.pose_files import write_tum
from jaxmap.datasets.poses import T_Z_UP_CAMERA_WORLD
from jaxmap.deeplab_labeller import make_deeplab_labeller
from jaxmap.fusion.params import FusionRule, make_fusion_params
from jaxmap.host_memory import peak_resident_mib
from jaxmap.labellers import Labeller, make_no_labeller, make_plane_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapper import Mapper, MapperParams, StepCost, compile_step, make_mapper
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.deeplab import fold_batch_norm, initial_weights, pure_network
from jaxmap.output_folder import write_json
from jaxmap.sequence import prepare_frames, run_sequence
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.options import StereoOptions
from jaxmap.types import Frame, StereoCamera, make_grid, make_stereo_camera

BASELINE = Path(__file__).with_name("bench_baseline.json")
WIDTH_PX, HEIGHT_PX, DISPARITIES = 1024, 768, 128
DEPTH_RANGE_M = (0.3, 12.0)
SEQUENCE_FRAMES = 24


@dataclass
class Case:
    """One thing to time, its peer, and the ratio it must not pass."""

    name: str
    peer_name: str
    run: Callable[[], object]
    peer: Callable[[], object]
    limit: float
    repeats: int
    compile_s: float = 0.0
    temporary_mib: float = 0.0


@dataclass
class Scene:
    """The Motorcycle pair, enlarged to the LocCam's size, as one frame and as a sequence."""

    left: np.ndarray
    right: np.ndarray
    camera: StereoCamera
    pose: np.ndarray

    @classmethod
    def make(cls) -> Scene:
        """The pair at 1024 x 768; its camera stands 1.1 m above the ground in the middle of the map."""
        sequence = open_sequence("sample:motorcycle")
        pair = sequence.read_pair(sequence.frames[0])
        source = sequence.camera
        zoom = WIDTH_PX / source.width_px
        left, right = (cv2.resize(image, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA) for image in pair)
        camera = make_stereo_camera(
            fx_px=float(source.fx_px) * zoom,
            fy_px=float(source.fy_px) * HEIGHT_PX / source.height_px,
            cx_px=float(source.cx_px) * zoom,
            cy_px=float(source.cy_px) * HEIGHT_PX / source.height_px,
            baseline_m=float(source.baseline_m),
            doffs_px=float(source.doffs_px) * zoom,
            width_px=WIDTH_PX,
            height_px=HEIGHT_PX,
        )
        pose = np.array(T_Z_UP_CAMERA_WORLD, np.float64)
        pose[:3, 3] = (20.0, 12.0, 1.1)
        return cls(left, right, camera, pose)

    def mapper(self, labeller: Labeller, voxel_size_m: float = 0.2) -> Mapper:
        """A mapper into 40 x 40 x 4 m."""
        grid = make_grid([0, 0, -2], [40, 40, 2], voxel_size_m)
        return make_mapper(self.camera, grid, labeller, FusionRule(), DEPTH_RANGE_M)

    def params(self, labeller: Labeller) -> MapperParams:
        """The default parameters."""
        return MapperParams(self.camera, make_fusion_params(labeller.classes), labeller.params)

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """A plain folder of pairs: the scene, its rows rolled a little from frame to frame."""
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for side, image in (("left", self.left), ("right", self.right)):
                (folder / side).mkdir()
                for index in range(SEQUENCE_FRAMES):
                    Image.fromarray(np.roll(image, index, axis=0)).save(folder / side / f"{index:06d}.png")
            names = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px")
            numbers = {key: float(getattr(self.camera, key)) for key in names}
            (folder / "camera.yaml").write_text(json.dumps({"image_size_px": [WIDTH_PX, HEIGHT_PX], **numbers}))
            (folder / "times.txt").write_text("\n".join(str(0.1 * index) for index in range(SEQUENCE_FRAMES)))
            poses = np.repeat(self.pose[None], SEQUENCE_FRAMES, axis=0)
            poses[:, 1, 3] += 0.2 * np.arange(SEQUENCE_FRAMES)
            write_tum(folder / "poses.tum", 0.1 * np.arange(SEQUENCE_FRAMES), poses)
            yield folder


def compiled_step(scene: Scene, front_end: StereoFrontEnd, labeller: Labeller) -> tuple[Callable[[], None], StepCost]:
    """The compiled step on the scene's frame, into a map that it goes on filling, and what compiling it took."""
    disparity_px = jnp.asarray(front_end(scene.left, scene.right).disparity_px)
    image = jnp.asarray(scene.left) if labeller.needs == "image" else None
    frame = Frame(disparity_px, jaxlie.SE3.from_matrix(jnp.asarray(scene.pose, jnp.float32)), image=image)
    mapper, params, key = scene.mapper(labeller), scene.params(labeller), jax.random.key(0)
    state = [mapper.init()]
    mapper, cost = compile_step(mapper, state[0], frame, params, key)

    def step() -> None:
        state[0], _ = mapper.step(state[0], frame, params, key)
        jax.block_until_ready(state[0].log_odds)

    return step, cost


def step_case(scene: Scene, name: str, labeller: Labeller, limit: float) -> Case:
    """The compiled step against SGBM 3WAY with 128 disparities on the same frame."""
    front_end = StereoFrontEnd(scene.camera, StereoOptions(num_disparities=DISPARITIES, pad_left=False))
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right)]
    step, cost = compiled_step(scene, front_end, labeller)
    peer = f"SGBM 3WAY, {DISPARITIES} disparities"
    temporary_mib = cost.temporary_bytes / 2**20
    return Case(name, peer, step, lambda: front_end.matcher(*grey), limit, 25, cost.compile_s, temporary_mib)


def network_case(scene: Scene, limit: float) -> Case:
    """The compiled step with a network in it against that network alone, up to probabilities of all pixels."""
    architecture = torch_architecture("mobilenet_v2", ROVER_CLASSES)
    saved = SavedModel(architecture, initial_weights(architecture, jax.random.key(0)), "network")
    front_end = StereoFrontEnd(scene.camera, StereoOptions(num_disparities=DISPARITIES, pad_left=False))
    step, cost = compiled_step(scene, front_end, make_deeplab_labeller(saved))
    network = pure_network(*fold_batch_norm(architecture, saved.weights))
    probabilities = jax.jit(lambda weights, images: jax.nn.softmax(network.apply(weights, images), axis=-1))
    images = jnp.asarray(scene.left)[None]

    def peer() -> None:
        probabilities(network.weights, images).block_until_ready()

    temporary_mib = cost.temporary_bytes / 2**20
    return Case(
        "step: label by MobileNetV2, carve, fuse",
        "that network alone",
        step,
        peer,
        limit,
        9,
        cost.compile_s,
        temporary_mib,
    )


def sequence_case(scene: Scene, folder: Path, limit: float) -> Case:
    """A whole sequence against reading and matching it."""
    sequence = open_sequence(folder)
    front_end = StereoFrontEnd(sequence.camera, StereoOptions(num_disparities=DISPARITIES))
    labeller = make_plane_labeller(ROVER_CLASSES)
    mapper, params, key = scene.mapper(labeller), scene.params(labeller), jax.random.key(0)
    first = next(iter(prepare_frames(sequence, front_end)))
    assert first.frame is not None
    mapper.step(mapper.init(), first.frame, params, key)

    def whole() -> None:
        for voxel_map, _ in run_sequence(mapper, mapper.init(), prepare_frames(sequence, front_end), params, key):
            jax.block_until_ready(voxel_map.log_odds)

    def ahead() -> None:
        for _ in prepare_frames(sequence, front_end):
            pass

    return Case(f"sequence of {SEQUENCE_FRAMES} frames", "reading and matching alone", whole, ahead, limit, repeats=5)


def measure(case: Case) -> dict[str, float | str]:
    """Times a case and its peer in turn."""
    case.run(), case.peer()
    times_s: tuple[list[float], list[float]] = ([], [])
    for _ in range(case.repeats):
        for function, record in zip((case.run, case.peer), times_s, strict=True):
            started_s = time.perf_counter()
            function()
            record.append(time.perf_counter() - started_s)
    run_ms, peer_ms = (1e3 * np.array(record) for record in times_s)
    return {
        "peer": case.peer_name,
        "median_ms": round(float(np.median(run_ms)), 3),
        "spread_ms": round(float(np.percentile(run_ms, 75) - np.percentile(run_ms, 25)), 3),
        "peer_median_ms": round(float(np.median(peer_ms)), 3),
        "ratio": round(float(np.median(run_ms) / np.median(peer_ms)), 4),
        "limit": round(case.limit, 4),
        "compile_s": round(case.compile_s, 2),
        "temporary_mib": round(case.temporary_mib, 1),
    }


def gate(name: str, figures: dict, baseline: dict) -> float:
    """The ratio that a case must not pass."""
    limit = figures["limit"]
    if name not in baseline:
        return limit
    return min(limit, max(1.5 * baseline[name]["ratio"], 0.9 * limit))


def main() -> int:
    """Runs the cases; 1 where a gate is passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write-baseline", action="store_true")
    arguments = parser.parse_args()
    baseline = json.loads(BASELINE.read_text())["cases"] if BASELINE.exists() else {}
    scene, results, passed = Scene.make(), {}, True
    with scene.folder() as folder:
        cases = [
            step_case(scene, "step: project, MLESAC, carve, fuse", make_plane_labeller(ROVER_CLASSES), 0.25),
            step_case(scene, "step: project, carve, fuse", make_no_labeller(), 0.25),
            network_case(scene, 1.5),
            sequence_case(scene, folder, 1 / 0.85),
        ]
        for case in cases:
            figures = results[case.name] = measure(case)
            bound = gate(case.name, figures, baseline)
            good = figures["ratio"] <= bound
            passed &= good
            print(
                f"{case.name:38s} {figures['median_ms']:9.2f} ms (+-{figures['spread_ms']:.2f})  "
                f"{case.peer_name:30s} {figures['peer_median_ms']:9.2f} ms  ratio {figures['ratio']:.3f} "
                f"(gate {bound:.3f}) {'ok' if good else 'TOO SLOW'}"
            )
            if case.compile_s:
                print(f"{'':38s} compiled in {case.compile_s:.2f} s; {case.temporary_mib:.0f} MiB beside the map")
    device = jax.devices()[0].device_kind
    print(f"peak resident {peak_resident_mib():.0f} MiB; {device}, OpenCV {cv2.__version__}, JAX {jax.__version__}")
    report = {"image_px": [WIDTH_PX, HEIGHT_PX], "cases": results}
    if arguments.json:
        write_json(arguments.json, report)
    if arguments.write_baseline:
        write_json(BASELINE, report)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
