"""Dask clusters for simulations: local worker processes, or an external scheduler."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import current_process, get_all_start_methods, get_context
from threading import current_thread, main_thread
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim.errors import ParameterError, SimulationError

if TYPE_CHECKING:
    from distributed import Client, Security

__all__ = ["WorkerStates", "check_installed", "dask_setup", "open_client"]

#: Timeout of a scheduler, seconds.
SCHEDULER_S = 10.0
#: Seconds after which a task of a paused worker is sent to another worker; workers report about once per second.
PAUSED_S = 10.0
#: Memory limits of local workers. A worker that dask pauses may wait forever for memory that a metric occupies; a terminated
#: worker restarts without it.
MEMORY_SETTINGS: dict[str, Any] = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
}
#: Local workers are forked from a process that has imported their modules: a new interpreter takes seconds. The first of these
#: methods is the default, "spawn" where processes cannot be forked (Windows), or libraries start threads on import (macOS).
START_METHOD = "spawn" if get_all_start_methods()[0] == "spawn" else "forkserver"
#: Local clusters do not serve HTTP, which requires no certificate.
NO_HTTP: dict[str, list[str]] = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}


def check_installed() -> None:
    """Check that the libraries for worker processes are installed."""
    for module in ("distributed", "dask", "cloudpickle", "cryptography"):
        import_optional("workers", module)


@contextmanager
def open_client(scheduler: str | None, n_workers: int) -> Iterator[Client]:
    """
    Connect to a scheduler, or to local workers that end with the context.

    ``scheduler``: address of a dask scheduler; None starts local workers. ``n_workers``: number of local workers. Raises
    ParameterError when no scheduler answers. Raises SimulationError when local workers do not start.

    Every peer that can connect to a dask scheduler or worker can run code with the rights of its owner. Local clusters use
    TLS with a key of this run, which stays in the memory of its processes, and reject connections without it. The
    configuration of dask (``distributed.comm.tls``) determines the connection to an external scheduler.
    """
    import dask
    from distributed import Client, LocalCluster, Security
    from distributed.system import MEMORY_LIMIT

    security = Security() if scheduler is not None else Security.temporary()
    if scheduler is not None:
        _check_scheduler(scheduler, security)
        with _suppress_logs():
            client = Client(scheduler, timeout=SCHEDULER_S, security=security, set_as_default=False)
            try:
                yield client
            finally:
                with suppress(Exception):
                    client.close(timeout=2)
        return
    if getattr(current_process(), "_inheriting", False):
        # A starting worker imports the main program and reaches this call; its parent reports that the worker did not start.
        raise SystemExit(1)
    # Without retries by dask: items of a lost worker are retried one by one, not as the same task.
    with (
        dask.config.set(
            {"distributed.scheduler.allowed-failures": 0, "distributed.admin.large-graph-warning-threshold": "1 TB"}
            | MEMORY_SETTINGS
            | NO_HTTP
            | {"distributed.worker.multiprocessing-method": _start_method()}
        ),
        ExitStack() as workers,
        ExitStack() as stack,
    ):
        try:
            stack.enter_context(_deferred_signals())
            cluster = workers.enter_context(
                LocalCluster(
                    n_workers=n_workers,
                    security=security,
                    threads_per_worker=1,
                    memory_limit=MEMORY_LIMIT // n_workers,
                    # No dashboard: dask would warn when another cluster uses its default port.
                    dashboard_address="127.0.0.1:0",
                    scheduler_kwargs={"dashboard": False},
                    preload=[__name__],
                    # The present environment; empty strings are equivalent to absent variables of the interpreter.
                    env={"PYTHONPATH": "", "PYTHONSAFEPATH": ""} | os.environ,
                    silence_logs=logging.CRITICAL,
                )
            )
            client = workers.enter_context(Client(cluster, set_as_default=False))
            stack.close()  # an interruption during the start is raised here, when workers can be closed
        except Exception as error:  # noqa: BLE001 -- the start fails in many ways when memory or time is short
            reason = " ".join(str(error).split()) or type(error).__name__
            raise SimulationError(
                f"the workers did not start ({reason:.160}); retry, or use fewer workers; in your own program, make the call "
                'under if __name__ == "__main__":, because workers import the program'
            ) from None
        yield client


@contextmanager
def _deferred_signals() -> Iterator[None]:
    """Defer Ctrl-C and SIGTERM to the end of the block: a starting cluster is not closed."""
    received: list[int] = []
    handlers: dict[int, Any] = {}
    if current_thread() is main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if callable(signal.getsignal(number)):
                handlers[number] = signal.signal(number, lambda found, _: received.append(found))
    try:
        yield
    finally:
        for deferred, handler in handlers.items():
            signal.signal(deferred, handler)
        if received:
            handlers[received[0]](received[0], None)


def _start_method() -> str:
    """Return the start method of local workers."""
    if START_METHOD == "forkserver":
        try:
            _start_fork_server()
        except OSError:  # for example, the path of temporary files is too long for a socket
            return "spawn"
    return START_METHOD


def _start_fork_server() -> None:
    """Start the process from which workers are forked, with the module path of this process."""
    from multiprocessing import forkserver, resource_tracker

    import dask

    get_context("forkserver").set_forkserver_preload(["foveasim.explore._worker_imports"])
    # Settings of libraries at their import, among them one thread: a process with threads must not be forked.
    settings = dask.config.get("distributed.nanny.pre-spawn-environ").items()
    defaults = {name: str(value) for name, value in settings if value is not None} | {"PYTHONHASHSEED": "0"}
    path = os.pathsep.join(map(os.path.abspath, sys.path))
    saved = dict(os.environ)
    os.environ.update(defaults | saved | {"PYTHONPATH": path, "PYTHONSAFEPATH": "1"})
    resource_tracker.ensure_running()  # unblocks the signal after its start
    # The process and the workers that it forks inherit the blocked signal: Ctrl-C is handled by the main program alone.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name in os.environ.keys() - saved.keys():
            del os.environ[name]
        os.environ.update(saved)


@contextmanager
def _suppress_logs() -> Iterator[None]:
    """Suppress the log messages of dask for lost connections, which are reported as errors."""
    logs = [logging.getLogger(name) for name in ("distributed.client", "distributed.core")]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)


def _check_scheduler(scheduler: str, security: Security) -> None:
    """Check that a scheduler answers: a client without one would block for a long time."""
    from distributed import rpc

    async def answer() -> Any:
        async with rpc(scheduler, connection_args=security.get_connection_args("client")) as connection:
            return await asyncio.wait_for(connection.identity(), SCHEDULER_S)

    reason = "it is not a dask scheduler"
    try:
        # In a separate thread: in a notebook, this thread already runs an event loop.
        with ThreadPoolExecutor(1) as pool:
            is_scheduler = pool.submit(lambda: asyncio.run(answer())).result().get("type") == "Scheduler"
    except (OSError, ValueError) as error:
        is_scheduler, reason = False, " ".join(str(error).split()) or type(error).__name__
    except Exception:  # noqa: BLE001 -- dask parses arbitrary answers of other servers as lengths and pickles
        is_scheduler = False
    if not is_scheduler:
        raise ParameterError(
            "scheduler",
            f"must be the address of a dask scheduler that answers within {SCHEDULER_S:g} s ({reason:.160})",
            scheduler,
        )


def dask_setup(_worker: Any) -> None:
    """Ignore Ctrl-C, which the main program handles, and seed numpy's global generator."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    np.random.seed()  # noqa: NPY002, TID251 -- forked workers have equal states, and metrics may use them


