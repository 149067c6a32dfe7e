"""Power maps as files: lossless round trips, files of other programs in their units, errors for malformed files."""

from __future__ import annotations

import importlib
import io
import json
import os
import struct
import subprocess
import sys
import threading
import zipfile
import zlib

import numpy as np
import pytest
import scipy.constants
from lazy_modules import LazyModule

import foveasim as fs
from foveasim import maps
from foveasim._io import sandbox
from foveasim._io.rasters.mat import write_mat73
from foveasim._io.rasters.units import length_in_um
from foveasim.errors import FileError, ParameterError
from foveasim.maps import _dataset, from_xarray, read_power_map, to_xarray, write_power_map
from foveasim.maps._formats import MAP_FORMATS, read_found
from foveasim.maps._units import irradiance_unit

h5py, xr, zarr, fits, OpenEXR, tifffile = map(
    LazyModule, ("h5py", "xarray", "zarr", "astropy.io.fits", "OpenEXR", "tifffile")
)

EXTENSIONS = ("npz", "fits", "tif", "exr", "nc", "zarr")
#: Letter without symmetry, top row first and bottom row first.
F = np.array([[1, 1, 1, 0], [1, 0, 0, 0], [1, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 2]], np.float32)
UPRIGHT = F[::-1]
METADATA = {"pitch_um": 0.5, "wavelength_nm": 550.0, "unit": "w_m2"}
#: Photon energy at 550 nm, J.
GREEN_J = scipy.constants.h * scipy.constants.c / 550e-9


def random_map(dtype=np.float32, n_band=3):
    """Return a map of values that are not short decimals."""
    rng = np.random.default_rng(7)
    grid = fs.Grid((5, 7), 7.0 / 30.0, (-1.234567890123456e-5, np.pi))
    return fs.PowerMap(rng.random((n_band, 5, 7)).astype(dtype), grid, rng.random(n_band).cumsum() * 100 + 400.1)


def read_in_process(path, kind, name):
    return MAP_FORMATS[kind].read(path, name)


@pytest.fixture(autouse=True)
def in_process(monkeypatch):
    """Read all formats in this process: starting a sandbox process takes about a second per file."""
    monkeypatch.setattr(maps, "read_found", read_in_process)


@pytest.fixture
def in_sandbox(monkeypatch):
    """Read in the sandbox process, as users do."""
    monkeypatch.setattr(maps, "read_found", read_found)


def letter_map():
    return fs.PowerMap.from_array(F, pitch_um=0.5, wavelength_nm=550.0, top_row_first=True)


def assert_same(read, power_map):
    np.testing.assert_array_equal(read.data, power_map.data, strict=True)
    assert read.grid == power_map.grid
    assert read.wavelength_nm.tolist() == power_map.wavelength_nm.tolist()


def save_array(tmp_path, array, name="map.npy"):
    np.save(tmp_path / name, array)
    return tmp_path / name


def assert_rejected(path, match, error=FileError, **metadata):
    with pytest.raises(error, match=match) as caught:
        read_power_map(path, **metadata)
    assert "\n" not in str(caught.value)
    if error is FileError:
        assert str(caught.value).startswith(f"{path}: ")
    return caught.value


# -- plain arrays -----------------------------------------------------------------------------------------------------


def test_plain_array_becomes_centred_band():
    spot = fs.PowerMap.from_array(F, pitch_um=0.5, wavelength_nm=550)

    assert spot.data.shape == (1, 5, 4)
    assert np.array_equal(spot.data[0], F)
    assert spot.grid == fs.Grid((5, 4), 0.5, (-1.0, -1.25))
    assert np.array_equal(letter_map().data[0], UPRIGHT)


def test_read_only_bands_are_shared_with_map():
    data = np.ones((2, 3, 4), np.float32)
    data.flags.writeable = False

    bands = fs.PowerMap.from_array(data, pitch_um=1.0, wavelength_nm=[450.0, 550.0], origin_um=(1.0, 2.0))

    assert np.shares_memory(bands.data, data)
    assert bands.grid.origin_um == (1.0, 2.0)


@pytest.mark.parametrize(
    ("data", "metadata", "message"),
    [
        (np.ones(3), {}, r"'data' must have the shape \(n_y, n_x\) or \(n_band, n_y, n_x\), got \(3,\)"),
        (np.ones((1, 1, 3, 3)), {}, r"'data' must have the shape"),
        (np.ones((0, 3)), {}, r"'data' must have the shape"),
        ([[1.0], [1.0, 2.0]], {}, r"'data' must be an array of numbers"),
        (np.ones((3, 3), complex), {}, r"'data' must have real numbers"),
        (np.ones((3, 3)), {"pitch_um": 0.0}, r"'pitch_um' must be > 0"),
        (np.ones((2, 3, 3)), {}, r"'data' must have the shape \(n_band, n_y, n_x\) = \(1, 3, 3\)"),
        (np.ones((3, 3)), {"wavelength_nm": "green"}, r"'wavelength_nm' must be an array of numbers"),
    ],
)
def test_from_array_rejects_invalid_arrays(data, metadata, message):
    with pytest.raises(ParameterError, match=message):
        fs.PowerMap.from_array(data, **{"pitch_um": 1.0, "wavelength_nm": 550.0, **metadata})


# -- round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.usefixtures("in_sandbox")
def test_files_round_trip_bit_identically(tmp_path, extension, dtype):
    power_map, path = random_map(dtype), tmp_path / f"map.{extension}"
    if (extension, dtype) == ("exr", np.float64):
        with pytest.raises(ParameterError, match="must be float32 for EXR"):
            write_power_map(power_map, path)
    else:
        write_power_map(power_map, path)
        assert_same(read_power_map(path), power_map)
    assert [p.name for p in tmp_path.iterdir()] == ([path.name] if path.exists() else [])


@pytest.mark.parametrize("extension", [e for e in EXTENSIONS if e not in ("nc", "zarr")])
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 5), (1, 6, 1), (4, 1, 1), (3, 4, 3)])
def test_files_round_trip_small_maps(tmp_path, extension, shape):
    power_map = fs.PowerMap(
        np.arange(np.prod(shape), dtype=np.float32).reshape(shape),
        fs.Grid(shape[1:], 0.1),
        400.0 + 0.1 * np.arange(shape[0]),
    )
    fs.write_power_map(power_map, tmp_path / f"map.{extension}")

    assert_same(fs.read_power_map(tmp_path / f"map.{extension}"), power_map)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 5), (4, 6, 1)])
def test_labelled_arrays_round_trip_small_maps(shape):
    power_map = fs.PowerMap(np.ones(shape), fs.Grid(shape[1:], 0.1, (3.0, 4.0)), 400.0 + 0.1 * np.arange(shape[0]))

    assert_same(from_xarray(to_xarray(power_map)), power_map)


@pytest.mark.slow
def test_existing_map_is_overwritten(tmp_path):
    for extension in EXTENSIONS:
        for power_map in (letter_map(), random_map()):
            write_power_map(power_map, tmp_path / f"map.{extension}")
    assert_same(read_power_map(tmp_path / "map.zarr"), random_map())
    assert_same(read_power_map(tmp_path / "map.fits"), random_map())


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_failed_write_leaves_no_file(tmp_path, extension, monkeypatch):
    def full(*_args, **_options):
        raise OSError(28, "No space left on device")

    with pytest.raises(FileError, match=r"the directory .* does not exist"):
        write_power_map(letter_map(), tmp_path / "nowhere" / f"map.{extension}")
    monkeypatch.setattr(_dataset, "to_xarray", full)
    monkeypatch.setattr("foveasim.maps._npy.np.savez", full)
    monkeypatch.setattr("tifffile.TiffWriter", full)
    monkeypatch.setattr("astropy.io.fits.PrimaryHDU", full)
    monkeypatch.setattr("OpenEXR.File", full)
    path = tmp_path / f"map.{extension}"
    with pytest.raises(FileError, match="No space left"):
        write_power_map(letter_map(), path)
    assert list(tmp_path.iterdir()) == []


