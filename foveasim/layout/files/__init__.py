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

What a file does not hold of a layout's columns is told when it is written: :attr:`WrittenLayout.lost_columns`.
Files are read by what they hold, whatever their ending; a file that is broken, cut short or hostile ends in one
:class:`~foveasim.errors.FileError`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from foveasim.errors import FileError, ParameterError
from foveasim.layout.files._bundled import layout_path, shipped_layouts
from foveasim.layout.files._common import WrittenLayout, head_of
from foveasim.layout.files.gds import GDS_MAGIC, OASIS_MAGIC
from foveasim.layout.files.gds import read as read_gds
from foveasim.layout.files.gds import write as write_gds
from foveasim.layout.files.geojson import read as read_geojson
from foveasim.layout.files.geojson import write as write_geojson
from foveasim.layout.files.geoparquet import MAGIC as PARQUET_MAGIC
from foveasim.layout.files.geoparquet import read as read_geoparquet
from foveasim.layout.files.geoparquet import write as write_geoparquet
from foveasim.layout.files.npz import MAGICS as NPZ_MAGICS
from foveasim.layout.files.npz import read as read_npz
from foveasim.layout.files.npz import write as write_npz
from foveasim.layout.files.svg import write as write_svg
from foveasim.layout.model import Layout

__all__ = ["WrittenLayout", "check_chip_options", "layout_path", "read_layout", "shipped_layouts", "write_layout"]

_WRITERS: dict[str, Any] = {
    ".gds": write_gds,
    ".gdsii": write_gds,
    ".oas": write_gds,
    ".oasis": write_gds,
    ".npz": write_npz,
    ".geojson": write_geojson,
    ".json": write_geojson,
    ".svg": write_svg,
    ".parquet": write_geoparquet,
    ".geoparquet": write_geoparquet,
}
#: Beginnings of formats that are told from others, and what to do with them.
_CURES = {
    b"\x1f\x8b": "is compressed with gzip; unpack it first",
    b"<": "is markup; an SVG drawing is written and not read",
}


def read_layout(path: str | Path, *, layer: int | None = None, cell: str | None = None) -> Layout:
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

    Returns
    -------
    Layout
        In the order in which the sites were written. From GDSII and OASIS, the data type is the column ``channel``, and
        there are those others that every site tells.

    Raises
    ------
    FileError
        When the file is missing, broken, cut short, too large, or no layout.
    ParameterError
        When an option does not belong to the file's format.
    """
    path = Path(path)
    if str(path) in shipped_layouts() and not path.exists():
        raise FileError(path, "no such file; foveasim.read_layout reads the bundled layout of this name")
    head = head_of(path)
    if head.startswith((GDS_MAGIC, OASIS_MAGIC)):
        return read_gds(path, layer=layer, cell=cell)
    check_chip_options(layer=layer, cell=cell)
    if head.startswith(NPZ_MAGICS):
        return read_npz(path)
    if head.startswith(PARQUET_MAGIC):
        return read_geoparquet(path)
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith(b"{"):
        return read_geojson(path)
    for magic, cure in _CURES.items():
        if text.startswith(magic):
            raise FileError(path, cure)
    raise FileError(path, "is no layout file: expected GDSII, OASIS, npz, GeoJSON or GeoParquet")


def check_chip_options(**options: object) -> None:
    """
    Reject options of chip files for a file of another format.

    Raises
    ------
    ParameterError
        When one is given.
    """
    for name, value in options.items():
        if value is not None:
            raise ParameterError(name, "belongs to GDSII and OASIS files", value, cure="leave it out")


def write_layout(
    layout: Layout,
    path: str | Path,
    *,
    layer: int | None = None,
    dbu_um: float | None = None,
    colours: Mapping[int, str] | None = None,
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
    >>> written.worst_move_um  # doctest: +SKIP
    0.0
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise FileError(path, f"must end in one of {', '.join(sorted(_WRITERS))}")
    chosen = {name: v for name, v in (("layer", layer), ("dbu_um", dbu_um), ("colours", colours)) if v is not None}
    known = {write_gds: {"layer", "dbu_um"}, write_svg: {"colours"}}.get(writer, set())
    for name, value in chosen.items():
        if name not in known:
            raise ParameterError(name, f"does not belong to {path.suffix} files", value, cure="leave it out")
    return writer(layout, path, **chosen)
