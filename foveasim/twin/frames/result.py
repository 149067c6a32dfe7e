"""Result of a fit: parameters with intervals, maps, and the sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import OwnCheck
from foveasim._core.validation import Floats, check_number, frozen_array
from foveasim._io.npz import open_archive, write_archive
from foveasim.layout import Layout
from foveasim.layout.channels import mosaic as with_mosaic
from foveasim.layout.generators.grid import grid
from foveasim.layout.readout import readout_by
from foveasim.sensor import Sensor
from foveasim.sensor.adc import ADC
from foveasim.twin.fitting.intervals import Estimate, Uncertain
from foveasim.twin.frame_sensors import sensor_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from foveasim.twin.fitting.fitting import Fitted

__all__ = ["Twin", "read_twin"]

FILE_FORMAT, FILE_VERSION = "foveasim twin", 1
#: Maps of a twin; those of offsets and responses are always known.
MAPS = ("offset_e", "response_fraction", "noise_e", "is_defect", "dark_e_per_s", "rts_probability")
#: Parameters of the ADC that a fit may be given, and mosaics.
ADC_PARAMETERS = ("bits", "companding", "log_strength", "companding_table", "inl_dn")
MOSAICS = (None, "RGGB", "BGGR", "GRBG", "GBRG")


@dataclass(frozen=True, eq=False, repr=False)
class Twin:
    """
    Parameters of a camera, estimated from its frames.

    Created by :func:`fit`, and read by :func:`read_twin`.

    Attributes
    ----------
    estimates : mapping of str to Estimate
        Parameters, each with an interval of 95 % confidence. ``dsnu_e`` and ``prnu_fraction`` are those of pixels, without
        rows and columns; ``black_level_dn`` is the mean code of a dark frame of exposure 0, in codes of a linear ADC.
    not_identifiable : mapping of str to str
        Parameters that the frames do not determine, and why.
    maps : mapping of str to (n_y, n_x) float64
        Values of pixels, the first row of the frames first: ``offset_e``, ``response_fraction``, ``noise_e``, ``is_defect``,
        and, if identifiable, ``dark_e_per_s`` and ``rts_probability``.
    levels : sequence of dict
        Mean and variance of each stack, measured and by the fit, with normalised residuals.
    assumptions : tuple of str
        What was taken as known.
    pixel_um : float, µm
    known : mapping
        Parameters that were given: bits, mosaic, and those of the ADC.
    n_fitted : int
        Number of parameters of the chain, and of levels of unknown light, that were fitted.
    temperature_k : float, K, optional
        Temperature of the dark current, if it was given: the lowest one.
    """

    estimates: Mapping[str, Estimate]
    not_identifiable: Mapping[str, str]
    maps: Mapping[str, Floats]
    levels: Sequence[Mapping[str, Any]]
    assumptions: tuple[str, ...]
    pixel_um: float
    known: Mapping[str, Any]
    n_fitted: int
    temperature_k: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "maps", {name: frozen_array(each) for name, each in self.maps.items()})
        for name in ("estimates", "not_identifiable", "maps", "known"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        object.__setattr__(self, "levels", tuple(MappingProxyType(dict(each)) for each in self.levels))

    def __repr__(self) -> str:
        n_y, n_x = next(iter(self.maps.values())).shape
        return f"Twin({n_x} x {n_y} pixels, {len(self.estimates)} parameters)"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of pixels."""
        n_y, n_x = self.maps["offset_e"].shape
        return n_y, n_x

    def value(self, name: str, default: float = 0.0) -> float:
        """Return an estimated value, or a default where the frames do not determine it."""
        return self.estimates[name].value if name in self.estimates else default

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per parameter: name, value, limits of the interval, and a note."""
        rows: list[dict[str, Any]] = [
            {"parameter": name, "value": each.value, "low": each.low, "high": each.high, "note": ""}
            for name, each in self.estimates.items()
        ]
        empty = {"value": math.nan, "low": math.nan, "high": math.nan}
        return rows + [{"parameter": name, **empty, "note": reason} for name, reason in self.not_identifiable.items()]

    def _repr_html_(self) -> str:
        from foveasim.view import to_html

        return to_html(self)

    @property
    def chi_square_ratio(self) -> float:
        """Chi-square of the levels per degree of freedom: near 1 where the chain explains them."""
        residuals = [row[f"{name}_residual"] for row in self.levels for name in ("mean", "variance")]
        return float(np.square(residuals).sum()) / max(len(residuals) - self.n_fitted, 1)

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Draw the photon transfer, measured and by the fit, on matplotlib axes."""
        from foveasim.twin.frames.report import draw_transfer
        from foveasim.view.plots.figures import new_figure

        axes = new_figure((5.0, 3.5)).subplots() if ax is None else ax
        draw_transfer(self, axes)
        axes.legend()
        return axes

    def write(self, path: str | Path) -> None:
        """
        Write the report, a web page, atomically.

        Raises
        ------
        FileError
            When the extension is not ``.html``, or the file cannot be written.
        """
        from foveasim.twin.frames.report import report_page
        from foveasim.view.web._page import write_page

        write_page(path, lambda: report_page(self))

    def write_figures(self, directory: str | Path, extension: str = "pdf") -> list[Path]:
        """
        Write the figures of the report to a directory, and return their paths.

        Raises
        ------
        FileError
            When a file cannot be written.
        """
        from foveasim._io.atomic import atomic_write
        from foveasim.twin.frames.report import FIGURES
        from foveasim.view.web._report_page import figure_of

        paths = []
        for name, draw in FIGURES.items():
            paths.append(Path(directory, f"{name}.{extension}"))
            figure = figure_of(partial(draw, self), "black", "0.9")
            with atomic_write(paths[-1]) as temporary:
                figure.savefig(temporary, format=extension)
        return paths

    def layout(self) -> Layout:
        """Return the grid of the camera's pixels, with rows, columns, readout lines and channels."""
        n_y, n_x = self.shape
        found = readout_by(grid(n_x=n_x, n_y=n_y, pitch_um=self.pixel_um), "column")
        return with_mosaic(found, self.known["mosaic"]) if self.known.get("mosaic") else found

    def sensor(self, layout: OwnCheck[Layout | None] = None, *, maps: bool | None = None, **parameters: Any) -> Sensor:
        """
        Return the sensor of this camera, or a sensor of its kind with other photosites.

        Parameters
        ----------
        layout : Layout, optional
            Photosites, by default those of the camera, which have the maps of its pixels; noise of the maps is reduced by
            taking each value in proportion to its reliability. Photosites that are all pixels of the camera, in any order and
            anywhere, have them, too. Others have random patterns of the same statistics: full well, dark current and steps of
            the ADC in electrons are proportional to the area of a site; read noise is that of the pixel.
        maps : bool, optional
            Whether sites have the maps of the pixels. False is another device of the kind, which ``device_seed`` draws.
        **parameters
            Parameters of :class:`foveasim.Sensor`, such as ``filters`` and ``qe``, or values instead of estimated ones and
            their maps: ``prnu_fraction`` replaces the map of the response. ``effects`` act in addition to those of the twin, or
            instead of one with the same name.

        Returns
        -------
        Sensor
            Its ``provenance`` says what was assumed. With a mosaic and without ``filters``, the filters are neutral, with the
            responses of the colours to the lamp.

        Raises
        ------
        ParameterError
            If a parameter is invalid, or maps are required for other photosites.
        """
        return sensor_of(self, layout, maps, parameters)

    def save(self, path: str | Path) -> None:
        """
        Write the twin to an ``.npz`` file, which :func:`read_twin` reads.

        Raises
        ------
        FileError
            If the file cannot be written.
        """
        write_archive(path, self._about(), dict(self.maps))

    def _about(self) -> dict[str, Any]:
        """Return all but the maps, as plain data."""
        return {
            "format": FILE_FORMAT,
            "version": FILE_VERSION,
            "estimates": {name: list(each) for name, each in self.estimates.items()},
            "not_identifiable": dict(self.not_identifiable),
            "levels": [dict(each) for each in self.levels],
            "assumptions": list(self.assumptions),
            "pixel_um": self.pixel_um,
            "known": dict(self.known),
            "n_fitted": self.n_fitted,
            "temperature_k": self.temperature_k,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self._about(), dict(self.maps))


