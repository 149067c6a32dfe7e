"""GDSII and OASIS files as KLayout and gdstk write and read them: records, paths, circles, cells of one name, missing cells."""

from __future__ import annotations

import re
import struct
import tempfile
import warnings
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from programs import run_programs

import foveasim as fs
from foveasim.errors import FileError, GeometryError, LayoutWarning, ParameterError
from foveasim.layout import Layout
from foveasim.layout.files import _gds_records, _oasis_records, _paths

gdstk = pytest.importorskip("gdstk")
klayout = pytest.importorskip("klayout.db")

pytestmark = pytest.mark.usefixtures("forked_readers")

GDSII_OASIS = ["gds", "oas"]
#: The polygon of 32 vertices with which KLayout draws a disc has this relative excess of area.
KLAYOUT_DISC = 32 * np.tan(np.pi / 32) / np.pi - 1.0


# -- bytes of files ---------------------------------------------------------------------------------------------------


def record(number, kind, content=b""):
    return struct.pack(">HBB", 4 + len(content), number, kind) + content


def name(number, text):
    return record(number, 6, text + b"\0" * (len(text) % 2))


def shorts(number, *values, kind=2):
    return record(number, kind, struct.pack(f">{len(values)}h", *values))


def xy(*values):
    return record(0x10, 3, struct.pack(f">{len(values)}i", *values))


def square(side, layer=1, x=0, y=0):
    corners = (x, y, x + side, y, x + side, y + side, x, y + side, x, y)
    return record(0x08, 0) + shorts(0x0D, layer) + shorts(0x0E, 0) + xy(*corners) + record(0x11, 0)


def path(*points, width=None, path_type=None, extensions=()):
    content = record(0x09, 0) + shorts(0x0D, 1) + shorts(0x0E, 0)
    content += b"" if path_type is None else shorts(0x21, path_type)
    content += b"" if width is None else record(0x0F, 3, struct.pack(">i", width))
    for number, value in zip((0x30, 0x31), extensions, strict=False):
        content += record(number, 3, struct.pack(">i", value))
    return content + xy(*points) + record(0x11, 0)


def sref(cell, *points, colrow=None, strans=None, magnification=None):
    content = record(0x0B if colrow else 0x0A, 0) + name(0x12, cell)
    content += b"" if strans is None else record(0x1A, 1, struct.pack(">H", strans))
    content += b"" if magnification is None else record(0x1B, 5, struct.pack(">Q", magnification))
    content += b"" if colrow is None else shorts(0x13, *colrow)
    return content + xy(*points) + record(0x11, 0)


def cell(title, *elements):
    return shorts(0x05, *12 * (1,)) + name(0x06, title) + b"".join(elements) + record(0x07, 0)


def library(*cells, header=b""):
    units = record(0x03, 5, bytes.fromhex("3e4189374bc6a7f03944b82fa09b5a54"))  # 0.001 user units, 1e-9 m
    head = shorts(0x00, 600) + shorts(0x01, *12 * (1,)) + header + name(0x02, b"LIB") + units
    return head + b"".join(cells) + record(0x04, 0)


def varint(number):
    found = bytearray()
    while number > 127:
        found.append(number & 127 | 128)
        number >>= 7
    return bytes([*found, number])


def signed(number):
    return varint(abs(number) << 1 | (number < 0))


def string(text):
    return varint(len(text)) + text


def oasis(*records, version=b"1.0"):
    """Return a file of a grid of 1 nm; the tables are at the positions 0."""
    start = b"%SEMI-OASIS\r\n\1" + string(version) + b"\0" + varint(1000) + b"\1"
    end = b"\2" + 12 * b"\0"
    padding = 256 - len(end) - 2 - 1
    return start + b"".join(records) + end + varint(padding) + bytes(padding) + b"\0"


def box(side, x=0, y=0, layer=1):
    return b"\x14\xdb" + varint(layer) + b"\0" + varint(side) + signed(x) + signed(y)


def block(content, method=0):
    packed = zlib.compress(content)[2:-4]
    return b"\x22" + bytes([method]) + varint(len(content)) + varint(len(packed)) + packed


@pytest.fixture
def saved(tmp_path):
    def save(content):
        file = tmp_path / "a.bin"
        file.write_bytes(content)
        return file

    return save


def test_handwritten_files_are_read(saved):
    content = cell(b"TOP", square(4000), path(0, 0, 9000, 0, width=1000, path_type=2))
    assert fs.read_layout(saved(library(content))).area_um2.tolist() == [16.0, 10.0]
    assert fs.read_layout(saved(oasis(b"\x0e" + string(b"TOP"), box(4000)))).area_um2.tolist() == [16.0]


# -- lists of records -------------------------------------------------------------------------------------------------


def test_every_gdsii_record_is_in_one_list():
    lists = (_gds_records.UNDERSTOOD, _gds_records.IRRELEVANT, _gds_records.REJECTED)
    assert sum(map(len, lists)) == len(set().union(*lists))
    assert set(range(0x3C)) - {0x21, 0x2E} <= set().union(*lists)


