"""Workers that compute: processes of this machine, or a Dask cluster that is already there. The same code drives both.

Needs the extra `cluster`. Rows are equal wherever they are made only if the packages and the threads of the numeric
libraries are, and so a worker that has others is refused.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import socket
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from cdpipe.core.errors import InputError
from cdpipe.core.threads import THREAD_VARIABLES, THREADS, fix_threads
from eval.core.provenance import versions

# Dask has its workers give every freed array back to the system at once, which costs a quarter of the time of a pair.
_ENVIRONMENT, _TRIM = "distributed.nanny.pre-spawn-environ", "MALLOC_TRIM_THRESHOLD_"
_PROBE_S, _CONNECT_S = 3.0, 6.0  # together less than ten seconds until an address that does not answer is named


@dataclass(frozen=True, slots=True)
class Where:
    """Where to compute: here if both are left out."""

    workers: int | None = None
    scheduler: str | None = None


HERE = Where()


def require_usable(where: Where) -> None:
    """Check what can be checked before anything is written.

    Raises:
        InputError: Both are named, or the extra is not installed.
    """
    if where.workers is not None and where.scheduler is not None:
        raise InputError("--workers and --scheduler: a scheduler has workers of its own; leave one of them out")
    if where == HERE:
        return
    if importlib.util.find_spec("distributed") is None:
        asked = "--workers" if where.scheduler is None else "--scheduler"
        raise InputError(f"{asked} needs a package more: pip install 'tunnelcd[cluster]'")


def require_reachable(where: Where) -> None:
    """Knock at the scheduler that is named, if one is; quick, so that it can be done before anything slow is loaded.

    Raises:
        InputError: Nobody answers there, or something that is no scheduler.
    """
    if where.scheduler is None:
        return
    try:
        _probe(where.scheduler)
    except (OSError, ValueError) as error:
        raise _unreachable(where.scheduler, error) from error


@contextmanager
def connected(where: Where, n_tasks: int) -> Iterator[Any]:
    """Yield a Dask client of the scheduler named, or of as many worker processes here, but no more than tasks.

    Raises:
        InputError: The scheduler cannot be reached, has no workers, or one of them is not like this process.
    """
    with _of_scheduler(where.scheduler) if where.scheduler is not None else _of_this_machine(where, n_tasks) as client:
        yield client


def n_slots(client: Any) -> int:
    """Return how many tasks the workers compute at a time, all together."""
    return sum(client.nthreads().values())


def is_shared(client: Any) -> bool:
    """Tell whether any machine of the cluster computes more than one task at a time."""
    slots: Counter[str | None] = Counter()
    for address, n_threads in client.nthreads().items():
        slots[urlsplit(address).hostname] += n_threads
    return max(slots.values(), default=0) > 1


@contextmanager
def _of_this_machine(where: Where, n_tasks: int) -> Iterator[Any]:
    import dask  # noqa: PLC0415 - an extra, and slow to import
    from distributed import Client, LocalCluster  # noqa: PLC0415 - as above

    fix_threads()
    environment = {name: value for name, value in dask.config.get(_ENVIRONMENT).items() if name != _TRIM}
    settings = {
        "n_workers": min(where.workers or 1, n_tasks),
        "threads_per_worker": 1,
        "dashboard_address": ":0",  # any free port: two runs may go on side by side
        "memory_limit": None,
        "silence_logs": logging.CRITICAL,
        # Ctrl-C reaches every process of the terminal: workers leave it to this one, which ends them
        "preload": [__name__],
    }
    with dask.config.set({_ENVIRONMENT: environment}), LocalCluster(**settings) as cluster, Client(cluster) as client:
        yield client


@contextmanager
def _of_scheduler(address: str) -> Iterator[Any]:
    from distributed import Client  # noqa: PLC0415 - as above

    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is told in one line
    try:
        _probe(address)
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, MemoryError) as error:  # the last where what answers speaks another language
        raise _unreachable(address, error) from error
    with client:
        if not client.nthreads():
            raise InputError(f"--scheduler {address}: has no workers: start some with `dask worker {address}`")
        _require_alike(client, address)
        yield client


def _probe(address: str) -> None:
    """Knock where a scheduler should be: Dask itself goes on trying where nobody answers.

    Raises:
        OSError: Nobody answers.
        ValueError: It is no address.
    """
    parts = urlsplit(address)
    if parts.scheme in ("tcp", "tls"):
        if not parts.hostname or not parts.port:
            raise ValueError("no host or no port")
        with socket.create_connection((parts.hostname, parts.port), timeout=_PROBE_S) as knocked:
            # a scheduler speaks first; what accepts and says nothing would hold Dask until its time is up
            if parts.scheme == "tcp" and not knocked.recv(1):
                raise OSError("what listens there is no scheduler")


def _unreachable(address: str, error: Exception) -> InputError:
    told = str(error) or "it is no Dask scheduler"
    return InputError(
        f"--scheduler {address}: cannot be reached ({told}): expected tcp://HOST:PORT of a running `dask scheduler`"
    )


def dask_setup(worker: object) -> None:
    """Let a worker of this machine ignore Ctrl-C; Dask calls this in each that it starts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _about() -> tuple[Mapping[str, str], Mapping[str, str]]:
    """Return the versions and the threads of the process that runs this."""
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
