"""Work over threads: order, bounded memory, exceptions at their turn; what the stages take; shapes."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError

import numpy as np
import pytest

from barsight.core.arrays import expect_shape, kernel
from barsight.core.parallel import in_background, ordered_map, parallel_bands, prefetch, prefetched_chain
from barsight.core.timing import Stopwatch


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_results_keep_the_items_order(workers: int) -> None:
    def later_first(k: int) -> int:
        time.sleep(0.002 * (k % 3 == 0))
        return k * k

    assert list(ordered_map(later_first, range(20), workers)) == [k * k for k in range(20)]
    assert list(ordered_map(later_first, [], workers)) == []


def test_no_more_items_are_taken_than_are_under_way() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for k in range(50):
            taken += 1
            yield k

    for done, result in enumerate(ordered_map(lambda k: k, items(), 3), start=1):
        assert result == done - 1
        assert taken - done <= 3
    assert taken == 50


def test_an_exception_comes_at_its_turn() -> None:
    results = ordered_map(lambda k: 1 / (3 - k), range(6), 4)
    assert [next(results) for _ in range(3)] == [1 / 3, 1 / 2, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_leaving_early_ends_the_threads() -> None:
    before = threading.active_count()
    started: list[int] = []
    results = ordered_map(started.append, range(1000), 2)
    next(results)
    results.close()
    assert threading.active_count() == before
    assert len(started) <= 4


def test_items_are_made_while_others_are_used() -> None:
    made: list[int] = []
    there = threading.Event()

    def items() -> Iterator[int]:
        for k in range(5):
            made.append(k)
            there.set()
            yield k
        raise ZeroDivisionError

    before = threading.active_count()
    ahead = prefetch(items())
    assert next(ahead) == 0
    there.clear()
    assert made == [0, 1] or (there.wait(5) and made == [0, 1])
    assert [next(ahead) for _ in range(4)] == [1, 2, 3, 4]
    with pytest.raises(ZeroDivisionError):
        next(ahead)
    assert threading.active_count() == before
    left = prefetch(iter(range(1000)), count=3)
    assert next(left) == 0
    left.close()
    assert threading.active_count() == before


def each(function: Callable[[int], object]) -> Callable[[int], Iterator[object]]:
    """Yield the only result of an item."""
    return lambda item: iter([function(item)])


def test_results_of_an_item_are_there_before_its_last() -> None:
    taken = threading.Event()

    def two(k: int) -> Iterator[int]:
        yield k
        assert taken.wait(timeout=5)
        yield -k

    with prefetched_chain(two, range(4), max_waiting=2) as results:
        assert next(results) == 0
        taken.set()
        assert list(results) == [0, 1, -1, 2, -2, 3, -3]


def test_leaving_in_the_middle_of_an_item_drops_its_rest() -> None:
    made: list[int] = []

    def many(k: int) -> Iterator[int]:
        for number in range(1000):
            made.append(number)
            time.sleep(0.001)
            yield k

    with prefetched_chain(many, range(3), max_waiting=2) as results:
        next(results)
    assert len(made) < 500
    with pytest.raises(CancelledError):
        next(results)


def test_what_is_begun_goes_on_before_anybody_asks() -> None:
    running, max_at_once, done = 0, 0, threading.Semaphore(0)
    lock = threading.Lock()

    def square(k: int) -> int:
        nonlocal running, max_at_once
        with lock:
            running += 1
            max_at_once = max(max_at_once, running)
        time.sleep(0.005)
        with lock:
            running -= 1
        done.release()
        return k * k

    before = threading.active_count()
    with prefetched_chain(each(square), range(20), max_waiting=5, workers=3) as results:
        assert all(done.acquire(timeout=5) for _ in range(5))
        assert not done.acquire(timeout=0.05)  # the sixth waits until a result is taken
        assert max_at_once == 1
        assert list(results) == [k * k for k in range(20)]
        assert 1 < max_at_once <= 3
    assert threading.active_count() == before


def test_leaving_what_is_begun_drops_the_rest() -> None:
    started: list[int] = []

    def slow(k: int) -> None:
        started.append(k)
        time.sleep(0.02)

    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt), prefetched_chain(each(slow), range(1000), max_waiting=8):
        while not started:
            time.sleep(0.001)
        raise KeyboardInterrupt
    assert started == [0]
    assert threading.active_count() == before


def test_an_exception_of_what_is_begun_comes_at_its_turn() -> None:
    def items() -> Iterator[int]:
        yield from (3, 2, 0, 1)
        raise KeyError("torn")

    with prefetched_chain(each(lambda k: 6 // k), items(), max_waiting=9) as results:
        assert [next(results), next(results)] == [2, 3]
        with pytest.raises(ZeroDivisionError):
            next(results)
    with prefetched_chain(each(lambda k: k), items(), max_waiting=2) as results, pytest.raises(KeyError):
        list(results)


def test_work_beside_a_block_is_done_at_its_end() -> None:
    begun, done = threading.Event(), []

    def work() -> None:
        assert begun.wait(5)
        done.append(1)

    with in_background(work):
        assert done == []
        begun.set()
    assert done == [1]

    def fail() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), in_background(fail):
        done.append(2)
    assert done == [1, 2]


def test_a_stopwatch_adds_up_and_survives_exceptions() -> None:
    watch = Stopwatch()
    for _ in range(2):
        with watch("stereo", frames=1):
            time.sleep(0.01)
    with pytest.raises(RuntimeError), watch("points"):
        raise RuntimeError
    (first, seconds, frames), (second, _, none) = watch.entries()
    assert (first, frames, second, none) == ("stereo", 2, "points", 0)
    assert 0.02 <= seconds < 2


def test_expect_shape() -> None:
    expect_shape("points", np.zeros((5, 3)), (None, 3))
    with pytest.raises(ValueError, match=r"points has shape \(5, 2\), expected Nx3"):
        expect_shape("points", np.zeros((5, 2)), (None, 3))
    with pytest.raises(ValueError, match="expected Nx3"):
        expect_shape("points", np.zeros(3), (None, 3))


@kernel()
def _doubled(value: float) -> float:
    return 2 * value


def test_a_kernel_is_compiled() -> None:
    assert _doubled(1.5) == 3.0
    assert _doubled.signatures  # type: ignore[attr-defined]


def test_bands_cover_every_row_once_from_any_number_of_threads() -> None:
    def count(_: int) -> int:
        rows = np.zeros(1000, dtype=int)

        def work(first: int, end: int) -> None:
            time.sleep(0.0005)
            rows[first:end] += 1

        parallel_bands(work, 1000, 64)
        return int((rows == 1).sum())

    assert list(ordered_map(count, range(8), 4)) == [1000] * 8


def test_an_exception_in_a_band_comes_out() -> None:
    def work(first: int, _: int) -> None:
        if first == 30:
            raise ValueError("row 30")

    with pytest.raises(ValueError, match="row 30"):
        parallel_bands(work, 100, 10)


ALONE = """
import os
import subprocess
import sys
import threading
from barsight.core.parallel import in_background, ordered_map, parallel_bands, prefetch, prefetched_chain
seen = set()
def work(item):
    seen.add(threading.get_ident())
    return item + 1
