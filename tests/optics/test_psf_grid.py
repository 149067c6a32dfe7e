"""PSFs of other programs: formats, conventions, interpolation over the field, relative illumination, wrong files."""

from __future__ import annotations

import pickle
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import FileError, ParameterError, SamplingWarning
from foveasim.optics import IlluminationTable, LateralColour, PSFGrid, Seidel, _field_modes, read_psfs
from foveasim.optics.psfs import _npz

pytestmark = [
    pytest.mark.filterwarnings("ignore:the image of the scene is only"),
    pytest.mark.filterwarnings("ignore:approximately .* of the light of a point lies beyond"),
    pytest.mark.filterwarnings("ignore:the PSFs have samples of"),
]
WAVE_NM = 550.0
LENS = fs.Optics(
    focal_length_mm=8.0,
    f_number=4.0,
    padding="zero",
    padding_cells=40,
    precision="double",
    oversample=1,
    field_tolerance=0.002,
)
#: λN and the pitch of samples at half of it, for scenes at 1 m.
LAMBDA_N_UM = 1e-3 * WAVE_NM * LENS.working_f_number(1.0)
STEP_UM = 0.5 * LAMBDA_N_UM
SEIDEL = Seidel(coma_um=0.08, astigmatism_um=0.06, field_curvature_um=0.05, field_radius_um=60.0)
#: Formats by file name.
FILES = ("lens.npz", "lens.fits", "lens.yaml")


def scene_of(image, pitch_um=100.0, waves_nm=(WAVE_NM,)):
    image = np.asarray(image, float).reshape(-1, *np.shape(image)[-2:])
    waves_nm = np.array(waves_nm)
    return fs.Scene(image, np.ones((len(image), waves_nm.size)), waves_nm, np.ones(waves_nm.size), pitch_um, 1.0)


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    """PSFs of a lens at 5 x 5 points of the field instead of 9 x 9 or 17 x 17."""
    monkeypatch.setattr(_field_modes, "FIELD_POINTS", (5,))


def noise(shape=(36, 32), **options):
    return scene_of(np.random.default_rng(0).random(shape), **options)


def point(shape, row, column, **options):
    image = np.zeros(shape)
    image[row, column] = 1.0
    return scene_of(image, **options)


def sampled(lens, points_um, n=97, pitch_um=STEP_UM, waves_nm=(WAVE_NM,)):
    """Return the PSFs of a lens at points of the field, (n_point, n_wavelength, n, n)."""
    return np.array(
        [
            [
                lens.psf(wave_nm, distance_m=1.0, pitch_um=pitch_um, n_points=n, field_um=at).psf_per_um2
                for wave_nm in waves_nm
            ]
            for at in points_um
        ]
    )


def imported(lens, points_um, **options):
    psf = sampled(lens, points_um, **options)
    x_um, y_um = np.array(points_um).T
    waves_nm = options.get("waves_nm", (WAVE_NM,))
    return PSFGrid.from_arrays(
        psf, x_um=x_um, y_um=y_um, wavelength_nm=waves_nm, pitch_um=options.get("pitch_um", STEP_UM)
    )


def grid_points(lens, scene, n=6):
    x0_um, y0_um, x1_um, y1_um = lens.grid(scene).bounds_um
    return [(float(x), float(y)) for y in np.linspace(y0_um, y1_um, n) for x in np.linspace(x0_um, x1_um, n)]


def displaced(found, expected):
    """Return the fraction of light that is elsewhere."""
    return 0.5 * np.abs(found - expected).sum() / expected.sum()


def with_psfs(psfs, lens=LENS, **changes):
    return replace(lens, seidel=None, zernike=None, psfs=psfs, **changes)


def write_listing(path, psf, centre, pitch_um=STEP_UM, wavelength_nm=WAVE_NM, kind="FFT", encoding="utf-16"):
    """Write PSFs (rows of the projected image, largest y first) as OpticStudio does."""
    n_y, n_x = psf.shape
    wave_um = 1e-3 * wavelength_nm
    lines = [
        f"Listing of {kind} PSF Data", "", "File : C:\\lens.zmx", "Title: ", "Date : 11/27/2026", "",
        f"Polychromatic {kind} PSF", f"{wave_um:.4f} to {wave_um:.4f} µm at 0.0000, 4.0000 (deg).",
        f"Data spacing is {pitch_um:.9f} µm.", f"Data area is {n_x * pitch_um:.3f} µm wide.", "Surface: Image",
        "Reference Coordinates: 0.0000E+000, 0.0000E+000", f"Pupil grid size: {n_x // 2} by {n_y // 2}",
        f"Image grid size: {n_x} by {n_y}", f"Center point is: row {centre[0] + 1}, column {centre[1] + 1}",
        "Values are not normalized.", "",
    ]  # fmt: skip
    rows = ["\t".join(f"{value:.9E}" for value in row) for row in psf]
    path.write_text("\n".join([*lines, *rows]) + "\n", encoding=encoding)


