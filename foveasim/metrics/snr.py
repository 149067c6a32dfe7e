"""
Signal and noise of the sites of each size or class: predicted, without a draw, and measured from captures.

Predictions are those of :func:`foveasim.sensor.signal_to_noise`, the package's one definition of the ratio.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import Bools, Floats, Ints, check_count, check_number, finite_array, read_only
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.errors import ParameterError
from foveasim.fields import PowerMap
from foveasim.layout import Layout
from foveasim.metrics.photon_transfer import SiteClasses, codes_of
from foveasim.metrics.sampling import require_layout
from foveasim.scene import Scene
from foveasim.sensor import Sensor, SiteSignals, signal_to_noise
from foveasim.sensor.adc import QUANTISATION_DN2, Converter
from foveasim.sensor.limits import check_plausible
from foveasim.sensor.signal_to_noise import CUT_OFF_SIGMAS

__all__ = ["SnrTable", "measured_snr_by_class", "relative_exposure_at_snr_fraction", "size_classes_um", "snr_by_class"]

#: Sizes that differ by less than this share are one class.
SIZE_ROUNDING = 1e-6
#: The light at a ratio is looked for between these fractions of what is given, and found to this fraction of it.
LEAST_SHARE, MOST_SHARE, SHARE_ROUNDING = 1e-12, 1e12, 1e-6
#: In at most so many steps, each so many of them a half, for clips that bend the ratio; of secants between these slopes.
MOST_STEPS, HALVED_EVERY, SLOPES = 200, 4, (0.25, 4.0)
#: Between two columns of a printed table.
GAP = "  "


@dataclass(frozen=True, eq=False, kw_only=True)
class SnrTable:
    """
    Signal and temporal noise of each class of sites, in linear codes.

    Attributes
    ----------
    classes : (n_class,)
        Labels of the classes, sorted.
    n_sites : (n_class,) int64
    size_um : (n_class,) float64, µm
        Mean square root of the sites' areas.
    signal_dn : (n_class,) float64, DN
        Mean code less that of dark frames.
    noise_dn : (n_class,) float64, DN
        Root of the mean temporal variance, quantisation included.
    saturated_fraction : (n_class,) float64
        Fraction of the sites whose noise is cut off: the mean charge is within two standard deviations of its shot noise of
        the full well, or the mean code within two of its own of the highest. A prediction has the ratio of saturation there;
        a measured ratio is too high.
    """

    classes: NDArray[Any]
    n_sites: Ints
    size_um: Floats
    signal_dn: Floats
    noise_dn: Floats
    saturated_fraction: Floats

    @property
    def snr(self) -> Floats:
        """Signal over noise, (n_class,): at most the root of the signal's electrons, unless measured ones are saturated."""
        return np.divide(self.signal_dn, self.noise_dn, out=np.zeros_like(self.signal_dn), where=self.noise_dn > 0.0)

    @property
    def snr_db(self) -> Floats:
        """The same in decibels, ``20 log10``, (n_class,); -inf without signal."""
        with np.errstate(divide="ignore"):
            return 20.0 * np.log10(np.maximum(self.snr, 0.0))

    def records(self) -> list[dict[str, Any]]:
        """One dict a class."""
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
        # As wide as their widest cell: numbers of any magnitude stay apart.
        widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
        return "\n".join(
            GAP.join(cell.rjust(width) for cell, width in zip(cells, widths, strict=True)) for cells in (heads, *rows)
        )


