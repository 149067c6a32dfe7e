"""Labels in the files that people have: classes in CSV, boxes in COCO's JSON, masks and flows in folders of their own."""

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

#: A larger file of labels is something else: the boxes of a hundred thousand photographs take half of this.
MAX_LABEL_BYTES = 1 << 30
#: Columns of a CSV file of classes.
PICTURE, LABEL = "picture", "label"
#: Endings of masks, in which every pixel is as it was written, and of optical flow.
MASK_ENDINGS, FLOW_ENDINGS = (".png", ".bmp", ".tif", ".tiff"), (".npy",)
#: Left, top, width, height in pixels.
_Box = tuple[float, float, float, float]
WHOLE = re.compile(r"[+-]?\d+")


def read_labels(path: Path, pictures: Sequence[str]) -> list[int] | list[str]:
    """
    Classes of pictures, of a CSV file or of an array.

    Parameters
    ----------
    path : Path
        ``.csv`` in UTF-8 with the columns ``picture`` and ``label`` in its first line, in any order of lines; others are not
        looked at. ``.npy``: an array of integers or texts, one for each picture in their order.
    pictures : sequence of str
        What the file calls them; it may name others too.

    Returns
    -------
    labels : list of int or of str
        Integers where all of the file's are.

    Raises
    ------
    FileError
        When it cannot be read, or has no class for a picture, or two.
    """
    content = _content(path)
    if path.suffix.lower() == ".npy":
        return list(_array(path).tolist())
    if path.suffix.lower() != ".csv":
        raise FileError(path, "must be a .csv file with the columns 'picture' and 'label', or an array (.npy)")
    try:
        lines = list(csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileError(path, f"is no CSV file in UTF-8 ({error})") from None
    head = [name.strip() for name in lines[0]] if lines else []
    if PICTURE not in head or LABEL not in head:
        raise FileError(path, f"must have the columns '{PICTURE}' and '{LABEL}' in its first line, got {head}")
    at_picture, at_label = head.index(PICTURE), head.index(LABEL)
    found: dict[str, str] = {}
    for number, line in enumerate(lines[1:], 2):
        if not line:
            continue
        if len(line) != len(head):
            raise FileError(path, f"has {len(line)} values in line {number}, and {len(head)} columns")
        name = line[at_picture].strip()
        if name in found:
            raise FileError(path, f"has the picture '{name}' twice, in line {number} again")
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
    """What is taken of a COCO file; what else there is, outlines and licences, is not looked at."""

    model_config = ConfigDict(extra="ignore")
    images: list[_CocoImage]
    annotations: list[_CocoAnnotation]


def read_boxes(path: Path, pictures: Sequence[str]) -> list[Floats]:
    """
    Boxes of pictures, of a JSON file as COCO has it.

    Parameters
    ----------
    path : Path
        With ``images`` (``id``, ``file_name``) and ``annotations`` (``image_id``, ``category_id``, ``bbox``: left, top, width,
        height in pixels). Annotations of crowds (``iscrowd``) are left out.
    pictures : sequence of str
        What the file calls them; it may name others too.

    Returns
    -------
    boxes : list of (n_box, 5) float64, pixels
        Of each picture: x0, y0, x1, y1 from its upper left corner, y down, and the category's number.

    Raises
    ------
    FileError
        When it cannot be read, does not name a picture, or a box has no area.
    """
    try:
        coco = TypeAdapter(_Coco).validate_json(_content(path))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"]))
        rule = first["msg"].replace("Input should", "must")
        raise FileError(path, f"holds no boxes as COCO has them ({place + ': ' if place else ''}{rule})") from None
    numbers: dict[str, int | str] = {}
    for image in coco.images:
        if image.file_name in numbers:
            raise FileError(path, f"names the picture '{image.file_name}' twice")
        numbers[image.file_name] = image.id
    _check_all(path, pictures, numbers)
    boxes: dict[int | str, list[list[float]]] = {numbers[name]: [] for name in pictures}
    for k, annotation in enumerate(coco.annotations):
        if annotation.image_id not in boxes or annotation.iscrowd:
            continue
        left, top, width, height = annotation.bbox
        if not (np.isfinite(annotation.bbox).all() and width > 0.0 and height > 0.0):
            raise FileError(path, f"annotations.{k}: has a box without an area: {list(annotation.bbox)}")
        boxes[annotation.image_id].append([left, top, left + width, top + height, float(annotation.category_id)])
    return [np.array(boxes[numbers[name]], np.float64).reshape(-1, 5) for name in pictures]


def files_of_pictures(folder: Path, pictures: Sequence[str], endings: Sequence[str]) -> list[Path]:
    """
    A file for each picture, of the same name with another ending.

    Parameters
    ----------
    folder : Path
        With the folders in it that the pictures' own has.
    pictures : sequence of str
    endings : sequence of str

    Raises
    ------
    FileError
        When there is no such folder, or not exactly one file of a picture.
    """
    if not folder.is_dir():
        raise FileError(folder, "no such folder" if not folder.exists() else "is not a folder")
    found: dict[str, Path] = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() in endings:
            name = file.relative_to(folder).with_suffix("").as_posix()
            if name in found:
                raise FileError(folder, f"has two files of the picture '{name}': {found[name].name} and {file.name}")
            found[name] = file
    wanted = [PurePosixPath(name).with_suffix("").as_posix() for name in pictures]
    twice = next((name for name, n in Counter(wanted).items() if n > 1), None)
    if twice is not None:
        raise FileError(folder, f"cannot tell two pictures apart that are called '{twice}'")
    _check_all(folder, wanted, found, f" ({', '.join(endings)})")
    return [found[name] for name in wanted]


def _check_all(path: Path, pictures: Sequence[str], found: Iterable[str], of: str = "") -> None:
    names = set(found)
    missing = [name for name in pictures if name not in names]
    if missing:
        has = f"it has '{min(names)}'" if names else "it has none"
        raise FileError(
            path, f"has nothing for {len(missing):,} of the {len(pictures):,} pictures, first '{missing[0]}'; {has}{of}"
        )


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise FileError(path, "no such file" if not path.exists() else "is not a file")
    if path.stat().st_size > MAX_LABEL_BYTES:
        raise FileError(path, f"is larger than {MAX_LABEL_BYTES} bytes, and so no file of labels")
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileError(path, f"cannot be read: {error.strerror or error}") from None


def _array(path: Path) -> NDArray[np.generic]:
    try:
        array: NDArray[np.generic] = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FileError(path, f"is no array that can be read ({error})") from None
    if not isinstance(array, np.ndarray) or array.ndim != 1 or array.dtype.kind not in "iuU":
        raise FileError(path, "must be an array of one dimension, of integers or of texts")
    return array
