"""Controls of the settings, generated from their JSON schema."""

from __future__ import annotations

import copy
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

from foveasim._core.validation import words_and_unit
from foveasim.config import bundled_layouts, get_setting, schema
from foveasim.config._electronics import values_of_twin
from foveasim.config._objects import FILE_SETTINGS
from foveasim.studio._settings.labels import words_of
from foveasim.studio._settings.templates import INITIAL, PER_AREA, has_mosaic, templates
from foveasim.studio._settings.unknowns import PARAMETERS, unknown_of, unknowns_of

__all__ = ["chosen_value", "controls_of", "structure_of"]

#: Ranges of sliders that annotations do not declare, by parameter: lowest and highest value; logarithmic if the lowest is
#: positive and far below the highest.
RANGES: dict[str, tuple[float, float]] = {
    "distance_m": (0.05, 100.0),
    "field_of_view_deg": (1.0, 120.0),
    "peak_radiance_w_m2_sr_nm": (1e-5, 1.0),
    "radiance_w_m2_sr_nm": (1e-5, 1.0),
    "rotation_deg": (-180.0, 180.0),
    "wavelength_nm": (350.0, 1000.0),
}
#: Ratio of the ends of a logarithmic slider.
LOG_RATIO = 50.0
#: Range of a slider around a value without a known range.
BELOW, ABOVE = 0.25, 4.0
#: Valid ranges up to this length are those of sliders: fractions, bits.
SHORT_RANGE = 20.0
#: Keys of ranges, also of unions.
BOUNDS = ("minimum", "exclusiveMinimum", "maximum", "usual")
#: Parameters with a list of valid numbers.
ENUMERATED = ("integration_order",)
#: Keys that select an alternative of a section.
TAGS = ("kind", "generator")
#: Sections that settings have on the page, also where a file may omit them.
REQUIRED = ("layout",)
#: Required parameters that are files without a bundled one, which the page asks for.
FROM_FILES = ("path", "file", "depth_m")
#: Optional parameters that new sections contain: framing and light of scenes.
GIVEN = {"fit", "peak_radiance_w_m2_sr_nm", "radiance_w_m2_sr_nm"}
#: Description of the choice of a generator's unknown.
SOLVE_HELP = "The parameter that follows from the others: the number of photosites, or one that gives the number."
#: Depth of nested sections.
MAX_DEPTH = 8
#: Largest number of sections of a list that have controls.
MAX_ITEMS = 100


