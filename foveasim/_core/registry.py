"""Registries of named objects, extensible by users and installed packages."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar, overload

from foveasim._core.names import did_you_mean, possible_names
from foveasim.errors import ParameterError, with_article


def import_all(package: str, path: Iterable[str], *, skip: str = "_kernels") -> None:
    """
    Import the modules of a package, so that their objects are registered.

    Modules whose names begin with ``skip`` are not imported.
    """
    for module in iter_modules(path):
        if not module.name.startswith(skip):
            import_module(f"{package}.{module.name}")


T = TypeVar("T")
F = TypeVar("F")
_log = logging.getLogger("foveasim")


@cache
def _entry_points() -> Any:
    """Return the entry points of all installed packages; ``select`` returns those of a group."""
    from importlib.metadata import entry_points

    return entry_points()


def _identity(item: Any) -> tuple[str, str | int]:
    """Return a key of a function or class that is the same after a reload."""
    return getattr(item, "__module__", ""), getattr(item, "__qualname__", id(item))


class _Example(NamedTuple):
    """Example of a registered object, and its known result."""

    example: Any = MappingProxyType({})
    expected: Any = None


class Registry(Mapping[str, T], Generic[T]):
    """
    Objects of one kind by name: built-in, registered by users, or from entry points.

    The checks of :mod:`foveasim.testing`, the gallery and the tests of all objects of a kind use their examples.

    Parameters
    ----------
    kind : str
        Kind of the objects, for messages: "layout generator".
    group : str
        Group of entry points, such as "foveasim.layouts"; the name of an entry point is the name of its object. Entry points
        are loaded when the registry is first read. An entry point that fails to load is logged as a warning and skipped.
    modules : sequence of str
        Modules that register further objects, imported when the registry is first read.
    """

    def __init__(self, kind: str, group: str, modules: Sequence[str] = ()) -> None:
        self.kind: str = kind
        self.group: str = group
        self._objects: dict[str, T] = {}
        self._examples: dict[str, _Example] = {}
        self._info: dict[str, Any] = {}
        self._modules = tuple(modules)
        self._is_complete = False
        #: Number of registrations so far; data derived from a registry are rebuilt when it changes.
        self.version: int = 0

    @overload
    def register(self, name: str, item: T, *, example: Any = None, expected: Any = None, info: Any = None) -> T: ...

    @overload
    def register(
        self, name: str, *, example: Any = None, expected: Any = None, info: Any = None
    ) -> Callable[[F], F]: ...

    def register(
        self, name: str, item: Any = None, *, example: Any = None, expected: Any = None, info: Any = None
    ) -> Any:
        """
        Register an object, or return a decorator that does.

        Parameters
        ----------
        name : str
        item : object, optional
            Object to register; by default a decorator is returned.
        example : mapping or callable, optional
            Valid parameters of the object, by default none, or a function of an empty directory that writes the files of the
            example and returns the parameters. For file formats, a function of a path: :mod:`foveasim.testing` describes the
            examples of all kinds.
        expected : object, optional
            Known result of the example, in the form of the kind.
        info : object, optional
            Facts about the object, in the form of the kind, such as :class:`foveasim.metrics.MetricInfo`.

        Raises
        ------
        ParameterError
            When another object has this name.
        """
        if item is None:
            return lambda decorated: self.register(name, decorated, example=example, expected=expected, info=info)
        if name in self._objects and _identity(self._objects[name]) != _identity(item):
            raise ParameterError("name", f"must be new: another {self.kind} has this name", name)
        if name not in self._objects:
            for facts in (self._examples, self._info):  # of an object that was removed
                facts.pop(name, None)
        self._objects[name] = item
        if example is not None or expected is not None:  # an entry point has the example of its decorator
            self._examples[name] = _Example({} if example is None else example, expected)
        if info is not None:
            self._info[name] = info
        self.version += 1
        return item

    def example(self, name: str) -> Any:
        """
        Return the example with which an object was registered, an empty mapping by default.

        Raises
        ------
        ParameterError
            When no object has this name.
        """
        self.find("name", name)
        found = self._examples.get(name, _Example()).example
        return dict(found) if isinstance(found, Mapping) else found

    def expected(self, name: str) -> Any:
        """Return the known result of the example of an object, or None."""
        return self._examples.get(name, _Example()).expected

    def info(self, name: str) -> Any:
        """Return the facts with which an object was registered, or None."""
        self._all()
        return self._info.get(name)

    def _all(self) -> dict[str, T]:
        if not self._is_complete:
            self._is_complete = True
            for module in self._modules:
                import_module(module)
            for point in _entry_points().select(group=self.group):
                try:
                    self.register(point.name, point.load())
                except Exception as error:  # noqa: BLE001 -- code of another package may raise anything
                    package = point.dist.name if point.dist is not None else point.value
                    reason = " ".join(str(error).split()) or type(error).__name__
                    _log.warning("%s '%s' of %s cannot be loaded (%s)", self.kind, point.name, package, reason)
        return self._objects

    def __getitem__(self, name: str) -> T:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def within(self, package: str) -> dict[str, T]:
        """Return the objects that modules of a package registered; entry points are not loaded."""
        return {
            name: item
            for name, item in self._objects.items()
            if str(getattr(item, "__module__", "")).startswith(f"{package}.")
        }

    def attributes_of(self, module: str) -> Callable[[str], T]:
        """Return a ``__getattr__`` for a module that looks up registered objects by name."""

        def attribute(name: str) -> T:
            if name.startswith("_"):  # looked up by Python, while packages are imported
                raise AttributeError(f"module '{module}' has no attribute '{name}'")
            if name in self:
                return self[name]
            own = (each for each in vars(sys.modules.get(module, object)) if not each.startswith("_"))
            hint = did_you_mean(name, {*self, *own})
            raise AttributeError(f"module '{module}' has no attribute '{name}'{'; ' if hint else ''}{hint}")

        return attribute

    def find(self, parameter: str, name: object) -> T:
        """
        Return the object with a given name.

        Raises
        ------
        ParameterError
            When no object has this name; the message contains the closest name and all names.
        """
        objects = self._all()
        if isinstance(name, str) and name in objects:
            return objects[name]
        raise ParameterError(
            parameter, f"must be the name of {with_article(self.kind)}", name, hint=possible_names(name, list(objects))
        )
