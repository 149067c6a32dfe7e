"""Chip files in gdsfactory: cells, layers, numbers and columns survive."""

from __future__ import annotations

import numpy as np
from other_programs import other_program

import foveasim as fs

gf = other_program("gdsfactory")


def test_gdsfactory_preserves_cells_and_sites(tmp_path):
    gf.gpdk.PDK.activate()
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