def test_every_oasis_record_is_in_one_list():
    lists = (_oasis_records.UNDERSTOOD, _oasis_records.IRRELEVANT, _oasis_records.REJECTED)
    assert sum(map(len, lists)) == len(set().union(*lists))
    assert set().union(*lists) == set(range(35))


@pytest.mark.parametrize("number", [0x7F, 0x3C, *_gds_records.REJECTED])
def test_unknown_gdsii_record_is_named(saved, number):
    content = library(cell(b"TOP", square(4000), record(number, 2, b"\0\1"), square(1000)))
    at = content.index(record(number, 2, b"\0\1"))
    with pytest.raises(
        FileError, match=f"contains the GDSII record .*0x{number:02X}\\)? at byte {at}, which may change"
    ):
        fs.read_layout(saved(content))


def test_irrelevant_gdsii_records_change_nothing(saved):
    data = {0: b"", 1: b"\0\1", 2: b"\0\1", 3: b"\0\0\0\1", 6: b"AB"}
    elements = {0x0C, 0x15, 0x16, 0x17, 0x19, 0x26, 0x2A, 0x2F}
    header = b"".join(
        record(n, k, data[k]) for n, (_, k) in _gds_records.IRRELEVANT.items() if n not in elements | {0, 1, 2}
    )
    text = record(0x0C, 0) + shorts(0x0D, 1) + shorts(0x16, 0) + record(0x17, 1, b"\0\5") + xy(0, 0)
    text += record(0x19, 6, b"AB") + record(0x11, 0)
    node = record(0x15, 0) + shorts(0x0D, 1) + shorts(0x2A, 0) + xy(0, 0, 5, 5) + record(0x11, 0)
    flagged = square(4000).replace(
        record(0x08, 0), record(0x08, 0) + record(0x26, 1, b"\0\1") + record(0x2F, 3, bytes(4))
    )

    assert fs.read_layout(saved(library(cell(b"TOP", text, node, flagged), header=header))).area_um2.tolist() == [16.0]


@pytest.mark.parametrize("is_compressed", [False, True])
@pytest.mark.parametrize(
    "extra", [b"\x21\x1f\0\1\0" + string(b"x") + b"\0\0", b"\x23", b"\x7f"], ids=["XGEOMETRY", "35", "127"]
)
def test_unknown_oasis_record_is_named(saved, extra, is_compressed):
    records = box(4000) + extra
    body = block(records) if is_compressed else records
    head = oasis(b"\x0e" + string(b"TOP"))[:-256]
    where = len(box(4000)) + (0 if is_compressed else len(head))
    block_text = f" of the block at byte {len(head)}" * is_compressed
    title = "XGEOMETRY .33." if extra[0] == 33 else str(extra[0])
    with pytest.raises(
        FileError, match=f"contains the OASIS record {title} at byte {where}{block_text}, which may change"
    ):
        fs.read_layout(saved(oasis(b"\x0e" + string(b"TOP"), body)))


@pytest.mark.parametrize("pack", [bytes, block])
def test_irrelevant_oasis_records_change_nothing(saved, pack):
    extras = (
        b"\0\0",  # PAD
        b"\5" + string(b"text"),
        b"\x0b" + string(b"metal") + b"\4\1\2\0",  # LAYERNAME, intervals
        b"\x1e\1" + string(b"own"),  # XNAME
        b"\x1f\1" + string(b"own") + b"\7",
    )
    inner = (
        b"\x20\1" + string(b"anything"),  # XELEMENT
        b"\x13\x5b" + string(b"label") + b"\1\0" + signed(5) + signed(7),  # TEXT
        b"\x1c\x24" + string(b"p") + b"\7" + bytes(8) + b"\x0a" + string(b"v"),  # PROPERTY: a real number and a string
    )
    records = oasis(*extras, b"\x0e" + string(b"TOP"), pack(box(4000) + b"".join(inner) + box(1000, 9000)))

    assert fs.read_layout(saved(records)).area_um2.tolist() == [16.0, 1.0]


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (oasis(b"\x0e" + string(b"TOP"), box(4000), version=b"2.0"), "has the OASIS version '2.0', expected '1.0'"),
        (oasis(b"\x0e" + string(b"TOP"), block(box(4000), method=1)), "has a block with the compression 1 at byte"),
        (
            oasis(b"\x0e" + string(b"TOP"), b"\x22\0\xff\xff\xff\xff\x0f\1\0"),
            "would decompress to more than the maximum",
        ),
        (oasis(b"\x0e" + string(b"TOP"), b"\x22\0\5\1\0"), "CBLOCK at byte .* cannot be decompressed"),
        (oasis(b"\x0e" + string(b"TOP"), b"\x1a\x80\x1a"), "no valid OASIS record CTRAPEZOID begins at byte"),
        (oasis(b"\x0d\3", box(4000)), "the cell at byte 22 has the number 3 without a name"),
        (library(cell(b"TOP", sref(b"A", 0, 0, 5, 0, 0, 5, colrow=(-9, 1)))), "an array of 65527 x 1 cells at byte"),
    ],
)
def test_malformed_records_are_named(saved, content, match):
    with pytest.raises(FileError, match=match):
        fs.read_layout(saved(content))


