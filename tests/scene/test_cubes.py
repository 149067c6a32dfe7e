"""Hyperspectral cubes: files written by hand, compared with the numbers in them; electrons of closed-form spectra."""

from __future__ import annotations

import copy
import json
import math
import mmap
import os
import pickle
import struct
import sys
import zlib
from dataclasses import replace

import numpy as np
import pytest
import scipy.constants
from lazy_modules import LazyModule
from PIL import Image

import foveasim as fs
from foveasim._io.rasters.mat import write_mat73
from foveasim.config import read_shot, schema
from foveasim.errors import ConfigError, FileError, FoveasimWarning, ParameterError
from foveasim.scene import CUBE_FORMATS, Scene
from foveasim.scene.charts import illuminant
from foveasim.scene.cubes import _envi, _formats, _selection
from foveasim.view.plots.rasters import scene_pixels

h5py, xr, OpenEXR, tifffile = map(LazyModule, ("h5py", "xarray", "OpenEXR", "tifffile"))

#: Values [band, row, column] with the top row first; no two are equal.
VALUES = np.arange(3 * 4 * 5, dtype=np.float64).reshape(3, 4, 5)
WAVES = [450.0, 550.0, 650.0]
PER_NM = "W m-2 sr-1 nm-1"
RADIANCE = {"unit": PER_NM, "distance_m": 1.0}


def read_here(form, reader, path, **args):
    """Read in this process; metadata are transferred as JSON as between processes."""
    assert form.is_sandboxed
    metadata, arrays = reader(str(path), **args)
    return json.loads(json.dumps(metadata)), arrays


@pytest.fixture(autouse=True)
def in_process(monkeypatch):
    """Read all formats in this process: starting a sandbox process takes about a second per file."""
    monkeypatch.setattr(_formats, "read_raster", read_here)


def radiance(scene):
    """Return the spectral radiance [wavelength, row, column], top row first, from the definition of a scene."""
    return np.einsum("byx,bk->kyx", scene.basis.astype(float), scene.spectrum_w_m2_sr_nm)[:, ::-1]


def write_envi(path, values=VALUES, *, code="f", number=4, interleave="bsq", order="<", offset=0, lines=(), **entries):
    """Write a cube number by number, as the definition of the interleaves specifies."""
    n_bands, n_y, n_x = values.shape
    loops = {
        "bsq": [(b, y, x) for b in range(n_bands) for y in range(n_y) for x in range(n_x)],
        "bil": [(b, y, x) for y in range(n_y) for b in range(n_bands) for x in range(n_x)],
        "bip": [(b, y, x) for y in range(n_y) for x in range(n_x) for b in range(n_bands)],
    }[interleave]
    convert = float if code in "fd" else int
    path.with_suffix(".img").write_bytes(
        b"#" * offset + b"".join(struct.pack(order + code, convert(values[at])) for at in loops)
    )
    header = {
        "samples": n_x,
        "lines": n_y,
        "bands": n_bands,
        "header offset": offset,
        "file type": "ENVI Standard",
        "data type": number,
        "interleave": interleave,
        "byte order": "<>".index(order),
        "wavelength units": "Nanometers",
        "wavelength": "{" + ",\n  ".join(map(str, WAVES[:n_bands])) + "}",
        "map info": "{UTM, 1, 1, 300000, 4000000, 30, 30, 12, North}",
        **{key.replace("_", " "): value for key, value in entries.items()},
    }
    for line in lines:
        header.pop(line.partition(" =")[0], None)
    text = "\n".join(["ENVI", "; a comment = {1}", *(f"{k} = {v}" for k, v in header.items() if v is not None), *lines])
    path.write_text(text + "\n")
    return path


def assert_rejected(path, match, error=FileError, **options):
    with pytest.raises(error, match=match) as caught:
        Scene.from_cube(path, **{**RADIANCE, **options})
    assert "\n" not in str(caught.value)
    if error is FileError:
        assert str(caught.value).startswith(f"{path}: ")


# -- ENVI -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("interleave", ["bsq", "bil", "bip"])
@pytest.mark.parametrize(
    ("code", "number"),
    [("B", 1), ("h", 2), ("i", 3), ("f", 4), ("d", 5), ("H", 12), ("I", 13), ("q", 14), ("Q", 15)],
)
def test_envi_types_and_interleaves_are_read(tmp_path, code, number, interleave, order):
    path = write_envi(tmp_path / "cube.hdr", code=code, number=number, interleave=interleave, order=order, offset=7)

    scene = Scene.from_cube(path, **RADIANCE)

    np.testing.assert_array_equal(radiance(scene), VALUES)
    assert scene.basis.dtype == (np.float32 if code in "BhfH" else np.float64)
    assert scene.wavelength_nm.tolist() == WAVES
    assert scene.band_width_nm.tolist() == [100.0] * 3
    assert scene.source == str(path)


@pytest.fixture
def all_mapped(monkeypatch):
    """Map floating-point ENVI data of any size."""
    monkeypatch.setattr(_selection, "MAX_COPIED_BYTES", 0)


PART = {"rows": (1, 4), "columns": (0, 2), "range_nm": (500, 700)}


@pytest.mark.parametrize("interleave", ["bsq", "bil"])
def test_large_envi_is_mapped(tmp_path, interleave, all_mapped):
    path = write_envi(tmp_path / "cube.hdr", interleave=interleave)

    scene = Scene.from_cube(path, **RADIANCE, **PART)

    base = scene.basis
    while isinstance(base, np.ndarray):
        base = base.base
    assert isinstance(base, mmap.mmap)
    assert not scene.basis.flags.writeable
    np.testing.assert_array_equal(radiance(scene), VALUES[1:, 1:4, :2])


@pytest.mark.parametrize("interleave", ["bsq", "bil", "bip"])
def test_small_scene_survives_changed_file(tmp_path, interleave):
    path = write_envi(tmp_path / "cube.hdr", interleave=interleave)
    scene, part = Scene.from_cube(path, **RADIANCE), Scene.from_cube(path, **RADIANCE, **PART)

    data = path.with_suffix(".img")
    data.write_bytes(bytes(data.stat().st_size))

    np.testing.assert_array_equal(radiance(scene), VALUES)
    np.testing.assert_array_equal(radiance(part), VALUES[1:, 1:4, :2])
    assert not scene.basis.flags.writeable
    data.write_bytes(b"")
    np.testing.assert_array_equal(radiance(scene), VALUES)


def change(data, how):
    if how == "overwritten":
        data.write_bytes(bytes(data.stat().st_size))
    elif how == "truncated":
        data.write_bytes(b"")
    else:
        with data.open("ab") as file:
            file.write(b"1234")


#: Uses of a scene from a file: each raises after a change.
USES = {
    "basis": lambda scene, _: scene.basis,
    "power map": lambda scene, camera: camera.optics.power_map(scene),
    "capture": lambda scene, camera: camera.capture(scene, exposure_s=0.1, seed=0),
    "crop": lambda scene, _: replace(scene, basis=scene.basis[:, 1:]),
    "pitch": lambda scene, _: scene.with_pitch(5.0).basis,
    "pixels": lambda scene, _: scene_pixels(scene, 2),
    "pickle": lambda scene, _: pickle.dumps(scene),
    "copy": lambda scene, _: copy.deepcopy(scene),
}


