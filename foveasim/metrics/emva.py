"""
EMVA 1288 parameters from frames of a sensor.

System gain, noise, quantum efficiency, saturation, nonuniformity, linearity and dark current according to EMVA Standard 1288,
Release 4.0 Linear (https://www.emva.org/standards-technology/emva-1288/), for sensors with a linear response. The parameters
are computed for each class of photosites. The split of the spatial variance into rows, columns and pixels requires a grid and
is omitted, as are the plots and histograms of the standard.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.user_warnings import warn
from foveasim._core.validation import Bools, Floats, finite_array, read_only
from foveasim.errors import FoveasimWarning, ParameterError, type_name
from foveasim.metrics.photon_transfer import (
    MIN_DARK_DN2,
    PhotonTransfer,
    SiteClasses,
    above_dark,
    codes_of,
    is_linear,
    photon_transfer,
    slopes,
)
from foveasim.sensor.adc import QUANTISATION_DN2

__all__ = ["Emva1288", "emva1288"]

#: Range of the linearity error in fractions of saturation.
LINEARITY_FRACTIONS = (0.05, 0.95)
#: Level of the PRNU in fractions of saturation.
PRNU_FRACTION = 0.5
#: Largest permitted fraction of dark codes that are clipped at 0.
MAX_UNDERFLOW_FRACTION = 0.005
#: Minimum number of points of a straight-line fit: exposures for the dark current, levels for the linearity error.
MIN_POINTS = 3


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
        dark-corrected mean; NaN if the estimated variance is negative.
    dark_current_e_per_s, dark_current_from_variance_e_per_s : (n_class,) float64, e-/s
        Dark current from the mean and from the variance of dark frames against exposure; NaN without a dark series.
    underflow_fraction : (n_class,) float64
        Fraction of dark codes that are 0.
    transfer, dark : PhotonTransfer
        Photon transfer curves of the frames and the dark frames.

    Notes
    -----
    The saturation is one of the given levels, so that its resolution is their spacing. A full well clips the fluctuations
    above it, so that the variance is highest approximately 2 standard deviations of the shot noise below the full well.
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
    dark_current_e_per_s: Floats
    dark_current_from_variance_e_per_s: Floats
    underflow_fraction: Floats
    transfer: PhotonTransfer
    dark: PhotonTransfer

    def __repr__(self) -> str:
        return f"Emva1288({self.transfer.n_frames.size} levels, {self.classes.size} classes)"

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per class, with all parameters of the class."""
        names = [f.name for f in fields(self) if f.name not in ("classes", "transfer", "dark")]
        derived = ("saturation_e", "threshold_e", "snr_max", "snr_max_db", "dynamic_range", "dynamic_range_db")
        columns = {name: np.asarray(getattr(self, name)).tolist() for name in (*names, *derived)}
        return [
            {"class": label, **{name: values[k] for name, values in columns.items()}}
            for k, label in enumerate(self.classes.tolist())
        ]

    def _repr_html_(self) -> str:
        from foveasim.view import to_html

        return to_html(self)

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
    frames: Sequence[Any],
    dark: Sequence[Any],
    photons: ArrayLike,
    *,
    classes: ArrayLike | None = None,
    dark_series: Sequence[Any] | None = None,
    exposure_s: ArrayLike | None = None,
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
        Expected photons per site at each level; they differ between sites of different size.
    classes : (n_site,), optional
        Class label of each site, such as its size or filter; a single class by default.
    dark_series : sequence of levels, optional
        Dark frames at three or more exposures ``exposure_s``, for the dark current and the dark noise at exposure 0.
    exposure_s : (n_exposure,) float64, s
        Exposure of each level of ``dark_series``.

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
        highest at the last level: the saturation, and the parameters derived from it, are underestimated.
    """
    for name, levels in (("frames", frames), ("dark", dark)):
        if not isinstance(levels, Iterable):
            raise ParameterError(name, f"must be a list of levels, got {type_name(levels)}")
    frames, dark = list(frames), list(dark)
    transfer = photon_transfer(frames, classes=classes)
    dark_transfer = photon_transfer(dark, classes=classes)
    groups = SiteClasses(classes, int(transfer.n_sites.sum()))
    mean_dn, variance_dn2 = above_dark(transfer, dark_transfer)
    level_ph = _photons(photons, groups, len(frames))
    i_saturation, i_class = transfer.saturation_level, np.arange(transfer.classes.size)
    n_at_end = np.count_nonzero(i_saturation == len(frames) - 1)
    if n_at_end:
        warn(
            f"the variance is highest at the last level for {n_at_end} of {i_saturation.size} classes: saturation is not "
            "reached and is underestimated; add levels of higher irradiance",
            FoveasimWarning,
        )
    saturation_dn = mean_dn[i_saturation, i_class]

    is_used = is_linear(mean_dn, i_saturation)
    gain_dn_per_e = slopes("frames", mean_dn, variance_dn2, is_used)
    responsivity = slopes("photons", level_ph, mean_dn, is_used)
    qe = responsivity / gain_dn_per_e

    dark_current, dark_current_from_variance, noise_dn2 = _dark_current(
        dark_series, exposure_s, classes, gain_dn_per_e, dark_transfer.temporal_variance_dn2[0]
    )
    dark_noise_dn = np.sqrt(np.maximum(noise_dn2, MIN_DARK_DN2))

    half = np.abs(mean_dn - PRNU_FRACTION * saturation_dn).argmin(axis=0)
    dark_half = np.minimum(half, dark_transfer.n_frames.size - 1)
    dark_spatial_dn2 = dark_transfer.spatial_variance_dn2[dark_half, i_class]
    bright_spatial_dn2 = transfer.spatial_variance_dn2[half, i_class] - dark_spatial_dn2
    linearity_min, linearity_max = _linearity(level_ph, mean_dn, saturation_dn)
    parameters: dict[str, NDArray[Any]] = {
        "classes": transfer.classes,
        "gain_dn_per_e": gain_dn_per_e,
        "responsivity_dn_per_ph": responsivity,
        "qe": qe,
        "dark_noise_dn": dark_noise_dn,
        "dark_noise_e": np.sqrt(dark_noise_dn**2 - QUANTISATION_DN2) / gain_dn_per_e,
        "is_quantisation_limited": noise_dn2 < MIN_DARK_DN2,
        "saturation_ph": level_ph[i_saturation, i_class],
        "threshold_ph": (dark_noise_dn / gain_dn_per_e + 0.5) / qe,
        "linearity_error_min_fraction": linearity_min,
        "linearity_error_max_fraction": linearity_max,
        "dsnu_e": _standard_deviation(dark_spatial_dn2) / gain_dn_per_e,
        "prnu_fraction": _standard_deviation(bright_spatial_dn2) / mean_dn[half, i_class],
        "dark_current_e_per_s": dark_current,
        "dark_current_from_variance_e_per_s": dark_current_from_variance,
        "underflow_fraction": _underflow_fraction(dark[0], groups),
    }
    return Emva1288(
        **{name: read_only(values) for name, values in parameters.items()}, transfer=transfer, dark=dark_transfer
    )


def _photons(photons: ArrayLike, groups: SiteClasses, n_levels: int) -> Floats:
    """Return the mean photons per site of each level and class, (n_level, n_class)."""
    values = finite_array("photons", photons, at_least=0.0)
    n_sites = int(groups.n_sites.sum())
    if values.shape == (n_levels,):
        level_ph = np.repeat(values[:, None], groups.n_sites.size, axis=1)
    elif values.shape == (n_levels, n_sites):
        level_ph = np.stack([groups.mean(level) for level in values])
    else:
        raise ParameterError("photons", f"must have shape ({n_levels},) or ({n_levels}, {n_sites})", values.shape)
    if np.any(np.diff(level_ph, axis=0) <= 0.0):
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

    Dark currents are (n_class,) in e-/s, variances (n_class,) in DN².
    """
    if dark_series is None and exposure_s is None:
        return np.full_like(gain_dn_per_e, np.nan), np.full_like(gain_dn_per_e, np.nan), noise_dn2
    if dark_series is None or exposure_s is None:
        raise ParameterError("dark_series", "must be given together with exposure_s")
    series = photon_transfer(dark_series, classes=classes)
    times_s = finite_array("exposure_s", exposure_s, ndim=1, at_least=0.0)
    if times_s.size != series.n_frames.size or np.unique(times_s).size < MIN_POINTS:
        raise ParameterError(
            "exposure_s",
            f"must have one exposure for each of {series.n_frames.size} levels, at least {MIN_POINTS} of them different",
            times_s.tolist(),
            "s",
        )
    off_s = times_s - times_s.mean()
    mean_slope = off_s @ series.mean_dn / (off_s @ off_s)
    variance_slope = off_s @ series.temporal_variance_dn2 / (off_s @ off_s)
    at_zero_dn2 = series.temporal_variance_dn2.mean(axis=0) - variance_slope * times_s.mean()
    return mean_slope / gain_dn_per_e, variance_slope / gain_dn_per_e**2, at_zero_dn2


