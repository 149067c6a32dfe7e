"""Shapes that no machine has memory for: an error before the array is made."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

import foveasim as fs
from foveasim._core import validation
from foveasim.errors import ParameterError
from foveasim.scene import charts

BIG = (10**6, 10**6)
PLACED = {"shape": BIG, "pitch_um": 1.0, "distance_m": 1.0}
LIT = {**PLACED, "radiance_w_m2_sr_nm": 1.0, "band_width_nm": 10.0}
CHARTS = [
    name
    for name, chart in vars(charts).items()
    if inspect.isfunction(chart) and {"shape", "radiance_w_m2_sr_nm"} <= set(inspect.signature(chart).parameters)
]
LAYOUT = fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0)
MADE = {
    "flat": lambda: fs.Scene.flat(**LIT),
    "points": lambda: fs.Scene.point_sources(**PLACED, pixels=[(0, 0)], intensity_w_sr_nm=1.0),
    "grid": lambda: fs.Grid(BIG, 1.0),
    "centred grid": lambda: fs.Grid.centred(BIG, 1.0),
    "id map": lambda: fs.view.id_map(LAYOUT, shape=BIG),
    "still": lambda: fs.view.render(fs.view.prisms(LAYOUT), "none.png", size_px=BIG),
}


@pytest.mark.parametrize("make", MADE.values(), ids=MADE)
def test_absurd_shapes_are_rejected_before_allocation(make):
    # The oracle is arithmetic: 1e12 float32 are 4e12 bytes, 3,725 GiB.
    with pytest.raises(
        ParameterError,
        match=r"must fit in memory: 3 arrays of 3,725 GiB exceed .* GiB, got \(1000000, 1000000\)",
    ):
        make()


@pytest.mark.parametrize("name", CHARTS)
def test_absurd_charts_are_rejected_before_allocation(name):
    chart = getattr(charts, name)
    parameters = [k for k, p in inspect.signature(chart).parameters.items() if p.default is p.empty]
    with pytest.raises(ParameterError, match=r"'shape' must fit in memory: 3 arrays of 3,725 GiB"):
        chart(**LIT, **{name: 1.0 for name in parameters if name not in LIT})


def test_memory_is_that_of_the_machine():
    meminfo = Path("/proc/meminfo")
    if not meminfo.exists():
        pytest.skip("/proc/meminfo is Linux's")
    (total_kib,) = re.findall(r"MemTotal: +(\d+) kB", meminfo.read_text())

    assert 2**28 <= validation.memory_bytes() <= 1024 * int(total_kib)
    assert fs.Grid((20_000, 10_000), 1.0).shape == (20_000, 10_000)
