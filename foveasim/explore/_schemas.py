"""JSON schemas of settings files, derived from the models that validate them."""

from __future__ import annotations

from typing import Any

from foveasim._core.validation import check_choice
from foveasim.config import schema
from foveasim.explore.datasets.plan import DatasetSection
from foveasim.explore.studies.plan import StudySection
from foveasim.explore.sweeps.plan import SweepSection

#: Models of the file kinds; the first three depend on registered extensions.
FILES: dict[str, Any] = {
    "shot": "shot",
    "layout": "layout",
    "rules": "rules",
    "sweep": SweepSection,
    "study": StudySection,
    "dataset": DatasetSection,
}


def schema_of(kind: str) -> dict[str, Any]:
    """
    Return the JSON schema of a file kind.

    Parameters
    ----------
    kind : {"shot", "layout", "rules", "sweep", "study", "dataset"}

    Examples
    --------
    >>> import foveasim as fs
    >>> list(fs.explore.schema_of("sweep")["properties"])
    ['shot', 'set', 'vary', 'points', 'mode', 'repeats', 'seed', 'metrics', 'results']
    """
    check_choice("kind", kind, FILES)
    return schema(FILES[kind], f"foveasim {kind}")
