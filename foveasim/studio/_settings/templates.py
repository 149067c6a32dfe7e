"""Valid initial values of sections and parameters that are chosen on the page."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from foveasim._core.registry import Registry
from foveasim.distortion import LENSES
from foveasim.errors import FoveasimError
from foveasim.layout import EDITS, LAYOUTS, mosaic
from foveasim.layout.sizes.sizing import SIZES, initial_parameters
from foveasim.optics.pupils import PUPILS
from foveasim.scene.registry import DISPLAYS, SCENES
from foveasim.sensor import PIXEL_OPTICS
from foveasim.sensor.effects import EFFECTS
from foveasim.sensor.spectral import CURVES

#: Module of edits whose parameters are points of the layout, which examples of other layouts do not have.
OF_POINTS = "foveasim.layout.edits.at_points"
#: A mosaic, to find out whether a layout can have one.
BLOCK = ["RG", "GB"]
#: Initial values of required parameters by name.
INITIAL: dict[str, Any] = {
    "band_width_nm": 100.0,
    "bits": 10,
    "display": "lcd",
    "distance_m": 1.0,
    "f_number": 2.8,
    "fit": "cover",
    "focal_length_mm": 8.0,
    "focal_um": 8000.0,
    "full_well_e": 10000.0,
    "intensity_w_sr_nm": 1e-6,
    "peak_radiance_w_m2_sr_nm": 0.02,
    "picture": "skimage:astronaut",
    "pitch_um": 500.0,
    "radiance_w_m2_sr_nm": 0.02,
    "shape": [512, 512],
    "wavelength_nm": 550.0,
}
#: Initial values of sections by their title in the schema.
SECTIONS: dict[str, dict[str, Any]] = {
    "annulus kind": {"obscuration": 0.3},
    "bars kind": {"groups": [-3, -2, -1]},
    "blades kind": {"n_blades": 6},
    "chief ray table": {"image_height_um": [0.0, 500.0, 1000.0], "angle_deg": [0.0, 5.0, 10.0]},
    "checkerboard kind": {"square_mm": 16.0},
    "clean kind": {"tolerance_um": 0.005},
    "clip kind": {"region": [[-200.0, -200.0], [200.0, -200.0], [200.0, 200.0], [-200.0, 200.0]], "cut": "drop"},
    "colour_chart kind": {"patch_mm": 35.0},
    "constant kind": {"value": 0.6},
    "coupling": {"neighbour_fraction": 0.01},
    "cut_out kind": {"region": [[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]]},
    "diffusion kind": {"spread_um": 1.0},
    "filter set": {
        "curves": [{"kind": "gaussian", "centre_nm": centre_nm, "fwhm_nm": 80.0} for centre_nm in (610.0, 540.0, 460.0)],
        "names": ["R", "G", "B"],
    },
    "fisheye kind": {"projection": "equidistant"},
    "gaussian kind": {"centre_nm": 550.0, "fwhm_nm": 150.0},
    "graph_colouring kind": {"n_channels": 3},
    "grey_scale kind": {"patch_mm": 20.0},
    "inset kind": {"margin_um": 0.1},
    "kernel kind": {"kernel": [[0.0, 0.01, 0.0], [0.01, 0.96, 0.01], [0.0, 0.01, 0.0]]},
    "lateral colour": {"wavelength_nm": [450.0, 550.0, 650.0], "magnification": [0.999, 1.0, 1.001]},
    "letter_f kind": {"height_mm": 150.0},
    "log_polar parameters": initial_parameters("log_polar") | {"fovea": "rings"},
    "merge_small kind": {"min_size_um": 2.0},
    "mosaic kind": {"block": ["RG", "GB"]},
    "overlay kind": {
        "layer": {"generator": "grid", "parameters": {"n_x": 20, "n_y": 20, "pitch_um": 4.0}}, "operation": "replace",
    },
    "panorama kind": {
        "mapping": "fisheye", "lens": {"kind": "fisheye", "projection": "equidistant", "focal_um": 1630.0}, "pixel_um": 10.0,
    },
    "pass_band kind": {"from_nm": 420.0, "to_nm": 680.0},
    "point_grid kind": {"spacing_mm": 16.0, "pitch_um": 500.0},
    "point_sources kind": {"pixels": [[256, 256]]},
    "polynomial kind": {"wavelength_nm": [400.0, 500.0, 600.0, 700.0], "value": [0.3, 0.6, 0.6, 0.4], "degree": 3},
    "polynomial_fisheye kind": {"k": [0.0, 0.0, 0.0, 0.0]},
    "product kind": {"curves": [0.8, {"kind": "silicon", "depth_um": 3.0}]},
    "quadtree parameters": initial_parameters("quadtree") | {"importance": "skimage:camera", "n_sites": 5000},
    "readout": {"frames_per_s": 30.0, "bits": 10},
    "random_channels kind": {"fractions": [1.0, 2.0, 1.0], "seed": 0},
    "relative illumination table": {"image_height_um": [0.0, 500.0, 1000.0], "fraction": [1.0, 0.95, 0.8]},
    "repair kind": {"rules": {"min_size_um": 2.0}},
    "requirement": {"measure": "snr", "at_least": 10.0},
    "rotate kind": {"angle_deg": 15.0},
    "routing": {"width_um": 0.2, "space_um": 0.2},
    "scale kind": {"factor": 1.2},
    "scaramuzza kind": {"a": [1.57e3, -2.75e-4, 3.76e-8, -3.64e-11], "pixel_um": 5.1},
    "siemens_star kind": {"n_spokes": 36, "radius_mm": 110.0},
    "silicon kind": {"depth_um": 3.0},
    "sine kind": {"line_pairs_per_mm": 0.05},
    "slit kind": {"width_fraction": 0.5},
    "snap kind": {"grid_um": 0.005},
    "spider kind": {"n_vanes": 4, "width_fraction": 0.05},
    "spline kind": {"wavelength_nm": [400.0, 500.0, 600.0, 700.0], "value": [0.3, 0.6, 0.6, 0.4]},
    "split kind": {"n_x": 2, "n_y": 1},
    "step kind": {"edge_nm": [400.0, 500.0, 600.0, 700.0], "value": [0.3, 0.6, 0.4]},
    "table kind": {"wavelength_nm": [400.0, 500.0, 600.0, 700.0], "value": [0.3, 0.6, 0.6, 0.4]},
    "tiling parameters": initial_parameters("tiling") | {"border": "drop"},
    "translate kind": {"dx_um": 10.0, "dy_um": 0.0},
    "voronoi_of parameters": {
        "points_um": [[-200.0, -150.0], [180.0, -190.0], [-40.0, 20.0], [210.0, 110.0], [-180.0, 200.0], [60.0, 240.0]],
        "size_um": [600.0, 600.0],
    },
    "zernike": {"coefficients": {"4": 0.1}},
    "zone_plate kind": {"line_pairs_per_mm": 0.5},
}  # fmt: skip
#: Initial values per µm² by parameter.
PER_AREA: dict[str, float] = {
    "capacitance_f": 1.5e-16,
    "dark_e_per_s": 10.0,
    "full_well_e": 2000.0,
    "read_noise_e": 0.05,
    "sensitivity": 0.001,
}
#: Registries of the sections whose titles in the schema end with a word.
REGISTRIES: dict[str, tuple[Registry[Any], ...]] = {
    "kind": (SCENES, DISPLAYS, LENSES, PUPILS, CURVES, EFFECTS, PIXEL_OPTICS, EDITS),
    "parameters": (LAYOUTS,),
}


def templates(title: str) -> dict[str, Any]:
    """
    Return the initial values of a section by its title in the schema.

    Registered kinds without values of the page have those of their examples.
    """
    if title in SECTIONS:
        return SECTIONS[title]
    name, _, word = title.rpartition(" ")
    if word == "parameters" and name in SIZES:
        return initial_parameters(name)
    for registry in REGISTRIES.get(word, ()):
        item = registry.get(name)
        example = None if item is None or item.__module__ == OF_POINTS else registry.example(name)
        if isinstance(example, Mapping):
            return {key: _plain(value) for key, value in example.items()}
    return {}


def _plain(value: Any) -> Any:
    """Return a value as settings files contain it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list | tuple) else value


def has_mosaic(generator: str) -> bool:
    """Return whether the sites of a generator are in rows and columns, or rings and sectors."""
    declared: bool | None = getattr(LAYOUTS.get(generator), "has_mosaic", False)
    return _has_mosaic(generator, LAYOUTS.version) if declared is None else declared


@lru_cache(maxsize=64)
def _has_mosaic(generator: str, _version: int) -> bool:
    try:
        mosaic(LAYOUTS[generator](**LAYOUTS.example(generator)), BLOCK)
    except (FoveasimError, TypeError, ValueError):  # no rows and columns, or an example with files
        return False
    return True
