"""Checks before a release: the stored public interface, sizes of installations, and licences of dependencies."""

from __future__ import annotations

import runpy
import subprocess
import sys
from email.message import Message
from importlib import import_module
from pathlib import Path

import pytest

from foveasim._core.extras import EXTRA_OF

RELEASE = Path(__file__).parents[1] / "release"


@pytest.fixture(scope="module")
def api():
    return runpy.run_path(str(RELEASE / "api.py"))


@pytest.mark.slow
def test_public_interface_is_the_stored_one(api):
    stored = (RELEASE / "api.txt").read_text("utf-8").splitlines()

    assert api["changes"](stored, api["interface"]()) == []  # else: python release/api.py --update, and CHANGELOG.md


def test_changed_parameters_are_reported(api):
    def before(light, *, seed):
        """Take two parameters."""

    def after(light, *, seed=0):
        """Take a default, too."""

    stored, found = (list(api["lines_of"]("module.call", call)) for call in (before, after))

    assert api["changes"](stored, found) == ["-module.call(light, *, seed)", "+module.call(light, *, seed=0)"]


def test_members_of_classes_are_listed(api):
    class Sample:
        def __init__(self, a, b=2):
            self._a = a, b

        @property
        def size(self):
            """One."""
            return 1

        @classmethod
        def read(cls, path):
            """Read one."""

        def _hidden(self):
            """Not listed."""

    Sample.__module__ = "foveasim.sample"

    assert list(api["lines_of"]("Sample", Sample)) == [
        "class Sample()", "Sample(a, b=2)", "Sample.read(cls, path)", "Sample.size",
    ]  # fmt: skip


@pytest.fixture
def release(monkeypatch):
    """Import a module of the checks."""
    monkeypatch.syspath_prepend(RELEASE)
    before = set(sys.modules)
    yield import_module
    for name in set(sys.modules) - before:
        if str(RELEASE) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


class Metadata:
    """A distribution with given metadata."""

    def __init__(self, **fields):
        self.metadata = Message()
        for name, value in fields.items():
            for line in value if isinstance(value, list) else [value]:
                self.metadata[name.replace("_", "-")] = line


def test_size_counts_each_file_once(release, tmp_path):
    (tmp_path / "package" / "__pycache__").mkdir(parents=True)
    (tmp_path / "package" / "a.py").write_bytes(bytes(3000))
    (tmp_path / "package" / "b.so").write_bytes(bytes(500_000))
    (tmp_path / "b.so").hardlink_to(tmp_path / "package" / "b.so")
    (tmp_path / "c.so").symlink_to(tmp_path / "package" / "b.so")
    (tmp_path / "package" / "__pycache__" / "a.cpython-311.pyc").write_bytes(bytes(4000))

    assert release("installations").size_mb(tmp_path) == 0.503


@pytest.mark.parametrize(
    ("fields", "licence"),
    [
        ({"License_Expression": "MIT AND PSF-2.0", "License": "GPL"}, "MIT AND PSF-2.0"),
        ({"License": "GPL-3.0-or-later"}, "GPL-3.0-or-later"),
        ({"License": "Apache 2.0", "Classifier": ["License :: OSI Approved :: MIT License"]}, "Apache-2.0"),
        (
            {"License": "Copyright (c) 2001\nAll rights", "Classifier": ["License :: OSI Approved :: BSD License"]},
            "BSD",
        ),
        ({"License": "UNKNOWN", "Classifier": ["License :: OSI Approved :: ISC License (ISCL)"]}, "ISC"),
        ({"Classifier": ["License :: OSI Approved", "Topic :: Printing"]}, ""),
        (
            {"Classifier": ["License :: Public Domain", "License :: OSI Approved :: GNU General Public License (GPL)"]},
            "GPL AND Public Domain",
        ),
    ],
)
def test_licence_comes_from_metadata(release, fields, licence):
    assert release("licences").licence_of(Metadata(**fields)) == licence


