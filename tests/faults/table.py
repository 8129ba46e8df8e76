"""Runs the fault matrices and writes their tables into the docs: `make fault-matrix`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.faults import can_cases, cases, ur_cases
from tests.faults.ur_cases import WireEnding
from tests.support.paths import DOCS, ROOT

REFERENCE = DOCS / "reference"
MATRICES = {
    "fault-matrix.md": ("tests/faults/test_embedded.py", 3),
    "fault-matrix-ur.md": ("tests/faults/test_ur.py", 2),
    "fault-matrix-can.md": ("tests/faults/test_can.py", 2),
}
"""Page → its tests, and how many of them at a time: an arm over the wire minds a busy computer."""

BEGIN, END = "<!-- table: make fault-matrix -->", "<!-- end of table -->"

Row = Mapping[str, Any]


def measured(tests: str, workers: int) -> list[Row]:
    """One row per field of a matrix, from running its tests.

    Raises:
        SystemExit: A field is not as it has to be.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pytest", "-q", "-n", str(workers), "-m", "matrix", tests]
        done = subprocess.run(
            command, cwd=ROOT, env={**os.environ, "HIL_MATRIX": folder}, check=False
        )
        if done.returncode:
            raise SystemExit("the matrix is not as it has to be: the table stays as it was")
        return [json.loads(path.read_text("utf-8")) for path in Path(folder).iterdir()]


def table(rows: Sequence[Row]) -> str:
    """Markdown: a line per fault, worst figures over all kinds of steps."""
    lines = [
        "| what goes wrong | ends as | exit code | first stop | at rest after | of allowed |"
        " steps | why |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for fault, ending in cases.FAULTS.items():
        mine = [row for row in rows if row["fault"] == fault]
        stop, rest = _worst(mine, "stop_s"), _worst(mine, "rest_s")
        lines.append(
            f"| {fault} | {_outcomes(mine)} | {ending.exit_code} | {_ms(stop)} | "
            f"{_ms(rest)} | {_allowed(ending.stop_within_s)} | {len(mine)} of {len(cases.STEPS)} | "
            f"{ending.why} |"
        )
    return "\n".join(lines)


def ur_table(rows: Sequence[Row]) -> str:
    """The one of the UR controller."""
    return wire_table(rows, ur_cases.FAULTS, ur_cases.STEPS)


def can_table(rows: Sequence[Row]) -> str:
    """The one of the drives on CAN."""
    return wire_table(rows, can_cases.FAULTS, can_cases.STEPS)


def wire_table(
    rows: Sequence[Row], faults: Mapping[str, WireEnding], steps: Mapping[str, Any]
) -> str:
    """Markdown: a line per fault, the first stop for each kind of step, else the worst figures."""
    lines = [
        f"| what goes wrong | ends as | exit code | {' | '.join(steps)} | allowed |"
        " at rest after | lost | process ends | why |",
        "|---" * (len(steps) + 8) + "|",
    ]
    for fault, ending in faults.items():
        mine = {row["step"]: row for row in rows if row["fault"] == fault}
        figures = [
            *(_wire_stop(ending, mine.get(step)) for step in steps),
            _wire_allowed(ending),
            _ms(_worst(list(mine.values()), "rest_s"), "—"),
            _ms(_worst(list(mine.values()), "lost_s"), "—"),
            "—" if ending.before else f"{_worst(list(mine.values()), 'ended_s'):.1f} s",
        ]
        lines.append(
            f"| {fault} | {_outcomes(list(mine.values()))} | {ending.exit_code} | "
            f"{' | '.join(figures)} | {ending.why} |"
        )
    return "\n".join(lines)


def written(page: str, new: str) -> str:
    """The page with another table in it."""
    head, rest = page.split(BEGIN)
    return f"{head}{BEGIN}\n{new}\n{END}{rest.split(END)[1]}"


def _wire_stop(ending: WireEnding, row: Row | None) -> str:
    if ending.before:
        return "does not move"
    if ending.stop_within_s is None:
        return "—" if row is None else "goes on"
    return "—" if row is None else _ms(row["stop_s"])


def _wire_allowed(ending: WireEnding) -> str:
    standing = f", standing {_allowed(ending.standing_s)}" if ending.standing_s else ""
    return _allowed(ending.stop_within_s) + standing


def _outcomes(rows: Sequence[Row]) -> str:
    return ", ".join(sorted({row["outcome"] for row in rows}))


def _allowed(seconds: float | None) -> str:
    return "—" if seconds is None else f"{1e3 * seconds:.0f} ms"


def _worst(rows: Sequence[Row], key: str) -> float | None:
    return max((row[key] for row in rows if row[key] is not None), default=None)


def _ms(seconds: float | None, nothing: str = "goes on") -> str:
    return nothing if seconds is None else f"{1e3 * seconds:.0f} ms"


def main() -> None:
    """All pages, or those that are named."""
    makers = {
        "fault-matrix.md": table,
        "fault-matrix-ur.md": ur_table,
        "fault-matrix-can.md": can_table,
    }
    for name, (tests, workers) in MATRICES.items():
        if len(sys.argv) > 1 and name not in sys.argv:
            continue
        page = REFERENCE / name
        new = makers[name](measured(tests, workers))
        page.write_text(written(page.read_text("utf-8"), new), "utf-8")


if __name__ == "__main__":
    main()
