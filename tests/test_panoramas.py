"""Cameras in panoramas: light of photosites beyond 90° against quadrature over directions and closed forms."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.distortion import DoubleSphere, Fisheye, PolynomialFisheye, Scaramuzza
from foveasim.errors import ParameterError

#: Large compared to the PSF, which is not part of the references.
FOCAL_UM, F_NUMBER = 20_000.0, 1.4
PROJECTIONS = ("equidistant", "equisolid", "stereographic")
K1, K4 = -0.05, (-0.02, 0.003, -0.0007, 0.00004)


def polynomial_slope(theta):
    return 1.0 - 0.06 * theta**2


def double_sphere(t):
    d2 = np.sqrt(np.sin(t) ** 2 + (-0.2 + np.cos(t)) ** 2)
    return 0.8 * np.sin(t) / (0.6 * d2 + 0.4 * (-0.2 + np.cos(t)))


def quadratic(t):
    c = 1.0 / np.tan(t)
    return 2.0 / (c + np.sqrt(c * c + 1.2))


#: Lens models, their image height in focal lengths and its derivative, as functions of the angle, and the largest angle.
LENSES = {
    "95 degrees": (
        fs.distortion.BrownConrady(k1=K1, focal_um=FOCAL_UM),
        lambda t: np.tan(t) * (1.0 + K1 * np.tan(t) ** 2),
        lambda t: (1.0 + 3.0 * K1 * np.tan(t) ** 2) / np.cos(t) ** 2,
        47.5,
    ),
    "110 degrees": (
        PolynomialFisheye(k=K4, focal_um=FOCAL_UM),
        lambda t: t * (1.0 + K4[0] * t**2 + K4[1] * t**4 + K4[2] * t**6 + K4[3] * t**8),
        lambda t: 1.0 + 3.0 * K4[0] * t**2 + 5.0 * K4[1] * t**4 + 7.0 * K4[2] * t**6 + 9.0 * K4[3] * t**8,
        55.0,
    ),
    "polynomial": (
        PolynomialFisheye(k=(-0.02, 0.0, 0.0, 0.0), focal_um=FOCAL_UM),
        lambda t: t - 0.02 * t**3,
        polynomial_slope,
        92.5,
    ),
    "double_sphere": (
        DoubleSphere(xi=-0.2, alpha=0.6, focal_um=FOCAL_UM),
        double_sphere,
        lambda t: (double_sphere(t + 1e-6) - double_sphere(t - 1e-6)) / 2e-6,
        105.0,
    ),
    "scaramuzza": (
        Scaramuzza(a=(200.0, -0.0015, 0.0, 0.0), pixel_um=100.0, focal_um=FOCAL_UM),
        # The ray (r, f(r)) with f(r) = 1 - 0.3 r², in focal lengths: r² 0.3 + r cot θ - 1 = 0.
        quadratic,
        lambda t: (quadratic(t + 1e-6) - quadratic(t - 1e-6)) / 2e-6,
        110.0,
    ),
}


def layout_of(kind, radius_um):
    if kind == "log_polar":
        return fs.layout.log_polar(n_sectors=24, r_min_um=0.15 * radius_um, r_max_um=radius_um)
    pitch_um = radius_um / 6.0
    if kind == "hexagonal":
        whole = fs.layout.hexagonal(n_columns=14, n_rows=14, pitch_um=pitch_um)
    else:
        whole = fs.layout.grid(n_x=12, n_y=12, pitch_um=pitch_um)
    farthest_um = np.maximum.reduceat(np.hypot(*whole.xy_um.T), whole.ring_offsets[whole.site_offsets[:-1]])
    return whole[farthest_um < radius_um]


def radiance(x, y, z):
    return 1.0 + 0.3 * x + 0.25 * y * z + 0.2 * x * x - 0.15 * y


def panorama(function, n_y, **options):
    elevation, azimuth = np.meshgrid(
        (0.5 - (np.arange(n_y) + 0.5) / n_y) * math.pi,
        ((np.arange(2 * n_y) + 0.5) / n_y - 1.0) * math.pi,
        indexing="ij",
    )
    cosine = np.cos(elevation)
    picture = function(cosine * np.sin(azimuth), np.sin(elevation), cosine * np.cos(azimuth))
    return fs.Scene.from_panorama(
        picture,
        peak_radiance_w_m2_sr_nm=1.0,
        wavelength_nm=[550.0],
        band_width_nm=1.0,
        encoding="linear",
        **options,
    )


def quadrature(layout, height, slope, largest_deg, function, n=12):
    """
    Return ``∫ L dΩ`` over each site by Gauss quadrature on triangles of its outline on the sensor.

    With image height h(θ) in focal lengths, ``dΩ = sin θ / (h h') dA``.
    """
    node, weight = np.polynomial.legendre.leggauss(n)
    node, weight = 0.5 + 0.5 * node, 0.5 * weight
    found = np.zeros(layout.n_sites)
    for site in range(layout.n_sites):
        ring = layout.site_offsets[site]
        a = layout.xy_um[layout.ring_offsets[ring] : layout.ring_offsets[ring + 1]] / FOCAL_UM
        b, c = np.roll(a, -1, axis=0), a.mean(axis=0)
        # The square (u, v) maps to the triangle c + u ((a - c) + v (b - a)), of Jacobian u times twice its area.
        u, v = node[:, np.newaxis], node[np.newaxis, :]
        at = c + u[..., np.newaxis, np.newaxis] * ((a - c) + v[..., np.newaxis, np.newaxis] * (b - a))
        cross = (a - c)[:, 0] * (b - a)[:, 1] - (a - c)[:, 1] * (b - a)[:, 0]
        area = (weight[:, np.newaxis] * node[:, np.newaxis] * weight)[..., np.newaxis] * cross
        r = np.hypot(at[..., 0], at[..., 1])
        theta = angles(r, height, slope, largest_deg)
        sine = np.sin(theta)
        value = function(sine * at[..., 0] / r, sine * at[..., 1] / r, np.cos(theta)) * sine / (r * slope(theta))
        found[site] = (value * area).sum()
    return found


def angles(r, height, slope, largest_deg):
    """Return the angles at image heights, by Newton's method."""
    table = np.linspace(1e-4, math.radians(largest_deg + 0.5), 20001)
    theta = np.interp(r, height(table), table)
    for _ in range(3):
        theta = theta - (height(theta) - r) / slope(theta)
    return theta


def uniform_light(layout, height, slope, largest_deg, tilt):
    """
    Return ``∫ T dΩ`` over each site of one ring, from the closed forms of sectors.

    By Green's theorem it is ``∮ G dφ`` along the outline on the sensor, where a sector from the axis to the angle θ has the
    light ``G = 1 - cos θ`` per azimuth, or ``sin² θ / 2`` behind a flat pupil, constant beyond 90°.
    """
    node, weight = np.polynomial.legendre.leggauss(24)
    found = np.zeros(layout.n_sites)
    for site in range(layout.n_sites):
        ring = layout.site_offsets[site]
        a = layout.xy_um[layout.ring_offsets[ring] : layout.ring_offsets[ring + 1]] / FOCAL_UM
        along = np.roll(a, -1, axis=0) - a
        at = a[:, np.newaxis] + (0.5 + 0.5 * node)[:, np.newaxis] * along[:, np.newaxis]
        r = np.hypot(at[..., 0], at[..., 1])
        theta = angles(r, height, slope, largest_deg)
        inner = 1.0 - np.cos(theta) if tilt == "turning" else 0.5 * np.sin(np.minimum(theta, 0.5 * math.pi)) ** 2
        turning = (at[..., 0] * along[:, np.newaxis, 1] - at[..., 1] * along[:, np.newaxis, 0]) / r**2
        found[site] = (inner * turning * 0.5 * weight).sum()
    return found


def optics(f_number=F_NUMBER, **options):
    return fs.Optics(
        focal_length_mm=FOCAL_UM / 1000.0, f_number=f_number, lens="aplanatic", precision="double", **options
    )


def power_over_radiance(lens, layout, scene, **options):
    """Return the power of each site over the area of the pupil times the radiance, sr."""
    sensor = fs.Sensor(layout)
    camera = fs.Camera(optics=optics(**options), sensor=sensor, distortion=lens, order=2)
    rate = camera.photoelectrons_per_s(scene) / sensor.responsivity_e_per_j(scene.wavelength_nm)[0, 0]
    return rate / (math.pi * (0.5e-6 * FOCAL_UM / camera.optics.f_number) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["log_polar", "hexagonal", "grid"])
@pytest.mark.parametrize("name", LENSES)
def test_smooth_panorama_equals_quadrature_over_directions(name, kind):
    lens, height, slope, angle_deg = LENSES[name]
    layout = layout_of(kind, FOCAL_UM * float(height(np.array(math.radians(angle_deg)))))
    expected = quadrature(layout, height, slope, angle_deg, radiance)
    scene = panorama(radiance, 1024, cells=1024)
    projections = PROJECTIONS if angle_deg > 80.0 else ("rectilinear", "orthographic", *PROJECTIONS)
    errors = [
        power_over_radiance(lens, layout, scene, projection=projection, pupil_tilt="turning") / expected - 1.0
        for projection in projections
    ]
    assert np.abs(errors).max() < 1e-4
    # The intermediate projection changes results by less than this.
    assert np.ptp(errors, axis=0).max() < 1e-4


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("tilt", ["turning", "flat"])
@pytest.mark.parametrize(
    ("name", "kind", "projection"),
    [
        ("polynomial", "log_polar", "auto"),
        ("polynomial", "hexagonal", "stereographic"),
        ("95 degrees", "log_polar", "orthographic"),
        ("110 degrees", "grid", "equidistant"),
        ("double_sphere", "grid", "auto"),
        ("scaramuzza", "log_polar", "equisolid"),
    ],
)
def test_uniform_panorama_gives_closed_forms_of_sectors(name, kind, projection, tilt):
    lens, height, slope, angle_deg = LENSES[name]
    layout = layout_of(kind, FOCAL_UM * float(height(np.array(math.radians(angle_deg)))))
    scene = panorama(lambda x, y, z: np.ones_like(x), 16, cells=1024)
    expected = uniform_light(layout, height, slope, angle_deg, tilt)
    # Diffraction moves light in proportion to λN: linear extrapolation from two f-numbers leaves geometric optics.
    found, blurred = (
        power_over_radiance(lens, layout, scene, f_number=n * F_NUMBER, projection=projection, pupil_tilt=tilt)
        for n in (1.0, 2.0)
    )
    found = 2.0 * found - blurred
    np.testing.assert_allclose(found, expected, rtol=1e-6 if tilt == "turning" else 0.0, atol=1e-6 * expected.max())


@pytest.mark.slow
def test_hemisphere_and_sphere_have_closed_forms():
    """A site of the whole field of 90° collects π for a flat pupil and 2π for one that turns."""
    angle = 2.0 * math.pi * np.arange(720) / 720
    # The polygon has the area of the circle.
    radius_um = 0.5 * math.pi * FOCAL_UM * math.sqrt(2.0 * math.pi / (720 * math.sin(2.0 * math.pi / 720)))
    circle = fs.Layout.from_polygons([radius_um * np.stack((np.cos(angle), np.sin(angle)), axis=1)])
    lens = Fisheye(projection="equidistant", focal_um=FOCAL_UM)
    scene = panorama(lambda x, y, z: np.ones_like(x), 16, cells=1024)
    assert power_over_radiance(lens, circle, scene, pupil_tilt="flat")[0] == pytest.approx(math.pi, rel=2e-5)
    assert power_over_radiance(lens, circle, scene)[0] == pytest.approx(2.0 * math.pi, rel=2e-5)


def test_camera_chooses_the_nearest_projection():
    scene = panorama(radiance, 32)
    layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=FOCAL_UM / 4.0)
    chosen = {}
    for name, lens in {
        **{projection: Fisheye(projection=projection, focal_um=FOCAL_UM) for projection in PROJECTIONS},
        "unified": fs.distortion.Omnidirectional(xi=1.0, focal_um=FOCAL_UM),
        "nearly ideal": fs.distortion.BrownConrady(k1=-0.001, focal_um=FOCAL_UM),
    }.items():
        camera = fs.Camera(optics=optics(), sensor=fs.Sensor(layout), distortion=lens)
        chosen[name] = camera.projection(scene)
    assert chosen == {
        "equidistant": "equidistant",
        "equisolid": "equisolid",
        "stereographic": "stereographic",
        "unified": "stereographic",
        "nearly ideal": "rectilinear",
    }
    plane = fs.Scene.flat(shape=(8, 8), pitch_um=100.0, distance_m=1.0, luminance_cd_m2=1.0)
    camera = fs.Camera(optics=optics(), sensor=fs.Sensor(layout), distortion=lens)
    assert camera.projection(plane) == camera.projection(camera.fit_scene(plane)) == "rectilinear"


