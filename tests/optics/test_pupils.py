"""Pupils against closed forms: areas, transfer functions, PSFs, and power maps."""

from __future__ import annotations

import pickle
import warnings

import numpy as np
import pytest
from scipy.special import j1

import foveasim as fs
from foveasim.errors import FileError, ParameterError, SamplingWarning
from foveasim.optics import Annulus, Blades, PupilImage, Slit, Spider, circular_otf
from foveasim.optics._aperture import Aperture, overlaps

WAVELENGTH_NM = 550.0
#: λN in µm of the lens below, focused at infinity.
LAMBDA_N_UM = 0.55 * 4.0


def lens(**changes):
    values = {"focal_length_mm": 22.0, "f_number": 4.0, "precision": "double", "padding": "periodic"}
    return fs.Optics(**{**values, **changes})


def clear(x, y, wavelength_nm):
    """Clear circle as a callable, so that the package samples it."""
    return np.ones(np.broadcast_shapes(x.shape, y.shape))


def points(n, radius=1.0):
    at = (np.arange(n) + 0.5) * (2.0 * radius / n) - radius
    return at[np.newaxis, :], at[:, np.newaxis]


def point_scene(optics, cells_per_lambda_n=4.0, n=301, wavelength_nm=(WAVELENGTH_NM,), at=None, distance_m=0.56):
    pitch_um = 0.55 * optics.working_f_number(distance_m) / cells_per_lambda_n
    return fs.Scene.point_sources(
        shape=(n, n),
        pixels=[(n // 2, n // 2)] if at is None else at,
        intensity_w_sr_nm=1e-9,
        pitch_um=pitch_um / optics.magnification(distance_m),
        distance_m=distance_m,
        wavelength_nm=wavelength_nm,
        band_width_nm=1.0,
    )


# -- shapes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pupil", "fraction"),
    [
        (Annulus(0.0), 1.0),
        (Annulus(0.5), 0.75),
        (Annulus(0.9), 0.19),
        (Blades(4), 2.0 / np.pi),
        (Blades(6), 1.5 * np.sqrt(3.0) / np.pi),
        (Blades(6, angle_deg=17.0), 1.5 * np.sqrt(3.0) / np.pi),
        (Slit(0.5), (2 * np.arcsin(0.5) + np.sin(2 * np.arcsin(0.5))) / np.pi),
        (Slit(0.5, angle_deg=40.0), (2 * np.arcsin(0.5) + np.sin(2 * np.arcsin(0.5))) / np.pi),
        ((Annulus(0.5), Slit(1.0)), 0.75),
        (lambda x, y, w: 0.5, 0.25),
        (lambda x, y, w: 1j * np.ones((1, 1)), 1.0),
    ],
)
def test_pupil_transmittance_equals_area_fraction(pupil, fraction):
    optics, circle = lens(pupil=pupil), lens()

    total = [o.power_map(point_scene(o, n=151)).data.sum() for o in (optics, circle)]

    assert total[0] / total[1] == pytest.approx(fraction, rel=8e-4)


def test_spider_removes_vane_area():
    clear_circle, vaned = Aperture([], [], 0.0), Aperture([Spider(3, 0.02, angle_deg=10.0)], [], 0.0)

    # Three bars of width 0.04 and length 1, in radii; they overlap in a small central triangle.
    assert clear_circle.transmittance(550.0) - vaned.transmittance(550.0) == pytest.approx(3 * 0.04 / np.pi, rel=0.02)


@pytest.mark.parametrize(
    ("pupil", "open_at", "closed_at"),
    [
        (Spider(1, 0.1, angle_deg=90.0), [(0.0, -0.5), (0.5, 0.0)], [(0.0, 0.5), (0.05, 0.5)]),
        (Slit(0.2, angle_deg=0.0), [(0.9, 0.1)], [(0.0, 0.5)]),
        (Slit(0.2, angle_deg=90.0), [(0.1, 0.9)], [(0.5, 0.0)]),
        (Blades(3, angle_deg=90.0), [(0.0, 0.9), (0.7, -0.4)], [(0.0, -0.6), (0.5, 0.5)]),
        (Annulus(0.3), [(0.4, 0.0)], [(0.0, 0.2)]),
    ],
)
def test_pupil_is_open_at_expected_points(pupil, open_at, closed_at):
    for positions, is_open in ((open_at, True), (closed_at, False)):
        for x, y in positions:
            assert bool(pupil(np.array([x]), np.array([y]), 550.0)[0]) is is_open


def test_pupil_image_is_upright_with_square_pixels():
    picture = np.zeros((4, 4), np.uint8)
    picture[0, 3] = 255  # upper right
    picture[3, 0] = 128
    pupil = PupilImage(picture)
    x, y = points(8)

    got = pupil(x, y, 550.0)

    assert np.all(got[6:, 6:] == 1.0)
    assert np.all(got[:2, :2] == 128 / 255)
    assert got.sum() == pytest.approx(4 * (1 + 128 / 255))
    assert PupilImage(picture, values="power")(x, y, 550.0)[0, 0] == pytest.approx(np.sqrt(128 / 255))


def test_pupil_image_reads_picture_file(tmp_path):
    from PIL import Image

    n = 400
    x, y = points(n)
    Image.fromarray((255 * Annulus(0.5)(x, y, 550.0)[::-1]).astype(np.uint8)).save(tmp_path / "pupil.png")

    assert Aperture([PupilImage(tmp_path / "pupil.png")], [], 0.0).transmittance(550.0) == pytest.approx(0.75, rel=2e-3)
    with pytest.raises(FileError):
        PupilImage(tmp_path / "no.png")


def test_measured_tilt_displaces_psf():
    y = np.linspace(1.0, -1.0, 65)[:, np.newaxis] * np.ones(65)
    psf = lens(pupil=PupilImage(np.ones((2, 2)), wavefront_um=0.3 * y)).psf(WAVELENGTH_NM)
    top = np.unravel_index(psf.psf_per_um2.argmax(), psf.psf_per_um2.shape)

    # A path difference of w µm per radius tilts the wave by w/a: w 2N µm on the sensor, apart from the pixel edges.
    assert psf.grid.y_um[top[0]] == pytest.approx(0.3 * 8.0 * 65 / 64, abs=psf.grid.pitch_um)
    assert psf.grid.x_um[top[1]] == 0.0


# -- transfer functions -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("n_across", [192.0, 200.3, 333.3, 512.0])
def test_sampled_circle_otf_matches_closed_form(n_across):
    n = int(np.ceil(n_across))
    otf = Aperture([clear], [], 0.0).compute_otf(550.0, n_across, n + 3, (0.0, 0.0), np.float64)
    s = np.arange(-n - 3, n + 4) / n_across

    np.testing.assert_allclose(otf, circular_otf(np.hypot(s[:, np.newaxis], s)), rtol=0.0, atol=7e-4)
    assert otf[n + 3, n + 3] == 1.0


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 77.0])
def test_interpolated_otf_matches_closed_form(angle_deg):
    s = np.linspace(0.0, 1.2, 601)

    got = lens(pupil=clear).otf(s / LAMBDA_N_UM * 1e3, WAVELENGTH_NM, angle_deg=angle_deg)

    assert got == pytest.approx(circular_otf(s), abs=1e-9)
    assert lens().mtf(s / LAMBDA_N_UM * 1e3, WAVELENGTH_NM) == pytest.approx(circular_otf(s), abs=1e-12)