def test_zarr_does_not_replace_other_directories(tmp_path):
    (tmp_path / "map.zarr").mkdir()
    (tmp_path / "map.zarr" / "thesis.txt").write_text("years of work")

    with pytest.raises(FileError, match="the path contains other data"):
        write_power_map(letter_map(), tmp_path / "map.zarr")

    assert (tmp_path / "map.zarr" / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize(("name", "match"), [("map.jpg", r"must end in one of \.exr, "), ("map", r"must end in")])
def test_write_rejects_unknown_extension(tmp_path, name, match):
    with pytest.raises(FileError, match=match):
        write_power_map(letter_map(), tmp_path / name)
    with pytest.raises(ParameterError, match="'power_map' must be a PowerMap"):
        write_power_map(F, tmp_path / "map.npz")


MISSING = {"fits": "astropy", "exr": "OpenEXR", "nc": "h5netcdf", "zarr": "zarr"}


@pytest.mark.parametrize(("extension", "library"), MISSING.items())
def test_missing_library_error_names_install_command(tmp_path, monkeypatch, extension, library):
    write_power_map(letter_map(), tmp_path / f"there.{extension}")
    monkeypatch.setitem(sys.modules, library, None)
    for name in [n for n in sys.modules if n.startswith(f"{library}.")]:
        monkeypatch.setitem(sys.modules, name, None)

    with pytest.raises(FileError, match=rf"map\.{extension}: needs {library}.*pip install 'foveasim\[maps\]'"):
        write_power_map(letter_map(), tmp_path / f"map.{extension}")
    if extension == "fits":
        assert_rejected(tmp_path / f"there.{extension}", r"needs .*pip install 'foveasim\[maps\]'")


def test_missing_xarray_error_names_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)

    with pytest.raises(ParameterError, match=r"pip install 'foveasim\[maps\]'"):
        to_xarray(letter_map())


# -- orientation --------------------------------------------------------------------------------------------------------


def tiff_letter(path):
    tifffile.imwrite(path, F)


def tiff_letter_bottom_row_first(path):
    tifffile.imwrite(path, F[::-1], extratags=[(274, "H", 1, 4, True)])


def fits_letter(path):
    fits.writeto(path, UPRIGHT)


def fits_letter_descending(path):
    header = fits.Header({"CUNIT1": "um", "CUNIT2": "um", "CDELT1": -0.5, "CDELT2": -0.5})
    fits.writeto(path, F[:, ::-1], header)


