"""Reading of layouts, captures and reports of design-rule checks, for viewers."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foveasim._core.short_repr import short_repr
from foveasim._io.zarr_stores import store_format
from foveasim.capture import Capture
from foveasim.columns import STORED
from foveasim.config._objects import read_any_layout, read_rules
from foveasim.errors import FileError, ParameterError, printable
from foveasim.layout import Layout, Report
from foveasim.layout.drc.report import is_lyrdb, read_lyrdb

#: Arrays of a capture's npz file that a layout's does not contain.
CAPTURE_ARRAYS = {f"{name}.npy" for name in STORED}


@dataclass(frozen=True)
class Viewable:
    """A layout or capture, the report of its design-rule check, and a title."""

    data: Layout | Capture
    report: Report | None
    name: str

    __repr__ = short_repr


def read_viewable(
    path: str | Path, *, layout: str | Path | None = None, rules: str | Path | None = None, **options: Any
) -> Viewable:
    """
    Read a layout, a capture, or a report of a design-rule check.

    Parameters
    ----------
    path : path
        A layout in any format, or the name of a bundled one; a capture (``.npz``, ``.zarr``); or a report (``.lyrdb``).
    layout : path, optional
        Layout of a report.
    rules : path or name of a preset, optional
        Design rules to check.
    **options
        Options of the layout's format, as for :func:`foveasim.read_layout`.

    Raises
    ------
    FileError
        When a file is missing, corrupt, or of another kind.
    ParameterError
        When a report is given without its layout or with rules, another file with a layout, or a capture with options.

    Examples
    --------
    >>> import foveasim as fs
    >>> view = fs.config.read_viewable("four_zones", rules="paper")
    >>> view.name, view.report.ok
    ('four_zones', True)
    """
    path = Path(path)
    if is_lyrdb(path):
        if layout is None:
            raise ParameterError("layout", f"must be given: the report {path} does not contain its layout")
        if rules is not None:
            raise ParameterError(
                "rules", "must be omitted for a report, which contains the results of a check", str(rules)
            )
        layout_of_report = read_any_layout(layout, **options).layout
        return Viewable(layout_of_report, read_lyrdb(path, layout_of_report.n_sites), printable(path.stem))
    if layout is not None:
        raise ParameterError("layout", f"must be omitted: {path} is not a report (.lyrdb)", str(layout))
    limits = None if rules is None else read_rules(rules)
    if _is_capture(path):
        for name in options:
            raise ParameterError(
                name, f"must be omitted: {printable(str(path))} is a capture, which contains its layout"
            )
        capture = Capture.load(path)
        return Viewable(capture, None if limits is None else capture.layout.check(limits), printable(path.stem))
    found = read_any_layout(path, **options).layout
    return Viewable(found, None if limits is None else found.check(limits), printable(path.stem))


def _is_capture(path: Path) -> bool:
    """Return whether a file or zarr store is a capture."""
    if path.is_dir():
        return store_format(path) is not None
    if not path.is_file() or not zipfile.is_zipfile(path):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist()) >= CAPTURE_ARRAYS
    except (OSError, zipfile.BadZipFile) as error:
        raise FileError(path, f"is corrupt ({error})") from None
