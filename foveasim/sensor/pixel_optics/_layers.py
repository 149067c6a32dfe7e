"""Layers of a pixel stack: refraction and displacement of rays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.validation import Floats, read_only
from foveasim.errors import ParameterError

#: Heights and refractive indices of layers; a smaller index than that of air would reflect rays totally.
HEIGHT = Limits(at_least=0.0, at_most=1e4, hint="heights of layers are in µm")
INDEX = Limits(at_least=1.0, at_most=5.0, hint="1 for air, 1.46 for silicon oxide, 3.5 for silicon in the infrared")


class Layers(NamedTuple):
    """Heights (n_layer,) µm and refractive indices (n_layer,) of a stack, the top layer first."""

    height_um: Floats
    refractive_index: Floats

    @classmethod
    def of(cls, height_um: float | Sequence[float], refractive_index: float | Sequence[float]) -> Layers:
        """
        Return layers of validated heights and indices; one of each stands for one layer.

        Raises ParameterError when a value is out of range, or the numbers of heights and indices differ.
        """
        heights_um = np.atleast_1d(HEIGHT.check_array("height_um", height_um))
        index = np.atleast_1d(INDEX.check_array("refractive_index", refractive_index))
        if heights_um.ndim > 1 or index.ndim > 1 or not heights_um.size:
            raise ParameterError(
                "height_um", "and 'refractive_index' must be numbers, or lists of one number per layer"
            )
        if heights_um.size != index.size:
            rule = f"must have one value for each of the {heights_um.size} heights, got {index.size}"
            raise ParameterError("refractive_index", rule)
        return cls(read_only(heights_um), read_only(index))

    @property
    def squared_index(self) -> Floats:
        """Squared refractive indices, (n_layer,)."""
        return self.refractive_index**2

    def displacements_um(self, tangents: Floats) -> Floats:
        """
        Compute the lateral displacements of rays from top to bottom.

        ``tangents`` (..., 2): rays above the stack, in air. Returns (..., 2) µm: the sum of the heights times the tangents
        ``t / sqrt(n² (1 + t²) - t²)`` in each layer, by Snell's law.
        """
        squared = np.square(tangents).sum(axis=-1)[..., np.newaxis]
        per_tangent = self.height_um / np.sqrt(self.squared_index * (1.0 + squared) - squared)
        return np.asarray(tangents * per_tangent.sum(axis=-1, keepdims=True))


def as_layers(instance: Any) -> Layers:
    """Return the layers of pixel optics, and store valid heights and indices."""
    layers = Layers.of(instance.height_um, instance.refractive_index)
    for name, array in layers._asdict().items():
        value = tuple(array.tolist()) if np.ndim(getattr(instance, name)) else float(array[0])
        object.__setattr__(instance, name, value)
    return layers
