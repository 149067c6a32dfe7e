"""Videos of captures as files: zarr folders that hold every code, pictures in a row, and video files to look at."""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.arrays import Floats, check_count, check_number
from foveasim.capture import Capture
from foveasim.errors import FileError, ParameterError
from foveasim.fields import Grid
from foveasim.files import written_whole
from foveasim.integrate import Integrator
from foveasim.layout import Layout
from foveasim.pictures import write_picture
from foveasim.reconstruct import Picture, fill_channels, raster_grid
from foveasim.reconstruct.picture import covered_share
from foveasim.records import described

__all__ = ["Recording", "read_recording", "write_video"]

FORMAT, VERSION = "foveasim video", 1
ZARR = ".zarr"
VIDEO_ENDINGS = (".mp4", ".mkv", ".mov", ".webm")
#: Codes that one chunk of a zarr folder holds, at least one frame of them: what is kept in memory while writing.
CHUNK_CODES = 1 << 22
#: What packs the numbers, as zarr does unless told otherwise; and a folder with more numbers beside the codes is refused.
CODECS = ("bytes", "zstd")
MAX_UNPACKED_BYTES = 8 * 2**30
NEEDS = {"zarr": "needs zarr: pip install 'foveasim[video]'", "av": "needs PyAV: pip install 'foveasim[video]'"}
#: Grey behind what no photosite sees, as a share of white.
BEHIND = 0.12


def write_video(
    captures: Iterable[Capture],
    path: str | Path,
    *,
    frame_s: float = 1.0 / 25.0,
    max_pixels: int = 512,
    n_frames: int | None = None,
    progress: bool = False,
) -> int:
    """
    Write captures as they come, whole or not at all.

    Parameters
    ----------
    captures : iterable of Capture
        Of the same layout, as :meth:`foveasim.Camera.video` gives them.
    path : path
        ``.zarr``: a folder with every code, which :func:`read_recording` reads. ``.mp4``, ``.mkv``, ``.mov``, ``.webm`` (with
        the extra ``video``) and ``.gif``: pictures to look at. Without an ending: a folder of pictures ``frame_000000.png`` ...
    frame_s : float, s
        How long a frame is shown.
    max_pixels : int
        Length of the longer side of pictures.
    n_frames : int, optional
        How many there will be, for the progress.
    progress : bool
        Whether to show how far it is, and how long it will still take.

    Returns
    -------
    n_frames : int
        How many were written.

    Raises
    ------
    FileError
        When the ending names no format, a library is missing, nothing can be written there, or something else is there.
    ParameterError
        When there is no capture, or a value is out of range.

    Notes
    -----
    In memory are a chunk of codes, or a frame, however long the video is. Until the last frame is written the target is not
    there, or is what it was before.
    """
    target = Path(path)
    frame_s = check_number("frame_s", frame_s, above=0.0)
    max_pixels = check_count("max_pixels", max_pixels, at_least=2)
    ending = target.suffix.lower()
    if progress:
        captures = _told(captures, n_frames)
    if ending == ZARR:
        return _write_zarr(captures, target)
    if ending == ".gif":
        return _write_gif(captures, target, frame_s, max_pixels)
    if ending in VIDEO_ENDINGS:
        return _write_film(captures, target, frame_s, max_pixels)
    if ending:
        raise FileError(
            target, f"must end in .zarr, .gif, {', '.join(VIDEO_ENDINGS)}, or have no ending, for a folder of pictures"
        )
    return _write_pictures(captures, target, max_pixels)


def _told(captures: Iterable[Capture], n_frames: int | None) -> Iterator[Capture]:
    from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (SpinnerColumn(), *Progress.get_default_columns()[:-1], TimeRemainingColumn(), TimeElapsedColumn())
    with Progress(*columns) as bar:
        yield from bar.track(captures, total=n_frames, description="frames")


