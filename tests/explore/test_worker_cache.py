"""Cache of a worker: every component equals a fresh one, whatever was computed before."""

from __future__ import annotations

import copy
import hashlib
import json
import typing
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from pydantic import BaseModel
from reference.twins import small_twin

from foveasim._io.images import write_picture
from foveasim.config import Source
from foveasim.config._models import models
from foveasim.config._objects import put_setting
from foveasim.explore.worker_cache import ShotRunner, WorkerCache
from foveasim.layout import Layout
from foveasim.metrics import METRICS
from foveasim.optics import PSFGrid
from foveasim.sensor.effects import EFFECTS, FixedFactor


@EFFECTS.register("ramp of test_worker_cache")
@dataclass(frozen=True)
class Ramp(FixedFactor):
    """Test effect: a loss that increases with the number of the site."""

    name: ClassVar[str] = "ramp"
    stage: ClassVar[str] = "photo"

    loss: float = 0.5

    def pattern(self, sites):
        return 1.0 - self.loss * np.linspace(0.0, 1.0, sites.n_sites)


#: A shot with every section, in which almost every setting changes the result.
SHOT = {
    "scene": {
        "kind": "picture",
        "picture": "picture.png",
        "pitch_um": 600.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.004,
        "wavelength_nm": [450.0, 550.0, 650.0],
        "band_width_nm": [80.0, 80.0, 80.0],
    },
    "optics": {
        "focal_length_mm": 8.0,
        "f_number": 2.8,
        "transmission": 0.9,
        "lateral_colour": {"wavelength_nm": [450.0, 650.0], "magnification": [0.999, 1.001]},
    },
    "distortion": {"kind": "brown_conrady", "focal_um": 300.0, "k1": -0.1},
    "layout": {
        "generator": "log_polar",
        "parameters": {"n_sectors": 24, "r_max_um": 30.0, "r_min_um": 6.0},
        "mosaic": "bayer",
        "edits": [{"kind": "rotate", "angle_deg": 10.0}, {"kind": "scale", "factor": 1.1}],
        "rules": {"min_size_um": 0.1},
    },
    "sensor": {
        "qe": 0.6,
        "filters": "rgb",
        "sensitivity": 0.9,
        "prnu_fraction": 0.02,
        "dark_e_per_s": 40.0,
        "temperature_k": 310.0,
        "dsnu_fraction": 0.1,
        "hot_fraction": 0.1,
        "hot_e_per_s": 2000.0,
        "dead_fraction": 0.05,
        "crosstalk": {"kind": "diffusion", "spread_um": 0.8, "max_gap_um": 0.3},
        "full_well_e": 1000.0,
        "coupling": {"neighbour_fraction": 0.01, "max_gap_um": 0.3},
        "ktc_noise": True,
        "read_noise_e": 2.0,
        "rts_fraction": 0.1,
        "rts_e": 20.0,
        "capacitance_f": 4e-15,
        "gain_fpn_fraction": 0.01,
        "nonlinearity_fraction": 0.02,
        "pedestal_v": 0.01,
        "pixel_fpn_fraction": 0.01,
        "line_fpn_fraction": 0.01,
        "companding": "log",
        "dnl_dn": 0.2,
        "bits": 12,
    },
    "exposure_s": 0.002,
    "seed": 1,
}
#: The same with aberrations, for whose settings one wavelength is sufficient.
ABERRATED = SHOT | {
    "scene": {
        "kind": "flat",
        "shape": [20, 20],
        "pitch_um": 700.0,
        "distance_m": 1.0,
        "radiance_w_m2_sr_nm": 0.01,
        "wavelength_nm": 550.0,
        "band_width_nm": 80.0,
    },
    "optics": {
        "focal_length_mm": 8.0,
        "f_number": 2.8,
        "zernike": {"coefficients": {"5": 0.1}, "wavelength_nm": 550.0, "unit": "waves"},
        "padding": "zero",
    },
}
ABERRATIONS = (
    "optics.zernike",
    "optics.seidel",
    "optics.field_patches",
    "optics.field_tolerance",
    "optics.field_modes",
)
#: Alternatives of the radiance of a scene.
LEVELS = ("scene.luminance_cd_m2", "scene.illuminance_lux", "scene.reflectance")
#: Settings without effect on planes.
OF_PANORAMAS = {"gaze_deg", "optics.projection", "optics.pupil_tilt"}
#: Other values of settings whose type does not suggest one.
OTHERS = {
    "times_s": [0.0, 0.05],
    "scene.picture": "other.png",
    "scene.spectrum": [[1.0, 0.5, 0.2], [0.5, 1.0, 0.5], [0.2, 0.5, 1.0]],
    "scene.wavelength_nm": [460.0, 560.0, 660.0],
    "scene.band_width_nm": [80.0, 80.0, 60.0],
    "scene.pitch_um": 550.0,
    "scene.field_of_view_deg": 0.6,
    "optics.pupil": {"kind": "slit", "width_fraction": 0.4},
    "optics.zernike.coefficients": {"5": 0.1, "8": 0.1},
    "optics.zernike.wavelength_nm": 600.0,
    "optics.lateral_colour.wavelength_nm": [450.0, 660.0],
    "optics.lateral_colour.magnification": [0.999, 1.002],
    "optics.seidel": {"spherical_um": 0.1},
    "optics.psfs": {"path": "psfs.npz"},
    "optics.relative_illumination": {"image_height_um": [0.0, 1e4], "fraction": [1.0, 0.5]},
    "optics.focus_distance_m": 0.9,
    "optics.oversample": 3,
    "optics.field_modes": 3,
    "optics.field_patches": 2,
    "optics.exit_pupil_mm": 2.0,
    "optics.chief_ray": {"image_height_um": [0.0, 1e4], "angle_deg": [0.0, 20.0]},
    "sensor.pixel_optics": {"kind": "microlens", "height_um": 3.0, "refractive_index": 1.5, "photodiode_inset_um": 0.3},
    "sensor.bits": 10,
    "sensor.provenance": {"title": "another sensor"},
    "sensor.effects": [{"kind": "ramp of test_worker_cache", "loss": 0.3}],
    "distortion.focal_um": [300.0, 320.0],
    "distortion.centre_um": [3.0, -2.0],
    "layout.parameters.min_size_um": 3.0,
    "layout.parameters.n_sites": 96,
    "layout.parameters.ring_ratio": 1.4,
    "layout.mosaic": ["RB"],
    "layout.move_um": [2.0, 3.0],
    "gaze_um": [4.0, -3.0],
    "gaze_path": [[0.0, 4.0, -3.0], [0.01, 8.0, 2.0]],
    "layout.edits": [{"kind": "rotate", "angle_deg": 10.0}, {"kind": "scale", "factor": 1.2}],
    "layout.rules": {"min_size_um": 0.2},
    "layout.source": "a paper",
    "sensor.qe": {"kind": "gaussian", "centre_nm": 550.0, "fwhm_nm": 150.0},
    "sensor.filters": None,
    "sensor.sensitivity": {"per_um2": 0.005},
    "sensor.dark_e_per_s": {"per_um2": 10.0},
    "sensor.full_well_e": {"per_um2": 10.0},
    "sensor.read_noise_e": {"per_um2": 0.3},
    "sensor.capacitance_f": {"per_um2": 1e-15},
    "sensor.coupling.edge_um": 3.0,
    "sensor.crosstalk.max_gap_um": 3.0,
    "sensor.coupling.max_gap_um": 3.0,
    "sensor.hot_fraction": 0.5,
    "sensor.dead_fraction": 0.5,
    "sensor.rts_fraction": 0.5,
    "sensor.inl_dn": [0.0, 3.0, 0.0],
    "sensor.disabled": ["read"],
    "integration_order": 2,
    "requirements": [{"measure": "n_sites", "at_least": 10.0}],
}
#: Sections as a whole.
SECTIONS = {
    "scene": [
        {
            "kind": "flat",
            "shape": [20, 20],
            "pitch_um": 400.0,
            "distance_m": 1.0,
            "radiance_w_m2_sr_nm": 0.004,
            "band_width_nm": 80.0,
        },
        {
            "kind": "siemens_star",
            "shape": [20, 20],
            "pitch_um": 400.0,
            "distance_m": 1.0,
            "radiance_w_m2_sr_nm": 0.004,
            "band_width_nm": 80.0,
        },
        *[
            {name: value for name, value in SHOT["scene"].items() if name != "pitch_um"} | {"gaze_range_um": range_um}
            for range_um in ([0.0, 0.0], [3.0, 5.0])
        ],
        {"kind": "power_map", "path": "map.npy", "pitch_um": 4.0, "wavelength_nm": 550.0, "unit": "w_m2"},
    ],
    "distortion": [
        None,
        {"kind": "fisheye", "projection": "equidistant", "focal_um": 200.0},
        {"kind": "fisheye", "projection": "stereographic", "focal_um": 200.0},
    ],
    "layout": [
        {"generator": "grid", "parameters": {"n_x": 7, "n_y": 5, "pitch_um": 4.0}, "mosaic": "bayer"},
        {"generator": "grid", "parameters": {"n_x": 7, "n_y": 5, "pitch_um": 4.0}, "mosaic": ["R"]},
    ],
    "sensor": [
        SHOT["sensor"] | {"companding": "table", "companding_table": [0.0, 0.4, 0.7, 0.9, 1.0]},
        {"preset": "imx174"},
        {"datasheet": "sheet.yaml"},
        {"twin": "twin.npz"},
        {},
    ],
}


