"""
Photon transfer: mean and variance of codes over irradiance levels, per class of sites.

The temporal variance follows EMVA 1288, Release 4.0 Linear (https://www.emva.org/standards-technology/emva-1288/). For two
frames of one level it is half the mean square of their difference, less half the square of the difference of their means.
This excludes fixed patterns and global flicker. For more than two frames, the sample variance over frames is used in the
same way. The spatial variance is the variance of the site means over frames, less the temporal variance of a single frame
over the number of frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import Limits, OwnCheck
from foveasim._core.validation import (
    Floats,
    Ints,
    as_numbers,
    check_count,
    check_per_site,
    finite_array,
    frozen_array,
    read_only,
    unmasked,
)
from foveasim.errors import ParameterError, type_name
from foveasim.sensor import Sensor
from foveasim.sensor.adc import QUANTISATION_DN2
from foveasim.sensor.limits import EXPOSURE, FRAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "PhotonTransfer",
    "SiteClasses",
    "above_dark",
    "codes_of",
    "draw_frames",
    "is_linear",
    "measure_subsets",
    "photon_transfer",
    "predicted_photon_transfer",
    "slopes",
]

#: Upper limit of the levels used for the gain, in fractions of saturation (EMVA 1288).
LINEAR_FRACTION = 0.7
#: Variance in DN² below which quantisation masks the dark noise (EMVA 1288).
MIN_DARK_DN2 = 0.24


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """
    Mean and variance of codes at several irradiance levels, for each class of sites.

    Attributes
    ----------
    classes : (n_class,)
        Labels of the classes, sorted.
    n_sites : (n_class,) int64
        Sites of each class.
    n_frames : (n_level,) int64
        Frames of each level; 0 for a prediction.
    mean_dn : (n_level, n_class) float64, DN
        Mean code over sites and frames.
    temporal_variance_dn2 : (n_level, n_class) float64, DN²
        Variance between frames, averaged over the sites; its expectation is ``1 - 1 / n_sites`` times the site variance.
    spatial_variance_dn2 : (n_level, n_class) float64, DN²
        Variance between sites without the temporal part; a measured estimate may be negative.
    """

    classes: NDArray[Any]
    n_sites: Ints
    n_frames: Ints
    mean_dn: Floats
    temporal_variance_dn2: Floats
    spatial_variance_dn2: Floats

    def __post_init__(self) -> None:
        shape = (np.size(self.n_frames), np.size(self.classes))
        for name in ("mean_dn", "temporal_variance_dn2", "spatial_variance_dn2"):
            values = finite_array(name, getattr(self, name))
            if values.shape != shape:
                raise ParameterError(name, f"must have shape (n_level, n_class) = {shape}, got {values.shape}")
            object.__setattr__(self, name, frozen_array(values))
        for name in ("classes", "n_sites", "n_frames"):
            object.__setattr__(self, name, frozen_array(np.asarray(unmasked(name, getattr(self, name)))))

    def __repr__(self) -> str:
        return f"PhotonTransfer({self.n_frames.size} levels, {self.classes.size} classes of {self.n_sites.sum()} sites)"

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per level and class."""
        return [
            {
                "level": level,
                "class": label,
                "n_frames": int(self.n_frames[level]),
                "mean_dn": float(self.mean_dn[level, k]),
                "temporal_variance_dn2": float(self.temporal_variance_dn2[level, k]),
                "spatial_variance_dn2": float(self.spatial_variance_dn2[level, k]),
            }
            for level in range(self.n_frames.size)
            for k, label in enumerate(self.classes.tolist())
        ]

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Draw the temporal variance of each class against its mean on matplotlib axes."""
        from foveasim.view import plot_curves

        curves: dict[str, tuple[Floats, Floats]] = {
            f"class {label}" if self.classes.size > 1 else "": (self.mean_dn[:, k], self.temporal_variance_dn2[:, k])
            for k, label in enumerate(self.classes.tolist())
        }
        labels = "mean code / DN", "temporal variance / DN²"
        return plot_curves(curves, *labels, logarithmic="xy", marker=".", ax=ax)

    def _repr_html_(self) -> str:
        from foveasim.view import to_html

        return to_html(self)

    @property
    def saturation_level(self) -> Ints:
        """Index of the saturation level (highest temporal variance, EMVA 1288), (n_class,)."""
        return np.asarray(self.temporal_variance_dn2.argmax(axis=0), np.int64)

    def gain_dn_per_e(self, dark: PhotonTransfer | None = None) -> Floats:
        """
        Compute the system gain from dark-corrected temporal variance against mean.

        Parameters
        ----------
        dark : PhotonTransfer, optional
            Dark frames, as one level or one for each level; the first level by default.

        Returns
        -------
        gain : (n_class,) float64, DN/e-
            Slope of a least-squares line through the origin, over levels up to 70 % of saturation.

        Raises
        ------
        ParameterError
            When the dark levels are inconsistent, no level has a signal, or the first level is not dark and ``dark`` is not
            given.
        """
        mean_dn, variance_dn2 = above_dark(self, dark)
        return slopes("levels", mean_dn, variance_dn2, is_linear(mean_dn, self.saturation_level))

    def dark_noise_e(self, dark: PhotonTransfer | None = None) -> Floats:
        """
        Compute the temporal dark noise without quantisation noise.

        Parameters
        ----------
        dark : PhotonTransfer, optional
            Dark frames, of which the first level is used; the first level of this curve by default.

        Returns
        -------
        noise : (n_class,) float64, e-
            ``sqrt(variance - 1/12) / gain``: read noise and dark-current shot noise. If the variance is below 0.24 DN²,
            quantisation masks it, and the result is the upper bound ``0.40 / gain``.

        Raises
        ------
        ParameterError
            As for :meth:`gain_dn_per_e`.
        """
        variance_dn2 = (self if dark is None else dark).temporal_variance_dn2[0]
        return np.sqrt(np.maximum(variance_dn2, MIN_DARK_DN2) - QUANTISATION_DN2) / self.gain_dn_per_e(dark)


class SiteClasses:
    """
    Class labels of sites, and statistics over the sites of each class.

    With ``n_blocks``, each class is divided into at most this number of blocks of consecutive sites, and statistics of subsets
    are those of all sites, and of all sites without one of the blocks, for the jackknife.

    Attributes
    ----------
    labels, n_sites : (n_class,)
        Labels, sorted, and sites of each class.
    class_index : (n_site,) int64
    n_blocks_of_class : (n_class,) int64
    """

    def __init__(self, classes: ArrayLike | None, n_sites: int, n_blocks: int = 0) -> None:
        labels = np.zeros(n_sites, np.int64) if classes is None else np.asarray(unmasked("classes", classes))
        check_per_site("classes", labels, n_sites)
        self.labels: Ints
        self.class_index: Ints
        self.labels, self.class_index = np.unique(labels, return_inverse=True)
        self.n_sites: Ints = np.bincount(self.class_index).astype(np.int64)
        if self.n_sites.min(initial=n_sites) < 2:
            few = self.labels[self.n_sites < 2].tolist()
            raise ParameterError("classes", "must have at least two sites each", few)
        self._n_blocks = n_blocks
        self.n_blocks_of_class: Ints = np.minimum(max(n_blocks, 1), self.n_sites)
        order = np.argsort(self.class_index, kind="stable")
        first = np.concatenate(([0], np.cumsum(self.n_sites)))
        rank = np.empty(n_sites, np.int64)
        rank[order] = np.arange(n_sites) - first[self.class_index[order]]
        block = rank * self.n_blocks_of_class[self.class_index] // self.n_sites[self.class_index]
        self._block_of_site = self.class_index * max(n_blocks, 1) + block
        self._subset_sizes = self._subset_sums(np.ones(n_sites))

    def _subset_sums(self, values: Floats) -> Floats:
        """Compute sums over the subsets: (1 + n_block, n_class) from (n_site,)."""
        shape = self.n_sites.size, max(self._n_blocks, 1)
        of_blocks = np.bincount(self._block_of_site, weights=values, minlength=shape[0] * shape[1]).reshape(shape).T
        total = of_blocks.sum(axis=0)
        return np.concatenate((total[None], total - of_blocks)) if self._n_blocks else total[None]

    def subset_means(self, values: Floats) -> Floats:
        """Compute means over the subsets: (1 + n_block, n_class) from (n_site,)."""
        return self._subset_sums(values) / self._subset_sizes

    def subset_variances(self, values: Floats) -> Floats:
        """Compute sample variances over the subsets: (1 + n_block, n_class) from (n_site,)."""
        off = values - self.mean(values)[self.class_index]
        with np.errstate(divide="ignore", invalid="ignore"):  # subsets of one site
            correction = self._subset_sizes / (self._subset_sizes - 1.0)
            return (self.subset_means(off * off) - self.subset_means(off) ** 2) * correction

    def mean(self, values: Floats) -> Floats:
        """Compute the mean over the sites of each class: (n_class,) from (n_site,)."""
        return np.bincount(self.class_index, weights=values) / self.n_sites

    def variance(self, values: Floats) -> Floats:
        """Compute the sample variance over the sites of each class: (n_class,) from (n_site,)."""
        off = values - self.mean(values)[self.class_index]
        return np.bincount(self.class_index, weights=off * off) / (self.n_sites - 1)


def draw_frames(
    sensor: Sensor,
    expected_e: ArrayLike,
    *,
    n_frames: Annotated[int, FRAMES] = 2,
    seed: int,
    first_frame: Annotated[int, Limits(at_least=0)] = 0,
    exposure_s: Annotated[float | None, EXPOSURE] = None,
    n_threads: int | None = None,
) -> NDArray[Any]:
    """
    Simulate several frames at one irradiance level.

    Parameters
    ----------
    sensor : Sensor
    expected_e : number or (n_site,) float64, e-
        Expected charge, as returned by :meth:`Sensor.expected_electrons`.
    n_frames : int
    seed, first_frame : int
        Seed of the noise and index of the first frame. Equal numbers give bit-identical frames for any number of threads.
    exposure_s : float, optional, s
        Exposure time, for sensors whose collection depends on it.
    n_threads : int, optional

    Returns
    -------
    codes : (n_frame, n_site) uint8 or uint16, DN

    Raises
    ------
    ParameterError
        When a number is out of range, or ``expected_e`` does not have one value per site.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(50, 50, 3.0), capacitance_f=1.6e-15, v_sat_v=1.0, bits=12
    ... )
    >>> frames = fs.metrics.draw_frames(sensor, np.full(2500, 1000.0), n_frames=4, seed=0)
    >>> frames.shape
    (4, 2500)
    """
    level_e = _level("expected_e", expected_e, sensor.layout.n_sites)
    codes = []
    for k in range(n_frames):
        frame = first_frame + k
        electrons = sensor.collect(level_e, seed=seed, frame=frame, exposure_s=exposure_s, n_threads=n_threads)
        codes.append(sensor.read(electrons, seed=seed, frame=frame, n_threads=n_threads))
    return np.stack(codes)


def photon_transfer(
    source: OwnCheck[Sensor | Sequence[Any]],
    expected_e: Sequence[ArrayLike] | Floats | None = None,
    *,
    classes: ArrayLike | None = None,
    n_frames: int = 2,
    seed: int | None = None,
    exposure_s: float | None = None,
    n_threads: int | None = None,
) -> PhotonTransfer:
    """
    Compute mean, temporal and spatial variance of codes for each level and class.

    Parameters
    ----------
    source : Sensor, or sequence of levels
        Sensor whose frames are simulated; or frames: two or more for each level, as an array ``(n_frame, n_site)`` in DN, or
        as a list of codes or of :class:`foveasim.Capture`.
    expected_e : (n_level,) or (n_level, n_site) float64, or a sequence of either, e-
        With a sensor: expected charge at each level, as returned by :meth:`Sensor.expected_electrons`.
    classes : (n_site,), optional
        Class label of each site, such as its size or filter; a single class by default.
    n_frames, seed, n_threads
        With a sensor: frames per level, seed of the noise, and number of threads, which does not affect the result.
    exposure_s : float, optional, s
        With a sensor whose collection depends on it: exposure time of all levels.

    Returns
    -------
    PhotonTransfer

    Raises
    ------
    ParameterError
        When there are fewer than two frames in a level or two sites in a class, or shapes differ.

    Examples
    --------
    >>> import numpy as np
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=200, n_y=200, pitch_um=2.0),
    ...     bits=12,
    ...     capacitance_f=1e-15,
    ...     v_sat_v=1.0,
    ... )
    >>> curve = fs.metrics.photon_transfer(sensor, np.linspace(0.0, 6000.0, 13), seed=0)
    >>> bool(np.abs(curve.gain_dn_per_e() * 6241.5 / 4096 - 1.0) < 0.02)
    True
    """
    if isinstance(source, Sensor):
        if expected_e is None or seed is None:
            raise ParameterError("expected_e" if expected_e is None else "seed", "must be given for a sensor")
        sensor, n_frames = source, check_count("n_frames", n_frames, at_least=2, at_most=int(FRAMES.high))
        options: dict[str, Any] = {"seed": seed, "exposure_s": exposure_s, "n_threads": n_threads}
        frames = (
            draw_frames(sensor, level_e, n_frames=n_frames, first_frame=k * n_frames, **options)
            for k, level_e in enumerate(_levels(expected_e, sensor.layout.n_sites))
        )
        return measure_subsets(frames, classes=classes)[0]
    if expected_e is not None or seed is not None:
        raise ParameterError(
            "expected_e" if seed is None else "seed", "must not be given with frames; omit it, or give a sensor"
        )
    return measure_subsets(source, classes=classes)[0]


def measure_subsets(
    source: Iterable[Any], *, classes: ArrayLike | None = None, n_blocks: int = 0
) -> tuple[PhotonTransfer, tuple[Floats, Floats, Floats], SiteClasses]:
    """
    Compute the photon transfer of frames, for all sites and without each block of sites.

    ``source``, ``classes``: as for :func:`photon_transfer`. ``n_blocks``: largest number of blocks of each class, 0 for none.
    Returns ``subsets``: mean, temporal and spatial variance: first of all sites, then without each block.
    """
    measured, counts, n_sites = [], [], None
    if not isinstance(source, Iterable):
        raise ParameterError("source", f"must be a foveasim.Sensor or a list of levels, got {type_name(source)}")
    for k, frames in enumerate(source):
        codes = codes_of(f"frames[{k}]", frames)
        if n_sites is None:
            n_sites = codes.shape[1]
            groups = SiteClasses(classes, n_sites, n_blocks)
        if codes.shape[1] != n_sites:
            raise ParameterError(f"frames[{k}]", f"must have {n_sites} sites, as the first level", codes.shape[1])
        measured.append(_statistics(codes, groups))
        counts.append(codes.shape[0])
    if n_sites is None:
        raise ParameterError("frames", "must have at least one level")
    mean_dn, temporal_dn2, spatial_dn2 = (np.stack(values, axis=1) for values in zip(*measured, strict=True))
    levels_dn = [(mean_dn[0, k], temporal_dn2[0, k], spatial_dn2[0, k]) for k in range(len(measured))]
    return _transfer(groups, counts, levels_dn), (mean_dn, temporal_dn2, spatial_dn2), groups


def predicted_photon_transfer(
    sensor: Sensor,
    expected_e: Sequence[ArrayLike] | Floats,
    *,
    classes: ArrayLike | None = None,
    exposure_s: float | None = None,
    n_threads: int | None = None,
) -> PhotonTransfer:
    """
    Predict the result of :func:`photon_transfer` for infinitely many frames.

    The prediction is analytical (:meth:`Sensor.predict`).

    Parameters
    ----------
    sensor : Sensor
    expected_e : (n_level,) or (n_level, n_site) float64, or a sequence of either, e-
        Expected charge at each level.
    classes : (n_site,), optional
        Class label of each site.
    exposure_s : float, optional, s
        Exposure time, for sensors whose collection depends on it.
    n_threads : int, optional

    Returns
    -------
    PhotonTransfer
        ``n_frames`` is 0 for each level.

    Raises
    ------
    ParameterError
        As for :func:`photon_transfer`.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(4, 4, 3.0), capacitance_f=1.6e-15, v_sat_v=1.0, bits=12
    ... )
    >>> curve = fs.metrics.predicted_photon_transfer(
    ...     sensor, [np.full(16, e) for e in (1000.0, 4000.0)]
    ... )
    >>> slope = np.diff(curve.temporal_variance_dn2[:, 0]) / np.diff(curve.mean_dn[:, 0])
    >>> slope.round(4).tolist()  # DN per electron
    [0.4104]
    """
    groups = SiteClasses(classes, sensor.layout.n_sites)
    levels_dn = []
    for level_e in _levels(expected_e, sensor.layout.n_sites):
        mean_dn, variance_dn2 = sensor.predict(level_e, exposure_s=exposure_s, n_threads=n_threads)
        levels_dn.append((groups.mean(mean_dn), groups.mean(variance_dn2), groups.variance(mean_dn)))
    return _transfer(groups, [0] * len(levels_dn), levels_dn)


def codes_of(name: str, frames: Any) -> NDArray[Any]:
    """Return codes (n_frame, n_site) from an array, or a list of captures or arrays."""
    if not isinstance(frames, np.ndarray):
        try:
            frames = [getattr(frame, "code", frame) for frame in frames]
        except TypeError:
            raise ParameterError(name, "must be a list of frames") from None
    codes = as_numbers(name, frames, keep_type=True)
    if codes.ndim != 2 or codes.shape[0] < 2 or codes.shape[1] < 2:
        raise ParameterError(name, "must have shape (n_frame, n_site), with at least two of each", codes.shape)
    if codes.dtype.kind == "f" and not np.isfinite(codes).all():
        raise ParameterError(name, "must be finite everywhere")
    return codes


def _statistics(codes: NDArray[Any], groups: SiteClasses) -> tuple[Floats, Floats, Floats]:
    """Compute mean, temporal and spatial variance of subsets, (1 + n_block, n_class)."""
    n_frames = codes.shape[0]
    mean_dn = codes.mean(axis=0, dtype=np.float64)
    off = codes - mean_dn
    stack_dn2 = groups.subset_means((off * off).sum(axis=0) / (n_frames - 1))
    frame_means_dn = np.array([groups.subset_means(row) for row in off])
    temporal_dn2 = stack_dn2 - frame_means_dn.var(axis=0, ddof=1)
    return groups.subset_means(mean_dn), temporal_dn2, groups.subset_variances(mean_dn) - stack_dn2 / n_frames


def _transfer(
    groups: SiteClasses, n_frames: Sequence[int], levels_dn: Sequence[tuple[Floats, Floats, Floats]]
) -> PhotonTransfer:
    mean_dn, temporal_dn2, spatial_dn2 = (np.stack(values) for values in zip(*levels_dn, strict=True))
    return PhotonTransfer(
        classes=read_only(groups.labels),
        n_sites=read_only(groups.n_sites),
        n_frames=read_only(np.array(n_frames, np.int64)),
        mean_dn=mean_dn,
        temporal_variance_dn2=temporal_dn2,
        spatial_variance_dn2=spatial_dn2,
    )


def _level(name: str, expected_e: ArrayLike, n_sites: int) -> Floats:
    """Return the expected charge of one level at every site."""
    level_e = finite_array(name, expected_e, at_least=0.0)
    return np.broadcast_to(check_per_site(name, level_e, n_sites, or_one=True), n_sites)


def _levels(expected_e: Sequence[ArrayLike] | Floats, n_sites: int) -> list[Floats]:
    try:
        n_levels = len(expected_e)
    except TypeError:
        raise ParameterError("expected_e", "must be a list of levels", expected_e, "e-") from None
    if not n_levels:
        raise ParameterError("expected_e", "must have at least one level")
    if np.ndim(expected_e[0]) > 1:
        raise ParameterError("expected_e", "must have shape (n_level,) or (n_level, n_site)")
    return [_level(f"expected_e[{k}]", level_e, n_sites) for k, level_e in enumerate(expected_e)]


def above_dark(transfer: PhotonTransfer, dark: PhotonTransfer | None) -> tuple[Floats, Floats]:
    """Return the dark-corrected mean and temporal variance, (n_level, n_class)."""
    n_levels = transfer.n_frames.size
    if dark is None:
        if np.any(transfer.mean_dn[0] > transfer.mean_dn[-1]):
            raise ParameterError(
                "levels", "must begin with a dark level", hint="sort the levels, or give separate dark frames"
            )
        return (
            transfer.mean_dn - transfer.mean_dn[0],
            transfer.temporal_variance_dn2 - transfer.temporal_variance_dn2[0],
        )
    if dark.n_frames.size not in (1, n_levels) or not np.array_equal(dark.classes, transfer.classes):
        raise ParameterError("dark", f"must have the same classes, and one level or {n_levels}", dark.n_frames.size)
    return transfer.mean_dn - dark.mean_dn, transfer.temporal_variance_dn2 - dark.temporal_variance_dn2


def is_linear(mean_dn: Floats, saturation_level: Ints) -> NDArray[np.bool_]:
    """Return whether a level is at most 70 % of saturation, (n_level, n_class)."""
    return np.asarray(mean_dn <= LINEAR_FRACTION * np.take_along_axis(mean_dn, saturation_level[None, :], axis=0))


def slopes(name: str, x: Floats, y: Floats, is_used: NDArray[np.bool_]) -> Floats:
    """Fit lines through the origin to (..., n_level, n_class); return (..., n_class)."""
    squares = np.where(is_used, x * x, 0.0).sum(axis=-2)
    if not np.all(squares > 0.0):
        raise ParameterError(
            name, "must have a signal below 70 % of saturation for every class", hint="add levels of lower irradiance"
        )
    return np.asarray(np.where(is_used, x * y, 0.0).sum(axis=-2) / squares)
