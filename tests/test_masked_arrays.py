"""Masked arrays at every public entry: masked values are rejected or count as missing, and are never read as they are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim import distortion, metrics, modes, optics, units, video, view
from foveasim._core.validation import unmasked
from foveasim._io.images import write_picture
from foveasim.errors import ParameterError
from foveasim.metrics import flow
from foveasim.metrics.photon_transfer import PhotonTransfer, SiteClasses, codes_of
from foveasim.reconstruct import Picture, estimate_from_charge, estimate_from_code, least_squares, linear, natural
from foveasim.reconstruct import cells as fill_cells
from foveasim.sensor import calibration, exposures, noise_budget
from foveasim.sensor.spectral import tables

LAYOUT = fs.layout.grid(n_x=6, n_y=5, pitch_um=2.0)
N = LAYOUT.n_sites
GRID = fs.Grid.centred((30, 36), 0.5)
SENSOR = fs.Sensor(LAYOUT, bits=10, full_well_e=1e4, capacitance_f=1e-15, v_sat_v=1.0)
LENS = optics.Optics(focal_length_mm=8.0, f_number=4.0)
CAMERA = fs.Camera(optics=LENS, sensor=SENSOR)
BARREL = distortion.BrownConrady(focal_um=100.0, k1=-0.1)
MAP = np.random.default_rng(0).uniform(1.0, 2.0, GRID.shape)
SITES = np.linspace(100.0, 200.0, N)
CODES = np.linspace(100, 900, N).astype(np.int64)
LABELS = np.arange(N) % 3
WAVES = np.array([450.0, 550.0, 650.0])
PLACE = {"pitch_um": 200.0, "distance_m": 1.0}
LIGHT = {"wavelength_nm": [550.0], "band_width_nm": 10.0, **PLACE}
FRAMES = np.random.default_rng(1).integers(100, 110, (4, N))
INTEGRATOR = fs.Integrator(LAYOUT, GRID)
CORNERS = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])


def changed(carrier, name):
    """The carrier with another array for one field, and that field's values."""
    return lambda array: getattr(replace(carrier, **{name: array}), name)


@cache
def capture():
    scene = fs.Scene.flat(shape=(64, 64), radiance_w_m2_sr_nm=0.1, **LIGHT)
    return CAMERA.capture(scene, exposure_s=1e-3, seed=0)


def scene_of(name):
    def made(array):
        values = {
            "basis": np.ones((1, 4, 4)),
            "spectrum_w_m2_sr_nm": np.ones((1, 3)),
            "wavelength_nm": WAVES,
            "band_width_nm": [10.0, 20.0, 30.0],
        }
        return getattr(fs.Scene(**{**values, name: array}, pitch_um=1.0, distance_m=1.0), name)

    return made


RAMP = exposures.Ramp(
    times_s=np.array([0.1, 0.2]), electrons=np.ones((2, N), np.int64), code=np.ones((2, N), np.uint16)
)
RATES = exposures.Rates(rate_e_per_s=SITES, sigma_e_per_s=SITES, n_used=np.ones(N, np.int64))
EVENTS = modes.Events(np.array([0.1, 0.2]), np.array([1, 2]), np.array([1, -1]), LAYOUT)
TRANSFER = PhotonTransfer(
    np.array([0, 1]), np.array([3, 3]), np.array([2]), np.ones((1, 2)), np.ones((1, 2)), np.ones((1, 2))
)

