"""Editor of photosites in a browser: tools, snapping, keys, steps, design rules, undo."""

from __future__ import annotations

import copy
import itertools
import json

import numpy as np
import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import SHOT, change, record_changes, set_value, setting, settle, until

from foveasim.studio._session import Start

pytestmark = pytest.mark.needs("chromium")

#: 12 x 10 squares of 20 µm around (-140, 320) µm.
PITCH_UM = 20.0
MOVE_UM = np.array([-140.0, 320.0])
N_SITES = 120
GRID = {
    **copy.deepcopy(SHOT),
    "layout": {
        "generator": "grid",
        "parameters": {"n_x": 12, "n_y": 10, "pitch_um": PITCH_UM},
        "mosaic": ["RG", "GB"],
        "move_um": MOVE_UM.tolist(),
    },
}


@pytest.fixture
def edit(visit, server, monkeypatch):
    """Open the editor on a grid, with other keys of the layout."""

    def start(tool="select", *, layout=None, **options):
        settings = {**GRID, "layout": {**GRID["layout"], **(layout or {})}}
        monkeypatch.setattr(server.studio, "start", Start(settings, "test", None, server.start_of.out))
        page = visit(**options)
        page.keyboard.press("0")
        page.keyboard.press("e")
        use(page, tool)
        until(page, "() => studio.page.asked === null")
        return page

    return start


def use(page, tool):
    page.click(f"[data-tool={tool}]")


def window(page, x, y):
    """Return the pixel of a position of the layout before it is moved."""
    return page.evaluate("([x, y]) => studio.toWindow(x, y)", [x + MOVE_UM[0], y + MOVE_UM[1]])


def click(page, *points, **options):
    for x, y in points:
        page.mouse.move(*window(page, x, y))
        page.mouse.click(*window(page, x, y), **options)


def drag(page, start, end, *, steps=4):
    page.mouse.move(*window(page, *start))
    page.mouse.down()
    page.mouse.move(*window(page, *end), steps=steps)
    page.mouse.up()


def edits(page):
    return setting(page, "layout.edits") or []


def areas(page):
    return np.array(page.evaluate("[...studio.panes.b.sites.area]"))


def count(page):
    return page.evaluate("studio.panes.b.sites.n")


def download(page, what):
    page.click("#file")
    with page.expect_download() as found:
        page.click(f"[data-file={what}]")
    return json.loads(found.value.path().read_text("utf-8"))


def undo(page):
    change(page, "() => { document.getElementById('undo').click(); }")


# -- drawing ----------------------------------------------------------------------------------------------------------------


def test_drawn_polygon_is_in_geojson(edit):
    page = edit("polygon")
    corners = [(-15.0, -15.0), (30.0, -15.0), (30.0, 15.0), (0.0, 30.0)]
    click(page, *corners)
    page.keyboard.press("Enter")
    settle(page)

    assert edits(page) == [{"kind": "draw", "outlines_um": [[list(c) for c in corners]], "overlap": "cut"}]
    rings = [np.array(f["geometry"]["coordinates"][0]) for f in download(page, "geojson")["features"]]
    found = [ring for ring in rings if {tuple(c) for c in ring} == {tuple(c + MOVE_UM) for c in np.array(corners)}]
    assert len(found) == 1
    assert areas(page).sum() == pytest.approx(N_SITES * PITCH_UM**2)
    assert areas(page)[-1] == pytest.approx(45 * 45 - 0.5 * 30 * 15 - 0.5 * 15 * 45)  # the box less two triangles
    undo(page)
    assert count(page) == N_SITES