@pytest.mark.parametrize("obscuration", [0.2, 0.5, 0.8])
def test_annulus_has_oneill_mtf(obscuration):
    """Overlap of two annuli, from the lens-shaped intersections of pairs of circles."""
    s = np.linspace(0.0, 1.0, 101)

    def lens_area(r1, r2, distance):
        if distance >= r1 + r2:
            return 0.0
        if distance <= abs(r1 - r2):
            return np.pi * min(r1, r2) ** 2
        c1 = (distance**2 + r1**2 - r2**2) / (2 * distance * r1)
        c2 = (distance**2 + r2**2 - r1**2) / (2 * distance * r2)
        k = (-distance + r1 + r2) * (distance + r1 - r2) * (distance - r1 + r2) * (distance + r1 + r2)
        return r1**2 * np.arccos(c1) + r2**2 * np.arccos(c2) - 0.5 * np.sqrt(k)

    e = obscuration
    expected = [
        (lens_area(1, 1, 2 * t) - 2 * lens_area(1, e, 2 * t) + lens_area(e, e, 2 * t)) / (np.pi * (1 - e * e))
        for t in s
    ]

    assert lens(pupil=Annulus(e)).mtf(s / LAMBDA_N_UM * 1e3, WAVELENGTH_NM) == pytest.approx(expected, abs=1e-7)


