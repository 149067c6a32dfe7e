"""Events: when, where, and whether brighter or darker, as arrays and files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.archives import opened_archive, write_archive
from foveasim.arrays import Floats, check_number, read_only
from foveasim.errors import FileError, ParameterError
from foveasim.files import written_whole
from foveasim.layout import Layout
from foveasim.layout.packed import packed_layout, unpacked_layout
from foveasim.records import described

__all__ = ["Events", "write_events"]

FORMAT, VERSION = "foveasim events", 1
HDF5_ENDINGS = (".h5", ".hdf5")
#: Events of one chunk in HDF5.
CHUNK_EVENTS = 1 << 16
#: Addresses in files for event tools are 16-bit numbers.
MAX_ADDRESS = 2**16 - 1
MICROSECONDS_PER_S = 1e6


@dataclass(frozen=True, eq=False)
class Events:
    """
    What photosites told of themselves, in the order of time.

    Attributes
    ----------
    t_s : (n_event,) float64, s
        Rising; events of the same time in the order of their sites.
    site : (n_event,) int32
    polarity : (n_event,) int8
        1 for brighter, -1 for darker; spikes are all 1.
    layout : Layout
        The photosites.
    """

    t_s: Floats
    site: NDArray[np.int32]
    polarity: NDArray[np.int8]
    layout: Layout

    def __post_init__(self) -> None:
        for name, kind in (("t_s", np.float64), ("site", np.int32), ("polarity", np.int8)):
            values = np.asarray(getattr(self, name))
            if (
                values.shape != np.shape(self.t_s)
                or values.ndim != 1
                or not np.can_cast(values.dtype, kind, "same_kind")
            ):
                raise ParameterError(
                    name, f"must be {np.dtype(kind).name}, one for each time, got {values.dtype}{values.shape}"
                )
            object.__setattr__(self, name, read_only(values.astype(kind, copy=False).view()))

    def __repr__(self) -> str:
        return f"Events({self.t_s.size:,} of {self.layout.n_sites:,} sites)"

    def __len__(self) -> int:
        """Number of events."""
        return int(self.t_s.size)

    def counts(self, *, polarity: int | None = None) -> NDArray[np.int64]:
        """How many events each site gave, (n_site,); of one polarity, or of both."""
        sites = self.site if polarity is None else self.site[self.polarity == polarity]
        return np.bincount(sites, minlength=self.layout.n_sites).astype(np.int64)

    def between(self, start_s: float, stop_s: float) -> Events:
        """The events from one time to before another."""
        start_s, stop_s = check_number("start_s", start_s), check_number("stop_s", stop_s)
        part = slice(*np.searchsorted(self.t_s, (start_s, stop_s)))
        return Events(self.t_s[part], self.site[part], self.polarity[part], self.layout)

    @classmethod
    def joined(cls, parts: Iterable[Events]) -> Events:
        """Events of batches that follow each other, as one."""
        batches = list(parts)
        if not batches:
            raise ParameterError("parts", "must hold at least one batch of events")
        arrays = [np.concatenate([getattr(b, name) for b in batches]) for name in ("t_s", "site", "polarity")]
        return cls(arrays[0], arrays[1], arrays[2], batches[0].layout)

    def addresses(self, pitch_um: float | None = None) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """
        Column and row of every site on a raster, (n_site,) each: where tools that know rows and columns only may put it.

        Parameters
        ----------
        pitch_um : float, optional, µm
            Of the raster; by default the root of the smallest site's area, which gives the sites of a square grid their own
            columns and rows. Row 0 is on top, as in pictures. Where sites lie closer than the pitch, some share an address.
        """
        centroid_um = self.layout.centroid_um
        if pitch_um is None:
            pitch_um = float(np.sqrt(self.layout.area_um2.min(initial=np.inf)))
        pitch_um = check_number("pitch_um", pitch_um, above=0.0)
        low, high = centroid_um.min(axis=0), centroid_um.max(axis=0)
        column, row = (
            np.rint((centroid_um[:, 0] - low[0]) / pitch_um),
            np.rint((high[1] - centroid_um[:, 1]) / pitch_um),
        )
        if max(column.max(), row.max()) > MAX_ADDRESS:
            raise ParameterError(
                "pitch_um",
                f"gives more than {MAX_ADDRESS + 1} columns or rows, which files have no numbers for",
                pitch_um,
                "µm",
            )
        return column.astype(np.uint16), row.astype(np.uint16)

    def save(self, path: str | Path, *, pitch_um: float | None = None) -> None:
        """
        Write the events to a file, whole or not at all.

        Parameters
        ----------
        path : path
            ``.npz``: the arrays and the layout, which :meth:`load` reads. ``.h5`` or ``.hdf5``: as :func:`write_events`.
        pitch_um : float, optional, µm
            Of the raster of :meth:`addresses` in HDF5.

        Raises
        ------
        FileError
            When the ending is none of these, h5py is missing, or nothing can be written there.
        """
        target = Path(path)
        if target.suffix.lower() in HDF5_ENDINGS:
            write_events([self], target, pitch_um=pitch_um)
            return
        if target.suffix.lower() != ".npz":
            raise FileError(target, "must end in .npz, .h5 or .hdf5")
        arrays = {name: np.asarray(getattr(self, name)) for name in ("t_s", "site", "polarity")}
        about = {"format": FORMAT, "version": VERSION, "provenance": described(dict(self.layout.provenance))}
        write_archive(target, about, arrays | packed_layout(self.layout))

    @classmethod
    def load(cls, path: str | Path) -> Events:
        """
        Read events that :meth:`save` wrote as ``.npz``.

        Raises
        ------
        FileError
            When the file is missing, broken, or holds no events.
        """
        with opened_archive(path, "file of events", FORMAT, VERSION) as (about, arrays):
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
        When there is no batch, or one begins before the end of the one before it.

    Notes
    -----
    HDF5 as of the data set DSEC (Gehrig et al., IEEE Robotics and Automation Letters 6, 4947, 2021), and of the tools that
    read it: the group ``events`` with the arrays ``t`` (µs, int64), ``x`` and ``y`` (uint16, row 0 on top) and ``p`` (uint8, 0
    or 1), and beside it ``ms_to_idx``, the first event of each millisecond, and ``t_offset`` of 0. Moreover ``events/site``,
    and the sites' ``sites/x_um``, ``sites/y_um``, ``sites/area_um2``, ``sites/x`` and ``sites/y``: since sites may share an
    address.
    """
    target = Path(path)
    if target.suffix.lower() not in HDF5_ENDINGS:
        raise FileError(target, "must end in .h5 or .hdf5")
    try:
        import h5py
    except ImportError:
        raise FileError(target, "needs h5py: pip install 'foveasim[video]'") from None
    n, n_ms, last_us = 0, 0, -1
    with written_whole(target) as temporary, h5py.File(temporary, "w") as file:
        for batch in batches:
            if "sites" not in file:
                x, y = batch.addresses(pitch_um)
                _begin(file, batch.layout, x, y)
            if len(batch) == 0:
                continue
            t_us = np.floor(batch.t_s * MICROSECONDS_PER_S).astype(np.int64)
            if t_us[0] < last_us:
                raise ParameterError("batches", f"must follow each other, got one that begins at {batch.t_s[0]:g} s")
            last_us = int(t_us[-1])
            arrays: dict[str, NDArray[Any]] = {
                "t": t_us,
                "x": x[batch.site],
                "y": y[batch.site],
                "p": batch.polarity > 0,
                "site": batch.site,
            }
            for name, values in arrays.items():
                _append(file[f"events/{name}"], values)
            # Of the milliseconds that begin behind all events before.
            begins_us = 1000 * np.arange(n_ms, last_us // 1000 + 1)
            _append(file["ms_to_idx"], n + np.searchsorted(t_us, begins_us))
            n, n_ms = n + t_us.size, last_us // 1000 + 1
        if "sites" not in file:
            raise ParameterError("batches", "must hold at least one batch of events")
        _append(file["ms_to_idx"], np.array([n]))
    return n


def _begin(file: Any, layout: Layout, x: NDArray[np.uint16], y: NDArray[np.uint16]) -> None:
    """What an HDF5 file of events has before the first."""
    kinds = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8, "site": np.int32}
    for name, kind in kinds.items():
        file.create_dataset(
            f"events/{name}", (0,), kind, maxshape=(None,), chunks=(CHUNK_EVENTS,), compression="gzip", shuffle=True
        )
    file.create_dataset("ms_to_idx", (0,), np.uint64, maxshape=(None,), chunks=(CHUNK_EVENTS,))
    file["t_offset"] = np.int64(0)
    centroid_um = layout.centroid_um
    sites = {"x_um": centroid_um[:, 0], "y_um": centroid_um[:, 1], "area_um2": layout.area_um2, "x": x, "y": y}
    for name, values in sites.items():
        file[f"sites/{name}"] = values
    file.attrs.update({"format": FORMAT, "version": VERSION})


def _append(dataset: Any, values: NDArray[Any]) -> None:
    n = dataset.shape[0]
    dataset.resize((n + values.size,))
    dataset[n:] = values
