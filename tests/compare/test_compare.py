"""Comparison at equal budget: identical cameras are equal, finer grids are better, unequal budgets are rejected."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace

import numpy as np
import pytest

import foveasim as fs
from foveasim.compare import quality_by_eccentricity
from foveasim.compare.metrics import COMPARED, best_cameras
from foveasim.errors import FileError, ParameterError
from foveasim.metrics import metric_info
from foveasim.reconstruct import Picture

OPTIONS = {"n_annuli": 4, "max_pixels": 64}


def photographs():
    """Return two pictures with structure at all scales."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:96, :96] / 96.0
    pictures = {}
    for k in range(3):
        waves = sum(
            np.sin(2.0 * np.pi * (f * x + g * y + p)) / (1.0 + f) for f, g, p in rng.uniform(0.0, 12.0, (12, 3))
        )
        pictures[f"picture {k}"] = np.uint8(np.interp(waves, (waves.min(), waves.max()), (5, 250)))
    return pictures


@pytest.fixture(scope="module")
def scenes():
    return fs.compare.photograph_scenes(160.0, pictures=photographs())


@pytest.fixture(scope="module")
def foveal():
    return fs.layout.log_polar(n_sites=484, min_size_um=1.5, r_max_um=80.0, stagger=True)


@pytest.fixture(scope="module")
def compared(foveal, scenes):
    square = fs.layout.grid(n_sites=484, size_um=(160.0, 160.0))
    layouts = {"foveal": foveal, "square": square, "again <b>": foveal}
    return fs.compare.layouts(layouts, scenes, **OPTIONS)


@pytest.mark.slow
def test_identical_layouts_have_identical_measures(compared):
    for name in COMPARED:
        for key in (name, f"{name}_by_eccentricity"):
            values = compared.values[key]
            np.testing.assert_array_equal(values[0], values[2])
        median, low, high = compared.differences(name)
        assert median[0] == median[2] == 0.0
        assert low[2] == high[2] == 0.0 or np.isnan([low[2], high[2]]).all()
    assert any(compared.differences(name).median[1] != 0.0 for name in COMPARED)


@pytest.mark.slow
def test_fovea_is_better_at_centre_only(compared):
    for name in ("psnr_db", "nyquist_per_mm", "information_bit_per_mm2"):
        values = compared.summary(name, by_eccentricity=True).median
        assert values[0, 0] > values[1, 0]
        assert values[0, 2] < values[1, 2]


