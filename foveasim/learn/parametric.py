"""Generated layouts as differentiable functions of the parameters of their generators."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from foveasim._core.names import possible_names
from foveasim._core.rings import next_vertex, positions_in_runs
from foveasim._core.validation import Floats, Ints, unit_of
from foveasim.errors import FoveasimError, ParameterError, type_name
from foveasim.layout import Layout
from foveasim.layout._noding import merge_coincident_points
from foveasim.layout.generator_registry import LAYOUTS
from foveasim.learn._tensors import constant
from foveasim.learn.outlines import Outlines

__all__ = ["generated"]

#: Steps of the central difference, relative to the parameter; the second one where the topology changes within the first. For a
#: power k of the parameter, the truncation error (k step)⁴ / 30 is below 5e-9 for k up to 100; rounding is 1e-16 / step.
STEPS = (2e-4, 1e-5)
#: Positions of the stencil in steps, and coefficients of the first derivative.
STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -8.0 / 12.0), (1.0, 8.0 / 12.0), (2.0, -1.0 / 12.0))
#: Largest change of a derivative within the stencil, relative to it plus the ratio of the layout to the parameter; a larger
#: one indicates a kink or a jump.
MAX_CHANGE = 0.1
#: Displacement of vertices, relative to the shortest edge of their ring, below which rings begin at the same vertex.
ALIGNED = 0.25
#: Distance of vertices that are one point, relative to the layout.
ROUNDING = 1e-9


def generated(generator: str | Callable[..., Layout], parameters: Mapping[str, Any]) -> tuple[Tensor, Outlines]:
    """
    Generate a layout whose vertices are differentiable functions of its parameters.

    Parameters
    ----------
    generator : str or callable
        Name of a layout generator, such as ``"log_polar"``, or a function that returns a Layout.
    parameters : mapping of str to number, tensor or other value
        Arguments of the generator. Tensors have no axis or one axis; those that require gradients are float64, and the others
        may be of any type.

    Returns
    -------
    points : (n_point, 2) tensor, µm
        Corners, with first derivatives by the parameters that require gradients.
    outlines : Outlines
        Topology; ``outlines.layout(points)`` is the layout. Corners of neighbours at the same position are one point as long as
        they move equally.

    Raises
    ------
    ParameterError
        When a name is not one of the generator, an integer requires gradients, or the layout does not depend smoothly on a
        parameter: when numbers of sites or vertices change within 0.002 % of its value, or the generator rejects these values.

    Notes
    -----
    The derivatives of the vertices are central differences with five points, at the cost of four layouts per number. Relative
    errors are about 1e-11 for lengths, and 1e-9 where the topology changes within 0.04 % of a value. Discontinuous changes,
    such as pieces merged into neighbours, have no derivative: the gradient is that of the present topology. If several numbers
    only change together, such as the sides and pitches of square zones, use a function of fewer parameters (see the example).

    Examples
    --------
    >>> import foveasim as fs
    >>> pitch_um = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    >>> points, outlines = generated("grid", {"n_x": 3, "n_y": 2, "pitch_um": pitch_um})
    >>> outlines.area_um2(points).sum().backward()
    >>> round(pitch_um.grad.item(), 9)  # 6 squares, 2 pitch each
    24.0

    Zones whose sides are fixed multiples of the pitch:

    >>> points, outlines = generated(
    ...     lambda pitch_um: fs.layout.zones(
    ...         side_um=(4 * pitch_um, 8 * pitch_um), pitch_um=(pitch_um, 2 * pitch_um)
    ...     ),
    ...     {"pitch_um": pitch_um},
    ... )
    >>> outlines
    Outlines(28 sites, 41 points)
    """
    name, function = _find_generator(generator)
    signature = inspect.signature(function).parameters
    variables = {}
    plain: dict[str, Any] = {}
    for key, value in parameters.items():
        _check_name(key, name, signature)
        if isinstance(value, Tensor):
            if value.requires_grad:
                variables[key] = _check_variable(key, value, name, signature)
            plain[key] = _as_plain(key, value)
        else:
            plain[key] = value
    layout = _generate(function, plain)
    inputs = list(variables.values())
    stencils = []
    if torch.is_grad_enabled():
        stencils = [
            _differentiate(function, _Number(plain, key, index), layout)
            for key, value in variables.items()
            for index in (range(value.numel()) if value.ndim else (None,))
        ]
    vertex = _common_points(layout, stencils)
    outlines = Outlines(vertex, layout.ring_offsets, layout.site_offsets, layout.columns, layout.provenance)
    _, first = np.unique(vertex, return_index=True)
    jacobian = np.array([stencil.gradient[first] for stencil in stencils]).reshape(len(stencils), first.size, 2)
    points = _Vertices.apply(constant(layout.xy_um[first]), torch.from_numpy(jacobian), *inputs)  # type: ignore[no-untyped-call]
    return points, outlines


class _Vertices(torch.autograd.Function):
    """Vertices with a given Jacobian by parameters."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, jacobian: Tensor, *inputs: Tensor) -> Tensor:
        ctx.save_for_backward(jacobian)
        ctx.shapes = [value.shape for value in inputs]
        return points.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator, unused-ignore]
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (jacobian,) = ctx.saved_tensors
        found = (jacobian * gradients[0].to(jacobian.dtype)).sum(dim=(1, 2))
        sizes = [shape.numel() for shape in ctx.shapes]
        parts = [part.reshape(shape) for part, shape in zip(torch.split(found, sizes), ctx.shapes, strict=True)]
        return None, None, *parts


