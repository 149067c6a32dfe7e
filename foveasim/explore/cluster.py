"""The dask that points are sent to: processes on this machine, or a scheduler that somebody started; and its workers."""

from __future__ import annotations

import asyncio
import logging
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import current_process
from typing import TYPE_CHECKING, Any

from foveasim._core.extras import needs
from foveasim.errors import ParameterError, SimulationError

if TYPE_CHECKING:
    from distributed import Client, Security

__all__ = ["WorkerStates", "client_of", "dask_setup"]

#: Time that a scheduler has to answer.
SCHEDULER_S = 10.0
#: Seconds after which a task that waits at a paused worker is sent elsewhere; workers report every second or so.
PAUSED_S = 10.0
#: What our own workers do about memory. A worker that dask pauses may wait for ever for memory that a metric keeps; one that
#: is ended is begun again without it.
MEMORY = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
}
#: Nothing of a local cluster answers over HTTP, which asks nobody for a certificate.
NO_HTTP: dict[str, list[str]] = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}


@contextmanager
def client_of(scheduler: str | None, n_workers: int) -> Iterator[Client]:
    """
    A client of a scheduler, or of workers on this machine that end with the block.

    Raises
    ------
    ParameterError
        When dask or cryptography is missing, or no scheduler answers.
    SimulationError
        When workers do not start on this machine.

    Notes
    -----
    Whoever can talk to a scheduler or a worker of dask can run code with the rights of its owner. Those on this machine
    talk TLS with a key of this run alone, which never leaves the memory of its processes, and accept nobody without it.
    A scheduler that somebody started is met as dask's configuration says (``distributed.comm.tls``).
    """
    try:
        import dask
        from distributed import Client, LocalCluster, Security
        from distributed.system import MEMORY_LIMIT

        security = Security() if scheduler is not None else Security.temporary()
    except ImportError:
        raise ParameterError("sweep", needs("distributed")) from None
    if scheduler is not None:
        _check_answer(scheduler, security)
        with _silent():
            client = Client(scheduler, timeout=SCHEDULER_S, security=security, set_as_default=False)
            try:
                yield client
            finally:
                with suppress(Exception):
                    client.close(timeout=2)
        return
    if getattr(current_process(), "_inheriting", False):
        # A worker that imports the main program came here: what began the worker tells that it did not start.
        raise SystemExit(1)
    # Every item of a worker that ended is tried again, alone: not with the others of its task.
    with (
        dask.config.set(
            {"distributed.scheduler.allowed-failures": 0, "distributed.admin.large-graph-warning-threshold": "1 TB"}
            | MEMORY
            | NO_HTTP
        ),
        ExitStack() as opened,
    ):
        try:
            cluster = opened.enter_context(
                LocalCluster(
                    n_workers=n_workers,
                    security=security,
                    threads_per_worker=1,
                    memory_limit=MEMORY_LIMIT // n_workers,
                    # No dashboard: only so does dask not ask for the one port of another's, and warn where that has it.
                    dashboard_address="127.0.0.1:0",
                    scheduler_kwargs={"dashboard": False},
                    preload=[__name__],
                    silence_logs=logging.CRITICAL,
                )
            )
            client = opened.enter_context(Client(cluster, set_as_default=False))
        except Exception as error:  # noqa: BLE001 -- a machine without memory or time for them makes them fail in many ways
            reason = " ".join(str(error).split()) or type(error).__name__
            raise SimulationError(
                f"the workers did not start ({reason:.160}); try it again, or with fewer of them; a program of your own calls "
                'it under if __name__ == "__main__": alone, for workers import that program'
            ) from None
        yield client


@contextmanager
def _silent() -> Iterator[None]:
    """Without what dask logs of a lost connection, which is told in a sentence."""
    logs = [logging.getLogger(name) for name in ("distributed.client", "distributed.core")]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)


def _check_answer(scheduler: str, security: Security) -> None:
    """Ask a scheduler who it is: a client that found none would not let go of the program for a while."""
    from distributed import rpc

    async def answer() -> Any:
        async with rpc(scheduler, connection_args=security.get_connection_args("client")) as asked:
            return await asyncio.wait_for(asked.identity(), SCHEDULER_S)

    reason = "it is something else"
    try:
        # In a thread of its own: a notebook has an event loop in this one.
        with ThreadPoolExecutor(1) as pool:
            is_scheduler = pool.submit(lambda: asyncio.run(answer())).result().get("type") == "Scheduler"
    except (OSError, ValueError) as error:
        is_scheduler, reason = False, " ".join(str(error).split()) or type(error).__name__
    except Exception:  # noqa: BLE001 -- what is no scheduler may answer anything, and dask takes it for lengths and pickles
        is_scheduler = False
    if not is_scheduler:
        raise ParameterError(
            "scheduler",
            f"must be the address of a dask scheduler that answers within {SCHEDULER_S:g} s ({reason:.160})",
            scheduler,
        )


def dask_setup(_worker: Any) -> None:
    """Prepare a worker of this machine: Ctrl-C, which all processes of a terminal get, is for the program that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class WorkerStates:
    """
    States of a scheduler's workers at the last update.

    Attributes
    ----------
    alive : set of str
        Addresses of all workers.
    running : set of str
        Those that start the tasks they are sent.
    stuck : set of str
        Those that have been paused for some time because their memory is full, and compute nothing.
    n_executing : int
        Tasks that all workers compute.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._paused_since_s: dict[str, float] = {}
        self.alive: set[str] = set()
        self.running: set[str] = set()
        self.stuck: set[str] = set()
        self.n_executing = 0

    def update(self) -> None:
        """
        Ask the scheduler.

        Raises
        ------
        SimulationError
            When it does not answer.
        """
        try:
            if self._client.cluster is not None:
                # Dask restarts a worker that ended, but not one that ends again before it has started.
                self._client.cluster.scale(len(self._client.cluster.worker_spec))
            found = self._client.scheduler_info(n_workers=-1)["workers"]
        except Exception:  # noqa: BLE001 -- connections break in many ways
            raise SimulationError("the scheduler does not answer any more") from None
        now_s = time.monotonic()
        executing = {
            address: one["metrics"].get("task_counts", {}).get("executing", 0) for address, one in found.items()
        }
        self.alive, self.n_executing = set(found), sum(executing.values())
        self.running = {address for address, one in found.items() if one["status"] == "running"}
        paused = {address for address, one in found.items() if one["status"] == "paused" and not executing[address]}
        self._paused_since_s = {address: self._paused_since_s.get(address, now_s) for address in paused}
        self.stuck = {address for address, since_s in self._paused_since_s.items() if now_s - since_s > PAUSED_S}
