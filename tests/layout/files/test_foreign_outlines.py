"""GeoJSON and GeoParquet files of other programs: units, parts, missing outlines, columns."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import FileError, LayoutWarning, ParameterError
from foveasim.layout.files import read_layout, write_layout

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

SQUARES = [shapely.box(0, 0, 2, 2), shapely.box(3, 0, 5, 2)]
TWO_PARTS = shapely.MultiPolygon([shapely.box(10, 0, 11, 1), shapely.box(10, 3, 12, 5)])


def geojson(path, geometries, members=None, properties=None):
    features = [
        {"type": "Feature", "properties": p, "geometry": None if g is None else json.loads(shapely.to_geojson(g))}
        for g, p in zip(geometries, properties or [{}] * len(geometries), strict=True)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features, **(members or {})}))
    return path


def parquet(path, geometries, column=None, geo=None, columns=None):
    about = {"encoding": "WKB", "geometry_types": [], **(column or {})}
    metadata = {"version": "1.1.0", "primary_column": "shape", "columns": {"shape": about}, **(geo or {})}
    wkb = [None if g is None else shapely.to_wkb(g) for g in geometries]
    table = pa.table({"shape": pa.array(wkb, pa.binary()), **(columns or {})})
    pq.write_table(table.replace_schema_metadata({"geo": json.dumps(metadata)}), path)
    return path


WRITERS = {"geojson": geojson, "parquet": lambda path, geometries: parquet(path, geometries, {"crs": None})}


# -- units --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("members", "match"),
    [
        ({}, "degrees of longitude and latitude"),
        ({"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}}, "EPSG::25832"),
        ({"coordRefSys": "http://www.opengis.net/def/crs/EPSG/0/25832"}, "EPSG/0/25832"),
    ],
)
def test_geojson_requires_unit(tmp_path, members, match):
    path = geojson(tmp_path / "a.geojson", SQUARES, members)
    with pytest.raises(FileError, match=match + r".*unit='um'"):
        fs.read_layout(path)
    assert fs.read_layout(path, unit="mm").area_um2.tolist() == [4e6, 4e6]


@pytest.mark.parametrize(
    ("column", "match"),
    [
        ({}, "OGC:CRS84, degrees"),
        ({"crs": None}, "unknown reference system"),
        ({"crs": {"type": "GeographicCRS", "name": "WGS 84"}}, "WGS 84"),
        ({"crs": {"type": "ProjectedCRS", "name": "by its identifier", "id": {"code": 25832}}}, "by its identifier"),
    ],
)
def test_geoparquet_requires_unit(tmp_path, column, match):
    path = parquet(tmp_path / "a.parquet", SQUARES, column)
    with pytest.raises(FileError, match=match + r".*unit='um'"):
        fs.read_layout(path)
    assert fs.read_layout(path, unit="nm").xy_um.max() == 0.005


def projected(unit):
    return {"type": "ProjectedCRS", "name": "plane", "coordinate_system": {"axis": [{"unit": unit}, {"unit": unit}]}}


@pytest.mark.parametrize(
    ("unit", "factor_um"),
    [("metre", 1e6), ({"type": "LinearUnit", "name": "millimetre", "conversion_factor": 0.001}, 1e3)],
)
def test_unit_of_reference_system_is_obeyed(tmp_path, unit, factor_um):
    path = parquet(tmp_path / "a.parquet", SQUARES, {"crs": projected(unit)})

    np.testing.assert_allclose(fs.read_layout(path).area_um2, 4.0 * factor_um**2)
    with pytest.raises(FileError, match=r"has coordinates in m.*got unit='um'; omit 'unit'"):
        fs.read_layout(path, unit="um")


@pytest.mark.parametrize("extension", ["geojson", "parquet"])
def test_own_file_states_its_unit(tmp_path, extension):
    layout = fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0)
    write_layout(layout, path := tmp_path / f"a.{extension}")

    assert fs.read_layout(path, unit="um").bounds_um == layout.bounds_um
    with pytest.raises(FileError, match="in µm, got unit='mm'"):
        fs.read_layout(path, unit="mm")
    with pytest.raises(ParameterError, match="unit"):
        fs.read_layout(path, unit="furlong")


def test_resaved_geoparquet_keeps_unit(tmp_path):
    layout = fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0)
    write_layout(layout, path := tmp_path / "a.parquet")
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({b"geo": table.schema.metadata[b"geo"]}), path)

    assert fs.read_layout(path).bounds_um == layout.bounds_um


def test_unit_is_no_option_of_npz(tmp_path):
    write_layout(fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0), tmp_path / "a.npz")
    with pytest.raises(ParameterError, match="is an option of"):
        fs.read_layout(tmp_path / "a.npz", unit="um")


# -- members and metadata that change the meaning ---------------------------------------------------------------------------


@pytest.mark.parametrize("member", ["transform", "place", "arcs"])
def test_members_that_change_coordinates_are_named(tmp_path, member):
    path = geojson(tmp_path / "a.geojson", SQUARES, {member: {"scale": [2, 2]}})
    with pytest.raises(FileError, match=f"'{member}', which changes"):
        fs.read_layout(path, unit="um")

    document = json.loads(geojson(tmp_path / "b.geojson", SQUARES).read_text())
    document["features"][1][member] = {"type": "Point"}
    (tmp_path / "b.geojson").write_text(json.dumps(document))
    with pytest.raises(FileError, match=f"feature 1 has the member '{member}'"):
        fs.read_layout(tmp_path / "b.geojson", unit="um")


@pytest.mark.parametrize(
    ("column", "geo", "match"),
    [
        ({"edges": "spherical"}, {}, "edges 'spherical' on a globe"),
        ({"encoding": "point"}, {}, "encoding 'point', expected one of WKB, polygon, multipolygon"),
        ({"curvature": 2}, {}, "metadata 'curvature'"),
        ({}, {"units": "m"}, "metadata 'units'"),
        ({}, {"version": "2.0.0"}, "GeoParquet 2.0.0, expected 1.x"),
    ],
)
def test_geoparquet_metadata_are_named(tmp_path, column, geo, match):
    with pytest.raises(FileError, match=match):
        fs.read_layout(parquet(tmp_path / "a.parquet", SQUARES, column, geo), unit="um")


def test_irrelevant_geoparquet_metadata_are_ignored(tmp_path):
    column = {"orientation": "counterclockwise", "bbox": [0, 0, 9, 9], "epoch": 2021.5, "edges": "planar"}
    column["covering"] = {"bbox": {side: ["box", side] for side in ("xmin", "ymin", "xmax", "ymax")}}
    box = pa.array([{"xmin": 0.0, "ymin": 0.0, "xmax": 1.0, "ymax": 1.0}] * 2)
    path = parquet(tmp_path / "a.parquet", SQUARES, column, {"creator": {}}, {"box": box})
    layout = fs.read_layout(path, unit="um")

    assert layout.area_um2.tolist() == [4.0, 4.0]
    assert "left_out_columns" not in layout.provenance


def test_several_heights_are_no_layout(tmp_path):
    tilted = [shapely.force_3d(SQUARES[0], 1.0), shapely.force_3d(SQUARES[1], 2.0)]
    for extension, write in WRITERS.items():
        with pytest.raises(FileError, match="at several z, from 1 to 2"):
            fs.read_layout(write(tmp_path / f"a.{extension}", tilted), unit="um")


# -- outlines -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("extension", WRITERS)
def test_parts_are_split_or_chosen(tmp_path, extension):
    path = WRITERS[extension](tmp_path / f"a.{extension}", [SQUARES[0], TWO_PARTS])
    with pytest.raises(FileError, match=r"1 must be one polygon, got one of 2 parts; pass parts='split' or"):
        fs.read_layout(path, unit="um")

    split = fs.read_layout(path, unit="um", parts="split")
    assert split.area_um2.tolist() == [4.0, 1.0, 4.0]
    assert (split.columns["parent"].tolist(), split.columns["part"].tolist()) == ([0, 1, 1], [0, 0, 1])
    with pytest.warns(LayoutWarning, match="1 smaller parts, 11 % of the area, are not read"):
        assert fs.read_layout(path, unit="um", parts="largest").area_um2.tolist() == [4.0, 4.0]


@pytest.mark.parametrize("extension", WRITERS)
def test_missing_outlines_are_skipped(tmp_path, extension):
    bow = shapely.Polygon([(20, 0), (24, 4), (24, 0), (20, 4)])
    geometries = [None, SQUARES[0], shapely.Point(1, 1), TWO_PARTS, bow, SQUARES[1]]
    path = WRITERS[extension](tmp_path / f"a.{extension}", geometries)
    with pytest.raises(FileError, match=r"(feature|row) 0 must be one polygon, got .*invalid='skip'|\(and 2 more\)"):
        fs.read_layout(path, unit="um")
    with pytest.warns(LayoutWarning) as caught:
        layout = fs.read_layout(path, unit="um", invalid="skip")

    assert layout.area_um2.tolist() == [4.0, 4.0]
    assert len(caught) == 2
    with pytest.warns(LayoutWarning) as caught:
        assert fs.read_layout(path, unit="um", invalid="repair").area_um2.tolist() == [4.0, 4.0, 4.0]
    assert "1 repaired" in str(caught[1].message)


@pytest.mark.parametrize("depth", [2, 3])
def test_native_encodings_match_wkb(tmp_path, depth):
    polygon = shapely.Polygon(
        [(0, 0), (9, 0), (9, 9), (0, 9)], [[(1, 1), (2, 1), (2, 2), (1, 2)], [(5, 5), (7, 5), (7, 7)]]
    )
    rings = [
        [[{"x": x, "y": y} for x, y in ring.coords] for ring in (p.exterior, *p.interiors)]
        for p in (polygon, SQUARES[1])
    ]
    kind = pa.list_(pa.list_(pa.struct([("x", pa.float64()), ("y", pa.float64())])))
    if depth == 3:
        rows, kind, parts = [[rings[0], rings[1]], None], pa.list_(kind), {"invalid": "skip", "parts": "split"}
    else:
        rows, parts = [None, *rings], {"invalid": "skip"}
    geo = {"encoding": "polygon" if depth == 2 else "multipolygon", "crs": None}
    metadata = {"version": "1.1.0", "primary_column": "g", "columns": {"g": geo}}
    table = pa.table({"g": pa.array(rows, kind)}).replace_schema_metadata({"geo": json.dumps(metadata)})
    pq.write_table(table, tmp_path / "a.parquet")
    with pytest.warns(LayoutWarning):
        layout = fs.read_layout(tmp_path / "a.parquet", unit="um", **parts)

    assert all(map(shapely.equals, layout.polygons(), [polygon, SQUARES[1]]))


# -- columns ------------------------------------------------------------------------------------------------------------


def test_categories_and_nullable_integers_stay(tmp_path):
    columns = {
        "kind": pa.array(["a", "b"]).dictionary_encode(),
        "number": pa.array([7, None], pa.int32()),
        "text": pa.array(["x", None]),
        "huge": pa.array([2**60, None]),
    }
    layout = fs.read_layout(parquet(tmp_path / "a.parquet", SQUARES, {"crs": None}, columns=columns), unit="um")

    assert layout.columns["kind"].tolist() == ["a", "b"]
    np.testing.assert_array_equal(layout.columns["number"], [7.0, np.nan])
    assert layout.columns["text"].tolist() == ["x", ""]
    assert layout.provenance["left_out_columns"] == ["huge"]


# -- settings and the command line ------------------------------------------------------------------------------------------


def test_settings_state_unit_and_parts(tmp_path):
    geojson(tmp_path / "a.geojson", [*SQUARES, TWO_PARTS])
    (tmp_path / "a.yaml").write_text("file: a.geojson\nunit: nm\nparts: split\n")

    np.testing.assert_allclose(fs.read_layout(tmp_path / "a.yaml").area_um2, [4e-6, 4e-6, 1e-6, 4e-6])


def test_convert_states_unit(tmp_path):
    from typer.testing import CliRunner

    from foveasim.cli import app

    geojson(tmp_path / "a.geojson", [*SQUARES, TWO_PARTS])
    words = [
        "convert",
        str(tmp_path / "a.geojson"),
        str(tmp_path / "a.npz"),
        "--reading",
        "unit=mm",
        "--reading",
        "parts=split",
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = CliRunner().invoke(app, words)

    assert result.exit_code == 0, result.output
    assert read_layout(tmp_path / "a.npz").area_um2.tolist() == [4e6, 4e6, 1e6, 4e6]
