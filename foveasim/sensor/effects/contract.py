"""
Base classes of effects: noise sources, fixed patterns and crosstalk.

The sensor chain is an ordered tuple of effects. All results of a sensor (random draws, predictions, the noise budget, the
weights of reconstructions and HDR merges) use only :meth:`Effect.apply`, :meth:`Effect.moments` and :meth:`Effect.linearise`,
which follows from the moments by default.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.caches import BoundedCache
from foveasim._core.random_streams import random_key
from foveasim._core.registry import Registry
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, read_only
from foveasim.errors import ParameterError, SimulationError
from foveasim.fields import PackedRings
from foveasim.sensor.device import Device

if TYPE_CHECKING:
    from foveasim.sensor.effects.crosstalk import CrosstalkOperator

__all__ = [
    "EFFECTS",
    "STAGES",
    "AdditiveNoise",
    "Effect",
    "FixedFactor",
    "FixedOffset",
    "GroupedNoise",
    "Photosites",
    "Reach",
    "Sites",
    "Stage",
    "StepModel",
]

T = TypeVar("T")
#: Variance of values without noise.
NOTHING = read_only(np.zeros(1))
#: Default of the capacitance per area of a site: 2,809 e-/µm² at 3 V.
CAPACITANCE_F_PER_UM2 = 1.5e-16
#: Cached values of a sensor: several times those of all standard effects.
MAX_CACHED = 64
#: Sites on which the result of an effect at a site depends.
Reach = Literal["site", "group", "all"]
REACHES: tuple[Reach, ...] = ("site", "group", "all")
#: Stage of the chain at which an effect acts.
Stage = Literal["photo", "dark", "expected", "collection", "charge", "sense_node", "output"]
#: Unit of the values at each stage, in the order of the chain.
STAGES: Mapping[Stage, str] = MappingProxyType(
    {
        "photo": "e-/s",  # photocurrent
        "dark": "e-/s",  # dark current
        "expected": "e-",  # expected charge
        "collection": "e-",  # the single shot-noise draw
        "charge": "e-",  # collected charge
        "sense_node": "V",  # charge over capacitance
        "output": "V",  # after the nonlinearity, before clipping and conversion
    }
)


#: Difference of means, relative to the mean, from which slopes are computed, and the smallest mean to which it is relative. A
#: power of 2 has no rounding of its own; that of the slope of a proportional effect is below 1e-12.
SLOPE_STEP, SMALLEST_MEAN = 2.0**-10, MappingProxyType({"e-/s": 1.0, "e-": 1.0, "V": 1e-6})


class StepModel(NamedTuple):
    """
    First-order model of an effect at the mean of each site.

    Attributes
    ----------
    mean : (..., n) or (1,), unit of the stage
        Mean after the effect.
    slope : None, (..., n), (1,), or CrosstalkOperator
        Derivative of this mean with respect to the mean before the effect; None for 1, an operator for effects that mix sites.
    deviation : None, (..., n) or (1,), unit of the stage
        Standard deviation that the effect adds; None for 0.
    groups : None or (n,) int
        Label of the draw of each site, for effects whose draws are common to groups of sites; None for a draw per site.
    """

    mean: Floats
    slope: Floats | CrosstalkOperator | None = None
    deviation: Floats | None = None
    groups: Ints | None = None

    def __repr__(self) -> str:
        return short_repr(self)


class Photosites(PackedRings, Protocol):
    """Protocol of photosite layouts for sensors, implemented by :class:`foveasim.Layout`."""

    @property
    def n_sites(self) -> int:
        """Number of sites."""

    @property
    def area_um2(self) -> Floats:
        """Area of each site, (n_site,) µm²."""

    @property
    def centroid_um(self) -> Floats:
        """Centroid of each site, (n_site, 2) µm."""

    @property
    def channel(self) -> Ints:
        """Index of each site's colour filter, (n_site,)."""

    @property
    def readout_line(self) -> Ints:
        """Readout line of each site, (n_site,)."""

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Data columns per site by name; colour layouts have ``channel``."""

    def __getitem__(self, selection: Any) -> Any:
        """Return the layout of some of the sites."""

    def adjacency(self, *, max_gap_um: float | None = None) -> Any:
        """Return the lengths of shared edges, (n_site, n_site) sparse, µm."""


def select_indices(selection: slice | Ints, index: slice | Ints, n: int) -> slice | Ints:
    """Return the indices of some of the selected elements among all ``n``; slices have step 1."""
    if not isinstance(selection, slice):
        return selection[index]
    chosen = range(n)[selection]
    if not isinstance(index, slice):
        return np.asarray(chosen.start + index)
    chosen = chosen[index]
    return slice(chosen.start, chosen.stop)


@dataclass(frozen=True, eq=False)
class Sites:
    """
    Photosites that an effect acts on: all sites of a layout, or a block of them.

    Attributes
    ----------
    layout : Layout
        All photosites: of the complete layout, also in tiles, for effects that need it (:attr:`Effect.needs_layout`).
    known_device : Device or None
        Device with its fixed patterns. With None, moments are over all devices of the kind.
    exposure_s : float or None, s
        Exposure time, for collections that need it; None if it is unknown. Cached results do not depend on it.
    given_f : (n_site,) or (1,) float64, F, or None
        Capacitance of the sense nodes of all photosites; None for one in proportion to their areas.
    index : slice or (n,) int64
        Indices of these sites in the layout; an array for part of a sensor that is not a range of sites.
    n_threads : int or None
        Number of threads for effects on all sites; None for all cores.
    """

    layout: Photosites
    known_device: Device | None
    given_f: Floats | None
    index: slice | Ints = field(default_factory=lambda: slice(None))
    n_threads: int | None = None
    exposure_s: float | None = None
    #: All sites of the sensor that a part belongs to, and the indices of its sites among them, a slice of step 1 or (n,).
    _complete: tuple[Sites, slice | Ints] | None = field(default=None, repr=False)
    _cache: BoundedCache = field(default_factory=lambda: BoundedCache(MAX_CACHED), repr=False)

    __repr__ = short_repr

    @property
    def n_sites(self) -> int:
        """Number of these sites."""
        if isinstance(self.index, slice):
            return len(range(*self.index.indices(self.layout.n_sites)))
        return self.index.size

    @property
    def capacitance_f(self) -> Floats:
        """Capacitance of the sense nodes of all photosites, (n_site,) or (1,) F."""
        if self.given_f is not None:
            return self.given_f
        # At first use: tiles of large sensors do not use those of all sites.
        return self._cache.get("capacitance_f", self._default_f)

    def _default_f(self) -> Floats:
        """Return capacitances by area: one for the equal sites of a lattice, and of its parts."""
        complete = self
        while complete._complete is not None:
            complete = complete._complete[0]
        lattice = getattr(complete.layout, "lattice", None)
        size_um = None if lattice is None else lattice.site_size_um
        area_um2 = self.layout.area_um2 if size_um is None else np.full(1, math.prod(size_um))
        return read_only(CAPACITANCE_F_PER_UM2 * area_um2)

    def block(self, index: slice | Ints, *, n_threads: int | None = 1) -> Sites:
        """Return some of the layout's sites."""
        return replace(self, index=index, n_threads=n_threads)

    def of(self, effect: Any) -> Sites:
        """
        Return these sites in the layout that an effect needs.

        For part of a sensor, such as a tile, this is the complete layout, unless ``effect.needs_layout`` is False.
        """
        if self._complete is None or not effect.needs_layout:
            return self
        sites, selection = self._complete
        index = select_indices(selection, self.index, sites.layout.n_sites)
        found = sites.block(index, n_threads=self.n_threads).during(self.exposure_s).of(effect)
        return found if self.known_device is not None else found.without_device()

    def without_device(self) -> Sites:
        """Return the same sites without a device, for moments over all devices of the kind."""
        return replace(self, known_device=None)

    def during(self, exposure_s: float | None) -> Sites:
        """Return the same sites with an exposure time."""
        return replace(self, exposure_s=exposure_s)

    @property
    def device(self) -> Device:
        """
        Source of the random numbers of fixed patterns, such as :meth:`Device.normals`.

        Raises
        ------
        SimulationError
            If the device is not known.
        """
        if self.known_device is None:
            raise SimulationError(
                "a fixed pattern that differs between devices must define pattern_moments(), its mean and variance over "
                "devices; other effects must define moments() without a device"
            )
        return self.known_device

    def select(self, values: ArrayLike) -> Any:
        """
        Return the elements of an array (n_site, ...) that belong to these sites.

        Single values are returned unchanged.
        """
        array = np.asarray(values)
        return array[self.index] if array.ndim and array.shape[0] > 1 else array

    def cached(self, key: Any, compute: Callable[[Sites], T]) -> T:
        """
        Return the cached result of a function of all sites, computed at the first call.

        Results that have not been used recently are discarded, and computed again.

        Parameters
        ----------
        key : Effect, or tuple of an Effect and hashable values
            Key of the cache, such as ``(self, "gain", channel)``. Effects are compared by identity, other values by type and
            value.
        compute : callable
            Called with all sites of the layout.

        Raises
        ------
        ParameterError
            If the key does not start with an effect, or a value is not hashable.
        """
        parts = key if isinstance(key, tuple) else (key,)
        if not parts or not isinstance(parts[0], Effect):
            raise ParameterError("key", "must be the effect, or a tuple of the effect and hashable values", key)
        # A known device is part of the key: functions of all sites may use its numbers.
        owner = (self.known_device, *parts)
        every = replace(self, index=slice(None), exposure_s=None)
        found: T = self._cache.get(_cache_key(owner), lambda: compute(every), owner=owner)
        return found

    def pattern(self, key: Any, compute: Callable[[Sites], ArrayLike]) -> Floats:
        """
        Return the elements for these sites of a cached array (n_site,) or number.

        The array is computed for all sites at the first call.

        Parameters
        ----------
        key : Effect, or tuple of an Effect and hashable values
            As for :meth:`cached`; methods of an effect with different names have different results.
        compute : callable
            Called with all sites of the layout; returns one number, or one for each of them.

        Raises
        ------
        SimulationError
            If the array has another shape, or a number is not finite.
        """
        parts = key if isinstance(key, tuple) else (key,)

        def compute_array(sites: Sites) -> Floats:
            array = np.atleast_1d(np.asarray(compute(sites), np.float64))
            if array.shape not in ((1,), (sites.n_sites,)):
                problem = f"an array of shape {array.shape}"
            elif (is_finite := np.isfinite(array)).all():
                return read_only(array.copy())
            else:
                problem = f"{array[np.argmin(is_finite)]} at site {np.argmin(is_finite)}"
            raise SimulationError(
                f"the effect '{parts[0].name}' must return one finite number, or one for each of the {sites.n_sites} sites, "
                f"got {problem}"
            )

        return self.select(self.cached((*parts, "pattern", getattr(compute, "__qualname__", "")), compute_array))


