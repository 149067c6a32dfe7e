"""Waiting for other threads, processes and pages: for what they do, never for a time."""

from __future__ import annotations

import time
from pathlib import Path

#: Only a program that never gets there takes longer, on any machine.
DEADLINE_S = 120.0


def wait_until(condition, *, program=None, step_s=0.005):
    """Return the first true value of a condition; fail after the deadline, and when the program that brings it about has ended."""
    end_s = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        assert program is None or program.poll() is None, f"the program ended with {program.returncode}"
        if time.monotonic() > end_s:
            raise AssertionError(f"did not happen within {DEADLINE_S:g} s")
        time.sleep(step_s)
    return found


def has_ended(process):
    """Return whether the process of a number has ended, also if nobody has asked for its exit code."""
    try:
        status = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return True
    return status.rpartition(")")[2].split()[0] == "Z"
