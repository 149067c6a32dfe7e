"""
MAT files of MATLAB, and structs of ISETCam.

Versions 5 to 7 are read with scipy, version 7.3, which is HDF5 with reversed axes, with h5py. Structs are read by the path of a
field, ``scene/data/photons``. Sizes are checked before data are decompressed.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._io.formats import FormatError
from foveasim._io.rasters import check_size, max_decompressed_bytes

__all__ = ["MAT5_MAGIC", "MAT73_MAGIC", "IsetStruct", "MatFile", "find_struct", "open_mat5", "open_mat73"]

MAT5_MAGIC, MAT73_MAGIC = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"
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

    Attributes
    ----------
    names : list of str
        Variables.
    shapes : dict
        Shapes of the variables that are plain numeric arrays, in the order of MATLAB.
    read : function
        Function that returns a variable, or a field such as ``oi/optics/focalLength``; None if it is missing or not an array of
        numbers or text.
    """

    names: list[str]
    shapes: dict[str, tuple[int, ...]]
    read: Callable[[str], NDArray[Any] | None]


@contextmanager
def open_mat5(path: Path) -> Iterator[MatFile]:
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

    def read(field: str) -> NDArray[Any] | None:
        first, *rest = field.split("/")
        if first not in classes:
            return None
        if first not in variables:
            variables[first] = load(first)
        part: Any = variables[first]
        for key in rest:
            if isinstance(part, np.ndarray) and part.dtype == object and part.size == 1:
                part = part.ravel()[0]
            part = getattr(part, key, None) if key in getattr(part, "_fieldnames", ()) else None
        return part if isinstance(part, np.ndarray) and part.dtype.kind in "iufcU" else None

    shapes = {name: shape for name, (shape, kind) in classes.items() if kind in CLASS_BYTES and kind != "char"}
    yield MatFile(names=list(classes), shapes=shapes, read=read)


@contextmanager
def open_mat73(path: Path) -> Iterator[MatFile]:
    """Open a MAT file of version 7.3."""
    h5py = import_optional(path, "h5py", "maps")
    n_bytes = path.stat().st_size
    with h5py.File(path, "r") as file:

        def dataset(field: str) -> Any:
            part: Any = file
            for key in field.split("/"):
                if not isinstance(part, h5py.Group) or not isinstance(part.get(key, getlink=True), h5py.HardLink):
                    return None
                part = part[key]
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
        yield MatFile(names=list(file), shapes=shapes, read=read)


# -- structs of ISETCam -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class IsetStruct:
    """
    An optical image or a scene of ISETCam.

    Attributes
    ----------
    photons : (n_row, n_column[, n_wave])
        Photon rates per nm, top row first.
    wavelength_nm, band_width_nm : list of float, nm
        None if missing. A single wavelength has a band width of 1 nm, as ISETCam's ``bin width``.
    field : function
        Function that returns a field by its path, as :attr:`MatFile.read`.
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
    Return the named struct, or one with a known name.

    Without either, the variables ``data`` and ``photons`` are its fields.

    Parameters
    ----------
    file : MatFile
    name : str, optional
    known : tuple of str
        Names in files of ISETCam; the first one is the usual name.
    what, cure : str
        Kind of the struct and the function that computes it, for messages.

    Raises
    ------
    FormatError
        If the file does not contain the struct, or its photons are invalid.
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