def own_models(kind):
    """Return the models of sections in a type."""
    if isinstance(kind, type):
        return [kind] if issubclass(kind, BaseModel) else []
    return [model for part in typing.get_args(kind) for model in own_models(part)]


def matching_model(kind, section):
    """Return the model of a section among the alternatives of a type; None for plain values."""
    found = own_models(kind)
    for model in found:
        tags = {name: typing.get_args(field.annotation) for name, field in model.model_fields.items()}
        if all(section[name] in tags.get(name, ()) for name in ("kind", "generator") if name in section):
            return model
    raise AssertionError(f"no model of {section}")


def leaves(model, section, prefix=""):
    """Yield path, type and value of every setting that a shot can have, including those that it has not."""
    for name, field in model.model_fields.items():
        path, value = prefix + name, section.get(name, field.default if not field.is_required() else None)
        in_sections = (
            "layout.edits",
            "sensor.companding_table",
            "sensor.datasheet",
            "sensor.twin",
            "scene.gaze_range_um",
            "gaze_deg",
            *LEVELS,
        )
        if name in ("kind", "generator") or path in in_sections:
            continue
        if isinstance(value, dict) and own_models(field.annotation) and path not in OTHERS:
            yield from leaves(matching_model(field.annotation, value), value, path + ".")
        else:
            yield path, field.annotation, value
    if prefix == "layout.":
        yield "layout.edits", None, section["edits"]


