"""Sources, comparison and links on the page of the studio, in a browser."""

from __future__ import annotations

import io
import json
import zipfile

import numpy as np
import pytest
from browsers import open_chromium
from films import write_film

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from PIL import Image
from studio.page_tools import (
    TIMEOUT_MS,
    change,
    codes,
    drop,
    forget_notice,
    set_value,
    setting,
    settle,
    until,
)

from foveasim.config import read_shot

pytestmark = [
    pytest.mark.needs("chromium"),
    pytest.mark.filterwarnings("ignore:.*outside the image at the gaze"),  # frames are framed for the gaze (0, 0)
]

#: A camera that shows a moving picture.
FAKE_CAMERA = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
SIZE = (48, 32)


def photograph(k):
    return np.random.default_rng(k).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


def png(k):
    buffer = io.BytesIO()
    Image.fromarray(photograph(k)).save(buffer, "PNG")
    return buffer.getvalue()


def video(tmp_path, name="clip.mp4", n_frames=12):
    """Return a video whose frames differ in their brightness."""
    codec, pixels = {"mp4": ("mpeg4", "yuv420p"), "avi": ("mpeg4", "yuv420p"), "gif": ("gif", "rgb8")}[name[-3:]]
    frames = [np.full((SIZE[1], SIZE[0], 3), 40 + 15 * k, np.uint8) for k in range(n_frames)]
    for frame in frames:
        frame[: SIZE[1] // 2] //= 2
    return write_film(tmp_path / name, frames, rate=10, codec=codec, pixels=pixels).read_bytes()


def film(page):
    until(page, "() => studio.state.film && !document.getElementById('film').hidden")
    settle(page)
    return page.evaluate("studio.state.film")


def unzipped(page, directory):
    page.click("#file")
    with page.expect_download() as download:
        page.click("[data-file=zip]")
    with zipfile.ZipFile(download.value.path()) as archive:
        archive.extractall(directory)
        return sorted(archive.namelist())


def codes_of(path):
    shot = read_shot(path)
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code


def drop_all(page, files):
    page.evaluate(
        """(files) => { const data = new DataTransfer(); for (const [name, bytes] of files) data.items.add(new File([new Uint8Array(bytes)], name));
        for (const type of ["dragenter", "dragover", "drop"]) document.body.dispatchEvent(new DragEvent(type, { dataTransfer: data, bubbles: true, cancelable: true })); }""",
        [[name, list(content)] for name, content in files],
    )


def hold_frames(page):
    """Show each frame of the video only when the test calls ``release``; ``shown`` lists those that were asked for."""
    page.evaluate("""() => { const { film } = studio.sources, { show } = film;
      Object.assign(window, { shown: [], release: null, releaseAll: () => { film.show = show; release?.(); } });
      film.show = async (n, isFinal) => { shown.push(n); await new Promise((resolve) => { release = resolve; }); return show(n, isFinal); }; }""")


def forget_messages(page):
    """Remove the last problem and notice, so that the same ones can be awaited again."""
    forget_notice(page)
    page.evaluate("() => { document.getElementById('problem').hidden = true; }")


def message(page, pattern):
    """Wait for a problem, or for a notice, which the page may have hidden since."""
    until(
        page,
        "pattern => ['problem:not([hidden])', 'notice'].some((id) => new RegExp(pattern).test(document.querySelector('#' + id)?.textContent))",
        pattern,
    )


# -- videos -----------------------------------------------------------------------------------------------------------------


def test_dropped_video_shows_its_frames(visit, tmp_path):
    page = visit()
    for name in ("clip.mp4", "clip.avi", "clip.gif"):
        drop(page, name, video(tmp_path, name))
        about = film(page)

        assert (about["kind"], about["n"], about["n_frames"]) == ("video", 0, 12)
        first = codes(page)
        page.click("[aria-label='One frame forward']")
        until(page, "() => studio.state.film.n === 1")
        settle(page)
        second = codes(page)
        assert second.mean() > first.mean()
        page.locator("#transport input").fill("11")
        until(page, "() => studio.state.film.n === 11")
        settle(page)
        assert codes(page).mean() > second.mean()
        page.click("[aria-label='One frame back']")
        until(page, "() => studio.state.film.n === 10")
        settle(page)
        assert "11 / 12" in page.inner_text("#transport .quiet")
        change(page, "() => { studio.connection.send({ do: 'undo' }); }")
        assert setting(page, "scene.picture") == "skimage:astronaut"
        assert page.is_hidden("#film")


def test_video_plays_while_gaze_moves(visit, tmp_path):
    page = visit()
    drop(page, "clip.mp4", video(tmp_path))
    film(page)
    page.click("[aria-label='Play']")
    until(page, "() => studio.state.film.n >= 3")
    page.evaluate("() => { studio.connection.set('gaze_um', [-100, 250], true); }")
    until(page, "() => studio.state.film.n === 11 && !studio.sources.film.isPlaying")
    settle(page)

    assert setting(page, "gaze_um") == [-100, 250]
    change(page, "() => { studio.connection.send({ do: 'undo' }); }")
    assert setting(page, "gaze_um") == [-140.0, 320.0]
    assert page.evaluate("studio.state.film.n") == 11
    change(page, "() => { studio.connection.send({ do: 'undo' }); }")
    assert setting(page, "scene.picture") == "skimage:astronaut"


def test_frames_are_archived_and_stepped_by_keys(visit, tmp_path):
    page = visit()
    drop(page, "clip.mp4", video(tmp_path))
    film(page)
    page.evaluate("() => { studio.sources.film.go(7); }")
    until(page, "() => studio.state.film.n === 7")
    settle(page)
    names = unzipped(page, tmp_path / "all")

    assert {"clip_frame_7.png", "test.yaml", "test.py", "test.ipynb"} <= set(names)
    assert np.array_equal(codes(page), codes_of(tmp_path / "all" / "test.yaml"))

    # Keys and buttons continue from the frame that is wanted, not from that of the last answer.
    page.evaluate("() => { studio.sources.film.go(0); }")
    until(page, "() => studio.state.film.n === 0")
    settle(page)
    hold_frames(page)

    def release(n):
        page.evaluate("() => release()")
        until(page, "n => shown.length === n", n)

    slider = page.locator("#transport input[type=range]")
    slider.press("ArrowRight")
    slider.press("ArrowRight")
    release(2)
    assert slider.input_value() == "2"
    slider.press("ArrowRight")
    page.click("[aria-label='One frame forward']")
    page.click("[aria-label='One frame forward']")
    release(3)
    page.click("[aria-label='One frame back']")
    release(4)
    page.evaluate("() => release()")
    settle(page)

    assert page.evaluate("shown") == [1, 2, 5, 4]
    assert slider.input_value() == "4"


def test_unreadable_sources_give_one_line(visit, tmp_path):
    page = visit()
    before = codes(page)
    drop(page, "notes.mp4", b"This is a text.\n" * 50)
    message(page, r"notes\.mp4.*not a readable video")
    drop(page, "cut.mp4", video(tmp_path)[:300])
    message(page, r"cut\.mp4")

    assert page.is_hidden("#film")
    assert np.array_equal(codes(page), before)
    assert not page.is_disabled("#freeze")

    forget_messages(page)
    start_camera(page)
    message(page, "There is no camera|does not permit")

    assert page.is_hidden("#film")
    assert setting(page, "scene.picture") == "skimage:astronaut"


def test_empty_and_large_files_give_one_line(visit):
    page = visit(is_checked=False)
    before = codes(page)
    drop(page, "empty.png", b"")
    message(page, r"empty\.png: the file is empty")
    page.evaluate(
        """() => { const data = new DataTransfer(); data.items.add(new File([new Uint8Array(65 * 2 ** 20)], "large.png"));
        document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true })); }"""
    )
    message(page, r"large\.png: (files may have at most 64 MiB|The server)")

    assert np.array_equal(codes(page), before)


# -- folders and charts ---------------------------------------------------------------------------------------------------------


def test_folder_becomes_a_film_strip(visit, tmp_path):
    page = visit()
    drop_all(page, [(f"picture {k}.png", png(k)) for k in (10, 2, 1)])
    until(page, "() => !document.getElementById('strip').hidden")
    settle(page)

    assert page.locator("#strip button").evaluate_all("all => all.map((b) => b.title)") == [
        "picture 1.png",
        "picture 2.png",
        "picture 10.png",
    ]
    assert "picture_1" in setting(page, "scene.picture")
    page.locator("#strip button").nth(2).click()
    until(page, "() => /picture_10/.test(studio.state.settings.scene.picture)")
    settle(page)
    assert page.locator("#strip [aria-current=true]").get_attribute("title") == "picture 10.png"
    page.click("[aria-label='Play']")
    until(page, "() => studio.sources.film.n === 2 && !studio.sources.film.isPlaying", None)
    settle(page)
    names = unzipped(page, tmp_path / "all")
    assert "picture_10.png" in names
    assert np.array_equal(codes(page), codes_of(tmp_path / "all" / "test.yaml"))
    page.click("#film [aria-label='Close']")
    assert page.is_hidden("#strip")


def test_corrupt_picture_of_folder_is_named(visit):
    page = visit()
    drop_all(page, [("a.png", png(1)), ("b.png", b"no picture")])
    until(page, "() => !document.getElementById('strip').hidden")
    settle(page)
    page.locator("#strip button").nth(1).click()
    message(page, r"b\.png")
    settle(page)

    assert "a.png" in setting(page, "scene.picture")


@pytest.mark.slow
def test_source_menu_selects_test_chart(visit):
    page = visit()
    page.focus("#source")
    page.keyboard.press("Enter")
    page.locator("#source-menu button", has_text="Siemens star").click()
    until(page, "() => studio.state.settings.scene.kind === 'siemens_star' && studio.isIdle")

    assert page.evaluate("Object.keys(studio.state.errors).length") == 0
    assert len(np.unique(codes(page))) > 2


# -- camera -------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def camera_browser(browser):
    chromium = open_chromium(browser.browser_type, *FAKE_CAMERA)
    yield chromium
    chromium.close()


@pytest.fixture
def visit_camera(server, camera_browser):
    """Open a page of a browser with a camera."""
    contexts = []

    def open_page(**options):
        context = camera_browser.new_context(viewport={"width": 1280, "height": 800}, **{"bypass_csp": True, **options})
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(TIMEOUT_MS)
        page.goto(server.address)
        settle(page)
        return page

    yield open_page
    for context in contexts:
        context.close()


def start_camera(page):
    page.click("#source")
    page.locator("#source-menu button", has_text="Camera").click()


def test_camera_frames_follow_live(visit_camera, tmp_path):
    page = visit_camera()
    start_camera(page)
    until(page, "() => studio.state.film && studio.state.film.n >= 4")
    first = page.evaluate("studio.state.film")
    assert (first["kind"], first["width"], first["height"]) == ("camera", 480, 360)
    before = codes(page)
    until(page, "n => studio.state.film.n >= n + 8", first["n"])
    assert not np.array_equal(codes(page), before)
    page.evaluate("() => { studio.connection.set('exposure_s', 0.01, true); }")
    until(page, "() => studio.state.settings.exposure_s === 0.01")
    page.click("#film button:has-text('Stop')")
    settle(page)
    n = page.evaluate("studio.state.film.n")
    # A frame of the camera would come before the answer to a later message.
    change(page, "() => { studio.connection.send({ do: 'pin', sites: [] }); }")
    assert page.evaluate("studio.state.film.n") == n
    names = unzipped(page, tmp_path / "all")
    assert sum(name.startswith("camera_") for name in names) == 1
    assert np.array_equal(codes(page), codes_of(tmp_path / "all" / "test.yaml"))
    # One step for the camera and one for the exposure, however many frames there were.
    change(page, "() => { studio.connection.send({ do: 'undo' }); studio.connection.send({ do: 'undo' }); }")
    assert setting(page, "scene.picture") == "skimage:astronaut"
    assert page.is_disabled("#undo")


def test_restarted_camera_sends_frames_once(visit_camera):
    page = visit_camera()
    start_camera(page)
    until(page, "() => studio.state.film && studio.state.film.n >= 2")
    page.evaluate("""() => { const { sources } = studio, answered = sources._shown.bind(sources);
      window.waiting = window.most = 0;
      sources._shown = async (id) => { window.most = Math.max(window.most, ++window.waiting); const found = await answered(id); window.waiting--; return found; };
      sources.stopCamera(); sources.startCamera(); }""")
    until(page, "() => studio.sources.isLive && studio.state.film.n >= 2")
    page.evaluate("() => { window.most = 0; }")
    n = page.evaluate("studio.state.film.n")
    until(page, "n => studio.state.film.n >= n + 4", n)

    assert page.evaluate("most") == 1
    assert page.evaluate("studio.sources.camera.isOn")


def test_frames_fit_into_messages(visit):
    page = visit()
    sizes = page.evaluate("""async () => { const { Camera } = await import("/static/camera.js"), camera = new Camera(), found = [];
      camera.size = 640;
      for (const [width, height] of [[640, 480], [480, 640], [1280, 1280], [1920, 1080], [100, 80]]) {
        const canvas = document.createElement("canvas");
        canvas.width = width; canvas.height = height;
        canvas.videoWidth = width; canvas.videoHeight = height;
        camera.video = canvas;
        const frame = camera.frame();
        found.push([frame.width, frame.height, frame.pixels.length]);
      }
      return found; }""")

    assert [size[:2] for size in sizes] == [[640, 480], [480, 640], [572, 572], [640, 360], [100, 80]]
    assert max(size[2] for size in sizes) < 2**20 - 1000


def test_undo_stops_the_camera(visit_camera):
    page = visit_camera()
    start_camera(page)
    until(page, "() => studio.state.film && studio.state.film.n >= 2")
    page.click("#undo")
    until(page, "() => !studio.sources.camera.isOn && studio.state.film === null")

    assert setting(page, "scene.picture") == "skimage:astronaut"
    assert page.is_hidden("#film")


# -- comparison ---------------------------------------------------------------------------------------------------------------


def rows(page):
    until(page, "() => document.querySelectorAll('#comparison tr').length > 5")
    settle(page)
    found = page.locator("#comparison tr[data-name]").evaluate_all(
        "all => all.map((row) => [row.dataset.name, [...row.querySelectorAll('td')].map((cell) => cell.textContent)])"
    )
    return dict(found)


def test_match_gives_the_same_number_of_sites(visit):
    page = visit()
    page.click("#freeze")
    form = page.locator(".control[data-key='layout'] select")
    form.evaluate("select => { select.closest('details').open = true; }")
    form.select_option(label="grid")
    until(page, "() => studio.isIdle && studio.state.settings.layout.generator === 'grid'")
    until(page, "() => document.querySelectorAll('#comparison tr.differs').length > 5")
    before = rows(page)
    assert before["n_sites"] == ["912", "14,400", "+13,490"]
    page.select_option("#match-what", "n_sites")
    page.click("#match")
    until(page, "() => studio.isIdle && studio.panes.b.sites.n < 2000")
    after = rows(page)

    assert after["n_sites"] == ["912", "900", "−12"]
    assert page.evaluate("studio.state.summary.width_um") == pytest.approx(960.0, rel=1e-6)
    assert all(
        value.endswith(" dB") and float(value[:-3]) > 5
        for value in after["fovea_psnr_db"][:2] + after["field_psnr_db"][:2]
    )
    assert page.locator("#comparison tr[data-name=fovea_psnr_db] th").inner_text() == "PSNR, fovea (fields differ)"
    assert "The fields differ: A 1,377 × 1,377 µm, B 960 × 960 µm" in page.inner_text("#comparison-note")
    page.select_option("#match-what", "field")
    page.click("#match")
    until(page, "() => studio.isIdle && studio.state.summary.width_um > 1300")
    assert page.evaluate("studio.state.summary.width_um") == pytest.approx(1377.3, rel=1e-3)
    until(page, "() => document.getElementById('comparison-note').textContent === ''")
    page.click("#freeze")
    assert page.is_hidden("#comparison")


def test_equal_variants_have_equal_rows(visit):
    page = visit()
    page.click("#freeze")
    found = rows(page)

    assert all(a == b and difference == "0" for a, b, difference in found.values())
    assert found["bits_per_frame"] == ["9,120", "9,120", "0"]
    assert found["frames_per_s"] == ["50 /s", "50 /s", "0"]
    assert page.locator("#comparison .best").count() == 0


# -- notebook, archive, links ---------------------------------------------------------------------------------------------------


def test_notebook_of_page_names_its_files(visit, tmp_path):
    page = visit()
    drop(page, "photo.png", png(3))
    until(page, "() => /photo/.test(studio.state.settings.scene.picture) && studio.isIdle")
    page.click("#file")
    with page.expect_download() as download:
        page.click("[data-file=notebook]")
    cells = json.loads(download.value.path().read_text("utf-8"))["cells"]

    assert "`photo.png`" in cells[0]["source"]
    assert '"photo.png"' in "".join(cell["source"] for cell in cells)


def copied_link(page, name):
    page.evaluate("() => { window.copied = null; navigator.clipboard.writeText = async (text) => { copied = text; }; }")
    page.click("#file")
    page.click(f"[data-do={name}]")
    until(page, "() => copied !== null")
    return page.evaluate("copied")


def test_link_restores_the_state(visit, server):
    page = visit()
    set_value(page, "optics.f_number", 4.0)
    wanted = codes(page)
    shared, own = copied_link(page, "share"), copied_link(page, "link")
    token = server.address.split("#")[1]
    assert token not in shared
    assert own.startswith(server.address + "&state=")

    other = visit()
    other.click("#file")
    other.click("[data-do=open-link]")
    other.fill("#link-text", shared)
    other.click("#link-form button[value=open]")
    until(other, "() => studio.state.settings.optics.f_number === 4 && studio.isIdle")
    assert np.array_equal(codes(other), wanted)
    third = visit(address=own)
    until(third, "() => window.studio && studio.isIdle && studio.state.settings.optics.f_number === 4")
    assert np.array_equal(codes(third), wanted)
    assert third.evaluate("location.hash") == "#" + token
    assert third.is_enabled("#undo")


def open_link(page, link):
    page.click("#file")
    page.click("[data-do=open-link]")
    page.fill("#link-text", link)
    page.click("#link-form button[value=open]")


def test_invalid_links_give_one_line(visit):
    page = visit()
    large = page.evaluate("""async () => {
      const stream = new Blob([new Uint8Array(5e7)]).stream().pipeThrough(new CompressionStream("deflate-raw"));
      const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
      return "#state=" + btoa(Array.from(bytes, (b) => String.fromCharCode(b)).join("")).replaceAll("+", "-").replaceAll("/", "_");
    }""")
    for link, text in (
        ("hello", "not a link of the studio"),
        ("http://127.0.0.1/#state=AAAA", "not one of the studio"),
        ("#state=!!!", "not one of the studio"),
        (large, "not one of the studio"),
    ):
        forget_messages(page)
        open_link(page, link)

        message(page, text)


def test_links_cannot_name_other_files(visit):
    page = visit()
    link = page.evaluate("""async () => {
      const settings = structuredClone(studio.state.settings);
      settings.scene.picture = "/etc/passwd";
      const { fragmentOf } = await import("/static/links.js");
      return "#" + await fragmentOf(JSON.stringify(settings));
    }""")
    open_link(page, link)
    message(page, "'/etc/passwd' is not available here; upload the file")

    assert setting(page, "scene.picture") == "skimage:astronaut"


def test_link_lists_uploaded_files(visit):
    page, other = visit(), visit()
    drop(page, "photo.png", png(3))
    until(page, "() => /photo/.test(studio.state.settings.scene.picture) && studio.isIdle")
    link = copied_link(page, "share")
    message(page, r"only the names of uploaded files: photo\.png")
    other.evaluate("link => { location.hash = link.slice(link.indexOf('#')); }", link)
    message(other, r"'photo\.png' is not available here; upload the file")


def chosen_file(page, key, label, name, content):
    """Choose an alternative with a file."""
    row = page.locator(f"[data-id='{key}']")
    page.evaluate("(key) => { studio.controls.rows.get(key).root.closest('details').open = true; }", key)
    page.locator("#search").fill(key)
    with page.expect_file_chooser() as chooser:
        row.locator("select").select_option(label=label)
    chooser.value.set_files({"name": name, "mimeType": "application/octet-stream", "buffer": content})


def test_files_are_chosen_at_settings(visit):
    page = visit()
    calibration = (
        b"image_width: 640\nimage_height: 480\ncamera_matrix: [800, 0, 319.5, 0, 800, 239.5, 0, 0, 1]\n"
        b"distortion_coefficients: [-0.2, 0.05, 0, 0]\n"
    )
    chosen_file(page, "distortion", "calibration…", "left.yaml", calibration)
    page.locator("#parameters-dialog").wait_for(timeout=TIMEOUT_MS)
    assert page.locator("#parameters-names").inner_text().startswith("Parameters: pixel_um, focal_um")
    page.get_by_role("button", name="Use the file").click()
    assert page.locator("#parameters-error").inner_text() == "Required: pixel_um"
    page.locator("#parameters-text").fill("pixel_um: 3.0\nsize: 2")
    page.get_by_role("button", name="Use the file").click()
    assert page.locator("#parameters-error").inner_text() == "Not a parameter: size"
    page.locator("#parameters-text").fill("pixel_um: 3.0")
    page.get_by_role("button", name="Use the file").click()
    until(page, "studio.state.settings.distortion?.pixel_um === 3")
    settle(page)

    assert setting(page, "distortion.path").endswith("left.yaml")
    assert page.locator("[data-id='distortion.path'] input").input_value() == "left.yaml"
    with page.expect_file_chooser() as chooser:
        page.get_by_role("button", name="Choose a file for path").click()
    other = calibration.replace(b"-0.2", b"-0.1")
    chooser.value.set_files({"name": "right.yaml", "mimeType": "application/octet-stream", "buffer": other})
    until(page, "studio.state.settings.distortion.path.endsWith('right.yaml')")
    settle(page)
    assert page.evaluate("studio.state.errors") == {}
