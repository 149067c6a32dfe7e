"""Validation of settings: each problem in one line, with the path and position of its key."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, PydanticUserError, TypeAdapter, ValidationError

from foveasim._core.names import closest_name, did_you_mean, list_names, possible_names
from foveasim.config._models import call_of
from foveasim.config._sources import Source
from foveasim.errors import ConfigError, ParameterError, format_value

#: Maximum number of problems in one message.
MAX_PROBLEMS = 3
#: Types of problems in pydantic: names that a section or a dataclass does not have; and wrong types, by the right one in words.
UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
TYPES = {"int_type": "an integer", "float_type": "a number"}


def plain_settings(source: Source | str | Path | None, value: Any, key_path: tuple[str, ...] = ()) -> Any:
    """
    Return settings from Python as a settings file contains them.

    Keys become strings, as in JSON; tuples and arrays become lists, paths strings, numbers of numpy numbers.

    Parameters
    ----------
    source : Source, path or None
        Origin of the settings, for messages.
    value : mapping, list or single value
    key_path : tuple of str
        Path of the value in the settings, for messages.

    Raises
    ------
    ConfigError
        When the settings contain other objects, other keys than strings and integers, or a key twice.
    """
    if value is None or type(value) in (str, bool, int, float):
        return value
    if isinstance(value, Mapping):
        found: dict[str, Any] = {}
        for key, item in value.items():
            name = str(key)
            if not isinstance(key, str | int | np.integer) or isinstance(key, bool):
                problem = f"must have strings or integers as keys, got {format_value(key)}"
                raise Source.of(source).error(key_path, problem)
            if name in found:
                raise Source.of(source).error((*key_path, name), "must be given once, not as a string and an integer")
            found[name] = plain_settings(source, item, (*key_path, name))
        return found
    if isinstance(value, list | tuple):
        return [plain_settings(source, item, (*key_path, str(k))) for k, item in enumerate(value)]
    if isinstance(value, np.ndarray | np.generic):
        return plain_settings(source, value.tolist(), key_path)
    if isinstance(value, Path):
        return str(value)
    for kind in (str, int, float):
        if isinstance(value, kind):  # subclasses, such as enumerations
            return kind(value)
    raise Source.of(source).error(key_path, f"must be a number, string, list or section, got {format_value(value)}")


def adapter_of(name: str, kind: Any) -> TypeAdapter[Any]:
    """Return the validator of a model; raise a ParameterError if ``kind`` is not a model."""
    try:
        if not isinstance(kind, str):  # pydantic would read it as the name of a type
            return TypeAdapter(kind)
    except (PydanticUserError, KeyError, TypeError):
        pass
    raise ParameterError(name, "must be a model of settings", kind)


def validate(source: Source | str | Path | None, kind: Any, data: Mapping[str, Any]) -> Any:
    """
    Return settings as an instance of a model.

    Raises
    ------
    ConfigError
        With the file, its line and column, the path of the key, and the expected and actual value.

    Examples
    --------
    Check a mapping of design rules:

    >>> import foveasim as fs
    >>> fs.config.validate(None, fs.DesignRules, {"min_size_um": 2.0, "grid_um": 0.005})
    DesignRules(min_size_um=2.0, grid_um=0.005)
    """
    source = Source.of(source)
    adapter = adapter_of("kind", kind)
    try:
        plain = plain_settings(source, data)
        return adapter.validate_json(json.dumps(plain), strict=True)
    except ValidationError as error:
        (key_path, first), *others = _problems(kind, plain, error)
        more = len(others) + 1 - MAX_PROBLEMS
        others_listed = [
            f"{'.'.join(key)}: {problem}" if key else problem for key, problem in others[: MAX_PROBLEMS - 1]
        ]
        message = "; ".join([first, *others_listed, *([f"and {more} more"] if more > 0 else [])])
        raise source.error(key_path, message) from None
    except RecursionError:
        raise ConfigError(source.file, "is nested too deeply") from None


def _problems(kind: Any, data: dict[str, Any], error: ValidationError) -> list[tuple[tuple[str, ...], str]]:
    """Return the path and the description of every distinct problem."""
    found = [(_key_path(data, item), item) for item in error.errors(include_url=False)]
    # For a union, pydantic reports a problem for every type: only those of the deepest key matter.
    problems: list[tuple[tuple[str, ...], str]] = []
    # Unknown keys first: a misspelt key is also missing.
    for key_path, item in sorted(found, key=lambda each: each[1]["type"] not in UNKNOWN_KEY):
        is_shadowed = _is_wrong_type(item) and any(
            other[: len(key_path)] == key_path and (len(other) > len(key_path) or not _is_wrong_type(o))
            for other, o in found
        )
        if not is_shadowed:
            # The path ends with the key that selects the kind of the section.
            tag = [item["ctx"]["discriminator"].strip("'")] if item["type"] == "union_tag_invalid" else []
            types = [TYPES[o["type"]] for other, o in found if other == key_path and o["type"] in TYPES]
            problems.append(((*key_path, *tag), _describe(kind, item, types, is_first=not problems)))
    return list(dict.fromkeys(problems))


def _is_wrong_type(error: Any) -> bool:
    """Return whether a problem is the type of a value, such as a list instead of a choice."""
    is_choice = error["type"] == "literal_error"
    return error["type"].endswith("_type") or (is_choice and isinstance(error["input"], dict | list))


def _key_path(data: Any, error: Any) -> tuple[str, ...]:
    """Return the keys and indices of a problem, without pydantic's tags of union members."""
    key_path = []
    tags = _tags(data)
    for i, part in enumerate(error["loc"]):
        if part in tags:  # a tag of a union, which may equal the name of a key
            tags = ()
        elif (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        ):
            data = data[part]
            tags = _tags(data)
            key_path.append(str(part))
        elif i == len(error["loc"]) - 1 and error["type"] == "missing":
            key_path.append(str(part))
    return tuple(key_path)