def test_first_vertex_closes_polygon(edit):
    page = edit("polygon")
    click(page, (0, 0), (40, 0), (40, 40), (20, 60), (0, 0))
    settle(page)

    assert len(edits(page)[0]["outlines_um"][0]) == 4
    click(page, (-60, -60), (-40, -60), (-40, -40), (-50, -30))
    page.keyboard.press("Backspace")
    page.keyboard.press("Control+z")
    until(page, "() => studio.editor.tool.path.length === 2")
    page.keyboard.press("Escape")
    settle(page)
    assert len(edits(page)) == 1
    assert page.evaluate("studio.editor.tool.path.length") == 0
    page.mouse.dblclick(*window(page, -80, -80))
    assert page.evaluate("studio.editor.tool.path.length") == 1


def test_rectangle_drag_is_one_step_or_cancelled(edit):
    page = edit("rectangle")
    page.mouse.move(*window(page, -15, -15))
    page.mouse.down()
    page.mouse.move(*window(page, 15, 15))
    until(page, "() => studio.panes.b.sites.n !== 120")
    page.keyboard.press("Escape")
    page.mouse.up()
    settle(page)

    assert edits(page) == []
    assert count(page) == N_SITES
    assert page.is_disabled("#undo")

    record_changes(page)
    page.mouse.move(*window(page, -15, -15))
    page.mouse.down()
    page.mouse.move(*window(page, 10, 10))
    until(page, "() => studio.panes.b.sites.n !== 120")
    page.mouse.move(*window(page, 15, 15))
    page.mouse.up()
    settle(page)

    final = [message["final"] for message in page.evaluate("changes")]
    assert final == [False] * (len(final) - 1) + [True]
    assert len(final) > 1
    assert edits(page)[0]["outlines_um"] == [[[-15, -15], [15, -15], [15, 15], [-15, 15]]]
    assert areas(page)[-1] == pytest.approx(900.0)
    undo(page)
    assert count(page) == N_SITES
    assert page.is_disabled("#undo")


def test_invalid_polygon_keeps_last_state(edit):
    page = edit("polygon")
    click(page, (-30, -30), (30, 30), (30, -30), (-30, 30))
    page.keyboard.press("Enter")
    page.wait_for_selector(".tool-problem:not([hidden])")
    settle(page)

    assert page.inner_text(".tool-problem").strip()
    assert edits(page) == []
    assert count(page) == N_SITES
    assert page.evaluate("studio.editor.tool.path.length") == 4
    page.keyboard.press("Escape")
    click(page, (-30, -30), (30, -30), (30, 30))
    page.keyboard.press("Enter")
    settle(page)
    assert page.is_hidden(".tool-problem")
    assert len(edits(page)) == 1


# -- sites, vertices, lines ---------------------------------------------------------------------------------------------------


def test_shared_vertex_moves_in_all_sites(edit):
    page = edit("vertex")
    drag(page, (20, 20), (25, 30))
    settle(page)

    assert edits(page) == [{"kind": "move_vertices", "from_um": [[20, 20]], "to_um": [[25, 30]]}]
    found = areas(page)
    assert found.sum() == pytest.approx(N_SITES * PITCH_UM**2)
    # Each changes by half the cross product of the displacement with a diagonal of the square.
    assert sorted(found[np.abs(found - 400) > 1e-6]) == pytest.approx([250.0, 350.0, 450.0, 550.0])
    n_at = """([x, y]) => { const { sites } = studio.panes.b; let n = 0;
      for (let v = 0; v < sites.position.length; v++) n += sites.xy[2 * sites.position[v]] === x && sites.xy[2 * sites.position[v] + 1] === y;
      return n; }"""
    assert page.evaluate(n_at, (np.array([25.0, 30.0]) + MOVE_UM).tolist()) == 4


def test_edge_gets_vertex_that_is_removed(edit):
    page = edit("vertex")
    drag(page, (10, 0), (10, 5))
    settle(page)
    assert edits(page)[0] == {"kind": "move_vertices", "from_um": [[10, 0]], "to_um": [[10, 5]]}
    found = areas(page)
    assert sorted(found[np.abs(found - 400) > 1e-6]) == pytest.approx([350.0, 450.0])
    page.mouse.move(*window(page, 10, 5))
    page.keyboard.press("Delete")
    settle(page)

    assert edits(page)[1] == {"kind": "remove_vertices", "points_um": [[10, 5]]}
    assert np.allclose(areas(page), 400.0)
    page.keyboard.down("Alt")
    click(page, (-40, 40))
    page.keyboard.up("Alt")
    settle(page)
    assert edits(page)[2] == {"kind": "remove_vertices", "points_um": [[-40, 40]]}