def controls_of(settings: Mapping[str, Any], start: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """
    Return the controls of settings, in the order of their sections.

    Parameters
    ----------
    settings : mapping
        Determines the alternatives whose parameters have controls, such as the layout generator.
    start : mapping, optional
        Initial settings, from which the ranges of sliders follow; by default the same settings.

    Returns
    -------
    controls : list of dict
        Plain data: key, label, kind, unit, default, help, section, and according to the kind range and choices.
    """
    root = _schema()
    start = settings if start is None else start
    found: list[dict[str, Any]] = []
    sections = dict(root["properties"])
    sections["sensor"] = _with_values(_resolved(root, sections["sensor"]), values_of_twin(settings.get("sensor")))
    for name, node in sections.items():
        is_required = name in REQUIRED or name in root["required"]
        found += _controls(root, name, name, node, settings.get(name), start, is_required=is_required)
    found = _with_unknown(found, settings)
    n_of_key = Counter(control["key"] for control in found if "do" not in control)
    _distinguish(found)
    for control in found:
        if "do" in control:
            continue
        is_form = control["kind"] == "choice" and n_of_key[control["key"]] > 1
        control["id"] = f"{control['key']}:form" if is_form else control["key"]
    return found


def _with_values(node: dict[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of a section with other defaults."""
    properties = {name: {**below, "default": values[name]} if name in values else below
                  for name, below in node["properties"].items()}  # fmt: skip
    return {**node, "properties": properties}


def _distinguish(controls: list[dict[str, Any]]) -> None:
    """Add the section above to names that several controls have."""
    keys: dict[str, set[str]] = {}
    for control in controls:
        keys.setdefault(control["label"], set()).add(control["key"])
    labels = {control["key"]: control["label"] for control in controls if "do" not in control}
    for control in controls:
        if len(keys[control["label"]]) > 1 and "." in control["key"]:
            above = control["key"].rpartition(".")[0]
            control["context"] = labels.get(above, above.rpartition(".")[2].replace("_", " "))


def _with_unknown(controls: list[dict[str, Any]], settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Add the choice of the generator's unknown before its parameters."""
    unknowns, unknown = unknowns_of(settings), unknown_of(settings)
    first = next((i for i, each in enumerate(controls) if each["key"].startswith(f"{PARAMETERS}.")), None)
    if not unknowns or first is None:
        return controls
    for control in controls[first:]:
        if control["key"].removeprefix(f"{PARAMETERS}.") in unknowns:
            control["is_optional"] = False  # always visible, also while another one is solved for
    solve = {
        **_described(PARAMETERS, "layout", {}),
        "id": f"{PARAMETERS}:solve",
        "label": "solve for",
        "help": SOLVE_HELP,
        "kind": "choice",
        "is_optional": False,
        "do": "solve",
        "choices": [{"label": label, "value": name} for name, label in unknowns.items()],
        "value": unknown,
    }
    return [*controls[:first], solve, *controls[first:]]


def structure_of(settings: Any, key: str = "") -> Any:
    """Return names, kinds and strings of settings, which determine the list of controls."""
    if isinstance(settings, Mapping):
        return {name: structure_of(value, name) for name, value in settings.items()}
    if isinstance(settings, list) and settings and all(isinstance(item, Mapping) for item in settings):
        return [structure_of(item) for item in settings[:MAX_ITEMS]]
    if isinstance(settings, bool) or key in ENUMERATED:
        return settings
    # 4 and 3.9 have the same control: another list would end the drag of a slider.
    return "number" if isinstance(settings, int | float) else "list" if isinstance(settings, list) else settings


def chosen_value(
    key: str, value: Any, shown: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], start: Mapping[str, Any]
) -> Any:
    """
    Return the value of an alternative for the current settings.

    The list on the page may be older than the settings: parameters that alternatives share have their current values.

    Parameters
    ----------
    key : str
    value : plain data
        One of the choices of the page, or any other value, which is returned.
    shown : sequence of controls
        The controls of the page.
    settings, start : mapping
        As for :func:`controls_of`.
    """
    labels = [c["label"] for each in _choices(shown, key) for c in each["choices"] if c["value"] == value]
    if not labels or not isinstance(value, dict):
        return value
    new = [c["value"] for each in _choices(controls_of(settings, start), key) for c in each["choices"]
           if c["label"] == labels[0]]  # fmt: skip
    return copy.deepcopy(new[0]) if new else value


def _choices(controls: Sequence[Mapping[str, Any]], key: str) -> list[Mapping[str, Any]]:
    return [control for control in controls if control["key"] == key and control["kind"] == "choice"]


@lru_cache(maxsize=1)
def _schema() -> dict[str, Any]:
    return schema()


def _controls(
    root: dict[str, Any],
    key: str,
    section: str,
    node: dict[str, Any],
    value: Any,
    start: Mapping[str, Any],
    *,
    is_required: bool = False,
    depth: int = 0,
) -> Iterator[dict[str, Any]]:
    """Yield the control of a parameter, and those of its section."""
    name = key.rpartition(".")[2]
    control = _described(key, section, node)
    if is_required:
        control["is_required"] = True
    options = list(_options(root, node))
    if key == "layout":
        options = [option for option in options if option.get("type") != "string"]
    control["is_optional"] = any(option.get("type") == "null" for option in options)
    options = [option for option in options if option.get("type") != "null"]
    sections = [option for option in options if option.get("type") == "object" and "properties" in option]
    default = node.get("default")
    selected = next((option for option in sections if _matches(option, value)), None)
    items = _items(root, options)
    if items:
        yield {**control, "kind": "sections", "choices": _templates_of(root, items)}
        for i, item in enumerate(value[:MAX_ITEMS] if isinstance(value, list) else ()):
            found = next((each for each in items if _matches(each, item)), None)
            if found is not None:
                item_key = f"{key}.{i}"
                heading = f"{i + 1}. {_label(found)}"
                yield {**_described(item_key, section, {}), "label": heading, "kind": "group", "is_item": True}
                yield from _parameters(root, item_key, section, found, item, start, depth)
        return
    if not sections:
        yield {**control, **_simple(name, options, value, default, get_setting(start, key))}
        return
    if len(sections) == 1 and len(options) == 1 and not control["is_optional"]:
        yield {**control, "kind": "group"}
    else:
        yield {**control, "kind": "choice", **_alternatives(root, key, options, value, control["is_optional"], start)}
        others = [option for option in options if option not in sections]
        if selected is None and value is None and not isinstance(default, dict):
            value = default
        if selected is None and others and value is not None:
            simple = _simple(name, others, value, default, get_setting(start, key))
            if simple["kind"] != "choice":  # names are alternatives of the control above
                yield {**control, **simple}
    if selected is None and len(sections) == 1 and len(options) == 1 and not control["is_optional"]:
        selected = sections[0]
    if selected is not None:
        inner_section = section if depth or "." in key else key
        yield from _parameters(root, key, inner_section, selected, value, start, depth)


def _parameters(
    root: dict[str, Any],
    key: str,
    section: str,
    selected: dict[str, Any],
    value: Any,
    start: Mapping[str, Any],
    depth: int,
) -> Iterator[dict[str, Any]]:
    """Yield the controls of the parameters of a section."""
    if depth == MAX_DEPTH:
        return
    values = value if isinstance(value, Mapping) else {}
    required = selected.get("required", ())
    for inner, below in selected["properties"].items():
        if below.get("readOnly") or (inner in TAGS and ("const" in below or len(below.get("enum", ())) == 1)):
            continue
        yield from _controls(
            root,
            f"{key}.{inner}",
            section,
            below,
            values.get(inner),
            start,
            is_required=inner in required,
            depth=depth + 1,
        )


def _items(root: dict[str, Any], options: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the sections that a list may contain; none for lists of values."""
    found = [item for option in options if option.get("type") == "array" and "items" in option
             for item in _options(root, option["items"])]  # fmt: skip
    is_list = len(options) == 1 and all(item.get("type") == "object" and "properties" in item for item in found)
    return found if is_list else []


def _templates_of(root: dict[str, Any], items: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the sections that a list may contain and that have valid initial values."""
    choices = [_choice(item, _initial(root, item, None)) for item in items]
    return [choice for choice in choices if [] not in choice["value"].values()]


def _choice(option: dict[str, Any], value: Any, *, is_complete: bool = False) -> dict[str, Any]:
    """
    Return an alternative with a value.

    One with a file, unless its value is complete, contains none of the parameters: the page asks for them and for ``file``,
    the key of the file.
    """
    required = option.get("required", ()) if isinstance(value, dict) and not is_complete else ()
    name = next((name for name in FROM_FILES if name in required), None)
    if name is None:
        return {"label": _label(option), "value": value}
    found = _tag(option)
    tag = {} if found is None else {found[0]: found[1]}
    names = [key for key in option["properties"] if key != name and key not in tag]
    return {
        "label": _label(option),
        "value": tag,
        "file": name,
        "required": [key for key in names if key in required],
        "optional": [key for key in names if key not in required],
    }


def _described(key: str, section: str, node: dict[str, Any]) -> dict[str, Any]:
    """Return the name, unit and help of a control."""
    name = key.rpartition(".")[2]
    label, unit = words_and_unit(name)
    words = words_of(key, node)
    found = _sentence(_plain(node.get("description", "")))
    return {
        "key": key,
        "label": words.label or label,
        "unit": words.unit or unit or ("fraction" if name.endswith("_fraction") else ""),
        "section": section,
        "help": words.help or found or f"{(words.label or label).capitalize()}.",
        "synonyms": words.synonyms,
        "default": node.get("default"),
    }


def _sentence(text: str) -> str:
    """Return a text that begins with a capital letter and ends with a full stop."""
    if not text:
        return ""
    first, _, rest = text.partition(" ")
    first = first if any(letter.isupper() for letter in first) or not first.isalpha() else first.capitalize()
    joined = f"{first} {rest}".strip()
    return joined if joined.endswith((".", "!", "?", ":")) else f"{joined}."


def _plain(text: str) -> str:
    """Return a docstring without markup."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"\1", text)
    return text.replace("``", "").replace("\\", "")


def _resolved(root: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """Return the definition that a node refers to."""
    while True:
        # Before version 2.9, pydantic wrote references with a description into ``allOf``.
        (node,) = node.get("allOf", (node,))
        if "$ref" not in node:
            return node
        node = root["$defs"][node["$ref"].rpartition("/")[2]]


def _options(root: dict[str, Any], node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the alternatives of a node, without nested unions."""
    node = _resolved(root, node)
    for union in ("anyOf", "oneOf"):
        if union in node:
            bounds = {name: node[name] for name in BOUNDS if name in node}
            for option in node[union]:
                for each in _options(root, option):
                    yield {**each, **bounds} if each.get("type") in ("number", "integer") else each
            return
    yield node


def _tag(option: dict[str, Any]) -> tuple[str, str] | None:
    """Return the key that selects a section, and its value."""
    for name in TAGS:
        below = option["properties"].get(name, {})
        if "const" in below:
            return name, below["const"]
    return None


def _matches(option: dict[str, Any], value: Any) -> bool:
    """Return whether a section is the one that a value belongs to."""
    if not isinstance(value, Mapping):
        return False
    tag = _tag(option)
    if tag is not None:
        return value.get(tag[0]) == tag[1]
    return set(value) <= set(option["properties"]) and set(option.get("required", ())) <= set(value)


def _label(option: dict[str, Any]) -> str:
    """Return the name of an alternative."""
    if option.get("type") == "object":
        tag = _tag(option) if "properties" in option else None
        if tag is not None:
            return tag[1].replace("_", " ")
        return {"PerArea": "per µm²"}.get(option.get("title", ""), option.get("title", "section"))
    if "const" in option:
        return str(option["const"])
    return {"array": "list", "string": "name", "number": "number", "integer": "number"}.get(
        option.get("type", ""), "value"
    )


def _alternatives(
    root: dict[str, Any],
    key: str,
    options: list[dict[str, Any]],
    value: Any,
    is_optional: bool,
    start: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the choices of a parameter, each with its initial value."""
    choices: list[dict[str, Any]] = []
    selected = None
    if is_optional:
        choices.append({"label": "none", "value": None})
        selected = 0 if value is None else None
    name = key.rpartition(".")[2]
    started = get_setting(start, key)
    for option in options:
        is_selected = selected is None and _is_of(option, value)
        if not is_selected and option.get("type") == "array":
            continue  # lists of values per site
        if option.get("type") == "object" and "properties" in option:
            if value is not None and is_selected:
                initial = value
            else:
                initial = started if _matches(option, started) else _initial(root, option, value)
                if option.get("title") == "PerArea" and not _matches(option, started):
                    initial = {"per_um2": PER_AREA.get(name, 1.0)}
        else:
            initial = _initial_value(name, option, value)
        if is_selected:
            selected = len(choices)
        choices.append(_choice(option, copy.deepcopy(initial), is_complete=is_selected))
    if key == "layout":
        choices += [{"label": f"bundled: {each.replace('_', ' ')}", "value": each} for each in bundled_layouts()]
    return {"choices": choices, "selected": selected}


def _is_of(option: dict[str, Any], value: Any) -> bool:
    """Return whether a value is of an alternative."""
    match option.get("type"):
        case "object":
            return _matches(option, value) if "properties" in option else isinstance(value, Mapping)
        case "number":
            return isinstance(value, int | float) and not isinstance(value, bool)
        case "integer":
            return isinstance(value, int) and not isinstance(value, bool)
        case "string":
            return isinstance(value, str) and value == option.get("const", value)
        case "boolean":
            return isinstance(value, bool)
        case "array":
            return isinstance(value, list)
        case _:
            return False


def _initial(root: dict[str, Any], option: dict[str, Any], value: Any) -> dict[str, Any]:
    """Return a valid section: its template, and the parameters that the current value has too."""
    found: dict[str, Any] = {}
    tag = _tag(option)
    if tag is not None:
        found[tag[0]] = tag[1]
    template = templates(option.get("title", ""))
    old = value if isinstance(value, Mapping) else {}
    for name, node in option["properties"].items():
        options = list(_options(root, node))
        if name in found:
            continue
        if name == "parameters":
            found[name] = _initial(root, options[0], None)
        elif name in template:
            found[name] = copy.deepcopy(template[name])
        elif name in old and any(_is_of(each, old[name]) for each in options):
            found[name] = copy.deepcopy(old[name])
        elif name in option.get("required", ()) or name in GIVEN:
            found[name] = _initial_value(name, options[0], None)
    # Framings of a scene exclude each other.
    if "fit" in found and any(found.get(name) is not None for name in ("pitch_um", "field_of_view_deg")):
        del found["fit"]
    wavelength_nm = found.get("wavelength_nm", INITIAL["wavelength_nm"])
    # Scenes with a single band require its width.
    if "band_width_nm" in option["properties"] and not (isinstance(wavelength_nm, list) and len(wavelength_nm) > 1):
        found.setdefault("band_width_nm", INITIAL["band_width_nm"])
    if "mosaic" in found and not has_mosaic(found.get("generator", "")):
        found.pop("mosaic", None)
    return found


def _initial_value(name: str, option: dict[str, Any], value: Any) -> Any:
    """Return a valid value of an alternative."""
    if _is_of(option, value):
        return value
    if "const" in option:
        return option["const"]
    if "enum" in option:
        return option["enum"][0]
    if name in INITIAL and _is_of(option, INITIAL[name]):
        return copy.deepcopy(INITIAL[name])
    match option.get("type"):
        case "object" if "properties" in option:
            return _initial(_schema(), option, None)
        case "object":
            return {}
        case "array":
            if "prefixItems" in option:
                return [_initial_value(name, _resolved(_schema(), item), None) for item in option["prefixItems"]]
            return [INITIAL[name]] if isinstance(INITIAL.get(name), int | float) else []
        case "integer":
            return 1
        case "boolean":
            return False
        case "string":
            return ""
        case _:
            return min(max(1.0, option.get("minimum", 1.0)), option.get("maximum", 1.0))


def _simple(name: str, options: list[dict[str, Any]], value: Any, default: Any, started: Any) -> dict[str, Any]:
    """Return the kind, range and choices of a control without a section."""
    shown = value if value is not None else default
    option = next((each for each in options if _is_of(each, shown)), options[0] if options else {})
    enum = option.get("enum")
    if enum is not None or (len(options) == 1 and "const" in option):
        values = enum or [option["const"]]
        names = [{"label": "none" if each is None else str(each).replace("_", " "), "value": each} for each in values]
        return {"kind": "choice", "choices": names, "selected": values.index(shown) if shown in values else None}
    match option.get("type"):
        case "number" | "integer":
            return {"kind": option["type"], **_range(name, option, shown, started)}
        case "boolean":
            return {"kind": "boolean"}
        case "string":
            return {"kind": "file" if name in FILE_SETTINGS else "text"}
        case _:
            length = len(option.get("prefixItems", ())) or None
            return {"kind": "list", "length": length}


def _range(name: str, option: Mapping[str, Any], value: Any, started: Any) -> dict[str, Any]:
    """Return the valid and the suggested range of a number, and the scale of its slider."""
    minimum = option.get("minimum", option.get("exclusiveMinimum"))
    maximum = option.get("maximum")
    low, high = option.get("usual") or RANGES.get(name) or (None, None)
    if low is None and minimum is not None and maximum is not None and maximum - minimum <= SHORT_RANGE:
        low, high = minimum, maximum
    around = next((x for x in (started, value) if isinstance(x, int | float) and math.isfinite(x)), None)
    if low is None or high is None:
        size = abs(around) if around else 1.0
        if around is not None and around > 0.0:
            low, high = size * BELOW, size * ABOVE
        elif around is not None and around < 0.0:
            low, high = -2.0 * size, 2.0 * size
        else:
            low, high = 0.0, 10.0 if option["type"] == "integer" else 1.0
        if name.startswith(("dx", "dy", "x_", "y_")):
            low, high = -max(abs(low), high), max(abs(low), high)
    for x in (around, value):
        if isinstance(x, int | float) and math.isfinite(x):
            low, high = min(low, float(x)), max(high, float(x))
    if minimum is not None:
        low = max(low, minimum)
        high = high if high > low else low + max(abs(low), 1.0)
    if maximum is not None:
        high = min(high, maximum)
    if option["type"] == "integer":
        low, high = math.floor(low), max(math.ceil(high), math.floor(low) + 1)
    is_log = low > 0.0 and high / low >= LOG_RATIO and option["type"] == "number"
    return {
        "minimum": minimum,
        "maximum": maximum,
        "suggested": [low, high],
        "scale": "log" if is_log else "linear",
    }
