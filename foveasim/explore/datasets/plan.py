"""A dataset in a YAML file: pictures, a shot, what is drawn, labels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from foveasim._io.yaml_files import read_yaml
from foveasim.config import files_from, picture_path, validated
from foveasim.explore.datasets.dataset import Dataset
from foveasim.explore.datasets.label_files import (
    FLOW_ENDINGS,
    MASK_ENDINGS,
    files_of_pictures,
    read_boxes,
    read_labels,
)
from foveasim.explore.datasets.pictures import Source, source_of
from foveasim.explore.datasets.recipes import classification, denoising
from foveasim.explore.sweeps.plan import telling

__all__ = ["DatasetFile", "DatasetSection", "read_dataset"]

#: What a file may say instead of distributions of its own.
RECIPES: dict[str | None, Callable[..., Dataset]] = {
    None: Dataset,
    "classification": classification,
    "denoising": denoising,
}
#: Of a distribution, in the unit of its setting.
_Numbers = list[float]
#: Keys that a dataset's call has too.
SAME = ("cameras", "draws", "seed", "fields", "fit")


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetFile:
    """
    A dataset with what its file says about it.

    Attributes
    ----------
    dataset : Dataset
    per_shard : int or None
        Samples of a shard, where it says so.
    """

    dataset: Dataset
    per_shard: int | None


class _Distribution(BaseModel):
    """What a setting is drawn from: one of these."""

    model_config = ConfigDict(extra="forbid", strict=True)
    uniform: _Numbers | None = Field(None, description="[low, high]")
    log_uniform: _Numbers | None = Field(None, description="[low, high]")
    integers: list[int] | None = Field(None, description="[low, high], both of them included")
    normal: _Numbers | None = Field(None, description="[mean, standard deviation, low, high]")
    choice: list[Any] | None = Field(None, description="values to choose from")
    weights: _Numbers | None = Field(None, description="of a choice: its chances are in proportion to them")


class DatasetSection(BaseModel):
    """A dataset: pictures, a shot, what is drawn of its settings, how often, labels, shards."""

    model_config = ConfigDict(extra="forbid", strict=True)
    pictures: str | list[str] = Field(description="a folder, a zip file, an array (.npy), or a list of files")
    shot: str | dict[str, Any] = Field(description="a file beside this one, or the settings themselves")
    set: dict[str, Any] = Field({}, description="settings to be replaced in all samples, by their paths")
    recipe: Literal["classification", "denoising"] | None = Field(
        None, description="usual distributions and fields, beside those that are given"
    )
    vary: dict[str, _Distribution] = Field({}, description="distributions by settings' paths")
    cameras: int | None = Field(None, description="that each picture is taken with; 1 by default")
    draws: int | None = Field(None, description="captures with each camera; 1 by default, and 4 for denoising")
    seed: int = 0
    fields: list[Literal["code", "electrons", "expected_e", "expected_dn"]] | None = Field(
        None, description="what a sample has of each site; code and electrons by default, or those of the recipe"
    )
    fit: Literal["cover", "contain"] | None = Field(None, description="pictures of any size on the layout")
    labels: str | list[int | str] | None = Field(
        None, description="a .csv file with the columns picture and label, an array (.npy), or a list"
    )
    boxes: str | None = Field(None, description="a JSON file as COCO has it")
    masks: str | None = Field(None, description="a folder with a .png, .bmp or .tif file of each picture's name")
    flows: str | None = Field(None, description="a folder with a .npy file of each picture's name")
    per_shard: int | None = Field(None, ge=1, description="samples of a shard")


def read_dataset(path: str | Path, *, n_threads: int = 1) -> DatasetFile:
    """
    Read a YAML file of a dataset, and make ready what it describes.

    Parameters
    ----------
    path : path
        With the keys ``pictures`` (a folder, a zip file, an array, or a list of files), ``shot`` (a file beside it, or the
        settings themselves), ``vary`` (distributions by settings' paths, as for :func:`parse_distribution`), ``recipe``
        (``classification`` or ``denoising``), ``cameras``, ``draws``, ``seed``, ``fields`` and ``fit`` (as for
        :class:`Dataset`), ``labels`` (a CSV file with the columns ``picture`` and ``label``, an array, or a list), ``boxes`` (a
        JSON file as COCO has it), ``masks`` and ``flows`` (folders with a file of each picture's name), ``per_shard``, and
        ``set`` (settings to be replaced in all samples). Files are looked for beside it; ``skimage:astronaut`` and its like are
        the pictures that come with scikit-image. In files of labels, pictures have the names that they have in their folder,
        and those of an array their numbers.
    n_threads : int
        That a sample is computed with.

    Returns
    -------
    DatasetFile

    Raises
    ------
    ConfigError
        With the file, the place in it, what was expected and got.
    FileError
        When pictures or labels cannot be read, or do not go together.
    """
    path = Path(path)
    section: DatasetSection = validated(path, DatasetSection, read_yaml(path))
    folder = path.parent
    source = _pictures(path, section.pictures)
    options = {name: value for name in SAME if (value := getattr(section, name)) is not None}
    labels = _labels(folder, section, source)
    with telling(path):
        dataset = RECIPES[section.recipe](
            source,
            folder / section.shot if isinstance(section.shot, str) else section.shot,
            {name: _distribution(folder, name, told) for name, told in section.vary.items()},
            changes={name: files_from(folder, value, name) for name, value in section.set.items()},
            source=path,
            n_threads=n_threads,
            **options,
            **labels,
        )
    return DatasetFile(dataset=dataset, per_shard=section.per_shard)


def _pictures(path: Path, pictures: str | list[str]) -> Source:
    with telling(path):
        if isinstance(pictures, str):
            return source_of(path.parent / pictures)
        return source_of([picture_path(path, name, f"pictures.{k}").absolute() for k, name in enumerate(pictures)])


def _labels(folder: Path, section: DatasetSection, pictures: Source) -> Mapping[str, Any]:
    """What a dataset's call is given of labels."""
    names = [pictures.key(k) for k in range(len(pictures))]
    found: dict[str, Any] = {}
    if isinstance(section.labels, str):
        found["labels"] = read_labels(folder / section.labels, names)
    elif section.labels is not None:
        found["labels"] = section.labels
    if section.boxes is not None:
        found["boxes"] = read_boxes(folder / section.boxes, names)
    if section.masks is not None:
        found["masks"] = files_of_pictures(folder / section.masks, names, MASK_ENDINGS)
    if section.flows is not None:
        found["flows"] = files_of_pictures(folder / section.flows, names, FLOW_ENDINGS)
    return found


def _distribution(folder: Path, path: str, told: _Distribution) -> dict[str, Any]:
    """A distribution as plain data, with the files that choices name beside the dataset's."""
    given = told.model_dump(exclude_none=True)
    return {kind: files_from(folder, values, path) if kind == "choice" else values for kind, values in given.items()}
