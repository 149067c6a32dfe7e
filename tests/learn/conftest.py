"""One thread of PyTorch per process: several processes with several threads each would wait for each other."""

from __future__ import annotations

import torch

torch.set_num_threads(1)