def write_as(path, psf, x_um, y_um):
    """Write an even-sized PSF, upright with the lowest row first, in the conventions of each format."""
    n = psf.shape[0]
    if path.suffix == ".yaml":
        # The projected image, largest y first: columns are reversed.
        write_listing(path.with_name("point.txt"), psf[:, ::-1], (n // 2, n - 1 - n // 2))
        path.write_text(
            f"psfs:\n  - {{file: point.txt, x_um: {-x_um}, y_um: {-y_um}, wavelength_nm: 550.0}}\n", encoding="utf-8"
        )
    else:
        about = {"x_um": x_um, "y_um": y_um, "wavelength_nm": WAVE_NM, "pitch_um": STEP_UM}
        PSFGrid.from_arrays(psf, centre="fft", **about).write(path)
    return read_psfs(path)


# -- conventions ------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", FILES)
def test_airy_psf_equals_clear_circle(tmp_path, name):
    n = 840
    psf = LENS.psf(WAVE_NM, distance_m=1.0, pitch_um=STEP_UM, n_points=n + 1).psf_per_um2[:n, :n]
    psfs = write_as(tmp_path / name, psf, 0.0, 0.0)
    scene = point((99, 101), 49, 50, pitch_um=122.0)
    expected = LENS.power_map(scene).data

    found = with_psfs(psfs).power_map(scene).data
    np.testing.assert_allclose(found, expected, atol=1e-3 * expected.max())
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)


def test_wrong_centre_displaces_light():
    n = 64
    psf = LENS.psf(WAVE_NM, distance_m=1.0, pitch_um=STEP_UM, n_points=n + 1).psf_per_um2[:n, :n]
    about = {"x_um": 0.0, "y_um": 0.0, "wavelength_nm": WAVE_NM, "pitch_um": STEP_UM}
    scene = point((61, 61), 30, 30, pitch_um=122.0)
    right = with_psfs(PSFGrid.from_arrays(psf, centre="fft", **about)).power_map(scene).data
    wrong = with_psfs(PSFGrid.from_arrays(psf, centre=(31, 32), **about)).power_map(scene).data

    assert displaced(right, LENS.power_map(scene).data) < 0.03
    assert displaced(wrong, LENS.power_map(scene).data) > 0.2


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", FILES)
def test_coma_lands_in_its_quadrant(tmp_path, name):
    lens = replace(LENS, seidel=Seidel(coma_um=0.5, field_radius_um=60.0))
    at_um = (60.0 * np.cos(np.pi / 6), 60.0 * np.sin(np.pi / 6))
    n = 256
    psf = lens.psf(WAVE_NM, distance_m=1.0, pitch_um=STEP_UM, n_points=n + 1, field_um=at_um).psf_per_um2[:n, :n]
    psfs = write_as(tmp_path / name, psf, *at_um)
    assert (psfs.x_um[0], psfs.y_um[0]) == pytest.approx(at_um)
    assert np.all(psfs.centroid_um > 0.0)

    scene = point((81, 81), 40, 40)

    # The aberrations of this point everywhere.
    def pupil(x, y, wave_nm):
        return np.exp(2j * np.pi * lens.seidel.wavefront_um(x, y, wave_nm, at_um) / (1e-3 * wave_nm))

    expected = replace(LENS, pupil=pupil).power_map(scene).data
    assert displaced(with_psfs(psfs).power_map(scene).data, expected) < 0.01
    for mirrored in (psfs.psf[..., ::-1], psfs.psf[..., ::-1, :], psfs.psf.swapaxes(2, 3)):
        wrong = with_psfs(replace(psfs, psf=mirrored)).power_map(scene).data
        assert displaced(wrong, expected) > 0.4


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("kind", ["grid", "radius"])
def test_turning_everything_changes_nothing(kind):
    lens, scene = replace(LENS, seidel=SEIDEL), noise()
    if kind == "grid":
        psfs = imported(lens, grid_points(lens, scene, 3), n=65)
        turned = PSFGrid.from_arrays(
            psfs.psf, x_um=psfs.x_um, y_um=psfs.y_um, wavelength_nm=WAVE_NM, pitch_um=STEP_UM, image="inverted"
        )
        turned_twice = replace(psfs, psf=psfs.psf[..., ::-1, ::-1], x_um=-psfs.x_um, y_um=-psfs.y_um)
        np.testing.assert_array_equal(turned.psf, turned_twice.psf)
    else:
        psfs = imported(lens, [(0.3 * r, 0.1 * r) for r in (0.0, 60.0, 120.0)], n=65)
        turned = replace(psfs, psf=psfs.psf[..., ::-1, ::-1], x_um=-psfs.x_um, y_um=-psfs.y_um)
    one = with_psfs(psfs).power_map(scene).data
    other = with_psfs(turned).power_map(scene_of(scene.basis[:, ::-1, ::-1])).data

    np.testing.assert_allclose(other[:, ::-1, ::-1], one, atol=1e-6 * one.max())


def test_first_row_and_image_of_arrays():
    psf = np.random.default_rng(3).random((7, 5))
    about = {"wavelength_nm": WAVE_NM, "pitch_um": 1.0, "x_um": 3.0, "y_um": 4.0}
    one = PSFGrid.from_arrays(psf, **about)

    assert np.array_equal(PSFGrid.from_arrays(psf[::-1], first_row="highest", **about).psf, one.psf)
    inverted = PSFGrid.from_arrays(psf[::-1, ::-1], image="inverted", **about)
    assert np.array_equal(inverted.psf, one.psf)
    assert (inverted.x_um[0], inverted.y_um[0]) == (-3.0, -4.0)
    even = PSFGrid.from_arrays(psf[:, :4], centre=(3, 1), **about)
    assert even.psf.shape == (1, 1, 7, 5)
    assert not even.psf[..., 0].any()


def test_bins_are_divided_by_their_width():
    fine, factor = 5, 1.0 * LAMBDA_N_UM / 2.0
    n = 41
    about = {"x_um": 0.0, "y_um": 0.0, "wavelength_nm": WAVE_NM}
    at = (np.arange(n * fine) - (n * fine) // 2) * factor / fine
    spot = np.exp(-0.5 * (np.hypot(at[:, np.newaxis] - 0.7, at + 0.4) / 2.5) ** 2)
    counts = spot.reshape(n, fine, n, fine).sum(axis=(1, 3))
    scene = noise()
    expected = with_psfs(PSFGrid.from_arrays(spot, pitch_um=factor / fine, **about)).power_map(scene).data
    errors = [
        np.abs(
            with_psfs(PSFGrid.from_arrays(counts, pitch_um=factor, samples=samples, **about)).power_map(scene).data
            - expected
        )
        for samples in ("bins", "points")
    ]

    assert errors[0].max() < 2e-4 * expected.max()
    assert errors[1].max() > 10.0 * errors[0].max()


# -- over the field ---------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("kind", "options", "changes"),
    [
        ("grid", {}, {}),
        ("radius", {}, {}),
        ("grid", {}, {"oversample": 2, "padding": "reflect"}),
        ("radius", {}, {"oversample": 3, "padding": "edge", "source_pixel": "square"}),
        ("grid", {"pitch_um": 600.0}, {"seidel": replace(SEIDEL, field_radius_um=300.0)}),
        ("radius", {}, {"field_patches": 5}),
    ],
)
def test_samples_of_lens_give_its_maps(kind, options, changes):
    scene, lens = noise(**options), replace(LENS, **{"seidel": SEIDEL, **changes})
    if kind == "grid":
        psfs = imported(lens, grid_points(lens, scene))
    else:
        corner_um = float(np.hypot(*lens.grid(scene).bounds_um[2:]))
        psfs = imported(lens, [(r * np.cos(0.4), r * np.sin(0.4)) for r in np.linspace(0.0, corner_um, 6)])
        assert psfs.is_radial
    expected = lens.power_map(scene).data
    found = with_psfs(psfs, lens).power_map(scene).data

    # The window contains 99.2 % of the light.
    assert displaced(found, expected) < 0.004
    assert found.sum() == pytest.approx(expected.sum(), rel=8e-3)


@pytest.mark.slow
def test_point_images_follow_from_samples():
    lens = replace(LENS, seidel=SEIDEL)
    psfs = imported(lens, grid_points(lens, noise(), 5), n=161)
    found, at = with_psfs(psfs), {"distance_m": 1.0, "field_um": (12.0, -9.0)}
    peak = lens.psf(WAVE_NM, **at).psf_per_um2.max()

    np.testing.assert_allclose(
        found.psf(WAVE_NM, **at).psf_per_um2, lens.psf(WAVE_NM, **at).psf_per_um2, atol=0.01 * peak
    )
    f_per_mm = np.linspace(0.0, 500.0, 6)
    otf = [each.otf(f_per_mm, WAVE_NM, angle_deg=30.0, **at) for each in (found, lens)]
    np.testing.assert_allclose(*otf, atol=0.008)
    assert found.strehl(WAVE_NM, **at) == pytest.approx(lens.strehl(WAVE_NM, **at), abs=0.01)
    energy = [each.encircled_energy([2.0, 5.0], WAVE_NM, **at) for each in (found, lens)]
    np.testing.assert_allclose(*energy, atol=0.008)


@pytest.mark.slow
def test_wavelengths_are_interpolated(monkeypatch):
    monkeypatch.setattr(_field_modes, "FIELD_POINTS", (3,))
    lens = replace(LENS, seidel=SEIDEL)
    points_um = [(0.0, 0.0), (0.0, 25.0), (0.0, 50.0)]
    psfs = imported(lens, points_um, waves_nm=(500.0, 600.0), n=129, pitch_um=0.9 * STEP_UM)
    waves_nm = (450.0, 500.0, 525.0, 600.0, 700.0)
    maps = with_psfs(psfs).power_map(noise((24, 20), waves_nm=waves_nm)).data

    middle = np.diff(maps[[1, 2, 3]], axis=0)
    np.testing.assert_allclose(3.0 * middle[0], middle[1], atol=5e-3 * np.abs(maps).max())
    expected = lens.power_map(noise((24, 20), waves_nm=waves_nm[1::2])).data
    assert displaced(maps[1], expected[0]) < 0.006
    assert displaced(maps[3], expected[1]) < 0.006


def test_positions_beyond_points_have_the_nearest_psf():
    lens = replace(LENS, seidel=SEIDEL)
    psfs = imported(lens, [(x, y) for y in (-5.0, 5.0) for x in (-5.0, 5.0)], n=65)
    one, other = (
        with_psfs(psfs).psf(WAVE_NM, distance_m=1.0, field_um=at).psf_per_um2 for at in ((5.0, 5.0), (80.0, 70.0))
    )

    np.testing.assert_allclose(one, other, atol=1e-12)


def test_uneven_points_do_not_overshoot():
    sizes = (3.0, 3.0, 3.5, 5.0, 8.0)
    spots = [np.exp(-0.5 * np.square(np.hypot(*np.mgrid[-24:25, -24:25]) / size)) for size in sizes]
    heights_um = [0.0, 2000.0, 2800.0, 3000.0, 3100.0]
    fraction = [1.0, 1.0, 0.9, 0.2, 0.01]
    psfs = PSFGrid.from_arrays(
        spots, x_um=heights_um, y_um=np.zeros(5), wavelength_nm=WAVE_NM, pitch_um=1.0, relative_illumination=fraction
    )
    lens = with_psfs(psfs)
    found, nearest = (lens.psf(WAVE_NM, distance_m=1.0, field_um=(x_um, 0.0)).psf_per_um2 for x_um in (1000.0, 2000.0))
    np.testing.assert_allclose(found, nearest, atol=1e-6 * nearest.max())
    at_um = np.column_stack((np.linspace(0.0, 3200.0, 100), np.zeros(100)))
    light = lens.aperture(noise()).illumination(at_um)
    assert 0.0 <= light.min() < light.max() <= 1.0


def test_cubic_illumination_is_interpolated_exactly():
    heights_um = np.linspace(0.0, 3000.0, 6)
    spot = np.exp(-0.5 * np.square(np.hypot(*np.mgrid[-16:17, -16:17]) / 3.0))
    psfs = PSFGrid.from_arrays(
        [spot] * 6, x_um=heights_um, y_um=np.zeros(6), wavelength_nm=WAVE_NM, pitch_um=1.0,
        relative_illumination=1.0 - 0.5 * (heights_um / 3000.0) ** 3,
    )  # fmt: skip
    between_um = np.array([200.0, 1000.0, 2500.0])
    found = with_psfs(psfs).aperture(noise()).illumination(np.column_stack((between_um, np.zeros(3))))

    np.testing.assert_allclose(found, 1.0 - 0.5 * (between_um / 3000.0) ** 3, rtol=1e-6)


def test_turned_windows_are_not_cut_off():
    y, x = np.mgrid[-32:33, -8:9]
    spot = np.exp(-0.5 * (np.square(y / 10.0) + np.square(x / 2.0)))
    psfs = PSFGrid.from_arrays([spot, spot], x_um=[0.0, 0.0], y_um=[0.0, 500.0], wavelength_nm=WAVE_NM, pitch_um=1.0)
    lens = with_psfs(psfs)
    one, other = (
        lens.psf(WAVE_NM, distance_m=1.0, field_um=at_um, pitch_um=1.0, n_points=65).psf_per_um2
        for at_um in ((0.0, 500.0), (500.0, 0.0))
    )
    np.testing.assert_allclose(other, one.T, atol=2e-3 * one.max())


def test_point_images_have_unit_power():
    fraction = np.array([[1.0, 1.0], [0.9, 0.5]])
    spot = np.exp(-0.5 * np.square(np.hypot(*np.mgrid[-16:17, -16:17]) / 3.0))
    psfs = PSFGrid.from_arrays(
        np.broadcast_to(spot, (2, 2, 33, 33)), x_um=[0.0, 0.0], y_um=[0.0, 500.0], wavelength_nm=[450.0, 650.0],
        pitch_um=0.8, relative_illumination=fraction,
    )  # fmt: skip
    lens = with_psfs(psfs)
    for wave_nm in (450.0, 650.0):
        assert lens.mtf([0.0], wave_nm, field_um=(0.0, 500.0))[0] == pytest.approx(1.0, rel=1e-9)
    assert float(lens.encircled_energy([20.0], 450.0, field_um=(0.0, 500.0))[0]) == pytest.approx(1.0, abs=5e-3)
    with pytest.raises(ParameterError, match=r"'pitch_um' times \(n_points - 1\) / 2 must be at most"):
        lens.psf(550.0, pitch_um=50.0, n_points=1025)


def test_wavelength_may_be_dark_at_a_point():
    spot = np.exp(-0.5 * np.square(np.hypot(*np.mgrid[-16:17, -16:17]) / 3.0))
    psfs = PSFGrid.from_arrays(
        np.broadcast_to(spot, (4, 2, 33, 33)), x_um=[-25.0, 25.0, -25.0, 25.0], y_um=[-25.0, -25.0, 25.0, 25.0],
        wavelength_nm=[500.0, 600.0], pitch_um=0.8, relative_illumination=[[1.0, 1.0], [1.0, 0.0]] * 2,
    )  # fmt: skip
    flat = scene_of(np.ones((60, 54)), waves_nm=(500.0, 600.0))
    one, other = with_psfs(psfs, padding="edge", field_tolerance=0.01).power_map(flat).data

    np.testing.assert_allclose(one[30, 10:-10], one[30, 27], rtol=0.02)
    assert (np.diff(other[30, 10:-10]) < 0.0).all()


def test_steep_vignetting_gives_no_negative_light():
    table = IlluminationTable(image_height_um=(0.0, 20.0, 20.5), fraction=(1.0, 1.0, 0.0))
    lens = replace(LENS, relative_illumination=table, padding="edge")
    found = lens.power_map(scene_of(np.ones((60, 54)))).data

    assert found.min() >= -1e-9 * found.max()
    assert found.max() <= 1.001 * found[0, 27, 30]


def test_one_psf_is_that_of_the_field():
    rng = np.random.default_rng(5)
    mask = np.where(rng.random((11, 11)) < 0.2, 1.0, 0.0)
    psfs = PSFGrid.from_arrays(mask, x_um=9.0, y_um=0.0, wavelength_nm=WAVE_NM, pitch_um=3.0, samples="points")
    lens = with_psfs(psfs, f_number=1.5)
    assert not lens.is_varying
    assert lens.field_error(noise()) == 0.0
    one, other = (lens.power_map(point((81, 81), row, 40)).data[0] for row in (40, 45))

    np.testing.assert_allclose(other[5:], one[:-5], rtol=0.02, atol=0.02 * one.max())


@pytest.mark.slow
def test_lateral_colour_scales_images():
    colours = LateralColour(wavelength_nm=(500.0, 600.0), magnification=(0.98, 1.0))
    lens, scene = replace(LENS, seidel=SEIDEL, lateral_colour=colours), noise(waves_nm=(500.0, 600.0))
    psfs = imported(lens, grid_points(lens, scene, 4), waves_nm=(500.0, 600.0), pitch_um=0.9 * STEP_UM)

    assert displaced(with_psfs(psfs, lens).power_map(scene).data, lens.power_map(scene).data) < 0.005


# -- relative illumination --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_relative_illumination_of_one_is_none():
    lens = replace(LENS, seidel=SEIDEL)
    psfs = imported(lens, grid_points(lens, noise(), 3), n=33)
    ones = replace(psfs, relative_illumination=np.ones((9, 1)))
    table = IlluminationTable(image_height_um=(0.0, 1000.0), fraction=(1.0, 1.0))
    scene = noise()
    found = with_psfs(ones).power_map(scene).data

    np.testing.assert_array_equal(found, with_psfs(psfs, relative_illumination=table).power_map(scene).data)
    # The field is small, so that the cosine of the lens is close to 1.
    cosine = with_psfs(psfs).power_map(scene).data
    assert (cosine < found).all()
    np.testing.assert_allclose(cosine, found, rtol=1e-4)


def test_table_of_the_cosine_law_gives_it():
    scene = scene_of(np.ones((40, 60)), pitch_um=20000.0)
    corner_um = float(np.hypot(*LENS.grid(scene).bounds_um[2:]))
    height_um = np.linspace(0.0, corner_um, 60)
    cos2 = 1.0 / (1.0 + np.square(height_um / (1e3 * LENS.focal_length_mm / (1.0 - 0.008))))
    table = IlluminationTable(image_height_um=tuple(height_um), fraction=tuple(np.square(cos2)))
    lens = replace(LENS, source_pixel="square", padding="edge")
    expected = lens.power_map(scene).data
    assert expected.min() < 0.8 * expected.max()

    np.testing.assert_allclose(replace(lens, relative_illumination=table).power_map(scene).data, expected, rtol=3e-4)


@pytest.mark.slow
def test_relative_illumination_weighs_the_source():
    lens, scene = LENS, scene_of(np.ones((60, 60)))
    points_um = grid_points(lens, scene, 3)
    fraction = np.array([[1.0 - 0.003 * x - 0.001 * y, 1.0 - 0.005 * x - 0.001 * y] for x, y in points_um])
    waves_nm = (500.0, 600.0)
    psfs = replace(imported(lens, points_um, waves_nm=waves_nm, pitch_um=0.9 * STEP_UM), relative_illumination=fraction)
    found = with_psfs(psfs, padding="reflect", field_tolerance=0.01).power_map(noise(waves_nm=waves_nm))
    flat = with_psfs(psfs, padding="reflect").power_map(scene_of(np.ones((60, 60)), waves_nm=waves_nm))
    x_um, y_um = (each[10:-10] for each in (flat.grid.x_um, flat.grid.y_um))

    for wave, slope in enumerate((0.003, 0.005)):
        expected = 1.0 - slope * x_um - 0.001 * y_um[:, np.newaxis]
        ratio = flat.data[wave, 10:-10, 10:-10] / expected
        assert np.ptp(ratio) < 0.01 * ratio.mean()
    assert np.isfinite(found.data).all()


# -- compositions -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def camera():
    lens = replace(LENS, seidel=SEIDEL, precision="single")
    psfs = replace(
        imported(lens, grid_points(lens, noise(), 3), n=65),
        relative_illumination=np.linspace(0.8, 1.0, 9)[:, np.newaxis],
    )
    layout = fs.layout.grid(n_x=16, n_y=16, pitch_um=1.5)
    return fs.Camera(optics=with_psfs(psfs, lens), sensor=fs.Sensor(layout, capacitance_f=1e-13))


@pytest.mark.filterwarnings("ignore::foveasim.errors.CoverageWarning")
def test_tiles_equal_captures(camera):
    scene = noise()
    whole = camera.capture(scene, exposure_s=10.0, seed=1)
    tiles = list(fs.tiles.capture_tiles(camera, scene, exposure_s=10.0, seed=1, tile_sites=1))

    np.testing.assert_array_equal(np.concatenate([tile.code for tile in tiles]), whole.code)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::foveasim.errors.CoverageWarning")
def test_lenses_are_pickled_and_shared_by_threads(camera):
    scene = noise()
    expected = camera.photoelectrons_per_s(scene)
    again = pickle.loads(pickle.dumps(camera))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: again.photoelectrons_per_s(scene), range(8)))

    for each in found:
        np.testing.assert_allclose(each, expected, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::foveasim.errors.CoverageWarning")
def test_gaze_moves_the_sensor_over_the_field(camera):
    scene, gaze_um = noise(), (6.0, -4.5)
    power_map = camera.power_map(scene)
    np.testing.assert_allclose(
        camera.with_gaze(gaze_um).photoelectrons_per_s(scene),
        camera.replace().with_gaze(gaze_um).photoelectrons_per_s(power_map),
        rtol=0.05,
    )


@pytest.mark.parametrize("name", ["lens.npz", "lens.fits"])
def test_settings_name_a_file(tmp_path, name):
    lens = replace(LENS, seidel=SEIDEL)
    imported(lens, grid_points(lens, noise(), 3), n=33).write(tmp_path / name)
    (tmp_path / "shot.yaml").write_text(
        "scene: {kind: flat, shape: [100, 100], pitch_um: 100.0, distance_m: 1.0, illuminance_lux: 100.0}\n"
        f"optics: {{focal_length_mm: 8.0, f_number: 4.0, psfs: {{path: {name}}}}}\n"
        "layout: {generator: grid, parameters: {n_x: 20, n_y: 20, pitch_um: 2.0}}\nexposure_s: 0.01\n",
        encoding="utf-8",
    )
    shot = fs.config.read_shot(tmp_path / "shot.yaml")
    assert shot.camera.optics.psfs.x_um.size == 9
    source = fs.config.to_python(fs.config.read_settings(tmp_path / "shot.yaml"), source=tmp_path / "shot.yaml")
    assert "read_psfs(" in source
    (tmp_path / "shot.yaml").write_text(
        (tmp_path / "shot.yaml").read_text(encoding="utf-8").replace(name, "missing.npz"), encoding="utf-8"
    )
    with pytest.raises(fs.errors.FoveasimError, match=r"missing\.npz"):
        fs.config.read_shot(tmp_path / "shot.yaml")


# -- wrong input ------------------------------------------------------------------------------------------------------

GOOD = {"psf": np.pad(np.ones((3, 1, 3, 3)), ((0, 0), (0, 0), (3, 3), (3, 3))), "x_um": [0.0, 0.0, 0.0], "y_um": [0.0, 1.0, 2.0],
        "wavelength_nm": [550.0], "pitch_um": 1.0}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"psf": np.ones((3, 2, 9, 9))}, r"'wavelength_nm' must have 2 values, one per PSF, got 1"),
        ({"psf": np.ones((2, 1, 9, 9))}, r"'x_um' and 'y_um' must have 2 values, one per PSF, got 3 and 3"),
        ({"psf": np.ones(9)}, r"'psf' must have the shape \(n_point, n_wavelength, n_y, n_x\), got \(9,\)"),
        ({"psf": np.full((3, 1, 9, 9), np.nan)}, r"'psf' must be finite; the one at \(0, 0\) µm and 550 nm is not"),
        ({"psf": -GOOD["psf"]}, r"'psf' must have a positive sum; the one at \(0, 0\) µm and 550 nm does not have one"),
        ({"psf": GOOD["psf"].astype(complex)}, r"'psf' must be an array of numbers"),
        ({"y_um": [0.0, 1.0, 1.0]}, r"must be different for all points, got \(0, 1\) µm at \[1\] and \[2\]"),
        ({"x_um": [0.0, 1.0, 1.0]}, r"must form a rectangular grid, or lie on one radius, got 3 points"),
        ({"wavelength_nm": [5.5]}, r"'wavelength_nm' must be from 10 to 1e\+06, got \[5.5\] nm"),
        ({"pitch_um": -1.0}, r"'pitch_um' must be > 0"),
        ({"pitch_um": 1e9}, r"'pitch_um' must be <= "),
        ({"relative_illumination": [1.0, 0.9]}, r"must have the shape \(n_point, n_wavelength\) = \(3, 1\), got \(2,"),
        ({"relative_illumination": [1.0, 0.9, -0.1]}, r"'relative_illumination' must be >= 0"),
        ({"centre": (9, 0)}, r"'centre' must be within the 9 x 9 samples"),
        ({"centre": "left"}, "'centre' must be two numbers"),
        ({"psf": np.ones((3, 8, 9))}, "'centre' must be given for even numbers of samples, got 8 x 9; pass 'fft'"),
        ({"pitch_um": None}, "'pitch_um' must be given, or 'sample_x_um' and 'sample_y_um'"),
        ({"pitch_um": [1.0, 2.0]}, "'pitch_um' must have one value, or one per wavelength, 1, got 2"),
        ({"sample_x_um": np.arange(9.0)}, "'pitch_um' must be omitted with 'sample_x_um'"),
        ({"image": "mirrored"}, r"'image' must be one of 'upright', 'inverted', got 'mirrored'"),
    ],
)
def test_wrong_arrays_are_rejected(changes, message):
    with pytest.raises(ParameterError, match=message):
        PSFGrid.from_arrays(**{**GOOD, **changes})