def test_slit_mtf_depends_on_direction():
    slit = lens(pupil=Slit(0.1))
    frequency_per_mm = np.array([0.3, 0.9]) / LAMBDA_N_UM * 1e3

    along = slit.mtf(frequency_per_mm, WAVELENGTH_NM)
    across = slit.mtf(frequency_per_mm, WAVELENGTH_NM, angle_deg=90.0)

    # Approximately a rectangle, whose MTF is a triangle up to the cut-off of its length.
    assert along == pytest.approx([0.7, 0.1], abs=0.01)
    assert across == pytest.approx([0.0, 0.0], abs=1e-9)


# -- point spread functions -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("obscuration", [0.2, 0.4, 0.7])
def test_annulus_psf_is_airy_amplitude_difference(obscuration):
    psf = lens(pupil=Annulus(obscuration)).psf(WAVELENGTH_NM)
    v = np.pi * np.hypot(psf.grid.x_um, psf.grid.y_um[:, np.newaxis]) / LAMBDA_N_UM + 1e-12
    e = obscuration
    amplitude = 2 * j1(v) / v - e * e * 2 * j1(e * v) / (e * v)

    expected = np.pi / 4 * amplitude**2 / (1 - e * e) / LAMBDA_N_UM**2

    np.testing.assert_allclose(psf.psf_per_um2, expected, rtol=0.0, atol=1e-9 * expected.max())


def test_sampled_circle_psf_is_airy_pattern():
    closed, sampled = (lens(pupil=p).psf(WAVELENGTH_NM, n_points=129) for p in (None, clear))

    assert closed.psf_per_um2[64, 64] == pytest.approx(np.pi / 4 / LAMBDA_N_UM**2, rel=1e-9)
    np.testing.assert_allclose(sampled.psf_per_um2, closed.psf_per_um2, rtol=0.0, atol=1e-9 * closed.psf_per_um2.max())


def test_hexagon_and_three_vanes_give_six_rays():
    # Rays are perpendicular to edges: at 30, 90, 150 ... degrees for the hexagon with a vertex on the x axis.
    for pupil, first_deg in ((Blades(6), 30.0), (Spider(3, 0.03), 90.0)):
        psf = lens(pupil=pupil).psf(WAVELENGTH_NM, n_points=401, pitch_um=0.25 * LAMBDA_N_UM)
        x_um, y_um = psf.grid.x_um, psf.grid.y_um[:, np.newaxis]
        radius, angle = np.hypot(x_um, y_um) / LAMBDA_N_UM, np.degrees(np.arctan2(y_um, x_um))
        is_far = (radius > 20) & (radius < 50)
        off_ray = np.abs((angle - first_deg + 30.0) % 60.0 - 30.0)
        on, off = (psf.psf_per_um2[is_far & there].mean() for there in (off_ray < 2.0, off_ray > 10.0))

        assert on > 5 * off


