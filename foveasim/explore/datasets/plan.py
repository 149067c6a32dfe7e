"""YAML files of datasets: pictures, shot, random settings and labels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from foveasim._core.short_repr import short_repr
from foveasim._io.yaml_files import read_yaml
from foveasim.columns import COLUMNS
from foveasim.config import Source, picture_path, resolve_files, validate
from foveasim.config._models import Section
from foveasim.errors import ParameterError
from foveasim.explore.datasets.dataset import Dataset
from foveasim.explore.datasets.images import CORTICAL, RASTER
from foveasim.explore.datasets.label_files import (
    FLOW_EXTENSIONS,
    MASK_EXTENSIONS,
    match_label_files,
    read_boxes,
    read_labels,
)
from foveasim.explore.datasets.pictures import Source as PictureSource
from foveasim.explore.datasets.pictures import source_of
from foveasim.explore.datasets.recipes import classification, denoising
from foveasim.explore.sweeps.plan import with_file_context

__all__ = ["DatasetFile", "DatasetSection", "read_dataset"]

#: Values of the key ``recipe``.
RECIPES: dict[str | None, Callable[..., Dataset]] = {
    None: Dataset,
    "classification": classification,
    "denoising": denoising,
}
#: Parameters of a distribution, in the unit of its setting.
_Numbers = list[float]
#: Values of sites, and their normalisation.
_Values = Literal["code", "electrons", "expected_e", "light_e"]


def _check_column(name: str) -> str:
    """Check the name of a column in a file."""
    try:
        COLUMNS.find("fields", name)
    except ParameterError as error:
        raise ValueError(error.detail) from None
    return name


#: Names of columns, with those of installed packages.
_ColumnName = Annotated[
    str, AfterValidator(_check_column), Field(json_schema_extra=lambda schema: schema.update(enum=list(COLUMNS)))
]
_Per = Literal["site", "um2"]
#: Keys with the same name in :class:`Dataset`.
DATASET_KEYS = ("cameras", "draws", "seed", "fields", "fit")


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetFile:
    """
    Dataset and storage options of a YAML file.

    Attributes
    ----------
    dataset : Dataset
    per_shard : int or None
        Number of samples per shard, if the file specifies it.
    """

    dataset: Dataset
    per_shard: int | None

    __repr__ = short_repr


class _Distribution(Section):
    """Distribution of a setting: exactly one kind."""

    uniform: _Numbers | None = Field(None, description="[low, high]")
    log_uniform: _Numbers | None = Field(None, description="[low, high]")
    integers: list[int] | None = Field(None, description="[low, high], both inclusive")
    normal: _Numbers | None = Field(None, description="[mean, standard deviation, low, high]")
    choice: list[Any] | None = Field(None, description="list of values")
    weights: _Numbers | None = Field(None, description="relative probabilities of the values of a choice")


class _Raster(Section):
    """Reconstructed picture of each sample."""

    method: Literal["cells", "linear", "natural", "least_squares"] | None = Field(
        None, description="reconstruction, cells by default"
    )
    max_pixels: int | None = Field(None, description="pixels along the longer side, 128 by default")
    of: _Values | None = Field(None, description="values to reconstruct, code by default")
    per: _Per | None = Field(None, description="values of a site, by default, or per µm²")
    mu: float | None = Field(None, description="regularisation of least_squares")
    tolerance: float | None = Field(None, description="relative tolerance of least_squares")
    max_steps: int | None = Field(None, description="maximum number of steps of least_squares")


class _Cortical(Section):
    """Log-polar image of each sample."""

    of: _Values | None = Field(None, description="values of the image, code by default")
    per: _Per | None = Field(None, description="values of a site, by default, or per µm²")
    n_rings: int | None = Field(None, description="rings; by default one pixel per site, on layouts of rings")
    n_sectors: int | None = Field(None, description="sectors, with n_rings")
    r_min_um: float | None = Field(None, description="inner radius, with n_rings")
    r_max_um: float | None = Field(None, description="outer radius, with n_rings")
    centre_um: list[float] | None = Field(None, description="[x, y], with n_rings; the optical axis by default")
    max_pixels: int | None = Field(
        None, description="pixels along the longer side of the picture that is resampled, 256 by default"
    )


class DatasetSection(Section):
    """Settings of a dataset: pictures, shot, distributions, labels and shards."""

    pictures: str | list[str] = Field(description="directory, zip file, array (.npy) or list of files")
    shot: str | dict[str, Any] = Field(description="settings file, relative to this file, or the settings")
    set: dict[str, Any] = Field({}, description="settings that are replaced in all samples, by path")
    recipe: Literal["classification", "denoising"] | None = Field(
        None, description="default distributions and fields of a task"
    )
    vary: dict[str, _Distribution] = Field({}, description="distributions by setting path")
    cameras: int | None = Field(None, description="random cameras per picture; 1 by default")
    draws: int | None = Field(None, description="captures per camera; 1 by default, 4 for denoising")
    seed: int = 0
    fields: list[_ColumnName] | None = Field(
        None, description="columns of the photosites; by default code and electrons, or those of the recipe"
    )
    fit: Literal["cover", "contain", "width"] | None = Field(
        None, description="framing of the pictures on the layout, instead of that of the scene"
    )
    labels: str | list[int | str] | None = Field(
        None, description="a .csv file with the columns picture and label, an array (.npy), or a list"
    )
    boxes: str | None = Field(None, description="JSON file in COCO format")
    masks: str | None = Field(None, description="directory with one .png, .bmp or .tif file per picture name")
    flows: str | None = Field(None, description="directory with one .npy file per picture name")
    raster: _Raster | None = Field(None, description="options of the reconstructed picture in each sample")
    cortical: _Cortical | None = Field(None, description="options of the log-polar image in each sample")
    per_shard: int | None = Field(None, ge=1, description="number of samples per shard")


def read_dataset(path: str | Path, *, n_threads: int = 1) -> DatasetFile:
    """
    Read the YAML file of a dataset.

    Parameters
    ----------
    path : path
        File with the keys ``pictures`` (a directory, zip file, array, or list of files), ``shot`` (a settings file, or the
        settings), ``vary`` (distributions by setting path, as for :func:`parse_distribution`), ``recipe``
        (``classification`` or ``denoising``), ``cameras``, ``draws``, ``seed``, ``fields``, ``raster``, ``cortical`` and
        ``fit`` (as for :class:`Dataset`), ``labels`` (a CSV file with the columns ``picture`` and ``label``, an array, or a
        list), ``boxes`` (a JSON file in COCO format), ``masks`` and ``flows`` (directories with one file per picture name),
        ``per_shard``, and ``set`` (settings that are replaced in all samples). Paths are relative to the file;
        ``skimage:astronaut`` is an example of a picture of scikit-image. Label files identify pictures by their names in the
        directory, or by their numbers in an array.
    n_threads : int
        Number of threads per sample.

    Returns
    -------
    DatasetFile

    Raises
    ------
    ConfigError
        When a setting is invalid; with the file, the key, the expected and the actual value.
    FileError
        When pictures or labels cannot be read, or do not match.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = fs.config.write_starting_file("dataset", Path(directory, "dataset.yaml"))
    ...     found = fs.explore.read_dataset(path)
    >>> len(found.dataset), found.dataset.class_names
    (12, ['cat', 'cup', 'person'])
    """
    path = Path(path)
    section: DatasetSection = validate(path, DatasetSection, read_yaml(path))
    directory = path.parent
    source = _pictures(path, section.pictures)
    options = {name: value for name in DATASET_KEYS if (value := getattr(section, name)) is not None}
    options |= {
        name: chosen.model_dump(exclude_none=True)
        for name in (RASTER, CORTICAL)
        if (chosen := getattr(section, name)) is not None
    }
    labels = _labels(directory, section, source)
    with with_file_context(path):
        dataset = RECIPES[section.recipe](
            source,
            directory / section.shot if isinstance(section.shot, str) else section.shot,
            {name: _distribution(directory, name, distribution) for name, distribution in section.vary.items()},
            changes=section.set,
            source=path,
            n_threads=n_threads,
            **options,
            **labels,
        )
    return DatasetFile(dataset=dataset, per_shard=section.per_shard)


def _pictures(path: Path, pictures: str | list[str]) -> PictureSource:
    with with_file_context(path):
        if not pictures:
            raise Source.of(path).error("pictures", "must name a directory, a zip file, an array (.npy) or pictures")
        if isinstance(pictures, str):
            return source_of(path.parent / pictures)
        own = Source.of(path)
        return source_of([picture_path(own, name, f"pictures.{k}").absolute() for k, name in enumerate(pictures)])


def _labels(directory: Path, section: DatasetSection, pictures: PictureSource) -> Mapping[str, Any]:
    """Return the label arguments of :class:`Dataset`."""
    found: dict[str, Any] = {}
    if all(given is None for given in (section.labels, section.boxes, section.masks, section.flows)):
        return found
    names = [pictures.key(k) for k in range(len(pictures))]
    if isinstance(section.labels, str):
        found["labels"] = read_labels(directory / section.labels, names)
    elif section.labels is not None:
        found["labels"] = section.labels
    if section.boxes is not None:
        found["boxes"] = read_boxes(directory / section.boxes, names)
    if section.masks is not None:
        found["masks"] = match_label_files(directory / section.masks, names, MASK_EXTENSIONS)
    if section.flows is not None:
        found["flows"] = match_label_files(directory / section.flows, names, FLOW_EXTENSIONS)
    return found


def _distribution(directory: Path, path: str, distribution: _Distribution) -> dict[str, Any]:
    """Return a distribution as plain data, with file choices relative to the dataset file."""
    given = distribution.model_dump(exclude_none=True)
    return {
        kind: resolve_files(directory, values, path) if kind == "choice" else values for kind, values in given.items()
    }