def test_lens_rejects_pupils_with_psfs():
    psfs = PSFGrid.from_arrays(**GOOD)
    with pytest.raises(ParameterError, match="'seidel' must not be given with 'psfs', which contain it"):
        replace(LENS, psfs=psfs, seidel=SEIDEL)
    lit = replace(psfs, relative_illumination=np.ones((3, 1)))
    table = IlluminationTable(image_height_um=(0.0, 1.0), fraction=(1.0, 0.5))
    with pytest.raises(ParameterError, match="'relative_illumination' must not be given with that of 'psfs'"):
        replace(LENS, psfs=lit, relative_illumination=table)
    with pytest.raises(ParameterError, match=r"'fraction' must be 1 on the axis, got 0\.5"):
        IlluminationTable(image_height_um=(0.0, 1.0), fraction=(0.5, 0.4))
    with pytest.raises(ParameterError, match="'fraction' must have one value for each of the 2 heights, got 1"):
        IlluminationTable(image_height_um=(0.0, 1.0), fraction=(1.0,))


def test_wide_psf_is_rejected_with_its_limit():
    ring = np.hypot(*np.mgrid[-300:301, -300:301])
    psfs = PSFGrid.from_arrays(np.abs(ring - 290.0) < 2.0, x_um=0.0, y_um=0.0, wavelength_nm=WAVE_NM, pitch_um=2.0)
    with pytest.raises(
        ParameterError, match=r"'psfs' must spread 95% of the light over a radius of at most 128 λN or 256 samples"
    ):
        with_psfs(psfs).power_map(noise())


