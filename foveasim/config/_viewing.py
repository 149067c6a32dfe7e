"""What a file holds that can be looked at: a layout, a capture, or a report of a layout's check."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

from foveasim._io.zarr_stores import store_format
from foveasim.capture import Capture
from foveasim.config import read_any_layout, read_rules
from foveasim.errors import FileError, ParameterError, printable
from foveasim.layout import Layout, Report
from foveasim.layout.drc.report import is_lyrdb, read_lyrdb

__all__ = ["Viewable", "read_viewable"]

#: Arrays that a file of numpy arrays has when it is a capture, and a layout has not.
CAPTURE_ARRAYS = {"code.npy", "electrons.npy"}


@dataclass(frozen=True)
class Viewable:
    """A layout or a capture, the report of a check of its layout, and a heading."""

    data: Layout | Capture
    report: Report | None
    name: str


def read_viewable(path: str | Path, *, layout: str | Path | None = None, rules: str | Path | None = None) -> Viewable:
    """
    Read a file of whatever can be looked at.

    Parameters
    ----------
    path : path
        A layout in any format, or the name of a shipped one; a capture (``.npz``, ``.zarr``); or a report (``.lyrdb``).
    layout : path, optional
        The layout that a report is of.
    rules : path or name of a preset, optional
        To check the layout against.

    Raises
    ------
    FileError
        When a file is missing, broken, or of another kind.
    ParameterError
        When a report comes without its layout, another file with one, or a report with rules.
    """
    path = Path(path)
    if is_lyrdb(path):
        if layout is None:
            raise ParameterError("layout", f"must be given: the report {path} does not hold the layout that it is of")
        if rules is not None:
            raise ParameterError("rules", "cannot be given with a report, which is of a check already made", str(rules))
        checked = read_any_layout(layout).layout
        return Viewable(checked, read_lyrdb(path, checked.n_sites), printable(path.stem))
    if layout is not None:
        raise ParameterError("layout", f"belongs to a report (.lyrdb), and {path} is none", str(layout))
    limits = None if rules is None else read_rules(rules)
    if _is_capture(path):
        capture = Capture.load(path)
        return Viewable(capture, None if limits is None else capture.layout.check(limits), printable(path.stem))
    found = read_any_layout(path).layout
    return Viewable(found, None if limits is None else found.check(limits), printable(path.stem))


def _is_capture(path: Path) -> bool:
    """Whether a file or a zarr store is a capture, rather than a layout."""
    if path.is_dir():
        return store_format(path) is not None
    if not path.is_file() or not zipfile.is_zipfile(path):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist()) >= CAPTURE_ARRAYS
    except (OSError, zipfile.BadZipFile) as error:
        raise FileError(path, f"is corrupt ({error})") from None
