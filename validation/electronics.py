"""
Shot noise, full well, reset and read noise, quantisation, and the parameters of EMVA 1288.

Drawn numbers are compared in standard errors of the expected scatter, which has closed forms; 4 of them are exceeded once in
16,000 numbers. NumPy and GalSim draw exact Poisson numbers; foveasim does so up to an expectation of 100 electrons, and above
it draws numbers with the first three moments of the Poisson distribution. Predictions have no scatter: they are compared with
sums over all charges and codes. The last rows analyse frames of a simulated camera by emva1288, the reference implementation of
the standard, and by foveasim.metrics.emva1288, against the parameters of the camera.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from records import ERRORS, OWN, Section, in_errors, largest_absolute, version_of
from scipy.constants import elementary_charge
from scipy.constants import k as boltzmann
from scipy.special import ndtr
from scipy.stats import poisson

import foveasim as fs

JANESICK = "Janesick, Photon Transfer (2007)"
EMVA = "EMVA 1288, Release 4.0 Linear"
LAYOUT = fs.layout.grid(n_x=250, n_y=200, pitch_um=3.0)
N = LAYOUT.n_sites


# -- shot noise and full well -----------------------------------------------------------------------------------------

MEANS_E = np.array([0.5, 5.0, 50.0, 99.0, 150.0, 1e3, 1e4])


def moments(draw: Callable[[float, int], np.ndarray]) -> np.ndarray:
    """Return mean, variance and third central moment of the draws at each expectation, (3, n)."""
    found = []
    for k, mean_e in enumerate(MEANS_E):
        values = np.asarray(draw(float(mean_e), k), np.float64)
        centred = values - mean_e
        found.append([values.mean(), np.mean(centred**2), np.mean(centred**3)])
    return np.array(found).T


def moment_errors() -> np.ndarray:
    """Return the standard errors of :func:`moments`, from the central moments of the Poisson distribution."""
    m = MEANS_E
    fourth, sixth = m + 3.0 * m**2, m + 25.0 * m**2 + 15.0 * m**3
    return np.sqrt(np.array([m, fourth - m**2, sixth - m**2]) / N)


def galsim_draw(mean_e: float, seed: int) -> np.ndarray:
    """Draw by GalSim."""
    import galsim

    image = galsim.ImageD(np.full((200, 250), mean_e))
    image.addNoise(galsim.PoissonNoise(galsim.BaseDeviate(seed + 1)))
    return image.array.ravel()


def compare_shot_noise(section: Section) -> None:
    """Compare draws of charges with moments of the Poisson distribution, without and with a full well."""
    sensor = fs.Sensor(LAYOUT)
    galsim, numpy = f"GalSim {version_of('GalSim')}", f"NumPy {version_of('numpy')}"
    calls = {
        OWN: lambda: moments(lambda mean_e, k: sensor.collect(np.full(N, mean_e), seed=k)),
        galsim: lambda: moments(galsim_draw),
        numpy: lambda: moments(lambda mean_e, k: np.random.default_rng(k).poisson(mean_e, N)),
    }
    section.compare(
        f"mean, variance and third moment of {N:,} charges, 0.5 to 10,000 e-",
        calls,
        np.array([MEANS_E, MEANS_E, MEANS_E]),
        by="all three are the expectation",
        source=f"Poisson distribution; {JANESICK}",
        tolerance=4.0,
        of=ERRORS,
        deviation=in_errors(moment_errors()),
        explanation="The largest of 21 deviations.",
    )
    well_e, mean_e = 1000, 1010.0
    charge = np.arange(well_e + 1)
    probability = poisson.pmf(charge, mean_e)
    probability[-1] += poisson.sf(well_e, mean_e)
    mean = float(probability @ charge)
    central = [float(probability @ (charge - mean) ** order) for order in (2, 4)]
    limited = fs.Sensor(LAYOUT, full_well_e=float(well_e))

    def both(values: np.ndarray) -> np.ndarray:
        return np.array([values.mean(), np.mean((values - mean) ** 2)])

    section.compare(
        f"mean and variance of {N:,} charges of {mean_e:.0f} e- with a full well of {well_e} e-",
        {
            OWN: lambda: both(limited.collect(np.full(N, mean_e), seed=0)),
            numpy: lambda: both(np.minimum(np.random.default_rng(0).poisson(mean_e, N), well_e)),
        },
        np.array([mean, central[0]]),
        by="sums over the clipped Poisson distribution",
        source="definition",
        tolerance=4.0,
        of=ERRORS,
        deviation=in_errors(np.sqrt(np.array([central[0], central[1] - central[0] ** 2]) / N)),
    )


# -- codes ------------------------------------------------------------------------------------------------------------


def exact_moments(mean_e: np.ndarray, gain: float, read_e: float, well_e: float, bits: int) -> np.ndarray:
    """Return mean and variance of codes (2, n): sums over Poisson charges, with Gaussian noise between levels of codes."""
    level = np.arange(1, 2**bits)
    found = []
    for each in mean_e:
        charge = np.arange(int(each + 12.0 * math.sqrt(each) + 30.0))
        probability = poisson.pmf(charge, each)
        probability /= probability.sum()
        at_least = probability @ ndtr((np.minimum(charge, well_e)[:, np.newaxis] - level / gain) / read_e)
        of_code = -np.diff(np.concatenate(([1.0], at_least, [0.0])))
        mean = of_code @ np.arange(2**bits)
        found.append([mean, of_code @ (np.arange(2**bits) - mean) ** 2])
    return np.array(found).T


def compare_codes(section: Section, directory: Path) -> None:
    """Compare predicted moments of codes with sums over charges and codes."""
    gain, read_e, well_e, bits = 0.25, 1.6, 850.0, 8
    mean_e = np.concatenate((np.linspace(0.0, 40.0, 41), np.linspace(45.0, 1000.0, 60)))
    layout = fs.layout.grid(n_x=mean_e.size, n_y=1, pitch_um=3.0)
    sensor = fs.Sensor(layout, gain_dn_per_e=gain, read_noise_e=read_e, full_well_e=well_e, bits=bits)
    truth = exact_moments(mean_e, gain, read_e, well_e, bits)
    formula = "linear model of EMVA 1288"
    found = section.compare(
        "predicted mean and variance of codes, 0 to 1000 e-, 0.25 DN/e-, full well 850 e-",
        {
            OWN: lambda: np.array(sensor.predict(mean_e)),
            formula: lambda: np.array([gain * mean_e - 0.5, gain**2 * (mean_e + read_e**2) + 1.0 / 12.0]),
        },
        truth,
        by="sums over all charges and codes",
        source="definition of the quantiser; Poisson and Gaussian distributions",
        tolerance=1e-9,
        deviation=largest_absolute,
        of="DN, DN²",
        cannot={formula: "no clipping at code 0 and at the full well, quantisation as uniform noise"},
    )
    figure = Figure(figsize=(5.2, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(truth[0], truth[1], "k-", lw=3, alpha=0.3, label="sums over charges and codes")
    for program, (mean, variance) in found.items():
        axes.plot(mean, variance, "--" if program == OWN else ":", label=program)
    axes.set(xlabel="mean code / DN", ylabel="variance / DN²")
    axes.legend(fontsize="small")
    section.draw(
        "photon_transfer",
        figure,
        "Photon transfer curve of 8 bits with a full well: variance of codes against their mean.",
        directory,
    )
    # Quantisation alone: Gaussian noise of some tenths of a code, at several positions between two transitions.
    sigmas, positions = np.array([0.15, 0.25, 0.4, 0.6]), np.linspace(0.0, 0.875, 8)
    n_frames = 8

    def exact(sigma: float, at: float) -> tuple[float, float, float]:
        code = np.arange(-8, 9)
        p = ndtr((code + 1 - at) / sigma) - ndtr((code - at) / sigma)
        mean = float(p @ code)
        variance = float(p @ (code - mean) ** 2)
        return mean, variance, float(p @ (code - mean) ** 4)

    cases = np.array([exact(sigma, at) for sigma in sigmas for at in positions])
    per_case = 1500
    layout = fs.layout.grid(n_x=per_case, n_y=len(cases), pitch_um=3.0)
    # 0.01 DN for each electron: charges are whole electrons.
    sensor = fs.Sensor(
        layout,
        gain_dn_per_e=0.001,
        bits=8,
        shot_noise="off",
        read_noise_e=np.repeat(1e3 * np.repeat(sigmas, positions.size), per_case),
    )
    charge = np.repeat(1e5 + 1e3 * np.tile(positions, sigmas.size), per_case)

    def drawn(codes: np.ndarray) -> np.ndarray:
        codes = codes.astype(np.float64).reshape(n_frames, len(cases), per_case) - 100.0
        return np.array([codes.mean(axis=(0, 2)), np.mean((codes - cases[:, :1]) ** 2, axis=(0, 2))])

    def by_numpy() -> np.ndarray:
        noise = np.random.default_rng(0).normal(size=(n_frames, charge.size))
        noise *= np.repeat(np.repeat(sigmas, positions.size), per_case)
        return drawn(np.floor(1e-3 * charge + noise))

    n = n_frames * per_case
    section.compare(
        "mean and variance of codes for read noise of 0.15 to 0.6 DN, at eight positions between two transitions",
        {
            OWN: lambda: drawn(fs.metrics.draw_frames(sensor, charge, n_frames=n_frames, seed=1)),
            f"NumPy {version_of('numpy')}": by_numpy,
        },
        cases[:, :2].T,
        by="probabilities of codes from the Gaussian distribution",
        source="definition of the quantiser",
        tolerance=4.0,
        of=ERRORS,
        deviation=in_errors(np.sqrt(np.array([cases[:, 1], cases[:, 2] - cases[:, 1] ** 2]) / n)),
        explanation="The largest of 64 deviations. The means over positions are σ² + 1/12 DN².",
    )


# -- photon transfer and reset noise ----------------------------------------------------------------------------------


def compare_gain(section: Section) -> None:
    """Compare the slope of variance over mean with the gain of the camera, and reset noise with sqrt(kTC)."""
    gain, read_e, bits, black_dn = 0.4, 4.0, 12, 60.0
    v_sat_v = 1.0
    sensor = fs.Sensor(
        LAYOUT,
        gain_dn_per_e=gain,
        read_noise_e=read_e,
        bits=bits,
        v_sat_v=v_sat_v,
        pedestal_v=black_dn / 2**bits * v_sat_v,
    )
    levels_e = np.concatenate(([0.0], np.linspace(500.0, 9000.0, 12)))

    def slope(frames: Callable[[float, int], np.ndarray]) -> float:
        """Return the slope, from half the variance of differences of two frames, for all programs alike."""
        mean, variance = [], []
        for k, level_e in enumerate(levels_e):
            first, second = (np.asarray(each, np.float64) for each in frames(float(level_e), k))
            mean.append(0.5 * (first.mean() + second.mean()))
            variance.append(0.5 * np.var(first - second, ddof=1))
        signal, shot = (np.array(each)[1:] - each[0] for each in (mean, variance))
        return float(signal @ shot / (signal @ signal))

    def by_galsim(level_e: float, seed: int) -> np.ndarray:
        import galsim

        frames = []
        for half in range(2):
            image = galsim.ImageD(np.full((200, 250), gain * level_e))
            noise = galsim.CCDNoise(galsim.BaseDeviate(2 * seed + half + 1), gain=1.0 / gain, read_noise=read_e)
            image.addNoise(noise)
            frames.append(np.floor(image.array.ravel() + black_dn))
        return np.array(frames)

    variance = gain**2 * (levels_e + read_e**2) + 1.0 / 12.0
    signal = gain * levels_e[1:]
    # Variances of two frames have the relative error sqrt(2/n); that of the dark frames is common to all levels.
    error = math.sqrt(
        (np.sum(signal**2 * 2.0 * variance[1:] ** 2) + 2.0 * variance[0] ** 2 * signal.sum() ** 2) / N
    ) / float(signal @ signal)
    section.compare(
        f"slope of variance over mean of codes, 13 levels of two frames of {N:,} photosites",
        {
            OWN: lambda: slope(
                lambda level_e, k: fs.metrics.draw_frames(sensor, np.full(N, level_e), n_frames=2, seed=k)
            ),
            f"GalSim {version_of('GalSim')}": lambda: slope(by_galsim),
        },
        gain,
        by="the system gain K, 0.4 DN/e-",
        source=f"{EMVA}; {JANESICK}",
        tolerance=4.0,
        of=ERRORS,
        deviation=in_errors(error),
        cannot={f"GalSim {version_of('GalSim')}": "no conversion to codes: its values are rounded down here"},
    )
    capacitances_f = np.array([1e-15, 1e-14, 1e-13])

    def reset_noise(capacitance_f: float, seed: int) -> float:
        """Return the noise of the reset, in e-, of dark frames on a pedestal."""
        camera = fs.Sensor(LAYOUT, capacitance_f=capacitance_f, v_sat_v=0.2, pedestal_v=0.1, bits=14, ktc_noise=True)
        codes = fs.metrics.draw_frames(camera, np.zeros(N), n_frames=1, seed=seed).astype(np.float64)
        per_dn_e = 0.2 * capacitance_f / elementary_charge / 2**14
        return math.sqrt(np.var(codes, ddof=1) - 1.0 / 12.0) * per_dn_e

    truth = np.sqrt(boltzmann * 300.0 * capacitances_f) / elementary_charge
    section.compare(
        "reset noise at 300 K: 1, 10 and 100 fF",
        {OWN: lambda: np.array([reset_noise(float(each), k) for k, each in enumerate(capacitances_f)])},
        truth,
        by="sqrt(k T C)/q: 12.7, 40.2 and 127 e-",
        source=f"{JANESICK}; constants of CODATA by SciPy",
        tolerance=4.0,
        of=ERRORS,
        deviation=in_errors(truth / math.sqrt(2.0 * N)),
        explanation="The other programs of this page have no reset noise.",
    )


# -- EMVA 1288 --------------------------------------------------------------------------------------------------------

SHAPE, BITS, N_LEVELS, N_STACK = (120, 160), 12, 50, 32
GAIN, QE, READ_E, WELL_E, DARK_E_PER_S = 0.4, 0.55, 4.0, 9000.0, 60.0
DSNU_E, PRNU = 3.0, 0.01
BLACK_DN = 60.0
TIMES_S = np.round(np.linspace(0.01, 0.5, N_LEVELS), 6)
PHOTONS = 20_000.0 / QE * TIMES_S
#: Level of the stacks of frames, half of saturation, and step of the levels among which foveasim has it as half.
HALF, STEP = 21, 7


def draw_camera() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return frames with and without light, (n_level) of (n_frame, n_site) each."""
    layout = fs.layout.grid(n_x=SHAPE[1], n_y=SHAPE[0], pitch_um=3.0)
    sensor = fs.Sensor(
        layout,
        qe=QE,
        gain_dn_per_e=GAIN,
        read_noise_e=READ_E,
        full_well_e=WELL_E,
        dark_e_per_s=DARK_E_PER_S,
        dsnu_e=DSNU_E,
        prnu_fraction=PRNU,
        bits=BITS,
        v_sat_v=1.0,
        pedestal_v=BLACK_DN / 2**BITS,
    )
    series: list[list[np.ndarray]] = []
    for kind, light in enumerate((1.0, 0.0)):
        levels = []
        for k, (time_s, photons) in enumerate(zip(TIMES_S, PHOTONS, strict=True)):
            rate = np.full(layout.n_sites, light * QE * photons / time_s)
            n = N_STACK if k == HALF else 2
            first = 1000 * kind + 40 * k
            levels.append(
                np.stack([sensor.expose(rate, float(time_s), seed=1288, frame=first + f)[2] for f in range(n)])
            )
        series.append(levels)
    return series[0], series[1]


