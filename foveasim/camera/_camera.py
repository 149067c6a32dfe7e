"""
The camera: optics, distortion and a sensor.

The only module that knows the order of the stages and creates random streams.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import NOT_NEGATIVE, Limits, OwnCheck
from foveasim._core.provenance import copy_plain_data, to_plain_data
from foveasim._core.random_streams import Streams
from foveasim._core.show import load, view_method
from foveasim._core.threads import cached_property, thread_count
from foveasim._core.validation import Floats, check_per_site, check_point, finite_array
from foveasim._projections import ImageProjection, check_direction
from foveasim.camera._clock import Clock
from foveasim.camera._colour import colour_correction
from foveasim.camera._exposure import ExposureTime
from foveasim.camera._footprints import FootprintCache, find_incidence, placed
from foveasim.camera._frames import Frame, ImageCache, Position, check_frames
from foveasim.camera._framing import Turn, axis_of, common_bounds_um, fit_panorama, fit_scene, turned_panorama
from foveasim.camera._rates import expected_rates, footprints_at
from foveasim.camera._steps import SensorFrame, capture_for_time, check_exposure, seconds_of, white_dn
from foveasim.camera._video import rates_of_frames, video
from foveasim.capture import Capture
from foveasim.distortion import Lens
from foveasim.distortion._projected import ProjectedLens, max_angle_rad, nearest_projection
from foveasim.errors import ParameterError, type_name
from foveasim.fields import Grid, PointMap, PowerMap
from foveasim.incidence import Incidence
from foveasim.integrate import Integrator, outline_bounds_um
from foveasim.layout.model import Layout
from foveasim.layout.rows import Scan
from foveasim.modes import Between
from foveasim.optics import Optics
from foveasim.reconstruct import Picture, reference
from foveasim.reconstruct.rasters import sum_of_images
from foveasim.scene import Scene
from foveasim.scene._panorama import Panorama
from foveasim.sensor import Footprints, NoiseBudget, Sensor, noise_budget
from foveasim.sensor.limits import EXPOSURE
from foveasim.sensor.model.auto_exposure import AUTO_PERCENTILE, AUTO_TARGET, PERCENTILE, TARGET
from foveasim.units import um_from_m, um_from_nm, w_from_w_m2_um2

if TYPE_CHECKING:
    from foveasim.twin import PictureComparison

#: What the optical axis is fixed to when the gaze moves: see :class:`Camera`.
GazeAxis = Literal["image", "sensor"]
#: Number of compiled layouts in the cache, per grid of one image.
MAX_CACHED_INTEGRATORS = 4
#: In cells of at most this width, in units of λN, irradiance is smooth: second-order integration is up to 70 times more
#: accurate. In cells wider than 0.8 λN it can be less accurate than first order.
SMOOTH_LAMBDA_N = 0.5


class Camera:
    """
    A lens and a sensor; ``capture`` exposes them to a scene.

    Parameters
    ----------
    optics : Optics
    sensor : Sensor
    distortion : lens model of foveasim.distortion, optional
        Displaces the image points of the ideal lens. The outlines of the photosites are mapped back through it once; no image
        is resampled. The optical axis meets the sensor at its ``centre_um``: the ideal image, relative illumination and field
        positions of a scene are centred there, as in OpenCV's ``projectPoints``. Where its ``focal_um`` differs between x
        and y, the ideal image is scaled accordingly, with unchanged area.
    order : {1, 2}, optional
        Order of integration: cells of constant irradiance, or with a gradient (see :class:`foveasim.Integrator`). By default
        2 for scenes whose image has cells of at most λN/2 at all wavelengths, else 1; always 1 for power maps.
    gaze_um : (x, y), µm
        Gaze: the point of the image at which the centre of the sensor is. Framing refers to the gaze (0, 0), so that the scale
        of an image does not depend on the gaze.
    gaze_deg : (azimuth, elevation), degrees
        Direction in a panorama towards which the camera turns from the orientation of the scene: to the right, then upwards,
        without roll. The image is computed for each direction.
    axis : {"image", "sensor"}
        What the optical axis is fixed to when the gaze moves. ``"image"``: the sensor moves behind a fixed lens; relative
        illumination, aberrations and distortion stay with the image, which is computed once for all gazes of a video.
        ``"sensor"``: the camera turns towards the gaze; they stay with the sensor, and the image is computed for each gaze. In
        a panorama, the gaze is the direction of its point.
    n_threads : int, optional
        Number of threads, by default one per core. Results are bit-identical for any number.

    Warns
    -----
    CoverageWarning
        On a capture, when photosites extend beyond the image or the image circle, or when the layout measures less than a
        quarter of the width of a photograph. Scenes with ``fit`` are framed on the layout, without these warnings.
    SamplingWarning
        On a capture, when second-order integration of a sharp image on coarse cells gives negative photoelectrons; once per
        camera, when more than 10 % of the photosites are smaller than the pixels of a photograph.
    ExposureWarning
        On a capture of a photograph, once per camera and cause, when more than 20 % of the photosites are saturated, or more
        than half receive less than one electron or one code above black.
    FoveasimWarning
        On a capture of a scene, when the ``focal_um`` of the lens model differs by more than 2 % from the image distance of the
        optics, which is their focal length for a distant scene: it would be distorted for wrong field angles.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0)
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout)
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(200, 200),
    ...     pitch_um=10.0,
    ...     distance_m=0.5,
    ...     radiance_w_m2_sr_nm=0.1,
    ...     band_width_nm=10.0,
    ... )
    >>> camera.capture(scene, exposure_s=0.01, seed=0).code.shape
    (64,)
    """

    def __init__(
        self,
        *,
        optics: Optics,
        sensor: Sensor,
        distortion: Lens | None = None,
        order: Literal[1, 2] | None = None,
        gaze_um: tuple[float, float] = (0.0, 0.0),
        gaze_deg: OwnCheck[tuple[float, float]] = (0.0, 0.0),
        axis: GazeAxis = "image",
        n_threads: int | None = None,
    ) -> None:
        if not isinstance(sensor.layout, Layout):
            raise ParameterError("sensor", f"must have a foveasim.Layout, got {type_name(sensor.layout)}")
        self._optics = optics
        self._sensor = sensor
        self._distortion = distortion
        self._order: Literal[1, 2] | None = None if order is None else 2 if order == 2 else 1
        self._layout = sensor.layout
        self._gaze_um = check_point("gaze_um", gaze_um)
        self._gaze_deg = check_direction("gaze_deg", gaze_deg)
        self._axis: GazeAxis = axis
        self._n_threads = thread_count(n_threads)
        #: By grid, order, position, whether the overlaps are stored, footprints, and projection.
        self._integrators: dict[tuple[Grid, int, Position, bool, Footprints | None, ImageProjection], Integrator] = {}
        self._footprints = FootprintCache()
        self._bounds_um: dict[ImageProjection, tuple[float, float, float, float]] = {}
        self._lenses: dict[ImageProjection, ProjectedLens] = {}
        #: The most recent scene with ``fit``, the gaze of a camera that turns, and the framed scene.
        self._framed: tuple[Scene, Turn, Scene] | None = None
        #: Causes of warnings that are not repeated.
        self._warned: set[str] = set()

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {
            "_integrators": {},
            "_footprints": FootprintCache(),
            "_bounds_um": {},
            "_lenses": {},
            "_framed": None,
        }  # without caches

    def __repr__(self) -> str:
        return f"Camera({self._optics!r}, {self._sensor!r})"

    _repr_html_ = view_method("to_html")

    @property
    def optics(self) -> Optics:
        """The optics; :meth:`replace` returns a camera with others."""
        return self._optics

    @property
    def sensor(self) -> Sensor:
        """The sensor; :meth:`replace` returns a camera with another."""
        return self._sensor

    @property
    def distortion(self) -> Lens | None:
        """The lens model of the distortion, or None."""
        return self._distortion

    @property
    def layout(self) -> Layout:
        """The layout of the sensor."""
        return self._layout

    @property
    def gaze_um(self) -> tuple[float, float]:
        """Point (x, y) of the image at which the centre of the sensor is, µm."""
        return self._gaze_um

    @property
    def gaze_deg(self) -> tuple[float, float]:
        """Azimuth and elevation towards which the camera turns in a panorama, degrees."""
        return self._gaze_deg

    @property
    def axis(self) -> GazeAxis:
        """Reference of the optical axis when the gaze moves: ``"image"`` or ``"sensor"``."""
        return self._axis

    @property
    def n_threads(self) -> int:
        """Number of threads."""
        return self._n_threads

    @property
    def settings(self) -> dict[str, Any]:
        """Copy of the settings that all captures share: optics, distortion, sensor, layout."""
        return copy_plain_data(self._settings)

    @cached_property
    def _settings(self) -> dict[str, Any]:
        return {
            "optics": to_plain_data(self._optics),
            "distortion": None if self._distortion is None else to_plain_data(self._distortion),
            "sensor": to_plain_data(self._sensor, without=("layout",)),
            "layout": to_plain_data(dict(self._layout.provenance)),
        }

    def oversample(self, light: Scene | PowerMap) -> int:
        """Return the number of map cells along a source pixel; 1 for power maps."""
        light = self.geometry_of(light)
        if isinstance(light, PowerMap):
            return 1
        n = self._optics.oversample
        return self._optics.auto_oversample(light) if n == "auto" else n

    def order(self, light: Scene | PowerMap) -> Literal[1, 2]:
        """Return the order of integration for a scene or power map."""
        light = self.geometry_of(light)
        if self._order is not None:
            return self._order
        if isinstance(light, PowerMap):
            return 1
        narrowest_um = float(um_from_nm(light.wavelength_nm.min())) * self._optics.working_f_number(light.distance_m)
        cell_um = self._optics.grid(light).pitch_x_um / self.oversample(light)
        return 2 if cell_um <= SMOOTH_LAMBDA_N * narrowest_um else 1

    def fit_scene(self, scene: Scene, *, others: Iterable[Camera] = ()) -> Scene:
        """
        Return a scene with the pixel pitch that its ``fit`` requires with this camera.

        Captures and all other results of the camera frame their scenes; this method shows the pitch, or prepares a scene for
        functions without a camera, such as :meth:`Optics.power_map`, or for several cameras.

        Parameters
        ----------
        scene : Scene
            With ``fit="cover"`` the image of the picture covers all photosites, with ``"contain"`` it lies within the bounding
            box of the layout, with ``"width"`` it has the width of this box. The optical axis and the centre of the picture are
            at the centre of this box. With a lens model they are at its ``centre_um``, so that a layout that is not centred
            there requires a larger picture to be covered, and contains a smaller one; outlines are undistorted first, and
            sites outside the image circle do not count. With lateral chromatic aberration, the condition holds for all
            wavelengths. The gaze is not considered, but ``gaze_range_um`` of the scene enlarges the box.
        others : iterable of Camera
            With the same optics and distortion. The bounding box is then that of all layouts, and all cameras have the same
            image of the returned scene: pass it to each, instead of the scene, to compare them.

        Returns
        -------
        Scene
            With ``pitch_um`` and its optical axis; the scene itself if it has a pitch.

        Raises
        ------
        ParameterError
            When the layout has no photosites in the image circle, or for ``"contain"`` the optical axis is outside its
            bounding box; when the distance of the scene is at most the focal length, or when the cameras have different lenses.

        Examples
        --------
        >>> import foveasim as fs
        >>> import numpy as np
        >>> optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
        >>> wide, high = (fs.layout.grid(n_x=n, n_y=60 - n, pitch_um=1.0) for n in (40, 20))
        >>> cameras = [
        ...     fs.Camera(optics=optics, sensor=fs.Sensor(layout)) for layout in (wide, high)
        ... ]
        >>> scene = fs.Scene.from_picture(
        ...     np.ones((10, 10)), fit="cover", distance_m=1.0, illuminance_lux=500.0
        ... )
        >>> framed = cameras[0].fit_scene(scene, others=cameras[1:])
        >>> [round(camera.image_grid(framed).bounds_um[2], 6) for camera in cameras]
        [20.0, 20.0]
        """
        chosen = self._optics.projection
        is_plane = scene.panorama is None and scene.projection == "rectilinear"
        if is_plane and self._distortion is None and chosen not in ("auto", "rectilinear"):
            raise ParameterError(
                "distortion",
                f"must be given for a photograph of a plane in the {chosen} projection; pass "
                f"foveasim.distortion.Fisheye(projection='{chosen}', focal_um=...)",
            )
        if scene.pitch_um is not None:
            return scene
        return self._frame([self, *others], scene, Turn())

    def _frame(self, cameras: Sequence[Camera], scene: Scene, turn: Turn | None) -> Scene:
        """Return a scene with its pitch; cells of a panorama are 0 without a turn."""
        framed = self._framed
        if len(cameras) == 1 and framed is not None and framed[0] is scene and turn in (framed[1], None):
            return framed[2]
        projection = self.projection(scene)
        bounds_um = common_bounds_um(cameras, str(scene.fit), projection)
        if scene.panorama is None:
            found = fit_scene(scene, self._optics, self._distortion, bounds_um)
        else:
            found = fit_panorama(scene, self._optics, self._distortion, bounds_um, projection, turn, self._n_threads)
        if len(cameras) == 1 and turn is not None:
            self._framed = scene, turn, found
        return found

    @property
    def layout_bounds_um(self) -> Floats:
        """Bounds of the undistorted outlines, (4,) µm; NaN without any in the image circle."""
        return self.bounds_in_um("rectilinear")

    def bounds_in_um(self, projection: ImageProjection) -> Floats:
        """Return the bounds of the outlines in an image of a projection, (4,) µm; NaN without any."""
        if projection not in self._bounds_um:
            self._bounds_um[projection] = outline_bounds_um(self._layout, self._lens_in(projection))
        return np.array(self._bounds_um[projection])

    def projection(self, light: Scene | PowerMap) -> ImageProjection:
        """
        Return the projection of the image of a scene, or of a power map.

        Parameters
        ----------
        light : Scene or PowerMap

        Returns
        -------
        {"rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"}
            That of a power map or of a picture. For a panorama that of ``Optics(projection=...)``; if it is ``"auto"``, the
            one nearest to the lens model within the bounds of the layout, rectilinear without a model.
        """
        if isinstance(light, PowerMap) or light.panorama is None:
            return light.projection
        chosen = self._optics.projection
        if chosen != "auto":
            return chosen
        return "rectilinear" if self._distortion is None else self._nearest_projection

    @cached_property
    def _nearest_projection(self) -> ImageProjection:
        """Projection nearest to the lens model."""
        assert self._distortion is not None
        bounds_um = np.array(outline_bounds_um(self._layout))
        return nearest_projection(self._distortion, max_angle_rad(self._distortion, bounds_um))

    def lens_for(self, light: Scene | PowerMap) -> PointMap | None:
        """
        Return the lens whose ideal positions are those of the image of a scene or power map.

        Returns
        -------
        object with ``distort`` and ``undistort``, or None
            :attr:`distortion`, unless the :meth:`projection` of the image is not rectilinear.
        """
        return self._lens_in(self.projection(light))

    def _lens_in(self, projection: ImageProjection) -> PointMap | None:
        if self._distortion is None or projection == "rectilinear":
            return self._distortion
        return self._lenses.setdefault(projection, ProjectedLens(self._distortion, projection))

    def sensor_frame(self, scene: Scene) -> SensorFrame:
        """Return the optical axis and the scales of the image of a scene."""
        if self._distortion is not None or scene.fit is None:
            return SensorFrame.of(self._distortion)
        axis_um = scene.axis_um
        return SensorFrame.of(None, axis_of(self.layout_bounds_um) if axis_um is None else axis_um)

    def _with_pitch(self, light: Scene | PowerMap) -> Scene | PowerMap:
        """Return a scene with its pitch, or a power map."""
        return self.fit_scene(light) if isinstance(light, Scene) else light

    def geometry_of(self, light: Scene | PowerMap) -> Scene | PowerMap:
        """Return a scene with its pitch, of a panorama with pixels of 0, or a power map."""
        if isinstance(light, Scene) and light.panorama is not None and light.pitch_um is None:
            return self._frame([self], light, None)
        return self._with_pitch(light)

    @overload
    def light_at_gaze(self, light: Scene, gaze_um: Position | None = None) -> Scene: ...

    @overload
    def light_at_gaze(self, light: PowerMap, gaze_um: Position | None = None) -> PowerMap: ...

    def light_at_gaze(self, light: Scene | PowerMap, gaze_um: Position | None = None) -> Scene | PowerMap:
        """
        Return a scene with its pitch, where a camera that turns towards a gaze sees it.

        Parameters
        ----------
        light : Scene or PowerMap
        gaze_um : (x, y), optional, µm
            By default that of the camera.

        Returns
        -------
        Scene or PowerMap
            For ``axis="sensor"`` a scene whose centre is displaced against the gaze, or a panorama seen in its direction;
            otherwise only the pitch is set. A panorama is turned by :attr:`gaze_deg`, unless it has a gaze of its own
            (:func:`foveasim.video.turn_camera`).

        Raises
        ------
        ParameterError
            For a power map and ``axis="sensor"``: its relative illumination cannot follow the gaze; for ``gaze_deg`` and a
            scene that is not a panorama.
        """
        if isinstance(light, Scene) and light.panorama is not None:
            moved_um = self._gaze_um if gaze_um is None else check_point("gaze_um", gaze_um)
            return self._frame([self], light, self._turn(light.panorama, moved_um))
        if any(self._gaze_deg):
            raise ParameterError(
                "gaze_deg",
                "must be (0, 0) for a plane, a power map, and a panorama that a camera has framed; use 'gaze_um', or turn the "
                "panorama first: Scene.turned",
                self._gaze_deg,
                "degrees",
            )
        gaze = np.array(self._gaze_um) if gaze_um is None else np.array(check_point("gaze_um", gaze_um))
        if self._axis == "image" or not gaze.any():
            return self._with_pitch(light)
        if isinstance(light, PowerMap):
            raise ParameterError(
                "axis",
                "must be 'image' for a power map: its relative illumination and aberrations are fixed",
                self._axis,
            )
        scene = self.fit_scene(light)
        if scene.projection != "rectilinear":
            raise ParameterError(
                "axis",
                f"must be 'image' for a picture in the {scene.projection} projection; use Scene.from_panorama",
                self._axis,
            )
        per_um = self.sensor_frame(scene).scale * self._optics.magnification(scene.distance_m)
        x_um, y_um = (np.array(scene.centre_um) - gaze / per_um).tolist()
        return scene.with_centre((x_um, y_um))

    def seen_panorama(self, scene: Scene) -> Panorama:
        """Return the panorama of a scene with the orientation at the gaze of the camera."""
        assert scene.panorama is not None
        projection, frame = self.projection(scene), self.sensor_frame(scene)
        focal_um = self._optics.magnification(scene.distance_m) * float(um_from_m(scene.distance_m))
        turn = self._turn(scene.panorama, self._gaze_um)
        return turned_panorama(scene.panorama, self._distortion, projection, np.array(frame.axis_um), focal_um, turn)

    def _turn(self, panorama: Panorama, gaze_um: Position) -> Turn:
        """Return the turn of a camera in a panorama."""
        if self._axis == "image" or not any(gaze_um):
            return Turn(gaze_deg=self._gaze_deg)
        if any(self._gaze_deg) or panorama.gaze_deg is not None:
            raise ParameterError(
                "gaze_um",
                "must be (0, 0) for axis='sensor' and a camera that turns by 'gaze_deg'; use one of both",
                gaze_um,
                "µm",
            )
        return Turn(gaze_um=gaze_um)

    @property
    def position_um(self) -> Position:
        """Position (x, y) of the layout's origin in the image, µm."""
        return self._gaze_um if self._axis == "image" else (0.0, 0.0)

    def image_grid(self, scene: Scene) -> Grid:
        """
        Return the undistorted grid of a scene's pixels, in the sensor frame at gaze (0, 0).

        Returns
        -------
        Grid
            :meth:`Optics.grid`, centred on the optical axis: the principal point of the distortion model.
        """
        return self.sensor_frame(scene).image(self._optics.grid(self._scene_at_gaze(scene)))

    def _scene_at_gaze(self, scene: Scene) -> Scene:
        """Return :meth:`light_at_gaze` of a scene."""
        found = self.light_at_gaze(scene)
        assert isinstance(found, Scene)
        return found

    def power_map(self, scene: Scene) -> PowerMap:
        """
        Compute the undistorted image of a scene, in the sensor frame at gaze (0, 0).

        Returns
        -------
        PowerMap
            (n_wavelength, n_y, n_x), W/m²: :meth:`Optics.power_map` with :meth:`oversample` cells along a source pixel,
            centred on the principal point of the distortion model. At the same ``order``, its capture is that of the scene,
            unless lateral chromatic aberration gives images of several sizes: these are resampled to the cells of the ideal
            image by areas of overlap, which blurs them by up to a cell. Captures and :meth:`reference` do not resample.

        Raises
        ------
        ParameterError, SimulationError
            When the distance of the scene is at most the focal length, or the result is not finite.
        """
        scene = self._scene_at_gaze(scene)
        power_map = self._optics.resolve_oversample(scene).power_map(scene, n_threads=self._n_threads)
        return replace(power_map, grid=self.sensor_frame(scene).image(power_map.grid))

    def integrator(
        self,
        grid: Grid,
        *,
        order: Literal[1, 2] = 1,
        n_grids: Annotated[int, Limits(at_least=1)] = 1,
        position_um: Position | None = None,
        compiled: bool = True,
        footprints: Footprints | None = None,
        projection: ImageProjection = "rectilinear",
    ) -> Integrator:
        """
        Return the sensor's layout compiled for a grid.

        Parameters
        ----------
        grid : Grid
        order : {1, 2}
            Order of integration.
        n_grids : int
            Number of grids that are used together: the cache has room for them.
        position_um : (x, y), optional, µm
            Position of the layout's origin in the image, by default :attr:`position_um`.
        compiled : bool
            As for :class:`Integrator`. Both sum in different orders, and are cached separately.
        footprints : Footprints, optional
            Light that the sites collect: :meth:`footprints`. Its outlines, in the frame of the sensor, replace those of the
            layout.
        projection : str
            Projection of the image: :meth:`projection`.

        Returns
        -------
        Integrator
            From the cache, when the same one was used recently.
        """
        position_um = self.position_um if position_um is None else check_point("position_um", position_um)
        key = (
            grid,
            order,
            position_um,
            compiled,
            None if footprints is None or footprints.outlines is None else footprints,
            projection,
        )
        integrator = self._integrators.get(key)
        if integrator is None:
            integrator = Integrator(
                placed(self._layout, footprints, position_um),
                grid,
                distortion=self._lens_in(projection),
                order=order,
                compiled=compiled,
                n_threads=self._n_threads,
            )
        # The most recent entry is not moved: threads that compute further frames look it up at the same time.
        if next(reversed(self._integrators), None) != key:
            self._integrators.pop(key, None)
            self._integrators[key] = integrator
        while len(self._integrators) > MAX_CACHED_INTEGRATORS * n_grids:
            self._integrators.pop(next(iter(self._integrators)), None)
        return integrator

    def replace(
        self,
        *,
        optics: Optics | None = None,
        sensor: Sensor | None = None,
        gaze_um: tuple[float, float] | None = None,
        gaze_deg: OwnCheck[tuple[float, float] | None] = None,
        axis: GazeAxis | None = None,
        n_threads: int | None = None,
    ) -> Camera:
        """
        Return a camera with other optics, another sensor, or another gaze.

        Compiled layouts are shared when the new sensor has the same layout object.
        """
        other = Camera(
            optics=self._optics if optics is None else optics,
            sensor=self._sensor if sensor is None else sensor,
            distortion=self._distortion,
            order=self._order,
            gaze_um=self._gaze_um if gaze_um is None else gaze_um,
            gaze_deg=self._gaze_deg if gaze_deg is None else gaze_deg,
            axis=self._axis if axis is None else axis,
            n_threads=self._n_threads if n_threads is None else n_threads,
        )
        if other._layout is self._layout:
            other._bounds_um, other._lenses, other._footprints = self._bounds_um, self._lenses, self._footprints
            if other._n_threads == self._n_threads:
                other._integrators = self._integrators
        return other

    def with_gaze(
        self,
        gaze_um: tuple[float, float] | None = None,
        axis: GazeAxis | None = None,
        *,
        gaze_deg: OwnCheck[tuple[float, float] | None] = None,
    ) -> Camera:
        """
        Return the camera with another gaze.

        Parameters
        ----------
        gaze_um : (x, y) or None, µm
            See the class; None for that of this camera.
        axis : {"image", "sensor"}, optional
            As for the class; by default that of this camera.
        gaze_deg : (azimuth, elevation), optional, degrees
            As for the class; by default that of this camera.

        Returns
        -------
        Camera
            Shares compiled layouts.

        Examples
        --------
        >>> import foveasim as fs
        >>> layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0)
        >>> camera = fs.Camera(
        ...     optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout)
        ... )
        >>> camera.with_gaze((20.0, -5.0)).gaze_um
        (20.0, -5.0)
        """
        if gaze_um is None and axis is None and gaze_deg is None:
            return self
        other = self.replace(gaze_um=gaze_um, axis=axis, gaze_deg=gaze_deg)
        other._warned = self._warned
        return other

    def photoelectrons_per_s(
        self,
        light: Scene | PowerMap,
        *,
        images: ImageCache | None = None,
    ) -> Floats:
        """
        Return the expected photoelectrons of every site per second.

        Parameters
        ----------
        light : Scene or PowerMap
            A scene, or a power map from any optics program.
        images : dict, optional
            Cache of the scene's images, read and extended: for further layouts with the same optics, scene and colour
            filters.

        Returns
        -------
        rate_e_per_s : (n_site,) float64, e-/s

        Raises
        ------
        ParameterError
            When ``light`` has another type, or a wavelength is outside the sensor's tables.
        SimulationError
            When the power map is not finite within a site.
        """
        return expected_rates(self, light, Clock(), cached=images)

    def capture(
        self,
        light: Scene | PowerMap,
        *,
        exposure_s: ExposureTime,
        seed: int,
        frame: int = 0,
        gaze_um: tuple[float, float] | None = None,
        axis: GazeAxis | None = None,
        gaze_deg: OwnCheck[tuple[float, float] | None] = None,
        photo_e_per_s: Floats | None = None,
    ) -> Capture:
        """
        Simulate one exposure.

        Parameters
        ----------
        light : Scene or PowerMap
            A scene, or a power map from any optics program.
        exposure_s : float or str, s
            Exposure time: a number, a fraction such as ``"1/50"``, ``"auto"`` for that of :meth:`auto_exposure` with its
            default target, or an exposure value such as ``"EV 12"``, for the f-number of the optics.
        seed, frame : int
            Seed and frame number of the noise. Equal ones give bit-identical captures.
        gaze_um : (x, y), optional, µm
            Point of the image at which the centre of the sensor is, instead of the gaze of the camera.
        axis : {"image", "sensor"}, optional
            What the optical axis is fixed to: see the class.
        gaze_deg : (azimuth, elevation), optional, degrees
            Direction towards which the camera turns in a panorama, instead of that of the camera.
        photo_e_per_s : (n_site,) float64, optional, e-/s
            Result of :meth:`photoelectrons_per_s` for the same ``light`` and gaze, which is then not computed again; without
            warnings of the exposure.
        """
        if gaze_um is not None or axis is not None or gaze_deg is not None:
            return self.with_gaze(gaze_um, axis, gaze_deg=gaze_deg).capture(
                light, exposure_s=exposure_s, seed=seed, frame=frame, photo_e_per_s=photo_e_per_s
            )
        streams = Streams(seed, frame)
        clock, is_given = Clock(), photo_e_per_s is not None
        if photo_e_per_s is None:
            photo_e_per_s = expected_rates(self, light, clock)
        else:
            photo_e_per_s = finite_array("photo_e_per_s", photo_e_per_s, at_least=0.0)
            check_per_site("photo_e_per_s", photo_e_per_s, self._layout.n_sites)
        capture = capture_for_time(self, light, photo_e_per_s, exposure_s, streams, clock)
        if not is_given:
            check_exposure(self, light, photo_e_per_s, capture)
        return capture

    def auto_exposure(
        self,
        light: Scene | PowerMap,
        *,
        target: Annotated[float, TARGET] = AUTO_TARGET,
        percentile: Annotated[float, PERCENTILE] = AUTO_PERCENTILE,
    ) -> float:
        """
        Return the exposure time that makes a bright photosite reach a fraction of its range.

        Parameters
        ----------
        light : Scene or PowerMap
        target, percentile : float
            Fraction of the range from black to saturation, and percentile of the sites that reaches it:
            :meth:`foveasim.Sensor.exposure_for`.

        Returns
        -------
        exposure_s : float, s

        Raises
        ------
        ParameterError
            If no light reaches these sites, or no exposure time reaches the target.

        Examples
        --------
        >>> import foveasim as fs
        >>> sensor = fs.Sensor(
        ...     fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0), full_well_e=1e4, capacitance_f=6e-16
        ... )
        >>> camera = fs.Camera(
        ...     optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=sensor
        ... )
        >>> scene = fs.Scene.flat(
        ...     shape=(200, 200),
        ...     pitch_um=10.0,
        ...     distance_m=0.5,
        ...     illuminance_lux=500.0,
        ...     band_width_nm=100.0,
        ... )
        >>> exposure_s = camera.auto_exposure(scene, target=0.5)
        >>> capture = camera.capture(scene, exposure_s=exposure_s, seed=0)
        >>> round(float(capture.electrons.mean()) / 1e4, 1)
        0.5
        """
        rates = self.photoelectrons_per_s(light)
        return self._sensor.exposure_for(rates, target=target, percentile=percentile, n_threads=self._n_threads)

    def rates(self, frames: OwnCheck[Iterable[Frame]], *, ahead: Annotated[int, NOT_NEGATIVE] = 0) -> Iterator[Floats]:
        """
        Yield the expected photoelectrons of every site per second, frame by frame.

        Parameters
        ----------
        frames : iterable of Scene or PowerMap, or of pairs with a position (x_um, y_um)
        ahead : int
            As for :meth:`video`.

        Yields
        ------
        photo_e_per_s : (n_site,) float64, e-/s
            As :meth:`photoelectrons_per_s` returns it. Read-only: repeated frames share one array.
        """
        check_frames(frames)
        return (rate_e_per_s for _, rate_e_per_s in rates_of_frames(self, frames, Clock(), ahead))

    def video(
        self,
        frames: OwnCheck[Iterable[Frame]],
        *,
        exposure_s: ExposureTime | Sequence[float],
        seed: int,
        first_frame: int = 0,
        frame_s: float | None = None,
        line_s: float = 0.0,
        every: Annotated[int, Limits(at_least=1)] = 1,
        between: Between = "hold",
        scan: Scan | None = None,
        ahead: Annotated[int, NOT_NEGATIVE] = 0,
        times_s: ArrayLike | None = None,
    ) -> Iterator[Capture]:
        """
        Yield captures of a sequence of frames, each computed on demand.

        Parameters
        ----------
        frames : iterable of Scene or PowerMap, or of pairs with a position (x_um, y_um)
            A position is the gaze of a frame, instead of that of the camera. See :mod:`foveasim.video` for frames from
            image and video files, and for gaze paths.
        exposure_s : float, str, or sequence of float, s
            As for :meth:`capture`. ``"auto"`` is the time of :meth:`auto_exposure` for each capture, from its first frame; for
            equal times pass that of one frame. A sequence is an exposure bracket: the captures use its times cyclically, by
            their numbers.
        seed : int
            Seed of the temporal noise; fixed patterns belong to the device.
        first_frame : int
            Number of the first capture: capture k has the noise of ``capture(..., frame=first_frame + k)``. To resume a
            video, pass the frames from number ``first_frame * every``.
        frame_s : float, optional, s
            Frame period. Without it and ``times_s`` each frame is exposed separately.
        line_s : float, s
            Line time of a rolling shutter: a site starts ``readout_order * line_s`` after the first. Requires times of the
            frames. Layouts without this column are read row by row, from the top of the picture, as cameras are.
        every : int
            Number of frames per capture.
        between : {"hold", "linear"}
            Irradiance between frames: constant until the next frame, or interpolated linearly.
        scan : {"rows_from_top", "rows_from_bottom", "columns_from_left", "columns_from_right"}, optional
            Order of the rows or columns in the upright picture, instead of the column ``readout_order``: see
            :class:`foveasim.modes.Shutter`.
        ahead : int
            Number of frames to compute in advance, each in one thread. This can be faster than one frame in all threads for
            frames that are slow to read, or with many cores; on two cores it is slower. Only for frames that do not depend on
            earlier captures.
        times_s : (n_frame,) float64, s
            Times of the frames in strictly ascending order, such as the time stamps of a video, instead of ``frame_s``. Default
            for ``line_s``, ``every`` and ``between``: those that the frames carry, as a :class:`foveasim.video.FrameSource` and
            the frames along a :class:`foveasim.video.GazePath` do. The time of each capture is the setting ``time_s``.

        Raises
        ------
        ParameterError, SimulationError
            On the call, when an argument is out of range; during iteration, as for :meth:`capture`.

        Warns
        -----
        FoveasimWarning
            When an exposure is longer than the time to the start of the next one, or the shutter is rolling, the layout has no
            column ``readout_order``, and no ``scan`` is specified.

        Notes
        -----
        Memory contains one power map, or ``ahead`` of them, and a few numbers per site for each exposure in progress. The
        layout is compiled once.

        The image of a repeated frame (the same object) is computed once, also for a moving gaze. A position shifts the
        photosites' outlines, so that fractions of a cell are exact. The layout is compiled for the position (0, 0) only: most
        others occur once, and repeated ones give bit-identical rates.

        With ``frame_s`` or ``times_s``, a capture integrates all frames during its exposure, weighted by their time; the last
        frame lasts until the last exposure ends.

        Examples
        --------
        >>> import foveasim as fs
        >>> layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0)
        >>> camera = fs.Camera(
        ...     optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout)
        ... )
        >>> scene = fs.Scene.flat(
        ...     shape=(200, 200),
        ...     pitch_um=10.0,
        ...     distance_m=0.5,
        ...     radiance_w_m2_sr_nm=0.1,
        ...     band_width_nm=10.0,
        ... )
        >>> [c.settings["frame"] for c in camera.video([scene, scene], exposure_s=0.01, seed=0)]
        [0, 1]
        """
        return video(
            self,
            frames,
            exposure_s,
            Streams(seed, first_frame),
            frame_s,
            line_s=line_s,
            every=every,
            between=between,
            scan=scan,
            ahead=ahead,
            times_s=times_s,
        )

    def predict(
        self,
        light: Scene | PowerMap,
        *,
        exposure_s: ExposureTime,
        gaze_um: tuple[float, float] | None = None,
        axis: GazeAxis | None = None,
        gaze_deg: OwnCheck[tuple[float, float] | None] = None,
    ) -> tuple[Floats, Floats]:
        """
        Return mean and variance of every site's code analytically.

        Parameters
        ----------
        light, exposure_s, gaze_um, axis, gaze_deg
            As for :meth:`capture`.

        Returns
        -------
        mean_dn, variance_dn2 : (n_site,) float64, DN and DN²
            Over the temporal noise of this device; its fixed patterns are part of the mean.
        """
        rate_e_per_s = self.with_gaze(gaze_um, axis, gaze_deg=gaze_deg).photoelectrons_per_s(light)
        exposure_s = seconds_of(self, exposure_s, rate_e_per_s)
        expected_e = self._sensor.expected_electrons(rate_e_per_s, exposure_s)
        return self._sensor.predict(expected_e, exposure_s=exposure_s, n_threads=self._n_threads)

    def predict_covariance(
        self,
        light: Scene | PowerMap,
        sites: ArrayLike,
        *,
        exposure_s: ExposureTime,
    ) -> Floats:
        """
        Return the temporal covariance of the codes of some sites analytically.

        Parameters
        ----------
        light : Scene or PowerMap
        sites : (n,) int
            Indices of the sites.
        exposure_s
            As for :meth:`capture`.

        Returns
        -------
        covariance : (n, n) float64, DN²
            See :meth:`foveasim.Sensor.predict_covariance`.
        """
        rate_e_per_s = self.photoelectrons_per_s(light)
        exposure_s = seconds_of(self, exposure_s, rate_e_per_s)
        expected_e = self._sensor.expected_electrons(rate_e_per_s, exposure_s)
        return self._sensor.predict_covariance(expected_e, sites, exposure_s=exposure_s)

    def reference(self, light: Scene | PowerMap, grid: Grid, *, exposure_s: Annotated[float, EXPOSURE]) -> Picture:
        """
        Return the picture of an ideal raster sensor, as ground truth for reconstructions.

        Parameters
        ----------
        light : Scene or PowerMap
        grid : Grid
            The pixels, in the image plane without distortion, from the position of the sensor at the gaze of the camera.
        exposure_s : float, s

        Returns
        -------
        Picture
            Exact means over the pixels, e-/µm², one channel per filter, without noise and dark signal; NaN outside the image.
            With the white balance and colour correction of captures. With lateral chromatic aberration, the sum of the images
            of all sizes, each on its own cells, as in captures.
        """
        joules_per_w_m2 = float(w_from_w_m2_um2(exposure_s))
        weights = self._sensor.responsivity_e_per_j(light.wavelength_nm) * joules_per_w_m2
        colour, scene = colour_correction(self._sensor, light), self.light_at_gaze(light)
        matrix = None if colour is None else colour.matrix
        shown = partial(replace, grid=grid, white=white_dn(self._sensor, light), colour_matrix=matrix)
        in_image = _moved(grid, self.position_um)
        if isinstance(scene, PowerMap):
            return shown(reference(scene, in_image, weights=weights))
        optics, frame = self._optics.resolve_oversample(scene), self.sensor_frame(scene)
        images = [
            (
                frame.image(source),
                optics.weighted_maps(scene, weights * is_in_image, grid=source, n_threads=self._n_threads),
            )
            for source, is_in_image in optics.image_grids(scene)
        ]
        return shown(sum_of_images(images, in_image, len(weights)))

    def noise_budget(
        self,
        light: Scene | PowerMap,
        *,
        exposure_s: ExposureTime,
    ) -> NoiseBudget:
        """
        Return the noise of every site by source: :func:`foveasim.sensor.noise_budget`.

        Parameters
        ----------
        light, exposure_s
            As for :meth:`capture`.

        Returns
        -------
        NoiseBudget
            Standard deviation by source, a dict of str to (n_site,) float64, e-.
        """
        rate_e_per_s = self.photoelectrons_per_s(light)
        return noise_budget(self._sensor, rate_e_per_s, seconds_of(self, exposure_s, rate_e_per_s))

    def compare_with(
        self,
        frames: OwnCheck[Any],
        target: Literal["slanted_edge", "grey_steps", "colour_chart", "flat_field"],
        *,
        exposure_s: float,
        **options: Any,
    ) -> PictureComparison:
        """Compare real frames with simulated ones; see :func:`foveasim.twin.compare_with`."""
        compare_with = load("twin").compare_with
        return compare_with(self, frames, target, exposure_s=exposure_s, **options)

    def incidence(self, light: Scene | PowerMap) -> Incidence:
        """
        Return the cones of light at the photosites.

        Parameters
        ----------
        light : Scene or PowerMap
            The distance of a scene determines the cones; those of a power map are of a lens in focus.

        Returns
        -------
        Incidence
            With the chief ray and the image height of each site.

        Examples
        --------
        >>> import foveasim as fs
        >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.8, exit_pupil_mm=10.0)
        >>> camera = fs.Camera(
        ...     optics=lens, sensor=fs.Sensor(fs.layout.grid(n_x=2, n_y=1, pitch_um=200.0))
        ... )
        >>> scene = fs.Scene.flat(
        ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
        ... )
        >>> cones = camera.incidence(scene)
        >>> cones.image_height_um.tolist(), cones.chief_ray.tolist()
        ([100.0, 100.0], [[-0.01, 0.0], [0.01, 0.0]])
        """
        return find_incidence(self, self._layout, self.light_at_gaze(light), self.position_um)[0]

    def footprints(self, light: Scene | PowerMap) -> Footprints | None:
        """
        Return the light that the photosites collect through the pixel optics of the sensor.

        Parameters
        ----------
        light : Scene or PowerMap

        Returns
        -------
        Footprints or None
            None for a sensor without ``pixel_optics``.

        Raises
        ------
        ParameterError
            When a site is beyond the table of chief rays.
        GeometryError
            When an inset of the pixel optics is too large for a site.
        """
        return footprints_at(self, self.light_at_gaze(light), self.position_um)

    def angular_response(self, light: Scene | PowerMap) -> Floats:
        """
        Return the response of each site to uniform light through the pixel optics.

        Parameters
        ----------
        light : Scene or PowerMap
            The distance of a scene determines the cone of light.

        Returns
        -------
        response : (n_site,) float64
            Fraction of the power incident on its outline that a site collects, with the light of other sites; 1 without pixel
            optics. Charges divided by it are corrected for the angular response, as by a flat field.

        Examples
        --------
        >>> import foveasim as fs
        >>> stack = fs.sensor.ApertureStack(height_um=4.0, refractive_index=1.5)
        >>> sensor = fs.Sensor(fs.layout.grid(n_x=3, n_y=1, pitch_um=4.0), pixel_optics=stack)
        >>> camera = fs.Camera(
        ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
        ... )
        >>> scene = fs.Scene.flat(
        ...     shape=(64, 64), pitch_um=50.0, distance_m=1.0, illuminance_lux=500.0
        ... )
        >>> camera.angular_response(scene).round(2).tolist()
        [0.9, 0.9, 0.9]
        """
        found = self.footprints(light)
        if found is None:
            return np.ones(self._layout.n_sites)
        if found.mixing is None:
            return np.array(found.response)
        area_um2 = self._layout.area_um2
        return np.asarray(found.response + found.mixing @ area_um2 / area_um2)


def _moved(grid: Grid, by_um: Position) -> Grid:
    """Return a grid at another position."""
    (x_um, y_um), (dx_um, dy_um) = grid.origin_um, by_um
    return Grid(grid.shape, grid.pitch_um, (x_um + dx_um, y_um + dy_um))
