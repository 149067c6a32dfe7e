"""
Response of pixels to oblique cones of light: openings above photodiodes, and microlenses.

Rays are geometric. The light that passes an opening and reaches the photodiode below is the overlap of two displaced polygons,
averaged over the cone; a microlens images the pupil onto the photodiode. foveasim uses few rays where displacements are small,
and promises responses within 1e-3 of the mean over the cone (2e-3 at f/2 and 4e-3 at f/1.4 for microlenses). None of the other
programs has pixels under cones of light; compared are 100,000 random rays by NumPy, and the shadow of the chief ray alone, a
common approximation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import shapely
from matplotlib.figure import Figure
from numpy.polynomial.legendre import leggauss
from records import OWN, Section, largest_absolute, largest_relative, version_of

import foveasim as fs

WIDTH_UM, INDEX = 3.0, 1.5
SQUARE = fs.Layout.from_rectangles([[0.0, 0.0]], WIDTH_UM)
AZIMUTH_DEG = 25.0
CATRYSSE = "Catrysse and Wandell, J. Opt. Soc. Am. A 19, 1610 (2002)"
N_RANDOM = 100_000
RANDOM = f"{N_RANDOM:,} rays, NumPy {version_of('numpy')}"
CHIEF = "shadow of the chief ray"


def cone(layout: fs.Layout, angle_deg: float, f_number: float) -> fs.incidence.Incidence:
    """Return cones of light with the same chief ray angle at all sites."""
    table = fs.optics.ChiefRayTable((0.0, 1.0, 1e6), (0.0, angle_deg, angle_deg))
    optics = fs.Optics(focal_length_mm=8.0, f_number=f_number, chief_ray=table)
    azimuth = math.radians(AZIMUTH_DEG)
    return optics.incidence(np.tile([1e4 * math.cos(azimuth), 1e4 * math.sin(azimuth)], (layout.n_sites, 1)))


def chief_tangent(angle_deg: float) -> np.ndarray:
    """Return the tangent of the chief ray along x and y."""
    azimuth = math.radians(AZIMUTH_DEG)
    return math.tan(math.radians(angle_deg)) * np.array([math.cos(azimuth), math.sin(azimuth)])


def displacement_um(tangent: np.ndarray, height_um: float) -> np.ndarray:
    """Return where rays (n, 2) meet the photodiode, relative to the opening, by Snell's law."""
    squared = np.square(tangent).sum(axis=-1, keepdims=True)
    sine = tangent / np.sqrt(1.0 + squared) / INDEX
    return height_um * sine / np.sqrt(1.0 - np.square(sine).sum(axis=-1, keepdims=True))


def square_share(at_um: np.ndarray) -> np.ndarray:
    """Return the overlap of a square with a displaced one over its area."""
    return np.prod(np.maximum(1.0 - np.abs(at_um) / WIDTH_UM, 0.0), axis=-1)


def by_quadrature(angle_deg: float, f_number: float, height_um: float, n: int = 600) -> float:
    """Return the mean share over the cone, weighted by irradiance: Gauss-Legendre in radius, equal steps in angle."""
    node, weight = leggauss(n // 2)
    radius, angle = 0.25 / f_number * (node + 1.0), 2.0 * np.pi * (np.arange(n) + 0.3) / n
    disc = radius[:, np.newaxis, np.newaxis] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    tangent = chief_tangent(angle_deg) + disc
    # Irradiance of a pupil plane parallel to the sensor: cos⁴ for each of its parts.
    irradiance = (weight * radius)[:, np.newaxis] * (1.0 + np.square(tangent).sum(axis=-1)) ** -2.0
    return float(np.average(square_share(displacement_um(tangent, height_um)), weights=irradiance))


def random_tangents(angle_deg: float, f_number: float) -> tuple[np.ndarray, np.ndarray]:
    """Return random rays of the cone, and their weights."""
    rng = np.random.default_rng(7)
    radius, angle = 0.5 / f_number * np.sqrt(rng.random(N_RANDOM)), 2.0 * np.pi * rng.random(N_RANDOM)
    tangent = chief_tangent(angle_deg) + np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))
    return tangent, (1.0 + np.square(tangent).sum(axis=-1)) ** -2.0


# -- openings ---------------------------------------------------------------------------------------------------------


def stack_response(layout: fs.Layout, angle_deg: float, f_number: float, height_um: float) -> float:
    """Return the response of foveasim."""
    stack = fs.sensor.ApertureStack(height_um=height_um, refractive_index=INDEX)
    return float(stack.footprints(layout, cone(layout, angle_deg, f_number)).response[0])


