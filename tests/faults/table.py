"""Runs the fault matrix and writes its table into the docs: `make fault-matrix`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from faults.cases import FAULTS, STEPS

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "fault-matrix.md"
BEGIN, END = "<!-- table: make fault-matrix -->", "<!-- end of table -->"

Row = Mapping[str, Any]


def measured() -> list[Row]:
    """One row per field of the matrix, from running its tests.

    Raises:
        SystemExit: A field is not as it has to be.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pytest", "-q", "-n", "3", "-m", "matrix"]
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
    for fault, ending in FAULTS.items():
        mine = [row for row in rows if row["fault"] == fault]
        outcome = {row["outcome"] for row in mine}
        stop, rest = _worst(mine, "stop_s"), _worst(mine, "rest_s")
        allowed = "—" if ending.stop_within_s is None else f"{1e3 * ending.stop_within_s:.0f} ms"
        lines.append(
            f"| {fault} | {', '.join(sorted(outcome))} | {ending.exit_code} | {_ms(stop)} | "
            f"{_ms(rest)} | {allowed} | {len(mine)} of {len(STEPS)} | {ending.why} |"
        )
    return "\n".join(lines)


def written(page: str, new: str) -> str:
    """The page with another table in it."""
    head, rest = page.split(BEGIN)
    return f"{head}{BEGIN}\n{new}\n{END}{rest.split(END)[1]}"


def _worst(rows: Sequence[Row], key: str) -> float | None:
    return max((row[key] for row in rows if row[key] is not None), default=None)


def _ms(seconds: float | None) -> str:
    return "goes on" if seconds is None else f"{1e3 * seconds:.0f} ms"


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text("utf-8"), table(measured())), "utf-8")