def items():
    for item in range(4):
        seen.add(threading.get_ident())
        yield item
def fails():
    raise ValueError("torn")
bands = []
parallel_bands(lambda first, end: bands.append(work(first)), 8, 2)
def each(item):
    yield work(item)
with prefetched_chain(each, items(), 3) as mapped, in_background(lambda: work(6)) as late:
    print(list(ordered_map(work, items())), list(prefetch(items())), list(mapped), late.result(), bands)
try:
    with in_background(fails):
        print("the block runs")
except ValueError as error:
    print(error, len(seen))
"""


def test_a_process_of_one_thread_begins_no_other() -> None:
    ended = [
        subprocess.run(
            [sys.executable, "-c", ALONE], env={**os.environ, "NUMBA_NUM_THREADS": threads}, check=True,
            capture_output=True, text=True,
        ).stdout.splitlines()
        for threads in ("1", "2")
    ]  # fmt: skip
    assert ended[0] == [
        "[1, 2, 3, 4] [0, 1, 2, 3] [1, 2, 3, 4] 7 [1, 3, 5, 7]", "the block runs", "torn 1",
    ]  # fmt: skip
    assert ended[0][1] == ended[1][1] and ended[1][2] != "torn 1"


FORKED = """
import os
import time
import weakref
import numba
import numpy as np
from barsight.core.arrays import kernel
from barsight.core.parallel import parallel_bands
@kernel(parallel=True)
def doubled(values):
    out = np.empty_like(values)
    for i in numba.prange(len(values)):
        out[i] = 2 * values[i]
    return out
class Rows:
    pass
def is_freed():
    rows = Rows()
    parallel_bands(lambda first, end, rows=rows: None, 8, 2)
    kept = weakref.ref(rows)
    del rows
    for _ in range(500):
        if kept() is None:
            return True
        time.sleep(0.01)
    return False
values = np.arange(100.0)
assert (doubled(values) == 2 * values).all() and is_freed()
if child := os.fork():
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
else:
    os._exit(int(not ((doubled(values) == 2 * values).all() and is_freed())))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_works_and_keeps_nothing() -> None:
    """`multiprocessing.Pool` forks notebooks: OpenMP ended such a worker, and each pair stayed in memory."""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2"}
    ended = subprocess.run([sys.executable, "-c", FORKED], env=environment, capture_output=True, text=True)
    assert ended.stdout == "0\n", ended.stderr
