"""
Is it better to learn optics and layout together?

New here: ``foveasim.learn.Imaging`` with ``foveasim.learn.Mesh``: aberrations and
vertices are trained for the same task, the localisation of a point source; the error is
then measured with captures of the camera.

Expect: an RMS error of 0.58 ± 0.02 µm if optics and layout are learned together, 0.72 ±
0.01 µm for optics, then layout, and 0.84 ± 0.03 µm for layout, then optics, with the
same number of steps (three seeds, ``--full``). Optics alone give 0.77 µm, layout alone
1.47 µm, the best defocus with a uniform grid 0.90 µm, neither 1.94 µm. The learned lens
of the first seed has mostly astigmatism and defocus.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray
from shapely import get_coordinates
from torch import Tensor

import foveasim as fs
from foveasim.learn import Imaging, Mesh, barrier, site_power
from foveasim.optics import Zernike
from foveasim.reconstruct import estimate_from_code
from foveasim.view import save_figure

#: Map cells of 0.75 µm; 6 x 6 photosites of 8 µm; and a scene with a margin, so that
#: its centre moves over all positions.
CELL_UM, FIELD_CELLS, SCENE_CELLS, N_X = 0.75, 64, 112, 6
GRID = fs.Grid.centred((FIELD_CELLS, FIELD_CELLS), CELL_UM)
#: Positions of the point: a Gaussian distribution around the axis within a square.
POSITION_SD_UM, MAX_POSITION_CELLS = 6.0, 18
#: Photoelectrons of the point, and read noise per photosite.
SIGNAL_E, READ_NOISE_E = 100.0, 4.0
WAVELENGTH_NM, BAND_WIDTH_NM, DISTANCE_M = 550.0, 50.0, 1.0
#: Polynomials of the pupil, by Noll index: defocus, astigmatism, coma, trefoil,
#: spherical aberration.
NOLL = (4, 5, 6, 7, 8, 9, 10, 11)
#: Initial values of the optics, and learning rates of both.
START_UM, OPTICS_RATE_UM, LAYOUT_RATE_UM = 0.02, 0.006, 0.1
#: Random measurements per step of training.
N_BATCH = 256
#: Rules that keep photosites plausible during training, and the weight of their
#: violation.
RULES, BARRIER = (
    fs.DesignRules(
        min_size_um=1.5, min_width_um=1.0, min_angle_deg=30.0, angle_limit_deg=26.0
    ),
    1e-3,
)
#: Parts that are trained, in one or two phases with the same total number of steps.
CONDITIONS: dict[str, tuple[tuple[str, ...], ...]] = {
    "neither": (),
    "by hand": (),
    "optics": (("optics",),),
    "layout": (("layout",),),
    "optics, then layout": (("optics",), ("layout",)),
    "layout, then optics": (("layout",), ("optics",)),
    "together": (("optics", "layout"),),
}
SHOWN = ("neither", "by hand", "optics", "layout", "together")
#: Frames per position of a measurement.
N_FRAMES = 4
#: Defocus by hand: RMS wavefront errors that are compared.
DEFOCUS_UM = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
#: Arguments of a short version.
QUICK = {"n_steps": 24, "n_test": 80, "stride": 2}


def optics(coefficients_um: Mapping[int, float]) -> fs.Optics:
    """Return the lens with Zernike coefficients by Noll index."""
    aberrations = Zernike(coefficients={**dict.fromkeys(NOLL, 0.0), **coefficients_um})
    return fs.Optics(
        focal_length_mm=8.0,
        f_number=2.8,
        zernike=aberrations,
        oversample=1,
        padding="zero",
        padding_cells=16,
    )


def point(row: int, column: int, intensity_w_sr_nm: float = 1e-13) -> fs.Scene:
    """Return the scene of a point source at a cell."""
    return fs.Scene.point_sources(
        shape=(SCENE_CELLS, SCENE_CELLS),
        pixels=[(row, column)],
        intensity_w_sr_nm=intensity_w_sr_nm,
        pitch_um=CELL_UM / optics({}).magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        wavelength_nm=(WAVELENGTH_NM,),
        band_width_nm=BAND_WIDTH_NM,
    )


@dataclass(frozen=True)
class Lattice:
    """Positions of the point on every k-th cell along both axes, from an offset."""

    stride: int = 1
    offset_x: int = 0
    offset_y: int = 0

    def positions(self) -> tuple[Tensor, Tensor]:
        """
        Return positions (n, 2) in µm, from the lower left, and prior probabilities
        (n,).
        """
        cells = (
            torch.arange(
                -MAX_POSITION_CELLS, MAX_POSITION_CELLS + 1, dtype=torch.float64
            )
            + 0.5
        )
        x, y = (
            CELL_UM * cells[offset :: self.stride]
            for offset in (self.offset_x, self.offset_y)
        )
        xy = torch.cartesian_prod(y, x).flip(1)
        prior = torch.exp(-0.5 * (xy**2).sum(dim=1) / POSITION_SD_UM**2)
        return xy, prior / prior.sum()

    def windows(self, psf: Tensor) -> Tensor:
        """
        Return maps of the field (n, n_y, n_x) from the map of a point in its
        centre.
        """
        # A point that moves by whole cells: windows from the highest position to the
        # lowest.
        first, n = (
            (SCENE_CELLS - FIELD_CELLS) // 2 - MAX_POSITION_CELLS,
            2 * MAX_POSITION_CELLS,
        )
        begin_y, begin_x = (
            first + (n - offset) % self.stride
            for offset in (self.offset_y, self.offset_x)
        )
        end_y, end_x = (
            first + n - offset + FIELD_CELLS
            for offset in (self.offset_y, self.offset_x)
        )
        windows = (
            psf[begin_y:end_y, begin_x:end_x]
            .unfold(0, FIELD_CELLS, self.stride)
            .unfold(1, FIELD_CELLS, self.stride)
        )
        return windows.reshape(-1, FIELD_CELLS, FIELD_CELLS)


@dataclass(eq=False)
class Design:
    """Optics and layout."""

    imaging: Imaging
    mesh: Mesh

    @classmethod
    def start(cls, coefficients_um: Mapping[int, float] | None = None) -> Design:
        """Return the initial optics with a uniform grid."""
        centre = SCENE_CELLS // 2
        return cls(
            Imaging(
                optics(coefficients_um or {}), point(centre, centre), wrt=("zernike",)
            ),
            Mesh(
                fs.layout.grid(N_X, size_um=(FIELD_CELLS * CELL_UM,) * 2),
                boundary="sliding",
            ),
        )

    def expected_e(self, lattice: Lattice) -> Tensor:
        """Return the expected charges (n_position, n_site) of the points."""
        psf = self.imaging()[0].float()
        psf = psf * (SIGNAL_E / (float(psf.detach().sum()) * CELL_UM**2))
        maps = lattice.windows(psf)
        # Second order: the image of a point varies much between adjacent cells.
        return (
            site_power(self.mesh(), maps, self.mesh, GRID, order=2, n_threads=1)
            .double()
            .flip(0)
        )

    def camera(self) -> fs.Camera:
        """Return the camera with the current optics and layout."""
        sensor = fs.Sensor(
            self.mesh.layout(),
            read_noise_e=READ_NOISE_E,
            capacitance_f=1e-15,
            v_sat_v=1.0,
            pedestal_v=0.02,
            bits=12,
        )
        return fs.Camera(optics=self.imaging.optics(), sensor=sensor, order=2)


def posterior(readings_e: Tensor, expected_e: Tensor, prior: Tensor) -> Tensor:
    """
    Return the probabilities (n, n_position) of positions after readings (n,
    n_site).
    """
    variance = expected_e + READ_NOISE_E**2
    constant = ((expected_e**2 / variance) + variance.log()).sum(dim=1)
    squares = (
        readings_e**2 @ (1.0 / variance).T
        - 2.0 * readings_e @ (expected_e / variance).T
        + constant
    )
    return torch.softmax(prior.log() - 0.5 * squares, dim=1)


def mean_squared_error(
    design: Design, lattice: Lattice, n: int, random: torch.Generator
) -> Tensor:
    """
    Compute the mean variance of positions after n measurements, in µm²: the least
    error.
    """
    (xy, prior), expected_e = lattice.positions(), design.expected_e(lattice)
    mean = expected_e[torch.multinomial(prior, n, replacement=True, generator=random)]
    noise = torch.randn(mean.shape, generator=random, dtype=torch.float64)
    probability = posterior(
        mean + (mean + READ_NOISE_E**2).sqrt() * noise, expected_e, prior
    )
    return (probability @ (xy**2)).sum(dim=1).mean() - ((probability @ xy) ** 2).sum(
        dim=1
    ).mean()


def train(
    design: Design, what: Sequence[str], n_steps: int, stride: int, seed: int
) -> None:
    """Train parts of a design, "optics", "layout" or both."""
    random = torch.Generator().manual_seed(seed)
    groups = {
        "optics": (design.imaging.zernike, OPTICS_RATE_UM),
        "layout": (design.mesh.displacement_um, LAYOUT_RATE_UM),
    }
    for name, (parameter, _) in groups.items():
        parameter.requires_grad_(name in what)
    if "optics" in what:  # in focus, the gradient by defocus vanishes
        with torch.no_grad():
            design.imaging.zernike += START_UM * torch.randn(
                len(NOLL), generator=random, dtype=torch.float64
            )
    optimiser = torch.optim.Adam(
        [{"params": [groups[name][0]], "lr": groups[name][1]} for name in what]
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, n_steps)
    for _ in range(n_steps):
        optimiser.zero_grad()
        # Random offsets, as edges would otherwise move to places between the positions
        # of one lattice.
        lattice = Lattice(
            stride, *torch.randint(stride, (2,), generator=random).tolist()
        )
        loss = mean_squared_error(design, lattice, N_BATCH, random)
        if "layout" in what:
            loss = loss + BARRIER * barrier(design.mesh(), design.mesh, RULES)
        loss.backward()
        optimiser.step()
        if "layout" in what:
            design.mesh.limit_step()
        schedule.step()


@torch.no_grad()
def expected_error_um(design: Design) -> float:
    """Compute the RMS error of the model, with positions on all cells."""
    random = torch.Generator().manual_seed(0)
    return float(mean_squared_error(design, Lattice(), 3000, random).sqrt())


@torch.no_grad()
def estimate(
    design: Design, exposure_s: float, n_test: int, seed: int
) -> tuple[NDArray[np.float64], ...]:
    """Return true positions, and estimates from captures, (n, 2) each, in µm."""
    camera, rng = design.camera(), np.random.default_rng(seed)
    xy, prior = Lattice().positions()
    where = rng.choice(len(xy), n_test, p=prior.numpy())
    true_um = xy[where].numpy()
    expected_e, readings = [], []
    for k, (column, row) in enumerate(
        (true_um / CELL_UM + SCENE_CELLS // 2).astype(int).tolist()
    ):
        scene = point(row, column)
        rate = camera.photoelectrons_per_s(scene)
        for frame in range(N_FRAMES):
            capture = camera.capture(
                scene,
                exposure_s=exposure_s,
                seed=seed * n_test + k,
                frame=frame,
                photo_e_per_s=rate,
            )
            readings.append(
                estimate_from_code(capture.code, camera.sensor, exposure_s).light_e
            )
        expected_e.append(capture.expected_e)
    table = design.expected_e(Lattice())
    # The simulator confirms the model that was trained.
    np.testing.assert_allclose(np.array(expected_e), table[where].numpy(), atol=0.05)
    probability = posterior(torch.from_numpy(np.array(readings)), table, prior)
    return np.repeat(true_um, N_FRAMES, axis=0), (probability @ xy).numpy()


def rms_um(true_um: NDArray[np.float64], found_um: NDArray[np.float64]) -> float:
    """Compute the RMS distance of estimates from true positions."""
    return float(np.sqrt(((found_um - true_um) ** 2).sum(axis=1).mean()))


def learn(name: str, n_steps: int, stride: int, seed: int) -> Design:
    """Return the design of a condition."""
    if name == "by hand":
        return min(
            (Design.start({4: defocus_um}) for defocus_um in DEFOCUS_UM),
            key=expected_error_um,
        )
    design = Design.start()
    phases = CONDITIONS[name]
    for what in phases:
        train(design, what, n_steps // len(phases), stride, seed)
    return design


def draw_designs(
    designs: Mapping[str, Design],
    estimates: Mapping[str, Sequence[NDArray[np.float64]]],
) -> Figure:
    """Draw the layout, the image of a point and the errors of every design."""
    figure = Figure(figsize=(7.6, 5.6), layout="constrained")
    rows = figure.subfigures(3, 1, height_ratios=(1.12, 1.0, 1.16))
    titles = (
        "Photosites, with the part below",
        "Image of a point, on the photosites",
        "Errors of the position / µm",
    )
    for row, title in zip(rows, titles, strict=True):
        row.suptitle(title, x=0.01, ha="left", fontsize="medium", fontweight="bold")
    axes = np.array([row.subplots(1, len(designs)) for row in rows])
    reach_um, shown_um = 0.5 * SCENE_CELLS * CELL_UM, 14.0
    for (above, centre, below), (name, design) in zip(
        axes.T, designs.items(), strict=True
    ):
        outlines = [
            get_coordinates(polygon) for polygon in design.mesh.layout().polygons()
        ]
        above.add_collection(
            PolyCollection(outlines, facecolor="0.93", edgecolor="0.35", linewidth=0.6)
        )
        above.add_patch(
            Rectangle(
                (-shown_um, -shown_um),
                2 * shown_um,
                2 * shown_um,
                fill=False,
                edgecolor="tab:blue",
            )
        )
        half_um = 0.5 * FIELD_CELLS * CELL_UM + 0.5
        above.set(
            xlim=(-half_um, half_um),
            ylim=(-half_um, half_um),
            aspect="equal",
            title=name,
        )
        above.axis("off")
        with torch.no_grad():
            psf = design.imaging()[0].numpy()
        extent = (-reach_um, reach_um, -reach_um, reach_um)
        centre.imshow(
            np.sqrt(np.maximum(psf, 0.0)), origin="lower", extent=extent, cmap="gray_r"
        )
        centre.add_collection(
            PolyCollection(
                outlines, facecolor="none", edgecolor="tab:blue", linewidth=0.8
            )
        )
        centre.set(
            xticks=[], yticks=[], xlim=(-shown_um, shown_um), ylim=(-shown_um, shown_um)
        )
        true_um, found_um = estimates[name]
        below.plot(*(found_um - true_um)[:400].T, ".", markersize=2, color="0.4")
        rms = rms_um(true_um, found_um)
        below.add_patch(
            Circle(
                (0.0, 0.0),
                rms,
                fill=False,
                edgecolor="tab:red",
                linewidth=1.4,
                zorder=3,
            )
        )
        below.text(
            0.04,
            0.95,
            f"RMS {rms:.2f} µm",
            transform=below.transAxes,
            va="top",
            color="tab:red",
        )
        below.set(
            xlim=(-5.5, 5.5),
            ylim=(-5.5, 5.5),
            aspect="equal",
            xticks=(-4, 0, 4),
            yticks=(-4, 0, 4),
        )
        if below is not axes[2, 0]:
            below.set_yticklabels([])
    bar_um = 10.0
    axes[1, 0].plot(
        (-12.0, -12.0 + bar_um),
        (-12.0, -12.0),
        color="black",
        linewidth=2.5,
        solid_capstyle="butt",
    )
    axes[1, 0].text(
        -12.0 + 0.5 * bar_um, -11.2, f"{bar_um:g} µm", ha="center", va="bottom"
    )
    return figure


def draw_errors(
    measured: Mapping[str, NDArray[np.float64]],
    expected: Mapping[str, NDArray[np.float64]],
) -> Figure:
    """Draw the measured error of every condition, and the one of the model."""
    figure = Figure(figsize=(7.6, 3.6), layout="constrained")
    ax = figure.subplots()
    deviations = [deviation(values) for values in measured.values()]
    ax.barh(
        range(len(measured)),
        [v.mean() for v in measured.values()],
        xerr=deviations,
        color="0.75",
        capsize=3,
    )
    predicted = [expected[name].mean() for name in measured]
    ax.plot(
        predicted,
        range(len(measured)),
        "D",
        color="black",
        markersize=4,
        label="expected error of the model",
    )
    ax.set_yticks(range(len(measured)), list(measured))
    ax.invert_yaxis()
    ax.set(
        xlabel="RMS error of the position, measured with captures / µm", xlim=(0, None)
    )
    ax.legend(frameon=False)
    return figure


def deviation(values: NDArray[np.float64]) -> float:
    """Compute the sample standard deviation; 0 for one value."""
    return float(values.std(ddof=1)) if values.size > 1 else 0.0


def main(
    out_dir: Path,
    *,
    n_steps: int = 200,
    n_test: int = 500,
    stride: int = 1,
    seeds: Sequence[int] = (1,),
) -> None:
    """Write the figures to a directory, and print the errors."""
    out_dir.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    # An exposure in which the point gives the specified charge.
    start, centre = Design.start(), SCENE_CELLS // 2
    with torch.no_grad():
        expected_e = start.expected_e(Lattice())
        in_table_e = float(expected_e[len(expected_e) // 2].sum())
    exposure_s = in_table_e / float(
        start.camera().photoelectrons_per_s(point(centre, centre)).sum()
    )

    # %% Train every condition with every seed, and measure it.
    measured, expected, shown, estimates = {}, {}, {}, {}
    for name in CONDITIONS:
        start_s = time.perf_counter()
        designs = [learn(name, n_steps, stride, seed) for seed in seeds]
        results = [
            estimate(one, exposure_s, n_test, seed)
            for one, seed in zip(designs, seeds, strict=True)
        ]
        measured[name] = np.array([rms_um(*result) for result in results])
        expected[name] = np.array([expected_error_um(one) for one in designs])
        shown[name], estimates[name] = designs[0], results[0]
        elapsed_s = time.perf_counter() - start_s
        print(
            f"{name:20} {measured[name].mean():.3f} ± "
            f"{deviation(measured[name]):.3f} µm, "
            f"expected {expected[name].mean():.3f} µm, {elapsed_s:.0f} s"
        )

    # %% Figures.
    figure = draw_designs({name: shown[name] for name in SHOWN}, estimates)
    save_figure(figure, out_dir / "29_designs.png", dpi=140)
    save_figure(draw_errors(measured, expected), out_dir / "29_errors.png", dpi=140)

    # %% Checks.
    for name in CONDITIONS:
        np.testing.assert_allclose(measured[name], expected[name], rtol=0.15)
    assert measured["together"].mean() < 0.6 * measured["neither"].mean()
    if n_steps >= 200:
        assert min(measured, key=lambda name: measured[name].mean()) == "together"
    for design in shown.values():
        assert design.mesh.layout().check(RULES).ok


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out_dir", nargs="?", default=".", type=Path)
    parser.add_argument("--full", action="store_true", help="three seeds")
    arguments = parser.parse_args()
    main(arguments.out_dir, seeds=(1, 2, 3) if arguments.full else (1,))
