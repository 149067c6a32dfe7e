"""Recordings: videos of all codes in zarr stores, written frame by frame and resumable."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.names import missing_path
from foveasim._core.provenance import differences, to_plain_data
from foveasim._core.validation import Floats, check_count
from foveasim._io.atomic import atomic_directory
from foveasim._io.resumable import LOCK, disk_errors, partial_path, resumable_directory
from foveasim._io.zarr_stores import ZARR, free_names, named_arrays, open_group, store_format
from foveasim.camera._frames import DIGEST_BYTES
from foveasim.capture import Capture
from foveasim.errors import FileError, ParameterError, type_name
from foveasim.layout import Layout
from foveasim.layout.packed import layout_to_arrays

__all__ = [
    "Recording",
    "check_consistent",
    "count_recorded_frames",
    "partial_path",
    "read_recording",
    "record",
    "resume_recording",
]

FORMAT, VERSION = "foveasim video", 3
#: Codes per chunk of a zarr store, but at least one frame; one chunk is in memory while writing.
CHUNK_CODES = 1 << 22
#: Resumable recordings are written at this interval or earlier: upper limit of the loss after a crash.
WRITE_S = 10.0
#: Allowed codecs, the defaults of zarr; and size limit of the arrays other than the codes.
CODECS = ("bytes", "zstd")
MAX_DECOMPRESSED_BYTES = 8 * 2**30
#: Arrays of the layout, and arrays that grow frame by frame: frame numbers are written last and mark complete frames.
LAYOUT_ARRAYS = ("xy_um", "ring_offsets", "site_offsets")
FRAME_ARRAYS = ("code", "exposure_s", "gaze_um", "next_path", "time_s", "frame")
#: Fill value of frame numbers, for incomplete frames.
NO_FRAME = -1
#: Digest of the rest of a gaze path where it ends, and in frames without a path.
NO_PATH = bytes(DIGEST_BYTES).hex()
#: Settings that may always differ between captures of one recording.
FRAME_SETTINGS = frozenset(
    {
        "exposure_s",
        "frame",
        "time_s",
        "light.source",
        "light.panorama.gaze_deg",
        "place_um",
        "gaze_um",
        "gaze_path",
        "next_gaze_path",
    }
)


# -- reading ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Recording:
    """
    A video of captures in a zarr store.

    Attributes
    ----------
    code : zarr array (n_frame, n_site) uint8 or uint16, DN
        Codes, read lazily: ``code[k]`` is a frame, ``code[:, site]`` the time series of a site.
    exposure_s : (n_frame,) float64, s
        Exposure times.
    frame : (n_frame,) int64
        Frame numbers, which select the random streams of the noise.
    gaze_um : (n_frame, 2) float64, µm
        Gaze position at the first source frame of each capture, in the image of the complete picture; 0 for frames without
        positions.
    layout : Layout
        Layout of the photosites.
    filter_names : tuple of str
        Names of the colour filters.
    filter_of_site : (n_site,) signed integers
        Index of the filter of each site.
    bits : int
        Bit depth of the codes.
    white_dn : (n_filter,) float64, DN
        White level per filter.
    settings : mapping
        Settings of the first frame.
    times_s : (n_frame,) float64, s
        Times of the first source frames of the captures; NaN where they are unknown.
    """

    code: Any
    exposure_s: Floats
    frame: NDArray[np.int64]
    gaze_um: Floats
    layout: Layout
    filter_names: tuple[str, ...]
    filter_of_site: NDArray[Any]
    bits: int
    white_dn: Floats
    settings: dict[str, Any]
    times_s: Floats

    def __repr__(self) -> str:
        return f"Recording({self.n_frames} frames of {self.layout.n_sites} sites, {self.bits} bits)"

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return int(self.code.shape[0])


def read_recording(path: str | Path) -> Recording:
    """
    Open a zarr store that :func:`write_video` wrote; codes are read lazily.

    Raises
    ------
    FileError
        When the store is missing, corrupt, or not a video of captures.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> sensor = fs.Sensor.from_preset(
    ...     fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0), "machine_vision"
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=300.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "wall.zarr")
    ...     _ = fs.video.write_video(
    ...         camera.video([scene] * 3, exposure_s=0.001, seed=0), path
    ...     )
    ...     print(
    ...         fs.video.read_recording(path).code.shape,
    ...         fs.video.read_recording(path).frame.tolist(),
    ...     )
    (3, 64) [0, 1, 2]
    """
    source = Path(path)
    import_optional(source, "zarr")
    if not source.is_dir():
        raise FileError(source, missing_path(source, "directory"))
    with _open_checked(source) as group:
        about = group.attrs
        stored = named_arrays(group["columns"], about.get("columns"))
        columns = {name: values[:] for name, values in stored.items()}
        return Recording(
            code=group["code"],
            exposure_s=group["exposure_s"][:],
            frame=group["frame"][:],
            gaze_um=group["gaze_um"][:],
            times_s=group["time_s"][:],
            layout=Layout(
                group["xy_um"][:], group["ring_offsets"][:], group["site_offsets"][:], columns, about["provenance"]
            ),
            filter_names=tuple(about["filter_names"]),
            filter_of_site=group["filter_of_site"][:],
            bits=int(about["bits"]),
            white_dn=np.asarray(about["white_dn"], np.float64),
            settings=about["settings"],
        )


def count_recorded_frames(path: str | Path) -> int:
    """
    Return the number of frames of a finished or interrupted recording.

    Parameters
    ----------
    path : path
        Path of the recording, as for :func:`write_video` with ``resume``.

    Returns
    -------
    n_frames : int
        0 if there is no recording.

    Raises
    ------
    FileError
        When the path contains other data, or the recording is corrupt.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     print(fs.video.count_recorded_frames(Path(directory, "long.zarr")))  # not begun
    0
    """
    target = Path(path)
    if target.suffix.lower() != ZARR:
        raise FileError(target, "must end in .zarr; other formats cannot be resumed")
    import_optional(target, "zarr")
    if target.exists():
        with _open_checked(target) as group:
            return int(group["code"].shape[0])
    directory = partial_path(target)
    return _count_complete(directory) if directory.exists() else 0


@contextmanager
def _open_checked(source: Path, mode: str = "r") -> Iterator[Any]:
    """Open the group of an untrusted recording; exceptions of the block become FileErrors."""
    with open_group(source, "video of captures", CODECS, FORMAT, VERSION, mode) as group:
        names = (*LAYOUT_ARRAYS, "filter_of_site", *(name for name in FRAME_ARRAYS if name != "code"))
        arrays = [group[name] for name in names if name in group]
        arrays += [array for _, array in group["columns"].arrays()] if "columns" in group else []
        if sum(array.nbytes for array in arrays) > MAX_DECOMPRESSED_BYTES:
            raise FileError(source, f"would decompress to more than {MAX_DECOMPRESSED_BYTES} bytes")
        yield group


def _is_recording(directory: Path) -> bool:
    return store_format(directory) == FORMAT


# -- writing ----------------------------------------------------------------------------------------------------------


def check_consistent(captures: Iterable[Capture], *, n_before: int = 0) -> Iterator[Capture]:
    """Yield the captures after checking that they have the same number of sites and bits."""
    first: tuple[int, int] | None = None
    for capture in captures:
        if not isinstance(capture, Capture):
            raise ParameterError("captures", f"must be Captures, got {type_name(capture)}")
        kind = capture.layout.n_sites, capture.bits
        first = kind if first is None else first
        if kind != first:
            raise ParameterError("captures", f"must have the same layout and bits, got {capture!r}")
        yield capture
    if first is None and n_before == 0:
        raise ParameterError("captures", "must contain at least one capture")


def record(captures: Iterable[Capture], target: Path, plan: Mapping[str, Any] | None) -> int:
    """Write captures to a zarr store atomically; return their number."""
    import_optional(target, "zarr")
    with atomic_directory(target, is_ours=_is_recording) as directory:
        frames = _Frames(directory, plan)
        for capture in check_consistent(captures):
            frames.add(capture)
        frames.write()
    return frames.n_complete


def resume_recording(captures: Iterable[Capture], target: Path, plan: Mapping[str, Any] | None) -> int:
    """Append captures to a resumable recording; return the total number of frames."""
    import_optional(target, "zarr")
    if target.exists():
        return _count_finished(captures, target, plan)
    with resumable_directory(target, "recording", is_ours=_is_recording, has_content=_count_complete) as unfinished:
        directory = unfinished.directory
        n_before = _count_complete(directory)
        if n_before:
            _check_plan(directory, plan)
        with disk_errors(target):
            frames = _Frames(directory, plan, n_before)
        try:
            for capture in _check_continuation(check_consistent(captures, n_before=n_before), directory, n_before):
                with disk_errors(target):
                    frames.add(capture)
                    if time.monotonic() - frames.written_s > WRITE_S:
                        frames.write()
            with disk_errors(target):
                frames.write()
                unfinished.finish(target)
        except BaseException as error:
            with suppress(Exception):
                frames.write()
            if frames.n_complete:
                error.add_note(
                    f"{frames.n_complete:,} frames are stored in {directory}; the same call resumes the recording"
                )
            raise
    return frames.n_complete


def _count_finished(captures: Iterable[Capture], target: Path, plan: Mapping[str, Any] | None) -> int:
    """Return the number of frames of a finished recording; reject further captures."""
    if not _is_recording(target):
        raise FileError(target, "cannot be written: the path contains other data; choose another path")
    _check_plan(target, plan)
    n = count_recorded_frames(target)
    # The same plan has no further captures; without a plan, check that there are none.
    if plan is None and next(iter(captures), None) is not None:
        raise FileError(
            target,
            f"is a finished recording of {n:,} frames, to which captures cannot be appended; choose another path, or delete "
            "the recording",
        )
    return n


def _count_complete(directory: Path) -> int:
    """Return the number of complete frames of an unfinished recording."""
    if not (directory / "frame" / "zarr.json").exists():
        return 0
    with _open_checked(directory) as group:
        frame = group["frame"][:]
    return int(np.argmax(frame == NO_FRAME)) if (frame == NO_FRAME).any() else frame.size


def _check_plan(path: Path, plan: Mapping[str, Any] | None) -> None:
    """Reject a recording that has another plan."""
    with _open_checked(path) as group:
        found = group.attrs.get("plan")
    _reject(path, differences(found, _json_round_trip(plan)))


def _reject(path: Path, different: Iterable[str]) -> None:
    for name in different:
        raise FileError(
            path,
            f"is another recording: '{name}' differs; choose another path, or delete that recording",
        )


def _check_continuation(captures: Iterable[Capture], directory: Path, n_before: int) -> Iterator[Capture]:
    """
    Yield the captures after checking that they continue the frames in the directory.

    Frame numbers must be consecutive. Settings that differed between earlier frames of the recording may differ again; other
    differences mean that it is another recording.
    """
    first: dict[str, Any] | None = None
    may_differ, next_frame, before_s = set(FRAME_SETTINGS), None, np.nan
    if n_before:
        with _open_checked(directory) as group:
            first, next_frame = group.attrs["settings"], int(group["frame"][n_before - 1]) + 1
            next_path = group["next_path"][n_before - 1].tobytes().hex()
            before_s = float(group["time_s"][n_before - 1])
            may_differ |= set(group.attrs["varied"])
    for k, capture in enumerate(captures, n_before):
        settings = _json_round_trip(capture.settings)
        frame = check_count("frame", settings.get("frame", k), at_least=0)
        if next_frame is not None and frame != next_frame:
            raise ParameterError(
                "captures",
                f"must have consecutive frame numbers for a resumable recording: expected {next_frame} after {k:,} frames; "
                f"skip the scenes of the first {k:,} frames, and set 'first_frame'",
                frame,
            )
        first = settings if first is None else first
        different = [name for name in differences(first, settings) if name not in may_differ]
        if n_before and k == n_before:
            _reject(directory, _property_differences(directory, capture))
            _reject(directory, different)
            if settings.get("gaze_path", NO_PATH) != next_path:
                _reject(directory, ["gaze_path"])
            if np.isnan(before_s) != ("time_s" not in settings) or settings.get("time_s", np.inf) <= before_s:
                _reject(directory, ["time_s"])
        elif different:
            may_differ |= set(different)
            with _open_checked(directory, "r+") as group:
                pass
            with disk_errors(directory):
                group.attrs["varied"] = sorted(may_differ - FRAME_SETTINGS)
        next_frame = frame + 1
        yield capture


def _property_differences(directory: Path, capture: Capture) -> Iterator[str]:
    """Yield the names of properties (not settings) that differ from those of a recording."""
    found = read_recording(directory)
    stored, new = layout_to_arrays(found.layout), layout_to_arrays(capture.layout)
    if stored.keys() != new.keys() or any(not np.array_equal(stored[name], new[name]) for name in new):
        yield "layout"
    if found.bits != capture.bits or found.code.dtype != capture.code.dtype:
        yield "bits"
    is_same = np.array_equal(found.filter_of_site, capture.filter_of_site)
    if found.filter_names != tuple(capture.filter_names) or not is_same:
        yield "filters"


def _json_round_trip(data: Mapping[str, Any] | None) -> Any:
    """Return data after a JSON round trip, as read from a file."""
    return json.loads(json.dumps(None if data is None else dict(data)))


class _Frames:
    """
    Writer of frames to a recording, with the last incomplete chunk in memory.

    A chunk is written again when frames are added to it, and each of its files is written atomically: frames that are marked
    complete are preserved if the process ends at any time.
    """

    def __init__(self, directory: Path, plan: Mapping[str, Any] | None, n_complete: int = 0) -> None:
        self._directory, self._plan = directory, plan
        self._arrays: dict[str, Any] = {}
        self._n_chunk = 1
        # Number of frames before the chunk, and its frames: one tuple, so that Ctrl-C cannot leave them inconsistent.
        self._chunk: tuple[int, list[tuple[Any, ...]]] = 0, []
        self.n_complete, self.written_s = n_complete, time.monotonic()
        if n_complete:
            with _open_checked(directory, "r+") as group:
                self._arrays = {name: group[name] for name in FRAME_ARRAYS}
                code = self._arrays["code"]
                self._n_chunk = code.chunks[0]
                n_before = n_complete - n_complete % self._n_chunk
                if (n_complete - n_before) * code.shape[1] * code.dtype.itemsize > MAX_DECOMPRESSED_BYTES:
                    raise FileError(directory, f"would decompress to more than {MAX_DECOMPRESSED_BYTES} bytes")
                values = (array[n_before:n_complete] for array in self._arrays.values())
                self._chunk = n_before, list(zip(*values, strict=True))
            for array in self._arrays.values():
                array.resize((n_complete, *array.shape[1:]))

    def add(self, capture: Capture) -> None:
        """Add a frame, and write the chunk if it is full."""
        if not self._arrays:
            self._create_arrays(capture)
        n_before, frames = self._chunk
        settings = capture.settings
        frames.append(
            (
                capture.code,
                settings.get("exposure_s", np.nan),
                settings.get("gaze_um", (0.0, 0.0)),
                np.frombuffer(bytes.fromhex(settings.get("next_gaze_path", NO_PATH)), np.uint8),
                settings.get("time_s", np.nan),
                settings.get("frame", n_before + len(frames)),
            )
        )
        if len(frames) == self._n_chunk:
            self.write()
            self._chunk = self.n_complete, []

    def write(self) -> None:
        """Write the frames that are only in memory."""
        n_before, frames = self._chunk
        n = n_before + len(frames)
        if n > self.n_complete:
            for array, values in zip(self._arrays.values(), zip(*frames, strict=True), strict=True):
                array.resize((n, *array.shape[1:]))
                array[n_before:] = np.asarray(values, array.dtype)
            self.n_complete = n
        self.written_s = time.monotonic()

    def _create_arrays(self, capture: Capture) -> None:
        layout, n_sites = capture.layout, capture.layout.n_sites
        arrays = {}
        for path in self._directory.iterdir():  # of a recording that was interrupted before its first frame
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != LOCK:
                path.unlink()
        names = free_names(layout.columns)
        group = import_optional(self._directory, "zarr").create_group(
            str(self._directory),
            attributes={
                "format": FORMAT,
                "version": VERSION,
                "filter_names": list(capture.filter_names),
                "bits": capture.bits,
                "white_dn": capture.white_dn.tolist(),
                "settings": _json_round_trip(capture.settings),
                "varied": [],
                "provenance": to_plain_data(dict(layout.provenance)),
                "columns": names,
                "plan": _json_round_trip(self._plan),
            },
        )
        for name in LAYOUT_ARRAYS:
            group.create_array(name, data=np.asarray(getattr(layout, name)))
        group.create_array("filter_of_site", data=np.asarray(capture.filter_of_site))
        group.create_group("columns")
        for name, values in layout.columns.items():
            group["columns"].create_array(names[name], data=np.asarray(values))
        self._n_chunk = max(1, CHUNK_CODES // max(n_sites, 1))
        for name, shape, dtype, n_chunk, fill in (
            ("code", (0, n_sites), capture.code.dtype, self._n_chunk, 0),
            ("exposure_s", (0,), np.dtype(np.float64), 4096, 0.0),
            ("gaze_um", (0, 2), np.dtype(np.float64), 4096, 0.0),
            ("next_path", (0, DIGEST_BYTES), np.dtype(np.uint8), 4096, 0),
            ("time_s", (0,), np.dtype(np.float64), 4096, np.nan),
            ("frame", (0,), np.dtype(np.int64), 4096, NO_FRAME),
        ):
            chunks = (n_chunk, *(max(n, 1) for n in shape[1:]))
            arrays[name] = group.create_array(name, shape=shape, chunks=chunks, dtype=dtype, fill_value=fill)
        self._arrays = arrays
