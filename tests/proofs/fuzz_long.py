"""`make fuzz`: every fuzz test with many more examples, in processes whose memory is bounded.

Usage: HIL_FUZZ_EXAMPLES=3000 python -m tests.proofs.fuzz_long [pytest options]

`make fuzz` gives each test 3000 examples, which takes hours; the proof 400, thousands in all.
Seeds differ from run to run; a failing example is printed by hypothesis and belongs into the tests.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from pathlib import Path

TESTS = Path(__file__).parents[1]


def files() -> list[Path]:
    """Return the test files whose number of examples can be raised."""
    tests = sorted(TESTS.rglob("test_*.py"))
    return [file for file in tests if "examples(" in file.read_text("utf-8")]


ADDRESS_SPACE = 6 << 30
"""What a process may map; numpy, MuJoCo and Pinocchio alone map half of it."""
MOST_RESIDENT = 1 << 30
"""What a process may use; importing everything takes a quarter of it."""


def bounded() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))


def peak_of(file: Path, options: list[str]) -> tuple[int, int]:
    """Exit code of a test file, and the most memory it used [bytes]."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "--timeout",
        "7200",
        "-m",
        "hypothesis",
        str(file),
        *options,
    ]
    process = subprocess.Popen(command, preexec_fn=bounded)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_maxrss * 1024


def main() -> int:
    os.environ.setdefault("HIL_FUZZ_EXAMPLES", "400")
    failed = []
    for path in files():
        began, file = time.monotonic(), path.relative_to(TESTS).as_posix()
        code, peak = peak_of(path, sys.argv[1:])
        took = time.monotonic() - began
        sys.stdout.write(f"{file}: exit {code}, {took:.0f} s, {peak / 1e6:.0f} MB at most\n")
        sys.stdout.flush()
        if code or peak > MOST_RESIDENT:
            failed.append(file)
    sys.stdout.write(f"failed: {', '.join(failed)}\n" if failed else "nothing found\n")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
