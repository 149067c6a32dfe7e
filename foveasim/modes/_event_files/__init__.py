"""Recordings of event cameras in the files of other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from foveasim._io.formats import FileFormat, FormatError, as_file_error, detect_format
from foveasim.errors import FileError, ParameterError
from foveasim.modes._event_files._arrays import HDF5_SIGNATURE, is_text, read_hdf5, read_npy, read_text
from foveasim.modes._event_files._inivation import read_aedat2, read_aedat4
from foveasim.modes._event_files._prophesee import read_dat, read_raw
from foveasim.modes._event_files._recording import TIME_UNITS, Recording, TimeUnit, empty_recording

__all__ = ["EVENT_FORMATS", "Recording", "TimeUnit", "read_recording"]


#: Extensions of text: a file without lines has no events.
TEXT_SUFFIXES = (".txt", ".csv")


def _begins_with_header(path: Path, head: bytes, *, is_dat: bool) -> bool:
    return head.startswith(b"% ") and (path.suffix.lower() == ".dat" or b"CD events" in head) == is_dat


#: Formats of event files. ``read(path)`` returns a :class:`Recording`. Options: ``time_unit``, ``ignore`` and ``shape``.
EVENT_FORMATS: Mapping[str, FileFormat] = {
    "raw": FileFormat(
        title="Prophesee RAW (EVT 2.0, 2.1 and 3.0)",
        suffixes=(".raw",),
        matches=lambda path, head: _begins_with_header(path, head, is_dat=False),
        read=read_raw,
        read_options=("ignore",),
    ),
    "dat": FileFormat(
        title="Prophesee DAT",
        suffixes=(".dat",),
        matches=lambda path, head: _begins_with_header(path, head, is_dat=True),
        read=read_dat,
        read_options=("ignore",),
    ),
    "aedat4": FileFormat(title="AEDAT 4", suffixes=(".aedat4",), signatures=(b"#!AER-DAT4",), read=read_aedat4),
    "aedat2": FileFormat(
        title="AEDAT 2",
        suffixes=(".aedat", ".aedat2"),
        signatures=(b"#!AER-DAT",),
        read=read_aedat2,
        read_options=("shape",),
    ),
    "hdf5": FileFormat(
        title="HDF5 (DSEC, v2e, Metavision)",
        suffixes=(".h5", ".hdf5"),
        signatures=(HDF5_SIGNATURE,),
        read=read_hdf5,
        read_options=("ignore",),
    ),
    "npy": FileFormat(
        title="NumPy", suffixes=(".npy",), signatures=(b"\x93NUMPY",), read=read_npy, read_options=("time_unit",)
    ),
    "text": FileFormat(
        title="text (t x y p)",
        suffixes=TEXT_SUFFIXES,
        matches=lambda _, head: is_text(head),
        read=read_text,
        read_options=("time_unit",),
    ),
}


def read_recording(path: Path, **options: Any) -> Recording:
    """
    Read a recording; the format is detected by content.

    ``options``: those of the format that are not None; others are errors. ``shape``, the numbers of rows and columns of the
    sensor, is for all formats.

    Raises FileError when the file is damaged, of another format, or contains what is not understood.
    """
    if path.suffix.lower() in TEXT_SUFFIXES and path.is_file() and not path.stat().st_size:
        return empty_recording()  # text without lines
    _, form = detect_format(path, EVENT_FORMATS, "file of events")
    assert form.read is not None
    given = {name: value for name, value in options.items() if value is not None and value != ()}
    for name, value in given.items():
        if name not in form.read_options and name != "shape":
            raise ParameterError(name, f"is not an option of {form.title} files", value, hint="omit it")
    given = {name: value for name, value in given.items() if name in form.read_options}
    if given.get("time_unit", "s") not in TIME_UNITS:
        raise ParameterError("time_unit", f"must be one of {', '.join(TIME_UNITS)}", given["time_unit"])
    with as_file_error(path, "file of events", passes=(FileError,)):
        found = form.read(path, **given)
        if not isinstance(found, Recording):
            raise FormatError("must be read as a recording")
        return found.checked()
