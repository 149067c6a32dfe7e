"""Simulation of a shot, its result files, and the summary table."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import shapely
from rich.table import Table

from foveasim._core.short_repr import short_repr
from foveasim._io.atomic import atomic_files
from foveasim._io.terminal import as_plain_text
from foveasim.capture import Capture
from foveasim.config._objects import Shot
from foveasim.errors import FileError, printable
from foveasim.layout import Layout, Report
from foveasim.reconstruct.picture import NO_DATA_COLOUR
from foveasim.view import hidden_figures, plot_capture, prisms, render, save_figure
from foveasim.view.renderer import missing_software

#: Shots of the demo, in the order of the table.
DEMO_SHOTS = ("foveal", "four_zones")
#: Longer side of the pictures that a shot writes.
PICTURE_PIXELS = 1024


def demo_settings() -> list[Path]:
    """
    Return the bundled settings files of the demo.

    Examples
    --------
    >>> import foveasim as fs
    >>> [path.name for path in fs.config.demo_settings()]
    ['foveal.yaml', 'four_zones.yaml']
    """
    return [Path(str(files("foveasim.config") / f"{name}.yaml")) for name in DEMO_SHOTS]


def check_directory(directory: str | Path) -> Path:
    """
    Return the path of a directory for results, after a check of permissions.

    Raises
    ------
    FileError
        When a file is in its place, or it cannot be created or written.
    """
    directory = Path(directory)
    existing = next(path for path in (directory, *directory.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise FileError(directory, f"cannot contain results: {existing} is a file; choose a directory")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise FileError(directory, f"cannot contain results: {existing} is not writable")
    return directory


def write_results(shot: Shot, capture: Capture, directory: str | Path) -> tuple[list[Path], float]:
    """
    Write ``NAME_picture.png``, ``NAME_layout.png`` and ``NAME_capture.npz``.

    Parameters
    ----------
    shot : Shot
    capture : Capture
    directory : path
        Created when missing. All files are written, or none.

    Returns
    -------
    paths : list of path
    seconds : float, s
        Elapsed time.

    Raises
    ------
    FileError
        When the directory cannot be created or written.
    """
    start_s = time.perf_counter()
    directory = check_directory(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(directory, f"cannot be created: {error.strerror or error}") from None
    paths = [directory / f"{shot.name}_{part}" for part in ("picture.png", "layout.png", "capture.npz")]
    with atomic_files(*paths) as (picture, layout, saved):
        capture.picture(max_pixels=PICTURE_PIXELS).save(picture, capture.white_dn, background=NO_DATA_COLOUR)
        with hidden_figures():
            axes = plot_capture(capture)
        axes.set_title(f"{printable(shot.name)}: {capture.layout.n_sites} photosites", parse_math=False)
        save_figure(axes.figure, layout)  # type: ignore[arg-type]
        capture.save(saved)
    return paths, time.perf_counter() - start_s


@dataclass(frozen=True)
class Result:
    """A shot with its capture, the report of its design rules, and the time to write files."""

    shot: Shot
    capture: Capture
    report: Report | None
    writing_s: float

    __repr__ = short_repr


def run_shot(shot: Shot, directory: str | Path) -> tuple[Result, list[Path]]:
    """
    Simulate a shot, check its design rules, and write its files.

    Returns
    -------
    result : Result
    paths : list of path
        The files written.

    Raises
    ------
    FoveasimError
        When the parts are incompatible, or files cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import foveasim as fs
    >>> settings = {
    ...     "scene": {
    ...         "kind": "flat",
    ...         "shape": [60, 60],
    ...         "pitch_um": 300.0,
    ...         "distance_m": 1.0,
    ...         "illuminance_lux": 500.0,
    ...     },
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": {
    ...         "generator": "grid",
    ...         "parameters": {"n_x": 16, "n_y": 16, "pitch_um": 3.0},
    ...     },
    ...     "exposure_s": "auto",
    ... }
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     result, paths = fs.config.run_shot(
    ...         fs.config.build_shot("wall", settings), directory
    ...     )
    ...     print([path.name for path in paths])
    ['wall_picture.png', 'wall_layout.png', 'wall_capture.npz']
    """
    capture = shot.camera.capture(shot.scene, exposure_s=shot.requested_s, seed=shot.seed)
    shot = shot.captured(capture)
    report = None if shot.rules is None else capture.layout.check(shot.rules)
    paths, writing_s = write_results(shot, capture, directory)
    return Result(shot, capture, report, writing_s), paths


def write_3d_picture(result: Result, directory: str | Path) -> Path | None:
    """
    Write ``NAME_3d.png``: photosites as prisms with their codes as height, by PyVista.

    Returns
    -------
    path : Path or None
        None when PyVista or OpenGL is missing.

    Raises
    ------
    FileError
        When the directory cannot be written.
    """
    if missing_software():
        return None
    path = check_directory(directory) / f"{result.shot.name}_3d.png"
    render(prisms(result.capture), path, renderer="pyvista")
    return path


def results_table(results: Sequence[Result]) -> Table:
    """Return a table of the shots' captures, one column per shot."""
    table = Table(title="Captures")
    table.add_column("")
    for result in results:
        table.add_column(as_plain_text(result.shot.name), justify="right")
    captures = [result.capture for result in results]
    rows = {
        "photosites": [f"{c.layout.n_sites:,}" for c in captures],
        "design rules": [_verdict(result.report) for result in results],
        "smallest site / µm": [f"{c.layout.size_um.min():.2f}" for c in captures],
        "largest site / µm": [f"{c.layout.size_um.max():.2f}" for c in captures],
        "blind-spot radius / µm": [_blind_spot(c.layout) for c in captures],
        "median electrons": [f"{np.median(c.electrons):,.0f}" for c in captures],
        "maximum electrons": [f"{c.electrons.max():,}" for c in captures],
        "median code / DN": [f"{np.median(c.code):,.0f} of {2**c.bits - 1:,}" for c in captures],
        "sites at code 0 / %": [f"{100 * np.mean(c.code == 0):.2f}" for c in captures],
        "saturated sites / %": [f"{100 * c.saturated_fraction:.2f}" for c in captures],
    }
    for stage in dict.fromkeys(stage for c in captures for stage in c.stage_s):
        rows[f"{stage} / s"] = [f"{c.stage_s.get(stage, 0.0):.3f}" for c in captures]
    rows["write files / s"] = [f"{result.writing_s:.3f}" for result in results]
    for title, values in rows.items():
        table.add_row(title, *values)
    return table


def _verdict(report: Report | None) -> str:
    if report is None:
        return "none"
    return "satisfied" if report.ok else f"{sum(len(result) for result in report.results):,} violations"


def _blind_spot(layout: Layout) -> str:
    """Return the radius of the hole at the centre of the innermost ring, or "none"."""
    if "ring" not in layout.columns:
        return "none"
    innermost = layout[layout.columns["ring"] == layout.columns["ring"].min()]
    centre_um = innermost.centroid_um.mean(axis=0)
    if shapely.intersects_xy(innermost.polygons(), *centre_um).any():
        return "none"
    return f"{np.linalg.norm(innermost.xy_um - centre_um, axis=1).min():.2f}"
