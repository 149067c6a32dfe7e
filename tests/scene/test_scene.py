"""Scenes: orientation, radiance and wavelengths, compared with published values and manual calculation."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import skimage
from lazy_modules import LazyModule
from PIL import Image

import foveasim as fs
from foveasim._io.encodings import decode
from foveasim.errors import FileError, ParameterError
from foveasim.scene import Scene, charts

tifffile = LazyModule("tifffile")
EPS32 = float(np.finfo(np.float32).eps)

#: Letter without symmetry, top row first, as in a file.
F = np.array(
    [
        [0, 0, 0, 0, 0],
        [0, 1, 1, 1, 0],
        [0, 1, 0, 0, 0],
        [0, 1, 1, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 0, 0, 0, 0],
    ],
    np.uint8,
)


def scene_of(picture, **changed):
    """Return a scene with a radiance of 1 W/(m² sr nm) for white."""
    given = {"pitch_um": 10.0, "distance_m": 0.5, "peak_radiance_w_m2_sr_nm": 1.0, "band_width_nm": 10.0}
    return Scene.from_picture(picture, **(given | changed))


def radiance(scene):
    """Return the spectral radiance (n_wavelength, n_y, n_x) from the definition of a scene."""
    return np.einsum("byx,bk->kyx", scene.basis, scene.spectrum_w_m2_sr_nm)


def points(**changed):
    given = {
        "shape": (4, 6),
        "pixels": [(1, 2)],
        "intensity_w_sr_nm": 1.0,
        "pitch_um": 10.0,
        "distance_m": 0.5,
        "band_width_nm": 10.0,
    }
    return Scene.point_sources(**(given | changed))


def flat(**changed):
    given = {"shape": (4, 6), "pitch_um": 10.0, "distance_m": 0.5, "radiance_w_m2_sr_nm": 0.25, "band_width_nm": 10.0}
    return Scene.flat(**(given | changed))


# -- decoding -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "light"),
    [
        (0.0, 0.0),
        (0.04045, 0.0031308),  # end of the linear segment of IEC 61966-2-1
        (0.1, 0.01002283),
        (0.5, 0.21404114),
        (0.735357, 0.5),
        (1.0, 1.0),
    ],
)
def test_srgb_decoding_matches_standard(value, light):
    assert abs(decode(np.array(value), "srgb") - light) < 1e-6


def test_srgb_codes_agree_with_scikit_image():
    codes = np.arange(256, dtype=np.uint8)
    greys = np.repeat(codes[np.newaxis, :, np.newaxis], 3, axis=2)
    brightness = skimage.color.rgb2xyz(greys)[0, :, 1]
    np.testing.assert_allclose(radiance(scene_of(codes[np.newaxis]))[0, 0], brightness, rtol=2e-6, atol=1e-12)


@pytest.mark.parametrize(("encoding", "power"), [("linear", 1), ("sqrt", 2)])
def test_linear_and_square_root_encodings_are_powers(encoding, power):
    values = np.array([[0.0, 0.25, 0.5, 1.0, 1.5]])
    np.testing.assert_allclose(radiance(scene_of(values, encoding=encoding))[0], values**power, rtol=EPS32)


@pytest.mark.parametrize("encoding", ["srgb", "sqrt", "linear"])
def test_encodings_are_strictly_increasing(encoding):
    assert np.all(np.diff(decode(np.linspace(0.0, 2.0, 2001), encoding)) > 0.0)


@pytest.mark.parametrize("encoding", ["srgb", "sqrt", "linear"])
@pytest.mark.parametrize(
    ("black", "white"),
    [
        (np.uint8(0), np.uint8(255)),
        (np.uint16(0), np.uint16(65_535)),
        (np.float16(0), np.float16(1)),
        (np.float32(0), np.float32(1)),
        (np.float64(0), np.float64(1)),
        (np.bool_(0), np.bool_(1)),
    ],
    ids=lambda value: value.dtype.name,
)
def test_black_is_zero_and_white_peak(black, white, encoding):
    scene = scene_of(np.array([[black, white]]), encoding=encoding, peak_radiance_w_m2_sr_nm=0.25)
    np.testing.assert_allclose(radiance(scene), [[[0.0, 0.25]]], rtol=EPS32)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_float_decoding_has_single_precision(dtype):
    light = float(radiance(scene_of(np.full((1, 1), 0.5, dtype)))[0, 0, 0])
    assert math.isclose(light, 0.21404114048223255, rel_tol=4 * EPS32)


def test_eight_and_sixteen_bits_agree():
    # 65535 = 257 x 255: the 8-bit code k is equivalent to the 16-bit code 257 k.
    codes = np.arange(256, dtype=np.uint8)[np.newaxis]
    np.testing.assert_array_equal(scene_of(codes).basis, scene_of(codes.astype(np.uint16) * np.uint16(257)).basis)


def test_byte_order_is_ignored():
    codes = F * np.uint16(40_000)
    np.testing.assert_array_equal(scene_of(codes.astype(">u2")).basis, scene_of(codes.astype("<u2")).basis)


def test_floats_above_one_exceed_peak():
    assert radiance(scene_of(np.array([[4.0]]), encoding="linear"))[0, 0, 0] == 4.0


def test_radiance_is_proportional_to_peak():
    one, seven = (radiance(scene_of(F * np.uint8(99), peak_radiance_w_m2_sr_nm=peak)) for peak in (1.0, 7.0))
    np.testing.assert_allclose(seven, 7.0 * one, rtol=1e-15)


# -- orientation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.bool_])
def test_array_row_0_is_bottom_row(dtype):
    picture = F.astype(dtype) * dtype(1 if dtype in (np.float32, np.bool_) else np.iinfo(dtype).max)
    np.testing.assert_array_equal(scene_of(picture).basis[0], F[::-1])


def test_file_row_0_is_bottom_row(tmp_path):
    Image.fromarray(F * np.uint8(255)).save(tmp_path / "f.png")
    np.testing.assert_array_equal(scene_of(tmp_path / "f.png").basis[0], F[::-1])


def test_file_and_array_yield_same_scene(tmp_path):
    colour = np.random.default_rng(1).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    Image.fromarray(colour).save(tmp_path / "f.png")
    np.testing.assert_array_equal(scene_of(str(tmp_path / "f.png")).basis, scene_of(colour).basis)


def test_channel_order_is_preserved():
    colour = np.stack([F, np.zeros_like(F), 1 - F], axis=-1) * np.uint8(255)
    red, green, blue = scene_of(colour).basis
    np.testing.assert_array_equal(red, F[::-1])
    np.testing.assert_array_equal(green, 0.0)
    np.testing.assert_array_equal(blue, 1.0 - F[::-1])


# -- transparency ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("picture", "expected"),
    [
        (np.full((1, 1, 2), [255, 0], np.uint8), 0.0),
        (np.full((1, 1, 2), [255, 51], np.uint8), 0.2),
        (np.full((1, 1, 4), [255, 255, 255, 51], np.uint8), 0.2),
        (np.full((1, 1, 4), [65_535, 65_535, 65_535, 13_107], np.uint16), 0.2),
        (np.full((1, 1, 4), [1.0, 1.0, 1.0, 0.2]), 0.2),
        (np.full((1, 1, 4), [255, 255, 255, 255], np.uint8), 1.0),
    ],
    ids=["clear grey", "grey", "colour", "16-bit colour", "float colour", "opaque colour"],
)
def test_alpha_scales_radiance(picture, expected):
    np.testing.assert_allclose(radiance(scene_of(picture)), expected, rtol=EPS32)


# -- colours and wavelengths ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("colour", "brightness"),  # Rec. ITU-R BT.709
    [((255, 0, 0), 0.2126), ((0, 255, 0), 0.7152), ((0, 0, 255), 0.0722), ((255, 255, 255), 1.0), ((0, 0, 0), 0.0)],
)
def test_colour_at_one_wavelength_becomes_luminance(colour, brightness):
    scene = scene_of(np.full((1, 1, 3), colour, np.uint8), wavelength_nm=[550.0])
    assert math.isclose(radiance(scene)[0, 0, 0], brightness, rel_tol=4 * EPS32)


def test_grey_picture_has_flat_spectrum():
    wavelength_nm = np.arange(400.0, 701.0, 10.0)
    at_all = radiance(scene_of(F * np.uint8(255), wavelength_nm=wavelength_nm))
    np.testing.assert_array_equal(at_all, np.tile(F[::-1], (31, 1, 1)))


def test_colour_channels_map_to_their_wavelengths():
    scene = scene_of(np.full((1, 1, 3), [255, 0, 0], np.uint8), wavelength_nm=[650.0, 540.0, 460.0])
    assert radiance(scene)[:, 0, 0].tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("shape", "wavelength_nm"), [((1, 1), [550.0]), ((1, 1, 1), [550.0]), ((1, 1, 3), [620.0, 550.0, 450.0])]
)
def test_default_wavelengths_are_those_of_paper(shape, wavelength_nm):
    assert scene_of(np.ones(shape)).wavelength_nm.tolist() == wavelength_nm


@pytest.mark.parametrize("mode", ["1", "L", "LA", "I;16"])
def test_grey_pictures_have_one_wide_band(mode, tmp_path):
    """One band of 100 nm at 550 nm, as for colour; 1-bit, 8-bit and 16-bit pictures agree where they are black or white."""
    white = np.array([[0, 255, 255], [0, 0, 255]], np.uint8)
    path = tmp_path / "grey.png"
    if mode == "I;16":
        Image.fromarray(white.astype(np.uint16) * 257).save(path)
    else:
        Image.fromarray(white).convert(mode).save(path)
    light = {"distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 0.02}
    scene = fs.Scene.from_picture(path, **light)
    array = fs.Scene.from_picture(white > 0, **light)

    assert (scene.wavelength_nm.tolist(), scene.band_width_nm.tolist()) == ([550.0], [100.0])
    for found in (scene, array):
        np.testing.assert_array_equal(radiance(found)[0], 0.02 * (white[::-1] > 0))
    layout = fs.layout.grid(n_x=3, n_y=2, pitch_um=100.0)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=fs.Sensor(layout))
    assert camera.capture(scene, exposure_s=0.01, seed=0).settings["light"]["band_width_nm"] == [100.0]


def test_channels_are_weighted_by_spectra():
    spectrum = [[1.0, 0.0, 0.5, 0.0], [0.0, 2.0, 0.5, 0.0], [0.0, 0.0, 0.5, 3.0]]
    scene = scene_of(
        np.full((1, 1, 3), [1.0, 0.5, 0.25]),
        encoding="linear",
        wavelength_nm=[400.0, 500.0, 600.0, 700.0],
        spectrum=spectrum,
        peak_radiance_w_m2_sr_nm=2.0,
    )
    np.testing.assert_allclose(radiance(scene)[:, 0, 0], [2.0, 2.0, 1.75, 1.5], rtol=1e-15)


@pytest.mark.parametrize(
    ("wavelength_nm", "width_nm"),
    [
        ([400.0, 410.0, 420.0], [10.0, 10.0, 10.0]),
        ([450.0, 550.0, 620.0], [100.0, 85.0, 70.0]),  # 400 to 500, 500 to 585, 585 to 655
        ([620.0, 550.0, 450.0], [70.0, 85.0, 100.0]),
        ([550.0, 620.0, 450.0], [85.0, 70.0, 100.0]),
        ([500.0, 600.0], [100.0, 100.0]),
    ],
)
def test_default_bands_extend_to_midpoints(wavelength_nm, width_nm):
    scene = scene_of(F * np.uint8(255), wavelength_nm=wavelength_nm, band_width_nm=None)
    np.testing.assert_allclose(scene.band_width_nm, width_nm, rtol=1e-15)


@pytest.mark.parametrize(("given", "width_nm"), [(12.0, [12.0, 12.0]), ([5.0, 7.0], [5.0, 7.0])])
def test_specified_band_widths_are_used(given, width_nm):
    scene = scene_of(F * np.uint8(255), wavelength_nm=[600.0, 500.0], band_width_nm=given)
    assert scene.band_width_nm.tolist() == width_nm


# -- flat scenes and points -----------------------------------------------------------------------------------------


def test_flat_scene_has_uniform_radiance():
    np.testing.assert_array_equal(radiance(flat(wavelength_nm=[450.0, 550.0])), np.full((2, 4, 6), 0.25))


@pytest.mark.parametrize("pitch_um", [0.5, 10.0, 11.6])
def test_point_intensity_is_radiance_times_area(pitch_um):
    scene = points(pitch_um=pitch_um, intensity_w_sr_nm=3e-6, wavelength_nm=[450.0, 550.0])
    area_m2 = (pitch_um * 1e-6) ** 2
    np.testing.assert_allclose(radiance(scene).sum(axis=(1, 2)) * area_m2, 3e-6, rtol=1e-14)


def test_point_sources_illuminate_their_pixels_only():
    light = radiance(points(pixels=[(0, 0), (3, 5), (1, 4)], intensity_w_sr_nm=[1.0, 2.0, 3.0]))[0] * (10e-6) ** 2
    expected = np.zeros((4, 6))
    expected[0, 0], expected[3, 5], expected[1, 4] = 1.0, 2.0, 3.0
    np.testing.assert_allclose(light, expected, rtol=1e-14)


def test_two_points_in_one_pixel_add_up():
    np.testing.assert_array_equal(
        points(pixels=[(1, 2), (1, 2)], intensity_w_sr_nm=[1.0, 2.0]).basis, points(intensity_w_sr_nm=3.0).basis
    )


# -- invalid arguments -----------------------------------------------------------------------------------------------

WHITE = np.ones((2, 2))
COLOUR = np.ones((2, 2, 3))


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.array([[1.0, math.nan]]), "'picture' must be finite"),
        (np.array([[1.0, math.inf]]), "'picture' must be finite"),
        (np.array([[1.0, -0.1]]), "'picture' must be finite and >= 0"),
        (np.ones((2, 2), np.int64), "'picture' must have the dtype uint8, uint16 or float, got int64"),
        ([[1, 2], [3, 4]], "'picture' must have the dtype uint8, uint16 or float, got int64"),
        (np.ones((2, 2), np.int8), "'picture' must have the dtype uint8, uint16 or float, got int8"),
        (np.ones((2, 2), complex), "'picture' must have the dtype uint8, uint16 or float, got complex128"),
        (np.ones(4), "'picture' must have the shape"),
        (np.ones((2, 2, 5)), "'picture' must have the shape"),
        (np.ones((1, 2, 2, 3)), "'picture' must have the shape"),
        (np.ones((0, 2)), "'picture' must have the shape"),
        (np.ones((2, 2, 0)), "'picture' must have the shape"),
        ([[1.0, 2.0], [3.0]], "'picture' must"),
        (None, "'picture' must"),
    ],
    ids=[
        "nan",
        "inf",
        "negative",
        "int64",
        "list of ints",
        "int8",
        "complex",
        "1-D",
        "5 channels",
        "4-D",
        "no rows",
        "no channels",
        "ragged",
        "none",
    ],
)
def test_from_picture_rejects_invalid_arrays(picture, message):
    with pytest.raises(ParameterError, match=rf"^{re.escape(message)}[^\n]*$"):
        scene_of(picture)


@pytest.mark.parametrize(
    ("picture", "changed", "message"),
    [
        (
            COLOUR,
            {"wavelength_nm": [500.0, 600.0]},
            "'wavelength_nm' must have one value, or one for each of the 3 channels, got [500.0, 600.0] nm; for other",
        ),
        (COLOUR, {"wavelength_nm": np.arange(400.0, 701.0, 10.0)}, "'wavelength_nm' must have one value, or one for"),
        (COLOUR, {"wavelength_nm": [500.0, 600.0], "spectrum": np.ones((2, 2))}, "'spectrum' must have the shape"),
        (WHITE, {"wavelength_nm": [500.0, 600.0], "spectrum": [[1.0, -1.0]]}, "'spectrum' must be >= 0"),
        (WHITE, {"wavelength_nm": [500.0, -600.0]}, "'wavelength_nm' must be > 0"),
        (WHITE, {"wavelength_nm": [500.0, math.nan]}, "'wavelength_nm' must be finite"),
        (WHITE, {"wavelength_nm": [500.0, 500.0], "band_width_nm": None}, "'wavelength_nm' must be unique"),
        (
            WHITE,
            {"wavelength_nm": [550.0], "band_width_nm": None},
            "'band_width_nm' must be given for a single wavelength",
        ),
        (COLOUR, {"band_width_nm": [10.0, 10.0]}, "'band_width_nm' must be one number, or one for each of the 3"),
        (COLOUR, {"band_width_nm": [10.0, 0.0, 10.0]}, "'band_width_nm' must be > 0"),
        (WHITE, {"encoding": "gamma"}, "'encoding' must be one of 'auto', 'srgb', 'sqrt', 'linear', got 'gamma'"),
        (WHITE, {"pitch_um": 0.0}, "'pitch_um' must be > 0"),
        (
            WHITE,
            {"fit": "cover"},
            "'fit' must not be given together with 'pitch_um', got 'cover'; choose one of 'pitch_um', 'fit' and",
        ),
        (
            WHITE,
            {"field_of_view_deg": 30.0},
            "'field_of_view_deg' must not be given together with 'pitch_um', got 30.0",
        ),
        (
            WHITE,
            {"pitch_um": None, "fit": "width", "field_of_view_deg": 30.0},
            "'fit' must not be given together with 'field_of_view_deg', got 'width'",
        ),
        (WHITE, {"pitch_um": None, "fit": "crop"}, "'fit' must be one of 'cover', 'contain', 'width', got 'crop'"),
        (WHITE, {"pitch_um": None, "field_of_view_deg": 0.0}, "'field_of_view_deg' must be > 0"),
        (WHITE, {"pitch_um": None, "field_of_view_deg": 180.0}, "'field_of_view_deg' must be < 180, got 180.0 degrees"),
        (WHITE, {"pitch_um": "10"}, "'pitch_um' must be one number"),
        (WHITE, {"distance_m": -1.0}, "'distance_m' must be > 0"),
        (WHITE, {"distance_m": math.inf}, "'distance_m' must be finite"),
        (WHITE, {"peak_radiance_w_m2_sr_nm": -1.0}, "'peak_radiance_w_m2_sr_nm' must be >"),
        (WHITE, {"peak_radiance_w_m2_sr_nm": math.nan}, "'peak_radiance_w_m2_sr_nm' must be finite"),
    ],
)
def test_from_picture_rejects_invalid_parameters(picture, changed, message):
    with pytest.raises(ParameterError, match=rf"^{re.escape(message)}[^\n]*$"):
        scene_of(picture, **changed)


def test_error_message_shows_plain_numbers():
    with pytest.raises(ParameterError, match=r"got \[500\.0, 600\.0\] nm"):
        scene_of(COLOUR, wavelength_nm=[500.0, 600.0])


def test_negative_file_value_error_names_file(tmp_path):
    tifffile.imwrite(tmp_path / "f.tif", np.array([[1.0, -1.0], [0.0, 0.0]], np.float32))
    with pytest.raises(FileError, match=r"f\.tif: 'picture' must be finite and >= 0 in all pixels$"):
        scene_of(tmp_path / "f.tif")


@pytest.mark.parametrize(
    "create",
    [
        partial(Scene.flat, radiance_w_m2_sr_nm=1.0),
        partial(Scene.point_sources, pixels=[(0, 0)], intensity_w_sr_nm=1.0),
        partial(charts.slanted_edge, radiance_w_m2_sr_nm=1.0),
        partial(charts.point_grid, spacing_mm=2.0, intensity_w_sr_nm=1.0),
    ],
)
def test_scenes_without_wavelengths_have_green_band(create):
    scene = create(shape=(40, 60), pitch_um=1000.0, distance_m=1.0)

    assert (scene.wavelength_nm.tolist(), scene.band_width_nm.tolist()) == ([550.0], [100.0])


def test_from_picture_rejects_missing_file(tmp_path):
    with pytest.raises(FileError, match=r"nowhere\.png: no such file$"):
        scene_of(tmp_path / "nowhere.png")


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"pixels": [(4, 0)]}, "pixels"),
        ({"pixels": [(0, 6)]}, "pixels"),
        ({"pixels": [(-1, 0)]}, "pixels"),
        ({"pixels": [(0.5, 0)]}, "pixels"),
        ({"pixels": [(1, 2, 3)]}, "pixels"),
        ({"pixels": [(1, 2), (1,)]}, "pixels"),
        ({"pixels": []}, "pixels"),
        ({"intensity_w_sr_nm": -1.0}, "intensity_w_sr_nm"),
        ({"intensity_w_sr_nm": math.nan}, "intensity_w_sr_nm"),
        ({"intensity_w_sr_nm": [1.0, 2.0]}, "intensity_w_sr_nm"),
        ({"wavelength_nm": [550.0], "band_width_nm": None}, "band_width_nm"),
        ({"pitch_um": 0.0}, "pitch_um"),
        ({"shape": (4,)}, "shape"),
        ({"shape": (4, 6, 3)}, "shape"),
    ],
)
def test_point_sources_reject_invalid_parameters(changed, name):
    with pytest.raises(ParameterError, match=rf"^'{name}(\[\d\])?' [^\n]*$"):
        points(**changed)


@pytest.mark.parametrize("shape", [(0, 6), (-1, 6), (4.5, 6), (4,), (4, 6, 3)], ids=str)
def test_flat_scene_rejects_invalid_shape(shape):
    with pytest.raises(ParameterError, match=r"^'shape(\[0\])?' "):
        flat(shape=shape)


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"basis": np.ones((2, 2))}, "basis"),
        ({"basis": np.ones((1, 0, 2))}, "basis"),
        ({"basis": np.full((1, 2, 2), math.nan)}, "basis"),
        ({"basis": np.full((1, 2, 2), math.inf)}, "basis"),
        ({"basis": np.full((1, 2, 2), -1.0)}, "basis"),
        ({"spectrum_w_m2_sr_nm": np.ones((1, 2))}, "spectrum_w_m2_sr_nm"),
        ({"spectrum_w_m2_sr_nm": np.ones((2, 1))}, "spectrum_w_m2_sr_nm"),
        ({"spectrum_w_m2_sr_nm": -np.ones((1, 1))}, "spectrum_w_m2_sr_nm"),
        ({"wavelength_nm": [-550.0]}, "wavelength_nm"),
        ({"band_width_nm": [10.0, 10.0]}, "band_width_nm"),
        ({"pitch_um": math.nan}, "pitch_um"),
        ({"pitch_um": None}, "pitch_um"),
        ({"field_of_view_deg": 30.0}, "field_of_view_deg"),
        ({"distance_m": 0.0}, "distance_m"),
    ],
)
def test_scene_rejects_inconsistent_arrays(changed, name):
    given = {
        "basis": np.ones((1, 2, 2)),
        "spectrum_w_m2_sr_nm": np.ones((1, 1)),
        "wavelength_nm": [550.0],
        "band_width_nm": [10.0],
        "pitch_um": 10.0,
        "distance_m": 0.5,
    }
    with pytest.raises(ParameterError, match=rf"^'{name}' must [^\n]*$"):
        Scene(**(given | changed))


@pytest.mark.parametrize("name", ["basis", "spectrum_w_m2_sr_nm", "wavelength_nm", "band_width_nm"])
def test_scene_arrays_are_read_only(name):
    array = getattr(scene_of(F * np.uint8(255)), name)
    with pytest.raises(ValueError, match=r"read-only"):
        array[...] = 0.0


def test_far_scene_accepts_pixels_of_kilometres():
    """Distance of ISETCam scenes, 1e6 m: pixels of 9 km are imaged to 36 µm by a focal length of 4 mm."""
    far = fs.Scene.flat(shape=(12, 16), pitch_um=9e9, distance_m=1e6, radiance_w_m2_sr_nm=0.5, band_width_nm=10.0)
    optics = fs.Optics(focal_length_mm=4.0, f_number=4.0)
    near = fs.Scene.flat(shape=(12, 16), pitch_um=9e6, distance_m=1e3, radiance_w_m2_sr_nm=0.5, band_width_nm=10.0)

    assert optics.grid(far).pitch_um == pytest.approx(36.0, rel=1e-6)
    np.testing.assert_allclose(optics.power_map(far).data, optics.power_map(near).data, rtol=1e-4)
    edge = fs.scene.charts.slanted_edge(
        shape=(12, 16), pitch_um=9e9, distance_m=1e6, radiance_w_m2_sr_nm=0.5, band_width_nm=10.0, wavelength_nm=[550.0]
    )
    assert edge.pitch_um == 9e9


@pytest.mark.parametrize("name", ["pitch_um", "distance_m"])
def test_scene_rejects_sizes_of_other_units(name):
    values = {"pitch_um": 10.0, "distance_m": 1.0, name: 1.1e15}

    with pytest.raises(ParameterError, match=rf"'{name}' must be <= 1e\+"):
        fs.Scene.flat(shape=(4, 4), radiance_w_m2_sr_nm=1.0, band_width_nm=1.0, **values)


def test_pitch_replaces_framing_and_shares_pixels():
    scene = scene_of(F, pitch_um=None, fit="contain")
    framed = scene.with_pitch(3.0)

    assert (framed.pitch_um, framed.fit, framed.field_of_view_deg) == (3.0, None, None)
    assert np.shares_memory(framed.basis, scene.basis)
    assert scene.pitch_um is None
    with pytest.raises(ParameterError, match=r"'pitch_um' must be > 0, got -1\.0 µm"):
        scene.with_pitch(-1.0)


def test_field_of_view_follows_replaced_distance():
    scene = scene_of(F, pitch_um=None, field_of_view_deg=60.0)
    farther = replace(scene, distance_m=2.0 * scene.distance_m, pitch_um=None)

    assert farther.pitch_um == pytest.approx(2.0 * scene.pitch_um)
    with pytest.raises(ParameterError, match="'field_of_view_deg' must not be given together with 'pitch_um'"):
        replace(scene, distance_m=2.0)
