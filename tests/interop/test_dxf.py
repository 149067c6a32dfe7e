"""Drawings of ezdxf as layouts: curves, holes, blocks, units, layers, and entities that are no outlines."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs
from foveasim.errors import FileError, LayoutWarning

ezdxf = other_program("ezdxf")


def drawing(unit=13, version="R2010"):
    found = ezdxf.new(version)
    found.header["$INSUNITS"] = unit
    return found, found.modelspace()


def saved(document, tmp_path, name="a.dxf", **options):
    document.saveas(tmp_path / name, **options)
    return tmp_path / name


# -- outlines -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["R12", "R2000", "R2018"])
@pytest.mark.parametrize("fmt", ["asc", "bin"])
def test_polylines_and_bulges_have_exact_area(tmp_path, version, fmt):
    document, model = drawing(version=version)
    if version == "R12":
        model.add_polyline2d([(0, 0), (2, 0), (2, 2), (0, 2)], close=True)
        model.add_polyline2d([(5, 0, 0, 0, 1), (7, 0, 0, 0, 1)], format="xyseb", close=True)
    else:
        model.add_lwpolyline([(0, 0), (2, 0), (2, 2), (0, 2)], close=True)
        model.add_lwpolyline([(5, 0, 0, 0, 1), (7, 0, 0, 0, 1)], close=True)
    layout = fs.read_layout(saved(document, tmp_path, fmt=fmt), unit="um")

    assert layout.area_um2[0] == 4.0
    assert layout.area_um2[1] == pytest.approx(np.pi, rel=2e-3)
    assert layout.bounds_um == pytest.approx((0.0, -1.0, 7.0, 2.0), abs=1e-3)


@pytest.mark.parametrize("sagitta_um", [0.1, 0.001, 0.0001])
def test_chords_stay_within_sagitta(tmp_path, sagitta_um):
    document, model = drawing()
    model.add_circle((0, 0), 10.0)
    model.add_lwpolyline([(30, 0, 0, 0, 0.5), (50, 0, 0, 0, 0.0), (50, 9, 0, 0, 0)], close=True)
    circle, arc = fs.read_layout(saved(document, tmp_path), max_sagitta_um=sagitta_um).polygons()
    radius = 20.0 * 1.25 / 2.0
    centre = np.array([40.0, 20.0 / 2.0 * 0.75])
    chord = np.array(arc.exterior.coords)
    along = [(a + b) / 2 for a, b in itertools.pairwise(chord[:-2])]

    middle = np.array(circle.exterior.coords)
    assert np.hypot(*((middle[1:] + middle[:-1]) / 2).T).min() >= 10.0 - sagitta_um * 1.001
    assert np.hypot(*(np.array(along) - centre).T) == pytest.approx(radius, abs=sagitta_um * 1.001)


def test_ellipse_spline_solid_and_face(tmp_path):
    document, model = drawing()
    model.add_ellipse((0, 0), (4, 0), 0.5)
    model.add_solid([(10, 0), (12, 0), (10, 2), (12, 2)])
    model.add_3dface([(20, 0), (23, 0), (23, 3), (20, 3)])
    model.add_spline([(30, 0), (34, 0), (34, 4), (30, 4), (30, 0)])
    areas = fs.read_layout(saved(document, tmp_path)).area_um2

    assert areas[:3] == pytest.approx([8.0 * np.pi, 4.0, 9.0], rel=1e-3)
    assert 12.0 < areas[3] < 30.0


def test_hatch_has_holes_and_edges(tmp_path):
    document, model = drawing()
    hatch = model.add_hatch()
    hatch.paths.add_polyline_path([(0, 0), (8, 0), (8, 8), (0, 8)], is_closed=True)
    hatch.paths.add_polyline_path([(2, 2), (4, 2), (4, 4), (2, 4)], is_closed=True, flags=16)
    edges = model.add_hatch().paths.add_edge_path()
    edges.add_line((20, 0), (22, 0))
    edges.add_arc((20, 0), 2.0, 0.0, 90.0)
    edges.add_line((20, 2), (20, 0))
    layout = fs.read_layout(saved(document, tmp_path))

    assert layout.area_um2 == pytest.approx([60.0, np.pi], rel=1e-3)
    assert np.diff(layout.site_offsets).tolist() == [2, 1]


# -- blocks -------------------------------------------------------------------------------------------------------------


def test_blocks_are_repeated_and_mirrored(tmp_path):
    document, model = drawing()
    pixel = document.blocks.new("PIXEL", base_point=(1, 0))
    pixel.add_lwpolyline([(1, 0), (3, 0), (1, 1)], close=True)
    quad = document.blocks.new("QUAD")
    quad.add_blockref("PIXEL", (0, 0), {"row_count": 2, "column_count": 3, "row_spacing": 5, "column_spacing": 4})
    model.add_blockref("QUAD", (100, 0), {"xscale": -2, "yscale": 2, "rotation": 90})
    layout = fs.read_layout(saved(document, tmp_path))
    # KLayout 0.30 has the same corners; ezdxf does not scale the steps of arrays within scaled blocks.
    corners = [(x, y) for y in (-4.0, -12.0, -20.0) for x in (88.0, 98.0)]

    np.testing.assert_allclose(layout.area_um2, 6 * [4.0])
    assert sorted(map(tuple, layout.site_bounds_um[:, :2].round(6).tolist())) == sorted(corners)


def test_layer_zero_is_that_of_reference(tmp_path):
    document, model = drawing()
    document.blocks.new("P").add_lwpolyline([(0, 0), (2, 0), (0, 2)], close=True)
    model.add_blockref("P", (0, 0), {"layer": "RED"})
    model.add_blockref("P", (9, 0), {"layer": "BLUE"})
    path = saved(document, tmp_path)
    with pytest.raises(FileError, match="outlines on 2 layers: 'BLUE', 'RED'; select with layer="):
        fs.read_layout(path)

    assert fs.read_layout(path, layer="red").columns["layer"].tolist() == ["RED"]
    assert fs.read_layout(path, layer=["RED", "BLUE"]).n_sites == 2
    with pytest.raises(FileError, match="no outlines on the layer 'GREEN'"):
        fs.read_layout(path, layer="GREEN")


def test_recursive_blocks_end_with_an_error(tmp_path):
    document, model = drawing()
    block = document.blocks.new("A")
    block.add_blockref("A", (1, 1), {"column_count": 2, "column_spacing": 3})
    block.add_lwpolyline([(0, 0), (2, 0), (0, 2)], close=True)
    model.add_blockref("A", (0, 0))
    with pytest.raises(FileError):
        fs.read_layout(saved(document, tmp_path))


# -- units and what is rejected -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "factor"), [(1, 25400.0), (4, 1e3), (6, 1e6), (9, 25.4), (12, 1e-3), (13, 1.0)])
def test_unit_of_drawing_is_obeyed(tmp_path, number, factor):
    document, model = drawing(number)
    model.add_lwpolyline([(0, 0), (2, 0), (0, 2)], close=True)
    path = saved(document, tmp_path)

    if number != 9:  # without a factor in ezdxf
        assert ezdxf.units.conversion_factor(number, 13) == pytest.approx(factor)
    np.testing.assert_allclose(fs.read_layout(path).area_um2, 2.0 * factor**2)
    with pytest.raises(FileError, match="omit 'unit'"):
        fs.read_layout(path, unit="cm")


def test_unitless_drawing_requires_unit(tmp_path):
    document, model = drawing(0)
    model.add_lwpolyline([(0, 0), (2, 0), (0, 2)], close=True)
    path = saved(document, tmp_path)
    with pytest.raises(FileError, match=r"is unitless .*unit='um'"):
        fs.read_layout(path)
    assert fs.read_layout(path, unit="mm").area_um2.tolist() == [2e6]


def test_missing_unit_is_no_metre(tmp_path):
    document, model = drawing()
    model.add_lwpolyline([(0, 0), (2, 0), (0, 2)], close=True)
    path = saved(document, tmp_path)
    path.write_text(path.read_text().replace("$INSUNITS", "$INSBASE2"))
    with pytest.raises(FileError, match=r"is unitless|ignores"):
        fs.read_layout(path)


@pytest.mark.parametrize(
    ("add", "named"),
    [
        (lambda m: m.add_line((0, 0), (1, 1)), "1 LINE"),
        (lambda m: m.add_arc((0, 0), 1, 0, 90), "1 ARC"),
        (lambda m: m.add_lwpolyline([(0, 0), (1, 0), (1, 1)]), r"1 LWPOLYLINE \(open or wide\)"),
        (
            lambda m: m.add_lwpolyline([(0, 0), (1, 0), (1, 1)], close=True, dxfattribs={"const_width": 0.2}),
            "open or wide",
        ),
        (lambda m: m.add_mline([(0, 0), (3, 0), (3, 3)]), "1 MLINE"),
        (lambda m: m.add_polyface(), r"1 POLYLINE \(open or wide\)"),
    ],
)
def test_other_entities_are_named(tmp_path, add, named):
    document, model = drawing()
    model.add_text("a label is irrelevant")
    model.add_circle((9, 9), 2.0)
    add(model)
    path = saved(document, tmp_path)
    with pytest.raises(FileError, match=f"no closed outlines: {named}" if named[0] == "1" else named):
        fs.read_layout(path)
    with pytest.warns(LayoutWarning, match="are skipped"):
        assert fs.read_layout(path, invalid="skip").n_sites == 1


def test_several_heights_are_named(tmp_path):
    document, model = drawing()
    model.add_lwpolyline([(0, 0), (2, 0), (0, 2)], close=True)
    model.add_lwpolyline([(5, 0), (7, 0), (5, 2)], close=True, dxfattribs={"elevation": 3.0})
    with pytest.raises(FileError, match="at several z, from 0 to 3"):
        fs.read_layout(saved(document, tmp_path))


def test_outlines_match_klayout(tmp_path):
    db = other_program("klayout.db")
    document, model = drawing()
    pixel = document.blocks.new("P")
    pixel.add_lwpolyline([(0, 0), (3, 0), (3, 1), (1, 2)], close=True)
    model.add_blockref(
        "P", (0, 0), {"row_count": 3, "column_count": 4, "row_spacing": 5, "column_spacing": 6, "rotation": 30}
    )
    path = saved(document, tmp_path)
    shapes = db.Layout()
    shapes.read(str(path))
    region = db.Region(
        shapes.top_cell().begin_shapes_rec(
            shapes.layer(0, 0) if not shapes.layer_indexes() else shapes.layer_indexes()[0]
        )
    )
    layout = fs.read_layout(path)

    assert region.count() == layout.n_sites == 12
    assert region.area() * shapes.dbu**2 == pytest.approx(layout.area_um2.sum(), rel=1e-3)


def test_ignored_content_is_named(tmp_path):
    document, model = drawing()
    document.blocks.new("P").add_lwpolyline([(0, 0), (2, 0), (0, 2)], close=True)
    model.add_blockref("P", (0, 0))
    model.add_circle((9, 0), 2.0)
    path = saved(document, tmp_path)
    path.write_text(path.read_text().replace("ENDBLK", "ENDBLX"))
    with pytest.raises(FileError, match="has content that ezdxf ignores"):
        fs.read_layout(path)


def test_changed_text_reads_or_raises(tmp_path):
    document, model = drawing()
    model.add_circle((0, 0), 5.0)
    model.add_blockref(document.blocks.new("B").name, (1, 1))
    model.add_lwpolyline([(20, 0), (22, 0), (20, 2)], close=True)
    lines = saved(document, tmp_path).read_text().split("\n")
    rng = np.random.default_rng(0)
    for _ in range(150):
        changed = list(lines)
        for at in rng.integers(max(len(lines) - 400, 0), len(lines), 4):
            changed[at] = ["", "0", "-1", "1e308", "nan", "LINE", "x" * 50][rng.integers(7)]
        (tmp_path / "b.dxf").write_text("\n".join(changed))
        try:
            fs.read_layout(tmp_path / "b.dxf", unit=None, invalid="skip")
        except FileError:
            continue
        except Warning:
            continue


def test_format_passes_check_of_extensions():
    fs.testing.check_extension("layout format", "dxf")
