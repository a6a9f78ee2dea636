"""Times DeepLabv3+ against torch eager, ONNX Runtime and OpenVINO on the same network, image and threads.

Needs the extra `bench` for the peers; those that are not installed are left out. All run in one process, turn
by turn, so that a busy machine disturbs all alike; ratios of medians count, not milliseconds. The network is
segmentation_models_pytorch's design with seeded weights, float32, three classes.

    python scripts/bench_deeplab.py --backbones mobilenet_v2 resnet18 --rounds 15
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SIZES = ((384, 512), (512, 512))
Runner = Callable[[], object]


def limit_threads(count: int) -> None:
    """Must run before the libraries are loaded, which read it once."""
    os.environ["OMP_NUM_THREADS"] = str(count)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


def ours(state: dict, image) -> tuple[Runner, float]:
    """Our network as `jaxmap segment` runs it, and how many GFLOP its compiled program counts."""
    import jax
    from safetensors.numpy import save_file

    from jaxmap.models.compilation import inference_options
    from jaxmap.models.deeplab import inference_network
    from jaxmap.models.importers import import_weights

    with tempfile.TemporaryDirectory() as folder:
        save_file(state, Path(folder) / "smp.safetensors")
        imported = import_weights(Path(folder) / "smp.safetensors")
    network = inference_network(imported.architecture, imported.weights)
    compiled = jax.jit(network.apply).lower(network.weights, image).compile(compiler_options=inference_options())
    gflop = compiled.cost_analysis()["flops"] / 1e9
    return lambda: compiled(network.weights, image).block_until_ready(), gflop


def peers(backbone: str, state: dict, image, threads: int) -> dict[str, Runner]:
    """The peers that are installed; each takes the normalised image."""
    try:
        import torch
    except ImportError:
        return {}
    from golden.make_smp_golden import MEAN, STD
    from golden.torch_deeplab import DeepLabV3Plus

    torch.set_num_threads(threads)
    network = DeepLabV3Plus(backbone).eval()
    network.load_state_dict({name: torch.from_numpy(value) for name, value in state.items()})
    scaled = (torch.from_numpy(image).float() / 255 - torch.tensor(MEAN)) / torch.tensor(STD)
    inputs = scaled.permute(0, 3, 1, 2).contiguous()
    last = network.to(memory_format=torch.channels_last)
    inputs_last = inputs.to(memory_format=torch.channels_last)

    def eager() -> object:
        with torch.inference_mode():
            return last(inputs_last)

    runners: dict[str, Runner] = {"torch channels-last": eager}
    with contextlib.suppress(ImportError):
        import onnxruntime

        content = io.BytesIO()
        torch.onnx.export(network, (inputs,), content, input_names=["image"], output_names=["logits"], dynamo=False)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        session = onnxruntime.InferenceSession(content.getvalue(), options, providers=["CPUExecutionProvider"])
        runners["onnxruntime"] = lambda: session.run(None, {"image": inputs.numpy()})
        with contextlib.suppress(ImportError):
            import openvino

            core = openvino.Core()
            model = core.read_model(io.BytesIO(content.getvalue()))
            hints = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": "LATENCY"}
            request = core.compile_model(model, "CPU", hints).create_infer_request()
            runners["openvino f32"] = lambda: request.infer({"image": inputs.numpy()})
    return runners


def matmul_rate() -> float:
    """GFLOP/s of a float32 matrix product, the best of several: what this machine can do."""
    import jax
    import jax.numpy as jnp

    size = 1024
    left = jnp.ones((size, size))
    product = jax.jit(jnp.dot)
    product(left, left).block_until_ready()
    times = [timed(lambda: product(left, left).block_until_ready()) for _ in range(15)]
    return 2e-9 * size**3 / min(times)


def timed(run: Runner) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def main() -> None:
    """Prints a line for each network, size and runner."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backbones", nargs="+", default=["mobilenet_v2", "resnet18"])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    limit_threads(arguments.threads)
    sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "golden")]
    from golden.seeded_weights import seeded_image
    from models.test_models_golden import seeded_state_of

    print(f"{arguments.threads} threads, float32, median of {arguments.rounds} interleaved rounds")
    for backbone in arguments.backbones:
        state = seeded_state_of(backbone)
        for size in SIZES:
            image = seeded_image(*size)[None]
            own, gflop = ours(state, image)
            runners = {"jaxmap": own, **peers(backbone, state, image, arguments.threads)}
            times: dict[str, list[float]] = {name: [] for name in runners}
            for run in runners.values():
                run()
            for _ in range(arguments.rounds):
                for name, run in runners.items():
                    # Threads of the one before may still be spinning.
                    time.sleep(0.02)
                    times[name].append(timed(run))
            rate, own_s = matmul_rate(), statistics.median(times["jaxmap"])
            speed = f"{gflop / own_s:.0f} GFLOP/s of {rate:.0f} in matmul"
            print(f"{backbone} {size[0]}x{size[1]}: {gflop:.1f} GFLOP, {speed}")
            for name, values in times.items():
                median, best = statistics.median(values), min(values)
                print(f"  {name:20} {1e3 * median:7.1f} ms (best {1e3 * best:6.1f})  {median / own_s:5.2f} x ours")


if __name__ == "__main__":
    main()
