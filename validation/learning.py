"""
Sensor layers of PyTorch: adjoints, gradients and noise.

Truths are those of other code: integrals of clipped polygons in shapely, differentiated numerically, captures of the simulator
(NumPy and compiled kernels) with changed inputs, a dense pseudoinverse. The other program for gradients by vertices is what
networks commonly use, soft masks: a product of sigmoids over samples, differentiated by autograd. Their edges are blurred by
the width of the sigmoid, and their gradients are as exact as the samples resolve it. deepinv has the solvers, its own
operators for photosites on a pixel grid, and noise.
"""

from __future__ import annotations

import importlib.metadata
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from matplotlib.figure import Figure
from records import OWN, Section, largest_absolute
from scipy.ndimage import gaussian_filter

import foveasim as fs

if TYPE_CHECKING:
    import torch

TORCH, DEEPINV = (
    f"{title} {importlib.metadata.version(name)}" for title, name in (("PyTorch", "torch"), ("deepinv", "deepinv"))
)
#: Cells along a side of the map, of 1 µm, and sites along a side of the layout.
N_CELLS, N_SITES = 48, 4
#: Step of numerical derivatives, µm: integrals are quadratic functions of a vertex between corners of cells.
STEP_UM = 1e-4
SHAPE = (24, 24)


# -- vertices ----------------------------------------------------------------------------------------------------------


def random_map() -> np.ndarray:
    """Return a smooth map with a mean of about 1, bottom row first."""
    rng = np.random.default_rng(0)
    return 1.0 + 3.0 * gaussian_filter(rng.standard_normal((N_CELLS, N_CELLS)), 2.0, mode="wrap")


def clipped_power(vertices: np.ndarray, cells: np.ndarray) -> float:
    """Return the integral of a map over a polygon, by the areas of its intersections with all cells."""
    polygon = shapely.Polygon(vertices)
    half = 0.5 * N_CELLS
    low = np.floor(vertices.min(axis=0) + half).astype(int)
    high = np.ceil(vertices.max(axis=0) + half).astype(int)
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    boxes = shapely.box(x - half, y - half, x + 1 - half, y + 1 - half)
    return float((shapely.area(shapely.intersection(boxes, polygon)) * cells[y, x]).sum())


def compare_vertices(section: Section, directory: Path) -> None:
    """Compare derivatives of integrals by vertices that neighbours share."""
    import torch

    cells = random_map()
    # No vertex at a corner of cells, where second derivatives jump.
    layout = fs.layout.grid(N_SITES, N_SITES, 8.3).rotate(10.0).translate(0.31, -0.17)
    mesh, grid = fs.learn.Mesh(layout, "free"), fs.Grid.centred((N_CELLS, N_CELLS), 1.0)
    weights = np.random.default_rng(1).standard_normal(layout.n_sites)
    start = mesh().detach()
    begin, _ = mesh.outlines.vertices(start)
    corners = begin.numpy().reshape(layout.n_sites, 4, 2)
    index = np.argmin(np.abs(corners[:, :, np.newaxis] - start.numpy()).sum(axis=-1), axis=-1)

    def loss(points: np.ndarray, sites: np.ndarray) -> float:
        return sum(weights[k] * clipped_power(points[index[k]], cells) for k in sites)

    truth = np.zeros((len(start), 2))
    for point in range(len(start)):
        sites = np.flatnonzero((index == point).any(axis=1))
        for axis in range(2):
            sides = []
            for sign in (1.0, -1.0):
                moved = start.numpy().copy()
                moved[point, axis] += sign * STEP_UM
                sides.append(loss(moved, sites))
            truth[point, axis] = (sides[0] - sides[1]) / (2.0 * STEP_UM)
    tensor, tensor_weights = torch.from_numpy(cells), torch.from_numpy(weights)

    def gradient(power: Callable[[torch.Tensor], torch.Tensor]) -> np.ndarray:
        points = start.clone().requires_grad_()
        (found,) = torch.autograd.grad((tensor_weights * power(points)).sum(), points)
        return found.numpy()

    def soft_power(points: torch.Tensor, n_samples: int, softness: float) -> torch.Tensor:
        """Integrate by masks of samples, with sigmoids as wide as ``softness``, in µm, at the edges."""
        at = (torch.arange(N_CELLS * n_samples) + 0.5) / n_samples - 0.5 * N_CELLS
        samples = torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).reshape(-1, 2).double()
        values = tensor.repeat_interleave(n_samples, 0).repeat_interleave(n_samples, 1).reshape(-1) / n_samples**2
        edge_begin, edge_end = mesh.outlines.vertices(points)
        along = edge_end - edge_begin
        normal = torch.stack((-along[:, 1], along[:, 0]), dim=1) / along.norm(dim=1, keepdim=True)
        inside = torch.sigmoid((normal @ samples.T - (normal * edge_begin).sum(dim=1, keepdim=True)) / softness)
        return inside.reshape(layout.n_sites, 4, -1).prod(dim=1) @ values

    masks, fine = f"soft masks, {TORCH}", f"soft masks, 6 × 6 samples a cell, {TORCH}"
    found = section.compare(
        f"derivatives of the powers of {layout.n_sites} photosites by the {2 * len(start)} coordinates of their vertices",
        {
            OWN: lambda: gradient(lambda points: fs.learn.site_power(points, tensor, mesh, grid)),
            masks: lambda: gradient(lambda points: soft_power(points, 1, 0.5)),
            fine: lambda: gradient(lambda points: soft_power(points, 6, 0.1)),
        },
        truth,
        by="central differences of integrals over clipped polygons, in shapely",
        source="construction",
        tolerance=1e-6,
        cannot={masks: "one sample per cell, sigmoids of 0.5 cells", fine: "sigmoids of 0.1 cells"},
        explanation="Sigmoids average the map across an edge, and lose corners.",
    )
    figure = Figure(figsize=(6.0, 2.8), layout="constrained")
    axes = figure.subplots()
    for program, values in found.items():
        axes.semilogy(
            np.sort(np.abs(values - truth).ravel())[::-1] / np.abs(truth).max() + 1e-17, ".-", ms=3, label=program
        )
    axes.set(xlabel="coordinates of vertices, sorted", ylabel="deviation / largest derivative")
    axes.legend(fontsize="small")
    section.draw("vertices", figure, "Deviations of the derivatives by the coordinates of vertices.", directory)