@contextmanager
def _folder_written_whole(target: Path, *, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """A temporary folder, renamed to the target when the block ends well, removed otherwise."""
    if target.exists() and not is_ours(target):
        raise FileError(target, "cannot be written: something else is there")
    if not target.parent.is_dir():
        raise FileError(target, f"cannot be written: the folder {target.parent} does not exist")
    token = secrets.token_hex(8)
    new, old = (target.with_name(f".foveasim-{token}-{which}{target.suffix}") for which in ("new", "old"))
    try:
        new.mkdir()
        yield new
        if target.exists():
            target.rename(old)
        new.rename(target)
    except OSError as error:
        if old.exists() and not target.exists():
            old.rename(target)
        raise FileError(target, f"cannot be written: {error.strerror or error}") from None
    finally:
        for folder in (new, old):
            shutil.rmtree(folder, ignore_errors=True)


def _checked(captures: Iterable[Capture]) -> Iterator[Capture]:
    """The captures, of which all must be of one layout, and one at least must come."""
    layout: Layout | None = None
    for capture in captures:
        if not isinstance(capture, Capture):
            raise ParameterError("captures", f"must be Captures, got a {type(capture).__name__}")
        if layout is not None and capture.layout is not layout and capture.layout.n_sites != layout.n_sites:
            raise ParameterError("captures", f"must be of the same layout, got one of {capture.layout!r}")
        layout = capture.layout
        yield capture
    if layout is None:
        raise ParameterError("captures", "must hold at least one capture")


# -- zarr -------------------------------------------------------------------------------------------------------------


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
    zarr = _library(source, "zarr")
    if not source.is_dir():
        raise FileError(source, "is not a folder" if source.exists() else "no such folder")
    try:
        _check_codecs(source)
        group = zarr.open_group(str(source), mode="r")
        about = dict(group.attrs)
        if about.get("format") != FORMAT:
            raise FileError(source, "is no video of captures")
        if about.get("version") != VERSION:
            raise FileError(source, f"has the format version {about.get('version')}, expected {VERSION}")
        arrays = [array for name, array in (*group.arrays(), *group["columns"].arrays()) if name != "code"]
        if sum(array.nbytes for array in arrays) > MAX_UNPACKED_BYTES:
            raise FileError(source, f"would unpack to more than {MAX_UNPACKED_BYTES} bytes")
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
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 -- a broken folder makes its readers trip over anything
        raise FileError(source, f"is broken or no video of captures ({' '.join(str(error).split())})") from None


def _check_codecs(source: Path) -> None:
    """Refuse metadata that name other programs to run on the chunks than those that recordings are packed with."""
    for path in source.rglob("zarr.json"):
        metadata = json.loads(path.read_text(encoding="utf-8"))
        if metadata.get("storage_transformers"):
            raise FileError(source, "is packed in a way that no video of captures is")
        for codec in metadata.get("codecs", []):
            if codec.get("name") not in CODECS:
                raise FileError(source, f"is packed with {codec.get('name')!r:.40}, as no video of captures is")


def _write_zarr(captures: Iterable[Capture], target: Path) -> int:
    zarr = _library(target, "zarr")

    def is_recording(folder: Path) -> bool:
        try:
            return zarr.open_group(str(folder), mode="r").attrs.get("format") == FORMAT
        except Exception:  # noqa: BLE001 -- whatever else it is
            return False

    with _folder_written_whole(target, is_ours=is_recording) as folder:
        group = zarr.open_group(str(folder), mode="w")
        columns: dict[str, list[Any]] = {"code": [], "exposure_s": [], "frame": []}
        n_written, n_chunk = 0, 1

        def flush() -> None:
            nonlocal n_written
            n = len(columns["code"])
            for name, values in columns.items():
                array = group[name]
                array.resize((n_written + n, *array.shape[1:]))
                array[n_written:] = np.asarray(values, array.dtype)
                values.clear()
            n_written += n

        for k, capture in enumerate(_checked(captures)):
            if k == 0:
                n_sites = capture.layout.n_sites
                n_chunk = max(1, CHUNK_CODES // max(n_sites, 1))
                _write_about(group, capture)
                group.create_array(
                    "code", shape=(0, n_sites), chunks=(n_chunk, max(n_sites, 1)), dtype=capture.code.dtype
                )
                for name, kind in (("exposure_s", "f8"), ("frame", "i8")):
                    group.create_array(name, shape=(0,), chunks=(4096,), dtype=kind)
            columns["code"].append(capture.code)
            columns["exposure_s"].append(capture.settings.get("exposure_s", np.nan))
            columns["frame"].append(capture.settings.get("frame", k))
            if len(columns["code"]) == n_chunk:
                flush()
        if columns["code"]:
            flush()
    return n_written


def _write_about(group: Any, capture: Capture) -> None:
    layout = capture.layout
    for name in ("xy_um", "ring_offsets", "site_offsets"):
        group.create_array(name, data=np.asarray(getattr(layout, name)))
    group.create_array("filter_of_site", data=np.asarray(capture.filter_of_site))
    group.create_group("columns")
    for name, values in layout.columns.items():
        group["columns"].create_array(name, data=np.asarray(values))
    group.attrs.update(
        {
            "format": FORMAT,
            "version": VERSION,
            "filter_names": list(capture.filter_names),
            "bits": capture.bits,
            "white_dn": capture.white_dn.tolist(),
            "settings": json.loads(json.dumps(capture.settings)),
            "provenance": described(dict(layout.provenance)),
        }
    )


def _library(path: Path, name: str) -> Any:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise FileError(path, NEEDS[name]) from None


# -- pictures ---------------------------------------------------------------------------------------------------------


class _Raster:
    """Pictures of captures of one layout: its overlaps with the pixels are computed once."""

    def __init__(self, layout: Layout, max_pixels: int, *, is_even: bool = False) -> None:
        grid = raster_grid(layout, max_pixels)
        if is_even:  # video formats halve the colours' pixels
            grid = Grid(tuple(n + n % 2 for n in grid.shape), grid.pitch_um, grid.origin_um)  # type: ignore[arg-type]
        self._layout, self._integrator = layout, Integrator(layout, grid)
        self._share = covered_share(self._integrator)
        self._covered_um2 = np.where(self._share > 0.0, self._share, np.nan) * grid.cell_area_um2

    def image(self, capture: Capture) -> NDArray[np.uint8]:
        """Colours as a screen expects them, and coverage, (n_y, n_x, 2 or 4), first row on top."""
        values = capture.code.astype(np.float64)[np.newaxis]
        n_filters = len(capture.filter_names)
        if n_filters > 1:
            values = fill_channels(self._layout, values[0], capture.filter_of_site, n_filters)
            values = np.where(np.isnan(values), 0.0, values)
        data = (self._integrator.spread(values) / self._covered_um2).astype(np.float32)
        white: Any = capture.white_dn
        if n_filters not in (1, 3):
            data, white = data.mean(axis=0, keepdims=True), float(np.mean(white))
        picture = Picture(data, self._share.astype(np.float32), self._integrator.grid)
        return np.asarray(picture.to_image(white, encode_srgb=True), np.uint8)

    def flat(self, capture: Capture) -> NDArray[np.uint8]:
        """Colours over a dark grey, (n_y, n_x, 3)."""
        image = self.image(capture).astype(np.float64)
        colours, cover = image[..., :-1], image[..., -1:] / 255.0
        colours = colours * cover + 255.0 * BEHIND * (1.0 - cover)
        return np.ascontiguousarray(np.broadcast_to(np.rint(colours), (*colours.shape[:2], 3)).astype(np.uint8))


def _write_pictures(captures: Iterable[Capture], target: Path, max_pixels: int) -> int:
    def is_pictures(folder: Path) -> bool:
        return folder.is_dir() and all(p.name.startswith("frame_") and p.suffix == ".png" for p in folder.iterdir())

    n_frames = 0
    with _folder_written_whole(target, is_ours=is_pictures) as folder:
        raster: _Raster | None = None
        for capture in _checked(captures):
            raster = raster or _Raster(capture.layout, max_pixels)
            write_picture(folder / f"frame_{n_frames:06d}.png", raster.image(capture))
            n_frames += 1
    return n_frames


def _write_gif(captures: Iterable[Capture], target: Path, frame_s: float, max_pixels: int) -> int:
    from PIL import Image

    n_frames = 0

    def pictures() -> Iterator[Image.Image]:
        nonlocal n_frames
        raster: _Raster | None = None
        for capture in _checked(captures):
            raster = raster or _Raster(capture.layout, max_pixels)
            n_frames += 1
            yield Image.fromarray(raster.flat(capture)).quantize(256)

    with written_whole(target) as temporary:
        all_pictures = pictures()
        first = next(all_pictures)
        first.save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=all_pictures,
            duration=max(20, round(1000.0 * frame_s)),
            loop=0,
        )
    return n_frames


def _write_film(captures: Iterable[Capture], target: Path, frame_s: float, max_pixels: int) -> int:
    av = _library(target, "av")
    codec = "libvpx-vp9" if target.suffix.lower() == ".webm" else "libx264"
    n_frames = 0
    with written_whole(target) as temporary:
        try:
            with av.open(str(temporary), mode="w") as container:
                raster: _Raster | None = None
                stream: Any = None
                for capture in _checked(captures):
                    raster = raster or _Raster(capture.layout, max_pixels, is_even=True)
                    pixels = raster.flat(capture)
                    if stream is None:
                        stream = container.add_stream(codec, rate=Fraction(1.0 / frame_s).limit_denominator(1001))
                        stream.height, stream.width = pixels.shape[:2]
                        stream.pix_fmt = "yuv420p"
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
                    n_frames += 1
                container.mux(stream.encode())
        except av.FFmpegError as error:
            raise FileError(target, f"cannot be written as a video file ({error})") from None
    return n_frames
