"""
PSF and OTF of the pupil, in focus, out of focus, and with aberrations.

All programs have the same pupil: a focal length of 8 mm, f/4 and 550 nm if not stated otherwise. prysm and POPPY sample it,
and transform the samples to the image plane; they are as accurate as the staircase of its edge and their number of samples
(512 across the pupil) permit. foveasim integrates over the pupil by Gauss quadrature between its edges, and has closed forms
for the OTF of pupils of circular symmetry.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.polynomial.legendre import leggauss
from records import OWN, Section, largest_absolute, version_of
from scipy.special import j1

import foveasim as fs

FOCAL_MM, F_NUMBER, WAVELENGTH_NM = 8.0, 4.0, 550.0
DIAMETER_MM = FOCAL_MM / F_NUMBER
#: Points of the PSF along either axis, centred, and their pitch.
N_POINTS, PITCH_UM = 127, 0.25
#: Samples across the pupil of programs that sample it.
N_PUPIL = 512
LAMBDA_N_UM = 1e-3 * WAVELENGTH_NM * F_NUMBER
AT_UM = PITCH_UM * (np.arange(N_POINTS) - N_POINTS // 2)
RADIUS_UM = np.hypot(*np.meshgrid(AT_UM, AT_UM))
GOODMAN = "Goodman, Introduction to Fourier Optics (2017)"
BORN = "Born and Wolf, Principles of Optics (1999)"
#: Root mean square of Zernike coefficients, waves: defocus, coma in y, spherical aberration (Noll).
ABERRATED = {4: 0.15, 7: 0.1, 11: 0.05}


def airy(ratio: float = 0.0) -> np.ndarray:
    """Return the PSF of a pupil with a circular obstruction of a relative diameter, relative to its peak."""
    v = np.pi * RADIUS_UM / LAMBDA_N_UM
    outer, inner = (2.0 * jinc(v), 2.0 * ratio**2 * jinc(ratio * v))
    return ((outer - inner) / (1.0 - ratio**2)) ** 2


def airy_at(radius_um: np.ndarray, lambda_n_um: float) -> np.ndarray:
    """Return the PSF of a circular pupil at distances from its centre, relative to its peak."""
    return (2.0 * jinc(np.pi * radius_um / lambda_n_um)) ** 2


def jinc(v: np.ndarray) -> np.ndarray:
    """Return J1(v)/v."""
    return np.divide(j1(v), v, out=np.full_like(v, 0.5), where=v > 0.0)


def by_quadrature(opd_waves: Callable[[np.ndarray, np.ndarray], np.ndarray], n: int = 200) -> np.ndarray:
    """
    Return the PSF of a wavefront over the points, relative to its peak without wavefront.

    ``opd_waves``: function of (r, θ) in the unit disc. Gauss-Legendre nodes along the radius, and equal steps of the angle,
    for which the sum converges exponentially; twice as many change the result by less than 1e-12.
    """
    node, weight = leggauss(n)
    r, theta = 0.5 * (node[:, np.newaxis] + 1.0), np.pi / n * np.arange(2 * n)
    pupil = weight[:, np.newaxis] * r * np.exp(2j * np.pi * opd_waves(r, theta)) / (2 * n)
    per_um = np.pi / LAMBDA_N_UM * AT_UM[:, np.newaxis]
    x, y = (r * np.cos(theta)).ravel(), (r * np.sin(theta)).ravel()
    field = (np.exp(-1j * per_um * y) * pupil.ravel()) @ np.exp(-1j * per_um * x).T
    return np.abs(field) ** 2


def aberrated_waves(r: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return the wavefront of :data:`ABERRATED`, from the polynomials of Noll, J. Opt. Soc. Am. 66, 207 (1976)."""
    return (
        ABERRATED[4] * np.sqrt(3.0) * (2.0 * r**2 - 1.0)
        + ABERRATED[7] * np.sqrt(8.0) * (3.0 * r**3 - 2.0 * r) * np.sin(theta)
        + ABERRATED[11] * np.sqrt(5.0) * (6.0 * r**4 - 6.0 * r**2 + 1.0)
    )


def own_psf(**pupil: object) -> np.ndarray:
    """Return the PSF of foveasim, 1/µm²."""
    optics = fs.Optics(focal_length_mm=FOCAL_MM, f_number=F_NUMBER, **pupil)
    return optics.psf(WAVELENGTH_NM, pitch_um=PITCH_UM, n_points=N_POINTS).psf_per_um2


def prysm_psf(
    opd_waves: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None, obscuration: float = 0.0
) -> np.ndarray:
    """Return the PSF of prysm, in its own unit."""
    from prysm.coordinates import cart_to_polar, make_xy_grid
    from prysm.propagation import Wavefront

    x, y = make_xy_grid(N_PUPIL, diameter=DIAMETER_MM)
    r, theta = cart_to_polar(x, y)
    r = r / (0.5 * DIAMETER_MM)
    amplitude = ((r <= 1.0) & (r >= obscuration)).astype(np.float64)
    opd_nm = None if opd_waves is None else WAVELENGTH_NM * opd_waves(r, theta)
    wave = Wavefront.from_amp_and_phase(amplitude, opd_nm, 1e-3 * WAVELENGTH_NM, DIAMETER_MM / N_PUPIL)
    return np.asarray(wave.focus_fixed_sampling(FOCAL_MM, PITCH_UM, N_POINTS).intensity.data)


