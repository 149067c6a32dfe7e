"""Times of frames: variable frame rates in captures, shutters, events, gaze paths, recordings and the command."""

from __future__ import annotations

import json
import math
import pickle
import subprocess
import sys
from fractions import Fraction
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from films import write_film
from PIL import Image
from typer.testing import CliRunner

import foveasim as fs
from foveasim.cli import app
from foveasim.config import read_shot, run_video
from foveasim.errors import ConfigError, FileError, FoveasimWarning, ParameterError
from foveasim.modes import EventPixels, Exposure, Shutter, SpikingPixels
from foveasim.video import FrameSource, GazePath, follow_gaze, read_recording, shift_sensor, write_video

TIMES_S = [0.0, 0.1, 0.5, 0.6, 0.65, 2.0]
LIGHT = {"pitch_um": 100.0, "distance_m": 0.5, "peak_radiance_w_m2_sr_nm": 0.1}
OPTICS = fs.Optics(focal_length_mm=22.0, f_number=4.0)
SETTINGS = {
    "scene": {"kind": "picture", "picture": "scene.png", "fit": "cover", "distance_m": 0.5, "peak_radiance_w_m2_sr_nm": 0.0005,
              "wavelength_nm": [550.0], "band_width_nm": 10.0},
    "optics": {"focal_length_mm": 22.0, "f_number": 4.0},
    "layout": {"generator": "hexagonal", "parameters": {"n_columns": 6, "n_rows": 5, "pitch_um": 40.0}},
    "sensor": {"bits": 12, "capacitance_f": 1e-13},
    "exposure_s": 0.01,
    "seed": 1,
}  # fmt: skip


def camera(n_y=4, pitch_um=30.0, **sensor):
    layout = fs.layout.grid(n_x=3, n_y=n_y, pitch_um=pitch_um)
    row = np.rint((layout.centroid_um[:, 1] - layout.centroid_um[:, 1].min()) / pitch_um).astype(np.int64)
    kinds = {"shot_noise": "off"} | sensor
    return fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout.with_columns(readout_order=row), **kinds))


def maps_of(levels):
    """Return uniform power maps."""
    grid = fs.Grid.centred((40, 40), 5.0)
    return [fs.PowerMap(np.full((1, 40, 40), level), grid, np.array([550.0])) for level in levels]