def exr_letter(path):
    with OpenEXR.File({"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}, {"550nm": F}) as file:
        file.write(str(path))


def npy_letter(path):
    with path.open("wb") as file:
        np.save(file, UPRIGHT)


def netcdf_letter(path):
    rows = xr.DataArray(F, dims=("row", "col"), coords={"row": np.arange(5.0)[::-1], "col": np.arange(4.0)})
    rows.to_dataset(name="light").to_netcdf(path, engine="h5netcdf")


def netcdf3_letter(path):
    rows = xr.DataArray(UPRIGHT, dims=("y", "x"), coords={"y": np.arange(5.0), "x": np.arange(4.0)})
    rows.to_dataset(name="light").to_netcdf(path, engine="scipy")


def zarr_letter(path):
    rows = xr.DataArray(F.T, dims=("x", "y"), coords={"y": -np.arange(5.0), "x": np.arange(4.0)})
    rows.to_dataset(name="light").to_zarr(path, zarr_format=2)


def mat_letter(path):
    scipy.io.savemat(path, {"oi": {"data": {"photons": F[:, :, np.newaxis]}, "spectrum": {"wave": 550.0}}})


LETTERS = [
    tiff_letter,
    tiff_letter_bottom_row_first,
    fits_letter,
    fits_letter_descending,
    exr_letter,
    npy_letter,
    netcdf_letter,
    netcdf3_letter,
    zarr_letter,
    mat_letter,
]


@pytest.mark.parametrize("make", LETTERS)
@pytest.mark.filterwarnings("ignore:Consolidated metadata")
def test_read_letter_is_upright(tmp_path, make):
    make(tmp_path / "map")

    read = read_power_map(tmp_path / "map", **METADATA)

    assert np.array_equal(read.data[0], UPRIGHT)
    assert read.grid == fs.Grid.centred((5, 4), 0.5)


@pytest.mark.parametrize("extension", [e for e in EXTENSIONS if e != "zarr"])
def test_written_letter_is_upright_in_other_readers(tmp_path, extension):
    path = tmp_path / f"map.{extension}"
    write_power_map(letter_map(), path)
    others = {
        "npz": lambda: np.load(path)["data"][0],
        "fits": lambda: fits.getdata(path)[0],
        "tif": lambda: tifffile.imread(path)[::-1],
        "exr": lambda: OpenEXR.File(str(path)).channels()["S0.550,0nm"].pixels[::-1],
        "nc": lambda: xr.load_dataset(path, engine="h5netcdf")["irradiance"].sortby("y").to_numpy()[0],
    }

    assert np.array_equal(others[extension](), UPRIGHT)


def test_top_row_first_flips_array_vertically(tmp_path):
    read = read_power_map(save_array(tmp_path, F), **METADATA, top_row_first=True)

    assert np.array_equal(read.data[0], UPRIGHT)


# -- metadata in files of other programs ------------------------------------------------------------------------------


def test_npz_archive_contains_all_metadata(tmp_path):
    path = tmp_path / "map.npz"
    np.savez_compressed(
        path, data=np.ones((2, 3, 4)), pitch_um=0.25, wavelength_nm=[450.0, 550.0], unit="photons/s/m2/nm"
    )

    read = read_power_map(path)

    assert read.grid == fs.Grid.centred((3, 4), 0.25)
    assert read.data[1, 0, 0] == pytest.approx(100.0 * GREEN_J, rel=1e-12)


def test_npz_array_is_selected_by_name(tmp_path):
    np.savez(tmp_path / "map.npz", a=np.ones((3, 4)), b=2.0 * np.ones((3, 4)))

    assert read_power_map(tmp_path / "map.npz", name="b", **METADATA).data.max() == 2.0
    assert_rejected(
        tmp_path / "map.npz", r"contains 2 arrays, none of them named 'data'; select the map with name=", **METADATA
    )
    assert_rejected(tmp_path / "map.npz", r"has no array 'c'; possible: 'a', 'b'", name="c", **METADATA)


def test_fits_header_specifies_all_metadata(tmp_path):
    header = fits.Header(
        {
            "CTYPE1": "LINEAR",
            "CUNIT1": "mm",
            "CRPIX1": 1.0,
            "CRVAL1": 0.01,
            "CDELT1": 0.002,
            "CTYPE2": "LINEAR",
            "CUNIT2": "mm",
            "CRPIX2": 2.0,
            "CRVAL2": 0.0,
            "CDELT2": 0.002,
            "CTYPE3": "WAVE",
            "CUNIT3": "m",
            "CRPIX3": 1.0,
            "CRVAL3": 4.5e-7,
            "CDELT3": 1e-7,
            "BUNIT": "mW/cm2",
        }
    )
    fits.writeto(tmp_path / "map.fits", np.ones((2, 3, 4), np.int16), header)

    read = read_power_map(tmp_path / "map.fits")

    assert read.grid.pitch_um == pytest.approx(2.0)
    # The centre of the first column is at 10 µm, the centre of the second row at 0.
    np.testing.assert_allclose(read.grid.origin_um, (9.0, -3.0))
    np.testing.assert_allclose(read.wavelength_nm, (450.0, 550.0))
    np.testing.assert_allclose(read.data, 10.0)


@pytest.mark.parametrize("given", [{}, {"CRPIX1": 2.5}, {"CRPIX1": 1.0, "CRPIX2": 3.0, "CRPIX3": 2.0}])
def test_fits_positions_are_those_of_astropy(tmp_path, given):
    """Missing keywords of the reference pixel are 0 (FITS standard 4.0, table 22)."""
    values = {"CTYPE1": "LINEAR", "CTYPE2": "LINEAR", "CTYPE3": "WAVE", "CUNIT1": "um", "CUNIT2": "um", "CUNIT3": "nm"}
    steps = {"CRVAL1": 10.0, "CDELT1": 2.0, "CRVAL2": -4.0, "CDELT2": 3.0, "CRVAL3": 500.0, "CDELT3": 50.0}
    header = fits.Header({**values, **steps, **given, "BUNIT": "W m-2"})
    fits.writeto(tmp_path / "map.fits", np.ones((2, 3, 4)), header)
    read = read_power_map(tmp_path / "map.fits")
    world = importlib.import_module("astropy.wcs").WCS(header)

    first_um = np.array(world.pixel_to_world_values(0, 0, 0)) * [1.0, 1.0, 1e9]  # wavelengths in m
    np.testing.assert_allclose(read.grid.origin_um, first_um[:2] - [1.0, 1.5])
    np.testing.assert_allclose(read.wavelength_nm, [first_um[2], first_um[2] + 50.0])


def test_fits_extension_is_selected_by_name(tmp_path):
    images = [fits.ImageHDU(n * np.ones((3, 4)), name=f"N{n}") for n in (1, 2)]
    for image in images:
        image.header["XPIXSZ"] = 3.5
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / "map.fits")
    metadata = {"wavelength_nm": 550.0, "unit": "w_m2"}

    assert_rejected(tmp_path / "map.fits", "contains 2 images: N1, N2; select the map with name=", **metadata)
    assert read_power_map(tmp_path / "map.fits", **metadata, name="N1").data.max() == 1.0
    assert read_power_map(tmp_path / "map.fits", **metadata, name="N2").data.max() == 2.0
    assert read_power_map(tmp_path / "map.fits", **metadata, name="2").grid.pitch_um == 3.5
    assert_rejected(tmp_path / "map.fits", r"contains no image 'N3'", **metadata, name="N3")


def test_fits_in_degrees_requires_pitch(tmp_path):
    fits.writeto(
        tmp_path / "map.fits",
        np.ones((3, 4)),
        fits.Header({"CUNIT1": "deg", "CUNIT2": "deg", "CDELT1": 0.1, "CDELT2": 0.1}),
    )

    assert_rejected(
        tmp_path / "map.fits",
        r"has cells of 360 arcsec, an angle; pass focal_length_mm=\.\.\., or pitch_um=",
        wavelength_nm=550.0,
        unit="w_m2",
    )


@pytest.mark.parametrize(
    ("keywords", "pitch_deg", "zero"),
    [
        ({"PIXSCALE": 36.0}, 0.01, None),
        ({"PIXELSCL": 36.0}, 0.01, None),
        ({"SECPIX1": 36.0, "SECPIX2": 36.0}, 0.01, None),
        ({"CUNIT1": "arcsec", "CUNIT2": "arcsec", "CDELT1": 36.0, "CDELT2": 36.0, "CRPIX1": 2.0, "CRPIX2": 2.0}, 0.01, 1.0),
        ({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CDELT1": -0.01, "CDELT2": 0.01, "CRVAL1": 50.0, "CRPIX1": 3.0,
          "CRPIX2": 3.0}, 0.01, 2.0),
        ({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CD1_1": 0.01, "CD2_2": 0.01, "PIXSCALE": 36.0}, 0.01, -1.0),
    ],
)  # fmt: skip
def test_fits_in_angles_uses_the_focal_length(tmp_path, keywords, pitch_deg, zero):
    options = {"wavelength_nm": 550.0, "unit": "w_m2"}
    data = np.arange(12.0).reshape(3, 4)
    fits.writeto(tmp_path / "map.fits", data, fits.Header(keywords))
    read = read_power_map(tmp_path / "map.fits", focal_length_mm=100.0, **options)

    pitch_um = 1e5 * np.radians(pitch_deg)
    assert read.grid.pitch_um == pytest.approx(pitch_um)
    expected = (-2.0 * pitch_um, -1.5 * pitch_um) if zero is None else 2 * (-(zero + 0.5) * pitch_um,)
    np.testing.assert_allclose(read.grid.origin_um, expected, rtol=1e-9)
    np.testing.assert_array_equal(read.data[0], data)
    assert_rejected(
        tmp_path / "map.fits", r"has cells of 36 arcsec, an angle; pass focal_length_mm=\.\.\., or", **options
    )
    assert read_power_map(tmp_path / "map.fits", pitch_um=2.0, **options).grid.pitch_um == 2.0
    fits.writeto(tmp_path / "map.fits", data, fits.Header({"XPIXSZ": 2.0}), overwrite=True)
    with pytest.raises(ParameterError, match="'focal_length_mm' must be omitted for a map without cells in angles"):
        read_power_map(tmp_path / "map.fits", focal_length_mm=100.0, **options)


@pytest.mark.parametrize(
    ("keywords", "match"),
    [
        ({"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "A_ORDER": 2}, "has distorted coordinates, A_ORDER = 2"),
        ({"CTYPE1": "RA---SIN", "CTYPE2": "DEC--SIN"}, "has the coordinates CTYPE1 = 'RA---SIN', which are not linear"),
        ({"CTYPE2": "Y-LOG", "CUNIT2": "um"}, "has the coordinates CTYPE2 = 'Y-LOG', which are not linear"),
        ({"CDELT1": 1.0, "CROTA1": 90.0}, "has rotated coordinate axes, CROTA1"),
        ({"PV2_1": 0.3, "XPIXSZ": 2.0}, "has distorted coordinates, PV2_1 = 0.3"),
        (
            {"CUNIT1": "arcsec", "CUNIT2": "arcsec", "CDELT1": 2.0, "CDELT2": 2.0, "PIXSCALE": 1.0},
            "has pixels of 0.000555556 degrees by CDELT or CD, and of 0.000277778 degrees by other keywords",
        ),
    ],
)
def test_fits_keywords_that_move_cells_are_reported(tmp_path, keywords, match):
    fits.writeto(tmp_path / "map.fits", np.ones((3, 4)), fits.Header(keywords))
    assert_rejected(tmp_path / "map.fits", match, wavelength_nm=550.0, unit="w_m2")


def test_scaled_fits_map_is_read(tmp_path):
    hdu = fits.PrimaryHDU(np.arange(12.0).reshape(3, 4))
    hdu.scale("int16", bscale=0.5, bzero=3.0)
    hdu.header["XPIXSZ"], hdu.header["BUNIT"] = 2.0, "W m-2"
    hdu.writeto(tmp_path / "map.fits")
    np.testing.assert_allclose(
        read_power_map(tmp_path / "map.fits", wavelength_nm=550.0).data[0], np.arange(12.0).reshape(3, 4), atol=0.26
    )


def test_unknown_attributes_of_maps_are_reported():
    array = to_xarray(random_map())
    array.attrs["gain_e_dn"] = 2.0
    with pytest.raises(ParameterError, match="has the attribute 'gain_e_dn', which may change the values"):
        from_xarray(array)


def test_read_rejects_rotated_fits_image(tmp_path):
    fits.writeto(tmp_path / "map.fits", np.ones((3, 4)), fits.Header({"CD1_1": 0.1, "CD1_2": 0.1, "CD2_2": 0.1}))

    assert_rejected(tmp_path / "map.fits", "has rotated coordinate axes", wavelength_nm=550.0, unit="w_m2")


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "deflate"},
        {"byteorder": ">"},
        {"bigtiff": True},
        {"photometric": "minisblack", "tile": (16, 16)},
    ],
    ids=str,
)
def test_tiff_pages_become_bands(tmp_path, options):
    bands = np.arange(3 * 20 * 30, dtype=np.uint16).reshape(3, 20, 30)
    tifffile.imwrite(tmp_path / "map.tif", bands, **{"photometric": "minisblack", **options})

    read = read_power_map(tmp_path / "map.tif", pitch_um=1.0, wavelength_nm=[450, 550, 650], unit="w_m2")

    assert np.array_equal(read.data, bands[:, ::-1])


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_tiff_samples_become_bands(tmp_path, planar):
    bands = np.arange(3 * 20 * 30, dtype=np.float32).reshape(3, 20, 30)
    samples = bands if planar == "separate" else np.moveaxis(bands, 0, -1)
    tifffile.imwrite(tmp_path / "map.tif", samples, photometric="rgb", planarconfig=planar)

    read = read_power_map(tmp_path / "map.tif", pitch_um=1.0, wavelength_nm=[450, 550, 650], unit="w_m2")

    assert np.array_equal(read.data, bands[:, ::-1])


def write_exr(path, channels, **header):
    with OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}, channels
    ) as file:
        file.write(str(path))


