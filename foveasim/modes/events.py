"""Events: when, where, and whether brighter or darker, as arrays and files."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.extras import needs
from foveasim._core.provenance import to_plain_data
from foveasim._core.validation import Floats, Ints, as_numbers, check_number, finite_array, own, read_only
from foveasim._io.atomic import atomic_write, check_room
from foveasim._io.formats import as_file_error
from foveasim._io.npz import opened_archive, write_archive
from foveasim.errors import FileError, FoveasimWarning, ParameterError
from foveasim.layout import Layout
from foveasim.layout.packed import OUTLINES, packed_layout, unpacked_layout
from foveasim.modes import _hdf5

__all__ = ["Events", "write_events"]

FORMAT, VERSION = "foveasim events", 1
HDF5_ENDINGS = (".h5", ".hdf5")
#: Addresses in files for event tools are 16-bit numbers, in some with a sign.
MAX_ADDRESS, MAX_SIGNED_ADDRESS = 2**16 - 1, 2**15 - 1
#: What tools call an event: address, time in µs, and whether brighter.
STRUCTURE = np.dtype([("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")])
#: Later than this a floating-point number does not tell microseconds.
MAX_T_S = 2.0**53 / 1e6
#: Counts of more bins and sites than this are a slip.
MAX_COUNTS = 1 << 30
#: Neighbours' distances have rounding errors of this share.
ROUNDING = 1e-9
POLARITIES = (1, -1)
ARRAYS = ("t_s", "site", "polarity")


@dataclass(frozen=True, eq=False)
class Events:
    """
    What photosites told of themselves, in the order of time.

    Parameters
    ----------
    t_s : (n_event,) float64, s
        At least 0, and rising; events of the same time in the order of their sites.
    site : (n_event,) int32
    polarity : (n_event,) int8
        1 for brighter, -1 for darker; spikes are all 1.
    layout : Layout
        The photosites.

    Raises
    ------
    ParameterError
        When times do not rise, a site is none of the layout's, or a polarity is neither 1 nor -1.
    """

    t_s: Floats
    site: NDArray[np.int32]
    polarity: NDArray[np.int8]
    layout: Layout

    def __post_init__(self) -> None:
        if not isinstance(self.layout, Layout):
            raise ParameterError("layout", f"must be a foveasim.Layout, got a {type(self.layout).__name__}")
        t_s, site, polarity = (as_numbers(name, getattr(self, name), keep_type=True) for name in ARRAYS)
        for name, values, kind in (
            ("t_s", t_s, np.float64),
            ("site", site, np.int64),
            ("polarity", polarity, np.int64),
        ):
            if values.ndim != 1 or values.size != t_s.size:
                raise ParameterError(name, f"must be one number for each of {t_s.size} times, got {values.shape}")
            if values.size and not np.can_cast(values.dtype, kind, "same_kind"):
                raise ParameterError(name, f"must be integers, got {values.dtype}")
        if t_s.size:
            # Whatever is not a number is not later than any.
            if not (t_s[0] >= 0.0 and np.all(t_s[1:] >= t_s[:-1]) and t_s[-1] < np.inf):
                raise ParameterError("t_s", "must be finite, at least 0, and rising", t_s, "s", "sort events by time")
            n_sites = self.layout.n_sites
            if site.min() < 0 or site.max() >= n_sites:
                bad = site[(site < 0) | (site >= n_sites)]
                raise ParameterError("site", f"must be from 0 to {n_sites - 1}, the sites of the layout", int(bad[0]))
            if not np.all(np.abs(polarity) == 1):
                bad = polarity[np.abs(polarity) != 1]
                raise ParameterError("polarity", "must be 1 or -1", int(bad[0]), hint="of 0 and 1 make 2 * p - 1")
        for name, values, kept in zip(ARRAYS, (t_s, site, polarity), (np.float64, np.int32, np.int8), strict=True):
            object.__setattr__(self, name, own(values.astype(kept, copy=False)))

    def __repr__(self) -> str:
        return f"Events({self.t_s.size:,} of {self.layout.n_sites:,} sites)"

    def __len__(self) -> int:
        """Number of events."""
        return int(self.t_s.size)

    def counts(self, *, polarity: int | None = None) -> Ints:
        """How many events each site gave, (n_site,); of one polarity, or of both."""
        sites = self.site if polarity is None else self.site[self._is_of(polarity)]
        return np.bincount(sites, minlength=self.layout.n_sites).astype(np.int64)

    def histogram(self, edges_s: ArrayLike, *, polarity: int | None = None) -> Ints:
        """
        How many events each site gave in each of some spans of time.

        Parameters
        ----------
        edges_s : (n_bin + 1,) float64, s
            Rising; each bin lasts from one to before the next, as of :meth:`between`.
        polarity : {1, -1}, optional
            Of one polarity; of both by default.

        Returns
        -------
        counts : (n_bin, n_site) int64

        Raises
        ------
        ParameterError
            When edges do not rise, or there are more bins and sites than fit the memory.
        """
        edges = finite_array("edges_s", edges_s, ndim=1)
        if edges.size < 2 or np.any(np.diff(edges) <= 0.0):
            raise ParameterError("edges_s", "must be two or more times, each later than the one before", edges, "s")
        n_bins, n_sites = edges.size - 1, self.layout.n_sites
        if n_bins * n_sites > MAX_COUNTS:
            raise ParameterError("edges_s", f"make {n_bins:,} bins of {n_sites:,} sites, more than fit the memory")
        ends = np.searchsorted(self.t_s, edges)
        span = slice(ends[0], ends[-1])
        cell = np.repeat(n_sites * np.arange(n_bins), np.diff(ends)) + self.site[span]
        if polarity is not None:
            cell = cell[self._is_of(polarity)[span]]
        return np.bincount(cell, minlength=n_bins * n_sites).astype(np.int64).reshape(n_bins, n_sites)

    def _is_of(self, polarity: int) -> NDArray[np.bool_]:
        if polarity not in POLARITIES:
            raise ParameterError("polarity", "must be 1 or -1", polarity)
        return np.asarray(self.polarity == polarity)

    def between(self, start_s: float, stop_s: float) -> Events:
        """The events from one time to before another."""
        start_s, stop_s = check_number("start_s", start_s), check_number("stop_s", stop_s)
        part = slice(*np.searchsorted(self.t_s, (start_s, stop_s)))
        return Events(self.t_s[part], self.site[part], self.polarity[part], self.layout)

    @classmethod
    def concatenate(cls, parts: Iterable[Events]) -> Events:
        """Events of batches that follow each other, as one."""
        batches = list(_following("parts", parts))
        if not batches:
            raise ParameterError("parts", "must hold at least one batch of events")
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
        pitch_um: float | None = None,
    ) -> Events:
        """
        Events of a recording that knows columns and rows: the other way round than :meth:`addresses`.

        Parameters
        ----------
        t_s : (n_event,) float64, s
            Rising.
        x, y : (n_event,) int
            Column and row of each, row 0 on top.
        polarity : (n_event,) int
            1 or -1.
        layout : Layout
            ``foveasim.layout.grid(n_x=640, n_y=480, pitch_um=...)`` for a recording of 640 x 480 pixels.
        pitch_um : float, optional, µm
            As of :meth:`addresses`.

        Raises
        ------
        ParameterError
            When there is no site at an address, or more than one; and as for the class.
        """
        none = np.zeros(0)
        site_x, site_y = cls(none, none.astype(np.int32), none.astype(np.int8), layout).addresses(pitch_um)
        code = site_x.astype(np.int64) * (MAX_ADDRESS + 1) + site_y
        order = np.argsort(code, kind="stable")
        places = [as_numbers(name, values, keep_type=True) for name, values in (("x", x), ("y", y))]
        for name, values in zip("xy", places, strict=True):
            if values.ndim != 1 or values.shape != places[0].shape or (values.size and values.dtype.kind not in "iu"):
                raise ParameterError(name, f"must be one integer an event, got {values.dtype}{values.shape}")
            if values.size and not 0 <= values.min() <= values.max() <= MAX_ADDRESS:
                raise ParameterError(name, f"must be from 0 to {MAX_ADDRESS}", (int(values.min()), int(values.max())))
        wanted = places[0].astype(np.int64) * (MAX_ADDRESS + 1) + places[1].astype(np.int64)
        first, behind = (np.searchsorted(code[order], wanted, side) for side in ("left", "right"))
        if np.any(behind - first != 1):
            bad = int(np.flatnonzero(behind - first != 1)[0])
            n = int(behind[bad] - first[bad])
            address = int(places[0][bad]), int(places[1][bad])
            raise ParameterError("layout", f"must have one site at each address (x, y), got {n} at {address}")
        return cls(t_s, order[first].astype(np.int32), polarity, layout)  # type: ignore[arg-type]

    def addresses(self, pitch_um: float | None = None) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """
        Column and row of every site on a raster, (n_site,) each: where tools that know rows and columns only may put it.

        Parameters
        ----------
        pitch_um : float, optional, µm
            Of the raster. By default sites have the numbers of their layout's columns ``column`` and ``row``, where these are
            theirs alone; else the raster is as fine as it takes that no two sites with different centres share an address.
            Row 0 is on top, as in pictures.

        Warns
        -----
        FoveasimWarning
            When sites share an address.
        """
        places = _numbered(self.layout) if pitch_um is None else None
        if places is None:
            places = _on_raster(self.layout, pitch_um)
        n_distinct = np.unique(places[0] * (MAX_ADDRESS + 1) + places[1]).size
        if n_distinct < self.layout.n_sites:
            warnings.warn(
                f"{self.layout.n_sites:,} sites have {n_distinct:,} addresses on the raster, so that some share theirs: take "
                "a smaller 'pitch_um', or tell sites by their numbers",
                FoveasimWarning,
                stacklevel=2,
            )
        return places[0].astype(np.uint16), places[1].astype(np.uint16)

    def structured(self, *, pitch_um: float | None = None) -> NDArray[Any]:
        """
        The events as event tools have them, such as Tonic.

        Parameters
        ----------
        pitch_um : float, optional, µm
            As of :meth:`addresses`.

        Returns
        -------
        events : (n_event,) structured
            Of ``x`` and ``y`` (int16, row 0 on top), ``t`` (int64, whole µs, rounded down) and ``p`` (bool, true for brighter).
        """
        x, y = self.addresses(pitch_um)
        if max(x.max(initial=0), y.max(initial=0)) > MAX_SIGNED_ADDRESS:
            raise ParameterError(
                "pitch_um",
                f"gives more than {MAX_SIGNED_ADDRESS + 1} columns or rows, which such arrays have no numbers for",
                pitch_um,
                "µm",
            )
        events = np.empty(len(self), STRUCTURE)
        events["x"], events["y"] = x[self.site], y[self.site]
        events["t"], events["p"] = _whole_us(self.t_s), self.polarity > 0
        return events

    def save(self, path: str | Path, *, pitch_um: float | None = None) -> None:
        """
        Write the events to a file, whole or not at all.

        Parameters
        ----------
        path : path
            ``.npz``: the arrays and the layout, to the last bit. ``.h5`` or ``.hdf5``: as :func:`write_events`. Both are read
            by :meth:`load`. For other tools, and without the layout, ``.npy``: the array of :meth:`structured`; ``.txt``: a
            line ``t x y p`` for each event, t in seconds and p 0 or 1.
        pitch_um : float, optional, µm
            Of the raster of :meth:`addresses`, which all but ``.npz`` have.

        Raises
        ------
        FileError
            When the ending is none of these, h5py is missing, or nothing can be written there.
        """
        target = Path(path)
        ending = target.suffix.lower()
        if ending in HDF5_ENDINGS:
            write_events([self], target, pitch_um=pitch_um)
        elif ending == ".npy":
            events = self.structured(pitch_um=pitch_um)
            with atomic_write(target) as temporary, temporary.open("wb") as file:
                np.save(file, events, allow_pickle=False)
        elif ending == ".txt":
            x, y = self.addresses(pitch_um)
            rows = np.stack((self.t_s, x[self.site], y[self.site], self.polarity > 0), axis=1)
            with atomic_write(target) as temporary:
                np.savetxt(temporary, rows, fmt=("%.9f", "%d", "%d", "%d"))
        elif ending == ".npz":
            arrays = {name: np.asarray(getattr(self, name)) for name in ARRAYS}
            about = {"format": FORMAT, "version": VERSION, "provenance": to_plain_data(dict(self.layout.provenance))}
            write_archive(target, about, arrays | packed_layout(self.layout))
        else:
            raise FileError(target, "must end in .npz, .h5, .hdf5, .npy or .txt")

    @classmethod
    def load(cls, path: str | Path) -> Events:
        """
        Read events that :meth:`save` wrote as ``.npz``, or :func:`write_events` as HDF5: then times are whole microseconds.

        Raises
        ------
        FileError
            When the file is missing, broken, or holds no events.
        """
        source = Path(path)
        if source.suffix.lower() in HDF5_ENDINGS:
            _needs_h5py(source)
            if not source.is_file():
                raise FileError(source, "is not a file" if source.exists() else "no such file")
            with as_file_error(source, "file of events"):
                return cls(*_hdf5.read_events(source))
        with opened_archive(source, "file of events", FORMAT, VERSION) as (about, arrays):
            layout = unpacked_layout(arrays, about.get("provenance", {}))
            return cls(arrays["t_s"], arrays["site"], arrays["polarity"], layout)


def write_events(batches: Iterable[Events], path: str | Path, *, pitch_um: float | None = None) -> int:
    """
    Write events to an HDF5 file as they come, whole or not at all.

    Parameters
    ----------
    batches : iterable of Events
        That follow each other, as :meth:`foveasim.modes.EventPixels.stream` gives them.
    path : path
        ``.h5`` or ``.hdf5``; needs the extra ``video``.
    pitch_um : float, optional, µm
        Of the raster of :meth:`Events.addresses`.

    Returns
    -------
    n_events : int
        How many were written.

    Raises
    ------
    FileError
        When the ending is none of these, h5py is missing, or nothing can be written there.
    ParameterError
        When there is no batch, one begins before the end of the one before it or has another layout, or events are later
        than a day.

    Notes
    -----
    HDF5 as of the dataset DSEC (Gehrig et al., IEEE Robotics and Automation Letters 6, 4947, 2021), and of the tools that
    read it, such as its own loaders and RVT: the group ``events`` with the arrays ``t`` (µs, int64), ``x`` and ``y`` (uint16,
    row 0 on top) and ``p`` (uint8, 0 or 1), and beside it ``ms_to_idx``, the first event of each millisecond, and ``t_offset``
    of 0. It is neither the one array (n, 4) that v2e writes, nor the HDF5 of Metavision. Moreover ``events/site``, and the
    sites' ``sites/x_um``, ``sites/y_um``, ``sites/area_um2``, ``sites/x`` and ``sites/y``, since sites may share an address;
    and the ``layout``, with which :meth:`Events.load` reads all of it back.
    """
    target = Path(path)
    if target.suffix.lower() not in HDF5_ENDINGS:
        raise FileError(target, "must end in .h5 or .hdf5")
    _needs_h5py(target)
    import h5py

    file: _hdf5.EventFile | None = None
    with atomic_write(target) as temporary, ExitStack() as opened:
        for batch in _following("batches", batches):
            t_us = _whole_us(batch.t_s)
            # HDF5 crashes on a full disk.
            n_bytes = _hdf5.most_bytes(batch.layout, 0 if file is None else file.n_events, t_us)
            check_room(temporary, n_bytes)
            if file is None:
                hdf5 = opened.enter_context(h5py.File(temporary, "w"))
                file = _hdf5.EventFile(hdf5, batch.layout, *batch.addresses(pitch_um))
            file.add(t_us, batch.site, batch.polarity)
        if file is None:
            raise ParameterError("batches", "must hold at least one batch of events")
        file.end()
        return file.n_events


# -- parts ------------------------------------------------------------------------------------------------------------


def _following(name: str, batches: Iterable[Events]) -> Iterator[Events]:
    """Batches of one layout that follow each other."""
    if isinstance(batches, Events) or not isinstance(batches, Iterable):
        cure = "put it into a list" if isinstance(batches, Events) else ""
        raise ParameterError(name, f"must be batches of events, got a {type(batches).__name__}", hint=cure)
    layout: Layout | None = None
    last_s = 0.0
    for batch in batches:
        if not isinstance(batch, Events):
            raise ParameterError(name, f"must be Events, got a {type(batch).__name__}")
        if layout is None:
            layout = batch.layout
        elif batch.layout is not layout and not all(
            np.array_equal(getattr(batch.layout, part), getattr(layout, part)) for part in OUTLINES
        ):
            raise ParameterError(name, f"must be of one layout, got {layout!r} and {batch.layout!r}")
        if len(batch):
            if batch.t_s[0] < last_s:
                raise ParameterError(
                    name, f"must follow each other, got one that begins at {batch.t_s[0]:g} s, before {last_s:g} s"
                )
            last_s = float(batch.t_s[-1])
        yield batch


def _numbered(layout: Layout) -> tuple[Ints, Ints] | None:
    """Column and row of each site by its layout's own numbers; None where they run otherwise, or sites share them."""
    centred_um = layout.centroid_um - layout.centroid_um.mean(axis=0) if layout.n_sites else layout.centroid_um
    places = []
    for axis, name in enumerate(("column", "row")):
        numbers = layout.columns.get(name)
        if numbers is None or numbers.dtype.kind not in "iu":
            return None
        whole = numbers.astype(np.int64)
        whole -= whole.min(initial=0)
        along, across = (
            float((whole - whole.mean()) @ centred_um[:, a]) if whole.size else 0.0 for a in (axis, 1 - axis)
        )
        if abs(along) < abs(across) or whole.max(initial=0) > MAX_ADDRESS:
            return None
        # Columns count to the right, rows downwards.
        is_turned = along < 0.0 if axis == 0 else along >= 0.0
        places.append(whole.max(initial=0) - whole if is_turned else whole)
    is_own = np.unique(places[0] * (MAX_ADDRESS + 1) + places[1]).size == layout.n_sites
    return (places[0], places[1]) if is_own else None


