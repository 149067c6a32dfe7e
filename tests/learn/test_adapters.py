"""Sensor layers in deepinv, torchvision and ONNX."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch

import foveasim as fs
from foveasim import learn
from tests.learn.test_layer import CAMERAS, EXPOSURE_S, SHAPE, camera, scene


def layer(**changes):
    options = {name: changes.pop(name) for name in ("encoding", "noise", "output") if name in changes}
    return learn.SensorLayer(camera(**changes), scene(), exposure_s=EXPOSURE_S, **options)


# -- deepinv ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["aberrated", "mixing", "dark", "pixel optics"])
def test_physics_is_linear_and_adjoint(name):
    pytest.importorskip("deepinv")
    problem = learn.physics(layer(**CAMERAS[name]))
    for dtype, limit in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        x, other = torch.randn(2, 2, 3, *SHAPE, dtype=dtype)
        y = torch.randn(2, problem.layer.n_sites, dtype=dtype)
        product = float((problem.A(x) * y).sum())
        scale = float(problem.A(x).norm() * y.norm())
        assert abs(product - float((x * problem.A_adjoint(y)).sum())) < limit * scale
        difference = problem.A(x + 2.0 * other) - problem.A(x) - 2.0 * problem.A(other)
        assert float(difference.norm()) < 10.0 * limit * float(problem.A(x).norm())
    assert float(problem.A(torch.ones(1, 3, *SHAPE)).max()) == pytest.approx(1.0)
    assert float(problem.adjointness_test(torch.rand(1, 3, *SHAPE))) < 1e-4


def test_physics_has_noise_of_sensor():
    pytest.importorskip("deepinv")
    problem = learn.physics(layer(**CAMERAS["dark"]), generator=torch.Generator().manual_seed(0))
    picture = torch.rand(1, 3, *SHAPE, dtype=torch.float64)
    expected = problem.A(picture)[0]
    drawn = problem.noise(problem.A(picture).expand(3000, -1))
    readout = problem.layer.readout
    variance = readout.variance_e2(problem.layer.light_e(picture, with_dark=True)[0]) / problem.unit_e**2

    assert float(((drawn.mean(dim=0) - expected) / (variance / 3000).sqrt()).abs().max()) < 5.0
    torch.testing.assert_close(drawn.var(dim=0), variance, rtol=0.15, atol=0.0)
    again = learn.physics(problem.layer, generator=torch.Generator().manual_seed(0))
    assert torch.equal(again(picture, seed=3), again(picture, seed=3))


def test_least_squares_reproduce_readings():
    pytest.importorskip("deepinv")
    problem = learn.physics(layer(), max_iter=200, tol=1e-6)
    picture = torch.rand(1, 3, *SHAPE, dtype=torch.float64)
    readings = problem.A(picture)
    found = problem.A_dagger(readings)

    assert float((problem.A(found) - readings).norm()) < 1e-3 * float(readings.norm())


def test_adapters_can_be_pickled_after_use():
    pytest.importorskip("deepinv")
    problem, picture = learn.physics(layer(), max_iter=30), torch.rand(1, 3, *SHAPE)
    readings = problem.A(picture)
    again = pickle.loads(pickle.dumps(problem))
    assert again.max_iter == 30
    assert torch.equal(again.A(picture), readings)
    change = learn.transform(layer(output="expected"))
    assert torch.equal(pickle.loads(pickle.dumps(change))(picture[0]), change(picture[0]))


def test_physics_rejects_encoded_pictures():
    with pytest.raises(fs.FoveasimError, match="must have linear encoding, got 'srgb'; decode pictures first"):
        learn.physics(layer(encoding="srgb"))


# -- torchvision ------------------------------------------------------------------------------------------------------------


def test_transform_replaces_images_only():
    v2 = pytest.importorskip("torchvision.transforms.v2")
    from PIL import Image
    from torchvision import tv_tensors

    sensor = layer(encoding="srgb", output="expected")
    values = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), np.uint8)
    expected = sensor(torch.from_numpy(values).movedim(-1, 0) / 255.0)
    chain = v2.Compose([v2.RandomHorizontalFlip(p=0.0), learn.transform(sensor)])
    for image in (Image.fromarray(values), tv_tensors.Image(torch.from_numpy(values).movedim(-1, 0))):
        found, label = chain(image, 3)
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-3)
        assert label == 3
        assert type(found) is torch.Tensor
    boxes = tv_tensors.BoundingBoxes([[1, 2, 3, 4]], format="XYXY", canvas_size=SHAPE)
    assert torch.equal(chain({"image": Image.fromarray(values), "boxes": boxes})["boxes"], boxes)


# -- other runtimes ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("name", ["aberrated", "distorted", "modes", "mixing", "converter"])
def test_layer_can_be_exported(name):
    """The exported program has the batch size as a variable, and the same results."""
    original = layer(**CAMERAS[name], noise=False)
    pictures = torch.rand(3, 3, *SHAPE)
    expected = original(pictures)
    with torch.no_grad():
        program = torch.export.export(original, (pictures,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    for n in (3, 2):
        torch.testing.assert_close(program.module()(pictures[:n]), expected[:n], rtol=0, atol=1.0)
        assert float((program.module()(pictures[:n]) != expected[:n]).float().mean()) < 0.02
    # The layer itself is unchanged.
    assert torch.equal(original(pictures), expected)


def test_layer_runs_in_onnx(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    original = layer(**CAMERAS["mixing"], noise=False).eval()
    pictures = torch.rand(3, 3, *SHAPE)
    path = tmp_path / "sensor.onnx"
    with torch.no_grad():
        program = torch.onnx.export(
            original, (pictures,), dynamo=True, dynamic_shapes=({0: torch.export.Dim("batch")},), verbose=False
        )
    program.save(path)
    session = onnxruntime.InferenceSession(path)
    (found,) = session.run(None, {session.get_inputs()[0].name: pictures[:2].numpy()})

    difference = np.abs(found - original(pictures[:2]).numpy())
    assert difference.max() <= 1.0
    assert (difference > 0.0).mean() < 0.02


# -- FOVI -------------------------------------------------------------------------------------------------------------------


def test_samples_of_fovi_become_sites():
    coords = pytest.importorskip("fovi.sensing.coords", exc_type=ImportError).SamplingCoords(
        fov=16.0, cmf_a=0.5, res=20
    )
    layout = learn.from_fovi(coords, radius_um=100.0)
    # The generator of this package has the same law.
    own = fs.layout.fovi(fov_um=200.0, a_um=100.0 * 0.5 / 8.0, n_rings=19)

    assert layout.n_sites == len(coords.cartesian) == own.n_sites
    found = np.stack((layout.columns["sample_x_um"], layout.columns["sample_y_um"]), axis=1)
    np.testing.assert_allclose(np.sort(np.hypot(*found.T)), np.sort(np.hypot(*own.centroid_um.T)), atol=2.0)
    torch.testing.assert_close(learn.to_fovi(layout, radius_um=100.0), coords.cartesian.float())


def test_samples_lie_in_their_sites():
    samples = 0.9 * torch.tanh(torch.randn(60, 2, generator=torch.Generator().manual_seed(0)))
    layout = learn.from_fovi(samples, radius_um=50.0)
    import shapely

    inside = shapely.contains(layout.polygons(), shapely.points(50.0 * samples.numpy()))
    assert inside.all()
    torch.testing.assert_close(learn.to_fovi(layout, radius_um=50.0), samples)
    np.testing.assert_allclose(layout.area_um2.sum(), np.pi * layout.provenance["radius_um"] ** 2, rtol=1e-4)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (np.zeros(5), "'samples'"),
        (np.zeros((5, 3)), r"\(n_site, 2\)"),
        (np.full((5, 2), np.nan), "'samples' must be finite"),
        (np.zeros((5, 2)), "'samples' must be at different positions"),
        (np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.0], [1.0, 0.0]]), "'samples' must be at different positions"),
    ],
)
def test_wrong_samples_are_rejected(samples, message):
    with pytest.raises(fs.FoveasimError, match=message):
        learn.from_fovi(samples, radius_um=1.0)
