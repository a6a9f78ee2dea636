"""Perceiving on workers: each takes a few frames at a time, and writes each frame whole."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxmap.datasets.base import from_images
from jaxmap.datasets.registry import SAMPLE_PREFIX
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.bounded_text import parse_json
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.executors import Workers, run_tasks
from jaxmap.runs.config import PerceiveConfig, absolute_tree, check_perception
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.labelling import Notify
from jaxmap.runs.perceiving import Keeper, KeptFrame, keep_frames, make_keeper
from jaxmap.runs.perception import plan_perception

_FRAMES_OF_A_TASK = 16
_ONE_AT_A_TIME = threading.Lock()
_keepers: dict[str, Keeper] = {}


@dataclass(frozen=True)
class PerceiveTask:
    """A few frames to be perceived; plain values.

    Attributes:
        run: JSON of what a worker plans the perception from.
        digest: of what perceives (`ObservationAttributes.digest`).
        folder: of the run.
        indices: of the frames.
    """

    run: str
    digest: str
    folder: str
    indices: tuple[int, ...]


def check_shareable(config: PerceiveConfig) -> None:
    """Refuses settings under which frames cannot be perceived apart.

    Raises:
        UsageError: the poses come from the images, one frame after the other.
    """
    if from_images(config):
        raise UsageError(
            "poses from images are found one frame after the other",
            where="--poses",
            fix="leave the workers out; jaxmap map of what was perceived takes them",
        )


def keep_on_workers(
    keeper: Keeper, config: PerceiveConfig, folder: RunFolder, indices: Sequence[int], workers: Workers, notify: Notify
) -> Iterator[KeptFrame]:
    """Perceives frames on workers and keeps them.

    Args:
        keeper: what does so; `begin` was called.
        config: its settings.
        folder: of the run.
        indices: of the frames.
        workers: where the tasks run.
        notify: takes a line where workers were lost.

    Raises:
        JaxmapError: workers are lost again and again, or as `keep_frames`.
    """
    source = keeper.seen.source
    run = json.dumps(
        {
            "source": source if source.startswith(SAMPLE_PREFIX) else os.path.abspath(source),
            "settings": absolute_tree(PerceiveConfig.of(config)),
            "disparity_sigma_px": keeper.attributes.disparity_sigma_px,
        }
    )
    _keepers.clear()
    _keepers[run] = keeper
    # Small tasks at the end keep all of them busy.
    size = max(1, min(_FRAMES_OF_A_TASK, len(indices) // (4 * workers.processes)))
    digest, where = keeper.attributes.digest(), os.path.abspath(folder.path)
    tasks = [
        PerceiveTask(run, digest, where, tuple(indices[start : start + size])) for start in range(0, len(indices), size)
    ]
    for _, kept in run_tasks(workers, perceive_task, tasks, notify):
        yield from kept


def perceive_task(task: PerceiveTask) -> list[KeptFrame]:
    """Perceives frames and keeps them, on a worker.

    Raises:
        JaxmapError: this worker would see them otherwise, or the disk refuses.
    """
    # Threads of one worker would take the memory of several.
    with _ONE_AT_A_TIME:
        keeper = _planned(task.run)
        if keeper.attributes.digest() != task.digest:
            raise JaxmapError(
                "a worker sees another camera, network or world than the process that gives the tasks",
                where=socket.gethostname(),
                fix="let all machines see the same files under the same paths, with the same jaxmap",
            )
        return list(keep_frames(keeper, RunFolder(Path(task.folder)), task.indices))


def _planned(run: str) -> Keeper:
    """What perceives, made once on each worker."""
    if run not in _keepers:
        keep_compiled_programs()
        tree = parse_json(run, "the task of a worker")
        config = check_perception(tree["settings"], "the task of a worker")
        seen = plan_perception(tree["source"], config, lambda line: None)
        _keepers.clear()
        _keepers[run] = make_keeper(seen, config, tree["disparity_sigma_px"])
    return _keepers[run]
