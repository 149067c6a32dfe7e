"""Safe reading of untrusted YAML, with size limits and without tags and anchors."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from foveasim._core.names import missing_path
from foveasim.errors import ConfigError

#: Size limit: settings files are written by hand.
MAX_FILE_BYTES = 1 << 20


class _NotAllowedError(yaml.MarkedYAMLError):
    """Valid YAML that settings may not contain."""


def _not_allowed(problem: str, node: Any) -> _NotAllowedError:
    return _NotAllowedError(problem=problem, problem_mark=node.start_mark)


class _SafeLoader(yaml.SafeLoader):
    """
    Loader of YAML without tags, anchors and duplicate keys.

    1e-13 is a number, and all keys are strings, as in JSON.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise _not_allowed("anchors and aliases are not allowed; repeat the values", event)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str) and (not isinstance(key, int) or isinstance(key, bool)):
                raise _not_allowed(f"the key {key!r} must be a string or an integer", key_node)
            if str(key) in keys:
                raise _not_allowed(f"duplicate key '{key}'", key_node)
            keys.add(str(key))
        return {str(key): value for key, value in super().construct_mapping(node, deep).items()}


_SafeLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(("timestamp", "float"))]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_SafeLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.\d*|\.\d+|\d+(?=[eE]))([eE][-+]?\d+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"),
    list("-+0123456789."),
)


class _Dumper(yaml.SafeDumper):
    """Writer of YAML that :func:`parse_yaml` reads as the same data, without anchors."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 -- the signature is that of yaml
        return True


_Dumper.yaml_implicit_resolvers = _SafeLoader.yaml_implicit_resolvers


def format_yaml(data: Any) -> str:
    """Return plain data as YAML, which :func:`parse_yaml` reads as the same data."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)


def parse_yaml(path: Path, text: str) -> Any:
    """
    Parse a YAML string; errors name the file.

    Raises ConfigError when the string is not YAML, or contains tags, anchors, duplicate keys or deep nesting.
    """
    try:
        return yaml.load(text, _SafeLoader)  # noqa: S506 -- a SafeLoader
    except RecursionError:
        raise ConfigError(path, "is nested too deeply") from None
    except yaml.MarkedYAMLError as error:
        position = None if error.problem_mark is None else _position(error.problem_mark)
        kind = "is not valid YAML for settings" if isinstance(error, _NotAllowedError) else "is not YAML"
        raise ConfigError(path, f"{kind}: {error.problem}", position=position) from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(path, f"is not valid YAML for settings: {' '.join(str(error).split())}") from None


def _position(mark: Any) -> tuple[int, int]:
    return mark.line + 1, mark.column + 1


def position_of(path: Path, keys: Sequence[str], *, is_exact: bool = False) -> tuple[int, int] | None:
    """
    Return the line and column of a key in a YAML file, from 1.

    ``keys``: keys, and indices of lists. ``is_exact``: whether the file must contain the key; by default the position is that
    of the innermost section with it. Returns ``position`` (line, column) or None: None when the file cannot be read, or does
    not contain the key.
    """
    try:
        node = yaml.compose(read_text(path), _SafeLoader)
    except (ConfigError, yaml.YAMLError, RecursionError, ValueError, OSError):
        return None
    mark = None
    for key in keys:
        if isinstance(node, yaml.MappingNode):
            found = next(((k.start_mark, v) for k, v in node.value if k.value == key), None)
        elif isinstance(node, yaml.SequenceNode) and key.isdecimal() and int(key) < len(node.value):
            found = node.value[int(key)].start_mark, node.value[int(key)]
        else:
            found = None
        if found is None:
            return None if is_exact or mark is None else _position(mark)
        mark, node = found
    return None if mark is None else _position(mark)


def first_comment(path: Path) -> str:
    """
    Return the comment in the first line of a YAML file, which describes it.

    Without one, the string is empty. Raises ConfigError when the file cannot be read.
    """
    line = read_text(path).partition("\n")[0]
    return line.lstrip("#").strip() if line.startswith("#") else ""


def read_text(path: Path) -> str:
    """
    Read a small UTF-8 text file.

    Raises ConfigError when the file is missing, too large, or not UTF-8 text.
    """
    if not path.is_file():
        raise ConfigError(path, missing_path(path))
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ConfigError(path, f"is larger than {MAX_FILE_BYTES} bytes, the limit of settings files")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise ConfigError(path, "is not a UTF-8 text file") from None


def read_yaml(path: Path) -> dict[str, Any]:
    """
    Read a settings file.

    Raises ConfigError when the file is missing, too large, not UTF-8 text, not YAML, or not a mapping.
    """
    text = read_text(path)
    data = parse_yaml(path, text)
    if not isinstance(data, dict):
        raise ConfigError(
            path, f"must contain settings as 'key: value', got {'nothing' if data is None else repr(data)[:60]}"
        )
    return data
