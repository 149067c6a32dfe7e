"""
Events in HDF5 of DSEC, v2e and Metavision, in NumPy files and in text.

Lines of text are ``t x y p``. The times of arrays are µs, as in these programs; those of text are seconds if they have
decimals.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.formats import FormatError
from foveasim._io.sandbox import read_in_sandbox
from foveasim.modes._event_files._recording import (
    MAX_EVENTS,
    Recording,
    integers,
    microseconds,
    polarities,
    shape_of,
)

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
FIELDS = ("t", "x", "y", "p")
#: Members of the group ``events`` that do not change events: indices of times and, of foveasim, sites.
IRRELEVANT = frozenset(("ms_to_idx", "indexes", "site"))
#: Limits of decompressed data, as for files of this package.
MAX_DECOMPRESSION_RATIO, MAX_DECOMPRESSED_BYTES = 1032, 8 * 2**30
#: Columns of the single array of v2e.
V2E_COLUMNS = 4
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
LINE = re.compile(rb"\s*" + rb"[\s,;]+".join([NUMBER.encode()] * 4) + rb"\s*$")


def is_text(head: bytes) -> bool:
    """Return whether the first line of a text file, without comments, has four numbers."""
    lines = head.removeprefix(b"\xef\xbb\xbf").splitlines()
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith(b"#")), b"")
    return LINE.match(first) is not None


def read_text(path: Path, time_unit: str | None = None) -> Recording:
    """Read lines of time, x, y and polarity; ``#`` begins a comment."""
    with path.open("rb") as file:
        lines = (line for line in file if line.strip() and not line.lstrip().startswith(b"#"))
        first = next(lines, b"")
    has_comma = b"," in first
    unit = time_unit or ("s" if b"." in first.replace(b",", b" ").split()[0] else None)
    if unit is None:
        raise FormatError("has integers as times, of unknown unit; pass time_unit='us', or 's', 'ms' or 'ns'")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an empty file
        rows = np.loadtxt(
            path, np.float64, comments="#", delimiter="," if has_comma else None, ndmin=2, max_rows=MAX_EVENTS
        )
    if rows.shape[1] != len(FIELDS):
        raise FormatError(f"must have four numbers on each line, t x y p, got {rows.shape[1]}")
    if not np.isfinite(rows).all():
        raise FormatError("must have finite numbers")
    x, y, p = (integers(name, rows[:, k]) for k, name in enumerate(("x", "y", "p"), 1))
    return Recording(microseconds(rows[:, 0], unit), x, y, polarities(p))


def read_npy(path: Path, time_unit: str | None = None) -> Recording:
    """Read a structured array with the fields t, x, y and p, as of Tonic."""
    events = np.load(path, allow_pickle=False, mmap_mode="r")
    names = set(events.dtype.names or ())
    if events.ndim != 1 or names != set(FIELDS):
        got = ", ".join(sorted(names)) if names else f"{events.dtype} of the shape {events.shape}"
        raise FormatError(f"must be a structured array with the fields t, x, y and p, got {got:.80}")
    if events.size > MAX_EVENTS:
        raise FormatError(f"contains {events.size:,} events, more than the limit of {MAX_EVENTS:,}")
    if events["t"].dtype.kind == "f" and time_unit is None:
        raise FormatError("has decimal numbers as times, of unknown unit; pass time_unit='s', or 'ms', 'us' or 'ns'")
    return _recording({name: np.ascontiguousarray(events[name]) for name in FIELDS}, time_unit or "us", None)


def _recording(arrays: dict[str, NDArray[Any]], unit: str, shape: tuple[int, int] | None) -> Recording:
    x, y = (integers(name, arrays[name]) for name in "xy")
    return Recording(microseconds(arrays["t"], unit), x, y, polarities(arrays["p"]), shape)


def read_hdf5(path: Path, ignore: Collection[str] = ()) -> Recording:
    """Read HDF5 in the forms of DSEC, v2e or Metavision, in the sandbox process."""
    import_optional(path, "h5py")
    about, arrays = read_in_sandbox(
        _read_hdf5, path, kind="HDF5", max_decompressed_bytes=_max_decompressed_bytes, ignore=sorted(ignore)
    )
    shape = None if about["size"] is None else shape_of(*about["size"])
    found = dict(zip(FIELDS, arrays, strict=True))
    if about["offset_us"]:
        found["t"] = integers("t", found["t"]) + int(about["offset_us"])
    return _recording(found, "us", shape)