#: Where masked values are rejected: what is called with an array, and an array that it takes.
REJECTED = {
    "PowerMap data": (lambda a: fs.PowerMap(a, GRID, [550.0]).data, MAP[np.newaxis]),
    "PowerMap wavelengths": (lambda a: fs.PowerMap(np.ones((3, *GRID.shape)), GRID, a).wavelength_nm, WAVES),
    "PowerMap.from_array": (lambda a: fs.PowerMap.from_array(a, pitch_um=0.5, wavelength_nm=550.0).data, MAP),
    "Grid origin": (lambda a: fs.Grid((2, 2), 1.0, a).origin_um, np.array([1.0, 2.0])),
    "Grid pitch": (lambda a: fs.Grid((2, 2), a).pitch_um, np.array([1.0, 2.0])),
    "Integrator": (INTEGRATOR, MAP),
    "Integrator float32": (INTEGRATOR, MAP.astype(np.float32)),
    "Integrator integers": (INTEGRATOR, np.ones(GRID.shape, np.int64)),
    "Integrator list of maps": (lambda a: INTEGRATOR([a, a])[0], MAP),
    "Integrator.spread": (INTEGRATOR.spread, SITES),
    **{
        f"Scene {name}": (scene_of(name), array)
        for name, array in {
            "basis": np.ones((1, 4, 4)),
            "spectrum_w_m2_sr_nm": np.ones((1, 3)),
            "wavelength_nm": WAVES,
            "band_width_nm": np.array([10.0, 20.0, 30.0]),
        }.items()
    },
    "Scene.from_picture": (
        lambda a: fs.Scene.from_picture(a, peak_radiance_w_m2_sr_nm=1.0, encoding="linear", **LIGHT).basis,
        np.random.default_rng(2).random((6, 7)),
    ),
    "Scene.from_picture bytes": (
        lambda a: fs.Scene.from_picture(a, peak_radiance_w_m2_sr_nm=1.0, **PLACE).basis,
        np.random.default_rng(2).integers(0, 255, (6, 7, 3), np.uint8),
    ),
    "Scene.from_picture spectrum": (
        lambda a: (
            fs.Scene.from_picture(
                np.ones((4, 4)), spectrum=a, wavelength_nm=WAVES, peak_radiance_w_m2_sr_nm=1.0, **PLACE
            ).spectrum_w_m2_sr_nm
        ),
        np.ones((1, 3)),
    ),
    "Scene.point_sources": (
        lambda a: fs.Scene.point_sources(shape=(9, 9), pixels=a, intensity_w_sr_nm=1.0, **LIGHT).basis,
        np.array([[1, 2], [3, 4]]),
    ),
    "chart": (
        lambda a: (
            fs.scene.charts.letter_f(
                height_mm=2.0, shape=(20, 20), radiance_w_m2_sr_nm=a, wavelength_nm=WAVES, **PLACE
            ).spectrum_w_m2_sr_nm
        ),
        np.ones(3),
    ),
    "Layout.xy_um": (lambda a: fs.Layout(a, [0, 4], [0, 1]).xy_um, CORNERS),
    "Layout.ring_offsets": (lambda a: fs.Layout(CORNERS, a, [0, 1]).ring_offsets, np.array([0, 4])),
    "Layout.site_offsets": (lambda a: fs.Layout(CORNERS, [0, 4], a).site_offsets, np.array([0, 1])),
    "Layout column": (lambda a: fs.Layout(CORNERS, [0, 4], [0, 1], {"channel": a}).channel, np.array([1])),
    "Layout.with_columns": (lambda a: LAYOUT.with_columns(mine=a).columns["mine"], SITES),
    "Layout.from_polygons": (lambda a: fs.Layout.from_polygons((a, [0, 4], [0, 1])).xy_um, CORNERS),
    "Layout.from_polygons channel": (
        lambda a: fs.Layout.from_polygons([shapely.box(0, 0, 1, 1), shapely.box(2, 0, 3, 1)], channel=a).channel,
        np.array([0, 1]),
    ),
    "Layout.from_rectangles": (lambda a: fs.Layout.from_rectangles(a, 1.0).xy_um, np.array([[0.0, 0.0], [3.0, 0.0]])),
    "Layout.sort_by": (lambda a: LAYOUT.sort_by(a).xy_um, SITES[::-1]),
    "Layout mask": (lambda a: LAYOUT[a].xy_um, np.arange(N) % 2 == 0),
    "Layout site numbers": (lambda a: LAYOUT[a].xy_um, np.array([1, 4, 2])),
    "merge": (lambda a: fs.layout.merge(LAYOUT, a).xy_um, np.arange(N)),
    "inset": (lambda a: fs.layout.inset(LAYOUT, a).xy_um, np.full(N, 0.1)),
    "quadtree": (lambda a: fs.layout.quadtree(a, pitch_um=1.0, limit=0.5, n_levels=2).xy_um, np.eye(8)),
    "voronoi": (
        lambda a: fs.layout.voronoi(n_sites=9, density=a, density_grid=fs.Grid((8, 8), 1.0), n_iterations=2).xy_um,
        np.ones((8, 8)),
    ),
    "random_channels": (lambda a: fs.layout.random_channels(LAYOUT, a, seed=0).channel, np.array([0.5, 0.5])),
    **{
        f"Sensor.{name}": (lambda a, name=name: getattr(fs.Sensor(LAYOUT, **{name: a}), name), array)
        for name, array in {
            "sensitivity": np.full(N, 0.5),
            "dark_e_per_s": SITES,
            "full_well_e": SITES,
            "read_noise_e": SITES,
            "capacitance_f": np.full(N, 1e-15),
            "inl_dn": np.array([0.0, 0.5, 0.0]),
        }.items()
    },
    "Sensor.companding_table": (
        lambda a: fs.Sensor(LAYOUT, companding="table", companding_table=a).companding_table,
        np.array([0.0, 0.7, 1.0]),
    ),
    "Sensor.expected_electrons": (lambda a: SENSOR.expected_electrons(a, 1.0), SITES),
    "Sensor.collect": (lambda a: SENSOR.collect(a, seed=0), SITES),
    "Sensor.read": (lambda a: SENSOR.read(a, seed=0), CODES),
    "Sensor.predict": (SENSOR.predict, SITES),
    "noise_budget": (
        lambda a: np.array(list(noise_budget(SENSOR, a, 1.0).values())),
        SITES,
    ),
    "Camera.capture": (
        lambda a: (
            CAMERA.capture(fs.PowerMap(MAP[np.newaxis], GRID, [550.0]), exposure_s=1.0, seed=0, photo_e_per_s=a).code
        ),
        SITES,
    ),
    "TableCurve": (
        lambda a: tables.TableCurve(wavelength_nm=[400.0, 500.0], value=a).value,
        np.array([0.1, 0.2]),
    ),
    "TableCurve call": (tables.TableCurve(wavelength_nm=[400.0, 700.0], value=[0.1, 0.2]), WAVES),
    "GaussianCurve call": (fs.sensor.GaussianCurve(centre_nm=550.0, fwhm_nm=50.0), WAVES),
    "KernelCrosstalk": (lambda a: fs.sensor.KernelCrosstalk(kernel=a).kernel, np.array([[0.1, 0.8, 0.1]])),
    "crosstalk": (lambda a: fs.sensor.Diffusion(spread_um=0.1).compile(LAYOUT).apply(a), SITES),
    "calibrate": (
        lambda a: calibration.calibrate(SENSOR, exposure_s=1.0, flat_e=a, n_frames=4, seed=0).gain,
        SITES * 5,
    ),
    "Calibration.from_frames": (
        lambda a: calibration.Calibration.from_frames(dark=a, flat=a + 300).gain,
        FRAMES.astype(np.float64),
    ),
    "linearise": (lambda a: calibration.linearise(a, SENSOR), CODES),
    "Ramp": (changed(RAMP, "code"), RAMP.code),
    "Rates": (changed(RATES, "rate_e_per_s"), SITES),
    "merge_exposures": (
        lambda a: exposures.merge_exposures(a, [0.01, 0.1], SENSOR).rate_e_per_s,
        np.stack((CODES, CODES)),
    ),
    "fit_ramp": (lambda a: exposures.fit_ramp(a, [0.1, 0.2, 0.3], SENSOR).rate_e_per_s, np.stack([CODES] * 3)),
    "Capture.code": (lambda a: replace(capture(), code=a).code, CODES.astype(np.uint16)),
    "Capture.electrons": (lambda a: replace(capture(), electrons=a).electrons, CODES),
    "undistort": (BARREL.undistort, np.array([[1.0, 2.0], [3.0, 4.0]])),
    "Scaramuzza": (
        lambda a: distortion.Scaramuzza(a=a, pixel_um=1.0, focal_um=100.0).a,
        np.array([100.0, -1e-3, 0.0, 0.0]),
    ),
    "from_opencv": (
        lambda a: distortion.from_opencv(a, [0.1, 0.0, 0.0, 0.0], image_size=(20, 10), pixel_um=1.0).focal_um,
        np.array([[50.0, 0.0, 9.5], [0.0, 50.0, 4.5], [0.0, 0.0, 1.0]]),
    ),
    "PupilImage": (lambda a: optics.PupilImage(a).picture, np.ones((8, 8))),
    "zernike": (lambda a: optics.aberrations.zernike(2, 0, a, np.zeros(3)), np.array([0.0, 0.5, 1.0])),
    "Zernike coefficient": (
        lambda a: optics.Zernike(coefficients={4: a}, wavelength_nm=WAVES).coefficients[4],
        np.array([0.1, 0.2, 0.3]),
    ),
    "LateralColour": (
        lambda a: optics.LateralColour(wavelength_nm=WAVES, magnification=a).magnification,
        np.array([0.99, 1.0, 1.01]),
    ),
    "mtf": (lambda a: LENS.mtf(a, 550.0), np.array([10.0, 50.0])),
    "weighted_maps": (
        lambda a: next(LENS.weighted_maps(fs.Scene.flat(shape=(64, 64), radiance_w_m2_sr_nm=1.0, **LIGHT), a)),
        np.ones((1, 1)),
    ),
    "flow regions": (lambda a: flow.flow_bound(np.ones((N, 2)), 1.0, regions=a).n_sites, LABELS),
    "flow map": (lambda a: flow.site_gradients_e_per_um(LAYOUT, a, GRID), MAP),
    "classes of sites": (lambda a: SiteClasses(a, N).labels, LABELS),
    "PhotonTransfer": (changed(TRANSFER, "mean_dn"), TRANSFER.mean_dn),
    "codes of frames": (lambda a: codes_of("frames", a), FRAMES),
    "codes of a list of frames": (lambda a: codes_of("frames", [a, a]), CODES),
    "slanted_edge where": (
        lambda a: metrics.slanted_edge_mtf(EDGE_LAYOUT, EDGE_VALUES, where=a).mtf,
        np.ones(400, bool),
    ),
    "polygon_mtf": (lambda a: metrics.polygon_mtf(LAYOUT, a), np.array([10.0, 50.0])),
    "Events": (changed(EVENTS, "t_s"), EVENTS.t_s),
    "Events.site": (changed(EVENTS, "site"), EVENTS.site),
    "Events.from_addresses": (
        lambda a: modes.Events.from_addresses(a, [1, 2], [3, 3], [1, -1], LAYOUT).t_s,
        np.array([0.1, 0.2]),
    ),
    "EventPixels.events": (
        lambda a: (
            modes.EventPixels(SENSOR, contrast_on=0.2, contrast_off=0.2).events([a, 2 * a], frame_s=0.1, seed=0).t_s
        ),
        SITES,
    ),
    "SpikingPixels": (lambda a: modes.SpikingPixels(SENSOR, threshold_e=a).threshold_e, SITES),
    "GazePath": (lambda a: video.GazePath(a, np.zeros((2, 2))).t_s, np.array([0.0, 1.0])),
    "FrameSource": (
        lambda a: next(iter(video.FrameSource([a], peak_radiance_w_m2_sr_nm=1.0, encoding="linear", **LIGHT))).basis,
        np.ones((4, 4)),
    ),
    "cells": (lambda a: fill_cells(LAYOUT, a, GRID).data, SITES),
    "least_squares variance": (lambda a: least_squares(LAYOUT, SITES, GRID, variance=a, mu=1.0).data, SITES),
    "estimate_from_charge": (lambda a: estimate_from_charge(a, SENSOR, 1.0).light_e, SITES),
    "estimate_from_code": (lambda a: estimate_from_code(a, SENSOR, 1.0).light_e, CODES),
    "Picture coverage": (lambda a: Picture(np.ones((1, *GRID.shape)), a, GRID).coverage, MAP),
    "Picture.to_image": (
        lambda a: Picture(np.ones((3, 4, 4)), np.ones((4, 4)), fs.Grid((4, 4), 1.0)).to_image(a),
        np.ones(3),
    ),
    "id_map": (lambda a: view.id_map(LAYOUT, (4, 4), a), np.array([0.0, 0.0, 4.0, 4.0])),
    "prisms": (lambda a: view.prisms(LAYOUT, a).values, SITES),
    "units": (units.m_from_um, SITES),
}

