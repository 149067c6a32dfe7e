"""Storage of datasets in shards, written atomically and in parallel, and resumable."""

from __future__ import annotations

import io
import json
import math
import operator
import os
import tarfile
import time
import warnings
from array import array
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.extras import import_optional
from foveasim._core.names import missing_path
from foveasim._core.threads import thread_count
from foveasim._core.validation import Ints
from foveasim._io.atomic import atomic_directory, atomic_write
from foveasim.errors import FileError, FoveasimWarning, ParameterError, SimulationError, warn
from foveasim.explore.datasets.dataset import Dataset
from foveasim.explore.datasets.items import flatten, unflatten
from foveasim.explore.datasets.zarr_rows import RowReader, create_rows
from foveasim.explore.executor import KILLED, WORKERS, executor

__all__ = ["StoredSamples", "open_dataset", "write_dataset"]

FORMAT = "foveasim dataset"
ZARR, ABOUT = ".zarr", "dataset.json"
#: Default size of a shard: approximate bytes and largest number of samples. Each process has one shard in memory.
SHARD_BYTES, MAX_SHARD_SAMPLES = 1 << 26, 512
#: Smallest default number of shards, so that many processes can write, and an interruption loses little.
MIN_SHARDS = 32
#: Smallest default number of samples of a shard, even if there are then fewer shards: small datasets have few files. Larger
#: shards have a multiple of this number, so that zarr chunks of 2, 4 or 8 samples divide them.
MIN_SHARD_SAMPLES = 8
#: Name of the array with the digest of each complete shard.
DONE = "done"
#: First member of a tar file, with the digest of its inputs; WebDataset skips such names.
INPUT_DIGEST = "__made_of__"
#: Extensions of the members of a sample in a tar file that are read; the class is also in the JSON.
READ_EXTENSIONS = ("npz", "json")
#: Bytes of a SHA-256.
DIGEST_BYTES = 32
#: Remaining time in one process above which worker processes are started, seconds; their start takes seconds.
SINGLE_PROCESS_S = 10.0

#: Function of the number of written samples and the total number.
Progress = Callable[[int, int], None]


