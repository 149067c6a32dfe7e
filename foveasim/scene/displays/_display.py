"""Display: primaries, transfer function, luminances, pixels and subpixels."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from foveasim._core.calls import Limits, OwnCheck, Usual, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import (
    Floats,
    Ints,
    as_numbers,
    band_widths_nm,
    check_number,
    check_shape,
    finite_array,
    frozen_array,
    read_only,
    wavelengths_nm,
)
from foveasim._io.primaries import SRGB_XY
from foveasim._io.text_files import read_columns
from foveasim.errors import FileError, ParameterError
from foveasim.scene._colorimetry import tristimulus
from foveasim.scene._photometry import luminance_of
from foveasim.scene.registry import DISPLAYS
from foveasim.units import decode_srgb

#: Exponent, name, or table of the relative luminance of each primary by digital values.
Transfer = float | Literal["srgb"] | Sequence[float] | Sequence[Sequence[float]]
#: The pixels of walls of LEDs are up to a few centimetres wide, and their luminances up to 1e4 cd/m².
PITCH = Limits(above=0.0, at_most=1e6, hint="the pixel pitch is in µm, 25400 over the dots per inch")
WHITE = Limits(above=0.0, at_most=1e6, hint="luminances are in cd/m²")
BLACK = Limits(at_least=0.0, at_most=1e6, hint="luminances are in cd/m²")
GAMMA = Limits(above=0.0, at_most=10.0)
RADIANCE = Limits(at_least=0.0, at_most=1e24)
#: Micrometres per inch.
UM_PER_INCH = 25400.0
#: Columns of files, and limits of tables that are written by an instrument.
COLUMNS = ("wavelength_nm", "red", "green", "blue")
MAX_FILE_BYTES, MAX_ROWS = 4 << 20, 100_000
#: Entries of a transfer table for 16 bits, and cells of a block.
MAX_LEVELS, MAX_CELLS = 2**16, 2**12
#: Differences of chromaticities that are rounding, or of no importance for colour.
SAME_XY = 1e-3
#: Index of cells without light.
DARK = -1


@dataclass(frozen=True, eq=False, kw_only=True)
class Display:
    """
    A display that shows digital values, as a scene: :meth:`foveasim.Scene.from_display`.

    Parameters
    ----------
    wavelength_nm : (n_wavelength,), nm
        Wavelengths of the primaries, in any order.
    primaries : (n_primary, n_wavelength)
        Spectra of the primaries (red, green, blue) at the digital value 1: in W/(m² sr nm), averaged over a pixel, or, with
        ``white_cd_m2``, in any common unit. Their sum is white.
    pitch_um : float, µm
        Pixel pitch.
    white_cd_m2 : float, optional, cd/m²
        Luminance of white, to which the primaries are scaled; by default that of their sum, plus the black level.
    black_cd_m2 : float, cd/m²
        Luminance of black: light that leaks through the pixels, with the spectrum of white. 0 for displays that emit light.
    transfer : float, "srgb", (n_level,) or (n_level, n_primary)
        Luminance of each primary, relative to that of the digital value 1: a power of the digital value (gamma), the function
        of IEC 61966-2-1, or a table from 0 to 1 at equidistant digital values, interpolated linearly.
    cells : (n_y, n_x) int, optional
        Subpixels: index of the primary in each cell of a block of pixels, or -1 for cells without light (black matrix); top row
        first. Without them, or unless a scene has ``subpixels=True``, a pixel is uniform.
    block : (n_y, n_x)
        Pixels of a block, one by default.
    source : str
        Origin of the data.

    Raises
    ------
    ParameterError
        If the arrays have inconsistent shapes, a value is out of range, black is not darker than white, or a transfer function
        decreases.

    Notes
    -----
    The luminance of grey with the digital value ``v`` is ``black + (white - black) transfer(v)``. All colours leak the same
    fraction ``black / white``, so the contrast of an LCD reduces the saturation of its primaries.

    Cells have the area of the block over their number. A primary's cells are brighter than the pixel by the inverse of the
    fraction that they cover, so the mean over a pixel does not depend on ``cells``. Where pixels of a block have unequal areas
    of a primary, as red and blue of PenTile displays, its cells show the mean over the block.

    Light is Lambertian, constant in time, and independent of other pixels; reflections of other light are not included.

    Displays of ISETCam (``displayCreate``) have the same data: ``wave`` and ``spd`` are ``wavelength_nm`` and the transposed
    ``primaries`` in W/(m² sr nm), ``gamma`` is a table ``transfer``, ``dpi`` is 25400 / ``pitch_um``, and the ``dixel`` is
    ``cells`` and ``block``.

    Examples
    --------
    A monochrome display, and a bundled one:

    >>> import foveasim as fs
    >>> amber = fs.scene.Display(
    ...     wavelength_nm=[570.0, 590.0, 610.0],
    ...     primaries=[[0.2, 1.0, 0.2]],
    ...     pitch_um=250.0,
    ...     white_cd_m2=100.0,
    ...     transfer=2.2,
    ... )
    >>> amber.dpi
    101.6
    >>> fs.scene.displays.lcd().primaries_xy.round(3).tolist()
    [[0.64, 0.33], [0.3, 0.6], [0.15, 0.06]]
    """

    wavelength_nm: Sequence[float] | Floats
    primaries: Sequence[Sequence[float]] | Floats
    pitch_um: Annotated[float, PITCH, Usual(50.0, 500.0)]
    white_cd_m2: Annotated[float, WHITE, Usual(50.0, 1000.0)] | None = None
    black_cd_m2: Annotated[float, BLACK, Usual(0.0, 1.0)] = 0.0
    transfer: OwnCheck[Transfer] = "srgb"
    cells: Sequence[Sequence[int]] | Ints | None = None
    block: tuple[int, int] = (1, 1)
    source: str = ""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        waves_nm = wavelengths_nm("wavelength_nm", self.wavelength_nm)
        widths_nm = band_widths_nm(waves_nm, None) if waves_nm.size > 1 else None
        if widths_nm is None:
            raise ParameterError("wavelength_nm", "must have at least 2 wavelengths", waves_nm.tolist(), "nm")
        primaries = RADIANCE.check_array("primaries", self.primaries, ndim=2)
        if primaries.shape[0] == 0 or primaries.shape[1] != waves_nm.size:
            raise ParameterError(
                "primaries",
                f"must have the shape (n_primary, n_wavelength) = (..., {waves_nm.size}), got {primaries.shape}",
            )
        order = np.argsort(waves_nm)
        waves_nm, primaries, widths_nm = waves_nm[order], primaries[:, order], widths_nm[order]
        own_cd_m2 = luminance_of(primaries, waves_nm, widths_nm)
        if not own_cd_m2.any():
            raise ParameterError(
                "primaries", "must have light between 380 and 780 nm", hint="displays have a luminance"
            )
        white_cd_m2 = self.white_cd_m2
        if white_cd_m2 is None:
            white_cd_m2 = float(own_cd_m2.sum()) + self.black_cd_m2
        if not self.black_cd_m2 < white_cd_m2:
            raise ParameterError(
                "black_cd_m2", f"must be less than 'white_cd_m2', {white_cd_m2:g}", self.black_cd_m2, "cd/m²"
            )
        cells, block = _checked_cells(self.cells, self.block, primaries.shape[0])
        for name, value in {
            "wavelength_nm": read_only(waves_nm),
            "primaries": read_only(primaries),
            "white_cd_m2": white_cd_m2,
            "transfer": _checked_transfer(self.transfer, primaries.shape[0]),
            "cells": cells,
            "block": block,
        }.items():
            object.__setattr__(self, name, value)

    @property
    def primaries_xy(self) -> Floats:
        """CIE 1931 chromaticities of the primaries, (n_primary, 2); NaN for invisible ones."""
        return self._chromaticities(np.asarray(self.primaries))

    @property
    def white_xy(self) -> Floats:
        """CIE 1931 chromaticity x and y of white, (2,)."""
        return self._chromaticities(np.asarray(self.primaries).sum(axis=0, keepdims=True))[0]

    @property
    def contrast(self) -> float:
        """Luminance of white over that of black."""
        assert self.white_cd_m2 is not None
        return self.white_cd_m2 / self.black_cd_m2 if self.black_cd_m2 > 0.0 else math.inf

    @property
    def dpi(self) -> float:
        """Pixels per inch."""
        return UM_PER_INCH / self.pitch_um

    @property
    def has_srgb_colours(self) -> bool:
        """Whether primaries and white have the chromaticities of sRGB, within 0.001."""
        found = np.vstack((self.primaries_xy, self.white_xy))
        return found.shape == SRGB_XY.shape and bool(np.all(np.abs(found - SRGB_XY) <= SAME_XY))

    def _chromaticities(self, spectra: Floats) -> Floats:
        waves_nm = np.asarray(self.wavelength_nm)
        xyz = tristimulus(spectra, waves_nm, band_widths_nm(waves_nm, None))
        with np.errstate(invalid="ignore"):
            return np.asarray(xyz[:, :2] / xyz.sum(axis=1, keepdims=True))

    def relative_luminance(self, values: Floats) -> Floats:
        """
        Return the luminance of each primary for digital values, relative to the value 1.

        Parameters
        ----------
        values : (n_primary, ...)
            Digital values from 0 to 1.

        Returns
        -------
        relative : (n_primary, ...) float64
            From 0 to 1, without the light of black.

        Examples
        --------
        >>> import numpy as np
        >>> import foveasim as fs
        >>> lcd = fs.scene.displays.lcd(transfer=2.0)
        >>> lcd.relative_luminance(np.full((3, 1), 0.5)).tolist()
        [[0.25], [0.25], [0.25]]
        """
        digital = finite_array("values", values, at_least=0.0, at_most=1.0)
        n_primary = np.asarray(self.primaries).shape[0]
        if digital.ndim == 0 or digital.shape[0] != n_primary:
            raise ParameterError(
                "values", f"must have the shape (n_primary, ...) = ({n_primary}, ...), got {digital.shape}"
            )
        if isinstance(self.transfer, str):
            return np.asarray(decode_srgb(digital))
        if isinstance(self.transfer, float):
            return np.asarray(digital**self.transfer)
        table = np.asarray(self.transfer)
        curves = np.broadcast_to(table.reshape(table.shape[0], -1).T, (n_primary, table.shape[0]))
        levels = np.linspace(0.0, 1.0, table.shape[0])
        return np.stack([np.interp(each, levels, curve) for each, curve in zip(digital, curves, strict=True)])

    @classmethod
    def from_csv(
        cls,
        path: str | Path,
        *,
        pitch_um: Annotated[float, PITCH, Usual(50.0, 500.0)],
        white_cd_m2: Annotated[float, WHITE, Usual(50.0, 1000.0)] | None = None,
        black_cd_m2: Annotated[float, BLACK, Usual(0.0, 1.0)] = 0.0,
        transfer: OwnCheck[Transfer] = "srgb",
        cells: Sequence[Sequence[int]] | Ints | None = None,
        block: tuple[int, int] = (1, 1),
    ) -> Display:
        r"""
        Read a display from measured spectra of its primaries.

        Parameters
        ----------
        path : path
            UTF-8 text whose first line names the columns. ``wavelength_nm``, ``red``, ``green`` and ``blue`` are read, others
            are ignored.
        pitch_um, white_cd_m2, black_cd_m2, transfer, cells, block
            As for the class: without ``white_cd_m2``, the spectra are in W/(m² sr nm).

        Returns
        -------
        Display

        Raises
        ------
        FileError
            If the file cannot be read, or is not such a table.
        ParameterError
            If another parameter is out of range.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> import foveasim as fs
        >>> with tempfile.TemporaryDirectory() as directory:
        ...     path = Path(directory, "display.csv")
        ...     _ = path.write_text(
        ...         "wavelength_nm,red,green,blue\n450,0,0,9\n550,0,3,0\n650,7,0,0\n"
        ...     )
        ...     display = fs.scene.Display.from_csv(
        ...         path, pitch_um=270.0, white_cd_m2=200.0, black_cd_m2=0.2
        ...     )
        >>> display.primaries.shape, display.source
        ((3, 3), 'display.csv')
        """
        path = Path(path)
        waves_nm, spectra = _read_spectra(path)
        try:
            return cls(
                wavelength_nm=waves_nm,
                primaries=spectra,
                pitch_um=pitch_um,
                white_cd_m2=white_cd_m2,
                black_cd_m2=black_cd_m2,
                transfer=transfer,
                cells=cells,
                block=block,
                source=path.name,
            )
        except ParameterError as error:
            raise (FileError(path, str(error)) if error.name in {"wavelength_nm", "primaries"} else error) from None


#: Three bands at single wavelengths, whose chromaticities are those of the observer.
_WAVES_NM = (400.0, 450.0, 500.0, 550.0, 600.0, 650.0, 700.0)
_LINES = [[float(at_nm == line_nm) for at_nm in _WAVES_NM] for line_nm in (650.0, 550.0, 450.0)]
_LINES_XY = ((0.726, 0.274), (0.3016, 0.6923), (0.1566, 0.0177))


def _example_file(directory: Path) -> dict[str, Any]:
    """Write the spectra of three lines."""
    rows = [",".join(f"{value:g}" for value in row) for row in zip(_WAVES_NM, *_LINES, strict=True)]
    path = directory / "display.csv"
    path.write_text("\n".join((",".join(COLUMNS), *rows)), encoding="utf-8")
    return {"path": str(path), "pitch_um": 250.0, "white_cd_m2": 100.0}


DISPLAYS.register("file", Display.from_csv, example=_example_file, expected=_LINES_XY)
DISPLAYS.register(
    "table",
    Display,
    example={"wavelength_nm": _WAVES_NM, "primaries": _LINES, "pitch_um": 250.0, "white_cd_m2": 100.0, "transfer": 2.2},
    expected=_LINES_XY,
)


def display_of(display: Display | str) -> Display:
    """Return a display, or the registered one of this name with its default parameters."""
    if isinstance(display, Display):
        return display
    make = DISPLAYS.find("display", display)
    try:
        inspect.signature(make).bind()
    except TypeError:
        raise ParameterError(
            "display", "must be the name of a display without required parameters", display, hint="pass a Display"
        ) from None
    made = make()
    if not isinstance(made, Display):
        raise ParameterError(
            "display", f"must be the name of a function that returns a Display, got {type(made).__name__}"
        )
    return made


def _read_spectra(path: Path) -> tuple[Floats, Floats]:
    """Return the wavelengths and the three spectra of a file."""
    lines = read_columns(path, "a table of spectra", COLUMNS, MAX_FILE_BYTES, has_comments=True)
    if not 2 <= len(lines) <= MAX_ROWS:
        raise FileError(path, f"must have 2 to {MAX_ROWS} wavelengths, got {len(lines)}")
    rows = []
    for number, cells in lines:
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:
            raise FileError(path, f"must have numbers in line {number}, got {', '.join(cells)[:60]}") from None
        if not np.isfinite(rows[-1]).all() or min(rows[-1]) < 0.0:
            raise FileError(path, f"must have finite numbers >= 0 in line {number}, got {', '.join(cells)[:60]}")
    waves_nm, *spectra = np.array(rows).T
    return waves_nm, np.array(spectra)


def _checked_transfer(transfer: Any, n_primary: int) -> Any:
    """Return an exponent, "srgb", or a read-only table."""
    rule = f"must be a number, 'srgb', or a table of the shape (n_level,) or (n_level, {n_primary})"
    if isinstance(transfer, str):
        if transfer != "srgb":
            raise ParameterError("transfer", rule, transfer)
        return transfer
    table = as_numbers("transfer", transfer)
    if table.ndim == 0:
        return check_number("transfer", transfer, above=0.0, at_most=GAMMA.at_most, hint="gamma is usually 1.8 to 2.4")
    is_table = table.ndim == 1 or (table.ndim == 2 and table.shape[1] == n_primary)
    if not is_table or not 2 <= table.shape[0] <= MAX_LEVELS:
        raise ParameterError("transfer", f"{rule} with 2 to {MAX_LEVELS} levels, got the shape {table.shape}")
    table = finite_array("transfer", table)
    if np.any(np.diff(table, axis=0) < 0.0):
        level = int(np.argwhere(np.diff(table, axis=0) < 0.0)[0][0]) + 1
        raise ParameterError("transfer", f"must not decrease, as it does at level {level}")
    if np.any(table[0] != 0.0) or np.any(table[-1] != 1.0):
        raise ParameterError(
            "transfer",
            "must begin with 0 and end with 1",
            [table[0].tolist(), table[-1].tolist()],
            hint="subtract the light of black, which is 'black_cd_m2', and divide by that of white",
        )
    return frozen_array(table)


def _checked_cells(cells: Any, block: Any, n_primary: int) -> tuple[Ints | None, tuple[int, int]]:
    """Return the cells of a block of pixels, and its shape."""
    shape = check_shape("block", block)
    if cells is None:
        if shape != (1, 1):
            raise ParameterError("block", "requires 'cells'", shape)
        return None, shape
    found = as_numbers("cells", cells)
    if found.ndim != 2 or not 1 <= found.size <= MAX_CELLS:
        raise ParameterError("cells", f"must have the shape (n_y, n_x), with 1 to {MAX_CELLS} cells, got {found.shape}")
    if found.shape[0] % shape[0] or found.shape[1] % shape[1]:
        raise ParameterError(
            "cells", f"must have an integer number of cells along each side of the {shape[0]} x {shape[1]} pixels of a block, "
            f"got {found.shape[0]} x {found.shape[1]} cells",
        )  # fmt: skip
    allowed = {float(k) for k in range(DARK, n_primary)}
    odd = [value for value in np.unique(found).tolist() if value not in allowed]
    if odd:
        raise ParameterError(
            "cells", f"must be indices of primaries, 0 to {n_primary - 1}, or -1 for cells without light", odd[0]
        )
    missing = [k for k in range(n_primary) if not np.any(found == k)]
    if missing:
        raise ParameterError("cells", f"must contain each of the {n_primary} primaries; {missing[0]} is missing")
    return frozen_array(found.astype(np.int64)), shape
