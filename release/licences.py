"""Licences of installed distributions: from their metadata, and from the shared libraries that their wheels contain."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable
from importlib.metadata import Distribution
from typing import Any

#: Licences that dependencies may have: permissive ones, and those that protect their own files or library only.
ALLOWED = frozenset({
    "0BSD", "Apache-2.0", "BSD", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "HPND", "ISC", "MIT", "MIT-0", "MIT-CMU",
    "PSF-2.0", "Python-2.0", "Unlicense", "Zlib",
    "LGPL-2.1-only", "LGPL-2.1-or-later", "LGPL-3.0-only", "LGPL-3.0-or-later", "MPL-2.0",
})  # fmt: skip
#: Names of licences in free text and classifiers, which are older than SPDX expressions.
SPDX = {
    "Apache 2.0": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD 3-Clause License": "BSD-3-Clause",
    "BSD License": "BSD",
    "Boost Software License 1.0 (BSL-1.0)": "BSL-1.0",
    "GNU General Public License (GPL)": "GPL",
    "ISC License (ISCL)": "ISC",
    "ISC license": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "NVIDIA Proprietary Software": "LicenseRef-NVIDIA-Proprietary",
    "Other/Proprietary License": "LicenseRef-Proprietary",
    "Python Software Foundation License": "PSF-2.0",
    "The MIT License (MIT)": "MIT",
}
#: Classifiers that state no licence.
VAGUE = {"OSI Approved", "DFSG approved"}
#: Libraries under the GPL that wheels contain, where the metadata states the licence of the sources only.
GPL_LIBRARIES = ("x264", "x265", "xvidcore")
#: What distributions state that is not allowed, and why they may be dependencies; "*" stands for any end of a name.
EXCEPTIONS = {
    "aedat": ("no licence", "optional: MIT by the file LICENSE of its wheel, without a licence in the metadata"),
    "av": ("x264, x265", "optional: the user installs it; its wheel has an FFmpeg with encoders under the GPL"),
    "cuda-toolkit": (
        "no licence",
        "optional, of PyTorch on Linux: a list of NVIDIA's libraries without files of its own",
    ),
    "klayout": (
        "GPL-3.0-or-later",
        "optional: the user installs it, and the MIT licence of foveasim is compatible with the GPL",
    ),
    "nvidia-*": (
        "LicenseRef-NVIDIA-Proprietary",
        "optional, of PyTorch on Linux: NVIDIA's libraries, from its own wheels",
    ),
    "openexr": (
        "no licence",
        "optional: BSD-3-Clause by the file LICENSE.md of its wheel, without a licence in the metadata",
    ),
    "pillow-heif": ("x265", "optional: the user installs it; its wheel has an encoder under the GPL"),
}


def name_of(distribution: Distribution) -> str:
    """Return the normalised name of a distribution."""
    return re.sub(r"[-_.]+", "-", distribution.metadata["Name"]).lower()


def licence_of(distribution: Distribution) -> str:
    """
    Return the licence of a distribution as an SPDX expression, empty if its metadata has none.

    The licence expression counts first, then a licence of one line, then the classifiers, all of which apply.
    """
    metadata = distribution.metadata
    if expression := metadata.get("License-Expression"):
        return str(expression)
    text = (metadata.get("License") or "").strip()
    if text and "\n" not in text and is_expression(SPDX.get(text, text)):
        return SPDX.get(text, text)
    ends = [
        line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or [] if line.startswith("License ::")
    ]
    return " AND ".join(sorted({SPDX.get(end, end) for end in ends if end not in VAGUE}))


def is_expression(text: str) -> bool:
    """Return whether a text reads as an SPDX expression, which free text rarely does."""
    return re.fullmatch(r"[\w.+-]+( (AND|OR|WITH) [\w.+-]+)*", text) is not None and text.upper() != "UNKNOWN"


def is_allowed(expression: str) -> bool:
    """Return whether an SPDX expression can be satisfied with allowed licences only."""
    without_exceptions = re.sub(r" WITH [\w.+-]+", "", expression)
    words = re.findall(r"[()]|[^\s()]+", without_exceptions)
    operators = {"AND": "and", "OR": "or", "(": "(", ")": ")"}
    logic = " ".join(operators.get(word) or str(word in ALLOWED) for word in words)
    try:
        return is_true(ast.parse(logic, mode="eval").body)
    except SyntaxError:
        return False


def is_true(node: ast.expr) -> bool:
    """Return whether a tree of True, False, ``and`` and ``or`` is true."""
    if isinstance(node, ast.BoolOp):
        return (all if isinstance(node.op, ast.And) else any)(map(is_true, node.values))
    return isinstance(node, ast.Constant) and node.value is True


def gpl_libraries(names: Iterable[str]) -> list[str]:
    """Return which libraries under the GPL are among file names, such as ``libx265-4883ecb5.so.217``."""
    pattern = re.compile(rf"(?:lib)?({'|'.join(GPL_LIBRARIES)})\b.*\.(?:so|dylib|dll)\b")
    return sorted({found[1] for name in names if (found := pattern.match(name))})


def question_of(record: dict[str, Any]) -> str:
    """Return what a distribution states that is not allowed, or the libraries under the GPL that it contains, else nothing."""
    if not record["licence"]:
        return "no licence"
    if not is_allowed(record["licence"]):
        return str(record["licence"])
    return ", ".join(record.get("gpl_libraries", ()))


def reason_of(name: str, question: str) -> str:
    """Return why a distribution is an exception, empty if it is none."""
    for pattern, (expected, reason) in EXCEPTIONS.items():
        if re.fullmatch(pattern.replace("*", ".*"), name) and question == expected:
            return reason
    return ""


def exceptions(distributions: dict[str, dict[str, Any]]) -> dict[str, str]:
    """Return the reason of each exception, by name; empty for distributions that may not be dependencies."""
    questions = {name: question_of(record) for name, record in sorted(distributions.items())}
    return {name: reason_of(name, question) for name, question in questions.items() if question}
