"""Comparison of cameras at equal budget: the same scenes, lens, exposure and grid."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import NOT_NEGATIVE, POSITIVE, Limits
from foveasim._core.extras import import_optional
from foveasim._core.provenance import to_plain_data, versions
from foveasim._core.validation import Floats, check_choice, check_number, check_point, read_only
from foveasim.camera import Camera
from foveasim.camera._framing import different_part, turned_instead
from foveasim.compare._light import (
    behind_image,
    e_per_photon,
    field_of,
    image_of,
    mean_spectrum,
    photons_per_um2,
    with_angular_response,
)
from foveasim.compare.annuli import quality_by_eccentricity
from foveasim.compare.budgets import BUDGETS, Budget, budget_of, budget_rows, check_equal_budgets
from foveasim.compare.information import scene_covariance
from foveasim.compare.intervals import MedianInterval, median_interval
from foveasim.compare.metrics import (
    BY_ECCENTRICITY,
    COMPARED,
    ComparedShot,
    best_cameras,
    further_metrics,
    information_by_annulus,
    layout_measures,
    metric_rows,
    scene_measures,
    size_records,
    wave_per_mm_of,
)
from foveasim.compare.setup import DEFAULT_EXPOSURE_S, cameras_of, field_um, photograph_scenes
from foveasim.compare.verdict import verdict_lines
from foveasim.errors import ParameterError, format_value
from foveasim.fields import PowerMap
from foveasim.layout import Layout
from foveasim.metrics.registry import check_number_name, metric_info
from foveasim.metrics.shots.resolution import wave_of
from foveasim.optics import Optics
from foveasim.reconstruct import Picture
from foveasim.scene import Scene
from foveasim.sensor import Sensor
from foveasim.sensor.model.linearisation import Linearisation

if TYPE_CHECKING:
    import xarray as xr
    from rich.console import RenderableType

__all__ = ["Comparison", "cameras", "layouts"]

Method = Literal["cells", "linear", "natural", "least_squares"]

#: Smallest coverage of a pixel that belongs to a camera's picture.
MIN_COVERAGE = 0.5
#: Explanation of a mark in tables.
BEST_NOTE = "* best value of the row"


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison:
    """
    Result of a comparison.

    Attributes
    ----------
    names : tuple of str
        Names of the cameras.
    scenes : tuple of str
    metrics : tuple of str
        Names in :data:`foveasim.metrics.METRICS`.
    budgets : tuple of Budget
        One per camera.
    edges_um : (n_annulus + 1,) float64, µm
        Radii of the annuli around ``centre_um``.
    centre_um : (x, y), µm
        Fixation point.
    values : mapping of str to array
        Metrics by name: (n_camera, n_scene) or (n_camera,); and ``NAME_by_eccentricity`` with an axis of annuli.
    coverage_fraction : (n_camera,) float64
        Fraction of the field that each camera covers. The field consists of the pixels that any camera covers.
    compared_fraction : float
        Fraction of the field that all cameras cover: pictures are compared there.
    pictures : mapping of str to list of Picture
        Pictures of each camera for each scene, photons/µm², multiplied by the fitted gain.
    ideals : mapping of str to list of Picture
        Their references: the ideal image of each camera on the same grid. They differ between gazes and spectral responses.
    sizes : mapping of str to list of dict
        Size classes of each camera: size in µm, number of sites, area fraction.
    settings : mapping
        Plain data: budget, exposure, seed, optics, sensors, layouts, versions.
    """

    names: tuple[str, ...]
    scenes: tuple[str, ...]
    metrics: tuple[str, ...] = COMPARED
    budgets: tuple[Budget, ...]
    edges_um: Floats
    centre_um: tuple[float, float]
    values: Mapping[str, Floats]
    coverage_fraction: Floats
    compared_fraction: float
    pictures: Mapping[str, Sequence[Picture]]
    ideals: Mapping[str, Sequence[Picture]]
    sizes: Mapping[str, Sequence[Mapping[str, Any]]]
    settings: Mapping[str, Any]

    def __repr__(self) -> str:
        return f"Comparison({', '.join(map(format_value, self.names))}; {len(self.scenes)} scenes)"

    def summary(self, name: str, *, by_eccentricity: bool = False) -> MedianInterval:
        """
        Return the median of a metric over the scenes, and its confidence interval.

        Parameters
        ----------
        name : str
            A name in :attr:`metrics`.
        by_eccentricity : bool
            Whether to return values per annulus.

        Returns
        -------
        median, low, high : (n_camera,) or (n_camera, n_annulus) float64
            With a 95 % interval for the median of the population of scenes, for any distribution (:func:`median_interval`).
            Its bounds are NaN for fewer than five scenes, and the value itself for metrics of layouts.
        """
        return self._interval(name, by_eccentricity, is_difference=False)

    def differences(self, name: str, *, by_eccentricity: bool = False) -> MedianInterval:
        """
        Return the median difference from the first camera, and its confidence interval.

        Parameters
        ----------
        name, by_eccentricity
            As for :meth:`summary`.

        Returns
        -------
        median, low, high : (n_camera,) or (n_camera, n_annulus) float64
            Differences are paired by scene, so that the interval does not contain the variation between scenes.
        """
        return self._interval(name, by_eccentricity, is_difference=True)

    def _interval(self, name: str, by_eccentricity: bool, *, is_difference: bool) -> MedianInterval:
        """Return the interval of a metric or its differences; one value for layouts."""
        has_scenes = metric_info(check_choice("name", name, self.metrics)).has_scene
        values = self.values[name + (BY_ECCENTRICITY if by_eccentricity else "")]
        if is_difference:
            with np.errstate(invalid="ignore"):  # infinite PSNR of identical pictures
                values = np.where(values == values[:1], 0.0, values - values[:1])
        return median_interval(np.moveaxis(values, 1, -1)) if has_scenes else MedianInterval(values, values, values)

    def verdict(self) -> list[str]:
        """
        Return the result in words.

        Returns
        -------
        lines : list of str
            For each camera after the first: where it or the first camera has the higher PSNR, by how much, and at which
            eccentricity they cross; and the difference over the field. Differences up to 0.1 dB count as equal.
        """
        return verdict_lines(self)

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per camera, with its budget, its coverage and all metrics."""
        rows = []
        for k, name in enumerate(self.names):
            row: dict[str, Any] = {
                "camera": name,
                **asdict(self.budgets[k]),
                "coverage_fraction": float(self.coverage_fraction[k]),
            }
            for metric in self.metrics:
                median, low, high = self.summary(metric)
                row[metric] = float(median[k])
                if metric_info(metric).has_scene:
                    row[f"{metric}_low"], row[f"{metric}_high"] = float(low[k]), float(high[k])
            rows.append(row)
        return rows

    def to_xarray(self) -> xr.Dataset:
        """
        Return all values as a labelled dataset.

        Returns
        -------
        xarray.Dataset
            Dimensions ``camera``, ``scene``, ``annulus``, with the radii of the annuli and the budgets as coordinates.

        Raises
        ------
        ParameterError
            When xarray is missing.
        """
        xr = import_optional("to_xarray", "xarray", "maps")
        variables = {}
        for name in self.metrics:
            info = metric_info(name)
            dims = ("camera", "scene") if info.has_scene else ("camera",)
            attributes = {"units": info.unit or "1", "long_name": info.title}
            variables[name] = (dims, self.values[name], attributes)
            variables[name + BY_ECCENTRICITY] = ((*dims, "annulus"), self.values[name + BY_ECCENTRICITY], attributes)
        variables["coverage_fraction"] = (("camera",), self.coverage_fraction, {"units": "1"})
        coordinates: dict[str, Any] = {
            "camera": list(self.names),
            "scene": list(self.scenes),
            "from_um": ("annulus", self.edges_um[:-1], {"units": "µm"}),
            "to_um": ("annulus", self.edges_um[1:], {"units": "µm"}),
        }
        for attribute, _, unit in BUDGETS.values():
            numbers = [getattr(budget, attribute) for budget in self.budgets]
            coordinates[attribute] = ("camera", numbers, {"units": unit or "1"})
        for name in coordinates.keys() & variables.keys():  # metrics that are budgets
            del variables[name]
        return xr.Dataset(variables, coordinates, {"settings": json.dumps(self.settings)})

    def plot(self) -> NDArray[Any]:
        """
        Draw all metrics against eccentricity, and the areas of size classes.

        Returns
        -------
        axes : (n_metric + 1,) array of matplotlib axes
            Of a new figure, with confidence intervals.
        """
        from foveasim.compare.figures import overview

        return overview(self)

    def write(self, path: str | Path) -> None:
        """
        Write a report as an HTML page that needs no network.

        Parameters
        ----------
        path : path
            With the extension ``.html``; written atomically.

        Raises
        ------
        FileError
            When the extension is another, or the file cannot be written.
        """
        from foveasim.compare.report import report_page
        from foveasim.view.web._page import write_page

        write_page(path, lambda: report_page(self))

    def __str__(self) -> str:
        rows = [["", *self.names], *self._rows()]
        first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
        table = ["  ".join([head.ljust(first), *map(str.rjust, cells, widths)]).rstrip() for head, *cells in rows]
        return "\n".join([*self.verdict(), *table, BEST_NOTE])

    def _repr_html_(self) -> str:
        from foveasim.view.notebook import html_table

        return html_table(" ".join([f"{self!r}.", *self.verdict(), BEST_NOTE]), ("", *self.names), self._rows())

    def __rich__(self) -> RenderableType:
        from rich.console import Group
        from rich.table import Table

        from foveasim._io.terminal import as_plain_text

        table = Table(box=None)
        table.add_column("")
        for name in self.names:
            table.add_column(as_plain_text(name), justify="right")
        for row in self._rows():
            table.add_row(*map(as_plain_text, row))
        return Group(*map(as_plain_text, self.verdict()), table, BEST_NOTE)

    def _rows(self) -> list[list[str]]:
        """Return title and one value per camera of each row of the table."""
        coverage = ["coverage of the field / %", *(f"{100.0 * part:.1f}" for part in self.coverage_fraction)]
        rows = metric_rows(self.metrics, self.summary)
        for row, best in zip(rows, best_cameras(self.metrics, self.summary), strict=True):
            if best is not None:
                row[best + 1] += " *"
        return [*budget_rows(self.budgets), coverage, *rows]