@pytest.mark.parametrize("how", ["overwritten", "truncated", "extended"])
@pytest.mark.parametrize("interleave", ["bsq", "bil"])
@pytest.mark.parametrize("use", USES)
def test_changed_mapped_file_raises_at_use(tmp_path, use, interleave, how, all_mapped):
    path = write_envi(tmp_path / "cube.hdr", interleave=interleave)
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=20.0, f_number=4.0, oversample=1),
        sensor=fs.Sensor(fs.layout.grid(n_x=2, n_y=2, pitch_um=40.0), qe=0.5),
    )
    scene = Scene.from_cube(path, **RADIANCE, pitch_um=1000.0)
    crop = replace(scene, basis=scene.basis[:, :, 1:])
    USES[use](scene, camera)  # the unchanged file
    data = path.with_suffix(".img")
    os.utime(data, ns=(0, 0))  # before the resolution of file times
    scene = Scene.from_cube(path, **RADIANCE, pitch_um=1000.0)

    change(data, how)

    expected = {"overwritten": "was modified", "truncated": "has 0 bytes instead of 240", "extended": "has 244 bytes"}
    for one in (scene, crop):
        with pytest.raises(FileError, match=f"{expected[how]}.* since it was opened; open it again") as caught:
            USES[use](one, camera)
        assert caught.value.path == data
    assert "5 x 4 pixels" in repr(scene)


def test_replaced_file_leaves_mapped_scene_valid(tmp_path, all_mapped):
    scene = Scene.from_cube(write_envi(tmp_path / "cube.hdr"), **RADIANCE)
    (tmp_path / "new.img").write_bytes(b"other")
    (tmp_path / "new.img").replace(tmp_path / "cube.img")

    np.testing.assert_array_equal(radiance(scene), VALUES)


@pytest.mark.slow
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("interleave", ["bsq", "bil", "bip"])
def test_mapped_and_copied_captures_are_equal(tmp_path, interleave, order, monkeypatch):
    values = np.random.default_rng(0).random((3, 24, 32))
    path = write_envi(tmp_path / "cube.hdr", values, interleave=interleave, order=order)
    lens = {"focal_length_mm": 20.0, "f_number": 4.0, "oversample": 1}
    varying = fs.Optics(**lens, seidel=fs.optics.Seidel(coma_um=0.1), field_patches=2)
    maps = []
    for limit in (2**30, 0):
        monkeypatch.setattr(_selection, "MAX_COPIED_BYTES", limit)
        scene = Scene.from_cube(path, **RADIANCE, pitch_um=1000.0)
        maps.append([optics.power_map(scene).data for optics in (fs.Optics(**lens), varying)])

    for copied, mapped in zip(*maps, strict=True):
        np.testing.assert_array_equal(copied, mapped)


def test_envi_data_file_finds_header(tmp_path):
    path = write_envi(tmp_path / "cube.hdr")

    scene = Scene.from_cube(path.with_suffix(".img"), **RADIANCE)
    path.rename(tmp_path / "cube.img.hdr")
    again = Scene.from_cube(tmp_path / "cube.img", **RADIANCE)
    by_header = Scene.from_cube(tmp_path / "cube.img.hdr", **RADIANCE)

    for one in (scene, again, by_header):
        np.testing.assert_array_equal(radiance(one), VALUES)


def test_envi_scale_factors_are_applied(tmp_path):
    gains = write_envi(
        tmp_path / "gains.hdr",
        data_gain_values="{1, 2, 0.5}",
        data_offset_values="{0, 0, 3}",
        data_units="mW/(cm2 sr um)",
    )
    scaled = write_envi(tmp_path / "scaled.hdr", code="h", number=2, reflectance_scale_factor=10_000)

    # 1 mW/(cm² sr µm) = 1e-3 W / (1e-4 m² sr 1e3 nm) = 0.01 W/(m² sr nm).
    expected = 0.01 * (VALUES * np.array([1.0, 2.0, 0.5])[:, None, None] + np.array([0.0, 0.0, 3.0])[:, None, None])
    np.testing.assert_allclose(radiance(Scene.from_cube(gains, distance_m=1.0)), expected, rtol=1e-6)
    lit = Scene.from_cube(scaled, distance_m=1.0, illuminant="E", radiance_w_m2_sr_nm=0.2)
    np.testing.assert_allclose(radiance(lit), VALUES / 10_000 * 0.2, rtol=1e-12)


@pytest.mark.parametrize(
    ("units", "per_nm"),
    [("Nanometers", 1.0), ("Micrometers", 1e-3), ("um", 1e-3), ("Meters", 1e-9), ("Unknown", 1.0), (None, 1.0)],
)
def test_envi_wavelengths_become_nm(tmp_path, units, per_nm):
    waves = "{" + ",".join(repr(w * per_nm) for w in WAVES) + "}"
    path = write_envi(tmp_path / "cube.hdr", wavelength=waves, wavelength_units=units)

    np.testing.assert_allclose(Scene.from_cube(path, **RADIANCE).wavelength_nm, WAVES, rtol=1e-12)


def test_bad_bands_are_skipped(tmp_path):
    values = VALUES.copy()
    values[1] = np.nan
    path = write_envi(tmp_path / "cube.hdr", values, bbl="{1, 0, 1}")

    scene = Scene.from_cube(path, **RADIANCE)

    np.testing.assert_array_equal(radiance(scene), VALUES[[0, 2]])
    assert scene.wavelength_nm.tolist() == [450.0, 650.0]
    assert_rejected(path, r"got nan at \[band, row, column\] = \[1, 0, 0\], 20 such values", bands=[0, 1])


