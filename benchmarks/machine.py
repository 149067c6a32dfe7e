"""Speed of the machine, and how much of it other processes use during a measurement."""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path

LOOP = compile("total = 0\nfor k in range(10_000_000):\n    total += k\n", "loop", "exec")
#: Columns of the first line of /proc/stat in which a core does not idle: all but idle and iowait; guests are part of user.
BUSY_COLUMNS = (0, 1, 2, 5, 6, 7)


def processor_model() -> str:
    """Return the model name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def additions_s() -> float:
    """Return the processor time of ten million additions in a loop of a Python script, the shortest of three."""
    seconds = []
    for _ in range(3):
        start_s = time.process_time()
        add_numbers()
        seconds.append(time.process_time() - start_s)
    return min(seconds)


def add_numbers() -> None:
    """Add ten million numbers in a loop of a Python script."""
    exec(LOOP, {})  # global names, as in a script: local ones of a function are twice as fast


def parse_busy_s(stat: str, ticks_per_s: float) -> float:
    """Return the time in which cores did not idle since the start of the machine, from the text of /proc/stat."""
    ticks = stat.splitlines()[0].split()[1:]
    return sum(int(ticks[k]) for k in BUSY_COLUMNS if k < len(ticks)) / ticks_per_s


def busy_s() -> float | None:
    """Return the time in which cores did not idle, or None where the system does not report it."""
    try:
        return parse_busy_s(Path("/proc/stat").read_text("ascii"), os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError):
        return None


def own_s() -> float:
    """Return the processor time of this process and of all that it has started and waited for."""
    return sum(os.times()[:4])


class OtherProcesses:
    """Processor time of other processes, and of other virtual machines on the host, since this object was created."""

    def __init__(self) -> None:
        self._start_s, self._busy_s, self._own_s = time.perf_counter(), busy_s(), own_s()

    def percent(self) -> float | None:
        """Return their processor time in percent of one core, or None where the system does not report it."""
        now_s = busy_s()
        if self._busy_s is None or now_s is None:
            return None
        others_s = (now_s - self._busy_s) - (own_s() - self._own_s)
        return max(0.0, 100.0 * others_s / max(time.perf_counter() - self._start_s, 1e-9))

    def describe(self) -> str:
        """Return the percentage in words, or the load average."""
        percent = self.percent()
        if percent is not None:
            return f"other processes used {percent:.0f} % of a core"
        return f"load average {os.getloadavg()[0]:.2g}" if hasattr(os, "getloadavg") else "load unknown"


def describe_machine() -> str:
    """Return the number of cores, the processor, and its speed."""
    return f"{os.cpu_count()} cores, {processor_model()}, ten million additions in a Python loop: {additions_s():.2f} s"
