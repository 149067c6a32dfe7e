"""
Integrals of a map over polygon photosites.

The map is a photograph of 256 x 256 cells, each with a constant value. exactextract and foveasim compute the area of each cell
within each polygon, and agree with intersections of polygons by shapely (GEOS) to rounding; foveasim does so for a layout that
it compiled before, exactextract finds the overlaps again for each map. Labels assign whole cells to sites: cv2.fillPoly draws
polygons with their border cells, which later sites overwrite, skimage.draw.polygon the cells whose centres are inside. pyFAI
splits detector pixels among polar bins, as if edges of pixels were straight lines of radius and azimuth.

Maps that vary within cells are not constant there: the second order of foveasim reconstructs a gradient, and its error falls
with a higher power of the cell size.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import scipy.ndimage
import shapely
import skimage
from matplotlib.figure import Figure
from numpy.polynomial.legendre import leggauss
from records import OWN, Section, largest, largest_relative, version_of

import foveasim as fs

N_CELLS = 256
GRID = fs.Grid.centred((N_CELLS, N_CELLS), 1.0)
#: Half of the side of the map, µm.
HALF_UM = 0.5 * N_CELLS
GEOS = "shapely, intersections of polygons and cells by GEOS"
CENTRES, FILLED = "labels of skimage.draw.polygon, SciPy", "labels of cv2.fillPoly, SciPy"
#: Wave vectors of the smooth map, 1/µm.
WAVE_X, WAVE_Y = 2.0 * np.pi / 20.0, 2.0 * np.pi / 26.0


def photograph() -> np.ndarray:
    """Return the cells of the map, the bottom row first."""
    picture = skimage.data.camera().astype(np.float64)
    return np.ascontiguousarray(picture.reshape(N_CELLS, 2, N_CELLS, 2).mean(axis=(1, 3))[::-1])


def sums_by_clipping(polygons: Sequence[shapely.Polygon], cells: np.ndarray) -> np.ndarray:
    """Return the sums over cells of value times area of the intersection, by shapely."""
    edge_um = np.arange(N_CELLS + 1) - HALF_UM
    x, y = np.meshgrid(edge_um[:-1], edge_um[:-1])
    boxes = shapely.box(x.ravel(), y.ravel(), x.ravel() + 1.0, y.ravel() + 1.0)
    polygons = np.asarray(polygons)
    shapely.prepare(polygons)
    site, cell = shapely.STRtree(boxes).query(polygons)
    area = np.ones(site.size)
    is_cut = ~shapely.contains(polygons[site], boxes[cell])
    area[is_cut] = shapely.area(shapely.intersection(polygons[site[is_cut]], boxes[cell[is_cut]]))
    return np.bincount(site, weights=area * cells.ravel()[cell], minlength=polygons.size)


def extracted(polygons: Sequence[shapely.Polygon], cells: np.ndarray, grid: fs.Grid = GRID) -> Callable[[], np.ndarray]:
    """Return a call of exactextract, whose raster has the top row first."""
    from exactextract import exact_extract
    from exactextract.feature import JSONFeatureSource
    from exactextract.raster import NumPyRasterSource

    raster = NumPyRasterSource(np.ascontiguousarray(cells[::-1]), *grid.bounds_um)
    features = [
        {"type": "Feature", "id": str(k), "properties": {}, "geometry": json.loads(each)}
        for k, each in enumerate(shapely.to_geojson(np.asarray(polygons)))
    ]

    def call() -> np.ndarray:
        found = exact_extract(raster, JSONFeatureSource(features), ["sum"], strategy="raster-sequential")
        return grid.cell_area_um2 * np.array([each["properties"]["sum"] for each in found])

    return call


def labelled(
    polygons: Sequence[shapely.Polygon], cells: np.ndarray, drawing: str, grid: fs.Grid = GRID
) -> Callable[[], np.ndarray]:
    """Return a call that sums cells by labels, which are drawn before: by cell centres, or with border cells."""
    labels = np.zeros(cells.shape, np.int32)
    first_um = np.array([grid.x_um[0], grid.y_um[0]])
    for site, polygon in enumerate(polygons, 1):
        rings = [(np.array(ring.coords) - first_um) / grid.pitch_um for ring in (polygon.exterior, *polygon.interiors)]
        if drawing == FILLED:
            cv2.fillPoly(labels, [np.rint(256.0 * ring).astype(np.int32) for ring in rings], site, shift=8)
            continue
        for k, ring in enumerate(rings):
            row, column = skimage.draw.polygon(ring[:, 1], ring[:, 0], cells.shape)
            labels[row, column] = 0 if k else site
    index = np.arange(1, len(polygons) + 1)
    return lambda: grid.cell_area_um2 * np.asarray(scipy.ndimage.sum_labels(cells, labels, index))


def programs(layout: fs.Layout, cells: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
    """Return the calls of all programs for a layout."""
    integrator, polygons = fs.Integrator(layout, GRID), layout.polygons()
    return {
        OWN: lambda: integrator(cells),
        "foveasim, with compilation": lambda: fs.Integrator(layout, GRID)(cells),
        f"exactextract {version_of('exactextract')}": extracted(polygons, cells),
        CENTRES: labelled(polygons, cells, CENTRES),
        FILLED: labelled(polygons, cells, FILLED),
    }


def stars() -> fs.Layout:
    """Return concave sites: stars of five to eight points, each in its own direction, some with a hole."""
    rng, polygons = np.random.default_rng(3), []
    for x in np.arange(-110.0, 111.0, 20.0):
        for y in np.arange(-110.0, 111.0, 20.0):
            n, turn = rng.integers(5, 9), rng.uniform(0.0, np.pi)
            angle = turn + np.pi / n * np.arange(2 * n)
            radius = np.where(np.arange(2 * n) % 2, 3.5, 9.5)
            centre = np.array([x, y]) + rng.uniform(-0.5, 0.5, 2)
            star = shapely.Polygon(centre + radius[:, np.newaxis] * np.column_stack((np.cos(angle), np.sin(angle))))
            hole = shapely.Point(centre).buffer(1.7, quad_segs=2)
            polygons.append(star.difference(hole) if n % 2 else star)
    return fs.Layout.from_polygons(polygons)


def tiles() -> fs.Layout:
    """Return Voronoi cells of random points, which cover the map without gaps."""
    points = np.random.default_rng(5).uniform(-HALF_UM, HALF_UM, (600, 2))
    cells = shapely.voronoi_polygons(shapely.MultiPoint(points), extend_to=shapely.box(*GRID.bounds_um))
    whole = shapely.box(*GRID.bounds_um)
    return fs.Layout.from_polygons([shapely.intersection(each, whole) for each in cells.geoms])


# -- polar bins -------------------------------------------------------------------------------------------------------

N_SECTORS, RADII_UM, STEP_UM = 24, np.linspace(20.0, 120.0, 11), 10.0


def sectors(n_chords: int) -> list[shapely.Polygon]:
    """Return annular sectors by azimuth, then radius, whose arcs are chords of the same area."""
    step = 2.0 * np.pi / N_SECTORS
    half = step / n_chords
    equal_area = math.sqrt(half / math.sin(half))
    found = []
    for k in range(N_SECTORS):
        angle = -np.pi + step * (k + np.linspace(0.0, 1.0, n_chords + 1))
        arc = equal_area * np.column_stack((np.cos(angle), np.sin(angle)))
        found += [
            shapely.Polygon(np.concatenate((inner * arc[::-1], outer * arc))) for inner, outer in pairwise(RADII_UM)
        ]
    return found


def by_pyfai(cells: np.ndarray, splitting: str) -> Callable[[], np.ndarray]:
    """
    Return a call of pyFAI, whose sparse matrix is computed in the first call.

    The outermost bins also receive what pixels have beyond the range; there is one more at each end, which is not compared.
    """
    from pyFAI.detectors import Detector
    from pyFAI.integrator.azimuthal import AzimuthalIntegrator

    detector = Detector(1e-6, 1e-6, max_shape=cells.shape, orientation=3)
    integrator = AzimuthalIntegrator(dist=1.0, poni1=1e-6 * HALF_UM, poni2=1e-6 * HALF_UM, detector=detector)

    def call() -> np.ndarray:
        found = integrator.integrate2d_ng(
            cells,
            RADII_UM.size + 1,
            N_SECTORS,
            unit="r_mm",
            radial_range=(1e-3 * (RADII_UM[0] - STEP_UM), 1e-3 * (RADII_UM[-1] + STEP_UM)),
            azimuth_range=(-180.0, 180.0),
            method=(splitting, "csr", "cython"),
            correctSolidAngle=False,
        )
        return np.asarray(found.sum_signal, np.float64)[:, 1:-1].ravel()

    call()
    return call


# -- maps that vary within cells --------------------------------------------------------------------------------------


def wave_cells(grid: fs.Grid) -> np.ndarray:
    """Return the means over cells of 1 + cos(kx x) cos(ky y)/2."""
    sinc_x, sinc_y = (np.sinc(k * grid.pitch_um / (2.0 * np.pi)) for k in (WAVE_X, WAVE_Y))
    along_x, along_y = np.cos(WAVE_X * np.asarray(grid.x_um)), np.cos(WAVE_Y * np.asarray(grid.y_um))
    return 1.0 + 0.5 * sinc_x * sinc_y * along_y[:, np.newaxis] * along_x


def wave_integrals(polygons: Sequence[shapely.Polygon], n: int = 40) -> np.ndarray:
    """Return the integrals of the wave over polygons: ∮ F dy with F the integral over x, by Gauss-Legendre along edges."""
    node, weight = leggauss(n)
    part = 0.5 * (node + 1.0)[:, np.newaxis]
    found = []
    for polygon in polygons:
        total = 0.0
        for k, ring in enumerate((polygon.exterior, *polygon.interiors)):
            x, y = np.array(ring.coords).T
            at_x, at_y = (a[:-1] + part * np.diff(a) for a in (x, y))
            primitive = at_x + 0.5 * np.sin(WAVE_X * at_x) / WAVE_X * np.cos(WAVE_Y * at_y)
            area = 0.5 * float((weight @ (primitive * np.diff(y))).sum()) * (1.0 if ring.is_ccw else -1.0)
            total += -area if k else area
        found.append(total)
    return np.array(found)


def validate(section: Section, directory: Path) -> None:
    """Compare integrals over sites with clipped polygons and closed forms."""
    cells = photograph()
    extract = f"exactextract {version_of('exactextract')}"
    for what, layout in (
        ("log-polar sites", fs.layout.log_polar(n_sectors=60, n_rings=24, r_min_um=10.0, r_max_um=126.0)),
        ("hexagons of 7.3 µm", fs.layout.hexagonal(n_columns=33, n_rows=39, pitch_um=7.3)),
        ("concave stars, some with holes", stars()),
    ):
        section.compare(
            f"integrals over {layout.n_sites:,} {what}",
            programs(layout, cells),
            sums_by_clipping(layout.polygons(), cells),
            by="Σ value x area of polygon ∩ cell",
            source=GEOS,
            tolerance=1e-12,
            cannot={
                extract: "overlaps are found again for each map; users can store its coverage fractions as a matrix",
                CENTRES: "no parts of cells; the time is without drawing labels",
            },
            explanation="Labels err by the cells that a border cuts. exactextract keeps parts of cells in single precision.",
        )
    layout = tiles()
    total = math.fsum(cells.ravel())
    calls = programs(layout, cells)
    section.compare(
        f"sum over {layout.n_sites} Voronoi cells that cover the map, against the sum of the map",
        {program: lambda call=call: call().sum() for program, call in calls.items()},
        total,
        by="sum of all cells, exactly rounded",
        source="conservation",
        tolerance=1e-12,
        deviation=largest_relative,
        repeats=0,
        explanation="Labels give each cell to one site, and conserve the sum unless no site contains the centre of a cell.",
    )
    fine, polar = sectors(512), fs.Layout.from_polygons(sectors(64))
    integrator = fs.Integrator(polar, GRID)
    pyfai = f"pyFAI {version_of('pyFAI')}"
    section.compare(
        f"integrals over {polar.n_sites} sectors of annuli, 10 µm x 15°",
        {
            OWN: lambda: integrator(cells),
            extract: extracted(polar.polygons(), cells),
            f"{pyfai}, full splitting": by_pyfai(cells, "full"),
            f"{pyfai}, splitting of bounding boxes": by_pyfai(cells, "bbox"),
            CENTRES: labelled(polar.polygons(), cells, CENTRES),
        },
        sums_by_clipping(fine, cells),
        by="Σ value x area of sector ∩ cell, arcs of 512 chords",
        source=GEOS,
        tolerance=1e-6,
        cannot={
            f"{pyfai}, full splitting": "bins are sectors, no other shapes; areas are those in radius and azimuth",
            f"{pyfai}, splitting of bounding boxes": "areas are those of bounding boxes in radius and azimuth",
        },
        explanation="foveasim and exactextract have arcs of 64 chords of the same area. Splitting in radius and azimuth takes "
        "curved edges for straight, and areas for those in these coordinates.",
    )
    found = compare_orders(section)
    draw_orders(section, directory, found)


def compare_orders(section: Section) -> dict[str, np.ndarray]:
    """Compare integrals of a smooth map over cells of several sizes; return the errors by program."""
    layout = fs.layout.log_polar(n_sectors=40, n_rings=16, r_min_um=10.0, r_max_um=50.0)
    polygons = layout.polygons()
    truth = wave_integrals(polygons)
    extract = f"exactextract {version_of('exactextract')}"
    sizes_um = np.array([4.0, 2.0, 1.0, 0.5, 0.25])
    errors = {name: np.empty(sizes_um.size) for name in ("foveasim, order 2", "foveasim, order 1", extract, CENTRES)}
    for k, pitch_um in enumerate(sizes_um):
        n = round(112.0 / pitch_um)
        grid = fs.Grid.centred((n, n), float(pitch_um))
        cells = wave_cells(grid)
        second, first = (fs.Integrator(layout, grid, order=order) for order in (2, 1))
        calls = {
            "foveasim, order 2": lambda second=second, cells=cells: second(cells),
            "foveasim, order 1": lambda first=first, cells=cells: first(cells),
            extract: extracted(polygons, cells, grid),
            CENTRES: labelled(polygons, cells, CENTRES, grid),
        }
        for name, call in calls.items():
            errors[name][k] = np.abs(call() / truth - 1.0).max()
        if pitch_um == 0.5:
            section.compare(
                f"a wave with periods of 20 and 26 µm over {layout.n_sites} log-polar sites, cells of 0.5 µm",
                {OWN: calls["foveasim, order 2"]}
                | {name: call for name, call in calls.items() if name != "foveasim, order 2"},
                truth,
                by="closed form in x, Gauss-Legendre along edges (Green's theorem)",
                source="Green's theorem",
                tolerance=2e-5,
                deviation=largest,
                cannot={extract: "cells are constant", CENTRES: "cells are constant, and belong to one site"},
                explanation="Constant cells err by the gradient within the cells that a border cuts, in exactextract as in the "
                "first order of foveasim.",
            )
    return {"sizes_um": sizes_um, **errors}


def draw_orders(section: Section, directory: Path, found: dict[str, np.ndarray]) -> None:
    """Draw the largest error against the size of cells."""
    figure = Figure(figsize=(5.2, 3.0), layout="constrained")
    axes = figure.subplots()
    sizes_um = found["sizes_um"]
    for (name, values), style in zip(list(found.items())[1:], ("o-", "s-", "x--", "^-"), strict=True):
        axes.loglog(sizes_um, values, style, label=name)
    axes.set_xticks(sizes_um, [f"{each:g}" for each in sizes_um])
    axes.set_xticks([], minor=True)
    axes.set(xlabel="cell / µm", ylabel="largest relative error")
    axes.legend(fontsize="small")
    section.draw(
        "orders",
        figure,
        "Integrals of a smooth wave over log-polar sites: largest error against the size of cells.",
        directory,
    )
