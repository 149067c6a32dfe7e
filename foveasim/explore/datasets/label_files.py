"""Label files: classes in CSV, boxes in COCO JSON, directories of masks and flows."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, TypeAdapter, ValidationError

from foveasim._core.names import missing_path
from foveasim._core.validation import Floats
from foveasim._io.text_files import read_columns, read_text
from foveasim.errors import FileError
from foveasim.explore._files import load_array
from foveasim.explore.datasets.packed import PackedFiles

__all__ = ["FLOW_EXTENSIONS", "MASK_EXTENSIONS", "match_label_files", "read_boxes", "read_labels"]

#: Size limit of a label file, bytes: the boxes of 100,000 photographs take half of this.
MAX_LABEL_BYTES = 1 << 30
#: Columns of a CSV file of classes.
PICTURE, LABEL = "picture", "label"
#: Extensions of masks (lossless formats only) and of optical flow.
MASK_EXTENSIONS, FLOW_EXTENSIONS = (".png", ".bmp", ".tif", ".tiff"), (".npy",)
#: Left, top, width, height in pixels.
_Box = tuple[float, float, float, float]
INTEGER = re.compile(r"[+-]?\d+")


def read_labels(path: Path, pictures: Sequence[str]) -> list[int] | list[str]:
    """
    Read the classes of pictures from a CSV or array file.

    ``path``: ``.csv``: UTF-8 with the columns ``picture`` and ``label`` in its first line, and lines in any order; other
    columns are ignored. ``.npy``: array of integers or strings, one per picture in the order of the pictures. ``pictures``:
    names of the pictures in the file, which may list others too. Returns ``labels``: integers if all labels of the file are
    integers. Raises FileError when the file cannot be read, or does not contain exactly one class for each picture.
    """
    if path.suffix.lower() == ".npy":
        return list(_array(path).tolist())
    if path.suffix.lower() != ".csv":
        raise FileError(path, "must be a .csv file with the columns 'picture' and 'label', or an array (.npy)")
    found: dict[str, str] = {}
    for number, (name, label) in read_columns(
        path, "a table of labels", (PICTURE, LABEL), MAX_LABEL_BYTES, has_numbers=False
    ):
        if name in found:
            raise FileError(path, f"lists the picture '{name}' twice, again in line {number}")
        found[name] = label
    _check_complete(path, pictures, found)
    labels = [found[name] for name in pictures]
    return [int(label) for label in labels] if all(INTEGER.fullmatch(label) for label in found.values()) else labels


class _CocoImage(BaseModel):
    id: int | str
    file_name: str


class _CocoAnnotation(BaseModel):
    image_id: int | str
    category_id: int
    bbox: _Box
    iscrowd: int = 0


class _Coco(BaseModel):
    """Keys that are read from a COCO file; others, such as outlines and licences, are ignored."""

    images: list[_CocoImage]
    annotations: list[_CocoAnnotation]


def read_boxes(path: Path, pictures: Sequence[str]) -> list[Floats]:
    """
    Read the boxes of pictures from a JSON file in COCO format.

    ``path``: file with ``images`` (``id``, ``file_name``) and ``annotations`` (``image_id``, ``category_id``, ``bbox``: left,
    top, width, height in pixels). Crowd annotations (``iscrowd``) are ignored. ``pictures``: names of the pictures in the
    file, which may list others too. Returns ``boxes``, list of (n_box, 5) float64, pixels: for each picture: x0, y0, x1, y1
    from its upper left corner, y down, and the category number. Raises FileError when the file cannot be read, does not list a
    picture, or a box has no area.
    """
    try:
        coco = TypeAdapter(_Coco).validate_json(read_text(path, "a COCO file", MAX_LABEL_BYTES))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        location = ".".join(map(str, first["loc"]))
        rule = first["msg"].replace("Input should", "must")
        raise FileError(path, f"is not a valid COCO file ({location + ': ' if location else ''}{rule})") from None
    numbers: dict[str, int | str] = {}
    for image in coco.images:
        if image.file_name in numbers:
            raise FileError(path, f"lists the picture '{image.file_name}' twice")
        numbers[image.file_name] = image.id
    _check_complete(path, pictures, numbers)
    boxes: dict[int | str, list[list[float]]] = {numbers[name]: [] for name in pictures}
    for k, annotation in enumerate(coco.annotations):
        if annotation.image_id not in boxes or annotation.iscrowd:
            continue
        left, top, width, height = annotation.bbox
        if not (np.isfinite(annotation.bbox).all() and width > 0.0 and height > 0.0):
            raise FileError(path, f"annotations.{k}: must have a box with an area > 0, got {list(annotation.bbox)}")
        boxes[annotation.image_id].append([left, top, left + width, top + height, float(annotation.category_id)])
    return [np.array(boxes[numbers[name]], np.float64).reshape(-1, 5) for name in pictures]


def match_label_files(directory: Path, pictures: Sequence[str], extensions: Sequence[str]) -> PackedFiles:
    """
    Return the file for each picture, with the same name and another extension.

    ``directory``: directory with the same subdirectories as that of the pictures. ``pictures``: names of the pictures.
    ``extensions``: allowed extensions. Raises FileError when the directory does not exist, or does not contain exactly one
    file for each picture.
    """
    if not directory.is_dir():
        raise FileError(directory, missing_path(directory, "directory"))
    found: dict[str, Path] = {}
    for file in sorted(directory.rglob("*")):
        if file.suffix.lower() in extensions:
            name = file.relative_to(directory).with_suffix("").as_posix()
            if name in found:
                raise FileError(
                    directory, f"has two files for the picture '{name}': {found[name].name} and {file.name}"
                )
            found[name] = file
    expected = [PurePosixPath(name).with_suffix("").as_posix() for name in pictures]
    repeated = next((name for name, n in Counter(expected).items() if n > 1), None)
    if repeated is not None:
        raise FileError(directory, f"must have one file per picture, but two pictures have the name '{repeated}'")
    _check_complete(directory, expected, found, f" ({', '.join(extensions)})")
    return PackedFiles(directory, (found[name].relative_to(directory).as_posix() for name in expected))


def _check_complete(path: Path, pictures: Sequence[str], found: Iterable[str], of: str = "") -> None:
    names = set(found)
    missing = [name for name in pictures if name not in names]
    if missing:
        has = f"it contains '{min(names)}'" if names else "it contains no entries"
        raise FileError(
            path, f"has no entry for {len(missing):,} of {len(pictures):,} pictures, first '{missing[0]}'; {has}{of}"
        )


def _array(path: Path) -> NDArray[np.generic]:
    array: NDArray[np.generic] = load_array(path)
    if not isinstance(array, np.ndarray) or array.ndim != 1 or array.dtype.kind not in "iuU":
        raise FileError(path, "must be a one-dimensional array of integers or strings")
    return array
