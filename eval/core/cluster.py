"""Dask workers: processes of this machine, or a running cluster; the same code uses both. Needs the extra `cluster`.

Rows are equal on all workers only if packages and threads of the numeric libraries are equal. A worker with others is
refused.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import socket
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

from cdpipe.core.errors import InputError
from cdpipe.core.threads import THREAD_VARIABLES, THREADS, fix_threads
from eval.core.exposure import is_loopback
from eval.core.provenance import versions
from eval.core.terminal.interrupts import interrupts_held

# By this variable Dask's workers return freed memory to the system at once, which takes a quarter of a pair's time.
_ENVIRONMENT, _TRIM = "distributed.nanny.pre-spawn-environ", "MALLOC_TRIM_THRESHOLD_"
_SCRATCH, _LOOPBACK = "temporary-directory", "127.0.0.1"
_PROBE_S, _CONNECT_S = 3.0, 6.0  # an unreachable address is reported within ten seconds


@dataclass(frozen=True, slots=True)
class Where:
    """Where to compute; in this process if both are None."""

    workers: int | None = None
    scheduler: str | None = None


HERE = Where()


def require_usable(where: Where) -> None:
    """Check the options before anything is written.

    Raises:
        InputError: Both options are given, or the extra is not installed.
    """
    if where.workers is not None and where.scheduler is not None:
        raise InputError("--workers and --scheduler: a scheduler has its own workers: leave one of the two out")
    if where == HERE:
        return
    if importlib.util.find_spec("distributed") is None:
        asked = "--workers" if where.scheduler is None else "--scheduler"
        raise InputError(f"{asked}: Dask is not installed: pip install 'tunnelcd[cluster]'")


def require_reachable(where: Where) -> None:
    """Try to reach the scheduler, if one is named; fast enough to run before slow imports.

    Raises:
        InputError: Nothing answers, or something that is no scheduler.
    """
    if where.scheduler is None:
        return
    try:
        _probe(where.scheduler)
    except (OSError, ValueError) as error:
        raise _unreachable(where.scheduler, error) from error


def exposure(where: Where) -> str:
    """Return a warning where other machines may reach the scheduler without a certificate, "" where they may not."""
    if where.scheduler is None or where.scheduler.startswith("tls://") or is_loopback(_host(where.scheduler)):
        return ""
    return (
        f"--scheduler {where.scheduler}: who reaches this port can run code on the scheduler, its workers and here: "
        "use tls:// (eval/running/RUNNING.md tells how), or a network in which you trust everybody"
    )


@contextmanager
def connected(where: Where, n_tasks: int) -> Iterator[Any]:
    """Yield a Dask client of the named scheduler, or of local worker processes, at most one per task.

    Raises:
        InputError: The scheduler cannot be reached, has no workers, or goes away, also within the block; a worker
            differs from this process; or several workers end during one task.
    """
    from distributed import KilledWorker  # noqa: PLC0415 - an extra, and slow to import

    try:
        with _of_scheduler(where.scheduler) if where.scheduler else _of_this_machine(where, n_tasks) as client:
            yield client
    except KilledWorker as error:
        raise InputError(
            "several workers ended during one task; what is finished is kept: go on without them"
        ) from error
    except (CancelledError, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # of a file; those of Dask have no number
        raise InputError(
            "the scheduler went away; what is finished is kept, the same command goes on from there"
        ) from error


def n_slots(client: Any) -> int:
    """Return how many tasks all workers compute at a time."""
    return sum(client.nthreads().values())


def is_shared(client: Any) -> bool:
    """Return whether any machine of the cluster computes more than one task at a time."""
    slots: Counter[str | None] = Counter()
    for address, n_threads in client.nthreads().items():
        slots[urlsplit(address).hostname] += n_threads
    return max(slots.values(), default=0) > 1


@contextmanager
def _of_this_machine(where: Where, n_tasks: int) -> Iterator[Any]:
    import dask  # noqa: PLC0415 - an extra, and slow to import
    from distributed import Client  # noqa: PLC0415 - as above

    fix_threads()
    _silence_dask()
    environment = {name: value for name, value in dask.config.get(_ENVIRONMENT).items() if name != _TRIM}
    settings = {
        "n_workers": min(where.workers or 1, n_tasks),
        "threads_per_worker": 1,
        "host": _LOOPBACK,  # whoever reaches a port can run code
        # any free port, so that two runs can work at the same time; unless told, older workers listen everywhere
        "dashboard_address": f"{_LOOPBACK}:0",
        "worker_dashboard_address": f"{_LOOPBACK}:0",
        "memory_limit": None,
        "silence_logs": logging.CRITICAL,
    }
    # workers search their scratch folder for packages: it must not be one that another user may have made
    with (
        TemporaryDirectory(prefix="tunnelcd-", ignore_cleanup_errors=True) as scratch,
        dask.config.set({_ENVIRONMENT: environment, _SCRATCH: scratch}),
        _safe_path(),
        _started_workers(settings) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def _started_workers(settings: Mapping[str, Any]) -> Iterator[Any]:
    from distributed import LocalCluster  # noqa: PLC0415 - as above

    with ExitStack() as started:
        try:
            with interrupts_held():
                cluster = started.enter_context(LocalCluster(**settings))
        except (RuntimeError, TimeoutError) as error:
            raise InputError(
                "--workers: a process ended while it started, or took too long: run the same command again, perhaps "
                "with fewer workers"
            ) from error
        yield cluster


def _silence_dask() -> None:
    """Let Dask write no log of this process: its errors are one line of ours."""
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let Python processes that are started meanwhile not begin with the working folder on their path."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]


@contextmanager
def _of_scheduler(address: str) -> Iterator[Any]:
    from distributed import Client  # noqa: PLC0415 - as above
    from distributed.security import Security  # noqa: PLC0415 - as above

    _silence_dask()
    try:
        _probe(address)
        if address.startswith("tls://") and Security().get_connection_args("client")["ssl_context"] is None:
            raise ValueError("Dask's settings name no certificate: eval/running/RUNNING.md tells which it needs")
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, MemoryError) as error:  # MemoryError: the peer speaks another protocol
        raise _unreachable(address, error) from error
    with client:
        if not client.nthreads():
            raise InputError(f"--scheduler {address}: has no workers: start some with `dask worker {address}`")
        _require_alike(client, address)
        yield client


def _probe(address: str) -> None:
    """Open a connection to a scheduler: Dask itself would retry where nothing answers.

    Raises:
        OSError: Nothing answers.
        ValueError: The address is malformed.
    """
    parts = urlsplit(address)
    if parts.scheme in ("tcp", "tls"):
        if not parts.hostname or not parts.port:
            raise ValueError("no host or no port")
        with socket.create_connection((parts.hostname, parts.port), timeout=_PROBE_S) as knocked:
            # a scheduler sends first; Dask would wait for its full timeout on a silent peer
            if parts.scheme == "tcp" and not knocked.recv(1):
                raise OSError("what listens there is no scheduler")


def _host(address: str) -> str:
    try:
        return urlsplit(address).hostname or ""
    except ValueError:
        return ""


def _unreachable(address: str, error: Exception) -> InputError:
    told = str(error) or "it is no Dask scheduler"
    return InputError(
        f"--scheduler {address}: cannot be reached ({told}): expected tcp://HOST:PORT of a running `dask scheduler`"
    )


def _about() -> tuple[Mapping[str, str], Mapping[str, str]]:
    """Return package versions and thread settings of the process that runs this."""
    return versions(), {name: os.environ.get(name, "unset") for name in THREAD_VARIABLES[:3]}


def _require_alike(client: Any, address: str) -> None:
    fix_threads()
    try:
        told = client.run(_about)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"--scheduler {address}: its workers cannot load tunnelcd ({error}): install the same version there"
        ) from error
    ours, our_threads = _about()
    for worker, (theirs, threads) in told.items():
        unlike = [f"{name} {theirs.get(name)}, not {ours[name]}" for name in ours if theirs.get(name) != ours[name]]
        if unlike:
            raise InputError(f"{worker}: has {', '.join(unlike)}: rows would not be equal; install the same there")
        unlike = [f"{name}={our_threads[name]}" for name in our_threads if threads[name] != our_threads[name]]
        if unlike:
            raise InputError(
                f"{worker}: its numeric libraries use other threads: start it with {' '.join(unlike)}, as "
                f"`dask worker` does by itself for {THREADS} thread unless --no-nanny is given"
            )
