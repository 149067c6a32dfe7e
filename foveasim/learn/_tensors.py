"""Checks of tensors, and their conversion to arrays."""

from __future__ import annotations

import math
import os
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, partial
from threading import Barrier, Lock
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual
from torch.utils._python_dispatch import _get_current_dispatch_mode

from foveasim._core.threads import thread_count
from foveasim.errors import ParameterError, type_name

#: Number of times that a step is halved before it is cancelled.
MAX_HALVINGS = 8
#: Size in bytes of a block that is allocated and released once: just below the largest one to which the allocator adapts.
LARGEST_BLOCK = 2**25 - 2**16

# The allocator of Linux returns free memory above twice the largest released block to the system, and later blocks cost page
# faults: 40 % of the time of a batch. After this release it keeps more. The block is never written, so that it needs no memory.
torch.empty(LARGEST_BLOCK, dtype=torch.uint8)


def check_tensor(
    name: str, value: object, shape: Sequence[int | None], description: str = "", *, any_device: bool = False
) -> Tensor:
    """
    Check that a value is a floating-point tensor of a shape, and return it.

    It must be on the CPU unless any device is allowed.

    ``None`` in the shape stands for any size; a leading ``...`` in the description for further axes, which
    the caller flattens.
    """
    if not isinstance(value, Tensor):
        raise ParameterError(name, f"must be a torch.Tensor, got {type_name(value)}", hint="use torch.as_tensor")
    if not value.is_floating_point():
        raise ParameterError(
            name, f"must be a tensor of floating-point numbers, got {value.dtype}", hint="use .double() or .float()"
        )
    if not any_device and value.device.type != "cpu":
        raise ParameterError(
            name, f"must be on the CPU, got a tensor on {value.device}", hint="use .cpu(); gradients follow it back"
        )
    sizes = tuple(value.shape)
    if len(sizes) != len(shape) or any(n is not None and n != m for n, m in zip(shape, sizes, strict=True)):
        expected = ", ".join("n" if n is None else str(n) for n in shape)
        raise ParameterError(name, f"must have the shape ({expected}){description}, got {sizes}")
    return value


def checked_gazes(gaze_um: object, scenes: Sequence[int]) -> Tensor:
    """
    Check gazes (..., 2), or paths of gazes (..., n_gaze, 2), of scenes (...).

    Returns them as (n_scene, n_gaze, 2).
    """
    is_path = isinstance(gaze_um, Tensor) and gaze_um.ndim == len(scenes) + 2
    expected = (*scenes, None, 2) if is_path else (*scenes, 2)
    found = check_tensor("gaze_um", gaze_um, expected, ", one row (x, y) per picture, or a path", any_device=True)
    return found.reshape(math.prod(scenes), found.shape[-2] if is_path else 1, 2)


