"""PyTorch adapter of datasets; ``make test-torch`` runs these tests, ``make test`` skips them."""

from __future__ import annotations

import operator
import pickle
from functools import partial

import numpy as np
import pytest
from explore.test_dataset import SHOT, VARY, pictures

from foveasim import explore

pytestmark = pytest.mark.needs("torch")


@pytest.mark.filterwarnings("ignore:This DataLoader will create 2 worker processes")  # on one core
def test_torch_loader_gives_equal_samples_with_workers(tmp_path):
    import torch

    data = explore.Dataset(pictures(20), SHOT, VARY, cameras=5, labels=[k % 7 for k in range(20)])
    stored = explore.write_dataset(data, tmp_path / "data.zarr")
    found = {
        n: list(torch.utils.data.DataLoader(samples, batch_size=8, num_workers=n, shuffle=False))
        for n, samples in ((0, data), (2, explore.torch_dataset(data)))
    }
    found["stored"] = list(torch.utils.data.DataLoader(stored, batch_size=8, num_workers=2))

    assert isinstance(explore.torch_dataset(data), torch.utils.data.Dataset)
    assert sum(len(batch["label"]) for batch in found[0]) == len(data) == 100
    for other in (found[2], found["stored"]):
        for one, two in zip(found[0], other, strict=True):
            for name in ("index", "code", "electrons", "label", "picture"):
                assert torch.equal(one[name], two[name])
            for path in VARY:
                assert torch.equal(one["settings"][path], two["settings"][path])
    np.testing.assert_array_equal(found[0][3]["code"][5].numpy(), data[29]["code"])


def test_adapter_shows_its_dataset():
    data = explore.Dataset(pictures(3), SHOT, VARY)

    assert repr(explore.torch_dataset(data)) == f"TorchDataset({data!r})"
    assert repr(explore.torch_dataset(data, len)) == f"TorchDataset({data!r}, len)"


def test_deep_codes_become_signed_tensors():
    import torch

    data = explore.Dataset(pictures(1), SHOT, changes={"sensor.bits": 12})
    transformed = explore.torch_dataset(data, partial(operator.itemgetter("code")))

    assert explore.torch_dataset(data)[0]["code"].dtype == torch.int32
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(transformed))[0].numpy(), data[0]["code"])
