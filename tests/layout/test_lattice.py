"""Lattices of rectangles: vertices on demand, equal to stored vertices."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import GeometryError
from foveasim.layout.lattice import RectangleLattice

X_UM, Y_UM = [[-4.0, -1.5], [-1.0, 0.5], [1.0, 3.0]], [[-2.0, 0.0], [0.25, 1.0]]


def lattice_layout():
    return fs.Layout.from_lattice(RectangleLattice(X_UM, Y_UM), {"row": [0, 0, 0, 1, 1, 1]})


def stored_layout():
    """Return the same sites with stored vertices."""
    rings = [[(x0, y0), (x1, y0), (x1, y1), (x0, y1)] for y0, y1 in Y_UM for x0, x1 in X_UM]
    return fs.Layout(np.reshape(rings, (-1, 2)), 4 * np.arange(7), np.arange(7), {"row": [0, 0, 0, 1, 1, 1]})


def has_vertices(layout):
    return "xy_um" in vars(layout)


@pytest.mark.parametrize(
    "name",
    ["xy_um", "ring_offsets", "site_offsets", "area_um2", "centroid_um", "site_bounds_um", "bounds_um", "n_sites"],
)
def test_lattice_equals_stored_vertices(name):
    np.testing.assert_array_equal(getattr(lattice_layout(), name), getattr(stored_layout(), name))


@pytest.mark.parametrize(
    "change",
    [
        lambda layout: layout.translate(0.1, -3.3),
        lambda layout: layout.scale(1.7, (0.3, 0.4)),
        lambda layout: layout.rotate(90.0),
        lambda layout: layout[[4, 1]],
        lambda layout: layout[3:],
        lambda layout: layout[2:5],
        lambda layout: layout[3:3],
        lambda layout: layout.sort_by("row", descending=True),
        lambda layout: pickle.loads(pickle.dumps(layout)),
        lambda layout: layout.with_columns(channel=np.arange(6)),
    ],
    ids=["translate", "scale", "rotate", "select", "row", "range", "none", "sort", "pickle", "columns"],
)
def test_changed_lattice_equals_changed_vertices(change):
    one, other = change(lattice_layout()), change(stored_layout())

    for name in ("xy_um", "ring_offsets", "site_offsets"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-15)
    assert one.columns.keys() == other.columns.keys()
    assert one.provenance == other.provenance


def test_vertices_are_computed_when_read():
    layout = fs.layout.mosaic(fs.layout.grid(40, 30, 2.0), "bayer").translate(1.0, 2.0)
    _ = layout.area_um2, layout.centroid_um, layout.bounds_um, layout.n_sites, repr(layout)
    assert not has_vertices(layout)

    assert layout.xy_um.shape == (4800, 2)
    assert has_vertices(layout)
    assert layout.xy_um is layout.xy_um
    assert not layout.xy_um.flags.writeable


def test_complete_rows_remain_a_lattice():
    layout = lattice_layout()

    assert all(layout[rows].lattice is not None for rows in (slice(3), slice(3, 6), slice(None)))
    assert all(layout[others].lattice is None for others in (slice(1, 4), slice(0), [0, 1, 2]))


def test_capture_of_grid_needs_no_vertices():
    layout = fs.layout.mosaic(fs.layout.grid(40, 30, 2.0), "bayer")
    sensor = fs.Sensor(layout, filters="rgb", read_noise_e=2.0)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=sensor)
    scene = fs.Scene.flat(
        shape=(80, 100),
        pitch_um=40.0,
        distance_m=0.5,
        radiance_w_m2_sr_nm=0.1,
        band_width_nm=10.0,
        wavelength_nm=[550.0],
    )
    camera.capture(scene, exposure_s=0.01, seed=0)

    assert not has_vertices(layout)


def test_blocks_of_vertices_join_to_all():
    lattice = RectangleLattice(X_UM, Y_UM)
    xy_um, ring_offsets, site_offsets = lattice.rings()
    blocks = [lattice.rings(first, min(first + 4, 6)) for first in (0, 4)]

    np.testing.assert_array_equal(np.concatenate([block[0] for block in blocks]), xy_um)
    np.testing.assert_array_equal(blocks[1][1], ring_offsets[:3])
    np.testing.assert_array_equal(blocks[1][2], site_offsets[:3])


def test_far_lattices_are_rejected():
    with pytest.raises(GeometryError, match="must lie within"):
        fs.Layout.from_lattice(RectangleLattice([[0.0, 1e30]], [[0.0, 1.0]]))


def test_missing_attributes_raise_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = lattice_layout().nonsense


def test_large_grids_have_few_bytes_per_site():
    layout = fs.layout.mosaic(fs.layout.grid(500, 400, 2.0), "bayer")
    columns = {id(column): column.nbytes for column in layout.columns.values()}

    assert sum(columns.values()) <= 12 * layout.n_sites
    # Products of an index and the number of columns of the largest layouts do not overflow.
    assert layout.columns["row"].dtype.itemsize >= 4
