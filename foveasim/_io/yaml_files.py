"""YAML from strangers: with limits, without tags and anchors, and nothing evaluated."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from foveasim.errors import ConfigError

__all__ = ["MAX_FILE_BYTES", "parsed", "read_text", "read_yaml"]

#: A settings file is written by hand; a longer one is something else.
MAX_FILE_BYTES = 1 << 20


class _Loader(yaml.SafeLoader):
    """YAML without tags, anchors and repeated keys, with 1e-13 as a number, and with all keys as texts, as JSON has them."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise yaml.YAMLError(f"anchors and aliases are not allowed (line {event.start_mark.line + 1})")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, str) and (not isinstance(key, int) or isinstance(key, bool)):
                raise yaml.YAMLError(f"the key {key!r} must be a text or an integer (line {line})")
            if str(key) in seen:
                raise yaml.YAMLError(f"the key '{key}' stands there twice (line {line})")
            seen.add(str(key))
        return {str(key): value for key, value in super().construct_mapping(node, deep).items()}


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(("timestamp", "float"))]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.\d*|\.\d+|\d+(?=[eE]))([eE][-+]?\d+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"),
    list("-+0123456789."),
)


def parsed(path: Path, text: str) -> Any:
    """
    What a text says, told as part of a file.

    Raises
    ------
    ConfigError
        When it is no YAML, or uses more of it than settings need.
    """
    try:
        return yaml.load(text, _Loader)  # noqa: S506 -- a SafeLoader
    except RecursionError:
        raise ConfigError(path, "is nested too deeply") from None
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        raise ConfigError(path, f"is not YAML{line}: {error.problem}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(path, f"is not YAML as settings need it: {' '.join(str(error).split())}") from None


def read_text(path: Path) -> str:
    """
    A text that was written by hand or by a small program.

    Raises
    ------
    ConfigError
        When it is no file, too large, or no text in UTF-8.
    """
    if not path.is_file():
        raise ConfigError(path, "no such file" if not path.exists() else "is not a file")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ConfigError(path, f"is larger than {MAX_FILE_BYTES} bytes, and so no settings file")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise ConfigError(path, "is no text file in UTF-8") from None


def read_yaml(path: Path) -> dict[str, Any]:
    """
    The settings in a file.

    Raises
    ------
    ConfigError
        When it is no file, too large, no text, no YAML, or no mapping.
    """
    text = read_text(path)
    data = parsed(path, text)
    if not isinstance(data, dict):
        raise ConfigError(
            path, f"must hold settings as 'key: value', got {'nothing' if data is None else repr(data)[:60]}"
        )
    return data
