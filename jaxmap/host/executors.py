"""Tasks on workers: in this process, in processes on this machine, or on a Dask cluster.

A task is a function of a module and plain values; what it makes, it leaves in files. A task that was lost with its
worker runs again, so a task that runs twice must come to the same.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from jaxmap.errors import JaxmapError

if TYPE_CHECKING:
    from distributed import Client

Task = TypeVar("Task")
Result = TypeVar("Result")

_ROUNDS = 3
"""So often may all that is left be lost without anything being done between: then it is not chance."""


@dataclass(frozen=True)
class Workers:
    """Where tasks run.

    Attributes:
        processes: so many on this machine; with one, the tasks run in this process.
        scheduler: the address of a Dask scheduler, whose workers run them instead.
        patience_s: how long a scheduler that is gone is waited for.
    """

    processes: int = 1
    scheduler: str | None = None
    patience_s: float = 600.0

    @property
    def shared(self) -> bool:
        """Whether tasks run anywhere but in this process."""
        return self.scheduler is not None or self.processes > 1


def run_tasks(
    workers: Workers,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    notify: Callable[[str], None] = lambda line: None,
) -> Iterator[tuple[Task, Result]]:
    """Runs a function on each task, and yields them with their results, in the order in which they are done.

    Args:
        workers: where.
        function: of a module that the workers can import.
        tasks: of plain values.
        notify: takes a line where workers were lost.

    Raises:
        JaxmapError: workers are lost again and again, or there are none; or as the function does.
    """
    if workers.scheduler is not None:
        yield from _run(lambda: _dask(workers, notify), _dask_losses(), function, tasks, notify)
    elif workers.processes > 1 and tasks:
        count = min(workers.processes, len(tasks))
        yield from _run(lambda: _processes(count), (BrokenProcessPool,), function, tasks, notify)
    else:
        yield from ((task, function(task)) for task in tasks)


def _run(
    make: Callable[[], AbstractContextManager[Executor]],
    losses: tuple[type[BaseException], ...],
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    notify: Callable[[str], None],
) -> Iterator[tuple[Task, Result]]:
    left, rounds_in_vain = dict(enumerate(tasks)), 0
    while left:
        done, loss = 0, None
        with make() as executor:
            try:
                futures = {executor.submit(function, task): number for number, task in left.items()}
            except losses as fault:
                futures, loss = {}, fault
            for future in as_completed(futures):
                try:
                    result = future.result()
                except losses as fault:
                    loss = fault
                    continue
                done += 1
                yield left.pop(futures[future]), result
        rounds_in_vain = 0 if done else rounds_in_vain + 1
        if loss is not None and left:
            reason = str(loss).strip().split("\n")[0] or type(loss).__name__
            if rounds_in_vain >= _ROUNDS:
                raise JaxmapError(
                    f"workers are lost again and again ({reason[:200]})",
                    fix="take fewer workers, or give each more memory; what is done is kept",
                )
            notify(f"workers were lost; {len(left)} of {len(tasks)} tasks run again")


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    before = multiprocessing.active_children()
    # Not forked: JAX has threads.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(count, mp_context=context, initializer=_begin_worker)
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            if child not in before:
                child.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    """An interrupt is for the process that gives the tasks; without that one there is nothing left to do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def _dask(workers: Workers, notify: Callable[[str], None]) -> Iterator[Executor]:
    client = _connect(workers, notify)
    try:
        if not client.scheduler_info()["workers"]:
            notify(f"the scheduler at {workers.scheduler} has no workers yet; waiting for some")
        yield client.get_executor(pure=False)
    finally:
        # A scheduler that is gone takes its time to be missed.
        client.close(timeout=2)


def _connect(workers: Workers, notify: Callable[[str], None]) -> Client:
    """A client of the scheduler, which may be on its way back."""
    from distributed import Client

    until_s, told = time.monotonic() + workers.patience_s, False
    while True:
        try:
            return Client(workers.scheduler, timeout=5, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as fault:
            if isinstance(fault, ValueError) or time.monotonic() > until_s:
                raise JaxmapError(
                    "no Dask scheduler answers",
                    where=workers.scheduler,
                    fix="check --scheduler: an address like tcp://HOST:8786, as dask scheduler prints it",
                ) from fault
            if not told:
                notify(f"no Dask scheduler answers at {workers.scheduler}; waiting for it")
                told = True
            time.sleep(1)


def _dask_losses() -> tuple[type[BaseException], ...]:
    """What the tasks of a cluster end with that has lost their workers, or its scheduler."""
    try:
        from distributed import CancelledError as Cancelled
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker
    except ImportError as fault:
        raise JaxmapError(
            "Dask is not installed, which --scheduler needs", fix="pip install 'jaxmap[cluster]'"
        ) from fault
    return (KilledWorker, Cancelled, CommClosedError, CancelledError)
