"""
Spectral curves from text files with one column of wavelengths and columns of values.

Columns are separated by semicolons, tabs, commas or spaces; numbers have decimal points, or decimal commas where columns are
not separated by commas, as spreadsheets write them in many languages. Lines that begin with ``#`` and empty lines are ignored.
A first line that does not begin with a number is a header with column names. Units are never inferred from the values:
wavelengths are in nm and values from 0 to 1, unless the caller or the header specifies another unit (``wavelength_um``,
``QE [%]``).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from foveasim._core.names import possible_names
from foveasim._core.validation import MAX_WAVELENGTH_NM, MIN_WAVELENGTH_NM, Floats
from foveasim._io.text_files import read_rows
from foveasim.errors import FileError
from foveasim.sensor.spectral.curves import CURVES
from foveasim.sensor.spectral.response import FilterSet
from foveasim.sensor.spectral.tables import Beyond, SplineCurve, TableCurve

__all__ = ["read_curve", "read_filters"]

WavelengthUnit = Literal["nm", "um"]
ValueUnit = Literal["fraction", "percent"]
Between = Literal["lines", "spline"]

#: Size limits of tables that are written by hand or by an instrument; larger files are not tables of curves.
MAX_FILE_BYTES = 4 << 20
MAX_ROWS, MAX_COLUMNS = 100_000, 1000
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
#: Non-finite numbers, which do not count as column names.
NON_FINITE = re.compile(r"[-+]?(nan|inf|infinity)", re.IGNORECASE)
#: Wavelength units in the header, in nm.
UNITS_NM = {
    **dict.fromkeys(("nm", "nanometer", "nanometers", "nanometre", "nanometres"), 1.0),
    **dict.fromkeys(
        ("um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"), 1e3
    ),
}
#: Unsupported wavelength units in the header.
OTHER_UNITS = {"angstrom", "angstroms", "ångström", "å", "mm", "m", "cm", "ev", "hz", "thz"}
#: Percent markers, which are removed from column names.
PERCENT = re.compile(r"[\s_]*[\[(]?\s*(%|\bpercent\b|\bpct\b|(?<=_)percent|(?<=_)pct)\s*[\])]?", re.IGNORECASE)


class _Table(NamedTuple):
    """Columns of a file: wavelengths in nm, values from 0 to 1."""

    names: tuple[str, ...]
    wavelength_nm: Floats
    values: Floats


def _example_file(directory: Path) -> dict[str, str]:
    """Write a table in percent."""
    path = directory / "curve.csv"
    path.write_text("wavelength (nm),QE (%)\n400,20\n500,60\n700,40\n", encoding="utf-8")
    return {"path": str(path)}


@CURVES.register("file", example=_example_file, expected={450.0: 0.4, 600.0: 0.5})
def read_curve(
    path: str | Path,
    column: str | int | None = None,
    *,
    wavelength_unit: WavelengthUnit | None = None,
    value_unit: ValueUnit | None = None,
    between: Between = "lines",
    beyond: Beyond = "raise",
) -> TableCurve | SplineCurve:
    r"""
    Read one curve from a text file.

    Parameters
    ----------
    path : path
        UTF-8 text file, with the wavelengths in the first column.
    column : str or int, optional
        Name or number of the value column, where 1 is the column after the wavelengths. Required if there are several.
    wavelength_unit : {"nm", "um"}, optional
        Unit of the wavelengths; by default that of the header (``wavelength_um``, ``lambda [µm]``), otherwise nm.
    value_unit : {"fraction", "percent"}, optional
        Unit of the values; by default percent if the column name states it (``QE [%]``, ``qe_percent``), otherwise 0 to 1.
    between : {"lines", "spline"}
        Interpolation: :class:`TableCurve` or :class:`SplineCurve`.
    beyond : {"raise", "zero", "hold"}
        Behaviour outside the table: raise an error, return 0, or return the value at the end.

    Returns
    -------
    TableCurve or SplineCurve
        Its ``source`` is the file and the column.

    Raises
    ------
    FileError
        If the file is missing, too large or not a valid table, or a value is out of range; the message states the line, the
        rule and the value.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "qe.csv")
    ...     _ = path.write_text("wavelength_nm,QE [%]\n400,20\n550,60\n700,40\n")
    ...     curve = fs.sensor.read_curve(path)
    >>> curve([475.0, 550.0]).round(3).tolist()
    [0.4, 0.6]
    """
    path = Path(path)
    table = _read(path, wavelength_unit, value_unit)
    if column is None and len(table.names) > 1:
        raise FileError(path, f"has {len(table.names)} value columns; specify one of {', '.join(table.names)}")
    k = _position(path, table, 1 if column is None else column)
    return _curve(table, k, f"{path.name}, {table.names[k]}", between, beyond)


def read_filters(
    path: str | Path,
    *,
    wavelength_unit: WavelengthUnit | None = None,
    value_unit: ValueUnit | None = None,
    between: Between = "lines",
    beyond: Beyond = "raise",
) -> FilterSet:
    r"""
    Read a set of colour filters from a text file, one per value column.

    Parameters
    ----------
    path : path
        UTF-8 text file, with the wavelengths in the first column and the filter names in the header.
    wavelength_unit, value_unit, between, beyond
        As for :func:`read_curve`.

    Returns
    -------
    FilterSet
        Filters in the order of the columns, which corresponds to the channels of a layout.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "filters.csv")
    ...     _ = path.write_text(
    ...         "nm,R,G,B\n450,0.02,0.1,0.8\n550,0.05,0.9,0.1\n650,0.9,0.1,0.02\n"
    ...     )
    ...     filters = fs.sensor.read_filters(path)
    >>> filters.names, filters.curves[1]([550.0]).tolist()
    (('R', 'G', 'B'), [0.9])
    """
    path = Path(path)
    table = _read(path, wavelength_unit, value_unit)
    curves = [_curve(table, k, f"{path.name}, {name}", between, beyond) for k, name in enumerate(table.names)]
    return FilterSet(curves, table.names)


def _curve(table: _Table, k: int, source: str, between: Between, beyond: Beyond) -> TableCurve | SplineCurve:
    kind = TableCurve if between == "lines" else SplineCurve
    values, waves_nm = table.values[:, k].tolist(), table.wavelength_nm.tolist()
    return kind(wavelength_nm=waves_nm, value=values, beyond=beyond, source=source)


def _position(path: Path, table: _Table, column: str | int) -> int:
    """Return the index of a column among the value columns."""
    if isinstance(column, str) and column in table.names:
        return table.names.index(column)
    if isinstance(column, int) and not isinstance(column, bool) and 1 <= column <= len(table.names):
        return column - 1
    raise FileError(
        path, f"has no column {column!r}; {possible_names(column, table.names)}, or 1 to {len(table.names)}"
    )


def _read(path: Path, wavelength_unit: WavelengthUnit | None, value_unit: ValueUnit | None) -> _Table:
    rows = read_rows(path, "a table of curves", MAX_FILE_BYTES, has_comments=True)
    if len(rows) > MAX_ROWS:
        raise FileError(path, f"must be a table of curves with at most {MAX_ROWS} lines")
    if not rows:
        raise FileError(path, "contains no table, only comments and empty lines")
    first = rows[0][1][0]
    header = None if NUMBER.fullmatch(first) or NON_FINITE.fullmatch(first) else rows.pop(0)[1]
    if len(rows) < 2:
        raise FileError(path, f"must have at least 2 rows of numbers, got {len(rows)}")
    n_columns = len(rows[0][1]) if header is None else len(header)
    if not 2 <= n_columns <= MAX_COLUMNS:
        raise FileError(
            path, f"must have 2 to {MAX_COLUMNS} columns, wavelengths and values, got {n_columns} in its first row"
        )
    numbers = np.array([_numbers(path, line, cells, n_columns) for line, cells in rows])
    scale_nm, is_percent, names = _parse_header(path, header, n_columns - 1)
    if wavelength_unit is not None:
        scale_nm = UNITS_NM[wavelength_unit]
    if value_unit is not None:
        is_percent[:] = value_unit == "percent"
    lines = [line for line, _ in rows]
    waves_nm = _validate_wavelengths_nm(path, lines, numbers[:, 0] * scale_nm, scale_nm)
    return _Table(names, waves_nm, _validate_values(path, lines, names, numbers[:, 1:], is_percent))


def _numbers(path: Path, line: int, cells: list[str], n_columns: int) -> list[float]:
    if len(cells) != n_columns:
        raise FileError(path, f"line {line} must have {n_columns} columns, as in the first row, got {len(cells)}")
    for k, cell in enumerate(cells, start=1):
        if not NUMBER.fullmatch(cell):
            raise FileError(path, f"line {line}, column {k}: must be a number, got {cell[:40]!r}")
    return [float(cell) for cell in cells]


def _parse_header(path: Path, header: list[str] | None, n_values: int) -> tuple[float, np.ndarray, tuple[str, ...]]:
    """Parse the header: nm per wavelength unit, mask of percent columns, and column names."""
    if header is None:
        return 1.0, np.zeros(n_values, np.bool_), tuple(str(k + 1) for k in range(n_values))
    words = [word for word in re.split(r"[\W_\d]+", header[0].lower()) if word]
    scales = [UNITS_NM[word] for word in words if word in UNITS_NM]
    other = [word for word in words[1:] if word in OTHER_UNITS]
    if other and not scales:
        raise FileError(path, f"wavelengths must be in nm or µm, got the column name {header[0][:40]!r}")
    names = tuple(PERCENT.sub("", cell).strip() for cell in header[1:])
    is_percent = np.array([PERCENT.search(cell) is not None for cell in header[1:]])
    for k, name in enumerate(names):
        if not name or name in names[:k]:
            problem = "has no name" if not name else f"repeats the name {name!r}"
            raise FileError(path, f"column {k + 2} {problem} in the header")
    return (scales or [1.0])[0], is_percent, names


def _validate_wavelengths_nm(path: Path, lines: list[int], waves_nm: Floats, scale_nm: float) -> Floats:
    is_odd = ~((waves_nm >= MIN_WAVELENGTH_NM) & (waves_nm <= MAX_WAVELENGTH_NM))
    if is_odd.any():
        k = int(np.argmax(is_odd))
        hint = (
            "; for wavelengths in µm set wavelength_unit='um'"
            if scale_nm == 1.0 and waves_nm[k] < MIN_WAVELENGTH_NM
            else ""
        )
        raise FileError(
            path,
            f"line {lines[k]}: the wavelength must be from {MIN_WAVELENGTH_NM:g} to {MAX_WAVELENGTH_NM:g} nm, "
            f"got {waves_nm[k]:g}{hint}",
        )
    order = np.argsort(waves_nm, kind="stable")
    repeated = np.flatnonzero(np.diff(waves_nm[order]) == 0.0)
    if repeated.size:
        a, b = (lines[order[repeated[0] + i]] for i in (0, 1))
        raise FileError(path, f"lines {a} and {b} have the same wavelength, {waves_nm[order[repeated[0]]]:g} nm")
    return waves_nm


def _validate_values(
    path: Path, lines: list[int], names: tuple[str, ...], values: Floats, is_percent: np.ndarray
) -> Floats:
    for is_bad, rule in (
        (values < 0.0, "must be >= 0; set negative noise to 0"),
        (is_percent & (values > 100.0), "must be <= 100 %"),
        (~is_percent & (values > 1.0), "must be <= 1; for percentages set value_unit='percent'"),
    ):
        if is_bad.any():
            row, column = (int(i) for i in np.argwhere(is_bad)[0])
            raise FileError(path, f"line {lines[row]}, column {names[column]!r}: {values[row, column]:g} {rule}")
    return np.where(is_percent, values / 100.0, values)
