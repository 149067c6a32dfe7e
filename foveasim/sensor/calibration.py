"""
Calibration: a device's fixed patterns from dark and flat frames, and codes without them.

Terms follow EMVA Standard 1288, Release 4.0 Linear: dark signal and its non-uniformity, photo response non-uniformity,
temporal dark noise, defect pixels. Codes are linear: what a companding converter made of them is undone first.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.random_streams import Streams
from foveasim._core.validation import Bools, Floats, as_numbers, check_count, check_number, finite_array, own, unmasked
from foveasim.errors import ParameterError, SimulationError
from foveasim.sensor.adc import QUANTISATION_DN2
from foveasim.sensor.effects.crosstalk import Neighbourhood
from foveasim.sensor.limits import check_plausible, check_plausible_array
from foveasim.sensor.sensor import Sensor
from foveasim.units import volts_to_electrons

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["Calibration", "calibrate", "linearise", "nominal_e_per_dn"]

#: Standard deviation of a Gaussian distribution over its median absolute deviation.
SIGMA_PER_MAD = 1.482602218505602
#: Chance that a site of typical noise is taken for a noisy one, in frames as few as there are.
FALSE_ALARM = 1e-6
#: A defective site's value comes from neighbours at most so many steps away.
FURTHEST_STEPS = 3


# -- the converter, the other way -------------------------------------------------------------------------------------


def linearise(code: ArrayLike, sensor: Sensor) -> Floats:
    """
    Codes that a linear converter would have given.

    Parameters
    ----------
    code : (...), DN
        Codes of the sensor, in any shape, whole or means of several; what lies between two codes is taken on a straight line.
    sensor : Sensor
        Its ``bits``, ``companding`` and ``inl_dn`` count.

    Returns
    -------
    linear_dn : (...) float64, DN
        The middle of the voltages that a code stands for, in linear codes: the code itself where the converter is linear.

    Raises
    ------
    ParameterError
        When a code is none of the sensor's, or the second argument is no sensor.

    Notes
    -----
    A linear code ``y`` stands for ``(y + 1/2) * v_sat_v / 2**bits``. Differential non-linearity is not undone, as it is not
    known to a user; nor is the response's bend, ``nonlinearity_fraction``, which comes before the offsets.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=1, n_y=1, pitch_um=2.0), companding="root")
    >>> linearise([0, 128, 255], sensor).round(2).tolist()
    [-0.5, 64.0, 254.5]
    """
    _require_sensor(sensor)
    return _interpolate(code, sensor.converter.linear_dn, 2.0**sensor.bits - 1.0)


def nominal_e_per_dn(sensor: Sensor) -> Floats:
    """Electrons of one linear code as the electronics are meant, without the device's faults, (n_site,) or (1,) e-/DN."""
    return np.atleast_1d(volts_to_electrons(sensor.v_sat_v / 2.0**sensor.bits, np.asarray(sensor.capacitance_f)))


def _interpolate(code: ArrayLike, linear_dn: Floats, highest_dn: float) -> Floats:
    values = finite_array("code", code, at_least=0.0)
    if values.size and values.max() > highest_dn:
        raise ParameterError("code", f"must be <= {highest_dn:g} everywhere", float(values.max()), "DN")
    return np.interp(values, np.arange(linear_dn.size), linear_dn)


