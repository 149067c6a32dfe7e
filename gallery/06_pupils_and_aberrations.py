"""
How do the pupil shape and the aberrations of a lens affect the images of a point and of
a letter?

New here: ``Optics(pupil=, zernike=, seidel=, focus_distance_m=)``, ``Optics.psf``,
``.mtf``, ``.strehl``, ``.field_error``.

Expect: diffraction spikes perpendicular to edges and vanes; a coma flare in +y, where
its wavefront error increases; Strehl ratios of 0.814 to 0.817 for 1/14 wave rms of any
aberration; a field of points with flares away from the axis, computed with 7 x 7
isoplanatic patches. As every diffraction fringe counts, these patches displace up to a
third of the energy of a PSF.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

import foveasim as fs
from foveasim import optics as parts
from foveasim.scene import charts
from foveasim.view import save_figure

WAVELENGTH_NM = 550.0
DISTANCE_M = 0.5
#: Spacing of the points of the field.
SPACING_MM = 3.6
#: Half the side of the PSFs.
EXTENT_UM = 14.0
LENS = {"focal_length_mm": 10.0, "f_number": 4.0}
LIGHT = {
    "distance_m": DISTANCE_M,
    "wavelength_nm": [WAVELENGTH_NM],
    "band_width_nm": 10.0,
}
#: Wavefront error for a Strehl ratio of about 0.8 (Marechal criterion), waves rms.
MARECHAL_WAVES = 1.0 / 14.0
#: Frequencies of the MTF for a test of the script.
QUICK = {"n_frequencies": 30}


def half_moon(
    x: np.ndarray,
    y: np.ndarray,
    wavelength_nm: float,  # noqa: ARG001 -- signature of pupil functions
) -> np.ndarray:
    """Return the transmission of a pupil: the upper half, decreasing in x."""
    return (y > 0.0) * (1.0 - 0.4 * (1.0 + x))


def pupils() -> dict[str, fs.Optics]:
    """Return lenses that differ in the pupil."""
    return {
        "clear circle": fs.Optics(**LENS),
        "annulus": fs.Optics(pupil=parts.Annulus(0.5), **LENS),
        "three vanes": fs.Optics(
            pupil=(parts.Annulus(0.3), parts.Spider(3, 0.03, angle_deg=90.0)), **LENS
        ),
        "five blades": fs.Optics(pupil=parts.Blades(5, angle_deg=90.0), **LENS),
        "user function": fs.Optics(pupil=half_moon, **LENS),
    }


def aberrations() -> dict[str, fs.Optics]:
    """Return lenses that differ in one aberration."""
    waves = {"unit": "waves", "wavelength_nm": WAVELENGTH_NM}
    return {
        "no aberration": fs.Optics(**LENS),
        "defocus": fs.Optics(focus_distance_m=0.65, **LENS),
        "coma in y": fs.Optics(
            zernike=parts.Zernike(coefficients={7: 0.3}, **waves), **LENS
        ),
        "astigmatism": fs.Optics(
            zernike=parts.Zernike(coefficients={6: 0.25}, **waves), **LENS
        ),
        "spherical": fs.Optics(
            zernike=parts.Zernike(coefficients={11: 0.25}, **waves), **LENS
        ),
    }


def draw(lenses: dict[str, fs.Optics], n_frequencies: int) -> Figure:
    """Draw PSF and image of a letter of each lens, and the MTF of all."""
    letter = charts.letter_f(
        height_mm=3.0,
        shape=(160, 160),
        pitch_um=32.0,
        radiance_w_m2_sr_nm=0.1,
        contrast=1.0,
        **LIGHT,
    )
    per_mm = np.linspace(0.0, 460.0, n_frequencies)
    figure = Figure(figsize=(8.0, 6.6), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 0.9))
    mtf = below.add_subplot()
    for k, ((name, lens), column) in enumerate(
        zip(lenses.items(), above.subplots(2, len(lenses)).T, strict=True)
    ):
        psf = lens.psf(WAVELENGTH_NM, distance_m=DISTANCE_M)
        highest = psf.psf_per_um2.max()
        left, bottom, right, top = psf.grid.bounds_um
        column[0].imshow(
            psf.psf_per_um2 + 1e-9,
            origin="lower",
            extent=(left, right, bottom, top),
            norm=LogNorm(1e-4 * highest, highest),
            cmap="magma",
        )
        column[0].set(xlim=(-EXTENT_UM, EXTENT_UM), ylim=(-EXTENT_UM, EXTENT_UM))
        column[0].set_title(
            f"{name}\nStrehl {lens.strehl(WAVELENGTH_NM, distance_m=DISTANCE_M):.2f}",
            fontsize=11,
        )
        column[1].imshow(
            lens.power_map(letter).data[0], origin="lower", cmap="gray", vmin=0.0
        )
        for axes in column:
            axes.set(xticks=[], yticks=[])
        for angle_deg, style in ((0.0, "-"), (90.0, "--")):
            contrast = lens.mtf(
                per_mm, WAVELENGTH_NM, angle_deg=angle_deg, distance_m=DISTANCE_M
            )
            mtf.plot(
                per_mm,
                contrast,
                style,
                color=f"C{k}",
                label=name if angle_deg == 0.0 else None,
            )
    above.axes[0].set_ylabel(f"PSF, {2 * EXTENT_UM:.0f} µm")
    above.axes[len(lenses)].set_ylabel("letter")
    mtf.plot([], [], "--", color="0.5", label="along y")
    mtf.set(
        xlabel="spatial frequency / (lp/mm)",
        ylabel="MTF",
        ylim=(0.0, 1.0),
        xlim=(0.0, per_mm[-1]),
    )
    mtf.grid(color="0.85")
    mtf.legend(frameon=False)
    return figure


def enlarged(power_map: fs.PowerMap, spacing_um: float) -> np.ndarray:
    """Return the surroundings of the images of a grid of points, top row first."""
    half = int(0.5 * spacing_um / 3.0 / power_map.grid.pitch_x_um)
    cells = power_map.data[0] ** 0.4

    def windows(centres_um: np.ndarray, axis_um: np.ndarray) -> list[slice]:
        middle = [int(np.abs(axis_um - at).argmin()) for at in centres_um]
        return [slice(k - half, k + half + 1) for k in middle]

    columns = windows(spacing_um * np.arange(-3, 4), power_map.grid.x_um)
    rows = windows(spacing_um * np.arange(2, -3, -1), power_map.grid.y_um)
    return np.block([[cells[row, column][::-1] for column in columns] for row in rows])


def main(out_dir: Path, n_frequencies: int = 200) -> None:
    """Write PSFs, letters and a field of points to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Pupils of different shapes.
    save_figure(draw(pupils(), n_frequencies), out_dir / "06_pupils.png", dpi=140)

    # %% Aberrations of a circular pupil.
    save_figure(
        draw(aberrations(), n_frequencies), out_dir / "06_aberrations.png", dpi=140
    )

    # %% Field of points through a lens with coma and astigmatism that increase with
    # field height.
    points = charts.point_grid(
        shape=(360, 480),
        pitch_um=60.0,
        spacing_mm=SPACING_MM,
        intensity_w_sr_nm=1e-6,
        **LIGHT,
    )
    field = fs.Optics(
        **LENS,
        seidel=parts.Seidel(coma_um=1.2, astigmatism_um=0.6, field_radius_um=300.0),
        field_patches=7,
    )
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    for position, (name, lens) in enumerate(
        {"no aberrations": fs.Optics(**LENS), "coma, astigmatism": field}.items(),
        start=1,
    ):
        axes = figure.add_subplot(1, 2, position)
        axes.imshow(
            enlarged(
                lens.power_map(points),
                1000.0 * SPACING_MM * lens.magnification(DISTANCE_M),
            ),
            cmap="magma",
        )
        axes.set(
            title=name,
            xticks=[],
            yticks=[],
            xlabel="points of the field, each enlarged 3 ×",
        )
    save_figure(figure, out_dir / "06_field.png", dpi=140)

    # %% Checks.
    waves = {"unit": "waves", "wavelength_nm": WAVELENGTH_NM}
    for j, name in {4: "defocus", 6: "astigmatism", 7: "coma", 11: "spherical"}.items():
        aberrated = fs.Optics(
            zernike=parts.Zernike(coefficients={j: MARECHAL_WAVES}, **waves), **LENS
        )
        strehl = aberrated.strehl(WAVELENGTH_NM)
        print(f"{name:>12}: Strehl {strehl:.4f} for 1/14 wave rms")
        assert abs(strehl - np.exp(-((2.0 * np.pi * MARECHAL_WAVES) ** 2))) < 4e-3
    displaced = field.field_error(points)
    print(f"7 x 7 isoplanatic patches displace up to {displaced:.1%} of the PSF energy")
    assert abs(displaced - 0.335) < 0.02
    coma = aberrations()["coma in y"].psf(WAVELENGTH_NM)
    weight = coma.psf_per_um2 / coma.psf_per_um2.sum()
    assert float((weight * coma.grid.y_um[:, np.newaxis]).sum()) > 1.0


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
