"""
Which layout reads digits best, and does the learned one become a chip?

New here: networks on photosites (``SiteConv``, ``SitePool``) behind ``SensorLayer``,
vertices that are trained through both, and the accuracy of the layout that is read from
its GDSII file.

Expect: with 1,023 to 1,033 photosites and the same noise, FOVI's layout reads 89.5 ±
0.4 % of the digits, a log-polar one 88.1 ± 0.9 %, and a square grid 70.4 ± 1.8 % (three
seeds, ``--full``). Near the gaze, foveal layouts are better (99 %, the grid 75 %), at
30 to 40 µm the grid (51 %, FOVI 30 %, log-polar 16 %). Vertices learned from the grid
read 79.8 ± 1.6 %; learned from FOVI's layout they do not help (87.5 ± 0.8 %). Written
as GDSII, the learned layouts have no violations, and read as many digits: 79.3 ± 1.7 %
and 87.6 ± 0.9 %.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor, nn
from torch.nn import functional

import foveasim as fs
from foveasim.layout import read_layout
from foveasim.learn import SensorLayer, SiteConv, SitePool, barrier
from foveasim.view import plot_layout, save_figure

#: Pictures of 128 x 128 pixels, 1 µm in the image; radius of all layouts; error of the
#: gaze, and its largest value.
N_PIXELS, RADIUS_UM, GAZE_SD_UM, REACH_UM = 128, 56.0, 15.0, 40.0
#: Pixels of a digit with its margin, and of a fragment of a digit; number of fragments,
#: and radiance of the background.
N_DIGIT, N_FRAGMENT, N_FRAGMENTS, BACKGROUND = 20, 7, 40, 0.1
FONTS = tuple(
    f"DejaVu{family}{style}"
    for family, italic in (
        ("Sans", "Oblique"),
        ("SansMono", "Oblique"),
        ("Serif", "Italic"),
    )
    for style in ("", "-Bold", f"-{italic}", f"-Bold{italic}")
)
FONT_SIZES = (13, 15, 17)
#: Rings of eccentricity in which accuracies are measured.
RINGS_UM = (0.0, 10.0, 20.0, 30.0, 40.0)
#: Number of photosites, exposure time, and noise, equal for all layouts.
N_SITES, EXPOSURE_S, READ_NOISE_E, BITS, FRAMES_PER_S = 1024, 0.01, 5.0, 10, 30.0
#: Rules of the chip, stricter ones of training with a margin for vertices on the
#: database grid of 1 nm, and their weight.
RULES = fs.DesignRules(
    min_size_um=1.0,
    min_width_um=0.6,
    min_angle_deg=30.0,
    angle_limit_deg=26.0,
    max_overlap_um2=0.0,
    max_gap_um2=0.0,
)
STRICT, BARRIER = (
    fs.DesignRules(
        min_size_um=1.01, min_width_um=0.61, min_angle_deg=31.0, angle_limit_deg=26.0
    ),
    3e-4,
)
#: Channels of the network, batch, and learning rates: of the network, and of vertices
#: relative to the smallest photosite.
CHANNELS, N_BATCH, NETWORK_RATE, VERTEX_RATE = (16, 48, 96), 64, 3e-3, 0.016
#: Steps of training between changes of the network to the positions of the photosites.
REFRESH_STEPS = 50
#: Steps that repair violations, without the error.
REPAIR_STEPS = 200
#: Layouts from which vertices are learned.
STARTS = ("square grid", "FOVI")
#: Points of the curve of sizes.
N_GROUPS = 20
#: Arguments of a short version.
QUICK = {"n_steps": 20, "n_test": 50}


@cache
def glyphs() -> tuple[Tensor, Tensor]:
    """
    Return bitmaps (n, N_DIGIT, N_DIGIT) of digits in some fonts and sizes, and their
    labels (n,).
    """
    directory = Path(mpl.get_data_path(), "fonts", "ttf")
    bitmaps = []
    for name in FONTS:
        for size in FONT_SIZES:
            font = ImageFont.truetype(str(directory / f"{name}.ttf"), size)
            for digit in range(10):
                picture = Image.new("L", (N_DIGIT, N_DIGIT))
                at = (N_DIGIT / 2, N_DIGIT / 2)
                ImageDraw.Draw(picture).text(
                    at, str(digit), fill=255, font=font, anchor="mm"
                )
                bitmaps.append(np.asarray(picture, np.float32) / 255.0)
    return torch.from_numpy(np.stack(bitmaps)), torch.arange(10).repeat(
        len(FONTS) * len(FONT_SIZES)
    )


def add_patches(pictures: Tensor, patches: Tensor, row: Tensor, column: Tensor) -> None:
    """
    Add patches (n, m, k, k) to pictures (n, n_y, n_x) at their first rows and columns
    (n, m).
    """
    k = torch.arange(patches.shape[-1])
    start = torch.arange(len(pictures))[:, None] * N_PIXELS**2 + row * N_PIXELS + column
    target = start[..., None, None] + (k[:, None] * N_PIXELS + k)
    pictures.view(-1).scatter_add_(0, target.reshape(-1), patches.reshape(-1))


def eccentricities_um(n: int, random: torch.Generator) -> Tensor:
    """
    Draw the distances of digits from the gaze, (n,) µm: half of a Gaussian
    distribution.
    """
    return (GAZE_SD_UM * torch.randn(n, generator=random)).abs().clamp(max=REACH_UM)


def pictures(r_um: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """
    Return pictures (n, 1, n_y, n_x) of a digit among fragments of others, and labels
    (n,).

    ``r_um`` (n,): distances of the digits from the gaze, in the centre.
    """
    n = len(r_um)
    bitmaps, labels = glyphs()
    found = torch.zeros(n, N_PIXELS, N_PIXELS)
    part = bitmaps.unfold(1, N_FRAGMENT, 1).unfold(2, N_FRAGMENT, 1)[:, 3:-3, 3:-3]
    other = torch.randint(len(labels), (n, N_FRAGMENTS), generator=random)
    at = torch.randint(part.shape[1], (2, n, N_FRAGMENTS), generator=random)
    row, column = torch.randint(
        N_PIXELS - N_FRAGMENT + 1, (2, n, N_FRAGMENTS), generator=random
    )
    add_patches(found, part[other, at[0], at[1]], row, column)

    which = torch.randint(len(labels), (n, 1), generator=random)
    angle = 2.0 * math.pi * torch.rand(n, 1, generator=random)
    corner = 0.5 * (N_PIXELS - N_DIGIT)
    row, column = (
        (corner + r_um[:, None] * part).round().long()
        for part in (angle.sin(), angle.cos())
    )
    k = torch.arange(N_DIGIT)
    found[
        torch.arange(n)[:, None, None],
        row[:, :, None] + k[:, None],
        column[:, :, None] + k,
    ] = 0.0
    add_patches(found, bitmaps[which], row, column)
    return BACKGROUND + (1.0 - BACKGROUND) * found[:, None].clamp(max=1.0), labels[
        which[:, 0]
    ]


def hand_made() -> dict[str, fs.Layout]:
    """Return the layouts by hand, of about N_SITES photosites within the same disc."""
    pitch_um = math.sqrt(math.pi * RADIUS_UM**2 / N_SITES)
    square = fs.layout.grid(int(2.0 * RADIUS_UM / pitch_um) + 3, pitch_um=pitch_um)
    is_inside = np.hypot(*square.centroid_um.T) < RADIUS_UM
    return {
        "square grid": fs.Layout.from_polygons(
            [p for p, k in zip(square.polygons(), is_inside, strict=True) if k]
        ),
        "log-polar": fs.layout.log_polar(
            r_max_um=RADIUS_UM, min_size_um=1.0, n_sites=N_SITES, fovea="rings"
        ),
        # The spacing in the fovea is just above the smallest size.
        "FOVI": fs.layout.fovi(fov_um=108.0, a_um=16.0, n_rings=22),
    }


def size_um(layout: fs.Layout) -> float:
    """Return the size of the smallest photosite."""
    return math.sqrt(layout.area_um2.min())


def sensor_layer(layout: fs.Layout, wrt: Sequence[str] = ()) -> SensorLayer:
    """Return a sensor with shot noise and read noise behind a lens, as a layer."""
    sensor = fs.Sensor(
        layout, read_noise_e=READ_NOISE_E, capacitance_f=5e-15, bits=BITS
    )
    lens = fs.Optics(focal_length_mm=8.0, f_number=2.8, oversample=1)
    white = np.ones((N_PIXELS, N_PIXELS))
    scene = fs.Scene.from_picture(
        white, pitch_um=999.0, distance_m=8.0, luminance_cd_m2=50.0, encoding="linear"
    )
    camera = fs.Camera(optics=lens, sensor=sensor)
    return SensorLayer(camera, scene, wrt=wrt, exposure_s=EXPOSURE_S, output="charge")


def readings(layer: SensorLayer, shown: Tensor, random: torch.Generator) -> Tensor:
    """Return charges with noise (n, n_site) relative to those of white, about 0."""
    white = torch.ones(1, *shown.shape[1:])
    expected_e = layer.expected_e(torch.cat((shown, white)))
    return 3.0 * layer.readout.draw(expected_e[:-1], random) / expected_e[-1] - 0.5


class Reader(nn.Module):
    """
    Convolutions on photosites with pooling, and a linear classifier of the features
    anywhere.
    """

    def __init__(
        self, layout: fs.Layout, groups: Sequence[NDArray[np.int64]] | None = None
    ) -> None:
        super().__init__()
        first = SitePool(layout, None if groups is None else groups[0], reduce="max")
        second = SitePool(
            first.layout, None if groups is None else groups[1], reduce="max"
        )
        self.groups = first.groups, second.groups
        layers: list[nn.Module] = []
        n = 1
        for n_next, pool in zip(CHANNELS, (first, second, None), strict=True):
            layers += [SiteConv(n, n_next, layout), nn.BatchNorm1d(n_next), nn.ReLU()]
            if pool is not None:
                layers.append(pool)
                layout = pool.layout
            n = n_next
        self.features, self.classify = nn.Sequential(*layers), nn.Linear(2 * n, 10)

    def on(self, layout: fs.Layout) -> Reader:
        """
        Return this network, with the same parameters, on photosites that
        have moved.
        """
        moved = Reader(layout, self.groups)
        moved.load_state_dict(self.state_dict(keep_vars=True), assign=True)
        return moved.train(self.training)

    def forward(self, values: Tensor) -> Tensor:
        """Return scores (n, 10) of readings (n, n_site)."""
        found = self.features(values[:, None])
        return self.classify(torch.cat((found.amax(dim=2), found.mean(dim=2)), dim=1))


def fit(reader: Reader, layer: SensorLayer, n_steps: int, seed: int) -> Reader:
    """
    Train a network, and the vertices if they are variables of the layer; return the
    network.

    Vertices move once the network reads: the gradients of an untrained one would
    displace them at random.
    """
    random, is_learned = torch.Generator().manual_seed(seed), bool(layer.model.wrt)
    optimiser = torch.optim.Adam(reader.parameters(), lr=NETWORK_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, NETWORK_RATE, n_steps, cycle_momentum=False
    )
    n_fixed = n_steps // 3 if is_learned else n_steps
    if is_learned:
        mesh = layer.model.mesh
        vertices = torch.optim.Adam(
            [mesh.displacement_um], lr=VERTEX_RATE * size_um(mesh.layout())
        )
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(vertices, n_steps - n_fixed)
    for step in range(n_steps):
        is_moving = step >= n_fixed
        shown, labels = pictures(eccentricities_um(N_BATCH, random), random)
        with torch.set_grad_enabled(is_moving):
            values = readings(layer, shown, random)
        loss = functional.cross_entropy(reader(values), labels)
        if is_moving:
            loss = loss + barrier(mesh(), mesh, STRICT, weight=BARRIER, convex=True)
            vertices.zero_grad()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if is_moving:
            vertices.step()
            decay.step()
            mesh.limit_step()
            if step % REFRESH_STEPS == REFRESH_STEPS - 1:
                reader = reader.on(mesh.layout())
    return reader


def learn_layout(start: fs.Layout, n_steps: int, seed: int) -> fs.Layout:
    """Train vertices and a network together, and repair violations that remain."""
    torch.manual_seed(seed)
    layer = sensor_layer(start, ("vertices",))
    fit(Reader(start), layer, n_steps, seed)
    mesh = layer.model.mesh
    optimiser = torch.optim.Adam(
        [mesh.displacement_um], lr=0.4 * VERTEX_RATE * size_um(start)
    )
    for _ in range(REPAIR_STEPS):
        loss = barrier(mesh(), mesh, STRICT, convex=True)
        if float(loss.detach()) == 0.0:
            break
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        mesh.limit_step()
    return mesh.layout()


@torch.no_grad()
def accuracy_percent(
    reader: Reader, layer: SensorLayer, n_test: int, seed: int
) -> NDArray[np.float64]:
    """
    Measure the percentage of digits read correctly: for the errors of the gaze, and in
    each ring.

    ``n_test``: number of digits in a ring.
    """
    random = torch.Generator().manual_seed(1000 + seed)
    reader.eval()
    distances_um = [eccentricities_um(4 * n_test, random)]
    for low_um, high_um in pairwise(RINGS_UM):
        distances_um.append(
            low_um + (high_um - low_um) * torch.rand(n_test, generator=random)
        )
    found = []
    for r_um in distances_um:
        n_correct = 0
        for part_um in r_um.split(100):
            shown, labels = pictures(part_um, random)
            n_correct += int(
                (reader(readings(layer, shown, random)).argmax(dim=1) == labels).sum()
            )
        found.append(100.0 * n_correct / len(r_um))
    return np.array(found)


def sensor_fraction(layout: fs.Layout) -> float:
    """Measure the part of a training step that is spent in the sensor."""
    reader, layer, random, sensor_s, total_s = (
        Reader(layout),
        sensor_layer(layout),
        torch.Generator(),
        0.0,
        0.0,
    )
    shown, labels = pictures(eccentricities_um(N_BATCH, random), random)
    for _ in range(10):
        start_s = time.perf_counter()
        with torch.no_grad():
            values = readings(layer, shown, random)
        sensor_s += time.perf_counter() - start_s
        functional.cross_entropy(reader(values), labels).backward()
        total_s += time.perf_counter() - start_s
    return sensor_s / total_s


def draw_layouts(layouts: Mapping[str, fs.Layout]) -> Figure:
    """Draw the central part of layouts, and a picture."""
    figure = Figure(figsize=(7.6, 5.4), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    for ax, (name, layout) in zip(axes, layouts.items(), strict=False):
        plot_layout(layout, ax=ax, scale_bar=False)
        ax.set_title(name, fontsize="medium")
    random, half = torch.Generator().manual_seed(5), 0.5 * N_PIXELS
    shown, _ = pictures(torch.tensor([12.0]), random)
    axes[-1].imshow(
        shown[0, 0].numpy(), cmap="gray", vmin=0.0, extent=(-half, half, -half, half)
    )
    axes[-1].set_title("a picture, the gaze in its centre", fontsize="medium")
    for ax in axes:
        ax.set(
            xticks=[], yticks=[], xlabel="", ylabel="", xlim=(-36, 36), ylim=(-36, 36)
        )
    return figure


def draw_accuracies(
    accuracies: Mapping[str, NDArray[np.float64]], layouts: Mapping[str, fs.Layout]
) -> Figure:
    """
    Draw accuracy and size of photosites against eccentricity, with standard deviations
    over the seeds.
    """
    figure = Figure(figsize=(7.6, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    middle_um = 0.5 * np.add(RINGS_UM[1:], RINGS_UM[:-1])
    for (name, found), marker in zip(accuracies.items(), "s^oDv", strict=True):
        mean, sd = found.mean(axis=0)[1:], deviation(found)[1:]
        left.errorbar(
            middle_um,
            mean,
            sd,
            marker=marker,
            markersize=5,
            capsize=2,
            linewidth=1.2,
            label=name,
        )
        # Means of groups of neighbouring eccentricities.
        r_um, sizes = (
            np.hypot(*layouts[name].centroid_um.T),
            np.sqrt(layouts[name].area_um2),
        )
        groups = np.array_split(np.argsort(r_um), N_GROUPS)
        at_um, sizes_um = (
            [part[group].mean() for group in groups] for part in (r_um, sizes)
        )
        right.plot(at_um, sizes_um, marker=marker, markersize=4, linewidth=1.2)
    left.axhline(10.0, color="black", linewidth=1, linestyle=":")
    left.set(
        xlabel="eccentricity of the digit / µm",
        ylabel="accuracy / %  (dotted: chance)",
        ylim=(0, 100),
    )
    right.set(
        xlabel="eccentricity / µm", ylabel="size of a photosite / µm", ylim=(0, None)
    )
    figure.legend(
        *left.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=3,
        frameon=False,
    )
    return figure


def deviation(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the sample standard deviation along the first axis; 0 for one value."""
    return values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1:])


