"""
Signal-to-noise ratio (SNR) per class of sites, predicted or measured from captures.

Predictions use :func:`foveasim.sensor.signal_to_noise`, the only definition of the SNR in the package.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import POSITIVE, Limits
from foveasim._core.validation import Bools, Floats, Ints, check_per_site, finite_array, read_only
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.errors import ParameterError
from foveasim.fields import PowerMap
from foveasim.layout import Layout
from foveasim.metrics.photon_transfer import SiteClasses, codes_of
from foveasim.scene import Scene
from foveasim.sensor import Sensor, SiteSignals, signal_to_noise
from foveasim.sensor.adc import ADC, QUANTISATION_DN2
from foveasim.sensor.limits import EXPOSURE
from foveasim.sensor.model.linearisation import CLIPPING_SIGMAS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["SnrTable", "measured_snr_by_class", "relative_exposure_at_snr_fraction", "size_classes_um", "snr_by_class"]

#: Relative difference below which sizes form one class.
SIZE_ROUNDING = 1e-6
#: Search range of the relative exposure, and relative tolerance of the result.
MIN_FRACTION, MAX_FRACTION, FRACTION_ROUNDING = 1e-12, 1e12, 1e-6
#: Maximum number of iterations, interval of the bisection steps (clipping makes the SNR nonlinear), and slope limits of the
#: secant steps.
MAX_STEPS, BISECT_EVERY, SLOPES = 200, 4, (0.25, 4.0)
#: Separator between the columns of a printed table.
GAP = "  "


@dataclass(frozen=True, eq=False, kw_only=True)
class SnrTable:
    """
    Signal, temporal noise and SNR of each class of sites, in linear codes.

    Attributes
    ----------
    classes : (n_class,)
        Labels of the classes, sorted.
    n_sites : (n_class,) int64
    size_um : (n_class,) float64, µm
        Mean square root of the site areas.
    signal_dn : (n_class,) float64, DN
        Mean code less the mean dark code.
    noise_dn : (n_class,) float64, DN
        Square root of the mean temporal variance, including quantisation.
    saturated_fraction : (n_class,) float64
        Fraction of sites with clipped noise: the mean charge is within two standard deviations of its shot noise of the full
        well, or the mean code is within two standard deviations of the highest code.
    """

    classes: NDArray[Any]
    n_sites: Ints
    size_um: Floats
    signal_dn: Floats
    noise_dn: Floats
    saturated_fraction: Floats

    def __repr__(self) -> str:
        return f"SnrTable({self.classes.size} classes of {int(self.n_sites.sum()):,} photosites)"

    @property
    def snr(self) -> Floats:
        """
        Signal over noise times the fraction of unsaturated sites, (n_class,).

        Saturated sites contribute 0. It is at most the square root of the signal in electrons.
        """
        ratio = np.divide(self.signal_dn, self.noise_dn, out=np.zeros_like(self.signal_dn), where=self.noise_dn > 0.0)
        return (1.0 - self.saturated_fraction) * ratio

    @property
    def snr_db(self) -> Floats:
        """SNR in decibels, ``20 log10``, (n_class,); -inf without signal."""
        with np.errstate(divide="ignore"):
            return 20.0 * np.log10(np.maximum(self.snr, 0.0))

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per class."""
        columns = {
            "class": self.classes,
            "n_sites": self.n_sites,
            "size_um": self.size_um,
            "signal_dn": self.signal_dn,
            "noise_dn": self.noise_dn,
            "snr": self.snr,
            "snr_db": self.snr_db,
            "saturated_fraction": self.saturated_fraction,
        }
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        return [dict(zip(columns, row, strict=True)) for row in rows]

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Draw the SNR of each class against its mean site size on matplotlib axes."""
        from foveasim.view import plot_curves

        return plot_curves({"": (self.size_um, self.snr)}, "site size / µm", "SNR", logarithmic="xy", marker="o", ax=ax)

    def _repr_html_(self) -> str:
        from foveasim.view import to_html

        return to_html(self)

    def __str__(self) -> str:
        heads = ("class", "sites", "size / µm", "signal / DN", "noise / DN", "SNR", "SNR / dB", "saturated")
        rows = [
            (
                f"{row['class']:.5g}" if isinstance(row["class"], float) else str(row["class"]),
                f"{row['n_sites']:,}",
                f"{row['size_um']:.4g}",
                f"{row['signal_dn']:.5g}",
                f"{row['noise_dn']:.4g}",
                f"{row['snr']:.4g}",
                f"{row['snr_db']:.4g}",
                f"{100.0 * row['saturated_fraction']:.3g} %",
            )
            for row in self.records()
        ]
        # Column width of the widest cell, so that numbers of any magnitude remain separated.
        widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
        return "\n".join(
            GAP.join(cell.rjust(width) for cell, width in zip(cells, widths, strict=True)) for cells in (heads, *rows)
        )


def size_classes_um(layout: Layout, n_classes: Annotated[int, Limits(at_least=1, at_most=1000)] = 6) -> Floats:
    """
    Assign each site to a size class, with logarithmically spaced class limits.

    Parameters
    ----------
    layout : Layout
    n_classes : int
        Maximum number of classes; empty classes are omitted.

    Returns
    -------
    size_um : (n_site,) float64, µm
        Centre of the class, the geometric mean of its limits; the size is the square root of the area.

    Raises
    ------
    ParameterError
        When ``n_classes`` is below 1, or the layout has no sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.log_polar(n_sectors=64, min_size_um=3.0, r_max_um=300.0)
    >>> np.unique(fs.metrics.size_classes_um(layout, 3)).round(1).tolist()
    [4.3, 8.8, 18.2]
    """
    if layout.n_sites == 0:
        raise ParameterError("layout", "must have at least one site")
    size_um = layout.size_um
    low_um, high_um = float(size_um.min()), float(size_um.max())
    if high_um <= low_um * (1.0 + SIZE_ROUNDING):
        return np.full(layout.n_sites, low_um)
    step = np.log(high_um / low_um) / n_classes
    position = np.clip(np.floor(np.log(size_um / low_um) / step + SIZE_ROUNDING), 0, n_classes - 1)
    return np.asarray(low_um * np.exp((position + 0.5) * step))


def snr_by_class(
    camera: Camera, light: Scene | PowerMap, *, exposure_s: float, classes: ArrayLike | None = None
) -> SnrTable:
    """
    Predict signal and noise of each class of sites analytically.

    Parameters
    ----------
    camera : Camera
    light : Scene or PowerMap
    exposure_s : float, s
    classes : (n_site,), optional
        Class label of each site, such as a filter or zone; by default :func:`size_classes_um`. At least two sites each.

    Returns
    -------
    SnrTable

    Raises
    ------
    ParameterError, SimulationError
        As for :meth:`Camera.predict`, or when a class has fewer than two sites.

    Notes
    -----
    Signal and noise are those of :func:`foveasim.sensor.signal_to_noise`, in linear codes: the noise includes quantisation
    once; companding and response nonlinearity are referred to the charge.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> layout = fs.layout.grid(n_x=16, n_y=16, pitch_um=4.0)
    >>> sensor = fs.Sensor.from_preset(layout, "machine_vision")
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> table = fs.metrics.snr_by_class(camera, scene, exposure_s=0.005)
    >>> table.size_um.tolist(), bool(40.0 < table.snr[0] < 120.0)
    ([4.0], True)
    """
    exposure_s = EXPOSURE.check("exposure_s", exposure_s)
    sensor, layout = _sensor_and_layout(camera)
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    expected_e = sensor.expected_electrons(camera.photoelectrons_per_s(light), exposure_s)
    dark_e = sensor.expected_electrons(np.zeros(layout.n_sites), exposure_s)
    signals = signal_to_noise(sensor, expected_e, dark_e, exposure_s=exposure_s)
    return _table(groups, layout.area_um2, *_linear_codes(signals))


def relative_exposure_at_snr_fraction(
    camera: Camera,
    light: Scene | PowerMap,
    *,
    exposure_s: float,
    snr: Annotated[float, POSITIVE] = 1.0,
    classes: ArrayLike | None = None,
) -> Floats:
    """
    Return the relative exposure at which each class of sites reaches a given SNR.

    With ``snr=1`` this is the absolute sensitivity threshold, relative to the given exposure.

    Parameters
    ----------
    camera : Camera
    light : Scene or PowerMap
    exposure_s : float, s
    snr : float
        Required signal-to-noise ratio.
    classes : (n_site,), optional
        As for :func:`snr_by_class`.

    Returns
    -------
    fraction : (n_class,) float64
        Values in the order of the sorted labels; above 1 if the given exposure is too low. NaN if the SNR is not reached at any
        exposure: half of the sites saturate before (:attr:`SnrTable.saturated_fraction`), or the sites have no signal.

    Raises
    ------
    ParameterError, SimulationError
        As for :func:`snr_by_class`.

    Notes
    -----
    The relative exposure is found by iteration over predictions as in :func:`snr_by_class`.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0)
    >>> sensor = fs.Sensor(
    ...     layout, read_noise_e=5.0, capacitance_f=1.6e-15, v_sat_v=1.0, bits=12
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=300.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> fs.metrics.relative_exposure_at_snr_fraction(
    ...     camera, scene, exposure_s=0.01, snr=10.0
    ... ).round(4).tolist()
    [0.0217]
    """
    exposure_s = EXPOSURE.check("exposure_s", exposure_s)
    sensor, layout = _sensor_and_layout(camera)
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    full_e = sensor.expected_electrons(camera.photoelectrons_per_s(light), exposure_s)
    dark_e = sensor.expected_electrons(np.zeros(layout.n_sites), exposure_s)
    search = _Search(groups.n_sites.size)
    is_saturated = np.zeros(groups.n_sites.size, bool)
    for _ in range(MAX_STEPS):
        if search.is_done.all():
            break
        fraction = np.exp(search.at)
        expected_e = dark_e + fraction[groups.class_index] * (full_e - dark_e)
        signals = signal_to_noise(sensor, expected_e, dark_e, exposure_s=exposure_s)
        signal_dn, noise_dn2, is_clipped = _linear_codes(signals)
        signal_dn, noise_dn = groups.mean(signal_dn), np.sqrt(groups.mean(noise_dn2))
        is_reached = ~search.is_done & (signal_dn > 0.0) & (signal_dn >= snr * noise_dn * (1.0 - FRACTION_ROUNDING))
        is_saturated = np.where(is_reached, groups.mean(is_clipped.astype(np.float64)) >= 0.5, is_saturated)
        required_dn = np.maximum(snr * noise_dn, np.finfo(float).tiny)
        search.step(np.log(np.clip(signal_dn, 1e-3 * required_dn, 1e3 * required_dn) / required_dn))
    return np.where(search.is_found & ~is_saturated, np.exp(search.high), np.nan)


class _Search:
    """Simultaneous root search of increasing functions: secant steps with bisection fallback."""

    def __init__(self, n: int) -> None:
        self.at = np.zeros(n)
        self.low, self.high = np.full(n, np.log(MIN_FRACTION)), np.full(n, np.log(MAX_FRACTION))
        self.is_found, self.is_done = np.zeros(n, bool), np.zeros(n, bool)
        self._last: tuple[Floats, Floats] | None = None
        self._n_steps = 0

    def step(self, value: Floats) -> None:
        """Update the brackets from the values at ``at``, and choose the next points."""
        at, is_active = self.at, ~self.is_done
        is_above = value >= -FRACTION_ROUNDING
        self.is_found |= is_active & is_above
        self.high = np.where(is_active & is_above, at, self.high)
        self.low = np.where(is_active & ~is_above, at, self.low)
        is_root = np.abs(value) <= FRACTION_ROUNDING
        self.is_done |= is_root | (self.high - self.low <= FRACTION_ROUNDING)
        # Without clipping, the SNR is proportional to the exposure (slope 1) or to its square root (slope 1/2).
        slope = np.ones(at.size)
        if self._last is not None:
            moved = at - self._last[0]
            slope = np.where(moved == 0.0, 1.0, (value - self._last[1]) / np.where(moved == 0.0, 1.0, moved))
        self._last = at, value
        self._n_steps += 1
        guess = at - value / np.clip(slope, *SLOPES)
        is_in = (guess > self.low) & (guess < self.high) & (self._n_steps % BISECT_EVERY != 0)
        self.at = np.where(self.is_done, at, np.where(is_in, guess, 0.5 * (self.low + self.high)))


def measured_snr_by_class(
    layout: Layout,
    frames: Any,
    dark: Any,
    *,
    bits: Annotated[int | None, Limits(at_least=1, at_most=16)] = None,
    full_well_e: ArrayLike | None = None,
    classes: ArrayLike | None = None,
) -> SnrTable:
    """
    Measure signal and noise of each class of sites from frames and dark frames.

    Parameters
    ----------
    layout : Layout
    frames, dark : (n_frame, n_site) DN, or lists of codes or captures
        Two frames or more of one scene, and dark frames. Codes of captures are linearised according to their settings; other
        codes must be linear, see :func:`foveasim.sensor.linearise`.
    bits : int, optional
        Bits per code, to detect saturation; taken from captures by default.
    full_well_e : float or (n_site,), optional, e-
        Full well capacity, to detect saturation from the electrons of captures; taken from their settings by default. Without
        captures, only saturation of the codes is detected.
    classes : (n_site,), optional
        As for :func:`snr_by_class`.

    Returns
    -------
    SnrTable

    Raises
    ------
    ParameterError
        When shapes are inconsistent, there are fewer than two frames, the bits are unknown, or the settings of captures do not
        contain the full well capacity of every site.

    Notes
    -----
    The variance is that of the codes, and at least the 1/12 DN² of quantisation (times the squared width of the code for
    companded codes). If the noise exceeds one code, the result agrees with :func:`snr_by_class`. Within one code, frames do not
    resolve the noise, and the SNR is an upper bound. Response nonlinearity is not corrected.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=40, n_y=40, pitch_um=3.0)
    >>> sensor = fs.Sensor(layout, capacitance_f=1.6e-15, v_sat_v=1.0, bits=12)
    >>> frames = fs.metrics.draw_frames(sensor, np.full(1600, 900.0), n_frames=8, seed=0)
    >>> dark = fs.metrics.draw_frames(sensor, np.zeros(1600), n_frames=8, seed=1)
    >>> fs.metrics.measured_snr_by_class(layout, frames, dark, bits=12).snr.round(
    ...     0
    ... ).tolist()  # √900 of shot noise
    [30.0]
    """
    captures = frames if isinstance(frames, Sequence) and all(isinstance(frame, Capture) for frame in frames) else ()
    sensor_settings = _common_settings(captures)
    if bits is None:
        if not captures:
            raise ParameterError("bits", "must be given for frames that are not captures")
        bits = captures[0].bits
    codes, dark_codes = codes_of("frames", frames), codes_of("dark", dark)
    for name, some in (("frames", codes), ("dark", dark_codes)):
        if some.shape[1] != layout.n_sites:
            raise ParameterError(name, f"must have the {layout.n_sites} sites of the layout", some.shape[1])
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    is_saturated = _is_near(codes.mean(axis=0), codes.var(axis=0, ddof=1), 2**bits - 1.5)
    well_e = _full_well_e(sensor_settings, full_well_e, layout.n_sites)
    if well_e is not None:
        mean_e = np.mean([capture.electrons for capture in captures], axis=0)
        is_saturated |= _is_near(mean_e, mean_e, well_e)
    adc = _build_adc(sensor_settings or {}, bits)
    linear_dn, dark_dn = (np.interp(some, np.arange(2.0**bits), adc.linear_dn) for some in (codes, dark_codes))
    floor_dn2 = QUANTISATION_DN2 * np.square(adc.width_of_code_dn(codes.mean(axis=0)))
    noise_dn2 = np.maximum(linear_dn.var(axis=0, ddof=1), floor_dn2)
    return _table(groups, layout.area_um2, linear_dn.mean(axis=0) - dark_dn.mean(axis=0), noise_dn2, is_saturated)


def _common_settings(captures: Sequence[Capture]) -> Mapping[str, Any] | None:
    """Return the settings of the sensor of captures, None without captures."""
    if not captures:
        return None
    first, *others = ((capture.bits, dict(capture.settings.get("sensor", {}))) for capture in captures)
    for k, other in enumerate(others, 1):
        if other != first:
            raise ParameterError("frames", f"must be captures of one sensor: the settings of captures 0 and {k} differ")
    return first[1]


def _build_adc(settings: Mapping[str, Any], bits: int) -> ADC:
    """Return the ADC specified by the settings of a sensor, or a linear one."""
    names = ("companding", "log_strength", "companding_table", "inl_dn")
    return ADC(bits=bits, **{name: settings[name] for name in names if name in settings})


def _sensor_and_layout(camera: Camera) -> tuple[Sensor, Layout]:
    assert isinstance(camera.sensor.layout, Layout)  # guaranteed by Camera
    return camera.sensor, camera.sensor.layout


def _full_well_e(settings: Mapping[str, Any] | None, full_well_e: ArrayLike | None, n_sites: int) -> Floats | None:
    """
    Return the full well capacity, one or (n_site,).

    None if it is unlimited, or without the settings of captures.
    """
    if full_well_e is None:
        if settings is None:
            return None
        full_well_e = settings.get("full_well_e")
        if isinstance(full_well_e, Mapping):
            raise ParameterError(
                "full_well_e", "must be given, because the settings of the captures do not contain it for every site"
            )
        if full_well_e is None:
            return None
    elif settings is None:
        raise ParameterError(
            "full_well_e", "must not be given without captures; codes alone do not determine the charge"
        )
    return check_per_site("full_well_e", finite_array("full_well_e", full_well_e, above=0.0), n_sites, or_one=True)


def _is_near(value: Floats, variance: Floats, limit: Floats | float) -> Bools:
    """Return whether a value is above a limit or within some standard deviations below it."""
    return np.asarray(value + CLIPPING_SIGMAS * np.sqrt(variance) >= limit)


def _linear_codes(found: SiteSignals) -> tuple[Floats, Floats, Bools]:
    """Return signal and variance in linear codes, and the saturation mask, (n_site,) each."""
    gain = found.gain_dn_per_e
    return gain * found.signal_e, np.square(gain * found.noise_e), found.is_saturated


def _table(
    groups: SiteClasses, area_um2: Floats, signal_dn: Floats, noise_dn2: Floats, is_saturated: Bools
) -> SnrTable:
    return SnrTable(
        classes=read_only(groups.labels),
        n_sites=read_only(groups.n_sites),
        size_um=read_only(groups.mean(np.sqrt(area_um2))),
        signal_dn=read_only(groups.mean(signal_dn)),
        noise_dn=read_only(np.sqrt(groups.mean(noise_dn2))),
        saturated_fraction=read_only(groups.mean(is_saturated.astype(np.float64))),
    )
