"""Run proofs and remember what they showed: `make proof`, or `make proof UNIT="static ur"`.

Without names those run that are stale (`units.py`), shortest first. A unit's result is written to
`state.json` when it ends, so that a call that was broken off goes on where it was; the table of
`docs/reference/proofs.md` is made from it.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from tests.proofs.units import UNITS, Unit
from tests.support.paths import DOCS, ROOT

STATE = Path(__file__).with_name("state.json")
PAGE = DOCS / "reference" / "proofs.md"
BEGIN, END = "<!-- table: make proof -->", "<!-- end of table -->"
INPUTS = ("hil", "drivers", "mock_robot", "benchmarks", "experiments", "tests", "pyproject.toml")
PRODUCT = ("hil/**/*", "drivers/**/*", "mock_robot/**/*", "benchmarks/**/*", "experiments/**/*")
ALWAYS = (*PRODUCT, "pyproject.toml", "constraints.txt")
MOST_FIGURES = 12
"""Printed lines that are kept of a unit."""

_NOISE = re.compile(
    r"[.sFEx]*\s*\[ *\d+%\]|[.sFEx]+|=+.*|-+.*|tests/\S+ .*|bringing up nodes.*|"
    r"(?:platform|rootdir|configfile|plugins|timeout|timeout method|timeout func_only):? .*|"
    r"(?:created|collecting|collected) .*|WARNING: .*"
)

State = dict[str, dict[str, Any]]


def inputs_of(unit: Unit) -> list[Path]:
    """Return the files that a unit's result depends on: what its tests import is among them."""
    patterns = [*ALWAYS, *unit.further]
    if "pytest" in unit.run:
        patterns.append("tests/conftest.py")
    for test in (*unit.tests, *unit.modules):
        patterns.append(f"{test}/**/*.py" if (ROOT / test).is_dir() else test)
    found = {path for pattern in patterns for path in ROOT.glob(pattern)}
    files = {path for path in found if path.is_file() and "__pycache__" not in path.parts}
    left = [path for path in files if path.is_relative_to(ROOT / "tests")]
    while left:
        new = imported_of_tests(left.pop()) - files
        files |= new
        left += new
    return sorted(files)


_IMPORT = re.compile(r"\bfrom (tests[\w.]*) import (\([^)]*\)|[^\n]*)|[\"' ](tests(?:\.\w+)+)\b")


def imported_of_tests(file: Path) -> set[Path]:
    """Return the files of `tests` that a file imports, or starts as modules, at any place in it."""
    if file.suffix != ".py":
        return set()
    names: set[str] = set()
    for package, members, module in _IMPORT.findall(file.read_text("utf-8")):
        names |= {module or package, *(f"{package}.{name}" for name in re.findall(r"\w+", members))}
    paths = {ROOT.joinpath(*name.split(".")) for name in names}
    return {
        path for name in paths for path in (name.with_suffix(".py"), name / "__init__.py")
        if path.is_file()
    }  # fmt: skip


