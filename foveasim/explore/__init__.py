"""Many cameras: sweeps over the settings of a shot, on the cores of this machine or on a dask scheduler."""

from __future__ import annotations

from foveasim.explore._metrics import METRICS, Metric, metric_of
from foveasim.explore._plan import Plan, plan_sweep, read_sweep
from foveasim.explore._results import open_results
from foveasim.explore._sweep import run_sweep, sweep

__all__ = ["METRICS", "Metric", "Plan", "metric_of", "open_results", "plan_sweep", "read_sweep", "run_sweep", "sweep"]
