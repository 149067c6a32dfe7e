"""Letters of the colours of a mosaic, which the filters of a sensor must name in the same order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from string import ascii_uppercase

#: Key of a layout's provenance: letters of the colours of channels 0, 1, ...
CHANNEL_LETTERS = "channel_letters"
#: Letters of colours, and the first letters of the names of their filters: clear and panchromatic ones are white.
COLOURS = {"R": "r", "G": "g", "B": "b", "W": "wcp", "C": "cwp", "Y": "y", "M": "m", "E": "e", "N": "ni", "I": "in"}


def find_wrong_letter(letters: str, channels: Iterable[int], names: Sequence[str]) -> int | None:
    """
    Return the first channel in use whose filter has not the name of its letter, None if all have.

    Filters that are only numbered have no names. The letters A, B, C, ... number as many filters, whatever their names.
    """
    if all(name.isdigit() for name in names) or letters == ascii_uppercase[: len(names)]:
        return None
    for k in channels:
        if k < len(letters) and not names[k].lower().startswith(tuple(COLOURS.get(letters[k], letters[k].lower()))):
            return k
    return None
