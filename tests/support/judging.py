"""A run with made-up rows that is fitted and judged."""

from __future__ import annotations

from pathlib import Path

from hil.recording.run_directory import RunDirectory
from tests.support.report_runs import dwell_plan, write_run

COUNTS = {"samples": 1000, "gaps": 0, "missing": 0, "duplicates": 0, "overruns": 0}


LOOSE = "{rmse: {max: 99, unit: A}}"


def run_with(root: Path, fits: str = "static-wls", accept: str = LOOSE) -> RunDirectory:
    run = write_run(root, dwell_plan(poses=40), accept=accept)
    file = run.path / "spec.yaml"
    named = ", ".join(f"{{estimator: {name}}}" for name in fits.split())
    file.write_text(file.read_text("utf-8").replace("{estimator: static-wls}", named), "utf-8")
    return run
