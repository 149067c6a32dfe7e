"""
Irradiance, photons, photometry and colour, and the light of pixels that see a uniform radiance.

The scene is uniform, so that diffraction has no effect, and images show the radiometry of the lens alone. The thin lens of
foveasim has π L sin²α on the axis and, by default, the cos⁴ law of the field; with an exit pupil, it integrates the radiance
over the disc. astropy converts units, and colour-science has the tables of the CIE in steps of 1 nm, where foveasim has steps
of 5 nm and takes the bands that a scene has. pyFAI has the solid angles of a flat detector at the centres of its pixels.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.polynomial.legendre import leggauss
from records import OWN, Section, largest, largest_absolute, largest_relative, version_of
from scipy.interpolate import CubicSpline

import foveasim as fs
from foveasim.scene._colorimetry import patch_colours

#: Exact values of the SI (BIPM, The International System of Units, 9th edition), J s and m/s.
PLANCK_J_S, LIGHT_M_S = 6.62607015e-34, 299_792_458.0
WAVELENGTH_NM = 550.0
BAND = {"wavelength_nm": [WAVELENGTH_NM], "band_width_nm": 1.0}
#: f-numbers and distances of the irradiance on the axis; the focal length is 8 mm.
F_NUMBERS, DISTANCES_M = (0.95, 1.4, 2.8, 5.6, 11.0), (0.03, 0.2, 1e4)
FOCAL_MM = 8.0
#: Image of the relative illumination: f/1.4, up to a tangent of the field angle of 0.85 along either axis.
FIELD_N, FIELD_TANGENT, N_FIELD = 1.4, 0.85, 201
#: Distance of planes far away.
FAR_M = 1e6
#: Pixels of the solid angles, and the tangent of the field at their outer edges.
N_PIXELS, PIXELS_TANGENT = 20, 1.0
#: Focal length of an equidistant lens, large compared with the PSF, and the largest angle of its photosites to the axis.
WIDE_FOCAL_UM, WIDE_DEG = 20_000.0, 105.0
BORN = "Born and Wolf, Principles of Optics (1999)"


def image_mm(focal_mm: float, distance_m: float) -> float:
    """Return the image distance D, 1/f = 1/H + 1/D."""
    return focal_mm * distance_m / (distance_m - 1e-3 * focal_mm)


def working_f_number(f_number: float, distance_m: float) -> float:
    """Return the f-number on the image side, N D / f."""
    return f_number * image_mm(FOCAL_MM, distance_m) / FOCAL_MM


def on_axis(lens: str) -> np.ndarray:
    """Return the irradiance in the centre of images of radiance 1, by foveasim."""
    found = []
    for f_number in F_NUMBERS:
        for distance_m in DISTANCES_M:
            scene = fs.Scene.flat(
                shape=(9, 9), pitch_um=10.0 * distance_m, distance_m=distance_m, radiance_w_m2_sr_nm=1.0, **BAND
            )
            optics = fs.Optics(focal_length_mm=FOCAL_MM, f_number=f_number, lens=lens, precision="double")
            found.append(optics.power_map(scene).data[0, 4, 4])
    return np.array(found)


def cone_irradiance(lens: str) -> np.ndarray:
    """Return π sin²α of the cones of :func:`on_axis`."""
    n = np.array([working_f_number(f_number, each_m) for f_number in F_NUMBERS for each_m in DISTANCES_M])
    return math.pi / (1.0 + 4.0 * n**2) if lens == "thin" else math.pi / (4.0 * n**2)


def disc_irradiance(tangent: np.ndarray, radius: float) -> np.ndarray:
    """
    Return the irradiance by a parallel disc of radiance 1, for radius and distance from its axis over the distance D.

    J. R. Howell, A Catalog of Radiation Heat Transfer Configuration Factors, B-13.
    """
    square = 1.0 + tangent**2 + radius**2
    return 0.5 * math.pi * (1.0 - (square - 2.0 * radius**2) / np.sqrt(square**2 - 4.0 * (tangent * radius) ** 2))


def field_image(*, has_diffraction: bool = False, **options: object) -> np.ndarray:
    """
    Return the image of a uniform plane far away, over its centre, by foveasim.

    Without diffraction: its effect is proportional to the wavelength, so that twice the image at one wavelength less the image
    at twice this wavelength is free of it.
    """
    scene = fs.Scene.flat(
        shape=(N_FIELD, N_FIELD),
        pitch_um=2e6 * FAR_M * FIELD_TANGENT / N_FIELD,
        distance_m=FAR_M,
        radiance_w_m2_sr_nm=1.0,
        wavelength_nm=[WAVELENGTH_NM, 2.0 * WAVELENGTH_NM],
        band_width_nm=1.0,
    )
    optics = fs.Optics(focal_length_mm=FOCAL_MM, f_number=FIELD_N, precision="double", padding="edge", **options)
    one, twice = optics.power_map(scene).data
    image = one if has_diffraction else 2.0 * one - twice
    return image / image[N_FIELD // 2, N_FIELD // 2]


def field_tangents() -> np.ndarray:
    """Return the tangents of the field angle at the cells of :func:`field_image`."""
    at = 2.0 * FIELD_TANGENT / N_FIELD * (np.arange(N_FIELD) - N_FIELD // 2)
    return np.hypot(at, at[:, np.newaxis])


def validate(section: Section, directory: Path) -> None:
    """Compare irradiance with closed forms, photons with astropy, and colours with colour-science."""
    compare_irradiance(section, directory)
    compare_photons(section)
    compare_colour(section)
    compare_solid_angles(section)
    compare_wide_angles(section)


def compare_irradiance(section: Section, directory: Path) -> None:
    """Irradiance on the axis, and over the field."""
    for lens, by in (("thin", "π L sin²α = π L/(1 + 4 N²)"), ("aplanatic", "π L sin²α = π L/(4 N²)")):
        section.compare(
            f"irradiance on the axis of the {lens} lens, f/0.95 to f/11, at 3 cm to 10 km",
            {OWN: lambda lens=lens: on_axis(lens)},
            cone_irradiance(lens),
            by=f"{by}, N on the image side",
            source=f"{BORN}, section 4.8",
            tolerance=1e-8,
            deviation=largest_relative,
            explanation="Planes of 9 x 9 pixels, over which the cos⁴ law varies by 3e-9.",
        )
    distance_mm = image_mm(FOCAL_MM, FAR_M)
    tangent, radius = field_tangents(), 0.5 * FOCAL_MM / FIELD_N / distance_mm
    exact = disc_irradiance(tangent, radius) / disc_irradiance(np.zeros(1), radius)
    law = (1.0 + tangent**2) ** -2
    with_diffraction = f"{OWN} with diffraction, 550 nm"
    section.compare(
        "relative illumination to 50°",
        {OWN: field_image, with_diffraction: lambda: field_image(has_diffraction=True)},
        law,
        by="cos⁴ θ",
        source=f"{BORN}, section 4.8",
        tolerance=1e-7,
        deviation=largest_relative,
        explanation=(
            "The wings of the PSF mix cells of different irradiance, in proportion to the wavelength; they are extrapolated to "
            "0 from 550 and 1100 nm. The thin lens of foveasim has the cos⁴ law by default, at every f-number."
        ),
    )
    found = section.compare(
        "relative illumination of a disc at f/1.4, to 50°",
        {
            OWN: lambda: field_image(exit_pupil_mm=distance_mm),
            "cos⁴ law (foveasim without exit pupil)": field_image,
        },
        exact,
        by="irradiance by a parallel disc, (π L/2)[1 - (1 + t² - r²)/√((1 + t² + r²)² - 4 t² r²)]",
        source="Howell, Catalog of Radiation Heat Transfer Configuration Factors, B-13",
        tolerance=2e-6,
        deviation=largest_relative,
        cannot={"cos⁴ law (foveasim without exit pupil)": "takes the cone for narrow"},
        explanation=(
            "The cos⁴ law is the limit of a small pupil. foveasim interpolates the closed form between 65 x 65 points by "
            "cubic splines."
        ),
    )
    row = N_FIELD // 2
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    values, error = figure.subplots(1, 2)
    degrees = np.degrees(np.arctan(2.0 * FIELD_TANGENT / N_FIELD * (np.arange(N_FIELD) - row)))
    values.plot(degrees, exact[row], color="black", lw=2.5, alpha=0.3, label="truth")
    for program, image in found.items():
        values.plot(degrees, image[row], lw=1.0, label=program)
        error.semilogy(degrees, np.abs(image / exact - 1.0)[row] + 1e-17, label=program)
    values.set(xlabel="field angle / °", ylabel="irradiance / centre")
    error.set(xlabel="field angle / °", ylabel="relative deviation", ylim=(1e-12, 1.0))
    error.legend(fontsize="small")
    section.draw("field", figure, "Irradiance over the field of a disc at f/1.4, and deviations from it.", directory)


def compare_photons(section: Section) -> None:
    """Photons of a photosite."""
    import astropy
    import astropy.units as u

    waves_nm = np.arange(400.0, 701.0, 50.0)
    layout = fs.layout.grid(n_x=1, n_y=1, pitch_um=3.0)
    n, exposure_s, radiance = 2.0, 0.01, 0.05
    area_m2 = 9e-12

    def own() -> np.ndarray:
        sensor = fs.Sensor(layout, qe=1.0)
        camera = fs.Camera(optics=fs.Optics(focal_length_mm=FOCAL_MM, f_number=n, precision="double"), sensor=sensor)
        found = []
        for wave_nm in waves_nm:
            scene = fs.Scene.flat(
                shape=(16, 16),
                pitch_um=100.0,
                distance_m=1e4,
                radiance_w_m2_sr_nm=radiance,
                wavelength_nm=[wave_nm],
                band_width_nm=1.0,
            ).with_pitch(1e6)
            found.append(exposure_s * camera.photoelectrons_per_s(scene).item())
        return np.array(found)

    w_m2 = math.pi * radiance / (1.0 + 4.0 * working_f_number(n, 1e4) ** 2)

    def by_astropy() -> np.ndarray:
        density = np.full(waves_nm.size, w_m2) * u.W / u.m**2 / u.nm
        photons = density.to(u.photon / u.s / u.m**2 / u.nm, u.spectral_density(waves_nm * u.nm))
        return (photons * u.nm * area_m2 * u.m**2 * exposure_s * u.s).value

    section.compare(
        "photons in a photosite, 400 to 700 nm",
        {OWN: own, f"astropy {astropy.__version__}": by_astropy},
        w_m2 * area_m2 * exposure_s * 1e-9 * waves_nm / (PLANCK_J_S * LIGHT_M_S),
        by="π L/(1 + 4 N²) · A t λ/(h c), exact constants of the SI",
        source="BIPM, The International System of Units (2019)",
        tolerance=1e-6,
        deviation=largest_relative,
        cannot={f"astropy {astropy.__version__}": "converts units; it has the closed form of the irradiance as input"},
        explanation=(
            "foveasim computes the complete chain, from a plane of 13 µm in the image to a sensor with a quantum efficiency of "
            "1; the cos⁴ law varies within this image."
        ),
    )


def compare_colour(section: Section) -> None:
    """Illuminants, luminance, and colours of patches."""
    import colour

    science = f"colour-science {version_of('colour-science')}"
    waves_nm = np.arange(380.0, 781.0, 5.0)

    def table(name: str, at_nm: np.ndarray) -> np.ndarray:
        stored = colour.SDS_ILLUMINANTS[name]
        return np.interp(at_nm, stored.wavelengths, stored.values) / np.interp(560.0, stored.wavelengths, stored.values)

    names = ("A", "D50", "D65")
    kelvin = {name: float(name[1:]) * 100.0 * 1.4388 / 1.438 for name in names[1:]}

    def by_science() -> np.ndarray:
        shape = colour.SpectralShape(380, 780, 5)
        found = [colour.sd_CIE_standard_illuminant_A(shape).values]
        for each in kelvin.values():
            xy = colour.temperature.CCT_to_xy_CIE_D(each)
            found.append(colour.sd_CIE_illuminant_D_series(xy).copy().align(shape).values)
        return np.array([each / each[waves_nm.tolist().index(560.0)] for each in found])

    section.compare(
        "illuminants A, D50 and D65, 380 to 780 nm in steps of 5 nm",
        {
            OWN: lambda: np.array([fs.scene.charts.illuminant(name, waves_nm) for name in names]),
            science: by_science,
        },
        np.array([table(name, waves_nm) for name in names]),
        by="tables of the CIE, relative to 560 nm",
        source="CIE 15:2004, tables T.1 and T.3, as stored by colour-science",
        tolerance=1e-4,
        explanation=(
            "The tables have six digits. Both programs have the formulas of the CIE, with weights of the components of "
            "daylight that are rounded to three decimals."
        ),
    )

    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(colour.SpectralShape(380, 780, 1))
    fine_nm, matching = observer.wavelengths, observer.values
    luminances = np.array([683.0 * (table(name, fine_nm) @ matching[:, 1]) for name in names])

    def own_luminance(step_nm: float) -> np.ndarray:
        at_nm = np.arange(380.0, 780.1, step_nm)
        return np.array(
            [
                fs.Scene(
                    np.ones((1, 1, 1)),
                    fs.scene.charts.illuminant(name, at_nm)[np.newaxis],
                    at_nm,
                    np.full(at_nm.size, step_nm),
                    1e3,
                    1.0,
                ).luminance_cd_m2.item()
                for name in names
            ]
        )

    def science_luminance() -> np.ndarray:
        shape = colour.SpectralShape(380, 780, 1)
        spectra = [colour.SpectralDistribution(table(name, fine_nm), shape.wavelengths) for name in names]
        return np.array([colour.sd_to_XYZ(each, observer, k=683.0, method="Integration")[1] for each in spectra])

    section.compare(
        "luminance of A, D50 and D65 with radiance 1 W/(m² sr nm) at 560 nm",
        {
            OWN: lambda: own_luminance(5.0),
            f"{OWN}, bands of 10 nm": lambda: own_luminance(10.0),
            science: science_luminance,
        },
        luminances,
        by="683 lm/W Σ L V Δλ in steps of 1 nm",
        source="CIE 15:2004, observer of 1931 as stored by colour-science",
        tolerance=2e-4,
        deviation=largest_relative,
        cannot={science: "its tables and its sum are those of the truth"},
        explanation="The table of foveasim has steps of 5 nm and four digits; bands are those of the scene.",
    )

    patches = colour.SDS_COLOURCHECKERS["ColorChecker N Ohta"]
    reflectances = np.array([CubicSpline(sd.wavelengths, sd.values)(fine_nm) for sd in patches.values()])

    def truth(name: str) -> np.ndarray:
        light = table(name, fine_nm)
        white = light @ matching
        srgb_xyz, srgb_white = srgb_primaries()
        bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
        adapt = np.linalg.inv(bradford) @ np.diag((bradford @ srgb_white) / (bradford @ white)) @ bradford
        return (reflectances * light) @ matching @ adapt.T @ np.linalg.inv(srgb_xyz).T

    def own_colours(name: str) -> np.ndarray:
        return patch_colours(fs.scene.charts.illuminant(name, waves_nm), waves_nm, np.full(waves_nm.size, 5.0))

    def science_colours(name: str) -> np.ndarray:
        light = colour.SDS_ILLUMINANTS[name]
        white = colour.sd_to_XYZ(colour.sd_ones(), illuminant=light)
        xy = colour.XYZ_to_xy(white)
        xyz = np.array([colour.sd_to_XYZ(sd, illuminant=light) for sd in patches.values()]) / white[1]
        return colour.XYZ_to_sRGB(
            xyz, illuminant=xy, chromatic_adaptation_transform="Bradford", apply_cctf_encoding=False
        )

    for name in ("D65", "A"):
        section.compare(
            f"linear sRGB of 24 patches under illuminant {name}",
            {OWN: lambda name=name: own_colours(name), science: lambda name=name: science_colours(name)},
            truth(name),
            by="sums in steps of 1 nm, spline of the reflectances, matrix of the primaries, Bradford adaptation",
            source="CIE 15:2004; IEC 61966-2-1; Lam (1985); reflectances of Ohta (1997)",
            tolerance=2e-3,
            deviation=largest_absolute,
            of="of white",
            explanation=(
                "foveasim has every second value of the reflectances, interpolates linearly between steps of 10 nm, and sums "
                "here in steps of 5 nm. colour-science has the rounded matrix of IEC 61966-2-1, and Sprague's interpolation."
            ),
        )


def srgb_primaries() -> tuple[np.ndarray, np.ndarray]:
    """Return the tristimulus values of linear sRGB, one primary per column, and of its white."""
    xy = np.array([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], [0.3127, 0.3290]])
    xyz = np.column_stack((xy, 1.0 - xy.sum(axis=1))) / xy[:, 1:]
    return xyz[:3].T * np.linalg.solve(xyz[:3].T, xyz[3]), xyz[3]


def rectangle_sr(edges: np.ndarray) -> np.ndarray:
    """
    Return the solid angles of the rectangles of a grid at distance 1, from the differences of those of their corners.

    The rectangle from the axis to (x, y) has atan(x y / sqrt(1 + x² + y²)).
    """
    x, y = edges, edges[:, np.newaxis]
    return np.diff(np.diff(np.arctan(x * y / np.sqrt(1.0 + x**2 + y**2)), axis=0), axis=1)


def uniform_panorama() -> fs.Scene:
    """Return a panorama of radiance 1."""
    return fs.Scene.from_panorama(
        np.ones((16, 32)), peak_radiance_w_m2_sr_nm=1.0, encoding="linear", cells=1024, **BAND
    )


def pixel_angles() -> np.ndarray:
    """Return the light of square photosites over radiance and pupil area, by foveasim."""
    pitch_um = 2.0 * PIXELS_TANGENT / N_PIXELS * 1e3 * FOCAL_MM
    sensor = fs.Sensor(fs.layout.grid(n_x=N_PIXELS, n_y=N_PIXELS, pitch_um=pitch_um), qe=1.0)
    optics = fs.Optics(
        focal_length_mm=FOCAL_MM,
        f_number=FIELD_N,
        lens="aplanatic",
        projection="rectilinear",
        pupil_tilt="turning",
        precision="double",
    )
    rate = fs.Camera(optics=optics, sensor=sensor, order=2).photoelectrons_per_s(uniform_panorama())
    per_w = 1e-9 * WAVELENGTH_NM / (PLANCK_J_S * LIGHT_M_S)
    pupil_m2 = math.pi * (0.5e-3 * FOCAL_MM / FIELD_N) ** 2
    return (rate / (per_w * pupil_m2)).reshape(N_PIXELS, N_PIXELS)


def pyfai_angles() -> np.ndarray:
    """Return solid angles of square pixels, by pyFAI."""
    import pyFAI.integrator.azimuthal
    from pyFAI.detectors import Detector

    pitch_m = 2.0 * PIXELS_TANGENT / N_PIXELS
    detector = Detector(pixel1=pitch_m, pixel2=pitch_m, max_shape=(N_PIXELS, N_PIXELS))
    integrator = pyFAI.integrator.azimuthal.AzimuthalIntegrator(
        dist=1.0, poni1=PIXELS_TANGENT, poni2=PIXELS_TANGENT, detector=detector
    )
    return np.asarray(integrator.solidAngleArray((N_PIXELS, N_PIXELS), absolute=True))


def compare_solid_angles(section: Section) -> None:
    """Light of pixels from a uniform sphere."""
    pyfai = f"pyFAI {version_of('pyFAI')}"
    edges = PIXELS_TANGENT * np.linspace(-1.0, 1.0, N_PIXELS + 1)
    section.compare(
        "light of 20 x 20 pixels of a field of 90° from a uniform sphere",
        {OWN: pixel_angles, pyfai: pyfai_angles},
        rectangle_sr(edges),
        by="solid angle of a rectangle, Σ ± atan(x y/√(1 + x² + y²))",
        source="closed form of a rectangle",
        tolerance=1e-4,
        deviation=largest,
        cannot={pyfai: "takes cos³ at the centre of a pixel; flat detectors only, thus fields below 180°"},
        explanation="foveasim includes diffraction, which moves light between pixels, in proportion to the f-number.",
    )


def sector_light(layout: fs.Layout, tilt: str) -> np.ndarray:
    """
    Return the light of sites behind an equidistant lens from a uniform sphere, over radiance and pupil area, sr.

    From the axis to the angle θ, a sector has 1 - cos θ per azimuth, or sin²θ/2 behind a flat pupil, constant beyond 90°. The
    light of a site is the integral of this function over the azimuth, along its outline, by 24 Gauss nodes on each edge.
    """
    node, weight = leggauss(24)
    found = np.zeros(layout.n_sites)
    for site, a in enumerate(np.split(layout.xy_um / WIDE_FOCAL_UM, layout.ring_offsets[1:-1])):
        along = (np.roll(a, -1, axis=0) - a)[:, np.newaxis]
        at = a[:, np.newaxis] + (0.5 + 0.5 * node)[:, np.newaxis] * along
        theta = np.hypot(at[..., 0], at[..., 1])
        per_azimuth = 1.0 - np.cos(theta) if tilt == "turning" else 0.5 * np.sin(np.minimum(theta, 0.5 * np.pi)) ** 2
        turn = (at[..., 0] * along[..., 1] - at[..., 1] * along[..., 0]) / theta**2
        found[site] = (per_azimuth * turn * 0.5 * weight).sum()
    return found


def compare_wide_angles(section: Section) -> None:
    """Light of sectors beyond 90° from a uniform sphere."""
    radius_um = WIDE_FOCAL_UM * np.radians(WIDE_DEG)
    layout = fs.layout.log_polar(n_sectors=48, r_min_um=0.15 * radius_um, r_max_um=radius_um)
    per_w = 1e-9 * WAVELENGTH_NM / (PLANCK_J_S * LIGHT_M_S)

    def own(tilt: str) -> np.ndarray:
        optics = fs.Optics(
            focal_length_mm=1e-3 * WIDE_FOCAL_UM,
            f_number=FIELD_N,
            lens="aplanatic",
            projection="equidistant",
            pupil_tilt=tilt,
            precision="double",
        )
        lens = fs.distortion.Fisheye(projection="equidistant", focal_um=WIDE_FOCAL_UM)
        camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout, qe=1.0), distortion=lens, order=2)
        pupil_m2 = math.pi * (0.5e-6 * WIDE_FOCAL_UM / FIELD_N) ** 2
        return camera.photoelectrons_per_s(uniform_panorama()) / (per_w * pupil_m2)

    for tilt, by in (("turning", "1 - cos θ"), ("flat", "sin²θ/2 up to 90°")):
        section.compare(
            f"light of {layout.n_sites} sectors from a uniform sphere, to {WIDE_DEG:g}°, {tilt} pupil",
            {OWN: lambda tilt=tilt: own(tilt)},
            sector_light(layout, tilt),
            by=f"∮ ({by}) dφ along the outline",
            source="solid angle of sectors, Green's theorem",
            tolerance=1e-4,
            deviation=largest,
            explanation="The PSF at f/1.4 moves light between sectors. None of the other programs here has light beyond 90°.",
        )