def compare_squares(section: Section) -> None:
    """Compare sites of 4 x 4 cells with pooling."""
    import deepinv
    import torch

    cells = torch.from_numpy(np.random.default_rng(2).random((8, 1, N_CELLS, N_CELLS)))
    n = N_CELLS // 4
    layout = fs.layout.grid(n, n, 4.0)
    mesh, grid = fs.learn.Mesh(layout), fs.Grid.centred((N_CELLS, N_CELLS), 1.0)
    points = mesh().detach()
    pooling = deepinv.physics.Downsampling(
        img_size=(1, N_CELLS, N_CELLS),
        filter=torch.full((1, 1, 4, 4), 1.0 / 16.0, dtype=torch.float64),
        factor=4,
        padding="valid",
    )
    section.compare(
        f"means over {n * n} squares of 4 × 4 cells, 8 pictures",
        {
            OWN: lambda: fs.learn.site_power(points, cells[:, 0], mesh, grid).numpy().reshape(8, n, n) / 16.0,
            f"{TORCH}, avg_pool2d": lambda: torch.nn.functional.avg_pool2d(cells, 4).numpy()[:, 0],
            f"{DEEPINV}, Downsampling": lambda: pooling.A(cells).numpy()[:, 0],
        },
        cells.numpy().reshape(8, n, 4, n, 4).mean(axis=(2, 4)),
        by="means in NumPy",
        source="construction",
        tolerance=1e-14,
    )


# -- layers ------------------------------------------------------------------------------------------------------------


def camera(defocus_um: float = 0.11) -> fs.Camera:
    """Return a camera with hexagons and an aberrated lens."""
    optics = fs.Optics(
        focal_length_mm=8.0,
        f_number=2.8,
        precision="double",
        oversample=1,
        zernike=fs.optics.Zernike(coefficients={4: defocus_um, 7: 0.055}),
    )
    layout = fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=5.0).rotate(7.0)
    return fs.Camera(optics=optics, sensor=fs.Sensor(layout, read_noise_e=4.0, bits=12, capacitance_f=2e-14))


def scene(basis: np.ndarray) -> fs.Scene:
    """Return a scene of one band, bottom row first."""
    return fs.Scene(
        basis[np.newaxis], np.full((1, 1), 0.01), np.array([550.0]), np.array([40.0]), None, 1.0, fit="cover"
    )


def compare_layers(section: Section) -> None:
    """Compare gradients of a layer with changes of captures, and its adjoint."""
    import torch

    rng = np.random.default_rng(3)
    picture = 0.2 + rng.random(SHAPE)
    original, exposure_s = camera(), 0.02
    layer = fs.learn.SensorLayer(original, scene(picture), exposure_s=exposure_s, output="expected", noise=False)
    weights = rng.standard_normal(layer.n_sites)

    def pixels_by_layer() -> np.ndarray:
        pictures = torch.from_numpy(picture[np.newaxis, np.newaxis, ::-1].copy()).requires_grad_()
        (found,) = torch.autograd.grad((layer(pictures)[0] * torch.from_numpy(weights)).sum(), pictures)
        return found.numpy()[0, 0, ::-1][::3, ::3]

    def charge(basis: np.ndarray, lens: fs.Camera = original) -> float:
        return float(lens.capture(scene(basis), exposure_s=exposure_s, seed=0).expected_e @ weights)

    start = charge(picture)
    truth = np.zeros((8, 8))
    for i, j in np.ndindex(8, 8):
        changed = picture.copy()
        changed[3 * i, 3 * j] += 1.0
        truth[i, j] = charge(changed) - start
    section.compare(
        "derivatives of charges by 64 pixels of a picture, through lens and photosites",
        {OWN: pixels_by_layer},
        truth,
        by="differences of captures of the simulator, which is linear",
        source="construction",
        tolerance=1e-9,
    )
    aberrated = fs.learn.SensorLayer(
        original, scene(picture), ("zernike",), exposure_s=exposure_s, output="expected", noise=False
    )
    coefficients = next(value for name, value in aberrated.named_parameters() if name.endswith("zernike"))
    pictures = torch.from_numpy(picture[np.newaxis, np.newaxis, ::-1].copy())

    def zernike_by_layer() -> float:
        (found,) = torch.autograd.grad((aberrated(pictures)[0] * torch.from_numpy(weights)).sum(), coefficients)
        return float(found[0])

    def difference(step: float) -> float:
        sides = [charge(picture, camera(0.11 + sign * step)) for sign in (1.0, -1.0)]
        return (sides[0] - sides[1]) / (2.0 * step)

    section.compare(
        "derivative of charges by a Zernike coefficient, defocus",
        {OWN: zernike_by_layer},
        (4.0 * difference(1e-4) - difference(2e-4)) / 3.0,
        by="differences of captures, extrapolated to a step of 0",
        source="Richardson, Phil. Trans. R. Soc. A 210, 307 (1911)",
        tolerance=1e-6,
        repeats=1,
    )
    compare_physics(section, layer)


