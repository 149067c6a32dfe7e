"""Shots: from settings to the files that a user looks at, and the demo's own settings."""

from __future__ import annotations

from foveasim.shots._shots import Result, check_folder, demo_settings, results_table, run_shot, write_results
from foveasim.shots._video import run_video
from foveasim.shots._viewing import Viewable, read_viewable

__all__ = [
    "Result",
    "Viewable",
    "check_folder",
    "demo_settings",
    "read_viewable",
    "results_table",
    "run_shot",
    "run_video",
    "write_results",
]
