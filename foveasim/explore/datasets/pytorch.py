"""Samples as tensors, for torch; torch is loaded when it is used."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import numpy as np

from foveasim._core.extras import needs
from foveasim.errors import ParameterError

__all__ = ["torch_dataset"]


class Samples(Protocol):
    """What has a length, and mappings of arrays and numbers as items."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Any: ...


def torch_dataset(dataset: Samples, transform: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """
    A map-style ``torch.utils.data.Dataset`` whose samples have tensors instead of arrays.

    Parameters
    ----------
    dataset : Dataset or StoredSamples
        Those need no torch, and ``DataLoader`` takes them as they are; this is for programs that ask for torch's own class.
    transform : callable, optional
        What becomes of each sample; for workers it must be possible to pickle it.

    Returns
    -------
    torch.utils.data.Dataset
        Codes of more than 8 bits as int32: torch has few operations for uint16.

    Raises
    ------
    ParameterError
        When torch is missing.

    Examples
    --------
    ::

        loader = torch.utils.data.DataLoader(torch_dataset(dataset), batch_size=32, shuffle=True, num_workers=4)
    """
    return _kind()(dataset, transform)


@cache
def _kind() -> Any:
    """The class, made when torch is there."""
    try:
        import torch  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        raise ParameterError("torch_dataset", needs("torch")) from None

    def tensor(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        return torch.from_numpy(value.astype(np.int32) if value.dtype == np.uint16 else value)

    class TorchDataSet(torch.utils.data.Dataset):  # type: ignore[misc,unused-ignore]
        """Samples of another dataset with tensors instead of arrays."""

        def __init__(self, dataset: Samples, transform: Callable[[dict[str, Any]], Any] | None) -> None:
            self.dataset, self.transform = dataset, transform

        def __reduce__(self) -> tuple[Any, ...]:
            # A class made in a function is not found by its name.
            return torch_dataset, (self.dataset, self.transform)

        def __len__(self) -> int:
            return len(self.dataset)

        def __getitem__(self, index: int) -> Any:
            sample = {name: tensor(value) for name, value in self.dataset[index].items()}
            return sample if self.transform is None else self.transform(sample)

    return TorchDataSet