def test_spectral_exr_bands_are_sorted_by_wavelength(tmp_path):
    channels = {f"S0.{w}nm": np.full((3, 4), i, np.float32) for i, w in enumerate(("1000,5", "450", "550,25"))}
    write_exr(tmp_path / "map.exr", channels | {"R": np.zeros((3, 4), np.float32)}, emissiveUnits="W.m^-2.nm^-1")

    read = read_power_map(tmp_path / "map.exr", pitch_um=1.0, band_width_nm=10.0)

    assert read.wavelength_nm.tolist() == [450.0, 550.25, 1000.5]
    assert read.data[:, 0, 0].tolist() == [10.0, 20.0, 0.0]


def test_channels_without_layer_have_wavelengths(tmp_path):
    ones = np.ones((3, 4), np.float32)
    write_exr(tmp_path / "map.exr", {"550.5nm": ones, "450nm": 2.0 * ones})

    read = read_power_map(tmp_path / "map.exr", pitch_um=1.0, unit="w_m2")

    assert read.wavelength_nm.tolist() == [450.0, 550.5]
    assert read.data[:, 0, 0].tolist() == [2.0, 1.0]


def test_read_rejects_exr_radiance_and_colours(tmp_path):
    ones = np.ones((3, 4), np.float32)
    write_exr(tmp_path / "scene.exr", {"S0.550nm": ones}, emissiveUnits="W.m^-2.sr^-1.nm^-1")
    write_exr(tmp_path / "colours.exr", dict.fromkeys("RGB", ones))

    assert_rejected(
        tmp_path / "scene.exr",
        r"has the unit 'W\.m\^-2\.sr\^-1\.nm\^-1', which is not an irradiance; .* pass unit=",
        pitch_um=1.0,
    )
    assert_rejected(tmp_path / "colours.exr", "contains RGB colours instead of irradiance", **METADATA)
    assert read_power_map(tmp_path / "scene.exr", pitch_um=1.0, unit="w_m2").data.max() == 1.0


def labelled(**changes):
    """Return a labelled array of another program, in SI units, with descending y."""
    coords = {
        "wl": ("wl", np.array([0.45, 0.55, 0.65]), {"units": "um"}),
        "y": ("y", np.arange(4)[::-1] * 2e-6, {"units": "m"}),
        "x": ("x", np.arange(5) * 2e-6 + 1e-5, {"units": "m"}),
    }
    data = np.arange(60.0).reshape(3, 4, 5)
    return xr.DataArray(data, dims=("wl", "y", "x"), coords=coords, attrs={"units": "W m-2 um-1"}).assign_attrs(
        **changes
    )


def test_labelled_array_is_flipped_and_converted():
    read = from_xarray(labelled())

    assert read.grid.pitch_um == pytest.approx(2.0)
    np.testing.assert_allclose(read.grid.origin_um, (9.0, -1.0))
    np.testing.assert_allclose(read.wavelength_nm, (450.0, 550.0, 650.0))
    # W/(m² µm) times bands of 100 nm: factor 0.1.
    np.testing.assert_allclose(read.data, labelled().to_numpy()[:, ::-1] / 10.0)


def test_dimension_order_and_singletons_are_ignored():
    array = labelled().expand_dims("time").transpose("x", "time", "wl", "y")

    np.testing.assert_array_equal(from_xarray(array).data, from_xarray(labelled()).data)


def test_array_slice_preserves_position():
    power_map = random_map()

    part = from_xarray(to_xarray(power_map)[1:, 2:4, 3:])

    np.testing.assert_array_equal(part.data, power_map.data[1:, 2:4, 3:])
    x0, y0 = power_map.grid.origin_um
    pitch_um = power_map.grid.pitch_um
    np.testing.assert_allclose(part.grid.origin_um, (x0 + 3 * pitch_um, y0 + 2 * pitch_um))
    assert part.grid.pitch_um == pytest.approx(pitch_um)


def test_scalar_wavelength_coordinate_is_read():
    read = from_xarray(labelled().isel(wl=1), band_width_nm=20.0)

    assert read.wavelength_nm == pytest.approx(550.0)
    assert read.data.max() == pytest.approx(39.0 * 1e-3 * 20.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda a: a.rename(x="theta"),
            r"has the dimensions \(wl, y, theta\), expected \(wavelength, y, x\); rename them",
        ),
        (lambda a: a.expand_dims(time=2), r"has the dimensions \(time, wl, y, x\)"),
        (lambda a: a.assign_coords(x=[0, 1, 2, 3, 5]), r"non-uniform steps along x"),
        (lambda a: a.assign_coords(x=[0, 1, 2, 3, np.nan]), r"non-finite coordinates along x"),
        (lambda a: a.assign_coords(x=list("abcde")), r"non-numeric coordinates along x"),
        (lambda a: a.drop_vars("x"), r"does not specify the cell size; pass pitch_um="),
        (lambda a: a.assign_coords(x=np.arange(5.0)), r"does not specify the cell size; pass pitch_um="),
        (
            lambda a: a.drop_vars("wl"),
            r"does not specify the wavelengths of its bands; pass wavelength_nm=\.\.\., 3 values in nm",
        ),
        (lambda a: a.assign_coords(wl=("wl", [0.0, 1.0, 2.0], {"units": "um"})), r"contains invalid wavelengths"),
        (lambda a: a.assign_attrs(units="K"), r"has the unit 'K', which is not an irradiance"),
        (lambda a: a.drop_attrs(deep=False), r"does not specify its unit; pass unit=\.\.\., one of 'w_m2', 'w_m2_nm'"),
        (lambda a: a.isel(wl=[1, 1, 1]), r"does not specify the band widths; pass band_width_nm="),
        (lambda a: a.where(a != 7), r"irradiance must be finite, got nan at \[band, row, column\] = \[0, 1, 2\]"),
        (lambda a: a - 1.0, r"irradiance must be >= 0, got -0\.1 W/m² at .*; clip it"),
        (lambda a: a * 1j, r"contains complex values"),
        (lambda a: a > 1, r"of dtype bool, expected real numbers"),
        (lambda a: a[:, :0], r"shape \(3, 0, 5\)"),
    ],
)
def test_from_xarray_rejects_invalid_arrays(change, message):
    with xr.set_options(keep_attrs=True):
        array = change(labelled())

    with pytest.raises(ParameterError, match=message):
        from_xarray(array)


def test_xarray_conversion_rejects_wrong_types():
    with pytest.raises(ParameterError, match=r"'data_array' must be a DataArray, got an ndarray"):
        from_xarray(np.ones((3, 3)))
    with pytest.raises(ParameterError, match=r"'power_map' must be a PowerMap"):
        to_xarray(np.ones((3, 3)))


def test_netcdf_variable_is_selected_by_name(tmp_path):
    two = xr.Dataset({"a": labelled(), "b": 2.0 * labelled(), "note": ("z", [1.0, 2.0])})
    two["b"].attrs = labelled().attrs
    two.to_netcdf(tmp_path / "map.nc", engine="h5netcdf")

    np.testing.assert_allclose(read_power_map(tmp_path / "map.nc", name="b").data, 2.0 * from_xarray(labelled()).data)
    assert_rejected(
        tmp_path / "map.nc", r"contains 2 numeric arrays with rows and columns: a, b; select the map with name="
    )
    assert_rejected(tmp_path / "map.nc", r"has no variable 'c'; possible: 'a', 'b', 'note'", name="c")


def test_scaled_netcdf_integers_are_decoded(tmp_path):
    packing = {"light": {"dtype": "int16", "scale_factor": 0.5, "add_offset": 10.0, "zlib": True, "_FillValue": -32768}}
    labelled().to_dataset(name="light").to_netcdf(tmp_path / "map.nc", engine="h5netcdf", encoding=packing)

    np.testing.assert_allclose(read_power_map(tmp_path / "map.nc").data, from_xarray(labelled()).data)