def test_inset_disables_vertex_tool(edit):
    page = edit("vertex", layout={"inset_um": 1.0})
    assert "inset of 1 µm" in page.inner_text(".tool-hint")
    drag(page, (19, 19), (25, 30))
    settle(page)
    assert edits(page) == []
    use(page, "polygon")
    assert "inset of 1 µm" in page.inner_text(".tool-hint")


def test_merge_joins_clicked_sites(edit):
    page = edit("merge")
    click(page, (10, 10), (30, 10))
    page.keyboard.press("Enter")
    settle(page)

    assert edits(page) == [{"kind": "merge_at", "points_um": [[10, 10], [30, 10]]}]
    assert count(page) == N_SITES - 1
    assert areas(page).max() == pytest.approx(800.0)
    assert page.evaluate("studio.page.selected.length") == 1


def test_cut_follows_line(edit):
    page = edit("cut")
    click(page, (-20, 0), (0, 20))
    page.keyboard.press("Enter")
    settle(page)
    assert count(page) == N_SITES + 1
    assert np.sort(areas(page))[:2] == pytest.approx([200.0, 200.0])
    use(page, "select")
    click(page, (50, 50))
    use(page, "cut")
    click(page, (20, 50), (100, 50))
    page.click(".apply")
    settle(page)

    assert edits(page)[1]["points_um"] == [[50, 50]]
    assert count(page) == N_SITES + 2


def test_selection_is_split_coloured_and_deleted(edit):
    page = edit("select")
    click(page, (10, 10))
    page.keyboard.down("Shift")
    click(page, (30, 10))
    page.keyboard.up("Shift")
    assert len(page.evaluate("studio.page.selected")) == 2
    use(page, "channel")
    page.get_by_label("Filter", exact=True).select_option(label="filter B")
    page.click(".apply")
    settle(page)
    assert page.evaluate(
        "(() => { const { values } = studio.panes.b.columns.find((c) => c.key === 'channel'); return studio.page.selected.map((site) => values[site]); })()"
    ) == [2, 2]
    use(page, "split")
    page.get_by_label("Parts along x").fill("3")
    page.get_by_label("Parts along y").fill("2")
    page.click(".apply")
    settle(page)
    assert count(page) == N_SITES + 2 * 5
    use(page, "select")
    click(page, (-10, -10))
    page.keyboard.press("Delete")
    settle(page)

    assert count(page) == N_SITES + 2 * 5 - 1
    assert [each["kind"] for each in edits(page)] == ["set_channel", "split_at", "remove_at"]


def test_moved_selection_stays_selected(edit):
    page = edit("select")
    click(page, (110, 10))
    page.keyboard.down("Shift")
    click(page, (110, 30))
    page.keyboard.up("Shift")
    use(page, "move")
    drag(page, (110, 10), (145, 20))
    settle(page)

    assert edits(page)[0]["by_um"] == [35, 10]
    assert page.evaluate("studio.page.selected.map((site) => studio.panes.b.sites.centre(site))") == pytest.approx(
        np.array([[145.0, 20.0], [145.0, 40.0]]) + MOVE_UM
    )
    page.focus("#map .marks")
    for key in ("ArrowRight", "ArrowRight", "ArrowUp"):
        page.keyboard.press(key)
        settle(page)
    step = page.evaluate("studio.editor.step")
    assert [each["by_um"] for each in edits(page)] == [[35, 10], [2 * step, step]]
    undo(page)
    undo(page)
    undo(page)
    undo(page)
    assert count(page) == N_SITES
    assert page.evaluate("studio.page.selected.map((site) => studio.panes.b.sites.centre(site))") == pytest.approx(
        np.array([[110.0, 10.0], [110.0, 30.0]]) + MOVE_UM
    )


