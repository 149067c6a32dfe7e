"""
Settings files in YAML: shots, layouts and design rules, and their JSON schema.

Each section names a call of the package and its parameters: file and Python have the same names, defaults and limits.
"""

from __future__ import annotations

from foveasim._core.calls import Limits, Usual, Words, publish
from foveasim.config._comparing import compare_files
from foveasim.config._new_sensor import write_sensor_files
from foveasim.config._objects import (
    YAML_EXTENSIONS,
    LayoutFile,
    Shot,
    build_shot,
    check_settings,
    get_setting,
    picture_path,
    put_setting,
    read_any_layout,
    read_layout,
    read_layout_file,
    read_rules,
    read_settings,
    read_shot,
    resolve_files,
    schema,
)
from foveasim.config._problems import plain_settings, validate
from foveasim.config._python import to_python
from foveasim.config._requirements import RegionResult, Requirement
from foveasim.config._shots import (
    Result,
    check_directory,
    demo_settings,
    results_table,
    run_shot,
    write_3d_picture,
    write_results,
)
from foveasim.config._sources import Source
from foveasim.config._starting_files import STARTING_FILES, starting_command, starting_file, write_starting_file
from foveasim.config._video import run_video
from foveasim.config._viewing import Viewable, read_viewable
from foveasim.layout import bundled_layouts

__all__ = [
    "STARTING_FILES",
    "YAML_EXTENSIONS",
    "LayoutFile",
    "Limits",
    "RegionResult",
    "Requirement",
    "Result",
    "Shot",
    "Source",
    "Usual",
    "Viewable",
    "Words",
    "build_shot",
    "bundled_layouts",
    "check_directory",
    "check_settings",
    "compare_files",
    "demo_settings",
    "get_setting",
    "picture_path",
    "plain_settings",
    "put_setting",
    "read_any_layout",
    "read_layout",
    "read_layout_file",
    "read_rules",
    "read_settings",
    "read_shot",
    "read_viewable",
    "resolve_files",
    "results_table",
    "run_shot",
    "run_video",
    "schema",
    "starting_command",
    "starting_file",
    "to_python",
    "validate",
    "write_3d_picture",
    "write_results",
    "write_sensor_files",
    "write_starting_file",
]

publish(__name__)
