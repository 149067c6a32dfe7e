"""Videos: frames, gaze paths, rolling shutters, frame sources, recordings and the command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from waiting import DEADLINE_S, wait_until

import foveasim as fs
from foveasim._core.random_streams import Streams
from foveasim._io.images import write_picture
from foveasim.errors import FileError, FoveasimWarning, ParameterError
from foveasim.modes import Exposure, Shutter
from foveasim.sensor import merge_exposures
from foveasim.video import (
    FrameSource,
    GazePath,
    count_recorded_frames,
    pan_camera,
    partial_path,
    read_recording,
    saccades,
    shift_sensor,
    write_video,
)
from foveasim.video.frame_source import list_pictures

PITCH_UM, DISTANCE_M = 10.0, 0.5
LIGHT = {
    "pitch_um": PITCH_UM,
    "distance_m": DISTANCE_M,
    "peak_radiance_w_m2_sr_nm": 0.1,
    "band_width_nm": 50.0,
    "encoding": "linear",
}
OPTICS = fs.Optics(focal_length_mm=22.0, f_number=4.0)


def pictures(n, shape=(120, 160), seed=0):
    rng = np.random.default_rng(seed)
    return [rng.random(shape, dtype=np.float32) for _ in range(n)]


def scene_of(picture):
    return fs.Scene.from_picture(picture, **LIGHT)


def rows_layout(n_x=12, n_y=10, pitch_um=3.0):
    layout = fs.layout.grid(n_x=n_x, n_y=n_y, pitch_um=pitch_um)
    row = np.rint((layout.centroid_um[:, 1] - layout.centroid_um[:, 1].min()) / pitch_um).astype(np.int64)
    return layout.with_columns(readout_order=row)


def camera_of(layout, **sensor):
    kinds = {"read_noise_e": 2.0, "prnu_fraction": 0.02, "bits": 12, "capacitance_f": 1e-14} | sensor
    return fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout, **kinds))


def map_camera(layout, **sensor):
    """Return a camera for power maps without shot noise, one electron per photon."""
    return fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout, shot_noise="off", **sensor))


def bar_map(grid, left_um, width_um=3.0):
    """Return a power map with a bright vertical bar, with partial coverage at its edges."""
    edges = grid.origin_um[0] + grid.pitch_um * np.arange(grid.shape[1] + 1)
    covered = np.diff(np.clip(edges, left_um, left_um + width_um)) / grid.pitch_um
    return fs.PowerMap(np.broadcast_to(covered, (1, *grid.shape)).copy(), grid, np.array([550.0]))


# -- successive frames -------------------------------------------------------------------------------------------------


def test_video_frames_equal_single_captures():
    scenes = [scene_of(p) for p in pictures(3)]
    camera = camera_of(rows_layout())

    captures = list(camera.video(scenes, exposure_s=0.01, seed=5, first_frame=7))

    for k, (scene, capture) in enumerate(zip(scenes, captures, strict=True)):
        single = camera_of(rows_layout()).capture(scene, exposure_s=0.01, seed=5, frame=7 + k)
        assert np.array_equal(capture.code, single.code)
        assert np.array_equal(capture.electrons, single.electrons)
        assert capture.settings == single.settings


def test_static_scene_changes_only_temporal_noise():
    scene = scene_of(pictures(1)[0])
    first, second = camera_of(rows_layout()).video([scene, scene], exposure_s=0.01, seed=5)

    assert np.array_equal(first.expected_e, second.expected_e)
    assert np.mean(first.electrons != second.electrons) > 0.9


def test_image_of_same_object_is_computed_once():
    scene = scene_of(pictures(1)[0])
    first, second, third = camera_of(rows_layout()).video(
        [scene, scene, scene_of(pictures(1)[0])], exposure_s=0.01, seed=5
    )

    assert "optics" in first.stage_s
    assert "optics" not in second.stage_s
    assert "optics" in third.stage_s
    assert np.array_equal(second.expected_e, third.expected_e)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("precision", "is_plain", "pitch_um"),
    [("single", True, 10.0), ("single", False, 60.0), ("double", True, 60.0), ("double", False, 10.0)],
)
def test_cached_lens_gives_bit_identical_maps(precision, is_plain, pitch_um):
    changes = {"pupil": fs.optics.Blades(6), "zernike": fs.optics.Zernike(coefficients={7: 0.05})}
    scenes = [
        fs.Scene.from_picture(np.stack([p, p.T, 1 - p], axis=-1), **(LIGHT | {"pitch_um": pitch_um}))
        for p in pictures(4, (130, 130))
    ]
    weights = np.random.default_rng(1).random((2, 3))

    def lens():
        return fs.Optics(focal_length_mm=22.0, f_number=4.0, precision=precision, **({} if is_plain else changes))

    cached = lens()
    for scene in scenes:
        fresh = [cells.tobytes() for cells in lens().weighted_maps(scene, weights)]
        assert [cells.tobytes() for cells in cached.weighted_maps(scene, weights)] == fresh
    assert sum(factor is not None for factor in cached._cache._factors.values()) == 3


def test_lens_cache_size_is_limited(monkeypatch):
    from foveasim.optics import otf

    small, large = (scene_of(np.ones(shape, np.float32)) for shape in ((120, 160), (180, 240)))

    def kept_sizes(*scenes, optics):
        for scene in scenes:
            list(optics.weighted_maps(scene, np.ones((1, 1))))
        return [factor.size for factor in optics._cache._factors.values() if factor is not None]

    def lens():
        return fs.Optics(focal_length_mm=22.0, f_number=4.0)

    assert kept_sizes(small, optics=lens()) == []
    (of_small,) = kept_sizes(small, small, optics=lens())
    (of_large,) = kept_sizes(large, large, optics=lens())
    assert len(kept_sizes(small, small, large, large, optics=lens())) == 2
    # A limit for one factor evicts the earlier one; then a limit for none.
    monkeypatch.setattr(otf, "MAX_FACTOR_SIZE", of_small + of_large - 1)
    assert kept_sizes(small, small, large, large, optics=lens()) == [of_large]
    monkeypatch.setattr(otf, "MAX_FACTOR_SIZE", of_small - 1)
    assert kept_sizes(small, small, small, optics=lens()) == []


def test_layout_is_compiled_once_for_video():
    camera = camera_of(rows_layout())
    list(camera.video([scene_of(p) for p in pictures(3)], exposure_s=0.01, seed=5))

    assert len(camera._integrators) == 1


def test_frames_are_requested_lazily():
    requested = []

    def frames():
        for k, picture in enumerate(pictures(3)):
            requested.append(k)
            yield scene_of(picture)

    video = camera_of(rows_layout()).video(frames(), exposure_s=0.01, seed=0)

    assert requested == []
    next(video)
    assert requested == [0]
    next(video)
    assert requested == [0, 1]


@pytest.mark.parametrize("ahead", [1, 2, 5])
def test_frames_computed_ahead_are_identical(ahead):
    scenes = [scene_of(p) for p in pictures(4)]
    frames = [
        scenes[0],
        scenes[0],
        scenes[1],
        (scenes[1], (0.3, 0.0)),
        (scenes[2], (0.3, 0.0)),
        (scenes[2], (0.5, 0.1)),
        scenes[3],
    ]
    times = {"exposure_s": 0.01, "seed": 3}
    for options in ({}, {"frame_s": 0.011, "line_s": 1e-3}):
        expected = list(camera_of(rows_layout()).video(frames, **times, **options))
        captures = list(camera_of(rows_layout()).video(frames, **times, **options, ahead=ahead))
        assert len(captures) == 7
        for a, b in zip(expected, captures, strict=True):
            assert np.array_equal(a.code, b.code)
            assert np.array_equal(a.expected_e, b.expected_e)
            assert a.settings == b.settings
    rates = camera_of(rows_layout()).rates(frames, ahead=ahead)
    assert np.array_equal(list(rates), list(camera_of(rows_layout()).rates(frames)))


def test_limited_number_of_frames_is_requested_ahead():
    requested = []

    def frames():
        for k, picture in enumerate(pictures(6)):
            requested.append(k)
            yield scene_of(picture)

    video = camera_of(rows_layout()).video(frames(), exposure_s=0.01, seed=0, ahead=2)
    next(video)
    assert requested == [0]
    next(video)
    assert requested == [0, 1, 2, 3]
    video.close()
    assert requested == [0, 1, 2, 3]


def test_error_ahead_is_raised_in_order():
    scene = scene_of(pictures(1)[0])
    video = camera_of(rows_layout()).video([scene, scene, "not a scene"], exposure_s=0.01, seed=0, ahead=2)

    next(video)
    with pytest.raises(ParameterError, match="Scene or a PowerMap"):
        list(video)


def test_rates_equal_photoelectrons_per_frame():
    scenes = [scene_of(p) for p in pictures(2)]
    camera = camera_of(rows_layout())

    for rate, scene in zip(camera.rates(scenes), scenes, strict=True):
        assert np.array_equal(rate, camera.photoelectrons_per_s(scene))


def test_rates_of_equal_frames_are_read_only():
    camera, scene = camera_of(rows_layout()), scene_of(pictures(1)[0])
    truth = camera.photoelectrons_per_s(scene)
    for rate in camera.rates([scene] * 3):
        assert np.array_equal(rate, truth)
        with pytest.raises(ValueError, match="read-only"):
            np.multiply(rate, 2.0, out=rate)


def test_bracket_cycles_exposures_and_merges():
    layout = rows_layout()
    camera = camera_of(layout, read_noise_e=0.0, prnu_fraction=0.0)
    scene = scene_of(pictures(1)[0])
    exposures_s = [0.002, 0.02]
    captures = list(camera.video([scene] * 4, exposure_s=exposures_s, seed=1))

    assert [c.settings["exposure_s"] for c in captures] == exposures_s * 2
    rates = merge_exposures([c.code for c in captures[:2]], exposures_s, camera.sensor)
    truth = camera.photoelectrons_per_s(scene)
    assert np.isfinite(rates.rate_e_per_s).all()
    assert np.abs((rates.rate_e_per_s - truth) / rates.sigma_e_per_s).max() < 5.0


@pytest.mark.parametrize("first", [1, 2, 3])
@pytest.mark.parametrize("shutter", [{}, {"frame_s": 0.004, "line_s": 1e-3, "every": 2}])
def test_resumed_video_equals_rest_of_video(first, shutter):
    lights = [scene_of(p) for p in pictures(9)]
    options = {"exposure_s": [0.002, 0.008, 0.005], "seed": 1} | shutter
    expected = list(camera_of(rows_layout()).video(lights, **options))[first:]
    remaining = lights[first * shutter.get("every", 1) :]
    found = list(camera_of(rows_layout()).video(remaining, **options, first_frame=first))

    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.code, other.code)
        assert np.array_equal(one.expected_e, other.expected_e)
        assert one.settings == other.settings


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"exposure_s": -1.0}, "exposure_s"),
        ({"exposure_s": []}, "exposure_s"),
        ({"seed": -1}, "seed"),
        ({"first_frame": -1}, "frame"),
        ({"line_s": 1e-3}, "'line_s' requires 'frame_s'"),
        ({"every": 2}, "'every' requires 'frame_s'"),
        ({"ahead": -1}, "ahead"),
        ({"between": "linear"}, "'between' requires 'frame_s'"),
        ({"frame_s": 0.0}, "frame_s"),
        ({"frame_s": 1.0, "every": 0}, "every"),
        ({"frame_s": 1.0, "line_s": -1.0}, "line_s"),
        ({"frame_s": 1.0, "between": "cubic"}, "between"),
    ],
)
def test_invalid_argument_is_rejected_immediately(change, name):
    with pytest.raises(ParameterError, match=name):
        camera_of(rows_layout()).video([], **({"exposure_s": 0.01, "seed": 0} | change))


def test_frames_of_other_types_are_rejected():
    camera = camera_of(rows_layout())
    with pytest.raises(ParameterError, match="iterable"):
        camera.video(3, exposure_s=0.01, seed=0)
    with pytest.raises(ParameterError, match="Scene or a PowerMap"):
        list(camera.video([np.ones((3, 3))], exposure_s=0.01, seed=0))
    with pytest.raises(ParameterError, match="pairs"):
        list(camera.video([(scene_of(pictures(1)[0]), 1.0, 2.0)], exposure_s=0.01, seed=0))
    with pytest.raises(ParameterError, match="'frames' must be an iterable of Scenes or PowerMaps, got an int"):
        camera.rates(5)
    with pytest.raises(ParameterError, match="got a Scene; put a single one into a list"):
        camera.rates(scene_of(pictures(1)[0]))


def test_no_frames_give_no_captures():
    camera = camera_of(rows_layout())

    assert list(camera.video([], exposure_s=0.01, seed=0)) == []
    assert list(camera.video([], exposure_s=0.01, seed=0, frame_s=0.1)) == []


# -- gaze paths-------------------------------------------------------------------------------------------------------


def test_gaze_by_integer_cells_shifts_picture():
    grid = fs.Grid.centred((60, 80), 0.5)
    data = np.random.default_rng(3).random((1, 60, 80))
    light = fs.PowerMap(data, grid, np.array([550.0]))
    camera = map_camera(rows_layout(n_x=5, n_y=4))
    # A gaze towards +x and +y shifts the picture towards -x and -y.
    shifted = fs.PowerMap(np.roll(data, (-4, -7), axis=(1, 2)), grid, np.array([550.0]))

    found, expected = camera.rates([(light, (3.5, 2.0)), shifted])

    assert np.allclose(found, expected, rtol=1e-12)


def test_repeated_gaze_has_identical_rates():
    layout = fs.layout.log_polar(n_sectors=16, r_max_um=12.0, r_min_um=2.0, n_rings=5)
    light = fs.PowerMap(np.random.default_rng(0).random((1, 80, 80)), fs.Grid.centred((80, 80), 0.5), np.array([550.0]))
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout))
    path = [(1.3, -0.7), (0.0, 0.0), (1.3, -0.7), (0.2, 0.4), (1.3, -0.7), (0.0, 0.0)]

    found = list(camera.rates((light, position_um) for position_um in path))

    for first, again in ((0, 2), (0, 4), (1, 5)):
        np.testing.assert_array_equal(found[again], found[first])
    np.testing.assert_array_equal(found[1], camera.photoelectrons_per_s(light))


def test_subcell_gaze_is_exact_on_linear_field():
    grid = fs.Grid.centred((60, 80), 0.5)
    x_um, y_um = np.meshgrid(grid.x_um, grid.y_um)
    light = fs.PowerMap((100.0 + 2.0 * x_um - 3.0 * y_um)[np.newaxis], grid, np.array([550.0]))
    layout = rows_layout(n_x=5, n_y=4)
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout), order=2)

    centred, shifted = camera.rates([light, (light, (0.123, -0.217))])
    plane = 100.0 + 2.0 * layout.centroid_um[:, 0] - 3.0 * layout.centroid_um[:, 1]

    assert np.allclose(shifted / centred, (plane + 2.0 * 0.123 + 3.0 * 0.217) / plane, rtol=1e-12)


def test_panned_camera_crops_scene_at_gaze():
    scene = scene_of(pictures(1, (200, 260))[0])
    cell_um = OPTICS.grid(scene).pitch_um
    layout = rows_layout(n_x=6, n_y=5)
    camera = camera_of(layout)
    path = GazePath(np.array([0.0, 1.0]), cell_um * np.array([[0.0, 0.0], [12.25, -7.5]]))
    parts = list(pan_camera(scene, path, OPTICS, shape=(120, 160)))

    (first, shift), (second, rest) = parts

    assert shift == (0.0, 0.0)
    assert np.array_equal(first.basis, scene.basis[:, 40:160, 50:210])
    assert np.array_equal(second.basis[0, 0, :3], scene.basis[0, 32, 62:65])
    assert rest[0] == pytest.approx(0.25 * cell_um)
    assert abs(rest[1]) == pytest.approx(0.5 * cell_um)
    # A sensor shifted behind the lens measures the same apart from relative illumination over these few pixels.
    panned, shifted = list(camera.rates(parts))[1], list(camera.rates(shift_sensor(scene, path)))[1]
    assert np.allclose(panned, shifted, rtol=2e-3)


def test_odd_crop_is_centred_to_half_pixel():
    scene = scene_of(pictures(1, (121, 161))[0])
    cell_um = OPTICS.grid(scene).pitch_um
    ((_, rest),) = pan_camera(scene, GazePath(np.zeros(1), np.zeros((1, 2))), OPTICS, shape=(100, 140))

    assert np.allclose(np.abs(rest), 0.5 * cell_um)


def test_gaze_outside_scene_reports_time():
    scene = scene_of(pictures(1)[0])
    path = GazePath(np.array([0.0, 0.5]), np.array([[0.0, 0.0], [1000.0, 0.0]]))
    with pytest.raises(ParameterError, match=r"leaves it at 0\.5 s"):
        list(pan_camera(scene, path, OPTICS, shape=(100, 100)))


def test_saccades_stay_in_field_with_fixations():
    path = saccades(duration_s=20.0, frame_s=1e-3, size_um=(200.0, 80.0), seed=3, saccade_s=0.04)
    speed = np.linalg.norm(np.diff(path.xy_um, axis=0), axis=1)

    assert path.xy_um.shape == (20_000, 2)
    assert np.all(np.abs(path.xy_um) <= [100.0, 40.0])
    # Fixations of 0.3 s on average and saccades of 0.04 s: 59 saccades of at most 40 steps.
    assert np.mean(speed > 0) == pytest.approx(0.04 / 0.34, rel=0.25)


def test_drift_variance_is_proportional_to_time():
    paths = [
        saccades(duration_s=0.5, frame_s=1e-3, size_um=(0.0, 0.0), seed=k, fixation_s=100.0, drift_um_per_root_s=10.0)
        for k in range(400)
    ]
    ends_um = np.array([path.xy_um[-1] for path in paths])

    # Variance 100 µm²/s for 0.499 s, from 800 samples: relative standard error sqrt(2/800) = 0.05.
    assert ends_um.var() == pytest.approx(49.9, rel=0.25)


def test_gaze_path_depends_on_seed():
    one, same, other = (saccades(duration_s=2.0, frame_s=0.01, size_um=(50.0, 50.0), seed=s) for s in (1, 1, 2))

    assert np.array_equal(one.xy_um, same.xy_um)
    assert not np.array_equal(one.xy_um, other.xy_um)


def test_gaze_path_matches_reference_implementation():
    """Compare the fixations with a slow reference implementation that evaluates every point of the path."""
    frame_s, n, seed = 0.01, 400, 5
    path = saccades(duration_s=n * frame_s, frame_s=frame_s, size_um=(60.0, 20.0), seed=seed, drift_um_per_root_s=3.0)
    rests, targets, walk = (Streams(seed).of(f"gaze {what}") for what in ("rests", "targets", "drift"))
    steps_um = 3.0 * np.sqrt(frame_s) * walk.standard_normal((n, 2))
    place_um, leave_s, is_first = np.zeros(2), 0.3 * max(rests.gamma(4.0) / 4.0, 0.2), True
    n_rests = 1
    for k, found_um in enumerate(path.xy_um):
        while frame_s * k >= leave_s + 0.05:
            place_um, is_first = np.array([30.0, 10.0]) * (2.0 * targets.random(2) - 1.0), True
            leave_s += 0.05 + 0.3 * max(rests.gamma(4.0) / 4.0, 0.2)
            n_rests += 1
        if frame_s * k < leave_s:
            place_um = place_um if is_first else place_um + steps_um[k]
            assert np.allclose(found_um, place_um, rtol=0.0, atol=1e-9)
            is_first = False
    assert n_rests > 8


def test_invalid_gaze_arguments_are_rejected():
    with pytest.raises(ParameterError, match=r"'duration_s' must be 1 to 100,000,000 frames of 0.01 s, got 0.001 s"):
        saccades(duration_s=0.001, frame_s=0.01, size_um=(1.0, 1.0), seed=0)
    with pytest.raises(ParameterError, match="duration_s"):
        saccades(duration_s=1e300, frame_s=1e-300, size_um=(1.0, 1.0), seed=0)
    scene, path = scene_of(pictures(1)[0]), GazePath(np.zeros(1), np.zeros((1, 2)))
    for source, gaze, message in (
        (None, path, "'source' must be a Scene or a PowerMap"),
        (scene, None, "'path' must be a GazePath"),
    ):
        with pytest.raises(ParameterError, match=message):
            shift_sensor(source, gaze)
    for change, message in (
        ({"scene": None}, "'scene' must be a Scene"),
        ({"path": 3}, "'path' must be a GazePath"),
        ({"optics": None}, "'optics' must be an Optics or a Camera"),
        ({"shape": 5}, "'shape' must be two integers"),
        ({"shape": (121, 160)}, r"'shape' must not exceed the shape of the scene, \(120, 160\)"),
    ):
        with pytest.raises(ParameterError, match=message):
            pan_camera(**({"scene": scene, "path": path, "optics": OPTICS, "shape": (10, 10)} | change))


def test_gaze_path_is_interpolated_linearly():
    path = GazePath(np.array([0.0, 2.0]), np.array([[0.0, 4.0], [10.0, 0.0]]))

    assert path.at(0.5).tolist() == [2.5, 3.0]
    assert path.at([-1.0, 5.0]).tolist() == [[0.0, 4.0], [10.0, 0.0]]
    with pytest.raises(ParameterError, match="t_s"):
        GazePath(np.zeros(2), np.zeros((2, 2)))
    with pytest.raises(ParameterError, match="xy_um"):
        GazePath(np.zeros(1), np.zeros((2, 2)))


# -- shutters ---------------------------------------------------------------------------------------------------------


def test_rolling_shutter_without_delay_is_global():
    scenes = [scene_of(p) for p in pictures(3)]
    plain = camera_of(rows_layout()).video(scenes, exposure_s=0.01, seed=5)
    rolled = camera_of(rows_layout()).video(scenes, exposure_s=0.01, seed=5, frame_s=0.01, line_s=0.0)

    for a, b in zip(plain, rolled, strict=True):
        assert np.array_equal(a.code, b.code)
        assert np.array_equal(a.expected_e, b.expected_e)


def test_static_scene_is_independent_of_shutter():
    scene = scene_of(pictures(1)[0])
    camera = camera_of(rows_layout())
    expected = next(camera.video([scene], exposure_s=0.01, seed=5)).expected_e
    for between in ("hold", "linear"):
        times = {"frame_s": 0.004, "line_s": 1.3e-3, "every": 3, "between": between}
        rolled = list(camera.video([scene] * 7, exposure_s=0.01, seed=5, **times))
        assert len(rolled) == 3
        for capture in rolled:
            assert np.allclose(capture.expected_e, expected, rtol=1e-12)


@pytest.mark.parametrize("between", ["hold", "linear"])
def test_moving_bar_is_skewed_by_line_time(between):
    layout = rows_layout(n_x=60, n_y=20, pitch_um=1.0)
    grid = fs.Grid.centred((40, 160), 0.5)
    speed_um_per_frame, frame_s, line_s = 0.1, 1e-4, 1e-3
    frames = (bar_map(grid, -20.0 + speed_um_per_frame * k) for k in range(300))
    (capture,) = map_camera(layout).video(
        frames, exposure_s=frame_s, seed=0, frame_s=frame_s, line_s=line_s, every=1000, between=between
    )
    light = capture.expected_e.reshape(20, 60)
    centre_um = light @ layout.centroid_um[:60, 0] / light.sum(axis=1)

    # v t_line = 0.1 µm / 1e-4 s * 1e-3 s = 1 µm per line.
    assert np.allclose(np.diff(centre_um), 1.0, atol=1e-9)


def test_motion_blur_has_expected_variance():
    layout = rows_layout(n_x=60, n_y=2, pitch_um=1.0)
    grid = fs.Grid.centred((8, 160), 0.5)
    frames = (bar_map(grid, -20.0 + 0.5 * k, width_um=1.0) for k in range(40))
    (capture,) = map_camera(layout).video(frames, exposure_s=0.02, seed=0, frame_s=1e-3, every=100)
    light = capture.expected_e[:60] / capture.expected_e[:60].sum()
    x_um = layout.centroid_um[:60, 0]
    variance = light @ x_um**2 - (light @ x_um) ** 2

    # Twenty positions 0.5 µm apart, 0.25 µm² (20² - 1) / 12, and every second bar covers two sites of 1 µm: 1/8 µm².
    assert variance == pytest.approx(0.25 * 399 / 12 + 0.125, abs=1e-3)


def test_lines_weight_frames_by_overlap():
    layout = rows_layout(n_x=1, n_y=3, pitch_um=1.0)
    grid = fs.Grid.centred((8, 8), 0.5)
    levels = np.array([1.0, 3.0, 10.0, 40.0])
    lights = [fs.PowerMap(np.full((1, 8, 8), level), grid, np.array([550.0])) for level in levels]
    camera = map_camera(layout)
    per_level = camera.photoelectrons_per_s(lights[0])
    held = next(camera.video(lights, exposure_s=1.5, seed=0, frame_s=1.0, line_s=0.5, every=9))
    line = next(camera.video(lights, exposure_s=1.5, seed=0, frame_s=1.0, line_s=0.5, every=9, between="linear"))

    # 1 for 1 s and 3 for 0.5 s; 1 for 0.5 s and 3 for 1 s; 3 for 1 s and 10 for 0.5 s.
    assert np.allclose(held.expected_e / per_level, [2.5, 3.5, 8.0], rtol=1e-12)
    # Piecewise linear interpolation of 1, 3, 10 and 40 at 0, 1, 2 and 3 s, integrated by the trapezoidal rule.
    table = np.interp(np.linspace(0, 3, 300_001), np.arange(4), levels)
    sums = [np.trapezoid(table[round(a * 1e5) : round((a + 1.5) * 1e5) + 1], dx=1e-5) for a in (0.0, 0.5, 1.0)]
    assert np.allclose(line.expected_e / per_level, sums, rtol=1e-9)


def test_last_frame_is_held_for_remaining_lines():
    layout = rows_layout(n_x=1, n_y=3, pitch_um=1.0)
    grid = fs.Grid.centred((8, 8), 0.5)
    lights = [fs.PowerMap(np.full((1, 8, 8), level), grid, np.array([550.0])) for level in (1.0, 3.0)]
    camera = map_camera(layout)
    per_level = camera.photoelectrons_per_s(lights[0])
    captures = list(camera.video(lights, exposure_s=1.0, seed=0, frame_s=1.0, line_s=1.0))

    assert [np.round(c.expected_e / per_level, 12).tolist() for c in captures] == [[1.0, 3.0, 3.0], [3.0, 3.0, 3.0]]


@pytest.mark.parametrize(("scan", "sign"), [(None, -1), ("rows_from_top", -1), ("rows_from_bottom", 1)])
def test_moving_edge_skews_as_in_cameras(scan, sign):
    # v t_line = 0.1 µm / 1e-4 s * 1e-3 s = 1 µm per row: the top row of the picture is read first, so that lower rows see
    # the edge farther to the right.
    layout = fs.layout.grid(n_x=60, n_y=20, pitch_um=1.0)
    grid = fs.Grid.centred((40, 160), 0.5)
    frames = (bar_map(grid, -20.0 + 0.1 * k) for k in range(800))
    options = {"exposure_s": 1e-4, "seed": 0, "frame_s": 1e-4, "line_s": 1e-3, "every": 1000}
    camera = map_camera(layout)
    if scan is None:
        with pytest.warns(
            FoveasimWarning, match="reads 20 rows from the top of the picture, because the layout has no"
        ):
            captures = camera.video(frames, **options)
    else:
        captures = camera.video(frames, **options, scan=scan)
    (capture,) = captures
    picture = capture.picture(of="expected_e", grid=fs.Grid.centred((20, 60), 1.0)).data[0]
    centre_um = picture @ layout.centroid_um[:60, 0] / picture.sum(axis=1)

    assert np.allclose(np.diff(centre_um), sign * 1.0, atol=1e-6)  # per row upwards
    assert capture.settings["scan"] == (scan or "rows_from_top")


def test_scan_replaces_readout_order():
    layout = fs.layout.readout_by(fs.layout.grid(n_x=1, n_y=3, pitch_um=1.0))
    times = {"frame_s": 1.0, "line_s": 0.5}

    assert Shutter(layout, **times).delay_s.tolist() == [1.0, 0.5, 0.0]
    assert Shutter(layout, **times, scan="rows_from_bottom").delay_s.tolist() == [0.0, 0.5, 1.0]
    with pytest.raises(ParameterError, match="'scan' requires 'line_s'"):
        camera_of(layout).video([], exposure_s=0.1, seed=0, frame_s=0.1, scan="rows_from_top")
    with pytest.raises(ParameterError, match="'scan' must be one of"):
        Shutter(layout, **times, scan="rows")


def test_every_nth_frame_starts_exposure():
    lights = [scene_of(p) for p in pictures(7)]
    camera = camera_of(rows_layout())
    captures = list(camera.video(lights, exposure_s=0.01, seed=0, frame_s=0.01, every=3))

    assert [c.settings["frame"] for c in captures] == [0, 1, 2]
    for k, capture in enumerate(captures):
        assert np.array_equal(capture.expected_e, camera.capture(lights[3 * k], exposure_s=0.01, seed=0).expected_e)


def test_overlapping_exposures_give_warning():
    camera, lights = camera_of(rows_layout()), [scene_of(pictures(1)[0])] * 4
    with pytest.warns(
        FoveasimWarning, match=r"the exposure of 1 s is longer than the 0.1 s between the starts of exposures"
    ):
        camera.video(lights, exposure_s=[0.05, 1.0], seed=0, frame_s=0.1)
    # Consecutive exposures, apart from rounding errors.
    assert len(list(camera.video(lights, exposure_s=0.1 + 0.2, seed=0, frame_s=0.1, every=3))) == 2


def test_invalid_shutter_arguments_are_rejected():
    shutter = Shutter(rows_layout(), frame_s=0.1, line_s=0.01)
    for call, name in (
        (lambda: Shutter(None, 1.0), "layout"),
        (lambda: shutter.overlap_fraction(0, -1.0), "exposure_s"),
        (lambda: shutter.overlap_fraction(0, np.nan), "exposure_s"),
        (lambda: shutter.overlap_fraction(-1, 1.0), "frame"),
        (lambda: shutter.last_frame(np.nan), "exposure_s"),
        (lambda: Exposure(shutter, np.nan), "exposure_s"),
        (lambda: Exposure(None, 1.0), "shutter"),
        (
            lambda: Exposure(shutter, 1.0).add(np.ones(3)),
            "rate_e_per_s' must have one value for each of the 120 sites",
        ),
        (lambda: Exposure(shutter, 1.0).add(np.full(120, np.nan)), "rate_e_per_s"),
        (lambda: Exposure(shutter, 1.0).mean_e_per_s(-np.ones(120)), "last_e_per_s"),
    ):
        with pytest.raises(ParameterError, match=name):
            call()


# -- frame sources ----------------------------------------------------------------------------------------------------


def test_directory_pictures_are_in_natural_order(tmp_path):
    for k in (10, 2, 1):
        write_picture(tmp_path / f"frame {k}.png", np.full((8, 8), k, np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    footage = FrameSource(tmp_path, **LIGHT)

    assert footage.n_frames == 3
    assert [round(float(scene.basis.max()) * 255) for scene in footage] == [1, 2, 10]
    assert [round(float(s.basis.max()) * 255) for s in FrameSource(tmp_path, start=1, step=1, **LIGHT)] == [2, 10]


def test_frame_source_can_be_iterated_again():
    footage = FrameSource(pictures(3), **LIGHT)

    assert [s.basis.sum() for s in footage] == [s.basis.sum() for s in footage]
    assert footage.n_frames == 3
    assert FrameSource(iter(pictures(2)), **LIGHT).n_frames is None
    assert FrameSource(pictures(5), start=1, stop=9, step=2, **LIGHT).n_frames == 2


def test_non_ascii_digits_in_names_are_ordered(tmp_path):
    names = ["٣.png", "01.png", "1.png", "2.png", "2²3.png", "10.png"]
    for name in reversed(names):
        write_picture(tmp_path / name, np.zeros((8, 8), np.uint8))
    assert [path.name for path in list_pictures(tmp_path)] == names


def test_iterator_source_is_consumed_once():
    footage = FrameSource(iter(pictures(3)), **LIGHT)
    assert len(list(footage)) == 3
    for again in (footage, footage.from_frame(1)):
        with pytest.raises(ParameterError, match=r"'source' was an iterator and has been consumed.*pass a list"):
            list(again)
    assert len(list(FrameSource(iter(pictures(3)), **LIGHT).from_frame(1))) == 2


def test_empty_frame_source_is_rejected():
    for source, options in (([], {}), (pictures(3), {"start": 3}), (pictures(3), {"start": 1, "stop": 1})):
        with pytest.raises(ParameterError, match="'source' must have a frame from"):
            FrameSource(source, **options, **LIGHT)
    for source, options in (((), {}), (pictures(3), {"start": 3})):
        footage = FrameSource(iter(source), **options, **LIGHT)
        with pytest.raises(
            ParameterError, match=r"'source' must have a frame from .*, got an unknown number of pictures"
        ):
            list(footage)
    # A resumed video may have no remaining frames.
    assert list(FrameSource(pictures(3), **LIGHT).from_frame(3)) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pich_um": 3.0}, "'pich_um' must be a parameter of Scene.from_picture; did you mean 'pitch_um'"),
        ({"distance_m": None}, "'distance_m' is missing"),
    ],
)
def test_scene_parameters_are_checked_before_reading(changes, message):
    settings = {name: value for name, value in (LIGHT | changes).items() if value is not None}
    with pytest.raises(ParameterError, match=message):
        FrameSource(["nowhere.png"], **settings)


def test_frames_of_different_size_are_rejected():
    with pytest.raises(FileError, match="frame 1: has the shape"):
        list(FrameSource([np.ones((4, 4)), np.ones((4, 5))], **LIGHT))


def test_missing_frame_source_is_rejected(tmp_path):
    with pytest.raises(FileError, match="no such file or directory"):
        FrameSource(tmp_path / "none.mp4", **LIGHT)
    with pytest.raises(FileError, match="contains no pictures"):
        FrameSource(tmp_path, **LIGHT)
    with pytest.raises(ParameterError, match="source"):
        FrameSource(3, **LIGHT)
    (tmp_path / "text.mp4").write_text("this is not a video")
    with pytest.raises(FileError, match="is not a readable video file"):
        FrameSource(tmp_path / "text.mp4", **LIGHT)


def test_missing_video_library_gives_install_command(tmp_path, monkeypatch):
    (tmp_path / "clip.mp4").write_bytes(b"0")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(FileError, match=r"pip install 'foveasim\[video\]'"):
        FrameSource(tmp_path / "clip.mp4", **LIGHT)
    camera = camera_of(rows_layout())
    captures = camera.video([scene_of(pictures(1)[0])], exposure_s=0.01, seed=0)
    with pytest.raises(FileError, match=r"pip install 'foveasim\[video\]'"):
        write_video(captures, tmp_path / "out.mp4")


# -- files ------------------------------------------------------------------------------------------------------------


def captures_of(n, **sensor):
    return camera_of(rows_layout(), **sensor).video([scene_of(p) for p in pictures(n)], exposure_s=0.01, seed=5)


def test_zarr_recording_contains_all_codes(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[read_recording.__module__], "CHUNK_CODES", 250)
    captures = list(captures_of(5))

    assert write_video(iter(captures), tmp_path / "v.zarr") == 5
    recording = read_recording(tmp_path / "v.zarr")

    assert recording.n_frames == 5
    assert recording.code.dtype == np.uint16
    assert np.array_equal(recording.code[:], [c.code for c in captures])
    assert recording.frame.tolist() == [0, 1, 2, 3, 4]
    assert recording.exposure_s.tolist() == [0.01] * 5
    assert recording.settings == captures[0].settings
    assert np.array_equal(recording.layout.xy_um, captures[0].layout.xy_um)
    assert np.array_equal(recording.layout.columns["readout_order"], captures[0].layout.columns["readout_order"])
    assert recording.bits == 12
    assert np.array_equal(recording.white_dn, captures[0].white_dn)
    assert [p.name for p in tmp_path.iterdir()] == ["v.zarr"]


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("other", [{"bits": 8}, {"n_x": 11}])
def test_captures_of_different_sensors_are_rejected(tmp_path, other, resume):
    sensor = {"bits": other["bits"]} if "bits" in other else {}
    camera = camera_of(rows_layout(n_x=other.get("n_x", 12)), **sensor)
    captures = [*captures_of(2), camera.capture(scene_of(pictures(1)[0]), exposure_s=0.01, seed=0, frame=2)]
    with pytest.raises(ParameterError, match="must have the same layout and bits"):
        write_video(captures, tmp_path / "v.zarr", resume=resume)
    assert count_recorded_frames(tmp_path / "v.zarr") == (2 if resume else 0)


@pytest.mark.slow
def test_failed_write_leaves_existing_files(tmp_path):
    def failing():
        yield from captures_of(2)
        raise RuntimeError("the source failed")

    write_video(captures_of(3), tmp_path / "v.zarr")
    for name in ("v.zarr", "pictures", "v.gif", "v.mp4"):
        with pytest.raises(RuntimeError, match="the source failed"):
            write_video(failing(), tmp_path / name)

    assert [p.name for p in tmp_path.iterdir()] == ["v.zarr"]
    assert read_recording(tmp_path / "v.zarr").n_frames == 3


@pytest.mark.slow
def test_only_recordings_are_overwritten(tmp_path):
    write_video(captures_of(3), tmp_path / "v.zarr")
    write_video(captures_of(2), tmp_path / "v.zarr")
    assert read_recording(tmp_path / "v.zarr").n_frames == 2

    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("text")
    (tmp_path / "other.zarr").mkdir()
    (tmp_path / "other.zarr" / "notes.txt").write_text("text")
    for name in ("other", "other.zarr"):
        with pytest.raises(FileError, match="the path contains other data"):
            write_video(captures_of(1), tmp_path / name)
        assert (tmp_path / name / "notes.txt").read_text() == "text"


@pytest.mark.parametrize(
    ("frame_s", "rate"), [(1.001 / 30.0, "30000/1001"), (0.04, "25"), (2.5, "2/5"), (2000.0, "1/2000")]
)
def test_video_file_has_frame_rate(tmp_path, frame_s, rate):
    av = pytest.importorskip("av")
    write_video(captures_of(2), tmp_path / "v.mp4", frame_s=frame_s)
    with av.open(str(tmp_path / "v.mp4")) as container:
        assert str(container.streams.video[0].base_rate or container.streams.video[0].average_rate) == rate


@pytest.mark.parametrize(
    ("name", "frame_s", "message"),
    [
        ("v.mp4", 1e-20, "'frame_s' must be"),
        ("v.mp4", 1e-7, "'frame_s' must be >= 1e-06 in a video file, got 1e-07 s; a .zarr store has any frame rate"),
        ("v.gif", 1e-20, "'frame_s' must be"),
        ("v.zarr", np.inf, "'frame_s' must be"),
    ],
)
def test_implausible_frame_rates_are_rejected(tmp_path, name, frame_s, message):
    with pytest.raises(ParameterError, match=message):
        write_video(captures_of(1), tmp_path / name, frame_s=frame_s)
    assert not (tmp_path / name).exists()


def test_written_pictures_match_captures(tmp_path):
    from foveasim._io.images import read_picture

    captures = list(captures_of(2))
    assert write_video(captures, tmp_path / "pictures", max_pixels=60) == 2

    for k, capture in enumerate(captures):
        expected = capture.picture(max_pixels=60).to_image(capture.white_dn)
        assert np.array_equal(read_picture(tmp_path / "pictures" / f"frame_{k:06d}.png"), expected)


@pytest.mark.parametrize("extension", ["mp4", "webm", "mkv"])
def test_video_file_round_trip_preserves_levels(tmp_path, extension):
    layout = rows_layout()
    grid = fs.Grid.centred((80, 90), 0.5)
    levels = np.linspace(0.1, 0.9, 6)
    camera = map_camera(layout, bits=8, capacitance_f=1e-13)
    full = float(camera.photoelectrons_per_s(fs.PowerMap(np.ones((1, 80, 90)), grid, np.array([550.0]))).max())
    exposure_s = 1.872e6 / full
    lights = [fs.PowerMap(np.full((1, 80, 90), level), grid, np.array([550.0])) for level in levels]
    path = tmp_path / f"film.{extension}"

    assert write_video(camera.video(lights, exposure_s=exposure_s, seed=0), path, max_pixels=64, frame_s=0.1) == 6
    footage = FrameSource(path, **(LIGHT | {"encoding": "srgb", "wavelength_nm": (550.0,)}))

    assert footage.frame_s == pytest.approx(0.1)
    found = [float(np.median(scene.basis)) for scene in footage]
    assert np.allclose(found, levels, atol=0.03)


def test_gif_contains_all_frames(tmp_path):
    from PIL import Image

    write_video(captures_of(4), tmp_path / "v.gif", frame_s=0.1, max_pixels=40)
    with Image.open(tmp_path / "v.gif") as gif:
        assert gif.n_frames == 4
        assert gif.info["duration"] == 100


@pytest.mark.slow
def test_unknown_extension_or_no_captures_is_rejected(tmp_path):
    with pytest.raises(FileError, match="must end in"):
        write_video(captures_of(1), tmp_path / "v.txt")
    for name in ("v.zarr", "v.gif", "v.mp4", "pictures"):
        with pytest.raises(ParameterError, match="at least one capture"):
            write_video([], tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_directory_without_recording_is_rejected(tmp_path):
    with pytest.raises(FileError, match="no such directory"):
        read_recording(tmp_path / "none.zarr")
    (tmp_path / "empty.zarr").mkdir()
    with pytest.raises(FileError, match="is corrupt or not a valid video"):
        read_recording(tmp_path / "empty.zarr")


def test_recording_with_unknown_codec_is_rejected(tmp_path):
    write_video(captures_of(2), tmp_path / "v.zarr")
    path = tmp_path / "v.zarr" / "code" / "zarr.json"
    path.write_text(path.read_text().replace('"zstd"', '"numcodecs.pickle"'))
    with pytest.raises(FileError, match=r"has the codec 'numcodecs\.pickle'"):
        read_recording(tmp_path / "v.zarr")


def test_recording_of_excessive_size_is_rejected(tmp_path):
    write_video(captures_of(2), tmp_path / "v.zarr")
    path = tmp_path / "v.zarr" / "xy_um" / "zarr.json"
    text = path.read_text()
    path.write_text(text.replace("480", str(10**10), 1))
    assert path.read_text() != text
    with pytest.raises(FileError, match="would decompress to more"):
        read_recording(tmp_path / "v.zarr")


def test_progress_bar_counts_frames(tmp_path, capsys):
    write_video(captures_of(2), tmp_path / "v.zarr", progress=True, n_frames=2)

    assert "frames" in capsys.readouterr().out


# -- interrupted recordings -------------------------------------------------------------------------------------------

#: A rolling shutter, an exposure bracket, and two frames per capture.
ROLLING = {"exposure_s": [0.002, 0.008, 0.005], "seed": 5, "frame_s": 0.004, "line_s": 1e-3, "every": 2}


class InterruptionError(Exception):
    """Interrupts a recording."""


def rolling(n_before, n_frames=22, **sensor):
    """Return the captures after ``n_before`` recorded ones."""
    footage = FrameSource(pictures(n_frames), **LIGHT).from_frame(2 * n_before)
    return camera_of(rows_layout(), **sensor).video(footage, **ROLLING, first_frame=n_before)


def interrupted(captures, n):
    """Yield ``n`` captures, then raise an error."""
    yield from islice(captures, n)
    raise InterruptionError


def files_of(directory):
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


@pytest.fixture
def small_chunks(monkeypatch):
    """Set chunks of four frames of 120 sites."""
    monkeypatch.setattr(sys.modules[read_recording.__module__], "CHUNK_CODES", 500)


@pytest.fixture(scope="module")
def rolled():
    """All captures of a recording that is not interrupted."""
    return list(rolling(0))


@pytest.fixture(scope="module")
def expected_files(rolled, tmp_path_factory):
    """Return the files of a recording that is not interrupted, in small chunks."""
    path = tmp_path_factory.mktemp("rolled") / "expected.zarr"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys.modules[read_recording.__module__], "CHUNK_CODES", 500)
        write_video(rolled, path)
    return files_of(path)


@pytest.mark.slow(keep=1)
@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("n_added", [(0, 3), (4, 1, 4), (5, 6), (11,), (1, 0, 1)])
def test_interrupted_recording_resumes_bit_identically(tmp_path, n_added, expected_files):
    path, n = tmp_path / "v.zarr", 0
    for more in n_added:
        assert count_recorded_frames(path) == n
        with pytest.raises(InterruptionError) as caught:
            write_video(interrupted(rolling(n), more), path, resume=True)
        n += more
        notes = [f"{n} frames are stored in {partial_path(path)}; the same call resumes the recording"] if n else []
        assert getattr(caught.value, "__notes__", []) == notes
        assert [p.name for p in tmp_path.iterdir()] == (["v.zarr.partial"] if n else [])

    assert write_video(rolling(n), path, resume=True) == 11

    assert files_of(path) == expected_files
    assert not partial_path(path).exists()
    assert count_recorded_frames(path) == read_recording(path).n_frames == 11
    assert write_video(rolling(count_recorded_frames(path)), path, resume=True) == 11


@pytest.mark.usefixtures("small_chunks")
def test_ctrl_c_preserves_all_frames(tmp_path):
    def ctrl_c():
        yield from islice(rolling(0), 6)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(ctrl_c(), tmp_path / "v.zarr", resume=True)

    assert count_recorded_frames(tmp_path / "v.zarr") == 6


RECORDER = """
import sys, time
from pathlib import Path
sys.path[:0] = TESTS
from test_video import count_recorded_frames, rolling, write_video
recording = sys.modules[count_recorded_frames.__module__]
recording.CHUNK_CODES, recording.WRITE_S = 500, 0.0

