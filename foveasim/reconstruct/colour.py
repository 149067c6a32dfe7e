"""Colour correction of pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from foveasim._core.validation import Floats, as_numbers, finite_array, frozen_array
from foveasim.errors import ParameterError

#: Patches of the colour chart.
N_PATCHES = 24


def check_matrix(name: str, matrix: Floats, n_channels: int | None = None) -> Floats:
    """Return a colour-correction matrix (3, n_channel), read-only, or raise a ParameterError."""
    found = finite_array(name, matrix, ndim=2)
    if found.shape[0] != 3 or n_channels not in (None, found.shape[1]):
        columns = "n_channel" if n_channels is None else n_channels
        raise ParameterError(name, f"must have the shape (3, {columns}), got {found.shape}")
    return frozen_array(found)


@dataclass(frozen=True, eq=False)
class ColourCorrection:
    """
    Colour correction of the values of colour filters, and the colour errors that remain.

    Attributes
    ----------
    matrix : (3, n_filter) float64
        Linear red, green and blue (sRGB) of white-balanced values, ``matrix @ (values / white)``. White stays white.
    delta_e : (24,) float64
        Colour difference ΔE*ab (CIE 1976) of each patch of the colour chart to its colour, after the correction and without
        noise: :data:`foveasim.scene.charts.PATCH_NAMES`.
    delta_e_raw : (24,) float64
        That of the white-balanced values of three filters, when they are shown as red, green and blue; NaN for other numbers of
        filters.
    """

    matrix: Floats
    delta_e: Floats
    delta_e_raw: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", check_matrix("matrix", self.matrix))
        for name, missing_is_nan in (("delta_e", False), ("delta_e_raw", True)):
            values = as_numbers(name, getattr(self, name), missing_is_nan=missing_is_nan)
            if values.shape != (N_PATCHES,) or not (np.isfinite(values) | missing_is_nan).all():
                raise ParameterError(name, f"must be {N_PATCHES} finite values, one for each patch", values)
            object.__setattr__(self, name, frozen_array(values))

    def __repr__(self) -> str:
        raw = "" if np.isnan(self.delta_e_raw).any() else f"; raw: mean {self.delta_e_raw.mean():.3g}"
        return (
            f"ColourCorrection({self.matrix.shape[1]} filters, ΔE*ab of the patches: mean {self.delta_e.mean():.3g}, "
            f"maximum {self.delta_e.max():.3g}{raw})"
        )

    def to_settings(self) -> dict[str, Any]:
        """Return plain data, without the differences of raw values if these are unknown."""
        raw = {} if np.isnan(self.delta_e_raw).any() else {"delta_e_raw": self.delta_e_raw.tolist()}
        return {"matrix": self.matrix.tolist(), "delta_e": self.delta_e.tolist(), **raw}

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> ColourCorrection | None:
        """
        Return the correction in the settings of a capture, None if there is none.

        Raises
        ------
        ParameterError
            When the settings are invalid, as in a damaged file.
        """
        found = settings.get("colour")
        if found is None:
            return None
        if not isinstance(found, Mapping) or not {"matrix", "delta_e"} <= set(found):
            raise ParameterError("settings", "must contain 'matrix' and 'delta_e' under 'colour'", found)
        return cls(found["matrix"], found["delta_e"], found.get("delta_e_raw", np.full(N_PATCHES, np.nan)))