EDGE_LAYOUT = fs.layout.grid(n_x=20, n_y=20, pitch_um=2.0)
EDGE_VALUES = 1.0 / (1.0 + np.exp(-(EDGE_LAYOUT.centroid_um @ [np.cos(0.1), np.sin(0.1)])))

#: Where masked values are missing values, as NaN is.
MISSING = {
    "linear": (lambda a: linear(LAYOUT, a, GRID).data, SITES),
    "natural": (lambda a: natural(LAYOUT, a, GRID).data, SITES),
    "least_squares": (lambda a: least_squares(LAYOUT, a, GRID, mu=1.0).data, SITES),
    "psnr": (lambda a: metrics.psnr_db(a, MAP + 0.1), MAP),
    "ssim": (lambda a: metrics.ssim(a, np.tile(MAP, 1)), MAP + 0.1),
    "slanted_edge_mtf": (lambda a: metrics.slanted_edge_mtf(EDGE_LAYOUT, a).mtf, EDGE_VALUES),
    "site_colours": (lambda a: view.colours_of(LAYOUT, a).rgb, SITES),
    "Picture data": (lambda a: Picture(a, MAP, GRID).data, MAP[np.newaxis]),
}


def masked(array, n_masked=0):
    mask = np.zeros(array.shape, bool)
    mask.flat[:n_masked] = True
    return np.ma.MaskedArray(array.copy(), mask)


