"""
Layout files: GDSII, OASIS, GeoJSON, GeoParquet, NeXus, npz, DXF and SVG.

=============  ==================  =================================================================================
extension      format              preserved by a round trip
=============  ==================  =================================================================================
.npz           numpy arrays        everything, bit for bit
.parquet       GeoParquet          everything, bit for bit; small files
.geojson       GeoJSON             everything; columns of numbers and strings only
.nxs, .h5      NeXus, pyFAI        everything, without holes; columns of numbers and strings only
.gds, .oas     GDSII, OASIS        outlines on the database grid, order of the sites; columns of numbers, exactly and as
                                   64-bit types, of booleans and of short strings
.dxf           DXF                 read-only: outlines and their layers
.svg           SVG                 nothing: a drawing, write-only
=============  ==================  =================================================================================

:attr:`WrittenLayout.dropped_columns` lists the columns that a file does not contain. The format of a file is detected from
its content, not from its extension. A corrupt, truncated or malformed file raises :class:`~foveasim.errors.FileError`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from foveasim._core.calls import Limits, OwnCheck, publish
from foveasim._core.registry import import_all
from foveasim._io.formats import FileFormat, as_file_error, detect_format, select_writer, validate_options
from foveasim.errors import FileError, FoveasimError
from foveasim.layout.files._bundled import bundled_layouts, layout_path
from foveasim.layout.files._common import FORMATS, WrittenLayout
from foveasim.layout.files._derived import DERIVED_LAYERS, LayoutLayer
from foveasim.layout.files._layers import layer_options, read_layer_map, reading_options
from foveasim.layout.files._outlines import Invalid, LengthUnit, Parts
from foveasim.layout.model import Layout

__all__ = [
    "DERIVED_LAYERS",
    "FORMATS",
    "FileFormat",
    "Invalid",
    "LayoutLayer",
    "LengthUnit",
    "Parts",
    "WrittenLayout",
    "bundled_layouts",
    "check_no_options",
    "layer_options",
    "layout_path",
    "read_layer_map",
    "read_layout",
    "read_options_of",
    "reading_options",
    "write_layout",
]

import_all(__name__, __path__)

#: Layers of photosites: a number, with datatype, or several.
LayerChoice: TypeAlias = int | str | tuple[int, int] | Sequence[int | str | tuple[int, int]]


def read_layout(
    path: str | Path,
    *,
    layer: OwnCheck[LayerChoice | None] = None,
    cell: str | None = None,
    layers: Mapping[str, Any] | str | Path | None = None,
    channels: Mapping[Any, int | str] | None = None,
    filter_names: Sequence[str] | None = None,
    invalid: Invalid | None = None,
    unit: LengthUnit | None = None,
    parts: Parts | None = None,
    duplicates: Literal["error", "rename"] | None = None,
    missing: Literal["error", "skip"] | None = None,
    circle_tolerance: Annotated[float | None, Limits(at_least=1e-6, at_most=0.03)] = None,
    centre: bool | None = None,
    **options: Any,
) -> Layout:
    """
    Read the photosites of a layout file.

    :func:`foveasim.read_layout` also reads bundled layouts by name and YAML files; it uses this function for other files.

    Parameters
    ----------
    path : path
        GDSII, OASIS, DXF, NeXus, npz, GeoJSON or GeoParquet, detected by content.
    layer : int, (int, int), str or list of these, optional
        GDSII and OASIS: layer of the photosites, ``77``, with datatype ``(77, 3)`` or ``"77/3"``, or several. By default the
        layer of the photosites of a file that foveasim wrote; required for other files with shapes on several layers. DXF:
        name of the layer, or several.
    cell : str, optional
        GDSII and OASIS: cell to read, with its complete cell hierarchy; required where there are several top cells. NeXus: path
        of the detector, ``"/entry/instrument/left"``; required where there are several.
    layers : mapping or path, optional
        GDSII and OASIS: layer map as for :func:`write_layout`. Its filter layers give the channels.
    channels : mapping, optional
        GDSII and OASIS: channels of filter layers, as numbers or names: ``{(10, 0): "R", "11/0": 1}``. The shape that covers a
        photosite gives its channel.
    filter_names : sequence of str, optional
        GDSII and OASIS: names of the channels 0, 1, ..., such as ``filters.names``; by default R, G, B, W.
    invalid : {"error", "skip", "repair"}, optional
        Not npz: outlines that are not simple polygons, because they cross themselves or have no area, are an error by
        default, which lists them with their positions. ``"skip"`` reads the others, and omits rows without outline.
        ``"repair"`` also divides an outline where it crosses itself, and reads the largest part. The parts of an outline that
        only touches itself are sites with the same ``site_id``.
    unit : {"nm", "um", "mm", "cm", "m", "mil", "in"}, optional
        GeoJSON, GeoParquet, DXF and NeXus: unit of the coordinates where the file does not state a unit of length. Files of
        other programs are in degrees (GeoJSON always, GeoParquet by default), in an unknown reference system, or unitless
        (DXF). Those of foveasim are in µm.
    parts : {"error", "split", "largest"}, optional
        GeoJSON, GeoParquet, DXF, NeXus: a site is one polygon; outlines of several parts are an error by default. ``"split"``
        reads each part as a site, with the columns ``parent``, the number of the row, and ``part``; ``"largest"`` reads the
        largest part.
    duplicates : {"error", "rename"}, optional
        GDSII and OASIS: several cells of one name are an error by default. ``"rename"`` reads all of them: a further cell ``A``
        is ``A$1``, or one with equal content is omitted. References that do not tell different cells apart remain an error.
    missing : {"error", "skip"}, optional
        GDSII and OASIS: references to cells that the file does not contain are an error by default, or skipped.
    circle_tolerance : float, optional
        GDSII and OASIS: largest distance between a circle and its outline, relative to the radius, by default 1e-3. The area is
        that of the circle. Applies to discs and to round ends of paths.
    centre : bool, optional
        Whether to move the centre of the layout's bounding box to the origin.
    **options
        Options of other formats in :data:`foveasim.layout.files.FORMATS`.

    Returns
    -------
    Layout
        Layout with the sites in the order in which they were written. For GDSII and OASIS, the columns are those with a value
        for every site, and ``channel`` follows from filter layers, from the file, or from several datatypes.

    Raises
    ------
    FileError
        When the file is missing, corrupt, truncated, too large, or not a layout, or a photosite has no filter although
        channels of filter layers are given.
    ParameterError
        When an option does not belong to the file's format.

    Warns
    -----
    LayoutWarning
        When invalid outlines are skipped or repaired, smaller parts are not read, missing cells are skipped or cells renamed;
        the message lists them. When records of a file have a meaning that other programs do not support either, such as
        absolute magnifications.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.read_layout("prima_75")  # a bundled layout; files by their paths
    Layout(142 sites from tiling, columns ['column', 'readout_line', 'row'])
    """
    path = Path(path)
    if str(path) in bundled_layouts() and not path.exists():
        raise FileError(path, "no such file; foveasim.read_layout reads the bundled layout of this name")
    _, found = detect_format(path, FORMATS, "layout file")
    assert found.read is not None
    given: dict[str, Any] = {
        "layer": layer,
        "cell": cell,
        "layers": layers,
        "channels": channels,
        "filter_names": filter_names,
    }
    given |= {"invalid": invalid, "unit": unit, "parts": parts}
    given |= {"duplicates": duplicates, "missing": missing, "circle_tolerance": circle_tolerance}
    chosen = validate_options(given | options, found.read_options, FORMATS, "read_options")
    with as_file_error(path, f"{found.title} layout", passes=(FoveasimError,)):
        layout: Layout = found.read(path, **chosen)
        return layout.centre() if centre else layout


def read_options_of(path: str | Path) -> set[str]:
    """Return the names of the options of a layout file's format, besides ``centre``."""
    return set(detect_format(Path(path), FORMATS, "layout file")[1].read_options)


