"""
Captures of sensors that are larger than memory, in tiles.

A tile is a range of consecutive photosites. The spectra of the scene's images are in memory once; for each tile, the rows of
the power map under its sites are computed, integrated, exposed and released::

    capture = fs.tiles.write_tiles(
        "wafer.zarr", camera, scene, exposure_s=0.01, seed=0, progress=True
    )
    capture.code[:1000]  # a zarr array, read in parts

The draws of a site depend on its index in the layout, so that tiles have the noise of the complete capture, for any size of the
tiles. Layouts whose indices are in spatial order, such as rows or rings, need the fewest rows of the map per tile.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import Limits, publish
from foveasim._core.extras import import_optional
from foveasim._core.names import missing_path
from foveasim._core.provenance import differences, to_plain_data
from foveasim._core.random_streams import Streams
from foveasim._core.threads import cached_property
from foveasim._core.validation import check_count, read_only
from foveasim._io.formats import as_file_error
from foveasim._io.mapped_files import in_memory
from foveasim._io.resumable import LOCK, disk_errors, partial_path, resumable_directory
from foveasim._io.zarr_stores import ZARR, free_names, named_arrays, open_group, store_format
from foveasim.camera import Camera
from foveasim.camera._clock import Clock
from foveasim.camera._footprints import find_footprints, placed
from foveasim.camera._steps import WeightedMap, capture_rates, capture_settings, integrate_maps, white_dn
from foveasim.camera._warnings import Covered, warn_of_coarse_cells, warn_of_coverage, warn_of_focal_length
from foveasim.capture import Capture
from foveasim.columns import COLUMNS, STORED, column_info
from foveasim.errors import FileError, ParameterError
from foveasim.fields import Grid, PowerMap
from foveasim.integrate import Integrator, outline_bounds_um
from foveasim.layout import Layout
from foveasim.layout.packed import layout_from_arrays, layout_to_arrays
from foveasim.optics._imaging import MapRows, rows_of
from foveasim.reconstruct import ColourCorrection, Picture, raster_grid
from foveasim.scene import Scene
from foveasim.sensor import Sensor
from foveasim.sensor.blocks import BLOCK_SITES
from foveasim.sensor.limits import EXPOSURE

__all__ = ["TiledCapture", "capture_tiles", "read_tiles", "write_tiles"]

FORMAT, VERSION = "foveasim tiles", 1
#: Default number of sites per tile.
TILE_SITES = 1 << 22
#: Rows of the map around a tile: gradients of second-order integration need one, rounding of the bounds another.
MARGIN_ROWS = 2
#: Arrays of a tile that its capture has as attributes; the filter of a site follows from the layout. The last array of a store
#: marks complete tiles.
ARRAYS = tuple(name for name in STORED if name != "filter_of_site")
COMPLETE = "tile_is_complete"
LAYOUT, SENSOR = "layout", "sensor"
CODECS = ("bytes", "zstd")
#: Elements per chunk of the layout's arrays.
CHUNK = 1 << 22
#: Chunks of zeros are written too: missing ones indicate a corrupt store.
ALL_CHUNKS = {"write_empty_chunks": True}


# -- computation ------------------------------------------------------------------------------------------------------


class _Image(NamedTuple):
    """Grid of an image, and rows of its maps by filter; of a power map by band."""

    grid: Grid
    rows: Mapping[int, MapRows]


def capture_tiles(
    camera: Camera,
    light: Scene | PowerMap,
    *,
    exposure_s: Annotated[float, EXPOSURE],
    seed: int,
    frame: int = 0,
    tile_sites: Annotated[int, Limits(at_least=1)] = TILE_SITES,
    first_tile: int = 0,
) -> Iterator[Capture]:
    """
    Yield the captures of ranges of consecutive photosites, each computed on demand.

    Parameters
    ----------
    camera : Camera
        Its sensor must have no effects between sites (crosstalk, inter-pixel capacitance).
    light : Scene or PowerMap
        The array of a power map may be memory-mapped.
    exposure_s, seed, frame
        As for :meth:`foveasim.Camera.capture`.
    tile_sites : int
        Sites per tile, rounded up to a multiple of 65,536, the number of sites with a common random generator.
    first_tile : int
        Number of the first tile to compute.

    Yields
    ------
    Capture
        Of the layout ``camera.layout[first:last]``. Its settings are those of the camera; ``tile`` contains
        ``first_site`` and the number of sites of the complete layout. Fixed patterns, effects, codes and charges are those of
        ``camera.capture``, except for rounding of the irradiance.

    Raises
    ------
    ParameterError, SimulationError
        On the call, when an argument is out of range or the sensor has crosstalk; during iteration, as for a capture.

    Warns
    -----
    CoverageWarning
        After the last tile, as for a capture.
    FoveasimWarning
        Before the first tile, when the lens model contradicts the focal length of the optics, as for a capture.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor.from_preset(
    ...     fs.layout.grid(n_x=300, n_y=300, pitch_um=2.0), "machine_vision"
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=1500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> tiles = fs.tiles.capture_tiles(
    ...     camera, scene, exposure_s=0.001, seed=0, tile_sites=65_536
    ... )
    >>> [tile.code.size for tile in tiles]
    [65536, 24464]
    """
    streams = Streams(seed, frame)
    tile_sites = _whole_blocks(tile_sites)
    n_tiles = -(-camera.layout.n_sites // tile_sites)
    first_tile = check_count("first_tile", first_tile, at_least=0, at_most=n_tiles)
    camera.sensor.part(slice(0, 0))  # raises an error for sensors with crosstalk
    return _tiles(camera, light, exposure_s, streams, tile_sites, range(first_tile, n_tiles))


def _whole_blocks(tile_sites: int) -> int:
    return -(-tile_sites // BLOCK_SITES) * BLOCK_SITES


def _tiles(
    camera: Camera, source: Scene | PowerMap, exposure_s: float, streams: Streams, tile_sites: int, tiles: range
) -> Iterator[Capture]:
    layout, light = camera.layout, camera.light_at_gaze(source)
    lens = camera.lens_for(light)
    if isinstance(light, Scene):
        warn_of_focal_length(camera.optics, camera.distortion, light)
    images = _images(camera, light)
    coverages = []
    smallest_grid = min((image.grid for image in images), key=lambda grid: grid.cell_area_um2)
    for tile in tiles:
        first, last = tile * tile_sites, min((tile + 1) * tile_sites, layout.n_sites)
        clock = Clock()
        with clock.stage("compile layout"):
            sensor = camera.sensor.part(slice(first, last))
            sites = layout[first:last]
            footprints = find_footprints(camera, sites, sensor.pixel_optics, light, camera.position_um)
            part = placed(sites, footprints, camera.position_um)
            bounds_um = outline_bounds_um(part, lens)
            strips = [_rows_under(image.grid, bounds_um) for image in images]
            integrators = [
                Integrator(
                    part,
                    _strip(image.grid, *rows),
                    distortion=lens,
                    order=camera.order(light),
                    compiled=False,
                    n_threads=camera.n_threads,
                )
                for image, rows in zip(images, strips, strict=True)
            ]
        if footprints is None or footprints.outlines is None:
            smallest = min(integrators, key=lambda integrator: integrator.grid.cell_area_um2)
            coverages.append(Covered.by(smallest))
        else:
            sites = placed(sites, None, camera.position_um)
            own_um = outline_bounds_um(sites, lens)
            coverages.append(Covered.of(sites, own_um, smallest_grid, lens, camera.n_threads))
        maps = _maps(sensor, light, images, strips, clock)
        rate_e_per_s = integrate_maps(sensor, light, maps, integrators, clock, footprints)
        # Arrays per site are those of all sites, as in a stored capture.
        about = {"first_site": first, "n_sites": layout.n_sites}
        part_streams = Streams(streams.seed, streams.frame, first // BLOCK_SITES)
        yield capture_rates(camera, sensor, light, rate_e_per_s, exposure_s, part_streams, clock, tile=about)
    if coverages:
        gaze_um = camera.gaze_um if any(camera.gaze_um) else None
        warn_of_coverage(source, Covered.union(smallest_grid.bounds_um, coverages), layout.n_sites, gaze_um)


def _images(camera: Camera, light: Scene | PowerMap) -> list[_Image]:
    """Return the images of a scene, whose maps are computed in rows, or a power map."""
    if isinstance(light, PowerMap):
        return [_Image(light.grid, {band: partial(rows_of, cells) for band, cells in enumerate(light.data)})]
    used = camera.sensor.filters_used
    e_per_j = camera.sensor.responsivity_e_per_j(light.wavelength_nm)[used]
    optics, frame = camera.optics.resolve_oversample(light), camera.sensor_frame(light)
    warn_of_coarse_cells(camera.optics, light, camera.layout)
    return [
        _Image(
            frame.image(grid),
            dict(
                zip(
                    used.tolist(),
                    optics.weighted_rows(light, e_per_j * is_in_image, grid=grid, n_threads=camera.n_threads),
                    strict=True,
                )
            ),
        )
        for grid, is_in_image in optics.image_grids(light)
    ]


def _rows_under(grid: Grid, bounds_um: tuple[float, float, float, float]) -> tuple[int, int]:
    """Return the first row of the map under a tile and the row after the last one."""
    n_y = grid.shape[0]
    y_um = np.array([bounds_um[1], bounds_um[3]])
    if np.isnan(y_um).any():  # all sites are outside the image circle
        return 0, 1
    low, high = (y_um - grid.origin_um[1]) / grid.pitch_y_um
    first = int(np.clip(np.floor(low) - MARGIN_ROWS, 0, n_y - 1))
    return first, int(np.clip(np.ceil(high) + MARGIN_ROWS, first + 1, n_y))


def _strip(grid: Grid, first: int, last: int) -> Grid:
    """Return the rows ``first`` to ``last - 1`` of a grid."""
    x_um, y_um = grid.origin_um
    return Grid((last - first, grid.shape[1]), grid.pitch_um, (x_um, y_um + first * grid.pitch_y_um))


def _maps(
    sensor: Sensor, light: Scene | PowerMap, images: Iterable[_Image], strips: Iterable[tuple[int, int]], clock: Clock
) -> Iterator[WeightedMap]:
    """Yield the rows of all maps under a tile, each with its sites and their weights."""
    e_per_j = sensor.responsivity_e_per_j(light.wavelength_nm)
    for k, (image, strip) in enumerate(zip(images, strips, strict=True)):
        for c, rows in image.rows.items():
            if isinstance(light, PowerMap):
                yield WeightedMap(k, rows(*strip), None, e_per_j[sensor.filter_of_site, c])
            elif c in sensor.sites_of_filter:
                with clock.stage("optics"):
                    cells = rows(*strip)
                yield WeightedMap(k, cells, sensor.sites_of_filter[c], None)
                del cells


# -- stores -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TiledCapture:
    """
    A capture in a zarr store, read in parts.

    Attributes
    ----------
    columns : mapping of str to zarr array (n_site,)
        Columns of the photosites, as those of :class:`foveasim.Capture`, with the registered ones that tables contain:
        ``capture.columns["code"][first:last]``, in short ``capture.code[first:last]``, reads the chunks of these sites only.
    tile_sites : int
        Sites per tile and per chunk.
    filter_names : tuple of str
    bits : int
    white_dn : (n_filter,) float64, DN
    settings : dict
    path : Path
    """

    columns: Mapping[str, Any]
    tile_sites: int
    filter_names: tuple[str, ...]
    bits: int
    white_dn: NDArray[np.float64]
    settings: Mapping[str, Any]
    path: Path

    def __repr__(self) -> str:
        return f"TiledCapture({self.n_sites:,} sites in {self.n_tiles} tiles, {self.bits} bits, {self.path.name!r})"

    @property
    def code(self) -> Any:
        """Digital values, zarr array (n_site,) uint8 or uint16, DN."""
        return self.columns["code"]

    @property
    def electrons(self) -> Any:
        """Collected charge, zarr array (n_site,) int64, e-."""
        return self.columns["electrons"]

    @property
    def expected_e(self) -> Any:
        """Expected charge, zarr array (n_site,) float64, e-."""
        return self.columns["expected_e"]

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return int(self.code.shape[0])

    @property
    def n_tiles(self) -> int:
        """Number of tiles."""
        return -(-self.n_sites // self.tile_sites)

    @cached_property
    def layout(self) -> Layout:
        """
        The layout of all sites, read at the first access.

        Raises
        ------
        FileError
            When the store is corrupt.
        """
        with _open(self.path) as group:
            arrays = {name: values[:] for name, values in _layout_arrays(group).items()}
            return layout_from_arrays(arrays, group.attrs["provenance"])

    @cached_property
    def _sensor(self) -> Sensor | None:
        """Sensor of the settings, without filters and quantum efficiency; None if unknown."""
        with _open(self.path) as group:
            arrays = {name: array[:] for name, array in group[SENSOR].arrays()} if SENSOR in group else {}
        try:
            return Sensor.from_settings(self.layout, self.settings["sensor"], arrays)
        except ParameterError:  # the capture of a tile explains it
            return None

    def tile(self, number: int) -> Capture:
        """
        Read a tile.

        Raises
        ------
        FileError
            When the store is corrupt.
        """
        number = check_count("number", number, at_least=0, at_most=self.n_tiles - 1)
        first, last = number * self.tile_sites, min((number + 1) * self.tile_sites, self.n_sites)
        with as_file_error(self.path, "tiled capture"):
            sensor = None if self._sensor is None else self._sensor.part(slice(first, last))
            layout = self.layout[first:last] if sensor is None else sensor.layout
            return Capture(
                layout=layout,
                electronics=sensor,
                **{name: self.columns[name][first:last] for name in ARRAYS},
                filter_of_site=layout.channel.astype(np.min_scalar_type(-len(self.filter_names)))
                if len(self.filter_names) > 1
                else np.zeros(layout.n_sites, np.int8),
                filter_names=self.filter_names,
                bits=self.bits,
                white_dn=self.white_dn,
                settings=dict(self.settings) | {"tile": {"first_site": first, "n_sites": self.n_sites}},
            )

    def __iter__(self) -> Iterator[Capture]:
        """Read all tiles, one after another."""
        return map(self.tile, range(self.n_tiles))

    def picture(self, *, max_pixels: int = 1024) -> Picture:
        """
        Return an overview: the mean code of the sites in each pixel, per filter.

        Parameters
        ----------
        max_pixels : int
            Pixels along the longer side. A site belongs to the pixel that contains its centroid; pixels without sites are NaN.
            For pixels that are smaller than sites, use ``tile(number).picture()``.
        """
        grid = raster_grid(self.layout, max_pixels)
        n_y, n_x = grid.shape
        n_filters = len(self.filter_names)
        total, count = np.zeros((2, n_filters * n_y * n_x))
        for capture in self:
            xy_um = capture.layout.centroid_um - np.array(grid.origin_um)
            column, row = (np.clip(xy_um[:, k] // grid.pitch_xy_um[k], 0, (n_x, n_y)[k] - 1) for k in (0, 1))
            pixel = ((capture.filter_of_site.astype(np.int64) * n_y + row) * n_x + column).astype(np.int64)
            total += np.bincount(pixel, capture.code, total.size)
            count += np.bincount(pixel, minlength=count.size)
        n_sites = count.reshape(n_filters, n_y, n_x)
        data = total.reshape(n_sites.shape) / np.where(n_sites > 0.0, n_sites, np.nan)
        coverage = np.asarray(n_sites.any(axis=0), np.float32)
        colour = ColourCorrection.from_settings(self.settings)
        matrix = None if colour is None else colour.matrix
        return Picture(np.asarray(data, np.float32), coverage, grid, white=self.white_dn, colour_matrix=matrix)


def write_tiles(
    path: str | Path,
    camera: Camera,
    light: Scene | PowerMap,
    *,
    exposure_s: Annotated[float, EXPOSURE],
    seed: int,
    frame: int = 0,
    tile_sites: Annotated[int, Limits(at_least=1)] = TILE_SITES,
    progress: bool = False,
) -> TiledCapture:
    """
    Write a capture to a zarr store, tile by tile, and return it.

    The same call resumes an interrupted capture at the first missing tile, and reads a finished one. Unfinished captures are in
    the directory ``<path>.partial``; the memory contains one tile and the spectra of the scene.

    Parameters
    ----------
    path : path
        Directory that ends in ``.zarr``; xarray opens the finished store.
    camera, light, exposure_s, seed, frame, tile_sites
        As for :func:`capture_tiles`.
    progress : bool
        Whether to show a progress bar with the remaining time.

    Raises
    ------
    FileError
        When zarr is missing, the path contains other data or another capture, or it cannot be written, for example on a full
        disk.
    ParameterError, SimulationError
        As for :func:`capture_tiles`.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> sensor = fs.Sensor.from_preset(
    ...     fs.layout.grid(n_x=20, n_y=20, pitch_um=3.0), "machine_vision"
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=400.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     fs.tiles.write_tiles(
    ...         Path(directory, "wall.zarr"), camera, scene, exposure_s=0.001, seed=0
    ...     )
    TiledCapture(400 sites in 1 tiles, 12 bits, 'wall.zarr')
    """
    target = Path(path)
    if target.suffix.lower() != ZARR:
        raise FileError(target, "must end in .zarr")
    zarr = import_optional(target, "zarr")
    start = partial(capture_tiles, camera, light, exposure_s=exposure_s, seed=seed, frame=frame, tile_sites=tile_sites)
    start()  # checks the arguments
    plan = _plan(camera, light, exposure_s, Streams(seed, frame), _whole_blocks(tile_sites))
    layout = camera.layout
    if not layout.n_sites:
        raise ParameterError("camera", "must have a layout with photosites")
    if target.exists():
        _require_same(target, plan, layout)
        return read_tiles(target)
    with resumable_directory(target, "tiled capture", is_ours=_is_tiles, has_content=_count_complete) as unfinished:
        directory = unfinished.directory
        n_complete = _count_complete(directory)
        if n_complete:
            _require_same(directory, plan, layout)
        else:
            with disk_errors(target):
                _create(directory, camera, light, plan)
        tiles: Iterable[Capture] = start(first_tile=n_complete)
        if progress:
            from foveasim._io.terminal import with_progress

            tiles = with_progress(tiles, "tiles", -(-layout.n_sites // plan["tile_sites"]), n_complete)
        try:
            # Arrays have the configuration that is set when they are opened.
            configuration = zarr.config.set({f"array.{name}": value for name, value in ALL_CHUNKS.items()})
            with configuration, _open(directory, "r+", is_finished=False) as group:
                arrays = {name: group[name] for name in (*_names(group), COMPLETE)}
            for capture in tiles:
                with disk_errors(target):
                    _add(arrays, n_complete, capture)
                n_complete += 1
            with disk_errors(target):
                unfinished.finish(target)
        except BaseException as error:
            if n_complete:
                error.add_note(f"{n_complete:,} tiles are stored in {directory}; the same call resumes the capture")
            raise
    return read_tiles(target)


def read_tiles(path: str | Path) -> TiledCapture:
    """
    Open a capture of :func:`write_tiles`; its arrays are read in parts.

    Raises
    ------
    FileError
        When zarr is missing, or the store is missing, corrupt or incomplete, or not a tiled capture.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> sensor = fs.Sensor.from_preset(
    ...     fs.layout.grid(n_x=20, n_y=20, pitch_um=3.0), "machine_vision"
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=400.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     _ = fs.tiles.write_tiles(
    ...         Path(directory, "wall.zarr"), camera, scene, exposure_s=0.001, seed=0
    ...     )
    ...     print(fs.tiles.read_tiles(Path(directory, "wall.zarr")).code[100:104].dtype)
    uint16
    """
    source = Path(path)
    if not source.is_dir():
        unfinished = partial_path(source)
        hint = f"; {unfinished.name} is unfinished: call write_tiles again" if unfinished.is_dir() else ""
        raise FileError(source, missing_path(source, "zarr store") + hint)
    with _open(source) as group:
        about = dict(group.attrs)
        return TiledCapture(
            columns={name: group[name] for name in _names(group)},
            tile_sites=int(about["plan"]["tile_sites"]),
            filter_names=tuple(about["filter_names"]),
            bits=int(about["bits"]),
            white_dn=read_only(np.asarray(about["white_dn"], np.float64)),
            settings=about["plan"]["settings"],
            path=source,
        )


def _plan(
    camera: Camera, light: Scene | PowerMap, exposure_s: float, streams: Streams, tile_sites: int
) -> dict[str, Any]:
    """Return plain data that identify a tiled capture; arrays of the light as checksums."""
    settings = capture_settings(camera, light, exposure_s, streams)
    checksum = 0
    for plane in light.data if isinstance(light, PowerMap) else light.basis:
        for first in range(0, plane.shape[0], 256):
            checksum = crc32(np.ascontiguousarray(in_memory(plane[first : first + 256])).data, checksum)
    n_sites = camera.layout.n_sites
    plan = {"settings": settings, "light_crc32": checksum, "n_sites": n_sites, "tile_sites": tile_sites}
    found: dict[str, Any] = json.loads(json.dumps(plan))
    return found


def _create(directory: Path, camera: Camera, light: Scene | PowerMap, plan: Mapping[str, Any]) -> None:
    """Create the arrays of a store, and write the layout."""
    for path in directory.iterdir():  # of a capture that was interrupted before its first tile
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()
    sensor, layout = camera.sensor, camera.layout
    outlines = layout_to_arrays(layout, is_compact=True)
    names = free_names(outlines)
    attributes = {
        "format": FORMAT,
        "version": VERSION,
        "filter_names": list(sensor.filter_names),
        "bits": sensor.bits,
        "white_dn": white_dn(sensor, light).tolist(),
        "provenance": to_plain_data(dict(layout.provenance)),
        "plan": plan,
        "columns": [name for name in COLUMNS if name not in STORED and column_info(name).in_tables],
        "layout": names,
    }
    group = import_optional(directory, "zarr").create_group(str(directory), zarr_format=3, attributes=attributes)
    n_sites, tile_sites = layout.n_sites, plan["tile_sites"]
    for name in _names(group):
        group.create_array(
            name,
            shape=(n_sites,),
            chunks=(tile_sites,),
            dtype="u1" if name == "code" and sensor.bits <= 8 else column_info(name).dtype,
            dimension_names=("site",),
            config=ALL_CHUNKS,
        )
    n_tiles = -(-n_sites // tile_sites)
    group.create_array(COMPLETE, shape=(n_tiles,), chunks=(1,), dtype="u1", dimension_names=("tile",), fill_value=0)
    renamed = {names[name]: values for name, values in outlines.items()}
    for name, stored in ((LAYOUT, renamed), (SENSOR, sensor.arrays)):
        parts = group.create_group(name)
        for key, values in stored.items():
            chunks = (max(1, min(CHUNK, values.shape[0])), *values.shape[1:])
            array = parts.create_array(key, shape=values.shape, chunks=chunks, dtype=values.dtype, config=ALL_CHUNKS)
            for first in range(0, values.shape[0], chunks[0]):
                array[first : first + chunks[0]] = values[first : first + chunks[0]]


def _add(arrays: Mapping[str, Any], tile: int, capture: Capture) -> None:
    """Write a tile; its mark is written last."""
    first = capture.settings["tile"]["first_site"]
    for name in arrays.keys() - {COMPLETE}:
        arrays[name][first : first + capture.layout.n_sites] = capture.column(name)
    arrays[COMPLETE][tile] = 1


def _names(group: Any) -> tuple[str, ...]:
    """Return the names of the columns that were registered when a store was created."""
    return (*ARRAYS, *map(str, group.attrs.get("columns", ())))


def _layout_arrays(group: Any) -> dict[str, Any]:
    """Return the stored arrays of a layout, by the names of :func:`layout_to_arrays`."""
    return named_arrays(group[LAYOUT], group.attrs.get("layout"))


@contextmanager
def _open(source: Path, mode: str = "r", *, is_finished: bool = True) -> Iterator[Any]:
    """Open the group of an untrusted store; exceptions of the block become FileErrors."""
    with open_group(source, "tiled capture", CODECS, FORMAT, VERSION, mode) as group:
        arrays = {name: group[name] for name in _names(group)} if is_finished else {}
        parts = [part for part in (LAYOUT, SENSOR) if part in group]
        arrays |= {f"{part}/{name}": array for part in parts for name, array in group[part].arrays()}
        for name, array in arrays.items():
            # A missing chunk would be read as 0, and a few bytes of metadata can claim any size.
            n_chunks = sum(1 for file in (source / name / "c").rglob("*") if file.is_file())
            if n_chunks != int(np.prod(array.cdata_shape)) and array.size:
                raise FileError(source, f"is corrupt: '{name}' is incomplete")
        yield group


def _is_tiles(directory: Path) -> bool:
    return store_format(directory) == FORMAT


def _count_complete(directory: Path) -> int:
    """Return the number of complete tiles at the beginning of an unfinished capture."""
    if not (directory / COMPLETE / "zarr.json").exists():
        return 0
    with _open(directory, is_finished=False) as group:
        is_complete = group[COMPLETE][:] == 1
    return is_complete.size if is_complete.all() else int(np.argmin(is_complete))


def _require_same(directory: Path, plan: Mapping[str, Any], layout: Layout) -> None:
    """Reject a store with another plan or layout."""
    if not _is_tiles(directory):
        raise FileError(directory, "cannot be written: the path contains other data; choose another path")
    with _open(directory, is_finished=False) as group:
        different = next(iter(differences(group.attrs["plan"], dict(plan))), None)
        if different is None and not _is_same_layout(group, layout):
            different = "layout"
    if different is not None:
        raise FileError(
            directory, f"is another capture: '{different}' differs; choose another path, or delete that capture"
        )


def _is_same_layout(group: Any, layout: Layout) -> bool:
    arrays, stored = layout_to_arrays(layout, is_compact=True), _layout_arrays(group)
    if stored.keys() != arrays.keys():
        return False
    return all(
        stored[name].shape == values.shape
        and all(
            np.array_equal(stored[name][first : first + CHUNK], values[first : first + CHUNK])
            for first in range(0, values.shape[0], CHUNK)
        )
        for name, values in arrays.items()
    )


publish(__name__)
