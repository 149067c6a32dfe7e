"""Comparison of the cameras of settings files, or of layouts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from foveasim import compare
from foveasim._io.yaml_files import read_yaml
from foveasim.compare.setup import DEFAULT_EXPOSURE_S, cameras_of, field_um
from foveasim.config._objects import YAML_EXTENSIONS, Shot, read_any_layout, read_shot, resolve_files
from foveasim.errors import FileError, ParameterError, printable
from foveasim.fields import PowerMap
from foveasim.layout import Layout
from foveasim.layout.files import layout_path, read_options_of
from foveasim.scene import Scene


def compare_files(
    paths: Sequence[str | Path],
    *,
    pictures: Sequence[str | Path] = (),
    exposure_s: float | None = None,
    layout_options: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> compare.Comparison:
    """
    Compare layouts, or the cameras of shots.

    Parameters
    ----------
    paths : sequence of paths
        Two or more layouts in any format, or names of bundled ones; or settings files of shots.
    pictures : sequence of paths
        Photographs as scenes. By default five of scikit-image for layouts, and the scenes of the shots for shots.
    exposure_s : float, optional, s
        By default that of the shots; 1/60 s for layouts.
    layout_options : mapping, optional
        Options of :func:`foveasim.read_layout` for the layouts whose format has them, such as ``layer`` of chip files.
    progress : function of (n_done, n), optional
    **options
        As for :func:`foveasim.compare.cameras`.

    Raises
    ------
    FileError
        When a file cannot be read.
    ParameterError
        When layouts and shots are mixed, exposures differ, no layout has one of the options,
        or as for :func:`foveasim.compare.cameras`.

    Examples
    --------
    >>> import foveasim as fs
    >>> found = fs.config.compare_files(
    ...     ["foveal.yaml", "square.yaml"], budget="data_rate"
    ... )  # doctest: +SKIP
    >>> found.write("report.html")  # doctest: +SKIP
    """
    if len(paths) < 2:
        raise ParameterError("files", "must be at least two layouts or shots", len(paths))
    found = [layout_path(Path(path), ".") for path in paths]
    are_shots = [_is_shot(path) for path in found]
    if len(set(are_shots)) > 1:
        shot, layout = (str(paths[are_shots.index(kind)]) for kind in (True, False))
        raise ParameterError(
            "files", f"must be layouts or shots, not both: {printable(shot)} is a shot, {printable(layout)} a layout"
        )
    names = _unique_names([path.stem for path in found])
    if not are_shots[0]:
        read = _read_layouts(paths, layout_options or {})
        cameras = cameras_of(dict(zip(names, read, strict=True)), None, None)
        first = next(iter(cameras.values()))
        scenes: dict[str, Scene | PowerMap] = dict(
            compare.photograph_scenes(field_um(read), first.optics, pictures=list(pictures) or None)
        )
        exposure_s = DEFAULT_EXPOSURE_S if exposure_s is None else exposure_s
    else:
        for name in layout_options or ():
            raise ParameterError(name, "must be omitted for shots, whose settings contain the options of their layouts")
        shots = dict(zip(names, [read_shot(path) for path in found], strict=True))
        cameras = {name: shot.camera for name, shot in shots.items()}
        if exposure_s is None:
            times_s = {name: shot.exposure_s for name, shot in shots.items()}
            exposure_s = next(iter(times_s.values()))
            if len(set(times_s.values())) > 1:
                raise ParameterError(
                    "exposure_s",
                    "must be equal",
                    ", ".join(f"{time_s:g} s ({name})" for name, time_s in times_s.items()),
                    hint="specify a common one",
                )
        scenes = dict(_photographs(shots, pictures)) if pictures else _scenes(shots, found)
    return compare.cameras(cameras, scenes, exposure_s=exposure_s, progress=progress, **options)


def _read_layouts(paths: Sequence[str | Path], options: Mapping[str, Any]) -> list[Layout]:
    """Read layouts; an option is for those whose format has it, or invalid for the first."""
    accepted = [{"centre"} | _options_of(layout_path(Path(path), ".")) for path in paths]
    unknown = set(options) - set().union(*accepted)
    return [
        read_any_layout(path, **{name: value for name, value in options.items() if name in names | unknown}).layout
        for path, names in zip(paths, accepted, strict=True)
    ]


def _options_of(path: Path) -> set[str]:
    return set() if path.suffix.lower() in YAML_EXTENSIONS else read_options_of(path)


def _is_shot(path: Path) -> bool:
    return path.suffix.lower() in YAML_EXTENSIONS and path.is_file() and "scene" in read_yaml(path)


def _unique_names(names: Sequence[str]) -> list[str]:
    """Return printable names, numbered where they repeat."""
    unique: list[str] = []
    for name in map(printable, names):
        k, candidate = 1, name
        while candidate in unique:
            k += 1
            candidate = f"{name} ({k})"
        unique.append(candidate)
    return unique


def _scenes(shots: dict[str, Shot], paths: Sequence[Path]) -> dict[str, Scene | PowerMap]:
    """Return the distinct scenes of shots."""
    settings: list[Any] = []
    scenes: dict[str, Scene | PowerMap] = {}
    for (name, shot), path in zip(shots.items(), paths, strict=True):
        section = resolve_files(path.parent, read_yaml(path)["scene"])
        if section not in settings:
            settings.append(section)
            scenes[f"scene of {name}"] = shot.scene
    return scenes


def _photographs(shots: dict[str, Shot], pictures: Sequence[str | Path]) -> dict[str, Scene]:
    """Return photographs with the distance, radiance and bands of all shots, which are equal."""
    light: dict[str, dict[str, Any]] = {}
    for name, shot in shots.items():
        scene = shot.scene
        if isinstance(scene, PowerMap):
            raise FileError(name, "has a power map as scene; photographs require a scene with a radiance")
        light[name] = {
            "distance_m": scene.distance_m,
            "peak_radiance_w_m2_sr_nm": float(scene.spectrum_w_m2_sr_nm.max()),
            "wavelength_nm": scene.wavelength_nm.tolist(),
            "band_width_nm": scene.band_width_nm.tolist(),
        }
    (first, common), *others = light.items()
    for name, own in others:
        different = [key for key in common if own[key] != common[key]]
        if different:
            raise ParameterError(
                "pictures",
                f"require shots whose scenes have the same {different[0]}: those of {printable(first)} and {printable(name)} "
                "differ",
            )
    cameras = [shot.camera for shot in shots.values()]
    width_um = field_um([camera.layout for camera in cameras])
    return compare.photograph_scenes(width_um, cameras[0].optics, pictures=pictures, **common)
