"""GDSII and OASIS files as chip designers use them: layer maps, cells and arrays, channels from filter layers."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from programs import run_programs
from registries import restored

import foveasim as fs
from foveasim._core.rings import site_ids
from foveasim.errors import ConfigError, FileError, GeometryError, LayoutWarning, ParameterError
from foveasim.layout import DERIVED_LAYERS, Layout
from foveasim.layout.files import _gdstk
from foveasim.layout.files._hierarchy import congruence_classes, find_arrays
from foveasim.layout.files._holes import hole_free_rings

gdstk = pytest.importorskip("gdstk")
klayout = pytest.importorskip("klayout.db")

pytestmark = pytest.mark.usefixtures("forked_readers")

GDSII_OASIS = ["gds", "oas"]
MAP = {
    "photosite": (77, 3),
    "filter_R": (10, 0),
    "filter_G": "11/2",
    "filter_2": 12,
    "well": {"layer": (20, 0), "inset_um": 0.2},
    "microlens": {"layer": (30, 0), "inset_um": 0.1, "corner_radius_um": 0.3},
    "metal_keep_out": {"layer": "40/1", "outset_um": 0.3},
    "trench": {"layer": (50, 0), "inset_um": 0.2, "outset_um": 0.12},
}
FILTERS = {(10, 0): 0, (11, 2): 1, (12, 0): 2}


@pytest.fixture(scope="module")
def bayer():
    grid = fs.layout.grid(n_x=24, n_y=15, pitch_um=2.2, fill_factor=0.8)
    return fs.layout.mosaic(grid, ("RG", "GB"))


@pytest.fixture(scope="module", params=GDSII_OASIS)
def chip(request, bayer, tmp_path_factory):
    path = tmp_path_factory.mktemp("chip") / f"chip.{request.param}"
    bayer.write(path, layers=MAP)
    return path


def assert_lossless(again, layout):
    np.testing.assert_array_equal(again.xy_um, np.round(layout.xy_um, 3))
    np.testing.assert_array_equal(again.ring_offsets, layout.ring_offsets)
    np.testing.assert_array_equal(again.site_offsets, layout.site_offsets)
    assert {*again.columns} - {"site_id"} == {*layout.columns}
    for name, column in layout.columns.items():
        np.testing.assert_array_equal(again.columns[name], column, err_msg=name)


def in_klayout(path):
    layout = klayout.Layout()
    layout.read(str(path))
    return layout


def region(layout, layer, datatype):
    """Return the flattened shapes of a layer."""
    found = layout.find_layer(layer, datatype)
    return klayout.Region(layout.top_cell().begin_shapes_rec(found)) if found is not None else klayout.Region()


def region_of(layout, chosen=slice(None)):
    """Return sites without holes as a region, rounded to nm."""
    return klayout.Region([
        klayout.Polygon([klayout.Point(round(x * 1e3), round(y * 1e3)) for x, y in p.exterior.coords[:-1]])
        for p in layout.polygons()[chosen]
    ])  # fmt: skip


# -- layers -----------------------------------------------------------------------------------------------------------


def test_layer_map_shapes_match_klayout(chip, bayer):
    other, outlines = in_klayout(chip), region_of(bayer)
    channel = bayer.channel
    expected = {
        (77, 3): outlines,
        (10, 0): region_of(bayer, channel == 0),
        (11, 2): region_of(bayer, channel == 1),
        (12, 0): region_of(bayer, channel == 2),
        (20, 0): outlines.sized(-200),
        (40, 1): outlines.sized(300),
        (50, 0): outlines.sized(120) - outlines.sized(-200),
    }
    assert {(i.layer, i.datatype) for i in other.layer_infos()} == {*expected, (30, 0)}
    for (layer, datatype), shapes in expected.items():
        found = region(other, layer, datatype)
        assert (layer == 50) or found.count() == shapes.count()
        assert (found ^ shapes).is_empty()
        assert found.area() == shapes.area()
        assert found.bbox() == shapes.bbox()


def trench_family(name):
    grid = fs.layout.grid(n_x=9, n_y=7, pitch_um=2.2, fill_factor=0.8)
    rings = fs.layout.log_polar(n_sectors=24, r_min_um=20.0, r_max_um=60.0)
    return {
        "grid": (fs.layout.mosaic(grid, "bayer"), {"outset_um": 0.12}),
        "outset beyond neighbours": (grid, {"outset_um": 1.5, "inset_um": 0.05}),
        "abutting": (fs.layout.grid(n_x=9, n_y=7, pitch_um=2.2), {"inset_um": 0.1}),
        "hexagons": (fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=3.0, trench_um=0.3), {"outset_um": 0.15}),
        "zones": (
            fs.layout.inset(fs.layout.zones(pitch_um=(2.0, 4.0), side_um=(16.0, 48.0)), 0.1),
            {"outset_um": 0.1},
        ),
        "octagons": (fs.layout.octagonal(n_x=6, n_y=5, pitch_um=3.0), {"inset_um": 0.12}),
        "rings": (rings, {"inset_um": 0.1}),
        "rings with gaps": (fs.layout.inset(rings, 0.1), {"outset_um": 0.08}),
    }[name]


TRENCHES = ("grid", "outset beyond neighbours", "abutting", "hexagons", "zones", "octagons", "rings", "rings with gaps")


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize(
    ("name", "extension", "hierarchy"),
    [
        (name, GDSII_OASIS[(i + hierarchy) % 2], hierarchy)
        for i, name in enumerate(TRENCHES)
        for hierarchy in (True, False)
    ],
)
def test_trench_matches_klayout_booleans(tmp_path, name, extension, hierarchy):
    layout, parameters = trench_family(name)
    sizes = {"well": {"layer": 2, "inset_um": 0.0}, "metal_keep_out": {"layer": 3, "outset_um": 0.0}}
    for other, parameter in (("well", "inset_um"), ("metal_keep_out", "outset_um")):
        sizes[other][parameter] = parameters.get(parameter, 0.0)
    layers = {"photosite": 1, "trench": {"layer": (50, 0), **parameters}, **sizes}
    layout.write(tmp_path / f"a.{extension}", layers=layers, hierarchy=hierarchy)
    other = in_klayout(tmp_path / f"a.{extension}")
    sites, kept, grown, trench = (region(other, layer, 0) for layer in (1, 2, 3, 50))

    assert (trench ^ (grown - kept)).is_empty()
    assert (trench & kept).is_empty()
    assert ((trench + sites) ^ grown).is_empty()
    assert max(polygon.num_points() for polygon in trench.each()) <= 8189
    assert fs.read_layout(tmp_path / f"a.{extension}").n_sites == layout.n_sites


def test_frames_between_curved_sites_have_exact_area(tmp_path):
    # Edges of neighbouring frames intersect off the database grid, where boolean operations of programs round.
    rings = fs.layout.inset(fs.layout.log_polar(n_sectors=40, r_min_um=20.0, r_max_um=82.4), 0.1)
    layers = {
        "photosite": 1,
        "metal_keep_out": {"layer": 3, "outset_um": 0.1},
        "trench": {"layer": 50, "outset_um": 0.1},
    }
    rings.write(tmp_path / "a.gds", layers=layers)
    polygons = gdstk.read_gds(tmp_path / "a.gds").cells[0].polygons
    sites, grown, frames = (sum(p.area() for p in polygons if p.layer == layer) for layer in (1, 3, 50))
    other = in_klayout(tmp_path / "a.gds")

    assert frames == pytest.approx(grown - sites, rel=1e-12)
    assert (region(other, 50, 0) ^ (region(other, 3, 0) - region(other, 1, 0))).sized(-1).is_empty()


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_trench_of_array_is_one_array(tmp_path, extension):
    layout = fs.layout.mosaic(fs.layout.grid(n_x=200, n_y=100, pitch_um=2.2, fill_factor=0.8), "bayer")
    layout.write(tmp_path / f"a.{extension}", layers={"photosite": 1, "trench": {"layer": 50, "outset_um": 0.15}})
    other = in_klayout(tmp_path / f"a.{extension}")
    (array,) = (i for i in other.top_cell().each_inst() if i.cell.name.startswith("TRENCH"))

    assert sorted((array.na, array.nb)) == [100, 200]
    assert (tmp_path / f"a.{extension}").stat().st_size < 1300


@restored(DERIVED_LAYERS)
def test_layer_of_layout_has_any_polygons(bayer, tmp_path):

    @DERIVED_LAYERS.register("seal ring")
    @fs.layout.LayoutLayer
    def seal_ring(layout, *, width_um=5.0):
        die = shapely.box(*layout.bounds_um)
        assert "channel" in layout.columns
        return [die.buffer(width_um, join_style="mitre") - die, shapely.MultiPolygon()]

    bayer.write(tmp_path / "a.gds", layers={"photosite": 1, "seal ring": {"layer": 9, "width_um": 2.0}})
    other = in_klayout(tmp_path / "a.gds")
    ring, sites = (region(other, layer, 0) for layer in (9, 1))
    x0, y0, x1, y1 = np.rint(np.array(bayer.bounds_um) * 1e3)

    assert ring.area() == (x1 - x0 + 4000) * (y1 - y0 + 4000) - (x1 - x0) * (y1 - y0)
    assert (ring & sites).is_empty()


@pytest.mark.parametrize(
    ("layout", "parameters", "match"),
    [
        ("grid", {}, r"'layers\[trench\]\.outset_um' or 'inset_um' must be positive, got 0\.0 µm; the gap between sites"),
        ("grid", {}, r"is 0\.232 µm, for example: outset_um=0\.116"),
        ("abutting", {}, "the sites have no gaps, for example: inset_um=0.1"),
        ("grid", {"outset_um": -0.1}, r"'layers\[trench\]\.outset_um' must be >= 0"),
        ("grid", {"inset_um": "x"}, r"'layers\[trench\]\.inset_um' must be one number"),
        ("grid", {"width_um": 1.0}, "must have the keys layer, outset_um, inset_um only, got 'width_um'"),
    ],
)  # fmt: skip
def test_invalid_trenches_are_rejected(tmp_path, layout, parameters, match):
    with pytest.raises(ParameterError, match=match):
        trench_family(layout)[0].write(
            tmp_path / "a.gds", layers={"photosite": 1, "trench": {"layer": 50, **parameters}}
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shapes", [None, "x", [1.0], [shapely.Point(0, 0)], [shapely.LineString([(0, 0), (1, 1)])]])
@restored(DERIVED_LAYERS)
def test_layer_of_layout_requires_polygons(bayer, tmp_path, shapes):
    DERIVED_LAYERS.register("frame", fs.layout.LayoutLayer(lambda _: shapes))
    with pytest.raises(ParameterError, match="derived layer 'frame' must return a sequence of shapely polygons"):
        bayer.write(tmp_path / "a.gds", layers={"photosite": 1, "frame": 2})


def test_microlens_has_area_of_rounded_square(chip, bayer):
    side_um = np.sqrt(bayer.area_um2[0]) - 0.2
    # The corners lose (4 - π) r², apart from the chords of the arcs and rounding.
    expected_um2 = bayer.n_sites * (side_um**2 - (4.0 - np.pi) * 0.3**2)

    assert region(in_klayout(chip), 30, 0).area() * 1e-6 == pytest.approx(expected_um2, rel=2e-3)


def test_pixel_cells_form_arrays(chip, bayer):
    other = in_klayout(chip)
    arrays = list(other.top_cell().each_inst())

    assert other.top_cell().name == "SENSOR"
    assert sorted(cell.name for cell in other.each_cell()) == ["PIXEL_0", "PIXEL_1", "PIXEL_2", "SENSOR", "TRENCH_3"]
    assert sum(max(i.na, 1) * max(i.nb, 1) for i in arrays if i.cell.name != "TRENCH_3") == bayer.n_sites
    assert len(arrays) <= 5
    assert not any(other.top_cell().shapes(k).size() for k in other.layer_indexes())
    assert chip.stat().st_size < 4000


def test_layer_map_round_trips_without_options(chip, bayer):
    assert_lossless(fs.read_layout(chip), bayer)


def test_layer_map_reads_its_own_file(chip, bayer):
    assert_lossless(fs.read_layout(chip, layers=MAP), bayer)


def test_derived_layer_can_be_read(chip, bayer):
    wells = fs.read_layout(chip, layer=(20, 0))

    assert wells.n_sites == bayer.n_sites
    np.testing.assert_allclose(wells.area_um2, (np.sqrt(bayer.area_um2[0]) - 0.4) ** 2, rtol=1e-3)


def test_several_layers_are_read_together(chip, bayer):
    layout = fs.read_layout(chip, layer=[(10, 0), "12/0"])

    assert layout.n_sites == np.count_nonzero(bayer.channel != 1)


def test_datatype_is_fixed_by_layer_pair(bayer, tmp_path):
    bayer.write(tmp_path / "a.gds", layer="5/7")

    assert [(i.layer, i.datatype) for i in in_klayout(tmp_path / "a.gds").layer_infos()] == [(5, 7)]
    assert_lossless(fs.read_layout(tmp_path / "a.gds"), bayer)


def test_layout_with_holes_round_trips_layers(tmp_path):
    square = shapely.box(0, 0, 4, 4) - shapely.box(1, 1, 2, 2)
    places = [(x, y) for y in range(0, 50, 5) for x in range(0, 60, 5)]
    layout = Layout.from_polygons([shapely.transform(square, lambda xy, at=at: xy + at) for at in places])
    layout.write(tmp_path / "a.gds", layers={"photosite": 1, "well": {"layer": 2, "inset_um": 0.25}, "microlens": 3})
    other = in_klayout(tmp_path / "a.gds")
    again = fs.read_layout(tmp_path / "a.gds")

    assert shapely.equals(again.polygons(), layout.polygons()).all()
    assert region(other, 1, 0).area() == 120 * 15_000_000
    assert (region(other, 2, 0) ^ region(other, 1, 0).sized(-250)).is_empty()
    assert region(other, 3, 0).area() == 120 * 16_000_000
    assert (tmp_path / "a.gds").stat().st_size < 2500


def test_filter_names_of_filter_set(bayer, tmp_path):
    names = ("Ye", "Cy", "Mg")
    layers = {"photosite": 1, "filter_Ye": 2, "filter_Cy": 3, "filter_Mg": 4}
    bayer.write(tmp_path / "a.oas", layers=layers, filter_names=names)
    channels = {(2, 0): "Ye", (3, 0): "Cy", (4, 0): "Mg"}
    again = fs.read_layout(tmp_path / "a.oas", layer=1, channels=channels, filter_names=names)

    assert (again.channel == bayer.channel).all()


@restored(DERIVED_LAYERS)
def test_registered_derived_layer_is_written(bayer, tmp_path):
    DERIVED_LAYERS.register("contact", lambda layout, *, side_um=0.5: shapely.buffer(
        shapely.points(layout.centroid_um), 0.5 * side_um, cap_style="square"
    ))  # fmt: skip
    bayer.write(tmp_path / "a.gds", layers={"photosite": 1, "contact": {"layer": 9, "side_um": 0.2}})

    assert region(in_klayout(tmp_path / "a.gds"), 9, 0).area() == bayer.n_sites * 200**2


@pytest.mark.parametrize(
    ("layers", "match"),
    [
        ({}, "'layers' must be a mapping of names to layers"),
        ({"well": 2}, "'layers' must contain the layer 'photosite'"),
        ({"photosite": 1, "metal keep-out": 2}, "got 'metal keep-out'; did you mean 'metal_keep_out'?"),
        ({"photosite": 1, "nonsense": 2}, "possible: 'photosite', 'filter_R', .*, 'well'"),
        ({"photosite": 1, "well": "1/0"}, "'photosite' and 'well' are both 1/0"),
        ({"photosite": "77:3"}, r"'layers\[photosite\]' must be a layer, such as \(77, 3\) or '77/3', got '77:3'"),
        ({"photosite": (1, 2, 3)}, "must be a layer"),
        ({"photosite": True}, "must be a layer"),
        ({"photosite": 40_000}, r"'layers\[photosite\]' must be <= 32767"),
        ({"photosite": 1, "well": {"layer": 2, "inset": 1.0}}, "must have the keys layer, inset_um only, got 'inset'"),
        ({"photosite": 1, "well": {"layer": 2, "inset_um": -1.0}}, r"'layers\[well\]\.inset_um' must be >= 0"),
        ({"photosite": 1, "filter_X": 2}, "must have channels as numbers, or as names of filter_names, got 'X'"),
        ({"photosite": 1, "filter_R": 2, "filter_0": 3, "filter_G": 4, "filter_B": 5}, "one layer per channel"),
        ({"photosite": 1, "filter_R": 2, "filter_B": 5}, "must have a filter layer for channel 1 of site 1"),
    ],
)
def test_invalid_layer_maps_are_rejected(bayer, tmp_path, layers, match):
    with pytest.raises(ParameterError, match=match):
        bayer.write(tmp_path / "a.gds", layers=layers)
    assert not list(tmp_path.iterdir())


def test_filter_layers_require_channels(tmp_path):
    grid = fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0)
    with pytest.raises(ParameterError, match="without the column 'channel'; add it, for example with"):
        grid.write(tmp_path / "a.gds", layers={"photosite": 1, "filter_R": 2})


def test_vanishing_derived_shape_names_site(tmp_path):
    layout = Layout.from_rectangles([[0, 0], [9, 0], [18, 0]], [5.0, 0.3, 5.0])
    with pytest.raises(GeometryError, match="layer 'well': the shape of site 1 would vanish") as caught:
        layout.write(tmp_path / "a.gds", layers={"photosite": 1, "well": {"layer": 2, "inset_um": 0.2}})
    assert caught.value.site_ids == (1,)


@restored(DERIVED_LAYERS)
def test_derived_layer_requires_polygon_per_site(bayer, tmp_path):
    DERIVED_LAYERS.register("frame", lambda layout: layout.polygons()[:-1])
    with pytest.raises(
        ParameterError, match=r"derived layer 'frame' must return one polygon for each of the \d+ sites"
    ):
        bayer.write(tmp_path / "a.gds", layers={"photosite": 1, "frame": 2})


def test_layer_map_file_is_read(bayer, tmp_path):
    (tmp_path / "map.yaml").write_text("photosite: 77/3\nfilter_R: 10\nfilter_G: 11/0\nfilter_B: {layer: 12/0}\n")
    bayer.write(tmp_path / "a.gds", layers=tmp_path / "map.yaml")

    assert {(i.layer, i.datatype) for i in in_klayout(tmp_path / "a.gds").layer_infos()} == {
        (77, 3),
        (10, 0),
        (11, 0),
        (12, 0),
    }


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (None, "no such file"),
        ("photosite", "must contain settings as 'key: value'"),
        ("photosite: 1\nphotosite: 2\n", "duplicate key 'photosite'"),
        ("photosite: 1\nwel: 2\n", "got 'wel'; did you mean 'well'"),
        ("photosite: 1/x\n", "must be a layer"),
        ("photosite: !!python/name:os.system\n", "is not"),
    ],
)
def test_invalid_layer_map_files_are_rejected(bayer, tmp_path, text, match):
    if text is not None:
        (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(ConfigError, match=match):
        bayer.write(tmp_path / "a.gds", layers=str(tmp_path / "map.yaml"))


# -- channels of other chips ------------------------------------------------------------------------------------------


@pytest.fixture
def foreign(chip, tmp_path):
    """Return the chip after a program that preserves no properties and adds a second top cell."""
    library = (gdstk.read_gds if chip.suffix == ".gds" else gdstk.read_oas)(chip)
    for cell in library.cells:
        for element in [*cell.polygons, *cell.references]:
            element.properties = []
    library.new_cell("LOGO").add(gdstk.rectangle((0, 0), (1, 1), 99))
    path = tmp_path / chip.name
    (library.write_gds if chip.suffix == ".gds" else library.write_oas)(path)
    return path


def by_position(layout):
    return layout.sort_by(np.round(layout.centroid_um[:, 1], 3), np.round(layout.centroid_um[:, 0], 3))


def test_foreign_chip_without_filters_has_no_channel(foreign, bayer):
    layout = fs.read_layout(foreign, layer=(77, 3), cell="SENSOR")

    assert layout.n_sites == bayer.n_sites
    assert list(layout.columns) == []
    with pytest.raises(fs.errors.SimulationError, match="read it from the filter layers of a GDSII or OASIS file with"):
        fs.Sensor(layout, filters="rgb")


@pytest.mark.parametrize(
    "options",
    [
        {"layer": (77, 3), "channels": FILTERS},
        {"layer": "77/3", "channels": {"10/0": "R", 11: "G", (12, 0): "B"}},
        {"layers": MAP},
        {"layer": [*FILTERS], "channels": FILTERS},
    ],
    ids=["numbers", "names", "map", "filters only"],
)
def test_filter_layers_give_channels(foreign, bayer, options):
    layout = by_position(fs.read_layout(foreign, cell="SENSOR", **options))

    np.testing.assert_array_equal(layout.channel, by_position(bayer).channel)
    fs.Sensor(layout, filters="rgb")


def test_large_filter_shape_covers_several_sites(tmp_path):
    library = gdstk.Library()
    squares = [gdstk.rectangle((x, 0), (x + 2, 2), 1) for x in range(0, 12, 3)]
    library.new_cell("A").add(*squares, gdstk.rectangle((-1, -1), (5.5, 3), 2), gdstk.rectangle((5.5, -1), (12, 3), 3))
    library.write_gds(tmp_path / "a.gds")

    assert fs.read_layout(tmp_path / "a.gds", layer=1, channels={2: "B", 3: "R"}).channel.tolist() == [2, 2, 0, 0]


def test_filter_of_site_covers_overlapping_site(tmp_path):
    library = gdstk.Library()
    library.new_cell("A").add(*(gdstk.rectangle((0, 0), (4, 4), layer) for layer in (1, 2)))
    library.cells[0].add(gdstk.rectangle((1, 1), (2, 2), 1))
    library.write_gds(tmp_path / "a.gds")

    assert fs.read_layout(tmp_path / "a.gds", layer=1, channels={2: "B"}).channel.tolist() == [2, 2]


@pytest.mark.parametrize("layer", [2, 3])
def test_filters_with_equal_outlines_conflict(tmp_path, layer):
    # One filter is in the cell of the photosite, the other in its parent.
    library = gdstk.Library()
    pixel = library.new_cell("PIXEL").add(*(gdstk.rectangle((0, 0), (2, 2), number) for number in (1, 2)))
    library.new_cell("A").add(gdstk.Reference(pixel, columns=9, rows=9, spacing=(3, 3)))
    library["A"].add(gdstk.rectangle((3, 3), (5, 5), layer))
    library.write_gds(tmp_path / "a.gds")
    channels = {2: "B", 3: "R"}
    if layer == 2:
        assert (fs.read_layout(tmp_path / "a.gds", layer=1, channels=channels).channel == 2).all()
    else:
        with pytest.raises(FileError, match=r"has filters of several channels over site \d+ at \(4, 4\) µm"):
            fs.read_layout(tmp_path / "a.gds", layer=1, channels=channels)


def test_letters_of_filter_layers_are_checked(tmp_path):
    library = gdstk.Library()
    cell = library.new_cell("A")
    for k, layer in enumerate((2, 3, 4)):
        cell.add(*(gdstk.rectangle((2 * k, 0), (2 * k + 2, 2), number) for number in (1, layer)))
    library.write_gds(tmp_path / "a.gds")
    path, letters = tmp_path / "a.gds", {2: "R", 3: "G", 4: "B"}
    maps = ({"channels": letters}, {"layers": {"photosite": 1, "filter_R": 2, "filter_G": 3, "filter_B": 4}})
    curves = [fs.sensor.ConstantCurve(0.5)] * 3
    exchanged = fs.FilterSet(curves, ("blue", "green", "red"))
    for options in maps:
        layout = fs.read_layout(path, layer=1, **options)
        assert fs.Sensor(layout, filters="rgb").n_filters == 3
        with pytest.raises(fs.errors.SimulationError, match="filter 0 of the sensor is 'blue', not of the colour 'R'"):
            fs.Sensor(layout, filters=exchanged)
    for options in ({"channels": {2: 0, 3: 1, 4: 2}}, {"channels": letters, "filter_names": ("R", "G", "B")}):
        fs.Sensor(fs.read_layout(path, layer=1, **options), filters=exchanged)  # in the order of the caller


def test_site_without_filter_is_reported(foreign):
    with pytest.raises(FileError, match=r"has \d+ of 360 photosites without a filter, first site \d+ at"):
        fs.read_layout(foreign, cell="SENSOR", layer=(77, 3), channels={(10, 0): "R", (11, 2): "G"})


def test_overlapping_filters_are_reported(tmp_path):
    library = gdstk.Library()
    library.new_cell("A").add(*(gdstk.rectangle((0, 0), (2, 2), layer) for layer in (1, 2, 3)))
    library.write_gds(tmp_path / "a.gds")
    with pytest.raises(FileError, match=r"has filters of several channels over site 0 at \(1, 1\) µm"):
        fs.read_layout(tmp_path / "a.gds", layer=1, channels={2: "B", 3: "R"})


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({}, "several layers, 10/0, 11/2, 12/0, 20/0, 30/0, ...; select one with layer="),
        ({"layer": (77, 4)}, "has no shape on layer 77/4; its layers with shapes are 10/0, 11/2"),
        ({"layer": [77, 5]}, "has no shape on layer 5;"),
        ({"layer": (77, 3), "cell": "TOP"}, "has no cell 'TOP'"),
        ({"layer": []}, "'layer' must be one or more layers"),
        ({"layer": 1.5}, "'layer' must be a layer"),
        ({"layer": 77, "channels": {"10/0": "X"}}, "the names are R, G, B, W"),
        ({"layer": 77, "channels": {}}, "'channels' must be a mapping of layers to channels"),
        ({"layer": 77, "channels": {10: 0}, "filter_names": ["R", "R"]}, "'filter_names' must be different strings"),
    ],
)
def test_invalid_reading_options_are_rejected(foreign, options, match):
    with pytest.raises((FileError, ParameterError), match=match):
        fs.read_layout(foreign, **{"cell": "SENSOR", **options})


# -- hierarchy --------------------------------------------------------------------------------------------------------


def family(name):
    rng = np.random.default_rng(8)
    grid = fs.layout.grid(n_x=40, n_y=30, pitch_um=2.0)
    return {
        "grid": lambda: grid,
        "one row": lambda: fs.layout.grid(n_x=40, n_y=1, pitch_um=2.0),
        "hexagons": lambda: fs.layout.hexagonal(n_columns=40, n_rows=31, pitch_um=3.0),
        "zones": lambda: fs.layout.zones(pitch_um=(2.0, 4.0, 8.0), side_um=(48.0, 144.0, 288.0)),
        "octagons": lambda: fs.layout.octagonal(n_x=12, n_y=10, pitch_um=3.0),
        "rings": lambda: fs.layout.log_polar(n_sectors=40, r_min_um=20.0, r_max_um=82.4),
        "x_trans": lambda: fs.layout.mosaic(grid, "x_trans"),
        "quad_bayer": lambda: fs.layout.mosaic(grid, "quad_bayer"),
        "nona": lambda: fs.layout.mosaic(grid, "nona"),
        "hole": lambda: fs.layout.mosaic(grid, "quad_bayer")[np.hypot(*grid.centroid_um.T) > 12.0],
        "split": lambda: fs.layout.split(grid, n_x=2, n_y=2),
        "shuffled": lambda: grid[rng.permutation(grid.n_sites)],
        "random integers": lambda: grid.with_columns(a=rng.integers(-(2**62), 2**62, grid.n_sites)),
        "random numbers": lambda: grid.with_columns(a=rng.normal(size=grid.n_sites)),
        "flags": lambda: grid.with_columns(is_dead=rng.random(grid.n_sites) < 0.02, name=np.repeat(["a", "b"], 600)),
        "backwards": lambda: grid[::-1],
        "one channel": lambda: grid.with_columns(channel=np.full(grid.n_sites, 3)),
    }[name]()


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize(
    ("name", "max_bytes", "extensions"),
    [
        ("grid", 600, "gds oas"),
        ("one row", 600, "oas"),
        ("hexagons", 4500, "gds"),
        ("zones", 4000, "oas"),
        ("octagons", 800, "gds"),
        ("rings", 200_000, "oas"),
        ("x_trans", 7000, "gds"),
        ("quad_bayer", 3000, "oas"),
        ("nona", 8000, "gds"),
        ("hole", 20_000, "oas"),
        ("split", 1500, "gds"),
        ("shuffled", 170_000, "oas"),
        ("random integers", 250_000, "gds oas"),
        ("random numbers", 250_000, "gds"),
        ("flags", 30_000, "gds oas"),
        ("backwards", 600, "gds"),
        ("one channel", 600, "oas"),
    ],
)
def test_hierarchical_files_are_lossless_and_small(tmp_path, name, max_bytes, extensions):
    layout = family(name)
    for extension in extensions.split():
        report = layout.write(tmp_path / f"a.{extension}")

        assert report.dropped_columns == ()
        assert_lossless(fs.read_layout(tmp_path / f"a.{extension}"), layout)
        assert (tmp_path / f"a.{extension}").stat().st_size < max_bytes


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_flat_file_has_same_content(bayer, tmp_path, extension):
    for hierarchy in (True, False):
        bayer.write(tmp_path / f"{hierarchy}.{extension}", layers=MAP, hierarchy=hierarchy)
    deep, flat = (in_klayout(tmp_path / f"{hierarchy}.{extension}") for hierarchy in (True, False))

    assert [cell.name for cell in flat.each_cell()] == ["SENSOR"]
    for info in deep.layer_infos():
        a, b = (region(other, info.layer, info.datatype) for other in (deep, flat))
        assert a.count() == b.count()
        assert (a ^ b).is_empty()
    assert_lossless(fs.read_layout(tmp_path / f"False.{extension}"), bayer)


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize(
    ("name", "extension", "then"),
    [
        ("grid", "gds", "oas"),
        ("one row", "oas", "oas"),
        ("hexagons", "gds", "gds"),
        ("x_trans", "gds", "oas"),
        ("flags", "oas", "oas"),
        ("flags", "gds", "gds"),
    ],
)
def test_arrays_survive_klayout(tmp_path, name, extension, then):
    layout = family(name)
    layout.write(tmp_path / f"a.{extension}")
    in_klayout(tmp_path / f"a.{extension}").write(str(tmp_path / f"b.{then}"))
    again = fs.read_layout(tmp_path / f"b.{then}")

    np.testing.assert_array_equal(again.site_bounds_um, fs.read_layout(tmp_path / f"a.{extension}").site_bounds_um)
    assert {*again.columns} - {"site_id"} == {*layout.columns}
    for column in layout.columns:
        np.testing.assert_array_equal(again.columns[column], layout.columns[column])
    np.testing.assert_array_equal(site_ids(again), site_ids(layout))


def test_klayout_shows_numbers_of_array(tmp_path):
    fs.layout.grid(n_x=7, n_y=5, pitch_um=2.0).write(tmp_path / "a.gds")
    other = in_klayout(tmp_path / "a.gds")
    (instance,) = other.top_cell().each_inst()

    assert instance.property(1) == "photosites 0+1i+7j of 7x5"
    assert instance.property(2) == "row=0+1j column=0+1i readout_line=0+1i"


def edited_array(tmp_path, edit):
    """Return the layout of a file with one array after another program changed the reference."""
    fs.layout.grid(n_x=7, n_y=5, pitch_um=2.0).write(tmp_path / "a.gds")
    library = gdstk.read_gds(tmp_path / "a.gds")
    sensor = next(cell for cell in library.cells if cell.name == "SENSOR")
    edit(library, sensor, sensor.references[0])
    library.write_gds(tmp_path / "b.gds")
    return fs.read_layout(tmp_path / "b.gds")


def test_changed_array_has_no_columns(tmp_path):
    def edit(_library, _sensor, reference):
        reference.repetition = gdstk.Repetition(columns=6, rows=5, spacing=(2, 2))

    layout = edited_array(tmp_path, edit)

    assert layout.n_sites == 30
    assert list(layout.columns) == []


@pytest.mark.parametrize(
    "text",
    [
        "photosites 0+1i+7j of 5x7",
        "photosites 0-1i+7j of 7x5",
        "photosites 0",
        "photosite 3",
        "photosites -1 of 7x5",
        "x",
    ],
)
def test_invalid_array_numbers_are_ignored(tmp_path, text):
    layout = edited_array(tmp_path, lambda _library, _sensor, reference: reference.set_gds_property(1, text))

    assert layout.n_sites == 35
    assert list(layout.columns) == []


def test_repeated_sensor_has_all_sites(tmp_path):
    def edit(library, sensor, _reference):
        library.new_cell("DIE").add(
            gdstk.Reference(sensor, (0, 0)), gdstk.Reference(sensor, (0, 100), rotation=np.pi / 2)
        )

    layout = edited_array(tmp_path, edit)

    assert layout.n_sites == 70
    assert layout.columns["column"].tolist() == 2 * (5 * [*range(7)])
    assert layout.centroid_um[:3].round(6).tolist() == [[-6.0, -4.0], [-4.0, -4.0], [-2.0, -4.0]]
    assert layout.centroid_um[35:38].round(6).tolist() == [[4.0, 94.0], [4.0, 96.0], [4.0, 98.0]]


def test_coordinates_at_limit_are_not_arrays(tmp_path):
    # The position behind the last column of an array would exceed 32 bits.
    limit_um = (2**31 - 1) * 1e-3
    layout = Layout.from_rectangles(np.stack((limit_um - 5.0 - 10.0 * np.arange(20.0)[::-1], np.zeros(20)), 1), 4.0)
    layout.write(tmp_path / "a.gds")
    arrays = [e for e in gdstk.read_gds(tmp_path / "a.gds").cells[0].references if e.repetition.size > 1]
    behind = [e.origin[0] + e.repetition.columns * e.repetition.spacing[0] for e in arrays]

    assert max(behind, default=0.0) <= limit_um
    assert_lossless(fs.read_layout(tmp_path / "a.gds"), layout)


@st.composite
def lattices(draw):
    """Return positions, classes and an integer column of overlapping random lattices, shuffled."""
    parts = []
    for kind in range(draw(st.integers(1, 3))):
        n_x, n_y = draw(st.integers(1, 6)), draw(st.integers(1, 6))
        x0, y0, dx, dy = (draw(st.integers(-50, 50)) for _ in range(4))
        j, i = np.divmod(np.arange(n_x * n_y), n_x)
        parts.append(
            np.stack((x0 + i * (dx or 1), y0 + j * (dy or 1), np.full(i.size, kind), draw(st.integers(-3, 3)) * i + j))
        )
    table = np.concatenate(parts, axis=1).T
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return rng.permutation(table) if draw(st.booleans()) else table


@settings(max_examples=examples(200))
@given(lattices())
def test_arrays_reproduce_every_site_once(table):
    columns = {"a": table[:, 3]}
    arrays = find_arrays(table[:, 2], table[:, :2], columns, 10**6)
    seen = []
    for k in range(arrays.first.size):
        first = arrays.first[k]
        for j in range(arrays.n_y[k]):
            for i in range(arrays.n_x[k]):
                site = first + i * arrays.number_steps[k, 0] + j * arrays.number_steps[k, 1]
                seen.append(site)
                assert (table[site, :2] == table[first, :2] + arrays.pitch[k] * (i, j)).all()
                assert table[site, 2] == table[first, 2]
                step_i, step_j = arrays.column_steps["a"][k]
                assert table[site, 3] == table[first, 3] + i * step_i + j * step_j

    assert sorted(seen) == list(range(len(table)))


@settings(max_examples=examples(100))
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(-9, 9), st.integers(-9, 9)), min_size=1, max_size=30))
def test_congruent_sites_are_equal_up_to_translation(sites):
    shapes = [
        [(0, 0), (2, 0), (2, 2)],
        [(0, 0), (2, 0), (0, 2)],
        [(2, 0), (2, 2), (0, 0)],
        [(0, 0), (2, 0), (2, 2), (0, 2)],
    ]
    rings = [np.array(shapes[s]) + np.array([x, y]) for s, x, y in sites]
    offsets = np.concatenate(([0], np.cumsum([len(r) for r in rings])))
    class_of, origin = congruence_classes(np.concatenate(rings), offsets, np.arange(offsets.size))

    for a, ring_a in enumerate(rings):
        for b, ring_b in enumerate(rings):
            is_same = ring_a.shape == ring_b.shape and (ring_a - ring_a.min(0) == ring_b - ring_b.min(0)).all()
            assert (class_of[a] == class_of[b]) == is_same
    assert origin.tolist() == [r.min(0).tolist() for r in rings]


@settings(max_examples=examples(100))
@given(st.lists(st.tuples(st.integers(3, 12), st.integers(3, 12), st.integers(0, 2**32)), min_size=1, max_size=5))
def test_parts_of_holed_sites_cover_them(sites):
    polygons = []
    for k, (n, n_hole, seed) in enumerate(sites):
        rng = np.random.default_rng(seed)
        rings = [
            (radius_um * rng.uniform(0.4, 1.0, m)) * np.exp(2j * np.pi * (np.arange(m) + rng.random()) / m)
            for radius_um, m in ((5.0, n), (1.0, n_hole))
        ]
        outline, hole = (shapely.Polygon(np.stack((r.real + 20.0 * k, r.imag), 1).round(3)) for r in rings)
        # Some outlines are concave, and some holes reach beyond them; the last one has two holes.
        polygons.append(outline - hole if outline.contains(hole) else outline)
    polygons.append(shapely.box(-20, 0, -10, 9) - shapely.box(-19, 1, -18, 2) - shapely.box(-12, 5, -11, 8))
    layout = Layout.from_polygons(polygons)
    site, part, n_parts, rings_um = hole_free_rings(layout, None)
    parts = shapely.polygons([shapely.LinearRing(ring) for ring in rings_um])

    assert shapely.is_valid(parts).all()
    assert (np.sort(site) == site).all()
    for k, polygon in enumerate(polygons):
        own = parts[site == k]
        assert part[site == k].tolist() == ([0] if len(own) == 1 else [*range(1, len(own) + 1)])
        assert (n_parts[site == k] == (0 if len(own) == 1 else len(own))).all()
        assert shapely.equals(shapely.coverage_union_all(own), polygon)
        assert shapely.area(own).sum() == pytest.approx(polygon.area, rel=1e-12)


# -- rounding ---------------------------------------------------------------------------------------------------------


def test_default_database_unit_is_nanometre(tmp_path):
    fs.layout.log_polar(n_sectors=40, r_min_um=20.0, r_max_um=82.4).write(tmp_path / "a.gds")

    assert in_klayout(tmp_path / "a.gds").dbu == pytest.approx(1e-3)


def test_coarse_database_unit_warns_with_site(tmp_path):
    layout = Layout.from_rectangles([[0.0, 0.0], [9.0, 0.0], [18.0016, 0.0]], 4.0)
    with pytest.warns(
        LayoutWarning, match=r"unit of 4 nm moves a vertex of site 2 by 1\.6 nm, more than 1 nm; use dbu_um=0\.001"
    ):
        layout.write(tmp_path / "a.gds", dbu_um=0.004)


@pytest.mark.filterwarnings("error")
def test_rounding_within_tolerance_is_silent(tmp_path):
    fs.layout.grid(n_x=9, n_y=9, pitch_um=2.0).write(tmp_path / "a.gds", dbu_um=0.005)


# -- untrusted files --------------------------------------------------------------------------------------------------


def test_truncated_hierarchical_file_is_rejected(chip, tmp_path):
    (tmp_path / "a").write_bytes(chip.read_bytes()[:-10])
    with pytest.raises(FileError, match=r"truncated|corrupt"):
        fs.read_layout(tmp_path / "a")


def read_with_limit(path, n_sites, layers, filters):
    """Read with memory for a number of squares."""
    return _gdstk.read(
        str(path),
        limit=lambda *_: None,
        is_oasis=path.suffix == ".oas",
        layers=layers,
        filters=filters,
        cell=None,
        max_sites=1000,
        max_memory_bytes=n_sites * (4 * _gdstk.VERTEX_BYTES + _gdstk.POLYGON_BYTES),
        max_text_bytes=10_000,
        max_cpu_s=10,
    )


def test_only_photosites_count_for_limit(chip, bayer):
    filters = list(FILTERS)
    _, (_, counts, tags, _, _, other_counts, _) = read_with_limit(chip, bayer.n_sites, [(77, 3)], filters)

    assert counts.size == bayer.n_sites
    assert other_counts.size == 0
    assert sorted(tags[:, 8]) == sorted(bayer.channel)
    with pytest.raises(_gdstk.FormatError, match="has more than the maximum for a file of its size: 360 sites"):
        read_with_limit(chip, bayer.n_sites - 1, [(77, 3)], filters)


def test_filters_of_other_outlines_count_for_limit(chip, bayer):
    # The wells are read as photosites, so that the outlines of the filters differ.
    with pytest.raises(_gdstk.FormatError, match="has more than the maximum for a file of its size: 720 sites"):
        read_with_limit(chip, 2 * bayer.n_sites - 1, [(20, 0)], list(FILTERS))

    assert read_with_limit(chip, 2 * bayer.n_sites, [(20, 0)], list(FILTERS))[1][4].shape == (4 * bayer.n_sites, 2)


def test_arrays_of_other_layers_are_not_expanded(tmp_path):
    library = gdstk.Library()
    contact = library.new_cell("CONTACT").add(gdstk.rectangle((0, 0), (0.1, 0.1), 9))
    top = library.new_cell("A").add(gdstk.rectangle((0, 0), (2, 2), 1))
    top.add(*(gdstk.Reference(contact, columns=30_000, rows=30_000, spacing=(1, 1)) for _ in range(9)))
    library.write_gds(tmp_path / "a.gds")

    assert fs.read_layout(tmp_path / "a.gds", layer=1).n_sites == 1


def test_small_file_of_huge_array_is_rejected(tmp_path):
    fs.layout.grid(n_x=7, n_y=5, pitch_um=2.0).write(tmp_path / "a.gds")
    data = (tmp_path / "a.gds").read_bytes()
    assert data.count(struct.pack(">hh", 7, 5)) == 1
    (tmp_path / "b.gds").write_bytes(data.replace(struct.pack(">hh", 7, 5), struct.pack(">hh", 32767, 32767)))
    with pytest.raises(FileError, match="has more than the maximum of 50000000 sites"):
        fs.read_layout(tmp_path / "b.gds")


# -- files of other programs: other encodings, invalid outlines -------------------------------------------------------


def test_latin_1_properties_are_ignored(tmp_path):
    library = gdstk.Library()
    top, pixel = library.new_cell("TOP"), library.new_cell("PIXEL")
    pixel.add(gdstk.rectangle((0, 0), (2, 2)))
    polygon, reference = gdstk.rectangle((10, 0), (12, 2)), gdstk.Reference(pixel, (20, 0))
    array = gdstk.Reference(pixel, (30, 0), columns=2, rows=1, spacing=(5, 5))
    for element in (polygon, reference, array):
        element.set_gds_property(1, "size 5 #m")
        element.set_gds_property(2, 'width=5 unit="#m"')
    top.add(polygon, reference, array)
    library.write_gds(tmp_path / "a.gds")
    data = (tmp_path / "a.gds").read_bytes()
    (tmp_path / "a.gds").write_bytes(data.replace(b"#", "µ".encode("latin-1")))

    layout = fs.read_layout(tmp_path / "a.gds")

    assert sorted(layout.centroid_um[:, 0].tolist()) == [11.0, 21.0, 31.0, 36.0]
    assert not {"width", "unit"} & {*layout.columns}


#: Quadrilaterals whose edges cross at (0.5, 0.5).
BOW_TIE = np.array([(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
LOPSIDED = np.array([(-1.5, -1.5), (0.5, 0.5), (0.5, -0.5), (-1.5, 1.5)]) + 0.5


@pytest.fixture(params=GDSII_OASIS)
def invalid_file(request, tmp_path):
    """Five sites with filters, of which the second and the fourth cross themselves."""
    library = gdstk.Library()
    top = library.new_cell("TOP")
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    for i, outline in enumerate((square, BOW_TIE, square, LOPSIDED, square)):
        points = outline + np.array([1.0 + 4.0 * i, 0.0])
        top.add(gdstk.Polygon(points, layer=77), gdstk.Polygon(points, layer=10 + i % 2))
    path = tmp_path / f"a.{request.param}"
    library.write_oas(path) if request.param == "oas" else library.write_gds(path)
    return path


OPTIONS = {"layer": 77, "channels": {10: 0, 11: 1}}
PLACES = r"2 of 5 outlines cross themselves or have no area, site 1 at \(5\.5, 0\.5\) µm, site 3 at \(13\.5, 0\.5\) µm"


def test_all_invalid_outlines_are_listed(invalid_file):
    with pytest.raises(FileError, match=f"{PLACES}; correct them, or pass invalid='skip' or invalid='repair'$"):
        fs.read_layout(invalid_file, **OPTIONS)
    with pytest.raises(ParameterError, match="'invalid' must be one of"):
        fs.read_layout(invalid_file, **OPTIONS, invalid="ignore")


def test_invalid_outlines_are_skipped(invalid_file):
    with pytest.warns(LayoutWarning, match=f"{PLACES}: 2 are skipped"):
        layout = fs.read_layout(invalid_file, **OPTIONS, invalid="skip")

    np.testing.assert_allclose(layout.centroid_um, [(1.5, 0.5), (9.5, 0.5), (17.5, 0.5)])
    np.testing.assert_allclose(layout.area_um2, 1.0)
    assert layout.channel.tolist() == [0, 0, 0]


def test_invalid_outlines_are_repaired(invalid_file):
    with pytest.warns(LayoutWarning, match=f"{PLACES}: 0 are skipped, 2 repaired"):
        layout = fs.read_layout(invalid_file, **OPTIONS, invalid="repair")

    # The largest triangle of each: base times height over 2.
    np.testing.assert_allclose(layout.area_um2, [1.0, 0.25, 1.0, 0.5 * 3.0 * 1.5, 1.0])
    assert layout.channel.tolist() == [0, 1, 0, 1, 0]


@pytest.mark.slow
@pytest.mark.parametrize("invalid_file", ["gds"], indirect=True)
def test_command_line_skips_invalid_outlines(invalid_file, tmp_path):
    command = ["convert", str(invalid_file), str(tmp_path / "b.npz"), "--source-layer", "77"]
    skipping, failing = run_programs([*command, "--reading", "invalid=skip"], command, cwd=tmp_path)

    for result, status in ((skipping, 0), (failing, 2)):
        assert result.returncode == status
        assert "site 3 at (13.5, 0.5) µm" in " ".join(result.stderr.decode().split())
    assert fs.read_layout(tmp_path / "b.npz").n_sites == 3
