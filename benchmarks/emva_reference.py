"""
The same frames in the reference implementation of EMVA 1288, in ``fs.metrics.emva1288`` and in ``fs.twin.fit``.

    python benchmarks/emva_reference.py             a table of the parameters
    python benchmarks/emva_reference.py FOLDER      the same, and leaves frames and descriptor in the folder

The frames are Poisson and Gaussian numbers, without the package: pairs with and without light for 50 exposure times, up to
beyond saturation, and stacks of 32 frames at half saturation. The reference reads them by its descriptor file.
"""

from __future__ import annotations

import logging
import math
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

import foveasim as fs

SHAPE, BITS, PIXEL_UM, N_LEVELS, N_STACK = (96, 128), 12, 3.0, 50, 32
#: What the frames are drawn with.
TRUTH = {
    "gain_dn_per_e": 0.4, "qe": 0.55, "read_noise_e": 4.0, "full_well_e": 9000.0, "dark_e_per_s": 50.0,
    "dsnu_row_e": 1.2, "dsnu_column_e": 1.6, "dsnu_pixel_e": 3.0,
    "prnu_row_fraction": 0.002, "prnu_column_fraction": 0.003, "prnu_pixel_fraction": 0.008,
}  # fmt: skip
TRUTH |= {
    f"{kind}_{unit}": math.hypot(*(TRUTH[f"{kind}_{part}_{unit}"] for part in ("row", "column", "pixel")))
    for kind, unit in (("dsnu", "e"), ("prnu", "fraction"))
}
BLACK_DN, PHOTONS_PER_S = 60.0, 2e4 / TRUTH["qe"]
TIMES_S = np.round(np.linspace(0.01, 0.5, N_LEVELS), 6)
#: Level of the stacks, half of saturation, and step of the levels among which they are.
HALF, STEP = 20, 4


@dataclass(frozen=True)
class Series:
    """
    Frames of a camera: ``lit`` and ``dark`` (n_level), each (n_frame, n_y, n_x) uint16, those of ``HALF`` with N_STACK frames.

    ``photons`` (n_level,): of a pixel in an exposure.
    """

    lit: list[np.ndarray]
    dark: list[np.ndarray]
    photons: np.ndarray


def draw_series(seed: int = 1288) -> Series:
    """Draw the frames."""
    rng = np.random.default_rng(seed)
    n_y, n_x = SHAPE

    def part(kind: str, name: str, unit: str) -> np.ndarray:
        """Draw rows, columns or pixels with exactly this standard deviation."""
        shape = {"row": (n_y, 1), "column": (1, n_x), "pixel": SHAPE}[name]
        values = rng.normal(size=shape)
        for axis in (0, 1):
            values -= values.mean(axis=axis, keepdims=True) if shape[axis] > 1 else 0.0
        degrees = (n_y - 1) * (n_x - 1) if name == "pixel" else max(shape) - 1
        return values * TRUTH[f"{kind}_{name}_{unit}"] / math.sqrt((values**2).sum() / degrees)

    def pattern(kind: str, unit: str) -> np.ndarray:
        return part(kind, "row", unit) + part(kind, "column", unit) + part(kind, "pixel", unit)

    offset_e, response = pattern("dsnu", "e"), 1.0 + pattern("prnu", "fraction")

    def frames(photons: float, time_s: float, n: int) -> np.ndarray:
        mean_e = TRUTH["qe"] * photons * response + TRUTH["dark_e_per_s"] * time_s
        charge_e = np.minimum(rng.poisson(mean_e, (n, *SHAPE)), TRUTH["full_well_e"])
        read_e = charge_e + offset_e + rng.normal(0.0, TRUTH["read_noise_e"], charge_e.shape)
        codes = np.rint(TRUTH["gain_dn_per_e"] * read_e + BLACK_DN)
        return np.clip(codes, 0, 2**BITS - 1).astype(np.uint16)

    photons = PHOTONS_PER_S * TIMES_S
    numbers = [N_STACK if k == HALF else 2 for k in range(N_LEVELS)]
    lit, dark = (
        [frames(p * has, t, n) for p, t, n in zip(photons, TIMES_S, numbers, strict=True)] for has in (1.0, 0.0)
    )
    return Series(lit, dark, photons)


