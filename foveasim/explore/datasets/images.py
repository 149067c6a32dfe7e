"""Images of samples, channels first: reconstructed pictures and log-polar images."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from foveasim._core.names import did_you_mean
from foveasim._core.validation import unit_of
from foveasim.capture import Capture
from foveasim.columns import COLUMNS, MAIN, column_info
from foveasim.errors import FoveasimError, ParameterError
from foveasim.sensor import Sensor

__all__ = ["CORTICAL", "RASTER", "check_image_options", "image_attributes", "image_units", "images_of"]

#: Items with the reconstructed picture and the log-polar image of a sample.
RASTER, CORTICAL = "raster", "cortical"
#: Default options: pictures for learning are small.
DEFAULTS: dict[str, dict[str, Any]] = {RASTER: {"max_pixels": 128}, CORTICAL: {"max_pixels": 256}}
#: Options of :meth:`foveasim.Capture.picture` and :meth:`foveasim.Capture.cortical` that are plain data.
OPTIONS: dict[str, Any] = {
    RASTER: ("method", "max_pixels", "of", "per", "mu", "tolerance", "max_steps"),
    CORTICAL: ("of", "per", "n_rings", "n_sectors", "r_min_um", "r_max_um", "centre_um", "max_pixels"),
}


def check_image_options(name: str, options: Any) -> dict[str, Any] | None:
    """Return the options of an image with their defaults, or None."""
    if options is None:
        return None
    known = OPTIONS[name]
    if not isinstance(options, Mapping):
        raise ParameterError(name, f"must be a mapping of options ({', '.join(known)}), or None", options)
    for key in options:
        if key not in known:
            raise ParameterError(
                name, f"must have the options {', '.join(known)}", str(key), hint=did_you_mean(str(key), known)
            )
    try:
        found: dict[str, Any] = json.loads(json.dumps({**DEFAULTS[name], **options}))
    except (TypeError, ValueError):
        raise ParameterError(name, "must have numbers, strings and lists as options", dict(options)) from None
    return found


def images_of(
    capture: Capture, sensor: Sensor, options: Mapping[str, Mapping[str, Any]], *, n_threads: int
) -> dict[str, Any]:
    """
    Return the images of a capture.

    ``options``: options of each image, by its name. Returns ``items``: ``raster`` (n_channel, n_y, n_x) float32, top row
    first, and ``cortical`` (n_channel, n_ring, n_sector) float32, the innermost ring first; 0 where ``raster_known`` (n_y,
    n_x) or ``cortical_known`` (n_ring, n_sector) is False. Raises ParameterError when an option is invalid for the capture;
    the message contains the name of the image.
    """
    items: dict[str, Any] = {}
    for name, chosen in options.items():
        data = np.asarray(_image(name, capture, sensor, chosen, n_threads).data)
        is_known = np.isfinite(data).all(axis=0)
        if name == RASTER:
            data, is_known = data[:, ::-1], is_known[::-1]
        items[name] = np.ascontiguousarray(np.where(is_known, data, 0.0), np.float32)
        items[f"{name}_known"] = np.ascontiguousarray(is_known)
    return items


def image_attributes(
    capture: Capture, sensor: Sensor, options: Mapping[str, Mapping[str, Any]], *, n_threads: int
) -> dict[str, dict[str, Any]]:
    """Return the position of each image in the sensor plane and its channels, as plain data."""
    found: dict[str, dict[str, Any]] = {}
    for name, chosen in options.items():
        image = _image(name, capture, sensor, chosen, n_threads)
        # With one pixel per site, the channel contains the values of all filters.
        names = list(capture.filter_names)
        channels = {"channels": names if image.data.shape[0] == len(names) else ["all"]}
        if name == RASTER:
            found[name] = {"bounds_um": list(image.grid.bounds_um), "first_row": "top", **channels}
        else:
            found[name] = {
                "radius_um": image.radius_um.tolist(),
                "start_rad": image.start_rad.tolist(),
                "centre_um": list(image.centre_um),
                **channels,
            }
    return found


def image_units(options: Mapping[str, Any]) -> str:
    """Return the unit of the values of an image."""
    # Least squares estimate photoelectrons.
    name = "light_e" if options.get("method") == "least_squares" else options.get("of", MAIN)
    units = column_info(name).unit if name in COLUMNS else unit_of(name)
    return f"{units}/µm²" if options.get("per") == "um2" else units


def _image(name: str, capture: Capture, sensor: Sensor, options: Mapping[str, Any], n_threads: int) -> Any:
    reconstruct = capture.picture if name == RASTER else capture.cortical
    try:
        return reconstruct(sensor=sensor, n_threads=n_threads, **options)
    except FoveasimError as error:
        raise ParameterError(name, f"has invalid options: {error}") from None
