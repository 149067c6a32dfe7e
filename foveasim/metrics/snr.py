"""Signal and noise of the sites of each size or class: predicted, without a draw, and measured from captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim.arrays import Floats, Ints, check_count, check_number, read_only
from foveasim.camera import Camera
from foveasim.errors import ParameterError
from foveasim.fields import PowerMap
from foveasim.layout import Layout
from foveasim.metrics.photon_transfer import SiteClasses, codes_of
from foveasim.scene import Scene

__all__ = ["SnrTable", "light_at_snr_fraction", "measured_snr_by_class", "size_classes_um", "snr_by_class"]

#: Sizes that differ by less than this share are one class.
SIZE_ROUNDING = 1e-6
#: The light at a ratio is found to this share, in at most so many steps.
SHARE_ROUNDING, MOST_STEPS = 1e-6, 60


@dataclass(frozen=True, eq=False, kw_only=True)
class SnrTable:
    """
    Signal and temporal noise of each class of sites.

    Attributes
    ----------
    classes : (n_class,)
        Labels of the classes, sorted.
    n_sites : (n_class,) int64
    size_um : (n_class,) float64, µm
        Mean square root of the sites' areas.
    signal_dn : (n_class,) float64, DN
        Mean code less that of darkness.
    noise_dn : (n_class,) float64, DN
        Root of the mean temporal variance.
    saturated_fraction : (n_class,) float64
        Share of the sites whose code is the highest, on average over frames to within half a code.
    """

    classes: NDArray[Any]
    n_sites: Ints
    size_um: Floats
    signal_dn: Floats
    noise_dn: Floats
    saturated_fraction: Floats

    @property
    def snr(self) -> Floats:
        """Signal over noise, (n_class,); infinite without noise, NaN where there is neither."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.signal_dn / self.noise_dn

    @property
    def snr_db(self) -> Floats:
        """The same in decibels, ``20 log10``, (n_class,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
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
        lines = ["    class    sites  size / µm  signal / DN  noise / DN     SNR  SNR / dB  saturated"]
        for row in self.records():
            label = f"{row['class']:.5g}" if isinstance(row["class"], float) else str(row["class"])
            lines.append(
                f"{label:>9}{row['n_sites']:9,}{row['size_um']:11.4g}{row['signal_dn']:13.5g}{row['noise_dn']:12.4g}"
                f"{row['snr']:8.4g}{row['snr_db']:10.4g}{100.0 * row['saturated_fraction']:9.3g} %"
            )
        return "\n".join(lines)


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
    Predicted signal and noise of each class of sites, by :meth:`Camera.predict`: without a draw.

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
    """
    exposure_s = check_number("exposure_s", exposure_s, at_least=0.0)
    sensor, layout = camera.sensor, camera.sensor.layout
    assert isinstance(layout, Layout)  # a camera takes no other
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    mean_dn, variance_dn2 = camera.predict(light, exposure_s=exposure_s)
    dark_dn, _ = sensor.predict(sensor.expected_electrons(np.zeros(layout.n_sites), exposure_s))
    highest = 2**sensor.bits - 1
    return _table(groups, layout.area_um2, mean_dn, variance_dn2, dark_dn, mean_dn > highest - 0.5)


def light_at_snr_fraction(
    camera: Camera, light: Scene | PowerMap, *, exposure_s: float, snr: float = 1.0, classes: ArrayLike | None = None
) -> Floats:
    """
    Share of a scene's light at which each class of sites has a signal-to-noise ratio: 1 for the least that can be seen.

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
        In the order of the sorted labels; more than 1 where the light given does not do. NaN where no light does: sites
        saturate before, or see nothing.

    Raises
    ------
    ParameterError, SimulationError
        As for :func:`snr_by_class`.

    Notes
    -----
    Found by predicting the codes at other shares until they fit, clips at darkness and quantisation included: without a
    pedestal the converter cuts off half the noise of darkness, and no formula tells the rest.
    """
    exposure_s = check_number("exposure_s", exposure_s, at_least=0.0)
    snr = check_number("snr", snr, above=0.0)
    sensor, layout = camera.sensor, camera.sensor.layout
    assert isinstance(layout, Layout)  # a camera takes no other
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    full_e = sensor.expected_electrons(camera.photoelectrons_per_s(light), exposure_s)
    dark_e = sensor.expected_electrons(np.zeros(layout.n_sites), exposure_s)
    dark_dn, _ = sensor.predict(dark_e)
    share = np.ones(groups.n_sites.size)
    for _ in range(MOST_STEPS):
        mean_dn, variance_dn2 = sensor.predict(dark_e + share[groups.of_site] * (full_e - dark_e))
        signal_dn, noise_dn = groups.mean(mean_dn - dark_dn), np.sqrt(groups.mean(variance_dn2))
        # The ratio grows as the light or as its root, so that each step at least halves what is off, as a power.
        off = np.clip(signal_dn / np.maximum(snr * noise_dn, np.finfo(float).tiny), 1e-3, 1e3)
        if np.abs(off - 1.0).max() < SHARE_ROUNDING:
            break
        share = np.clip(share / off, 1e-12, 1e12)
    return np.where(np.abs(off - 1.0) < SHARE_ROUNDING, share, np.nan)


def measured_snr_by_class(
    layout: Layout, frames: Any, dark: Any, *, bits: int | None = None, classes: ArrayLike | None = None
) -> SnrTable:
    """
    The same from frames of one scene and of darkness.

    Parameters
    ----------
    layout : Layout
    frames, dark : (n_frame, n_site) DN, or lists of codes or captures
        Two frames or more.
    bits : int, optional
        Of the codes, to tell saturation; taken from captures by default.
    classes : (n_site,), optional
        As for :func:`snr_by_class`.

    Returns
    -------
    SnrTable

    Raises
    ------
    ParameterError
        When shapes do not fit together, there are fewer than two frames, or the bits are not known.
    """
    if bits is None:
        first = frames[0] if isinstance(frames, Sequence) and len(frames) else None
        bits = getattr(first, "bits", None)
        if bits is None:
            raise ParameterError("bits", "must be given where frames are no captures")
    highest = 2 ** check_count("bits", bits, at_most=16) - 1
    codes, dark_codes = codes_of("frames", frames), codes_of("dark", dark)
    for name, some in (("frames", codes), ("dark", dark_codes)):
        if some.shape[1] != layout.n_sites:
            raise ParameterError(name, f"must have the layout's {layout.n_sites} sites", some.shape[1])
    groups = SiteClasses(size_classes_um(layout) if classes is None else classes, layout.n_sites)
    mean_dn = codes.mean(axis=0)
    return _table(
        groups,
        layout.area_um2,
        mean_dn,
        codes.var(axis=0, ddof=1),
        dark_codes.mean(axis=0),
        mean_dn > highest - 0.5,
    )


def _table(
    groups: SiteClasses,
    area_um2: Floats,
    mean_dn: Floats,
    variance_dn2: Floats,
    dark_dn: Floats,
    is_full: NDArray[np.bool_],
) -> SnrTable:
    return SnrTable(
        classes=read_only(groups.labels),
        n_sites=read_only(groups.n_sites),
        size_um=read_only(groups.mean(np.sqrt(area_um2))),
        signal_dn=read_only(groups.mean(mean_dn - dark_dn)),
        noise_dn=read_only(np.sqrt(groups.mean(variance_dn2))),
        saturated_fraction=read_only(groups.mean(is_full.astype(np.float64))),
    )
