"""
Kinds of values that annotations specify, for the validation of arguments.

A kind is coarser than its annotation: numbers may be of numpy, arrays may be lists, and sequences of a fixed length may be of
any type. Values, shapes and bounds are validated by the functions themselves; here, a value is rejected that no code of the
function could use. Items of sequences, sets and mappings are checked where the annotation is abstract (``Sequence[str]``);
those of ``list[...]`` and ``tuple[..., ...]``, and of iterators, are not.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import os
import sys
import typing
from collections import abc
from collections.abc import Callable, Iterator, Mapping
from dataclasses import InitVar
from enum import Enum
from functools import lru_cache
from importlib import import_module
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.names import did_you_mean, list_names
from foveasim.errors import ParameterError, type_name, with_article

T = TypeVar("T")
OWN_CHECK = "checked by the call"
#: Annotation of a parameter whose call checks the kind of its values itself, with a message of its own.
OwnCheck = Annotated[T, OWN_CHECK]
#: Words for the lengths of sequences.
COUNTS = {1: "one", 2: "two", 3: "three", 4: "four"}
#: Types of the aliases that the statement ``type`` of Python 3.12 defines.
ALIASES: Any = (typing.TypeAliasType,) if hasattr(typing, "TypeAliasType") else ()
#: Longest name of a file, and longest path, of the usual file systems.
MAX_NAME_BYTES, MAX_PATH_BYTES = 255, 4095


class Kind(NamedTuple):
    """
    Values that a parameter accepts.

    ``one`` and ``many`` are names of one value and of several, ``choices`` the possible strings, if they are few. Messages
    about objects that are identified by their class (``is_class``) show the class. ``item`` is the kind of the items of a
    collection.
    """

    accepts: Callable[[Any], bool]
    one: str
    many: str
    choices: tuple[str, ...] = ()
    is_class: bool = False
    item: Any = None


def check_kind(name: str, value: Any, kind: Kind) -> None:
    """Check that a value is of a kind."""
    if not kind.accepts(value):
        if isinstance(value, str | os.PathLike) and _PATH.one in kind.one and _is_too_long(value):
            rule = f"must have names of at most {MAX_NAME_BYTES} bytes, and {MAX_PATH_BYTES} in all"
            raise ParameterError(name, rule, f"{os.fspath(value)!s:.60}...")
        if kind.item is not None and _is_sequence(value):
            for k, each in enumerate(value):
                check_kind(f"{name}[{k}]", each, kind.item)
        if kind.item is not None and isinstance(value, Mapping):
            for key, each in value.items():
                check_kind(f"{name}[{key!r}]", each, kind.item)
        if kind.is_class:
            raise ParameterError(name, f"must be {kind.one}, got {type_name(value)}")
        hint = did_you_mean(value, kind.choices) if isinstance(value, str) else ""
        raise ParameterError(name, f"must be {kind.one}", value, hint=hint)


class _Named(type):
    """Metaclass of stand-ins for types of libraries, which are identified by their names."""

    library: str

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return _named(cls.library, name)

    def __getitem__(cls, key: object) -> Any:
        return cls

    def __instancecheck__(cls, value: object) -> bool:
        return any(
            each.__name__ == cls.__name__ and each.__module__.partition(".")[0] == cls.library
            for each in type(value).__mro__
        )


def _named(library: str, name: str) -> Any:
    """Return a stand-in for a type of a library."""
    return _Named(name, (), {"library": library})


@lru_cache(maxsize=256)
def _types_of(module: str) -> dict[str, Any]:
    """Return types that a module imports for type checkers only, or their stand-ins."""
    found: dict[str, Any] = {}
    for node in ast.walk(ast.parse(inspect.getsource(sys.modules[module]))):
        if not isinstance(node, ast.If) or ast.unparse(node.test) != "TYPE_CHECKING":
            continue
        for each in ast.walk(node):
            if isinstance(each, ast.Import):
                found.update((name.asname or name.name, _named(name.name, name.name)) for name in each.names)
            elif isinstance(each, ast.ImportFrom) and each.module is not None:
                library = each.module.partition(".")[0]
                for name in each.names:
                    if library == __name__.partition(".")[0]:
                        import_module(each.module)
                    loaded = getattr(sys.modules.get(each.module), name.name, None)
                    found[name.asname or name.name] = _named(library, name.name) if loaded is None else loaded
    return found


class _Names(dict[str, Any]):
    """Names in annotations of a module."""

    def __init__(self, known: Mapping[str, Any]) -> None:
        super().__init__(known)

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            return getattr(builtins, name)
        try:
            return _types_of(self["__name__"])[name]
        except (OSError, TypeError, KeyError):  # no source code
            raise KeyError(name) from None


def resolve_annotation(annotation: Any, names: Mapping[str, Any]) -> Any:
    """
    Return the type of an annotation that is a string.

    ``names``: global names of the module of the annotation. Returns :data:`~typing.Any` when a name is not known, as in
    annotations that were inherited from other modules, or when an older version of a library does not have the type.
    """
    if not isinstance(annotation, str):
        return annotation
    try:
        return eval(annotation, {}, _Names(names))  # noqa: S307 -- source code of the package
    except (NameError, TypeError):
        return Any


def without_alias(annotation: Any) -> Any:
    """
    Return the type that an alias stands for; ArrayLike remains.

    From numpy 2.5, both NDArray and ArrayLike are aliases that the statement ``type`` defines.
    """
    alias: Any = get_origin(annotation) or annotation
    if not isinstance(alias, ALIASES) or alias is ArrayLike:
        return annotation
    value = alias.__value__
    return without_alias(value[get_args(annotation)] if alias is not annotation else value)


def kind_of(annotation: Any) -> Kind | None:
    """Return the kind of the values of a type; None if it accepts any value."""
    annotation = without_alias(annotation)
    if isinstance(annotation, InitVar):
        return kind_of(annotation.type)
    if get_origin(annotation) is Annotated:
        first, *others = get_args(annotation)
        return None if OWN_CHECK in others else kind_of(first)
    members = set(get_args(annotation)) if get_origin(annotation) in (Union, UnionType) else {annotation}
    kinds: list[Kind | None] = []
    paths = {each for each in members if isinstance(each, type) and issubclass(each, os.PathLike)}
    is_path = bool(paths) and str in members
    if is_path:
        members -= paths
        kinds.append(_PATH)
    if members >= _ARRAY_LIKE:
        # ``str | ArrayLike`` is indistinguishable from ArrayLike, which accepts strings.
        members -= _ARRAY_LIKE
        kinds.append(_ARRAY)
    elif is_path:
        members -= {str}
    kinds += [_single_kind(each) for each in _in_order(annotation, members)]
    if any(kind is None for kind in kinds):
        return None
    return _either([kind for kind in kinds if kind is not None])


def _in_order(annotation: Any, members: set[Any]) -> list[Any]:
    """Return the members of a union in their order, None last."""
    every = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    return sorted((each for each in every if each in members), key=lambda each: each is NoneType)


def _either(kinds: list[Kind]) -> Kind:
    """Return the kind of a union; messages do not mention None."""
    tests = tuple(kind.accepts for kind in kinds)
    shown = [kind for kind in kinds if kind is not _NONE] or kinds
    if len(shown) == 1:
        first, *_ = shown
        return first if len(kinds) == 1 else first._replace(accepts=lambda value: value is None or first.accepts(value))
    separator = " or " if all(kind.is_class for kind in shown) else ", or "
    one, many = (separator.join(dict.fromkeys(getattr(kind, each) for kind in shown)) for each in ("one", "many"))
    collections = [kind for kind in shown if kind.item is not None]
    return Kind(
        lambda value: any(test(value) for test in tests),
        one,
        many,
        choices=tuple(choice for kind in shown for choice in kind.choices),
        is_class=any(kind.is_class for kind in shown),
        item=collections[0].item if len(collections) == 1 else None,
    )


def _single_kind(kind: Any) -> Kind | None:
    """Return the kind of a type that is not a union."""
    kind = without_alias(kind)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return kind_of(kind)
    if origin is Literal:
        return _choice(arguments)
    if origin is np.ndarray or kind is np.ndarray:
        scalar = get_args(arguments[1])[0] if arguments else Any
        if scalar is np.object_:
            return _class("array of objects", lambda value: isinstance(value, np.ndarray))
        return _NUMBERS if isinstance(scalar, type) and issubclass(scalar, np.number | np.bool_) else _ARRAY
    if origin is tuple and Ellipsis not in arguments:
        return _fixed_sequence(arguments)
    found = _KINDS.get(kind) or _KINDS.get(origin)
    if found is not None:
        return found
    if origin is abc.Sequence:
        return _collection(_is_sequence, arguments[0])
    if origin in (abc.Iterable, abc.Collection, abc.Container, set, frozenset, abc.Set):
        return _collection(_is_iterable, arguments[0])
    if origin in (abc.Mapping, abc.MutableMapping):
        return _mapping(arguments[1])
    owner = origin or kind
    if not isinstance(owner, type) or owner in (object, Any):
        return None
    if getattr(owner, "_is_protocol", False):
        return _protocol(owner)
    return _class(owner.__name__, lambda value: isinstance(value, owner))


def _choice(values: tuple[Any, ...]) -> Kind:
    names = tuple(value for value in values if isinstance(value, str))
    shown = list_names(names) if len(names) == len(values) else ", ".join(map(repr, values))

    def accepts(value: Any) -> bool:
        if isinstance(value, np.generic | np.ndarray) and value.ndim == 0:
            value = value.item()
        is_plain = isinstance(value, str | int | float | None)
        return is_plain and any(value == each and isinstance(value, bool) == isinstance(each, bool) for each in values)

    return Kind(accepts, f"one of {shown}", f"names among {shown}", names)


def _class(name: str, accepts: Callable[[Any], bool]) -> Kind:
    return Kind(accepts, with_article(name), f"{name} objects", is_class=True)


def _fixed_sequence(items: tuple[Any, ...]) -> Kind | None:
    """Return the kind of a sequence of a fixed length; functions check its numbers."""
    kinds = [kind_of(item) for item in items]
    tests = [_is_no_sequence if kind in (_NUMBER, _INTEGER) else kind.accepts for kind in kinds if kind]
    n = len(items)

    def accepts(value: Any) -> bool:
        if not _is_sequence(value) or len(value) != n:
            return False
        return len(tests) != n or all(test(item) for test, item in zip(tests, value, strict=True))

    names = {kind.many if kind else "values" for kind in kinds}
    one = f"{COUNTS.get(n, n)} {names.pop() if len(names) == 1 else 'values'}"
    return Kind(accepts, one, f"lists of {one}")


def _collection(is_collection: Callable[[Any], bool], item: Any) -> Kind:
    kind = kind_of(item)
    if kind is None:
        return Kind(is_collection, "a list", "lists")
    if kind in (_NUMBER, _INTEGER) and is_collection is _is_sequence:
        return _NUMBERS  # one number stands for a list of one, as in numpy.atleast_1d
    test = kind.accepts

    def accepts(value: Any) -> bool:
        # Iterators and lazy sequences are not read.
        is_read = isinstance(value, list | tuple | set | frozenset | np.ndarray)
        return is_collection(value) and (not is_read or all(map(test, value)))

    return Kind(accepts, f"a list of {kind.many}", f"lists of {kind.many}", item=kind)


def _mapping(item: Any) -> Kind:
    kind = kind_of(item)

    def accepts(value: Any) -> bool:
        return isinstance(value, Mapping) and (kind is None or all(map(kind.accepts, value.values())))

    of = f" to {kind.many}" if kind else ""
    return Kind(accepts, f"a mapping{of}", f"mappings{of}", item=kind)


def _protocol(protocol: type) -> Kind:
    names = [
        name
        for each in protocol.__mro__
        if getattr(each, "_is_protocol", False)
        for name in {**getattr(each, "__annotations__", {}), **vars(each)}
        if not name.startswith("_") or name == "__call__"
    ]
    return _class(protocol.__name__.removesuffix("Like"), lambda value: all(_has(value, name) for name in names))


@lru_cache(maxsize=1024)
def _class_has(kind: type, name: str) -> bool:
    """Whether a class has an attribute for its instances, or computes any on access."""
    return hasattr(kind, "__getattr__") or any(
        name in vars(each) or name in inspect.get_annotations(each) for each in kind.__mro__
    )


def _has(value: object, name: str) -> bool:
    """Whether an object has an attribute, without computing it."""
    kind: type = type(value)
    return _class_has(kind, name) or name in getattr(value, "__dict__", ())


def _accepts_path(value: Any) -> bool:
    return isinstance(value, str | os.PathLike) and not _is_too_long(value)


def _is_too_long(value: Any) -> bool:
    """Whether file systems reject a path, for which pathlib raises an OSError."""
    path = os.fspath(value)
    if len(path) <= MAX_NAME_BYTES // 4:  # the common case; a character has at most 4 bytes
        return False
    encoded = path if isinstance(path, bytes) else path.encode("utf-8", "surrogatepass")
    return len(encoded) > MAX_PATH_BYTES or any(len(part) > MAX_NAME_BYTES for part in encoded.split(os.sep.encode()))


def _accepts_number(value: Any) -> bool:
    kind = type(value)
    if kind is float or kind is int:
        return True
    if isinstance(value, str | bytes) or not hasattr(kind, "__float__"):
        return False
    return getattr(value, "ndim", 0) == 0 and getattr(getattr(value, "dtype", None), "kind", "f") in "biuf"


def _accepts_integer(value: Any) -> bool:
    if type(value) is int:
        return True
    if not _accepts_number(value):
        return False
    try:
        return isinstance(value, int | np.integer) or float(value).is_integer()
    except (OverflowError, ValueError):  # fractions and decimals without a float
        return False


def _accepts_bool(value: Any) -> bool:
    return isinstance(value, bool | np.bool_) or (type(value) is int and value in (0, 1))


def _is_sequence(value: Any) -> bool:
    """Return whether items have an order and a number."""
    if isinstance(value, list | tuple):
        return True
    if isinstance(value, str | bytes | Mapping | type):
        return False
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, abc.Sequence | abc.KeysView | abc.ValuesView) or (
        hasattr(value, "__len__") and hasattr(value, "__getitem__")
    )


def _is_no_sequence(value: Any) -> bool:
    kind = type(value)
    return kind is float or kind is int or not _is_sequence(value)


def _is_iterable(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return hasattr(value, "__iter__") and not isinstance(value, str | bytes | type)


def _accepts_array(value: Any, kinds: str) -> bool:
    dtype = getattr(value, "dtype", None)
    if dtype is not None and hasattr(value, "shape"):  # arrays of any library; they are not loaded
        kind = getattr(dtype, "kind", kinds[0])
        return kind in kinds or (kind == "O" and all(map(_accepts_number, np.asarray(value).flat)))
    if isinstance(value, bool | int | float | complex | str | bytes | np.generic):
        return np.asarray(value).dtype.kind in kinds
    if value is None or isinstance(value, Mapping | set | frozenset | type | Enum | slice):
        return False
    if not isinstance(value, list | tuple):
        if hasattr(type(value), "__array__") or hasattr(type(value), "__array_interface__"):
            return True  # converted, and checked, by the function
        if not hasattr(value, "__len__"):
            return False
    try:
        return all(dtype in kinds for dtype in _dtypes(value))
    except RecursionError:  # a list that contains itself
        return False


def _dtypes(value: Any) -> Iterator[str]:
    """Yield the kinds of the scalars in nested lists; ``O`` for other objects."""
    if isinstance(value, list | tuple):
        for each in value:
            kind = type(each)
            if kind is float or kind is int or issubclass(kind, np.floating | np.integer):
                yield "f"
            else:
                yield from _dtypes(each)
    elif getattr(getattr(value, "dtype", None), "kind", "") == "O":
        yield from ("f" if _accepts_number(each) else "O" for each in np.asarray(value).flat)
    elif hasattr(value, "dtype"):
        yield getattr(value.dtype, "kind", "f")
    elif value is None:
        yield "O"
    elif _accepts_number(value):
        yield "f"
    else:
        try:
            yield np.asarray(value).dtype.kind
        except (TypeError, ValueError):  # nested objects of the package, or rows of different lengths
            yield "O"


_NONE = Kind(lambda value: value is None, "None", "None")
_NUMBER = Kind(_accepts_number, "one number", "numbers")
_INTEGER = Kind(_accepts_integer, "an integer", "integers")
_STRING = Kind(lambda value: isinstance(value, str), "a string", "strings")
_PATH = Kind(_accepts_path, "a path", "paths")
_NUMBERS = Kind(lambda value: _accepts_array(value, "fiub"), "an array of numbers", "arrays of numbers")
_ARRAY = Kind(lambda value: _accepts_array(value, "fiubcSUTmMV"), "an array of numbers", "arrays of numbers")
_FUNCTION = Kind(callable, "a callable", "callables")
_LIST = Kind(_is_sequence, "a list", "lists")
#: Kinds of types without arguments, and of types whose arguments are not checked.
_KINDS: dict[Any, Kind] = {
    NoneType: _NONE,
    # Random streams are None where nothing is drawn.
    np.random.Generator: Kind(
        lambda value: value is None or isinstance(value, np.random.Generator),
        "a Generator",
        "Generator objects",
        is_class=True,
    ),
    bool: Kind(_accepts_bool, "True or False", "True or False"),
    float: _NUMBER,
    int: _INTEGER,
    str: _STRING,
    list: _LIST,
    tuple: _LIST,
    dict: Kind(lambda value: isinstance(value, Mapping), "a mapping", "mappings"),
    abc.Callable: _FUNCTION,
    abc.Iterator: Kind(lambda value: hasattr(value, "__next__"), "an iterator", "iterators"),
    type: Kind(lambda value: isinstance(value, type), "a class", "classes"),
}
_ARRAY_LIKE = frozenset(get_args(ArrayLike) or (ArrayLike,))
