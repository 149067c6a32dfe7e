"""Captures as xarray datasets, pandas tables and zarr stores: units, and bit-identical round trips."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import FileError, ParameterError
from foveasim.layout.packed import layout_to_arrays

#: Names of columns that are reserved, invalid in files, or paths.
ODD_NAMES = ("code", "site", "x_um", "a/b", "..", "zarr.json", "__x", "with space", "é", "x" * 300, "area_um2")


def make_capture(**columns):
    layout = fs.layout.mosaic(fs.layout.log_polar(n_sectors=12, r_min_um=4.0, r_max_um=20.0), ("RG", "GB"))
    layout = fs.Layout(
        layout.xy_um,
        layout.ring_offsets,
        layout.site_offsets,
        {**layout.columns, **{name: values(layout.n_sites) for name, values in columns.items()}},
        layout.provenance,
    )
    scene = fs.Scene.flat(
        shape=(60, 60), pitch_um=300.0, distance_m=1.0, radiance_w_m2_sr_nm=0.1, wavelength_nm=[620, 550, 450]
    )
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=8.0, f_number=2.8),
        sensor=fs.Sensor(layout, filters="rgb", read_noise_e=2.0, bits=12),
    )
    return camera.capture(scene, exposure_s=0.0003, seed=2**70)


@pytest.fixture(scope="module")
def capture():
    odd = dict.fromkeys(ODD_NAMES, np.arange)
    return make_capture(
        words=lambda n: np.array(["µ", "long word", ""])[np.arange(n) % 3],
        raw=lambda n: np.array([b"a", b"bcd"])[np.arange(n) % 2],
        flag=lambda n: np.arange(n) % 2 == 0,
        small=lambda n: (np.arange(n) % 200).astype(np.uint8),
        half=lambda n: np.linspace(0, 1, n).astype(np.float32),
        nan=lambda n: np.where(np.arange(n) % 2, np.nan, -0.0),
        zeros=np.zeros,
        gain_e_per_dn=np.ones,
        **odd,
    )


def assert_same(one, other):
    for name in ("code", "electrons", "expected_e", "filter_of_site", "white_dn"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a.dtype, a.tobytes()) == (b.dtype, b.tobytes()), name
    parts, others = layout_to_arrays(one.layout), layout_to_arrays(other.layout)
    assert list(parts) == list(others)
    for name, part in parts.items():
        assert (part.dtype, part.tobytes()) == (others[name].dtype, others[name].tobytes()), name
    assert (one.filter_names, one.bits, one.settings) == (other.filter_names, other.bits, other.settings)
    assert one.layout.provenance == other.layout.provenance


# -- labelled arrays and tables ---------------------------------------------------------------------------------------


def test_differences_of_signed_codes_are_negative(capture):
    other = dataclasses.replace(capture, code=capture.code[::-1].copy())
    difference_dn = capture.code_dn - other.code_dn

    assert difference_dn.dtype == np.int32
    assert difference_dn.min() == -difference_dn.max() < 0
    assert np.array_equal(difference_dn, capture.code.astype(float) - other.code.astype(float))
    table = capture.to_pandas()
    assert (table["code_dn"] - 2**capture.bits).max() < 0
    assert np.array_equal(table["code_dn"], table["code"])
    assert np.array_equal(capture.column("code_dn"), capture.code_dn)


def test_dataset_has_dims_units_and_coordinates(capture):
    found = capture.to_xarray()
    n = capture.layout.n_sites

    assert dict(found.sizes) == {"site": n, "filter": 3}
    assert {name: v.attrs["units"] for name, v in found.data_vars.items()} == {
        "code": "DN",
        "code_dn": "DN",
        "electrons": "e-",
        "expected_e": "e-",
        "filter_of_site": "1",
        "white_dn": "DN",
    }
    assert all("units" in v.attrs for v in found.variables.values())
    assert found["x_um"].attrs["units"] == "µm"
    assert found["area_um2"].attrs["units"] == "µm²"
    assert found["gain_e_per_dn"].attrs["units"] == "e-/DN"
    assert found["filter"].to_numpy().tolist() == list(capture.filter_names)
    np.testing.assert_array_equal(found["code"], capture.code)
    np.testing.assert_array_equal(np.stack((found["x_um"], found["y_um"]), 1), capture.layout.centroid_um)
    np.testing.assert_array_equal(found["channel"], capture.layout.channel)


def test_dataset_attributes_name_settings_seed_versions(capture):
    attributes = capture.to_xarray().attrs

    assert json.loads(attributes["settings"]) == capture.settings
    assert json.loads(attributes["versions"]) == capture.settings["versions"]
    assert json.loads(attributes["provenance"])["generator"] == "log_polar"
    assert attributes["seed"] == str(2**70)  # which no integer of a file can hold
    assert (attributes["bits"], attributes["exposure_s"]) == (12, 0.0003)


@pytest.mark.parametrize("file_format", ["nc", "zarr"])
def test_dataset_survives_netcdf_and_zarr(capture, tmp_path, file_format):
    import xarray as xr

    expected = capture.to_xarray()
    if file_format == "nc":
        expected = expected.drop_vars(["raw", "flag"])  # netCDF 4 has neither bytes nor booleans
        expected.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
        with xr.open_dataset(tmp_path / "x.nc", engine="h5netcdf") as opened:
            found = opened.load()
    else:
        expected = expected.drop_vars(["raw"])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # zarr's, of text of a fixed length
            expected.to_zarr(tmp_path / "x.zarr", consolidated=False)
        with xr.open_zarr(tmp_path / "x.zarr", consolidated=False, chunks=None) as opened:
            found = opened.load()

    xr.testing.assert_equal(found, expected)
    assert {k: str(v) for k, v in found.attrs.items()} == {k: str(v) for k, v in expected.attrs.items()}
    assert all(found[name].attrs.get("units") for name in expected.variables)


def test_table_has_a_row_per_site(capture):
    table = capture.to_pandas()

    assert len(table) == capture.layout.n_sites
    assert table.index.name == "site"
    assert list(table.columns[:8]) == [
        "x_um", "y_um", "area_um2", "filter_name", "filter_of_site", "code", "electrons", "expected_e",
    ]  # fmt: skip
    assert {"channel", "ring", "sector", "words", "a_b", "code_"} <= set(table.columns)
    np.testing.assert_array_equal(table["code"], capture.code)
    means = table.groupby("filter_name")["expected_e"].mean()
    for k, name in enumerate(capture.filter_names):
        assert means[name] == pytest.approx(capture.expected_e[capture.filter_of_site == k].mean(), rel=1e-12)
    table["code"] += 1  # the table is the user's own
    assert int(capture.code.max()) < 2**12
    assert table["code"].iloc[0] == capture.code[0] + 1


@pytest.mark.parametrize(("method", "library"), [("to_xarray", "xarray"), ("to_pandas", "pandas")])
def test_missing_library_gives_pip_command(capture, monkeypatch, method, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ParameterError, match=rf"needs {library}; install it with: pip install 'foveasim\[maps\]'"):
        getattr(capture, method)()


# -- stores -----------------------------------------------------------------------------------------------------------


def test_store_round_trip_is_bit_identical(capture, tmp_path):
    capture.save(tmp_path / "x.zarr")
    capture.save(tmp_path / "x.npz")

    assert_same(fs.Capture.load(tmp_path / "x.zarr"), capture)
    assert_same(fs.Capture.load(tmp_path / "x.npz"), capture)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.npz", "x.zarr"]


def test_xarray_opens_store_as_dataset(capture, tmp_path):
    import xarray as xr

    capture.save(tmp_path / "x.zarr")
    expected = capture.to_xarray()
    with xr.open_zarr(tmp_path / "x.zarr", consolidated=False, chunks=None) as found:
        xr.testing.assert_equal(found.drop_vars("raw"), expected.drop_vars("raw"))
        assert set(found.coords) == set(expected.coords)
        assert {k: found.attrs[k] for k in expected.attrs} == expected.attrs


def test_store_replaces_captures_only(capture, tmp_path):
    import zarr

    other = make_capture()
    other.save(tmp_path / "x.zarr")
    capture.save(tmp_path / "x.zarr")
    assert_same(fs.Capture.load(tmp_path / "x.zarr"), capture)

    foreign = tmp_path / "foreign.zarr"
    zarr.create_group(str(foreign), attributes={"format": "another"})
    (tmp_path / "file.zarr").write_text("mine")
    (tmp_path / "folder.zarr").mkdir()
    for name in ("foreign", "file", "folder"):
        with pytest.raises(FileError, match="the path contains other data"):
            capture.save(tmp_path / f"{name}.zarr")
    assert (tmp_path / "file.zarr").read_text() == "mine"
    with pytest.raises(FileError, match="does not exist"):
        capture.save(tmp_path / "none" / "x.zarr")


def test_failed_save_leaves_the_former_store(capture, tmp_path, monkeypatch):
    other = make_capture()
    other.save(tmp_path / "x.zarr")
    written = []

    def full(self, *args, **kwargs):
        written.append(self)
        if len(written) > 20:
            raise OSError(28, "No space left on device")
        return replace(self, *args, **kwargs)

    replace = Path.replace
    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(FileError, match=r"x\.zarr: cannot be written: No space left"):
        capture.save(tmp_path / "x.zarr")
    monkeypatch.undo()

    assert len(written) > 20
    assert_same(fs.Capture.load(tmp_path / "x.zarr"), other)
    assert [path.name for path in tmp_path.iterdir()] == ["x.zarr"]


def edit(path, **changes):
    metadata = json.loads(path.read_text())
    for key, value in changes.items():
        part = metadata
        *inner, last = key.split("__")
        for name in inner:
            part = part[name]
        part[last] = value
    path.write_text(json.dumps(metadata))


CORRUPTIONS = {
    "chunk gone": lambda store: (store / "code" / "c" / "0").unlink(),
    "chunk truncated": lambda store: (store / "code" / "c" / "0").write_bytes(b"\1\0"),
    "array gone": lambda store: shutil.rmtree(store / "electrons"),
    "outlines gone": lambda store: shutil.rmtree(store / "layout"),
    "metadata gone": lambda store: (store / "zarr.json").unlink(),
    "metadata empty": lambda store: (store / "zarr.json").write_bytes(b""),
    "metadata deep": lambda store: (store / "zarr.json").write_text("[" * 200_000),
    "metadata binary": lambda store: (store / "code" / "zarr.json").write_bytes(b"\xff\xfe"),
    "metadata list": lambda store: (store / "code" / "zarr.json").write_text("[]"),
    "huge shape": lambda store: edit(store / "code" / "zarr.json", shape=[10**15]),
    "other codec": lambda store: edit(store / "code" / "zarr.json", codecs=[{"name": "numcodecs.pickle"}]),
    "transformer": lambda store: edit(store / "code" / "zarr.json", storage_transformers=[{"name": "x"}]),
    "other type": lambda store: edit(store / "code" / "zarr.json", data_type="int16"),
    "other format": lambda store: edit(store / "zarr.json", attributes__format="foveasim video"),
    "other version": lambda store: edit(store / "zarr.json", attributes__version="9" * 1000),
    "bits": lambda store: edit(store / "zarr.json", attributes__bits="[/evil]"),
    "no settings": lambda store: edit(store / "zarr.json", attributes__settings="{"),
    "columns": lambda store: edit(store / "zarr.json", attributes__columns={"a": "../../x"}),
    "column": lambda store: edit(store / "zarr.json", attributes__columns={"a": "white_dn"}),
    "link": lambda store: (
        (store / "code" / "c" / "0").rename(store.parent / "elsewhere"),
        (store / "code" / "c" / "0").symlink_to(store.parent / "elsewhere"),
    ),
    "offsets": lambda store: (store / "layout" / "ring_offsets" / "c" / "0").write_bytes(
        bytes(len((store / "layout" / "ring_offsets" / "c" / "0").read_bytes()))
    ),
}  # fmt: skip


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("how", CORRUPTIONS)
def test_corrupt_store_gives_file_error(capture, tmp_path, how):
    store = tmp_path / "x.zarr"
    capture.save(store)
    CORRUPTIONS[how](store)

    with pytest.raises(FileError, match=r"x\.zarr: ") as caught:
        fs.Capture.load(store)
    assert len(str(caught.value)) < 500 + len(str(tmp_path))


def test_missing_paths_give_file_errors(capture, tmp_path):
    for name, message in (("x.zarr", "no such zarr store"), ("x.npz", "no such file")):
        with pytest.raises(FileError, match=message):
            fs.Capture.load(tmp_path / name)
    (tmp_path / "file.zarr").write_text("x")
    for name in ("file.zarr", "."):
        with pytest.raises(FileError):
            fs.Capture.load(tmp_path / name)
    with pytest.raises(FileError, match=r"must end in \.npz or \.zarr"):
        capture.save(tmp_path / "x.nc")


def test_missing_zarr_gives_pip_command(capture, tmp_path, monkeypatch):
    capture.save(tmp_path / "x.zarr")
    monkeypatch.setitem(sys.modules, "zarr", None)
    for call in (lambda: capture.save(tmp_path / "y.zarr"), lambda: fs.Capture.load(tmp_path / "x.zarr")):
        with pytest.raises(FileError, match=r"needs zarr; install it with: pip install 'foveasim\[video\]'"):
            call()
    assert not (tmp_path / "y.zarr").exists()


def test_view_shows_store_like_archive(capture, tmp_path):
    from foveasim.config import read_viewable

    capture.save(tmp_path / "x.zarr")
    assert_same(read_viewable(tmp_path / "x.zarr").data, capture)
    (tmp_path / "folder").mkdir()
    with pytest.raises(FileError):
        read_viewable(tmp_path / "folder")


# -- names of the package ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_explore_is_imported_when_used():
    code = (
        "import sys, foveasim as fs; before = 'foveasim.explore' in sys.modules; fs.explore.run_sweep; "
        "print(before, 'explore' in dir(fs), hasattr(fs, 'no_such_name'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout.split() == ["False", "True", "False"]
    assert fs.explore.__name__ == "foveasim.explore"
