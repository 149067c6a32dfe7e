"""Chip files of and for gdsfactory: default files of components are read; cells, layers, numbers and columns survive."""

from __future__ import annotations

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs

gf = other_program("gdsfactory")


@pytest.fixture(autouse=True)
def pdk():
    gf.gpdk.PDK.activate()


@pytest.mark.parametrize("extension", ["gds", "oas"])
def test_default_file_of_component_is_read(tmp_path, extension):
    component = gf.components.circle(radius=10)
    component.write(str(tmp_path / f"circle.{extension}"))
    layout = fs.read_layout(tmp_path / f"circle.{extension}")

    assert layout.provenance["cell"] == component.name
    assert layout.area_um2 == pytest.approx([component.area((1, 0))], rel=1e-12)


def test_array_of_component_is_read(tmp_path):
    top = gf.Component("array")
    top.add_ref(gf.components.rectangle(size=(2, 1), layer=(1, 0)), columns=20, rows=10, column_pitch=5, row_pitch=4)
    layout = fs.read_layout(top.write_gds(tmp_path / "array.gds"))

    assert layout.n_sites == 200
    np.testing.assert_allclose(layout.area_um2, 2.0)


def test_gdsfactory_preserves_cells_and_sites(tmp_path):
    layout = fs.layout.mosaic(fs.layout.grid(n_x=24, n_y=15, pitch_um=2.2), ("RG", "GB"))
    layers = {"photosite": (77, 3), "filter_R": (10, 0), "filter_G": (11, 0), "filter_B": (12, 0), "well": (20, 0)}
    layout.write(tmp_path / "chip.gds", layers=layers)
    component = gf.import_gds(tmp_path / "chip.gds")
    counts = {layer: len(polygons) for layer, polygons in component.get_polygons(by="tuple").items()}
    again = fs.read_layout(component.write_gds(tmp_path / "again.gds"))

    assert component.name == "SENSOR"
    assert len(component.insts) == 4
    assert (counts[77, 3], counts[20, 0], counts[10, 0]) == (360, 360, np.count_nonzero(layout.channel == 0))
    np.testing.assert_array_equal(again.xy_um, np.round(layout.xy_um, 3))
    assert all((again.columns[name] == column).all() for name, column in layout.columns.items())
