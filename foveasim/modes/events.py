"""Events of photosites: times, sites and polarities, as arrays and files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FINITE, POSITIVE, OwnCheck
from foveasim._core.extras import import_optional
from foveasim._core.provenance import to_plain_data
from foveasim._core.validation import Floats, Ints, as_numbers, finite_array, frozen_array, read_only
from foveasim._io.atomic import atomic_write, check_free_space
from foveasim._io.formats import as_file_error
from foveasim._io.npz import open_archive, write_archive
from foveasim.errors import FileError, FoveasimWarning, ParameterError, type_name, warn
from foveasim.layout.model import Layout
from foveasim.layout.packed import OUTLINES, layout_from_arrays, layout_to_arrays
from foveasim.modes import _hdf5
from foveasim.modes._addresses import (
    MAX_ADDRESS,
    addresses_from_columns,
    addresses_on_raster,
    count_distinct,
    pixel_grid,
    sites_at,
    too_many_addresses,
)
from foveasim.modes._event_files import TimeUnit, read_recording

__all__ = ["Events", "write_events"]

FORMAT, VERSION = "foveasim events", 1
HDF5_EXTENSIONS = (".h5", ".hdf5")
#: Addresses of structured arrays are signed 16-bit integers.
MAX_SIGNED_ADDRESS = 2**15 - 1
#: Event record of event tools: address, time in µs, and polarity (true for ON).
STRUCTURE = np.dtype([("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")])
#: Above this time float64 does not resolve microseconds.
MAX_T_S = 2.0**53 / 1e6
#: Size limit of histograms.
MAX_COUNTS = 1 << 30
POLARITIES = (1, -1)
#: Time 0 of events from files.
Origin = Literal["file", "first_event"]
ARRAYS = ("t_s", "site", "polarity")


@dataclass(frozen=True, eq=False)
class Events:
    """
    Events of photosites in temporal order.

    Parameters
    ----------
    t_s : (n_event,) float64, s
        Times, at least 0 and in ascending order; simultaneous events are in the order of their sites.
    site : (n_event,) int32
        Indices of the photosites.
    polarity : (n_event,) int8
        1 for ON, -1 for OFF events; 1 for spikes.
    layout : Layout
        Layout of the photosites.

    Raises
    ------
    ParameterError
        When times are not in ascending order, a site is not in the layout, or a polarity is neither 1 nor -1.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout, polarity = fs.layout.grid(2, 1, 3.0), np.array([1, -1], np.int8)
    >>> events = fs.modes.Events(
    ...     t_s=np.array([0.1, 0.2]),
    ...     site=np.array([0, 1]),
    ...     polarity=polarity,
    ...     layout=layout,
    ... )
    >>> events.histogram([0.0, 0.15, 0.3]).tolist()
    [[1, 0], [0, 1]]
    """

    t_s: Floats
    site: NDArray[np.int32]
    polarity: NDArray[np.int8]
    layout: Layout

    def __post_init__(self) -> None:
        t_s, site, polarity = (as_numbers(name, getattr(self, name), keep_type=True) for name in ARRAYS)
        for name, values, kind in zip(ARRAYS, (t_s, site, polarity), (np.float64, np.int64, np.int64), strict=True):
            if values.ndim != 1 or values.size != t_s.size:
                raise ParameterError(name, f"must be one number for each of {t_s.size} times, got {values.shape}")
            if values.size and not np.can_cast(values.dtype, kind, "same_kind"):
                raise ParameterError(name, f"must be integers, got {values.dtype}")
        if t_s.size:
            # Written so that NaN fails the comparison.
            if not (t_s[0] >= 0.0 and np.all(t_s[1:] >= t_s[:-1]) and t_s[-1] < np.inf):
                raise ParameterError(
                    "t_s", "must be finite, at least 0, and ascending", t_s, "s", "sort the events by time"
                )
            n_sites = self.layout.n_sites
            if site.min() < 0 or site.max() >= n_sites:
                bad = site[(site < 0) | (site >= n_sites)]
                raise ParameterError("site", f"must be from 0 to {n_sites - 1}, the sites of the layout", int(bad[0]))
            if not np.all(np.abs(polarity) == 1):
                bad = polarity[np.abs(polarity) != 1]
                raise ParameterError("polarity", "must be 1 or -1", int(bad[0]), hint="convert 0 and 1 with 2 * p - 1")
        for name, values, dtype in zip(ARRAYS, (t_s, site, polarity), (np.float64, np.int32, np.int8), strict=True):
            object.__setattr__(self, name, frozen_array(values.astype(dtype, copy=False)))

    def __repr__(self) -> str:
        return f"Events({self.t_s.size:,} of {self.layout.n_sites:,} sites)"

    def __len__(self) -> int:
        """Number of events."""
        return int(self.t_s.size)

    def counts(self, *, polarity: OwnCheck[int | None] = None) -> Ints:
        """Return the number of events per site, (n_site,), of one polarity or both."""
        sites = self.site if polarity is None else self.site[self._has_polarity(polarity)]
        return np.bincount(sites, minlength=self.layout.n_sites).astype(np.int64)

    def histogram(self, edges_s: ArrayLike, *, polarity: OwnCheck[int | None] = None) -> Ints:
        """
        Return the number of events per time bin and site.

        Parameters
        ----------
        edges_s : (n_bin + 1,) float64, s
            Bin edges in ascending order; bins include their lower edge, as in :meth:`between`.
        polarity : {1, -1}, optional
            Count events of one polarity; by default of both.

        Returns
        -------
        counts : (n_bin, n_site) int64

        Raises
        ------
        ParameterError
            When edges are not in ascending order, or the counts do not fit in memory.
        """
        edges = finite_array("edges_s", edges_s, ndim=1)
        if edges.size < 2 or np.any(np.diff(edges) <= 0.0):
            raise ParameterError("edges_s", "must be two or more times in ascending order", edges, "s")
        n_bins, n_sites = edges.size - 1, self.layout.n_sites
        if n_bins * n_sites > MAX_COUNTS:
            raise ParameterError(
                "edges_s",
                f"must give counts that fit in memory, got {n_bins:,} bins of {n_sites:,} sites; use fewer bins",
            )
        ends = np.searchsorted(self.t_s, edges)
        span = slice(ends[0], ends[-1])
        cell = np.repeat(n_sites * np.arange(n_bins), np.diff(ends)) + self.site[span]
        if polarity is not None:
            cell = cell[self._has_polarity(polarity)[span]]
        return np.bincount(cell, minlength=n_bins * n_sites).astype(np.int64).reshape(n_bins, n_sites)

    def _has_polarity(self, polarity: int) -> NDArray[np.bool_]:
        if polarity not in POLARITIES:
            raise ParameterError("polarity", "must be 1 or -1", polarity)
        return np.asarray(self.polarity == polarity)

    def between(self, start_s: Annotated[float, FINITE], stop_s: Annotated[float, FINITE]) -> Events:
        """Return the events with ``start_s <= t_s < stop_s``."""
        part = slice(*np.searchsorted(self.t_s, (start_s, stop_s)))
        return Events(self.t_s[part], self.site[part], self.polarity[part], self.layout)

    @classmethod
    def concatenate(cls, parts: OwnCheck[Iterable[Events]]) -> Events:
        """Concatenate consecutive batches of events."""
        batches = list(_check_consecutive("parts", parts))
        if not batches:
            raise ParameterError("parts", "must contain at least one batch of events")
        t_s, site, polarity = (read_only(np.concatenate([getattr(b, name) for b in batches])) for name in ARRAYS)
        return cls(t_s, site, polarity, batches[0].layout)

    @classmethod
    def from_addresses(
        cls,
        t_s: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        polarity: ArrayLike,
        layout: Layout,
        *,
        pitch_um: Annotated[float | None, POSITIVE] = None,
    ) -> Events:
        """
        Create events from column and row addresses: the inverse of :meth:`addresses`.

        Parameters
        ----------
        t_s : (n_event,) float64, s
            Times in ascending order.
        x, y : (n_event,) int
            Column and row of each event; row 0 is the top row.
        polarity : (n_event,) int
            1 or -1.
        layout : Layout
            Layout of the photosites: ``foveasim.layout.grid(n_x=640, n_y=480, pitch_um=...)`` for a recording of 640 x 480
            pixels.
        pitch_um : float, optional, µm
            As in :meth:`addresses`.

        Raises
        ------
        ParameterError
            When an address does not have exactly one site; and as for the class.
        """
        empty = np.zeros(0)
        site_x, site_y = cls(empty, empty.astype(np.int32), empty.astype(np.int8), layout).addresses(pitch_um)
        addresses = [as_numbers(name, values, keep_type=True) for name, values in (("x", x), ("y", y))]
        for name, values in zip("xy", addresses, strict=True):
            if (
                values.ndim != 1
                or values.shape != addresses[0].shape
                or (values.size and values.dtype.kind not in "iu")
            ):
                raise ParameterError(name, f"must be one integer per event, got {values.dtype}{values.shape}")
            if values.size and not 0 <= values.min() <= values.max() <= MAX_ADDRESS:
                raise ParameterError(name, f"must be from 0 to {MAX_ADDRESS}", (int(values.min()), int(values.max())))
        target = tuple(values.astype(np.int64) for values in addresses)
        return cls(t_s, sites_at((site_x, site_y), target), polarity, layout)  # type: ignore[arg-type]

    def addresses(
        self, pitch_um: Annotated[float | None, POSITIVE] = None
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """
        Return column and row of every site on a raster, for tools that require pixel addresses.

        Parameters
        ----------
        pitch_um : float, optional, µm
            Pitch of the raster. By default the columns ``column`` and ``row`` of the layout are the addresses if they are
            unique; otherwise the raster is so fine that sites with different centres have different addresses. Row 0 is the top
            row, as in pictures.

        Returns
        -------
        x, y : (n_site,) uint16

        Warns
        -----
        FoveasimWarning
            When several sites have the same address.
        """
        addresses = addresses_from_columns(self.layout) if pitch_um is None else None
        if addresses is None:
            addresses = addresses_on_raster(self.layout, pitch_um)
        n_distinct = count_distinct(*addresses)
        if n_distinct < self.layout.n_sites:
            warn(
                f"{self.layout.n_sites:,} sites have only {n_distinct:,} addresses on the raster; use a smaller 'pitch_um', "
                "or identify sites by their indices",
                FoveasimWarning,
            )
        return addresses[0].astype(np.uint16), addresses[1].astype(np.uint16)

    def to_structured_array(self, *, pitch_um: Annotated[float | None, POSITIVE] = None) -> NDArray[Any]:
        """
        Return the events as a structured array for event tools such as Tonic.

        Parameters
        ----------
        pitch_um : float, optional, µm
            As in :meth:`addresses`.

        Returns
        -------
        events : (n_event,) structured
            Fields ``x`` and ``y`` (int16, row 0 is the top row), ``t`` (int64, µs, rounded down) and ``p`` (bool, true for ON).

        Raises
        ------
        ParameterError
            When an address or a time does not fit the data type.
        """
        x, y = self.addresses(pitch_um)
        if max(x.max(initial=0), y.max(initial=0)) > MAX_SIGNED_ADDRESS:
            raise too_many_addresses(pitch_um, MAX_SIGNED_ADDRESS, "int16")
        events = np.empty(len(self), STRUCTURE)
        events["x"], events["y"] = x[self.site], y[self.site]
        events["t"], events["p"] = _to_us(self.t_s), self.polarity > 0
        return events

    def save(self, path: str | Path, *, pitch_um: Annotated[float | None, POSITIVE] = None) -> None:
        """
        Write the events to a file atomically.

        Parameters
        ----------
        path : path
            The extension selects the format. ``.npz``: arrays and layout, lossless. ``.h5`` or ``.hdf5``: as
            :func:`write_events`. :meth:`load` reads both. Formats for other tools, without the layout: ``.npy``, the array of
            :meth:`to_structured_array`; ``.txt``, a line ``t x y p`` per event, with t in seconds and p 0 or 1.
        pitch_um : float, optional, µm
            Pitch of the raster of :meth:`addresses`, for all formats except ``.npz``.

        Raises
        ------
        FileError
            When the extension is not one of these, h5py is not installed, or the file cannot be written.
        """
        target = Path(path)
        extension = target.suffix.lower()
        if extension in HDF5_EXTENSIONS:
            write_events([self], target, pitch_um=pitch_um)
        elif extension == ".npy":
            events = self.to_structured_array(pitch_um=pitch_um)
            with atomic_write(target) as temporary, temporary.open("wb") as file:
                np.save(file, events, allow_pickle=False)
        elif extension == ".txt":
            x, y = self.addresses(pitch_um)
            rows = np.stack((self.t_s, x[self.site], y[self.site], self.polarity > 0), axis=1)
            with atomic_write(target) as temporary:
                np.savetxt(temporary, rows, fmt=("%.9f", "%d", "%d", "%d"))
        elif extension == ".npz":
            arrays = {name: np.asarray(getattr(self, name)) for name in ARRAYS}
            about = {"format": FORMAT, "version": VERSION, "provenance": to_plain_data(dict(self.layout.provenance))}
            write_archive(target, about, arrays | layout_to_arrays(self.layout))
        else:
            raise FileError(target, "must end in .npz, .h5, .hdf5, .npy or .txt")

    @classmethod
    def load(cls, path: str | Path) -> Events:
        """
        Read events from ``.npz`` or HDF5 files of :meth:`save` or :func:`write_events`.

        Times from HDF5 are rounded down to microseconds.

        Raises
        ------
        FileError
            When the file is missing, corrupt, or does not contain events.
        """
        source = Path(path)
        if source.suffix.lower() in HDF5_EXTENSIONS:
            import_optional(source, "h5py")
            if not source.is_file():
                raise FileError(source, "is not a file" if source.exists() else "no such file")
            with as_file_error(source, "event file"):
                return cls(*_hdf5.read_events(source))
        with open_archive(source, "event file", FORMAT, VERSION) as (about, arrays):
            layout = layout_from_arrays(arrays, about.get("provenance", {}))
            return cls(arrays["t_s"], arrays["site"], arrays["polarity"], layout)

    @classmethod
    def read(
        cls,
        path: str | Path,
        layout: Layout | None = None,
        *,
        pitch_um: Annotated[float | None, POSITIVE] = None,
        time_unit: TimeUnit | None = None,
        origin: Origin = "file",
        ignore: Sequence[str] = (),
    ) -> Events:
        """
        Read events of other programs, or those that :meth:`save` wrote.

        Parameters
        ----------
        path : path
            The content selects the format: RAW of Prophesee with EVT 2.0, 2.1 or 3.0; DAT; AEDAT 2 (DAVIS 240 and 346, DVS
            640) and AEDAT 4 (needs the extra ``events``); HDF5 as of DSEC, v2e and Metavision; ``.npy`` with the fields t, x,
            y and p; text with lines ``t x y p``; ``.npz`` and HDF5 of this package, with their layout.
        layout : Layout, optional
            Layout with one site for each pixel (see :meth:`from_addresses`), whose row 0 is the top row. By default a grid of
            the sensor size that the file states.
        pitch_um : float, optional, µm
            Pixel pitch, which files do not contain: of the grid, or of the addresses of a ``layout``.
        time_unit : {"s", "ms", "us", "ns"}, optional
            Unit of the times in text and ``.npy`` files. By default µs in arrays of integers, and seconds in text with
            decimals. All other formats have µs.
        origin : {"file", "first_event"}
            Time 0: that of the clock of the file, or the first event. Clocks may begin when the camera is switched on (RAW), or
            in 1970 (AEDAT 4); DSEC's ``t_offset`` is added.
        ignore : sequence of str
            Names of headers or arrays that are not known and do not change the events.

        Returns
        -------
        Events
            In the order of their times. ON events are 1, OFF events -1.

        Raises
        ------
        FileError
            When the file is damaged, of another format, or contains what is not understood.
        ParameterError
            When neither a layout nor a pitch and the size of the sensor are known, or an event has no site.

        Notes
        -----
        External triggers, words of vendors, frames and samples of inertial sensors are no events of sites, and are not read.
        Times of EVT 2.0, EVT 3.0 and DAT begin anew after 2^34, 2^24 and 2^32 µs; they continue here. Events before the first
        time of RAW files have no time, and are skipped, as by Metavision.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> import foveasim as fs
        >>> with tempfile.TemporaryDirectory() as directory:
        ...     path = Path(directory, "events.txt")
        ...     _ = path.write_text("0.001 1 0 0")
        ...     events = fs.modes.Events.read(path, fs.layout.grid(n_x=2, n_y=1, pitch_um=5.0))
        >>> events.t_s.tolist(), events.site.tolist(), events.polarity.tolist()
        ([0.001], [1], [-1])
        """
        source = Path(path)
        if _is_own_file(source):
            if layout is not None or pitch_um is not None:
                name, value = ("layout", layout) if layout is not None else ("pitch_um", pitch_um)
                raise ParameterError(name, "must not be given for files with their layout", value, hint="omit it")
            return _with_origin(cls.load(source), origin)
        shape = None if layout is None else _raster_shape(layout, pitch_um)
        found = read_recording(source, time_unit=time_unit, ignore=tuple(ignore), shape=shape)
        t_s = found.t_us / 1e6
        if layout is None:
            if found.shape is None or pitch_um is None:
                size = "the file does not state the size of the sensor"
                if found.shape is not None:
                    size = f"the sensor has {found.shape[1]} x {found.shape[0]} pixels; or pass pitch_um="
                raise ParameterError("layout", f"must be given for {source.name}: {size}")
            layout, pitch_um = pixel_grid(found.shape, pitch_um), None
        polarity = np.where(found.is_on, np.int8(1), np.int8(-1))
        return _with_origin(cls.from_addresses(t_s, found.x, found.y, polarity, layout, pitch_um=pitch_um), origin)


def write_events(
    batches: OwnCheck[Iterable[Events]], path: str | Path, *, pitch_um: Annotated[float | None, POSITIVE] = None
) -> int:
    """
    Write batches of events to an HDF5 file incrementally and atomically.

    Parameters
    ----------
    batches : iterable of Events
        Consecutive batches, as from :meth:`foveasim.modes.EventPixels.stream`.
    path : path
        File with the extension ``.h5`` or ``.hdf5``; needs the extra ``video``.
    pitch_um : float, optional, µm
        Pitch of the raster of :meth:`Events.addresses`.

    Returns
    -------
    n_events : int
        Number of events written.

    Raises
    ------
    FileError
        When the extension is not one of these, h5py is not installed, or the file cannot be written.
    ParameterError
        When there is no batch, batches overlap in time or have different layouts, or events are later than about a day.

    Notes
    -----
    The format is that of the dataset DSEC (Gehrig et al., IEEE Robotics and Automation Letters 6, 4947, 2021) and of tools that
    read it, such as RVT: the group ``events`` with the arrays ``t`` (µs, int64), ``x`` and ``y`` (uint16, row 0 is the top row)
    and ``p`` (uint8, 0 or 1), the array ``ms_to_idx``, the first event of each millisecond, and ``t_offset`` of 0. It is
    neither the single array (n, 4) of v2e nor the HDF5 format of Metavision. Additional arrays are ``events/site``, and
    ``sites/x_um``, ``sites/y_um``, ``sites/area_um2``, ``sites/x`` and ``sites/y``, because several sites may have the same
    address; and ``layout``, with which :meth:`Events.load` restores the events.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> pixels = fs.modes.EventPixels(
    ...     fs.Sensor(fs.layout.grid(n_x=2, n_y=1, pitch_um=10.0)), floor_e_per_s=0.0
    ... )
    >>> events = pixels.events([[100.0, 100.0], [1000.0, 100.0]], frame_s=1.0, seed=0)
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "events.h5")
    ...     print(
    ...         fs.modes.write_events([events], path),
    ...         set(fs.modes.Events.load(path).site.tolist()),
    ...     )
    11 {0}
    """
    target = Path(path)
    if target.suffix.lower() not in HDF5_EXTENSIONS:
        raise FileError(target, "must end in .h5 or .hdf5")
    h5py = import_optional(target, "h5py")
    file: _hdf5.EventFile | None = None
    with atomic_write(target) as temporary, ExitStack() as stack:
        for batch in _check_consecutive("batches", batches):
            t_us = _to_us(batch.t_s)
            # HDF5 crashes on a full disk.
            n_bytes = _hdf5.max_file_bytes(batch.layout, 0 if file is None else file.n_events, t_us)
            check_free_space(temporary, n_bytes)
            if file is None:
                hdf5 = stack.enter_context(h5py.File(temporary, "w"))
                file = _hdf5.EventFile(hdf5, batch.layout, *batch.addresses(pitch_um))
            file.add(t_us, batch.site, batch.polarity)
        if file is None:
            raise ParameterError("batches", "must contain at least one batch of events")
        file.finish()
        return file.n_events


# -- parts ------------------------------------------------------------------------------------------------------------


def _is_own_file(path: Path) -> bool:
    """Return whether a file contains events with their layout."""
    if path.suffix.lower() == ".npz":
        return True
    if path.suffix.lower() not in HDF5_EXTENSIONS or not path.is_file():
        return False
    import_optional(path, "h5py")
    with as_file_error(path, "event file"):
        return _hdf5.is_own_file(path)


def _with_origin(events: Events, origin: Origin) -> Events:
    """Return events with time 0 at the first one, if this is the origin."""
    if origin == "file" or not len(events):
        return events
    t_us = _to_us(events.t_s)
    return Events((t_us - t_us[0]) / 1e6, events.site, events.polarity, events.layout)


def _raster_shape(layout: Layout, pitch_um: float | None) -> tuple[int, int]:
    empty = np.zeros(0)
    x, y = Events(empty, empty.astype(np.int32), empty.astype(np.int8), layout).addresses(pitch_um)
    return int(y.max(initial=0)) + 1, int(x.max(initial=0)) + 1


def _check_consecutive(name: str, batches: Iterable[Events]) -> Iterator[Events]:
    """Yield batches after checking that they have one layout and are consecutive."""
    if isinstance(batches, Events) or not isinstance(batches, Iterable):
        hint = "pass a list of batches" if isinstance(batches, Events) else ""
        raise ParameterError(name, f"must be batches of events, got {type_name(batches)}", hint=hint)
    layout: Layout | None = None
    last_s = 0.0
    for batch in batches:
        if not isinstance(batch, Events):
            raise ParameterError(name, f"must be Events, got {type_name(batch)}")
        if layout is None:
            layout = batch.layout
        elif batch.layout is not layout and not all(
            np.array_equal(getattr(batch.layout, part), getattr(layout, part)) for part in OUTLINES
        ):
            raise ParameterError(name, f"must have the same layout, got {layout!r} and {batch.layout!r}")
        if len(batch):
            if batch.t_s[0] < last_s:
                raise ParameterError(
                    name,
                    f"must be consecutive in time, got a batch that begins at {batch.t_s[0]:g} s, before {last_s:g} s",
                )
            last_s = float(batch.t_s[-1])
        yield batch


def _to_us(t_s: Floats) -> Ints:
    """Convert times to microseconds, rounded down."""
    if t_s.size and t_s[-1] > MAX_T_S:
        raise ParameterError("t_s", f"must be at most {MAX_T_S:.3g} for microseconds", float(t_s[-1]), "s")
    t_us = np.floor(t_s * 1e6)
    # The product may be rounded across an integer: times that were read from microseconds must not change.
    t_us += (t_us + 1.0) / 1e6 <= t_s
    t_us -= t_us / 1e6 > t_s
    return t_us.astype(np.int64)
