"""
Asynchronous photosites: change detection (event cameras) and integrate-and-fire.

Both process the photoelectron rates of frames, as from :meth:`foveasim.Camera.rates`, and store their state between frames:
events do not depend on the size of the batches of a video.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import KW_ONLY, dataclass, replace
from itertools import islice
from threading import Lock
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import NOT_NEGATIVE, Limits, OwnCheck, check_declared
from foveasim._core.random_streams import fixed_pattern_key
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property, parallel_map, thread_count
from foveasim._core.validation import Floats, Ints, check_per_site, finite_array, read_only
from foveasim.errors import ParameterError, SimulationError, type_name
from foveasim.layout.model import Layout
from foveasim.modes.events import Events
from foveasim.modes.frame_times import FrameTimes
from foveasim.sensor import Sensor
from foveasim.sensor.effects import ShotNoise
from foveasim.sensor.limits import CHARGE, DURATION, EXPOSURE, RATE, SPREAD, TEMPERATURE, WIDE_SPREAD
from foveasim.units import BOLTZMANN_J_PER_K, ELEMENTARY_CHARGE_C

__all__ = ["EventPixels", "SpikingPixels"]

#: Smallest threshold of a site as a fraction of the mean, for any mismatch.
MIN_THRESHOLD_FRACTION = 0.1
#: Thresholds below 1e-3 are below the noise of any circuit, and would emit too many events for memory.
CONTRAST = Limits(above=0.0, low=1e-3, at_most=20.0, hint="contrasts are natural logarithms: 0.2 is 22 %")
#: Larger noise would cross thresholds of 1 all the time.
CONTRAST_NOISE = Limits(at_least=0.0, at_most=1.0, hint="contrasts are natural logarithms: 0.02 is 2 %")
CAPACITANCE = Limits(at_least=0.0, low=1e-18, at_most=1e-9, hint="capacitances are in farad: 1 fF is 1e-15")
EVENT_RATE = Limits(at_least=0.0, at_most=1e9, hint="rates are per second and photosite")
#: Sites per task; fixed, so that results do not depend on the number of threads.
BLOCK_SITES = 2048
#: More events per batch than this indicate a wrong threshold or a wrong unit of the rates.
MAX_EVENTS = 1 << 27

#: Kernel call for some sites: slice of sites, maximum number of events, state arrays, output arrays.
KernelCall = Callable[[slice, int, NDArray[Any], Ints, Ints, Floats, NDArray[np.int32], NDArray[np.int8]], int]
#: Events of some sites, frame by frame: number of events up to the end of each frame, times, sites, polarities.
BlockEvents = tuple[Ints, Floats, NDArray[np.int32], NDArray[np.int8]]


class _Pixels:
    """Photosites that generate events from the photoelectron rates of frames."""

    sensor: Sensor
    #: Name of the random stream of the noise.
    _noise_name: ClassVar[str]

    def stream(
        self,
        rates: OwnCheck[Iterable[ArrayLike]],
        *,
        frame_s: Annotated[float | None, DURATION] = None,
        seed: Annotated[int, NOT_NEGATIVE],
        batch: Annotated[int, Limits(at_least=1)] = 32,
        n_threads: int | None = None,
        times_s: ArrayLike | None = None,
    ) -> Iterator[Events]:
        """
        Yield the events or spikes of successive batches of frames.

        Parameters
        ----------
        rates : iterable of (n_site,), e-/s
            Photoelectron rates of the frames, as from :meth:`foveasim.Camera.rates`.
        frame_s : float, s
            Frame period; the first frame is at 0 s.
        seed : int
            Seed of the noise.
        batch : int
            Frames per batch; events do not depend on it.
        n_threads : int, optional
            Number of threads, by default all cores. Events do not depend on it.
        times_s : (n_frame,) float64, s
            Times of the frames in strictly ascending order, instead of ``frame_s``; events have times on the same axis.

        Yields
        ------
        Events
            Events of a batch, all later than those of previous batches. Spikes are of polarity 1.

        Raises
        ------
        ParameterError
            Immediately when a value is out of range, or not exactly one of ``frame_s`` and ``times_s`` is given; during
            iteration when a frame does not have one rate >= 0 per site, or there is not one time per frame.
        SimulationError
            When the events do not fit in memory, or the current of a site of :class:`EventPixels` is zero.
        """
        _check_rates(rates)
        key = fixed_pattern_key(seed, self._noise_name)
        times = FrameTimes.of(frame_s, times_s, frames=rates)
        if times is None:
            raise ParameterError("frame_s", "must be given, or 'times_s'")
        return self._stream(rates, times, key, batch, thread_count(n_threads))

    def events(
        self,
        rates: OwnCheck[Iterable[ArrayLike]],
        *,
        frame_s: float | None = None,
        seed: int,
        n_threads: int | None = None,
        times_s: ArrayLike | None = None,
    ) -> Events:
        """Return all events at once; parameters as for :meth:`stream`."""
        empty = Events(np.zeros(0), np.zeros(0, np.int32), np.zeros(0, np.int8), _layout(self.sensor))
        batches = self.stream(rates, frame_s=frame_s, seed=seed, n_threads=n_threads, times_s=times_s)
        return Events.concatenate([empty, *batches])

    @abstractmethod
    def _stream(
        self, rates: Iterable[ArrayLike], times: FrameTimes, key: tuple[Any, Any], batch: int, n_threads: int
    ) -> Iterator[Events]:
        """Yield the events of batches; the arguments are valid."""


@dataclass(frozen=True, eq=False)
class EventPixels(_Pixels):
    """
    Photosites of an event camera (dynamic vision sensor), which detect contrast changes.

    Parameters
    ----------
    sensor : Sensor
        Sensor with the photosites. Areas, sensitivities, PRNU, dark current, crosstalk and the device seed are used.
    contrast_on, contrast_off : float
        Contrast thresholds: change of the natural logarithm of the photocurrent per event. 0.2 is an increase by 22 % or a
        decrease by 18 %.
    mismatch_fraction : float
        Threshold mismatch: relative standard deviation of the thresholds, fixed in the device; at most 0.3.
    refractory_s : float, s
        Refractory time after an event, in which the reference follows the photoreceptor level.
    capacitance_f : float, F
        Capacitance of the photoreceptor node: 1e-14 F is typical, 0 disables the low pass. See the notes.
    temperature_k : float, K
        Temperature, which affects the low pass.
    leak_per_s : float, 1/s
        Rate of ON events of a site at constant irradiance, due to leakage.
    leak_spread_fraction : float
        Relative standard deviation of the leak rates, a log-normal distribution, fixed in the device.
    noise_per_s : float, 1/s
        Rate of shot noise events of a site at zero photocurrent, with equal probabilities of both polarities.
    noise_half_e_per_s : float, e-/s
        Photocurrent at which the noise rate is half: ``noise_per_s / (1 + I / noise_half)``.
    contrast_noise : float
        Temporal noise at the comparator: standard deviation of a Gaussian number that is added to the change of the logarithm,
        and drawn again at each event. It widens the S-curve of each site.
    contrast_noise_changes_per_s : float, 1/s
        Rate at which the contrast noise is also drawn between events, 2 pi times its corner frequency; its autocorrelation is
        that of a first-order low pass. Large numbers cause noise events at constant irradiance.
    floor_e_per_s : float, e-/s
        Rate added to the photocurrent of every site, so that the logarithm is finite at zero irradiance.

    Notes
    -----
    The logarithm L(t) of the photocurrent I is interpolated linearly between frames, at their times, and event times are the
    threshold crossings to machine precision. The photoreceptor is a low pass, ``dV/dt = (L - V) / tau`` with ``tau = C (kT/q) /
    I``, so its corner frequency ``1 / (2 pi tau)`` is proportional to the photocurrent; I is the mean current of each part of a
    frame in which L changes by at most 0.25. An event sets the reference of the site to its level at the end of the refractory
    time; leakage lowers the reference. The frame rate should be so high that L changes little between frames.

    The initial phase of the leak of each site is random, drawn with the noise, so that leak events of different sites are not
    synchronous and their rate is constant from the first frame. An event at the boundary of two frames belongs to the first.

    Noise events are a Poisson process with the refractory time as dead time; a noise event sets the reference like other
    events. :func:`event_probability` is the probability of an event after a step of irradiance.

    Examples
    --------
    A site with a photocurrent that increases from 100 to 1000 e-/s, ln 10 = 2.303, at thresholds of 0.5:

    >>> import foveasim as fs
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=1, n_y=1, pitch_um=10.0))
    >>> pixels = EventPixels(sensor, contrast_on=0.5, floor_e_per_s=0.0)
    >>> pixels.events([[100.0], [1000.0]], frame_s=1.0, seed=0).t_s.round(3).tolist()
    [0.217, 0.434, 0.651, 0.869]
    """

    sensor: Sensor
    _: KW_ONLY
    contrast_on: Annotated[float, CONTRAST] = 0.2
    contrast_off: Annotated[float, CONTRAST] = 0.2
    mismatch_fraction: Annotated[float, SPREAD] = 0.0
    refractory_s: Annotated[float, EXPOSURE] = 0.0
    capacitance_f: Annotated[float, CAPACITANCE] = 0.0
    temperature_k: Annotated[float, TEMPERATURE] = 300.0
    leak_per_s: Annotated[float, EVENT_RATE] = 0.0
    leak_spread_fraction: Annotated[float, WIDE_SPREAD] = 0.0
    noise_per_s: Annotated[float, EVENT_RATE] = 0.0
    noise_half_e_per_s: Annotated[float, replace(RATE, above=0.0)] = 1e4
    contrast_noise: Annotated[float, CONTRAST_NOISE] = 0.0
    contrast_noise_changes_per_s: Annotated[float, EVENT_RATE] = 0.0
    floor_e_per_s: Annotated[float, RATE] = 1.0

    _noise_name: ClassVar[str] = "change events"
    __repr__ = short_repr

    def __post_init__(self) -> None:
        _check_sensor(self.sensor)
        check_declared(self)

    @cached_property
    def thresholds(self) -> tuple[Floats, Floats]:
        """ON and OFF thresholds of every site, (n_site,) or (1,) each."""
        means = self.contrast_on, self.contrast_off
        if not self.mismatch_fraction:
            return read_only(np.full(1, means[0])), read_only(np.full(1, means[1]))
        on, off = (
            mean
            * np.maximum(
                1.0 + self.mismatch_fraction * self.sensor.device.normals(f"event {sign}"), MIN_THRESHOLD_FRACTION
            )
            for mean, sign in zip(means, ("on", "off"), strict=True)
        )
        return read_only(on), read_only(off)

    @cached_property
    def leaks_per_s(self) -> Floats:
        """Leak rate of every site in events per second, (n_site,) or (1,)."""
        if not self.leak_spread_fraction:
            return read_only(np.full(1, self.leak_per_s))
        return read_only(self.leak_per_s * self.sensor.device.log_normals("event leak", self.leak_spread_fraction))

    def _stream(
        self, rates: Iterable[ArrayLike], times: FrameTimes, key: tuple[Any, Any], batch: int, n_threads: int
    ) -> Iterator[Events]:
        from foveasim.modes import _kernels

        tau_e = self.capacitance_f * BOLTZMANN_J_PER_K * self.temperature_k / ELEMENTARY_CHARGE_C**2
        (on, off), leaks_per_s = self.thresholds, self.leaks_per_s
        memory = np.zeros((self.sensor.layout.n_sites, 6))
        n_drawn = np.zeros(self.sensor.layout.n_sites, np.int64)
        n_before = 0
        last_current: Floats | None = None
        for dark_current in _batches(self.sensor, rates, batch, times):
            current = dark_current + self.floor_e_per_s
            if not current.min(initial=np.inf) > 0.0:
                site = int(np.flatnonzero((current <= 0.0).any(axis=0))[0])
                raise SimulationError(
                    f"the current of site {site} is zero, and its logarithm infinite; set 'floor_e_per_s' or a dark current"
                )
            if last_current is None:
                memory[:, _kernels.LEVEL] = np.log(current[0])
                frames, log_current = current, np.log(current)
            else:
                frames = np.concatenate((last_current, current))
                log_current = np.log(frames)
            begins_s, steps_s = times.of_frames(max(n_before - 1, 0), frames.shape[0])

            def run_kernel(sites: slice, max_events: int, *out: NDArray[Any]) -> int:
                return int(
                    _kernels.change_events(
                        np.ascontiguousarray(log_current[:, sites]),  # noqa: B023 -- called in this iteration
                        np.ascontiguousarray(frames[:, sites]),  # noqa: B023
                        begins_s,  # noqa: B023
                        steps_s,  # noqa: B023
                        _part(on, sites),
                        _part(off, sites),
                        _part(leaks_per_s, sites),
                        self.refractory_s,
                        tau_e,
                        self.noise_per_s,
                        self.noise_half_e_per_s,
                        self.contrast_noise,
                        self.contrast_noise_changes_per_s,
                        *key,
                        sites.start,
                        max_events,
                        *out,
                    )
                )

            n_before += current.shape[0]
            last_current = current[-1:].copy()
            yield _collect_events(run_kernel, frames.shape[0] - 1, memory, n_drawn, self.sensor, n_threads)


@dataclass(frozen=True, eq=False)
class SpikingPixels(_Pixels):
    """
    Integrate-and-fire photosites with a charge threshold.

    Parameters
    ----------
    sensor : Sensor
        Sensor with the photosites. Areas, sensitivities, PRNU, dark current and crosstalk are used. If its shot noise is off
        or disabled, the charge increases uniformly.
    threshold_e : float or (n_site,), e-
        Charge per spike, at least 1.
    refractory_s : float, s
        Refractory time after a spike, during which charge is lost.

    Notes
    -----
    Without noise, the spike rate is ``1 / (N_th / I + refractory)`` for a current of I electrons per second. With noise, the
    time to a threshold of N electrons follows the gamma distribution of shape N, which is sampled exactly; the relative
    standard deviation of intervals is ``1 / sqrt(N)``. Collected charge is retained between frames. Rates are constant during
    each frame: frame k lasts from ``k frame_s`` to ``(k + 1) frame_s``, or from ``times_s[k]`` to ``times_s[k + 1]``, the last
    one as long as the one before it.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=1, n_y=1, pitch_um=10.0), shot_noise="off")
    >>> SpikingPixels(sensor, threshold_e=400.0).events(
    ...     [[1000.0], [500.0]], frame_s=1.0, seed=0
    ... ).t_s.round(9).tolist()
    [0.4, 0.8, 1.4]
    """

    sensor: Sensor
    _: KW_ONLY
    threshold_e: Annotated[float | Floats, replace(CHARGE, at_least=1.0)] = 1000.0
    refractory_s: Annotated[float, EXPOSURE] = 0.0

    _noise_name: ClassVar[str] = "spikes"
    __repr__ = short_repr

    def __post_init__(self) -> None:
        _check_sensor(self.sensor)
        collection = self.sensor.collection
        if collection.is_drawn and not isinstance(collection, ShotNoise):
            raise ParameterError(
                "sensor", f"must have shot noise for spikes, got the collection '{collection.name}'", hint="disable it"
            )
        check_declared(self, n_sites=self.sensor.layout.n_sites)

    def _stream(
        self, rates: Iterable[ArrayLike], times: FrameTimes, key: tuple[Any, Any], batch: int, n_threads: int
    ) -> Iterator[Events]:
        from foveasim.modes import _kernels

        if times.times_s is not None and times.times_s.size == 1:
            raise ParameterError(
                "times_s", "must be two or more times: the duration of a single frame is unknown; use 'frame_s'"
            )
        threshold_e = np.atleast_1d(np.asarray(self.threshold_e, np.float64))
        memory = np.zeros((self.sensor.layout.n_sites, 4))
        n_drawn = np.zeros(self.sensor.layout.n_sites, np.int64)
        first = 0
        for current in _batches(self.sensor, rates, batch, times):
            begins_s, steps_s = times.of_frames(first, current.shape[0])
            expected = current / (threshold_e + self.refractory_s * current) * steps_s[:, np.newaxis]
            if expected.sum() > MAX_EVENTS:
                raise SimulationError(
                    f"{expected.sum():.3g} spikes in {current.shape[0]} frames do not fit in memory; use a smaller 'batch', a "
                    "higher 'threshold_e' or lower rates"
                )

            def run_kernel(sites: slice, max_events: int, *out: NDArray[Any]) -> int:
                return int(
                    _kernels.charge_spikes(
                        np.ascontiguousarray(current[:, sites]),  # noqa: B023 -- called in this iteration
                        begins_s,  # noqa: B023
                        steps_s,  # noqa: B023
                        _part(threshold_e, sites),
                        self.refractory_s,
                        self.sensor.collection.is_drawn,
                        *key,
                        sites.start,
                        max_events,
                        *out,
                    )
                )

            yield _collect_events(run_kernel, current.shape[0], memory, n_drawn, self.sensor, n_threads)
            first += current.shape[0]


# -- parts ------------------------------------------------------------------------------------------------------------


def _check_sensor(sensor: Sensor) -> None:
    if not isinstance(sensor.layout, Layout):
        raise ParameterError("sensor", f"must have a foveasim.Layout, got {type_name(sensor.layout)}")


def _check_rates(rates: object) -> None:
    if not isinstance(rates, Iterable):
        raise ParameterError(
            "rates",
            f"must be an iterable of frames with one rate per site, got {type_name(rates)}",
            hint="foveasim.Camera.rates computes them from scenes",
        )


def _part(values: Floats, sites: slice) -> Floats:
    """Return the values of some sites, or the common value of all."""
    return values[sites] if values.size > 1 else values


def _batches(sensor: Sensor, rates: Iterable[ArrayLike], batch: int, times: FrameTimes) -> Iterator[Floats]:
    """
    Yield the currents of batches of frames, (n_frame, n_site) e-/s.

    Currents include dark signal and crosstalk.
    """
    n_sites = sensor.layout.n_sites
    remaining, n_before = iter(rates), 0
    while rows := list(islice(remaining, batch)):
        n_before += len(rows)
        times.check_number(n_before - 1)
        current = np.empty((len(rows), n_sites))
        for k, row in enumerate(rows):
            rate = check_per_site("rates", finite_array("rates", row, at_least=0.0), n_sites)
            current[k] = sensor.expected_electrons(rate, 1.0)
        yield current
    times.check_complete(n_before)


def _collect_events(
    run_kernel: KernelCall, n_frames: int, memory: NDArray[Any], n_drawn: Ints, sensor: Sensor, n_threads: int
) -> Events:
    """Run a kernel on all sites and return the events in temporal order."""
    n_found = 0
    counter_lock = Lock()

    def compute_block(first: int) -> BlockEvents:
        nonlocal n_found
        sites = slice(first, min(first + BLOCK_SITES, memory.shape[0]))
        capacity = 4 * BLOCK_SITES
        while True:
            state, drawn, ends = memory[sites].copy(), n_drawn[sites].copy(), np.zeros(n_frames, np.int64)
            out = np.empty(capacity), np.empty(capacity, np.int32), np.empty(capacity, np.int8)
            max_events = MAX_EVENTS - n_found
            n = run_kernel(sites, max_events, state, drawn, ends, *out)
            if n > max_events:
                raise _too_many(n_frames)
            if n <= capacity:
                break
            capacity = n
        memory[sites], n_drawn[sites] = state, drawn
        with counter_lock:
            n_found += n
        if n_found > MAX_EVENTS:
            raise _too_many(n_frames)
        return ends, out[0][:n], out[1][:n], out[2][:n]

    blocks = parallel_map(compute_block, range(0, memory.shape[0], BLOCK_SITES), n_threads)
    t_s, site, polarity = np.empty(n_found), np.empty(n_found, np.int32), np.empty(n_found, np.int8)
    begins = np.concatenate(([0], sum((ends for ends, *_ in blocks), np.zeros(n_frames, np.int64))))

    def merge_frame(k: int) -> None:
        # Events of a frame are later than those of previous frames, and ordered by site, then by time.
        parts = [[array[ends[k - 1] if k else 0 : ends[k]] for array in (s, i, p)] for ends, s, i, p in blocks]
        found_s, sites, signs = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        order = _stable_argsort(found_s)
        target = slice(begins[k], begins[k + 1])
        for merged, frame_values in ((t_s, found_s), (site, sites), (polarity, signs)):
            merged[target] = frame_values[order]

    if blocks:
        parallel_map(merge_frame, range(n_frames), n_threads)
    return Events(read_only(t_s), read_only(site), read_only(polarity), _layout(sensor))


def _too_many(n_frames: int) -> SimulationError:
    return SimulationError(
        f"more than {MAX_EVENTS:,} events in {n_frames} frames do not fit in memory; use a smaller 'batch', higher thresholds, "
        "lower rates or less noise"
    )


def _stable_argsort(values: Floats) -> Ints:
    """Return the indices of a stable sort, four times as fast as numpy."""
    order = np.argsort(values)
    ordered = values[order]
    is_tied = np.zeros(values.size, bool)
    np.equal(ordered[1:], ordered[:-1], out=is_tied[1:])
    is_tied[:-1] |= is_tied[1:]
    tied = order[is_tied]
    order[is_tied] = tied[np.lexsort((tied, values[tied]))]
    return order


def _layout(sensor: Sensor) -> Layout:
    layout = sensor.layout
    assert isinstance(layout, Layout)  # was checked
    return layout
