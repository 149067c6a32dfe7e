"""Events in HDF5: the arrays that event tools read, with photosites and layout."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.provenance import to_plain_data
from foveasim._core.validation import Floats, Ints
from foveasim._io.sandbox import read_in_sandbox
from foveasim.errors import FileError, ParameterError
from foveasim.layout.model import Layout
from foveasim.layout.packed import layout_from_arrays, layout_to_arrays

FORMAT, VERSION = "foveasim events", 2
#: Events, or milliseconds, per chunk.
CHUNK = 1 << 16
#: Upper bound of the file size without events and layout.
METADATA_BYTES = 1 << 16
#: Size limit of the table of milliseconds: times of more than a day indicate times since an epoch, not since the start.
MAX_MS = 100_000_000
#: Limits of decompressed data: the maximum compression ratio of deflate, per byte of the file, and a number of bytes in all.
MAX_DECOMPRESSION_RATIO, MAX_DECOMPRESSED_BYTES = 1032, 8 * 2**30
#: Kinds of numeric columns, and of strings, which are stored as bytes.
NUMBERS, STRINGS = "biuf", "US"
KINDS = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8, "site": np.int32}


def max_file_bytes(layout: Layout, n_before: int, t_us: Ints) -> int:
    """
    Return an upper bound of the file size after adding events: the uncompressed size.

    ``layout``: layout of the photosites. ``n_before``: number of events in the file. ``t_us`` (n,) int64, µs: times of the
    events to add.
    """
    per_event = sum(np.dtype(kind).itemsize for kind in KINDS.values())
    n_chunks = min(int(t_us[-1]) // 1000 + 1, MAX_MS) // CHUNK + 1 if t_us.size else 1
    layout_bytes = sum(values.nbytes for values in layout_to_arrays(layout).values()) + 32 * layout.n_sites
    provenance_bytes = len(json.dumps(to_plain_data(dict(layout.provenance))))
    return per_event * (n_before + t_us.size) + 8 * CHUNK * n_chunks + layout_bytes + provenance_bytes + METADATA_BYTES


class EventFile:
    """
    Writer of events to an open HDF5 file.

    ``file``: file that is open for writing. ``layout``: layout of the photosites. ``x``, ``y`` (n_site,) uint16: address of
    each site.
    """

    def __init__(self, file: Any, layout: Layout, x: NDArray[np.uint16], y: NDArray[np.uint16]) -> None:
        self._file, self._x, self._y = file, x, y
        self.n_events, self._n_ms = 0, 0
        for name, kind in KINDS.items():
            file.create_dataset(
                f"events/{name}", (0,), kind, maxshape=(None,), chunks=(CHUNK,), compression="gzip", shuffle=True
            )
        file.create_dataset("ms_to_idx", (0,), np.uint64, maxshape=(None,), chunks=(CHUNK,))
        file["t_offset"] = np.int64(0)
        centroid_um = layout.centroid_um
        sites = {"x_um": centroid_um[:, 0], "y_um": centroid_um[:, 1], "area_um2": layout.area_um2, "x": x, "y": y}
        for name, values in sites.items():
            file[f"sites/{name}"] = values
        for name, values in layout_to_arrays(layout).items():
            if values.dtype.kind not in NUMBERS + STRINGS:
                raise ParameterError(
                    "batches",
                    f"must have a layout with columns that HDF5 supports, got '{name}' of dtype {values.dtype}",
                )
            file[f"layout/{name}"] = np.char.encode(values, "utf-8") if values.dtype.kind == "U" else values
        provenance = json.dumps(to_plain_data(dict(layout.provenance)))
        file["layout/provenance"] = np.frombuffer(provenance.encode(), np.uint8)
        file.attrs.update({"format": FORMAT, "version": VERSION})

    def add(self, t_us: Ints, site: NDArray[np.int32], polarity: NDArray[np.int8]) -> None:
        """Append events, all later than the previous ones."""
        if t_us.size == 0:
            return
        n_ms = int(t_us[-1]) // 1000 + 1
        if n_ms > MAX_MS:
            raise ParameterError(
                "batches",
                f"must end before {MAX_MS // 1000:,} s, the limit of the table of milliseconds",
                float(t_us[-1]) * 1e-6,
                "s",
                "subtract the start time of the recording",
            )
        values: dict[str, NDArray[Any]] = {
            "t": t_us,
            "x": self._x[site],
            "y": self._y[site],
            "p": polarity > 0,
            "site": site,
        }
        for name in KINDS:
            _append(self._file[f"events/{name}"], values[name])
        # Index of the first event of each millisecond that has begun since the previous events.
        for begin in range(self._n_ms, n_ms, CHUNK):
            begins_us = 1000 * np.arange(begin, min(begin + CHUNK, n_ms))
            _append(self._file["ms_to_idx"], self.n_events + np.searchsorted(t_us, begins_us))
        self.n_events, self._n_ms = self.n_events + t_us.size, n_ms

    def finish(self) -> None:
        """Close the table of milliseconds with the number of events."""
        _append(self._file["ms_to_idx"], np.array([self.n_events]))


def read_events(path: Path) -> tuple[Floats, NDArray[np.int32], NDArray[np.int8], Layout]:
    """
    Read times, sites, polarities and layout of a file that :class:`EventFile` wrote.

    Times are rounded down to microseconds.

    Raises FileError when the file is corrupt, malformed, or contains other data.
    """
    metadata, found = read_in_sandbox(_read, path, kind="HDF5", max_decompressed_bytes=_max_decompressed_bytes)
    arrays = dict(zip(metadata["names"], found, strict=True))
    outlines = {
        name.removeprefix("layout/"): np.char.decode(values, "utf-8") if values.dtype.kind == "S" else values
        for name, values in arrays.items()
        if name.startswith("layout/") and name != "layout/provenance"
    }
    layout = layout_from_arrays(outlines, json.loads(arrays["layout/provenance"].tobytes()))
    # A single division of the integer is correctly rounded: 300,000 µs gives 0.3 s.
    t_s = arrays["events/t"] / 1e6
    return t_s, arrays["events/site"], (2 * arrays["events/p"].astype(np.int8) - 1).astype(np.int8), layout


def is_own_file(path: Path) -> bool:
    """Return whether :class:`EventFile` wrote a file, by its attributes."""
    found, _ = read_in_sandbox(_format_of, path, kind="HDF5", max_decompressed_bytes=_max_decompressed_bytes)
    return bool(found["is_own"])


def _append(dataset: Any, values: NDArray[Any]) -> None:
    n = dataset.shape[0]
    dataset.resize((n + values.size,))
    dataset[n:] = values


# -- in the sandbox process ------------------------------------------------------------------------------------------


def _max_decompressed_bytes(n_bytes: int) -> int:
    return min(MAX_DECOMPRESSION_RATIO * n_bytes, MAX_DECOMPRESSED_BYTES)


def _read(file_name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Read the arrays of a file, and their names."""
    import h5py

    path = Path(file_name)
    with h5py.File(path, "r") as file:
        if file.attrs.get("format") != FORMAT:
            raise FileError(path, "does not contain events of foveasim; read it with Events.read")
        if file.attrs.get("version") != VERSION:
            raise FileError(path, f"has the format version {file.attrs.get('version')!s:.40}, expected {VERSION}")
        found = {f"events/{name}": _dataset(path, file, "events", name) for name in ("t", "site", "p")}
        for name in _group(path, file, "layout"):
            found[f"layout/{name}"] = _dataset(path, file, "layout", name)
        if sum(part.size * part.dtype.itemsize for part in found.values()) > _max_decompressed_bytes(
            path.stat().st_size
        ):
            raise FileError(path, "would decompress to more than a file of its size can contain")
        arrays = [np.ascontiguousarray(part[()]) for part in found.values()]
    return {"names": list(found)}, arrays


def _format_of(file_name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    import h5py

    with h5py.File(file_name, "r") as file:
        return {"is_own": bool(np.array_equal(file.attrs.get("format"), FORMAT))}, []


def _group(path: Path, file: Any, name: str) -> Mapping[str, Any]:
    import h5py

    if not isinstance(file.get(name, getlink=True), h5py.HardLink) or not isinstance(file[name], h5py.Group):
        raise FileError(path, f"must contain the group {name!r}, not a link")
    group: Mapping[str, Any] = file[name]
    return group


def _dataset(path: Path, file: Any, group: str, name: str) -> Any:
    """Return a dataset of numbers or strings that is stored in this file."""
    import h5py

    parts: Any = _group(path, file, group)
    part = parts[name] if isinstance(parts.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(part, h5py.Dataset) or part.external or part.is_virtual or part.dtype.kind not in NUMBERS + "S":
        raise FileError(path, f"must contain the numbers '{group}/{name}', not a link or external data")
    return part
