"""
MTF of photosite apertures, MTF of slanted edges, sampling limits and picture quality.

foveasim sums the Fourier transforms of the edges of any polygon. prysm and GalSim have closed forms for rectangles, GalSim also
for discs; prysm samples other shapes (512 samples across the shape here). The slanted-edge method after ISO 12233 is applied to
edges whose MTF is known, by foveasim for sites of any shape and position, and as the standard describes it for grids, with four
bins of constant width for each pixel. PSNR and SSIM are those of scikit-image, whose code foveasim calls for SSIM.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import shapely
import skimage
from matplotlib.figure import Figure
from numpy.polynomial.legendre import leggauss
from records import OWN, Section, largest_absolute, largest_relative, version_of
from scipy.special import j1, ndtr

import foveasim as fs

#: Line pairs per mm, up to four times the Nyquist frequency of 4 µm.
PER_MM = np.linspace(0.0, 500.0, 101)
ISO = "e-SFR of ISO 12233 on a grid"
N_SAMPLES = 512


# -- apertures --------------------------------------------------------------------------------------------------------


def sampled_mtf(kind: str, size_um: float, angle_deg: float) -> np.ndarray:
    """Return the MTF of samples of a shape of prysm: a sum over them."""
    from prysm.coordinates import cart_to_polar, make_xy_grid
    from prysm.geometry import circle, regular_polygon

    x, y = make_xy_grid(N_SAMPLES, diameter=1.01 * size_um)
    shapes = {
        "disc": lambda: circle(0.5 * size_um, cart_to_polar(x, y)[0]),
        "hexagon": lambda: regular_polygon(6, 0.5 * size_um, x, y),  # flats along x
    }
    mask = shapes[kind]()
    angle = math.radians(angle_deg)
    at_um = (x * math.cos(angle) + y * math.sin(angle))[mask]
    return np.abs(np.exp(-2e-3j * np.pi * np.outer(PER_MM, at_um)).mean(axis=1))


def galsim_mtf(profile: object, angle_deg: float) -> np.ndarray:
    """Return the MTF of a profile of GalSim."""
    wave = 2e-3 * np.pi * PER_MM
    angle = math.radians(angle_deg)
    return np.abs([profile.kValue(k * math.cos(angle), k * math.sin(angle)) for k in wave])  # type: ignore[attr-defined]


def compare_apertures(section: Section) -> None:
    """Compare MTFs of squares, hexagons and discs with closed forms."""
    import galsim
    from prysm.detector import pixel_ft

    prysm, other = f"prysm {version_of('prysm')}", f"GalSim {version_of('GalSim')}"
    f_um = 1e-3 * PER_MM
    square = fs.layout.grid(n_x=1, n_y=1, pitch_um=4.0)
    angle_deg = 20.0
    cos, sin = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    section.compare(
        "MTF of a square of 4 µm at 20°, up to 500 lp/mm",
        {
            OWN: lambda: fs.metrics.polygon_mtf(square, PER_MM, angle_deg=angle_deg)[0],
            prysm: lambda: np.abs(pixel_ft(f_um * cos, f_um * sin, 4.0, 4.0)),
            other: lambda: galsim_mtf(galsim.Box(4.0, 4.0), angle_deg),
        },
        np.abs(np.sinc(4.0 * f_um * cos) * np.sinc(4.0 * f_um * sin)),
        by="|sinc(w f cos φ) sinc(w f sin φ)|",
        source="Boreman, Modulation Transfer Function (2001)",
        tolerance=1e-12,
        deviation=largest_absolute,
        of="of 1",
    )
    for width_um in (4.0, 7.3):
        hexagon = fs.layout.hexagonal(n_columns=1, n_rows=1, pitch_um=width_um)
        side = width_um / math.sqrt(3.0)
        along = np.abs(2.0 / 3.0 * np.sinc(width_um * f_um) + np.sinc(0.5 * width_um * f_um) ** 2 / 3.0)
        across = np.abs(np.sinc(1.5 * side * f_um) * np.sinc(0.5 * side * f_um))
        section.compare(
            f"MTF of a hexagon of {width_um:g} µm between flats, along flats and vertices",
            {
                OWN: lambda hexagon=hexagon: np.array(
                    [fs.metrics.polygon_mtf(hexagon, PER_MM, angle_deg=each)[0] for each in (0.0, 90.0)]
                ),
                prysm: lambda side=side: np.array([sampled_mtf("hexagon", 2.0 * side, each) for each in (0.0, 90.0)]),
            },
            np.array([along, across]),
            by="2/3 sinc(w f) + 1/3 sinc²(w f/2), and sinc(3 s f/2) sinc(s f/2)",
            source="projections of the hexagon, a trapezium each",
            tolerance=1e-12,
            deviation=largest_absolute,
            of="of 1",
            repeats=1,
            cannot={prysm: "samples of the shape, no closed form", other: "no polygons"},
        )
    angle = 2.0 * np.pi * (np.arange(360) + 0.5) / 360
    radius_um = 2.0 * math.sqrt(np.pi / (180.0 * math.sin(np.pi / 180.0)))
    disc = fs.Layout.from_polygons([shapely.Polygon(radius_um * np.column_stack((np.cos(angle), np.sin(angle))))])
    v = 4.0 * np.pi * f_um[1:]
    section.compare(
        "MTF of a disc of 4 µm",
        {
            OWN: lambda: fs.metrics.polygon_mtf(disc, PER_MM)[0],
            prysm: lambda: sampled_mtf("disc", 4.0, 0.0),
            other: lambda: galsim_mtf(galsim.TopHat(2.0), 0.0),
        },
        np.concatenate(([1.0], np.abs(2.0 * j1(v) / v))),
        by="|2 J₁(π D f)/(π D f)|",
        source="Goodman, Introduction to Fourier Optics (2017)",
        tolerance=1e-8,
        deviation=largest_absolute,
        of="of 1",
        repeats=1,
        explanation="foveasim has a polygon of 360 sides with the area of the disc.",
    )


# -- slanted edges ----------------------------------------------------------------------------------------------------

EDGE_DEG, BLUR_UM, PITCH_UM = 5.0, 1.0, 3.0
EDGE_PER_MM = np.linspace(0.0, 500.0 / PITCH_UM, 51)


def across_edge(xy_um: np.ndarray) -> np.ndarray:
    """Return the distance from an edge through the origin."""
    return xy_um @ np.array([math.cos(math.radians(EDGE_DEG)), math.sin(math.radians(EDGE_DEG))])


def blurred_edge(layout: fs.Layout, n: int = 6) -> np.ndarray:
    """Return means over sites of an edge from 0 to 1 with Gaussian blur, by quadrature over triangles of each polygon."""
    node, weight = leggauss(n)
    u, v = 0.5 * (node[:, np.newaxis] + 1.0), 0.5 * (node + 1.0)
    # Triangle as an image of the unit square, with its Jacobian determinant 2 A u.
    first, second = (u * (1.0 - v)).ravel(), (u * v).ravel()
    part = (0.25 * weight[:, np.newaxis] * weight * 2.0 * u).ravel()
    found = []
    for polygon in layout.polygons():
        corners = np.array(polygon.exterior.coords)
        total = 0.0
        for k in range(1, len(corners) - 2):  # convex sites: a fan
            a, b, c = corners[0], corners[k], corners[k + 1]
            area = 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
            at_um = a + first[:, np.newaxis] * (b - a) + second[:, np.newaxis] * (c - a)
            total += area * float(part @ ndtr(across_edge(at_um) / BLUR_UM))
        found.append(total / polygon.area)
    return np.array(found)


def edge_on_grid(picture: np.ndarray, per_mm: np.ndarray) -> np.ndarray:
    """Return the MTF as the standard describes it: line fit to row centroids, four bins for each pixel, Hamming window."""
    n_y, n_x = picture.shape
    column, row = np.arange(n_x), np.arange(n_y)
    slope = np.diff(picture, axis=1)
    between = column[:-1] + 0.5
    middle = np.full(n_y, between.mean())
    for _ in range(3):
        hamming = 0.54 + 0.46 * np.cos(2.0 * np.pi * (between - middle[:, np.newaxis]) / n_x)
        middle = np.polyval(np.polyfit(row, (slope * hamming) @ between / (slope * hamming).sum(axis=1), 1), row)
    tilt = (middle[-1] - middle[0]) / (n_y - 1)
    distance = column - middle[:, np.newaxis]
    edges = np.arange(math.ceil(4.0 * distance.min()), math.floor(4.0 * distance.max()) + 1) / 4.0
    number, _ = np.histogram(distance, edges)
    esf = np.histogram(distance, edges, weights=picture)[0] / number
    lsf, at = np.diff(esf), edges[1:-1]
    lsf = lsf * (0.54 + 0.46 * np.cos(np.pi * at / np.abs(at).max()))
    per_pixel = 1e-3 * per_mm * PITCH_UM * math.cos(math.atan(tilt))  # distances are along rows
    spectrum = np.abs(np.exp(-2j * np.pi * np.outer(per_pixel, at)) @ lsf) / abs(lsf.sum())
    return spectrum / np.sinc(per_pixel / 4.0)


def gaussian(per_mm: np.ndarray) -> np.ndarray:
    """Return the MTF of the blur."""
    return np.exp(-2.0 * (1e-3 * np.pi * BLUR_UM * per_mm) ** 2)


def square_mtf(per_mm: np.ndarray) -> np.ndarray:
    """Return the MTF of blurred squares across the edge."""
    angle = math.radians(EDGE_DEG)
    return gaussian(per_mm) * np.abs(
        np.sinc(1e-3 * PITCH_UM * per_mm * math.cos(angle)) * np.sinc(1e-3 * PITCH_UM * per_mm * math.sin(angle))
    )


def compare_edges(section: Section, directory: Path) -> None:
    """Compare measured MTFs of edges with the MTF that they have."""
    squares = fs.layout.grid(n_x=100, n_y=100, pitch_um=PITCH_UM)
    squares = squares.translate(*-squares.centroid_um.mean(axis=0))
    values = blurred_edge(squares)

    def own(layout: fs.Layout, samples: np.ndarray) -> np.ndarray:
        return fs.metrics.slanted_edge_mtf(layout, samples, frequency_per_mm=EDGE_PER_MM).mtf

    truth = square_mtf(EDGE_PER_MM)
    found = section.compare(
        "slanted edge of 5° on 100 x 100 squares of 3 µm, blur of 1 µm",
        {OWN: lambda: own(squares, values), ISO: lambda: edge_on_grid(values.reshape(100, 100), EDGE_PER_MM)},
        truth,
        by="MTF of the Gaussian times that of the square",
        source="convolution theorem; the edge by quadrature over the sites",
        tolerance=2e-3,
        deviation=largest_absolute,
        of="of 1",
        explanation="The standard corrects the difference of bins, not the mean over each, a factor of sinc(f/4) for f cycles "
        "per pixel: 0.974 at the Nyquist frequency. Divided by it, its largest deviation is 6e-4. foveasim corrects both.",
    )
    rng = np.random.default_rng(4)
    noisy = [values + rng.normal(0.0, 0.02, values.size) for _ in range(12)]

    def rms(measured: np.ndarray, expected: np.ndarray) -> float:
        return float(np.sqrt(np.mean((measured - expected) ** 2)))

    section.compare(
        "the same with noise of 2 % of the step, rms of 12 edges",
        {
            OWN: lambda: np.array([own(squares, each) for each in noisy]),
            ISO: lambda: np.array([edge_on_grid(each.reshape(100, 100), EDGE_PER_MM) for each in noisy]),
        },
        truth,
        by="MTF of the Gaussian times that of the square",
        source="convolution theorem",
        tolerance=0.012,
        deviation=rms,
        of="of 1, rms",
        repeats=1,
        explanation="foveasim has wider bins far from the edge, which contain less noise.",
    )
    hexagons = fs.layout.hexagonal(n_columns=100, n_rows=115, pitch_um=PITCH_UM, orientation="pointy")
    hexagons = hexagons.translate(*-hexagons.centroid_um.mean(axis=0))
    site = hexagons.polygons()[0]
    transform = np.abs(polygon_transform(site, EDGE_PER_MM))
    samples = blurred_edge(hexagons)
    section.compare(
        "slanted edge of 5° on 11,500 hexagons of 3 µm, blur of 1 µm",
        {OWN: lambda: own(hexagons, samples)},
        gaussian(EDGE_PER_MM) * transform,
        by="MTF of the Gaussian times that of the hexagon",
        source="convolution theorem; the edge by quadrature over the sites",
        tolerance=2e-3,
        deviation=largest_absolute,
        of="of 1",
        repeats=1,
        cannot={ISO: "rows and columns of pixels only"},
    )
    compare_camera(section)
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    mtf, error = figure.subplots(1, 2)
    mtf.plot(EDGE_PER_MM, truth, "k-", lw=3, alpha=0.3, label="closed form")
    for program, measured in found.items():
        mtf.plot(EDGE_PER_MM, measured, "--" if program == OWN else ":", label=program)
        error.plot(EDGE_PER_MM, measured - truth, label=program)
    mtf.set(xlabel="frequency / (lp/mm)", ylabel="MTF")
    error.set(xlabel="frequency / (lp/mm)", ylabel="deviation")
    mtf.legend(fontsize="small")
    section.draw(
        "edge", figure, "MTF of a slanted edge on squares of 3 µm, and deviations from the closed form.", directory
    )


def polygon_transform(polygon: shapely.Polygon, per_mm: np.ndarray, n: int = 40) -> np.ndarray:
    """Return the transform across the edge over the area, by chords of the polygon along the edge."""
    # Width of the polygon along the edge at each distance: a piecewise linear function between its corners.
    corners = np.array(polygon.exterior.coords)[:-1] - np.array(polygon.centroid.coords[0])
    turned = shapely.affinity.rotate(shapely.Polygon(corners), -EDGE_DEG, origin=(0.0, 0.0))
    at = np.unique(np.array(turned.exterior.coords)[:, 0])
    node, weight = leggauss(n)
    total = np.zeros(per_mm.size, np.complex128)
    for low, high in pairwise(at):
        x = low + 0.5 * (high - low) * (node + 1.0)
        length = [turned.intersection(shapely.LineString([(each, -99.0), (each, 99.0)])).length for each in x]
        total += 0.5 * (high - low) * np.exp(-2e-3j * np.pi * np.outer(per_mm, x)) @ (weight * length)
    return total / polygon.area


def compare_camera(section: Section) -> None:
    """Compare the MTF that a complete camera shows with the product of its parts."""
    focal_mm, f_number, distance_m, cell_um = 10.0, 4.0, 0.5, 0.5
    image_mm = 1.0 / (1.0 / focal_mm - 1e-3 / distance_m)
    working = f_number * image_mm / focal_mm
    optics = fs.Optics(focal_length_mm=focal_mm, f_number=f_number)
    layout = fs.layout.grid(n_x=60, n_y=60, pitch_um=4.0)
    scene = fs.scene.charts.slanted_edge(
        angle_deg=EDGE_DEG,
        shape=(760, 760),
        pitch_um=cell_um * 1e3 * distance_m / image_mm,
        distance_m=distance_m,
        radiance_w_m2_sr_nm=0.1,
        wavelength_nm=[550.0],
        band_width_nm=10.0,
    )
    per_mm = np.linspace(0.0, 125.0, 26)
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout, capacitance_f=1e-13))

    def measured() -> np.ndarray:
        values = camera.capture(scene, exposure_s=0.1, seed=1).expected_e
        return fs.metrics.slanted_edge_mtf(layout, values, frequency_per_mm=per_mm).mtf

    s = per_mm * 0.55e-3 * working
    lens = 2.0 / np.pi * (np.arccos(s) - s * np.sqrt(1.0 - s**2))
    angle = math.radians(EDGE_DEG)
    waves = 1e-3 * np.outer([math.cos(angle), math.sin(angle)], per_mm)
    pixel = np.abs(np.sinc(4.0 * waves).prod(axis=0))
    # Pixels of the chart, and cells of the power map.
    cells = np.sinc(cell_um * waves).prod(axis=0) ** 2
    section.compare(
        "MTF of a camera up to its Nyquist frequency: f/4, 550 nm, squares of 4 µm, by a slanted edge",
        {OWN: measured},
        lens * pixel * cells,
        by="MTF of the lens times those of square and cells",
        source="Goodman, Introduction to Fourier Optics (2017), section 7.3.2",
        tolerance=8e-3,
        deviation=largest_absolute,
        of="of 1",
        repeats=1,
        explanation="Chart, lens, integration, sensor and measurement in one chain. The line spread function ends with the "
        "sensor, and lacks the tails of the PSF: the deviation is nearly equal at all frequencies.",
    )


# -- sampling and pictures --------------------------------------------------------------------------------------------


def windowed_ssim(one: np.ndarray, other: np.ndarray, data_range: float, size: int = 7) -> float:
    """Return the mean SSIM of uniform windows with sample covariances, by its definition."""
    a, b = (
        np.lib.stride_tricks.sliding_window_view(each, (size, size)).reshape(-1, size * size) for each in (one, other)
    )
    mean_a, mean_b = a.mean(axis=1), b.mean(axis=1)
    a, b = a - mean_a[:, np.newaxis], b - mean_b[:, np.newaxis]
    n = size * size - 1
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    similarity = (2.0 * mean_a * mean_b + c1) * (2.0 * (a * b).sum(axis=1) / n + c2)
    similarity /= (mean_a**2 + mean_b**2 + c1) * (((a**2).sum(axis=1) + (b**2).sum(axis=1)) / n + c2)
    return float(similarity.mean())


def compare_pictures(section: Section) -> None:
    """Compare Nyquist frequencies, PSNR and SSIM with their definitions."""
    layouts = (
        fs.layout.grid(n_x=20, n_y=20, pitch_um=2.5),
        fs.layout.hexagonal(n_columns=20, n_rows=20, pitch_um=2.0).rotate(11.0),
    )
    section.compare(
        "Nyquist frequencies of a square lattice of 2.5 µm and a hexagonal one of 2 µm",
        {OWN: lambda: np.array([float(np.median(fs.metrics.nyquist_per_mm(each))) for each in layouts])},
        np.array([200.0, 1e3 / (math.sqrt(3.0) * 2.0)]),
        by="1/(2 p), and 1/(√3 p)",
        source="Petersen and Middleton, Information and Control 5, 279 (1962)",
        tolerance=1e-9,
        deviation=largest_relative,
    )
    reference = skimage.data.camera()[::2, ::2].astype(np.float64)
    picture = np.clip(reference + np.random.default_rng(2).normal(0.0, 12.0, reference.shape), 0.0, 255.0)
    scikit, opencv = f"scikit-image {version_of('scikit-image')}", f"OpenCV {cv2.__version__}"
    error2 = math.fsum(((picture - reference) ** 2).ravel()) / reference.size
    section.compare(
        "PSNR of a noisy photograph",
        {
            OWN: lambda: fs.metrics.psnr_db(picture, reference, data_range=255.0),
            scikit: lambda: skimage.metrics.peak_signal_noise_ratio(reference, picture, data_range=255.0),
            opencv: lambda: cv2.PSNR(reference, picture, 255.0),
        },
        10.0 * math.log10(255.0**2 / error2),
        by="10 lg(range²/mean square of the difference)",
        source="definition",
        tolerance=1e-10,
        deviation=largest_absolute,
        of="dB",
    )
    section.compare(
        "SSIM of a noisy photograph",
        {
            OWN: lambda: fs.metrics.ssim(picture, reference, data_range=255.0),
            scikit: lambda: skimage.metrics.structural_similarity(reference, picture, data_range=255.0),
        },
        windowed_ssim(picture, reference, 255.0),
        by="its definition, window by window",
        source="Wang et al., IEEE Trans. Image Process. 13, 600 (2004); windows of 7 x 7 with equal weights",
        tolerance=1e-10,
        deviation=largest_absolute,
        of="of 1",
        explanation="foveasim calls scikit-image, and excludes windows with pixels that no site covers.",
    )


def validate(section: Section, directory: Path) -> None:
    """Compare MTFs and metrics of pictures with closed forms."""
    compare_apertures(section)
    compare_edges(section, directory)
    compare_pictures(section)
