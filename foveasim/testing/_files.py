"""Checks of file formats: example files, truncated files, and round trips."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from foveasim.config import read_layout
from foveasim.errors import FoveasimError
from foveasim.fields import Grid, PowerMap
from foveasim.layout import FORMATS, Layout, grid
from foveasim.maps import MAP_FORMATS, read_power_map, write_power_map
from foveasim.optics import PSF_FORMATS, PSFGrid, read_psfs
from foveasim.scene import CUBE_FORMATS, Scene
from foveasim.testing._extension import Extension, check_of, require

#: Tolerances of coordinates, µm, and of relative values and areas in files.
POSITION_UM, RELATIVE, AREA = 1e-3, 1e-6, 1e-3
#: Fractions of the complete file that remain in truncated files.
TRUNCATED = (0.3, 0.7)

Reader = Callable[..., Any]
Compare = Callable[[Any, Any], str]


@check_of(FORMATS)
def check_layout_format(extension: Extension) -> None:
    """Check a format of layouts."""
    standard = grid(n_x=3, n_y=2, pitch_um=2.0)[[0, 1, 2, 3, 5]].translate(1.0, 4.0)  # without symmetry

    def write(path: Path) -> None:
        standard.write(path)

    _check_format(extension, read_layout, write, standard, _layout_difference)


def _layout_difference(found: object, expected: Layout) -> str:
    if not isinstance(found, Layout):
        return f"returns {type(found).__name__}, expected Layout"
    if found.n_sites != expected.n_sites:
        return f"returns {found.n_sites} sites, expected {expected.n_sites}"
    away_um = np.abs(found.centroid_um - expected.centroid_um).max()
    if away_um > POSITION_UM:
        return f"returns sites that are displaced by up to {away_um:.4g} µm; check units, orientation and order"
    error = np.abs(found.area_um2 / expected.area_um2 - 1.0).max()
    return f"returns areas that differ by up to {error:.1%}" if error > AREA else ""


@check_of(MAP_FORMATS)
def check_map_format(extension: Extension) -> None:
    """Check a format of power maps."""
    values = np.arange(1000, dtype=np.float32).reshape(2, 20, 25)  # more than the blocks to which files are padded
    standard = PowerMap(values, Grid((20, 25), 0.5, (-1.0, 2.0)), np.array([450.0, 550.0]))

    def write(path: Path) -> None:
        write_power_map(standard, path)

    _check_format(extension, read_power_map, write, standard, _map_difference)


def _map_difference(found: PowerMap, expected: PowerMap) -> str:
    if found.data.shape != expected.data.shape:
        return f"returns a map of shape {found.data.shape}, expected {expected.data.shape}"
    if not np.allclose(found.data, expected.data, rtol=RELATIVE):
        return "returns other values; check units, and that row 0 is the lowest row"
    if not np.allclose(found.grid.bounds_um, expected.grid.bounds_um, atol=POSITION_UM):
        return f"returns a map from {found.grid.bounds_um}, expected {expected.grid.bounds_um} µm"
    if not np.allclose(found.wavelength_nm, expected.wavelength_nm):
        return f"returns the wavelengths {found.wavelength_nm}, expected {expected.wavelength_nm} nm"
    return ""


@check_of(CUBE_FORMATS)
def check_cube_format(extension: Extension) -> None:
    """Check a format of hyperspectral cubes."""

    def read(path: Path, **options: Any) -> Scene:
        return Scene.from_cube(path, **{"distance_m": 1.0, "pitch_um": 100.0, **options})

    _check_format(extension, read, None, None, _cube_difference)


def _cube_difference(scene: Scene, expected: Any) -> str:
    radiance = np.einsum("byx,bk->kyx", scene.basis, scene.spectrum_w_m2_sr_nm)
    if radiance.shape != np.shape(expected):
        return f"returns radiance of shape {radiance.shape}, expected {np.shape(expected)}"
    if not np.allclose(radiance, expected, rtol=RELATIVE):
        return "returns another radiance; check units, and that row 0 is the lowest row"
    return ""


@check_of(PSF_FORMATS)
def check_psf_format(extension: Extension) -> None:
    """Check a format of PSFs."""
    values = np.zeros((3, 2, 33, 37))  # more than the blocks to which files are padded
    values[..., 5:-5, 5:-5] = np.arange(3 * 2 * 23 * 27).reshape(3, 2, 23, 27)  # without symmetry
    standard = PSFGrid(
        psf=values,
        x_um=np.array([0.0, 1.0, 2.0]),
        y_um=np.array([0.0, 2.0, 4.0]),
        wavelength_nm=np.array([450.0, 550.0]),
        pitch_um=0.5,
        samples="bins",
        relative_illumination=np.array([[1.0, 1.0], [0.9, 0.8], [0.7, 0.6]]),
    )
    _check_format(extension, read_psfs, standard.write, standard, _psf_difference)


def _psf_difference(found: PSFGrid, expected: PSFGrid) -> str:
    if found.psf.shape != expected.psf.shape:
        return f"returns PSFs of shape {found.psf.shape}, expected {expected.psf.shape}"
    if not np.allclose(found.psf, expected.psf, atol=RELATIVE * expected.psf.max()):
        return "returns other values; check that PSFs are upright, with row 0 as the lowest row"
    if not all(np.allclose(getattr(found, at), getattr(expected, at), atol=POSITION_UM) for at in ("x_um", "y_um")):
        return "returns other points of the field; check units, and that they are those of the upright picture"
    if not np.allclose(found.wavelength_nm, expected.wavelength_nm) or not np.allclose(
        found.pitches_um, expected.pitches_um
    ):
        return "returns other wavelengths or another distance of the samples"
    if not np.allclose(found.middle_offset, expected.middle_offset, atol=1e-6):
        return "returns another position of the image point; check centre"
    if found.samples != expected.samples:
        return f"returns samples={found.samples!r}, expected {expected.samples!r}"
    read, stored = found.relative_illumination, expected.relative_illumination
    if (read is None) != (stored is None) or (
        read is not None and stored is not None and not np.allclose(read, stored)
    ):
        return "returns another relative illumination"
    return ""


def _check_format(
    extension: Extension, read: Reader, write: Callable[[Path], None] | None, standard: Any, difference: Compare
) -> None:
    """Read the example, the standard object that the format writes, and truncated files."""
    form = extension.item
    require(form.title and form.suffixes, "must have a title and suffixes")
    path = extension.directory / f"example{form.suffixes[0]}"
    options: dict[str, Any] = {}
    if callable(extension.example):
        found = extension.example(path)
        expected, options = found if isinstance(found, tuple) else (found, {})
    else:
        require(
            form.write is not None, "has no example; register it with a function of a path that writes a small file"
        )
        expected = standard
        assert write is not None
        write(path)
    require(path.exists(), f"has an example that does not write {path.name}")
    if form.read is None:
        return
    require(form.matches_file(path, b"" if path.is_dir() else path.read_bytes()[:1024]), "must match its own files")
    wrong = difference(read(path, **options), expected)
    require(not wrong, wrong)
    if form.write is not None and write is not None and callable(extension.example):
        again = path.with_name(f"again{path.suffix}")
        write(again)
        wrong = difference(read(again), standard)
        require(not wrong, f"{wrong} for a file that it wrote")
    if path.is_file():
        _check_truncated(path, read, options, expected, difference)
    else:
        shutil.rmtree(path)


def _check_truncated(path: Path, read: Reader, options: dict[str, Any], expected: Any, difference: Compare) -> None:
    complete = path.read_bytes()
    for fraction in TRUNCATED:
        path.write_bytes(complete[: int(fraction * len(complete))])
        try:
            found = read(path, **options)
        except FoveasimError:
            continue
        except Exception as error:
            raise AssertionError(
                f"raises {type(error).__name__} for a truncated file; a FormatError becomes a message with the path"
            ) from error
        require(difference(found, expected), "must not read a truncated file as if it were complete")