def test_rectilinear_panorama_equals_photograph_of_a_plane():
    """A plane in front of a lens, as a panorama: the same light with the law of the fourth power of the cosine."""
    layout = fs.layout.grid(n_x=6, n_y=6, pitch_um=FOCAL_UM / 8.0)
    n, half = 400, 0.6
    at = (np.arange(n) + 0.5 - 0.5 * n) * 2.0 * half / n
    x, y = np.meshgrid(at, at[::-1])
    norm = np.sqrt(1.0 + x * x + y * y)
    plane = fs.Scene.from_picture(
        radiance(x / norm, y / norm, 1.0 / norm),
        pitch_um=2.0 * half / n * 1e6 * 1e6,
        distance_m=1e6,
        peak_radiance_w_m2_sr_nm=1.0,
        wavelength_nm=[550.0],
        band_width_nm=1.0,
        encoding="linear",
    )
    expected = power_over_radiance(None, layout, plane)
    found = power_over_radiance(None, layout, panorama(radiance, 1024, cells=400))
    np.testing.assert_allclose(found, expected, rtol=3e-4)


@pytest.mark.parametrize("projection", [*PROJECTIONS, "orthographic"])
def test_ideal_projection_needs_no_lens_model(projection):
    """``Optics(projection=...)`` without a lens model has the image of an ideal lens."""
    layout = fs.layout.grid(n_x=6, n_y=6, pitch_um=FOCAL_UM / 6.0)
    scene = panorama(radiance, 512, cells=512)
    lens = Fisheye(projection=projection, focal_um=FOCAL_UM)
    of_model = power_over_radiance(lens, layout, scene, projection="equidistant", pupil_tilt="turning")
    ideal = power_over_radiance(None, layout, scene, projection=projection, pupil_tilt="turning")
    np.testing.assert_allclose(ideal, of_model, rtol=1e-4)


