"""
Layouts as files: chip layout (GDSII, OASIS), maps (GeoJSON, GeoParquet), exact arrays (npz), and drawings (SVG).

=============  ==================  =================================================================================
ending         format              what a round trip keeps
=============  ==================  =================================================================================
.npz           numpy arrays        everything, to the last bit
.parquet       GeoParquet          everything, to the last bit; small
.geojson       GeoJSON             everything; numbers and text in columns
.gds, .oas     GDSII, OASIS        outlines on the database grid, order of the sites, ``channel``; columns of numbers to
                                   the last bit, as 64 bits, of truth values and of short texts
.svg           SVG                 nothing: a drawing, written only
=============  ==================  =================================================================================

What a file does not hold of a layout's columns is told when it is written: :attr:`WrittenLayout.dropped_columns`.
Files are read by what they hold, whatever their ending; a file that is corrupt, truncated or malformed ends in one
:class:`~foveasim.errors.FileError`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from foveasim._core.registry import import_all
from foveasim._io.formats import FileFormat, chosen_options, format_of, writing_format
from foveasim.errors import FileError
from foveasim.layout.files._bundled import layout_path, shipped_layouts
from foveasim.layout.files._common import WrittenLayout
from foveasim.layout.files._formats import FORMATS
from foveasim.layout.model import Layout

__all__ = [
    "FORMATS",
    "FileFormat",
    "WrittenLayout",
    "check_no_options",
    "layout_path",
    "read_layout",
    "shipped_layouts",
    "write_layout",
]

import_all(__name__, __path__)


def read_layout(path: str | Path, *, layer: int | None = None, cell: str | None = None, **options: Any) -> Layout:
    """
    Read the photosites of a layout file.

    Names of bundled layouts and YAML files are read by :func:`foveasim.read_layout`, which reads all other files by this.

    Parameters
    ----------
    path : path
        GDSII, OASIS, npz, GeoJSON or GeoParquet, told by its content. Coordinates of GeoJSON and GeoParquet are in µm.
    layer : int, optional
        Of GDSII and OASIS: the layer that holds the photosites; needed where shapes lie on several.
    cell : str, optional
        Of GDSII and OASIS: the cell to read, with all cells below it; needed where several are on top.
    **options
        Of other formats in :data:`foveasim.layout.files.FORMATS`.

    Returns
    -------
    Layout
        In the order in which the sites were written. From GDSII and OASIS, the data type is the column ``channel``, and
        there are those others that every site tells.

    Raises
    ------
    FileError
        When the file is missing, broken, truncated, too large, or no layout.
    ParameterError
        When an option does not belong to the file's format.
    """
    path = Path(path)
    if str(path) in shipped_layouts() and not path.exists():
        raise FileError(path, "no such file; foveasim.read_layout reads the bundled layout of this name")
    _, found = format_of(path, FORMATS, "layout file")
    assert found.read is not None
    chosen = chosen_options({"layer": layer, "cell": cell, **options}, found.read_options, FORMATS, "read_options")
    layout: Layout = found.read(path, **chosen)
    return layout


def check_no_options(**options: object) -> None:
    """
    Reject options of formats for a file that has none.

    Raises
    ------
    ParameterError
        When one is given.
    """
    chosen_options(options, (), FORMATS, "read_options")


def write_layout(
    layout: Layout,
    path: str | Path,
    *,
    layer: int | None = None,
    dbu_um: float | None = None,
    colours: Mapping[int, str] | None = None,
    **options: Any,
) -> WrittenLayout:
    """
    Write a layout to a file, whole or not at all.

    Parameters
    ----------
    layout : Layout
    path : path
        Its ending names the format: ``.gds``, ``.oas``, ``.npz``, ``.geojson``, ``.parquet`` or ``.svg``.
    layer : int, optional
        Of GDSII and OASIS: the layer of the photosites, by default 1.
    dbu_um : float, optional
        Of GDSII and OASIS: the database unit in µm, to whose multiples the vertices move; by default 1e-4, a tenth
        of a nanometre, with which coordinates reach 214 mm.
    colours : mapping of int to str, optional
        Of SVG: the colour of each channel, as ``{0: "#c23b22", 1: "green"}``; channels not named are grey.
    **options
        Of other formats in :data:`foveasim.layout.files.FORMATS`.

    Returns
    -------
    WrittenLayout
        What rounding did to the outlines, zero for formats that keep every digit; and the columns left out.

    Raises
    ------
    FileError
        When the ending is unknown, or nothing can be written there.
    ParameterError
        When an option does not belong to the format, or the format cannot hold a column or a channel.
    GeometryError
        When sites collapse or cross themselves on the database grid.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> written = write_layout(grid(n_x=3, n_y=3, pitch_um=2.0), "die.gds")  # doctest: +SKIP
    >>> written.max_displacement_um  # doctest: +SKIP
    0.0
    """
    path = Path(path)
    found = writing_format(path, FORMATS)
    assert found.write is not None
    given = {"layer": layer, "dbu_um": dbu_um, "colours": colours, **options}
    written: WrittenLayout = found.write(
        layout, path, **chosen_options(given, found.write_options, FORMATS, "write_options")
    )
    return written
