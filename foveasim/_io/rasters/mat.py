"""
MAT files of MATLAB, and structs of ISETCam.

Versions 5 to 7 are read with scipy, version 7.3, which is HDF5 with reversed axes, with h5py. Structs are read by the path of a
field, ``scene/data/photons``. Sizes are checked before data are decompressed.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._core.registry import Registry
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.rasters import check_size, max_decompressed_bytes

_MAT5_MAGIC, _MAT73_MAGIC = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"
#: Fields of ISETCam structs with photons and wavelengths.
PHOTONS, WAVES = ("data/photons", "photons"), ("spectrum/wave", "wave", "data/wave")
#: Sizes of the elements of plain arrays by MATLAB class, bytes.
CLASS_BYTES = {"double": 8, "single": 4, "logical": 1, "char": 4} | {
    f"{sign}int{8 * size}": size for size in (1, 2, 4, 8) for sign in ("", "u")
}
#: MAT files of version 5: sizes of header and tag, types of elements, and bytes that are decompressed at a time.
HEADER_BYTES, TAG_BYTES, COMPRESSED, MATRIX = 128, 8, 15, 14
PIECE_BYTES = 2**20


@dataclass(frozen=True, kw_only=True)
class MatFile:
    """
    An open MAT file.

    ``names``: variables. ``shapes``: shapes, in the order of MATLAB, of those that are plain numeric arrays. ``read``:
    function that returns a variable, or a field such as ``oi/optics/focalLength``; None if it is missing or not an array of
    numbers or text. ``fields``: function that returns the names of the fields of a struct; empty for others.
    """

    names: list[str]
    shapes: dict[str, tuple[int, ...]]
    read: Callable[[str], NDArray[Any] | None]
    fields: Callable[[str], list[str]]


@contextmanager
def _open_mat5(path: Path) -> Iterator[MatFile]:
    """Open a MAT file of version 5 to 7."""
    from scipy.io import loadmat, whosmat

    classes = {str(name): (tuple(map(int, shape)), str(kind)) for name, shape, kind in whosmat(str(path))}
    variables: dict[str, Any] = {}

    def load(name: str) -> Any:
        shape, kind = classes[name]
        if kind in CLASS_BYTES:
            check_size(shape, CLASS_BYTES[kind], path.stat().st_size)
            source: Any = str(path)
        else:  # the size of a struct is not in its header
            source = BytesIO(_decompress(path))
        return loadmat(source, variable_names=[name], struct_as_record=False, squeeze_me=False)[name]

    def part_of(field: str) -> Any:
        first, *rest = field.split("/")
        if first not in classes:
            return None
        if first not in variables:
            variables[first] = load(first)
        part = _only(variables[first])
        for key in rest:
            part = _only(getattr(part, key, None)) if key in getattr(part, "_fieldnames", ()) else None
        return part

    def read(field: str) -> NDArray[Any] | None:
        part = part_of(field)
        return part if isinstance(part, np.ndarray) and part.dtype.kind in "iufcU" else None

    def fields(field: str) -> list[str]:
        return list(getattr(part_of(field), "_fieldnames", ()))

    shapes = {name: shape for name, (shape, kind) in classes.items() if kind in CLASS_BYTES and kind != "char"}
    yield MatFile(names=list(classes), shapes=shapes, read=read, fields=fields)


def _only(part: Any) -> Any:
    """Return the struct of an array of one, and other values unchanged."""
    is_struct = isinstance(part, np.ndarray) and part.dtype == object and part.size == 1
    return part.ravel()[0] if is_struct else part


@contextmanager
def _open_mat73(path: Path) -> Iterator[MatFile]:
    """Open a MAT file of version 7.3."""
    h5py = import_optional(path, "h5py", "maps")
    n_bytes = path.stat().st_size
    with h5py.File(path, "r") as file:

        def part_of(field: str) -> Any:
            part: Any = file
            for key in field.split("/"):
                if not isinstance(part, h5py.Group) or not isinstance(part.get(key, getlink=True), h5py.HardLink):
                    return None
                part = part[key]
            return part

        def fields(field: str) -> list[str]:
            part = part_of(field)
            return list(part) if isinstance(part, h5py.Group) else []

        def dataset(field: str) -> Any:
            part = part_of(field)
            is_plain = isinstance(part, h5py.Dataset) and not (part.external or part.is_virtual)
            return part if is_plain and part.dtype.kind in "iuf" else None

        def is_text(part: Any) -> bool:
            return part.attrs.get("MATLAB_class") in (b"char", "char")

        def read(field: str) -> NDArray[Any] | None:
            part = dataset(field)
            if part is None:
                return None
            check_size(part.shape, part.dtype.itemsize, n_bytes)
            values = np.asarray(part[()]).transpose()
            return np.array("".join(map(chr, values.ravel().tolist()))) if is_text(part) else values

        found = {name: part for name in file if (part := dataset(name)) is not None and not is_text(part)}
        shapes = {name: tuple(map(int, part.shape[::-1])) for name, part in found.items()}
        yield MatFile(names=[name for name in file if name != "#refs#"], shapes=shapes, read=read, fields=fields)


# -- structs of ISETCam -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class IsetStruct:
    """
    An optical image or a scene of ISETCam.

    ``photons`` (n_row, n_column[, n_wave]): photon rates per nm, top row first. ``wavelength_nm``, ``band_width_nm``: None
    if missing; a single wavelength has a band width of 1 nm, as ISETCam's ``bin width``. ``field``: as
    :attr:`MatFile.read`.
    """

    photons: NDArray[Any]
    wavelength_nm: list[float] | None
    band_width_nm: list[float] | None
    field: Callable[[str], NDArray[Any] | None]

    def number(self, path: str) -> float | None:
        """Return a field as a finite number; None if it is missing or another kind of value."""
        return _number(self.field(path))

    def text(self, path: str) -> str:
        """Return a field as text in lower case without spaces."""
        values = self.field(path)
        return "" if values is None else "".join(values.ravel().astype(str).tolist()).lower().replace(" ", "")


def find_struct(file: MatFile, name: str | None, known: tuple[str, ...], what: str, cure: str) -> IsetStruct:
    """
    Return the named struct, or one with a known name; the first one is the usual name.

    Without either, the variables ``data`` and ``photons`` are its fields. ``what``, ``cure``: kind of the struct and the
    function that computes it, for messages. Raises FormatError if the file does not contain the struct, or its photons are
    invalid.
    """
    struct = next((one for one in (known if name is None else (name,)) if one in file.names), None)
    if struct is None and (name is not None or not {"data", "photons"} & set(file.names)):
        wanted = name or known[0]
        raise FormatError(f"contains no {what} {wanted!r:.40}; {possible_names(wanted, file.names)}")

    def field(path: str) -> NDArray[Any] | None:
        return file.read(path if struct is None else f"{struct}/{path}")

    photons, waves = (next((v for n in names if (v := field(n)) is not None), None) for names in (PHOTONS, WAVES))
    if photons is None:
        raise FormatError(f"contains no {what} with data.photons; compute it with {cure}")
    if photons.ndim not in (2, 3) or 0 in photons.shape:
        raise FormatError(f"contains photons of shape {photons.shape[:5]}, expected (row, column, wave)")
    return IsetStruct(
        photons=_photon_rates(photons, _number(field("data/dmin")), _number(field("data/dmax"))),
        wavelength_nm=None if waves is None else waves.ravel().tolist(),
        band_width_nm=[1.0] if photons.size == math.prod(photons.shape[:2]) else None,
        field=field,
    )


def _number(values: NDArray[Any] | None) -> float | None:
    if values is None or values.size != 1 or values.dtype.kind not in "iuf":
        return None
    value = float(values.ravel()[0])
    return value if math.isfinite(value) else None


def _photon_rates(photons: NDArray[Any], low: float | None, high: float | None) -> NDArray[Any]:
    """Return photon rates; integers of versions before 2017 are scaled to a range."""
    if photons.dtype.kind != "u":
        return photons
    if low is None or high is None or not low <= high:
        raise FormatError("contains photons as integers without their range, dmin and dmax")
    return low + (high - low) / float(np.iinfo(photons.dtype).max) * photons.astype(np.float64)


# -- decompression with a limit -----------------------------------------------------------------------------------------


def _decompress(path: Path) -> bytes:
    """Return the file with decompressed elements, up to the size limit."""
    n_bytes = path.stat().st_size
    max_bytes = max_decompressed_bytes(n_bytes)
    with path.open("rb") as file:
        header = file.read(HEADER_BYTES)
        order = "little" if header[126:128] == b"IM" else "big"
        pieces, size = [header], HEADER_BYTES
        while len(tag := file.read(TAG_BYTES)) == TAG_BYTES:
            kind, length = int.from_bytes(tag[:4], order), int.from_bytes(tag[4:], order)  # type: ignore[arg-type]
            if kind not in (COMPRESSED, MATRIX) or length > n_bytes:
                raise FormatError("is corrupt: an element is not a variable, or is longer than the file")
            element = _inflate(file, length, max_bytes - size) if kind == COMPRESSED else tag + file.read(length)
            pieces.append(element)
            size += len(element)
            if size > max_bytes:
                raise FormatError(f"would decompress to more than {max_bytes} bytes; save it uncompressed, with -v6")
    return b"".join(pieces)


def _inflate(file: IO[bytes], length: int, max_bytes: int) -> bytes:
    """Return one decompressed element, limited to little more than ``max_bytes`` bytes."""
    inflater, parts, size = zlib.decompressobj(), [], 0
    while length > 0 and size <= max_bytes:
        compressed = file.read(min(length, PIECE_BYTES))
        if not compressed:
            raise FormatError("is truncated")
        length -= len(compressed)
        while compressed and size <= max_bytes:
            parts.append(inflater.decompress(compressed, PIECE_BYTES))
            size += len(parts[-1])
            compressed = inflater.unconsumed_tail
    return b"".join(parts)


def write_mat5(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a MAT file of version 5."""
    from scipy.io import savemat

    savemat(path, dict(tree))