def compare_openings(section: Section, directory: Path) -> None:
    """Compare overlaps of openings and photodiodes."""
    angles_deg = np.arange(0.0, 41.0, 5.0)
    height_um, narrow = 2.0, 1000.0
    hexagon = fs.layout.hexagonal(n_columns=1, n_rows=1, pitch_um=WIDTH_UM)
    outline = hexagon.polygons()[0]
    moved = [displacement_um(chief_tangent(each), height_um) for each in angles_deg]
    for what, layout, truth, by in (
        ("square", SQUARE, [square_share(each) for each in moved], "(1 - |dx|/w)(1 - |dy|/w), d = h tan asin(sin θ/n)"),
        (
            "hexagon",
            hexagon,
            [outline.intersection(shapely.affinity.translate(outline, *-each)).area / outline.area for each in moved],
            "overlap of displaced hexagons by shapely (GEOS)",
        ),
    ):
        section.compare(
            f"response of a {what} of 3 µm under an opening, height 2 µm, f/1000, chief rays up to 40°",
            {OWN: lambda layout=layout: np.array([stack_response(layout, a, narrow, height_um) for a in angles_deg])},
            np.array(truth),
            by=by,
            source=f"geometric shadow; {CATRYSSE}",
            tolerance=1e-3,
            deviation=largest_absolute,
            of="of 1",
        )
    relative = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    f_number = 100.0
    section.compare(
        "response of a square to a cone on the axis, blur radius up to half of the width",
        {
            OWN: lambda: np.array(
                [stack_response(SQUARE, 0.0, f_number, r * WIDTH_UM * INDEX * 2.0 * f_number) for r in relative]
            )
        },
        1.0 - 8.0 * relative / (3.0 * np.pi) + relative**2 / (2.0 * np.pi),
        by="1 - 8 r/3π + r²/2π, r = h/(2 n N w)",
        source="mean of (1 - |x|)(1 - |y|) over a disc",
        tolerance=1e-3,
        deviation=largest_absolute,
        of="of 1",
    )
    cases = [(a, n) for n in (1.4, 2.0, 2.8, 5.6) for a in (0.0, 6.0, 12.0, 18.0, 24.0)]
    truth = np.array([by_quadrature(a, n, height_um) for a, n in cases])

    def random() -> np.ndarray:
        found = []
        for angle_deg, f_number in cases:
            tangent, weight = random_tangents(angle_deg, f_number)
            found.append(np.average(square_share(displacement_um(tangent, height_um)), weights=weight))
        return np.array(found)

    found = section.compare(
        "response of a square to cones of f/1.4 to f/5.6, chief rays up to 24°",
        {
            OWN: lambda: np.array([stack_response(SQUARE, a, n, height_um) for a, n in cases]),
            RANDOM: random,
            CHIEF: lambda: np.array([square_share(displacement_um(chief_tangent(a), height_um)) for a, _ in cases]),
        },
        truth,
        by="quadrature over the exact cone, 180,000 rays",
        source=CATRYSSE,
        tolerance=1e-3,
        deviation=largest_absolute,
        of="of 1",
        cannot={CHIEF: "no width of the cone"},
    )
    figure = Figure(figsize=(5.2, 3.0), layout="constrained")
    axes = figure.subplots()
    for n, colour in ((1.4, "C0"), (5.6, "C1")):
        chosen = [k for k, (_, each) in enumerate(cases) if each == n]
        at = [cases[k][0] for k in chosen]
        axes.plot(at, truth[chosen], color=colour, lw=3, alpha=0.3, label=f"quadrature, f/{n:g}")
        axes.plot(at, found[OWN][chosen], "o", color=colour, label=f"foveasim, f/{n:g}")
    axes.plot(at, found[CHIEF][chosen], "k:", label=CHIEF)
    axes.set(xlabel="chief ray angle / °", ylabel="response")
    axes.legend(fontsize="small")
    section.draw(
        "openings",
        figure,
        "Response of a square of 3 µm, 2 µm below its opening, against the chief ray angle.",
        directory,
    )


# -- microlenses ------------------------------------------------------------------------------------------------------


def lens_response(layout: fs.Layout, angle_deg: float, f_number: float, height_um: float) -> float:
    """Return the response of foveasim without shift of the microlens."""
    microlens = fs.sensor.Microlens(height_um=height_um, refractive_index=INDEX)
    return float(microlens.footprints(layout, cone(layout, angle_deg, f_number)).response[0])