BAD_ENVI = {
    "no wavelengths": (
        {"wavelength": None},
        r"does not specify the wavelengths of its bands; pass wavelength_nm=\.\.\., 3",
    ),
    "wrong count": ({"wavelength": "{450, 550}"}, "contains 2 wavelengths for 3 bands"),
    "descending": (
        {"wavelength": "{650, 550, 450}"},
        "wavelengths must ascend, got 550 nm in band 1 after 650 nm in band 0; select bands in ascending order with bands=",
    ),
    "unknown unit": ({"wavelength_units": "Wavenumber"}, "in the unknown unit 'Wavenumber', expected nm, µm or m"),
    "no unit": ({"wavelength": "{0.4, 0.5, 0.6}", "wavelength_units": None}, "from 0.4 to 0.6 without a unit"),
    "not a number": ({"wavelength": "{450, x, 650}"}, "'wavelength' must be a list of numbers"),
    "interleave": (
        {"interleave": "bsq", "lines": ("interleave = bsx",)},
        "'interleave' must be bsq, bil or bip, got 'bsx'",
    ),
    "data type": ({"lines": ("data type = 6",)}, "'data type' must be one of .*, got 6, which is complex"),
    "byte order": ({"lines": ("byte order = 2",)}, r"'byte order' must be 0 .* or 1 .*, got 2"),
    "no samples": ({"samples": None}, "'samples' must be an integer of at least 1, and is missing"),
    "too many lines": (
        {"lines": ("lines = 5",)},
        "300 bytes in all, but 'cube.img' has 240: the data file is truncated",
    ),
    "too few lines": (
        {"lines": ("lines = 3",)},
        "180 bytes in all, but 'cube.img' has 240: the data file contains more",
    ),
    "huge": ({"lines": ("lines = 99999999999999999999",)}, "'lines' must be an integer"),
    "gains": ({"data_gain_values": "{1, 2}"}, "'data gain values' must have 3 numbers, one per band, got 2"),
    "zero scale": ({"reflectance_scale_factor": 0}, "'reflectance scale factor' must be > 0, got 0"),
    "bad bands": ({"bbl": "{0, 0, 0}"}, "marks all its bands as bad"),
    "short bbl": ({"bbl": "{0, 1}"}, "'bbl' must have 3 numbers, one per band, got 2"),
    "compressed": ({"file_compression": 1}, "is compressed"),
    "unknown gain": ({"radiometric_gain": 2}, "has the unknown key 'radiometric gain', which may change the values"),
    "complex": ({"complex_function": "Power"}, "has the unknown key 'complex function', which may change the values"),
    "two gains": (
        {"data_gain_values": "{1, 1, 1}", "Data_Gain_Values": "{2, 2, 2}"},
        "has two values of 'data gain values', '{1, 1, 1}' and '{2, 2, 2}'",
    ),
    "library": (
        {"file_type": "ENVI Spectral Library"},
        "has the 'file type' 'ENVI Spectral Library', expected ENVI Stand",
    ),
    "missing": ({"data_ignore_value": 7}, r"got 7 at \[band, row, column\] = \[0, 1, 2\], 1 such values"),
}


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.upper().replace("; A", "; a"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("wavelength = {", "wavelength =\n  {\n"),
        lambda text: text.replace(",\n  ", "  "),
        lambda text: text.replace("\n", "\r\n").replace(" = ", "="),
        lambda text: text + "\n  ; wavelength = {1}\ndescription = {\n  gain = 2}\noperator = someone\n",
    ],
    ids=["upper case", "byte order mark", "brace on next line", "blanks", "line ends", "comments"],
)
def test_envi_headers_of_other_programs_are_read(tmp_path, change):
    path = write_envi(tmp_path / "cube.hdr", data_gain_values="{1, 2, 0.5}", FWHM="{5, 5, 5}")
    path.write_text(change(path.read_text()), encoding="utf-8", newline="")

    scene = Scene.from_cube(path, **RADIANCE)
    assert scene.wavelength_nm.tolist() == WAVES
    np.testing.assert_allclose(radiance(scene), VALUES * np.array([1.0, 2.0, 0.5])[:, None, None])


def test_envi_gains_of_reflectance_are_applied(tmp_path):
    gains = {"data_reflectance_gain_values": "{0.01, 0.02, 0.01}", "data_reflectance_offset_values": "{0, 0, 0.1}"}
    lit = {"distance_m": 1.0, "illuminant": "E", "radiance_w_m2_sr_nm": 1.0}
    expected = VALUES * np.array([0.01, 0.02, 0.01])[:, None, None] + np.array([0.0, 0.0, 0.1])[:, None, None]
    scene = Scene.from_cube(write_envi(tmp_path / "cube.hdr", **gains), **lit)
    np.testing.assert_allclose(radiance(scene), expected, rtol=1e-6)
    both = write_envi(tmp_path / "cube.hdr", data_gain_values="{2, 2, 2}", **gains)
    np.testing.assert_allclose(radiance(Scene.from_cube(both, **RADIANCE)), 2.0 * VALUES, rtol=1e-6)


@pytest.mark.parametrize(("entries", "match"), BAD_ENVI.values(), ids=BAD_ENVI)
def test_bad_envi_gives_one_line(tmp_path, entries, match):
    assert_rejected(write_envi(tmp_path / "cube.hdr", **entries), match)


def test_missing_files_give_one_line(tmp_path):
    path = write_envi(tmp_path / "cube.hdr")
    path.with_suffix(".img").rename(tmp_path / "cubes.img")

    assert_rejected(
        path, "has no data file: expected 'cube' without extension or with one of .*; did you mean 'cubes.img'"
    )
    assert_rejected(tmp_path / "cub.hdr", "did you mean 'cube.hdr'")
    (tmp_path / "text.hdr").write_text("#?RADIANCE\n")
    assert_rejected(
        tmp_path / "text.hdr",
        "not a valid hyperspectral cube: expected ENVI, EXR, folder of pictures, MAT, netCDF, numpy array, TIFF or zarr",
    )
    for name in ("cube.dat", "cube.raw"):
        (tmp_path / name).write_bytes(bytes(240))
    assert_rejected(path, r"several data files, cube\.dat, cube\.raw; pass the data file instead")


# -- selection --------------------------------------------------------------------------------------------------------


def test_resampling_interpolates_linearly(tmp_path):
    scene = Scene.from_cube(write_envi(tmp_path / "cube.hdr"), **RADIANCE, resample_nm=[475.0, 550.0])

    np.testing.assert_allclose(radiance(scene), [0.75 * VALUES[0] + 0.25 * VALUES[1], VALUES[1]], rtol=1e-12)
    assert scene.basis.shape[0] == 2  # band 650 nm has no weight, and is not read
    assert scene.wavelength_nm.tolist() == [475.0, 550.0]
    assert scene.band_width_nm.tolist() == [75.0, 75.0]


@pytest.mark.parametrize("interleave", ["bsq", "bip"])
def test_bands_select_order_of_wavelengths(tmp_path, interleave):
    path = write_envi(tmp_path / "cube.hdr", wavelength="{650, 550, 450}", interleave=interleave)

    scene = Scene.from_cube(path, **RADIANCE, bands=[2, 0])

    np.testing.assert_array_equal(radiance(scene), VALUES[[2, 0]])
    assert scene.wavelength_nm.tolist() == [450.0, 650.0]


def test_large_pixel_interleaved_cube_is_converted(tmp_path, monkeypatch):
    monkeypatch.setattr(_selection, "BLOCK_VALUES", 31)
    path = write_envi(tmp_path / "cube.hdr", interleave="bip")

    scene = Scene.from_cube(path, **RADIANCE, rows=(1, 4), columns=(2, 5), bands=[0, 2])

    np.testing.assert_array_equal(radiance(scene), VALUES[[0, 2], 1:4, 2:5])


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"rows": (0, 5)}, r"'rows' must be \(start, stop\) with 0 <= start < stop <= 4, got \(0, 5\)"),
        ({"columns": (3, 3)}, r"'columns' must be \(start, stop\)"),
        ({"columns": (3,)}, r"'columns' must be two integers"),
        ({"rows": 3}, "'rows' must be two integers, got 3"),
        ({"bands": 3}, "'bands' must be a sequence of integers, got 3"),
        ({"bands": [3]}, "'bands' must be from 0 to 2, the bands of the cube, got 3"),
        ({"bands": [0, 0]}, "'bands' must be different indices"),
        ({"bands": [0.5]}, r"'bands\[0\]' must be an integer"),
        ({"range_nm": (700, 800)}, "'range_nm' must contain a band of the cube, from 450 to 650"),
        ({"range_nm": (500, 400)}, r"'range_nm' must be two wavelengths \(lowest, highest\)"),
        ({"resample_nm": [400.0]}, "'resample_nm' must be from 450 to 650, the range of the selected bands"),
        ({"resample_nm": [500.0, 480.0]}, "'resample_nm' must ascend"),
        ({"wavelength_nm": [450.0, 550.0]}, "'wavelength_nm' must have 3 values, one per band of the cube, got 2"),
        ({"invalid": "nan"}, "'invalid' must be one of 'raise', 'zero'"),
        ({"quantity": "radience"}, "did you mean 'radiance'"),
        ({"unit": "W m-2"}, "'unit' must be a unit of radiance or reflectance, got 'W m-2'; .* 'W m-2 sr-1 nm-1'"),
        ({"quantity": "reflectance"}, "'unit' must be a unit of reflectance"),
        ({"scale": 0.0}, "'scale' must be > 0"),
        ({"illuminant": "A"}, "'illuminant' must be omitted for a cube of radiance"),
        ({"distance_m": None}, "'distance_m' must be given: the file does not contain the distance"),
        ({"pitch_um": 1.0, "field_of_view_deg": 2.0}, "'field_of_view_deg' must not be given together with 'pitch_um'"),
        ({"bands": [1]}, "'band_width_nm' must be given for a single wavelength"),
    ],
)
def test_wrong_arguments_give_one_line(tmp_path, options, match):
    assert_rejected(write_envi(tmp_path / "cube.hdr"), match, ParameterError, **options)