def test_plain_hdf5_is_read_with_passed_metadata(tmp_path):
    with h5py.File(tmp_path / "map.h5", "w") as file:
        file["fields/power"] = np.ones((3, 4))
        file["power"] = np.arange(12.0).reshape(3, 4)

    read = read_power_map(tmp_path / "map.h5", **METADATA)

    np.testing.assert_array_equal(read.data[0], np.arange(12.0).reshape(3, 4))


# -- optical images of ISETCam --------------------------------------------------------------------------------------


def optical_image(photons, wave, **changes):
    """Return a struct ``oi`` of ISETCam for a focal length of 4 mm and a field of view of 10 degrees."""
    return {
        "type": "opticalimage",
        "wAngular": 10.0,
        "data": {"photons": photons},
        "spectrum": {"wave": np.asarray(wave, float).reshape(-1, 1)},
        "optics": {"focalLength": 0.004, "model": "diffractionlimited", "fNumber": 4.0},
        **changes,
    }


SAVERS = {
    "v7": lambda path, tree: scipy.io.savemat(path, tree, do_compression=True),
    "v6": scipy.io.savemat,
    "v7.3": write_mat73,
}


@pytest.mark.parametrize("save", SAVERS.values(), ids=SAVERS)
def test_optical_image_yields_absolute_irradiance(tmp_path, save):
    wave = np.array([540.0, 550.0, 560.0])
    photon_j = scipy.constants.h * scipy.constants.c / (wave * 1e-9)
    # 1 W/(m² nm) at every wavelength: 2.769e18 photons/(s m² nm) at 550 nm.
    photons = np.ones((4, 6, 3)) / photon_j
    photons[0, 1] *= 3.0
    assert photons[3, 0, 1] == pytest.approx(2.7688e18, rel=1e-4)
    save(tmp_path / "oi.mat", {"oi": optical_image(photons, wave)})

    read = read_power_map(tmp_path / "oi.mat")

    expected = np.full((3, 4, 6), 10.0)
    expected[:, 3, 1] = 30.0  # row 1 of ISETCam is the top row
    np.testing.assert_allclose(read.data, expected, rtol=1e-12)
    assert read.wavelength_nm.tolist() == wave.tolist()
    # Width 2 f tan(fov / 2) = 2 · 4000 µm · 0.0874887 = 699.909 µm for 6 columns.
    assert read.grid.pitch_um == pytest.approx(116.6516, rel=1e-6)
    np.testing.assert_allclose(read.grid.bounds_um, (-349.9547, -233.3031, 349.9547, 233.3031), rtol=1e-6)


@pytest.mark.parametrize("save", SAVERS.values(), ids=SAVERS)
def test_optical_images_are_found_by_name(tmp_path, save):
    photons = np.random.default_rng(8).random((4, 6, 2)).astype(np.float32) * np.float32(1e18)
    image = optical_image(photons, [450.0, 550.0])
    trees = {"oi": {"oi": image}, "opticalimage": {"opticalimage": image}, "fields": image}
    for name, tree in trees.items():
        save(tmp_path / f"{name}.mat", tree)
    save(tmp_path / "mine.mat", {"mine": image, "other": {"a": 1.0}})

    maps = [read_power_map(tmp_path / f"{name}.mat") for name in trees]
    maps.append(read_power_map(tmp_path / "mine.mat", name="mine"))

    assert maps[0].data.dtype == np.float32
    for power_map in maps[1:]:
        assert_same(power_map, maps[0])
    assert_rejected(tmp_path / "mine.mat", r"contains no optical image 'oi'; possible: 'mine', 'other'")


@pytest.mark.parametrize("save", SAVERS.values(), ids=SAVERS)
def test_ray_traced_focal_length_is_in_mm(tmp_path, save):
    optics = {"focalLength": 1.0, "model": "raytrace", "rayTrace": {"effectiveFocalLength": 8.0}}
    save(tmp_path / "oi.mat", {"oi": optical_image(np.ones((4, 6)), [550.0], optics=optics)})

    read = read_power_map(tmp_path / "oi.mat")

    assert read.grid.pitch_um == pytest.approx(2 * 116.6516, rel=1e-6)
    # The band width of a single wavelength is 1 nm.
    assert read.data.max() == pytest.approx(GREEN_J, rel=1e-12)


def test_integer_photons_of_old_versions_are_scaled(tmp_path):
    packed = np.array([[0, 65535], [32768, 1]], np.uint16)
    data = {"photons": packed, "dmin": 1e17, "dmax": 3e17, "bitDepth": 16.0}
    scipy.io.savemat(tmp_path / "oi.mat", {"oi": optical_image(0, [550.0], data=data)})

    rates = read_power_map(tmp_path / "oi.mat").data[0, ::-1] / GREEN_J

    np.testing.assert_allclose(rates, [[1e17, 3e17], [1e17 + 2e17 * 32768 / 65535, 1e17 + 2e17 / 65535]], rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wAngular": 200.0}, "does not specify the cell size; pass pitch_um="),
        ({"optics": {"focalLength": np.nan}}, "does not specify the cell size; pass pitch_um="),
        ({"spectrum": 1.0}, "does not specify the wavelengths"),
        ({"data": {"illuminance": 1.0}}, r"contains no optical image with data\.photons; compute it with oiCompute"),
        ({"data": {"photons": np.ones((2, 2, 2, 2))}}, r"photons of shape \(2, 2, 2, 2\)"),
        ({"data": {"photons": np.ones((2, 2), np.uint16)}}, "without their range, dmin and dmax"),
        ({"data": {"photons": np.ones((2, 2, 3))}}, "contains 1 wavelengths for 3 bands"),
        ({"data": {"photons": -np.ones((2, 2))}}, "irradiance must be >= 0"),
    ],
)
def test_incomplete_optical_image_error_names_field(tmp_path, changes, message):
    scipy.io.savemat(tmp_path / "oi.mat", {"oi": optical_image(np.ones((2, 2)), [550.0], **changes)})

    assert_rejected(tmp_path / "oi.mat", message)


def test_arguments_override_file_metadata(tmp_path):
    scipy.io.savemat(tmp_path / "oi.mat", {"oi": optical_image(np.ones((4, 6)), [550.0])})

    read = read_power_map(
        tmp_path / "oi.mat", pitch_um=2.0, wavelength_nm=600.0, unit="w_m2_nm", band_width_nm=7.0, origin_um=(1.0, 2.0)
    )

    assert read.grid == fs.Grid((4, 6), 2.0, (1.0, 2.0))
    assert read.wavelength_nm.tolist() == [600.0]
    assert read.data.max() == 7.0


# -- numbers and units ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("w_m2", (1.0, 1.0)),
        ("w_m2_nm", (100.0, 100.0)),
        ("photons_s_m2", (GREEN_J * 550 / 450, GREEN_J)),
        ("photons_s_m2_nm", (100.0 * GREEN_J * 550 / 450, 100.0 * GREEN_J)),
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_are_converted_to_watts_per_band(tmp_path, unit, expected, dtype):
    scale = 1.0 if unit.startswith("w") else 1e18
    path = save_array(tmp_path, np.full((2, 3, 4), scale, dtype))

    read = read_power_map(path, pitch_um=1.0, wavelength_nm=[450.0, 550.0], unit=unit)

    assert read.data.dtype == dtype
    np.testing.assert_allclose(read.data[:, 0, 0], scale * np.array(expected), rtol=2 * np.finfo(dtype).eps)


