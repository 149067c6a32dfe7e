"""PyTorch adapter for datasets; torch is imported on first use."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import numpy as np

from foveasim._core.extras import import_optional

__all__ = ["torch_dataset"]


class Samples(Protocol):
    """Sequence of samples: mappings of arrays and numbers."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Any: ...


def torch_dataset(dataset: Samples, transform: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """
    Create a map-style ``torch.utils.data.Dataset`` with tensors instead of arrays.

    Parameters
    ----------
    dataset : Dataset or StoredSamples
        ``DataLoader`` also accepts these directly; this adapter is for programs that require the class of torch.
    transform : callable, optional
        Function that is applied to each sample. It must be picklable for worker processes.

    Returns
    -------
    torch.utils.data.Dataset
        Codes of more than 8 bits are int32: torch has few operations for uint16.

    Raises
    ------
    ParameterError
        When torch is not installed.

    Examples
    --------
    ::

        loader = torch.utils.data.DataLoader(
            torch_dataset(dataset), batch_size=32, shuffle=True, num_workers=4
        )
    """
    return _dataset_class()(dataset, transform)


@cache
def _dataset_class() -> Any:
    """Return the dataset class, which is defined on first use."""
    torch = import_optional("torch_dataset", "torch")

    def tensor(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        return torch.from_numpy(value.astype(np.int32) if value.dtype == np.uint16 else value)

    class TorchDataset(import_optional("torch_dataset", "torch.utils.data").Dataset):  # type: ignore[misc]
        """Dataset with tensors instead of the arrays of another dataset."""

        def __init__(self, dataset: Samples, transform: Callable[[dict[str, Any]], Any] | None) -> None:
            self.dataset, self.transform = dataset, transform

        def __repr__(self) -> str:
            applied = "" if self.transform is None else f", {getattr(self.transform, '__name__', self.transform)}"
            return f"TorchDataset({self.dataset!r}{applied})"

        def __reduce__(self) -> tuple[Any, ...]:
            # Pickle cannot import a class that is defined in a function.
            return torch_dataset, (self.dataset, self.transform)

        def __len__(self) -> int:
            return len(self.dataset)

        def __getitem__(self, index: int) -> Any:
            sample = {name: tensor(value) for name, value in self.dataset[index].items()}
            return sample if self.transform is None else self.transform(sample)

    return TorchDataset
