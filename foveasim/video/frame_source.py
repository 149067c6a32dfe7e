"""Frame sources: pictures in a row, from memory, a directory or a video file, as scenes."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.extras import needs
from foveasim._core.validation import check_count, check_number
from foveasim._io.images import PICTURE_ENDINGS, check_picture_size, picture_names
from foveasim.errors import FileError, ParameterError, printable
from foveasim.scene import Scene

__all__ = ["FrameSource", "pictures_in"]

#: Any wavelengths: they are left off again.
GREY_NM, COLOUR_NM = (550.0,), (620.0, 550.0, 450.0)
#: More frames than anyone has.
MAX_FRAMES = 2**31
NEEDS_PYAV = needs("av")


class FrameSource:
    """
    Frames of light from pictures; iterating gives a Scene for each, read when it is asked for.

    Parameters
    ----------
    source : path, or iterable of paths or arrays
        A folder of pictures, in the natural order of their names (``frame 2`` before ``frame 10``); a video file, with the
        extra ``video``; or the pictures themselves, as :meth:`foveasim.Scene.from_picture` takes them. An iterator gives
        them once, and the footage can be iterated once then.
    start, stop, step : int
        Which of the frames: as of a slice.
    frame_s : float, optional, s
        From one frame to the next; by default what the video file says.
    template : Scene, optional
        A scene whose pitch, distance and spectra the frames have, with the pictures in place of its own: colours are made grey
        for a scene of one basis image, and grey is made colour for one of three.
    **scene
        Of :meth:`foveasim.Scene.from_picture`: ``pitch_um``, ``distance_m``, ``peak_radiance_w_m2_sr_nm``, and others; beside
        ``template`` the ``encoding`` alone.

    Raises
    ------
    FileError
        When there is no such file, a folder holds no pictures, or, as frames are read, one is broken or of another size.
    ParameterError
        When a value is out of range, a setting of the scene is missing or unknown, or there is no frame at all.

    Examples
    --------
    >>> import numpy as np
    >>> pictures = [np.full((4, 6), level) for level in (0.25, 0.5)]
    >>> footage = FrameSource(
    ...     pictures, pitch_um=10.0, distance_m=1.0, peak_radiance_w_m2_sr_nm=0.1, band_width_nm=10.0, encoding="linear"
    ... )
    >>> [float(scene.basis.max()) for scene in footage]
    [0.25, 0.5]
    """

    def __init__(
        self,
        source: str | Path | Iterable[str | Path | ArrayLike],
        *,
        start: int = 0,
        stop: int | None = None,
        step: int = 1,
        frame_s: float | None = None,
        template: Scene | None = None,
        **scene: Any,
    ) -> None:
        if template is not None and not isinstance(template, Scene):
            raise ParameterError("template", f"must be a Scene, got a {type(template).__name__}")
        if template is not None and template.basis.shape[0] not in (1, 3):
            raise ParameterError(
                "template", f"must have 1 or 3 basis images, as pictures have, got {template.basis.shape[0]}"
            )
        if template is not None and set(scene) - {"encoding"}:
            raise ParameterError(
                min(set(scene) - {"encoding"}), "is that of the scene 'template', and cannot be given beside it"
            )
        if template is None:
            _check_settings(scene)
        self._template = template
        self._start = check_count("start", start, at_least=0, at_most=MAX_FRAMES)
        self._stop = None if stop is None else check_count("stop", stop, at_least=0, at_most=MAX_FRAMES)
        self._step = check_count("step", step, at_most=MAX_FRAMES)
        self._scene = scene
        self._source: Iterable[Any]
        self._n_source: int | None = None
        told_s: float | None = None
        if isinstance(source, str | Path):
            path = Path(source)
            if path.is_dir():
                self._source = pictures_in(path)
                self._n_source = len(self._source)
            elif path.is_file():
                self._source = _VideoFile(path)
                self._n_source, told_s = self._source.n_frames, self._source.frame_s
            else:
                raise FileError(path, "no such file or folder")
        elif isinstance(source, Iterable):
            self._source = _Once(source) if isinstance(source, Iterator) else source
            self._n_source = len(source) if isinstance(source, Sized) else None
        else:
            raise ParameterError("source", f"must be a path, or pictures, got a {type(source).__name__}")
        if frame_s is not None:
            told_s = check_number("frame_s", frame_s, above=0.0)
        self._frame_s = None if told_s is None else told_s * (self._step if frame_s is None else 1)
        self._may_be_empty = False
        if self._n_source is not None and not isinstance(self._source, _VideoFile):  # whose number is an estimate
            self._check_some(self.n_frames)

    def __repr__(self) -> str:
        return f"FrameSource({self.n_frames or 'any number of'} frames)"

    @property
    def frame_s(self) -> float | None:
        """Seconds from one frame to the next; None where nobody said."""
        return self._frame_s

    @property
    def n_frames(self) -> int | None:
        """How many frames there are; None where that is not known before the last."""
        if self._n_source is None:
            return None
        return len(
            range(self._start, min(self._n_source, self._n_source if self._stop is None else self._stop), self._step)
        )

    def from_frame(self, n: int) -> FrameSource:
        """
        The same frames without the first ``n``, which are passed over and not made into scenes.

        Parameters
        ----------
        n : int

        Returns
        -------
        FrameSource

        Raises
        ------
        ParameterError
            When ``n`` is negative or not whole.
        """
        rest = copy.copy(self)
        rest._start += check_count("n", n, at_least=0, at_most=MAX_FRAMES) * self._step  # noqa: SLF001 -- its own
        rest._may_be_empty = True  # noqa: SLF001
        return rest

    def _check_some(self, n_frames: int | None) -> None:
        if n_frames == 0 and not self._may_be_empty:
            told = "any number of" if self._n_source is None else f"{self._n_source:,}"
            until = "" if self._stop is None else f" to before {self._stop}"
            raise ParameterError("source", f"has no frame from {self._start}{until}, of {told} pictures")

    def __iter__(self) -> Iterator[Scene]:
        """Scenes, one after the other."""
        shape: tuple[int, ...] | None = None
        pictures: Iterator[Any] = islice(iter(self._source), self._start, self._stop, self._step)
        if isinstance(self._source, _VideoFile):  # frames that are passed over are decoded, and no more
            pictures = _pixels(self._source.path, pictures)
        for k, picture in enumerate(pictures):
            scene = Scene.from_picture(picture, **self._scene) if self._template is None else self._made_like(picture)
            if shape is not None and scene.basis.shape != shape:
                where = picture if isinstance(picture, str | Path) else f"frame {self._start + k * self._step}"
                raise FileError(
                    where, f"has the shape {scene.basis.shape}, and the frames before it {shape}: all must be alike"
                )
            shape = scene.basis.shape
            yield scene
        self._check_some(0 if shape is None else None)

    def _made_like(self, picture: Any) -> Scene:
        template = self._template
        assert template is not None
        n_basis = template.basis.shape[0]
        read = Scene.from_picture(
            picture,
            pitch_um=template.pitch_um,
            distance_m=template.distance_m,
            peak_radiance_w_m2_sr_nm=1.0,
            # One wavelength makes colours grey. The spectra are those of the other scene.
            wavelength_nm=GREY_NM if n_basis == 1 else COLOUR_NM,
            band_width_nm=1.0,
            **self._scene,
        )
        basis = np.broadcast_to(read.basis, (n_basis, *read.basis.shape[1:]))
        return replace(template, basis=basis, source=read.source)


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder, in the natural order of their names."""
    names = picture_names(path.name for path in folder.iterdir() if path.is_file())
    if not names:
        raise FileError(folder, f"holds no pictures ({', '.join(PICTURE_ENDINGS)})")
    return [folder / name for name in names]