def test_arrays_are_those_of_files(tmp_path):
    """Rows of numpy arrays are top row first, as those of pictures."""
    options = {"wavelength_nm": WAVES, "unit": "W m-2 sr-1 nm-1", "distance_m": 1.0, "pitch_um": 100.0}
    values = np.random.default_rng(0).random((4, 5, len(WAVES))).astype(np.float32)
    np.save(tmp_path / "cube.npy", values)
    tifffile.imwrite(tmp_path / "bands.tif", np.moveaxis(values, -1, 0), photometric="minisblack")
    tifffile.imwrite(tmp_path / "pixels.tif", values, photometric="minisblack", planarconfig="contig")
    scene = Scene.from_cube(values, **options)
    others = [
        Scene.from_cube(np.moveaxis(values, -1, 0), axis=0, **options),
        *(Scene.from_cube(tmp_path / name, **options) for name in ("cube.npy", "bands.tif", "pixels.tif")),
    ]
    before = values.copy()
    values[:] = 0.0

    assert np.array_equal(scene.basis, np.moveaxis(before, -1, 0)[:, ::-1])
    for other in others:
        assert np.array_equal(other.basis, scene.basis)
        assert np.array_equal(other.spectrum_w_m2_sr_nm, scene.spectrum_w_m2_sr_nm)


def test_labelled_array_has_its_wavelengths():
    xarray = pytest.importorskip("xarray")
    values = np.random.default_rng(0).random((2, 4, 5))
    coords = {"wavelength": ("wavelength", [500.0, 600.0], {"units": "nm"})}
    array = xarray.DataArray(values, coords, ("wavelength", "y", "x"), attrs={"units": "W m-2 sr-1 nm-1"})
    scene = Scene.from_cube(array.transpose("y", "x", "wavelength"), distance_m=1.0, pitch_um=100.0)

    assert scene.wavelength_nm.tolist() == [500.0, 600.0]
    assert scene.basis * scene.spectrum_w_m2_sr_nm[0, 0] == pytest.approx(values[:, ::-1])


def test_dataset_of_hdf5_is_selected_by_name(tmp_path):
    h5py = pytest.importorskip("h5py")
    values = np.random.default_rng(0).random((4, 5, 2))
    with h5py.File(tmp_path / "cube.h5", "w") as file:
        file["first"], file["second"] = values, 2.0 * values
    options = {"wavelength_nm": [500.0, 600.0], "unit": "W m-2 sr-1 nm-1", "distance_m": 1.0, "pitch_um": 100.0}
    scene = Scene.from_cube(tmp_path / "cube.h5", name="second", **options)

    assert scene.basis * scene.spectrum_w_m2_sr_nm[0, 0] == pytest.approx(2.0 * np.moveaxis(values, -1, 0)[:, ::-1])


@pytest.mark.parametrize(
    ("array", "options", "message"),
    [
        (np.ones((2, 3, 2)), {}, "'path' is an array that does not specify the wavelengths of its bands; pass wave"),
        (np.ones((2, 3, 2)), {"wavelength_nm": [500, 600]}, "'path' is an array that does not specify the unit of its"),
        (np.ones(4), {}, r"'path' must be a file, or an array of rows, columns and bands, got \(4,\)"),
        (np.ones((2, 3, 2)), {"axis": 5}, "'axis' must be an axis of the array, from -3 to 2, got 5"),
        ("cube.npy", {"axis": 0}, "'axis' must be -1 for files, whose formats specify the axes, got 0"),
    ],
)
def test_incomplete_arrays_give_one_line(array, options, message):
    with pytest.raises(ParameterError, match=message):
        Scene.from_cube(array, distance_m=1.0, **options)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_invalid_values_are_rejected_or_replaced(tmp_path, value):
    values = VALUES.copy()
    values[1, 2, 3] = value
    path = write_envi(tmp_path / "cube.hdr", values)

    assert_rejected(
        path, rf"got {value:g} at \[band, row, column\] = \[1, 2, 3\], 1 such values in all; pass invalid='zero'"
    )
    assert_rejected(path, r"at \[band, row, column\] = \[1, 2, 3\]", rows=(1, 4), columns=(1, 5), range_nm=(500, 700))
    replaced = VALUES.copy()
    replaced[1, 2, 3] = 0.0
    np.testing.assert_array_equal(radiance(Scene.from_cube(path, **RADIANCE, invalid="zero")), replaced)


def test_offset_precedes_check_of_sign(tmp_path):
    path = write_envi(tmp_path / "cube.hdr", VALUES - 2.0, data_offset_values="{2, 2, 2}")

    np.testing.assert_array_equal(radiance(Scene.from_cube(path, **RADIANCE)), VALUES)
    assert_rejected(
        write_envi(tmp_path / "low.hdr", VALUES, data_offset_values="{0, -21.5, 0}"),
        r"got -1\.5 at .* = \[1, 0, 0\], 2 such",
    )


def test_cube_too_large_for_memory(tmp_path, monkeypatch):
    path = write_envi(tmp_path / "cube.hdr", code="h", number=2)
    monkeypatch.setattr(_selection, "memory_bytes", lambda: 100)

    assert_rejected(path, "needs .* GiB of memory, more than .*; select bands=, range_nm=, rows= or columns=")
    assert Scene.from_cube(path, **RADIANCE, rows=(0, 1)).basis.shape == (3, 1, 5)


# -- units and illuminants --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "per_unit"),
    [
        ("W m-2 sr-1 nm-1", 1.0),
        ("W.m^-2.sr^-1.nm^-1", 1.0),
        ("W/m²/sr/µm", 1e-3),
        ("W m-2 sr-1 m-1", 1e-9),
        ("uW/(cm^2 sr nm)", 1e-2),
        ("µW*cm-2*nm-1*sr-1", 1e-2),
    ],
)
def test_units_of_power_are_converted(tmp_path, unit, per_unit):
    scene = Scene.from_cube(write_envi(tmp_path / "cube.hdr"), unit=unit, distance_m=1.0)

    np.testing.assert_allclose(radiance(scene), VALUES * per_unit, rtol=1e-12)


def test_photons_become_power(tmp_path):
    scene = Scene.from_cube(write_envi(tmp_path / "cube.hdr"), unit="photons/(s m2 sr nm)", distance_m=1.0)

    photon_j = scipy.constants.h * scipy.constants.c / (np.array(WAVES) * 1e-9)
    np.testing.assert_allclose(radiance(scene), VALUES * photon_j[:, None, None], rtol=1e-9)


