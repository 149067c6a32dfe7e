"""Contents of the start page, as plain data."""

from __future__ import annotations

from typing import Any

from foveasim._io.yaml_files import first_comment
from foveasim.layout import LAYOUTS, MOSAICS, OPTICAL_FORMATS
from foveasim.layout.generator_registry import summary_of
from foveasim.layout.sizes.sizing import N_SITES, is_rectangular, sizable
from foveasim.sensor import PRESETS
from foveasim.studio._engine import MAX_SITES
from foveasim.studio._files import Files, preset_paths, presets, thumbnail_name
from foveasim.studio._settings.templates import has_mosaic
from foveasim.studio._start import new_sensor as sensors
from foveasim.studio._start.recent import recent_files

#: Initial choices of a new sensor.
INITIAL = {
    "generator": "log_polar",
    "format": "1/3",
    "n_sites": N_SITES,
    "frames_per_s": sensors.FRAMES_PER_S,
    "filters": sensors.BAYER,
    "electronics": "machine_vision",
}


def contents_of(files: Files) -> dict[str, Any]:
    """
    Return presets with thumbnails, the choices of a new sensor, and recent files.

    ``files``: those that settings may contain. Without directories that are kept, ``recent`` is None.
    """
    directories = files.kept_directories
    return {
        "presets": [_with_description(each) for each in presets()],
        "generators": [_generator(name) for name in sizable()],
        "formats": [
            {
                "name": name,
                "label": f"{each.title}, {each.description}",
                "size_um": list(each.size_um),
                "source": each.source,
            }
            for name, each in OPTICAL_FORMATS.items()
        ],
        "mosaics": [{"name": name, "label": _mosaic_label(name)} for name in sensors.mosaics()],
        "electronics": [
            {
                "name": name,
                "label": f"{PRESETS[name].group}: {PRESETS[name].title}",
                "source": PRESETS[name].source,
                "scaling": PRESETS[name].scaling,
            }
            for name in sensors.electronics()
        ],
        "initial": INITIAL,
        "max_sites": MAX_SITES,
        "recent": recent_files(files, directories) if directories else None,
    }


def _with_description(preset: dict[str, str]) -> dict[str, str]:
    name = preset["name"]
    return {**preset, "text": first_comment(preset_paths()[name]), "picture": thumbnail_name(name)}


def _generator(name: str) -> dict[str, Any]:
    text = summary_of(LAYOUTS[name]).removeprefix("Generate ")
    return {
        "name": name,
        "label": name.replace("_", " "),
        "text": f"{text[:1].upper()}{text[1:]}.",
        "fills_format": is_rectangular(name),
        "has_mosaic": has_mosaic(name),
    }


def _mosaic_label(name: str) -> str:
    """Return the name and the size of a mosaic."""
    if name == sensors.BAYER:
        return f"Bayer, {name}"
    block = MOSAICS[name]
    return f"{name.replace('_', ' ')}, {len(block[0])} × {len(block)}"
