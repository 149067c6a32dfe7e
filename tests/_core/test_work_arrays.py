"""Tests of the reuse of the memory of large arrays."""

import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import foveasim as fs
from foveasim._core import work_arrays
from foveasim._core.work_arrays import release_memory, work_array

SHAPE = (512, 1024)


@pytest.fixture(autouse=True)
def empty_pool(monkeypatch):
    monkeypatch.setattr(work_arrays, "_POOL", work_arrays._Pool())


def address(array):
    return array.__array_interface__["data"][0]


def test_memory_is_reused_after_deletion():
    first = work_array(SHAPE, np.float32)
    at = address(first)
    assert address(work_array(SHAPE, np.float32)) != at

    del first
    again = work_array((SHAPE[1] // 2, SHAPE[0]), np.complex64)

    assert again.shape == (SHAPE[1] // 2, SHAPE[0])
    assert again.dtype == np.complex64
    assert again.flags.c_contiguous
    assert again.flags.writeable
    assert address(again) == at


def test_views_prevent_memory_reuse():
    whole = work_array(SHAPE, np.float32)
    at = address(whole)
    view = whole.reshape(-1)[10:].view(np.uint8)[3:]
    del whole

    assert address(work_array(SHAPE, np.float32)) != at
    del view
    assert at in {address(each) for each in [work_array(SHAPE, np.float32) for _ in range(2)]}


def test_unused_memory_is_limited(monkeypatch):
    n_bytes = 4 * SHAPE[0] * SHAPE[1]
    monkeypatch.setattr(work_arrays._POOL, "max_unused_bytes", 2 * n_bytes)
    arrays = [work_array(SHAPE, np.float32) for _ in range(4)]
    del arrays

    assert sum(unused.size for unused in work_arrays._POOL._unused) == 2 * n_bytes


def test_release_keeps_used_memory():
    used, unused = (work_array(SHAPE, np.float32) for _ in range(2))
    used[...] = 3.0
    del unused
    assert len(work_arrays._POOL._unused) == 1

    release_memory()

    assert work_arrays._POOL._unused == []
    assert (used == 3.0).all()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the C library of GNU")
def test_threads_share_one_heap(tmp_path):
    code = """
import ctypes, sys, threading
if sys.argv[1] == "shared":
    from foveasim._core.work_arrays import share_heap
    share_heap()
barrier, blocks = threading.Barrier(3), []
def allocate():
    blocks.append(bytearray(100_000))
    barrier.wait()
threads = [threading.Thread(target=allocate) for _ in range(3)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p
file = ctypes.c_void_p(libc.fopen(sys.argv[2].encode(), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
"""
    n_heaps = {}
    for name in ("shared", "separate"):
        path = tmp_path / f"{name}.xml"
        subprocess.run([sys.executable, "-c", code, name, str(path)], check=True)
        n_heaps[name] = path.read_text().count("<heap nr=")

    assert n_heaps["shared"] == 1 < n_heaps["separate"]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the C library of GNU")
def test_free_pages_of_the_heap_are_returned():
    """Blocks of 16 KiB with a used one after every 64."""
    code = """
import resource, sys
from foveasim._core import work_arrays
def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize() / 2**20
blocks = [bytearray(16_000) for _ in range(12_800)]
used = blocks[::64]
full = resident_mb()
del blocks
work_arrays.trim_heaps()
early = resident_mb()
work_arrays._trims.last_s -= work_arrays.TRIM_INTERVAL_S
work_arrays.trim_heaps()
print(full, early, resident_mb())
"""
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    full, early, late = map(float, found.split())

    assert early > full - 20.0  # not before the interval is over
    assert late < full - 150.0


@pytest.mark.parametrize("frames", ["captures", "video"])
def test_frames_return_free_pages(monkeypatch, frames):
    trims = []
    monkeypatch.setattr(work_arrays, "_trim", lambda: trims.append(1))
    monkeypatch.setattr(work_arrays._trims, "interval_s", 0.0)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=fs.Sensor(fs.layout.grid(8, 8, 3.0)))
    scene = fs.Scene.flat(shape=(200, 200), pitch_um=100.0, distance_m=1.0, radiance_w_m2_sr_nm=0.1, band_width_nm=10.0)
    if frames == "video":
        list(camera.video([scene, replace(scene, distance_m=2.0)], exposure_s=0.001, seed=0))
    else:
        for _ in range(2):
            camera.capture(scene, exposure_s=0.001, seed=0)

    assert len(trims) >= 2


def test_threads_never_share_memory():
    def fill(number):
        array = work_array(SHAPE, np.int32)
        array[:] = number
        return bool((array == number).all())

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(fill, range(200)))
