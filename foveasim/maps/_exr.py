"""
Maps as EXR: a channel a band, its name ending in the wavelength; the first row is on top.

Names are those of spectral EXR, ``S0.550,5nm`` (Fichet, Pacanowski, Wilkie 2021, An OpenEXR layout for spectral images,
JCGT 10(3)), with a comma or a point, or plainly ``550.5nm``; its attribute ``emissiveUnits`` is the unit. Pitch and
origin stand as JSON in the attribute ``foveasim``.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.extras import needs
from foveasim._io.formats import FileFormat, FormatError
from foveasim.errors import FileError, ParameterError
from foveasim.fields import PowerMap, to_file_rows
from foveasim.maps._common import MAX_BANDS, Found, check_size
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._text import about_map, found_in_text

__all__ = ["MAGIC", "read", "write"]

MAGIC = b"\x76\x2f\x31\x01"
ATTRIBUTE = "foveasim"
#: A band's channel; S1 to S3 are polarisation, T reflectance, and other channels for display.
BAND = re.compile(r"(?:S0\.|.*\.)?(?P<number>[0-9]+(?:[.,][0-9]+)?(?:[eE][-+]?[0-9]+)?)nm")
OTHER = re.compile(r"(?:[RGBAYZ]|S[123]\..*|T\..*)")
#: EXR's numbers of 32 bits.
ITEMSIZE = 4


def write(power_map: PowerMap, path: Path) -> None:
    """
    Write a channel a band, unpacked.

    Raises
    ------
    ParameterError
        When the map is not float32, or two bands have the same wavelength.
    """
    exr = _openexr(path)
    if power_map.data.dtype != np.float32:
        raise ParameterError(
            "power_map",
            f"must be float32 for EXR, got {power_map.data.dtype}",
            hint="convert it, or take .npz, .fits or .nc",
        )
    names = [_channel_name(wavelength) for wavelength in power_map.wavelength_nm.tolist()]
    if len(set(names)) < len(names):
        raise ParameterError("wavelength_nm", "must be different from each other in EXR", power_map.wavelength_nm)
    header = {
        "compression": exr.NO_COMPRESSION,
        "type": exr.scanlineimage,
        "emissiveUnits": "W.m^-2",
        "spectralLayoutVersion": "1.0",
        ATTRIBUTE: json.dumps(about_map(power_map)),
    }
    images = [np.ascontiguousarray(to_file_rows(image)) for image in power_map.data]
    with exr.File(header, dict(zip(names, images, strict=True))) as file:
        file.write(str(path))


def read(path: Path, name: str | None) -> Found:
    """Read the channels that are bands, by rising wavelength, or in the order in which we wrote them."""
    exr = _openexr(path)
    if name is not None:
        raise FormatError("holds one map without a name; leave name= out")
    with exr.File(str(path), header_only=True) as file:
        if len(file.parts) != 1:
            raise FormatError(f"holds {len(file.parts)} pictures; give a file with one")
        header = file.header()
        low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
        n_x, n_y = (high - low + 1).tolist()
        channels = {c.name: (c.xSampling, c.ySampling) for c in header["channels"]}
        if len(channels) > MAX_BANDS or min(n_x, n_y) < 1:
            raise FormatError(f"holds {len(channels)} channels of {n_x} x {n_y}")
        check_size((len(channels), n_y, n_x), ITEMSIZE, path.stat().st_size)
        text, told = (v if isinstance(v := header.get(key), str) else None for key in (ATTRIBUTE, "emissiveUnits"))
    bands = _bands(list(channels))
    if any(channels[channel] != (1, 1) for channel in bands):
        raise FormatError("has channels of fewer cells than others")
    with exr.File(str(path), separate_channels=True) as file:
        pixels = file.channels()
        ours = found_in_text(text or "", np.empty((1, 1)), is_y_falling=True)
        if ours.wavelength_nm is not None:
            order = [_channel_name(wavelength) for wavelength in ours.wavelength_nm]
            if sorted(order) != sorted(bands):
                raise FormatError("tells other wavelengths than its channels have")
            return replace(ours, data=np.stack([pixels[channel].pixels for channel in order]))
        data = np.stack([pixels[channel].pixels for channel in bands])
    waves = [wavelength for wavelength in bands.values() if wavelength is not None]
    return Found(
        data=data,
        is_y_falling=True,
        wavelength_nm=waves or None,
        unit=told,
    )


def _bands(names: list[str]) -> dict[str, float | None]:
    """Channels that are bands with their wavelengths, by these; or all, in their order, when none tells one."""
    waves = {name: match for name in names if not OTHER.fullmatch(name) and (match := BAND.fullmatch(name))}
    if waves:
        numbers = {name: float(match["number"].replace(",", ".")) for name, match in waves.items()}
        return {name: numbers[name] for name in sorted(numbers, key=numbers.__getitem__)}
    if len(names) > 1 and set(names) <= set("RGBA"):
        raise FormatError("holds the colours of a picture, and not light by wavelength; make a Scene of it")
    return dict.fromkeys(names)


def _channel_name(wavelength_nm: float) -> str:
    """Name of a band's channel; EXR takes a point for the end of a layer's name."""
    return f"S0.{wavelength_nm!r}nm".replace(".", ",").replace("S0,", "S0.")


def _openexr(path: Path) -> Any:
    try:
        import OpenEXR
    except ImportError:
        raise FileError(path, needs("OpenEXR", "maps")) from None
    return OpenEXR


MAP_FORMATS.register(
    "exr",
    FileFormat(title="EXR", suffixes=(".exr",), signatures=(MAGIC,), read=read, write=write, is_sandboxed=True),
)
