"""Units in files: products of powers of W, J, m, s, photons and sr."""

from __future__ import annotations

import re
from typing import TypeAlias

import numpy as np

#: Powers of watt, metre, second, photon and steradian.
Powers: TypeAlias = tuple[int, int, int, int, int]
_WATT, _METRE, _SECOND, _PHOTON, _STERADIAN = (
    (1, 0, 0, 0, 0),
    (0, 1, 0, 0, 0),
    (0, 0, 1, 0, 0),
    (0, 0, 0, 1, 0),
    (0, 0, 0, 0, 1),
)
_BASE: dict[str, tuple[float, Powers]] = {
    **{name: (size, _WATT) for name, size in (("W", 1.0), ("mW", 1e-3), ("uW", 1e-6), ("nW", 1e-9), ("kW", 1e3))},
    **dict.fromkeys(("watt", "watts", "Watt", "Watts"), (1.0, _WATT)),
    "J": (1.0, (1, 0, 1, 0, 0)),
    "erg": (1e-7, (1, 0, 1, 0, 0)),
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), (1.0, _METRE)),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), (1e-2, _METRE)),
    **dict.fromkeys(("in", "inch", "inches"), (2.54e-2, _METRE)),
    **dict.fromkeys(("mil", "mils"), (2.54e-5, _METRE)),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), (1e-3, _METRE)),
    **dict.fromkeys(
        ("um", "micron", "microns", "micrometre", "micrometres", "micrometer", "micrometers"), (1e-6, _METRE)
    ),
    **dict.fromkeys(("nm", "nanometre", "nanometres", "nanometer", "nanometers"), (1e-9, _METRE)),
    **dict.fromkeys(("Angstrom", "angstrom", "Angstroms", "AA"), (1e-10, _METRE)),
    **dict.fromkeys(("s", "sec", "second", "seconds"), (1.0, _SECOND)),
    **dict.fromkeys(("photon", "photons", "ph", "quanta"), (1.0, _PHOTON)),
    **dict.fromkeys(("sr", "steradian", "steradians"), (1.0, _STERADIAN)),
}
_TOKEN = re.compile(r"(?P<name>[A-Za-z]+)(?P<power>[-+]?[0-9]{1,2}(?![0-9]))?|(?P<sign>[/()1])")
#: Maximum length of a unit string.
_MAX_CHARS = 64


def length_in_um(text: str) -> float | None:
    """
    Parse a unit of length; return its size in µm, or None.

    Examples
    --------
    >>> length_in_um("mm"), length_in_um("µm"), length_in_um("deg")
    (1000.0, 1.0, None)
    """
    quantity = parse_unit(text)
    return None if quantity is None or quantity[1] != _METRE else round_factor(quantity[0] * 1e6)


def round_factor(factor: float) -> float:
    """Round to 12 digits: 1e-6 / 1e-4 differs from 0.01 in the last bit."""
    return float(f"{factor:.12g}")


def parse_unit(text: str) -> tuple[float, Powers] | None:
    """
    Parse a product of units with powers; return its size and powers of the base units.

    A slash applies to the next unit or bracket only.
    """
    plain = text.strip()
    for other, ours in (("²", "2"), ("µ", "u"), ("μ", "u"), ("⁻", "-"), ("¹", "1"), ("**", ""), ("^", "")):
        plain = plain.replace(other, ours)
    plain = re.sub(r"[·.*\s_]+", " ", plain)
    size, powers = 1.0, np.zeros(5, int)
    sign, brackets, at = 1, [1], 0
    if not plain or len(plain) > _MAX_CHARS:
        return None
    while at < len(plain):
        if plain[at] == " ":
            at += 1
            continue
        token = _TOKEN.match(plain, at)
        if token is None:
            return None
        at = token.end()
        match token["sign"]:
            case "/":
                sign = -1
            case "(":
                brackets.append(brackets[-1] * sign)
                sign = 1
            case ")" if len(brackets) > 1:
                brackets.pop()
            case ")":
                return None
            case "1":  # as in 1/s
                sign = 1
            case _:
                if token["name"] not in _BASE:
                    return None
                one, its_powers = _BASE[token["name"]]
                n = sign * brackets[-1] * int(token["power"] or 1)
                size, powers, sign = size * one**n, powers + n * np.array(its_powers), 1
    return (size, tuple(powers.tolist())) if len(brackets) == 1 else None
