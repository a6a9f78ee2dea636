"""Work that runs ahead in threads, in order and bounded."""

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

    The first items are begun at once, before a result is asked for. From then on an item is begun whenever a result is
    taken: results that nobody has taken yet are never more than `ahead`, in the making or waiting, however slow the
    consumer is. What the function raises is raised where the item's result would stand, and ends it all.

    Args:
        function: called in the threads.
        items: read as far as needed, in the thread of the consumer.
        workers: threads.
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
            # The result that is taken gets no name here: it would live on while the next one is waited for.
            pending.extend(pool.submit(function, item) for item in islice(source, 1))
            yield pending.popleft().result()
    finally:
        # Not waited for: the garbage collector may close this generator in one of the pool's own threads,
        # which would wait for itself for ever.
        pool.shutdown(wait=False, cancel_futures=True)
