"""
Views of the studio: the data that each shows, by name.

A new view is one function with :func:`part` here, and one pane of the page.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.short_repr import short_repr
from foveasim.errors import ParameterError, SimulationError
from foveasim.fields import Grid, PowerMap
from foveasim.metrics import polygon_mtf
from foveasim.scene import Scene
from foveasim.sensor import noise_budget
from foveasim.studio._engine import Simulated
from foveasim.studio._variants import compare
from foveasim.units import per_mm_from_per_um, photon_energy_j
from foveasim.view.site_colours import encode_light
from foveasim.view.web._content import describe_sites, outlines_of, rules_of

__all__ = ["PARTS", "Part", "PartData", "summary_of"]

#: Data of a part: plain data, and arrays by name.
PartData = tuple[dict[str, Any], dict[str, NDArray[Any]]]
#: Longer side of the reconstructed picture and of the optical image.
PICTURE_PIXELS = 512
#: Wavelengths of the spectrum: the first range that all curves of the sensor cover; else the bands of the scene.
RANGES_NM = ((350.0, 1000.0), (400.0, 1000.0), (380.0, 780.0), (400.0, 700.0))
N_WAVELENGTHS = 131
#: Number of frequencies of MTF curves.
N_FREQUENCIES = 65
#: Fraction of the cells of an optical image that are not brighter than white.
WHITE_QUANTILE = 0.995
#: Levels of linear light in the table of sRGB bytes.
N_LEVELS = 1 << 14


@dataclass(frozen=True)
class Part:
    """
    A view.

    Attributes
    ----------
    name : str
    label : str
        Heading on the page.
    make : function of Simulated
        Returns the data.
    depends : function of Simulated
        Returns objects that determine the data: the part is computed again when one of them is another object.
    """

    name: str
    label: str
    make: Callable[[Simulated], PartData]
    depends: Callable[[Simulated], tuple[Any, ...]]

    __repr__ = short_repr


#: Views by name, in the order of their computation.
PARTS: dict[str, Part] = {}


def part(
    label: str, depends: Callable[[Simulated], tuple[Any, ...]]
) -> Callable[[Callable[[Simulated], PartData]], Callable[[Simulated], PartData]]:
    """Register a function as the view with its name."""

    def register(make: Callable[[Simulated], PartData]) -> Callable[[Simulated], PartData]:
        name = make.__name__
        PARTS[name] = Part(name, label, make, depends)
        return make

    return register


def _capture(result: Simulated) -> tuple[Any, ...]:
    return (result.capture,)


def _layout(result: Simulated) -> tuple[Any, ...]:
    return (result.capture.layout,)


@part("Photosites", _layout)
def sites(result: Simulated) -> PartData:
    """Return the outlines of the photosites."""
    about, _, layout = describe_sites(result.capture.layout)
    return {key: about[key] for key in ("n_sites", "bounds_um", "palette")}, outlines_of(layout)


@part("Values of the photosites", _capture)
def columns(result: Simulated) -> PartData:
    """Return the columns of the photosites: codes, electrons, signal to noise, filters."""
    about, arrays, _ = describe_sites(result.capture, sensor=result.shot.camera.sensor)
    return {key: about[key] for key in ("columns", "filter", "notes")}, arrays


@part("Noise", _capture)
def noise(result: Simulated) -> PartData:
    """Return the noise budget: median over the photosites by source, e-."""
    sensor, capture = result.shot.camera.sensor, result.capture
    budget = noise_budget(sensor, result.photo_e_per_s, result.shot.exposure_s)
    sources = [
        {"name": name, "label": name.replace("_", " "), "is_temporal": name in budget.temporal, "values": found}
        for name, values in budget.items()
        if (found := float(np.median(values))) > 0.0
    ]
    return {"sources": sources, "unit": "e⁻", "median_electrons": float(np.median(capture.electrons))}, {}


@part("Spectrum", lambda result: (result.shot.camera.sensor,))
def spectrum(result: Simulated) -> PartData:
    """Return the spectral response of each filter, electrons per photon."""
    wavelength_nm, e_per_j = _responsivity(result)
    e_per_photon = e_per_j * photon_energy_j(wavelength_nm)
    curves = [
        {"label": name, "unit_x": "nm", "unit_y": "e⁻ per photon", "name": name} for name in result.capture.filter_names
    ]
    return _curves(curves, [wavelength_nm] * len(curves), list(e_per_photon))


def _responsivity(result: Simulated) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return wavelengths, and the responsivity of each filter at these, (n_filter, n), e-/J."""
    sensor = result.shot.camera.sensor
    for low_nm, high_nm in RANGES_NM:
        wavelength_nm = np.linspace(low_nm, high_nm, N_WAVELENGTHS)
        with suppress(ParameterError):
            return wavelength_nm, sensor.responsivity_e_per_j(wavelength_nm)
    wavelength_nm = np.sort(result.shot.scene.wavelength_nm)
    return wavelength_nm, sensor.responsivity_e_per_j(wavelength_nm)


