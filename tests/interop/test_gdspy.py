"""GDSII files of gdspy: polygons, paths of all ends, arrays and references have the area that gdspy computes."""

from __future__ import annotations

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs
from foveasim.errors import FileError

gdspy = other_program("gdspy")


@pytest.fixture
def library():
    gdspy.current_library = gdspy.GdsLibrary()
    return gdspy.GdsLibrary()


def test_shapes_have_area_of_gdspy(library, tmp_path):
    pixel = library.new_cell("PIXEL")
    pixel.add(gdspy.Rectangle((0, 0), (2, 1), layer=1))
    pixel.add(gdspy.Round((10, 0), 1.5, tolerance=1e-3, layer=1))
    for k, ends in enumerate(("flush", "extended", (0.3, 0.1))):
        pixel.add(gdspy.FlexPath([(0, 5 + 3 * k), (4, 5 + 3 * k)], 0.5, ends=ends, gdsii_path=True, layer=1))
    top = library.new_cell("TOP")
    top.add(gdspy.CellArray(pixel, 3, 2, (40, 50), (7, 9), rotation=90, magnification=2, x_reflection=True))
    top.add(gdspy.CellReference(pixel, (-100, 0), rotation=30))
    library.write_gds(str(tmp_path / "a.gds"))
    layout = fs.read_layout(tmp_path / "a.gds")
    expected_um2 = sum(abs(gdspy.Polygon(p).area()) for p in top.get_polygons())

    assert layout.n_sites == 5 * 7
    assert layout.area_um2.sum() == pytest.approx(expected_um2, rel=1e-4)


def test_round_ends_have_area_of_disc(library, tmp_path):
    top = library.new_cell("TOP")
    top.add(gdspy.FlexPath([(0, 0), (4, 0)], 1.0, ends="round", gdsii_path=True, layer=1))
    library.write_gds(str(tmp_path / "a.gds"))

    assert fs.read_layout(tmp_path / "a.gds").area_um2 == pytest.approx(4.0 + np.pi / 4.0, rel=1e-9)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # gdspy leaves the file open
def test_repeated_names_are_reported(library, tmp_path):
    cell = library.new_cell("AAAA").add(gdspy.Rectangle((0, 0), (1, 1)))
    library.new_cell("BBBB").add([gdspy.Rectangle((0, 0), (2, 2)), gdspy.CellReference(cell)])
    library.write_gds(str(tmp_path / "a.gds"))
    data = (tmp_path / "a.gds").read_bytes()
    (tmp_path / "a.gds").write_bytes(data.replace(b"\6\6BBBB", b"\6\6AAAA"))
    with pytest.raises(ValueError, match="AAAA"):
        gdspy.GdsLibrary(infile=str(tmp_path / "a.gds"))
    with pytest.raises(FileError, match=r"has several cells 'AAAA', at byte .* and byte"):
        fs.read_layout(tmp_path / "a.gds")
