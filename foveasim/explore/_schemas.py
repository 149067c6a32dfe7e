"""JSON schemas of the files that the program reads, of the models that it reads them with."""

from __future__ import annotations

from typing import Any

from foveasim._core.validation import check_choice
from foveasim.config import schema
from foveasim.explore.datasets.plan import DatasetSection
from foveasim.explore.studies.plan import StudySection
from foveasim.explore.sweeps.plan import SweepSection

__all__ = ["schema_of"]

#: Sorts of files, with their models.
FILES: dict[str, Any] = {"sweep": SweepSection, "study": StudySection, "dataset": DatasetSection}


def schema_of(kind: str) -> dict[str, Any]:
    """
    JSON schema of a file.

    Parameters
    ----------
    kind : {"shot", "sweep", "study", "dataset"}

    Raises
    ------
    ParameterError
        When it is none of these.
    """
    check_choice("kind", kind, ("shot", *FILES))
    return schema(FILES[kind], f"foveasim {kind}") if kind in FILES else schema()
