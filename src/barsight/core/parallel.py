"""Work spread over threads with its order kept and its memory bounded."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar, cast

Item = TypeVar("Item")
Result = TypeVar("Result")


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """`map` over a pool of threads: results in the items' order, at most workers + 1 items under way.

    For functions that release the interpreter (OpenCV, compiled kernels). An exception of the function comes
    out at its item's turn; leaving the loop early waits for the items under way and drops the rest.
    """
    pool = ThreadPoolExecutor(workers)
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def read_ahead(items: Iterable[Item], count: int = 1) -> Iterator[Item]:
    """The items in order, the next `count` of them made in a thread of their own while one is used.

    An exception of the items comes out at its turn; leaving early waits for the item under way.
    """
    end = object()
    pool = ThreadPoolExecutor(1)
    source = iter(items)

    def following() -> Item | object:
        return next(source, end)

    waiting = deque(pool.submit(following) for _ in range(count))
    try:
        while (item := waiting.popleft().result()) is not end:
            waiting.append(pool.submit(following))
            yield cast(Item, item)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
