"""The lens: from the light of a scene to the light on the sensor plane."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from foveasim.arrays import Floats, check_choice, check_count, check_number
from foveasim.errors import ParameterError, SamplingWarning
from foveasim.fields import Grid, PowerMap, SceneLike
from foveasim.optics.otf import RadialTables
from foveasim.parallel import thread_count
from foveasim.units import m_from_mm, m_from_um, um_from_nm

__all__ = ["Optics"]

#: Default padding: the radius that holds all but this share of a point's light ...
LOST_SHARE = 0.01
#: ... which for a clear circle is about ``2 / (π² share)`` in units of wavelength x f-number.
REACH_SHARE = 2.0 / math.pi**2
#: The paper's Eq. 5 asks for an aperture radius much larger than H λ / (p0 min(M, N)): this many times.
MUCH_LARGER = 10.0
#: For cells wider than this many λN diffraction is that of cells of this width: 0.3 % of the light goes astray, or less.
MAX_ALIASES = 128
PADDINGS = ("reflect", "edge", "zero", "periodic")


@dataclass(frozen=True, slots=True, kw_only=True)
class Optics:
    """
    A thin lens with a clear circular pupil, in focus.

    Parameters
    ----------
    focal_length_mm : float, mm
    f_number : float
        As engraved on the lens: focal length over pupil diameter.
    emission : {"lambertian", "isotropic"}
        ``"lambertian"``: the scene has a radiance L that is the same in all directions; irradiance falls as cos⁴ and
        is ``π L / (1 + 4 N²)`` on the axis, N the image-side f-number. ``"isotropic"``: Eq. 3 of the paper, points
        that radiate L (W/m²) evenly into a hemisphere; it falls as cos³ and is ``L / (8 N²)`` on the axis.
    transmission : float
        Share of the light that the glass lets through.
    source_pixel : {"point", "square"}
        Whether a picture's pixel shines from its centre (the paper) or evenly from its square.
    padding : {"reflect", "edge", "zero", "periodic"}
        What lies beyond the picture. ``"periodic"`` adds nothing: light that leaves on one side enters on the other,
        so that none is lost.
    padding_cells : int, optional
        Width of the padding; by default the radius that holds 99 % of a point's light.
    precision : {"single", "double"}
        Of the Fourier transforms and the maps.

    Raises
    ------
    ParameterError
        When a value is out of range.

    Notes
    -----
    Each cell of a map is the *mean* irradiance over the cell: the point spread function is integrated over the cell
    exactly, whatever its size (for cells wider than λN/2 the aliases of every frequency are summed).

    The Gauss conditions (pupil much smaller than the distances, small angles) make the point spread function the same
    all over the field, so a map is ``IFFT(FFT(scene * falloff) * OTF)``. ``π L / (1 + 4 N²)`` is the light from the cone
    that a flat pupil fills, seen from the image, where ISETCam's camera equation takes it too; ``π L / 4 N²`` is its limit for
    small apertures, and the isotropic ``L / (8 N²)`` is of that small-angle kind.
    """

    focal_length_mm: float
    f_number: float
    emission: Literal["lambertian", "isotropic"] = "lambertian"
    transmission: float = 1.0
    source_pixel: Literal["point", "square"] = "point"
    padding: Literal["reflect", "edge", "zero", "periodic"] = "reflect"
    padding_cells: int | None = None
    precision: Literal["single", "double"] = "single"

    def __post_init__(self) -> None:
        numbers = {
            "focal_length_mm": check_number(
                "focal_length_mm",
                self.focal_length_mm,
                above=0.0,
                at_least=0.01,
                at_most=1e6,
                cure="focal lengths are in mm",
            ),
            "f_number": check_number(
                "f_number",
                self.f_number,
                above=0.0,
                at_least=0.5,
                at_most=1e4,
                cure="no lens in air is faster than f/0.5",
            ),
            "transmission": check_number("transmission", self.transmission, above=0.0, at_most=1.0),
        }
        if self.padding_cells is not None:
            numbers["padding_cells"] = check_count("padding_cells", self.padding_cells, at_least=0, at_most=2**20)
        for name, number in numbers.items():
            object.__setattr__(self, name, number)
        check_choice("emission", self.emission, ("lambertian", "isotropic"))
        check_choice("source_pixel", self.source_pixel, ("point", "square"))
        check_choice("padding", self.padding, PADDINGS)
        check_choice("precision", self.precision, ("single", "double"))

    # -- geometry -------------------------------------------------------------------------------------------------

    def magnification(self, distance_m: float) -> float:
        """
        Size of the image over the size of the scene, ``D / H`` with ``1/f = 1/H + 1/D``.

        Raises
        ------
        ParameterError
            When the scene is not further away than the focal length.
        """
        focal_m = float(m_from_mm(self.focal_length_mm))
        distance_m = check_number("distance_m", distance_m, above=0.0)
        if distance_m <= focal_m:
            raise ParameterError(
                "distance_m",
                f"must be larger than the focal length, {focal_m:g} m, for an image to form",
                distance_m,
                "m",
            )
        return focal_m / (distance_m - focal_m)

    def working_f_number(self, distance_m: float) -> float:
        """Image-side f-number ``D / 2a`` when focused at a distance: the engraved one times (1 + magnification)."""
        return self.f_number * (1.0 + self.magnification(distance_m))

    def grid(self, scene: SceneLike) -> Grid:
        """The sensor-plane grid on which a scene's pixels are imaged, upright and centred on the axis."""
        shape = scene.basis.shape
        return Grid.centred((shape[1], shape[2]), scene.pitch_um * self.magnification(scene.distance_m))

    def irradiance_per_radiance(self, distance_m: float) -> float:
        """Irradiance on the axis over the scene's radiance (sr), transmission included."""
        n = self.working_f_number(distance_m)
        gain = math.pi / (1.0 + 4.0 * n * n) if self.emission == "lambertian" else 1.0 / (8.0 * n * n)
        return gain * self.transmission

    # -- light ----------------------------------------------------------------------------------------------------

    def power_map(self, scene: SceneLike, *, n_threads: int | None = None) -> PowerMap:
        """
        Irradiance on the sensor plane, one map for each wavelength.

        Parameters
        ----------
        scene : Scene
        n_threads : int, optional
            All cores by default.

        Returns
        -------
        PowerMap
            (n_wavelength, n_y, n_x), float32 or float64 as ``precision`` says, W/m² within each wavelength's band.

        Raises
        ------
        ParameterError, SimulationError
            When the scene is too near, or not finite.
        """
        n_bands = scene.wavelength_nm.size
        data = np.empty((n_bands, *scene.basis.shape[1:]), self._real_type())
        for band, cells in enumerate(self.weighted_maps(scene, np.eye(n_bands), n_threads=n_threads)):
            data[band] = cells
        return PowerMap(data, self.grid(scene), scene.wavelength_nm)

    def weighted_maps(
        self, scene: SceneLike, weights: Floats, *, n_threads: int | None = None
    ) -> Iterator[NDArray[Any]]:
        """
        Weighted sums of the power maps of all wavelengths, one after the other.

        Parameters
        ----------
        scene : Scene
        weights : (n_output, n_wavelength) float64
            Output c is ``sum_k weights[c, k] * power_map[k]``.
        n_threads : int, optional
            All cores by default.

        Returns
        -------
        maps : iterator of (n_y, n_x) float32 or float64
            Each is computed when it is asked for.

        Notes
        -----
        Since a sum over wavelengths can be taken before the inverse transform, and the scene is a sum of B basis
        images, the cost is B forward transforms and one inverse transform an output, for any number of wavelengths.
        """
        weights = np.asarray(weights, dtype=np.float64)
        cutoff_per_um = 1.0 / (um_from_nm(scene.wavelength_nm) * self.working_f_number(scene.distance_m))
        cutoff_per_um = np.minimum(cutoff_per_um, MAX_ALIASES / self.grid(scene).pitch_um)
        self._warn_if_too_small(cutoff_per_um, self.grid(scene))
        return self._weighted_maps(scene, weights, cutoff_per_um, thread_count(n_threads))

    def _weighted_maps(
        self, scene: SceneLike, weights: Floats, cutoff_per_um: Floats, n_threads: int
    ) -> Iterator[NDArray[Any]]:
        from foveasim.optics._transform import Transform, source_pixels

        grid = self.grid(scene)
        pad = self.padding_cells
        if pad is None:
            pad = math.ceil(REACH_SHARE / LOST_SHARE / (float(cutoff_per_um.min()) * grid.pitch_um))
        transform = Transform(
            shape=grid.shape,
            rows=source_pixels(grid.shape[0], self.padding, pad),
            columns=source_pixels(grid.shape[1], self.padding, pad),
            pitch_um=grid.pitch_um,
            f_max_per_um=float(cutoff_per_um.max()),
            sinc_power=1 if self.source_pixel == "point" else 2,
            real=self._real_type(),
            n_threads=n_threads,
        )
        table_of = RadialTables(cutoff_per_um, self._real_type())
        light = scene.spectrum_w_m2_sr_nm * scene.band_width_nm * self.irradiance_per_radiance(scene.distance_m)
        is_needed = np.array([[bool(np.any(output * spectrum)) for spectrum in light] for output in weights], bool)
        spectra: dict[int, NDArray[Any]] = {}
        for c, output in enumerate(weights):
            total: NDArray[Any] | None = None
            for b in (int(b) for b in np.flatnonzero(is_needed[c])):
                if b not in spectra:
                    spectra[b] = transform.forward(
                        scene.basis[b], *self._squared_tangents(scene), self._falloff_power()
                    )
                # The last use of a spectrum may overwrite it.
                is_last_use = not is_needed[c + 1 :, b].any()
                is_first_term = total is None
                if total is None:
                    total = spectra[b] if is_last_use else np.empty_like(spectra[b])
                transform.multiply(spectra[b], *table_of(output * light[b]), total, is_added=not is_first_term)
                if is_last_use:
                    del spectra[b]
            yield np.zeros(grid.shape, self._real_type()) if total is None else transform.inverse(total)

    # -- parts ----------------------------------------------------------------------------------------------------

    def _real_type(self) -> type[np.floating[Any]]:
        return np.float32 if self.precision == "single" else np.float64

    def _warn_if_too_small(self, cutoff_per_um: Floats, grid: Grid) -> None:
        """Warn where the paper's Eq. 5, a >> H λ / (p0 min(M, N)), does not hold."""
        # On the sensor side the ratio of its two sides is min(M, N) p / (2 λ N).
        ratio = 0.5 * min(grid.shape) * grid.pitch_um * float(cutoff_per_um.min())
        if ratio < MUCH_LARGER:
            height, width = (n * grid.pitch_um for n in grid.shape)
            warnings.warn(
                f"the image of the scene is only {width:.4g} x {height:.4g} µm, and the lens spreads a point over "
                f"{2.44 / float(cutoff_per_um.min()):.3g} µm: the paper's Eq. 5 wants the aperture's radius to be much "
                f"larger than H λ / (p0 min(M, N)), and it is {ratio:.3g} times that; take a larger picture or a smaller "
                "f-number, and see that pitch_um, distance_m and focal_length_mm are in their units",
                SamplingWarning,
                stacklevel=4,
            )

    def _squared_tangents(self, scene: SceneLike) -> tuple[Floats, Floats]:
        """(x0/H)² of the scene's columns and (y0/H)² of its rows."""
        _, n_y, n_x = scene.basis.shape
        step = float(m_from_um(scene.pitch_um)) / scene.distance_m
        return ((np.arange(n_x) - 0.5 * (n_x - 1)) * step) ** 2, ((np.arange(n_y) - 0.5 * (n_y - 1)) * step) ** 2

    def _falloff_power(self) -> int:
        return 4 if self.emission == "lambertian" else 3
