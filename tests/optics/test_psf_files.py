"""Positions and pitches of PSFs of other programs: arrays, npz, FITS and text of Zemax."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import FileError, ParameterError
from foveasim.optics import PSFGrid, read_psfs
from tests.effort import examples

fits = pytest.importorskip("astropy.io.fits")
pytestmark = [
    pytest.mark.filterwarnings("ignore:approximately .* of the light of a point lies beyond"),
    pytest.mark.filterwarnings("ignore:the PSFs have samples of"),
    pytest.mark.filterwarnings("ignore:the image of the scene is only"),
]
WAVE_NM = 550.0
LENS = fs.Optics(focal_length_mm=8.0, f_number=4.0, padding="zero", padding_cells=40, precision="double", oversample=1)
ABOUT = {"x_um": 0.0, "y_um": 0.0, "wavelength_nm": WAVE_NM}
#: Centroid (x, y) of a spot and its radius, in samples.
SPOT, RADIUS = (0.7, -1.2), 2.5


def spot(n_y, n_x, row, column, radius=RADIUS, at=SPOT):
    """Return a Gaussian with its centroid ``at`` (x, y) samples from (row, column)."""
    y, x = np.arange(n_y)[:, np.newaxis] - row - at[1], np.arange(n_x) - column - at[0]
    return np.exp(-0.5 * (x * x + y * y) / radius**2)


def map_centroid_um(psfs):
    """Return the centroid (x, y) of the power map of a point source on the axis."""
    image = np.zeros((1, 61, 61))
    image[0, 30, 30] = 1.0
    scene = fs.Scene(image, np.ones((1, 1)), np.array([WAVE_NM]), np.ones(1), 122.0, 1.0)
    light = replace(LENS, psfs=psfs).power_map(scene)
    weights = light.data[0] / light.data[0].sum()
    return float((weights * light.grid.x_um).sum()), float((weights * light.grid.y_um[:, np.newaxis]).sum())


@pytest.mark.parametrize(
    ("shape", "centre"),
    [
        ((32, 32), (15.5, 15.5)),
        ((32, 32), "middle"),
        ((32, 32), "fft"),
        ((33, 32), (16, 15.5)),
        ((33, 33), None),
        ((40, 36), (17.25, 20.8)),
    ],
)
@pytest.mark.parametrize("options", [{}, {"image": "inverted"}, {"first_row": "highest"}], ids=str)
def test_centroids_are_those_of_the_spot(shape, centre, options):
    places = {"fft": [n // 2 for n in shape], "middle": [0.5 * (n - 1) for n in shape], None: [n // 2 for n in shape]}
    row, column = places.get(centre, centre) if not isinstance(centre, tuple) else centre
    psf = spot(*shape, row, column)
    psfs = PSFGrid.from_arrays(psf, pitch_um=1.1, centre=centre, **ABOUT, **options)

    sign_x = -1.0 if "image" in options else 1.0
    sign_y = sign_x * (-1.0 if "first_row" in options else 1.0)
    expected_um = 1.1 * np.array(SPOT) * [sign_x, sign_y]
    np.testing.assert_allclose(psfs.centroid_um[0, 0], expected_um, atol=1e-4)
    assert map_centroid_um(psfs) == pytest.approx(expected_um, abs=2e-3)


def test_even_samples_of_point_image_stay_centred():
    coma = fs.Optics(focal_length_mm=8.0, f_number=4.0, seidel=fs.optics.Seidel(coma_um=0.3, field_radius_um=300.0))
    at = {"distance_m": 1.0, "field_um": (0.0, 300.0)}
    odd, even = (coma.psf(WAVE_NM, pitch_um=0.8, n_points=n, **at).psf_per_um2 for n in (129, 128))
    one = PSFGrid.from_arrays(odd, pitch_um=0.8, **ABOUT)
    other = PSFGrid.from_arrays(even, pitch_um=0.8, centre=(63.5, 63.5), **ABOUT)
    wrong = PSFGrid.from_arrays(even, pitch_um=0.8, centre=(63, 63), **ABOUT)

    np.testing.assert_allclose(other.centroid_um, one.centroid_um, atol=0.02)
    np.testing.assert_allclose(wrong.centroid_um - other.centroid_um, 0.4, atol=1e-9)
    f_per_mm = np.linspace(0.0, 400.0, 5)
    phase = [
        fs.Optics(focal_length_mm=8.0, f_number=4.0, psfs=psfs).otf(f_per_mm, WAVE_NM, angle_deg=90.0, distance_m=1.0)
        for psfs in (one, other)
    ]
    np.testing.assert_allclose(*phase, atol=2e-3)


def test_varying_psfs_keep_positions_between_samples():
    heights_um = [0.0, 100.0, 200.0]
    psf = np.array([spot(24, 24, 11.5, 11.5, at=(0.3 * k, 0.0)) for k in range(3)])
    about = {"x_um": heights_um, "y_um": np.zeros(3), "wavelength_nm": WAVE_NM, "pitch_um": 1.0}
    lens = fs.Optics(focal_length_mm=8.0, f_number=4.0, psfs=PSFGrid.from_arrays(psf, centre="middle", **about))
    for x_um, y_um, expected_um in ((100.0, 0.0, (0.3, 0.0)), (0.0, 200.0, (0.0, 0.6)), (150.0, 0.0, (0.45, 0.0))):
        point = lens.psf(WAVE_NM, field_um=(x_um, y_um), pitch_um=0.5, n_points=81)
        weights = point.psf_per_um2 / point.psf_per_um2.sum()
        found = (weights * point.grid.x_um).sum(), (weights * point.grid.y_um[:, np.newaxis]).sum()
        assert found == pytest.approx(expected_um, abs=3e-3)


def test_coordinates_of_samples_decide():
    x_um, y_um = np.linspace(-12.0, 12.0, 32), np.linspace(10.0, -14.0, 32)
    psf = np.exp(-0.5 * ((x_um - 0.4) ** 2 + (y_um[:, np.newaxis] + 1.3) ** 2) / 2.0**2)
    psfs = PSFGrid.from_arrays(psf, sample_x_um=x_um, sample_y_um=y_um, **ABOUT)

    assert psfs.pitch_um == pytest.approx(24.0 / 31.0)
    np.testing.assert_allclose(psfs.centroid_um[0, 0], (0.4, -1.3), atol=1e-6)
    for changes, message in (
        ({"sample_y_um": None}, "'sample_y_um' must be given with the other coordinates"),
        ({"sample_x_um": x_um**3}, "'sample_x_um' must have equal steps"),
        (
            {"sample_y_um": 2.0 * y_um},
            "'sample_y_um' must have the steps of 'sample_x_um', 0.774194 µm, got 1.54839 µm",
        ),
        ({"sample_x_um": x_um + 50.0}, "'sample_x_um' and 'sample_y_um' must contain the image point"),
        ({"first_row": "highest"}, "'first_row' must be omitted with 'sample_x_um' and 'sample_y_um'"),
        ({"sample_x_um": x_um[:-1]}, "'sample_x_um' must have 32 values"),
    ):
        with pytest.raises(ParameterError, match=message):
            PSFGrid.from_arrays(psf, **{"sample_x_um": x_um, "sample_y_um": y_um, **ABOUT, **changes})


@pytest.mark.parametrize("name", ["lens.npz", "lens.fits"])
def test_files_keep_centre_and_pitches(tmp_path, name):
    waves_nm, pitches_um = [650.0, 450.0], [0.65, 0.45]
    psf = np.array([[spot(20, 22, 9.5, 11.2), spot(20, 22, 9.5, 11.2)]])
    about = {"x_um": 0.0, "y_um": 0.0, "wavelength_nm": waves_nm, "pitch_um": pitches_um}
    psfs = PSFGrid.from_arrays(psf, centre=(9.5, 11.2), **about)
    psfs.write(tmp_path / name)
    found = read_psfs(tmp_path / name)

    assert found.centre == pytest.approx(psfs.centre, abs=1e-12)
    np.testing.assert_allclose(found.pitches_um, [0.45, 0.65], rtol=1e-12)
    np.testing.assert_array_equal(found.psf, psfs.psf)
    np.testing.assert_allclose(found.centroid_um, psfs.centroid_um, atol=1e-12)
    np.testing.assert_allclose(psfs.centroid_um[0] / psfs.pitches_um[:, np.newaxis], [SPOT, SPOT], atol=4e-3)


def test_wavelengths_have_their_own_pitch():
    """The PSFs of an FFT have a pitch proportional to the wavelength."""
    waves_nm = (450.0, 550.0, 650.0)
    n, lens = 129, fs.Optics(focal_length_mm=8.0, f_number=4.0, zernike=fs.optics.Zernike(coefficients={7: 0.1}))
    pitches_um = [0.4e-3 * wave_nm * 4.0 for wave_nm in waves_nm]
    psf = [lens.psf(w, pitch_um=p, n_points=n).psf_per_um2 for w, p in zip(waves_nm, pitches_um, strict=True)]
    psfs = PSFGrid.from_arrays([psf], x_um=0.0, y_um=0.0, wavelength_nm=waves_nm, pitch_um=pitches_um)
    sampled = fs.Optics(focal_length_mm=8.0, f_number=4.0, psfs=psfs)

    f_per_mm = np.linspace(0.0, 380.0, 6)
    for wave_nm in waves_nm:
        np.testing.assert_allclose(sampled.mtf(f_per_mm, wave_nm), lens.mtf(f_per_mm, wave_nm), atol=6e-3)
        expected = lens.psf(wave_nm, pitch_um=0.3, n_points=21).psf_per_um2
        np.testing.assert_allclose(
            sampled.psf(wave_nm, pitch_um=0.3, n_points=21).psf_per_um2, expected, atol=8e-3 * expected.max()
        )
    between = sampled.otf(f_per_mm, 500.0)
    mean = 0.5 * (sampled.otf(f_per_mm, 450.0) + sampled.otf(f_per_mm, 550.0))
    np.testing.assert_allclose(between, mean, atol=1e-9)
    assert "samples of 0.72 to 1.04 µm" in repr(psfs)


# -- FITS images of other programs ------------------------------------------------------------------------------------


def write_fits(path, *images):
    """Write images; each is (values, keywords, name)."""
    hdus = []
    for values, keywords, name in images:
        kind = fits.ImageHDU if hdus else fits.PrimaryHDU
        header = fits.Header({**keywords, **({"EXTNAME": name} if name else {})})
        hdus.append(kind(values, header))
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


#: Keywords of POPPY: an image in arcseconds per pixel, and its wavelength in m.
POPPY = {"PIXELSCL": 0.5, "WAVELEN": 550e-9}


def test_fits_of_poppy_is_centred(tmp_path):
    path = write_fits(tmp_path / "psf.fits", (spot(32, 32, 15.5, 15.5), POPPY, ""))
    found = read_psfs(path, focal_length_mm=500.0)

    pitch_um = 500e3 * np.radians(0.5 / 3600.0)
    assert found.wavelength_nm.tolist() == pytest.approx([550.0])
    assert found.pitch_um == pytest.approx(pitch_um)
    np.testing.assert_allclose(found.centroid_um[0, 0], pitch_um * np.array(SPOT), atol=1e-4)
    with pytest.raises(FileError, match=r"has samples of 0\.5 arcsec, an angle; pass focal_length_mm=\.\.\.$"):
        read_psfs(path)


def test_fits_images_of_wavelengths_are_stacked(tmp_path):
    images = [
        (spot(n, n, 0.5 * (n - 1), 0.5 * (n - 1)), {"PIXELSCL": scale, "WAVELEN": wave_nm * 1e-9}, f"W{wave_nm}")
        for n, scale, wave_nm in ((32, 0.6, 600), (40, 0.5, 500))
    ]
    path = write_fits(tmp_path / "psf.fits", *images)
    found = read_psfs(path, focal_length_mm=500.0)

    np.testing.assert_allclose(found.wavelength_nm, [500.0, 600.0])
    np.testing.assert_allclose(found.pitches_um, 500e3 * np.radians(np.array([0.5, 0.6]) / 3600.0))
    np.testing.assert_allclose(found.centroid_um[0] / found.pitches_um[:, np.newaxis], [SPOT, SPOT], atol=1e-4)
    one = read_psfs(path, focal_length_mm=500.0, name="W600")
    assert one.psf.shape[-1] == 33


def test_fits_of_stpsf_requires_an_extension(tmp_path):
    keywords = {**POPPY, "NWAVES": 9}
    images = [
        (spot(36, 36, 17.5, 17.5), keywords, "OVERSAMP"),
        (spot(9, 9, 4, 4), {**keywords, "PIXELSCL": 2.0}, "DET_SAMP"),
    ]
    path = write_fits(tmp_path / "psf.fits", *images)
    options = {"focal_length_mm": 500.0}
    with pytest.raises(FileError, match=r"is the PSF of 9 wavelengths; pass wavelength_nm=\.\.\., the one for which"):
        read_psfs(path, **options)
    with pytest.raises(FileError, match=r"contains several PSFs at 560 nm; select one with name=, .*'OVERSAMP'"):
        read_psfs(path, wavelength_nm=560.0, **options)
    found = {name: read_psfs(path, wavelength_nm=560.0, name=name, **options) for name in ("OVERSAMP", "DET_SAMP")}
    assert [each.samples for each in found.values()] == ["points", "bins"]
    with pytest.raises(FileError, match="contains no image 'DET'"):
        read_psfs(path, name="DET", **options)


def test_fits_reference_pixel_is_the_image_point(tmp_path):
    linear = {"CTYPE1": "LINEAR", "CUNIT1": "um", "CDELT1": 0.5, "CTYPE2": "LINEAR", "CUNIT2": "um", "CDELT2": 0.5}
    values = spot(40, 40, 18.0, 21.0)
    options = {"wavelength_nm": WAVE_NM}
    path = write_fits(tmp_path / "psf.fits", (values, {**linear, "CRPIX1": 22.0, "CRPIX2": 19.0}, ""))
    np.testing.assert_allclose(read_psfs(path, **options).centroid_um[0, 0], 0.5 * np.array(SPOT), atol=1e-4)
    path = write_fits(tmp_path / "psf.fits", (values, {**linear, "CRVAL1": -11.0, "CRVAL2": -9.5}, ""))
    np.testing.assert_allclose(read_psfs(path, **options).centroid_um[0, 0], 0.5 * np.array(SPOT), atol=1e-4)
    # Without CRPIX, the reference pixel is 0, which is outside the array.
    path = write_fits(tmp_path / "psf.fits", (values, linear, ""))
    with pytest.raises(FileError, match="'centre' must be within the 40 x 40 samples"):
        read_psfs(path, **options)
    found = read_psfs(path, centre=(18.0, 21.0), **options)
    np.testing.assert_allclose(found.centroid_um[0, 0], 0.5 * np.array(SPOT), atol=1e-4)


def test_fits_cube_has_wavelengths_of_its_header(tmp_path):
    cube = np.array([spot(15, 15, 7, 7), spot(15, 15, 7, 7, radius=3.0)])
    waves = {"WAVELN00": 5e-7, "WAVELN01": 6e-7}
    found = read_psfs(write_fits(tmp_path / "psf.fits", (cube, {"XPIXSZ": 2.0, **waves}, "")))
    np.testing.assert_allclose(found.wavelength_nm, [500.0, 600.0])
    assert found.pitch_um == 2.0
    path = write_fits(tmp_path / "psf.fits", (cube, {"XPIXSZ": 2.0}, ""))
    with pytest.raises(FileError, match=r"does not specify the wavelength of each image; pass wavelength_nm="):
        read_psfs(path)
    np.testing.assert_allclose(read_psfs(path, wavelength_nm=[450.0, 650.0]).wavelength_nm, [450.0, 650.0])
    with pytest.raises(FileError, match="'wavelength_nm' must have 2 values, one per image, got 3"):
        read_psfs(path, wavelength_nm=[450.0, 650.0, 700.0])


def test_scaled_fits_integers_are_read(tmp_path):
    values = spot(15, 15, 7, 7)
    hdu = fits.PrimaryHDU(values.copy())
    hdu.scale("int16", bscale=1e-4, bzero=0.5)
    hdu.header.update({"XPIXSZ": 2.0, "WAVELEN": 550e-9})
    hdu.writeto(tmp_path / "psf.fits")
    found = read_psfs(tmp_path / "psf.fits")
    np.testing.assert_allclose(found.psf[0, 0], values / values.sum(), atol=1e-4 / values.sum())

    blank = fits.PrimaryHDU(np.where(values > 0.9, -1, 100 * values).astype(np.int16))
    blank.header.update({"XPIXSZ": 2.0, "WAVELEN": 550e-9, "BLANK": -1})
    blank.writeto(tmp_path / "blank.fits")
    with pytest.raises(FileError, match="'psf' must be finite"):
        read_psfs(tmp_path / "blank.fits")


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({}, "does not specify the pitch of its samples: it has no CDELT with a unit, PIXELSCL"),
        ({"PIXELSCL": -1.0}, "has the invalid value PIXELSCL = -1, expected a positive number"),
        ({"PIXELSCL": "fine"}, "has the invalid value PIXELSCL = 'fine', expected a finite number"),
        ({"PIXELSCL": 0.5, "PIXUNIT": "furlong"}, "has the unit PIXUNIT = 'furlong', expected an angle or a length"),
        ({"XPIXSZ": 2.0, "YPIXSZ": 3.0}, "has samples of 2 x 3, expected squares"),
        ({"XPIXSZ": 2.0, "BUNIT": "mag"}, "has values in BUNIT = 'mag', a logarithm"),
        ({"XPIXSZ": 2.0, "CPDIS1": "LOOKUP"}, "has distorted coordinates, CPDIS1 = 'LOOKUP'"),
        ({"XPIXSZ": 2.0, "A_ORDER": 3}, "has distorted coordinates, A_ORDER = 3"),
        ({"XPIXSZ": 2.0, "CTYPE1": "X---LOG"}, "has the coordinates CTYPE1 = 'X---LOG', which are not linear"),
        ({"CTYPE1": "RA---AIT", "CTYPE2": "DEC--AIT"}, "has the coordinates CTYPE1 = 'RA---AIT', which are not linear"),
        (
            {"CDELT1": 0.5, "CDELT2": 0.5, "CROTA2": 30.0, "CUNIT1": "um", "CUNIT2": "um"},
            "has rotated coordinate axes, CROTA2",
        ),
        ({"CD1_1": 0.5, "CD1_2": 0.1, "CD2_2": 0.5, "CUNIT1": "um"}, "has rotated coordinate axes"),
        ({"CDELT1": -0.5, "CDELT2": 0.5, "CUNIT1": "um", "CUNIT2": "um"}, "has coordinates that fall along an axis"),
        (
            {"CDELT1": 1e-4, "CDELT2": 1e-4, "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"},
            "has samples of 0.36 arcsec, an angle; pass focal_length_mm",
        ),
    ],
)
def test_fits_keywords_that_change_samples_are_reported(tmp_path, keywords, message):
    path = write_fits(tmp_path / "psf.fits", (spot(15, 15, 7, 7), {**keywords, "WAVELEN": 550e-9}, ""))
    with pytest.raises(FileError, match=message) as caught:
        read_psfs(path)
    assert "\n" not in str(caught.value)


def test_celestial_fits_needs_the_image_point(tmp_path):
    keywords = {"CDELT1": -1e-4, "CDELT2": 1e-4, "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "WAVELEN": 550e-9}
    path = write_fits(tmp_path / "psf.fits", (spot(15, 15, 7, 7), keywords, ""))
    with pytest.raises(
        FileError, match=r"has celestial coordinates, which do not say where the image point is; pass centre="
    ):
        read_psfs(path, focal_length_mm=1000.0)
    found = read_psfs(path, focal_length_mm=1000.0, centre="middle")
    assert found.pitch_um == pytest.approx(1e6 * np.radians(1e-4))
    np.testing.assert_allclose(found.centroid_um[0, 0] / found.pitch_um, SPOT, atol=0.06)


def test_options_of_other_formats_are_rejected(tmp_path):
    psfs = PSFGrid.from_arrays(spot(15, 15, 7, 7), pitch_um=1.0, **ABOUT)
    psfs.write(tmp_path / "lens.npz")
    psfs.write(tmp_path / "lens.fits")
    with pytest.raises(ParameterError, match="'focal_length_mm' is an option of FITS files only, got 8"):
        read_psfs(tmp_path / "lens.npz", focal_length_mm=8.0)
    with pytest.raises(FileError, match="'name' must be omitted for a stack, which contains it"):
        read_psfs(tmp_path / "lens.fits", name="OVERSAMP")


# -- text of Zemax ----------------------------------------------------------------------------------------------------


def listing(psf, centre, *, waves="0.5500 to 0.5500 µm", spacing="0.250 µm", form="{:.6E}"):
    n_y, n_x = psf.shape
    rows = "\n".join("\t".join(form.format(value) for value in row) for row in psf)
    return (
        f"Listing of Huygens PSF Data\n\nFile : C:\\lens.zmx\nTitle: centre of rotation\nDate : 11/27/2026\n\n"
        f"Polychromatic Huygens PSF\n{waves} at 0.0000 (deg).\nData spacing is {spacing}.\nData area is 10 µm wide.\n"
        f"Strehl ratio: 0.811\nPupil grid size: 32 by 32\nImage grid size: {n_x} by {n_y}\n{centre}"
        f"Center coordinates   : 0.00000000E+000, 1.00000000E+000 Millimeters\nValues are not normalized.\n\n{rows}\n"
    )


@pytest.mark.parametrize(
    ("shape", "text"),
    [
        ((40, 30), "Center point is: 21, 11\n"),
        ((20, 40), "Center point is: 21, 11\n"),
        ((40, 30), "Center point is: row 21, column 11\n"),
    ],
)
def test_older_headers_specify_the_centre(tmp_path, shape, text):
    """Row and column, unless only the other order lies in the grid."""
    row, column = (20, 10) if shape[0] > 21 else (10, 20)
    psf = spot(*shape, row, column)
    (tmp_path / "psf.txt").write_text(listing(psf, text), encoding="utf-8")
    found = read_psfs(tmp_path / "psf.txt")
    # Inverted, with the largest y first: x is mirrored, and y twice.
    np.testing.assert_allclose(found.centroid_um[0, 0], 0.25 * np.array([-SPOT[0], SPOT[1]]), atol=1e-3)


def test_decimal_commas_are_read(tmp_path):
    psf = spot(24, 24, 12, 11)
    commas = listing(psf, "Center point is: row 13, column 12\n", waves="0,5500 to 0,5500 µm", spacing="0,250 µm")
    body, values = commas.split("Values are")
    (tmp_path / "psf.txt").write_text(f"{body}Values are{values.replace('.', ',')}", encoding="utf-16")
    found = read_psfs(tmp_path / "psf.txt")
    assert (found.pitch_um, found.wavelength_nm[0]) == (0.25, 550.0)
    np.testing.assert_allclose(found.centroid_um[0, 0], 0.25 * np.array([-SPOT[0], SPOT[1]]), atol=1e-3)


def test_range_of_wavelengths_stands_for_one(tmp_path):
    path = tmp_path / "psf.txt"
    path.write_text(
        listing(spot(15, 15, 7, 7), "Center point is: 8, 8\n", waves="0.4861 to 0.6563 µm"), encoding="utf-8"
    )
    with pytest.raises(
        FileError, match=r"is the PSF of 0\.4861 to 0\.6563 µm; .* or pass wavelength_nm=\.\.\., the one for"
    ):
        read_psfs(path)
    assert read_psfs(path, wavelength_nm=550.0).wavelength_nm.tolist() == [550.0]
    with pytest.raises(FileError, match=r"is the PSF of 486\.1 to 656\.3 nm, but wavelength_nm= 700 nm"):
        read_psfs(path, wavelength_nm=700.0)


def test_index_has_a_pitch_for_each_wavelength(tmp_path):
    entries = []
    for wave_um, y_um in ((0.45, 0), (0.65, 0), (0.45, 500), (0.65, 500)):
        name = f"{wave_um}_{y_um}.txt"
        text = listing(spot(24, 24, 11.5, 11.5), "", waves=f"{wave_um} µm", spacing=f"{wave_um:.3f} µm")
        (tmp_path / name).write_text(text, encoding="utf-8")
        entries.append(f"  - {{file: {name}, x_um: 0.0, y_um: {y_um}, wavelength_nm: {1e3 * wave_um:g}}}\n")
    path = tmp_path / "lens.yaml"
    path.write_text("centre: middle\npsfs:\n" + "".join(entries), encoding="utf-8")
    found = read_psfs(path)

    np.testing.assert_allclose(found.pitches_um, [0.45, 0.65])
    expected = np.array([-SPOT[0], SPOT[1]]) * found.pitches_um[:, np.newaxis]
    np.testing.assert_allclose(found.centroid_um, np.broadcast_to(expected, (2, 2, 2)), atol=1e-3)
    path.write_text("psfs:\n" + "".join(entries), encoding="utf-8")
    with pytest.raises(FileError, match="has no line 'Center point is' in its header; pass centre="):
        read_psfs(path)
    path.write_text("centre: left\npsfs:\n" + "".join(entries), encoding="utf-8")
    with pytest.raises(
        FileError, match=r"must have two numbers \(row, column\), 'fft' or 'middle' as 'centre', got 'left'"
    ):
        read_psfs(path)


def test_corrupt_listings_give_one_sentence(tmp_path):
    """Any change of bytes gives PSFs or one sentence."""
    path, rng = tmp_path / "psf.txt", np.random.default_rng(5)
    good = listing(spot(9, 9, 4, 4), "Center point is: 5, 5\n").encode()
    for _ in range(examples(600)):
        content = bytearray(good)
        for at in rng.integers(0, 560, rng.integers(1, 4)):
            content[at] = rng.integers(256)
        path.write_bytes(bytes(content))
        with contextlib.suppress(fs.errors.FoveasimError):
            read_psfs(path)