def cameras(
    cameras: Mapping[str, Camera],
    scenes: Mapping[str, Scene | PowerMap] | None = None,
    *,
    exposure_s: Annotated[float, POSITIVE],
    seed: Annotated[int, Limits(at_least=0)] = 0,
    budget: str | None = "n_sites",
    tolerance: Annotated[float, NOT_NEGATIVE] = 0.02,
    frames_per_s: float | Mapping[str, float] | None = None,
    centre_um: tuple[float, float] = (0.0, 0.0),
    n_annuli: Annotated[int, Limits(at_least=1, at_most=1000)] = 8,
    max_pixels: Annotated[int, Limits(at_least=16, at_most=4096)] = 256,
    method: Method = "cells",
    metrics: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """
    Compare cameras of equal budget, with the same scenes, lens and exposure.

    Parameters
    ----------
    cameras : mapping of str to Camera
        Two or more, with the same optics, distortion and ``gaze_deg``.
    scenes : mapping of str to Scene or PowerMap, optional
        By default five photographs that fill the field (:func:`photograph_scenes`).
    exposure_s : float, s
    seed : int
        Seed of the noise, the same for all cameras.
    budget : {"n_sites", "data_rate", "readout_time", "area", "read_noise"} or None
        Budget that must be equal; None for any budgets.
    tolerance : float
        Largest difference between two budgets, relative to the smaller one.
    frames_per_s : float, or mapping of str to float, optional, 1/s
        Frame rate for the data rate, of all cameras or by name; by default one frame per exposure.
    centre_um : (x, y), µm
        Fixation point, the centre of the annuli.
    n_annuli : int
        Number of annuli of equal width, out to the largest distance of a site.
    max_pixels : int
        Pixels along the longer side of the pictures, which have a common grid.
    method : {"cells", "linear", "natural", "least_squares"}
        Reconstruction, as for :meth:`Capture.picture`.
    metrics : sequence of str
        Further metrics, by their names in :data:`foveasim.metrics.METRICS`. Those that can be computed for some of the
        photosites are also computed by annulus.
    progress : function of (n_done, n), optional

    Returns
    -------
    Comparison

    Raises
    ------
    ParameterError
        When budgets differ, cameras have different lenses or directions, or a value is out of range.

    Notes
    -----
    Scenes with ``fit`` are framed once, on the bounding box of all layouts, so that all cameras have the same image and the
    results do not depend on their order.

    The reference of a picture is the ideal image on its grid: exact means of the irradiance, with the spectral response and the
    gaze of its camera. One gain per picture is fitted. Pictures are compared where all cameras cover at least half of a pixel.
    The covariance of the scenes is that of the photons in the part of the image that any camera sees.

    Examples
    --------
    >>> import foveasim as fs
    >>> optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    >>> layouts = {"grid": fs.layout.grid(n_x=20, n_y=20, pitch_um=4.0)}
    >>> layouts["hexagonal"] = fs.layout.hexagonal(n_columns=20, n_rows=20, pitch_um=4.3)
    >>> cameras = {
    ...     name: fs.Camera(optics=optics, sensor=fs.compare.default_sensor(layouts[name]))
    ...     for name in layouts
    ... }
    >>> scene = fs.Scene.flat(
    ...     shape=(40, 40), pitch_um=400.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> found = fs.compare.cameras(
    ...     cameras, {"wall": scene}, exposure_s=0.01, n_annuli=2, max_pixels=32
    ... )
    >>> {name: round(budget.area_um2) for name, budget in zip(found.names, found.budgets)}
    {'grid': 6400, 'hexagonal': 6405}
    """
    named = _check_cameras(cameras)
    fixation = check_point("centre_um", centre_um)
    metrics = tuple(dict.fromkeys(check_number_name("metrics", name) for name in metrics if name not in COMPARED))
    budgets = {name: budget_of(camera, _rate(frames_per_s, name, exposure_s)) for name, camera in named.items()}
    check_equal_budgets(budgets, budget, tolerance)
    first = next(iter(named.values()))  # all cameras have the same lens
    all_layouts = [camera.layout for camera in named.values()]
    if scenes is None:
        scenes = photograph_scenes(field_um(all_layouts), first.optics)
    if not scenes:
        raise ParameterError("scenes", "must be a mapping of names to at least one scene", scenes)
    # All cameras have the same image, whose scale would otherwise follow from the layout of each.
    lights = {}
    for name, scene in scenes.items():
        if isinstance(scene, Scene) and scene.panorama is not None:
            _check_directions(named)
        ahead, light = turned_instead(first, scene)
        lights[str(name)] = ahead.fit_scene(light, others=named.values()) if isinstance(light, Scene) else light
    gaze_deg = first.gaze_deg  # of all cameras
    named = {name: camera.with_gaze(gaze_deg=(0.0, 0.0)) for name, camera in named.items()}
    first = next(iter(named.values()))
    steps = count(1)

    def advance() -> None:
        if progress is not None:
            progress(next(steps), len(named) * (len(lights) + 1))

    annuli, grid, covariance_grid = field_of(list(named.values()), fixation, n_annuli, max_pixels)
    shots: dict[str, list[_Shot]] = {name: [] for name in named}
    photons, spectra = [], []
    for light in lights.values():
        maps: dict[tuple[float, float], PowerMap] = {}  # by the direction of cameras that turn
        photons.append(photons_per_um2(image_of(first.with_gaze((0.0, 0.0)), light, maps), covariance_grid, exposure_s))
        spectra.append(mean_spectrum(maps[0.0, 0.0], covariance_grid))
        for name, camera in named.items():
            capture = camera.capture(light, exposure_s=exposure_s, seed=seed)
            sensor_at_angles = with_angular_response(camera, light)
            picture = capture.picture(method, of="light_e", per="um2", grid=grid, sensor=sensor_at_angles)
            ideal = camera.reference(light, grid, exposure_s=exposure_s)
            model, shot_measures = scene_measures(behind_image(camera), capture, image_of(camera, light, maps), annuli)
            shot_measures |= further_metrics(metrics, ComparedShot(light, camera, exposure_s), capture, annuli)
            shots[name].append(_Shot(picture, ideal, model, sensor_at_angles.light_response(), shot_measures))
            advance()
    covered = [one[0].picture.coverage >= MIN_COVERAGE for one in shots.values()]
    is_common, is_field = (combine(covered, axis=0) for combine in (np.all, np.any))
    if not is_common.any():
        raise ParameterError("cameras", "must have a common part of the field; the layouts do not overlap")
    covariance = scene_covariance(np.array(photons), covariance_grid.pitch_x_um)
    n_sites, area_um2 = (sum(getattr(one, part) for one in budgets.values()) for part in ("n_sites", "area_um2"))
    wave_per_mm = wave_per_mm_of(n_sites, area_um2)
    values: dict[str, list[Any]] = {key: [] for name in (*COMPARED, *metrics) for key in (name, name + BY_ECCENTRICITY)}
    pictures: dict[str, list[Picture]] = {}
    ideals: dict[str, list[Picture]] = {}
    waves = sorted({wave_of(light) for light in lights.values()})
    for name, camera in named.items():
        shots_of_camera = shots[name]
        qualities = [
            quality_by_eccentricity(one.picture, one.ideal, **annuli._asdict(), is_compared=is_common)
            for one in shots_of_camera
        ]
        per_photon = e_per_photon(camera.sensor, spectra)
        responses = [per_photon[camera.sensor.filter_of_site] * one.response for one in shots_of_camera]
        measures = [quality._asdict() | one.measures for quality, one in zip(qualities, shots_of_camera, strict=True)]
        found = (
            {key: [one[key] for one in measures] for key in measures[0]}
            | information_by_annulus(camera, covariance, responses, [one.model for one in shots_of_camera], annuli)
            | layout_measures(camera, waves, annuli, wave_per_mm)
        )
        for metric in metrics:
            if not metric_info(metric).has_scene:
                found |= {key: found[key][0] for key in (metric, metric + BY_ECCENTRICITY)}
        for key, rows in values.items():
            rows.append(found[key])
        # In photons, pictures of sensors with different sensitivities have the same white.
        scale = 1.0 / per_photon.mean()
        pictures[name] = [
            _scaled(one.picture, scale * quality.gain) for quality, one in zip(qualities, shots_of_camera, strict=True)
        ]
        ideals[name] = [_scaled(one.ideal, scale) for one in shots_of_camera]
        advance()
    n_field = np.count_nonzero(is_field)
    return Comparison(
        names=tuple(named),
        scenes=tuple(lights),
        metrics=(*COMPARED, *metrics),
        budgets=tuple(budgets.values()),
        edges_um=read_only(annuli.edges_um),
        centre_um=fixation,
        values={key: read_only(np.asarray(rows, np.float64)) for key, rows in values.items()},
        coverage_fraction=read_only(np.array([np.count_nonzero(part) for part in covered]) / n_field),
        compared_fraction=float(np.count_nonzero(is_common) / n_field),
        pictures=pictures,
        ideals=ideals,
        sizes={name: size_records(camera) for name, camera in named.items()},
        settings={
            "budget": budget,
            "tolerance": tolerance,
            "exposure_s": exposure_s,
            "seed": seed,
            "method": method,
            "wave_per_mm": wave_per_mm,
            "optics": to_plain_data(first.optics),
            "distortion": to_plain_data(first.distortion),
            "cameras": {
                name: {
                    "sensor": to_plain_data(camera.sensor, without={"layout"}),
                    "layout": to_plain_data(dict(camera.layout.provenance)),
                    "gaze_um": list(camera.gaze_um),
                    "gaze_deg": list(gaze_deg),
                    "axis": camera.axis,
                }
                for name, camera in named.items()
            },
            "versions": versions(),
        },
    )


def _scaled(picture: Picture, factor: float) -> Picture:
    return replace(picture, data=(factor * picture.data).astype(np.float32))


class _Shot(NamedTuple):
    """Parts of a capture of a scene that a comparison keeps."""

    picture: Picture
    ideal: Picture
    model: Linearisation
    response: Floats
    measures: dict[str, Any]


def layouts(
    layouts: Mapping[str, Layout],
    scenes: Mapping[str, Scene | PowerMap] | None = None,
    *,
    optics: Optics | None = None,
    sensor: Callable[[Layout], Sensor] | None = None,
    exposure_s: float = DEFAULT_EXPOSURE_S,
    **options: Any,
) -> Comparison:
    """
    Compare layouts of equal budget, in cameras of the same design.

    Parameters
    ----------
    layouts : mapping of str to Layout
    scenes : mapping of str to Scene or PowerMap, optional
        As for :func:`cameras`.
    optics : Optics, optional
        By default a lens of 8 mm and f/2.8.
    sensor : function of a layout, optional
        Returns the sensor of a layout; :func:`default_sensor` by default.
    exposure_s : float, s
    **options
        As for :func:`cameras`.

    Returns
    -------
    Comparison

    Raises
    ------
    ParameterError
        As for :func:`cameras`.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.slanted_edge(
    ...     shape=(64, 64), pitch_um=250.0, distance_m=1.0, luminance_cd_m2=100.0
    ... )
    >>> layouts = {"grid": fs.layout.grid(n_x=20, n_y=20, pitch_um=4.0)}
    >>> layouts["hexagonal"] = fs.layout.hexagonal(n_columns=20, n_rows=20, pitch_um=4.3)
    >>> found = fs.compare.layouts(layouts, {"edge": scene}, n_annuli=2, max_pixels=40)
    >>> found.values["psnr_db"].round().tolist()
    [[26.0], [28.0]]

    ::

        foveal = fs.layout.log_polar(n_sites=14_000, min_size_um=2.0, r_max_um=690.0)
        square = fs.layout.grid(n_sites=14_000, size_um=(1223.0, 1223.0))
        fs.compare.layouts({"foveal": foveal, "square": square}).write("report.html")
    """
    return cameras(cameras_of(layouts, optics, sensor), scenes, exposure_s=exposure_s, **options)


def _check_cameras(cameras: Mapping[str, Camera]) -> dict[str, Camera]:
    if len(cameras) < 2:
        raise ParameterError("cameras", "must be at least two", len(cameras))
    named = {str(name): camera for name, camera in cameras.items()}
    (first_name, first), *others = named.items()
    for name, camera in others:
        pair = f"{format_value(first_name)} and {format_value(name)}"
        if part := different_part(first, camera):
            raise ParameterError("cameras", f"must have the same {part}: those of {pair} differ")
        if camera.gaze_deg != first.gaze_deg:
            raise ParameterError(
                "cameras", f"must have the same gaze_deg, since all see one image: those of {pair} differ"
            )
        if camera.sensor.filter_names != first.sensor.filter_names:
            raise ParameterError("cameras", f"must have the same colour filters: those of {pair} differ")
    return named


def _check_directions(cameras: Mapping[str, Camera]) -> None:
    """Raise ParameterError for cameras that turn towards points in panoramas, framed once."""
    for name, camera in cameras.items():
        if camera.axis == "sensor" and any(camera.gaze_um):
            raise ParameterError(
                "gaze_um",
                f"must be (0, 0) for panoramas and axis='sensor', but not that of {format_value(name)}; use 'gaze_deg'",
                camera.gaze_um,
                "µm",
            )


def _rate(frames_per_s: float | Mapping[str, float] | None, name: str, exposure_s: float) -> float:
    if frames_per_s is None:
        return 1.0 / exposure_s
    if isinstance(frames_per_s, Mapping):
        if name not in frames_per_s:
            raise ParameterError("frames_per_s", f"must have a rate for {format_value(name)}", list(frames_per_s))
        frames_per_s = frames_per_s[name]
    return check_number("frames_per_s", frames_per_s, above=0.0)
