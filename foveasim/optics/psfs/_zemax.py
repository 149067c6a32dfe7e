"""
PSFs in text exports of Zemax OpticStudio, of its FFT and Huygens methods.

A file contains the PSF of one field point and one wavelength. An index in YAML lists the files of a lens::

    image: inverted      # positions in the projected image, as in OpticStudio (the default)
    psfs:
      - {file: axis_550.txt, x_um: 0.0, y_um: 0.0, wavelength_nm: 550.0}
      - {file: edge_550.txt, x_um: 0.0, y_um: 1800.0, wavelength_nm: 550.0, relative_illumination: 0.82}

The first row of a listing is that of the largest y, and the centre is that of its header: ``row 129, column 128``, or in older
versions ``21, 11``, which is row and column, too, unless only the other order lies in the grid. Numbers may have decimal
commas. Every line of a header is read, known to be irrelevant, or an error if it is about the centre, the spacing or the
orientation.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from foveasim._core.validation import Floats
from foveasim._io.formats import FileFormat, FormatError, as_file_error, listed_file
from foveasim._io.rasters.units import length_in_um
from foveasim._io.text_files import read_text
from foveasim._io.yaml_files import MAX_FILE_BYTES as MAX_INDEX_BYTES
from foveasim._io.yaml_files import parse_yaml
from foveasim.errors import FileError, ParameterError
from foveasim.optics.psfs._formats import PSF_FORMATS, choices_of, require
from foveasim.optics.psfs._grid import CENTRES, MAX_POINTS, MAX_SIDE, MAX_VALUES, PSFGrid

TITLE = re.compile(r"\s*Listing of (FFT|Huygens) PSF Data")
#: Largest size of a listing: 2048 x 2048 values of 16 characters in UTF-16.
MAX_BYTES = 2**27
NUMBER = r"([-+]?[\d.,]{1,32}(?:[eE][-+]?\d{1,4})?)"
WAVES = re.compile(rf"{NUMBER}(?:\s+to\s+{NUMBER})?\s*([^\W\d_]{{1,4}}|µm|μm)\s+at\s", re.IGNORECASE)
SPACING = re.compile(rf"Data spacing is\s+{NUMBER}\s*(\S+?)\.?$")
SIZE = re.compile(r"Image grid size:\s*(\d{1,9})\s*by\s*(\d{1,9})$")
CENTRE = re.compile(r"Cent(?:er|re) point is:\s*(?:row\s*(\d{1,9}),\s*column\s*(\d{1,9})|(\d{1,9}),\s*(\d{1,9}))\.?$")
#: Lines that do not change the PSF: names, where it is in the image, sampling of the pupil, and what follows from others.
IRRELEVANT = re.compile(
    r"(File|Title|Date|Configuration|Surface|Field|Wavelengths?|Lens units|Pupil grid size|Strehl ratio|"
    r"Cent(er|re) coordinates|Reference Coordinates?)\b.{0,3}:|"
    r"Data area is\s|Configuration \d|((Poly|Mono)chromatic )?(FFT|Huygens) PSF$",
    re.IGNORECASE,
)
#: Words of lines that change the PSF.
RELEVANT = re.compile(
    r"cent(er|re)|centroid|spacing|delta|grid|pixel|orient|rotat|mirror|flip|transpos|\brow|\bcolumn|\baxis|\baxes|logarithm|"
    r"\blog\b|\bdB\b|phase|imaginary|\breal\b|amplitude",
    re.IGNORECASE,
)
#: Values that are not proportional to the irradiance.
OTHER_VALUES = re.compile(r"logarithm|\blog\b|\bdB\b|phase|imaginary|\breal\b|amplitude|radians|degrees", re.IGNORECASE)
#: Characters and lines of a header that are searched.
MAX_LINE, MAX_HEADER_LINES = 200, 100
#: Relative tolerance of wavelengths and distances of samples, which listings round.
SAME = 1e-3
KEYS = ("file", "x_um", "y_um", "wavelength_nm")
INDEX_KEYS = ("psfs", "image", "first_row", "samples", "centre")


class Listing(NamedTuple):
    """
    PSF of one point and a range of wavelengths.

    ``values`` (n_y, n_x); ``centre`` (row, column) or None.
    """

    values: Floats
    range_nm: tuple[float, float]
    pitch_um: float
    centre: tuple[float, float] | None


def read_listing(path: Path) -> Listing:
    """Read a text export; FormatErrors say what is missing."""
    lines = _text(path).splitlines()
    if not lines or not TITLE.match(lines[0]):
        raise FormatError("is not a listing of an FFT or Huygens PSF of Zemax OpticStudio")
    header = next((k for k, line in enumerate(lines) if line.lstrip().startswith("Values are")), None)
    if header is None:
        raise FormatError("has no line 'Values are ...', after which the values begin")
    if OTHER_VALUES.search(lines[header]):
        raise FormatError(f"has values that are no irradiance, {lines[header].strip()!r:.60}; export a linear PSF")
    found = _header([line[:MAX_LINE].strip() for line in lines[1 : min(header, MAX_HEADER_LINES)]])
    for what in ("wavelength", "'Data spacing is'", "'Image grid size'"):
        if what not in found:
            raise FormatError(f"has no {what} in its header")
    waves, spacing, size = found["wavelength"], found["'Data spacing is'"], found["'Image grid size'"]
    low, high = _number(waves[1]), _number(waves[2] or waves[1])
    n_x, n_y = int(size[1]), int(size[2])
    if max(n_x, n_y) > MAX_SIDE:
        raise FormatError(f"has {n_x} by {n_y} values, more than the limit of {MAX_SIDE} along a side")
    words = " ".join(lines[header + 1 :]).split()
    if len(words) != n_x * n_y:
        raise FormatError(f"has {len(words)} values, expected {n_x} by {n_y} = {n_x * n_y}")
    try:
        values = np.array([word.replace(",", ".") for word in words], np.float64).reshape(n_y, n_x)
    except ValueError as error:
        raise FormatError(f"has a value that is not a number ({error})") from None
    per_nm = 1e3 * _unit_um(waves[3])
    return Listing(
        values,
        (low * per_nm, high * per_nm),
        _number(spacing[1]) * _unit_um(spacing[2]),
        _centre(found["centre"], n_x, n_y) if "centre" in found else None,
    )


def _header(lines: list[str]) -> dict[str, re.Match[str]]:
    """Return the known lines by name; raise a FormatError with a line that is not."""
    patterns = {"'Data spacing is'": SPACING, "'Image grid size'": SIZE, "centre": CENTRE, "wavelength": WAVES}
    found: dict[str, re.Match[str]] = {}
    for line in lines:
        if IRRELEVANT.match(line):
            continue
        for name, pattern in patterns.items():
            match = pattern.match(line)
            if match is not None:
                if name in found and found[name][0] != match[0]:
                    raise FormatError(f"has two lines about the same, {found[name][0]!r:.60} and {line!r:.60}")
                found[name] = match
                break
        else:
            if RELEVANT.search(line):
                raise FormatError(
                    f"has the unknown line {line!r:.80} in its header, which may change the PSF; remove it"
                )
    return found


def _centre(match: re.Match[str], n_x: int, n_y: int) -> tuple[float, float]:
    """Return the indices (row, column) of the centre."""
    row, column = (int(match[k] or match[k + 2]) - 1 for k in (1, 2))
    if match[1] is None and not (row < n_y and column < n_x):
        row, column = column, row
    if not (0 <= row < n_y and 0 <= column < n_x):
        raise FormatError(f"has the centre {match[0]!r:.60} outside its {n_x} by {n_y} values")
    return float(row), float(column)


def _number(text: str) -> float:
    """Return a number with a decimal point or comma."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        raise FormatError(f"has the number {text!r:.40} in its header, expected one decimal point or comma") from None