@pytest.mark.parametrize("name", REJECTED)
def test_masked_values_are_rejected(name):
    call, array = REJECTED[name]

    with pytest.raises(
        ParameterError, match=r"'\w+(\[\d+\])?' must have no masked values, got \d of \d+ masked; fill them"
    ):
        call(masked(array, 1))


@pytest.mark.parametrize("name", [*REJECTED, *MISSING])
def test_mask_without_masked_values_changes_nothing(name):
    call, array = (REJECTED | MISSING)[name]

    np.testing.assert_array_equal(call(masked(array)), call(array))


@pytest.mark.parametrize("name", MISSING)
def test_masked_values_count_as_missing(name):
    call, array = MISSING[name]
    missing = array.copy()
    missing.flat[0] = np.nan
    hidden = masked(array, 1)
    hidden.data.flat[0] = 1e9  # what a mask hides is not looked at

    np.testing.assert_array_equal(call(hidden), call(missing))


def test_message_counts_masked_cells():
    holes = np.ma.masked_less(np.arange(391.0).reshape(17, 23), 12.0)

    with pytest.raises(
        ParameterError, match=r"^'data' must have no masked values, got 12 of 391 masked; fill them first, "
    ):
        fs.PowerMap.from_array(holes, pitch_um=1.0, wavelength_nm=550.0)