def poppy_psf(zernike_waves: dict[int, float] | None = None, obscuration: float = 0.0) -> np.ndarray:
    """Return the PSF of POPPY, in its own unit."""
    import poppy

    radius_m = 0.5e-3 * DIAMETER_MM
    system = poppy.OpticalSystem(npix=N_PUPIL, oversample=1, pupil_diameter=2.0 * radius_m)
    system.add_pupil(poppy.CircularAperture(radius=radius_m))
    if obscuration:
        system.add_pupil(poppy.SecondaryObscuration(secondary_radius=obscuration * radius_m, n_supports=0))
    if zernike_waves:
        coefficients = np.zeros(max(zernike_waves))
        for noll, waves in zernike_waves.items():
            coefficients[noll - 1] = 1e-9 * WAVELENGTH_NM * waves
        system.add_pupil(poppy.ZernikeWFE(coefficients=coefficients, radius=radius_m))
    arcsec = np.degrees(1e-3 * PITCH_UM / FOCAL_MM) * 3600.0
    system.add_detector(pixelscale=arcsec, fov_pixels=N_POINTS)
    return np.asarray(system.calc_psf(1e-9 * WAVELENGTH_NM)[0].data)[::-1]  # its y points downwards


def relative_to(unaberrated: Callable[[], np.ndarray], psf: Callable[[], np.ndarray]) -> Callable[[], np.ndarray]:
    """Return a function of a PSF relative to the peak of another one, which is computed once."""
    peak = cache(lambda: unaberrated().max())
    return lambda: psf() / peak()


def hopkins_otf(per_cutoff: np.ndarray, w20_waves: float, n: int = 400) -> np.ndarray:
    """
    Return the OTF of a circular pupil out of focus, by quadrature over the overlap of two discs.

    H. H. Hopkins, Proc. R. Soc. A 231, 91 (1955): for the shift 2s of two unit discs, s = f over the cutoff, the difference of
    the wavefronts W20 ((x + s)² - (x - s)²) is linear in x, so that the integral over y is a length.
    """
    node, weight = leggauss(n)
    found = []
    for s in per_cutoff:
        # x = (1 - s) sin t removes the square root at the ends of the overlap.
        t, w = 0.5 * np.pi * node, 0.5 * np.pi * weight
        x = (1.0 - s) * np.sin(t)
        length = 2.0 * np.sqrt(1.0 - (np.abs(x) + s) ** 2)
        found.append(np.sum(w * (1.0 - s) * np.cos(t) * length * np.cos(8.0 * np.pi * w20_waves * s * x)) / np.pi)
    return np.array(found)


def validate(section: Section, directory: Path) -> None:
    """Compare PSFs with closed forms and quadrature, and OTFs with closed forms."""
    prysm, poppy = f"prysm {version_of('prysm')}", f"POPPY {version_of('poppy')}"
    coarse = "the edge of its pupil is a staircase of samples"
    section.compare(
        "PSF of a circular pupil",
        {
            OWN: relative_to(own_psf, own_psf),
            prysm: relative_to(prysm_psf, prysm_psf),
            poppy: relative_to(poppy_psf, poppy_psf),
        },
        airy(),
        by="[2 J₁(v)/v]²",
        source=f"{GOODMAN}, section 4.4.2",
        tolerance=1e-6,
        cannot={prysm: coarse, poppy: "weights samples at the edge by their part inside"},
    )
    ring = {"obscuration": 0.4}
    section.compare(
        "PSF of an annular pupil, obscuration 0.4",
        {
            OWN: relative_to(
                lambda: own_psf(pupil=fs.optics.Annulus(0.4)), lambda: own_psf(pupil=fs.optics.Annulus(0.4))
            ),
            prysm: relative_to(lambda: prysm_psf(**ring), lambda: prysm_psf(**ring)),
            poppy: relative_to(lambda: poppy_psf(**ring), lambda: poppy_psf(**ring)),
        },
        airy(0.4),
        by="difference of two J₁(v)/v",
        source=f"{BORN}, section 8.6.2",
        tolerance=1e-6,
    )
    zernike = fs.optics.Zernike(coefficients=ABERRATED, unit="waves")
    found = section.compare(
        "PSF with defocus, coma and spherical aberration, 0.19 waves rms",
        {
            OWN: relative_to(own_psf, lambda: own_psf(zernike=zernike)),
            prysm: relative_to(prysm_psf, lambda: prysm_psf(aberrated_waves)),
            poppy: relative_to(poppy_psf, lambda: poppy_psf(ABERRATED)),
        },
        by_quadrature(aberrated_waves) / by_quadrature(lambda r, theta: 0.0 * r * theta).max(),
        by="quadrature over the pupil, 80,000 nodes",
        source="Noll (1976) for the polynomials",
        explanation="The y axis of POPPY points downwards. The reason of its remaining deviation is open.",
        tolerance=1e-5,
        of="of the peak without aberrations",
        deviation=largest_absolute,
    )
    w20_waves = np.linspace(0.05, 1.45, 15)
    middle = N_POINTS // 2
    section.compare(
        "intensity on the axis out of focus, W₂₀ up to 1.45 waves",
        {
            OWN: lambda: np.array([own_psf(zernike=defocus(w))[middle, middle] for w in w20_waves]) / own_psf().max(),
            prysm: lambda: (
                np.array([prysm_psf(lambda r, _, w=w: w * r**2)[middle, middle] for w in w20_waves]) / prysm_psf().max()
            ),
        },
        np.sinc(w20_waves) ** 2,
        by="[sin(π W₂₀)/(π W₂₀)]²",
        source=f"{BORN}, section 8.8.2",
        tolerance=1e-6,
        deviation=largest_absolute,
        of="of the peak in focus",
        repeats=0,
    )
    per_cutoff = np.linspace(0.02, 0.98, 49)
    per_mm = per_cutoff * 1e3 / LAMBDA_N_UM
    for what, w20, truth, by, source in (
        ("in focus", 0.0, disc_overlap(per_cutoff), "overlap of two discs", f"{GOODMAN}, section 7.3.2"),
        (
            "out of focus, W₂₀ = 0.75 waves",
            0.75,
            hopkins_otf(per_cutoff, 0.75),
            "integral over the overlap of two discs, 400 nodes",
            "Hopkins, Proc. R. Soc. A 231, 91 (1955)",
        ),
    ):
        section.compare(
            f"OTF {what}",
            {
                OWN: lambda w=w20: own_otf(per_mm, w),
                prysm: lambda w=w20: prysm_otf(per_mm, w),
            },
            truth,
            by=by,
            source=source,
            tolerance=5e-6,
            deviation=largest_absolute,
            cannot={prysm: "transforms the PSF within a window of 1024 cells of λN/4"},
        )
    draw_psf(section, directory, found)