def read_twin(path: str | Path) -> Twin:
    """
    Read a twin.

    Parameters
    ----------
    path : path

    Raises
    ------
    FileError
        If the file is not a twin, or is corrupt.
    """
    with open_archive(path, FILE_FORMAT, FILE_FORMAT, FILE_VERSION) as (about, arrays):
        _check_stored(about, arrays)
        return _restored(about, arrays)


def _check_stored(about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Check names, shapes and numbers of an untrusted file."""
    shapes = {each.shape for each in arrays.values()}
    if (
        not set(MAPS[:2]) <= set(arrays) <= set(MAPS)
        or len(shapes) != 1
        or len(*shapes) != 2
        or 0 in next(iter(shapes))
    ):
        raise ValueError(f"its maps must be {', '.join(MAPS)}, of equal size")
    if not all(np.isfinite(each).all() for each in arrays.values()):
        raise ValueError("its maps must be finite")
    known = dict(about["known"])
    if known.pop("mosaic", None) not in MOSAICS or not {"bits"} <= set(known) <= set(ADC_PARAMETERS):
        raise ValueError(f"its known parameters must be mosaic, {', '.join(ADC_PARAMETERS)}")
    ADC(**known)
    check_number("pixel_um", about["pixel_um"], above=0.0, at_most=1e3)
    if not all(math.isfinite(float(value)) for value, *_ in about["estimates"].values()):
        raise ValueError("its estimates must be finite")


def _restored(about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Twin:
    return Twin(
        {name: Estimate(*map(float, each)) for name, each in about["estimates"].items()},
        {str(name): str(reason) for name, reason in about["not_identifiable"].items()},
        {name: np.asarray(each, np.float64) for name, each in arrays.items()},
        tuple(about["levels"]),
        tuple(map(str, about["assumptions"])),
        float(about["pixel_um"]),
        about["known"],
        int(about["n_fitted"]),
        None if about["temperature_k"] is None else float(about["temperature_k"]),
    )


def twin_of(fitted: Fitted, names: list[str], pixel_um: float, known: Mapping[str, Any]) -> Twin:
    """Return the twin of fitted statistics, of stacks with these names."""
    fit, levels = fitted.fit, fitted.levels
    n = levels.mean_dn.size
    rows = [
        {
            "stack": names[int(levels.stack[k])],
            "class": int(levels.class_of_level[k]),
            "n_frames": int(levels.n_frames[k]),
            "light_e": float(fit.light_e[k]),
            "mean_dn": float(levels.mean_dn[k]),
            "variance_dn2": float(levels.variance_dn2[k]),
            "fitted_mean_dn": float(fit.means_dn[k]),
            "fitted_variance_dn2": float(fit.variances_dn2[k]),
            "mean_residual": float(fit.residuals[k]),
            "variance_residual": float(fit.residuals[n + k]),
        }
        for k in range(n)
    ]
    maps: dict[str, NDArray[Any]] = {
        name: frozen_array(np.asarray(each, np.float64)) for name, each in fitted.maps.items()
    }
    return Twin(
        {name: each for name, each in fitted.estimates.items() if isinstance(each, Estimate)},
        {name: each.reason for name, each in fitted.estimates.items() if isinstance(each, Uncertain)},
        maps,
        tuple(rows),
        tuple(fitted.assumptions),
        pixel_um,
        known,
        len(fit.names),
        fitted.temperature_k,
    )
