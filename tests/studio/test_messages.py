"""Messages: decoding gives what was encoded, and those of a page have a handler, a type and clear errors."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import page_messages

from foveasim.errors import FileError, ParameterError
from foveasim.studio import _session
from foveasim.studio._messages.encoding import TYPES, decode_part, encode_part, from_json, to_json
from foveasim.studio._messages.models import HANDLERS, MESSAGES, CameraFrame, read_message

ARRAYS = st.dictionaries(
    st.text("abcé-", min_size=1, max_size=5),
    st.tuples(st.sampled_from(TYPES), st.lists(st.integers(0, 100), max_size=9)),
    max_size=5,
)


@given(ARRAYS, st.integers(0, 2**40))
def test_decoding_returns_encoded_arrays(arrays, version):
    given_arrays = {name: np.array(values, kind) for name, (kind, values) in arrays.items()}

    header, found = decode_part(encode_part("sites", version, {"n": 3}, given_arrays))

    assert (header["part"], header["version"], header["about"]) == ("sites", version, {"n": 3})
    assert list(found) == list(given_arrays)
    for name, array in given_arrays.items():
        assert found[name].dtype == array.dtype
        assert np.array_equal(found[name], array)


def test_arrays_begin_at_multiples_of_8():
    arrays = {"a": np.zeros(3, np.uint8), "b": np.zeros(1, np.float64), "c": np.zeros(5, np.uint16)}
    message = encode_part("x", 1, {"text": "µm"}, arrays)
    length = int.from_bytes(message[:4], "little")
    header = json.loads(message[4 : 4 + length])

    assert (4 + length) % 8 == 0
    assert [about["offset"] for about in header["arrays"]] == [0, 8, 16]
    assert len(message) == 4 + length + 32


def test_unsupported_types_are_rejected():
    with pytest.raises(ParameterError, match="int64"):
        encode_part("x", 1, {}, {"a": np.zeros(3, np.int64)})


def test_truncated_messages_are_rejected():
    message = encode_part("x", 1, {}, {"a": np.zeros(30)})

    for n in (3, 20, len(message) - 1):
        with pytest.raises(FileError, match="truncated"):
            decode_part(message[:n])


def test_infinity_survives_json():
    value = {"a": [1.5, math.inf, -math.inf], "b": {"c": np.float32(0.5)}}

    text = json.dumps(to_json(value), allow_nan=False)

    assert from_json(json.loads(text)) == {"a": [1.5, math.inf, -math.inf], "b": {"c": 0.5}}
    assert to_json(math.nan) is None


# -- messages of a page ------------------------------------------------------------------------------------------------------


def test_every_message_has_a_handler():
    assert _session.Session
    assert set(HANDLERS) == {*MESSAGES.values(), CameraFrame}


def test_types_of_messages_are_current():
    text = page_messages.FILE.read_text("utf-8")

    assert page_messages.with_types(text) == text, "run python tests/reference/page_messages.py"


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ([], "'message' must be a JSON object"),
        ({"do": "explode"}, "'do' must be the name of a message, got 'explode'"),
        ({"do": "set", "key": "a..b"}, "'key' must be the path of a setting, such as sensor.bits, got 'a..b'"),
        ({"do": "set", "key": "seed", "final": 1}, "'final' must be true or false, got 1"),
        ({"do": "file", "path": "x", "as": "program"}, "'as' must be scene, layout or settings, got 'program'"),
        ({"do": "views", "names": ["sites"], "pixels": True}, "'pixels' must be an integer from 1 to 2,048, got True"),
        ({"do": "assign", "values": [{"value": 3}]}, "'values' must be a list of 1 to 100 mappings with the path of a setting as key, and a value"),
        ({"do": "compare", "variants": ["a"] * 6}, "'variants' must be a list of at most 5 variants"),
        ({"do": "pin"}, "'sites' must be a list of at most 6 indices of photosites"),
    ],
)  # fmt: skip
def test_invalid_fields_have_a_rule(data, text):
    with pytest.raises(ParameterError) as raised:
        read_message(data).check()

    assert str(raised.value) == text


def test_unknown_fields_are_ignored():
    message = read_message({"do": "drawn", "version": 3, "cls": 1, "_problem": 2, "do_not": {}})

    assert message.is_valid
    assert read_message({"do": "drawn", "cls": 1, "_fields_set": 2}).is_valid is False
