"""Log-polar images: one pixel per site on rings, resampling as in OpenCV, and back."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.reconstruct import CorticalImage, Picture, cortical, from_cortical, to_cortical


def ringed(**options):
    return fs.layout.log_polar(
        **{"n_sectors": 25, "r_min_um": 10.0, "r_max_um": 80.0, "n_rings": 9, "chords_per_arc": 4, **options}
    )


def picture_of(plane, pitch_um=1.0, origin_um=None):
    n_y, n_x = plane.shape
    origin = (-0.5 * n_x * pitch_um, -0.5 * n_y * pitch_um) if origin_um is None else origin_um
    grid = fs.Grid(plane.shape, pitch_um, origin)
    return Picture(np.asarray(plane, np.float32)[np.newaxis], np.ones(plane.shape, np.float32), grid)


@pytest.mark.parametrize("stagger", [False, True])
@pytest.mark.parametrize("fovea", ["none", "rings"])
def test_rings_have_one_pixel_per_site(stagger, fovea):
    layout = ringed(stagger=stagger, fovea=fovea).translate(3.0, -7.0)
    layout = layout[np.random.default_rng(0).permutation(layout.n_sites)]
    values = np.arange(layout.n_sites, dtype=float)

    image = cortical(layout, values)

    assert image.data.shape == (1, 9, 25)
    assert np.unique(image.sites).size == 9 * 25
    np.testing.assert_allclose(image.centre_um, (3.0, -7.0), atol=1e-9)
    np.testing.assert_allclose(image.radius_um, np.geomspace(10.0, 80.0, 10), rtol=1e-9)
    np.testing.assert_allclose(image.start_rad[1::2], np.pi / 25 if stagger else 0.0, atol=1e-9)
    np.testing.assert_array_equal(image.data[0], values[image.sites])
    # Sites in the direction of each pixel.
    angle = image.start_rad[:, np.newaxis] + (np.arange(25) + 0.5) * 2.0 * np.pi / 25
    r_um = image.ring_centre_um[:, np.newaxis]
    points = shapely.points(3.0 + r_um * np.cos(angle), -7.0 + r_um * np.sin(angle))
    assert shapely.contains(layout.polygons()[image.sites], points).all()


def test_site_values_are_inverse():
    layout = ringed(fovea="rings")
    values = np.random.default_rng(1).uniform(size=(2, layout.n_sites))

    image = cortical(layout, values)
    back = image.site_values(layout.n_sites)

    used = np.isin(np.arange(layout.n_sites), image.sites)
    np.testing.assert_array_equal(back[:, used], values[:, used])
    assert np.isnan(back[:, ~used]).all()
    assert (~used).sum() == layout.n_sites - 9 * 25 > 0


@pytest.mark.parametrize("stagger", [False, True])
def test_nearest_picture_shows_the_sites(stagger):
    layout = ringed(stagger=stagger, chords_per_arc=16)
    values = np.arange(layout.n_sites, dtype=float)
    grid = fs.Grid.centred((90, 90), 2.0)

    found = from_cortical(cortical(layout, values), grid, method="nearest").data[0]

    x, y = (part.ravel() for part in np.meshgrid(grid.x_um, grid.y_um))
    point, site = shapely.STRtree(layout.polygons()).query(shapely.points(x, y), predicate="within")
    expected = np.full(x.size, np.nan)
    expected[point] = site
    differs = ~(np.isclose(found.ravel(), expected, equal_nan=True))
    # Pixel centres between an arc and its chords.
    assert differs.mean() < 0.01


def test_smooth_image_survives_round_trip():
    angle = (np.arange(96) + 0.5) * 2.0 * np.pi / 96
    ring = np.linspace(0.0, 1.0, 40)[:, np.newaxis]
    image = CorticalImage(
        data=(2.0 + np.cos(2.0 * angle) * ring + np.sin(angle))[np.newaxis],
        radius_um=np.geomspace(20.0, 120.0, 41),
        start_rad=np.zeros(40),
    )

    picture = from_cortical(image, fs.Grid.centred((500, 500), 0.5))
    back = to_cortical(picture, n_rings=40, n_sectors=96, r_min_um=20.0, r_max_um=120.0)

    np.testing.assert_allclose(back.data[0, 1:-1], image.data[0, 1:-1], atol=0.01)
    np.testing.assert_allclose(back.radius_um, image.radius_um)


def test_resampling_matches_opencv():
    cv2 = pytest.importorskip("cv2")
    rng, n, n_angles, n_radii, reach = np.random.default_rng(2), 161, 72, 40, 75.0
    plane = cv2.GaussianBlur(rng.uniform(size=(n, n)).astype(np.float32), (0, 0), 3.0)
    centre = 0.5 * (n - 1)

    theirs = cv2.warpPolar(plane, (n_radii, n_angles), (centre, centre), reach, cv2.WARP_POLAR_LOG | cv2.INTER_LINEAR)
    # Their column j has the radius exp(k j) - 1 in pixels, and row i the angle 2 pi i / n.
    k, pitch_um = np.log(reach) / n_radii, 2.0
    ours = to_cortical(
        picture_of(plane, pitch_um),
        n_rings=n_radii - 1,
        n_sectors=n_angles,
        r_min_um=(np.exp(0.5 * k) - 1.0) * pitch_um,
        r_max_um=(np.exp((n_radii - 0.5) * k) - 1.0) * pitch_um,
        start_rad=-np.pi / n_angles,
        offset_um=pitch_um,
    )

    # They interpolate with 1/32 of a pixel.
    np.testing.assert_allclose(ours.data[0], theirs[:, 1:].T, atol=np.abs(np.diff(plane)).max() / 16.0)
    assert np.corrcoef(ours.data[0].ravel(), theirs[:, 1:].T.ravel())[0, 1] > 0.9999


def test_inverse_matches_opencv():
    cv2 = pytest.importorskip("cv2")
    n, n_angles, n_radii, reach = 121, 90, 50, 55.0
    angle = 2.0 * np.pi * np.arange(n_angles) / n_angles
    polar = (np.cos(3.0 * angle)[:, np.newaxis] * np.linspace(0.2, 1.0, n_radii)).astype(np.float32)
    centre, k = 0.5 * (n - 1), np.log(reach) / n_radii
    flags = cv2.WARP_POLAR_LOG | cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    theirs = cv2.warpPolar(polar, (n, n), (centre, centre), reach, flags)
    image = CorticalImage(
        data=polar[:, 1:].T[np.newaxis],
        radius_um=np.exp((np.arange(n_radii) + 0.5) * k) - 1.0,
        start_rad=np.full(n_radii - 1, -np.pi / n_angles),
        offset_um=1.0,
    )

    ours = from_cortical(image, fs.Grid.centred((n, n), 1.0)).data[0]

    y, x = np.mgrid[:n, :n] - centre
    inside = (np.hypot(x, y) > 4.0) & (np.hypot(x, y) < 50.0)
    # Some versions of OpenCV leave a few pixels undefined, also as signalling NaN.
    with np.errstate(invalid="ignore"):
        is_close = np.abs(ours - theirs) < 0.02
    assert np.mean(is_close[inside]) > 0.99


def test_angles_increase_counter_clockwise():
    x, y = np.meshgrid(np.arange(101) - 50.0, np.arange(101) - 50.0)
    image = to_cortical(
        picture_of(np.arctan2(y, x) % (2.0 * np.pi)), n_rings=5, n_sectors=16, r_min_um=10.0, r_max_um=45.0
    )

    np.testing.assert_allclose(image.data[0, 2, 1:-1], (np.arange(16) + 0.5)[1:-1] * 2.0 * np.pi / 16, atol=0.02)


def test_missing_pixels_remain_missing():
    x, y = np.meshgrid(np.arange(101) - 50.0, np.arange(101) - 50.0)
    plane = np.where(np.hypot(x, y) < 20.0, np.nan, 1.0)

    image = to_cortical(picture_of(plane), n_rings=20, n_sectors=30, r_min_um=5.0, r_max_um=49.0)
    back = from_cortical(image, fs.Grid.centred((101, 101), 1.0))

    is_blind = image.ring_centre_um < 19.0
    assert np.isnan(image.data[0, is_blind]).all()
    np.testing.assert_allclose(image.data[0, image.ring_centre_um > 21.5], 1.0)
    assert np.isnan(back.data[0, 50, 50])
    assert back.coverage[50, 50] == 0.0


@pytest.fixture(scope="module")
def capture():
    layout = ringed()
    scene = fs.Scene.flat(
        shape=(80, 80),
        pitch_um=300.0,
        distance_m=1.0,
        radiance_w_m2_sr_nm=0.01,
        wavelength_nm=550.0,
        band_width_nm=10.0,
    )
    sensor = fs.Sensor(layout, capacitance_f=1e-15 * layout.area_um2)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
    return camera.capture(scene, exposure_s=0.01, seed=0), sensor


def test_capture_has_cortical_image(capture):
    shot, sensor = capture
    exact = shot.cortical()
    uniform = shot.cortical(of="expected_e", per="um2", sensor=sensor)
    resampled = shot.cortical(
        n_rings=9, n_sectors=25, r_min_um=10.0, r_max_um=80.0, of="expected_e", per="um2", sensor=sensor
    )

    np.testing.assert_array_equal(exact.site_values(shot.layout.n_sites)[0], shot.code)
    assert np.ptp(uniform.data) < 0.02 * uniform.data.mean()  # relative illumination
    assert resampled.sites is None
    np.testing.assert_allclose(resampled.data[0, 1:-1], uniform.data[0, 1:-1], rtol=0.01)


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (fs.layout.grid(n_x=4, pitch_um=2.0), "must have the columns 'ring' and 'sector'; resample a picture instead"),
        (fs.layout.fovi(fov_um=50.0, a_um=5.0, n_rings=8), "at least two rings with equal numbers of sectors"),
        (
            fs.layout.grid(n_x=4, pitch_um=2.0).with_columns(
                ring=np.repeat(np.arange(4), 4), sector=np.tile(np.arange(4), 4)
            ),
            "must have concentric rings of equal sectors",
        ),
    ],
)
def test_other_layouts_are_explained(layout, message):
    with pytest.raises(ParameterError, match=message):
        cortical(layout, np.zeros(layout.n_sites))


def test_bad_arguments_are_explained(capture):
    shot, _ = capture
    picture = picture_of(np.ones((9, 9)))

    with pytest.raises(ParameterError, match="'n_rings' and 'n_sectors' must be given together"):
        shot.cortical(n_rings=4)
    with pytest.raises(ParameterError, match="'r_max_um' must be used with 'n_rings'"):
        shot.cortical(r_max_um=4.0)
    with pytest.raises(ParameterError, match=r"'r_min_um' must be > 0 and < 4, the outer radius, got 5\.0 µm"):
        to_cortical(picture, n_rings=4, n_sectors=8, r_min_um=5.0, r_max_um=4.0)
    with pytest.raises(ParameterError, match="'method' must be one of 'linear', 'nearest'"):
        from_cortical(shot.cortical(), picture.grid, method="cubic")
    with pytest.raises(ParameterError, match="'sites' must be known"):
        to_cortical(picture, n_rings=4, n_sectors=8, r_max_um=4.0).site_values(4)
    with pytest.raises(ParameterError, match="'radius_um' must be 3 increasing radii"):
        CorticalImage(data=np.zeros((1, 2, 4)), radius_um=np.array([1.0, 3.0, 2.0]), start_rad=np.zeros(2))
