"""
Layer maps of GDSII and OASIS files.

A layer map is a mapping from names to layers:

==================  ================================================================================================
name                shapes
==================  ================================================================================================
``photosite``       outlines of all sites
``filter_R``        outlines of the sites with this filter; ``filter_0`` for the channel 0
a derived layer     polygons computed from the outlines, see :data:`foveasim.layout.DERIVED_LAYERS`
==================  ================================================================================================

A layer is a pair ``(layer, datatype)``, a string ``"77/3"``, an integer (datatype 0), or a mapping of ``layer`` and of the
parameters of a derived layer: ``{"layer": (20, 0), "inset_um": 0.2}``.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from foveasim._core.names import possible_names
from foveasim._core.validation import check_count
from foveasim.errors import ConfigError, ParameterError
from foveasim.layout.files._derived import DERIVED_LAYERS, LayoutLayer

#: Layer and datatype; None for any datatype.
LayerNumber: TypeAlias = tuple[int, int | None]

#: Maximum layer and datatype: some programs read them as signed 16-bit integers.
MAX_LAYER = 32767
#: Maximum layer and datatype that are read.
MAX_READ_LAYER = 2**31 - 1
PHOTOSITE = "photosite"
FILTER = "filter_"
#: Names of the channels in the order of ``mosaic`` and of the RGB filters of a sensor.
FILTER_NAMES = ("R", "G", "B", "W")
#: Options of reading that the command line takes by their names, and the types of their values.
FURTHER: dict[str, type[str | float]] = {
    "invalid": str,
    "unit": str,
    "parts": str,
    "duplicates": str,
    "missing": str,
    "circle_tolerance": float,
}
EXAMPLE = "such as (77, 3) or '77/3'"
_NUMBERS = re.compile(r"([0-9]{1,9})(?:/([0-9]{1,9}))?")


# -- layer maps -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnLayer:
    """
    A layer of a file, and its shapes.

    A datatype of None stands for the channel of each site. ``channel``: that of the sites of a filter layer. ``parameters``:
    keywords of the function of a derived layer.
    """

    name: str
    layer: int
    datatype: int | None
    channel: int | None = None
    parameters: dict[str, Any] = field(default_factory=dict)

    @property
    def number(self) -> LayerNumber:
        """Layer and datatype."""
        return self.layer, self.datatype

    @property
    def is_derived(self) -> bool:
        """Whether the shapes are derived from the outlines."""
        return self.name != PHOTOSITE and self.channel is None

    @property
    def is_of_layout(self) -> bool:
        """Whether the shapes are those of the complete layout, not of each site."""
        return self.is_derived and isinstance(DERIVED_LAYERS[self.name], LayoutLayer)


def layer_options(words: Sequence[str], map_file: Path | None = None) -> dict[str, Any]:
    """
    Return options of writers and readers from the words of a command line.

    Parameters
    ----------
    words : sequence of str
        Layers of the photosites, ``77/3``, or entries of a layer map, ``filter_R=10/0``.
    map_file : path, optional
        YAML file of a layer map; words replace its entries.

    Raises
    ------
    ConfigError
        When the file is invalid.
    ParameterError
        When a layer without a name is given with a layer map.
    """
    entries = {name: value for name, equals, value in (word.partition("=") for word in words) if equals}
    numbers = [word for word in words if "=" not in word]
    if map_file is None and not entries:
        return {"layer": numbers[0] if len(numbers) == 1 else numbers} if numbers else {}
    if numbers:
        raise ParameterError("layer", "must have a name in a layer map", numbers[0], hint=f"photosite={numbers[0]}")
    return {"layers": {**(read_layer_map(map_file) if map_file is not None else {}), **entries}}


def reading_options(
    *,
    layer: Sequence[str] = (),
    channels: Sequence[str] = (),
    cell: str | None = None,
    centre: bool = False,
    further: Sequence[str] = (),
) -> dict[str, Any]:
    """
    Return options of :func:`foveasim.read_layout` from the words of a command line.

    Parameters
    ----------
    layer : sequence of str
        As ``words`` of :func:`layer_options`.
    channels : sequence of str
        Filter layers with the name or number of their channel, ``10/0=R``; several are separated by commas.
    cell : str, optional
    centre : bool
    further : sequence of str
        Other options with their values, ``invalid=skip``: the names in :data:`FURTHER`.

    Returns
    -------
    options : dict
        Only those that were given.

    Raises
    ------
    ParameterError
        When a filter layer has no channel, or a further option is unknown or has no valid value.
    """
    options = layer_options(layer)
    found: dict[str, int | str] = {}
    for word in ",".join(channels).split(",") if channels else ():
        number, _, name = (part.strip() for part in word.partition("="))
        if not number or not name:
            raise ParameterError("channels", "must be layers with their channel, such as 10/0=R", word)
        found[number] = int(name) if name.isdecimal() else name
    given = {"channels": found or None, "cell": cell, "centre": centre or None}
    return options | {name: value for name, value in given.items() if value is not None} | _further_options(further)


def _further_options(words: Sequence[str]) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for word in words:
        name, _, text = (part.strip() for part in word.partition("="))
        if name not in FURTHER:
            raise ParameterError("reading", "must be options of layout files", name, hint=possible_names(name, FURTHER))
        try:
            options[name] = FURTHER[name](text)
        except ValueError:
            raise ParameterError(name, "must be a number", text) from None
    return options


def read_layer_map(path: str | Path) -> dict[str, Any]:
    r"""
    Read a layer map from a YAML file.

    Parameters
    ----------
    path : path
        Lines such as ``photosite: 77/3`` and ``well: {layer: 20/0, inset_um: 0.2}``.

    Returns
    -------
    layers : dict
        Value of ``layers=`` of :func:`write_layout` and :func:`read_layout`.

    Raises
    ------
    ConfigError
        When the file is missing, or not a mapping in YAML.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "layers.yaml")
    ...     _ = path.write_text("photosite: 77/3\nwell: {layer: 20/0, inset_um: 0.2}\n")
    ...     print(fs.layout.read_layer_map(path))
    {'photosite': '77/3', 'well': {'layer': '20/0', 'inset_um': 0.2}}
    """
    from foveasim._io.yaml_files import read_yaml

    layers: dict[str, Any] = read_yaml(Path(path))
    return layers


def parse_layer_map(
    layers: Mapping[str, Any] | str | Path, filter_names: Sequence[str] | None = None
) -> list[DrawnLayer]:
    """
    Return the layers of a layer map, or of its YAML file.

    ``filter_names``: names of the channels 0, 1, ... Raises ConfigError when the file is missing or invalid. Raises
    ParameterError when a name is unknown, a layer is invalid, or two names have the same layer.
    """
    if isinstance(layers, str | Path):
        path = Path(layers)
        try:
            return parse_layer_map(read_layer_map(path), filter_names)
        except ParameterError as error:
            raise ConfigError(path, str(error)) from None
    if not isinstance(layers, Mapping) or not layers:
        raise ParameterError("layers", f"must be a mapping of names to layers, {EXAMPLE}, or a YAML file", layers)
    names = check_filter_names(filter_names)
    drawn = [_drawn_layer(name, value, names) for name, value in layers.items()]
    owner: dict[LayerNumber, str] = {}
    for layer in drawn:
        other = owner.setdefault(layer.number, layer.name)
        if other != layer.name:
            raise ParameterError(
                "layers", f"must be different layers, but '{other}' and '{layer.name}' are both {_text(layer.number)}"
            )
    channels = [layer.channel for layer in drawn if layer.channel is not None]
    if len(channels) != len(set(channels)):
        raise ParameterError("layers", "must have one layer per channel", list(layers))
    if PHOTOSITE not in layers:
        raise ParameterError("layers", "must contain the layer 'photosite'", list(layers))
    return drawn


def _drawn_layer(name: str, value: Any, filter_names: Sequence[str]) -> DrawnLayer:
    if not isinstance(name, str):
        raise ParameterError("layers", "must have strings as keys", name)
    key = f"layers[{name}]"
    channel = None
    parameters: dict[str, Any] = {}
    if name.startswith(FILTER):
        channel = parse_channel("layers", name.removeprefix(FILTER), filter_names)
    elif name != PHOTOSITE and name not in DERIVED_LAYERS:
        known = [PHOTOSITE, *(FILTER + n for n in filter_names), *DERIVED_LAYERS]
        raise ParameterError("layers", "must have names of layers as keys", name, hint=possible_names(name, known))
    if isinstance(value, Mapping):
        parameters = dict(value)
        value = parameters.pop("layer", None)
        allowed = [] if name not in DERIVED_LAYERS else list(inspect.signature(DERIVED_LAYERS[name]).parameters)[1:]
        for parameter in parameters:
            if parameter not in allowed:
                raise ParameterError(key, f"must have the keys {', '.join(['layer', *allowed])} only", parameter)
    layer, datatype = parse_layer(key, value, at_most=MAX_LAYER)
    return DrawnLayer(
        name=name, layer=layer, datatype=0 if datatype is None else datatype, channel=channel, parameters=parameters
    )


def parse_layer(name: str, value: Any, *, at_most: int = MAX_READ_LAYER) -> LayerNumber:
    """Return layer and datatype of ``77``, ``(77, 3)``, ``"77"`` or ``"77/3"``."""
    parts: Sequence[Any]
    if isinstance(value, str):
        match = _NUMBERS.fullmatch(value.strip())
        parts = () if match is None else [int(n) for n in match.groups() if n is not None]
    elif isinstance(value, Sequence):
        parts = value
    else:
        parts = (value,)
    is_integer = [isinstance(n, int | np.integer) and not isinstance(n, bool) for n in parts]
    if len(parts) not in (1, 2) or not all(is_integer):
        raise ParameterError(name, f"must be a layer, {EXAMPLE}", value)
    numbers = [check_count(name, n, at_least=0, at_most=at_most) for n in parts]
    return numbers[0], numbers[1] if len(numbers) == 2 else None


def parse_selection(value: Any) -> list[LayerNumber]:
    """Return the layers to read: one layer, or a list of layers."""
    is_pair = isinstance(value, tuple) and len(value) == 2 and all(isinstance(n, int) for n in value)
    if isinstance(value, str) or not isinstance(value, Sequence) or is_pair:
        return [parse_layer("layer", value)]
    if not value:
        raise ParameterError("layer", f"must be one or more layers, {EXAMPLE}", value)
    return [parse_layer("layer", item) for item in value]


def parse_channels(channels: Any, filter_names: Sequence[str] | None = None) -> dict[LayerNumber, int]:
    """
    Return the channel of each filter layer.

    ``channels``: from layers to names or numbers of channels: ``{(10, 0): "R", "11/0": 1}``. ``filter_names``: names of the
    channels 0, 1, ...
    """
    if not isinstance(channels, Mapping) or not channels:
        raise ParameterError("channels", "must be a mapping of layers to channels, such as {(10, 0): 'R'}", channels)
    names = check_filter_names(filter_names)
    return {parse_layer("channels", key): parse_channel("channels", value, names) for key, value in channels.items()}


def parse_channel(name: str, value: Any, filter_names: Sequence[str]) -> int:
    """Return a channel from its number, or from its name."""
    if isinstance(value, str):
        if value in filter_names:
            return list(filter_names).index(value)
        if not (value.isascii() and value.isdecimal() and len(value) <= len(str(MAX_LAYER))):
            raise ParameterError(
                name,
                "must have channels as numbers, or as names of filter_names",
                value,
                hint=f"the names are {', '.join(filter_names)}; others with filter_names=(...)",
            )
        value = int(value)
    return check_count(name, value, at_least=0, at_most=MAX_LAYER)


def are_colours(channels: Any, layers: Sequence[DrawnLayer], filter_names: Sequence[str] | None) -> bool:
    """Whether filter layers are selected by the default letters of colours."""
    named = [
        *(channels or {}).values(),
        *(layer.name.removeprefix(FILTER) for layer in layers if layer.channel is not None),
    ]
    return filter_names is None and any(name in FILTER_NAMES for name in named)


def check_filter_names(filter_names: Sequence[str] | None) -> Sequence[str]:
    """Return the names of the channels, by default R, G, B, W."""
    if filter_names is None:
        return FILTER_NAMES
    names = list(filter_names) if isinstance(filter_names, Sequence) else []
    if not names or not all(isinstance(n, str) and n for n in names) or len(set(names)) != len(names):
        raise ParameterError("filter_names", "must be different strings, one per channel", filter_names)
    return names


def _text(number: LayerNumber) -> str:
    return "/".join(str(n) for n in number if n is not None)
