"""Web pages in a browser: positions, values and colours of sites, controls; and in Python: the encoded data."""

from __future__ import annotations

import base64
import csv
import gzip
import io
import itertools
import json
import re
import sys
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest
import shapely
import shapely.affinity
from browsers import wait_for_promise, watch
from matplotlib import colormaps
from reference.ray_casting import first_hits, rays_of
from waiting import wait_until

import foveasim as fs
from foveasim._core.provenance import to_plain_data
from foveasim._io.images import read_picture
from foveasim.errors import FileError, GeometryError, ParameterError
from foveasim.layout.drc.report import read_lyrdb
from foveasim.view import SensorStack, prisms, site_at, solid_page, solids, web_page, write_solid_page, write_web_page
from foveasim.view.site_colours import FILTER_COLOURS, colours_of
from foveasim.view.site_pictures import SiteMeans
from foveasim.view.web._bodies import bodies_of
from foveasim.view.web._content import content_of
from foveasim.view.web._pack import back_references, pack, to_smallest_type
from foveasim.view.web._shapes import shapes_of

#: A frame with an island in it, an L, an arrow that no fan from its first vertex fills, a comb that no fan fills,
#: two boxes with a common boundary, and two that overlap.
FRAME = shapely.Polygon([(0, 0), (8, 0), (8, 8), (0, 8)], [[(2, 2), (2, 6), (6, 6), (6, 2)]])
L_SHAPE = shapely.Polygon([(10, 0), (16, 0), (16, 2), (12, 2), (12, 8), (10, 8)])
ARROW = shapely.Polygon([(0, 10), (8, 14), (0, 18), (3, 14)])
COMB = shapely.Polygon([
    (10, 10), (20, 10), (20, 18), (18, 18), (18, 12), (16, 12), (16, 18), (14, 18), (14, 12), (12, 12), (12, 18), (10, 18),
])  # fmt: skip
SHAPES = [
    FRAME, shapely.box(3, 3, 5, 5), L_SHAPE, ARROW, COMB, shapely.box(22, 0, 25, 4), shapely.box(25, 0, 30, 4),
    shapely.box(22, 10, 27, 15), shapely.box(25, 12, 30, 18), shapely.Point(26, 7).buffer(1.5),
]  # fmt: skip
MIXED_LAYOUT = fs.Layout.from_polygons(
    SHAPES,
    readout_line=np.arange(10) // 2,
    gain=np.array([0.1, 1 / 3, 2.5, np.nan, 1e-7, 123456.789, -4.0, 7.0, 8.0, 9.0]),
    kind=np.array(["frame", "box", "ell", "arrow", "comb", "box", "box", "box", "box", "disc"]),
    is_dark=np.arange(10) == 3,
    wide=np.arange(10) * 10**15,
)
N_X, N_Y, PITCH_UM = 12, 10, 2.5
MOSAIC = fs.layout.mosaic(fs.layout.grid(n_x=N_X, n_y=N_Y, pitch_um=PITCH_UM), ("RG", "GB"))


#: Electronics with 5 e- per code, as in :func:`capture_of`.
ELECTRONICS = {"bits": 10, "v_sat_v": 1.0, "capacitance_f": 5 * 1024 * 1.602176634e-19, "read_noise_e": 3.0}


