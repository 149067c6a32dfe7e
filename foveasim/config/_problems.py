"""Validation of settings: each problem in one line, with the path of its key."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from foveasim.errors import ConfigError

__all__ = ["validate"]

#: Maximum number of problems in one message.
MAX_PROBLEMS = 3


def validate(path: Path, kind: Any, data: dict[str, Any]) -> Any:
    """
    Return settings as an instance of a model.

    Raises
    ------
    ConfigError
        With the file, the path of the key, and the expected and actual value.
    """
    try:
        return TypeAdapter(kind).validate_json(json.dumps(data, default=_reject), strict=True)
    except ValidationError as error:
        problems = _problems(data, error)
        message = "; ".join(problems[:MAX_PROBLEMS])
        more = len(problems) - MAX_PROBLEMS
        raise ConfigError(path, message + (f"; and {more} more" if more > 0 else "")) from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(path, f"contains an unreadable value ({error})") from None


def _reject(value: object) -> None:
    raise ValueError(f"a {type(value).__name__} is not a number, string, list or section")


def _problems(data: dict[str, Any], error: ValidationError) -> list[str]:
    """Return every distinct problem as "key: problem"."""
    found = [(_key_path(data, item), item) for item in error.errors(include_url=False)]
    # For a union, pydantic reports a problem for every type: only those of the deepest key matter.
    problems = [
        f"{'.'.join(key_path) or 'the file'}{_describe(item)}"
        for key_path, item in found
        if not (
            item["type"].endswith("_type")
            and any(
                other[: len(key_path)] == key_path and (len(other) > len(key_path) or not o["type"].endswith("_type"))
                for other, o in found
            )
        )
    ]
    return list(dict.fromkeys(problems))


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


def _describe(error: Any) -> str:
    match error["type"]:
        case "extra_forbidden":
            return ": no such setting"
        case "missing":
            return ": missing"
        case "union_tag_not_found":
            return f": requires the key {error['ctx']['discriminator']}"
        case "union_tag_invalid":
            key = error["ctx"]["discriminator"].strip("'")
            return f".{key}: must be one of {error['ctx']['expected_tags']}, got '{error['ctx']['tag']}'"
        case _:
            got = "" if isinstance(error["input"], dict | list) else f", got {json.dumps(error['input'])}"
            rule = re.sub(r"^\w+ should", "must", error["msg"]).replace(" after validation", "")
            return f": {rule}{got}"