@pytest.mark.slow
def test_information_and_shift_are_independent_of_pictures(foveal, scenes):
    pair, one = {"a": foveal, "b": foveal}, {"one": scenes["picture 0"]}
    coarse, fine = (fs.compare.layouts(pair, one, n_annuli=2, max_pixels=n) for n in (32, 256))

    for name in ("information_bit_per_site", "shift_sigma_um"):
        np.testing.assert_allclose(coarse.values[name], fine.values[name], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("side_um", [2.0, 16.0])
def test_shift_precision_matches_displaced_images(scenes, side_um):
    size_um = min(160.0, 40.0 * side_um)
    square = fs.layout.grid(n_x=round(size_um / side_um), size_um=(size_um, size_um))
    camera, exposure_s, step_um = cameras_of(square, f_number=2.8), 1 / 60, 0.02
    image = camera.power_map(scenes["picture 1"])

    def expected_e(x_um, y_um):
        x0_um, y0_um = image.grid.origin_um
        grid = fs.Grid(image.grid.shape, image.grid.pitch_um, (x0_um + x_um, y0_um + y_um))
        return camera.capture(
            fs.PowerMap(image.data, grid, image.wavelength_nm), exposure_s=exposure_s, seed=0
        ).expected_e

    steps = ((step_um, 0.0), (0.0, step_um))
    gradient = np.stack([(expected_e(x, y) - expected_e(-x, -y)) / (2.0 * step_um) for x, y in steps], axis=1)
    noise_e = fs.sensor.signal_to_noise(
        camera.sensor, expected_e(0.0, 0.0), camera.sensor.expected_electrons(np.zeros(square.n_sites), exposure_s)
    ).noise_e
    information = np.einsum("si,sj,s->ij", gradient, gradient, noise_e**-2.0)

    found = fs.compare.cameras({"a": camera, "b": camera}, {"1": image}, exposure_s=exposure_s, max_pixels=32)

    expected_um = np.sqrt(np.mean(np.diagonal(np.linalg.inv(information))))
    assert found.values["shift_sigma_um"][0, 0] == pytest.approx(expected_um, rel=1e-2)


def test_shift_along_edge_is_unobservable():
    camera = cameras_of(fs.layout.grid(n_x=8, size_um=(16.0, 16.0)))
    edge = fs.PowerMap(np.array([[[1.0, 2.0]]]), fs.Grid.centred((1, 2), 20.0), np.array([550.0]))

    found = fs.compare.cameras({"a": camera, "b": camera}, {"edge": edge}, exposure_s=1e-4, n_annuli=2, max_pixels=16)

    assert np.isinf(found.values["shift_sigma_um"]).all()
    assert found.values["information_bit_per_site"].min() > 0.0


def test_blind_spot_is_stated_and_excluded(compared, foveal):
    blind_um = foveal.provenance["blind_radius_um"]

    assert compared.coverage_fraction[1] > compared.coverage_fraction[0]
    assert compared.compared_fraction <= compared.coverage_fraction.min()
    assert np.isnan(compared.pictures["foveal"][0].data[0, 32, 32])
    assert blind_um > compared.pictures["foveal"][0].grid.pitch_um


def test_uniform_grid_has_known_frequencies(compared):
    side_um = 160.0 / round(np.sqrt(compared.budgets[1].n_sites))

    assert compared.values["nyquist_per_mm"][1] == pytest.approx(500.0 / side_um)
    # The lens lowers the MTF50 of a square aperture, 0.603 / side along x.
    assert 0.3 * 603.0 / side_um < compared.values["mtf50_per_mm"][1] < 650.0 / side_um


@pytest.mark.slow
def test_finer_grid_has_higher_psnr(scenes):
    grids = {f"{n}": fs.layout.grid(n_x=n, size_um=(160.0, 160.0)) for n in (10, 20, 40)}
    found = fs.compare.layouts(grids, scenes, budget=None, **OPTIONS)
    psnr, ssim = (found.summary(name).median for name in ("psnr_db", "ssim"))

    assert psnr[0] + 1.0 < psnr[1] < psnr[2] - 1.0
    assert ssim[0] < ssim[1] < ssim[2]


def test_budgets_follow_from_the_sensor(foveal):
    noise_e = np.linspace(1.0, 3.0, foveal.n_sites)
    sensor = fs.Sensor(foveal, bits=12, read_noise_e=noise_e)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)

    found = fs.compare.budget_of(camera, 25.0)

    assert found.n_sites == foveal.n_sites
    assert found.data_rate_bit_per_s == foveal.n_sites * 12 * 25
    assert found.area_um2 == pytest.approx(sum(polygon.area for polygon in foveal.polygons()))
    assert found.read_noise_e2 == pytest.approx(sum(sigma**2 for sigma in noise_e))
    assert found.readout_steps == max(
        foveal.readout_line.tolist().count(line) for line in set(foveal.readout_line.tolist())
    )


def test_readout_time_is_longest_line():
    wide = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=fs.Sensor(fs.layout.grid(30, 8, 2.0)))
    single = wide.replace(sensor=fs.Sensor(wide.sensor.layout.with_columns(readout_line=np.zeros(240, np.int64))))

    assert fs.compare.budget_of(wide, 30.0).readout_steps == 8  # columns are read in parallel
    assert fs.compare.budget_of(single, 30.0).readout_steps == 240


def test_unequal_budgets_are_rejected(scenes):
    grids = {"a": fs.layout.grid(n_x=20, size_um=(80.0, 80.0)), "b": fs.layout.grid(n_x=21, size_um=(80.0, 80.0))}

    with pytest.raises(ParameterError, match=r"within 2 %: the number of sites of 'a' is 400, that of 'b' 441; use"):
        fs.compare.layouts(grids, scenes, **OPTIONS)
    found = fs.compare.layouts(grids, {"one": scenes["picture 0"]}, budget="area", **OPTIONS)
    assert found.budgets[0].area_um2 == pytest.approx(found.budgets[1].area_um2)
    assert np.isnan(found.summary("psnr_db").low).all()


def cameras_of(layout, **optics):
    lens = fs.Optics(**{"focal_length_mm": 8.0, "f_number": 4.0, **optics})
    return fs.Camera(optics=lens, sensor=fs.compare.default_sensor(layout))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda one: {"a": one}, "must be at least two, got 1"),
        (lambda one: [one, one], "'cameras' must be a mapping to Camera objects, got "),
        (lambda one: {"a": one, "b": 3}, "'cameras\\['b'\\]' must be a Camera, got an int"),
        (
            lambda one: {"a": one, "b": cameras_of(one.sensor.layout, f_number=2.0)},
            "must have the same optics: those of 'a' and 'b' differ",
        ),
    ],
)
def test_invalid_cameras_are_explained(change, message, foveal):
    with pytest.raises(ParameterError, match=message):
        fs.compare.cameras(change(cameras_of(foveal)), exposure_s=0.01)