def size_classes_um(layout: Layout, n_classes: int = 6) -> Floats:
    """
    The class of size of every site: equal ratios from the smallest to the largest.

    Parameters
    ----------
    layout : Layout
    n_classes : int
        At most; classes without sites are not there.

    Returns
    -------
    size_um : (n_site,) float64, µm
        The middle of its class, the geometric mean of its limits; size is the square root of area.

    Raises
    ------
    ParameterError
        When the number is below 1, or the layout has no sites.
    """
    require_layout(layout)
    n_classes = check_count("n_classes", n_classes)
    if layout.n_sites == 0:
        raise ParameterError("layout", "must have sites")
    size_um = np.sqrt(layout.area_um2)
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
    Predict signal and noise of each class of sites, without a draw.

    Parameters
    ----------
    camera : Camera
    light : Scene or PowerMap
    exposure_s : float, s
    classes : (n_site,), optional
        Label of each site's class, such as a filter or zone; by default :func:`size_classes_um`. Two sites or more each.

    Returns
    -------
    SnrTable

    Raises
    ------
    ParameterError, SimulationError
        As for :meth:`Camera.predict`, or when a class has fewer than two sites.

    Notes
    -----
    Signal and noise are those of :func:`foveasim.sensor.signal_to_noise`, in linear codes: quantisation is in the noise once,
    companding and the response's bend are referred to the charge.
    """
    exposure_s = check_plausible("exposure_s", exposure_s)
    sensor, layout = _sensor_and_layout(camera)
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    expected_e = sensor.expected_electrons(camera.photoelectrons_per_s(light), exposure_s)
    dark_e = sensor.expected_electrons(np.zeros(layout.n_sites), exposure_s)
    return _table(groups, layout.area_um2, *_linear_codes(signal_to_noise(sensor, expected_e, dark_e)))


def relative_exposure_at_snr_fraction(
    camera: Camera, light: Scene | PowerMap, *, exposure_s: float, snr: float = 1.0, classes: ArrayLike | None = None
) -> Floats:
    """
    Fraction of a scene's light at which each class of sites has a signal-to-noise ratio: 1 for the least that can be seen.

    Parameters
    ----------
    camera : Camera
    light : Scene or PowerMap
    exposure_s : float, s
    snr : float
        The ratio that is asked for.
    classes : (n_site,), optional
        As for :func:`snr_by_class`.

    Returns
    -------
    share : (n_class,) float64
        In the order of the sorted labels; more than 1 where the light given does not do. NaN where no light does: half of the
        sites saturate before (:attr:`SnrTable.saturated_fraction`), or they see nothing.

    Raises
    ------
    ParameterError, SimulationError
        As for :func:`snr_by_class`.

    Notes
    -----
    Found by predicting the ratio of :func:`snr_by_class` at other fractions.
    """
    exposure_s = check_plausible("exposure_s", exposure_s)
    snr = check_number("snr", snr, above=0.0)
    sensor, layout = _sensor_and_layout(camera)
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    full_e = sensor.expected_electrons(camera.photoelectrons_per_s(light), exposure_s)
    dark_e = sensor.expected_electrons(np.zeros(layout.n_sites), exposure_s)
    search = _Search(groups.n_sites.size)
    is_saturated = np.zeros(groups.n_sites.size, bool)
    for _ in range(MOST_STEPS):
        if search.is_done.all():
            break
        fraction = np.exp(search.at)
        expected_e = dark_e + fraction[groups.of_site] * (full_e - dark_e)
        signal_dn, noise_dn2, is_cut = _linear_codes(signal_to_noise(sensor, expected_e, dark_e))
        signal_dn, noise_dn = groups.mean(signal_dn), np.sqrt(groups.mean(noise_dn2))
        does = ~search.is_done & (signal_dn > 0.0) & (signal_dn >= snr * noise_dn * (1.0 - SHARE_ROUNDING))
        is_saturated = np.where(does, groups.mean(is_cut.astype(np.float64)) >= 0.5, is_saturated)
        too_little = np.maximum(snr * noise_dn, np.finfo(float).tiny)
        search.step(np.log(np.clip(signal_dn, 1e-3 * too_little, 1e3 * too_little) / too_little))
    return np.where(search.is_found & ~is_saturated, np.exp(search.high), np.nan)


class _Search:
    """Roots of rising functions of a logarithm, each of its own: secants, and halves where these leave what is left."""

    def __init__(self, n: int) -> None:
        self.at = np.zeros(n)
        self.low, self.high = np.full(n, np.log(LEAST_SHARE)), np.full(n, np.log(MOST_SHARE))
        self.is_found, self.is_done = np.zeros(n, bool), np.zeros(n, bool)
        self._last: tuple[Floats, Floats] | None = None
        self._n_steps = 0

    def step(self, value: Floats) -> None:
        """Take the functions' values at ``at``, and go on to the next places; those that are done stay."""
        at, goes = self.at, ~self.is_done
        is_above = value >= -SHARE_ROUNDING
        self.is_found |= goes & is_above
        self.high = np.where(goes & is_above, at, self.high)
        self.low = np.where(goes & ~is_above, at, self.low)
        is_root = np.abs(value) <= SHARE_ROUNDING
        self.is_done |= is_root | (self.high - self.low <= SHARE_ROUNDING)
        # Signals grow as the light and ratios as it or its root, where no clip bends them.
        slope = np.ones(at.size)
        if self._last is not None:
            moved = at - self._last[0]
            slope = np.where(moved == 0.0, 1.0, (value - self._last[1]) / np.where(moved == 0.0, 1.0, moved))
        self._last = at, value
        self._n_steps += 1
        guess = at - value / np.clip(slope, *SLOPES)
        is_in = (guess > self.low) & (guess < self.high) & (self._n_steps % HALVED_EVERY != 0)
        self.at = np.where(self.is_done, at, np.where(is_in, guess, 0.5 * (self.low + self.high)))


