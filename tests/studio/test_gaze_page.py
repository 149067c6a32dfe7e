"""Gaze paths on the page of the studio, in a browser: record, edit, replay, files, keyboard."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from reference.accessibility import violations_in_themes
from studio.page_tools import Keys, change, codes, drop, hold_clock, pass_time, set_value, setting, settle, until
from studio.test_sources_page import film, hold_frames, video

from foveasim.cli import app
from foveasim.config import read_shot
from foveasim.video import GazePath, read_recording

pytestmark = [
    pytest.mark.needs("chromium"),
    pytest.mark.filterwarnings("ignore:.*outside the image at the gaze"),  # frames are framed for the gaze (0, 0)
]

#: Buttons of the row.
RECORD, TABLE = "#gaze .record", "#gaze [aria-label='Show the rows of the gaze path']"
#: Frame period of the video, and the gaze that the tests record at some of its frames.
FRAME_S = 0.1
RECORDED = {0: [0.0, 0.0], 2: [60.0, 20.0], 5: [-40.0, 35.0], 9: [25.0, -30.0]}
ROWS = [[0.0, -140.0, 320.0], [0.2, 60.0, 120.0], [0.4, -200.0, 100.0]]


def gaze(page):
    return setting(page, "gaze_um")


def path_of(page):
    return setting(page, "gaze_path")


def steps(page):
    """Return the number of undo steps, by undoing all and repeating them."""
    n = 0
    while page.is_enabled("#undo"):
        change(page, "() => { studio.connection.send({ do: 'undo' }); }")
        n += 1
    for _ in range(n):
        change(page, "() => { studio.connection.send({ do: 'redo' }); }")
    return n


def drag(page, by, n_moves=4):
    """Drag the outline by CSS pixels, with a held clock."""
    x, y = page.evaluate("() => studio.toWindow(0, 0, 'scene')")
    page.mouse.move(x + 6, y + 12)
    page.mouse.down()
    for k in range(1, n_moves + 1):
        page.mouse.move(x + 6 + by[0] * k / n_moves, y + 12 + by[1] * k / n_moves)
        pass_time(page, 60)
    page.mouse.up()
    settle(page)


def interpolated(rows, t_s):
    times, x, y = np.transpose(rows)
    return [float(np.interp(t_s, times, each)) for each in (x, y)]


def with_rows(page, rows=ROWS):
    page.click("#gaze-path")
    set_value(page, "gaze_path", rows)


# -- recording ----------------------------------------------------------------------------------------------------------------


def test_recording_over_picture_is_one_step(visit):
    page = visit()
    page.click("#gaze-path")
    page.click(RECORD)
    page.click(RECORD)

    assert page.inner_text("#notice") == "No movement of the gaze was recorded"
    assert path_of(page) is None
    assert page.is_disabled("#undo")

    start = gaze(page)
    hold_clock(page)
    page.click(RECORD)
    pass_time(page, 300)
    drag(page, (30, -12))
    pass_time(page, 300)
    drag(page, (-20, 10))
    page.click(RECORD)
    settle(page)
    rows = path_of(page)
    moved_ms = [300, 360, 420, 480, 540, 840, 900, 960, 1020, 1080]
    expected = {round(30e-3 * ms) for ms in moved_ms}
    # The rest before a movement is recorded too.
    expected |= {0} | {k - 1 for k in expected}

    assert rows[0] == [0, *start]
    np.testing.assert_allclose([30 * t for t, *_ in rows], sorted(expected), atol=1e-9)
    assert rows[-1][1:] == gaze(page) != start
    assert steps(page) == 1
    assert rows[1][1:] == pytest.approx(start)
    change(page, "() => { studio.connection.send({ do: 'undo' }); }")
    assert (gaze(page), path_of(page)) == (start, None)


def test_recorded_video_runs_on_command_line(visit, server, tmp_path):
    """Record and replay over a video, save, and run ``foveasim video`` on the saved shot."""
    page = visit()
    content = video(tmp_path)
    drop(page, "clip.mp4", content)
    film(page)
    set_value(page, "gaze_um", [0.0, 0.0])
    set_value(page, "sensor.disabled", ["shot"])
    set_value(page, "sensor.read_noise_e", 0.0)
    page.click("#gaze-path")
    page.click(RECORD)
    for n, (x, y) in RECORDED.items():
        page.evaluate("n => studio.sources.film.go(n)", n)
        until(page, "n => studio.state.film.n === n", n)
        settle(page)
        page.evaluate(
            "([x, y]) => { const [a, b] = studio.gazePanel.recordedAt; studio.panes.scene.on.gaze(x - a, y - b, true); }",
            [x, y],
        )
        settle(page)
    page.click(RECORD)
    settle(page)
    rows = path_of(page)
    expected = [[n * FRAME_S, *RECORDED[n]] for n in RECORDED if n > 0]
    np.testing.assert_allclose([row for row in rows if row[0] > 0.0], expected, atol=1e-9)

    page.evaluate("() => studio.gazePanel.film.go(0)")
    settle(page)
    # Replay: each state has the gaze of its frame.
    page.evaluate(
        """() => { window.shown = []; const { usePath, use } = studio.gazePanel;
        studio.gazePanel.use = (state) => { shown.push([state.film.n, ...state.settings.gaze_um]); use.call(studio.gazePanel, state); }; }"""
    )
    page.click("[aria-label='Play the gaze path']")
    until(page, "() => !studio.gazePanel.film.isPlaying && studio.state.film.n === 11")
    settle(page)
    shown = page.evaluate("shown")
    # A slow machine skips frames.
    assert len({n for n, *_ in shown}) > 1
    replayed = [each for each in shown[1:] if each[0] > 0]
    np.testing.assert_allclose(
        [xy for _, *xy in replayed], [interpolated(rows, n * FRAME_S) for n, *_ in replayed], atol=1e-9
    )
    found = {}
    for n in (3, 5, 11):
        page.evaluate("n => studio.gazePanel.film.go(n)", n)
        until(page, "n => studio.state.film.n === n", n)
        settle(page)
        found[n] = codes(page)

    name = f"{tmp_path.name}.yaml"
    change(page, "name => { studio.connection.send({ do: 'save', name }); }", name)
    saved = server.start_of.out / name
    (tmp_path / "clip.mp4").write_bytes(content)
    command = ["video", str(saved), "--frames", str(tmp_path / "clip.mp4"), "--out", str(tmp_path / "codes.zarr")]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    recording = read_recording(tmp_path / "codes.zarr")
    np.testing.assert_allclose(recording.gaze_um, [interpolated(rows, n * FRAME_S) for n in range(12)], atol=1e-9)
    assert read_shot(saved).gaze_path.rows.tolist() == rows
    for n, of_page in found.items():
        assert np.array_equal(recording.code[n], of_page)


def test_gaze_follows_pointer_while_video_plays(visit, tmp_path):
    page = visit()
    drop(page, "clip.mp4", video(tmp_path, n_frames=14))
    film(page)
    page.click("#gaze-path")
    page.click(RECORD)
    x, y = page.evaluate("() => studio.toWindow(0, 0, 'scene')")
    hold_frames(page)
    page.evaluate("() => { studio.sources.film.isSkipping = false; studio.sources.film.play(); }")
    page.mouse.move(x, y)
    page.mouse.down()
    for k in range(1, 5):
        page.mouse.move(x + 6 * k, y - 4 * k)
        until(page, "k => shown.length === k", k)
        page.evaluate("() => release()")
        until(page, "k => studio.state.film.n === k", k)
    page.mouse.up()
    page.evaluate("() => { studio.sources.film.pause(); releaseAll(); }")
    settle(page)
    page.click(RECORD)
    settle(page)
    rows = path_of(page)
    positions = np.array(rows)[:, 1:]

    np.testing.assert_allclose([t / FRAME_S for t, *_ in rows], range(5), atol=1e-9)
    # Frame k came after movement k, and before the next one.
    assert (np.diff(positions[:4], axis=0) > 0.1).all()
    np.testing.assert_array_equal(positions[4], positions[3])
    # Another recording replaces the rows of its frames only.
    page.evaluate("() => studio.sources.film.go(13)")
    until(page, "() => studio.state.film.n === 13")
    settle(page)
    page.click(RECORD)
    page.evaluate("() => studio.panes.scene.on.gaze(5, 5, true)")
    page.click(RECORD)
    settle(page)
    assert path_of(page)[:-1] == [row for row in rows if row[0] < 1.25]
    assert path_of(page)[-1][0] == pytest.approx(1.3)


# -- replay -------------------------------------------------------------------------------------------------------------------


def test_replay_and_slider_follow_the_path(visit):
    page = visit()
    with_rows(page)
    n_steps = steps(page)
    page.evaluate(
        """() => { window.shown = []; const { _follow } = studio.gazePanel; studio.gazePanel._follow = async function (n, isFinal) {
        const isShown = await _follow.call(this, n, isFinal); shown.push([this._timeOf(n), ...studio.state.settings.gaze_um]); return isShown; }; }"""
    )
    page.click("[aria-label='Play the gaze path']")
    until(page, "() => !studio.gazePanel.film.isPlaying && studio.gazePanel.film.n > 0")
    settle(page)
    shown = page.evaluate("shown")

    np.testing.assert_allclose([xy for _, *xy in shown], [interpolated(ROWS, t) for t, *_ in shown], atol=1e-9)
    assert gaze(page) == ROWS[-1][1:]
    assert page.inner_text("#transport .quiet") == "0.40 s · -200.0, 100.0 µm"
    assert page.evaluate("studio.panes.scene.position") == ROWS[-1][1:]
    assert steps(page) == n_steps + 1

    before = steps(page)
    page.locator("#transport input[type=range]").fill("3")
    settle(page)

    assert gaze(page) == pytest.approx(interpolated(ROWS, 0.1))
    assert page.locator("#transport input[type=range]").get_attribute("aria-valuetext").startswith("0.10 s")
    assert steps(page) == before + 1


def test_pause_keeps_the_last_position(visit):
    page = visit()
    with_rows(page, [[0, 0, 0], [600, 400, 0]])  # longer than any test
    before = steps(page)
    page.click("[aria-label='Play the gaze path']")
    until(page, "() => studio.gazePanel.film.n > 3")
    page.click("[aria-label='Pause the gaze path']")
    settle(page)
    n, (x, y) = page.evaluate("studio.gazePanel.film.n"), gaze(page)

    assert (x, y) == pytest.approx((400.0 / 600.0 * n / 30.0, 0.0))
    assert steps(page) == before + 1


# -- editing ------------------------------------------------------------------------------------------------------------------


def test_points_are_dragged_on_the_image(visit):
    page = visit()
    with_rows(page)
    target = "(k) => { const [t, x, y] = studio.gazePanel.rows[k], { marks } = studio.panes.scene, box = marks.getBoundingClientRect(), view = studio.panes.scene.view(); return [box.left + view.toX(x), box.top + view.toY(y), view.perUm]; }"
    x, y, per_um = page.evaluate(target, 2)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 10, y + 6, steps=3)
    page.mouse.up()
    settle(page)
    rows = path_of(page)

    assert rows[:2] == ROWS[:2]
    assert rows[2] == pytest.approx([0.4, -200.0 + 10 / per_um, 100.0 - 6 / per_um], abs=0.2)
    assert steps(page) == 2
    # A click shows the time of a point.
    x, y, _ = page.evaluate(target, 1)
    page.mouse.click(x, y)
    settle(page)
    assert page.evaluate("studio.gazePanel.time") == pytest.approx(0.2)
    assert gaze(page) == pytest.approx(ROWS[1][1:])


def test_table_edits_are_undo_steps(visit):
    page = visit()
    with_rows(page)
    page.click(TABLE)
    page.fill("[aria-label='x of row 2, µm']", "0.07 mm")
    page.keyboard.press("Enter")
    settle(page)
    assert path_of(page)[1] == [0.2, 70, 120]
    page.fill("[aria-label='time of row 1, s']", "1/4")
    page.keyboard.press("Enter")
    settle(page)
    assert [row[0] for row in path_of(page)] == [0.2, 0.25, 0.4]
    page.fill("[aria-label='time of row 1, s']", "0.25")
    page.keyboard.press("Enter")
    until(page, "() => document.querySelector('#transport .quiet.wrong')")
    assert "0.25 s in row 2 after 0.25 s in row 1" in page.inner_text("#transport .quiet")
    until(page, "() => document.querySelector(\"[aria-label='time of row 1, s']\").value === '0.2'")
    page.click("[aria-label='Delete row 3']")
    settle(page)
    assert [row[0] for row in path_of(page)] == [0.2, 0.25]
    page.evaluate("() => studio.gazePanel.film.go(3)")
    settle(page)
    set_value(page, "gaze_um", [11, 12])
    page.click("[aria-label='Insert the present gaze at the present time']")
    settle(page)
    assert path_of(page)[0] == pytest.approx([0.1, 11, 12])
    assert len(path_of(page)) == 3


def test_long_paths_are_shown_in_parts(visit):
    page = visit()
    with_rows(page, [[k / 10, k, -k] for k in range(120)])
    page.click(TABLE)

    assert page.inner_text(".gaze-head .quiet") == "1–50 of 120 rows"
    page.click("[aria-label='Later rows']")
    page.click("[aria-label='Later rows']")
    assert page.inner_text(".gaze-head .quiet") == "101–120 of 120 rows"
    page.click("[aria-label='Delete row 120']")
    settle(page)
    assert len(path_of(page)) == 119


# -- files and random paths -----------------------------------------------------------------------------------------------------


def test_files_and_saccades_are_undo_steps(visit, tmp_path):
    page = visit()
    GazePath.from_rows(ROWS).write(tmp_path / "eye.csv")
    page.click("#gaze-path")
    with page.expect_file_chooser() as chooser:
        page.click("#gaze-menu")
        page.click("#gaze .menu >> text=Open CSV…")
    chooser.value.set_files(tmp_path / "eye.csv")
    until(page, "() => studio.state.settings.gaze_path")
    settle(page)
    assert path_of(page) == ROWS
    page.click("#gaze-menu")
    with page.expect_download() as download:
        page.click("#gaze .menu >> text=Save CSV")
    shutil.copy(download.value.path(), tmp_path / "saved.csv")
    assert GazePath.read(tmp_path / "saved.csv").rows.tolist() == ROWS
    page.click("#gaze-menu")
    page.click("#gaze .menu >> text=Saccades…")
    page.fill("#saccades-dialog [name=duration_s]", "2 s")
    page.fill("#saccades-dialog [name=seed]", "5")
    page.click("#saccades-dialog [value=create]")
    until(page, "() => studio.state.settings.gaze_path?.length === 60")
    settle(page)
    page.click("#gaze-menu")
    page.click("#gaze .menu >> text=Clear")
    settle(page)
    assert path_of(page) is None
    assert steps(page) == 3


def test_dropped_file_opens_the_row(visit):
    page = visit()
    drop(page, "eye.csv", b"t_s,x_um,y_um\n0,1,2\n1,3,4\n")
    until(page, "() => !document.getElementById('gaze').hidden")
    settle(page)

    assert path_of(page) == [[0, 1, 2], [1, 3, 4]]


def test_path_survives_reload_and_restart(visit, server):
    page = visit()
    with_rows(page)
    page.reload()
    settle(page)
    assert path_of(page) == ROWS
    until(page, "() => studio.gazePanel.rows.length === 3")
    server.stop()
    server.start()
    page.reload()
    until(page, "() => window.studio?.state?.settings.gaze_path && studio.gazePanel.rows.length === 3")
    assert path_of(page) == ROWS


# -- keyboard and accessibility -----------------------------------------------------------------------------------------------


def test_path_works_by_keyboard(visit):
    page = visit()
    keys, start = Keys(page), gaze(page)
    keys.use("#gaze-path")
    hold_clock(page)
    keys.use("#gaze .record")
    keys.to("#scene .marks")
    for key in ("ArrowRight", "ArrowRight", "ArrowUp"):
        pass_time(page, 150)
        keys.press(key)
    keys.use("#gaze .record")
    settle(page)
    rows = np.array(path_of(page))
    moved = rows[-1, 1:] - start
    assert moved[0] > 0
    assert moved[0] == pytest.approx(2 * moved[1], rel=0.01)
    keys.use("#transport [aria-label='Play the gaze path']")
    until(page, "() => !studio.gazePanel.film.isPlaying && studio.gazePanel.film.n > 0")
    settle(page)
    keys.use("#gaze [aria-label='Show the rows of the gaze path']")
    keys.use("[aria-label='Delete row 1']")
    settle(page)
    assert len(path_of(page)) == len(rows) - 1
    keys.use("#gaze-menu")
    keys.press("End", "Enter")
    settle(page)
    assert path_of(page) is None
    assert keys.n_pointed == 0


@pytest.mark.nightly
def test_row_has_no_serious_violations(visit):
    page = visit(width=1920, height=844)
    with_rows(page)
    page.click(TABLE)
    for width in (1920, 1280, 390):
        page.set_viewport_size({"width": width, "height": 844})
        settle(page)
        assert violations_in_themes(page, "html" if width == 1920 else "#pane-scene") == [], width
        page.click(RECORD)
        assert violations_in_themes(page, "#pane-scene") == [], width
        page.click(RECORD)
        page.click("#gaze-menu")
        page.evaluate("() => { document.getElementById('notice').hidden = true; }")
        assert violations_in_themes(page, "#pane-scene") == [], width
        page.click("#gaze .menu >> text=Saccades…")
        assert violations_in_themes(page, "#saccades-dialog") == [], width
        row, pane = (page.locator(each).bounding_box() for each in ("#transport", "#pane-scene"))
        assert row["x"] + row["width"] <= pane["x"] + pane["width"] + 0.5
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.keyboard.press("Escape")
        page.wait_for_selector("#saccades-dialog", state="hidden")
