"""
Points, directions and photosites of lens models, and light beyond 90°.

Lens models of foveasim and OpenCV have the same formulas. The way from the scene to the sensor is a formula, whose rounding
errors are compared with exact arithmetic. The way back has no closed form: foveasim uses Newton's method, and knows how far
the model can be inverted; OpenCV iterates a fixed point for Brown and Conrady's model, 5 times if no criterion is given, and
Newton's method for fisheye lenses. Beyond 90° there is no plane; foveasim has directions there, and integrates the image of a
panorama over the photosites. With OpenCV one resamples the panorama, and sums the cells of labels that scikit-image fills.
"""

from __future__ import annotations

from decimal import Decimal, localcontext
from pathlib import Path

import cv2
import numpy as np
import skimage.draw
from matplotlib.figure import Figure
from numpy.polynomial.legendre import leggauss
from records import OWN, Section, largest_absolute, largest_relative

import foveasim as fs

N_POINTS = 20_000
#: Calibration in pixels: size of the image, focal lengths and principal point, of OpenCV, whose y points down.
SIZE, PIXEL_UM = (1280, 960), 3.0
MATRIX = np.array([[620.0, 0.0, 651.3], [0.0, 618.0, 471.8], [0.0, 0.0, 1.0]])
#: k1, k2, p1, p2, k3: barrel distortion of a wide lens; the four of a fisheye lens.
BROWN = (-0.28, 0.09, 8e-4, -5e-4, -0.012)
FISHEYE = (-0.02, 0.003, -0.0007, 0.00004)
#: Largest radius of ideal points, in focal lengths, and largest angle of the fisheye lens in front of the camera.
MAX_RADIUS, MAX_FISHEYE_DEG = 1.25, 85.0
#: Scaramuzza's model of a lens of 210°: a0, a2, a3, a4 in pixels.
SCARAMUZZA = (330.0, -7.5e-4, -3e-7, -6e-10)
MAX_WIDE_DEG = 105.0
#: Lens of the light beyond 90°: f/1.4, so large that the PSF has no effect.
FOCAL_UM, F_NUMBER, N_PANORAMA = 20_000.0, 1.4, 2048
OPENCV_MANUAL = "OpenCV, Camera Calibration and 3D Reconstruction"


def directions_up_to(angle_deg: float) -> np.ndarray:
    """Return unit vectors (n, 3) of all azimuths, x right, y up, z along the axis."""
    random = np.random.default_rng(0)
    theta = np.radians(angle_deg) * np.sqrt(random.random(N_POINTS))
    azimuth = 2.0 * np.pi * random.random(N_POINTS)
    return np.stack((np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)), axis=1)


def plane_points() -> np.ndarray:
    """Return ideal points (n, 2) in focal lengths, y down."""
    random = np.random.default_rng(0)
    radius, azimuth = MAX_RADIUS * np.sqrt(random.random(N_POINTS)), 2.0 * np.pi * random.random(N_POINTS)
    return np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth)), axis=1)


def pixels_of(points: np.ndarray) -> np.ndarray:
    """Return pixels of normalised points, y down."""
    return points * np.diag(MATRIX)[:2] + MATRIX[:2, 2]


def um_of(pixels: np.ndarray) -> np.ndarray:
    """Return positions from the centre of the image in µm, y up."""
    return (pixels - 0.5 * (np.array(SIZE) - 1.0)) * (PIXEL_UM, -PIXEL_UM)


def pixels_of_um(xy_um: np.ndarray) -> np.ndarray:
    """Return pixels, y down, the inverse of :func:`um_of`."""
    return xy_um / (PIXEL_UM, -PIXEL_UM) + 0.5 * (np.array(SIZE) - 1.0)