@settings(max_examples=examples(300), deadline=None)
@given(st.data())
def test_damaged_records_are_read_or_rejected(data):
    shapes = b"".join(
        b"\x1a\xfb\1\0" + bytes([k]) + varint(3000) + varint(1000) + signed(0) + signed(0) for k in (0, 9, 17)
    )
    circle = b"\x1b\x3b\1\0" + varint(500) + signed(3) + signed(-4)
    contents = (
        oasis(
            b"\3" + string(b"A"),
            b"\x0d\0",
            block(box(400) + circle),
            b"\x0e" + string(b"T"),
            shapes,
            b"\x11\xb0\1A\0\0",
        ),
        library(
            cell(b"A", square(100), path(0, 0, 9, 9, width=4)), cell(b"T", sref(b"A", 0, 0, 5, 0, 0, 5, colrow=(2, 2)))
        ),
    )
    content = bytearray(data.draw(st.sampled_from(contents)))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(20, len(content) - 1))] = data.draw(st.integers(0, 255))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", LayoutWarning)
        file = Path(folder, "a")
        file.write_bytes(content)
        reader = _oasis_records if content.startswith(b"%") else _gds_records
        with suppress(FileError):
            reader.read_records(file, bytes(content), data.draw(st.sampled_from(["error", "rename"])))


# -- records that gdstk reads otherwise -------------------------------------------------------------------------------


def klayout_area(file, layer=1):
    """Return the merged area in µm² and the number of the shapes with an area, flattened."""
    layout = klayout.Layout()
    layout.read(str(file))
    index = layout.find_layer(layer, 0)
    if index is None:
        return 0.0, 0
    shapes = klayout.Region()
    shapes.merged_semantics = False
    n = 0
    tops = [c for c in layout.top_cells() if not c.name.startswith("$$$")]
    for top in tops:
        iterator = klayout.RecursiveShapeIterator(layout, top, index)
        for item in iterator.each():
            polygon = item.shape().polygon
            n += polygon is not None and polygon.area() > 0
        shapes += klayout.Region(klayout.RecursiveShapeIterator(layout, top, index))
    return shapes.merged().area() * layout.dbu**2, n


def merged_um2(layout):
    return shapely.union_all(layout.polygons()).area


ARRAY_CORNERS = {
    "skewed towards the axes": (5000, 7000, 9000, 0, 0, 9000),
    "without pitch of columns": (5000, 7000, 5000, 7000, 5000, 9000),
    "without pitch of rows": (0, 0, 30_000, 0, 0, 0),
    "plain": (100, 200, 30_100, 200, 100, 20_200),
}


@pytest.mark.filterwarnings("ignore:.*:foveasim.errors.LayoutWarning")
@pytest.mark.parametrize(
    "elements",
    [
        (path(0, 0, 9000, 0, width=3000), path(0, 20_000, 9000, 20_000)),
        (path(0, 0, 9000, 0, width=3000, path_type=3), square(1000, y=90_000)),
        (path(0, 0, 9000, 0, width=-3000), square(1000, y=90_000)),
        (path(0, 0, 9000, 0, width=3000, path_type=4, extensions=(500, 700)), square(1000, y=90_000)),
        (path(0, 0, 9000, 0, width=3000, path_type=4, extensions=(500,)), square(1000, y=90_000)),
        *((sref(b"A", *corners, colrow=(3, 2)), square(1000, y=90_000)) for corners in ARRAY_CORNERS.values()),
        (sref(b"A", 0, 0, colrow=None, strans=6, magnification=0x4120000000000000), square(1000, y=90_000)),
        (sref(b"A", 0, 0, 9000, 0, 0, 9000, colrow=(0, 2)), square(1000, y=90_000)),
        (square(2000).replace(record(0x08, 0), record(0x2D, 0)).replace(shorts(0x0E, 0), shorts(0x2E, 0)),),
    ],
    ids=[
        "no width", "path type 3", "absolute width", "extensions", "one extension", *ARRAY_CORNERS, "absolute", "no column", "box"
    ],
)  # fmt: skip
def test_elements_match_klayout(saved, elements):
    file = saved(library(cell(b"A", square(2000)), cell(b"TOP", *elements)))
    used = [b"A" in part for part in elements]
    if not any(used):
        file = saved(library(cell(b"TOP", *elements)))
    area_um2, n = klayout_area(file)
    layout = fs.read_layout(file, layer=1, cell="TOP", invalid="skip")

    assert layout.n_sites == n
    assert merged_um2(layout) == pytest.approx(area_um2, rel=1e-12)