# -- in the sandbox process ------------------------------------------------------------------------------------------


def _max_decompressed_bytes(n_bytes: int) -> int:
    return min(MAX_DECOMPRESSION_RATIO * n_bytes, MAX_DECOMPRESSED_BYTES)


def _read_hdf5(file_name: str, ignore: list[str]) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    import h5py

    with h5py.File(file_name, "r") as file:
        events, cd = _member(file, "events"), _member(file, "CD")
        size = _geometry(file)
        if isinstance(events, h5py.Dataset):  # v2e
            rows = _values(file_name, events)
            if rows.ndim != 2 or rows.shape[1] != V2E_COLUMNS:
                raise FormatError(f"must have 'events' of the shape (n, 4), got {rows.shape}")
            return {"size": size, "offset_us": 0}, [np.ascontiguousarray(rows[:, k]) for k in range(V2E_COLUMNS)]
        if isinstance(events, h5py.Group):  # DSEC
            unknown = set(events) - {*FIELDS, "height", "width", *IRRELEVANT, *ignore}
            if unknown:
                name = min(unknown)
                raise FormatError(
                    f"has 'events/{name:.40}', which is not known; pass ignore=({name!r:.40},) if it is irrelevant"
                )
            if "width" in events and "height" in events:
                size = [int(_values(file_name, events[name])) for name in ("width", "height")]
            offset = _member(file, "t_offset")
            offset_us = 0 if offset is None else int(_values(file_name, offset))
            return {"size": size, "offset_us": offset_us}, [
                _values(file_name, _required(events, name)) for name in FIELDS
            ]
        if isinstance(cd, h5py.Group):  # Metavision
            records = _values(file_name, _required(cd, "events"))
            if set(records.dtype.names or ()) != set(FIELDS):
                raise FormatError("must have 'CD/events' with the fields x, y, p and t")
            return {"size": size, "offset_us": 0}, [np.ascontiguousarray(records[name]) for name in FIELDS]
        names = ", ".join(sorted(map(str, file))[:8])
        raise FormatError(
            f"must have 'events' as of DSEC or v2e, or 'CD/events' as of Metavision, got {names or 'nothing'}"
        )


def _member(group: Any, name: str) -> Any:
    import h5py

    return group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None


def _required(group: Any, name: str) -> Any:
    found = _member(group, name)
    if found is None:
        raise FormatError(f"must have '{group.name.strip('/')}/{name}'")
    return found


def _values(file_name: str, data: Any) -> NDArray[Any]:
    """Return the numbers of a dataset that is stored in this file."""
    import h5py

    if not isinstance(data, h5py.Dataset) or data.external or data.is_virtual:
        raise FormatError(f"must have numbers as {getattr(data, 'name', '?')!r:.60}, not a link or external data")
    kinds = [data.dtype[name] for name in data.dtype.names] if data.dtype.names else [data.dtype]
    if any(kind.kind not in "biuf" for kind in kinds):
        raise FormatError(f"must have numbers as {data.name!r:.60}, got {data.dtype!s:.60}")
    if data.size * data.dtype.itemsize > _max_decompressed_bytes(Path(file_name).stat().st_size):
        raise FormatError("would decompress to more than a file of its size can contain")
    try:
        return np.asarray(data[()])
    except OSError as error:
        if "filter" in str(error):
            raise FormatError(
                f"compresses {data.name!r:.60} with a filter that h5py does not have, such as ECF of Metavision; convert it to "
                "RAW, or to HDF5 without this filter"
            ) from None
        raise


def _geometry(file: Any) -> list[int] | None:
    """Return width and height of Metavision's attribute ``geometry``."""
    stated = file.attrs.get("geometry")
    if stated is None:
        return None
    text = stated.decode("ascii", "replace") if isinstance(stated, bytes) else str(stated)
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if match is None:
        raise FormatError(f"states the geometry {text:.40}, must be as 1280x720")
    return [int(match[1]), int(match[2])]