def test_layer_is_placed_in_the_view(edit):
    page = edit("layer")
    page.locator(".tool-options").get_by_label("Generator").select_option(label="hexagonal")
    page.click(".apply")
    settle(page)
    (added,) = edits(page)
    assert added["layer"]["generator"] == "hexagonal"
    assert added["layer"]["move_um"] == [0, 0]
    assert page.is_visible("#tile-steps .step-fields")
    for name, value in (("n_columns", "4"), ("n_rows", "4"), ("pitch_um", "10")):
        field = page.locator(f".step-fields [data-at$='.{name}']")
        field.fill(value)
        field.press("Enter")
        settle(page)

    assert edits(page)[0]["layer"]["parameters"] == {"n_columns": 4, "n_rows": 4, "pitch_um": 10}
    assert (areas(page) < 100).sum() >= 16
    page.locator(".step-fields select").select_option("cut_out")
    settle(page)
    assert areas(page).sum() == pytest.approx(N_SITES * 400 - 16 * 100 * np.sqrt(3) / 2)


# -- design rules -------------------------------------------------------------------------------------------------------------


def test_rules_follow_drag_and_repair(edit):
    page = edit("rectangle")
    page.click(".rules-button")
    settle(page)
    assert setting(page, "layout.rules.min_size_um") == 20
    until(page, "() => document.querySelector('.rules-button').textContent === 'rules satisfied'")
    page.mouse.move(*window(page, -35, -35))
    page.mouse.down()
    page.mouse.move(*window(page, -20, -20))
    until(page, "() => /violation/.test(document.querySelector('.rules-button').textContent)")
    assert page.evaluate("studio.editor.violationsIn([-180, 280, -150, 310]).length") > 0
    page.mouse.up()
    settle(page)
    assert page.evaluate("studio.rules.violations.n") > 0
    use(page, "repair")
    until(page, "() => document.querySelector('.repairs li[data-method=drop]:not(.pending)')")
    page.click(".repairs li[data-method=drop] button")
    settle(page)

    until(page, "() => document.querySelector('.rules-button').textContent === 'rules satisfied'")
    assert edits(page)[-1] == {"kind": "repair", "method": "drop"}


# -- history, steps -----------------------------------------------------------------------------------------------------------


def test_hundred_edits_undo_and_redo(edit):
    page = edit()
    first = areas(page)
    change(
        page,
        """() => { for (let k = 0; k < 100; k++) {
          const x = -110 + 20 * (k % 10), y = -90 + 20 * Math.floor(k / 10);
          studio.editor.commit({ kind: "split_at", points_um: [[x, y]], n_x: 2, n_y: 1 });
        } }""",
    )
    settle(page)
    assert len(edits(page)) == 100
    last = areas(page)
    assert len(last) == N_SITES + 100
    change(page, "() => { for (let k = 0; k < 100; k++) studio.connection.send({ do: 'undo' }); }")
    assert edits(page) == []
    assert np.array_equal(areas(page), first)
    change(page, "() => { for (let k = 0; k < 100; k++) studio.connection.send({ do: 'redo' }); }")
    assert len(edits(page)) == 100
    assert np.array_equal(areas(page), last)


