"""Point images against polar quadrature, exact overlaps and closed forms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import shapely
from reference.pupil_integrals import pupil_integrals, pupil_nodes
from scipy.special import j1

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.optics import Annulus, Blades, PupilEdges, PupilImage, Slit, Spider, Zernike, noll_to_nm, zernike

WAVELENGTH_NM = 550.0
LAMBDA_N_UM = 0.55 * 4.0
GREY = np.random.default_rng(1).random((6, 6))
#: Every kind of pupil, and combinations of edges that cross each other; quadratures of many pieces need few nodes for each.
PUPILS = {
    "circle": ((), {"n_radial": 140}),
    "annulus": ((Annulus(0.5),), {"n_radial": 100}),
    "thin annulus": ((Annulus(0.95),), {"n_radial": 80}),
    "hexagon": ((Blades(6, angle_deg=17.0),), {"n_radial": 60}),
    "pentagon": ((Blades(5),), {"n_radial": 60}),
    "slit": ((Slit(0.3, angle_deg=25.0),), {"n_radial": 80}),
    "spider": ((Spider(3, 0.02, angle_deg=10.0),), {"n_radial": 70}),
    "obstructed": ((Spider(4, 0.02), Annulus(0.3)), {"n_radial": 60}),
    "heptagon and slit": ((Blades(7, angle_deg=3.0), Slit(0.6, angle_deg=40.0)), {"n_radial": 40}),
    "picture": ((PupilImage(GREY),), {"n_radial": 24}),
}
TERMS = (4, 7, 22, 36)


def lens(pupils=(), **coefficients):
    terms = {int(name[1:]): waves for name, waves in coefficients.items()}
    return fs.Optics(
        focal_length_mm=22.0,
        f_number=4.0,
        pupil=tuple(pupils) or None,
        zernike=Zernike(coefficients=terms, unit="waves") if terms else None,
    )


def clear(x, y, wavelength_nm):
    return np.ones(np.broadcast_shapes(x.shape, y.shape))


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize(
    ("name", "term"), [(name, term) for k, name in enumerate(PUPILS) for term in TERMS[k % 2 :: 2]]
)
def test_psf_and_strehl_match_polar_quadrature(name, term):
    pupils, accuracy = PUPILS[name]
    optics = lens(pupils, **{f"z{term}": 0.5})
    # Samples at λN/8 within 16 λN, and at λN within 64 λN.
    rng = np.random.default_rng(term)
    narrow = optics.psf(WAVELENGTH_NM)
    wide = optics.psf(WAVELENGTH_NM, pitch_um=LAMBDA_N_UM, n_points=129)
    at = np.concatenate((rng.integers(96, 161, (20, 2)), rng.integers(0, 257, (6, 2)), [(128, 128)]))
    at_wide = rng.integers(40, 89, (6, 2))
    points = np.concatenate(
        [
            np.stack((psf.grid.x_um[i[:, 1]], psf.grid.y_um[i[:, 0]]), axis=1)
            for psf, i in ((narrow, at), (wide, at_wide))
        ]
    )

    psf, strehl = pupil_integrals(
        pupils, lambda x, y: 0.5 * zernike(*noll_to_nm(term), x, y), points / LAMBDA_N_UM, **accuracy
    )

    got = np.concatenate((narrow.psf_per_um2[tuple(at.T)], wide.psf_per_um2[tuple(at_wide.T)])) * LAMBDA_N_UM**2
    assert got == pytest.approx(psf, abs=1e-6 * narrow.psf_per_um2.max() * LAMBDA_N_UM**2)
    assert optics.strehl(WAVELENGTH_NM, reference="image_point") == pytest.approx(strehl, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pupil", "first"),
    [((), 2), ((Annulus(0.5),), 3), ((Blades(6), Spider(3, 0.02)), 4)],
    ids=["circle", "annulus", "star"],
)
def test_strehl_matches_quadrature_for_36_terms(pupil, first):
    x, y, weight = pupil_nodes(pupil, n_radial=90)
    for one in pupil:
        weight = weight * one(x, y, WAVELENGTH_NM)
    for term in range(first, 37, 3):
        wave = np.exp(1j * np.pi * zernike(*noll_to_nm(term), x, y))

        got = lens(pupil, **{f"z{term}": 0.5}).strehl(WAVELENGTH_NM, reference="image_point")

        assert got == pytest.approx(np.abs(weight @ wave) ** 2 / weight.sum() ** 2, rel=1e-6), term


@pytest.mark.slow
@pytest.mark.parametrize("name", ["circle", "obstructed", "picture"])
def test_psf_is_independent_of_window(name):
    optics = lens(PUPILS[name][0], z8=0.5, z36=-0.2)
    small, large = (optics.psf(WAVELENGTH_NM, n_points=n).psf_per_um2 for n in (65, 513))

    np.testing.assert_allclose(small, large[224:289, 224:289], rtol=0.0, atol=1e-8 * large.max())


# -- optical transfer functions ---------------------------------------------------------------------------------------


def polygon_of(pupil):
    """Return the open area of blades, slits and spiders, exactly; within the unit circle for blades."""
    if isinstance(pupil, Blades):
        angles = np.radians(pupil.angle_deg + 360.0 / pupil.n_blades * np.arange(pupil.n_blades))
        return shapely.Polygon(np.stack((np.cos(angles), np.sin(angles)), axis=1))
    if isinstance(pupil, Slit):
        w = pupil.width_fraction
        return shapely.affinity.rotate(shapely.box(-2.0, -w, 2.0, w), pupil.angle_deg, origin=(0.0, 0.0))
    w = pupil.width_fraction
    vanes = [
        shapely.affinity.rotate(
            shapely.box(0.0, -w, 2.0, w), pupil.angle_deg + 360.0 / pupil.n_vanes * k, origin=(0.0, 0.0)
        )
        for k in range(pupil.n_vanes)
    ]
    return shapely.box(-2.0, -2.0, 2.0, 2.0).difference(shapely.union_all(vanes))


def triangle_nodes(area, n=24):
    """Return Gauss nodes and weights over the triangles of a polygonal area."""
    node, weight = np.polynomial.legendre.leggauss(n)
    u, v = (a.ravel() for a in np.meshgrid(0.5 * (node + 1.0), 0.5 * (node + 1.0), indexing="ij"))
    jacobian = np.outer(weight, weight).ravel() * 0.25 * u
    found = []
    for triangle in shapely.constrained_delaunay_triangles(area).geoms:
        a, b, c = np.array(triangle.exterior.coords)[:3]
        xy = a + np.outer(u * (1.0 - v), b - a) + np.outer(u * v, c - a)
        found.append(np.column_stack((xy, jacobian * 2.0 * triangle.area)))
    return np.concatenate(found).T if found else np.zeros((3, 0))


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 33.0])
@pytest.mark.parametrize(
    "pupils", [(Blades(5, angle_deg=20.0),), (Blades(6), Slit(0.4, angle_deg=30.0), Spider(3, 0.03))]
)
def test_otf_matches_quadrature_over_polygon_overlap(pupils, angle_deg):
    optics = lens(pupils, z7=0.2, z11=-0.1)
    s = np.array([0.003, 0.1, 0.35, 0.6, 0.85])
    direction = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    area = shapely.intersection_all([polygon_of(pupil) for pupil in pupils])

    got = optics.otf(s / LAMBDA_N_UM * 1e3, WAVELENGTH_NM, angle_deg=angle_deg)

    for k, (dx, dy) in enumerate(np.outer(s, direction)):
        copies = [shapely.affinity.translate(area, sign * dx, sign * dy) for sign in (-1.0, 1.0)]
        x, y, weight = triangle_nodes(shapely.intersection(*copies))
        path = [
            0.2 * zernike(3, -1, x + t * dx, y + t * dy) - 0.1 * zernike(4, 0, x + t * dx, y + t * dy) for t in (-1, 1)
        ]
        expected = weight @ np.exp(2j * np.pi * (path[0] - path[1])) / area.area
        assert got[k] == pytest.approx(expected, abs=1e-7)


def test_otf_of_picture_is_pixel_correlation():
    """At lags of complete pixels, the correlation of uniform squares within the circle."""
    n = 16
    picture = np.zeros((n, n))
    picture[4:12, 4:12] = np.random.default_rng(5).random((8, 8))
    lags = np.arange(9)
    frequency_per_mm = 1e3 * lags / n / LAMBDA_N_UM

    got = lens([PupilImage(picture)]).otf(frequency_per_mm, WAVELENGTH_NM)

    expected = [(picture[:, : n - k] * picture[:, k:]).sum() / (picture**2).sum() for k in lags]
    assert got == pytest.approx(np.array(expected), abs=1e-9)


@pytest.mark.slow
def test_otf_is_transform_of_psf():
    """The phase of the OTF has the sign of its definition, also for an asymmetric PSF."""
    optics = lens([Blades(5, angle_deg=11.0)], z7=0.3, z10=0.1, z2=0.2)
    psf = optics.psf(WAVELENGTH_NM, pitch_um=0.4 * LAMBDA_N_UM, n_points=501)
    s = np.array([0.05, 0.2, 0.5])

    got = optics.otf(s / LAMBDA_N_UM * 1e3, WAVELENGTH_NM, angle_deg=40.0)

    x, y = (at * np.outer(s, [np.cos(np.radians(40.0)), np.sin(np.radians(40.0))])[:, [k]] for k, at in
            enumerate((psf.grid.x_um / LAMBDA_N_UM, psf.grid.y_um / LAMBDA_N_UM)))  # fmt: skip
    energy = psf.psf_per_um2 * psf.grid.cell_area_um2
    expected = np.einsum("ky,yx,kx->k", np.exp(-2j * np.pi * y), energy, np.exp(-2j * np.pi * x), optimize=True)
    # The energy beyond 100 λN: 3e-3 beyond 200 λN, and inversely proportional to the radius.
    assert got == pytest.approx(expected, abs=6e-3)


# -- callables ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stop:
    """Open within a circle and above a line, with the edges of both."""

    radius: float

    def __call__(self, x, y, wavelength_nm):
        return (x * x + y * y <= self.radius**2) & (y >= 0.0 * x)

    def edges(self):
        return PupilEdges(radii=[self.radius], segments=np.array([[(-1.0, 0.0), (1.0, 0.0)]]))


def test_callable_with_edges_is_integrated_exactly():
    """On the x axis, the amplitude of half a circle is half that of the circle."""
    psf = lens([Stop(0.7)]).psf(WAVELENGTH_NM, n_points=65)
    v = 0.7 * np.pi * psf.grid.x_um / LAMBDA_N_UM
    amplitude = 0.5 * 0.7**2 * np.pi * 2.0 * j1(v + 1e-12) / (v + 1e-12)
    imaginary = np.abs(_half_disc_field(0.7, psf.grid.x_um / LAMBDA_N_UM))

    assert imaginary == pytest.approx(np.abs(amplitude), abs=1e-12)
    assert psf.psf_per_um2[32] == pytest.approx(
        amplitude**2 / (4.0 * 0.5 * np.pi * 0.7**2) / LAMBDA_N_UM**2, abs=1e-9 * psf.psf_per_um2.max()
    )


def _half_disc_field(radius, x_lambda_n):
    node, weight = np.polynomial.legendre.leggauss(80)
    x = np.sin(0.5 * np.pi * node)
    chord = np.cos(0.5 * np.pi * node) ** 2 * 0.5 * np.pi * weight
    return radius**2 * np.exp(-1j * np.pi * radius * np.outer(x_lambda_n, x)) @ chord


def test_gaussian_callable_has_closed_form_strehl():
    """Gaussian amplitude and defocus: an integral over r² in closed form."""
    width, waves = 0.8, 0.35
    optics = lens([lambda x, y, _: np.exp(-(x * x + y * y) * width)], z4=waves / np.sqrt(12.0))

    a = width - 2j * np.pi * waves
    expected = np.abs((1.0 - np.exp(-a)) / a) ** 2 / ((1.0 - np.exp(-width)) / width) ** 2
    assert optics.strehl(WAVELENGTH_NM, reference="image_point") == pytest.approx(expected, rel=1e-9)


def test_discontinuous_callable_is_sampled():
    """Edges that the package does not know: a circle of half the radius and of twice the PSF's size."""
    stop = lens([lambda x, y, _: (x * x + y * y <= 0.25) * 1.0])
    psf = stop.psf(WAVELENGTH_NM, n_points=65)
    v = 0.5 * np.pi * np.hypot(psf.grid.x_um, psf.grid.y_um[:, np.newaxis]) / LAMBDA_N_UM + 1e-12
    expected = 0.25 * np.pi / 4.0 * (2.0 * j1(v) / v) ** 2 / LAMBDA_N_UM**2
    s = np.linspace(0.0, 0.6, 13)

    assert psf.psf_per_um2 == pytest.approx(expected, abs=1e-3 * expected.max())
    assert stop.mtf(s / LAMBDA_N_UM * 1e3, WAVELENGTH_NM) == pytest.approx(fs.optics.circular_otf(2.0 * s), abs=2e-3)
    assert stop.strehl(WAVELENGTH_NM) == pytest.approx(1.0)


