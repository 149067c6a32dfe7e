"""Metadata of the distribution: links and addresses."""

from __future__ import annotations

import re
import runpy
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HOOK = runpy.run_path(str(ROOT / "hatch_build.py"))
ADDRESS = "https://example.org/foveasim"
README = (ROOT / "README.md").read_text("utf-8")


@pytest.mark.parametrize(
    ("text", "linked", "plain"),
    [
        ("[guide](docs/a.md#b)", f"[guide]({ADDRESS}/blob/main/docs/a.md#b)", "guide"),
        ("![A sensor](a.png)", f"![A sensor]({ADDRESS}/raw/main/a.png)", ""),
        ("[site](https://example.com/x)", "[site](https://example.com/x)", "[site](https://example.com/x)"),
        ("[below](#licence)", "[below](#licence)", "[below](#licence)"),
        (
            "[a [b] c](d.md), [e](f.md)",
            f"[a [b] c]({ADDRESS}/blob/main/d.md), [e]({ADDRESS}/blob/main/f.md)",
            "a [b] c, e",
        ),
    ],
)
def test_relative_links_become_absolute_or_text(text, linked, plain):
    assert HOOK["description"](text, ADDRESS) == linked
    assert HOOK["description"](text, "") == plain


@pytest.mark.parametrize("address", ["", ADDRESS])
def test_description_has_no_relative_links(address):
    targets = re.findall(r"\]\(([^)\s]+)\)", HOOK["description"](README, address))

    assert len(re.findall(r"\]\(docs/", README)) > 20
    assert [target for target in targets if not re.match(r"\w+:|#", target)] == []


def test_links_of_description_exist():
    linked = HOOK["description"](README, ADDRESS)
    paths = re.findall(rf"{re.escape(ADDRESS)}/(?:blob|raw)/main/([^)#]+)", linked)

    assert len(paths) > 30
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_project_addresses_follow_from_setting():
    assert HOOK["urls"]("") == {}
    assert set(HOOK["urls"](ADDRESS)) == {"Homepage", "Documentation", "Changelog", "Issues"}
    assert all(url.startswith(ADDRESS) for url in HOOK["urls"](ADDRESS).values())


def test_distribution_names_authors_and_licence():
    from importlib.metadata import metadata

    found = metadata("foveasim")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]

    assert found["Author"] == project["authors"][0]["name"] == "The foveasim developers"
    assert found.get("License-Expression", found.get("License")) == "MIT"  # the second of metadata before 2.4
    assert (ROOT / "LICENSES" / "MIT.txt").read_text() == (ROOT / "LICENSE").read_text()
