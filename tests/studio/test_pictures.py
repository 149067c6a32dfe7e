"""Photographs that are opened on the page: reduction of large ones, progress, and cancelling."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from foveasim._io.encodings import decode
from foveasim._io.images import read_picture
from foveasim.studio import _pictures
from foveasim.studio._pictures import reduced_picture, resolved_pixels


@pytest.fixture
def photo(tmp_path):
    def write(shape, name="photo.png", seed=0):
        pixels = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / name)
        return tmp_path / name, pixels

    return write


def unused(tmp_path):
    return lambda name: tmp_path / name


@pytest.mark.parametrize("encoding", ["srgb", "sqrt", "linear"])
@pytest.mark.parametrize("shape", [(62, 83), (62, 83, 3), (60, 80, 4)])
def test_reduced_pixels_are_means_of_radiance(tmp_path, photo, shape, encoding):
    path, pixels = photo(shape)
    target, note = reduced_picture(path, unused(tmp_path), 20, encoding)
    found = read_picture(target)
    found, pixels = (each[..., None] if each.ndim == 2 else each for each in (found, pixels))
    expected = np.array(
        [
            [pixels[3 * y : 3 * y + 3, 3 * x : 3 * x + 3] / 255.0 for x in range(shape[1] // 3)]
            for y in range(shape[0] // 3)
        ]
    )
    alpha = expected[..., 3:] if pixels.shape[2] == 4 else 1.0
    radiance = (decode(expected[..., :3], encoding) * alpha).mean(axis=(2, 3))

    assert found.dtype == np.uint16
    np.testing.assert_allclose(decode(found / 65535.0, encoding), radiance, atol=3e-5)
    assert f"{shape[1]} × {shape[0]} pixels" in note
    assert f"{shape[1] // 3} × {shape[0] // 3}" in note


def test_small_pictures_remain(tmp_path, photo):
    assert reduced_picture(photo((39, 60))[0], unused(tmp_path), 20, "srgb") is None


def test_resolved_pixels_follow_the_sensor(recorder):
    """Three pixels per side of the smallest photosite, of 12 µm on 192 µm; the limits are those of pictures."""
    shot = recorder.session.result.shot
    assert resolved_pixels(shot) == _pictures.MIN_PIXELS
    small = recorder.do(do="set", key="layout.parameters", value={"n_x": 700, "n_y": 2, "pitch_um": 1.0})
    assert small["errors"] == {}
    assert resolved_pixels(recorder.session.result.shot) == 2100


def test_large_picture_is_reduced_when_opened(recorder, photo, monkeypatch):
    monkeypatch.setattr(_pictures, "MIN_PIXELS", 50)
    path, _ = photo((200, 300, 3))
    stored = recorder.session.add_file("photo.png", path.read_bytes())
    state = recorder.do(do="file", path=str(stored), **{"as": "scene"})
    picture = state["settings"]["scene"]["picture"]

    assert state["errors"] == {}
    assert picture.endswith("photo_75x50.tif")
    assert recorder.session.result.shot.scene.basis.shape[1:] == (50, 75)
    assert ["300 × 200 pixels; it was reduced to 75 × 50" in note for note in state["notes"]] == [True]
    assert recorder.session.exported()[1].keys() == {"photo_75x50.tif"}
    assert recorder.do(do="undo")["notes"] == []


def test_stages_are_reported_and_cancelled(recorder):
    before = recorder.session.history.settings
    seen = []
    receive = recorder._receive

    def cancel(message):
        receive(message)
        if not isinstance(message, bytes) and '"progress"' in message:
            seen.append(recorder.messages[-1]["text"])
            if seen[-1] == "optical image":
                recorder.session.post({"do": "cancel"})

    recorder.session._listeners = {cancel: False}
    state = recorder.do(do="set", key="optics.f_number", value=4.0, final=True, id=3)

    assert seen[-1] == "optical image"
    assert (state["settings"], state["errors"], state["can_undo"]) == (before, {}, False)
    assert [message["text"] for message in recorder.messages if message["kind"] == "note"] == [
        "cancelled; the settings are those before"
    ]
    recorder.session._listeners = {receive: False}
    state = recorder.do(do="set", key="optics.f_number", value=4.0, final=True, id=4)
    assert state["settings"]["optics"]["f_number"] == 4.0
    assert recorder.session.result.shot.camera.optics.f_number == 4.0


def test_cancelled_start_is_repeated(make_session, settings):
    """Cancelling the first simulation leaves no flag behind."""
    recorder = make_session()
    recorder.session.result = None
    recorder.session.engine = type(recorder.session.engine)(n_threads=1, check=recorder.session.check)
    receive = recorder._receive

    def cancel(message):
        receive(message)
        if not isinstance(message, bytes) and '"progress"' in message:
            recorder.session.post({"do": "cancel"})

    recorder.session._listeners = {cancel: False}
    state = recorder.do(do="refresh", id=1)
    assert list(state["errors"].values()) == ["cancelled; the settings are those before"]
    recorder.session._listeners = {receive: False}
    assert recorder.do(do="refresh", id=2)["summary"]["n_sites"] == 224
    recorder.session.post({"do": "cancel"})  # nothing is in progress
    assert recorder.do(do="set", key="seed", value=7, id=3)["settings"]["seed"] == 7


def test_reductions_are_made_once(recorder, photo, monkeypatch):
    monkeypatch.setattr(_pictures, "MIN_PIXELS", 50)
    stored = recorder.session.add_file("photo.png", photo((200, 300, 3))[0].read_bytes())
    for _ in range(2):
        recorder.do(do="file", path=str(stored), **{"as": "scene"})
    assert sorted(path.name for path in recorder.session.uploads.iterdir() if path.is_file()) == [
        "photo.png",
        "photo_75x50.tif",
    ]
