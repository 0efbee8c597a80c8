"""Spread work over threads with its order kept and its memory bounded; where NUMBA_NUM_THREADS is 1, no other
thread is begun.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import chain
from queue import SimpleQueue
from threading import Event, Semaphore
from typing import Generic, NamedTuple, TypeVar, cast

import cv2
import numba

Item = TypeVar("Item")
Result = TypeVar("Result")
Taken = TypeVar("Taken")

WORKERS = 2
"""Number of items processed side by side: a user's number of cores."""


def ordered_map(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int = WORKERS
) -> Iterator[Result]:
    """Map over a pool of threads: results in the items' order, at most workers + 1 items under way.

    For functions that release the interpreter (OpenCV, compiled kernels). An exception of the function comes
    out at its item's turn; leaving the loop early waits for the items under way and drops the rest.
    """
    if _is_alone():
        yield from map(function, items)
        return
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


@contextmanager
def prefetched_chain(
    function: Callable[[Item], Iterable[Result]], items: Iterable[Item], max_waiting: int,
    workers: int = WORKERS,
) -> Iterator[Iterator[Result]]:  # fmt: skip
    """Chain what a function yields of each item, in the items' order: one thread begins at once, beside
    whatever the caller does first; from the first result asked for on there are all workers.

    At most `max_waiting` items are under way or wait, beside the one whose results are being taken, each as
    soon as it is there. An exception of the function or the items comes out at its turn; leaving waits for
    the results under way and drops the rest.
    """
    if _is_alone():
        yield chain.from_iterable(map(function, items))
        return
    work = _ChainWork(function, items, max_waiting, workers)
    try:
        yield work.results()
    finally:
        work.leave()


class _Queued(NamedTuple, Generic[Result]):
    """Results of an item so far, followed by None, and a function that raises the exception that ended
    them.
    """

    done: Future[None]
    found: SimpleQueue[tuple[Result] | None]


class _ChainWork(Generic[Item, Result]):
    """Threads of a `prefetched_chain`: one reads the items, the others work on them."""

    def __init__(
        self, function: Callable[[Item], Iterable[Result]], items: Iterable[Item], max_waiting: int,
        workers: int,
    ) -> None:  # fmt: skip
        self._function, self._items, self._workers = function, items, workers
        self._at_once, self._room, self._left = Semaphore(1), Semaphore(max_waiting - 1), Event()
        self._begun: SimpleQueue[_Queued[Result] | None] = SimpleQueue()
        self._pool, self._reader = ThreadPoolExecutor(workers), ThreadPoolExecutor(1)
        self._reading = self._reader.submit(self._read)

    def results(self) -> Iterator[Result]:
        """Yield the results; from now on all workers work."""
        self._at_once.release(self._workers)
        while (item := self._taken(self._begun)) is not None:
            self._room.release()
            while (result := self._taken(item.found)) is not None:
                yield result[0]
            item.done.result()
        self._reading.result()

    def leave(self) -> None:
        """Wait for the results under way and drop the rest."""
        self._left.set()
        self._room.release()
        self._reader.shutdown(wait=True, cancel_futures=True)
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _read(self) -> None:
        try:
            for item in self._items:
                found: SimpleQueue[tuple[Result] | None] = SimpleQueue()
                self._begun.put(_Queued(self._pool.submit(self._work, item, found), found))
                self._room.acquire()  # before the next item takes memory
                if self._left.is_set():
                    return
        finally:
            self._begun.put(None)

    def _work(self, item: Item, found: SimpleQueue[tuple[Result] | None]) -> None:
        try:
            with self._at_once:
                for result in () if self._left.is_set() else self._function(item):
                    found.put((result,))
                    if self._left.is_set():
                        return
        finally:
            found.put(None)

    def _taken(self, queue: SimpleQueue[Taken]) -> Taken:
        if self._left.is_set():
            raise CancelledError
        return queue.get()


def prefetch(items: Iterable[Item], count: int = 1) -> Iterator[Item]:
    """Prefetch the next `count` items in a thread while one is used; the order is kept.

    An exception of the items comes out at its turn; leaving early waits for the item under way.
    """
    if _is_alone():
        yield from items
        return
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


@contextmanager
def in_background(work: Callable[[], Result]) -> Iterator[Future[Result]]:
    """Run `work` in a background thread while the block under it runs; what it raises comes out where its
    result is asked for, at the latest at the block's end.
    """
    if _is_alone():
        done = Future[Result]()
        try:
            done.set_result(work())
        except Exception as error:
            done.set_exception(error)
        yield done
        done.result()
        return
    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(work)
        yield working
        working.result()


@contextmanager
def single_opencv_thread() -> Iterator[None]:
    """Keep OpenCV on the calling thread: if frames are processed side by side, its own threads only spin
    and wait.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _is_alone() -> bool:
    """Check whether this process has a single thread, as each of several that share the cores has."""
    return bool(numba.config.NUMBA_NUM_THREADS == 1)


def parallel_bands(work: Callable[[int, int], None], rows: int, band_rows: int) -> None:
    """Call `work(first, end)` for every band of `rows` rows, on all cores at once; bands may not depend on
    each other.

    For compiled kernels, which release the interpreter: plain ones compile in a fraction of the time of
    parallel ones, and calls from several threads needn't take turns. The caller works along, so that it never
    waits for a thread that is busy elsewhere.
    """
    firsts = iter(range(0, rows, band_rows))

    def take() -> None:
        for first in firsts:
            work(first, min(rows, first + band_rows))

    helpers = [_helpers().submit(take) for _ in range(numba.get_num_threads() - 1)]
    try:
        take()
    finally:
        for helper in helpers:
            if not helper.cancel():
                helper.result()


@cache
def _helpers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(numba.config.NUMBA_NUM_THREADS - 1, 1), thread_name_prefix="bands")


if hasattr(os, "register_at_fork"):
    # A fork has none of these threads: what is handed to them would be kept for good.
    os.register_at_fork(after_in_child=_helpers.cache_clear)
