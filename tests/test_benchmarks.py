"""The programs of benchmarks/: rows that miss their bounds, the load of the machine, and planted faults."""

from __future__ import annotations

import random
import sys
from importlib import import_module
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SOURCE = '''\
"""A module."""

LIMIT = 3


def scale(values, n, factor=2.0):
    """Return scaled values."""
    if n < 1:
        raise ValueError(f"n must be at least 1, got {n + 2}")
    elif n > 7:
        n = 8
    return [factor * value for value in values[:n]]
'''


@pytest.fixture
def module_of(monkeypatch):
    """Return a function that imports a module of benchmarks/."""
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    before = set(sys.modules)
    yield import_module
    for name in {"fault_probes", "fault_selection", "gpu", "machine", "report"} - before:
        sys.modules.pop(name, None)


@pytest.fixture
def measured(module_of):
    """Return a function that runs a benchmark with one row, whose figures in the first and second run are given."""

    def measure(figures, bound=2.0):
        report, left = module_of("report").Report(is_judged=True), list(figures)
        report.measure(lambda own: own.add("frame", "", "", "", left.pop(0), bound))
        return report, left

    return measure


@pytest.mark.slow
def test_rows_within_bounds_are_measured_once(measured):
    report, left = measured([1.5, 1.0])

    assert left == [1.0]
    assert (report.missed, [row.figure for row in report.rows]) == (0, [1.5])
    assert "measured again: no row" in report.summary()


@pytest.mark.slow
@pytest.mark.parametrize(("figures", "expected", "n_missed"), [((3.0, 1.5), 1.5, 0), ((3.0, 4.0), 3.0, 1)])
def test_missed_rows_keep_better_figure(measured, figures, expected, n_missed):
    report, _ = measured(figures)

    assert (report.missed, [row.figure for row in report.rows]) == (n_missed, [expected])
    assert "measured again: frame" in report.summary()


def test_busy_time_omits_idle_cores(module_of):
    stat = "cpu  100 20 30 4000 500 6 7 80 9 9\ncpu0 100 20 30 4000 500 6 7 80 9 9\n"

    assert module_of("machine").parse_busy_s(stat, ticks_per_s=100.0) == pytest.approx(2.43)


def test_faults_spare_messages_and_docstrings(module_of):
    candidates = module_of("fault_selection").candidates
    found = {kind: {line for line, *_ in each} for kind, each in candidates(SOURCE, random.Random(0)).items()}

    assert found["arithmetic"] == {12}
    assert found["comparison"] == found["condition"] == {8, 10}
    assert found["constant"] == {3, 6, 8, 10, 11}
    assert found["index"] == {12}


def test_fault_follows_its_moved_line(module_of):
    fault = module_of("fault_selection").Fault(0, "a.py", 11, 12, "constant", "        n = 8", "        n = 9")
    moved = SOURCE.replace("LIMIT = 3", "LIMIT = 3\nOTHER = 4")

    assert fault.planted_in(moved) == moved.replace("n = 8", "n = 9")
    with pytest.raises(SystemExit, match="does not contain the line 'n = 8'"):
        fault.planted_in(SOURCE.replace("n = 8", "n = 10"))


@pytest.mark.parametrize(("line", "expected"), [(12, 12), (11, 11), (10, 8), (6, 8), (3, 8)])
def test_probe_precedes_faulty_statement(module_of, line, expected):
    text = SOURCE.split("\n")[line - 1]
    fault = module_of("fault_selection").Fault(0, "a.py", line, 0, "constant", text, text)
    statements = list(module_of("fault_probes").probed({"a.py": SOURCE}, fault))

    assert [(path, statement.lineno) for path, statement in statements] == [("a.py", expected)]


def test_kernel_is_probed_in_its_callers(module_of):
    kernels = "def _inner(x):\n    return x + 1\n\n\ndef outer(x):\n    return _inner(x)\n"
    caller = (
        "def call(x):\n    from a import _kernels\n\n    return _kernels.outer(x)\n\n\ndef other(x):\n    return x\n"
    )
    line = "    return x + 1"
    fault = module_of("fault_selection").Fault(0, "a/_kernels.py", 2, 0, "arithmetic", line, line)
    found = module_of("fault_probes").probed({"a/_kernels.py": kernels, "a/b.py": caller}, fault)

    assert [(path, function.lineno) for path, function in found] == [("a/b.py", 2)]


def test_machines_without_gpu_run_nothing(module_of, monkeypatch, capsys, tmp_path):
    gpu = module_of("gpu")
    monkeypatch.setattr(gpu, "has_gpu", lambda: False)
    monkeypatch.setattr(gpu, "run_tests", lambda device: pytest.fail("tests were run"))
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--out", str(tmp_path / "gpu.json")])
    gpu.main()

    assert capsys.readouterr().out == "PyTorch finds no CUDA device here; nothing was run.\n"
    assert not list(tmp_path.iterdir())


def test_failed_tests_of_device_end_the_run(module_of, monkeypatch, tmp_path):
    gpu = module_of("gpu")
    monkeypatch.setattr(gpu, "ROOT", tmp_path)
    (tmp_path / "tests" / "learn").mkdir(parents=True)
    (tmp_path / "tests" / "learn" / "test_one.py").write_text(
        "import pytest\n@pytest.mark.parametrize('device', ['cpu', 'cuda'])\ndef test_one(device):\n    assert device == 'cpu'\n"
    )

    assert gpu.run_tests("cpu").startswith("1 passed, 1 deselected")
    with pytest.raises(SystemExit, match=r"test_one\[cuda\]"):
        gpu.run_tests("cuda")