def write_series(series: Series, folder: Path) -> Path:
    """
    Write frames as PNG, the descriptor file of the reference, and the list of stacks of a twin.

    Return the descriptor.
    """
    lines, stacks = [f"n {BITS} {SHAPE[1]} {SHAPE[0]}"], ["stacks:"]
    for kind, levels in (("b", series.lit), ("d", series.dark)):
        for k, (codes, time_s) in enumerate(zip(levels, TIMES_S, strict=True)):
            directory = folder / f"{kind}_{k:02d}"
            directory.mkdir(parents=True, exist_ok=True)
            names = [f"{directory.name}/{n:02d}.png" for n in range(len(codes))]
            for name, frame in zip(names, codes, strict=True):
                Image.fromarray(frame).save(folder / name)
            photons = float(series.photons[k]) if kind == "b" else 0.0
            head = f"{kind} {1e9 * time_s:.0f}" + (f" {photons!r}" if kind == "b" else "")
            # Two files are temporal data of the reference, more are spatial data.
            for part in (names[:2], names) if len(names) > 2 else (names,):
                lines += [head, *(f"i {name}" for name in part)]
            stacks.append(
                f"  - {{frames: '{directory.name}/*.png', exposure_s: {time_s}, photons: {photons!r}, name: {directory.name}}}"
            )
    (folder / "stacks.yaml").write_text("\n".join(stacks) + "\n")
    descriptor = folder / "descriptor.txt"
    descriptor.write_text("\n".join(lines) + "\n")
    return descriptor


def reference_of(descriptor: Path, saturation: int | None = None) -> Any:
    """
    Return the results of the reference implementation.

    ``saturation``: index of the level, instead of the search of the reference.
    """
    from emva1288.process import routines
    from emva1288.process.data import Data1288
    from emva1288.process.loader import LoadImageData
    from emva1288.process.parser import ParseEmvaDescriptorFile
    from emva1288.process.results import Results1288

    # Numpy 2 lacks a function that the reference calls.
    routines.np = SimpleNamespace(**{"asfarray": partial(np.asarray, dtype=np.float64)} | vars(np))
    parsed = ParseEmvaDescriptorFile(str(descriptor), loglevel=logging.ERROR)
    loaded = LoadImageData(parsed.images, loglevel=logging.ERROR)
    data = Data1288(loaded.data, loglevel=logging.ERROR).data
    return Results1288(data, index_u_ysat=saturation, loglevel=logging.ERROR)


def own_of(series: Series) -> tuple[fs.metrics.Emva1288, fs.metrics.Emva1288]:
    """Return the parameters of the pairs of frames, and those of the stacks, among fewer levels."""
    layout = fs.layout.grid(n_x=SHAPE[1], n_y=SHAPE[0], pitch_um=PIXEL_UM)

    def sites(n: int, step: int) -> list[list[np.ndarray]]:
        """Return light and dark frames of sites, the bottom row first."""
        return [
            [codes[:n, ::-1].reshape(-1, layout.n_sites) for codes in levels[::step]]
            for levels in (series.lit, series.dark)
        ]

    lit, dark = sites(2, 1)
    temporal = fs.metrics.emva1288(lit, dark, series.photons, dark_series=dark, exposure_s=TIMES_S)
    return temporal, fs.metrics.emva1288(*sites(N_STACK, STEP), series.photons[::STEP], layout=layout)


@dataclass(frozen=True)
class Row:
    """A parameter: of the frames, of the reference, of emva1288, and value and limits of a twin; NaN or None without one."""

    title: str
    truth: float
    reference: float
    own: float
    twin: tuple[float, float, float] | None = None


