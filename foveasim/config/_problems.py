"""Settings against their models, every problem told in one sentence with its place."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from foveasim.errors import ConfigError

__all__ = ["validated"]

#: Problems of a file that one message names.
SHOWN_PROBLEMS = 3


def validated(path: Path, kind: Any, data: dict[str, Any]) -> Any:
    """
    The settings as a model.

    Raises
    ------
    ConfigError
        With the file, the place in it, what was expected and got.
    """
    try:
        return TypeAdapter(kind).validate_json(json.dumps(data, default=_refuse), strict=True)
    except ValidationError as error:
        problems = _problems(data, error)
        shown = "; ".join(problems[:SHOWN_PROBLEMS])
        more = len(problems) - SHOWN_PROBLEMS
        raise ConfigError(path, shown + (f"; and {more} more" if more > 0 else "")) from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(path, f"holds a value that cannot be read ({error})") from None


def _refuse(value: object) -> None:
    raise ValueError(f"a {type(value).__name__} is neither number, text, list nor section")


def _problems(data: dict[str, Any], error: ValidationError) -> list[str]:
    """Every problem once, as "place: what is wrong"."""
    found = [(_place(data, item), item) for item in error.errors(include_url=False)]
    # Where several types are allowed, pydantic tells what is wrong with each: the nearest one says what was meant.
    told = [
        f"{'.'.join(place) or 'the file'}{_sentence(item)}"
        for place, item in found
        if not (
            item["type"].endswith("_type")
            and any(
                other[: len(place)] == place and (len(other) > len(place) or not o["type"].endswith("_type"))
                for other, o in found
            )
        )
    ]
    return list(dict.fromkeys(told))


def _place(data: Any, error: Any) -> tuple[str, ...]:
    """Keys and positions that lead to a problem, without the names of alternatives that pydantic puts among them."""
    place = []
    tags = _tags(data)
    for i, part in enumerate(error["loc"]):
        if part in tags:  # the alternative that a section's key chose, which may be the name of another key
            tags = ()
        elif (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        ):
            data = data[part]
            tags = _tags(data)
            place.append(str(part))
        elif i == len(error["loc"]) - 1 and error["type"] == "missing":
            place.append(str(part))
    return tuple(place)


def _tags(data: Any) -> tuple[Any, ...]:
    """What a section's key may have chosen among alternatives."""
    return (data.get("kind"), data.get("generator")) if isinstance(data, dict) else ()


def _sentence(error: Any) -> str:
    match error["type"]:
        case "extra_forbidden":
            return ": no such setting"
        case "missing":
            return ": is missing"
        case "union_tag_not_found":
            return f": needs the key {error['ctx']['discriminator']}"
        case "union_tag_invalid":
            key = error["ctx"]["discriminator"].strip("'")
            return f".{key}: must be one of {error['ctx']['expected_tags']}, got '{error['ctx']['tag']}'"
        case _:
            got = "" if isinstance(error["input"], dict | list) else f", got {json.dumps(error['input'])}"
            rule = re.sub(r"^\w+ should", "must", error["msg"]).replace(" after validation", "")
            return f": {rule}{got}"
