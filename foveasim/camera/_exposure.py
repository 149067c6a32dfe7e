"""Exposure times: seconds, fractions, exposure values, and automatic exposure."""

from __future__ import annotations

import re
from typing import Literal, TypeAlias

from foveasim.errors import ParameterError
from foveasim.sensor.limits import EXPOSURE
from foveasim.sensor.model.auto_exposure import AUTO_PERCENTILE, AUTO_TARGET

#: Exposure time in seconds, or as :func:`exposure_time` reads it.
ExposureTime: TypeAlias = float | str
#: Entry in the settings of captures with automatic exposure.
AUTO_SETTINGS = {"auto_exposure": {"target": AUTO_TARGET, "percentile": AUTO_PERCENTILE}}
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_FRACTION = re.compile(rf"({_NUMBER})(?:\s*/\s*({_NUMBER}))?")
_VALUE = re.compile(rf"EV\s*({_NUMBER})", re.IGNORECASE)


def exposure_time(exposure_s: object, f_number: float) -> float | Literal["auto"]:
    """
    Return an exposure time in seconds, or ``"auto"``.

    ``exposure_s``: a number or fraction of seconds, such as 0.02 or ``"1/50"``, ``"auto"``, or an exposure value for the
    f-number N, such as ``"EV 12"``: N² / 2¹² seconds (ISO 2720). Raises ParameterError for other values.
    """
    if not isinstance(exposure_s, str):
        return EXPOSURE.check("exposure_s", exposure_s)
    if exposure_s == "auto":
        return "auto"
    fraction, value = _FRACTION.fullmatch(exposure_s.strip()), _VALUE.fullmatch(exposure_s.strip())
    if fraction and float(fraction[2] or 1.0):
        return EXPOSURE.check("exposure_s", float(fraction[1]) / float(fraction[2] or 1.0))
    if value and abs(float(value[1])) <= 100.0:
        return EXPOSURE.check("exposure_s", f_number**2 / 2.0 ** float(value[1]))
    raise ParameterError(
        "exposure_s",
        "must be a time in seconds, a fraction such as '1/50', 'auto', or a value such as 'EV 12'",
        exposure_s,
    )
