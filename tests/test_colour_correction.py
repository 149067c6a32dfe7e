"""Colour correction: photographs come back exactly, and the patches of the chart have the colours of colour-science."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.scene import _colorimetry as colorimetry
from foveasim.scene import charts
from foveasim.units import decode_srgb

WAVES_NM = np.arange(400.0, 701.0, 10.0)
#: Side and gap of the patches of the chart, and pixels of a patch of the photograph.
PATCH_MM, GAP_MM, N = 5.6, 0.56, 24
COLOURS = np.array([[[200, 40, 30], [20, 180, 60]], [[30, 50, 220], [255, 255, 255]]], np.uint8)


@pytest.fixture(scope="module")
def colour():
    with np.printoptions():  # its import changes them
        return pytest.importorskip("colour")


@pytest.fixture(scope="module")
def d65_nm(colour):
    return np.array(colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"])


def filters(*names):
    """Return curves of broad, overlapping filters, with their peaks and widths in nm."""
    shapes = {"red": (610.0, 45.0), "green": (540.0, 45.0), "blue": (460.0, 35.0), "white": (550.0, 400.0)}
    curves = [
        lambda nm, at=shapes[name]: 0.1 + 0.8 * np.exp(-0.5 * ((np.asarray(nm) - at[0]) / at[1]) ** 2) for name in names
    ]
    return fs.sensor.FilterSet(curves, names)


def camera(mosaic=(("red", "green"), ("green", "blue")), n=48, **sensor):
    names = list(dict.fromkeys(name for row in mosaic for name in row))
    layout = fs.layout.grid(pitch_um=10.0, n_x=n, n_y=n)
    if len(names) > 1:
        letters = "".join(name[0].upper() for name in names)
        layout = fs.layout.mosaic(layout, ["".join(name[0].upper() for name in row) for row in mosaic], letters)
    parameters = {"capacitance_f": 50e-15, "bits": 14, "shot_noise": "off", "filters": filters(*names)}
    return fs.Camera(
        optics=fs.Optics(focal_length_mm=50.0, f_number=2.0),
        sensor=fs.Sensor(layout, **(parameters | sensor)),
    )


def photograph(**change):
    picture = np.kron(COLOURS, np.ones((N, N, 1), np.uint8))
    return fs.Scene.from_picture(
        picture, **({"fit": "cover", "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 0.01} | change)
    )


def chart(illuminant="D65", **change):
    return charts.colour_chart(
        shape=(264, 264), pitch_um=160.0, distance_m=1.0, patch_mm=PATCH_MM, gap_mm=GAP_MM, n_basis=24,
        **({"illuminant": illuminant, "illuminance_lux": 500.0} | change),
    )  # fmt: skip


def centres(picture):
    """Return the values in the middle of the four colours of the photograph, (4, n_channel)."""
    n = picture.data.shape[1]
    low, high = n // 4, n - n // 4 - 1
    return np.array([picture.data[:, y, x] for y, x in ((high, low), (high, high), (low, low), (low, high))])


# -- colorimetry against colour-science ----------------------------------------------------------------------------------


def test_tristimulus_values_equal_colour_science(colour):
    spectra = charts.patch_reflectance(np.arange(380.0, 781.0, 5.0)) * charts.illuminant(
        "D65", np.arange(380.0, 781.0, 5.0)
    )
    found = colorimetry.tristimulus(spectra, np.arange(380.0, 781.0, 5.0), np.full(81, 5.0))
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(colour.SpectralShape(380, 780, 5))
    assert found == pytest.approx(5.0 * spectra @ observer.values, rel=1e-5)


@pytest.mark.parametrize("illuminant", ["A", "D50", "D65"])
def test_chromatic_adaptation_equals_colour_science(colour, d65_nm, illuminant):
    xyz = np.random.default_rng(0).uniform(0.05, 1.0, (20, 3))
    white_xy = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"][illuminant]
    white = colour.xy_to_XYZ(white_xy)
    adapted = colour.chromatic_adaptation(
        xyz, white, colour.xy_to_XYZ(d65_nm), method="Von Kries", transform="Bradford"
    )
    space = colour.RGB_COLOURSPACES["sRGB"].copy()
    space.use_derived_transformation_matrices(True)
    expected = adapted @ space.matrix_XYZ_to_RGB.T
    assert colorimetry.srgb_of_xyz(xyz, white) == pytest.approx(expected, abs=1e-9)


def test_lightness_and_chroma_equal_colour_science(colour, d65_nm):
    rgb = np.vstack((np.random.default_rng(1).uniform(0.0, 1.0, (20, 3)), np.full((1, 3), 1e-3), np.zeros((1, 3))))
    space = colour.RGB_COLOURSPACES["sRGB"].copy()
    space.use_derived_transformation_matrices(True)
    expected = colour.XYZ_to_Lab(rgb @ space.matrix_RGB_to_XYZ.T, d65_nm)
    assert colorimetry.lab_of(rgb) == pytest.approx(expected, abs=1e-7)


# -- photographs ---------------------------------------------------------------------------------------------------------


MOSAICS = {
    "Bayer": (("red", "green"), ("green", "blue")),
    "RGBW": (("red", "green"), ("white", "blue")),
    "stripes": (("blue", "green", "red"),),
}


@pytest.mark.parametrize("mosaic", MOSAICS.values(), ids=list(MOSAICS))
def test_photograph_returns_its_own_colours(mosaic):
    scene, made = photograph(), camera(mosaic)
    capture = made.capture(scene, exposure_s="auto", seed=0)
    found = centres(capture.picture(max_pixels=64, of="expected_e").to_rgb())
    expected = decode_srgb(COLOURS.reshape(4, 3) / 255.0)
    # The level of white depends on the exposure; colours and their ratios do not.
    scale = found[3].mean()
    assert found / scale == pytest.approx(expected, abs=2e-3)
    raw = centres(capture.picture(max_pixels=64, colour="raw", of="expected_e").to_rgb())
    assert raw.shape != expected.shape or np.abs(raw / raw[3].mean() - expected).max() > 0.1
    assert capture.colour_correction.delta_e.max() < 0.01


def test_reference_picture_has_corrected_colours():
    made, scene = camera(), photograph()
    grid = fs.Grid.centred((64, 64), 7.5)
    found = centres(made.reference(scene, grid, exposure_s=0.01).to_rgb())
    assert found / found[3].mean() == pytest.approx(decode_srgb(COLOURS.reshape(4, 3) / 255.0), abs=2e-3)


def test_channels_with_own_spectra_are_inverted():
    spectrum = [[0.1, 0.2, 1.0], [0.1, 1.0, 0.3], [0.8, 0.1, 0.0]]
    scene = photograph(wavelength_nm=[470.0, 540.0, 600.0], band_width_nm=50.0, spectrum=spectrum)
    capture = camera().capture(scene, exposure_s="auto", seed=0)
    found = centres(capture.picture(max_pixels=64, of="expected_e").to_rgb())
    assert found / found[3].mean() == pytest.approx(decode_srgb(COLOURS.reshape(4, 3) / 255.0), abs=2e-3)


def test_saturated_photosites_are_shown_white():
    capture = camera().capture(photograph(), exposure_s=10.0, seed=0)
    assert capture.saturated_fraction > 0.99
    image = capture.picture(max_pixels=32).to_image(capture.white_dn)
    assert image[..., :3].min() == 255


# -- spectral scenes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("illuminant", ["D65", "A"])
def test_colour_differences_are_those_of_captures(colour, d65_nm, illuminant):
    scene = chart(illuminant)
    capture = camera(n=200).capture(scene, exposure_s="auto", seed=0)
    correction = capture.colour_correction
    picture = capture.picture(max_pixels=200, of="expected_e")
    rgb, light = picture.to_rgb().data, charts.illuminant(illuminant, WAVES_NM)
    step_um = 1000.0 * (PATCH_MM + GAP_MM) * camera().optics.magnification(1.0)
    found = []
    for patch in range(24):
        row, column = divmod(patch, 6)
        x_um, y_um = (column - 2.5) * step_um, (1.5 - row) * step_um
        iy, ix = (
            int(np.argmin(np.abs(axis - at))) for axis, at in ((picture.grid.y_um, y_um), (picture.grid.x_um, x_um))
        )
        found.append(rgb[:, iy, ix])
    found = np.array(found, np.float64)

    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(colour.SpectralShape(400, 700, 10))
    xyz = (charts.patch_reflectance(WAVES_NM) * light) @ observer.values
    white = light @ observer.values
    whitepoint = colour.xy_to_XYZ(d65_nm)
    exact = colour.XYZ_to_Lab(
        colour.chromatic_adaptation(xyz / white[1], white / white[1], whitepoint, transform="Bradford"), d65_nm
    )
    space = colour.RGB_COLOURSPACES["sRGB"].copy()
    space.use_derived_transformation_matrices(True)
    # The exposure is unknown: that of the white patch agrees in luminance.
    y = found @ space.matrix_RGB_to_XYZ[1]
    target_y = (xyz / white[1])[:, 1]
    scale = (target_y @ y) / (y @ y)
    shown = colour.XYZ_to_Lab(scale * found @ space.matrix_RGB_to_XYZ.T, d65_nm)
    difference = colour.delta_E(shown, exact, method="CIE 1976")
    assert difference.mean() == pytest.approx(correction.delta_e.mean(), rel=0.1)
    assert np.corrcoef(difference, correction.delta_e)[0, 1] > 0.95
    assert correction.delta_e.mean() < 0.5 * correction.delta_e_raw.mean()


def test_white_is_that_of_the_illuminant():
    capture = camera(n=200).capture(chart("A"), exposure_s="auto", seed=0)
    picture = capture.picture(max_pixels=200, of="expected_e", colour="raw")
    step_um = 1000.0 * (PATCH_MM + GAP_MM) * camera().optics.magnification(1.0)
    iy, ix = (
        np.argmin(np.abs(axis - at))
        for axis, at in ((picture.grid.y_um, -1.5 * step_um), (picture.grid.x_um, -2.5 * step_um))
    )
    white = picture.to_rgb().data[:, iy, ix]
    assert white / white[1] == pytest.approx(np.ones(3), abs=0.05)
    assert capture.colour_correction.matrix @ np.ones(3) == pytest.approx(np.ones(3), abs=1e-6)


def test_no_other_matrix_is_better():
    scene, sensor = chart("D50"), camera().sensor
    correction = camera().capture(scene, exposure_s=0.01, seed=0).colour_correction
    light = charts.illuminant("D50", WAVES_NM)
    response = sensor.responsivity_e_per_j(WAVES_NM)
    values = (charts.patch_reflectance(WAVES_NM) * light) @ response.T / (response @ light)
    xyz, white = (
        colorimetry.tristimulus(part, WAVES_NM, np.full(31, 10.0))
        for part in (charts.patch_reflectance(WAVES_NM) * light, light[np.newaxis])
    )
    target = colorimetry.srgb_of_xyz(xyz, white[0])
    weight = np.maximum(target @ [0.2126, 0.7152, 0.0722], 0.01)[:, np.newaxis] ** (-2.0 / 3.0)

    def error(matrix):
        return np.sum((weight * (values @ matrix.T - target)) ** 2)

    best, rng = error(correction.matrix), np.random.default_rng(2)
    for _ in range(100):
        change = rng.normal(0.0, 0.01, (3, 3))
        assert error(correction.matrix + change - change.mean(axis=1, keepdims=True)) > best


# -- sensors without colours ---------------------------------------------------------------------------------------------


def curve(_nm):
    return np.full(np.shape(_nm), 0.5)


@pytest.mark.parametrize(
    ("change", "scene"),
    [
        ({"filters": fs.sensor.FilterSet([curve] * 3)}, photograph),
        ({"filters": None}, photograph),
        ({}, lambda: photograph(wavelength_nm=[550.0], band_width_nm=50.0)),
        ({}, lambda: chart(wavelength_nm=[640.0, 650.0], illuminant="E")),
    ],
    ids=["equal filters", "no filters", "grey photograph", "two bands"],
)
def test_sensors_without_colours_say_so(change, scene):
    made = camera(**change) if change.get("filters", True) else camera(((("red",),)), **change)
    capture = made.capture(scene(), exposure_s=0.01, seed=0)
    assert capture.colour_correction is None
    with pytest.raises(ParameterError, match="'colour' must be 'raw': the capture has no colour correction"):
        capture.picture(colour="corrected")
    raw, default = (np.asarray(capture.picture(max_pixels=16, colour=colour)) for colour in ("raw", None))
    assert np.array_equal(raw, default)
    with pytest.raises(ParameterError, match="'colour' must be one of 'corrected', 'raw', got 'sRGB'"):
        capture.picture(colour="sRGB")


def test_filter_without_photosites_has_no_weight():
    names = ("red", "green", "blue", "white")
    capture = camera(filters=filters(*names)).capture(photograph(), exposure_s="auto", seed=0)
    matrix = capture.colour_correction.matrix
    assert matrix.shape == (3, 4)
    assert not matrix[:, 3].any()
    assert matrix[:, :3] == pytest.approx(
        camera().capture(photograph(), exposure_s=0.1, seed=0).colour_correction.matrix
    )


# -- compositions --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def captured():
    made = camera(MOSAICS["RGBW"])
    return made, made.capture(photograph(), exposure_s=0.02, seed=0)


@pytest.mark.parametrize("suffix", [".npz", ".zarr"])
def test_saved_captures_keep_their_colours(captured, tmp_path, suffix):
    _, capture = captured
    capture.save(tmp_path / f"capture{suffix}")
    loaded = fs.Capture.load(tmp_path / f"capture{suffix}")
    assert np.array_equal(loaded.colour_correction.matrix, capture.colour_correction.matrix)
    assert np.array_equal(np.asarray(loaded.picture(max_pixels=32)), np.asarray(capture.picture(max_pixels=32)))


def test_tiles_have_colours_of_the_capture(captured, tmp_path):
    made, capture = captured
    tiled = fs.tiles.write_tiles(tmp_path / "tiles.zarr", made, photograph(), exposure_s=0.02, seed=0)
    matrix = capture.colour_correction.matrix
    assert np.array_equal(tiled.picture(max_pixels=16).colour_matrix, matrix)
    assert all(np.array_equal(tile.colour_correction.matrix, matrix) for tile in tiled)


def test_video_frames_are_pictures_of_captures(captured, tmp_path):
    made, _ = captured
    frames = made.video([photograph()] * 2, exposure_s=0.02, seed=0)
    fs.video.write_video(frames, tmp_path / "frames", max_pixels=32)
    capture = next(iter(made.video([photograph()], exposure_s=0.02, seed=0)))
    expected = capture.picture(max_pixels=32).to_image(capture.white_dn)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "frames" / "frame_000000.png")), expected)


def test_log_polar_images_are_corrected(captured):
    _, capture = captured
    image = capture.cortical(n_rings=20, n_sectors=60, r_min_um=10.0)
    assert np.array_equal(image.colour_matrix, capture.colour_correction.matrix)
    picture = fs.reconstruct.from_cortical(image, fs.Grid.centred((16, 16), 20.0))
    assert picture.to_image().shape == (16, 16, 4)


@pytest.mark.parametrize(
    "colour", [{}, [], {"matrix": "x", "delta_e": []}, {"matrix": np.eye(3).tolist(), "delta_e": ["a"]}]
)
def test_damaged_settings_of_colours_are_reported(captured, colour):
    _, capture = captured
    damaged = replace(capture, settings={**capture.settings, "colour": colour})
    with pytest.raises(ParameterError, match=r"'(settings|matrix|delta_e)' must"):
        damaged.picture(max_pixels=8)


def test_settings_of_colours_are_plain(captured):
    _, capture = captured
    correction = capture.colour_correction
    again = fs.reconstruct.ColourCorrection.from_settings(capture.settings)
    assert np.array_equal(again.matrix, correction.matrix)
    assert np.isnan(correction.delta_e_raw).all()  # four filters are not red, green and blue
    with pytest.raises(ParameterError, match="'matrix' must have the shape"):
        fs.reconstruct.ColourCorrection(np.ones((2, 3)), np.zeros(24), np.zeros(24))
    with pytest.raises(ParameterError, match="'colour_matrix' must have the shape"):
        fs.Picture(
            np.ones((4, 2, 2), np.float32),
            np.ones((2, 2), np.float32),
            fs.Grid((2, 2), 1.0, (0.0, 0.0)),
            None,
            np.ones((3, 3)),
        )