@pytest.mark.filterwarnings("error")
def test_coarse_samples_cause_warning():
    psfs = PSFGrid.from_arrays(**GOOD)
    with pytest.warns(
        SamplingWarning, match=r"the PSFs have samples of 1 µm, coarser than λN/2 = 0\.55 µm at 550 nm and f/2"
    ):
        replace(LENS, f_number=2.0, psfs=psfs).psf(WAVE_NM)
    replace(LENS, f_number=4.0, psfs=psfs).psf(WAVE_NM)


@pytest.mark.filterwarnings("error")
def test_light_beyond_the_window_causes_warning():
    psf = LENS.psf(WAVE_NM, distance_m=1.0, pitch_um=STEP_UM, n_points=15).psf_per_um2
    with pytest.warns(
        SamplingWarning, match=r"approximately \d+% of the light of a point lies beyond the window of its PSF"
    ):
        PSFGrid.from_arrays(psf, x_um=0.0, y_um=0.0, wavelength_nm=WAVE_NM, pitch_um=STEP_UM)
    for n in (31, 63, 127):
        wide = LENS.psf(WAVE_NM, distance_m=1.0, pitch_um=STEP_UM, n_points=n).psf_per_um2
        psfs = PSFGrid.from_arrays(wide, x_um=0.0, y_um=0.0, wavelength_nm=WAVE_NM, pitch_um=STEP_UM)
        beyond = 1.0 - float(LENS.ensquared_energy(n * STEP_UM, WAVE_NM, distance_m=1.0))
        assert float(psfs.beyond_fraction[0, 0]) == pytest.approx(beyond, rel=0.35)