def test_unit_of_file_must_be_known(tmp_path):
    path = write_envi(tmp_path / "cube.hdr", data_units="DN")
    assert_rejected(
        path, "has the unit 'DN', which is neither a spectral radiance nor a reflectance; pass unit=", unit=None
    )
    path = write_envi(tmp_path / "cube.hdr", data_units="W m-2 sr-1")
    assert_rejected(path, "which is not per nm; pass unit=", unit=None)
    path = write_envi(tmp_path / "cube.hdr")
    assert_rejected(path, "does not specify the unit of its values; pass unit=.*, or quantity='reflectance'", unit=None)


def test_reflectance_is_lit_by_illuminant(tmp_path):
    path = write_envi(tmp_path / "cube.hdr", VALUES / 100.0, code="d", number=5)
    options = {"quantity": "reflectance", "distance_m": 1.0, "radiance_w_m2_sr_nm": 0.3}

    daylight = radiance(Scene.from_cube(path, **options))
    table = {"wavelength_nm": [400.0, 500.0, 700.0], "value": [0.0, 1.0, 3.0]}
    tabulated = radiance(Scene.from_cube(path, **options, illuminant=table))
    percent = radiance(Scene.from_cube(path, **(options | {"unit": "%"}), scale=100.0))
    ends = {"wavelength_nm": [WAVES[0], WAVES[-1]], "value": [1.0, 1.0]}
    widths_nm = Scene.from_cube(path, **options, illuminant=ends).band_width_nm
    assert widths_nm.sum() == pytest.approx(np.ptp(WAVES))  # bands end with the table

    np.testing.assert_allclose(daylight, VALUES / 100 * 0.3 * illuminant("D65", WAVES)[:, None, None], rtol=1e-12)
    np.testing.assert_allclose(tabulated, VALUES / 100 * 0.3 * np.array([0.5, 1.5, 2.5])[:, None, None], rtol=1e-12)
    np.testing.assert_allclose(percent, daylight, rtol=1e-12)


def test_wrong_illumination_gives_one_line(tmp_path):
    path = write_envi(tmp_path / "cube.hdr", VALUES / 100.0, wavelength="{450, 550, 850}")
    lit = {"unit": "1", "radiance_w_m2_sr_nm": 0.3}

    assert_rejected(
        path,
        "'radiance_w_m2_sr_nm' must be given, or 'luminance_cd_m2' or 'illuminance_lux' instead",
        ParameterError,
        unit="1",
    )
    assert_rejected(path, "'illuminant' 'D65' must be from 380 to 780.*850.*; select range_nm=", ParameterError, **lit)
    assert_rejected(path, "did you mean 'D65'", ParameterError, **lit, illuminant="d65")
    for table, match in (
        ({"wavelength_nm": [400.0, 800.0], "value": [1.0, 1.0]}, "must be tabulated from 450 to 850"),
        ({"wavelength_nm": [400.0, 900.0], "value": [1.0]}, "one value for each, got 1"),
        ({"wavelength_nm": [400.0, 900.0]}, "must have the keys 'wavelength_nm' and 'value'"),
    ):
        assert_rejected(path, match, ParameterError, **lit, illuminant=table)


def test_reflectance_above_one_warns(tmp_path):
    path = write_envi(tmp_path / "cube.hdr", code="h", number=2)
    lit = {"quantity": "reflectance", "distance_m": 1.0, "radiance_w_m2_sr_nm": 0.3}

    with pytest.warns(FoveasimWarning, match=r"the reflectance of the cube is up to 59, above 1; pass scale="):
        Scene.from_cube(path, **lit)
    with pytest.raises(FoveasimWarning, match="the reflectance"):  # warnings as errors
        Scene.from_cube(path, **lit)
    Scene.from_cube(path, **lit, scale=1 / 59.0)  # no warning


# -- other formats ----------------------------------------------------------------------------------------------------


def write_exr(path, values=VALUES, names=("S0.450,000000nm", "S0.550,000000nm", "S0.650,000000nm"), **header):
    channels = {name: np.array(image, np.float32) for name, image in zip(names, values, strict=True)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def test_spectral_exr_is_read_by_layer(tmp_path):
    names = ["S0.550,000000nm", "T.4,5e2nm", "S0.450,000000nm", "T.0.65um", "S1.450nm", "R"]
    values = np.concatenate([VALUES, VALUES / 100.0])
    path = write_exr(tmp_path / "cube.exr", values, names, emissiveUnits="W.m^-2.sr^-1.nm^-1")

    emitted = Scene.from_cube(path, distance_m=1.0, name="S0")
    reflected = Scene.from_cube(path, distance_m=1.0, name="T", radiance_w_m2_sr_nm=1.0, illuminant="E", scale=0.01)

    np.testing.assert_array_equal(radiance(emitted), VALUES[[2, 0]])
    np.testing.assert_allclose(radiance(reflected), values[[1, 3]].astype(np.float32).astype(float) * 0.01, rtol=1e-12)
    np.testing.assert_allclose(reflected.wavelength_nm, [450.0, 650.0], rtol=1e-12)
    assert_rejected(path, "contains several layers; select one with name=, possible: 'S0', 'T'")
    assert_rejected(path, "has no layer 'S3'; select one with name=", name="S3")


def test_bad_exr_gives_one_line(tmp_path):
    colours = write_exr(tmp_path / "colours.exr", VALUES, "RGB")
    assert_rejected(
        colours, "does not contain channels with wavelengths, got B, G, R; read colours with Scene.from_picture"
    )
    heat = write_exr(tmp_path / "heat.exr", VALUES, ["S0.1THz", "S0.2THz", "S0.3THz"])
    assert_rejected(heat, r"got S0\.1THz, S0\.2THz, S0\.3THz; expected names such as 'S0\.550,0nm'")
    fluorescent = write_exr(tmp_path / "f.exr", VALUES, ["T.400nm", "T.500nm", "T.400nm.500nm"])
    assert_rejected(fluorescent, "contains fluorescence, channel 'T.400nm.500nm'")
    paper = write_exr(tmp_path / "paper.exr", emissiveUnits="W.m^-2.sr^-1")
    assert_rejected(paper, r"has the unit 'W\.m\^-2\.sr\^-1', which is not per nm; pass unit=", unit=None)


def test_truncated_exr_gives_one_line(tmp_path, monkeypatch):
    monkeypatch.undo()  # in the sandbox process
    path = write_exr(tmp_path / "cube.exr")
    np.testing.assert_array_equal(radiance(Scene.from_cube(path, **RADIANCE)), VALUES)
    with pytest.raises(ParameterError, match=r"'rows' must be \(start, stop\) with 0 <= start < stop <= 4"):
        Scene.from_cube(path, **RADIANCE, rows=(2, 9))
    path.write_bytes(path.read_bytes()[:-20])

    assert_rejected(path, "is corrupt or truncated")


def labelled(**changes):
    """Return a labelled cube in SI units, with y upwards and another order of dimensions."""
    coords = {
        "wavelength": ("wavelength", np.array(WAVES) * 1e-9, {"units": "m"}),
        "y": ("y", np.arange(4) * 0.01, {"units": "m"}),
        "x": ("x", np.arange(5) * 0.01, {"units": "m"}),
    }
    array = xr.DataArray(
        VALUES[:, ::-1], dims=("wavelength", "y", "x"), coords=coords, attrs={"units": "W m-2 sr-1 um-1"}
    )
    return array.transpose("y", "x", "wavelength").assign_attrs(**changes)


@pytest.mark.parametrize("kind", ["nc", "nc3", "zarr"])
@pytest.mark.filterwarnings("ignore:Consolidated metadata")
def test_labelled_cubes_are_read(tmp_path, kind):
    path = tmp_path / f"cube.{kind}"
    dataset = labelled().to_dataset(name="radiance").assign(mask=(("y", "x"), np.ones((4, 5))))
    {
        "nc": lambda: dataset.to_netcdf(path, engine="h5netcdf"),
        "nc3": lambda: dataset.to_netcdf(path, engine="scipy"),
        "zarr": lambda: dataset.to_zarr(path, zarr_format=2),
    }[kind]()

    scene = Scene.from_cube(path, distance_m=2.0)
    part = Scene.from_cube(path, distance_m=2.0, rows=(0, 2), columns=(3, 5), range_nm=(500, 700), fit="width")

    np.testing.assert_allclose(radiance(scene), VALUES * 1e-3, rtol=1e-12)
    np.testing.assert_allclose(scene.wavelength_nm, WAVES, rtol=1e-12)
    assert scene.pitch_um == pytest.approx(1e4)
    assert (part.fit, part.pitch_um) == ("width", None)
    np.testing.assert_allclose(radiance(part), VALUES[1:, :2, 3:] * 1e-3, rtol=1e-12)
    assert_rejected(path, "has no variable 'radianc'; did you mean 'radiance'", name="radianc")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda a: a.drop_vars("wavelength"), "does not specify the wavelengths of its bands"),
        (lambda a: a.rename(wavelength="time").drop_vars("time"), r"does not specify the wavelengths"),
        (lambda a: a.rename(x="longitude"), r"has the dimensions \(y, longitude, wavelength\), expected"),
        (
            lambda a: a.assign_coords(wavelength=("wavelength", [1.0, 2.0, 3.0], {"units": "eV"})),
            "in the unknown unit 'eV'",
        ),
        (lambda a: a.assign_coords(y=("y", [0, 1, 2, 4], {"units": "m"})), "has non-uniform steps along y"),
        (
            lambda a: a.assign_coords(y=("y", [0, 1, 2, 3], {"units": "m"})),
            "has pixels of 10000 x 1e.06 µm, expected squares",
        ),
        (lambda a: a.where(a != 7.0), r"got nan at \[band, row, column\]"),
        (lambda a: a.isel(x=0), "contains 0 numeric arrays with rows, columns and bands"),
    ],
)
def test_bad_labelled_cubes_give_one_line(tmp_path, change, match):
    change(labelled()).to_dataset(name="cube").to_netcdf(tmp_path / "cube.nc", engine="h5netcdf")

    assert_rejected(tmp_path / "cube.nc", match)


