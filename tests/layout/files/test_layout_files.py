"""Layout files: round trips, interoperability with other programs, and invalid files."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import FileError, GeometryError, LayoutWarning, ParameterError
from foveasim.layout import Layout, hexagonal
from foveasim.layout.files import read_layout, write_layout
from foveasim.sensor.device import Device

gdstk = pytest.importorskip("gdstk")
klayout = pytest.importorskip("klayout.db")
pq = pytest.importorskip("pyarrow.parquet")

#: The columns of some layouts leave no room for the identity of the sites in GDSII.
pytestmark = [
    pytest.mark.filterwarnings("ignore:the file does not contain the identity of the sites"),
    pytest.mark.usefixtures("forked_readers"),
]

EXACT = ["npz", "geojson", "parquet"]
GDSII_OASIS = ["gds", "oas"]
DBU_UM = 1e-3


def ring(n, radius_um, centre_um=(0.0, 0.0), turn_rad=0.1):
    angle = turn_rad + 2.0 * np.pi * np.arange(n) / n
    return np.asarray(centre_um) + radius_um * np.stack((np.cos(angle), np.sin(angle)), 1)


@pytest.fixture(scope="module")
def zoo():
    """Sites of 3 to 40 vertices off any grid, two thirds of them with one or two holes, in random order."""
    rng = np.random.default_rng(5)
    polygons = []
    for i in range(60):
        centre = np.array([i % 10, i // 10]) * 7.3 - 20.0 + rng.uniform(-0.3, 0.3, 2)
        holes = [ring(5, 0.5, (centre[0] + s, centre[1] + 0.3), 0.7) for s in ([], [0.1], [-1.0, 1.1])[i % 3]]
        polygons.append(shapely.Polygon(ring(3 + (7 * i) % 38 if i % 3 == 0 else 12 + i % 9, 3.1, centre), holes))
    order = rng.permutation(60)
    return Layout.from_polygons(
        [polygons[i] for i in order],
        channel=rng.integers(0, 5, 60),
        readout_line=rng.integers(0, 9, 60).astype(np.int32),
        provenance={"made_by": "zoo", "steps": ["α", 1.5, None]},
        gain=rng.normal(size=60).astype(np.float32),
        weight=np.where(rng.random(60) < 0.2, np.nan, rng.normal(size=60) * 1e-300),
        name=np.array([f"µ\"{i}'," for i in order]),
        is_dead=rng.random(60) < 0.5,
    )


def assert_same(a, b):
    for name in ("xy_um", "ring_offsets", "site_offsets"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert list(a.columns) == list(b.columns)
    for name, column in a.columns.items():
        assert column.dtype == b.columns[name].dtype, name
        np.testing.assert_array_equal(column, b.columns[name])


def same_bits(a, b):
    return a.dtype == b.dtype and a.tobytes() == b.tobytes()


def lattice(layout):
    """Return the vertices as integers in database units, by decimal rounding."""
    return np.round(layout.xy_um, 3) * 10**3


def same_outlines(a, b):
    return all(shapely.equals(p, q) for p, q in zip(a, b, strict=True))


# -- round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("extension", EXACT)
def test_exact_formats_round_trip_bit_identically(zoo, tmp_path, extension):
    report = write_layout(zoo, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")

    assert_same(zoo, again)
    assert dict(again.provenance) == dict(zoo.provenance)
    assert (report.n_sites, report.max_displacement_um, report.worst_area_error) == (60, 0.0, 0.0)
    assert report.dropped_columns == ()


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_gdsii_oasis_round_trip_on_database_grid(zoo, tmp_path, extension):
    write_layout(zoo, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")
    expected = Layout(np.round(zoo.xy_um, 3), zoo.ring_offsets, zoo.site_offsets).polygons()

    assert again.n_sites == 60
    assert same_outlines(again.polygons(), expected)
    assert [len(p.interiors) for p in again.polygons()] == [len(p.interiors) for p in zoo.polygons()]
    np.testing.assert_array_equal(again.channel, zoo.channel)
    np.testing.assert_allclose(again.area_um2, shapely.area(expected), rtol=1e-12)


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_new_process_reads_same_layout(zoo, tmp_path, monkeypatch, extension):
    write_layout(zoo, tmp_path / f"a.{extension}")
    forked = read_layout(tmp_path / f"a.{extension}")
    monkeypatch.undo()

    assert_same(read_layout(tmp_path / f"a.{extension}"), forked)


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_first_vertex_survives_without_holes(tmp_path, extension):
    layout = hexagonal(pitch_um=3.3, n_columns=9, n_rows=7)
    write_layout(layout, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")

    np.testing.assert_array_equal(again.xy_um, np.round(layout.xy_um, 3))
    np.testing.assert_array_equal(again.ring_offsets, layout.ring_offsets)


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_second_round_trip_is_bit_identical(tmp_path, extension):
    first, second = tmp_path / f"a.{extension}", tmp_path / f"b.{extension}"
    write_layout(hexagonal(pitch_um=3.3, n_columns=9, n_rows=7), first)
    report = write_layout(read_layout(first), second)

    assert first.read_bytes() == second.read_bytes()
    assert report.max_displacement_um == 0.0


@pytest.mark.parametrize("extension", EXACT + GDSII_OASIS)
def test_empty_layout_round_trips(tmp_path, extension):
    empty = hexagonal(pitch_um=3.3, n_columns=3, n_rows=3)[:0]
    write_layout(empty, tmp_path / f"a.{extension}")

    assert read_layout(tmp_path / f"a.{extension}").n_sites == 0


@pytest.mark.parametrize("extension", EXACT + GDSII_OASIS)
def test_format_is_detected_by_content(zoo, tmp_path, extension):
    write_layout(zoo, tmp_path / f"a.{extension}")
    expected = read_layout(tmp_path / f"a.{extension}")
    for wrong in {"gds": ("yaml", "npz"), "oas": ("gds", "geojson")}.get(extension, ("yaml", "gds", "npz", "geojson")):
        (tmp_path / f"wrong.{wrong}").write_bytes((tmp_path / f"a.{extension}").read_bytes())
        assert_same(read_layout(tmp_path / f"wrong.{wrong}"), expected)


def test_npz_supports_any_column_type(tmp_path):
    bare = hexagonal(pitch_um=3.3, n_columns=2, n_rows=2)
    layout = bare.with_columns(
        when=np.array(["2020-01-01"] * 4, "M8[D]"),
        z=np.arange(4) * 1j,
        raw=np.array([b"a"] * 4),
        half=np.ones(4, ">f2"),
    )
    write_layout(layout, tmp_path / "a.npz")

    assert_same(read_layout(tmp_path / "a.npz"), layout)


@pytest.mark.parametrize("extension", ["geojson", "parquet"])
def test_unsupported_column_types_are_rejected(tmp_path, extension):
    layout = hexagonal(pitch_um=3.3, n_columns=2, n_rows=2).with_columns(z=np.arange(4) * 1j)
    with pytest.raises(ParameterError, match=r"'z' must contain real numbers .*, got complex128; write a \.npz file"):
        write_layout(layout, tmp_path / f"a.{extension}")


@pytest.mark.parametrize("extension", EXACT)
def test_extreme_numbers_round_trip(tmp_path, extension):
    layout = hexagonal(pitch_um=3.3, n_columns=2, n_rows=2).with_columns(
        a=np.array([np.inf, -np.inf, np.nan, -0.0]),
        b=np.array([2**63 - 1, -(2**63), 0, 1]),
        c=np.full(4, 2**64 - 1, np.uint64),
        d=np.full(4, np.nan),
    )
    write_layout(layout, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")

    assert_same(again, layout)
    assert np.signbit(again.columns["a"][3])


@pytest.mark.parametrize("extension", EXACT)
def test_mixed_large_integers_round_trip_exactly(small, tmp_path, extension):
    layout = small.with_columns(a=np.array([2**64 - 1, 0, 2**63, 1, 2, 3, 4, 5, 6], np.uint64))
    write_layout(layout, tmp_path / f"a.{extension}")

    assert_same(read_layout(tmp_path / f"a.{extension}"), layout)


# -- columns in GDSII and OASIS ---------------------------------------------------------------------------------------

#: Numbers that are difficult to round trip: signed zeros, neighbours of 1/n, the largest and the smallest.
HARD_FLOATS = [
    *(np.nan, np.inf, -np.inf, -0.0, 0.0, 0.1, np.nextafter(0.1, 0), np.nextafter(1 / 3, 1), 5e-324, -1e-310),
    *(1.7976931348623157e308, 2.0**63, -(2.0**64), 1e300, 3.0, 0.30000000000000004, -1 / 49, 1e16, 1e-5, 0.5),
]
HARD_INTS = [0, -1, 2**53 + 1, 2**63 - 1, -(2**63), -(2**63) + 1, 2**32, -(2**31)]


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("extension", GDSII_OASIS)
@pytest.mark.parametrize(
    "column",
    [
        np.array(HARD_FLOATS),
        np.array(HARD_INTS),
        np.array([2**64 - 1, 0, 2**63], np.uint64),
        np.array([True, False, False]),
        np.array([True, True]),
        np.array(["", " ", "a b", 'say "=3"', "µ\n\t\\", "true", "17", "\ud83d", "x=1 y=2", "\x7f\x00b"]),
    ],
    ids=["floats", "ints", "uints", "both", "true", "texts"],
)
def test_gdsii_oasis_columns_round_trip_exactly(tmp_path, extension, column):
    layout = hexagonal(pitch_um=3.3, n_columns=column.size, n_rows=1).with_columns(
        a=column, last=np.arange(column.size)
    )
    report = write_layout(layout, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")

    assert report.dropped_columns == ()
    assert sorted(again.columns) == sorted(layout.columns)
    assert same_bits(again.columns["a"], column)
    np.testing.assert_array_equal(again.columns["last"], layout.columns["last"])


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_narrow_types_are_widened_exactly(tmp_path, extension):
    narrow = {"a": np.array([-7, 8], np.int8), "b": np.array([0.1, 1e30], np.float32), "c": np.array([1.5, 6e4], ">f2")}
    write_layout(hexagonal(pitch_um=3.3, n_columns=2, n_rows=1).with_columns(**narrow), tmp_path / f"a.{extension}")
    columns = read_layout(tmp_path / f"a.{extension}").columns

    assert [columns[name].dtype for name in narrow] == [np.int64, np.float64, np.float64]
    assert all((columns[name] == values).all() for name, values in narrow.items())


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_divided_sites_round_trip_columns(zoo, tmp_path, extension):
    report = write_layout(zoo, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")

    assert report.dropped_columns == (("is_dead", "site_id") if extension == "gds" else ())
    assert {*again.columns} - {"site_id"} == {*zoo.columns} - {*report.dropped_columns}
    for name in {*again.columns} - {"site_id"}:
        np.testing.assert_array_equal(again.columns[name], zoo.columns[name], err_msg=name)


@pytest.mark.parametrize(("n_chars", "dropped"), [(101, ()), (102, ("long",))])
def test_column_exceeding_gds_property_is_dropped(tmp_path, capfd, n_chars, dropped):
    square_um = np.stack((np.arange(10.0) * 2, np.zeros(10)), 1)
    layout = Layout.from_rectangles(square_um, 1.0, first=np.arange(10), long=["a" * n_chars] + ["a"] * 9)
    report = write_layout(layout, tmp_path / "a.gds", hierarchy=False)
    polygons = gdstk.read_gds(tmp_path / "a.gds").cells[0].polygons
    n_bytes = max(sum(2 * -(-len(v[2].rstrip(b"\0")) // 2) for v in p.properties) for p in polygons)

    assert report.dropped_columns == dropped
    assert {*read_layout(tmp_path / "a.gds").columns} == {"first", "long"} - {*dropped}
    assert n_bytes == (128 if not dropped else 20)
    # gdstk warns of properties that exceed the format limit.
    assert capfd.readouterr().err == ""
    assert write_layout(layout, tmp_path / "a.oas").dropped_columns == ()


def test_many_distinct_strings_dropped_from_oasis(tmp_path):
    layout = hexagonal(pitch_um=3.3, n_columns=200, n_rows=110).with_columns(
        name=np.array([f"site{i}" for i in range(22_000)]), kind=np.array(["a", "b"] * 11_000)
    )
    report = write_layout(layout, tmp_path / "a.oas")

    assert report.dropped_columns == ("name",)
    assert (read_layout(tmp_path / "a.oas").columns["kind"] == layout.columns["kind"]).all()


@pytest.mark.parametrize("extension", [*GDSII_OASIS, "svg"])
def test_dropped_columns_are_reported(tmp_path, extension):
    layout = hexagonal(pitch_um=3.3, n_columns=2, n_rows=2).with_columns(
        when=np.array(["2020-01-01"] * 4, "M8[D]"), z=np.arange(4) * 1j, raw=np.array([b"a"] * 4), a=np.arange(4)
    )
    stored = () if extension == "svg" else ("a", "column", "readout_line", "row")

    assert write_layout(layout, tmp_path / f"a.{extension}").dropped_columns == tuple(
        sorted({*layout.columns} - {*stored})
    )
    # Without shapes, the file contains no columns.
    assert write_layout(layout[:0], tmp_path / f"a.{extension}").dropped_columns == tuple(sorted(layout.columns))


UNUSUAL_NAMES = ("a b", "a=b", 'say "a"', "µ", "", "1", '"a"', "%s", "a\n", "photosite")


@pytest.mark.parametrize("extension", GDSII_OASIS)
@pytest.mark.parametrize("names", [UNUSUAL_NAMES[:3], UNUSUAL_NAMES[3:6], UNUSUAL_NAMES[6:]], ids=repr)
def test_unusual_column_names_round_trip(tmp_path, extension, names):
    unusual = {name: np.arange(4) + k for k, name in enumerate(names)}
    layout = hexagonal(pitch_um=3.3, n_columns=2, n_rows=2).with_columns(**unusual, b=np.arange(4) + 5)
    report = write_layout(layout, tmp_path / f"a.{extension}")
    columns = read_layout(tmp_path / f"a.{extension}").columns

    assert report.dropped_columns == ()
    for name, values in unusual.items():
        assert columns[name].tolist() == values.tolist()
    assert columns["b"].tolist() == [5, 6, 7, 8]


@pytest.mark.parametrize(("extension", "then"), [("gds", "gds"), ("gds", "oas"), ("oas", "oas")])
def test_columns_survive_klayout(zoo, tmp_path, extension, then):
    write_layout(zoo, tmp_path / f"a.{extension}")
    other = klayout.Layout()
    other.read(str(tmp_path / f"a.{extension}"))
    other.write(str(tmp_path / f"b.{then}"))
    first, again = read_layout(tmp_path / f"a.{extension}"), read_layout(tmp_path / f"b.{then}")

    assert list(again.columns) == list(first.columns)
    for name, column in first.columns.items():
        assert same_bits(again.columns[name], column), name


def test_klayout_shows_columns_as_words(tmp_path):
    write_layout(hexagonal(pitch_um=3.3, n_columns=2, n_rows=1).with_columns(gain=[0.5, 2.0]), tmp_path / "a.gds")
    other = klayout.Layout()
    other.read(str(tmp_path / "a.gds"))
    properties = {s.property(1): s.property(2) for s in other.top_cell().shapes(other.layer(1, 0)).each()}

    assert properties == {
        f"photosite {i}": f"row=0 column={i} readout_line={i} gain={g}" for i, g in enumerate([0.5, 2.0])
    }


def edited(tmp_path, edit):
    """Return the columns of a file with nine sites after another program changed its polygons."""
    layout = hexagonal(pitch_um=3.3, n_columns=3, n_rows=3).with_columns(a=np.arange(9), b=np.arange(9) * 0.5)
    write_layout(layout, tmp_path / "a.gds", hierarchy=False)
    library = gdstk.read_gds(tmp_path / "a.gds")
    edit(library.cells[0])
    library.write_gds(tmp_path / "b.gds", max_points=0)
    return read_layout(tmp_path / "b.gds").columns


@pytest.mark.parametrize("text", [None, "", "ring", "\x01", "a=1\nb=2", "é=1", "=1 =2"])
def test_shape_without_columns_drops_all_columns(tmp_path, text):
    def edit(cell):
        polygon = cell.polygons[4]
        polygon.delete_gds_property(2)
        if text is not None:
            polygon.set_gds_property(2, text)

    assert list(edited(tmp_path, edit)) == []


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("b=3.5", ["b"]),
        ("b=3.5 readout_line=2 c=5", ["b", "readout_line"]),
        ("b=2 a=7", ["a", "b"]),
        ("a=1 a=2 b=1", ["b"]),
        ("a=1.5 b=0", ["a", "b"]),
        ("a=true b=0.5", ["b"]),
        ("a=x b=0x10", []),
        ("a=99999999999999999999 b=1", ["b"]),
        ('a="1" b=1', ["b"]),
        ("a b=1", ["b"]),
        ("a= b=1", ["b"]),
        ("a=__import__('os') b=1", ["b"]),
    ],
)
def test_column_restored_only_if_complete(tmp_path, text, left):
    columns = edited(tmp_path, lambda cell: cell.polygons[4].set_gds_property(2, text))

    assert sorted(columns) == left
    if "a" in left:
        assert [v for v, i in zip(columns["a"], range(9), strict=True) if i != 4] == [0, 1, 2, 3, 5, 6, 7, 8]


@pytest.mark.parametrize(
    ("text", "channel"), [("channel=9 a=1", 9), ("channel=-1 a=1", None), ("channel=0.5 a=1", None)]
)
def test_channel_column_precedes_datatype(tmp_path, text, channel):
    def edit(cell):
        for polygon in cell.polygons:
            polygon.set_gds_property(2, text)

    columns = edited(tmp_path, edit)

    assert columns["a"].tolist() == [1] * 9
    assert "channel" not in columns if channel is None else columns["channel"].tolist() == [channel] * 9


def test_conflicting_part_values_drop_column(zoo, tmp_path):
    write_layout(zoo, tmp_path / "a.gds")
    library = gdstk.read_gds(tmp_path / "a.gds")
    part = next(p for p in library.cells[0].polygons if "part 2" in p.get_gds_property(1))
    part.set_gds_property(2, part.get_gds_property(2).replace("readout_line=", "readout_line=1"))
    library.write_gds(tmp_path / "b.gds", max_points=0)

    assert {*zoo.columns} - {*read_layout(tmp_path / "b.gds").columns} == {"readout_line", "is_dead"}


@pytest.mark.parametrize(
    "values",
    [["a"], ["a", 1, "b"], [1, 2], ["a", b"\xff"], ["a b", 1], ["a", "1 b=2"], ["a=", 1], ["a", 1] * 100, [b"\xff", 1]],
    ids=str,
)
def test_malformed_oasis_properties_are_tolerated(tmp_path, values):
    library = gdstk.Library()
    library.new_cell("A").add(*(gdstk.rectangle((i, 0), (i + 1, 1)).set_property("columns", values) for i in range(3)))
    library.write_oas(tmp_path / "a.oas")
    layout = read_layout(tmp_path / "a.oas")

    assert layout.n_sites == 3
    assert all(column.shape == (3,) for column in layout.columns.values())


def test_unread_shapes_do_not_affect_columns(tmp_path):
    library = gdstk.Library()
    inner = library.new_cell("IN").add(
        gdstk.rectangle((0, 0), (1, 1), 1).set_gds_property(2, "a=1"),
        gdstk.rectangle((2, 0), (3, 1), 1).set_gds_property(2, "a=2"),
        gdstk.rectangle((4, 0), (5, 1), 2),
    )
    library.new_cell("TOP").add(gdstk.Reference(inner, (0, 0), columns=2, rows=1, spacing=(10, 0)))
    library.write_gds(tmp_path / "a.gds")

    assert read_layout(tmp_path / "a.gds", layer=1).columns["a"].tolist() == [1, 2, 1, 2]
    assert list(read_layout(tmp_path / "a.gds", layer=2).columns) == []


# -- interoperability with other programs -----------------------------------------------------------------------------


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_klayout_reads_areas_layers_and_channels(zoo, tmp_path, extension):
    write_layout(zoo, tmp_path / f"a.{extension}", layer=7)
    other = klayout.Layout()
    other.read(str(tmp_path / f"a.{extension}"))
    twice_area_dbu2 = dict.fromkeys(range(60), 0)
    channels = {}
    assert other.dbu == pytest.approx(DBU_UM)
    for info in other.layer_infos():
        assert info.layer == 7
        for shape in other.top_cell().shapes(other.layer(info)).each():
            text = shape.property(1) if extension == "gds" else shape.property("photosite")
            words = str(text[0] if isinstance(text, list) else text).split()
            site = int(words[1] if extension == "gds" else words[0])
            twice_area_dbu2[site] += shape.polygon.area2()
            channels[site] = info.datatype
    dbu = lattice(zoo)
    exact = []
    for s in range(60):
        twice = 0
        for r in range(zoo.site_offsets[s], zoo.site_offsets[s + 1]):
            xy = [(round(x), round(y)) for x, y in dbu[zoo.ring_offsets[r] : zoo.ring_offsets[r + 1]]]
            twice += sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(xy, xy[1:] + xy[:1], strict=True))
        exact.append(twice)

    assert [twice_area_dbu2[s] for s in range(60)] == exact
    assert [channels[s] for s in range(60)] == zoo.channel.tolist()


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_site_order_survives_klayout(zoo, tmp_path, extension):
    write_layout(zoo, tmp_path / f"a.{extension}")
    other = klayout.Layout()
    other.read(str(tmp_path / f"a.{extension}"))
    other.write(str(tmp_path / f"b.{extension}"))
    first, again = read_layout(tmp_path / f"a.{extension}"), read_layout(tmp_path / f"b.{extension}")

    assert same_outlines(first.polygons(), again.polygons())
    np.testing.assert_array_equal(first.channel, again.channel)


def test_klayout_keyholes_are_read_as_holes(tmp_path):
    other = klayout.Layout()
    polygon = klayout.DPolygon([klayout.DPoint(*p) for p in ((0, 0), (0, 10), (10, 10), (10, 0))])
    polygon.insert_hole([klayout.DPoint(*p) for p in ((2, 2), (2, 5), (5, 5), (5, 2))])
    other.create_cell("A").shapes(other.layer(1, 3)).insert(polygon)
    other.write(str(tmp_path / "a.gds"))
    layout = read_layout(tmp_path / "a.gds")

    assert layout.area_um2.tolist() == pytest.approx([91.0])
    assert layout.channel.tolist() == [3]
    assert np.diff(layout.site_offsets).tolist() == [2]


def test_gds_coordinates_in_nanometres_are_converted(tmp_path):
    library = gdstk.Library(unit=1e-9, precision=1e-9)
    pixel, top = library.new_cell("PIXEL"), library.new_cell("TOP")
    pixel.add(gdstk.rectangle((0, 0), (2000, 3000), 1))
    top.add(gdstk.Reference(pixel, (500, 7000)))
    library.write_gds(tmp_path / "a.gds")

    assert read_layout(tmp_path / "a.gds").bounds_um == pytest.approx((0.5, 7.0, 2.5, 10.0))


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_flattened_hierarchy_matches_klayout(tmp_path, extension):
    rng = np.random.default_rng(3)
    library = gdstk.Library(unit=1e-6, precision=1e-6 * DBU_UM)
    pixel, block, top = (library.new_cell(name) for name in ("PIXEL", "BLOCK", "TOP"))
    pixel.add(gdstk.Polygon([(0, 0), (2, 0), (2, 1), (0.5, 1.5)], 1, 2))
    block.add(
        gdstk.Reference(pixel, (1, 2), rotation=np.pi / 2, columns=3, rows=2, spacing=(4, 5)),
        gdstk.rectangle((-3, -3), (-2, -2), 1, 4),
    )
    for _ in range(6):
        top.add(
            gdstk.Reference(
                block,
                tuple(np.round(rng.uniform(-300, 300, 2), 3)),
                rotation=rng.integers(0, 4) * np.pi / 2,
                x_reflection=bool(rng.integers(2)),
            )
        )
    top.add(
        gdstk.Reference(pixel, (500, 500), magnification=2.0),
        gdstk.FlexPath([(600, 0), (620, 0)], 2.0, layer=1, datatype=0),
    )
    (library.write_gds if extension == "gds" else library.write_oas)(tmp_path / f"a.{extension}")
    layout = read_layout(tmp_path / f"a.{extension}")
    other = klayout.Layout()
    other.read(str(tmp_path / f"a.{extension}"))
    expected = []
    for info in other.layer_infos():
        shapes = other.top_cell().begin_shapes_rec(other.layer(info))
        while not shapes.at_end():
            p = shapes.shape().polygon.transformed(shapes.trans())
            points = [(q.x, q.y) for q in p.each_point_hull()]
            expected.append((info.datatype, p.area(), *np.min(points, 0), *np.max(points, 0)))
            shapes.next()
    got = [
        (c, round(a / DBU_UM**2), *np.rint(b / DBU_UM).astype(int).tolist())
        for c, a, b in zip(layout.channel, layout.area_um2, layout.site_bounds_um, strict=True)
    ]

    assert layout.n_sites == 6 * 7 + 2
    assert sorted(got) == sorted(expected)


def test_sites_of_repeated_cell_stay_separate(zoo, tmp_path):
    write_layout(zoo, tmp_path / "a.gds")
    library = gdstk.read_gds(tmp_path / "a.gds")
    sensor = library.cells[0]
    library.new_cell("DIE").add(gdstk.Reference(sensor, (0, 0)), gdstk.Reference(sensor, (200, 0)))
    library.write_gds(tmp_path / "b.gds", max_points=0)
    once, twice = read_layout(tmp_path / "a.gds"), read_layout(tmp_path / "b.gds")

    assert twice.n_sites == 120
    np.testing.assert_allclose(twice.area_um2, np.tile(once.area_um2, 2), rtol=1e-9)
    assert_same(read_layout(tmp_path / "b.gds", cell="SENSOR"), once)


def test_other_readers_accept_geojson(zoo, tmp_path):
    write_layout(zoo, tmp_path / "a.geojson")
    data = json.loads((tmp_path / "a.geojson").read_text(), parse_constant=pytest.fail)
    geometries = shapely.get_parts(shapely.from_geojson((tmp_path / "a.geojson").read_text()))

    assert [f["id"] for f in data["features"]] == list(range(60))
    assert all(shapely.equals_exact(g, p) for g, p in zip(geometries, zoo.polygons(), strict=True))
    assert [f["properties"]["name"] for f in data["features"]] == zoo.columns["name"].tolist()


def test_foreign_geojson_reports_omitted_properties(tmp_path):
    features = [
        {"type": "Feature", "properties": {"channel": i, "q": None if i else 1, "note": {"a": 1}}, "geometry": g}
        for i, g in enumerate(
            [
                {"type": "Polygon", "coordinates": [[[0, 0, 9], [0, 2, 9], [2, 2, 9], [2, 0, 9], [0, 0, 9]]]},
                {"type": "MultiPolygon", "coordinates": [[[[4, 0], [6, 0], [6, 2], [4, 2], [4, 0]]]]},
            ]
        )
    ]
    (tmp_path / "a").write_text("\ufeff " + json.dumps({"features": features, "type": "FeatureCollection"}))
    layout = read_layout(tmp_path / "a", unit="um")

    assert layout.area_um2.tolist() == [4.0, 4.0]
    assert layout.channel.tolist() == [0, 1]
    np.testing.assert_array_equal(layout.columns["q"], [1.0, np.nan])
    assert layout.provenance["left_out_properties"] == ["note"]


def test_features_inside_properties_are_not_sites(tmp_path):
    squares = [
        {"type": "Polygon", "coordinates": [[[x, 0], [x + w, 0], [x + w, w], [x, w], [x, 0]]]}
        for x, w in ((0, 1), (4, 2))
    ]
    inner = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [9, 9]}}
    features = [{"type": "Feature", "properties": {"n": i, "of": inner}, "geometry": g} for i, g in enumerate(squares)]
    document = {"type": "FeatureCollection", "other": features[0], "features": features, "more": inner}
    (tmp_path / "a.geojson").write_text(json.dumps(document))

    layout = read_layout(tmp_path / "a.geojson", unit="um")

    assert layout.area_um2.tolist() == [1.0, 4.0]
    assert layout.columns["n"].tolist() == [0, 1]
    assert layout.provenance["left_out_properties"] == ["of"]


def test_geoparquet_metadata_follows_standard(zoo, tmp_path):
    write_layout(zoo, tmp_path / "a.parquet")
    table = pq.read_table(tmp_path / "a.parquet")
    geo = json.loads(table.schema.metadata[b"geo"])

    assert geo["version"] == "1.1.0"
    assert geo["columns"][geo["primary_column"]]["encoding"] == "WKB"
    assert geo["columns"]["geometry"]["bbox"] == list(zoo.bounds_um)
    assert same_outlines(shapely.from_wkb(table["geometry"].to_numpy(zero_copy_only=False)), zoo.polygons())


def test_svg_draws_rings_in_channel_colours(zoo, tmp_path):
    report = write_layout(zoo, tmp_path / "a.svg", colours={1: "#ff0000", 2: "green"})
    root = ET.parse(tmp_path / "a.svg").getroot()
    group = root.find("{*}g")
    paths = group.findall("{*}path")
    left, top, width, height = map(float, root.get("viewBox").split())

    assert (group.get("transform"), group.get("fill-rule")) == ("scale(1,-1)", "evenodd")
    assert [p.get("fill") for p in paths] == [{1: "#ff0000", 2: "green"}.get(c, "#9a9a9a") for c in zoo.channel]
    assert (left, -top, left + width, -top - height) == pytest.approx(
        [zoo.bounds_um[i] for i in (0, 3, 2, 1)], abs=1e-3
    )
    for path, site in zip(paths, zoo.polygons(), strict=True):
        rings = [
            [tuple(map(float, v.split())) for v in part.strip("MZ").split("L")]
            for part in path.get("d").split("Z")[:-1]
        ]
        assert shapely.Polygon(rings[0], rings[1:]).area == pytest.approx(site.area, abs=1e-3)
    assert 0.0 < report.max_displacement_um <= 0.5e-4 * 2**0.5 + 1e-9


@pytest.mark.parametrize("colour", ['red"/><script>', "url(#a)", "", "#12345", 7])
def test_svg_rejects_invalid_colours(zoo, tmp_path, colour):
    with pytest.raises(ParameterError, match=r"must be a CSS colour name, #rgb or #rrggbb|must be a string"):
        write_layout(zoo, tmp_path / "a.svg", colours={0: colour})


# -- rounding ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extension", "dbu_um"), [("gds", 1e-4), ("oas", 1e-3), ("gds", 5e-3), ("oas", 0.0137), ("gds", 0.0137)]
)
@pytest.mark.filterwarnings("ignore::foveasim.errors.LayoutWarning")  # 5 and 13.7 nm
def test_rounding_report_matches_read_layout(tmp_path, extension, dbu_um):
    layout = hexagonal(pitch_um=3.3, n_columns=20, n_rows=20).rotate(17.3)
    report = write_layout(layout, tmp_path / f"a.{extension}", dbu_um=dbu_um)
    again = read_layout(tmp_path / f"a.{extension}")
    move_um = max(np.hypot(*(a - b)) for a, b in zip(layout.xy_um, again.xy_um, strict=True))
    area = [q.area / p.area - 1 for p, q in zip(layout.polygons(), again.polygons(), strict=True)]

    assert report.max_displacement_um == pytest.approx(move_um, rel=1e-6)
    assert 0.25 * dbu_um < report.max_displacement_um <= dbu_um * 0.5**0.5 * (1 + 1e-9)
    assert report.worst_area_error == pytest.approx(np.abs(area).max(), rel=1e-4)


def test_collapsed_sites_are_reported(tmp_path):
    layout = Layout.from_polygons([shapely.box(0, 0, 5, 5), shapely.box(6, 0, 6.04, 5), shapely.box(7, 0, 9, 5)])
    with pytest.raises(GeometryError, match=r"site 1 would collapse .* use a smaller dbu_um") as caught:
        write_layout(layout, tmp_path / "a.gds", dbu_um=0.1)
    assert caught.value.site_ids == (1,)
    assert not list(tmp_path.iterdir())


def test_large_coordinates_require_larger_unit(tmp_path):
    layout = Layout.from_polygons([shapely.box(3e5, 0, 3.1e5, 5)])
    with pytest.raises(ParameterError, match=r"'dbu_um' must be >= 0\.000144"):
        write_layout(layout, tmp_path / "a.gds", dbu_um=1e-4)


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize(("extension", "n"), [("gds", 8190), ("gds", 8191), ("gds", 12_000), ("oas", 8191)])
def test_site_with_many_vertices_round_trips(tmp_path, extension, n):
    star = ring(n, 400.0) * (1.0 + 0.3 * np.sin(40.0 * np.pi * np.arange(n) / n))[:, np.newaxis]
    layout = Layout.from_polygons([shapely.box(600, 0, 601, 1), shapely.Polygon(star)], channel=[3, 1])
    write_layout(layout, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")
    other = klayout.Layout()
    other.read(str(tmp_path / f"a.{extension}"))
    sizes = [s.polygon.num_points() for s in other.top_cell().shapes(other.layer(1, 1)).each()]

    assert max(sizes) <= (8190 if extension == "gds" else n)
    assert again.n_sites == 2
    assert again.channel.tolist() == [3, 1]
    assert shapely.equals(again.polygons()[1], shapely.Polygon(np.round(star, 3)))
    assert np.diff(again.ring_offsets)[1] == n


def test_incomplete_divided_site_is_rejected(zoo, tmp_path):
    write_layout(zoo, tmp_path / "a.gds")
    library = gdstk.read_gds(tmp_path / "a.gds")
    cell = library.cells[0]
    cell.remove(next(p for p in cell.polygons if "part 1" in p.get_gds_property(1)))
    library.write_gds(tmp_path / "b.gds", max_points=0)
    with pytest.raises(FileError, match=r"has missing or duplicate parts of photosite \d+, expected \d+ parts"):
        read_layout(tmp_path / "b.gds")


# -- options ----------------------------------------------------------------------------------------------------------


def test_layer_and_cell_must_be_selected(tmp_path):
    library = gdstk.Library()
    library.new_cell("A").add(gdstk.rectangle((0, 0), (1, 1), 1), gdstk.rectangle((2, 0), (4, 1), 5))
    library.write_gds(tmp_path / "a.gds")
    with pytest.raises(FileError, match=r"shapes on several layers, 1/0, 5/0; select one with layer="):
        read_layout(tmp_path / "a.gds")
    assert read_layout(tmp_path / "a.gds", layer=5).area_um2.tolist() == pytest.approx([2.0])
    with pytest.raises(FileError, match="has no shape on layer 9"):
        read_layout(tmp_path / "a.gds", layer=9)
    library.new_cell("B").add(gdstk.rectangle((0, 0), (3, 1), 1))
    library.write_gds(tmp_path / "b.gds")
    with pytest.raises(FileError, match="has several top cells, 'A', 'B'; select one with cell="):
        read_layout(tmp_path / "b.gds")
    assert read_layout(tmp_path / "b.gds", cell="B").area_um2.tolist() == pytest.approx([3.0])
    with pytest.raises(FileError, match="has no cell 'C'"):
        read_layout(tmp_path / "b.gds", cell="C")


@pytest.mark.parametrize(
    ("options", "extension"),
    [({"layer": 1}, "npz"), ({"dbu_um": 1e-3}, "geojson"), ({"colours": {}}, "gds"), ({"layer": 2}, "svg")],
)
def test_options_of_other_formats_are_rejected(zoo, tmp_path, options, extension):
    (name,) = options
    belongs = "SVG" if name == "colours" else "GDSII and OASIS"
    with pytest.raises(ParameterError, match=f"'{name}' is an option of {belongs} files only, got .*; omit it"):
        write_layout(zoo, tmp_path / f"a.{extension}", **options)


def test_gdsii_read_option_rejected_for_npz(zoo, tmp_path):
    write_layout(zoo, tmp_path / "a.npz")
    with pytest.raises(ParameterError, match="'layer' is an option of DXF, GDSII and OASIS files"):
        read_layout(tmp_path / "a.npz", layer=1)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"layer": -1}, "layer"),
        ({"layer": 40_000}, "layer"),
        ({"dbu_um": 0.0}, "dbu_um"),
        ({"dbu_um": np.nan}, "dbu_um"),
    ],
)
def test_invalid_options_are_rejected(zoo, tmp_path, options, match):
    with pytest.raises(ParameterError, match=match):
        write_layout(zoo, tmp_path / "a.gds", **options)


def test_channel_beyond_16_bits_is_rejected(tmp_path):
    layout = hexagonal(pitch_um=3.3, n_columns=2, n_rows=2).with_columns(channel=[0, 1, 2, 40_000])
    with pytest.raises(ParameterError, match="'channel' must be <= 32767"):
        write_layout(layout, tmp_path / "a.gds")


def test_unknown_extension_lists_known_ones(zoo, tmp_path):
    with pytest.raises(FileError, match=r"must end in one of .*\.gds"):
        write_layout(zoo, tmp_path / "a.dxf")


# -- untrusted files --------------------------------------------------------------------------------------------------


def outcome(path):
    """Return the layout, or the one-line message of a FileError; other outcomes fail the test."""
    try:
        layout = read_layout(path)
    except FileError as error:
        text = str(error)
        assert "\n" not in text
        assert len(text) < 600
        return text
    assert np.isfinite(layout.xy_um).all()
    return layout


def corrupted(data, rng, n):
    """Yield seeded truncations, bit flips, and runs of noise of a file."""
    for i in range(n):
        if i % 3 == 0:
            yield data[: rng.integers(1, len(data))]
            continue
        corrupt = bytearray(data)
        # Half of the flips are near the beginning, which contains the structure.
        where = rng.integers(0, len(data) if i % 2 else min(len(data), 400), 1 + i % 4)
        for at in where:
            corrupt[at] ^= 1 << rng.integers(8)
        if i % 7 == 0:
            at = rng.integers(0, len(data))
            corrupt[at : at + 8] = rng.bytes(8)
        yield bytes(corrupt)


@pytest.fixture(scope="module")
def small():
    bare = hexagonal(pitch_um=3.3, n_columns=3, n_rows=3)
    holed = [shapely.Polygon(p.exterior.coords, [ring(4, 0.4, p.centroid.coords[0])]) for p in bare.polygons()]
    return Layout.from_polygons(holed, channel=np.arange(9) % 3, name=np.array(list("abcdefghi")))


@pytest.mark.slow
@pytest.mark.parametrize("extension", [*EXACT, *GDSII_OASIS])
def test_corrupt_files_read_or_raise(small, tmp_path, extension):
    write_layout(small, tmp_path / f"a.{extension}")
    data = (tmp_path / f"a.{extension}").read_bytes()
    rng = np.random.default_rng(11)
    n = 120 if extension in EXACT else 60
    paths = []
    for i, corrupt in enumerate(corrupted(data, rng, n)):
        paths.append(tmp_path / f"{i}.{extension}")
        paths[-1].write_bytes(corrupt)
    with ThreadPoolExecutor(2) as pool:
        results = list(pool.map(outcome, paths)) if extension in GDSII_OASIS else [outcome(p) for p in paths]

    assert sum(isinstance(r, str) for r in results) > n // 4


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "is empty"),
        (b"hello", "layout file"),
        (b"<svg/>", "SVG files can be written but not read"),
        (b"\x1f\x8b\x08", "compressed with gzip"),
        (b"{", "GeoJSON"),
        (b'{"type": "Topology"}', "not a GeoJSON FeatureCollection"),
        (b"{" + b'"a":{' * 100_000, "GeoJSON"),
        (b'{"type": "FeatureCollection", "features": [1]}', "feature 0 must be one polygon"),
        (b'{"type": "FeatureCollection", "features": [' + b"[" * 200_000, "GeoJSON"),
        (b"PK\x03\x04", "npz"),
        (b"PAR1" + bytes(50) + b"PAR1", "GeoParquet"),
        (b"%SEMI-OASIS\r\n", "truncated"),
        (b"%SEMI-OASIS\r\n" + bytes(300), "does not end with the END record"),
        (b"\x00\x06\x00\x02\x00\x05", "truncated"),
        (b"\x00\x06\x00\x02\x00\x05\x00\x00\x00\x00", "no valid GDSII record begins at byte 6"),
        (b"\x00\x06\x00\x02\x00\x05\x00\x04\x04\x00junk", "unexpected data after the end"),
    ],
)
def test_unrecognised_content_gives_specific_error(tmp_path, content, match):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(FileError, match=match):
        read_layout(tmp_path / "a")


@pytest.mark.parametrize(
    ("geometry", "match"),
    [
        ('{"type": "Polygon", "coordinates": [[[0,0],[4,4],[4,0],[0,4],[0,0]]]}', "site 0 crosses"),
        ('{"type": "Polygon", "coordinates": [[[0,0],[1e999,4],[4,0],[0,0]]]}', "not finite"),
        ('{"type": "Polygon", "coordinates": [[[0,0],[NaN,4],[4,0],[0,0]]]}', "not finite"),
        ('{"type": "Polygon", "coordinates": [[["0",0],[4,4],[4,0],[0,0]]]}', "not two or three numbers"),
        ('{"type": "Polygon", "coordinates": [[[true,0],[4,4],[4,0],[0,0]]]}', "not two or three numbers"),
        ('{"type": "Polygon", "coordinates": [[[0],[4,4],[4,0],[0,0]]]}', "not two or three numbers"),
        ('{"type": "Polygon", "coordinates": [[[0,0],[4,4]]]}', "fewer than 4 positions"),
        ('{"type": "Polygon", "coordinates": 3}', "must be one polygon"),
        ('{"type": "Point", "coordinates": [0, 0]}', "got Point"),
        ('{"type": "Polygon", "coordinates": [[[0,0],[' + "9" * 5000 + ",4],[4,0],[0,0]]]}", "GeoJSON"),
        ("null", "must be one polygon"),
    ],
)
def test_invalid_geojson_geometry_is_rejected(tmp_path, geometry, match):
    (tmp_path / "a").write_text(
        f'{{"type": "FeatureCollection", "features": [{{"type": "Feature", "geometry": {geometry}}}]}}'
    )
    with pytest.raises(FileError, match=match):
        read_layout(tmp_path / "a", unit="um")


def test_recursive_cell_is_rejected(tmp_path):
    library = gdstk.Library()
    a, b, c = (library.new_cell(n) for n in "ABC")
    c.add(gdstk.Reference(a, (0, 0)))
    a.add(gdstk.Reference(b, (1, 1)), gdstk.rectangle((0, 0), (1, 1)))
    b.add(gdstk.Reference(a, (1, 1)))
    library.write_gds(tmp_path / "a.gds")
    with pytest.raises(FileError, match="has a cell that contains itself"):
        read_layout(tmp_path / "a.gds")


def test_exploding_hierarchy_is_rejected(tmp_path):
    library = gdstk.Library()
    inner = library.new_cell("C0").add(gdstk.rectangle((0, 0), (1, 1)))
    for i in range(1, 12):
        inner = library.new_cell(f"C{i}").add(gdstk.Reference(inner, (0, 0), columns=30, rows=30, spacing=(2, 2)))
    library.write_gds(tmp_path / "a.gds")
    # 30**22 rectangles: those that are counted one by one never end.
    with pytest.raises(FileError, match="more than the maximum of 50000000 sites"):
        read_layout(tmp_path / "a.gds")


def test_missing_referenced_cell_is_rejected(tmp_path):
    library = gdstk.Library()
    library.new_cell("A").add(gdstk.rectangle((0, 0), (1, 1)), gdstk.Reference("NOWHERE", (0, 0)))
    library.write_gds(tmp_path / "a.gds")
    with pytest.raises(FileError, match="NOWHERE"):
        read_layout(tmp_path / "a.gds")


def npz(path, **changes):
    about = {"format": "foveasim layout", "version": 1, "unit": "um", "provenance": {}}
    arrays = {
        "about": np.array(json.dumps(about)),
        "xy_um": np.array([[0.0, 0], [1, 0], [0, 1]]),
        "ring_offsets": np.array([0, 3]),
        "site_offsets": np.array([0, 1]),
    }
    np.savez(path, **arrays | changes)
    return path


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"column_evil": np.array([{"a": 1}], dtype=object)}, "array of Python objects"),
        ({"xy_um": np.array([[0.0, 0], [0, 1], [1, 0]])}, "wound the wrong way"),
        ({"xy_um": np.array([[0.0, 0], [np.nan, 1], [1, 0]])}, "finite"),
        ({"ring_offsets": np.array([0, 9])}, "ring_offsets"),
        ({"ring_offsets": np.array([0, -5, 3])}, "ring_offsets"),
        ({"site_offsets": np.array([0.0, 1.0])}, "site_offsets"),
        ({"column_a": np.arange(5)}, "one value for each"),
        ({"about": np.array("[]")}, "is not a foveasim layout"),
        ({"about": np.array('{"format": "foveasim capture"}')}, r"load it with Capture\.load"),
        ({"about": np.array('{"format": "foveasim layout", "version": 99}')}, "format version 99, expected 1"),
    ],
)
def test_invalid_npz_layout_is_rejected(tmp_path, changes, match):
    with pytest.raises(FileError, match=match):
        read_layout(npz(tmp_path / "a.npz", **changes))


def test_huge_npz_array_rejected_before_allocation(tmp_path):
    npz(tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "a.npz") as old, zipfile.ZipFile(tmp_path / "b.npz", "w") as new:
        for name in old.namelist():
            if name == "xy_um.npy":
                buffer = io.BytesIO()
                np.lib.format.write_array_header_1_0(
                    buffer, {"descr": "<f8", "fortran_order": False, "shape": (2**50, 2)}
                )
                new.writestr(name, buffer.getvalue() + bytes(48))
            else:
                new.writestr(name, old.read(name))
    with pytest.raises(FileError, match="size of an array does not match its header"):
        read_layout(tmp_path / "b.npz")


def test_npz_decompression_limit_is_enforced(tmp_path, monkeypatch):
    monkeypatch.setattr("foveasim.layout.files._common.MAX_DECOMPRESSED_BYTES", 1000)
    with pytest.raises(FileError, match="would decompress to more than 1000 bytes"):
        read_layout(npz(tmp_path / "a.npz", column_a=np.zeros(200)))


@pytest.mark.parametrize("extension", EXACT)
def test_too_many_sites_are_rejected(small, tmp_path, monkeypatch, extension):
    write_layout(small, tmp_path / f"a.{extension}")
    monkeypatch.setattr("foveasim.layout.files._common.MAX_SITES", 8)
    with pytest.raises(FileError, match="sites, more than the maximum of 8"):
        read_layout(tmp_path / f"a.{extension}")


def test_parquet_decompression_limit_is_enforced(small, tmp_path, monkeypatch):
    pa = pytest.importorskip("pyarrow")
    monkeypatch.setattr("foveasim.layout.files._common.MAX_DECOMPRESSED_BYTES", 2**26)
    write_layout(small, tmp_path / "a.parquet")
    metadata = pq.read_table(tmp_path / "a.parquet").schema.metadata
    values = pa.DictionaryArray.from_arrays(pa.array(np.zeros(10**6, np.int32)), pa.array([bytes(10**5)]))
    pq.write_table(
        pa.table({"geometry": values}).replace_schema_metadata(metadata), tmp_path / "b.parquet", compression="zstd"
    )
    with pytest.raises(FileError, match="has geometry of type dictionary"):
        read_layout(tmp_path / "b.parquet")
    table = pa.table({"geometry": values})
    with pq.ParquetWriter(tmp_path / "b.parquet", table.schema, compression="zstd", store_schema=False) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({"geo": metadata[b"geo"]})
    assert (tmp_path / "b.parquet").stat().st_size < 10**6
    with pytest.raises(FileError, match="would decompress to more than the maximum of 67108864 bytes"):
        read_layout(tmp_path / "b.parquet")


def test_too_large_files_are_rejected(small, tmp_path, monkeypatch):
    write_layout(small, tmp_path / "a.npz")
    monkeypatch.setattr("foveasim._io.formats.MAX_FILE_BYTES", 100)
    with pytest.raises(FileError, match="more than the limit of 100"):
        read_layout(tmp_path / "a.npz")


@pytest.mark.parametrize(("path", "match"), [("nowhere.gds", "no such file"), (".", "is not a file")])
def test_missing_file_is_reported(tmp_path, path, match):
    with pytest.raises(FileError, match=match):
        read_layout(tmp_path / path)


# -- atomic writing, and optional libraries ---------------------------------------------------------------------------


@pytest.mark.parametrize("extension", [*EXACT, *GDSII_OASIS, "svg"])
def test_failed_write_preserves_old_file(small, tmp_path, monkeypatch, extension):
    path = tmp_path / f"a.{extension}"
    path.write_bytes(b"old")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", full)
    with pytest.raises(FileError, match="cannot be written: No space left on device"):
        write_layout(small, path)

    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_full_disk_is_detected_with_gdstk(small, tmp_path, monkeypatch, extension):
    path = tmp_path / f"a.{extension}"

    class Library(gdstk.Library):
        def write_gds(self, target, **_):
            target.write_bytes(b"\x00\x06\x00\x02")

        write_oas = write_gds

    monkeypatch.setattr(gdstk, "Library", Library)
    with pytest.raises(FileError, match="the written file is incomplete"):
        write_layout(small, path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("extension", "module", "extra"),
    [("gds", "gdstk", "layout"), ("oas", "gdstk", "layout"), ("parquet", "pyarrow", "parquet")],
)
def test_missing_library_gives_install_command(small, tmp_path, monkeypatch, extension, module, extra):
    path = tmp_path / f"a.{extension}"
    write_layout(small, path)
    monkeypatch.setitem(sys.modules, module, None)
    for call in (lambda: write_layout(small, path), lambda: read_layout(path)):
        with pytest.raises(FileError, match=rf"needs {module}; install it with: pip install 'foveasim\[{extra}\]'"):
            call()


def test_optional_libraries_are_loaded_lazily(tmp_path):
    code = (
        "import sys, foveasim.layout.files as f; from foveasim.layout import hexagonal;"
        f"f.write_layout(hexagonal(pitch_um=2., n_columns=2, n_rows=2), {str(tmp_path / 'a.npz')!r});"
        "print({'gdstk', 'pyarrow', 'klayout'} & set(sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_round_trip_of_20000_sites(tmp_path, extension):
    layout = hexagonal(pitch_um=3.3, n_columns=200, n_rows=100)
    write_layout(layout, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")

    assert again.n_sites == 20_000


# -- the same device --------------------------------------------------------------------------------------------------


def log_polar():
    return fs.layout.log_polar(n_sectors=24, r_min_um=10.0, r_max_um=60.0, n_rings=6)


#: Layouts with centroids off the database grid, on it, and with sites that are identified by their outlines.
DEVICES = {
    "log-polar": log_polar,
    "hexagons": lambda: hexagonal(8, 6, 3.3),
    "grid": lambda: fs.layout.grid(n_x=9, n_y=7, pitch_um=2.2),
    "fine grid": lambda: fs.layout.grid(n_x=9, n_y=7, pitch_um=2.20004),
    "rings": lambda: Layout.from_polygons(
        [shapely.Polygon(ring(40, r, (3.3, 1.7)), [ring(40, r - 1.0, (3.3, 1.7))] if r > 1 else []) for r in (1, 3, 5)]
    ),
    "far": lambda: log_polar().translate(3e5, -2.5e5),
}


@pytest.mark.slow(keep=10)
@pytest.mark.parametrize(
    ("name", "extension"),
    [(name, extension) for name in DEVICES for extension in EXACT]
    + [(name, GDSII_OASIS[i % 2]) for i, name in enumerate(DEVICES)]
    + [("log-polar", "oas"), ("rings", "oas")],
)
def test_layout_read_again_is_same_device(tmp_path, name, extension):
    layout = DEVICES[name]()
    write_layout(layout, tmp_path / f"a.{extension}")
    again = read_layout(tmp_path / f"a.{extension}")
    normals = Device(seed=5, layout=layout).normals("prnu")

    np.testing.assert_array_equal(Device(seed=5, layout=again).normals("prnu"), normals)
    assert np.unique(normals).size == layout.n_sites
    part = np.random.default_rng(0).permutation(layout.n_sites)[: layout.n_sites // 2]
    np.testing.assert_array_equal(Device(seed=5, layout=again[part]).normals("prnu"), normals[part])
    write_layout(again, tmp_path / f"b.{extension}")
    twice = read_layout(tmp_path / f"b.{extension}")
    np.testing.assert_array_equal(Device(seed=5, layout=twice).normals("prnu"), normals)


def test_sites_on_database_grid_need_no_identity(tmp_path):
    write_layout(DEVICES["grid"](), tmp_path / "a.gds")

    assert "site_id" not in read_layout(tmp_path / "a.gds").columns


def test_missing_identity_in_gds_warns(tmp_path):
    layout = log_polar().with_columns(remark=np.array(["a" * 60] * log_polar().n_sites))

    with pytest.warns(LayoutWarning, match=r"does not contain the identity of the sites.*leave no room.*\.npz"):
        report = write_layout(layout, tmp_path / "a.gds")
    assert report.dropped_columns == ("site_id",)
