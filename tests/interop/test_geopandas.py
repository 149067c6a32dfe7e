"""Layouts in GeoParquet and GeoJSON files of geopandas."""

from __future__ import annotations

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs
from foveasim.errors import FileError

geopandas = other_program("geopandas")

LAYOUT = fs.layout.hexagonal(n_columns=4, n_rows=3, pitch_um=3.0)


def frame(tmp_path):
    LAYOUT.write(tmp_path / "own.parquet")
    return geopandas.read_parquet(tmp_path / "own.parquet")


@pytest.mark.parametrize("encoding", ["WKB", "geoarrow"])
def test_geopandas_preserves_micrometres(tmp_path, encoding):
    found = frame(tmp_path)
    found["kind"] = found["row"].astype(str).astype("category")
    found.to_parquet(tmp_path / "a.parquet", geometry_encoding=encoding, write_covering_bbox=encoding == "WKB")
    layout = fs.read_layout(tmp_path / "a.parquet")

    np.testing.assert_array_equal(layout.xy_um, LAYOUT.xy_um)
    assert layout.columns["kind"].tolist() == LAYOUT.columns["row"].astype(str).tolist()
    assert "left_out_columns" not in layout.provenance


def test_geopandas_millimetres_are_obeyed(tmp_path):
    crs = frame(tmp_path).crs.to_json_dict()
    for axis in crs["coordinate_system"]["axis"]:
        axis["unit"] = {"type": "LinearUnit", "name": "millimetre", "conversion_factor": 0.001}
    frame(tmp_path).set_crs(crs, allow_override=True).to_parquet(tmp_path / "a.parquet")

    np.testing.assert_allclose(fs.read_layout(tmp_path / "a.parquet").xy_um, 1e3 * LAYOUT.xy_um, rtol=1e-12)


@pytest.mark.parametrize("crs", [4326, 4258, None])
def test_geopandas_degrees_are_rejected(tmp_path, crs):
    frame(tmp_path).set_crs(crs, allow_override=True).to_parquet(tmp_path / "a.parquet")
    with pytest.raises(FileError, match="state their unit"):
        fs.read_layout(tmp_path / "a.parquet")


def test_geopandas_geojson_requires_unit(tmp_path):
    frame(tmp_path).to_file(tmp_path / "a.geojson")
    with pytest.raises(FileError, match="degrees"):
        fs.read_layout(tmp_path / "a.geojson")
    np.testing.assert_allclose(fs.read_layout(tmp_path / "a.geojson", unit="um").area_um2, LAYOUT.area_um2)
