"""Shots: from settings to the files that a user looks at, and the demo's own settings."""

from __future__ import annotations

from foveasim.shots._shots import demo_settings, results_table, take, write_results

__all__ = ["demo_settings", "results_table", "take", "write_results"]
