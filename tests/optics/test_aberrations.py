"""Aberrations against closed forms: Zernike polynomials, defocus, Strehl ratio, orientation, field."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import scipy

import foveasim as fs
from foveasim.errors import ParameterError, SamplingWarning
from foveasim.optics import LateralColour, Seidel, Zernike, noll_to_nm, osa_to_nm, zernike

WAVELENGTH_NM = 550.0
LAMBDA_N_UM = 0.55 * 4.0
DISTANCE_M = 0.56


def lens(**changes):
    values = {"focal_length_mm": 22.0, "f_number": 4.0, "precision": "double", "padding": "periodic"}
    return fs.Optics(**{**values, **changes})


def aberrated(**changes):
    return lens(zernike=Zernike(**changes))


def scene_of(image, pitch_um=11.6, distance_m=DISTANCE_M, wavelength_nm=(WAVELENGTH_NM,)):
    n = len(wavelength_nm)
    return fs.Scene(
        np.asarray(image, float)[np.newaxis], np.ones((1, n)), np.array(wavelength_nm), np.ones(n), pitch_um, distance_m
    )


def map_of(optics, image, **changes):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        return optics.power_map(scene_of(image, **changes))


def centroid_um(power_map, band=0):
    psf = power_map.data[band] / power_map.data[band].sum()
    return float((psf * power_map.grid.x_um).sum()), float((psf * power_map.grid.y_um[:, np.newaxis]).sum())


# -- Zernike polynomials --------------------------------------------------------------------------------------------------


def test_zernike_indices_match_published_tables():
    """Noll (1976), Table I; Thibos et al. (2002), Table 1."""
    noll = [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0), (4, 2), (4, -2), (4, 4), (4, -4), (5, 1), (5, -1), (5, 3), (5, -3), (5, 5), (5, -5), (6, 0)]  # fmt: skip
    osa = [(0, 0), (1, -1), (1, 1), (2, -2), (2, 0), (2, 2), (3, -3), (3, -1), (3, 1), (3, 3), (4, -4), (4, -2), (4, 0), (4, 2), (4, 4), (5, -5)]  # fmt: skip

    assert [noll_to_nm(j + 1) for j in range(len(noll))] == noll
    assert [osa_to_nm(j) for j in range(len(osa))] == osa
    for to_nm, first in ((noll_to_nm, 1), (osa_to_nm, 0)):
        all_orders = [to_nm(j) for j in range(first, first + 231)]  # complete radial orders, up to n = 20
        assert sorted(all_orders) == sorted({(n, m) for n in range(21) for m in range(-n, n + 1, 2)})


def test_zernike_polynomials_are_orthonormal():
    radial, weight = np.polynomial.legendre.leggauss(40)
    r, dr = 0.5 * (radial + 1.0), 0.5 * weight
    angle = np.arange(64) * (2.0 * np.pi / 64)
    x, y = np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle))
    area = np.outer(dr * r, np.full(64, 2.0 * np.pi / 64)) / np.pi
    modes = np.array([zernike(*noll_to_nm(j), x, y) for j in range(1, 232)])

    gram = np.einsum("aij,bij,ij->ab", modes, modes, area, optimize=True)

    np.testing.assert_allclose(gram, np.eye(231), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("n", "m", "form"),
    [
        (0, 0, lambda r, t: 1 + 0 * r * t),
        (1, 1, lambda r, t: 2 * r * np.cos(t)),
        (1, -1, lambda r, t: 2 * r * np.sin(t)),
        (2, 0, lambda r, t: math.sqrt(3) * (2 * r**2 - 1 + 0 * t)),
        (2, -2, lambda r, t: math.sqrt(6) * r**2 * np.sin(2 * t)),
        (3, -1, lambda r, t: math.sqrt(8) * (3 * r**3 - 2 * r) * np.sin(t)),
        (4, 0, lambda r, t: math.sqrt(5) * (6 * r**4 - 6 * r**2 + 1 + 0 * t)),
        (5, 3, lambda r, t: math.sqrt(12) * (5 * r**5 - 4 * r**3) * np.cos(3 * t)),
    ],
)
def test_zernike_polynomials_match_closed_forms(n, m, form):
    r, t = np.meshgrid(np.linspace(0, 1, 11), np.linspace(0, 6, 13))

    assert zernike(n, m, r * np.cos(t), r * np.sin(t)) == pytest.approx(form(r, t), abs=1e-13)


@pytest.mark.slow
def test_psf_is_independent_of_index_and_unit():
    psfs = [
        aberrated(**c).psf(WAVELENGTH_NM).psf_per_um2
        for c in (
            {"coefficients": {7: 0.11, 11: -0.055}},
            {"coefficients": {7: 0.11, 12: -0.055}, "index": "osa"},
            {"coefficients": {7: 0.2, 11: -0.1}, "unit": "waves"},
            {"coefficients": {7: 0.2, 11: -0.1}, "unit": "waves", "wavelength_nm": 550.0},
            {"coefficients": {7: [0.0, 0.22], 11: -0.055}, "wavelength_nm": [500.0, 600.0]},
        )
    ]

    for psf in psfs[1:]:
        np.testing.assert_allclose(psf, psfs[0], rtol=0.0, atol=1e-12)


def test_coefficients_vary_with_wavelength():
    own = Zernike(coefficients={4: 0.2}, unit="waves")
    of_one = Zernike(coefficients={4: 0.2}, unit="waves", wavelength_nm=550.0)
    table = Zernike(coefficients={4: [0.0, 1.0]}, unit="waves", wavelength_nm=[400.0, 600.0])

    def at(z, wavelength_nm):
        return z.coefficients_um(wavelength_nm)[2, 0]

    assert [at(own, w) for w in (400.0, 600.0)] == pytest.approx([0.08, 0.12])
    assert [at(of_one, w) for w in (400.0, 600.0)] == pytest.approx([0.11, 0.11])
    assert [at(table, w) for w in (300.0, 500.0, 900.0)] == pytest.approx([0.0, 0.3, 0.6])


# -- defocus ------------------------------------------------------------------------------------------------------------


def hopkins(s, waves):
    """OTF of a defocused circle: overlap of two shifted discs with the phase difference of the parabola."""
    if s >= 1.0:
        return 0.0
    value, _ = scipy.integrate.quad(
        lambda x: 2 * np.sqrt(max(0.0, 1 - (abs(x) + s) ** 2)) * np.cos(8 * np.pi * waves * x * s), -(1 - s), 1 - s,
        limit=400, epsabs=1e-10,
    )  # fmt: skip
    return value / np.pi


@pytest.mark.parametrize("waves", [0.25, 0.5, 1.0, 2.0, 5.0])
def test_defocused_circle_has_hopkins_otf(waves):
    optics = aberrated(coefficients={4: waves / math.sqrt(12)}, unit="waves")
    s = np.linspace(0.0, 1.1, 45)

    got = optics.otf(s / LAMBDA_N_UM * 1e3, WAVELENGTH_NM, angle_deg=33.0)

    assert got == pytest.approx(np.array([hopkins(t, waves) for t in s]), abs=1e-8)


@pytest.mark.parametrize("waves", [0.1, 0.5, 0.9, 1.5, 3.3])
def test_defocused_psf_centre_is_squared_sinc(waves):
    optics = aberrated(coefficients={4: waves / math.sqrt(12)}, unit="waves")

    assert optics.strehl(WAVELENGTH_NM, reference="image_point") == pytest.approx(np.sinc(waves) ** 2, abs=1e-9)
    assert optics.strehl(WAVELENGTH_NM) >= np.sinc(waves) ** 2 - 1e-9
    centre = optics.psf(WAVELENGTH_NM, n_points=3).psf_per_um2[1, 1]
    assert centre * LAMBDA_N_UM**2 * 4 / np.pi == pytest.approx(np.sinc(waves) ** 2, abs=1e-9)


def test_tilt_does_not_change_the_strehl_ratio():
    """Coma contains tilt, and distortion is tilt: the image is displaced."""
    ratios = [
        aberrated(coefficients={7: 0.3, 3: tilt}, unit="waves").strehl(WAVELENGTH_NM) for tilt in (0.0, 0.4, -1.0)
    ]
    assert ratios == pytest.approx([ratios[0]] * 3, rel=1e-6)
    assert aberrated(coefficients={2: 0.7}, unit="waves").strehl(WAVELENGTH_NM) == pytest.approx(1.0, abs=2e-6)
    coma = aberrated(coefficients={7: 0.3}, unit="waves")
    # Dense samples of the PSF, λN/32 apart.
    dense = (
        coma.psf(WAVELENGTH_NM, pitch_um=LAMBDA_N_UM / 32, n_points=257).psf_per_um2.max() * LAMBDA_N_UM**2 * 4 / np.pi
    )
    assert ratios[0] == pytest.approx(dense, rel=1e-3)
    assert coma.strehl(WAVELENGTH_NM, reference="image_point") == pytest.approx(0.0128, abs=1e-4)
    with pytest.raises(ParameterError, match="'reference' must be one of 'peak', 'image_point', got 'centre'"):
        coma.strehl(WAVELENGTH_NM, reference="centre")


@pytest.mark.parametrize("j", [5, 6, 8, 11])
def test_strehl_ratio_is_of_highest_peak(j):
    optics = aberrated(coefficients={j: 0.4, 4: 0.1}, unit="waves")
    dense = optics.psf(WAVELENGTH_NM, pitch_um=LAMBDA_N_UM / 24, n_points=241).psf_per_um2.max()
    assert optics.strehl(WAVELENGTH_NM) == pytest.approx(dense * LAMBDA_N_UM**2 * 4 / np.pi, rel=4e-3)


@pytest.mark.parametrize("distance_m", [0.3, 0.45, 0.8, 3.0])
def test_defocus_matches_sphere_path_difference(distance_m):
    """Reference: exact spheres around the two image points at the pupil edge; the package uses a parabola."""
    optics = lens(focus_distance_m=0.5, f_number=11.0)
    radius_mm = 1.0
    images_mm = [1.0 / (1.0 / 22.0 - 1e-3 / d) for d in (0.5, distance_m)]

    # Difference of the sags of the spheres that converge to the sensor and to the image of the scene.
    sags_mm = [d - math.sqrt(d**2 - radius_mm**2) for d in images_mm]

    # A nearer scene is imaged behind the sensor, with a flatter sphere.
    assert optics.defocus_um(distance_m) == pytest.approx((sags_mm[0] - sags_mm[1]) * 1e3, rel=5e-3)
    assert lens().defocus_um(distance_m) == 0.0
    assert optics.defocus_um(0.5) == 0.0


def test_defocus_blur_matches_circle_of_confusion():
    """Reference: geometric cone from the pupil, intersected by the sensor plane."""
    optics = lens(focus_distance_m=0.4, f_number=2.0)
    image_mm, focus_mm = (1.0 / (1.0 / 22.0 - 1e-3 / d) for d in (0.5, 0.4))
    circle_um = 11.0 * abs(focus_mm - image_mm) / image_mm * 1e3  # diameter
    radii_um = circle_um / 2 * np.array([0.5, 0.8, 1.1])

    got = optics.encircled_energy(radii_um, WAVELENGTH_NM, distance_m=0.5)

    assert optics.defocus_um(0.5) < -10 * 0.55  # waves; negative: the scene is beyond the focus
    assert got == pytest.approx([0.25, 0.64, 1.0], abs=0.03)


def test_magnification_of_defocused_scene_uses_sensor_distance():
    optics = lens(focus_distance_m=0.4)
    image_mm = 1.0 / (1.0 / 22.0 - 1.0 / 400.0)

    assert optics.magnification(0.8) == pytest.approx(image_mm / 800.0)
    assert optics.working_f_number(0.8) == pytest.approx(4.0 * image_mm / 22.0)
    assert optics.magnification(0.4) == pytest.approx(lens().magnification(0.4))


# -- Strehl ratio-----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("j", [4, 5, 6, 7, 8, 9, 11, 12, 16, 22, 37])
@pytest.mark.parametrize("sigma_waves", [0.01, 0.03, 0.07])
def test_strehl_follows_rms_wavefront_error(j, sigma_waves):
    got = aberrated(coefficients={j: sigma_waves}, unit="waves").strehl(WAVELENGTH_NM)

    assert got == pytest.approx(math.exp(-((2 * np.pi * sigma_waves) ** 2)), abs=5e-5 + 500 * sigma_waves**4)


def test_tilt_and_piston_preserve_psf_peak():
    tilted = aberrated(coefficients={1: 0.4, 2: 0.3}, unit="waves").psf(WAVELENGTH_NM, n_points=401)

    assert tilted.psf_per_um2.max() == pytest.approx(np.pi / 4 / LAMBDA_N_UM**2, rel=1e-2)


# -- orientation ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("j", "axis"), [(2, 0), (3, 1), (8, 0), (7, 1)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_tilt_and_coma_move_centroid_by_sign(j, axis, sign):
    image = np.zeros((201, 201))
    image[100, 100] = 1.0

    power_map = map_of(aberrated(coefficients={j: sign * 0.15}), image)
    moved = centroid_um(power_map)

    # Mean slope over the disc times 2N, by the divergence theorem, for W = 2 c x (tilt) and c sqrt(8) (3r³ - 2r) cos t (coma).
    # The tolerance accounts for the wings of the PSF beyond the picture, which contain a tenth of the moment.
    slope_um = sign * 0.15 * (2.0 if j in (2, 3) else math.sqrt(8))
    assert moved[axis] == pytest.approx(2 * lens().working_f_number(DISTANCE_M) * slope_um, rel=0.12)
    assert moved[1 - axis] == pytest.approx(0.0, abs=1e-6)


def test_positive_coma_flare_points_up():
    psf = aberrated(coefficients={7: 0.25}, unit="waves").psf(WAVELENGTH_NM)
    energy = psf.psf_per_um2 * psf.grid.cell_area_um2
    brightest = np.unravel_index(energy.argmax(), energy.shape)
    mean_y_um = (energy * psf.grid.y_um[:, np.newaxis]).sum() / energy.sum()

    assert psf.grid.x_um[brightest[1]] == 0.0
    assert psf.grid.y_um[brightest[0]] < 0.0 < mean_y_um


def test_letter_f_is_upright_with_coma():
    letter = np.zeros((120, 100))
    letter[20:100, 30:40] = letter[90:100, 30:75] = letter[55:65, 30:60] = 1.0  # rows count from the bottom

    sharp, flared = (map_of(o, letter, pitch_um=116.0).data[0] for o in (lens(), aberrated(coefficients={7: 0.3})))

    # Upright: the long bar is at the top, and the lower right is empty.
    assert sharp[95, 70] > 0.5 * sharp.max()
    assert sharp[60, 70] < 0.1 * sharp.max() > sharp[25, 60]
    # The flare of the upper bar lies above it.
    above, below = flared[101:109, 45:70].sum(), flared[81:89, 45:70].sum()
    assert above > 4 * below
    assert sharp[101:109, 45:70].sum() == pytest.approx(sharp[81:89, 45:70].sum(), rel=0.2)


# -- field-dependent aberrations ----------------------------------------------------------------------------------------


def test_field_coma_points_away_from_axis():
    coma = lens(seidel=Seidel(coma_um=0.5, field_radius_um=1000.0), padding="reflect")
    for field_um in ((1000.0, 0.0), (0.0, 1000.0), (-700.0, -700.0)):
        psf = coma.psf(WAVELENGTH_NM, field_um=field_um)
        energy = psf.psf_per_um2 * psf.grid.cell_area_um2
        moved = np.array([(energy * psf.grid.x_um).sum(), (energy * psf.grid.y_um[:, np.newaxis]).sum()])

        assert moved @ np.array(field_um) > 0.9 * np.hypot(*moved) * np.hypot(*field_um)
    assert coma.strehl(WAVELENGTH_NM) == pytest.approx(1.0, abs=1e-6)
    # Coma of 0.15 µm at the edge is 0.15 r³ cos t; its rms without tilt is 0.15 / (3 sqrt(8)) µm.
    weak = lens(seidel=Seidel(coma_um=0.15, field_radius_um=1000.0), padding="reflect")
    height = weak.psf(WAVELENGTH_NM, field_um=(1000.0, 0.0)).psf_per_um2.max() * LAMBDA_N_UM**2 * 4 / np.pi
    assert height == pytest.approx(math.exp(-((2 * np.pi * 0.15 / 0.55 / (3 * math.sqrt(8))) ** 2)), abs=6e-3)


@pytest.mark.parametrize(
    ("part", "at_edge"),
    [
        ({"spherical_um": 1.0}, lambda x, y, *_: (x * x + y * y) ** 2),
        ({"coma_um": 1.0}, lambda x, y, hx, hy: (x * x + y * y) * (x * hx + y * hy)),
        ({"astigmatism_um": 1.0}, lambda x, y, hx, hy: (x * hx + y * hy) ** 2),
        ({"field_curvature_um": 1.0}, lambda x, y, hx, hy: (hx * hx + hy * hy) * (x * x + y * y)),
    ],
)
def test_seidel_wavefronts_match_closed_forms(part, at_edge):
    seidel = Seidel(**part, field_radius_um=50.0)
    x, y = np.array([1.0, 0.3]), np.array([0.0, -0.4])

    assert seidel.wavefront_um(x, y, 550.0, (50.0, 0.0))[0] == pytest.approx(1.0)
    assert seidel.wavefront_um(x, y, 550.0, (20.0, -35.0)) == pytest.approx(at_edge(x, y, 0.4, -0.7))


def field_lens(**changes):
    values = {
        "seidel": Seidel(coma_um=0.8, astigmatism_um=0.6, field_radius_um=60.0),
        "padding": "zero",
        "padding_cells": 40,
    }
    return lens(**{**values, **changes})


@pytest.mark.parametrize("n_patches", [3, 5])
def test_psf_is_exact_at_patch_centre(n_patches):
    n = 161
    optics = field_lens(field_patches=n_patches, source_pixel="point")
    image = np.zeros((n, n))
    at = (120, 40) if n_patches == 5 else (80, 80)  # patch centres are quarters or halves of the picture apart
    image[at] = 1.0
    power_map = map_of(optics, image)
    p_um = power_map.grid.pitch_um
    field_um = tuple((i - 80) * p_um * (161 / 160 if n_patches == 5 else 0) for i in (at[1], at[0]))

    reference = map_of(
        lens(
            padding="zero",
            padding_cells=40,
            pupil=lambda x, y, w: np.exp(2j * np.pi * optics.seidel.wavefront_um(x, y, w, field_um) / (1e-3 * w)),
        ),
        image,
    )

    # The point is within half a cell of the patch centre.
    np.testing.assert_allclose(power_map.data[0], reference.data[0], rtol=0.0, atol=0.02 * reference.data.max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("padding", "padding_cells"), [("reflect", None), ("edge", 0), ("zero", 30), ("reflect", 30), ("zero", None)]
)
def test_patches_with_equal_psfs_match_convolution(padding, padding_cells):
    image = np.random.default_rng(5).random((70, 90)) + 0.5
    options = {"padding": padding, "padding_cells": padding_cells}
    plain = map_of(lens(seidel=Seidel(spherical_um=0.3), **options), image).data
    # With so large a field radius, all pixels are practically on the axis.
    patched = map_of(lens(seidel=Seidel(spherical_um=0.3, coma_um=1.0, field_radius_um=1e7), **options), image).data

    # The periodic continuation is the same, except for PSF energy beyond the guard of a patch.
    np.testing.assert_allclose(patched, plain, rtol=2e-3)
    assert patched.sum() == pytest.approx(plain.sum(), rel=1e-3)


@pytest.mark.slow
def test_uniform_scene_stays_uniform_with_patches():
    image = np.ones((120, 140))
    patched = map_of(lens(seidel=Seidel(coma_um=1e-9), padding="reflect"), image, pitch_um=46.4).data
    plain = map_of(lens(padding="reflect"), image, pitch_um=46.4).data

    np.testing.assert_allclose(patched, plain, rtol=2e-3)


@pytest.mark.slow
def test_isoplanatic_error_decreases_with_patch_count():
    image = np.zeros((161, 161))
    rng = np.random.default_rng(2)
    for at in rng.integers(50, 111, (12, 2)):
        image[tuple(at)] = 1.0
    seidel = Seidel(coma_um=0.25, astigmatism_um=0.15, field_radius_um=240.0)
    maps, errors = [], []
    for n_patches in (3, 5, 11):
        optics = field_lens(seidel=seidel, field_patches=n_patches)
        maps.append(map_of(optics, image, pitch_um=46.4).data[0])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SamplingWarning)
            errors.append(optics.field_error(scene_of(image, pitch_um=46.4)) if n_patches < 11 else 0.0)
    truth = maps[-1]
    displaced = [0.5 * np.abs(m - truth).sum() / truth.sum() for m in maps]

    for got in maps:
        assert got.sum() == pytest.approx(truth.sum(), rel=5e-3)
    assert errors[1] < 0.32 * errors[0]  # approximately a quarter
    # The reported error is the maximum over the field; the points are spread over it.
    assert displaced[0] < errors[0]
    assert displaced[1] < errors[1]
    assert displaced[0] > 0.1 * errors[0]


def test_constant_psf_has_no_field_error():
    assert aberrated(coefficients={7: 0.1}).field_error(scene_of(np.ones((50, 50)))) == 0.0


# -- lateral chromatic aberration ---------------------------------------------------------------------------------------


def test_lateral_colour_scales_point_positions():
    optics = lens(lateral_colour=LateralColour(wavelength_nm=[450.0, 650.0], magnification=[0.98, 1.02]))
    image = np.zeros((161, 161))
    image[120, 140] = 1.0
    waves_nm = (450.0, 550.0, 650.0)

    power_map = map_of(optics, image, wavelength_nm=waves_nm, pitch_um=116.0)

    for band, size in enumerate((0.98, 1.0, 1.02)):
        iy, ix = np.unravel_index(power_map.data[band].argmax(), image.shape)
        near = power_map.data[band, iy - 3 : iy + 4, ix - 3 : ix + 4]
        off = [(near.sum(axis=k) * np.arange(-3, 4)).sum() / near.sum() for k in (1, 0)]
        assert (iy + off[0] - 80, ix + off[1] - 80) == pytest.approx((40 * size, 60 * size), abs=0.03)
    plain = map_of(lens(), image, wavelength_nm=waves_nm, pitch_um=116.0)
    assert power_map.data.sum(axis=(1, 2)) == pytest.approx(plain.data.sum(axis=(1, 2)), rel=3e-3)


def test_camera_applies_lateral_colour_without_resampling():
    """Reference: the same scene at both image sizes, one wavelength each, on a layout of large squares."""
    colour = LateralColour(wavelength_nm=[450.0, 650.0], magnification=[0.97, 1.0])
    rng = np.random.default_rng(8)
    image = rng.random((150, 150))
    layout = fs.layout.grid(n_x=12, n_y=12, pitch_um=4.0)
    sensor = fs.Sensor(layout, qe=1.0)
    both = fs.Camera(optics=lens(lateral_colour=colour), sensor=sensor)
    scene = scene_of(image, wavelength_nm=(450.0, 650.0))

    got = both.photoelectrons_per_s(scene)

    expected = np.zeros(layout.n_sites)
    for band, size in enumerate(colour.magnification):
        alone = lens(focal_length_mm=22.0).power_map(scene)
        grid = fs.Grid.centred(alone.grid.shape, alone.grid.pitch_um * size)
        # The same power in smaller cells; diffraction depends on the sensor coordinates, not on the cells.
        small = lens(padding="periodic")
        narrow = fs.Scene(
            scene.basis,
            scene.spectrum_w_m2_sr_nm[:, [band]],
            scene.wavelength_nm[[band]],
            np.ones(1),
            11.6 * size,
            DISTANCE_M,
        )
        irradiance = small.power_map(narrow).data[0]
        # Relative illumination depends on the unscaled scene.
        y, x = ((np.arange(150) - 74.5)[:, None] * 11.6e-6, (np.arange(150) - 74.5) * 11.6e-6)
        ratio = ((1 + (x**2 + y**2) * size**2 / DISTANCE_M**2) / (1 + (x**2 + y**2) / DISTANCE_M**2)) ** 2
        joules = fs.units.photon_energy_j(scene.wavelength_nm[band])
        expected += fs.Integrator(layout, grid, order=2)(irradiance / size**2 * ratio) * 1e-12 / joules

    assert len(both.optics.image_grids(scene)) == 2
    assert got == pytest.approx(expected, rel=1e-4)


def test_reference_with_lateral_colour_equals_capture():
    """Pixels that cut the cells of every image, on cells wider than the PSF: no image is resampled."""
    colour = LateralColour(wavelength_nm=[450.0, 650.0], magnification=[0.97, 1.03])
    image = np.random.default_rng(4).random((90, 90))
    scene = scene_of(image, wavelength_nm=(450.0, 550.0, 650.0), pitch_um=116.0)
    pixels = fs.Grid.centred((26, 30), 1.37 * 116.0 * lens().magnification(DISTANCE_M) / 2.0)
    layout = fs.layout.grid(n_x=30, n_y=26, pitch_um=pixels.pitch_x_um)
    optics = lens(lateral_colour=colour, precision="single", oversample=1)
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout), order=1)

    got = camera.reference(scene, pixels, exposure_s=0.5).data[0].ravel() * pixels.cell_area_um2

    assert got == pytest.approx(0.5 * camera.photoelectrons_per_s(scene), rel=1e-5)


def test_unit_lateral_colour_is_bit_identical():
    scene = scene_of(np.random.default_rng(0).random((80, 80)), wavelength_nm=(500.0, 600.0))
    sensor = fs.Sensor(fs.layout.grid(n_x=6, n_y=6, pitch_um=3.0))
    flat = LateralColour(wavelength_nm=[500.0, 600.0], magnification=[1.0, 1.0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        plain, same = (
            fs.Camera(optics=lens(lateral_colour=c), sensor=sensor).photoelectrons_per_s(scene) for c in (None, flat)
        )

    assert np.array_equal(plain, same)


@pytest.mark.slow
@pytest.mark.parametrize("moved_cells", [3.0, 11.3, 27.0])
def test_tilt_displaces_psf_over_wide_cells(moved_cells):
    """Reference: the same tilt on cells a fifth as wide as 2.6 λN, binned."""
    n = 81
    maps = []
    lambda_n_um = 0.55 * lens().working_f_number(DISTANCE_M)
    for finer in (1, 5):
        cell_um = 2.6 * lambda_n_um / finer
        # A tilt of c µm rms has a slope of 2c per radius, and displaces the image by 2N times the slope.
        tilt_um = moved_cells * 2.6 * lambda_n_um / (4.0 * lens().working_f_number(DISTANCE_M))
        image = np.zeros((n * finer, n * finer))
        image[n * finer // 2, (n // 2 - 20) * finer + finer // 2] = 1.0
        optics = aberrated(coefficients={2: tilt_um})
        data = map_of(optics, image, pitch_um=cell_um / optics.magnification(DISTANCE_M)).data[0]
        maps.append(data.reshape(n, finer, n, finer).sum(axis=(1, 3)) / data.sum())

    # At the geometric blur radius, the sampled OTF represents all but 1.3 % of the energy.
    assert 0.5 * np.abs(maps[0] - maps[1]).sum() < 0.015


def test_zernike_is_hashable_and_immutable():
    waves = [450.0, 650.0]
    one = Zernike(coefficients={4: [0.1, 0.2]}, wavelength_nm=waves)
    waves[1] = 5000.0

    assert one.coefficients_um(550.0)[2, 0] == pytest.approx(0.15)
    assert one == Zernike(coefficients={4: (0.1, 0.2)}, wavelength_nm=np.array([450.0, 650.0]))
    assert one != Zernike(coefficients={4: [0.1, 0.3]}, wavelength_nm=[450.0, 650.0])
    assert len({lens(zernike=one), lens(zernike=one), lens()}) == 2
    with pytest.raises(TypeError):
        one.coefficients[4] = 3.0


# -- limits -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Zernike(coefficients={}), "'coefficients' must be a mapping of indices to numbers"),
        (lambda: Zernike(coefficients=[0.1]), "'coefficients' must be a mapping to numbers"),
        (lambda: Zernike(coefficients={0: 0.1}), "'coefficients' has an index that must be >= 1, got 0"),
        (lambda: Zernike(coefficients={-1: 0.1}, index="osa"), "'coefficients' has an index that must be >= 0, got -1"),
        (lambda: Zernike(coefficients={10**6: 0.1}), "'coefficients' has an index that must be <= 5151"),
        (lambda: Zernike(coefficients={"coma": 0.1}), "'coefficients' has an index that must be an integer"),
        (lambda: Zernike(coefficients={4: float("nan")}), r"'coefficients\[4\]' must be finite"),
        (
            lambda: Zernike(coefficients={4: [0.1, 0.2]}),
            r"'coefficients\[4\]' must be one number, or one for each of the 1",
        ),
        (lambda: Zernike(coefficients={4: 0.1}, index="fringe"), "'index' must be one of 'noll', 'osa'"),
        (lambda: Zernike(coefficients={4: 0.1}, unit="nm"), "'unit' must be one of 'um', 'waves'"),
        (lambda: Zernike(coefficients={4: 0.1}, wavelength_nm=0.0), "'wavelength_nm' must be > 0"),
        (
            lambda: Zernike(coefficients={4: 0.1}, wavelength_nm=[600.0, 500.0]),
            "'wavelength_nm' must be strictly increasing",
        ),
        (lambda: Seidel(coma_um=float("inf")), "'coma_um' must be finite"),
        (lambda: Seidel(coma_um=1.0, field_radius_um=0.0), "'field_radius_um' must be > 0"),
        (lambda: LateralColour(wavelength_nm=[500.0], magnification=[2.0]), "'magnification' must be from 0.9 to 1.1"),
        (
            lambda: LateralColour(wavelength_nm=[500.0, 600.0], magnification=[1.0]),
            "'wavelength_nm' must be strictly increasing and have one value per",
        ),
        (lambda: zernike(2, 1, 0.0, 0.0), "'m' must be from -n to n = 2 in steps of two, got 1"),
        (lambda: lens(zernike={4: 0.1}), "'zernike' must be a Zernike, got a dict"),
        (
            lambda: lens(seidel=Seidel(coma_um=1.0), field_patches=5),
            "'padding' must not be 'periodic' with 'field_patches'",
        ),
        (lambda: lens(focus_distance_m=0.02), "'focus_distance_m' must be larger than the focal length, 0.022 m"),
        (lambda: lens(focus_distance_m=-1.0), "'focus_distance_m' must be > 0"),
        (lambda: lens(field_patches=0), "'field_patches' must be >= 1"),
        (
            lambda: aberrated(coefficients={4: 1000.0}).mtf(1.0, 550.0),
            "'aberrations' must blur a point by at most 128 λN, got .* at 550 nm; check the unit of the coefficients",
        ),
    ],
)
def test_invalid_aberrations_raise(make, message):
    with pytest.raises(ParameterError, match=f"^{message}"):
        make()
