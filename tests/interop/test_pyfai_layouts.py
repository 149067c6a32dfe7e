"""Detectors of pyFAI as layouts, and layouts as detectors of pyFAI."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from other_programs import other_program

import foveasim as fs

detectors = other_program("pyFAI.detectors")


def corners_um(detector):
    """Return the corners (n, corner, 2) of the pixels as x and y."""
    corners = np.asarray(detector.get_pixel_corners(), np.float64)
    return 1e6 * corners.reshape(-1, corners.shape[2], 3)[..., 2:0:-1]


@pytest.mark.parametrize("name", ["Pixirad1", "imxpad_s70", "Xpad_flat"])
def test_irregular_detectors_are_layouts(tmp_path, name):
    detector = detectors.detector_factory(name)
    detector.save(str(tmp_path / "a.h5"))
    layout = fs.read_layout(tmp_path / "a.h5")
    expected = corners_um(detector)

    assert layout.n_sites == expected.shape[0]
    np.testing.assert_allclose(layout.area_um2, shapely.area(shapely.polygons(expected)), rtol=1e-5)
    np.testing.assert_allclose(layout.site_bounds_um[:, :2], expected.min(axis=1), atol=1e-6)


@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
def test_uniform_detectors_follow_orientation(tmp_path, orientation):
    detector = detectors.Detector(1e-4, 2e-4, max_shape=(3, 5), orientation=orientation)
    detector.save(str(tmp_path / "a.h5"))
    layout = fs.read_layout(tmp_path / "a.h5")

    np.testing.assert_allclose(layout.site_bounds_um[:, 2:], corners_um(detector).max(axis=1), rtol=1e-5)


@pytest.mark.parametrize(
    "layout",
    [fs.layout.hexagonal(n_columns=6, n_rows=5, pitch_um=30.0), fs.layout.grid(n_x=4, n_y=3, pitch_um=10.0)],
    ids=["hexagons", "squares"],
)
def test_pyfai_reads_layout(tmp_path, layout):
    layout.write(tmp_path / "a.nxs")
    detector = detectors.NexusDetector(str(tmp_path / "a.nxs"))
    y, x, _ = detector.calc_cartesian_positions()
    row, column = layout.columns["row"], layout.columns["column"]

    np.testing.assert_allclose(
        corners_um(detector).mean(axis=1)[row * x.shape[1] + column], layout.centroid_um, atol=1e-4
    )
    if detector.CORNERS == 4:  # pyFAI takes the mean of the first four corners as centre
        np.testing.assert_allclose(1e6 * np.stack((x, y), axis=-1)[row, column], layout.centroid_um, atol=1e-3)


def test_pyfai_reads_irregular_layout(tmp_path):
    layout = fs.layout.log_polar(n_sectors=24, r_min_um=100.0, r_max_um=800.0, n_rings=8)
    layout.write(tmp_path / "a.nxs")
    detector = detectors.NexusDetector(str(tmp_path / "a.nxs"))

    assert detector.shape == (1, layout.n_sites)
    np.testing.assert_allclose(shapely.area(shapely.polygons(corners_um(detector))), layout.area_um2, rtol=1e-4)