def as_array(tensor: Tensor) -> NDArray[Any]:
    """Return the numbers of a tensor as a C-contiguous array, without a copy where possible."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


class Constants:
    """
    Constant arrays as tensors, on the devices and with the dtypes of other tensors.

    Modules keep them in double precision, and not among their buffers.
    """

    def __init__(self, **values: Any) -> None:
        self._values = {name: np.asarray(value) for name, value in values.items()}
        self._tensors: dict[tuple[str, torch.device, torch.dtype], Tensor] = {}

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_tensors": {}}

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def add(self, **values: Any) -> None:
        """Add arrays."""
        self._values.update((name, np.asarray(value)) for name, value in values.items())

    def get(self, name: str, like: Tensor, compute: Callable[[], Any] | None = None) -> Tensor:
        """
        Return an array as a tensor on the device of ``like``.

        ``compute`` returns the array if it is not yet known. Floating-point and complex numbers have the precision of ``like``,
        integers their own.
        """
        key = name, like.device, like.dtype
        found = self._tensors.get(key)
        if found is None:
            if name not in self._values:
                assert compute is not None
                self.add(**{name: compute()})
            values = self._values[name]
            precision = like.dtype.to_complex() if values.dtype.kind == "c" else like.dtype.to_real()
            with torch.inference_mode(mode=False):
                found = torch.from_numpy(np.array(values))
                # First the precision: some devices have no float64.
                found = (found.to(precision) if values.dtype.kind in "fc" else found).to(like.device)
            if type(found) is Tensor:  # tensors of a tracer are not kept
                self._tensors[key] = found
        return found


class SparseMap:
    """
    Multiplication of rows (..., n) by a sparse matrix (m, n).

    Differentiable any number of times: the derivative is the product with the transposed matrix.
    """

    def __init__(self, matrix: Any) -> None:
        self._matrix = matrix.tocsr()
        self._matrix.sum_duplicates()
        self.shape = self._matrix.shape
        self._constants = Constants()
        self._tensors: dict[Any, Tensor] = {}

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_tensors": {}, "_constants": Constants()}

    @property
    def entries(self) -> Any:
        """Elements of the matrix, in COO format with int64 indices."""
        found = self._matrix.tocoo()
        found.coords = tuple(np.asarray(each, np.int64) for each in found.coords)
        return found

    def tensor(self, like: Tensor, *, is_transposed: bool = False) -> Tensor:
        """Return the matrix, or the transposed one, as a CSR tensor on the device of ``like``."""
        key = is_transposed, like.device, like.dtype
        found = self._tensors.get(key)
        if found is None:
            part = self._matrix.T.tocsr() if is_transposed else self._matrix
            dtype = np.int32 if part.nnz < 2**31 else np.int64
            index = [torch.from_numpy(np.array(each, dtype)) for each in (part.indptr, part.indices)]
            data = torch.from_numpy(np.array(part.data)).to(like.dtype)
            with torch.inference_mode(mode=False), warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
                found = torch.sparse_csr_tensor(*index, data, part.shape, device=like.device, check_invariants=False)
            self._tensors[key] = found
        return found

    def _arrays(self, like: Tensor) -> tuple[NDArray[Any], ...]:
        """Return the begin of each row, the columns and the elements of the matrix."""
        get, matrix = partial(self._constants.get, like=like), self._matrix
        begin = get("begin", compute=lambda: matrix.indptr.astype(np.int32))
        column = get("columns", compute=lambda: matrix.indices.astype(np.int32))
        return (
            begin.numpy(),
            column.numpy(),
            get("elements", compute=lambda: np.asarray(matrix.data, np.float64)).numpy(),
        )

    def apply(self, values: Tensor) -> Tensor:
        """Return the products (..., m) of rows (..., n)."""
        rows = values.reshape(-1, self.shape[1])
        if is_array(rows) and self._matrix.nnz < 2**31:
            from foveasim.integrate._kernels import multiply_rows

            found = rows.new_empty(rows.shape[0], self.shape[0])
            multiply_rows(*self._arrays(rows), rows.contiguous().numpy(), found.numpy())
        elif torch.compiler.is_compiling():  # only operations that other runtimes also have
            get = partial(self._constants.get, like=rows)
            data = get("data", compute=lambda: self.entries.data)
            products = rows.index_select(1, get("column", compute=lambda: self.entries.col)) * data
            sums = rows.new_zeros(rows.shape[0], self.shape[0])
            found = sums.index_add(1, get("row", compute=lambda: self.entries.row), products)
        else:
            found = _Product.apply(rows, self, False)  # type: ignore[no-untyped-call]
        return found.reshape(*values.shape[:-1], self.shape[0])  # type: ignore[no-any-return]


class _Product(torch.autograd.Function):
    """Products of rows with a sparse matrix, or with the transposed one."""

    @staticmethod
    def forward(rows: Tensor, matrix: SparseMap, is_transposed: bool) -> Tensor:
        if rows.device.type == "meta":
            return rows.new_empty(rows.shape[0], matrix.shape[1 if is_transposed else 0])
        sparse = matrix.tensor(rows, is_transposed=is_transposed)
        if rows.device.type == "cpu" and rows.shape[0]:  # without copies of the rows
            return torch.stack([torch.mv(sparse, row) for row in rows])
        return torch.sparse.mm(sparse, rows.T).T

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        del output
        _, ctx.matrix, ctx.is_transposed = inputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        return _Product.apply(gradients[0], ctx.matrix, not ctx.is_transposed), None, None  # type: ignore[no-untyped-call]


def is_array(tensor: Tensor) -> bool:
    """
    Return whether kernels may read and write the memory of a tensor directly.

    The tensor must be in CPU memory, and no derivative, transform, tracer or mode may depend on seeing its operations.
    """
    if type(tensor) is not Tensor or tensor.device.type != "cpu" or tensor.dtype not in (torch.float32, torch.float64):
        return False
    is_tracked = (tensor.requires_grad and torch.is_grad_enabled()) or unpack_dual(tensor).tangent is not None
    is_traced = torch.compiler.is_compiling() or torch.jit.is_tracing() or _get_current_dispatch_mode() is not None
    if is_tracked or is_traced or tensor.is_neg():
        return False
    probe = tensor.new_empty(0)
    if torch._is_functional_tensor(probe):  # noqa: SLF001 -- no public function says so
        return False
    try:
        probe.numpy()
    except RuntimeError:  # within another transform of torch.func
        return False
    return True


class Parts(NamedTuple):
    """Parts of the rows of tensors, and how many may be computed at the same time."""

    slices: Sequence[slice] = (slice(None),)
    n_together: int = 1


def in_parts(
    compute: Callable[..., Tensor],
    parts: Parts,
    *tensors: Tensor | None,
    finish: Callable[[Tensor], Tensor] = lambda result: result,
) -> Tensor:
    """
    Return the results of a function for parts of the rows of tensors.

    Without derivatives, each core of the CPU computes different parts. This is faster than cores that share each operation,
    because they exchange data through a common cache or memory. Results are bit-identical for any number of threads.

    Parameters
    ----------
    compute : callable
        Function of a part of each tensor.
    parts : Parts
    *tensors : tensor or None
    finish : callable
        Function of the result of each part, called in the order of the parts, as random numbers require.
    """
    first_part, *others = parts.slices

    def result_of(part: slice) -> Tensor:
        return compute(*(None if each is None else each[part] for each in tensors))

    first = finish(result_of(first_part))  # alone, because it creates the constants that all parts share
    if not others:
        return first
    if first.requires_grad:
        return torch.cat([first, *(finish(result_of(part)) for part in others)])
    # Results that stay in memory between those of other parts would fragment it.
    rows = first.new_empty(others[-1].stop, *first.shape[1:])
    rows[first_part] = first
    del first
    n_threads, is_inference = _count_threads(parts) if is_array(rows) else 1, torch.is_inference_mode_enabled()
    if n_threads == 1:
        for part in others:
            rows[part] = finish(result_of(part))
        return rows
    results: dict[int, Tensor] = {}
    waiting, lock = deque(others), Lock()

    def compute_alone(part: slice) -> None:
        with torch.inference_mode(is_inference), torch.no_grad():
            result = result_of(part)
            with lock:
                results[part.start] = result
                while waiting and waiting[0].start in results:
                    ready = waiting.popleft()
                    rows[ready] = finish(results.pop(ready.start))

    tasks = [_pool(n_threads).submit(compute_alone, part) for part in others]
    try:
        for task in tasks:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        wait(tasks)
    return rows


def _count_threads(parts: Parts) -> int:
    """Return the number of threads that compute different parts; 1: all share each part."""
    if torch.is_autocast_enabled("cpu"):  # other threads do not inherit it
        return 1
    n_threads, n_parts = min(torch.get_num_threads(), thread_count()), len(parts.slices) - 1
    return min(n_threads, parts.n_together) if 2 * n_parts > n_threads else 1


@cache
def _pool(n_threads: int) -> ThreadPoolExecutor:
    """Return threads in which operations of torch use one thread each."""
    n_before, start = torch.get_num_threads(), Barrier(n_threads)

    def initialise() -> None:
        torch.get_num_threads()  # the first call in a thread sets the default, so that it must precede the next line
        torch.set_num_threads(1)

    pool = ThreadPoolExecutor(n_threads, "foveasim layers", initialise)
    wait([pool.submit(start.wait) for _ in range(n_threads)])
    # The last number that any thread sets is the default of those that start later.
    torch.set_num_threads(n_before)
    return pool


if hasattr(os, "register_at_fork"):  # a forked process does not inherit the threads of its parent
    os.register_at_fork(after_in_child=_pool.cache_clear)


def constant(values: Any) -> Tensor:
    """Return a float64 tensor with a copy of numbers."""
    return torch.from_numpy(np.array(values, np.float64))


def shorten_steps(start: Tensor, target: Tensor, find_invalid: Callable[[Tensor], Tensor | None]) -> Tensor:
    """
    Return the fraction of the step of each row that gives a valid state, (n, 1) or (n,).

    ``find_invalid`` sets a state, and returns a mask of the rows whose steps make it invalid, or None. Their steps are halved,
    and cancelled after 8 halvings. If the state is still invalid, the steps of all other rows are halved in the same way.
    """
    target = torch.where(torch.isfinite(target), target, start)
    fraction = torch.ones_like(target[..., :1] if target.ndim > 1 else target)
    while (is_blocked := find_invalid(start + fraction * (target - start))) is not None:
        if not bool((fraction[is_blocked] > 0.0).any()):
            is_blocked = torch.ones_like(is_blocked)
            if not bool((fraction > 0.0).any()):
                break
        halved = 0.5 * fraction
        fraction = torch.where(is_blocked, torch.where(halved < 0.5**MAX_HALVINGS, 0.0, halved), fraction)
    return fraction
