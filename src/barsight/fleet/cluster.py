"""Run tasks on Dask: a cluster of local processes, or one with a given scheduler."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from barsight.core.errors import ConfigError, InputError
from barsight.core.extras import extra
from barsight.fleet.limits import thread_variables

with extra("fleet"):
    import dask
    from distributed import CancelledError, Client, LocalCluster, as_completed

T = TypeVar("T")
_LOST = 1000
"""Number of worker deaths that Dask accepts for a task: killed machines are no fault of it; the ledger counts
them as well.
"""
AHEAD = 4
"""Number of tasks queued at the scheduler for each worker, however many are planned."""
LOOK_S = 0.5
"""Interval in seconds at which new workers and an opened window are noticed."""


@contextmanager
def connect(workers: int, scheduler: str | None, threads: int = 0) -> Iterator[Any]:
    """Provide a client of the cluster at `scheduler`, or of one with `workers` processes that ends with it.

    threads: of the kernels in each local process; 0 leaves them unchanged.

    Raises ConfigError for an invalid address, InputError for a scheduler that doesn't answer.
    """
    for name in ("distributed", "distributed.client"):  # each has its own level; relevant errors are raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    options = {
        "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",
        "distributed.scheduler.allowed-failures": _LOST, "distributed.worker.daemon": False,
        "distributed.worker.memory.terminate": False, "distributed.worker.memory.pause": False,
        "distributed.worker.memory.spill": False, "distributed.worker.memory.target": False,
    }  # fmt: skip
    with dask.config.set(options):
        if scheduler is not None:
            if re.fullmatch(r"(tcp|tls)://[^:/]+:\d{1,5}", scheduler) is None:
                raise ConfigError(f"--scheduler {scheduler}: is not an address; write tcp://HOST:8786")
            try:
                client = Client(scheduler, timeout=20, set_as_default=False)
            except (OSError, ValueError) as error:
                raise InputError(scheduler, "no scheduler answers there", "start dask scheduler") from error
            with client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0",
                host="127.0.0.1", memory_limit=0, env=thread_variables(threads),
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):  # fmt: skip
            yield client


def slots(client: Any) -> int:
    """Count the threads of the current workers, at least 1."""
    threads: dict[str, int] = client.nthreads()
    return max(1, sum(threads.values()))


def run_all(
    client: Any, run: Callable[[Any, Any], T], tasks: Iterable[Any], settings: Any,
    may_go_on: Callable[[], bool] = lambda: True, ahead: int = AHEAD,
) -> Iterator[T | None]:  # fmt: skip
    """Run tasks in their order, `ahead` per worker at a time; yield each result as it ends, None for a lost
    task.

    may_go_on: called before each task, and again while others run; if it returns False and nothing runs, the
    rest is left. Raises a task's exception, InputError if the scheduler is gone.
    """
    waiting = iter(tasks)
    running = as_completed(loop=client.loop)
    is_more = True
    while True:
        with _translated_errors(client):
            while is_more and running.count() < ahead * slots(client) and may_go_on():
                task = next(waiting, None)
                is_more = task is not None
                if is_more:
                    running.add(client.submit(_ended, run, task, settings, pure=False, retries=0))
        if running.is_empty():
            return
        with running.thread_condition:
            if not running.has_ready():
                running.thread_condition.wait(LOOK_S)
        while running.has_ready():
            future = next(running)
            with _translated_errors(client):
                ended = future.result() if future.status == "finished" else None
            if isinstance(ended, Exception):
                raise ended
            yield ended
            future.release()


@contextmanager
def _translated_errors(client: Any) -> Iterator[None]:
    """Turn the errors that Dask raises after its scheduler has died into one line."""
    address = client.scheduler.address if client.scheduler else "the scheduler"
    try:
        yield
    except (OSError, CancelledError) as error:
        raise InputError(address, "no scheduler is there any more", "start it, then the run again") from error


def _ended(run: Callable[[Any, Any], T], task: Any, settings: Any) -> T | Exception:
    """Run a task on a worker and return its exception: if it were raised, Dask would log it, and it would
    look like that of a dead worker.
    """
    try:
        return run(task, settings)
    except Exception as error:
        return error
