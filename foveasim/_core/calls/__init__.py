"""Validation of the arguments of public calls: their names, number, types and ranges."""

from __future__ import annotations

from foveasim._core.calls.arguments import CHECKED, check_arguments, check_public_calls
from foveasim._core.calls.kinds import OwnCheck
from foveasim._core.calls.limits import (
    FINITE,
    FRACTION,
    LENGTH,
    NOT_NEGATIVE,
    POSITIVE,
    Declaration,
    Declared,
    Limits,
    Usual,
    check_declared,
    declarations_of,
)

__all__ = [
    "CHECKED",
    "FINITE",
    "FRACTION",
    "LENGTH",
    "NOT_NEGATIVE",
    "POSITIVE",
    "Declaration",
    "Declared",
    "Limits",
    "OwnCheck",
    "Usual",
    "check_arguments",
    "check_declared",
    "check_public_calls",
    "declarations_of",
]
