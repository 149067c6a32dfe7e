"""Images of samples: reconstructed pictures and log-polar images of the captures of a dataset."""

from __future__ import annotations

import numpy as np
import pytest
from explore.test_dataset import SHOT, VARY, assert_same, pictures
from pydantic import TypeAdapter

import foveasim as fs
from foveasim import explore
from foveasim.errors import ConfigError, ParameterError
from foveasim.explore.datasets.plan import DatasetSection

RINGS = SHOT | {
    "layout": {
        "generator": "log_polar",
        "parameters": {"n_sectors": 24, "r_min_um": 8.0, "n_rings": 8, "r_max_um": 60.0},
        "mosaic": ["RG", "GB"],
    },
    "sensor": SHOT["sensor"] | {"filters": "rgb", "bits": 10},
}
FITTED = RINGS | {"scene": {key: value for key, value in SHOT["scene"].items() if key != "pitch_um"} | {"fit": "cover"}}


def rings(**options):
    return explore.Dataset(pictures(2), FITTED, VARY, draws=2, **options)


@pytest.mark.parametrize("method", ["cells", "linear"])
def test_raster_is_picture_of_capture(method):
    data = rings(raster={"method": method, "max_pixels": 24, "of": "electrons"})
    sample, capture = data[3], data.capture(3)
    picture = capture.picture(method, max_pixels=24, of="electrons", sensor=data.shot(3).camera.sensor)

    assert sample["raster"].dtype == np.float32
    assert sample["raster"].shape == (3, 24, 24)
    # The top row is first.
    np.testing.assert_array_equal(sample["raster_known"][::-1], np.isfinite(picture.data[0]))
    np.testing.assert_array_equal(sample["raster"][:, ::-1], np.nan_to_num(picture.data))
    assert 0.0 < sample["raster_known"].mean() < 1.0


def test_raster_is_upright_like_its_picture():
    """A picture with a bright top gives a raster with a bright top."""
    picture = np.zeros((40, 40), np.uint8)
    picture[:20] = 255
    grid = {"generator": "grid", "parameters": {"n_x": 12, "n_y": 12, "pitch_um": 8.0}}
    data = explore.Dataset([picture], FITTED | {"layout": grid, "sensor": {}}, raster={"max_pixels": 12})

    raster = data[0]["raster"][0]

    assert raster[:4].min() > 10 * raster[-4:].max()


def test_cortical_image_has_one_pixel_per_site():
    data = rings(cortical={})
    sample = data[1]
    layout = data.layout
    ring, sector = layout.columns["ring"], layout.columns["sector"]

    assert sample["cortical"].shape == (1, ring.max() - ring.min() + 1, 24)
    assert sample["cortical_known"].all()
    np.testing.assert_array_equal(sample["cortical"][0, ring - ring.min(), sector], sample["code"])


def test_cortical_image_of_other_layouts_is_resampled():
    data = explore.Dataset(pictures(1), SHOT, cortical={"n_rings": 6, "n_sectors": 12, "per": "um2"})
    image = data.capture(0).cortical(
        n_rings=6, n_sectors=12, per="um2", max_pixels=256, sensor=data.shot(0).camera.sensor
    )

    np.testing.assert_array_equal(data[0]["cortical"], np.nan_to_num(image.data).astype(np.float32))
    np.testing.assert_array_equal(data[0]["cortical_known"], np.isfinite(image.data[0]))


@pytest.mark.parametrize("name", ["data", "data.zarr"])
def test_images_are_stored_with_units(name, tmp_path):
    data = rings(raster={"max_pixels": 20, "per": "um2"}, cortical={"of": "electrons"})

    stored = explore.write_dataset(data, tmp_path / name)
    items = stored.about["items"]

    for k in range(4):
        assert_same(stored[k], data[k])
    assert items["raster"]["units"] == "DN/µm²"
    assert items["raster"]["shape"] == [3, 20, 20]
    assert items["raster"]["channels"] == list(data.capture(0).filter_names)
    assert items["cortical"]["units"] == "e-"
    np.testing.assert_allclose(items["cortical"]["radius_um"][-1], 60.0, rtol=1e-6)
    np.testing.assert_allclose(items["raster"]["bounds_um"], np.r_[-1, -1, 1, 1] * 60.0, rtol=0.02)


