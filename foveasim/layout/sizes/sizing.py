"""Layouts from sizes: field, number of photosites and smallest photosite."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any

from foveasim._core.calls import LENGTH
from foveasim._core.quantities import format_quantity
from foveasim._core.validation import MAX_SITES, check_choice, check_length_um
from foveasim.errors import FoveasimError, ParameterError, SimulationError
from foveasim.layout.generator_registry import LAYOUTS, SITES
from foveasim.layout.model import Layout
from foveasim.layout.sizes.site_counts import CountError

__all__ = ["from_sizes"]

#: Number of photosites where none is given, and shape of a field without a format.
N_SITES, SHAPE = 12_000, (math.sqrt(4 / 3), math.sqrt(3 / 4))
#: Relative difference of the smallest site from the required one, and number of layouts that are tried.
TOLERANCE, MAX_TRIES = 0.05, 8
#: Largest relative difference of the number of sites where generators have no nearer possible number.
MAX_FRACTION = 0.08
#: Unknown of rasters whose numbers of columns and rows follow from the pitch, and margins of their field relative to the pitch
#: that are tried, so that the number of sites remains.
COLUMNS, MARGINS = "columns", (0.0, 0.1, 0.25, 0.5)
#: Significant digits of sides and factors, and of lengths times a factor.
DIGITS, LENGTH_DIGITS = 7, 12
#: Suffix of the names of lengths, and the radius that an outline does not exceed.
SUFFIX, LIMIT = "_um", "r_max_um"

Parameters = Mapping[str, Any]
Generate = Callable[[Parameters], Layout]


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """
    Parameters of a generator that determine the sizes of its layouts.

    ``initial``: values of a sensor of usual size. ``replaced``: parameters that the sides of the field ``size_um`` and the
    number of photosites replace, for generators that fill a rectangle; else None. ``columns``: numbers of columns and rows.
    ``counts``, ``lengths``, ``ratios``: parameters that follow the size of a photosite relative to the field: numbers of
    photosites along a line, lengths, and ratios of neighbouring photosites, whose product over a line remains. ``smallest``:
    parameter that is the smallest site. ``excludes``: parameters for which a generator solves only without another one.
    """

    initial: Parameters = field(default_factory=dict)
    replaced: tuple[str, ...] | None = None
    columns: tuple[str, str] | None = None
    counts: tuple[str, ...] = ()
    lengths: tuple[str, ...] = ()
    ratios: tuple[str, ...] = ()
    smallest: str | None = None
    excludes: Mapping[str, str] = field(default_factory=dict)


#: Sizes by generator; others have the required parameters of their examples.
SIZES: Mapping[str, Sizes] = MappingProxyType(
    {
        "foveal_cartesian": Sizes(
            initial={"n_rings": 38, "ring_ratio": 1.1, "pitch_um": 5.0, "n_fovea": 10},
            counts=("n_fovea",),
            ratios=("ring_ratio",),
        ),
        "fovi": Sizes(initial={"fov_um": 1300.0, "a_um": 50.0, "n_rings": 55}),
        "giotto": Sizes(
            initial={"n_rho": 76, "n_theta": 128, "n_fovea": 20, "n_across": 600, "unit_um": 2.5},
            counts=("n_rho", "n_fovea", "n_across"),
            lengths=("unit_um",),
        ),
        "grid": Sizes(
            initial={"n_x": 120, "n_y": 120, "pitch_um": 8.0},
            replaced=("n_x", "n_y", "pitch_um", "pitch_y_um"),
            columns=("n_x", "n_y"),
        ),
        "hexagonal": Sizes(
            initial={"n_columns": 120, "n_rows": 138, "pitch_um": 8.0},
            replaced=("n_columns", "n_rows", "pitch_um"),
            columns=("n_columns", "n_rows"),
        ),
        "log_polar": Sizes(
            initial={"n_sectors": 128, "min_size_um": 3.0, "r_max_um": 600.0},
            lengths=("min_size_um",),
            smallest="min_size_um",
        ),
        "octagonal": Sizes(
            initial={"n_x": 100, "n_y": 100, "pitch_um": 10.0},
            replaced=("n_x", "n_y", "pitch_um"),
            columns=("n_x", "n_y"),
        ),
        "penrose": Sizes(initial={"size_um": 800.0, "side_um": 12.0}),
        "quadtree": Sizes(initial={"pitch_um": 4.0, "n_levels": 5}),
        "sunflower": Sizes(initial={"n_sites": 6000, "spacing_um": 8.0}),
        "tiling": Sizes(initial={"pitch_um": 8.0, "radius_um": 450.0}, replaced=("pitch_um", "radius_um")),
        "voronoi": Sizes(initial={"n_sites": 3000, "size_um": [600.0, 600.0]}, replaced=()),
        "zones": Sizes(
            initial={"side_um": [256.0, 512.0, 1024.0], "pitch_um": [4.0, 8.0, 16.0]},
            excludes={"n_fovea": "pitch_um"},
        ),
    }
)


def from_sizes(
    generator: str,
    *,
    size_um: tuple[float, float] | None = None,
    n_sites: Annotated[int, SITES] | None = None,
    min_size_um: Annotated[float, LENGTH] | None = None,
    **parameters: Any,
) -> Layout:
    """
    Generate a layout from the sizes that a sensor must have.

    The parameters of the generator follow from them.

    Parameters
    ----------
    generator : str
        Name of a generator that has a number of photosites: ``"log_polar"``, ``"hexagonal"``.
    size_um : (width, height), optional, µm
        Field, such as that of an optical format, :data:`foveasim.layout.OPTICAL_FORMATS`. Rectangular layouts fill it, others
        are inscribed. By default, it follows from the other two, with the sides 4:3.
    n_sites : int, optional
        Number of photosites, within 8 %. By default, it follows from the other two, or is 12,000.
    min_size_um : float, optional, µm
        Size of the smallest photosite, the square root of its area, within 5 %. By default, it follows from the other two.
    **parameters
        Further parameters of the generator, such as ``fovea="rings"``: neither lengths nor numbers that follow from the sizes.

    Returns
    -------
    Layout
        Its provenance contains the parameters of the generator.

    Raises
    ------
    ParameterError
        When a value is out of range, or a parameter follows from the sizes.
    SimulationError
        When the sizes are not enough, or contradict each other; the message contains what is possible.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.from_sizes(
    ...     "log_polar", size_um=(4800, 3600), n_sites=8000, fovea="rings"
    ... )
    >>> layout.n_sites, layout.provenance["parameters"]["r_max_um"]
    (8059, 1800.0)
    >>> round(float(layout.size_um.min()), 1)
    8.4
    """
    check_choice("generator", generator, sizable())
    for side_um in size_um or ():
        check_length_um("size_um", side_um)
    follows = {*initial_parameters(generator), *_unknowns(generator), *(SIZES.get(generator, Sizes()).replaced or ())}
    for name, value in parameters.items():
        if name in follows or name.endswith(SUFFIX):
            raise ParameterError(name, f"of {generator} must be left out: it follows from the sizes", value)
    given = initial_parameters(generator) | parameters
    found, _ = sized(generator, given, size_um=size_um, n_sites=n_sites, min_size_um=min_size_um)
    return LAYOUTS[generator](**found)  # with its warnings


def sizable() -> list[str]:
    """Return the generators whose parameters follow from a number of photosites."""
    return [
        name
        for name in sorted(LAYOUTS)
        if (given := initial_parameters(name)) and ("n_sites" in given or _unknowns(name))
    ]


def initial_parameters(generator: str) -> dict[str, Any]:
    """Return values of the parameters that determine the sizes."""
    if generator in SIZES:
        return dict(SIZES[generator].initial)
    required = {
        each.name
        for each in inspect.signature(LAYOUTS[generator]).parameters.values()
        if each.default in (each.empty, None)
    }
    return {name: value for name, value in LAYOUTS.example(generator).items() if name in required}


def is_rectangular(generator: str) -> bool:
    """Return whether a generator fills a rectangle."""
    return generator in SIZES and SIZES[generator].replaced is not None


def sized(
    generator: str,
    parameters: Parameters,
    *,
    size_um: Sequence[float] | None,
    n_sites: int | None,
    min_size_um: float | None,
    max_sites: int = MAX_SITES,
    generate: Generate | None = None,
) -> tuple[dict[str, Any], Layout]:
    """
    Return parameters of a generator and its layout for :func:`from_sizes`.

    ``parameters``: those of another size. ``generate``: returns a layout, for generators that require a picture.
    """
    solver = _Sizing(generator, parameters, max_sites, generate or (lambda each: generated(generator, each)))
    if min_size_um is None:
        if size_um is None:
            raise SimulationError("the size of the sensor is not determined; give a format, or the smallest site")
        return solver.filled(size_um, n_sites or N_SITES)
    if size_um is None:
        n_sites = n_sites or N_SITES
        size_um = [min_size_um * math.sqrt(n_sites) * side for side in SHAPE]
        factor = min_size_um / float(solver.filled(size_um, n_sites)[1].size_um.min())
        return solver.filled([factor * each_um for each_um in size_um], n_sites)
    if n_sites is None:
        return solver.with_smallest(size_um, min_size_um)
    return solver.checked(size_um, n_sites, min_size_um)


class _Sizing:
    """Layouts of a generator by field, number of photosites and smallest photosite."""

    def __init__(self, generator: str, parameters: Parameters, max_sites: int, generate: Generate) -> None:
        self.generator, self.parameters, self.max_sites, self.generate = generator, parameters, max_sites, generate
        self.sizes = SIZES.get(generator, Sizes())

    def filled(
        self, size_um: Sequence[float], n_sites: int, max_fraction: float = MAX_FRACTION
    ) -> tuple[dict[str, Any], Layout]:
        """Return parameters and layout for a field and a number of photosites."""
        if self.sizes.replaced is not None:
            found = with_field(self.generator, self.parameters, size_um, size_um)
            found = with_number(self.generator, [found], n_sites, max_fraction)
        else:
            found = self.solved(self.refined(n_sites), n_sites, max_fraction)
            factor = 0.5 * min(size_um) / max(map(abs, self.generate(found).bounds_um))
            found = with_scale(found, factor, 0.5 * min(size_um))
        return found, self.generate(found)

    def with_smallest(self, size_um: Sequence[float], min_size_um: float) -> tuple[dict[str, Any], Layout]:
        """Return parameters and layout for a field and the smallest photosite."""
        n_most = self.n_most(size_um, min_size_um)
        if is_rectangular(self.generator) and n_most > self.max_sites:
            raise self.contradiction(size_um, n_most, min_size_um, self.at_most(size_um, n_most))
        if self.sizes.smallest is not None:
            found = {**self.parameters, self.sizes.smallest: min_size_um, LIMIT: 0.5 * min(size_um)}
            ratio, layout = 1.0, self.generate(found)
        else:
            n_tried = n_most if is_rectangular(self.generator) else min(n_most, N_SITES)
            for _ in range(MAX_TRIES):
                found, layout = self.filled(size_um, max(1, n_tried), math.inf)
                ratio = float(layout.size_um.min()) / min_size_um
                if abs(ratio - 1.0) <= TOLERANCE:
                    break
                n_tried = round(n_tried * ratio**2)
        if abs(ratio - 1.0) > TOLERANCE:
            raise self.contradiction(size_um, None, min_size_um, (layout.n_sites, ratio * min_size_um))
        if layout.n_sites > self.max_sites:
            raise self.contradiction(size_um, layout.n_sites, min_size_um, self.at_most(size_um, layout.n_sites))
        return found, layout

    def checked(self, size_um: Sequence[float], n_sites: int, min_size_um: float) -> tuple[dict[str, Any], Layout]:
        """Return parameters and layout for all three, which may contradict each other."""
        n_most = self.n_most(size_um, min_size_um)
        if n_sites > min((1.0 + 2.0 * TOLERANCE) * n_most, self.max_sites):
            possible = [(n_most, min_size_um)] if n_most < n_sites else []
            raise self.contradiction(size_um, n_sites, min_size_um, *possible, self.at_most(size_um, n_sites))
        if self.sizes.smallest is not None:
            given = {**self.parameters, self.sizes.smallest: min_size_um, LIMIT: 0.5 * min(size_um)}
            try:
                found = self.solved(given, n_sites)
            except CountError as error:
                raise self.contradiction(size_um, n_sites, min_size_um, (error.nearest, min_size_um)) from error
            return found, self.generate(found)
        found, layout = self.filled(size_um, n_sites)
        size_found_um = float(layout.size_um.min())
        if abs(size_found_um / min_size_um - 1.0) <= TOLERANCE:
            return found, layout
        n_possible = self.with_smallest(size_um, min_size_um)[1].n_sites
        raise self.contradiction(
            size_um, n_sites, min_size_um, (n_possible, min_size_um), (layout.n_sites, size_found_um)
        )

    def refined(self, n_sites: int) -> dict[str, Any]:
        """Return values for a number of photosites, before a parameter is solved for."""
        found, sizes = dict(self.parameters), self.sizes
        if _has_picture(self.generator):
            return found
        factor = math.sqrt(n_sites / self.generate(found).n_sites)
        for name in sizes.counts:
            found[name] = max(1, round(found[name] * factor))
        for name in sizes.lengths:
            found[name] = found[name] / factor
        for name in sizes.ratios:
            found[name] = found[name] ** (1.0 / factor)
        return found

    def solved(self, parameters: Parameters, n_sites: int, max_fraction: float = MAX_FRACTION) -> dict[str, Any]:
        """Return parameters that solve for the first unknown of a generator."""
        unknown = next(iter(_unknowns(self.generator)), None)
        given = _but(parameters, unknown, self.sizes.excludes.get(unknown or ""))
        found = with_number(self.generator, [given], n_sites, max_fraction)
        if unknown is None or self.sizes.smallest is None:
            return found
        # An integer, which later layouts need not search again.
        return given | {unknown: self.generate(found).provenance["parameters"][unknown]}

    def n_most(self, size_um: Sequence[float], min_size_um: float) -> int:
        """Return the number of smallest photosites on the field."""
        area_um2 = math.prod(size_um) if is_rectangular(self.generator) else 0.25 * math.pi * min(size_um) ** 2
        return round(area_um2 / min_size_um**2)

    def at_most(self, size_um: Sequence[float], n_sites: int) -> tuple[int, float]:
        """Return a possible number of photosites of one size, and this size."""
        n_possible = min(n_sites, self.max_sites)
        return n_possible, 1.0 / math.sqrt(n_possible / self.n_most(size_um, 1.0))

    def contradiction(
        self, size_um: Sequence[float], n_sites: int | None, min_size_um: float, *possible: tuple[int, float]
    ) -> SimulationError:
        """Return the error of sizes that no layout has, with numbers and sizes that are possible."""
        names = ", or ".join(f"{n:,} of {_um(each_um)}" for n, each_um in possible)
        width_mm, height_mm = (1e-3 * each_um for each_um in size_um)
        wanted = f"{'' if n_sites is None else f'{n_sites:,} '}photosites of {_um(min_size_um)}"
        field = f"{self.generator.replace('_', ' ')} in {width_mm:.4g} × {height_mm:.4g} mm"
        return SimulationError(f"{field} cannot have {wanted}: possible are {names}")


def with_field(
    generator: str, parameters: Parameters, size_um: Sequence[float], present_um: Sequence[float]
) -> dict[str, Any]:
    """
    Return parameters of a generator for a field of a width and a height.

    Layouts that fill a rectangle lack a pitch, which follows from a number of photosites; others are inscribed in the field.

    ``size_um``, ``present_um``: width and height of the field, and of the layout of the parameters.
    """
    replaced = SIZES.get(generator, Sizes()).replaced
    if replaced is not None:
        return _but(parameters, *replaced) | {"size_um": [rounded_down(side_um, DIGITS) for side_um in size_um]}
    factor = min(side_um / own_um for side_um, own_um in zip(size_um, present_um, strict=True))
    return with_scale(parameters, factor, 0.5 * min(size_um))


def with_scale(parameters: Parameters, factor: float, limit_um: float) -> dict[str, Any]:
    """Return parameters with lengths times a factor, and radii of at most ``limit_um``."""
    factor = rounded_down(factor, DIGITS)  # lengths that are multiples of others remain so
    found = {name: _scaled(value, factor) if name.endswith(SUFFIX) else value for name, value in parameters.items()}
    return found | {LIMIT: min(found[LIMIT], rounded_down(limit_um, DIGITS))} if LIMIT in found else found


def with_number(
    generator: str, candidates: Sequence[Parameters], n_sites: int, max_fraction: float = MAX_FRACTION
) -> dict[str, Any]:
    """
    Return parameters with a number of photosites, or the nearest possible one.

    ``candidates``: parameters without a number, the best ones first. ``max_fraction``: largest relative difference.
    """
    found: dict[int, dict[str, Any]] = {}
    if _unknowns(generator) and not _has_picture(generator):
        for parameters in candidates:
            n_possible = n_sites
            with suppress(FoveasimError, TypeError):
                try:
                    n_built = generated(generator, {**parameters, "n_sites": n_sites}).n_sites
                except CountError as error:
                    n_possible = error.nearest
                    n_built = generated(generator, {**parameters, "n_sites": n_possible}).n_sites
                if abs(n_built - n_sites) <= max_fraction * n_sites:
                    found.setdefault(abs(n_built - n_sites), {**parameters, "n_sites": n_possible})
                if n_built == n_sites or (found and SIZES.get(generator, Sizes()).columns is None):
                    break
    # Without any, the generator reports the reason.
    return found[min(found)] if found else {**candidates[0], "n_sites": n_sites}


def renumbered(
    generator: str,
    parameters: Parameters,
    n_sites: int,
    layout: Layout,
    unknown: str | None = None,
    *,
    is_resized: bool = True,
) -> dict[str, Any]:
    """
    Return parameters of a generator that solves for another number of photosites.

    By default, rasters have the field of the present layout, and other pitches; of other generators, one parameter is solved
    for.

    ``layout``: that of the parameters. ``unknown``: parameter that is solved for, or :data:`COLUMNS`. ``is_resized``: whether
    the other parameters of a raster are derived from the layout. Raises ParameterError when there is nothing to solve for.
    """
    parameters, solvable = _but(parameters, "n_sites"), _unknowns(generator)
    if SIZES.get(generator, Sizes()).columns is not None:
        kept = [parameters]
        candidates = list(_raster_candidates(generator, parameters, layout, n_sites, unknown)) if is_resized else kept
    elif solvable:
        given = [each for each in solvable if parameters.get(each) is not None and unknown in (None, each)]
        if not given and unknown is None:
            raise ParameterError("layout", f"of {generator} must contain {' or '.join(solvable)}")
        candidates = [_but(parameters, other) for other in given or [str(unknown)]]
    else:
        candidates = [parameters]
    return with_number(generator, candidates, n_sites)


def _raster_candidates(
    generator: str, parameters: Parameters, layout: Layout, n_sites: int, unknown: str | None
) -> Iterator[dict[str, Any]]:
    """Yield parameters of a raster without its number of sites, the best ones first."""
    columns, rows = SIZES[generator].columns or ("", "")
    built = layout.provenance.get("parameters") or {}
    n_columns, n_rows = built.get(columns) or 1, built.get(rows)
    x0_um, y0_um, x1_um, y1_um = layout.bounds_um
    width_um, height_um = x1_um - x0_um, y1_um - y0_um
    pitch_um = built.get("pitch_um") or width_um / n_columns
    if generator != "octagonal":  # whose rows alternate with diamonds
        if built.get("pitch_um") is None and n_columns > 1:
            pitch_um = float(math.hypot(*(layout.centroid_um[1] - layout.centroid_um[0])))
        n_rows = n_rows or max(1, round(layout.n_sites / n_columns))
    if unknown == COLUMNS:
        kept = _but(parameters, columns, rows, "size_um") | {"pitch_um": round(pitch_um, 6)}
        if n_rows is not None:
            yield kept | {rows: max(1, round(n_rows * math.sqrt(n_sites / layout.n_sites)))}
        yield kept
        return
    kept = _but(parameters, columns, rows, "pitch_um", "pitch_y_um")
    if parameters.get("size_um") is not None:
        yield kept
        return
    if generator == "grid":  # outlines are smaller than the cells
        width_um, height_um = n_columns * pitch_um, (n_rows or n_columns) * (built.get("pitch_y_um") or pitch_um)
        yield kept | {"size_um": [round(width_um, 6), round(height_um, 6)]}
    for margin in MARGINS:
        yield kept | {"size_um": [round(width_um + margin * pitch_um, 6), round(height_um + margin * pitch_um, 6)]}


def generated(generator: str, parameters: Parameters) -> Layout:
    """Return a layout; its warnings are those of the simulation that follows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return LAYOUTS[generator](**parameters)


def rounded_down(value: float, n_digits: int) -> float:
    """Return a positive number with a number of significant digits, not above it."""
    unit = 10.0 ** (math.floor(math.log10(value)) - n_digits + 1)
    return float(f"{math.floor(value / unit) * unit:.{n_digits}g}")


def _unknowns(generator: str) -> list[str]:
    """Return the parameters for which a generator solves."""
    return [each.name for each in LAYOUTS[generator].solve_for]  # type: ignore[attr-defined]


def _has_picture(generator: str) -> bool:
    """Return whether a generator reads a picture."""
    return LAYOUTS[generator].picture is not None  # type: ignore[attr-defined]


def _but(parameters: Parameters, *names: str | None) -> dict[str, Any]:
    return {key: value for key, value in parameters.items() if key not in names}


def _scaled(value: Any, factor: float) -> Any:
    """Return a length or lengths multiplied by a factor."""
    if isinstance(value, list | tuple):
        return [_scaled(item, factor) for item in value]
    return float(f"{value * factor:.{LENGTH_DIGITS}g}") if isinstance(value, int | float) else value


def _um(length_um: float) -> str:
    return format_quantity(length_um, "µm", digits=3)