def test_encircled_and_ensquared_energy_match_tables():
    """Encircled energy of the first three Airy zeros: 83.778, 90.993 and 93.765 %; squares by integration."""
    radius_um = np.array([1.21967, 2.23313, 3.23832]) * LAMBDA_N_UM
    side_um = np.array([[0.5, 1.0], [1.5, 2.0]]) * LAMBDA_N_UM
    in_squares = [[0.177327, 0.528891], [0.766734, 0.833845]]

    for optics, tolerance in ((lens(), 1e-6), (lens(pupil=clear), 5e-5)):
        got = optics.encircled_energy(radius_um, WAVELENGTH_NM)
        assert got == pytest.approx([0.83778, 0.90993, 0.93765], abs=tolerance + 5e-6)
        assert optics.ensquared_energy(side_um, WAVELENGTH_NM) == pytest.approx(np.array(in_squares), abs=tolerance)
        assert optics.encircled_energy(0.0, WAVELENGTH_NM) == 0.0
    assert lens().ensquared_energy(200.0 * LAMBDA_N_UM, WAVELENGTH_NM) == pytest.approx(1.0, abs=5e-3)


def test_ensquared_energy_is_psf_integral():
    optics = lens(pupil=(Blades(5, angle_deg=12.0), Annulus(0.3)))
    psf = optics.psf(WAVELENGTH_NM, n_points=400, pitch_um=0.01 * LAMBDA_N_UM)

    got = optics.ensquared_energy(4.0 * LAMBDA_N_UM, WAVELENGTH_NM)

    assert got == pytest.approx(psf.psf_per_um2.sum() * psf.grid.cell_area_um2, abs=1e-4)


def test_near_point_psf_scales_with_bellows_factor():
    near, far = (lens().psf(WAVELENGTH_NM, distance_m=d).grid.pitch_um for d in (0.044, None))

    assert near / far == pytest.approx(2.0)


# -- power maps--------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("cells_per_lambda_n", [4.1, 1.3, 0.4, 0.11])
def test_sampled_circle_map_matches_closed_form(cells_per_lambda_n):
    closed, sampled = lens(), lens(pupil=clear)

    data = [
        o.power_map(point_scene(o, cells_per_lambda_n, at=[(150, 150), (20, 77)])).data[0] for o in (closed, sampled)
    ]

    np.testing.assert_allclose(data[1], data[0], rtol=0.0, atol=5e-4 * data[0].max())
    assert data[1].sum() == pytest.approx(data[0].sum(), rel=1e-9)


def test_point_map_equals_psf():
    optics = lens(pupil=Blades(5, angle_deg=20.0), zernike=fs.optics.Zernike(coefficients={7: 0.1, 5: -0.05}))
    power_map = optics.power_map(point_scene(optics, 12.0, n=401))
    psf = optics.psf(WAVELENGTH_NM, distance_m=0.56, pitch_um=power_map.grid.pitch_um, n_points=401)
    fraction = power_map.data[0] / power_map.data.sum()

    # Means over cells of λN/12 against samples at their centres; the periodic map contains the total energy.
    np.testing.assert_allclose(fraction, psf.psf_per_um2 * psf.grid.cell_area_um2, rtol=0.0, atol=6e-3 * fraction.max())


