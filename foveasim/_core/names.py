"""Messages about unknown names: the closest name, and the possible names."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from difflib import SequenceMatcher
from itertools import islice
from pathlib import Path
from string import ascii_uppercase

from foveasim.errors import printable

#: Key of a layout's provenance: letters of the colours of channels 0, 1, ...
CHANNEL_LETTERS = "channel_letters"
#: Letters of colours, and the first letters of the names of their filters: clear and panchromatic ones are white.
COLOURS = {"R": "r", "G": "g", "B": "b", "W": "wcp", "C": "cwp", "Y": "y", "M": "m", "E": "e", "N": "ni", "I": "in"}

#: Names of devices on Windows, which no file or directory can have, with or without an extension.
DEVICES = re.compile("con|prn|aux|nul|(com|lpt)[0-9¹²³]", re.IGNORECASE)
#: Longest complete list of names in a message; of longer lists, it contains the closest names and the total number.
MAX_LISTED = 16
#: Similarity of names, 0 to 1, from which one is suggested for the other, as in :func:`difflib.get_close_matches`.
MIN_SIMILARITY = 0.6
#: Similarity from which a name precedes the equivalent of another program's term.
HIGH_SIMILARITY = 0.8
#: Longest name that is compared, and largest number of files of a directory.
MAX_COMPARED, MAX_FILES = 80, 10_000
#: Terms of ISETCam, Pyxel, KLayout and data sheets, and the beginnings of the names of these quantities here.
OTHER_TERMS: dict[str, tuple[str, ...]] = {
    "aperture": ("f_number",),
    "bit_depth": ("bits",),
    "conversion_gain": ("capacitance",),
    "dark_current": ("dark_e_per_s",),
    "exposure_time": ("exposure",),
    "fnumber": ("f_number",),
    "gap": ("trench", "min_space"),
    "integration_time": ("exposure",),
    "min_pixel": ("min_size",),
    "pixel_pitch": ("pitch",),
    "pixel_size": ("pitch", "min_size"),
    "quantum_efficiency": ("qe",),
    "shutter": ("exposure",),
    "spacing": ("pitch", "min_space"),
    "trench": ("min_space",),
    "voltage_swing": ("v_sat",),
    "well_capacity": ("full_well",),
}


def closest_name(name: object, names: Iterable[str]) -> str | None:
    """
    Return the name that is most similar to an unknown one, or None.

    Case, hyphens and spaces are ignored, and equal units at the end. Terms of other programs are looked up in ``OTHER_TERMS``.
    """
    known = list(names)
    similar = _most_similar(name, known)
    if similar is not None and _similarity(name, similar) >= HIGH_SIMILARITY:
        return similar
    words = _normalise(name)
    beginnings = [each for term, found in OTHER_TERMS.items() if words.startswith(term) for each in found]
    return next((each for begin in beginnings for each in known if _normalise(each).startswith(begin)), similar)


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return the question ``did you mean 'gap_um'?``, or an empty string."""
    closest = closest_name(name, names)
    return "" if closest is None else f"did you mean {_quote(closest)}?"


def list_names(names: Collection[str], name: object = "") -> str:
    """
    Return a list of names for a message.

    ``names``: more than ``MAX_LISTED`` names are reduced to the closest ones, in the given order. ``name``: the unknown name.

    Examples
    --------
    >>> list_names(["grid", "giotto"])
    "'grid', 'giotto'"
    >>> list_names([f"name_{k}" for k in range(40)], "name_7").endswith(
    ...     "(16 closest of 40)"
    ... )
    True
    """
    if len(names) <= MAX_LISTED:
        return ", ".join(map(_quote, names)) or "none"
    closest = set(sorted(names, key=lambda each: -_similarity(name, each))[:MAX_LISTED])
    return f"{', '.join(_quote(each) for each in names if each in closest)} ({MAX_LISTED} closest of {len(names)})"


def possible_names(name: object, names: Collection[str]) -> str:
    """
    Return the hint of a message about an unknown name.

    Examples
    --------
    >>> possible_names("gapum", ["gap_um", "pitch_um"])
    "did you mean 'gap_um'? possible: 'gap_um', 'pitch_um'"
    >>> possible_names("zzz", ["gap_um"])
    "possible: 'gap_um'"
    """
    return f"{did_you_mean(name, names)} possible: {list_names(names, name)}".strip()


def missing_path(path: Path, kind: str = "file") -> str:
    """
    Return the problem of a path that is not an existing file or directory.

    ``kind``: expected kind of the path: ``"file"``, ``"directory"``, ``"file or directory"``. Returns ``problem``: such as
    ``no such file; did you mean 'photo.jpg'?``, with the closest name in the same directory.
    """
    try:
        if path.exists():
            return f"is not a {kind}"
        directory = next(each for each in path.parents if each.exists())
        # The first part of the path that does not exist.
        wanted = path.relative_to(directory).parts[0]
        is_last = directory == path.parent
        visible = (each for each in islice(directory.iterdir(), MAX_FILES) if not each.name.startswith("."))
        found = sorted(each.name for each in visible if (is_last and kind != "directory") or each.is_dir())
        # Files with the same extension are compared without it.
        stems = {Path(name).stem: name for name in found if Path(name).suffix == Path(wanted).suffix}
        closest = stems.get(_most_similar(Path(wanted).stem, stems) or "") or _most_similar(
            wanted, [name for name in found if Path(name).suffix != Path(wanted).suffix]
        )
        hint = "" if closest is None else f"did you mean {_quote(closest)}?"
    except (OSError, ValueError, StopIteration):  # no permission, or not a valid path
        return f"no such {kind}"
    if not is_last:
        hint = f"there is no directory {_quote(wanted)}{'; ' * bool(hint)}{hint}"
    return f"no such {kind}; {hint}" if hint else f"no such {kind}"


def _quote(name: object) -> str:
    return f"'{printable(name)}'"


def _normalise(name: object) -> str:
    return re.sub(r"[\s-]+", "_", str(name)[:MAX_COMPARED].casefold())


def _most_similar(name: object, names: Iterable[str]) -> str | None:
    """Return the most similar name, of equals the last; None if none is similar enough."""
    similarity = {each: _similarity(name, each) for each in names}
    best = max(similarity, key=lambda each: (similarity[each], each), default=None)
    return best if best is not None and similarity[best] >= MIN_SIMILARITY else None


def _similarity(name: object, other: str) -> float:
    """Return the similarity of two names, from 0 to 1."""
    first, second = _normalise(name), _normalise(other)
    (begin, _, unit), (other_begin, _, other_unit) = first.rpartition("_"), second.rpartition("_")
    if unit == other_unit and begin and other_begin and first != second:
        first, second = begin, other_begin
    return SequenceMatcher(None, second, first, autojunk=False).ratio()


def find_wrong_letter(letters: str, channels: Iterable[int], names: Sequence[str]) -> int | None:
    """
    Return the first channel in use whose filter has another name than its letter, or None.

    Filters that are only numbered have no names. The letters A, B, C, ... number as many filters, whatever their names.
    """
    if all(name.isdigit() for name in names) or letters == ascii_uppercase[: len(names)]:
        return None
    for k in channels:
        if k < len(letters) and not names[k].lower().startswith(tuple(COLOURS.get(letters[k], letters[k].lower()))):
            return k
    return None
