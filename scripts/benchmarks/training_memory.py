"""Measures memory and time of one training step: peak resident size, what the compiler counts, seconds.

    python scripts/benchmarks/training_memory.py [--config NAME] [--steps 4] [--option SECTION.NAME=VALUE ...]

The network starts from random weights, as after `--init` of its backbone (which freezes the backbone's batch norms)
with --pretrained. The batch is noise of 480x640 pixels with labels of its classes.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from jaxmap.geometry.relief import RELIEF_CHANNELS
from jaxmap.host.memory import peak_resident_mib, restart_with_lasting_memory
from jaxmap.runs.training_plan import TRAIN_SETTINGS, TrainConfig
from jaxmap.training.initial_network import make_initial_network
from jaxmap.training.step import Batch, make_trainer

SIZE_PX = (480, 640)


def main() -> None:
    """Runs a few steps and prints one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", help="a configuration of jaxmap train")
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--pretrained", action="store_true", help="the backbone's batch norms are frozen")
    parser.add_argument("--returned", action="store_true", help="freed memory goes back to the system")
    parser.add_argument("--option", action="append", default=[], metavar="SECTION.NAME=VALUE")
    given = parser.parse_args()
    if not given.returned:
        restart_with_lasting_memory()
    config = TRAIN_SETTINGS.load(given.config) if given.config else TrainConfig()
    for text in given.option:
        name, value = text.split("=", 1)
        config = changed(config, name.split("."), yaml.safe_load(value))
    network = make_initial_network(config.network, config.norm, config.classes, None, seed=0)
    norms = tuple(name for name in network.batch_norms if not (given.pretrained and name == "backbone"))
    weights = jnp.ones(len(config.classes))
    trainer = make_trainer(network.architecture, config, steps=1000, class_weights=weights, batch_norms=norms)
    batch = noise(config, relief=network.architecture.relief_channels > 0)
    state, key = trainer.init(network.weights), jax.random.key(0)
    before = peak_resident_mib()
    compiled = trainer.step.lower(state, batch, key).compile()  # type: ignore[attr-defined]
    counted = compiled.memory_analysis().temp_size_in_bytes / 2**20
    compiling = peak_resident_mib()
    laps, loss = [], float("nan")
    for _ in range(given.steps):
        started_s, busy_s = time.perf_counter(), time.process_time()
        state, metrics = compiled(state, batch, key)
        loss = float(metrics.loss)
        laps.append((time.perf_counter() - started_s, time.process_time() - busy_s))
    seconds, busy = (min(times) for times in zip(*laps[1:], strict=True)) if laps[1:] else (0.0, 0.0)
    print(
        f"resident {peak_resident_mib():.0f} MiB (before {before:.0f}, after compiling {compiling:.0f}), "
        f"counted {counted:.0f} MiB, {seconds:.2f} s a step ({busy:.2f} s of all cores), loss {loss:.4f}"
    )


def changed(config: TrainConfig, names: list[str], value: object) -> TrainConfig:
    """The configuration with one option changed."""
    if isinstance(value, list):
        value = tuple(value)
    if len(names) == 1:
        return replace(config, **{names[0]: value})
    part = replace(getattr(config, names[0]), **{names[1]: value})
    return replace(config, **{names[0]: part})


def noise(config: TrainConfig, *, relief: bool) -> Batch:
    """A batch without meaning."""
    draw, count = np.random.default_rng(0), config.batch_size
    coarse = (count, SIZE_PX[0] // 4, SIZE_PX[1] // 4, RELIEF_CHANNELS)
    return jax.device_put(
        Batch(
            images=draw.integers(0, 256, (count, *SIZE_PX, 3), np.uint8),  # type: ignore[arg-type]
            labels=draw.integers(0, len(config.classes), (count, *SIZE_PX), np.uint8),  # type: ignore[arg-type]
            sizes_px=np.full((count, 2), SIZE_PX, np.int32),  # type: ignore[arg-type]
            draws=np.stack([np.zeros(count, np.int32), np.arange(count, dtype=np.int32)], axis=1),  # type: ignore[arg-type]
            originals=np.zeros(count, bool),  # type: ignore[arg-type]
            relief=draw.random(coarse).astype(np.float16) if relief else None,  # type: ignore[arg-type]
        )
    )


if __name__ == "__main__":
    main()