def exact_brown_conrady(points: np.ndarray) -> np.ndarray:
    """Return distorted points (n, 2) of normalised ones, in decimal arithmetic of 40 digits."""
    k1, k2, p1, p2, k3 = map(Decimal, BROWN)
    found = []
    with localcontext() as context:
        context.prec = 40
        for x, y in points.tolist():
            a, b = Decimal(x), Decimal(y)
            r2 = a * a + b * b
            factor = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            real = (
                a * factor + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
                b * factor + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
            )
            found.append([float(each) for each in real])
    return np.array(found)


def fisheye_height(theta: np.ndarray) -> np.ndarray:
    """Return the image height in focal lengths."""
    square = theta * theta
    return theta * (1.0 + square * np.polynomial.polynomial.polyval(square, FISHEYE))


def scaramuzza_pixels(directions: np.ndarray) -> np.ndarray:
    """
    Return pixels (n, 2) from the centre of directions, y up, by bisection.

    The ray (x, y, f(r)) at the distance r has the angle acot(f(r)/r), which increases with r.
    """
    across = np.hypot(directions[:, 0], directions[:, 1])
    low, high = np.zeros(across.size), np.full(across.size, 700.0)
    a0, a2, a3, a4 = SCARAMUZZA
    for _ in range(60):
        r = 0.5 * (low + high)
        is_below = (a0 + r**2 * (a2 + r * (a3 + r * a4))) * across > r * directions[:, 2]
        low, high = np.where(is_below, r, low), np.where(is_below, high, r)
    return directions[:, :2] * (r / across)[:, np.newaxis]


def ocam_directions(pixels: np.ndarray) -> np.ndarray:
    """Return unit vectors (n, 3) of pixels from the centre, y up, by the formula of OCamCalib."""
    a0, a2, a3, a4 = SCARAMUZZA
    r = np.hypot(pixels[:, 0], pixels[:, 1])
    rays = np.column_stack((pixels, a0 + r**2 * (a2 + r * (a3 + r * a4))))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def validate(section: Section, directory: Path) -> None:
    """Compare Brown and Conrady's model, fisheye lenses, Scaramuzza's model, and light beyond 90°."""
    compare_brown_conrady(section, directory)
    compare_fisheye(section)
    compare_wide(section)
    compare_light(section)


def compare_brown_conrady(section: Section, directory: Path) -> None:
    """Compare points with OpenCV."""
    opencv = f"OpenCV {cv2.__version__}"
    k, still = np.array(BROWN), np.zeros(3)
    lens = fs.distortion.from_opencv(MATRIX, k, image_size=SIZE, pixel_um=PIXEL_UM)
    ideal = plane_points()
    ideal_px, ideal_um = pixels_of(ideal), um_of(pixels_of(ideal))
    real_px = pixels_of(exact_brown_conrady(ideal))
    real_um = um_of(real_px)
    space = np.pad(ideal, ((0, 0), (0, 1)), constant_values=1.0)
    section.compare(
        f"distorted points of Brown and Conrady's model, to {np.degrees(np.arctan(MAX_RADIUS)):.0f}°",
        {
            OWN: lambda: pixels_of_um(lens.distort(ideal_um)),
            f"{opencv} projectPoints": lambda: cv2.projectPoints(space, still, still, MATRIX, k)[0][:, 0],
        },
        real_px,
        by="the formula, in decimal arithmetic of 40 digits",
        source=f"{OPENCV_MANUAL}; Brown (1966)",
        tolerance=1e-10,
        deviation=largest_absolute,
        of="pixels",
    )
    many = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
    found = section.compare(
        "ideal points of distorted ones",
        {
            OWN: lambda: pixels_of_um(lens.undistort(real_um)),
            f"{opencv} undistortPoints": lambda: cv2.undistortPoints(real_px, MATRIX, k, P=MATRIX)[:, 0],
            f"{opencv} undistortPoints, 1000 iterations": lambda: cv2.undistortPoints(
                real_px, MATRIX, k, P=MATRIX, criteria=many
            )[:, 0],
        },
        ideal_px,
        by="the points from which the distorted ones were computed",
        source="inverse of the exact formula",
        tolerance=1e-9,
        deviation=largest_absolute,
        of="pixels",
        cannot={
            f"{opencv} undistortPoints": "stops after 5 iterations by default",
            f"{opencv} undistortPoints, 1000 iterations": "does not tell where the model has no inverse",
        },
        explanation="The fixed point of OpenCV converges slowly towards the fold of the model.",
    )
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    axes = figure.subplots()
    ring = np.degrees(np.arctan(np.hypot(*ideal.T))).astype(int)
    for (program, each), style in zip(found.items(), ("-", "-", "--"), strict=True):
        largest = np.zeros(ring.max() + 1)
        np.maximum.at(largest, ring, np.hypot(*(each - ideal_px).T))
        axes.semilogy(np.arange(largest.size) + 0.5, largest + 1e-16, style, label=program)
    axes.set(xlabel="field angle / °", ylabel="largest deviation / pixels")
    axes.legend(fontsize="small")
    section.draw("inverse", figure, "Largest deviations of ideal points in rings of 1° of the field.", directory)


