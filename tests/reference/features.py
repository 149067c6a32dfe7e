"""
Features of the package as axes of a table, and settings of a shot with one feature of each axis.

Every feature is a piece of a settings file. Names and examples of layouts, edits, charts, pupils and lens models come from the
registries.
"""

from __future__ import annotations

import copy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from foveasim._io.images import write_picture
from foveasim.config import build_shot
from foveasim.distortion import LENSES
from foveasim.layout import EDITS, LAYOUTS
from foveasim.optics import PUPILS
from foveasim.scene import SCENES

#: Lens with an image of 36 µm at 17 degrees, where distortion and relative illumination matter.
FOCAL_MM, DISTANCE_M = 0.06, 0.05
IMAGE_UM = 1e3 / (1.0 / FOCAL_MM - 1.0 / (1e3 * DISTANCE_M))
#: Pixels of a scene, of 0.6 µm in the image.
SHAPE = (112, 120)
PITCH_UM = 0.6 * (1e3 * DISTANCE_M) / (1e-3 * IMAGE_UM)
EXPOSURE_S = 0.002
CENTRE_UM = [0.7, -0.4]
BASE = {
    "optics": {"focal_length_mm": FOCAL_MM, "f_number": 2.8},
    "sensor": {"qe": 0.6, "capacitance_f": 2e-15, "v_sat_v": 1.0, "bits": 10},
    "exposure_s": EXPOSURE_S,
    "seed": 5,
}
#: Scenes: their geometry, and arguments instead of those of the examples, whose sizes in mm are smaller.
GEOMETRY = {"pitch_um": PITCH_UM, "distance_m": DISTANCE_M}
CHART = GEOMETRY | {"shape": list(SHAPE)}
RADIANCE = {"radiance_w_m2_sr_nm": [0.03, 0.05, 0.04], "wavelength_nm": [450.0, 550.0, 620.0], "band_width_nm": 60.0}
GREY = {"radiance_w_m2_sr_nm": 0.12, "wavelength_nm": [550.0], "band_width_nm": 60.0}
POINTS = {"wavelength_nm": [550.0], "band_width_nm": 60.0}
SCENE_ARGUMENTS: dict[str, dict[str, Any]] = {
    "picture": GEOMETRY
    | {"picture": "picture.png", "peak_radiance_w_m2_sr_nm": 0.08, "wavelength_nm": [620.0, 550.0, 450.0]},
    "rgbd": GEOMETRY
    | {"picture": "picture.png", "peak_radiance_w_m2_sr_nm": 0.08, "wavelength_nm": [620.0, 550.0, 450.0]}
    | {"depth_m": "depth.png", "depth_scale": 1e-6},
    "panorama": {
        "picture": "panorama.png",
        "peak_radiance_w_m2_sr_nm": 0.08,
        "distance_m": DISTANCE_M,
        "cells": SHAPE[1],
    }
    | {"wavelength_nm": [620.0, 550.0, 450.0], "yaw_deg": 20.0},
    "flat": CHART | GREY,
    "point_sources": CHART | POINTS | {"pixels": [[30, 40], [60, 61], [80, 20]], "intensity_w_sr_nm": 1e-4},
    "display": {
        "picture": "picture.png",
        "distance_m": DISTANCE_M,
        "wavelength_nm": [620.0, 550.0, 450.0],
        "subpixels": True,
        "display": {"kind": "lcd", "pitch_um": PITCH_UM, "white_cd_m2": 5000.0},
    },
    "cube": GEOMETRY | {"path": "cube.hdr", "quantity": "radiance", "unit": "W/m2/sr/nm"},
    "checkerboard": CHART | RADIANCE | {"square_mm": 6.0},
    "slanted_edge": CHART | GREY,
    "bars": CHART | RADIANCE | {"groups": [1, 2, 3]},
    "letter_f": CHART | GREY | {"height_mm": 15.0},
    "grey_scale": CHART | RADIANCE | {"patch_mm": 4.0},
    "colour_chart": CHART
    | {"patch_mm": 6.0, "radiance_w_m2_sr_nm": 0.02, "wavelength_nm": [430.0, 490.0, 550.0, 610.0, 670.0]},
    "point_grid": CHART | POINTS | {"spacing_mm": 16.0 * PITCH_UM / 1e3, "intensity_w_sr_nm": 1e-5},
    "sine": CHART | RADIANCE | {"line_pairs_per_mm": 0.1, "angle_deg": 20.0},
    "zone_plate": CHART | GREY | {"line_pairs_per_mm": 0.2},
    "siemens_star": CHART | RADIANCE,
}
#: Parameters of generators and edits in files that differ from those in Python.
LAYOUT_FILE_ARGUMENTS = {
    "grid": {"stagger": False, "trench_um": 0.0},
    "quadtree": {"importance": "importance.png"},
    "voronoi_of": {"points_um": [[3.1 * (k % 8) - 10.8 + 0.4 * (k % 3), 3.0 * (k // 8) - 7.5] for k in range(48)]},
}
EDIT_FILE_ARGUMENTS: dict[str, dict[str, Any]] = {
    "overlay": {
        "layer": {"generator": "grid", "parameters": {"n_x": 3, "n_y": 2, "pitch_um": 2.5}, "move_um": [1.0, 2.0]},
        "operation": "replace",
    },
    "repair": {"rules": {"min_size_um": 1.0}},
    "inset": {"margin_um": 0.1},
    "snap": {"grid_um": 0.1},
    "scale": {"factor": 1.1},
    "merge_small": {"min_size_um": 1.5},
    "draw": {"outlines_um": [[[21.0, 21.0], [23.0, 21.0], [22.0, 23.0]]], "channel": 0},
}


#: Position of all lens models; lengths in their examples are for a focal length of 60 µm.
#: Models whose image height is a function of the angle, as that of ``fisheye``.
AS_FISHEYE = ("double_sphere", "extended_unified", "field_of_view")
LENS = {"focal_um": IMAGE_UM, "centre_um": CENTRE_UM}


def pupil_arguments(name):
    """Return the example of a pupil, with a picture in the directory of :func:`write_files`."""
    return {"picture": "pupil.png"} if name == "image" else PUPILS.example(name)


def plain(value):
    """Return settings with lists instead of tuples and arrays."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, tuple | list | np.ndarray):
        return [plain(each) for each in value]
    return value


def layouts():
    return {
        name: {
            "layout": {
                "generator": name,
                "parameters": plain({**LAYOUTS.example(name), **LAYOUT_FILE_ARGUMENTS.get(name, {})}),
            }
        }
        for name in LAYOUTS
    }


#: Edits that are features of the axis of colours.
COLOUR_EDITS = ("mosaic", "graph_colouring", "random_channels")


def edits():
    return {
        "none": {},
        **{
            name: {"layout": {"edits": [{"kind": name, **plain(EDIT_FILE_ARGUMENTS.get(name, EDITS.example(name)))}]}}
            for name in EDITS
            if name not in COLOUR_EDITS
        },
    }


def points_on(layout, edit):
    """Return the arguments of edits at points, with points of a layout."""
    polygons = layout.polygons()
    inner = [shapely.point_on_surface(polygon).coords[0] for polygon in polygons]
    if edit == "merge_at":
        shared_um = layout.adjacency().tocoo()
        longest = shared_um.data.argmax()
        return {"points_um": plain([inner[shared_um.row[longest]], inner[shared_um.col[longest]]])}
    site = int(np.diff(layout.ring_offsets)[layout.site_offsets[:-1]].argmax())
    vertex = layout.xy_um[layout.ring_offsets[layout.site_offsets[site]]].tolist()
    if edit == "move_vertices":
        return {"from_um": [vertex], "to_um": [[vertex[0] + 0.02, vertex[1] + 0.01]]}
    if edit == "remove_vertices":
        return {"points_um": [vertex]}
    more = {"split_at": {"n_x": 2}, "move_sites": {"by_um": [0.2, 0.1]}, "set_channel": {"channel": 0}}
    return {"points_um": plain([inner[layout.n_sites // 3]]), **more.get(edit, {})}


#: Edits whose points depend on the layout.
POINT_EDITS = ("remove_at", "merge_at", "split_at", "move_sites", "move_vertices", "remove_vertices", "set_channel")


def sensor(**values):
    return {"sensor": values}


def own(name, **values):
    return {"sensor": {"effects": [{"kind": name, **values}]}}


@cache
def axes():
    """Return the features of each axis, as settings by name."""
    return {
        "scene": {
            name: {"scene": {"kind": name, **(SCENE_ARGUMENTS.get(name) or plain(SCENES.example(name)) | GEOMETRY)}}
            for name in SCENES
        },
        "optics": {
            "circle": {},
            **{name: {"optics": {"pupil": {"kind": name, **pupil_arguments(name)}}} for name in PUPILS},
            "zernike": {"optics": {"zernike": {"coefficients": {4: 0.1, 7: 0.15}}}},
            "seidel": {"optics": {"seidel": {"coma_um": 0.4}, "field_patches": 2}},
            "lateral_colour": {
                "optics": {"lateral_colour": {"wavelength_nm": [400.0, 700.0], "magnification": [1.0, 1.01]}}
            },
            "isotropic": {"optics": {"emission": "isotropic"}},
            "oversample": {"optics": {"oversample": 3}},
            "square": {
                "optics": {
                    "source_pixel": "square",
                    "padding": "edge",
                    "relative_illumination": {"image_height_um": [0.0, 1000.0], "fraction": [1.0, 0.6]},
                }
            },
        },
        "distortion": {
            "none": {},
            **{
                name: {"distortion": {"kind": name, **example, **LENS}}
                for name in LENSES
                if name not in AS_FISHEYE and not callable(example := LENSES.example(name))  # files
            },
        },
        "order": {"auto": {}, "1": {"integration_order": 1}, "2": {"integration_order": 2}},
        "layout": layouts(),
        "edit": edits(),
        "move": {"none": {}, "moved": {"layout": {"move_um": [0.5, -0.3]}}},
        "colour": {
            "mono": {},
            "graph": sensor(filters="rgb") | {"layout": {"edits": [{"kind": "graph_colouring", "n_channels": 3}]}},
            "random": sensor(filters="rgb")
            | {"layout": {"edits": [{"kind": "random_channels", "fractions": [1.0, 2.0, 1.0], "seed": 0}]}},
        },
        "photo": {
            "uniform": {},
            "prnu": sensor(prnu_fraction=0.02),
            "dead": sensor(dead_fraction=0.1),
            "sensitivity": sensor(sensitivity={"per_um2": 0.02}),
            "corner_loss": own("corner_loss", loss=0.5, radius_um=40.0),
        },
        "dark": {
            "none": {},
            "dsnu": sensor(dark_e_per_s=500.0, dsnu_fraction=0.2),
            "hot": sensor(dark_e_per_s={"per_um2": 100.0}, hot_fraction=0.05, hot_e_per_s=5e4),
            "after_glow": own("after_glow", fraction=0.1),
        },
        "charge": {
            "separate": {},
            "full_well": sensor(full_well_e=6000.0),
            "full_well_per_area": sensor(full_well_e={"per_um2": 2000.0}),
            "diffusion": sensor(crosstalk={"kind": "diffusion", "spread_um": 0.3}),
            "ipc": sensor(coupling={"neighbour_fraction": 0.02}),
        },
        "shot": {"auto": {}, "exact": sensor(shot_noise="exact"), "off": sensor(shot_noise="off")},
        "temporal": {
            "none": {},
            "read": sensor(read_noise_e=8.0),
            "reset": sensor(ktc_noise=True),
            "cds": sensor(ktc_noise=True, cds=True, read_noise_e=5.0),
            "rts": sensor(read_noise_e=3.0, rts_fraction=0.2, rts_e=20.0),
            "reset_sag": own("reset_sag", sigma_v=1e-3),
            "line_noise": own("line_noise", sigma_v=1e-3),
        },
        "fixed": {
            "none": {},
            "gain_fpn": sensor(gain_fpn_fraction=0.02, capacitance_f={"per_um2": 4e-15}),
            "pixel_fpn": sensor(pixel_fpn_fraction=0.01, pedestal_v=0.05),
            "column_fpn": sensor(line_fpn_fraction=0.01, pedestal_v=0.05),
            "nonlinearity": sensor(nonlinearity_fraction=0.05),
            "stitched_gain": own("stitched_gain", left=1.0, right=1.1),
        },
        "adc": {
            "linear": {},
            "8 bits": sensor(bits=8),
            "log": sensor(companding="log"),
            "root": sensor(companding="root"),
            "dnl": sensor(dnl_dn=0.3),
            "inl": sensor(inl_dn=[0.0, 2.0, -1.0, 0.0]),
            "disabled": sensor(read_noise_e=4.0, disabled=["read"]),
        },
    }


#: Edits that cut sites along other outlines, and leave slivers of some.
CUTTING_EDITS = ("clip", "cut_along", "cut_out", "overlay")
#: Features that only some generators have: sites with readout lines.
WITHOUT_LINES = ("penrose", "sunflower", "voronoi", "voronoi_of")


def is_possible(row):
    """Whether features can be combined; None stands for any feature, and what follows the features is ignored."""
    features = dict(zip(axes_names(), row, strict=False))
    needs_lines = features.get("fixed") == "column_fpn" or features.get("adc") == "dnl"
    if needs_lines and features.get("layout") in WITHOUT_LINES:
        return False
    # Points that radiate uniformly are those of a plane; images of panoramas through lens models are not rectilinear.
    is_isotropic = features.get("scene") == "panorama" and features.get("optics") == "isotropic"
    if is_isotropic and features.get("distortion") not in (None, "none"):
        return False
    has_slivers = features.get("edit") in CUTTING_EDITS and features.get("layout") not in (None, "grid")
    # Capacitances in proportion to the area of slivers are below the limit, and couple to those of their neighbours too strongly.
    if has_slivers and features.get("fixed") == "gain_fpn":
        return False
    return not (features.get("edit") == "inset" and features.get("charge") in ("diffusion", "ipc"))  # no shared edges


def axes_names():
    return list(axes())


def settings_with(**features):
    """Return settings with the given features, and the first of every other axis."""
    return settings_of([features.get(axis, next(iter(each))) for axis, each in axes().items()])


def merge(settings, feature):
    """Add a feature to settings: sections are merged, lists joined."""
    for key, value in feature.items():
        if isinstance(value, dict) and isinstance(settings.get(key), dict):
            merge(settings[key], value)
        elif isinstance(value, list) and key in ("edits", "effects") and key in settings:
            settings[key] = [*settings[key], *copy.deepcopy(value)]
        else:
            settings[key] = copy.deepcopy(value)


def settings_of(row):
    """Return the settings of a row of features."""
    settings = copy.deepcopy(BASE)
    for axis, name in zip(axes(), row, strict=True):
        feature = axes()[axis][name]
        if axis == "edit" and name in POINT_EDITS:
            layout = {key: value for key, value in settings["layout"].items() if key != "edits"}
            generated = build_shot(None, {**settings, "layout": layout, "sensor": {}}).camera.sensor.layout
            feature = {"layout": {"edits": [{"kind": name, **points_on(generated, name)}]}}
        merge(settings, feature)
    return settings


def write_files(directory: Path):
    """Write the files that the settings refer to."""
    rng = np.random.default_rng(0)
    write_picture(directory / "picture.png", rng.integers(0, 256, (*SHAPE, 3), np.uint8))
    write_picture(directory / "panorama.png", rng.integers(0, 256, (360, 720, 3), np.uint8))
    near = np.hypot(*np.mgrid[-1 : 1 : 1j * SHAPE[0], -1 : 1 : 1j * SHAPE[1]]) < 0.4
    write_picture(directory / "depth.png", np.where(near, 300, int(1e6 * DISTANCE_M)).astype(np.uint16))
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    write_picture(directory / "pupil.png", np.uint8(255 * (np.hypot(x, y) < 0.9) * (y > -0.4)))
    write_picture(directory / "importance.png", np.uint8(255 * np.exp(-3.0 * np.hypot(x, y))))
    cube = rng.random((4, *SHAPE), dtype=np.float32) * 0.04
    cube.tofile(directory / "cube.img")
    wavelengths = ", ".join(str(each) for each in (450, 520, 590, 660))
    (directory / "cube.hdr").write_text(
        f"ENVI\nsamples = {SHAPE[1]}\nlines = {SHAPE[0]}\nbands = 4\nheader offset = 0\ndata type = 4\ninterleave = bsq\n"
        f"byte order = 0\nwavelength units = nm\nwavelength = {{{wavelengths}}}\n"
    )
