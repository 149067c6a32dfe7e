"""One thread of PyTorch per process: several processes with several threads each would wait for each other."""

from __future__ import annotations

from importlib.util import find_spec

if find_spec("torch"):
    import torch

    torch.set_num_threads(1)