def _text(path: Path) -> str:
    """Return the text of a listing, in UTF-16, UTF-8 or Windows-1252."""
    if path.stat().st_size > MAX_BYTES:
        raise FormatError(f"must have at most {MAX_BYTES} bytes")
    content = path.read_bytes()
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252")


def _unit_um(name: str) -> float:
    unit = name.rstrip(".,:;")
    size_um = length_in_um(unit)
    if size_um is None:
        raise FormatError(f"has the unit of length {unit!r:.20}, expected one such as µm, nm or mm")
    return size_um


def read_one(path: Path, *, wavelength_nm: Any = None, centre: Any = None) -> PSFGrid:
    """Read one listing, whose PSF is that of the whole field."""
    one = read_listing(path)
    if wavelength_nm is not None and np.size(wavelength_nm) != 1:
        raise ParameterError("wavelength_nm", f"must be one number for a listing, got {np.size(wavelength_nm)}")
    return PSFGrid.from_arrays(
        one.values,
        x_um=0.0,
        y_um=0.0,
        wavelength_nm=_wavelength_nm(one, wavelength_nm, "pass wavelength_nm=..., the one for which it stands"),
        pitch_um=one.pitch_um,
        image="inverted",
        first_row="highest",
        centre=_listed_centre(one, centre),
    )