def check_no_options(**options: object) -> None:
    """Reject format options for a file without options."""
    validate_options(options, (), FORMATS, "read_options")


def write_layout(
    layout: Layout,
    path: str | Path,
    *,
    layer: OwnCheck[LayerChoice | None] = None,
    layers: Mapping[str, Any] | str | Path | None = None,
    filter_names: Sequence[str] | None = None,
    dbu_um: Annotated[float | None, Limits(at_least=1e-9, at_most=1e3)] = None,
    hierarchy: bool | None = None,
    max_vertices: Annotated[int | None, Limits(at_least=4, at_most=1_000_000)] = None,
    colours: Mapping[int, str] | None = None,
    **options: Any,
) -> WrittenLayout:
    """
    Write a layout to a file atomically.

    Parameters
    ----------
    layout : Layout
    path : path
        The extension selects the format: ``.gds``, ``.oas``, ``.npz``, ``.geojson``, ``.parquet``, ``.nxs`` or ``.svg``.
    layer : int, (int, int) or str, optional
        GDSII and OASIS: layer of the photosites, by default 1, with the channel as datatype. ``(77, 3)`` or ``"77/3"`` sets the
        datatype; the channel is then a column.
    layers : mapping or path, optional
        GDSII and OASIS: layer map, or its YAML file: the layer of the outlines, ``"photosite": (77, 3)``, of colour filters,
        ``"filter_R": (10, 0)`` or ``"filter_0": (10, 0)``, and of shapes derived from the outlines by the functions
        :data:`foveasim.layout.DERIVED_LAYERS`, ``"well": {"layer": (20, 0), "inset_um": 0.2}``.
    filter_names : sequence of str, optional
        GDSII and OASIS: names of the channels 0, 1, ..., such as ``filters.names``; by default R, G, B, W.
    dbu_um : float, optional
        GDSII and OASIS: database unit in µm; vertices are rounded to its multiples. The default 1e-3, one nanometre, moves
        them by at most 0.71 nm.
    hierarchy : bool, optional
        GDSII and OASIS: whether congruent sites are references to a cell, and regular ones arrays, by default True. Otherwise
        each site is a polygon in the top cell.
    max_vertices : int, optional
        GDSII and OASIS: maximum vertices of a polygon, for programs that read no larger ones; in GDSII at most 8189, which is
        the default there. Outlines with more, and with holes, are divided into parts, which become one site again on
        reading.
    colours : mapping of int to str, optional
        SVG: colour of each channel, such as ``{0: "#c23b22", 1: "green"}``; other channels are grey.
    **options
        Options of other formats in :data:`foveasim.layout.files.FORMATS`.

    Returns
    -------
    WrittenLayout
        Rounding errors of the outlines, zero for lossless formats, and the dropped columns.

    Raises
    ------
    FileError
        When the extension is unknown, or the file cannot be written.
    ParameterError
        When an option does not belong to the format, or the format does not support a column or a channel.
    GeometryError
        When sites, or shapes derived from them, vanish, collapse or self-intersect on the database grid, or have more vertices
        than a layout of a file may have.

    Warns
    -----
    LayoutWarning
        When rounding moves a vertex by more than 1 nm, or columns leave no room for the identity of the sites, so that sensors
        of the layout that is read from the file have other fixed patterns.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> written = write_layout(
    ...     grid(n_x=3, n_y=3, pitch_um=2.0), "die.gds"
    ... )  # doctest: +SKIP
    >>> written.max_displacement_um  # doctest: +SKIP
    0.0
    """
    path = Path(path)
    found = select_writer(path, FORMATS)
    assert found.write is not None
    given = {
        "layer": layer,
        "layers": layers,
        "filter_names": filter_names,
        "dbu_um": dbu_um,
        "hierarchy": hierarchy,
        "max_vertices": max_vertices,
        "colours": colours,
        **options,
    }
    written: WrittenLayout = found.write(
        layout, path, **validate_options(given, found.write_options, FORMATS, "write_options")
    )
    return written


publish(__name__)
