"""Taking a shot and writing its results."""

from __future__ import annotations

import tempfile
import time
from importlib.resources import files
from pathlib import Path

import numpy as np
from rich.table import Table

from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.errors import FileError
from foveasim.view import plot_capture, save_figure

__all__ = ["demo_settings", "results_table", "take", "write_results"]

#: The demo's shots, in the order shown.
DEMO_SHOTS = ("foveal", "four_zones")
#: Side of the pictures that a shot writes.
PICTURE_PIXELS = 1024


def demo_settings() -> list[Path]:
    """The settings files of the demo's shots, which come with the package."""
    return [Path(str(files("foveasim.shots") / f"{name}.yaml")) for name in DEMO_SHOTS]


def take(shot: Shot) -> Capture:
    """Capture of a shot."""
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)


def write_results(shot: Shot, capture: Capture, folder: str | Path) -> tuple[list[Path], float]:
    """
    Write a capture's files: ``NAME_picture.png``, ``NAME_layout.png``, ``NAME_capture.npz``.

    Parameters
    ----------
    shot : Shot
    capture : Capture
    folder : path
        Made when it does not exist. Nothing is put in it before every file is complete.

    Returns
    -------
    paths : list of path
    seconds : float, s
        Time that it took.

    Raises
    ------
    FileError
        When the folder cannot be made or written.
    """
    start_s = time.perf_counter()
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".foveasim-", dir=folder) as staging:
            stage = Path(staging)
            capture.picture(max_pixels=PICTURE_PIXELS).save(
                stage / f"{shot.name}_picture.png", capture.white_dn, encode_srgb=True
            )
            axes = plot_capture(capture)
            axes.set_title(f"{shot.name}: {capture.layout.n_sites} photosites")
            save_figure(axes.figure, stage / f"{shot.name}_layout.png")  # type: ignore[arg-type]
            capture.save(stage / f"{shot.name}_capture.npz")
            paths = [path.replace(folder / path.name) for path in sorted(stage.iterdir())]
    except OSError as error:
        raise FileError(folder, f"cannot be written: {error.strerror or error}") from None
    return paths, time.perf_counter() - start_s


def results_table(results: dict[str, tuple[Capture, float]]) -> Table:
    """Table of captures by name, each with the seconds that writing its files took."""
    table = Table(title="What the sensors saw")
    table.add_column("")
    for name in results:
        table.add_column(name, justify="right")

    def row(title: str, of: list[str]) -> None:
        table.add_row(title, *of)

    captures = [capture for capture, _ in results.values()]
    row("photosites", [f"{c.layout.n_sites:,}" for c in captures])
    row("smallest pixel / µm", [f"{np.sqrt(c.layout.area_um2.min()):.2f}" for c in captures])
    row("largest pixel / µm", [f"{np.sqrt(c.layout.area_um2.max()):.2f}" for c in captures])
    row("blind-spot radius / µm", [_blind_spot(c) for c in captures])
    row("median electrons", [f"{np.median(c.electrons):,.0f}" for c in captures])
    row("most electrons", [f"{c.electrons.max():,}" for c in captures])
    row("saturated sites / %", [f"{100 * c.saturated:.2f}" for c in captures])
    stages = list(dict.fromkeys(stage for c in captures for stage in c.stage_s))
    for stage in stages:
        row(f"{stage} / s", [f"{c.stage_s.get(stage, 0.0):.3f}" for c in captures])
    row("pictures and files / s", [f"{seconds:.3f}" for _, seconds in results.values()])
    return table


def _blind_spot(capture: Capture) -> str:
    radius_um = capture.layout.provenance.get("blind_radius_um")
    return "none" if radius_um is None else f"{radius_um:.2f}"