def pictures(n=6, shape=(32, 48)):
    """Return uniform grey pictures, each brighter than the one before."""
    return [np.full((*shape, 3), 20 + 200 * k // n, np.uint8) for k in range(n)]


def film(path, times_s=TIMES_S, **options):
    """Write a video file with time stamps, and return its path."""
    return write_film(path, pictures(len(times_s)), times_s=times_s, **options)


def stamps_of(path):
    """Return the times of decoded frames by PyAV, in s."""
    av = pytest.importorskip("av")
    with av.open(str(path)) as container:
        return [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]


def settings_of(captures, name="time_s"):
    return [capture.settings.get(name) for capture in captures]


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("times_s", [TIMES_S, [5.0 + t for t in TIMES_S], [0.0, 1e-3, 7.0]])
def test_linear_interpolation_integrates_ramp_exactly(times_s):
    lights = maps_of([1.0 + 3.0 * (t - times_s[0]) for t in times_s])
    exposure_s, line_s = 0.14, 0.05
    of_one = next(camera().rates(maps_of([1.0])))
    captures = list(
        camera().video(lights, exposure_s=exposure_s, seed=0, times_s=times_s, line_s=line_s, every=2, between="linear")
    )
    begins_s = np.array(times_s[::2]) - times_s[0]
    lines = camera().layout.columns["readout_order"]

    assert settings_of(captures) == times_s[::2]
    for begin_s, capture in zip(begins_s, captures, strict=True):
        # Mean of 1 + 3 t over the exposure of each line, constant after the last frame.
        edges = begin_s + line_s * lines[:, np.newaxis] + exposure_s * np.linspace(0.0, 1.0, 200_001)
        mean = np.mean(1.0 + 3.0 * np.minimum(edges, times_s[-1] - times_s[0]), axis=1)
        np.testing.assert_allclose(capture.expected_e, exposure_s * of_one * mean, rtol=2e-5)


def test_held_frames_are_weighted_by_duration():
    lights = maps_of([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    capture = next(camera().video(lights, exposure_s=2.5, seed=0, times_s=TIMES_S, every=6))
    durations_s = [0.1, 0.4, 0.1, 0.05, 1.35, 0.5]  # the last frame lasts to the end

    expected = np.dot(durations_s, [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]) * next(camera().rates(maps_of([1.0])))
    np.testing.assert_allclose(capture.expected_e, expected, rtol=1e-12)


@pytest.mark.parametrize("between", ["hold", "linear"])
@pytest.mark.parametrize("exposure_s", [0.0, 0.05, 0.3, 5.0])
def test_frame_weights_sum_to_one(between, exposure_s):
    layout = camera(n_y=5).layout
    for first in range(6):
        shutter = Shutter(layout, times_s=TIMES_S, line_s=0.12, between=between)
        weights = np.array([shutter.overlap_fraction(k, exposure_s, first) * np.ones(15) for k in range(8)])
        last = shutter.last_frame(exposure_s, first)

        np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-12)
        assert weights.min() >= 0.0
        assert np.all(weights[last + 1 :] == 0.0)
        assert np.any(weights[last] > 0.0) or exposure_s == 0.0
        exposure = Exposure(shutter, exposure_s, first)
        for _ in range(last + 1):
            exposure.add(np.full(15, 3.0))
        assert exposure.is_complete
        np.testing.assert_allclose(exposure.mean_e_per_s(np.zeros(15)), 3.0)


@pytest.mark.parametrize("between", ["hold", "linear"])
def test_equal_times_are_a_frame_period(between):
    rng = np.random.default_rng(1)
    lights = maps_of(rng.random(9))
    options = {"exposure_s": [0.02, 0.07], "seed": 1, "line_s": 3e-3, "every": 2, "between": between}
    by_step = list(camera().video(lights, frame_s=0.04, **options))
    by_time = list(camera().video(lights, times_s=0.04 * np.arange(9), **options))

    for one, other in zip(by_step, by_time, strict=True):
        np.testing.assert_allclose(one.expected_e, other.expected_e, rtol=1e-13)
        assert one.settings["time_s"] == other.settings["time_s"]


def test_events_cross_thresholds_between_irregular_frames():
    sensor = fs.Sensor(fs.layout.grid(n_x=1, n_y=1, pitch_um=10.0))
    pixels = EventPixels(sensor, contrast_on=0.25, contrast_off=0.25, floor_e_per_s=0.0)
    log_rates = np.array([0.0, 0.6, 0.6, -1.0, 0.9, 0.4])
    events = pixels.events(100.0 * np.exp(log_rates)[:, np.newaxis], times_s=TIMES_S, seed=0)
    expected, level = [], 0.0
    for (begin_s, end_s), (low, high) in zip(pairwise(TIMES_S), pairwise(log_rates), strict=True):
        step = math.copysign(0.25, high - low)
        while high != low and (high - level - step) * step >= 0.0:
            level += step
            expected.append(begin_s + (end_s - begin_s) * (level - low) / (high - low))

    assert len(expected) > 10
    np.testing.assert_allclose(events.t_s, expected, rtol=1e-9)


@pytest.mark.parametrize("kind", [EventPixels, SpikingPixels])
def test_events_do_not_depend_on_batches(kind):
    sensor = fs.Sensor(fs.layout.grid(n_x=5, n_y=4, pitch_um=10.0))
    pixels = kind(
        sensor, **({"noise_per_s": 20.0, "leak_per_s": 2.0} if kind is EventPixels else {"threshold_e": 50.0})
    )
    rates = np.random.default_rng(0).uniform(50.0, 500.0, (6, 20))
    expected = pixels.events(rates, times_s=TIMES_S, seed=3)

    assert expected.t_s.size > 50
    assert expected.t_s.max() > 1.0
    for batch in (1, 2, 5):
        parts = list(pixels.stream(iter(rates), times_s=TIMES_S, seed=3, batch=batch))
        for name in ("t_s", "site", "polarity"):
            np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(expected, name))
    by_step = pixels.events(rates, frame_s=0.25, seed=3)
    np.testing.assert_array_equal(pixels.events(rates, times_s=0.25 * np.arange(6), seed=3).t_s, by_step.t_s)


def test_spikes_follow_frame_durations():
    sensor = fs.Sensor(fs.layout.grid(n_x=1, n_y=1, pitch_um=10.0), shot_noise="off")
    rates = [[1000.0], [500.0], [2000.0]]
    found = SpikingPixels(sensor, threshold_e=100.0).events(rates, times_s=[1.0, 1.25, 2.0], seed=0)
    # Charge 250 until 1.25 s, 625 until 2 s, 2125 at the end of the last frame, which lasts as long as the one before it.
    charge, times_s = [0.0, 250.0, 625.0, 2125.0], [1.0, 1.25, 2.0, 2.75]

    np.testing.assert_allclose(found.t_s, np.interp(100.0 * np.arange(1, 22), charge, times_s))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"times_s": [0.0, 0.1, 0.1]}, r"strictly ascending, got 0\.1 s after 0\.1 s at index 2"),
        ({"times_s": [0.0, 0.1, 0.05]}, r"got 0\.05 s after 0\.1 s"),
        ({"times_s": [0.0, np.nan, 1.0]}, "'times_s' must be finite"),
        ({"times_s": []}, "one or more times"),
        ({"times_s": [[0.0, 1.0]]}, "1 dimension"),
        ({"times_s": [0.0, 1.0], "frame_s": 0.1}, "must not be given with 'frame_s'"),
        ({"times_s": [0.0, 1.0]}, "got 2 times of 3 frames"),
        ({"times_s": [0.0, 1.0, 2.0, 3.0]}, "got 4 times of 3 frames"),
    ],
)
def test_invalid_times_are_one_sentence(change, message):
    lights, sensor = maps_of([1.0] * 3), camera().sensor
    for call in (
        lambda: camera().video(lights, exposure_s=0.01, seed=0, **change),
        lambda: EventPixels(sensor).stream(np.ones((3, 12)), seed=0, **change),
        lambda: follow_gaze(lights, GazePath([0.0], [[0.0, 0.0]]), **change),
        lambda: FrameSource([np.ones((4, 4))] * 3, **LIGHT, **change),
    ):
        with pytest.raises(ParameterError, match=message):
            call()