def _wavelength_nm(one: Listing, given: Any, cure: str, source: str = "wavelength_nm=") -> float:
    """Return the wavelength of a listing; one of a range must be given."""
    low, high = one.range_nm
    is_one = abs(high - low) <= SAME * low
    if given is None:
        if is_one:
            return low
        raise FormatError(
            f"is the PSF of {1e-3 * low:g} to {1e-3 * high:g} µm; export one wavelength per file, or {cure}"
        )
    given_nm = float(np.ravel(given)[0])
    if not low * (1.0 - SAME) <= given_nm <= high * (1.0 + SAME):
        of = f"at {low:g} nm" if is_one else f"of {low:g} to {high:g} nm"
        raise FormatError(f"is the PSF {of}, but {source} {given_nm:g} nm")
    return given_nm


def _listed_centre(one: Listing, given: Any) -> Any:
    """Return the given centre, or that of the header."""
    if given is None and one.centre is None:
        raise FormatError("has no line 'Center point is' in its header; pass centre=..., (row, column) from 0")
    return one.centre if given is None else given


def read_index(path: Path, *, allow_outside: bool = False) -> PSFGrid:
    """
    Read an index and its listings, which are in its directory unless ``allow_outside``.

    The pitch may differ between wavelengths, as that of FFT PSFs.
    """
    about = parse_yaml(path, read_text(path, "an index of PSFs", MAX_INDEX_BYTES))
    entries = _entries(about)
    points = list(dict.fromkeys((entry["x_um"], entry["y_um"]) for entry in entries))
    waves_nm = sorted({entry["wavelength_nm"] for entry in entries})
    known: dict[tuple[int, int], str] = {}
    for entry in entries:
        at = points.index((entry["x_um"], entry["y_um"])), waves_nm.index(entry["wavelength_nm"])
        if at in known:
            raise FormatError(
                f"lists {known[at]!r:.80} and {entry['file']!r:.80} for the same point and wavelength; remove one of them"
            )
        known[at] = entry["file"]
    for p, (x_um, y_um) in enumerate(points):
        for w, wave_nm in enumerate(waves_nm):
            if (p, w) not in known:
                raise FormatError(
                    f"lists no PSF at ({x_um:g}, {y_um:g}) µm and {wave_nm:g} nm, a wavelength of other points; add it"
                )
    given = [entry for entry in entries if "relative_illumination" in entry]
    if given and len(given) < len(entries):
        missing = next(entry["file"] for entry in entries if "relative_illumination" not in entry)
        raise FormatError(f"has 'relative_illumination' for some files only; add it to {missing!r:.80}")
    fraction = np.ones((len(points), len(waves_nm)))
    listed = [listed_file(path, entry["file"], allow_outside=allow_outside) for entry in entries]
    centre = _index_centre(about.get("centre"))
    first = _listed(path, entries[0], listed[0], None, centre)
    n_values = len(entries) * first.values.size
    if n_values > MAX_VALUES:
        raise FormatError(f"lists {n_values} values, more than the limit of {MAX_VALUES}")
    stack = np.empty((len(points), len(waves_nm), *first.values.shape))
    references: dict[int, tuple[str, Listing]] = {}
    for number, entry in enumerate(entries):
        at = points.index((entry["x_um"], entry["y_um"])), waves_nm.index(entry["wavelength_nm"])
        reference = references.get(at[1], (entries[0]["file"], first._replace(pitch_um=math.nan)))
        one = _listed(path, entry, listed[number], reference, centre) if number else first
        references.setdefault(at[1], (entry["file"], one))
        stack[at], fraction[at] = one.values, entry.get("relative_illumination", 1.0)
    x_um, y_um = np.array(points).T
    conventions = {"image": "inverted", "first_row": "highest", **choices_of(about)}
    return PSFGrid.from_arrays(
        stack,
        x_um=x_um,
        y_um=y_um,
        wavelength_nm=waves_nm,
        pitch_um=[references[w][1].pitch_um for w in range(len(waves_nm))],
        centre=first.centre if centre is None else centre,
        relative_illumination=fraction if given else None,
        **conventions,
    )