def compare_microlenses(section: Section) -> None:
    """Compare the light that microlenses bring to their photodiodes."""
    f_number, half_um = 100.0, 0.5 * WIDTH_UM
    # Radii of the image of the pupil over half of the width: inside of the square, and beyond its sides and corners.
    relative = np.array([0.5, 0.9, 1.0, 1.1, 1.25, 1.4, 1.8, 2.5])
    inside = np.minimum(1.0 / relative, 1.0)
    sides = 1.0 - 4.0 / np.pi * (np.arccos(inside) - inside * np.sqrt(1.0 - inside**2))
    truth = np.where(relative < math.sqrt(2.0), sides, 4.0 / (np.pi * relative**2))
    section.compare(
        "light on a square photodiode under a microlens, pupil image of 0.5 to 2.5 times its width",
        {
            OWN: lambda: np.array(
                [lens_response(SQUARE, 0.0, f_number, r * half_um * INDEX * 2.0 * f_number) for r in relative]
            )
        },
        truth,
        by="area of disc ∩ square over that of the disc",
        source="segments of a circle; étendue",
        tolerance=1e-3,
        deviation=largest_absolute,
        of="of 1",
    )
    n_corners, radius_um, height_um = 400, 1.0, 6.0
    angle = 2.0 * np.pi * np.arange(n_corners) / n_corners
    corner_um = radius_um * math.sqrt(2.0 * np.pi / n_corners / math.sin(2.0 * np.pi / n_corners))
    disc = fs.Layout.from_polygons([shapely.Polygon(corner_um * np.column_stack((np.cos(angle), np.sin(angle))))])
    f_numbers = np.array([1.4, 1.6, 2.0, 2.8, 4.0, 5.6])
    aperture = INDEX * radius_um / math.hypot(radius_um, height_um)
    pupil = 1.0 / np.sqrt(1.0 + 4.0 * f_numbers**2)

    def random() -> np.ndarray:
        found = []
        for n in f_numbers:
            tangent, weight = random_tangents(0.0, float(n))
            hit = np.hypot(*displacement_um(tangent, height_um).T) <= radius_um
            found.append(np.average(hit, weights=weight))
        return np.array(found)

    section.compare(
        "light on a disc of 1 µm radius, 6 µm under a microlens, f/1.4 to f/5.6",
        {OWN: lambda: np.array([lens_response(disc, 0.0, float(n), height_um) for n in f_numbers]), RANDOM: random},
        np.minimum((aperture / pupil) ** 2, 1.0),
        by="min(1, (NA/sin θ)²), NA = n r/√(r² + h²), tan θ = 1/2N",
        source="numerical aperture; conservation of étendue",
        tolerance=4e-3,
        deviation=largest_absolute,
        of="of 1",
    )
    angles_deg = np.array([0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0])

    def by_rays(angle_deg: float) -> float:
        """Return the share of the square by rings of many rays."""
        node, weight = leggauss(400)
        radius, direction = 0.25 / 2.8 * (node + 1.0), 2.0 * np.pi * (np.arange(2000) + 0.37) / 2000
        ring = radius[:, np.newaxis, np.newaxis] * np.stack((np.cos(direction), np.sin(direction)), axis=-1)
        tangent = chief_tangent(angle_deg) + ring
        hit = (np.abs(displacement_um(tangent, height_um)) <= half_um).all(axis=-1)
        return float(np.average(hit, weights=(weight * radius)[:, None] * (1.0 + np.square(tangent).sum(-1)) ** -2.0))

    def random_square() -> np.ndarray:
        found = []
        for each in angles_deg:
            tangent, weight = random_tangents(float(each), 2.8)
            hit = (np.abs(displacement_um(tangent, height_um)) <= half_um).all(axis=-1)
            found.append(np.average(hit, weights=weight))
        return np.array(found)

    section.compare(
        "light on a square of 3 µm, 6 µm under a microlens without shift, f/2.8, chief rays up to 30°",
        {OWN: lambda: np.array([lens_response(SQUARE, a, 2.8, height_um) for a in angles_deg]), RANDOM: random_square},
        np.array([by_rays(float(each)) for each in angles_deg]),
        by="800,000 rays on rings",
        source="Catrysse, Liu and El Gamal, Proc. SPIE 3965, 420 (2000)",
        tolerance=1e-3,
        deviation=largest_absolute,
        of="of 1",
    )


# -- irradiance -------------------------------------------------------------------------------------------------------


def compare_irradiance(section: Section) -> None:
    """Compare the irradiance of a cone with quadrature over the pupil."""
    angles_deg, f_number = np.arange(0.0, 41.0, 5.0), 1.4
    node, weight = leggauss(200)
    radius, direction = 0.25 / f_number * (node + 1.0), 2.0 * np.pi * np.arange(400) / 400
    disc = radius[:, np.newaxis, np.newaxis] * np.stack((np.cos(direction), np.sin(direction)), axis=-1)

    def solid_angle(angle_deg: float) -> float:
        """Return the projected solid angle of the pupil: cos⁴ for each of its parts."""
        tangent = chief_tangent(angle_deg) + disc
        part = (weight * radius)[:, np.newaxis] * (1.0 + np.square(tangent).sum(axis=-1)) ** -2.0
        return float(part.sum() * 0.25 / f_number * 2.0 * np.pi / 400)

    tangents = np.tan(np.radians(angles_deg))
    call: dict[str, Callable[[], np.ndarray]] = {
        OWN: lambda: fs.incidence.cone_irradiance_sr(tangents, 0.5 / f_number),
        "cos⁴ law": lambda: np.pi / (1.0 + 4.0 * f_number**2) * np.cos(np.radians(angles_deg)) ** 4,
    }
    section.compare(
        "irradiance of a pupil of f/1.4 over its radiance, chief rays up to 40°",
        call,
        np.array([solid_angle(float(each)) for each in angles_deg]),
        by="cos⁴ integrated over the pupil, 80,000 nodes",
        source="Foote, Bull. Bur. Stand. 12, 583 (1915)",
        tolerance=1e-12,
        deviation=largest_relative,
        cannot={"cos⁴ law": "small pupils only"},
    )


def validate(section: Section, directory: Path) -> None:
    """Compare responses to cones with closed forms and many rays."""
    compare_openings(section, directory)
    compare_microlenses(section)
    compare_irradiance(section)
