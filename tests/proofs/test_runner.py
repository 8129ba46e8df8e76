"""The runner of the proofs: what is stale, what is remembered, what the table says."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.proofs import __main__ as runner
from tests.proofs import bench
from tests.proofs.units import UNITS, Unit
from tests.support.paths import ROOT
from tests.support.waiting import until

MARK = "mark." + "proof"


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small checkout with two units: one that passes, one that does as `outcome.txt` says."""
    for name in ("hil/core/a.py", "tests/support/b.py", "tests/support/c.py", "docs/other.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1")
    (tmp_path / "tests" / "test_it.py").write_text("from tests.support import (\n    b,\n)\n")
    page = tmp_path / "docs" / "proofs.md"
    page.write_text(f"Before.\n\n{runner.BEGIN}\n{runner.END}\n\nAfter.\n")
    (tmp_path / "outcome.txt").write_text("0")
    ends = "import sys; print('ratio 3.5'); sys.exit(int(open('outcome.txt').read()))"
    units = (
        Unit("good", "one is one", ("-c", "print('12 passed in 3.00s')"), 1.0),
        Unit("odd", "it ends well", ("-c", ends, "tests/test_it.py"), 0.5, ("outcome.txt",)),
    )
    for name, value in {
        "ROOT": tmp_path, "STATE": tmp_path / "state.json", "PAGE": page, "UNITS": units,
    }.items():  # fmt: skip
        monkeypatch.setattr(runner, name, value)
    return tmp_path


def stale() -> list[str]:
    state = runner.read_state()
    standings = {unit.name: runner.standing_of(unit, state) for unit in runner.UNITS}
    return [name for name, standing in standings.items() if standing != runner.PASSED]


def test_what_has_passed_is_stale_only_when_an_input_changes(checkout: Path) -> None:
    assert stale() == ["good", "odd"]
    assert runner.main([]) == 0
    assert stale() == []
    for name, now in (
        ("docs/other.md", []),
        ("tests/support/b.py", ["odd"]),
        ("tests/support/c.py", []),
        ("outcome.txt", ["odd"]),
        ("hil/core/a.py", ["good", "odd"]),
    ):
        before = (checkout / name).read_text()
        (checkout / name).write_text("2")
        assert stale() == now, name
        (checkout / name).write_text(before)
        assert stale() == []