def other_value(path, kind, value):
    """Return another value of a setting: from the table, or by its type."""
    if path in OTHERS:
        return OTHERS[path]
    parts = [kind, *typing.get_args(kind)]
    choices = [
        choice for part in parts if typing.get_origin(part) is typing.Literal for choice in typing.get_args(part)
    ]
    if choices:
        return next(choice for choice in choices if choice != value)
    if bool in parts:
        return not value
    if int in parts and not isinstance(value, float):
        return (value or 0) + 2
    assert float in parts, f"{path} needs another value in OTHERS"
    return 0.8 * value if value else 0.05


def varied(base, *, aberrations):
    """Yield settings in which one value differs from those of a shot: aberrations, or all others."""
    for path, kind, value in leaves(models().shot, base):
        if path.startswith(ABERRATIONS) == aberrations:
            yield path, other_value(path, kind, value)


def with_value(base, path, value):
    data = copy.deepcopy(base)
    put_setting(None, data, path, value)
    return data


def plain(value):
    """Return a component as comparable plain data, with all values of arrays."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, Layout):
        columns = {name: plain(column) for name, column in value.columns.items()}
        return plain([value.xy_um, value.ring_offsets, value.site_offsets, value.channel]), columns
    if is_dataclass(value):
        public = [f.name for f in fields(value) if not f.name.startswith("_")]
        return type(value).__name__, {name: plain(getattr(value, name)) for name in public}
    if isinstance(value, typing.Mapping):
        return [(repr(key), plain(item)) for key, item in sorted(value.items(), key=lambda item: repr(item[0]))]
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return repr(value)


def checksum(shot, camera, capture):
    """Return a checksum of everything that a capture measures."""
    arrays = capture.code, capture.electrons, capture.expected_e, capture.white_dn
    return int(hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()[:12], 16)


@pytest.fixture
def runner(tmp_path, monkeypatch):
    """Return a function that creates runners, and the components that their caches returned."""
    rng = np.random.default_rng(5)
    for name in ("picture.png", "other.png"):
        write_picture(tmp_path / name, rng.integers(0, 256, (20, 24, 3), dtype=np.uint8))
    spot = np.exp(-0.5 * np.square(np.hypot(*np.mgrid[-12:13, -12:13])))
    PSFGrid.from_arrays(spot, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=1.0).write(tmp_path / "psfs.npz")
    np.save(tmp_path / "map.npy", rng.random((24, 24)))
    sheet = "{pixel_um: '2.25', bits: 12, qe_percent: '91.25', dark_noise_e: '5.560', saturation_e: '9458'}"
    (tmp_path / "sheet.yaml").write_text(sheet)
    small_twin().save(tmp_path / "twin.npz")
    monkeypatch.chdir(tmp_path)
    returned = {}
    part = WorkerCache.part

    def logged(self, kind, settings, make):
        value = part(self, kind, settings, make)
        returned[kind, json.dumps(settings, sort_keys=True)] = value
        return value

    monkeypatch.setattr(WorkerCache, "part", logged)
    metrics = {"checksum": checksum, "psnr": METRICS["psnr_db"], "snr": METRICS["snr"]}

    def new():
        return ShotRunner(Source.of(None), metrics, n_threads=1)

    return new, returned


def compare_with_fresh(runner, base, values):
    """Compare results and components of shared caches with fresh ones; return the paths of settings without effect."""
    new, returned = runner
    shared, alone = new(), new().record(0, base)
    assert (alone.error, shared.record(0, base)) == ("", alone)
    unchanged = set()
    for path, value in values:
        settings = with_value(base, path, value)
        # The point before is a neighbour in all settings but this one, and its components are cached.
        assert shared.record(0, base) == alone, path
        returned.clear()
        found = shared.record(0, settings)
        cached = dict(returned)
        returned.clear()
        expected = new().record(0, settings)
        assert (expected.error, found) == ("", expected), path
        # Compiled layouts of a camera depend on earlier points; the power on the sites shows their effect.
        for key, component in cached.items():
            assert key[0] == "camera" or plain(component) == plain(returned[key]), (path, key)
        if expected == alone:
            unchanged.add(path)
    return unchanged


@pytest.mark.nightly
def test_cached_components_equal_fresh_ones(runner):
    values = list(varied(SHOT, aberrations=False))

    unchanged = compare_with_fresh(runner, SHOT, values)

    # Settings without effect would show no wrong component.
    assert len(unchanged - OF_PANORAMAS) < 0.1 * len(values), unchanged


@pytest.mark.slow
def test_cached_aberrations_equal_fresh_ones(runner):
    values = list(varied(ABERRATED, aberrations=True))

    assert compare_with_fresh(runner, ABERRATED, values) <= {
        "optics.field_patches",
        "optics.field_tolerance",
        "optics.field_modes",
    }


@pytest.mark.slow
def test_cached_sections_equal_fresh_ones(runner):
    values = [(section, value) for section, alternatives in SECTIONS.items() for value in alternatives]

    assert compare_with_fresh(runner, SHOT, values) == set()


def test_layouts_of_twins_are_not_confused(runner, tmp_path):
    """Settings without a layout have that of their twin."""
    other = replace(small_twin(), maps={name: values[:4] for name, values in small_twin().maps.items()})
    other.save(tmp_path / "other.npz")
    base = {name: value for name, value in SHOT.items() if name != "layout"} | {"sensor": {"twin": "twin.npz"}}

    assert compare_with_fresh(runner, base, [("sensor.twin", "other.npz"), ("sensor.bits", 10)]) == set()


def test_images_of_panoramas_are_not_confused(runner, tmp_path):
    """The image of a panorama depends on the lens model and the layout, too."""
    write_picture(tmp_path / "sky.png", np.random.default_rng(1).integers(0, 256, (16, 32), dtype=np.uint8))
    base = SHOT | {
        "scene": {"kind": "panorama", "picture": "sky.png", "peak_radiance_w_m2_sr_nm": 0.004, "cells": 32},
        "distortion": {"kind": "fisheye", "projection": "equidistant", "focal_um": 30.0, "centre_um": [0.5, 0.0]},
    }
    changes = {
        "gaze_deg": [70.0, 20.0],
        "gaze_um": [1.0, 0.0],
        "distortion.projection": "stereographic",
        "distortion.focal_um": 40.0,
        "layout.parameters.r_max_um": 20.0,
        "optics.pupil_tilt": "flat",
        "optics.projection": "equisolid",
        "scene.yaw_deg": 30.0,
    }
    turning = base | {"axis": "sensor", "gaze_um": [3.0, 2.0]}

    assert compare_with_fresh(runner, base, changes.items()) == set()
    assert compare_with_fresh(runner, turning, [("gaze_um", [3.0, 2.5]), ("distortion.focal_um", 40.0)]) == set()
