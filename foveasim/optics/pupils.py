"""
Pupil functions: amplitude transmittance over the aperture.

A pupil is a callable ``T(x, y, wavelength_nm)`` of arrays x, y in units of the aperture radius, x to the right and y up as
in the picture on the sensor. It returns real or complex amplitudes; the power transmittance is their squared modulus.
Outside the unit circle, which corresponds to the f-number, the transmittance is 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FINITE, FRACTION, Declared, Limits
from foveasim._core.registry import Registry
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats, as_broadcast, as_numbers, finite_array, read_only
from foveasim._io.images import read_picture, write_picture
from foveasim.errors import ParameterError
from foveasim.fields import from_file_rows
from foveasim.optics._quadrature import PupilEdges

__all__ = ["Annulus", "Blades", "Pupil", "PupilImage", "Slit", "Spider"]

#: Half the length of edges that extend beyond the unit circle.
LONG = 1.5

#: Callable of x, y in aperture radii and the wavelength in nm that returns real or complex amplitudes.
Pupil = Callable[[Floats, Floats, float], NDArray[Any]]

#: Pupil factories by their names in settings files; each returns a function of pupil coordinates and wavelength. Installed
#: packages register pupils as entry points of the group ``foveasim.pupils``.
PUPILS: Registry[Callable[..., Any]] = Registry("pupil", "foveasim.pupils")


@PUPILS.register("annulus", example={"obscuration": 0.4}, expected=0.84)
@dataclass(frozen=True, slots=True)
class Annulus(Declared):
    """
    Annular pupil with a central obscuration, as in a telescope with a secondary mirror.

    Parameters
    ----------
    obscuration : float
        Radius of the obscuration over the aperture radius, 0 to 0.999.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.Optics(focal_length_mm=100.0, f_number=8.0, pupil=fs.optics.Annulus(0.5))
    >>> lens.mtf([50.0, 150.0], 550.0).round(
    ...     3
    ... ).tolist()  # less contrast at low frequencies, more at high ones
    [0.449, 0.232]
    >>> fs.Optics(focal_length_mm=100.0, f_number=8.0).mtf([50.0, 150.0], 550.0).round(
    ...     3
    ... ).tolist()
    [0.722, 0.225]
    """

    obscuration: Annotated[float, Limits(at_least=0.0, at_most=0.999)]

    def __call__(self, x: Floats, y: Floats, wavelength_nm: float) -> Bools:  # noqa: ARG002 -- signature of all pupils
        """Return the amplitudes at points of the aperture."""
        x, y = as_broadcast(x=x, y=y)
        return np.asarray(x * x + y * y >= self.obscuration**2)

    def edges(self) -> PupilEdges:
        """Return the circle of the obscuration."""
        return PupilEdges(radii=[self.obscuration])


@PUPILS.register("spider", example={"n_vanes": 3, "width_fraction": 0.1})
@dataclass(frozen=True, slots=True)
class Spider(Declared):
    """
    Spider vanes: radial bars that support a secondary mirror.

    Parameters
    ----------
    n_vanes : int
    width_fraction : float
        Width of a vane over the aperture diameter, 0 to 1.
    angle_deg : float, degrees
        Direction of the first vane, counter-clockwise from the x axis.

    Examples
    --------
    >>> import foveasim as fs
    >>> (
    ...     bool(fs.optics.Spider(4, 0.1)(0.5, 0.0, 550.0)),
    ...     bool(fs.optics.Spider(4, 0.1)(0.4, 0.4, 550.0)),
    ... )
    (False, True)
    """

    n_vanes: Annotated[int, Limits(at_least=1, at_most=360)]
    width_fraction: Annotated[float, FRACTION]
    angle_deg: Annotated[float, FINITE] = 0.0

    def __call__(self, x: Floats, y: Floats, wavelength_nm: float) -> Bools:  # noqa: ARG002
        """Return the amplitudes at points of the aperture."""
        x, y = as_broadcast(x=x, y=y)
        is_open = np.ones(np.broadcast_shapes(x.shape, y.shape), bool)
        for angle in np.radians(self.angle_deg + 360.0 / self.n_vanes * np.arange(self.n_vanes)):
            along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
            is_open &= (along < 0.0) | (np.abs(across) > self.width_fraction)
        return is_open

    def edges(self) -> PupilEdges:
        """Return the two long sides and the inner end of each vane."""
        w = self.width_fraction
        vane = np.array([[(LONG, w), (0.0, w)], [(0.0, w), (0.0, -w)], [(0.0, -w), (LONG, -w)]])
        directions = self.angle_deg + 360.0 / self.n_vanes * np.arange(self.n_vanes)
        return PupilEdges(segments=np.concatenate([_rotated(vane, angle_deg) for angle_deg in directions]))


@PUPILS.register("blades", example={"n_blades": 4, "angle_deg": 10.0}, expected=2.0 / np.pi)
@dataclass(frozen=True, slots=True)
class Blades(Declared):
    """
    Iris diaphragm: regular polygon with its vertices on the circle.

    Parameters
    ----------
    n_blades : int
        Number of blades, at least 3.
    angle_deg : float, degrees
        Direction of the first vertex, counter-clockwise from the x axis.

    Examples
    --------
    >>> import foveasim as fs
    >>> (
    ...     bool(fs.optics.Blades(6)(0.95, 0.0, 550.0)),
    ...     bool(fs.optics.Blades(6)(0.0, 0.95, 550.0)),
    ... )  # a vertex, an edge
    (True, False)
    """

    n_blades: Annotated[int, Limits(at_least=3, at_most=360)]
    angle_deg: Annotated[float, FINITE] = 0.0

    def __call__(self, x: Floats, y: Floats, wavelength_nm: float) -> Bools:  # noqa: ARG002
        """Return the amplitudes at points of the aperture."""
        x, y = as_broadcast(x=x, y=y)
        is_open = np.ones(np.broadcast_shapes(x.shape, y.shape), bool)
        inner = np.cos(np.pi / self.n_blades)
        for angle in np.radians(self.angle_deg + 360.0 / self.n_blades * (np.arange(self.n_blades) + 0.5)):
            is_open &= x * np.cos(angle) + y * np.sin(angle) <= inner
        return is_open

    def edges(self) -> PupilEdges:
        """Return the sides of the polygon."""
        half = np.sin(np.pi / self.n_blades)
        side = np.array([[(np.cos(np.pi / self.n_blades), y) for y in (-half, half)]])
        directions = self.angle_deg + 360.0 / self.n_blades * (np.arange(self.n_blades) + 0.5)
        return PupilEdges(segments=np.concatenate([_rotated(side, angle_deg) for angle_deg in directions]))


@PUPILS.register("slit", example={"width_fraction": 0.4, "angle_deg": 30.0})
@dataclass(frozen=True, slots=True)
class Slit(Declared):
    """
    Straight slit across the circle.

    Parameters
    ----------
    width_fraction : float
        Width over the aperture diameter, above 0 and at most 1.
    angle_deg : float, degrees
        Direction of the slit's long side, counter-clockwise from the x axis.

    Examples
    --------
    >>> import foveasim as fs
    >>> (
    ...     bool(fs.optics.Slit(0.2)(0.5, 0.05, 550.0)),
    ...     bool(fs.optics.Slit(0.2)(0.5, 0.25, 550.0)),
    ... )
    (True, False)
    """

    width_fraction: Annotated[float, Limits(above=0.0, at_most=1.0)]
    angle_deg: Annotated[float, FINITE] = 0.0

    def __call__(self, x: Floats, y: Floats, wavelength_nm: float) -> Bools:  # noqa: ARG002
        """Return the amplitudes at points of the aperture."""
        x, y = as_broadcast(x=x, y=y)
        angle = np.radians(self.angle_deg)
        return np.asarray(np.abs(y * np.cos(angle) - x * np.sin(angle)) <= self.width_fraction)

    def edges(self) -> PupilEdges:
        """Return the two long sides."""
        sides = np.array([[(-LONG, y), (LONG, y)] for y in (-self.width_fraction, self.width_fraction)])
        return PupilEdges(segments=_rotated(sides, self.angle_deg))


def _example_picture(directory: Path) -> dict[str, Any]:
    """Write a picture with a bright left half and dark quarters on the right."""
    path = directory / "pupil.png"
    write_picture(path, np.array([[255, 0], [255, 128]], np.uint8))
    return {"picture": str(path), "values": "power"}


@PUPILS.register("image", example=_example_picture, expected=0.5 + 0.25 * 128.0 / 255.0)
@dataclass(frozen=True, eq=False)
class PupilImage:
    """
    Pupil specified by a picture, or by measured amplitudes and a wavefront.

    Parameters
    ----------
    picture : path, or (n, n) array, top row first
        Transmittance, 0 to 1 (integers: 0 to the maximum of the type), over the square around the circular aperture. The
        pixels are uniform squares; colour channels are averaged and multiplied by alpha.
    values : {"amplitude", "power"}
        Whether values are amplitude or power (squared amplitude) transmittances.
    wavefront_um : (n, n) array, top row first, optional, µm
        Optical path difference at the pixel centres, interpolated linearly. The PSF moves in the direction in which it
        increases.

    Raises
    ------
    FileError
        When the file cannot be read.
    ParameterError
        When an array is not square or not finite, or a transmittance is outside 0 to 1.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> stop = np.zeros((64, 64))
    >>> stop[:, 16:48] = 1.0  # a vertical slit of half the diameter
    >>> pupil = fs.optics.PupilImage(stop)
    >>> pupil(np.array([0.0, 0.75]), np.array([0.0, 0.0]), 550.0).tolist()
    [1.0, 0.0]
    """

    picture: str | Path | ArrayLike = field(repr=False)
    values: Literal["amplitude", "power"] = "amplitude"
    wavefront_um: ArrayLike | None = field(default=None, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        is_file = isinstance(self.picture, str | Path)
        pixels = read_picture(self.picture) if is_file else as_numbers("picture", self.picture, keep_type=True)  # type: ignore[arg-type]
        peak = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else 1.0
        amplitude = finite_array("picture", pixels, at_least=0.0) / peak
        if amplitude.ndim not in (2, 3) or amplitude.shape[0] != amplitude.shape[1] or amplitude.size == 0:
            raise ParameterError("picture", f"must be square, got shape {amplitude.shape}")
        if amplitude.max() > 1.0:
            raise ParameterError("picture", "must be within 0 to 1", float(amplitude.max()))
        channels = from_file_rows(amplitude)
        # Transparent pixels transmit no power; scenes apply alpha in the same way.
        alpha = channels[-1] if channels.shape[0] in (2, 4) else 1.0
        amplitude = (channels[:-1] if channels.shape[0] in (2, 4) else channels).mean(axis=0) * alpha
        if self.values == "power":
            amplitude = np.sqrt(amplitude)
        object.__setattr__(self, "picture", read_only(np.ascontiguousarray(amplitude[::-1])))
        object.__setattr__(self, "values", "amplitude")
        if self.wavefront_um is not None:
            wavefront_um = finite_array("wavefront_um", self.wavefront_um, ndim=2)
            if wavefront_um.shape[0] != wavefront_um.shape[1]:
                raise ParameterError("wavefront_um", f"must be square, got shape {wavefront_um.shape}")
            object.__setattr__(self, "wavefront_um", read_only(wavefront_um.copy()))

    def __call__(self, x: Floats, y: Floats, wavelength_nm: float) -> NDArray[Any]:
        """Return the amplitudes at points of the aperture."""
        x, y = as_broadcast(x=x, y=y)
        amplitude = as_numbers("picture", self.picture)  # type: ignore[arg-type]
        n = amplitude.shape[0]
        row, column = (
            np.clip(np.floor(0.5 * n * (1.0 + s * c)).astype(np.int64), 0, n - 1) for s, c in ((-1, y), (1, x))
        )
        there = amplitude[row, column]
        if self.wavefront_um is None:
            return there
        from scipy.ndimage import map_coordinates

        wavefront_um = as_numbers("wavefront_um", self.wavefront_um)
        n = wavefront_um.shape[0]
        rows, columns = np.broadcast_arrays(0.5 * n * (1.0 - y) - 0.5, 0.5 * n * (1.0 + x) - 0.5)
        path_um = map_coordinates(wavefront_um, [rows, columns], order=1, mode="nearest")
        return np.asarray(there * np.exp(2j * np.pi * path_um / (1e-3 * wavelength_nm)))

    def edges(self) -> PupilEdges:
        """Return pixel edges, and lines at which the slope of the wavefront changes."""
        n = len(as_numbers("picture", self.picture))  # type: ignore[arg-type]
        lines = np.arange(1, n) * (2.0 / n) - 1.0
        if self.wavefront_um is not None:
            n = len(as_numbers("wavefront_um", self.wavefront_um))
            lines = np.concatenate((lines, (np.arange(n) + 0.5) * (2.0 / n) - 1.0))
        return PupilEdges(lines_x=lines, lines_y=lines)


@dataclass(frozen=True, slots=True)
class Half:
    """Half of the pupil behind one photodiode of a dual pixel, on one side of the y axis."""

    side: Literal["left", "right"]

    def __call__(self, x: Floats, y: Floats, wavelength_nm: float) -> Floats:  # noqa: ARG002
        """Return the amplitudes at points of the aperture; points on the axis belong to both."""
        x, y = as_broadcast(x=x, y=y)
        inward = x if self.side == "left" else -x
        return np.where(inward < 0.0, 1.0, np.where(inward == 0.0, np.sqrt(0.5), 0.0)) * np.ones(y.shape)

    def edges(self) -> PupilEdges:
        """Return the y axis."""
        return PupilEdges(segments=np.array([[(0.0, -LONG), (0.0, LONG)]]))


def _rotated(segments: Floats, angle_deg: float) -> Floats:
    """Return segments (n, 2, 2) rotated counter-clockwise."""
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.asarray(segments @ np.array([[cos, sin], [-sin, cos]]))
