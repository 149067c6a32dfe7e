"""Sizes of optical formats: the rule of camera tubes for their diagonals, and fields of layouts."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs
from foveasim.layout import OPTICAL_FORMATS


def inches(name):
    numerator, _, denominator = name.partition("/")
    return float(numerator) / float(denominator or 1.0)


@pytest.mark.parametrize("name", OPTICAL_FORMATS)
def test_diagonals_are_those_of_camera_tubes(name):
    """16 mm per inch from 1/2 inch and 18 mm per inch below; 2/3 inch has 11 mm instead of 10.7 mm."""
    width_um, height_um = OPTICAL_FORMATS[name].size_um
    rule_mm = (16.0 if inches(name) >= 0.5 else 18.0) * inches(name)

    assert 1e-3 * np.hypot(width_um, height_um) == pytest.approx(rule_mm, rel=0.035)
    assert width_um / height_um == pytest.approx(4.0 / 3.0, rel=0.02)
    assert OPTICAL_FORMATS[name].title == f"{name} inch"


def test_formats_are_fields_of_generators():
    layout = fs.layout.voronoi(n_sites=50, size_um=OPTICAL_FORMATS["1/2.3"].size_um)

    assert layout.bounds_um == pytest.approx((-3085.0, -2275.0, 3085.0, 2275.0))