def _linearity(level_ph: Floats, mean_dn: Floats, saturation_dn: Floats) -> tuple[Floats, Floats]:
    """Return the extreme relative deviations from a line fitted with weights 1 / signal²."""
    lowest, highest = np.full_like(saturation_dn, np.nan), np.full_like(saturation_dn, np.nan)
    for c, full_dn in enumerate(saturation_dn):
        y = mean_dn[:, c]
        level = np.arange(y.size)
        # From the first level above the lower limit to the last level below the upper one.
        is_above, is_below = y >= LINEARITY_FRACTIONS[0] * full_dn, y <= LINEARITY_FRACTIONS[1] * full_dn
        first = np.where(is_above, level, y.size).min()
        last = np.where(is_below, level, -1).max()
        chosen = slice(first, last + 1)
        x, y = level_ph[chosen, c], y[chosen]
        if y.size < MIN_POINTS or y.min() <= 0.0 or np.ptp(x) == 0.0:
            continue
        slope, offset = np.linalg.lstsq(np.column_stack((x / y, 1.0 / y)), np.ones(y.size), rcond=None)[0]
        deviation = y / (slope * x + offset) - 1.0
        lowest[c], highest[c] = deviation.min(), deviation.max()
    return lowest, highest


def _standard_deviation(variance_dn2: Floats) -> Floats:
    """Return the standard deviation in DN; NaN for a negative variance estimate."""
    return np.sqrt(np.where(variance_dn2 >= 0.0, variance_dn2, np.nan))


def _underflow_fraction(dark: Any, groups: SiteClasses) -> Floats:
    """Return the fraction of codes that are 0; warn if it is too large."""
    fraction = groups.mean((codes_of("dark[0]", dark) == 0).mean(axis=0))
    if fraction.max() > MAX_UNDERFLOW_FRACTION:
        warn(
            f"{100 * fraction.max():.1f} % of the dark codes are 0, which clips the noise: dark noise and DSNU are "
            "underestimated; raise the dark level above 0, for example by a pedestal",
            FoveasimWarning,
        )
    return fraction