@pytest.mark.parametrize(
    ("elements", "match"),
    [
        (
            (sref(b"A", 0, 0, strans=4),),
            r"1 reference, at byte \d+, with an absolute magnification or angle; read as relative",
        ),
        (
            (sref(b"A", 0, 0, strans=2), sref(b"A", 9, 9, strans=6)),
            r"2 references, the first at byte \d+, with an absolute",
        ),
        (
            (path(0, 0, 9000, 0, width=-300), sref(b"A", 0, 0, magnification=0x4120000000000000)),
            r"1 path, at byte \d+, with an absolute width; it is magnified with its cell",
        ),
        (
            (path(0, 0, 9000, 0, width=300, path_type=3), sref(b"A", 0, 0)),
            r"1 path, at byte \d+, of the unknown type 3",
        ),
        (
            (path(0, 0, 9000, 0, width=300, path_type=0, extensions=(50, 70)), sref(b"A", 0, 0)),
            r"2 extensions, the first at byte \d+, of a path of another type than 4; ignored",
        ),
    ],
)
def test_unsupported_flags_cause_warning(saved, elements, match):
    with pytest.warns(LayoutWarning, match=match):
        fs.read_layout(saved(library(cell(b"A", square(2000)), cell(b"TOP", *elements))))


@pytest.mark.parametrize("kind", range(26))
def test_trapezoids_match_klayout(saved, kind):
    size = varint(3000) + varint(1000) if kind not in (8, 9, 10, 11, 12, 13, 14, 15) else varint(1000) + varint(3000)
    file = saved(oasis(b"\x0e" + string(b"TOP"), b"\x1a\xfb\1\0" + bytes([kind]) + size + signed(500) + signed(-700)))
    area_um2, n = klayout_area(file)
    layout = fs.read_layout(file)

    assert (layout.n_sites, merged_um2(layout)) == (n, pytest.approx(area_um2, rel=1e-12))


@pytest.mark.parametrize("number", [23, 24, 25])
@pytest.mark.parametrize("is_vertical", [False, True])
def test_free_trapezoids_match_klayout(saved, number, is_vertical):
    deltas = signed(300) + signed(-200) if number == 23 else signed(300)
    info = 0x7B | 0x80 * is_vertical
    shape = bytes([number, info, 1, 0]) + varint(3000) + varint(2000) + deltas + signed(500) + signed(-700)
    file = saved(
        oasis(b"\x0e" + string(b"TOP"), b"\x10", shape, bytes([number, 0x18]) + deltas + signed(5000) + signed(100))
    )
    area_um2, n = klayout_area(file)
    layout = fs.read_layout(file)

    assert (layout.n_sites, merged_um2(layout)) == (n, pytest.approx(area_um2, rel=1e-12))
    assert n == 2


# -- paths and circles ------------------------------------------------------------------------------------------------


@pytest.fixture
def written(tmp_path):
    """Write shapes of KLayout."""

    def write(extension, *shapes):
        layout = klayout.Layout()
        top, index = layout.create_cell("TOP"), layout.layer(1, 0)
        for shape in shapes:
            top.shapes(index).insert(shape)
        layout.write(str(tmp_path / f"a.{extension}"))
        return tmp_path / f"a.{extension}"

    return write


def klayout_path(points, width, *ends):
    return klayout.Path([klayout.Point(*p) for p in points], width, *ends)


def test_dots_are_discs_and_squares(written):
    dots = [klayout_path([(5000 * k, 0)], 1000, 500, 500, k % 2 == 0) for k in range(5)]
    layout = fs.read_layout(written("gds", *dots))

    np.testing.assert_allclose(layout.area_um2, np.where(np.arange(5) % 2, 1.0, np.pi / 4.0), rtol=1e-12)
    np.testing.assert_allclose(layout.centroid_um, [(5.0 * k, 0.0) for k in range(5)], atol=1e-12)
    assert layout.provenance["circle_tolerance"] == 1e-3


def test_dots_of_oasis_are_circles(written):
    dots = [klayout_path([(5000 * k, 0)], 1000, 500, 500, True) for k in range(5)]
    layout = fs.read_layout(written("oas", *dots))

    np.testing.assert_allclose(layout.area_um2, np.pi / 4.0, rtol=1e-12)


def test_path_of_zero_length_is_dot(written):
    layout = fs.read_layout(written("gds", klayout_path([(7, 9), (7, 9)], 1000, 500, 500, True)))

    assert layout.area_um2 == pytest.approx(np.pi / 4.0, rel=1e-12)


@pytest.mark.parametrize("ends", [(), (500, 500)])
def test_paths_without_width_are_skipped(written, ends):
    file = written("gds", klayout.Box(0, 0, 1000, 1000), klayout_path([(0, 5000), (5000, 5000)], 0, *ends))
    with pytest.raises(FileError, match=r"1 of 2 outlines cross themselves or have no area, site 1 at \(.*5\) µm"):
        fs.read_layout(file)
    for choice in ("skip", "repair"):
        with pytest.warns(LayoutWarning, match="1 are skipped"):
            assert fs.read_layout(file, invalid=choice).area_um2.tolist() == [1.0]


@pytest.mark.parametrize("radius", [7, 100, 2000, 10**8])
@pytest.mark.parametrize("tolerance", [None, 1e-4, 0.03])
def test_circle_has_area_of_its_radius(saved, radius, tolerance):
    circles = b"\x1b\x3b\1\0" + varint(radius) + signed(3) + signed(-4) + b"\x1b\x18" + signed(5 * radius) + signed(0)
    layout = fs.read_layout(saved(oasis(b"\x0e" + string(b"TOP"), circles)), circle_tolerance=tolerance)
    distance_um = np.hypot(*(layout.polygons()[0].exterior.coords.xy - np.array([[0.003], [-0.004]])))

    np.testing.assert_allclose(layout.area_um2, np.pi * (1e-3 * radius) ** 2, rtol=1e-9)
    assert np.abs(distance_um / (1e-3 * radius) - 1.0).max() <= (tolerance or 1e-3)
    assert layout.provenance["circle_tolerance"] == (tolerance or 1e-3)


