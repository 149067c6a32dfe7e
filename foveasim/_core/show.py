"""Methods that are functions of higher floors, such as those that draw, loaded on use."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib import import_module
from types import MethodType
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypeVar, overload

from foveasim._core.calls.docstrings import Docstring

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pyvista import PolyData  # noqa: TID251 -- a type alone

R = TypeVar("R")


def load(module: str) -> Any:
    """Return a module of a higher floor by its name, when a method of a lower one needs it."""
    return import_module(f"foveasim.{module}")


class _OfFunction:
    """Attribute of a method that is derived from its function."""

    def __init__(self, of_function: Callable[[Callable[..., Any]], Any], of_class: Any = None) -> None:
        self.of_function: Callable[[Callable[..., Any]], Any] = of_function
        self.of_class: Any = of_class

    def __get__(self, method: ViewMethod[Any] | None, owner: type | None = None) -> Any:
        return self.of_class if method is None else self.of_function(method.function)


def _signature(function: Callable[..., Any]) -> inspect.Signature:
    """Return the signature of a method: the first parameter is the object."""
    signature = inspect.signature(function)
    first, *others = signature.parameters.values()
    return signature.replace(
        parameters=[inspect.Parameter("self", first.POSITIONAL_OR_KEYWORD), *others],
    )


class ViewMethod(Generic[R]):
    __doc__ = _OfFunction(
        lambda function: Docstring.of(function).without_first_parameter(),
        "Method that is a function of :mod:`foveasim.view`; created by :func:`view_method`.",
    )
    __signature__: Any = _OfFunction(
        _signature, inspect.Signature([inspect.Parameter("name", inspect.Parameter.POSITIONAL_OR_KEYWORD)])
    )

    def __init__(self, name: str) -> None:
        self._name = name
        self.__name__: str = name
        self.__qualname__ = name
        self.__module__ = __name__

    def __set_name__(self, owner: type, name: str) -> None:
        self.__name__, self.__qualname__, self.__module__ = name, f"{owner.__qualname__}.{name}", owner.__module__

    @property
    def function(self) -> Callable[..., R]:
        """The function that draws."""
        found: Callable[..., R] = getattr(load("view"), self._name)
        return found

    @overload
    def __get__(self, item: None, owner: type) -> Self: ...
    @overload
    def __get__(self, item: object, owner: type) -> Callable[..., R]: ...
    def __get__(self, item: object, owner: type) -> Self | Callable[..., R]:
        return self if item is None else MethodType(self, item)

    def __call__(self, item: object, *args: Any, **kwargs: Any) -> R:
        return self.function(item, *args, **kwargs)

    def __repr__(self) -> str:
        return f"<method {self.__qualname__}: foveasim.view.{self._name}>"


@overload
def view_method(name: Literal["to_html"]) -> ViewMethod[str]: ...
@overload
def view_method(name: Literal["to_png"]) -> ViewMethod[bytes | None]: ...
@overload
def view_method(name: Literal["polydata"]) -> ViewMethod[PolyData]: ...
@overload
def view_method(name: Literal["show_columns"]) -> ViewMethod[None]: ...
@overload
def view_method(
    name: Literal[
        "plot_capture",
        "plot_cortical",
        "plot_layout",
        "plot_noise_budget",
        "plot_picture",
        "plot_power_map",
        "plot_report",
        "plot_scene",
    ],
) -> ViewMethod[Axes]: ...
def view_method(name: str) -> ViewMethod[Any]:
    """
    Return a method that calls a function of :mod:`foveasim.view` with its object.

    Lower modules thereby draw their objects without importing the package, which is loaded on use. Signature and docstring are
    those of the function, without its first parameter.

    ``name``: name of the function.

    Examples
    --------
    >>> class Spot:
    ...     plot = view_method("plot_layout")
    >>> import inspect
    >>> list(inspect.signature(Spot().plot).parameters)[:2]
    ['by', 'label']
    """
    return ViewMethod(name)
