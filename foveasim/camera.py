"""
The camera: a lens and a sensor, joined.

The only place that knows the order of the stages, and that makes random streams.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cached_property
from threading import Lock
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.provenance import to_plain_data, versions
from foveasim._core.random_streams import Streams
from foveasim._core.threads import in_order, thread_count
from foveasim._core.validation import Bools, Floats, check_count, finite_array, read_only
from foveasim.capture import Capture
from foveasim.distortion import Lens
from foveasim.errors import CoverageWarning, FoveasimWarning, ParameterError, SamplingWarning, SimulationError
from foveasim.fields import Grid, PowerMap
from foveasim.integrate import Integrator
from foveasim.layout import Layout
from foveasim.modes import Between, Exposure, Shutter
from foveasim.optics import Optics
from foveasim.reconstruct import Picture, reference
from foveasim.scene import Scene
from foveasim.sensor import Sensor, noise_budget
from foveasim.sensor.limits import check_plausible, check_plausible_array
from foveasim.units import um_from_nm, w_from_w_m2_um2

__all__ = ["Camera", "Light"]

#: A place in the image, (x, y) in µm.
Place = tuple[float, float]
#: A frame of light: a scene or a map, or one with the place in its image where the sensor's middle is put.
Light = Scene | PowerMap | tuple[Scene | PowerMap, Sequence[float]]
#: Maps of light behind each colour filter, on each grid.
KeptImages = dict[tuple[Grid, int], NDArray[Any]]

#: A map made by Fourier transforms may fall below darkness by this fraction of the brightest site: rounding of float32.
NEGATIVE_ROUNDING = 1e-4
#: A filter that passes less than this fraction of the strongest one's light cannot be balanced against it.
DIMMEST_WHITE = 0.01
#: Exposures that outlast the time between them by this share do so by rounding.
TIME_ROUNDING = 1e-9
#: Compiled layouts that a camera keeps, one for each grid it met: those of this many kinds of light.
KEPT_INTEGRATORS = 4
#: Where cells are at most this many λN wide the light is smooth over them, and integration of second order is up to 70 times
#: nearer to the truth; where they are wider than 0.8 it can be further off.
SMOOTH_LAMBDA_N = 0.5


class Camera:
    """
    A lens in front of a sensor.

    Parameters
    ----------
    optics : Optics
    sensor : Sensor
    distortion : lens model of foveasim.distortion, optional
        Displaces the image points of the ideal lens. The outlines of the photosites are undistorted once, and no picture is
        resampled. The optical axis meets the sensor at its ``centre_um``: the ideal image, relative illumination and field
        positions of a scene are all centred there, as in OpenCV's ``projectPoints``. Where its ``focal_um`` differs between x
        and y, the ideal image is scaled alike, keeping its area.
    order : {1, 2}, optional
        Whether a map's cells are taken as even, or as means with a gradient (see :class:`foveasim.Integrator`). By default 2
        for scenes whose image has cells of at most λN/2 at all wavelengths, and 1 for coarser ones and for power maps.
    n_threads : int, optional
        All cores of the process by default. Results do not depend on it, bit for bit.

    Raises
    ------
    ParameterError
        When an argument is none of the above.

    Warns
    -----
    CoverageWarning
        On a capture, when photosites lie off the image, or where the lens sends no light.
    SamplingWarning
        On a capture, when second-order integration of a sharp image on coarse cells makes photosites negative.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0)
    >>> camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout))
    >>> scene = fs.Scene.flat(
    ...     shape=(200, 200), pitch_um=10.0, distance_m=0.5, radiance_w_m2_sr_nm=0.1, band_width_nm=10.0
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
        n_threads: int | None = None,
    ) -> None:
        for name, part, kind in (("optics", optics, Optics), ("sensor", sensor, Sensor)):
            if not isinstance(part, kind):
                raise ParameterError(name, f"must be a foveasim.{kind.__name__}, got a {type(part).__name__}")
        if not isinstance(sensor.layout, Layout):
            raise ParameterError("sensor", f"must have a foveasim.Layout, got a {type(sensor.layout).__name__}")
        if distortion is not None and not isinstance(distortion, Lens):
            raise ParameterError(
                "distortion",
                f"must be a lens model with distort, undistort, focal_um and centre_um, got a {type(distortion).__name__}",
            )
        self._optics = optics
        self._sensor = sensor
        self._distortion = distortion
        self._order: Literal[1, 2] | None = order
        if order is not None:
            self._order = 2 if check_count("order", order, at_most=2) == 2 else 1
        self._layout = sensor.layout
        self._n_threads = thread_count(n_threads)
        self._integrators: dict[tuple[Grid, int, Place], Integrator] = {}

    def __repr__(self) -> str:
        return f"Camera({self._optics!r}, {self._sensor!r})"

    @property
    def optics(self) -> Optics:
        """The lens. For another one make another camera."""
        return self._optics

    @property
    def sensor(self) -> Sensor:
        """The sensor. For another one make another camera."""
        return self._sensor

    @property
    def distortion(self) -> Lens | None:
        """Where the lens puts light that an ideal one would put elsewhere, or None. For another one make another camera."""
        return self._distortion

    def oversample(self, light: Scene | PowerMap) -> int:
        """Cells of the power map along a side of a source pixel: as :class:`Optics` specifies or chooses; 1 for power maps."""
        return 1 if isinstance(light, PowerMap) else int(self._optics.resolved(light).oversample)

    def order(self, light: Scene | PowerMap) -> Literal[1, 2]:
        """Order of the integration of a kind of light."""
        if self._order is not None:
            return self._order
        if isinstance(light, PowerMap):
            return 1
        narrowest_um = float(um_from_nm(light.wavelength_nm.min())) * self._optics.working_f_number(light.distance_m)
        cell_um = self._optics.grid(light).pitch_x_um / self.oversample(light)
        return 2 if cell_um <= SMOOTH_LAMBDA_N * narrowest_um else 1

    def image_grid(self, scene: Scene) -> Grid:
        """
        Return the grid on which the pixels of a scene are imaged without distortion, in the sensor frame.

        Parameters
        ----------
        scene : Scene

        Returns
        -------
        Grid
            :meth:`Optics.grid`, centred on the principal point of the distortion model.

        Raises
        ------
        ParameterError
            When the scene is not a Scene, or nearer than the focal length.
        """
        return self._placed(self._optics.grid(scene))

    def power_map(self, scene: Scene) -> PowerMap:
        """
        Compute the irradiance of a scene on the sensor plane without distortion, in the sensor frame.

        Parameters
        ----------
        scene : Scene

        Returns
        -------
        PowerMap
            (n_wavelength, n_y, n_x): :meth:`Optics.power_map` with :meth:`oversample` cells along a source pixel, centred on
            the principal point of the distortion model. Capturing it gives the capture of the scene at the same ``order``.

        Raises
        ------
        ParameterError, SimulationError
            When the scene is too near, or not finite.
        """
        power_map = self._optics.resolved(scene).power_map(scene, n_threads=self._n_threads)
        return PowerMap(power_map.data, self._placed(power_map.grid), power_map.wavelength_nm)

    def _placed(self, grid: Grid) -> Grid:
        """Move a grid from the frame of the lens, centred on the axis, to the frame of the sensor."""
        if self._distortion is None:
            return grid
        centre_um = np.array(self._distortion.centre_um)
        focal_um = np.broadcast_to(np.asarray(self._distortion.focal_um), (2,))
        scale = focal_um / math.sqrt(focal_um[0] * focal_um[1])
        pitch_x_um, pitch_y_um = grid.pitch_xy_um * scale
        x0_um, y0_um = centre_um + grid.origin_um * scale
        return Grid(grid.shape, (float(pitch_x_um), float(pitch_y_um)), (float(x0_um), float(y0_um)))

    def integrator(
        self,
        grid: Grid,
        *,
        order: Literal[1, 2] = 1,
        n_grids: int = 1,
        place_um: Place = (0.0, 0.0),
    ) -> Integrator:
        """
        The sensor's layout compiled for a grid, with its middle at a place in the image, µm.

        Kept for the grids used last, of which ``n_grids`` are used together.
        """
        key = grid, order, place_um
        integrator = self._integrators.get(key)
        if integrator is None:
            layout = self._layout.translate(*place_um) if any(place_um) else self._layout
            integrator = Integrator(layout, grid, distortion=self._distortion, order=order, n_threads=self._n_threads)
        # One that is in its place already is left there: frames that are computed together find it.
        if next(reversed(self._integrators), None) != key:
            self._integrators.pop(key, None)
            self._integrators[key] = integrator
        while len(self._integrators) > KEPT_INTEGRATORS * n_grids:
            self._integrators.pop(next(iter(self._integrators)), None)
        return integrator

    def replace(self, *, optics: Optics | None = None, sensor: Sensor | None = None) -> Camera:
        """
        A camera with another lens, another sensor, or both.

        Layouts that were compiled for grids are shared where the new sensor has the same layout: the same object, not its like.

        Raises
        ------
        ParameterError
            When an argument is none of the above.
        """
        other = Camera(
            optics=self._optics if optics is None else optics,
            sensor=self._sensor if sensor is None else sensor,
            distortion=self._distortion,
            order=self._order,
            n_threads=self._n_threads,
        )
        if other._layout is self._layout:
            other._integrators = self._integrators
        return other

    def photoelectrons_per_s(self, light: Scene | PowerMap, *, images: KeptImages | None = None) -> Floats:
        """
        Expected photoelectrons of every site in a second, (n_site,) e-/s.

        Parameters
        ----------
        light : Scene or PowerMap
            A scene to be imaged, or a map that any other optics program made.
        images : dict, optional
            The scene's images are put in it, and taken from it where they are there: for other layouts with the same lens,
            scene and colour filters.

        Raises
        ------
        ParameterError
            When the light is neither, or a wavelength outside the sensor's tables.
        SimulationError
            When the map is not finite under a site.
        """
        return self._photoelectrons_per_s(light, _Clock(), kept=images)

    def capture(
        self,
        light: Scene | PowerMap,
        *,
        exposure_s: float,
        seed: int,
        frame: int = 0,
        photo_e_per_s: Floats | None = None,
    ) -> Capture:
        """
        One exposure.

        Parameters
        ----------
        light : Scene or PowerMap
            A scene to be imaged, or a map that any other optics program made.
        exposure_s : float, s
        seed, frame : int
            Of the noise. The same numbers give the same capture, bit for bit.
        photo_e_per_s : (n_site,) float64, optional, e-/s
            What :meth:`photoelectrons_per_s` gave for this light, where it is known: nothing of it is computed again.

        Returns
        -------
        Capture

        Raises
        ------
        ParameterError, SimulationError
            When a value is out of range, or parts do not fit together.
        """
        streams = Streams(seed, frame)
        exposure_s = check_plausible("exposure_s", exposure_s)
        clock = _Clock()
        if photo_e_per_s is None:
            photo_e_per_s = self._photoelectrons_per_s(light, clock)
        else:
            photo_e_per_s = finite_array("photo_e_per_s", photo_e_per_s, ndim=1, at_least=0.0)
            if photo_e_per_s.size != self._layout.n_sites:
                raise ParameterError(
                    "photo_e_per_s", f"must be {self._layout.n_sites} numbers, one per site, got {photo_e_per_s.size}"
                )
        return self._exposed(light, photo_e_per_s, exposure_s, streams, clock)

    def _exposed(
        self,
        light: Scene | PowerMap,
        photo_e_per_s: Floats,
        exposure_s: float,
        streams: Streams,
        clock: _Clock,
        **settings: Any,
    ) -> Capture:
        """What the sensor makes of the light on its sites."""
        sensor = self._sensor
        with clock.stage("sensor"):
            expected_e = sensor.expected_electrons(photo_e_per_s, exposure_s)
            electrons = sensor.collect(expected_e, streams=streams, n_threads=self._n_threads)
            code = sensor.read(electrons, streams=streams, n_threads=self._n_threads)
        return Capture(
            layout=self._layout,
            code=read_only(code),
            electrons=read_only(electrons),
            expected_e=read_only(expected_e),
            filter_of_site=read_only(sensor.filter_of_site),
            filter_names=sensor.filter_names,
            bits=sensor.bits,
            white_dn=self._white(light),
            settings={
                "light": _light_described(light),
                **self._described,
                "oversample": self.oversample(light),
                "integration_order": self.order(light),
                "exposure_s": exposure_s,
                "seed": streams.seed,
                "frame": streams.frame,
                "versions": versions(),
                **settings,
            },
            stage_s=clock.stage_s,
        )

    @cached_property
    def _described(self) -> dict[str, Any]:
        """What all captures of the camera have in common, as plain data."""
        return {
            "optics": to_plain_data(self._optics),
            "distortion": None if self._distortion is None else to_plain_data(self._distortion),
            "sensor": {k: v for k, v in to_plain_data(self._sensor).items() if k != "layout"},
            "layout": to_plain_data(dict(self._layout.provenance)),
        }

    def rates(self, frames: Iterable[Light], *, ahead: int = 0) -> Iterator[Floats]:
        """
        Expected photoelectrons of every site in a second, frame by frame: what the modes of acquisition take.

        Parameters
        ----------
        frames : iterable of Scene or PowerMap, or of pairs with a place (x_um, y_um)
        ahead : int
            As for :meth:`video`.

        Yields
        ------
        photo_e_per_s : (n_site,) float64, e-/s
            As :meth:`photoelectrons_per_s` gives it; read-only, since a frame that comes again gives the same array again.

        Raises
        ------
        ParameterError, SimulationError
            At once, when an argument is out of range; as for :meth:`capture`, when the frame comes.
        """
        _check_frames(frames)
        ahead = check_count("ahead", ahead, at_least=0)
        return (rate_e_per_s for *_, rate_e_per_s in self._lit(frames, _Clock(), ahead))

    def video(
        self,
        frames: Iterable[Light],
        *,
        exposure_s: float | Sequence[float],
        seed: int,
        first_frame: int = 0,
        frame_s: float | None = None,
        line_s: float = 0.0,
        every: int = 1,
        between: Between = "hold",
        ahead: int = 0,
    ) -> Iterator[Capture]:
        """
        One capture after the other, each made when it is asked for.

        Parameters
        ----------
        frames : iterable of Scene or PowerMap, or of pairs with a place (x_um, y_um)
            The light, frame by frame. With a place, the sensor's middle is put there in the image behind the lens: a gaze that
            moves. See :mod:`foveasim.video` for frames from pictures and video files, and for paths of gazes.
        exposure_s : float, or one after the other, s
            Of a sequence the captures take one each, over and over, as their numbers say: a bracket.
        seed : int
            Of the noise; fixed patterns are the device's and stay.
        first_frame : int
            Number of the first capture: capture k has the noise of ``capture(..., frame=first_frame + k)``. A video is gone on
            with from light number ``first_frame * every`` on.
        frame_s : float, optional, s
            From one frame of light to the next. Without it every frame lights one capture and no other.
        line_s : float, s
            Rolling shutter: a site begins ``readout_order * line_s`` after the first. Needs ``frame_s``.
        every : int
            Number of frames of light from one capture to the next.
        between : {"hold", "linear"}
            What light does between frames: it holds until the next, or goes over into it in a straight line.
        ahead : int
            Frames that are computed before they are asked for, each by one thread, which is faster than all threads on one
            frame. For frames that do not depend on the captures before.

        Yields
        ------
        Capture

        Raises
        ------
        ParameterError, SimulationError
            At once, when an argument is out of range; as for :meth:`capture`, when the frame comes.

        Warns
        -----
        FoveasimWarning
            When an exposure outlasts the time to the begin of the next one: no photosite can be in both.

        Notes
        -----
        Memory holds one frame of irradiance, or ``ahead`` of them, and a few numbers per site for each exposure in progress.
        The layout is compiled once.
        The same object again is the same light: its image is not computed again, wherever the gaze goes. A place moves the
        photosites' outlines, so that shifts of any part of a cell are exact; the layout is compiled for each new place.

        With ``frame_s`` a capture has the light of all frames that its exposure covers, each weighted by its time; the last
        frame's light stays until the last exposure is over.

        Examples
        --------
        >>> import foveasim as fs
        >>> layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0)
        >>> camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout))
        >>> scene = fs.Scene.flat(
        ...     shape=(200, 200), pitch_um=10.0, distance_m=0.5, radiance_w_m2_sr_nm=0.1, band_width_nm=10.0
        ... )
        >>> [c.settings["frame"] for c in camera.video([scene, scene], exposure_s=0.01, seed=0)]
        [0, 1]
        """
        exposures_s = check_plausible_array("exposure_s", exposure_s)
        if exposures_s.ndim > 1 or exposures_s.size == 0:
            raise ParameterError("exposure_s", "must be one time, or a sequence of times", exposure_s, "s")
        exposures_s = np.atleast_1d(exposures_s)
        _check_frames(frames)
        if frame_s is None and (line_s or between != "hold" or every != 1):
            name = "line_s" if line_s else "between" if between != "hold" else "every"
            raise ParameterError(name, "needs 'frame_s', the time from one frame of light to the next")
        streams = Streams(seed, first_frame)
        every, ahead = check_count("every", every), check_count("ahead", ahead, at_least=0)
        if frame_s is None:
            return self._still(frames, exposures_s, streams, ahead)
        shutter = Shutter(self._layout, frame_s, line_s, between)
        if exposures_s.max() > (1.0 + TIME_ROUNDING) * every * shutter.frame_s:
            warnings.warn(
                f"an exposure of {exposures_s.max():g} s outlasts the {every * shutter.frame_s:g} s to the next one's begin, "
                "and no photosite can collect the same light for both: take a shorter 'exposure_s', or a larger 'every'",
                FoveasimWarning,
                stacklevel=2,
            )
        return self._rolling(frames, exposures_s, streams, shutter, every, ahead)

    def _still(self, frames: Iterable[Light], exposures_s: Floats, streams: Streams, ahead: int) -> Iterator[Capture]:
        """A capture for every frame, which is all that lights it."""
        clock = _Clock()
        for k, (light, place_um, rate_e_per_s) in enumerate(self._lit(frames, clock, ahead)):
            number = Streams(streams.seed, streams.frame + k)
            exposure_s = float(exposures_s[number.frame % exposures_s.size])
            yield self._exposed(light, rate_e_per_s, exposure_s, number, clock.so_far(), **_place_settings(place_um))

    def _rolling(
        self, frames: Iterable[Light], exposures_s: Floats, streams: Streams, shutter: Shutter, every: int, ahead: int
    ) -> Iterator[Capture]:
        """A capture for every so many frames, lit by all those that its exposure covers."""
        times = {"frame_s": shutter.frame_s, "line_s": shutter.line_s, "every": every, "between": shutter.between}
        going_on: deque[tuple[int, Scene | PowerMap, Place, Exposure]] = deque()
        clock = _Clock()

        def first(last_e_per_s: Floats) -> Capture:
            k, light, place_um, exposure = going_on.popleft()
            number = Streams(streams.seed, streams.frame + k)
            mean_e_per_s, told = exposure.mean_e_per_s(last_e_per_s), times | _place_settings(place_um)
            return self._exposed(light, mean_e_per_s, exposure.exposure_s, number, clock.so_far(), **told)

        rate_e_per_s = np.zeros(1)
        for n, (light, place_um, rate_e_per_s) in enumerate(self._lit(frames, clock, ahead)):
            if n % every == 0:
                k = n // every
                exposure_s = float(exposures_s[(streams.frame + k) % exposures_s.size])
                going_on.append((k, light, place_um, Exposure(shutter, exposure_s)))
            with clock.stage("shutter"):
                for *_, exposure in going_on:
                    exposure.add(rate_e_per_s)
            while going_on and going_on[0][-1].is_complete:
                yield first(rate_e_per_s)
        while going_on:
            yield first(rate_e_per_s)

    def _lit(
        self, frames: Iterable[Light], clock: _Clock, ahead: int
    ) -> Iterator[tuple[Scene | PowerMap, Place, Floats]]:
        """Every frame's light, the sensor's place, and the light on the sites; what frames have in common is computed once."""
        alone = self
        if ahead:
            alone = Camera(
                optics=self._optics, sensor=self._sensor, distortion=self._distortion, order=self._order, n_threads=1
            )
        making = Lock()

        def lit(task: _Task) -> tuple[_Task, Floats | None, _Clock]:
            own = _Clock()
            if task.is_repeated:
                return task, None, own
            # Who comes first makes the images that the next frames of the same light take.
            with making if task.images == {} else nullcontext():
                return task, alone._photoelectrons_per_s(task.light, own, task.place_um, task.images), own

        rate_e_per_s = np.zeros(self._layout.n_sites)
        for task, found, own in in_order(lit, _tasks(frames), self._n_threads, ahead):
            # Who gets it twice must find it as it was.
            rate_e_per_s = rate_e_per_s if found is None else read_only(found)
            clock.add(own)
            yield task.light, task.place_um, rate_e_per_s

    def predict(self, light: Scene | PowerMap, *, exposure_s: float) -> tuple[Floats, Floats]:
        """
        Mean and variance of every site's code over all noise, without a draw.

        Parameters
        ----------
        light : Scene or PowerMap
        exposure_s : float, s

        Returns
        -------
        mean_dn, variance_dn2 : (n_site,) float64, DN and DN²
            Of this device: its fixed patterns are in the mean.

        Raises
        ------
        ParameterError, SimulationError
            As for :meth:`capture`.
        """
        expected_e = self._sensor.expected_electrons(self._photoelectrons_per_s(light, _Clock()), exposure_s)
        return self._sensor.predict(expected_e, n_threads=self._n_threads)

    def reference(self, light: Scene | PowerMap, grid: Grid, *, exposure_s: float) -> Picture:
        """
        The picture that a perfect sensor with a raster's pixels would take: what reconstructions are compared with.

        Parameters
        ----------
        light : Scene or PowerMap
        grid : Grid
            The raster, in the plane of the lens without distortion.
        exposure_s : float, s

        Returns
        -------
        Picture
            Photoelectrons per µm² behind each of the sensor's filters, of the light behind the lens, without noise and dark
            charge: exact means over the pixels. NaN off the image.

        Raises
        ------
        ParameterError, SimulationError
            As for :meth:`capture`.
        """
        exposure_s = check_plausible("exposure_s", exposure_s)
        if not isinstance(light, Scene | PowerMap):
            raise ParameterError("light", f"must be a Scene or a PowerMap, got a {type(light).__name__}")
        power_map = self.power_map(light) if isinstance(light, Scene) else light
        # Joules on a µm².
        joules_per_w_m2 = float(w_from_w_m2_um2(exposure_s))
        weights = self._sensor.responsivity_e_per_j(light.wavelength_nm) * joules_per_w_m2
        return reference(power_map, grid, weights=weights)

    def noise_budget(self, light: Scene | PowerMap, *, exposure_s: float) -> dict[str, Floats]:
        """
        Noise of every site by source, (n_site,) e- each: :func:`foveasim.sensor.noise_budget` for what the camera sees.

        Parameters
        ----------
        light : Scene or PowerMap
        exposure_s : float, s

        Raises
        ------
        ParameterError, SimulationError
            As for :meth:`capture`.
        """
        return noise_budget(self._sensor, self._photoelectrons_per_s(light, _Clock()), exposure_s)

    def _photoelectrons_per_s(
        self,
        light: Scene | PowerMap,
        clock: _Clock,
        place_um: Place = (0.0, 0.0),
        kept: KeptImages | None = None,
    ) -> Floats:
        """
        One inverse transform and one pass over the map for each colour filter, whatever the number of wavelengths.

        Lateral colour makes images of several sizes, each with its own grid, and the same for each of them. The images of a
        scene are put in ``kept``, and taken from there when they are in it.
        """
        if not isinstance(light, Scene | PowerMap):
            raise ParameterError("light", f"must be a Scene or a PowerMap, got a {type(light).__name__}")
        filter_of_site = self._sensor.filter_of_site
        weights = self._sensor.responsivity_e_per_j(light.wavelength_nm)
        with clock.stage("load kernels"):
            _load_kernels(light)
        if isinstance(light, PowerMap):
            optics, grids = self._optics, [(light.grid, np.ones(light.wavelength_nm.size, bool))]
        else:
            optics = self._optics.resolved(light)
            grids = optics.image_grids(light)
        with clock.stage("compile layout"):
            order = self.order(light)
            placed = [grid if isinstance(light, PowerMap) else self._placed(grid) for grid, _ in grids]
            integrators = [self.integrator(grid, order=order, n_grids=len(grids), place_um=place_um) for grid in placed]
        self._warn_of_uncovered(min(integrators, key=lambda integrator: integrator.grid.cell_area_um2))
        rate_e_per_s = np.zeros(self._layout.n_sites)
        if isinstance(light, PowerMap):
            integrator = integrators[0]
            with clock.stage("integration"):
                for band, cells in enumerate(light.data):
                    rate_e_per_s += weights[filter_of_site, band] * w_from_w_m2_um2(integrator(cells))
        else:
            used = np.unique(filter_of_site)
            for (grid, is_on_it), integrator in zip(grids, integrators, strict=True):
                new = used if kept is None else np.array([c for c in used if (grid, c) not in kept], np.int64)
                maps = optics.weighted_maps(light, weights[new] * is_on_it, grid=grid, n_threads=self._n_threads)
                for c in used:
                    with clock.stage("optics"):
                        cells = next(maps) if kept is None or (grid, c) not in kept else kept[grid, c]
                        if kept is not None:
                            kept[grid, c] = cells
                    with clock.stage("integration"):
                        rates = w_from_w_m2_um2(integrator(cells))
                        del cells
                    rate_e_per_s += np.where(filter_of_site == c, rates, 0.0)
        if not np.isfinite(rate_e_per_s).all():
            bad = int(np.flatnonzero(~np.isfinite(rate_e_per_s))[0])
            raise SimulationError(
                f"the light on site {bad} is not finite: the power map has a NaN or an infinity there"
            )
        # Transforms leave rates below 0 by rounding, second order where cells are coarse; a map from elsewhere may be negative.
        is_negative = rate_e_per_s < -NEGATIVE_ROUNDING * float(rate_e_per_s.max(initial=0.0))
        if is_negative.any():
            if isinstance(light, PowerMap) and (order == 1 or np.nanmin(light.data) < 0.0):
                bad = int(rate_e_per_s.argmin())
                raise SimulationError(f"the light on site {bad} is negative: the power map is below 0 there")
            if order == 2:
                self._warn_of_negative(rate_e_per_s, is_negative)
        return np.maximum(rate_e_per_s, 0.0)

    def _warn_of_negative(self, rate_e_per_s: Floats, is_negative: Bools) -> None:
        """Warn where gradients of coarse cells make photosites negative."""
        fraction = -float(rate_e_per_s[is_negative].sum()) / float(np.abs(rate_e_per_s).sum())
        warnings.warn(
            f"second-order integration makes the photoelectrons of {int(is_negative.sum()):,} of {rate_e_per_s.size:,} "
            f"photosites negative, {100.0 * fraction:.3g} % of all, and they are set to 0: the image is too sharp for cells of "
            "this size; take order=1, or finer cells (Optics(oversample=...))",
            SamplingWarning,
            stacklevel=4,
        )

    def _warn_of_uncovered(self, integrator: Integrator) -> None:
        """Tell of sites that the map of light does not reach: their darkness is no property of the scene."""
        n_lost = integrator.sites_outside_image_circle.size
        if n_lost:
            warnings.warn(
                f"{n_lost:,} of {self._layout.n_sites:,} photosites lie outside the lens's image circle and get no light: "
                "shrink or move the layout, or take a lens model that reaches further",
                CoverageWarning,
                stacklevel=4,
            )
        n_uncovered = int(np.count_nonzero(integrator.uncovered_um2)) - n_lost
        if n_uncovered:
            x_min, y_min, x_max, y_max = integrator.grid.bounds_um
            left, bottom, right, top = self._layout.bounds_um
            warnings.warn(
                f"{n_uncovered:,} of {self._layout.n_sites:,} photosites lie partly or wholly off the image and get less light "
                f"or none: the image reaches from ({x_min:.4g}, {y_min:.4g}) to ({x_max:.4g}, {y_max:.4g}) µm, the layout "
                f"from ({left:.4g}, {bottom:.4g}) to ({right:.4g}, {top:.4g}) µm; enlarge the scene (pitch_um), or shrink or "
                "move the layout",
                CoverageWarning,
                stacklevel=4,
            )

    def _white(self, light: Scene | PowerMap) -> Floats:
        """Response of every filter to equal light in all bands, the strongest being the highest code."""
        width_nm = light.band_width_nm if isinstance(light, Scene) else np.ones(light.wavelength_nm.size)
        response = self._sensor.responsivity_e_per_j(light.wavelength_nm) @ width_nm
        highest = float(response.max(initial=0.0))
        if highest == 0.0:
            return np.ones(response.size)
        return np.maximum(response / highest, DIMMEST_WHITE) * (2**self._sensor.bits - 1)