def test_images_of_panoramas_are_upright():
    """The picture shows what is to the right on the right, and what is above at the top, beyond 90° too."""
    lens = Fisheye(projection="equidistant", focal_um=FOCAL_UM)
    angle_um = FOCAL_UM * math.radians(100.0)
    layout = fs.Layout.from_rectangles(angle_um * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]), 500.0)
    sides = {"right": lambda x, y, z: 1.0 * (x > 0.8), "left": lambda x, y, z: 1.0 * (x < -0.8)}
    sides |= {"top": lambda x, y, z: 1.0 * (y > 0.8), "bottom": lambda x, y, z: 1.0 * (y < -0.8)}
    for k, side in enumerate(sides.values()):
        seen = power_over_radiance(lens, layout, panorama(side, 64, cells=256))
        assert seen.argmax() == k
        assert seen[k] > 1e3 * np.delete(seen, k).max()
    # A camera that turns to the right sees there what is behind it.
    behind = panorama(lambda x, y, z: 1.0 * (z < -0.8), 64, cells=256)
    assert power_over_radiance(lens, layout, behind.turned(yaw_deg=90.0)).argmax() == 0


def test_turning_gaze_sees_direction_of_point():
    """With ``axis="sensor"``, the centre of the sensor receives the light that the gaze has without turning."""
    lens = Fisheye(projection="equisolid", focal_um=FOCAL_UM)
    layout = fs.layout.grid(n_x=2, n_y=2, pitch_um=FOCAL_UM)
    gaze_um = (900.0, -16_000.0)
    direction = lens.direction([gaze_um])[0]
    scene = panorama(radiance, 512, cells=512)
    camera = fs.Camera(optics=optics(), sensor=fs.Sensor(layout), distortion=lens, gaze_um=gaze_um, axis="sensor")
    turned = camera.light_at_gaze(scene)
    n_y, n_x = turned.basis.shape[1:]
    centre = turned.basis[0, n_y // 2 - 1 : n_y // 2 + 1, n_x // 2 - 1 : n_x // 2 + 1].mean()
    assert centre == pytest.approx(radiance(*direction), abs=2e-3)
    assert camera.light_at_gaze(scene) is turned  # resampled once


def test_tiles_and_video_equal_captures():
    lens, height, _, angle_deg = LENSES["polynomial"]
    layout = layout_of("log_polar", FOCAL_UM * float(height(np.array(math.radians(angle_deg)))))
    sensor = fs.Sensor.from_preset(layout, "machine_vision")
    camera = fs.Camera(optics=optics(), sensor=sensor, distortion=lens)
    scene = panorama(radiance, 64)
    capture = camera.capture(scene, exposure_s="auto", seed=0)
    seconds = capture.settings["exposure_s"]
    assert capture.settings["light"]["projection"] == camera.projection(scene)
    assert (capture.code > 0).all()  # also beyond 90°
    tiles = list(fs.tiles.capture_tiles(camera, scene, exposure_s=seconds, seed=0, tile_sites=256))
    np.testing.assert_allclose(np.concatenate([tile.expected_e for tile in tiles]), capture.expected_e, rtol=1e-9)
    video = list(camera.video([scene, scene.turned(yaw_deg=40.0)], exposure_s=seconds, seed=0))
    np.testing.assert_array_equal(video[0].code, capture.code)
    turned = camera.photoelectrons_per_s(scene.turned(yaw_deg=40.0))
    np.testing.assert_allclose(video[1].expected_e, camera.sensor.expected_electrons(turned, seconds))
    mean, _ = camera.predict(scene, exposure_s=seconds)
    assert np.abs(mean - capture.code).mean() < 5.0


def test_isotropic_points_require_a_plane():
    with pytest.raises(ParameterError, match="'emission' must be 'lambertian' for the equisolid projection"):
        fs.Optics(focal_length_mm=8.0, f_number=2.0, projection="equisolid", emission="isotropic")
    lens = Fisheye(projection="equidistant", focal_um=FOCAL_UM)
    camera = fs.Camera(
        optics=replace(optics(), emission="isotropic"),
        sensor=fs.Sensor(fs.layout.grid(n_x=4, n_y=4, pitch_um=5000.0)),
        distortion=lens,
    )
    with pytest.raises(ParameterError, match="'emission' must be 'lambertian' for the equidistant projection"):
        camera.photoelectrons_per_s(panorama(radiance, 64))


def test_power_maps_keep_the_projection(tmp_path):
    lens = Fisheye(projection="equisolid", focal_um=FOCAL_UM)
    sensor = fs.Sensor(fs.layout.grid(n_x=6, n_y=6, pitch_um=8000.0))
    camera = fs.Camera(optics=optics(), sensor=sensor, distortion=lens)
    scene = panorama(radiance, 64)
    power_map = camera.power_map(scene)
    assert power_map.projection == camera.projection(scene) == camera.projection(power_map) == "equisolid"
    expected = camera.photoelectrons_per_s(scene)
    np.testing.assert_allclose(camera.photoelectrons_per_s(power_map), expected, rtol=1e-12)
    with pytest.raises(ParameterError, match="'power_map' must be rectilinear for a file, got an equisolid image"):
        fs.write_power_map(power_map, tmp_path / "map.npz")
    with pytest.raises(ParameterError, match="'power_map' must be rectilinear, got an equisolid image"):
        fs.distortion.distort_map(power_map, lens)


def test_photographs_of_planes_require_a_lens_model():
    plane = fs.Scene.flat(shape=(64, 64), pitch_um=1e5, distance_m=10.0, luminance_cd_m2=1.0)
    camera = fs.Camera(optics=optics(projection="equidistant"), sensor=fs.Sensor(fs.layout.grid(4, 4, 100.0)))
    with pytest.raises(
        ParameterError, match="'distortion' must be given for a photograph of a plane in the equidistant"
    ):
        camera.photoelectrons_per_s(plane)
    # With a model, the projection of the intermediate image of a plane remains rectilinear.
    lens = Fisheye(projection="equidistant", focal_um=FOCAL_UM)
    found, expected = (
        fs.Camera(optics=each, sensor=camera.sensor, distortion=lens).photoelectrons_per_s(plane)
        for each in (camera.optics, optics())
    )
    np.testing.assert_array_equal(found, expected)


def test_psfs_of_designs_blur_panoramas():
    """Blur of a Gaussian PSF keeps equal radiances and the light of a sky, and removes its fine waves."""
    x_um = (np.arange(49) - 24.0) * 0.5
    psf = np.exp(-(x_um[:, None] ** 2 + x_um**2) / (2.0 * 2.0**2))
    psfs = fs.optics.PSFGrid(
        psf=psf[None, None],
        x_um=np.zeros(1),
        y_um=np.zeros(1),
        wavelength_nm=np.array([550.0]),
        pitch_um=0.5,
        centre=(24.0, 24.0),
    )
    waves = 1.0 + np.cos(360.0 * np.linspace(-np.pi, np.pi, 2880, endpoint=False)) * np.ones((1440, 1))
    sensor = fs.Sensor(fs.layout.grid(n_x=40, n_y=40, pitch_um=3.0))
    found = {}
    for name, sky in (("equal", np.ones((64, 128))), ("waves", waves)):
        scene = fs.Scene.from_panorama(sky, luminance_cd_m2=100.0)
        for own in (None, psfs):
            optics = fs.Optics(focal_length_mm=0.4, f_number=2.0, psfs=own)
            camera = fs.Camera(
                optics=optics, sensor=sensor, distortion=Fisheye(projection="equidistant", focal_um=400.0)
            )
            found[name, own is None] = camera.capture(scene, exposure_s=0.01, seed=0).expected_e.reshape(40, 40)
    inner = np.s_[8:-8, 8:-8]

    np.testing.assert_allclose(found["equal", False][inner], found["equal", True][inner], rtol=1e-3)
    assert found["waves", False][inner].sum() == pytest.approx(found["waves", True][inner].sum(), rel=0.03)
    assert found["waves", False][inner].std() < 0.25 * found["waves", True][inner].std()


def test_fisheye_photograph_and_its_panorama_agree():
    """A photograph of an equirectangular panorama by a calibrated lens, seen by another camera."""
    n, pixel_um = 801, 60.0
    lens = fs.distortion.from_opencv(
        [[330.0, 0.0, 402.0], [0.0, 330.0, 398.5], [0.0, 0.0, 1.0]],
        [-0.02, 0.003, -0.0007, 0.00004],
        image_size=(n, n),
        pixel_um=pixel_um,
        fisheye=True,
    )
    x, y = np.meshgrid((np.arange(n) - 0.5 * (n - 1)) * pixel_um, (0.5 * (n - 1) - np.arange(n)) * pixel_um)
    d = lens.direction(np.stack((x, y), axis=-1), outside="mask")
    options = {"peak_radiance_w_m2_sr_nm": 1.0, "wavelength_nm": [550.0], "band_width_nm": 1.0, "encoding": "linear"}
    photograph = fs.Scene.from_panorama(
        np.nan_to_num(radiance(*np.moveaxis(d, -1, 0))),
        mapping="fisheye",
        lens=lens,
        pixel_um=pixel_um,
        cells=512,
        **options,
    )
    layout = fs.layout.grid(n_x=6, n_y=6, pitch_um=FOCAL_UM / 5.0)
    model = Fisheye(projection="stereographic", focal_um=FOCAL_UM)
    expected = power_over_radiance(model, layout, panorama(radiance, 512, cells=512))
    np.testing.assert_allclose(power_over_radiance(model, layout, photograph), expected, rtol=5e-4)


def test_frames_of_panoramas_keep_the_orientation(tmp_path):
    """A folder of pictures with a panorama as template is a video of panoramas."""
    from PIL import Image

    random = np.random.default_rng(2)
    for k in range(2):
        Image.fromarray(random.integers(0, 255, (16, 32), np.uint8)).save(tmp_path / f"{k}.png")
    template = fs.Scene.from_panorama(np.ones((16, 32)), luminance_cd_m2=300.0, pitch_deg=-20.0)
    frames = list(fs.video.FrameSource(tmp_path, template=template))
    expected = fs.Scene.from_panorama(tmp_path / "1.png", luminance_cd_m2=300.0, pitch_deg=-20.0)
    assert frames[1].panorama == expected.panorama
    camera = fs.Camera(
        optics=optics(),
        sensor=fs.Sensor(fs.layout.grid(4, 4, 8000.0)),
        distortion=Fisheye(projection="equidistant", focal_um=FOCAL_UM),
    )
    np.testing.assert_allclose(camera.photoelectrons_per_s(frames[1]), camera.photoelectrons_per_s(expected), rtol=1e-6)


def test_own_lens_models_image_panoramas():
    """A model without directions images the field in front of the lens."""

    class Magnifier:
        focal_um, centre_um = FOCAL_UM, (0.0, 0.0)

        def distort(self, xy_um, *, outside="error"):
            return 1.25 * np.asarray(xy_um)

        def undistort(self, xy_um, *, outside="error"):
            return np.asarray(xy_um) / 1.25

    layout = fs.layout.grid(4, 4, 6000.0)
    scene = panorama(radiance, 256, cells=256)
    found = {
        projection: power_over_radiance(Magnifier(), layout, scene, projection=projection, pupil_tilt="flat")
        for projection in ("auto", "rectilinear", "equidistant")
    }
    np.testing.assert_array_equal(found["auto"], found["rectilinear"])
    np.testing.assert_allclose(found["equidistant"], found["rectilinear"], rtol=5e-4)


def test_outlines_around_the_back_pole_are_dark():
    """The direction opposite to the axis is a circle on the sensor; a site that contains it is outside the field."""
    angle = 2.0 * math.pi * np.arange(64) / 64
    circle = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    disc, around = 1.02 * math.pi * FOCAL_UM * circle, fs.layout.grid(4, 4, 8000.0)
    lens, scene = Fisheye(projection="equidistant", focal_um=FOCAL_UM), panorama(radiance, 64, cells=64)
    whole = fs.Layout.from_polygons([disc])
    with pytest.raises(
        ParameterError, match="'fit' must be used with a layout that has photosites in the image circle"
    ):
        power_over_radiance(lens, whole, scene)
    mixed = fs.Layout.from_polygons([*around.polygons(), shapely.Polygon(disc, [0.9 * disc])])
    with pytest.warns(fs.errors.CoverageWarning, match=r"1 of 17 photosites lie outside the image circle"):
        found = power_over_radiance(lens, mixed, scene)
    assert found[-1] == 0.0
    assert found[:-1].min() > 0.0


def test_oblique_chief_rays_cause_a_warning():
    stack = fs.sensor.ApertureStack(height_um=4.0, refractive_index=1.5)
    scene = panorama(radiance, 64, cells=64)
    lens = Fisheye(projection="equidistant", focal_um=FOCAL_UM)
    sensor = fs.Sensor(fs.layout.grid(8, 8, 7000.0), pixel_optics=stack)
    with pytest.warns(fs.errors.FoveasimWarning, match=r"chief rays reach the sensor at up to 60.*exit_pupil_mm"):
        fs.Camera(optics=optics(), sensor=sensor, distortion=lens).photoelectrons_per_s(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        far = fs.Camera(optics=optics(exit_pupil_mm=100.0), sensor=sensor, distortion=lens)
        far.photoelectrons_per_s(scene)