def test_touching_discs_do_not_overlap():
    n = _paths.n_vertices_of_disc(1e-3)
    a = shapely.Polygon(_paths.disc(np.zeros(2), 1.0, n))
    for angle in np.deg2rad([0.0, 30.0, 60.0, 90.0]):
        b = shapely.Polygon(_paths.disc(2.0 * np.array([np.cos(angle), np.sin(angle)]), 1.0, n))
        assert a.intersection(b).area == 0.0


def test_round_ends_add_area_of_disc(written):
    layout = fs.read_layout(written("gds", klayout_path([(0, 0), (9000, 0), (9000, 7000)], 1000, 500, 500, True)))

    assert layout.area_um2 == pytest.approx(16.0 + np.pi / 4.0, rel=1e-12)


@st.composite
def spines(draw):
    """Return the vertices of a path that does not cross itself: x increases."""
    points = [(draw(st.integers(-50, 50)), draw(st.integers(-50, 50)))]
    for _ in range(draw(st.integers(0, 3))):
        dx, dy = draw(st.sampled_from([(20, 0), (20, 20), (20, -20), (30, 11), (10, 40), (10, -40)]))
        points.append((points[-1][0] + dx, points[-1][1] + dy))
    return [(100 * x, 100 * y) for x, y in points]


@settings(max_examples=examples(200), deadline=None)
@given(spines(), st.integers(1, 400), st.integers(-50, 300), st.integers(0, 300), st.booleans())
def test_outline_of_path_matches_klayout(points, half, start, end, is_round):
    if len(points) == 1 and start + end <= 0:
        return
    ends = (half, half, True) if is_round else (start, end)
    expected = klayout.Region(klayout_path(points, 2 * half, *ends).polygon()).merged()
    outline = _paths.path_outline(np.array(points, float), half, None if is_round else (start, end), 60)
    polygon = shapely.Polygon(outline)

    assert polygon.is_valid
    tolerance = 0.8 * polygon.length + is_round * 1.1 * KLAYOUT_DISC * np.pi * half**2
    assert abs(polygon.area - expected.area()) <= tolerance


# -- layers that are not read -----------------------------------------------------------------------------------------


def test_paths_on_other_layers_are_not_counted(tmp_path):
    library_ = gdstk.Library()
    pixel = library_.new_cell("PIXEL").add(gdstk.rectangle((0, 0), (1, 1), 1))
    pixel.add(*(gdstk.FlexPath([(0, 0.1 * k), (1, 0.1 * k)], 0.02, layer=31, simple_path=True) for k in range(12)))
    library_.new_cell("TOP").add(gdstk.Reference(pixel, columns=2500, rows=2000, spacing=(2, 2)))
    library_.write_gds(tmp_path / "a.gds")
    with pytest.raises(FileError, match="has more than the maximum of 50000000 sites"):
        fs.read_layout(tmp_path / "a.gds", layer=31)
    with pytest.raises(FileError, match="has no shape on layer 7; its layers with shapes are 1/0, 31/0"):
        fs.read_layout(tmp_path / "a.gds", layer=7)
    small = gdstk.read_gds(tmp_path / "a.gds")
    next(c for c in small.cells if c.name == "TOP").references[0].repetition = gdstk.Repetition(30, 20, spacing=(2, 2))
    small.write_gds(tmp_path / "a.gds")

    assert fs.read_layout(tmp_path / "a.gds", layer=1).n_sites == 600
    assert fs.read_layout(tmp_path / "a.gds", layer=31).n_sites == 7200


# -- cells ------------------------------------------------------------------------------------------------------------


def test_cells_of_one_name_are_reported(saved):
    content = library(
        cell(b"A", square(1000)), cell(b"A", square(2000)), cell(b"TOP", sref(b"A", 0, 0), sref(b"A", 5000, 0))
    )
    first, second = (m.start() for m in re.finditer(re.escape(name(0x06, b"A")), content))
    with pytest.raises(
        FileError, match=f"has several cells 'A', at byte {first} and byte {second}; give each cell its own"
    ):
        fs.read_layout(saved(content))
    with pytest.raises(
        FileError, match="references the cell 'A' in 'TOP', but contains several different cells of this name"
    ):
        fs.read_layout(saved(content), duplicates="rename", cell="TOP")


def test_cells_of_one_name_are_renamed(saved):
    file = saved(library(cell(b"A", square(1000)), cell(b"A", square(2000)), cell(b"B", square(500))))
    for title, area_um2 in (("A", 1.0), ("A$1", 4.0), ("B", 0.25)):
        with pytest.warns(LayoutWarning, match="1 names of several cells; 1 cells are renamed"):
            assert fs.read_layout(file, duplicates="rename", cell=title).area_um2.tolist() == [area_um2]


