"""Layouts from sizes: a field, a number of photosites and a smallest photosite."""

import numpy as np
import pytest

import foveasim as fs
from foveasim.layout import OPTICAL_FORMATS, from_sizes
from foveasim.layout.sizes.sizing import is_rectangular, sizable

FORMAT_UM = OPTICAL_FORMATS["1/3"].size_um
#: Generators whose layouts require a picture, or seconds.
SLOW = {"quadtree", "tiling", "voronoi"}
FAST = [name for name in sizable() if name not in SLOW]


@pytest.mark.parametrize("generator", FAST)
def test_field_and_number_are_as_required(generator):
    layout = from_sizes(generator, size_um=FORMAT_UM, n_sites=1500)
    x0_um, y0_um, x1_um, y1_um = layout.bounds_um

    assert layout.n_sites == pytest.approx(1500, rel=0.08)
    width_um, height_um = FORMAT_UM if is_rectangular(generator) else (3600.0, 3600.0)
    assert x1_um - x0_um <= width_um * (1.0 + 1e-9)
    assert y1_um - y0_um <= height_um * (1.0 + 1e-9)
    assert (x1_um - x0_um) * (y1_um - y0_um) > 0.85 * width_um * height_um


@pytest.mark.parametrize("generator", FAST)
def test_smallest_site_and_number_are_as_required(generator):
    layout = from_sizes(generator, n_sites=1500, min_size_um=7.5)

    assert layout.size_um.min() == pytest.approx(7.5, rel=0.05)
    assert layout.n_sites == pytest.approx(1500, rel=0.08)


def test_squares_have_closed_form():
    """A field of 4.8 × 3.6 mm has 120 × 90 squares of 40 µm."""
    layout = from_sizes("grid", size_um=(4800.0, 3600.0), min_size_um=40.0)

    assert layout.n_sites == 120 * 90
    np.testing.assert_allclose(layout.area_um2, 1600.0, rtol=1e-6)


def test_lengths_follow_one_factor():
    """The same layout at half the size, since all requirements of length are halved."""
    large = from_sizes("zones", size_um=(4000.0, 4000.0), n_sites=2000)
    small = from_sizes("zones", size_um=(2000.0, 2000.0), n_sites=2000)

    assert small.n_sites == large.n_sites
    np.testing.assert_allclose(small.area_um2, 0.25 * large.area_um2, rtol=1e-6)


def test_provenance_reproduces_layout():
    layout = from_sizes("log_polar", size_um=FORMAT_UM, n_sites=1500, fovea="rings")
    again = fs.layout.log_polar(**layout.provenance["parameters"])

    assert layout.provenance["parameters"]["fovea"] == "rings"
    np.testing.assert_array_equal(again.area_um2, layout.area_um2)


def test_installed_generators_have_sizes(monkeypatch):
    monkeypatch.setattr(fs.layout.LAYOUTS, "_objects", dict(fs.layout.LAYOUTS))

    @fs.layout.layout_generator(example={"n_sites": 9, "side_um": 2.0, "gap_um": 0.5})
    def dots(*, n_sites: int, side_um: float, gap_um: float = 0.0) -> fs.Layout:
        xy_um = side_um * np.stack(np.meshgrid(*2 * [np.arange(round(n_sites**0.5))]), axis=-1).reshape(-1, 2)
        return fs.Layout.from_rectangles(xy_um - xy_um.mean(axis=0), side_um - gap_um)

    layout = from_sizes("dots", size_um=(100.0, 80.0), n_sites=64)

    assert layout.n_sites == 64
    np.testing.assert_allclose(layout.size_um, 10.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "not determined; give a format, or the smallest site"),
        ({"n_sites": 100}, "not determined"),
        ({"generator": "spiral"}, "'generator' must be one of"),
        ({"size_um": (0.0, 5.0)}, "'size_um'"),
        ({"size_um": 3.0}, "'size_um' must be"),
        ({"size_um": FORMAT_UM, "pitch_um": 3.0}, "'pitch_um' of grid must be left out: it follows from the sizes"),
        ({"size_um": FORMAT_UM, "n_x": 3}, "'n_x' of grid must be left out"),
        ({"size_um": FORMAT_UM, "stager": True}, "did you mean 'stagger'?"),
        (
            {"size_um": FORMAT_UM, "n_sites": 3000, "min_size_um": 40.0},
            "cannot have 3,000 photosites of 40 µm: possible are 10,800 of 40 µm, or 2,961 of 76.2 µm",
        ),
        (
            {"generator": "log_polar", "size_um": FORMAT_UM, "n_sites": 2500, "min_size_um": 60.0},
            "cannot have 2,500 photosites of 60 µm: possible are",
        ),
    ],
)
def test_contradicting_sizes_are_explained(given, message):
    with pytest.raises(fs.FoveasimError) as caught:
        from_sizes(**{"generator": "grid", **given})
    assert message in str(caught.value)
