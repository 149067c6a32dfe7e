"""Optics, distortion, readout and complete cameras as functions of tensors, compared with the simulator and with differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck
from torch.func import functional_call

import foveasim as fs
from foveasim import learn
from foveasim.distortion import BrownConrady, Fisheye, Omnidirectional, PolynomialFisheye, Scaramuzza
from foveasim.errors import ParameterError
from foveasim.integrate import UndistortedOutlines
from foveasim.learn.distortion import coefficient_values
from foveasim.optics import LateralColour, PSFGrid, PupilImage, Seidel, Zernike
from foveasim.sensor.effects import Diffusion, InterPixelCapacitance

#: The pictures and focal lengths are small, so that every derivative can be compared.
pytestmark = pytest.mark.filterwarnings(
    "ignore::foveasim.errors.SamplingWarning",
    "ignore::foveasim.errors.CoverageWarning",
    "ignore:the focal length of the lens model",
)
RNG = np.random.default_rng(0)
ZERNIKE = Zernike(coefficients={4: 0.1, 7: 0.15})
SEIDEL = Seidel(spherical_um=0.2, coma_um=0.2, astigmatism_um=0.1, field_curvature_um=0.05, field_radius_um=20.0)
PUPIL = PupilImage(0.5 + 0.5 * RNG.random((3, 3)))

#: A spot that moves and darkens towards the edges of the picture.
PSFS = PSFGrid.from_arrays(
    [np.exp(-0.25 * np.square(np.hypot(*np.mgrid[-9 - y : 10 - y, -9 - x : 10 - x]))) for y in (-1, 1) for x in (-1, 2)],
    x_um=[-20.0, 20.0, -20.0, 20.0], y_um=[-20.0, -20.0, 20.0, 20.0], wavelength_nm=550.0, pitch_um=1.0,
    relative_illumination=[0.7, 0.9, 0.8, 1.0],
)  # fmt: skip


def lens(**changes):
    return fs.Optics(focal_length_mm=22.0, f_number=4.0, precision="double", **changes)


def scene(shape=(20, 24), n_basis=2, n_waves=3, pitch_um=30.0):
    rng = np.random.default_rng(5)
    return fs.Scene(
        rng.random((n_basis, *shape)), 0.02 * rng.random((n_basis, n_waves)), np.linspace(450, 650, n_waves),
        np.full(n_waves, 40.0), pitch_um, 0.5,
    )  # fmt: skip


# -- imaging ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("padding", ["reflect", "edge", "zero", "periodic"])
@pytest.mark.parametrize("oversample", [1, 2, 3])
def test_maps_agree_with_simulator(padding, oversample):
    optics = lens(padding=padding, oversample=oversample)
    maps = learn.Imaging(optics, scene())()

    expected = optics.power_map(scene()).data
    np.testing.assert_allclose(maps.numpy(), expected, rtol=0, atol=1e-13 * expected.max())


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize(
    ("changes", "wrt"),
    [
        ({"zernike": ZERNIKE}, ("zernike",)),
        ({"zernike": ZERNIKE, "oversample": 2, "source_pixel": "square"}, ("zernike", "defocus")),
        ({"seidel": SEIDEL, "field_patches": 3}, ("seidel",)),
        ({"seidel": SEIDEL, "field_patches": 3, "oversample": 2}, ()),
        ({"seidel": SEIDEL}, ()),
        ({"seidel": SEIDEL, "oversample": 2, "padding": "periodic"}, ()),
        ({"psfs": PSFS}, ()),
        ({"psfs": PSFS, "oversample": 2, "padding": "zero"}, ()),
        ({"pupil": PUPIL, "oversample": 2}, ("pupil",)),
        ({"pupil": PUPIL, "zernike": ZERNIKE}, ("pupil", "zernike")),
    ],
)
def test_variable_lenses_agree_with_simulator(changes, wrt):
    optics = lens(**{"oversample": 1, **changes})
    imaging = learn.Imaging(optics, scene(), wrt)
    limit = 1e-12
    expected = optics.power_map(scene()).data
    np.testing.assert_allclose(imaging().detach().numpy(), expected, rtol=0, atol=limit * expected.max())

    # And after the variables have changed, with the lens of these values.
    with torch.no_grad():
        for parameter in imaging.parameters():
            parameter.mul_(0.93)
    expected = imaging.optics().power_map(scene()).data
    np.testing.assert_allclose(imaging().detach().numpy(), expected, rtol=0, atol=2e-4 * expected.max())


@pytest.mark.parametrize(
    ("changes", "wrt"),
    [
        ({}, ()),
        ({"oversample": 2}, ()),
        ({"zernike": ZERNIKE}, ("zernike", "defocus")),
        ({"zernike": ZERNIKE, "oversample": 2}, ("zernike",)),
        ({"seidel": SEIDEL, "field_patches": 2}, ("seidel",)),
        ({"seidel": SEIDEL, "field_modes": 3}, ()),
        ({"psfs": PSFS, "field_modes": 2}, ()),
        ({"pupil": PUPIL}, ("pupil",)),
    ],
)
def test_imaging_passes_gradcheck(changes, wrt, real_device):
    imaging = learn.Imaging(lens(**{"oversample": 1, "padding_cells": 2, **changes}), scene((6, 7), 2, 2), wrt)
    imaging = imaging.to(real_device)
    names = [name for name, _ in imaging.named_parameters()]

    def maps(weights, basis, *values):
        return functional_call(imaging, dict(zip(names, values, strict=True)), (weights, basis))

    values = [(p.detach() * 1.02 + 0.003).requires_grad_() for p in imaging.parameters()]
    weights = torch.rand(2, 2, dtype=torch.float64, device=real_device, requires_grad=True)
    basis = torch.rand(2, 6, 7, dtype=torch.float64, device=real_device, requires_grad=True)
    assert gradcheck(maps, (weights, basis, *values), atol=1e-6, rtol=1e-6, nondet_tol=1e-10, fast_mode=True)


def test_batches_of_scenes_are_imaged():
    imaging = learn.Imaging(lens(oversample=1), scene())
    basis = torch.rand(4, 2, 20, 24, dtype=torch.float64)

    torch.testing.assert_close(imaging(basis=basis)[2], imaging(basis=basis[2]))


def test_total_power_ignores_aberrations():
    optics = lens(zernike=ZERNIKE, padding="periodic", oversample=1)
    imaging = learn.Imaging(optics, scene(), ("zernike",))
    (gradient,) = torch.autograd.grad(imaging().sum(), list(imaging.parameters()))

    assert float(gradient.abs().max()) < 1e-10 * float(imaging().sum().detach())


def test_defocus_is_found_by_descent():
    sharp = learn.Imaging(lens(oversample=1, zernike=Zernike(coefficients={4: 0.0}), padding_cells=12), scene())()
    imaging = learn.Imaging(
        lens(oversample=1, zernike=Zernike(coefficients={4: 0.12}), padding_cells=12), scene(), ("zernike",)
    )
    optimiser = torch.optim.Adam(imaging.parameters(), lr=0.01)
    for _ in range(40):
        optimiser.zero_grad()
        ((imaging() - sharp) ** 2).mean().backward()
        optimiser.step()

    assert abs(float(imaging.zernike.detach()[0])) < 0.02


@pytest.mark.parametrize(
    ("changes", "wrt", "message"),
    [
        ({}, ("zernik",), "did you mean 'zernike'"),
        ({"seidel": SEIDEL}, ("zernike",), "without optics.zernike"),
        ({}, ("seidel",), "without optics.seidel"),
        ({}, ("pupil",), "PupilImage"),
        ({"psfs": PSFS}, ("zernike",), "must be empty for a lens with 'psfs', whose aberrations are fixed"),
        ({"zernike": Zernike(coefficients={4: 0.1}, unit="waves")}, ("zernike",), "depend on the wavelength"),
        (
            {"lateral_colour": LateralColour(wavelength_nm=[450, 650], magnification=[1.0, 1.01])},
            (),
            "lateral chromatic",
        ),
    ],
)
def test_impossible_lens_variables_are_rejected(changes, wrt, message):
    with pytest.raises(fs.FoveasimError, match=message):
        learn.Imaging(lens(**changes), scene(), wrt)


def test_coarse_cells_are_rejected_for_aberrations():
    imaging = learn.Imaging(lens(zernike=ZERNIKE, oversample=1), scene(pitch_um=600.0), ("zernike",))
    with pytest.raises(fs.FoveasimError, match="must have map cells of at most"):
        imaging()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"weights": torch.ones(1, 4)}, "'weights' must have the shape"),
        ({"basis": torch.ones(2, 3, 3)}, "'basis' must have the shape"),
        ({"basis": torch.ones(2, 20, 24, dtype=torch.int64)}, "floating-point"),
    ],
)
def test_wrong_imaging_tensors_are_rejected(arguments, message):
    with pytest.raises(fs.FoveasimError, match=message):
        learn.Imaging(lens(), scene())(**arguments)


# -- distortion ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize(
    ("model", "names"),
    [
        (BrownConrady(focal_um=1000.0, k1=-0.12, k2=0.02, p1=0.004, p2=-0.003, centre_um=(5.0, -8.0)), ("k1", "p2")),
        (BrownConrady(focal_um=(1000.0, 1010.0), k1=0.05), ("k1", "k2")),
        (PolynomialFisheye(focal_um=800.0, k=(0.02, -0.01, 0.0, 0.0)), ("k[0]", "k[1]", "k[3]")),
        (Scaramuzza(a=(1.57e3, -2.75e-4, 3.76e-8, -3.64e-11), pixel_um=2.2, focal_um=3454.0), ("a[1]",)),
        (Scaramuzza(a=(500.0, -4e-4, 1e-7, 1e-10, 1e-14, 1e-17), pixel_um=3.0, focal_um=900.0), ("a[4]", "a[5]")),
        (Omnidirectional(xi=1.1, k1=-0.05, focal_um=900.0), ("xi", "k1")),
        (BrownConrady(k1=-0.1, s1=0.01, tau_x_rad=0.1, focal_um=900.0), ("s1", "tau_x_rad")),
        (Fisheye(projection="equidistant", focal_um=900.0), ()),
    ],
)
def test_distortion_passes_gradcheck(model, names):
    points = torch.from_numpy(RNG.uniform(-400, 400, (12, 2))).requires_grad_()
    start = torch.tensor(coefficient_values(model, names), dtype=torch.float64)
    # Variables of order 1: Scaramuzza's coefficients differ by orders of magnitude.
    unit = torch.where(start.abs() < 1e-3, torch.where(start == 0.0, 1.0, start.abs()), 1.0)
    scaled = (start / unit).requires_grad_()

    def ideal(points, scaled):
        return learn.undistort(model, points, scaled * unit, names) / 100.0

    assert gradcheck(ideal, (points, scaled), eps=1e-5, atol=1e-6, rtol=1e-6)
    np.testing.assert_allclose(
        ideal(points, scaled).detach() * 100.0, model.undistort(points.detach().numpy()), rtol=1e-14
    )


def test_distortion_derivative_inverts_forward_model():
    model = BrownConrady(focal_um=1000.0, k1=-0.12, k2=0.02)
    points = torch.from_numpy(RNG.uniform(-400, 400, (30, 2))).requires_grad_()
    ideal = learn.undistort(model, points)
    (slope,) = torch.autograd.grad(ideal[:, 0].sum() + ideal[:, 1].sum(), points)
    # The distorted position of a radial model, x R(r²), has a Jacobian in closed form.
    x, y = (ideal.detach() / 1000.0).T
    r2 = x * x + y * y
    factor, change = 1 - 0.12 * r2 + 0.02 * r2**2, -0.12 + 0.04 * r2
    jacobian = torch.stack(
        (factor + 2 * x * x * change, 2 * x * y * change, 2 * x * y * change, factor + 2 * y * y * change), 1
    )
    expected = torch.linalg.inv(jacobian.reshape(-1, 2, 2)).sum(dim=1)

    torch.testing.assert_close(slope, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"names": ("k11",)}, "did you mean 'k1'"),
        ({"names": ("k1",), "coefficients": torch.zeros(2, dtype=torch.float64)}, "one per name"),
        ({"points": torch.zeros(3, 3)}, "'points' must have the shape"),
        ({"lens": 3}, "'lens' must be a Lens"),
    ],
)
def test_wrong_distortion_arguments_are_rejected(arguments, message):
    valid = {"lens": BrownConrady(focal_um=1000.0, k1=-0.1), "points": torch.zeros(3, 2, dtype=torch.float64)}
    with pytest.raises(fs.FoveasimError, match=message):
        learn.undistort(**{**valid, **arguments})


# -- readout ---------------------------------------------------------------------------------------------------------------


def sensor(**changes):
    layout = fs.layout.hexagonal(n_columns=7, n_rows=6, pitch_um=3.0).rotate(9.0)
    layout = layout.with_columns(channel=np.arange(layout.n_sites) % 3)
    settings = {"filters": "rgb", "qe": 0.6, "capacitance_f": 1e-14, "read_noise_e": 3.0, "v_sat_v": 1.0, "bits": 8}
    return fs.Sensor(layout, **{**settings, **changes})


SENSORS = {
    "plain": {},
    "patterns": {
        "prnu_fraction": 0.02,
        "dark_e_per_s": 100.0,
        "dsnu_fraction": 0.2,
        "line_fpn_fraction": 0.005,
        "pixel_fpn_fraction": 0.003,
    },
    "diffusion": {"crosstalk": Diffusion(spread_um=0.5)},
    "capacitance": {"coupling": InterPixelCapacitance(neighbour_fraction=0.02)},
    "nonlinear": {"nonlinearity_fraction": 0.03, "pedestal_v": 0.05},
    "companding": {"companding": "root"},
    "reset": {"ktc_noise": True, "gain_fpn_fraction": 0.02},
}


def built(name):
    return sensor(**SENSORS[name])


@pytest.mark.parametrize("name", SENSORS)
def test_expected_charges_agree_with_sensor(name):
    device = built(name)
    rates = RNG.uniform(1e4, 1e6, device.layout.n_sites)
    found = learn.Readout(device).expected_e(torch.from_numpy(rates), 0.01)

    np.testing.assert_allclose(found.numpy(), device.expected_electrons(rates, 0.01), rtol=1e-12)


@pytest.mark.parametrize("name", SENSORS)
def test_expected_codes_agree_with_prediction(name):
    device = built(name)
    expected_e = RNG.uniform(500.0, 5000.0, device.layout.n_sites)
    mean_dn, _ = device.predict(expected_e)
    found = learn.Readout(device).expected_code(torch.from_numpy(expected_e))

    np.testing.assert_allclose(found.numpy(), mean_dn, rtol=0, atol=0.02 if name == "companding" else 0.005)


@pytest.mark.parametrize("name", SENSORS)
def test_readout_passes_gradcheck(name, real_device):
    readout = learn.Readout(built(name))
    charge = torch.from_numpy(RNG.uniform(500.0, 5000.0, (2, readout.sensor.layout.n_sites))).to(real_device)
    charge.requires_grad_()
    exposure = torch.tensor(1.0, dtype=torch.float64, device=real_device, requires_grad=True)

    def results(charge, exposure):
        expected_e = readout.expected_e(charge, exposure)
        return (
            expected_e,
            readout.voltage(expected_e) * 1e3,
            readout.expected_code(expected_e),
            readout.variance_e2(expected_e),
        )

    assert gradcheck(results, (charge, exposure), atol=1e-5, rtol=1e-6, eps=1e-6, nondet_tol=1e-8)


def test_drawn_charges_have_stated_moments():
    readout = learn.Readout(sensor())
    mean = torch.linspace(100.0, 5000.0, readout.sensor.layout.n_sites, dtype=torch.float64)
    drawn = readout.draw(mean.expand(20000, -1), torch.Generator().manual_seed(0))
    error = torch.sqrt(readout.variance_e2(mean) / 20000)

    assert float(((drawn.mean(dim=0) - mean) / error).abs().max()) < 5.0
    torch.testing.assert_close(drawn.var(dim=0), readout.variance_e2(mean), rtol=0.06, atol=0.0)


def test_drawn_charges_stop_at_full_well():
    readout = learn.Readout(sensor(full_well_e=1000.0, read_noise_e=0.0))
    charge = torch.full((readout.sensor.layout.n_sites,), 5000.0, dtype=torch.float64, requires_grad=True)
    drawn = readout.draw(charge)
    drawn.sum().backward()

    assert float(drawn.detach().max()) <= 1000.0
    assert torch.all(charge.grad == 0.0)


def test_straight_through_codes_are_integers():
    readout = learn.Readout(sensor(read_noise_e=0.0))
    charge = torch.linspace(-100.0, 8000.0, readout.sensor.layout.n_sites, dtype=torch.float64, requires_grad=True)
    code = readout.code(charge)
    code.sum().backward()
    volts = charge.detach().numpy() * 1.602176634e-19 / 1e-14
    lsb_per_e = 1.602176634e-19 / 1e-14 * 256

    np.testing.assert_array_equal(code.detach().numpy(), np.clip(np.floor(volts * 256), 0, 255))
    inside = (volts * 256 > 0.5) & (volts * 256 < 255.5)
    np.testing.assert_allclose(charge.grad.numpy()[inside], lsb_per_e, rtol=1e-9)
    assert torch.all(charge.grad[volts < 0] == 0.0)


def test_wrong_charges_are_rejected():
    readout = learn.Readout(sensor())
    with pytest.raises(fs.FoveasimError, match="with one column per site"):
        readout.voltage(torch.zeros(3))
    with pytest.raises(fs.FoveasimError, match="'sensor' must be a Sensor"):
        learn.Readout(3)


# -- cameras ---------------------------------------------------------------------------------------------------------------


CAMERAS = {
    "plain": ({}, None),
    "aberrated": ({"zernike": ZERNIKE, "oversample": 2}, None),
    "distorted": ({}, BrownConrady(focal_um=100.0, k1=-0.1, p1=0.01, centre_um=(1.0, 2.0))),
    "fisheye": ({"zernike": ZERNIKE}, PolynomialFisheye(focal_um=80.0, k=(0.01, 0.0, 0.0, 0.0))),
    "gaze": ({}, BrownConrady(focal_um=100.0, k1=-0.1)),
    "turned": ({}, BrownConrady(focal_um=100.0, k1=-0.1)),
}
GAZES = {"gaze": {"gaze_um": (1.3, -0.7)}, "turned": {"gaze_um": (1.3, -0.7), "axis": "sensor"}}


def camera(name):
    optics, distortion = CAMERAS[name]
    return fs.Camera(optics=lens(**optics), sensor=sensor(), distortion=distortion, **GAZES.get(name, {}))


def variables(name):
    optics, distortion = CAMERAS[name]
    return (
        "vertices", "filters", "qe", "exposure_s",
        *(("zernike", "defocus") if "zernike" in optics else ()),
        *(("distortion",) if distortion else ()),
    )  # fmt: skip


@pytest.mark.parametrize("name", CAMERAS)
def test_model_agrees_with_capture(name):
    expected_e, model = learn.capture(camera(name), scene(pitch_um=40.0, n_basis=3), variables(name), exposure_s=0.01)
    capture = camera(name).capture(scene(pitch_um=40.0, n_basis=3), exposure_s=0.01, seed=0)

    np.testing.assert_allclose(expected_e.detach().numpy(), capture.expected_e, rtol=1e-10)
    again = model.camera().capture(scene(pitch_um=40.0, n_basis=3), exposure_s=0.01, seed=0)
    np.testing.assert_array_equal(again.code, capture.code)


PIXEL_OPTICS = {
    "stack": fs.sensor.ApertureStack(height_um=2.0, refractive_index=1.5),
    "microlens": fs.sensor.Microlens(height_um=16.0, refractive_index=1.5, photodiode_inset_um=0.2, crosstalk=True),
}


def with_pixel_optics(name, kind):
    plain = camera(name)
    changed = replace(plain.sensor, pixel_optics=PIXEL_OPTICS[kind])
    return plain.replace(optics=replace(plain.optics, exit_pupil_mm=0.05), sensor=changed)


@pytest.mark.filterwarnings("ignore:the narrowest opening")
@pytest.mark.parametrize("kind", PIXEL_OPTICS)
@pytest.mark.parametrize("name", ["plain", "distorted", "gaze"])
def test_model_collects_light_through_pixel_optics(name, kind):
    light, original = scene(pitch_um=40.0, n_basis=3), with_pixel_optics(name, kind)
    model = learn.Model(original, light, ("filters", "exposure_s"), exposure_s=0.01)
    capture = original.capture(light, exposure_s=0.01, seed=0)
    found = model()
    found.sum().backward()

    np.testing.assert_allclose(found.detach().numpy(), capture.expected_e, rtol=1e-10)
    assert not np.allclose(
        capture.expected_e, camera(name).capture(light, exposure_s=0.01, seed=0).expected_e, rtol=0.01
    )
    assert all(parameter.grad.abs().max() > 0.0 for parameter in model.parameters() if parameter.requires_grad)


@pytest.mark.filterwarnings("ignore:the narrowest opening")
def test_vertices_of_pixel_optics_are_rejected():
    with pytest.raises(fs.FoveasimError, match="'wrt' must not contain 'vertices' for a sensor with pixel optics"):
        learn.Model(with_pixel_optics("plain", "stack"), scene(), ("vertices",), exposure_s=0.01)


@pytest.mark.parametrize("name", CAMERAS)
def test_model_derivatives_agree_with_differences(name):
    """Central differences of captures by the simulator itself, with changed objects."""
    light, h = scene(pitch_um=40.0, n_basis=3), 1e-5
    original = camera(name)
    model = learn.Model(original, light, variables(name), exposure_s=0.01, boundary="free")
    weights = torch.rand(model.mesh.n_sites, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    (model() * weights).sum().backward()

    def total(changed, exposure_s=0.01):
        return float(changed.capture(light, exposure_s=exposure_s, seed=0).expected_e @ weights.numpy())

    def quotient(parameter, index, step):
        found = []
        with torch.no_grad():
            start = parameter.reshape(-1)[index].clone()
            for sign in (1, -1):
                parameter.reshape(-1)[index] = start + sign * step
                found.append(total(model.camera(), float(model.exposure_s)))
            parameter.reshape(-1)[index] = start
        return (found[0] - found[1]) / (2 * step)

    for parameter_name, parameter in model.named_parameters():
        index = parameter.numel() // 3
        relative = 3e-5 if "zernike" in parameter_name or "defocus" in parameter_name else 2e-6
        assert float(parameter.grad.reshape(-1)[index]) == pytest.approx(
            quotient(parameter, index, h), rel=relative, abs=1e-6 * float(parameter.grad.abs().max())
        ), parameter_name


def test_gradient_by_scene_is_adjoint():
    model = learn.Model(camera("plain"), scene(pitch_um=40.0, n_basis=3), (), exposure_s=0.01)
    basis = torch.rand(3, 20, 24, dtype=torch.float64, requires_grad=True)
    weights = torch.rand(model.mesh.n_sites, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((model(basis) * weights).sum(), basis)
    other = torch.rand(3, 20, 24, dtype=torch.float64)

    # Linear without dark signal: <gradient, other> is the result for the other scene.
    assert float((gradient * other).sum()) == pytest.approx(float((model(other) * weights).sum()), rel=1e-10)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"wrt": ("vertex",)}, "did you mean 'vertices'"),
        ({"wrt": ("distortion",)}, "camera without distortion"),
        ({"camera": 3}, "'camera' must be a Camera"),
        ({"scene": 3}, "'scene' must be a Scene"),
    ],
)
def test_wrong_model_arguments_are_rejected(arguments, message):
    valid = {"camera": camera("plain"), "scene": scene(), "wrt": (), "exposure_s": 0.01}
    with pytest.raises(fs.FoveasimError, match=message):
        learn.Model(**{**valid, **arguments})


def test_out_of_range_filters_are_reported():
    model = learn.Model(camera("plain"), scene(), ("filters",), exposure_s=0.01)
    with torch.no_grad():
        model.filters += 3.0
    with pytest.raises(fs.FoveasimError, match="0 to 1"):
        model.camera()


def test_learned_camera_reproduces_expected_charges():
    light = scene(pitch_um=40.0, n_basis=3)
    model = learn.Model(
        camera("aberrated"), light, ("vertices", "zernike", "filters"), exposure_s=0.01, boundary="sliding"
    )
    optimiser = torch.optim.Adam(model.parameters(), lr=0.02)
    for _ in range(3):
        optimiser.zero_grad()
        model().var().backward()
        optimiser.step()
        model.mesh.limit_step()
        with torch.no_grad():
            model.filters.clamp_(0.0, 1.0)
    learned = model.camera()
    capture = replace_precision(learned).capture(light, exposure_s=0.01, seed=0)

    np.testing.assert_allclose(capture.expected_e, model().detach().numpy(), rtol=2e-4)


def replace_precision(camera):
    optics = replace(camera.optics, precision="double")
    return camera.replace(optics=optics)


@pytest.mark.parametrize("order", [1, 2])
def test_distorted_outlines_agree_with_differences(order):
    """Displacements of vertices before the distortion, through the plain integrator."""
    distortion = BrownConrady(focal_um=60.0, k1=-0.08, p1=0.003, centre_um=(0.7, -0.4))
    grid, h, n_compared = fs.Grid((40, 40), 0.8, (-16.0, -16.0)), 1e-4, 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        mesh = learn.Mesh(fs.layout.hexagonal(n_columns=4, n_rows=3, pitch_um=5.0).rotate(7.0), "free")
        points = mesh().detach() + torch.from_numpy(rng.uniform(-0.5, 0.5, (mesh.n_points, 2)))
        layout = mesh.outlines.layout(points)
        pieces = np.ones(mesh.outlines.edges.n_edges, np.int64)
        chords = UndistortedOutlines(layout, distortion, 0.8).count_pieces()
        np.maximum.at(pieces, mesh.outlines.edges.edge, chords)
        outlines, subdivision = mesh.outlines.subdivide(pieces)
        cells, weights = rng.random(grid.shape), rng.uniform(-1.0, 1.0, layout.n_sites)
        points.requires_grad_()
        ideal = learn.undistort(distortion, subdivision(points))
        power = learn.site_power(ideal, torch.from_numpy(cells), outlines, grid, order=order)
        np.testing.assert_allclose(
            power.detach().numpy(), fs.Integrator(layout, grid, distortion=distortion, order=order)(cells), rtol=1e-12
        )
        (power * torch.from_numpy(weights)).sum().backward()

        def total(points, outlines=mesh.outlines, cells=cells, weights=weights):
            moved = outlines.layout(points)
            return float(fs.Integrator(moved, grid, distortion=distortion, order=order)(cells) @ weights)

        scale = float(points.grad.abs().max())
        for point, axis in zip(rng.integers(0, mesh.n_points, 20), rng.integers(0, 2, 20), strict=True):
            slopes = []
            for size in (h, 0.5 * h):
                step = torch.zeros_like(points)
                step[point, axis] = size
                slopes.append((total(points.detach() + step) - total(points.detach() - step)) / (2.0 * size))
            if abs(slopes[0] - slopes[1]) < 1e-8 * scale:  # else an edge passes a corner of cells
                n_compared += 1
                assert abs(slopes[1] - float(points.grad[point, axis])) < 2e-8 * scale

    assert n_compared > 100


def test_models_refuse_scenes_that_are_not_planes():
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=1.0, f_number=2.8),
        sensor=fs.Sensor(fs.layout.grid(n_x=3, n_y=3, pitch_um=4.0)),
    )
    panorama = fs.Scene.from_panorama(np.ones((8, 16)), luminance_cd_m2=100.0)
    size = {"pitch_um": 2000.0, "distance_m": 0.5, "luminance_cd_m2": 100.0}
    deep = fs.Scene.from_rgbd(np.ones((9, 9)), np.full((9, 9), 0.5), **size)
    for scene in (panorama, deep):
        with pytest.raises(ParameterError, match="'scene' must be a plane for"):
            learn.Model(camera, scene, exposure_s=0.01)
