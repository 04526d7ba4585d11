"""Work on a Dask cluster: two processes of this machine, or the scheduler that a user has."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from servo_daemon.errors import BadInputError, ServoDaemonError
from servo_daemon.fleet.units import Unit

if TYPE_CHECKING:
    from distributed import Client

log = logging.getLogger(__name__)

#: Units sent ahead for each thread of the cluster: a worker that is done has the next one already, and a million units
#: are not a million tasks in the scheduler's memory.
_AHEAD = 4
#: A unit is tried again when the worker that had it died; after so many deaths it is given up.
_DEATHS = 1
_CONNECT_S = 10.0

#: What is done with a unit, given what was asked: a document of plain values.
Work = Callable[[Unit, tuple[str, ...]], dict[str, Any]]


def scheduler(address: str, timeout_s: float = _CONNECT_S) -> Client:
    """A client of a scheduler, such as that at "tcp://host:8786"; Dask is installed.

    Raises:
        BadInputError: none answers there in that time.
    """
    from distributed import Client
    from distributed.comm.addressing import get_address_host_port

    try:
        get_address_host_port(address)  # a client of what is no address is left half open
        return Client(address, timeout=timeout_s, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise BadInputError(f"--dask {address}: no scheduler answers there (tcp://host:8786): {error}") from error


@contextmanager
def cluster(address: str | None, workers: int | None = None) -> Iterator[Client]:
    """A client of a scheduler, or of a cluster of processes on this machine that ends with it.

    Raises:
        BadInputError: no scheduler answers there.
        ServoDaemonError: Dask is not installed.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError:
        raise ServoDaemonError("fleet needs Dask: pip install 'servo-daemon[dask]'") from None
    dask.config.set({"distributed.scheduler.allowed-failures": _DEATHS})
    logging.getLogger("distributed").setLevel(logging.WARNING)  # it tells of every connection
    if address is not None:
        with scheduler(address) as client:
            if not client.nthreads():
                log.warning("the scheduler at %s has no worker yet: waiting for the first", address)
            yield client
        return
    logging.getLogger("distributed").setLevel(logging.ERROR)  # workers that are ended in the middle of their work
    # Estimation computes in one thread; several that share a core wait for each other.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    _spare_workers()
    with ExitStack() as stack:
        with _interrupts_ignored():
            local = LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers or os.cpu_count() or 1,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",  # None: port 8787, which two of them on a machine cannot both have
                silence_logs=logging.ERROR,  # workers that are interrupted warn of every task
            )
            stack.enter_context(local)
        yield stack.enter_context(Client(local, set_as_default=False))  # type: ignore[no-untyped-call]


def _spare_workers() -> None:
    """Workers of this machine keep freed memory as any process does, and are not watched at work. (By Dask's default
    they give it back at once and get it from the system again for the next array, half of the time of fits of 20 s, and
    note a hundred times a second where they are: half a megabyte a fit, for an hour.)
    """
    import dask

    key = "distributed.nanny.pre-spawn-environ"
    kept = {name: value for name, value in dask.config.get(key).items() if name != "MALLOC_TRIM_THRESHOLD_"}
    dask.config.set({key: kept, "distributed.worker.profile.enabled": False})


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes that begin now leave Ctrl-C, which a terminal sends to all, to this one, which ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def results(
    client: Client, units: Sequence[Unit], work: Work, asked: tuple[str, ...]
) -> Iterator[tuple[Unit, dict[str, Any]]]:
    """What came of each unit, as they are done. One that its workers died of gives `{"error": …}`.

    The scheduler blames every task that a dying worker had, so those are tried once more, one at a time.
    """
    threads = max(1, sum(client.nthreads().values()))  # type: ignore[no-untyped-call]
    blamed = []
    for unit, future in _done(client, units, work, asked, _AHEAD * threads):
        if type(future.exception()).__name__ == "KilledWorker":
            blamed.append(unit)
        else:
            yield unit, _document(future)
    for unit, future in _done(client, blamed, work, asked, 1):
        yield unit, _document(future)


def _done(
    client: Client, units: Sequence[Unit], work: Work, asked: tuple[str, ...], ahead: int
) -> Iterator[tuple[Unit, Any]]:
    """Finished futures, with at most so many units under way."""
    from distributed import as_completed

    waiting = iter(units)
    running: dict[Any, Unit] = {}
    done = as_completed(loop=client.loop)  # type: ignore[no-untyped-call]

    def send() -> None:
        unit = next(waiting, None)
        if unit is not None:
            future = client.submit(work, unit, asked, pure=False)
            running[future.key] = unit
            done.add(future)  # type: ignore[no-untyped-call]

    for _ in range(ahead):
        send()
    for future in done:
        yield running.pop(future.key), future
        future.release()
        send()


def _document(future: Any) -> dict[str, Any]:
    error = future.exception()
    if error is not None:
        return {"error": f"{type(error).__name__}: {error}"}
    document: dict[str, Any] = future.result()
    return document