def write_frames(lit: list[np.ndarray], dark: list[np.ndarray], folder: Path) -> Path:
    """Write frames as PNG, and their descriptor for emva1288."""
    lines = [f"n {BITS} {SHAPE[1]} {SHAPE[0]}"]
    for kind, levels in (("b", lit), ("d", dark)):
        for k, codes in enumerate(levels):
            names = []
            for f, frame in enumerate(codes):
                names.append(f"{kind}_{k:02d}_{f:02d}.png")
                Image.fromarray(frame.reshape(SHAPE)).save(folder / names[-1], compress_level=1)
            head = f"{kind} {1e9 * TIMES_S[k]:.0f}" + (f" {float(PHOTONS[k])!r}" if kind == "b" else "")
            # Two frames are temporal data, more are spatial data.
            for part in (names[:2], names) if len(names) > 2 else (names,):
                lines += [head, *(f"i {name}" for name in part)]
    descriptor = folder / "descriptor.txt"
    descriptor.write_text("\n".join(lines) + "\n")
    return descriptor


def by_emva1288(descriptor: Path, saturation: int) -> dict[str, float]:
    """Return the parameters of the reference implementation."""
    from emva1288.process import routines
    from emva1288.process.data import Data1288
    from emva1288.process.loader import LoadImageData
    from emva1288.process.parser import ParseEmvaDescriptorFile
    from emva1288.process.results import Results1288

    # NumPy 2 lacks a function that it calls.
    routines.np = SimpleNamespace(**{"asfarray": partial(np.asarray, dtype=np.float64)} | vars(np))
    parsed = ParseEmvaDescriptorFile(str(descriptor), loglevel=logging.ERROR)
    images = LoadImageData(parsed.images, loglevel=logging.ERROR)
    data = Data1288(images.data, loglevel=logging.ERROR).data
    found = Results1288(data, index_u_ysat=saturation, loglevel=logging.ERROR)
    return {
        "gain": float(found.K),
        "qe": 0.01 * float(found.QE),
        "read": float(found.sigma_d),
        "dark": float(found.u_I_mean),
        "dsnu": float(found.DSNU1288),
        "prnu": 0.01 * float(found.PRNU1288),
    }