def npz_with(path, **changes):
    np.savez(path, **{name: value for name, value in {**GOOD, **changes}.items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pitch_um": None}, "has no 'pitch_um', which files of PSFs must contain"),
        ({"extra": [1.0]}, "has the unknown array 'extra'; expected psf, x_um"),
        ({"pitch_um": [1.0, 2.0]}, "'pitch_um' must have one value, or one per wavelength, 1, got 2"),
        ({"image": "inverse"}, "must have 'upright' or 'inverted' as 'image', got 'inverse'; did you mean 'inverted'"),
        ({"centre": [0.5, 1.0, 2.0]}, r"must have two numbers \(row, column\), 'fft' or 'middle' as 'centre'"),
        ({"y_um": [0.0, 1.0, 1.0]}, "must be different for all points"),
        ({"psf": np.full((3, 1, 9, 9), np.inf)}, "'psf' must be finite"),
        ({"psf": np.array([None, 1.0], object)}, "an array of Python objects"),
    ],
)
def test_wrong_npz_files_are_rejected(tmp_path, changes, message):
    path = tmp_path / "lens.npz"
    npz_with(path, **changes)
    with pytest.raises(FileError, match=message) as caught:
        read_psfs(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_conventions_of_npz_files_are_applied(tmp_path):
    rng = np.random.default_rng(7)
    psf = rng.random((3, 1, 8, 8))
    options = {"image": "inverted", "first_row": "highest", "samples": "bins", "centre": np.array([3, 4])}
    npz_with(tmp_path / "lens.npz", psf=psf, **options)
    found = read_psfs(tmp_path / "lens.npz")
    expected = PSFGrid.from_arrays(**{**GOOD, "psf": psf, **options, "centre": (3, 4)})

    np.testing.assert_array_equal(found.psf, expected.psf)
    assert found.samples == "bins"
    np.testing.assert_array_equal(found.y_um, [0.0, -1.0, -2.0])


def test_malformed_archives_are_rejected(tmp_path, monkeypatch):
    monkeypatch.setattr(_npz, "MAX_VALUES", 2**17)
    path = tmp_path / "lens.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("psf.npy", "w", force_zip64=True) as file,
    ):
        file.write(bytes(2**20 + 1))
    with pytest.raises(FileError, match="would decompress to more than"):
        read_psfs(path)
    npz_with(path, psf=np.pad(np.ones((3, 1, 3, 3)), ((0, 0), (0, 0), (90, 90), (90, 90))))
    assert read_psfs(path).psf.shape == (3, 1, 183, 183)
    path.write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(FileError, match="is corrupt or not a valid file of PSFs"):
        read_psfs(path)


