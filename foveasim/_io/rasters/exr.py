"""
EXR files: header with size limits, and channels as bands.

The library applies the compression and the line order. Read are the windows, the channels, ``pixelAspectRatio`` and, by the
readers, ``emissiveUnits``. Other attributes do not change the values, unless one of :data:`RELEVANT` is in their names, which
is an error.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.formats import FormatError
from foveasim._io.rasters import MAX_BANDS, check_size
from foveasim._io.rasters.units import length_in_um, round_factor

MAGIC = b"\x76\x2f\x31\x01"
#: Channel name of a band: optional layer, wavelength and unit. Layers are not numbers: ``550.5nm`` is one wavelength.
CHANNEL = re.compile(
    r"(?:(?P<layer>S[0-3]|T|.*[^0-9.].*)\.)?(?P<number>[0-9]+(?:[.,][0-9]+)?(?:[eE][-+]?[0-9]+)?)(?P<unit>[a-zµ]{1,2})"
)
#: Layers of polarisation in spectral EXR.
POLARISATION = ("S1", "S2", "S3")
#: Bytes of a 32-bit channel value.
ITEMSIZE = 4
#: Parts of the names of attributes that change the values, such as those of cameras in spectral EXR.
RELEVANT = re.compile(
    r"gain|offset|scale|factor|units?$|response|transmission|sensitivit|exposurecomp|calib|gamma|encod|invert|logarithm|dark",
    re.IGNORECASE,
)
#: Attributes with such names that are read, or do not change the values: units of what is reflected, of foveasim's maps.
NOT_RELEVANT = frozenset(("emissiveUnits", "foveasim"))


@dataclass(frozen=True, kw_only=True)
class ExrHeader:
    """Names of the channels and text attributes of an EXR file with one image."""

    channels: list[str]
    attributes: dict[str, str]


def read_header(path: Path) -> ExrHeader:
    """
    Read the header of a file with one image.

    Raises FormatError if the file contains several images, or is too large.
    """
    exr = import_optional(path, "OpenEXR", "maps")
    with exr.File(str(path), header_only=True) as file:
        if len(file.parts) != 1:
            raise FormatError(f"contains {len(file.parts)} images; provide a file with one")
        header = file.header()
        low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
        n_x, n_y = (high - low + 1).tolist()
        channels = [channel.name for channel in header["channels"]]
        attributes = {key: value for key, value in header.items() if isinstance(value, str)}
        _check_attributes(header)
    if len(channels) > MAX_BANDS or min(n_x, n_y) < 1:
        raise FormatError(
            f"must have at most {MAX_BANDS} channels of at least 1 x 1, got {len(channels)} of {n_x} x {n_y}"
        )
    check_size((len(channels), n_y, n_x), ITEMSIZE, path.stat().st_size)
    return ExrHeader(channels=channels, attributes=attributes)


def _check_attributes(header: dict[str, Any]) -> None:
    """Raise a FormatError for an unknown attribute that changes the values or pixels."""
    for name in map(str, header):
        if name not in NOT_RELEVANT and RELEVANT.search(name):
            raise FormatError(f"has the attribute {name!r:.60}, which may change the values; apply it, and remove it")
    aspect = float(header.get("pixelAspectRatio", 1.0))
    if aspect != 1.0:
        raise FormatError(f"has pixels with the pixelAspectRatio {aspect:g}, expected squares; resample it")
    kind = str(header.get("type", "")).rpartition(".")[2]
    if "deep" in kind.lower():
        raise FormatError(f"contains a deep image, of the type {kind:.40}, expected one value per pixel")


def band_of_channel(name: str) -> tuple[str, float] | None:
    """
    Return the layer and the wavelength in nm of a channel; None without a wavelength.

    Examples
    --------
    >>> band_of_channel("S0.550,5nm"), band_of_channel("550.5nm"), band_of_channel("R")
    (('S0', 550.5), ('', 550.5), None)
    """
    match = CHANNEL.fullmatch(name)
    size_um = None if match is None else length_in_um(match["unit"])
    if match is None or size_um is None:
        return None
    number = float(match["number"].replace(",", "."))
    return match["layer"] or "", number if size_um == 1e-3 else round_factor(number * size_um * 1e3)


def read_channels(path: Path, names: Sequence[str]) -> NDArray[Any]:
    """
    Read channels as bands (n_band, n_y, n_x), top row first.

    Raises FormatError if a channel is subsampled.
    """
    exr = import_optional(path, "OpenEXR", "maps")
    with exr.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        if any((channels[name].xSampling, channels[name].ySampling) != (1, 1) for name in names):
            raise FormatError("has subsampled channels; write all bands at full resolution")
        return np.stack([channels[name].pixels for name in names])
