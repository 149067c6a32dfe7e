"""Binary messages: decoding gives what was encoded, at aligned offsets."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foveasim.errors import FileError, ParameterError
from foveasim.studio._messages import TYPES, decode_part, encode_part, from_json, to_json

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