def test_steps_are_listed_and_changed(edit):
    page = edit()
    page.evaluate("""() => { studio.editor.commit({ kind: "split_at", points_um: [[10, 10]], n_x: 2, n_y: 2 });
      studio.editor.commit({ kind: "remove_at", points_um: [[-110, -90]] }); }""")
    settle(page)
    names = "[...document.querySelectorAll('.step-name')].map((e) => e.innerText.replace(/\\s+/g, ' '))"
    assert page.evaluate(names) == ["1. Split 1 site into 2 × 2", "2. Delete 1 site"]
    page.locator(".step-name").first.click()
    until(page, "() => studio.page.asked === null")
    view = page.evaluate(
        "(({ x, y, scale, width, height }) => [x, y, Math.min(width, height) / scale])(studio.panes.b.map)"
    )
    # The site at the point is now a part of 10 µm.
    assert view[:2] == pytest.approx((np.array([15, 15]) + MOVE_UM).tolist())
    assert view[2] == pytest.approx(10 / 0.4)
    field = page.locator(".step-fields [data-at='field0n_x']")
    field.fill("5")
    field.press("Enter")
    settle(page)
    assert edits(page)[0]["n_x"] == 5
    assert count(page) == N_SITES + 9 - 1
    page.click("[aria-label='Move down: step 1']")
    settle(page)
    assert [each["kind"] for each in edits(page)] == ["remove_at", "split_at"]
    page.click("[aria-label='Delete: step 1']")
    settle(page)
    assert count(page) == N_SITES + 9
    page.click("[aria-label='Duplicate: step 1']")
    settle(page)
    assert len(edits(page)) == 2
    page.locator(".step-name").last.focus()
    page.keyboard.press("Delete")
    settle(page)
    assert len(edits(page)) == 1


# -- snapping, keys -------------------------------------------------------------------------------------------------------------


def test_positions_snap_to_vertices_and_grid(edit):
    page = edit("polygon")

    def position(x, y, dx=0, dy=0):
        px, py = window(page, x, y)
        page.mouse.move(px + dx, py + dy)
        until(
            page,
            """([px, py]) => { const { raw, map, pane } = studio.editor, box = pane.marks.getBoundingClientRect();
            return raw && Math.hypot(box.left + map.toX(raw.x) - px, box.top + map.toY(raw.y) - py) < 0.5; }""",
            [px + dx, py + dy],
        )
        found = page.evaluate("studio.editor.at")
        return found["kind"], [found["x"] - MOVE_UM[0], found["y"] - MOVE_UM[1]]

    for _ in range(2):
        page.click("#nearer")
    kind, at = position(20, 20, 5, -4)
    assert (kind, at) == ("vertex", pytest.approx([20, 20], abs=1e-9))
    kind, at = position(30, 20, 4, 4)
    assert (kind, at) == ("midpoint", pytest.approx([30, 20], abs=1e-9))
    assert page.evaluate("studio.editor.step") == 1
    kind, at = position(27, 20, 1, 3)
    assert (kind, at) == ("edge", pytest.approx([27, 20], abs=1e-9))
    page.get_by_label("Grid in µm").fill("2.5")
    page.get_by_label("Grid in µm").press("Enter")
    kind, at = position(32.5, 12.5, 1, 1)
    assert (kind, at) == ("grid", pytest.approx([32.5, 12.5], abs=1e-9))
    page.keyboard.down("Control")
    kind, at = position(20, 20, 5, -4)
    page.keyboard.up("Control")
    assert kind == "free"
    assert np.hypot(at[0] - 20, at[1] - 20) * page.evaluate("studio.panes.b.map.scale") == pytest.approx(
        np.hypot(5, 4), abs=0.2
    )
    click(page, (20, 20))
    page.keyboard.down("Shift")
    kind, at = position(30, 21)
    assert (kind, at) == ("direction", pytest.approx([30, 20]))
    kind, at = position(5, 6)
    assert (at[0] - 20) == pytest.approx(at[1] - 20)
    page.keyboard.up("Shift")


def test_grid_of_settings_is_the_step(edit):
    page = edit("polygon", layout={"snap_um": 0.25})
    assert page.evaluate("studio.editor.step") == 0.25
    use(page, "vertex")
    drag(page, (20, 20), (25, 30))
    settle(page)
    assert edits(page)[0]["tolerance_um"] > 0.25 / np.sqrt(2)
    assert areas(page).sum() == pytest.approx(N_SITES * PITCH_UM**2)