def write_mat73(path: Path, tree: Mapping[str, Any]) -> None:
    """
    Write numbers, strings and mappings as MATLAB does.

    Axes are reversed, text is stored as numbers, and a header precedes the HDF5 data.
    """
    h5py = import_optional(path, "h5py", "maps")

    def fill(group: Any, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            if isinstance(value, Mapping):
                fill(group.create_group(name), value)
                continue
            is_text = isinstance(value, str)
            group[name] = np.array([[ord(c)] for c in value], np.uint16) if is_text else np.atleast_2d(value).T
            group[name].attrs["MATLAB_class"] = np.bytes_("char" if is_text else "double")

    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file, tree)
    with path.open("r+b") as binary:
        binary.write((_MAT73_MAGIC + b", Platform: GLNXA64").ljust(124) + b"\x00\x02IM")


# -- registration -------------------------------------------------------------------------------------------------------

#: Signature of files of each version, and functions that open and write them.
_VERSIONS = {
    "mat73": (_MAT73_MAGIC, _open_mat73, write_mat73),
    "mat": (_MAT5_MAGIC, _open_mat5, write_mat5),
}


def register_mat(
    formats: Registry[FileFormat],
    read: Callable[[MatFile, str | None], Any],
    example: Callable[[Callable[[Path, Mapping[str, Any]], None], Path], Any],
) -> None:
    """
    Register the versions of MAT files as formats.

    ``read``: function of an open file and the name of a variable. ``example``: function that writes an example with the given
    function to a path.
    """
    for name, (magic, open_file, write) in _VERSIONS.items():
        form = FileFormat(
            title="MAT",
            suffixes=(".mat",),
            signatures=(magic,),
            read=partial(_read, open_file, read),
            is_sandboxed=True,
        )
        formats.register(name, form, example=partial(example, write))


def _read(
    open_file: Callable[[Path], AbstractContextManager[MatFile]],
    read: Callable[[MatFile, str | None], Any],
    path: Path,
    name: str | None,
) -> Any:
    with open_file(path) as file:
        return read(file, name)