def test_frames_of_iterators_must_match_times():
    for n, message in ((4, "got 3 times of at least 4 frames"), (2, "got 3 times of 2 frames")):
        for options in ({}, {"between": "linear"}):
            with pytest.raises(ParameterError, match=message):
                list(camera().video(iter(maps_of([1.0] * n)), exposure_s=1e-3, seed=0, times_s=[0, 1, 2], **options))
        with pytest.raises(ParameterError, match=message):
            EventPixels(camera().sensor).events(iter(np.ones((n, 12))), times_s=[0, 1, 2], seed=0)
    with pytest.raises(ParameterError, match="'frame_s' must be given, or 'times_s'"):
        EventPixels(camera().sensor).events(np.ones((3, 12)), seed=0)
    with pytest.raises(ParameterError, match="'frame_s' must be given, or 'times_s'"):
        Shutter(camera().layout)
    with pytest.raises(ParameterError, match="duration of a single frame"):
        SpikingPixels(camera().sensor).events(np.ones((1, 12)), seed=0, times_s=[0.0])


# -- files -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "tick"),
    [
        ("a.mkv", "ffv1", "bgr0", Fraction(1, 1000)),
        ("a.mp4", "libx264", "yuv420p", Fraction(1, 90_000)),  # with B-frames
        ("a.webm", "libvpx-vp9", "yuv420p", Fraction(1, 1000)),
        ("a.gif", "gif", "rgb8", Fraction(1, 100)),
        ("a.apng", "apng", "rgba", Fraction(1, 1000)),
    ],
)
def test_time_stamps_of_files_are_used(tmp_path, name, codec, pixels, tick):
    path = film(tmp_path / name, codec=codec, pixels=pixels, tick_s=tick)
    footage = FrameSource(path, **LIGHT)
    levels = [float(scene.basis.mean()) for scene in footage]

    np.testing.assert_allclose(footage.times_s, stamps_of(path), atol=1e-12)
    np.testing.assert_allclose(footage.times_s, TIMES_S, atol=float(tick) / 2)
    assert footage.frame_s is None
    assert levels == sorted(levels)
    assert len(set(levels)) == 6
    assert settings_of(camera().video(footage, exposure_s=1e-3, seed=0)) == footage.times_s.tolist()


def test_first_time_stamp_is_zero_after_offset(tmp_path):
    path = film(tmp_path / "a.mkv", start=4000)

    assert stamps_of(path)[0] == 4.0
    np.testing.assert_allclose(FrameSource(path, **LIGHT).times_s, TIMES_S)


