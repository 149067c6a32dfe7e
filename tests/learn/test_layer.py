"""Cameras as layers of networks, compared with captures of the simulator; devices, gazes and wrong inputs."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Thread

import numpy as np
import pytest
import torch
from reference.twins import small_twin
from torch.func import functional_call
from torch.fx.experimental.proxy_tensor import make_fx

import foveasim as fs
from foveasim import learn
from foveasim.distortion import BrownConrady
from foveasim.learn import _tensors
from foveasim.optics import IlluminationTable, Seidel, Zernike
from foveasim.sensor.effects import Diffusion, InterPixelCapacitance
from foveasim.units import decode_srgb

pytestmark = pytest.mark.filterwarnings(
    "ignore::foveasim.errors.SamplingWarning",
    "ignore::foveasim.errors.CoverageWarning",
    "ignore:the focal length of the lens model",
)
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.8, precision="double", oversample=1)
EXPOSURE_S = 0.02
SHAPE = (40, 48)


def scene(shape=SHAPE, seed=0):
    """Return a scene of 3 basis images with 5 wavelengths."""
    rng = np.random.default_rng(seed)
    return fs.Scene(
        rng.random((3, *shape)), 0.01 * rng.random((3, 5)), np.linspace(450.0, 650.0, 5), np.full(5, 40.0), None, 1.0, fit="cover"
    )  # fmt: skip


def pictures_of(light, dtype=torch.float64):
    """Return the basis images of a scene as pictures, top row first."""
    return torch.from_numpy(np.array(light.basis)[:, ::-1].copy()).to(dtype)


def sensor(layout=None, **changes):
    layout = fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=5.0).rotate(7.0) if layout is None else layout
    if "channel" not in layout.columns:
        layout = layout.with_columns(channel=np.arange(layout.n_sites) % 3)
    n_channels = int(layout.channel.max()) + 1
    filters = (
        "rgb"
        if n_channels == 3
        else fs.sensor.FilterSet([fs.sensor.ConstantCurve(0.9 - 0.05 * k) for k in range(n_channels)])
    )
    return fs.Sensor(layout, **{"filters": filters, "read_noise_e": 2.0, "bits": 10, "capacitance_f": 2e-14, **changes})


def camera(layout=None, optics=None, **changes):
    own = {name: changes.pop(name) for name in ("distortion", "gaze_um", "axis", "order") if name in changes}
    return fs.Camera(optics=replace(OPTICS, **(optics or {})), sensor=sensor(layout, **changes), **own)


BUNDLED = [
    "bayer_grid", "four_zones", "foveal_blind_spot", "giotto_1", "ibidem", "log_polar_ccd", "pixirad_1", "prima_75", "spectral_16",
    "square_grid", "x_trans",
]  # fmt: skip


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("name", BUNDLED)
def test_layer_agrees_with_camera_for_bundled_sensors(name):
    original, light = camera(fs.read_layout(name)), scene()
    expected_e = original.capture(light, exposure_s=EXPOSURE_S, seed=0).expected_e
    layer = learn.SensorLayer(original, light, exposure_s=EXPOSURE_S)
    # A camera with more filters than wavelengths weights maps of the wavelengths, which rounds differently.
    exact = 1e-11 if name == "spectral_16" else 1e-12
    for dtype, limit in ((torch.float64, exact), (torch.float32, 1e-6)):
        found = layer.expected_e(pictures_of(light, dtype))
        assert found.dtype == dtype
        np.testing.assert_allclose(found.numpy(), expected_e, rtol=0, atol=limit * expected_e.max())


CAMERAS = {
    "distorted": {"distortion": BrownConrady(focal_um=100.0, k1=-0.1, centre_um=(1.0, 2.0))},
    "moved": {"gaze_um": (2.3, -1.7)},
    "turned": {"gaze_um": (2.3, -1.7), "axis": "sensor"},
    "aberrated": {"optics": {"zernike": Zernike(coefficients={4: 0.2, 7: 0.1}), "oversample": 2}},
    "modes": {"optics": {"seidel": Seidel(coma_um=0.5, field_radius_um=30.0), "field_modes": 4}},
    "patches": {"optics": {"seidel": Seidel(coma_um=0.5, field_radius_um=30.0), "field_patches": 2}},
    "second order": {"order": 2},
    "pixel optics": {"pixel_optics": fs.sensor.Microlens(height_um=8.0, refractive_index=1.5, crosstalk=True)},
    "mixing": {"crosstalk": Diffusion(spread_um=0.8), "coupling": InterPixelCapacitance(neighbour_fraction=0.02)},
    "dark": {"dark_e_per_s": 400.0, "dsnu_fraction": 0.3, "prnu_fraction": 0.05, "dead_fraction": 0.05},
    "data sheet": {"capacitance_f": None, "gain_dn_per_e": 0.2, "dsnu_e": 4.0, "pedestal_v": 0.1},
    "converter": {"dnl_dn": 0.4, "companding": "root", "nonlinearity_fraction": 0.04},
}


@pytest.mark.parametrize("name", CAMERAS)
def test_layer_agrees_with_camera_with_its_parts(name):
    original, light = camera(**copy.deepcopy(CAMERAS[name])), scene()
    capture = original.capture(light, exposure_s=EXPOSURE_S, seed=0)
    layer = learn.SensorLayer(original, light, exposure_s=EXPOSURE_S, noise=False)
    found = layer.expected_e(pictures_of(light)).numpy()
    np.testing.assert_allclose(found, capture.expected_e, rtol=0, atol=1e-12 * capture.expected_e.max())

    # Codes without noise are those of the sensor for the expected charges.
    noiseless = layer.readout.code(torch.tensor(capture.expected_e))
    assert torch.equal(layer(pictures_of(light)), noiseless) or name == "converter"


def test_layer_has_the_maps_of_a_twin():
    """Charges are those of captures; means of codes with noise are those of predictions."""
    original, light, exposure_s = fs.Camera(optics=OPTICS, sensor=small_twin().sensor()), scene(), 0.001
    capture = original.capture(light, exposure_s=exposure_s, seed=0)
    layer = learn.SensorLayer(original, light, exposure_s=exposure_s)
    found = layer.expected_e(pictures_of(light)).numpy()
    codes = np.mean([layer(pictures_of(light)).numpy() for _ in range(300)], axis=0)
    mean_dn, variance_dn2 = original.predict(light, exposure_s=exposure_s)
    z = (codes - mean_dn) / np.sqrt(variance_dn2 / 300)

    np.testing.assert_allclose(found, capture.expected_e, rtol=0, atol=1e-12 * capture.expected_e.max())
    assert np.ptp(original.sensor.pattern("offset_map")) > 0.0
    assert 0.0 < mean_dn.max() < 2047.0
    assert np.abs(z).max() < 4.5


@pytest.mark.parametrize("name", ["moved", "modes", "patches"])
def test_first_row_may_be_the_top_one(name):
    light = scene()
    model = learn.Model(camera(**copy.deepcopy(CAMERAS[name])), light, (), exposure_s=EXPOSURE_S)
    basis = torch.from_numpy(np.array(light.basis, np.float64))

    assert torch.equal(model.photo_e_per_s(basis.flip(-2), origin="upper"), model.photo_e_per_s(basis))
    with pytest.raises(fs.FoveasimError, match="'origin' must be one of 'lower', 'upper', got 'top'"):
        model.photo_e_per_s(basis, origin="top")


def test_layer_reads_charges_as_the_sensor():
    """Without temporal noise, with all conversions, for whole electrons."""
    original = camera(**CAMERAS["converter"], read_noise_e=0.0, shot_noise="off", ktc_noise=False)
    charge_e = np.arange(0, 72) * 431.0
    layer = learn.SensorLayer(original, scene(), exposure_s=EXPOSURE_S)

    np.testing.assert_array_equal(
        layer.readout.code(torch.from_numpy(charge_e)).numpy(), original.sensor.read(charge_e.astype(np.int64), seed=0)
    )


def test_layer_draws_agree_with_prediction():
    light, n = scene(), 4000
    original = camera(**CAMERAS["mixing"])
    layer = learn.SensorLayer(original, light, exposure_s=EXPOSURE_S)
    code = layer(pictures_of(light, torch.float32).expand(n, -1, -1, -1), generator=torch.Generator().manual_seed(0))
    mean, variance = original.predict(light, exposure_s=EXPOSURE_S)
    code = code.double().numpy()
    fourth = ((code - code.mean(axis=0)) ** 4).mean(axis=0)

    assert np.all(np.abs(code.mean(axis=0) - mean) < 5.0 * np.sqrt(variance / n))
    assert np.all(np.abs(code.var(axis=0, ddof=1) - variance) < 5.0 * np.sqrt((fourth - code.var(axis=0) ** 2) / n))


@pytest.mark.parametrize("name", ["distorted", "aberrated", "modes", "patches", "pixel optics"])
def test_layer_is_adjoint_to_its_gradient(name):
    layer = learn.SensorLayer(camera(**copy.deepcopy(CAMERAS[name])), scene(), exposure_s=EXPOSURE_S)
    for dtype, limit in ((torch.float32, 1e-6), (torch.float64, 1e-13)):
        generator = torch.Generator().manual_seed(0)
        pictures = torch.rand(2, 3, *SHAPE, generator=generator, dtype=dtype, requires_grad=True)
        weights = torch.rand(2, layer.n_sites, generator=generator, dtype=dtype)
        product = (layer.photo_e_per_s(pictures) * weights).sum()
        (adjoint,) = torch.autograd.grad(product, pictures)

        assert float((adjoint * pictures).detach().sum()) == pytest.approx(float(product.detach()), rel=limit)


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    ("changes", "wrt"),
    [
        ({}, ("filters", "qe", "exposure_s")),
        ({"optics": {"zernike": Zernike(coefficients={4: 0.2})}}, ("zernike", "defocus")),
        ({}, ("vertices",)),
        ({"distortion": BrownConrady(focal_um=100.0, k1=-0.1)}, ("vertices", "distortion")),
    ],
)
def test_layer_passes_gradcheck(changes, wrt, real_device):
    """Also to the gaze, where the geometry admits it; of smooth codes."""
    layout = fs.layout.hexagonal(n_columns=3, n_rows=2, pitch_um=5.0).rotate(7.0)
    layer = learn.SensorLayer(
        camera(layout, **changes), scene((9, 10)), wrt, exposure_s=0.005, noise=False, boundary="free"
    ).to(real_device)
    variables = {name: value.detach().clone() for name, value in layer.named_parameters()}
    pictures = torch.rand(2, 3, 9, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) + 0.1
    gazes = () if "distortion" in wrt else (torch.tensor([[0.31, -0.2], [0.1, 0.7]], dtype=torch.float64),)

    def expected(pictures, *values):
        given, values = values[: len(gazes)], values[len(gazes) :]
        weights = functional_call(layer, dict(zip(variables, values, strict=True)), (pictures, *given))
        return weights / 100.0

    layer.output = "expected"
    inputs = [each.to(real_device).requires_grad_() for each in (pictures, *gazes, *variables.values())]
    # Sums on a GPU have no fixed order, and gradients of the order of 1000.
    assert torch.autograd.gradcheck(expected, inputs, eps=1e-6, atol=1e-5, rtol=1e-5, nondet_tol=1e-8, fast_mode=True)


def test_codes_pass_their_gradient_straight_through():
    light = scene()
    layer = learn.SensorLayer(camera(), light, exposure_s=EXPOSURE_S, noise=False)
    pictures = pictures_of(light).requires_grad_()
    code = layer(pictures)
    (of_codes,) = torch.autograd.grad(code.sum(), pictures)
    (of_charges,) = torch.autograd.grad(layer.expected_e(pictures).sum(), pictures)

    assert torch.equal(code, code.round())
    per_e = layer.readout.sensor.v_per_e[0] * 1024 / layer.readout.sensor.v_sat_v
    torch.testing.assert_close(of_codes, of_charges * per_e, rtol=1e-9, atol=0.0)


# -- gaze -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["image", "sensor"])
@pytest.mark.parametrize(("gaze_cells", "order", "limit"), [((3.0, -2.0), 1, 1e-12), ((1.31, -0.77), 2, 3e-3)])
def test_gaze_agrees_with_camera(axis, gaze_cells, order, limit):
    """A shift by whole cells is exact; by fractions of cells that sample the image it differs by the accuracy of integration."""
    even = IlluminationTable(image_height_um=(0.0, 1e4), fraction=(1.0, 1.0))
    light = replace(scene(), gaze_range_um=(8.0, 8.0))
    original = camera(optics={"relative_illumination": even, "oversample": order}, axis=axis, order=order)
    layer = learn.SensorLayer(original, light, exposure_s=EXPOSURE_S)
    gaze_um = tuple((np.array(gaze_cells) * layer.model.grid.pitch_x_um).tolist())
    expected_e = original.with_gaze(gaze_um, axis).capture(light, exposure_s=EXPOSURE_S, seed=0).expected_e
    found = layer.expected_e(pictures_of(light)[None], torch.tensor([gaze_um], dtype=torch.float64))[0]

    np.testing.assert_allclose(found.numpy(), expected_e, rtol=0, atol=limit * expected_e.max())


@pytest.mark.parametrize("leading", [(), (2,), (2, 3)])
def test_path_of_gazes_is_a_sequence(leading):
    light = scene()
    layer = learn.SensorLayer(camera(), light, exposure_s=EXPOSURE_S, output="expected")
    pictures = torch.rand(*leading, 3, *SHAPE, dtype=torch.float64)
    path = torch.rand(*leading, 4, 2, dtype=torch.float64)
    found = layer(pictures, path)

    assert found.shape == (*leading, 4, layer.n_sites)
    torch.testing.assert_close(found[..., 2, :], layer(pictures, path[..., 2, :]), rtol=1e-12, atol=1e-9)


def test_gaze_is_found_by_descent():
    light = scene()
    layer = learn.SensorLayer(camera(), light, exposure_s=EXPOSURE_S, output="expected")
    smooth = torch.nn.functional.avg_pool2d(pictures_of(light), 9, 1, 4)[None]
    seen = layer(smooth, torch.tensor([[1.5, -1.0]], dtype=torch.float64))
    gaze = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([gaze], lr=0.1)
    for _ in range(100):
        optimiser.zero_grad()
        ((layer(smooth, gaze) - seen) ** 2).mean().backward()
        optimiser.step()

    torch.testing.assert_close(gaze.detach(), torch.tensor([[1.5, -1.0]], dtype=torch.float64), rtol=0, atol=0.05)


@pytest.mark.parametrize(
    ("name", "gaze_um", "message"),
    [
        ("distorted", [[0.0, 0.0]], "must be that of the camera for a lens model"),
        ("turned", [[0.0, 0.0]], "must be that of the camera for axis='sensor'"),
        ("patches", [[0.0, 0.0]], "isoplanatic patches"),
        ("pixel optics", [[0.0, 0.0]], "pixel optics"),
        ("moved", [0.0, 0.0], "'gaze_um' must have the shape"),
        ("moved", [[0.0, 0.0, 0.0]], "'gaze_um' must have the shape"),
        ("moved", [[0, 0]], "'gaze_um' must be a tensor of floating-point numbers"),
    ],
)
def test_impossible_gazes_are_rejected(name, gaze_um, message):
    layer = learn.SensorLayer(camera(**copy.deepcopy(CAMERAS[name])), scene(), exposure_s=EXPOSURE_S)
    with pytest.raises(fs.FoveasimError, match=message):
        layer(torch.rand(1, 3, *SHAPE), torch.tensor(gaze_um))


# -- modules ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("output", ["code", "charge", "expected"])
def test_layer_runs_on_devices(output, dtype, device):
    layer = learn.SensorLayer(camera(), scene(), ("filters", "exposure_s"), exposure_s=EXPOSURE_S, output=output).to(
        device
    )
    pictures = torch.rand(2, 3, *SHAPE, device=device, dtype=dtype, requires_grad=True)
    found = layer(pictures)
    found.sum().backward()

    assert (found.shape, found.dtype, found.device.type) == ((2, layer.n_sites), dtype, device.type)
    assert pictures.grad.device.type == layer.model.filters.grad.device.type == device.type


@pytest.mark.parametrize(
    ("name", "wrt"),
    [
        ("mixing", ("vertices",)),
        ("distorted", ("vertices", "distortion")),
        ("aberrated", ("zernike", "defocus")),
        ("patches", ()),
    ],
)
def test_variables_follow_devices(name, wrt, device):
    """On other devices than the CPU, vertices use sums over edges in operations of PyTorch."""
    layer = learn.SensorLayer(
        camera(**copy.deepcopy(CAMERAS[name])), scene(), wrt, exposure_s=EXPOSURE_S, output="expected"
    )
    pictures = torch.rand(2, 3, *SHAPE, dtype=torch.float64)
    expected = layer(pictures).detach()
    layer.to(device)(pictures.to(device).requires_grad_()).sum().backward()
    found = layer(pictures.to(device)).detach()

    assert (found.shape, found.device.type) == (expected.shape, device.type)
    assert all(value.grad.device.type == device.type for value in layer.parameters())
    if device.type != "meta":
        torch.testing.assert_close(found.cpu(), expected, rtol=1e-10, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_layer_computes_in_single_precision_under_autocast(dtype):
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S, output="expected")
    pictures = torch.rand(2, 3, *SHAPE)
    plain = layer(pictures)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = torch.nn.functional.linear(layer(pictures), torch.eye(layer.n_sites))
        assert torch.equal(layer(pictures), plain)

    assert found.dtype == torch.bfloat16
    assert layer(pictures.to(dtype)).dtype == torch.float32


def test_layer_is_a_module():
    layer = learn.SensorLayer(camera(), scene(), ("filters",), exposure_s=EXPOSURE_S)
    pictures = torch.rand(2, 3, *SHAPE)
    first = layer(pictures, generator=torch.Generator().manual_seed(4))
    for other in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        assert torch.equal(other(pictures, generator=torch.Generator().manual_seed(4)), first)
    changed = copy.deepcopy(layer)
    with torch.no_grad():
        changed.model.filters.mul_(0.5)
    assert not torch.equal(changed(pictures, generator=torch.Generator().manual_seed(4)), first)
    changed.load_state_dict(layer.state_dict())
    assert torch.equal(changed(pictures, generator=torch.Generator().manual_seed(4)), first)
    with ThreadPoolExecutor(4) as pool:
        found = pool.map(lambda seed: layer(pictures, generator=torch.Generator().manual_seed(seed)), [4] * 8)
    assert all(torch.equal(each, first) for each in found)


@pytest.fixture
def one_picture_per_part(monkeypatch):
    """Let batches be computed in parts of one picture, on three threads of which each has a part."""
    n_threads = torch.get_num_threads()
    monkeypatch.setattr("foveasim.learn.imaging.MAX_PART", 1)
    monkeypatch.setattr("foveasim.learn._tensors.thread_count", lambda: 3)
    torch.set_num_threads(4)
    yield
    assert torch.get_num_threads() == 4
    torch.set_num_threads(n_threads)


@pytest.mark.usefixtures("one_picture_per_part")
@pytest.mark.parametrize("name", ["mixing", "patches", "moved"])
@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode, torch.enable_grad])
def test_parts_of_batches_are_independent(name, context):
    layer = learn.SensorLayer(camera(**CAMERAS[name]), scene(), exposure_s=EXPOSURE_S)
    pictures = torch.rand(7, 3, *SHAPE)
    with context():
        found = layer(pictures, generator=torch.Generator().manual_seed(4))
        whole = torch.stack([layer.photo_e_per_s(picture) for picture in pictures])

        assert torch.equal(layer.photo_e_per_s(pictures), whole)
        assert torch.equal(layer(pictures, generator=torch.Generator().manual_seed(4)), found)
        assert found.is_inference() == (context is torch.inference_mode)


@pytest.mark.usefixtures("one_picture_per_part")
def test_parts_of_batches_follow_their_gazes():
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S)
    pictures, path = torch.rand(7, 3, *SHAPE, dtype=torch.float64), torch.rand(7, 2, 2, dtype=torch.float64)
    whole = torch.stack([layer.photo_e_per_s(*each) for each in zip(pictures, path, strict=True)])

    assert torch.equal(layer.photo_e_per_s(pictures, path), whole)
    assert torch.equal(layer.model.photo_e_per_s(pictures, path, origin="upper"), whole)


@pytest.mark.usefixtures("one_picture_per_part")
def test_parts_of_batches_have_gradients():
    layer = learn.SensorLayer(camera(), scene(), ("filters",), exposure_s=EXPOSURE_S)
    pictures = torch.rand(5, 3, *SHAPE, dtype=torch.float64)
    layer.photo_e_per_s(pictures).square().sum().backward()
    found, layer.model.filters.grad = layer.model.filters.grad, None
    for picture in pictures:
        layer.photo_e_per_s(picture).square().sum().backward()

    torch.testing.assert_close(found, layer.model.filters.grad, rtol=1e-12, atol=0.0)


@pytest.mark.usefixtures("one_picture_per_part")
def test_errors_of_parts_are_raised():
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S)
    pictures = torch.rand(7, 3, *SHAPE)
    pictures[5, 0, 3, 3] = float("nan")

    with pytest.raises(fs.errors.ParameterError, match="must be finite"):
        layer(pictures)


@pytest.mark.usefixtures("one_picture_per_part")
def test_rejected_batches_draw_no_random_numbers():
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S)
    pictures, generator = torch.rand(7, 3, *SHAPE), torch.Generator().manual_seed(4)
    state = generator.get_state()
    pictures[6] = -1.0
    with pytest.raises(fs.errors.ParameterError, match="must be >= 0"):
        layer(pictures, generator=generator)

    assert torch.equal(generator.get_state(), state)


@pytest.mark.usefixtures("one_picture_per_part")
def test_threads_of_others_keep_their_number():
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S)
    layer(torch.rand(7, 3, *SHAPE))
    found = []
    for _ in range(3):
        thread = Thread(target=lambda: found.append(torch.get_num_threads()))
        thread.start()
        layer(torch.rand(7, 3, *SHAPE))
        thread.join()

    assert found == [4, 4, 4]
    used = _tensors._pool(3).map(lambda _: (torch.rand(1 << 20).add_(1.0), torch.get_num_threads())[1], range(6))
    assert list(used) == [1] * 6


@pytest.mark.parametrize("n_columns", [1, 2])
def test_large_sites_are_summed_precisely(n_columns):
    layout = fs.layout.grid(n_columns, n_columns, 400.0 / n_columns)
    layer = learn.SensorLayer(
        fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout)), scene_shape=(1, 400, 400), exposure_s=EXPOSURE_S
    )
    white = torch.full((1, 1, 400, 400), 0.3)
    with torch.no_grad():
        found, expected = layer.photo_e_per_s(white), layer.photo_e_per_s(white.double())

    torch.testing.assert_close(found.double(), expected, rtol=2e-6, atol=0.0)


@pytest.mark.parametrize("shape", [(0,), (2, 0)])
def test_empty_batches_have_empty_results(shape):
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S)

    assert layer(torch.rand(*shape, 3, *SHAPE)).shape == (*shape, layer.n_sites)
    assert layer(torch.rand(2, 3, *SHAPE), torch.zeros(2, 0, 2)).shape == (2, 0, layer.n_sites)


@pytest.mark.filterwarnings("ignore:`torch.jit.trace", "ignore::torch.jit.TracerWarning")
def test_tracers_see_all_operations():
    imaging = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S).model.imaging
    first, other = (torch.rand(2, 3, *SHAPE, dtype=torch.float64) for _ in range(2))
    expected = imaging(basis=other)

    for make in (
        lambda function: torch.jit.trace(function, first, check_trace=False),
        lambda function: make_fx(function)(first),
        torch.func.functionalize,
    ):
        torch.testing.assert_close(make(lambda each: imaging(basis=each))(other), expected)


def test_negative_views_are_read():
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S, output="expected")
    pictures = torch.rand(2, 3, *SHAPE)

    torch.testing.assert_close(layer(torch._neg_view(-pictures)), layer(pictures))


@pytest.mark.usefixtures("one_picture_per_part")
def test_layers_work_within_functional_gradients():
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S, output="expected")
    pictures = torch.rand(4, 3, *SHAPE, dtype=torch.float64)
    variable = pictures.clone().requires_grad_()
    layer(variable).square().sum().backward()

    torch.testing.assert_close(torch.func.grad(lambda each: layer(each).square().sum())(pictures), variable.grad)
    gain = torch.func.grad(lambda gain: gain * layer(pictures).sum())(torch.ones(()))
    assert float(gain) == pytest.approx(float(layer(pictures).sum()))


def test_layer_can_be_used_first_without_gradients():
    """Constants that are created in inference mode must not stay inference tensors."""
    layer = learn.SensorLayer(camera(**CAMERAS["mixing"]), scene(), ("filters",), exposure_s=EXPOSURE_S)
    with torch.inference_mode():
        layer(torch.rand(1, 3, *SHAPE))
    layer(torch.rand(1, 3, *SHAPE)).sum().backward()

    assert layer.model.filters.grad.abs().max() > 0.0


def test_camera_of_layer_has_its_variables():
    light = scene()
    layer = learn.SensorLayer(camera(), light, ("filters",), exposure_s=EXPOSURE_S)
    with torch.no_grad():
        layer.model.filters.mul_(0.5)
    found = layer.expected_e(pictures_of(light)).detach().numpy()

    capture = layer.camera().capture(light, exposure_s=EXPOSURE_S, seed=0)
    np.testing.assert_allclose(capture.expected_e, found, rtol=1e-12)


@pytest.mark.parametrize("shape", [(3, 32, 40), (1, 32, 40), (32, 40)])
def test_shapes_replace_scenes(shape):
    layer = learn.SensorLayer(camera(), scene_shape=shape, output="expected")
    n_channels = shape[0] if len(shape) == 3 else 3
    white = layer(torch.ones(1, n_channels, 32, 40))
    saturation_e = layer.readout.sensor.linearise(np.zeros(1)).saturation_e

    assert layer.channels == n_channels
    assert 0.3 < float(white.max()) / float(saturation_e[0]) < 1.0


@pytest.mark.parametrize(("encoding", "decode"), [("srgb", decode_srgb), ("sqrt", np.square)])
def test_encoded_pictures_are_decoded(encoding, decode):
    values = np.random.default_rng(0).random((3, *SHAPE))
    plain, encoded = (
        learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S, output="expected", encoding=each)
        for each in ("linear", encoding)
    )

    torch.testing.assert_close(
        encoded(torch.from_numpy(values)), plain(torch.from_numpy(decode(values))), rtol=1e-12, atol=0
    )


PICTURES = torch.rand(2, 3, *SHAPE)


@pytest.mark.parametrize(
    ("pictures", "message"),
    [
        (PICTURES.numpy(), "'pictures' must be a Tensor, got an ndarray"),
        ((PICTURES * 255).byte(), "must be floating-point numbers from 0 to 1, got torch.uint8; for 8 bits use"),
        (PICTURES * 255, "must be relative radiances, 1 for white.*divide those of 8 bits by 255"),
        (PICTURES - 0.5, "'pictures' must be >= 0.*undo the normalisation"),
        (PICTURES * torch.nan, "'pictures' must be finite"),
        (
            PICTURES.movedim(1, -1),
            r"got \(2, 40, 48, 3\); channels come before rows and columns: use .movedim\(-1, -3\)",
        ),
        (PICTURES[:, :1], "the scene has 3 channels"),
        (PICTURES[:, :, 1:], r"must have the shape \(..., 3, 40, 48\)"),
        (PICTURES[0, 0], r"must have the shape \(..., 3, 40, 48\)"),
    ],
)
def test_wrong_pictures_are_rejected(pictures, message):
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S)
    with pytest.raises(fs.FoveasimError, match=message):
        layer(pictures)


@pytest.mark.parametrize("exposure_s", [-1.0, 1e9, float("nan")])
def test_wrong_exposures_are_rejected(exposure_s):
    with pytest.raises(fs.FoveasimError, match="'exposure_s' must be"):
        learn.SensorLayer(camera(), scene(), exposure_s=exposure_s)


def test_gazes_of_another_device_are_rejected():
    layer = learn.SensorLayer(camera(), scene(), exposure_s=EXPOSURE_S)
    with pytest.raises(fs.FoveasimError, match="'gaze_um' must be on the device of the pictures, cpu, got meta"):
        layer(PICTURES, torch.zeros(2, 2, device="meta"))


def test_pictures_of_another_device_are_rejected():
    layer = learn.SensorLayer(camera(), scene(), ("filters",), exposure_s=EXPOSURE_S)
    with pytest.raises(
        fs.FoveasimError, match=r"must be on the device of the layer, cpu, got meta; use layer.to\(device\)"
    ):
        layer(PICTURES.to("meta"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "'scene' must be given, or 'scene_shape', but not both"),
        ({"scene": scene(), "scene_shape": SHAPE}, "'scene' must be given, or 'scene_shape', but not both"),
        ({"scene_shape": (2, 8, 8)}, "must have 1 or 3 channels, got 2; pass a Scene"),
        ({"scene_shape": 8}, "'scene_shape'"),
        ({"scene_shape": (3, 0, 8)}, "'scene_shape' must be"),
        ({"scene": scene(), "output": "codes"}, "'output' must be one of"),
        ({"scene": scene(), "encoding": "gamma"}, "'encoding' must be one of"),
        ({"scene": scene(), "wrt": ("vertex",)}, "did you mean 'vertices'"),
    ],
)
def test_wrong_layer_arguments_are_rejected(arguments, message):
    with pytest.raises(fs.FoveasimError, match=message):
        learn.SensorLayer(camera(), **arguments)
