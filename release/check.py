"""
Checks before a release: what is built and documented is what the repository says. Needs the extra ``release``.

    python release/check.py                     all checks
    python release/check.py build types api     some of them
    python release/check.py installations licences --without learn adapters     without those of gigabytes
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from installations import CORE, RESULTS, measure, new_environment, read_results, write_results
from licences import exceptions, question_of
from processes import CheckError, run

from foveasim._core.extras import EXTRA_OF

ROOT = Path(__file__).parents[1]
#: Largest size of the wheel, 10^6 bytes.
MAX_WHEEL_MB = 4.0
#: Smallest part of the public symbols whose types pyright knows.
MIN_TYPED = 0.99
#: Largest size of the installed core, 10^6 bytes.
MAX_CORE_MB = 600.0
#: Extras with modules that the package imports.
EXTRAS = sorted(set(EXTRA_OF.values()))


@dataclass
class Context:
    """
    Temporary directory, with the wheel and the source distribution once they are built.

    ``without``: extras that are not installed.
    """

    directory: Path
    without: tuple[str, ...] = ()

    @cached_property
    def wheel(self) -> Path:
        """The wheel, built with the source distribution when it is first needed."""
        run(sys.executable, "-m", "build", "--outdir", str(self.directory / "dist"), str(ROOT))
        return next((self.directory / "dist").glob("*.whl"))

    @property
    def sdist(self) -> Path:
        """The source distribution, from which the wheel is built."""
        return self.wheel.with_name(f"foveasim-{self.version}.tar.gz")

    @property
    def version(self) -> str:
        """Version of the wheel."""
        return self.wheel.name.split("-")[1]


def members(wheel: Path) -> dict[str, str]:
    """Return the hash of each file of a wheel, but for the list of hashes."""
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if not name.endswith("/RECORD")]
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in names}


def check_build(context: Context) -> str:
    """Build the source distribution and the wheel from it; a wheel from the repository is the same."""
    direct = context.directory / "direct"
    run(sys.executable, "-m", "build", "--wheel", "--outdir", str(direct), str(ROOT))
    one, other = members(context.wheel), members(next(direct.glob("*.whl")))
    if different := sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name)):
        raise CheckError(f"wheels from the repository and from the source distribution differ: {different[:5]}")
    with tarfile.open(context.sdist) as archive:
        tracked = set(run("git", "ls-files", cwd=ROOT).splitlines())
        names = {name.partition("/")[2] for name in archive.getnames()}
        if missing := sorted(name for name in tracked if name.startswith("foveasim/") and name not in names):
            raise CheckError(f"files are missing in the source distribution: {missing[:5]}")
    run(sys.executable, "-m", "twine", "check", "--strict", str(context.wheel), str(context.sdist))
    size_mb = context.wheel.stat().st_size / 1e6
    if size_mb > MAX_WHEEL_MB:
        raise CheckError(f"the wheel has {size_mb:.2f} MB, at most {MAX_WHEEL_MB:g}")
    sdist_mb = context.sdist.stat().st_size / 1e6
    return f"wheel of {size_mb:.2f} MB with {len(one)} files, source distribution of {sdist_mb:.1f} MB"


def check_version(context: Context) -> str:
    """Compare the version of the wheel with that of the citation and the changelog."""
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    cited = re.search(r"^version: *['\"]?([^'\"\n]+)", citation, re.MULTILINE)
    if cited is None or cited.group(1) != context.version:
        raise CheckError(f"CITATION.cff has the version {cited and cited.group(1)}, the wheel {context.version}")
    changelog = (ROOT / "CHANGELOG.md").read_text("utf-8")
    released = f"## [{context.version}]" in changelog
    if not released and f"will be {context.version}" not in changelog:
        raise CheckError(
            f"CHANGELOG.md must have a section of {context.version}, or state that it will be the next release"
        )
    return f"{context.version}, {'released' if released else 'not yet released in the changelog'}"


def check_api(_context: Context) -> str:
    """Compare the public interface with the stored one."""
    return run(sys.executable, str(ROOT / "release" / "api.py")).strip()


def check_types(context: Context) -> str:
    """Measure which part of the public types pyright knows, in an environment without extras."""
    python = new_environment(context.directory / "env", str(context.wheel))
    directory = context.directory / "empty"
    directory.mkdir(exist_ok=True)
    path = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
    found = subprocess.run(
        [sys.executable, "-m", "pyright", "--verifytypes", "foveasim", "--ignoreexternal", "--outputjson"],
        cwd=directory, env={**os.environ, "PATH": path, "VIRTUAL_ENV": str(python.parents[1])}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    try:
        report = json.loads(found.stdout)["typeCompleteness"]
    except (ValueError, KeyError):
        raise CheckError(f"pyright gave no report: {(found.stderr or found.stdout)[-500:]}") from None
    counts, score = report["exportedSymbolCounts"], report["completenessScore"]
    if not counts["withKnownType"] or score < MIN_TYPED:
        names = [each["name"] for each in report["symbols"] if each["isExported"] and not each["isTypeKnown"]]
        raise CheckError(
            f"{100.0 * score:.1f} % of the public types are known, at least {100.0 * MIN_TYPED:g}: {names[:9]}"
        )
    return f"{100.0 * score:.2f} % of {sum(counts.values()):,} public symbols have known types"


def check_installations(context: Context) -> str:
    """Install the core and each extra alone: every call works, or names the extra that it requires."""
    records = read_results()
    chosen = [name for name in EXTRAS if name not in context.without]
    records[CORE], calls = measure(context.wheel, CORE, context.directory / CORE)
    write_results(records, [CORE, *EXTRAS])
    failed = []
    for extra in chosen:
        names = [name for name, required in calls.items() if required == extra]
        try:
            if not names:
                raise CheckError(f"no call requires the extra {extra}")
            records[extra], _ = measure(context.wheel, extra, context.directory / extra, records[CORE], names)
        except CheckError as error:
            failed.append(f"{extra}: {error}")
        write_results(records, [CORE, *EXTRAS])
    if failed:
        raise CheckError("\n".join(failed))
    size_mb = records[CORE]["mb"]
    if size_mb > MAX_CORE_MB:
        raise CheckError(f"the core has {size_mb:.0f} MB, at most {MAX_CORE_MB:g}")
    n_core = sum(not required for required in calls.values())
    left_out = f"; not installed: {', '.join(context.without)}" if context.without else ""
    return (
        f"core of {size_mb:.0f} MB with {n_core} of {len(calls)} calls, the others with {len(chosen)} extras, "
        f"each alone{left_out}"
    )


def check_licences(context: Context) -> str:
    """Judge the licences of all distributions that the check of the installations found, now or earlier."""
    records = read_results()
    if missing := [name for name in (CORE, *EXTRAS) if name not in records and name not in context.without]:
        raise CheckError(f"{RESULTS.name} lacks {', '.join(missing)}; run: python release/check.py installations")
    found = {name: record for each in records.values() for name, record in each["distributions"].items()}
    reasons = exceptions(found)
    core = records[CORE]["distributions"]
    if wrong := [name for name, reason in reasons.items() if not reason or name in core]:
        stated = ", ".join(f"{name} ({question_of(found[name])})" for name in wrong)
        raise CheckError(f"neither allowed, nor an exception of an extra with a reason: {stated}")
    listed = f"{len(reasons)} exceptions: {', '.join(reasons)}" if reasons else "no exception"
    return f"{len(found)} distributions, {listed}"


def check_docs(_context: Context) -> str:
    """Build the documentation, with warnings as errors, and check its links."""
    run("make", "docs", cwd=ROOT)
    return "built without warnings, links found"


CHECKS: dict[str, Callable[[Context], str]] = {
    "build": check_build,
    "version": check_version,
    "api": check_api,
    "types": check_types,
    "installations": check_installations,
    "licences": check_licences,
    "docs": check_docs,
}


def main() -> None:
    """Run the checks that the command line names, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="CHECK", help=f"one of {', '.join(CHECKS)}; by default all")
    parser.add_argument(
        "--without",
        nargs="+",
        default=[],
        metavar="EXTRA",
        help=f"extras that are not installed, of {', '.join(EXTRAS)}",
    )
    parser.add_argument("--keep", type=Path, metavar="DIRECTORY", help="where wheel and source distribution are kept")
    options = parser.parse_args()
    chosen = options.names or list(CHECKS)
    if unknown := [name for name in chosen if name not in CHECKS]:
        parser.error(f"unknown checks: {', '.join(unknown)}; possible: {', '.join(CHECKS)}")
    if unknown := [name for name in options.without if name not in EXTRAS]:
        parser.error(f"unknown extras: {', '.join(unknown)}; possible: {', '.join(EXTRAS)}")
    failed = []
    with tempfile.TemporaryDirectory() as directory:
        context = Context(Path(directory), tuple(options.without))
        for name in chosen:
            start_s = time.perf_counter()
            try:
                verdict = CHECKS[name](context)
            except CheckError as error:
                failed.append(name)
                verdict = f"FAILED: {error}"
            print(f"{name} ({time.perf_counter() - start_s:.0f} s): {verdict}", flush=True)
        if options.keep and not failed:
            shutil.copytree(context.wheel.parent, options.keep, dirs_exist_ok=True)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
