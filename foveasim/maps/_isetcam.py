"""
Optical images of ISETCam and ISETBio in MAT files: the struct ``oi``, or its fields.

``data.photons`` (row, column, wave) are photons/(s m² nm), top row first; ``spectrum.wave`` is in nm. The image is centred on
the axis, its samples are square, and its width is ``2 f tan(wAngular / 2)`` with the focal length f (``oiGet(oi, 'width')``
since November 2021; earlier versions used the image distance). A single wavelength has a band width of 1 nm, as ISETCam's
``bin width``. Integer data from versions before 2017 are scaled to the range ``dmin`` to ``dmax``.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.names import possible_names
from foveasim._io.formats import FileFormat, FormatError
from foveasim.fields import from_file_rows
from foveasim.maps._common import Found, check_size, max_decompressed_bytes
from foveasim.maps._formats import MAP_FORMATS

__all__ = ["MAT5_MAGIC", "MAT73_MAGIC", "read_mat5", "read_mat73"]

MAT5_MAGIC, MAT73_MAGIC = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"
#: Names of the struct in files of scripts and of vcExportObject.
NAMES = ("oi", "opticalimage", "opticalImage")
PHOTONS, WAVES = ("data/photons", "photons"), ("spectrum/wave", "wave", "data/wave")
FIELDS = ("data", "photons", "spectrum", "wave", "wAngular", "optics")
#: MAT files of version 5: sizes of header and tag, types of elements, and bytes that are decompressed at a time.
HEADER_BYTES, TAG_BYTES, COMPRESSED, MATRIX = 128, 8, 15, 14
PIECE_BYTES = 2**20
#: Maximum number of values of fields other than the photons.
MAX_VALUES = 10_000

#: Function that returns a field by its path, ``optics/focalLength``; None if it is missing or not an array of numbers or text.
Field: TypeAlias = Callable[[str], "NDArray[Any] | None"]


def read_mat5(path: Path, name: str | None) -> Found:
    """Read a MAT file of version 5 or 7."""
    from scipy.io import loadmat, whosmat

    decompressed: Any = BytesIO(_decompress(path))
    names = [str(variable[0]) for variable in whosmat(decompressed)]
    decompressed.seek(0)
    struct = _struct(names, name)
    variables = list(FIELDS) if struct is None else [struct]
    tree: Any = loadmat(decompressed, variable_names=variables, struct_as_record=False, squeeze_me=False)

    def field(field_path: str) -> NDArray[Any] | None:
        first, *rest = field_path.split("/") if struct is None else (struct, *field_path.split("/"))
        part: Any = tree.get(first)
        for key in rest:
            if isinstance(part, np.ndarray) and part.dtype == object and part.size == 1:
                part = part.ravel()[0]
            part = getattr(part, key, None) if key in getattr(part, "_fieldnames", ()) else None
        return part if isinstance(part, np.ndarray) and part.dtype.kind in "iufcU" else None

    return _read_fields(field)


def read_mat73(path: Path, name: str | None) -> Found:
    """Read a MAT file of version 7.3, which is HDF5 with reversed axes."""
    import h5py

    n_bytes = path.stat().st_size
    with h5py.File(path, "r") as file:
        struct = _struct(list(file), name)

        def field(field_path: str) -> NDArray[Any] | None:
            part: Any = file
            for key in (field_path if struct is None else f"{struct}/{field_path}").split("/"):
                if not isinstance(part, h5py.Group) or not isinstance(part.get(key, getlink=True), h5py.HardLink):
                    return None
                part = part[key]
            if not isinstance(part, h5py.Dataset) or part.dtype.kind not in "iuf" or part.external or part.is_virtual:
                return None
            check_size(part.shape, part.dtype.itemsize, n_bytes)
            if field_path not in PHOTONS and part.size > MAX_VALUES:
                return None
            values = np.asarray(part[()]).transpose()
            is_text = part.attrs.get("MATLAB_class") in (b"char", "char")
            return np.array("".join(map(chr, values.ravel().tolist()))) if is_text else values

        return _read_fields(field)


def _struct(names: list[str], name: str | None) -> str | None:
    """Return the name of the optical image; None if the variables are its fields."""
    for one in NAMES if name is None else (name,):
        if one in names:
            return one
    if name is None and {"data", "photons"} & set(names):
        return None
    raise FormatError(f"contains no optical image {name or 'oi'!r:.40}; {possible_names(name or 'oi', names)}")


def _read_fields(field: Field) -> Found:
    photons, waves = (next((v for n in names if (v := field(n)) is not None), None) for names in (PHOTONS, WAVES))
    if photons is None:
        raise FormatError("contains no optical image with data.photons; compute it with oiCompute")
    if photons.ndim not in (2, 3) or 0 in photons.shape:
        raise FormatError(f"contains photons of shape {photons.shape[:5]}, expected (row, column, wave)")
    images = from_file_rows(_photon_rates(photons, field))
    pitch = _pitch_um(field, photons.shape[1])
    return Found(
        data=images,  # already bottom row first
        pitch_um=None if pitch is None else (pitch, pitch),
        wavelength_nm=None if waves is None else waves.ravel().tolist(),
        band_width_nm=[1.0] if images.shape[0] == 1 else None,
        unit="photons_s_m2_nm",
    )


def _photon_rates(photons: NDArray[Any], field: Field) -> NDArray[Any]:
    """Return photon rates, scaled from the integers of old versions."""
    if photons.dtype.kind != "u":
        return photons
    low, high = _number(field("data/dmin")), _number(field("data/dmax"))
    if low is None or high is None or not low <= high:
        raise FormatError("contains photons as integers without their range, dmin and dmax")
    return low + (high - low) / float(np.iinfo(photons.dtype).max) * photons.astype(np.float64)


def _pitch_um(field: Field, n_columns: int) -> float | None:
    """Return the side of a cell from the field of view; None without angle or focal length."""
    angle_deg, focal_m = _number(field("wAngular")), _number(field("optics/focalLength"))
    model = field("optics/model")
    if model is not None and "".join(model.ravel().astype(str).tolist()).lower().replace(" ", "") == "raytrace":
        focal_mm = _number(field("optics/rayTrace/effectiveFocalLength"))
        focal_m = None if focal_mm is None else focal_mm * 1e-3
    if angle_deg is None or focal_m is None or not 0.0 < angle_deg < 180.0 or not focal_m > 0.0:
        return None
    return 2.0 * focal_m * math.tan(math.radians(0.5 * angle_deg)) / n_columns * 1e6


def _number(values: NDArray[Any] | None) -> float | None:
    if values is None or values.size != 1 or values.dtype.kind not in "iuf":
        return None
    number = float(values.ravel()[0])
    return number if math.isfinite(number) else None


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


for _name, _magic, _read in (("mat73", MAT73_MAGIC, read_mat73), ("mat", MAT5_MAGIC, read_mat5)):
    MAP_FORMATS.register(
        _name, FileFormat(title="MAT", suffixes=(".mat",), signatures=(_magic,), read=_read, is_sandboxed=True)
    )
