"""Result of a fit: parameters with intervals, maps, and the sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import OwnCheck
from foveasim._core.validation import Floats, frozen_array
from foveasim._io.npz import open_archive, write_archive
from foveasim.layout import Layout
from foveasim.layout.channels import mosaic as with_mosaic
from foveasim.layout.generators.grid import grid
from foveasim.layout.readout import readout_by
from foveasim.sensor import Sensor
from foveasim.sensor.effects.measured import ColumnNoise, OffsetMap, ResponseMap, RowNoise, TelegraphMap
from foveasim.sensor.published.datasheet import SWING_V
from foveasim.twin.frames.intervals import Estimate, Uncertain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from foveasim.twin.frames.fitting import Fitted

__all__ = ["Twin", "read_twin"]

FILE_FORMAT, FILE_VERSION = "foveasim twin", 1
#: Probability of RTS noise above which a pixel has it.
MIN_PROBABILITY = 0.5


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
    levels: tuple[Mapping[str, Any], ...]
    assumptions: tuple[str, ...]
    pixel_um: float
    known: Mapping[str, Any]
    n_fitted: int
    temperature_k: float | None = None

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

    def sensor(self, layout: OwnCheck[Layout | None] = None, **parameters: Any) -> Sensor:
        """
        Return the sensor of this camera, or a sensor of its kind with another layout.

        Parameters
        ----------
        layout : Layout, optional
            Other photosites. By default those of the camera, with the maps of its pixels; noise of the maps is reduced by
            taking each value in proportion to its reliability. Other layouts have patterns of the same statistics: full well,
            dark current and steps of the ADC in electrons are proportional to the area of a site; read noise is that of the
            pixel.
        **parameters
            Parameters of :class:`foveasim.Sensor`, such as ``filters`` and ``qe``, or values instead of estimated ones.

        Returns
        -------
        Sensor
        """
        own = layout is None
        sites = self.layout() if layout is None else layout
        scale = 1.0 if own else np.asarray(sites.area_um2) / self.pixel_um**2
        n_codes = 2 ** int(self.known["bits"])
        found: dict[str, Any] = {name: value for name, value in self.known.items() if name != "mosaic"}
        found |= {
            "v_sat_v": SWING_V,
            "gain_dn_per_e": self.value("gain_dn_per_e") / scale,
            "pedestal_v": SWING_V * (self.value("black_level_dn") + 0.5) / n_codes,
            "read_noise_e": self.value("read_noise_e"),
            "nonlinearity_fraction": self.value("nonlinearity_fraction"),
        }
        if "dnl_dn" in self.estimates and self.estimates["dnl_dn"].low > 0.0:
            found["dnl_dn"] = self.value("dnl_dn")
        if "qe" in self.estimates:
            found["qe"] = min(self.value("qe"), 1.0)
        if "full_well_e" in self.estimates:
            found["full_well_e"] = self.value("full_well_e") * scale
        if self.temperature_k is not None:
            found["temperature_k"] = found["dark_reference_k"] = self.temperature_k
        if "dark_doubling_k" in self.estimates:
            found["dark_doubling_k"] = self.value("dark_doubling_k")
        found |= self._maps_of_sites(sites) if own else self._statistics(sites, scale)
        return Sensor(sites, **(found | parameters))

    def _statistics(self, sites: Layout, scale: Floats | float) -> dict[str, Any]:
        """Return the parameters of sensors of the same kind."""
        names = (
            "prnu_fraction", "dsnu_e", "dsnu_fraction", "hot_fraction", "hot_e_per_s", "dead_fraction", "rts_fraction",
            "rts_e",
        )  # fmt: skip
        found: dict[str, Any] = {name: self.value(name) for name in names if name in self.estimates}
        if "dark_e_per_s" in self.estimates:
            found["dark_e_per_s"] = max(self.value("dark_e_per_s"), 0.0) * scale
        if "readout_line" in sites.columns:
            n_codes = 2 ** int(self.known["bits"])
            found["line_fpn_fraction"] = self.value("dsnu_column_e") * self.value("gain_dn_per_e") / n_codes
        return found | {"effects": self._noise_of_lines(sites)}

    def _noise_of_lines(self, sites: Layout) -> list[Any]:
        """Return the temporal noise of rows and columns, for layouts that have them."""
        kinds = {"row": RowNoise, "column": ColumnNoise}
        found = {name: self.estimates.get(f"{name}_noise_e") for name in kinds if name in sites.columns}
        return [kinds[name](each.value) for name, each in found.items() if each is not None and each.low > 0.0]

    def _maps_of_sites(self, sites: Layout) -> dict[str, Any]:
        """Return the parameters of this device for its sites: the last row of frames first."""

        def of_sites(name: str) -> Floats:
            return np.ascontiguousarray(self.maps[name][::-1]).ravel()

        effects: list[Any] = [ResponseMap(of_sites("response_fraction")), OffsetMap(of_sites("offset_e"))]
        found: dict[str, Any] = {}
        if "dark_e_per_s" in self.maps:
            found["dark_e_per_s"] = np.maximum(of_sites("dark_e_per_s"), 0.0)
        if "rts_probability" in self.maps:
            steps = np.where(of_sites("rts_probability") > MIN_PROBABILITY, self.value("rts_e"), 0.0)
            effects.append(TelegraphMap(steps))
        return found | {"effects": effects + self._noise_of_lines(sites)}

    def save(self, path: str | Path) -> None:
        """
        Write the twin to an ``.npz`` file, which :func:`read_twin` reads.

        Raises
        ------
        FileError
            If the file cannot be written.
        """
        about = {
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
        write_archive(path, about, dict(self.maps))


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
    with open_archive(path, "foveasim twin", FILE_FORMAT, FILE_VERSION) as (about, arrays):
        return Twin(
            MappingProxyType({name: Estimate(*map(float, each)) for name, each in about["estimates"].items()}),
            MappingProxyType({str(name): str(reason) for name, reason in about["not_identifiable"].items()}),
            MappingProxyType({name: frozen_array(np.asarray(each, np.float64)) for name, each in arrays.items()}),
            tuple(MappingProxyType(each) for each in about["levels"]),
            tuple(map(str, about["assumptions"])),
            float(about["pixel_um"]),
            MappingProxyType(about["known"]),
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
        MappingProxyType({name: each for name, each in fitted.estimates.items() if isinstance(each, Estimate)}),
        MappingProxyType({name: each.reason for name, each in fitted.estimates.items() if isinstance(each, Uncertain)}),
        MappingProxyType(maps),
        tuple(MappingProxyType(each) for each in rows),
        tuple(fitted.assumptions),
        pixel_um,
        MappingProxyType(dict(known)),
        len(fit.names),
        fitted.temperature_k,
    )