# -- a calibration ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Calibration:
    """
    What dark and flat frames tell of a device, site by site.

    Made by :func:`calibrate`, or of measured frames by :meth:`from_frames`.

    Attributes
    ----------
    offset_dn : (n_site,) float64, DN
        Mean dark frame, in linear codes.
    gain : (n_site,) float64
        Relative response: flat less dark over ``expected_dn``, of mean 1 over the sites that are neither defective nor clipped.
        A site of twice the area that gives twice the signal has the gain 1, when it was expected to.
    read_noise_dn : (n_site,) float64, DN
        Temporal dark noise: standard deviation of the dark frames in time, with that of dark charge and of rounding.
    expected_dn : (n_site,) float64, DN
        What the flat was to give, up to a common factor.
    hot, dead, noisy : (n_site,) bool
        Sites with too much dark signal, too little response, too much noise.
    clipped : (n_site,) bool
        Sites with codes of 0 in the dark, or the highest one in the flat, in too many frames: their offset or gain is not known
        well, and they have no part in the mean. When these are many, give the sensor a pedestal, or the flat less light.
    exposure_s : float, optional, s
        Exposure of the dark frames, where it is known.
    dark_rate_dn_per_s : (n_site,) float64, optional, DN/s
        Dark signal of a second, where there were dark frames of two exposures.
    highest_dn : float, optional, DN
        The code that means saturation; None for no test.
    linear_dn : (n_codes,) float64, optional, DN
        Linear code of every code; None where codes are linear.
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
        for field in fields(self):
            values = getattr(self, field.name)
            if isinstance(values, np.ndarray):
                object.__setattr__(self, field.name, own(np.asarray(unmasked(field.name, values))))

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
        exposure_s: float | None = None,
        long_exposure_s: float | None = None,
        expected_dn: ArrayLike = 1.0,
        expected_dark_dn_per_s: ArrayLike = 0.0,
        expected_noise_dn: ArrayLike = 1.0,
        highest_dn: float | None = None,
        linear_dn: ArrayLike | None = None,
        hot_sigmas: float = 6.0,
        dead_fraction: float = 0.5,
        noisy_ratio: float = 3.0,
        max_clipped_fraction: float = 0.005,
    ) -> Calibration:
        """
        Calibration of frames that were measured, or of simulated ones.

        Parameters
        ----------
        dark, flat : (n_frame, n_site), DN
            Codes in the dark, at least two frames, and under even light, at least one; of the same exposure.
        dark_long : (n_frame, n_site), optional, DN
            Codes in the dark of a longer exposure, for the dark rate; with it go ``exposure_s`` and ``long_exposure_s``.
        exposure_s, long_exposure_s : float, optional, s
        expected_dn : number or (n_site,), DN
            What each site is to give under the flat's light, up to a common factor: area times filter over capacitance. What is
            in it is not taken for a fixed pattern, and is left in corrected codes; with 1 all sites are made alike.
        expected_dark_dn_per_s : number or (n_site,), DN/s
            Dark signal as it was meant; hot sites are those with more. With other than 0 goes ``exposure_s``.
        expected_noise_dn : number or (n_site,), DN
            Temporal dark noise as it was meant, up to a common factor.
        highest_dn : float, optional, DN
            The code that means saturation.
        linear_dn : (n_codes,), optional, DN
            Linear code of every code, for companding converters: ``linearise(np.arange(2**bits), sensor)``.
        hot_sigmas : float
            A site is hot when its dark signal, or dark rate, is so many robust standard deviations above the median.
        dead_fraction : float
            A site is dead when its response is below this fraction of the median.
        noisy_ratio : float
            A site is noisy when its temporal dark noise is so many times the typical one, and by more than the luck of so
            few frames: one typical site in a million.
        max_clipped_fraction : float
            Fraction of the frames that a site may be clipped in.

        Returns
        -------
        Calibration

        Raises
        ------
        ParameterError
            When frames have not the same sites, are too few, or a value is out of range.
        SimulationError
            When the flat is no brighter than the dark, saturates half of the sites, or leaves no good site.

        Notes
        -----
        With temporal variances ``d`` and ``f`` of a dark and a flat frame, ``n`` frames of each leave on corrected codes, at
        a share x of the flat's signal, a fixed pattern of variance ``((1 - x)**2 d + x**2 f) / n``. The robust standard
        deviation is 1.4826 times the median absolute deviation, and no less than that of rounding.
        """
        table = None if linear_dn is None else finite_array("linear_dn", linear_dn, ndim=1)
        stacks = {"dark": _Frames(highest_dn, table), "flat": _Frames(highest_dn, table)}
        for name, frames, at_least in (("dark", dark, 2), ("flat", flat, 1)):
            stacks[name].add_all(name, _stack(name, frames, at_least))
        stack_long = None
        if dark_long is not None:
            stack_long = _Frames(highest_dn, table)
            stack_long.add_all("dark_long", _stack("dark_long", dark_long, 1))
        return _calibration(
            stacks["dark"],
            stacks["flat"],
            stack_long,
            exposure_s=exposure_s,
            long_exposure_s=long_exposure_s,
            expected_dn=expected_dn,
            expected_dark_dn_per_s=expected_dark_dn_per_s,
            expected_noise_dn=expected_noise_dn,
            hot_sigmas=hot_sigmas,
            dead_fraction=dead_fraction,
            noisy_ratio=noisy_ratio,
            max_clipped_fraction=max_clipped_fraction,
        )

    def offset_at(self, exposure_s: float | None = None) -> Floats:
        """
        Dark signal of an exposure, (n_site,) DN; of the calibration's own by default.

        Raises
        ------
        ParameterError
            When the exposure is negative.
        SimulationError
            When it is another than the calibration's, and the dark rate is not known.
        """
        if exposure_s is None:
            return self.offset_dn
        exposure_s = check_plausible("exposure_s", exposure_s)
        if exposure_s == self.exposure_s:
            return self.offset_dn
        if self.dark_rate_dn_per_s is None or self.exposure_s is None:
            raise SimulationError(
                f"the dark signal of {exposure_s:g} s is not known; calibrate with dark frames of a second exposure "
                "('long_exposure_s')"
            )
        return self.offset_dn + self.dark_rate_dn_per_s * (exposure_s - self.exposure_s)

    def correct(
        self,
        code: ArrayLike,
        *,
        exposure_s: float | None = None,
        fill: Neighbourhood | None = None,
        kind: ArrayLike | None = None,
        max_gap_um: float | None = None,
    ) -> Floats:
        """
        Codes without offsets and differences of gain.

        Parameters
        ----------
        code : (..., n_site), DN
            As the sensor gives them, not linearise; not changed. One call for many frames looks for neighbours once.
        exposure_s : float, optional, s
            Of these codes, when it is not that of the calibration and the dark rate is known.
        fill : Layout, optional
            Give defective sites the mean of their good neighbours, each taken relative to what it is expected to give; where a
            site has none, of neighbours of neighbours, up to three steps. By default they keep their own, corrected.
        kind : (n_site,) of integers, optional
            Fill from neighbours of the same kind only: ``sensor.filter_of_site`` on a mosaic.
        max_gap_um : float, optional, µm
            Sites that face each other across a gap of up to this width are neighbours; by default those that share an edge.

        Returns
        -------
        corrected_dn : (..., n_site) float64, DN
            ``(linear code - offset) / gain``: 0 in the dark. NaN where the code is saturated, where the gain is not above 0,
            and where there is nothing to fill from.

        Raises
        ------
        ParameterError
            When there is not one code a site, or one is out of range.
        SimulationError
            When no two sites of the layout are neighbours, or the exposure's dark signal is not known.
        """
        codes = _per_site("code", code, self.n_sites)
        linear_dn = codes if self.linear_dn is None else _interpolate(codes, self.linear_dn, self.linear_dn.size - 1.0)
        is_usable = np.broadcast_to(self.gain > 0.0, codes.shape)
        if self.highest_dn is not None:
            is_usable = is_usable & (codes < self.highest_dn)
        gain = np.where(self.gain > 0.0, self.gain, 1.0)
        values = np.where(is_usable, (linear_dn - self.offset_at(exposure_s)) / gain, np.nan)
        if fill is None:
            return values
        return self._filled(values.reshape(-1, self.n_sites), fill, kind, max_gap_um).reshape(codes.shape)

    def _filled(
        self, values: Floats, layout: Neighbourhood, kind: ArrayLike | None, max_gap_um: float | None
    ) -> Floats:
        """Frames (n_frame, n_site) with defective sites taken from the nearest good ones."""
        if not hasattr(layout, "adjacency") or layout.n_sites != self.n_sites:
            raise ParameterError("fill", f"must be the layout of these {self.n_sites} sites", layout)
        kinds = None if kind is None else finite_array("kind", kind, ndim=1)
        if kinds is not None and kinds.size != self.n_sites:
            raise ParameterError("kind", f"must be one number for each of the {self.n_sites} sites, got {kinds.size}")
        bad = np.flatnonzero(self.defective)
        if bad.size == 0:
            return values
        neighbours = _pattern(layout.adjacency(max_gap_um=max_gap_um))
        if neighbours.nnz == 0:
            raise SimulationError(
                "no two sites of the layout share an edge, so nothing can be filled; for sites behind trenches give "
                "'max_gap_um', the width of a trench"
            )
        is_good = np.isfinite(values) & ~self.defective
        relative = np.where(is_good, values / self.expected_dn, 0.0).T
        found = np.full((bad.size, values.shape[0]), np.nan)
        within = _pattern(neighbours[bad])
        for _ in range(FURTHEST_STEPS):
            near = within.copy()
            if kinds is not None:
                of_bad = np.repeat(kinds[bad], np.diff(near.indptr))
                near.data = (of_bad == kinds[near.indices]).astype(np.float64)
            count = near @ is_good.T.astype(np.float64)
            mean = (near @ relative) / np.where(count > 0.0, count, 1.0)
            found = np.where(np.isnan(found) & (count > 0.0), mean, found)
            if not np.isnan(found).any():
                break
            within = _pattern(within @ neighbours + within)
        values[:, bad] = found.T * self.expected_dn[bad]
        return values


def calibrate(
    sensor: Sensor,
    *,
    exposure_s: float,
    flat_e: ArrayLike,
    n_frames: int,
    seed: int,
    long_exposure_s: float | None = None,
    hot_sigmas: float = 6.0,
    dead_fraction: float = 0.5,
    noisy_ratio: float = 3.0,
    max_clipped_fraction: float = 0.005,
    n_threads: int | None = None,
) -> Calibration:
    """
    Take dark and flat frames with a sensor, and calibrate it.

    Parameters
    ----------
    sensor : Sensor
    exposure_s : float, s
        Of both kinds of frames.
    flat_e : number or (n_site,), e-
        Photoelectrons that the flat light is to give each site, before the device's non-uniformity: in proportion to area and
        filter where sites differ. About half of the range is right.
    n_frames : int
        Of each kind, at least 2.
    seed : int
        Of the frames' noise.
    long_exposure_s : float, optional, s
        Exposure of further dark frames, for the dark rate.
    hot_sigmas, dead_fraction, noisy_ratio, max_clipped_fraction : float
        See :meth:`Calibration.from_frames`.
    n_threads : int, optional
        All cores by default. The frames do not depend on it.

    Returns
    -------
    Calibration
        Its gain is against what the electronics were meant to give of ``flat_e``: capacitances, crosstalk and coupling of the
        sensor's settings are expected, and are left in corrected codes.

    Raises
    ------
    ParameterError
        When a value is out of range, or there is not one expectation a site.
    SimulationError
        When the flat saturates half of the sites, or leaves no good site.

    Notes
    -----
    Frames are taken one after the other; memory is a few arrays of a frame's size, whatever their number.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0), prnu_fraction=0.05, dark_e_per_s=2e4, bits=12, capacitance_f=2e-15
    ... )
    >>> calibration = calibrate(sensor, exposure_s=0.1, flat_e=15000.0, n_frames=50, seed=1)
    >>> bool(np.abs(calibration.gain * sensor.response.mean() / sensor.response - 1.0).max() < 0.01)
    True
    """
    _require_sensor(sensor)
    exposure_s = check_plausible("exposure_s", check_number("exposure_s", exposure_s, above=0.0))
    n_frames = check_count("n_frames", n_frames, at_least=2)
    n_sites = sensor.layout.n_sites
    flat = np.ascontiguousarray(_one_or_per_site("flat_e", check_plausible_array("flat_e", flat_e), n_sites, above=0.0))
    meant = sensor.nominal()
    darkness = np.zeros(n_sites)
    dark_e = meant.expected_electrons(darkness, exposure_s)
    signal_e = meant.expected_electrons(flat / exposure_s, exposure_s) - dark_e
    # RTS noise is a defect, which makes a site noisy: not part of what is meant.
    quiet = meant.without(*(effect.name for effect in meant.chain if effect.half_step(meant.sites) is not None))
    dark_e2 = dark_e if sensor.shot.is_drawn else np.zeros(1)
    noise_e2 = dark_e2 + quiet.readout_model(dark_e).noise_e2
    signal_e, dark_e = (meant.readout_model(part).mean_e for part in (signal_e, dark_e))
    e_per_dn = nominal_e_per_dn(sensor)
    table = None if sensor.companding == "linear" and not sensor.inl_dn else sensor.converter.linear_dn

    def frames(light_e: Floats, exposure_s: float, kind: int) -> _Frames:
        stack = _Frames(2.0**sensor.bits - 1.0, table)
        expected_e = sensor.expected_electrons(light_e / exposure_s, exposure_s)
        for frame in range(kind * n_frames, (kind + 1) * n_frames):
            streams = Streams(seed, frame)
            electrons = sensor.collect(expected_e, streams=streams, n_threads=n_threads)
            stack.add(sensor.read(electrons, streams=streams, n_threads=n_threads))
        return stack

    if long_exposure_s is not None:
        check_plausible("long_exposure_s", long_exposure_s)
        long_exposure_s = check_number("long_exposure_s", long_exposure_s, above=exposure_s)
    return _calibration(
        frames(darkness, exposure_s, 0),
        frames(flat, exposure_s, 1),
        None if long_exposure_s is None else frames(darkness, long_exposure_s, 2),
        exposure_s=exposure_s,
        long_exposure_s=long_exposure_s,
        expected_dn=signal_e / e_per_dn,
        expected_dark_dn_per_s=dark_e / e_per_dn / exposure_s,
        expected_noise_dn=np.sqrt(noise_e2 / e_per_dn**2 + QUANTISATION_DN2),
        hot_sigmas=hot_sigmas,
        dead_fraction=dead_fraction,
        noisy_ratio=noisy_ratio,
        max_clipped_fraction=max_clipped_fraction,
    )


# -- parts ------------------------------------------------------------------------------------------------------------


class _Frames:
    """Mean and variance of linear codes over frames, one frame at a time (Welford's sums), and how often they clip."""

    def __init__(self, highest_dn: float | None, linear_dn: Floats | None) -> None:
        self.highest_dn = None if highest_dn is None else check_number("highest_dn", highest_dn, above=0.0)
        self.linear_dn = linear_dn
        self.n_frames = 0
        self.mean_dn = self.squares_dn2 = np.zeros(0)
        self.n_lowest = self.n_highest = np.zeros(0, np.int64)

    def add(self, code: NDArray[Any]) -> None:
        if self.n_frames == 0:
            self.mean_dn, self.squares_dn2 = np.zeros(code.size), np.zeros(code.size)
            self.n_lowest, self.n_highest = np.zeros(code.size, np.int64), np.zeros(code.size, np.int64)
        self.n_frames += 1
        table = self.linear_dn
        linear_dn = code.astype(np.float64) if table is None else _interpolate(code, table, table.size - 1.0)
        off_dn = linear_dn - self.mean_dn
        self.mean_dn += off_dn / self.n_frames
        self.squares_dn2 += off_dn * (linear_dn - self.mean_dn)
        self.n_lowest += code <= 0
        if self.highest_dn is not None:
            self.n_highest += code >= self.highest_dn

    def add_all(self, name: str, frames: Iterable[NDArray[Any]]) -> None:
        for frame in frames:
            try:
                self.add(frame)
            except ParameterError as error:
                raise ParameterError(name, error.detail) from None


def _calibration(
    dark: _Frames,
    flat: _Frames,
    dark_long: _Frames | None,
    *,
    exposure_s: float | None,
    long_exposure_s: float | None,
    expected_dn: ArrayLike,
    expected_dark_dn_per_s: ArrayLike,
    expected_noise_dn: ArrayLike,
    hot_sigmas: float,
    dead_fraction: float,
    noisy_ratio: float,
    max_clipped_fraction: float,
) -> Calibration:
    n_sites = dark.mean_dn.size
    for name, stack in (("flat", flat), ("dark_long", dark_long)):
        if stack is not None and stack.mean_dn.size != n_sites:
            raise ParameterError(name, f"must have the {n_sites} sites of the dark frames, got {stack.mean_dn.size}")
    hot_sigmas = check_plausible("hot_sigmas", hot_sigmas)
    dead_fraction = check_number("dead_fraction", dead_fraction, at_least=0.0, at_most=1.0)
    noisy_ratio = check_plausible("noisy_ratio", check_number("noisy_ratio", noisy_ratio, at_least=1.0))
    most_clipped = check_number("max_clipped_fraction", max_clipped_fraction, at_least=0.0, at_most=1.0)
    expected = _one_or_per_site("expected_dn", expected_dn, n_sites, above=0.0)
    meant_rate = _one_or_per_site("expected_dark_dn_per_s", expected_dark_dn_per_s, n_sites, above=None)
    meant_noise = _one_or_per_site("expected_noise_dn", expected_noise_dn, n_sites, above=0.0)
    if exposure_s is not None:
        exposure_s = check_plausible("exposure_s", exposure_s)
    elif dark_long is not None or meant_rate.any():
        raise ParameterError("exposure_s", "must be given with a second exposure or an expected dark signal", None)
    if (dark_long is None) != (long_exposure_s is None):
        raise ParameterError("long_exposure_s", "and 'dark_long' belong together", long_exposure_s)

    is_saturated = flat.n_highest > most_clipped * flat.n_frames
    if is_saturated.mean() > 0.5:
        raise SimulationError(
            f"the flat saturates {100 * is_saturated.mean():.0f} % of the sites, so their response is unknown; take less light"
        )
    is_clipped = is_saturated | (dark.n_lowest > most_clipped * dark.n_frames)
    response = (flat.mean_dn - dark.mean_dn) / expected
    typical = float(np.median(response[~is_saturated]))
    if not typical > 0.0:
        raise SimulationError("the flat is no brighter than the dark, so the response is not known; take more light")

    is_hot = _outliers(dark.mean_dn - meant_rate * (exposure_s or 0.0), hot_sigmas, np.sqrt(QUANTISATION_DN2))
    rate: Floats | None = None
    if dark_long is not None and exposure_s is not None:
        longer_s = check_number("long_exposure_s", long_exposure_s, above=exposure_s) - exposure_s
        rate = (dark_long.mean_dn - dark.mean_dn) / longer_s
        is_hot |= _outliers(rate - meant_rate, hot_sigmas, np.sqrt(QUANTISATION_DN2) / longer_s)
    is_dead = (response < dead_fraction * typical) & ~is_saturated
    noise_dn = np.sqrt(dark.squares_dn2 / (dark.n_frames - 1))
    is_noisy = _noisy(noise_dn, meant_noise, _rounding_dn(dark), dark.n_frames, noisy_ratio)
    is_good = ~(is_hot | is_dead | is_noisy | is_clipped)
    if not is_good.any():
        # A sensor without pedestal clips everywhere in the dark; what is not defective still tells the mean.
        is_good = ~(is_hot | is_dead | is_noisy | is_saturated)
    if not is_good.any():
        raise SimulationError("no site is free of defects, so there is no mean response; relax the thresholds")
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


def _outliers(values: Floats, hot_sigmas: float, smallest_dn: float) -> Bools:
    """Values far above their median, by the robust spread."""
    median = np.median(values)
    sigma = max(SIGMA_PER_MAD * float(np.median(np.abs(values - median))), float(smallest_dn))
    return np.asarray(values > median + hot_sigmas * sigma)


def _noisy(noise_dn: Floats, meant_dn: Floats, rounding_dn: Floats, n_frames: int, noisy_ratio: float) -> Bools:
    """Sites whose variance is above what is typical, by a ratio of standard deviations and by more than luck."""
    from scipy.stats import chi2

    n_free = n_frames - 1
    typical = float(np.median((noise_dn / meant_dn) ** 2)) * n_free / float(chi2.median(n_free))
    lucky = float(chi2.isf(FALSE_ALARM, n_free)) / n_free
    return np.asarray(noise_dn**2 > max(noisy_ratio**2, lucky) * np.maximum(typical * meant_dn**2, rounding_dn**2))


def _rounding_dn(frames: _Frames) -> Floats:
    """Standard deviation of rounding where the sites' mean codes lie: wider apart codes round more."""
    table = frames.linear_dn
    if table is None or table.size < 2:
        return np.sqrt([QUANTISATION_DN2])
    return np.interp(frames.mean_dn, table, np.gradient(table)) * np.sqrt(QUANTISATION_DN2)


def _stack(name: str, frames: ArrayLike, at_least: int) -> Floats:
    stack = finite_array(name, frames, ndim=2)
    if stack.shape[0] < at_least or stack.shape[1] == 0:
        raise ParameterError(
            name,
            f"must be at least {at_least} frame{'s' * (at_least > 1)} (n_frame, n_site), got the shape {stack.shape}",
        )
    return stack


def _one_or_per_site(name: str, values: ArrayLike, n_sites: int, *, above: float | None) -> Floats:
    array = finite_array(name, values, above=above)
    if array.shape not in ((), (1,), (n_sites,)):
        raise ParameterError(name, f"must be one number, or one for each of the {n_sites} sites, got {array.shape}")
    return np.broadcast_to(array, n_sites)


def _per_site(name: str, values: ArrayLike, n_sites: int) -> Floats:
    array = as_numbers(name, values)
    if array.ndim == 0 or array.shape[-1] != n_sites:
        raise ParameterError(name, f"must have one value for each of the {n_sites} sites, got the shape {array.shape}")
    return array


def _pattern(matrix: Any) -> csr_array[Any]:
    """Ones where a sparse matrix has entries."""
    from scipy.sparse import csr_array

    out = csr_array(matrix)
    out.data = np.ones_like(out.data, dtype=np.float64)
    return out


def _require_sensor(sensor: object) -> None:
    if not isinstance(sensor, Sensor):
        raise ParameterError("sensor", f"must be a foveasim.Sensor, got a {type(sensor).__name__}")