def defocus(w20_waves: float) -> fs.optics.Zernike:
    """Return the polynomial of a wavefront W20 r², without its mean."""
    return fs.optics.Zernike(coefficients={4: w20_waves / (2.0 * np.sqrt(3.0))}, unit="waves")


def own_otf(per_mm: np.ndarray, w20_waves: float) -> np.ndarray:
    """Return the OTF of foveasim."""
    wavefront = defocus(w20_waves) if w20_waves else None
    optics = fs.Optics(focal_length_mm=FOCAL_MM, f_number=F_NUMBER, zernike=wavefront)
    return optics.otf(per_mm, WAVELENGTH_NM).real


def prysm_otf(per_mm: np.ndarray, w20_waves: float) -> np.ndarray:
    """Return the OTF of prysm, interpolated linearly between its frequencies."""
    from prysm.coordinates import cart_to_polar, make_xy_grid
    from prysm.otf import otf_from_psf
    from prysm.propagation import Wavefront

    r, _ = cart_to_polar(*make_xy_grid(N_PUPIL, diameter=DIAMETER_MM))
    r = r / (0.5 * DIAMETER_MM)
    wave = Wavefront.from_amp_and_phase(
        (r <= 1.0).astype(np.float64), w20_waves * WAVELENGTH_NM * r**2, 1e-3 * WAVELENGTH_NM, DIAMETER_MM / N_PUPIL
    )
    psf = wave.focus_fixed_sampling(FOCAL_MM, 0.25 * LAMBDA_N_UM, 1024).intensity
    transform = otf_from_psf(psf)
    row = transform.data[transform.data.shape[0] // 2].real
    row = row[row.size // 2 :]
    return np.interp(per_mm, transform.dx * np.arange(row.size), row)


def disc_overlap(per_cutoff: np.ndarray) -> np.ndarray:
    """Return the OTF of a circular pupil in focus."""
    return 2.0 / np.pi * (np.arccos(per_cutoff) - per_cutoff * np.sqrt(1.0 - per_cutoff**2))


def draw_psf(section: Section, directory: Path, found: dict[str, np.ndarray]) -> None:
    """Draw the aberrated PSF along y, and deviations from the truth."""
    truth = by_quadrature(aberrated_waves) / by_quadrature(lambda r, theta: 0.0 * r * theta).max()
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    psf, error = figure.subplots(1, 2)
    for program, values in found.items():
        psf.semilogy(AT_UM, values[:, N_POINTS // 2], label=program)
        error.semilogy(AT_UM, np.abs(values - truth)[:, N_POINTS // 2] + 1e-17, label=program)
    psf.set(xlabel="y / µm", ylabel="PSF / peak in focus", ylim=(1e-6, 1.0))
    error.set(xlabel="y / µm", ylabel="deviation", ylim=(1e-16, 1e-1))
    error.legend(fontsize="small")
    section.draw(
        "psf", figure, "PSF with defocus, coma and spherical aberration through its centre, and deviations.", directory
    )
