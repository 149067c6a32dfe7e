"""Spectra of sampling points: lattice peaks, disordered layouts, and alias frequencies."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.metrics import aliasing_spectrum, polygon_mtf, sampling_spectrum
from foveasim.metrics.aliasing import _point_transform

PITCH_UM = 4.0
SQUARES = fs.layout.grid(n_x=60, n_y=60, pitch_um=PITCH_UM)
HEXAGONS = fs.layout.hexagonal(n_columns=60, n_rows=69, pitch_um=PITCH_UM)


@cache
def blue_noise():
    return fs.layout.voronoi(n_sites=3600, size_um=(240.0, 240.0), seed=1)


def scattered(n=3600, seed=3):
    """Random points."""
    return fs.Layout.from_rectangles(np.random.default_rng(seed).uniform(-120.0, 120.0, (n, 2)), 0.5)


@pytest.mark.parametrize("kind", ["real", "complex"])
def test_nonuniform_fft_matches_direct_sum(kind):
    rng = np.random.default_rng(0)
    xy_um, weight = rng.uniform(-50.0, 50.0, (400, 2)), rng.normal(size=400)
    if kind == "complex":
        weight = weight + 1j * rng.normal(size=400)
    f = 5.0 * np.arange(-30, 31)

    waves = (
        np.exp(-2e-3j * np.pi * np.multiply.outer(f, xy_um[:, 0])),
        np.exp(-2e-3j * np.pi * np.multiply.outer(f, xy_um[:, 1])),
    )
    direct = np.einsum("yn,xn,n->yx", waves[1], waves[0], weight)

    assert np.abs(_point_transform(xy_um, weight, f) - direct).max() <= 2e-7 * np.abs(weight).sum()


def peaks(spectrum, least):
    """Positions of local maxima above a minimum power, (n, 2) as (fx, fy)."""
    power = spectrum.power
    around = np.max([np.roll(power, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    iy, ix = np.nonzero((power == around) & (power >= least))
    return np.stack((spectrum.frequency_per_mm[ix], spectrum.frequency_per_mm[iy]), axis=1)


@pytest.mark.parametrize(
    ("layout", "basis_um"),
    [(SQUARES, [[4.0, 0.0], [0.0, 4.0]]), (HEXAGONS, [[4.0, 0.0], [2.0, 2.0 * np.sqrt(3.0)]])],
    ids=["squares", "hexagons"],
)
def test_lattice_peaks_match_reciprocal_lattice(layout, basis_um):
    spectrum = sampling_spectrum(layout, max_per_mm=560.0)
    n = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2)
    reciprocal = 1e3 * n @ np.linalg.inv(basis_um).transpose()
    reciprocal = reciprocal[np.abs(reciprocal).max(axis=1) < 560.0]
    found = peaks(spectrum, least=0.5 * spectrum.power.max())
    step = spectrum.frequency_per_mm[1] - spectrum.frequency_per_mm[0]
    distance = np.linalg.norm(found[:, None] - reciprocal, axis=2)
    f = spectrum.frequency_per_mm
    from_peaks = np.min([np.hypot(f - x, f[:, None] - y) for x, y in reciprocal], axis=0)

    assert len(found) == len(reciprocal)
    assert distance.min(axis=1).max() <= step
    assert distance.min(axis=0).max() <= step
    assert spectrum.power[from_peaks > spectrum.peak_per_mm].max() < 1e-3 * spectrum.power.max()
    assert spectrum.nyquist_per_mm == pytest.approx(0.5 * np.sort(np.linalg.norm(reciprocal, axis=1))[1])


def test_random_points_have_flat_spectrum():
    spectrum = sampling_spectrum(scattered(), max_per_mm=400.0)
    frequency, power, anisotropy = spectrum.radial(16)
    high = frequency > 2.0 * spectrum.peak_per_mm

    assert power[high] == pytest.approx(np.ones(high.sum()), abs=0.35)
    assert power[high].mean() == pytest.approx(1.0, abs=0.06)
    # The power of random points has an exponential distribution, whose variance is the squared mean.
    assert anisotropy[high].mean() == pytest.approx(1.0, abs=0.15)


def test_blue_noise_spectrum_has_no_peaks():
    spectrum, lattice = sampling_spectrum(blue_noise(), max_per_mm=400.0), sampling_spectrum(SQUARES, max_per_mm=400.0)
    frequency, power, _ = spectrum.radial(40)
    valley = (frequency > 2.0 * spectrum.peak_per_mm) & (frequency < 125.0)
    ring = (frequency > 230.0) & (frequency < 290.0)
    f = spectrum.frequency_per_mm
    away = np.hypot(f, f[:, None]) > 2.0 * spectrum.peak_per_mm

    assert power[valley].max() < 0.03
    assert power[ring].max() > 2.0
    assert spectrum.power[away].max() < 0.1 * spectrum.power.max()
    g = lattice.frequency_per_mm
    assert lattice.power[np.hypot(g, g[:, None]) > 2.0 * lattice.peak_per_mm].max() > 0.95 * lattice.power.max()


def test_lattice_alias_has_full_contrast():
    wave = (170.0, 33.0)
    found = aliasing_spectrum(SQUARES, wave)
    mtf = polygon_mtf(SQUARES[[0]], np.hypot(*wave), angle_deg=np.degrees(np.arctan2(wave[1], wave[0])))[0, 0]

    assert found.baseband_fraction == pytest.approx(mtf, rel=1e-9)
    assert found.alias_fraction == pytest.approx(mtf, rel=1e-3)
    assert found.alias_per_mm == pytest.approx([170.0 - 250.0, 33.0], abs=0.05)
    assert found.noise_fraction == pytest.approx(1.0, abs=0.01)


def test_sine_below_nyquist_has_no_alias():
    for layout in (SQUARES, HEXAGONS):
        found = aliasing_spectrum(layout, (70.0, 40.0))

        assert found.baseband_fraction > 0.8
        assert found.alias_fraction < 0.007
        assert found.noise_fraction < 1e-3


def test_hexagons_resolve_sine_that_squares_alias():
    # 140 line pairs per mm: above 125 for squares (alias at -110), below 144 for hexagons.
    squares, hexagons = (aliasing_spectrum(layout, (140.0, 0.0)) for layout in (SQUARES, HEXAGONS))

    assert squares.alias_fraction == pytest.approx(squares.baseband_fraction, rel=1e-3)
    assert hexagons.alias_fraction < 0.01


def test_blue_noise_converts_alias_to_noise():
    lattice, blue = (aliasing_spectrum(layout, (170.0, 33.0)) for layout in (SQUARES, blue_noise()))

    assert blue.alias_fraction < 0.35 * lattice.alias_fraction
    assert 0.3 < blue.noise_fraction < 0.9


def test_aliasing_is_rotation_invariant():
    found = aliasing_spectrum(HEXAGONS, (215.0, 30.0), centre_um=(0.0, 0.0), radius_um=100.0)
    rotated = aliasing_spectrum(HEXAGONS.rotate(90.0), (-30.0, 215.0), centre_um=(0.0, 0.0), radius_um=100.0)

    assert found.alias_fraction == pytest.approx(found.baseband_fraction, rel=1e-3)
    assert rotated.alias_fraction == pytest.approx(found.alias_fraction, rel=1e-6)
    assert rotated.noise_fraction == pytest.approx(found.noise_fraction, rel=1e-6)


def test_invalid_aliasing_arguments_raise():
    with pytest.raises(ParameterError, match="'radius_um' must enclose at least 16 sites, encloses 4"):
        sampling_spectrum(SQUARES, radius_um=4.0)
    with pytest.raises(ParameterError, match=r"'max_per_mm' must be at most .* reduce radius_um"):
        sampling_spectrum(SQUARES, max_per_mm=1e5)
    with pytest.raises(ParameterError, match="'layout' must have sites in more than one row"):
        sampling_spectrum(fs.layout.grid(n_x=60, n_y=1, pitch_um=4.0), radius_um=100.0)
    with pytest.raises(ParameterError, match="'wave_per_mm' must be two numbers"):
        aliasing_spectrum(SQUARES, (1.0, 2.0, 3.0))
    with pytest.raises(ParameterError, match="'weights' must be one of 'sites', 'area'"):
        sampling_spectrum(SQUARES, weights="none")


def test_lattice_peak_height_matches_window_sums():
    """Closed forms over the disc: the mean of cos² is (1/2 - 2/π²), the mean of its square (3/8 - 2/π²)."""
    spectrum = sampling_spectrum(SQUARES)
    centre = spectrum.frequency_per_mm.size // 2
    window, square = 0.5 - 2.0 / np.pi**2, 3.0 / 8.0 - 2.0 / np.pi**2

    peaks = spectrum.power[centre, centre], spectrum.power[centre, np.abs(spectrum.frequency_per_mm - 250.0).argmin()]

    assert peaks[0] == pytest.approx(spectrum.n_sites * window**2 / square, rel=0.01)
    assert peaks[0] == pytest.approx(0.51 * spectrum.n_sites, rel=0.02)


@pytest.mark.parametrize("n_bins", [0, -1, 2.5, 10_000, None])
def test_invalid_radial_bin_count_raises(n_bins):
    with pytest.raises(ParameterError, match="'n_bins' must be"):
        sampling_spectrum(SQUARES).radial(n_bins)


def test_alias_plot_marks_wave_and_alias():
    # The wave at 1.5 Nyquist folds to -0.5 Nyquist: 187.5 - 250 line pairs per mm.
    ax = aliasing_spectrum(SQUARES, (187.5, 0.0)).plot()
    marks = {line.get_label(): line.get_xydata()[0] for line in ax.lines}

    assert marks["wave"] == pytest.approx([187.5, 0.0])
    assert marks["alias"] == pytest.approx([-62.5, 0.0], abs=0.1)
    (circle,) = ax.patches
    assert circle.radius == pytest.approx(125.0)
    shown = np.asarray(ax.images[0].get_array())
    x0, x1, y0, y1 = ax.images[0].get_extent()
    for x, y in marks.values():
        row, column = int((y1 - y) / (y1 - y0) * shown.shape[0]), int((x - x0) / (x1 - x0) * shown.shape[1])
        assert shown[row, column] > shown.max() - 3.0