def digest_of(unit: Unit) -> str:
    """Return the SHA-256 of how a unit is run and of the names and contents of its inputs."""
    digest = hashlib.sha256(" ".join(unit.run).encode())
    for path in inputs_of(unit):
        digest.update(b"\0" + path.relative_to(ROOT).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def last_of(unit: Unit, state: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return the last result of a unit; None if it was of another claim, or of other bounds."""
    last = state.get(unit.name)
    same = last is not None and (last["claim"], last["run"]) == (unit.claim, " ".join(unit.run))
    return last if same else None


PASSED = "passed"


def standing_of(unit: Unit, state: Mapping[str, Mapping[str, Any]]) -> str:
    """Return what is known of a unit in a few words; `PASSED` if it is not stale."""
    last = last_of(unit, state)
    if last is None:
        return "never ran"
    if not last["passed"]:
        return f"failed at {last['revision']}"
    if last["inputs"] != digest_of(unit):
        return f"passed at {last['revision']}, changed since"
    return PASSED


def read_state() -> State:
    """Return what is known of each unit, by its name."""
    return json.loads(STATE.read_text("utf-8")) if STATE.exists() else {}


def write_state(state: State) -> None:
    """Write what is known, whole or not at all, and the table of the page."""
    order = {unit.name: place for place, unit in enumerate(UNITS)}
    known = {name: state[name] for name in sorted(state, key=lambda n: order.get(n, len(order)))}
    draft = STATE.with_suffix(".draft")
    draft.write_text(json.dumps(known, indent=1, ensure_ascii=False) + "\n", "utf-8")
    draft.replace(STATE)
    write_table(known)


def table_of(state: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the Markdown table of all units, and below it what they printed."""
    lines = ["| unit | claim | last run | minutes | result |", "|---|---|---|---|---|"]
    for unit in UNITS:
        last = last_of(unit, state)
        if last is None:
            cells = ("not yet", f"about {unit.minutes:g}", "–")
        else:
            result = "passed" if last["passed"] else "**failed**"
            when = f"{last['date']}, `{last['revision']}`"
            cells = (when, f"{last['seconds'] / 60:.1f}", f"{result}: {last['summary']}")
        lines.append(f"| `{unit.name}` | {unit.claim} | " + " | ".join(cells) + " |")
    for unit in UNITS:
        if (last := last_of(unit, state)) and (figures := last["figures"]):
            lines += ["", f"## {unit.name}", "", "```text", *figures, "```"]
    return "\n".join(lines)


def write_table(state: Mapping[str, Mapping[str, Any]]) -> None:
    """Replace the table of the page."""
    text = PAGE.read_text("utf-8")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    PAGE.write_text(f"{before}{BEGIN}\n\n{table_of(state)}\n\n{END}{after}", "utf-8")


def figures_of(output: str) -> list[str]:
    """Return the printed lines that are figures: neither progress nor pytest's own headings."""
    lines = [line.strip() for line in output.splitlines()]
    told = [line for line in lines if line and not _NOISE.fullmatch(line)]
    return [line[:300] for line in told[-MOST_FIGURES:]]


def summary_of(unit: Unit, output: str, code: int) -> str:
    """Return pytest's last line without its frame and times, or a program's exit code."""
    found = re.findall(r"(\d+ (?:passed|failed)[^=\n]*?) in [\d.]+s", output)
    return found[-1] if found and "pytest" in unit.run else f"exit code {code}"


def revision() -> str:
    """Return the short hash of the checkout, marked if anything but documents differs from it."""
    git = ("git", "-C", str(ROOT))
    told = subprocess.run([*git, "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True)
    changed = subprocess.run(
        [*git, "status", "--porcelain", "--", *INPUTS, f":!{STATE.relative_to(ROOT).as_posix()}"],
        capture_output=True,
        text=True,
    )
    return told.stdout.strip() + ("+" if changed.stdout.strip() else "")


def end(process: subprocess.Popen[str]) -> None:
    """End a process and all that it has started; a run that is made in it may hear no signal."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5.0)


def run_unit(unit: Unit, state: State) -> bool:
    """Run a unit, record its result, and return whether it passed.

    Raises:
        KeyboardInterrupt: Ctrl-C; the unit's processes are ended, and nothing is recorded.
    """
    inputs, tested, began = digest_of(unit), revision(), time.monotonic()
    sys.stdout.write(f"\n== {unit.name}: {unit.claim} (about {unit.minutes:g} min)\n")
    sys.stdout.flush()
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with subprocess.Popen(
        [sys.executable, *unit.run],
        cwd=ROOT,
        env=threads | os.environ,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        output = ""
        try:
            for line in process.stdout:
                output += line
                sys.stdout.write(line)
                sys.stdout.flush()
            code = process.wait()
        except KeyboardInterrupt:
            end(process)
            raise
    summary = summary_of(unit, output, code)
    # What was skipped, for want of an extra, of data or of a quiet computer, has not been shown.
    words = f" {summary}"
    shown = code == 0 and (
        "pytest" not in unit.run or (" passed" in words and " skipped" not in words)
    )
    if digest_of(unit) != inputs:
        shown, summary = False, f"{summary}; its inputs were changed meanwhile"
    state |= read_state()  # another call may have ended units meanwhile
    state[unit.name] = {
        "passed": shown,
        "claim": unit.claim,
        "run": " ".join(unit.run),
        "summary": summary,
        "revision": tested,
        "inputs": inputs,
        "date": date.today().isoformat(),
        "seconds": round(time.monotonic() - began, 1),
        "cores": os.cpu_count(),
        "figures": figures_of(output),
    }
    write_state(state)
    return shown


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the units that are named, or those that are stale; return 1 if one of them failed."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.proofs", description="Run proofs and remember what they showed."
    )
    parser.add_argument(
        "units", nargs="*", help="names of units; without any, those that are stale"
    )
    parser.add_argument("--list", action="store_true", help="say what is stale and run nothing")
    given = parser.parse_args(arguments)
    by_name = {unit.name: unit for unit in UNITS}
    if unknown := sorted(set(given.units) - set(by_name)):
        close = [near for name in unknown for near in difflib.get_close_matches(name, by_name, 1)]
        guess = f"; did you mean {' or '.join(close)}?" if close else ""
        parser.error(f"no unit {', '.join(unknown)}{guess} `make proof-state` lists them")
    state = read_state()
    standings = {unit.name: standing_of(unit, state) for unit in UNITS}
    stale = [unit for unit in UNITS if standings[unit.name] != PASSED]
    if given.list:
        for unit in UNITS:
            what = f"{unit.name:16} {standings[unit.name]:34} {unit.minutes:3g} min"
            sys.stdout.write(f"{what}  {unit.claim}\n")
        minutes = sum(unit.minutes for unit in stale)
        sys.stdout.write(f"{len(stale)} of {len(UNITS)} are stale: {minutes / 60:.1f} h\n")
        return 0
    chosen = [by_name[name] for name in given.units] or sorted(stale, key=lambda one: one.minutes)
    failed: list[str] = []
    for unit in chosen:
        try:
            failed += [] if run_unit(unit, state) else [unit.name]
        except KeyboardInterrupt:
            sys.stdout.write(f"\ninterrupted; nothing is recorded of {unit.name}\n")
            return 130
    sys.stdout.write(f"\n{len(chosen) - len(failed)} of {len(chosen)} units passed")
    sys.stdout.write(f"; failed: {', '.join(failed)}\n" if failed else "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the unit's processes as well
    sys.exit(main())
