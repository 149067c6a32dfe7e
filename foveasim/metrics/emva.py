"""
EMVA 1288 parameters from frames of a sensor.

System gain, noise, quantum efficiency, saturation, nonuniformity, linearity and dark current according to EMVA Standard 1288,
Release 4.0 Linear (https://www.emva.org/standards-technology/emva-1288/), for sensors with a linear response. The parameters
are computed for each class of photosites, with intervals of 95 % confidence. The parts of rows, columns and pixels of DSNU and
PRNU are those of classes in complete rows and columns. The plots and histograms of the standard are omitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import OwnCheck
from foveasim._core.validation import Bools, Floats, Ints, finite_array, read_only
from foveasim.errors import FoveasimWarning, ParameterError, type_name, warn
from foveasim.layout.model import Layout
from foveasim.metrics.emva_intervals import EmvaIntervals, Jackknife
from foveasim.metrics.emva_nonuniformity import MeanImage, class_grids, mean_image, nonuniformity
from foveasim.metrics.photon_transfer import (
    MIN_DARK_DN2,
    PhotonTransfer,
    SiteClasses,
    above_dark,
    codes_of,
    is_linear,
    measure_subsets,
    slopes,
)
from foveasim.sensor.adc import QUANTISATION_DN2
from foveasim.sensor.published.datasheet import THRESHOLD_E

__all__ = ["Emva1288", "emva1288"]

#: Range of the linearity error in fractions of saturation.
LINEARITY_FRACTIONS = (0.05, 0.95)
#: Level of the PRNU in fractions of saturation.
PRNU_FRACTION = 0.5
#: Largest permitted fraction of dark codes that are clipped at 0.
MAX_UNDERFLOW_FRACTION = 0.005
#: Largest number of blocks of sites of the jackknife: Student's distribution is then nearly Gaussian.
N_BLOCKS = 100
#: Minimum number of points of a straight-line fit: exposures for the dark current, levels for the linearity error.
MIN_POINTS = 3


#: Parameters that follow from others.
DERIVED = ("saturation_e", "threshold_e", "snr_max", "snr_max_db", "dynamic_range", "dynamic_range_db")


@dataclass(frozen=True, eq=False)
class Emva1288:
    """
    EMVA 1288 parameters of each class of sites.

    Attributes
    ----------
    classes : (n_class,)
        Labels of the classes, sorted.
    gain_dn_per_e : (n_class,) float64, DN/e-
        System gain K: slope of the temporal variance against the mean, both dark-corrected, up to 70 % of saturation.
    responsivity_dn_per_ph : (n_class,) float64, DN per photon
        Responsivity R: slope of the dark-corrected mean against photons, up to 70 % of saturation.
    qe : (n_class,) float64
        Quantum efficiency, electrons per photon: R / K.
    dark_noise_dn : (n_class,) float64, DN
        Temporal dark noise including quantisation; extrapolated to exposure 0 if a dark series is given. At least sqrt(0.24).
    dark_noise_e : (n_class,) float64, e-
        Dark noise without quantisation: ``sqrt(dark_noise_dn**2 - 1/12) / K``.
    is_quantisation_limited : (n_class,) bool
        Whether quantisation masks the dark noise (variance below 0.24 DN²), which is then an upper bound.
    saturation_ph : (n_class,) float64, photons
        Saturation: photons at the level of the highest temporal variance.
    threshold_ph : (n_class,) float64, photons
        Absolute sensitivity threshold, at which the SNR is 1: ``(dark_noise_dn / K + 1/2) / qe``.
    linearity_error_min_fraction, linearity_error_max_fraction : (n_class,) float64
        Largest negative and positive relative deviation of the mean from a line fitted with relative weights from 5 to 95 %
        of saturation; NaN for fewer than three levels.
    dsnu_e : (n_class,) float64, e-
        DSNU1288: spatial standard deviation of dark frames over K; NaN if the estimated variance is negative.
    prnu_fraction : (n_class,) float64
        PRNU1288: spatial standard deviation at the level closest to half saturation, less the dark variance, over the
        dark-corrected mean; NaN if the estimated variance is negative. Without what the photons of each site explain: shading
        by the optics, and areas.
    dsnu_row_e, dsnu_column_e, dsnu_pixel_e, prnu_row_fraction, prnu_column_fraction, prnu_pixel_fraction : (n_class,) float64
        Parts of rows, columns and pixels; NaN for a class without complete rows and columns, or without a ``layout``, and if
        the estimated variance is negative.
    dark_current_e_per_s, dark_current_from_variance_e_per_s : (n_class,) float64, e-/s
        Dark current from the mean and from the variance of dark frames against exposure; NaN without a dark series.
    underflow_fraction : (n_class,) float64
        Fraction of dark codes that are 0.
    transfer, dark : PhotonTransfer
        Photon transfer curves of the frames and the dark frames.
    intervals : EmvaIntervals
        95 % confidence intervals of all parameters, and whether the data resolve them.

    Notes
    -----
    The saturation is one of the given levels, so that its resolution is their spacing. A full well clips the fluctuations
    above it, so that the variance is highest approximately 2 standard deviations of the shot noise below the full well.

    Intervals come from the jackknife over blocks of consecutive sites. They contain the parameters of the kind of sensor, of
    which the measured sites are a sample, and assume independent blocks: errors that all sites share, such as a wrong photon
    number or a nonlinear response, are not included. Of 1,000 simulated sensors with 2,025 sites, 93 to 96 % of the intervals
    contain the parameter. Those of saturation and linearity error are simultaneous over levels, and therefore wider, 98 to
    100 %; that of the saturation ends at the levels next to those that may have the highest variance. Intervals of standard
    deviations are those of the variances: a DSNU below the temporal noise of the mean has an interval from 0, whatever the
    estimate is. The limits of parts of rows, columns and pixels assume Gaussian nonuniformity (chi-square distributions), and
    those of the PRNU with ``highpass`` do, too.
    """

    classes: NDArray[Any]
    gain_dn_per_e: Floats
    responsivity_dn_per_ph: Floats
    qe: Floats
    dark_noise_dn: Floats
    dark_noise_e: Floats
    is_quantisation_limited: Bools
    saturation_ph: Floats
    threshold_ph: Floats
    linearity_error_min_fraction: Floats
    linearity_error_max_fraction: Floats
    dsnu_e: Floats
    prnu_fraction: Floats
    dsnu_row_e: Floats
    dsnu_column_e: Floats
    dsnu_pixel_e: Floats
    prnu_row_fraction: Floats
    prnu_column_fraction: Floats
    prnu_pixel_fraction: Floats
    dark_current_e_per_s: Floats
    dark_current_from_variance_e_per_s: Floats
    underflow_fraction: Floats
    transfer: PhotonTransfer
    dark: PhotonTransfer
    intervals: EmvaIntervals

    def __repr__(self) -> str:
        return f"Emva1288({self.transfer.n_frames.size} levels, {self.classes.size} classes)"

    def records(self) -> list[dict[str, Any]]:
        """
        Return one dict per class, with all parameters.

        ``not_resolved`` lists those that the data do not resolve.
        """
        others = ("classes", "transfer", "dark", "intervals")
        names = [f.name for f in fields(self) if f.name not in others]
        columns = {name: np.asarray(getattr(self, name)).tolist() for name in (*names, *DERIVED)}
        unresolved = {
            name: self.intervals.is_measured(name) & ~self.intervals.is_resolved(name) for name in self.intervals.limits
        }
        return [
            {"class": label}
            | {name: values[k] for name, values in columns.items()}
            | {"not_resolved": ", ".join(name for name, is_unresolved in unresolved.items() if is_unresolved[k])}
            for k, label in enumerate(self.classes.tolist())
        ]

    def _repr_html_(self) -> str:
        from foveasim.view import to_html

        return to_html(self) + to_html(self.intervals)

    @property
    def saturation_e(self) -> Floats:
        """Saturation capacity, (n_class,) e-: ``qe * saturation_ph``."""
        return self.qe * self.saturation_ph

    @property
    def threshold_e(self) -> Floats:
        """Absolute sensitivity threshold, (n_class,) e-: ``qe * threshold_ph``."""
        return self.qe * self.threshold_ph

    @property
    def snr_max(self) -> Floats:
        """Maximum SNR, (n_class,): ``sqrt(saturation_e)``, the shot noise limit of the standard."""
        return np.sqrt(self.saturation_e)

    @property
    def snr_max_db(self) -> Floats:
        """Maximum SNR in decibels, ``20 log10``, (n_class,)."""
        return 20.0 * np.log10(self.snr_max)

    @property
    def dynamic_range(self) -> Floats:
        """Dynamic range: saturation over absolute sensitivity threshold, (n_class,)."""
        return self.saturation_ph / self.threshold_ph

    @property
    def dynamic_range_db(self) -> Floats:
        """Dynamic range in decibels, ``20 log10``, (n_class,)."""
        return 20.0 * np.log10(self.dynamic_range)


def emva1288(
    frames: OwnCheck[Sequence[Any]],
    dark: OwnCheck[Sequence[Any]],
    photons: ArrayLike,
    *,
    classes: ArrayLike | None = None,
    dark_series: Sequence[Any] | None = None,
    exposure_s: ArrayLike | None = None,
    layout: Layout | None = None,
    highpass: bool = False,
) -> Emva1288:
    """
    Compute EMVA 1288 parameters from uniformly illuminated frames and dark frames.

    Parameters
    ----------
    frames : sequence of levels
        Two or more frames for each irradiance level, in increasing order: ``(n_frame, n_site)`` DN, or a list of codes or
        captures. The levels should exceed saturation; the standard requires 50 levels. Many frames near half saturation and
        in the dark reduce the uncertainty of PRNU and DSNU.
    dark : sequence of levels
        Dark frames in the same form: one level for a constant exposure time, or one for each level.
    photons : (n_level,) or (n_level, n_site) float64
        Expected photons per site at each level; they differ between sites of different size. Photons of each site are also
        the shading, which is then no part of the PRNU: without them, uneven light counts as PRNU.
    classes : (n_site,), optional
        Class label of each site, such as its size or filter; a single class by default.
    dark_series : sequence of levels, optional
        Dark frames at three or more exposures ``exposure_s``, for the dark current and the dark noise at exposure 0.
    exposure_s : (n_exposure,) float64, s
        Exposure of each level of ``dark_series``.
    layout : Layout, optional
        Layout of the sites, for the parts of rows, columns and pixels; by default that of captures.
    highpass : bool
        Whether to suppress uneven light, of unknown photons per site, in the PRNU by the highpass filter of Release 4.0, which
        subtracts a smoothed image (boxes of 7 x 7 and 11 x 11 pixels, and a binomial filter of 3 x 3). Needs a layout with rows
        and columns. The part that the filter removes from the PRNU is corrected.

    Returns
    -------
    Emva1288

    Raises
    ------
    ParameterError
        When shapes are inconsistent, a level has fewer than two frames, there is no signal, or levels do not increase.

    Warns
    -----
    FoveasimWarning
        When more than 0.5 % of the dark codes are 0: the clipping biases dark noise and DSNU low. When the variance is
        highest at the last level: the saturation, and the parameters derived from it, are underestimated. When there is a
        layout, and no class has complete rows and columns.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=40, n_y=40, pitch_um=3.0)
    >>> sensor = fs.Sensor(
    ...     layout,
    ...     capacitance_f=1.6e-15,
    ...     v_sat_v=1.0,
    ...     bits=12,
    ...     read_noise_e=5.0,
    ...     pedestal_v=0.02,
    ... )
    >>> photons = np.linspace(2e3, 24e3, 12)
    >>> levels_e = 0.5 * photons * np.ones((1600, 1))  # quantum efficiency of 0.5
    >>> frames = [
    ...     fs.metrics.draw_frames(sensor, level_e, n_frames=2, seed=k)
    ...     for k, level_e in enumerate(levels_e.T)
    ... ]
    >>> dark = [fs.metrics.draw_frames(sensor, np.zeros(1600), n_frames=2, seed=99)]
    >>> found = fs.metrics.emva1288(frames, dark, photons)
    >>> found.qe.round(2).tolist(), found.dark_noise_e.round().tolist()
    ([0.5], [5.0])
    """
    for name, levels in (("frames", frames), ("dark", dark)):
        if not isinstance(levels, Iterable):
            raise ParameterError(name, f"must be a list of levels, got {type_name(levels)}")
    frames, dark = list(frames), list(dark)
    transfer, lit, groups = measure_subsets(frames, classes=classes, n_blocks=N_BLOCKS)
    dark_transfer, unlit, _ = measure_subsets(dark, classes=classes, n_blocks=N_BLOCKS)
    mean_dn, _ = above_dark(transfer, dark_transfer)
    level_ph = _photons(photons, groups, len(frames))
    i_saturation, i_class = transfer.saturation_level, np.arange(transfer.classes.size)
    n_at_end = np.count_nonzero(i_saturation == len(frames) - 1)
    if n_at_end:
        warn(
            f"the variance is highest at the last level for {n_at_end} of {i_saturation.size} classes: saturation is not "
            "reached and is underestimated; add levels of higher irradiance",
            FoveasimWarning,
        )
    # The levels are chosen once, and the parameters are computed for all subsets of sites.
    saturation_dn = mean_dn[i_saturation, i_class]
    half = np.abs(mean_dn - PRNU_FRACTION * saturation_dn).argmin(axis=0)
    dark_half = np.minimum(half, dark_transfer.n_frames.size - 1)
    signal_dn, shot_dn2 = lit[0] - unlit[0], lit[1] - unlit[1]

    is_used = is_linear(mean_dn, i_saturation)
    gain_dn_per_e = slopes("frames", signal_dn, shot_dn2, is_used)
    responsivity = slopes("photons", np.broadcast_to(level_ph, signal_dn.shape), signal_dn, is_used)
    qe = responsivity / gain_dn_per_e
    dark_current, dark_current_from_variance, noise_dn2 = _dark_current(
        dark_series, exposure_s, classes, gain_dn_per_e, unlit[1][:, 0]
    )
    noise_e = np.sqrt(np.maximum(noise_dn2, MIN_DARK_DN2)) / gain_dn_per_e
    dark_spatial_dn2 = unlit[2][:, dark_half, i_class]
    images = _images(frames, dark, half, dark_half, _ratios(photons, groups, half))
    bright_spatial_dn2 = lit[2][:, half, i_class].copy()
    for k, (bright, _) in enumerate(images):
        bright_spatial_dn2[:, k] = (groups.subset_variances(bright.mean_dn) - groups.subset_means(bright.noise_dn2))[
            :, k
        ]
    bright_spatial_dn2 -= dark_spatial_dn2
    layout = getattr(next(iter(frames[0])), "layout", None) if layout is None else layout
    if highpass and layout is None:
        raise ParameterError("layout", "must be given for a highpass filter", None)
    grids = [None] * i_class.size if layout is None else class_grids(_check_layout(layout, groups), groups)
    if highpass and any(grid is None for grid in grids):
        raise ParameterError(
            "highpass", "needs complete rows and columns in each class", hint="pass photons of each site"
        )
    parts = nonuniformity(grids, images, gain_dn_per_e[0], signal_dn[0, half, i_class], highpass=highpass)
    deviation, is_compared = _linearity(level_ph, signal_dn, saturation_dn)

    subsets = {
        "gain_dn_per_e": gain_dn_per_e,
        "responsivity_dn_per_ph": responsivity,
        "qe": qe,
        "threshold_ph": (noise_e + THRESHOLD_E) / qe,
        "threshold_e": noise_e + THRESHOLD_E,
        "dark_current_e_per_s": dark_current,
        "dark_current_from_variance_e_per_s": dark_current_from_variance,
    }
    #: Squares of parameters: differences of variances, which may be estimated as negative.
    squares = {
        "dark_noise_dn": np.maximum(noise_dn2, MIN_DARK_DN2),
        "dark_noise_e": (np.maximum(noise_dn2, MIN_DARK_DN2) - QUANTISATION_DN2) / gain_dn_per_e**2,
        "dsnu_e": dark_spatial_dn2 / gain_dn_per_e**2,
        "prnu_fraction": bright_spatial_dn2 / signal_dn[:, half, i_class] ** 2,
    }
    underflow = _underflow_fraction(dark[0], groups)
    estimates: dict[str, NDArray[Any]] = {
        **{name: values[0] for name, values in subsets.items()},
        **{name: _root(values[0]) for name, values in squares.items()},
        **{name: _root(values) for name, values in parts.values.items()},
        "is_quantisation_limited": noise_dn2[0] < MIN_DARK_DN2,
        "saturation_ph": level_ph[0, i_saturation, i_class],
        "linearity_error_min_fraction": _extreme(np.min, deviation[0], is_compared),
        "linearity_error_max_fraction": _extreme(np.max, deviation[0], is_compared),
        "underflow_fraction": underflow[0],
    }
    # Without a dark level below the quantisation, the noise and the threshold have only upper limits.
    jackknife = Jackknife(groups.n_blocks_of_class)
    limits = {name: jackknife.interval(values) for name, values in subsets.items()}
    # The interval of a square begins at 0 if it contains 0.
    limits |= {name: np.sqrt(jackknife.interval(values)) for name, values in squares.items()}
    limits |= {name: np.sqrt(values) for name, values in parts.limits.items()}
    is_limited = estimates["is_quantisation_limited"]
    for name in ("dark_noise_dn", "dark_noise_e"):
        limits[name][is_limited, 0] = 0.0
    limits["threshold_e"][is_limited, 0] = THRESHOLD_E
    limits["threshold_ph"][is_limited, 0] = THRESHOLD_E / limits["qe"][is_limited, 1]
    extremes = jackknife.interval_of_extremes(deviation, is_compared)
    limits["linearity_error_min_fraction"], limits["linearity_error_max_fraction"] = extremes
    limits["saturation_ph"] = _saturation_limits(level_ph[0], jackknife.candidates(lit[1]))
    limits["underflow_fraction"] = jackknife.interval_of_fraction(underflow, groups.n_sites, len(dark[0]))
    limits |= _derived_limits(limits)
    names = [f.name for f in fields(Emva1288)]
    return Emva1288(
        **{name: read_only(estimates[name]) for name in names if name in estimates},
        classes=transfer.classes,
        transfer=transfer,
        dark=dark_transfer,
        intervals=EmvaIntervals(
            transfer.classes, {name: read_only(limits[name]) for name in (*names, *DERIVED) if name in limits}
        ),
    )


def _root(values: Floats) -> Floats:
    """Return square roots, NaN of negative numbers."""
    return np.sqrt(np.where(values >= 0.0, values, np.nan))


def _check_layout(layout: Layout, groups: SiteClasses) -> Layout:
    n_sites = int(groups.n_sites.sum())
    if not isinstance(layout, Layout) or layout.n_sites != n_sites:
        raise ParameterError("layout", f"must be a layout of the {n_sites} sites of the frames", layout)
    return layout


def _ratios(photons: ArrayLike, groups: SiteClasses, half: Ints) -> list[Floats | None]:
    """Return photons over their mean, at the level of the PRNU of each class."""
    values = finite_array("photons", photons, at_least=0.0)
    if values.ndim == 1:
        return [None] * half.size
    found: list[Floats | None] = []
    for k, level in enumerate(half):
        level_ph = values[level]
        if not np.all(level_ph[groups.class_index == k] > 0.0):
            raise ParameterError("photons", f"must be > 0 at each site at the level of the PRNU, {level}")
        # Sites of other classes are not used.
        found.append(np.where(groups.class_index == k, level_ph / groups.mean(level_ph)[k], 1.0))
    return found


def _images(
    frames: Sequence[Any], dark: Sequence[Any], half: Ints, dark_half: Ints, ratio: Sequence[Floats | None]
) -> list[tuple[MeanImage, MeanImage]]:
    """Return the bright and the dark mean image of each class at the level of its PRNU."""
    known: dict[tuple[int, int], tuple[MeanImage, MeanImage]] = {}
    images = []
    for level, dark_level, relative in zip(half.tolist(), dark_half.tolist(), ratio, strict=True):
        if relative is not None:
            images.append((mean_image(frames[level], dark[dark_level], relative), mean_image(dark[dark_level])))
            continue
        if (level, dark_level) not in known:
            known[level, dark_level] = mean_image(frames[level]), mean_image(dark[dark_level])
        images.append(known[level, dark_level])
    return images


def _photons(photons: ArrayLike, groups: SiteClasses, n_levels: int) -> Floats:
    """
    Return the mean photons per site of each subset, level and class.

    Either (1 + n_block, n_level, n_class), or (1, n_level, n_class) if they are the same for all sites.
    """
    values = finite_array("photons", photons, at_least=0.0)
    n_sites = int(groups.n_sites.sum())
    if values.shape == (n_levels,):
        level_ph = np.repeat(values[None, :, None], groups.n_sites.size, axis=2)
    elif values.shape == (n_levels, n_sites):
        level_ph = np.stack([groups.subset_means(level) for level in values], axis=1)
    else:
        raise ParameterError("photons", f"must have shape ({n_levels},) or ({n_levels}, {n_sites})", values.shape)
    if np.any(np.diff(level_ph[0], axis=0) <= 0.0):
        raise ParameterError("photons", "must increase from level to level in every class", hint="sort the levels")
    return level_ph


def _dark_current(
    dark_series: Sequence[Any] | None,
    exposure_s: ArrayLike | None,
    classes: ArrayLike | None,
    gain_dn_per_e: Floats,
    noise_dn2: Floats,
) -> tuple[Floats, Floats, Floats]:
    """
    Return the dark currents from mean and variance, and the variance at exposure 0.

    Dark currents are (1 + n_block, n_class) in e-/s, variances (1 + n_block, n_class) in DN².
    """
    if dark_series is None and exposure_s is None:
        return np.full_like(gain_dn_per_e, np.nan), np.full_like(gain_dn_per_e, np.nan), noise_dn2
    if dark_series is None or exposure_s is None:
        raise ParameterError("dark_series", "must be given together with exposure_s")
    series, (mean_dn, variance_dn2, _), _ = measure_subsets(dark_series, classes=classes, n_blocks=N_BLOCKS)
    times_s = finite_array("exposure_s", exposure_s, ndim=1, at_least=0.0)
    if times_s.size != series.n_frames.size or np.unique(times_s).size < MIN_POINTS:
        raise ParameterError(
            "exposure_s",
            f"must have one exposure for each of {series.n_frames.size} levels, at least {MIN_POINTS} of them different",
            times_s.tolist(),
            "s",
        )
    off_s = times_s - times_s.mean()
    mean_slope, variance_slope = (
        np.tensordot(off_s, values, axes=(0, 1)) / (off_s @ off_s) for values in (mean_dn, variance_dn2)
    )
    at_zero_dn2 = variance_dn2.mean(axis=1) - variance_slope * times_s.mean()
    return mean_slope / gain_dn_per_e, variance_slope / gain_dn_per_e**2, at_zero_dn2


def _linearity(level_ph: Floats, signal_dn: Floats, saturation_dn: Floats) -> tuple[Floats, Bools]:
    """
    Return the relative deviations from a line fitted with weights 1 / signal².

    Of each subset, level and class, (1 + n_block, n_level, n_class); and whether a level is fitted, (n_level, n_class).
    """
    y, x = signal_dn, np.broadcast_to(level_ph, signal_dn.shape)
    n_levels, level = y.shape[1], np.arange(y.shape[1])[:, None]
    # From the first level above the lower limit to the last level below the upper one.
    low, high = (fraction * saturation_dn for fraction in LINEARITY_FRACTIONS)
    first = np.where(y[0] >= low, level, n_levels).min(axis=0)
    last = np.where(y[0] <= high, level, -1).max(axis=0)
    is_used = (level >= first) & (level <= last)
    span_ph = np.where(is_used, x[0], -np.inf).max(axis=0) - np.where(is_used, x[0], np.inf).min(axis=0)
    is_used &= (is_used.sum(axis=0) >= MIN_POINTS) & (span_ph > 0.0) & ~np.any(is_used & (y[0] <= 0.0), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # levels and classes that are not used
        # Least squares of slope * u + offset * v - 1 by the normal equations, with columns of similar size.
        scale_ph, scale_dn = (np.where(is_used, values, 0.0).max(axis=1, keepdims=True) for values in (x, y))
        u, v = (np.where(is_used, ratio, 0.0) for ratio in (x / scale_ph * (scale_dn / y), scale_dn / y))
        uu, uv, vv, u1, v1 = ((p * q).sum(axis=1, keepdims=True) for p, q in ((u, u), (u, v), (v, v), (u, 1), (v, 1)))
        slope, offset = (u1 * vv - v1 * uv) / (uu * vv - uv * uv), (v1 * uu - u1 * uv) / (uu * vv - uv * uv)
        return y / (scale_dn * (slope * x / scale_ph + offset)) - 1.0, is_used


def _extreme(function: Callable[..., Floats], deviation_fraction: Floats, is_used: Bools) -> Floats:
    """Return the smallest or largest deviation, (n_class,); NaN without used levels."""
    initial = np.inf if function is np.min else -np.inf
    found = function(deviation_fraction, axis=0, where=is_used, initial=initial)
    return np.where(is_used.any(axis=0), found, np.nan)


def _saturation_limits(level_ph: Floats, may_be_highest: Bools) -> Floats:
    """
    Return the levels next to those that may have the highest variance, (n_class, 2).

    They are 0 and infinity beyond the first and the last level.
    """
    n_levels = level_ph.shape[0]
    around = np.concatenate((np.zeros_like(level_ph[:1]), level_ph, np.full_like(level_ph[:1], np.inf)))
    i_class = np.arange(level_ph.shape[1])
    first, last = may_be_highest.argmax(axis=0), n_levels - 1 - may_be_highest[::-1].argmax(axis=0)
    return np.stack((around[first, i_class], around[last + 2, i_class]), axis=-1)


def _derived_limits(limits: dict[str, Floats]) -> dict[str, Floats]:
    """Return the limits of products and ratios of parameters, from those of the factors."""
    with np.errstate(divide="ignore", invalid="ignore"):  # infinite saturation, threshold 0
        saturation_e = limits["qe"] * limits["saturation_ph"]
        dynamic_range = limits["saturation_ph"] / limits["threshold_ph"][:, ::-1]
        return {
            "saturation_e": saturation_e,
            "snr_max": np.sqrt(saturation_e),
            "snr_max_db": 10.0 * np.log10(saturation_e),
            "dynamic_range": dynamic_range,
            "dynamic_range_db": 20.0 * np.log10(dynamic_range),
        }


def _underflow_fraction(dark: Any, groups: SiteClasses) -> Floats:
    """Return the fraction of codes that are 0, (1 + n_block, n_class); warn if large."""
    fraction = groups.subset_means((codes_of("dark[0]", dark) == 0).mean(axis=0))
    if fraction[0].max() > MAX_UNDERFLOW_FRACTION:
        warn(
            f"{100 * fraction[0].max():.1f} % of the dark codes are 0, which clips the noise: dark noise and DSNU are "
            "underestimated; raise the dark level above 0, for example by a pedestal",
            FoveasimWarning,
        )
    return fraction
