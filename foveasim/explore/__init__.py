"""Parameter sweeps, optimisation studies and simulated image datasets."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.explore._metrics import import_metric
from foveasim.explore._schemas import schema_of
from foveasim.explore.datasets.dataset import Dataset
from foveasim.explore.datasets.distributions import parse_distribution
from foveasim.explore.datasets.plan import DatasetFile, read_dataset
from foveasim.explore.datasets.pytorch import torch_dataset
from foveasim.explore.datasets.recipes import classification, denoising
from foveasim.explore.datasets.store import StoredSamples, open_dataset, write_dataset
from foveasim.explore.requirements import CheckedRequirement, ResultMetric, check_requirements, result_of
from foveasim.explore.solving import Solution, solve
from foveasim.explore.studies.plan import StudyPlan, plan_study, read_study
from foveasim.explore.studies.study import best_table, run_study, storage_name, study
from foveasim.explore.studies.trials import finished_trials, trials_table
from foveasim.explore.sweeps.plan import Plan, plan_sweep, read_sweep
from foveasim.explore.sweeps.results import open_results
from foveasim.explore.sweeps.sweep import run_sweep, sweep

__all__ = [
    "CheckedRequirement",
    "Dataset",
    "DatasetFile",
    "Plan",
    "ResultMetric",
    "Solution",
    "StoredSamples",
    "StudyPlan",
    "best_table",
    "check_requirements",
    "classification",
    "denoising",
    "finished_trials",
    "import_metric",
    "open_dataset",
    "open_results",
    "parse_distribution",
    "plan_study",
    "plan_sweep",
    "read_dataset",
    "read_study",
    "read_sweep",
    "result_of",
    "run_study",
    "run_sweep",
    "schema_of",
    "solve",
    "storage_name",
    "study",
    "sweep",
    "torch_dataset",
    "trials_table",
    "write_dataset",
]

publish(__name__)
