"""Models of real cameras: simulated pictures beside real ones."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.twin.pictures import Deviation, PictureComparison, compare_with

__all__ = ["Deviation", "PictureComparison", "compare_with"]

publish(__name__)
