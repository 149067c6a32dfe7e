"""Properties of all public names: checked arguments, copies and pickles."""

from __future__ import annotations

from foveasim._core.calls.arguments import CHECKED, check_arguments, check_public_calls
from foveasim._core.calls.kinds import OwnCheck
from foveasim._core.calls.limits import (
    FINITE,
    FRACTION,
    LENGTH,
    NOT_NEGATIVE,
    PORT,
    POSITIVE,
    Declaration,
    Declared,
    Limits,
    Usual,
    Words,
    check_declared,
    declarations_of,
    without_declarations,
)
from foveasim._core.calls.pickling import copyable, make_copyable

__all__ = [
    "CHECKED",
    "FINITE",
    "FRACTION",
    "LENGTH",
    "NOT_NEGATIVE",
    "PORT",
    "POSITIVE",
    "Declaration",
    "Declared",
    "Limits",
    "OwnCheck",
    "Usual",
    "Words",
    "check_arguments",
    "check_declared",
    "copyable",
    "declarations_of",
    "publish",
    "without_declarations",
]


def publish(module_name: str) -> None:
    """Check calls of the names in ``__all__``, and define the state of the classes."""
    check_public_calls(module_name)
    make_copyable(module_name)
