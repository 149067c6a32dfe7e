"""
Columns of photosites: one value for each site of a capture.

Tables, figures, pages, datasets, tiles and exports have the same ones, with their titles and units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from inspect import signature
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import publish
from foveasim._core.names import possible_names
from foveasim._core.registry import Registry
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, title_and_unit, words_and_unit
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout.model import Layout

if TYPE_CHECKING:
    from foveasim.capture import Capture
    from foveasim.sensor import Sensor

__all__ = ["COLUMNS", "Column", "ColumnInfo", "column_info"]

#: Function of a capture that returns one value for each site. If it has an optional parameter ``sensor``, it receives that
#: of :meth:`foveasim.Capture.picture`.
Column: TypeAlias = Callable[..., NDArray[Any]]
#: The column that figures and pages show first.
MAIN = "code"
#: Columns that every layout has.
OF_LAYOUT = ("channel", "area_um2", "size_um", "readout_line")


@dataclass(frozen=True, kw_only=True)
class ColumnInfo:
    """
    Facts about a column, for tables, figures and pages.

    Attributes
    ----------
    title : str
        By default the name without its unit.
    unit : str
        By default that of the name's suffix, such as ``_e``; empty for dimensionless numbers.
    note : str
        Definition, shown beside the values.
    dtype : str
        Type of the values in stores, as for :class:`numpy.dtype`.
    is_signal : bool
        Whether it is light: figures show it in shades of grey or, on a colour mosaic, of the filters.
    is_random : bool
        Whether it differs between draws; if not, the samples of a dataset that differ in their draw share it.
    in_tables : bool
        Whether tables, exports and tiles contain it; otherwise it is computed only where it is named.
    on_pages : bool
        Whether pages and the studio list it.

    Examples
    --------
    >>> import foveasim as fs
    >>> info = fs.columns.column_info("expected_e")
    >>> info.title, info.unit
    ('expected electrons', 'e-')
    """

    title: str = ""
    unit: str = ""
    note: str = ""
    dtype: str = "f8"
    is_signal: bool = False
    is_random: bool = True
    in_tables: bool = True
    on_pages: bool = True

    __repr__ = short_repr

    def __post_init__(self) -> None:
        try:
            is_number = np.dtype(self.dtype).kind in "biuf"
        except TypeError:
            is_number = False
        if not is_number:
            raise ParameterError("dtype", "must be the name of a type of numbers, such as 'f8' or 'i4'", self.dtype)

    @property
    def heading(self) -> str:
        """Title and unit, such as ``"electrons / e-"``."""
        return f"{self.title} / {self.unit}" if self.unit else self.title


#: Columns by name. Facts are registered with ``@COLUMNS.register(name, info=ColumnInfo(...))``, and have defaults. Installed
#: packages add columns as entry points of the group ``foveasim.columns``.
COLUMNS: Registry[Column] = Registry("column", "foveasim.columns")


def column_info(name: str) -> ColumnInfo:
    """
    Return the facts about a column.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.columns.column_info("code").heading
    'code / DN'

    Raises
    ------
    ParameterError
        When no column has this name.
    """
    COLUMNS.find("column", name)
    found: ColumnInfo = COLUMNS.info(name) or ColumnInfo()
    title, unit = title_and_unit(name, found.title, found.unit)
    return replace(found, title=title, unit=unit)


def find_column(
    parameter: str, name: str, layout: Layout, capture: Capture | None = None, sensor: Sensor | None = None
) -> tuple[NDArray[Any], ColumnInfo]:
    """
    Return a column of a layout, or of a capture of it, (n_site,), and the facts about it.

    Arrays of the capture come first, then columns of the layout. Raises ParameterError for the parameter when neither has the
    column, and errors as :func:`compute_column`.
    """
    if capture is not None and name in COLUMNS and (name in STORED or name not in layout.columns):
        return compute_column(name, capture, sensor), column_info(name)
    if name in layout.columns or name in OF_LAYOUT:
        words, unit = words_and_unit(name)
        values: NDArray[Any] = layout.columns[name] if name in layout.columns else getattr(layout, name)
        return values, ColumnInfo(title=words, unit=unit)
    known = {*(COLUMNS if capture is not None else ()), *OF_LAYOUT, *layout.columns}
    raise ParameterError(parameter, "must be the name of a column", name, hint=possible_names(name, sorted(known)))


def compute_column(name: str, capture: Capture, sensor: Sensor | None = None) -> NDArray[Any]:
    """
    Return the values of a registered column, (n_site,).

    Raises SimulationError when its function does not return one value for each site, and errors of the function.
    """
    function = COLUMNS[name]
    options = {} if name in STORED or "sensor" not in signature(function).parameters else {"sensor": sensor}
    values, n_sites = np.asarray(function(capture, **options)), capture.layout.n_sites
    if values.shape != (n_sites,):
        raise SimulationError(
            f"the column '{name}' must have one value for each of the {n_sites:,} sites, got the shape {values.shape}"
        )
    return values


def registered_by_user(names: Iterable[str]) -> dict[str, tuple[Column, ColumnInfo]]:
    """Return the functions and facts of columns that the package itself does not have."""
    bundled = {*STORED, *COLUMNS.within("foveasim")}
    return {name: (COLUMNS[name], COLUMNS.info(name)) for name in names if name not in bundled}


# -- arrays of captures --------------------------------------------------------------------------------------------------


#: Columns that are arrays of a capture, and of its files.
STORED = {
    "code": ColumnInfo(title="code", unit="DN", dtype="u2", is_signal=True),
    "electrons": ColumnInfo(title="electrons", unit="e-", dtype="i8", is_signal=True),
    "expected_e": ColumnInfo(title="expected electrons", unit="e-", is_signal=True, is_random=False),
    "filter_of_site": ColumnInfo(title="filter", dtype="i1", is_random=False, on_pages=False),
}
for _name, _info in STORED.items():
    COLUMNS.register(_name, attrgetter(_name), info=_info)


# -- computed columns ----------------------------------------------------------------------------------------------------


@COLUMNS.register(
    "code_dn",
    info=ColumnInfo(
        title="signed code",
        unit="DN",
        note="for differences; codes are unsigned",
        dtype="i4",
        is_signal=True,
        on_pages=False,
    ),
)
def code_dn(capture: Capture) -> NDArray[np.int32]:
    """Return the code of every site as signed integers, (n_site,) DN."""
    return capture.code_dn


@COLUMNS.register(
    "snr",
    info=ColumnInfo(
        title="signal-to-noise ratio",
        note="expected photoelectrons over temporal noise, quantisation included",
        is_random=False,
        in_tables=False,
    ),
)
def snr(capture: Capture, sensor: Sensor | None = None) -> Floats:
    """Return the expected signal-to-noise ratio of every site, (n_site,)."""
    return capture.signal_to_noise(sensor=sensor)


@COLUMNS.register(
    "expected_dn",
    info=ColumnInfo(
        title="expected code",
        unit="DN",
        note="mean over temporal noise, quantisation included",
        is_random=False,
        in_tables=False,
        on_pages=False,
    ),
)
def expected_dn(capture: Capture, sensor: Sensor | None = None) -> Floats:
    """Return the mean code over temporal noise of every site, (n_site,) DN."""
    return capture.expected_code(sensor=sensor)


publish(__name__)