def test_equal_cells_of_one_name_are_one(saved):
    top = cell(b"TOP", sref(b"A", 0, 0), sref(b"A", 5000, 0))
    file = saved(library(cell(b"A", square(1000)), top, cell(b"A", square(1000))))
    with pytest.warns(LayoutWarning, match="0 cells are renamed, and equal ones read once"):
        assert fs.read_layout(file, duplicates="rename").area_um2.tolist() == [1.0, 1.0]


def placed(number, x, y=0):
    return b"\x11\xf0" + varint(number) + signed(x) + signed(y)


@pytest.mark.parametrize("pack", [bytes, block])
def test_oasis_cells_are_told_apart_by_number(saved, pack):
    names = b"\3" + string(b"A") + b"\3" + string(b"A")
    cells = b"\x0d\0", pack(box(1000)), b"\x0d\1", pack(box(2000) + box(3000, 9000))
    top = b"\x0e" + string(b"TOP"), placed(0, 0), placed(1, 20_000), placed(1, 50_000)
    file = saved(oasis(names, *cells, *top))
    first, second = (m.start() for m in re.finditer(re.escape(b"\x0d"), file.read_bytes()[13:]))
    with pytest.raises(FileError, match=f"has several cells 'A', at byte {first + 13} and byte {second + 13}"):
        fs.read_layout(file)
    with pytest.warns(LayoutWarning, match="1 names of several cells; 1 cells are renamed"):
        layout = fs.read_layout(file, duplicates="rename")

    assert sorted(layout.area_um2.tolist()) == [1.0, 4.0, 4.0, 9.0, 9.0]


@pytest.mark.parametrize(
    "records",
    [
        (b"\x0e" + string(b"A"), box(1000), b"\x0e" + string(b"A"), box(2000)),
        (b"\3" + string(b"A"), b"\x0d\0", box(1000), b"\x0d\0", box(2000)),
    ],
    ids=["names", "numbers"],
)
def test_oasis_references_by_shared_name_are_ambiguous(saved, records):
    reference = b"\x11\xb0" + string(b"A") + signed(0) + signed(0) if records[0][0] == 14 else placed(0, 0)
    file = saved(oasis(*records, b"\x0e" + string(b"TOP"), reference))
    with pytest.raises(FileError, match="contains several different cells of this name"):
        fs.read_layout(file, duplicates="rename", cell="TOP")
    file = saved(oasis(*records, b"\x0e" + string(b"TOP"), box(500)))
    with pytest.warns(LayoutWarning, match="1 cells are renamed"):
        assert fs.read_layout(file, duplicates="rename", cell="A$1").area_um2.tolist() == [4.0]


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_missing_cells_are_skipped_on_request(tmp_path, extension):
    library_ = gdstk.Library()
    library_.new_cell("TOP").add(
        gdstk.rectangle((0, 0), (1, 1), 1), gdstk.Reference("IP", (0, 0)), gdstk.Reference("IO", (0, 0))
    )
    file = tmp_path / f"a.{extension}"
    library_.write_gds(file) if extension == "gds" else library_.write_oas(file)
    with pytest.raises(
        FileError, match="references the cell 'IP' in 'TOP', which it does not contain; add the cell, or pass missi"
    ):
        fs.read_layout(file)
    with pytest.warns(LayoutWarning, match="2 cells that the file does not contain are skipped: 'IO', 'IP'"):
        assert fs.read_layout(file, missing="skip").n_sites == 1


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_context_cells_of_klayout_are_ignored(tmp_path, extension):
    layout = klayout.Layout()
    top = layout.create_cell("TOP")
    top.shapes(layout.layer(1, 0)).insert(klayout.Box(0, 0, 1000, 1000))
    top.add_meta_info(klayout.LayoutMetaInfo("origin", "a generator", "", True))
    layout.write(str(tmp_path / f"a.{extension}"))
    if extension == "gds":
        assert [c.name for c in gdstk.read_gds(tmp_path / "a.gds").cells] == ["$$$CONTEXT_INFO$$$", "TOP"]
    read = fs.read_layout(tmp_path / f"a.{extension}")

    assert read.provenance["cell"] == "TOP"
    assert read.area_um2.tolist() == [1.0]


def test_context_cell_by_gdstk_is_ignored(tmp_path):
    library_ = gdstk.Library()
    top = library_.new_cell("TOP").add(gdstk.rectangle((0, 0), (1, 1), 1))
    library_.new_cell("$$$CONTEXT_INFO$$$").add(gdstk.Reference(top), gdstk.rectangle((0, 0), (1, 1), 99))
    library_.write_gds(tmp_path / "a.gds")

    assert fs.read_layout(tmp_path / "a.gds").area_um2.tolist() == [1.0]


# -- vertices and parts -----------------------------------------------------------------------------------------------


def ring_layout(n, hole=False):
    angle = 2.0 * np.pi * np.arange(n) / n
    circle = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    return Layout.from_polygons([shapely.Polygon(100.0 * circle, [30.0 * circle[::-1]] if hole else None)])


