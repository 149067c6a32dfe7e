"""Rows of sharded zarr arrays, with zarr as the reference."""

from __future__ import annotations

import json

import numpy as np
import pytest
from lazy_modules import LazyModule

from foveasim.explore.datasets.zarr_rows import CHUNK_BYTES, RowReader, create_rows, rows_per_chunk

zarr = LazyModule("zarr")

N = 11


def created(directory, values, per_shard):
    """Write an array shard by shard, and return its reader and the array."""
    group = zarr.open_group(str(directory), mode="w", zarr_format=3)
    is_text = values.dtype.kind == "T"
    create_rows(
        group,
        "x",
        n=len(values),
        per_shard=per_shard,
        shape=values.shape[1:],
        dtype=str if is_text else values.dtype,
        dimensions=("sample", *"abc"[: values.ndim - 1]),
        attributes={"unit": "DN"},
    )
    with zarr.config.set({"array.write_empty_chunks": True}):
        array = zarr.open_group(str(directory), mode="r+")["x"]
    for start in range(0, len(values), per_shard):
        array[start : start + per_shard] = values[start : start + per_shard]
    return RowReader(array, directory / "x"), array


def example(kind):
    rng = np.random.default_rng(0)
    return {
        "numbers": rng.normal(size=N),
        "integers": rng.integers(-(2**60), 2**60, N),
        "flags": rng.random((N, 500)) < 0.5,
        "codes": rng.integers(0, 4096, (N, 3000), np.uint16),
        "small": rng.integers(0, 9, (N, 3, 4), np.int64),
        "pictures": rng.normal(size=(N, 3, 40, 50)).astype(np.float32),
        "zeros": np.zeros((N, 1000), np.int64),
        "nothing": np.zeros((N, 0, 4)),
        "strings": np.array(["", "µm", "a" * 300, *map(str, range(N - 3))], np.dtypes.StringDType()),
    }[kind]


@pytest.mark.parametrize("per_shard", [1, 4, 8, 11])
@pytest.mark.parametrize(
    "kind", ["numbers", "integers", "flags", "codes", "small", "pictures", "zeros", "nothing", "strings"]
)
def test_rows_equal_those_of_zarr(kind, per_shard, tmp_path):
    values = example(kind)
    rows, array = created(tmp_path, values, per_shard)

    for k in np.random.default_rng(1).permutation(N).tolist():
        found = rows.read(k)
        np.testing.assert_array_equal(found, array[k])
        np.testing.assert_array_equal(found, values[k])
        if kind != "strings":
            assert (found.dtype, found.shape) == (values.dtype, values.shape[1:])


@pytest.mark.parametrize(("per_shard", "row_bytes"), [(512, 7488), (24, 4000), (31, 100), (7, 10**9), (1, 1)])
def test_chunks_divide_shards_and_are_small(per_shard, row_bytes):
    n = rows_per_chunk(per_shard, row_bytes)

    assert per_shard % n == 0
    assert n == 1 or n * row_bytes <= CHUNK_BYTES


def test_row_reads_only_its_bytes(tmp_path):
    """Bytes of other chunks may be anything."""
    values = example("pictures")
    rows, _ = created(tmp_path, values, 8)
    (file,) = (tmp_path / "x" / "c" / "0").rglob("0/0/0")
    content = bytearray(file.read_bytes())
    index = np.frombuffer(content[-(8 * 16 + 4) : -4], "<u8").reshape(8, 2)
    for k, (offset, length) in enumerate(index.tolist()):
        if k != 5:
            content[offset : offset + length] = bytes(length)
    file.write_bytes(content)

    np.testing.assert_array_equal(rows.read(5), values[5])
    with pytest.raises((ValueError, RuntimeError)):
        rows.read(4)


@pytest.mark.parametrize("kind", ["numbers", "codes", "strings"])
@pytest.mark.parametrize("kept", [0, 3, 0.5, 0.99])
def test_truncated_shards_are_corrupt(kind, kept, tmp_path):
    rows, _ = created(tmp_path, example(kind), N)
    (file,) = (path for path in (tmp_path / "x" / "c").rglob("*") if path.is_file())
    content = file.read_bytes()
    file.write_bytes(content[: int(kept * len(content)) if isinstance(kept, float) else kept])

    with pytest.raises((ValueError, RuntimeError, UnicodeDecodeError)):
        rows.read(N - 1)


def test_changed_byte_violates_checksum(tmp_path):
    rows, _ = created(tmp_path, example("codes"), 1)
    file = tmp_path / "x" / "c" / "3" / "0"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)

    with pytest.raises((ValueError, RuntimeError)):
        rows.read(3)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"zstd"', '"gzip"'),
        ('"end"', '"start"'),
        ('"little"', '"big"'),
        ('"crc32c"', '"zstd"'),
        ('"separator": "/"', '"separator": "."'),
    ],
)
def test_other_layouts_are_rejected(old, new, tmp_path):
    _, array = created(tmp_path, example("codes"), 4)
    text = json.dumps(array.metadata.to_dict(), default=str)
    assert old in text

    class Metadata:
        def to_dict(self):
            return json.loads(text.replace(old, new))

    class Other:
        metadata, dtype, ndim, shape, path = Metadata(), array.dtype, array.ndim, array.shape, "x"

    with pytest.raises(ValueError, match="'x' has another chunk layout or other codecs"):
        RowReader(Other(), tmp_path / "x")
