"""Times DeepLabv3+ beside the same network in torch, ONNX Runtime and OpenVINO, with the same weights and image.

    python scripts/benchmarks/deeplab.py --backbones mobilenet_v2 resnet18 --rounds 15
    python scripts/benchmarks/deeplab.py --train --rounds 5

Prints one table: median and best time of each network, image size and library, and the ratio of its median to ours;
with --train of whole training steps (forward, backward, AdamW; batch norm by the batch) beside torch's. Needs torch and
segmentation_models_pytorch (extra `bench`), whose network and initial weights all take; float32, three classes. All run
in one process, in turn, so that a busy machine disturbs all alike: compare ratios, not milliseconds.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness import Run, in_turn, limit_threads, timed

from jaxmap.host.memory import restart_with_lasting_memory

SIZES = ((384, 512), (512, 512))
BATCH, CROP = 8, (384, 384)
RATE, DECAY = 1e-3, 1e-4


def imported(backbone: str) -> Any:
    """The torch network's weights as `jaxmap weights import` reads them."""
    import networks
    from safetensors.torch import save_file

    from jaxmap.models.importers import import_weights

    with tempfile.TemporaryDirectory() as folder:
        state = {name: value.clone() for name, value in networks.torch_network(backbone).state_dict().items()}
        save_file(state, Path(folder) / "smp.safetensors")
        return import_weights(Path(folder) / "smp.safetensors")


def our_inference(backbone: str, images: Any) -> tuple[Run, float]:
    """Our network as `jaxmap segment` runs it, and the GFLOP that the compiler counts."""
    import jax

    from jaxmap.models.deeplab import inference_network

    model = imported(backbone)
    network = inference_network(model.architecture, model.weights)
    compiled = jax.jit(network.apply).lower(network.weights, images).compile()
    return lambda: compiled(network.weights, images).block_until_ready(), compiled.cost_analysis()["flops"] / 1e9


def our_training(backbone: str, images: Any, labels: Any) -> Run:
    """Training steps of our network."""
    import jax
    import jax.numpy as jnp
    import optax

    from jaxmap.models.deeplab import training_form
    from jaxmap.training.losses import total_loss
    from jaxmap.training.optimiser import is_statistic
    from jaxmap.training.options import LossOptions

    model = imported(backbone)
    # Torch's network has no dropout.
    network = training_form(replace(model.architecture, dropout=0.0), ("backbone", "aspp", "decoder"))
    optimiser = optax.adamw(RATE, weight_decay=DECAY)

    def loss(moved, fixed, images, labels):
        logits, statistics = network({**moved, **fixed}, images, jax.random.key(0))
        return total_loss(logits, labels, jnp.ones(logits.shape[-1]), LossOptions()), statistics

    def step(moved, fixed, memory, images, labels):
        (value, statistics), gradient = jax.value_and_grad(loss, has_aux=True)(moved, fixed, images, labels)
        updates, memory = optimiser.update(gradient, memory, moved)
        return value, optax.apply_updates(moved, updates), {**fixed, **statistics}, memory

    moved = {name: jnp.array(value) for name, value in model.weights.items() if not is_statistic(name)}
    fixed = {name: jnp.array(value) for name, value in model.weights.items() if is_statistic(name)}
    held = [moved, fixed, optimiser.init(moved)]
    compiled = jax.jit(step, donate_argnums=(0, 1, 2)).lower(*held, images, labels).compile()

    def run() -> float:
        value, *held[:] = compiled(*held, images, labels)
        return float(value)

    return run


def torch_training(backbone: str, images: Any, labels: Any, threads: int, layout: str) -> Run:
    """Training steps of torch eager, in one order of memory."""
    import copy

    import networks
    import torch

    torch.set_num_threads(threads)
    order = getattr(torch, layout)
    inputs = networks.torch_images(images).contiguous(memory_format=order)
    truth = torch.from_numpy(labels).long()
    network = copy.deepcopy(networks.torch_network(backbone)).train().to(memory_format=order)
    # As many libraries' heads have it, and ours here: without dropout.
    for module in network.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)

    def run() -> float:
        optimiser.zero_grad()
        loss = torch.nn.functional.cross_entropy(network(inputs), truth)
        loss.backward()
        optimiser.step()
        return loss.item()

    return run


def print_rows(title: str, runs: Mapping[str, Run], rounds: int) -> float:
    """Times runs in turn and prints a line for each; the median of ours, in seconds."""
    for run in runs.values():
        run()
    times = dict(zip(runs, in_turn(list(runs.values()), [1] * len(runs), rounds), strict=True))
    own_s = statistics.median(times["jaxmap"])
    for name, values in times.items():
        median_s = statistics.median(values)
        print(
            f"{title:24s}{name:22s}{1e3 * median_s:11.1f}{1e3 * min(values):11.1f}{median_s / own_s:9.2f}", flush=True
        )
    return own_s


def matmul_rate() -> float:
    """GFLOP/s of a float32 matrix product, the best of several: what this machine reaches."""
    import jax
    import jax.numpy as jnp

    size = 1024
    left = jnp.ones((size, size))
    product = jax.jit(jnp.dot)
    product(left, left).block_until_ready()
    return 2e-9 * size**3 / min(timed(lambda: product(left, left).block_until_ready()) for _ in range(15))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backbones", nargs="+", default=["mobilenet_v2", "resnet18"])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--train", action="store_true", help="time training steps instead of inference")
    given = parser.parse_args()
    restart_with_lasting_memory()
    limit_threads(given.threads)
    import networks
    import numpy as np

    if importlib.util.find_spec("segmentation_models_pytorch") is None:
        parser.error("needs torch and segmentation_models_pytorch: pip install 'jaxmap[bench]'")
    rng = np.random.default_rng(0)
    print(f"{'network, image':24s}{'':22s}{'median, ms':>11s}{'best, ms':>11s}{'ratio':>9s}")
    for backbone in given.backbones:
        if given.train:
            images = rng.integers(0, 256, (BATCH, *CROP, 3), np.uint8)
            labels = (images[..., 0] // 86).astype(np.uint8)
            runs = {"jaxmap": our_training(backbone, images, labels)}
            for name, layout in (("torch eager", "contiguous_format"), ("torch channels-last", "channels_last")):
                runs[name] = torch_training(backbone, images, labels, given.threads, layout)
            print_rows(f"{backbone}, {BATCH} x {CROP[0]}x{CROP[1]}", runs, given.rounds)
            continue
        for size in SIZES:
            images = rng.integers(0, 256, (1, *size, 3), np.uint8)
            own, gflop = our_inference(backbone, images)
            there = {
                name: make(backbone, images, given.threads)
                for name, (make, modules) in networks.PEERS.items()
                if all(map(importlib.util.find_spec, modules))
            }
            own_s = print_rows(f"{backbone}, {size[0]}x{size[1]}", {"jaxmap": own} | there, given.rounds)
            print(f"{'':24s}ours: {gflop:.1f} GFLOP, {gflop / own_s:.0f} GFLOP/s of {matmul_rate():.0f} in a product")


if __name__ == "__main__":
    main()
