"""
Quantities of real and simulated frames, and intervals of their differences.

Both are measured by the same functions, on the same photosites: what noise and biases they have is equal for equal cameras.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Floats, Ints
from foveasim.camera import Camera
from foveasim.camera._colour import colour_correction
from foveasim.errors import ParameterError
from foveasim.metrics.emva_intervals import CONFIDENCE, Jackknife
from foveasim.metrics.photon_transfer import SiteClasses, measure_subsets, slopes
from foveasim.metrics.slanted_edge import EdgeMtf, slanted_edge_mtf
from foveasim.scene import Scene, charts
from foveasim.scene._colorimetry import LUMINANCE_WEIGHTS, lab_of, patch_colours
from foveasim.scene._illuminants import Illuminant
from foveasim.scene.charts import PATCH_NAMES
from foveasim.twin.pictures._target_scenes import WAVES_NM, WIDTHS_NM
from foveasim.units import per_mm_from_per_um

__all__ = ["CAMERAS", "SPATIAL", "Deviation", "DeviationTable", "Pair", "has_sites"]

#: Titles of the curves, and of the noise.
CAMERAS, SPATIAL, TEMPORAL = ("real", "simulated"), "spatial noise", "temporal noise"
#: Blocks of sites of the jackknife.
N_BLOCKS = 100
#: Frequencies of the MTF that are compared, in fractions of the Nyquist frequency of the pitch.
MTF_FRACTIONS = (0.25, 0.5, 0.75, 1.0)
#: Smallest signal of a patch, relative to the brightest one, up to which its weight in the system gain increases.
MIN_SIGNAL_FRACTION = 0.05
#: Patches of the white balance: greys without the brightest and the darkest.
BALANCED = list(range(19, 23))


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """
    A quantity of a real and a simulated camera, and the interval of the difference.

    Attributes
    ----------
    quantity, unit : str
    part : str
        Patch, ring or frequency; empty for the complete target.
    channel : str
        Colour filter; empty for all.
    real, simulated, difference : float
        In ``unit``; the difference is real minus simulated.
    low, high : float
        Confidence interval of the difference: of all rows of a table together.
    is_within : bool
        Whether the interval contains 0: noise explains the difference.
    """

    quantity: str
    part: str
    channel: str
    unit: str
    real: float
    simulated: float
    difference: float
    low: float
    high: float
    is_within: bool


class Pair(NamedTuple):
    """Codes (n_frame, n_site) or values (n_site,) of both cameras."""

    real: NDArray[Any]
    simulated: NDArray[Any]


def has_sites(camera: Camera) -> Bools:
    """Return which filters have photosites, (n_filter,)."""
    return np.asarray(np.bincount(camera.sensor.filter_of_site, minlength=camera.sensor.n_filters) > 0)


class _Row(NamedTuple):
    """A quantity of both cameras, with the standard error of its difference."""

    quantity: str
    part: str
    channel: str
    unit: str
    real: float
    simulated: float
    error: float
    freedom: float


class DeviationTable:
    """
    Compared quantities, whose intervals are simultaneous.

    ``has_temporal``: whether the noise of several frames is that between them.
    """

    def __init__(self, camera: Camera, *, has_temporal: bool = True) -> None:
        self._camera, self._has_temporal, self._rows = camera, has_temporal, list[_Row]()
        self._filters = camera.sensor.filter_of_site
        self._names = ["" if has_sites(camera).sum() == 1 else name for name in camera.sensor.filter_names]

    def noise_of(self, frames: Pair) -> str:
        """Return the title of the noise of frames."""
        return TEMPORAL if self._has_temporal and len(frames.real) > 1 else SPATIAL

    def deviations(self) -> tuple[Deviation, ...]:
        """Return all rows with their intervals."""
        from scipy.special import stdtrit

        found = []
        for row in self._rows:
            difference = row.real - row.simulated
            half = row.error * float(stdtrit(row.freedom, 1.0 - 0.5 * (1.0 - CONFIDENCE) / len(self._rows)))
            low, high = difference - half, difference + half
            given = row._asdict()
            del given["error"], given["freedom"]
            found.append(Deviation(**given, difference=difference, low=low, high=high, is_within=low <= 0.0 <= high))
        return tuple(found)

    def _add(self, quantity: str, unit: str, parts: Sequence[tuple[str, str]], pair: Pair, groups: SiteClasses) -> None:
        """Add a quantity of parts and channels: values (1 + n_block, n_part), of subsets of sites."""
        jackknife = Jackknife(np.full(len(parts), groups.n_blocks_of_class.max()))
        error = jackknife.error(pair.real - pair.simulated)
        for k, (part, channel) in enumerate(parts):
            real, simulated = (float(values[0, k]) for values in pair)
            freedom = float(groups.n_blocks_of_class.max() - 1)
            self._rows.append(_Row(quantity, part, channel, unit, real, simulated, float(error[k]), freedom))

    def _classes(self, labels: Ints) -> tuple[Bools, SiteClasses, Ints, Ints]:
        """Return the sites of patches, their classes by patch and filter, and both of each class."""
        used = labels >= 0
        n_filters = len(self._names)
        groups = SiteClasses(labels[used] * n_filters + self._filters[used], int(used.sum()), N_BLOCKS)
        patch, channel = np.divmod(groups.labels, n_filters)
        return used, groups, patch, channel

    def add_signals(
        self,
        pair: Pair,
        labels: Ints,
        names: Sequence[str],
        titles: tuple[str, str] | None = None,
        darks: Pair | None = None,
    ) -> dict[str, tuple[Floats, Floats]]:
        """Add level and noise of patches, and the system gain; return noise against level."""
        used, groups, patch, channel = self._classes(labels)
        is_temporal = self.noise_of(pair) == TEMPORAL
        title, noise_title = titles or ("mean code", self.noise_of(pair))
        mean, variance = (
            Pair(*parts)
            for parts in zip(
                *(_moments(codes[:, used], groups, is_temporal=is_temporal) for codes in pair), strict=True
            )
        )
        parts = [(names[p], self._names[c]) for p, c in zip(patch.tolist(), channel.tolist(), strict=True)]
        noise = Pair(*(np.sqrt(np.maximum(values, 0.0)) for values in variance))
        self._add(title, "DN", parts, mean, groups)
        self._add(noise_title, "DN", parts, noise, groups)
        shape = np.unique(patch).size, np.unique(channel).size
        if is_temporal and shape[0] > 1:
            dark_used, dark_groups, *_ = self._classes(np.zeros_like(labels))
            zero = None
            if darks is not None and len(darks.real) > 1:
                zero = [_moments(codes[:, dark_used], dark_groups, is_temporal=is_temporal) for codes in darks]
            gains = []
            for k, moments in enumerate(zip(mean, variance, strict=True)):
                level, noise2 = (values.reshape(-1, *shape) for values in moments)
                darkest = int(level[0].sum(axis=1).argmin())
                offset, noise0 = (level[:, darkest], noise2[:, darkest]) if zero is None else zero[k]
                signal, shot = level - offset[:, np.newaxis], noise2 - noise0[:, np.newaxis]
                # The standard error of a variance is proportional to it: relative weights, limited for dark patches.
                brightest = signal[0].max(axis=0)
                weight = 1.0 / np.maximum(signal[0], np.where(brightest > 0.0, MIN_SIGNAL_FRACTION * brightest, 1.0))
                signal, shot = weight * signal, weight * shot
                gains.append(slopes("frames", signal, shot, np.ones(shape, bool)))
            channels = [("", self._names[c]) for c in np.unique(channel).tolist()]
            self._add("system gain", "DN/e-", channels, Pair(*gains), groups)
        return {
            f"{title} {self._names[c]}".strip(): (levels[0, channel == c], noises[0, channel == c])
            for c in np.unique(channel).tolist()
            for title, levels, noises in zip(CAMERAS, mean, noise, strict=True)
        }

    def add_edges(self, pair: Pair, used: Bools) -> dict[str, tuple[Floats, Floats]]:
        """Add the MTF of each filter; return its curves."""
        curves: dict[str, tuple[Floats, Floats]] = {}
        for channel in np.unique(self._filters[used]).tolist():
            where, name = used & (self._filters == channel), self._names[channel]
            edges = [slanted_edge_mtf(self._camera.layout, values, where=where) for values in pair]
            curves |= {
                f"{title} {name}".strip(): (e.frequency_per_mm, e.mtf) for title, e in zip(CAMERAS, edges, strict=True)
            }
            found = [[(edge.mtf50_per_mm, _mtf50_error_per_mm(edge)) for edge in edges]]
            at_per_mm = np.array(MTF_FRACTIONS) * float(per_mm_from_per_um(0.5 / edges[0].pitch_um))
            found += [[(_at(f, e, e.mtf), _at(f, e, e.mtf_sigma)) for e in edges] for f in at_per_mm.tolist()]
            titles = [("MTF50", "", name, "per mm"), *(("MTF", f"{f:.4g} per mm", name, "") for f in at_per_mm)]
            for title, ((real, error), (simulated, other)) in zip(titles, found, strict=True):
                if math.isnan(real - simulated):  # no MTF50 below the highest frequency
                    continue
                self._rows.append(_Row(*title, real, simulated, math.hypot(error, other), math.inf))
        return curves

    def add_rings(self, charges: Pair, rings: Ints) -> dict[str, tuple[Floats, Floats]]:
        """Add the relative illumination, a mean over filters; return it by ring."""
        used, groups, ring, _ = self._classes(rings)
        n_rings = np.unique(ring).size
        levels = [groups.subset_means(values[used]).reshape(1 + N_BLOCKS, n_rings, -1) for values in charges]
        relative = Pair(*((level / level[:, :1]).mean(axis=2) for level in levels))
        parts = [(f"{k / n_rings:.0%} to {(k + 1) / n_rings:.0%} of the radius", "") for k in range(1, n_rings)]
        self._add("relative illumination", "", parts, Pair(*(values[:, 1:] for values in relative)), groups)
        centre = np.arange(n_rings, dtype=np.float64) + 0.5
        return {title: (centre, values[0]) for title, values in zip(CAMERAS, relative, strict=True)}

    def add_colours(self, charges: Pair, patches: Ints, scene: Scene | None, illuminant: Illuminant) -> None:
        """Add CIELAB and the colour errors of the chart after white balance and one matrix."""
        from skimage.color import deltaE_ciede2000

        sensor = self._camera.sensor
        correction = None if scene is None else colour_correction(sensor, scene)
        exact = patch_colours(charts.illuminant(illuminant, WAVES_NM), WAVES_NM, WIDTHS_NM)
        if correction is None or exact is None:
            raise ParameterError("camera", "must have three different colour filters for a colour chart")
        used, groups, *_ = self._classes(patches)
        matrix = correction.matrix[:, has_sites(self._camera)]
        white = float((exact[BALANCED] @ LUMINANCE_WEIGHTS).sum())
        labs = []
        for values in charges:
            levels = groups.subset_means(values[used]).reshape(1 + N_BLOCKS, len(PATCH_NAMES), -1)
            balanced = levels * white / levels[:, BALANCED].sum(axis=1, keepdims=True)
            labs.append(lab_of((balanced @ matrix.T).reshape(-1, 3)).reshape(1 + N_BLOCKS, -1, 3))
        parts = [(name, "") for name in PATCH_NAMES]
        for k, axis in enumerate(("L*", "a*", "b*")):
            self._add(axis, "", parts, Pair(*(lab[..., k] for lab in labs)), groups)
        errors = Pair(*(deltaE_ciede2000(np.broadcast_to(lab_of(exact), lab.shape), lab) for lab in labs))
        self._add("colour error (CIE 2000)", "", parts, errors, groups)
        means = Pair(*(values.mean(axis=1, keepdims=True) for values in errors))
        self._add("mean colour error (CIE 2000)", "", [("", "")], means, groups)


def _moments(codes: NDArray[Any], groups: SiteClasses, *, is_temporal: bool) -> tuple[Floats, Floats]:
    """Return mean and noise variance of subsets, (1 + n_block, n_class)."""
    if is_temporal:
        classes = groups.labels[groups.class_index]
        mean, temporal, _ = measure_subsets([codes], classes=classes, n_blocks=N_BLOCKS)[1]
        return mean[:, 0], temporal[:, 0]
    values = codes[0].astype(np.float64)
    return groups.subset_means(values), groups.subset_variances(values)


def _at(frequency_per_mm: float, edge: EdgeMtf, values: Floats) -> float:
    """Return values along the frequencies of an MTF, interpolated at one of them."""
    return float(np.interp(frequency_per_mm, edge.frequency_per_mm, values))


def _mtf50_error_per_mm(edge: EdgeMtf) -> float:
    """Return the standard error of MTF50, from that of the MTF and its slope."""
    slope = np.gradient(edge.mtf, edge.frequency_per_mm)
    return abs(_at(edge.mtf50_per_mm, edge, edge.mtf_sigma) / _at(edge.mtf50_per_mm, edge, slope))