def capture_of(layout, filters=("R", "G", "B"), **sensor):
    rng = np.random.default_rng(3)
    expected_e = rng.uniform(0.0, 4000.0, layout.n_sites)
    electrons = rng.poisson(expected_e)
    return fs.Capture(
        layout=layout,
        code=(electrons // 5).astype(np.uint16),
        electrons=electrons,
        expected_e=expected_e,
        filter_of_site=layout.channel,
        filter_names=filters,
        bits=10,
        white_dn=np.full(len(filters), 800.0),
        settings={"exposure_s": 0.01, "sensor": {**to_plain_data(fs.Sensor(layout, **ELECTRONICS)), **sensor}},
    )


CAPTURE = capture_of(MOSAIC)


# -- encoded data -----------------------------------------------------------------------------------------------------------


def triangles_of(shapes):
    """Yield triangles as the page creates them, with their sites, in plain loops."""
    cut = dict(zip(shapes.cut_sites.tolist(), range(len(shapes.cut_sites)), strict=True))
    for site in range(len(shapes.site_offsets) - 1):
        if site in cut:
            i = cut[site]
            yield from ((site, corners) for corners in shapes.cuts[shapes.cut_offsets[i] : shapes.cut_offsets[i + 1]])
        else:
            first, last = shapes.ring_offsets[shapes.site_offsets[[site, site + 1]]]
            yield from ((site, (first, v, v + 1)) for v in range(first + 1, last - 1))


@pytest.mark.parametrize(
    ("layout", "n_cut"),
    [
        (MIXED_LAYOUT, 2),  # the frame, and the comb
        (fs.layout.log_polar(n_sectors=24, r_min_um=20.0, r_max_um=60.0, chords_per_arc=3), 0),
        (fs.layout.penrose(side_um=5.0, size_um=60.0), 0),
    ],
    ids=["zoo", "log-polar", "penrose"],
)
def test_triangles_fill_exactly_their_site(layout, n_cut):
    shapes = shapes_of(layout)
    filled_um2 = np.zeros(layout.n_sites)
    polygons = layout.polygons()
    for site, corners in triangles_of(shapes):
        triangle = shapely.Polygon(shapes.xy_um[shapes.position[list(corners)]])
        filled_um2[site] += triangle.area
        assert triangle.difference(polygons[site]).area < 1e-9

    assert filled_um2 == pytest.approx(layout.area_um2, rel=1e-9)
    assert shapes.cut_sites.size == n_cut


def test_shared_vertices_stored_once_and_decoded():
    for layout in (MIXED_LAYOUT, MOSAIC):
        shapes = shapes_of(layout)
        position, n_distinct = [], 0
        for back in back_references(shapes.position).tolist():
            position.append(n_distinct if back == 0 else n_distinct - back)
            n_distinct += back == 0
        assert position == shapes.position.tolist()
    shapes = shapes_of(fs.layout.grid(n_x=5, n_y=4, pitch_um=1.0))

    assert shapes.xy_um.shape == (6 * 5, 2)
    assert np.unique(shapes.xy_um, axis=0).shape == (6 * 5, 2)


@pytest.mark.parametrize(
    "values",
    [
        np.array([0, 255]), np.array([-1, 100]), np.array([0, 2**16]), np.array([2**40, -5]), np.array([0.1, np.nan, np.inf, -0.0]),
        np.array([0.5, 2.0**-30]), np.array([True, False]), np.zeros(0),
    ],
    ids=str,
)  # fmt: skip
def test_packed_numbers_decode_bit_identically(values):
    small = to_smallest_type(values)
    about, text = pack(small)
    planes = np.frombuffer(gzip.decompress(base64.b64decode(text)), np.uint8)
    decode = (
        np.ascontiguousarray(planes.reshape(-1, about["size"]).T).view(about["type"]).ravel()
        if about["size"]
        else small
    )

    assert np.array_equal(decode.astype(np.float64), values.astype(np.float64), equal_nan=True)
    assert decode.nbytes <= max(values.nbytes, 1)


def snr_column(capture):
    """Return the signal-to-noise ratios in the page of a capture, or None."""
    page = content_of(capture)
    names = [column["array"] for column in page.about["columns"] if column["key"] == "snr"]
    return page.arrays[names[0]] if names else None


@pytest.mark.slow
def test_page_snr_includes_quantisation():
    expected_e = CAPTURE.expected_e

    assert snr_column(CAPTURE) == pytest.approx(expected_e / np.sqrt(expected_e + 9.0 + 25.0 / 12.0), rel=1e-6)
    quiet = snr_column(capture_of(MOSAIC, shot_noise="off"))
    assert quiet == pytest.approx(expected_e / np.sqrt(9.0 + 26.0 / 12.0), rel=1e-6)
    # An array of which the settings contain only the checksum, and settings without a sensor.
    assert snr_column(capture_of(MOSAIC, read_noise_e={"shape": [120], "sha256": "..."})) is None
    assert snr_column(replace(CAPTURE, settings={})) is None


class Elements(HTMLParser):
    """Elements of a page."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def test_page_loads_no_external_resources():
    text = web_page(CAPTURE)
    links = [v for _, attrs in Elements(text).found for k, v in attrs.items() if k in {"src", "href", "action"}]

    assert links
    assert all(link.startswith("data:") for link in links)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    assert "connect-src" not in policy


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: web_page(3), ParameterError, "'data' must be a Layout or a Capture, got an int"),
        (lambda: web_page(MIXED_LAYOUT[:0]), GeometryError, "the layout has no sites"),
        (
            lambda: web_page(MIXED_LAYOUT, report="none"),
            ParameterError,
            "'report' must be a Report, got a str",
        ),
        (
            lambda: web_page(MIXED_LAYOUT, report=MOSAIC.check(fs.DesignRules(min_size_um=1.0))),
            ParameterError,
            "'report' must be a check of this layout of 10 sites, got one of 120",
        ),
        (lambda: write_web_page(MIXED_LAYOUT, "page.txt"), FileError, r"page.txt: must end in .html"),
        (lambda: write_web_page(MIXED_LAYOUT, "nowhere/page.html"), FileError, "the directory nowhere does not exist"),
    ],
)
def test_invalid_page_arguments_raise(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_page_is_written_atomically(tmp_path, monkeypatch):
    (tmp_path / "page.html").write_text("before")
    monkeypatch.setattr("foveasim.view.web._page.web_page", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_web_page(MIXED_LAYOUT, tmp_path / "page.html")

    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]
    assert (tmp_path / "page.html").read_text() == "before"


# -- in a browser --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def visit(browser, tmp_path):
    """Open pages; at the end check that they had no errors and no network requests."""
    contexts, problems, requested = [], [], []

    def open_page(text, *, hash_text="", script=None, **options):
        path = tmp_path / f"page{len(contexts)}.html"
        path.write_text(text, encoding="utf-8")
        context = browser.new_context(
            **{"viewport": {"width": 1200, "height": 800}, "reduced_motion": "reduce", **options}
        )
        contexts.append(context)
        if script:
            context.add_init_script(script)
        page = context.new_page()
        watch(page, problems)
        page.on("request", lambda request: requested.append(request.url))
        page.goto(path.as_uri() + hash_text)
        wait_for_promise(page, "foveasim.complete")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert problems == []
    assert [url for url in requested if not url.startswith(("file:", "data:", "blob:"))] == []


def until(page, condition, argument=None):
    """Poll a condition from outside, because the page's content security policy forbids evaluation of strings."""
    wait_until(lambda: page.evaluate(condition, argument), step_s=0.02)


def settle(page):
    """Wait until all is drawn, after a frame of the browser, at whose end the page receives new sizes."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    until(page, "foveasim.isIdle")


def wheel(page, *steps):
    """Turn the wheel, and wait until each step has reached the page."""
    for step in steps:
        before = page.evaluate("""() => {
          if (window.turned === undefined) { window.turned = 0; addEventListener("wheel", ({ deltaY }) => { turned += deltaY; }, true); }
          return turned; }""")
        page.mouse.wheel(0, step)
        until(page, "wanted => Math.abs(turned - wanted) < 0.5", before + step)
    settle(page)


def hover(page, x_um, y_um):
    page.mouse.move(*page.evaluate("([x, y]) => foveasim.toWindow(x, y)", [x_um, y_um]))
    settle(page)


def row(page, label):
    """Return the value of a label in the panel of the site under the mouse."""
    return page.evaluate(
        "label => { const dt = [...document.querySelectorAll('#values dt')].find((e) => e.textContent === label);"
        " return dt && dt.nextElementSibling.textContent; }",
        label,
    )


@pytest.mark.slow
@pytest.mark.needs("chromium")
def test_mouse_shows_site_and_values(visit):
    page = visit(web_page(MIXED_LAYOUT))
    inside = {0: (1, 1), 1: (4, 4), 2: (11, 6), 3: (5, 14), 4: (19, 17), 5: (23, 2), 6: (28, 2), 9: (26, 7)}
    for site, point in inside.items():
        hover(page, *point)
        assert page.evaluate("foveasim.hovered") == site
        assert page.inner_text("#site-heading") == f"Photosite {site}"
        assert row(page, "area") == f"{float(f'{MIXED_LAYOUT.area_um2[site]:.6g}'):g} µm²"
        assert row(page, "readout line") == str(site // 2)
        assert row(page, "kind") == MIXED_LAYOUT.columns["kind"][site]
        assert row(page, "is dark") == ("yes" if site == 3 else "no")
        assert row(page, "wide") == f"{site * 10**15:,}"
    assert row(page, "gain") == "9"
    # The hole of the frame next to the island, the notch of the arrow, a gap of the comb, and outside the layout.
    for point in [(2.5, 4.0), (1.0, 14.0), (17.0, 15.0), (21.0, 9.0)]:
        hover(page, *point)
        assert page.evaluate("foveasim.hovered") == -1
        assert row(page, "area") == "–"
    hover(page, 26.0, 13.0)
    assert page.evaluate("foveasim.hovered") == 8
    assert row(page, "overlaps") == "7"
    values = page.evaluate("foveasim.nSites && [...Array(10).keys()].map((i) => foveasim.values(i).gain)")
    assert np.array_equal(np.array(values, dtype=float), MIXED_LAYOUT.columns["gain"], equal_nan=True)


@pytest.mark.needs("chromium")
def test_page_picks_match_python(visit):
    pick = "points => points.map(([x, y]) => foveasim.pickAll(x, y))"
    hexagons = fs.layout.hexagonal(n_columns=7, n_rows=6, pitch_um=3.0)
    for layout, is_straight in ((MIXED_LAYOUT, False), (MOSAIC, True), (hexagons, False), (MOSAIC.rotate(30.0), False)):
        page = visit(web_page(layout))
        x0, y0, x1, y1 = layout.bounds_um
        anywhere = np.random.default_rng(0).uniform((x0 - 1, y0 - 1), (x1 + 1, y1 + 1), (1500, 2))
        closed = np.concatenate((layout.xy_um, layout.xy_um[:1]))
        on_borders = np.concatenate((layout.xy_um, 0.5 * (closed[1:] + closed[:-1])))
        # The midpoint of a slanted edge is on either side by rounding; that of axis-parallel edges is exact.
        points = np.concatenate((anywhere, on_borders)) if is_straight else anywhere
        found = page.evaluate(pick, points.tolist())

        assert [sites[-1] if sites else -1 for sites in found] == [site_at(layout, x, y) for x, y in points]
        if layout is not MIXED_LAYOUT:
            rim = shapely.union_all(layout.polygons()).boundary
            inner = on_borders[shapely.distance(rim, shapely.points(on_borders)) > 0.1]
            assert inner.shape[0] > 100
            assert all(len(sites) == 1 for sites in page.evaluate(pick, inner.tolist()))


@pytest.mark.needs("chromium")
def test_wheel_zooms_about_cursor(visit):
    page = visit(web_page(CAPTURE))
    page.mouse.move(320, 510)
    under = page.evaluate("foveasim.fromWindow(320, 510)")
    before = page.evaluate("foveasim.view.scale")
    wheel(page, -200, -200, -200, 150, -200)

    assert page.evaluate("foveasim.view.scale") / before == pytest.approx(np.exp(0.4 * 4 - 0.3), rel=1e-9)
    assert page.evaluate("foveasim.fromWindow(320, 510)") == pytest.approx(under, abs=1e-9)


@pytest.mark.needs("chromium")
def test_mouse_pans_and_pins_buttons_zoom(visit):
    page = visit(web_page(CAPTURE))
    hover(page, 0.0, 0.0)
    before = page.evaluate("foveasim.view")
    x, y = page.evaluate("foveasim.toWindow(0, 0)")
    page.mouse.down()
    page.mouse.move(x + 60, y + 40, steps=4)
    page.mouse.up()
    after = page.evaluate("foveasim.view")

    assert (after["x"] - before["x"]) * before["scale"] == pytest.approx(-60, abs=1e-6)
    assert (after["y"] - before["y"]) * before["scale"] == pytest.approx(40, abs=1e-6)
    assert page.evaluate("foveasim.pinned") == -1

    page.mouse.click(*page.evaluate("foveasim.toWindow(6.0, 6.0)"))
    assert page.evaluate("foveasim.pinned") == page.evaluate("foveasim.pick(6.0, 6.0)")
    page.mouse.move(5, 5)
    assert "(pinned)" in page.inner_text("#site-heading")
    page.click("#nearer")
    assert page.evaluate("foveasim.view.scale") == pytest.approx(2 * before["scale"])
    page.click("#fit")
    assert page.evaluate("foveasim.view") == pytest.approx(before)


@pytest.mark.needs("chromium")
def test_pinch_zooms_by_finger_distance(visit):
    page = visit(web_page(CAPTURE), has_touch=True)
    before = page.evaluate("foveasim.view")
    fingers = page.context.new_cdp_session(page)

    def touch(kind, half):
        points = [] if half is None else [{"x": 400 - half, "y": 400, "id": 0}, {"x": 400 + half, "y": 400, "id": 1}]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 50)
    for half in range(60, 151, 10):
        touch("touchMove", half)
    touch("touchEnd", None)

    assert page.evaluate("foveasim.view.scale") / before["scale"] == pytest.approx(3.0, rel=0.25)


@pytest.mark.needs("chromium")
def test_site_colours_follow_selected_column(visit):
    page = visit(web_page(CAPTURE))
    site = int(np.argmax(CAPTURE.code * (MOSAIC.channel == 1)))
    x, y = MOSAIC.centroid_um[site]
    x, y = x + 0.3 * PITCH_UM, y + 0.2 * PITCH_UM

    def drawn():
        return page.evaluate("([x, y]) => foveasim.pixel(x, y)", [x, y])[:3]

    fraction = CAPTURE.code[site] / CAPTURE.code.max()
    assert page.evaluate("foveasim.column") == "picture"
    assert drawn() == pytest.approx(np.array(FILTER_COLOURS["G"]) * fraction ** (1 / 2.2), abs=2)
    page.select_option("#colouring", "channel")
    until(page, "foveasim.column === 'channel'")
    assert drawn() == list(FILTER_COLOURS["G"])
    page.select_option("#colouring", "electrons")
    until(page, "foveasim.column === 'electrons'")
    low, high = CAPTURE.electrons.min(), CAPTURE.electrons.max()
    expected = colormaps["viridis"]((CAPTURE.electrons[site] - low) / (high - low))[:3]
    assert drawn() == pytest.approx(np.array(expected) * 255, abs=4)
    page.select_option("#colouring", "code")
    until(page, "foveasim.column === 'code'")
    assert drawn() == pytest.approx([255 * fraction ** (1 / 2.2)] * 3, abs=2)
    hover(page, x, y)
    assert row(page, "code") == f"{CAPTURE.code[site]:,} DN"
    assert row(page, "electrons") == f"{CAPTURE.electrons[site]:,} e⁻"
    assert row(page, "filter") == "G"
    assert float(row(page, "signal-to-noise ratio")) == pytest.approx(CAPTURE.signal_to_noise()[site], rel=1e-5)
    assert page.evaluate(f"foveasim.values({site}).expected_e") == CAPTURE.expected_e[site]


@pytest.mark.needs("chromium")
def test_holes_and_notches_show_background(visit):
    page = visit(web_page(MIXED_LAYOUT), color_scheme="light")
    points = [(2.5, 4.0), (1.0, 14.0), (17.0, 15.0), (13.0, 5.0), (1.0, 1.0), (4.0, 4.0), (7.0, 14.0), (19.0, 17.0)]
    is_ground = [page.evaluate("([x, y]) => foveasim.pixel(x, y)", list(p))[:3] == [185, 196, 214] for p in points]

    assert is_ground == [True] * 4 + [False] * 4


@pytest.mark.needs("chromium")
def test_value_range_fades_other_sites(visit):
    page = visit(web_page(CAPTURE), hash_text="#by=electrons")
    low, high = np.argsort(CAPTURE.electrons)[[5, -5]]
    point = {site: (MOSAIC.centroid_um[site] + 0.6).tolist() for site in (low, high)}

    def drawn(site):
        return page.evaluate("([x, y]) => foveasim.pixel(x, y)", point[site])[:3]

    before = drawn(low), drawn(high)
    page.fill("#range-from", str(int(np.median(CAPTURE.electrons))))
    page.keyboard.press("Enter")
    after = drawn(low), drawn(high)

    assert after[1] == before[1]
    assert np.abs(np.array(after[0]) - (185, 196, 214)).max() < 0.13 * 255
    page.click("#range-all")
    assert (drawn(low), drawn(high)) == before
    box = page.locator("#histogram").bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"], box["y"] + 20, steps=3)
    page.mouse.up()
    from_e, to_e = page.evaluate("foveasim.range")
    span = CAPTURE.electrons.max() - CAPTURE.electrons.min()
    assert from_e == pytest.approx(CAPTURE.electrons.min() + 0.5 * span, abs=0.02 * span)
    assert to_e == CAPTURE.electrons.max()


@pytest.mark.needs("chromium")
def test_unchanged_range_bound_keeps_precision(visit):
    page = visit(web_page(CAPTURE), hash_text="#by=expected_e")
    page.fill("#range-from", "1000")
    page.keyboard.press("Enter")

    assert page.evaluate("foveasim.range") == [1000.0, CAPTURE.expected_e.max()]


@pytest.mark.needs("chromium")
def test_page_is_operable_by_keyboard(visit):
    page = visit(web_page(CAPTURE))
    order = []
    for _ in range(20):
        page.keyboard.press("Tab")
        order.append(page.evaluate("document.activeElement.id"))
        assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none" or not order[-1]
    wanted = [
        "find-site",
        "link",
        "save",
        "theme",
        "help",
        "marks",
        "nearer",
        "farther",
        "fit",
        "colouring",
        "enlarge",
    ]
    assert [name for name in order if name in wanted][: len(wanted)] == wanted

    page.focus("#colouring")
    page.keyboard.press("ArrowDown")
    until(page, "foveasim.column === 'code'")
    page.focus("#marks")
    before = page.evaluate("foveasim.view")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    after = page.evaluate("foveasim.view")
    assert after["x"] > before["x"]
    assert after["y"] > before["y"]
    page.keyboard.press("+")
    assert page.evaluate("foveasim.view.scale") > after["scale"]
    page.keyboard.press("Enter")
    pinned = page.evaluate("foveasim.pinned")
    assert pinned == page.evaluate("foveasim.pick(foveasim.view.x, foveasim.view.y)") >= 0
    until(page, "document.getElementById('live').textContent !== ''")
    assert page.inner_text("#live").startswith(f"Photosite {pinned}: code {CAPTURE.code[pinned]:,} DN")
    page.keyboard.press("Escape")
    assert page.evaluate("foveasim.pinned") == -1
    page.keyboard.press("0")
    assert page.evaluate("foveasim.view.scale") == pytest.approx(before["scale"])


@pytest.mark.needs("chromium")
def test_site_search_finds_number_or_reports(visit):
    page = visit(web_page(CAPTURE))
    page.keyboard.press("/")
    page.keyboard.type("57")
    page.keyboard.press("Enter")
    view = page.evaluate("foveasim.view")

    assert page.evaluate("foveasim.pinned") == 57
    assert (view["x"], view["y"]) == pytest.approx(MOSAIC.centroid_um[57])
    page.fill("#find-site", "120")
    page.keyboard.press("Enter")
    assert page.inner_text("[role=status]") == "Photosites are numbered from 0 to 119"
    assert page.get_attribute("#find-site", "aria-invalid") == "true"
    assert page.evaluate("foveasim.pinned") == 57


@pytest.mark.needs("chromium")
def test_violation_list_navigates_by_click_and_enter(visit):
    rules = fs.DesignRules(max_overlap_um2=0.0, min_size_um=2.5, min_space_um=2.5, max_sites=50)
    report = MIXED_LAYOUT.check(rules)
    page = visit(web_page(MIXED_LAYOUT, report=report))
    buttons = page.locator("#violations button")

    assert buttons.count() == len(report.violations) > 3
    assert page.inner_text("#rule option >> nth=0") == f"all ({len(report.violations)})"
    for i, violation in enumerate(report.violations):
        if i % 2:
            buttons.nth(i).click()
        else:
            buttons.nth(i).focus()
            page.keyboard.press("Enter")
        view = page.evaluate("foveasim.view")
        x0, y0, x1, y1 = violation.marker.bounds
        assert page.evaluate("foveasim.chosen") == i
        assert (view["x"], view["y"]) == pytest.approx((0.5 * (x0 + x1), 0.5 * (y0 + y1)), abs=1e-6)
        assert view["scale"] * max(x1 - x0, y1 - y0) < view["height"]
        assert str(violation.site_ids[0]) in buttons.nth(i).inner_text()
    page.select_option("#rule", label="max_overlap_um2 (1)")
    assert buttons.count() == 1
    assert buttons.first.inner_text().split("\n") == ["sites 7, 8", "6 µm², limit 0 µm²"]
    assert "the limit is 0 µm²" in page.inner_text("#rule-description")


@pytest.mark.needs("chromium")
def test_link_restores_view(visit):
    page = visit(web_page(CAPTURE), hash_text="#x=2.5&y=-3.25&width=9&by=snr&site=41")

    view = page.evaluate("foveasim.view")
    assert (view["x"], view["y"], view["width"] / view["scale"]) == pytest.approx((2.5, -3.25, 9.0))
    assert page.evaluate("[foveasim.column, foveasim.pinned]") == ["snr", 41]
    page.click("#nearer")
    until(page, "new URLSearchParams(location.hash.slice(1)).get('width') === '4.5'")
    assert "by=snr" in page.url
    for wrong in ("#x=a&width=-1&by=nothing&site=1e9&range=x y", "#%%%", "#site=-1&range=1"):
        assert visit(web_page(CAPTURE), hash_text=wrong).evaluate("foveasim.pinned") == -1


@pytest.mark.needs("chromium")
def test_picture_and_map_positions_agree(visit):
    page = visit(web_page(CAPTURE))
    x_um, y_um = 6.2, 8.4
    box = page.locator("#picture-frame").bounding_box()
    x0, y0, x1, y1 = MOSAIC.bounds_um

    def point_on_picture():
        box = page.locator("#picture").bounding_box()
        scale = min(box["width"] / (x1 - x0), box["height"] / (y1 - y0))
        left = box["x"] + 0.5 * (box["width"] - scale * (x1 - x0))
        top = box["y"] + 0.5 * (box["height"] - scale * (y1 - y0))
        return left + (x_um - x0) * scale, top + (y1 - y_um) * scale

    page.locator("#picture").scroll_into_view_if_needed()
    page.mouse.move(*point_on_picture())
    assert page.evaluate("foveasim.hovered") == site_at(MOSAIC, x_um, y_um)
    page.click("#enlarge")
    assert page.locator("#picture-frame").bounding_box()["width"] > 1.2 * box["width"]
    page.mouse.move(*point_on_picture())
    assert page.evaluate("foveasim.hovered") == site_at(MOSAIC, x_um, y_um)
    page.mouse.click(*point_on_picture())
    view = page.evaluate("foveasim.view")
    assert (view["x"], view["y"]) == pytest.approx((x_um, y_um), abs=0.1)


@pytest.mark.needs("chromium")
def test_view_is_saved_as_picture(visit, tmp_path):
    page = visit(web_page(CAPTURE, name="a/b <c>"))
    with page.expect_download() as download:
        page.click("#save")
    download.value.save_as(tmp_path / "view.png")
    picture = read_picture(tmp_path / "view.png")
    view = page.evaluate("foveasim.view")

    assert download.value.suggested_filename == "a_b_c_.png"
    assert picture.shape[:2] == (view["height"] + 46, view["width"])
    pixels = picture[: int(view["height"])].reshape(-1, picture.shape[2])
    assert len(np.unique(pixels[:, :3], axis=0)) > 50


MALICIOUS = (
    "</script><script>window.hacked = 1</script>",
    "<img src=x onerror='window.hacked = 1'>",
    "\"'><svg onload=window.hacked=1>",
    "<!--<script>",
    "$script ${title} \u2028 &lt;b&gt;",
)


@pytest.mark.slow
@pytest.mark.needs("chromium")
def test_untrusted_names_are_escaped(visit, tmp_path):
    layout = MIXED_LAYOUT.with_columns(**{
        text: np.array([MALICIOUS[(i + k) % len(MALICIOUS)] for i in range(MIXED_LAYOUT.n_sites)])
        for k, text in enumerate(MALICIOUS)
    })  # fmt: skip
    layout = fs.Layout(
        layout.xy_um, layout.ring_offsets, layout.site_offsets, layout.columns, {"generator": MALICIOUS[0]}
    )
    MIXED_LAYOUT.check(fs.DesignRules(min_size_um=2.5)).write(tmp_path / "report.lyrdb")
    text = (tmp_path / "report.lyrdb").read_text()
    text = text.replace("min_size_um", MALICIOUS[1].replace("<", "&lt;")).replace("photosite", "place")
    (tmp_path / "malformed.lyrdb").write_text(text)
    report = read_lyrdb(tmp_path / "malformed.lyrdb", layout.n_sites)
    for name in (MALICIOUS[0], MALICIOUS[3], MALICIOUS[4]):
        page = visit(web_page(layout, report=report, name=name))
        hover(page, 1.0, 1.0)
        page.locator("#violations button").first.click()
        page.select_option("#colouring", MALICIOUS[0])
        until(page, "name => foveasim.column === name", MALICIOUS[0])
        # Scripts of pictures that cannot be shown would run before that of a later one.
        page.evaluate(
            "() => new Promise((done) => { const last = new Image(); last.onerror = done; last.src = 'data:,'; })"
        )

        assert page.evaluate("window.hacked") is None
        assert page.evaluate("document.querySelector('h1').textContent") == name
        assert page.evaluate("document.title") == name.strip().replace("\u2028", "\u2028")
        assert page.evaluate("foveasim.values(0)")[MALICIOUS[0]] == MALICIOUS[0]
        assert page.evaluate("document.querySelectorAll('img, svg[onload]').length") == 1


@pytest.mark.needs("chromium")
def test_missing_webgl2_shows_message_and_picture(visit):
    without = (
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...rest)"
        " { return kind === 'webgl2' ? null : get.call(this, kind, ...rest); };"
    )
    page = visit(web_page(CAPTURE), script=without)

    assert page.inner_text("[role=status]").startswith("This browser has no WebGL2")
    box = page.locator("#picture").bounding_box()
    assert box["width"] > 600
    assert box["height"] > 400
    assert not page.is_visible("aside")


def luminance(colour):
    fractions = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in fractions]
    return np.dot(linear, (0.2126, 0.7152, 0.0722))


@pytest.mark.needs("chromium")
def test_theme_button_and_text_contrast(visit):
    page = visit(web_page(CAPTURE), color_scheme="dark")
    theme = "document.documentElement.dataset.theme"
    for expected in ("dark", "light"):
        assert page.evaluate(theme) == expected
        names = ("--text", "--quiet", "--accent", "--wrong", "--raised")
        *inks, ground = (
            page.evaluate("n => getComputedStyle(document.documentElement).getPropertyValue(n).trim()", name)
            for name in names
        )
        for ink in inks:
            high, low = sorted((luminance(ink), luminance(ground)), reverse=True)
            assert (high + 0.05) / (low + 0.05) >= 4.5  # WCAG 2.1, level AA
        shot = page.screenshot()
        assert len(shot) > 10_000
        page.click("#theme")
    assert page.evaluate(theme) == "dark"


@pytest.mark.needs("chromium")
def test_page_fits_small_windows(visit):
    page = visit(web_page(CAPTURE, name="a rather long name of a sensor that nobody would think of"))
    for width, height in ((1280, 720), (1024, 640), (640, 800)):
        page.set_viewport_size({"width": width, "height": height})
        settle(page)

        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), width
        assert page.evaluate(
            "document.querySelector('aside').scrollWidth <= document.querySelector('aside').clientWidth"
        ), width
        for name in ("#find-site", "#theme", "#nearer", "#colouring"):
            box = page.locator(name).bounding_box()
            assert 0 <= box["x"] <= box["x"] + box["width"] <= width, name


@pytest.mark.needs("chromium")
@pytest.mark.parametrize(("n_x", "n_y"), [(100, 100), (300, 250)])
def test_large_layout_sites_are_pickable(visit, n_x, n_y):
    layout = fs.layout.grid(n_x=n_x, n_y=n_y, pitch_um=1.5)
    capture = capture_of(layout, filters=("all",))
    page = visit(web_page(capture))
    sites = np.random.default_rng(1).integers(0, layout.n_sites, 200)
    found = page.evaluate("points => points.map(([x, y]) => foveasim.pick(x, y))", layout.centroid_um[sites].tolist())

    assert found == sites.tolist()
    for site in sites[:3].tolist():
        x, y = layout.centroid_um[site]
        level = 255 * (capture.code[site] / capture.code.max()) ** (1 / 2.2)
        page.fill("#find-site", str(site))
        page.press("#find-site", "Enter")
        assert page.evaluate("([x, y]) => foveasim.pixel(x, y)", [x + 0.3, y + 0.3])[:3] == pytest.approx(
            [level] * 3, abs=2
        )
        assert page.evaluate(f"foveasim.values({site}).electrons") == capture.electrons[site]


@pytest.mark.needs("chromium")
def test_outlines_sharp_at_extreme_zoom(visit):
    """Boundary in the centre of a view of 2 nm width, on a sensor of 10 mm."""
    border_um = 3.0
    layout = fs.Layout.from_polygons(
        [shapely.box(0, 0, border_um, 10), shapely.box(border_um, 0, 6, 10), shapely.box(9_000, 9_000, 10_000, 10_000)],
        channel=[0, 1, 2],
    )
    page = visit(web_page(layout), hash_text=f"#x={border_um}&y=5&width=0.002&by=channel")
    colours = [page.evaluate("([x, y]) => foveasim.pixel(x, y)", [border_um + d, 5.0])[:3] for d in (-1e-4, 1e-4)]

    assert page.evaluate("foveasim.view.width / foveasim.view.scale") == pytest.approx(0.002)
    assert colours == [list(FILTER_COLOURS["R"]), list(FILTER_COLOURS["G"])]


def test_about_json_names_every_array():
    text = web_page(MIXED_LAYOUT, report=MIXED_LAYOUT.check(fs.DesignRules(min_size_um=2.5)))
    about = json.loads(re.search(r'<script type="application/json" id="about">(.*?)</script>', text)[1])
    ids = {attrs["id"] for tag, attrs in Elements(text).found if tag == "script" and attrs.get("type") == "text/plain"}

    assert {f"data-{name}" for name in about["arrays"]} == ids
    assert [rule["name"] for rule in about["rules"]] == ["min_size_um"]


# -- three dimensions ----------------------------------------------------------------------------------------------------------


@pytest.mark.needs("chromium")
def test_mouse_picks_prisms_in_3d(visit):
    page = visit(solid_page(CAPTURE))
    page.evaluate("foveasim.lookDown()")
    x0, y0, x1, y1 = MOSAIC.bounds_um
    max_height_um = 0.15 * max(x1 - x0, y1 - y0)
    for site in (0, 37, 64, 119, int(CAPTURE.code.argmax())):
        x, y = MOSAIC.centroid_um[site]
        z = max_height_um * CAPTURE.code[site] / CAPTURE.code.max()
        page.mouse.move(*page.evaluate("([x, y, z]) => foveasim.toWindow(x, y, z)", [x, y, z]))
        until(page, "site => foveasim.hovered === site", site)

        assert page.inner_text("#site-heading") == f"Photosite {site} (columns)"
        assert row(page, "code") == f"{CAPTURE.code[site]:,} DN"
        assert row(page, "area") == f"{PITCH_UM**2} µm²"
        assert row(page, "filter") == "RGB"[MOSAIC.channel[site]]
    page.mouse.move(3, 3)
    until(page, "foveasim.hovered === -1")
    # From the side, the tallest prism hides the sites directly behind its top.
    page.focus("#solid")
    page.keyboard.press("0")
    site = int(CAPTURE.code.argmax())
    top = [*MOSAIC.centroid_um[site], max_height_um]
    picked = page.evaluate("(p) => foveasim.pick(...foveasim.toWindow(...p))", top)
    assert picked == {"site": site, "part": "columns"}


@pytest.mark.needs("chromium")
def test_solid_picture_contains_scale_bar_and_legend(visit, tmp_path):
    layout = fs.layout.mosaic(fs.layout.grid(n_x=6, n_y=4, pitch_um=3.0), ("RG", "GB"))
    # Swatches of the filters of the parts, and the ends of the scales of a mosaic.
    for page in (visit(solid_page(layout)), visit(solid_page(CAPTURE))):
        if "picture" in page.inner_html("#colouring"):
            page.select_option("#colouring", "picture")
            until(page, "foveasim.colour(0) !== null")
        with page.expect_download() as download:
            page.click("#save")
        download.value.save_as(tmp_path / "view.png")
        picture = read_picture(tmp_path / "view.png")[..., :3].astype(int)
        height = round(page.evaluate("document.getElementById('solid').getBoundingClientRect().height"))
        foot = picture[height:]

        assert foot.shape[0] >= 46
        bar = foot[26:29, 14 : 14 + 20].reshape(-1, 3)  # the scale bar in the colour of texts
        assert np.all(bar == bar[0])
        assert np.abs(bar[0] - foot[-1, -1]).sum() > 300
        for name in "RGB":
            assert (np.abs(foot - FILTER_COLOURS[name]).max(axis=2) <= 8).sum() >= 4


@pytest.mark.slow
def test_many_white_sites_are_coloured_by_size():
    def colouring(layout):
        text = solid_page(layout)
        return json.loads(re.search(r'<script type="application/json" id="about">(.*?)</script>', text)[1]).get(
            "colouring"
        )

    zones = fs.layout.zones(side_um=(32.0, 64.0), pitch_um=(1.0, 2.0))
    assert zones.n_sites > 1000
    assert colouring(zones) == "size_um"
    assert colouring(fs.layout.zones(side_um=(8.0, 16.0), pitch_um=(1.0, 2.0))) is None
    assert colouring(fs.layout.grid(n_x=40, n_y=40, pitch_um=1.0)) is None
    assert colouring(zones.with_columns(channel=np.arange(zones.n_sites) % 3)) is None


@pytest.mark.needs("chromium")
def test_capture_in_3d_has_every_colouring(visit):
    page = visit(solid_page(CAPTURE))
    keys = page.evaluate("[...document.getElementById('colouring').options].map((one) => one.value)")
    assert (page.input_value("#colouring"), keys[:2]) == ("", ["", "picture"])
    assert page.locator("#colouring option").first.inner_text() == "of the picture"
    for key in [*keys, "picture"]:
        page.select_option("#colouring", key)
        until(page, "key => Boolean(foveasim.colour(0)) === Boolean(key)", key)


@pytest.mark.needs("chromium")
def test_hidden_parts_expose_parts_below(visit):
    layout = fs.layout.mosaic(fs.layout.grid(n_x=6, n_y=4, pitch_um=3.0), ("RG", "GB"))
    stack = solids(layout, SensorStack(well_depth_um=4.0, trench_width_um=0.4))
    page = visit(solid_page(layout, solids=stack))
    assert page.evaluate("foveasim.parts") == list(stack.parts) == ["wells", "trenches", "filters", "lenses"]
    page.evaluate("foveasim.lookDown()")
    position = [*layout.centroid_um[14], 0.0]
    for part in ("lenses", "filters", "wells"):
        found = page.evaluate("(p) => foveasim.pick(...foveasim.toWindow(...p))", position)
        assert found == {"site": 14, "part": part}
        page.get_by_label(part).uncheck()
    found = page.evaluate(
        "(p) => foveasim.pick(...foveasim.toWindow(...p))", [layout.bounds_um[0] + 0.1, layout.centroid_um[6, 1], 0.0]
    )
    assert found == {"site": 6, "part": "trenches"}


@pytest.mark.needs("chromium")
def test_keys_rotate_and_hover_highlights_site(visit, tmp_path):
    page = visit(solid_page(CAPTURE))
    shots = [page.screenshot()]
    page.focus("#solid")
    for key in ("ArrowLeft", "ArrowUp", "+", "t", "0"):
        page.keyboard.press(key)
        settle(page)
        shots.append(page.screenshot())
    assert all(one != other for one, other in itertools.pairwise(shots))
    x, y = page.evaluate("(p) => foveasim.toWindow(...p)", [*MOSAIC.centroid_um[60], 1.0])
    page.mouse.move(x, y)
    until(page, "foveasim.hovered >= 0")
    settle(page)
    (tmp_path / "lit.png").write_bytes(page.screenshot(clip={"x": x - 4, "y": y - 4, "width": 8, "height": 8}))
    red, green, blue = read_picture(tmp_path / "lit.png")[..., :3].reshape(-1, 3).mean(axis=0)
    assert red > green > 1.3 * blue  # the yellow highlight over any filter colour


@pytest.mark.needs("chromium")
def test_solid_page_escapes_names(visit):
    layout = MOSAIC.with_columns(**{MALICIOUS[0]: np.full(MOSAIC.n_sites, MALICIOUS[1])})
    page = visit(solid_page(layout, name=MALICIOUS[1]))
    page.evaluate("foveasim.lookDown()")
    page.mouse.move(*page.evaluate("(p) => foveasim.toWindow(...p)", [*MOSAIC.centroid_um[40], 0.0]))
    until(page, "foveasim.hovered === 40")

    assert row(page, MALICIOUS[0].replace("_", " ").strip()) == MALICIOUS[1]
    assert page.evaluate("window.hacked") is None


def test_solid_page_is_self_contained(tmp_path):
    write_solid_page(MOSAIC, tmp_path / "solid.html")
    text = (tmp_path / "solid.html").read_text()

    assert all(
        v.startswith("data:") for _, attrs in Elements(text).found for k, v in attrs.items() if k in {"src", "href"}
    )
    with pytest.raises(FileError, match=r"must end in .html"):
        write_solid_page(MOSAIC, tmp_path / "solid.glb")


# -- three dimensions: encoded data --------------------------------------------------------------------------------------------


def surfaces_of(about, arrays):
    """Yield decoded surfaces, in plain loops: name, corners (n, 3, 3) in µm, sites and colours of triangles."""
    x, y = np.cumsum(arrays["position_x"], dtype=np.int64), np.cumsum(arrays["position_y"], dtype=np.int64)
    position, n_distinct = [], 0
    for back in arrays["positions"].tolist():
        position.append(n_distinct if back == 0 else n_distinct - back)
        n_distinct += back == 0
    points_um = np.array(about["origin_um"]) + about["lattice_um"] * np.column_stack(
        (x[position], y[position], arrays["z"])
    )
    runs = list(zip(*(arrays[f"run_{key}"].tolist() for key in ("sites", "points", "triangles")), strict=True))
    colours = arrays["run_colours"].reshape(-1, 3)
    tiles = arrays["tile_runs"].tolist()
    run = first = corner = tile = 0
    for body in about["list"]:
        assert sum(tiles[tile : tile + body["n_tiles"]]) == body["n_runs"]
        tile += body["n_tiles"]
        triangles, sites, rgb = [], [], []
        for _ in range(body["n_runs"]):
            site, n_points, n_triangles = runs[run]
            local = arrays["corners"][corner : corner + 3 * n_triangles].reshape(-1, 3).astype(int)
            triangles.append(points_um[first + local])
            sites += [site - 1] * n_triangles
            rgb += [colours[run]] * n_triangles
            run, first, corner = run + 1, first + n_points, corner + 3 * n_triangles
        yield body["name"], np.concatenate(triangles), np.array(sites), np.array(rgb)


def in_one_order(triangles_um, sites, *more):
    """Return triangles in canonical order, starting at their lowest corner, sorted by site and position."""
    rounded = np.round(triangles_um, 3)
    start = [min(range(3), key=lambda k: tuple(corners[k])) for corners in rounded]
    turned = np.array([np.roll(corners, -k, axis=0) for corners, k in zip(triangles_um, start, strict=True)])
    order = np.lexsort((*np.round(turned, 3).reshape(-1, 9).T, sites))
    return turned[order], *(values[order] for values in (sites, *more))


def big():
    return fs.layout.mosaic(fs.layout.grid(n_x=90, n_y=70, pitch_um=2.0), ("RG", "GB"))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("make", "build", "n_tiles"),
    [
        (lambda: MIXED_LAYOUT, lambda layout: (prisms(layout, np.arange(10.0)),), 1),
        (lambda: MOSAIC, lambda layout: solids(layout, SensorStack(trench_width_um=0.3)).meshes, 1),
        (
            lambda: MOSAIC,
            lambda layout: solids(layout, SensorStack(trench_width_um=0.3, n_lens_corners=12)).cut().meshes,
            1,
        ),
        (big, lambda layout: (prisms(layout, np.arange(6300.0)),), 4),
    ],
    ids=["notches and holes", "stack", "stack cut open", "tiles"],
)
def test_packed_surfaces_return_every_triangle(make, build, n_tiles):
    layout = make()
    meshes = build(layout)
    about, arrays = bodies_of(meshes, layout)
    for mesh, (name, triangles_um, sites, rgb) in zip(meshes, surfaces_of(about, arrays), strict=True):
        corners = mesh.triangles
        expected = in_one_order(mesh.points_um[corners], mesh.photosite[corners[:, 0]], mesh.colours[corners[:, 0]])
        found = in_one_order(triangles_um, sites, rgb)

        assert name == mesh.name
        assert np.abs(found[0] - expected[0]).max() <= 0.51 * about["lattice_um"]
        assert np.array_equal(found[1], expected[1])
        assert np.array_equal(found[2], expected[2])
    assert {body["n_tiles"] for body in about["list"]} == {n_tiles}
    assert about["lattice_um"] <= 0.001


def test_unshowable_surfaces_raise_by_name():
    (mesh,) = solids(MOSAIC, SensorStack(trench_width_um=0.0, filter_thickness_um=0.0, lens_height_um=0.0)).meshes
    spotted, crossing = mesh.colours.copy(), mesh.triangles.copy()
    spotted[5] = 1, 2, 3
    crossing[0, 2] = mesh.points_um.shape[0] - 1
    for changed, message in (
        (replace(mesh, colours=spotted), "must have one colour per photosite and part, got several in 'wells'"),
        (replace(mesh, triangles=crossing), "must have triangles of one photosite each, got others in 'wells'"),
        (replace(mesh, photosite=mesh.photosite + 1), "must be of photosites 0 to 119, got others in 'wells'"),
    ):
        with pytest.raises(ParameterError, match=message):
            bodies_of([changed], MOSAIC)
    with pytest.raises(GeometryError, match="must have at least one triangle"):
        bodies_of([replace(mesh, triangles=mesh.triangles[:0])], MOSAIC)


@pytest.mark.slow
def test_solid_page_needs_no_trimesh(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    monkeypatch.setitem(sys.modules, "manifold3d", None)

    assert len(solid_page(MOSAIC)) < 150_000
    assert len(solid_page(CAPTURE)) < 150_000


def test_scripts_are_readable_source():
    """Scripts are neither minified nor third-party code."""
    web = files("foveasim.view.web")
    names = sorted(path.name for path in web.iterdir() if not path.name.startswith("__"))
    scripts = [name for name in names if name.endswith(".js")]

    assert {name.rsplit(".")[-1] for name in names} == {"py", "js", "css", "html"}
    for name in scripts:
        text = (web / name).read_text(encoding="utf-8")
        assert len(text) < 50_000
        assert max(map(len, text.splitlines())) < 250
        assert not re.search(r"licen[sc]e|copyright|@preserve", text, re.IGNORECASE)


# -- three dimensions in a browser ------------------------------------------------------------------------------------------------

HEXAGONS = fs.layout.hexagonal(n_columns=7, n_rows=6, pitch_um=3.0)
#: Every other hexagon with a hole, a slot or a notch.
ODD = fs.Layout.from_polygons([
    polygon.difference(
        (
            polygon.centroid.buffer(0.7, quad_segs=4),
            shapely.affinity.translate(shapely.box(-0.3, -3.0, 0.3, 0.2), polygon.centroid.x, polygon.centroid.y),
            shapely.affinity.translate(
                shapely.Polygon([(-3, -0.8), (0, 0), (-3, 0.8)]), polygon.centroid.x, polygon.centroid.y
            ),
            shapely.Polygon(),
        )[i % 4]
    )
    for i, polygon in enumerate(HEXAGONS.polygons())
])  # fmt: skip
RINGS = fs.layout.log_polar(n_sectors=24, r_min_um=20.0, r_max_um=60.0, stagger=True)


@cache
def stack_of_mosaic():
    return solids(
        MOSAIC, SensorStack(well_depth_um=4.0, trench_width_um=0.5, filter_thickness_um=1.5, lens_height_um=0.0)
    )


def columns_of(layout):
    """Return a page of columns of many heights, and the same prisms for ray casting: name, polygons, floors, roofs."""
    capture = capture_of(layout, filters=("all",) * (int(layout.channel.max()) + 1))
    x0, y0, x1, y1 = layout.bounds_um
    roofs_um = 0.15 * max(x1 - x0, y1 - y0) * capture.code / capture.code.max()
    return solid_page(capture), [("columns", layout.polygons(), np.zeros(layout.n_sites), roofs_um)], True


def stack_prisms():
    wells = fs.layout.inset(MOSAIC, 0.25).polygons()
    ground = MOSAIC.polygons()
    n = MOSAIC.n_sites
    return (
        solid_page(MOSAIC, solids=stack_of_mosaic()),
        [
            ("wells", wells, np.full(n, -4.0), np.zeros(n)),
            ("trenches", shapely.difference(ground, wells), np.full(n, -4.0), np.zeros(n)),
            ("filters", ground, np.zeros(n), np.full(n, 1.5)),
        ],
        True,
    )


def press(page, *keys):
    page.focus("#solid")
    for key in keys:
        page.keyboard.press(key)


def drag(page, dx, dy, button="left"):
    page.mouse.move(420, 430)
    page.mouse.down(button=button)
    page.mouse.move(420 + dx, 430 + dy, steps=4)
    page.mouse.up(button=button)


VIEWS = {
    "aside": lambda _: None,
    "above": lambda page: press(page, "t"),
    "rotated, near, panned": lambda page: (drag(page, 190, -60), press(page, "+", "+", "+", "Shift+ArrowLeft")),
    "low, twice as high": lambda page: (press(page, *["ArrowDown"] * 5), page.fill("#height", "1")),
    "below": lambda page: press(page, *["ArrowDown"] * 14),
    "inside": lambda page: press(page, *["+"] * 9),
}


@pytest.mark.slow
@pytest.mark.needs("chromium")
@pytest.mark.parametrize(
    ("build", "views"),
    [
        (lambda: columns_of(MIXED_LAYOUT), tuple(VIEWS)),
        (lambda: columns_of(ODD), ("aside", "low, twice as high")),
        (lambda: columns_of(RINGS), ("above", "rotated, near, panned")),
        (stack_prisms, ("aside", "rotated, near, panned", "below", "inside")),
    ],
    ids=["notches and holes", "hexagons", "log-polar", "stack"],
)
def test_picks_match_ray_casting(visit, build, views):
    text, parts, has_floor = build()
    page = visit(text)
    box = page.locator("#solid").bounding_box()
    rng = np.random.default_rng(5)
    for name in views:
        page.focus("#solid")
        page.keyboard.press("0")
        page.fill("#height", "0")
        VIEWS[name](page)
        camera = page.evaluate("foveasim.camera")
        pixels = np.floor(rng.uniform((0, 0), (int(box["width"]), int(box["height"])), (150, 2))) + 0.5
        positions = pixels + np.array([box["x"], box["y"]])
        found = page.evaluate("points => points.map(([x, y]) => foveasim.pick(x, y))", positions.tolist())
        # Compare pixels within one site without another site at the same depth; at boundaries rounding decides.
        around = [pixels + offset for offset in ((0, 0), (0.6, 0.6), (-0.6, 0.6), (0.6, -0.6), (-0.6, -0.6))]
        rays = rays_of(camera, box["width"], box["height"], np.concatenate(around))
        hits = np.concatenate([
            first_hits(polygons, floors * camera["height"], roofs * camera["height"], camera["eye"], rays, has_floor=has_floor)
            for _, polygons, floors, roofs in parts
        ], axis=1)  # fmt: skip
        hits[hits < 0.01 * camera["distance"]] = np.inf  # in front of the near plane
        order = np.argsort(hits, axis=1)
        first, second = np.take_along_axis(hits, order[:, :2], axis=1).T
        which = np.where(np.isfinite(first), order[:, 0], -1).reshape(5, -1)
        with np.errstate(invalid="ignore"):
            is_clear = (
                (np.where(np.isfinite(first), second - first, 1.0) > 1e-4 * camera["distance"])
                .reshape(5, -1)
                .all(axis=0)
            )
        is_clear &= (which == which[0]).all(axis=0)
        n_sites = len(parts[0][1])
        expected = [
            {"site": int(k) % n_sites, "part": parts[int(k) // n_sites][0]} if k >= 0 else {"site": -1, "part": None}
            for k in which[0]
        ]
        wrong = [
            (name, tuple(pixels[i]), found[i], expected[i]) for i in np.flatnonzero(is_clear) if found[i] != expected[i]
        ]

        assert wrong == []
        assert is_clear.sum() > 60
        assert (which[0][is_clear] >= 0).sum() > 15


@pytest.mark.slow
@pytest.mark.needs("chromium")
def test_gestures_change_only_the_view(visit):
    page = visit(solid_page(CAPTURE))
    page.mouse.click(440, 470)
    pinned = page.evaluate("foveasim.pinned")
    assert pinned >= 0
    state = (
        "() => [foveasim.pinned, foveasim.parts, foveasim.camera.height, document.getElementById('height').value,"
        " [...document.querySelectorAll('#parts input')].map((box) => box.checked), document.documentElement.dataset.theme,"
        " document.getElementById('values').textContent]"
    )
    page.mouse.move(600, 300)
    settle(page)
    page.mouse.move(3, 3)
    settle(page)
    before = page.evaluate(state)

    def view():
        camera = page.evaluate("foveasim.camera")
        arm = np.array(camera["eye"]) - camera["target"]
        return np.array(camera["target"]), arm / np.linalg.norm(arm), np.linalg.norm(arm)

    turns = {
        "drag": lambda: drag(page, 80, 30), "left": lambda: press(page, "ArrowLeft"), "up": lambda: press(page, "ArrowUp"),
    }  # fmt: skip
    moves = {
        "right button": lambda: drag(page, 40, 25, "right"),
        "shift": lambda: (page.keyboard.down("Shift"), drag(page, -30, 20), page.keyboard.up("Shift")),
        "keys": lambda: press(page, "Shift+ArrowRight", "Shift+ArrowUp"),
    }
    zooms = {
        "wheel": lambda: (page.mouse.move(300, 460), wheel(page, -240)),
        "plus": lambda: press(page, "+"),
        "minus": lambda: press(page, "-"),
        "middle button": lambda: drag(page, 0, 60, "middle"),
        "buttons": lambda: page.click("#nearer"),
    }
    for kind, gestures in (("turn", turns), ("move", moves), ("zoom", zooms)):
        for name, gesture in gestures.items():
            target, direction, distance = view()
            gesture()
            settle(page)
            new_target, new_direction, new_distance = view()

            assert (np.abs(new_direction - direction).max() > 0.01) == (kind == "turn"), name
            assert (abs(new_distance / distance - 1) > 0.01) == (kind == "zoom"), name
            if kind != "zoom":
                assert (np.abs(new_target - target).max() > 0.1) == (kind == "move"), name
            page.mouse.move(3, 3)
            settle(page)
            assert page.evaluate(state) == before, name
    press(page, "0")
    assert page.evaluate(state) == before


@pytest.mark.needs("chromium")
def test_solid_page_touch_gestures(visit):
    page = visit(solid_page(CAPTURE), has_touch=True)
    fingers = page.context.new_cdp_session(page)

    def touch(kind, *positions):
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(positions)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    before = page.evaluate("foveasim.camera")
    touch("touchStart", (390, 400), (450, 400))
    for half in range(40, 101, 10):
        touch("touchMove", (420 - half, 400), (420 + half, 400))
    touch("touchEnd")
    after = page.evaluate("foveasim.camera")
    assert before["distance"] / after["distance"] == pytest.approx(100 / 30, rel=0.25)
    touch("touchStart", (400, 400))
    for x in range(410, 500, 10):
        touch("touchMove", (x, 400))
    touch("touchEnd")
    turned = page.evaluate("foveasim.camera")
    assert turned["target"] == after["target"]
    assert turned["distance"] == pytest.approx(after["distance"])
    assert turned["eye"] != after["eye"]


@pytest.mark.needs("chromium")
def test_ids_are_drawn_once_per_view(visit):
    page = visit(solid_page(CAPTURE))
    page.mouse.move(300, 400)
    settle(page)
    before = page.evaluate("foveasim.counts")
    for x in range(300, 560, 13):
        page.mouse.move(x, 420)
        settle(page)
    after = page.evaluate("foveasim.counts")
    assert after["screen"] > before["screen"] + 5
    assert (after["ids"], after["image"]) == (before["ids"], before["image"])

    page.click("#theme")
    page.mouse.move(420, 420)
    settle(page)
    dark = page.evaluate("foveasim.counts")
    assert (dark["ids"], dark["image"]) == (after["ids"], after["image"] + 1)
    for step in range(5):
        wheel(page, -40)
        now = page.evaluate("foveasim.counts")
        assert now["image"] == dark["image"] + step + 1
        assert now["ids"] <= dark["ids"] + step + 1
    page.mouse.move(3, 3)
    settle(page)
    before = page.evaluate("foveasim.counts")
    drag(page, 50, 50)
    page.mouse.move(3, 3)
    settle(page)
    # Nothing is drawn without interaction.
    quiet = page.evaluate("foveasim.counts")
    assert quiet["image"] > before["image"]
    assert quiet["ids"] <= before["ids"] + 2
    page.evaluate("async () => { for (let k = 0; k < 3; k++) await new Promise(requestAnimationFrame); }")
    assert page.evaluate("foveasim.counts") == quiet


@pytest.mark.needs("chromium")
def test_wheel_approaches_surface_under_mouse(visit):
    page = visit(solid_page(CAPTURE))
    site = int(CAPTURE.code.argmax())
    x0, y0, x1, y1 = MOSAIC.bounds_um
    top = [*MOSAIC.centroid_um[site], 0.15 * max(x1 - x0, y1 - y0)]
    position = page.evaluate("(p) => foveasim.toWindow(...p)", top)
    page.mouse.move(*position)
    until(page, "site => foveasim.hovered === site", site)
    before = page.evaluate("foveasim.camera.distance")
    for _ in range(6):
        wheel(page, -200)
    until(page, "before => foveasim.camera.distance < 0.12 * before", before)

    assert page.evaluate("(p) => foveasim.toWindow(...p)", top) == pytest.approx(position, abs=1.0)
    assert page.evaluate("(p) => foveasim.pick(...p)", position)["site"] == site


@pytest.mark.needs("chromium")
def test_solids_sharp_at_extreme_zoom(visit):
    """Two sites of micrometres on a sensor of 10 mm, from the smallest distance."""
    layout = fs.Layout.from_polygons(
        [shapely.box(0, 0, 3, 10), shapely.box(3, 0, 6, 10), shapely.box(9_000, 9_000, 10_000, 10_000)],
        channel=[0, 1, 2],
    )
    flat = SensorStack(trench_width_um=0.0, filter_thickness_um=0.0, lens_height_um=0.0)
    page = visit(solid_page(layout, solids=solids(layout, flat)), viewport={"width": 400, "height": 300})
    press(page, "t")
    for _ in range(20):
        page.mouse.move(*page.evaluate("foveasim.toWindow(3, 5, 0)"))
        wheel(page, -1200)
    x, y = page.evaluate("foveasim.toWindow(3, 5, 0)")
    scale = page.evaluate("foveasim.toWindow(4, 5, 0)")[0] - x

    assert scale > 60  # pixels per µm
    for side, site in ((-3, 0), (3, 1)):
        assert page.evaluate("(p) => foveasim.pick(...p)", [x + side, y]) == {"site": site, "part": "wells"}


@pytest.mark.needs("chromium")
def test_click_and_enter_pin_site(visit):
    page = visit(solid_page(CAPTURE))
    press(page, "t")
    settle(page)
    page.mouse.click(*page.evaluate("(p) => foveasim.toWindow(...p)", [*MOSAIC.centroid_um[41], 0.0]))
    assert page.evaluate("foveasim.pinned") == 41
    page.mouse.move(3, 3)
    until(page, "foveasim.hovered === -1")
    assert page.inner_text("#site-heading") == "Photosite 41 (columns, pinned)"
    assert row(page, "code") == f"{CAPTURE.code[41]:,} DN"
    press(page, "Escape")
    assert page.evaluate("foveasim.pinned") == -1
    press(page, "Enter")
    pinned = page.evaluate("foveasim.pinned")
    assert page.evaluate("foveasim.camera.target")[:2] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert shapely.distance(MOSAIC.polygons()[pinned], shapely.Point(0.0, 0.0)) < 0.1
    spoken = f"Photosite {pinned}: code {CAPTURE.code[pinned]:,} DN"
    until(page, "text => document.getElementById('live').textContent.startsWith(text)", spoken)
    page.click("#unpin")
    assert page.evaluate("foveasim.pinned") == -1


@pytest.mark.needs("chromium")
@pytest.mark.parametrize("make", [web_page, solid_page])
def test_question_mark_shows_key_list(visit, make):
    page = visit(make(CAPTURE))
    settle(page)
    check_listed_letters(page)
    canvas = "#marks" if make is web_page else "#solid"
    is_open = "document.getElementById('keys').open"
    for close in ("Escape", "?"):
        page.focus(canvas)
        assert not page.evaluate(is_open)
        page.keyboard.press("?")
        assert page.evaluate(is_open)
        assert page.locator("#keys").get_by_text("?", exact=True).is_visible()
        # Other keys have no effect while the list is open.
        settle(page)
        before = page.screenshot()
        for key in ("+", "t", "+", "-", "-", "-"):
            page.keyboard.press(key)
        settle(page)
        assert_alike(page.screenshot(), before)
        page.keyboard.press(close)
        assert not page.evaluate(is_open)
    if make is web_page:
        page.focus("#find-site")
        page.keyboard.type("?")
        assert page.input_value("#find-site") == "?"
        assert not page.evaluate(is_open)
    page.click("#help")
    assert page.evaluate(is_open)
    page.mouse.click(5, 5)
    assert not page.evaluate(is_open)


def check_listed_letters(page):
    """The letters in the list are those that have functions."""
    listed = page.evaluate("[...document.querySelectorAll('#keys kbd')].map((one) => one.textContent)")
    letters = {key.lower() for key in listed if len(key) == 1 and key.isalpha()}
    script = page.evaluate("document.querySelector('body > script:not([type])').textContent")

    assert letters == {key.lower() for key in re.findall(r'event\.key === "([a-z])"', script)}
    is_shown = page.evaluate("[...document.querySelectorAll('.for-rules')].some((one) => !one.hidden)")
    assert not is_shown


@pytest.mark.needs("chromium")
@pytest.mark.parametrize("make", [web_page, solid_page])
def test_lost_graphics_context_is_restored(visit, make):
    page = visit(make(CAPTURE))
    page.evaluate("foveasim.draw && foveasim.draw()")
    settle(page)
    before = page.screenshot()
    canvas = "#cells" if make is web_page else "#solid"
    page.evaluate(
        "name => { window.losing = document.querySelector(name).getContext('webgl2').getExtension('WEBGL_lose_context');"
        " losing.loseContext(); }",
        canvas,
    )
    until(page, "!document.querySelector('[role=status]').hidden")
    assert "was lost" in page.inner_text("[role=status]")
    page.mouse.move(300, 300)
    wheel(page, -100)
    wheel(page, 100)
    page.mouse.move(3, 3)
    page.evaluate("losing.restoreContext()")
    until(page, "document.querySelector('[role=status]').hidden")
    settle(page)
    if make is solid_page:
        press(page, "0")
        settle(page)
        page.evaluate("document.activeElement.blur()")
        site = page.evaluate("(p) => foveasim.pick(...foveasim.toWindow(...p))", [*MOSAIC.centroid_um[0], 0.1])["site"]
        assert site >= 0
    else:
        page.click("#fit")
        page.evaluate("document.activeElement.blur()")
        page.mouse.move(3, 3)
        settle(page)
    settle(page)
    assert_alike(page.screenshot(), before)


def assert_alike(one, other):
    """Check that two screenshots differ in few pixels, such as a blinking cursor or a fading button."""
    from io import BytesIO

    from PIL import Image

    a, b = (np.asarray(Image.open(BytesIO(shot)).convert("RGB"), float) for shot in (one, other))
    assert (np.abs(a - b).max(axis=2) > 8).mean() < 0.002


@pytest.mark.needs("chromium")
def test_solid_page_reports_missing_webgl2(visit):
    without = (
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...rest)"
        " { return kind === 'webgl2' ? null : get.call(this, kind, ...rest); };"
    )
    page = visit(solid_page(CAPTURE), script=without)

    assert page.inner_text("#opening").startswith("This browser has no WebGL2, which three dimensions need.")
    page.keyboard.press("?")
    assert page.evaluate("document.getElementById('keys').open")


@pytest.mark.needs("chromium")
def test_solids_fill_high_resolution_screens(visit):
    page = visit(solid_page(CAPTURE), device_scale_factor=2)
    size = "[document.getElementById('solid').width, document.getElementById('solid').height]"
    for width, height in ((1200, 800), (900, 620), (640, 760)):
        page.set_viewport_size({"width": width, "height": height})
        until(page, "size => innerWidth === size[0] && innerHeight === size[1]", [width, height])
        settle(page)
        box = page.locator("#map").bounding_box()
        assert page.evaluate(size) == [round(2 * box["width"]), round(2 * box["height"])]
        press(page, "t")
        top = [*MOSAIC.centroid_um[64], 0.0]
        assert page.evaluate("(p) => foveasim.pick(...foveasim.toWindow(...p))", top)["site"] == 64
        corners = [page.evaluate("(p) => foveasim.toWindow(...p)", [x, y, 0.0]) for x, y in ((-15, -12.5), (15, 12.5))]
        assert all(box["x"] <= x <= box["x"] + box["width"] for x, _ in corners)
        assert all(box["y"] <= y <= box["y"] + box["height"] for _, y in corners)
        assert corners[0][0] < corners[1][0]  # x to the right
        assert corners[0][1] > corners[1][1]  # y up


@pytest.mark.needs("chromium")
def test_solids_show_colours_on_background(visit, tmp_path):
    layout = fs.layout.mosaic(fs.layout.grid(n_x=4, n_y=4, pitch_um=3.0), ("RG", "GB"))
    page = visit(solid_page(layout, solids=solids(layout, SensorStack(lens_height_um=0.0))), color_scheme="light")
    press(page, "t")
    # From above, ambient and direct illumination add up to this fraction of the full colour.
    light = 0.42 + 0.60 * 0.856
    for theme, ground in (("light", (185, 196, 214)), ("dark", (43, 51, 64))):
        page.emulate_media(color_scheme=theme)
        settle(page)
        (tmp_path / "above.png").write_bytes(page.screenshot())
        picture = read_picture(tmp_path / "above.png")

        def drawn(x, y, picture=picture):
            px, py = page.evaluate("(p) => foveasim.toWindow(...p)", [x, y, 0.6])
            return picture[int(py), int(px), :3].astype(int).tolist()

        for site in (0, 1, 4):
            colour = np.array(FILTER_COLOURS["RGB"[layout.channel[site]]]) / 255
            linear = light * np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
            shown = 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
            assert drawn(*layout.centroid_um[site]) == pytest.approx(shown, abs=2), theme
        assert drawn(layout.bounds_um[0] - 0.8, 0.0) == list(ground)


#: Emulates a graphics card, for which edges are anti-aliased.
EMULATE_GRAPHICS_CARD = (
    "const ask = WebGL2RenderingContext.prototype.getParameter;"
    "WebGL2RenderingContext.prototype.getParameter = function (name) { return name === 0x9246 ? 'card' : ask.call(this, name); };"
)


@pytest.mark.needs("chromium")
def test_fast_graphics_antialias_solid_edges(visit, tmp_path):
    layout = fs.Layout.from_polygons([shapely.Polygon([(0, 0), (30, 2), (28, 20), (1, 18)])])
    flat = SensorStack(trench_width_um=0.0, filter_thickness_um=0.0, lens_height_um=0.0)
    n_colours, sites = {}, {}
    for name, script in (("slow", None), ("fast", EMULATE_GRAPHICS_CARD)):
        page = visit(solid_page(layout, solids=solids(layout, flat)), script=script)
        press(page, "t")
        settle(page)
        page.evaluate("document.activeElement.blur()")
        # Clipped to exclude the buttons and the scale bar over the view.
        (tmp_path / "edge.png").write_bytes(page.screenshot(clip={"x": 4, "y": 70, "width": 800, "height": 670}))
        picture = read_picture(tmp_path / "edge.png")[..., :3]
        n_colours[name] = len(np.unique(picture.reshape(-1, 3), axis=0))
        sites[name] = page.evaluate("(p) => foveasim.pick(...foveasim.toWindow(...p))", [15, 10, 0])["site"]
        assert (picture[350, 400] == picture[400, 420]).all()

    assert sites == {"slow": 0, "fast": 0}
    assert n_colours["slow"] == 2
    assert 4 <= n_colours["fast"] <= 16  # mixtures of four samples per pixel


@pytest.mark.needs("chromium")
@pytest.mark.parametrize(("n_x", "n_y"), [(60, 50), (300, 250)])
def test_large_solid_page_sites_are_pickable(visit, n_x, n_y):
    layout = fs.layout.grid(n_x=n_x, n_y=n_y, pitch_um=1.5)
    wells = solids(layout, SensorStack(trench_width_um=0.0, filter_thickness_um=0.0, lens_height_um=0.0))
    page = visit(solid_page(layout, solids=wells), viewport={"width": 760, "height": 520})
    page.evaluate("foveasim.lookDown()")
    sites = np.random.default_rng(1).integers(0, layout.n_sites, 100)
    positions = np.column_stack((layout.centroid_um[sites], np.zeros(sites.size))).tolist()
    found = page.evaluate("places => places.map((p) => foveasim.pick(...foveasim.toWindow(...p)).site)", positions)

    if n_x == 60:
        assert found == sites.tolist()
    else:
        # A site covers one or two pixels.
        step = np.abs(layout.centroid_um[found] - layout.centroid_um[sites]).max(axis=1)
        assert step.max() <= 1.5 * 1.001
    assert page.inner_text("#parts") == f"wells · {12 * layout.n_sites:,} triangles"
    # In a close view most tiles are not visible; those that are visible are complete.
    page.mouse.move(*page.evaluate("foveasim.toWindow(0.1, 0.1, 0)"))
    settle(page)
    for _ in range(8):
        wheel(page, -400)
    settle(page)
    box = page.locator("#solid").bounding_box()
    corners = [(box["x"] + u * box["width"], box["y"] + v * box["height"]) for u in (0.03, 0.97) for v in (0.03, 0.97)]
    assert page.evaluate("foveasim.camera.distance") < 20.0
    assert min(page.evaluate("places => places.map((p) => foveasim.pick(...p).site)", corners)) >= 0


@pytest.mark.needs("chromium")
def test_scripts_import_as_modules(browser):
    """Each module can be imported separately by other pages and notebooks."""
    web = files("foveasim.view.web")
    context = browser.new_context()
    page = context.new_page()
    page.route(
        "https://modules.invalid/*",
        lambda route: route.fulfill(
            content_type="text/javascript" if route.request.url.endswith(".js") else "text/html",
            body=(web / route.request.url.rsplit("/", 1)[1]).read_text(encoding="utf-8")
            if route.request.url.endswith(".js")
            else "<p>",
        ),
    )
    page.goto("https://modules.invalid/")
    names = ["bodies", "colours", "gestures", "gl", "map", "orbit", "page_parts", "sites", "solid_view", "unpack"]
    exports = {name: page.evaluate(f"import('./{name}.js').then((module) => Object.keys(module))") for name in names}
    context.close()

    assert all(exports.values())
    assert {"Orbit"} == set(exports["orbit"])
    assert "SolidView" in exports["solid_view"]


# -- measurements, colour maps, overview ------------------------------------------------------------------------------------


SMALL = {"viewport": {"width": 460, "height": 620}}


def drag_tool(page, key, start_um, end_um):
    """Choose a tool by its key, and drag between two points of the sensor."""
    page.keyboard.press(key)
    for k, point in enumerate((start_um, np.mean([start_um, end_um], axis=0).tolist(), end_um)):
        page.mouse.move(*page.evaluate("([x, y]) => foveasim.toWindow(x, y)", list(point)))
        if k == 0:
            page.mouse.down()
    page.mouse.up()
    settle(page)


@pytest.mark.needs("chromium")
def test_selection_statistics_match_numpy(visit, tmp_path):
    page = visit(web_page(CAPTURE, name="one"), **SMALL)
    drag_tool(page, "s", [-9.0, -6.0], [4.5, 8.0])
    x_um, y_um = MOSAIC.centroid_um.T
    chosen = np.flatnonzero((x_um > -9.0) & (x_um < 4.5) & (y_um > -6.0) & (y_um < 8.0))
    assert page.evaluate("foveasim.selected") == chosen.tolist()
    assert page.inner_text("#selection-heading") == f"Selection: {chosen.size} photosites"

    rows = page.locator("#statistics tr").all_inner_texts()
    assert rows[0].split() == ["n", "mean", "std", "min", "max"]
    for title, values in (("code / DN", CAPTURE.code), ("electrons / e⁻", CAPTURE.electrons), ("expected electrons / e⁻", CAPTURE.expected_e)):  # fmt: skip
        shown = [float(part.replace(",", "")) for part in rows[rows.index(title) + 1].split()]
        part = values[chosen].astype(float)
        assert shown[0] == chosen.size
        assert shown[1:] == pytest.approx([part.mean(), part.std(ddof=1), part.min(), part.max()], rel=6e-4)
    counts = np.bincount(CAPTURE.filter_of_site[chosen])
    assert sorted(rows[rows.index("filter") + 1].split(", ")) == sorted(f"{n} {k}" for n, k in zip("RGB", counts, strict=True))  # fmt: skip

    with page.expect_download() as download:
        page.click("#export")
    download.value.save_as(tmp_path / "sites.csv")
    assert download.value.suggested_filename == "one_sites.csv"
    table = np.genfromtxt(tmp_path / "sites.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert np.array_equal(table["site"], chosen)
    assert table["x_um"] == pytest.approx(x_um[chosen], abs=1e-9)
    assert np.array_equal(table["code"], CAPTURE.code[chosen])
    assert np.array_equal(table["expected_e"], CAPTURE.expected_e[chosen])
    assert "".join(table["channel"]) == "".join("RGB"[k] for k in CAPTURE.filter_of_site[chosen])

    until(page, "location.hash.includes('select=')")
    again = visit(web_page(CAPTURE), hash_text=page.evaluate("location.hash"), **SMALL)
    assert again.evaluate("foveasim.selected") == chosen.tolist()
    page.click("#clear-selection")
    assert page.locator("#selection").is_hidden()


@pytest.mark.needs("chromium")
def test_csv_quotes_strings_and_formulas(visit):
    names = np.array(["a,b", 'say "x"', "=1+1", "-2", "two\nlines", "plain", "@x", "+y", "µ", ""])
    page = visit(web_page(MIXED_LAYOUT.with_columns(kind=names)), **SMALL)
    drag_tool(page, "s", [-1.0, -1.0], [31.0, 19.0])
    rows = list(csv.DictReader(io.StringIO(page.evaluate("foveasim.table"), newline="")))

    assert [int(row["site"]) for row in rows] == list(range(10))
    assert [row["kind"] for row in rows] == [
        ("'" if name[:1] in "=-@+" and name else "") + name for name in names.tolist()
    ]
    gain = [float(row["gain"]) if row["gain"] else np.nan for row in rows]
    assert np.array_equal(gain, MIXED_LAYOUT.columns["gain"], equal_nan=True)


@pytest.mark.needs("chromium")
def test_ruler_measures_by_mouse_and_keys(visit):
    page = visit(web_page(CAPTURE), **SMALL)
    before = page.evaluate("foveasim.view")
    drag_tool(page, "r", [-6.0, -4.0], [6.0, 5.0])
    assert page.evaluate("foveasim.ruler") == pytest.approx(15.0, rel=1e-3)
    assert page.evaluate("foveasim.view") == before
    assert page.evaluate("foveasim.pinned") == -1
    assert page.inner_text("#cursor").startswith("15 µm Δx 12, Δy 9 µm, 36.87°")

    # With the keyboard, the arrow moves the second point by 60 pixels; Escape ends and removes the ruler.
    page.focus("#marks")
    page.keyboard.press("Enter")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    assert page.evaluate("foveasim.ruler") == pytest.approx(60.0 / before["scale"], rel=1e-6)
    page.keyboard.press("Escape")
    assert page.evaluate("[foveasim.ruler, foveasim.tool]") == [None, None]
    # Without a tool, a drag pans.
    x_um = page.evaluate("foveasim.view.x")
    page.mouse.move(*page.evaluate("foveasim.toWindow(0, 0)"))
    page.mouse.down()
    page.mouse.move(*page.evaluate("foveasim.toWindow(3, 0)"), steps=2)
    page.mouse.up()
    assert page.evaluate("foveasim.view.x") == pytest.approx(x_um - 3.0, abs=0.1)


@pytest.mark.needs("chromium")
def test_colour_maps_match_matplotlib(visit):
    page = visit(web_page(CAPTURE), hash_text="#by=electrons", **SMALL)
    span = np.ptp(CAPTURE.electrons)
    for name in ("viridis", "cividis", "grey"):
        page.select_option("#colour-map", name)
        until(page, "name => foveasim.colourMap === name", name)
        table = np.rint(255.0 * colormaps["gray" if name == "grey" else name](np.arange(256))[:, :3])
        for site in (0, 17, int(CAPTURE.electrons.argmax()), int(CAPTURE.electrons.argmin())):
            step = round(255 * (CAPTURE.electrons[site] - CAPTURE.electrons.min()) / span)
            assert page.evaluate("site => foveasim.colour(site)", site) == table[step].tolist(), name
        until(page, "name => location.hash.includes('map=' + name)", name)


def overview_of(page):
    """Return the overview of a page, lowest row first, and the bounds of the view."""
    shown = page.evaluate("""() => { const { data, ...size } = foveasim.overview(); let text = "";
      for (let i = 0; i < data.length; i += 8192) text += String.fromCharCode(...data.slice(i, i + 8192));
      return { ...size, data: btoa(text) }; }""")
    view = page.evaluate("foveasim.view")
    picture = np.frombuffer(base64.b64decode(shown["data"]), np.uint8).reshape(shown["height"], shown["width"], 4)[::-1]
    half = np.array([view["width"], view["height"]]) / (2 * view["scale"])
    return picture, (view["x"] - half[0], view["y"] - half[1], view["x"] + half[0], view["y"] + half[1])


@pytest.mark.needs("chromium")
def test_overview_shows_exact_area_means(visit):
    layout = fs.layout.voronoi(n_sites=900, size_um=(30.0, 20.0), n_iterations=2, seed=2)
    layout = fs.layout.random_channels(layout, (0.5, 0.3, 0.2), seed=1)
    page = visit(web_page(layout), hash_text="#by=size_um", viewport={"width": 400, "height": 420})
    for by in ("size_um", "channel"):
        page.select_option("#colouring", by)
        settle(page)
        picture, bounds_um = overview_of(page)
        expected = SiteMeans(layout, picture.shape[:2], bounds_um).picture(colours_of(layout, by)).astype(int)

        assert np.abs(picture[..., 3] - expected[..., 3]).max() <= 2, by
        is_inside = expected[..., 3] == 255
        assert is_inside.mean() > 0.2
        # The page and matplotlib round values to colours differently, by at most one of 256 steps.
        assert np.abs(picture.astype(int) - expected)[is_inside].max() <= 4, by


@pytest.mark.needs("chromium")
def test_overview_of_chequerboard_has_no_moire(visit):
    layout = fs.layout.grid(n_x=500, n_y=400, pitch_um=1.0)
    value = (np.add.outer(np.arange(400), np.arange(500)).ravel() % 2).astype(float)
    page = visit(web_page(layout.with_columns(value=value)), hash_text="#by=value&map=cividis", viewport={"width": 220, "height": 300})  # fmt: skip
    picture, _ = overview_of(page)
    table = np.rint(255.0 * colormaps["cividis"](np.arange(256))[:, :3])
    drawn = picture[picture[..., 3] == 255][:, :3]
    step = np.abs(drawn[:, np.newaxis] - table).sum(axis=2)

    assert drawn.shape[0] > 3000
    assert np.all(step.min(axis=1) == 0)
    side = page.evaluate("1 / foveasim.view.scale")
    assert np.abs(step.argmin(axis=1) - 127.5).max() <= 128 / side**2 + 2


@pytest.mark.needs("chromium")
def test_overview_appears_for_small_sites_only(visit):
    layout = fs.layout.grid(n_x=120, n_y=100, pitch_um=1.0)
    page = visit(web_page(layout.with_columns(value=np.arange(12000.0))), viewport={"width": 300, "height": 360})
    until(page, "foveasim.hasOverview")
    page.evaluate("location.hash = '#x=0&y=0&width=12&by=value'")
    until(page, "foveasim.view.scale > 10 && !foveasim.hasOverview")


@pytest.mark.needs("chromium")
def test_solid_page_colours_have_legend(visit):
    page = visit(solid_page(CAPTURE), **SMALL)
    assert page.locator("#legend").is_hidden()
    page.select_option("#colouring", "picture")
    until(page, "!document.getElementById('legend').hidden")  # of the codes
    page.select_option("#colouring", "expected_e")
    until(page, "foveasim.colour(3) !== null")
    span = np.ptp(CAPTURE.expected_e)
    step = round(255 * (CAPTURE.expected_e[3] - CAPTURE.expected_e.min()) / span)
    assert page.evaluate("foveasim.colour(3)") == np.rint(255 * np.array(colormaps["viridis"](step))[:3]).tolist()
    assert page.inner_text("#summary").startswith("expected electrons / e⁻: ")
    assert len(page.locator("#ticks span").all_inner_texts()) >= 3

    page.select_option("#colouring", "channel")
    until(page, "!document.getElementById('kinds').hidden")
    counts = np.bincount(CAPTURE.filter_of_site)
    assert page.locator("#kinds li").all_inner_texts() == [f"{n} · {k}" for n, k in zip("RGB", counts, strict=True)]
    page.select_option("#colouring", "")
    until(page, "foveasim.colour(3) === null")


@pytest.mark.needs("chromium")
def test_solid_page_scale_bar_length(visit):
    page = visit(solid_page(CAPTURE), **SMALL)
    page.evaluate("foveasim.lookDown()")
    settle(page)
    text = page.inner_text("#scale-bar")
    length_um = page.evaluate("foveasim.scaleBarUm")
    camera = page.evaluate("foveasim.camera")
    # At the height of the target, two points at this distance are as far apart as the bar is long.
    z_um = camera["target"][2] / camera["height"]
    ends = [page.evaluate("(p) => foveasim.toWindow(...p)", [x, camera["target"][1], z_um]) for x in (0.0, length_um)]

    assert text.strip() == f"{length_um:.3g} µm"
    box = page.locator("#scale-bar i").bounding_box()
    assert ends[1][0] - ends[0][0] == pytest.approx(box["width"], abs=0.5)


@pytest.mark.needs("chromium")
def test_cut_removes_sites_beyond_plane(visit):
    page = visit(solid_page(CAPTURE), **SMALL)
    page.evaluate("foveasim.lookDown()")

    def picked(site):
        return page.evaluate("(p) => foveasim.pick(...foveasim.toWindow(...p)).site", [*MOSAIC.centroid_um[site], 0.1])

    left, right = 4 * N_X + 2, 4 * N_X + 9
    assert (picked(left), picked(right)) == (left, right)
    page.keyboard.press("c")
    assert page.evaluate("foveasim.cut") == {"axis": 0, "sign": 1, "position": pytest.approx(0.0, abs=0.5)}
    assert (picked(left), picked(right)) == (left, -1)
    assert "is removed" in page.inner_text("#cut-text")
    for _ in range(30):
        page.keyboard.press("]")
    assert picked(right) == right
    page.keyboard.press("c")
    page.evaluate("document.getElementById('cut-position').value = 100")
    page.dispatch_event("#cut-position", "input")
    assert (picked(left), picked(right)) == (-1, right)
    page.select_option("#cut", "")
    assert (picked(left), picked(right)) == (left, right)
    assert page.evaluate("foveasim.cut") is None


@pytest.mark.needs("chromium")
def test_second_capture_shares_view_and_scale(visit):
    second = replace(CAPTURE, electrons=CAPTURE.electrons * 2)
    page = visit(web_page(CAPTURE, second=second), hash_text="#by=electrons&second=second-electrons", viewport={"width": 900, "height": 500})  # fmt: skip
    assert page.evaluate("foveasim.second") == "second-electrons"
    high = 2 * CAPTURE.electrons.max() - CAPTURE.electrons.min()
    for site in (3, 40, 119):
        for electrons, handle in ((CAPTURE.electrons, "colour"), (second.electrons, "secondColour")):
            step = round(255 * (electrons[site] - CAPTURE.electrons.min()) / high)
            expected = np.rint(255 * np.array(colormaps["viridis"](step))[:3]).tolist()
            assert page.evaluate(f"site => foveasim.{handle}(site)", site) == expected

    # The wheel over one map zooms both; the site under the mouse is marked in both.
    box = page.locator("#second-marks").bounding_box()
    px, py = round(0.5 * box["width"]) + 20, round(0.5 * box["height"]) - 10
    page.mouse.move(box["x"] + px, box["y"] + py)
    wheel(page, -300)
    view, other = page.evaluate("[foveasim.view, foveasim.secondView]")
    assert [other[name] for name in ("x", "y", "scale")] == [view[name] for name in ("x", "y", "scale")]
    view = other
    x_um = view["x"] + (px - view["width"] / 2) / view["scale"]
    y_um = view["y"] - (py - view["height"] / 2) / view["scale"]
    page.mouse.move(box["x"] + px, box["y"] + py)
    assert page.evaluate("foveasim.hovered") == site_at(MOSAIC, x_um, y_um) >= 0
    assert row(page, "second electrons") == f"{second.electrons[site_at(MOSAIC, x_um, y_um)]:,} e⁻"
    page.select_option("#second-column", "")
    until(page, "foveasim.second === null")
    assert page.locator("#second").is_hidden()


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (3, "'second' must be a Capture, got an int"),
        (capture_of(fs.layout.grid(n_x=2, n_y=2, pitch_um=1.0), ("all",)), "'second' must be a capture of this layout of 120 sites, got one of 4 sites"),
    ],
)  # fmt: skip
def test_invalid_second_capture_raises(second, message):
    with pytest.raises(ParameterError, match=message):
        web_page(CAPTURE, second=second)


@pytest.mark.needs("chromium")
def test_optical_image_shares_cursor(visit):
    light = np.zeros((3, 20, 30), np.float32)
    light[0, :10], light[2, 10:] = 1.0, 1.0  # 450 nm below, 620 nm above
    optical_image = fs.PowerMap(light, fs.Grid.centred((20, 30), 2.0), np.array([450.0, 540.0, 620.0]))
    page = visit(web_page(CAPTURE, optical_image=optical_image), viewport={"width": 900, "height": 900})
    assert page.inner_text("#picture-heading") == "Optical image"
    colour = (
        "([x, y]) => { const image = document.getElementById('picture'), canvas = document.createElement('canvas');"
        " canvas.width = image.naturalWidth; canvas.height = image.naturalHeight; const context = canvas.getContext('2d');"
        " context.drawImage(image, 0, 0); return [...context.getImageData(x, y, 1, 1).data]; }"
    )
    assert page.evaluate(colour, [15, 3]) == [255, 0, 0, 255]
    assert page.evaluate(colour, [15, 16]) == [0, 0, 255, 255]
    # The frame shows 60 x 40 µm: a quarter of its width to the right of the centre is 15 µm, outside; a tenth 6 µm, inside.
    page.locator("#picture").scroll_into_view_if_needed()
    box = page.locator("#picture").bounding_box()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.45 * box["height"])
    assert page.evaluate("foveasim.hovered") == site_at(MOSAIC, 6.0, 2.0)
    with pytest.raises(ParameterError, match="'optical_image' must be a PowerMap, got an ndarray"):
        web_page(CAPTURE, optical_image=light)