def _cache_key(parts: tuple[Any, ...]) -> Hashable:
    """Return a key of effects and devices by identity, and of other values by type and value."""

    def typed(part: Any) -> Any:
        if isinstance(part, Effect | Device):
            return type(part), id(part)
        return type(part), tuple(map(typed, part)) if isinstance(part, tuple) else part

    key = tuple(map(typed, parts))
    try:
        hash(key)
    except TypeError:
        raise ParameterError("key", "must contain only hashable values after the effect", parts[2:]) from None
    return key


class Effect(ABC):
    """
    Base class of noise sources, fixed patterns and crosstalk.

    Subclasses are frozen dataclasses.

    Attributes
    ----------
    name : str
        Key of the noise budget and of the random stream; unique within a sensor.
    stage : Stage
        Stage of the chain, which determines the unit of the values: :data:`STAGES`.
    is_temporal : bool
        Whether the effect is drawn again for each frame; otherwise it is fixed for a device, or deterministic. Effects before
        collection must be fixed, and affine in the values: light twice as strong adds twice the charge.
    reach : {"site", "group", "all"}
        ``"site"``: each site's result and draw are independent of other sites. ``"group"``: draws are common to groups of
        sites, such as rows; means are per site. ``"all"``: values of sites are mixed, as by crosstalk, and :meth:`apply` is
        called with all sites at once; such effects derive from :class:`Mixing`.
    is_drawn_at_reset : bool
        Whether all reads between two resets share one draw.
    is_defect : bool
        Whether the effect changes few sites only, as dead, hot and RTS sites. Means over devices exclude it.
    needs_layout : bool
        Whether the effect on a site depends on its position or index in the layout, on other sites, or on an array per site. If
        not, the effect on part of a sensor, such as a tile, is computed for its sites alone, which takes less memory.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    is_temporal: ClassVar[bool]
    reach: ClassVar[Reach] = "site"
    is_drawn_at_reset: ClassVar[bool] = False
    is_defect: ClassVar[bool] = False
    needs_layout: ClassVar[bool] = True

    @abstractmethod
    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """
        Return the values after the effect.

        Parameters
        ----------
        values : (n,) float64, unit of the stage
            May be overwritten and returned.
        sites : Sites
            The ``n`` sites of the values.
        rng : numpy.random.Generator
            Random stream of this effect, frame and block of sites. It is None for fixed effects, which use ``sites.device``.
            For effects of reach "group", every block and every part of a sensor has the same stream, at its start: the draw
            of a group must depend on its label only, as ``rng.standard_normal(n_groups)[label]`` with the number of all
            groups.
        """

    @abstractmethod
    def moments(self, mean: Floats, variance: Floats, *, sites: Sites) -> tuple[Floats, Floats]:
        """
        Compute mean and variance after the effect analytically.

        Parameters
        ----------
        mean, variance : (n,) or (1,) float64, unit of the stage and its square
        sites : Sites
            With a device, its fixed patterns are known constants; without one, moments are over all devices.
        """

    def linearise(self, mean: Floats, *, sites: Sites) -> StepModel:
        """
        Compute mean, slope and added standard deviation at the mean of each site.

        The default follows from :meth:`moments`, with a central difference that is small relative to the mean, so that it does
        not depend on the unit of the stage. A class that redefines :meth:`moments` alone has the default.

        Parameters
        ----------
        mean : (..., n) or (1,) float64, unit of the stage
            Mean before the effect.
        sites : Sites
            As for :meth:`moments`.
        """
        after, added = self.validate_moments(mean, NOTHING, sites)
        step = SLOPE_STEP * np.maximum(np.abs(mean), SMALLEST_MEAN[STAGES[self.stage]])
        ahead, behind = mean + step, mean - step
        if self.stage == "collection":
            behind = np.maximum(behind, 0.0)  # expected charges are not negative
        means = (self.validate_moments(at, NOTHING, sites)[0] for at in (ahead, behind))
        slope = np.subtract(*means) / (ahead - behind)
        return StepModel(after, slope, np.sqrt(np.maximum(added, 0.0)) if np.any(added) else None)

    def validate_linear(self, mean: Floats, sites: Sites) -> StepModel:
        """Return the result of :meth:`linearise` after checking its shapes."""
        sites = sites.of(self)
        definer = next(each for each in type(self).__mro__ if not {"linearise", "moments"}.isdisjoint(vars(each)))
        linearise = self.linearise if "linearise" in vars(definer) else partial(Effect.linearise, self)
        found: Any = linearise(mean, sites=sites)
        shape = np.broadcast_shapes(np.shape(mean), (sites.n_sites,))
        try:
            model = StepModel(*found)
        except TypeError:
            raise SimulationError(f"the effect '{self.name}' must return a StepModel; check its linearise()") from None
        names = [name for name in StepModel._fields[:3] if isinstance(getattr(model, name), np.ndarray)]
        what = "a mean, a slope and a deviation"
        parts = self._validate_shapes([getattr(model, name) for name in names], len(names), shape, what, "linearise")
        groups = None if model.groups is None else _labels(self, model.groups, sites.n_sites)
        return model._replace(**dict(zip(names, parts, strict=True)), groups=groups)

    def validate_moments(self, mean: Floats, variance: Floats, sites: Sites) -> tuple[Floats, Floats]:
        """Return the result of :meth:`moments` after checking its shapes."""
        sites = sites.of(self)
        shape = np.broadcast_shapes(np.shape(mean), np.shape(variance), (sites.n_sites,))
        found = self.moments(mean, variance, sites=sites)
        after, spread2 = self._validate_shapes(found, 2, shape, "a mean and a variance", "moments")
        return after, spread2

    def _validate_shapes(self, found: Any, n: int, shape: tuple[int, ...], what: str, method: str) -> list[Floats]:
        """Return the arrays that a method returned, if they can be broadcast to a shape."""
        try:
            arrays = [
                part if part.dtype.kind in "iu" else np.asarray(part, np.float64) for part in map(np.asarray, found)
            ]
            if len(arrays) != n or np.broadcast_shapes(*(part.shape for part in arrays), shape) != shape:
                raise ValueError
        except (TypeError, ValueError):
            raise SimulationError(
                f"the effect '{self.name}' must return {what} of shape {shape}; check its {method}()"
            ) from None
        return arrays

    def half_step(self, sites: Sites) -> Floats | None:
        """
        Return half the difference between two equally probable states, (n,) or (1,).

        None for effects with other distributions.
        """
        return None


class _FixedPattern(Effect):
    is_temporal: ClassVar[bool] = False

    @abstractmethod
    def pattern(self, sites: Sites) -> ArrayLike:
        """Return the pattern of ``sites.device``, (n,) or one number common to all sites."""

    def pattern_moments(self, sites: Sites) -> tuple[ArrayLike, ArrayLike]:
        """
        Return mean and variance of the pattern over devices, (n,) or one number each.

        The default is for a pattern common to all devices: the pattern itself, and 0.
        """
        return self.pattern(sites), 0.0

    def _model(self, sites: Sites) -> tuple[Floats, Floats | None]:
        """Return the device's pattern and None, or mean and standard deviation over devices."""
        if sites.known_device is not None:
            return sites.pattern(self, self.pattern), None
        centre, spread2 = (sites.select(part) for part in self.pattern_moments(replace(sites, index=slice(None))))
        return np.atleast_1d(centre), np.sqrt(np.atleast_1d(spread2))


