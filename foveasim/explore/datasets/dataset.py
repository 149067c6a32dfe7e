"""Datasets of pictures captured by random cameras, reproducible from a seed."""

from __future__ import annotations

import hashlib
import json
import operator
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from foveasim._core.caches import BoundedCache
from foveasim._core.calls import Limits, OwnCheck
from foveasim._core.provenance import versions
from foveasim._core.random_streams import Streams
from foveasim._core.threads import cached_property, default_threads
from foveasim._core.validation import Ints, check_count
from foveasim._io.encodings import FileEncoding
from foveasim._io.images import EncodedPicture
from foveasim.capture import Capture
from foveasim.columns import COLUMNS, STORED, column_info, registered_by_user
from foveasim.config import Shot, Source, build_shot, check_settings, put_setting, resolve_files
from foveasim.errors import (
    ConfigError,
    FileError,
    FoveasimError,
    FoveasimWarning,
    ParameterError,
    SimulationError,
    type_name,
    warn,
)
from foveasim.explore._files import digests
from foveasim.explore.datasets.distributions import MAX_INTEGER, MIN_INTEGER, Distribution, parse_distribution
from foveasim.explore.datasets.images import CORTICAL, RASTER, check_image_options, image_attributes, images_of
from foveasim.explore.datasets.items import describe_items
from foveasim.explore.datasets.labels import (
    NO_CLASS,
    boxes_on_sites,
    check_per_picture,
    flow_on_sites,
    mask_on_sites,
    read_flow,
    read_mask,
    validate_boxes,
)
from foveasim.explore.datasets.packed import PackedBoxes
from foveasim.explore.datasets.pictures import digest_of, is_lazy, source_of
from foveasim.explore.sweeps.plan import VARY, check_disjoint, copy_settings, locate_shot, put_changes, with_changes
from foveasim.explore.worker_cache import rate_settings
from foveasim.layout import Layout
from foveasim.scene import Scene

__all__ = ["Dataset"]

#: Number of cached components of each kind per process, the most recently used.
MAX_CACHED = 4
#: Largest number of values of each setting that are checked before the first sample.
CHECKED_VALUES = 64
#: Limits of cameras and draws; the upper one is beyond any feasible computation.
REPEATS = Limits(at_least=1, at_most=10**9)
#: Settings that ``fit`` replaces.
FRAMING = ("scene.pitch_um", "scene.fit", "scene.field_of_view_deg")
#: Setting that determines the photosites.
LAYOUT = "layout"


