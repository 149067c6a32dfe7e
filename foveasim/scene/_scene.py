"""Scene: spectral radiance of a plane in front of the lens, or by direction."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import POSITIVE, Limits, OwnCheck, check_declared
from foveasim._core.show import ViewMethod, view_method
from foveasim._core.threads import cached_property
from foveasim._core.validation import (
    MAX_WAVELENGTH_NM,
    Floats,
    Images,
    as_numbers,
    band_widths_nm,
    check_number,
    check_point,
    check_shape,
    finite_array,
    freeze,
    frozen_array,
    read_only,
    unmasked,
    wavelengths_nm,
)
from foveasim._io.encodings import FileEncoding, decode
from foveasim._io.formats import as_file_error
from foveasim._io.images import EncodedPicture, as_encoded, write_picture
from foveasim._io.mapped_files import check_unchanged, value_range
from foveasim._projections import ImageProjection
from foveasim.errors import FileError, ParameterError, printable
from foveasim.fields import from_file_rows
from foveasim.scene._colorimetry import LUMINANCE_WEIGHTS
from foveasim.scene._depth import DepthFormat, Missing, check_depth, read_depth
from foveasim.scene._illuminants import Illuminant
from foveasim.scene._panorama import CELLS, TURN, Mapping, Panorama
from foveasim.scene._photometry import level_of_white, luminance_of
from foveasim.scene.cubes import (
    IlluminantTable,
    Invalid,
    Quantity,
    Selection,
    array_errors,
    cube_of,
    read_cube,
    select,
    spectral_radiance,
)
from foveasim.scene.displays._display import Display, display_of
from foveasim.scene.displays._raster import raster_of
from foveasim.scene.registry import SCENES
from foveasim.units import m_from_um, um_from_m

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Framing of a picture on a layout.
Fit: TypeAlias = Literal["cover", "contain", "width"]
#: Parameters of which one determines the size of a scene.
FRAMINGS = ("pitch_um", "fit", "field_of_view_deg")

#: Default wavelengths of the channels of colour pictures (red, green, blue) and of grey pictures.
RGB_NM = (620.0, 550.0, 450.0)
GREY_NM = (550.0,)
#: Width of the band of a grey photograph, by default.
GREY_BAND_WIDTH_NM = 100.0
#: Larger encoded floating-point values indicate a picture in the range 0 to 255 instead of 0 to 1.
MAX_ENCODED = 16.0
#: Larger values are errors of units: 1e9 m is the distance and width of an astronomical scene.
PITCH, DISTANCE = Limits(above=0.0, at_most=1e15), Limits(above=0.0, at_most=1e9)
#: Distance of panoramas, m.
FAR_M = 1e6
#: Tolerance of a pitch that is given together with the field of view: rounding errors.
PITCH_ROUNDING = 1e-9
#: Spectral radiance above that of any source, W/(m² sr nm); that of the sun is about 2e4.
MAX_RADIANCE = 1e24
RADIANCE = Limits(at_least=0.0, at_most=MAX_RADIANCE)
#: Distance of the value 1 in files of distances, m.
DEPTH_SCALE = Limits(above=0.0, at_most=1e9)
#: Layers of a scene with depth.
LAYERS = Limits(at_least=1, at_most=256)
#: Characters of the source in the representation.
MAX_SOURCE = 100


class _BasisImages:
    """Basis images of a scene; each access checks the file of mapped images."""

    def __get__(self, scene: Scene | None, owner: type[Scene]) -> Images:
        if scene is None:  # dataclasses: the field has no default
            raise AttributeError("basis")
        images: Images = vars(scene)["basis"]
        return check_unchanged(images)

    def __set__(self, scene: Scene, images: Images) -> None:
        vars(scene)["basis"] = images


@dataclass(frozen=True, eq=False)
class Scene:
    """
    Spectral radiance of a plane at a given distance in front of the lens.

    Usually created by :meth:`from_picture`, :meth:`from_panorama`, :meth:`from_cube`, :meth:`from_display`, :meth:`flat` or
    :meth:`point_sources`.

    Parameters
    ----------
    basis : (n_basis, n_y, n_x) float32 or float64
        Basis images, bottom row first, values >= 0. The array is copied, so that later changes do not affect the scene; an
        array that is read-only, with all its base arrays, is shared. Images that are mapped from a file (:meth:`from_cube`) are
        checked at each use: ``FileError`` if the file has changed.
    spectrum_w_m2_sr_nm : (n_basis, n_wavelength) float64, W/(m² sr nm)
        Spectral radiance of the value 1 in each basis image.
    wavelength_nm : (n_wavelength,) float64, nm
        Wavelengths of the bands.
    band_width_nm : (n_wavelength,) float64, nm
        Widths of the bands.
    pitch_um : float or None, µm
        Pixel pitch in the scene; None for a scene with ``fit`` that no camera has framed, and derived from
        ``field_of_view_deg`` if that is given.
    distance_m : float, m
        Distance of the scene from the pupil of the lens.
    source : str
        Origin of the basis images, for provenance.
    fit : {"cover", "contain", "width"}, optional
        Framing on the layout of a camera, which derives the pitch: :meth:`foveasim.Camera.fit_scene`.
    field_of_view_deg : float, optional, degrees
        Horizontal angle of the scene as seen from the lens.
    is_picture : bool
        Whether the scene is a photograph: cameras warn if their layout measures only a small part of it.
    gaze_range_um : (x, y), µm
        With ``fit="cover"``, largest distances of the gaze from the centre along either axis, in the sensor plane: the image
        covers all photosites for each gaze within them (:attr:`foveasim.Camera.gaze_um`).
    centre_um : (x, y), µm
        Position of the picture's centre in the scene, from the optical axis. (0, 0) with ``fit``.
    illuminant : (n_wavelength,) float64, optional
        Relative spectrum of white, for the white balance and the colour correction of captures; by default of equal energy.
    is_rgb : bool
        Whether the three basis images are the channels of a photograph in linear sRGB, which the colour correction of captures
        reproduces.
    axis_um : (x, y), optional, µm
        With ``fit``, where the optical axis meets the sensor; :meth:`foveasim.Camera.fit_scene` sets it with the pitch.
    display : Display, optional
        Display that shows the picture, as the frames of a video with this scene as template: :meth:`from_display`.
    projection : {"rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"}
        Projection of the picture: ``"rectilinear"`` is a plane in front of the lens. In others, the pixel at the distance r
        from the axis has the direction θ with ``r = distance ρ(θ)``, with the image height ρ of :class:`foveasim.Optics`.
    panorama : Panorama, optional
        Directions of the pixels of a picture that is not a plane, with ``fit="cover"``: see :meth:`from_panorama`. A camera
        computes the image in its projection, with ``panorama=None``.
    depth_m : (n_y, n_x) float64, optional, m
        Distance of each pixel along the optical axis, bottom row first, instead of ``distance_m`` for all; infinity is allowed.
        See :meth:`from_rgbd`.
    depth_layers : int, optional
        Largest number of layers of a scene with depth.

    Raises
    ------
    ParameterError
        If the arrays have inconsistent shapes, or contain values that are not finite or negative, or if the framing is missing
        or contradicts itself.

    Notes
    -----
    Spectral radiance of pixel [iy, ix] at wavelength k: ``sum_b basis[b, iy, ix] * spectrum[b, k]``.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> picture = np.tile(np.linspace(0.0, 1.0, 64), (48, 1))
    >>> scene = fs.Scene.from_picture(
    ...     picture, pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> scene.basis.shape, round(float(scene.luminance_cd_m2.max()), 1)  # 500 / π
    ((1, 48, 64), 159.2)
    """

    if TYPE_CHECKING:
        basis: Images
    else:
        basis: Images = _BasisImages()
    spectrum_w_m2_sr_nm: Floats
    wavelength_nm: Floats
    band_width_nm: Floats
    pitch_um: Annotated[float, PITCH] | None
    distance_m: Annotated[float, DISTANCE]
    source: str = field(default="arrays", kw_only=True)
    fit: Fit | None = field(default=None, kw_only=True)
    field_of_view_deg: float | None = field(default=None, kw_only=True)
    is_picture: bool = field(default=False, kw_only=True)
    gaze_range_um: tuple[float, float] = field(default=(0.0, 0.0), kw_only=True)
    centre_um: tuple[float, float] = field(default=(0.0, 0.0), kw_only=True)
    illuminant: Floats | None = field(default=None, kw_only=True)
    is_rgb: bool = field(default=False, kw_only=True)
    axis_um: tuple[float, float] | None = field(default=None, kw_only=True)
    display: Display | None = field(default=None, kw_only=True)
    projection: ImageProjection = field(default="rectilinear", kw_only=True)
    panorama: Panorama | None = field(default=None, kw_only=True)
    depth_m: Floats | None = field(default=None, kw_only=True)
    depth_layers: Annotated[int | None, LAYERS] = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        check_declared(self)
        basis = np.asarray(unmasked("basis", self.basis))
        if basis.dtype not in (np.float32, np.float64):
            basis = read_only(as_numbers("basis", basis))
        if basis.ndim != 3 or 0 in basis.shape:
            raise ParameterError("basis", f"must have the shape (n_basis, n_y, n_x), got {basis.shape}")
        lowest, highest = value_range(basis)
        if not (np.isfinite(lowest) and np.isfinite(highest)):
            raise ParameterError("basis", "must be finite; replace NaN and infinite values")
        if lowest < 0.0:
            raise ParameterError("basis", "must be >= 0", lowest)
        wavelength_nm = wavelengths_nm("wavelength_nm", self.wavelength_nm)
        width_nm = finite_array(
            "band_width_nm", np.atleast_1d(self.band_width_nm), ndim=1, above=0.0, at_most=MAX_WAVELENGTH_NM
        )
        spectrum = RADIANCE.check_array("spectrum_w_m2_sr_nm", self.spectrum_w_m2_sr_nm, ndim=2)
        brightest = highest * float(spectrum.max(initial=0.0))
        if not brightest <= MAX_RADIANCE:
            raise ParameterError(
                "basis", f"must have a spectral radiance of at most {MAX_RADIANCE:g}", brightest, "W/(m² sr nm)"
            )
        if width_nm.shape != wavelength_nm.shape:
            raise ParameterError(
                "band_width_nm", f"must have one value for each of the {wavelength_nm.size} wavelengths", width_nm
            )
        if spectrum.shape != (basis.shape[0], wavelength_nm.size):
            raise ParameterError(
                "spectrum_w_m2_sr_nm",
                f"must have the shape (n_basis, n_wavelength) = {(basis.shape[0], wavelength_nm.size)}, got {spectrum.shape}",
            )
        object.__setattr__(self, "basis", frozen_array(basis))
        object.__setattr__(self, "spectrum_w_m2_sr_nm", read_only(spectrum.copy()))
        object.__setattr__(self, "wavelength_nm", wavelength_nm)
        object.__setattr__(self, "band_width_nm", read_only(width_nm.copy()))
        if self.illuminant is not None:
            illuminant = finite_array("illuminant", self.illuminant, ndim=1, at_least=0.0)
            if illuminant.shape != wavelength_nm.shape or not illuminant.any():
                raise ParameterError(
                    "illuminant", f"must be {wavelength_nm.size} values, one per wavelength, and not all 0", illuminant
                )
            object.__setattr__(self, "illuminant", frozen_array(illuminant))
        if self.is_rgb and basis.shape[0] != len(RGB_NM):
            raise ParameterError("is_rgb", f"requires three basis images, got {basis.shape[0]}")
        if self.depth_m is not None:
            if self.panorama is not None or self.projection != "rectilinear":
                raise ParameterError("depth_m", "must not be given for a panorama, but for a picture of a plane")
            object.__setattr__(self, "depth_m", frozen_array(check_depth(self.depth_m, basis.shape[1:])))
        elif self.depth_layers is not None:
            raise ParameterError("depth_layers", "requires 'depth_m'", self.depth_layers)
        object.__setattr__(self, "pitch_um", self._checked_pitch_um())
        object.__setattr__(self, "centre_um", check_point("centre_um", self.centre_um))
        object.__setattr__(self, "gaze_range_um", check_point("gaze_range_um", self.gaze_range_um, at_least=0.0))
        if any(self.centre_um) and self.fit is not None:
            raise _framing_conflict("fit", self.fit, "centre_um")
        if self.axis_um is not None:
            if self.fit is None:
                raise ParameterError("axis_um", "requires 'fit'", self.axis_um, "µm")
            object.__setattr__(self, "axis_um", check_point("axis_um", self.axis_um))
        if self.panorama is not None:
            if self.fit != "cover":
                raise ParameterError("panorama", "requires fit='cover'", self.fit)
            self.panorama.check_shape(basis.shape[1:])
        if any(self.gaze_range_um) and self.fit != "cover":
            raise ParameterError("gaze_range_um", "requires fit='cover'", self.gaze_range_um, "µm")

    def _checked_pitch_um(self) -> float | None:
        """Return the pitch: as given, or that of the field of view; None before framing."""
        given_um = self.pitch_um
        if self.fit is not None:
            if self.field_of_view_deg is not None:
                raise _framing_conflict("fit", self.fit, "field_of_view_deg")
            return given_um
        if self.field_of_view_deg is None:
            if given_um is None:
                raise ParameterError("pitch_um", "must be given, or 'fit' or 'field_of_view_deg' instead")
            return given_um
        angle_deg = check_number("field_of_view_deg", self.field_of_view_deg, above=0.0)
        if not angle_deg < 180.0:
            raise ParameterError("field_of_view_deg", "must be < 180", angle_deg, "degrees", "a scene is a plane")
        object.__setattr__(self, "field_of_view_deg", angle_deg)
        width_um = 2.0 * float(um_from_m(self.distance_m)) * math.tan(math.radians(0.5 * angle_deg))
        pitch_um = PITCH.check("pitch_um", width_um / self.basis.shape[2])
        if given_um is not None and not math.isclose(given_um, pitch_um, rel_tol=PITCH_ROUNDING):
            raise _framing_conflict("field_of_view_deg", angle_deg, "pitch_um")
        return pitch_um

    @property
    def luminance_cd_m2(self) -> Images:
        """
        Luminance of each pixel, (n_y, n_x) float64, cd/m², bottom row first.

        683 lm/W times the sum over the bands of radiance, photopic luminous efficiency and width.
        """
        weights = luminance_of(self.spectrum_w_m2_sr_nm, self.wavelength_nm, self.band_width_nm)
        return np.asarray(np.tensordot(weights, self.basis, axes=1))

    @cached_property
    def depth_range_m(self) -> tuple[float, float] | None:
        """Smallest and largest distance of the pixels, m; None without depth."""
        return None if self.depth_m is None else (float(self.depth_m.min()), float(self.depth_m.max()))

    def with_pitch(self, pitch_um: float) -> Scene:
        """
        Return the scene with another pixel pitch instead of its pitch, fit or field of view.

        Parameters
        ----------
        pitch_um : float, µm
            Pixel pitch in the scene.

        Returns
        -------
        Scene
            Shares the arrays of this scene.
        """
        return self._with(
            pitch_um=PITCH.check("pitch_um", pitch_um),
            fit=None,
            gaze_range_um=(0.0, 0.0),
            field_of_view_deg=None,
            axis_um=None,
            display=None,
        )

    def framed(self, pitch_um: float, axis_um: tuple[float, float] | None) -> Scene:
        """Return a scene with ``fit`` with its pitch and its optical axis."""
        axis = None if axis_um is None else check_point("axis_um", axis_um)
        return self._with(pitch_um=PITCH.check("pitch_um", pitch_um), axis_um=axis)

    def resampled(
        self, basis: Images, pitch_um: float, axis_um: tuple[float, float] | None, projection: ImageProjection
    ) -> Scene:
        """Return a panorama as the picture of its image, with its pitch and its optical axis."""
        if not np.isfinite(value_range(basis)).all():
            raise ParameterError("basis", "must be finite")
        return self._with(basis=basis, projection=projection, panorama=None).framed(pitch_um, axis_um)

    def turned(
        self,
        *,
        yaw_deg: float | None = None,
        pitch_deg: float | None = None,
        roll_deg: float | None = None,
        gaze_deg: OwnCheck[tuple[float, float] | None] = None,
    ) -> Scene:
        """
        Return a panorama with another orientation of the camera.

        Parameters
        ----------
        yaw_deg, pitch_deg, roll_deg : float, optional, degrees
            As for :meth:`from_panorama`; by default those of this scene.
        gaze_deg : (azimuth, elevation), optional, degrees
            Direction towards which the camera turns from this orientation, instead of :attr:`foveasim.Camera.gaze_deg`.

        Returns
        -------
        Scene
            Shares the arrays of this scene.

        Raises
        ------
        ParameterError
            If the scene is a plane.

        Examples
        --------
        >>> import foveasim as fs
        >>> import numpy as np
        >>> scene = fs.Scene.from_panorama(np.ones((16, 32)), luminance_cd_m2=100.0)
        >>> scene.turned(yaw_deg=90.0).panorama.yaw_deg
        90.0
        """
        if self.panorama is None:
            raise ParameterError("scene", "must be a panorama, which Scene.from_panorama creates, got a plane")
        angles = {"yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "roll_deg": roll_deg, "gaze_deg": gaze_deg}
        given: dict[str, Any] = {name: value for name, value in angles.items() if value is not None}
        return self._with(panorama=replace(self.panorama, **given))

    def with_centre(self, centre_um: tuple[float, float]) -> Scene:
        """
        Return the scene at another position.

        Parameters
        ----------
        centre_um : (x, y), µm
            Position of the picture's centre, from the optical axis.

        Returns
        -------
        Scene
            Shares the arrays of this scene.
        """
        return self._with(centre_um=check_point("centre_um", centre_um))

    def _with(self, **values: Any) -> Scene:
        """Return a copy with other values, without a check of all pixels."""
        scene = copy.copy(self)
        for name, value in values.items():
            object.__setattr__(scene, name, value)
        return scene

    def __repr__(self) -> str:
        n_basis, n_y, n_x = vars(self)["basis"].shape
        if self.panorama is not None:
            return (
                f"Scene({self.panorama.mapping} panorama of {n_x} x {n_y} pixels, {n_basis} basis images, "
                f"{self.wavelength_nm.size} wavelengths, from {printable(self.source)[:MAX_SOURCE]})"
            )
        size = f", fit='{self.fit}'," if self.pitch_um is None else f" of {self.pitch_um:g} µm"
        depths_m = self.depth_range_m
        depth = "" if depths_m is None else f", depth {depths_m[0]:g} to {depths_m[1]:g} m"
        return (
            f"Scene({n_x} x {n_y} pixels{size} at {self.distance_m:g} m{depth}, {n_basis} basis images, "
            f"{self.wavelength_nm.size} wavelengths, from {printable(self.source)[:MAX_SOURCE]})"
        )

    plot: ClassVar[ViewMethod[Axes]] = view_method("plot_scene")
    _repr_html_ = view_method("to_html")

    @classmethod
    def from_picture(
        cls,
        picture: OwnCheck[str | Path | ArrayLike],
        *,
        pitch_um: float | None = None,
        fit: Fit | None = None,
        gaze_range_um: tuple[float, float] = (0.0, 0.0),
        field_of_view_deg: float | None = None,
        distance_m: float,
        peak_radiance_w_m2_sr_nm: float | None = None,
        luminance_cd_m2: float | None = None,
        illuminance_lux: float | None = None,
        reflectance: float = 1.0,
        wavelength_nm: Sequence[float] | None = None,
        band_width_nm: float | Sequence[float] | None = None,
        spectrum: Sequence[Sequence[float]] | Floats | None = None,
        encoding: FileEncoding = "auto",
        channels: Literal["rgb", "bgr"] = "rgb",
    ) -> Scene:
        """
        Create a scene from a photograph.

        Parameters
        ----------
        picture : path, image of Pillow, or (n_y, n_x) or (n_y, n_x, n_channel) array
            File, image, or array in the convention of image libraries, top row first: grey or colour, with or without alpha.
            8-bit and 16-bit values range from 0 to the maximum of the dtype, booleans are 0 and 1; floating-point values have
            the peak 1 and may exceed it. The radiance is multiplied by alpha.
        pitch_um : float, optional, µm
            Pixel pitch in the scene, instead of ``fit``.
        fit : {"cover", "contain", "width"}, optional
            Framing, from which each camera derives the pitch: the image of the picture covers the layout completely, lies
            within its bounding box, or has its width. The centre of the picture is at the centre of this box, or on the
            optical axis of a lens model. Default: ``"cover"``.
        gaze_range_um : (x, y), µm
            With ``fit="cover"``, range of gazes for which the image covers the layout: see the class.
        field_of_view_deg : float, optional, degrees
            Horizontal angle of the picture as seen from the lens, instead of ``pitch_um`` and ``fit``.
        distance_m : float, m
            Distance of the scene from the lens.
        peak_radiance_w_m2_sr_nm : float, W/(m² sr nm)
            Spectral radiance of the value 1; if ``spectrum`` is given, of a pixel value of 1 where ``spectrum`` is 1.
        luminance_cd_m2 : float, cd/m²
            Luminance of white (value 1 in all channels), instead of the radiance.
        illuminance_lux, reflectance : float, lx
            Illuminance of the scene, instead of the radiance, and reflectance of its white, a diffuse (Lambertian) surface:
            the luminance of white is ``illuminance_lux * reflectance / π``.
        wavelength_nm : sequence, optional, nm
            One wavelength per channel; (620, 550, 450) for colour and 550 for grey by default. A grey picture has the same
            radiance at all wavelengths. For one wavelength a colour picture is converted to grey. With ``spectrum`` any
            number of wavelengths is allowed.
        band_width_nm : number or sequence, optional, nm
            Widths of the bands; by default bands extend halfway to the adjacent wavelengths. Required for one wavelength,
            except that of a grey picture without ``wavelength_nm``, whose band is 100 nm wide.
        spectrum : (n_channel, n_wavelength), optional
            Relative spectrum of each channel at the value 1.
        encoding : {"auto", "srgb", "sqrt", "linear"}
            Encoding of the values: sRGB (photographs), square root of the radiance (the paper), or radiance. ``"auto"`` is
            what a file or an image of Pillow states, else linear for EXR, Radiance HDR, PFM and floating-point TIFF, and sRGB
            for other files and arrays. Every other encoding replaces what the file states, such as its profile: see the notes.
        channels : {"rgb", "bgr"}
            Order of the channels of a colour array: ``"bgr"`` for those of OpenCV.

        Raises
        ------
        FileError
            If the file cannot be read.
        ParameterError
            If channels, wavelengths and spectra are inconsistent, a value is out of range, more than one of ``pitch_um``,
            ``fit`` and ``field_of_view_deg`` is given, or not exactly one of radiance, luminance and illuminance.

        Notes
        -----
        Photometric quantities are the sum of the spectral radiance over the bands, weighted by their widths and by the
        photopic luminous efficiency V(λ) (:func:`foveasim.scene.charts.photopic`), times 683 lm/W. Full daylight is about
        20,000 to 100,000 lx, an overcast sky 1,000 to 10,000, an office 500, and the full moon 0.3.

        With ``encoding="auto"``, colours in other spaces become linear sRGB, and the white of each space becomes white: ICC
        profiles (with littleCMS, relative colorimetric, extra ``pictures``), gamma and primaries of PNG, TIFF, BMP, EXR and
        Radiance HDR, the codes of Rec. ITU-T H.273 in PNG, HEIC, AVIF and JPEG 2000, Adobe RGB of cameras. Values of Radiance
        HDR are divided by their EXPOSURE and COLORCORR. Colours outside sRGB are negative in a channel; their luminance is kept
        for one wavelength, and such a channel is 0 in a scene of several, since radiance is not negative.
        """
        _check_framing(pitch_um, fit, field_of_view_deg)
        if pitch_um is None and field_of_view_deg is None and fit is None:
            fit = "cover"
        peak = peak_radiance_w_m2_sr_nm
        if peak is not None:
            peak = RADIANCE.check("peak_radiance_w_m2_sr_nm", peak)
        is_file = isinstance(picture, str | os.PathLike)
        read = as_encoded(picture, encoding)
        pixels = read.pixels
        if (
            pixels.ndim not in (2, 3)
            or 0 in pixels.shape
            or (pixels.ndim == 3 and pixels.shape[2] > 4 and spectrum is None)
        ):
            raise ParameterError(
                "picture", f"must have the shape (n_y, n_x) or (n_y, n_x, 1 to 4 channels), got {pixels.shape}"
            )
        has_alpha = (
            pixels.ndim == 3 and pixels.shape[2] in (2, 4) and (spectrum is None or len(spectrum) != pixels.shape[2])
        )
        if channels == "bgr" and not read.is_array:
            raise ParameterError("channels", "must be 'rgb' for files and images of Pillow", channels)
        if channels == "bgr" and pixels.ndim == 3 and pixels.shape[2] in (3, 4):
            pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
        try:
            colours = _relative_radiance(replace(read, pixels=pixels), has_alpha=has_alpha)
        except ParameterError as error:
            raise (FileError(str(picture), str(error)) if is_file else error) from None
        n_channels = colours.shape[0]
        if wavelength_nm is None:
            wavelength_nm = RGB_NM if n_channels == 3 else None
        waves_nm, widths_nm = scene_bands(wavelength_nm, band_width_nm)
        if spectrum is not None:
            relative = finite_array("spectrum", spectrum, ndim=2, at_least=0.0)
            if relative.shape != (n_channels, waves_nm.size):
                raise ParameterError(
                    "spectrum",
                    f"must have the shape (n_channel, n_wavelength) = {(n_channels, waves_nm.size)}, got {relative.shape}",
                )
        elif n_channels == waves_nm.size:
            relative = np.eye(n_channels)
        elif n_channels == 1:
            relative = np.ones((1, waves_nm.size))
        elif n_channels == 3 and waves_nm.size == 1:
            # Before colours outside sRGB are clipped: their luminance is that of the photograph.
            colours, relative = np.tensordot(LUMINANCE_WEIGHTS, colours, axes=1)[np.newaxis], np.ones((1, 1))
        else:
            raise ParameterError(
                "wavelength_nm",
                f"must have one value, or one for each of the {n_channels} channels",
                waves_nm.tolist(),
                "nm",
                "for other wavelengths pass 'spectrum', the spectrum of each channel",
            )
        peak = level_of_white(
            "peak_radiance_w_m2_sr_nm",
            peak,
            relative.sum(axis=0),
            waves_nm,
            widths_nm,
            luminance_cd_m2=luminance_cd_m2,
            illuminance_lux=illuminance_lux,
            reflectance=reflectance,
        )
        if read.is_wide:
            np.maximum(colours, 0.0, out=colours)
        return cls(
            freeze(colours),
            peak * relative,
            waves_nm,
            widths_nm,
            pitch_um,
            distance_m,
            source=str(picture) if is_file else "a picture array",
            fit=fit,
            gaze_range_um=gaze_range_um,
            field_of_view_deg=field_of_view_deg,
            is_picture=True,
            is_rgb=colours.shape[0] == len(RGB_NM),
        )

    @classmethod
    def from_panorama(
        cls,
        picture: OwnCheck[str | Path | ArrayLike],
        *,
        mapping: Mapping = "equirectangular",
        yaw_deg: Annotated[float, TURN] = 0.0,
        pitch_deg: Annotated[float, TURN] = 0.0,
        roll_deg: Annotated[float, TURN] = 0.0,
        cells: Annotated[int | Literal["auto"], CELLS] = "auto",
        lens: OwnCheck[Any] = None,
        pixel_um: Annotated[float | None, POSITIVE] = None,
        gaze_range_um: tuple[float, float] = (0.0, 0.0),
        distance_m: float = FAR_M,
        peak_radiance_w_m2_sr_nm: float | None = None,
        luminance_cd_m2: float | None = None,
        illuminance_lux: float | None = None,
        reflectance: float = 1.0,
        wavelength_nm: Sequence[float] | None = None,
        band_width_nm: float | Sequence[float] | None = None,
        spectrum: Sequence[Sequence[float]] | Floats | None = None,
        encoding: FileEncoding = "auto",
        channels: Literal["rgb", "bgr"] = "rgb",
    ) -> Scene:
        """
        Create a scene from a panorama: radiance by direction, for lenses with any field.

        Parameters
        ----------
        picture : path, image of Pillow, or (n_y, n_x) or (n_y, n_x, n_channel) array
            As for :meth:`from_picture`.
        mapping : {"equirectangular", "cubemap", "fisheye"}
            ``"equirectangular"``: 360° by 180°, the zenith in the top row, the direction straight ahead in the centre.
            ``"cubemap"``: a horizontal cross of 4 x 3 square faces: left, front, right and back from left to right in the
            middle row, top and bottom above and below the front. ``"fisheye"``: a photograph by a lens with a calibration; it
            is dark outside the photograph, and its relative illumination is not corrected.
        yaw_deg, pitch_deg, roll_deg : float, degrees
            Orientation of the camera: it turns to the right, then upwards, then clockwise about its axis.
        cells : "auto" or int
            Number of cells along the longer side of the image that a camera computes. ``"auto"``: two per pixel of the panorama
            on the axis, at least 64 and at most 2048.
        lens : lens model of foveasim.distortion, optional
            For a fisheye photograph, its lens; the origin is the centre of the photograph.
        pixel_um : float, optional, µm
            For a fisheye photograph, the pixel size in its calibration.
        gaze_range_um : (x, y), µm
            Range of gazes for which the image covers the layout: see the class.
        distance_m : float, m
            Distance of the scene, for the focus of the lens.
        peak_radiance_w_m2_sr_nm, luminance_cd_m2, illuminance_lux, reflectance
            As for :meth:`from_picture`.
        wavelength_nm, band_width_nm, spectrum, encoding, channels
            As for :meth:`from_picture`.

        Raises
        ------
        FileError
            If the file cannot be read.
        ParameterError
            As for :meth:`from_picture`, or if the picture does not have the shape of the mapping.

        Notes
        -----
        A camera computes the image once per orientation: the mean radiance over the solid angle of each cell, from fractions
        of pixels, so that small features are not lost, and the poles are not sampled at single points.

        Examples
        --------
        An ideal fisheye lens with a field of 185 degrees:

        >>> import foveasim as fs
        >>> import numpy as np
        >>> sky = np.repeat([1.0, 0.2], 32)[:, np.newaxis] * np.ones(
        ...     128
        ... )  # bright above the horizon
        >>> scene = fs.Scene.from_panorama(sky, luminance_cd_m2=1000.0, encoding="linear")
        >>> lens = fs.distortion.Fisheye(projection="equidistant", focal_um=1000.0)
        >>> camera = fs.Camera(
        ...     optics=fs.Optics(focal_length_mm=1.0, f_number=2.8),
        ...     sensor=fs.Sensor(fs.layout.grid(n_x=2, n_y=3, pitch_um=1000.0)),
        ...     distortion=lens,
        ... )
        >>> rates = camera.photoelectrons_per_s(scene)
        >>> camera.projection(scene), (rates / rates.max()).round(2).tolist()
        ('equidistant', [0.2, 0.2, 0.71, 0.71, 1.0, 1.0])
        """
        panorama = Panorama(
            mapping=mapping,
            yaw_deg=yaw_deg,
            pitch_deg=pitch_deg,
            roll_deg=roll_deg,
            cells=cells,
            lens=lens,
            pixel_um=pixel_um,
        )
        scene = cls.from_picture(
            picture,
            fit="cover",
            gaze_range_um=gaze_range_um,
            distance_m=distance_m,
            peak_radiance_w_m2_sr_nm=peak_radiance_w_m2_sr_nm,
            luminance_cd_m2=luminance_cd_m2,
            illuminance_lux=illuminance_lux,
            reflectance=reflectance,
            wavelength_nm=wavelength_nm,
            band_width_nm=band_width_nm,
            spectrum=spectrum,
            encoding=encoding,
            channels=channels,
        )
        return replace(scene, panorama=panorama)

    @classmethod
    def from_rgbd(
        cls,
        picture: OwnCheck[str | Path | ArrayLike],
        depth_m: OwnCheck[str | Path | ArrayLike],
        *,
        distance_m: float,
        depth_scale: Annotated[float | None, DEPTH_SCALE] = None,
        depth_format: DepthFormat | None = None,
        calibration: str | Path | None = None,
        missing: Missing = "raise",
        depth_layers: Annotated[int | None, LAYERS] = None,
        pitch_um: float | None = None,
        fit: Fit | None = None,
        gaze_range_um: tuple[float, float] = (0.0, 0.0),
        field_of_view_deg: float | None = None,
        peak_radiance_w_m2_sr_nm: float | None = None,
        luminance_cd_m2: float | None = None,
        illuminance_lux: float | None = None,
        reflectance: float = 1.0,
        wavelength_nm: Sequence[float] | None = None,
        band_width_nm: float | Sequence[float] | None = None,
        spectrum: Sequence[Sequence[float]] | Floats | None = None,
        encoding: FileEncoding = "auto",
        channels: Literal["rgb", "bgr"] = "rgb",
    ) -> Scene:
        """
        Create a scene from a photograph and the distance of each of its pixels.

        Parameters
        ----------
        picture : path, image of Pillow, or array
            Photograph that is sharp at all distances, as for :meth:`from_picture`.
        depth_m : (n_y, n_x) array, or path
            Distance of each pixel along the optical axis, in m, top row first, of the size of the picture. Infinity is the
            background at infinity. Files: the channel Z of EXR, 16-bit PNG or TIFF, PFM, or numpy; their unit is
            ``depth_scale`` or ``depth_format``.
        distance_m : float, m
            Distance of the plane in which ``pitch_um`` holds, and which is in focus unless the lens has a focus distance. A
            pixel is a direction, that of its chief ray, so that the scale of the image does not depend on the depth.
        depth_scale : float, optional, m
            Distance of the value 1 in ``depth_m``, such as 0.001 for millimetres; 1 for arrays by default.
        depth_format : {"mm", "nyu", "nyu_raw", "tum", "middlebury"}, optional
            Convention of the values instead of a scale: millimetres in integers, as in the usual pictures of NYU Depth v2
            (``"nyu"``); raw values d of that set, ``351.3 / (1092.5 - d)`` m and at most 10 m, as in its toolbox; 5000 per
            metre (TUM RGB-D); disparities d of Middlebury 2014, ``baseline f / (d + doffs)``, infinite where unknown.
        calibration : path, optional
            File ``calib.txt`` of the disparities of Middlebury.
        missing : {"raise", "far", "nearest"}
            What pixels with the value 0 or NaN, and unknown disparities, mean: an error, infinity, or the distance of the
            nearest pixel that has one.
        depth_layers : int, optional
            Largest number of layers. By default the blur radii of adjacent layers differ by one pixel or λN/2.
        pitch_um, fit, gaze_range_um, field_of_view_deg, peak_radiance_w_m2_sr_nm, luminance_cd_m2, illuminance_lux, reflectance
            As for :meth:`from_picture`.
        wavelength_nm, band_width_nm, spectrum, encoding, channels
            As for :meth:`from_picture`.

        Raises
        ------
        FileError
            If a file cannot be read, or does not state the unit of its distances.
        ParameterError
            If shapes differ, a distance is negative or missing, or an argument is out of range, as for :meth:`from_picture`.

        Notes
        -----
        The lens blurs a point at the distance H over a disc of the radius ``a D |1/H - 1/H_focus|``, with the pupil radius a
        and the image distance D, in addition to diffraction and aberrations. Near objects cover far ones; what they hide is
        the far surface at their rim, continued.

        Units of files: Silberman et al., ECCV (2012), ``depth_rel2depth_abs.m``; Sturm et al., IROS (2012); Scharstein et
        al., GCPR (2014). The channel Z of EXR is the distance from the viewer; renderers differ in whether it is that along
        the axis or along the ray, which must be multiplied by the cosine of its angle.

        Examples
        --------
        >>> import foveasim as fs
        >>> import numpy as np
        >>> depth_m = np.where(np.arange(64) < 32, 0.5, 2.0) * np.ones((48, 1))
        >>> scene = fs.Scene.from_rgbd(
        ...     np.ones((48, 64)),
        ...     depth_m,
        ...     distance_m=2.0,
        ...     pitch_um=500.0,
        ...     illuminance_lux=500.0,
        ... )
        >>> scene.depth_range_m
        (0.5, 2.0)
        """
        distances_m = read_depth(
            depth_m, depth_scale=depth_scale, depth_format=depth_format, calibration=calibration, missing=missing
        )
        plane = cls.from_picture(
            picture,
            pitch_um=pitch_um,
            fit=fit,
            gaze_range_um=gaze_range_um,
            field_of_view_deg=field_of_view_deg,
            distance_m=distance_m,
            peak_radiance_w_m2_sr_nm=peak_radiance_w_m2_sr_nm,
            luminance_cd_m2=luminance_cd_m2,
            illuminance_lux=illuminance_lux,
            reflectance=reflectance,
            wavelength_nm=wavelength_nm,
            band_width_nm=band_width_nm,
            spectrum=spectrum,
            encoding=encoding,
            channels=channels,
        )
        return replace(plane, depth_m=distances_m, depth_layers=depth_layers)

    @classmethod
    def from_cube(
        cls,
        path: OwnCheck[str | Path | ArrayLike],
        *,
        axis: int = -1,
        distance_m: float | None = None,
        pitch_um: float | None = None,
        fit: Fit | None = None,
        gaze_range_um: tuple[float, float] = (0.0, 0.0),
        field_of_view_deg: float | None = None,
        quantity: Quantity | None = None,
        unit: str | None = None,
        scale: float | None = None,
        illuminant: Illuminant | IlluminantTable | None = None,
        radiance_w_m2_sr_nm: float | None = None,
        luminance_cd_m2: float | None = None,
        illuminance_lux: float | None = None,
        wavelength_nm: Sequence[float] | None = None,
        band_width_nm: float | Sequence[float] | None = None,
        bands: Sequence[int] | None = None,
        range_nm: tuple[float, float] | None = None,
        resample_nm: Sequence[float] | None = None,
        rows: tuple[int, int] | None = None,
        columns: tuple[int, int] | None = None,
        name: str | None = None,
        invalid: Invalid = "raise",
    ) -> Scene:
        """
        Create a scene from a hyperspectral cube of radiance or reflectance.

        Parameters
        ----------
        path : path, (n_y, n_x, n_band) array, or xarray.DataArray
            ENVI header or data file, MAT file, scene of ISETCam, spectral EXR, netCDF or HDF5 file, zarr directory, numpy file,
            TIFF of several bands, or folder of pictures (:mod:`foveasim.scene.cubes`), detected from its content; or an array,
            top row first as in pictures, which is copied. The dimensions of an xarray.DataArray have names, and coordinates may
            specify wavelengths.
        axis : int
            Axis of the bands of an array.
        distance_m : float, optional, m
            Distance of the scene from the lens, if the file does not contain it.
        pitch_um, fit, gaze_range_um, field_of_view_deg : optional
            Pixel pitch in the scene, framing on the layout, or horizontal angle of the selected columns, as for
            :meth:`from_picture`. By default those of the file, or ``fit="cover"``.
        quantity : {"radiance", "reflectance"}, optional
            Quantity of the values, if the file does not specify it.
        unit : str, optional
            Unit of the values, if the file does not contain it, such as ``"W m-2 sr-1 nm-1"``, ``"uW/(cm^2 sr nm)"``,
            ``"photons/(s m2 sr nm)"`` or ``"%"``.
        scale : float, optional
            Factor from the numbers in the file to the unit, instead of that of the file.
        illuminant : {"A", "D50", "D55", "D65", "D75", "E"} or mapping, optional
            Illuminant of a reflectance: a CIE illuminant, or a table ``{"wavelength_nm": [...], "value": [...]}``, which is
            interpolated linearly. Default: ``"D65"``, which is tabulated from 380 to 780 nm.
        radiance_w_m2_sr_nm : float, W/(m² sr nm)
            For a reflectance: spectral radiance at 560 nm of a white with reflectance 1, or factor of the table.
        luminance_cd_m2, illuminance_lux : float, cd/m² and lx
            For a reflectance, instead: luminance of this white, or illuminance of the scene.
        wavelength_nm : sequence, optional, nm
            Wavelengths of all bands of the file, instead of those in the file.
        band_width_nm : number or sequence, optional, nm
            Widths of the bands of the scene; by default bands extend halfway to the adjacent wavelengths.
        bands : sequence of int, optional
            Indices of the bands, from 0. By default all except those that the file marks as bad.
        range_nm : (lowest, highest), optional, nm
            Wavelengths of the bands.
        resample_nm : sequence, optional, nm
            Ascending wavelengths of the scene, at which the bands are interpolated linearly.
        rows, columns : (start, stop), optional
            Part of the image, in pixels from the top and from the left, without ``stop``.
        name : str, optional
            Name of the variable, array or EXR layer, if the file contains several: ``data.cube`` is a field of a struct in a
            MAT file. For a folder of pictures, a pattern of their names.
        invalid : {"raise", "zero"}
            Whether NaN, infinite, negative and missing values are rejected or replaced by 0.

        Raises
        ------
        FileError
            If the file is missing, corrupt, truncated, too large or not a cube, contains invalid values, or lacks metadata that
            were not passed.
        ParameterError
            If an argument is out of range or inconsistent with the file.

        Warns
        -----
        FoveasimWarning
            If a reflectance exceeds 1 by more than 1 %.

        Notes
        -----
        Data are stored once, as float32 if this represents them exactly. Floating-point ENVI data by band or line (bsq, bil)
        above 1 GiB are mapped into memory, not copied. Each use of such a scene raises ``FileError`` if the size or the time of
        modification of the file has changed; replacing it by another file of the same name does not affect the scene. Scale
        factors, units, illuminant and interpolation change only the spectra of the basis images.
        """
        _check_framing(pitch_um, fit, field_of_view_deg)
        is_file = isinstance(path, str | os.PathLike)
        if is_file and axis != -1:
            raise ParameterError("axis", "must be -1 for files, whose formats specify the axes", axis)
        selection = Selection(
            wavelength_nm=wavelength_nm,
            bands=bands,
            range_nm=range_nm,
            resample_nm=resample_nm,
            rows=rows,
            columns=columns,
            invalid=invalid,
        )
        file = Path(path) if is_file else None  # type: ignore[arg-type]
        errors = array_errors() if file is None else as_file_error(file, "hyperspectral cube", passes=(ParameterError,))
        with errors:
            cube = select(cube_of(path, axis), selection) if file is None else read_cube(file, name, selection)
            radiance = spectral_radiance(
                cube,
                quantity=quantity,
                unit=unit,
                scale=scale,
                illuminant=illuminant,
                radiance_w_m2_sr_nm=radiance_w_m2_sr_nm,
                luminance_cd_m2=luminance_cd_m2,
                illuminance_lux=illuminance_lux,
                resample_nm=resample_nm,
                band_width_nm=band_width_nm,
            )
            distance_m = cube.distance_m if distance_m is None else distance_m
            if distance_m is None:
                raise ParameterError(
                    "distance_m",
                    f"must be given: the {'file' if is_file else 'array'} does not contain the distance of the scene",
                )
            if pitch_um is None and field_of_view_deg is None and fit is None:
                pitch_um, field_of_view_deg = cube.square_pitch_um(), cube.field_of_view_deg
                if pitch_um is not None:
                    field_of_view_deg = None
                fit = "cover" if pitch_um is None and field_of_view_deg is None else None
        radiance.warn_above_one()
        return cls(
            freeze(cube.data),
            radiance.spectrum_w_m2_sr_nm,
            radiance.wavelength_nm,
            radiance.band_width_nm,
            pitch_um,
            distance_m,
            source=str(path) if is_file else "a cube array",
            fit=fit,
            gaze_range_um=gaze_range_um,
            field_of_view_deg=field_of_view_deg,
            is_picture=True,
            illuminant=radiance.illuminant,
        )

    @classmethod
    def from_display(
        cls,
        picture: OwnCheck[str | Path | ArrayLike],
        display: Display | str,
        *,
        distance_m: float,
        subpixels: bool = False,
        wavelength_nm: Sequence[float] | None = None,
        band_width_nm: float | Sequence[float] | None = None,
    ) -> Scene:
        """
        Create a scene from a picture that a display shows.

        Parameters
        ----------
        picture : path, image of Pillow, or (n_y, n_x) or (n_y, n_x, n_channel) array
            Digital values, one pixel of the picture for each of the display; formats as for :meth:`from_picture`. Profiles and
            encodings of files are ignored, as by a display without colour management. Grey pictures have the same value in all
            primaries; alpha is in front of black.
        display : Display or str
            Display, or the name of a bundled one: ``"lcd"`` or ``"oled"`` (:mod:`foveasim.scene.displays`).
        distance_m : float, m
            Distance of the display from the lens.
        subpixels : bool
            Whether pixels are not uniform, but consist of the cells of the display, which are then the pixels of the scene.
        wavelength_nm : sequence, optional, nm
            Wavelengths of the scene, at which spectra are interpolated linearly; by default those of the display. White has the
            same luminance.
        band_width_nm : number or sequence, optional, nm
            Widths of the bands; by default bands extend halfway to the adjacent wavelengths.

        Returns
        -------
        Scene
            One basis image per primary. The pixel pitch is that of the display, or of its cells. White is the illuminant, and
            displays with the colours of sRGB show the linear sRGB of a photograph (``is_rgb``).

        Raises
        ------
        FileError
            If the picture cannot be read.
        ParameterError
            If the picture has no digital values from 0 to 1 for the primaries of the display, or the display has no cells.

        Examples
        --------
        >>> import foveasim as fs
        >>> import numpy as np
        >>> ramp = np.linspace(0.0, 1.0, 5)[np.newaxis]
        >>> scene = fs.Scene.from_display(ramp, "lcd", distance_m=0.5)
        >>> scene.luminance_cd_m2.round(2).tolist()  # 0.25 + 249.75 sRGB(v)
        [[0.25, 12.96, 53.71, 130.75, 250.0]]
        >>> fs.Scene.from_display(ramp, "lcd", distance_m=0.5, subpixels=True).basis.shape
        (3, 3, 15)
        """
        shown, is_file = display_of(display), isinstance(picture, str | os.PathLike)
        try:
            light = raster_of(
                shown,
                as_encoded(picture, "srgb"),
                subpixels=subpixels,
                wavelength_nm=wavelength_nm,
                band_width_nm=band_width_nm,
            )
        except ParameterError as error:
            is_of_file = is_file and error.name == "picture"
            raise (FileError(str(picture), str(error)) if is_of_file else error) from None
        return cls(
            freeze(light.basis),
            light.spectrum_w_m2_sr_nm,
            light.wavelength_nm,
            light.band_width_nm,
            light.pitch_um,
            distance_m,
            source=f"{picture if is_file else 'a picture array'} on a display ({shown.source or 'no source'})",
            illuminant=light.white,
            is_rgb=shown.has_srgb_colours,
            display=shown,
        )

    def on_display(self, picture: OwnCheck[str | Path | ArrayLike]) -> Scene:
        """
        Return the scene of another picture on the display of this one.

        Parameters
        ----------
        picture : path, image of Pillow, or array
            As for :meth:`from_display`.

        Returns
        -------
        Scene
            With the distance, position and bands of this scene, and subpixels if it has them.

        Raises
        ------
        ParameterError
            If this scene has no display, or the picture does not have its digital values.

        Examples
        --------
        >>> import foveasim as fs
        >>> import numpy as np
        >>> white = fs.Scene.from_display(np.ones((2, 3)), "oled", distance_m=0.3)
        >>> white.on_display(np.zeros((2, 3))).luminance_cd_m2.max()
        np.float64(0.0)
        """
        if self.display is None or self.pitch_um is None:
            raise ParameterError("picture", "requires a scene with a display, such as that of Scene.from_display")
        scene = type(self).from_display(
            picture,
            self.display,
            distance_m=self.distance_m,
            subpixels=self.pitch_um < self.display.pitch_um,
            wavelength_nm=self.wavelength_nm,  # type: ignore[arg-type]
            band_width_nm=self.band_width_nm,  # type: ignore[arg-type]
        )
        return scene.with_centre(self.centre_um)

    @classmethod
    def flat(
        cls,
        *,
        shape: tuple[int, int],
        pitch_um: float,
        distance_m: float,
        radiance_w_m2_sr_nm: float | None = None,
        luminance_cd_m2: float | None = None,
        illuminance_lux: float | None = None,
        reflectance: float = 1.0,
        wavelength_nm: Sequence[float] | None = None,
        band_width_nm: float | Sequence[float] | None = None,
    ) -> Scene:
        """
        Create a scene of uniform spectral radiance at all positions and wavelengths.

        Parameters
        ----------
        shape : (n_y, n_x)
        pitch_um, distance_m, wavelength_nm, band_width_nm
            As for :meth:`from_picture`.
        radiance_w_m2_sr_nm : float, W/(m² sr nm)
            Or ``luminance_cd_m2``, or ``illuminance_lux`` with ``reflectance``, as for :meth:`from_picture`.
        """
        if radiance_w_m2_sr_nm is not None:
            radiance_w_m2_sr_nm = RADIANCE.check("radiance_w_m2_sr_nm", radiance_w_m2_sr_nm)
        waves_nm, widths_nm = scene_bands(wavelength_nm, band_width_nm)
        radiance = level_of_white(
            "radiance_w_m2_sr_nm",
            radiance_w_m2_sr_nm,
            np.ones(waves_nm.size),
            waves_nm,
            widths_nm,
            luminance_cd_m2=luminance_cd_m2,
            illuminance_lux=illuminance_lux,
            reflectance=reflectance,
        )
        return cls(
            freeze(np.ones((1, *check_shape("shape", shape)), np.float32)),
            np.full((1, waves_nm.size), radiance),
            waves_nm,
            widths_nm,
            pitch_um,
            distance_m,
            source="a uniform field",
        )

    @classmethod
    def point_sources(
        cls,
        *,
        shape: tuple[int, int],
        pixels: Sequence[tuple[int, int]],
        intensity_w_sr_nm: float | Sequence[float],
        pitch_um: float,
        distance_m: float,
        wavelength_nm: Sequence[float] | None = None,
        band_width_nm: float | Sequence[float] | None = None,
    ) -> Scene:
        """
        Create a scene of point sources on a black background.

        Parameters
        ----------
        shape : (n_y, n_x)
        pixels : sequence of (iy, ix)
            Pixels of the point sources; row 0 is the bottom row.
        intensity_w_sr_nm : number, or one per point, W/(sr nm)
            Spectral radiant intensity of the points.
        pitch_um, distance_m, wavelength_nm, band_width_nm
            As for :meth:`from_picture`.

        Raises
        ------
        ParameterError
            If a pixel lies outside the picture, or a value is out of range.
        """
        pitch_um = check_number("pitch_um", pitch_um, above=0.0)
        n_y, n_x = check_shape("shape", shape)
        pixels = unmasked("pixels", pixels)
        try:
            points = np.asarray(pixels)
        except ValueError:
            raise ParameterError("pixels", "must be pairs (iy, ix) of integers", pixels) from None
        if points.ndim != 2 or points.shape[1] != 2 or points.dtype.kind not in "iu":
            raise ParameterError("pixels", "must be pairs (iy, ix) of integers", pixels)
        if np.any(points < 0) or np.any(points >= (n_y, n_x)):
            raise ParameterError("pixels", f"must lie within {n_y} rows and {n_x} columns", pixels)
        intensity = finite_array("intensity_w_sr_nm", intensity_w_sr_nm, at_least=0.0)
        if intensity.ndim > 1 or (intensity.ndim == 1 and intensity.size != points.shape[0]):
            raise ParameterError(
                "intensity_w_sr_nm", f"must be one number, or one for each of the {points.shape[0]} points"
            )
        image = np.zeros((1, n_y, n_x))
        np.add.at(image[0], (points[:, 0], points[:, 1]), intensity)
        waves_nm, widths_nm = scene_bands(wavelength_nm, band_width_nm)
        # A pixel of pitch p0 and radiance I / p0² has the intensity I.
        per_area = np.full((1, waves_nm.size), 1.0 / float(m_from_um(pitch_um)) ** 2)
        return cls(
            read_only(image),
            per_area,
            waves_nm,
            widths_nm,
            pitch_um,
            distance_m,
            source="point sources",
        )


def scene_bands(
    wavelength_nm: Sequence[float] | None, band_width_nm: float | Sequence[float] | None
) -> tuple[Floats, Floats]:
    """Return the wavelengths and widths of bands; by default one band at 550 nm of 100 nm."""
    if wavelength_nm is None:
        wavelength_nm, band_width_nm = GREY_NM, GREY_BAND_WIDTH_NM if band_width_nm is None else band_width_nm
    waves_nm = wavelengths_nm("wavelength_nm", wavelength_nm)
    return waves_nm, band_widths_nm(waves_nm, band_width_nm)


def _check_framing(pitch_um: float | None, fit: Fit | None, field_of_view_deg: float | None) -> None:
    """Raise ParameterError if a framing is given in two ways."""
    given = {"pitch_um": pitch_um, "field_of_view_deg": field_of_view_deg, "fit": fit}
    other, name = (*(name for name in given if given[name] is not None), None, None)[:2]
    if other is not None and name is not None:
        raise _framing_conflict(name, given[name], other)


def _framing_conflict(name: str, value: object, other: str) -> ParameterError:
    return ParameterError(
        name,
        f"must not be given together with '{other}'",
        value,
        hint="choose one of 'pitch_um', 'fit' and 'field_of_view_deg', and omit the others or set them to null",
    )


def _relative_radiance(picture: EncodedPicture, *, has_alpha: bool) -> Images:
    """Return the relative radiance (n_channel, n_y, n_x) float32, multiplied by alpha."""
    pixels, encoding = picture.pixels, picture.encoding
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype in (np.uint8, np.uint16):
        from foveasim.scene import _kernels

        peak = float(np.iinfo(pixels.dtype).max)
        table = decode(np.arange(peak + 1) / peak, encoding).astype(np.float32)
        values = np.arange(peak + 1, dtype=np.float32) / np.float32(peak)
        colours = from_file_rows(pixels[..., :-1] if has_alpha else pixels)
        radiance = np.empty(colours.shape, np.float32)
        _kernels.look_up(colours, table, radiance)
        alpha = values[from_file_rows(pixels[..., -1])] if has_alpha else None
    elif pixels.dtype.kind == "f":
        colours = pixels[..., :-1] if has_alpha else pixels
        may_be_negative = picture.is_wide and encoding == "linear"
        lowest = (pixels[..., -1:] if has_alpha else pixels[..., :0]) if may_be_negative else pixels
        if not np.isfinite(pixels).all() or lowest.min(initial=0.0) < 0:
            raise ParameterError("picture", "must be finite and >= 0 in all pixels")
        if encoding != "linear" and pixels.max() > MAX_ENCODED:
            raise ParameterError(
                "picture",
                f"must be <= {MAX_ENCODED:g} for encoding='{encoding}'",
                float(pixels.max()),
                hint="the peak of floating-point pictures is 1: divide by 255, or pass uint8",
            )
        precise = colours.astype(np.float32) if pixels.dtype == np.float16 else colours
        decoded = decode(np.ascontiguousarray(from_file_rows(precise)), encoding)
        radiance = decoded.astype(np.float32, copy=np.may_share_memory(decoded, pixels))
        alpha = from_file_rows(pixels[..., -1]).astype(np.float32) if has_alpha else None
    else:
        raise ParameterError("picture", f"must have the dtype uint8, uint16 or float, got {pixels.dtype}")
    if alpha is not None:
        radiance *= alpha
    return radiance


#: Common parameters of the examples: the size of pixels, the distance, and one band.
_GEOMETRY = {"pitch_um": 100.0, "distance_m": 1.0}
_BAND = {"wavelength_nm": [550.0], "band_width_nm": 10.0}


def _example_picture(directory: Path) -> dict[str, Any]:
    """Write a picture with bright pixels at the upper left and below."""
    path = directory / "picture.png"
    write_picture(path, np.array([[255, 0, 0], [255, 0, 0], [255, 255, 0]], np.uint8))
    return {"picture": str(path), "peak_radiance_w_m2_sr_nm": 0.02, **_BAND, **_GEOMETRY}


def _example_rgbd(directory: Path) -> dict[str, Any]:
    """Write a picture, and its distances in millimetres."""
    path = directory / "depth.png"
    write_picture(path, np.array([[1000, 1000, 900], [1000, 1000, 900], [1000, 1000, 900]], np.uint16))
    return {**_example_picture(directory), "depth_m": str(path), "depth_format": "mm"}


def _example_cube(directory: Path) -> dict[str, Any]:
    """Write an ENVI cube of two bands."""
    np.array([[[3, 0, 0], [3, 3, 0]]] * 2, "<f4").tofile(directory / "cube.img")
    entries = "samples = 3\nlines = 2\nbands = 2\ndata type = 4\ninterleave = bsq\nwavelength = {500, 600}\n"
    (directory / "cube.hdr").write_text(f"ENVI\n{entries}", encoding="utf-8")
    return {"path": str(directory / "cube.hdr"), "quantity": "radiance", "unit": "W/m2/sr/nm", **_GEOMETRY}


def _example_on_display(directory: Path) -> dict[str, Any]:
    """Write a picture as that of :func:`_example_picture`."""
    return {"picture": _example_picture(directory)["picture"], "display": "lcd", "distance_m": 1.0}


def _example_panorama(directory: Path) -> dict[str, Any]:
    """Write a panorama that is bright at the upper left and the lower right."""
    path = directory / "panorama.png"
    write_picture(path, np.array([[255, 0, 0, 0], [0, 0, 255, 255]], np.uint8))
    return {"picture": str(path), "peak_radiance_w_m2_sr_nm": 0.02, "yaw_deg": 20.0, **_BAND}


SCENES.register("picture", Scene.from_picture, example=_example_picture, expected=("#..", "#..", "##."))
SCENES.register("panorama", Scene.from_panorama, example=_example_panorama, expected=("#...", "..##"))
SCENES.register("rgbd", Scene.from_rgbd, example=_example_rgbd, expected=("#..", "#..", "##."))
_FLAT = {**_GEOMETRY, **_BAND, "shape": (4, 6), "radiance_w_m2_sr_nm": 0.02}
SCENES.register("flat", Scene.flat, example=_FLAT, expected=("##", "##"))
SCENES.register(
    "point_sources",
    Scene.point_sources,
    example={**_GEOMETRY, **_BAND, "shape": (4, 6), "pixels": [(0, 0), (3, 0), (3, 5)], "intensity_w_sr_nm": 1e-9},
    expected=("#....#", "......", "......", "#....."),
)
SCENES.register("cube", Scene.from_cube, example=_example_cube, expected=("#..", "##."))
SCENES.register("display", Scene.from_display, example=_example_on_display, expected=("#..", "#..", "##."))