class FixedFactor(_FixedPattern):
    """Multiplicative fixed pattern; subclasses define :meth:`pattern`."""

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the values times the pattern."""
        values *= sites.pattern(self, self.pattern)
        return values

    def moments(self, mean: Floats, variance: Floats, *, sites: Sites) -> tuple[Floats, Floats]:
        """Compute the moments of a product of independent factors."""
        factor, deviation = self._model(sites)
        if deviation is None:
            return mean * factor, variance * factor**2
        return mean * factor, variance * (factor**2 + deviation**2) + (mean * deviation) ** 2

    def linearise(self, mean: Floats, *, sites: Sites) -> StepModel:
        """Return the mean, the factor, and the mean times its standard deviation."""
        factor, deviation = self._model(sites)
        return StepModel(mean * factor, factor, None if deviation is None else np.abs(mean) * deviation)


class FixedOffset(_FixedPattern):
    """Additive fixed pattern; subclasses define :meth:`pattern`, in the unit of the stage."""

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the values plus the pattern."""
        values += sites.pattern(self, self.pattern)
        return values

    def moments(self, mean: Floats, variance: Floats, *, sites: Sites) -> tuple[Floats, Floats]:
        """Compute the moments of a sum of independent terms."""
        offset, deviation = self._model(sites)
        return mean + offset, variance if deviation is None else variance + deviation**2

    def linearise(self, mean: Floats, *, sites: Sites) -> StepModel:
        """Return the mean, and the standard deviation of the offset."""
        offset, deviation = self._model(sites)
        return StepModel(mean + offset, None, deviation)


