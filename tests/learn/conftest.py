"""
One thread of PyTorch per process: several processes with several threads each would wait for each other.

Tests with the fixture ``device`` run on all devices that the machine has, and on ``meta``, whose tensors have no values; those
of derivatives, with the fixture ``real_device``, run on the former only. ``make test-gpu`` runs both on a GPU.
"""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from foveasim.optics import _field_modes

DEVICES = ["cpu", "meta"]
if find_spec("torch"):
    import torch

    torch.set_num_threads(1)
    if torch.cuda.is_available():
        DEVICES.append("cuda")


@pytest.fixture(params=DEVICES)
def device(request):
    return torch.device(request.param)


@pytest.fixture(params=[name for name in DEVICES if name != "meta"])
def real_device(request):
    return torch.device(request.param)


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    """Sample PSFs that vary over the field at 5 x 5 points instead of 9 x 9 or 17 x 17, in layers and simulator."""
    monkeypatch.setattr(_field_modes, "FIELD_POINTS", (5,))


@pytest.fixture(autouse=find_spec("torch") is not None)
def fixed_random_numbers():
    """Draw the same random tensors in each run, whichever tests run before."""
    torch.manual_seed(0)
