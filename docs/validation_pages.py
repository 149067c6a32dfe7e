"""Pages of the validation, from the results that ``make validate`` stores."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.config import Config

DIRECTORY = Path(__file__).parent / "validation"
RESULTS = "results.json"
OWN = "foveasim"
INTRODUCTION = """\
Every stage of foveasim, compared with closed forms and slow reference methods, and with other programs on the same input in the
same run. A deviation is that from the truth, not from another program. Each comparison has a tolerance for foveasim, which
`make validate` asserts; the other programs are not judged, and what they do differently is stated below each table."""
READING = """\
Times are the shortest of up to three calls, on the machine that each page names. They include what a program does for its
result and no imports; a program that computes more than the comparison asks for takes longer. Run all of it yourself with
`make validate`, or a stage with `python validation/run.py STAGE`."""
#: Rows of the table in the paper: stage, beginning of the comparison, and its short form.
PAPER_ROWS = (
    (
        "diffraction",
        "PSF with defocus",
        "PSF with defocus, coma and spherical aberration",
    ),
    ("image", "modulation of 10 waves", "modulation of waves on square photosites"),
    ("distortion", "ideal points", "inverse of Brown and Conrady's model"),
    ("distortion", "light of 672", "672 photosites behind a fisheye lens, to 105°"),
    ("integration", "integrals over 1,440", "integrals over 1,440 log-polar sites"),
    ("integration", "integrals over 240", "integrals over 240 sectors of annuli"),
    ("resolution", "MTF of a hexagon of 7.3", "MTF of a hexagon"),
    ("layouts", "minimum width of 1,998", "minimum width of 1,998 shapes"),
    ("learning", "derivatives of the powers", "derivatives by vertices"),
    ("learning", "adjoint of lens", "adjoint of lens and photosites"),
)
#: Lines between which the paper has its results.
PAPER_MARKS = "<!-- results -->", "<!-- end of results -->"
PAPER_TEXT = """\
`make validate` compares every stage with closed forms and with other programs, on the same input and in the same run: {rows}
comparisons in {stages} stages, of which {kept} are within their tolerances. Some of them, with the time of each program:"""
MACHINE = "Times: {processor} with {cores} cores, {system}, Python {python}, foveasim {foveasim}."


def pages_of(results: dict[str, Any]) -> dict[str, str]:
    """Return the text of each page by its name."""
    sections = results["sections"]
    pages = {f"{section['name']}.md": page_of(section) for section in sections}
    return {"index.md": index_of(sections), **pages}


def index_of(sections: list[dict[str, Any]]) -> str:
    """Return the overview: a row per stage."""
    rows = [
        "| stage | comparisons | largest part of a tolerance | compared with | time |",
        "|---|---|---|---|---|",
    ]
    for section in sections:
        names = [
            one["program"].partition(", ")[0]
            for row in section["rows"]
            for one in row["results"]
        ]
        programs = dict.fromkeys(name for name in names if OWN not in name)
        # Counts without a tolerance have no part of it.
        part = max(
            own_of(row)["deviation"] / (row["tolerance"] or 1.0)
            for row in section["rows"]
        )
        rows.append(
            f"| [{section['title']}]({section['name']}.md) | {len(section['rows'])} | {number(100.0 * part)} % | "
            f"{', '.join(programs) or 'closed forms'} | {section['seconds']:.0f} s |"
        )
    n_rows = sum(len(section["rows"]) for section in sections)
    kept = sum(is_kept(row) for section in sections for row in section["rows"])
    toctree = "\n".join(
        [
            "```{toctree}",
            ":hidden:",
            "",
            *(section["name"] for section in sections),
            "```",
        ]
    )
    parts = [
        "# Validation",
        INTRODUCTION,
        f"{kept} of {n_rows} comparisons are within their tolerances.",
        "\n".join(rows),
    ]
    return "\n\n".join([*parts, READING, toctree]) + "\n"


def page_of(section: dict[str, Any]) -> str:
    """Return the page of a stage: its table, figures, and explanations."""
    rows = [
        "| comparison | truth, source | program | deviation | tolerance | time |",
        "|---|---|---|---|---|---|",
    ]
    for row in section["rows"]:
        for k, one in enumerate(row["results"]):
            first = (
                [f"{row['what']}", f"{row['truth']}; {row['source']}"]
                if k == 0
                else ["", ""]
            )
            of = f" {row['of']}" if row["of"] else ""
            bound = number(row["tolerance"]) if one["program"] == OWN else ""
            took = "" if one["seconds"] is None else time_of(one["seconds"])
            cells = [
                *first,
                one["program"],
                f"{number(one['deviation'])}{of}",
                bound,
                took,
            ]
            rows.append(
                f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
            )
    figures = [
        f"![{caption}]({name})\n\n{caption}"
        for name, caption in section["figures"].items()
    ]
    differences = list(differences_of(section))
    named = MACHINE.format(**section["machine"])
    parts = [
        f"# {section['title']}",
        section["about"],
        "\n".join(rows),
        named,
        *figures,
    ]
    if differences:
        parts += ["## Differences", "\n".join(differences)]
    return "\n\n".join(parts) + "\n"


def paper_of(text: str, results: dict[str, Any]) -> str:
    """Return the text of the paper with these results."""
    before, after = PAPER_MARKS
    start, end = text.index(before) + len(before), text.index(after)
    return f"{text[:start]}\n{paper_results(results['sections'])}\n{text[end:]}"


def paper_results(sections: list[dict[str, Any]]) -> str:
    """Return the summary of all comparisons, and a table of some."""
    rows = [row for section in sections for row in section["rows"]]
    lines = [
        PAPER_TEXT.format(
            rows=len(rows), stages=len(sections), kept=sum(map(is_kept, rows))
        ),
        "",
        "| comparison | foveasim | other programs |",
        "|---|---|---|",
    ]
    named = {section["name"]: section["rows"] for section in sections}
    for stage, start, short in PAPER_ROWS:
        row = next(row for row in named[stage] if row["what"].startswith(start))
        own = own_of(row)
        others = [
            f"{one['program']}: {measured(one)}"
            for one in row["results"]
            if OWN not in one["program"]
        ]
        of = f", {row['of']}" if row["of"] else ""
        lines.append(f"| {short}{of} | {measured(own)} | {'; '.join(others)} |")
    return "\n".join(lines)


def measured(one: dict[str, Any]) -> str:
    """Return the deviation of a program, and its time."""
    took = "" if one["seconds"] is None else f", {time_of(one['seconds'])}"
    return f"{number(one['deviation'])}{took}"


def differences_of(section: dict[str, Any]) -> Iterator[str]:
    """Yield what explains deviations, and what other programs do not offer, as items of a list."""
    for row in section["rows"]:
        if row["explanation"]:
            yield f"- {row['what']}: {row['explanation']}"
    seen = set()
    for row in section["rows"]:
        for one in row["results"]:
            if one["cannot"] and (one["program"], one["cannot"]) not in seen:
                seen.add((one["program"], one["cannot"]))
                yield f"- {one['program']}: {one['cannot']}."


def own_of(row: dict[str, Any]) -> dict[str, Any]:
    """Return the result of foveasim."""
    return next(one for one in row["results"] if one["program"] == OWN)


def is_kept(row: dict[str, Any]) -> bool:
    """Return whether foveasim is within the tolerance."""
    return own_of(row)["deviation"] <= row["tolerance"]


def number(value: float) -> str:
    """Return a number with two digits."""
    if value == 0.0 or 1e-2 <= abs(value) < 99.5:
        return f"{value:.2g}"
    if 99.5 <= abs(value) < 1e5:
        return f"{value:.0f}"
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


def time_of(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    for scale, unit in ((1.0, "s"), (1e-3, "ms")):
        if seconds >= scale:
            return f"{number(seconds / scale)} {unit}"
    return f"{number(seconds / 1e-6)} µs"


def write_validation(_app: Sphinx, _config: Config) -> None:
    """Write the pages."""
    for old in DIRECTORY.glob("*.md"):
        old.unlink()
    for name, text in pages_of(
        json.loads((DIRECTORY / RESULTS).read_text("utf-8"))
    ).items():
        (DIRECTORY / name).write_text(text, "utf-8")