class _Clock:
    """Adds up the seconds of named stages."""

    def __init__(self) -> None:
        self.stage_s: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start_s = time.perf_counter()
        yield
        self.stage_s[name] = self.stage_s.get(name, 0.0) + time.perf_counter() - start_s

    def add(self, other: _Clock) -> None:
        """Add another's seconds."""
        for name, s in other.stage_s.items():
            self.stage_s[name] = self.stage_s.get(name, 0.0) + s

    def so_far(self) -> _Clock:
        """What was added up since this was last asked."""
        before = _Clock()
        before.stage_s, self.stage_s = self.stage_s, {}
        return before


class _Task(NamedTuple):
    """One frame of a video: its light, the sensor's place, where its images are kept, and whether nothing changed."""

    light: Scene | PowerMap
    place_um: Place
    images: KeptImages | None
    is_repeated: bool


def _tasks(frames: Iterable[Light]) -> Iterator[_Task]:
    """The frames, with what each has in common with the one before: frames with places share the images of their light."""
    before: _Task | None = None
    for frame in frames:
        light, place_um = _parts(frame)
        is_same = before is not None and light is before.light
        images: KeptImages | None = None
        if isinstance(frame, tuple) and isinstance(light, Scene):
            is_kept = before is not None and is_same and before.images is not None
            images = before.images if before is not None and is_kept else {}
        is_repeated = before is not None and is_same and place_um == before.place_um
        before = _Task(light, place_um, images, is_repeated)
        yield before