def write_dataset(
    dataset: Dataset,
    path: str | Path,
    *,
    per_shard: Annotated[int | None, Limits(at_least=1)] = None,
    workers: Annotated[int | None, WORKERS] = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> StoredSamples:
    """
    Simulate and write all samples, or resume an interrupted call.

    Parameters
    ----------
    dataset : Dataset
    path : path
        ``.zarr``: zarr store with a sharded array for each item of the samples, its dimensions and its unit. Without an
        extension: directory of tar files ``shard-000000.tar`` ... in the format of WebDataset, with the arrays (``.npz``), the
        other items (``.json``) and, with labels, the class (``.cls``) of each sample. Both read single samples in any order;
        zarr also reads arrays of all samples.
    per_shard : int, optional
        Number of samples per shard; by default 1/32 of the dataset, from 8 to 512 samples, and at most about 64 MiB.
    workers : int, optional
        Number of processes; 1 and 0 are this process. Other processes import the main file of the calling program: call this
        function under ``if __name__ == "__main__":``. None: one process per core, as soon as the estimated remaining time in
        this process exceeds 10 s.
    scheduler : str, optional
        Address of a dask scheduler instead, such as ``"tcp://10.0.0.1:8786"``. Its workers need this package, and access to
        the pictures and ``path`` under the same names.
    progress : callable, optional
        Called with the number of written samples and the total number.

    Returns
    -------
    StoredSamples
        Bit-identical for any number of workers and after any interruption.

    Raises
    ------
    FileError
        When the extension is not supported, the path contains other data, a picture cannot be read, or writing fails, for
        example on a full disk. Complete shards remain, and the same call resumes, unless the pictures, masks or flows of
        complete shards have changed.
    ParameterError
        When samples have different layouts, which only tar files support, or no scheduler answers.
    SimulationError
        When the camera of a sample cannot be built, a process ends repeatedly, the scheduler is lost, or pictures cannot be
        sent to other processes.

    Warns
    -----
    FoveasimWarning
        Once, when samples have warnings; the item ``warning`` of a sample contains its own.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> import numpy as np
    >>> scene = {
    ...     "kind": "picture",
    ...     "picture": "",
    ...     "fit": "cover",
    ...     "distance_m": 1.0,
    ...     "illuminance_lux": 500.0,
    ... }
    >>> layout = {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 8.0}}
    >>> shot = {
    ...     "scene": scene,
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": layout,
    ...     "exposure_s": 0.01,
    ... }
    >>> dataset = fs.explore.denoising(np.full((2, 32, 32), 128, np.uint8), shot)
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     stored = fs.explore.write_dataset(dataset, Path(directory, "noisy"))
    ...     print(len(stored), sorted(path.name for path in stored.path.glob("*.tar")))
    8 ['shard-000000.tar']
    """
    target = Path(path).absolute()
    kind = _shards_class(target)
    if kind is _ZarrShards:
        if dataset.is_layout_varied:
            raise ParameterError(
                "layout", "must not vary in a zarr store, whose arrays have one length; use a directory of tar files"
            )
        import_optional(target, "zarr", "explore")
    plan = json.loads(json.dumps(dataset.to_dict()))
    about = _read_about(target) if os.path.exists(target) else None  # noqa: PTH110 -- False, not an error, without permission
    if about is None:
        items = dataset.describe_items()
        arrays = [item for item in items.values() if item["shape"]]
        n_bytes = max(1, sum(np.dtype(item["dtype"]).itemsize * math.prod(item["shape"]) for item in arrays))
        about = {
            "format": FORMAT,
            "version": kind.version,
            "n_samples": len(dataset),
            "per_shard": per_shard or _default_per_shard(len(dataset), n_bytes),
            "class_names": dataset.class_names,
            "items": items,
            "plan": plan,
        }
        kind.create(target, about, dataset)
    else:
        _check_same(target, about, plan, per_shard)
    _write_shards(dataset, kind(target, about), scheduler, workers, progress)
    return open_dataset(target)


def _default_per_shard(n_samples: int, n_bytes: int) -> int:
    """Return the default number of samples of a shard, for samples of a given size."""
    n = min(max(n_samples // MIN_SHARDS // MIN_SHARD_SAMPLES, 1) * MIN_SHARD_SAMPLES, MAX_SHARD_SAMPLES)
    return max(1, min(n, SHARD_BYTES // n_bytes, n_samples))


def _check_same(target: Path, about: Mapping[str, Any], plan: Mapping[str, Any], per_shard: int | None) -> None:
    different = next((key for key in plan if about["plan"].get(key) != plan[key]), None)
    if different is None and per_shard not in (None, about["per_shard"]):
        different = "per_shard"
    if different is not None:
        raise FileError(
            target, f"is another dataset: its {different!r} differs; use another path, or remove the existing dataset"
        )


def _write_shards(
    dataset: Dataset, shards: _Shards, scheduler: str | None, workers: int | None, progress: Progress | None
) -> None:
    """Write missing shards, after a check that the inputs of complete shards are unchanged."""
    missing = array("q")
    for k in range(shards.n_shards):
        input_digest = shards.input_digest(k)
        if not input_digest:
            missing.append(k)
        elif input_digest != dataset.digest(shards.samples(k)):
            samples = shards.samples(k)
            raise FileError(
                shards.directory,
                f"was written from other pictures, masks or flows: those of samples {samples[0]} to {samples[-1]} have "
                "changed; use another path, or remove the existing dataset",
            )
    n, n_done = shards.n_samples, shards.n_samples - sum(len(shards.samples(k)) for k in missing)
    n_warnings, first_warning = 0, ""
    if progress is not None:
        progress(n_done, n)
    with closing(_write_each(dataset, shards, missing, scheduler, workers)) as results:
        for k, (n_in_shard, first) in results:
            n_warnings, first_warning = n_warnings + n_in_shard, min(first_warning or first, first or first_warning)
            n_done += len(shards.samples(k))
            if progress is not None:
                progress(n_done, n)
    if n_warnings:
        warn(f"{n_warnings:,} of the samples written have warnings, such as: {first_warning}", FoveasimWarning)


def _write_each(
    dataset: Dataset, shards: _Shards, missing: Sequence[int], scheduler: str | None, workers: int | None
) -> Generator[tuple[int, _Warnings], None, None]:
    """Write shards, and yield each with the warnings of its samples."""
    write = partial(_write_shard, dataset, shards)
    start_s = time.monotonic()
    n_done = 0
    if scheduler is None and workers in (None, 0, 1):
        for n_done, k in enumerate(missing):
            n_left = len(missing) - n_done
            left_s = n_left * (time.monotonic() - start_s) / n_done if n_done else 0.0
            if workers is None and n_left > 1 and left_s > SINGLE_PROCESS_S:
                break
            yield k, write(k)
        else:
            return
    what = "the pictures or labels"
    n_workers = min(workers or thread_count(), len(missing) - n_done)
    with executor(write, what=what, scheduler=scheduler, workers=n_workers) as run:
        for k, found in run(missing[n_done:], ()):
            if found is KILLED:
                raise SimulationError(
                    f"the process that wrote shard {k} ended in every attempt: out of memory, or a crash; complete shards "
                    "remain, and the same call resumes"
                )
            yield k, found


class _Warnings(NamedTuple):
    """Number of samples of a shard that have warnings, and the alphabetically first warning."""

    n: int
    first: str


def _write_shard(dataset: Dataset, shards: _Shards, k: int) -> _Warnings:
    """Simulate and write a shard, and return the warnings of its samples."""
    input_digest = dataset.digest(shards.samples(k))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # summarised at the end
        samples = [dataset[index] for index in shards.samples(k)]
    try:
        shards.write(k, samples, input_digest)
    except OSError as error:
        raise FileError(
            shards.directory,
            f"cannot be written: {error.strerror or error}; complete shards remain, and the same call resumes",
        ) from None
    found = [f"sample {sample['index']}: {sample['warning']}" for sample in samples if sample["warning"]]
    return _Warnings(len(found), min(found, default=""))


# -- reading ----------------------------------------------------------------------------------------------------------


class StoredSamples:
    """
    Stored samples, bit-identical to those of the written :class:`Dataset`.

    The class is a map-style dataset too, with ``__len__`` and ``__getitem__``.

    Attributes
    ----------
    path : Path
    about : mapping
        Settings, distributions, seed, class names and versions.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        self.path: Path = path
        self.about: Mapping[str, Any] = about
        self._shards = _shards_class(path)(path, about)

    def __repr__(self) -> str:
        return f"StoredSamples({len(self)} in {self.path})"

    def __len__(self) -> int:
        """Return the number of samples."""
        return self._shards.n_samples

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Iterate over all samples."""
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> dict[str, Any]:
        """
        Read a sample.

        Raises
        ------
        IndexError
            When the index is out of range.
        FileError
            When the shard of the sample is corrupt.
        """
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"sample index {position} is out of range for {len(self)} samples")
        position %= len(self)
        try:
            return self._shards.read(position)
        except Exception as error:  # noqa: BLE001 -- corrupt shards raise many kinds of errors
            raise FileError(self.path, f"has a corrupt sample {position} ({' '.join(str(error).split())})") from None

    @property
    def class_names(self) -> list[str] | None:
        """Names of the classes by label, or None."""
        names: list[str] | None = self.about["class_names"]
        return names


def open_dataset(path: str | Path) -> StoredSamples:
    """
    Open a dataset of :func:`write_dataset`; samples are read on access.

    Raises
    ------
    FileError
        When the dataset does not exist, is corrupt, or is incomplete.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> import numpy as np
    >>> scene = {
    ...     "kind": "picture",
    ...     "picture": "",
    ...     "fit": "cover",
    ...     "distance_m": 1.0,
    ...     "illuminance_lux": 500.0,
    ... }
    >>> layout = {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 8.0}}
    >>> shot = {
    ...     "scene": scene,
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": layout,
    ...     "exposure_s": 0.01,
    ... }
    >>> dataset = fs.explore.denoising(np.full((2, 32, 32), 128, np.uint8), shot)
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     _ = fs.explore.write_dataset(dataset, Path(directory, "noisy.zarr"))
    ...     print(fs.explore.open_dataset(Path(directory, "noisy.zarr"))[5]["code"].shape)
    (64,)
    """
    source = Path(path).absolute()
    try:
        if not source.is_dir():
            raise FileError(source, missing_path(source, "directory"))
    except OSError as error:
        raise FileError(source, f"cannot be read: {error.strerror or error}") from None
    if source.suffix.lower() == ZARR:
        import_optional(source, "zarr", "explore")
    stored = StoredSamples(source, _read_about(source))
    shards = stored._shards  # noqa: SLF001 -- same module
    n_done = sum(shards.is_complete(k) for k in range(shards.n_shards))
    if n_done < shards.n_shards:
        raise FileError(source, f"has {n_done} of {shards.n_shards} shards; write the same dataset again to resume")
    return stored


def _read_about(target: Path) -> dict[str, Any]:
    """Read the description of a stored dataset."""
    is_zarr = target.suffix.lower() == ZARR
    file = target / ("zarr.json" if is_zarr else ABOUT)
    about: Any = None
    try:
        read = json.loads(file.read_text(encoding="utf-8"))
        about = read["attributes"] if is_zarr else read
    except (OSError, ValueError, KeyError, TypeError):
        pass
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise FileError(target, "is not a dataset of foveasim; use another path")
    expected = _shards_class(target).version
    if about.get("version") != expected:
        raise FileError(
            target, f"has the format version {about.get('version')}, expected {expected}; write the dataset again"
        )
    return about


def _shards_class(target: Path) -> type[_Shards]:
    if target.suffix.lower() == ZARR:
        return _ZarrShards
    if target.suffix:
        raise FileError(target, "must have the extension .zarr, or none for a directory of tar files")
    return _TarShards


# -- shards -----------------------------------------------------------------------------------------------------------


class _Shards:
    """
    Base class of stored shards with a fixed number of samples each.

    ``version``: version of the format.
    """

    version: int

    def __init__(self, directory: Path, about: Mapping[str, Any]) -> None:
        self.directory = directory
        self.n_samples, self.per_shard = int(about["n_samples"]), int(about["per_shard"])
        self.n_shards = -(-self.n_samples // self.per_shard)

    @staticmethod
    def create(target: Path, about: Mapping[str, Any], dataset: Dataset) -> None:
        """Create the store for samples with the given items."""
        raise NotImplementedError

    def samples(self, k: int) -> range:
        """Return the indices of the samples of a shard."""
        return range(k * self.per_shard, min((k + 1) * self.per_shard, self.n_samples))

    def is_complete(self, k: int) -> bool:
        """Return whether a shard is complete."""
        return self.input_digest(k) != ""

    def input_digest(self, k: int) -> str:
        """Return the digest of the inputs of a shard; empty when it is missing or corrupt."""
        raise NotImplementedError

    def write(self, k: int, samples: Sequence[Mapping[str, Any]], input_digest: str) -> None:
        """Write a shard."""
        raise NotImplementedError

    def read(self, index: int) -> dict[str, Any]:
        """Read a sample."""
        raise NotImplementedError


class _TarShards(_Shards):
    """Shards as tar files, which exist only when complete."""

    version = 2

    def __init__(self, directory: Path, about: Mapping[str, Any]) -> None:
        super().__init__(directory, about)
        self._members: dict[int, Ints] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_members": {}}

    @staticmethod
    def create(target: Path, about: Mapping[str, Any], dataset: Dataset) -> None:
        with atomic_directory(target, is_ours=lambda _: False) as new:
            (new / ABOUT).write_text(json.dumps(about, indent=1), encoding="utf-8")
            if not dataset.is_layout_varied:
                dataset.layout.write(new / "layout.npz")

    def _file(self, k: int) -> Path:
        return self.directory / f"shard-{k:06d}.tar"

    def is_complete(self, k: int) -> bool:
        return self._file(k).is_file()

    def input_digest(self, k: int) -> str:
        try:
            with tarfile.open(self._file(k), "r:") as tar:
                first = tar.next()
                content = None if first is None or first.name != INPUT_DIGEST else tar.extractfile(first)
                return "" if content is None else content.read().decode()
        except (OSError, tarfile.TarError, UnicodeDecodeError):
            return ""

    def write(self, k: int, samples: Sequence[Mapping[str, Any]], input_digest: str) -> None:
        with (
            atomic_write(self._file(k)) as temporary,
            tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar,
        ):
            _add(tar, INPUT_DIGEST, input_digest.encode())
            for sample in samples:
                arrays: dict[str, Any] = {n: value for n, value in sample.items() if isinstance(value, np.ndarray)}
                rest = {name: value for name, value in sample.items() if name not in arrays}
                compressed = io.BytesIO()
                np.savez_compressed(compressed, **arrays)
                parts = {"npz": compressed.getvalue(), "json": json.dumps(rest).encode()}
                if "label" in sample:
                    parts["cls"] = str(sample["label"]).encode()
                for extension, content in parts.items():
                    _add(tar, f"{sample['index']:09d}.{extension}", content)

    def read(self, index: int) -> dict[str, Any]:
        k, position = divmod(index, self.per_shard)
        if k not in self._members:
            self._members[k] = self._read_members(k)
        with self._file(k).open("rb") as file:

            def content(extension: str) -> bytes:
                offset, size = self._members[k][position, READ_EXTENSIONS.index(extension)].tolist()
                if offset == 0:
                    raise ValueError("missing")
                file.seek(offset)
                return file.read(size)

            rest = json.loads(content("json"))
            with np.load(io.BytesIO(content("npz")), allow_pickle=False) as arrays:
                return rest | {name: arrays[name] for name in arrays.files}

    def _read_members(self, k: int) -> Ints:
        """Return the offset and size of the members of each sample, (n_sample, n_extension, 2)."""
        members = np.zeros((len(self.samples(k)), len(READ_EXTENSIONS), 2), np.int64)
        with tarfile.open(self._file(k), "r:") as tar:
            for item in tar:
                number, _, extension = item.name.partition(".")
                if extension in READ_EXTENSIONS and number.isdecimal() and int(number) in self.samples(k):
                    position = int(number) - self.samples(k).start
                    members[position, READ_EXTENSIONS.index(extension)] = item.offset_data, item.size
        return members


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    item = tarfile.TarInfo(name)
    item.size = len(content)
    tar.addfile(item, io.BytesIO(content))


class _ZarrShards(_Shards):
    """Shards of zarr arrays, with a digest that is written after all arrays."""

    version = 3

    def __init__(self, directory: Path, about: Mapping[str, Any]) -> None:
        super().__init__(directory, about)
        if not isinstance(about.get("items"), Mapping):
            raise FileError(directory, "is corrupt: it does not describe the items of its samples")
        self._names = list(about["items"])
        self._opened: tuple[int, dict[str, Any]] | None = None
        self._readers: dict[str, RowReader] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None, "_readers": None}

    @staticmethod
    def create(target: Path, about: Mapping[str, Any], dataset: Dataset) -> None:
        zarr = import_optional(target, "zarr", "explore")
        n, per_shard = about["n_samples"], about["per_shard"]

        with atomic_directory(target, is_ours=lambda _: False) as new:
            group = zarr.open_group(str(new), mode="w", zarr_format=3)
            for name, item in about["items"].items():
                create_rows(
                    group,
                    name,
                    n=n,
                    per_shard=per_shard,
                    shape=item["shape"],
                    dtype=str if item["dtype"] == "str" else item["dtype"],
                    dimensions=("sample", *item["dimensions"]),
                    attributes={key: item[key] for key in item if key not in ("dimensions", "shape", "dtype")},
                )
            group.create_array(
                DONE,
                shape=(-(-n // per_shard), DIGEST_BYTES),
                chunks=(1, DIGEST_BYTES),
                dtype="u1",
                fill_value=0,
                filters=None,
                compressors=None,
                dimension_names=("shard", "byte"),
            )
            layout = dataset.layout
            for name in ("xy_um", "ring_offsets", "site_offsets"):
                group.create_array(f"layout/{name}", data=np.asarray(getattr(layout, name)))
            group.create_array("layout/filter_of_site", data=np.asarray(dataset.shot(0).camera.sensor.filter_of_site))
            # Last, because these attributes identify the directory as a dataset.
            group.attrs.update(about)

    def _arrays(self) -> dict[str, Any]:
        if self._opened is None or self._opened[0] != os.getpid():
            zarr = import_optional(self.directory, "zarr", "explore")
            # Chunks of zeros are written, so that a missing one is an error.
            with zarr.config.set({"array.write_empty_chunks": True}):
                group = zarr.open_group(str(self.directory), mode="r+")
                arrays = {name: group[name] for name in (*self._names, DONE)}
            self._opened = os.getpid(), arrays
        return self._opened[1]

    def _rows(self) -> dict[str, RowReader]:
        """Return the reader of each array; forked processes can use it, too."""
        if self._readers is None:
            try:
                arrays = self._arrays()
                self._readers = {name: RowReader(array, self.directory / name) for name, array in arrays.items()}
            except Exception as error:  # noqa: BLE001 -- corrupt metadata raise many kinds of errors
                reason = " ".join(str(error).split()) or type(error).__name__
                raise FileError(self.directory, f"is corrupt ({reason:.200})") from None
        return self._readers

    def input_digest(self, k: int) -> str:
        done = self._rows()[DONE]
        try:
            mark = np.asarray(done.read(k))
        except (OSError, ValueError):  # a truncated digest counts as missing
            return ""
        return mark.tobytes().hex() if mark.any() else ""

    def write(self, k: int, samples: Sequence[Mapping[str, Any]], input_digest: str) -> None:
        arrays, position = self._arrays(), slice(self.samples(k).start, self.samples(k).stop)
        flattened = [flatten(sample) for sample in samples]
        for name in flattened[0]:
            values: list[Any] = [sample[name] for sample in flattened]
            if isinstance(values[0], str):
                arrays[name][position] = np.array(values, np.dtypes.StringDType())
            else:
                arrays[name][position] = np.array(values).astype(arrays[name].dtype, casting="safe", copy=False)
        arrays[DONE][k] = np.frombuffer(bytes.fromhex(input_digest), np.uint8)

    def read(self, index: int) -> dict[str, Any]:
        found = {name: rows.read(index) for name, rows in self._rows().items() if name != DONE}
        return unflatten(
            {
                name: value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
                for name, value in found.items()
            }
        )
