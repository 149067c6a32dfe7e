"""Fit of a sensor to the frames of a camera."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal
from zipfile import BadZipFile

import numpy as np

from foveasim._core.calls import Limits, OwnCheck
from foveasim._core.work_arrays import release_memory
from foveasim._io.npz import read_archive, write_archive
from foveasim.errors import FoveasimError, FoveasimWarning, ParameterError, warn
from foveasim.metrics.emva import MAX_UNDERFLOW_FRACTION
from foveasim.sensor.adc import ADC, BITS, LOG_STRENGTH, Companding
from foveasim.twin.fitting.fitting import fit_statistics
from foveasim.twin.frames.result import Twin, twin_of
from foveasim.twin.frames.stacks import Stack, read_stacks
from foveasim.twin.frames.statistics import StackStatistics, sum_frames

__all__ = ["fit"]

PIXEL = Limits(above=0.0, low=0.1, at_most=1e3, hint="the side of a pixel, in µm")
#: Arrays of the statistics of a stack.
STORED = tuple(each.name for each in fields(StackStatistics))


def fit(
    frames: OwnCheck[str | Path | Sequence[Stack]],
    *,
    bits: Annotated[int, BITS],
    pixel_um: Annotated[float, PIXEL],
    mosaic: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None,
    companding: Companding = "linear",
    log_strength: Annotated[float, LOG_STRENGTH] = 100.0,
    companding_table: Sequence[float] | None = None,
    inl_dn: Sequence[float] = (),
    resume: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Twin:
    """
    Estimate the parameters of a camera from dark and uniformly illuminated frames.

    Parameters
    ----------
    frames : path, or list of Stack
        Folder of stacks (:func:`read_stacks`), or the stacks. Needed are dark frames, and some levels of light up to
        saturation, each of two frames or more; better are 16 frames of 10 levels, 64 dark frames of the shortest exposure, and
        dark frames of two longer exposures.
    bits : int
        Bits of the codes, without the empty ones of their files.
    pixel_um : float, µm
        Side of a pixel.
    mosaic : {"RGGB", "BGGR", "GRBG", "GBRG"}, optional
        Colours of the first two rows of the frames.
    companding, log_strength, companding_table, inl_dn
        Transfer function of the ADC, if it is not linear: see :class:`foveasim.sensor.adc.ADC`.
    resume : path, optional
        Directory for the statistics of stacks that have been read, from which an interrupted fit continues.
    progress : callable, optional
        Called with the number of stacks that have been read, and of all.

    Returns
    -------
    Twin

    Raises
    ------
    ParameterError
        When stacks have different sizes, fewer than two frames, fewer than four rows or columns, or codes above those
        of ``bits``; without dark frames, or without levels of light.
    FileError
        When a file cannot be read.

    Warns
    -----
    FoveasimWarning
        When more than 0.5 % of the dark codes are 0, which biases noise and black level.

    Notes
    -----
    Means and variances of the levels are those of the sensor's chain (:meth:`foveasim.Sensor.predict`), with quantisation,
    companding, clipping, nonlinearity and the nonuniformity of the pixels; the parameters maximise their likelihood. RTS noise
    is a mixture of noncentral chi-square distributions of the variances of pixels, the dark current a log-normal distribution.
    DNL follows from the frequencies of codes in some columns, each of which has an ADC of its own.
    Intervals contain differences between blocks of rows. They do not contain errors that all frames share, such as a light
    that drifts with the exposure time.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=64, n_y=48, pitch_um=3.0)
    >>> camera = fs.Sensor(
    ...     layout,
    ...     bits=12,
    ...     v_sat_v=1.0,
    ...     capacitance_f=1.6e-15,
    ...     read_noise_e=5.0,
    ...     pedestal_v=0.02,
    ... )
    >>> def frames(signal_e, seed):
    ...     codes = fs.metrics.draw_frames(
    ...         camera, np.full(layout.n_sites, signal_e), n_frames=8, seed=seed
    ...     )
    ...     return codes.reshape(8, 48, 64)
    >>> stacks = [fs.twin.Stack(frames(0.0, 9), exposure_s=0.01, light=0)]
    >>> stacks += [
    ...     fs.twin.Stack(frames(1000.0 * k, k), exposure_s=0.01 * k, light=1)
    ...     for k in range(1, 9)
    ... ]
    >>> twin = fs.twin.fit(stacks, bits=12, pixel_um=3.0)
    >>> round(twin.estimates["read_noise_e"].value, 1)
    5.0
    >>> twin.sensor().bits
    12
    """
    stacks = read_stacks(frames) if isinstance(frames, str | Path) else list(frames)
    if not stacks or not all(isinstance(each, Stack) for each in stacks):
        raise ParameterError("frames", "must be a folder, or a list of foveasim.twin.Stack objects")
    adc: dict[str, Any] = {"companding": companding}
    if companding == "log":
        adc["log_strength"] = log_strength
    if companding_table is not None:
        adc["companding_table"] = [float(each) for each in companding_table]
    if len(inl_dn):
        adc["inl_dn"] = [float(each) for each in inl_dn]
    ADC(bits=bits, **adc)  # checks them before frames are read
    names = [each.name or f"stack {k}" for k, each in enumerate(stacks)]
    statistics = []
    for k, (name, stack) in enumerate(zip(names, stacks, strict=True)):
        statistics.append(_statistics(name, stack, bits, None if resume is None else Path(resume)))
        if statistics[k].shape != statistics[0].shape:
            shapes = [f"{n_x} x {n_y} pixels" for n_y, n_x in (statistics[0].shape, statistics[k].shape)]
            raise ParameterError(
                "frames", f"must have the same size, but {names[0]} has {shapes[0]} and {name} {shapes[1]}"
            )
        if progress is not None:
            progress(k + 1, len(stacks))
    release_memory()  # of frames
    known = {"bits": bits, **adc}
    return twin_of(fit_statistics(statistics, stacks, known, mosaic), names, pixel_um, {**known, "mosaic": mosaic})


def _statistics(name: str, stack: Stack, bits: int, resume: Path | None) -> StackStatistics:
    """Return the statistics of a stack; those that are stored if its files did not change."""
    path = None if resume is None else _sums_path(resume, stack)
    found = None if path is None else _stored(path)
    if found is None:
        found = StackStatistics.of(sum_frames(name, stack))
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_archive(path, {}, {each: np.asarray(getattr(found, each)) for each in STORED}, is_compressed=False)
    _check_codes(name, stack, bits, found)
    return found


def _stored(path: Path) -> StackStatistics | None:
    """Return stored statistics, None if there are none that can be read."""
    try:
        arrays: dict[str, Any] = read_archive(path)[1]
        return StackStatistics(**arrays | {"n_frames": int(arrays["n_frames"])})
    except (FoveasimError, KeyError, TypeError, ValueError, OSError, BadZipFile):
        return None


def _check_codes(name: str, stack: Stack, bits: int, found: StackStatistics) -> None:
    """Compare the codes of a stack with the bits, and warn of dark codes that are 0."""
    n_zeros, highest, occurring = found.found.tolist()
    if highest >= 2**bits:
        shift = (occurring & -occurring).bit_length() - 1
        hint = f"the codes are multiples of {2**shift}: divide them by it" if shift else ""
        raise ParameterError("bits", f"must be those of the codes: {name} has the code {highest}", bits, hint=hint)
    n_codes = found.sums.size * found.n_frames
    if stack.is_dark and n_zeros > MAX_UNDERFLOW_FRACTION * n_codes:
        warn(
            f"{100.0 * n_zeros / n_codes:.2g} % of the codes of {name} are 0: the black level is too low, and noise and "
            "offsets are biased; increase the black level of the camera",
            FoveasimWarning,
        )


def _sums_path(resume: Path, stack: Stack) -> Path | None:
    """
    Return the file for the sums of a stack of files, None for arrays.

    It depends on names, sizes and times of the files.
    """
    if isinstance(stack.frames, np.ndarray) or not all(isinstance(each, str | Path) for each in stack.frames):
        return None
    states = []
    for each in stack.frames:
        status = Path(each).stat()
        states.append((str(Path(each).resolve()), status.st_size, status.st_mtime_ns))
    return resume / f"{hashlib.sha256(json.dumps(states).encode()).hexdigest()[:24]}.npz"