def test_default_bands_extend_to_midpoints(tmp_path):
    read = read_power_map(
        save_array(tmp_path, np.ones((3, 1, 1))), pitch_um=1.0, wavelength_nm=[600, 400, 450], unit="w_m2_nm"
    )

    assert read.data.ravel().tolist() == [150.0, 50.0, 100.0]


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("W/m2", ("w_m2", 1.0)),
        ("W/m^2", ("w_m2", 1.0)),
        ("W m-2", ("w_m2", 1.0)),
        ("W·m⁻²", ("w_m2", 1.0)),
        ("W/m²", ("w_m2", 1.0)),
        ("J s**-1 m**-2", ("w_m2", 1.0)),
        ("uW/cm2", ("w_m2", 0.01)),
        ("µW/(cm^2)", ("w_m2", 0.01)),
        ("erg/s/cm2/Angstrom", ("w_m2_nm", 0.01)),
        ("W m-2 um-1", ("w_m2_nm", 1e-3)),
        ("W/m^3", ("w_m2_nm", 1e-9)),
        ("W/(m2 nm)", ("w_m2_nm", 1.0)),
        ("photons/s/m2", ("photons_s_m2", 1.0)),
        ("photons/(s m2 nm)", ("photons_s_m2_nm", 1.0)),
        ("w_m2", ("w_m2", 1.0)),
        ("photons_s_m2_nm", ("photons_s_m2_nm", 1.0)),
        ("W/m2 nm", None),
        ("W m-2 sr-1", None),
        ("W/m2/nm/sr", None),
        ("V/m", None),
        ("1/s", None),
        ("W/(m2", None),
        ("W/m2)", None),
        ("", None),
        ("a.u.", None),
        ("W" * 100, None),
        ("m" + "9" * 60, None),
        ("W/m100", None),
    ],
)
def test_irradiance_units_are_parsed(text, unit):
    assert irradiance_unit(text) == unit


@pytest.mark.parametrize(
    ("text", "size_um"),
    [("nm", 1e-3), ("micron", 1.0), ("μm", 1.0), ("m", 1e6), ("AA", 1e-4), ("px", None), ("m2", None)],
)
def test_length_units_are_parsed(text, size_um):
    assert length_in_um(text) == size_um


@pytest.mark.parametrize("dtype", [">f4", ">f8", "<f2", "u1", ">u2", "<i4", ">i8", "u8"])
def test_all_numeric_dtypes_are_read(tmp_path, dtype):
    read = read_power_map(save_array(tmp_path, np.arange(12).reshape(3, 4).astype(dtype)), **METADATA)

    assert np.array_equal(read.data[0], np.arange(12).reshape(3, 4))
    assert read.data.dtype in (np.float32, np.float64)
    assert read.data.dtype.isnative


def test_fortran_order_yields_same_array(tmp_path):
    array = np.arange(24.0).reshape(2, 3, 4)

    read = read_power_map(
        save_array(tmp_path, np.asfortranarray(array)), pitch_um=1.0, wavelength_nm=[450, 550], unit="w_m2"
    )

    assert np.array_equal(read.data, array)


def test_negative_rounding_errors_are_preserved(tmp_path):
    light = np.array([[1.0, -1e-7]])

    assert np.array_equal(read_power_map(save_array(tmp_path, light), **METADATA).data[0], light)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.array([[1.0, np.nan]]), r"irradiance must be finite, got nan at \[band, row, column\] = \[0, 0, 1\]"),
        (np.array([[1.0], [np.inf]]), r"irradiance must be finite, got inf at \[band, row, column\] = \[0, 1, 0\]"),
        (np.array([[1.0, -0.5]]), r"must be >= 0, got -0\.5 W/m² at \[band, row, column\] = \[0, 0, 1\]"),
        (np.array([[-1e-9, -1e-9]]), r"irradiance must be >= 0"),
        (np.ones((2, 2), complex), r"contains complex values \(a field\)"),
        (np.ones((2, 2), bool), r"of dtype bool"),
        (np.array([["a", "b"]]), r"of dtype <U1"),
        (np.ones(3), r"shape \(3,\)"),
        (np.ones((2, 1, 3, 3)), r"shape \(2, 1, 3, 3\)"),
        (np.ones((2, 0)), r"shape \(2, 0\)"),
        (np.float64(1.0), r"shape \(\)"),
        (np.array([[{}]], dtype=object), r"contains Python objects"),
        (np.zeros((2, 2), [("a", "f8")]), r"of dtype"),
        (np.ones((5000, 1, 1)), r"contains 5000 bands, more than 4096; store bands first"),
    ],
)
def test_read_rejects_invalid_irradiance(tmp_path, array, message):
    assert_rejected(save_array(tmp_path, array), message, **METADATA)


@pytest.mark.parametrize(
    ("metadata", "message", "error"),
    [
        ({"pitch_um": None}, r"does not specify the cell size; pass pitch_um=\.\.\., the side or", FileError),
        ({"wavelength_nm": None}, r"pass wavelength_nm=\.\.\., 1 values in nm", FileError),
        ({"unit": None}, r"does not specify its unit; pass unit=\.\.\., one of", FileError),
        ({"unit": "w_m2_nm"}, r"does not specify the band widths; pass band_width_nm=", FileError),
        ({"pitch_um": -1.0}, r"'pitch_um' must be > 0", ParameterError),
        ({"pitch_um": 1e-6}, r"'pitch_um' must be >= 0\.0001", ParameterError),
        ({"wavelength_nm": 0.55}, r"'wavelength_nm' must be from 10", ParameterError),
        (
            {"wavelength_nm": [450, 550]},
            r"'wavelength_nm' must have 1 values, one per band of the map, got 2",
            ParameterError,
        ),
        (
            {"unit": "lux"},
            r"'unit' must be one of 'w_m2', 'w_m2_nm', 'photons_s_m2', 'photons_s_m2_nm', got 'lux'",
            ParameterError,
        ),
        (
            {"unit": "w_m2_nm", "band_width_nm": [1, 2]},
            r"'band_width_nm' must be one number, or one for each",
            ParameterError,
        ),
        ({"band_width_nm": -1}, r"'band_width_nm' must be > 0", ParameterError),
        ({"origin_um": (1.0,)}, r"'origin_um' must be two numbers", ParameterError),
        ({"name": "x"}, r"contains one unnamed array; omit name=", FileError),
    ],
)
def test_read_rejects_missing_or_invalid_metadata(tmp_path, metadata, message, error):
    assert_rejected(save_array(tmp_path, np.ones((3, 4))), message, error, **{**METADATA, **metadata})


def test_read_rejects_files_of_other_formats(tmp_path):
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "packed").write_bytes(b"\x1f\x8b" + bytes(50))
    (tmp_path / "text").write_text("1 2 3")

    assert_rejected(tmp_path / "nowhere", "no such file")
    assert_rejected(tmp_path, "is not a file")
    assert_rejected(tmp_path / "empty", "is empty")
    assert_rejected(tmp_path / "packed", "is compressed with gzip; decompress it first")
    assert_rejected(
        tmp_path / "text", r"is not a valid power map: expected EXR, FITS, MAT, netCDF, npy, npz, (.*, )?TIFF or zarr"
    )


# -- malformed files --------------------------------------------------------------------------------------------------

MAX_S, TIMEOUT_S, MAX_BYTES = 20.0, 60.0, 2 * 2**30
READ = """
import json, resource, sys
from foveasim._io import sandbox
from foveasim._io.rasters.units import length_in_um
from foveasim import maps
from foveasim.errors import FoveasimError
from foveasim.maps import read_power_map
from foveasim.maps._formats import MAP_FORMATS

if "in process" in sys.argv:
    maps.read_found = lambda path, kind, name: MAP_FORMATS[kind].read(path, name)
    resource.setrlimit(resource.RLIMIT_AS, (4 * 2**30, 4 * 2**30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
answers = open(int(sys.argv[1]), "w")

def busy_s():
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))

for path in sys.stdin.read().splitlines():
    began_s = busy_s()
    try:
        answer = ["PowerMap", str(read_power_map(path, pitch_um=1.0, wavelength_nm=550.0, unit="w_m2").data.shape)]
    except FoveasimError as error:
        answer = [type(error).__name__, str(error)]
    except BaseException as error:
        answer = ["!" + type(error).__name__, str(error)]
    own = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) * 1024
    child = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    print(json.dumps([*answer, busy_s() - began_s, own + child]), file=answers, flush=True)
"""
#: The reading process crashed or was killed.
CRASHED = "crashed"
#: Errors that reading may raise.
ERRORS = {"FileError", "ParameterError"}


