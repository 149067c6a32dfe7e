"""Report of a twin as a web page, and its figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import unit_of
from foveasim.twin.fitting.intervals import Estimate
from foveasim.view.web._report_page import (
    FAINT,
    INK,
    ReportFigure,
    ReportSection,
    ReportTable,
    drawn_figure,
    figure_of,
    picture_figure,
    report_html,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from foveasim.twin.frames.result import Twin

__all__ = ["FIGURES", "draw_residuals", "draw_transfer", "report_page"]

#: Colours of measurements and the fit, distinguishable with colour-vision deficiencies, and on light and dark pages.
MEASURED, FITTED = "#2f7fd6", "#e0862a"
#: What parameters are.
TITLES = {
    "gain_dn_per_e": "system gain K",
    "black_level_dn": "black level, in linear codes",
    "read_noise_e": "read noise of pixels",
    "row_noise_e": "temporal noise of rows",
    "column_noise_e": "temporal noise of columns",
    "full_well_e": "full well",
    "nonlinearity_fraction": "response nonlinearity, loss at the end of the range",
    "dnl_dn": "DNL, standard deviation in a column",
    "dark_e_per_s": "dark current",
    "dark_doubling_k": "temperature rise that doubles the dark current",
    "dsnu_fraction": "nonuniformity of the dark current, over its mean",
    "dsnu_e": "DSNU of pixels",
    "dsnu_row_e": "DSNU of rows",
    "dsnu_column_e": "DSNU of columns",
    "prnu_fraction": "PRNU of pixels",
    "prnu_row_fraction": "PRNU of rows",
    "prnu_column_fraction": "PRNU of columns",
    "rts_fraction": "fraction of pixels with RTS noise",
    "rts_e": "step of RTS noise",
    "hot_fraction": "fraction of hot pixels",
    "hot_e_per_s": "additional dark current of hot pixels",
    "dead_fraction": "fraction of dead pixels",
    "qe": "quantum efficiency",
}
#: Maps with titles, in the order of the report.
MAPS = {
    "offset_e": "offset",
    "response_fraction": "response",
    "noise_e": "dark noise",
    "dark_e_per_s": "dark current",
    "rts_probability": "probability of RTS noise",
    "is_defect": "defects",
}
#: Number above which there is no decimal point, largest number of decimals of an interval, and quantiles of black and white.
MANY, MAX_DECIMALS = 1000.0, 7
QUANTILES = (0.005, 0.995)
#: Longest side of the picture of a map, and chi-square per degree of freedom up to which a fit is good.
MAX_SIDE, GOOD_RATIO = 512, 1.5


def draw_transfer(twin: Twin, axes: Axes) -> None:
    """Draw the temporal variance of the levels against the mean, and that of the fit."""
    rows = sorted(twin.levels, key=lambda row: row["mean_dn"])
    axes.plot(
        [row["fitted_mean_dn"] for row in rows], [row["fitted_variance_dn2"] for row in rows], color=FITTED, label="fit"
    )
    axes.plot(
        [row["mean_dn"] for row in rows], [row["variance_dn2"] for row in rows], "o", color=MEASURED, ms=4,
        label="measured",
    )  # fmt: skip
    axes.set_xlabel("mean code / DN")
    axes.set_ylabel("temporal variance / DN²")


def draw_residuals(twin: Twin, axes: Axes) -> None:
    """Draw the deviations of means and variances from the fit, in standard errors."""
    means = [row["mean_dn"] for row in twin.levels]
    for name, marker, colour in (("mean", "o", MEASURED), ("variance", "s", FITTED)):
        axes.plot(means, [row[f"{name}_residual"] for row in twin.levels], marker, color=colour, ms=4, label=name)
    for y in (-2.0, 2.0):
        axes.axhline(y, color="#8a8f98", linewidth=0.8, linestyle="--")
    axes.set_xlabel("mean code / DN")
    axes.set_ylabel("deviation / standard errors")


#: Figures by the names of their files.
FIGURES: dict[str, Callable[[Twin, Axes], None]] = {"photon_transfer": draw_transfer, "residuals": draw_residuals}


def report_page(twin: Twin) -> str:
    """Return the report of a twin as HTML."""
    n_y, n_x = twin.shape
    ratio = twin.chi_square_ratio
    verdict = (
        "The fit explains all levels within their noise."
        if ratio < GOOD_RATIO
        else "The chain does not explain the levels: see the residuals, and check the light of each stack and the ADC."
    )
    summary = [
        f"{n_x} x {n_y} pixels of {twin.pixel_um:g} µm, {int(twin.known['bits'])} bits, {len(twin.levels)} levels.",
        f"{verdict} The mean square of the deviations is {ratio:.2f} of that of the noise.",
        *twin.assumptions,
    ]
    return report_html(
        "Twin of a camera",
        [
            ReportSection("Summary", summary, _tables(twin)),
            ReportSection(
                "Photon transfer",
                ("Deviations within the dashed lines, two standard errors, are those of noise.",),
                figures=[
                    [
                        drawn_figure(figure_of(partial(draw, twin), INK, FAINT), name.replace("_", " "), caption)
                        for (name, draw), caption in zip(
                            FIGURES.items(),
                            ("Temporal variance of each level.", "Deviations from the fit."),
                            strict=True,
                        )
                    ]
                ],
            ),
            ReportSection("Maps", ("Black and white are the 0.5 % and 99.5 % quantiles.",), figures=[_maps(twin)]),
            ReportSection("Levels", (), [_levels(twin)]),
        ],
    )


def _tables(twin: Twin) -> list[ReportTable]:
    rows = [[TITLES.get(name, name), *_interval(each), unit_of(name), name] for name, each in twin.estimates.items()]
    tables = [
        ReportTable(
            ("Parameter", "value", "95 % interval", "unit", "name"), rows, "Parameters that the frames determine."
        )
    ]
    if twin.not_identifiable:
        others = [[TITLES.get(name, name), reason] for name, reason in twin.not_identifiable.items()]
        tables.append(
            ReportTable(("Not identifiable", "because"), others, "Parameters that the frames do not determine.")
        )
    return tables


def _shown(value: float) -> str:
    """Return a number with four digits, or all before the point."""
    return f"{value:,.0f}" if abs(value) >= MANY else f"{value:.4g}"


def _interval(each: Estimate) -> tuple[str, str]:
    """Return a value and its interval, with two digits of the width of the interval."""
    width = each.high - each.low
    decimals = min(max(1 - math.floor(math.log10(width)), 0), MAX_DECIMALS) if width > 0.0 else 4
    value, low, high = (f"{number:,.{decimals}f}" for number in each)
    return value, f"{low} to {high}"


def _levels(twin: Twin) -> ReportTable:
    heads = ("Stack", "frames", "light / e-", "mean / DN", "fit", "variance / DN²", "fit")
    rows = [
        [
            str(row["stack"]), str(row["n_frames"]), f"{row['light_e']:.5g}", f"{row['mean_dn']:.6g}",
            f"{row['fitted_mean_dn']:.6g}", f"{row['variance_dn2']:.5g}", f"{row['fitted_variance_dn2']:.5g}",
        ]
        for row in twin.levels
    ]  # fmt: skip
    return ReportTable(heads, rows, "Mean and temporal variance of the pixels, measured and by the fit.")


def _maps(twin: Twin) -> Sequence[ReportFigure]:
    figures = []
    for name, title in MAPS.items():
        if name not in twin.maps:
            continue
        values = twin.maps[name]
        step = max(1, math.ceil(max(values.shape) / MAX_SIDE))
        low, high = np.quantile(values, QUANTILES)
        if high <= low:
            low, high = float(values.min()), max(float(values.max()), float(values.min()) + 1e-12)
        grey: NDArray[np.uint8] = np.rint(
            255.0 * np.clip((values[::step, ::step] - low) / (high - low), 0.0, 1.0)
        ).astype(np.uint8)
        unit = unit_of(name)
        figures.append(picture_figure(grey, title, f"{low:.3g} to {high:.3g} {unit}".rstrip()))
    return figures
