"""Detectors in NeXus files: faces, corners of pixels, uniform pixels, units, and what is rejected."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import FileError, GeometryError, LayoutWarning
from foveasim.layout import Layout

h5py = pytest.importorskip("h5py")

#: A square, and a triangle without vertices in common.
VERTICES = np.array([(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (5, 0, 0), (8, 0, 0), (5, 4, 0)], float)
DATASETS = {"vertices": VERTICES, "winding_order": np.arange(7), "faces": np.array([0, 4])}
CORNERS = np.zeros((1, 2, 4, 3))
CORNERS[0, :, :, 1:] = 1e-6 * np.array([[(0, 0), (4, 0), (4, 3), (0, 3)], [(0, 3), (4, 3), (4, 8), (0, 8)]])


def detector(file, name="detector"):
    group = file
    for part, kind in (("entry", "NXentry"), ("instrument", "NXinstrument"), (name, "NXdetector")):
        group = group.require_group(part)
        group.attrs["NX_class"] = kind
    return group


def geometry(path, changes=None, units="mm", name="detector_shape", **more):
    with h5py.File(path, "w") as file:
        part = detector(file).create_group(name)
        part.attrs["NX_class"] = "NXoff_geometry"
        for key, values in {**DATASETS, **(changes or {})}.items():
            part[key] = values
        if units:
            part["vertices"].attrs["units"] = units
        for key, values in more.items():
            detector(file)[key] = values
    return path


def pyfai(path, **datasets):
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            detector(file)[name] = values
    return path


# -- round trips ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".nxs", ".h5"])
def test_layout_round_trips_exactly(tmp_path, suffix):
    layout = fs.layout.fovi(fov_um=9.0, a_um=0.5, n_rings=14)
    layout = layout.with_columns(name=np.array([f"µ{i}" for i in range(layout.n_sites)]), is_dead=layout.area_um2 > 1.0)
    layout.write(tmp_path / f"a{suffix}")
    again = fs.read_layout(tmp_path / f"a{suffix}")

    np.testing.assert_array_equal(again.xy_um, layout.xy_um)
    np.testing.assert_array_equal(again.ring_offsets, layout.ring_offsets)
    assert {n: (c.dtype, c.tolist()) for n, c in again.columns.items()} == {
        n: (c.dtype, c.tolist()) for n, c in layout.columns.items()
    }
    assert again.provenance == layout.provenance


def test_corners_follow_rows_and_columns(tmp_path):
    layout = fs.layout.grid(n_x=3, n_y=2, pitch_um=4.0)
    layout.write(tmp_path / "a.nxs")
    with h5py.File(tmp_path / "a.nxs") as file:
        corners = file["entry/instrument/detector/pixel_corners"][()]

    assert corners.shape == (2, 3, 4, 3)
    np.testing.assert_allclose(corners[..., 0, 2:0:-1].reshape(-1, 2), 1e-6 * layout.xy_um[::4], rtol=1e-6)


def test_holes_cannot_be_written(tmp_path):
    layout, _ = Layout.from_rectangles([[0.0, 0.0], [0.0, 0.0]], [9.0, 3.0]).clean(0.01)
    with pytest.raises(GeometryError, match="site 0 has a hole"):
        layout.write(tmp_path / "a.nxs")


# -- geometries -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("units", "factor"), [("m", 1e6), ("mm", 1e3), ("um", 1.0), ("µm", 1.0), ("micron", 1.0)])
def test_units_of_vertices_are_obeyed(tmp_path, units, factor):
    layout = fs.read_layout(geometry(tmp_path / "a.nxs", units=units))

    np.testing.assert_allclose(layout.area_um2, np.array([4.0, 6.0]) * factor**2)
    with pytest.raises(FileError, match="omit 'unit'"):
        fs.read_layout(tmp_path / "a.nxs", unit="cm")


def test_missing_units_must_be_stated(tmp_path):
    path = geometry(tmp_path / "a.nxs", units="")
    with pytest.raises(FileError, match=r"without the attribute 'units'.*unit='um'"):
        fs.read_layout(path)
    assert fs.read_layout(path, unit="um").area_um2.tolist() == [4.0, 6.0]
    with pytest.raises(FileError, match="unit 'furlong', expected a length"):
        fs.read_layout(geometry(tmp_path / "b.nxs", units="furlong"))


def test_detector_faces_select_and_number(tmp_path):
    path = geometry(tmp_path / "a.nxs", {"detector_faces": [[1, 42]]}, units="um")
    layout = fs.read_layout(path)

    assert layout.area_um2.tolist() == [6.0]
    assert layout.columns["detector_number"].tolist() == [42]


def test_faces_of_one_number_are_one_site(tmp_path):
    vertices = np.array([(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (4, 0, 0), (4, 2, 0)], float)
    faces = {"vertices": vertices, "winding_order": [0, 1, 2, 3, 1, 4, 5, 2], "faces": [0, 4]}
    path = geometry(tmp_path / "a.nxs", {**faces, "detector_faces": [[0, 7], [1, 7]]}, units="um")

    assert fs.read_layout(path).area_um2.tolist() == [8.0]


def test_shape_of_pixel_is_repeated_at_offsets(tmp_path):
    y, x = np.meshgrid([0.0, 5.0], [1.0, 4.0, 7.0], indexing="ij")
    hexagon = np.array([(1, 0, 0), (2, 1, 0), (2, 2, 0), (1, 3, 0), (0, 2, 0), (0, 1, 0)], float)
    shape = {"vertices": hexagon, "winding_order": np.arange(6), "faces": [0]}
    offsets = {"x_pixel_offset": x, "y_pixel_offset": y}
    layout = fs.read_layout(geometry(tmp_path / "a.nxs", shape, "um", "pixel_shape", **offsets))

    assert layout.n_sites == 6
    np.testing.assert_allclose(layout.centroid_um, np.stack((x.ravel() + 1.0, y.ravel() + 1.5), axis=1))


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"vertices": VERTICES + np.arange(7)[:, np.newaxis] * [0, 0, 1.0]}, "at several z, from 0 to 6"),
        ({"winding_order": np.arange(1, 8)}, "vertices that do not exist"),
        ({"faces": np.array([0, 9])}, "vertices that do not exist"),
        ({"faces": np.array([0, 6])}, "fewer than 3 vertices"),
        ({"detector_faces": np.array([[5, 1]])}, "'detector_faces' that are not pairs"),
        ({"curvature": np.zeros(2)}, "curvature, which is not known in NXoff_geometry"),
    ],
)
def test_invalid_geometries_are_named(tmp_path, changes, match):
    with pytest.raises(FileError, match=match):
        fs.read_layout(geometry(tmp_path / "a.nxs", changes))


def test_cylinders_are_named(tmp_path):
    with h5py.File(tmp_path / "a.nxs", "w") as file:
        detector(file).create_group("tubes").attrs["NX_class"] = "NXcylindrical_geometry"
    with pytest.raises(FileError, match="by cylinders"):
        fs.read_layout(tmp_path / "a.nxs")


def test_one_of_several_detectors_is_selected(tmp_path):
    with h5py.File(tmp_path / "a.nxs", "w") as file:
        for name in ("left", "right"):
            part = detector(file, name).create_group("detector_shape")
            part.attrs["NX_class"] = "NXoff_geometry"
            for key, values in DATASETS.items():
                part[key] = values * (2.0 if name == "right" and key == "vertices" else 1)
            part["vertices"].attrs["units"] = "um"
    with pytest.raises(FileError, match=r"several detectors: .*left/detector_shape, .*right"):
        fs.read_layout(tmp_path / "a.nxs")
    assert fs.read_layout(tmp_path / "a.nxs", cell="entry/instrument/right").area_um2.tolist() == [16.0, 24.0]
    with pytest.raises(FileError, match="has no detector 'middle'"):
        fs.read_layout(tmp_path / "a.nxs", cell="middle")


# -- pyFAI ----------------------------------------------------------------------------------------------------------------


def test_corners_are_z_y_x_in_metres(tmp_path):
    layout = fs.read_layout(pyfai(tmp_path / "a.h5", pixel_corners=CORNERS, mask=np.array([[0, 1]])))

    np.testing.assert_allclose(layout.area_um2, [12.0, 20.0])
    np.testing.assert_allclose(layout.bounds_um, (0.0, 0.0, 8.0, 4.0), atol=1e-9)
    assert layout.columns["column"].tolist() == [0, 1]
    assert layout.columns["mask"].tolist() == [False, True]


@pytest.mark.parametrize(("orientation", "corner"), [(1, (4, 2)), (2, (0, 2)), (3, (0, 0)), (4, (4, 0))])
def test_uniform_pixels_follow_orientation(tmp_path, orientation, corner):
    path = pyfai(tmp_path / "a.h5", pixel_size=[2e-6, 2e-6], shape=[2, 3], orientation=orientation)

    np.testing.assert_allclose(fs.read_layout(path)[:1].bounds_um[:2], corner, atol=1e-9)


def test_missing_pixels_are_skipped(tmp_path):
    corners = CORNERS.copy()
    corners[0, 1, 2, 1] = np.nan
    path = pyfai(tmp_path / "a.h5", pixel_corners=corners)
    with pytest.raises(FileError, match="pixel 1 must be one polygon, got none"):
        fs.read_layout(path)
    with pytest.warns(LayoutWarning, match="1 of 2 are skipped"):
        assert fs.read_layout(path, invalid="skip").n_sites == 1


@pytest.mark.parametrize(
    ("datasets", "match"),
    [
        ({"pixel_corners": CORNERS + CORNERS[..., 1:2] * [1, 0, 0]}, "at several z"),
        ({"pixel_corners": CORNERS, "shape": [1, 1]}, "is binned"),
        ({"pixel_corners": CORNERS[0]}, "shape .*expected .slow, fast, corner, 3"),
        ({"pixel_corners": CORNERS, "tilt": 0.1}, "tilt, which is not known in detectors of pyFAI"),
        ({"pixel_size": [1e-6, 1e-6], "shape": [2, 2], "orientation": 9}, "orientation 9"),
        ({"data": np.zeros(3)}, "has no detector"),
    ],
)
def test_invalid_detectors_are_named(tmp_path, datasets, match):
    with pytest.raises(FileError, match=match):
        fs.read_layout(pyfai(tmp_path / "a.h5", **datasets))


def test_links_are_not_followed(tmp_path):
    geometry(tmp_path / "target.nxs")
    with h5py.File(tmp_path / "a.nxs", "w") as file:
        detector(file)["detector_shape"] = h5py.ExternalLink("target.nxs", "/entry/instrument/detector/detector_shape")
    with pytest.raises(FileError, match="has no detector"):
        fs.read_layout(tmp_path / "a.nxs")


def test_changed_bytes_read_or_raise(tmp_path):
    data = geometry(tmp_path / "a.nxs").read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(12):
        changed = np.frombuffer(data, np.uint8).copy()
        changed[rng.integers(0, len(data), 30)] = rng.integers(0, 256, 30)
        (tmp_path / "b.nxs").write_bytes(changed.tobytes())
        with contextlib.suppress(FileError):
            fs.read_layout(tmp_path / "b.nxs")
