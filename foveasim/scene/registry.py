"""Registry of scenes and charts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from foveasim._core.registry import Registry

__all__ = ["SCENES", "chart"]

F = TypeVar("F", bound=Callable[..., Any])

#: Functions that give a :class:`foveasim.Scene`, by their names in settings files. Installed packages add theirs as entry
#: points of the group ``foveasim.scenes``.
SCENES: Registry[Callable[..., Any]] = Registry("scene", "foveasim.scenes")
#: What the docstring of a chart has in place of ``{picture}``: the parameters that all charts have.
PICTURE = """shape : (n_y, n_x)
        Numbers of pixels.
    pitch_um : float, µm
        Pixel pitch in the scene.
    distance_m : float, m
        Distance of the scene from the lens.
    radiance_w_m2_sr_nm : number, or one per wavelength, W/(m² sr nm)
        Spectral radiance of white.
    wavelength_nm : sequence, nm
        Wavelengths.
    band_width_nm : number or sequence, optional, nm
        Widths of the wavelengths' bands; by default they reach halfway to the neighbours. Needed for one wavelength."""


def chart(name: str) -> Callable[[F], F]:
    """Decorate a chart: register it, and complete its docstring by the parameters that all charts have."""

    def decorate(function: F) -> F:
        function.__doc__ = (function.__doc__ or "").replace("{picture}", PICTURE)
        return SCENES.register(name, function)  # type: ignore[return-value]

    return decorate
