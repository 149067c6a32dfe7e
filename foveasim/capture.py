"""Captures: results of one exposure, with the settings that reproduce it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import OwnCheck, publish
from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._core.provenance import copy_plain_data, to_plain_data
from foveasim._core.rings import same_rings
from foveasim._core.show import ViewMethod, view_method
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, Ints, check_count, frozen_array, read_only, unit_of, unmasked
from foveasim._io.atomic import atomic_directory
from foveasim._io.npz import open_archive, write_archive
from foveasim._io.zarr_stores import ZARR, Variable, free_names, open_store, store_format, write_variables
from foveasim.columns import COLUMNS, STORED, column_info, compute_column, find_column
from foveasim.distortion import LENSES, BrownConrady, Fisheye
from foveasim.errors import FileError, ParameterError
from foveasim.fields import Grid
from foveasim.layout.model import Layout
from foveasim.layout.packed import layout_from_arrays, layout_to_arrays
from foveasim.reconstruct import (
    ColourCorrection,
    CorticalImage,
    Picture,
    cells,
    cortical,
    electrons_per_code,
    estimate_from_charge,
    estimate_from_code,
    fill_channels,
    least_squares,
    linear,
    natural,
    raster_grid,
    to_cortical,
)
from foveasim.reconstruct.picture import PIXELS, Gaps
from foveasim.reconstruct.unwrap import FIELD, ViewProjection, unwrap
from foveasim.sensor import Sensor, signal_to_noise
from foveasim.units import m_from_mm, um_from_m

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from pyvista import PolyData  # noqa: TID251 -- a type alone

__all__ = ["Capture"]

FILE_FORMAT = "foveasim capture"
FILE_VERSION = 1
#: Functions of :mod:`foveasim.reconstruct`, and the values that they reconstruct.
Method = Literal["cells", "linear", "natural", "least_squares"]
Quantity = Literal["code", "electrons", "expected_e", "light_e"]
#: Names of variables that are derived from the layout, and of the dimensions' coordinates.
DERIVED = ("x_um", "y_um", "area_um2", "filter_name")
SITE, FILTER = "site", "filter"
#: Groups of a store with the outlines, and with the arrays of the sensor.
LAYOUT_GROUP, SENSOR_GROUP = "layout", "sensor"


@dataclass(frozen=True, eq=False)
class Capture:
    """
    Result of one exposure.

    Attributes
    ----------
    layout : Layout
        The photosites.
    code : (n_site,) uint8 or uint16, DN
        Digital values, as a camera delivers them. Differences of unsigned integers wrap around below 0: 3 - 5 is 65,534. Use
        :attr:`code_dn` to subtract dark frames or other captures.
    electrons : (n_site,) int64, e-
        Collected charge, with shot noise, clipped at the full well capacity.
    expected_e : (n_site,) float64, e-
        Expected charge.
    filter_of_site : (n_site,) signed integers
        Index of each site's colour filter.
    filter_names : tuple of str
    bits : int
        Bit depth of the codes: the highest is ``2**bits - 1``.
    white_dn : (n_filter,) float64, DN
        Code of a spectrum of equal radiance in all bands, up to a common factor, for white balance.
    settings : mapping
        Plain data: optics, sensor, layout, scene, exposure, seed, frame, versions.
    stage_s : mapping of str to float
        Elapsed seconds of each stage, with those of kernels that are compiled in it; not saved.
    electronics : Sensor, optional
        The sensor, whose noise and response the methods use. None for captures that were read from a file: the methods then
        create it from ``settings`` and ``sensor_arrays``.
    sensor_arrays : mapping of str to array
        Parameters of the sensor with more than 64 values, such as those per site, by their SHA-256 in ``settings``.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> sensor = fs.Sensor.from_preset(
    ...     fs.layout.grid(n_x=16, n_y=16, pitch_um=3.45), "machine_vision"
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> capture = camera.capture(scene, exposure_s="auto", seed=0)
    >>> (
    ...     capture.code.shape,
    ...     capture.electrons.dtype,
    ...     bool(0.6 < capture.code.mean() / 4095 < 0.8),
    ... )
    ((256,), dtype('int64'), True)
    """

    layout: Layout
    code: NDArray[Any]
    electrons: Ints
    expected_e: Floats
    filter_of_site: Ints
    filter_names: tuple[str, ...]
    bits: int
    white_dn: Floats
    settings: Mapping[str, Any]
    stage_s: Mapping[str, float] = field(default_factory=dict)
    electronics: Sensor | None = None
    sensor_arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n_filters = len(self.filter_names)
        max_code = 2 ** check_count("bits", self.bits, at_least=1, at_most=16) - 1
        limits = {"code": max_code, "filter_of_site": n_filters - 1}
        shapes = {
            **{name: (self.layout.n_sites, info.dtype) for name, info in STORED.items()},
            "white_dn": (n_filters, "f8"),
        }
        for name, (n, dtype) in shapes.items():
            shape, limit = (n,), limits.get(name)
            values = np.asarray(unmasked(name, getattr(self, name)))
            if values.shape != shape or values.dtype.kind != dtype[0]:
                raise ParameterError(
                    name, f"must be numbers of the shape {shape}, got {values.dtype} of {values.shape}"
                )
            # NaN fails the comparisons.
            smallest, largest = (values.min(), values.max()) if values.size else (0, 0)
            if not (smallest >= 0 and largest < np.inf):
                raise ParameterError(name, "must be finite and >= 0 everywhere")
            if limit is not None and largest > limit:
                raise ParameterError(name, f"must be <= {limit} everywhere", int(largest))
            object.__setattr__(self, name, frozen_array(values))
        # Captures of one camera share settings; a copy lets users edit those of one.
        object.__setattr__(self, "settings", copy_plain_data(self.settings))
        object.__setattr__(self, "stage_s", dict(self.stage_s))
        if self.electronics is not None and not same_rings(self.electronics.layout, self.layout):
            object.__setattr__(self, "electronics", None)  # a copy with other sites

    def __repr__(self) -> str:
        return (
            f"Capture({self.layout.n_sites} sites, {self.bits} bits, {100 * self.saturated_fraction:.1f} % saturated)"
        )

    def column(self, name: str, *, sensor: Sensor | None = None) -> NDArray[Any]:
        """
        Return a column of the photosites.

        Parameters
        ----------
        name : str
            An array of the capture, a column of the layout, ``"area_um2"``, ``"size_um"``, ``"channel"``, ``"readout_line"``,
            or a column in :data:`foveasim.columns.COLUMNS`, such as ``"snr"``.
        sensor : Sensor, optional
            As for :meth:`picture`.

        Returns
        -------
        values : (n_site,) array

        Raises
        ------
        ParameterError
            When the column does not exist, or requires parameters of the sensor that are not known.
        SimulationError
            When the function of the column does not return one value per site.

        Examples
        --------
        >>> import foveasim as fs
        >>> sensor = fs.Sensor.from_preset(
        ...     fs.layout.grid(n_x=16, n_y=16, pitch_um=3.45), "machine_vision"
        ... )
        >>> camera = fs.Camera(
        ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
        ... )
        >>> scene = fs.Scene.flat(
        ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
        ... )
        >>> capture = camera.capture(scene, exposure_s="auto", seed=0)
        >>> capture.column("snr").shape, capture.column("expected_dn").dtype
        ((256,), dtype('float64'))
        """
        self._check_sensor(sensor)
        return find_column("name", name, self.layout, self, sensor)[0]

    @property
    def code_dn(self) -> NDArray[np.int32]:
        """
        Codes as signed integers, (n_site,) int32, DN: differences may be negative.

        Examples
        --------
        >>> import foveasim as fs
        >>> sensor = fs.Sensor.from_preset(
        ...     fs.layout.grid(n_x=16, n_y=16, pitch_um=3.45), "machine_vision"
        ... )
        >>> camera = fs.Camera(
        ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
        ... )
        >>> scene = fs.Scene.flat(
        ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
        ... )
        >>> first, second = (
        ...     camera.capture(scene, exposure_s=1e-3, seed=seed) for seed in (0, 1)
        ... )
        >>> difference_dn = first.code_dn - second.code_dn
        >>> bool(difference_dn.min() < 0)
        True
        """
        return read_only(self.code.astype(np.int32))

    @property
    def saturated_fraction(self) -> float:
        """Fraction of the sites with the highest code."""
        return float(np.mean(self.code == 2**self.bits - 1)) if self.code.size else 0.0

    def picture(
        self,
        method: Method = "cells",
        *,
        max_pixels: Annotated[int, PIXELS] = 1024,
        grid: Grid | None = None,
        of: Quantity = "code",
        per: Literal["site", "um2"] = "site",
        gaps: Gaps = "fill",
        colour: Literal["corrected", "raw"] | None = None,
        sensor: Sensor | None = None,
        projection: ViewProjection | None = None,
        field_of_view_deg: Annotated[float | None, FIELD] = None,
        towards_deg: OwnCheck[tuple[float, float] | None] = None,
        lens: OwnCheck[Any] = None,
        **options: Any,
    ) -> Picture:
        """
        Reconstruct a raster picture from the sites' values.

        Parameters
        ----------
        method : {"cells", "linear", "natural", "least_squares"}
            ``"cells"``: area-weighted mean of the photosites in each pixel; on a colour mosaic, missing colours of a site come
            from the nearest sites with that filter. ``"linear"``, ``"natural"``: interpolation between the sites' centroids,
            per filter. ``"least_squares"``: regularised least squares. See the functions of these names in
            :mod:`foveasim.reconstruct`.
        max_pixels : int
            Pixels along the longer side, when ``grid`` is not given.
        grid : Grid, optional
            The pixels; by default square ones over the bounds of the layout.
        of : {"code", "electrons", "expected_e", "light_e"}
            Values to reconstruct. ``"light_e"`` are photoelectrons estimated from the codes: without companding, pedestal and
            dark signal.
        per : {"site", "um2"}
            ``"site"``: the values themselves, so that larger sites are brighter. ``"um2"``: values divided by the site's area
            in µm² and its light response (and, for codes, relative conversion gain), so that a uniform scene gives a uniform
            picture. The response is that of :meth:`Sensor.light_response` over devices.
        gaps : {"fill", "empty"}
            Whether sites extend to the centre of the gap to a neighbour, such as a trench; gaps wider than half the size (root
            of the area) of the smaller site, and blind spots, are empty.
        colour : {"corrected", "raw"}, optional
            Whether images of the picture, such as files and plots, have the colours of the scene (:attr:`colour_correction`) or
            those of the filters. ``data`` are the values of the filters in both cases. Default: ``"corrected"`` where there is
            a correction.
        sensor : Sensor, optional
            By default that of the capture. Required for captures that were read from a file, if the sensor has effects that
            are not registered.
        projection : str, optional
            ``"equirectangular"``, ``"rectilinear"``, or another projection of :func:`foveasim.reconstruct.unwrap`, to which
            the picture is mapped through the lens model: panoramas and views of wide fields.
        field_of_view_deg, towards_deg : optional
            With ``projection``, the field of the picture and the direction at its centre, by default the optical axis.
        lens : lens model of foveasim.distortion, optional
            With ``projection``, by default that of the camera.
        **options
            Options of the method's function: ``mu``, ``blur``, ``tolerance``, ``max_steps`` and ``variance`` for
            ``"least_squares"``, ``n_threads`` for all.

        Returns
        -------
        Picture
            One channel per colour filter, with the white balance of ``white_dn`` and the colour correction; NaN outside the
            photosites.

        Raises
        ------
        ParameterError
            When a choice or option is invalid, the sensor's parameters are required and not known, the sensor has another
            layout, or a required colour correction does not exist.

        Notes
        -----
        Least squares require values that are linear in irradiance: codes and charges are used without pedestal, dark signal
        and companding, and without saturated sites. The result is irradiance in photoelectrons per µm²; with ``per="site"``
        it is scaled to a site of mean response. The ``variance`` is by default that of shot noise, and for codes also that
        of reset, read, RTS and quantisation noise.
        """
        known = {"n_threads"} | (
            {"mu", "blur", "tolerance", "max_steps", "variance"} if method == "least_squares" else set()
        )
        if set(options) - known:
            name = min(set(options) - known)
            hint = possible_names(name, sorted(known))
            raise ParameterError(name, f"must be an option of the method {method!r}", hint=hint)
        self._check_sensor(sensor)
        if projection is not None and grid is not None:
            raise ParameterError("grid", "must not be given with 'projection', which has its own pixels", grid)
        for name, value in (("lens", lens), ("field_of_view_deg", field_of_view_deg), ("towards_deg", towards_deg)):
            if projection is None and value is not None:
                raise ParameterError(name, "requires 'projection'", value)
        grid = raster_grid(self.layout, max_pixels) if grid is None else grid
        picture = self._reconstruct(method, grid, of, per, sensor, {"gaps": gaps, **options})
        matrix = self._colour_matrix(colour)
        if (self.white_dn > 0.0).all():
            picture = replace(picture, white=self.white_dn, colour_matrix=matrix)
        if projection is None:
            return picture
        x_um, y_um = self.settings.get("gaze_um", (0.0, 0.0)) if self.settings.get("axis") == "image" else (0.0, 0.0)
        return unwrap(
            picture,
            self._lens_of_settings() if lens is None else lens,
            projection=projection,
            field_of_view_deg=field_of_view_deg,
            towards_deg=(0.0, 0.0) if towards_deg is None else towards_deg,
            max_pixels=max_pixels,
            position_um=(float(x_um), float(y_um)),
        )

    def _lens_of_settings(self) -> Any:
        """Return the lens model of the camera, or one of its ideal image."""
        data, optics = self.settings.get("distortion"), self.settings.get("optics") or {}
        if isinstance(data, Mapping):
            for model in LENSES.values():
                if isinstance(model, type) and model.__name__ == data.get("kind"):
                    return model(**{name: value for name, value in data.items() if name != "kind"})
        elif "focal_length_mm" in optics:
            light = self.settings.get("light") or {}
            focus_m = optics.get("focus_distance_m") or light.get("distance_m") or math.inf
            focal_m = float(m_from_mm(optics["focal_length_mm"]))
            x0_um, y0_um, x1_um, y1_um = self.layout.bounds_um
            ideal: dict[str, Any] = {"focal_um": float(um_from_m(focal_m / (1.0 - focal_m / focus_m)))}
            if light.get("fit") is not None:  # framed scenes are centred on the layout
                ideal["centre_um"] = (0.5 * (x0_um + x1_um), 0.5 * (y0_um + y1_um))
            projection = optics.get("projection", "auto")
            return (
                BrownConrady(**ideal)
                if projection in ("auto", "rectilinear")
                else Fisheye(projection=projection, **ideal)
            )
        raise ParameterError("lens", "must be given: the capture does not contain its lens model")

    @property
    def colour_correction(self) -> ColourCorrection | None:
        """
        Colour correction of the filters for the scene, with its colour errors.

        For photographs in red, green and blue, the inverse of what the filters do to their three bands; otherwise the
        least-squares solution for the patches under the illuminant of the scene. None when the filters cannot distinguish
        colours: fewer than three with photosites, or equal ones.
        """
        return ColourCorrection.from_settings(self.settings)

    def _colour_matrix(self, colour: str | None) -> Floats | None:
        found = None if colour == "raw" else self.colour_correction
        if found is None and colour == "corrected":
            raise ParameterError(
                "colour",
                "must be 'raw': the capture has no colour correction",
                colour,
                hint="this needs three different filters, and three bands of light",
            )
        return None if found is None else found.matrix

    def _reconstruct(
        self, method: str, grid: Grid, of: str, per: str, sensor: Sensor | None, options: dict[str, Any]
    ) -> Picture:
        """Return the picture of a method, without white balance."""
        methods = {"cells": cells, "linear": linear, "natural": natural}
        n_filters = len(self.filter_names)
        is_in_filter = self.filter_of_site == np.arange(n_filters)[:, np.newaxis]
        is_fitted = method == "least_squares"
        values, response, variance = self._values_and_response(of, per, sensor, is_fitted=is_fitted)
        if is_fitted:
            options = {"variance": variance, **options}
            scale = float(response.mean()) if per == "site" else 1.0
            is_present = is_in_filter.any(axis=1)
            channels = np.where(is_in_filter[is_present], values, np.nan)
            found = least_squares(self.layout, channels, grid, response=response / scale, **options)
            if is_present.all():
                return found
            data = np.zeros((n_filters, *grid.shape), np.float32) * found.data[:1]
            data[is_present] = found.data
            return Picture(read_only(data), found.coverage, grid)
        values = values / (response if per == "um2" else 1.0)
        if method == "cells":
            if n_filters > 1:
                values = fill_channels(self.layout, values, self.filter_of_site, n_filters)
                values = np.where(np.isnan(values), 0.0, values)
            return cells(self.layout, values, grid, **options)
        # A filter that no site has is black, as in cells.
        channels = np.where(is_in_filter, values, np.where(is_in_filter.any(axis=1, keepdims=True), np.nan, 0.0))
        return methods[method](self.layout, channels, grid, **options)

    def cortical(
        self,
        *,
        of: Quantity = "code",
        per: Literal["site", "um2"] = "site",
        n_rings: int | None = None,
        n_sectors: int | None = None,
        r_min_um: float | None = None,
        r_max_um: float | None = None,
        centre_um: tuple[float, float] | None = None,
        max_pixels: Annotated[int, PIXELS] = 1024,
        sensor: Sensor | None = None,
        n_threads: int | None = None,
    ) -> CorticalImage:
        """
        Return the values as a log-polar image of rings and sectors.

        On layouts of rings with equal sectors it has exactly one pixel per site, and one channel, also with colour filters.
        With ``n_rings`` and ``n_sectors``, and thus for any layout, the picture of :meth:`picture` is resampled.

        Parameters
        ----------
        of, per, sensor
            As for :meth:`picture`.
        n_rings, n_sectors : int, optional
            Shape of the resampled image.
        r_min_um, r_max_um, centre_um : optional, µm
            Radii and centre of the resampled image: see :func:`foveasim.reconstruct.to_cortical`. By default the centre is
            the optical axis, and the outermost ring touches the nearest side of the bounds of the layout.
        max_pixels : int
            Pixels along the longer side of the picture that is resampled.
        n_threads : int, optional
            Threads of the reconstruction; all cores by default.

        Returns
        -------
        CorticalImage
            :func:`foveasim.reconstruct.from_cortical` is the inverse.

        Raises
        ------
        ParameterError
            When the layout does not have such rings and no shape is given, or as for :meth:`picture`.
        """
        self._check_sensor(sensor)
        if n_rings is None and n_sectors is None:
            for name, value in (("r_min_um", r_min_um), ("r_max_um", r_max_um), ("centre_um", centre_um)):
                if value is not None:
                    raise ParameterError(name, "must be used with 'n_rings' and 'n_sectors'", value, "µm")
            values, response, _ = self._values_and_response(of, per, sensor)
            return cortical(self.layout, values / (response if per == "um2" else 1.0))
        if n_rings is None or n_sectors is None:
            raise ParameterError("n_rings", "and 'n_sectors' must be given together")
        centre = (0.0, 0.0) if centre_um is None else centre_um
        if r_max_um is None:
            x0, y0, x1, y1 = self.layout.bounds_um
            r_max_um = min(x1 - centre[0], y1 - centre[1], centre[0] - x0, centre[1] - y0)
        picture = self.picture(max_pixels=max_pixels, of=of, per=per, sensor=sensor, n_threads=n_threads)
        return to_cortical(
            picture, n_rings=n_rings, n_sectors=n_sectors, r_min_um=r_min_um, r_max_um=r_max_um, centre_um=centre
        )

    def signal_to_noise(self, *, sensor: Sensor | None = None) -> Floats:
        """
        Return the expected signal-to-noise ratio of every site.

        See :func:`foveasim.sensor.signal_to_noise`.

        Parameters
        ----------
        sensor : Sensor, optional
            As for :meth:`picture`.

        Returns
        -------
        ratio : (n_site,) float64
        """
        known = self._sensor_or(sensor)
        dark_e = np.broadcast_to(
            known.expected_electrons(np.zeros(self.layout.n_sites), self._exposure_s), self.expected_e.shape
        )
        return signal_to_noise(known, self.expected_e, dark_e, exposure_s=self._exposure_s).ratio

    def expected_code(self, *, sensor: Sensor | None = None) -> Floats:
        """
        Return the mean code of every site over temporal noise.

        See :meth:`foveasim.Sensor.predict`.

        Parameters
        ----------
        sensor : Sensor, optional
            As for :meth:`picture`.

        Returns
        -------
        mean_dn : (n_site,) float64, DN
        """
        return self._sensor_or(sensor).predict(self.expected_e, exposure_s=self._exposure_s)[0]

    @property
    def _exposure_s(self) -> float:
        """Exposure time of the settings; 0 without one."""
        return float(self.settings.get("exposure_s", 0.0))

    def _check_sensor(self, sensor: Sensor | None) -> None:
        """Raise when a sensor has another layout than the capture."""
        if sensor is not None and (not isinstance(sensor, Sensor) or not same_rings(sensor.layout, self.layout)):
            raise ParameterError(
                "sensor", "must be the Sensor of the capture's layout, with the same sites in the same order", sensor
            )

    def _values_and_response(
        self, of: str, per: str, sensor: Sensor | None, *, is_fitted: bool = False
    ) -> tuple[Floats, Floats, Floats | None]:
        """
        Return values and responses of the sites, and the variances of estimated values.

        Values are estimated photoelectrons for ``"light_e"`` and for fits, which exclude saturated sites.
        """
        is_estimated = is_fitted or of == "light_e"
        values = np.asarray(self.code if of == "light_e" else getattr(self, of), dtype=np.float64)
        if not is_estimated and per != "um2":
            return values, np.ones(values.size), None
        electronics = self._sensor_or(sensor)
        e_per_dn = electrons_per_code(electronics) if of == "code" else np.ones(values.size)
        light_response = electronics.light_response(is_device_known=False)
        response = self.layout.area_um2 * light_response * (np.mean(e_per_dn) / e_per_dn)
        if not is_estimated:
            return values, response, None
        if of in ("code", "light_e"):
            estimates = estimate_from_code(self.code, electronics, self._exposure_s)
        else:
            estimates = estimate_from_charge(getattr(self, of), electronics, self._exposure_s)
        values = estimates.light_e / e_per_dn
        if is_fitted:
            values[estimates.is_saturated] = np.nan
        return values, response, estimates.variance_e2 / e_per_dn**2

    def _sensor_or(self, given: Sensor | None) -> Sensor:
        """Return a given sensor of this layout, or that of the capture; see :meth:`picture`."""
        self._check_sensor(given)
        return self._electronics if given is None else given

    @cached_property
    def _electronics(self) -> Sensor:
        """Sensor of the capture; without filters and quantum efficiency after reading."""
        if self.electronics is not None:
            return self.electronics
        known = Sensor.from_settings(self.layout, self.settings.get("sensor", {}), self.sensor_arrays)
        if "tile" in self.settings:
            unknown = [effect.name for effect in known.effects if effect.needs_layout]
            if unknown:
                raise ParameterError(
                    "sensor",
                    f"must be given: the effects {', '.join(map(repr, unknown))} of a tile need the complete layout",
                    hint="use camera.sensor.part(slice(first, last))",
                )
        return known

    to_pyvista: ClassVar[ViewMethod[PolyData]] = view_method("polydata")
    plot: ClassVar[ViewMethod[Axes]] = view_method("plot_capture")
    plot3d: ClassVar[ViewMethod[None]] = view_method("show_columns")
    _repr_html_ = view_method("to_html")

    def to_xarray(self) -> xr.Dataset:
        """
        Return the capture as a labelled dataset that netCDF and zarr files can store.

        Returns
        -------
        xarray.Dataset
            Dimensions ``site`` (n_site) and ``filter`` (n_filter). Variables ``code``, ``electrons``, ``expected_e``,
            ``filter_of_site`` and registered columns over sites, ``white_dn`` over filters. Coordinates: index of the sites,
            their centroids ``x_um`` and ``y_um``, ``area_um2``, names of the filters, and all columns of the layout. Every
            variable has its ``units``, ``"1"`` when dimensionless. Attributes: ``bits``, ``seed``, ``exposure_s``, and
            ``settings``, ``versions``, ``provenance`` as JSON strings.

        Notes
        -----
        A column of the layout is renamed when its name is taken or contains other characters than letters, digits and
        ``_``; its attribute ``long_name`` is the original name. Outlines are not included: ``layout.write`` and
        :meth:`save` write them.
        """
        xr = import_optional("to_xarray", "xarray", "maps")
        variables, coordinates, _ = self._variables()

        def parts(chosen: Mapping[str, Variable]) -> dict[str, Any]:
            return {name: (part.dims, part.data, dict(part.attributes)) for name, part in chosen.items()}

        return xr.Dataset(parts(variables), parts(coordinates), self._attributes())

    def to_pandas(self) -> pd.DataFrame:
        """
        Return the capture as a table with one row per site.

        Returns
        -------
        pandas.DataFrame
            Index ``site``. Columns ``x_um``, ``y_um``, ``area_um2``, ``filter_name``, ``filter_of_site``, ``code``,
            ``electrons``, ``expected_e``, registered columns such as ``code_dn`` (signed codes, for differences), and those of
            the layout, named as in :meth:`to_xarray`. ``attrs`` contains the attributes of :meth:`to_xarray`.

        Examples
        --------
        The mean code of the sites of each filter::

            capture.to_pandas().groupby("filter_name")["code"].mean()
        """
        pd = import_optional("to_pandas", "pandas")
        variables, coordinates, _ = self._variables()
        columns = {
            **{name: coordinates[name] for name in ("x_um", "y_um", "area_um2")},
            "filter_name": Variable((SITE,), np.array(self.filter_names)[self.filter_of_site], {}),
            "filter_of_site": variables["filter_of_site"],
            **{name: part for name, part in variables.items() if part.dims == (SITE,)},
            **{name: part for name, part in coordinates.items() if part.dims == (SITE,) and name != SITE},
        }
        # DataFrames share memory with their arrays, which are read-only here.
        table = pd.DataFrame(
            {name: part.data.copy() for name, part in columns.items()},
            index=pd.Index(coordinates[SITE].data, name=SITE),
        )
        table.attrs = self._attributes()
        return table

    def _variables(self) -> tuple[dict[str, Variable], dict[str, Variable], dict[str, str]]:
        """Return variables, coordinates, and the names of the layout's columns among these."""
        layout, centroid_um = self.layout, self.layout.centroid_um
        variables = {
            name: _variable(name, (SITE,), compute_column(name, self))
            for name in COLUMNS
            if column_info(name).in_tables
        }
        variables["white_dn"] = _variable("white_dn", (FILTER,), np.asarray(self.white_dn))
        coordinates = {
            SITE: _variable(SITE, (SITE,), np.arange(layout.n_sites)),
            "x_um": _variable("x_um", (SITE,), centroid_um[:, 0]),
            "y_um": _variable("y_um", (SITE,), centroid_um[:, 1]),
            "area_um2": _variable("area_um2", (SITE,), layout.area_um2),
            FILTER: _variable(FILTER, (FILTER,), np.array(self.filter_names)),
        }
        names = free_names(layout.columns, (*variables, *coordinates, *DERIVED))
        for name, values in layout.columns.items():
            coordinates[names[name]] = _variable(name, (SITE,), values, is_renamed=names[name] != name)
        return variables, coordinates, names

    def _attributes(self) -> dict[str, Any]:
        """Return attributes of the capture: numbers and strings, which all formats can store."""
        settings = self.settings
        seed = settings.get("seed")
        found: dict[str, Any] = {"bits": self.bits}
        if isinstance(seed, int):
            found["seed"] = seed if abs(seed) < 2**63 else str(seed)
        if isinstance(settings.get("exposure_s"), int | float):
            found["exposure_s"] = float(settings["exposure_s"])
        return found | {
            "settings": json.dumps(settings),
            "versions": json.dumps(settings.get("versions", {})),
            "provenance": json.dumps(to_plain_data(dict(self.layout.provenance))),
        }

    def save(self, path: str | Path) -> None:
        """
        Write the capture to a ``.npz`` file or a ``.zarr`` directory, atomically.

        Parameters
        ----------
        path : path
            ``.npz``: one compressed file. ``.zarr``, with the extra ``video``: a store that xarray opens as the dataset of
            :meth:`to_xarray`, with the outlines in its group ``layout``. An existing capture is replaced.

        Raises
        ------
        FileError
            When the extension is another, zarr is missing, the path exists and is not a capture, or it cannot be written.
        """
        target = Path(path)
        if target.suffix.lower() == ZARR:
            self._save_store(target)
            return
        if target.suffix.lower() != ".npz":
            raise FileError(target, "must end in .npz or .zarr")
        about = {
            "format": FILE_FORMAT,
            "version": FILE_VERSION,
            "filter_names": list(self.filter_names),
            "bits": self.bits,
            "white_dn": self.white_dn.tolist(),
            "settings": self.settings,
            "sensor_arrays": list(self._stored_arrays),
            "provenance": to_plain_data(dict(self.layout.provenance)),
        }
        arrays = {name: getattr(self, name) for name in STORED}
        of_sensor = {f"{SENSOR_GROUP}_{k}": values for k, values in enumerate(self._stored_arrays.values())}
        write_archive(path, about, arrays | of_sensor | layout_to_arrays(self.layout))

    @property
    def _stored_arrays(self) -> Mapping[str, NDArray[Any]]:
        """Arrays to which the settings refer: not those of a part of a sensor."""
        known = self.sensor_arrays if self.electronics is None else self.electronics.arrays
        needed = json.dumps(self.settings.get("sensor", {})) if known else ""
        return {digest: values for digest, values in known.items() if digest in needed}

    def _save_store(self, target: Path) -> None:
        zarr = import_optional(target, "zarr")
        variables, coordinates, names = self._variables()
        outlines = {
            "xy_um": _variable("xy_um", ("vertex", "axis"), self.layout.xy_um),
            "ring_offsets": _variable("ring_offsets", ("ring_end",), self.layout.ring_offsets),
            "site_offsets": _variable("site_offsets", ("site_end",), self.layout.site_offsets),
        }
        of_sensor = {
            digest: Variable(tuple(f"{digest[:8]}_{axis}" for axis in range(values.ndim)), values, {})
            for digest, values in self._stored_arrays.items()
        }
        attributes = {
            "format": FILE_FORMAT,
            "version": FILE_VERSION,
            **self._attributes(),
            "filter_names": list(self.filter_names),
            "columns": names,
            # Convention of xarray: names of the coordinates that are not dimensions.
            "coordinates": " ".join(name for name in coordinates if name not in (SITE, FILTER)),
        }
        with atomic_directory(target, is_ours=lambda directory: store_format(directory) == FILE_FORMAT) as directory:
            group = zarr.create_group(str(directory), zarr_format=3, attributes=attributes)
            write_variables(group, variables | coordinates)
            write_variables(group.create_group(LAYOUT_GROUP), outlines)
            write_variables(group.create_group(SENSOR_GROUP), of_sensor)

    @classmethod
    def load(cls, path: str | Path) -> Capture:
        """
        Read a capture that :meth:`save` wrote.

        Parameters
        ----------
        path : path
            A ``.npz`` file or a ``.zarr`` directory.

        Raises
        ------
        FileError
            When it is missing, corrupt, incomplete, too large, or not a capture.
        """
        source = Path(path)
        if source.is_dir() or (source.suffix.lower() == ZARR and not source.exists()):
            return cls._load_store(source)
        with open_archive(source, "foveasim capture", FILE_FORMAT, FILE_VERSION) as (about, arrays):
            values: dict[str, Any] = {name: arrays[name] for name in STORED}
            return cls(
                layout=layout_from_arrays(arrays, about["provenance"]),
                **values,
                filter_names=tuple(about["filter_names"]),
                bits=int(about["bits"]),
                white_dn=np.asarray(about["white_dn"], dtype=np.float64),
                settings=about["settings"],
                sensor_arrays={
                    str(digest): arrays[f"{SENSOR_GROUP}_{k}"]
                    for k, digest in enumerate(about.get("sensor_arrays", ()))
                },
            )

    @classmethod
    def _load_store(cls, source: Path) -> Capture:
        with open_store(source, "foveasim capture", FILE_FORMAT, FILE_VERSION) as (about, arrays):
            xy_um, ring_offsets, site_offsets = (
                arrays[f"{LAYOUT_GROUP}/{name}"][...] for name in ("xy_um", "ring_offsets", "site_offsets")
            )
            columns = {str(name): arrays[path][...] for name, path in about["columns"].items()}
            return cls(
                layout=Layout(xy_um, ring_offsets, site_offsets, columns, json.loads(about["provenance"])),
                **{name: arrays[name][...] for name in (*STORED, "white_dn")},
                filter_names=tuple(map(str, about["filter_names"])),
                bits=about["bits"],
                settings=json.loads(about["settings"]),
                sensor_arrays={
                    path.removeprefix(f"{SENSOR_GROUP}/"): array[...]
                    for path, array in arrays.items()
                    if path.startswith(f"{SENSOR_GROUP}/")
                },
            )


def _variable(name: str, dims: tuple[str, ...], values: NDArray[Any], *, is_renamed: bool = False) -> Variable:
    """Return an array with the unit in its name; xarray writes the unit of times itself."""
    unit = column_info(name).unit if name in COLUMNS else unit_of(name)
    units = {} if values.dtype.kind in "mM" else {"units": unit or "1"}
    return Variable(dims, values, units | ({"long_name": name} if is_renamed else {}))


publish(__name__)