class WorkerStates:
    """
    States of the workers of a scheduler at the last update.

    Attributes
    ----------
    alive : set of str
        Addresses of all workers.
    running : set of str
        Workers that accept tasks.
    stuck : set of str
        Workers without running tasks that dask paused more than ``PAUSED_S`` seconds ago because their memory is full.
    n_executing : int
        Number of tasks in execution on all workers.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._paused_since_s: dict[str, float] = {}
        self.alive: set[str] = set()
        self.running: set[str] = set()
        self.stuck: set[str] = set()
        self.n_executing: int = 0

    def update(self) -> None:
        """Read the worker states from the scheduler."""
        try:
            if self._client.cluster is not None:
                # Dask restarts an ended worker, but not a worker that ends again during its start.
                self._client.cluster.scale(len(self._client.cluster.worker_spec))
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
        except Exception:  # noqa: BLE001 -- connections fail in many ways
            raise SimulationError("the scheduler no longer answers") from None
        now_s = time.monotonic()
        executing = {
            address: worker["metrics"].get("task_counts", {}).get("executing", 0) for address, worker in workers.items()
        }
        self.alive, self.n_executing = set(workers), sum(executing.values())
        self.running = {address for address, worker in workers.items() if worker["status"] == "running"}
        paused = {
            address for address, worker in workers.items() if worker["status"] == "paused" and not executing[address]
        }
        self._paused_since_s = {address: self._paused_since_s.get(address, now_s) for address in paused}
        self.stuck = {address for address, since_s in self._paused_since_s.items() if now_s - since_s > PAUSED_S}
