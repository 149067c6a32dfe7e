"""
Public interface of the package as text, one line per name: what changes between two versions.

    python release/api.py            report changes since the stored interface; exit with 1 if there are any
    python release/api.py --update   store the interface, after the changelog lists its changes
"""

from __future__ import annotations

import argparse
import difflib
import inspect
import runpy
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
STORED = Path(__file__).with_name("api.txt")
#: Documented by a build with PyTorch only.
LEARN = "foveasim.learn"


def public_modules() -> list[str]:
    """Return the modules that the documentation lists."""
    sys.path.insert(0, str(ROOT / "docs"))
    modules: list[str] = sorted(runpy.run_path(str(ROOT / "docs" / "generated_pages.py"))["MODULES"])
    return [name for name in modules if name != LEARN]


def lines_of(name: str, item: Any) -> Iterator[str]:
    """Yield the lines of a name: parameters with their defaults, and members of classes."""
    if inspect.isclass(item):
        bases = ", ".join(base.__name__ for base in item.__bases__ if base is not object)
        yield f"class {name}({bases})"
        if not issubclass(item, BaseException):
            yield f"{name}{signature_of(item)}"
        own = [base for base in reversed(item.__mro__) if base.__module__.partition(".")[0] == "foveasim"]
        members = {member: value for base in own for member, value in vars(base).items()}
        for member, value in sorted(members.items()):
            if member.startswith("_"):
                continue
            if isinstance(value, property) or not callable(inspect.unwrap(getattr(value, "__func__", value))):
                yield f"{name}.{member}"
            else:
                yield f"{name}.{member}{signature_of(getattr(value, '__func__', value))}"
    elif callable(item):
        yield f"{name}{signature_of(item)}"
    else:
        yield f"{name}: {type(item).__name__}"


def signature_of(call: Any) -> str:
    """Return the parameters of a call without annotations."""
    try:
        signature = inspect.signature(call)
    except (TypeError, ValueError):
        return "(...)"
    bare = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    text = str(signature.replace(parameters=bare, return_annotation=signature.empty))
    return text if " at 0x" not in text else "(...)"


def interface() -> list[str]:
    """Return the public interface, sorted, each name once where it is defined or first listed."""
    found: dict[str, None] = {}
    for module_name in public_modules():
        module = import_module(module_name)
        for public in sorted(module.__all__):
            item = getattr(module, public)
            if not inspect.ismodule(item):
                found |= dict.fromkeys(lines_of(f"{module_name}.{public}", item))
    return sorted(found)


def changes(stored: list[str], found: list[str]) -> list[str]:
    """Return removed lines with ``-`` and new ones with ``+``."""
    lines = difflib.unified_diff(stored, found, lineterm="", n=0)
    return [line for line in lines if line[0] in "+-" and not line.startswith(("+++", "---"))]


def main() -> None:
    """Report or store the interface."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="store the interface")
    is_update = parser.parse_args().update
    found = interface()
    if is_update:
        STORED.write_text("\n".join(found) + "\n", "utf-8")
    found_changes = changes(STORED.read_text("utf-8").splitlines(), found)
    print("\n".join(found_changes) or f"{len(found)} lines of the public interface, unchanged")
    if found_changes:
        sys.exit("the public interface changed: list this in CHANGELOG.md, then run: python release/api.py --update")


if __name__ == "__main__":
    main()
