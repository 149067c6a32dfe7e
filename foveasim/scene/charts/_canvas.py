"""Common parts of the charts: raster, radiance of white, and exact means over pixels."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NotRequired, TypedDict, TypeVar, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import FRACTION, Limits, check_arguments, check_declared, without_declarations
from foveasim._core.validation import Bools, Floats, check_shape, freeze
from foveasim.errors import ParameterError, SamplingWarning, warn
from foveasim.scene._photometry import level_of_white
from foveasim.scene._scene import DISTANCE, PITCH, RADIANCE, Scene, scene_bands
from foveasim.scene.registry import SCENES
from foveasim.units import m_from_um

F = TypeVar("F", bound=Callable[..., Scene])
#: A number, or one for each wavelength.
OneOrMore = float | Sequence[float]
Fractions = NDArray[np.float32]

HALF_TURN = Limits(at_least=-180.0, at_most=180.0)
#: Pixels per block: a few float64 arrays of this size fit into the processor cache.
BLOCK_PIXELS = 2**18
#: Samples along each side of a pixel without a closed-form mean.
SAMPLES = 32
#: Nyquist limit of patterns.
MIN_PIXELS_PER_PERIOD = 2.0
#: Relative tolerance of sizes: rounding errors.
ROUNDING = 1e-9
#: Common part of the examples of charts: 80 x 60 pixels of 0.1 mm.
EXAMPLE_PICTURE = {
    "shape": (60, 80),
    "pitch_um": 100.0,
    "distance_m": 1.0,
    "radiance_w_m2_sr_nm": 2.0,
    "band_width_nm": 10.0,
}
#: Documentation of the parameters of the canvas.
PARAMETERS = {
    "contrast": "contrast : float\n        (white - black) / (white + black).",
    "shape": "shape : (n_y, n_x)\n        Number of pixels.",
    "pitch_um": "pitch_um : float, µm\n        Pixel pitch in the scene.",
    "distance_m": "distance_m : float, m\n        Distance of the scene from the lens.",
    "radiance_w_m2_sr_nm": "radiance_w_m2_sr_nm : number, or one per wavelength, W/(m² sr nm)\n"
    "        Spectral radiance of white.",
    "luminance_cd_m2": "luminance_cd_m2 : float, cd/m²\n        Luminance of white, instead of its radiance.",
    "illuminance_lux": "illuminance_lux, reflectance : float, lx\n"
    "        Illuminance of the chart, instead of the radiance, and reflectance of its white, a diffuse surface.",
    "wavelength_nm": "wavelength_nm : sequence, optional, nm\n"
    "        Wavelengths; by default one band at 550 nm with a width of 100 nm.",
    "band_width_nm": "band_width_nm : number or sequence, optional, nm\n"
    "        Widths of the bands; by default bands extend halfway to the adjacent wavelengths. Required for one wavelength.",
}
RETURNS = "\n\n    Returns\n    -------\n    scene : Scene\n        One basis image."


class Raster(TypedDict):
    """Parameters of all charts, as in :class:`Canvas`."""

    shape: tuple[int, int]
    pitch_um: float
    distance_m: float
    band_width_nm: NotRequired[OneOrMore | None]


class Picture(Raster):
    """Parameters of charts with a radiance of white."""

    radiance_w_m2_sr_nm: NotRequired[OneOrMore | None]
    luminance_cd_m2: NotRequired[float | None]
    illuminance_lux: NotRequired[float | None]
    reflectance: NotRequired[float]
    wavelength_nm: NotRequired[Sequence[float] | None]


class Pattern(Picture):
    """Parameters of charts with a contrast that is 1 by default."""

    contrast: NotRequired[float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Canvas:
    """Raster of a chart, radiance of white, and Michelson contrast."""

    contrast: Annotated[float, FRACTION] = 1.0
    shape: tuple[int, int]
    pitch_um: Annotated[float, PITCH]
    distance_m: Annotated[float, DISTANCE]
    radiance_w_m2_sr_nm: OneOrMore | None = None
    luminance_cd_m2: float | None = None
    illuminance_lux: float | None = None
    reflectance: float = 1.0
    wavelength_nm: Sequence[float] | None = None
    band_width_nm: OneOrMore | None = None

    def __post_init__(self) -> None:
        check_declared(self)
        waves_nm, widths_nm = scene_bands(self.wavelength_nm, self.band_width_nm)
        given = self.radiance_w_m2_sr_nm
        radiance = np.ones(1) if given is None else RADIANCE.check_array("radiance_w_m2_sr_nm", given)
        if radiance.ndim > 1 or radiance.size not in (1, waves_nm.size):
            raise ParameterError(
                "radiance_w_m2_sr_nm", f"must be one number, or one for each of the {waves_nm.size} wavelengths"
            )
        radiance = np.broadcast_to(radiance, waves_nm.shape)
        level = level_of_white(
            "radiance_w_m2_sr_nm",
            None if given is None else 1.0,
            radiance,
            waves_nm,
            widths_nm,
            luminance_cd_m2=self.luminance_cd_m2,
            illuminance_lux=self.illuminance_lux,
            reflectance=self.reflectance,
        )
        for name, value in {
            "shape": check_shape("shape", self.shape),
            "radiance_w_m2_sr_nm": level * radiance,
            "wavelength_nm": waves_nm,
            "band_width_nm": widths_nm,
        }.items():
            object.__setattr__(self, name, value)

    @property
    def pitch_mm(self) -> float:
        """Pixel pitch, mm."""
        return 1e3 * float(m_from_um(self.pitch_um))

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the picture, mm."""
        return self.shape[1] * self.pitch_mm, self.shape[0] * self.pitch_mm

    @property
    def x_edges_mm(self) -> Floats:
        """Boundaries of the columns (n_x + 1,), relative to the centre of the picture."""
        return np.asarray((np.arange(self.shape[1] + 1) - 0.5 * self.shape[1]) * self.pitch_mm)

    @property
    def y_edges_mm(self) -> Floats:
        """Boundaries of the rows (n_y + 1,), bottom first."""
        return np.asarray((np.arange(self.shape[0] + 1) - 0.5 * self.shape[0]) * self.pitch_mm)

    @property
    def x_mm(self) -> Floats:
        """Centres of the columns (n_x,)."""
        return np.asarray((np.arange(self.shape[1]) - 0.5 * (self.shape[1] - 1)) * self.pitch_mm)

    @property
    def y_mm(self) -> Floats:
        """Centres of the rows (n_y,), bottom first."""
        return np.asarray((np.arange(self.shape[0]) - 0.5 * (self.shape[0] - 1)) * self.pitch_mm)

    def row_blocks(self) -> Iterator[slice]:
        """Yield blocks of rows that fit into the cache."""
        n_rows = max(1, BLOCK_PIXELS // self.shape[1])
        yield from (slice(i, min(i + n_rows, self.shape[0])) for i in range(0, self.shape[0], n_rows))

    def fill(self, function: Callable[[slice], Floats]) -> Fractions:
        """Return a raster (n_y, n_x) float32 of the fractions of white in blocks of rows."""
        fractions = np.empty(self.shape, np.float32)
        for rows in self.row_blocks():
            np.clip(function(rows), 0.0, 1.0, out=fractions[rows], casting="same_kind")
        return fractions

    def check_fits(self, name: str, width_mm: float, height_mm: float) -> None:
        """Reject a chart, whose size the parameter ``name`` determines, beyond the picture."""
        picture_width_mm, picture_height_mm = self.size_mm
        if width_mm > picture_width_mm * (1 + ROUNDING) or height_mm > picture_height_mm * (1 + ROUNDING):
            raise ParameterError(
                name,
                f"must yield a chart within the picture of {picture_width_mm:.4g} x {picture_height_mm:.4g} mm, "
                f"got {width_mm:.4g} x {height_mm:.4g} mm",
            )

    def radius_mm(self, radius_mm: float | None) -> float:
        """Return the radius of a round chart, by default the largest that fits."""
        if radius_mm is None:
            return 0.5 * min(self.size_mm)
        self.check_fits("radius_mm", 2.0 * radius_mm, 2.0 * radius_mm)
        return radius_mm

    def warn_if_fine(self, name: str, period_mm: float) -> None:
        """Warn of fewer than two pixels per period."""
        n_pixels = period_mm / self.pitch_mm
        if n_pixels < MIN_PIXELS_PER_PERIOD * (1 - ROUNDING):
            warn(
                f"'{name}' yields {n_pixels:.3g} pixels per period in the finest part of the pattern, which averages to grey "
                f"below 2; use a coarser pattern, or a pixel pitch of at most {500.0 * period_mm:.4g} µm",
                SamplingWarning,
            )

    def scene(self, fractions: Fractions, source: str) -> Scene:
        """
        Return the scene of a chart in black and white.

        ``fractions`` (n_y, n_x) float32: fraction of white in each pixel; overwritten. ``source``: description of the chart.
        """
        black = (1.0 - self.contrast) / (1.0 + self.contrast)
        fractions *= np.float32(1.0 - black)
        fractions += np.float32(black)
        return self.scene_of(fractions[np.newaxis], np.asarray(self.radiance_w_m2_sr_nm)[np.newaxis], source)

    def scene_of(
        self, basis: Fractions, spectrum_w_m2_sr_nm: Floats, source: str, illuminant: Floats | None = None
    ) -> Scene:
        """
        Return the scene of basis images and their spectra.

        The images (n_basis, n_y, n_x) are not copied; the spectra are (n_basis, n_wavelength), the illuminant (n_wavelength,).
        """
        return Scene(
            freeze(basis),
            spectrum_w_m2_sr_nm,
            np.asarray(self.wavelength_nm),
            np.asarray(self.band_width_nm),
            self.pitch_um,
            self.distance_m,
            source=source,
            illuminant=illuminant,
        )


def ink_to_white(fractions: Fractions, ink: str) -> Fractions:
    """Convert fractions of ink to fractions of white, in place."""
    if ink == "dark":
        np.subtract(np.float32(1.0), fractions, out=fractions)
    return fractions


def chart(name: str, *, example: Mapping[str, Any], expected: Sequence[str]) -> Callable[[F], F]:
    """
    Register a chart with parameters of the canvas, such as ``**picture``, the last ones.

    They replace it in the signature, and ``{picture}`` in the docstring, followed by the usual result if there is no other.
    The example is completed by :data:`EXAMPLE_PICTURE`.
    """

    def decorate(function: F) -> F:
        hints, signature = get_type_hints(function, include_extras=True), inspect.signature(function)
        *own, rest = signature.parameters.values()
        names = get_args(hints.pop(rest.name))[0].__annotations__
        common = [each for each in inspect.signature(Canvas).parameters.values() if each.name in names]
        signature = signature.replace(
            parameters=[each.replace(annotation=without_declarations(each.annotation)) for each in (*own, *common)]
        )
        types = get_type_hints(Canvas, include_extras=True)
        function.__signature__ = signature  # type: ignore[attr-defined]
        function.__annotations__ = {**{each.name: types[each.name] for each in common}, **hints}
        described, text = (
            "\n    ".join(PARAMETERS[each.name] for each in common if each.name in PARAMETERS),
            function.__doc__ or "",
        )
        function.__doc__ = text.replace("{picture}", described if "Returns\n" in text else described + RETURNS)
        complete = {key: value for key, value in EXAMPLE_PICTURE.items() if key in signature.parameters} | {**example}
        return SCENES.register(name, check_arguments(function), example=complete, expected=expected)  # type: ignore[return-value]

    return decorate


def interval(edges_mm: Floats, low_mm: float, high_mm: float) -> Floats:
    """Return the exact fraction of each pixel (n,) with boundaries (n + 1,) in an interval."""
    inside_mm = np.clip(edges_mm, low_mm, high_mm)
    return np.asarray(np.diff(inside_mm) / np.diff(edges_mm))


def add_rectangle(
    picture: Fractions, canvas: Canvas, x_mm: tuple[float, float], y_mm: tuple[float, float], value: float = 1.0
) -> None:
    """Add the exact pixel means of a rectangle with the bounds ``x_mm`` and ``y_mm``."""
    columns, rows = interval(canvas.x_edges_mm, *x_mm), interval(canvas.y_edges_mm, *y_mm)
    (i_x,), (i_y,) = np.nonzero(columns), np.nonzero(rows)
    if i_x.size and i_y.size:
        x, y = slice(i_x[0], i_x[-1] + 1), slice(i_y[0], i_y[-1] + 1)
        picture[y, x] += (value * np.outer(rows[y], columns[x])).astype(np.float32)


def half_plane(height: Floats, x: Floats | float, y: Floats | float) -> Floats:
    """
    Return the exact fraction of a square pixel on one side of a straight line.

    ``height`` (...) float64, pixels: signed distance of the pixel centre from the line, positive on that side. ``x``, ``y``
    (float, or (...) float64): unit normal of the line. Returns ``fraction`` (...) float64.

    The distance of a random point of the square from a line through its centre is the sum of two uniform variables of the
    widths ``|x|`` and ``|y|``, with a trapezoidal density; the fraction is its integral.
    """
    wide = np.maximum(np.abs(x), np.abs(y))
    narrow = np.maximum(np.minimum(np.abs(x), np.abs(y)), np.finfo(np.float64).tiny)
    distance = np.minimum(np.abs(height), 0.5 * (wide + narrow))
    beyond = 0.5 * (wide + narrow) - distance
    corner = np.minimum(beyond, narrow)
    fraction = np.where(
        distance <= 0.5 * (wide - narrow), 0.5 + distance / wide, 1.0 - 0.5 * (corner / narrow) * (corner / wide)
    )
    return np.where(height < 0.0, 1.0 - fraction, fraction)


def sample_means(
    canvas: Canvas, is_selected: Bools, rows: slice, function: Callable[[Floats, Floats], Floats]
) -> Floats:
    """
    Return means over selected pixels from 32 x 32 samples each.

    The error at a sharp edge is at most 1/64.

    ``is_selected`` (n_row, n_x) bool: selected pixels in the rows of a block. ``rows``: rows of the block. ``function``:
    function that returns the fraction of white at x and y (...), mm. Returns ``means`` (n_chosen,) float64.
    """
    i_y, i_x = np.nonzero(is_selected)
    x_mm, y_mm = canvas.x_mm[i_x], canvas.y_mm[rows][i_y]
    offsets_mm = ((np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5) * canvas.pitch_mm
    means = np.empty(i_x.size)
    n_block = max(1, BLOCK_PIXELS // SAMPLES**2)
    for block in (slice(i, i + n_block) for i in range(0, i_x.size, n_block)):
        x = x_mm[block, np.newaxis, np.newaxis] + offsets_mm
        y = y_mm[block, np.newaxis, np.newaxis] + offsets_mm[:, np.newaxis]
        means[block] = function(x, y).mean(axis=(1, 2))
    return means