def _check_frames(frames: object) -> None:
    if not isinstance(frames, Iterable):
        hint = "put one into a list" if isinstance(frames, Scene | PowerMap) else ""
        raise ParameterError(
            "frames", f"must be an iterable of Scenes or PowerMaps, got a {type(frames).__name__}", hint=hint
        )


def _place_settings(place_um: Place) -> dict[str, Any]:
    """What a capture's settings tell of its place."""
    return {"place_um": list(place_um)} if any(place_um) else {}


def _parts(frame: Light) -> tuple[Scene | PowerMap, Place]:
    """Light, and the place of the sensor's middle in its image."""
    if not isinstance(frame, tuple):
        return frame, (0.0, 0.0)
    place_um = finite_array("frames", frame[1], ndim=1) if len(frame) == 2 else np.zeros(0)
    if place_um.size != 2:
        raise ParameterError("frames", "must be Scenes or PowerMaps, or pairs (light, (x_um, y_um))", frame)
    return frame[0], (float(place_um[0]), float(place_um[1]))


def _light_described(light: Scene | PowerMap) -> dict[str, object]:
    if isinstance(light, PowerMap):
        return {"kind": "PowerMap", "grid": to_plain_data(light.grid), "wavelength_nm": light.wavelength_nm.tolist()}
    return {
        "kind": "Scene",
        "source": light.source,
        "shape": list(light.basis.shape),
        "pitch_um": light.pitch_um,
        "distance_m": light.distance_m,
        "wavelength_nm": light.wavelength_nm.tolist(),
        "band_width_nm": light.band_width_nm.tolist(),
        "spectrum_w_m2_sr_nm": to_plain_data(light.spectrum_w_m2_sr_nm),
    }


def _load_kernels(light: Scene | PowerMap) -> None:
    """Import the kernels that images of this light need, so that their compilation is not timed with other work."""
    import foveasim.integrate._kernels

    if isinstance(light, Scene):
        import foveasim.optics._kernels  # noqa: F401
