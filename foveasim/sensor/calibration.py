"""
Calibration: fixed patterns of a device from dark and flat frames, and their correction.

Terms follow EMVA Standard 1288, Release 4.0 Linear: dark signal and its non-uniformity, photo response non-uniformity,
temporal dark noise, defect pixels. All quantities refer to linear codes: companding is inverted first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FRACTION, POSITIVE, OwnCheck
from foveasim._core.validation import Bools, Floats, check_number, check_per_site, finite_array, own_arrays
from foveasim.errors import ParameterError, SimulationError
from foveasim.sensor.adc import QUANTISATION_DN2, interpolate_codes
from foveasim.sensor.effects import Photosites
from foveasim.sensor.limits import CHARGE, DURATION, EXPOSURE, FRAMES, RATIO
from foveasim.sensor.sensor import Sensor

__all__ = ["Calibration", "calibrate", "linearise", "nominal_e_per_dn"]

#: Ratio of the standard deviation of a Gaussian distribution to its median absolute deviation.
SIGMA_PER_MAD = 1.482602218505602
#: Probability that a site with typical noise is classified as noisy, for the given number of frames.
FALSE_ALARM_PROBABILITY = 1e-6
#: Maximum distance, in steps of adjacency, of the neighbours that replace a defective site.
MAX_FILL_STEPS = 3
NOISY_RATIO = replace(RATIO, at_least=1.0)


# -- inversion of the ADC transfer function ---------------------------------------------------------------------------


def linearise(code: ArrayLike, sensor: Sensor) -> Floats:
    """
    Convert codes to linear codes by inverting companding and integral nonlinearity.

    Parameters
    ----------
    code : (...), DN
        Codes of the sensor, of any shape: integers, or means of several frames, which are interpolated linearly.
    sensor : Sensor
        Only ``bits``, ``companding`` and ``inl_dn`` are used.

    Returns
    -------
    linear_dn : (...) float64, DN
        Centre of the voltage interval of each code, in linear codes; equal to the code for a linear ADC.

    Notes
    -----
    A linear code ``y`` corresponds to the voltage ``(y + 1/2) * v_sat_v / 2**bits``. Differential nonlinearity is not
    corrected because it is unknown for a real device. The response nonlinearity, ``nonlinearity_fraction``, is not corrected
    because it precedes the offsets.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=1, n_y=1, pitch_um=2.0), companding="root")
    >>> linearise([0, 128, 255], sensor).round(2).tolist()
    [-0.5, 64.0, 254.5]
    """
    return sensor.adc.linear_of_code_dn(code)


def nominal_e_per_dn(sensor: Sensor) -> Floats:
    """
    Return the electrons per linear code at zero charge, as the mean over devices.

    (n_site,) or (1,) float64, e-/DN.
    """
    transfer = sensor.readout_model(0.0, is_device_known=False).transfer
    return np.asarray(1.0 / transfer.linear_gain_dn_per_e(sensor.adc.n_codes))


# -- calibration ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Calibration:
    """
    Calibration of a device: offset, gain, noise and defects of each site.

    Created by :func:`calibrate`, or from measured frames by :meth:`from_frames`.

    Attributes
    ----------
    offset_dn : (n_site,) float64, DN
        Mean dark frame, in linear codes.
    gain : (n_site,) float64
        Relative response: (flat - dark) / ``expected_dn``, normalised to mean 1 over the sites that are neither defective nor
        clipped. A site with twice the area and twice the signal has gain 1 if ``expected_dn`` accounts for its area.
    read_noise_dn : (n_site,) float64, DN
        Temporal dark noise: standard deviation over the dark frames, including dark-current shot noise and quantisation.
    expected_dn : (n_site,) float64, DN
        Expected signal of the flat frames, up to a common factor.
    hot, dead, noisy : (n_site,) bool
        Sites with excessive dark signal, insufficient response, or excessive noise.
    clipped : (n_site,) bool
        Sites with code 0 in too many dark frames, or the highest code in too many flat frames. Their offset or gain is
        uncertain, and they are excluded from the mean. If there are many, increase the pedestal or reduce the flat signal.
    exposure_s : float, optional, s
        Exposure time of the dark frames, if known.
    dark_rate_dn_per_s : (n_site,) float64, optional, DN/s
        Dark signal per second, if there were dark frames of two exposure times.
    highest_dn : float, optional, DN
        Saturation code; None for no saturation test.
    linear_dn : (n_codes,) float64, optional, DN
        Linear code of each code; None if codes are linear.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=16, n_y=16, pitch_um=2.0)
    >>> sensor = fs.Sensor(
    ...     layout, prnu_fraction=0.05, capacitance_f=2e-15, bits=12, shot_noise="off"
    ... )
    >>> calibration = fs.sensor.calibrate(
    ...     sensor, exposure_s=0.1, flat_e=8000.0, n_frames=4, seed=1
    ... )
    >>> code = sensor.read(sensor.collect(sensor.response * 6000.0, seed=2), seed=2)
    >>> corrected_dn = calibration.correct(code)
    >>> (
    ...     round(float(code.std() / code.mean()), 3),
    ...     round(float(corrected_dn.std() / corrected_dn.mean()), 3),
    ... )
    (0.052, 0.001)
    """

    offset_dn: Floats
    gain: Floats
    read_noise_dn: Floats
    expected_dn: Floats
    hot: Bools
    dead: Bools
    noisy: Bools
    clipped: Bools
    exposure_s: float | None = None
    dark_rate_dn_per_s: Floats | None = None
    highest_dn: float | None = None
    linear_dn: Floats | None = None

    def __post_init__(self) -> None:
        own_arrays(self)

    def __repr__(self) -> str:
        return f"Calibration({self.n_sites} sites, {int(self.defective.sum())} defective, {int(self.clipped.sum())} clipped)"

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.offset_dn.size

    @property
    def defective(self) -> Bools:
        """Sites that are hot, dead or noisy, (n_site,)."""
        return self.hot | self.dead | self.noisy

    @classmethod
    def from_frames(
        cls,
        dark: ArrayLike,
        flat: ArrayLike,
        *,
        dark_long: ArrayLike | None = None,
        exposure_s: Annotated[float | None, EXPOSURE] = None,
        long_exposure_s: Annotated[float | None, DURATION] = None,
        expected_dn: ArrayLike = 1.0,
        expected_dark_dn_per_s: ArrayLike = 0.0,
        expected_noise_dn: ArrayLike = 1.0,
        highest_dn: Annotated[float | None, POSITIVE] = None,
        linear_dn: ArrayLike | None = None,
        hot_sigmas: Annotated[float, RATIO] = 6.0,
        dead_fraction: Annotated[float, FRACTION] = 0.5,
        noisy_ratio: Annotated[float, NOISY_RATIO] = 3.0,
        max_clipped_fraction: Annotated[float, FRACTION] = 0.005,
    ) -> Calibration:
        """
        Compute a calibration from measured or simulated frames.

        Parameters
        ----------
        dark, flat : (n_frame, n_site), DN
            Codes of at least two dark frames, and of at least one flat frame (uniform irradiance) of the same exposure time.
        dark_long : (n_frame, n_site), optional, DN
            Codes of dark frames of a longer exposure time, for the dark rate; requires ``exposure_s`` and ``long_exposure_s``.
        exposure_s, long_exposure_s : float, optional, s
        expected_dn : number or (n_site,), DN
            Expected signal of each site in the flat frames, up to a common factor: area times filter over capacitance.
            Expected differences do not count as fixed pattern and remain in corrected codes; with 1 all sites are equalised.
        expected_dark_dn_per_s : number or (n_site,), DN/s
            Nominal dark signal; hot sites are those in excess of it. Values other than 0 require ``exposure_s``.
        expected_noise_dn : number or (n_site,), DN
            Nominal temporal dark noise, up to a common factor.
        highest_dn : float, optional, DN
            Saturation code.
        linear_dn : (n_codes,), optional, DN
            Linear code of each code, for companding ADCs: ``linearise(np.arange(2**bits), sensor)``.
        hot_sigmas : float
            A site is hot if its dark signal, or dark rate, exceeds the median by this number of robust standard deviations.
        dead_fraction : float
            A site is dead if its response is below this fraction of the median.
        noisy_ratio : float
            A site is noisy if the ratio of its temporal dark noise to the typical noise exceeds this number, and the excess
            is statistically significant for the number of frames (false-alarm probability 1e-6).
        max_clipped_fraction : float
            Maximum fraction of the frames in which a site may be clipped.

        Raises
        ------
        SimulationError
            If the flat signal is not above the dark signal, more than half of the sites are saturated, or no site is free of
            defects.

        Notes
        -----
        With temporal variances ``d`` and ``f`` of a dark and a flat frame, a calibration from ``n`` frames of each leaves a
        residual fixed pattern of variance ``((1 - x)**2 d + x**2 f) / n`` in corrected codes, at a fraction x of the flat
        signal. The robust standard deviation is 1.4826 times the median absolute deviation, and at least that of rounding.
        """
        table = None if linear_dn is None else finite_array("linear_dn", linear_dn, ndim=1)

        def stack(name: str, frames: ArrayLike, at_least: int) -> _Frames:
            codes = finite_array(name, frames, ndim=2)
            if codes.shape[0] < at_least or codes.shape[1] == 0:
                raise ParameterError(
                    name,
                    f"must be at least {at_least} frame{'s' * (at_least > 1)} (n_frame, n_site), "
                    f"got the shape {codes.shape}",
                )
            found = _Frames(codes.shape[1], highest_dn, table)
            for frame in codes:
                try:
                    found.add(frame)
                except ParameterError as error:
                    raise ParameterError(name, error.detail) from None
            return found

        return _calibration(
            stack("dark", dark, 2),
            stack("flat", flat, 1),
            None if dark_long is None else stack("dark_long", dark_long, 1),
            _Thresholds(hot_sigmas, dead_fraction, noisy_ratio, max_clipped_fraction),
            exposure_s=exposure_s,
            long_exposure_s=long_exposure_s,
            expected_dn=expected_dn,
            expected_dark_dn_per_s=expected_dark_dn_per_s,
            expected_noise_dn=expected_noise_dn,
        )

    def offset_at(self, exposure_s: Annotated[float | None, EXPOSURE] = None) -> Floats:
        """
        Return the dark signal of an exposure time, (n_site,) DN.

        The exposure time of the calibration is the default.

        Raises
        ------
        SimulationError
            If the exposure time differs from that of the calibration, and the dark rate is unknown.
        """
        if exposure_s is None or exposure_s == self.exposure_s:
            return self.offset_dn
        if self.dark_rate_dn_per_s is None or self.exposure_s is None:
            raise SimulationError(
                f"the dark signal at {exposure_s:g} s is unknown; calibrate with dark frames of a second exposure time "
                "('long_exposure_s')"
            )
        return self.offset_dn + self.dark_rate_dn_per_s * (exposure_s - self.exposure_s)

    def correct(
        self,
        code: ArrayLike,
        *,
        exposure_s: float | None = None,
        fill: OwnCheck[Photosites | None] = None,
        kind: ArrayLike | None = None,
        max_gap_um: float | None = None,
    ) -> Floats:
        """
        Correct codes for offset and gain differences.

        Parameters
        ----------
        code : (..., n_site), DN
            Codes of the sensor, not linearised; not modified. With ``fill``, pass many frames in one call, as neighbours are
            determined once per call.
        exposure_s : float, optional, s
            Exposure time of the codes, if it differs from that of the calibration; requires a known dark rate.
        fill : Layout, optional
            Replace defective sites by the mean of their good neighbours, each relative to its expected signal. Sites without
            good neighbours use neighbours of neighbours, up to three steps. By default defective sites are not replaced.
        kind : (n_site,) of integers, optional
            Replace only from neighbours of the same kind, such as ``sensor.filter_of_site`` on a mosaic.
        max_gap_um : float, optional, µm
            Maximum width of gaps between neighbouring sites; by default neighbours share an edge.

        Returns
        -------
        corrected_dn : (..., n_site) float64, DN
            ``(linear code - offset) / gain``: 0 in dark frames. NaN for saturated codes, for a gain that is not above 0, and
            for defective sites without good neighbours.

        Raises
        ------
        SimulationError
            If no two sites of the layout are neighbours, or the dark signal of the exposure time is unknown.
        """
        codes = check_per_site("code", finite_array("code", code), self.n_sites, or_rows=True)
        linear_dn = codes if self.linear_dn is None else interpolate_codes(codes, self.linear_dn)
        is_usable = np.broadcast_to(self.gain > 0.0, codes.shape)
        if self.highest_dn is not None:
            is_usable = is_usable & (codes < self.highest_dn)
        gain = np.where(self.gain > 0.0, self.gain, 1.0)
        values = np.where(is_usable, (linear_dn - self.offset_at(exposure_s)) / gain, np.nan)
        if fill is None:
            return values
        return self._replace_defects(values.reshape(-1, self.n_sites), fill, kind, max_gap_um).reshape(codes.shape)

    def _replace_defects(
        self, values: Floats, layout: Photosites, kind: ArrayLike | None, max_gap_um: float | None
    ) -> Floats:
        """Replace defective sites in frames (n_frame, n_site) by their nearest good neighbours."""
        from scipy.sparse import csr_array

        if not hasattr(layout, "adjacency") or layout.n_sites != self.n_sites:
            raise ParameterError("fill", f"must be the layout of these {self.n_sites} sites", layout)
        kinds = None if kind is None else check_per_site("kind", finite_array("kind", kind), self.n_sites)
        bad = np.flatnonzero(self.defective)
        if bad.size == 0:
            return values
        neighbours = csr_array(layout.adjacency(max_gap_um=max_gap_um)).astype(np.bool_)
        if neighbours.nnz == 0:
            raise SimulationError(
                "no two sites of the layout share an edge, so defective sites have no neighbours; for sites separated by "
                "trenches, set 'max_gap_um' to the trench width"
            )
        is_good = np.isfinite(values) & ~self.defective
        relative = np.where(is_good, values / self.expected_dn, 0.0).T
        replacements = np.full((bad.size, values.shape[0]), np.nan)
        reachable = neighbours[bad]
        for _ in range(MAX_FILL_STEPS):
            usable = reachable.copy()
            if kinds is not None:
                kinds_of_bad = np.repeat(kinds[bad], np.diff(usable.indptr))
                usable.data = kinds_of_bad == kinds[usable.indices]
            count = usable @ is_good.T.astype(np.float64)
            mean = (usable @ relative) / np.where(count > 0.0, count, 1.0)
            replacements = np.where(np.isnan(replacements) & (count > 0.0), mean, replacements)
            if not np.isnan(replacements).any():
                break
            reachable = reachable @ neighbours + reachable
        values[:, bad] = replacements.T * self.expected_dn[bad]
        return values


def calibrate(
    sensor: Sensor,
    *,
    exposure_s: Annotated[float, DURATION],
    flat_e: ArrayLike,
    n_frames: Annotated[int, replace(FRAMES, at_least=2)],
    seed: int,
    long_exposure_s: Annotated[float | None, DURATION] = None,
    hot_sigmas: Annotated[float, RATIO] = 6.0,
    dead_fraction: Annotated[float, FRACTION] = 0.5,
    noisy_ratio: Annotated[float, NOISY_RATIO] = 3.0,
    max_clipped_fraction: Annotated[float, FRACTION] = 0.005,
    n_threads: int | None = None,
) -> Calibration:
    """
    Simulate dark and flat frames of a sensor, and compute its calibration.

    Parameters
    ----------
    sensor : Sensor
    exposure_s : float, s
        Exposure time of dark and flat frames.
    flat_e : number or (n_site,), e-
        Expected photoelectrons of each site in the flat frames without non-uniformity, proportional to area and filter where
        sites differ. About half of the range is suitable.
    n_frames : int
        Number of dark frames and of flat frames, at least 2.
    seed : int
        Seed of the temporal noise.
    long_exposure_s : float, optional, s
        Exposure time of additional dark frames, for the dark rate.
    hot_sigmas, dead_fraction, noisy_ratio, max_clipped_fraction : float
        See :meth:`Calibration.from_frames`.
    n_threads : int, optional
        Number of threads; all cores by default. The frames do not depend on it.

    Returns
    -------
    Calibration
        The gain is relative to the mean response of all devices to ``flat_e``, without defects: sensitivities, capacitances,
        crosstalk, inter-pixel capacitance and other effects common to all devices are part of the expectation, and remain in
        corrected codes.

    Raises
    ------
    SimulationError
        If the flat frames saturate more than half of the sites, or no site is free of defects.

    Notes
    -----
    Frames are processed one at a time; memory is a few arrays of the size of a frame for any number of frames.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0),
    ...     prnu_fraction=0.05,
    ...     dark_e_per_s=2e4,
    ...     bits=12,
    ...     capacitance_f=2e-15,
    ... )
    >>> calibration = calibrate(sensor, exposure_s=0.1, flat_e=15000.0, n_frames=50, seed=1)
    >>> bool(
    ...     np.abs(calibration.gain * sensor.response.mean() / sensor.response - 1.0).max()
    ...     < 0.01
    ... )
    True
    """
    n_sites = sensor.layout.n_sites
    flat = np.ascontiguousarray(_one_or_per_site("flat_e", CHARGE.check_array("flat_e", flat_e), n_sites, above=0.0))
    zero_e = np.zeros(n_sites)
    # Noisy sites are those with more noise than sites without defects.
    dark, lit = (sensor.linearise_without_defects(photo_e / exposure_s, exposure_s) for photo_e in (zero_e, flat))
    dn_per_e = dark.linear_gain_dn_per_e
    table = None if sensor.adc.is_linear else sensor.adc.linear_dn

    def frames(photo_e: Floats, exposure_s: float, kind: int) -> _Frames:
        stack = _Frames(n_sites, 2.0**sensor.bits - 1.0, table)
        expected_e = sensor.expected_electrons(photo_e / exposure_s, exposure_s)
        for frame in range(kind * n_frames, (kind + 1) * n_frames):
            electrons = sensor.collect(expected_e, seed=seed, frame=frame, exposure_s=exposure_s, n_threads=n_threads)
            stack.add(sensor.read(electrons, seed=seed, frame=frame, n_threads=n_threads))
        return stack

    if long_exposure_s is not None:
        check_number("long_exposure_s", long_exposure_s, above=exposure_s)
    return _calibration(
        frames(zero_e, exposure_s, 0),
        frames(flat, exposure_s, 1),
        None if long_exposure_s is None else frames(zero_e, long_exposure_s, 2),
        _Thresholds(hot_sigmas, dead_fraction, noisy_ratio, max_clipped_fraction),
        exposure_s=exposure_s,
        long_exposure_s=long_exposure_s,
        expected_dn=(lit.node_e - dark.node_e) * dn_per_e,
        expected_dark_dn_per_s=dark.node_e * dn_per_e / exposure_s,
        expected_noise_dn=np.sqrt(dark.variance_e2()) * dn_per_e,
    )


# -- helpers ----------------------------------------------------------------------------------------------------------


class _Thresholds(NamedTuple):
    """Thresholds for defective and clipped sites: see :meth:`Calibration.from_frames`."""

    hot_sigmas: float
    dead_fraction: float
    noisy_ratio: float
    max_clipped_fraction: float


class _Frames:
    """Running mean, variance (Welford's algorithm) and clipping counts of linear codes."""

    def __init__(self, n_sites: int, highest_dn: float | None, linear_dn: Floats | None) -> None:
        self.highest_dn = highest_dn
        self.linear_dn = linear_dn
        self.n_frames = 0
        self.mean_dn, self.squares_dn2 = np.zeros(n_sites), np.zeros(n_sites)
        self.n_lowest, self.n_highest = np.zeros(n_sites, np.int64), np.zeros(n_sites, np.int64)

    def add(self, code: NDArray[Any]) -> None:
        self.n_frames += 1
        table = self.linear_dn
        linear_dn = code.astype(np.float64) if table is None else interpolate_codes(code, table)
        off_dn = linear_dn - self.mean_dn
        self.mean_dn += off_dn / self.n_frames
        self.squares_dn2 += off_dn * (linear_dn - self.mean_dn)
        self.n_lowest += code <= 0
        if self.highest_dn is not None:
            self.n_highest += code >= self.highest_dn


def _calibration(
    dark: _Frames,
    flat: _Frames,
    dark_long: _Frames | None,
    thresholds: _Thresholds,
    *,
    exposure_s: float | None,
    long_exposure_s: float | None,
    expected_dn: ArrayLike,
    expected_dark_dn_per_s: ArrayLike,
    expected_noise_dn: ArrayLike,
) -> Calibration:
    n_sites = dark.mean_dn.size
    for name, stack in (("flat", flat), ("dark_long", dark_long)):
        if stack is not None and stack.mean_dn.size != n_sites:
            raise ParameterError(name, f"must have the {n_sites} sites of the dark frames, got {stack.mean_dn.size}")
    expected = _one_or_per_site("expected_dn", expected_dn, n_sites, above=0.0)
    expected_rate = _one_or_per_site("expected_dark_dn_per_s", expected_dark_dn_per_s, n_sites, above=None)
    expected_noise = _one_or_per_site("expected_noise_dn", expected_noise_dn, n_sites, above=0.0)
    if exposure_s is None and (dark_long is not None or expected_rate.any()):
        raise ParameterError("exposure_s", "must be given with 'dark_long' or 'expected_dark_dn_per_s'", None)
    if (dark_long is None) != (long_exposure_s is None):
        raise ParameterError("long_exposure_s", "must be given if and only if 'dark_long' is", long_exposure_s)

    is_saturated = flat.n_highest > thresholds.max_clipped_fraction * flat.n_frames
    if is_saturated.mean() > 0.5:
        raise SimulationError(
            f"the flat frames saturate {100 * is_saturated.mean():.0f} % of the sites, so their response is unknown; reduce "
            "the flat signal"
        )
    is_clipped = is_saturated | (dark.n_lowest > thresholds.max_clipped_fraction * dark.n_frames)
    response = (flat.mean_dn - dark.mean_dn) / expected
    typical = float(np.median(response[~is_saturated]))
    if not typical > 0.0:
        raise SimulationError(
            "the flat signal is not above the dark signal, so the response is unknown; increase the flat signal"
        )

    rounding_dn = np.sqrt(QUANTISATION_DN2)
    is_hot = _find_outliers(dark.mean_dn - expected_rate * (exposure_s or 0.0), thresholds.hot_sigmas, rounding_dn)
    rate: Floats | None = None
    if dark_long is not None and exposure_s is not None:
        longer_s = check_number("long_exposure_s", long_exposure_s, above=exposure_s) - exposure_s
        rate = (dark_long.mean_dn - dark.mean_dn) / longer_s
        is_hot |= _find_outliers(rate - expected_rate, thresholds.hot_sigmas, rounding_dn / longer_s)
    is_dead = (response < thresholds.dead_fraction * typical) & ~is_saturated
    noise_dn = np.sqrt(dark.squares_dn2 / (dark.n_frames - 1))
    is_noisy = _find_noisy(noise_dn, expected_noise, _rounding_dn(dark), dark.n_frames, thresholds.noisy_ratio)
    is_good = ~(is_hot | is_dead | is_noisy | is_clipped)
    if not is_good.any():
        # Without a pedestal all sites clip in dark frames; the mean is then over all sites that are not defective.
        is_good = ~(is_hot | is_dead | is_noisy | is_saturated)
    if not is_good.any():
        raise SimulationError("no site is free of defects, so the mean response is undefined; relax the thresholds")
    return Calibration(
        offset_dn=dark.mean_dn,
        gain=response / float(response[is_good].mean()),
        read_noise_dn=noise_dn,
        expected_dn=np.array(expected),
        hot=is_hot,
        dead=is_dead,
        noisy=is_noisy,
        clipped=is_clipped,
        exposure_s=exposure_s,
        dark_rate_dn_per_s=rate,
        highest_dn=dark.highest_dn,
        linear_dn=dark.linear_dn,
    )


def _find_outliers(values: Floats, hot_sigmas: float, smallest_dn: float) -> Bools:
    """Return the mask of values above the median by many robust standard deviations."""
    median = np.median(values)
    sigma = max(SIGMA_PER_MAD * float(np.median(np.abs(values - median))), float(smallest_dn))
    return np.asarray(values > median + hot_sigmas * sigma)


def _find_noisy(noise_dn: Floats, expected_dn: Floats, rounding_dn: Floats, n_frames: int, noisy_ratio: float) -> Bools:
    """
    Return the mask of sites whose temporal noise is above the typical noise.

    Both the ratio of standard deviations and the statistical significance of the excess are tested.
    """
    from scipy.stats import chi2

    n_free = n_frames - 1
    typical = float(np.median((noise_dn / expected_dn) ** 2)) * n_free / float(chi2.median(n_free))
    max_chance_ratio = float(chi2.isf(FALSE_ALARM_PROBABILITY, n_free)) / n_free
    return np.asarray(
        noise_dn**2 > max(noisy_ratio**2, max_chance_ratio) * np.maximum(typical * expected_dn**2, rounding_dn**2)
    )


def _rounding_dn(frames: _Frames) -> Floats:
    """Return the standard deviation of rounding at each site's mean code, by the code spacing."""
    table = frames.linear_dn
    if table is None or table.size < 2:
        return np.sqrt([QUANTISATION_DN2])
    return np.interp(frames.mean_dn, table, np.gradient(table)) * np.sqrt(QUANTISATION_DN2)


def _one_or_per_site(name: str, values: ArrayLike, n_sites: int, *, above: float | None) -> Floats:
    array = finite_array(name, values, above=above)
    if array.shape != (1,):
        check_per_site(name, array, n_sites, or_one=True)
    return np.broadcast_to(array, n_sites)
