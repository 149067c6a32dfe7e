"""Point spread functions at points of the field, in the frame of the upright picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import LENGTH
from foveasim._core.threads import cached_property
from foveasim._core.validation import (
    Floats,
    Ints,
    as_numbers,
    check_length_um,
    finite_array,
    read_only,
    wavelengths_nm,
)
from foveasim.errors import ParameterError, SamplingWarning, warn

#: Largest number of values: 2 GiB in double precision.
MAX_VALUES = 1 << 28
#: Largest number of values of PSFs on a radius: they are rotated around the axis, for which finer samples are stored.
MAX_TURNED_VALUES = 1 << 24
#: Largest number of field points and of samples along a side.
MAX_POINTS, MAX_SIDE = 4096, 8192
#: Largest difference of equal coordinates, as a fraction of the extent of the field.
SAME = 1e-6
#: Fraction of the light beyond the window of a PSF above which a warning is issued.
MAX_BEYOND = 0.05
#: Largest relative difference of distances of samples that are equal, and of coordinates from uniform ones, in samples.
SAME_PITCH, SAME_STEP = 1e-9, 1e-3
#: Image points of arrays, by name: that of ``fftshift``, and the middle of the array.
CENTRES: dict[str, Callable[[int], float]] = {"fft": lambda n: float(n // 2), "middle": lambda n: 0.5 * (n - 1)}


@dataclass(frozen=True, eq=False, kw_only=True)
class PSFGrid:
    """
    Point spread functions of a lens over its field, from another program or a measurement.

    Created by :meth:`from_arrays`, which converts from the conventions of other programs, or :func:`read_psfs`.

    Parameters
    ----------
    psf : (n_point, n_wavelength, n_y, n_x) float32 or float64
        Irradiance around the image point, row 0 lowest, with odd numbers of rows and columns. Each PSF is divided by its sum.
    x_um, y_um : (n_point,) float64, µm
        Image points relative to the optical axis, in the upright picture. They form a rectangular grid, lie on one radius of
        a rotationally symmetric lens, or are one point, whose PSF is that of the whole field.
    wavelength_nm : (n_wavelength,) float64, nm
        Ascending. The PSF is interpolated linearly between wavelengths; beyond the outermost wavelength it is constant.
    pitch_um : float or (n_wavelength,), µm
        Sampling pitch, of all wavelengths or of each.
    samples : {"points", "bins"}
        Whether values are those at points, or means over squares around them, such as counts of rays.
    relative_illumination : (n_point, n_wavelength), optional
        Irradiance of a uniform scene relative to that on the axis, in place of cos⁴; by default that of the lens.
    centre : (row, column), optional
        Position of the image point, at most half a sample from the middle one; by default the middle sample. An array with
        an even number of samples around the image point has it at half a sample, between two of them.

    Raises
    ------
    ParameterError
        When shapes differ, values are not finite, a PSF has no positive sum, or points coincide or form no grid or radius.

    Warns
    -----
    SamplingWarning
        When more than 5 % of the light lies beyond the window, by :attr:`beyond_fraction`.

    Notes
    -----
    Between the points, the PSFs and their centroids are interpolated separately: the PSFs are centred on their centroids,
    interpolated, and displaced by the interpolated centroid. The interpolation uses cubic splines, or is linear if distances
    between points differ by more than a factor of 2. PSFs on a radius are rotated around the axis. Beyond the outermost points,
    the PSF is that of the nearest position within. Frequencies above the cut-off of the lens, ``1 / λN``, are removed.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> spot = np.exp(-0.5 * np.add.outer(np.arange(-8, 9) ** 2, np.arange(-8, 9) ** 2))
    >>> psfs = fs.optics.PSFGrid.from_arrays(
    ...     spot, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=1.0
    ... )
    >>> psfs
    PSFGrid(1 point, 550 nm, 17 x 17 samples of 1 µm)
    >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.8, psfs=psfs)
    >>> lens.is_varying
    False
    """

    psf: NDArray[np.floating[Any]] = field(repr=False)
    x_um: Floats
    y_um: Floats
    wavelength_nm: Floats
    pitch_um: Annotated[float, LENGTH] | Floats
    samples: Literal["points", "bins"] = "points"
    relative_illumination: Floats | None = None
    centre: tuple[float, float] | None = None

    def __repr__(self) -> str:
        return f"PSFGrid({self.description})"

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        waves_nm = np.atleast_1d(wavelengths_nm("wavelength_nm", np.atleast_1d(self.wavelength_nm)))
        x_um, y_um = (np.atleast_1d(finite_array(name, getattr(self, name))) for name in ("x_um", "y_um"))
        psf = as_numbers("psf", self.psf, keep_type=True)
        _check_shape(psf, x_um, y_um, waves_nm)
        if (np.diff(waves_nm) <= 0.0).any():
            raise ParameterError("wavelength_nm", "must ascend without equal values", waves_nm.tolist(), "nm")
        _check_apart(x_um, y_um)
        set_(self, "pitch_um", _pitch_um(self.pitch_um, waves_nm.size))
        set_(self, "centre", _near_middle(self.centre, psf.shape[2:]))
        real = np.float32 if psf.dtype == np.float32 else np.float64
        set_(self, "psf", read_only(_normalised(psf, real, x_um, y_um, waves_nm)))
        for name, values in (("x_um", x_um), ("y_um", y_um), ("wavelength_nm", waves_nm)):
            set_(self, name, read_only(np.array(values, np.float64)))
        if self.relative_illumination is not None:
            fraction = finite_array("relative_illumination", self.relative_illumination, at_least=0.0)
            if fraction.ndim == 1 and waves_nm.size == 1:
                fraction = fraction[:, np.newaxis]
            if fraction.shape != psf.shape[:2]:
                raise ParameterError(
                    "relative_illumination",
                    f"must have the shape (n_point, n_wavelength) = {psf.shape[:2]}, got {fraction.shape}",
                )
            if not (fraction.mean(axis=1) > 0.0).all():
                raise ParameterError("relative_illumination", "must be above 0 at each point for one wavelength")
            set_(self, "relative_illumination", read_only(fraction.copy()))
        if self.is_radial and psf.size > MAX_TURNED_VALUES:
            raise ParameterError("psf", f"must have at most {MAX_TURNED_VALUES} values on a radius, got {psf.size}")
        beyond = float(self.beyond_fraction.max())
        if beyond > MAX_BEYOND:
            warn(
                f"approximately {beyond:.0%} of the light of a point lies beyond the window of its PSF, {psf.shape[3]} x "
                f"{psf.shape[2]} samples of {self._pitch}; export a larger window",
                SamplingWarning,
            )

    @classmethod
    def from_arrays(
        cls,
        psf: ArrayLike,
        *,
        x_um: ArrayLike,
        y_um: ArrayLike,
        wavelength_nm: ArrayLike,
        pitch_um: float | ArrayLike | None = None,
        sample_x_um: ArrayLike | None = None,
        sample_y_um: ArrayLike | None = None,
        image: Literal["upright", "inverted"] = "upright",
        first_row: Literal["lowest", "highest"] = "lowest",
        samples: Literal["points", "bins"] = "points",
        centre: tuple[float, float] | Literal["fft", "middle"] | None = None,
        relative_illumination: ArrayLike | None = None,
    ) -> PSFGrid:
        """
        Convert PSFs of another program or a measurement.

        Parameters
        ----------
        psf : (n_point, n_wavelength, n_y, n_x), (n_point, n_y, n_x) or (n_y, n_x) array
            Three dimensions: PSFs of one wavelength. Two dimensions: one PSF.
        x_um, y_um : (n_point,) array or float, µm
            Image points relative to the optical axis, in any order.
        wavelength_nm : (n_wavelength,) array or float, nm
            In any order.
        pitch_um : float or (n_wavelength,) array, µm
            Sampling pitch, of all wavelengths or of each: FFTs of a pupil have a pitch proportional to the wavelength.
        sample_x_um, sample_y_um : (n_x,) and (n_y,) arrays, optional, µm
            Positions of columns and rows relative to the image point, at equal steps, instead of ``pitch_um``, ``centre`` and
            ``first_row``.
        image : {"upright", "inverted"}
            Whether positions are those in the upright picture, or those in the image that a lens projects, as in lens design.
            The latter are turned by 180°: ``h(-x, -y)`` at the field point ``(-x, -y)``.
        first_row : {"lowest", "highest"}
            Whether row 0 is that of the smallest or the largest y.
        samples : {"points", "bins"}
            As for :class:`PSFGrid`.
        centre : (row, column) or {"fft", "middle"}, optional
            Position of the image point in samples of the array, from 0 in the middle of the first one, as it is given:
            ``(63.5, 63.5)`` is the middle of 128 samples. ``"fft"``: ``n // 2``, as after ``fftshift`` (FFT PSFs of Optiland,
            rayoptics and ISETCam). ``"middle"``: ``(n - 1) / 2``, the middle of the array (Huygens PSFs of Optiland, samples
            on ``linspace``, :meth:`foveasim.Optics.psf`). Both are equal for odd numbers of samples, where it may be omitted.
        relative_illumination : (n_point, n_wavelength) array, optional

        Returns
        -------
        PSFGrid

        Raises
        ------
        ParameterError
            As for :class:`PSFGrid`; when the number of samples is even, and neither ``centre`` nor coordinates say where the
            image point is.

        Examples
        --------
        >>> import foveasim as fs
        >>> import numpy as np
        >>> airy = fs.Optics(focal_length_mm=8.0, f_number=4.0).psf(
        ...     550.0, pitch_um=1.0, n_points=64
        ... )
        >>> psfs = fs.optics.PSFGrid.from_arrays(
        ...     airy.psf_per_um2,
        ...     x_um=0.0,
        ...     y_um=0.0,
        ...     wavelength_nm=550.0,
        ...     pitch_um=1.0,
        ...     centre=(31.5, 31.5),
        ... )
        >>> psfs.psf.shape, psfs.centre, bool(np.abs(psfs.centroid_um).max() < 1e-9)
        ((1, 1, 65, 65), (31.5, 31.5), True)
        """
        waves_nm = np.atleast_1d(as_numbers("wavelength_nm", wavelength_nm))
        x, y = (np.atleast_1d(as_numbers(name, at)) for name, at in (("x_um", x_um), ("y_um", y_um)))
        values = as_numbers("psf", psf, keep_type=True)
        if sample_x_um is None and len(getattr(psf, "coords", ())):
            hint = "pass sample_x_um and sample_y_um in µm, and psf.values"
            raise ParameterError("psf", "must have no coordinates of its own, whose unit is not known", psf, hint=hint)
        if values.ndim == 2:
            values = values[np.newaxis, np.newaxis]
        elif values.ndim == 3:
            values = values[:, np.newaxis]
        _check_shape(values, x, y, waves_nm, is_padded=False)
        if sample_x_um is not None or sample_y_um is not None:
            given = {"pitch_um": pitch_um, "centre": centre, "first_row": None if first_row == "lowest" else first_row}
            values, pitch_um, centre = _at_coordinates(values, sample_x_um, sample_y_um, given)
        elif pitch_um is None:
            raise ParameterError("pitch_um", "must be given, or 'sample_x_um' and 'sample_y_um'", pitch_um)
        values, middle = _centred(values, _image_point(centre, values.shape[2:]))
        if first_row == "highest":
            values, middle = values[..., ::-1, :], (values.shape[2] - 1 - middle[0], middle[1])
        if image == "inverted":
            values, x, y = values[..., ::-1, ::-1], -x, -y
            middle = values.shape[2] - 1 - middle[0], values.shape[3] - 1 - middle[1]
        order = np.argsort(waves_nm)
        fraction = None
        if relative_illumination is not None:
            fraction = as_numbers("relative_illumination", relative_illumination)
            fraction = fraction.reshape(-1, 1) if fraction.ndim == 1 and waves_nm.size == 1 else fraction
            fraction = fraction[:, order] if fraction.shape == values.shape[:2] else fraction
        pitches_um = as_numbers("pitch_um", pitch_um)
        return cls(
            psf=values[:, order],
            x_um=x,
            y_um=y,
            wavelength_nm=waves_nm[order],
            pitch_um=pitches_um[order] if pitches_um.shape == order.shape else pitches_um,
            samples=samples,
            relative_illumination=fraction,
            centre=middle,
        )

    def write(self, path: str | Path) -> None:
        """
        Write the PSFs to a file atomically.

        Parameters
        ----------
        path : path
            With the extension ``.npz`` or ``.fits``.

        Raises
        ------
        FileError
            When the extension is another, or the file cannot be written.
        """
        from foveasim.optics.psfs._formats import write

        write(self, Path(path))

    @property
    def description(self) -> str:
        """Numbers of points, wavelengths and samples."""
        n_points, n_waves, n_y, n_x = self.psf.shape
        waves = f"{self.wavelength_nm[0]:g} nm" if n_waves == 1 else f"{n_waves} wavelengths"
        points = "1 point" if n_points == 1 else f"{n_points} points"
        return f"{points}, {waves}, {n_x} x {n_y} samples of {self._pitch}"

    @property
    def _pitch(self) -> str:
        """Pitch or range of pitches, for descriptions and messages."""
        low_um, high_um = float(self.pitches_um.min()), float(self.pitches_um.max())
        return f"{low_um:g} µm" if low_um == high_um else f"{low_um:g} to {high_um:g} µm"

    @property
    def pitches_um(self) -> Floats:
        """Sampling pitch of each wavelength, (n_wavelength,) µm."""
        return np.broadcast_to(self.pitch_um, self.wavelength_nm.shape)

    @property
    def middle_offset(self) -> tuple[float, float]:
        """Position (x, y) of the middle sample relative to the image point, in samples."""
        assert self.centre is not None
        n_y, n_x = self.psf.shape[2:]
        return n_x // 2 - self.centre[1], n_y // 2 - self.centre[0]

    @property
    def is_varying(self) -> bool:
        """Whether there are PSFs at several points."""
        return self.x_um.size > 1

    @property
    def is_radial(self) -> bool:
        """Whether the points lie on one radius of a rotationally symmetric lens."""
        return len(self.axes) == 1

    @cached_property
    def axes(self) -> tuple[Floats, ...]:
        """Coordinates of the points, µm: none for one point, radii, or x and y of a grid."""
        if self.x_um.size == 1:
            return ()
        extent_um = float(max(np.abs(self.x_um).max(), np.abs(self.y_um).max()))
        radius_um = np.hypot(self.x_um, self.y_um)
        far = int(radius_um.argmax())
        along = (self.x_um * self.x_um[far] + self.y_um * self.y_um[far]) / radius_um[far]
        if (np.abs(along - radius_um) <= SAME * extent_um).all():
            return (np.sort(radius_um),)
        axes = tuple(_distinct(at, SAME * extent_um) for at in (self.x_um, self.y_um))
        n_x, n_y = (axis.size for axis in axes)
        if n_x * n_y != self.x_um.size or n_x < 2 or n_y < 2:
            raise ParameterError(
                "x_um",
                f"and 'y_um' must form a rectangular grid, or lie on one radius, got {self.x_um.size} points with {n_x} "
                f"different x and {n_y} different y",
                hint="add the missing points, or give those of one direction from the axis",
            )
        return axes

    @cached_property
    def order(self) -> Ints:
        """Indices of the points by radius, or row by row of the grid."""
        if len(self.axes) < 2:
            return np.argsort(np.hypot(self.x_um, self.y_um))
        column, row = (
            np.abs(axis[:, np.newaxis] - at).argmin(axis=0)
            for axis, at in zip(self.axes, (self.x_um, self.y_um), strict=True)
        )
        return np.lexsort((column, row))

    def cut_off_um(self, wavelength_nm: Any, lambda_n_um: Any) -> Any:
        """Return the period of the cut-off frequency: λN, or two samples if these are coarser."""
        return np.maximum(lambda_n_um, 2.0 * self._coarsest_um(wavelength_nm))

    def _coarsest_um(self, wavelength_nm: Any) -> Any:
        """Return the larger pitch of the two wavelengths between which one lies, µm."""
        last = self.wavelength_nm.size - 1
        above = np.clip(np.searchsorted(self.wavelength_nm, wavelength_nm), 0, last)
        below = np.clip(np.searchsorted(self.wavelength_nm, wavelength_nm, "right") - 1, 0, last)
        return np.maximum(self.pitches_um[below], self.pitches_um[above])

    @property
    def azimuth_rad(self) -> float:
        """Direction of the radius on which the points lie, from the x axis."""
        far = int(self.order[-1])
        return math.atan2(self.y_um[far], self.x_um[far])

    @cached_property
    def centroid_um(self) -> Floats:
        """Centroids (x, y) relative to the image points, (n_point, n_wavelength, 2) µm."""
        assert self.centre is not None
        y, x = (np.arange(n) - at for n, at in zip(self.psf.shape[2:], self.centre, strict=True))
        centroid = np.stack(
            (np.einsum("pwyx,x->pw", self.psf, x), np.einsum("pwyx,y->pw", self.psf, y)), axis=-1, dtype=np.float64
        )
        return centroid * self.pitches_um[:, np.newaxis]

    @property
    def beyond_fraction(self) -> Floats:
        """
        Estimated fraction of the light beyond the window, (n_point, n_wavelength).

        The irradiance of a diffraction pattern decreases with the third power of the distance (edges of a pupil), as c / r³.
        Its mean over the sides of a square of half side R is ``c / (√2 R³)``, and ``4 √2 c / R = 8 R²`` times this mean lies
        beyond the square.
        """
        n_y, n_x = self.psf.shape[2:]
        rows = self.psf, self.psf[..., ::-1, :], self.psf.swapaxes(2, 3), self.psf[..., ::-1].swapaxes(2, 3)
        # One of the two outermost lines may be padding.
        means = [each[..., :2, :].mean(axis=3, dtype=np.float64).max(axis=2) for each in rows]
        beyond = 2.0 * n_y * n_x * np.maximum(np.mean(means, axis=0), 0.0)
        return np.asarray(beyond / (1.0 + beyond))


def _check_shape(
    psf: NDArray[Any], x_um: Floats, y_um: Floats, wavelength_nm: Floats, *, is_padded: bool = True
) -> None:
    """Check that each point and wavelength has a PSF, and the limits of the size."""
    rule = "(n_point, n_wavelength, n_y, n_x)"
    if psf.ndim != 4 or 0 in psf.shape:
        raise ParameterError("psf", f"must have the shape {rule}, got {psf.shape}")
    if x_um.shape != (psf.shape[0],) or y_um.shape != x_um.shape:
        raise ParameterError(
            "x_um", f"and 'y_um' must have {psf.shape[0]} values, one per PSF, got {x_um.size} and {y_um.size}"
        )
    if wavelength_nm.shape != (psf.shape[1],):
        raise ParameterError("wavelength_nm", f"must have {psf.shape[1]} values, one per PSF, got {wavelength_nm.size}")
    # Even numbers of samples are padded by one.
    if psf.size > MAX_VALUES or psf.shape[0] > MAX_POINTS or max(psf.shape[2:]) > MAX_SIDE + 1:
        raise ParameterError(
            "psf",
            f"must have at most {MAX_POINTS} points, {MAX_SIDE} samples along a side and {MAX_VALUES} values, "
            f"got {psf.shape}",
        )
    if is_padded and (psf.shape[2] % 2 == 0 or psf.shape[3] % 2 == 0):
        raise ParameterError(
            "psf",
            f"must have odd numbers of rows and columns, got {psf.shape[2:]}",
            hint="use PSFGrid.from_arrays for even numbers",
        )


def _check_apart(x_um: Floats, y_um: Floats) -> None:
    """Check that no two points coincide."""
    from scipy.spatial import KDTree

    points = np.column_stack((x_um, y_um))
    if len(points) < 2:
        return
    found: Any = KDTree(points).query(points, k=2)
    is_same = found[0][:, 1] <= SAME * float(np.abs(points).max())
    if is_same.any():
        one = int(np.argmax(is_same))
        other = max(int(k) for k in found[1][one] if k != one)
        raise ParameterError(
            "x_um",
            f"and 'y_um' must be different for all points, got ({x_um[one]:g}, {y_um[one]:g}) µm at [{one}] and [{other}]",
        )


def _normalised(psf: NDArray[Any], real: Any, x_um: Floats, y_um: Floats, wavelength_nm: Floats) -> NDArray[Any]:
    """Return PSFs of unit sum; raise a ParameterError that names the first invalid one."""
    sums = psf.sum(axis=(2, 3), dtype=np.float64)
    for is_bad, rule in ((~np.isfinite(sums), "must be finite"), (sums <= 0.0, "must have a positive sum")):
        if is_bad.any():
            point, wave = np.argwhere(is_bad)[0]
            raise ParameterError(
                "psf",
                f"{rule}; the one at ({x_um[point]:g}, {y_um[point]:g}) µm and {wavelength_nm[wave]:g} nm "
                f"{'is not' if rule.endswith('finite') else 'does not have one'}",
            )
    # PSFs from a file or another PSFGrid already have unit sum: their values must not change.
    is_one = np.abs(sums - 1.0) <= 8.0 * np.finfo(real).eps
    return np.ascontiguousarray(psf / np.where(is_one, 1.0, sums)[:, :, np.newaxis, np.newaxis], real)


def _pitch_um(pitch_um: Any, n_waves: int) -> float | Floats:
    """Return one pitch, or that of each wavelength where they differ."""
    values = as_numbers("pitch_um", pitch_um)
    if values.shape not in ((), (1,), (n_waves,)):
        raise ParameterError("pitch_um", f"must have one value, or one per wavelength, {n_waves}, got {values.size}")
    names = ("pitch_um",) if values.ndim == 0 else tuple(f"pitch_um[{k}]" for k in range(values.size))
    each = np.array([check_length_um(name, one) for name, one in zip(names, values.ravel().tolist(), strict=True)])
    return float(each[0]) if np.ptp(each) <= SAME_PITCH * each[0] else read_only(each)


def _near_middle(centre: Any, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the position of the image point, within half a sample of the middle one."""
    if centre is None:
        return shape[0] // 2, shape[1] // 2
    found = _pair(centre, shape)
    if any(abs(at - n // 2) > 0.5 for at, n in zip(found, shape, strict=True)):
        raise ParameterError(
            "centre",
            f"must be at most half a sample from the middle of the {shape[0]} x {shape[1]} samples",
            found,
            hint="use PSFGrid.from_arrays for others",
        )
    return found


def _pair(centre: Any, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return a position (row, column) within the samples."""
    found = finite_array("centre", centre)
    if found.shape != (2,):
        raise ParameterError("centre", "must be two numbers (row, column), 'fft' or 'middle'", centre)
    if not all(0.0 <= at <= n - 1 for at, n in zip(found.tolist(), shape, strict=True)):
        raise ParameterError("centre", f"must be within the {shape[0]} x {shape[1]} samples", centre)
    return float(found[0]), float(found[1])


def _image_point(centre: Any, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the position (row, column) of the image point in an array."""
    if isinstance(centre, str):
        if centre not in CENTRES:
            raise ParameterError("centre", "must be two numbers (row, column), 'fft' or 'middle'", centre)
        return CENTRES[centre](shape[0]), CENTRES[centre](shape[1])
    if centre is not None:
        return _pair(centre, shape)
    if shape[0] % 2 == 0 or shape[1] % 2 == 0:
        raise ParameterError(
            "centre",
            f"must be given for even numbers of samples, got {shape[0]} x {shape[1]}",
            hint="pass 'fft' for the sample n // 2 (after fftshift), 'middle' for (n - 1) / 2, or (row, column)",
        )
    return shape[0] // 2, shape[1] // 2


def _at_coordinates(
    psf: NDArray[Any], x_um: Any, y_um: Any, given: dict[str, Any]
) -> tuple[NDArray[Any], float, tuple[float, float]]:
    """Return PSFs with ascending coordinates, their pitch and the position of the image point."""
    for name, value in given.items():
        if value is not None:
            raise ParameterError(name, "must be omitted with 'sample_x_um' and 'sample_y_um', which contain it", value)
    steps_um, firsts_um = [], []
    for name, along, n in (("sample_x_um", x_um, psf.shape[3]), ("sample_y_um", y_um, psf.shape[2])):
        if along is None:
            raise ParameterError(name, "must be given with the other coordinates", along)
        at_um = finite_array(name, along, ndim=1)
        if at_um.size != n or n < 2:
            raise ParameterError(name, f"must have {n} values, at least 2, one per sample, got {at_um.size}")
        step_um = float(at_um[-1] - at_um[0]) / (n - 1)
        if step_um == 0.0 or np.abs(at_um - at_um[0] - step_um * np.arange(n)).max() > SAME_STEP * abs(step_um):
            raise ParameterError(name, "must have equal steps", hint="resample the PSF")
        if step_um < 0.0:
            psf, at_um = np.flip(psf, 3 if name == "sample_x_um" else 2), at_um[::-1]
        steps_um.append(abs(step_um))
        firsts_um.append(float(at_um[0]))
    if abs(steps_um[0] - steps_um[1]) > SAME_STEP * steps_um[0] / max(psf.shape[2:]):
        raise ParameterError(
            "sample_y_um",
            f"must have the steps of 'sample_x_um', {steps_um[0]:g} µm, got {steps_um[1]:g} µm",
            hint="resample the PSF to squares",
        )
    row, column = -firsts_um[1] / steps_um[0], -firsts_um[0] / steps_um[0]
    if not (0.0 <= row <= psf.shape[2] - 1 and 0.0 <= column <= psf.shape[3] - 1):
        raise ParameterError("sample_x_um", "and 'sample_y_um' must contain the image point, 0")
    return psf, steps_um[0], (row, column)


def _centred(psf: NDArray[Any], centre: tuple[float, float]) -> tuple[NDArray[Any], tuple[float, float]]:
    """
    Return PSFs that are padded so that the image point is in the middle sample.

    Returns the PSFs with odd numbers of samples, and the position (row, column) of the image point, at most half a sample from
    the middle one.
    """
    pads, found = [], []
    for at, n in zip(centre, psf.shape[2:], strict=True):
        middle = min(math.floor(at + 0.5), n - 1)
        half = max(middle, n - 1 - middle)
        pads.append((half - middle, half - (n - 1 - middle)))
        found.append(at + half - middle)
    n_padded = psf.shape[0] * psf.shape[1] * math.prod(n + sum(pad) for n, pad in zip(psf.shape[2:], pads, strict=True))
    if n_padded > MAX_VALUES:
        raise ParameterError(
            "centre", f"must be near the middle of the samples, of {psf.shape[2]} x {psf.shape[3]}", centre
        )
    return np.pad(psf, [(0, 0), (0, 0), *pads]), (found[0], found[1])


def with_common_window(psfs: Sequence[tuple[NDArray[Any], Any]]) -> tuple[NDArray[Any], tuple[float, float]]:
    """
    Return PSFs of different sizes as one array, padded around their image points.

    ``psfs``: values (n_y, n_x), and the position of the image point as in :meth:`PSFGrid.from_arrays`. Returns values (n, n_y,
    n_x) and the position (row, column). Raises ParameterError if the image points are at other places between samples.
    """
    padded = [_centred(values[np.newaxis, np.newaxis], _image_point(at, values.shape)) for values, at in psfs]
    n_y, n_x = (max(values.shape[axis] for values, _ in padded) for axis in (2, 3))
    if len(psfs) * n_y * n_x > MAX_VALUES:
        raise ParameterError("psf", f"must have at most {MAX_VALUES} values, got {len(psfs)} x {n_y} x {n_x}")
    stack, places = np.zeros((len(psfs), n_y, n_x), np.result_type(*(values for values, _ in padded))), []
    for k, (values, at) in enumerate(padded):
        top, left = (n_y - values.shape[2]) // 2, (n_x - values.shape[3]) // 2
        stack[k, top : top + values.shape[2], left : left + values.shape[3]] = values[0, 0]
        places.append((at[0] + top, at[1] + left))
    if np.ptp(places, axis=0).max() > SAME_STEP:
        raise ParameterError(
            "centre", "must be at the same place between samples for all PSFs", hint="resample them to one place"
        )
    return stack, places[0]


def _distinct(values: Floats, tolerance: float) -> Floats:
    """Return ascending values that differ by more than a tolerance."""
    ascending = np.sort(values)
    return ascending[np.concatenate(([True], np.diff(ascending) > tolerance))]
