"""Registry of layout generators, and provenance of generated layouts."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ParamSpec

import numpy as np
import shapely

from foveasim._core.calls import Limits, check_arguments
from foveasim._core.calls.docstrings import Docstring
from foveasim._core.provenance import to_plain_data
from foveasim._core.registry import Registry
from foveasim._core.validation import MAX_SITES
from foveasim.errors import SimulationError, type_name
from foveasim.layout.model import Layout
from foveasim.layout.sizes.site_counts import SolveFor, layout_with_n_sites, select_unknown

__all__ = ["COUNT", "LAYOUTS", "SITES", "layout_generator"]

P = ParamSpec("P")

#: Numbers of sites, rows, columns and rings.
COUNT = Limits(at_least=1)
SITES = Limits(at_least=1, at_most=MAX_SITES, hint="take fewer or larger photosites")

#: Layout generators by their name in settings files and in :mod:`foveasim.layout`. Installed packages register more as entry
#: points of the group ``foveasim.layouts``.
LAYOUTS: Registry[Callable[..., Layout]] = Registry("layout generator", "foveasim.layouts")


def layout_generator(
    *,
    example: Mapping[str, Any],
    picture: str | None = None,
    solve_for: Sequence[SolveFor] = (),
    has_mosaic: bool | None = None,
) -> Callable[[Callable[P, Layout]], Callable[P, Layout]]:
    """
    Register a generator, and record its parameters in the provenance of layouts.

    Parameters
    ----------
    example : mapping
        Parameters of a small layout, used by the gallery and by the checks of all generators.
    picture : str, optional
        Name of the parameter that is the path of a picture in settings files.
    solve_for : sequence of SolveFor
        Parameters that the number of sites determines, in order of preference: the first one that is None is solved for when
        the parameter ``n_sites`` is given. The generator declares ``n_sites: int | None = None`` and never receives it.
    has_mosaic : bool, optional
        Whether the sites can have a mosaic (:func:`foveasim.layout.mosaic`), since they are in rows and columns, or rings and
        sectors; by default whether those of the example can.

    Notes
    -----
    The decorated function has the attributes ``picture``, ``solve_for`` and ``has_mosaic``. Parameters are recorded as plain
    data. To record one in another form, a generator includes it in the ``"parameters"`` of its own provenance.

    Examples
    --------
    >>> @layout_generator(example={"side_um": 2.0})  # doctest: +SKIP
    ... def single(*, side_um: float) -> Layout:
    ...     return Layout.from_rectangles([[0.0, 0.0]], side_um)
    >>> single(side_um=3.0).provenance["parameters"]  # doctest: +SKIP
    {'side_um': 3.0}
    """

    def decorate(generator: Callable[P, Layout]) -> Callable[P, Layout]:
        signature = inspect.signature(generator)
        name = generator.__name__
        checked = check_arguments(generator)

        def generate(parameters: Mapping[str, Any]) -> Layout:
            given = inspect.BoundArguments(signature, dict(parameters))
            return checked(*given.args, **given.kwargs)

        @functools.wraps(checked)
        def registered(*args: P.args, **kwargs: P.kwargs) -> Layout:
            try:
                given = signature.bind(*args, **kwargs)
            except TypeError:
                return checked(*args, **kwargs)  # raises the error of a call
            given.apply_defaults()
            unknown = select_unknown(name, solve_for, given.arguments) if solve_for else None
            if unknown is None:
                layout = checked(*args, **kwargs)
            else:
                layout, given.arguments[unknown.name] = layout_with_n_sites(name, generate, unknown, given.arguments)
            if not isinstance(layout, Layout):
                raise SimulationError(f"the layout generator '{name}' must return a Layout, got {type_name(layout)}")
            if solve_for:
                given.arguments["n_sites"] = None  # the value that was found reproduces the layout
            own = dict(layout.provenance)
            own.pop("made_by", None)
            parameters = {key: _to_plain(value) for key, value in given.arguments.items()} | own.pop("parameters", {})
            return layout.with_provenance({"generator": name, "parameters": parameters, **own})

        for fact, value in (("picture", picture), ("solve_for", tuple(solve_for)), ("has_mosaic", has_mosaic)):
            setattr(registered, fact, value)
        return LAYOUTS.register(name, registered, example=example)

    return decorate


def summary_of(generator: Callable[..., Layout]) -> str:
    """Return the first sentence of the docstring of a generator, without markup and full stop."""
    summary = Docstring.of(generator).summary.split(". ")[0]
    return " ".join(summary.replace("``", "").split()).rstrip(".")


def _to_plain(value: Any) -> Any:
    """Convert a parameter to the plain data of a settings file."""
    if isinstance(value, shapely.Geometry):
        return shapely.to_wkt(value, rounding_precision=-1)
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_to_plain(item) for item in value] if isinstance(value, list | tuple) else to_plain_data(value)