def test_keyboard_alone_draws_and_moves(edit):
    page = edit("polygon")
    page.focus("#map .marks")
    page.keyboard.press("r")
    page.get_by_label("Grid in µm").fill("10")
    page.get_by_label("Grid in µm").press("Enter")
    page.focus("#map .marks")
    page.keyboard.press("Enter")  # the centre of the view
    for key in ("ArrowRight", "ArrowRight", "ArrowUp"):
        page.keyboard.press(key)
    page.keyboard.press("Enter")
    settle(page)
    assert edits(page)[0]["outlines_um"] == [[[0, 0], [20, 0], [20, 10], [0, 10]]]
    page.keyboard.press("n")
    page.keyboard.press("ArrowUp")  # the next vertex above
    at = page.evaluate("studio.editor.at")
    assert at["kind"] == "vertex"
    page.keyboard.press("Enter")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Enter")
    settle(page)
    assert edits(page)[1]["kind"] == "move_vertices"
    page.keyboard.press("p")
    field = page.get_by_label("Position in µm")
    for text in ("-240, 220", "@10, 0", "@0, 10.5"):
        field.fill(text)
        field.press("Enter")
    field.press("Enter")
    until(page, "() => (studio.state.settings.layout.edits || []).length === 3")
    settle(page)

    assert edits(page)[2]["outlines_um"] == [[[-100, -100], [-90, -100], [-90, -89.5]]]
    page.keyboard.press("Escape")
    page.focus("#map .marks")
    page.keyboard.press("v")
    page.keyboard.press("e")
    assert page.is_hidden(".tool-strip")


def test_typed_positions_replace_each_other(edit):
    page = edit("polygon")
    page.get_by_label("Position in µm").focus()
    for text in ("-240, 220", "@10, 0", "@0, 10.5"):
        page.keyboard.type(text)
        page.keyboard.press("Enter")
        until(page, "() => studio.page.asked === null")  # the page has written the position that was placed
    page.keyboard.press("Enter")
    settle(page)

    assert edits(page)[0]["outlines_um"] == [[[-100, -100], [-90, -100], [-90, -89.5]]]


def test_editor_fits_width(edit):
    page = edit("polygon", width=2560, height=1440)
    for width, scheme in itertools.product((2560, 1280, 390), ("light", "dark")):
        page.set_viewport_size({"width": width, "height": 844 if width < 500 else width * 9 // 16})
        page.emulate_media(color_scheme=scheme)
        settle(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.locator("#map").bounding_box()["width"] > 200
        assert page.locator(".tool-strip button").last.is_visible()


@pytest.mark.filterwarnings("ignore:the layout measures")
def test_drawn_settings_match_command(edit, tmp_path):
    from foveasim.config import read_shot

    page = edit("rectangle")
    drag(page, (-30, -30), (10, 10))
    settle(page)
    set_value(page, "exposure_s", 0.01)
    path = tmp_path / "shot.yaml"
    page.click("#file")
    with page.expect_download() as found:
        page.click("[data-file=yaml]")
    path.write_bytes(found.value.path().read_bytes())
    codes = page.evaluate("[...studio.panes.b.columns.find((c) => c.key === 'code').values]")

    shot = read_shot(path)
    capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)
    assert np.array_equal(capture.code, codes)


def test_layer_in_rectangle_keeps_the_rest(edit):
    page = edit("layer")
    page.locator(".tool-options").get_by_label("Generator").select_option(label="grid")
    drag(page, (10.0, 10.0), (50.0, 30.0))
    settle(page)
    (added,) = edits(page)

    assert added["region"] == [[10, 10], [50, 10], [50, 30], [10, 30]]
    assert areas(page).sum() == pytest.approx(N_SITES * 400)
    assert count(page) > N_SITES
    undo(page)
    page.evaluate("() => studio.editor.use('layer')")
    click(page, (30.0, 20.0))
    settle(page)
    (added,) = edits(page)
    assert "region" not in added
    assert added["layer"]["move_um"] == [30, 20]