@pytest.mark.parametrize(
    "value",
    [
        [np.ma.MaskedArray([1.0, 2.0], [False, True]), [3.0, 4.0]],
        ([np.ma.MaskedArray([1.0], [True])],),
        [1.0, np.ma.masked],
        np.ma.masked,
        np.ma.MaskedArray(1.0, True),
    ],
)
def test_masks_inside_lists_are_found(value):
    with pytest.raises(ParameterError, match="'values' must have no masked values"):
        unmasked("values", value)
    assert np.isnan(unmasked("values", value, missing_is_nan=True)).sum() == 1


@pytest.mark.parametrize("value", [None, 3.0, "text", [1.0, 2.0], [[1.0], [2.0, 3.0]], np.ones(3), object()])
def test_values_without_mask_are_returned_themselves(value):
    assert unmasked("values", value) is value


def test_missing_values_keep_float32():
    assert unmasked("values", masked(np.ones(3, np.float32), 1), missing_is_nan=True).dtype == np.float32
    assert unmasked("values", masked(np.ones(3, np.int16), 1), missing_is_nan=True).dtype == np.float64


def test_picture_file_rejects_masked_pixels(tmp_path):
    with pytest.raises(ParameterError, match="'picture' must have no masked values"):
        write_picture(tmp_path / "picture.png", masked(np.zeros((4, 4), np.uint8), 1))
    assert not list(tmp_path.iterdir())