@pytest.mark.parametrize("extension", GDSII_OASIS)
@pytest.mark.parametrize("hole", [False, True])
def test_divided_outlines_become_one_site(tmp_path, extension, hole):
    layout, file = ring_layout(2000, hole), tmp_path / f"a.{extension}"
    layout.write(file, max_vertices=199)
    polygons = [p for c in getattr(gdstk, f"read_{extension}")(file).cells for p in c.polygons]
    again = fs.read_layout(file)

    assert max(p.size for p in polygons) <= 199
    assert len(polygons) > 9
    assert again.n_sites == 1
    assert np.diff(again.ring_offsets).tolist() == np.diff(layout.ring_offsets).tolist()
    assert again.area_um2 == pytest.approx(layout.area_um2, rel=1e-5)


def test_vertex_limit_of_gdsii_is_checked(tmp_path):
    with pytest.raises(ParameterError, match="'max_vertices' must be <= 8189 in GDSII, got 9000"):
        ring_layout(100).write(tmp_path / "a.gds", max_vertices=9000)


@pytest.mark.parametrize("extension", ["gds", "oas", "geojson", "parquet"])
def test_unreadable_outlines_are_not_written(tmp_path, extension):
    with pytest.raises(GeometryError, match="site 0 has 33000 vertices, too many for a photosite"):
        ring_layout(33_000).write(tmp_path / f"a.{extension}")
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("ignore:.*outlines cross themselves:foveasim.errors.LayoutWarning")
def test_parts_of_touching_outline_share_identity(tmp_path):
    library_ = gdstk.Library()
    lobes = np.array([(0, 0), (2, 0), (2, 2), (4, 2), (4, 4), (2, 4), (2, 2), (0, 2)], float)
    top = library_.new_cell("TOP")
    for number, (points, layer) in enumerate(((lobes, 10), (lobes + 10.0, 11), (lobes[:3] + 20.0, 10))):
        polygon = gdstk.Polygon(points, 1)
        polygon.set_gds_property(2, f"row={number}")
        polygon.set_gds_property(1, f"photosite {number}")
        top.add(polygon, gdstk.Polygon(points, layer))
    library_.write_gds(tmp_path / "a.gds")
    layout = fs.read_layout(tmp_path / "a.gds", layer=1, channels={10: 0, 11: 1}, invalid="repair")
    ids = layout.columns["site_id"]

    assert layout.area_um2.tolist() == [4.0, 4.0, 4.0, 4.0, 2.0]
    assert layout.columns["row"].tolist() == [0, 0, 1, 1, 2]
    assert layout.channel.tolist() == [0, 0, 1, 1, 0]
    assert ids[0] == ids[1] != ids[2] == ids[3] != ids[4]


# -- all shapes, against KLayout --------------------------------------------------------------------------------------


def random_layout(rng):
    """Return a layout of KLayout of nested cells, and the area of the discs in database units."""
    layout = klayout.Layout()
    index, other = layout.layer(1, 0), layout.layer(2, 0)
    cells = [layout.create_cell(f"C{k}") for k in range(rng.integers(2, 5))]
    disc_area = {}
    for k, item in enumerate(cells):
        shapes, disc_area[item.name] = item.shapes(index), 0.0
        for _ in range(rng.integers(1, 5)):
            x, y, w, h = (int(v) for v in rng.integers([-5000, -5000, 200, 200], [5000, 5000, 3000, 3000]))
            half = int(rng.integers(50, 300))
            points = [(x, y), (x + w, y), (x + w + 700, y + h), (x + w + 2500, y + h)][: rng.integers(1, 5)]
            kind = rng.integers(6)
            if kind == 0:
                shapes.insert(klayout.Box(x, y, x + w, y + h))
            elif kind == 1:
                corners = [(x, y), (x + w, y + 100), (x + w - 50, y + h), (x + 30, y + h - 60)]
                shapes.insert(klayout.Polygon([klayout.Point(*p) for p in corners]))
            elif kind == 2:
                shapes.insert(klayout_path(points, 2 * half, half, half, True))
                disc_area[item.name] += np.pi * half**2
            elif kind == 3:
                shapes.insert(klayout_path(points, 2 * half, half, half))
            elif kind == 4:
                shapes.insert(klayout_path(points, 2 * half, 100, 250))
            elif len(points) > 1:
                shapes.insert(klayout_path(points, 2 * half, 0, 0))
        item.shapes(other).insert(klayout_path([(0, 0), (999, 0)], 10))
        for child in cells[:k]:
            if rng.random() < 0.7:
                place = klayout.ICplxTrans(
                    float(rng.choice([1.0, 2.0, 0.5])) if rng.random() < 0.4 else 1.0,
                    float(rng.choice([0.0, 90.0, 180.0, 30.0])),
                    bool(rng.integers(2)),
                    *(int(v) for v in rng.integers(-90_000, 90_000, 2)),
                )
                copies = tuple(int(v) for v in rng.integers(1, 4, 2))
                array = (klayout.Vector(40_000, 0), klayout.Vector(0, 50_000), *copies) if rng.random() < 0.5 else ()
                item.insert(klayout.CellInstArray(child.cell_index(), place, *array))
    return layout