def by_foveasim(lit: list[np.ndarray], dark: list[np.ndarray]) -> tuple[dict[str, float], int]:
    """Return the parameters of foveasim.metrics.emva1288, and the level of saturation."""
    pairs = [[each[:2] for each in levels] for levels in (lit, dark)]
    temporal = fs.metrics.emva1288(*pairs, PHOTONS, dark_series=pairs[1], exposure_s=TIMES_S)
    # Non-uniformities from the stacks: among these levels, the one nearest to half of saturation.
    spatial = fs.metrics.emva1288(lit[::STEP], dark[::STEP], PHOTONS[::STEP])
    values = {
        "gain": temporal.gain_dn_per_e,
        "qe": temporal.qe,
        "read": temporal.dark_noise_e,
        "dark": temporal.dark_current_e_per_s,
        "dsnu": spatial.dsnu_e,
        "prnu": spatial.prnu_fraction,
    }
    return {name: float(each[0]) for name, each in values.items()}, int(temporal.transfer.saturation_level[0])


def emva_errors(saturation: int) -> dict[str, float]:
    """Return standard errors of the parameters, by the closed forms of their estimators."""
    n = SHAPE[0] * SHAPE[1]
    dark_e = DARK_E_PER_S * TIMES_S
    dark_dn2 = GAIN**2 * (dark_e + READ_E**2) + 1.0 / 12.0
    signal_dn = GAIN * QE * PHOTONS
    lit_dn2 = dark_dn2 + GAIN * signal_dn
    used = signal_dn <= 0.7 * signal_dn[saturation]
    s, v, d, p = signal_dn[used], lit_dn2[used], dark_dn2[used], PHOTONS[used]
    # Each level has two frames: variances with the relative error sqrt(2/n), means with sqrt(v/2n); the PRNU is common.
    gain = math.sqrt(np.sum(s**2 * 2.0 * (v**2 + d**2)) / n) / (s @ s)
    responsivity = math.sqrt(np.sum(p**2 * (v + d)) / (2.0 * n)) / (p @ p) / (GAIN * QE)
    relative_gain = gain / GAIN
    t = TIMES_S - TIMES_S.mean()
    half = lit_dn2[HALF] / N_STACK, dark_dn2[HALF] / N_STACK
    dsnu_dn2, prnu_dn2 = (GAIN * DSNU_E) ** 2, (PRNU * signal_dn[HALF]) ** 2
    spatial = [
        math.sqrt(2.0 * (a + b) ** 2 / n + 2.0 * b**2 / (n * (N_STACK - 1)))
        for a, b in ((dsnu_dn2, half[1]), (prnu_dn2 + dsnu_dn2, half[0]))
    ]
    return {
        "gain": gain,
        "qe": QE * math.hypot(relative_gain, responsivity, PRNU / math.sqrt(n)),
        # The noise at exposure 0 is an intercept of the variances over the times.
        "read": READ_E
        * math.hypot(
            relative_gain,
            0.5
            / (GAIN**2 * READ_E**2)
            * math.sqrt(2.0 * np.mean(dark_dn2) ** 2 / n)
            * math.sqrt(1.0 / t.size + TIMES_S.mean() ** 2 / (t @ t)),
        ),
        "dark": DARK_E_PER_S
        * math.hypot(relative_gain, math.sqrt(np.sum(t**2 * dark_dn2) / (2.0 * n)) / (t @ t) / (GAIN * DARK_E_PER_S)),
        "dsnu": DSNU_E * math.hypot(relative_gain, 0.5 * spatial[0] / dsnu_dn2),
        "prnu": PRNU * 0.5 * math.hypot(*spatial) / prnu_dn2,
    }