def compare(
    out_dir: Path, n_steps: int, n_test: int, seed: int
) -> dict[str, tuple[fs.Layout, NDArray[np.float64]]]:
    """
    Return all layouts with their accuracies: by hand, learned, and read from the files
    of the learned ones.
    """
    by_hand, results = hand_made(), {}
    learned = {
        f"learned from {name}": learn_layout(by_hand[name], n_steps, seed)
        for name in STARTS
    }
    for name, layout in (by_hand | learned).items():
        torch.manual_seed(seed)
        # A new network for every layout.
        reader = fit(Reader(layout), sensor_layer(layout), n_steps, seed)
        results[name] = (
            layout,
            accuracy_percent(reader, sensor_layer(layout), n_test, seed),
        )
        if name in learned:
            path = out_dir / f"36_{name.replace(' ', '_')}_{seed}.gds"
            layout.write(path)
            chip = read_layout(path)
            found = accuracy_percent(reader.on(chip), sensor_layer(chip), n_test, seed)
            results[f"{name}, from GDSII"] = chip, found
    return results


def main(
    out_dir: Path,
    *,
    n_steps: int = 1000,
    n_test: int = 1000,
    seeds: Sequence[int] = (1,),
) -> None:
    """
    Write two chips per seed and the figures to a directory, and print the
    accuracies.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)

    # %% For each seed: learn layouts from two starts, train a new network on every
    # layout; write and read the chips.
    results = [compare(out_dir, n_steps, n_test, seed) for seed in seeds]
    for result in results:
        for layout, _ in result.values():
            assert layout.check(RULES).ok
    shown = {name: layout for name, (layout, _) in results[0].items()}
    found = {name: np.array([result[name][1] for result in results]) for name in shown}

    # %% Table.
    for name, values in found.items():
        rings = ", ".join(f"{mean:.1f}" for mean in values.mean(axis=0)[1:])
        print(
            f"{name:36} {shown[name].n_sites:,} sites, {values[:, 0].mean():.1f} "
            f"± {deviation(values)[0]:.1f} %, rings {rings}"
        )
    fine = math.pi * RADIUS_UM**2 / float(shown["FOVI"].area_um2.min())
    rate, fine_rate = (
        n * BITS * FRAMES_PER_S * 1e-6 for n in (shown["FOVI"].n_sites, fine)
    )
    print(
        f"{rate:.2f} Mbit/s; a square grid as fine as the fovea of FOVI: "
        f"{fine:,.0f} sites, {fine_rate:.2f} Mbit/s"
    )
    print(f"sensor: {100.0 * sensor_fraction(shown['FOVI']):.0f} % of a training step")

    # %% Figures, without the chips, which agree with the learned layouts.
    kept = {
        name: layout for name, layout in shown.items() if not name.endswith("GDSII")
    }
    save_figure(draw_layouts(kept), out_dir / "36_layouts.png", dpi=140)
    save_figure(
        draw_accuracies({name: found[name] for name in kept}, kept),
        out_dir / "36_accuracies.png",
        dpi=140,
    )

    # %% Checks, weaker after short training.
    for name in STARTS:
        chip, learned = f"learned from {name}, from GDSII", f"learned from {name}"
        np.testing.assert_allclose(
            shown[chip].centroid_um, shown[learned].centroid_um, atol=2e-3
        )
        if n_steps >= 1000:
            np.testing.assert_allclose(
                found[chip][:, 0], found[learned][:, 0], atol=3.0
            )
    if n_steps >= 1000:
        assert found["FOVI"][:, 0].mean() > found["square grid"][:, 0].mean() + 10.0
        assert (
            found["learned from square grid"][:, 0].mean()
            > found["square grid"][:, 0].mean() + 5.0
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out_dir", nargs="?", default=".", type=Path)
    parser.add_argument("--full", action="store_true", help="three seeds")
    arguments = parser.parse_args()
    main(arguments.out_dir, seeds=(1, 2, 3) if arguments.full else (1,))