def compare_physics(section: Section, layer: fs.learn.SensorLayer) -> None:
    """Compare a sensor as the physics of deepinv with its own operators, a dense matrix, and its own noise."""
    import deepinv
    import torch

    torch.manual_seed(0)
    physics = fs.learn.physics(
        layer, generator=torch.Generator().manual_seed(1), max_iter=500, tol=1e-10, implicit_backward_solver=False
    )
    size = (1, *SHAPE)
    own_operators = {
        f"{DEEPINV}, BlurFFT": deepinv.physics.BlurFFT(size, deepinv.physics.blur.gaussian_blur(1.5).double()),
        f"{DEEPINV}, Downsampling": deepinv.physics.Downsampling(
            img_size=size, filter=deepinv.physics.blur.gaussian_blur(1.0).double(), factor=2
        ),
    }

    def adjointness(operator: Any) -> float:
        return float(operator.adjointness_test(img_size=size, num_samples=20, dtype=torch.float64))

    section.compare(
        "adjoint of lens and photosites as a physics: |A − Bᵀ|/|A|, by the test of deepinv in double precision",
        {OWN: lambda: adjointness(physics)} | {name: lambda o=o: adjointness(o) for name, o in own_operators.items()},
        0.0,
        by="0",
        source="deepinv, LinearPhysics.adjointness_test",
        tolerance=1e-12,
        deviation=largest_absolute,
        of="relative",
        cannot=dict.fromkeys(own_operators, "an operator of its own on a pixel grid, for comparison"),
    )
    units = torch.eye(math.prod(SHAPE), dtype=torch.float64).reshape(-1, *size)
    matrix = physics.A(units).T.numpy()
    picture = torch.rand(1, *size, dtype=torch.float64)
    readings = physics.A(picture)
    section.compare(
        f"picture of least squares and least norm from {layer.n_sites} readings",
        {OWN: lambda: physics.A_dagger(readings, solver="lsqr").numpy().ravel()},
        np.linalg.pinv(matrix) @ readings.numpy()[0],
        by="pseudoinverse of the dense matrix, in NumPy",
        source="Golub and Van Loan, Matrix Computations (2013)",
        tolerance=1e-6,
        cannot={OWN: f"solver: LSQR of {DEEPINV}"},
        explanation="The default solver of deepinv, CG with a regularisation of 1e-8, stops 6e-4 of the maximum from it.",
        repeats=1,
    )
    n_draws = 2000
    dim = 0.003 * readings
    expected_e = dim[0].numpy() * physics.unit_e
    noise = deepinv.physics.PoissonGaussianNoise(gain=1.0 / physics.unit_e, sigma=4.0 / physics.unit_e)

    def variance_e2(draw: Callable[[Any], Any]) -> np.ndarray:
        return draw(dim.expand(n_draws, -1)).numpy().var(axis=0, ddof=1) * physics.unit_e**2

    section.compare(
        "variance of noisy readings of about 60 electrons, shot and read noise of 4 e-",
        {OWN: lambda: variance_e2(physics.noise), f"{DEEPINV}, PoissonGaussianNoise": lambda: variance_e2(noise)},
        expected_e + 4.0**2,
        by="E + σ²",
        source="Janesick, Photon Transfer (2007)",
        tolerance=4.0,
        deviation=lambda found, truth: float(abs((found / truth).mean() - 1.0) * math.sqrt(0.5 * n_draws * truth.size)),
        of="standard errors",
    )


def validate(section: Section, directory: Path) -> None:
    """Compare integrals, gradients, adjoint and noise."""
    import torch

    torch.set_num_threads(1)  # idle threads would occupy the cores between the small operations of these comparisons
    compare_squares(section)
    compare_vertices(section, directory)
    compare_layers(section)
