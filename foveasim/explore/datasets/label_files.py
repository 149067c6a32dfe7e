"""Label files: classes in CSV, boxes in COCO JSON, directories of masks and flows."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from foveasim._core.validation import Floats
from foveasim.errors import FileError

__all__ = ["FLOW_ENDINGS", "MASK_ENDINGS", "files_of_pictures", "read_boxes", "read_labels"]

#: Size limit of a label file, bytes: the boxes of 100,000 photographs take half of this.
MAX_LABEL_BYTES = 1 << 30
#: Columns of a CSV file of classes.
PICTURE, LABEL = "picture", "label"
#: Extensions of masks (lossless formats only) and of optical flow.
MASK_ENDINGS, FLOW_ENDINGS = (".png", ".bmp", ".tif", ".tiff"), (".npy",)
#: Left, top, width, height in pixels.
_Box = tuple[float, float, float, float]
WHOLE = re.compile(r"[+-]?\d+")


def read_labels(path: Path, pictures: Sequence[str]) -> list[int] | list[str]:
    """
    Read the classes of pictures from a CSV or array file.

    Parameters
    ----------
    path : Path
        ``.csv``: UTF-8 with the columns ``picture`` and ``label`` in its first line, and lines in any order; other columns are
        ignored. ``.npy``: array of integers or strings, one per picture in the order of the pictures.
    pictures : sequence of str
        Names of the pictures in the file, which may list others too.

    Returns
    -------
    labels : list of int or of str
        Integers if all labels of the file are integers.

    Raises
    ------
    FileError
        When the file cannot be read, or does not contain exactly one class for each picture.
    """
    content = _content(path)
    if path.suffix.lower() == ".npy":
        return list(_array(path).tolist())
    if path.suffix.lower() != ".csv":
        raise FileError(path, "must be a .csv file with the columns 'picture' and 'label', or an array (.npy)")
    try:
        lines = list(csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileError(path, f"is not a valid UTF-8 CSV file ({error})") from None
    head = [name.strip() for name in lines[0]] if lines else []
    if PICTURE not in head or LABEL not in head:
        raise FileError(path, f"must have the columns '{PICTURE}' and '{LABEL}' in its first line, got {head}")
    at_picture, at_label = head.index(PICTURE), head.index(LABEL)
    found: dict[str, str] = {}
    for number, line in enumerate(lines[1:], 2):
        if not line:
            continue
        if len(line) != len(head):
            raise FileError(path, f"has {len(line)} values in line {number}, expected {len(head)}")
        name = line[at_picture].strip()
        if name in found:
            raise FileError(path, f"lists the picture '{name}' twice, again in line {number}")
        found[name] = line[at_label].strip()
    _check_all(path, pictures, found)
    labels = [found[name] for name in pictures]
    return [int(label) for label in labels] if all(WHOLE.fullmatch(label) for label in found.values()) else labels


class _CocoImage(BaseModel):
    model_config = ConfigDict(extra="ignore")
    id: int | str
    file_name: str


class _CocoAnnotation(BaseModel):
    model_config = ConfigDict(extra="ignore")
    image_id: int | str
    category_id: int
    bbox: _Box
    iscrowd: int = 0


class _Coco(BaseModel):
    """Keys that are read from a COCO file; others, such as outlines and licences, are ignored."""

    model_config = ConfigDict(extra="ignore")
    images: list[_CocoImage]
    annotations: list[_CocoAnnotation]


def read_boxes(path: Path, pictures: Sequence[str]) -> list[Floats]:
    """
    Read the boxes of pictures from a JSON file in COCO format.

    Parameters
    ----------
    path : Path
        File with ``images`` (``id``, ``file_name``) and ``annotations`` (``image_id``, ``category_id``, ``bbox``: left, top,
        width, height in pixels). Crowd annotations (``iscrowd``) are ignored.
    pictures : sequence of str
        Names of the pictures in the file, which may list others too.

    Returns
    -------
    boxes : list of (n_box, 5) float64, pixels
        For each picture: x0, y0, x1, y1 from its upper left corner, y down, and the category number.

    Raises
    ------
    FileError
        When the file cannot be read, does not list a picture, or a box has no area.
    """
    try:
        coco = TypeAdapter(_Coco).validate_json(_content(path))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"]))
        rule = first["msg"].replace("Input should", "must")
        raise FileError(path, f"is not a valid COCO file ({place + ': ' if place else ''}{rule})") from None
    numbers: dict[str, int | str] = {}
    for image in coco.images:
        if image.file_name in numbers:
            raise FileError(path, f"lists the picture '{image.file_name}' twice")
        numbers[image.file_name] = image.id
    _check_all(path, pictures, numbers)
    boxes: dict[int | str, list[list[float]]] = {numbers[name]: [] for name in pictures}
    for k, annotation in enumerate(coco.annotations):
        if annotation.image_id not in boxes or annotation.iscrowd:
            continue
        left, top, width, height = annotation.bbox
        if not (np.isfinite(annotation.bbox).all() and width > 0.0 and height > 0.0):
            raise FileError(path, f"annotations.{k}: must have a box with an area > 0, got {list(annotation.bbox)}")
        boxes[annotation.image_id].append([left, top, left + width, top + height, float(annotation.category_id)])
    return [np.array(boxes[numbers[name]], np.float64).reshape(-1, 5) for name in pictures]


def files_of_pictures(folder: Path, pictures: Sequence[str], endings: Sequence[str]) -> list[Path]:
    """
    Return the file for each picture, with the same name and another extension.

    Parameters
    ----------
    folder : Path
        Directory with the same subdirectories as that of the pictures.
    pictures : sequence of str
        Names of the pictures.
    endings : sequence of str
        Allowed extensions.

    Raises
    ------
    FileError
        When the directory does not exist, or does not contain exactly one file for each picture.
    """
    if not folder.is_dir():
        raise FileError(folder, "no such directory" if not folder.exists() else "is not a directory")
    found: dict[str, Path] = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() in endings:
            name = file.relative_to(folder).with_suffix("").as_posix()
            if name in found:
                raise FileError(folder, f"has two files for the picture '{name}': {found[name].name} and {file.name}")
            found[name] = file
    wanted = [PurePosixPath(name).with_suffix("").as_posix() for name in pictures]
    twice = next((name for name, n in Counter(wanted).items() if n > 1), None)
    if twice is not None:
        raise FileError(folder, f"must have one file per picture, but two pictures have the name '{twice}'")
    _check_all(folder, wanted, found, f" ({', '.join(endings)})")
    return [found[name] for name in wanted]


def _check_all(path: Path, pictures: Sequence[str], found: Iterable[str], of: str = "") -> None:
    names = set(found)
    missing = [name for name in pictures if name not in names]
    if missing:
        has = f"it contains '{min(names)}'" if names else "it contains no entries"
        raise FileError(
            path, f"has no entry for {len(missing):,} of {len(pictures):,} pictures, first '{missing[0]}'; {has}{of}"
        )


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise FileError(path, "no such file" if not path.exists() else "is not a file")
    if path.stat().st_size > MAX_LABEL_BYTES:
        raise FileError(path, f"is larger than {MAX_LABEL_BYTES} bytes, the limit of label files")
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileError(path, f"cannot be read: {error.strerror or error}") from None


def _array(path: Path) -> NDArray[np.generic]:
    try:
        array: NDArray[np.generic] = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FileError(path, f"is not a readable array ({error})") from None
    if not isinstance(array, np.ndarray) or array.ndim != 1 or array.dtype.kind not in "iuU":
        raise FileError(path, "must be a one-dimensional array of integers or strings")
    return array
