"""Stacks of frames of a camera: arrays, or files that are read one frame at a time."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import Limits, OwnCheck, check_declared
from foveasim.errors import FileError, ParameterError
from foveasim.sensor.limits import EXPOSURE, TEMPERATURE
from foveasim.twin.frame_files import stored_frames

__all__ = ["Stack", "read_stacks"]

LIGHT = Limits(at_least=0.0, at_most=1e12, hint="0 is dark; other values are relative, such as 1 for a constant lamp")
#: Names of directories of stacks: dark_10ms, flat-2.5ms.
STACK_NAME = re.compile(r"(dark|flat)[ _-]*(\d+(?:\.\d+)?)[ _-]*(us|ms|s)(?:[ _-].*)?", re.IGNORECASE)
SECONDS = {"us": 1e-6, "ms": 1e-3, "s": 1.0}


@dataclass(frozen=True, eq=False)
class Stack:
    """
    Frames of one exposure time and one level of light.

    Parameters
    ----------
    frames : (n_frame, n_y, n_x) array, or a sequence of (n_y, n_x) arrays or of files
        Raw codes of at least two frames, the top row of the upright picture first. Files are ``.npy``, TIFF, PNG, FITS (bottom
        row first, unless ``ROWORDER`` says otherwise) or raw files of cameras (extra ``pictures``), of one or several frames,
        and are read one after the other.
    exposure_s : float, s
    light : float, optional
        Relative irradiance, which is equal for all stacks with the same number: 0 in the dark, 1 for a constant lamp. None if
        it is unknown.
    photons : float, optional
        Photons that reach a pixel in the exposure, by a calibrated photometer, instead of ``light``.
    temperature_k : float, K, optional
    name : str
        For messages and the report.

    Raises
    ------
    ParameterError
        If a value is out of range, or both ``light`` and ``photons`` are given.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> dark = fs.twin.Stack(np.zeros((4, 8, 8), np.uint16), exposure_s=0.01, light=0)
    >>> dark.is_dark
    True
    """

    frames: OwnCheck[Any]
    exposure_s: Annotated[float, EXPOSURE]
    light: Annotated[float | None, LIGHT] = None
    photons: Annotated[float | None, LIGHT] = None
    temperature_k: Annotated[float | None, TEMPERATURE] = None
    name: str = ""

    def __post_init__(self) -> None:
        check_declared(self)
        if self.light is not None and self.photons is not None:
            raise ParameterError("photons", "must not be given together with 'light'")

    def __repr__(self) -> str:
        return f"Stack({self.name or 'frames'!r}, {self.exposure_s:g} s)"

    @property
    def is_dark(self) -> bool:
        """Whether there is no light."""
        return self.light == 0.0 or self.photons == 0.0

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield the frames, (n_y, n_x) each."""
        if isinstance(self.frames, np.ndarray) and self.frames.ndim == 3:
            yield from self.frames
            return
        if not isinstance(self.frames, Sequence):
            raise ParameterError(
                "frames", "must be an array (n_frame, n_y, n_x), or a list of frames or files", self.frames
            )
        for each in self.frames:
            if isinstance(each, str | Path):
                frames, first_row = stored_frames(Path(each))
                yield from (frame if first_row == "top" else frame[::-1] for frame in frames)
            else:
                yield np.asarray(each)


def read_stacks(folder: str | Path) -> list[Stack]:
    """
    Find the stacks of a folder.

    Each subfolder is a stack, whose name says what it contains: ``dark_10ms``, ``flat_2.5ms``. All ``flat`` stacks have the
    same light. Otherwise, a file ``stacks.yaml`` lists the stacks::

        stacks:
          - {frames: "dark/*.tif", exposure_s: 0.01, light: 0}
          - {frames: "lamp_low/*.tif", exposure_s: 0.01, photons: 1500}

    Parameters
    ----------
    folder : path

    Returns
    -------
    list of Stack
        Files are not read yet.

    Raises
    ------
    FileError
        When there are no stacks, or ``stacks.yaml`` has an error.
    """
    base = Path(folder)
    if not base.is_dir():
        raise FileError(base, "must be a folder of stacks of frames")
    listed = base / "stacks.yaml"
    stacks = _listed(listed) if listed.is_file() else _named(base)
    if not stacks:
        raise FileError(
            base, "contains no stacks: name subfolders as dark_10ms and flat_10ms, or list the stacks in stacks.yaml"
        )
    return stacks


def _listed(path: Path) -> list[Stack]:
    from foveasim._io.yaml_files import read_yaml

    found = read_yaml(path)
    entries = found.get("stacks")
    if not isinstance(entries, list) or set(found) != {"stacks"}:
        raise FileError(path, "must be a list 'stacks' of {frames: ..., exposure_s: ..., light: ...}")
    names = {"frames", "exposure_s", "light", "photons", "temperature_k", "name"}
    stacks = []
    for k, entry in enumerate(entries):
        if not isinstance(entry, dict) or not {"frames", "exposure_s"} <= set(entry) or not set(entry) <= names:
            raise FileError(
                path, f"stacks[{k}] must have 'frames' and 'exposure_s', and may have {', '.join(sorted(names))}"
            )
        pattern = str(entry["frames"])
        files = sorted(path.parent.glob(pattern))
        if not files:
            raise FileError(path, f"stacks[{k}]: no files match {pattern}")
        try:
            stacks.append(Stack(files, **{"name": pattern} | {key: entry[key] for key in entry if key != "frames"}))
        except ParameterError as error:
            raise FileError(path, f"stacks[{k}]: {error}") from None
    return stacks


def _named(base: Path) -> list[Stack]:
    stacks = []
    for directory in sorted(each for each in base.iterdir() if each.is_dir() and not each.name.startswith(".")):
        match = STACK_NAME.fullmatch(directory.name)
        if match is None:
            continue
        files = sorted(each for each in directory.iterdir() if each.is_file() and not each.name.startswith("."))
        if not files:
            raise FileError(directory, "contains no frames")
        kind, number, unit = match.groups()
        exposure_s = float(number) * SECONDS[unit.lower()]
        stacks.append(Stack(files, exposure_s, light=float(kind.lower() == "flat"), name=directory.name))
    return sorted(stacks, key=lambda each: (not each.is_dark, each.exposure_s))
