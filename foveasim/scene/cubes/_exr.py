"""
Spectral EXR: one channel per band.

Channels of radiance are named ``S0.550,5nm``, those of reflectance ``T.550,5nm`` (Fichet, Pacanowski, Wilkie 2021, An OpenEXR
layout for spectral images, JCGT 10(3)), with a decimal comma or point; ``emissiveUnits`` is the unit of radiance. Channels
without prefix, ``550.5nm``, have the quantity that the caller specifies. Polarisation, S1 to S3, is ignored.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._core.validation import Floats
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.rasters.exr import MAGIC, POLARISATION, band_of_channel, read_channels, read_header
from foveasim.scene.cubes._cube import EXAMPLE_NM, Cube, Quantity, example_radiance
from foveasim.scene.cubes._formats import CUBE_FORMATS

FLUORESCENCE = re.compile(r"T\.[^.]+m\.[^.]+m")
QUANTITIES: dict[str, Quantity] = {"S0": "radiance", "T": "reflectance"}


def read_exr(path: Path, name: str | None) -> Cube:
    """Read the channels of the layer ``name`` by ascending wavelength."""
    header = read_header(path)
    layers: dict[str, dict[str, float]] = {}
    for channel in header.channels:
        if FLUORESCENCE.fullmatch(channel):
            raise FormatError(f"contains fluorescence, channel {channel!r:.60}, which a scene cannot represent")
        band = band_of_channel(channel)
        if band is not None and band[0] not in POLARISATION:
            layers.setdefault(band[0], {})[channel] = band[1]
    if not layers:
        is_colour = bool(set("RGB") & set(header.channels))
        cure = "read colours with Scene.from_picture" if is_colour else "expected names such as 'S0.550,0nm'"
        listed = ", ".join(header.channels[:5])
        raise FormatError(f"does not contain channels with wavelengths, got {listed:.80}; {cure}")
    layer = name if name is not None else next(iter(layers)) if len(layers) == 1 else None
    if layer not in layers:
        problem = "contains several layers" if layer is None else f"has no layer {layer!r:.40}"
        raise FormatError(f"{problem}; select one with name=, {possible_names(layer or '', sorted(layers))}")
    bands = sorted(layers[layer].items(), key=lambda item: item[1])
    return Cube(
        data=read_channels(path, [channel for channel, _ in bands]),
        wavelength=[wavelength_nm for _, wavelength_nm in bands],
        wavelength_unit="nm",
        quantity=QUANTITIES.get(layer),
        unit=header.attributes.get("emissiveUnits") if layer != "T" else None,
    )


def _example(path: Path) -> Floats:
    """Write one channel per band, top row first."""
    exr, radiance = import_optional(path, "OpenEXR", "maps"), example_radiance()
    channels = {f"S0.{nm:g}nm": np.float32(band[::-1]) for nm, band in zip(EXAMPLE_NM, radiance, strict=True)}
    header = {"compression": exr.NO_COMPRESSION, "type": exr.scanlineimage, "emissiveUnits": "W.m^-2.sr^-1.nm^-1"}
    with exr.File(header, channels) as file:
        file.write(str(path))
    return radiance


CUBE_FORMATS.register(
    "exr",
    FileFormat(title="EXR", suffixes=(".exr",), signatures=(MAGIC,), read=read_exr, is_sandboxed=True, is_silent=True),
    example=_example,
)
