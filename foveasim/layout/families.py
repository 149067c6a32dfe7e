"""Layout families: the registry of generators, and how their layouts record what they were made from."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec

import numpy as np
import shapely

from foveasim._core.provenance import to_plain_data
from foveasim._core.registry import Registry
from foveasim.errors import SimulationError
from foveasim.layout.model import Layout

__all__ = ["LAYOUTS", "layout_family"]

P = ParamSpec("P")

#: Every generator of layouts by its name in settings files and in :mod:`foveasim.layout`. Installed packages add theirs as
#: entry points of the group ``foveasim.layouts``.
LAYOUTS: Registry[Callable[..., Layout]] = Registry("layout family", "foveasim.layouts")


def layout_family(
    *, example: Mapping[str, Any], picture: str | None = None
) -> Callable[[Callable[P, Layout]], Callable[P, Layout]]:
    """
    Decorate a generator: register it, and record its name and parameters in the provenance of its layouts.

    Parameters
    ----------
    example : mapping
        Parameters of a small layout, from which the gallery and the tests of all families make one.
    picture : str, optional
        Parameter that settings files give as the path of a picture.

    Notes
    -----
    The decorated function has the attributes ``example`` and ``picture``. Parameters are recorded as plain data. A generator
    that records one in another way has it in the ``"parameters"`` of its own provenance.

    Examples
    --------
    >>> @layout_family(example={"side_um": 2.0})  # doctest: +SKIP
    ... def single(*, side_um: float) -> Layout:
    ...     return Layout.from_rectangles([[0.0, 0.0]], side_um)
    >>> single(side_um=3.0).provenance["parameters"]  # doctest: +SKIP
    {'side_um': 3.0}
    """

    def decorate(generator: Callable[P, Layout]) -> Callable[P, Layout]:
        signature = inspect.signature(generator)
        name = generator.__name__

        @functools.wraps(generator)
        def family(*args: P.args, **kwargs: P.kwargs) -> Layout:
            layout = generator(*args, **kwargs)
            if not isinstance(layout, Layout):
                raise SimulationError(f"the layout family '{name}' must return a Layout, got a {type(layout).__name__}")
            given = signature.bind(*args, **kwargs)
            given.apply_defaults()
            own = dict(layout.provenance)
            own.pop("made_by", None)
            parameters = {key: _plain(value) for key, value in given.arguments.items()} | own.pop("parameters", {})
            return layout.with_provenance({"generator": name, "parameters": parameters, **own})

        family.example, family.picture = dict(example), picture  # type: ignore[attr-defined]
        return LAYOUTS.register(name, family)

    return decorate


def _plain(value: Any) -> Any:
    """A parameter as a settings file would have it."""
    if isinstance(value, shapely.Geometry):
        return shapely.to_wkt(value, rounding_precision=-1)
    if isinstance(value, np.ndarray):
        return value.tolist()
    return to_plain_data(value)
