"""
Published measurements, counts and claims, repeated with foveasim.

The truth of a row is a printed value. Deviations are given in units of its rounding, half of its last digit, where nothing
else limits the comparison; a model that is known to differ has a wider tolerance and says why. Values that are printed in a
data sheet follow there from others with rounding of their own, so these rows have a tolerance of 1.2 %. Lengths that a source
does not print are assumptions of the bundled layouts. Times of other programs are those that the paper prints, on its authors'
computer, and cannot be repeated here: ISET and the simulator of the paper run in MATLAB.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from records import ERRORS, OWN, Section, in_errors, largest, largest_absolute, largest_relative
from scipy.optimize import brentq
from scipy.special import ndtr
from scipy.stats import qmc

import foveasim as fs
from foveasim.config import read_any_layout, read_shot

ROOT = Path(__file__).parents[1]
PAPER = "From the radiance reflected by a scene to a digital picture: a compact model based simulator for image sensor design"
PAPER_PROGRAM, ISET = "simulator of the paper, MATLAB", "ISET, MATLAB"


def of_rounding(printed: str) -> Callable[[Any, Any], float]:
    """Return the deviation from a printed number, in units of half its last digit."""
    decimals = len(printed.partition(".")[2])
    return lambda found, truth: float(np.abs(np.asarray(found) - truth).max() / (0.5 * 10.0**-decimals))


def number(found: Any, truth: Any) -> float:
    """Return the number itself, for times, of which less is better."""
    del truth
    return float(found)


def compare_printed(
    section: Section,
    what: str,
    printed: str,
    call: Callable[[], float],
    source: str,
    *,
    tolerance: float = 1.0,
    explanation: str = "",
) -> None:
    """Compare a number with a printed one."""
    section.compare(
        f"{what}: {printed}",
        {OWN: call},
        float(printed),
        by="printed value",
        source=source,
        tolerance=tolerance,
        deviation=of_rounding(printed),
        of="of the rounding",
        explanation=explanation,
        repeats=0,
    )


# -- geometry ----------------------------------------------------------------------------------------------------------


def compare_geometry(section: Section) -> None:
    """Compare counts and sizes of published sensors."""

    def hexagonal_saving_percent() -> float:
        squares, hexagons = fs.layout.grid(20, 20, 5.0), fs.layout.hexagonal(20, 20, 5.0)
        inner = [np.nanmedian(fs.metrics.nyquist_per_mm(layout)) for layout in (squares, hexagons)]
        # Sites per area at the same band limit: densities scale as its square.
        per_um2 = [limit**-2 / layout.area_um2[0] for limit, layout in zip(inner, (squares, hexagons), strict=True)]
        return float(100.0 * (1.0 - per_um2[1] / per_um2[0]))

    compare_printed(
        section,
        "samples that a hexagonal lattice saves for a circular band, percent",
        "13.4",
        hexagonal_saving_percent,
        "Mersereau, Proc. IEEE 67, 930 (1979)",
    )
    giotto = "github.com/robotology/icub-main, src/libraries/logPolar"
    sensors = {
        name: read_any_layout(name).layout for name in ("giotto_2", "ibidem", "log_polar_ccd", "prima_100", "pixirad_1")
    }
    ring = sensors["giotto_2"].columns["ring"]
    outer = sensors["giotto_2"][ring == ring.max()]
    radius = np.hypot(*outer.xy_um.T) / 6.45
    ccd = sensors["log_polar_ccd"]
    ccd_size_um = [2.0 * np.pi * np.hypot(*ccd.centroid_um[ccd.columns["ring"] == k].T).mean() / 64 for k in (0, 29)]
    pixirad = sensors["pixirad_1"]
    rows_um = np.diff(np.unique(np.round(pixirad.centroid_um[:, 1], 6)))
    trial = "PRIMA, PubMed Central PMC7384969, with the width of 85 µm of such pixels"
    spatial = "PubMed Central PMC4826388; manufacturer's number of pixels"
    ccd_page = "LIRA-Lab, University of Genova, page on the CCD log-polar sensor"
    for what, printed, found, source in (
        ("Giotto 2: sites of the fovea", "5167", np.count_nonzero(ring < 42), giotto),
        ("Giotto 2: log-polar sites", "27720", np.count_nonzero(ring >= 42), giotto),
        ("Giotto 2: radius in smallest pixels", "545", radius.max(), giotto),
        ("IBIDEM: sites", "8192", sensors["ibidem"].n_sites, "University of Genova, IBIDEM project page"),
        ("log-polar CCD: sites", "1920", ccd.n_sites, ccd_page),
        ("log-polar CCD: size on the inner circle, µm", "30", ccd_size_um[0], ccd_page),
        ("log-polar CCD: size on the outer circle, µm", "412", ccd_size_um[1], ccd_page),
        ("PRIMA: pixels", "378", sensors["prima_100"].n_sites, trial),
        ("PRIMA: fill factor", "0.7225", sensors["prima_100"].area_um2[0] / (0.5 * math.sqrt(3.0) * 100.0**2), trial),
        ("Pixirad-1: pixels", "243712", pixirad.n_sites, spatial),
        ("Pixirad-1: distance of rows, µm", "51.96", rows_um.mean(), spatial),
        (
            "data rate of 2592 × 1944 pixels, 10 bits, 30 frames/s, 20 % blanking, Gbit/s",
            "1.814",
            fs.layout.Readout(frames_per_s=30.0, bits=10, blanking=0.2).gbit_per_s(2592 * 1944),
            "product of the numbers",
        ),
    ):
        compare_printed(section, what, printed, lambda found=found: float(found), source)
    compare_fovi(section)


def compare_fovi(section: Section) -> None:
    """Compare the numbers of sites of rings with the rule of FOVI."""
    fov_um, a_um, n_rings = 1000.0, 20.0, 60
    w = [math.log(a_um) + k * (math.log(0.5 * fov_um + a_um) - math.log(a_um)) / n_rings for k in range(n_rings + 2)]
    radius = [math.exp(each) - a_um for each in w]
    counts = [1] + [
        math.ceil(4.0 * math.pi * radius[k] / (radius[k + 1] - radius[k - 1])) for k in range(1, n_rings + 1)
    ]
    layout = fs.layout.fovi(fov_um, a_um=a_um, n_rings=n_rings)
    section.compare(
        f"sites of the {n_rings} isotropic rings of FOVI, {sum(counts):,} in total",
        {OWN: lambda: np.bincount(layout.columns["ring"])},
        np.array(counts),
        by="⌈2π r/Δr⌉ on radii that are even in ln(r + a)",
        source="rule of the Python package fovi",
        tolerance=0.0,
        deviation=largest_absolute,
        of="sites",
        repeats=0,
    )


# -- the paper ---------------------------------------------------------------------------------------------------------


def compare_paper(section: Section) -> None:
    """Compare counts, noise and times with those of the paper."""
    zones = read_any_layout("four_zones").layout
    sides = (64, 128, 256, 512)
    inner = (0, *sides[:-1])
    by_zone = [(side**2 - hole**2) // pitch**2 for side, hole, pitch in zip(sides, inner, (1, 2, 4, 8), strict=True)]
    section.compare(
        f"Fig. 14, four zones whose pitch doubles: {sum(by_zone):,} sites instead of {sides[-1] ** 2:,}",
        {OWN: lambda: np.array([np.count_nonzero(np.isclose(zones.size_um, size)) for size in (4.0, 8.0, 16.0, 32.0)])},
        np.array(by_zone),
        by="areas of the zones over those of their pixels",
        source=PAPER,
        tolerance=0.0,
        deviation=largest_absolute,
        of="sites in a zone",
        explanation="The paper prints neither the sides nor the number; these are the sides of the bundled layout.",
        repeats=0,
    )
    blind = read_any_layout("foveal_blind_spot").layout
    first = blind[blind.columns["ring"] == 0]
    corner_um = np.hypot(*first.xy_um.T)
    section.compare(
        "Fig. 13, radius of the blind spot of pixels of at least 2 µm on 192 sectors",
        {OWN: lambda: 0.5 * (corner_um.min() + corner_um.max())},
        2.0 / (2.0 * math.sin(math.pi / 192)),
        by="p/(2 sin π/n), where the arc is one pixel",
        source=PAPER,
        tolerance=1e-3,
        deviation=largest_relative,
        explanation="The paper prints neither counts nor radii; these are those of the bundled layout.",
        repeats=0,
    )
    compare_read_noise(section)
    compare_times(section)


def compare_read_noise(section: Section) -> None:
    """Compare the SNR of Fig. 9: 6,000 electrons, a full well of 7,000 and three read noises."""
    mean_e, well_e, reads_e, n = 6000.0, 7000.0, (0.0, 50.0, 200.0), 40_000
    layout = fs.layout.grid(200, 200, 2.2)

    def snr() -> np.ndarray:
        found = []
        for k, read_e in enumerate(reads_e):
            sensor = fs.Sensor(
                layout,
                read_noise_e=read_e,
                capacitance_f=well_e * fs.units.ELEMENTARY_CHARGE_C / 3.0,
                v_sat_v=3.0,
                bits=16,
            )
            code = np.asarray(fs.metrics.draw_frames(sensor, np.full(n, mean_e), n_frames=1, seed=k), np.float64)
            found.append(code.mean() / code.std())
        return np.array(found)

    # Sites at the full well are cut: moments of a normal distribution with an upper limit.
    sd = np.sqrt(mean_e + np.square(reads_e))
    z = (well_e - mean_e) / sd
    density = np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    mean = mean_e - sd * (density - z * ndtr(-z))
    square = ndtr(z) * (mean_e**2 + sd**2) - sd * density * (mean_e + well_e) + well_e**2 * ndtr(-z)
    truth = mean / np.sqrt(square - mean**2)
    section.compare(
        "Fig. 9, SNR at 6,000 electrons and a full well of 7,000 with read noises of 0, 50 and 200 e-",
        {OWN: snr},
        truth,
        by="μ/√(μ + σ²), cut at the full well",
        source=f"{PAPER}, Fig. 9, for the numbers",
        tolerance=4.0,
        deviation=in_errors(truth / math.sqrt(2.0 * n)),
        of=ERRORS,
        repeats=0,
    )


def seconds_of(call: Callable[[], Any]) -> float:
    """Return the time of one call."""
    start_s = time.perf_counter()
    call()
    return time.perf_counter() - start_s


def compare_times(section: Section) -> None:
    """Compare times of frames with those that the paper prints."""
    rng = np.random.default_rng(0)
    zones = read_any_layout("four_zones").layout
    scene = fs.Scene.from_picture(
        rng.random((1024, 1024)).astype(np.float32),
        pitch_um=260.0,
        distance_m=1.0,
        peak_radiance_w_m2_sr_nm=0.01,
        wavelength_nm=(550.0,),
        band_width_nm=100.0,
    )

    def zone_camera() -> fs.Camera:
        sensor = fs.Sensor(
            zones, qe=fs.SiliconQE(depth_um=3.0), capacitance_f=4e-16 * zones.area_um2, read_noise_e=2.0, bits=8
        )
        return fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)

    def capture_zones() -> Any:
        return zone_camera().capture(scene, exposure_s=1.0 / 30.0, seed=1)

    capture_zones()
    section.compare(
        "Fig. 14, time of a frame of four zones from a picture of 1024 × 1024 pixels",
        {
            OWN: lambda: min(seconds_of(capture_zones) for _ in range(3)),
            PAPER_PROGRAM: lambda: 0.3,
            ISET: lambda: 20.0,
        },
        0.0,
        by="time of the paper",
        source=f"{PAPER}, Applications and prospects",
        tolerance=0.3,
        deviation=number,
        of="s",
        cannot={ISET: "optics and sensor with square pixels"},
        explanation=(
            "The paper prints neither the size of the picture nor the computer of this run. The time contains all preparations "
            "of a new camera."
        ),
        repeats=0,
    )
    largest_scene = fs.Scene.from_picture(
        rng.random((4640, 8256), dtype=np.float32),
        pitch_um=65.0,
        distance_m=1.0,
        peak_radiance_w_m2_sr_nm=0.01,
        wavelength_nm=(550.0,),
        band_width_nm=100.0,
    )
    foveal = fs.layout.log_polar(240, n_rings=126, r_min_um=31.0, r_max_um=1190.0)

    def capture_foveal() -> Any:
        sensor = fs.Sensor(foveal, qe=fs.SiliconQE(depth_um=3.0), capacitance_f=4e-16 * foveal.area_um2, bits=8)
        camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
        return camera.capture(largest_scene, exposure_s=1.0 / 30.0, seed=1)

    section.compare(
        f"time of a frame of {foveal.n_sites:,} log-polar sites from the largest picture of the paper, 4640 × 8256 pixels",
        {OWN: lambda: min(seconds_of(capture_foveal) for _ in range(3)), PAPER_PROGRAM: lambda: 5.0},
        0.0,
        by="time of the paper",
        source=f"{PAPER}, Applications and prospects",
        tolerance=5.0,
        deviation=number,
        of="s",
        cannot={PAPER_PROGRAM: "less than a few seconds, which counts as 5 here"},
        repeats=0,
    )
    shot = read_shot(ROOT / "gallery" / "mobius_distortion.yaml")

    def capture_distorted() -> Any:
        return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=1)

    first_s = seconds_of(capture_distorted)
    section.compare(
        "time of a frame with distortion, from a picture of 4640 × 8256 pixels: the first one",
        {OWN: lambda: first_s, PAPER_PROGRAM: lambda: 360.0},
        0.0,
        by="time of the paper, up to about 6 minutes",
        source=f"{PAPER}, Applications and prospects",
        tolerance=360.0,
        deviation=number,
        of="s",
        explanation="Once for a camera, 1.27 million outlines are undistorted, and the integration is prepared.",
        repeats=0,
    )
    section.compare(
        "the same: each further frame",
        {OWN: lambda: seconds_of(capture_distorted), PAPER_PROGRAM: lambda: 360.0},
        0.0,
        by="time of the paper, up to about 6 minutes",
        source=f"{PAPER}, Applications and prospects",
        tolerance=360.0,
        deviation=number,
        of="s",
        repeats=0,
    )


# -- sampling ----------------------------------------------------------------------------------------------------------


def compare_sampling(section: Section, directory: Path) -> None:
    """Compare aliasing of a square lattice and of Poisson-disc points."""
    yellott = "Yellott, Science 221, 382 (1983)"
    pitch_um, n_side = 5.0, 64
    side_um = pitch_um * n_side
    # Radius of the discs for the density of the lattice: 0.7 of the points of the closest packing are found.
    points = qmc.PoissonDisk(2, radius=0.82 / n_side, rng=np.random.default_rng(1)).fill_space()
    points_um = side_um * (points - 0.5)
    # Tiny apertures: only the positions count.
    tiny_um = 0.5
    disc = fs.Layout.from_rectangles(points_um, tiny_um)
    square = fs.layout.grid(n_side, n_side, pitch_um, width_um=tiny_um)
    radius_um, max_per_mm = 0.5 * side_um, 1600.0

    def spectrum_of(layout: fs.Layout) -> fs.metrics.SamplingSpectrum:
        return fs.metrics.sampling_spectrum(layout, centre_um=(0.0, 0.0), radius_um=radius_um, max_per_mm=max_per_mm)

    spectrum = spectrum_of(disc)
    r_um = np.hypot(*points_um.T)
    inside, weight = r_um < radius_um, np.cos(0.5 * np.pi * np.minimum(r_um / radius_um, 1.0)) ** 2
    wave = np.exp(
        -2e-3j * np.pi * spectrum.frequency_per_mm[:, np.newaxis, np.newaxis] * points_um[inside].T[np.newaxis]
    )
    sums = (weight[inside] * wave[:, 1]) @ wave[:, 0].T
    section.compare(
        f"power spectrum of {np.count_nonzero(inside):,} Poisson-disc points at {spectrum.power.size:,} frequencies",
        {OWN: lambda: spectrum_of(disc).power},
        np.abs(sums) ** 2 / np.square(weight[inside]).sum(),
        by="sum over all points at each frequency",
        source=yellott,
        tolerance=1e-6,
        repeats=1,
    )
    distance = np.hypot(*np.meshgrid(spectrum.frequency_per_mm, spectrum.frequency_per_mm))
    far = (distance > 1000.0) & (distance < 1600.0)
    # Speckle of a complex Gaussian number: 1/step² frequencies have as many independent ones as their area has windows of
    # the transform; a real field has half of them.
    step_per_um = 1e-3 * (spectrum.frequency_per_mm[1] - spectrum.frequency_per_mm[0])
    window_um2 = (weight[inside] ** 2).sum() ** 2 / (weight[inside] ** 4).sum() * side_um**2 / len(points)
    error = math.sqrt(2.0 / (np.count_nonzero(far) * step_per_um**2 * window_um2))
    section.compare(
        "mean power of Poisson-disc points at high frequencies: noise, as that of random points",
        {OWN: spectrum.power[far].mean},
        1.0,
        by="1, no peaks",
        source=yellott,
        tolerance=4.0,
        deviation=in_errors(error),
        of=ERRORS,
        repeats=0,
    )
    wave_per_mm = (140.0, 0.0)
    regular = fs.metrics.aliasing_spectrum(square, wave_per_mm, centre_um=(0.0, 0.0), radius_um=radius_um)
    irregular = fs.metrics.aliasing_spectrum(disc, wave_per_mm, centre_um=(0.0, 0.0), radius_um=radius_um)
    section.compare(
        "contrast of the moiré of a wave at 1.4 times the Nyquist frequency, square lattice",
        {OWN: lambda: np.array([regular.alias_fraction, 1e-2 * abs(regular.alias_per_mm[0])])},
        np.array([np.sinc(1e-3 * tiny_um * wave_per_mm[0]), 0.6]),
        by="MTF of the aperture, at |f − 1/p|",
        source=yellott,
        tolerance=1e-4,
        deviation=largest,
        explanation="The window of the analysed disc shifts the peak and its height.",
        repeats=0,
    )
    # The largest of M squares of complex Gaussian numbers exceeds its mean times ln(1000 M) once in 1,000 cases.
    n_free = math.pi * (1e-3 * irregular.nyquist_per_mm) ** 2 * window_um2
    mean_square = np.square(weight[inside]).sum() / weight[inside].sum() ** 2
    bound = math.sqrt(mean_square * math.log(1000.0 * n_free))
    section.compare(
        "the same wave, Poisson-disc points: contrast of the strongest alias",
        {OWN: lambda: irregular.alias_fraction},
        0.0,
        by="0: no moiré, only noise",
        source=yellott,
        tolerance=bound,
        deviation=largest_absolute,
        of="of the contrast of the wave",
        explanation="Tolerance: the largest amplitude of white noise of as many points, in 99.9 % of cases.",
        repeats=0,
    )
    draw_spectra(section, directory, spectrum, spectrum_of(square))


def draw_spectra(
    section: Section, directory: Path, disc: fs.metrics.SamplingSpectrum, square: fs.metrics.SamplingSpectrum
) -> None:
    """Draw the power spectra of both sets of points."""
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    for axes, (title, spectrum) in zip(
        figure.subplots(1, 2), (("square lattice", square), ("Poisson-disc points", disc)), strict=True
    ):
        end = np.abs(spectrum.frequency_per_mm) < 620.0
        extent = 2 * (*spectrum.frequency_per_mm[end][[0, -1]],)
        axes.imshow(spectrum.power[np.ix_(end, end)], extent=extent, vmin=0.0, vmax=4.0, cmap="gray_r", rasterized=True)
        axes.set(title=title, xlabel="frequency / (1/mm)")
    section.draw(
        "yellott",
        figure,
        "Power spectra of sampling points: peaks of a lattice, which cause moiré; noise of Poisson-disc points, outside an "
        "empty disc.",
        directory,
    )


# -- measurements ------------------------------------------------------------------------------------------------------


def compare_pixirad(section: Section) -> None:
    """Compare the MTF of hexagons and a Gaussian cloud with that measured at Pixirad-1."""
    source = "PubMed Central PMC4826388, Pixirad-1: hexagons with a pitch of 60 µm"
    hexagon = fs.layout.hexagonal(1, 1, 60.0)
    #: Directions along the apothem (x) and across, and the widths of the cloud that fit both modulations.
    spread_um = {0.0: 20.2, 90.0: 23.2}

    def mtf(per_mm: float, angle_deg: float) -> float:
        aperture = float(fs.metrics.polygon_mtf(hexagon, per_mm, angle_deg=angle_deg)[0, 0])
        return aperture * math.exp(-2.0 * (math.pi * 1e-3 * per_mm * spread_um[angle_deg]) ** 2)

    fitted = (
        "The widths of the cloud, 20.2 µm along and 23.2 µm across, are fitted to this modulation and the next. Their rounding "
        "to 0.1 µm changes it by up to 0.001."
    )
    predicted = (
        "This frequency and the next are predicted from the widths; the tolerance is for a cloud that is no Gaussian. The MTF "
        "of the bare hexagon is equal in both directions to 0.0014; what causes the two widths is open."
    )
    for what, angle_deg, per_mm, printed in (
        ("along the apothem", 0.0, 8.33, "0.397"),
        ("across", 90.0, 9.62, "0.228"),
    ):
        compare_printed(
            section,
            f"Pixirad-1, MTF {what} at {per_mm}/mm",
            printed,
            lambda f=per_mm, a=angle_deg: mtf(f, a),
            source,
            tolerance=3.0,
            explanation=fitted if angle_deg == 0.0 else "",
        )
    for what, angle_deg, printed in (("along the apothem", 0.0, "13.3"), ("across", 90.0, "12.0")):
        section.compare(
            f"Pixirad-1, frequency with an MTF of 10 % {what}: {printed}/mm",
            {OWN: lambda a=angle_deg: brentq(lambda f: mtf(f, a) - 0.1, 5.0, 20.0)},
            float(printed),
            by="measurement",
            source=source,
            tolerance=0.035,
            deviation=largest_relative,
            explanation=predicted if angle_deg == 0.0 else "",
            repeats=0,
        )


def measured(sensor: fs.Sensor, saturation_e: float) -> fs.metrics.Emva1288:
    """Return the EMVA 1288 parameters of simulated frames, with levels each 0.5 % next to the saturation."""
    exposure_s = 1e-4
    signals_e = saturation_e * np.concatenate((np.linspace(0.05, 0.9, 18), np.linspace(0.92, 1.05, 27)))

    def frames(signal_e: float, n_frames: int, seed: int) -> Any:
        expected_e = sensor.expected_electrons(np.full(sensor.layout.n_sites, signal_e / exposure_s), exposure_s)
        return fs.metrics.draw_frames(sensor, expected_e, n_frames=n_frames, seed=seed, exposure_s=exposure_s)

    light = [frames(each, 16 if each > 0.9 * saturation_e else 4, k) for k, each in enumerate(signals_e)]
    return fs.metrics.emva1288(light, [frames(0.0, 16, 999)], signals_e / float(sensor.qe))


def compare_sheets(section: Section) -> None:
    """Compare measurements of simulated sensors with data sheets, of which the sensors know a few values only."""
    given = ("title", "pixel_um", "bits", "qe_percent", "gain_dn_per_e", "dark_noise_e", "saturation_e")
    limits = (
        "In this and the next sheets, values in decibels are compared as ratios, which their rounding changes by up to 0.6 %. "
        "The variance is flat at saturation: at the next level, 0.5 % lower, it differs by 1e-4 of itself."
    )
    values = {
        "saturation_e": lambda found: found.saturation_e[0],
        "saturation_ph": lambda found: found.saturation_ph[0],
        "threshold_e": lambda found: found.threshold_e[0],
        "threshold_ph": lambda found: found.threshold_ph[0],
        "snr_max_db": lambda found: 10.0 ** (found.snr_max_db[0] / 20.0),
        "dynamic_range_db": lambda found: 10.0 ** (found.dynamic_range_db[0] / 20.0),
    }
    for name, title in (
        ("imx900_low_gain", "Sony IMX900, low gain"),
        ("imx900_high_gain", "Sony IMX900, high gain"),
        ("imx250", "FLIR BFS-U3-51S5M-C"),
    ):
        printed = fs.sensor.PRESETS[name].sheet
        checked = [each for each in values if getattr(printed, each) is not None]
        sheet = fs.sensor.DataSheet(**{each: getattr(printed, each) for each in given})
        sensor = fs.Sensor.from_datasheet(fs.layout.grid(200, 200, float(sheet.pixel_um)), sheet)
        truth = [float(getattr(printed, each)) for each in checked]
        truth = [
            10.0 ** (value / 20.0) if each.endswith("_db") else value
            for each, value in zip(checked, truth, strict=True)
        ]
        words = [each.rpartition("_")[0].replace("_", " ") for each in checked]
        found = measured(sensor, sheet.value("saturation_e"))
        result = np.array([values[each](found) for each in checked])
        section.compare(
            f"EMVA 1288 of {title}: {', '.join(dict.fromkeys(words)).replace('snr max', 'maximum SNR')}",
            {OWN: result.copy},
            np.array(truth),
            by="printed values, of which the sensor has quantum efficiency, gain, dark noise and saturation in electrons",
            source=printed.source,
            tolerance=0.012,
            deviation=largest_relative,
            explanation=limits if name == "imx900_low_gain" else "",
            repeats=0,
        )


def compare_events(section: Section) -> None:
    """Compare S-curves of arrays with published thresholds."""
    layout = fs.layout.grid(128, 128, 40.0)
    for seed, (what, threshold, spread, source) in enumerate(
        (
            (
                "DVS128, 2.1 % of mismatch (at a threshold of 20 %)",
                math.log(1.2),
                0.021,
                "Lichtsteiner, Posch and Delbruck, IEEE J. Solid-State Circuits 43, 566 (2008)",
            ),
            (
                "IMX636, threshold of 0.15 and mismatch of 0.00651",
                0.15,
                0.00651,
                "Root, Mujo and Xu, Noise2Params, arXiv:2605.16317",
            ),
        )
    ):
        sensor = fs.Sensor(layout, device_seed=seed)
        pixels = fs.modes.EventPixels(
            sensor,
            contrast_on=threshold,
            contrast_off=threshold,
            mismatch_fraction=spread / threshold,
            floor_e_per_s=0.0,
        )
        steps = threshold + spread * np.linspace(-2.0, 2.0, 9)

        def fractions(pixels: fs.modes.EventPixels = pixels, steps: np.ndarray = steps) -> np.ndarray:
            dark = np.full(layout.n_sites, 1e4)
            found = [pixels.events([dark, dark * math.exp(step)], frame_s=1e-3, seed=1).site for step in steps]
            return np.array([np.unique(site).size / layout.n_sites for site in found])

        truth = ndtr((steps - threshold) / spread)
        section.compare(
            f"S-curve of an array of {layout.n_sites:,} event pixels: {what}",
            {OWN: fractions},
            truth,
            by="normal distribution with the published width",
            source=source,
            tolerance=4.0,
            deviation=in_errors(np.sqrt(truth * (1.0 - truth) / layout.n_sites)),
            of=ERRORS,
            repeats=1,
        )


def validate(section: Section, directory: Path) -> None:
    """Compare geometry, figures and times of the paper, sampling, and measurements."""
    compare_geometry(section)
    compare_paper(section)
    compare_sampling(section, directory)
    compare_pixirad(section)
    compare_sheets(section)
    compare_events(section)
