"""
Power maps in EXR files: one channel per band, top row first.

Channel names end in the wavelength, as in spectral EXR, ``S0.550,5nm`` (Fichet, Pacanowski, Wilkie 2021, An OpenEXR layout
for spectral images, JCGT 10(3)), with a decimal comma or point, or without prefix, ``550.5nm``. The attribute
``emissiveUnits`` is the unit. Pitch and origin are stored as JSON in the attribute ``foveasim``.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.rasters.exr import MAGIC, POLARISATION, band_of_channel, read_channels, read_header
from foveasim.errors import ParameterError
from foveasim.fields import PowerMap, to_file_rows
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._json_metadata import found_in_metadata, map_metadata

ATTRIBUTE = "foveasim"


def write(power_map: PowerMap, path: Path) -> None:
    """
    Write one uncompressed channel per band.

    Raises ParameterError if the map is not float32, or two bands have the same wavelength.
    """
    exr = import_optional(path, "OpenEXR", "maps")
    if power_map.data.dtype != np.float32:
        raise ParameterError(
            "power_map",
            f"must be float32 for EXR, got {power_map.data.dtype}",
            hint="convert it, or use .npz, .fits or .nc",
        )
    names = [_channel_name(wavelength) for wavelength in power_map.wavelength_nm.tolist()]
    if len(set(names)) < len(names):
        raise ParameterError("wavelength_nm", "must be unique for EXR", power_map.wavelength_nm)
    header = {
        "compression": exr.NO_COMPRESSION,
        "type": exr.scanlineimage,
        "emissiveUnits": "W.m^-2",
        "spectralLayoutVersion": "1.0",
        ATTRIBUTE: json.dumps(map_metadata(power_map)),
    }
    images = [np.ascontiguousarray(to_file_rows(image)) for image in power_map.data]
    with exr.File(header, dict(zip(names, images, strict=True))) as file:
        file.write(str(path))


def read(path: Path, name: str | None) -> Found:
    """Read the channels of bands, in written order or by increasing wavelength."""
    if name is not None:
        raise FormatError("contains one unnamed map; omit name=")
    header = read_header(path)
    bands = _bands(header.channels)
    stored = found_in_metadata(header.attributes.get(ATTRIBUTE, ""), np.empty((1, 1)), is_y_descending=True)
    if stored.wavelength_nm is not None:
        order = [_channel_name(wavelength) for wavelength in stored.wavelength_nm]
        if sorted(order) != sorted(bands):
            raise FormatError("has an attribute 'foveasim' with wavelengths that differ from its channel names")
        return replace(stored, data=read_channels(path, order))
    waves = [wavelength for wavelength in bands.values() if wavelength is not None]
    return Found(
        data=read_channels(path, list(bands)),
        is_y_descending=True,
        wavelength_nm=waves or None,
        unit=header.attributes.get("emissiveUnits"),
    )


def _bands(names: list[str]) -> dict[str, float | None]:
    """Return the channels of bands by wavelength, or all channels without wavelengths."""
    bands = {name: band for name in names if (band := band_of_channel(name)) and band[0] not in (*POLARISATION, "T")}
    if bands:
        return {name: bands[name][1] for name in sorted(bands, key=lambda name: bands[name][1])}
    if len(names) > 1 and set(names) <= set("RGBA"):
        raise FormatError("contains RGB colours instead of irradiance per wavelength; read it with Scene.from_picture")
    return dict.fromkeys(names)


def _channel_name(wavelength_nm: float) -> str:
    """Return the channel name of a band; a point would end a layer name in EXR."""
    return f"S0.{wavelength_nm!r}nm".replace(".", ",").replace("S0,", "S0.")


MAP_FORMATS.register(
    "exr",
    FileFormat(
        title="EXR", suffixes=(".exr",), signatures=(MAGIC,), read=read, write=write, is_sandboxed=True, is_silent=True
    ),
)
