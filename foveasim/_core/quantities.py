"""Numbers with units as text: metric prefixes, thousands, and mm² for large areas."""

from __future__ import annotations

import math
from collections.abc import Sequence

#: Metric prefixes by their power of ten.
PREFIXES = {-18: "a", -15: "f", -12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
#: Units with prefixes, and other units for large values: the value from which they are used, and their size.
PREFIXED = frozenset({"F", "V", "s", "bit/s"})
LARGE = {"µm²": (1e5, 1e6, "mm²"), "µm": (1e4, 1e3, "mm")}


def format_quantity(values: float | Sequence[float], unit: str, *, digits: int = 4) -> str:
    """
    Return a value, or the range of two unless they appear equal, with its unit.

    Examples
    --------
    >>> (
    ...     format_quantity(9e-15, "F"),
    ...     format_quantity(1 / 30, "s", digits=3),
    ...     format_quantity([4e-16, 2e-13], "F"),
    ... )
    ('9 fF', '33.3 ms', '0.4 to 200 fF')
    >>> (
    ...     format_quantity(10700.4, "e-"),
    ...     format_quantity(2.5e6, "µm²"),
    ...     format_quantity(0.85, ""),
    ... )
    ('10,700 e-', '2.5 mm²', '0.85')
    """
    numbers = [float(value) for value in (values if isinstance(values, Sequence) else [values])]
    sizes = sorted(float(f"{abs(number):.{digits - 1}e}") for number in numbers if number and math.isfinite(number))
    size = 1.0
    if unit in LARGE and sizes and sizes[-1] >= LARGE[unit][0]:
        _, size, unit = LARGE[unit]
    elif unit in PREFIXED and sizes:  # the prefix of the geometric mean of a range
        power = 3 * math.floor(0.5 * (math.log10(sizes[0]) + math.log10(sizes[-1])) / 3.0 + 1e-9)
        power = min(max(power, min(PREFIXES)), max(PREFIXES))
        size, unit = 10.0**power, PREFIXES[power] + unit
    text = " to ".join(dict.fromkeys(_format(number / size, digits) for number in numbers))
    return f"{text} {unit}" if unit else text


def _format(value: float, digits: int) -> str:
    """Return a number with thousands, without an exponent where that is shorter."""
    if 10.0**digits <= abs(value) < 10.0 ** (digits + 9):
        return f"{float(f'{value:.{digits}g}'):,.0f}"
    return f"{value:,.{digits}g}"