def test_selected_frames_keep_their_times(tmp_path):
    path = film(tmp_path / "a.mkv")
    footage = FrameSource(path, start=1, step=2, **LIGHT)
    rest = footage.from_frame(1)

    np.testing.assert_allclose(footage.times_s, [0.0, 0.5, 1.9])
    np.testing.assert_allclose(rest.times_s, [0.5, 1.9])
    assert len(list(rest)) == 2
    assert footage.from_frame(3).times_s is None
    np.testing.assert_allclose(FrameSource(path, stop=3, **LIGHT).times_s, [0.0, 0.1, 0.5])
    given = FrameSource(path, times_s=np.arange(6) ** 2, **LIGHT).from_frame(2)
    assert given.times_s.tolist() == [4.0, 9.0, 16.0, 25.0]
    assert FrameSource(path, frame_s=0.5, **LIGHT).frame_s == 0.5


@pytest.mark.parametrize(
    ("rate", "name"), [(Fraction(30_000, 1001), "a.mkv"), (24, "a.mp4"), (25, "a.avi"), (1000, "a.mkv")]
)
def test_constant_rate_is_exact_despite_rounding(tmp_path, rate, name):
    path = write_film(tmp_path / name, pictures(40), rate=rate, codec="libx264" if name == "a.mp4" else "ffv1",
                      pixels="yuv420p" if name == "a.mp4" else "bgr0")  # fmt: skip
    footage = FrameSource(path, **LIGHT)

    np.testing.assert_allclose(footage.times_s, np.arange(40) / float(rate), rtol=1e-12)
    assert footage.frame_s == pytest.approx(1.0 / float(rate), rel=1e-12)


def test_avi_with_reordered_frames_has_decode_times(tmp_path):
    path = write_film(tmp_path / "a.avi", pictures(9), rate=25, codec="libx264", pixels="yuv420p")

    np.testing.assert_allclose(FrameSource(path, **LIGHT).times_s, 0.04 * np.arange(9), atol=1e-9)


def test_files_without_time_stamps_are_named(tmp_path):
    path = write_film(tmp_path / "a.h264", pictures(3), codec="libx264", pixels="yuv420p")
    message = r"a\.h264: has frames without time stamps; specify the frame period"
    footage = FrameSource(path, **LIGHT)

    with pytest.raises(FileError, match=message):
        footage.times_s  # noqa: B018
    with pytest.raises(FileError, match=message):
        camera().video(footage, exposure_s=1e-3, seed=0, line_s=1e-5)
    assert settings_of(camera().video(footage, exposure_s=1e-3, seed=0)) == [None] * 3
    timed = FrameSource(path, frame_s=0.1, **LIGHT)
    assert settings_of(camera().video(timed, exposure_s=1e-3, seed=0)) == pytest.approx([0.0, 0.1, 0.2])


def test_edit_list_selects_and_shifts_frames(tmp_path):
    path = film(tmp_path / "a.mp4", [0.04 * k for k in range(10)], codec="libx264", pixels="yuv420p")
    content = path.read_bytes()
    at = content.index(b"elst") + 8
    # version 0: number of entries, then duration, media time, rate; the presentation begins 4 frames later.
    assert content[at - 4 : at + 4] == bytes([0, 0, 0, 0, 0, 0, 0, 1])
    scale = int.from_bytes(content[(m := content.index(b"mdhd") + 16) : m + 4])
    media_time = int.from_bytes(content[at + 8 : at + 12]) + round(0.16 * scale)
    (tmp_path / "b.mp4").write_bytes(content[: at + 8] + media_time.to_bytes(4, "big") + content[at + 12 :])
    footage = FrameSource(tmp_path / "b.mp4", **LIGHT)

    np.testing.assert_allclose(footage.times_s, 0.04 * np.arange(6), atol=1e-9)
    expected = [scene.basis for scene in FrameSource(path, start=4, **LIGHT)]
    np.testing.assert_array_equal([scene.basis for scene in footage], expected)


