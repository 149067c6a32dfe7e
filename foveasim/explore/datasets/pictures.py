"""Picture sources of a dataset: directories, zip files, arrays and sequences."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from foveasim._core.names import missing_path
from foveasim._io.encodings import FileEncoding
from foveasim._io.images import PICTURE_EXTENSIONS, EncodedPicture, as_encoded, picture_names
from foveasim.errors import FileError, ParameterError, type_name
from foveasim.explore._files import digests, load_array
from foveasim.explore.datasets.packed import PackedFiles, PackedStrings

__all__ = ["Source", "digest_of", "is_lazy", "source_of"]

#: Largest decompressed size of a picture, bytes.
MAX_DECOMPRESSED_BYTES = 2**30


class Source(ABC):
    """Sequence of pictures with names and optional classes."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def name(self, k: int) -> str:
        """Return the name of a picture for messages."""

    def key(self, k: int) -> str:
        """Return the name of a picture in label files: relative path, or index."""
        return str(k)

    @abstractmethod
    def picture(self, k: int, encoding: FileEncoding = "auto") -> EncodedPicture:
        """Read a picture as :func:`foveasim._io.images.as_encoded`, top row first."""

    def labels(self) -> list[Any] | None:
        """Return the class of every picture if the source contains classes, else None."""
        return None

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return plain data that identifies the source, without the contents of its pictures."""

    @property
    def is_lazy(self) -> bool:
        """Whether the items of the source may be computed on access."""
        return False

    @abstractmethod
    def digest(self, k: int) -> str:
        """Return a checksum of the contents of a picture, without decompressing it."""


def source_of(pictures: Any) -> Source:
    """Create the source of the pictures of a dataset; return a source unchanged."""
    if isinstance(pictures, Source):
        return pictures
    if isinstance(pictures, str | Path):
        path = Path(pictures).absolute()
        try:
            if path.is_dir():
                return _Directory(path)
            if not path.is_file():
                raise FileError(path, missing_path(path, "file or directory"))
        except OSError as error:
            raise _read_error(error, path) from None
        if path.suffix.lower() == ".npy":
            return _ArrayFile(path)
        if zipfile.is_zipfile(path):
            return _Zip(path)
        raise FileError(path, "must be a directory of pictures, a zip file of pictures, or an array (.npy)")
    if isinstance(pictures, np.ndarray):
        return _Array(pictures)
    if isinstance(pictures, Mapping) or not (hasattr(pictures, "__len__") and hasattr(pictures, "__getitem__")):
        raise ParameterError(
            "pictures", f"must be a directory, a zip file, an array, or a sequence, got {type_name(pictures)}"
        )
    return _Items(pictures)


def is_lazy(items: Sequence[Any]) -> bool:
    """Return whether items of a sequence may be computed on access."""
    return not isinstance(items, list | tuple | np.ndarray | PackedFiles)


def digest_of(item: Any) -> str:
    """
    Compute the SHA-256 of a file, or of an array with its dtype and shape.

    The result is empty when the item cannot be read; its reader reports the error.
    """
    try:
        if isinstance(item, str | Path):
            return digests([Path(item)])[str(Path(item))]
        array = np.ascontiguousarray(item)
        digest = hashlib.sha256(f"{array.dtype.str} {np.shape(item)}".encode())
        digest.update(array.data)
    except (OSError, TypeError, ValueError):
        return ""
    return digest.hexdigest()


class _Files(Source):
    """Picture files in natural order of their names."""

    kind: ClassVar[str]

    def __init__(self, path: Path, names: Iterable[str]) -> None:
        self._path, self._names = path, PackedStrings(picture_names(names))
        if not self._names:
            raise FileError(path, f"contains no pictures ({', '.join(PICTURE_EXTENSIONS)})")

    def __len__(self) -> int:
        return len(self._names)

    def key(self, k: int) -> str:
        return self._names[k]

    def labels(self) -> list[Any] | None:
        """Return the top-level directory of each picture; None if a picture is in none."""
        directories = [PurePosixPath(name).parts[0] if "/" in name else None for name in self._names]
        return directories if all(directory is not None for directory in directories) else None

    def to_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, **_names_digest(self._names)}


class _Directory(_Files):
    """Pictures of a directory and its subdirectories."""

    kind = "folder"

    def __init__(self, directory: Path) -> None:
        found = (
            f"{prefix}{name}"
            for root, _, names in os.walk(directory, onerror=_raise_error)
            for prefix in [f"{Path(root).relative_to(directory).as_posix()}/".removeprefix("./")]
            for name in names
        )
        super().__init__(directory, found)

    def name(self, k: int) -> str:
        return str(self._path / self._names[k])

    def picture(self, k: int, encoding: FileEncoding = "auto") -> EncodedPicture:
        return as_encoded(self._path / self._names[k], encoding)

    def digest(self, k: int) -> str:
        return digest_of(self._path / self._names[k])


class _Zip(_Files):
    """Pictures of a zip file, which every process opens separately."""

    kind = "zip"

    def __init__(self, path: Path) -> None:
        try:
            with zipfile.ZipFile(path) as archive:
                names = [item.filename for item in archive.infolist() if not item.is_dir()]
        except (OSError, zipfile.BadZipFile) as error:
            raise FileError(path, f"is corrupt ({error})") from None
        super().__init__(path, names)
        self._opened: tuple[int, zipfile.ZipFile] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None}

    def name(self, k: int) -> str:
        return f"{self._path}!{self._names[k]}"

    def picture(self, k: int, encoding: FileEncoding = "auto") -> EncodedPicture:
        archive, name = self._archive(), self._names[k]
        if archive.getinfo(name).file_size > MAX_DECOMPRESSED_BYTES:
            raise FileError(self.name(k), f"would decompress to more than {MAX_DECOMPRESSED_BYTES} bytes")
        try:
            content = archive.read(name)
        except Exception as error:  # noqa: BLE001 -- corrupt members raise many kinds of errors
            raise FileError(self.name(k), f"is corrupt ({' '.join(str(error).split())})") from None
        with tempfile.TemporaryDirectory(prefix="foveasim-") as directory:
            file = Path(directory) / f"picture{PurePosixPath(name).suffix}"
            file.write_bytes(content)
            try:
                return as_encoded(file, encoding)
            except FileError as error:
                raise FileError(self.name(k), str(error).removeprefix(f"{file}: ")) from None

    def _archive(self) -> zipfile.ZipFile:
        # A forked process shares the file position of its parent.
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = os.getpid(), zipfile.ZipFile(self._path)
        return self._opened[1]

    def digest(self, k: int) -> str:
        # Decompressed data are checked against this CRC.
        item = self._archive().getinfo(self._names[k])
        return f"{item.file_size} bytes, {item.CRC:08x}"


class _Array(Source):
    """Array of pictures (n, n_y, n_x) or (n, n_y, n_x, n_channel) in memory."""

    def __init__(self, pictures: NDArray[Any]) -> None:
        _check_stack("pictures", pictures)
        self._pictures = pictures

    def __len__(self) -> int:
        return int(self._pictures.shape[0])

    def name(self, k: int) -> str:
        return f"picture {k}"

    def picture(self, k: int, encoding: FileEncoding = "auto") -> EncodedPicture:
        return as_encoded(self._pictures[k], encoding)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "array", "shape": list(self._pictures.shape), "dtype": str(self._pictures.dtype)}

    def digest(self, k: int) -> str:
        return digest_of(self._pictures[k])


class _ArrayFile(Source):
    """Memory-mapped ``.npy`` file of pictures."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._pictures: NDArray[Any] | None = None
        self._n = len(self._array())

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_pictures": None}

    def _array(self) -> NDArray[Any]:
        if self._pictures is None:
            pictures = load_array(self._path, mmap_mode="r")
            _check_stack(str(self._path), pictures)
            self._pictures = pictures
        return self._pictures

    def __len__(self) -> int:
        return self._n

    def name(self, k: int) -> str:
        return f"{self._path}[{k}]"

    def picture(self, k: int, encoding: FileEncoding = "auto") -> EncodedPicture:
        return as_encoded(np.array(self._array()[k]), encoding)

    def to_dict(self) -> dict[str, Any]:
        array = self._array()
        return {"kind": "array file", "name": self._path.name, "shape": list(array.shape), "dtype": str(array.dtype)}

    def digest(self, k: int) -> str:
        return digest_of(self._array()[k])