def _on_raster(layout: Layout, pitch_um: float | None) -> tuple[Ints, Ints]:
    """Column and row of each site's centre on a raster from the left and from the top."""
    from scipy.spatial import cKDTree

    centroid_um = layout.centroid_um
    if layout.n_sites == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    low_um, high_um = centroid_um.min(axis=0), centroid_um.max(axis=0)
    if pitch_um is None:
        # Centres that lie further apart than this along either axis fall into different columns or rows.
        distance_um = np.asarray(cKDTree(centroid_um).query(centroid_um, k=2, p=np.inf)[0])[:, 1]
        nearest_um = float(distance_um[distance_um > 0.0].min(initial=np.inf))
        finest_um = float((high_um - low_um).max()) / MAX_ADDRESS
        pitch_um = max((1.0 - ROUNDING) * nearest_um, finest_um) if np.isfinite(nearest_um) else 1.0
    pitch_um = check_number("pitch_um", pitch_um, above=0.0)
    column = np.floor((centroid_um[:, 0] - low_um[0]) / pitch_um + 0.5)
    row = np.floor((high_um[1] - centroid_um[:, 1]) / pitch_um + 0.5)
    if max(column.max(), row.max()) > MAX_ADDRESS:
        raise ParameterError(
            "pitch_um",
            f"gives more than {MAX_ADDRESS + 1} columns or rows, which files have no numbers for",
            pitch_um,
            "µm",
        )
    return column.astype(np.int64), row.astype(np.int64)


def _whole_us(t_s: Floats) -> Ints:
    """Microseconds, rounded down."""
    if t_s.size and t_s[-1] > MAX_T_S:
        raise ParameterError("t_s", f"must be at most {MAX_T_S:.3g} for microseconds", float(t_s[-1]), "s")
    t_us = np.floor(t_s * 1e6)
    # The product may be rounded past an integer: what was read from whole microseconds stays as it is.
    t_us += (t_us + 1.0) / 1e6 <= t_s
    t_us -= t_us / 1e6 > t_s
    return t_us.astype(np.int64)


def _needs_h5py(path: Path) -> None:
    try:
        import h5py  # noqa: F401
    except ImportError:
        raise FileError(path, needs("h5py")) from None
