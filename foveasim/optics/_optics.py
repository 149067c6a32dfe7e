"""Lens model: from scene radiance to irradiance on the sensor plane."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import Limits, OwnCheck, Usual, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.show import view_method
from foveasim._core.threads import thread_count
from foveasim._core.validation import Bools, Floats, check_number, check_point, finite_array, read_only, wavelengths_nm
from foveasim.errors import ParameterError, SamplingWarning, warn
from foveasim.fields import Grid, PowerMap, SceneLike
from foveasim.incidence import N_RINGS, N_RINGS_OF_PUPILS, ChiefRayTable, Incidence, cone_irradiance_sr
from foveasim.optics._aperture import ACROSS_PER_BLUR, MAX_ACROSS, Aperture, PSFModel, Wavefront, overlaps
from foveasim.optics._illumination import IlluminationTable, solid_angles_sr
from foveasim.optics._point_images import Point, PointImages
from foveasim.optics.aberrations import LateralColour, Seidel, Zernike
from foveasim.optics.otf import MAX_ALIASES, ONE_POINT, PlaneTables, RadialTables, TableCache, Tables
from foveasim.optics.psfs._field import FieldPSFs
from foveasim.optics.psfs._grid import PSFGrid
from foveasim.optics.pupils import Half, Pupil
from foveasim.units import m_from_mm, m_from_um, um_from_m, um_from_nm

if TYPE_CHECKING:
    from foveasim.optics._depth import Layer, LayerLight, Layers
    from foveasim.optics._field_modes import FieldModes, FieldWeight
    from foveasim.optics._imaging import Imaging, MapRows
    from foveasim.optics._transform import Factor, Transform

FOCAL_LENGTH = Limits(above=0.0, at_least=0.01, at_most=1e6, hint="check the unit: focal lengths are in mm")
F_NUMBER = Limits(above=0.0, at_least=0.5, at_most=1e4, hint="f/0.5 is the limit for a lens in air")
EXIT_PUPIL = Limits(
    above=0.0, at_least=0.01, at_most=1e6, hint="distances of exit pupils are in mm, inf if telecentric"
)
#: Wavelength of the transmittance of pupils for rays.
CONE_NM = 550.0
#: Fraction of the PSF energy outside the default padding radius.
LOST_FRACTION = 0.01
#: Fraction of the PSF energy that an isoplanatic patch may displace.
PATCH_LOST_FRACTION = 0.002
#: Part of a layer of a scene with depth.
LayerPart: TypeAlias = Literal["light", "cover"]
#: Largest number of layers whose apertures are cached.
MAX_LAYERS = 256
#: Factor by which the aperture radius should exceed H λ / (p0 min(M, N)); the paper's Eq. 5 requires "much larger".
MIN_RADIUS_RATIO = 10.0
#: Largest number of cells along a source pixel.
MAX_OVERSAMPLE = 16
#: Cells per λN for which the energy of a point in a photosite of side λN is within 1e-3 at second order, for any position of
#: its edges: the largest error over 600 positions is 1.3e-3 at 5 cells and 6e-4 at 6 (gallery/03_edges_and_cells.py).
FINE_CELLS_PER_LAMBDA_N = 5.5
#: Largest relative error for photosites of side λN and n cells per λN, ``CELL_ERROR * n ** CELL_ERROR_POWER``, and its limit.
CELL_ERROR, CELL_ERROR_POWER, LARGEST_CELL_ERROR = 0.16, -3.1, 0.2
#: Points along each side of the picture between which the relative illumination is interpolated, linearly without overshoot.
ILLUMINATION_POINTS = 65
#: Rounding error of interpolated relative illumination.
ILLUMINATION_ROUNDING = 1e-12
#: An aplanatic lens has a sine of at most 1, and cones have a tangent radius of at most 1.
MIN_APLANATIC_F_NUMBER = 0.7072
#: Memory limit of a map: 16 GiB in single precision.
MAX_CELLS = 1 << 32
#: Memory limit of a map with automatic oversampling: 512 MiB in single precision.
MAX_AUTO_CELLS = 1 << 27
#: Limit of the cells around such a map, for the light that the blur spreads.
MAX_AUTO_PADDING_CELLS = 1 << 24


def _pitch_um(scene: SceneLike) -> float:
    """Return the pixel pitch of a scene, which a scene with ``fit`` does not have."""
    if scene.pitch_um is None:
        raise ParameterError(
            "scene",
            "must have a pixel pitch, which with 'fit' depends on the layout; pass camera.fit_scene(scene), or set 'pitch_um'",
        )
    return scene.pitch_um


def depth_of(scene: SceneLike) -> Floats | None:
    """Return the distance of each pixel of a scene with depth, (n_y, n_x) m."""
    return getattr(scene, "depth_m", None)


def _depth_range_m(scene: SceneLike) -> tuple[float, float] | None:
    """Return the smallest and the largest distance of a scene with depth."""
    return None if depth_of(scene) is None else getattr(scene, "depth_range_m")  # noqa: B009 -- not of every scene


def _is_pupil(pupil: object) -> bool:
    """Return whether an object is callable with x, y and a wavelength."""
    if not callable(pupil) or isinstance(pupil, type):
        return False
    try:
        inspect.signature(pupil).bind(0.0, 0.0, 0.0)
    except TypeError:
        return False
    except ValueError:  # builtin without a signature
        return True
    return True


class View(NamedTuple):
    """
    Image of a scene by a lens.

    Size over that of the scene, grid of its pixels, λN (µm), and automatic oversampling.
    """

    magnification: float
    grid: Grid
    lambda_n_um: Floats
    auto_oversample: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Optics(PointImages):
    """
    Thin lens with diffraction, aberrations, defocus and relative illumination.

    Parameters
    ----------
    focal_length_mm : float, mm
    f_number : float
        Nominal f-number: focal length over the diameter of the circle around the pupil.
    emission : {"lambertian", "isotropic"}
        ``"lambertian"``: the scene radiance L is the same in all directions; irradiance falls off as cos⁴ from its on-axis
        value (see ``lens``). ``"isotropic"``: Eq. 3 of the paper, points that radiate L (W/m²) uniformly into a hemisphere;
        irradiance falls off as cos³ and is ``L / (8 N²)`` on the axis.
    lens : {"thin", "aplanatic"}
        On-axis irradiance for a Lambertian scene of radiance L and the image-side f-number N: ``π L / (1 + 4 N²)`` for the
        thin lens of the paper and ISETCam, or ``π L / (4 N²)`` for an aplanatic lens, which satisfies Abbe's sine condition,
        as corrected photographic lenses do. The second is higher by 1.6 % at f/4, 3.2 % at f/2.8, 13 % at f/1.4.
    projection : {"auto", "rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"}
        Projection of the image: the image height f tan θ, f θ, 2 f sin(θ/2), 2 f tan(θ/2) or f sin θ of a ray at the angle θ
        to the axis, of a panorama. Without a lens model it is that of the lens. With one, it is that of the intermediate image,
        on which results do not depend. ``"auto"``: that nearest to the lens model of a camera, rectilinear without one. The
        image of a plane is rectilinear; for others, a camera needs a lens model.
    pupil_tilt : {"auto", "flat", "turning"}
        Whether the entrance pupil is a flat disc, which a ray at the angle θ meets with the area π a² cos θ, or turns towards
        the field, as in most fisheye lenses, with the area π a². Relative illumination is the area times the solid angle per
        area of the image: cos⁴ θ or cos³ θ for a rectilinear image. ``"auto"``: flat for rectilinear images, else turning.
    transmission : float
        Power transmittance of the glass.
    pupil : Annulus, Spider, Blades, Slit, PupilImage, callable, or a sequence of them, optional
        Pupil function within the circle; several are multiplied. A callable ``T(x, y, wavelength_nm)`` returns real or complex
        amplitudes of modulus at most 1 at points in units of the circle's radius. By default a clear circle.
    zernike : Zernike, optional
        Aberrations that are constant over the field; each may depend on the wavelength.
    seidel : Seidel, optional
        Aberrations that depend on the distance from the axis.
    psfs : PSFGrid, optional
        Point spread functions from another program or a measurement, at any distance of the scene, instead of ``pupil``,
        ``zernike`` and ``seidel``.
    relative_illumination : IlluminationTable, optional
        Irradiance over image height, instead of the falloff of ``emission`` and the relative illumination of ``psfs``.
    focus_distance_m : float, optional, m
        Distance at which the lens is focused, infinity allowed; by default the distance of the scene. Scenes at other
        distances are defocused.
    lateral_colour : LateralColour, optional
        Image size per wavelength. Outside a smaller image the power map is 0.
    field_tolerance : float
        Fraction of the light of a point that may be displaced where aberrations vary over the field: half the integral of the
        absolute difference of the PSFs, or of their sums over map cells wider than λN/2. The PSFs at 9 x 9 points of the
        picture are a sum of modes, whose number follows.
    field_modes : "auto" or int
        Number of modes in addition to the mean PSF, instead of the tolerance.
    field_patches : int, optional
        Isoplanatic patches along each side of the picture instead of modes; the PSF is interpolated linearly between them. Many
        times slower. Energy beyond the reach of a patch, 0.2 % of the PSF, may be displaced.
    source_pixel : {"point", "square"}
        Whether a scene pixel emits from its centre (the paper) or uniformly from its square.
    oversample : int or "auto"
        Map cells along a side of a source pixel, k: maps have k x k times as many cells, each with its exact mean. ``"auto"``
        is 1, except in a :class:`foveasim.Camera`, which chooses k for each scene by :meth:`auto_oversample`. Finer cells
        resolve the irradiance under photosites whose edges cut cells. They also resolve the lattice of point emitters if
        source pixels are wider than λN; use ``source_pixel="square"`` in this case. A camera warns if an automatic choice gives
        photosites an error above 1e-3.
    padding : {"reflect", "edge", "zero", "periodic"}
        Continuation of the picture beyond its boundary. ``"periodic"`` adds no cells: power that leaves on one side enters on
        the opposite side, so that power is conserved.
    padding_cells : int, optional
        Width of the padding; by default approximately the radius of 99 % encircled energy.
    precision : {"single", "double"}
        Precision of the Fourier transforms and the maps.
    exit_pupil_mm : float, optional, mm
        Distance of the exit pupil from the sensor, infinity for a telecentric lens; by default that of the thin lens, its image
        distance. It determines the chief ray angles at the sites of a sensor with ``pixel_optics`` (see :meth:`incidence`), and
        the relative illumination: the integral of the radiance over the cone at each point, instead of the law of the fourth
        power of the cosine of the field angle. For pupils with a central obscuration it is that of the clear circle.
    pupil_part : {"full", "left", "right"}
        Half of the pupil behind the photodiodes of one side of dual pixels. The energies of both halves add up to that of the
        full pupil, but not their PSFs, since the halves diffract separately: use the full pupil for the sum.
    chief_ray : ChiefRayTable, optional
        Chief ray angles at image heights, instead of an exit pupil; beyond the last height, those there.

    Notes
    -----
    Each cell of a map contains the *mean* irradiance over the cell: the point spread function is integrated exactly over
    cells of any size (for cells wider than λN/2 the aliases of each frequency are summed).

    Under the Gauss conditions (pupil much smaller than the distances, small angles) the point spread function is
    shift-invariant, so that a map is ``IFFT(FFT(scene * falloff) * OTF)``.

    The irradiance on the axis is ``π L sin²α``, α the half-angle of the image-side cone (Born and Wolf, Principles of Optics,
    section on the photometry of images). A flat pupil of radius a at the distance D has ``tan α = a / D = 1 / 2N``, which gives
    ``π L / (1 + 4 N²)``: the thin lens. The principal surface of an aplanatic lens is a sphere around the image, so that
    ``sin α = 1 / 2N`` (Abbe's sine condition), which gives ``π L / 4 N²`` at every aperture. The same follows from the flux
    through the entrance pupil, ``π L a² / D²``, spread over the geometric image. Eq. 3 of the paper specifies that flux, so
    the isotropic ``L / (8 N²)`` is consistent with the aplanatic lens. The two agree in the limit of large N.

    The clear circle in focus has a closed-form OTF. The OTF of any other pupil is the autocorrelation of the sampled pupil; it
    is complex for an asymmetric pupil. The sampling density increases with the geometric blur of the aberrations; for a circle,
    the result is within 7e-4 of the closed form. In both cases OTF(0) = 1, so that the transmitted power is exact. A defocused
    scene has the path difference ``(a²/2) (1/H - 1/H_focus)`` at the edge of a pupil of radius a: Goodman, Introduction to
    Fourier Optics, section on focusing errors.

    The pupil, like the picture, is upright in sensor coordinates: the PSF moves in the direction in which the wavefront
    increases.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    >>> round(lens.working_f_number(0.5), 4), round(lens.strehl(550.0), 6)
    (2.8455, 1.0)
    >>> (
    ...     round(float(lens.mtf(100.0, 550.0)), 4),
    ...     round(float(lens.encircled_energy(3.0, 550.0)), 4),
    ... )
    (0.8047, 0.9035)
    """

    focal_length_mm: Annotated[float, FOCAL_LENGTH, Usual(1.0, 200.0)]
    f_number: Annotated[float, F_NUMBER, Usual(1.0, 32.0)]
    emission: Literal["lambertian", "isotropic"] = "lambertian"
    lens: Literal["thin", "aplanatic"] = "thin"
    projection: Literal["auto", "rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"] = "auto"
    pupil_tilt: Literal["auto", "flat", "turning"] = "auto"
    transmission: Annotated[float, Limits(above=0.0, at_most=1.0)] = 1.0
    pupil: OwnCheck[Pupil | Sequence[Pupil] | None] = None
    zernike: Zernike | None = None
    seidel: Seidel | None = None
    psfs: PSFGrid | None = None
    relative_illumination: IlluminationTable | None = None
    focus_distance_m: Annotated[float | None, Usual(0.05, 100.0)] = None
    lateral_colour: LateralColour | None = None
    field_patches: Annotated[int | None, Limits(at_least=1, at_most=64), Usual(1, 15)] = None
    field_tolerance: Annotated[float, Limits(above=0.0, at_most=1.0), Usual(0.001, 0.1)] = 0.01
    field_modes: Annotated[int | Literal["auto"], Limits(at_least=0, at_most=80), Usual(0, 24)] = "auto"
    source_pixel: Literal["point", "square"] = "point"
    oversample: Annotated[int | Literal["auto"], Limits(at_least=1, at_most=MAX_OVERSAMPLE)] = "auto"
    padding: Literal["reflect", "edge", "zero", "periodic"] = "reflect"
    padding_cells: Annotated[int | None, Limits(at_least=0, at_most=2**20)] = None
    precision: Literal["single", "double"] = "single"
    exit_pupil_mm: Annotated[float | None, Usual(1.0, 200.0)] = None
    pupil_part: Literal["full", "left", "right"] = "full"
    chief_ray: ChiefRayTable | None = None
    _cache: TableCache = field(default_factory=TableCache, init=False, repr=False, compare=False)

    __repr__ = short_repr

    _repr_html_ = view_method("to_html")

    def __post_init__(self) -> None:
        check_declared(self)
        if self.focus_distance_m is not None:
            distance_m = self._check_distance("focus_distance_m", self.focus_distance_m)
            object.__setattr__(self, "focus_distance_m", distance_m)
        if isinstance(self.pupil, Sequence):
            object.__setattr__(self, "pupil", tuple(self.pupil))
        if not all(_is_pupil(pupil) for pupil in self._pupils()):
            raise ParameterError(
                "pupil", "must be a pupil of foveasim.optics, or a callable T(x, y, wavelength_nm)", self.pupil
            )
        if self.psfs is not None:
            for name in ("pupil", "zernike", "seidel", "pupil_part"):
                if getattr(self, name) not in (None, "full"):
                    raise ParameterError(name, "must not be given with 'psfs', which contain it", getattr(self, name))
            if self.relative_illumination is not None and self.psfs.relative_illumination is not None:
                raise ParameterError(
                    "relative_illumination", "must not be given with that of 'psfs'", self.relative_illumination
                )
        if self.exit_pupil_mm is not None:
            distance_mm = self.exit_pupil_mm
            if distance_mm != math.inf:
                distance_mm = EXIT_PUPIL.check("exit_pupil_mm", distance_mm)
            object.__setattr__(self, "exit_pupil_mm", distance_mm)
            if self.chief_ray is not None:
                raise ParameterError("exit_pupil_mm", "must not be given with 'chief_ray'", distance_mm, "mm")
        self._require_lambertian(self.projection)
        if self.field_patches is not None and self.is_varying and self.padding == "periodic":
            raise ParameterError(
                "padding",
                "must not be 'periodic' with 'field_patches'",
                hint="choose 'reflect', 'edge' or 'zero', or omit 'field_patches': patches beyond the picture are undefined",
            )

    def _require_lambertian(self, projection: str) -> None:
        if projection not in ("auto", "rectilinear") and self.emission != "lambertian":
            raise ParameterError(
                "emission",
                f"must be 'lambertian' for the {projection} projection: isotropic points are those of a plane",
                self.emission,
            )

    # -- geometry -------------------------------------------------------------------------------------------------

    def _check_distance(self, name: str, distance_m: float) -> float:
        focal_m = float(m_from_mm(self.focal_length_mm))
        if isinstance(distance_m, float) and distance_m == math.inf:
            return math.inf
        distance_m = check_number(name, distance_m, above=0.0)
        if distance_m <= focal_m:
            raise ParameterError(
                name, f"must be larger than the focal length, {focal_m:g} m, for an image to form", distance_m, "m"
            )
        return distance_m

    def _image_distance_mm(self, distance_m: float) -> float:
        """
        Return the sensor distance D from the pupil, ``1/f = 1/H + 1/D``.

        H is the focus distance, or the distance of the scene if the focus distance is not set.
        """
        focus_m = distance_m if self.focus_distance_m is None else self.focus_distance_m
        return self.focal_length_mm / (1.0 - float(m_from_mm(self.focal_length_mm)) / focus_m)

    def magnification(self, distance_m: float) -> float:
        """
        Return the image size over the scene size, ``D / H``.

        D is the sensor distance, ``1/f = 1/H_focus + 1/D``, and H is ``distance_m``.

        Raises
        ------
        ParameterError
            When the scene is not farther away than the focal length.
        """
        distance_m = self._check_distance("distance_m", distance_m)
        return float(m_from_mm(self._image_distance_mm(distance_m))) / distance_m

    def working_f_number(self, distance_m: float) -> float:
        """
        Return the image-side f-number ``D / 2a``.

        For a scene in focus, it is the nominal f-number times (1 + magnification).
        """
        distance_m = self._check_distance("distance_m", distance_m)
        return self.f_number * self._image_distance_mm(distance_m) / self.focal_length_mm

    def defocus_um(self, distance_m: float) -> float:
        """
        Return the defocus path difference at the pupil edge in µm.

        It is positive for a scene nearer than the focus distance.

        Raises
        ------
        ParameterError
            When the scene is not farther away than the focal length.
        """
        return self._defocus_um(self._check_distance("distance_m", distance_m))

    def _defocus_um(self, distance_m: float) -> float:
        if self.focus_distance_m is None:
            return 0.0
        radius_m = 0.5 * float(m_from_mm(self.focal_length_mm)) / self.f_number
        return float(um_from_m(0.5 * radius_m**2 * (1.0 / distance_m - 1.0 / self.focus_distance_m)))

    def incidence(
        self, field_um: ArrayLike, distance_m: float | None = None, *, displacement_um: tuple[float, float] = (0.0, 0.0)
    ) -> Incidence:
        """
        Return the cones of light at positions of the image.

        Parameters
        ----------
        field_um : (n, 2) float64, µm
            Positions relative to the optical axis, for a sensor that is not displaced.
        distance_m : float, optional, m
            Distance of the scene; by default that at which the lens is focused, or infinity.
        displacement_um : (x, y), µm
            Displacement of the sensor behind the lens.

        Returns
        -------
        Incidence
            Cones around chief rays from the centre of the exit pupil, ``t = r / D``, or from the table. Their tangent radius is
            that of the flat pupil, ``1 / 2N`` with the image-side f-number N, or ``1 / sqrt(4 N² - 1)`` for an aplanatic lens,
            whose sine is ``1 / 2N``. Rays are weighted with the transmittance of the pupil at 550 nm.

        Raises
        ------
        ParameterError
            When the scene is not farther away than the focal length, or a position is beyond the table of chief rays.

        Examples
        --------
        >>> import foveasim as fs
        >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.0, exit_pupil_mm=10.0)
        >>> cone = lens.incidence([[0.0, 0.0], [0.0, 2000.0]])
        >>> cone.radius, cone.chief_ray.tolist()
        (0.25, [[0.0, 0.0], [0.0, 0.2]])
        """
        if distance_m is None:
            distance_m = math.inf if self.focus_distance_m is None else self.focus_distance_m
        distance_m = self._check_distance("distance_m", distance_m)
        distance_mm = self._image_distance_mm(distance_m) if self.exit_pupil_mm is None else self.exit_pupil_mm
        pupils = self._pupils()

        def transmission(x: Floats, y: Floats) -> Floats:
            return np.prod([np.square(np.abs(pupil(x, y, CONE_NM))) for pupil in pupils], axis=0)

        return Incidence(
            np.asarray(field_um),
            radius=self._cone_radius(distance_m),
            exit_pupil_um=float(um_from_m(m_from_mm(distance_mm))),
            table=self.chief_ray,
            displacement_um=displacement_um,
            transmission=transmission if pupils else None,
            n_rings=N_RINGS_OF_PUPILS if pupils else N_RINGS,
        )

    def _cone_radius(self, distance_m: float) -> float:
        """Return the tangent of the half-angle of the image-side cone."""
        n = self.working_f_number(distance_m)
        if self.lens == "thin":
            return 0.5 / n
        if n <= MIN_APLANATIC_F_NUMBER:
            raise ParameterError(
                "f_number",
                f"must be > {MIN_APLANATIC_F_NUMBER} at the image of an aplanatic lens for cones of light",
                n,
            )
        return 1.0 / math.sqrt(4.0 * n * n - 1.0)

    def grid(self, scene: SceneLike) -> Grid:
        """Return the upright sensor-plane grid of the scene pixels, centred as the scene."""
        return self._view(scene).grid

    def _view(self, scene: SceneLike) -> View:
        """Return what follows from the geometry and the wavelengths of a scene."""
        geometry = scene.basis.shape[1:], scene.pitch_um, scene.distance_m, tuple(scene.centre_um)
        key = *geometry, scene.wavelength_nm.tobytes(), _depth_range_m(scene)
        found: View = self._cache.views.get(key, lambda: self._make_view(scene))
        return found

    def _make_view(self, scene: SceneLike) -> View:
        _, n_y, n_x = scene.basis.shape
        magnification = self.magnification(scene.distance_m)
        x_um, y_um = scene.centre_um
        pitch_um, centre_um = _pitch_um(scene) * magnification, (x_um * magnification, y_um * magnification)
        grid = Grid.centred((n_y, n_x), pitch_um, centre_um)
        lambda_n_um = read_only(self.cut_off_um(scene.wavelength_nm, scene.distance_m))
        return View(magnification, grid, lambda_n_um, self._auto_oversample(scene, grid, lambda_n_um))

    def image_grids(self, scene: SceneLike) -> list[tuple[Grid, Bools]]:
        """
        Return the map grids, each with a mask of its wavelengths, (n_wavelength,) bool.

        There is one grid, ``oversample`` times finer than :meth:`grid`, unless lateral chromatic aberration gives images of
        different sizes. The cells scale with the image size, so that no picture is resampled.
        """
        grid = self.grid(scene)
        if self.lateral_colour is None:
            return [(self._refine(grid), np.ones(scene.wavelength_nm.size, bool))]
        sizes = self.lateral_colour.at(scene.wavelength_nm)
        x_um, y_um = grid.centre_um
        return [
            (
                self._refine(Grid.centred(grid.shape, grid.pitch_x_um * size, (x_um * size, y_um * size))),
                sizes == size,
            )
            for size in np.unique(sizes).tolist()
        ]

    @property
    def _n_fine(self) -> int:
        """Map cells along a side of a source pixel."""
        return 1 if self.oversample == "auto" else self.oversample

    def _refine(self, grid: Grid) -> Grid:
        """Return the grid of map cells for a grid of source pixels."""
        n_y, n_x = grid.shape
        return Grid((self._n_fine * n_y, self._n_fine * n_x), grid.pitch_x_um / self._n_fine, grid.origin_um)

    def resolve_oversample(self, scene: SceneLike) -> Optics:
        """
        Return a lens with a numerical ``oversample``, chosen for a scene if it is "auto".

        Both lenses share the cache of OTF tables.
        """
        if self.oversample != "auto":
            return self
        lens = copy(self)  # with the same cache; all other parameters are valid
        object.__setattr__(lens, "oversample", self.auto_oversample(scene))
        return lens

    def auto_oversample(self, scene: SceneLike) -> int:
        """
        Choose the number of map cells along a side of a source pixel.

        Parameters
        ----------
        scene : Scene

        Returns
        -------
        k : int
            The smallest number with at least 5.5 cells per λN at the shortest wavelength, so that the fraction of a point's
            energy that a photosite of side λN collects is accurate to 1e-3 at second order. It is smaller if the map would
            exceed 2^27 cells, or the padding around it, which strong aberrations require, 2^24 cells, and at most 16. It is 1
            if the source pixels are points and farther apart than λN, where finer cells would resolve single emitters. A camera
            warns where :meth:`auto_oversample_error` exceeds 1e-3.
        """
        return self._view(scene).auto_oversample

    def _auto_oversample(self, scene: SceneLike, grid: Grid, lambda_n_um: Floats) -> int:
        per_lambda_n = float(lambda_n_um.min()) / grid.pitch_x_um
        if per_lambda_n < 1.0 and self.source_pixel == "point":
            return 1
        wanted = math.ceil(FINE_CELLS_PER_LAMBDA_N / per_lambda_n * (1.0 - 1e-9))
        n_pixels = math.prod(scene.basis.shape[1:])
        affordable = math.isqrt(MAX_AUTO_CELLS // n_pixels) if n_pixels else 1
        wanted = max(1, min(wanted, affordable, MAX_OVERSAMPLE))
        if wanted == 1:
            return 1
        n_padding = self._n_padding_pixels(scene, grid, lambda_n_um)
        return max(1, min(wanted, math.isqrt(MAX_AUTO_PADDING_CELLS // max(n_padding, 1))))

    def _n_padding_pixels(self, scene: SceneLike, grid: Grid, lambda_n_um: Floats) -> int:
        """Return the number of source pixels that transforms add around a scene, for the blur."""
        from foveasim.optics._transform import source_pixels

        pad = self.padding_cells
        if pad is None:
            pixels = Grid.centred(grid.shape, grid.pitch_x_um, grid.centre_um)
            pad = max(
                self._reach_cells(scene, pixels, aperture, lambda_n_um, LOST_FRACTION)
                for aperture in self._extreme_apertures(scene)
            )
        return math.prod(source_pixels(n, self.padding, pad).size for n in grid.shape) - math.prod(grid.shape)

    def auto_oversample_error(self, scene: SceneLike) -> float:
        """
        Return the expected error of photosites of side λN due to the cells of the map.

        Parameters
        ----------
        scene : Scene

        Returns
        -------
        error : float
            Largest error over positions, relative to the mean of a scene of independent random pixels. For n cells per λN at
            the shortest wavelength it is approximately ``0.16 n ** -3.1``, and at most 0.2: measured for square source
            pixels of 0.97 to 8 λN, and 300 sites each, against maps of 22 cells per λN. For points farther apart than λN it is
            the error for square pixels of the same size.
        """
        n_cells = self.auto_oversample(scene) if self.oversample == "auto" else self.oversample
        cells = n_cells * self._pixels_per_lambda_n(scene)
        return float(min(LARGEST_CELL_ERROR, CELL_ERROR * cells**CELL_ERROR_POWER))

    def _pixels_per_lambda_n(self, scene: SceneLike) -> float:
        """Return source pixels per λN at the shortest wavelength."""
        view = self._view(scene)
        return float(view.lambda_n_um.min()) / view.grid.pitch_x_um

    def irradiance_per_radiance(self, distance_m: float) -> float:
        """Return on-axis irradiance over scene radiance (sr), including the transmission."""
        n = self.working_f_number(distance_m)
        sin2 = 0.25 / (n * n) if self.lens == "aplanatic" or self.emission == "isotropic" else 1.0 / (1.0 + 4.0 * n * n)
        return (math.pi if self.emission == "lambertian" else 0.5) * sin2 * self.transmission

    def check(self, scene: SceneLike) -> None:
        """
        Validate the lens for a scene without computing a map.

        Raises
        ------
        ParameterError
            When the scene is not a Scene or is too near, the pupil is empty, or the aberrations exceed the largest blur.
        """
        grid, is_deep = self.grid(scene), depth_of(scene) is not None
        for aperture in self._extreme_apertures(scene):
            if aperture.is_clear_circle or (
                is_deep and isinstance(aperture, Aperture) and aperture.is_defocused_circle
            ):
                continue
            for wave_nm in scene.wavelength_nm:
                aperture.transmittance(float(wave_nm))
                for point_um in self._field_points_um(grid):
                    aperture.n_across(float(wave_nm), point_um)

    # -- irradiance -----------------------------------------------------------------------------------------------

    def power_map(self, scene: SceneLike, *, n_threads: int | None = None, reference: bool = False) -> PowerMap:
        """
        Compute the irradiance on the sensor plane for each wavelength.

        Parameters
        ----------
        scene : Scene
        n_threads : int, optional
            All cores by default.
        reference : bool
            For a scene with depth: rays through 288 points of the pupil, at each of which near layers hide far ones, without
            diffraction. Slow; shows the error of layers that cover each other.

        Returns
        -------
        PowerMap
            (n_wavelength, k n_y, k n_x) with k = ``oversample``, float32 or float64 according to ``precision``, W/m² per
            wavelength band.

        Raises
        ------
        ParameterError, SimulationError
            When the scene is too near or not finite.
        """
        grid = self._refine(self.grid(scene))
        n_bands = scene.wavelength_nm.size
        data = np.empty((n_bands, *grid.shape), self._real_type())
        if reference:
            self._write_reference(scene, grid, data)
            return PowerMap(read_only(data), grid, scene.wavelength_nm)
        for band, cells in enumerate(self.weighted_maps(scene, np.eye(n_bands), n_threads=n_threads)):
            data[band] = cells
        return PowerMap(read_only(data), grid, scene.wavelength_nm, projection=scene.projection)

    def weighted_maps(
        self, scene: SceneLike, weights: Floats, *, grid: Grid | None = None, n_threads: int | None = None
    ) -> Iterator[NDArray[Any]]:
        """
        Yield weighted sums of the power maps over wavelength.

        Parameters
        ----------
        scene : Scene
        weights : (n_output, n_wavelength) float64
            Output c is ``sum_k weights[c, k] * power_map[k]``.
        grid : Grid, optional
            One of :meth:`image_grids`; only its wavelengths may have nonzero weights. By default the grid without lateral
            chromatic aberration, to which images of other sizes are resampled by the areas of overlap of the cells.
        n_threads : int, optional
            All cores by default.

        Returns
        -------
        maps : iterator of (k n_y, k n_x) float32 or float64
            Computed lazily.

        Notes
        -----
        The sum over wavelengths is taken before the inverse transform, and the scene is a sum of B basis images. The cost is
        therefore B forward transforms, and one inverse transform per output, for any number of wavelengths. This cost applies
        to each image size with lateral chromatic aberration, and to each isoplanatic patch with field-dependent aberrations.

        The sums of OTFs that multiply the basis images are evaluated for each wavelength, or for each pair of an output and a
        basis image, whichever are fewer: a hyperspectral scene of B independent bands requires B.

        Memory: the spectra of the outputs or those of the basis images, whichever are fewer, one more spectrum, and one map.
        With more basis images than outputs, the first map is available after all forward transforms.
        """
        rows_of_maps = self.weighted_rows(scene, weights, grid=grid, n_threads=n_threads)
        n_y = self._refine(self.grid(scene)).shape[0]

        def complete(rows: MapRows) -> NDArray[Any]:
            return rows(0, n_y)

        # Unlike a generator, it has no reference to a spectrum while its map is processed.
        return map(complete, rows_of_maps)

    def weighted_rows(
        self, scene: SceneLike, weights: Floats, *, grid: Grid | None = None, n_threads: int | None = None
    ) -> Iterator[MapRows]:
        """
        Yield functions that compute rows of the maps of :meth:`weighted_maps`.

        Only their spectra are in memory, for maps that are processed in strips. With aberrations that vary over the field, or
        lateral chromatic aberration without ``grid``, complete maps are in memory.

        Parameters
        ----------
        scene, weights, grid, n_threads
            As for :meth:`weighted_maps`.

        Yields
        ------
        rows : callable
            ``rows(first, last)`` returns the rows ``first`` to ``last - 1``, (n, k n_x) float32 or float64.
        """
        common = self._refine(self.grid(scene))
        weights = finite_array("weights", weights, ndim=2)
        if weights.shape[1] != scene.wavelength_nm.size:
            raise ParameterError(
                "weights",
                f"must have shape (n_output, {scene.wavelength_nm.size}), one column per wavelength, got {weights.shape}",
            )
        if grid is not None and not grid.is_square:
            raise ParameterError("grid", "must have square cells, like the scene pixels", grid.pitch_um, "µm")
        self._warn_if_too_small(self._lambda_n_um(scene), common)
        if math.prod(common.shape) > MAX_CELLS:
            raise ParameterError(
                "oversample", f"must give a map of at most {MAX_CELLS:,} cells, got {common.shape}", self.oversample
            )
        if grid is not None or self.lateral_colour is None:
            return self._maps(scene, weights, grid or common, thread_count(n_threads))
        return self._maps_on_one_grid(scene, weights, thread_count(n_threads))

    def _maps_on_one_grid(self, scene: SceneLike, weights: Floats, n_threads: int) -> Iterator[MapRows]:
        from foveasim.optics._imaging import rows_of

        to = self._refine(self.grid(scene))
        groups = self.image_grids(scene)
        onto = [
            [
                overlaps(n, to.pitch_x_um, n, grid.pitch_x_um, to_um - from_um)
                for n, to_um, from_um in zip(to.shape, to.centre_um[::-1], grid.centre_um[::-1], strict=True)
            ]
            for grid, _ in groups
        ]
        for output in weights:
            total = np.zeros(to.shape)
            for (grid, is_of_it), (along_y, along_x) in zip(groups, onto, strict=True):
                if np.any(output * is_of_it):
                    rows = next(self._maps(scene, (output * is_of_it)[np.newaxis], grid, n_threads))
                    total += (along_x @ (along_y @ rows(0, grid.shape[0])).T).T
            yield partial(rows_of, total.astype(self._real_type()))

    def _maps(self, scene: SceneLike, weights: Floats, grid: Grid, n_threads: int) -> Iterator[MapRows]:
        if depth_of(scene) is not None:
            return self._maps_with_depth(scene, weights, grid, n_threads)
        return self._plane_maps(scene, weights, grid, n_threads)

    def _plane_maps(
        self,
        scene: SceneLike,
        weights: Floats,
        grid: Grid,
        n_threads: int,
        object_m: float | None = None,
        layer_part: LayerPart | None = None,
    ) -> Iterator[MapRows]:
        from foveasim.optics._imaging import isoplanatic_maps

        imaging, tables_at = self.imaging(
            scene, weights, grid=grid, n_threads=n_threads, object_m=object_m, layer_part=layer_part
        )
        if self.field_patches is None or not self.is_varying:
            return imaging.maps(tables_at((0.0, 0.0)))
        return isoplanatic_maps(imaging, self.n_patches, tables_at)

    def _maps_with_depth(self, scene: SceneLike, weights: Floats, grid: Grid, n_threads: int) -> Iterator[MapRows]:
        """Yield maps of a scene with depth; all maps are in memory together."""
        from foveasim.optics._depth import composed_maps, mean_spectrum
        from foveasim.optics._imaging import rows_of

        lens = self._focused(scene)
        layers = lens._layers(scene)  # noqa: SLF001 -- same class
        if len(layers.layers) == 1 and lens._is_of_planes(scene, layers.layers[0].distance_m):  # noqa: SLF001
            yield from lens._plane_maps(scene, weights, grid, n_threads, layers.layers[0].distance_m)  # noqa: SLF001
            return

        def maps_of(light: LayerLight, layer: Layer, is_cover: bool) -> Iterator[MapRows]:
            part: LayerPart = "cover" if is_cover else "light"
            return lens._plane_maps(light, weights, grid, n_threads, layer.distance_m, part)  # noqa: SLF001

        white = lens._on_axis_w_m2(scene, mean_spectrum(scene)[np.newaxis], grid)[0]  # noqa: SLF001
        maps = composed_maps(scene, layers, maps_of, weights @ white, grid.shape, self._real_type(), n_threads)
        lens._apply_illumination(maps, scene, grid)  # noqa: SLF001
        for complete in maps:
            yield partial(rows_of, complete)

    def _is_of_planes(self, scene: SceneLike, object_m: float) -> bool:
        """Return whether the defocus at a distance is within the limit of scenes that are planes."""
        aperture = self._aperture(object_m)
        if not (isinstance(aperture, Aperture) and aperture.is_defocused_circle):
            return True
        blur = max(aperture.blur_lambda_n(wave_nm, (0.0, 0.0)) for wave_nm in scene.wavelength_nm.tolist())
        return blur * ACROSS_PER_BLUR <= MAX_ACROSS

    def _write_reference(self, scene: SceneLike, grid: Grid, data: NDArray[Any]) -> None:
        """Write maps of a scene with depth by rays through points of the pupil."""
        from foveasim.optics._depth import fine_pixels, reference_map

        if depth_of(scene) is None or self.is_varying or self.lateral_colour is not None:
            raise ParameterError(
                "reference",
                "must be False, except for a scene with depth and a lens whose aberrations are constant over the field",
                True,
            )
        lens, centre = self._focused(scene), (0.0, 0.0)
        layers = lens._layers(scene)  # noqa: SLF001 -- same class
        radiance_w_m2 = lens._on_axis_w_m2(scene, scene.spectrum_w_m2_sr_nm, grid)  # noqa: SLF001
        n_number = lens.working_f_number(scene.distance_m)
        for band, wave_nm in enumerate(scene.wavelength_nm.tolist()):
            pixels = np.einsum("byx,b->yx", scene.basis, radiance_w_m2[:, band], dtype=np.float64)

            def shifts_cells(layer: Layer, points: Floats, wave_nm: float = wave_nm) -> Floats:
                aperture = lens._aperture(layer.distance_m)  # noqa: SLF001
                assert isinstance(aperture, Aperture)
                return aperture.ray_slopes(points, wave_nm, centre) * (2.0 * n_number / grid.pitch_x_um)

            def transmittance(points: Floats, wave_nm: float = wave_nm) -> Floats:
                x, y = points.T
                every = [np.square(np.abs(pupil(x, y, wave_nm))) for pupil in self._pupils()]
                return np.asarray(np.prod([np.ones(x.size), *every], axis=0))

            fine = fine_pixels(layers, self._n_fine)
            image = np.kron(pixels, np.ones((self._n_fine, self._n_fine)))[np.newaxis]
            data[band] = reference_map(fine, image, shifts_cells, transmittance, self.padding)
        lens._apply_illumination(data, scene, grid)  # noqa: SLF001

    def _focused(self, scene: SceneLike) -> Optics:
        """Return the lens with a focus distance, that of the scene by default, and its own cache."""
        if self.psfs is not None:
            raise ParameterError(
                "psfs",
                "must not be given for a scene with depth: PSFs sampled at one distance do not determine those at others",
                self.psfs,
                hint="pass the Zernike coefficients of the design as 'zernike', since a wavefront can be defocused",
            )
        focus_m = scene.distance_m if self.focus_distance_m is None else self.focus_distance_m

        def create() -> Optics:
            lens = replace(self, focus_distance_m=focus_m)
            lens._cache.apertures.max_values = lens._cache.modes.max_values = MAX_LAYERS  # noqa: SLF001
            return lens

        found: Optics = self._cache.focused.get((focus_m, self.oversample), create)
        return found

    def _layers(self, scene: SceneLike) -> Layers:
        """Return the layers of a scene with depth, for a lens with a focus distance."""
        from foveasim.optics._depth import Layers

        depth_m, max_layers = depth_of(scene), getattr(scene, "depth_layers", None)
        assert depth_m is not None
        assert self.focus_distance_m is not None
        focus_m = self.focus_distance_m
        self._check_distance("depth_m", float(depth_m.min()))
        view = self._view(scene)
        cell_um = max(view.grid.pitch_x_um, 0.5 * float(view.lambda_n_um.min()))
        radius_um = 0.5 * float(um_from_m(m_from_mm(self.focal_length_mm))) / self.f_number
        blur_cells_m = radius_um * float(m_from_mm(self._image_distance_mm(focus_m))) / cell_um
        found: Layers = self._cache.layers.get(
            (id(depth_m), blur_cells_m, focus_m, max_layers),
            lambda: Layers.of(depth_m, blur_cells_m, focus_m, max_layers),
            owner=depth_m,
        )
        return found

    def _on_axis_w_m2(self, scene: SceneLike, spectrum_w_m2_sr_nm: Floats, grid: Grid) -> Floats:
        """Return the on-axis irradiance of spectra in each band on the cells of a grid."""
        aperture = self._aperture(scene.distance_m)
        transmittance = np.array([aperture.transmittance(float(w)) for w in scene.wavelength_nm])
        irradiance_w_m2 = (
            spectrum_w_m2_sr_nm * scene.band_width_nm * transmittance * self.irradiance_per_radiance(scene.distance_m)
        )
        pixel_um = grid.pitch_x_um * self._n_fine
        return irradiance_w_m2 * (_pitch_um(scene) * self._view(scene).magnification / pixel_um) ** 2

    def _apply_illumination(self, maps: NDArray[Any], scene: SceneLike, grid: Grid) -> None:
        """Multiply maps on the cells of a grid by the relative illumination."""
        cells = Grid.centred(grid.shape, grid.pitch_x_um, grid.centre_um)
        illumination = self._illumination(cells, self._aperture(scene.distance_m), scene.distance_m)
        if illumination is None:
            x2, y2 = self._squared_tangents(scene, self._n_fine)
            for row, row_y2 in enumerate(y2):
                tangent2 = 1.0 + x2 + row_y2
                falloff = tangent2 * tangent2 if self._falloff_power == 4 else tangent2 ** (0.5 * self._falloff_power)
                maps[:, row] /= falloff.astype(maps.dtype)
        for part in illumination or []:
            maps *= part.at_pixels().astype(maps.dtype)

    @property
    def _falloff_power(self) -> int:
        """Exponent of the cosine of the field angle."""
        return (4 if self.emission == "lambertian" else 3) - (self.pupil_tilt == "turning")

    @property
    def n_patches(self) -> tuple[int, int]:
        """Numbers of isoplanatic patches along y and x."""
        n = self.field_patches
        return (1, 1) if n is None or not self.is_varying else (n, n)

    def imaging(
        self,
        scene: SceneLike,
        weights: Floats,
        *,
        grid: Grid | None = None,
        n_threads: int = 1,
        object_m: float | None = None,
        layer_part: LayerPart | None = None,
    ) -> tuple[Imaging, Callable[[tuple[float, float]], Tables]]:
        """
        Return the inputs of the computation of maps, for other transforms.

        Parameters
        ----------
        scene, weights, grid, n_threads
            As for :meth:`weighted_maps`.
        object_m : float, optional, m
            Distance that determines the defocus, by default that of the scene.
        layer_part : {"light", "cover"}, optional
            For a layer of a scene with depth: its light or its cover, without relative illumination.

        Returns
        -------
        imaging : Imaging
            Geometry, padding and weights.
        tables_at : callable
            OTF tables for the image point (x, y), µm; with modes of the field, those of all modes.
        """
        from foveasim.optics._imaging import Imaging

        grid = self._refine(self.grid(scene)) if grid is None else grid
        lambda_n_um = self._lambda_n_um(scene)
        object_m = scene.distance_m if object_m is None else object_m
        aperture = self._aperture(object_m)
        is_clear_circle = aperture.is_clear_circle
        defocus_um = 0.0
        if layer_part is not None and isinstance(aperture, Aperture) and aperture.is_defocused_circle:
            is_clear_circle, defocus_um = True, aperture.defocus_um
        # Of the lens, whatever the cells are.
        blur_um = 4.0 * defocus_um * lambda_n_um / um_from_nm(scene.wavelength_nm)
        pixels = Grid.centred(
            (scene.basis.shape[1], scene.basis.shape[2]), grid.pitch_x_um * self._n_fine, grid.centre_um
        )
        if is_clear_circle:
            lambda_n_um = np.maximum(lambda_n_um, grid.pitch_x_um / MAX_ALIASES)
        irradiance_w_m2 = self._on_axis_w_m2(scene, scene.spectrum_w_m2_sr_nm, grid)
        modes = self._field_modes(scene, n_threads, object_m) if self._has_modes() else None
        if modes is not None:
            # Mode k of image b is an image, and mode k of wavelength λ a wavelength.
            n_modes = modes.n_modes
            irradiance_w_m2 = np.einsum("bw,kl->bklw", irradiance_w_m2, np.eye(n_modes)).reshape(
                -1, n_modes * irradiance_w_m2.shape[1]
            )
            weights = np.tile(weights, n_modes)
        tangent2_x, tangent2_y = self._squared_tangents(scene)
        illumination = self._illumination(pixels, aperture, scene.distance_m) if layer_part is None else []
        basis = scene.basis
        if illumination is None and scene.projection != "rectilinear":
            illumination, basis = [], np.multiply(basis, self._law_at_pixels(scene), dtype=self._real_type())
        if illumination is not None:
            tangent2_x, tangent2_y = np.zeros_like(tangent2_x), np.zeros_like(tangent2_y)
        # Cache key: a factor depends on these, the lens and the weights.
        place = None if modes is None else grid
        spectrum_key = scene.wavelength_nm.tobytes(), object_m, grid.shape, grid.pitch_x_um, self._n_fine, place

        def cached_factor(weight: Floats, transform: Transform, table_of: Tables) -> Factor:
            # Factors of a clear circle are real and even.
            n_columns, n_rows = transform.spectrum_shape
            n_numbers = n_columns * (n_rows // 2 + 1 if is_clear_circle else 2 * n_rows)
            cached = self._cache.factor(
                spectrum_key, weight, n_numbers, lambda: transform.complete(transform.factor(*table_of(weight)))
            )
            if cached is None:
                return transform.factor(*table_of(weight))
            return lambda first, last: cached[first:last]

        imaging = Imaging(
            basis=basis,
            irradiance_w_m2=irradiance_w_m2,
            weights=weights,
            field_weights=[] if modes is None else modes.weights(pixels.shape),
            illumination=illumination or [],
            tangent2_x=tangent2_x,
            tangent2_y=tangent2_y,
            falloff_power=self._falloff_power,
            grid=pixels,
            # Beyond a picture with zero padding is darkness, which covers what is behind it.
            padding="edge" if layer_part == "cover" and self.padding == "zero" else self.padding,
            pad=self._reach_cells(scene, pixels, aperture, lambda_n_um, LOST_FRACTION)
            if self.padding_cells is None
            else self.padding_cells,
            guard=self._reach_cells(scene, pixels, aperture, lambda_n_um, PATCH_LOST_FRACTION),
            blur_cells=self._blur_um(scene, pixels, aperture, lambda_n_um) / pixels.pitch_x_um,
            f_max_per_um=1.0 / float(lambda_n_um.min()),
            is_square_source=self.source_pixel == "square",
            oversample=self._n_fine,
            real=self._real_type(),
            n_threads=n_threads,
            cached_factor=cached_factor,
            lit_rows=getattr(scene, "lit_rows", None),
        )

        def tables_at(field_um: tuple[float, float]) -> Tables:
            if is_clear_circle and defocus_um == 0.0:
                return RadialTables(1.0 / lambda_n_um, self._real_type())
            if is_clear_circle:
                found: RadialTables = self._cache.radial.get(
                    (scene.wavelength_nm.tobytes(), lambda_n_um.tobytes(), object_m),
                    lambda: RadialTables(1.0 / lambda_n_um, self._real_type(), blur_um / (4.0 * lambda_n_um)),
                )
                return found

            points_um, combinations = [field_um], ONE_POINT
            if modes is not None:
                points_um = [(float(x_um), float(y_um)) for x_um, y_um in modes.points_um]
                combinations = modes.combinations

            def create() -> PlaneTables:
                return PlaneTables(
                    aperture, scene.wavelength_nm, lambda_n_um, points_um, self._real_type(), combinations, n_threads
                )

            return self._cache.prepare(spectrum_key[:2], place or field_um, create, imaging.sums())

        return imaging, tables_at

    def field_error(self, scene: SceneLike) -> float:
        """
        Return the largest fraction of the light of a point that is displaced.

        This is half the integral of the absolute difference between the PSF at a point of the field and that of the maps: of
        modes, at the points that determine them and midway between these, where light that is displaced within a map cell wider
        than λN/2 does not count; of isoplanatic patches, midway between their centres, where it decreases with the square of
        ``field_patches``. For a single patch, the corners of the picture are compared with its centre.

        Parameters
        ----------
        scene : Scene

        Returns
        -------
        fraction : float
            Maximum over wavelengths and points; 0 for a constant PSF.
        """
        from foveasim.optics._imaging import isoplanatic_error

        grid, n = self.grid(scene), self.field_patches
        if not self.is_varying:
            return 0.0
        if n is None:
            return self._field_modes(scene, thread_count(None)).displaced
        aperture = self._aperture(scene.distance_m)
        return max(
            isoplanatic_error(aperture, grid, (n, n), float(wave_nm), float(near_um))
            for wave_nm, near_um in zip(scene.wavelength_nm, self._lambda_n_um(scene), strict=True)
        )

    def psf_modes(self, scene: SceneLike) -> FieldModes:
        """
        Return the modes of PSFs that vary over the field.

        Parameters
        ----------
        scene : Scene

        Returns
        -------
        FieldModes
            Their number, weights, singular values, and the light that they displace.

        Raises
        ------
        ParameterError
            When the PSF is constant, or isoplanatic patches replace modes.
        """
        if not self._has_modes():
            raise ParameterError(
                "optics",
                "must have a PSF that varies over the field, and no 'field_patches', for modes",
                self,
            )
        return self._field_modes(scene, thread_count(None))

    def _has_modes(self) -> bool:
        return self.is_varying and self.field_patches is None

    def _field_modes(self, scene: SceneLike, n_threads: int, object_m: float | None = None) -> FieldModes:
        """Return the modes of the PSFs over a picture, with the defocus of a distance."""
        from foveasim.optics._field_modes import find_modes

        object_m = scene.distance_m if object_m is None else object_m
        grid, aperture = self._refine(self.grid(scene)), self._aperture(object_m)
        n_modes = None if self.field_modes == "auto" else self.field_modes
        found: FieldModes = self._cache.modes.get(
            (scene.wavelength_nm.tobytes(), object_m, grid),
            lambda: find_modes(
                aperture,
                grid,
                scene.wavelength_nm,
                self._lambda_n_um(scene),
                tolerance=self.field_tolerance,
                n_modes=n_modes,
                n_threads=n_threads,
            ),
        )
        if n_modes is None and found.displaced > self.field_tolerance:
            warn(
                f"the PSF varies so much over the field that {found.n_modes} modes, from its values at "
                f"{found.at_points.shape[1]} x {found.at_points.shape[2]} points, displace {found.displaced:.2g} of the light "
                f"of a point, more than field_tolerance = {self.field_tolerance:g}; more points would take too long: use a "
                f"part of the picture, or accept it with field_tolerance={1.05 * found.displaced:.2g}",
                SamplingWarning,
            )
        return found

    def _point(self, wavelength_nm: float, distance_m: float | None, field_um: tuple[float, float]) -> Point:
        wave_nm = float(wavelengths_nm("wavelength_nm", check_number("wavelength_nm", wavelength_nm))[0])
        if distance_m is None:
            distance_m = float("inf") if self.focus_distance_m is None else self.focus_distance_m
        distance_m = self._check_distance("distance_m", distance_m)
        aperture = self._aperture(distance_m)
        return Point(
            aperture=aperture,
            is_clear_circle=aperture.is_clear_circle,
            wavelength_nm=wave_nm,
            lambda_n_um=float(self.cut_off_um(wave_nm, distance_m)),
            field_um=check_point("field_um", field_um),
        )

    # -- parts ----------------------------------------------------------------------------------------------------

    def _pupils(self) -> tuple[Pupil, ...]:
        half = () if self.pupil_part == "full" else (Half(self.pupil_part),)
        if self.pupil is None:
            return half
        return (*(self.pupil if isinstance(self.pupil, Sequence) else (self.pupil,)), *half)

    def aperture(self, scene: SceneLike) -> PSFModel:
        """Return the aperture, or the sampled PSFs, for the distance of a scene."""
        return self._aperture(scene.distance_m)

    def _extreme_apertures(self, scene: SceneLike) -> list[PSFModel]:
        """Return the aperture for a scene, or for the nearest and the farthest point of its depth."""
        depths_m = _depth_range_m(scene)
        if depths_m is None:
            return [self._aperture(scene.distance_m)]
        lens = self._focused(scene)
        return [lens._aperture(lens._check_distance("depth_m", each_m)) for each_m in depths_m]  # noqa: SLF001

    def _aperture(self, distance_m: float) -> PSFModel:
        psfs = self.psfs
        if psfs is not None:
            return self._cache.apertures.get(distance_m, lambda: FieldPSFs.at(psfs, self.working_f_number(distance_m)))
        wavefronts: list[Wavefront] = [part for part in (self.zernike, self.seidel) if part is not None]
        return self._cache.apertures.get(
            distance_m, lambda: Aperture(self._pupils(), wavefronts, self._defocus_um(distance_m))
        )

    @property
    def is_varying(self) -> bool:
        """Whether the PSF varies over the field."""
        return any(part is not None and part.is_varying for part in (self.seidel, self.psfs))

    def _lambda_n_um(self, scene: SceneLike) -> Floats:
        """Return λN at the wavelengths of a scene, or two samples of PSFs if these are coarser."""
        return self._view(scene).lambda_n_um

    def cut_off_um(self, wavelength_nm: Floats | float, distance_m: float) -> Floats:
        """Return the period of the cut-off frequency: λN, or two samples of coarser PSFs."""
        waves_nm = finite_array("wavelength_nm", wavelength_nm, above=0.0)
        lambda_n_um = np.asarray(um_from_nm(waves_nm) * self.working_f_number(distance_m))
        return lambda_n_um if self.psfs is None else np.asarray(self.psfs.cut_off_um(waves_nm, lambda_n_um))

    def _field_points_um(self, grid: Grid) -> list[tuple[float, float]]:
        """Return the field points with the strongest aberrations."""
        half_x_um, half_y_um = (0.5 * n * grid.pitch_x_um for n in grid.shape[::-1])
        x_um, y_um = grid.centre_um
        corners = [(x_um + sx * half_x_um, y_um + sy * half_y_um) for sx in (-1, 1) for sy in (-1, 1)]
        return [(0.0, 0.0), *(corners if self.is_varying else ())]

    def _blur_um(self, scene: SceneLike, grid: Grid, aperture: PSFModel, lambda_n_um: Floats) -> float:
        """Return the largest geometric ray displacement on the sensor."""
        return max(
            aperture.blur_lambda_n(float(wave_nm), point_um) * float(near_um)
            for wave_nm, near_um in zip(scene.wavelength_nm, lambda_n_um, strict=True)
            for point_um in self._field_points_um(grid)
        )

    def _reach_cells(
        self, scene: SceneLike, grid: Grid, aperture: PSFModel, lambda_n_um: Floats, lost_fraction: float
    ) -> int:
        """Return the radius in cells that contains all but a fraction of the PSF energy."""
        from foveasim.optics._imaging import reach_cells

        return max(
            reach_cells(
                lost_fraction,
                float(near_um),
                aperture.blur_lambda_n(float(wave_nm), point_um),
                aperture.edge(float(wave_nm)),
                grid.pitch_x_um,
            )
            for wave_nm, near_um in zip(scene.wavelength_nm, lambda_n_um, strict=True)
            for point_um in self._field_points_um(grid)
        )

    def _real_type(self) -> type[np.floating[Any]]:
        return np.float32 if self.precision == "single" else np.float64

    def _warn_if_too_small(self, lambda_n_um: Floats, grid: Grid) -> None:
        """Warn if the paper's Eq. 5, a >> H λ / (p0 min(M, N)), is not satisfied."""
        # In sensor coordinates the ratio of both sides of Eq. 5 is min(M, N) p / (2 λ N).
        widest_um = float(max(lambda_n_um.max(), grid.pitch_x_um / MAX_ALIASES))
        ratio = 0.5 * min(grid.shape) * grid.pitch_x_um / widest_um
        if ratio < MIN_RADIUS_RATIO:
            height, width = (n * grid.pitch_x_um for n in grid.shape)
            warn(
                f"the image of the scene is only {width:.4g} x {height:.4g} µm, and the Airy disc has a diameter of "
                f"{2.44 * widest_um:.3g} µm: an aperture radius much larger than "
                f"H λ / (p0 min(M, N)) is required, got {ratio:.3g} times this value; use a larger picture or a smaller "
                "f-number, and check the units of pitch_um, distance_m and focal_length_mm",
                SamplingWarning,
            )

    def _illumination(self, pixels: Grid, aperture: PSFModel, distance_m: float) -> list[FieldWeight] | None:
        """Return relative illumination of pixels; None: the law of the emission; empty: uniform."""
        found: list[FieldWeight] | None = self._cache.illumination.get(
            (pixels, distance_m), lambda: self._make_illumination(pixels, aperture, distance_m)
        )
        return found

    def _make_illumination(self, pixels: Grid, aperture: PSFModel, distance_m: float) -> list[FieldWeight] | None:
        from foveasim.optics._field_modes import field_points_um, field_weights

        points_um = field_points_um(pixels, ILLUMINATION_POINTS)
        table, degree = self.relative_illumination, 1
        values = aperture.illumination(points_um.reshape(-1, 2)) if table is None else table.at(points_um)
        if values is None:
            values, degree = self._cone_illumination(points_um, distance_m), 3
        if values is None:
            return None
        is_one = (np.abs(values - 1.0) <= ILLUMINATION_ROUNDING).all()
        return [] if is_one else field_weights(values.reshape(1, *points_um.shape[:2]), pixels.shape, degree=degree)

    def _cone_illumination(self, points_um: Floats, distance_m: float) -> Floats | None:
        """Return the irradiance by the cones at points (..., 2) over that on the axis."""
        height_um = np.hypot(points_um[..., 0], points_um[..., 1])
        if self.exit_pupil_mm is not None:
            tangent = height_um / float(um_from_m(m_from_mm(self.exit_pupil_mm)))
        elif self.chief_ray is None:
            return None
        else:
            within_um = np.minimum(height_um, self.chief_ray.image_height_um[-1]).reshape(-1, 1)
            tangent = self.chief_ray.tangents(np.pad(within_um, ((0, 0), (0, 1))))[:, 0].reshape(height_um.shape)
        radius = self._cone_radius(distance_m)
        values = cone_irradiance_sr(tangent, radius) / cone_irradiance_sr(0.0, radius)
        if self.emission == "isotropic":  # radiance increases with the field angle
            values = values * np.hypot(
                1.0, height_um / float(um_from_m(m_from_mm(self._image_distance_mm(distance_m))))
            )
        return np.asarray(values)

    def _law_at_pixels(self, scene: SceneLike) -> Floats:
        """
        Return the relative illumination of an image that is not rectilinear, (n_y, n_x).

        The projected area of the pupil relative to that on the axis, times the solid angle per area of the image.
        """
        self._require_lambertian(scene.projection)
        grid, distance_m = self.grid(scene), scene.distance_m
        focal_um = float(um_from_m(m_from_mm(self._image_distance_mm(distance_m))))
        found: Floats = self._cache.illumination.get(
            (grid, distance_m, scene.projection),
            lambda: solid_angles_sr(grid, focal_um, scene.projection, is_flat=self.pupil_tilt == "flat"),
        )
        return found

    def _squared_tangents(self, scene: SceneLike, n_fine: int = 1) -> tuple[Floats, Floats]:
        """Return (x0/H)² of the scene columns and (y0/H)² of the scene rows, or of their cells."""
        n_y, n_x = (n_fine * n for n in scene.basis.shape[1:])
        step, x, y = (
            float(m_from_um(each)) / scene.distance_m for each in (_pitch_um(scene) / n_fine, *scene.centre_um)
        )
        return ((np.arange(n_x) - 0.5 * (n_x - 1)) * step + x) ** 2, (
            (np.arange(n_y) - 0.5 * (n_y - 1)) * step + y
        ) ** 2
