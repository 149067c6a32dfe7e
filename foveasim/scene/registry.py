"""Registry of scenes and charts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from foveasim._core.registry import Registry

__all__ = ["EXAMPLE_PICTURE", "SCENES", "chart"]

F = TypeVar("F", bound=Callable[..., Any])

#: Functions that return a :class:`foveasim.Scene`, by their names in settings files. Installed packages add functions as
#: entry points of the group ``foveasim.scenes``.
SCENES: Registry[Callable[..., Any]] = Registry("scene", "foveasim.scenes")
#: Documentation of the common parameters of charts, which replaces ``{picture}`` in their docstrings.
PICTURE_PARAMETERS = """shape : (n_y, n_x)
        Number of pixels.
    pitch_um : float, µm
        Pixel pitch in the scene.
    distance_m : float, m
        Distance of the scene from the lens.
    radiance_w_m2_sr_nm : number, or one per wavelength, W/(m² sr nm)
        Spectral radiance of white.
    wavelength_nm : sequence, nm
        Wavelengths.
    band_width_nm : number or sequence, optional, nm
        Widths of the bands; by default bands extend halfway to the adjacent wavelengths. Required for one wavelength."""


#: Common parameters of the examples of charts: 80 x 60 pixels of 0.1 mm.
EXAMPLE_PICTURE: dict[str, Any] = {"shape": (60, 80), "pitch_um": 100.0, "distance_m": 1.0, "band_width_nm": 10.0}


def chart(name: str, *, example: Mapping[str, Any], expected: Sequence[str]) -> Callable[[F], F]:
    """
    Register a chart function and insert the common parameters into its docstring.

    The example is completed by :data:`EXAMPLE_PICTURE` and a radiance.
    """

    def decorate(function: F) -> F:
        function.__doc__ = (function.__doc__ or "").replace("{picture}", PICTURE_PARAMETERS)
        complete = {**EXAMPLE_PICTURE, "radiance_w_m2_sr_nm": 2.0, **example}
        return SCENES.register(name, function, example=complete, expected=expected)  # type: ignore[return-value]

    return decorate
