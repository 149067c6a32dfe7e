"""
Settings files: YAML to the package's objects, and the JSON schema of what may stand in them.

A file names a call of the package and its parameters: the file and the Python call have the same names, defaults and limits.
"""

from __future__ import annotations

from foveasim.config._models import GENERATORS
from foveasim.config._objects import (
    YAML_ENDINGS,
    LayoutFile,
    Shot,
    build_shot,
    check_settings,
    files_from,
    picture_path,
    put_setting,
    read_any_layout,
    read_layout_file,
    read_rules,
    read_settings,
    read_shot,
    schema,
)
from foveasim.config._problems import validated
from foveasim.layout import shipped_layouts

__all__ = [
    "GENERATORS",
    "YAML_ENDINGS",
    "LayoutFile",
    "Shot",
    "build_shot",
    "check_settings",
    "files_from",
    "picture_path",
    "put_setting",
    "read_any_layout",
    "read_layout_file",
    "read_rules",
    "read_settings",
    "read_shot",
    "schema",
    "shipped_layouts",
    "validated",
]