def _index_centre(given: Any) -> Any:
    """Return the centre in an index: (row, column), "fft", "middle", or None."""
    is_pair = isinstance(given, list) and len(given) == 2 and all(type(at) in (int, float) for at in given)
    if not (given is None or is_pair or given in tuple(CENTRES)):
        raise FormatError(f"must have two numbers (row, column), 'fft' or 'middle' as 'centre', got {given!r:.40}")
    return given


def _listed(
    index: Path, entry: dict[str, Any], file: Path, reference: tuple[str, Listing] | None, centre: Any
) -> Listing:
    """Read the listing of an entry, which must be as the first one of its wavelength."""
    with as_file_error(file, "listing of a PSF", passes=(FileError,)):
        one = read_listing(file)
        _wavelength_nm(one, entry["wavelength_nm"], "", f"{index.name} lists it for")
        _listed_centre(one, centre)
        if reference is None:
            return one
        name, first = reference
        if one.values.shape != first.values.shape or one.centre != first.centre:
            raise FormatError(
                f"has {one.values.shape} values with the centre {one.centre}, expected {first.values.shape} with "
                f"{first.centre} as in {name!r:.80}"
            )
        if abs(one.pitch_um - first.pitch_um) > SAME * first.pitch_um:
            raise FormatError(
                f"has samples of {one.pitch_um:g} µm, expected {first.pitch_um:g} µm as in {name!r:.80} of the same "
                "wavelength; set the same 'image delta', or resample it"
            )
        return one