def rows_of(reference: Any, own: tuple[Any, Any], estimates: Any) -> list[Row]:
    """Return the parameters of each of the three."""
    temporal, spatial = own
    # In electrons by the gain of all levels, as in the reference.
    scale = float(spatial.gain_dn_per_e[0] / temporal.gain_dn_per_e[0])

    def row(title: str, names: tuple[str, str], truth: str = "", twin: str = "") -> Row:
        name, own_name = names
        value = getattr(reference, name, math.nan)
        source = spatial if own_name.startswith(("dsnu", "prnu")) else temporal
        found = float(getattr(source, own_name)[0]) if own_name else math.nan
        percent = 100.0 if title.endswith("%") else 1.0
        found *= percent * (scale if own_name.startswith("dsnu") else 1.0)
        estimate = tuple(percent * each for each in estimates[twin]) if twin else None
        return Row(
            title, percent * TRUTH.get(truth, math.nan), float(value() if callable(value) else value), found, estimate
        )

    return [
        row("gain K / DN/e-", ("K", "gain_dn_per_e"), "gain_dn_per_e", "gain_dn_per_e"),
        row("quantum efficiency / %", ("QE", "qe"), "qe", "qe"),
        row("dark noise / DN", ("sigma_y_dark", "dark_noise_dn")),
        row("dark noise / e-", ("sigma_d", "dark_noise_e"), "read_noise_e", "read_noise_e"),
        row("sensitivity threshold / photons", ("u_p_min", "threshold_ph")),
        row("saturation / e-", ("u_e_sat", "saturation_e")),
        row("full well / e-", ("", ""), "full_well_e", "full_well_e"),
        row("maximum SNR / dB", ("SNR_max_dB", "snr_max_db")),
        row("dynamic range / dB", ("DR_dB", "dynamic_range_db")),
        row("lowest linearity error / %", ("LE_min", "linearity_error_min_fraction")),
        row("highest linearity error / %", ("LE_max", "linearity_error_max_fraction")),
        row("dark current of means / e-/s", ("u_I_mean", "dark_current_e_per_s"), "dark_e_per_s", "dark_e_per_s"),
        row("dark current of variances / e-/s", ("u_I_var", "dark_current_from_variance_e_per_s"), "dark_e_per_s"),
        row("DSNU / e-", ("DSNU1288", "dsnu_e"), "dsnu_e"),
        row("DSNU of rows / e-", ("DSNU1288_row", "dsnu_row_e"), "dsnu_row_e", "dsnu_row_e"),
        row("DSNU of columns / e-", ("DSNU1288_col", "dsnu_column_e"), "dsnu_column_e", "dsnu_column_e"),
        row("DSNU of pixels / e-", ("DSNU1288_pixel", "dsnu_pixel_e"), "dsnu_pixel_e", "dsnu_e"),
        row("PRNU / %", ("PRNU1288", "prnu_fraction"), "prnu_fraction"),
        row("PRNU of rows / %", ("PRNU1288_row", "prnu_row_fraction"), "prnu_row_fraction", "prnu_row_fraction"),
        row(
            "PRNU of columns / %",
            ("PRNU1288_col", "prnu_column_fraction"),
            "prnu_column_fraction",
            "prnu_column_fraction",
        ),
        row("PRNU of pixels / %", ("PRNU1288_pixel", "prnu_pixel_fraction"), "prnu_pixel_fraction", "prnu_fraction"),
    ]


def table_of(rows: list[Row]) -> str:
    """Return the table as Markdown."""
    lines = ["| parameter | drawn | reference | `emva1288` | twin | 95 % interval |", "|---|---|---|---|---|---|"]
    for each in rows:
        value, limits = "", ""
        if each.twin is not None:
            value, limits = _digits(each.twin[0]), f"{_digits(each.twin[1])} to {_digits(each.twin[2])}"
        cells = [each.title, *map(_digits, (each.truth, each.reference, each.own)), value, limits]
        lines.append(f"| {' | '.join(cells)} |".replace("  ", " "))
    return "\n".join(lines)


def _digits(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.5g}"


def main(folder: Path) -> None:
    """Print the table."""
    series = draw_series()
    descriptor, own = write_series(series, folder), own_of(series)
    saturation = int(own[0].transfer.saturation_level[0])
    twin = fs.twin.fit(folder, bits=BITS, pixel_um=PIXEL_UM)
    print(table_of(rows_of(reference_of(descriptor, saturation), own, twin.estimates)))
    print(
        f"\nLevel of the highest variance: {saturation}; search of the reference: {reference_of(descriptor).index_u_ysat}."
    )
    print(f"Mean square of the deviations of the twin: {twin.chi_square_ratio:.2f}.")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with TemporaryDirectory() as temporary:
            main(Path(temporary))