def test_zarr_images_have_named_dimensions(tmp_path):
    zarr = pytest.importorskip("zarr")
    explore.write_dataset(rings(raster={"max_pixels": 20}, cortical={}), tmp_path / "data.zarr")
    group = zarr.open_group(str(tmp_path / "data.zarr"), mode="r")

    assert group["raster"].metadata.dimension_names == ("sample", "raster_channel", "raster_y", "raster_x")
    assert group["cortical"].metadata.dimension_names == ("sample", "cortical_channel", "ring", "sector")
    assert group["raster"].attrs["units"] == "DN"
    assert group["cortical"].attrs["radius_um"] == rings(cortical={}).describe_items()["cortical"]["radius_um"]


def test_images_identify_the_dataset(tmp_path):
    explore.write_dataset(rings(raster={"max_pixels": 20}), tmp_path / "data")

    with pytest.raises(fs.errors.FileError, match="is another dataset: its 'raster' differs"):
        explore.write_dataset(rings(raster={"max_pixels": 21}), tmp_path / "data")


def test_yaml_file_specifies_images(tmp_path):
    np.save(tmp_path / "pictures.npy", pictures(2))
    file = tmp_path / "data.yaml"
    file.write_text(
        "pictures: pictures.npy\n"
        f"shot: {FITTED!r}\n"
        "raster: {method: cells, max_pixels: 16}\n"
        "cortical: {n_rings: 4, n_sectors: 8}\n"
    )

    sample = explore.read_dataset(file).dataset[0]

    assert sample["raster"].shape == (3, 16, 16)
    assert sample["cortical"].shape == (3, 4, 8)


def test_schema_contains_image_options():
    schema = TypeAdapter(DatasetSection).json_schema()

    assert "n_rings" in schema["$defs"]["_Cortical"]["properties"]
    assert schema["$defs"]["_Raster"]["properties"]["method"]["anyOf"][0]["enum"] == [
        "cells",
        "linear",
        "natural",
        "least_squares",
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"raster": 96}, "'raster' must be a mapping of options .*got 96"),
        ({"raster": {"max_pixel": 96}}, "'raster' must have the options .*got 'max_pixel'; did you mean 'max_pixels'"),
        ({"raster": {"method": "cubic"}}, "'raster' has invalid options: 'method' must be .*got 'cubic'"),
        ({"raster": {"max_pixels": 0}}, "'raster' has invalid options: 'max_pixels' must be .*got 0"),
        ({"raster": {"mu": 1.0}}, "'raster' has invalid options: 'mu' must be an option of the method 'cells'"),
        ({"raster": {"mu": object()}}, "'raster' must have numbers, strings and lists as options"),
        ({"cortical": {"n_rings": 4}}, "'cortical' has invalid options: 'n_rings' and 'n_sectors' must be given"),
        ({"cortical": {}}, "'cortical' has invalid options: 'layout' must have the columns 'ring' and 'sector'"),
    ],
)
def test_invalid_image_options_are_rejected(options, message):
    with pytest.raises(ParameterError, match=message) as caught:
        explore.Dataset(pictures(1), SHOT, **options)
    assert "\n" not in str(caught.value)


def test_unknown_image_options_of_files_are_rejected(tmp_path):
    np.save(tmp_path / "pictures.npy", pictures(2))
    file = tmp_path / "data.yaml"
    file.write_text(f"pictures: pictures.npy\nshot: {FITTED!r}\nraster: {{pixels: 16}}\n")

    with pytest.raises(ConfigError, match=r"raster\.pixels"):
        explore.read_dataset(file)