def test_invalid_options_are_explained(foveal, scenes):
    pair = {"a": foveal, "b": foveal}

    with pytest.raises(
        ParameterError, match="'budget' must be one of 'n_sites', 'data_rate', 'readout_time', 'area', 'read_noise'"
    ):
        fs.compare.layouts(pair, scenes, budget="sites")
    with pytest.raises(ParameterError, match="'frames_per_s' must have a rate for 'b'"):
        fs.compare.layouts(pair, scenes, frames_per_s={"a": 10.0})
    with pytest.raises(ParameterError, match="'scenes' must be a mapping"):
        fs.compare.layouts(pair, [scenes["picture 0"]])


def flat_picture(values, grid):
    return Picture(np.asarray(values, np.float32)[np.newaxis], np.ones(grid.shape, np.float32), grid)


def test_psnr_of_white_noise_matches_variance():
    grid, rng = fs.Grid.centred((200, 200), 1.0), np.random.default_rng(2)
    x, y = np.meshgrid(grid.x_um, grid.y_um)
    ideal = 100.0 + 50.0 * np.sign(x)
    sigma = np.where(np.hypot(x, y) < 50.0, 2.0, 5.0)
    noisy = flat_picture((ideal + sigma * rng.standard_normal(grid.shape)) / 3.0, grid)

    found = quality_by_eccentricity(noisy, flat_picture(ideal, grid), edges_um=np.array([0.0, 50.0, 100.0]))

    expected = 20.0 * np.log10(100.0 / np.array([2.0, 5.0]))
    # Relative standard deviation of a variance: sqrt(2 / n).
    tolerance = 5.0 * 10.0 / np.log(10.0) * np.sqrt(2.0 / np.array([7854.0, 23562.0]))
    assert found.gain == pytest.approx(3.0, rel=2e-3)
    assert (np.abs(found.psnr_db_by_eccentricity - expected) < tolerance).all()
    assert found.ssim_by_eccentricity[0] > found.ssim_by_eccentricity[1]


def test_totals_match_metrics_of_pictures():
    grid, rng = fs.Grid.centred((40, 40), 1.0), np.random.default_rng(3)
    one, other = (flat_picture(rng.uniform(1.0, 2.0, grid.shape), grid) for _ in range(2))

    found = quality_by_eccentricity(one, other, edges_um=np.array([0.0, 100.0]))
    scaled = flat_picture(found.gain * one.data[0], grid)

    assert found.psnr_db == pytest.approx(fs.metrics.psnr_db(scaled, other), abs=1e-4)
    assert found.psnr_db_by_eccentricity[0] == pytest.approx(found.psnr_db)
    assert found.ssim == pytest.approx(fs.metrics.ssim(scaled, other), abs=1e-4)


def test_pictures_of_other_grids_are_rejected():
    one = flat_picture(np.ones((8, 8)), fs.Grid.centred((8, 8), 1.0))
    other = flat_picture(np.ones((8, 8)), fs.Grid.centred((8, 8), 1.5))

    with pytest.raises(
        ParameterError, match=r"same grid as the picture, 8 x 8 pixels of 1 µm .* got 8 x 8 pixels of 1.5"
    ):
        quality_by_eccentricity(one, other, edges_um=np.array([0.0, 10.0]))


def test_dataset_has_units_and_settings(compared):
    data = compared.to_xarray()

    assert data["psnr_db_by_eccentricity"].dims == ("camera", "scene", "annulus")
    assert data["psnr_db"].sel(camera="square").shape == (3,)
    assert data["shift_sigma_um"].attrs["units"] == "µm"
    assert data["n_sites"].values.tolist() == [budget.n_sites for budget in compared.budgets]
    assert json.loads(data.attrs["settings"])["seed"] == 0
    records = compared.records()
    assert records[1]["psnr_db"] == pytest.approx(float(data["psnr_db"].sel(camera="square").median()))