def _entries(about: Any) -> list[dict[str, Any]]:
    """Return the checked entries of an index."""
    if not isinstance(about, Mapping) or not isinstance(about.get("psfs"), list) or not about["psfs"]:
        raise FormatError("must have a list 'psfs' of entries with the keys " + ", ".join(KEYS))
    unknown = sorted(set(about) - set(INDEX_KEYS))
    if unknown:
        raise FormatError(f"has the unknown key {unknown[0]!r:.40}; expected {', '.join(INDEX_KEYS)}")
    if len(about["psfs"]) > MAX_POINTS:
        raise FormatError(f"lists {len(about['psfs'])} files, more than {MAX_POINTS}")
    found = []
    for number, entry in enumerate(about["psfs"]):
        if not isinstance(entry, Mapping):
            raise FormatError(f"must have the keys {', '.join(KEYS)} in psfs[{number}]")
        require(entry, KEYS)
        unknown = sorted(set(entry) - {*KEYS, "relative_illumination"})
        if unknown:
            raise FormatError(f"has the unknown key {unknown[0]!r:.40} in psfs[{number}]")
        numbers = {name: value for name, value in entry.items() if name != "file"}
        for name, value in numbers.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise FormatError(f"must have a finite number as '{name}' in psfs[{number}], got {value!r:.40}")
        if not isinstance(entry["file"], str):
            raise FormatError(f"must have the name of a file as 'file' in psfs[{number}], got {entry['file']!r:.40}")
        found.append({"file": entry["file"], **{name: float(value) for name, value in numbers.items()}})
    return found


def _is_listing(path: Path, head: bytes) -> bool:
    text = head.replace(b"\x00", b"").lstrip(b"\xff\xfe\xef\xbb\xbf")
    return path.is_file() and TITLE.match(text.decode("latin-1")) is not None


def _is_index(path: Path, head: bytes) -> bool:  # noqa: ARG001 -- the signature is that of formats
    return path.suffix.lower() in (".yaml", ".yml")


def write_example(path: Path, values: Floats, wavelength_nm: float) -> None:
    """Write a listing as OpticStudio does, with samples of 0.5 µm, largest y first."""
    n_y, n_x = values.shape
    rows = "\n".join("\t".join(f"{value:.8E}" for value in row) for row in values)
    header = (
        f"Listing of FFT PSF Data\n\nPolychromatic FFT PSF\n{1e-3 * wavelength_nm:.4f} to {1e-3 * wavelength_nm:.4f} µm at "
        f"0.0000, 0.0000 (deg).\nData spacing is 0.500 µm.\nData area is {0.5 * n_x:.3f} µm wide.\nSurface: Image\n"
        f"Pupil grid size: {n_x // 2} by {n_y // 2}\nImage grid size: {n_x} by {n_y}\n"
        f"Center point is: row {n_y // 2 + 1}, column {n_x // 2}\nValues are not normalized.\n\n"
    )
    path.write_text(header + rows + "\n", encoding="utf-16")


def _example(path: Path) -> PSFGrid:
    values = np.pad(np.arange(1.0, 17.0).reshape(4, 4), 2)
    write_example(path, values, 550.0)
    # Turned by 180° into the upright picture, with the lowest row first: columns are reversed.
    return PSFGrid.from_arrays(values[:, ::-1], x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=0.5, centre=(4, 4))


def _example_index(path: Path) -> PSFGrid:
    entries, found = [], []
    for k in range(2):
        values = np.zeros((8, 8))
        values[2 + k : 5, 2:6] = np.arange(1.0, 5.0)
        write_example(path.with_name(f"point_{k}.txt"), values, 550.0)
        entries.append(f"  - {{file: point_{k}.txt, x_um: 0.0, y_um: {500.0 * k}, wavelength_nm: 550.0}}\n")
        found.append(values[:, ::-1])
    path.write_text("psfs:\n" + "".join(entries), encoding="utf-8")
    y_um = [0.0, -500.0]
    return PSFGrid.from_arrays(found, x_um=[0.0, 0.0], y_um=y_um, wavelength_nm=550.0, pitch_um=0.5, centre=(4, 4))


PSF_FORMATS.register(
    "zemax",
    FileFormat(
        title="Zemax listing",
        suffixes=(".txt",),
        matches=_is_listing,
        read=read_one,
        read_options=("wavelength_nm", "centre"),
    ),
    example=_example,
)
PSF_FORMATS.register(
    "zemax_index",
    FileFormat(
        title="index of Zemax listings",
        suffixes=(".yaml", ".yml"),
        matches=_is_index,
        read=read_index,
        read_options=("allow_outside",),
    ),
    example=_example_index,
)