@part("MTF", lambda result: (result.capture.layout, result.shot.camera.optics, result.shot.scene))
def mtf(result: Simulated) -> PartData:
    """Return MTF curves of the lens on the axis and of three photosites."""
    layout, scene = result.capture.layout, result.shot.scene
    order = np.argsort(layout.area_um2, kind="stable")
    chosen = {"smallest site": order[0], "median site": order[order.size // 2], "largest site": order[-1]}
    last_per_mm = float(per_mm_from_per_um(1.0 / np.sqrt(layout.area_um2[order[0]])))
    frequency_per_mm = np.linspace(0.0, last_per_mm, N_FREQUENCIES)
    values = {name: polygon_mtf(layout[np.array([site])], frequency_per_mm)[0] for name, site in chosen.items()}
    if isinstance(scene, Scene):
        wavelength_nm = float(np.median(scene.wavelength_nm))
        lens = result.shot.camera.optics.mtf(frequency_per_mm, wavelength_nm=wavelength_nm, distance_m=scene.distance_m)
        values = {f"lens, {wavelength_nm:g} nm": lens, **values}
    curves = [{"label": name, "unit_x": "1/mm", "unit_y": ""} for name in values]
    return _curves(curves, [frequency_per_mm] * len(curves), list(values.values()))


@part("Picture", _capture)
def picture(result: Simulated) -> PartData:
    """Return the picture that is reconstructed from the codes."""
    capture = result.capture
    found = capture.picture(max_pixels=PICTURE_PIXELS)
    levels = found.data / capture.white_dn.reshape(-1, 1, 1).astype(np.float32)
    return _picture(levels, found.coverage, found.grid.bounds_um)


@part("Optical image", lambda result: (*result.images.values(), result.shot.scene))
def scene(result: Simulated) -> PartData:
    """Return the optical image through each colour filter."""
    camera, source = result.shot.camera, result.shot.scene
    if isinstance(source, PowerMap):
        bands, grid = source.data[np.argsort(-source.wavelength_nm)], source.grid
    else:
        # With lateral chromatic aberration, each wavelength has its own grid: the largest is shown.
        widest = max((key[0] for key in result.images), key=lambda each: each.pitch_x_um)
        found = {key[1]: image for key, image in result.images.items() if key[0] == widest}
        bands = np.stack([found[c] / np.float32(result.capture.white_dn[c]) for c in sorted(found)])
        bounds_um = np.array(camera.image_grid(source).bounds_um)
        pitch_um = (bounds_um[2:] - bounds_um[:2]) / bands.shape[:0:-1]
        grid = Grid(widest.shape, (float(pitch_um[0]), float(pitch_um[1])), tuple(bounds_um[:2].tolist()))
    data, grid = _reduced(bands, grid)
    scale = float(np.quantile(data, WHITE_QUANTILE)) or 1.0
    about, arrays = _picture(data / scale, np.ones(data.shape[1:], np.float32), grid.bounds_um)
    return about, arrays


@part("Design rules", lambda result: (result.capture.layout, result.shot.rules))
def rules(result: Simulated) -> PartData:
    """Return the results of the design-rule check."""
    if result.shot.rules is None:
        return {"rules": []}, {}
    arrays: dict[str, NDArray[Any]] = {}
    report = result.capture.layout.check(result.shot.rules)
    return {"rules": rules_of(report, arrays), "is_satisfied": bool(report.ok)}, arrays


@part("A and B", lambda result: (result.capture, result.frozen and result.frozen.capture))
def comparison(result: Simulated) -> PartData:
    """Return budgets and picture quality of the frozen variant and the current one."""
    if result.frozen is None:
        raise SimulationError("there is no variant A to compare with")
    return compare(result.frozen, result), {}


def summary_of(result: Simulated) -> dict[str, Any]:
    """Return numbers of a capture, with units in their names."""
    capture, layout = result.capture, result.capture.layout
    x0, y0, x1, y1 = layout.bounds_um
    size_um = np.sqrt(layout.area_um2)
    found = {
        "n_sites": layout.n_sites,
        "bounds_um": [x0, y0, x1, y1],
        "width_um": x1 - x0,
        "height_um": y1 - y0,
        "min_size_um": float(size_um.min()),
        "max_size_um": float(size_um.max()),
        "exposure_s": result.shot.exposure_s,
        "bits": capture.bits,
        "mean_dn": float(capture.code.mean()),
        "median_e": float(np.median(capture.electrons)),
        "saturated_fraction": capture.saturated_fraction,
        "dark_fraction": float(np.mean(capture.code == 0)),
        "f_number": result.shot.camera.optics.f_number,
    }
    if isinstance(result.shot.scene, Scene):
        found["magnification"] = float(result.shot.camera.optics.magnification(result.shot.scene.distance_m))
    return found


def _curves(curves: list[dict[str, Any]], x: list[NDArray[Any]], y: list[NDArray[Any]]) -> PartData:
    """Return curves with their arrays."""
    arrays = {
        f"{axis}-{k}": np.asarray(v, np.float32) for axis, each in (("x", x), ("y", y)) for k, v in enumerate(each)
    }
    return {"curves": curves}, arrays


def _reduced(bands: NDArray[Any], grid: Grid) -> tuple[NDArray[np.float32], Grid]:
    """Return means of blocks of cells; incomplete upper and right blocks are cropped."""
    n_y, n_x = bands.shape[1:]
    block = max(1, -(-max(n_y, n_x) // PICTURE_PIXELS))
    rows, n_columns = n_y // block, n_x // block
    cells = bands[:, : rows * block, : n_columns * block].reshape(-1, rows, block, n_columns, block)
    data = cells.mean(axis=(2, 4), dtype=np.float32)
    pitch_x_um, pitch_y_um = grid.pitch_x_um * block, grid.pitch_y_um * block
    return data, Grid((rows, n_columns), (pitch_x_um, pitch_y_um), grid.origin_um)


def _picture(light: NDArray[Any], coverage: NDArray[Any], bounds_um: tuple[float, ...]) -> PartData:
    """Return bytes of a picture, top row first, from linear (n_channel, n_y, n_x)."""
    if light.shape[0] not in (1, 3):
        light = light.mean(axis=0, keepdims=True)
    level = np.clip(np.nan_to_num(light) * np.float32(N_LEVELS - 1), 0, N_LEVELS - 1).astype(np.uint16)
    pixels = np.empty((*coverage.shape, 4), np.uint8)
    pixels[..., :3] = np.moveaxis(_srgb_table()[level], 0, -1)[::-1]
    pixels[..., 3] = np.rint(255.0 * np.clip(coverage, 0.0, 1.0))[::-1]
    about = {"width": pixels.shape[1], "height": pixels.shape[0], "bounds_um": list(bounds_um)}
    return about, {"rgba": pixels}


@lru_cache(maxsize=1)
def _srgb_table() -> NDArray[np.uint8]:
    """Return the sRGB byte of each level of linear light."""
    return encode_light(np.linspace(0.0, 1.0, N_LEVELS))
