"""Videos of captures as zarr folders that hold every code: written frame by frame, gone on with after any end, and read."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import library
from foveasim._core.provenance import differences, to_plain_data
from foveasim._core.validation import Floats, check_count
from foveasim._io.atomic import atomic_directory, lock, remove_folder
from foveasim._io.formats import as_file_error
from foveasim._io.zarr_stores import ZARR, check_codecs
from foveasim.capture import Capture
from foveasim.errors import FileError, ParameterError
from foveasim.layout import Layout
from foveasim.layout.packed import packed_layout

__all__ = [
    "Recording",
    "alike",
    "count_recorded_frames",
    "partial_path",
    "read_recording",
    "record",
    "resume_recording",
]

FORMAT, VERSION = "foveasim video", 1
#: Codes that one chunk of a zarr folder holds, at least one frame of them: what is kept in memory while writing.
CHUNK_CODES = 1 << 22
#: A recording that can be gone on with is written at least so often, whether a chunk is full or not: what a sudden end costs.
WRITE_S = 10.0
#: What packs the numbers, as zarr does unless told otherwise; and a folder with more numbers beside the codes is rejected.
CODECS = ("bytes", "zstd")
MAX_UNPACKED_BYTES = 8 * 2**30
#: Arrays of the layout, and those that grow frame by frame: the numbers come last, and tell which frames are whole.
GEOMETRY, GROWING = ("xy_um", "ring_offsets", "site_offsets"), ("code", "exposure_s", "frame")
#: Instead of a frame's number until the frame is whole.
NO_FRAME = -1
#: What may differ between captures of one recording, whatever else does not.
OWN_SETTINGS = frozenset({"exposure_s", "frame", "light.source", "place_um"})
#: A file that is locked while a recording grows, and the ending of zarr's files that are not written to their end.
LOCK, TORN = "lock", ".partial"


# -- reading ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Recording:
    """
    A video in a zarr folder.

    Attributes
    ----------
    code : zarr array (n_frame, n_site) uint8 or uint16, DN
        Read as it is indexed: ``code[k]`` is a frame, ``code[:, site]`` what a site saw.
    exposure_s : (n_frame,) float64, s
    frame : (n_frame,) int64
        Numbers of the frames, which their noise is of.
    layout : Layout
    filter_names : tuple of str
    filter_of_site : (n_site,) int64
    bits : int
    white_dn : (n_filter,) float64, DN
    settings : mapping
        Of the first frame.
    """

    code: Any
    exposure_s: Floats
    frame: NDArray[np.int64]
    layout: Layout
    filter_names: tuple[str, ...]
    filter_of_site: NDArray[np.int64]
    bits: int
    white_dn: Floats
    settings: dict[str, Any]

    def __repr__(self) -> str:
        return f"Recording({self.n_frames} frames of {self.layout.n_sites} sites, {self.bits} bits)"

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return int(self.code.shape[0])


def read_recording(path: str | Path) -> Recording:
    """
    Open a zarr folder that :func:`write_video` wrote; codes are read as they are asked for.

    Raises
    ------
    FileError
        When it is missing, broken, or no video of captures.
    """
    source = Path(path)
    library(source, "zarr")
    if not source.is_dir():
        raise FileError(source, "is not a folder" if source.exists() else "no such folder")
    with _trusted(source) as group:
        about = group.attrs
        columns = {name: values[:] for name, values in group["columns"].arrays()}
        return Recording(
            code=group["code"],
            exposure_s=group["exposure_s"][:],
            frame=group["frame"][:],
            layout=Layout(
                group["xy_um"][:], group["ring_offsets"][:], group["site_offsets"][:], columns, about["provenance"]
            ),
            filter_names=tuple(about["filter_names"]),
            filter_of_site=group["filter_of_site"][:],
            bits=int(about["bits"]),
            white_dn=np.asarray(about["white_dn"], np.float64),
            settings=about["settings"],
        )


def partial_path(path: str | Path) -> Path:
    """The folder beside a recording in which it grows: there after an end of the program, until the last frame is in."""
    target = Path(path)
    return target.with_name(target.name + ".partial")


def count_recorded_frames(path: str | Path) -> int:
    """
    How many frames of a recording are there, of one that was ended or one that is finished.

    Parameters
    ----------
    path : path
        Of the recording, as :func:`write_video` was given it with ``resume``.

    Returns
    -------
    n_frames : int
        0 where nothing is there.

    Raises
    ------
    FileError
        When something else is there, or it is broken.
    """
    target = Path(path)
    if target.suffix.lower() != ZARR:
        raise FileError(target, "is no .zarr folder, and others keep no frames")
    library(target, "zarr")
    if target.exists():
        with _trusted(target) as group:
            return int(group["code"].shape[0])
    folder = partial_path(target)
    return _n_whole(folder) if folder.exists() else 0


@contextmanager
def _trusted(source: Path, mode: str = "r") -> Iterator[Any]:
    """The group of a recording; what its folder holds may be anything, and whatever that breaks is told in one sentence."""
    zarr = library(source, "zarr")
    with as_file_error(source, "video of captures", passes=(FileError,)):
        check_codecs(source, CODECS, "video of captures")
        group = zarr.open_group(str(source), mode=mode, use_consolidated=False)  # which is not what was checked
        if group.attrs.get("format") != FORMAT:
            raise FileError(source, "is no video of captures")
        if group.attrs.get("version") != VERSION:
            raise FileError(source, f"has the format version {group.attrs.get('version')}, expected {VERSION}")
        names = (*GEOMETRY, "filter_of_site", "exposure_s", "frame")
        arrays = [group[name] for name in names if name in group]
        arrays += [array for _, array in group["columns"].arrays()] if "columns" in group else []
        if sum(array.nbytes for array in arrays) > MAX_UNPACKED_BYTES:
            raise FileError(source, f"would unpack to more than {MAX_UNPACKED_BYTES} bytes")
        yield group


def _is_recording(folder: Path) -> bool:
    zarr = library(folder, "zarr")
    try:
        return zarr.open_group(str(folder), mode="r", use_consolidated=False).attrs.get("format") == FORMAT
    except Exception:  # noqa: BLE001 -- whatever else it is
        return False


# -- writing ----------------------------------------------------------------------------------------------------------


def alike(captures: Iterable[Capture], *, n_before: int = 0) -> Iterator[Capture]:
    """
    The captures, as they come.

    Raises
    ------
    ParameterError
        When they are not all of one layout and as many bits, or none comes where none was before.
    """
    first: tuple[int, int] | None = None
    for capture in captures:
        if not isinstance(capture, Capture):
            raise ParameterError("captures", f"must be Captures, got a {type(capture).__name__}")
        kind = capture.layout.n_sites, capture.bits
        first = kind if first is None else first
        if kind != first:
            raise ParameterError("captures", f"must be of the same layout and bits, got {capture!r}")
        yield capture
    if first is None and n_before == 0:
        raise ParameterError("captures", "must hold at least one capture")


def record(captures: Iterable[Capture], target: Path, plan: Mapping[str, Any] | None) -> int:
    """Write captures to a zarr folder, whole or not at all; their number."""
    library(target, "zarr")
    with atomic_directory(target, is_ours=_is_recording) as folder:
        frames = _Frames(folder, plan)
        for capture in alike(captures):
            frames.add(capture)
        frames.write()
    return frames.n_whole


def resume_recording(captures: Iterable[Capture], target: Path, plan: Mapping[str, Any] | None) -> int:
    """Write captures to a zarr folder after those that are kept; the number of all."""
    library(target, "zarr")
    if target.exists():
        return _finished(captures, target, plan)
    with _growing(target) as folder:
        n_before = _n_whole(folder)
        if n_before:
            _check_plan(folder, plan)
        with _full_disks_told(target):
            frames = _Frames(folder, plan, n_before)
        try:
            for capture in _following(alike(captures, n_before=n_before), folder, n_before):
                with _full_disks_told(target):
                    frames.add(capture)
                    if time.monotonic() - frames.written_s > WRITE_S:
                        frames.write()
            with _full_disks_told(target):
                frames.write()
                folder.rename(target)
                (target / LOCK).unlink(missing_ok=True)
        except BaseException as error:
            with suppress(Exception):
                frames.write()
            if frames.n_whole:
                error.add_note(f"{frames.n_whole:,} frames are kept in {folder}, from which the same recording goes on")
            raise
    return frames.n_whole


def _finished(captures: Iterable[Capture], target: Path, plan: Mapping[str, Any] | None) -> int:
    """The number of frames of a finished recording, after which nothing may come."""
    if not _is_recording(target):
        raise FileError(target, "cannot be written: something else is there")
    _check_plan(target, plan)
    n = count_recorded_frames(target)
    # Of the same plan nothing more can come; who gives none says so by captures of which none is left.
    if plan is None and next(iter(captures), None) is not None:
        raise FileError(
            target,
            f"is finished, with {n:,} frames, and nothing is put after them; write this one under another name, or remove "
            "that one",
        )
    return n


@contextmanager
def _growing(target: Path) -> Iterator[Path]:
    """The folder in which a recording grows, locked; it stays after the block unless no frame is in it."""
    folder = partial_path(target)
    if not target.parent.is_dir():
        raise FileError(target, f"cannot be written: the folder {target.parent} does not exist")
    if folder.exists() and not (folder.is_dir() and _is_ours(folder)):
        raise FileError(folder, "cannot be written: something else is there")
    with _full_disks_told(target):
        folder.mkdir(exist_ok=True)
        file = (folder / LOCK).open("ab")
    with file:
        with _full_disks_told(target):
            # A folder that another program finished or began meanwhile is not the one that was locked.
            if not lock(file) or not _is_at(file, folder / LOCK):
                raise FileError(target, "is being written by another program")
            for torn in folder.rglob(f"*{TORN}"):
                torn.unlink()
        try:
            yield folder
        finally:
            if folder.exists() and not _n_whole(folder):
                remove_folder(folder)


@contextmanager
def _full_disks_told(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FileError(target, f"cannot be written: {error.strerror or error}") from None


def _is_ours(folder: Path) -> bool:
    """Whether a recording grows in a folder, or was about to."""
    return all(path.name == LOCK or path.suffix == TORN for path in folder.iterdir()) or _is_recording(folder)


def _is_at(file: IO[bytes], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False


def _n_whole(folder: Path) -> int:
    """How many frames of a growing recording are whole."""
    if not (folder / "frame" / "zarr.json").exists():
        return 0
    with _trusted(folder) as group:
        frame = group["frame"][:]
    return int(np.argmax(frame == NO_FRAME)) if (frame == NO_FRAME).any() else frame.size


def _check_plan(path: Path, plan: Mapping[str, Any] | None) -> None:
    """Reject a recording that was made after another plan."""
    with _trusted(path) as group:
        found = group.attrs.get("plan")
    _refuse(path, differences(found, _plain(plan)))


def _refuse(path: Path, different: Iterable[str]) -> None:
    for name in different:
        raise FileError(
            path,
            f"is another recording: '{name}' differs; write this one under another name, or remove that one",
        )


def _following(captures: Iterable[Capture], folder: Path, n_before: int) -> Iterator[Capture]:
    """
    The captures, which must be numbered one after the other, and go on with those that the folder holds.

    What differed between captures of the recording before may differ again; anything else that does is another recording.
    """
    first: dict[str, Any] | None = None
    may_differ, next_frame = set(OWN_SETTINGS), None
    if n_before:
        with _trusted(folder) as group:
            first, next_frame = group.attrs["settings"], int(group["frame"][n_before - 1]) + 1
            may_differ |= set(group.attrs["varied"])
    for k, capture in enumerate(captures, n_before):
        settings = _plain(capture.settings)
        frame = check_count("frame", settings.get("frame", k), at_least=0)
        if next_frame is not None and frame != next_frame:
            raise ParameterError(
                "captures",
                f"must be numbered one after the other to be gone on with: after {k:,} frames comes the number "
                f"{next_frame}; leave out the light of the first {k:,}, and number the captures from there on (first_frame)",
                frame,
            )
        first = settings if first is None else first
        different = [name for name in differences(first, settings) if name not in may_differ]
        if n_before and k == n_before:
            _refuse(folder, _other_parts(folder, capture))
            _refuse(folder, different)
        elif different:
            may_differ |= set(different)
            with _trusted(folder, "r+") as group:
                pass
            with _full_disks_told(folder):
                group.attrs["varied"] = sorted(may_differ - OWN_SETTINGS)
        next_frame = frame + 1
        yield capture


def _other_parts(folder: Path, capture: Capture) -> Iterator[str]:
    """Names of what a capture has otherwise than a recording, beside settings."""
    found = read_recording(folder)
    there, here = packed_layout(found.layout), packed_layout(capture.layout)
    if there.keys() != here.keys() or any(not np.array_equal(there[name], here[name]) for name in here):
        yield "layout"
    if found.bits != capture.bits or found.code.dtype != capture.code.dtype:
        yield "bits"
    is_same = np.array_equal(found.filter_of_site, capture.filter_of_site)
    if found.filter_names != tuple(capture.filter_names) or not is_same:
        yield "filters"


def _plain(data: Mapping[str, Any] | None) -> Any:
    """Data as they come back from a file."""
    return json.loads(json.dumps(None if data is None else dict(data)))


class _Frames:
    """
    The frames of a recording in a folder, and those of the last chunk, not yet full, in memory.

    A chunk is written again when frames come to it, and every file of it whole or not at all: what the folder tells that it
    holds is there after any end of the program.
    """

    def __init__(self, folder: Path, plan: Mapping[str, Any] | None, n_whole: int = 0) -> None:
        self._folder, self._plan = folder, plan
        self._arrays: dict[str, Any] = {}
        self._n_chunk = 1
        # How many frames are before the chunk, and its frames: together, so that Ctrl-C never finds one without the other.
        self._chunk: tuple[int, list[tuple[Any, ...]]] = 0, []
        self.n_whole, self.written_s = n_whole, time.monotonic()
        if n_whole:
            with _trusted(folder, "r+") as group:
                self._arrays = {name: group[name] for name in GROWING}
                code = self._arrays["code"]
                self._n_chunk = code.chunks[0]
                n_before = n_whole - n_whole % self._n_chunk
                if (n_whole - n_before) * code.shape[1] * code.dtype.itemsize > MAX_UNPACKED_BYTES:
                    raise FileError(folder, f"would unpack to more than {MAX_UNPACKED_BYTES} bytes")
                values = (array[n_before:n_whole] for array in self._arrays.values())
                self._chunk = n_before, list(zip(*values, strict=True))
            for array in self._arrays.values():
                array.resize((n_whole, *array.shape[1:]))

    def add(self, capture: Capture) -> None:
        """Add a frame; a chunk that is full is written."""
        if not self._arrays:
            self._begin(capture)
        n_before, frames = self._chunk
        told = capture.settings
        frames.append((capture.code, told.get("exposure_s", np.nan), told.get("frame", n_before + len(frames))))
        if len(frames) == self._n_chunk:
            self.write()
            self._chunk = self.n_whole, []

    def write(self) -> None:
        """Write the frames that are in memory alone."""
        n_before, frames = self._chunk
        n = n_before + len(frames)
        if n > self.n_whole:
            for array, values in zip(self._arrays.values(), zip(*frames, strict=True), strict=True):
                array.resize((n, *array.shape[1:]))
                array[n_before:] = np.asarray(values, array.dtype)
            self.n_whole = n
        self.written_s = time.monotonic()

    def _begin(self, capture: Capture) -> None:
        layout, n_sites = capture.layout, capture.layout.n_sites
        arrays = {}
        for path in self._folder.iterdir():  # of one that was ended before its first frame
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != LOCK:
                path.unlink()
        group = library(self._folder, "zarr").create_group(
            str(self._folder),
            attributes={
                "format": FORMAT,
                "version": VERSION,
                "filter_names": list(capture.filter_names),
                "bits": capture.bits,
                "white_dn": capture.white_dn.tolist(),
                "settings": _plain(capture.settings),
                "varied": [],
                "provenance": to_plain_data(dict(layout.provenance)),
                "plan": _plain(self._plan),
            },
        )
        for name in GEOMETRY:
            group.create_array(name, data=np.asarray(getattr(layout, name)))
        group.create_array("filter_of_site", data=np.asarray(capture.filter_of_site))
        group.create_group("columns")
        for name, values in layout.columns.items():
            group["columns"].create_array(name, data=np.asarray(values))
        self._n_chunk = max(1, CHUNK_CODES // max(n_sites, 1))
        for name, shape, dtype, n_chunk, fill in (
            ("code", (0, n_sites), capture.code.dtype, self._n_chunk, 0),
            ("exposure_s", (0,), np.dtype(np.float64), 4096, 0.0),
            ("frame", (0,), np.dtype(np.int64), 4096, NO_FRAME),
        ):
            chunks = (n_chunk, *(max(n, 1) for n in shape[1:]))
            arrays[name] = group.create_array(name, shape=shape, chunks=chunks, dtype=dtype, fill_value=fill)
        self._arrays = arrays
