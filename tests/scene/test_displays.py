"""Displays: luminances and colours of colour-science and the standards, means over cells, pictures, settings."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
from PIL import Image

import foveasim as fs
from foveasim.errors import FileError, ParameterError
from foveasim.scene import Display, displays

WAVES_NM = np.arange(400.0, 701.0, 10.0)
BANDS = np.exp(-(((WAVES_NM - np.array([[620.0], [540.0], [450.0]])) / 20.0) ** 2))
PLAIN = {"wavelength_nm": WAVES_NM, "primaries": BANDS, "pitch_um": 250.0}
#: Stripes, stripes between black lines, three unequal areas, and PenTile pixels in which each primary has an equal area.
CELLS = {
    "stripes": [[0, 1, 2]],
    "black matrix": [[-1, -1, -1, -1, -1, -1], [0, -1, 1, -1, 2, -1]],
    "unequal": [[0, 0, 0, 0], [1, 1, 2, -1], [1, 1, 2, -1]],
    "quad": [[0, 1], [1, 2]],
}
RAMP = np.linspace(0.0, 1.0, 256)[np.newaxis]
SHOT = {
    "scene": {"kind": "display", "picture": "picture.png", "display": "lcd", "distance_m": 0.05},
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}},
    "exposure_s": 0.01,
}


def scene_of(picture, display, **parameters):
    return fs.Scene.from_display(picture, display, distance_m=0.5, **parameters)


def radiance_of(scene):
    """Return the spectral radiance (n_wavelength, n_y, n_x)."""
    return np.einsum("byx,bk->kyx", scene.basis, scene.spectrum_w_m2_sr_nm, dtype=np.float64)


def means(values, n_y, n_x):
    """Return the means (..., n_y, n_x) over equal blocks."""
    *first, height, width = values.shape
    return values.reshape(*first, n_y, height // n_y, n_x, width // n_x).mean(axis=(-3, -1))


@pytest.fixture(scope="module")
def colour():
    with np.printoptions():  # its import changes them
        return pytest.importorskip("colour")


@pytest.fixture
def picture():
    return np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)


@pytest.fixture
def shot(tmp_path, picture):
    Image.fromarray(picture).save(tmp_path / "picture.png")
    path = tmp_path / "shot.yaml"
    path.write_text(json.dumps(SHOT), encoding="utf-8")
    return path


# -- luminance and colour ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.2])
@pytest.mark.parametrize("black_cd_m2", [0.0, 0.5])
def test_grey_ramp_has_its_luminance(gamma, black_cd_m2):
    display = Display(**PLAIN, white_cd_m2=320.0, black_cd_m2=black_cd_m2, transfer=gamma)

    found = scene_of(RAMP, display).luminance_cd_m2

    assert found == pytest.approx(black_cd_m2 + (320.0 - black_cd_m2) * RAMP**gamma, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_srgb_ramp_equals_colour_science(colour, dtype):
    peak = np.iinfo(dtype).max if np.dtype(dtype).kind == "u" else 1.0
    digital = np.round(RAMP * 255) * (peak / 255)

    found = scene_of(digital.astype(dtype), displays.lcd(white_cd_m2=100.0, black_cd_m2=0.0)).luminance_cd_m2

    assert found == pytest.approx(100.0 * colour.models.eotf_sRGB(RAMP), rel=1e-5, abs=1e-5)


def test_transfer_table_is_interpolated():
    table = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.4], [1.0, 1.0, 1.0]])
    scene = scene_of(np.array([[0.0, 0.25, 0.5, 0.75, 1.0]]), Display(**PLAIN, white_cd_m2=1.0, transfer=table))

    assert scene.basis[:, 0] == pytest.approx(
        np.array([[0.0, 0.05, 0.1, 0.55, 1.0], [0.0, 0.1, 0.2, 0.6, 1.0], [0.0, 0.2, 0.4, 0.7, 1.0]])
    )


@pytest.mark.parametrize(("name", "space"), [("lcd", "sRGB"), ("oled", "DCI-P3")])
def test_primaries_equal_those_of_standards(colour, name, space):
    display = getattr(displays, name)(black_cd_m2=0.0)
    colours = np.vstack((np.eye(3), np.ones(3)))[np.newaxis]
    radiance = radiance_of(scene_of(colours, display))[:, 0].T
    shape = colour.SpectralShape(380, 780, 5)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)

    found = colour.XYZ_to_xy(radiance @ observer.values)

    assert found[:3] == pytest.approx(colour.RGB_COLOURSPACES[space].primaries, abs=5e-4)
    assert found[3] == pytest.approx(colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"], abs=5e-4)
    assert display.primaries_xy == pytest.approx(found[:3], abs=1e-5)
    assert display.white_xy == pytest.approx(found[3], abs=1e-5)


def test_measured_display_is_read(colour, tmp_path):
    measured = colour.MSDS_DISPLAY_PRIMARIES["Apple Studio Display"]
    path = tmp_path / "display.csv"
    rows = [
        ["# measured"],
        ["wavelength_nm", "red", "green", "blue"],
        *np.column_stack((measured.wavelengths, measured.values)),
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in rows))
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(measured.shape)

    display = Display.from_csv(path, pitch_um=250.0, white_cd_m2=100.0)

    assert display.primaries_xy == pytest.approx(colour.XYZ_to_xy(measured.values.T @ observer.values), abs=1e-4)
    assert scene_of(np.ones((2, 2)), display).luminance_cd_m2 == pytest.approx(np.full((2, 2), 100.0))
    assert not display.has_srgb_colours


def test_leaking_light_has_the_spectrum_of_white():
    scene = scene_of(np.array([[0, 255]], np.uint8), displays.lcd(white_cd_m2=200.0, black_cd_m2=1.0))
    black, white = radiance_of(scene)[:, 0].T

    assert 200.0 * black == pytest.approx(white, rel=1e-5)
    assert displays.lcd(white_cd_m2=200.0, black_cd_m2=1.0).contrast == 200.0
    assert displays.oled().contrast == np.inf


def test_absolute_primaries_have_their_luminance():
    """One watt at 555 nm is 683 lm."""
    display = Display(
        wavelength_nm=[545.0, 555.0, 565.0], primaries=[[0.0, 0.01, 0.0]], pitch_um=100.0, black_cd_m2=2.0
    )

    assert display.white_cd_m2 == pytest.approx(683.0 * 0.01 * 10.0 + 2.0)
    scene = scene_of(np.array([[0.0, 1.0]]), display)
    assert radiance_of(scene)[1, 0, 1] - radiance_of(scene)[1, 0, 0] == pytest.approx(0.01)


@pytest.mark.parametrize(
    "bands", [{"wavelength_nm": [450.0, 550.0, 620.0]}, {"wavelength_nm": [550.0], "band_width_nm": 10.0}]
)
def test_other_bands_keep_the_luminance(bands):
    scene = scene_of(RAMP, "lcd", **bands)

    assert scene.luminance_cd_m2[0, [0, -1]] == pytest.approx([0.25, 250.0], rel=1e-6)
    assert scene.wavelength_nm.tolist() == bands["wavelength_nm"]


# -- subpixels --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CELLS)
def test_cells_conserve_light_of_pixels(picture, name):
    display = Display(**PLAIN, white_cd_m2=300.0, black_cd_m2=0.3, cells=CELLS[name])
    uniform, cells = (scene_of(picture, display, subpixels=each) for each in (False, True))

    assert means(cells.luminance_cd_m2, 6, 8) == pytest.approx(uniform.luminance_cd_m2, rel=1e-9)
    assert means(radiance_of(cells), 6, 8) == pytest.approx(radiance_of(uniform), rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("shape", [(6, 8), (5, 7)])
def test_unequal_pixels_show_means_of_blocks(shape):
    """Two PenTile pixels of RGBG share red and blue; green is that of each pixel."""
    digital = np.random.default_rng(1).random((*shape, 3))
    display = Display(**PLAIN, white_cd_m2=300.0, cells=[[0, 1, 2, 1]], block=(1, 2), transfer=1.0)
    scene = scene_of(digital, display, subpixels=True)
    light = (
        scene.basis * (scene.spectrum_w_m2_sr_nm / scene_of(digital, display).spectrum_w_m2_sr_nm)[:, :1, np.newaxis]
    )
    expected = np.pad(digital, ((0, 0), (0, shape[1] % 2), (0, 0)), mode="edge")[::-1]
    pairs = expected.reshape(shape[0], -1, 2, 3)

    assert means(light[1], *shape) == pytest.approx(expected[:, : shape[1], 1], rel=1e-6)
    n_pairs = shape[1] // 2
    for k in (0, 2):
        found = means(light[k][:, : 4 * n_pairs], shape[0], n_pairs)
        assert found == pytest.approx(pairs[:, :n_pairs, :, k].mean(axis=2), rel=1e-6)


def test_cells_have_the_top_row_first():
    display = Display(**PLAIN, cells=[[0, 0], [1, 2]], white_cd_m2=1.0)
    lit = scene_of(np.ones((1, 1)), display, subpixels=True).basis > 0.0

    assert lit[:, ::-1].astype(int).tolist() == [[[1, 1], [0, 0]], [[0, 0], [1, 0]], [[0, 0], [0, 1]]]


def test_blocks_begin_at_the_top_left():
    display = Display(**PLAIN, cells=[[0, 1], [1, 2]], block=(2, 2), white_cd_m2=1.0)
    lit = scene_of(np.ones((3, 3)), display, subpixels=True).basis > 0.0

    assert lit[0, ::-1].astype(int).tolist() == [[1, 0, 1], [0, 0, 0], [1, 0, 1]]
    assert lit[2, ::-1].astype(int).tolist() == [[0, 0, 0], [0, 1, 0], [0, 0, 0]]


@pytest.mark.parametrize(("name", "n_cells"), [("lcd", 3), ("oled", 2)])
def test_pitch_is_that_of_pixels_or_cells(name, n_cells):
    display = getattr(displays, name)(pitch_um=120.0)

    assert scene_of(RAMP, display).pitch_um == 120.0
    assert scene_of(RAMP, display, subpixels=True).pitch_um == 120.0 / n_cells
    assert scene_of(RAMP, display, subpixels=True).basis.shape == (3, n_cells, 256 * n_cells)
    assert display.dpi == pytest.approx(25400.0 / 120.0)


def test_sensor_sees_moire_of_stripes():
    """Stripes of 1.25 periods per photosite appear with 0.25 periods per photosite."""
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    photosite_um = 10.0
    display = displays.lcd(pitch_um=photosite_um / 1.25 / optics.magnification(0.5), black_cd_m2=0.0)
    red = np.zeros((60, 120, 3), np.uint8)
    red[..., 0] = 255
    layout = fs.layout.grid(n_x=64, n_y=8, pitch_um=photosite_um, fill_factor=0.1)
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout))

    def spectrum(**parameters):
        mean, _ = camera.predict(scene_of(red, display, **parameters), exposure_s=0.002)
        signal = mean.reshape(8, 64).mean(axis=0)
        return np.abs(np.fft.rfft(signal / signal.mean())) / 64

    assert spectrum(subpixels=True)[16] > 0.1
    assert np.argmax(spectrum(subpixels=True)[1:]) == 15
    assert spectrum()[1:].max() < 0.01


# -- pictures ---------------------------------------------------------------------------------------------------------


def test_grey_pictures_show_all_primaries(picture):
    grey = picture[..., 0]
    light = scene_of(grey, "lcd").basis

    assert np.array_equal(light, scene_of(np.repeat(grey[..., np.newaxis], 3, axis=2), "lcd").basis)
    assert np.array_equal(light, scene_of(grey[..., np.newaxis], "lcd").basis)
    assert np.array_equal(
        scene_of(grey > 99, "lcd").basis, scene_of(np.where(grey > 99, 255, 0).astype(np.uint8), "lcd").basis
    )


def test_alpha_is_in_front_of_black(picture):
    alpha = np.full((6, 8, 1), 51, np.uint8)
    light = scene_of(np.concatenate((picture, alpha), axis=2), "lcd").basis

    assert light == pytest.approx(scene_of(picture / 255 * 0.2, "lcd").basis, rel=1e-5)


def test_values_of_files_ignore_profiles(tmp_path, picture):
    """A PNG that states linear values is shown as any other."""
    from PIL import PngImagePlugin

    info = PngImagePlugin.PngInfo()
    info.add(b"gAMA", (100000).to_bytes(4, "big"))
    for name, more in (("plain.png", {}), ("linear.png", {"pnginfo": info})):
        Image.fromarray(picture).save(tmp_path / name, **more)
    plain, linear = (scene_of(tmp_path / name, "lcd") for name in ("plain.png", "linear.png"))

    assert np.array_equal(plain.basis, scene_of(picture, "lcd").basis)
    assert np.array_equal(plain.basis, linear.basis)
    assert "plain.png on a display (LCD, sRGB)" in plain.source


def test_picture_of_lcd_has_its_colours():
    """The colour correction returns the linear sRGB of a uniform picture, relative to white."""
    layout = fs.layout.mosaic(fs.layout.grid(n_x=12, n_y=12, pitch_um=5.0), ("RG", "GB"))
    sensor = fs.Sensor(layout, filters="rgb", shot_noise="off", bits=14, full_well_e=1e5)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)

    def capture(*digital):
        scene = scene_of(np.full((40, 40, 3), digital, np.uint8), displays.lcd(pitch_um=1000.0, black_cd_m2=0.0))
        return camera.capture(scene, exposure_s=0.02, seed=0)

    found, white = (
        np.nanmean(capture(*each).picture().data, axis=(1, 2)) for each in ((200, 120, 60), (255, 255, 255))
    )
    shown = capture(255, 255, 255).colour_correction.matrix @ (found / white)

    assert shown == pytest.approx(fs.units.decode_srgb(np.array([200, 120, 60]) / 255), rel=0.02)


def test_colours_of_displays_are_declared(picture):
    lcd, oled = (scene_of(picture, name) for name in ("lcd", "oled"))

    assert lcd.is_rgb
    assert not oled.is_rgb
    for scene in (lcd, oled):
        white = scene.spectrum_w_m2_sr_nm.sum(axis=0)
        assert scene.illuminant == pytest.approx(white / white.max())


def test_frames_of_videos_are_shown(picture):
    template = scene_of(picture, "oled", subpixels=True, wavelength_nm=[450.0, 550.0, 620.0]).with_centre((10.0, 20.0))
    frames = [picture, 255 - picture]

    shown = list(fs.video.FrameSource(frames, frame_s=0.1, template=template))

    for frame, scene in zip(frames, shown, strict=True):
        expected = scene_of(frame, "oled", subpixels=True, wavelength_nm=[450.0, 550.0, 620.0])
        assert np.array_equal(scene.basis, expected.basis)
        assert np.array_equal(scene.spectrum_w_m2_sr_nm, expected.spectrum_w_m2_sr_nm)
        assert (scene.pitch_um, scene.centre_um) == (expected.pitch_um, (10.0, 20.0))
    with pytest.raises(ParameterError, match="'encoding' must not be given with a template that has a display"):
        fs.video.FrameSource(frames, frame_s=0.1, template=template, encoding="linear")
    with pytest.raises(ParameterError, match="'picture' requires a scene with a display"):
        template.with_pitch(50.0).on_display(picture)


# -- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"transfer": 0.0}, "'transfer' must be > 0, got 0"),
        ({"transfer": -2.2}, "'transfer' must be > 0"),
        ({"transfer": "gamma"}, r"'transfer' must be a number, 'srgb', or a table of the shape \(n_level,\) or \(n_level, 3\)"),
        ({"transfer": np.zeros((4, 2))}, r"'transfer' must be .* with 2 to 65536 levels, got the shape \(4, 2\)"),
        ({"transfer": [0.0, 0.6, 0.5, 1.0]}, "'transfer' must not decrease, as it does at level 2"),
        ({"transfer": [0.01, 0.5, 1.0]}, r"'transfer' must begin with 0 and end with 1, got \[0.01, 1.0\]; subtract the light"),
        ({"black_cd_m2": 100.0}, "'black_cd_m2' must be less than 'white_cd_m2', 100, got 100.0 cd/m²"),
        ({"black_cd_m2": -1.0}, "'black_cd_m2' must be"),
        ({"white_cd_m2": 1e9}, "'white_cd_m2' must be .*luminances are in cd/m²"),
        ({"white_cd_m2": 0.0}, "'white_cd_m2' must be > 0, got 0.0 cd/m²; luminances are in cd/m²"),
        ({"pitch_um": 0.0}, "'pitch_um' must be > 0"),
        ({"wavelength_nm": [0.4, 0.5, 0.6]}, "'wavelength_nm' must be from 10 to"),
        ({"wavelength_nm": [500.0]}, "'wavelength_nm' must have at least 2 wavelengths"),
        ({"primaries": np.ones((3, 4))}, r"'primaries' must have the shape \(n_primary, n_wavelength\) = \(..., 31\)"),
        ({"primaries": -BANDS}, "'primaries' must be >= 0"),
        ({"primaries": 0.0 * BANDS}, "'primaries' must have light between 380 and 780 nm"),
        ({"cells": [[0, 1, 3]]}, "'cells' must be indices of primaries, 0 to 2, or -1 for cells without light, got 3"),
        ({"cells": [[0, 1, 0]]}, "'cells' must contain each of the 3 primaries; 2 is missing"),
        ({"cells": [0, 1, 2]}, r"'cells' must have the shape \(n_y, n_x\), with 1 to 4096 cells, got \(3,\)|'cells' must be"),
        ({"cells": [[0, 1, 2]], "block": (1, 2)}, "'cells' must have an integer number of cells along each side of the 1 x 2"),
        ({"block": (1, 2)}, "'block' requires 'cells'"),
    ],
)  # fmt: skip
def test_invalid_display_is_one_sentence(values, message):
    with pytest.raises(ParameterError, match=f"^{message}") as caught:
        Display(**{**PLAIN, "white_cd_m2": 100.0, **values})
    assert "\n" not in str(caught.value)


def test_missing_pitch_is_named():
    with pytest.raises(ParameterError, match="'pitch_um' must be given"):
        Display(wavelength_nm=WAVES_NM, primaries=BANDS)


@pytest.mark.parametrize(
    ("picture", "parameters", "message"),
    [
        (np.full((2, 2), 1.5), {}, "'picture' must be from 0 to 1 in all pixels; .* divide by 255"),
        (np.full((2, 2), np.nan), {}, "'picture' must be from 0 to 1"),
        (np.ones((2, 2, 5)), {}, r"'picture' must have 1 or 3 channels, as the display, and alpha or none, got the shape \(2, 2, 5\)"),
        (np.ones((2, 2), np.int64), {}, "'picture' must have the dtype uint8, uint16 or float, got int64"),
        (np.ones((0, 2)), {}, "'picture' must"),
        (np.ones((2, 2)), {"wavelength_nm": [300.0, 400.0]}, "'wavelength_nm' must be from 380 to 780"),
        (np.ones((2, 2)), {"wavelength_nm": [550.0]}, "'band_width_nm' must be given"),
    ],
)  # fmt: skip
def test_invalid_picture_is_one_sentence(picture, parameters, message):
    with pytest.raises(ParameterError, match=f"^{message}"):
        scene_of(picture, "lcd", **parameters)


def test_unknown_name_and_cells_are_reported():
    with pytest.raises(ParameterError, match="'display' must be the name of a display, got 'lxd'; did you mean 'lcd'"):
        scene_of(RAMP, "lxd")
    with pytest.raises(
        ParameterError, match="'display' must be the name of a display without required parameters, got 'file'"
    ):
        scene_of(RAMP, "file")
    with pytest.raises(ParameterError, match="'subpixels' requires a display with 'cells'"):
        scene_of(RAMP, Display(**PLAIN), subpixels=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wavelength_nm,red,green\n400,1,1\n500,1,1", "must have the columns 'wavelength_nm', 'red', 'green' and 'blue'"),
        ("wavelength_nm,red,green,blue\n400,1,1,1", "must have 2 to 100000 wavelengths, got 1"),
        ("wavelength_nm,red,green,blue\n400,1,x,1\n500,1,1,1", "must have numbers in line 2, got 400, 1, x, 1"),
        ("wavelength_nm,red,green,blue\n400,1,1,1\n500,-1,1,1", "must have finite numbers >= 0 in line 3"),
        ("wavelength_nm,red,green,blue\n400,1,1,1\n500,nan,1,1", "must have finite numbers >= 0 in line 3"),
        ("wavelength_nm,red,green,blue\n400,1,1,1\n400,1,1,1", "'wavelength_nm' must be unique"),
        ("wavelength_nm,red,green,blue\n0.4,1,1,1\n0.5,1,1,1", "'wavelength_nm' must be from 10"),
        ("wavelength_nm,red,green,blue\n900,1,1,1\n950,1,1,1", "'primaries' must have light between 380 and 780 nm"),
    ],
)  # fmt: skip
def test_invalid_file_is_one_sentence(tmp_path, text, message):
    path = tmp_path / "display.csv"
    path.write_text(text)

    with pytest.raises(FileError, match=f"display.csv: {message}"):
        Display.from_csv(path, pitch_um=250.0, white_cd_m2=100.0)
    with pytest.raises(FileError, match="no such file"):
        Display.from_csv(tmp_path / "missing.csv", pitch_um=250.0)


# -- objects and settings ---------------------------------------------------------------------------------------------


def test_display_and_scene_are_pickled(picture):
    display = displays.oled(white_cd_m2=300.0)
    again = pickle.loads(pickle.dumps(display))
    scene = pickle.loads(pickle.dumps(scene_of(picture, display, subpixels=True)))

    assert np.array_equal(scene_of(picture, again, subpixels=True).basis, scene.basis)
    assert repr(again) == repr(display)
    assert "pitch_um=63.5, white_cd_m2=300.0" in repr(display)
    assert not display.primaries.flags.writeable


def test_settings_name_and_describe_displays(shot, picture):
    by_name = fs.config.read_shot(shot).scene
    section = "scene.display={kind: lcd, pitch_um: 100, transfer: 2.2, cells: [[0, 1, 2]]}"
    described = fs.config.read_shot(shot, [section, "scene.subpixels=true"]).scene

    assert np.array_equal(by_name.basis, scene_of(picture, "lcd").basis)
    expected = scene_of(picture, displays.lcd(pitch_um=100.0, transfer=2.2), subpixels=True)
    assert np.array_equal(described.basis, expected.basis)
    assert described.pitch_um == pytest.approx(100.0 / 3.0)


def test_sweep_compares_displays_by_name(shot):
    plan = fs.config.read_settings(shot)
    plan["scene"]["picture"] = str(shot.parent / "picture.png")

    found = fs.explore.sweep(plan, {"scene.display": ["lcd", "oled"]}, workers=0)

    assert found.sizes["scene.display"] == 2


def test_python_source_calls_displays(shot, picture):
    settings = fs.config.read_settings(shot, ["scene.display={kind: oled, white_cd_m2: 200}"])
    source = fs.config.to_python(settings, source=shot)
    names = {}
    exec(source, names)

    assert "display=fs.scene.displays.oled(white_cd_m2=200.0)" in source
    assert np.array_equal(names["scene"].basis, scene_of(picture, "oled").basis)