@pytest.mark.parametrize(
    ("expression", "is_allowed"),
    [
        ("BSD-3-Clause AND 0BSD AND MIT AND Zlib AND CC0-1.0", True),
        ("Apache-2.0 WITH LLVM-exception AND BSL-1.0", True),
        ("MPL-2.0", True),
        ("GPL-2.0-only OR MIT", True),
        ("MIT AND (GPL-3.0-only OR LGPL-3.0-only)", True),
        ("MIT AND GPL-3.0-only", False),
        ("(MIT OR BSD-3-Clause) AND AGPL-3.0-or-later", False),
        ("LicenseRef-Own", False),
        ("Public Domain", False),
        ("", False),
    ],
)
def test_expression_requires_allowed_licences(release, expression, is_allowed):
    assert release("licences").is_allowed(expression) == is_allowed


def test_exceptions_are_for_what_they_state(release):
    licences = release("licences")
    distributions = {
        "numpy": {"licence": "BSD-3-Clause"},
        "pillow-heif": {"licence": "BSD-3-Clause", "gpl_libraries": ["x265"]},
        "nvidia-cudnn-cu99": {"licence": "LicenseRef-NVIDIA-Proprietary"},
        "openexr": {"licence": "AGPL-3.0-only"},
        "unknown": {"licence": ""},
    }
    found = licences.exceptions(distributions)

    assert set(found) == set(distributions) - {"numpy"}
    assert [name for name, reason in found.items() if not reason] == ["openexr", "unknown"]


def test_libraries_of_wheels_are_recognised(release):
    names = ["libx265-4883ecb5.so.217", "libx264.165.dylib", "libx265_tools.py", "libpng16.so", "xvidcore.dll"]

    assert release("licences").gpl_libraries(names) == ["x264", "x265", "xvidcore"]


def test_stored_licences_are_allowed_or_exceptions(release):
    installations, licences = release("installations"), release("licences")
    records = installations.read_results()

    assert set(records) == {installations.CORE, *EXTRA_OF.values()}
    for record in records.values():
        assert all(licences.exceptions(record["distributions"]).values())
    assert licences.exceptions(records[installations.CORE]["distributions"]) == {}


def test_sizes_of_the_page_are_stored_ones(release):
    installations = release("installations")
    page = installations.PAGE.read_text("utf-8")
    records = installations.read_results()

    assert installations.with_sizes(page, records) == page
    larger = {**records, "layout": {**records["layout"], "mb": records["core"]["mb"] + 1234.0}}
    assert "| 1,234 |\n" in installations.with_sizes(page, larger)
    with pytest.raises(installations.CheckError, match="must contain one line with"):
        installations.with_sizes(page.replace("`layout`", "`layouts`"), records)


def test_licence_tables_name_all_dependencies(release):
    tables = runpy.run_path(str(RELEASE.parent / "docs" / "installation_tables.py"))
    records = release("installations").read_results()
    core, others = tables["table_of_core"](records), tables["table_of_exceptions"](records)

    assert core.count("\n") == 1 + len(records["core"]["distributions"])
    assert "| klayout | `klayout` | GPL-3.0-or-later | optional" in others
    assert "| numpy" not in others


def test_failed_program_raises_its_last_line(release):
    processes = release("processes")

    assert processes.run(sys.executable, "-c", "print(7)") == "7\n"
    with pytest.raises(processes.CheckError, match=r"(?s)-c .* failed:.*out of paper"):
        processes.run(sys.executable, "-c", "raise SystemExit('out of paper')")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["colours"], "unknown checks: colours; possible: build, version"),
        (["licences", "--without", "colours"], "unknown extras: colours; possible: adapters, dxf"),
    ],
)
def test_unknown_arguments_are_named(arguments, message):
    found = subprocess.run(
        [sys.executable, str(RELEASE / "check.py"), *arguments], capture_output=True, text=True, check=False
    )

    assert found.returncode == 2
    assert message in found.stderr