@pytest.mark.slow
def test_report_is_escaped_and_self_contained(compared, tmp_path):
    compared.write(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()

    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert "again &lt;b&gt;" in page
    assert "again <b>" not in page
    assert not re.search(r"(src|href|srcset)=\"(?!data:)", page)
    assert page.count("<img ") == len(re.findall(r"<figcaption><b>[^<]+</b> [^<]+\.</figcaption>", page))
    with pytest.raises(FileError, match=r"must end in \.html"):
        compared.write(tmp_path / "report.pdf")


def test_overview_draws_every_measure(compared):
    axes = compared.plot()

    assert {ax.get_ylabel().split(" / ")[0] for ax in axes} >= {metric_info(name).title for name in COMPARED}
    axes[0].figure.canvas.draw()


def test_table_lists_cameras_and_measures(compared):
    lines = str(compared).splitlines()
    verdict = compared.verdict()

    assert lines[: len(verdict)] == verdict
    assert all(name in lines[len(verdict)] for name in compared.names)
    assert lines[-1] == "* best value of the row"
    assert [line for line in lines if line.startswith("PSNR / dB")]
    assert "[" not in str(compared)  # three scenes have no interval


def test_progress_counts_to_its_total(scenes, foveal):
    counts = []
    fs.compare.layouts(
        {"a": foveal, "b": foveal}, scenes, progress=lambda done, total: counts.append((done, total)), **OPTIONS
    )

    assert counts == [(k, 8) for k in range(1, 9)]


# -- verdict -------------------------------------------------------------------------------------------------------------


def with_differences(compared, by_annulus_db, over_field_db, n_scenes=3):
    """Return a comparison of two cameras whose PSNR differs by these values from annulus to annulus."""
    first = np.full((n_scenes, len(by_annulus_db)), 20.0)
    values = {
        "psnr_db_by_eccentricity": np.array([first, first + by_annulus_db]),
        "psnr_db": 20.0 + np.array([np.zeros(n_scenes), np.broadcast_to(over_field_db, n_scenes)]),
    }
    return replace(
        compared,
        names=("foveal", "square"),
        scenes=tuple(f"scene {k}" for k in range(n_scenes)),
        edges_um=np.linspace(0.0, 100.0, len(by_annulus_db) + 1),
        values={**compared.values, **values},
    )


@pytest.mark.parametrize(
    ("by_annulus_db", "sentence"),
    [
        # Between the centres at 37.5 and 62.5 µm, from -2 to 3 dB: zero at two fifths of the way.
        (
            [-6.0, -2.0, 3.0, 1.0],
            (
                "Within 48 µm of the fixation point, foveal has a higher PSNR than square, by up to 6.0 dB; beyond, square has the "
                "higher one, by up to 3.0 dB."
            ),
        ),
        ([1.0, 2.0, 0.05, 0.5], "square has a higher PSNR than foveal at all eccentricities, by up to 2.0 dB."),
        ([0.08, -0.08, 0.0, np.nan], "foveal and square have the same PSNR at all eccentricities, within 0.1 dB."),
        (
            [-1.0, 1.0, -1.0, -1.0],
            (
                "The higher PSNR is that of foveal (by up to 1.0 dB) and of square (by up to 1.0 dB) in turn: from the fixation point "
                "outwards, it changes at 25 and 50 µm, beginning with foveal."
            ),
        ),
    ],
)
def test_verdict_says_where_which_is_better(compared, by_annulus_db, sentence):
    assert with_differences(compared, by_annulus_db, 1.0).verdict()[0] == sentence


@pytest.mark.parametrize(
    ("over_field_db", "n_scenes", "sentence"),
    [
        (2.5, 3, "Over the field, square has a PSNR that is 2.5 dB higher than that of foveal."),
        (0.05, 3, "Over the field, the PSNR of foveal and square is equal within 0.1 dB."),
        (np.nan, 3, "Over the field, the PSNR of foveal and square cannot be compared."),
        (
            [-1.0, -2.0, -3.0, -4.0, -5.0],
            5,
            (
                "Over the field, foveal has a PSNR that is 3.0 dB higher than that of square (95 % confidence interval over 5 scenes "
                "1.0 to 5.0 dB)."
            ),
        ),
        (
            [1.0, -2.0, -3.0, -4.0, -5.0],
            5,
            (
                "Over the field, foveal has a PSNR that is 3.0 dB higher than that of square (95 % confidence interval over 5 scenes "
                "-1.0 to 5.0 dB: not significant)."
            ),
        ),
    ],
)
def test_verdict_over_the_field_has_interval(compared, over_field_db, n_scenes, sentence):
    assert with_differences(compared, [1.0, 1.0], over_field_db, n_scenes).verdict()[1] == sentence


def test_best_values_are_marked(compared):
    values = {name: np.array(array, copy=True) for name, array in compared.values.items()}
    values["psnr_db"][:] = [[10.0], [12.0], [10.0]]
    values["shift_sigma_um"][:] = [[0.1], [0.2], [0.3]]
    changed = replace(compared, values=values)
    rows = {line.split("  ")[0]: line for line in str(changed).splitlines()}

    assert best_cameras(COMPARED, changed.summary)[list(COMPARED).index("psnr_db")] == 1
    assert best_cameras(COMPARED, changed.summary)[list(COMPARED).index("shift_sigma_um")] == 0
    assert re.search(r" 10 +12 \* +10$", rows["PSNR / dB"])
    values["shift_sigma_um"][2] = 0.1
    assert best_cameras(COMPARED, changed.summary)[list(COMPARED).index("shift_sigma_um")] is None


@pytest.mark.slow
def test_report_begins_with_the_verdict(compared, tmp_path):
    compared.write(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text("utf-8")

    assert html.escape(compared.verdict()[0]) in page.split("<table")[0]
    assert page.count('<strong title="best value">') == sum(
        best is not None for best in best_cameras(COMPARED, compared.summary)
    )
