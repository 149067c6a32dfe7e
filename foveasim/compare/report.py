"""Report of a comparison as a web page."""

from __future__ import annotations

import json
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from foveasim._core.quantities import format_quantity
from foveasim.compare.budgets import BUDGETS, budget_rows
from foveasim.compare.figures import draw_measure, draw_sizes
from foveasim.compare.intervals import MIN_SCENES
from foveasim.compare.metrics import best_cameras, metric_rows
from foveasim.metrics.registry import metric_info
from foveasim.reconstruct import Picture
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
    from foveasim.compare.comparison import Comparison

__all__ = ["report_page"]

#: Scenes whose pictures are shown, and quantile of the ideal picture that is shown as white.
MAX_SHOWN_SCENES, WHITE_QUANTILE = 3, 0.995
#: Coverage of the field below which the missing part is stated.
COMPLETE = 0.995


def report_page(comparison: Comparison) -> str:
    """Return the report of a comparison as HTML."""
    names = comparison.names
    return report_html(
        "Comparison of " + " and ".join([", ".join(names[:-1]), names[-1]]),
        [
            _summary(comparison),
            ReportSection(
                "Pictures",
                ("Pixels without photosites are transparent. All pictures of a scene have the same white.",),
                figures=_pictures(comparison),
            ),
            _eccentricity(comparison),
            _sizes(comparison),
            _definitions(comparison),
        ],
    )


def _summary(comparison: Comparison) -> ReportSection:
    budget, n = comparison.settings["budget"], len(comparison.scenes)
    equal = (
        f"Equal budget: {BUDGETS[budget][1]}, within {100.0 * comparison.settings['tolerance']:g} %."
        if budget is not None
        else "The budgets are not equal."
    )
    exposure = format_quantity(comparison.settings["exposure_s"], "s")
    scenes = f"{n} scenes" if n > 1 else "one scene"
    if n < MIN_SCENES:
        scenes += f", without confidence intervals, which require {MIN_SCENES} scenes"
    notes = [
        *comparison.verdict(),
        (f"{equal} Same lens, exposure of {exposure}, and picture grid; {scenes}: {', '.join(comparison.scenes)}."),
    ]
    missing = [
        f"{name} does not cover {100.0 * (1.0 - part):.1f} %"
        for name, part in zip(comparison.names, comparison.coverage_fraction, strict=True)
        if part < COMPLETE
    ]
    if missing:
        notes.append(
            f"Of the field that any camera covers, {'; '.join(missing)}. Pictures are compared in the "
            f"{100.0 * comparison.compared_fraction:.1f} % that all cover."
        )
    differences = [[head, *others] for head, _, *others in metric_rows(comparison.metrics, comparison.differences)]
    interval = "median [95 % confidence interval] over the scenes"
    return ReportSection(
        "Summary",
        notes,
        (
            ReportTable(("Budget", *comparison.names), budget_rows(comparison.budgets), "Budgets of the cameras."),
            ReportTable(
                ("Measure", *comparison.names),
                metric_rows(comparison.metrics, comparison.summary),
                f"Over the complete field: {interval}. Bold: the best value of a row.",
                best_cameras(comparison.metrics, comparison.summary),
            ),
            ReportTable(
                ("Difference", *comparison.names[1:]),
                differences,
                f"Differences from {comparison.names[0]}, paired by scene: {interval}.",
            ),
        ),
    )


def _pictures(comparison: Comparison) -> list[list[ReportFigure]]:
    rows = []
    for k, scene in enumerate(comparison.scenes[:MAX_SHOWN_SCENES]):
        ideals = {name: comparison.ideals[name][k] for name in comparison.names}
        one = next(iter(ideals.values()))
        balance = np.ones(len(one.data)) if one.white is None else one.white
        white = balance * max(
            float(np.nanquantile(ideal.data / balance.reshape(-1, 1, 1), WHITE_QUANTILE)) for ideal in ideals.values()
        )
        are_equal = all(np.array_equal(ideal.data, one.data, equal_nan=True) for ideal in ideals.values())
        row = []
        for i, (name, ideal) in enumerate(ideals.items()):
            psnr = comparison.values["psnr_db"][i, k]
            if i == 0 or not are_equal:
                title = "ideal" if are_equal else f"ideal image of {name}"
                row.append(picture_figure(_pixels(ideal, white), title, f"{scene}: irradiance on the picture grid."))
            row.append(
                picture_figure(_pixels(comparison.pictures[name][k], white), name, f"{scene}: PSNR {psnr:.1f} dB.")
            )
        rows.append(row)
    return rows


def _pixels(picture: Picture, white: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.asarray(picture.to_image(np.maximum(white, 1e-12)), np.uint8)


def _eccentricity(comparison: Comparison) -> ReportSection:
    x_um, y_um = comparison.centre_um
    intervals = ", with 95 % confidence intervals over the scenes" if len(comparison.scenes) >= MIN_SCENES else ""
    figures = [
        drawn_figure(
            figure_of(partial(draw_measure, comparison, name), INK, FAINT),
            info.title,
            f"{info.definition[0].upper()}{info.definition[1:]}{intervals if info.has_scene else ''}.",
        )
        for name, info in ((name, metric_info(name)) for name in comparison.metrics)
    ]
    note = f"In annuli around the fixation point ({x_um:g}, {y_um:g}) µm."
    return ReportSection("By eccentricity", (note,), figures=[figures])


def _sizes(comparison: Comparison) -> ReportSection:
    rows = [
        [name, f"{row['size_um']:.4g}", f"{row['n_sites']:,}", f"{100.0 * row['area_fraction']:.1f}"]
        for name in comparison.names
        for row in comparison.sizes[name]
    ]
    figure = drawn_figure(
        figure_of(partial(draw_sizes, comparison), INK, FAINT),
        "Area by site size",
        "Fraction of the area of the sites in each class.",
    )
    return ReportSection(
        "Area by site size",
        tables=[ReportTable(("Camera", "size / µm", "sites", "area / %"), rows, "Size classes of equal ratios.")],
        figures=[[figure]],
    )


def _definitions(comparison: Comparison) -> ReportSection:
    notes = [
        (
            "PSNR and SSIM compare each picture with the exact means of the ideal irradiance over its pixels, after a fit of "
            "one gain, where all cameras cover at least half of a pixel."
        ),
        (
            "Information is that of Gaussian readings about Gaussian scenes with the isotropic covariance of these scenes, by "
            "the chain rule over blocks of adjacent sites: an estimate to compare sensors, not a bound for photographs."
        ),
        "The precision of a shift is the Cramér–Rao bound for a known image and the sites of an annulus.",
        (
            "Confidence intervals are those of order statistics for the median of the population of scenes. They are valid for "
            "any distribution."
        ),
    ]
    versions = ", ".join(f"{name} {version}" for name, version in comparison.settings["versions"].items())
    notes.append(f"Seed {comparison.settings['seed']}; {versions}.")
    return ReportSection(
        "Definitions and settings",
        notes,
        folded=("Settings of the comparison", json.dumps(comparison.settings, indent=1, ensure_ascii=False)),
    )
