"""Default datasets for classification and denoising."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from foveasim._core.validation import check_number
from foveasim.config import Source
from foveasim.explore.datasets.dataset import Dataset
from foveasim.explore.sweeps.plan import locate_shot, put_changes, with_changes

__all__ = ["classification", "denoising"]

#: Range of random device seeds: each device has its own fixed-pattern noise.
DEVICES = (0, 2**31 - 1)
#: Lower limit of the f-number of a lens in air.
MIN_F_NUMBER = 0.5


def classification(
    pictures: Any,
    shot: str | Path | Mapping[str, Any],
    vary: Mapping[str, Any] | None = None,
    *,
    cameras: int = 1,
    seed: int = 0,
    **options: Any,
) -> Dataset:
    """
    Create a dataset of labelled pictures captured by random cameras.

    Parameters
    ----------
    pictures, shot, cameras, seed
        As for :class:`Dataset`. Classes are the names of the directories of the pictures, or ``labels``.
    vary : mapping of str to distribution, optional
        Distributions that replace or extend the defaults: f-number from 1/1.5 to 3 times that of the shot (at least 0.5),
        exposure time from 1/8 to 4 times, read noise from 0.5 to 20 e-, 0 to 2 % photo-response non-uniformity, 0 to 1 % pixel
        and line fixed-pattern noise, and a random device seed.
    **options
        Further parameters of :class:`Dataset`: ``labels``, ``boxes``, ``masks``, ``flows``, ``fit``, ``fields``, ``draws``, ...

    Returns
    -------
    Dataset
        With the field ``code`` by default.

    Raises
    ------
    FileError, ParameterError, ConfigError
        As for :class:`Dataset`.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> scene = {
    ...     "kind": "picture",
    ...     "picture": "",
    ...     "fit": "cover",
    ...     "distance_m": 1.0,
    ...     "illuminance_lux": 500.0,
    ... }
    >>> layout = {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 8.0}}
    >>> shot = {
    ...     "scene": scene,
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": layout,
    ...     "exposure_s": 0.01,
    ... }
    >>> pictures = np.full((2, 32, 32), 128, np.uint8)
    >>> dataset = fs.explore.classification(
    ...     pictures, shot, cameras=3, labels=["cat", "dog"]
    ... )
    >>> len(dataset), dataset.class_names, dataset[5]["code"].shape
    (6, ['cat', 'dog'], (64,))
    """
    f_number, exposure_s = _read_numbers(shot, options, "optics.f_number", "exposure_s")
    defaults: dict[str, Any] = {
        "optics.f_number": {"log_uniform": [max(f_number / 1.5, MIN_F_NUMBER), 3.0 * f_number]},
        "exposure_s": {"log_uniform": [exposure_s / 8.0, 4.0 * exposure_s]},
        "sensor.read_noise_e": {"log_uniform": [0.5, 20.0]},
        "sensor.prnu_fraction": {"uniform": [0.0, 0.02]},
        "sensor.pixel_fpn_fraction": {"uniform": [0.0, 0.01]},
        "sensor.line_fpn_fraction": {"uniform": [0.0, 0.01]},
        "sensor.device_seed": {"integers": list(DEVICES)},
    }
    return Dataset(
        pictures, shot, defaults | dict(vary or {}), cameras=cameras, seed=seed, **{"fields": ("code",)} | options
    )


def denoising(
    pictures: Any,
    shot: str | Path | Mapping[str, Any],
    vary: Mapping[str, Any] | None = None,
    *,
    draws: int = 4,
    seed: int = 0,
    **options: Any,
) -> Dataset:
    """
    Create a dataset of noisy captures with their expectation as the target.

    Parameters
    ----------
    pictures, shot, draws, seed
        As for :class:`Dataset`.
    vary : mapping of str to distribution, optional
        Distributions that replace or extend the defaults: exposure time from 1/32 to 1 times that of the shot, and read noise
        from 0.5 to 20 e-.
    **options
        Further parameters of :class:`Dataset`.

    Returns
    -------
    Dataset
        With the fields ``code`` and, as the target, ``expected_dn``: the analytic mean of the code over temporal noise. The
        target contains the fixed-pattern noise of the device, which is equal in all draws; use a shot without fixed patterns
        for a target without them. Where codes clip at 0, the mean code is biased upwards; ``sensor.pedestal_v`` avoids
        clipping of noise at zero irradiance.

    Raises
    ------
    FileError, ParameterError, ConfigError
        As for :class:`Dataset`.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> scene = {
    ...     "kind": "picture",
    ...     "picture": "",
    ...     "fit": "cover",
    ...     "distance_m": 1.0,
    ...     "illuminance_lux": 500.0,
    ... }
    >>> layout = {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 8.0}}
    >>> shot = {
    ...     "scene": scene,
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": layout,
    ...     "exposure_s": 0.01,
    ... }
    >>> dataset = fs.explore.denoising(np.full((2, 32, 32), 128, np.uint8), shot, draws=4)
    >>> len(dataset), sorted(key for key in dataset[0] if key in ("code", "expected_dn"))
    (8, ['code', 'expected_dn'])
    """
    (exposure_s,) = _read_numbers(shot, options, "exposure_s")
    defaults: dict[str, Any] = {
        "exposure_s": {"log_uniform": [exposure_s / 32.0, exposure_s]},
        "sensor.read_noise_e": {"log_uniform": [0.5, 20.0]},
    }
    options = {"fields": ("code", "expected_dn")} | options
    return Dataset(pictures, shot, defaults | dict(vary or {}), draws=draws, seed=seed, **options)


def _read_numbers(shot: str | Path | Mapping[str, Any], options: Mapping[str, Any], *paths: str) -> list[float]:
    """Return numbers of the shot settings, after the ``changes`` of the dataset options."""
    own = Source.of(options.get("source"))
    source, data = locate_shot(own, shot)
    source = with_changes(own, source, options.get("changes"))
    put_changes(own, source, data, options.get("changes"), [])
    found = []
    for path in paths:
        setting: Any = data
        for name in path.split("."):
            setting = setting.get(name) if isinstance(setting, Mapping) else None
        if setting is None:
            raise source.error(path, "missing")
        found.append(check_number(path.rpartition(".")[2], setting, above=0.0))
    return found
