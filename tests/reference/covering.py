"""
Covering array of tests/compositions: a stored table in which each possible pair of values of two axes occurs.

Its axes are those of ``reference.features``, and the invariants of ``test_invariants.py``. The first ``N_DEFAULT`` rows,
those of the default run, contain each value. After a change of an axis, ``PYTHONPATH=tests python tests/reference/covering.py``
stores the table again: rows that remain possible are kept, and rows with the missing pairs are added.
"""

from __future__ import annotations

import ast
import csv
import random
import sys
from collections import Counter
from itertools import combinations, product
from pathlib import Path

from effort import is_in_part

DIRECTORY = Path(__file__).parents[1] / "compositions"
TABLE = DIRECTORY / "covering.csv"
#: Rows of the default run: each feature in one of them, each invariant in six.
N_DEFAULT = 90
#: Rows that are tried for each one of the table: more make the table a little shorter.
N_CANDIDATES = 30


def read_rows() -> tuple[tuple[str, ...], ...]:
    """Return the stored rows: one feature of each axis, then the invariant."""
    with TABLE.open(newline="") as file:
        return tuple(map(tuple, list(csv.reader(file))[1:]))


def cases(rows, *, effort, commit="") -> dict[str, list[tuple[str, ...]]]:
    """
    Return the rows of features for each invariant.

    ``effort`` is that of ``effort.effort``. All features with all invariants contain every triple of two features and an
    invariant: they run every night, and a part of them, which the hash of a commit selects, with the complete run.
    """
    selected = {"default": rows[:N_DEFAULT]}.get(effort, rows)
    found = {invariant: [] for invariant in sorted({row[-1] for row in rows})}
    for *features, invariant in selected:
        found[invariant].append(tuple(features))
    if effort != "nightly" and not commit:
        return found
    for (i, (*features, own)), (j, invariant) in product(enumerate(rows), enumerate(found)):
        if invariant != own and (effort == "nightly" or is_in_part(i + j, commit)):
            found[invariant].append(tuple(features))
    return found


def pairs_of(row):
    """Return the pairs of values in a row, each with its axis."""
    return set(combinations(enumerate(row), 2))


def possible_pairs(values, is_possible):
    """Yield the pairs of values of two axes that can be combined."""
    anything = [None] * len(values)
    for (i, first), (j, second) in combinations(enumerate(values), 2):
        for a, b in product(first, second):
            row = list(anything)
            row[i], row[j] = a, b
            if is_possible(row):
                yield (i, a), (j, b)


def invariants():
    """Return the names of the tests with an argument ``shot``, ``settings`` or ``row``, without ``test_``."""
    source = ast.parse((DIRECTORY / "test_invariants.py").read_text())
    return [
        node.name.removeprefix("test_")
        for node in source.body
        if isinstance(node, ast.FunctionDef)
        and node.name.startswith("test_")
        and {argument.arg for argument in node.args.args} & {"shot", "settings", "row"}
    ]


def cover(kept, values, is_possible, rng):
    """Return rows that contain each possible pair, the kept ones among them: the best of some greedy rows, until none is missing."""
    rows = list(kept)
    missing = set(possible_pairs(values, is_possible)).difference(*map(pairs_of, rows))
    while missing:
        candidates = [greedy_row(missing, values, is_possible, rng) for _ in range(N_CANDIDATES)]
        rows.append(max(candidates, key=lambda row: len(missing & pairs_of(row))))
        missing -= pairs_of(rows[-1])
    return rows


def greedy_row(missing, values, is_possible, rng):
    """Return a row with one of the missing pairs, and as many others as each next axis can add."""
    row = [None] * len(values)
    for k, value in rng.choice(sorted(missing)):
        row[k] = value
    rest = [k for k, value in enumerate(row) if value is None]
    for k in rng.sample(rest, len(rest)):
        possible = [value for value in values[k] if is_possible([*row[:k], value, *row[k + 1 :]])]
        row[k] = max(
            rng.sample(possible, len(possible)),
            key=lambda value: sum(pair in missing for pair in pairs_with(row, k, value)),
        )
    return tuple(row)


def pairs_with(row, k, value):
    """Return the pairs of a value of axis k with the values of an incomplete row."""
    return [((i, v), (k, value)) if i < k else ((k, value), (i, v)) for i, v in enumerate(row) if v is not None]


def in_order(rows, values):
    """Return rows in an order in which each part from the beginning contains values about equally often."""
    rest, ordered, n_rows_with = list(rows), [], Counter()
    while rest:
        # The value that is rarest in relation to the number of values of its axis counts most.
        best = min(rest, key=lambda row: sorted(n_rows_with[k, value] * len(values[k]) for k, value in enumerate(row)))
        rest.remove(best)
        ordered.append(best)
        n_rows_with.update(enumerate(best))
    return ordered


def main():
    """Store the table with rows for the present axes."""
    from reference.features import axes, is_possible

    names = [*axes(), "invariant"]
    values = [*map(list, axes().values()), invariants()]
    kept = [row for row in (read_rows() if TABLE.exists() else ()) if len(row) == len(values) and is_possible(row)]
    kept = [row for row in kept if all(value in axis for value, axis in zip(row, values, strict=True))]
    rows = in_order(cover(kept, values, is_possible, random.Random(0)), values)
    with TABLE.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([names, *rows])
    sys.stdout.write(f"{TABLE}: {len(rows)} rows, {len(kept)} of them as before\n")


if __name__ == "__main__":
    sys.path.insert(0, str(DIRECTORY.parent))
    main()