SAVERS = {
    "v7": lambda path, tree: scipy.io.savemat(path, tree, do_compression=True),
    "v6": scipy.io.savemat,
    "v7.3": write_mat73,
}


@pytest.mark.parametrize("save", SAVERS.values(), ids=SAVERS)
def test_matlab_cubes_are_read(tmp_path, save):
    path = tmp_path / "cube.mat"
    by_row = np.moveaxis(VALUES, 0, 2)  # row, column, band
    save(path, {"rad": by_row, "bands": np.array(WAVES), "rgb": np.ones((4, 5)), "units": "uW/(cm^2 sr nm)"})
    save(tmp_path / "two.mat", {"a": by_row, "b": 2.0 * by_row.astype(np.int16)})
    save(tmp_path / "first.mat", {"cube": VALUES, "wave": np.array(WAVES)})

    np.testing.assert_allclose(radiance(Scene.from_cube(path, distance_m=1.0)), VALUES * 0.01, rtol=1e-12)
    second = Scene.from_cube(tmp_path / "two.mat", **RADIANCE, name="b", wavelength_nm=WAVES)
    np.testing.assert_array_equal(radiance(second), 2.0 * VALUES)
    np.testing.assert_array_equal(radiance(Scene.from_cube(tmp_path / "first.mat", **RADIANCE)), VALUES)
    assert_rejected(tmp_path / "two.mat", "contains 2 arrays of rows, columns and bands: a, b; select one with name=")
    assert_rejected(path, "has no array 'rat'; did you mean 'rad'", name="rat")
    assert_rejected(tmp_path / "two.mat", "does not specify the wavelengths", name="a")


@pytest.mark.parametrize("save", SAVERS.values(), ids=SAVERS)
def test_isetcam_scene_yields_absolute_radiance(tmp_path, save):
    photon_j = scipy.constants.h * scipy.constants.c / (np.array(WAVES) * 1e-9)
    photons = np.moveaxis(VALUES, 0, 2) / photon_j
    tree = {
        "data": {"photons": photons},
        "spectrum": {"wave": np.reshape(WAVES, (-1, 1))},
        "wAngular": 10.0,
        "distance": 2.0,
    }
    save(tmp_path / "scene.mat", {"scene": {"type": "scene", **tree}})
    save(tmp_path / "fields.mat", tree)

    for name in ("scene.mat", "fields.mat"):
        scene = Scene.from_cube(tmp_path / name)
        np.testing.assert_allclose(radiance(scene), VALUES, rtol=1e-9)
        assert scene.distance_m == 2.0
        # 5 columns at 2 m over 10 degrees: 2 · 2 m · tan(5°) / 5 = 69.991 mm.
        assert scene.pitch_um == pytest.approx(69_990.9, rel=1e-6)
    part = Scene.from_cube(tmp_path / "scene.mat", columns=(1, 3))
    assert part.pitch_um == pytest.approx(69_990.9, rel=1e-6)
    assert Scene.from_cube(tmp_path / "scene.mat", distance_m=4.0, fit="contain").fit == "contain"


# -- a camera, settings and extensions --------------------------------------------------------------------------------


def ramp(path, n=41):
    """Write a cube of uniform radiance that rises linearly from 0 at 400 nm to 0.04 W/(m² sr nm) at 800 nm."""
    waves = np.linspace(400.0, 800.0, n)
    values = np.broadcast_to((1e-4 * (waves - 400.0))[:, None, None], (n, 32, 32))
    write_envi(
        path, values, code="d", number=5, wavelength="{" + ",".join(map(repr, waves.tolist())) + "}", data_units=PER_NM
    )
    return waves


@pytest.mark.parametrize("resample_nm", [None, [500.0, 550.0, 600.0]])
def test_camera_counts_electrons_of_spectrum(tmp_path, resample_nm):
    ramp(tmp_path / "cube.hdr")
    layout = fs.layout.grid(n_x=3, n_y=3, pitch_um=50.0)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=fs.Sensor(layout, qe=0.5))
    scene = Scene.from_cube(
        tmp_path / "cube.hdr", distance_m=1.0, range_nm=(500, 600), resample_nm=resample_nm, pitch_um=2000.0
    )

    expected_e = camera.capture(scene, exposure_s=0.01, seed=0).expected_e

    # Thin lens at 1 m: working f-number N = 4 (1 + m), m = f / (1 m - f); irradiance pi L / (1 + 4 N²).
    n = 4.0 * (1.0 + 0.008 / (1.0 - 0.008))
    waves, width = (np.linspace(500, 600, 11), 10.0) if resample_nm is None else (np.array(resample_nm), 50.0)
    photons = 1e-4 * (waves - 400.0) * width * waves * 1e-9 / (scipy.constants.h * scipy.constants.c)
    electrons = 0.5 * math.pi / (1.0 + 4.0 * n**2) * photons.sum() * 2500e-12 * 0.01
    # Relative illumination decreases by 2e-5 over 25 µm at a focal length of 8 mm.
    np.testing.assert_allclose(expected_e[4], electrons, rtol=5e-5)


