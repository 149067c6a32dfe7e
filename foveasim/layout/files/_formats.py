"""Table of layout formats."""

from __future__ import annotations

from foveasim._core.registry import Registry
from foveasim._io.formats import FileFormat

__all__ = ["FORMATS"]

#: Formats of layout files. ``read(path, **options)`` returns a :class:`foveasim.Layout`, ``write(layout, path, **options)`` a
#: :class:`foveasim.layout.WrittenLayout`. Installed packages add formats as entry points of the group ``foveasim.formats``.
FORMATS: Registry[FileFormat] = Registry("layout format", "foveasim.formats")