def read_all(paths, *, in_sandbox=True):
    """
    Read files in a separate process; return kind and message of each result, CPU time in seconds, and memory in bytes.

    Without ``in_sandbox`` the readers run in that process itself. A crash of the process is a separate kind of result.
    """
    answers = []
    while len(answers) < len(paths):
        rest, (source, sink) = paths[len(answers) :], os.pipe()
        command = [sys.executable, "-c", READ, str(sink), *(() if in_sandbox else ("in process",))]
        with (
            subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, pass_fds=[sink]
            ) as program,
            os.fdopen(source) as lines,
        ):
            os.close(sink)
            timer = threading.Timer(TIMEOUT_S + 4 * len(rest), program.kill)
            timer.start()
            program.stdin.write("\n".join(map(str, rest)).encode())
            program.stdin.close()
            answers += map(json.loads, lines)
            timer.cancel()
        if len(answers) < len(paths):
            answers.append([CRASHED, f"{program.returncode}", 0.0, 0])
    return answers


def assert_harmless(answers, kinds):
    for answer in answers:
        kind, message, busy_s, n_bytes = answer
        assert kind in kinds, answer
        assert message.isprintable(), answer
        assert len(message) < 700
        assert busy_s < MAX_S, answer
        assert n_bytes < MAX_BYTES, answer


def npy_header(shape, dtype="<f4"):
    text = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    text = text.ljust(-(len(text) + 11) % 64 + len(text)) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def compressed_zeros(n_mib):
    """Return a zlib stream of zeros: compressed blocks of 1 MiB that do not refer to each other are repeated."""
    compressor, block = zlib.compressobj(9), bytes(2**20)
    first = compressor.compress(block) + compressor.flush(zlib.Z_FULL_FLUSH)
    other = compressor.compress(block) + compressor.flush(zlib.Z_FULL_FLUSH)
    end = zlib.compressobj(9, wbits=-15).flush()
    # Adler-32 of n zeros: sums of 1 and n.
    checksum = ((n_mib * 2**20) % 65_521) << 16 | 1
    return first + other * (n_mib - 1) + end + struct.pack(">I", checksum)


def zipped(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def zip_bomb():
    """Return an archive with an array of 512 MiB."""
    header, zeros, name = npy_header((2**14, 2**13)), bytes(2**29), b"data.npy"
    compressor = zlib.compressobj(9, wbits=-15)
    content = compressor.compress(header) + compressor.flush(zlib.Z_FULL_FLUSH) + compressed_zeros(2**9)[2:-4]
    checksum = zlib.crc32(zeros, zlib.crc32(header))
    sizes = len(content), len(header) + len(zeros), len(name)
    about = struct.pack("<HHHHHIIIHH", 20, 0, zipfile.ZIP_DEFLATED, 0, 0, checksum, *sizes, 0)
    member = b"PK\x03\x04" + about + name + content
    directory = b"PK\x01\x02" + struct.pack("<H", 20) + about + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
    return member + directory + b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(directory), len(member), 0)


def fits_header(*cards, body=b""):
    text = b"".join(f"{key:8}= {value:>20}".encode().ljust(80) for key, value in cards) + b"END".ljust(80)
    return text.ljust(-(-len(text) // 2880) * 2880) + body


def tiff_directory(*entries, after=0, body=b""):
    """Return a TIFF with one directory of entries (tag, type, count, value)."""
    table = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + table + struct.pack("<I", after) + body


def big_tiff():
    n = 2**20
    return tiff_directory(
        *((256, 4, 1, n), (257, 4, 1, n), (258, 3, 1, 32), (259, 3, 1, 8), (262, 3, 1, 1), (339, 3, 1, 3)),
        *((273, 4, 1, 200), (277, 3, 1, 1), (278, 4, 1, n), (279, 4, 1, 50)),
        body=bytes(100),
    )


def looping_tiff():
    return tiff_directory((256, 4, 1, 2), (257, 4, 1, 2), (258, 3, 1, 8), (273, 4, 1, 8), after=8)


def mat_element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + bytes(0 if kind == 15 else -len(content) % 8)


def mat(*elements):
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"".join(elements)


def mat_array(name, kind, dims, *parts):
    content = mat_element(6, struct.pack("<II", kind, 0)) + mat_element(5, struct.pack("<ii", *dims))
    content += mat_element(1, name) + b"".join(parts)
    return mat_element(14, content)


def nested_mat(n):
    """Return a MAT file with n nested cells."""
    inner = mat_array(b"", 6, (1, 1), mat_element(9, bytes(8)))
    for _ in range(n):
        inner = mat_array(b"", 1, (1, 1), inner)
    return mat(mat_array(b"oi", 1, (1, 1), inner))


def hdf5(fill):
    file = io.BytesIO()
    with h5py.File(file, "w") as tree:
        fill(tree)
    return file.getvalue()


def sparse(tree):
    tree.create_dataset("light", (2**20, 2**20), "f4", chunks=(1024, 1024), compression="gzip")


def hdf5_bomb(tree):
    shape = (2**13, 2**14)
    light = tree.create_dataset("light", shape, "f4", chunks=shape, compression="gzip", shuffle=True)
    light.id.write_direct_chunk((0, 0), compressed_zeros(2**9))


def virtual(tree):
    layout = h5py.VirtualLayout((2, 2), "u1")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (2, 2))
    tree.create_virtual_dataset("light", layout)


def mat73(fill):
    content = bytearray(512) + hdf5(fill)
    content[:128] = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    return bytes(content)


def huge_oi(tree):
    tree.create_dataset("oi/data/photons", (3, 2**18, 2**18), "f4", chunks=(1, 1024, 1024), compression="gzip")


MALFORMED = {
    "npy of a huge shape": lambda: npy_header((2**20, 2**20)) + bytes(100),
    "npy of a negative shape": lambda: npy_header((-3, -4)) + bytes(48),
    "npy of no bytes": lambda: npy_header((2**30, 2**20), "<V0"),
    "npy of objects": lambda: npy_header((1, 1), "|O") + b"cos\nsystem\n(S'touch /tmp/owned'\ntR.",
    "npy with code as header": lambda: (
        b"\x93NUMPY\x01\x00\x40\x00" + b"__import__('os').system('touch /tmp/owned')".ljust(63) + b"\n"
    ),
    "npy with an endless header": lambda: b"\x93NUMPY\x02\x00\xff\xff\xff\x7f" + b"(" * 100_000,
    "zip bomb": zip_bomb,
    "zip with a bomb as metadata": lambda: zipped(
        data=npy_header((2, 2)) + bytes(16), unit=npy_header((2**22,)) + bytes(2**24)
    ),
    "zip of objects": lambda: zipped(data=npy_header((1, 1), "|O") + b"cos\nsystem\n(S'touch /tmp/owned'\ntR."),
    "fits of a huge shape": lambda: fits_header(
        ("SIMPLE", "T"), ("BITPIX", -64), ("NAXIS", 2), ("NAXIS1", 2**31), ("NAXIS2", 2**31)
    ),
    "fits of a negative shape": lambda: fits_header(
        ("SIMPLE", "T"), ("BITPIX", -64), ("NAXIS", 2), ("NAXIS1", -5), ("NAXIS2", 5)
    ),
    "fits of 999 axes": lambda: fits_header(
        ("SIMPLE", "T"), ("BITPIX", 8), ("NAXIS", 999), *((f"NAXIS{i}", 1) for i in range(1, 1000))
    ),
    "fits without an end": lambda: b"SIMPLE  =                    T".ljust(80) + b"COMMENT".ljust(80) * 100_000,
    "fits of 2000 parts": lambda: (
        fits_header(("SIMPLE", "T"), ("BITPIX", 8), ("NAXIS", 0), ("EXTEND", "T"))
        + fits_header(("XTENSION", "'IMAGE   '"), ("BITPIX", 8), ("NAXIS", 0), ("PCOUNT", 0), ("GCOUNT", 1)) * 2000
    ),
    "tiff of a huge shape": big_tiff,
    "tiff of cyclic pages": looping_tiff,
    "hdf5 of a huge shape": lambda: hdf5(sparse),
    "hdf5 bomb": lambda: hdf5(hdf5_bomb),
    "hdf5 with external storage": lambda: hdf5(
        lambda t: t.create_dataset("light", (2, 2), "u1", external="/etc/passwd")
    ),
    "hdf5 with a virtual dataset": lambda: hdf5(virtual),
    "hdf5 with an external link": lambda: hdf5(
        lambda t: t.__setitem__("light", h5py.ExternalLink("/tmp/other.h5", "/x"))
    ),
    "hdf5 of objects": lambda: hdf5(lambda t: t.create_dataset("light", (2, 2), h5py.string_dtype())),
    "hdf5 with cyclic links": lambda: hdf5(
        lambda t: (t.create_group("a"), t["a"].__setitem__("b", t["/"]), t["a"].__setitem__("c", t["a"]))
    ),
    "hdf5 of 2000 arrays": lambda: hdf5(lambda t: [t.create_dataset(f"a{i}", data=1.0) for i in range(2000)]),
    "netCDF 3 of endless dimensions": lambda: b"CDF\x01" + struct.pack(">iii", 0, 10, 2**31 - 1) + bytes(100),
    "mat bomb": lambda: mat(mat_element(15, compressed_zeros(2**9))),
    "mat of a huge shape": lambda: mat(mat_array(b"oi", 6, (2**15, 2**16), mat_element(9, bytes(8)))),
    "mat of a huge cell": lambda: mat(mat_array(b"oi", 1, (2**15, 2**15))),
    "mat of nested cells": lambda: nested_mat(20_000),
    "mat of a function": lambda: mat(
        mat_array(b"oi", 16, (1, 1), mat_array(b"", 4, (1, 6), mat_element(4, "system".encode("utf-16-le"))))
    ),
    "mat of an object": lambda: mat(mat_array(b"oi", 17, (1, 1))),
    "mat 7.3 of a huge shape": lambda: mat73(huge_oi),
    "mat 7.3 of objects": lambda: mat73(lambda t: t.create_dataset("oi/data/photons", (2, 2), h5py.ref_dtype)),
    "mat 7.3 with external storage": lambda: mat73(
        lambda t: t.create_dataset("oi/data/photons", (2, 2), "u1", external="/etc/passwd")
    ),
}


@pytest.mark.slow
def test_malformed_files_raise_one_line_errors(tmp_path):
    paths = [tmp_path / f"{i}" for i in range(len(MALFORMED))]
    for path, make in zip(paths, MALFORMED.values(), strict=True):
        path.write_bytes(make())

    answers = dict(zip(MALFORMED, read_all(paths), strict=True))

    for name, answer in answers.items():
        assert answer[0] in ERRORS, (name, answer)
        assert not answer[1].isspace(), name
    assert_harmless(answers.values(), ERRORS)


#: Malicious changes of the metadata in a zarr directory.
MALFORMED_ZARR = {
    "pickle": lambda m: m["codecs"].append({"name": "numcodecs.pickle", "configuration": {}}),
    "unknown": lambda m: m["codecs"].append({"name": "os.system"}),
    "nested": lambda m: m["codecs"].insert(
        0,
        {
            "name": "sharding_indexed",
            "configuration": {"chunk_shape": [1, 1, 1], "codecs": [{"name": "numcodecs.pickle"}]},
        },
    ),
    "objects": lambda m: m.update(data_type="object"),
    "huge": lambda m: m.update(shape=[1, 2**30, 2**30]),
    "huge chunks": lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=[1, 2**20, 2**20]),
    "negative": lambda m: m.update(shape=[1, -5, 4]),
    "storage": lambda m: m.update(storage_transformers=[{"name": "x"}]),
}


