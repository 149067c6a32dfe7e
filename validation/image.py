"""
Images of waves, of a picture and of a point on square photosites.

A lens of f/4 forms the image at 550 nm. foveasim multiplies the spectrum of the picture by the OTF of the lens, and integrates
the power map over the outlines of the photosites. GalSim convolves the points of the picture with its Airy profile and a
pixel in Fourier space. SciPy and OpenCV have no optics: they convolve the picture with a PSF that is integrated over the
pixels, truncated, and normalised. All programs have the same picture, which continues periodically beyond the photosites that
are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import galsim
import numpy as np
import scipy.ndimage
import scipy.signal
from diffraction import airy_at, disc_overlap
from matplotlib.figure import Figure
from numpy.polynomial.legendre import leggauss
from records import OWN, Section, largest, largest_absolute, version_of

import foveasim as fs

FOCAL_MM, F_NUMBER, WAVELENGTH_NM, DISTANCE_M = 8.0, 4.0, 550.0, 1e4
LAMBDA_N_UM = 1e-3 * WAVELENGTH_NM * F_NUMBER / (1.0 - 1e-3 * FOCAL_MM / DISTANCE_M)
PITCH_UM = 3.0
#: Waves: cells along a photosite, photosites along a side, and periods along the sides of the picture.
N_FINE, N_WAVES = 6, 256
PERIODS = ((6, 0), (0, 30), (51, 0), (37, 61), (-90, 20), (64, 101), (118, -35), (20, 127), (190, 60), (300, -120))
#: Photosites of the picture along a side, and those around them that are not compared.
N_PICTURE, MARGIN = 512, 48
#: Cells of the truncated PSF of SciPy and OpenCV, for the waves and for the picture, and samples along a side of a cell.
WAVE_KERNEL, PICTURE_KERNEL, N_SAMPLES = 385, 97, 9
#: Cells that GalSim has around a picture.
GALSIM_CELLS = 192
#: Photosites of the image of a point, their pitch, and the position of the point from the centre of the middle one.
N_POINT, POINT_PITCH_UM, POINT_UM = 31, 1.1, (0.33, -0.22)
GOODMAN = "Goodman, Introduction to Fourier Optics (2017)"


def lens(**options: object) -> fs.Optics:
    """Return the lens, without the falloff towards the corners, which other programs do not model."""
    even = fs.optics.IlluminationTable(image_height_um=[0.0, 1e5], fraction=[1.0, 1.0])
    return fs.Optics(focal_length_mm=FOCAL_MM, f_number=F_NUMBER, relative_illumination=even, **options)


def scene_of(picture: np.ndarray, cell_um: float) -> fs.Scene:
    """Return the scene whose pixels have an image of ``cell_um``."""
    pitch_um = cell_um / lens().magnification(DISTANCE_M)
    return fs.Scene(picture[np.newaxis], np.ones((1, 1)), [WAVELENGTH_NM], [1.0], pitch_um, DISTANCE_M)


def camera_of(layout: fs.Layout, **options: object) -> Callable[[fs.Scene], np.ndarray]:
    """Return a function of a scene: light of square photosites, relative to a scene of radiance 1."""
    optics = lens(**options)
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout, qe=1.0), order=2)
    per_radiance = optics.irradiance_per_radiance(DISTANCE_M) * 1e-12 * layout.area_um2
    per_radiance = per_radiance / fs.units.photon_energy_j(WAVELENGTH_NM)
    side = round(layout.n_sites**0.5)
    return lambda scene: (camera.photoelectrons_per_s(scene) / per_radiance).reshape(side, side)


@cache
def kernel_of(n_cells: int, cell_um: float) -> np.ndarray:
    """Return the Airy PSF in cells: means of 9 x 9 samples, normalised."""
    at = cell_um / N_SAMPLES * (np.arange(n_cells * N_SAMPLES) - 0.5 * (n_cells * N_SAMPLES - 1))
    psf = airy_at(np.hypot(at, at[:, np.newaxis]), LAMBDA_N_UM)
    cells = psf.reshape(n_cells, N_SAMPLES, n_cells, N_SAMPLES).mean(axis=(1, 3))
    return cells / cells.sum()


def galsim_image(picture: np.ndarray, cell_um: float, n_sites: int, folding: float = 1e-3) -> np.ndarray:
    """
    Return the image of points on square pixels, in the middle of a picture, by GalSim.

    GalSim takes the lattice of points for band-limited at a frequency below the cut-off of the lens, if not told otherwise.
    """
    parameters = galsim.GSParams(maximum_fft_size=16384, folding_threshold=folding)
    light = galsim.InterpolatedImage(
        galsim.Image(picture, scale=cell_um),
        x_interpolant="delta",
        normalization="sb",
        _force_maxk=2.0 * np.pi / LAMBDA_N_UM,
        gsparams=parameters,
    )
    airy = galsim.Airy(lam_over_diam=LAMBDA_N_UM, gsparams=parameters)
    image = galsim.Convolve(light, airy, gsparams=parameters)
    return image.drawImage(nx=n_sites, ny=n_sites, scale=PITCH_UM, dtype=float).array / PITCH_UM**2


def validate(section: Section, directory: Path) -> None:
    """Compare waves, a picture, and a point."""
    compare_waves(section, directory)
    compare_picture(section)
    compare_point(section)


# -- waves ------------------------------------------------------------------------------------------------------------


def waves_picture() -> np.ndarray:
    """Return the sum of all waves, periodic, and its values at the cells."""
    n = N_FINE * N_WAVES
    at = (np.arange(n) + 0.5) / n
    picture = np.full((n, n), 1.0)
    for along_x, along_y in PERIODS:
        wave = np.exp(2j * np.pi * along_x * at) * np.exp(2j * np.pi * along_y * at)[:, np.newaxis]
        picture += wave.real / (2.0 * len(PERIODS))
    return picture


def modulations(image: np.ndarray) -> np.ndarray:
    """Return the amplitude of each wave over that in the picture, by least squares over the middle of the photosites."""
    start = (N_WAVES - image.shape[0]) // 2
    at = (np.arange(image.shape[0]) + start + 0.5) / N_WAVES
    x, y = (each.ravel() for each in np.meshgrid(at, at))
    phases = [2.0 * np.pi * (along_x * x + along_y * y) for along_x, along_y in PERIODS]
    columns = np.stack([np.ones_like(x), *map(np.cos, phases), *map(np.sin, phases)], axis=1)
    found = np.linalg.lstsq(columns, image.ravel(), rcond=None)[0]
    amplitude = np.hypot(found[1 : len(PERIODS) + 1], found[len(PERIODS) + 1 :])
    return 2.0 * len(PERIODS) * amplitude / found[0]


def compare_waves(section: Section, directory: Path) -> None:
    """Compare the modulation of waves."""
    picture = waves_picture()
    cell_um = PITCH_UM / N_FINE
    inner = slice(MARGIN, -MARGIN)
    scene = scene_of(picture, cell_um)
    layout = fs.layout.grid(n_x=N_WAVES, n_y=N_WAVES, pitch_um=PITCH_UM)
    own = camera_of(layout, padding="periodic", oversample=1, precision="double")
    kernel = kernel_of(WAVE_KERNEL, cell_um)
    around = np.pad(picture, GALSIM_CELLS, mode="wrap")

    def sites(fine: np.ndarray) -> np.ndarray:
        return fine.reshape(N_WAVES, N_FINE, N_WAVES, N_FINE).mean(axis=(1, 3))

    def by_scipy() -> np.ndarray:
        padded = np.pad(picture, WAVE_KERNEL // 2, mode="wrap")
        return sites(scipy.signal.fftconvolve(padded, kernel, mode="valid"))

    def by_opencv() -> np.ndarray:
        padded = np.pad(picture, WAVE_KERNEL // 2, mode="wrap")
        cut = slice(WAVE_KERNEL // 2, -(WAVE_KERNEL // 2))
        return sites(cv2.filter2D(padded, cv2.CV_64F, kernel)[cut, cut])

    per_um = np.array(PERIODS) / (N_WAVES * PITCH_UM)
    ratio = np.hypot(*per_um.T) * LAMBDA_N_UM
    truth = disc_overlap(ratio) * np.prod(np.sinc(per_um * PITCH_UM), axis=1)
    galsim_name, scipy_name, opencv_name = names()
    found = section.compare(
        f"modulation of {len(PERIODS)} waves on square photosites, up to {ratio.max():.2f} of the cut-off",
        {
            OWN: lambda: modulations(own(scene)[inner, inner]),
            galsim_name: lambda: modulations(galsim_image(around, cell_um, N_WAVES - 2 * MARGIN, folding=1e-4)),
            scipy_name: lambda: modulations(by_scipy()[inner, inner]),
            opencv_name: lambda: modulations(by_opencv()[inner, inner]),
        },
        np.abs(truth),
        by="MTF of the lens times sinc(f_x p) sinc(f_y p) of the photosite",
        source=f"{GOODMAN}, section 7.3.2; Boreman, Modulation Transfer Function (2001)",
        tolerance=1e-4,
        deviation=largest_absolute,
        of="of modulation",
        cannot={scipy_name: "no optics: PSF of 385 cells", opencv_name: "no optics: PSF of 385 cells"},
        explanation=(
            "A truncated PSF lacks its wings, which changes the modulation at low frequencies. GalSim takes the picture for 0 "
            "outside, and folds 1e-4 of the light back (folding_threshold; with 1e-3 it is 1.5 to 2.5e-3 off, twice as fast)."
        ),
        repeats=1,
    )
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    values, error = figure.subplots(1, 2)
    values.plot(ratio, np.abs(truth), "o", color="black", ms=9.0, alpha=0.25, label="truth")
    for (program, each), marker in zip(found.items(), "o^sx", strict=False):
        values.plot(ratio, each, marker, ms=4.0, label=program)
        error.semilogy(ratio, np.abs(each - np.abs(truth)) + 1e-17, marker, ms=4.0, label=program)
    values.set(xlabel="frequency / cut-off", ylabel="modulation")
    error.set(xlabel="frequency / cut-off", ylabel="deviation")
    error.legend(fontsize="small")
    section.draw("waves", figure, "Modulation of waves on square photosites, and deviations.", directory)


def names() -> tuple[str, str, str]:
    """Return the names of the other programs."""
    opencv = f"OpenCV {cv2.__version__} filter2D"
    return f"GalSim {galsim.__version__}", f"SciPy {version_of('scipy')} fftconvolve", opencv


# -- picture ----------------------------------------------------------------------------------------------------------


def random_picture() -> np.ndarray:
    """Return a periodic picture of blurred noise, from 0 to 1."""
    noise = np.random.default_rng(0).random((N_PICTURE, N_PICTURE))
    picture = scipy.ndimage.gaussian_filter(noise, 1.5, mode="wrap")
    return (picture - picture.min()) / np.ptp(picture)


def periodic_image(picture: np.ndarray) -> np.ndarray:
    """
    Return the light of photosites, one for each point of a periodic picture.

    The spectrum of the lattice of points is periodic: each frequency f of the samples has the sum over its replicas
    ``OTF(f + k/p) sinc(f_x p + k_x) sinc(f_y p + k_y)``, of which those below the cut-off are not 0.
    """
    f_x, f_y = np.fft.fftfreq(N_PICTURE), np.fft.fftfreq(N_PICTURE)[:, np.newaxis]
    n = int(PITCH_UM / LAMBDA_N_UM + 0.5) + 1
    transfer = np.zeros((N_PICTURE, N_PICTURE))
    for k_x in range(-n, n + 1):
        for k_y in range(-n, n + 1):
            ratio = np.minimum(np.hypot(f_x + k_x, f_y + k_y) * LAMBDA_N_UM / PITCH_UM, 1.0)
            transfer += disc_overlap(ratio) * np.sinc(f_x + k_x) * np.sinc(f_y + k_y)
    return np.fft.ifft2(np.fft.fft2(picture) * transfer).real


def compare_picture(section: Section) -> None:
    """Compare images of a picture with one pixel for each photosite."""
    picture = random_picture()
    inner = slice(MARGIN, -MARGIN)
    scene = scene_of(picture, PITCH_UM)
    layout = fs.layout.grid(n_x=N_PICTURE, n_y=N_PICTURE, pitch_um=PITCH_UM)
    own, single = (camera_of(layout, padding="periodic", precision=each) for each in ("double", "single"))
    kernel = kernel_of(PICTURE_KERNEL, PITCH_UM)
    half = PICTURE_KERNEL // 2
    padded = np.pad(picture, half, mode="wrap")
    around = np.pad(picture, GALSIM_CELLS, mode="wrap")
    galsim_name, scipy_name, opencv_name = names()
    single_name = f"{OWN} in single precision"
    section.compare(
        f"picture of {N_PICTURE} x {N_PICTURE} points on as many photosites",
        {
            OWN: lambda: own(scene)[inner, inner],
            single_name: lambda: single(scene)[inner, inner],
            galsim_name: lambda: galsim_image(around, PITCH_UM, N_PICTURE - 2 * MARGIN),
            scipy_name: lambda: scipy.signal.fftconvolve(padded, kernel, mode="valid")[inner, inner],
            opencv_name: lambda: cv2.filter2D(padded, cv2.CV_64F, kernel)[half:-half, half:-half][inner, inner],
        },
        periodic_image(picture)[inner, inner],
        by="sum of OTF times sinc over the replicas of each frequency",
        source=f"{GOODMAN}, sections 2.4 and 7.3.2",
        tolerance=1e-4,
        cannot={
            galsim_name: "takes the picture for 0 outside",
            scipy_name: f"no optics: PSF of {PICTURE_KERNEL} cells",
            opencv_name: f"no optics: PSF of {PICTURE_KERNEL} cells",
        },
        explanation=(
            "The PSF beyond 97 cells has 0.3 % of its light. GalSim assumes that its picture is band-limited unless it has the "
            "cut-off of the lens as largest frequency: without the replicas of the lattice it is 1.2 % off."
        ),
    )


# -- point ------------------------------------------------------------------------------------------------------------


def point_image() -> np.ndarray:
    """Return the share of the light of a point in each photosite, by 24 x 24 Gauss nodes each."""
    node, weight = leggauss(24)
    edge = POINT_PITCH_UM * (np.arange(N_POINT) - N_POINT // 2)[:, np.newaxis] + 0.5 * POINT_PITCH_UM * node
    x, y = (edge - each for each in POINT_UM)
    radius = np.hypot(x[np.newaxis, np.newaxis], y[:, :, np.newaxis, np.newaxis])
    share = np.einsum("iajb,a,b->ij", airy_at(radius, LAMBDA_N_UM), weight, weight)
    return share * (0.5 * POINT_PITCH_UM) ** 2 * np.pi / (4.0 * LAMBDA_N_UM**2)


def compare_point(section: Section) -> None:
    """Compare images of a point between the centres of photosites."""
    n_cells, per_site = 363, 10
    points = np.zeros((n_cells, n_cells))
    points[n_cells // 2, n_cells // 2] = 1.0
    cell_um = POINT_PITCH_UM / per_site
    scene = scene_of(points, cell_um)
    layout = fs.layout.grid(n_x=N_POINT, n_y=N_POINT, pitch_um=POINT_PITCH_UM)
    moved = fs.Layout.from_polygons([each - np.array(POINT_UM) for each in vertices_of(layout)])
    own = camera_of(moved, padding="zero", padding_cells=1000, oversample=1, precision="double")
    galsim_name, _, _ = names()

    def by_galsim(method: str) -> np.ndarray:
        airy = galsim.Airy(lam_over_diam=LAMBDA_N_UM)
        offset = tuple(each / POINT_PITCH_UM for each in POINT_UM)
        image = airy.drawImage(nx=N_POINT, ny=N_POINT, scale=POINT_PITCH_UM, offset=offset, method=method, dtype=float)
        return image.array

    def by_astropy() -> np.ndarray:
        from astropy.convolution import discretize_model
        from astropy.modeling.models import AiryDisk2D

        zero = 1.2196698912665045 * LAMBDA_N_UM / POINT_PITCH_UM
        x, y = (each / POINT_PITCH_UM for each in POINT_UM)
        model = AiryDisk2D(amplitude=1.0, x_0=x, y_0=y, radius=zero)
        half = N_POINT // 2
        bounds = (-half, half + 1)
        values = discretize_model(model, bounds, bounds, mode="oversample", factor=10)
        return values * np.pi * POINT_PITCH_UM**2 / (4.0 * LAMBDA_N_UM**2)

    astropy = f"astropy {version_of('astropy')}"
    section.compare(
        "point between photosites of λN/2",
        {
            OWN: lambda: own(scene) * (POINT_PITCH_UM / cell_um) ** 2,
            galsim_name: lambda: by_galsim("auto"),
            f"{galsim_name}, real space": lambda: by_galsim("real_space"),
            astropy: by_astropy,
        },
        point_image(),
        by="integral of the Airy pattern over each photosite, 24 x 24 Gauss nodes",
        source=f"{GOODMAN}, section 4.4.2",
        tolerance=1e-4,
        deviation=largest,
        cannot={astropy: "means of 10 x 10 samples in each pixel"},
        explanation=(
            "GalSim integrates the Airy profile itself. foveasim has cells of λN/20, within which it takes the irradiance for "
            "linear. A point on a pixel is the task of GalSim, not of a map of a scene."
        ),
    )


def vertices_of(layout: fs.Layout) -> list[np.ndarray]:
    """Return the vertices of the sites of a layout without holes."""
    return [layout.xy_um[a:b] for a, b in zip(layout.ring_offsets[:-1], layout.ring_offsets[1:], strict=True)]
