"""Budgets of cameras: number of sites, data rate, readout time, area, and read noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np

from foveasim._core.calls import POSITIVE
from foveasim._core.quantities import format_quantity
from foveasim._core.validation import check_choice
from foveasim.camera import Camera
from foveasim.errors import ParameterError, format_value

__all__ = ["BUDGETS", "Budget", "budget_of", "budget_rows", "check_equal_budgets"]


@dataclass(frozen=True, kw_only=True)
class Budget:
    """
    Budget of a camera.

    Attributes
    ----------
    n_sites : int
    data_rate_bit_per_s : float, bit/s
        Sum of bit depth times frame rate over all sites, without blanking.
    readout_steps : int
        Readout time in units of the time of one site: the number of sites on the longest readout line, as the lines are read
        in parallel and the sites of a line in sequence.
    area_um2 : float, µm²
        Total area of the sites.
    read_noise_e2 : float, e-²
        Sum of the variances of the readout over all sites, without quantisation: read, reset and RTS noise, further effects.
    """

    n_sites: int
    data_rate_bit_per_s: float
    readout_steps: int
    area_um2: float
    read_noise_e2: float


#: Names of budgets, with the attribute, the title and the unit of each.
BUDGETS = {
    "n_sites": ("n_sites", "number of sites", ""),
    "data_rate": ("data_rate_bit_per_s", "data rate", "bit/s"),
    "readout_time": ("readout_steps", "readout time", "steps"),
    "area": ("area_um2", "area of the sites", "µm²"),
    "read_noise": ("read_noise_e2", "sum of read-noise variances", "e-²"),
}
assert {attribute for attribute, _, _ in BUDGETS.values()} == {field.name for field in fields(Budget)}


def budget_of(camera: Camera, frames_per_s: Annotated[float, POSITIVE]) -> Budget:
    """
    Return the budget of a camera.

    Parameters
    ----------
    camera : Camera
    frames_per_s : float, 1/s

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=20, n_y=10, pitch_um=3.0), bits=12)
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> budget = fs.compare.budget_of(camera, 30.0)
    >>> budget.n_sites, budget.data_rate_bit_per_s, round(budget.area_um2)
    (200, 72000.0, 1800)
    """
    sensor = camera.sensor
    n_sites = sensor.layout.n_sites
    return Budget(
        n_sites=n_sites,
        data_rate_bit_per_s=n_sites * sensor.bits * frames_per_s,
        readout_steps=int(np.unique(sensor.layout.readout_line, return_counts=True)[1].max(initial=0)),
        area_um2=float(sensor.layout.area_um2.sum()),
        read_noise_e2=float(np.broadcast_to(sensor.readout_model(0.0).noise_e2, n_sites).sum()),
    )


def budget_rows(budgets: Sequence[Budget]) -> list[list[str]]:
    """Return title and one value per camera of each budget."""
    return [
        [title, *(format_quantity(getattr(budget, attribute), unit, digits=6) for budget in budgets)]
        for attribute, title, unit in BUDGETS.values()
    ]


def check_equal_budgets(budgets: Mapping[str, Budget], budget: str | None, tolerance: float) -> None:
    """
    Check that cameras have the same budget.

    ``budget`` ({"n_sites", "data_rate", "readout_time", "area", "read_noise"} or None): the budget to compare; None for no
    check. ``tolerance``: largest difference of two cameras, relative to the smaller budget. Raises ParameterError when the
    smallest and the largest budget differ by more.
    """
    if budget is None:
        return
    attribute, title, unit = BUDGETS[check_choice("budget", budget, tuple(BUDGETS))]
    found = {name: getattr(one, attribute) for name, one in budgets.items()}
    low, high = min(found, key=found.__getitem__), max(found, key=found.__getitem__)
    if found[high] - found[low] > tolerance * found[low]:
        shown = [format_quantity(found[name], unit, digits=6) for name in (low, high)]
        raise ParameterError(
            "budget",
            f"must be equal within {100.0 * tolerance:g} %: the {title} of {format_value(low)} is {shown[0]}, "
            f"that of {format_value(high)} {shown[1]}",
            hint="use layouts of equal budget (n_sites= of a generator), a larger tolerance, or no budget",
        )