@pytest.mark.parametrize("more", ["", "\ndef test_more():\n    pass\n"], ids=["all", "one"])
def test_a_proof_whose_tests_were_skipped_has_not_passed(
    more: str, checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (checkout / "test_it.py").write_text(
        f"import pytest\n\ndef test_it():\n    pytest.skip('no torch')\n{more}"
    )
    unit = Unit("skips", "it works", ("-m", "pytest", "test_it.py"), 1.0)
    monkeypatch.setattr(runner, "UNITS", (unit,))
    assert runner.main([]) == 1
    assert stale() == ["skips"]


def test_a_proof_whose_inputs_were_changed_meanwhile_has_not_passed(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    edits = ("-c", "open('hil/core/a.py', 'w').write('2')")
    monkeypatch.setattr(runner, "UNITS", (Unit("edits", "it edits", edits, 1.0),))
    assert runner.main([]) == 1
    assert "changed meanwhile" in runner.read_state()["edits"]["summary"]
    assert stale() == ["edits"]


def test_a_failure_is_remembered_and_runs_again(
    checkout: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (checkout / "outcome.txt").write_text("3")
    assert runner.main([]) == 1
    assert "failed: odd" in capfd.readouterr().out
    assert stale() == ["odd"]
    assert runner.read_state()["odd"]["summary"] == "exit code 3"
    (checkout / "outcome.txt").write_text("0")
    assert runner.main([]) == 0
    assert "good: one is one" not in capfd.readouterr().out
    assert stale() == []


def test_the_table_has_every_unit_and_what_it_printed(checkout: Path) -> None:
    assert runner.main(["odd"]) == 0
    page = runner.PAGE.read_text("utf-8")
    assert page.startswith("Before.")
    assert page.endswith("After.\n")
    assert "| `good` | one is one | not yet | about 1 | – |" in page
    assert "passed: exit code 0" in page
    assert "## odd\n\n```text\nratio 3.5\n```" in page


def test_another_claim_has_not_been_shown(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runner.main([]) == 0
    good, odd = runner.UNITS
    monkeypatch.setattr(runner, "UNITS", (replace(good, claim="one is two"), odd))
    assert stale() == ["good"]
    runner.write_state(runner.read_state())
    assert "| `good` | one is two | not yet | about 1 | – |" in runner.PAGE.read_text("utf-8")
    assert runner.main(["--list"]) == 0
    assert "1 of 2 are stale" in capsys.readouterr().out


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="Linux only")
def test_ctrl_c_ends_all_processes_of_a_unit_and_records_nothing(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    deaf = "import signal, subprocess, sys, time; signal.signal(signal.SIGINT, signal.SIG_IGN); "
    child = f"{deaf}print('there', flush=True); time.sleep(600)"
    parent = f"{deaf}subprocess.run([sys.executable, '-c', {child!r}])"
    monkeypatch.setattr(runner, "UNITS", (Unit("waits", "it waits", ("-c", parent), 1.0),))
    started: list[subprocess.Popen[str]] = []

    class Starting(subprocess.Popen[str]):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            started.append(self)

    def interrupted(text: str) -> int:
        if "there" in text:
            raise KeyboardInterrupt
        return len(text)

    monkeypatch.setattr(runner.subprocess, "Popen", Starting)
    with monkeypatch.context() as patched:
        patched.setattr(runner.sys.stdout, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            runner.run_unit(runner.UNITS[0], {})
    group = started[-1].pid
    until(lambda: not any(_group_of(stat) == group for stat in Path("/proc").glob("[0-9]*/stat")))
    assert stale() == ["waits"]


def _group_of(stat: Path) -> int:
    """Return the process group of a process that has not ended; 0 otherwise."""
    try:
        state, _, group = stat.read_text("utf-8").rpartition(")")[2].split()[:3]
    except OSError:
        return 0
    return 0 if state == "Z" else int(group)


def test_a_unit_that_does_not_exist_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        runner.main(["statics"])
    assert "no unit statics; did you mean static?" in capsys.readouterr().err


def test_the_committed_table_is_of_the_committed_state() -> None:
    text = runner.PAGE.read_text("utf-8")
    between = text.split(runner.BEGIN)[1].split(runner.END)[0]
    assert between.strip() == runner.table_of(runner.read_state())


def test_every_test_that_is_marked_as_a_proof_belongs_to_a_unit() -> None:
    files = {test for unit in UNITS for test in unit.tests}
    marked = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("test_*.py")
        if MARK in path.read_text("utf-8")
    }
    missing = [
        name for name in marked if not any(re.match(rf"{file}(/|$)", name) for file in files)
    ]
    assert missing == []


IMPORTED = re.compile(r"(?m)^\s*(?:from|import) ((?:tests|benchmarks)[\w.]*)")


def test_what_a_unit_imports_of_tests_and_benchmarks_is_an_input() -> None:
    for unit in UNITS:
        inputs = set(runner.inputs_of(unit))
        tests = [path for path in inputs if path.suffix == ".py" and "tests" in path.parts]
        names = {name for path in tests for name in IMPORTED.findall(path.read_text("utf-8"))}
        files = {ROOT.joinpath(*name.split(".")).with_suffix(".py") for name in names}
        assert [path for path in files if path.exists() and path not in inputs] == [], unit.name


def test_units_have_names_of_their_own_and_files_that_exist() -> None:
    assert len({unit.name for unit in UNITS}) == len(UNITS)
    for unit in UNITS:
        assert runner.inputs_of(unit), unit.name
        assert [test for test in unit.tests if not (ROOT / test).exists()] == []


@pytest.mark.parametrize(
    ("bounds", "code", "last"),
    [
        ([], 0, "twice 2"),
        (["ours_s<=1"], 0, "ours_s 0.5 (at most 1)"),
        (["ours_s<=0.4"], 1, "ours_s 0.5 (at most 0.4: NOT KEPT)"),
        (["twice>=2"], 0, "twice 2 (at least 2)"),
        (["twice>=2.5", "ours_s<=1"], 1, "ours_s 0.5 (at most 1)"),
        (["peer_s>=1"], 1, "peer_s nan (at least 1: NOT KEPT)"),
    ],
)
def test_a_benchmark_is_judged_by_its_bounds(
    bounds: list[str],
    code: int,
    last: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    document = {"name": "it", "figures": {"ours_s": 0.5}, "ratios": {"twice": 2.0}}
    monkeypatch.setattr(bench, "measure", {"it": document}.__getitem__)
    assert bench.main(["it", *bounds]) == code
    assert capsys.readouterr().out.splitlines()[-1] == last


def test_bounds_of_benchmarks_can_be_read() -> None:
    for unit in UNITS:
        if "tests.proofs.bench" in unit.run:
            bounds = unit.run[unit.run.index("tests.proofs.bench") + 2 :]
            assert [bench.bound_of(text)[1] for text in bounds], unit.name
    with pytest.raises(ValueError, match="name>=number"):
        bench.bound_of("twice=2")
