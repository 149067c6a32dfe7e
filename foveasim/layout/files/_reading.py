"""Layouts of GDSII and OASIS files: layers, sites with columns and channels, outlines."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.names import CHANNEL_LETTERS
from foveasim._core.rings import positions_in_runs
from foveasim._core.validation import MAX_SITES, Floats, Ints
from foveasim._io.formats import as_file_error
from foveasim._io.sandbox import WALL_TIME_FACTOR, run_in_sandbox
from foveasim.errors import FileError, GeometryError, LayoutWarning, warn
from foveasim.layout.database_grid import to_um
from foveasim.layout.files import _gds_records, _gdstk, _oasis_records, _paths
from foveasim.layout.files._columns import CHANNEL, MAX_COLUMN_BYTES, parse_columns
from foveasim.layout.files._common import check_site_count, layout_from_untrusted
from foveasim.layout.files._holes import without_keyholes
from foveasim.layout.files._layers import (
    FILTER_NAMES,
    PHOTOSITE,
    DrawnLayer,
    LayerNumber,
    are_colours,
    parse_channels,
    parse_layer_map,
    parse_selection,
)
from foveasim.layout.files._oasis_records import OASIS_MAGIC
from foveasim.layout.files._outlines import valid_polygons, with_one_identity
from foveasim.layout.files._source import Source
from foveasim.layout.model import Layout
from foveasim.layout.packed import check_sizes

#: Limits of the sandbox process: memory while gdstk reads, and in total; column strings; time; larger for large files.
MIN_READING_BYTES, READING_PER_BYTE = 2**30, 256
MIN_MEMORY_BYTES, MEMORY_PER_BYTE, MAX_MEMORY_BYTES = 2**32, 256, 2**35
MIN_STRING_BYTES, STRING_BYTES_PER_BYTE = 2**27, 32
MAX_CPU_S, BYTES_PER_S = 5, 2**20
#: Number of names of missing cells in a message.
MAX_LISTED_CELLS = 5


def read(
    path: Path,
    *,
    layer: Any = None,
    cell: str | None = None,
    layers: Mapping[str, Any] | str | Path | None = None,
    channels: Mapping[Any, Any] | None = None,
    filter_names: Sequence[str] | None = None,
    invalid: str = "error",
    duplicates: str = "error",
    missing: str = "error",
    circle_tolerance: float = _paths.CIRCLE_TOLERANCE,
) -> Layout:
    """
    Read GDSII or OASIS, detected by content.

    The cell hierarchy is flattened, and the sites are ordered by their numbers. Invalid outlines are an error, which lists all
    of them, or are skipped or repaired with a warning; likewise missing cells and several cells of one name.
    """
    import_optional(path, "gdstk")
    wanted, filters, have_colours = _selection(layer, layers, channels, filter_names)
    with as_file_error(path, "GDSII or OASIS layout"):
        data = path.read_bytes()
        is_oasis = data.startswith(OASIS_MAGIC)
        source = (_oasis_records if is_oasis else _gds_records).read_records(path, data, duplicates)
        n_bytes = len(data)
        del data
        answer, shapes, covers, lines = _read_in_sandbox(
            path,
            source,
            n_bytes,
            is_oasis=is_oasis,
            layers=wanted,
            filters=list(filters),
            cell=cell,
            missing=missing,
            circle_tolerance=circle_tolerance,
        )
        counts, tags = shapes.counts, shapes.tags
        check_site_count(path, counts.size)
        xy_um = to_um(shapes.xy, answer["dbu_um"])
        pieces, piece, first = _group_by_site(path, xy_um, counts, tags)
        columns = _columns(lines, tags[piece], first)
        columns = _with_channel(columns, tags[piece[first], 1:3], wanted)
        about = {
            "made_by": "read_layout",
            "file": path.name,
            "format": "OASIS" if is_oasis else "GDSII",
            "cell": answer["cell"],
            "dbu_um": float(f"{answer['dbu_um']:.12g}"),
        }
        about |= {"circle_tolerance": circle_tolerance} if answer["arcs"] else {}
        check_sizes(np.ones(counts.size), counts)
        is_undivided = first.size == piece.size
        kept = np.arange(first.size)
        try:
            layout = layout_from_untrusted(
                pieces.rings_um if is_undivided else _merge_parts(pieces, first), columns, about
            )
        except GeometryError:
            polygons, kept = valid_polygons(path, without_keyholes(_merge_parts(pieces, first)), invalid)
            layout = layout_from_untrusted(polygons, {name: c[kept] for name, c in columns.items()}, about)
            layout = with_one_identity(layout, kept)
        if filters:
            # Sites of the layout with the outline of a filter: none of a skipped one, several of a repaired one.
            number = tags[piece, 8]
            outline = np.repeat(np.arange(first.size), np.diff(np.append(first, piece.size)))[number >= 0]
            begin = np.searchsorted(kept, outline)
            n_parts = np.searchsorted(kept, outline, side="right") - begin
            site = np.repeat(begin, n_parts) + positions_in_runs(n_parts)
            equal = np.stack((site, np.repeat(number[number >= 0], n_parts)))
            covers_um = to_um(covers.xy, answer["dbu_um"])
            channel = _covering_channels(path, layout, equal, covers_um, covers, filters)
            colours = {CHANNEL_LETTERS: "".join(FILTER_NAMES)} if have_colours else {}
            layout = layout.with_columns(channel=channel).with_provenance(about | colours)
        return layout


def _selection(
    layer: Any, layers: Any, channels: Any, filter_names: Sequence[str] | None
) -> tuple[list[LayerNumber] | None, dict[LayerNumber, int], bool]:
    """
    Return the layers of the photosites (None: default), and the channels of filters.

    The last value is whether they are named by colours.
    """
    wanted = None if layer is None else parse_selection(layer)
    filters = {} if channels is None else parse_channels(channels, filter_names)
    drawn: list[DrawnLayer] = []
    if layers is not None:
        drawn = parse_layer_map(layers, filter_names)
        if wanted is None:
            wanted = [d.number for d in drawn if d.name == PHOTOSITE]
        filters = {d.number: d.channel for d in drawn if d.channel is not None} | filters
    return wanted, filters, are_colours(channels, drawn, filter_names)


def _with_channel(
    columns: dict[str, NDArray[Any]], tags: Ints, wanted: list[LayerNumber] | None
) -> dict[str, NDArray[Any]]:
    """
    Return the columns with the channel, if the file contains it.

    A column of this name precedes the datatype. The datatype is a channel where it differs between sites, and in files of other
    programs also where it is not 0 and only a layer number was selected. ``tags`` are datatype and number of each site.
    """
    channel = columns.pop(CHANNEL, None)
    if channel is not None and channel.dtype.kind in "iu" and channel.size:
        is_index = int(channel.min()) >= 0 and int(channel.max()) <= MAX_SITES
        columns |= {CHANNEL: channel} if is_index else {}
    if CHANNEL in columns:
        return columns
    datatype, number = tags.T
    is_other = bool((number < 0).any()) and (wanted is None or any(kind is None for _, kind in wanted))
    is_channel = bool((datatype != datatype[:1]).any()) or (is_other and bool(datatype.any()))
    return {CHANNEL: datatype, **columns} if is_channel else columns


def _covering_channels(
    path: Path, layout: Layout, filters: Ints, xy_um: Floats, covers: _gdstk.Shapes, channels: Mapping[LayerNumber, int]
) -> Ints:
    """
    Return the channel of the filter that covers each site.

    A filter covers a site if it contains a point in the interior of the site. ``filters`` are the sites and the filters that
    have their outlines, as (2, n) indices; ``covers`` are the other filters.
    """
    channel_of = np.array(list(channels.values()))
    site, channel = filters[0], channel_of[filters[1]]
    found = np.full(layout.n_sites, -1)
    found[site] = channel
    if covers.counts.size:
        number = np.full(covers.counts.size, -1)
        for k, (layer, datatype) in enumerate(channels):
            number[
                (covers.tags[:, 0] == layer) & ((covers.tags[:, 1] == datatype) if datatype is not None else True)
            ] = k
        ring_offsets = np.concatenate(([0], np.cumsum(covers.counts)))
        shapes = Layout(xy_um, ring_offsets, np.arange(ring_offsets.size)).polygons()
        covered, cover = _covers(layout.polygons(), shapes)
        site, channel = np.concatenate((site, covered)), np.concatenate((channel, channel_of[number[cover]]))
        found[site] = channel
    bare = np.flatnonzero(found < 0)
    if bare.size and filters.size:
        # Sites that overlap the site of a filter.
        owners = np.unique(filters[0])
        covered, cover = _covers(layout[bare].polygons(), layout[owners].polygons())
        found[bare[covered]] = found[owners[cover]]
        bare = np.flatnonzero(found < 0)
    if bare.size:
        x, y = layout.centroid_um[bare[0]]
        raise FileError(
            path,
            f"has {bare.size} of {layout.n_sites} photosites without a filter, first site {bare[0]} at ({x:.6g}, {y:.6g}) µm; "
            "add the layer of its filter to channels= or layers=",
        )
    different = np.flatnonzero(found[site] != channel)
    if different.size:
        s = int(site[different].min())
        x, y = layout.centroid_um[s]
        raise FileError(
            path, f"has filters of several channels over site {s} at ({x:.6g}, {y:.6g}) µm; select one layer"
        )
    return found


def _covers(sites: NDArray[Any], shapes: NDArray[Any]) -> tuple[Ints, Ints]:
    """Return pairs of a site and a shape that contains a point in the interior of the site."""
    site, shape = shapely.STRtree(shapes).query(shapely.point_on_surface(sites), predicate="within")
    return site, shape


def _read_in_sandbox(
    path: Path, source: Source, n_bytes: int, *, is_oasis: bool, **options: Any
) -> tuple[dict[str, Any], _gdstk.Shapes, _gdstk.Shapes, bytes]:
    """Read the file with gdstk in the sandbox process, which a malformed file may crash."""
    max_cpu_s = MAX_CPU_S + n_bytes // BYTES_PER_S
    max_memory_bytes = min(MIN_MEMORY_BYTES + MEMORY_PER_BYTE * n_bytes, MAX_MEMORY_BYTES)
    with tempfile.TemporaryDirectory(prefix="foveasim-", ignore_cleanup_errors=True) as directory:
        content, circles = Path(directory, "content"), Path(directory, "circles.npy")
        if source.content is not None:
            content.write_bytes(source.content)
        if len(source.circles):
            np.save(circles, source.circles, allow_pickle=False)
        args = options | {
            "is_oasis": is_oasis,
            "source": None if source.content is None else str(content),
            "circles": str(circles) if len(source.circles) else None,
            "ambiguous": list(source.ambiguous),
            "max_sites": MAX_SITES,
            "max_memory_bytes": max_memory_bytes,
            "max_text_bytes": max(MIN_STRING_BYTES, STRING_BYTES_PER_BYTE * n_bytes),
            "max_cpu_s": WALL_TIME_FACTOR * max_cpu_s,
        }
        answer, (xy, counts, tags, lines, *covers) = run_in_sandbox(
            _gdstk.read,
            path,
            args,
            kind="OASIS" if is_oasis else "GDSII",
            max_cpu_s=max_cpu_s,
            max_bytes=min(MIN_READING_BYTES + READING_PER_BYTE * n_bytes, max_memory_bytes),
            is_standalone=True,
            parts=(_paths,),
        )
    if answer["missing"]:
        names = [f"{name!r:.40}" for name in answer["missing"]]
        shown = ", ".join(names[:MAX_LISTED_CELLS]) + ", ..." * (len(names) > MAX_LISTED_CELLS)
        source.notes.append(f"{len(names)} cells that the file does not contain are skipped: {shown}")
    for note in source.notes:
        warn(f"{path.name}: {note}", LayoutWarning)
    return (
        answer,
        _gdstk.Shapes(xy, counts, tags, 1),
        _gdstk.Shapes(covers[0], covers[1], covers[2], 1),
        lines.tobytes(),
    )


def _group_by_site(path: Path, xy_um: Floats, counts: Ints, tags: Ints) -> tuple[Layout, Ints, Ints]:
    """
    Sort the polygons of the file by site number, and group the parts of divided sites.

    Returns ``pieces``: one unchecked site per polygon. ``piece`` (n_piece,) int64: positions of the polygons in the file.
    ``first`` (n_site,) int64: index of the first piece of each site.
    """
    if counts.size and counts.min() < 3:
        raise FileError(path, f"contains a polygon with {counts.min()} vertices, expected at least 3")
    site, part, n_parts, placement = tags[:, 2:6].T
    # Sites without a number follow the numbered ones, in the order of the file.
    number = np.where(site >= 0, site, site.max(initial=-1) + 1)
    order = np.lexsort((part, number, placement))
    pieces = Layout(xy_um, np.concatenate(([0], np.cumsum(counts))), np.arange(counts.size + 1))
    if (np.diff(order) != 1).any():
        pieces = pieces[order]
    if not n_parts.any():
        return pieces, order, np.arange(order.size)
    key = np.stack((placement, number, n_parts), 1)[order]
    is_first = np.concatenate(([True], (key[1:] != key[:-1]).any(axis=1))) | (n_parts[order] == 0)
    first = np.flatnonzero(is_first)
    size = np.diff(np.append(first, order.size))
    is_wrong = (n_parts[order] != np.repeat(size, size)) | (part[order] != positions_in_runs(size) + 1)
    is_wrong &= n_parts[order] > 0
    if is_wrong.any():
        bad = order[np.flatnonzero(is_wrong)[0]]
        raise FileError(path, f"has missing or duplicate parts of photosite {site[bad]}, expected {n_parts[bad]} parts")
    return pieces, order, first


def _merge_parts(pieces: Layout, first: Ints) -> NDArray[Any]:
    """Merge the pieces of each site into one polygon."""
    polygons = pieces.polygons()
    merged = polygons[first]
    size = np.diff(np.append(first, polygons.size))
    for i in np.flatnonzero(size > 1):
        merged[i] = shapely.coverage_union_all(polygons[first[i] : first[i] + size[i]])
    return merged


def _columns(lines: bytes, tags: Ints, first: Ints) -> dict[str, NDArray[Any]]:
    """
    Return the columns with a value for all pieces, equal for all pieces of a site.

    ``tags`` are those of the pieces, with the line of each piece in ``lines`` and its index in an array.
    """
    columns = {}
    line, row, column = tags[:, 6], tags[:, 7] >> 32, tags[:, 7] & 0xFFFFFFFF
    size = np.diff(np.append(first, line.size))
    for name, (values, steps) in parse_columns(lines).items() if lines else ():
        if values.itemsize * line.size > MAX_COLUMN_BYTES:
            continue
        pieces = values[line]
        if steps is not None:
            pieces = pieces + steps[line, 0] * column + steps[line, 1] * row
        of_site = pieces[first]
        if np.array_equal(np.repeat(of_site, size), pieces, equal_nan=values.dtype.kind == "f"):
            columns[name] = of_site
    return columns
