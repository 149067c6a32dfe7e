"""
Scenes with depth: edges of near objects, circles of confusion, and the light that defocus conserves.

The lens of f/1.4 is in focus at 1 m; blurs are large compared with its PSF in focus, so that geometric optics are the truth. A
point out of focus becomes a disc. An object in front of a uniform background covers the part of the pupil that the disc has
on its side. foveasim divides the scene in layers of defocus, whose OTFs include diffraction; as a reference, it also traces
rays through 288 points of the pupil. OpenCV has no lens: it convolves two layers with discs, whose radii are ours, and covers
one with the other.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import scipy.optimize
from matplotlib.figure import Figure
from numpy.polynomial.legendre import leggauss
from records import OWN, Section, largest, largest_absolute, largest_relative
from scipy.ndimage import gaussian_filter
from scipy.special import j1

import foveasim as fs

FOCAL_MM, F_NUMBER, FOCUS_M, WAVELENGTH_NM = 10.0, 1.4, 1.0, 400.0
#: Cells of the image, and the geometric radius of the blur of edges and objects: 800 λN, so that diffraction is negligible.
RADIUS_UM = 480.0
#: Radii of blurs of edges, in cells, and cells along a row.
EDGE_RADII, N_EDGE = (1.3, 4.0, 8.0), 96
#: Pixels of objects, and the radius of their blur.
N_OBJECT, OBJECT_RADIUS = 128, 7.0
#: Distances of points and edges that are out of focus.
DISTANCES_M = (0.5, 1.5, 1e4)
EVEN = fs.optics.IlluminationTable(image_height_um=[0.0, 1e6], fraction=[1.0, 1.0])
POTMESIL = "Potmesil and Chakravarty, ACM Trans. Graphics 1, 85 (1982)"


@cache
def lens(**options: object) -> fs.Optics:
    """Return the lens, without the falloff towards the corners."""
    settings = {"precision": "double", "oversample": 1, "padding": "edge", "source_pixel": "square", **options}
    return fs.Optics(focal_length_mm=FOCAL_MM, f_number=F_NUMBER, relative_illumination=EVEN, **settings)


def image_m() -> float:
    """Return the image distance of the plane in focus."""
    return 1.0 / (1e3 / FOCAL_MM - 1.0 / FOCUS_M)


def blur_radius_um(distance_m: float) -> float:
    """Return the radius of the circle of confusion, a D (1/H - 1/H_focus)."""
    return 1e6 * 0.5e-3 * FOCAL_MM / F_NUMBER * image_m() * (1.0 / distance_m - 1.0 / FOCUS_M)


def distance_of_m(radius_um: float) -> float:
    """Return the distance in front of the focus with a circle of confusion, the inverse of :func:`blur_radius_um`."""
    return 1.0 / (1.0 / FOCUS_M + 1e-6 * radius_um / (0.5e-3 * FOCAL_MM / F_NUMBER * image_m()))


def scene_of(picture: np.ndarray, depth_m: np.ndarray, cell_um: float) -> fs.Scene:
    """Return the scene whose pixels have an image of ``cell_um``."""
    return fs.Scene.from_rgbd(
        picture,
        depth_m,
        distance_m=FOCUS_M,
        pitch_um=cell_um * FOCUS_M / image_m(),
        wavelength_nm=[WAVELENGTH_NM],
        band_width_nm=1.0,
        encoding="linear",
        peak_radiance_w_m2_sr_nm=1.0,
    )


def on_axis() -> float:
    """Return the irradiance of radiance 1, π/(1 + 4 N²) of the image-side f-number."""
    return np.pi / (1.0 + (2.0 * F_NUMBER * image_m() / (1e-3 * FOCAL_MM)) ** 2)


def disc_kernel(radius: float, n_samples: int = 64) -> np.ndarray:
    """Return a disc of a radius in cells, by the share of each cell that it covers."""
    half = int(np.ceil(radius + 0.5))
    n = 2 * half + 1
    at = (np.arange(n * n_samples) + 0.5) / n_samples - 0.5 * n
    inside = np.hypot(at, at[:, np.newaxis]) <= radius
    kernel = inside.reshape(n, n_samples, n, n_samples).mean(axis=(1, 3))
    return kernel / kernel.sum()


def edge_share(radius: float, n: int = 400) -> np.ndarray:
    """Return the means over cells of (acos s - s sqrt(1 - s²))/π, the share of the pupil on the near side of an edge."""
    node, weight = leggauss(n)
    at = np.arange(N_EDGE)[:, np.newaxis] + 0.5 - N_EDGE // 2 + 0.5 * node
    s = np.clip(at / radius, -1.0, 1.0)
    return (np.arccos(s) - s * np.sqrt(1.0 - s * s)) / np.pi @ (0.5 * weight)


def own_edge(radius: float, *, reference: bool = False) -> np.ndarray:
    """Return the image of a white half plane in front of a grey background in focus, from 0 to 1, by foveasim."""
    is_near = np.arange(N_EDGE) < N_EDGE // 2
    depth_m = np.where(is_near, distance_of_m(RADIUS_UM), FOCUS_M) * np.ones((8, 1))
    picture = np.where(is_near, 1.0, 0.25) * np.ones((8, 1))
    map_of = lens().power_map(scene_of(picture, depth_m, RADIUS_UM / radius), reference=reference)
    return (map_of.data[0, 4] / on_axis() - 0.25) / 0.75


def opencv_layers(near: np.ndarray, is_near: np.ndarray, far: float, radius: float) -> np.ndarray:
    """Return the image of an object out of focus in front of a uniform background, by OpenCV."""
    kernel = disc_kernel(radius)
    light, cover = (
        cv2.filter2D(np.float64(each), cv2.CV_64F, kernel, borderType=cv2.BORDER_REPLICATE)
        for each in (near * is_near, is_near)
    )
    return light + (1.0 - cover) * far


def validate(section: Section, directory: Path) -> None:
    """Compare edges, objects, circles of confusion, and energies."""
    compare_edges(section, directory)
    compare_objects(section)
    compare_confusion(section)
    compare_energy(section)


def compare_edges(section: Section, directory: Path) -> None:
    """Compare edges with the closed form."""
    opencv, rays = f"OpenCV {cv2.__version__} filter2D, two layers", f"{OWN}, rays"
    row = np.broadcast_to(np.arange(N_EDGE) < N_EDGE // 2, (64, N_EDGE))

    def opencv_edge(radius: float) -> np.ndarray:
        return (opencv_layers(row, row, 0.25, radius)[32] - 0.25) / 0.75

    found = section.compare(
        f"edge in front of a background in focus, blurs of {', '.join(f'{each:g}' for each in EDGE_RADII)} cells",
        {
            OWN: lambda: np.array([own_edge(each) for each in EDGE_RADII]),
            rays: lambda: np.array([own_edge(each, reference=True) for each in EDGE_RADII]),
            opencv: lambda: np.array([opencv_edge(each) for each in EDGE_RADII]),
        },
        np.array([edge_share(each) for each in EDGE_RADII]),
        by="means over cells of [acos s - s √(1 - s²)]/π, s = x/r",
        source="part of a disc on one side of a chord",
        tolerance=2e-3,
        deviation=largest_absolute,
        of="of the step",
        cannot={
            opencv: "discs of given radii; pixels are points in the middle of cells",
            rays: "288 points of the pupil",
        },
        explanation=(
            "foveasim has diffraction, 1/800 of the radius. Its first images of such discs take some seconds for the OTFs, "
            "which are not part of the times."
        ),
    )
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    values, error = figure.subplots(1, 2)
    x = np.arange(N_EDGE) + 0.5 - N_EDGE // 2
    truth = edge_share(EDGE_RADII[-1])
    values.plot(x, truth, color="black", lw=2.5, alpha=0.3, label="truth")
    for program, each in found.items():
        values.plot(x, each[-1], lw=1.0, label=program)
        error.semilogy(x, np.abs(each[-1] - truth) + 1e-17, label=program)
    values.set(xlabel="x / cells", ylabel="share of the near side", xlim=(-20, 20))
    error.set(xlabel="x / cells", ylabel="deviation", xlim=(-20, 20), ylim=(1e-8, 1.0))
    error.legend(fontsize="small")
    section.draw(
        "edge", figure, "Edge in front of a background in focus, with a blur of 8 cells, and deviations.", directory
    )


def compare_objects(section: Section) -> None:
    """Compare textured objects in front of a uniform background."""
    random = np.random.default_rng(3)
    shape, texture = (
        gaussian_filter(random.standard_normal((N_OBJECT, N_OBJECT)), sigma, mode="wrap") for sigma in (9.0, 2.0)
    )
    is_near = shape > 0.0
    near = np.clip(0.6 + 0.15 * texture / texture.std(), 0.0, 1.0)
    far, cell_um = 0.3, RADIUS_UM / OBJECT_RADIUS
    depth_m = np.where(is_near, distance_of_m(RADIUS_UM), FOCUS_M)
    scene = scene_of(np.where(is_near, near, far), depth_m, cell_um)
    optics = lens(padding="periodic")
    # Replicas of the spectrum of square pixels in the means over cells.
    transfer = np.zeros((N_OBJECT, N_OBJECT))
    n = 12
    for k_x in range(-n, n + 1):
        for k_y in range(-n, n + 1):
            f_x, f_y = np.fft.fftfreq(N_OBJECT) + k_x, np.fft.fftfreq(N_OBJECT)[:, np.newaxis] + k_y
            v = 2.0 * np.pi * OBJECT_RADIUS * np.hypot(f_x, f_y)
            disc = np.divide(2.0 * j1(v), v, out=np.ones_like(v), where=v > 0.0)
            transfer += disc * (np.sinc(f_x) * np.sinc(f_y)) ** 2

    def blurred(each: np.ndarray) -> np.ndarray:
        return np.fft.ifft2(np.fft.fft2(each) * transfer).real

    def own(*, reference: bool = False) -> np.ndarray:
        return optics.power_map(scene, reference=reference).data[0][::-1] / on_axis()

    def by_opencv() -> np.ndarray:
        margin = 2 * int(OBJECT_RADIUS) + 2
        padded = [np.pad(each, margin, mode="wrap") for each in (near, is_near)]
        return opencv_layers(padded[0], padded[1], far, OBJECT_RADIUS)[margin:-margin, margin:-margin]

    opencv, rays = f"OpenCV {cv2.__version__} filter2D, two layers", f"{OWN}, rays"
    inner = slice(16, -16)
    section.compare(
        f"objects out of focus in front of a uniform background, blur of {OBJECT_RADIUS:g} cells",
        {
            OWN: lambda: own()[inner, inner],
            rays: lambda: own(reference=True)[inner, inner],
            opencv: lambda: by_opencv()[inner, inner],
        },
        (blurred(near * is_near) + (1.0 - blurred(is_near * 1.0)) * far)[inner, inner],
        by="covering by the blurred object, OTF 2 J₁(v)/v of the disc times sinc² of pixels and cells",
        source=POTMESIL,
        tolerance=1e-3,
        cannot={opencv: "takes pixels for points in the middle of cells"},
        explanation=(
            "The background is uniform, because its hidden parts are unknown to all programs. Without the 16 outer cells: the "
            "scene ends there for foveasim, even if its light is periodic."
        ),
    )


def compare_confusion(section: Section) -> None:
    """Compare the diameters of circles of confusion with those fitted to images of an edge."""
    picture = (np.arange(N_EDGE) < N_EDGE // 2) * np.ones((8, 1))

    def diameters() -> np.ndarray:
        found = []
        for distance_m in DISTANCES_M:
            cell_um = abs(blur_radius_um(distance_m)) / 12.3
            scene = scene_of(picture, np.full(picture.shape, distance_m), cell_um)
            line = lens().power_map(scene).data[0, 4] / on_axis()
            fit = scipy.optimize.minimize_scalar(
                lambda radius, line=line: np.square(edge_share(radius, 40) - line).sum(),
                bounds=(8.0, 18.0),
                method="bounded",
                options={"xatol": 1e-8},
            )
            found.append(2.0 * fit.x * cell_um)
        return np.array(found)

    f_m = 1e-3 * FOCAL_MM
    at_m = np.array(DISTANCES_M)
    section.compare(
        f"diameters of circles of confusion, {DISTANCES_M[0]:g} m to infinity",
        {OWN: diameters},
        1e6 * f_m**2 / F_NUMBER * np.abs(at_m - FOCUS_M) / (at_m * (FOCUS_M - f_m)),
        by="f²/N |H - H_focus| / [H (H_focus - f)], fitted to the images of an edge",
        source=POTMESIL,
        tolerance=1e-2,
        deviation=largest_relative,
        explanation=(
            "The radii are 21 to 64 λN: fringes of Fresnel diffraction in the discs displace the fit by up to 0.1 λN of "
            "the radius."
        ),
        repeats=1,
    )


def compare_energy(section: Section) -> None:
    """Compare the energy of points, and the irradiance of equal radiances."""
    cell_um, n = 4.0, 128

    def energies() -> np.ndarray:
        found = []
        for distance_m in DISTANCES_M:
            for is_alone in (True, False):
                picture, depth_m = np.zeros((n, n)), np.full((n, n), distance_m if is_alone else FOCUS_M)
                picture[60, 66], depth_m[60, 66] = 1.0, distance_m
                scene = scene_of(picture, depth_m, cell_um)
                found.append(lens(padding="periodic").power_map(scene).data.sum())
        return np.array(found)

    section.compare(
        f"energy of a point, {DISTANCES_M[0]:g} m to infinity, alone or in front of a background",
        {OWN: energies},
        np.full(2 * len(DISTANCES_M), on_axis()),
        by="π/(1 + 4 N²) times the area of its image in focus",
        source="conservation of energy",
        tolerance=1e-9,
        deviation=largest_relative,
        repeats=1,
    )
    random = np.random.default_rng(1)
    hills = gaussian_filter(random.standard_normal((n, n)), 8.0, mode="wrap")
    depth_m = np.where(hills > 0.0, 0.7, 1.0 + 2.0 * np.abs(hills) / hills.std())
    section.compare(
        "irradiance of equal radiances at 0.7 m and from 1 m to 9 m",
        {OWN: lambda: lens().power_map(scene_of(np.ones((n, n)), depth_m, cell_um)).data[0]},
        np.full((n, n), on_axis()),
        by="π/(1 + 4 N²)",
        source="invariance of radiance",
        tolerance=1e-6,
        deviation=largest,
    )