def test_wrong_fits_files_are_rejected(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    path = tmp_path / "lens.fits"
    psfs = PSFGrid.from_arrays(**GOOD)

    def change(edit):
        psfs.write(path)
        with fits.open(path) as file:
            hdus = [each.copy() for each in file]
        edit(hdus)
        fits.HDUList(hdus).writeto(path, overwrite=True)

    for edit, message in (
        (lambda h: h[0].header.remove("PITCH_UM"), "has no 'PITCH_UM', which files of PSFs must contain"),
        (lambda h: h[0].header.set("PITCH_UM", "wide"), "has the invalid value PITCH_UM = 'wide', expected a number"),
        (lambda h: h[0].header.set("IMAGE", "turned"), "must have 'upright' or 'inverted' as 'image', got 'turned'"),
        (lambda h: h.pop(1), "has no table 'POINTS' with the columns x_um, y_um"),
        (lambda h: h.pop(2), "has no table 'WAVELENGTHS' with the columns wavelength_nm"),
        (lambda h: h[1].columns.change_name("x_um", "x"), "has no 'x_um', which files of PSFs must contain"),
        (lambda h: h.__setitem__(0, fits.PrimaryHDU(header=h[0].header)), "contains no image"),
    ):
        change(edit)
        with pytest.raises(FileError, match=message):
            read_psfs(path)
    psfs.write(path)
    content = path.read_bytes()
    # A header that claims 2 GiB.
    path.write_bytes(content.replace(b"NAXIS1  =                    9", b"NAXIS1  =             99999999"))
    with pytest.raises(FileError, match=r"truncated|more than the limit"):
        read_psfs(path)


def index_of(tmp_path, entries, head=""):
    """Write listings and an index; entries are (file, x_um, y_um, wavelength_nm)."""
    psf = np.zeros((8, 8))
    psf[3:6, 2:5] = np.arange(9.0).reshape(3, 3)
    for file, _, _, wave_nm in entries:
        write_listing(tmp_path / file, psf, (4, 3), pitch_um=0.5, wavelength_nm=wave_nm)
    lines = [f"  - {{file: {f}, x_um: {x}, y_um: {y}, wavelength_nm: {w}}}" for f, x, y, w in entries]
    path = tmp_path / "lens.yaml"
    path.write_text(head + "psfs:\n" + "\n".join(lines) + "\n", encoding="utf-8")
    return path


ENTRIES = [
    ("a.txt", 0.0, 0.0, 500.0),
    ("b.txt", 0.0, 100.0, 500.0),
    ("c.txt", 0.0, 0.0, 600.0),
    ("d.txt", 0.0, 100.0, 600.0),
]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8", "utf-8-sig", "cp1252"])
@pytest.mark.parametrize("kind", ["FFT", "Huygens"])
def test_listings_are_read_in_all_encodings(tmp_path, encoding, kind):
    psf = np.zeros((16, 12))
    psf[9, 6], psf[2, 6], psf[9, 8] = 4.0, 2.0, 1.0  # above the centre, and right of it
    write_listing(tmp_path / "psf.txt", psf, (8, 5), pitch_um=0.25, kind=kind, encoding=encoding)
    found = read_psfs(tmp_path / "psf.txt")

    assert (found.wavelength_nm[0], found.pitch_um) == (550.0, 0.25)
    # Right and above in the projected image are left and below in the upright picture.
    x_um, y_um = found.centroid_um[0, 0]
    assert x_um == pytest.approx(-0.25 * (1 * 4 + 1 * 2 + 3 * 1) / 7)
    assert y_um == pytest.approx(-0.25 * (-1 * 4 + 6 * 2 - 1 * 1) / 7)


def test_index_of_listings_gives_points_and_wavelengths(tmp_path):
    found = read_psfs(index_of(tmp_path, ENTRIES))
    assert found.psf.shape[:2] == (2, 2)
    np.testing.assert_array_equal(found.y_um, [0.0, -100.0])
    np.testing.assert_array_equal(found.wavelength_nm, [500.0, 600.0])
    upright = read_psfs(index_of(tmp_path, ENTRIES, head="image: upright\n"))
    np.testing.assert_array_equal(upright.psf, found.psf[..., ::-1, ::-1])
    np.testing.assert_array_equal(upright.y_um, [0.0, 100.0])


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (ENTRIES[:3], r"lists no PSF at \(0, 100\) µm and 600 nm, a wavelength of other points; add it"),
        (
            [*ENTRIES, ("e.txt", 0.0, 0.0, 500.0)],
            "lists 'a.txt' and 'e.txt' for the same point and wavelength; remove one of them",
        ),
    ],
)
def test_wrong_indices_are_rejected(tmp_path, entries, message):
    with pytest.raises(FileError, match=message) as caught:
        read_psfs(index_of(tmp_path, entries))
    assert "lens.yaml" in str(caught.value)