class AdditiveNoise(Effect):
    """Additive Gaussian temporal noise of mean 0; subclasses define :meth:`deviation`."""

    is_temporal: ClassVar[bool] = True

    @abstractmethod
    def deviation(self, sites: Sites) -> ArrayLike:
        """Return the standard deviation, (n,) or one number, in the unit of the stage."""

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the values plus a Gaussian draw."""
        from foveasim._core import _kernels

        check_drawn(values, rng)
        _kernels.add_normals(values, sites.pattern(self, self.deviation), random_key(rng))
        return values

    def moments(self, mean: Floats, variance: Floats, *, sites: Sites) -> tuple[Floats, Floats]:
        """Return the mean and the sum of the variances."""
        return mean, variance + sites.pattern(self, self.deviation) ** 2

    def linearise(self, mean: Floats, *, sites: Sites) -> StepModel:
        """Return the mean and the standard deviation."""
        return StepModel(mean, None, sites.pattern(self, self.deviation))


class GroupedNoise(AdditiveNoise):
    """
    Additive Gaussian temporal noise of mean 0, common to groups of sites such as rows.

    Subclasses define :meth:`deviation`, and :meth:`groups` for groups other than readout lines. The draw of a group depends on
    the name of the effect, the seed, the frame and the label of the group only, so that it is the same in all tiles.
    """

    reach: ClassVar[Reach] = "group"

    def groups(self, sites: Sites) -> ArrayLike:
        """Return the label of each site's group, (n,) int, by default its readout line."""
        if "readout_line" not in sites.layout.columns:
            raise SimulationError(
                f"the effect '{self.name}' requires a readout line for each site, but the layout has no column "
                "'readout_line'; add it, for example with foveasim.layout.readout_by, or define groups()"
            )
        return sites.select(sites.layout.readout_line)

    def _groups(self, sites: Sites) -> Ints:
        """Return the labels of the sites, computed once for all sites of the layout."""
        of_all = sites.without_device().cached(
            (self, "groups"), lambda every: read_only(_labels(self, self.groups(every), every.n_sites).copy())
        )
        return np.asarray(of_all[sites.index])

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the values plus the Gaussian draw of each group."""
        from scipy.special import ndtri

        from foveasim.sensor import _kernels

        labels, key = self._groups(sites), rng.bit_generator.random_raw(2).astype(np.uint64)
        drawn, index = labels, None
        if labels.size and (last := int(labels.max())) - (first := int(labels.min())) < labels.size:
            drawn, index = np.arange(first, last + 1), labels - first
        words = np.ascontiguousarray(drawn, np.int64).view(np.uint64)
        normals = ndtri(_kernels.device_uniforms(key[0], key[1], words, np.uint64(0)))
        values += sites.pattern(self, self.deviation) * (normals if index is None else normals[index])
        return values

    def linearise(self, mean: Floats, *, sites: Sites) -> StepModel:
        """Return the mean, the standard deviation and the groups."""
        return StepModel(mean, None, sites.pattern(self, self.deviation), self._groups(sites))


def check_drawn(values: object, rng: object, *, is_drawn: bool = True) -> None:
    """Check that a draw has an array to change, and a random stream."""
    if not isinstance(values, np.ndarray) or values.ndim != 1 or values.dtype != np.float64:
        raise ParameterError("values", "must be a float64 array of shape (n,), which the draw overwrites", values)
    if is_drawn and not isinstance(rng, np.random.Generator):
        raise ParameterError("rng", "must be a numpy.random.Generator", rng)


def _labels(effect: Effect, labels: ArrayLike, n_sites: int) -> Ints:
    """Return labels of groups, (n,) int64, after validation."""
    array = np.asarray(labels)
    if (
        array.shape != (n_sites,)
        or array.dtype.kind not in "biu"
        or (array.dtype == np.uint64 and int(array.max(initial=0)) > np.iinfo(np.int64).max)
    ):
        raise SimulationError(
            f"the effect '{effect.name}' must have one label per site, int64 of shape ({n_sites},), got {array.dtype} of shape "
            f"{array.shape}; check its groups()"
        )
    return array.astype(np.int64, copy=False)


#: Additional effects by their names in settings files. Classes are registered with ``@EFFECTS.register("name")``, or by entry
#: points of the group ``foveasim.effects`` in installed packages.
EFFECTS: Registry[type[Effect]] = Registry("effect", "foveasim.effects")
