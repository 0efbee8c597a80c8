"""Run tasks on Dask: a cluster of this machine's processes, or one whose scheduler is named."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from barsight.core.errors import ConfigError, InputError, OutputError
from barsight.core.extras import extra
from barsight.fleet.limits import thread_variables

with extra("fleet"):
    import dask
    from distributed import Client, LocalCluster, as_completed

T = TypeVar("T")
_LOST = 1000
"""Deaths of workers that a task may see: killed machines are no fault of it; the ledger counts them too."""
AHEAD = 4
"""Tasks that wait at the scheduler for each worker; no more are held there, however many are planned."""


@contextmanager
def connect(workers: int, scheduler: str | None, threads: int = 0) -> Iterator[Any]:
    """Lend a client of the cluster at `scheduler`, or of one of so many processes that ends with it.

    threads: of the kernels in each process of this machine; 0 leaves it alone.

    Raises InputError for a scheduler that doesn't answer.
    """
    logging.getLogger("distributed").setLevel(logging.ERROR)
    options = {
        "distributed.scheduler.allowed-failures": _LOST, "distributed.worker.daemon": False,
        "distributed.worker.memory.terminate": False, "distributed.worker.memory.pause": False,
        "distributed.worker.memory.spill": False, "distributed.worker.memory.target": False,
    }  # fmt: skip
    with dask.config.set(options):
        if scheduler is not None:
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
    """Count the threads of the workers that are there now, at least 1."""
    threads: dict[str, int] = client.nthreads()
    return max(1, sum(threads.values()))


def run_all(
    client: Any, run: Callable[[Any, Any], T], tasks: Iterable[Any], settings: Any,
    may_go_on: Callable[[], bool] = lambda: True,
) -> Iterator[T | None]:  # fmt: skip
    """Run tasks in their order, a few ahead of the workers, and yield what each returns as it ends; None for
    one that was lost. may_go_on: asked before each; where it refuses, what runs is waited for.

    Raises what a task raised where another try would too: ConfigError and OutputError.
    """
    waiting = iter(tasks)
    running = as_completed(loop=client.loop)
    count = 0

    def submit_more() -> int:
        added = 0
        while count + added < AHEAD * slots(client) and may_go_on():
            task = next(waiting, None)
            if task is None:
                break
            running.add(client.submit(run, task, settings, pure=False, retries=0))
            added += 1
        return added

    count += submit_more()
    while count:
        future = next(running)
        count -= 1
        error = future.exception() if future.status == "error" else None
        if isinstance(error, ConfigError | OutputError):
            raise error
        yield future.result() if future.status == "finished" else None
        future.release()
        count += submit_more()
