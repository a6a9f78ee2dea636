"""Times DeepLabv3+ against torch eager, ONNX Runtime and OpenVINO on the same network, image and threads.

With --train: whole training steps (forward, backward, AdamW; batch norm by the batch) against torch's.

Needs the extra `bench` for the peers; those that are not installed are left out. All run in one process, turn
by turn, so that a busy machine disturbs all alike; ratios of medians count, not milliseconds. The network is
segmentation_models_pytorch's design with seeded weights, float32, three classes.

    python scripts/bench_deeplab.py --backbones mobilenet_v2 resnet18 --rounds 15
    python scripts/bench_deeplab.py --train --rounds 5

The process keeps the memory it frees, as with `jaxmap train`; that helps all of them.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

from benchmarks.harness import Run as Runner
from benchmarks.harness import in_turn, timed
from benchmarks.threads import limit_threads
from jaxmap.host.memory import restart_with_lasting_memory

ROOT = Path(__file__).resolve().parent.parent
SIZES = ((384, 512), (512, 512))
BATCH, CROP = 8, (384, 384)
RATE, DECAY = 1e-3, 1e-4


def ours(state: dict, image) -> tuple[Runner, float]:
    """Our network as `jaxmap segment` runs it, and how many GFLOP its compiled program counts."""
    import jax
    from safetensors.numpy import save_file

    from jaxmap.models.deeplab import inference_network
    from jaxmap.models.importers import import_weights

    with tempfile.TemporaryDirectory() as folder:
        save_file(state, Path(folder) / "smp.safetensors")
        imported = import_weights(Path(folder) / "smp.safetensors")
    network = inference_network(imported.architecture, imported.weights)
    compiled = jax.jit(network.apply).lower(network.weights, image).compile()
    gflop = compiled.cost_analysis()["flops"] / 1e9
    return lambda: compiled(network.weights, image).block_until_ready(), gflop


def our_training(state: dict, images, labels) -> Runner:
    """Steps of our network; a call gives the loss before the step."""
    from dataclasses import replace

    import jax
    import jax.numpy as jnp
    import optax
    from safetensors.numpy import save_file

    from jaxmap.models.deeplab import training_form
    from jaxmap.models.importers import import_weights
    from jaxmap.training.losses import total_loss
    from jaxmap.training.options import PixelLossOptions
    from jaxmap.training.step import is_statistic

    with tempfile.TemporaryDirectory() as folder:
        save_file(state, Path(folder) / "smp.safetensors")
        imported = import_weights(Path(folder) / "smp.safetensors")
    # The twin has no dropout.
    network = training_form(replace(imported.architecture, dropout=0.0), ("backbone", "aspp", "decoder"))
    optimiser = optax.adamw(RATE, weight_decay=DECAY)

    def loss(moved, fixed, images, labels):
        logits, statistics = network({**moved, **fixed}, images, jax.random.key(0))
        return total_loss(logits, labels, jnp.ones(logits.shape[-1]), PixelLossOptions()), statistics

    def step(moved, fixed, memory, images, labels):
        (value, statistics), gradient = jax.value_and_grad(loss, has_aux=True)(moved, fixed, images, labels)
        updates, memory = optimiser.update(gradient, memory, moved)
        return value, optax.apply_updates(moved, updates), {**fixed, **statistics}, memory

    moved = {name: jnp.array(value) for name, value in imported.weights.items() if not is_statistic(name)}
    fixed = {name: jnp.array(value) for name, value in imported.weights.items() if is_statistic(name)}
    held = [moved, fixed, optimiser.init(moved)]
    compiled = jax.jit(step, donate_argnums=(0, 1, 2)).lower(*held, images, labels).compile()

    def run() -> float:
        value, *held[:] = compiled(*held, images, labels)
        return float(value)

    return run


def torch_training(backbone: str, state: dict, images, labels, threads: int) -> dict[str, Runner]:
    """Steps of torch eager, in both orders of memory; the faster one counts."""
    try:
        import torch
    except ImportError:
        return {}
    from golden.make_smp_golden import MEAN, STD
    from golden.torch_deeplab import DeepLabV3Plus

    torch.set_num_threads(threads)
    scaled = (torch.from_numpy(images).float() / 255 - torch.tensor(MEAN)) / torch.tensor(STD)
    truth = torch.from_numpy(labels).long()

    def runner(layout: torch.memory_format) -> Runner:
        network = DeepLabV3Plus(backbone)
        network.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in state.items()})
        network = network.train().to(memory_format=layout)
        inputs = scaled.permute(0, 3, 1, 2).contiguous(memory_format=layout)
        optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)

        def run() -> float:
            optimiser.zero_grad()
            loss = torch.nn.functional.cross_entropy(network(inputs), truth)
            loss.backward()
            optimiser.step()
            return loss.item()

        return run

    return {
        "torch eager": runner(torch.contiguous_format),
        "torch channels-last": runner(torch.channels_last),
    }


def train(backbone: str, rounds: int, threads: int) -> None:
    """Prints the training case of a network."""
    import numpy as np
    from golden.seeded_weights import seeded_image, seeded_state_of

    state = seeded_state_of(backbone)
    images = np.stack([np.roll(seeded_image(*CROP), 16 * place, axis=0) for place in range(BATCH)])
    labels = (images[..., 0] // 86).astype(np.uint8)
    runners = {"jaxmap": our_training(state, images, labels)}
    runners |= torch_training(backbone, state, images, labels, threads)
    losses = {name: run() for name, run in runners.items()}
    times = measured(runners, rounds)
    own_s = statistics.median(times["jaxmap"])
    print(f"{backbone} training step, batch {BATCH} of {CROP[0]}x{CROP[1]}")
    for name, values in times.items():
        median = statistics.median(values)
        rate = f"{BATCH / median:5.2f} images/s"
        print(f"  {name:20} {median:6.2f} s  {rate}  {median / own_s:5.2f} x ours  (first loss {losses[name]:.5f})")


def measured(runners: dict[str, Runner], rounds: int) -> dict[str, list[float]]:
    """Seconds of each call, turn by turn."""
    return dict(zip(runners, in_turn(list(runners.values()), [1] * len(runners), rounds), strict=True))


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


def main() -> None:
    """Prints a line for each network, size and runner."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backbones", nargs="+", default=["mobilenet_v2", "resnet18"])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--train", action="store_true", help="time training steps instead of inference")
    arguments = parser.parse_args()
    restart_with_lasting_memory()
    limit_threads(arguments.threads)
    sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "golden")]
    from golden.seeded_weights import seeded_image, seeded_state_of

    from benchmarks.network_peers import NetworkPeers

    print(f"{arguments.threads} threads, float32, median of {arguments.rounds} interleaved rounds")
    for backbone in arguments.backbones:
        if arguments.train:
            train(backbone, arguments.rounds, arguments.threads)
            continue
        state = seeded_state_of(backbone)
        for size in SIZES:
            image = seeded_image(*size)[None]
            own, gflop = ours(state, image)
            peers = NetworkPeers(backbone, state, image, arguments.threads)
            runners = {"jaxmap": own, **peers.installed()}
            for run in runners.values():
                run()
            times = measured(runners, arguments.rounds)
            rate, own_s = matmul_rate(), statistics.median(times["jaxmap"])
            speed = f"{gflop / own_s:.0f} GFLOP/s of {rate:.0f} in matmul"
            print(f"{backbone} {size[0]}x{size[1]}: {gflop:.1f} GFLOP, {speed}")
            for name, values in times.items():
                median, best = statistics.median(values), min(values)
                print(f"  {name:20} {1e3 * median:7.1f} ms (best {1e3 * best:6.1f})  {median / own_s:5.2f} x ours")


if __name__ == "__main__":
    main()
