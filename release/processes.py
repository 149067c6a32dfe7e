"""Programs that the release checks run."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path


class CheckError(Exception):
    """A release check that fails."""


def run(*command: str, cwd: Path | None = None, **variables: str) -> str:
    """Run a program and return what it prints; raise CheckError with its last lines if it fails."""
    found = subprocess.run(
        command, cwd=cwd, env={**os.environ, **variables}, capture_output=True, text=True, check=False
    )
    if found.returncode:
        last = "\n".join((found.stdout + found.stderr).splitlines()[-20:])
        raise CheckError(f"{' '.join(command[:4])} ... failed:\n{last}")
    return found.stdout