def compare_fisheye(section: Section) -> None:
    """Compare points and directions of Kannala and Brandt's model with OpenCV, in front of the camera."""
    opencv = f"OpenCV {cv2.__version__} fisheye"
    k, still = np.array(FISHEYE), np.zeros((1, 1, 3))
    lens = fs.distortion.from_opencv(MATRIX, k, image_size=SIZE, pixel_um=PIXEL_UM, fisheye=True)
    directions = directions_up_to(MAX_FISHEYE_DEG)
    theta = np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2])
    unit = directions[:, :2] / np.hypot(directions[:, 0], directions[:, 1])[:, np.newaxis]
    real_px = pixels_of(unit * fisheye_height(theta)[:, np.newaxis] * (1.0, -1.0))
    real_um = um_of(real_px)
    space = directions * (1.0, -1.0, 1.0)

    def projected() -> np.ndarray:
        return cv2.fisheye.projectPoints(space[:, np.newaxis], still, still, MATRIX, k)[0][:, 0]

    def undistorted(**options: object) -> np.ndarray:
        points = cv2.fisheye.undistortPoints(real_px[:, np.newaxis], MATRIX, k, **options)[:, 0]
        rays = np.column_stack((points * (1.0, -1.0), np.ones(N_POINTS)))
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    section.compare(
        f"points of a fisheye lens, to {MAX_FISHEYE_DEG:.0f}°",
        {OWN: lambda: pixels_of_um(lens.project(directions)), opencv: projected},
        real_px,
        by="f (θ + k₁ θ³ + k₂ θ⁵ + k₃ θ⁷ + k₄ θ⁹)",
        source=f"Kannala and Brandt (2006); {OPENCV_MANUAL}",
        tolerance=1e-10,
        deviation=largest_absolute,
        of="pixels",
    )
    section.compare(
        f"directions of points of a fisheye lens, to {MAX_FISHEYE_DEG:.0f}°",
        {OWN: lambda: lens.direction(real_um), opencv: undistorted},
        directions,
        by="the directions from which the points were computed",
        source="inverse of the formula",
        tolerance=1e-12,
        deviation=largest_angle,
        of="rad",
        cannot={opencv: "points of a plane, thus no directions beyond 90°"},
    )


def largest_angle(found: np.ndarray, truth: np.ndarray) -> float:
    """Return the largest angle between unit vectors, rad."""
    return float(2.0 * np.arcsin(0.5 * np.linalg.norm(found - truth, axis=1).max()))