@pytest.mark.slow
def test_malformed_zarr_raises_one_line_errors(tmp_path):
    paths = []
    for name, change in MALFORMED_ZARR.items():
        path = tmp_path / f"{name}.zarr"
        write_power_map(letter_map(), path)
        metadata = path / "irradiance" / "zarr.json"
        about = json.loads(metadata.read_text())
        change(about)
        metadata.write_text(json.dumps(about))
        paths.append(path)
    (path / "zarr.json").write_text("{" * 5000)

    answers = read_all(paths, in_sandbox=False)

    assert_harmless(answers, ERRORS)
    for name, answer in zip(MALFORMED_ZARR, answers, strict=True):
        assert "is encoded with the unsupported codec" in answer[1] or name not in ("pickle", "unknown", "nested"), (
            answer
        )


@pytest.fixture(scope="module")
def valid_files(tmp_path_factory):
    """Contents of one valid file per format."""
    directory = tmp_path_factory.mktemp("valid")
    for extension in ("npz", "fits", "tif", "exr", "nc"):
        write_power_map(random_map(n_band=1), directory / f"map.{extension}")
    np.save(directory / "map.npy", random_map().data[0])
    tree = {"oi": optical_image(np.ones((4, 6)), [550.0])}
    scipy.io.savemat(directory / "map.mat", tree)
    write_mat73(directory / "map.mat73", tree)
    files = {path.suffix[1:]: path.read_bytes() for path in directory.iterdir()}
    files["fits"] = files["fits"].rstrip(b"\0")  # truncated padding of the last block would not be an error
    return files


#: Formats with libraries that corrupt files can crash: read in the sandbox process.
FRAGILE = ("exr", "nc", "mat", "mat73")
N_CORRUPT = 40


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("extension", ["npy", "npz", "fits", "tif", *FRAGILE])
def test_corrupt_files_are_handled(valid_files, tmp_path, extension):
    """Truncated files, random bytes after the header, and flipped bits: each yields a map or an error of one line."""
    data, rng = valid_files[extension], np.random.default_rng(11)
    files = [data[: len(data) * i // N_CORRUPT] for i in range(1, N_CORRUPT)]
    files += [data[:16] + rng.bytes(int(size)) for size in rng.integers(1, 3000, N_CORRUPT)]
    for i in range(N_CORRUPT):
        corrupt = bytearray(data)
        for at in rng.integers(0, len(data), 1 + i % 3):
            corrupt[at] ^= 1 << rng.integers(8)
        files.append(bytes(corrupt))
    paths = [tmp_path / str(i) for i in range(len(files))]
    for path, content in zip(paths, files, strict=True):
        path.write_bytes(content)

    answers = read_all(paths, in_sandbox=False)

    crashed = {CRASHED} if extension in FRAGILE else set()
    assert_harmless(answers, ERRORS | {"PowerMap"} | crashed)
    if extension != "exr":  # OpenEXR returns incomplete data and prints a message to standard output
        assert_harmless(answers[: 2 * N_CORRUPT - 1], ERRORS | crashed)


def test_missing_tiff_strips_raise_error(tmp_path):
    path = tmp_path / "map.tif"
    tifffile.imwrite(path, np.ones((40, 30), np.float32), rowsperstrip=5)
    with tifffile.TiffFile(path) as file:
        offset = file.pages[0].tags["StripByteCounts"].offset
    content = path.read_bytes()
    path.write_bytes(content[:offset] + struct.pack("<H", 60_000) + content[offset + 2 :])

    assert_rejected(path, "is corrupt or truncated", **METADATA)


@pytest.mark.usefixtures("in_sandbox")
def test_read_rejects_truncated_exr(valid_files, tmp_path):
    (tmp_path / "map.exr").write_bytes(valid_files["exr"][:-20])

    assert_rejected(tmp_path / "map.exr", "is corrupt or truncated")


@pytest.mark.usefixtures("in_sandbox")
@pytest.mark.parametrize(
    ("limit", "value", "message"),
    [
        ("BASE_BYTES", 96 * 2**20 - 3 * 2**28, "crashed|more memory|failed to map|is corrupt|took more than"),
        ("MAX_CPU_S", 0, "reading it took more than 0 s"),
    ],
)
def test_sandbox_crash_raises_one_line_error(valid_files, tmp_path, monkeypatch, limit, value, message):
    (tmp_path / "map.mat").write_bytes(valid_files["mat"])
    monkeypatch.setattr(sandbox, limit, value)

    assert_rejected(tmp_path / "map.mat", message)