def slowly(captures):
    for capture in captures:
        if capture.settings["frame"] == 10:
            time.sleep(600)
        yield capture

write_video(slowly(rolling(count_recorded_frames("v.zarr"))), "v.zarr", resume=True)
"""


@pytest.mark.slow
def test_killed_process_leaves_valid_recording(tmp_path, monkeypatch, expected_files):
    script, path = tmp_path / "record.py", tmp_path / "v.zarr"
    script.write_text(f"TESTS = {list(map(str, Path(__file__).parents[:2]))!r}\n{RECORDER}")
    n_recorded = 0
    for more in (2, 3):
        running = subprocess.Popen([sys.executable, script], cwd=tmp_path)
        wait_until(lambda n=n_recorded + more: count_recorded_frames(path) >= n, program=running)
        running.kill()
        assert running.wait() == -signal.SIGKILL
        assert n_recorded + more <= count_recorded_frames(path) < 11
        n_recorded = count_recorded_frames(path)

    monkeypatch.setattr(sys.modules[read_recording.__module__], "CHUNK_CODES", 500)
    assert write_video(rolling(n_recorded), path, resume=True) == 11
    assert files_of(path) == expected_files


@pytest.mark.slow
@pytest.mark.usefixtures("small_chunks")
def test_full_disk_loses_no_complete_frame(tmp_path, monkeypatch, rolled, expected_files):
    codes, replace, n_full = np.array([capture.code for capture in rolled]), Path.replace, 0
    monkeypatch.setattr(sys.modules[read_recording.__module__], "WRITE_S", 0.0)

    def fill_after(n_files):
        def full(path, target):
            nonlocal n_files
            n_files -= 1
            if n_files < 0:
                raise OSError(28, "No space left on device")
            return replace(path, target)

        monkeypatch.setattr(Path, "replace", full)

    for n_files in range(0, 90, 11):
        path = tmp_path / f"{n_files}.zarr"
        fill_after(n_files)
        try:
            write_video(iter(rolled), path, resume=True)
        except FileError as error:
            n_full += 1
            assert "cannot be written: No space left on device" in str(error)  # noqa: PT017 -- some calls succeed
        monkeypatch.setattr(Path, "replace", replace)
        n_recorded = count_recorded_frames(path)
        if n_recorded:
            assert np.array_equal(codes_of(path, n_recorded), codes[:n_recorded])
        assert write_video(iter(rolled[n_recorded:]), path, resume=True) == 11
        assert files_of(path) == expected_files
    assert n_full > 5


def codes_of(path, n):
    """Return the codes of the first frames of a finished or interrupted recording."""
    import zarr

    return zarr.open_array(str(path if path.exists() else partial_path(path)), path="code", mode="r")[:n]


@pytest.mark.slow
def test_frames_are_written_at_time_intervals(tmp_path, monkeypatch):
    path, n_recorded = tmp_path / "v.zarr", []

    def watched():
        for capture in rolling(0):
            n_recorded.append(count_recorded_frames(path))
            yield capture

    monkeypatch.setattr(sys.modules[read_recording.__module__], "WRITE_S", 0.0)
    write_video(watched(), path, resume=True)

    assert n_recorded == list(range(11))


@pytest.mark.slow
@pytest.mark.usefixtures("small_chunks")
def test_different_recording_is_not_resumed(tmp_path):
    path = tmp_path / "v.zarr"
    with pytest.raises(InterruptionError):
        write_video(interrupted(rolling(0), 5), path, resume=True, plan={"gaze": {"seed": 1}})
    before = files_of(partial_path(path))

    def message_of(options=None, light=None, plan=1, **sensor):
        layout = sensor.pop("layout", rows_layout())
        footage = FrameSource(pictures(22), **(LIGHT | (light or {}))).from_frame(10)
        captures = camera_of(layout, **sensor).video(footage, **(ROLLING | {"first_frame": 5} | (options or {})))
        with pytest.raises((FileError, ParameterError)) as rejected:
            write_video(captures, path, resume=True, plan={"gaze": {"seed": plan}})
        assert files_of(partial_path(path)) == before
        return str(rejected.value)

    columns = rows_layout().with_columns(zone=np.arange(120))
    shifted = rows_layout().translate(0.1, 0.0)
    for name, changes in {
        "gaze.seed": {"plan": 2},
        "bits": {"bits": 8},
        "sensor.read_noise_e": {"read_noise_e": 3.0},
        "layout": {"layout": shifted},
        "seed": {"options": {"seed": 6}},
        "line_s": {"options": {"line_s": 2e-3}},
        "every": {"options": {"every": 3}},
        "light.pitch_um": {"light": {"pitch_um": 11.0}},
        "light.spectrum_w_m2_sr_nm": {"light": {"peak_radiance_w_m2_sr_nm": 0.2}},
    }.items():
        assert f"is another recording: '{name}' differs; choose another path" in message_of(**changes)
    assert "'layout' differs" in message_of(layout=columns)
    for first_frame in (0, 4, 6):
        message = message_of(options={"first_frame": first_frame})
        assert "expected 5 after 5 frames; skip the scenes of the first 5 frames" in message
        assert f"got {first_frame}" in message


#: Records two more frames, and a capture in tiles, with a function as quantum efficiency.
FUNCTION_RECORDER = """
import sys
import numpy as np
import foveasim as fs
from foveasim.errors import FileError
from foveasim.tiles import write_tiles
from foveasim.video import count_recorded_frames, write_video
from own import qe

