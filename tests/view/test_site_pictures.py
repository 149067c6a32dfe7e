"""Pictures of photosites: area-weighted means, colours of the colour map only, no moiré, no data, gaps."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib import colormaps

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.view import colours_of, site_picture, site_pictures
from foveasim.view.site_colours import BACKGROUND, NO_DATA, ColourScale, decode_light, encode_light
from foveasim.view.site_pictures import SiteMeans

#: A chequerboard of the values 0 and 1.
SIDE = 120
FINE = fs.layout.grid(n_x=SIDE, n_y=SIDE, pitch_um=1.0)
CHEQUERED = (np.add.outer(np.arange(SIDE), np.arange(SIDE)).ravel() % 2).astype(np.float64)
VIRIDIS = np.rint(255.0 * colormaps["viridis"](np.arange(256))[:, :3]).astype(int)


def mix(colours, weights):
    """Return the mean of sRGB colours in linear light, by loops over the formula of IEC 61966-2-1."""
    mixed = []
    for c in range(3):
        light = 0.0
        for colour, weight in zip(colours, weights, strict=True):
            part = colour[c] / 255.0
            light += weight * (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4)
        mixed.append(round(255.0 * (12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055)))
    return np.array(mixed)


@pytest.mark.parametrize("n", [7, 13, 40, 59])
def test_fine_chequerboard_has_one_colour(n):
    # Up to 17 sites across a pixel, at every phase. Two pixels across a period give alternating pixels without averaging.
    picture = site_picture(FINE, colours_of(FINE, CHEQUERED), (n, n)).astype(int)
    # A pixel of side s contains at most one site (1 µm²) more of one kind than of the other.
    tolerance = 128 / (SIDE / n) ** 2 + 2

    shown = np.abs(picture.reshape(-1, 1, 3) - VIRIDIS).sum(axis=2).argmin(axis=1)
    assert np.all(picture.reshape(-1, 3) == VIRIDIS[shown])
    assert np.abs(shown - 127.5).max() <= tolerance


def test_pixels_are_exact_means_of_clipped_polygons():
    layout = fs.layout.voronoi(n_sites=60, size_um=(10.0, 8.0), seed=1)
    values = np.random.default_rng(2).uniform(0.0, 5.0, layout.n_sites)
    colours = colours_of(layout, values)
    picture = SiteMeans(layout, (4, 5), (-6.0, -4.0, 4.0, 4.0)).picture(colours)
    polygons = layout.polygons()

    for row in range(4):
        for column in range(5):
            pixel = shapely.box(-6.0 + 2 * column, -4.0 + 2 * row, -4.0 + 2 * column, -2.0 + 2 * row)
            area_um2 = shapely.area(shapely.intersection(polygons, pixel))
            mean = area_um2 @ values / area_um2.sum()
            fraction = (mean - values.min()) / (values.max() - values.min())
            assert np.array_equal(picture[row, column, :3], VIRIDIS[min(255, int(256 * fraction))])
            assert picture[row, column, 3] == pytest.approx(255 * area_um2.sum() / 4.0, abs=0.501)


@pytest.mark.slow
@settings(max_examples=examples(25))
@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9), st.sampled_from(["viridis", "gray"]))
def test_values_have_colours_of_their_map_only(seed, n_y, n_x, colour_map):
    rng = np.random.default_rng(seed)
    layout = fs.layout.voronoi(n_sites=200, size_um=(15.0, 15.0), seed=5)
    colours = colours_of(layout, rng.exponential(1.0, layout.n_sites))
    scale = ColourScale(colours.scale.low, colours.scale.high, colour_map)
    shown = SiteMeans(layout, (n_y, n_x), rng.uniform(-9, 0, 2).tolist() + rng.uniform(1, 9, 2).tolist()).picture(
        fs.view.SiteColours(scale.colours(colours.values), "", colours.values, scale, is_on_scale=True)
    )
    table = np.rint(255.0 * colormaps[colour_map](np.arange(256))[:, :3]).astype(int)
    drawn = shown[shown[..., 3] > 0][:, :3].astype(int)

    assert np.abs(drawn[:, np.newaxis] - table).sum(axis=2).min(axis=1).max(initial=0) == 0


def test_filters_mix_in_linear_light():
    layout = fs.layout.mosaic(FINE, ("RG", "GB"))
    colours = colours_of(layout, "channel")
    picture = site_picture(layout, colours, (10, 10))

    assert np.all(np.abs(picture.astype(int) - mix([rgb for _, rgb in colours.legend], [0.25, 0.5, 0.25])) <= 1)


def test_gaps_show_background_by_area():
    layout = fs.Layout.from_rectangles([[0.25, 0.5], [3.0, 0.5]], [[0.5, 1.0], [2.0, 1.0]])
    picture = site_picture(layout, colours_of(layout, np.array([[1.0, 0, 0], [0, 0, 1.0]])), (1, 2), (0, 0, 4, 1))

    assert np.array_equal(picture[0, 0], mix([(255, 0, 0), BACKGROUND], [0.25, 0.75]))
    assert picture[0, 1].tolist() == [0, 0, 255]


def test_missing_values_mix_by_area():
    layout = fs.layout.grid(n_x=4, n_y=1, pitch_um=1.0)
    picture = site_picture(layout, colours_of(layout, np.array([0.0, np.nan, np.nan, 4.0])), (1, 4), (-2, -0.5, 2, 0.5))
    assert picture[0, 1].tolist() == picture[0, 2].tolist() == list(NO_DATA)
    assert np.array_equal(picture[0, [0, 3]], VIRIDIS[[0, 255]])

    # Half of each pixel without data, the other half with the lowest and the highest value.
    halves = site_picture(layout, colours_of(layout, np.array([0.0, np.nan, np.nan, 4.0])), (1, 2), (-2, -0.5, 2, 0.5))
    for column, colour in ((0, VIRIDIS[0]), (1, VIRIDIS[255])):
        assert np.abs(halves[0, column] - mix([colour, NO_DATA], [0.5, 0.5])).max() <= 1


def test_bands_of_rows_change_nothing(monkeypatch):
    layout = fs.layout.penrose(side_um=2.0, size_um=14.0)
    colours = colours_of(layout, "area_um2")
    complete = SiteMeans(layout, (37, 20)).picture(colours)
    monkeypatch.setattr(site_pictures, "PIXELS_PER_BAND", 150)

    assert np.abs(SiteMeans(layout, (37, 20)).picture(colours).astype(int) - complete).max() <= 1


def test_light_encoding_round_trips_every_byte():
    every = np.arange(256, dtype=np.uint8)

    assert np.array_equal(encode_light(decode_light(every)), every)
    assert decode_light(every[[0, 255]]).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: site_picture(FINE, colours_of(FINE), (0, 4)), r"'shape\[0\]' must be >= 1"),
        (lambda: site_picture(FINE, colours_of(FINE), (4, 4), (1, 0, 0, 1)), "'bounds_um' must be"),
        (lambda: site_picture(FINE, colours_of(FINE[:3]), (4, 4)), "'colours' must have one colour for each of the 14400 sites, got 3"),
        (lambda: site_picture(FINE[:0], colours_of(FINE[:0]), (4, 4)), "'layout' must have sites unless"),
    ],
)  # fmt: skip
def test_invalid_picture_arguments_raise(call, message):
    with pytest.raises(ParameterError, match=message):
        call()