def test_many_vanes_are_integrated():
    """Overlapping vanes: 40 of them cover the centre, and the open sectors are equal."""
    n, w = 40, 0.03
    psf = lens([Spider(n, w)]).psf(WAVELENGTH_NM, n_points=1)
    # The vanes touch at the radius w / sin(π/n); beyond it, each sector is open between two lines.
    r, dr = np.polynomial.legendre.leggauss(60)
    low = w / np.sin(np.pi / n)
    r, dr = 0.5 * (1.0 + low) + 0.5 * (1.0 - low) * r, 0.5 * (1.0 - low) * dr
    area = n * ((2.0 * np.pi / n - 2.0 * np.arcsin(w / r)) * r) @ dr

    assert psf.psf_per_um2[0, 0] * LAMBDA_N_UM**2 == pytest.approx(area / 4.0, rel=1e-9)


def test_invalid_edges_raise():
    with pytest.raises(ParameterError, match="'segments' must have shape"):
        PupilEdges(segments=np.zeros((3, 2)))
    with pytest.raises(ParameterError, match="'radii' must be"):
        PupilEdges(radii=[float("nan")])


@pytest.mark.parametrize(
    ("pupil", "fraction"),
    [
        (lambda x, y, _: np.hypot(x - 0.31, y - 0.17) < 0.05, 0.0025),
        (lambda x, y, _: np.hypot(x - 0.31, y - 0.17) >= 0.05, 0.9975),
        (lambda x, y, _: np.abs(y - 0.31) >= 0.01 + 0.0 * x, 1.0 - 0.04 * np.sqrt(1.0 - 0.31**2) / np.pi),
    ],
    ids=["hole", "speck", "vane"],
)
def test_small_features_of_callables_are_seen(pupil, fraction):
    clear_peak, peak = (
        fs.Optics(focal_length_mm=22.0, f_number=4.0, pupil=each).psf(WAVELENGTH_NM, n_points=9).psf_per_um2.max()
        for each in (None, lambda x, y, nm: pupil(x, y, nm).astype(float))
    )

    # The peak of a real pupil is proportional to its area.
    assert peak / clear_peak == pytest.approx(fraction, rel=2e-2 if fraction < 0.5 else 2e-3)
