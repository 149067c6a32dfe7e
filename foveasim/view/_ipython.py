"""The interactive session, if there is one."""

from __future__ import annotations

import sys
from typing import Any


def ipython_shell() -> Any:
    """Return the shell of IPython that runs this code, or None."""
    ipython = sys.modules.get("IPython")
    return None if ipython is None else ipython.get_ipython()


def is_notebook() -> bool:
    """Return whether this code runs in the kernel of a notebook, which shows pictures."""
    return hasattr(ipython_shell(), "kernel")


def display(data: object) -> None:
    """Show an object below the cell of a notebook that runs this code."""
    sys.modules["IPython"].display.display(data)