light = fs.PowerMap(np.ones((1, 8, 8)), fs.Grid.centred((8, 8), 1.0), np.array([550.0]))
sensor = fs.Sensor(fs.layout.grid(n_x=4, n_y=4, pitch_um=1.0), qe=qe)
camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
n = count_recorded_frames("v.zarr")

def frames():
    yield from (light, light)
    raise InterruptedError

for write in (
    lambda: write_video(camera.video(frames(), exposure_s=0.01, seed=1, first_frame=n), "v.zarr", resume=True),
    lambda: write_tiles("t.zarr", camera, light, exposure_s=0.01, seed=1),
):
    try:
        write()
    except (FileError, InterruptedError) as error:
        print(type(error).__name__, "qe" if "sensor.qe" in str(error) else "")
print(count_recorded_frames("v.zarr"))
"""


@pytest.mark.slow
def test_functions_are_equal_in_new_processes(tmp_path):
    def run(hash_seed):
        environment = os.environ | {"PYTHONHASHSEED": str(hash_seed), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, "-c", FUNCTION_RECORDER]
        found = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert found.returncode == 0, found.stderr
        return found.stdout.split()

    source = "LEVEL = 0.5\n\n\ndef qe(wavelength_nm):\n    return LEVEL + 0.0 * wavelength_nm\n"
    (tmp_path / "own.py").write_text(source)
    assert run(1) == ["InterruptedError", "2"]
    (tmp_path / "own.py").write_text("# a comment\n" + source)
    assert run(2) == ["InterruptedError", "4"]
    (tmp_path / "own.py").write_text(source.replace("0.5", "0.6"))
    assert run(3) == ["FileError", "qe", "FileError", "qe", "4"]


def gaze_path(n, last_um=3.0):
    xy_um = np.random.default_rng(4).uniform(-4.0, 4.0, (n, 2))
    xy_um[-1, 0] = last_um
    return GazePath(0.004 * np.arange(n), xy_um)


GAZE_FRAMES = {
    "shift": lambda scene, path, n: islice(shift_sensor(scene, path), n, None),
    "rest": lambda scene, path, n: shift_sensor(scene, GazePath(path.t_s[n:], path.xy_um[n:])),
    "pan": lambda scene, path, n: islice(pan_camera(scene, path, OPTICS, shape=(150, 200)), n, None),
    "list": lambda scene, path, n: [(scene, tuple(xy_um)) for xy_um in path.xy_um][n:],
}


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(("kind", "every"), [("shift", 1), ("rest", 2), ("pan", 2), ("list", 1)])
def test_recordings_store_and_check_gaze(tmp_path, kind, every):
    file, scene, path = tmp_path / "v.zarr", scene_of(pictures(1, (180, 240))[0]), gaze_path(8)
    shutter = {"frame_s": 0.004, "every": every} if every > 1 else {}

    def captures(n, path):
        frames = GAZE_FRAMES[kind](scene, path, n * every)
        return camera_of(rows_layout()).video(frames, exposure_s=0.003, seed=1, first_frame=n, **shutter)

    with pytest.raises(InterruptionError):
        write_video(interrupted(captures(0, path), 2), file, resume=True)
    # Only the last point of the path differs.
    for other in (gaze_path(8, last_um=2.0), GazePath(path.t_s[:-1], path.xy_um[:-1])):
        with pytest.raises(FileError, match="is another recording: 'gaze_path' differs"):
            write_video(captures(2, other), file, resume=True)
    still = camera_of(rows_layout()).video([scene], exposure_s=0.003, seed=1, first_frame=2, **shutter)
    with pytest.raises(FileError, match="is another recording"):
        write_video(still, file, resume=True)
    n = write_video(captures(2, path), file, resume=True)
    write_video(captures(0, path), tmp_path / "expected.zarr")

    assert n == 8 // every
    assert np.array_equal(read_recording(file).gaze_um, path.xy_um[::every])
    assert files_of(file) == files_of(tmp_path / "expected.zarr")


def test_recording_without_gaze_is_centred(tmp_path):
    write_video(captures_of(2), tmp_path / "v.zarr")

    assert read_recording(tmp_path / "v.zarr").gaze_um.tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_recording_with_different_filters_is_rejected(tmp_path):
    layout = rows_layout()
    layout = layout.with_columns(channel=np.arange(layout.n_sites) % 3)
    for filters, rejection in ((None, None), ("rgb", "'filters' differs")):
        n = count_recorded_frames(tmp_path / "v.zarr")
        captures = camera_of(layout, filters=filters).video(
            [scene_of(p) for p in pictures(3)[n:]], exposure_s=0.01, seed=5, first_frame=n
        )
        with pytest.raises(InterruptionError if rejection is None else FileError, match=rejection):
            write_video(interrupted(captures, 2), tmp_path / "v.zarr", resume=True)


def test_varied_settings_may_vary_after_resuming(tmp_path):
    """The distance differs between frames."""
    path = tmp_path / "v.zarr"
    scenes = [fs.Scene.from_picture(p, **(LIGHT | {"distance_m": 0.5 - 0.02 * k})) for k, p in enumerate(pictures(4))]

    def moving(n, **sensor):
        return camera_of(rows_layout(), **sensor).video(scenes[n:], exposure_s=0.01, seed=1, first_frame=n)

    with pytest.raises(InterruptionError):
        write_video(interrupted(moving(0), 2), path, resume=True)
    with pytest.raises(FileError, match=r"sensor\.read_noise_e"):
        write_video(moving(2, read_noise_e=3.0), path, resume=True)
    assert write_video(moving(2), path, resume=True) == 4
    assert np.array_equal(read_recording(path).code[:], [c.code for c in moving(0)])


def test_nonconsecutive_frames_cannot_be_recorded_resumably(tmp_path):
    captures = [next(captures_of(1)) for _ in range(2)]
    with pytest.raises(ParameterError, match="must have consecutive frame numbers"):
        write_video(captures, tmp_path / "v.zarr", resume=True)
    assert write_video(captures, tmp_path / "v.zarr") == 2


def test_recording_is_locked_while_writing(tmp_path):
    path = tmp_path / "v.zarr"

    def concurrent():
        for k, capture in enumerate(rolling(0)):
            if k in (0, 3):
                with pytest.raises(FileError, match="is being written by another process"):
                    write_video(rolling(0), path, resume=True)
            yield capture

    assert write_video(concurrent(), path, resume=True) == 11
    assert np.array_equal(read_recording(path).code[:], [c.code for c in rolling(0)])


@pytest.mark.slow
def test_finished_recording_is_unchanged(tmp_path):
    path = tmp_path / "v.zarr"
    write_video(rolling(0), path, resume=True, plan={"a": 1})
    before = files_of(path)

    def never():
        raise AssertionError
        yield

    assert write_video(never(), path, resume=True, plan={"a": 1}) == 11
    with pytest.raises(FileError, match="is another recording: 'a' differs"):
        write_video(never(), path, resume=True, plan={"a": 2})
    write_video(rolling(0), tmp_path / "w.zarr")
    with pytest.raises(FileError, match="is a finished recording of 11 frames, to which captures cannot be appended"):
        write_video(rolling(10), tmp_path / "w.zarr", resume=True)
    assert files_of(path) == before


def test_other_data_are_not_overwritten(tmp_path):
    for name, existing in (("a", "a.zarr"), ("b", "b.zarr.partial")):
        (tmp_path / existing).mkdir()
        (tmp_path / existing / "notes.txt").write_text("text")
        with pytest.raises(FileError, match="the path contains other data"):
            write_video(rolling(0), tmp_path / f"{name}.zarr", resume=True)
        assert files_of(tmp_path / existing) == {"notes.txt": b"text"}
    (tmp_path / "c.zarr.partial").write_text("text")
    with pytest.raises(FileError, match="the path contains other data"):
        write_video(rolling(0), tmp_path / "c.zarr", resume=True)
    with pytest.raises(FileError, match="does not exist"):
        write_video(rolling(0), tmp_path / "none" / "c.zarr", resume=True)


def test_only_zarr_recordings_can_be_resumed(tmp_path):
    for name in ("v.mp4", "v.gif", "pictures"):
        with pytest.raises(ParameterError, match=r"'resume' is supported for \.zarr stores only"):
            write_video(rolling(0), tmp_path / name, resume=True)
        with pytest.raises(FileError, match=r"must end in \.zarr"):
            count_recorded_frames(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("small_chunks")
def test_progress_bar_continues_after_resuming(tmp_path, capsys):
    with pytest.raises(InterruptionError):
        write_video(interrupted(rolling(0), 6), tmp_path / "v.zarr", resume=True, progress=True, n_frames=11)
    assert "55%" in capsys.readouterr().out
    write_video(rolling(6), tmp_path / "v.zarr", resume=True, progress=True, n_frames=11)
    assert "100%" in capsys.readouterr().out


def test_frame_source_from_frame_is_remainder(tmp_path):
    film = tmp_path / "film.mp4"
    write_video(captures_of(7), film, max_pixels=64, frame_s=0.1)
    for source in (film, pictures(7)):
        footage = FrameSource(source, start=1, step=2, **(LIGHT | {"wavelength_nm": (550.0,)}))
        expected = [scene.basis for scene in footage]
        assert len(expected) == 3
        for n in range(5):
            remaining = footage.from_frame(n)
            assert remaining.n_frames == max(3 - n, 0)
            assert remaining.frame_s == footage.frame_s
            assert [b.tobytes() for b in expected[n:]] == [scene.basis.tobytes() for scene in remaining]
    with pytest.raises(ParameterError, match="'n'"):
        footage.from_frame(-1)


def test_consolidated_metadata_are_ignored(tmp_path):
    """Consolidated metadata of zarr could name a codec that the metadata of the array do not name."""
    path = tmp_path / "v.zarr"
    codes = [c.code for c in captures_of(2)]
    write_video(captures_of(2), path)
    about = json.loads((path / "zarr.json").read_text())
    code = (path / "code" / "zarr.json").read_text().replace('"zstd"', '"numcodecs.pickle"')
    about["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": {"code": json.loads(code)},
    }
    (path / "zarr.json").write_text(json.dumps(about))

    assert np.array_equal(read_recording(path).code[:], codes)


# -- command line -----------------------------------------------------------------------------------------------------

SHOT = """
scene: {kind: picture, picture: photo.png, pitch_um: 100, distance_m: 1.0, peak_radiance_w_m2_sr_nm: 0.2}
optics: {focal_length_mm: 8, f_number: 2.8}
layout: {generator: grid, parameters: {n_x: 20, n_y: 20, pitch_um: 3}}
sensor: {capacitance_f: 1.0e-13}
exposure_s: 0.01
"""


@pytest.fixture
def directory(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    (tmp_path / "shot.yaml").write_text(SHOT)
    (tmp_path / "frames").mkdir()
    for k in range(3):
        write_picture(tmp_path / "frames" / f"{k}.png", rng.integers(0, 255, (120, 160, 3), np.uint8))
    write_picture(tmp_path / "photo.png", rng.integers(0, 255, (120, 160, 3), np.uint8))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(*arguments):
    """Run the command ``video`` in this process and return its exit code."""
    from foveasim.cli import main

    before, sys.argv = sys.argv, ["foveasim", "video", *arguments]
    try:
        main()
    except SystemExit as error:
        return error.code or 0
    finally:
        sys.argv = before
    return 0


def test_command_records_directory_with_shot_camera(directory, capsys):
    assert command("shot.yaml", "--frames", "frames", "--out", "v.zarr") == 0
    recording = read_recording(directory / "v.zarr")

    assert recording.n_frames == 3
    assert "3 frames" in capsys.readouterr().out
    from foveasim.config import read_shot

    shot = read_shot("shot.yaml", ["scene.picture=frames/2.png"])
    single = shot.camera.capture(shot.scene, exposure_s=0.01, seed=0, frame=2)
    assert np.array_equal(recording.code[2], single.code)


@pytest.mark.parametrize("framing", ["fit: cover", "field_of_view_deg: 1.0"])
def test_command_frames_each_picture(directory, framing):
    """The pictures of the video have other numbers of pixels than that of the shot."""
    from foveasim.config import read_shot

    (directory / "shot.yaml").write_text(SHOT.replace("pitch_um: 100", framing))
    write_picture(directory / "photo.png", np.zeros((30, 90, 3), np.uint8))
    assert command("shot.yaml", "--frames", "frames", "--out", "v.zarr") == 0

    shot = read_shot("shot.yaml", ["scene.picture=frames/1.png"])
    single = shot.camera.capture(shot.scene, exposure_s=0.01, seed=0, frame=1)
    assert np.array_equal(read_recording(directory / "v.zarr").code[1], single.code)


def test_command_stops_after_given_frames(directory):
    assert command("shot.yaml", "--frames", "frames", "--out", "pictures", "--stop", "2") == 0

    assert sorted(p.name for p in (directory / "pictures").iterdir()) == ["frame_000000.png", "frame_000001.png"]


#: The command, which waits with a number of recorded frames, and says so.
HELD_COMMAND = """
import sys, time
from pathlib import Path
from foveasim import cli
from foveasim.video import recording
n_frames, add = int(sys.argv.pop(1)), recording._Frames.add
def held(frames, capture):
    if capture.settings["frame"] == n_frames:
        Path("held").touch()
        time.sleep(600)
    add(frames, capture)
