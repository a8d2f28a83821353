"""Tasks run sequentially in this process, or distributed by Dask over processes and machines."""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeVar

from ..models.config.errors import UserError
from .progress import Update

T = TypeVar("T")
_ATTEMPTS = 3
_PATIENCE = 5.0  # s for a scheduler to answer


@dataclass(frozen=True)
class Failed:
    """A task that raised, or whose worker died in every attempt."""

    task: Any
    reason: str


def run_here(
    work: Callable[[T, Update], None], tasks: Sequence[T], progress: Update
) -> list[Failed]:
    """Run tasks in this process, one by one; an error is recorded and the next task started.

    Raises:
        UserError: bad input; the later tasks are not run.
    """
    failed = []
    for number, task in enumerate(tasks):

        def report(fraction: float, remark: str = "", /, done: int = number) -> None:
            progress((done + fraction) / len(tasks), remark)

        report(0.0, str(task))
        try:
            work(task, report)
        except UserError:
            raise
        except Exception as error:  # noqa: BLE001 - other tasks don't depend on it
            failed.append(Failed(task, f"{type(error).__name__}: {error}"))
    return failed


def check_workers(address: str | None, workers: int) -> None:
    """Check that the workers are available, before any file is written.

    Raises:
        UserError: Dask is not installed, nothing answers at the address, a negative number, or both
            an address and a number.
    """
    if workers < 0:
        raise UserError(f"--workers {workers}: give 0 for this process, or a number of processes")
    if address is not None and workers > 0:
        raise UserError("--workers: the scheduler of --cluster has its own; leave one out")
    if workers > 0:
        _distributed()
    if address is not None:
        with _client(address, 0):
            return


def run_on_cluster(
    work: Callable[[T], None],
    tasks: Sequence[T],
    progress: Update,
    *,
    address: str | None = None,
    workers: int = 2,
) -> list[Failed]:
    """Run tasks on the scheduler at `address`, or on `workers` new processes of this machine.

    A task whose worker dies is restarted on another one, as often as the scheduler allows, in three
    attempts; other tasks are not affected. `work` must be importable on the workers, which need
    access to the same files as this process.

    Raises:
        UserError: Dask is not installed, nothing answers at the address, or bad input.
    """
    with _client(address, workers) as client:
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        left = {client.submit(work, task, pure=False): (task, 1) for task in tasks}
        finished, failed = 0, []
        try:
            waiting = as_completed(list(left), loop=client.loop)
            for future in waiting:
                task, attempt = left.pop(future)
                error = future.exception()
                if isinstance(error, KilledWorker) and attempt < _ATTEMPTS:
                    again = client.submit(work, task, pure=False)
                    left[again] = (task, attempt + 1)
                    waiting.add(again)
                    continue
                if isinstance(error, UserError):
                    raise error
                if error is not None:
                    failed.append(Failed(task, f"{type(error).__name__}: {error}"))
                finished += 1
                progress(finished / len(tasks), f"{finished} of {len(tasks)} tasks, last: {task}")
        finally:
            client.cancel(list(left))
    return failed


@contextmanager
def _client(address: str | None, workers: int) -> Iterator[Any]:
    distributed = _distributed()
    Client, LocalCluster = distributed.Client, distributed.LocalCluster
    if address is not None:
        try:
            asyncio.run(_greet(address))  # a Client that fails would close itself for 10 s more
            client = Client(address, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise UserError(
                f"--cluster {address}: no scheduler answers there; start one with "
                "`dask scheduler` and give the address that it prints"
            ) from error
        with client:
            yield client
        return
    with (
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",  # a free port, on this machine alone
            memory_limit=0,
            host="127.0.0.1",
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


async def _greet(address: str) -> None:
    """Connect to a process of Dask and leave it again.

    Raises:
        OSError: none answers there.
        ValueError: the address has another form.
    """
    from distributed import Security
    from distributed.comm.core import connect

    given = Security().get_connection_args("client")  # as a Client takes them
    comm = await asyncio.wait_for(connect(address, timeout=_PATIENCE, **given), _PATIENCE)
    await comm.close()


def _distributed() -> ModuleType:
    try:
        import distributed
    except ImportError as error:
        raise UserError(
            "a cluster needs Dask, which is not installed: pip install 'spinndrift[cluster]'"
        ) from error
    return distributed