def test_hidden_vp8_frames_have_no_time(tmp_path):
    av = pytest.importorskip("av")
    film(tmp_path / "a.webm", codec="libvpx", pixels="yuv420p")
    with av.open(str(tmp_path / "a.webm")) as source, av.open(str(tmp_path / "b.webm"), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size == 0:
                continue
            for at, hidden in ((packet.pts, False), (packet.pts + 10, True)):
                content = bytearray(bytes(packet))
                content[0] &= 0xEF if hidden else 0xFF  # the bit show_frame of RFC 6386
                copy = av.Packet(bytes(content))
                copy.pts = copy.dts = at
                copy.stream, copy.time_base, copy.is_keyframe = stream, packet.time_base, packet.is_keyframe
                target.mux(copy)
    footage = FrameSource(tmp_path / "b.webm", **LIGHT)
    with av.open(str(tmp_path / "b.webm")) as container:
        assert sum(packet.size > 0 for packet in container.demux(video=0)) == 12

    np.testing.assert_allclose(footage.times_s, TIMES_S)
    assert len(list(footage)) == 6


@pytest.mark.parametrize("lossy", [False, True])
def test_animated_webp_has_durations(tmp_path, lossy):
    images = [Image.fromarray(picture) for picture in pictures(5)]
    durations = [100, 400, 100, 50, 5]  # ms; browsers show 5 ms for 100 ms
    images[0].save(tmp_path / "a.webp", save_all=True, append_images=images[1:], duration=durations, lossless=not lossy)
    footage = FrameSource(tmp_path / "a.webp", **LIGHT)

    np.testing.assert_allclose(footage.times_s, [0.0, 0.1, 0.5, 0.6, 0.65])
    for scene, picture in zip(footage, pictures(5), strict=True):
        expected = fs.Scene.from_picture(picture, encoding="srgb", **LIGHT).basis
        np.testing.assert_allclose(scene.basis, expected, atol=0.02 if lossy else 1e-7)


def test_corrupt_webp_gives_frames_or_sentence(tmp_path):
    images = [Image.fromarray(picture) for picture in pictures(4)]
    images[0].save(tmp_path / "a.webp", save_all=True, append_images=images[1:], duration=40, lossless=True)
    content, rng, n_read, messages = (tmp_path / "a.webp").read_bytes(), np.random.default_rng(0), 0, set()
    for k in range(300):
        bad = bytearray(content if k % 10 else content[: rng.integers(13, len(content))])
        for at in rng.integers(12, len(bad), rng.integers(1, 5)):
            bad[at] = rng.integers(256)
        (tmp_path / "bad.webp").write_bytes(bad)
        try:
            footage = FrameSource(tmp_path / "bad.webp", **LIGHT)
            n_read += len(footage.times_s) == sum(1 for _ in footage)
        except (FileError, ParameterError) as error:
            messages.add(str(error))
    assert n_read > 0
    assert all("\n" not in message for message in messages)


def test_pickled_source_has_times_in_another_process(tmp_path):
    footage = FrameSource(film(tmp_path / "a.mkv"), **LIGHT).from_frame(1)
    (tmp_path / "footage.pickle").write_bytes(pickle.dumps(footage))
    script = (
        "import json, pickle, sys; from pathlib import Path; f = pickle.loads(Path(sys.argv[1]).read_bytes())\n"
        "print(json.dumps([f.times_s.tolist(), [float(s.basis.mean()) for s in f]]))"
    )
    printed = subprocess.check_output([sys.executable, "-c", script, str(tmp_path / "footage.pickle")], text=True)

    assert json.loads(printed) == [footage.times_s.tolist(), [float(scene.basis.mean()) for scene in footage]]


def test_gaze_follows_time_stamps(tmp_path):
    path = GazePath([0.0, 1.0], [[0.0, 0.0], [10.0, -4.0]])
    footage = FrameSource(film(tmp_path / "a.mkv"), **LIGHT)
    frames = follow_gaze(footage, path)

    np.testing.assert_allclose(frames.times_s, TIMES_S)
    gazes_um = [position_um for _, position_um in frames]
    np.testing.assert_allclose(gazes_um, path.at(TIMES_S))
    rest = [position_um for _, position_um in follow_gaze(footage.from_frame(4), path)]
    assert rest == gazes_um[4:]
    captures = camera().video(follow_gaze(footage, path), exposure_s=1e-3, seed=0, line_s=1e-5)
    assert settings_of(captures) == footage.times_s.tolist()
    with pytest.raises(ParameterError, match="the frames have no times"):
        follow_gaze(list(footage), path)
    with pytest.raises(ParameterError, match="'first_frame' must not be given"):
        follow_gaze(footage, path, first_frame=2)


def test_frames_along_path_have_its_times():
    path = GazePath(TIMES_S, np.zeros((6, 2)))
    (light,) = maps_of([1.0])
    captures = list(camera().video(shift_sensor(light, path), exposure_s=1e-3, seed=0, line_s=1e-6))

    assert settings_of(captures) == TIMES_S
    frames = shift_sensor(light, path)
    next(frames)
    assert frames.times_s.tolist() == TIMES_S[1:]
    # Also without the rest of the path.
    part = camera().video(islice(shift_sensor(light, path), 2, 4), exposure_s=1e-3, seed=0)
    assert settings_of(part) == TIMES_S[2:4]


def test_events_of_video_file_have_its_times(tmp_path):
    footage = FrameSource(film(tmp_path / "a.mkv"), **LIGHT)
    pixels = EventPixels(camera().sensor, contrast_on=0.1)
    events = pixels.events(camera().rates(footage), times_s=footage.times_s, seed=0)
    rates = list(camera().rates(footage))

    np.testing.assert_array_equal(events.t_s, pixels.events(rates, times_s=TIMES_S, seed=0).t_s)
    assert events.t_s.size > 12
    assert events.t_s.max() <= 2.0


def test_datasets_reject_frame_sources():
    dataset = pytest.importorskip("foveasim.explore")
    with pytest.raises(
        ParameterError, match="must be a directory, a zip file, an array, or a sequence, got a FrameSource"
    ):
        dataset.Dataset(FrameSource(pictures(2), **LIGHT), None)


# -- writing -----------------------------------------------------------------------------------------------------------


def captures_at(times_s, **options):
    levels = maps_of(np.linspace(0.02, 0.2, len(times_s)))
    return camera(pitch_um=3.0).video(
        levels, exposure_s=1e-8 if times_s[1] < 1e-3 else 1e-3, seed=0, times_s=times_s, **options
    )


@pytest.mark.parametrize(
    ("name", "unit_s"), [("v.mp4", 1e-9), ("v.mov", 1e-9), ("v.mkv", 1e-3), ("v.webm", 1e-3), ("v.gif", 0.01)]
)
def test_videos_play_at_speed_of_simulation(tmp_path, name, unit_s):
    times_s = [7.0 + t for t in TIMES_S]
    assert write_video(captures_at(times_s), tmp_path / name, max_pixels=32) == 6

    np.testing.assert_allclose(stamps_of(tmp_path / name), TIMES_S, atol=unit_s)
    np.testing.assert_allclose(FrameSource(tmp_path / name, **LIGHT).times_s, TIMES_S, atol=unit_s)


def test_webp_plays_at_speed_of_simulation(tmp_path):
    write_video(captures_at(TIMES_S), tmp_path / "v.webp", max_pixels=32)
    with Image.open(tmp_path / "v.webp") as image:
        durations = [(image.seek(k), image.load(), image.info["duration"])[2] for k in range(image.n_frames)]

    assert durations == [100, 400, 100, 50, 1350, 1350]
    np.testing.assert_allclose(FrameSource(tmp_path / "v.webp", **LIGHT).times_s, TIMES_S)


def test_pictures_are_written_with_times(tmp_path):
    write_video(captures_at(TIMES_S), tmp_path / "v", max_pixels=32)
    write_video(captures_at(TIMES_S), tmp_path / "v", max_pixels=32)  # replaces it
    footage = FrameSource(tmp_path / "v", times_s=tmp_path / "v" / "frame_times.csv", **LIGHT)

    assert footage.times_s.tolist() == TIMES_S
    write_video(camera().video(maps_of([1.0]), exposure_s=1e-3, seed=0), tmp_path / "w")
    assert [path.name for path in (tmp_path / "w").iterdir()] == ["frame_000000.png"]


def test_gif_distributes_rounding(tmp_path):
    write_video(captures_at([k / 30 for k in range(31)]), tmp_path / "v.gif", max_pixels=32)
    found = np.array(stamps_of(tmp_path / "v.gif"))

    np.testing.assert_allclose(found, np.arange(31) / 30, atol=0.0051)
    assert set(np.rint(100 * np.diff(found)).astype(int)) == {3, 4}


@pytest.mark.parametrize(("name", "shortest_s"), [("v.gif", 0.02), ("v.webp", 0.011)])
def test_too_fast_animations_give_warning(tmp_path, name, shortest_s):
    with pytest.warns(FoveasimWarning, match=rf"{name} shows frames of 0\.005 s for {shortest_s} s, the shortest time"):
        write_video(captures_at([0.005 * k for k in range(4)]), tmp_path / name, max_pixels=32)

    np.testing.assert_allclose(FrameSource(tmp_path / name, **LIGHT).times_s, shortest_s * np.arange(4))


def test_given_period_replaces_times(tmp_path):
    write_video(captures_at(TIMES_S), tmp_path / "v.mp4", max_pixels=32, frame_s=0.1)
    np.testing.assert_allclose(stamps_of(tmp_path / "v.mp4"), 0.1 * np.arange(6))
    write_video(camera().video(maps_of([1.0] * 3), exposure_s=1e-3, seed=0), tmp_path / "w.mp4", max_pixels=32)
    np.testing.assert_allclose(stamps_of(tmp_path / "w.mp4"), 0.04 * np.arange(3))
    write_video(
        camera().video(maps_of([1.0] * 3), exposure_s=1e-4, seed=0, frame_s=1e-3), tmp_path / "x.mp4", max_pixels=32
    )
    np.testing.assert_allclose(stamps_of(tmp_path / "x.mp4"), 1e-3 * np.arange(3), atol=1e-9)


def test_captures_without_ascending_times_are_named(tmp_path):
    captures = list(captures_at([0.0, 1.0, 2.0]))
    untimed = list(camera().video(maps_of([1.0]), exposure_s=1e-3, seed=0))

    with pytest.raises(ParameterError, match=r"ascending times, got 0 s after 2 s; specify 'frame_s'"):
        write_video([*captures, captures[0]], tmp_path / "v.gif")
    with pytest.raises(ParameterError, match="must all have times, or none of them"):
        write_video([*captures, *untimed], tmp_path / "v.mp4")
    with pytest.raises(ParameterError, match=r"'captures' must be apart by >= 1e-06 in a video file"):
        write_video(captures_at([0.0, 1e-7]), tmp_path / "v.mp4")
    assert list(tmp_path.iterdir()) == []


def test_recordings_have_times_and_resume(tmp_path):
    footage = FrameSource(film(tmp_path / "a.mkv"), **LIGHT)
    options = {"exposure_s": 1e-3, "seed": 2}
    write_video(camera().video(footage, **options), tmp_path / "whole.zarr")

    def interrupted():
        yield from islice(camera().video(footage, **options), 2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(interrupted(), tmp_path / "part.zarr", resume=True)
    for start in (1, 3):  # frames that were not next
        wrong = FrameSource(footage._source.path, start=start, times_s=TIMES_S[: 6 - start], **LIGHT)
        with pytest.raises(FileError, match="'time_s' differs"):
            write_video(camera().video(wrong, first_frame=2, **options), tmp_path / "part.zarr", resume=True)
    write_video(camera().video(footage.from_frame(2), first_frame=2, **options), tmp_path / "part.zarr", resume=True)
    whole, part = (read_recording(tmp_path / f"{name}.zarr") for name in ("whole", "part"))

    np.testing.assert_allclose(part.times_s, TIMES_S)
    np.testing.assert_array_equal(part.times_s, whole.times_s)
    np.testing.assert_array_equal(part.code[:], whole.code[:])
    write_video(camera().video(maps_of([1.0] * 2), **options), tmp_path / "untimed.zarr")
    assert np.isnan(read_recording(tmp_path / "untimed.zarr").times_s).all()


# -- settings and command ----------------------------------------------------------------------------------------------


@pytest.fixture
def directory(tmp_path):
    """Write a shot, six frames, and their times."""
    (tmp_path / "frames").mkdir()
    for k, picture in enumerate(pictures()):
        Image.fromarray(picture).save(tmp_path / "frames" / f"{k}.png")
    Image.fromarray(pictures()[0]).save(tmp_path / "scene.png")
    (tmp_path / "shot.yaml").write_text(yaml.safe_dump(SETTINGS))
    (tmp_path / "times.csv").write_text("frame,t_s\n" + "".join(f"{k},{t}\n" for k, t in enumerate(TIMES_S)))
    return tmp_path


def command(directory, *options, out="v.zarr"):
    arguments = [
        "video",
        str(directory / "shot.yaml"),
        "--frames",
        str(directory / "frames"),
        "--out",
        str(directory / out),
    ]
    return CliRunner().invoke(app, [*arguments, *options])


@pytest.mark.parametrize("how", ["option", "list", "file"])
def test_command_takes_times_of_pictures(directory, how):
    changes = {"option": {}, "list": {"times_s": TIMES_S}, "file": {"times_s": "times.csv"}}[how]
    (directory / "shot.yaml").write_text(yaml.safe_dump(SETTINGS | changes))
    result = command(directory, *(["--times", str(directory / "times.csv")] if how == "option" else []))

    assert result.exit_code == 0, result.output
    assert read_recording(directory / "v.zarr").times_s.tolist() == TIMES_S
    assert command(directory, "--fps", "10", out="w.mp4").exit_code == 0
    np.testing.assert_allclose(stamps_of(directory / "w.mp4"), 0.1 * np.arange(6))


def test_command_with_path_and_shutter_uses_times(directory):
    (directory / "gaze.csv").write_text("t_s,x_um,y_um\n0,0,0\n2,4,2\n")
    layout = fs.layout.grid(n_x=6, n_y=5, pitch_um=40.0)
    layout.with_columns(readout_order=np.arange(30) // 6).write(directory / "rows.npz")
    scene = SETTINGS["scene"] | {"gaze_range_um": [4.0, 2.0]}
    changes = {"layout": "rows.npz", "exposure_s": 0.04, "scene": scene}
    (directory / "shot.yaml").write_text(yaml.safe_dump(SETTINGS | changes))
    options = ["--times", str(directory / "times.csv"), "--gaze", str(directory / "gaze.csv"), "--line-s", "0.02"]
    assert command(directory, *options).exit_code == 0
    found = read_recording(directory / "v.zarr")
    shot = read_shot(directory / "shot.yaml")
    footage = FrameSource(directory / "frames", template=shot.scene, times_s=TIMES_S)
    frames = follow_gaze(footage, GazePath.read(directory / "gaze.csv"))
    expected = list(shot.camera.video(frames, exposure_s=0.04, seed=1, line_s=0.02, times_s=TIMES_S))

    np.testing.assert_array_equal(found.code[:], [capture.code for capture in expected])
    np.testing.assert_allclose(found.gaze_um, np.outer(TIMES_S, [2.0, 1.0]))
    assert "was already complete: 6 frames" in command(directory, *options).output
    other = command(directory, *options[2:], "--fps", "10")
    assert other.exit_code != 0
    assert "'shutter.frame_s' differs" in str(other.exception)


@pytest.mark.parametrize(
    ("times_s", "message"),
    [
        ([0.0, 0.0], "strictly ascending, got 0 s after 0 s at index 1"),
        ([], "one or more times"),
        ([0.0, "a"], "times_s"),
        ([0.0, math.inf, 1.0], "times_s"),
    ],
)
def test_invalid_times_in_settings_are_named(directory, times_s, message):
    (directory / "shot.yaml").write_text(yaml.safe_dump(SETTINGS | {"times_s": times_s}))
    with pytest.raises(ConfigError, match=message):
        read_shot(directory / "shot.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_s\n0\n0.5\n0.5\n", r"times\.csv: 't_s' must be strictly ascending"),
        ("t\n0\n", "must have the columns"),
        ("t_s\n0\nx\n", "must have a number in line 3, got x"),
        ("t_s\n", "one or more times"),
        ("t_s\n0\nnan\n", "must be finite"),
    ],
)
def test_invalid_files_of_times_are_named(tmp_path, text, message):
    (tmp_path / "times.csv").write_text(text)
    with pytest.raises(FileError, match=message):
        FrameSource([np.ones((4, 4))] * 3, times_s=tmp_path / "times.csv", **LIGHT)


def test_command_plays_video_file_at_its_times(directory):
    path = film(directory / "a.mkv")
    shot = read_shot(directory / "shot.yaml")
    assert run_video(shot, path, directory / "v.mp4") == 6

    np.testing.assert_allclose(stamps_of(directory / "v.mp4"), TIMES_S, atol=1e-9)


def test_frames_have_encoding_of_the_scene(directory):
    scene = SETTINGS["scene"] | {"encoding": "linear"}
    (directory / "shot.yaml").write_text(yaml.safe_dump(SETTINGS | {"scene": scene}))
    assert command(directory).exit_code == 0
    shot = read_shot(directory / "shot.yaml")
    footage = FrameSource(directory / "frames", template=shot.scene, encoding="linear")
    expected = [capture.code for capture in shot.camera.video(footage, exposure_s=0.01, seed=1)]

    np.testing.assert_array_equal(read_recording(directory / "v.zarr").code[:], expected)
    assert read_shot(Path(directory / "shot.yaml"), ["times_s=[0, 1]"]).times_s.tolist() == [0.0, 1.0]
