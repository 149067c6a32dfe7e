"""Index maps of the photosite under each pixel: exact on boundaries, without gaps, for all shapes."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.id_map import id_map as slow_id_map
from reference.polygons import POLYGONS

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.layout.model import layout_of
from foveasim.view import SitePixels, id_map, site_at

L = fs.layout
#: Families whose sites fill the plane, with straight and slanted boundaries, and T-junctions.
TILINGS = {
    "grid": L.grid(n_x=7, n_y=5, pitch_um=2.0),
    "bricks": L.grid(n_x=7, n_y=6, pitch_um=2.0, stagger=True),
    "hexagons": L.hexagonal(n_columns=8, n_rows=7, pitch_um=2.0),
    "octagons": L.octagonal(n_x=6, n_y=6, pitch_um=2.0),
    "zones": L.zones(side_um=(8, 16), pitch_um=(1, 2)),
    "quadtree": L.quadtree(np.add.outer(np.arange(16.0), np.arange(16.0)), pitch_um=1.0, limit=20.0, n_levels=3),
    "log-polar": L.log_polar(n_sectors=24, min_size_um=1.0, r_max_um=10.0),
    "Voronoi": L.voronoi(n_sites=60, size_um=(12.0, 12.0)),
    "Penrose": L.penrose(side_um=2.0, size_um=14.0),
}


def rings_of(layout):
    rings = np.split(layout.xy_um, layout.ring_offsets[1:-1])
    return [rings[a:b] for a, b in zip(layout.site_offsets[:-1], layout.site_offsets[1:], strict=True)]


@st.composite
def lattice_sites(draw):
    """Generate sites of one to three rings with integer corners: concave, intersecting themselves and others, with holes."""
    corner = st.tuples(st.integers(-4, 4), st.integers(-4, 4))
    sites = draw(st.lists(st.lists(st.lists(corner, min_size=3, max_size=7), min_size=1, max_size=3), max_size=4))
    rings = [ring for site in sites for ring in site]
    # The constructor would reject them.
    return layout_of(
        np.array([p for ring in rings for p in ring], float).reshape(-1, 2),
        np.cumsum([0, *map(len, rings)]),
        np.cumsum([0, *map(len, sites)]),
    )


@pytest.mark.slow
@given(layout=lattice_sites(), steps=st.sampled_from([1, 2, 4]), n_threads=st.sampled_from([1, 3]))
@settings(max_examples=examples(100))
def test_samples_match_exact_rational_arithmetic(layout, steps, n_threads):
    # Pixel centres at multiples of 1, 1/2 and 1/4.
    n = 10 * steps
    low = -5.0 - 0.5 / steps
    ids = id_map(layout, (n, n), (low, low, low + 10, low + 10), n_threads=n_threads)
    centres = low + (np.arange(n) + 0.5) * (10 / n)

    assert np.array_equal(ids, slow_id_map(rings_of(layout), centres, centres))


@pytest.mark.parametrize("layout", TILINGS.values(), ids=TILINGS)
@pytest.mark.parametrize("n", [16, 61])
def test_tiling_pixels_have_exactly_one_site(layout, n):
    separate = [id_map(layout[[i]], (n, n), layout.bounds_um) >= 0 for i in range(layout.n_sites)]
    together = id_map(layout, (n, n), layout.bounds_um)

    assert np.sum(separate, axis=0).max() == 1
    x_min, y_min, x_max, y_max = layout.bounds_um
    x, y = (low + (np.arange(n) + 0.5) * (high - low) / n for low, high in ((x_min, x_max), (y_min, y_max)))
    inside = shapely.union_all(layout.polygons()).buffer(-1e-9)
    is_inside = shapely.contains(inside, shapely.points(*np.meshgrid(x, y)))
    assert is_inside.mean() > 0.4
    assert together[is_inside].min() >= 0


def test_boundary_centres_belong_right_or_above():
    layout = L.grid(n_x=4, n_y=3, pitch_um=2.0)  # from -4 to 4, from -3 to 3
    ids = id_map(layout, (7, 9), (-4.5, -3.5, 4.5, 3.5))  # integer pixel centres: on corners, edges and site centres

    row, column = np.divmod(np.arange(12), 4)
    for iy, y in enumerate(range(-3, 4)):
        for ix, x in enumerate(range(-4, 5)):
            has = (row == (y + 3) // 2) & (column == (x + 4) // 2)
            assert ids[iy, ix] == (np.flatnonzero(has)[0] if has.any() else -1)


@pytest.mark.parametrize("name", POLYGONS)
def test_pixels_cover_area_of_any_shape(name):
    layout = fs.Layout.from_polygons([POLYGONS[name]])
    x_min, y_min, x_max, y_max = layout.bounds_um
    ids = id_map(layout, (700, 700))
    pixel_um2 = (x_max - x_min) * (y_max - y_min) / 700**2
    length_um = shapely.length(POLYGONS[name])

    # The error is less than one pixel per pixel that the outline crosses.
    pitch_um = max(x_max - x_min, y_max - y_min) / 700
    assert abs((ids == 0).sum() * pixel_um2 - layout.area_um2[0]) <= length_um * pitch_um


def test_interior_centres_match_shapely():
    layout = L.voronoi(n_sites=200, size_um=(20.0, 20.0))
    ids = id_map(layout, (83, 91))
    x_min, y_min, x_max, y_max = layout.bounds_um
    x = x_min + (np.arange(91) + 0.5) * (x_max - x_min) / 91
    y = y_min + (np.arange(83) + 0.5) * (y_max - y_min) / 83
    xs, ys = (a.ravel() for a in np.meshgrid(x, y))
    point, site = shapely.STRtree(layout.polygons()).query(shapely.points(xs, ys), predicate="within")

    assert point.size > 0.99 * ids.size
    assert np.array_equal(ids.ravel()[point], site)


def test_overlapping_sites_show_highest_index():
    boxes = [shapely.box(0, 0, 4, 4), shapely.box(1, 1, 3, 3), shapely.box(2, 0, 6, 4)]
    ids = id_map(fs.Layout.from_polygons(boxes), (4, 6))

    assert ids.tolist() == [[0, 0, 2, 2, 2, 2], [0, 1, 2, 2, 2, 2], [0, 1, 2, 2, 2, 2], [0, 0, 2, 2, 2, 2]]


def test_result_independent_of_threads():
    layout = L.log_polar(n_sectors=60, min_size_um=1.0, r_max_um=40.0, stagger=True)
    one = id_map(layout, (333, 257), n_threads=1)
    pixels = SitePixels.from_layout(layout, (111, 120), n_threads=1)
    rgb = fs.view.site_colours(layout, "area_um2")

    assert all(np.array_equal(id_map(layout, (333, 257), n_threads=n), one) for n in (2, 3, 7))
    assert all(np.array_equal(pixels.picture(rgb, n_threads=n), pixels.picture(rgb, n_threads=1)) for n in (2, 5))


def test_window_matches_part_of_full_map():
    layout = L.octagonal(n_x=16, n_y=16, pitch_um=2.0)
    complete = id_map(layout, (256, 256), (-16, -16, 16, 16))
    window = id_map(layout, (64, 128), (-8, -4, 8, 4))

    assert np.array_equal(window, complete[96:160, 64:192])
    assert np.all(id_map(layout, (5, 5), (100, 100, 110, 110)) == -1)


def test_site_at_matches_enclosing_pixel():
    layout = L.penrose(side_um=2.0, size_um=14.0)
    pixels = SitePixels.from_layout(layout, (40, 50), (-8.0, -6.0, 8.0, 6.0), n_samples=3)
    y, x = np.meshgrid(-6.0 + (np.arange(120) + 0.5) * 0.1, -8.0 + (np.arange(150) + 0.5) * (16 / 150), indexing="ij")
    found = pixels.site_at(x, y)

    assert np.array_equal(found, pixels.ids)
    assert [site_at(layout, x[i, j], y[i, j]) for i, j in ((60, 75), (3, 9), (100, 20))] == [
        pixels.ids[i, j] for i, j in ((60, 75), (3, 9), (100, 20))
    ]
    assert pixels.site_at([-8.1, 8.0, 0.0], [0.0, 0.0, 6.5]).tolist() == [-1, -1, -1]


def to_light(rgb):
    """Return the linear light of sRGB bytes (IEC 61966-2-1)."""
    part = np.asarray(rgb) / 255.0
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def from_light(light):
    """Return sRGB values from 0 to 255, not rounded."""
    return 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def test_pixel_is_mean_of_samples():
    layout = L.voronoi(n_sites=50, size_um=(10.0, 10.0))
    rgb = np.random.default_rng(0).integers(0, 256, (50, 3), dtype=np.uint8)
    one = SitePixels.from_layout(layout, (30, 40), (-6, -6, 6, 6), n_samples=1)
    three = SitePixels.from_layout(layout, (30, 40), (-6, -6, 6, 6), n_samples=3)
    table = np.concatenate((rgb, [[10, 20, 30]]))  # index -1 is the last row
    light = to_light(table)[three.ids].reshape(30, 3, 40, 3, 3)

    assert np.array_equal(one.picture(rgb, background=(10, 20, 30)), table[one.ids])
    assert np.array_equal(one.ids, three.ids[1::3, 1::3])
    assert np.abs(three.picture(rgb, background=(10, 20, 30)) - from_light(light.mean(axis=(1, 3)))).max() <= 0.52

    # Without a background: the mean of the samples in sites, and their fraction.
    is_site = (three.ids >= 0).reshape(30, 3, 40, 3)
    counts = is_site.sum(axis=(1, 3))
    separate = (light * is_site[..., None]).sum(axis=(1, 3)) / np.maximum(counts, 1)[..., None]
    clear = three.picture(rgb, background=None)
    assert np.abs(clear[..., :3] - from_light(separate)).max() <= 0.52
    assert np.abs(clear[..., 3] - 255 * counts / 9).max() <= 0.5


def test_boundaries_drawn_between_sites():
    pixels = SitePixels.from_layout(L.grid(n_x=2, n_y=2, pitch_um=2.0), (6, 6), (-3, -3, 3, 3), n_samples=1)
    drawn = np.all(pixels.picture(np.full((4, 3), 200, np.uint8), boundary=(1, 2, 3)) == (1, 2, 3), axis=-1)

    # Sites at pixels 1 to 2 and 3 to 4: boundaries at the first pixel of each, and at the first pixel after them.
    within = np.arange(6) > 0
    at = np.isin(np.arange(6), (1, 3, 5))
    assert np.array_equal(
        drawn,
        (at[:, None] & (within[None] & (np.arange(6) < 5)[None])) | (at[None] & (within & (np.arange(6) < 5))[:, None]),
    )
    assert np.array_equal(pixels.boundary_fraction(), drawn.astype(float))
    fine = SitePixels.from_layout(L.grid(n_x=2, n_y=2, pitch_um=2.0), (2, 2), (-3, -3, 3, 3), n_samples=3)
    assert np.array_equal(fine.boundary_fraction(), drawn.reshape(2, 3, 2, 3).mean(axis=(1, 3)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda g: id_map(g, (0, 4)), r"'shape\[0\]' must be >= 1"),
        (lambda g: id_map(g, (2**16, 2**16)), "'shape' must (have at most|fit in memory: 3 arrays)"),
        (lambda g: id_map(g, (4, 4), (0, 0, 0, 1)), "'bounds_um' must be"),
        (lambda g: id_map(g, (4, 4), (0, 0, np.nan, 1)), "'bounds_um' must be finite"),
        (lambda g: id_map(g[:0], (4, 4)), "'layout' must have sites unless"),
        (lambda g: SitePixels.from_layout(g, (4, 4), n_samples=0), "'n_samples' must be >= 1"),
        (
            lambda g: SitePixels.from_layout(g, (4, 4)).picture(np.zeros((3, 3), np.uint8)),
            r"'rgb' must be uint8 .* n_site > 3",
        ),
        (lambda g: SitePixels.from_layout(g, (4, 4)).picture(np.zeros((4, 3))), "'rgb' must be uint8"),
    ],
)
def test_invalid_arguments_raise(call, message):
    with pytest.raises(ParameterError, match=message):
        call(L.grid(n_x=2, n_y=2, pitch_um=2.0))


def test_empty_layout_covers_nothing():
    empty = L.grid(n_x=1, n_y=1, pitch_um=1.0)[:0]

    assert np.all(
        SitePixels.from_layout(empty, (3, 3), (0, 0, 1, 1)).picture(np.zeros((0, 3), np.uint8)) == [185, 196, 214]
    )
