"""Parameters of the reference implementation of EMVA 1288, of ``emva1288`` and of a twin, from the same files of frames."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs

other_program("emva1288.process.parser")

pytestmark = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # the descriptor, which it leaves open

ROOT = Path(__file__).parents[2]
PARTS = (("row", "row", "dsnu_row_e"), ("column", "col", "dsnu_column_e"), ("pixel", "pixel", "dsnu_e"))


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The results of all three, and the module that draws the frames."""
    path = ROOT / "benchmarks" / "emva_reference.py"
    spec = spec_from_file_location(path.stem, path)
    module = module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, path.stem, module)  # where dataclasses look up types
        spec.loader.exec_module(module)
    folder = tmp_path_factory.mktemp("frames")
    series = module.draw_series()
    descriptor, (temporal, spatial) = module.write_series(series, folder), module.own_of(series)
    saturation = int(temporal.transfer.saturation_level[0])
    reference = module.reference_of(descriptor, saturation)
    return SimpleNamespace(
        module=module,
        searched=module.reference_of(descriptor),
        reference=reference,
        temporal=temporal,
        spatial=spatial,
        twin=fs.twin.fit(folder, bits=module.BITS, pixel_um=module.PIXEL_UM),
    )


def test_parameters_agree_in_seven_digits(compared):
    """The digits that the reference compares: gain, QE, noise, saturation, linearity, dark current, total DSNU and PRNU."""
    rows = compared.module.rows_of(compared.reference, (compared.temporal, compared.spatial), compared.twin.estimates)
    whole = [row for row in rows if np.isfinite(row.reference) and " of " not in row.title.replace("current of", "")]

    assert len(whole) == 14
    for row in whole:
        assert row.own == pytest.approx(row.reference, rel=5e-8), row.title


def test_table_of_guide_is_current(compared):
    """The columns of the frames, of the reference and of ``emva1288``; those of the twin are within their intervals."""
    rows = compared.module.rows_of(compared.reference, (compared.temporal, compared.spatial), compared.twin.estimates)
    printed = [line.split("|")[1:-1] for line in compared.module.table_of(rows).splitlines()]
    guide = (ROOT / "docs" / "guides" / "your_camera.md").read_text()
    start = guide.index("| parameter | drawn |")
    shown = [line.split("|")[1:-1] for line in guide[start : guide.index("\n\n", start)].splitlines()]

    assert [cells[:4] for cells in shown] == [cells[:4] for cells in printed]
    for row, cells in zip(rows, shown[2:], strict=True):
        assert (row.twin is None) == (not cells[4].strip())
        assert row.twin is None or row.twin[1] <= float(cells[4]) <= row.twin[2]


def test_parts_agree_by_formulas_of_standard(compared):
    """
    Equations (41) and following divide squares of means by the numbers of rows and columns, instead of the degrees of freedom.

    They are solved with the same means here.
    """
    other, spatial, (n_y, n_x) = compared.reference, compared.spatial, compared.module.SHAPE
    n, left = n_y * n_x, n_y * n_x - n_y - n_x
    signal = other.spatial["avg_mean"] - other.spatial["avg_mean_dark"]
    found = {}
    for suffix, stack_dn2 in (("_dark", other.sigma_2_y_stack_dark), ("", other.sigma_2_y_stack)):
        dsnu2 = [(spatial.gain_dn_per_e[0] * getattr(spatial, f"dsnu_{part}_e")[0]) ** 2 for part, *_ in PARTS]
        prnu2 = [(signal * getattr(spatial, f"prnu_{part}_fraction")[0]) ** 2 for part, *_ in PARTS]
        row, column, pixel = dsnu2 if suffix else np.add(dsnu2, prnu2)
        noise = stack_dn2 / compared.module.N_STACK
        of_rows, of_columns = row + (pixel + noise) / n_x, column + (pixel + noise) / n_y
        squares = (n_y - 1) * n_x * of_rows + (n_x - 1) * n_y * of_columns + (n_y - 1) * (n_x - 1) * (pixel + noise)
        total = squares / (n - 1) - noise
        row_means = (n_y - 1) / n_y * of_rows - noise / n_x
        column_means = (n_x - 1) / n_x * of_columns - noise / n_y
        found |= {
            f"row{suffix}": ((n - n_x) * row_means - n_y * (total - column_means)) / left,
            f"col{suffix}": ((n - n_y) * column_means - n_x * (total - row_means)) / left,
            f"pixel{suffix}": n * (total - column_means - row_means) / left,
        }
    for name, value in found.items():
        assert value == pytest.approx(getattr(other, f"s_2_y_{name}"), rel=1e-9), name


def test_parts_differ_by_numbers_of_lines(compared):
    for part, short, _ in PARTS:
        for kind, unit in (("dsnu", "e"), ("prnu", "fraction")):
            own = getattr(compared.spatial, f"{kind}_{part}_{unit}")[0]
            other = getattr(compared.reference, f"{kind.upper()}1288_{short}")
            other /= 100.0 if kind == "prnu" else compared.spatial.gain_dn_per_e[0] / compared.temporal.gain_dn_per_e[0]
            assert own == pytest.approx(other, rel=1.0 / min(compared.module.SHAPE))


def test_reference_searches_saturation_among_clipped_levels(compared):
    """The standard takes the highest variance; the reference stops at a peak of the noise above it."""
    variances = compared.searched.temporal["s2_y"]

    assert compared.temporal.transfer.saturation_level[0] == np.argmax(variances)
    assert variances[compared.searched.index_u_ysat] < 0.05 * variances.max()


@pytest.mark.parametrize(
    ("name", "own", "reference", "factor"),
    [
        ("gain_dn_per_e", "gain_dn_per_e", "K", 1.0),
        ("qe", "qe", "QE", 0.01),
        ("read_noise_e", "dark_noise_e", "sigma_d", 1.0),
        ("dark_e_per_s", "dark_current_e_per_s", "u_I_mean", 1.0),
        ("prnu_fraction", "prnu_pixel_fraction", "PRNU1288_pixel", 0.01),
        ("prnu_row_fraction", "prnu_row_fraction", "PRNU1288_row", 0.01),
        ("prnu_column_fraction", "prnu_column_fraction", "PRNU1288_col", 0.01),
        *((twin, f"dsnu_{part}_e", f"DSNU1288_{short}", 1.0) for part, short, twin in PARTS),
    ],
)
def test_twin_agrees_within_intervals(name, own, reference, factor, compared):
    """Both intervals of 95 % together contain the difference, and that of the twin what was drawn."""
    found = compared.twin.estimates[name]
    result = compared.spatial if own.startswith(("dsnu", "prnu")) else compared.temporal
    limits = result.intervals[own][0]
    difference = abs(found.value - factor * float(getattr(compared.reference, reference)))

    assert difference < 0.5 * np.hypot(found.high - found.low, limits[1] - limits[0])
    truth = compared.module.TRUTH[own if own in compared.module.TRUTH else name]
    assert found.low <= truth <= found.high
