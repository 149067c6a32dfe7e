"""
Calls of all public functions and commands, with valid arguments.

A program without test tools, for environments that contain the package and some of its extras only::

    python tests/installation/calls.py [--report REPORT.json] [--program foveasim] [NAME ...]

It makes the named calls, by default all. Each one works, or gives one line with the command that installs an extra; other
outcomes are printed, and the exit status is 1. The report contains all outcomes. With ``--program``, commands are run by this
program, otherwise in this process.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
import warnings
import zlib
from contextlib import redirect_stderr, redirect_stdout
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely

import foveasim as fs

#: One line with the command that installs an extra.
HINT = re.compile(r"[^\n]* needs [\w.]+; install it with: pip install 'foveasim\[(\w+)\]'")
#: Beginnings of messages that depend on the machine.
MACHINE = ("this machine has no screen", "this machine has no OpenGL")
PICTURE = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8)
SHOT = {
    "scene": {
        "kind": "flat",
        "shape": [60, 60],
        "pitch_um": 300.0,
        "distance_m": 1.0,
        "radiance_w_m2_sr_nm": 0.1,
        "band_width_nm": 100.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {
        "generator": "grid",
        "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0},
        "rules": {"min_size_um": 1.0},
    },
    "sensor": {"read_noise_e": 2.0, "capacitance_f": 4e-15},
    "exposure_s": 0.0001,
}
PHOTOGRAPHED = SHOT | {
    "scene": {
        "kind": "picture",
        "picture": "photos/cats/1.png",
        "pitch_um": 300.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.05,
        "wavelength_nm": [620, 550, 450],
    },
    "exposure_s": 0.01,
}
VARIED = PHOTOGRAPHED | {"scene": {k: v for k, v in PHOTOGRAPHED["scene"].items() if k != "picture"}}
VARY = {"sensor.bits": [8, 10]}
SEARCH = {"sensor.bits": [8, 10]}
GOALS = {"snr_mean": "maximize"}
LIMIT = fs.config.Requirement(measure="snr", at_least=1.0)
DRAWS = {"optics.f_number": {"uniform": [2.0, 4.0]}}
SHEET = {
    "shape": (60, 60),
    "pitch_um": 100.0,
    "distance_m": 0.5,
    "radiance_w_m2_sr_nm": 0.05,
    "wavelength_nm": (450.0, 550.0, 620.0),
}
#: AEDAT 4 file of four events of an 8 × 8 sensor, which dv-processing wrote: base 85 of the compressed bytes.
AEDAT4 = (
    "c-oayPfHs?6n{xpEsKUAIpiQ^9K}<bT_uzrl8~)N3>X78)W4S{JKCYi%rZM0(3A8lc<}3Z^rLue@eBBN-9SvXG#z-udpo~B^Jm}2"
    "y3;!TwCD7y6??^8%K?-Cpxr%aK|D+-f&t6$0W*LM#xll3?rrrs3sCb$WW-d!rKr=LicK3P!BG>^V??+^R;M!5ZE+<j@m>9+POYT2"
    "66iGCo&nmE&=~G&t;kPyQ>T47^c4#te@gU?j{<>KTwK$};d!-YMaaLBrQ+9IxPy-L!T~!%`)Q4i6ml28EB8ck&D5NN-BA0XP7`D!"
    "CUo!*nTWE-g1+LuPC3|a7-%^po~zw>g~-^hGKXs0LwkP3nVJ@DeeZos6_|J$p7xBk#iw2~#XI1)>~w6&g{F-!X=W*`v;SwwQ1xdn"
    "zMpzHD>~i8e>hQ(^P1(28YU#e#V}~6)NDQ;WBOuV;#|Op?hjxQTgAW`K?b~Jq4}}2X-4Hz%=QX!pTXs*lb#B&orMJgwCvb$mqT7A"
    "F-Z(AF#WSNHrVeuU*8!d9a)Sic_?FV8d$BtCgh9o>us-}b1SfFEWvN=)nqeeXS^wZR};_mi2"
)


class Objects:
    """Parts of a camera and files, created on first use in a directory."""

    def __init__(self, directory):
        self.directory = directory
        self.n_files = 0

    def path(self, suffix, name=None):
        """Return a new path."""
        self.n_files += 1
        return self.directory / f"{name or f'file_{self.n_files}'}{suffix}"

    def text(self, suffix, content):
        """Write a file and return its path."""
        path = self.path(suffix)
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    def written(self, suffix, write):
        """Return a new path to which a function has written."""
        path = self.path(suffix)
        write(path)
        return path

    @cached_property
    def layout(self):
        return fs.layout.mosaic(fs.layout.grid(8, 8, 3.0), ["RG", "GB"])

    @cached_property
    def plain(self):
        return fs.layout.readout_by(fs.layout.grid(8, 8, 3.0), "column")

    @cached_property
    def optics(self):
        return fs.Optics(focal_length_mm=8.0, f_number=2.8)

    @cached_property
    def psfs(self):
        spot = np.pad(np.ones((3, 3)), 4)
        return fs.optics.PSFGrid.from_arrays(spot, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=1.0)

    @cached_property
    def sensor(self):
        return fs.Sensor(
            self.layout,
            filters=fs.rgb_filters(),
            crosstalk=fs.sensor.Diffusion(spread_um=0.3),
            capacitance_f=1e-15,
            v_sat_v=0.3,
            bits=10,
        )

    @cached_property
    def camera(self):
        return fs.Camera(optics=self.optics, sensor=self.sensor)

    @cached_property
    def simple(self):
        return fs.Camera(optics=self.optics, sensor=fs.Sensor(self.plain))

    @cached_property
    def scene(self):
        return fs.Scene.flat(**SHEET)

    @cached_property
    def capture(self):
        return self.camera.capture(self.scene, exposure_s=0.01, seed=0)

    @cached_property
    def power_map(self):
        return self.camera.power_map(self.scene)

    @cached_property
    def grid(self):
        return fs.Grid.centred((48, 48), 0.5)

    @cached_property
    def picture(self):
        return self.capture.picture()

    @cached_property
    def photo_e_per_s(self):
        return self.camera.photoelectrons_per_s(self.scene)

    @cached_property
    def expected_e(self):
        return np.full(self.layout.n_sites, 500.0)

    @cached_property
    def frames(self):
        return fs.metrics.draw_frames(self.sensor, self.expected_e, n_frames=8, seed=1)

    @cached_property
    def dark(self):
        return fs.metrics.draw_frames(self.sensor, 0.0 * self.expected_e, n_frames=8, seed=2)

    @cached_property
    def sites(self):
        return self.sensor.sites

    @cached_property
    def events(self):
        rates = [self.photo_e_per_s * k for k in (1.0, 2.0, 0.5)]
        return fs.modes.EventPixels(self.sensor, noise_per_s=100.0).events(rates, frame_s=0.01, seed=0)

    @cached_property
    def lens(self):
        return fs.distortion.BrownConrady(focal_um=8000.0, k1=-0.1)

    @cached_property
    def gaze(self):
        return fs.video.GazePath([0.0, 0.1], [[0.0, 0.0], [2.0, 0.0]])

    @cached_property
    def panorama(self):
        return fs.Scene.from_panorama(np.ones((8, 16)), luminance_cd_m2=10.0)

    @cached_property
    def directions(self):
        return fs.video.DirectionPath([0.0, 0.1], [[0.0, 0.0], [20.0, 5.0]])

    @cached_property
    def report(self):
        return self.layout.check(fs.DesignRules(min_size_um=4.0))

    @cached_property
    def solids(self):
        return fs.view.solids(fs.layout.grid(2, 2, 5.0))

    @cached_property
    def photos(self):
        directory = self.directory / "photos"
        (directory / "cats").mkdir(parents=True)
        from PIL import Image

        for n in range(2):
            Image.fromarray(PICTURE).save(directory / "cats" / f"{n}.png")
        return directory

    @cached_property
    def shot_file(self):
        return self.text(".yaml", SHOT)

    @cached_property
    def shot(self):
        return fs.config.read_shot(self.shot_file)

    @cached_property
    def result(self):
        return fs.config.run_shot(self.shot, self.directory / "result")[0]

    @cached_property
    def sweep_file(self):
        return self.text(".yaml", {"shot": SHOT, "vary": VARY})

    @cached_property
    def study_file(self):
        return self.text(".yaml", {"shot": SHOT, "search": SEARCH, "objectives": GOALS, "trials": 2})

    @cached_property
    def dataset_file(self):
        return self.text(".yaml", {"shot": VARIED, "pictures": str(self.photos), "vary": DRAWS})

    @cached_property
    def dataset(self):
        return fs.explore.Dataset([PICTURE] * 2, VARIED, vary=DRAWS)

    @cached_property
    def plan(self):
        return fs.explore.plan_sweep(SHOT, VARY)

    @cached_property
    def swept(self):
        return self.written(".zarr", lambda path: explore.run_sweep(self.plan, out=path, workers=1))

    @cached_property
    def study_plan(self):
        return fs.explore.plan_study(SHOT, SEARCH, GOALS, n_trials=2)

    @cached_property
    def study(self):
        return fs.explore.run_study(self.study_plan)

    @cached_property
    def comparison(self):
        return fs.compare.cameras(
            {"a": self.simple, "b": self.simple}, {"flat": self.scene}, exposure_s=0.01, n_annuli=2, max_pixels=32
        )

    @cached_property
    def stacks(self):
        """Folder of stacks of frames."""
        folder, rng = self.path("", "frames"), np.random.default_rng(0)
        for name, signal_e in (("dark_1ms", 0.0), ("flat_1ms", 1000.0), ("flat_2ms", 2000.0), ("flat_4ms", 4000.0)):
            (folder / name).mkdir(parents=True)
            codes = rng.poisson(signal_e, (8, 24, 32)) + rng.normal(60.0, 5.0, (8, 24, 32))
            np.save(folder / name / "frames.npy", np.rint(0.5 * codes).astype(np.uint16))
        return folder

    @cached_property
    def twin(self):
        return fs.twin.fit(self.stacks, bits=12, pixel_um=3.0)

    @cached_property
    def twins(self):
        camera = fs.Camera(optics=self.optics, sensor=fs.Sensor(fs.layout.grid(n_x=30, n_y=30, pitch_um=3.0)))
        return camera.compare_with(np.full((2, 30, 30), 9), "flat_field", exposure_s=0.01)

    @cached_property
    def covariance(self):
        return fs.compare.SceneCovariance(np.ones(2), np.array([2.0, 5.0]))

    @cached_property
    def tiled(self):
        return fs.tiles.write_tiles(self.path(".zarr"), self.simple, self.scene, exposure_s=0.01, seed=0)

    @cached_property
    def recording(self):
        path = self.path(".zarr")
        fs.video.write_video([self.capture] * 2, path)
        return path

    @cached_property
    def calibration(self):
        return self.sensor.calibrate(exposure_s=0.01, flat_e=900.0, n_frames=4, seed=0)

    @cached_property
    def ramp_map(self):
        y, x = np.mgrid[:60, :60] / 10.0
        return 5.0 + np.sin(x) + np.cos(y) + 0.2 * x * y

    @cached_property
    def cortical(self):
        return self.capture.cortical(n_rings=4, n_sectors=8)


def own_layout():
    @fs.layout.layout_generator(example={"side_um": 2.0})
    def installation_generator(side_um):
        return fs.layout.grid(2, 2, side_um)

    del fs.layout.LAYOUTS._objects["installation_generator"]
    return installation_generator(side_um=3.0)


def own_edit():
    @fs.layout.layout_edit(example={})
    def installation_edit(layout):
        return layout

    del fs.layout.EDITS._objects["installation_edit"]
    return installation_edit(fs.layout.grid(2, 2, 2.0))


def with_settings_files(o):
    os.chdir(o.directory)
    assert o.photos.is_dir()
    return fs.config.Source(file=o.directory / "shot.yaml")


compare, config, distortion, explore, layout, maps, metrics, modes = (
    fs.compare, fs.config, fs.distortion, fs.explore, fs.layout, fs.maps, fs.metrics, fs.modes
)  # fmt: skip
optics, reconstruct, charts, sensor, effects, tiles, units, video, view = (
    fs.optics, fs.reconstruct, fs.scene.charts, fs.sensor, fs.sensor.effects, fs.tiles, fs.units, fs.video, fs.view
)  # fmt: skip
LENGTH = np.array([1.0, 2.0])
TRIANGLE = [[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]]
SQUARE = shapely.box(-3.0, -3.0, 3.0, 3.0)
POINT = [[0.1, 0.2]]
#: A drawing of one square in µm.
SQUARE_DXF = (
    "0 SECTION 2 HEADER 9 $ACADVER 1 AC1015 9 $INSUNITS 70 13 0 ENDSEC 0 SECTION 2 ENTITIES "
    "0 LWPOLYLINE 5 1F 100 AcDbEntity 8 0 100 AcDbPolyline 90 4 70 1 10 0 20 0 10 4 20 0 10 4 20 4 10 0 20 4 "
    "0 ENDSEC 0 EOF "
).replace(" ", "\n")
#: Bundled layout with the fewest sites.
BUNDLED = "prima_75"
#: Names relative to the package, and functions of :class:`Objects`.
CALLS = {
    "compile_kernels": lambda o: fs.compile_kernels(),
    "rgb_filters": lambda o: fs.rgb_filters(),
    "read_layout": lambda o: fs.read_layout(o.written(".npz", o.layout.write)),
    "read_layout geojson": lambda o: fs.read_layout(o.written(".geojson", o.layout.write)),
    "read_layout gds": lambda o: fs.read_layout(o.written(".gds", o.layout.write)),
    "read_layout oas": lambda o: fs.read_layout(o.written(".oas", o.layout.write)),
    "read_layout nxs": lambda o: fs.read_layout(o.written(".nxs", o.layout.write)),
    "read_layout parquet": lambda o: fs.read_layout(o.written(".parquet", o.layout.write)),
    "read_power_map": lambda o: fs.read_power_map(o.written(".npz", lambda p: fs.write_power_map(o.power_map, p))),
    "read_power_map npy": lambda o: fs.read_power_map(
        o.written(".npy", lambda p: np.save(p, np.ones((3, 4)))), pitch_um=1.0, wavelength_nm=550.0, unit="w_m2"
    ),
    **{
        f"read_power_map {kind}": lambda o, kind=kind: fs.read_power_map(
            o.written(f".{kind}", lambda p: fs.write_power_map(o.power_map, p))
        )
        for kind in ("tif", "fits", "exr", "nc", "zarr")
    },
    "write_power_map": lambda o: fs.write_power_map(o.power_map, o.path(".npz")),
    "Capture.save": lambda o: fs.Capture.load(o.written(".npz", o.capture.save)),
    "Capture.save zarr": lambda o: fs.Capture.load(o.written(".zarr", o.capture.save)),
    "Capture.to_xarray": lambda o: o.capture.to_xarray(),
    "Capture.to_pandas": lambda o: o.capture.to_pandas(),
    "Capture.to_pyvista": lambda o: o.capture.to_pyvista(),
    "Capture.plot": lambda o: o.capture.plot(),
    "Capture.signal_to_noise": lambda o: o.capture.signal_to_noise(),
    "Layout.to_pyvista": lambda o: o.layout.to_pyvista(),
    "Layout.plot": lambda o: o.layout.plot(),
    "Layout.write svg": lambda o: o.layout.write(o.path(".svg")),
    "Picture.save": lambda o: [o.picture.save(o.path(suffix)) for suffix in (".png", ".jpg", ".tif", ".webp")],
    "Picture.save 16": lambda o: o.picture.save(o.path(".png"), bits=16),
    "Picture.save exr": lambda o: o.picture.save(o.path(".exr")),
    "Scene.from_picture": lambda o: fs.Scene.from_picture(
        o.photos / "cats" / "0.png", pitch_um=100.0, distance_m=0.5, peak_radiance_w_m2_sr_nm=0.05
    ),
    "Scene.from_display": lambda o: fs.Scene.from_display(
        o.photos / "cats" / "0.png", "oled", distance_m=0.5, subpixels=True
    ).on_display(o.photos / "cats" / "1.png"),
    "Scene.from_panorama": lambda o: o.camera.projection(o.panorama.turned(yaw_deg=20.0)),
    "Scene.from_rgbd": lambda o: fs.Optics(focal_length_mm=8.0, f_number=2.8).power_map(
        fs.Scene.from_rgbd(
            np.ones((8, 8)), np.full((8, 8), 1.0), pitch_um=100.0, distance_m=0.5, peak_radiance_w_m2_sr_nm=0.05
        )
    ),
    "Camera.video": lambda o: list(o.camera.video([o.scene] * 2, exposure_s=0.01, seed=0)),
    "Camera.noise_budget": lambda o: o.camera.noise_budget(o.scene, exposure_s=0.01).plot(),
    "Camera.compare_with": lambda o: o.twins,
    "Camera.predict": lambda o: o.camera.predict(o.scene, exposure_s=0.01),
    "compare.budget_of": lambda o: compare.budget_of(o.camera, 30.0),
    "compare.cameras": lambda o: o.comparison.summary("psnr_db"),
    "compare.Comparison.to_xarray": lambda o: o.comparison.to_xarray(),
    "compare.Comparison.write": lambda o: o.comparison.write(o.path(".html")),
    "compare.Comparison.plot": lambda o: o.comparison.plot(),
    "compare.default_sensor": lambda o: compare.default_sensor(o.plain),
    "compare.gaussian_information_bits": lambda o: compare.gaussian_information_bits(np.eye(3), np.ones(3)),
    "compare.median_interval": lambda o: compare.median_interval(np.arange(5.0)),
    "compare.layouts": lambda o: compare.layouts(
        {"a": o.plain, "b": o.plain}, {"flat": o.scene}, optics=o.optics, exposure_s=0.01, n_annuli=2, max_pixels=32
    ),
    "compare.photograph_scenes": lambda o: compare.photograph_scenes(20.0, pictures=[o.photos / "cats" / "1.png"]),
    "compare.quality_by_eccentricity": lambda o: compare.quality_by_eccentricity(
        o.picture, o.picture, edges_um=np.array([0.0, 10.0]), data_range=1.0
    ),
    "compare.scene_covariance": lambda o: compare.scene_covariance(
        10.0 + np.random.default_rng(0).normal(size=(4, 32, 32)), 2.0
    ),
    "compare.site_information_bits": lambda o: compare.site_information_bits(
        o.plain, o.covariance, o.plain.area_um2, np.ones((1, o.plain.n_sites)), n_conditions=4
    ),
    "config.plain_settings": lambda o: config.plain_settings(None, {"optics": {"f_number": 2}}),
    "config.build_shot": lambda o: config.build_shot("shot", SHOT),
    "config.bundled_layouts": lambda o: [fs.read_layout(path) for path in config.bundled_layouts().values()],
    "config.check_directory": lambda o: config.check_directory(o.directory / "new"),
    "config.check_settings": lambda o: config.check_settings(None, SHOT),
    "config.compare_files": lambda o: config.compare_files(
        [o.shot_file, o.shot_file], pictures=[o.photos / "cats" / "1.png"], n_annuli=2, max_pixels=32
    ),
    "config.demo_settings": lambda o: config.demo_settings(),
    "config.picture_path": lambda o: config.picture_path(with_settings_files(o), "photos/cats/1.png", "scene.picture"),
    "config.get_setting": lambda o: config.get_setting(SHOT, "sensor.bits"),
    "config.put_setting": lambda o: config.put_setting(None, json.loads(json.dumps(SHOT)), "sensor.bits", 10),
    "config.read_any_layout": lambda o: config.read_any_layout(BUNDLED),
    "config.read_layout_file": lambda o: config.read_layout_file(config.bundled_layouts()[BUNDLED]),
    "config.read_rules": lambda o: config.read_rules("sky130_met1"),
    "config.read_settings": lambda o: config.read_settings(o.shot_file),
    "config.read_shot": lambda o: config.read_shot(o.shot_file),
    "config.read_viewable": lambda o: config.read_viewable(o.written(".npz", o.capture.save)),
    "config.resolve_files": lambda o: config.resolve_files(o.directory, {"picture": "a.png"}),
    "config.results_table": lambda o: config.results_table([o.result]),
    "config.run_shot": lambda o: config.run_shot(o.shot, o.directory / "run"),
    "config.run_video": lambda o: [
        config.run_video(
            config.build_shot(with_settings_files(o), PHOTOGRAPHED), o.photos / "cats", o.path(suffix), frame_s=0.1
        )
        for suffix in (".gif", "")
    ],
    "config.run_video zarr": lambda o: config.run_video(
        config.build_shot(with_settings_files(o), PHOTOGRAPHED), o.photos / "cats", o.path(".zarr")
    ),
    "config.schema": lambda o: config.schema(),
    "config.starting_command": lambda o: config.starting_command("sweep", "sweep.yaml"),
    "config.starting_file": lambda o: config.starting_file("sweep"),
    "config.to_python": lambda o: config.to_python(SHOT),
    "config.validate": lambda o: config.validate(None, fs.DesignRules, {"min_size_um": 1.0}),
    "config.write_3d_picture": lambda o: config.write_3d_picture(o.result, o.directory),
    "config.write_results": lambda o: config.write_results(o.shot, o.result.capture, o.directory / "results"),
    "config.write_sensor_files": lambda o: config.write_sensor_files(
        {"pixel_um": "3.45", "bits": 12, "qe_percent": 64, "dark_noise_e": "2.1", "saturation_e": 10_400},
        o.path(".yaml"),
    ),
    "config.write_starting_file": lambda o: config.write_starting_file("study", o.path(".yaml")),
    "distortion.distort_map": lambda o: distortion.distort_map(o.power_map, o.lens),
    "distortion.from_opencv": lambda o: distortion.from_opencv(
        [[800.0, 0.0, 31.5], [0.0, 800.0, 31.5], [0.0, 0.0, 1.0]],
        [-0.1, 0.0, 0.0, 0.0],
        image_size=(64, 64),
        pixel_um=10.0,
    ),
    "distortion.read_calibration": lambda o: distortion.read_calibration(
        o.text(
            ".yaml",
            "image_width: 64\nimage_height: 64\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [800.0, 0.0, 31.5, 0.0, 800.0, 31.5, 0.0, 0.0, 1.0]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.1, 0.0, 0.0, 0.0, 0.0]\n",
        ),
        pixel_um=10.0,
    ),
    "distortion.to_opencv": lambda o: distortion.to_opencv(o.lens, image_size=(64, 64), pixel_um=10.0),
    "explore.check_requirements": lambda o: explore.check_requirements(o.shot, o.result.capture),
    "explore.result_of": lambda o: explore.result_of(LIMIT, o.shot, o.result.capture),
    "explore.solve": lambda o: explore.solve(SHOT, "exposure_s", LIMIT, bounds=(1e-6, 1.0)),
    "explore.best_table": lambda o: explore.best_table(o.study_plan, o.study),
    "explore.classification": lambda o: explore.classification([PICTURE], VARIED, labels=["cat"])[0],
    "explore.denoising": lambda o: explore.denoising([PICTURE], VARIED)[0],
    "explore.Dataset": lambda o: o.dataset[1],
    "explore.Dataset.capture": lambda o: o.dataset.capture(1).code,
    "explore.finished_trials": lambda o: explore.finished_trials(o.study),
    "explore.import_metric": lambda o: explore.import_metric("os.path:getsize"),
    "explore.open_dataset": lambda o: explore.open_dataset(
        o.written("", lambda p: explore.write_dataset(o.dataset, p))
    )[1],
    "explore.open_results": lambda o: explore.open_results(o.swept),
    "explore.parse_distribution": lambda o: explore.parse_distribution("optics.f_number", {"uniform": [2.0, 4.0]}),
    "explore.plan_study": lambda o: explore.plan_study(SHOT, SEARCH, GOALS, n_trials=2),
    "explore.plan_sweep": lambda o: explore.plan_sweep(SHOT, VARY),
    "explore.read_dataset": lambda o: explore.read_dataset(o.dataset_file),
    "explore.read_study": lambda o: explore.read_study(o.study_file),
    "explore.read_sweep": lambda o: explore.read_sweep(o.sweep_file),
    "explore.run_study": lambda o: explore.run_study(o.study_plan, storage=o.path(".db")),
    "explore.run_study workers": lambda o: explore.run_study(o.study_plan, workers=1),
    "explore.run_sweep": lambda o: explore.run_sweep(o.plan, workers=1),
    "explore.schema_of": lambda o: [explore.schema_of(kind) for kind in ("shot", "sweep", "study", "dataset")],
    "explore.storage_name": lambda o: explore.storage_name("study.db"),
    "explore.study": lambda o: explore.study(SHOT, SEARCH, GOALS, n_trials=2),
    "explore.sweep": lambda o: explore.sweep(SHOT, VARY, workers=1),
    "explore.sweep metric": lambda o: explore.sweep(SHOT, VARY, workers=1, metrics={"own": lambda *_: len(VARY)}),
    "explore.torch_dataset": lambda o: explore.torch_dataset(o.dataset)[0],
    "explore.trials_table": lambda o: explore.trials_table(o.study),
    "explore.write_dataset": lambda o: explore.write_dataset(o.dataset, o.path("")),
    "explore.write_dataset zarr": lambda o: explore.write_dataset(o.dataset, o.path(".zarr")),
    "explore.write_dataset workers": lambda o: explore.write_dataset(o.dataset, o.path(""), workers=1),
    "layout.adjacency": lambda o: layout.adjacency(o.layout),
    "layout.clip": lambda o: layout.clip(o.layout, SQUARE),
    "layout.clean": lambda o: layout.clean(o.plain, 0.01),
    "layout.cleaned": lambda o: layout.cleaned(o.plain, tolerance_um=0.01),
    "layout.cut_along": lambda o: layout.cut_along(o.layout, [[-30.0, 0.5], [30.0, 0.5]]),
    "layout.cut_out": lambda o: layout.cut_out(o.layout, SQUARE),
    "layout.describe": lambda o: layout.describe(o.layout),
    "layout.draw": lambda o: layout.draw(o.plain, [TRIANGLE], overlap="cut"),
    "layout.enforce": lambda o: layout.enforce(o.layout, fs.DesignRules(min_size_um=1.0)),
    "layout.fill": lambda o: layout.fill(layout.cut_out(o.plain, SQUARE), SQUARE, size_um=1.0),
    "layout.foveal_cartesian": lambda o: layout.foveal_cartesian(n_rings=6, ring_ratio=1.3, pitch_um=2.0, n_fovea=3),
    "layout.fovi": lambda o: layout.fovi(fov_um=100.0, a_um=10.0, n_rings=8),
    "layout.from_sizes": lambda o: layout.from_sizes("grid", n_sites=35, min_size_um=2.0),
    "layout.giotto": lambda o: layout.giotto(n_rho=5, n_theta=16, n_fovea=4, n_across=30, unit_um=2.0),
    "layout.giotto_ratio": lambda o: layout.giotto_ratio(n_rho=5, n_fovea=4, n_across=30),
    "layout.graph_colouring": lambda o: layout.graph_colouring(o.plain, 4),
    "layout.grid": lambda o: layout.grid(3, 2, 2.0),
    "layout.hexagonal": lambda o: layout.hexagonal(3, 2, 2.0),
    "layout.inset": lambda o: layout.inset(o.plain, 0.1),
    "layout.layout_edit": lambda o: own_edit(),
    "layout.layout_generator": lambda o: own_layout(),
    "layout.log_polar": lambda o: layout.log_polar(n_sectors=16, r_max_um=50.0, min_size_um=2.0),
    "layout.merge": lambda o: layout.merge(o.plain, np.arange(64) // 8),
    "layout.merge_at": lambda o: layout.merge_at(o.plain, [[-1.0, 0.5], [1.0, 0.5]]),
    "layout.merge_small": lambda o: layout.merge_small(o.plain, min_size_um=4.0),
    "layout.min_width_um": lambda o: layout.min_width_um(o.plain),
    "layout.mosaic": lambda o: layout.mosaic(o.plain, ["RG", "GB"]),
    "layout.move_sites": lambda o: layout.move_sites(layout.inset(o.plain, 0.5), [[1.5, 1.5]], [0.1, 0.0]),
    "layout.move_vertices": lambda o: layout.move_vertices(o.plain, [[0.0, 0.0]], [[0.1, 0.1]]),
    "layout.nearest_bus": lambda o: layout.nearest_bus(o.plain, [shapely.LineString([(-12.0, 0.0), (12.0, 0.0)])]),
    "layout.node": lambda o: layout.node(o.plain),
    "layout.octagonal": lambda o: layout.octagonal(4, 4, 4.0),
    "layout.overlay": lambda o: layout.overlay(o.plain, layout.grid(4, 4, 2.0)),
    "layout.penrose": lambda o: layout.penrose(side_um=3.0, size_um=20.0),
    "layout.quadtree": lambda o: layout.quadtree(PICTURE[:32, :32, 0] / 255.0, pitch_um=1.0, n_levels=3, limit=0.5),
    "layout.random_channels": lambda o: layout.random_channels(o.plain, [0.5, 0.5], seed=0),
    "layout.read_layer_map": lambda o: layout.read_layer_map(o.text(".yaml", "photosite: 10/0\nwell: 20/0\n")),
    "layout.read_layout": lambda o: layout.read_layout(o.written(".npz", o.layout.write)),
    "layout.read_layout dxf": lambda o: layout.read_layout(o.text(".dxf", SQUARE_DXF)),
    "layout.readout_by": lambda o: layout.readout_by(layout.grid(3, 3, 2.0), "row"),
    "layout.readout_order": lambda o: layout.readout_order(o.plain),
    "layout.remove_at": lambda o: layout.remove_at(o.plain, POINT),
    "layout.remove_vertices": lambda o: layout.remove_vertices(
        layout.move_vertices(o.plain, [[0.0, 1.5]], [[0.1, 1.5]]), [[0.1, 1.5]]
    ),
    "layout.repair": lambda o: layout.repair(o.plain, rules=fs.DesignRules(min_size_um=1.0)),
    "layout.set_channel": lambda o: layout.set_channel(o.plain, POINT, 1),
    "layout.sites_at": lambda o: layout.sites_at(o.plain, POINT),
    "layout.snap": lambda o: layout.snap(o.plain, 0.5),
    "layout.split": lambda o: layout.split(o.plain, n_x=2, n_y=2),
    "layout.split_at": lambda o: layout.split_at(o.plain, POINT, n_x=2, n_y=2),
    "layout.square_ring_ratio": lambda o: layout.square_ring_ratio(64),
    "layout.sunflower": lambda o: layout.sunflower(50, 2.0),
    "layout.tiling": lambda o: layout.tiling(2.0, size_um=(10.0, 10.0)),
    "layout.track_demand": lambda o: layout.track_demand(o.plain, layout.Routing(width_um=0.1, space_um=0.1)),
    "layout.to_graph": lambda o: layout.to_graph(o.layout),
    "layout.union": lambda o: layout.union([o.plain, o.plain.translate(50.0, 0.0)]),
    "layout.voronoi": lambda o: layout.voronoi(30, size_um=(20.0, 20.0), seed=0),
    "layout.voronoi_of": lambda o: layout.voronoi_of([(-3.0, 0.0), (1.0, 0.0)], size_um=(20.0, 20.0)),
    "layout.write_layout": lambda o: layout.write_layout(o.layout, o.path(".npz")),
    "layout.write_layout gds": lambda o: layout.write_layout(o.layout, o.path(".gds")),
    "layout.write_layout parquet": lambda o: layout.write_layout(o.layout, o.path(".parquet")),
    "layout.Report.write": lambda o: o.report.write(o.path(".lyrdb")),
    "layout.Report.plot": lambda o: o.report.plot(),
    "layout.zones": lambda o: layout.zones(pitch_um=[1.0, 2.0], side_um=[4.0, 8.0]),
    "maps.from_xarray": lambda o: maps.from_xarray(maps.to_xarray(o.power_map)),
    "maps.to_xarray": lambda o: maps.to_xarray(o.power_map),
    "metrics.aliasing_spectrum": lambda o: metrics.aliasing_spectrum(o.plain, (70.0, 40.0)).plot(),
    "metrics.draw_frames": lambda o: metrics.draw_frames(o.sensor, o.expected_e, n_frames=2, seed=0),
    "metrics.emva1288": lambda o: metrics.emva1288(
        [metrics.draw_frames(o.sensor, 0.4 * k * o.expected_e, n_frames=8, seed=k) for k in range(1, 13)],
        [o.dark],
        1000.0 * np.arange(1, 13),
    ),
    "metrics.estimate_flow": lambda o: metrics.estimate_flow(
        o.plain,
        fs.Integrator(o.plain, fs.Grid.centred((60, 60), 0.5))(o.ramp_map),
        o.ramp_map,
        fs.Grid.centred((60, 60), 0.5),
        variance_e2=1.0,
    ),
    "metrics.metric_info": lambda o: metrics.metric_info("snr_db").title,
    "metrics.flow_bound": lambda o: metrics.flow_bound(np.random.default_rng(0).normal(size=(64, 2)), 1.0),
    "metrics.measured_snr_by_class": lambda o: metrics.measured_snr_by_class(o.layout, o.frames, o.dark, bits=8),
    "metrics.neighbour_spacing_um": lambda o: metrics.neighbour_spacing_um(o.plain),
    "metrics.nyquist_per_mm": lambda o: metrics.nyquist_per_mm(o.plain),
    "metrics.nyquist_vs_eccentricity": lambda o: metrics.nyquist_vs_eccentricity(o.plain, n_bins=2),
    "metrics.photon_transfer": lambda o: metrics.photon_transfer(o.sensor, [o.expected_e], n_frames=4, seed=0).plot(),
    "metrics.polygon_mtf": lambda o: metrics.polygon_mtf(o.plain, [50.0]),
    "metrics.polygon_otf": lambda o: metrics.polygon_otf(o.plain, [[50.0, 0.0]]),
    "metrics.predicted_photon_transfer": lambda o: metrics.predicted_photon_transfer(o.sensor, [o.expected_e]),
    "metrics.psnr_db": lambda o: metrics.psnr_db(PICTURE[..., 0] / 255.0, PICTURE[..., 1] / 255.0),
    "metrics.relative_exposure_at_snr_fraction": lambda o: metrics.relative_exposure_at_snr_fraction(
        o.simple, o.scene, exposure_s=0.01
    ),
    "metrics.sampling_spectrum": lambda o: metrics.sampling_spectrum(o.plain).plot(),
    "metrics.site_gradients_e_per_um": lambda o: metrics.site_gradients_e_per_um(
        o.plain, o.ramp_map, fs.Grid.centred((60, 60), 0.5)
    ),
    "metrics.size_classes_um": lambda o: metrics.size_classes_um(o.plain),
    "metrics.slanted_edge_mtf": lambda o: metrics.slanted_edge_mtf(
        layout.grid(40, 40, 1.0), (layout.grid(40, 40, 1.0).centroid_um @ [1.0, 0.1] > 0.0).astype(float)
    ),
    "metrics.snr_by_class": lambda o: metrics.snr_by_class(o.simple, o.scene, exposure_s=0.01).plot(),
    "metrics.ssim": lambda o: metrics.ssim(PICTURE[..., 0] / 255.0, PICTURE[..., 1] / 255.0, data_range=1.0),
    "metrics.wave_vectors_per_mm": lambda o: metrics.wave_vectors_per_mm([1.0, 2.0]),
    "modes.event_probability": lambda o: modes.event_probability([0.1, 0.2], 0.2, contrast_noise=0.02),
    "modes.write_events": lambda o: modes.write_events([o.events], o.path(".h5")),
    "modes.Events.read": lambda o: modes.Events.read(o.written(".txt", o.events.save), o.events.layout),
    "modes.Events.read aedat": lambda o: modes.Events.read(
        o.written(".aedat4", lambda path: path.write_bytes(zlib.decompress(base64.b85decode(AEDAT4)))), o.events.layout
    ),
    "modes.Events.save": lambda o: modes.Events.load(o.written(".npz", o.events.save)),
    "modes.Events.save h5": lambda o: modes.Events.load(o.written(".h5", o.events.save)),
    "optics.circular_otf": lambda o: optics.circular_otf([0.0, 0.5]),
    "optics.noll_to_nm": lambda o: optics.noll_to_nm(4),
    "optics.osa_to_nm": lambda o: optics.osa_to_nm(4),
    "optics.read_psfs": lambda o: optics.read_psfs(o.written(".npz", o.psfs.write)),
    "optics.read_psfs fits": lambda o: optics.read_psfs(o.written(".fits", o.psfs.write)),
    "optics.zernike": lambda o: optics.zernike(2, 0, [0.1], [0.2]),
    "optics.PupilImage": lambda o: optics.PupilImage(np.ones((16, 16))),
    "reconstruct.blur_kernel": lambda o: reconstruct.blur_kernel(o.optics, o.grid, wavelength_nm=550.0),
    "reconstruct.cells": lambda o: reconstruct.cells(o.layout, o.expected_e, o.grid),
    "reconstruct.cortical": lambda o: reconstruct.cortical(
        layout.log_polar(n_sectors=16, r_max_um=50.0, min_size_um=2.0),
        np.ones(layout.log_polar(n_sectors=16, r_max_um=50.0, min_size_um=2.0).n_sites),
    ).plot(),
    "reconstruct.electrons_per_code": lambda o: reconstruct.electrons_per_code(o.sensor),
    "reconstruct.estimate_from_charge": lambda o: reconstruct.estimate_from_charge(o.expected_e, o.sensor, 0.01),
    "reconstruct.estimate_from_code": lambda o: reconstruct.estimate_from_code(o.capture.code, o.sensor, 0.01),
    "reconstruct.fill_channels": lambda o: reconstruct.fill_channels(o.layout, o.expected_e, o.layout.channel, 3),
    "reconstruct.from_cortical": lambda o: reconstruct.from_cortical(o.cortical, o.grid),
    "reconstruct.least_squares": lambda o: reconstruct.least_squares(o.layout, o.expected_e, o.grid, mu=0.1),
    "reconstruct.linear": lambda o: reconstruct.linear(o.layout, o.expected_e, o.grid),
    "reconstruct.natural": lambda o: reconstruct.natural(o.layout, o.expected_e, o.grid),
    "reconstruct.raster_grid": lambda o: reconstruct.raster_grid(o.layout, 32),
    "reconstruct.reference": lambda o: reconstruct.reference(o.power_map, o.grid),
    "reconstruct.unwrap": lambda o: reconstruct.unwrap(o.picture, o.lens, max_pixels=32),
    "reconstruct.to_cortical": lambda o: reconstruct.to_cortical(o.picture, n_rings=4, n_sectors=8, r_max_um=10.0),
    "scene.charts.bar_elements": lambda o: charts.bar_elements((0,)),
    "scene.charts.bars": lambda o: charts.bars(groups=(3,), **SHEET),
    "scene.charts.checkerboard": lambda o: charts.checkerboard(square_mm=1.0, n_squares=(4, 4), **SHEET),
    "scene.charts.colour_chart": lambda o: charts.colour_chart(patch_mm=0.5, gap_mm=0.1, **SHEET),
    "scene.charts.grey_scale": lambda o: charts.grey_scale(n_steps=4, patch_mm=1.0, **SHEET),
    "scene.charts.illuminant": lambda o: charts.illuminant("D65", [550.0]),
    "scene.charts.letter_f": lambda o: charts.letter_f(height_mm=3.0, **SHEET),
    "scene.charts.photopic": lambda o: charts.photopic([550.0]),
    "scene.charts.patch_reflectance": lambda o: charts.patch_reflectance([550.0]),
    "scene.charts.point_grid": lambda o: charts.point_grid(
        spacing_mm=1.0,
        n_points=(3, 3),
        intensity_w_sr_nm=1e-6,
        **{key: value for key, value in SHEET.items() if key != "radiance_w_m2_sr_nm"},
    ),
    "scene.charts.siemens_star": lambda o: charts.siemens_star(**SHEET),
    "scene.charts.sine": lambda o: charts.sine(line_pairs_per_mm=0.5, **SHEET),
    "scene.charts.slanted_edge": lambda o: charts.slanted_edge(**SHEET),
    "scene.charts.zone_plate": lambda o: charts.zone_plate(line_pairs_per_mm=1.0, **SHEET).plot(),
    "scene.displays.lcd": lambda o: fs.scene.displays.lcd(),
    "scene.displays.oled": lambda o: fs.scene.displays.oled(white_cd_m2=300.0),
    "scene.Display.from_csv": lambda o: fs.scene.Display.from_csv(
        o.text(".csv", "wavelength_nm,red,green,blue\n450,0,0,1\n550,0,1,0\n650,1,0,0\n"), pitch_um=250.0
    ),
    "sensor.calibrate": lambda o: sensor.calibrate(o.sensor, exposure_s=0.01, flat_e=900.0, n_frames=4, seed=0),
    "sensor.camera_filters": lambda o: sensor.camera_filters(),
    "sensor.ccd_qe": lambda o: sensor.ccd_qe(),
    "sensor.draw_shot_noise": lambda o: sensor.draw_shot_noise(o.expected_e, "exact", 100.0, seed=0),
    "sensor.fit_ramp": lambda o: sensor.fit_ramp(
        sensor.non_destructive_reads(o.sensor, o.photo_e_per_s, [0.001, 0.002, 0.003], seed=0).code,
        [0.001, 0.002, 0.003],
        o.sensor,
    ),
    "sensor.linearise": lambda o: sensor.linearise(o.capture.code, o.sensor),
    "sensor.merge_exposures": lambda o: sensor.merge_exposures(np.stack([o.capture.code] * 2), [0.01, 0.01], o.sensor),
    "sensor.noise_budget": lambda o: sensor.noise_budget(o.sensor, o.photo_e_per_s, 0.01),
    "sensor.non_destructive_reads": lambda o: sensor.non_destructive_reads(
        o.sensor, o.photo_e_per_s, [0.001, 0.002], seed=0
    ),
    "sensor.read_curve": lambda o: sensor.read_curve(o.text(".csv", "nm,R\n400,0.1\n700,0.2\n")),
    "sensor.read_datasheet": lambda o: sensor.read_datasheet(
        o.text(".yaml", "{pixel_um: 3, bits: 12, qe_percent: 60, dark_noise_e: 2, saturation_e: 9000}")
    ),
    "sensor.read_filters": lambda o: sensor.read_filters(o.text(".csv", "nm,R,G\n400,0.1,0.2\n700,0.2,0.3\n")),
    "sensor.rgb_filters": lambda o: sensor.rgb_filters(),
    "sensor.signal_to_noise": lambda o: sensor.signal_to_noise(o.sensor, o.expected_e, 0.0 * o.expected_e),
    "sensor.effects.dark_current_factor": lambda o: effects.dark_current_factor(310.0, 300.0, doubling_k=8.0),
    "sensor.effects.draw_shot_noise": lambda o: effects.draw_shot_noise(o.expected_e, "exact", 100.0, seed=0),
    "studio.run_studio": lambda o: fs.studio.run_studio(o.shot_file, open_browser=False, announce=interrupt),
    "testing.check_all": lambda o: fs.testing.check_all("curve"),
    "testing.check_extension": lambda o: fs.testing.check_extension("metric", "snr"),
    "testing.check_sensor_effect": lambda o: fs.testing.check_sensor_effect("read", {"read_noise_e": 5.0}),
    "testing.extensions": lambda o: list(fs.testing.extensions()),
    "tiles.capture_tiles": lambda o: list(tiles.capture_tiles(o.simple, o.scene, exposure_s=0.01, seed=0)),
    "tiles.read_tiles": lambda o: tiles.read_tiles(o.tiled.path).picture(),
    "tiles.write_tiles": lambda o: tiles.write_tiles(o.path(".zarr"), o.simple, o.scene, exposure_s=0.01, seed=0),
    "twin.fit": lambda o: o.twin.estimates,
    "twin.read_stacks": lambda o: [list(each) for each in fs.twin.read_stacks(o.stacks)],
    "twin.read_twin": lambda o: (o.twin.save(path := o.path(".npz")), fs.twin.read_twin(path)),
    "twin.Twin.plot": lambda o: o.twin.plot(),
    "twin.Twin.sensor": lambda o: o.twin.sensor(),
    "twin.Twin.write": lambda o: (o.twin.write(o.path(".html")), o.twin.write_figures(o.directory)),
    "twin.compare_with": lambda o: o.twins.plot(),
    "twin.PictureComparison.to_pandas": lambda o: o.twins.to_pandas(),
    "twin.fit_event_pixels": lambda o: fs.twin.fit_event_pixels(
        fs.twin.StepResponses([0.1, 0.2, 0.3], [99] * 3, [2, 55, 98]), contrast_noise=0.0
    ).plot(),
    "twin.EventPixelFit.pixels": lambda o: fs.twin.fit_event_pixels(
        static=[fs.twin.StaticRecording(np.full(9, 9), np.full(9, 2), bin_s=9.0)]
    ).pixels(o.sensor, contrast_on=0.2, contrast_off=0.2, mismatch_fraction=0.0, contrast_noise=0.0),
    "units.decode_srgb": lambda o: units.decode_srgb(0.5),
    "units.electrons_to_volts": lambda o: units.electrons_to_volts(LENGTH, 1e-15),
    "units.encode_srgb": lambda o: units.encode_srgb(0.5),
    "units.m_from_mm": lambda o: units.m_from_mm(LENGTH),
    "units.m_from_nm": lambda o: units.m_from_nm(LENGTH),
    "units.m_from_um": lambda o: units.m_from_um(LENGTH),
    "units.per_mm_from_per_um": lambda o: units.per_mm_from_per_um(LENGTH),
    "units.per_um_from_per_mm": lambda o: units.per_um_from_per_mm(LENGTH),
    "units.photon_energy_j": lambda o: units.photon_energy_j(LENGTH),
    "units.um_from_m": lambda o: units.um_from_m(LENGTH),
    "units.um_from_nm": lambda o: units.um_from_nm(LENGTH),
    "units.volts_to_electrons": lambda o: units.volts_to_electrons(LENGTH, 1e-15),
    "units.w_from_w_m2_um2": lambda o: units.w_from_w_m2_um2(LENGTH),
    "video.count_recorded_frames": lambda o: video.count_recorded_frames(o.recording),
    "video.DirectionPath": lambda o: o.directions.at(0.05),
    "video.FrameSource": lambda o: list(
        video.FrameSource(o.photos / "cats", frame_s=0.1, pitch_um=50.0, distance_m=0.5, peak_radiance_w_m2_sr_nm=0.05)
    ),
    "video.follow_gaze": lambda o: list(video.follow_gaze([o.scene] * 2, o.gaze, frame_s=0.1)),
    "video.pan_camera": lambda o: list(video.pan_camera(o.scene, o.gaze, o.optics, shape=(40, 40))),
    "video.partial_path": lambda o: video.partial_path("video.zarr"),
    "video.read_gaze_path": lambda o: video.read_gaze_path(o.written(".csv", o.gaze.write)),
    "video.read_recording": lambda o: video.read_recording(o.recording).code[0],
    "video.saccades": lambda o: video.saccades(duration_s=1.0, frame_s=0.1, size_um=(10.0, 10.0), seed=0),
    "video.shift_sensor": lambda o: list(video.shift_sensor(o.scene, o.gaze)),
    "video.turn_camera": lambda o: list(video.turn_camera(o.panorama, o.directions)),
    "video.write_video": lambda o: [
        video.write_video([o.capture] * 2, o.path(suffix), frame_s=0.1) for suffix in (".gif", "")
    ],
    "video.write_video mp4": lambda o: list(
        video.FrameSource(
            o.written(".mp4", lambda p: video.write_video([o.capture] * 2, p, frame_s=0.1)),
            pitch_um=50.0,
            distance_m=0.5,
            peak_radiance_w_m2_sr_nm=0.05,
        )
    ),
    "view.colours_of": lambda o: view.colours_of(o.layout),
    "view.find_renderer": lambda o: view.find_renderer(),
    "view.hidden_figures": lambda o: view.hidden_figures().__enter__(),
    "view.id_map": lambda o: view.id_map(o.layout, (20, 20)),
    "view.picture_colours": lambda o: view.picture_colours(o.layout, PICTURE),
    "view.plot_angular_response": lambda o: view.plot_angular_response(o.camera, o.scene),
    "view.plot_capture": lambda o: view.plot_capture(o.capture),
    "view.plot_cortical": lambda o: view.plot_cortical(o.cortical),
    "view.plot_curves": lambda o: view.plot_curves({"a": (LENGTH, LENGTH)}, "x", "y"),
    "view.plot_image": lambda o: view.plot_image(PICTURE[..., 0], (0.0, 0.0, 1.0, 1.0), "x", "y"),
    "view.plot_layout": lambda o: view.plot_layout(o.layout),
    "view.plot_noise_budget": lambda o: view.plot_noise_budget(
        dict(o.simple.noise_budget(o.scene, exposure_s=0.01)), classes=o.plain.area_um2
    ),
    "view.plot_picture": lambda o: view.plot_picture(o.picture),
    "view.plot_power_map": lambda o: view.plot_power_map(o.power_map),
    "view.plot_report": lambda o: view.plot_report(o.report),
    "view.plot_results": lambda o: view.plot_results(explore.open_results(o.swept)),
    "view.plot_scene": lambda o: view.plot_scene(o.scene),
    "view.plotter": lambda o: view.plotter(o.layout, off_screen=True),
    "view.polydata": lambda o: view.polydata(o.layout),
    "view.prisms": lambda o: view.prisms(o.layout),
    "view.prisms pyvista": lambda o: view.prisms(o.layout).to_pyvista(),
    "view.render": lambda o: view.render(o.layout, o.path(".png"), size_px=(400, 300)),
    "view.render software": lambda o: view.render(o.layout, o.path(".png"), size_px=(400, 300), renderer="software"),
    "view.save_drawing": lambda o: view.save_drawing(o.layout, o.path(".svg")),
    "view.save_figure": lambda o: view.save_figure(view.plot_layout(o.layout).figure, o.path(".png")),
    "view.show": lambda o: view.show(o.layout, size_px=(400, 300)),
    "view.show_columns": lambda o: view.show_columns(o.capture, size_px=(400, 300)),
    "view.site_at": lambda o: view.site_at(o.layout, 0.5, 0.5),
    "view.site_colours": lambda o: view.site_colours(o.layout),
    "view.site_picture": lambda o: view.site_picture(o.layout, view.colours_of(o.layout), (20, 20)),
    "view.sites_in_view": lambda o: view.sites_in_view(o.layout, size_px=(400, 300)),
    "view.solid_page": lambda o: view.solid_page(o.capture),
    "view.solids": lambda o: o.solids.check(),
    **{
        f"view.Solids.write {kind}": lambda o, kind=kind: o.solids.write(o.path(f".{kind}"))
        for kind in ("stl", "ply", "glb", "3mf")
    },
    "view.Solids.to_pyvista": lambda o: o.solids.to_pyvista(),
    "view.stack": lambda o: view.stack(o.layout),
    "view.to_html": lambda o: [view.to_html(item) for item in (o.layout, o.capture, o.sensor, o.report)],
    "view.to_png": lambda o: view.to_png(o.picture),
    "view.web_page": lambda o: view.web_page(o.capture),
    "view.widget": lambda o: view.widget(o.capture),
    "view.write_meshes": lambda o: view.write_meshes([view.prisms(o.layout)], o.path(".stl")),
    "view.write_solid_page": lambda o: view.write_solid_page(o.layout, o.path(".html")),
    "view.write_web_page": lambda o: view.write_web_page(o.layout, o.path(".html")),
}
for _name in fs.learn.__all__:
    CALLS[f"learn.{_name}"] = lambda o, name=_name: getattr(fs.learn, name)


def interrupt(*_):
    """Interrupt this program soon, as Ctrl-C does: the studio serves until then."""
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()


#: Commands of the program: arguments as functions of :class:`Objects`.
COMMANDS = {
    "demo": lambda o: ["--out", o.path("")],
    "run": lambda o: [o.shot_file, "--out", o.path("")],
    "check": lambda o: [o.written(".npz", o.layout.write), "--rules", "sky130_met1"],
    "check --report": lambda o: [
        o.written(".npz", o.layout.write),
        "--rules",
        "sky130_met1",
        "--report",
        o.path(".lyrdb"),
    ],
    "compile": lambda o: [],
    "layouts": lambda o: [],
    "describe": lambda o: [BUNDLED, "--fps", "30"],
    "events": lambda o: [o.written(".npz", o.events.save), "--out", o.path(".npy")],
    "convert": lambda o: [o.written(".npz", o.layout.write), o.path(".geojson")],
    "convert gds": lambda o: [o.written(".npz", o.layout.write), o.path(".gds")],
    "view": lambda o: [BUNDLED, "--out", o.path(".html")],
    "view --solid": lambda o: [o.written(".npz", o.layout.write), "--solid", "--out", o.path(".html")],
    "studio": lambda o: [o.shot_file, "--no-browser"],
    "compare": lambda o: [
        o.shot_file,
        o.shot_file,
        "--picture",
        o.photos / "cats" / "1.png",
        "--pixels",
        "32",
        "--annuli",
        "2",
        "--out",
        o.path(".html"),
    ],
    "sweep": lambda o: [o.sweep_file, "--workers", "1", "--out", o.path(".zarr")],
    "plot": lambda o: [o.swept],
    "study": lambda o: [o.study_file, "--out", o.path(".db")],
    "study --workers": lambda o: [o.study_file, "--workers", "1", "--out", o.path(".db")],
    "dataset": lambda o: [o.dataset_file, "--out", o.path("")],
    "dataset zarr": lambda o: [o.dataset_file, "--out", o.path(".zarr")],
    "video": lambda o: [
        o.text(".yaml", PHOTOGRAPHED),
        "--frames",
        o.photos / "cats",
        "--out",
        o.path(".gif"),
        "--fps",
        "10",
    ],
    "video zarr": lambda o: [o.text(".yaml", PHOTOGRAPHED), "--frames", o.photos / "cats", "--out", o.path(".zarr")],
    "twin": lambda o: [o.stacks, "--bits", "12", "--pixel-um", "3", "--out", o.path("")],
    "schema": lambda o: ["sweep"],
    "new": lambda o: ["study", "--out", o.path(".yaml")],
}


class Output(io.StringIO):
    """Standard output of a command; the studio is interrupted when it announces its address."""

    def write(self, text):
        if text.startswith("studio at"):
            interrupt()
        return super().write(text)


def run_command(name, arguments, program):
    """Run a command and return its outcome."""
    if program:
        with subprocess.Popen(
            [program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            if name == "studio" and process.stdout.readline():
                process.send_signal(signal.SIGINT)
            message, code = process.communicate()[1], process.returncode
    else:
        from foveasim.cli import main as run_main

        err = io.StringIO()
        sys.argv = ["foveasim", *arguments]
        try:
            with redirect_stdout(Output()), redirect_stderr(err):
                run_main()
            code = 0
        except SystemExit as ended:
            code = ended.code or 0
        message = err.getvalue()
    is_expected = code == 0 or (code == 1 and name.startswith("check"))  # the layout violates the rules
    return "ok" if is_expected else message.strip().removeprefix("error: ") or f"exit code {code}"


def outcome(name, objects, program=None):
    """Return "ok", the message of an error of the package, or a traceback."""
    try:
        if name.startswith("foveasim "):
            command = name.removeprefix("foveasim ")
            return run_command(command, [command.split()[0], *map(str, COMMANDS[command](objects))], program)
        CALLS[name](objects)
    except KeyboardInterrupt:
        return "ok"
    except fs.FoveasimError as error:
        return str(error)
    except ImportError as error:
        return str(error) if str(error).startswith("foveasim.") else traceback.format_exc()
    except Exception:  # noqa: BLE001 -- reported
        return traceback.format_exc()
    return "ok"


def required_extra(text):
    """
    Return the extra that the message of a call names, ``""`` for a call that works.

    Raises
    ------
    ValueError
        For any other outcome.
    """
    if text == "ok" or text.startswith(MACHINE):
        return ""
    hint = HINT.fullmatch(text)
    if hint is None:
        raise ValueError(text)
    return hint[1]


def failures(outcomes):
    """Return the outcomes of calls that neither work nor name an extra."""
    found = {}
    for name, text in outcomes.items():
        try:
            required_extra(text)
        except ValueError:
            found[name] = text
    return found


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--report", type=Path)
    parser.add_argument("--program", type=Path, help="command of the package, such as env/bin/foveasim")
    options = parser.parse_args()
    names = options.names or (*CALLS, *(f"foveasim {name}" for name in COMMANDS))
    report, program = (path and str(path.absolute()) for path in (options.report, options.program))
    warnings.simplefilter("ignore")
    # With PYTHONWARNDEFAULTENCODING, the package must not depend on the encoding of the locale.
    warnings.filterwarnings("error", category=EncodingWarning, module="foveasim")
    with tempfile.TemporaryDirectory(prefix="foveasim-") as directory:
        objects = Objects(Path(directory).resolve())
        outcomes = {}
        for name in names:
            os.chdir(directory)
            outcomes[name] = outcome(name, objects, program)
        os.chdir("/")
    if report:
        Path(report).write_text(json.dumps(outcomes, indent=1))
    failed = failures(outcomes)
    for name, text in failed.items():
        sys.stdout.write(f"{name}: {text}\n")
    n_extras = sum(text != "ok" for text in outcomes.values()) - len(failed)
    sys.stdout.write(
        f"{Path(fs.__file__).parent}: {len(outcomes)} calls, {n_extras} require an extra, {len(failed)} failed\n"
    )
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