SHOT = """
scene:
  kind: cube
  path: data/cube.hdr
  distance_m: 1.0
  pitch_um: 2000.0
  range_nm: [500, 600]
  rows: [4, 30]
optics: {{focal_length_mm: 8.0, f_number: 4.0}}
layout: {{generator: grid, parameters: {{n_x: 3, n_y: 3, pitch_um: 5.0}}}}
exposure_s: 0.01
{more}
"""


def test_settings_file_contains_cube(tmp_path):
    (tmp_path / "data").mkdir()
    ramp(tmp_path / "data" / "cube.hdr")
    (tmp_path / "shot.yaml").write_text(SHOT.format(more=""))

    shot = read_shot(tmp_path / "shot.yaml")

    direct = Scene.from_cube(
        tmp_path / "data" / "cube.hdr", distance_m=1.0, pitch_um=2000.0, range_nm=(500, 600), rows=(4, 30)
    )
    assert shot.scene.basis.shape == direct.basis.shape == (11, 26, 32)
    np.testing.assert_array_equal(radiance(shot.scene), radiance(direct))
    table = "scene.illuminant={wavelength_nm: [400, 800], value: [1, 1]}"
    lit = read_shot(
        tmp_path / "shot.yaml",
        [table, "scene.unit='1'", "scene.radiance_w_m2_sr_nm=0.1", "scene.resample_nm=[550]", "scene.band_width_nm=10"],
    )
    np.testing.assert_allclose(radiance(lit.scene), 1e-4 * 150.0 * 0.1, rtol=1e-12)
    cube = next(each for key, each in schema()["$defs"].items() if key == "cube_kind" or each["title"] == "cube kind")
    assert {"path", "illuminant", "resample_nm", "rows", "kind"} <= set(cube["properties"])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ("scene.rows=[4, 90]", r"--set scene\.rows: must be \(start, stop\) with 0 <= start < stop <= 32"),
        ("scene.quantity=radience", "did you mean 'radiance'"),
        ("scene.path=data/cub.hdr", r"cub\.hdr: no such file"),
        ("scene.bands=[0.5]", "scene.bands"),
    ],
)
def test_wrong_setting_gives_key_path(tmp_path, change, match, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    ramp(tmp_path / "data" / "cube.hdr", n=11)
    (tmp_path / "shot.yaml").write_text(SHOT.format(more=""))

    with pytest.raises(ConfigError, match=match) as caught:
        read_shot(tmp_path / "shot.yaml", [change])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("save", [scipy.io.savemat, write_mat73], ids=["v5", "v7.3"])
def test_matlab_structs_contain_cubes(tmp_path, save):
    cube = np.moveaxis(VALUES, 0, 2)
    inner = {"cube": cube, "wavelengths": np.array(WAVES), "unit": PER_NM}
    path = tmp_path / "cube.mat"
    save(path, {"data": {"part": inner, "other": np.ones((2, 2))}, "lines": np.arange(3.0), "wave": np.arange(3.0)})
    for name in ("data.part.cube", "data/part/cube"):
        scene = Scene.from_cube(path, name=name, distance_m=1.0)
        np.testing.assert_array_equal(radiance(scene), VALUES)
        assert scene.wavelength_nm.tolist() == WAVES
    assert_rejected(path, "has no array 'data.part.cub'; did you mean 'data.part.cube'", name="data.part.cub")
    assert_rejected(path, "has no array 'data.none.cube'", name="data.none.cube")
    assert_rejected(path, r"select the field of a struct with name=, such as 'data\.(part|other)'")
    save(path, {"data": {**inner, "scale": 2.0}})
    assert_rejected(path, "has the number 'data/scale', which may change the values", name="data.cube")


# -- attributes and tags that change the values -----------------------------------------------------------------------


def test_packed_netcdf_values_are_scaled(tmp_path):
    """CF conventions, section 8.1: scale factor, offset, fill value and range of packed values."""
    array = labelled()
    encoding = {"dtype": "int16", "scale_factor": 0.5, "add_offset": 10.0, "_FillValue": -999}
    array.to_dataset(name="cube").to_netcdf(tmp_path / "cube.nc", engine="h5netcdf", encoding={"cube": encoding})
    np.testing.assert_allclose(radiance(Scene.from_cube(tmp_path / "cube.nc", **RADIANCE)), VALUES, atol=0.26)

    array.attrs["valid_range"] = np.array([-20, 60], np.int16)  # from 0 to 40 after unpacking
    array.to_dataset(name="cube").to_netcdf(tmp_path / "cube.nc", engine="h5netcdf", encoding={"cube": encoding})
    assert_rejected(tmp_path / "cube.nc", r"got nan at \[band, row, column\] = \[2, 0, 1\], 19 such values")
    scene = Scene.from_cube(tmp_path / "cube.nc", invalid="zero", **RADIANCE)
    assert radiance(scene).max() == 40.0


@pytest.mark.parametrize("name", ["radiometric_gain", "Slope", "calibration_offset", "nodata_value"])
def test_unknown_attributes_of_arrays_are_reported(tmp_path, name):
    array = labelled()
    array.attrs[name] = 2.0
    array.to_dataset(name="cube").to_netcdf(tmp_path / "cube.nc", engine="h5netcdf")
    assert_rejected(tmp_path / "cube.nc", f"has the attribute '{name}', which may change the values", unit=None)
    array.attrs.pop(name)
    array.attrs |= {"history": "written", "comment": "a field", "wavelength_units": "nm"}
    assert Scene.from_cube(array, distance_m=1.0).basis.shape == VALUES.shape


@pytest.mark.parametrize(
    ("attributes", "match"),
    [
        ({"exposureCompensation": 1.5}, "has the attribute 'exposureCompensation', which may change the values"),
        ({"cameraResponse": "1nm:2"}, "has the attribute 'cameraResponse', which may change the values"),
        ({"pixelAspectRatio": 2.0}, "has pixels with the pixelAspectRatio 2, expected squares"),
    ],
)
def test_exr_attributes_that_change_values_are_reported(tmp_path, attributes, match):
    channels = {f"S0.{wave_nm:g}nm": band.astype(np.float32) for wave_nm, band in zip(WAVES, VALUES, strict=True)}
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage, "expTime": 0.1, "owner": "someone"}
    for more, is_good in (({}, True), (attributes, False)):
        with OpenEXR.File({**header, **more}, dict(channels)) as file:
            file.write(str(tmp_path / "cube.exr"))
        if is_good:
            np.testing.assert_array_equal(radiance(Scene.from_cube(tmp_path / "cube.exr", **RADIANCE)), VALUES)
        else:
            assert_rejected(tmp_path / "cube.exr", match)


def write_tiff(path, **options):
    tifffile.imwrite(path, VALUES.astype(np.float32), **{"photometric": "minisblack", **options})
    return path


