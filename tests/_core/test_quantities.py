"""Numbers with units as text."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from foveasim._core.quantities import PREFIXES, format_quantity

POWERS = {prefix: power for power, prefix in PREFIXES.items()}


@given(st.floats(1e-17, 1e14), st.sampled_from(["F", "V", "s", "bit/s"]))
def test_prefixed_value_reads_as_number(value, unit):
    number, prefixed = format_quantity(value, unit).split(" ")
    prefix = prefixed.removesuffix(unit)
    shown = float(number.replace(",", ""))

    assert shown * 10.0 ** POWERS[prefix] == pytest.approx(value, rel=6e-4)
    assert 1.0 <= shown < 1000.0 or value < 1e-18


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (0.0, "s", "0 s"),
        (0.99999, "s", "1 s"),
        (1e-3, "V", "1 mV"),
        (float("nan"), "F", "nan F"),
        ([0.0, 1e-3], "s", "0 to 1 ms"),
        ([2.9e-15, 6.3e-14], "F", "2.9 to 63 fF"),
        ([2.2, 2.2000001], "µm", "2.2 µm"),
        (1_870_000.0, "e-", "1,870,000 e-"),
        (4e4, "µm²", "40,000 µm²"),
        (2.5e6, "µm²", "2.5 mm²"),
        (5e-4, "", "0.0005"),
    ],
)
def test_known_values_are_formatted(value, unit, expected):
    assert format_quantity(value, unit) == expected


def test_large_numbers_have_no_exponents():
    assert all(re.fullmatch(r"[0-9,]+ e-", format_quantity(10.0**power, "e-")) for power in range(12))