@pytest.mark.parametrize(("precision", "tolerance"), [("single", 1e-5), ("double", 1e-9)])
def test_obstructed_pupil_conserves_flux(precision, tolerance):
    optics = lens(pupil=(Annulus(0.3), Spider(4, 0.02)), precision=precision)
    rng = np.random.default_rng(3)
    scene = fs.Scene(rng.random((1, 90, 110)), np.ones((1, 1)), np.array([550.0]), np.array([2.0]), 40.0, 0.56)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        got, full = (o.power_map(scene).data.sum(dtype=np.float64) for o in (optics, lens()))

    assert got / full == pytest.approx(Aperture(optics.pupil, [], 0.0).transmittance(550.0), rel=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
def test_weighted_maps_equal_weighted_sum_of_maps(precision):
    rng = np.random.default_rng(1)
    wavelength_nm = np.linspace(420.0, 700.0, 9)
    scene = fs.Scene(
        rng.random((3, 64, 80)), rng.random((3, 9)), wavelength_nm, rng.uniform(5, 20, 9), pitch_um=20.0, distance_m=0.7
    )
    optics = fs.Optics(
        focal_length_mm=25.0,
        f_number=5.6,
        precision=precision,
        pupil=lambda x, y, w: np.exp(-(x**2) * w / 500.0) * np.ones_like(y),
        zernike=fs.optics.Zernike(coefficients={8: 0.2}),
        focus_distance_m=0.8,
    )
    weights = rng.random((4, 9))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        maps = optics.power_map(scene).data.astype(np.float64)
        collapsed = np.stack(list(optics.weighted_maps(scene, weights)))

    expected = np.tensordot(weights, maps, axes=1)
    tolerance = 3e-6 if precision == "single" else 1e-12
    np.testing.assert_allclose(collapsed, expected, rtol=0.0, atol=tolerance * expected.max())


def test_pupil_depends_on_wavelength():
    """Spectral filter in the pupil: the full circle transmits red, the inner half of its radius blue."""
    optics = lens(pupil=lambda x, y, w: (x**2 + y**2 < (1.0 if w > 500.0 else 0.25)) * 1.0)
    data = optics.power_map(point_scene(optics, wavelength_nm=(450.0, 620.0))).data

    assert data[0].sum() / data[1].sum() == pytest.approx(0.25, rel=1e-3)
    assert data[0, 150, 150] / data[0].sum() < 0.6 * data[1, 150, 150] / data[1].sum()


def test_pickled_optics_excludes_cache():
    optics = lens(pupil=Blades(7))
    optics.power_map(point_scene(optics, n=101))

    again = pickle.loads(pickle.dumps(optics))

    assert len(pickle.dumps(optics)) < 2000
    assert again == optics
    assert np.array_equal(
        again.power_map(point_scene(again, n=101)).data, optics.power_map(point_scene(optics, n=101)).data
    )


def test_overlaps_are_cell_fractions():
    assert overlaps(3, 2.0, 4, 1.5).toarray() == pytest.approx(
        np.array([[0.75, 0.25, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0.25, 0.75]])
    )
    assert overlaps(2, 1.0, 8, 1.0).toarray() @ np.arange(8.0) == pytest.approx([3.0, 4.0])


# -- limits -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Annulus(1.0), "'obscuration' must be <= 0.999"),
        (lambda: Annulus(float("nan")), "'obscuration' must be finite"),
        (lambda: Blades(2), "'n_blades' must be >= 3"),
        (lambda: Slit(0.0), "'width_fraction' must be > 0"),
        (lambda: Spider(0, 0.1), "'n_vanes' must be >= 1"),
        (lambda: PupilImage(np.ones((3, 4))), "'picture' must be square, got shape"),
        (lambda: PupilImage(np.full((3, 3), 2.0)), "'picture' must be within 0 to 1, got 2.0"),
        (lambda: PupilImage(np.full((3, 3), np.nan)), "'picture' must be finite everywhere"),
        (lambda: PupilImage(np.ones((3, 3)), wavefront_um=np.ones((2, 3))), "'wavefront_um' must be square"),
        (lambda: lens(pupil="circle"), "'pupil' must be a pupil of foveasim.optics, or a callable"),
        (lambda: lens(pupil=3.0), "'pupil' must be a pupil of foveasim.optics, or a callable"),
    ],
)
def test_invalid_pupil_raises(make, message):
    with pytest.raises(ParameterError, match=f"^{message}"):
        make()


