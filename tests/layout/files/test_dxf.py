"""Drawings in DXF: arcs, detection, and the missing library; other tests are in tests/interop."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import FileError
from foveasim.layout.files.dxf import _is_dxf, _with_arcs


@pytest.mark.parametrize(
    ("bulge", "factor"), [(1.0, 0.5 * np.pi), (-1.0, -0.5 * np.pi), (np.tan(np.pi / 8), 0.25 * np.pi - 0.5)]
)
def test_arcs_of_bulges_have_exact_area(bulge, factor):
    # The bulge of a semicircle is 1, that of a quarter circle tan(22.5 degrees).
    radius = 1.0 if abs(bulge) == 1.0 else np.sqrt(2.0)
    points = np.array([(0.0, -1.0, bulge), (0.0, 1.0, 0.0), (-4.0, 1.0, 0.0), (-4.0, -1.0, 0.0)])
    polygon = shapely.Polygon(_with_arcs(points, is_closed=True, tolerance=1e-6))

    assert polygon.area == pytest.approx(8.0 + factor * radius**2, abs=1e-4)


def test_open_polylines_are_no_outlines():
    points = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0)])

    assert _with_arcs(points, is_closed=False, tolerance=1e-3) is None
    assert len(_with_arcs(np.vstack((points, points[:1])), is_closed=False, tolerance=1e-3)) == 3


@pytest.mark.parametrize(
    ("head", "expected"),
    [
        (b"  0\nSECTION\n", True),
        (b"0\r\nSECTION\r\n", True),
        (b"999\ncomment\n  0\nSECTION\n", True),
        (b"AutoCAD Binary DXF\r\n\x1a\x00", True),
        (b"0\nEOF\n", False),
        (b"{}", False),
    ],
)
def test_drawings_are_detected(tmp_path, head, expected):
    assert _is_dxf(tmp_path, head) == expected


def test_missing_ezdxf_gives_command(tmp_path, monkeypatch):
    (tmp_path / "a.dxf").write_text("  0\nSECTION\n  0\nENDSEC\n  0\nEOF\n")
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(FileError, match=r"needs ezdxf.*foveasim\[dxf\]"):
        fs.read_layout(tmp_path / "a.dxf")
