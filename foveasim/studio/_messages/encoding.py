"""Binary messages of the studio: a JSON header and arrays for JavaScript."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.errors import FileError, FoveasimError, ParameterError, printable

#: Alignment of arrays in bytes: typed arrays of JavaScript require offsets that are multiples of their item size.
ALIGNMENT = 8
#: Longest message of an error.
MAX_MESSAGE_LENGTH = 500
#: Types of arrays; JavaScript has a typed array for each.
TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")
#: Non-finite numbers in JSON, as YAML writes them.
NOT_FINITE = {".inf": math.inf, "-.inf": -math.inf}


def encode_part(
    name: str,
    version: int,
    about: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    *,
    is_preview: bool = False,
    has_more: bool = False,
    is_awaited: bool = False,
) -> bytes:
    """
    Encode a part: the length of the header as little-endian uint32, the header, the arrays.

    ``version``: number of the state that the part belongs to. ``about``: plain data. ``arrays``: of the types in
    :data:`TYPES`, any shape; each begins at a multiple of 8 bytes. ``is_preview``: whether the data are those of a preview.
    ``has_more``: whether the page waits for the next part, and shows both in one frame. ``is_awaited``: whether the page
    answers when it is drawn.
    """
    described, pieces, offset = [], [], 0
    for key, array in arrays.items():
        flat = np.ascontiguousarray(array).reshape(-1)
        if flat.dtype.name not in TYPES:
            raise ParameterError("arrays", f"must be one of {', '.join(TYPES)}, got {flat.dtype.name} for {key!r}")
        content = flat.astype(flat.dtype.newbyteorder("<"), copy=False).tobytes()
        described.append({"name": key, "type": flat.dtype.name, "size": int(flat.size), "offset": offset})
        pieces += [content, bytes(-len(content) % ALIGNMENT)]
        offset += len(content) + -len(content) % ALIGNMENT
    header = json.dumps(
        {
            "part": name,
            "version": version,
            "about": to_json(dict(about)),
            "arrays": described,
            **({"is_preview": True} if is_preview else {}),
            **({"has_more": True} if has_more else {}),
            **({"is_awaited": True} if is_awaited else {}),
        },
        allow_nan=False,
        separators=(",", ":"),
    ).encode()
    header += b" " * (-(4 + len(header)) % ALIGNMENT)
    return b"".join((len(header).to_bytes(4, "little"), header, *pieces))


def decode_part(message: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """
    Decode a part.

    Returns ``arrays``, dict of str to (n,) array. Raises FileError when the message is truncated.
    """
    start = 4 + int.from_bytes(message[:4], "little")
    try:
        header = json.loads(message[4:start])
        arrays = {
            about["name"]: np.frombuffer(
                message, np.dtype(about["type"]).newbyteorder("<"), about["size"], start + about["offset"]
            )
            for about in header["arrays"]
        }
    except ValueError as error:
        raise FileError(None, f"the message is truncated ({error})") from None
    return header, arrays


def to_json(value: Any) -> Any:
    """Return plain data that JSON can represent: infinity as ``".inf"``, NaN as None."""
    if isinstance(value, dict):
        return {str(name): to_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ".inf" if value > 0.0 else "-.inf"
    return value


def from_json(value: Any, n_levels: int = 1000) -> Any:
    """Return plain data with infinity for ``".inf"``; raise ValueError for more levels."""
    if n_levels < 0:
        raise ValueError(n_levels)
    if isinstance(value, dict):
        return {name: from_json(item, n_levels - 1) for name, item in value.items()}
    if isinstance(value, list):
        return [from_json(item, n_levels - 1) for item in value]
    return NOT_FINITE.get(value, value) if isinstance(value, str) else value


def one_line(error: BaseException) -> str:
    """Return the message of an exception in one line."""
    if isinstance(error, MemoryError):
        return "not enough memory; use a smaller picture or fewer photosites"
    text = str(error) if isinstance(error, FoveasimError) else f"{type(error).__name__}: {error}".removesuffix(": ")
    text = printable(" ".join(text.split()))
    return text if len(text) <= MAX_MESSAGE_LENGTH else text[: MAX_MESSAGE_LENGTH - 3] + "..."


def is_answer_to_freeze(message: str) -> bool:
    """Return whether a message is the one after the parts of a variant."""
    return message.startswith('{"kind": "done"') and bool(json.loads(message)["is_freeze"])
