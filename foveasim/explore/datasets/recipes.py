"""The datasets that the paper names: pictures as other cameras would take them, and noisy captures with their expectation."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from foveasim._core.validation import check_number
from foveasim.config import put_setting, read_settings
from foveasim.errors import ConfigError
from foveasim.explore.datasets.dataset import Dataset

__all__ = ["classification", "denoising"]

#: Devices to draw from: each has fixed patterns of its own.
DEVICES = (0, 2**31 - 1)
#: No lens in air is faster.
FASTEST = 0.5


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
    Every picture with its class through cameras drawn at random: what a classifier must not mind.

    Parameters
    ----------
    pictures, shot, cameras, seed
        As for :class:`Dataset`. Classes are the names of the folders that pictures are in, or ``labels``.
    vary : mapping of str to distribution, optional
        Instead of these, or beside them: the f-number from 1/1.5 to 3 times the shot's, the exposure from 1/8 to 4 times,
        read noise from 0.5 to 20 e-, 0 to 2 % photo-response non-uniformity, 0 to 1 % offset patterns of pixels and of lines,
        and any device.
    **options
        Of :class:`Dataset`: ``labels``, ``boxes``, ``masks``, ``flows``, ``fit``, ``fields``, ``draws``, ...

    Returns
    -------
    Dataset
        With the codes alone, unless ``fields`` says otherwise.

    Raises
    ------
    FileError, ParameterError, ConfigError
        As for :class:`Dataset`.
    """
    f_number, exposure_s = _numbers(shot, options, "optics.f_number", "exposure_s")
    usual: dict[str, Any] = {
        "optics.f_number": {"log_uniform": [max(f_number / 1.5, FASTEST), 3.0 * f_number]},
        "exposure_s": {"log_uniform": [exposure_s / 8.0, 4.0 * exposure_s]},
        "sensor.read_noise_e": {"log_uniform": [0.5, 20.0]},
        "sensor.prnu_fraction": {"uniform": [0.0, 0.02]},
        "sensor.pixel_fpn_fraction": {"uniform": [0.0, 0.01]},
        "sensor.line_fpn_fraction": {"uniform": [0.0, 0.01]},
        "sensor.device_seed": {"integers": list(DEVICES)},
    }
    return Dataset(
        pictures, shot, usual | dict(vary or {}), cameras=cameras, seed=seed, **{"fields": ("code",)} | options
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
    Noisy captures and what they are noisy about: several draws of each picture and camera.

    Parameters
    ----------
    pictures, shot, draws, seed
        As for :class:`Dataset`.
    vary : mapping of str to distribution, optional
        Instead of these, or beside them: the exposure from 1/32 of the shot's up to it, and read noise from 0.5 to 20 e-.
    **options
        Of :class:`Dataset`.

    Returns
    -------
    Dataset
        With the ``code`` and, as the target, ``expected_dn``: the mean of the code over all draws, computed and not averaged.
        It has the fixed patterns of the device, which no draw differs in; give a shot without them for a target that has none.
        Where codes are cut off at 0 the mean is above the light's; ``sensor.pedestal_v`` keeps noise about darkness.

    Raises
    ------
    FileError, ParameterError, ConfigError
        As for :class:`Dataset`.
    """
    (exposure_s,) = _numbers(shot, options, "exposure_s")
    usual: dict[str, Any] = {
        "exposure_s": {"log_uniform": [exposure_s / 32.0, exposure_s]},
        "sensor.read_noise_e": {"log_uniform": [0.5, 20.0]},
    }
    options = {"fields": ("code", "expected_dn")} | options
    return Dataset(pictures, shot, usual | dict(vary or {}), draws=draws, seed=seed, **options)


def _numbers(shot: str | Path | Mapping[str, Any], options: Mapping[str, Any], *paths: str) -> list[float]:
    """Numbers among the shot's settings, with the changes among a dataset's options."""
    file = Path(options.get("source", "settings")) if isinstance(shot, Mapping) else Path(shot)
    data = deepcopy(dict(shot)) if isinstance(shot, Mapping) else read_settings(file)
    for path, value in (options.get("changes") or {}).items():
        put_setting(file, data, path, value)
    found = []
    for path in paths:
        place: Any = data
        for name in path.split("."):
            place = place.get(name) if isinstance(place, Mapping) else None
        if place is None:
            raise ConfigError(file, f"{path}: is missing")
        found.append(check_number(path.rpartition(".")[2], place, above=0.0))
    return found
