"""Objects of all public classes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import foveasim as fs
from foveasim import (
    compare,
    config,
    distortion,
    explore,
    layout,
    metrics,
    modes,
    optics,
    reconstruct,
    sensor,
    tiles,
    twin,
    video,
    view,
)
from foveasim.layout import drc
from foveasim.maps import Found
from foveasim.scene.charts import BarElement
from foveasim.sensor import effects

MANY = np.linspace(0.0, 1.0, 1000)
TABLE = tuple(np.linspace(400.0, 700.0, 200))
SITES = fs.layout.grid(40, 30, 2.0)
STACK = twin.Stack(np.ones((4, 32, 32), np.uint16), exposure_s=0.01, light=0, name="dark")
TWIN = twin.Twin(
    dict.fromkeys(("gain_dn_per_e", "black_level_dn", "read_noise_e"), twin.Estimate(1.0, 0.5, 2.0)), {"qe": "no photons"},
    dict.fromkeys(("offset_e", "response_fraction"), np.ones((32, 32))), (), ("a constant lamp",), 3.0, {"bits": 12}, 3,
)  # fmt: skip
STATIC = twin.StaticRecording(np.full((4, 60), 9), np.full((4, 60), 2), bin_s=10.0)
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.8)
OPTICS_OVER_FIELD = fs.Optics(
    focal_length_mm=8.0, f_number=8.0, seidel=optics.Seidel(coma_um=0.5, field_radius_um=500.0), field_modes=2
)
PSFS = optics.PSFGrid(
    psf=np.pad(np.ones((3, 1, 1, 1)), ((0, 0), (0, 0), (9, 9), (9, 9))),
    x_um=np.arange(3.0),
    y_um=np.zeros(3),
    wavelength_nm=np.array([550.0]),
    pitch_um=1.0,
)
SENSOR = fs.Sensor(SITES, read_noise_e=np.full(SITES.n_sites, 2.0), capacitance_f=1e-13)
CAMERA = fs.Camera(optics=OPTICS, sensor=SENSOR)
GRID = fs.Grid((100, 200), 0.5)
SCENE = fs.Scene.flat(
    shape=(60, 80), pitch_um=100.0, distance_m=0.5, radiance_w_m2_sr_nm=0.05, wavelength_nm=(450.0, 550.0)
)
CURVE = sensor.TableCurve(wavelength_nm=TABLE, value=(0.5,) * 200)
REPORT = SITES.check(fs.DesignRules(min_size_um=3.0, max_sites=10, waivers={"max_sites": "test"}))
BY_CLASS = {"classes": np.arange(50), "n_sites": np.arange(50)}
PER_CLASS = dict.fromkeys(
    (
        "gain_dn_per_e", "responsivity_dn_per_ph", "qe", "dark_noise_dn", "dark_noise_e", "is_quantisation_limited", "saturation_ph", "threshold_ph", "linearity_error_min_fraction", "linearity_error_max_fraction", "dsnu_e", "prnu_fraction",
        "dsnu_row_e", "dsnu_column_e", "dsnu_pixel_e", "prnu_row_fraction", "prnu_column_fraction", "prnu_pixel_fraction",
        "dark_current_e_per_s", "dark_current_from_variance_e_per_s", "underflow_fraction",
    ),
    np.ones(50),
)  # fmt: skip
TRANSFER = metrics.PhotonTransfer(np.arange(50), np.arange(50), np.arange(9), *(np.ones((9, 50)),) * 3)
INTERVALS = metrics.EmvaIntervals(np.arange(50), {"qe": np.ones((50, 2)), "dsnu_e": np.zeros((50, 2))})
BOUND = metrics.FlowBound(regions=np.arange(1000), n_sites=np.arange(50), information_per_um2=np.ones((50, 2, 2)))
SPECTRUM = {"nyquist_per_mm": 250.0, "peak_per_mm": 1.0, "frequency_per_mm": MANY}


SHOT = {
    "scene": {
        "kind": "picture",
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.05,
        "wavelength_nm": [620, 550],
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "grid", "parameters": {"n_x": 40, "n_y": 40, "pitch_um": 2.0}},
    "sensor": {"capacitance_f": 1e-13},
    "exposure_s": 0.01,
}


REQUIREMENT = config.Requirement(measure="snr", at_least=1.0, annulus_um=(0.0, 50.0))
RESULT = config.RegionResult(measure="snr", annulus_um=(0.0, 50.0))


def public_objects(directory):
    """Return an object of each public class, most of them with large arrays; some are written to a directory."""
    capture = CAMERA.capture(SCENE, exposure_s=0.01, seed=0)
    dataset = explore.Dataset(list(np.zeros((2, 80, 80), np.uint8)), SHOT)
    explore.write_dataset(dataset, directory / "samples", per_shard=2)
    shot = config.Shot(name="shot", scene=SCENE, camera=CAMERA, rules=None, requested_s=0.01, seed=0)
    plan = explore.Plan(
        source=config.Source(file=Path("sweep.yaml")), written=config.Source(file=Path("sweep.yaml")), settings={"a": list(range(100))}, values={"sensor.bits": list(range(100))}, mode="zip",
        repeats=1, seed=0, metrics={}, files={},
    )  # fmt: skip
    solids = view.solids(fs.layout.grid(2, 2, 5.0), view.SensorStack())
    twins = fs.Camera(optics=OPTICS, sensor=SENSOR).compare_with(np.full((2, 30, 40), 9), "flat_field", exposure_s=0.01)
    return [
        CAMERA, capture, fs.DesignRules(preset="sky130_met1"), fs.rgb_filters() * CURVE, fs.Grid((2, 3), 0.5), SITES, OPTICS,
        fs.GaussianCurve(centre_nm=550.0, fwhm_nm=90.0), CAMERA.integrator(GRID), capture.picture(), CAMERA.power_map(SCENE),
        fs.PolynomialCurve(wavelength_nm=TABLE, value=CURVE.value), SCENE, SENSOR, fs.SiliconQE(depth_um=3.0),
        layout.Change("min_size_um", "dropped", tuple(range(1000))), layout.Stock(9, 81.0, 3.0),
        SITES.enforce(fs.DesignRules(min_size_um=0.1))[1], layout.FORMATS["npz"], layout.LayoutLayer(len), layout.OPTICAL_FORMATS["1/3"], SITES.to_graph(), layout.PRESETS["sky130_met1"], sensor.PRESETS["mobile"],
        layout.Readout(frames_per_s=30.0, bits=8), REPORT, layout.Routing(width_um=1.0, space_um=1.0), layout.RULES["min_width_um"],
        REPORT.results[0], SITES.describe(layout.Readout(frames_per_s=30.0, bits=8)), REPORT.violations[0],
        SITES.write(directory / "sites.geojson"), BarElement(group=0, element=1, direction="vertical", line_pairs_per_mm=1.0, x_mm=0.0, y_mm=0.0, side_mm=1.0),
        optics.Annulus(0.3), optics.Blades(5), optics.LateralColour(wavelength_nm=TABLE, magnification=(1.0,) * 200),
        OPTICS_OVER_FIELD.psf_modes(SCENE),
        optics.PointSpread(psf_per_um2=np.ones(GRID.shape), grid=GRID, wavelength_nm=550.0),
        optics.ChiefRayTable(image_height_um=np.arange(200.0), angle_deg=0.1 * np.arange(200.0)), OPTICS.incidence(SITES.centroid_um),
        optics.IlluminationTable(image_height_um=np.arange(200.0), fraction=np.linspace(1.0, 0.5, 200)), PSFS,
        optics.PupilImage(np.ones((64, 64))), optics.Seidel(coma_um=0.1), optics.Slit(0.1), optics.Slit(0.1).edges(), optics.Spider(3, 0.1),
        optics.Zernike(coefficients=dict.fromkeys(range(4, 30), 0.01)),
        distortion.BrownConrady(focal_um=8000.0, k1=-0.1), distortion.Fisheye(projection="equidistant", focal_um=8000.0),
        distortion.Omnidirectional(xi=1.2, focal_um=8000.0), distortion.ExtendedUnified(alpha=0.6, beta=1.1, focal_um=8000.0),
        distortion.DoubleSphere(xi=-0.2, alpha=0.6, focal_um=8000.0), distortion.FieldOfView(w_rad=0.9, focal_um=8000.0),
        distortion.PolynomialFisheye(k=(0.1, 0.0, 0.0, 0.0), focal_um=8000.0), distortion.Scaramuzza(a=(-500.0, 1e-4, 0.0, 0.0), pixel_um=2.0, focal_um=1000.0),
        Found(data=np.ones((3, 100, 100))),
        fs.scene.Cube(data=np.ones((3, 100, 100))), fs.scene.displays.lcd(),
        sensor.BandMean(curve=CURVE, band_width_nm=10.0), sensor.ConstantCurve(0.5), sensor.Diffusion(spread_um=0.5),
        sensor.InterPixelCapacitance(neighbour_fraction=0.01), sensor.KernelCrosstalk(kernel=np.full((5, 5), 0.04).tolist()),
        sensor.ApertureStack(height_um=2.0, refractive_index=1.5, photodiode=SITES), sensor.Microlens(height_um=2.0, refractive_index=1.5),
        sensor.Footprints(np.full(SITES.n_sites, 0.5), SITES), sensor.Outlines(SITES.xy_um, SITES.ring_offsets, SITES.site_offsets),
        sensor.Diffusion(spread_um=0.5).compile(SITES), sensor.LIMITS["read_noise_e"], CAMERA.noise_budget(SCENE, exposure_s=0.01),
        sensor.PassBand(from_nm=400.0), sensor.ProductCurve((CURVE, CURVE)), sensor.Ramp(MANY, np.ones((1000, 9)), np.ones((1000, 9))),
        sensor.Rates(MANY, MANY, MANY), sensor.signal_to_noise(SENSOR, np.full(SITES.n_sites, 50.0), np.zeros(SITES.n_sites)),
        SENSOR.linearise(np.full(SITES.n_sites, 50.0)), SENSOR.invert(np.full(SITES.n_sites, 50)),
        sensor.SplineCurve(wavelength_nm=TABLE, value=CURVE.value), sensor.StepCurve(edge_nm=TABLE, value=(0.5,) * 199), CURVE,
        sensor.DataSheet(pixel_um=3.45, bits=12, qe_percent=64, dark_noise_e=2.1, saturation_e=10_400),
        sensor.Calibration(**dict.fromkeys(("offset_dn", "gain", "read_noise_dn", "expected_dn"), MANY), **dict.fromkeys(("hot", "dead", "noisy", "clipped"), MANY < 0.0)),
        effects.ColumnOffset(0.1), effects.DarkOffset(2.0), effects.DarkSignal(0.1), effects.DeadSites(0.1), effects.HotSites(0.1, 10.0), effects.PhotoResponse(0.1),
        effects.PixelGain(0.1), effects.PixelOffset(0.1), effects.ReadNoise(MANY), effects.ResetNoise(300.0), effects.ShotNoise(), SENSOR.sites,
        effects.StepModel(MANY, MANY, MANY), effects.TelegraphNoise(0.1, 2.0), effects.ResponseMap(MANY), effects.OffsetMap(MANY),
        effects.TelegraphMap(MANY), effects.RowNoise(2.0), effects.ColumnNoise(2.0),
        reconstruct.SiteEstimates(light_e=MANY, variance_e2=MANY, is_saturated=MANY > 0.5),
        video.FrameSource([np.zeros((8, 8), np.uint8)] * 3, frame_s=0.1, pitch_um=50.0, distance_m=0.5, peak_radiance_w_m2_sr_nm=0.05, band_width_nm=10.0),
        video.GazePath(np.arange(100.0), np.zeros((100, 2))), video.DirectionPath(np.arange(100.0), np.zeros((100, 2))),
        video.Recording(np.zeros((9, 1200)), MANY, np.arange(9), np.zeros((9, 2)), SITES, ("all",), np.zeros(1200, np.int64), 8, np.ones(1), {}, np.full(9, np.nan)),
        modes.EventPixels(SENSOR), modes.Events(np.zeros(3), np.zeros(3, np.int32), np.ones(3, np.int8), SITES),
        twin.StepResponses(0.1 + 0.001 * MANY, np.full(MANY.size, 9), np.ones((MANY.size, 9), np.int64)), STATIC, twin.fit_event_pixels(static=[STATIC]),
        modes.Shutter(SITES, 0.1), modes.Exposure(modes.Shutter(SITES, 0.1), 0.05), modes.SpikingPixels(SENSOR, threshold_e=np.full(SITES.n_sites, 100.0)),
        metrics.AliasingSpectrum(**SPECTRUM, wave_per_mm=MANY[:2], amplitude=np.ones((9, 9)), baseband_fraction=1.0, alias_fraction=0.0, alias_per_mm=MANY[:2], noise_fraction=0.0),
        metrics.nyquist_vs_eccentricity(SITES), metrics.EdgeMtf(frequency_per_mm=MANY, mtf=MANY, mtf_sigma=MANY, angle_deg=5.0, offset_um=0.0, contrast=1.0, bin_um=0.5, pitch_um=2.0, distance_um=MANY, esf=MANY, n_sites=1000),
        metrics.Emva1288(np.arange(50), *PER_CLASS.values(), TRANSFER, TRANSFER, INTERVALS), INTERVALS, BOUND,
        metrics.FlowEstimate(regions=np.arange(1000), flow_um=np.ones((50, 2)), bound=BOUND, misfit=MANY), TRANSFER,
        metrics.SamplingSpectrum(**SPECTRUM, power=np.ones((1000, 1000)), n_sites=100),
        metrics.SnrTable(**BY_CLASS, size_um=np.ones(50), signal_dn=np.ones(50), noise_dn=np.ones(50), saturated_fraction=np.ones(50)),
        view.prisms(SITES), view.PartReport(name="wells", status="ok", n_triangles=10, volume_um3=1.0, euler_characteristic=2),
        view.SensorStack(), view.colours_of(SITES, "area_um2"), view.SitePixels.from_layout(SITES, (50, 50)), solids, solids.check(), view.Viewpoint(),
        plan, explore.StudyPlan(base=plan, search={}, objectives={"m": "minimize"}, constraints={}, n_trials=1, batch=1, name="study", directory=directory, files={}),
        config.LayoutFile(layout=SITES, rules=fs.DesignRules(min_size_um=1.0), source="sites.npz"), config.Result(shot, capture, REPORT, 0.1), shot,
        REQUIREMENT, RESULT, explore.ResultMetric(RESULT), explore.CheckedRequirement(REQUIREMENT, 5.0), explore.Solution("exposure_s", 0.01, 5.0, [(float(k), 1.0) for k in range(50)]),
        config.Viewable(capture, REPORT, "capture"), drc.Case(SITES, fs.DesignRules(min_size_um=1.0)), drc.Measurement(MANY),
        config.Source(file=Path("sweep.yaml"), keys=("shot",), index="3"), layout.SolveFor(name="n_x", is_integer=True, is_increasing=True, guess=len),
        compare.budget_of(CAMERA, 30.0), fs.metrics.metric_info("psnr_db"), compare.median_interval(np.ones((50, 5))), compare.SceneCovariance(np.ones(50), np.ones(50)),
        compare.quality_by_eccentricity(capture.picture(), capture.picture(), edges_um=np.array([0.0, 20.0])),
        twins, twins.deviations[0], twin.Estimate(1.0, 0.5, 2.0), STACK, TWIN,
        compare.cameras({"a": CAMERA, "b": CAMERA}, {"flat": SCENE}, exposure_s=0.01, n_annuli=2),
        reconstruct.ColourCorrection(np.eye(3), np.zeros(24), np.zeros(24)),
        reconstruct.CorticalImage(data=np.ones((1, 20, 30)), radius_um=np.arange(21.0), start_rad=np.zeros(20)),
        tiles.TiledCapture(columns={"code": MANY}, tile_sites=500, filter_names=("all",), bits=8, white_dn=np.ones(1), settings={}, path=Path("large.zarr")),
        fs.columns.column_info("snr"), config.Limits(above=0.0), config.Usual(0.0, 1.0), config.Words("petal radius"),
        dataset, explore.DatasetFile(dataset=dataset, per_shard=None), explore.open_dataset(directory / "samples"),
    ]  # fmt: skip