@pytest.mark.parametrize(
    ("pupil", "message"),
    [
        (lambda x, y, w: 0.0 * x * y, "'pupil' must transmit power, got an empty pupil at 550 nm"),
        ((Annulus(0.9), lambda x, y, w: x**2 + y**2 < 0.7), "'pupil' must transmit power"),
        (lambda x, y, w: np.full(x.shape, np.nan), "'pupil' must return amplitudes <= 1 at 550 nm, got nan"),
        (lambda x, y, w: 2.0, "'pupil' must return amplitudes <= 1 at 550 nm, got 2.0"),
        (
            (Annulus(0.9), lambda x, y, w: np.ones(7)),
            r"'pupil\[1\]' must return amplitudes that broadcast with x and y",
        ),
        (lambda x, y, w: "open", "'pupil' must return real or complex amplitudes"),
    ],
)
def test_invalid_pupil_amplitudes_raise_on_use(pupil, message):
    optics = lens(pupil=pupil)

    with pytest.raises(ParameterError, match=f"^{message}"):
        optics.power_map(point_scene(optics, n=101))
    with pytest.raises(ParameterError, match=f"^{message}"):
        optics.mtf(100.0, WAVELENGTH_NM)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda o: o.psf(0.0), "'wavelength_nm' must be > 0"),
        (lambda o: o.psf(-550.0), "'wavelength_nm' must be > 0"),
        (lambda o: o.psf(5.5e-7), "'wavelength_nm' must be from 10 to"),
        (lambda o: o.mtf([1.0, np.nan], 550.0), "'frequency_per_mm' must be finite everywhere"),
        (lambda o: o.mtf(1.0, 550.0, angle_deg=np.inf), "'angle_deg' must be finite"),
        (lambda o: o.psf(550.0, distance_m=0.02), "'distance_m' must be larger than the focal length, 0.022 m"),
        (lambda o: o.psf(550.0, distance_m=-1.0), "'distance_m' must be > 0"),
        (lambda o: o.psf(550.0, field_um=(1.0,)), "'field_um' must be two numbers"),
        (lambda o: o.psf(550.0, pitch_um=0.0), "'pitch_um' must be > 0"),
        (lambda o: o.psf(550.0, n_points=10**6), "'n_points' must be <= 8192"),
        (lambda o: o.encircled_energy(-1.0, 550.0), "'radius_um' must be >= 0"),
        (lambda o: o.ensquared_energy([1.0, -1.0], 550.0), "'side_um' must be >= 0"),
    ],
)
def test_invalid_point_image_argument_raises(call, message):
    with pytest.raises(ParameterError, match=f"^{message}"):
        call(lens())


def test_mtf_of_scalar_frequency_is_scalar():
    for optics in (lens(), lens(pupil=Annulus(0.3))):
        got = optics.mtf(50.0, WAVELENGTH_NM)
        assert got.shape == ()
        assert got == pytest.approx(optics.mtf([[50.0]], WAVELENGTH_NM)[0, 0])