@pytest.mark.parametrize("name", ["../{}.txt", "{folder}/{}.txt", "link_{}.txt", "sub/../../{}.txt"])
def test_index_does_not_leave_its_directory(tmp_path, name):
    """The message is equal for files that exist and others."""
    folder = tmp_path / "lens"
    (folder / "sub").mkdir(parents=True)
    index_of(tmp_path, ENTRIES[:1])
    for stem in ("a", "missing"):
        (folder / f"link_{stem}.txt").symlink_to(tmp_path / f"{stem}.txt")
        file = name.format(stem, folder=tmp_path)
        index = folder / "lens.yaml"
        index.write_text(f"psfs: [{{file: '{file}', x_um: 0.0, y_um: 0.0, wavelength_nm: 500.0}}]\n")
        with pytest.raises(
            FileError, match="outside its directory; move the file, or pass allow_outside=True"
        ) as caught:
            read_psfs(index)
        assert "exist" not in str(caught.value)
        if stem == "a":
            assert read_psfs(index, allow_outside=True).wavelength_nm.tolist() == [500.0]
    shot = fs.config.read_settings(fs.config.demo_settings()[0])
    shot["optics"]["psfs"] = {"path": str(index), "allow_outside": True}
    with pytest.raises(fs.errors.ConfigError, match=r"optics\.psfs\.allow_outside: unknown"):
        fs.config.build_shot(None, shot)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("psfs: []", "must have a list 'psfs' of entries with the keys file, x_um, y_um, wavelength_nm"),
        ("psfs: [{file: a.txt, x_um: 0, y_um: 0}]", "has no 'wavelength_nm', which files of PSFs must contain"),
        (
            "psfs: [{file: a.txt, x_um: left, y_um: 0, wavelength_nm: 500}]",
            r"must have a finite number as 'x_um' in psfs\[0\]",
        ),
        (
            "psfs: [{file: [a], x_um: 0, y_um: 0, wavelength_nm: 500}]",
            r"must have the name of a file as 'file' in psfs\[0\]",
        ),
        ("psfs: [{file: z.txt, x_um: 0, y_um: 0, wavelength_nm: 500}]", "lists 'z.txt', which does not exist"),
        (
            "psfs: [{file: a.txt, x_um: 0, y_um: 0, wavelength_nm: 900}]",
            "is the PSF at 500 nm, but lens.yaml lists it for 900 nm",
        ),
        ("psfs: [3]", r"must have the keys file, x_um, y_um, wavelength_nm in psfs\[0\]"),
        ("lenses: [3]\npsfs: [3]", "has the unknown key 'lenses'; expected psfs, image"),
        ("psfs: !!python/object/apply:os.getcwd []", "is not YAML|is not valid YAML"),
        (
            "image: turned\npsfs: [{file: a.txt, x_um: 0, y_um: 0, wavelength_nm: 500}]",
            "must have 'upright' or 'inverted' as 'image'",
        ),
    ],
)
def test_wrong_text_of_an_index_is_rejected(tmp_path, text, message):
    index_of(tmp_path, ENTRIES)
    (tmp_path / "lens.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(fs.errors.FoveasimError, match=message) as caught:
        read_psfs(tmp_path / "lens.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Listing of FFT", "Listing of MTF", "is not a valid file of PSFs"),
        ("Values are", "Numbers are", "has no line 'Values are ...', after which the values begin"),
        ("Data spacing is", "Spacing:", "has the unknown line 'Spacing: 0.250000000 µm.' in its header"),
        ("Data spacing is 0.250000000 µm.", "", "has no 'Data spacing is' in its header"),
        (
            "Surface: Image",
            "Rotation: 90",
            "has the unknown line 'Rotation: 90' in its header, which may change the PSF",
        ),
        ("Surface: Image", "Center: centroid", "has the unknown line 'Center: centroid' in its header"),
        (
            "Surface: Image",
            "Data spacing is 0.5 µm.",
            "has two lines about the same, 'Data spacing is 0.250000000 µm.'",
        ),
        (
            "Values are not normalized",
            "Values are the logarithm",
            "has values that are no irradiance, 'Values are the log",
        ),
        ("Center point is: row 5, column 4", "", "has no line 'Center point is' in its header; pass centre="),
        ("row 5, column 4", "row 5, column 9", "has the centre 'Center point is: row 5, column 9' outside its 8 by 8"),
        ("row 5, column 4", "(5, 4)", r"has the unknown line 'Center point is: \(5, 4\)' in its header"),
        ("0.250000000 µm", "1,250.0 µm", "has the number '1,250.0' in its header, expected one decimal point or comma"),
        ("0.5500 to 0.5500", "0.4500 to 0.6500", "is the PSF of 0.45 to 0.65 µm; export one wavelength per file"),
        ("0.250000000 µm", "0.250000000 ft", "has the unit of length 'ft', expected one such as µm"),
        ("Image grid size: 8 by 8", "Image grid size: 8 by 9", "has 64 values, expected 8 by 9 = 72"),
        ("Image grid size: 8 by 8", "Image grid size: 80000 by 80000", "more than the limit of 8192 along a side"),
        ("1.000000000E+00", "one", "has a value that is not a number"),
        ("1.000000000E+00", "nan", "'psf' must be finite"),
    ],
)
def test_wrong_listings_are_rejected(tmp_path, old, new, message):
    path, psf = tmp_path / "psf.txt", np.zeros((8, 8))
    psf[4, 3] = 1.0
    write_listing(path, psf, (4, 3), pitch_um=0.25, encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(FileError, match=message) as caught:
        read_psfs(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_unknown_files_and_extensions_are_rejected(tmp_path):
    (tmp_path / "psf.bin").write_bytes(b"unknown")
    with pytest.raises(FileError, match="is not a valid file of PSFs: expected FITS, index of Zemax listings, npz"):
        read_psfs(tmp_path / "psf.bin")
    with pytest.raises(FileError, match=r"psf\.npz"):
        read_psfs(tmp_path / "psf.npz")
    with pytest.raises(FileError, match=r"must end in one of \.fit, \.fits, \.npz"):
        PSFGrid.from_arrays(**GOOD).write(tmp_path / "psf.txt")


def test_coordinates_of_labelled_arrays_are_not_dropped():
    xarray = pytest.importorskip("xarray")
    x_mm = 1e-3 * np.arange(-4.0, 5.0)
    psf = xarray.DataArray(np.eye(9) + 0.1, {"y": x_mm, "x": x_mm})

    with pytest.raises(
        ParameterError, match=r"must have no coordinates of its own, .*; pass sample_x_um and sample_y_um"
    ):
        PSFGrid.from_arrays(psf, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=1.0)
    found = PSFGrid.from_arrays(
        psf, x_um=0.0, y_um=0.0, wavelength_nm=550.0, sample_x_um=1e3 * psf.x, sample_y_um=1e3 * psf.y
    )
    assert found.centre == (4.0, 4.0)
