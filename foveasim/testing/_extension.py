"""A registered object with its example, and the requirements of checks."""

from __future__ import annotations

import functools
import inspect
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

from foveasim._core.provenance import to_plain_data
from foveasim._core.registry import Registry
from foveasim._core.threads import cached_property
from foveasim.config import Shot, build_shot
from foveasim.layout import Layout, grid

#: Settings of a shot of 4 x 4 squares, to which the section of an extension is added.
SETTINGS: dict[str, Any] = {
    "scene": {
        "kind": "flat", "radiance_w_m2_sr_nm": 0.02, "shape": [32, 32], "pitch_um": 500.0, "distance_m": 1.0,
        "wavelength_nm": [550.0], "band_width_nm": 50.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "grid", "parameters": {"n_x": 4, "n_y": 4, "pitch_um": 10.0}},
    "sensor": {},
    "exposure_s": 0.01,
}  # fmt: skip


def require(condition: object, message: str) -> None:
    """Raise an AssertionError unless a condition holds."""
    if not condition:
        raise AssertionError(message)


@dataclass(frozen=True)
class Extension:
    """A registered object, its example, and an empty directory."""

    kind: str
    name: str
    item: Any
    example: Any
    expected: Any
    directory: Path

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the example; its files are written."""
        found = self.example(self.directory) if callable(self.example) else self.example
        require(isinstance(found, Mapping), f"must have a mapping of parameters as example, got {found!r:.40}")
        return dict(found)

    @property
    def settings(self) -> dict[str, Any]:
        """Section of settings files with the example."""
        return {"kind": self.name, **to_plain_data(self.parameters)}

    def make(self, *arguments: Any, **changed: Any) -> Any:
        """Return the result of a call with the parameters of the example."""
        parameters = self.parameters | changed
        try:
            inspect.signature(self.item).bind(*arguments, **parameters)
        except TypeError as error:
            raise AssertionError(f"cannot be called with its example ({error}); register it with example=") from None
        return self.item(*arguments, **parameters)

    def check_dataclass(self, made: Any) -> None:
        """Check that an object is frozen, hashable, and the same after pickling."""
        require(
            is_dataclass(made) and getattr(type(made), "__dataclass_params__").frozen,  # noqa: B009 -- not typed
            "must be a frozen dataclass: results are cached by their parameters",
        )
        hash(made)
        again = pickle.loads(pickle.dumps(made))  # noqa: S301 -- the data were created here
        require(to_plain_data(again) == to_plain_data(made), "must have the same parameters after pickling")

    def shot(self, section: str) -> Shot:
        """Return the shot with the example as a section of its settings."""
        return shot_with(section, self.settings)


def shot_with(section: str, values: Mapping[str, Any]) -> Shot:
    """Return the shot of the standard settings with changes of one section."""
    kept = {} if "kind" in values else SETTINGS.get(section, {})
    return build_shot(None, {**SETTINGS, section: {**kept, **values}})


def square_grid() -> Layout:
    """Return the layout of examples: 4 x 4 squares of 10 µm around the optical axis."""
    return grid(n_x=4, n_y=4, pitch_um=10.0)


@dataclass(frozen=True)
class Check:
    """Check of the objects of a registry."""

    registry: Registry[Any]
    function: Callable[[Extension], None]

    def __call__(self, extension: Extension) -> None:
        """Raise an AssertionError if the object does not have a property of its kind."""
        self.function(extension)


def check_of(registry: Registry[Any]) -> Callable[[Callable[[Extension], None]], Check]:
    """Return a decorator of the check of a registry's objects."""
    return functools.partial(Check, registry)