def _find_generator(generator: str | Callable[..., Layout]) -> tuple[str, Callable[..., Layout]]:
    """Return the name and the function of a generator."""
    if isinstance(generator, str):
        return generator, LAYOUTS.find("generator", generator)
    return getattr(generator, "__name__", "the function"), generator


def _check_name(key: object, name: str, signature: Mapping[str, inspect.Parameter]) -> None:
    if any(each.kind is each.VAR_KEYWORD for each in signature.values()):
        return
    if key not in signature:
        hint = possible_names(key, list(signature))
        raise ParameterError("parameters", f"must have names of parameters of '{name}' as keys", key, hint=hint)


def _check_variable(key: str, value: Tensor, name: str, signature: Mapping[str, inspect.Parameter]) -> Tensor:
    """Check that a tensor that requires gradients is one of real numbers on the CPU."""
    annotation = signature[key].annotation if key in signature else inspect.Parameter.empty
    kind = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))
    is_known = annotation is not inspect.Parameter.empty
    if is_known and not re.search(r"\b(float|Any|ArrayLike|Floats)\b", kind):
        rule = "must be an integer" if re.search(r"\bint\b", kind) else f"must be of the type {kind}"
        raise ParameterError(
            key, f"{rule} of '{name}', without derivatives, got a tensor that requires gradients", hint="use .item()"
        )
    if value.dtype != torch.float64 or value.device.type != "cpu" or value.ndim > 1:
        shape = tuple(value.shape)
        raise ParameterError(
            key,
            f"must be a float64 tensor on the CPU with at most one axis, got {value.dtype}, {shape}",
            hint="use .double()",
        )
    return value


def _as_plain(key: str, value: Tensor) -> Any:
    """Return a tensor as a number or a list."""
    if value.ndim > 1:
        raise ParameterError(key, f"must be a tensor with at most one axis, got the shape {tuple(value.shape)}")
    return value.detach().cpu().tolist()


def _generate(function: Callable[..., Layout], parameters: Mapping[str, Any]) -> Layout:
    layout = function(**parameters)
    if not isinstance(layout, Layout):
        raise ParameterError("generator", f"must return a Layout, got {type_name(layout)}")
    if not layout.n_sites:
        raise ParameterError("generator", "must return a layout with at least one site")
    return layout


@dataclass(frozen=True)
class _Number:
    """One number of the parameters of a generator: a parameter, or an element of one."""

    parameters: Mapping[str, Any]
    key: str
    index: int | None

    @property
    def name(self) -> str:
        """Name for messages."""
        return self.key if self.index is None else f"{self.key}[{self.index}]"

    @property
    def value(self) -> float:
        """Present value."""
        given = self.parameters[self.key]
        return float(given if self.index is None else given[self.index])

    @property
    def scale(self) -> float:
        """Magnitude of the value, or of the other elements if it is zero, or 1."""
        return abs(self.value) or float(np.abs(self.parameters[self.key]).max(initial=0.0)) or 1.0

    def at(self, value: float) -> dict[str, Any]:
        """Return the parameters with another value of the number."""
        given, k = self.parameters[self.key], self.index
        return {**self.parameters, self.key: value if k is None else [*given[:k], value, *given[k + 1 :]]}

    def error(self, rule: str, hint: str) -> ParameterError:
        """Return an error about the value."""
        return ParameterError(self.name, f"{rule}, for derivatives", self.value, unit_of(self.key), hint)


class _Stencil(NamedTuple):
    """Vertices (n_vertex, 2) at the positions of the stencil, and their derivatives."""

    points: Sequence[Floats]
    gradient: Floats


