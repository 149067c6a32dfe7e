"""Copies of all public objects by pickle and the module copy, after use: equal, bit-identical results, read-only arrays."""

from __future__ import annotations

import copy
import pickle
from functools import cached_property
from types import FunctionType, MappingProxyType

import cloudpickle
import numpy as np
import pytest
from reference.public_objects import CAMERA, GRID, SCENE, SENSOR, public_objects

import foveasim as fs

COPIES = {
    "pickle": lambda item: pickle.loads(pickle.dumps(item)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    "cloudpickle": lambda item: pickle.loads(cloudpickle.dumps(item)),
}
SEALED = (str, bytes, int, float, complex, bool, type(None), FunctionType, type, np.generic)
#: Attributes that are caches or locks; and the places of violations, of which copies contain the results.
SKIPPED = {"_cache", "_integrators", "_locate", "_lock"}


@pytest.fixture(scope="module")
def used(tmp_path_factory):
    """Return an object of each public class whose parts have been used."""
    objects = public_objects(tmp_path_factory.mktemp("copied"))
    CAMERA.predict(SCENE, exposure_s=0.01)
    return objects


def differences(one, other, where="", visited=None):
    """Yield the parts in which two objects differ, without their caches."""
    visited = set() if visited is None else visited
    if id(one) in visited:
        return
    visited.add(id(one))
    if type(one) is not type(other):
        yield f"{where}: {type(one).__name__}, {type(other).__name__}"
    elif isinstance(one, np.ndarray):
        if one.dtype != other.dtype or one.shape != other.shape or one.tobytes() != other.tobytes():
            yield f"{where}: other values"
        if one.flags.writeable != other.flags.writeable:
            yield f"{where}: writeable {one.flags.writeable}, {other.flags.writeable}"
    elif isinstance(one, dict | MappingProxyType):
        if list(one) != list(other):
            yield f"{where}: other keys"
            return
        for key in one:
            yield from differences(one[key], other[key], f"{where}[{key!r}]", visited)
    elif isinstance(one, list | tuple):
        if len(one) != len(other):
            yield f"{where}: other length"
            return
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from differences(a, b, f"{where}[{k}]", visited)
    elif type(one).__module__.startswith("foveasim") and not isinstance(one, SEALED):
        slots = [name for kind in type(one).__mro__ for name in getattr(kind, "__slots__", ())]
        names = sorted({*slots, *getattr(one, "__dict__", {})} - SKIPPED)
        for name in names:
            if not isinstance(getattr(type(one), name, None), cached_property):
                yield from differences(getattr(one, name), getattr(other, name), f"{where}.{name}", visited)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("method", COPIES)
def test_copies_of_public_objects_are_equal(used, method):
    found = []
    for item in used:
        try:
            found += differences(item, COPIES[method](item), type(item).__name__)
        except Exception as error:  # noqa: BLE001 -- all are reported
            found.append(f"{type(item).__name__}: {type(error).__name__} {error}")

    assert found == []


#: Results of used objects, bit-identical for copies.
RESULTS = {
    "Camera": lambda item: item.capture(SCENE, exposure_s=0.01, seed=3).code,
    "Camera of two moments": lambda item: item.predict(SCENE, exposure_s=0.01)[1],
    "Sensor": lambda item: item.pattern("prnu"),
    "Optics": lambda item: item.power_map(SCENE).data,
    "Integrator": lambda item: item(np.arange(GRID.shape[0] * GRID.shape[1], dtype=np.float32).reshape(GRID.shape)),
    "Layout": lambda item: item.area_um2,
    "Capture": lambda item: item.picture().data,
    "EventPixels": lambda item: item.events([np.full(1200, 1e5), np.full(1200, 5e5)], frame_s=0.01, seed=0).t_s,
    "SpikingPixels": lambda item: item.events([np.full(1200, 1e5)], frame_s=0.01, seed=0).t_s,
    "CrosstalkOperator": lambda item: item.apply(np.arange(1200.0)),
    "Sites": lambda item: item.device.normals("test"),
    "Dataset": lambda item: item[1]["code"],
    "Shot": lambda item: item.camera.capture(item.scene, exposure_s=0.01, seed=1).code,
    "Shutter": lambda item: item.overlap_fraction(0, 0.05),
    "Report": lambda item: repr(item.records()),
}


@pytest.mark.parametrize("method", COPIES)
@pytest.mark.parametrize("name", RESULTS)
def test_copies_give_identical_results(used, name, method):
    item = next(item for item in used if type(item).__name__ == name.split()[0])
    if name == "Sensor":
        item = fs.Sensor(SENSOR.layout, prnu_fraction=0.01)
    before = RESULTS[name](item)

    after = RESULTS[name](COPIES[method](item))

    assert np.asarray(before).tobytes() == np.asarray(after).tobytes()
