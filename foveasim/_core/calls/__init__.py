"""Validation of the arguments of public calls: their names, number and types."""

from __future__ import annotations

from foveasim._core.calls.arguments import CHECKED, check_arguments, check_public_calls
from foveasim._core.calls.kinds import OwnCheck

__all__ = ["CHECKED", "OwnCheck", "check_arguments", "check_public_calls"]