def _differentiate(function: Callable[..., Layout], number: _Number, layout: Layout) -> _Stencil:
    """Return the derivatives of the vertices of a layout by a number."""
    try:
        return _apply_stencil(function, number, layout, STEPS[0])
    except ParameterError:
        return _apply_stencil(function, number, layout, STEPS[1])


def _apply_stencil(function: Callable[..., Layout], number: _Number, layout: Layout, step_fraction: float) -> _Stencil:
    """Return the derivatives of the vertices with a step relative to the scale of the number."""
    step = step_fraction * number.scale
    found = []
    for position, _ in STENCIL:
        value = number.value + position * step
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # those of the layout itself were given
                other = _generate(function, number.at(value))
        except FoveasimError as error:
            raise number.error(
                f"must have valid values around it (at {value:.9g}: {error})",
                "vary several parameters together with a function as generator",
            ) from error
        difference = _difference_of_topology(layout, other)
        if difference:
            raise number.error(
                f"must not change the topology (at {number.value:.9g} and {value:.9g} there are {difference})",
                "take another value, or other parameters such as a fixed number of rings",
            )
        found.append(_align_rings(other.xy_um, layout))
    derivatives = sum(factor * xy_um for (_, factor), xy_um in zip(STENCIL, found, strict=True)) / step
    if not _is_smooth(layout.xy_um, found, step, number.scale):
        raise number.error(
            "must have values around it at which the vertices move smoothly",
            "the layout changes abruptly here; take another value",
        )
    return _Stencil(found, np.asarray(derivatives))


def _difference_of_topology(layout: Layout, other: Layout) -> str:
    """Return the difference of two topologies for a message, or an empty string."""
    if layout.n_sites != other.n_sites:
        return f"{layout.n_sites} and {other.n_sites} sites"
    if layout.xy_um.shape != other.xy_um.shape:
        return f"{layout.xy_um.shape[0]} and {other.xy_um.shape[0]} vertices"
    names = ("ring_offsets", "site_offsets")
    is_equal = all(np.array_equal(getattr(layout, name), getattr(other, name)) for name in names)
    return "" if is_equal else "other sites with the same number of vertices"


def _align_rings(xy_um: Floats, layout: Layout) -> Floats:
    """Return the vertices with rings rotated to begin at the same vertex as in a layout."""
    offsets = layout.ring_offsets
    size = np.diff(offsets)
    start, length = np.repeat(offsets[:-1], size), np.repeat(size, size)
    position = positions_in_runs(size)
    edge = layout.xy_um[next_vertex(offsets)] - layout.xy_um
    shortest = np.minimum.reduceat(np.hypot(edge[:, 0], edge[:, 1]), offsets[:-1])
    best, shift = np.full(size.size, np.inf), np.zeros(size.size, np.int64)
    for k in range(int(size.max())):
        distance = np.abs(xy_um[start + (position + k) % length] - layout.xy_um).max(axis=1)
        furthest = np.maximum.reduceat(distance, offsets[:-1])
        shift[furthest < best] = k
        best = np.minimum(best, furthest)
        if (best < ALIGNED * shortest).all():
            break
    return np.asarray(xy_um[start + (position + np.repeat(shift, size)) % length])


def _is_smooth(xy: Floats, around: Sequence[Any], step: Any, scale: float) -> bool:
    """Return whether vertices depend smoothly on a number: no kinks, jumps or permutations."""
    before2, before, after, after2 = around
    slope = (after - before) / (2.0 * step)
    wide = np.abs((after2 - before2) / (4.0 * step) - slope).max()
    kink = np.abs(after - 2.0 * xy + before).max() / step
    return bool(max(wide, kink) <= MAX_CHANGE * (np.abs(slope).max() + np.abs(xy).max() / scale))


def _common_points(layout: Layout, stencils: Sequence[_Stencil]) -> Ints:
    """Return the point of each vertex; vertices at the same position are one if they stay so."""
    xy_um = layout.xy_um
    _, group = merge_coincident_points(xy_um)
    _, first = np.unique(group, return_index=True)
    tolerance_um = ROUNDING * float(np.ptp(xy_um, axis=0).max())
    is_apart = np.zeros(group.size, bool)
    for stencil in stencils:
        for each in stencil.points:
            is_apart |= np.abs(each - each[first[group]]).max(axis=1) > tolerance_um
    # Vertices that leave their group are points of their own.
    group = np.where(is_apart, group.max() + 1 + np.arange(group.size), group)
    return np.asarray(np.unique(group, return_inverse=True)[1].ravel(), dtype=np.int64)