def test_tiff_tags_decide_rows_and_missing_pixels(tmp_path):
    options = {**RADIANCE, "wavelength_nm": WAVES}
    path = write_tiff(tmp_path / "cube.tif", extratags=[(274, "H", 1, 4)])
    np.testing.assert_array_equal(radiance(Scene.from_cube(path, **options)), VALUES[:, ::-1])
    path = write_tiff(tmp_path / "cube.tif", extratags=[(42113, "s", 0, "7")])
    assert_rejected(path, r"got 7 at \[band, row, column\] = \[0, 1, 2\], 1 such values", wavelength_nm=WAVES)
    for tag, match in (
        ((42113, "s", 0, "none"), "has the tag GDAL_NODATA = 'none', expected a number"),
        (
            (42112, "s", 0, '<GDALMetadata><Item name="SCALE" role="scale">0.1</Item></GDALMetadata>'),
            "has the scale 0.1 in GDAL",
        ),
        ((34675, "B", 4, b"icc!"), r"has a colour profile .* \(InterColorProfile\), the tag 34675"),
        ((301, "H", 6, tuple(range(6))), r"has a transfer function \(TransferFunction\), the tag 301"),
        ((274, "H", 1, 6), "has the unsupported orientation 6"),
    ):
        assert_rejected(write_tiff(tmp_path / "cube.tif", extratags=[tag]), match, wavelength_nm=WAVES)
    assert_rejected(
        write_tiff(tmp_path / "cube.tif", photometric="miniswhite"), "unsupported photometric", wavelength_nm=WAVES
    )


# -- folders of pictures ----------------------------------------------------------------------------------------------


def write_bands(path, names, values=VALUES):
    path.mkdir(exist_ok=True)
    for name, band in zip(names, values, strict=True):
        write_band(path / name, band)
    return path


def write_band(path, band):
    if path.suffix == ".tif":
        tifffile.imwrite(path, band.astype(np.uint16), photometric="minisblack")
    else:
        Image.fromarray(band.astype(np.uint16)).save(path)


def test_folder_of_pictures_is_a_cube(tmp_path):
    """The layout of CAVE: 16-bit PNG per band, numbered from 1, beside a colour picture."""
    values = 1000.0 * np.concatenate([VALUES] * 4)
    path = write_bands(tmp_path / "balloons", [f"balloons_ms_{k}.png" for k in range(1, 13)], values)
    (path / "balloons_RGB.bmp").write_bytes(b"BM")
    waves_nm = [400.0 + 10.0 * k for k in range(12)]
    lit = {
        "distance_m": 1.0,
        "quantity": "reflectance",
        "illuminant": "E",
        "radiance_w_m2_sr_nm": 0.5,
        "scale": 1.0 / 65535,
    }
    scene = Scene.from_cube(path, wavelength_nm=waves_nm, **lit)

    np.testing.assert_allclose(radiance(scene), 0.5 * values / 65535, rtol=1e-6)
    assert scene.wavelength_nm.tolist() == waves_nm
    assert_rejected(path, r"does not specify the wavelengths of its bands; pass wavelength_nm=\.\.\., 12 values in nm")


def test_names_of_pictures_contain_wavelengths(tmp_path):
    path = write_bands(tmp_path / "field", ["a_1_650nm.tif", "a_2_450 nm.tif", "a_3_550.5nm.tif"])
    scene = Scene.from_cube(path, **RADIANCE)
    assert scene.wavelength_nm.tolist() == [450.0, 550.5, 650.0]
    np.testing.assert_array_equal(radiance(scene), VALUES[[1, 2, 0]])
    assert Scene.from_cube(path, name="a_[23]*", **RADIANCE).wavelength_nm.tolist() == [450.0, 550.5]


def with_chunk(path, name, data):
    """Insert a chunk after the header of a PNG file."""
    content = path.read_bytes()
    chunk = struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    path.write_bytes(content[:33] + chunk + content[33:])


def test_wrong_folders_give_one_line(tmp_path):
    path, options = write_bands(tmp_path / "f", ["1.png", "2.png", "3.png"]), {"wavelength_nm": WAVES}
    Image.new("RGB", (5, 4)).save(path / "4.png")
    assert_rejected(path, "has a picture '4.png' of 3 channels, expected one number per pixel; select grey", **options)
    (path / "4.png").unlink()
    with_chunk(path / "2.png", b"gAMA", struct.pack(">I", 45455))
    assert_rejected(
        path, r"has a picture '2.png' with a transfer function \(the chunk gAMA\), which changes", **options
    )
    write_bands(path, ["2.png"], VALUES[1:2, :2])
    assert_rejected(path, "contains bands of different kinds: '1.png' has .*, '2.png' ", **options)
    (path / "2.png").write_bytes((path / "1.png").read_bytes()[:-20])
    assert_rejected(path, "has a picture '2.png' that is corrupt or truncated", **options)
    write_band(path / "2.tif", VALUES[1])
    assert_rejected(path, r"contains pictures of several kinds, \.png, \.tif; select some with name=", **options)
    assert_rejected(path, r"contains no PNG or TIFF pictures with names like '\*\.bmp'", name="*.bmp")


def test_every_format_has_an_entry():
    assert set(CUBE_FORMATS) >= {"envi", "exr", "folder", "netcdf", "zarr", "mat73", "mat"}
    assert set(_envi.TYPES) == {1, 2, 3, 4, 5, 12, 13, 14, 15}


# -- malformed files --------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:the reflectance of the cube")
def test_corrupt_envi_headers_are_handled(tmp_path):
    """Truncated headers, and headers with changed characters: each yields a scene or an error of one line."""
    path = write_envi(tmp_path / "cube.hdr", bbl="{1, 1, 1}", data_gain_values="{1, 1, 1}", data_ignore_value=-1)
    text, rng = path.read_bytes(), np.random.default_rng(5)
    contents = [text[: len(text) * i // 60] for i in range(1, 60)]
    for i in range(300):
        corrupt = bytearray(text)
        for at in rng.integers(4, len(text), 1 + i % 4):
            corrupt[at] = rng.choice(list(b"0123456789{}=,-\n e\xff\x00"))
        contents.append(bytes(corrupt))

    answers = []
    for content in contents:
        path.write_bytes(content)
        try:
            answers.append(type(Scene.from_cube(path, **RADIANCE, quantity="radiance")).__name__)
        except (FileError, ParameterError) as error:
            answers.append(str(error))

    assert not [answer for answer in answers if "\n" in answer]
    assert not [answer for answer in answers if "is corrupt or not a valid" in answer]  # exceptions of libraries
    assert 20 < answers.count("Scene") < 340


def huge_hdf5(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("cube", (2**10, 2**14, 2**14), "f4", chunks=(1, 1024, 1024), compression="gzip")


def external_hdf5(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("cube", (2, 2, 2), "u1", external="/etc/passwd")


def huge_mat(path):
    scipy.io.savemat(path, {"cube": np.zeros((2, 3, 4))})
    sizes = struct.pack("<iii", 2, 3, 4)
    content = path.read_bytes()
    assert content.count(sizes) == 1
    path.write_bytes(content.replace(sizes, struct.pack("<iii", 2**10, 2**14, 2**14)))


@pytest.mark.parametrize(
    ("write", "match"),
    [
        (huge_hdf5, "contains an array of 1024 x 16384 x 16384 elements, more than the limit"),
        (external_hdf5, "stores its data in another file, which is not opened"),
        (huge_mat, "contains an array of 1024 x 16384 x 16384 elements, more than the limit"),
    ],
)
def test_malformed_files_give_one_line(tmp_path, write, match):
    write(tmp_path / "cube")

    assert_rejected(tmp_path / "cube", match)


def test_missing_library_names_extra(tmp_path, monkeypatch):
    labelled().to_dataset(name="cube").to_netcdf(tmp_path / "cube.nc", engine="h5netcdf")
    monkeypatch.setitem(sys.modules, "xarray", None)

    assert_rejected(tmp_path / "cube.nc", r"needs xarray; install it with: pip install 'foveasim\[maps\]'")