def measured_snr_by_class(
    layout: Layout,
    frames: Any,
    dark: Any,
    *,
    bits: int | None = None,
    full_well_e: ArrayLike | None = None,
    classes: ArrayLike | None = None,
) -> SnrTable:
    """
    Measure signal and noise of each class of sites from frames of one scene and dark frames.

    Parameters
    ----------
    layout : Layout
    frames, dark : (n_frame, n_site) DN, or lists of codes or captures
        Two frames or more. Codes of captures are made linear, as their settings say; others must be:
        :func:`foveasim.sensor.linearise`.
    bits : int, optional
        Of the codes, to tell saturation; taken from captures by default.
    full_well_e : float or (n_site,), optional, e-
        Full wells, to tell saturation by captures' electrons; taken from their settings by default. Codes alone do not tell
        that a well is full: without captures only saturation of the codes is told.
    classes : (n_site,), optional
        As for :func:`snr_by_class`.

    Returns
    -------
    SnrTable

    Raises
    ------
    ParameterError
        When shapes do not fit together, there are fewer than two frames, the bits are not known, or captures' settings do
        not tell the full well of every site.

    Notes
    -----
    The variance is that of the codes, and no less than the 1/12 DN² of quantisation (times the square of the code's width where
    codes are companded). Where noise spans more than one code it is that of :func:`snr_by_class`; inside one code, frames do
    not show what there is of noise, and the ratio is an upper bound. A bent response is not made straight.
    """
    require_layout(layout)
    captures = frames if isinstance(frames, Sequence) and all(isinstance(frame, Capture) for frame in frames) else ()
    if bits is None:
        first = frames[0] if isinstance(frames, Sequence) and len(frames) else None
        bits = getattr(first, "bits", None)
        if bits is None:
            raise ParameterError("bits", "must be given where frames are no captures")
    bits = check_count("bits", bits, at_most=16)
    codes, dark_codes = codes_of("frames", frames), codes_of("dark", dark)
    for name, some in (("frames", codes), ("dark", dark_codes)):
        if some.shape[1] != layout.n_sites:
            raise ParameterError(name, f"must have the layout's {layout.n_sites} sites", some.shape[1])
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    is_saturated = _is_near(codes.mean(axis=0), codes.var(axis=0, ddof=1), 2**bits - 1.5)
    well_e = _full_well_e(captures, full_well_e, layout.n_sites)
    if well_e is not None:
        mean_e = np.mean([capture.electrons for capture in captures], axis=0)
        is_saturated |= _is_near(mean_e, mean_e, well_e)
    converter = _converter(captures, bits)
    linear_dn, dark_dn = (np.interp(some, np.arange(2.0**bits), converter.linear_dn) for some in (codes, dark_codes))
    floor_dn2 = QUANTISATION_DN2 * np.square(converter.width_of_code_dn(codes.mean(axis=0)))
    noise_dn2 = np.maximum(linear_dn.var(axis=0, ddof=1), floor_dn2)
    return _table(groups, layout.area_um2, linear_dn.mean(axis=0) - dark_dn.mean(axis=0), noise_dn2, is_saturated)


def _converter(captures: Sequence[Capture], bits: int) -> Converter:
    """Converter that made the codes, as captures' settings specify it; a linear one where they do not."""
    settings = captures[0].settings.get("sensor", {}) if captures else {}
    names = ("companding", "log_strength", "companding_table", "inl_dn")
    return Converter(bits=bits, **{name: settings[name] for name in names if name in settings})


def _sensor_and_layout(camera: Camera) -> tuple[Sensor, Layout]:
    if not isinstance(camera, Camera):
        raise ParameterError("camera", f"must be a foveasim.Camera, got a {type(camera).__name__}")
    assert isinstance(camera.sensor.layout, Layout)  # a camera takes no other
    return camera.sensor, camera.sensor.layout


def _full_well_e(captures: Sequence[Capture], full_well_e: ArrayLike | None, n_sites: int) -> Floats | None:
    """Wells of the captures' sites, one or (n_site,); None where there are none, or no captures."""
    if full_well_e is None:
        if not captures:
            return None
        full_well_e = captures[0].settings.get("sensor", {}).get("full_well_e")
        if isinstance(full_well_e, Mapping):
            raise ParameterError("full_well_e", "must be given: the captures' settings do not tell it of every site")
        if full_well_e is None:
            return None
    elif not captures:
        raise ParameterError("full_well_e", "goes with captures: codes alone do not tell the charge")
    well_e = finite_array("full_well_e", full_well_e, above=0.0)
    if well_e.shape not in ((), (n_sites,)):
        raise ParameterError("full_well_e", f"must be one number, or one for each of the {n_sites} sites", well_e.shape)
    return well_e


def _is_near(value: Floats, variance: Floats, limit: Floats | float) -> Bools:
    """Whether a limit is within some standard deviations of a value, or below it."""
    return np.asarray(value + CUT_OFF_SIGMAS * np.sqrt(variance) >= limit)


def _linear_codes(found: SiteSignals) -> tuple[Floats, Floats, Bools]:
    """Signal in linear codes, its variance, and whether sites are saturated, (n_site,) each."""
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