class _Items(Source):
    """Sequence of files, arrays or Pillow images, or of pairs of these with their classes."""

    def __init__(self, items: Sequence[Any]) -> None:
        if len(items) == 0:
            raise ParameterError("pictures", "must contain at least one picture")
        self._items = items

    def __len__(self) -> int:
        return len(self._items)

    def name(self, k: int) -> str:
        item = self._stored_item(k)
        return str(item) if isinstance(item, str | Path) else f"picture {k}"

    def key(self, k: int) -> str:
        item = self._stored_item(k)
        return Path(item).name if isinstance(item, str | Path) else str(k)

    def _item(self, k: int) -> Any:
        item = self._items[k]
        return item[0] if isinstance(item, tuple) else item

    def _stored_item(self, k: int) -> Any:
        """Return an item of a list, or None if items may be computed on access."""
        return None if self.is_lazy else self._item(k)

    def picture(self, k: int, encoding: FileEncoding = "auto") -> EncodedPicture:
        item = self._item(k)
        if isinstance(item, str | Path):
            return as_encoded(item, encoding)
        if _is_image(item):
            try:
                return as_encoded(item, encoding)
            except ParameterError as error:
                raise FileError(self.name(k), f"is not a readable image: {error.detail}") from None
        try:
            return as_encoded(np.asarray(item), encoding)
        except ValueError:
            raise ParameterError(f"picture {k}", "must be a file or an array of numbers", item) from None

    def labels(self) -> list[Any] | None:
        if isinstance(self._items, list | tuple):
            is_pair = [isinstance(item, tuple) and len(item) > 1 for item in self._items]
            if all(is_pair):
                return [item[1] for item in self._items]
            if any(isinstance(item, tuple) for item in self._items):
                raise ParameterError("pictures", "must all be pairs (picture, label), or all be pictures")
            return None
        targets = getattr(self._items, "targets", None)
        if targets is not None and len(targets) == len(self):
            return np.asarray(targets).tolist()
        if isinstance(self._items[0], tuple):
            return [self._items[k][1] for k in range(len(self))]
        return None

    def to_dict(self) -> dict[str, Any]:
        names = {} if self.is_lazy else _names_digest(PackedStrings(self.name(k) for k in range(len(self))))
        return {"kind": "items", "n": len(self)} | names

    @property
    def is_lazy(self) -> bool:
        return is_lazy(self._items)

    def digest(self, k: int) -> str:
        item = self._item(k)
        return digest_of(item if isinstance(item, str | Path) else self.picture(k, "linear").pixels)


def _is_image(item: Any) -> bool:
    """Return whether an item is a Pillow image; without Pillow in use, none is."""
    pillow = sys.modules.get("PIL.Image")
    return pillow is not None and isinstance(item, pillow.Image)


def _names_digest(names: PackedStrings) -> dict[str, Any]:
    """Return the number of names and their SHA-256."""
    return {"n": len(names), "sha256": names.digest()}


def _read_error(error: OSError, path: Path) -> FileError:
    return FileError(error.filename or path, f"cannot be read: {error.strerror or error}")


def _raise_error(error: OSError) -> None:
    """Raise errors of ``os.walk``, which would skip unreadable directories silently."""
    raise _read_error(error, Path())


def _check_stack(name: str, pictures: NDArray[Any]) -> None:
    if pictures.ndim not in (3, 4) or 0 in pictures.shape or (pictures.ndim == 4 and pictures.shape[3] > 4):
        raise ParameterError(
            name, f"must have the shape (n, n_y, n_x) or (n, n_y, n_x, 1 to 4 channels), got {pictures.shape}"
        )
