"""Mapping a function over items in threads, ahead of their use: in order and bounded."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import TypeVar

In = TypeVar("In")
Out = TypeVar("Out")


def prefetch(function: Callable[[In], Out], items: Iterable[In], workers: int, ahead: int) -> Iterator[Out]:
    """Maps a function over items in threads, in order.

    The first items are started at once, before a result is asked for; after that one item is started for each result
    taken. At most `ahead` results are in progress or waiting, however slow the consumer is. An exception of the
    function is raised in place of the item's result, and ends the iteration.

    Args:
        function: called in the threads.
        items: consumed as needed, in the thread of the consumer.
        workers: number of threads.
        ahead: at least 1.
    """
    source = iter(items)
    pool = ThreadPoolExecutor(workers, thread_name_prefix="jaxmap")
    pending = deque(pool.submit(function, item) for item in islice(source, ahead))
    return _in_order(function, source, pool, pending)


def _in_order(
    function: Callable[[In], Out], source: Iterator[In], pool: ThreadPoolExecutor, pending: deque[Future[Out]]
) -> Iterator[Out]:
    try:
        while pending:
            wait((pending[0],))
            # The result gets no name here: a reference would keep it alive while the next one is waited for.
            pending.extend(pool.submit(function, item) for item in islice(source, 1))
            yield pending.popleft().result()
    finally:
        # Without waiting: the garbage collector may close this generator in one of the pool's own threads,
        # which would then wait for itself.
        pool.shutdown(wait=False, cancel_futures=True)
