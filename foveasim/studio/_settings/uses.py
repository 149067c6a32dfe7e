"""Settings that a dropped file is for, from its content."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from foveasim._io.formats import read_head
from foveasim._io.images import PICTURE_EXTENSIONS
from foveasim._io.npz import archive_format
from foveasim._io.yaml_files import read_yaml
from foveasim.config import YAML_EXTENSIONS, schema
from foveasim.errors import FileError
from foveasim.layout.files import FORMATS
from foveasim.maps import MAP_FORMATS
from foveasim.optics import PSF_FORMATS
from foveasim.scene.cubes import CUBE_FORMATS
from foveasim.twin.frames.result import FILE_FORMAT as TWIN_FORMAT
from foveasim.video import GazePath

__all__ = ["PLACES", "Use", "use_of"]

Use = Literal["scene", "layout", "settings", "gaze", "calibration", "psfs", "map", "cube", "twin"]
#: Setting of each use that is a section with a file, and the label of the section among its choices.
PLACES: dict[Use, tuple[str, str]] = {
    "calibration": ("distortion", "calibration"),
    "psfs": ("optics.psfs", "PSFs"),
    "map": ("scene", "power map"),
    "cube": ("scene", "cube"),
    "layout": ("layout", "layout file"),
}
#: Tables of formats, and the word for their archives of arrays in their metadata.
TABLES: dict[Use, tuple[Any, str]] = {
    "layout": (FORMATS, "layout"), "psfs": (PSF_FORMATS, "PSFs"), "map": (MAP_FORMATS, ""), "cube": (CUBE_FORMATS, ""),
}  # fmt: skip
#: Keys of the files of layouts, and of lists of PSFs.
LAYOUT_KEYS, PSF_KEYS = {"generator", "file"}, {"psfs"}
BYTE_ORDER_MARK, ZIP = b"\xef\xbb\xbf", b"PK"


def use_of(path: Path) -> Use:
    """
    Return what a file is for.

    Raises FileError when the content can be of several kinds, which only the user knows.
    """
    head = read_head(path)
    text = head.removeprefix(BYTE_ORDER_MARK).lstrip()
    if path.suffix.lower() in YAML_EXTENSIONS:
        return _use_of_yaml(path)
    if text.startswith(b"{"):
        return "layout" if b'"FeatureCollection"' in path.read_bytes() else "calibration"
    if text.startswith((b"<?xml", b"<opencv_storage")) or b"polynomial coefficients" in text:
        return "calibration"
    found = [use for use, (table, _) in TABLES.items() if _is_of(table, path, head)]
    if head.startswith(ZIP) and found:
        if (name := archive_format(path)) == TWIN_FORMAT:
            return "twin"
        return next((use for use in found if name == f"foveasim {TABLES[use][1]}"), "map")  # of other programs, too
    if len(found) == 1:
        return found[0]
    if path.suffix.lower() in PICTURE_EXTENSIONS:
        return "scene"
    first = text.partition(b"\n")[0].decode("latin-1").strip().lower()
    if set(first.split(",")).issuperset(GazePath.COLUMNS):
        return "gaze"
    if first.isprintable() and not found:
        raise FileError(path, "is a text; choose it in the list of the setting that it is for, such as qe or filters")
    places = " or ".join(f"{PLACES[use][0]} ({PLACES[use][1]})" for use in found if use in PLACES)
    if not places:
        return "scene"  # whose reader explains what is wrong
    raise FileError(path, f"can have several meanings; choose it in the list of the setting {places}")


def _is_of(table: Any, path: Path, head: bytes) -> bool:
    return any(form.read is not None and form.matches_file(path, head) for form in table.values())


def _use_of_yaml(path: Path) -> Use:
    keys = set(read_yaml(path))
    if keys & LAYOUT_KEYS:
        return "layout"
    if keys & PSF_KEYS:
        return "psfs"
    return "settings" if keys & set(schema()["properties"]) else "calibration"
