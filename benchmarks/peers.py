"""
The same work with other libraries: time and agreement of each, measured in one run.

    python benchmarks/peers.py             2048 x 2048 photosites; 30,240 log-polar sites on 38 million cells
    python benchmarks/peers.py --quick     512 x 512; the same sites on 2.4 million cells

A capture: a picture through a diffraction-limited lens of f/4 onto square photosites, shot noise, read noise, 12 bits. The
convolutions of SciPy and OpenCV use a PSF that is truncated to 97 cells.

An integration: the sums of a map over polygons. Labels of the cells are not exact: a cell belongs to one site completely.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable

import cv2
import numpy as np
import scipy.ndimage
import scipy.signal
import shapely
from dense import DISTANCE_M, PITCH_UM, dense_optics
from rich.console import Console
from rich.table import Table

import foveasim as fs

WAVELENGTH_NM, EXPOSURE_S, READ_NOISE_E, FULL_WELL_E, V_SAT_V, BITS = 550.0, 0.02, 3.0, 1e4, 3.0, 12
#: Cells and samples per cell of the truncated PSF.
PSF_CELLS, PSF_SAMPLES = 97, 9
N_REPEATS = 3
#: Compared values: without the boundary, where the libraries continue a picture in different ways.
MARGIN = slice(PSF_CELLS, -PSF_CELLS)
console = Console(width=130)


def compare(
    title: str,
    calls: dict[str, Callable[[], np.ndarray]],
    *,
    illumination: np.ndarray | float = 1.0,
    is_noisy: bool = False,
) -> None:
    """
    Print time, ratio and largest relative difference of each call from the first one.

    The first result is divided by its relative illumination before. Of noisy results, the means are compared.
    """
    found = {name: call() for name, call in calls.items()}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(N_REPEATS):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    table = Table(title=title)
    for heading in ("library", "time", "its time over foveasim's", "largest relative difference"):
        table.add_column(heading, justify="left" if heading == "library" else "right")
    first = next(iter(found))
    own, own_s = found[first], statistics.median(seconds[first])
    found[first] = own = own / illumination
    for name, values in found.items():
        s = statistics.median(seconds[name])
        reference, compared = (array[own.ndim * (MARGIN,)].astype(np.float64) for array in (own, values))
        if is_noisy:
            reference, compared = reference.mean(), compared.mean()
        difference = float(np.max(np.abs(compared - reference)) / np.max(np.abs(reference)))
        table.add_row(name, f"{s:.3g} s", f"{s / own_s:.3g}", f"{difference:.1e}")
    console.print(table)


def compare_captures(n_side: int) -> None:
    """Compare optical images, and complete captures."""
    rng = np.random.default_rng(0)
    picture = scipy.ndimage.gaussian_filter(rng.random((n_side, n_side)), 3.0, mode="wrap")
    picture = np.float32((picture - picture.min()) / np.ptp(picture))
    optics = dense_optics()
    pitch_um = PITCH_UM / optics.magnification(DISTANCE_M)
    scene = fs.Scene(picture[np.newaxis], np.full((1, 1), 0.01), [WAVELENGTH_NM], [10.0], pitch_um, DISTANCE_M)
    layout = fs.layout.grid(n_x=n_side, n_y=n_side, pitch_um=PITCH_UM)
    capacitance_f = FULL_WELL_E * fs.units.ELEMENTARY_CHARGE_C / V_SAT_V
    sensor = fs.Sensor(layout, read_noise_e=READ_NOISE_E, capacitance_f=capacitance_f, v_sat_v=V_SAT_V, bits=BITS)
    camera = fs.Camera(optics=optics, sensor=sensor)
    # Photoelectrons of a picture of 1, without relative illumination.
    flat = optics.irradiance_per_radiance(DISTANCE_M) * 0.01 * 10.0
    scale_e = flat * PITCH_UM**2 * 1e-12 * EXPOSURE_S / fs.units.photon_energy_j(WAVELENGTH_NM)
    psf = optics.psf(
        WAVELENGTH_NM, distance_m=DISTANCE_M, pitch_um=PITCH_UM / PSF_SAMPLES, n_points=PSF_CELLS * PSF_SAMPLES
    ).psf_per_um2
    kernel = psf.reshape(PSF_CELLS, PSF_SAMPLES, PSF_CELLS, PSF_SAMPLES).sum(axis=(1, 3))
    kernel = np.float32(kernel / kernel.sum())

    def scipy_image() -> np.ndarray:
        padded = np.pad(picture, PSF_CELLS // 2, mode="symmetric")
        return scale_e * scipy.signal.fftconvolve(padded, kernel, mode="valid")

    def opencv_image() -> np.ndarray:
        return scale_e * cv2.filter2D(picture, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT)

    def noisy(image_e: np.ndarray) -> np.ndarray:
        electrons = rng.poisson(image_e) + READ_NOISE_E * rng.standard_normal(image_e.shape)
        return np.clip(electrons * (2**BITS / FULL_WELL_E), 0, 2**BITS - 1).astype(np.uint16)

    def own_image() -> np.ndarray:
        return EXPOSURE_S * camera.photoelectrons_per_s(scene).reshape(n_side, n_side)

    # cos^4, which the other libraries do not model.
    x_um = layout.lattice.x_um.mean(axis=1)
    distance_um = 1e3 * optics.focal_length_mm * (1.0 + optics.magnification(DISTANCE_M))
    illumination = (1.0 + (x_um**2 + x_um[:, np.newaxis] ** 2) / distance_um**2) ** -2
    images = {"scipy.signal.fftconvolve": scipy_image, "cv2.filter2D": opencv_image}
    captures: dict[str, Callable[[], np.ndarray]] = {
        "foveasim": lambda: camera.capture(scene, exposure_s=EXPOSURE_S, seed=0).code.reshape(n_side, n_side)
    }
    captures |= {f"{name}, numpy.random": lambda image=image: noisy(image()) for name, image in images.items()}
    try:
        import galsim
    except ImportError:
        console.print("GalSim is not installed: make peers installs it")
    else:
        airy = galsim.Airy(lam_over_diam=1e-3 * WAVELENGTH_NM * optics.working_f_number(DISTANCE_M), flux=1.0)
        noise = galsim.CCDNoise(galsim.BaseDeviate(0), gain=1.0, read_noise=READ_NOISE_E)
        parameters = galsim.GSParams(maximum_fft_size=4 * n_side + 4096)

        def galsim_picture() -> galsim.Image:
            light = galsim.InterpolatedImage(
                galsim.Image(scale_e * picture, scale=PITCH_UM), x_interpolant="lanczos5", gsparams=parameters
            )
            return galsim.Convolve(light, airy, gsparams=parameters).drawImage(nx=n_side, ny=n_side, scale=PITCH_UM)

        def galsim_codes() -> np.ndarray:
            image = galsim_picture()
            image.addNoise(noise)
            return np.clip(image.array * (2**BITS / FULL_WELL_E), 0, 2**BITS - 1).astype(np.uint16)

        images["GalSim"] = lambda: galsim_picture().array
        captures["GalSim"] = galsim_codes
    compare(
        f"Optical image of {n_side} x {n_side} pixels, photoelectrons",
        {"foveasim": own_image} | images,
        illumination=illumination,
    )
    compare(f"Capture with noise, {n_side} x {n_side} photosites", captures, illumination=illumination, is_noisy=True)


def compare_integration(shape: tuple[int, int]) -> None:
    """Compare sums of a map over polygons."""
    from exactextract import exact_extract
    from exactextract.feature import JSONFeatureSource
    from exactextract.raster import NumPyRasterSource

    grid = fs.Grid.centred(shape, 0.5)
    r_max_um = 0.495 * shape[0] * grid.pitch_um
    layout = fs.layout.log_polar(n_sectors=240, n_rings=126, r_min_um=0.026 * r_max_um, r_max_um=r_max_um)
    cells = np.random.default_rng(0).random(shape, dtype=np.float32)
    top_first = np.ascontiguousarray(cells[::-1])
    polygons = layout.polygons()
    features = [
        {"type": "Feature", "id": str(i), "properties": {}, "geometry": json.loads(polygon)}
        for i, polygon in enumerate(shapely.to_geojson(polygons))
    ]
    raster = NumPyRasterSource(top_first, *grid.bounds_um)
    labels = np.zeros(shape, np.int32)
    corners = (np.array([grid.x_um[0], grid.y_um[0]]), grid.pitch_um)
    for site, polygon in enumerate(polygons, 1):
        vertices = (np.array(polygon.exterior.coords) - corners[0]) / corners[1]
        cv2.fillPoly(labels, [np.rint(256 * vertices).astype(np.int32)], site, shift=8)
    integrator = fs.Integrator(layout, grid)
    index = np.arange(1, layout.n_sites + 1)

    def extracted() -> np.ndarray:
        found = exact_extract(raster, JSONFeatureSource(features), ["sum"], strategy="raster-sequential")
        return np.array([feature["properties"]["sum"] for feature in found])

    compare(
        f"Sums over {layout.n_sites:,} log-polar sites on {shape[0]} x {shape[1]} cells",
        {
            "foveasim": lambda: integrator(cells) / grid.cell_area_um2,
            "foveasim, with compilation": lambda: fs.Integrator(layout, grid)(cells) / grid.cell_area_um2,
            "exactextract": extracted,
            "scipy.ndimage.sum_labels of cv2.fillPoly": lambda: scipy.ndimage.sum_labels(cells, labels, index),
        },
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    is_quick = parser.parse_args().quick
    compare_captures(512 if is_quick else 2048)
    compare_integration((1160, 2064) if is_quick else (4640, 8256))
