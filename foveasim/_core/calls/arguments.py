"""
Messages for calls with wrong arguments.

Python reports a misspelt, missing or surplus argument as a TypeError, and a value of a wrong type only where the function
uses it, or not at all. Public functions, constructors and methods raise an :class:`~foveasim.errors.ArgumentError` instead,
with the signature of the call and the closest name, and a :class:`~foveasim.errors.ParameterError` for values that do not
match the annotations. Checked functions keep their signature, types and docstring.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from types import FunctionType
from typing import Any, ParamSpec, TypeVar, cast

from foveasim._core.calls.kinds import Kind, check_kind, kind_of, resolve_annotation
from foveasim._core.calls.limits import Converter, Declaration, without_declarations
from foveasim._core.names import did_you_mean
from foveasim.errors import ArgumentError

P = ParamSpec("P")
R = TypeVar("R")
#: Characters of a signature in a message; optional parameters beyond are replaced by "...".
MAX_SIGNATURE = 150
#: Characters of a default in a signature.
MAX_DEFAULT = 12
#: First parameters of methods, which Python passes.
BOUND = ("self", "cls")
#: Accepted kinds of values: of parameters by position, of parameters by name, of ``*args``, and of ``**kwargs``.
_Kinds = tuple[list[tuple[str, Kind | None]], dict[str, Kind | None], tuple[str, Kind] | None, Kind | None]
#: Converters of parameters with declared limits, by position and by name.
_Converters = tuple[list[tuple[int, str, Converter]], dict[str, Converter]]
#: Modules whose functions check their arguments only in calls from outside the package. The package calls them many times
#: per capture, with arguments that a public function has already checked.
INNER = ("foveasim.optics._optics", "foveasim.sensor.effects.contract", "foveasim.units")
#: Attribute that marks a function whose arguments are checked.
CHECKED = "_arguments_are_checked"


def check_arguments(call: Callable[P, R], *, converts: bool = True) -> Callable[P, R]:
    """
    Return a function that rejects arguments outside its signature or declared limits.

    ``converts``: whether arguments with declared limits are checked and converted, to floats and integers; dataclasses do
    so themselves. A valid call takes 1 to 2 µs longer, and lists of numbers a time in proportion to their length; the
    annotations are read at the first call. Those of :data:`INNER` modules are not checked within the package.
    """
    if not isinstance(call, FunctionType) or hasattr(call, CHECKED):
        return call
    # Local names, because the function below runs with the globals of ``call``, which lack these functions.
    find_problem, find_checks, check = _find_problem, _find_checks, check_kind
    frame, is_inner = sys._getframe, call.__module__ in INNER and call.__name__ != "__init__"  # noqa: SLF001 -- as in logging
    kinds: _Kinds | None = None
    converters: _Converters = [], {}
    annotations = call.__annotations__

    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        __tracebackhide__ = True  # in the tracebacks of IPython and pytest
        nonlocal kinds, converters
        if is_inner and frame(1).f_globals.get("__name__", "").startswith("foveasim."):
            return call(*args, **kwargs)
        if kinds is None:
            found, found_converters = find_checks(call, annotations)
            converters = found_converters if converts else converters
            kinds = found  # set last, so that other threads that see the kinds also see the converters
        by_position, by_name, of_args, of_kwargs = kinds
        for (name, kind), value in zip(by_position, args):  # noqa: B905 -- surplus arguments are reported below
            if kind is not None and not kind.accepts(value):
                check(name, value, kind)
        if of_args is not None:
            for k, value in enumerate(args[len(by_position) :]):
                if not of_args[1].accepts(value):
                    check(f"{of_args[0]}[{k}]", value, of_args[1])
        for name, value in kwargs.items():
            kind = by_name.get(name, of_kwargs)
            if kind is not None and not kind.accepts(value):
                check(name, value, kind)
        for k, name, convert in converters[0]:
            if k < len(args):
                args = (*args[:k], convert(name, args[k], None), *args[k + 1 :])  # type: ignore[assignment]
        for name, convert in converters[1].items():
            if name in kwargs:
                kwargs[name] = convert(name, kwargs[name], None)
        try:
            return call(*args, **kwargs)
        except TypeError:
            problem = find_problem(call, args, kwargs)
            if problem is None:
                raise
            raise problem from None

    # With the globals of the function, so that doctest finds its examples.
    found = FunctionType(checked.__code__, call.__globals__, call.__name__, None, checked.__closure__)
    functools.update_wrapper(found, call)
    setattr(found, CHECKED, True)
    # ``help`` shows the signature of the original.
    call.__annotations__ = {name: without_declarations(each) for name, each in annotations.items()}
    return cast("Callable[P, R]", found)


def _find_checks(call: Callable[..., Any], annotations: Mapping[str, Any]) -> tuple[_Kinds, _Converters]:
    """Return kinds of all arguments, and converters of parameters by position and by name."""
    names = getattr(inspect.unwrap(call), "__globals__", {})
    by_position: list[tuple[str, Kind | None]] = []
    by_name: dict[str, Kind | None] = {}
    converters: _Converters = [], {}
    of_args, of_kwargs = None, None
    for k, (name, parameter) in enumerate(inspect.signature(call).parameters.items()):
        annotation = resolve_annotation(annotations.get(name, Any), names)
        known = None if k == 0 and name in BOUND else kind_of(annotation)
        if parameter.kind is parameter.VAR_KEYWORD:
            of_kwargs = known
        elif parameter.kind is parameter.VAR_POSITIONAL:
            of_args = None if known is None else (name, known)
        else:
            declared = Declaration.of(annotation)
            convert = None if declared.limits is None else declared.converter
            by_name[name] = known
            if convert is not None:
                converters[1][name] = convert
            if parameter.kind is not parameter.KEYWORD_ONLY:
                by_position.append((name, known))
                if convert is not None:
                    converters[0].append((k, name, convert))
    return (by_position, by_name, of_args, of_kwargs), converters


def check_public_calls(module_name: str) -> None:
    """
    Check the arguments of all public functions, constructors and methods of a module.

    Public names are those in its ``__all__``; see :func:`check_arguments`.
    """
    module = sys.modules[module_name]
    for name in module.__all__:
        item = vars(module).get(name)  # None for names that are imported on use
        package = str(getattr(item, "__module__", "")).partition(".")[0]
        if package != __name__.partition(".")[0]:
            continue
        if isinstance(item, FunctionType):
            checked = check_arguments(item)
            # Also in the module that defines the function, where pickle looks it up.
            for home in (module, sys.modules[item.__module__]):
                if vars(home).get(name) is item:
                    setattr(home, name, checked)
        elif (
            isinstance(item, type) and not issubclass(item, BaseException) and not getattr(item, "_is_protocol", False)
        ):
            for kind in item.__mro__:
                if kind.__module__.partition(".")[0] == package:
                    _check_methods(kind)


def _check_methods(kind: type) -> None:
    for name, member in list(vars(kind).items()):
        if name.startswith("_") and name not in ("__init__", "__call__"):
            continue
        if isinstance(member, classmethod | staticmethod):
            setattr(kind, name, type(member)(check_arguments(member.__func__)))
        elif isinstance(member, FunctionType):
            setattr(kind, name, check_arguments(member, converts=name != "__init__" or not is_dataclass(kind)))


def _find_problem(call: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> ArgumentError | None:
    """Return the error of arguments that do not match a signature, None if they do."""
    declared = list(inspect.signature(call).parameters.values())
    is_bound = bool(declared) and declared[0].name in BOUND and "." in call.__qualname__
    parameters = declared[1:] if is_bound else declared
    name = _name_of(call, args[:is_bound])
    args = args[1:] if is_bound else args
    shown = _format_signature(name, parameters)
    by_position = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    by_name = [p.name for p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    kinds = {p.kind for p in parameters}
    given = {*by_position[: len(args)], *kwargs}
    unknown = [] if inspect.Parameter.VAR_KEYWORD in kinds else [key for key in kwargs if key not in by_name]
    if unknown:
        free = [key for key in by_name if key not in given]
        return ArgumentError(unknown[0], f"must be an argument of {shown}", hint=did_you_mean(unknown[0], free))
    twice = [key for key in by_position[: len(args)] if key in kwargs]
    if twice:
        return ArgumentError(twice[0], f"must be given once, by position or by name: {shown}")
    if len(args) > len(by_position) and inspect.Parameter.VAR_POSITIONAL not in kinds:
        n = len(by_position)
        limit = f"at most {n} positional argument{'s' * (n != 1)}" if n else "named arguments only"
        return ArgumentError(name, f"must have {limit}, got {len(args)} by position: {shown}")
    missing = [p.name for p in parameters if p.name not in given and _is_required(p)]
    if missing:
        others = "".join(f"and '{key}' " for key in missing[1:])
        return ArgumentError(missing[0], f"{others}must be given: {shown}")
    return None


def _is_required(parameter: inspect.Parameter) -> bool:
    is_variadic = parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    return parameter.default is parameter.empty and not is_variadic


def _name_of(call: Callable[..., Any], owner: tuple[Any, ...]) -> str:
    """Return the name as users write it: ``function``, ``Class`` or ``Class.method``."""
    if owner and call.__name__ != "__init__":  # inherited methods have the name of the object's class
        kind = owner[0] if isinstance(owner[0], type) else type(owner[0])
        return f"{kind.__name__}.{call.__name__}"
    return call.__qualname__.rpartition("<locals>.")[2].removesuffix(".__init__")


def _format_signature(name: str, parameters: list[inspect.Parameter]) -> str:
    """Return a signature with all required, and as many optional parameters as fit."""
    parts: list[str] = []
    is_shortened = False
    for k, parameter in enumerate(parameters):
        if parameter.kind is parameter.KEYWORD_ONLY and not any(
            p.kind in (p.KEYWORD_ONLY, p.VAR_POSITIONAL) for p in parameters[:k]
        ):
            parts.append("*")
        if _is_required(parameter):
            parts.append(parameter.name)
        elif is_shortened or len(", ".join(parts)) > MAX_SIGNATURE:
            is_shortened = True
        elif parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            parts.append(("*" if parameter.kind is parameter.VAR_POSITIONAL else "**") + parameter.name)
        else:
            default = repr(parameter.default)
            is_short = len(default) <= MAX_DEFAULT and not default.startswith("<")
            parts.append(f"{parameter.name}={default if is_short else '...'}")
    return f"{name}({', '.join(parts)}{', ...' * is_shortened})"