def compare_with_klayout(file, layer=1):
    area_um2, n = klayout_area(file, layer)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LayoutWarning)
        tops = klayout.Layout()
        tops.read(str(file))
        layouts = [fs.read_layout(file, layer=layer, cell=top.name, invalid="skip") for top in tops.top_cells() if n]
    polygons = np.concatenate([layout.polygons() for layout in layouts])
    # KLayout rounds vertices, by up to 0.7 nm in each cell, which magnifications enlarge; its discs are too large.
    is_disc = [p.length**2 / p.area < 4.0 * np.pi * 1.4 for p in polygons]
    tolerance_um2 = (
        0.004 * shapely.length(polygons).sum() * 0.5 + KLAYOUT_DISC * 1.1 * shapely.area(polygons)[is_disc].sum()
    )

    assert len(polygons) == n
    assert abs(shapely.union_all(polygons).area - area_um2) <= tolerance_um2


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_random_files_of_klayout_match_it(tmp_path, extension):
    file = tmp_path / f"a.{extension}"
    for seed in range(examples(12)):
        layout = random_layout(np.random.default_rng(seed))
        options = klayout.SaveLayoutOptions()
        options.oasis_write_cblocks, options.oasis_compression_level = bool(seed % 2), seed % 3
        layout.write(str(file), options)
        compare_with_klayout(file)


@pytest.mark.parametrize("extension", GDSII_OASIS)
def test_random_files_of_gdstk_match_klayout(tmp_path, extension):
    file = tmp_path / f"a.{extension}"
    for seed in range(examples(12)):
        rng = np.random.default_rng(seed)
        library_ = gdstk.Library()
        pixel, top = library_.new_cell("PIXEL"), library_.new_cell("TOP")
        for k in range(rng.integers(1, 6)):
            x, y = rng.integers(-9000, 9000, 2) * 1e-3 + (20.0 * k, 0.0)
            shape = [
                gdstk.rectangle((x, y), (x + 2, y + 1), 1),
                gdstk.ellipse((x, y), rng.integers(300, 3000) * 1e-3, tolerance=1e-4, layer=1),
                gdstk.Polygon([(x, y), (x + 3, y), (x + 2, y + 1), (x, y + 1)], 1),
                gdstk.regular_polygon((x, y), 2, 8, layer=1),
                gdstk.FlexPath([(x, y), (x + 3, y), (x + 5, y + 2)], 0.4, ends=("flush", "extended", (0.1, 0.3))[k % 3],
                               simple_path=True, layer=1),
            ][rng.integers(5)]  # fmt: skip
            if rng.random() < 0.3:
                shape.repetition = gdstk.Repetition(3, 2, spacing=(200, 200))
            (pixel if k % 2 else top).add(shape)
        for place in rng.integers(-500, 500, (rng.integers(0, 4), 2)):
            reference = gdstk.Reference(pixel, tuple(place), rotation=float(rng.choice([0, np.pi / 2, 0.3])),
                                        magnification=float(rng.choice([1, 1.5])), x_reflection=bool(rng.integers(2)))  # fmt: skip
            if rng.random() < 0.5:
                reference.repetition = gdstk.Repetition(2, 3, spacing=(700, 900))
            top.add(reference)
        if extension == "gds":
            library_.write_gds(file)
        else:
            library_.write_oas(file, compression_level=int(rng.integers(10)), circle_tolerance=1e-3)
        compare_with_klayout(file)


# -- command line -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_commands_take_options_of_reading(tmp_path):
    content = library(cell(b"TOP", square(1000), sref(b"IP", 0, 0), path(0, 0, width=500, path_type=1)))
    (tmp_path / "a.gds").write_bytes(content)
    skipping = ["--reading", "missing=skip", "--reading", "circle_tolerance=0.01"]
    converted, failed, shown, wrong = run_programs(
        ["convert", "a.gds", "b.gds", "--max-vertices", "8", *skipping],
        ["convert", "a.gds", "c.gds"],
        ["describe", "a.gds", *skipping],
        ["describe", "a.gds", "--reading", "mising=skip"],
        cwd=tmp_path,
    )

    assert [converted.returncode, failed.returncode, shown.returncode, wrong.returncode] == [0, 2, 0, 2]
    assert "did you mean 'missing'" in " ".join(wrong.stderr.decode().split())
    assert "missing='skip'" in " ".join(failed.stderr.decode().split())
    assert fs.read_layout(tmp_path / "b.gds").area_um2 == pytest.approx([1.0, np.pi / 16.0], rel=1e-2)


def test_settings_take_options_of_reading(tmp_path):
    (tmp_path / "a.gds").write_bytes(library(cell(b"TOP", square(1000), sref(b"IP", 0, 0))))
    (tmp_path / "a.yaml").write_text("file: a.gds\nmissing: skip\nduplicates: rename\ncircle_tolerance: 0.01\n")
    with pytest.warns(LayoutWarning, match="'IP'"):
        assert fs.read_layout(tmp_path / "a.yaml").n_sites == 1