def compare_emva(section: Section) -> None:
    """Compare the parameters that both analyses find with those of the camera."""
    lit, dark = draw_camera()
    own, saturation = by_foveasim(lit, dark)
    with TemporaryDirectory() as folder:
        reference = by_emva1288(write_frames(lit, dark, Path(folder)), saturation)
    errors = emva_errors(saturation)
    program = f"emva1288 {version_of('emva1288')}"
    for name, truth, what in (
        ("gain", GAIN, "system gain, 0.4 DN/e-"),
        ("qe", QE, "quantum efficiency, 0.55"),
        ("read", READ_E, "dark noise at exposure 0, 4 e-"),
        ("dark", DARK_E_PER_S, "dark current, 60 e-/s"),
        ("dsnu", DSNU_E, "DSNU, 3 e-"),
        ("prnu", PRNU, "PRNU, 0.01"),
    ):
        section.compare(
            f"EMVA 1288 of frames of foveasim: {what}",
            {OWN: lambda name=name: own[name], program: lambda name=name: reference[name]},
            truth,
            by="parameter of the simulated camera",
            source=EMVA,
            tolerance=4.0,
            of=ERRORS,
            deviation=in_errors(errors[name]),
            repeats=0,
            explanation="emva1288 divides the DSNU in DN by the gain of all levels, foveasim here by that of every seventh."
            if name == "dsnu"
            else "",
            cannot={
                program: "its search for saturation stops at a peak of the noise; given the level of highest variance"
            }
            if name == "gain"
            else None,
        )


def validate(section: Section, directory: Path) -> None:
    """Compare charges and codes with the distributions that they are drawn from."""
    compare_shot_noise(section)
    compare_codes(section, directory)
    compare_gain(section)
    compare_emva(section)
