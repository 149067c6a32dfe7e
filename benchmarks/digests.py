"""
Digests of captures, predictions, files and pages, to show that a change of the code changes no result.

    python benchmarks/digests.py before.json     # on one version
    python benchmarks/digests.py after.json --against before.json

All bundled and gallery shots, bundled layouts in the camera of the demo, all registered effects, and sweeps, comparisons,
videos and datasets of a small shot. ``PYTHONPATH`` selects another checkout.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import foveasim as fs
from foveasim.sensor.effects import EFFECTS

GALLERY = Path(__file__).parents[1] / "gallery"
#: Times and versions in files.
VOLATILE = re.compile(rb'"(stage_s|seconds|created|elapsed_s)": ?(\{[^}]*\}|[-0-9.e"]+)')
SMALL = {
    "scene": {"kind": "siemens_star", "n_spokes": 24, "shape": [120, 120], "pitch_um": 400.0, "distance_m": 1.0,
              "illuminance_lux": 300.0},
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "log_polar", "parameters": {"n_sectors": 32, "min_size_um": 5.0, "r_max_um": 150.0}},
    "sensor": {"read_noise_e": 2.0, "capacitance_f": 4e-15},
    "exposure_s": 0.01,
    "seed": 5,
}  # fmt: skip


def digest(value: Any) -> str:
    """Return the digest of an array, a file, a text, or nested values."""
    found = hashlib.sha256()
    _add(found, value)
    return found.hexdigest()[:16]


def _add(found: Any, value: Any) -> None:
    if isinstance(value, Path):
        if value.suffix in (".npz", ".zip"):
            with np.load(value, allow_pickle=False) as stored:
                _add(found, {name: stored[name] for name in sorted(stored)})
        else:
            found.update(VOLATILE.sub(b"", value.read_bytes()))
    elif isinstance(value, Mapping):
        for key in sorted(value):
            found.update(str(key).encode())
            _add(found, value[key])
    elif isinstance(value, str):
        found.update(VOLATILE.sub(b"", value.encode()))
    else:
        array = np.asarray(value)
        if array.dtype.kind in "US" and array.ndim == 0:
            found.update(VOLATILE.sub(b"", str(array).encode()))
        else:
            found.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())


def settings_of_shots() -> Iterator[tuple[str, Path | None, dict[str, Any]]]:
    """Yield name, file and settings of each shot."""
    files = [*fs.config.demo_settings(), *sorted(GALLERY.glob("*.yaml"))]
    for file in files:
        settings = fs.config.read_settings(file)
        if {"scene", "layout"} <= settings.keys() and "picture" not in str(settings.get("scene", {}).get("file", "")):
            yield file.stem, file, settings
    demo = fs.config.demo_settings()[0]
    for name in fs.layout.bundled_layouts():
        settings = fs.config.read_settings(demo)
        settings.pop("requirements", None)
        yield (
            f"layout {name}",
            demo,
            {**settings, "layout": name, "exposure_s": "auto", "sensor": {"preset": "machine_vision"}},
        )
    for name in EFFECTS:
        example = EFFECTS.example(name)
        if isinstance(example, Mapping):
            yield f"effect {name}", None, {**SMALL, "sensor": {"capacitance_f": 4e-15, **example}}
    for optics in (
        {"seidel": {"coma_um": 0.4, "field_radius_um": 150.0}},
        {"pupil": {"kind": "spider", "n_vanes": 3, "width_fraction": 0.1}},
    ):
        yield f"optics {next(iter(optics))}", None, {**SMALL, "optics": {**SMALL["optics"], **optics}}
    yield "gaze", None, {**SMALL, "gaze_um": [20.0, -10.0]}


def of_shot(file: Path | None, settings: dict[str, Any], directory: Path) -> dict[str, Any]:
    """Return the results of a shot by name."""
    shot = fs.config.build_shot(file, settings)
    result, paths = fs.config.run_shot(shot, directory)
    capture = result.capture
    predicted = shot.camera.predict(shot.scene, exposure_s=result.shot.exposure_s)
    found: dict[str, Any] = {
        "capture": {key: getattr(capture, key) for key in ("code", "electrons", "expected_e")},
        "settings": json.dumps(capture.settings, sort_keys=True, default=str),
        "prediction": {
            key: np.asarray(getattr(predicted, key)) for key in ("mean_dn", "variance_dn2") if hasattr(predicted, key)
        },
        "picture": capture.picture(max_pixels=64).data,
        "rules": "" if result.report is None else str(result.report),
        "summary": str(capture.layout.describe()),
        "python": fs.config.to_python(settings, source=file),
        "page": capture._repr_html_(),
        **{path.suffix: path for path in paths},
    }
    for suffix in ("gds", "oas", "geojson", "npz"):
        target = directory / f"layout.{suffix}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fs.config.build_shot(file, settings).camera.layout.write(target)
        found[f"layout file {suffix}"] = fs.layout.read_layout(target).xy_um if suffix in ("gds", "oas") else target
    return found


def of_jobs(directory: Path) -> dict[str, Any]:
    """Return the results of a sweep, a comparison, a video and schemas."""
    names = ["n_sites", "mean_code_dn", "saturated_fraction", "snr", "psnr_db", "data_rate_gbit_per_s"]
    swept = fs.explore.sweep(SMALL, {"exposure_s": [0.002, 0.02]}, metrics=names, workers=0)
    shot = fs.config.build_shot(None, SMALL)
    optics = shot.camera.optics
    layouts = {"grid": fs.layout.grid(20, 20, 6.0), "rings": shot.camera.layout}
    cameras = {key: fs.Camera(optics=optics, sensor=fs.compare.default_sensor(each)) for key, each in layouts.items()}
    compared = fs.compare.cameras(
        cameras, {"star": shot.scene}, exposure_s=0.01, n_annuli=2, max_pixels=48, budget=None
    )
    compared.write(directory / "report.html")
    frames = list(shot.camera.video([shot.scene] * 3, frame_s=0.02, exposure_s=0.01, seed=1))
    found = {
        "sweep": {str(key): swept[key].values for key in swept.data_vars if swept[key].dtype.kind in "biuf"},
        "comparison": dict(compared.values),
        "report": directory / "report.html",
        "video": [frame.code for frame in frames],
    }
    for kind in ("shot", "layout", "rules"):
        found[f"schema {kind}"] = json.dumps(fs.config.schema(kind), sort_keys=True)
    for name in ("snr", "snr_db", "mtf", "psnr_db", "violations", "smallest_size_um", "exposure_s"):
        options = {"frequency_per_mm": 40.0} if name == "mtf" else {}
        one = fs.config.build_shot(None, {**SMALL, "layout": {**SMALL["layout"], "rules": {"min_size_um": 6.0}}})
        capture = one.camera.capture(one.scene, exposure_s=0.01, seed=5)
        found[f"result {name}"] = fs.explore.result_of(fs.config.RegionResult(measure=name, **options), one, capture)
    return found


def main() -> int:
    """Write the digests; list those that differ from others."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--against", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    found: dict[str, str] = {}
    for name, file, settings in settings_of_shots():
        with tempfile.TemporaryDirectory() as directory:
            try:
                results = of_shot(file, settings, Path(directory))
                found |= {f"{name}: {key}": digest(value) for key, value in results.items()}
            except fs.FoveasimError as error:
                found[f"{name}: error"] = str(error)
        print(name, file=sys.stderr)
    with tempfile.TemporaryDirectory() as directory:
        found |= {f"jobs: {key}": digest(value) for key, value in of_jobs(Path(directory)).items()}
    options.out.write_text(json.dumps(found, indent=1), "utf-8")
    if options.against is None:
        return 0
    before = json.loads(options.against.read_text("utf-8"))
    changed = [key for key in {**before, **found} if before.get(key) != found.get(key)]
    print(f"{len(found)} digests, {len(changed)} differ from {options.against}")
    print("\n".join(f"  {key}" for key in changed))
    return int(bool(changed))


if __name__ == "__main__":
    sys.exit(main())
