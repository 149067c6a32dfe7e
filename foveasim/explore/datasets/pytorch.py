"""Samples as tensors, for torch; torch is loaded when it is used."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import numpy as np

from foveasim._core.extras import needs
from foveasim.errors import ParameterError

__all__ = ["torch_data_set"]


class Samples(Protocol):
    """What has a length, and mappings of arrays and numbers as items."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Any: ...


def torch_data_set(data_set: Samples, transform: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """
    A map-style ``torch.utils.data.Dataset`` whose samples have tensors in the place of arrays.

    Parameters
    ----------
    data_set : DataSet or StoredSamples
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

        loader = torch.utils.data.DataLoader(torch_data_set(data_set), batch_size=32, shuffle=True, num_workers=4)
    """
    return _kind()(data_set, transform)


@cache
def _kind() -> Any:
    """The class, made when torch is there."""
    try:
        import torch  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        raise ParameterError("torch_data_set", needs("torch")) from None

    def tensor(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        return torch.from_numpy(value.astype(np.int32) if value.dtype == np.uint16 else value)

    class TorchDataSet(torch.utils.data.Dataset):  # type: ignore[misc,unused-ignore]
        """Samples of another data set with tensors in the place of arrays."""

        def __init__(self, data_set: Samples, transform: Callable[[dict[str, Any]], Any] | None) -> None:
            self.data_set, self.transform = data_set, transform

        def __reduce__(self) -> tuple[Any, ...]:
            # A class made in a function is not found by its name.
            return torch_data_set, (self.data_set, self.transform)

        def __len__(self) -> int:
            return len(self.data_set)

        def __getitem__(self, index: int) -> Any:
            sample = {name: tensor(value) for name, value in self.data_set[index].items()}
            return sample if self.transform is None else self.transform(sample)

    return TorchDataSet