def compare_wide(section: Section) -> None:
    """Compare directions and points beyond 90°, and the way there and back for every model."""
    lens = fs.distortion.Scaramuzza(a=SCARAMUZZA, pixel_um=PIXEL_UM, focal_um=SCARAMUZZA[0] * PIXEL_UM)
    directions = directions_up_to(MAX_WIDE_DEG)
    pixels = scaramuzza_pixels(directions)
    section.compare(
        f"directions of pixels of Scaramuzza's model, to {MAX_WIDE_DEG:.0f}°",
        {OWN: lambda: lens.direction(PIXEL_UM * pixels)},
        ocam_directions(pixels),
        by="(x, y, a₀ + a₂ r² + a₃ r³ + a₄ r⁴)",
        source="Scaramuzza, Martinelli and Siegwart (2006), OCamCalib",
        tolerance=1e-14,
        deviation=largest_angle,
        of="rad",
    )
    section.compare(
        f"pixels of directions of Scaramuzza's model, to {MAX_WIDE_DEG:.0f}°",
        {OWN: lambda: lens.project(directions) / PIXEL_UM},
        pixels,
        by="bisection of the angle of the ray",
        source="Scaramuzza, Martinelli and Siegwart (2006)",
        tolerance=1e-10,
        deviation=largest_absolute,
        of="pixels",
        explanation="OCamCalib itself fits a polynomial of the angle to this inverse.",
    )
    focal = {"focal_um": MATRIX[0, 0] * PIXEL_UM, "centre_um": (35.0, -12.0)}
    models = {
        "Fisheye": fs.distortion.Fisheye(projection="equisolid", **focal),
        "PolynomialFisheye": fs.distortion.PolynomialFisheye(k=FISHEYE, **focal),
        "Omnidirectional": fs.distortion.Omnidirectional(xi=1.1, k1=-0.05, k2=0.004, p1=-0.001, p2=0.002, **focal),
        "ExtendedUnified": fs.distortion.ExtendedUnified(alpha=0.6, beta=1.1, **focal),
        "DoubleSphere": fs.distortion.DoubleSphere(xi=-0.2, alpha=0.6, **focal),
        "FieldOfView": fs.distortion.FieldOfView(w_rad=0.9, **focal),
        "Scaramuzza": lens,
    }
    section.compare(
        f"there and back, {len(models)} models, to {MAX_WIDE_DEG:.0f}°",
        {OWN: lambda: np.concatenate([each.direction(each.project(directions)) for each in models.values()])},
        np.concatenate([directions] * len(models)),
        by="the directions themselves",
        source="identity",
        tolerance=1e-11,
        deviation=largest_angle,
        of="rad",
    )


# -- light beyond 90° -------------------------------------------------------------------------------------------------


