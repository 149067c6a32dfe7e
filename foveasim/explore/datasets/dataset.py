"""Datasets of pictures captured by random cameras, reproducible from a seed."""

from __future__ import annotations

import hashlib
import json
import operator
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from foveasim._core.provenance import versions
from foveasim._core.random_streams import Streams
from foveasim._core.validation import check_choice, check_count
from foveasim.capture import Capture
from foveasim.config import Shot, build_shot, check_settings, put_setting, read_settings, resolve_files
from foveasim.errors import ConfigError, FileError, FoveasimError, FoveasimWarning, ParameterError, SimulationError
from foveasim.explore._files import digests
from foveasim.explore.datasets.distributions import LEAST, MOST, Draw, parse_distribution
from foveasim.explore.datasets.labels import (
    NOTHING,
    boxes_on_sites,
    check_per_picture,
    flow_on_sites,
    mask_on_sites,
    read_flow,
    read_mask,
    validate_boxes,
)
from foveasim.explore.datasets.pictures import digest_of, is_lazy, source_of
from foveasim.explore.sweeps.plan import check_disjoint
from foveasim.layout import Layout
from foveasim.scene import Scene

__all__ = ["FIELDS", "Dataset"]

#: Quantities per site that samples may contain.
FIELDS = ("code", "electrons", "expected_e", "expected_dn")
#: Number of cached components of each kind per process, the most recently used.
KEPT = 4
#: Largest number of values of each setting that are checked before the first sample.
TRIED_VALUES = 64
#: Upper limit of cameras and draws, beyond any feasible computation.
MAX_REPEATS = 10**9
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
    fields : sequence of {"code", "electrons", "expected_e", "expected_dn"}
        Quantities per site in a sample: the code, the electrons, their expectation, and the mean code over temporal noise.
    labels : sequence of int or str, optional
        Class of each picture; by default the class of each pair, or the name of the top-level directory of each picture.
        Strings are numbered in alphabetical order.
    boxes : sequence of (n_box, 4) or (n_box, 5), optional, pixels
        Boxes of each picture: x0, y0, x1, y1 from its upper left corner, y down, and a class.
    masks : sequence of (n_y, n_x) integers, or of files, optional
        Classes of the pixels of each picture.
    flows : sequence of (n_y, n_x, 2), or of ``.npy`` files, optional, pixels
        Displacement of each pixel, x to the right and y down; NaN where it is unknown.
    fit : {"cover", "contain"}, optional
        Scaling of each picture with the lens of the shot: the scene pitch is chosen so that the image just covers the layout,
        or just fits on it. By default the pitch is that of the shot.
    changes : mapping of str to value, optional
        Settings that are replaced in all samples.
    source : path
        Name of a mapping of settings in messages.
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
    :mod:`foveasim.explore.datasets.labels` defines these labels.

    Each process caches recent components: layouts, compiled layouts, lenses, scenes and the power on the sites. Arrays in
    memory may be copied to each process; picture files and ``.npy`` files are read on demand.

    Examples
    --------
    >>> import numpy as np
    >>> shot = {
    ...     "scene": {
    ...         "kind": "picture", "picture": "", "pitch_um": 500.0, "distance_m": 1.0,
    ...         "peak_radiance_w_m2_sr_nm": 0.1, "wavelength_nm": 550, "band_width_nm": 100,
    ...     },
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 2.0}},
    ...     "exposure_s": 0.01,
    ... }
    >>> pictures = np.full((3, 32, 32), 128, np.uint8)
    >>> data = Dataset(pictures, shot, {"optics.f_number": {"uniform": [2.0, 4.0]}}, cameras=2, labels=[0, 1, 0])
    >>> len(data), data[3]["code"].shape, data[3]["label"]
    (6, (64,), 1)
    """

    def __init__(
        self,
        pictures: Any,
        shot: str | Path | Mapping[str, Any],
        vary: Mapping[str, Any] | None = None,
        *,
        cameras: int = 1,
        draws: int = 1,
        seed: int = 0,
        fields: Sequence[str] = ("code", "electrons"),
        labels: Sequence[int | str] | None = None,
        boxes: Sequence[Any] | None = None,
        masks: Sequence[Any] | None = None,
        flows: Sequence[Any] | None = None,
        fit: Literal["cover", "contain"] | None = None,
        changes: Mapping[str, Any] | None = None,
        source: str | Path = "settings",
        n_threads: int = 1,
    ) -> None:
        self.cameras = check_count("cameras", cameras, at_most=MAX_REPEATS)
        self.draws = check_count("draws", draws, at_most=MAX_REPEATS)
        self.seed = Streams(seed).seed
        self.fields = tuple(fields)
        for field in self.fields:
            check_choice("fields", field, FIELDS)
        self._n_threads = check_count("n_threads", n_threads)
        self._pictures = source_of(pictures)
        n = len(self._pictures)
        self._labels, self.class_names = _numbered(self._pictures.labels() if labels is None else labels, n)
        self._boxes = None
        if boxes is not None:
            each = check_per_picture("boxes", boxes, n)
            self._boxes = [validate_boxes(f"boxes[{k}]", each[k]) for k in range(n)]
        self._masks = None if masks is None else check_per_picture("masks", masks, n)
        self._flows = None if flows is None else check_per_picture("flows", flows, n)
        if fit is not None:
            check_choice("fit", fit, ("cover", "contain"))
        self._fit = fit
        self._files: list[Path] = []
        self._file, self._settings = _base(shot, Path(source), changes or {}, self._files, is_fitted=fit is not None)
        self._draws = _draws(self._file, vary or {}, self._files, is_fitted=fit is not None)
        self._begin()
        self._fit_um = (0.0, 0.0, 1.0)
        self._code_type: Any = np.uint8
        self._try_ends()

    def _begin(self) -> None:
        """Initialise the state of a process: caches and warnings."""
        self._kept: dict[str, OrderedDict[str, tuple[Any, list[Warning]]]] = {}
        self._told: list[Warning] = []
        self._has_warned = False

    def __getstate__(self) -> dict[str, Any]:
        own = ("_kept", "_told", "_has_warned", "layout")
        return {name: value for name, value in self.__dict__.items() if name not in own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

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
        return self._at(index, self._sample)

    def capture(self, index: int) -> Capture:
        """Simulate a sample and return its capture."""
        return self._at(index, lambda index: self._captured(index)[1])

    def shot(self, index: int) -> Shot:
        """Return the camera and scene of a sample; its noise uses ``seed`` and frame ``index``."""
        return self._at(index, self._shot)

    def settings_of(self, index: int) -> dict[str, Any]:
        """Return all settings of a sample in the structure of a settings file."""
        return self._at(index, self._settings_of)

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
        return any(path == LAYOUT or path.startswith(LAYOUT + ".") for path in self._draws)

    def to_dict(self) -> dict[str, Any]:
        """
        Return everything that determines the samples as plain data.

        The contents of pictures, masks and flows are not included; see :meth:`digest`.
        """
        labels = {
            "labels": self._labels,
            "boxes": None if self._boxes is None else [[*map(np.ndarray.tolist, each)] for each in self._boxes],
            "masks": self._masks is not None,
            "flows": self._flows is not None,
        }
        return {
            "pictures": self._pictures.to_dict(),
            "settings": self._settings,
            "vary": {path: draw.to_dict() for path, draw in self._draws.items()},
            "cameras": self.cameras,
            "draws": self.draws,
            "seed": self.seed,
            "fields": list(self.fields),
            "fit": self._fit,
            "class_names": self.class_names,
            "labels": hashlib.sha256(json.dumps(labels).encode()).hexdigest(),
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
        of_pictures = self._pixels_digest if self._pictures.is_lazy else self._pictures.digest
        found = [of_pictures(k) for k in (_ends(numbers) if self._pictures.is_lazy else numbers)]
        for each in (self._masks, self._flows):
            if each is not None:
                found += [digest_of(each[k]) for k in (_ends(numbers) if is_lazy(each) else numbers)]
        return hashlib.sha256("\n".join(found).encode()).hexdigest()

    def _pixels_digest(self, picture: int) -> str:
        try:
            return digest_of(self._pixels(picture))
        except FoveasimError:  # reported on access to the sample
            return ""

    # -- a sample -----------------------------------------------------------------------------------------------------

    def _at(self, index: int, what: Callable[[int], Any]) -> Any:
        """Evaluate a function of a sample index, with the sample in the messages of errors."""
        place = operator.index(index)
        if not -len(self) <= place < len(self):
            raise IndexError(f"sample index {place} is out of range for {len(self)} samples")
        place %= len(self)
        try:
            return what(place)
        except FoveasimError as error:
            raise self._with_sample_name(place, error) from None

    def _with_sample_name(self, index: int, error: FoveasimError) -> FoveasimError:
        which = f"sample {index} ({self._name_of(index)})"
        if isinstance(error, ConfigError):
            return ConfigError(error.path, f"{which}: {str(error).removeprefix(f'{error.path}: ')}")
        return error if isinstance(error, FileError) else SimulationError(f"{which}: {error}")

    def _name_of(self, index: int) -> str:
        return self._pictures.name(self._picture_of(index))

    def _picture_of(self, index: int) -> int:
        return index // (self.cameras * self.draws)

    def _drawn(self, index: int) -> dict[str, tuple[Any, int | float]]:
        """Return the random settings of a sample: value and number by path."""
        return {path: draw.at(self.seed, index // self.draws) for path, draw in self._draws.items()}

    def _settings_of(self, index: int) -> dict[str, Any]:
        return self._with(index, {path: value for path, (value, _) in self._drawn(index).items()})

    def _with(self, index: int, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings with the given values and the picture of a sample."""
        data = _copied(self._settings)
        data["scene"]["picture"] = self._name_of(index)
        if self._fit is not None:
            half_x_um, half_y_um, magnification = self._fit_um
            n_y, n_x = self._pixels(self._picture_of(index)).shape[:2]
            choose = max if self._fit == "cover" else min
            data["scene"]["pitch_um"] = choose(2.0 * half_x_um / n_x, 2.0 * half_y_um / n_y) / magnification
        for path, value in values.items():
            put_setting(self._file, data, path, value)
        return data

    def _keep(self, part: str, settings: Any, make: Callable[[], Any]) -> Any:
        """
        Return the component with the given settings, from the cache or newly built.

        The warnings of its construction are stored with it, so that every sample that uses it reports them.
        """
        parts = self._kept.setdefault(part, OrderedDict())
        key = json.dumps(settings, sort_keys=True)
        if key not in parts:
            with _caught_warnings() as caught:
                made = make()
            parts[key] = made, [_warning(each.message) for each in caught]
            if len(parts) > KEPT:
                parts.popitem(last=False)
        parts.move_to_end(key)
        made, told = parts[key]
        self._told += told
        return made

    def _pixels(self, picture: int) -> NDArray[Any]:
        pixels: NDArray[Any] = self._keep("picture", picture, lambda: self._pictures.picture(picture))
        return pixels

    def _shot(self, index: int) -> Shot:
        return self._built(index, self._settings_of(index))

    def _built(self, index: int, settings: Mapping[str, Any]) -> Shot:
        picture = self._picture_of(index)

        def scene() -> Scene:
            values = {key: value for key, value in settings["scene"].items() if key not in ("kind", "picture")}
            try:
                return Scene.from_picture(self._pixels(picture), **values)
            except ParameterError as error:
                raise FileError(self._name_of(index), f"is not a valid picture for these settings: {error}") from None

        def keep(part: str, told: Any, make: Callable[[], Any]) -> Any:
            return self._keep(part, [picture, told], scene) if part == "scene" else self._keep(part, told, make)

        return build_shot(self._file, settings, n_threads=self._n_threads, cache=keep)

    def _captured(self, index: int) -> tuple[Shot, Capture]:
        settings = self._settings_of(index)
        shot = self._built(index, settings)
        camera, sensor, scene = shot.camera, shot.camera.sensor, shot.scene
        sums = [sensor.responsivity_e_per_j(scene.wavelength_nm), sensor.filter_of_site]
        light = [
            self._picture_of(index),
            *(settings.get(part) for part in ("scene", "optics", "distortion", "layout", "integration_order")),
            *(hashlib.sha256(each.tobytes()).hexdigest() for each in sums),
        ]
        photo_e_per_s = self._keep("light", light, lambda: camera.photoelectrons_per_s(scene))
        capture = camera.capture(
            scene, exposure_s=shot.exposure_s, seed=self.seed, frame=index, photo_e_per_s=photo_e_per_s
        )
        return shot, capture

    def _sample(self, index: int) -> dict[str, Any]:
        self._told = []
        with _caught_warnings() as caught:
            drawn = self._drawn(index)
            shot, capture = self._captured(index)
            sample: dict[str, Any] = {"index": index, "picture": self._picture_of(index)}
            sample |= {field: self._field(field, index, shot, capture) for field in self.fields}
            sample |= self._site_labels(index, shot)
        told = [*self._told, *(_warning(each.message) for each in caught)]
        if told and not self._has_warned:
            self._has_warned = True
            text = f"sample {index}: {told[0]}; further warnings are in the item 'warning' of each sample"
            warnings.warn(text, type(told[0]), stacklevel=4)
        sample["settings"] = {path: number for path, (_, number) in drawn.items()}
        sample["warning"] = "; ".join(dict.fromkeys(str(each) for each in told))
        return sample

    def _field(self, field: str, index: int, shot: Shot, capture: Capture) -> NDArray[Any]:
        if field == "code":
            return capture.code.astype(self._code_type)
        if field == "expected_dn":
            # Equal for all draws of a camera.
            predict = partial(shot.camera.sensor.predict, capture.expected_e, n_threads=self._n_threads)
            return np.array(self._keep("prediction", index // self.draws, predict)[0])
        return np.array(getattr(capture, field))

    def _site_labels(self, index: int, shot: Shot) -> dict[str, Any]:
        picture = self._picture_of(index)
        found: dict[str, Any] = {} if self._labels is None else {"label": self._labels[picture]}
        if self._boxes is None and self._masks is None and self._flows is None:
            return found
        camera, scene = shot.camera, shot.scene
        assert isinstance(scene, Scene)
        grid = camera.image_grid(scene)
        lens = camera.distortion
        n_grids = len(camera.optics.image_grids(scene))
        integrator = camera.integrator(grid, order=1, n_grids=n_grids)
        where = f"of {self._name_of(index)}"
        if self._boxes is not None:
            boxes_px, classes = self._boxes[picture]
            on_sites = boxes_on_sites(boxes_px, integrator, lens)
            n_most = max(len(each) for each, _ in self._boxes)
            found["box_um"] = _filled(on_sites.box_um, n_most, 0.0)
            found["box_label"] = _filled(classes, n_most, NOTHING)
            found["box_covers"] = _filled(on_sites.covers, n_most, False)
        if self._masks is not None:
            mask = read_mask(self._masks[picture], f"mask {where}", grid.shape)
            found["mask"] = mask_on_sites(mask, integrator)
        if self._flows is not None:
            flow = flow_on_sites(read_flow(self._flows[picture], f"flow {where}", grid.shape), integrator, lens)
            found["flow_um"], found["flow_known"] = flow.flow_um, flow.is_known
        return found

    # -- before the first sample --------------------------------------------------------------------------------------

    def _try_ends(self) -> None:
        """Build the first shot at the bounds of every setting, to detect errors early."""
        try:
            base = self._built(0, self._with(0, {}) if self._fit is None else self._unfitted())
            layout, scene = base.camera.sensor.layout, base.scene
            if self._fit is not None:
                assert isinstance(layout, Layout)
                assert isinstance(scene, Scene)
                if layout.n_sites == 0:
                    raise ParameterError("fit", "must be used with a layout that has photosites")
                x_um, y_um = (0.0, 0.0) if base.camera.distortion is None else base.camera.distortion.centre_um
                x0, y0, x1, y1 = layout.bounds_um
                half_um = max(x1 - x_um, x_um - x0), max(y1 - y_um, y_um - y0)
                self._fit_um = (*half_um, base.camera.optics.magnification(scene.distance_m))
            first = {path: draw.ends[0] for path, draw in self._draws.items()}
            most_bits = self._tried(first)
            for path, draw in self._draws.items():
                for value in draw.ends[1:TRIED_VALUES]:
                    most_bits = max(most_bits, self._tried(first | {path: value}))
            self._code_type = np.uint8 if most_bits <= 8 else np.uint16
        finally:
            self._begin()

    def _unfitted(self) -> dict[str, Any]:
        data = _copied(self._settings)
        data["scene"]["picture"] = self._name_of(0)
        return data

    def _tried(self, values: Mapping[str, Any]) -> int:
        """Build the shot of the first picture with the given values and return its bit depth."""
        settings = self._with(0, values)
        check_settings(self._file, settings)
        return self._built(0, settings).camera.sensor.bits


def _base(
    shot: str | Path | Mapping[str, Any],
    source: Path,
    changes: Mapping[str, Any],
    found: list[Path],
    *,
    is_fitted: bool,
) -> tuple[Path, Any]:
    """
    Return the file of the settings, for messages, and the settings with absolute paths.

    The referenced files are appended to ``found``.
    """
    if isinstance(shot, Mapping):
        file, data = source, _copied(shot)
    elif isinstance(shot, str | Path):
        file = Path(shot)
        data = read_settings(file)
    else:
        raise ParameterError("shot", f"must be a settings file or a mapping of settings, got a {type(shot).__name__}")
    scene = data.get("scene")
    if not isinstance(scene, Mapping) or scene.get("kind") != "picture":
        raise ConfigError(file, "scene.kind: must be 'picture' for a dataset, which supplies the pictures")
    data = resolve_files(
        file.parent, {**data, "scene": {key: scene[key] for key in scene if key != "picture"}}, found=found
    )
    data["scene"]["picture"] = ""
    if is_fitted:
        data["scene"]["pitch_um"] = 1.0
    for path, value in changes.items():
        put_setting(file, data, path, resolve_files(Path(), value, path, found))
    data.pop("seed", None)
    try:
        return file, json.loads(json.dumps(data, default=_plain))
    except (TypeError, ValueError, RecursionError) as error:
        raise ConfigError(file, f"must contain only numbers, strings, lists and mappings ({error})") from None


def _plain(value: Any) -> Any:
    """Convert numpy and path objects in settings to plain data."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"got a {type(value).__name__}")


def _draws(file: Path, vary: Mapping[str, Any], found: list[Path], *, is_fitted: bool) -> dict[str, Draw]:
    if not isinstance(vary, Mapping):
        raise ParameterError("vary", "must be a mapping of setting paths to distributions", vary)
    draws = {str(path): parse_distribution(str(path), told) for path, told in vary.items()}
    check_disjoint(file, draws)
    for path, draw in draws.items():
        if draw.kind == "choice":
            draws[path] = replace(
                draw, values=tuple(resolve_files(Path(), value, path, found) for value in draw.values)
            )
        if path in ("seed", "scene", "scene.kind", "scene.picture"):
            raise ParameterError(path, "must not vary: the dataset has its own seed and its own pictures")
        if is_fitted and path == "scene.pitch_um":
            raise ParameterError(path, "must not vary with 'fit', which sets it")
    return draws


def _numbered(labels: Any, n: int) -> tuple[list[int] | None, list[str] | None]:
    """Return the classes of the pictures as numbers, and the names of string classes."""
    if labels is None:
        return None, None
    each = check_per_picture("labels", labels, n)
    values = [value.item() if isinstance(value, np.generic) else value for value in (each[k] for k in range(n))]
    if all(isinstance(value, int) for value in values):
        for value in values:
            check_count("labels", int(value), at_least=LEAST, at_most=MOST)
        return [int(value) for value in values], None
    if all(isinstance(value, str) for value in values):
        names = sorted(set(values))
        numbers = {name: k for k, name in enumerate(names)}
        return [numbers[value] for value in values], names
    raise ParameterError("labels", "must all be integers, or all be strings", values)


def _ends(numbers: range) -> list[int]:
    """Return the first and the last number."""
    return [*dict.fromkeys((numbers[0], numbers[-1]))]


def _filled(array: NDArray[Any], n: int, value: Any) -> NDArray[Any]:
    """Pad an array with rows of one value to ``n`` rows."""
    rest = np.full((n - len(array), *array.shape[1:]), value, array.dtype)
    return np.concatenate((array, rest))


@contextmanager
def _caught_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """Record all warnings except ResourceWarning, which garbage collection emits at any time."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", ResourceWarning)
        yield caught


def _warning(message: Warning | str) -> Warning:
    return message if isinstance(message, Warning) else FoveasimWarning(message)


def _copied(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of settings with new mappings; lists are shared."""
    return {key: _copied(value) if isinstance(value, Mapping) else value for key, value in data.items()}