def _tags(data: Any) -> tuple[Any, ...]:
    """Return the possible union tags of a section."""
    return (data.get("kind"), data.get("generator")) if isinstance(data, dict) else ()


def _describe(kind: Any, error: Any, types: list[str], *, is_first: bool) -> str:
    """
    Return the rule and the value of a problem; the first unknown name lists all valid ones.

    ``types``: types that are valid instead of a name.
    """
    match error["type"]:
        case "extra_forbidden" | "unexpected_keyword_argument":
            name = error["loc"][-1]
            section = _section_at(kind, error["loc"][:-1])
            if section is None:
                return "unknown key"
            if not issubclass(section, BaseModel):
                call, keys = None, [field.name for field in fields(section)]
            else:
                call, keys = call_of(section), [field.alias or key for key, field in section.model_fields.items()]
            what = "unknown key" if call is None else f"unknown parameter of {call.__name__}"
            hint = possible_names(name, keys) if is_first else did_you_mean(name, keys)
            return f"{what}; {hint}" if hint else what
        case "missing":
            return "missing"
        case "union_tag_not_found" | "missing_alternative":
            key = error.get("ctx", {}).get("discriminator")
            rule, _, others = (f"requires the key {key}" if key else error["msg"]).partition(";")
            given = error["input"] if isinstance(error["input"], dict) else {}
            closest = next((name for key in _quoted(rule) if (name := closest_name(key, given))), None)
            return f"{rule}, got '{closest}'" if closest else f"{rule};{others}" if others else rule
        case "union_tag_invalid":
            tag = error["input"].get(error["ctx"]["discriminator"].strip("'"))
            shown = f"'{tag}'" if isinstance(tag, str) else json.dumps(tag)
            return _not_one_of(_quoted(error["ctx"]["expected_tags"]), tag, shown)
        case "literal_error":
            value = error["input"]
            return _not_one_of(_quoted(error["ctx"]["expected"]), value, json.dumps(value), types)
        case _:
            is_shown = isinstance(error["input"], dict | list) or ", got " in error["msg"]
            got = "" if is_shown else f", got {json.dumps(error['input'])}"
            rule = re.sub(r"^\w+ should", "must", error["msg"].removeprefix("Value error, ")).replace(
                " after validation", ""
            )
            return f"{rule}{got}"


def _quoted(names: str) -> list[str]:
    """Return the names in a list of pydantic such as ``'a', 'b' or 'c'``."""
    return re.findall(r"'([^']*)'", names) or re.findall(r"[^\s,]+(?<!\bor)", names)


def _not_one_of(known: list[str], value: Any, shown: str, types: Sequence[str] = ()) -> str:
    hint = did_you_mean(value, known) if isinstance(value, str) else ""
    also = "".join(f"{each}, or " for each in dict.fromkeys(types))
    return f"must be {also}one of {list_names(known, value)}, got {shown}{'; ' if hint else ''}{hint}"


def _section_at(kind: Any, loc: tuple[Any, ...]) -> type[Any] | None:
    """Return the model or dataclass of a section, by its location in the notation of pydantic."""
    candidates = list(_alternatives(kind))
    for part in loc:
        tagged = [each for each in candidates if part in _literals(each)]
        candidates = tagged or [
            below for each in candidates for inner in _below(each, part) for below in _alternatives(inner)
        ] or candidates  # fmt: skip
    return next(
        (each for each in candidates if isinstance(each, type) and (issubclass(each, BaseModel) or is_dataclass(each))),
        None,
    )


def _alternatives(kind: Any) -> Iterator[Any]:
    """Yield the types of a union, without annotations."""
    if get_origin(kind) is Annotated:
        yield from _alternatives(get_args(kind)[0])
    elif get_origin(kind) in (Union, UnionType):
        for each in get_args(kind):
            yield from _alternatives(each)
    else:
        yield kind


def _literals(kind: Any) -> tuple[Any, ...]:
    """Return the values of the key that selects a section in a union."""
    if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
        return ()
    fields = (kind.model_fields.get(key) for key in ("kind", "generator"))
    return tuple(
        value
        for field in fields
        if field is not None and get_origin(field.annotation) is Literal
        for value in get_args(field.annotation)
    )


def _below(kind: Any, part: Any) -> list[Any]:
    """Return the type of a key of a section, or of an item of a container."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return [field.annotation for key, field in kind.model_fields.items() if part in (key, field.alias)]
    if get_origin(kind) in (list, tuple) and isinstance(part, int):
        return list(get_args(kind)[:1])
    return list(get_args(kind)[1:2]) if get_origin(kind) is dict else []