class Dataset:
    """
    Map-style dataset of pictures captured by random cameras.

    A sample is simulated on access. The class implements ``__len__`` and ``__getitem__``, as ``torch.utils.data.DataLoader``
    and other loaders require, and does not depend on torch. A sample does not depend on the order of access or the process.

    Parameters
    ----------
    pictures : path, (n, n_y, n_x) or (n, n_y, n_x, n_channel) array, or sequence
        Directory tree or zip file of pictures, ``.npy`` file of an array, or sequence of files, arrays or Pillow images, or of
        pairs of these with their classes. All pairs of a sequence other than a list or tuple are read once for their classes,
        unless the sequence has an attribute ``targets``.
    shot : path or mapping
        Settings file, or mapping of settings, with a scene of the kind ``picture``. The dataset supplies its picture.
    vary : mapping of str to distribution, optional
        Distributions by setting path, such as ``{"optics.f_number": {"log_uniform": [1.4, 8]}}``; see
        :func:`foveasim.explore.parse_distribution`. Every camera is an independent draw.
    cameras : int
        Number of random cameras per picture.
    draws : int
        Number of captures per camera, which differ in their noise. Sample i shows picture ``i // (cameras * draws)`` through
        camera ``i // draws``.
    seed : int
        Seed of the cameras and the noise.
    fields : sequence of str
        Columns of the photosites in a sample, by their names in :data:`foveasim.columns.COLUMNS`: the ``"code"``, the
        ``"electrons"``, their expectation ``"expected_e"``, the mean code over temporal noise, ``"expected_dn"``, and others.
    labels : sequence of int or str, optional
        Class of each picture; by default the class of each pair, or the name of the top-level directory of each picture.
        Strings are numbered in alphabetical order.
    boxes : sequence of (n_box, 4) or (n_box, 5), optional, pixels
        Boxes of each picture: x0, y0, x1, y1 from its upper left corner, y down, and a class.
    masks : sequence of (n_y, n_x) integers, or of files, optional
        Classes of the pixels of each picture.
    flows : sequence of (n_y, n_x, 2), or of ``.npy`` files, optional, pixels
        Displacement of each pixel, x to the right and y down; NaN where it is unknown.
    raster : mapping, optional
        Options of :meth:`foveasim.Capture.picture`, such as ``{"method": "cells", "max_pixels": 96}``; 128 pixels by default.
        Samples then contain the reconstructed picture.
    cortical : mapping, optional
        Options of :meth:`foveasim.Capture.cortical`, such as ``{"n_rings": 32, "n_sectors": 64}``; on layouts of rings ``{}``.
        Samples then contain the log-polar image.
    fit : {"cover", "contain", "width"}, optional
        Framing of each picture, as the setting ``scene.fit``, which it replaces (:meth:`foveasim.Scene.from_picture`). The
        pitch follows from the layout and lens of each sample. By default the framing or pitch is that of the shot.
    changes : mapping of str to value, optional
        Settings that are replaced in all samples.
    source : path, optional
        File of the dataset, for messages; relative paths in ``changes`` and in a mapping of settings are relative to its
        directory, by default the working directory.
    n_threads : int
        Number of threads per sample.

    Raises
    ------
    FileError
        When there are no pictures, or the first cannot be read; on access to a sample, when its picture cannot be read.
    ParameterError, ConfigError
        When a distribution, a path or a bound is invalid, or labels do not match the pictures.

    Notes
    -----
    Samples are mappings of arrays and numbers: ``index``, ``picture``, the ``fields`` (n_site,), ``settings`` (random values by
    path; indices for choices other than numbers) and ``warning``; with labels ``label``; with boxes ``box_um`` (n_box, 4),
    ``box_label`` (n_box,) and ``box_covers`` (n_box, n_site), padded with boxes of class -1 to the same number in all samples;
    with masks ``mask`` (n_site,), -1 outside the picture; with flows ``flow_um`` (n_site, 2) and ``flow_known`` (n_site,).
    Images are float32 with channels first: ``raster`` (n_channel, n_y, n_x), top row first, and ``cortical`` (n_channel,
    n_ring, n_sector), innermost ring first; both are 0 where ``raster_known`` (n_y, n_x) and ``cortical_known`` (n_ring,
    n_sector) are False: outside the photosites.
    :mod:`foveasim.explore.datasets.labels` defines these labels.

    Each process caches recent components: layouts, compiled layouts, lenses, scenes and the power on the sites. Arrays in
    memory may be copied to each process; picture files and ``.npy`` files are read on demand.

    Examples
    --------
    >>> import numpy as np
    >>> shot = {
    ...     "scene": {
    ...         "kind": "picture",
    ...         "picture": "",
    ...         "fit": "cover",
    ...         "distance_m": 1.0,
    ...         "peak_radiance_w_m2_sr_nm": 0.1,
    ...         "wavelength_nm": 550,
    ...         "band_width_nm": 100,
    ...     },
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": {
    ...         "generator": "grid",
    ...         "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 8.0},
    ...     },
    ...     "exposure_s": 0.01,
    ... }
    >>> pictures = np.full((3, 32, 32), 128, np.uint8)
    >>> data = Dataset(
    ...     pictures,
    ...     shot,
    ...     {"optics.f_number": {"uniform": [2.0, 4.0]}},
    ...     cameras=2,
    ...     labels=[0, 1, 0],
    ... )
    >>> len(data), data[3]["code"].shape, data[3]["label"]
    (6, (64,), 1)
    """

    def __init__(
        self,
        pictures: Any,
        shot: OwnCheck[str | Path | Mapping[str, Any]],
        vary: OwnCheck[Mapping[str, Any] | None] = None,
        *,
        cameras: Annotated[int, REPEATS] = 1,
        draws: Annotated[int, REPEATS] = 1,
        seed: int = 0,
        fields: Sequence[str] = ("code", "electrons"),
        labels: OwnCheck[Sequence[int | str] | None] = None,
        boxes: Sequence[Any] | None = None,
        masks: Sequence[Any] | None = None,
        flows: Sequence[Any] | None = None,
        raster: OwnCheck[Mapping[str, Any] | None] = None,
        cortical: OwnCheck[Mapping[str, Any] | None] = None,
        fit: Literal["cover", "contain", "width"] | None = None,
        changes: Mapping[str, Any] | None = None,
        source: Source | str | Path | None = None,
        n_threads: Annotated[int, Limits(at_least=1)] = 1,
    ) -> None:
        self.cameras: int = cameras
        self.draws: int = draws
        self.seed: int = Streams(seed).seed
        self.fields: tuple[str, ...] = tuple(fields)
        for field in self.fields:
            COLUMNS.find("fields", field)
        self._n_threads = n_threads
        self._pictures = source_of(pictures)
        n = len(self._pictures)
        self.class_names: list[str] | None
        self._labels, self.class_names = _number_classes(self._pictures.labels() if labels is None else labels, n)
        self._boxes = None
        if boxes is not None:
            each = check_per_picture("boxes", boxes, n)
            self._boxes = PackedBoxes(validate_boxes(f"boxes[{k}]", each[k]) for k in range(n))
        self._masks = None if masks is None else check_per_picture("masks", masks, n)
        self._flows = None if flows is None else check_per_picture("flows", flows, n)
        images = {RASTER: check_image_options(RASTER, raster), CORTICAL: check_image_options(CORTICAL, cortical)}
        self._images = {name: options for name, options in images.items() if options is not None}
        self._fit = fit
        self._files: list[Path] = []
        own = Source.of(source)
        base_source, self._settings = _base_settings(shot, own, changes, self._files, fit)
        self._distributions = _parse_distributions(own, vary or {}, self._files, is_fitted=fit is not None)
        written = own.absolute().at(VARY)
        self._source = base_source.absolute().with_replaced({path: written.at(path) for path in self._distributions})
        self._reset()
        self._code_type: Any = np.uint8
        self._check_bounds()

    def _reset(self) -> None:
        """Initialise the state of a process: caches and warnings."""
        self._cache: dict[str, BoundedCache] = {}
        self._messages: list[Warning] = []
        self._has_warned = False

    def __getstate__(self) -> dict[str, Any]:
        excluded = ("_cache", "_messages", "_has_warned", "layout")
        state = {name: value for name, value in self.__dict__.items() if name not in excluded}
        return state | {"_columns": registered_by_user(self.fields)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, (column, info) in state.pop("_columns").items():  # of a program that this process does not run
            if name not in COLUMNS:
                COLUMNS.register(name, column, info=info)
        self.__dict__.update(state)
        self._reset()

    def __repr__(self) -> str:
        return (
            f"Dataset({len(self)} samples of {len(self._pictures)} pictures, {self.cameras} cameras each, "
            f"{self.draws} draws each)"
        )

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._pictures) * self.cameras * self.draws

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Iterate over all samples."""
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> dict[str, Any]:
        """
        Simulate a sample.

        Raises
        ------
        IndexError
            When the index is out of range.
        FileError, SimulationError
            When the picture of the sample cannot be read, or its camera cannot be built.
        """
        return self._evaluate(index, self._sample)

    def capture(self, index: int) -> Capture:
        """Simulate a sample and return its capture."""
        return self._evaluate(index, lambda index: self._capture(index)[1])

    def shot(self, index: int) -> Shot:
        """Return the camera and scene of a sample; its noise uses ``seed`` and frame ``index``."""
        return self._evaluate(index, self._shot)

    def settings_of(self, index: int) -> dict[str, Any]:
        """Return all settings of a sample in the structure of a settings file."""
        return self._evaluate(index, self._settings_of)

    @cached_property
    def layout(self) -> Layout:
        """
        Layout of all samples.

        Raises
        ------
        ParameterError
            When the samples have different layouts.
        """
        if self.is_layout_varied:
            raise ParameterError("layout", "must be equal in all samples; use shot(index).camera.sensor.layout")
        layout = self.shot(0).camera.sensor.layout
        assert isinstance(layout, Layout)
        return layout

    @property
    def is_layout_varied(self) -> bool:
        """Whether samples have different layouts."""
        return any(path == LAYOUT or path.startswith(LAYOUT + ".") for path in self._distributions)

    def describe_items(self) -> dict[str, dict[str, Any]]:
        """
        Return the dimensions, shape, type and unit of each item of the samples, as plain data.

        Shapes are those of the first sample; images also have the position of their pixels and their channels.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # reported with the samples
            items = describe_items(self._evaluate(0, self._sample), self._images)
            if self._images:
                shot, capture = self._evaluate(0, self._capture)
                sensor = shot.camera.sensor
                attributes = image_attributes(capture, sensor, self._images, n_threads=self._n_threads)
                for name, found in attributes.items():
                    items[name] |= found
        return items

    def to_dict(self) -> dict[str, Any]:
        """
        Return everything that determines the samples as plain data.

        The contents of pictures, masks and flows are not included; see :meth:`digest`.
        """
        labels = hashlib.sha256(f"{self._masks is not None} {self._flows is not None}".encode())
        arrays = () if self._labels is None else (self._labels,)
        for array in (*arrays, *(() if self._boxes is None else self._boxes.arrays())):
            labels.update(f"{array.dtype.str} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return {
            "pictures": self._pictures.to_dict(),
            "settings": self._settings,
            "vary": {path: distribution.to_dict() for path, distribution in self._distributions.items()},
            "cameras": self.cameras,
            "draws": self.draws,
            "seed": self.seed,
            "fields": list(self.fields),
            "fit": self._fit,
            RASTER: self._images.get(RASTER),
            CORTICAL: self._images.get(CORTICAL),
            "class_names": self.class_names,
            "labels": labels.hexdigest(),
            "files": digests(self._files),
            "versions": versions(),
        }

    def digest(self, samples: range) -> str:
        """
        Compute the SHA-256 of the pictures, masks and flows of a range of samples.

        For sequences that may compute items on access (other than lists, arrays and files), only the first and the last item
        contribute.
        """
        numbers = range(self._picture_of(samples[0]), self._picture_of(samples[-1]) + 1)
        digest_picture = self._pixels_digest if self._pictures.is_lazy else self._pictures.digest
        found = [digest_picture(k) for k in (_first_and_last(numbers) if self._pictures.is_lazy else numbers)]
        for each in (self._masks, self._flows):
            if each is not None:
                found += [digest_of(each[k]) for k in (_first_and_last(numbers) if is_lazy(each) else numbers)]
        return hashlib.sha256("\n".join(found).encode()).hexdigest()

    def _pixels_digest(self, picture: int) -> str:
        try:
            return digest_of(self._picture(picture, "linear").pixels)  # as stored
        except FoveasimError:  # reported on access to the sample
            return ""

    # -- a sample -----------------------------------------------------------------------------------------------------

    def _evaluate(self, index: int, function: Callable[[int], Any]) -> Any:
        """Evaluate a function of a sample index, with the sample in the messages of errors."""
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"sample index {position} is out of range for {len(self)} samples")
        position %= len(self)
        try:
            return function(position)
        except FoveasimError as error:
            raise self._with_sample_name(position, error) from None

    def _with_sample_name(self, index: int, error: FoveasimError) -> FoveasimError:
        label = f"sample {index} ({self._name_of(index)})"
        if isinstance(error, ConfigError):
            return ConfigError(error.path, f"{label}: {error.detail}", position=error.position)
        return error if isinstance(error, FileError) else SimulationError(f"{label}: {error}")

    def _name_of(self, index: int) -> str:
        return self._pictures.name(self._picture_of(index))

    def _picture_of(self, index: int) -> int:
        return index // (self.cameras * self.draws)

    def _sample_settings(self, index: int) -> dict[str, tuple[Any, int | float]]:
        """Return the random settings of a sample: value and number by path."""
        return {
            path: distribution.sample(self.seed, index // self.draws)
            for path, distribution in self._distributions.items()
        }

    def _settings_of(self, index: int) -> dict[str, Any]:
        return self._settings_with(index, {path: value for path, (value, _) in self._sample_settings(index).items()})

    def _settings_with(self, index: int, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings with the given values and the picture of a sample."""
        data: dict[str, Any] = copy_settings(self._settings)
        data["scene"]["picture"] = self._name_of(index)
        for path, value in values.items():
            put_setting(self._source, data, path, value)
        return data

    def _cached(self, part: str, settings: Any, make: Callable[[], Any]) -> Any:
        """
        Return the component with the given settings, from the cache or newly built.

        The warnings of its construction are stored with it, so that every sample that uses it reports them.
        """

        def compute() -> tuple[Any, list[Warning]]:
            with _record_warnings() as caught:
                made = make()
            return made, [_as_warning(each.message) for each in caught]

        parts = self._cache.setdefault(part, BoundedCache(MAX_CACHED))
        value, messages = parts.get(json.dumps(settings, sort_keys=True), compute)
        self._messages += messages
        return value

    def _picture(self, picture: int, encoding: FileEncoding) -> EncodedPicture:
        found: EncodedPicture = self._cached(
            "picture", [picture, encoding], lambda: self._pictures.picture(picture, encoding)
        )
        return found

    def _shot(self, index: int) -> Shot:
        return self._build(index, self._settings_of(index))

    def _build(self, index: int, settings: Mapping[str, Any]) -> Shot:
        picture = self._picture_of(index)

        def scene() -> Scene:
            values = {key: value for key, value in settings["scene"].items() if key not in ("kind", "picture")}
            try:
                pixels: Any = self._picture(picture, values.get("encoding", "auto"))
                return Scene.from_picture(pixels, **values)
            except ParameterError as error:
                raise FileError(self._name_of(index), f"is not a valid picture for these settings: {error}") from None

        def cache(part: str, part_settings: Any, make: Callable[[], Any]) -> Any:
            return (
                self._cached(part, [picture, part_settings], scene)
                if part == "scene"
                else self._cached(part, part_settings, make)
            )

        return build_shot(self._source, settings, n_threads=self._n_threads, cache=cache)

    def _capture(self, index: int) -> tuple[Shot, Capture]:
        settings = self._settings_of(index)
        shot = self._build(index, settings)
        camera, scene = shot.camera, shot.scene
        power_settings = [self._picture_of(index), rate_settings(shot, settings)]
        photo_e_per_s = self._cached("power", power_settings, lambda: camera.photoelectrons_per_s(scene))
        capture = camera.capture(
            scene, exposure_s=shot.requested_s, seed=self.seed, frame=index, photo_e_per_s=photo_e_per_s
        )
        return shot.captured(capture), capture

    def _sample(self, index: int) -> dict[str, Any]:
        self._messages = []
        with _record_warnings() as caught:
            sampled = self._sample_settings(index)
            shot, capture = self._capture(index)
            sample: dict[str, Any] = {"index": index, "picture": self._picture_of(index)}
            sample |= {field: self._field(field, index, shot, capture) for field in self.fields}
            sample |= self._site_labels(index, shot)
            if self._images:
                sample |= images_of(capture, shot.camera.sensor, self._images, n_threads=self._n_threads)
        messages = [*self._messages, *(_as_warning(each.message) for each in caught)]
        if messages and not self._has_warned:
            self._has_warned = True
            message = f"sample {index}: {messages[0]}; further warnings are in the item 'warning' of each sample"
            warn(message, type(messages[0]))
        sample["settings"] = {path: number for path, (_, number) in sampled.items()}
        sample["warning"] = "; ".join(dict.fromkeys(str(each) for each in messages))
        return sample

    def _field(self, field: str, index: int, shot: Shot, capture: Capture) -> NDArray[Any]:
        if field == "code":
            return capture.code.astype(self._code_type)

        def compute() -> NDArray[Any]:
            with default_threads(self._n_threads):
                return capture.column(field, sensor=shot.camera.sensor)

        if column_info(field).is_random or field in STORED:
            return np.array(compute())
        return np.array(
            self._cached("columns", (field, index // self.draws), compute)
        )  # equal for all draws of a camera

    def _site_labels(self, index: int, shot: Shot) -> dict[str, Any]:
        picture = self._picture_of(index)
        found: dict[str, Any] = {} if self._labels is None else {"label": int(self._labels[picture])}
        if self._boxes is None and self._masks is None and self._flows is None:
            return found
        camera = shot.camera
        assert isinstance(shot.scene, Scene)
        if shot.scene.panorama is not None:
            raise ParameterError(
                "scene", "must be a plane for labels in its pixels, got a panorama; omit boxes, masks and flows"
            )
        scene = camera.fit_scene(shot.scene)
        grid = camera.image_grid(scene)
        lens = camera.distortion
        n_grids = len(camera.optics.image_grids(scene))
        integrator = camera.integrator(grid, order=1, n_grids=n_grids)
        where = f"of {self._name_of(index)}"
        if self._boxes is not None:
            boxes_px, classes = self._boxes[picture]
            on_sites = boxes_on_sites(boxes_px, integrator, lens)
            # From the image to the layout.
            found["box_um"] = _pad(on_sites.box_um - np.tile(camera.position_um, 2), self._boxes.most, 0.0)
            found["box_label"] = _pad(classes, self._boxes.most, NO_CLASS)
            found["box_covers"] = _pad(on_sites.covers, self._boxes.most, False)
        if self._masks is not None:
            mask = read_mask(self._masks[picture], f"mask {where}", grid.shape)
            found["mask"] = mask_on_sites(mask, integrator)
        if self._flows is not None:
            flow = flow_on_sites(read_flow(self._flows[picture], f"flow {where}", grid.shape), integrator, lens)
            found["flow_um"], found["flow_known"] = flow.flow_um, flow.is_known
        return found

    # -- before the first sample --------------------------------------------------------------------------------------

    def _check_bounds(self) -> None:
        """Build the first shot at the bounds of every setting, to detect errors early."""
        try:
            self._build(0, self._settings_with(0, {}))
            first = {path: distribution.bounds[0] for path, distribution in self._distributions.items()}
            max_bits = self._check_values(first)
            for path, distribution in self._distributions.items():
                for value in distribution.bounds[1:CHECKED_VALUES]:
                    max_bits = max(max_bits, self._check_values(first | {path: value}))
            self._code_type = np.uint8 if max_bits <= 8 else np.uint16
            if self._images:
                with _record_warnings():
                    shot, capture = self._capture(0)
                    images_of(capture, shot.camera.sensor, self._images, n_threads=self._n_threads)
        finally:
            self._reset()

    def _check_values(self, values: Mapping[str, Any]) -> int:
        """Build the shot of the first picture with the given values and return its bit depth."""
        settings = self._settings_with(0, values)
        check_settings(self._source, settings)
        return self._build(0, settings).camera.sensor.bits


def _base_settings(
    shot: str | Path | Mapping[str, Any],
    own: Source,
    changes: Mapping[str, Any] | None,
    found: list[Path],
    fit: str | None,
) -> tuple[Source, Any]:
    """
    Return the origin of the settings, for messages, and the settings with absolute paths.

    The referenced files are appended to ``found``.
    """
    if not isinstance(shot, str | Path | Mapping):
        raise ParameterError("shot", f"must be a settings file or a mapping of settings, got {type_name(shot)}")
    source, data = locate_shot(own, shot)
    scene = data.get("scene")
    if not isinstance(scene, Mapping) or scene.get("kind") != "picture":
        raise source.error("scene.kind", "must be 'picture' for a dataset, which supplies the pictures")
    data = resolve_files(
        source.directory, {**data, "scene": {key: scene[key] for key in scene if key != "picture"}}, found=found
    )
    data["scene"]["picture"] = ""
    if fit is not None:
        data["scene"] |= {"fit": fit, "pitch_um": None, "field_of_view_deg": None}
    source = with_changes(own, source, changes)
    put_changes(own, source, data, changes, found)
    data.pop("seed", None)
    return source, data


def _parse_distributions(
    own: Source, vary: Mapping[str, Any], found: list[Path], *, is_fitted: bool
) -> dict[str, Distribution]:
    if not isinstance(vary, Mapping):
        raise ParameterError("vary", "must be a mapping of setting paths to distributions", vary)
    distributions = {str(path): parse_distribution(str(path), spec) for path, spec in vary.items()}
    check_disjoint(own, distributions)
    for path, distribution in distributions.items():
        if distribution.kind == "choice":
            distributions[path] = replace(
                distribution, values=tuple(resolve_files(Path(), value, path, found) for value in distribution.values)
            )
        if path in ("seed", "scene", "scene.kind", "scene.picture"):
            raise ParameterError(path, "must not vary: the dataset has its own seed and its own pictures")
        if is_fitted and path in FRAMING:
            raise ParameterError(path, "must not vary with 'fit', which replaces it")
    return distributions


def _number_classes(labels: Any, n: int) -> tuple[Ints | None, list[str] | None]:
    """Return the classes of the pictures as numbers, and the names of string classes."""
    if labels is None:
        return None, None
    each = check_per_picture("labels", labels, n)
    values = [value.item() if isinstance(value, np.generic) else value for value in (each[k] for k in range(n))]
    if all(isinstance(value, int) for value in values):
        for value in values:
            check_count("labels", int(value), at_least=MIN_INTEGER, at_most=MAX_INTEGER)
        return np.array(values, np.int64), None
    if all(isinstance(value, str) for value in values):
        names = sorted(set(values))
        numbers = {name: k for k, name in enumerate(names)}
        return np.array([numbers[value] for value in values], np.int64), names
    raise ParameterError("labels", "must all be integers, or all be strings", values)


def _first_and_last(numbers: range) -> list[int]:
    """Return the first and the last number."""
    return [*dict.fromkeys((numbers[0], numbers[-1]))]


def _pad(array: NDArray[Any], n: int, value: Any) -> NDArray[Any]:
    """Pad an array with rows of one value to ``n`` rows."""
    padding = np.full((n - len(array), *array.shape[1:]), value, array.dtype)
    return np.concatenate((array, padding))


@contextmanager
def _record_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """Record all warnings except ResourceWarning, which garbage collection emits at any time."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", ResourceWarning)
        yield caught


def _as_warning(message: Warning | str) -> Warning:
    return message if isinstance(message, Warning) else FoveasimWarning(message)
