"""
Metadata that depend on the public address of the project.

The address is ``tool.foveasim.public-address`` in ``pyproject.toml``. With it, project URLs are added, and relative links
of the description become absolute; without it, they become plain text, since a package index cannot resolve them.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

#: Links and pictures of Markdown; targets with a scheme, and anchors, are absolute.
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?!\w+:|#)([^)\s]+)\)")


def description(text: str, address: str) -> str:
    """Return Markdown whose relative links are absolute; plain text without an address."""

    def replace(link: re.Match[str]) -> str:
        is_picture, label, target = link.groups()
        if not address:
            return "" if is_picture else label
        return f"{is_picture}[{label}]({address}/{'raw' if is_picture else 'blob'}/main/{target})"

    return LINK.sub(replace, text)


def urls(address: str) -> dict[str, str]:
    """Return the project URLs at a public address."""
    if not address:
        return {}
    return {
        "Homepage": address,
        "Documentation": f"{address}/blob/main/docs/index.md",
        "Changelog": f"{address}/blob/main/CHANGELOG.md",
        "Issues": f"{address}/issues",
    }


class PublicAddress(MetadataHookInterface):
    """Hook of the build backend."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        """Add the description and the URLs."""
        root = Path(self.root)
        settings = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["tool"]["foveasim"]
        address = str(settings["public-address"]).rstrip("/")
        text = description((root / "README.md").read_text("utf-8"), address)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
        metadata["urls"] = urls(address)