@pytest.mark.parametrize("obscuration", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("side", [99.0, 101.0, 300.0])
def test_ensquared_energy_tail_scales_with_edge_length(side, obscuration):
    """Outside a square of side a lies 8 sqrt(2) / (π³ a) for a clear circle, times the relative edge length for an annulus."""
    edge = (1.0 + obscuration) / (1.0 - obscuration**2)
    optics = lens(pupil=Annulus(obscuration)) if obscuration else lens()
    if obscuration and side > 256.0:
        with pytest.raises(ParameterError, match=r"'side_um' must be <= 256 λN for a sampled pupil, got 660.0 µm"):
            optics.ensquared_energy(side * LAMBDA_N_UM, WAVELENGTH_NM)
        return

    tail = 1.0 - optics.ensquared_energy(side * LAMBDA_N_UM, WAVELENGTH_NM)

    assert tail == pytest.approx(edge * 8 * np.sqrt(2) / (np.pi**3 * side), rel=0.08)


@pytest.mark.parametrize(
    ("pupil", "edge"),
    [
        (clear, 1.0),
        (Annulus(0.5), 1.5 / 0.75),
        (Annulus(0.9), 1.9 / 0.19),
        (Blades(4, angle_deg=22.5), 4 * np.sqrt(2) / 2 / 2),
    ],
)
def test_aperture_edge_matches_pupil_perimeter(pupil, edge):
    aperture = Aperture([pupil], [], 0.0)

    assert aperture.edge(550.0) == pytest.approx(edge, rel=0.05)


def test_psf_beyond_sampled_range_raises():
    with pytest.raises(
        ParameterError, match=r"'pitch_um' times .* at most 512 λN = 1126 µm for a sampled pupil, got 4506 µm"
    ):
        lens(pupil=Annulus(0.3)).psf(WAVELENGTH_NM, pitch_um=LAMBDA_N_UM, n_points=4097)


def test_transparent_pupil_pixels_transmit_no_power():
    picture = np.zeros((4, 4, 4), np.uint8)
    picture[..., :3] = 255
    picture[:2, :, 3] = 255  # the upper half is opaque
    x, y = points(4)

    got = PupilImage(picture)(x, y, 550.0)

    assert got.tolist() == [[0.0] * 4] * 2 + [[1.0] * 4] * 2


@pytest.mark.parametrize(
    "picture", [np.exp(1j * np.ones((3, 3))), [["0.5", "1"], ["1", "1"]], [[1, 0], [0]], np.ones((0, 0))]
)
def test_non_numeric_pupil_image_raises(picture):
    with pytest.raises(ParameterError, match=r"^'picture' must be (an array of numbers|square)"):
        PupilImage(picture)


def test_otf_tables_are_cached_between_frames(monkeypatch):
    calls = []
    compute_otf = Aperture.compute_otf
    monkeypatch.setattr(Aperture, "compute_otf", lambda self, *a: calls.append(a) or compute_otf(self, *a))
    optics = lens(pupil=Blades(5), precision="single")
    scene = point_scene(optics, n=64, wavelength_nm=np.linspace(400.0, 700.0, 7))
    weights = np.random.default_rng(0).random((3, 7))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        first = list(optics.weighted_maps(scene, weights))
        n_first = len(calls)
        again = list(optics.weighted_maps(scene, weights))

    assert n_first == 7
    assert len(calls) == 7
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


@pytest.mark.parametrize(
    ("method", "arguments", "message"),
    [
        ("power_map", ("x.png",), "'scene' must be a Scene, got a str"),
        ("grid", (None,), "'scene' must be a Scene, got a NoneType"),
        ("field_error", (np.ones((3, 3)),), "'scene' must be a Scene, got an ndarray"),
        ("weighted_maps", ("scene", np.ones((2, 2))), r"'weights' must have shape \(n_output, 1\)"),
        ("weighted_maps", ("scene", [1.0]), "'weights' must have 2 dimensions"),
        ("mtf", (np.ones(2), np.ones(3)), "'wavelength_nm' must be one number"),
    ],
)
def test_invalid_scene_or_weights_raise(method, arguments, message):
    optics = lens(pupil=Annulus(0.2))
    scene = point_scene(optics, n=64)

    with pytest.raises(ParameterError, match=f"^{message}"):
        getattr(optics, method)(*(scene if isinstance(a, str) and a == "scene" else a for a in arguments))


@pytest.mark.parametrize("pupil", [Annulus, lambda x: x, [Annulus(0.2), None], print])
def test_uncallable_pupil_raises(pupil):
    if pupil is print:  # accepts any arguments and returns None
        with pytest.raises(ParameterError, match="'pupil' must return real or complex amplitudes"):
            lens(pupil=pupil).mtf(1.0, 550.0)
        return
    with pytest.raises(ParameterError, match=r"^'pupil' must be a pupil"):
        lens(pupil=pupil)


def test_invalid_distance_and_padding_raise():
    optics = lens(padding="zero", padding_cells=200_000)

    with pytest.raises(ParameterError, match="'distance_m' must be one number"):
        optics.strehl(550.0, distance_m=np.ones(3))
    with pytest.raises(
        ParameterError,
        match=r"'padding_cells' must give a padded picture of at most 131072 cells, got 301 \+ 2 x 200000 = 400301",
    ):
        list(optics.weighted_maps(point_scene(optics), [[1.0]]))


def test_pupil_list_is_copied():
    pupils = [Annulus(0.2)]
    optics = lens(pupil=pupils)
    pupils.append(Slit(0.1))

    assert optics.pupil == (Annulus(0.2),)