recording._Frames.add = held
cli.main()
"""


def run_command(n_frames, *arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-c", HELD_COMMAND, str(n_frames), "video", "shot.yaml", "--frames", "frames", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


@pytest.mark.slow
def test_stopped_command_resumes(directory, capsys):
    frames, out = directory / "frames", directory / "v.zarr"
    for k in range(3, 18):
        os.link(frames / f"{k % 3}.png", frames / f"{k}.png")
    messages = []
    for n_frames in (0, 8):
        running = run_command(n_frames, "--out", "v.zarr", cwd=directory)
        wait_until((directory / "held").exists, program=running)
        running.send_signal(signal.SIGINT)
        messages.append(running.communicate(timeout=DEADLINE_S)[1])
        assert running.returncode == 130
        assert count_recorded_frames(out) == n_frames
        (directory / "held").unlink()

    assert messages[0] == "interrupted\n"
    assert messages[1].startswith("interrupted; ")
    assert "8 frames" in messages[1]
    assert not out.exists()

    arguments = ("shot.yaml", "--frames", "frames", "--out", "v.zarr")
    assert command(*arguments, "--set", "sensor.read_noise_e=9") == 2
    assert "is another recording: 'sensor.read_noise_e' differs" in capsys.readouterr().err
    assert command(*arguments) == 0
    assert "wrote v.zarr: 18 frames" in capsys.readouterr().out
    assert command("shot.yaml", "--frames", "frames", "--out", "expected.zarr") == 0
    assert files_of(out) == files_of(directory / "expected.zarr")


@pytest.mark.slow
def test_corrupt_frame_loses_no_recorded_frame(directory, capsys):
    good = (directory / "frames" / "2.png").read_bytes()
    (directory / "frames" / "2.png").write_bytes(good[:-100].ljust(len(good), b"\0"))
    arguments = ("shot.yaml", "--frames", "frames", "--out", "v.zarr")

    assert command(*arguments) == 2
    # The error may be raised while the previous frame has been read but not captured.
    assert 1 <= count_recorded_frames("v.zarr") <= 2
    assert " frames are stored in v.zarr.partial; the same call resumes the recording" in capsys.readouterr().err
    (directory / "frames" / "2.png").write_bytes(good)
    assert command(*arguments) == 0
    assert read_recording(directory / "v.zarr").frame.tolist() == [0, 1, 2]


@pytest.mark.slow
def test_command_leaves_finished_recordings_unchanged(directory, capsys):
    arguments = ("shot.yaml", "--frames", "frames", "--out", "v.zarr")
    assert command(*arguments) == 0
    before = files_of(directory / "v.zarr")
    capsys.readouterr()

    assert command(*arguments) == 0
    assert "v.zarr was already complete: 3 frames" in capsys.readouterr().out
    for changes, name in (
        (("--set", "optics.f_number=4"), "optics.f_number"),
        (("--stop", "2"), "stop"),
        (("--set", "layout.parameters.pitch_um=2.9"), "layout.parameters.pitch_um"),
        (("--set", "exposure_s=0.02"), "exposure_s"),
    ):
        assert command(*arguments, *changes) == 2
        assert f"is another recording: '{name}' differs" in capsys.readouterr().err
    write_picture(directory / "frames" / "3.png", np.zeros((120, 160, 3), np.uint8))
    assert command(*arguments) == 2
    assert "is another recording: 'frames' differs" in capsys.readouterr().err
    assert files_of(directory / "v.zarr") == before
    # Other formats are written again.
    for k in ("2", "3"):
        assert command("shot.yaml", "--frames", "frames", "--out", "v.gif", "--stop", k) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--frames", "none"), "no such file or directory"),
        (("--frames", "frames", "--fps", "0"), "--fps must be > 0"),
        (("--frames", "frames", "--line-s", "1e-4"), "frame_s"),
        (("--frames", "frames", "--line-s", "1e-4", "--fps", "30", "--scan", "rows"), "'scan' must be one of"),
        (("--frames", "frames", "--out", "v.txt"), "must end in"),
    ],
)
@pytest.mark.usefixtures("directory")
def test_command_errors_are_one_line(capsys, arguments, message):
    assert command("shot.yaml", *arguments) == 2
    error = capsys.readouterr().err

    assert message in error
    assert "Traceback" not in error


def test_template_scene_specifies_frame_settings():
    grey, colour = (
        fs.Scene.from_picture(p, **(LIGHT | {"peak_radiance_w_m2_sr_nm": 0.3, "wavelength_nm": w}))
        for p, w in ((np.ones((4, 5)), (500.0,)), (np.ones((4, 5, 3)), (600.0, 550.0, 500.0)))
    )
    white = np.full((6, 7, 3), 0.5)
    for like, frame in ((grey, white), (colour, white), (grey, white[..., 0]), (colour, white[..., 0])):
        (scene,) = FrameSource([frame], template=like, encoding="linear")
        assert scene.basis.shape == (like.basis.shape[0], 6, 7)
        assert np.allclose(scene.basis, 0.5)
        assert np.array_equal(scene.spectrum_w_m2_sr_nm, like.spectrum_w_m2_sr_nm)
        assert np.array_equal(scene.wavelength_nm, like.wavelength_nm)
    with pytest.raises(ParameterError, match="pitch_um"):
        FrameSource([], template=grey, pitch_um=3.0)
    with pytest.raises(ParameterError, match="template"):
        FrameSource([], template=3)