def _check_settings(scene: dict[str, Any]) -> None:
    """Reject settings that Scene.from_picture does not take, and lack those that it needs, before the first picture is read."""
    parameters = list(inspect.signature(Scene.from_picture).parameters.values())[1:]
    names = [p.name for p in parameters]
    for name in scene:
        if name not in names:
            raise ParameterError(name, f"is no setting of a scene from a picture; there are {', '.join(names)}")
    for parameter in parameters:
        if parameter.default is parameter.empty and parameter.name not in scene:
            raise ParameterError(
                parameter.name, "is missing: a scene from a picture needs it, or give a scene as 'template'"
            )


class _Once:
    """What an iterator gives, for who begins first."""

    def __init__(self, pictures: Iterator[Any]) -> None:
        self._pictures: Iterator[Any] | None = pictures

    def __iter__(self) -> Iterator[Any]:
        if self._pictures is None:
            raise ParameterError(
                "source", "was an iterator, whose pictures are gone after the first time", hint="give a list of them"
            )
        pictures, self._pictures = self._pictures, None
        return pictures


class _VideoFile:
    """Frames of a video file as the decoder gives them, which become (n_y, n_x, 3) uint8, first row on top."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _opened(path) as container, _readable(path, "is corrupt"):
            stream = container.streams.video[0]
            rate = stream.average_rate or stream.base_rate
            self.frame_s = float(1 / rate) if rate and rate > 0 else None
            self.n_frames: int | None = int(stream.frames) if stream.frames > 0 else None

    def __iter__(self) -> Iterator[Any]:
        with _opened(self.path) as container:
            n_read = 0
            with _readable(self.path, "is corrupt"):
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                frames = iter(container.decode(stream))
            while True:
                with _readable(self.path, f"is corrupt after frame {n_read}"):
                    frame = next(frames, None)
                if frame is None:
                    break
                yield frame
                n_read += 1
            if n_read == 0:
                raise FileError(self.path, "holds no frames")


def _pixels(path: Path, frames: Iterator[Any]) -> Iterator[NDArray[np.uint8]]:
    """Decode frames to pixels; a size that a corrupt file claims is checked before memory is taken for it."""
    for frame in frames:
        check_picture_size(path, frame.width, frame.height)
        with _readable(path, "is corrupt"):
            pixels = frame.to_ndarray(format="rgb24")
        yield pixels


def _opened(path: Path) -> Any:
    try:
        import av
    except ImportError:
        raise FileError(path, NEEDS_PYAV) from None
    with _readable(path, "is no video file that can be read"):
        # Titles and the like are not used: one that is corrupt does not matter.
        container = av.open(str(path), metadata_errors="replace")
    if not container.streams.video:
        container.close()
        raise FileError(path, "holds no pictures that move")
    if (
        container.streams.video[0].codec_context is None
    ):  # some versions of PyAV crash where they are asked to decode it
        container.close()
        raise FileError(path, "holds pictures in a coding that is unknown here")
    return container


@contextmanager
def _readable(path: Path, problem: str) -> Iterator[None]:
    """What the video library raises in the block, as a FileError: a corrupt file makes it raise anything."""
    try:
        yield
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise FileError(path, f"{problem} ({printable(reason):.160})") from None