def radiance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return a smooth radiance over directions."""
    return 1.0 + 0.3 * x + 0.25 * y * z + 0.2 * x * x - 0.15 * y


def light_by_quadrature(layout: fs.Layout, n: int = 12) -> np.ndarray:
    """
    Return the integral of radiance over the solid angle of each site of one ring, behind an ideal equidistant lens, sr.

    Gauss nodes on triangles from the centre of a site to its edges. With the image height θ in focal lengths, an area dA has
    the solid angle sin θ / θ dA.
    """
    node, weight = leggauss(n)
    u, w = 0.5 + 0.5 * node, 0.5 * weight
    found = np.zeros(layout.n_sites)
    for site in range(layout.n_sites):
        ring = layout.site_offsets[site]
        a = layout.xy_um[layout.ring_offsets[ring] : layout.ring_offsets[ring + 1]] / FOCAL_UM
        b, c = np.roll(a, -1, axis=0), a.mean(axis=0)
        at = c + u[:, np.newaxis, np.newaxis, np.newaxis] * ((a - c) + u[:, np.newaxis, np.newaxis] * (b - a))
        cross = (a - c)[:, 0] * (b - a)[:, 1] - (a - c)[:, 1] * (b - a)[:, 0]
        area = ((w * u)[:, np.newaxis] * w)[..., np.newaxis] * cross
        theta = np.hypot(at[..., 0], at[..., 1])
        sine = np.sin(theta)
        x, y = at[..., 0] / theta * sine, at[..., 1] / theta * sine
        found[site] = (radiance(x, y, np.cos(theta)) * sine / theta * area).sum()
    return found


def compare_light(section: Section) -> None:
    """Compare the light of photosites beyond 90° with quadrature, and with a resampled picture."""
    radius_um = FOCAL_UM * np.radians(MAX_WIDE_DEG)
    layout = fs.layout.log_polar(n_sectors=48, r_min_um=0.15 * radius_um, r_max_um=radius_um)
    n_y = N_PANORAMA // 2
    elevation = (0.5 - (np.arange(n_y) + 0.5) / n_y) * np.pi
    azimuth = ((np.arange(N_PANORAMA) + 0.5) / n_y - 1.0) * np.pi
    cosine = np.cos(elevation)[:, np.newaxis]
    picture = radiance(
        cosine * np.sin(azimuth), np.sin(elevation)[:, np.newaxis] + 0.0 * azimuth, cosine * np.cos(azimuth)
    )
    scene = fs.Scene.from_panorama(
        picture,
        peak_radiance_w_m2_sr_nm=1.0,
        wavelength_nm=[550.0],
        band_width_nm=1.0,
        encoding="linear",
        cells=1024,
    )
    optics = fs.Optics(focal_length_mm=1e-3 * FOCAL_UM, f_number=F_NUMBER, lens="aplanatic", precision="double")
    lens = fs.distortion.Fisheye(projection="equidistant", focal_um=FOCAL_UM)
    sensor = fs.Sensor(layout, qe=1.0)
    camera = fs.Camera(optics=optics, sensor=sensor, distortion=lens, order=2)
    per_sr = np.pi * (0.5e-6 * FOCAL_UM / F_NUMBER) ** 2 / fs.units.photon_energy_j(550.0)

    def resampled(n_side: int) -> np.ndarray:
        step = 2.0 * np.radians(MAX_WIDE_DEG) / n_side
        labels = np.zeros((n_side, n_side), np.int32)
        for site, vertices in enumerate(np.split(layout.xy_um, layout.ring_offsets[1:-1]), 1):
            column, row = (vertices / FOCAL_UM / step + 0.5 * n_side - 0.5).T
            labels[skimage.draw.polygon(row, column, labels.shape)] = site
        at = step * (np.arange(n_side) - 0.5 * n_side + 0.5)
        x, y = np.meshgrid(at, at)
        theta = np.hypot(x, y)
        over = np.sinc(theta / np.pi)
        column = (np.arctan2(over * x, np.cos(theta)) / np.pi + 1.0) * n_y - 0.5
        row = (0.5 - np.arcsin(np.clip(over * y, -1.0, 1.0)) / np.pi) * n_y - 0.5
        image = cv2.remap(
            np.float32(picture),
            np.float32(column),
            np.float32(row),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        sums = np.bincount(labels.ravel(), (image * over).ravel(), minlength=layout.n_sites + 1)
        return sums[1:] * step**2

    opencv = f"OpenCV {cv2.__version__} remap, scikit-image {skimage.__version__} polygon"
    finer = f"{opencv}, 2048 x 2048 cells"
    section.compare(
        f"light of {layout.n_sites} photosites behind an equidistant lens, to {MAX_WIDE_DEG:.0f}°",
        {
            OWN: lambda: camera.photoelectrons_per_s(scene) / per_sr,
            opencv: lambda: resampled(1024),
            finer: lambda: resampled(2048),
        },
        light_by_quadrature(layout),
        by="∫ L sin θ/θ dA over the outline, Gauss nodes on its triangles",
        source="solid angle of an equidistant image, dΩ = sin θ dθ dφ",
        tolerance=1e-4,
        deviation=largest_relative,
        cannot={opencv: "each cell belongs to one site completely; the solid angles of cells are ours"},
        explanation="foveasim has an image of 1024 x 1024 cells, and cuts cells at the outlines; labels do not.",
        repeats=1,
    )
