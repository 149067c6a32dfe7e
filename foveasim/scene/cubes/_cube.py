"""Data and metadata of a hyperspectral cube in a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, wavelengths_nm
from foveasim._io.formats import FormatError
from foveasim._io.rasters.units import length_in_um
from foveasim.errors import ParameterError

#: Wavelengths and unit of the cubes of examples.
EXAMPLE_NM, EXAMPLE_UNIT = (500.0, 600.0), "W m-2 sr-1 nm-1"
#: Physical quantity of the values of a cube.
Quantity: TypeAlias = Literal["radiance", "reflectance"]
#: Relative tolerance of square pixels: positions may be float32.
SQUARE_TOLERANCE = 1e-4
#: Wavelengths below this are not in nm; without a unit they are rejected.
MIN_NM = 10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Cube:
    """
    Data and metadata of a hyperspectral cube; None for metadata that a file lacks.

    Attributes
    ----------
    data : (n_band, n_y, n_x)
        Values of any real dtype, rows and columns in file order: an array, or an object with ``shape``, ``dtype`` and slicing,
        such as a memory map, of which only the selected part is read.
    is_y_descending, is_x_descending : bool
        Whether the first row is the top row, and the first column the rightmost column.
    wavelength : (n_band,)
        Wavelengths of the bands in ``wavelength_unit``.
    wavelength_unit : str
        Unit of length: ``nm``, ``Micrometers``, ...; nm if None.
    band_width_nm : (n_band,), nm
    quantity : {"radiance", "reflectance"}
    unit : str
        Unit as written in the file: ``W m-2 sr-1 nm-1``, ``uW/(cm^2 sr nm)``, ``%``, ...
    scale, offset : number or (n_band,)
        Values in the unit are ``scale * data + offset``.
    is_good : (n_band,) bool
        Whether a band is valid; others are skipped.
    missing : number
        Value of pixels without data.
    pitch_um : (along x, along y), µm
        Size of a pixel in the scene.
    field_of_view_deg : float, degrees
        Horizontal angle of all columns.
    distance_m : float, m
    close : callable
        Function that closes the file, called after the data are read.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> data = np.ones((3, 4, 6))  # bands, rows, columns
    >>> cube = fs.scene.Cube(
    ...     data=data,
    ...     wavelength=[0.45, 0.55, 0.65],
    ...     wavelength_unit="um",
    ...     quantity="reflectance",
    ... )
    >>> cube.data.shape, cube.wavelength_unit
    ((3, 4, 6), 'um')
    """

    data: Any
    is_y_descending: bool = True
    is_x_descending: bool = False
    wavelength: Sequence[float] | Floats | None = None
    wavelength_unit: str | None = None
    band_width_nm: Sequence[float] | Floats | None = None
    quantity: Quantity | None = None
    unit: str | None = None
    scale: float | Sequence[float] | Floats = 1.0
    offset: float | Sequence[float] | Floats = 0.0
    is_good: Sequence[bool] | None = None
    missing: float | None = None
    pitch_um: tuple[float, float] | None = None
    field_of_view_deg: float | None = None
    distance_m: float | None = None
    close: Callable[[], None] | None = None

    __repr__ = short_repr

    def waves_nm(self, given_nm: Any = None) -> Floats:
        """
        Return the given wavelengths, or those of the file, (n_band,) nm.

        Raises
        ------
        FormatError
            If the file does not specify wavelengths in a unit of length, or not one per band.
        ParameterError
            If the given wavelengths are invalid.
        """
        n_bands = int(self.data.shape[0])
        if given_nm is not None:
            waves_nm = wavelengths_nm("wavelength_nm", given_nm)
            if waves_nm.size != n_bands:
                rule = f"must have {n_bands} values, one per band of the cube, got {waves_nm.size}"
                raise ParameterError("wavelength_nm", rule)
            return waves_nm
        if self.wavelength is None:
            raise FormatError(
                f"does not specify the wavelengths of its bands; pass wavelength_nm=..., {n_bands} values in nm"
            )
        values = np.asarray(self.wavelength, np.float64)
        if values.size != n_bands:
            raise FormatError(f"contains {values.size} wavelengths for {n_bands} bands; pass wavelength_nm=...")
        unit = self.wavelength_unit
        size_um = 1e-3 if unit is None else length_in_um(unit) or length_in_um(unit.lower())
        if size_um is None:
            raise FormatError(
                f"has wavelengths in the unknown unit {unit!r:.40}, expected nm, µm or m; pass wavelength_nm=..."
            )
        if unit is None and np.all(values < MIN_NM):
            raise FormatError(
                f"has wavelengths from {values.min():.6g} to {values.max():.6g} without a unit, which are not nm; "
                "specify the unit in the file, or pass wavelength_nm=..."
            )
        try:
            return wavelengths_nm("wavelength", values * (1e3 * size_um) if size_um != 1e-3 else values)
        except ParameterError as error:
            raise FormatError(f"contains invalid wavelengths ({error}); pass wavelength_nm=...") from None

    def square_pitch_um(self) -> float | None:
        """
        Return the pixel pitch of the file, µm, or None.

        Raises
        ------
        FormatError
            If pixels are not square.
        """
        if self.pitch_um is None:
            return None
        along_x, along_y = self.pitch_um
        if abs(along_x - along_y) > SQUARE_TOLERANCE * max(along_x, along_y):
            raise FormatError(
                f"has pixels of {along_x:.6g} x {along_y:.6g} µm, expected squares; resample it, or pass fit=, pitch_um= or "
                "field_of_view_deg="
            )
        return along_x


def example_radiance() -> Floats:
    """Return the radiance of examples, (n_band, n_y, n_x), bottom row first."""
    return np.arange(1.0, 2.0 * 4.0 * 5.0 + 1.0).reshape(2, 4, 5)
