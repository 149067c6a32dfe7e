"""Metadata of maps as a JSON string, for formats without fields for them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._io.formats import FormatError
from foveasim.fields import PowerMap
from foveasim.maps._common import Found

FILE_FORMAT = "foveasim power map"
FILE_VERSION = 1
#: Longer strings are not metadata of foveasim.
MAX_CHARS = 2**20


def map_metadata(power_map: PowerMap) -> dict[str, Any]:
    """Return the metadata of a map; Python's JSON represents float64 losslessly."""
    return {
        "format": FILE_FORMAT,
        "version": FILE_VERSION,
        "unit": "w_m2",
        "pitch_um": power_map.grid.pitch_um,
        "origin_um": list(power_map.grid.origin_um),
        "wavelength_nm": power_map.wavelength_nm.tolist(),
    }


def found_in_metadata(text: str, data: NDArray[Any], *, is_y_descending: bool) -> Found:
    """
    Return a map with the metadata of a string; without them if foveasim did not write it.

    Raises FormatError if the string has the format of foveasim and is invalid.
    """
    about = _parse(text)
    if not isinstance(about, dict) or about.get("format") != FILE_FORMAT:
        return Found(data=data, is_y_descending=is_y_descending)
    if about.get("version") != FILE_VERSION:
        raise FormatError(f"has the format version {about.get('version')!r:.40}, expected {FILE_VERSION}")
    try:
        pitch_x_um, pitch_y_um = map(float, np.broadcast_to(about["pitch_um"], (2,)))
        x0, y0 = map(float, about["origin_um"])
        waves = [float(w) for w in about["wavelength_nm"]]
    except (KeyError, TypeError, ValueError):
        raise FormatError("contains an invalid pitch, origin or wavelength") from None
    return Found(
        data=data,
        is_y_descending=is_y_descending,
        pitch_um=(pitch_x_um, pitch_y_um),
        origin_um=(x0, y0),
        wavelength_nm=waves,
        unit=str(about.get("unit")),
    )


def _parse(text: str) -> Any:
    if not text.startswith("{") or len(text) > MAX_CHARS:
        return None
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None
